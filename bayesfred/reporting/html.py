"""One self-contained HTML page about a run: verdict, tables, figures, provenance.

The page loads nothing from elsewhere and runs no script, so that it can be mailed, archived and
opened years later. Text that comes from a user is escaped by the template engine.
`bayesfred.sampling.summary` and `bayesfred.analysis.diagnostics` supply the numbers,
`bayesfred.reporting.figures` the figures. `base.html` has the styles of all pages.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from bayesfred._typing import Floats, PathLike
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.errors import printable
from bayesfred.io import atomic
from bayesfred.io.marks import marked
from bayesfred.io.summary_table import Table
from bayesfred.model.joint import JointPosterior
from bayesfred.model.noise import SubtractedNoise, correlation_ratio
from bayesfred.model.parameters import Parameter
from bayesfred.model.posterior import Posterior
from bayesfred.reporting.figures import PageFigure
from bayesfred.reporting.labels import (
    html_symbol,
    html_symbols,
    html_unit,
    scale_of,
    with_error,
)
from bayesfred.reporting.style import embedded
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.record import RunRecord

__all__ = [
    "described_frames",
    "described_model",
    "embedded_figures",
    "made_with",
    "parameter_rows",
    "provenance",
    "render",
    "write_report",
]

LEVELS = (0.025, 0.16, 0.84, 0.975)  # of the intervals of 68 % and 95 %

# digits after the point of what is dimensionless
DIGITS = {
    "rhat": 4,
    "ess_bulk": 0,
    "ess_tail": 0,
    "tau": 2,
    "prior_sensitivity": 3,
    "likelihood_sensitivity": 3,
}


@dataclass(frozen=True)
class _Statistic:
    """A measure of the fit with what it would be for a true model."""

    name: str
    value: str
    expected: str
    sd: str
    z: str
    meaning: str


def write_report(
    path: PathLike,
    *,
    chain: Chain,
    summary: Table,
    diagnostics: Diagnostics,
    figures: Sequence[PageFigure] = (),
    result: str | None = None,
    home: Path | None = None,
) -> Path:
    """Write the report of a run as one HTML file, in one step: the old page stays until then.

    Parameters
    ----------
    path : path-like
        Where the page goes; an existing file is replaced.
    chain : Chain
        Its `record` gives title, frame, settings and notes.
    summary : Table
        The parameters of `chain`, see `bayesfred.sampling.summary.summary`, with
        `Diagnostics.columns`.
    diagnostics : Diagnostics
        What `diagnose` said of `chain`.
    figures : sequence of PageFigure, optional
        In the page's order.
    result : str, optional
        A sentence with what was found, which leads the page.
    home : Path, optional
        The page of all frames, beside this one.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the page cannot be written.
    """
    path = Path(path)
    posterior, record = chain.posterior(), chain.record or RunRecord(path.stem)
    made = made_with(chain)
    heading, subtitle = record.title or path.stem, described_model(record, posterior)
    page = render(
        "run.html",
        title=f"{heading}: {subtitle}; {made}",
        heading=heading,
        subtitle=subtitle,
        made=made,
        home=home and quote(home.name),
        result=result,
        diagnostics=diagnostics,
        causes=diagnostics.causes,
        rows=parameter_rows(chain, summary),
        prior_dominated=html_symbols(diagnostics.prior_dominated, posterior.parameters),
        has_truth="truth" in summary.colnames,
        has_robust="robust_sd" in summary.colnames,
        statistics=_statistics(diagnostics),
        figures=embedded_figures(figures),
        **provenance(chain, diagnostics),
    )
    atomic.replace(path, marked(page, chain.identity))
    return path


def parameter_rows(chain: Chain, summary: Table) -> list[dict[str, str]]:
    """The rows of the table of parameters, as the templates take them.

    Parameters
    ----------
    chain : Chain
    summary : astropy.table.Table
        Of all its parameters, or of some.

    Returns
    -------
    list of dict
    """
    parameters = {p.name: p for p in chain.posterior().parameters}
    levels = dict(
        zip(chain.parameter_names, np.quantile(chain.draws(), LEVELS, axis=0).T, strict=True)
    )
    return [_row(dict(row), parameters[row["name"]], levels[row["name"]]) for row in summary]


def made_with(chain: Chain) -> str:
    """When a run was made, if that is known, and with which version.

    Parameters
    ----------
    chain : Chain

    Returns
    -------
    str
        Such as "2026-11-22 04:00 UTC, bayesfred 0.1.0".
    """
    made = f"bayesfred {chain.versions['bayesfred']}"
    if chain.record is None:
        return made
    return f"{datetime.fromisoformat(chain.record.made):%Y-%m-%d %H:%M} UTC, {made}"


def render(template: str, **values: Any) -> bytes:
    """Fill in a template of this folder: what is no markup is escaped, and printable.

    Parameters
    ----------
    template : str
        Its file's name.
    **values : object

    Returns
    -------
    bytes
    """
    environment = Environment(
        loader=PackageLoader("bayesfred.reporting", ""),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=_shown,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values).encode()


def _shown(value: Any) -> Any:
    """Text without characters that show nothing, or turn what follows: they are escaped."""
    return printable(value) if isinstance(value, str) and not isinstance(value, Markup) else value


def _lines(text: str) -> Markup:
    """A text of several lines."""
    return Markup("\n").join(Markup("{}").format(printable(line)) for line in text.split("\n"))


def embedded_figures(figures: Sequence[PageFigure]) -> list[dict[str, Any]]:
    """Figures as a template takes them.

    Parameters
    ----------
    figures : sequence of PageFigure

    Returns
    -------
    list of dict
    """
    return [{**f._asdict(), "image": embedded(f.content)} for f in figures]


def described_model(record: RunRecord, posterior: Posterior) -> str:
    """The frame and its model in words.

    Parameters
    ----------
    record : RunRecord
    posterior : Posterior

    Returns
    -------
    str
    """
    model, free = posterior.model, posterior.nuisances
    ny, nx = posterior.counts.shape
    box = " integrated over the pixel" if model.detector.pixel == "box" else ""
    number, noise = len(model.sources), posterior.noise.pixelwise
    parts = [
        f"{record.frame or 'frame'}, {ny} × {nx} pixels",
        f"{number} source{'s' * (number != 1)} of {free.flux} flux",
        f"{_words(model.psf)}{box}",
        f"distortion of {model.distortion.n_terms} terms",
    ]
    if isinstance(noise, SubtractedNoise):
        parts += [_words(noise.noise), "structure of the background subtracted"]
    else:
        parts.append(_words(noise))
    if noise is not posterior.noise:
        parts.append(f"noise correlation ratio {correlation_ratio(posterior.noise):g}")
    names = [name.replace("_", " ") for name in free.names]
    return ", ".join(parts) + (f"; also free: {', '.join(names)}" if names else "")


def described_frames(posterior: JointPosterior) -> str:
    """What several frames share, in words.

    Parameters
    ----------
    posterior : JointPosterior

    Returns
    -------
    str
    """
    return (
        f"{len(posterior.frames)} frames of one instrument; of {posterior.n_parameters} parameters "
        f"they share {posterior.n_shared}"
    )


def _words(value: Any) -> str:
    """The name of a class in words, abbreviations kept."""
    name = re.sub("(?<=[a-z])(?=[A-Z])", " ", type(value).__name__)
    first, *rest = name.split()
    return " ".join([first, *(word if word.isupper() else word.lower() for word in rest)])


def _row(values: dict[str, Any], parameter: Parameter, levels: Floats) -> dict[str, str]:
    """One parameter's cells by column of the summary, its numbers in one power of ten.

    `levels` are the parameter's quantiles of `LEVELS`.
    """
    scale = scale_of(values["mean"], values["sd"])
    cells: dict[str, str] = {
        key: _minus(scale.number(values[key])) if math.isfinite(values[key]) else ""
        for key in ("truth", "MAP", "mean", "sd", "robust_sd")
        if key in values
    }
    bounds = [_minus(scale.number(level)) for level in levels]
    cells |= {
        "symbol": html_symbol(parameter),
        "unit": html_unit(parameter, scale.exponent),
        "z": _z(values["z"]) if "z" in values else "",
        "corner": _minus(with_error(values["corner"], values["corner_sd"]).replace("+-", "±")),
        "interval_68": f"{bounds[1]} … {bounds[2]}",
        "interval_95": f"{bounds[0]} … {bounds[3]}",
    }
    return cells | {
        key: f"{values[key]:.{digits}f}" if math.isfinite(values[key]) else ""
        for key, digits in DIGITS.items()
    }


def _statistics(diagnostics: Diagnostics) -> list[_Statistic]:
    """A row for each check, then the paper's two numbers, of which nothing is expected."""
    d = diagnostics
    rows = [
        _Statistic(
            check["name"], _number(check["value"]), _number(check["expected"]),
            _number(check["sd"]), _z(check["z"]), check["meaning"],
        )
        for check in d.checks
    ]  # fmt: skip
    return [
        *rows,
        _Statistic(
            "χ² of Sun & "
            "Zhou", _general(d.chi2_paper), "1" if math.isfinite(d.chi2_paper) else "", "", "",
            "variance of counts − source image over the background; exceeds 1 where sources add "
            "noise",
        ),
        _Statistic(
            "λ̂ of Sun & Zhou", _general(d.background_estimate), "", "", "",
            "mean of counts − source image, counts per pixel",
        ),
    ]  # fmt: skip


def _number(value: float) -> str:
    """Numbers of all sizes, with a digit that matters; empty where there is none."""
    if not math.isfinite(value):
        return ""
    return _minus(f"{value:.1f}" if abs(value) >= 100.0 else f"{value:.3g}")


def provenance(chain: Chain, diagnostics: Diagnostics) -> dict[str, Any]:
    """Where a run's draws are from, its notes and its settings, as the templates take them.

    Parameters
    ----------
    chain : Chain
    diagnostics : Diagnostics

    Returns
    -------
    dict
    """
    record = chain.record or RunRecord()
    return {
        "provenance": _provenance(chain, diagnostics),
        "notes": record.notes,
        "settings": _lines(record.settings or ""),
    }


def _provenance(chain: Chain, diagnostics: Diagnostics) -> list[tuple[str, str]]:
    n_ensembles, n_steps, n_walkers, d = chain.chain.shape
    drawn = f"{diagnostics.n_draws} of {d} parameters, "
    if chain.method == "mcmc":
        how = [
            ("sampler", f"{n_ensembles} ensembles of {n_walkers} walkers"),
            ("steps", f"{n_steps}, {chain.burn_in} of them burn-in"),
            ("draws", f"{drawn}acceptance {diagnostics.acceptance:.1%}"),
        ]
    else:
        how = [
            ("draws", f"{drawn}independent, of the Laplace approximation"),
            ("approximation", str(diagnostics.approximation)),
        ]
    return [
        ("chain file", printable(str(chain.path))),
        ("seed", str(chain.seed)),
        *how,
        ("MAP", f"{chain.estimate.message} ({chain.estimate.n_evaluations} evaluations)"),
        ("pixels used", str(diagnostics.n_pixels)),
        ("versions", chain.version_history),
    ]


def _minus(number: str) -> str:
    return number.replace("-", "−")


def _z(value: float) -> str:
    return _minus(f"{value:+.2f}") if math.isfinite(value) else ""


def _general(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else "not defined"
