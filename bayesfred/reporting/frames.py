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
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, FuncNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from bayesfred._typing import Flags, Floats
from bayesfred.model.posterior import Posterior

__all__ = ["FittedFrame", "draw_triptych", "frame_triptych", "star_panels", "triptych_height"]

# Light where there is little: a page in dark mode inverts its figures, see `template.html`.
COUNTS_MAP, RESIDUAL_MAP = "gray_r", "RdBu_r"
MASKED = "#a9d18e"  # a colour that neither map has
RESIDUAL_LIMIT = 5.0
TRIPTYCH_MARGIN, TRIPTYCH_SIDE = 0.7, 5.6
MAX_STARS = 24


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
        return cls(
            posterior.counts,
            posterior.expected_counts(params),
            posterior.sigma(params),
            posterior.mask,
        )

    def recorded(self) -> Floats:
        """The frame, nan where a pixel was masked because it holds no counts."""
        return np.where(self.mask | (self.counts != 0.0), self.counts, np.nan)

    def residual(self) -> Floats:
        """Residual in standard deviations; nan outside the mask."""
        out = np.full(self.counts.shape, np.nan)
        used = self.mask
        out[used] = (self.counts[used] - self.expected[used]) / self.sigma[used]
        return out


def frame_triptych(fitted: FittedFrame) -> Figure:
    """The frame, the model on the same scale, and their difference in standard deviations.

    Parameters
    ----------
    fitted : FittedFrame

    Returns
    -------
    Figure
    """
    fig = Figure(figsize=(19, triptych_height(fitted)), dpi=100, layout="constrained")
    draw_triptych(fig, fig.subplots(1, 3), fitted)
    return fig


def star_panels(fitted: FittedFrame, u: Floats, v: Floats, *, half_width: int) -> Figure:
    """Cut-outs around the brightest sources: counts, model and residual side by side.

    Counts and model of a source share a scale; all residuals share one, so that a misplaced source
    shows as a dipole.

    Parameters
    ----------
    fitted : FittedFrame
    u, v : ndarray, shape (n_sources,), pixel
        Positions from the middle of the frame; at most the 24 brightest that lie in the frame are
        shown.
    half_width : int
        A stamp has 2 half_width + 1 pixels a side.

    Returns
    -------
    Figure
    """
    ny, nx = fitted.counts.shape
    # a source without an image has the position nan, far outside for what follows
    column, row = (
        np.rint(np.nan_to_num(position, nan=-1e9) + (n - 1) / 2).astype(int)
        for position, n in ((u, nx), (v, ny))
    )
    inside = np.flatnonzero((column >= 0) & (column < nx) & (row >= 0) & (row < ny))
    stamp = partial(_stamp, half_width=half_width)
    light = [float(np.nansum(stamp(fitted.expected, column[s], row[s]))) for s in inside]
    shown = inside[np.argsort(light, kind="stable")[::-1][:MAX_STARS]]
    blocks = 1 if shown.size < 3 else 3
    rows = max(-(-shown.size // blocks), 1)
    fig = Figure(figsize=(1.0 + 4.1 * blocks, 0.75 + 1.35 * rows), dpi=100)
    if not shown.size:
        fig.text(0.5, 0.5, "no source lies in the frame", ha="center", va="center")
        return fig
    layers = (fitted.recorded(), fitted.expected, fitted.residual())
    width, height = fig.get_size_inches()
    outer = fig.add_gridspec(
        1,
        blocks,
        left=0.01,
        right=1 - 0.75 / width,
        bottom=0.01,
        top=1 - 0.42 / height,
        wspace=0.06,
    )
    for b in range(blocks):
        grid = outer[b].subgridspec(rows, 3, wspace=0.03, hspace=0.06)
        for r, s in enumerate(shown[b * rows : (b + 1) * rows]):
            data, model, difference = (stamp(layer, column[s], row[s]) for layer in layers)
            norm = _stretch(data, model)
            axes = [fig.add_subplot(grid[r, c]) for c in range(3)]
            _show(axes[0], data, norm, COUNTS_MAP)
            _show(axes[1], model, norm, COUNTS_MAP)
            last = _show(axes[2], difference, _sigma_norm(), RESIDUAL_MAP)
            position = f"{u[s]:+.0f}, {v[s]:+.0f}"
            axes[1].text(
                0.04,
                0.96,
                position,
                transform=axes[1].transAxes,
                va="top",
                color="black",
                fontsize=8.5,
            )
            for ax, title in zip(axes, ("counts", "model", "residual"), strict=True):
                ax.set(xticks=[], yticks=[])
                if r == 0:
                    ax.set_title(title, fontsize=10)
    bar = fig.add_axes((1 - 0.65 / width, 0.04, 0.14 / width, 0.86))
    fig.colorbar(last, cax=bar, label="residual / sigma")
    return fig


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
    return TRIPTYCH_MARGIN + TRIPTYCH_SIDE * min(max(float(ny / nx), 0.25), 2.0)


def draw_triptych(fig: Figure, axes: Sequence[Axes], fitted: FittedFrame) -> None:
    """Show frame, model and residual on three axes; the first two share a colour bar.

    Parameters
    ----------
    fig : Figure
    axes : sequence of Axes, length 3
    fitted : FittedFrame
    """
    ny, nx = fitted.counts.shape
    extent = (-nx / 2, nx / 2, -ny / 2, ny / 2)
    norm = _stretch(fitted.counts[fitted.mask], fitted.expected[fitted.mask])
    _show(axes[0], fitted.recorded(), norm, COUNTS_MAP, extent)
    _show(axes[1], fitted.expected, norm, COUNTS_MAP, extent)
    # inset axes are exactly as high as the image beside them
    bar = fig.colorbar(
        ScalarMappable(norm, COUNTS_MAP),
        cax=axes[1].inset_axes((1.02, 0.0, 0.035, 1.0)),
    )
    bar.set_label("counts per pixel", fontsize=13)
    ticks = _even_ticks(norm)
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    residual = _show(axes[2], fitted.residual(), _sigma_norm(), RESIDUAL_MAP, extent)
    scale = fig.colorbar(residual, cax=axes[2].inset_axes((1.02, 0.0, 0.035, 1.0)))
    scale.set_label("residual / sigma", fontsize=13)
    for ax, title in zip(axes, ("frame", "model", "residual"), strict=True):
        ax.set_title(title, fontsize=15)
        ax.set_xlabel("u / pixel", fontsize=13)
    axes[0].set_ylabel("v / pixel", fontsize=13)
    for ax in (*axes, bar.ax, scale.ax):
        ax.tick_params(labelsize=12)


def _show(
    ax: Axes,
    frame: Floats,
    norm: Normalize,
    colours: str,
    extent: tuple[float, float, float, float] | None = None,
) -> AxesImage:
    """An image, green where it is not finite; unsmoothed, so that noise stays noise."""
    cmap: Colormap = colormaps[colours].with_extremes(bad=MASKED)
    image = np.ma.masked_invalid(frame)
    return ax.imshow(
        image, cmap=cmap, norm=norm, extent=extent, origin="lower", interpolation="nearest"
    )


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
