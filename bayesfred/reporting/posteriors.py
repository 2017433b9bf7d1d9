"""Figures of a posterior and of the chain behind it.

Every function returns a `matplotlib.figure.Figure` that belongs to no window and no pyplot state;
the caller saves it. Parameters are shown multiplied by a power of ten that their label states,
because a distortion coefficient is a few millionths. `bayesfred.reporting.html` puts the figures on
one page.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import corner
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator, ScalarFormatter

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import Parameter
from bayesfred.reporting.frames import FittedFrame, draw_triptych, triptych_height
from bayesfred.reporting.labels import axis_label, math_symbol, power_of_ten, scale_of
from bayesfred.reporting.style import (
    ENSEMBLE_COLOURS,
    ESTIMATE_COLOUR,
    POSTERIOR_COLOUR,
    TRUTH_COLOUR,
)
from bayesfred.sampling.chain import Chain

__all__ = ["corner_parameters", "corner_plot", "marginal_plot", "overview", "trace_plot"]

MAX_CORNER = 12  # parameters in pairs that a page shows readably
MAX_CORNER_DRAWS = 20_000
MAX_TRACE_STEPS = 1_000


def corner_parameters(
    draws: Floats, names: Sequence[str], given: Sequence[str] = ()
) -> tuple[int, ...]:
    """Choose the parameters that are shown in pairs.

    A panel of a pair tells more than two histograms only where the two are correlated. So of more
    than twelve parameters those are chosen that make up the most correlated pairs.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units
    names : sequence of str, length d
    given : sequence of str, optional
        Show these instead.

    Returns
    -------
    tuple of int
        Indices in increasing order.

    Raises
    ------
    InputError
        A name is no parameter's.

    Examples
    --------
    >>> corner_parameters(np.eye(3), ["f_ux", "g_vy", "background"], ["background", "f_ux"])
    (0, 2)
    """
    unknown = [name for name in given if name not in names]
    if unknown:
        raise InputError(
            f"corner: got {', '.join(unknown)}, expected names among {', '.join(names)}"
        )
    if given:
        return tuple(k for k, name in enumerate(names) if name in given)
    if len(names) <= MAX_CORNER:
        return tuple(range(len(names)))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = np.nan_to_num(np.abs(np.corrcoef(draws, rowvar=False)))
    rows, columns = np.triu_indices(len(names), 1)
    chosen: set[int] = set()
    for pair in np.argsort(-correlation[rows, columns], kind="stable"):
        joined = chosen | {int(rows[pair]), int(columns[pair])}
        if len(joined) <= MAX_CORNER:
            chosen = joined
        if len(chosen) == MAX_CORNER:
            break
    return tuple(sorted(chosen))


def corner_plot(
    draws: Floats,
    parameters: Sequence[Parameter],
    *,
    truth: Floats | None = None,
    estimate: Floats | None = None,
) -> Figure:
    """Marginal posteriors of all parameters and pairs; contours hold 39 and 86 % of the draws.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units
    parameters : sequence of Parameter, length d
    truth, estimate : ndarray, shape (d,), parameter units, optional
        Values to mark: those a simulation used, and the MAP.

    Returns
    -------
    Figure
    """
    d = len(parameters)
    draws = draws[:: -(-len(draws) // MAX_CORNER_DRAWS)] if len(draws) else np.zeros((1, d))
    ranges = [_span(draws[:, k], None if truth is None else truth[k]) for k in range(d)]
    scale = 10.0 ** np.array([power_of_ten(np.array(span)) for span in ranges])
    labels = [
        axis_label(parameter, round(math.log10(s)), "\n")
        for parameter, s in zip(parameters, scale, strict=True)
    ]
    side = 1.6 + 0.97 * d
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
            look: dict[str, Any] = {"color": colour, "linestyle": style, "linewidth": 0.9}
            if d == 1:  # which corner cannot mark
                fig.axes[0].axvline(values[0] / scale[0], **look)
            else:
                corner.overplot_lines(fig, values / scale, **look)
            marked.append((label, colour, style))
    for ax in fig.axes:
        ax.tick_params(labelsize=8 if small else 8.5, length=2, pad=1.5)
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


def marginal_plot(
    draws: Floats,
    parameters: Sequence[Parameter],
    priors: Mapping[str, Any],
    *,
    truth: Floats | None = None,
    estimate: Floats | None = None,
) -> Figure:
    """A histogram of each parameter's draws with the density of its prior.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units
    parameters : sequence of Parameter, length d
    priors : mapping of str to frozen scipy.stats distribution
        By the parameters' names.
    truth, estimate : ndarray, shape (d,), parameter units, optional
        Values to mark: those a simulation used, and the MAP.

    Returns
    -------
    Figure
    """
    d, columns = len(parameters), 6
    rows = -(-d // columns)
    fig = Figure(figsize=(13, 0.45 + 1.75 * rows), dpi=100, layout="constrained")
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[d:]:
        ax.set_visible(False)
    for k, (ax, parameter) in enumerate(zip(axes, parameters, strict=False)):
        span = _span(draws[:, k], None if truth is None else truth[k])
        exponent = power_of_ten(np.array(span))
        scale = 10.0**exponent
        edges = np.linspace(*span, 41)
        height = np.histogram(draws[:, k], edges)[0] / max(
            len(draws) * (edges[1] - edges[0]), 1e-300
        )
        ax.stairs(height, edges / scale, color=POSTERIOR_COLOUR, fill=True, alpha=0.35)
        ax.stairs(height, edges / scale, color=POSTERIOR_COLOUR, linewidth=1.0, label="posterior")
        middle = 0.5 * (edges[1:] + edges[:-1])
        ax.plot(
            middle / scale, priors[parameter.name].pdf(middle), "-.", color="0.3", linewidth=1.1,
            label="prior",
        )  # fmt: skip
        for values, colour, style, label in (
            (truth, TRUTH_COLOUR, "-", "truth"),
            (estimate, ESTIMATE_COLOUR, "--", "MAP"),
        ):
            if values is not None:
                ax.axvline(
                    values[k] / scale, color=colour, linestyle=style, linewidth=1.0, label=label
                )
        ax.set(xlim=(span[0] / scale, span[1] / scale), ylim=(0, None), yticks=[])
        ax.xaxis.set_major_locator(MaxNLocator(3))
        ax.ticklabel_format(axis="x", useOffset=False)
        ax.tick_params(labelsize=8.5)
        ax.set_xlabel(axis_label(parameter, exponent), fontsize=9.5)
    handles, labels = axes[0].get_legend_handles_labels()
    fig.legend(
        handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9, frameon=False
    )
    return fig


def trace_plot(chain: Chain, parameters: Sequence[Parameter]) -> Figure:
    """Every parameter's ensembles over the steps, and the ranks of each ensemble's draws.

    A band holds the middle 68 % of an ensemble's walkers, a line is their median, the burn-in is
    shaded. The rank histogram beside it is flat at 1 for every ensemble when all draw from one
    distribution.

    Parameters
    ----------
    chain : Chain
    parameters : sequence of Parameter, length d

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
    for k, parameter in enumerate(parameters):
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
        trace.set_ylabel(axis_label(parameter, exponent, "\n"), fontsize=8.5)
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


def overview(
    fitted: FittedFrame,
    draws: Floats,
    parameters: Sequence[Parameter],
    *,
    truth: Floats | None = None,
) -> Figure:
    """The picture that lies beside a chain: the frame against its model, and every posterior.

    Parameters
    ----------
    fitted : FittedFrame
    draws : ndarray, shape (n, d), parameter units
    parameters : sequence of Parameter, length d
    truth : ndarray, shape (d,), parameter units, optional
        With it posteriors are shown as (draws - truth) / sd; without, the distortion's terms as
        draws / sd, on an axis that is linear within +-3 and logarithmic beyond.

    Returns
    -------
    Figure
    """
    mean, sd = draws.mean(axis=0), draws.std(axis=0, ddof=1)
    sd = np.where(sd > 0.0, sd, 1.0)
    kept = [k for k, p in enumerate(parameters) if truth is not None or p.letter in ("f", "g")]
    z = (mean if truth is None else mean - truth)[kept] / sd[kept]
    heights = (triptych_height(fitted), 3.4)
    fig = Figure(figsize=(19, sum(heights)), dpi=100, layout="constrained")
    # an array, whatever the stubs of the version say
    parts: Any = fig.subfigures(2, 1, height_ratios=heights)
    upper, lower = parts
    draw_triptych(fig, upper.subplots(1, 3), fitted)
    ax = lower.subplots()
    position = np.arange(len(kept))
    for width in (1.0, 2.0):
        ax.axhspan(-width, width, color="0.4", alpha=0.11, linewidth=0)
    ax.axhline(0.0, color="0.3", linewidth=0.8)
    ax.errorbar(position, z, yerr=1.0, fmt="o", color=POSTERIOR_COLOUR, capsize=4, markersize=6)
    if truth is None:
        ax.set_yscale("symlog", linthresh=3.0)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.margins(y=0.12)
        ax.set_ylabel("posterior mean / sd")
    else:
        limit = max(3.5, float(np.max(np.abs(z), initial=0.0)) + 1.5)
        ax.set_ylim(-limit, limit)
        ax.set_ylabel("(posterior mean - truth) / sd")
    ax.set_xlim(-0.7, len(kept) - 0.3)
    ticks = [f"{math_symbol(parameters[k])}\n{_plain(mean[k], sd[k])}" for k in kept]
    ax.set_xticks(
        position, ticks, fontsize=9 if len(kept) <= 16 else 7, rotation=0 if len(kept) <= 16 else 60
    )
    return fig


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


def _plain(mean: float, sd: float) -> str:
    """A value with its uncertainty to two digits, in a common power of ten, for matplotlib."""
    scale = scale_of(mean, sd)
    text = f"${scale.number(mean)}$\n$\\pm {scale.number(sd)}$"
    return f"{text}\n$\\times 10^{{{scale.exponent}}}$" if scale.exponent else text
