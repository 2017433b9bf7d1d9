"""The figure of the residuals: their distribution, pixel phase, the sources that do not fit.

`bayesfred.analysis.residuals` makes the numbers.
"""

from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.analysis.pixel_phase import PixelPhase, harmonics
from bayesfred.analysis.residuals import BINS, Residuals
from bayesfred.reporting.frames import colour_bar, frame_panel
from bayesfred.reporting.panels import Box, Panel, Sheet
from bayesfred.reporting.style import POSTERIOR_COLOUR, TRUTH_COLOUR

__all__ = ["described_residuals", "residual_panels"]

LIMIT = 5.0  # standard deviations at which colours end
BAND = 0.95
PHASE_BINS = 8
AXES = (("du", POSTERIOR_COLOUR, "o", -0.008), ("dv", TRUTH_COLOUR, "s", 0.008))
SIZE = 10.0  # points, of text


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
    sheet = Sheet(15.0, 4.6)
    boxes = [(0.75 + 4.77 * k, 0.55, 3.67, 3.68) for k in range(3)]
    _draw_pit(sheet, boxes[0], residuals.pit)
    _draw_phase(sheet, boxes[1], residuals.phases)
    _draw_sources(sheet, boxes[2], residuals, shape)
    return sheet.finish()


def _draw_pit(sheet: Sheet, box: Box, pit: Floats | None) -> None:
    """The histogram of the PIT over its expectation, with the band that holds 95 % of the bars."""
    if pit is None or pit.size < BINS:
        panel = sheet.panel(box, (0.0, 1.0), (0.0, 1.0), SIZE)
        _say(panel, "not tested")
    else:
        counts, edges = np.histogram(pit, BINS, (0.0, 1.0))
        bars, expected = counts * BINS / pit.size, pit.size / BINS
        ends = [0.5 - BAND / 2, 0.5 + BAND / 2]
        low, high = stats.binom.ppf(ends, pit.size, 1.0 / BINS) / expected
        far = max(np.abs(bars - 1.0).max(), high - 1.0)
        span = max(1.0 - 1.3 * far, 0.0), 1.0 + 1.6 * far
        panel = sheet.panel(box, (0.0, 1.0), span, SIZE)
        band = {"facecolors": "0.85"}
        panel.band(np.array(panel.x), np.full(2, low), np.full(2, high), **band)
        panel.mark(y=1.0, colors="0.5", linewidths=0.8)
        look = {"colors": POSTERIOR_COLOUR, "linewidths": 1.8}
        panel.line(np.repeat(edges, 2)[1:-1], np.repeat(bars, 2), **look)
        _name(panel, (0.8, 0), f"{BAND:.0%} of the bars of a true model", band)
        _name(panel, (0.8, 1), "this frame", look)
    _around(panel, "PIT of the residual", "pixels / expected", "Distribution")


def _draw_phase(sheet: Sheet, box: Box, phases: tuple[PixelPhase, PixelPhase]) -> None:
    """Weighted means of the displacements in bins of the phase, and the two harmonics."""
    if not any(fit.phase.size for fit in phases):
        panel = sheet.panel(box, (-0.5, 0.5), (0.0, 1.0), SIZE)
        _say(panel, "no source whose place is known")
    else:
        means = [_by_phase(fit) for fit in phases]
        grid = np.linspace(-0.5, 0.5, 201)
        curves = [1e3 * harmonics(grid) @ fit.coefficients for fit in phases if fit.dof]
        values = np.concatenate(
            [ends for _, mean, sd in means for ends in (mean - sd, mean + sd)] + curves
        )
        margin = 0.05 * float(np.ptp(values)) or 1.0
        span = float(values.min()) - margin, float(values.max()) + margin
        panel = sheet.panel(box, (-0.5, 0.5), span, SIZE)
        panel.mark(y=0.0, colors="0.5", linewidths=0.8)
        for k, (fit, (place, mean, sd), (name, colour, mark, offset)) in enumerate(
            zip(phases, means, AXES, strict=True)
        ):
            look = {"colors": colour, "linewidths": 1.5}
            panel.bars(place + offset, mean - sd, mean + sd, cap=0.028, **look)
            x, y = panel.at(place + offset, mean).T
            sheet.axes.plot(x, y, mark, color=colour, markersize=5)
            if fit.dof:
                curve = 1e3 * harmonics(grid) @ fit.coefficients
                panel.line(grid, curve, colors=colour, linewidths=1.2)
            x, y = _name(panel, (2.3, k), f"{name} along its axis", look)
            sheet.axes.plot(x + 0.15, y, mark, color=colour, markersize=5)
    _around(panel, "position within the pixel", "displacement / 0.001 pixel", "Pixel phase")


def _by_phase(fit: PixelPhase) -> tuple[Floats, Floats, Floats]:
    """Bins of the phase that have sources: their middle, mean displacement and sd, 0.001 pixel."""
    bins = np.clip(((fit.phase + 0.5) * PHASE_BINS).astype(int), 0, PHASE_BINS - 1)
    weight = np.bincount(bins, fit.sd**-2.0, PHASE_BINS)
    mean = np.bincount(bins, fit.displacement * fit.sd**-2.0, PHASE_BINS)
    some = weight > 0.0
    place = (np.arange(PHASE_BINS)[some] + 0.5) / PHASE_BINS - 0.5
    return place, 1e3 * mean[some] / weight[some], 1e3 / np.sqrt(weight[some])


def _draw_sources(sheet: Sheet, box: Box, residuals: Residuals, shape: tuple[int, int]) -> None:
    """Every source's chi-square, in standard deviations, with rings around poor fits."""
    panel = frame_panel(sheet, box, shape, SIZE)
    table = residuals.sources
    u, v, z = (np.asarray(table[name]) for name in ("u", "v", "chi2_z"))
    inside = (np.abs(u) <= panel.x[1]) & (np.abs(v) <= panel.y[1])
    some = np.flatnonzero(np.isfinite(z) & inside)
    order = some[np.argsort(np.abs(z[some]), kind="stable")]
    size = 12.0 + 10.0 * np.minimum(np.abs(z[order]), 2.0 * LIMIT)
    x, y = panel.at(u[order], v[order]).T
    sheet.axes.scatter(
        x, y, c=z[order], s=size, cmap="RdBu_r", norm=Normalize(-LIMIT, LIMIT),
        edgecolors="0.25", linewidths=0.5,
    )  # fmt: skip
    failed = np.flatnonzero(np.asarray(table["failed"]) & inside)
    x, y = panel.at(u[failed], v[failed]).T
    sheet.axes.scatter(
        x, y, s=260, facecolors="none", edgecolors="black",
        linewidths=1.3,
    )  # fmt: skip
    left, bottom, width, height = panel.box
    bar = (left + 1.03 * width, bottom + 0.09 * height, 0.15, 0.82 * height)
    scale = "RdBu_r", (-LIMIT, LIMIT)
    colour_bar(sheet, bar, scale, "chi-square: excess / sd", sizes=(SIZE, SIZE))
    # values beyond the scale have the colours of its ends
    for end, way, colour in ((bar[1], -0.15, 0.0), (bar[1] + bar[3], 0.15, 1.0)):
        across = bar[0] + bar[2] * np.array([0.0, 0.5, 1.0])
        tip = np.stack([across, [end, end + way, end]], axis=1)
        sheet.area(tip, facecolors=tuple(colormaps["RdBu_r"](colour)))
        sheet.line(tip, colors="black", linewidths=0.8)
    title = "Sources (ringed: do not fit)" if np.any(table["failed"]) else "Sources"
    _around(panel, "u / pixel", "v / pixel", title, numbered=True)


def _around(panel: Panel, below: str, beside: str, above: str, *, numbered: bool = False) -> None:
    """What stands around a panel, and its numbers unless it has them."""
    if not numbered:
        panel.ticks_below()
        panel.ticks_beside()
    panel.label_below(below, 0.28, fontsize=SIZE)
    panel.label_beside(beside, 0.52, fontsize=SIZE)
    panel.label_above(above, fontsize=12)


def _name(
    panel: Panel, place: tuple[float, int], name: str, look: dict[str, Any]
) -> tuple[float, float]:
    """A line of a panel's legend, this far from its left; returns where it begins."""
    (left, row), (x, y, _, height) = place, panel.box
    x, y = x + left, y + height - 0.15 - 0.17 * row
    panel.sheet.sample(x, y, look)
    panel.sheet.text(x + 0.4, y, name, va="center", fontsize=8)
    return x, y


def _say(panel: Panel, text: str) -> None:
    left, bottom, width, height = panel.box
    at = left + 0.5 * width, bottom + 0.5 * height
    panel.sheet.text(*at, text, ha="center", va="center", color="0.35", fontsize=SIZE)


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
