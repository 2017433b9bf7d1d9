"""The figure of a design: the planned frame's error, and the sources and pointings that tell most.

It is a `matplotlib.figure.Figure` that belongs to no window and no pyplot state.
`bayesfred.analysis.design` has the numbers.
"""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from bayesfred._typing import Floats
from bayesfred.analysis.design import Choice, Design
from bayesfred.reporting.style import ESTIMATE_COLOUR, POSTERIOR_COLOUR, TRUTH_COLOUR

__all__ = ["design_plot"]

WIDTH = 11.0  # inch
WIDE = 5.0  # ratio of values from which an axis is logarithmic
MANY = 50  # numbers from which their axis is logarithmic
MOST = 1e4  # ratio of the errors that an axis shows
RANDOM_COLOUR = "0.55"


def design_plot(design: Design) -> Figure:
    """The error over the planned frame, the order of sources, and what more of them would tell.

    Parameters
    ----------
    design : Design

    Returns
    -------
    Figure
        With a row of panels for the pointings if there are any.
    """
    u, v = design.points.u, design.points.v
    height = 0.36 * WIDTH * min(max(float(np.ptp(v) / np.ptp(u)), 0.3), 1.6)
    heights, panels = [height + 0.9, 3.6], "mo\nnn"
    if design.frames is not None:
        heights, panels = [*heights, 4.2], f"{panels}\npf"
    fig = Figure(figsize=(WIDTH, sum(heights)), dpi=100, layout="constrained")
    axes = fig.subplot_mosaic(panels, height_ratios=heights)
    for name in "mo":
        axes[name].set(
            xlim=(u.min(), u.max()), ylim=(v.min(), v.max()), aspect="equal",
            xlabel=f"u / {design.unit}", ylabel=f"v / {design.unit}",
        )  # fmt: skip
    _map(fig, axes["m"], design)
    _order(fig, axes["o"], design)
    _number(axes["n"], design)
    if design.frames is not None:
        _pointings(axes["p"], design, design.frames)
        _frames(axes["f"], design, design.frames)
    return fig


def _map(fig: Figure, ax: Axes, design: Design) -> None:
    """The error over the frame."""
    sd = np.ma.masked_invalid(design.sd)
    low, high = float(sd.min()), float(sd.max())
    logarithmic = high > WIDE * low > 0.0
    norm = LogNorm(low, high) if logarithmic else Normalize(0.0, high)
    image = ax.pcolormesh(
        design.points.u, design.points.v, sd, cmap="viridis", norm=norm,
        shading="gouraud" if np.isfinite(design.sd).all() else "nearest", rasterized=True,
    )  # fmt: skip
    bar = fig.colorbar(image, ax=ax, label=f"error (1 sd) / {design.unit}", shrink=0.8)
    if logarithmic:
        _plain_numbers(bar.ax.yaxis, high / low)
    ax.plot(*design.images.T, ".", color="w", markersize=3, clip_on=True)
    beyond = "extrapolated everywhere"
    if len(design.points.hull):
        ax.plot(*design.points.hull[[*range(len(design.points.hull)), 0]].T, "w--", linewidth=1.0)
        beyond = "extrapolated outside the dashes"
    _title(ax, f"the planned frame: {design.error_rms:.2g} {design.unit} rms\n{beyond}")


def _order(fig: Figure, ax: Axes, design: Design) -> None:
    """Which sources tell most."""
    choice = design.sources
    rank = np.arange(1, len(choice.order) + 1)
    u, v = design.images[choice.order[::-1]].T  # the first on top
    size = float(np.clip(4000.0 / len(rank), 6.0, 60.0))
    dots = ax.scatter(
        u, v, c=rank[::-1], cmap="viridis", s=size, vmin=1, vmax=max(len(rank), 2),
        edgecolors="0.4", linewidths=0.3,
    )  # fmt: skip
    u, v = design.images[choice.chosen].T
    ax.scatter(u, v, s=3.0 * size, facecolors="none", edgecolors=TRUTH_COLOUR, linewidths=1.4)
    fig.colorbar(dots, ax=ax, label="place in the order", shrink=0.8)
    _title(
        ax,
        f"which sources tell most ({design.criterion}-optimal)\n"
        f"rings: the best {len(choice.chosen)} together",
    )


def _number(ax: Axes, design: Design) -> None:
    """The error with 1, 2, ... sources."""
    choice = design.sources
    _curve(ax, design.random_rms, RANDOM_COLOUR, "at random (median), rms")
    _curve(ax, design.random_largest, RANDOM_COLOUR, "at random (median), at worst", "--")
    _curve(ax, choice.rms, POSTERIOR_COLOUR, "in this order, rms")
    _curve(ax, choice.largest, POSTERIOR_COLOUR, "in this order, at worst", "--")
    k = len(choice.chosen)
    ax.plot(k, design.exact_rms, "o", color=TRUTH_COLOUR, label="a target of the best alone, rms")
    ax.plot(
        k, design.exact_largest, "o", mfc="w", color=TRUTH_COLOUR,
        label="a target of the best alone, at worst",
    )  # fmt: skip
    both = np.concatenate([choice.rms, choice.largest, design.random_rms, design.random_largest])
    _finish(ax, design, both, "number of sources")
    _title(ax, "error of the displacement from the pixels of some of the sources")


def _pointings(ax: Axes, design: Design, frames: Choice) -> None:
    """How many frames to take at each pointing."""
    ax.plot(*design.dithers.T, "o", color=RANDOM_COLOUR, mfc="w", markersize=5)
    taken, times = np.unique(frames.chosen, return_counts=True)
    ax.plot(*design.dithers[taken].T, "o", color=TRUTH_COLOUR, markersize=7)
    for (x, y), n in zip(design.dithers[taken], times, strict=True):
        ax.annotate(f"{n}", (x, y), (6, 5), textcoords="offset points", fontsize=11)
    ax.set(
        xlabel=f"displacement of the catalogue along x / {design.unit}",
        ylabel=f"along y / {design.unit}", aspect="equal", adjustable="datalim",
    )  # fmt: skip
    ax.margins(0.2)
    _title(ax, f"pointings to choose from\nnumbers: how many of {len(frames.chosen)} frames")


def _frames(ax: Axes, design: Design, frames: Choice) -> None:
    """The error of the shared field with 1, 2, ... frames."""
    _curve(ax, frames.rms, POSTERIOR_COLOUR, "rms")
    _curve(ax, frames.largest, POSTERIOR_COLOUR, "at worst", "--")
    k = len(frames.chosen)
    ax.plot(k, frames.chosen_rms, "o", color=TRUTH_COLOUR, label="the chosen frames, rms")
    ax.plot(
        k, frames.chosen_largest, "o", mfc="w", color=TRUTH_COLOUR,
        label="the chosen frames, at worst",
    )  # fmt: skip
    _finish(ax, design, np.concatenate([frames.rms, frames.largest]), "number of frames")
    _title(ax, "error of the field that frames share")


def _curve(ax: Axes, values: Floats, colour: str, label: str, style: str = "-") -> None:
    marker = "." if len(values) < 30 else ""
    ax.plot(
        np.arange(1, len(values) + 1), values, style, color=colour, label=label, marker=marker,
        linewidth=1.3,
    )  # fmt: skip


def _finish(ax: Axes, design: Design, values: Floats, label: str) -> None:
    """Scales, labels, the wanted error and a legend."""
    ax.axhline(design.error, color=ESTIMATE_COLOUR, linewidth=1.2, label="the wanted rms error")
    low, high = min(values.min(), design.error), max(values.max(), design.error)
    high = min(high, MOST * low)  # with few sources the prior alone bounds the error
    ax.set(
        yscale="log", ylim=(0.7 * low, 1.5 * high), xlabel=label,
        ylabel=f"error over the field / {design.unit}",
    )  # fmt: skip
    _plain_numbers(ax.yaxis, high / low)
    most = ax.get_xlim()[1]
    if most > MANY:
        ax.set(xscale="log", xlim=(0.9, most))
        ax.xaxis.set_major_formatter("{x:g}")
    else:
        ax.set_xlim(0.5, math.floor(most) + 0.5)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    ax.grid(color="0.9", linewidth=0.6)
    ax.legend(fontsize=9, frameon=False)


def _plain_numbers(axis: Axis, ratio: float) -> None:
    """Label a logarithmic axis with decimal numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if ratio < 300.0 else (1.0,)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _title(ax: Axes, text: str) -> None:
    ax.set_title(text, loc="left", fontsize=11)
