"""Figures of a frame against its model.

Every function returns a `matplotlib.figure.Figure` that belongs to no window and no pyplot state;
the caller saves it. Frames are shown with u to the right and v upwards, in pixels from the middle
of the frame, as the model counts them. `bayesfred.reporting.html` puts the figures on one page.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import Colormap, FuncNorm, Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from bayesfred._typing import Flags, Floats
from bayesfred.model.posterior import Posterior
from bayesfred.reporting.panels import DPI, SMALL, Box, Panel, Sheet

__all__ = [
    "FittedFrame",
    "background_panels",
    "colour_bar",
    "draw_triptych",
    "frame_panel",
    "residual_panels",
    "star_panels",
    "triptych_height",
]

# Light where there is little: a page in dark mode inverts its figures, see `template.html`.
COUNTS_MAP, RESIDUAL_MAP = "gray_r", "RdBu_r"
MASKED = "#cfe3bf"  # a colour that neither map has
RESIDUAL_LIMIT = 5.0
RESIDUALS = RESIDUAL_MAP, (-RESIDUAL_LIMIT, RESIDUAL_LIMIT)
NUMBERS, LABELS = 12.0, 13.0  # points, around a frame
SIDE = 5.0  # inch of a frame's longer side, and of what stands around it
LEFT, BELOW, ABOVE = 0.85, 0.65, 0.4
MAX_STARS = 24
STAMP = 1.25  # inch


@dataclass(frozen=True, eq=False)
class FittedFrame:
    """A frame and what a model makes of it.

    Attributes
    ----------
    counts, expected, sigma : ndarray, shape (ny, nx), counts per pixel
        Frame, model, and the standard deviation that the noise model gives each pixel.
    mask : ndarray of bool, shape (ny, nx)
        True where a pixel enters the likelihood; the others are green in a residual, and in the
        frame if they are empty.
    """

    counts: Floats
    expected: Floats
    sigma: Floats
    mask: Flags

    @classmethod
    def at(cls, posterior: Posterior, params: Floats) -> "FittedFrame":
        """The frame of a posterior with the model of one parameter vector, shape (d,)."""
        expected = posterior.expected_counts(params)
        level = params[posterior.parameter_names.index("background")]
        variance = posterior.noise_at(params).pixelwise.counts_variance(expected, level)
        return cls(posterior.counts, expected, np.sqrt(variance), posterior.mask)

    def recorded(self) -> Floats:
        """The frame, nan where a pixel was masked because it holds no counts."""
        return np.where(self.mask | (self.counts != 0.0), self.counts, np.nan)

    def residual(self) -> Floats:
        """Residual in standard deviations; nan outside the mask."""
        out = np.full(self.counts.shape, np.nan)
        used = self.mask
        out[used] = (self.counts[used] - self.expected[used]) / self.sigma[used]
        return out


def residual_panels(frames: Sequence[FittedFrame]) -> Figure:
    """Residuals of several models, three in a row, on one scale and numbered from 1.

    Parameters
    ----------
    frames : sequence of FittedFrame

    Returns
    -------
    Figure
    """
    columns = min(len(frames), 3)
    rows = -(-len(frames) // columns)
    high = max(triptych_height(frame) for frame in frames)
    sheet = Sheet((LEFT + SIDE) * columns + 1.1, rows * high)
    for k, fitted in enumerate(frames):
        left = LEFT + (LEFT + SIDE) * (k % columns)
        bottom = BELOW + high * (rows - 1 - k // columns)
        place = left, bottom, high - BELOW - ABOVE
        panel = _show(sheet, place, fitted.residual(), _sigma_norm(), RESIDUAL_MAP)
        panel.label_above(f"run {k + 1}", fontsize=15)
        panel.label_beside("v / pixel", 0.62, fontsize=13)
    box = (sheet.width - 0.95, BELOW, 0.2, sheet.height - 1.1)
    colour_bar(sheet, box, RESIDUALS, "residual / sigma")
    return sheet.finish()


def background_panels(frame: Floats, background: Floats, used: Flags) -> Figure:
    """A frame and the background that was measured in it, on one scale.

    Parameters
    ----------
    frame, background : ndarray, shape (ny, nx), counts per pixel
    used : ndarray of bool, shape (ny, nx)
        Pixels whose background the scale holds.

    Returns
    -------
    Figure
    """
    least, most = np.percentile(background[used], (0.0, 99.9))
    ny, nx = frame.shape
    high = SIDE * min(max(float(ny / nx), 0.25), 2.0)
    sheet = Sheet(2.0 * (LEFT + SIDE) + 1.2, BELOW + high + ABOVE)
    margin = 0.1 * float(most - least)
    span = float(least) - margin, float(most) + margin
    for k, (values, title) in enumerate(((frame, "frame"), (background, "background"))):
        place = LEFT + (LEFT + SIDE) * k, BELOW, high
        panel = _show(sheet, place, values, Normalize(*span, clip=True), COUNTS_MAP)
        panel.label_above(title, fontsize=15)
        if not k:
            panel.label_beside("v / pixel", 0.62, fontsize=13)
    box = (panel.box[0] + panel.box[2] + 0.1, panel.box[1], 0.175, panel.box[3])
    colour_bar(sheet, box, (COUNTS_MAP, span), "counts per pixel")
    return sheet.finish()


def star_panels(fitted: FittedFrame, u: Floats, v: Floats, *, half_width: int) -> Figure:
    """Cut-outs around the brightest sources: counts, model and residual side by side.

    Counts and model of a source share a scale; all residuals share one, so that a misplaced source
    shows as a dipole.

    Parameters
    ----------
    fitted : FittedFrame
    u, v : ndarray, shape (n_sources,), pixel
        Positions from the middle of the frame; at most the 24 that lie in the frame and have the
        most light in pixels of the likelihood are shown.
    half_width : int
        A stamp has 2 half_width + 1 pixels a side.

    Returns
    -------
    Figure
    """
    ny, nx = fitted.counts.shape
    # a source without an image has the position nan, far outside for what follows
    column, row_of = (
        np.rint(np.nan_to_num(position, nan=-1e9) + (n - 1) / 2).astype(int)
        for position, n in ((u, nx), (v, ny))
    )
    inside = np.flatnonzero((column >= 0) & (column < nx) & (row_of >= 0) & (row_of < ny))
    stamp = partial(_stamp, half_width=half_width)
    used = np.where(fitted.mask, fitted.expected, 0.0)
    light = [float(np.nansum(stamp(used, column[s], row_of[s]))) for s in inside]
    shown = inside[np.argsort(light, kind="stable")[::-1][:MAX_STARS]]
    blocks = 1 if shown.size < 3 else 3
    rows = max(-(-shown.size // blocks), 1)
    sheet = Sheet(1.0 + 4.1 * blocks, 0.55 + (STAMP + 0.07) * rows)
    if not shown.size:
        sheet.text(
            0.5 * sheet.width, 0.5 * sheet.height, "no source lies in the frame", ha="center"
        )
        return sheet.finish()
    layers = (fitted.recorded(), fitted.expected, fitted.residual())
    for k, s in enumerate(shown):
        block, row = divmod(k, rows)
        data, model, difference = (stamp(layer, column[s], row_of[s]) for layer in layers)
        norm = _stretch(data, model)
        left, bottom = 0.12 + 4.1 * block, 0.1 + (STAMP + 0.07) * (rows - 1 - row)
        for c, (values, scale, colours) in enumerate(
            ((data, norm, COUNTS_MAP), (model, norm, COUNTS_MAP),
             (difference, _sigma_norm(), RESIDUAL_MAP))
        ):  # fmt: skip
            box = (left + c * (STAMP + 0.05), bottom, STAMP, STAMP)
            sheet.panel(box, (0.0, 1.0), (0.0, 1.0))
            shown_values = scale(np.ma.masked_invalid(values))
            sheet.image(box, _colours(colours)(shown_values, bytes=True))
            if row == 0:
                title = ("counts", "model", "residual")[c]
                sheet.text(
                    box[0] + 0.5 * STAMP, box[1] + STAMP + 0.06, title, ha="center", fontsize=10
                )
        position = f"{round(u[s]):+d}, {round(v[s]):+d}".replace("-", "−")
        sheet.text(left + STAMP + 0.1, bottom + STAMP - 0.06, position, va="top", fontsize=8.5)
    box = (sheet.width - 0.65, 0.1, 0.14, sheet.height - 0.5)
    colour_bar(sheet, box, RESIDUALS, "residual / sigma", sizes=(SMALL, 10.0))
    return sheet.finish()


def triptych_height(fitted: FittedFrame) -> float:
    """Height that three frames side by side need; a strip of a frame gets a band around it.

    Parameters
    ----------
    fitted : FittedFrame

    Returns
    -------
    float, inch
    """
    ny, nx = fitted.counts.shape
    return BELOW + ABOVE + SIDE * min(max(float(ny / nx), 0.25), 2.0)


def draw_triptych(sheet: Sheet, fitted: FittedFrame) -> None:
    """Show frame, model and residual at the top of a sheet; the first two share a colour bar.

    Parameters
    ----------
    sheet : Sheet
        19 inches wide.
    fitted : FittedFrame
    """
    high = triptych_height(fitted) - BELOW - ABOVE
    bottom = sheet.height - high - ABOVE
    norm = _stretch(fitted.counts[fitted.mask], fitted.expected[fitted.mask])
    frame, model, residual = (
        _show(sheet, (left, bottom, high), values, scale, colours)
        for left, values, scale, colours in (
            (LEFT, fitted.recorded(), norm, COUNTS_MAP),
            (6.4, fitted.expected, norm, COUNTS_MAP),
            (13.05, fitted.residual(), _sigma_norm(), RESIDUAL_MAP),
        )
    )
    for panel, title in ((frame, "frame"), (model, "model"), (residual, "residual")):
        panel.label_above(title, fontsize=15)
    frame.label_beside("v / pixel", 0.62, fontsize=13)
    values = _even_ticks(norm)
    ticks = np.asarray(norm(values)), [f"{value:g}" for value in values]
    bars = [(box[0] + box[2] + 0.1, box[1], 0.175, box[3]) for box in (model.box, residual.box)]
    colour_bar(sheet, bars[0], (COUNTS_MAP, (0.0, 1.0)), "counts per pixel", ticks=ticks)
    colour_bar(sheet, bars[1], RESIDUALS, "residual / sigma")


def _show(
    sheet: Sheet, place: tuple[float, float, float], frame: Floats, norm: Normalize, colours: str
) -> Panel:
    """A frame in a panel, green where it is not finite; unsmoothed, so that noise stays noise.

    The place is given by left, bottom and height; it is as wide as `SIDE`.
    """
    panel = frame_panel(sheet, (*place[:2], SIDE, place[2]), frame.shape, NUMBERS)
    _, _, width, height = panel.box
    ny, nx = frame.shape
    some = np.ix_(*(_shown(n, inches) for n, inches in ((ny, height), (nx, width))))
    sheet.image(panel.box, _colours(colours)(norm(np.ma.masked_invalid(frame[some])), bytes=True))
    panel.label_below("u / pixel", 0.33, fontsize=LABELS)
    return panel


def frame_panel(sheet: Sheet, room: Box, shape: tuple[int, ...], size: float) -> Panel:
    """A panel in the middle of some room, as wide and high as a frame, with numbers around it.

    Parameters
    ----------
    sheet : Sheet
    room : tuple of float, inch
        Left, bottom, width and height.
    shape : tuple of int, (ny, nx)
    size : float, point
        Of the numbers.

    Returns
    -------
    Panel
        Its data are pixels from the middle.
    """
    left, bottom, wide, high = room
    ny, nx = shape
    width, height = min(wide, high * nx / ny), min(high, wide * ny / nx)
    box = (left + 0.5 * (wide - width), bottom + 0.5 * (high - height), width, height)
    panel = sheet.panel(box, (-nx / 2, nx / 2), (-ny / 2, ny / 2), size)
    panel.ticks_below()
    panel.ticks_beside()
    return panel


def _shown(number: int, inches: float) -> NDArray[np.int64]:
    """Which of some rows or columns are seen in a figure."""
    most = min(number, max(round(DPI * inches), 1))
    return ((np.arange(most) + 0.5) * number / most).astype(np.int64)


def colour_bar(
    sheet: Sheet,
    box: Box,
    scale: tuple[str, tuple[float, float]],
    label: str,
    *,
    ticks: tuple[Floats, list[str]] | None = None,
    sizes: tuple[float, float] = (NUMBERS, LABELS),
) -> None:
    """A colour bar with its label.

    Parameters
    ----------
    sheet : Sheet
    box : tuple of float, inch
        Left, bottom, width and height.
    scale : tuple of str and (float, float)
        Name of the colours, and the values at their ends.
    label : str
    ticks : tuple of ndarray and list of str, optional
        Values and their labels; round numbers if not given.
    sizes : tuple of float, point
        Of numbers and label.
    """
    colours, span = scale
    sheet.image(box, colormaps[colours](np.linspace(0.0, 1.0, 256)[:, None], bytes=True))
    bar = sheet.panel(box, (0.0, 1.0), span, sizes[0])
    right = bar.ticks_beside(right=True, given=ticks)
    sheet.text(
        right + 0.05, box[1] + 0.5 * box[3], label, rotation=90, va="center", fontsize=sizes[1]
    )


def _colours(name: str) -> Colormap:
    """A map of colours, green where a value is not finite."""
    return colormaps[name].with_extremes(bad=MASKED)


def _sigma_norm() -> Normalize:
    return Normalize(-RESIDUAL_LIMIT, RESIDUAL_LIMIT)


def _stretch(counts: Floats, expected: Floats) -> FuncNorm:
    """Asinh stretch: linear over the noise of the background, logarithmic for bright sources."""
    both = expected[np.isfinite(expected)]
    low = float(np.min(both, initial=np.inf)) if both.size else 0.0
    noise = math.sqrt(max(low, 0.1))
    low = (
        max(low - 2.0 * noise, float(np.nanmin(counts, initial=np.inf)), 0.0) if both.size else 0.0
    )
    peak = float(np.max(both, initial=0.0))
    high = max(peak + 2.0 * math.sqrt(max(peak, 0.0)), low + 4.0 * noise)
    width = max(4.0 * noise, (high - low) / 1000.0)

    def forward(x: Floats) -> Floats:
        return np.asarray(np.arcsinh((x - low) / width))

    def inverse(y: Floats) -> Floats:
        return np.asarray(low + width * np.sinh(y))

    functions: tuple[Callable[[Floats], Floats], Callable[[Floats], Floats]] = (forward, inverse)
    return FuncNorm(functions, vmin=low, vmax=high)


def _even_ticks(norm: FuncNorm) -> list[float]:
    """Round counts at about equal distances along the stretched colour bar."""
    ticks: list[float] = []
    for value in np.asarray(norm.inverse(np.linspace(0.0, 1.0, 7))):
        step = 10.0 ** (math.floor(math.log10(abs(value))) - 1) if value else 1.0
        ticks.append(float(np.round(value / step) * step))
    return sorted(set(ticks))


def _stamp(frame: Floats, column: int, row: int, half_width: int) -> Floats:
    """The square around a pixel; nan beyond the frame."""
    side = 2 * half_width + 1
    out = np.full((side, side), np.nan)
    top, left = row - half_width, column - half_width
    part = frame[max(top, 0) : top + side, max(left, 0) : left + side]
    above, before = max(-top, 0), max(-left, 0)
    out[above : above + part.shape[0], before : before + part.shape[1]] = part
    return out
