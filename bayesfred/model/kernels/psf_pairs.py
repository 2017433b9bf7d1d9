"""What pixels that several samples share add to the normal equations of a measured PSF.

`psf_normal` counts every sample with itself; here it is counted with the others of its pixel.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.model.kernels.psf_grids import EDGE, find_splines

KNOTS = 16  # B-splines that are not zero at a point
TEMPLATES = 3


class _Runs(NamedTuple):
    """The coefficients that one pixel depends on, as runs of neighbouring ones."""

    begin: Ints  # a run's first coefficient
    sample: Ints  # the sample that a run is of
    first: Ints  # (runs + 1,) where its values begin
    values: Floats  # derivatives of the pixel's expected counts


@inner()
def _add_runs(levels, samples, n, scaled, runs, size):
    """Append the runs of a sample, whose terms times its light are `scaled`; returns their number.

    Knots along a come one after the other, and a knot's terms within it, so each of a level's four
    rows of knots is one run.
    """
    begin, first, values = runs.begin, runs.first, runs.values
    wx, wy = np.empty(4), np.empty(4)
    for level in range(levels.side.size):
        side, h = levels.side[level], levels.spacing[level]
        low, terms = levels.low[level], levels.high[level] - levels.low[level]
        i, j = find_splines(h, samples, n, side + 2 * EDGE, wx, wy)
        i, j = i - EDGE, j - EDGE
        left, right = max(0, -i), min(4, side - i)
        if right <= left:
            continue
        for q in range(max(0, -j), min(4, side - j)):
            begin[size] = levels.start[level] + ((j + q) * side + i + left) * terms
            runs.sample[size] = n
            at = first[size]
            for p in range(left, right):
                weight = wx[p] * wy[q]
                for t in range(terms):
                    values[at] = weight * scaled[low + t]
                    at += 1
            size += 1
            first[size] = at
    return size


@inner(fastmath=FAST)
def _add_products(runs, size, weight, matrix):
    """Add weight times the products of runs of different samples, of two runs once."""
    begin, sample, first, values = runs
    for r in range(size):
        for k in range(first[r], first[r + 1]):
            line, value = matrix[begin[r] + k - first[r]], weight * values[k]
            for other in range(r, size):
                if sample[r] == sample[other]:
                    continue
                at, length = first[other], first[other + 1] - first[other]
                target = line[begin[other] : begin[other] + length]
                for o in range(length):
                    target[o] += value * values[at + o]


@inner(fastmath=FAST)
def _add_row(runs, size, n, factor, target):
    """Add to target, at the places of the runs of other samples than n, these times a factor."""
    begin, first, values = runs.begin, runs.first, runs.values
    for r in range(size):
        if runs.sample[r] == n:
            continue
        at, length = first[r], first[r + 1] - first[r]
        own = target[begin[r] : begin[r] + length]
        for o in range(length):
            own[o] += factor * values[at + o]


@entry()
def add_pairs(grids, samples, pixels, templates, matrix, coupling):
    """Add to the matrix of the coefficients and to their coupling with the templates.

    `grids` are the levels and the field's terms, `pixels` the samples' light and pixels' weight.
    """
    (levels, field), (light, weight) = grids, pixels
    crowd, width = 1, 0
    for i in range(weight.size):
        crowd = max(crowd, samples.first[i + 1] - samples.first[i])
    for level in range(levels.side.size):
        width += KNOTS * (levels.high[level] - levels.low[level])
    most, scaled = crowd * 4 * levels.side.size, np.empty(field.shape[1])
    runs = _Runs(
        np.empty(most, np.int64), np.empty(most, np.int64), np.zeros(most + 1, np.int64),
        np.empty(crowd * width),
    )  # fmt: skip
    for i in range(weight.size):
        w, begin, end = weight[i], samples.first[i], samples.first[i + 1]
        if w == 0.0 or end - begin < 2:
            continue
        size = 0
        for n in range(begin, end):
            for t in range(scaled.size):
                scaled[t] = light[n] * field[samples.source[n], t]
            size = _add_runs(levels, samples, n, scaled, runs, size)
        _add_products(runs, size, w, matrix)
        for n in range(begin, end):
            for m in range(TEMPLATES):
                target = coupling[TEMPLATES * samples.source[n] + m]
                _add_row(runs, size, n, w * templates[m, n], target)
