"""The corner plot: histograms of parameters, contours of their pairs, all correlations.

Pairs of 28 parameters would be 378 panels, which nobody reads. So those parameters are shown whose
correlations are strongest, and the correlations of all as an image in the corner that stays free.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from contourpy import FillType, LineType, contour_generator
from matplotlib import colormaps
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import Parameter
from bayesfred.reporting.labels import axis_label, math_symbol, power_of_ten
from bayesfred.reporting.panels import Panel, Sheet
from bayesfred.reporting.style import (
    ESTIMATE_COLOUR,
    POSTERIOR_COLOUR,
    TRUTH_COLOUR,
)

__all__ = [
    "corner_parameters",
    "corner_plot",
    "correlations",
    "described_pairs",
    "marks_of",
    "pairs_caption",
    "shown_range",
]

MAX_CORNER = 8  # parameters in pairs that a page shows readably
MAX_CORNER_DRAWS = 20_000
BINS = 24
SMOOTH = 0.9  # bins
LEVELS = (1.0 - math.exp(-0.5), 1.0 - math.exp(-2.0))
GAP = 0.05  # inch between panels
LEFT, BELOW = 0.95, 0.72  # inch around them

Mark = tuple[str, Floats, dict[str, Any]]


def corner_parameters(
    draws: Floats, names: Sequence[str], given: Sequence[str] = ()
) -> tuple[int, ...]:
    """Choose the parameters that are shown in pairs.

    A panel of a pair tells more than two histograms only where the two are correlated. So of more
    than eight parameters those are chosen that make up the most correlated pairs.

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
    correlation = np.abs(correlations(draws))
    rows, columns = np.triu_indices(len(names), 1)
    chosen: set[int] = set()
    for pair in np.argsort(-correlation[rows, columns], kind="stable"):
        joined = chosen | {int(rows[pair]), int(columns[pair])}
        if len(joined) <= MAX_CORNER:
            chosen = joined
        if len(chosen) == MAX_CORNER:
            break
    return tuple(sorted(chosen))


def correlations(draws: Floats) -> Floats:
    """Correlation of every pair of parameters, 0 where one of them never moved.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units

    Returns
    -------
    ndarray, shape (d, d)
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.nan_to_num(np.atleast_2d(np.corrcoef(draws, rowvar=False)))


def corner_plot(
    draws: Floats,
    parameters: Sequence[Parameter],
    *,
    shown: Sequence[int] | None = None,
    truth: Floats | None = None,
    estimate: Floats | None = None,
) -> Figure:
    """Marginal posteriors of parameters and pairs; contours hold 39 and 86 % of the draws.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units
    parameters : sequence of Parameter, length d
    shown : sequence of int, optional
        Indices of the parameters to show; where not all are, the correlations of all are in the
        corner that stays free.
    truth, estimate : ndarray, shape (d,), parameter units, optional
        Values to mark: those a simulation used, and the MAP.

    Returns
    -------
    Figure
    """
    which = list(range(len(parameters)) if shown is None else shown)
    n = len(which)
    cell = 1.12 if n > 4 else 1.6
    side = n * (cell + GAP)
    sheet = Sheet(LEFT + side + 0.1, BELOW + side + 0.1)
    some = draws[:: max(-(-len(draws) // MAX_CORNER_DRAWS), 1), which]
    some = some if len(some) else np.zeros((1, n))
    marks = [(label, values[which], look) for label, values, look in marks_of(truth, estimate)]
    ranges, exponents = zip(
        *(shown_range(some[:, k], None if truth is None else truth[which[k]]) for k in range(n)),
        strict=True,
    )
    some = some / 10.0 ** np.array(exponents)
    for i, parameter in enumerate(which):
        name = axis_label(parameters[parameter], exponents[i], "\n")
        bottom = BELOW + (n - 1 - i) * (cell + GAP)
        heights, edges = np.histogram(some[:, i], BINS, ranges[i])
        for j in range(i + 1):
            box = (LEFT + j * (cell + GAP), bottom, cell, cell)
            panel = sheet.panel(
                box, ranges[j], ranges[i] if j < i else (0.0, 1.08 * max(heights.max(), 1))
            )
            if j < i:
                _contours(panel, some[:, j], some[:, i])
                panel.ticks_beside(labelled=j == 0)
            else:
                panel.steps(heights, edges, colors=POSTERIOR_COLOUR, linewidths=1.0)
            panel.ticks_below(labelled=i == n - 1)
            for _, values, look in marks:
                scaled = values / 10.0 ** np.array(exponents)
                panel.mark(x=scaled[j], y=scaled[i] if j < i else None, **look)
            if j == 0 and i > 0:
                panel.label_beside(name, 0.42)
            if i == n - 1:
                panel.label_below(axis_label(parameters[which[j]], exponents[j], "\n"), 0.3)
    if n < len(parameters):
        room = 0.5 * side
        _matrix(sheet, (LEFT + side - room, BELOW + side - room, room), draws, parameters)
    sheet.legend([(label, look) for label, _, look in marks])
    return sheet.finish()


def pairs_caption(n_shown: int, n: int) -> str:
    """What stands below a corner plot.

    Parameters
    ----------
    n_shown, n : int
        Parameters shown in pairs, and all there are.

    Returns
    -------
    str
    """
    caption = "Contours hold 39 % and 86 % of the draws."
    if n_shown < n:
        caption += (
            f" {n_shown} of {n} parameters: report --corner NAME,NAME,... shows others. The "
            "triangle has the correlation of every pair."
        )
    return caption


def described_pairs(draws: Floats, names: Sequence[str], shown: Sequence[int]) -> str:
    """Say what is seen in a corner plot.

    Parameters
    ----------
    draws : ndarray, shape (n, d), parameter units
    names : sequence of str, length d
    shown : sequence of int
        Indices of the parameters that are shown in pairs.

    Returns
    -------
    str
    """
    text = f"Histograms of {len(shown)} parameters and contours of their pairs."
    if len(names) < 2:
        return text
    correlation = correlations(draws)
    i, j = divmod(int(np.argmax(np.abs(np.triu(correlation, 1)))), len(names))
    number = f"{correlation[i, j]:+.2f}".replace("-", "−")
    return f"{text} The strongest correlation is {number}, of {names[i]} and {names[j]}."


def marks_of(truth: Floats | None, estimate: Floats | None) -> list[Mark]:
    """Name, values and look of what is marked in a figure.

    Parameters
    ----------
    truth, estimate : ndarray, shape (d,), parameter units, or None

    Returns
    -------
    list of (str, ndarray, dict)
    """
    return [
        (
            label,
            values,
            {"colors": colour, "linestyles": style, "linewidths": 0.9, "zorder": 2.5},
        )
        for label, values, colour, style in (
            ("truth", truth, TRUTH_COLOUR, "-"), ("MAP", estimate, ESTIMATE_COLOUR, "--"),
        )
        if values is not None
    ]  # fmt: skip


def shown_range(draws: Floats, truth: float | None) -> tuple[tuple[float, float], int]:
    """What an axis shows: the draws, and the truth unless it is far away.

    Parameters
    ----------
    draws : ndarray, shape (n,), parameter unit
    truth : float or None

    Returns
    -------
    span : tuple of float
        In units of the power of ten.
    exponent : int
        Of the power of ten that the axis leaves out.
    """
    low, high = (float(q) for q in np.quantile(draws, (0.001, 0.999)))
    width = high - low or abs(low) or 1.0
    if truth is not None and low - width < truth < high + width:
        low, high = min(low, truth), max(high, truth)
    span = low - 0.08 * width, high + 0.08 * width
    exponent = power_of_ten(np.array(span))
    return (span[0] / 10.0**exponent, span[1] / 10.0**exponent), exponent


def _contours(panel: Panel, x: Floats, y: Floats) -> None:
    """Where a pair's draws are densest: the areas that hold 39 % and 86 % of them."""
    ranges = panel.y, panel.x
    density = gaussian_filter(np.histogram2d(y, x, BINS, ranges)[0], SMOOTH)
    ordered = np.sort(density, axis=None)[::-1]
    within = np.searchsorted(np.cumsum(ordered) / np.sum(ordered), LEVELS, side="right")
    inner, outer = ordered[np.maximum(within - 1, 0)]
    outer = min(outer, (1.0 - 1e-4) * inner)
    # beyond the edges the density falls, so that every contour is closed
    density = np.pad(np.pad(density, 1, "edge"), 1, constant_values=density.min())
    up, across = (
        low + (np.arange(-2, BINS + 2) + 0.5) * (high - low) / BINS for low, high in ranges
    )
    made: Any = contour_generator(
        across, up, density, fill_type=FillType.OuterCode, line_type=LineType.Separate
    )
    top = (1.0 + 1e-4) * density.max()
    for low, high, alpha in ((outer, inner, 1.0 / 3.0), (inner, top, 1.0)):
        for points, codes in zip(*made.filled(low, high), strict=True):
            panel.sheet.area(panel.at(*points.T), codes, facecolors=POSTERIOR_COLOUR, alpha=alpha)
        for points in made.lines(low):
            panel.line(*points.T, colors=POSTERIOR_COLOUR, linewidths=0.7)


def _matrix(
    sheet: Sheet,
    place: tuple[float, float, float],
    draws: Floats,
    parameters: Sequence[Parameter],
) -> None:
    """The correlations of all pairs of parameters, in a square given by its corner and side."""
    left, bottom, side = place
    d = len(parameters)
    left, cell = left + 0.1, (side - 0.6) / d
    colours = colormaps["RdBu_r"](0.5 + 0.5 * correlations(draws), bytes=True)
    colours[np.triu_indices(d)] = 0  # transparent: a pair is shown once
    sheet.image((left, bottom, d * cell, d * cell), colours[::-1])
    for k, parameter in enumerate(parameters):
        sheet.text(
            left + (k + 0.2) * cell, bottom + (d - k - 0.5) * cell, math_symbol(parameter),
            va="center", fontsize=8.0 if cell > 0.12 else max(3.0, 60.0 * cell),
        )  # fmt: skip
    bar = sheet.panel((left + side - 1.7, bottom + side - 0.65, 1.2, 0.11), (-1.0, 1.0), (0.0, 1.0))
    sheet.image(bar.box, colormaps["RdBu_r"](np.linspace(0.0, 1.0, 101)[None], bytes=True))
    for value, at in zip(("−1", "0", "1"), bar.at(np.array([-1.0, 0.0, 1.0]), 0.0), strict=True):
        sheet.text(at[0], at[1] - 0.05, value, ha="center", va="top")
    sheet.text(bar.box[0] + 0.6, bar.box[1] + 0.16, f"correlations of all {d}", ha="center")
