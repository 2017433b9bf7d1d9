"""Figures of a run: the posterior, the chain behind it, and the frame against its model.

Every function returns a `matplotlib.figure.Figure` that belongs to no window and no pyplot state;
the caller saves it. Parameters are shown multiplied by a power of ten that their label states,
because a distortion coefficient is a few millionths. Frames are drawn with u to the right and v
upwards, in pixels from the middle of the frame, as the model counts them.
`bayesfred.reporting.html` puts the figures on one page.
"""

import io
import math
import re
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import corner
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, FuncNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.ecdf_bands import band, ecdf, points
from bayesfred.analysis.noise_study import VARIABLES, NoiseStudy
from bayesfred.analysis.sbc import PosteriorCalibration
from bayesfred.analysis.study_helpers import LEVELS
from bayesfred.sampling.chain import Chain

__all__ = [
    "calibration_plot",
    "corner_plot",
    "frame_triptych",
    "noise_plot",
    "overview",
    "parameter_powers",
    "parameter_unit",
    "png",
    "power_of_ten",
    "star_panels",
    "trace_plot",
]

ENSEMBLE_COLOURS = (
    "#0072b2",
    "#d55e00",
    "#009e73",
    "#cc79a7",
    "#e69f00",
    "#56b4e9",
    "#7f7f7f",
    "#000000",
)
TRUTH_COLOUR = "#d55e00"
ESTIMATE_COLOUR = "#009e73"
POSTERIOR_COLOUR = "#0072b2"
MASKED = "0.72"
RESIDUAL_LIMIT = 5.0
TRIPTYCH_MARGIN, TRIPTYCH_SIDE = 0.7, 5.6
MAX_STARS = 24
MAX_CORNER_DRAWS = 20_000
MAX_TRACE_STEPS = 1_000
VARIABLE_LABELS = {
    "background": "background / counts per pixel",
    "flux": "mean flux / counts",
    "sources": "number of sources",
    "psf_sigma": "PSF sigma / pixel",
    "exposure": "exposure / the model's",
}


def parameter_powers(name: str) -> tuple[str, tuple[tuple[str, int], ...]] | None:
    """Split a polynomial term's name into its letter and its variables' powers; None for any other parameter.

    Examples
    --------
    >>> parameter_powers("f_u2x")
    ('f', (('u', 2), ('x', 1)))
    >>> parameter_powers("background_uv")
    ('background', (('u', 1), ('v', 1)))
    >>> parameter_powers("flux_scale") is None
    True
    """
    match = re.fullmatch(r"(f|g|background)_((?:[uvxy]\d*)+)", name)
    if match is None:
        return None
    factors = re.findall(r"([uvxy])(\d*)", match[2])
    return match[1], tuple((variable, int(power or 1)) for variable, power in factors)


def parameter_unit(name: str) -> tuple[str, int]:
    """Unit of a parameter: its leading word, and the power of a pixel that multiplies it.

    Examples
    --------
    >>> parameter_unit("f_ux2"), parameter_unit("background_u"), parameter_unit("offset_x")
    (('', -2), ('counts', 0), ('', 1))
    """
    term = parameter_powers(name)
    if term is not None:
        # the background's u and v run from -1 to 1 over the frame
        return (
            ("counts", 0)
            if term[0] == "background"
            else ("", 1 - sum(power for _, power in term[1]))
        )
    return {"background": ("counts", 0), "flux_scale": ("", 0)}.get(name, ("", 1))


def power_of_ten(values: Floats) -> int:
    """Exponent k for which values / 10^k print well; 0 where they do so unscaled.

    Examples
    --------
    >>> power_of_ten(np.array([-2e-6, 1e-8])), power_of_ten(np.array([5.0]))
    (-6, 0)
    """
    largest = float(np.max(np.abs(values), initial=0.0))
    if not 0.0 < largest < math.inf:
        return 0
    exponent = math.floor(math.log10(largest))
    return 0 if -2 <= exponent <= 3 else exponent


def corner_plot(
    draws: Floats,
    names: Sequence[str],
    *,
    truth: Floats | None = None,
    estimate: Floats | None = None,
) -> Figure:
    """Marginal posteriors of all parameters and pairs, with contours that hold 39 and 86 % of the draws.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units
    names : sequence of str, length d
    truth, estimate : ndarray, shape (d,), parameter units, optional
        Values to mark: those a simulation used, and the MAP.

    Returns
    -------
    Figure
    """
    d = len(names)
    draws = draws[:: -(-len(draws) // MAX_CORNER_DRAWS)] if len(draws) else np.zeros((1, d))
    ranges = [_span(draws[:, k], None if truth is None else truth[k]) for k in range(d)]
    scale = 10.0 ** np.array([power_of_ten(np.array(span)) for span in ranges])
    labels = [
        _label(name, round(math.log10(s)), "\n") for name, s in zip(names, scale, strict=True)
    ]
    side = 1.6 + 1.0 * d
    fig = Figure(figsize=(side, side), dpi=100)
    fig.subplots(d, d, squeeze=False)
    small = d > 6
    corner.corner(
        draws / scale,
        fig=fig,
        range=[(low / s, high / s) for (low, high), s in zip(ranges, scale, strict=True)],
        labels=labels,
        label_kwargs={"fontsize": 10},
        labelpad=0.2 if small else 0.12,
        bins=24,
        smooth=0.9,
        color=POSTERIOR_COLOUR,
        max_n_ticks=3,
        plot_datapoints=False,
        plot_density=False,
        fill_contours=True,
        levels=(1 - math.exp(-0.5), 1 - math.exp(-2)),
        contour_kwargs={"linewidths": 0.7},
        hist_kwargs={"linewidth": 1.0},
    )
    marked: list[tuple[str, str, Any]] = []
    for values, colour, style, label in (
        (truth, TRUTH_COLOUR, "-", "truth"),
        (estimate, ESTIMATE_COLOUR, "--", "MAP"),
    ):
        if values is not None:
            corner.overplot_lines(fig, values / scale, color=colour, linestyle=style, linewidth=0.9)
            marked.append((label, colour, style))
    for ax in fig.axes:
        ax.tick_params(labelsize=7.5 if small else 8.5, length=2, pad=1.5)
        for axis in (ax.xaxis, ax.yaxis):
            formatter = axis.get_major_formatter()
            if isinstance(formatter, ScalarFormatter):
                formatter.set_useOffset(False)
            if len(axis.get_ticklocs()):
                # a tick at the very edge would run into the neighbouring panel
                low, high = axis.get_view_interval()
                edge = 0.06 * (high - low)
                ticks = np.asarray(MaxNLocator(3).tick_values(low, high))
                axis.set_ticks(ticks[(ticks > low + edge) & (ticks < high - edge)])
    margin = 0.75 / side
    fig.subplots_adjust(
        left=1.3 * margin, bottom=1.3 * margin, right=1 - 0.2 / side, top=1 - 0.2 / side
    )
    if marked:
        handles = [Line2D([], [], color=colour, linestyle=style) for _, colour, style in marked]
        fig.legend(
            handles,
            [label for label, _, _ in marked],
            loc="upper right",
            fontsize=10 if small else 8,
            frameon=False,
        )
    return fig


def trace_plot(chain: Chain) -> Figure:
    """Every parameter's ensembles over the steps, and the ranks of each ensemble's draws.

    A band holds the middle 68 % of an ensemble's walkers, a line is their median, the burn-in is
    shaded. The rank histogram beside it is flat at 1 for every ensemble when all draw from one
    distribution.

    Parameters
    ----------
    chain : Chain

    Returns
    -------
    Figure
    """
    values = chain.chain
    n_ensembles, n_steps, _, d = values.shape
    rows = -(-d // 2)
    fig = Figure(figsize=(13, 0.9 + 1.25 * rows), dpi=100)
    # the third column keeps a distance
    axes = fig.subplots(rows, 5, squeeze=False, width_ratios=(4, 1, 0.8, 4, 1))
    height = fig.get_figheight()
    fig.subplots_adjust(
        left=0.08, right=0.99, bottom=0.5 / height, top=1 - 0.4 / height, wspace=0.1, hspace=0.2
    )
    steps = np.unique(np.linspace(0, n_steps - 1, min(n_steps, MAX_TRACE_STEPS)).astype(int))
    for k, name in enumerate(chain.parameter_names):
        # down the first pair of columns, then down the second, as the table of parameters runs
        trace, ranks = axes[k % rows, 3 * (k // rows) : 3 * (k // rows) + 2]
        bands = np.quantile(values[..., k][:, steps], (0.16, 0.5, 0.84), axis=2)
        exponent = power_of_ten(bands)
        for e in range(n_ensembles):
            colour = ENSEMBLE_COLOURS[e % len(ENSEMBLE_COLOURS)]
            low, middle, high = bands[:, e] / 10.0**exponent
            trace.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
            trace.plot(steps, middle, color=colour, linewidth=0.9, label=f"ensemble {e}")
        if chain.burn_in:
            trace.axvspan(0, chain.burn_in, color="0.5", alpha=0.25, linewidth=0, label="burn-in")
        trace.set_xlim(0, max(n_steps - 1, 1))
        trace.ticklabel_format(axis="y", useOffset=False)
        trace.yaxis.set_major_locator(MaxNLocator(3))
        trace.set_ylabel(_label(name, exponent, "\n"), fontsize=8.5)
        trace.yaxis.set_label_coords(-0.12, 0.5)
        trace.tick_params(labelsize=7)
        _rank_histogram(ranks, values[:, chain.burn_in :, :, k])
        last = k % rows == rows - 1 or k == d - 1
        for ax, text in ((trace, "step"), (ranks, "rank")):
            ax.tick_params(labelbottom=last)
            ax.set_xlabel(text if last else "", fontsize=8)
    for ax in [*axes[:, 2], *axes[d - rows :, 3:].flat]:
        ax.set_visible(False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="upper center", ncols=len(labels), fontsize=8, frameon=False)
    return fig


def frame_triptych(counts: Floats, expected: Floats, sigma: Floats, mask: Flags) -> Figure:
    """The frame, the model on the same scale, and their difference in standard deviations.

    Parameters
    ----------
    counts, expected, sigma : ndarray, shape (ny, nx), counts per pixel
        Frame, model, and the standard deviation that the noise model gives each pixel.
    mask : ndarray of bool, shape (ny, nx)
        True where a pixel enters the likelihood; the others are grey in the residual, and in the
        frame if they are empty.

    Returns
    -------
    Figure
    """
    fig = Figure(figsize=(19, _triptych_height(counts)), dpi=100, layout="constrained")
    _draw_triptych(fig, fig.subplots(1, 3), counts, expected, sigma, mask)
    return fig


def star_panels(
    counts: Floats,
    expected: Floats,
    sigma: Floats,
    mask: Flags,
    u: Floats,
    v: Floats,
    *,
    half_width: int,
) -> Figure:
    """Cut-outs around the brightest sources: counts, model and residual side by side.

    Counts and model of a source share a scale; all residuals share one, so that a misplaced source
    shows as a dipole.

    Parameters
    ----------
    counts, expected, sigma : ndarray, shape (ny, nx), counts per pixel
        Frame, model, and the standard deviation that the noise model gives each pixel.
    mask : ndarray of bool, shape (ny, nx)
        True where a pixel enters the likelihood; the others are grey in counts and residual.
    u, v : ndarray, shape (n_sources,), pixel
        Positions from the middle of the frame; at most the 24 brightest that lie in the frame are
        shown.
    half_width : int
        A stamp has 2 half_width + 1 pixels a side.

    Returns
    -------
    Figure
    """
    ny, nx = counts.shape
    # a source without an image has the position nan, far outside for what follows
    column, row = (
        np.rint(np.nan_to_num(place, nan=-1e9) + (n - 1) / 2).astype(int)
        for place, n in ((u, nx), (v, ny))
    )
    inside = np.flatnonzero((column >= 0) & (column < nx) & (row >= 0) & (row < ny))
    stamp = partial(_stamp, half_width=half_width)
    light = [float(np.nansum(stamp(expected, column[s], row[s]))) for s in inside]
    shown = inside[np.argsort(light, kind="stable")[::-1][:MAX_STARS]]
    blocks = 1 if shown.size < 3 else 3
    rows = max(-(-shown.size // blocks), 1)
    fig = Figure(figsize=(1.0 + 4.1 * blocks, 0.75 + 1.35 * rows), dpi=100)
    if not shown.size:
        fig.text(0.5, 0.5, "no source lies in the frame", ha="center", va="center")
        return fig
    used, residual = _recorded(counts, mask), _residual(counts, expected, sigma, mask)
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
            data, model, difference = (
                stamp(frame, column[s], row[s]) for frame in (used, expected, residual)
            )
            norm = _stretch(data, model)
            axes = [fig.add_subplot(grid[r, c]) for c in range(3)]
            _show(axes[0], data, norm, "viridis")
            _show(axes[1], model, norm, "viridis")
            last = _show(axes[2], difference, _sigma_norm(), "RdBu_r")
            place = f"{u[s]:+.0f}, {v[s]:+.0f}"
            axes[1].text(
                0.04, 0.96, place, transform=axes[1].transAxes, va="top", color="white", fontsize=7
            )
            for ax, title in zip(axes, ("counts", "model", "residual"), strict=True):
                ax.set(xticks=[], yticks=[])
                if r == 0:
                    ax.set_title(title, fontsize=8.5)
    bar = fig.add_axes((1 - 0.65 / width, 0.04, 0.14 / width, 0.86))
    fig.colorbar(last, cax=bar, label="residual / sigma")
    return fig


def _triptych_height(counts: Floats) -> float:
    """Inches that three frames side by side need; a strip of a frame gets a band around it."""
    ny, nx = counts.shape
    return TRIPTYCH_MARGIN + TRIPTYCH_SIDE * min(max(float(ny / nx), 0.25), 2.0)


def overview(
    counts: Floats,
    expected: Floats,
    sigma: Floats,
    mask: Flags,
    draws: Floats,
    names: Sequence[str],
    *,
    truth: Floats | None = None,
) -> Figure:
    """The picture that lies beside a chain: the frame against its model, and every parameter's posterior.

    Parameters
    ----------
    counts, expected, sigma : ndarray, shape (ny, nx), counts per pixel
        Frame, model, and the standard deviation that the noise model gives each pixel.
    mask : ndarray of bool, shape (ny, nx)
        True where a pixel enters the likelihood.
    draws : ndarray, shape (n, d), parameter units
    names : sequence of str, length d
    truth : ndarray, shape (d,), parameter units, optional
        With it posteriors are shown as (draws - truth) / sd; without, the distortion's terms as
        draws / sd, on an axis that is linear within +-3 and logarithmic beyond.

    Returns
    -------
    Figure
    """
    mean, sd = draws.mean(axis=0), draws.std(axis=0)
    sd = np.where(sd > 0.0, sd, 1.0)
    kept = [k for k, name in enumerate(names) if truth is not None or name.startswith(("f_", "g_"))]
    z = (mean if truth is None else mean - truth)[kept] / sd[kept]
    heights = (_triptych_height(counts), 3.4)
    fig = Figure(figsize=(19, sum(heights)), dpi=100, layout="constrained")
    parts: Any = fig.subfigures(
        2, 1, height_ratios=heights
    )  # an array, whatever the stubs of the version say
    upper, lower = parts
    _draw_triptych(fig, upper.subplots(1, 3), counts, expected, sigma, mask)
    ax = lower.subplots()
    place = np.arange(len(kept))
    for reach in (1.0, 2.0):
        ax.axhspan(-reach, reach, color="0.4", alpha=0.11, linewidth=0)
    ax.axhline(0.0, color="0.3", linewidth=0.8)
    ax.errorbar(place, z, yerr=1.0, fmt="o", color=POSTERIOR_COLOUR, capsize=4, markersize=6)
    if truth is None:
        ax.set_yscale("symlog", linthresh=3.0)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.margins(y=0.12)
        ax.set_ylabel("posterior mean / sd")
    else:
        reach = max(3.5, float(np.max(np.abs(z), initial=0.0)) + 1.5)
        ax.set_ylim(-reach, reach)
        ax.set_ylabel("(posterior mean - truth) / sd")
    ax.set_xlim(-0.7, len(kept) - 0.3)
    ticks = [f"{_symbol(names[k])}\n{_plain(mean[k], sd[k])}" for k in kept]
    ax.set_xticks(
        place, ticks, fontsize=9 if len(kept) <= 16 else 7, rotation=0 if len(kept) <= 16 else 60
    )
    return fig


def noise_plot(study: NoiseStudy) -> Figure:
    """Every parameter's width over the noise level with the bound, the efficiency, and how many intervals hold the truth.

    Parameters
    ----------
    study : NoiseStudy
        Its first variable of several values is the abscissa; combinations of the others are series.

    Returns
    -------
    Figure
    """
    cells = study.cells
    varied = [name for name in VARIABLES if len(set(cells[name])) > 1] or [VARIABLES[0]]
    abscissa, others = varied[0], varied[1:]
    of = np.array(
        [
            ", ".join(f"{name.replace('_', ' ')} {cells[name][k]:g}" for name in others)
            for k in range(len(cells["failed"]))
        ]
    )
    series = list(dict.fromkeys(of.tolist()))
    names = study.parameter_names
    rows = -(-len(names) // 4)
    columns = max(-(-len(names) // rows), 2)
    heights = (0.6 + 2.6 * rows, 3.6)
    fig = Figure(figsize=(3.6 * max(columns, 3), sum(heights)), dpi=100, layout="constrained")
    parts: Any = fig.subfigures(2, 1, height_ratios=heights)
    upper, lower = parts
    widths = upper.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    efficiency, coverage = lower.subplots(1, 2)
    for s, label in enumerate(series):
        colour = ENSEMBLE_COLOURS[s % len(ENSEMBLE_COLOURS)]
        aside = 1.0 + 0.05 * (
            s - 0.5 * (len(series) - 1)
        )  # so that points of a noise level do not hide each other
        for ax, name in zip(widths, names, strict=False):
            mine = np.flatnonzero((cells["parameter"] == name) & (of == label))
            x, width, bound, scatter = (
                cells[key][mine] for key in (abscissa, "width", "bound", "scatter")
            )
            order = np.argsort(x)
            error = scatter / np.sqrt(2.0 * np.maximum(cells["frames"][mine] - 1, 1))
            ax.plot(x[order], bound[order], color=colour, linewidth=1.0)
            ax.errorbar(
                x * 1.04,
                scatter,
                error,
                fmt="s",
                mfc="white",
                color=colour,
                markersize=4.5,
                linewidth=1.0,
            )
            ax.plot(x / 1.04, width, "o", color=colour, markersize=4.5)
        mine = np.flatnonzero((cells["parameter"] == "theta") & (of == label))
        x = cells[abscissa][mine] * aside
        efficiency.errorbar(
            x,
            cells["efficiency"][mine],
            cells["efficiency_error"][mine],
            fmt="o",
            color=colour,
            capsize=3,
        )
        for level, mark in zip(LEVELS, "os", strict=True):
            key = f"coverage_{100 * level:.0f}"
            coverage.errorbar(
                x, cells[key][mine], cells[f"{key}_error"][mine], fmt=mark, color=colour, capsize=3
            )
    every = cells[abscissa]
    for ax in (*widths[: len(names)], efficiency, coverage):
        ax.set_xscale("log" if every.max() > 3.0 * every.min() else "linear")
        ax.tick_params(labelsize=8)
    for k, ax in enumerate(widths):
        ax.set_visible(k < len(names))
        if k < len(names):
            ax.set_yscale("log")
            ax.set_title("sd of " + _label(names[k], 0), fontsize=9.5)
            ax.tick_params(which="both", labelbottom=k + columns >= len(names), labelsize=8)
        if k < len(names) <= k + columns:
            ax.set_xlabel(VARIABLE_LABELS[abscissa], fontsize=8.5)
    handles = [
        Line2D([], [], color="0.3", linewidth=1.0, label="Cramér–Rao bound"),
        Line2D([], [], color="0.3", linestyle="", marker="o", markersize=4.5, label="posterior sd"),
        Line2D(
            [],
            [],
            color="0.3",
            linestyle="",
            marker="s",
            markersize=4.5,
            mfc="white",
            label="scatter of the estimates",
        ),
        *(
            Line2D(
                [],
                [],
                linewidth=3.0,
                color=ENSEMBLE_COLOURS[s % len(ENSEMBLE_COLOURS)],
                label=label,
            )
            for s, label in enumerate(series)
        ),
    ][: 3 + (len(series) if others else 0)]
    upper.legend(
        handles=handles,
        loc="outside upper center",
        ncols=min(len(handles), 6),
        frameon=False,
        fontsize=9,
    )
    efficiency.axhline(1.0, color="0.3", linewidth=0.8)
    efficiency.set(
        xlabel=VARIABLE_LABELS[abscissa],
        ylabel="bound / variance of the estimates",
        title="efficiency, all coefficients",
    )
    for level in LEVELS:
        coverage.axhline(level, color="0.3", linewidth=0.8)
    coverage.set(
        xlabel=VARIABLE_LABELS[abscissa],
        ylabel="share of intervals that hold the truth",
        title="coverage, all coefficients",
    )
    low = min(
        0.5,
        float(np.nanmin(cells["coverage_68"][cells["parameter"] == "theta"], initial=0.5)) - 0.05,
    )
    coverage.set_ylim(low, 1.02)
    coverage.set_yticks([*LEVELS, 1.0], [f"{level:.0%}" for level in (*LEVELS, 1.0)])
    return fig


def calibration_plot(calibration: PosteriorCalibration) -> Figure:
    """Every quantity's ranks: their distribution less the uniform one with its 95 % band, coverage, and mean pulls.

    Parameters
    ----------
    calibration : PosteriorCalibration

    Returns
    -------
    Figure
    """
    n, names, found = calibration.n, list(calibration.pit), calibration.quantities
    if not names:
        fig = Figure(figsize=(8, 2), dpi=100)
        fig.text(0.5, 0.5, "no frame has a posterior", ha="center", va="center")
        return fig
    columns = 4
    rows = -(-len(names) // columns)
    heights = (0.4 + 2.2 * rows, 3.9)
    fig = Figure(figsize=(14, sum(heights)), dpi=100, layout="constrained")
    parts: Any = fig.subfigures(2, 1, height_ratios=heights)
    upper, lower = parts
    z, (low, high) = points(n), band(n)
    panels = upper.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for k, ax in enumerate(panels):
        ax.set_visible(k < len(names))
        if k < len(names):
            off = ecdf(calibration.pit[names[k]])
            left = np.any((off < low - 1e-9) | (off > high + 1e-9))
            ax.fill_between(z, low - z, high - z, color="0.4", alpha=0.2, linewidth=0)
            ax.step(
                z,
                off - z,
                where="post",
                color=TRUTH_COLOUR if left else POSTERIOR_COLOUR,
                linewidth=1.1,
            )
            ax.axhline(0.0, color="0.3", linewidth=0.6)
            ax.set_title(f"{_quantity(names[k])}   p = {found['uniformity'][k]:.2g}", fontsize=9.5)
            ax.tick_params(labelsize=8, labelbottom=k + columns >= len(names))
            ax.set_xlim(0, 1)
            if k % columns == 0:
                ax.set_ylabel("ECDF - z", fontsize=8.5)
            if k + columns >= len(names):
                ax.set_xlabel("z: rank of the truth", fontsize=8.5)
    upper.suptitle(f"{n} frames; band: 95 % of uniform ranks stay inside all along", fontsize=10)
    coverage, pull = lower.subplots(1, 2)
    place = np.arange(len(names))
    for level, mark in zip(LEVELS, "os", strict=True):
        key = f"coverage_{100 * level:.0f}"
        coverage.axhline(level, color="0.3", linewidth=0.8)
        coverage.errorbar(
            place,
            found[key],
            yerr=found[f"{key}_error"],
            fmt=mark,
            color=POSTERIOR_COLOUR,
            capsize=3,
            markersize=4.5,
        )
    coverage.set(
        title="share of intervals that hold the truth",
        ylim=(min(0.5, float(found["coverage_68"].min()) - 0.05), 1.02),
    )
    coverage.set_yticks([*LEVELS, 1.0], [f"{level:.0%}" for level in (*LEVELS, 1.0)])
    error = 1.0 / math.sqrt(n)
    pull.axhspan(-3.0 * error, 3.0 * error, color="0.4", alpha=0.15, linewidth=0)
    pull.axhline(0.0, color="0.3", linewidth=0.8)
    pull.errorbar(
        place, found["pull"], yerr=error, fmt="o", color=POSTERIOR_COLOUR, capsize=3, markersize=4.5
    )
    reach = max(4.5 * error, 1.15 * float(np.abs(found["pull"]).max()) + error)
    pull.set(
        title="mean of (posterior mean - truth) / sd; band: 3 standard errors", ylim=(-reach, reach)
    )
    for ax in (coverage, pull):
        ax.set_xticks(
            place,
            [_quantity(name) for name in names],
            rotation=60,
            ha="right",
            rotation_mode="anchor",
            fontsize=8,
        )
    return fig


def png(figure: Figure) -> bytes:
    """A figure as a PNG file's content, 150 dots an inch."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=150)
    return buffer.getvalue()


def _quantity(name: str) -> str:
    """What a calibration ranks: a parameter, the log-likelihood, or f or g at a point of the field."""
    return re.sub(r"^([fg])\((.*)\)$", r"$\1$(\2) px", name) if "(" in name else _symbol(name)


def _draw_triptych(
    fig: Figure, axes: Sequence[Axes], counts: Floats, expected: Floats, sigma: Floats, mask: Flags
) -> None:
    """Frame, model and residual on three axes; the first two share a colour bar."""
    ny, nx = counts.shape
    extent = (-nx / 2, nx / 2, -ny / 2, ny / 2)
    norm = _stretch(counts[mask], expected[mask])
    _show(axes[0], _recorded(counts, mask), norm, "viridis", extent)
    _show(axes[1], expected, norm, "viridis", extent)
    # inset axes are exactly as high as the image beside them
    bar = fig.colorbar(
        ScalarMappable(norm, "viridis"),
        cax=axes[1].inset_axes((1.02, 0.0, 0.035, 1.0)),
        label="counts per pixel",
    )
    ticks = _even_ticks(norm)
    bar.set_ticks(ticks, labels=[f"{tick:g}" for tick in ticks])
    bar.minorticks_off()
    residual = _show(
        axes[2], _residual(counts, expected, sigma, mask), _sigma_norm(), "RdBu_r", extent
    )
    fig.colorbar(
        residual, cax=axes[2].inset_axes((1.02, 0.0, 0.035, 1.0)), label="residual / sigma"
    )
    for ax, title in zip(axes, ("frame", "model", "residual"), strict=True):
        ax.set(title=title, xlabel="u / pixel")
    axes[0].set_ylabel("v / pixel")


def _show(
    ax: Axes,
    frame: Floats,
    norm: Normalize,
    colours: str,
    extent: tuple[float, float, float, float] | None = None,
) -> AxesImage:
    """An image whose pixels that are not finite are grey; unsmoothed, so that noise stays noise."""
    cmap: Colormap = colormaps[colours].with_extremes(bad=MASKED)
    image = np.ma.masked_invalid(frame)
    return ax.imshow(
        image, cmap=cmap, norm=norm, extent=extent, origin="lower", interpolation="nearest"
    )


def _recorded(counts: Floats, mask: Flags) -> Floats:
    """The frame, nan where a pixel was masked because it holds no counts."""
    return np.where(mask | (counts != 0.0), counts, np.nan)


def _residual(counts: Floats, expected: Floats, sigma: Floats, mask: Flags) -> Floats:
    """Residual in standard deviations; nan outside the mask."""
    out = np.full(counts.shape, np.nan)
    out[mask] = (counts[mask] - expected[mask]) / sigma[mask]
    return out


def _sigma_norm() -> Normalize:
    return Normalize(-RESIDUAL_LIMIT, RESIDUAL_LIMIT)


def _stretch(counts: Floats, expected: Floats) -> FuncNorm:
    """Asinh stretch above the background: linear over its noise, logarithmic towards the brightest source."""
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


def _rank_histogram(ax: Axes, draws: Floats) -> None:
    """Histogram of each ensemble's ranks among all draws, relative to a flat one.

    `draws` has the shape (n_ensembles, n_steps, n_walkers).
    """
    ranks = np.argsort(np.argsort(draws, axis=None, kind="stable")).reshape(len(draws), -1)
    edges = np.linspace(0.0, max(draws.size, 1), 13)
    for e, own in enumerate(ranks):
        height = np.histogram(own, edges)[0] * 12.0 / max(own.size, 1)
        ax.stairs(
            height,
            edges / edges[-1],
            color=ENSEMBLE_COLOURS[e % len(ENSEMBLE_COLOURS)],
            linewidth=1.0,
        )
    ax.axhline(1.0, color="0.5", linewidth=0.6, zorder=0)
    ax.set(xlim=(0, 1), ylim=(0, 2.2), xticks=[0, 0.5, 1], yticks=[0, 1, 2])
    ax.tick_params(labelsize=7, labelleft=False)


def _span(draws: Floats, truth: float | None) -> tuple[float, float]:
    """What an axis of the corner plot shows: the draws, and the truth unless it is far away."""
    low, high = (float(q) for q in np.quantile(draws, (0.001, 0.999)))
    width = high - low or abs(low) or 1.0
    if truth is not None and low - width < truth < high + width:
        low, high = min(low, truth), max(high, truth)
    return low - 0.08 * width, high + 0.08 * width


def _symbol(name: str) -> str:
    """A parameter's name as mathematics, for matplotlib."""
    term = parameter_powers(name)
    if term is None:
        return name.replace("_", " ")
    letter, factors = term
    powers = " ".join(
        variable if power == 1 else f"{variable}^{power}" for variable, power in factors
    )
    return f"$b_{{{powers}}}$" if letter == "background" else f"${letter}_{{{powers}}}$"


def _label(name: str, exponent: int, separator: str = " ") -> str:
    """Symbol, power of ten and unit of an axis."""
    word, pixels = parameter_unit(name)
    pixel = "" if pixels == 0 else "px" if pixels == 1 else f"px$^{{{pixels}}}$"
    scale = f"$10^{{{exponent}}}$" if exponent else ""
    unit = " ".join(part for part in (scale, word, pixel) if part)
    return _symbol(name) + (f"{separator}[{unit}]" if unit else "")


def _plain(value: float, sd: float) -> str:
    """A value with its uncertainty to two digits, in a common power of ten."""
    exponent = power_of_ten(np.array([value, sd]))
    decimals = max(0, 1 - math.floor(math.log10(sd)) + exponent)
    text = f"${value / 10.0**exponent:.{decimals}f}$\n$\\pm {sd / 10.0**exponent:.{decimals}f}$"
    return f"{text}\n$\\times 10^{{{exponent}}}$" if exponent else text
