"""The figure of a displacement field: displacements, their errors, and what the sources say.

It is a `matplotlib.figure.Figure` that belongs to no window and no pyplot state. Arrows and
ellipses are enlarged by round factors, which the panels state, beside an arrow of known length.
`bayesfred.analysis.field` and `bayesfred.analysis.sources` have the numbers.
"""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path
from numpy.typing import NDArray

from bayesfred._typing import Floats
from bayesfred.analysis.field import DisplacementField
from bayesfred.io.summary_table import Table
from bayesfred.model.kernels.clusters import DOF
from bayesfred.reporting.style import POSTERIOR_COLOUR, TRUTH_COLOUR

__all__ = ["field_plot"]

# light enough for black arrows
SIZES = LinearSegmentedColormap.from_list("sizes", ["#ffffff", "#9ecae1", "#4292c6"])
EXTRAPOLATED = "0.45"
SIGNIFICANT = 3.0  # standard deviations
# scales of Student's t distribution along two axes that are exceeded as rarely
AS_RARE = math.sqrt(DOF * math.expm1(SIGNIFICANT**2 / DOF))
WIDTH, SIDE = 6.2, 4.4  # inch, of the figure and a panel
BELOW, ABOVE = 0.75, 0.55  # inch, around a panel

Strings = NDArray[np.str_]


def field_plot(
    field: DisplacementField, sources: Table, binning: int = 1, scatter: float = 0.0
) -> Figure:
    """The displacement over the frame with its errors, and how far the sources are off the model.

    Parameters
    ----------
    field : DisplacementField
    sources : Table
        Of `bayesfred.analysis.sources.source_table`, whose lengths are recorded pixels.
    binning : int
        Fine pixels along each side of a recorded pixel.
    scatter : float, fine pixel
        The scale of Student's t distribution by which positions scatter; 0 where they do not.

    Returns
    -------
    Figure
        One panel above the other, both in pixels of the fine grid.
    """
    u, v = field.points.u, field.points.v
    high = SIDE * min(max(float(np.ptp(v) / np.ptp(u)), 0.3), 1.6)
    height = 2.0 * (high + BELOW + ABOVE)
    fig = Figure(figsize=(WIDTH, height), dpi=100)
    above, below = (
        fig.add_axes((0.8 / WIDTH, bottom / height, SIDE / WIDTH, high / height))
        for bottom in (2.0 * BELOW + high + ABOVE, BELOW)
    )
    unit = "px" if binning == 1 else "fine px"
    for ax in (above, below):
        ax.set(
            xlim=(u.min(), u.max()), ylim=(v.min(), v.max()), aspect="equal",
            xlabel=f"u / {unit}", ylabel=f"v / {unit}",
        )  # fmt: skip
    _displacements(fig, above, field, unit)
    _residuals(below, field, sources, (binning, unit), scatter)
    return fig


def _displacements(fig: Figure, ax: Axes, field: DisplacementField, unit: str) -> None:
    """Size of the displacement in colour, arrows, and ellipses of one standard deviation."""
    points, mean = field.points, field.displacement
    length = np.hypot(mean[..., 0], mean[..., 1])
    image = ax.pcolormesh(
        points.u, points.v, np.ma.masked_invalid(length), cmap=SIZES, vmin=0.0,
        shading="gouraud" if np.isfinite(length).all() else "nearest", rasterized=True,
    )  # fmt: skip
    bar = ax.inset_axes((1.04, 0.1, 0.04, 0.8))
    fig.colorbar(image, cax=bar, label=f"displacement / {unit}")
    hatch(ax, points.hull)
    some = (slice(None, None, 2), slice(None, None, 2))
    shown = np.isfinite(length[some])
    at = np.stack([points.u[some][shown], points.v[some][shown]], axis=1)
    spacing = 2.0 * _spacing(field)
    scale = arrows(ax, at, mean[some][shown], 1.2 * spacing, unit)
    values, vectors = np.linalg.eigh(field.covariance[some][shown])
    axes = np.sqrt(np.maximum(values, 0.0))  # along the columns of `vectors`, the larger last
    among = (points.weights[some] > 0.0)[shown]
    enlarged = _round(0.4 * spacing / max(np.max(axes[among], initial=0.0), 1e-12))
    angle = np.degrees(np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1]))
    size = 2.0 * enlarged * axes
    fits = size[:, 1] < 1.5 * spacing
    for which, colour in ((among, TRUTH_COLOUR), (~among & fits, EXTRAPOLATED)):
        ax.add_collection(
            EllipseCollection(
                size[which, 1], size[which, 0], angle[which], units="xy", offsets=at[which],
                offset_transform=ax.transData, facecolors="none", edgecolors=colour, linewidths=1.1,
            )
        )  # fmt: skip
    ax.set_title(
        f"displacement{scale}\nellipses (1 sd) {_times(enlarged)}",
        loc="left", fontsize=11, y=1.0,  # else all labels are measured for it
    )  # fmt: skip


def _residuals(
    ax: Axes, field: DisplacementField, sources: Table, pixel: tuple[int, str], scatter: float
) -> None:
    """By how much the counts say that each source is off the place where the model has it."""
    binning, unit = pixel
    at, off, sd = (
        binning * np.stack([np.asarray(sources[name], dtype=np.float64) for name in names], axis=1)
        for names in (("u", "v"), ("du", "dv"), ("du_sd", "dv_sd"))
    )
    known = np.isfinite(at + off + sd).all(axis=1)
    at, off, sd = at[known], off[known], sd[known]
    ax.plot(at[:, 0], at[:, 1], ".", color="0.3", markersize=3)
    far = np.hypot(*(off / np.hypot(sd, AS_RARE / SIGNIFICANT * scatter)).T) > SIGNIFICANT
    length = np.hypot(*off.T)
    # a faint source's arrow, which is noise, would make those of the others too small to be seen
    short = length <= 3.0 * np.quantile(length, 0.95) if len(at) else np.zeros(0, dtype=bool)
    colours = np.where(far, TRUTH_COLOUR, POSTERIOR_COLOUR)[short]
    scale = arrows(ax, at[short], off[short], 3.0 * _spacing(field), unit, colours)
    by_chance = len(at) * math.exp(-0.5 * SIGNIFICANT**2)  # of normal errors along two axes
    ax.plot(*at[far & ~short].T, "x", color=TRUTH_COLOUR)
    errors = f"{SIGNIFICANT:.0f} sd" + (" and their scatter" if scatter else "")
    ax.set_title(
        f"sources, off the model{scale}\n{far.sum()} of {len(at)} by more than {errors} (orange), "
        f"{by_chance:.0f} by chance",
        loc="left", fontsize=11, y=1.0,  # else all labels are measured for it
    )  # fmt: skip


def arrows(
    ax: Axes, at: Floats, vectors: Floats, longest: float, unit: str, colours: Strings | str = "k"
) -> str:
    """Arrows of which the longest has this length on the axes, and one of known length below.

    Returns how they are enlarged, for the title.
    """
    largest = float(np.max(np.hypot(*vectors.T), initial=0.0))
    if largest == 0.0:
        return ""
    enlarged, key = _round(longest / largest), _round(largest)
    ax.quiver(
        *at.T, *(enlarged * vectors.T), angles="xy", scale_units="xy", scale=1.0, color=colours,
        width=0.004, zorder=3,
    )  # fmt: skip
    left, right = ax.get_xlim()
    below = -0.1 * (right - left) / float(np.ptp(ax.get_ylim()))
    ax.annotate(
        f"{key:,.10g} {unit} ", (right, below), (right - enlarged * key, below),
        xycoords=ax.get_xaxis_transform(), ha="right", va="center", fontsize=11,
        arrowprops={"arrowstyle": "-|>", "facecolor": "k", "shrinkA": 0, "shrinkB": 0},
        annotation_clip=False,
    )  # fmt: skip
    return f": arrows {_times(enlarged)}"


def _times(enlarged: float) -> str:
    if enlarged < 1.0:
        return f"reduced to {enlarged:.10g}"
    return "to scale" if enlarged == 1.0 else f"{enlarged:,.10g} times enlarged"


def hatch(ax: Axes, hull: Floats) -> None:
    """Hatch what the axes show outside the hull of the sources' images."""
    (low_u, high_u), (low_v, high_v) = ax.get_xlim(), ax.get_ylim()
    frame = [(low_u, low_v), (high_u, low_v), (high_u, high_v), (low_u, high_v)]
    rings = [frame, hull[::-1].tolist()] if len(hull) else [frame]
    paths = [Path([*ring, ring[0]], closed=True) for ring in rings]
    patch = PathPatch(
        Path.make_compound_path(*paths), facecolor="none", edgecolor=EXTRAPOLATED, hatch="///",
        linewidth=0.8, alpha=0.5, zorder=2,
    )  # fmt: skip
    ax.add_patch(patch)


def _spacing(field: DisplacementField) -> float:
    """Distance of the grid's points along the frame's longer side, pixel."""
    u, v = field.points.u, field.points.v
    return float(max(u[0, 1] - u[0, 0], v[1, 0] - v[0, 0]))


def _round(value: float) -> float:
    """The largest of 1, 2, 5, 10, ... and their tenths, hundredths ... that is not larger."""
    power = 10.0 ** math.floor(math.log10(value))
    return power * next(step for step in (5.0, 2.0, 1.0) if step * power <= value * (1.0 + 1e-9))
