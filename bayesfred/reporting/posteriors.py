"""Figures of a posterior and of the chain behind it.

Every function returns a `matplotlib.figure.Figure` that belongs to no window and no pyplot state;
the caller saves it. Parameters are shown multiplied by a power of ten that their label states,
because a distortion coefficient is a few millionths. `bayesfred.reporting.html` puts the figures on
one page.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from bayesfred._typing import Floats
from bayesfred.model.parameters import Parameter
from bayesfred.reporting.frames import FittedFrame, draw_triptych, triptych_height
from bayesfred.reporting.labels import axis_label, math_symbol, power_of_ten, raised, scale_of
from bayesfred.reporting.pairs import marks_of, shown_range
from bayesfred.reporting.panels import Panel, Sheet
from bayesfred.reporting.style import (
    ENSEMBLE_COLOURS,
    POSTERIOR_COLOUR,
)
from bayesfred.sampling.chain import Chain

__all__ = ["marginal_plot", "overview", "trace_plot"]

MAX_TRACE_STEPS = 1_000
RANK_BINS = 12
COLUMNS = 6  # of histograms
LINEAR = 3.0  # standard deviations up to which the overview's axis is linear


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
    rows = -(-len(parameters) // COLUMNS)
    width, height = 2.0, 1.2
    sheet = Sheet(0.15 + COLUMNS * (width + 0.14), 0.35 + rows * (height + 0.65))
    marks = marks_of(truth, estimate)
    prior_look = {"colors": "0.3", "linestyles": "-.", "linewidths": 1.1}
    for k, parameter in enumerate(parameters):
        row, column = divmod(k, COLUMNS)
        span, exponent = shown_range(draws[:, k], None if truth is None else truth[k])
        scale = 10.0**exponent
        edges = np.linspace(*span, 41)
        heights = np.histogram(draws[:, k] / scale, edges)[0] / (
            max(len(draws), 1) * (edges[1] - edges[0])
        )
        middle = 0.5 * (edges[1:] + edges[:-1])
        prior = scale * priors[parameter.name].pdf(scale * middle)
        top = 1.05 * max(heights.max(), prior.max(), 1e-300)
        panel = sheet.panel(
            (
                0.1 + column * (width + 0.14),
                0.6 + (rows - 1 - row) * (height + 0.65),
                width,
                height,
            ),
            span,
            (0.0, top),
        )
        panel.filled_steps(heights, edges, facecolors=POSTERIOR_COLOUR, alpha=0.35)
        panel.steps(heights, edges, colors=POSTERIOR_COLOUR, linewidths=1.0)
        panel.line(middle, prior, **prior_look)
        for _, values, look in marks:
            panel.mark(x=values[k] / scale, **look)
        panel.ticks_below()
        panel.label_below(axis_label(parameter, exponent, "\n"), 0.22)
    posterior_look = {"colors": POSTERIOR_COLOUR, "linewidths": 1.0}
    sheet.legend(
        [("posterior", posterior_look), ("prior", prior_look)]
        + [(label, look) for label, _, look in marks]
    )
    return sheet.finish()


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
    sheet = Sheet(13.0, 0.85 + 1.25 * rows)
    steps = np.unique(np.linspace(0, n_steps - 1, min(n_steps, MAX_TRACE_STEPS)).astype(int))
    colours = [ENSEMBLE_COLOURS[e % len(ENSEMBLE_COLOURS)] for e in range(n_ensembles)]
    lines: list[dict[str, Any]] = [{"colors": colour, "linewidths": 0.9} for colour in colours]
    burn_in = {"facecolors": "0.5", "alpha": 0.25}
    for k, parameter in enumerate(parameters):
        # down the first pair of columns, then down the second, as the table of parameters runs
        left, bottom = 1.0 + 6.5 * (k // rows), 0.5 + 1.25 * (rows - 1 - k % rows)
        bands = np.quantile(values[..., k][:, steps], (0.16, 0.5, 0.84), axis=2)
        exponent = power_of_ten(bands)
        bands /= 10.0**exponent
        low, high = float(bands.min()), float(bands.max())
        margin = 0.05 * (high - low) or 0.5 * abs(low) or 0.5
        trace = sheet.panel(
            (left, bottom, 4.1, 1.05), (0.0, max(n_steps - 1, 1)), (low - margin, high + margin)
        )
        for (below, middle, above), colour, look in zip(
            bands.swapaxes(0, 1), colours, lines, strict=True
        ):
            trace.band(steps, below, above, facecolors=colour, alpha=0.15)
            trace.line(steps, middle, **look)
        if chain.burn_in:
            ends = np.array([0.0, chain.burn_in])
            trace.band(ends, np.full(2, trace.y[0]), np.full(2, trace.y[1]), **burn_in)
        trace.ticks_beside()
        trace.label_beside(axis_label(parameter, exponent, "\n"), 0.45)
        ranks = sheet.panel((left + 4.2, bottom, 1.2, 1.05), (0.0, 1.0), (0.0, 2.2))
        ranks.mark(y=1.0, colors="0.5", linewidths=0.6)
        for heights, look in zip(_ranks(values[:, chain.burn_in :, :, k]), lines, strict=True):
            ranks.steps(heights, np.linspace(0.0, 1.0, RANK_BINS + 1), **look)
        last = k % rows == rows - 1 or k == d - 1
        for panel, text in ((trace, "step"), (ranks, "rank")):
            panel.ticks_below(labelled=last)
            if last:
                panel.label_below(text, 0.25)
    sheet.legend(
        [(f"ensemble {e}", look) for e, look in enumerate(lines)]
        + ([("burn-in", burn_in)] if chain.burn_in else [])
    )
    return sheet.finish()


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
    sheet = Sheet(19.0, triptych_height(fitted) + 3.3)
    draw_triptych(sheet, fitted)
    ticks = [f"{math_symbol(parameters[k])}\n{_plain(mean[k], sd[k])}" for k in kept]
    _deviations(sheet, z, ticks, from_truth=truth is not None)
    return sheet.finish()


def _deviations(sheet: Sheet, z: Floats, names: Sequence[str], *, from_truth: bool) -> None:
    """Posterior means in standard deviations, with bands of one and two, along a sheet's foot."""
    heights = np.stack([z - 1.0, z, z + 1.0])
    limit = max(3.5, float(np.max(np.abs(z), initial=0.0)) + 1.5)
    span = -limit, limit
    if not from_truth:
        heights = _compressed(heights)
        low, high = np.min(heights, initial=-2.0), np.max(heights, initial=2.0)
        span = float(1.12 * low - 0.12 * high), float(1.12 * high - 0.12 * low)
    box = (0.85, 0.75, 17.95, 2.4)
    panel = sheet.panel(box, (-0.7, len(z) - 0.3), span, 10.0)
    across, one = np.array(panel.x), np.ones(2)
    for width in (1.0, 2.0):
        panel.band(across, -width * one, width * one, facecolors="0.4", alpha=0.11)
    panel.mark(y=0.0, colors="0.3", linewidths=0.8)
    at = np.arange(float(len(z)))
    below, middle, above = heights
    panel.bars(at, below, above, cap=0.055, colors=POSTERIOR_COLOUR, linewidths=1.5)
    sheet.axes.plot(*panel.at(at, middle).T, "o", color=POSTERIOR_COLOUR, markersize=6)
    panel.ticks_beside(given=None if from_truth else _marks(panel))
    panel.label_beside(
        f"{'(posterior mean − truth)' if from_truth else 'posterior mean'} / sd", 0.4, fontsize=10
    )
    wide = len(z) <= 32
    for (x, y), name in zip(panel.at(at, span[0]), names, strict=True):
        panel.ticks.append(np.array([(x, y), (x, y - panel.tick)]))
        sheet.text(
            x, y - 2.0 * panel.tick, name, ha="center", va="top", ma="center",
            fontsize=8 if wide else 6, rotation=0 if wide else 60,
        )  # fmt: skip


def _compressed(z: Floats) -> Floats:
    """Linear within +-3, logarithmic beyond: a decade is as high as 2.7 within."""
    far = np.maximum(np.abs(z) / LINEAR, 1.0)
    return np.sign(z) * (np.minimum(np.abs(z), LINEAR) + 0.9 * LINEAR * np.log10(far))


def _marks(panel: Panel) -> tuple[Floats, list[str]]:
    """Whole numbers near zero and powers of ten beyond, as many as there is room for."""
    unit = panel.box[3] / (panel.y[1] - panel.y[0])  # inch
    decades = 10.0 ** np.arange(1, 300, math.ceil(0.2 / (0.9 * LINEAR * unit)))
    values = np.concatenate([np.arange(1.0, LINEAR + 1.0) if unit > 0.2 else [], decades])
    values = np.concatenate([-values[::-1], [0.0], values])
    at = _compressed(values)
    inside = (at > panel.y[0]) & (at < panel.y[1])
    return at[inside], [f"{value:g}".replace("-", "−") for value in values[inside]]


def _ranks(draws: Floats) -> Floats:
    """Histogram of each ensemble's ranks among all draws, relative to a flat one.

    `draws` has the shape (n_ensembles, n_steps, n_walkers), the result (n_ensembles, bins).
    """
    order = np.argsort(draws, axis=None, kind="stable")
    bins = np.empty(order.size, dtype=np.int64)
    bins[order] = np.arange(order.size) * RANK_BINS // max(order.size, 1)
    own = bins.reshape(len(draws), -1)
    counts = np.array([np.bincount(each, minlength=RANK_BINS) for each in own])
    return counts * RANK_BINS / max(own.shape[1], 1)


def _plain(mean: float, sd: float) -> str:
    """A value with its uncertainty to two digits, in a common power of ten, one below the other."""
    scale = scale_of(mean, sd)
    text = f"{scale.number(mean)}\n± {scale.number(sd)}".replace("-", "−")
    return f"{text}\n× {raised('10', scale.exponent)}" if scale.exponent else text
