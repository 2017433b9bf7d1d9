"""One self-contained HTML page about a run: verdict, tables, figures, provenance.

The page loads nothing from elsewhere and runs no script, so that it can be mailed, archived and
opened years later. Text that comes from a user is escaped by the template engine.
`bayesfred.sampling.summary` and `bayesfred.analysis.diagnostics` supply the numbers; the figures
are those of `bayesfred.reporting.frames` and `bayesfred.reporting.posteriors`.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from bayesfred._typing import Floats, PathLike
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.analysis.field import DisplacementField
from bayesfred.analysis.sources import source_table
from bayesfred.errors import printable
from bayesfred.io import atomic
from bayesfred.io.summary_table import Table
from bayesfred.model.parameters import Parameter
from bayesfred.model.posterior import Posterior
from bayesfred.reporting.field import field_plot
from bayesfred.reporting.frames import FittedFrame, frame_triptych, star_panels
from bayesfred.reporting.labels import html_symbol, html_unit, scale_of, with_error
from bayesfred.reporting.posteriors import corner_plot, trace_plot
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain

__all__ = ["PageFigure", "page_figures", "write_report"]

# digits after the point of what is dimensionless
DIGITS = {
    "rhat": 4,
    "ess_bulk": 0,
    "ess_tail": 0,
    "tau": 2,
    "prior_sensitivity": 3,
    "likelihood_sensitivity": 3,
}


class PageFigure(NamedTuple):
    """A figure of the page with what stands above and below it."""

    heading: str
    caption: str
    figure: Figure


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
    title: str,
    chain: Chain,
    summary: Table,
    diagnostics: Diagnostics,
    figures: Sequence[PageFigure] = (),
    result: str | None = None,
    notes: Sequence[str] = (),
    settings: str | None = None,
) -> Path:
    """Write the report of a run as one HTML file, in one step: the old page stays until then.

    Parameters
    ----------
    path : path-like
        Where the page goes; an existing file is replaced.
    title : str
        Heading of the page.
    chain : Chain
    summary : Table
        The parameters of `chain`, see `bayesfred.sampling.summary.summary`, with
        `Diagnostics.columns`.
    diagnostics : Diagnostics
        What `diagnose` said of `chain`.
    figures : sequence of PageFigure, optional
        In the page's order.
    result : str, optional
        What the run found, in a sentence.
    notes : sequence of str, optional
        Paragraphs of plain text.
    settings : str, optional
        The run's settings, printed as they are.

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
    environment = Environment(
        loader=PackageLoader("bayesfred.reporting", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    parameters = {p.name: p for p in chain.posterior().parameters}
    page = environment.get_template("template.html").render(
        title=title,
        diagnostics=diagnostics,
        rows=[_row(dict(row), parameters[row["name"]]) for row in summary],
        prior_dominated=Markup(", ").join(
            html_symbol(parameters[name]) for name in diagnostics.prior_dominated
        ),
        has_truth="truth" in summary.colnames,
        statistics=_statistics(diagnostics),
        figures=[(f.heading, f.caption, _data_uri(f.figure)) for f in figures],
        provenance=_provenance(chain, diagnostics),
        result=result,
        notes=notes,
        settings=settings,
    )
    atomic.replace(path, page.encode())
    return path


def _row(values: dict[str, Any], parameter: Parameter) -> dict[str, str]:
    """One parameter's cells by column of the summary, its numbers in one power of ten."""
    scale = scale_of(values["mean"], values["sd"])
    cells: dict[str, str] = {
        key: _minus(scale.number(values[key]))
        for key in ("truth", "MAP", "mean", "sd")
        if key in values
    }
    cells |= {
        "symbol": html_symbol(parameter),
        "unit": html_unit(parameter, scale.exponent),
        "z": _z(values["z"]) if "z" in values else "",
        "corner": _minus(with_error(values["corner"], values["corner_sd"]).replace("+-", "±")),
    }
    return cells | {key: f"{values[key]:.{digits}f}" for key, digits in DIGITS.items()}


def _statistics(diagnostics: Diagnostics) -> list[_Statistic]:
    d = diagnostics
    return [
        _statistic(
            "Pearson", d.pearson, d.pearson_expected, d.pearson_sd,
            "sum of (counts − model)² / variance over the pixels used",
        ),
        _statistic(
            "Deviance", d.deviance, d.deviance_expected, d.deviance_sd,
            "twice the log-likelihood that a perfect model would gain; expectation exact for any "
            "mean count",
        ),
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


def _statistic(name: str, value: float, expected: float, sd: float, meaning: str) -> _Statistic:
    return _Statistic(
        name,
        f"{value:.1f}",
        f"{expected:.1f}",
        f"{sd:.1f}",
        _z((value - expected) / sd if sd > 0 else math.nan),
        meaning,
    )


def page_figures(
    fitted: FittedFrame,
    chain: Chain,
    *,
    truth: Floats | None = None,
    field: DisplacementField | None = None,
) -> list[PageFigure]:
    """The figures of a run's page.

    Parameters
    ----------
    fitted : FittedFrame
        The frame with the model at the MAP.
    chain : Chain
    truth : ndarray, shape (d,), parameter units, optional
        Values that a simulation used.
    field : DisplacementField, optional
        Of the chain; its figure comes first.

    Returns
    -------
    list of PageFigure
    """
    posterior = chain.posterior()
    u, v, half_width = _star_positions(chain, posterior)
    return [
        *(() if field is None else [_field_figure(field, chain, posterior)]),
        PageFigure(
            "Frame, model and residual",
            "At the MAP. Grey pixels do not enter the likelihood.",
            frame_triptych(fitted),
        ),
        PageFigure(
            "Brightest sources",
            "Labelled with u, v in pixels from the middle. A dipole in a residual is a misplaced "
            "source.",
            star_panels(fitted, u, v, half_width=half_width),
        ),
        PageFigure(
            "Posterior",
            "Contours hold 39 % and 86 % of the draws.",
            corner_plot(
                chain.draws(), posterior.parameters, truth=truth, estimate=chain.estimate.params
            ),
        ),
        PageFigure(
            "Chain",
            "Median and middle 68 % of each ensemble's walkers; histograms of their ranks, flat "
            "at 1 when all ensembles sample one distribution.",
            trace_plot(chain, posterior.parameters),
        ),
    ]


def _field_figure(field: DisplacementField, chain: Chain, posterior: Posterior) -> PageFigure:
    sources = source_table(posterior, chain.estimate.params)
    return PageFigure(
        "Displacement",
        "Above: from the object to its image, with the error that the posterior gives it. What is "
        "hatched lies beyond the sources, where only the terms of the distortion say what happens; "
        "its ellipses are grey, and left out where they are large. Below: by how much the counts "
        "of each source say that its image is off the place where the model has it; arrows that "
        "agree with their neighbours mean a missing term. The longest arrows are left out; a cross "
        "stands for one of more than 3 standard deviations.",
        field_plot(field, sources, posterior.model.detector.binning),
    )


def _star_positions(chain: Chain, posterior: Posterior) -> tuple[Floats, Floats, int]:
    """Images of the sources in recorded pixels from the middle, and a stamp's half-width."""
    model = posterior.model
    params = dict(zip(chain.parameter_names, chain.estimate.params, strict=True))
    theta = chain.estimate.params[: model.distortion.n_terms]
    x = model.sources.x + params.get("offset_x", 0.0)
    y = model.sources.y + params.get("offset_y", 0.0)
    u, v = model.distortion.image_position(theta, x, y)
    binning = model.detector.binning
    half_width = max(4, math.ceil(3.5 * params.get("psf_sigma", model.psf.sigma) / binning))
    return u / binning, v / binning, half_width


def _provenance(chain: Chain, diagnostics: Diagnostics) -> list[tuple[str, str]]:
    n_ensembles, n_steps, n_walkers, d = chain.chain.shape
    return [
        ("chain file", printable(str(chain.path))),
        ("seed", str(chain.seed)),
        ("sampler", f"{n_ensembles} ensembles of {n_walkers} walkers"),
        ("steps", f"{n_steps}, {chain.burn_in} of them burn-in"),
        (
            "draws",
            f"{diagnostics.n_draws} of {d} parameters, acceptance {diagnostics.acceptance:.1%}",
        ),
        ("MAP", f"{chain.estimate.message} ({chain.estimate.n_evaluations} evaluations)"),
        ("pixels used", str(diagnostics.n_pixels)),
        (
            "versions",
            ", ".join(f"{name} {version}" for name, version in sorted(chain.versions.items())),
        ),
    ]


def _data_uri(figure: Figure) -> str:
    return "data:image/png;base64," + base64.b64encode(png(figure, dpi=100)).decode("ascii")


def _minus(number: str) -> str:
    return number.replace("-", "−")


def _z(value: float) -> str:
    return _minus(f"{value:+.2f}") if math.isfinite(value) else ""


def _general(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else "not defined"
