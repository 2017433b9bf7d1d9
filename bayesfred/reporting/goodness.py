"""The figure of the residuals: their distribution, pixel phase, the sources that do not fit.

`bayesfred.analysis.residuals` makes the numbers.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.analysis.pixel_phase import PixelPhase, harmonics
from bayesfred.analysis.residuals import BINS, Residuals
from bayesfred.reporting.style import POSTERIOR_COLOUR, TRUTH_COLOUR

__all__ = ["described_residuals", "residual_panels"]

LIMIT = 5.0  # standard deviations at which colours end
BAND = 0.95
PHASE_BINS = 8


def residual_panels(residuals: Residuals, shape: tuple[int, int]) -> Figure:
    """Distribution of the residuals, displacement against pixel phase, and a map of the sources.

    Parameters
    ----------
    residuals : Residuals
    shape : tuple of int, (ny, nx)
        Of the frame.

    Returns
    -------
    Figure
    """
    fig = Figure(figsize=(15, 4.6), dpi=100)
    axes = fig.subplots(1, 3)
    fig.subplots_adjust(left=0.05, right=0.93, bottom=0.12, top=0.92, wspace=0.3)
    _draw_pit(axes[0], residuals.pit)
    _draw_phase(axes[1], residuals.phases)
    _draw_sources(fig, axes[2], residuals, shape)
    return fig


def _draw_pit(ax: Axes, pit: Floats | None) -> None:
    """The histogram of the PIT over its expectation, with the band that holds 95 % of the bars."""
    ax.set(
        xlabel="PIT of the residual", ylabel="pixels / expected", title="Distribution", xlim=(0, 1)
    )
    if pit is None or pit.size < BINS:
        return _say(ax, "not tested")
    counts, edges = np.histogram(pit, BINS, (0.0, 1.0))
    expected = pit.size / BINS
    low, high = stats.binom.ppf([0.5 - BAND / 2, 0.5 + BAND / 2], pit.size, 1.0 / BINS) / expected
    ax.axhspan(low, high, color="0.85", label=f"{BAND:.0%} of the bars of a true model")
    ax.axhline(1.0, color="0.5", lw=0.8)
    ax.stairs(
        counts / expected, edges, baseline=None, color=POSTERIOR_COLOUR, lw=1.8, label="this frame"
    )
    far = max(np.abs(counts / expected - 1.0).max(), high - 1.0)
    ax.set_ylim(max(1.0 - 1.3 * far, 0.0), 1.0 + 1.6 * far)
    ax.legend(loc="upper center", fontsize=8, frameon=False)
    return None


def _draw_phase(ax: Axes, phases: tuple[PixelPhase, PixelPhase]) -> None:
    """Weighted means of the displacements in bins of the phase, and the two harmonics."""
    ax.set(
        xlabel="position within the pixel",
        ylabel="displacement / pixel",
        title="Pixel phase",
        xlim=(-0.5, 0.5),
    )
    if not any(phase.phase.size for phase in phases):
        return _say(ax, "no source whose place is known")
    grid = np.linspace(-0.5, 0.5, 201)
    ax.axhline(0.0, color="0.5", lw=0.8)
    marks = (("du", POSTERIOR_COLOUR, "o", -0.008), ("dv", TRUTH_COLOUR, "s", 0.008))
    for fit, (name, colour, mark, offset) in zip(phases, marks, strict=True):
        bins = np.clip(((fit.phase + 0.5) * PHASE_BINS).astype(int), 0, PHASE_BINS - 1)
        weight = np.bincount(bins, fit.sd**-2.0, PHASE_BINS)
        mean = np.bincount(bins, fit.displacement * fit.sd**-2.0, PHASE_BINS)
        some = weight > 0.0
        place = (np.arange(PHASE_BINS)[some] + 0.5) / PHASE_BINS - 0.5 + offset
        ax.errorbar(
            place, mean[some] / weight[some], weight[some] ** -0.5, fmt=mark, ms=5, capsize=2,
            color=colour, label=f"{name} along its axis",
        )  # fmt: skip
        if fit.dof:
            ax.plot(grid, harmonics(grid) @ fit.coefficients, color=colour, lw=1.2)
    ax.legend(fontsize=8, frameon=False)
    return None


def _draw_sources(fig: Figure, ax: Axes, residuals: Residuals, shape: tuple[int, int]) -> None:
    """Every source's chi-square, in standard deviations, with rings around poor fits."""
    ny, nx = shape
    table = residuals.sources
    z = np.asarray(table["chi2_z"])
    some = np.isfinite(z)
    order = np.flatnonzero(some)[np.argsort(np.abs(z[some]), kind="stable")]
    size = 12.0 + 10.0 * np.minimum(np.abs(z[order]), 2.0 * LIMIT)
    points = ax.scatter(
        table["u"][order], table["v"][order], c=z[order], s=size, cmap="RdBu_r",
        norm=Normalize(-LIMIT, LIMIT), edgecolors="0.25", linewidths=0.5,
    )  # fmt: skip
    failed = np.flatnonzero(table["failed"])
    ax.scatter(
        table["u"][failed], table["v"][failed], s=260, facecolors="none", edgecolors="black",
        linewidths=1.3,
    )  # fmt: skip
    bar = ax.inset_axes((1.03, 0.05, 0.04, 0.9))
    fig.colorbar(points, cax=bar, label="chi-square: excess / sd", extend="both")
    ax.set(
        xlim=(-nx / 2, nx / 2), ylim=(-ny / 2, ny / 2), aspect="equal", xlabel="u / pixel",
        ylabel="v / pixel", title="Sources (ringed: do not fit)" if failed.size else "Sources",
    )  # fmt: skip


def _say(ax: Axes, text: str) -> None:
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", color="0.35")


def described_residuals(residuals: Residuals) -> str:
    """Say what is seen in `residual_panels`.

    Parameters
    ----------
    residuals : Residuals

    Returns
    -------
    str
    """
    z = np.asarray(residuals.sources["chi2_z"])
    z = z[np.isfinite(z)]
    checks = {check.name: check for check in residuals.checks}
    pit = checks["PIT"]
    parts = [
        f"Histogram of the residuals' distribution, {_signed(pit.z)} standard deviations from flat."
        if np.isfinite(pit.z)
        else "The residuals' distribution is not tested."
    ]
    for axis in "uv":
        phase = checks[f"pixel phase along {axis}"]
        if np.isfinite(phase.z):
            parts.append(
                f"Along {axis} displacements vary with the position within the pixel by "
                f"{phase.value:.2g} pixel ({_signed(phase.z)} standard deviations)."
            )
    failed = int(np.sum(residuals.sources["failed"]))
    parts.append(f"Of {z.size} sources {failed} do not fit.")
    return " ".join(parts)


def _signed(value: float) -> str:
    return f"{value:+.1f}".replace("-", "−")
