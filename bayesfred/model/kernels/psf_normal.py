"""The normal equations of a PSF that is measured on a frame.

The PSF of a source is a sum of cubic B-splines on square grids ("levels"), and over the field every
coefficient is a sum of terms P_t(x, y):

    p(a, b; x, y) = sum_levels sum_knots sum_t c[level, knot, t] P_t(x, y) B(a / h - i) B(b / h - j)

so the expected counts are linear in c. A sample is a pair of a source and a pixel that it reaches,
and a pixel's row of the design matrix is the sum over its samples: overlapping sources share one
row. Beside c every source has three templates: its kernel K, and the derivatives X and Y of its
light as it is shifted along a and along b. The distortion's coefficients act through X and Y, so
the equations hold for them too.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST

KNOTS = 16  # B-splines that are not zero at a point
TEMPLATES = 3


class Levels(NamedTuple):
    """The grids of B-splines; coefficient (knot, t) of level l is start + knot (high - low) + t."""

    start: Ints  # (l,) a level's first coefficient
    side: Ints  # (l,) knots along one axis
    low: Ints  # (l,) first term of the field
    high: Ints  # (l,) the term after the last
    spacing: Floats  # (l,) pixel


class SourceSamples(NamedTuple):
    """Pairs of sources and pixels, sorted by pixel."""

    first: Ints  # (pixels + 1,) samples of pixel i are those from first[i] to first[i + 1]
    source: Ints  # (samples,)
    a: Floats  # (samples,) pixel, from the middle of the source's image
    b: Floats
    size: Floats  # (samples,) |D|, or 1 where flux is not conserved


@inner()
def _splines(x, side, weights, slopes):
    """The first of the four knots around x (knots from the middle), and their splines at x."""
    x = x + 0.5 * (side - 1)
    i = np.int64(np.floor(x))
    f = x - i
    g = 1.0 - f
    weights[0], weights[3] = g * g * g / 6.0, f * f * f / 6.0
    weights[1] = 2.0 / 3.0 - f * f * (1.0 - 0.5 * f)
    weights[2] = 2.0 / 3.0 - g * g * (1.0 - 0.5 * g)
    slopes[0], slopes[3] = -0.5 * g * g, 0.5 * f * f
    slopes[1], slopes[2] = f * (1.5 * f - 2.0), -g * (1.5 * g - 2.0)
    return i - 1


@entry()
def sample_psf(levels, field, samples, coefficients):
    """p, p_a and p_b at every sample, shape (3, samples), per square pixel."""
    out = np.zeros((3, samples.source.size))
    wx, wy, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for level in range(levels.side.size):
        side, h = levels.side[level], levels.spacing[level]
        low, high, start = levels.low[level], levels.high[level], levels.start[level]
        for n in range(samples.source.size):
            i = _splines(samples.a[n] / h, side, wx, dx)
            j = _splines(samples.b[n] / h, side, wy, dy)
            terms = field[samples.source[n]]
            for q in range(max(0, -j), min(4, side - j)):
                for p in range(max(0, -i), min(4, side - i)):
                    at = start + ((j + q) * side + i + p) * (high - low)
                    c = 0.0
                    for t in range(high - low):
                        c += coefficients[at + t] * terms[low + t]
                    out[0, n] += c * wx[p] * wy[q]
                    out[1, n] += c * dx[p] * wy[q] / h
                    out[2, n] += c * wx[p] * dy[q] / h
    return out


class _Runs(NamedTuple):
    """The coefficients that one pixel depends on, as runs of neighbouring ones."""

    begin: Ints  # a run's first coefficient
    first: Ints  # (runs + 1,) where its values begin
    values: Floats  # derivatives of the pixel's expected counts


@inner()
def _add_runs(levels, samples, n, scaled, runs, size):
    """Append the runs of a sample, whose terms times its light are `scaled`; returns their number.

    Knots along a come one after the other, and a knot's terms within it, so each of a level's four
    rows of knots is one run.
    """
    begin, first, values = runs
    wx, wy, spare = np.empty(4), np.empty(4), np.empty(4)
    for level in range(levels.side.size):
        side, h = levels.side[level], levels.spacing[level]
        low, terms = levels.low[level], levels.high[level] - levels.low[level]
        i = _splines(samples.a[n] / h, side, wx, spare)
        j = _splines(samples.b[n] / h, side, wy, spare)
        left, right = max(0, -i), min(4, side - i)
        if right <= left:
            continue
        for q in range(max(0, -j), min(4, side - j)):
            begin[size] = levels.start[level] + ((j + q) * side + i + left) * terms
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
def _add_square(runs, size, weight, matrix):
    """Add weight times the runs' outer product: of two runs once, of one with itself half."""
    begin, first, values = runs
    for r in range(size):
        for k in range(first[r], first[r + 1]):
            line, value = matrix[begin[r] + k - first[r]], weight * values[k]
            own = line[begin[r] : begin[r] + first[r + 1] - first[r]]
            half = 0.5 * value
            for o in range(own.size):
                own[o] += half * values[first[r] + o]
            for other in range(r + 1, size):
                at, length = first[other], first[other + 1] - first[other]
                target = line[begin[other] : begin[other] + length]
                for o in range(length):
                    target[o] += value * values[at + o]


@inner(fastmath=FAST)
def _add_columns(runs, size, columns, target):
    """Add to the columns of target, at the runs' rows, the runs times a pixel's numbers."""
    begin, first, values = runs
    for r in range(size):
        for k in range(first[r], first[r + 1]):
            line, value = target[begin[r] + k - first[r]], values[k]
            for m in range(columns.size):
                line[m] += value * columns[m]


@inner(fastmath=FAST)
def _add_row(runs, size, factor, target):
    """Add to target, at the runs' places, the runs times a factor."""
    begin, first, values = runs
    for r in range(size):
        at, length = first[r], first[r + 1] - first[r]
        own = target[begin[r] : begin[r] + length]
        for o in range(length):
            own[o] += factor * values[at + o]


@entry()
def normal_equations(levels, field, samples, pixels, templates):
    """The equations of all coefficients, beside the templates and the background's terms.

    `pixels` are the flux of every source, and of every pixel the weight, the residual and the
    background's terms; `templates` has shape (3, samples). Returns the matrix of the coefficients,
    shape (c, c), of which the sum with its transpose is the information; the couplings with the
    templates, shape (3 sources, c); and with the background's terms and the residuals, shape
    (c, terms + 1).
    """
    flux, weight, residual, background = pixels
    last, terms = levels.side.size - 1, background.shape[1]
    total = levels.start[last] + levels.side[last] ** 2 * (levels.high[last] - levels.low[last])
    matrix, others = np.zeros((total, total)), np.zeros((total, terms + 1))
    coupling = np.zeros((TEMPLATES * flux.size, total))
    crowd, width = 1, 0
    for i in range(weight.size):
        crowd = max(crowd, samples.first[i + 1] - samples.first[i])
    for level in range(levels.side.size):
        width += KNOTS * (levels.high[level] - levels.low[level])
    most = crowd * 4 * levels.side.size
    runs = _Runs(np.empty(most, np.int64), np.zeros(most + 1, np.int64), np.empty(crowd * width))
    columns, scaled = np.empty(terms + 1), np.empty(field.shape[1])
    for i in range(weight.size):
        w, size = weight[i], 0
        if w == 0.0:
            continue
        for n in range(samples.first[i], samples.first[i + 1]):
            s = samples.source[n]
            for t in range(scaled.size):
                scaled[t] = flux[s] * samples.size[n] * field[s, t]
            size = _add_runs(levels, samples, n, scaled, runs, size)
        _add_square(runs, size, w, matrix)
        for m in range(terms):
            columns[m] = w * background[i, m]
        columns[terms] = w * residual[i]
        _add_columns(runs, size, columns, others)
        for n in range(samples.first[i], samples.first[i + 1]):
            at = TEMPLATES * samples.source[n]
            for m in range(TEMPLATES):
                _add_row(runs, size, w * templates[m, n], coupling[at + m])
    return matrix, coupling, others
