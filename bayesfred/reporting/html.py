"""One self-contained HTML page about a run: verdict, tables, figures, provenance.

The page loads nothing from elsewhere and runs no script, so that it can be mailed, archived and
opened years later. Text that comes from a user is escaped by the template engine.
`bayesfred.analysis.diagnostics` supplies the numbers and `bayesfred.reporting.plots` the figures.
"""

import base64
import math
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure

from bayesfred._typing import Floats, PathLike
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.errors import printable
from bayesfred.io.atomic import replace
from bayesfred.model.posterior import Posterior
from bayesfred.reporting import plots
from bayesfred.sampling.chain import Chain

__all__ = ["write_report"]


@dataclass(frozen=True)
class _Row:
    """A parameter as the table prints it: all numbers of the row in one power of ten."""

    symbol: Markup
    unit: Markup
    truth: str
    estimate: str
    mean: str
    sd: str
    z: str
    rhat: str
    ess_bulk: str
    ess_tail: str
    tau: str
    prior: str
    likelihood: str


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
    diagnostics: Diagnostics,
    posterior: Posterior,
    truth: Floats | None = None,
    notes: Sequence[str] = (),
    settings: str | None = None,
) -> Path:
    """Write the report of a run as one HTML file, in one step: a reader sees the old page or the new one.

    Parameters
    ----------
    path : path-like
        Where the page goes; an existing file is replaced.
    title : str
        Heading of the page.
    chain : Chain
    diagnostics : Diagnostics
        What `diagnose` said of `chain`.
    posterior : Posterior
        The posterior that `chain` samples.
    truth : ndarray, shape (d,), parameter units, optional
        Values that a simulation used.
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
        The page cannot be written.
    """
    path = Path(path)
    draws = chain.draws()
    environment = Environment(
        loader=PackageLoader("bayesfred.reporting", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template("template.html").render(
        title=title,
        diagnostics=diagnostics,
        rows=_rows(chain, diagnostics, draws, truth),
        prior_dominated=Markup(", ").join(_symbol(name) for name in diagnostics.prior_dominated),
        has_truth=truth is not None,
        statistics=_statistics(diagnostics),
        figures=_figures(chain, posterior, draws, truth),
        provenance=_provenance(chain, diagnostics),
        notes=notes,
        settings=settings,
    )
    replace(path, page.encode())
    return path


def _rows(
    chain: Chain, diagnostics: Diagnostics, draws: Floats, truth: Floats | None
) -> list[_Row]:
    rows = []
    for k, name in enumerate(chain.parameter_names):
        mean, sd = float(draws[:, k].mean()), float(draws[:, k].std())
        estimate = float(chain.estimate.params[k])
        true = None if truth is None else float(truth[k])
        exponent, decimals = _scale(mean, sd)
        z = "" if true is None else _z(mean - true, sd)
        rows.append(
            _Row(
                _symbol(name),
                _unit(name, exponent),
                _number(true, exponent, decimals),
                _number(estimate, exponent, decimals),
                _number(mean, exponent, decimals),
                _number(sd, exponent, decimals),
                z,
                f"{diagnostics.rhat[name]:.4f}",
                f"{diagnostics.ess_bulk[name]:.0f}",
                f"{diagnostics.ess_tail[name]:.0f}",
                f"{diagnostics.tau[name]:.2f}",
                f"{diagnostics.prior_sensitivity[name]:.3f}",
                f"{diagnostics.likelihood_sensitivity[name]:.3f}",
            )
        )
    return rows


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
        name, f"{value:.1f}", f"{expected:.1f}", f"{sd:.1f}", _z(value - expected, sd), meaning
    )


def _figures(
    chain: Chain, posterior: Posterior, draws: Floats, truth: Floats | None
) -> list[tuple[str, str, str]]:
    """Heading, caption and data URI of each figure."""
    counts, mask = posterior.counts, posterior.mask
    expected = posterior.expected_counts(chain.estimate.params)
    sigma = posterior.sigma(chain.estimate.params)
    u, v, half_width = _star_positions(chain, posterior)
    return [
        (
            "Frame, model and residual",
            "At the MAP. Grey pixels do not enter the likelihood.",
            _data_uri(plots.frame_triptych(counts, expected, sigma, mask)),
        ),
        (
            "Brightest sources",
            "Labelled with u, v in pixels from the middle. A dipole in a residual is a misplaced "
            "source.",
            _data_uri(
                plots.star_panels(counts, expected, sigma, mask, u, v, half_width=half_width)
            ),
        ),
        (
            "Posterior",
            "Contours hold 39 % and 86 % of the draws.",
            _data_uri(
                plots.corner_plot(
                    draws, chain.parameter_names, truth=truth, estimate=chain.estimate.params
                )
            ),
        ),
        (
            "Chain",
            "Median and middle 68 % of each ensemble's walkers; histograms of their ranks, flat "
            "at 1 when "
            "all ensembles draw from one distribution.",
            _data_uri(plots.trace_plot(chain)),
        ),
    ]


def _star_positions(chain: Chain, posterior: Posterior) -> tuple[Floats, Floats, int]:
    """Where the model puts the sources, in recorded pixels from the middle, and a stamp's half-width."""
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
    buffer = BytesIO()
    figure.savefig(buffer, format="png", facecolor="white")
    return "data:image/png;base64," + base64.b64encode(buffer.getvalue()).decode("ascii")


def _scale(value: float, sd: float) -> tuple[int, int]:
    """Power of ten of a row, and the decimals that give its uncertainty two digits."""
    exponent = plots.power_of_ten(np.array([value, sd]))
    if not 0.0 < sd < math.inf:
        return exponent, 6
    digits = math.floor(math.log10(sd) + 1e-12)
    # 0.0996 would round to 0.100: three digits
    if round(sd / 10.0 ** (digits - 1)) == 100:
        digits += 1
    return exponent, max(0, 1 - digits + exponent)


def _number(value: float | None, exponent: int, decimals: int) -> str:
    return "" if value is None else f"{value / 10.0**exponent:.{decimals}f}".replace("-", "−")


def _z(difference: float, sd: float) -> str:
    return f"{difference / sd:+.2f}".replace("-", "−") if sd > 0.0 else ""


def _general(value: float) -> str:
    return f"{value:.5g}" if math.isfinite(value) else "not defined"


def _symbol(name: str) -> Markup:
    """A parameter's name with its powers raised."""
    term = plots.parameter_powers(name)
    if term is None:
        return Markup("{}").format(name.replace("_", " "))
    powers = Markup("").join(
        Markup("{}").format(variable)
        if power == 1
        else Markup("{}<sup>{}</sup>").format(variable, power)
        for variable, power in term[1]
    )
    letter = Markup("<i>{}</i>").format(term[0]) if len(term[0]) == 1 else term[0]
    return Markup("{}<sub>{}</sub>").format(letter, powers)


def _unit(name: str, exponent: int) -> Markup:
    """Power of ten and unit of a row."""
    word, pixels = plots.parameter_unit(name)
    parts = [Markup("10<sup>{}</sup>").format(str(exponent).replace("-", "−"))] if exponent else []
    parts += [Markup("{}").format(word)] if word else []
    if pixels:
        power = Markup("<sup>{}</sup>").format(str(pixels).replace("-", "−")) if pixels != 1 else ""
        parts.append(Markup("px{}").format(power))
    return Markup(" ").join(parts)
