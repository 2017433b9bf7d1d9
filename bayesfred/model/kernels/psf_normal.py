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

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST

KNOTS = 16  # B-splines that are not zero at a point
TEMPLATES = 3
NEAR = 7  # columns on which B-splines overlap one
TOGETHER = 64  # sources
LINES = 4096  # pixels


class Levels(NamedTuple):
    """The grids of B-splines; coefficient (knot, t) of level l is start + knot (high - low) + t."""

    start: Ints  # (l,) a level's first coefficient
    side: Ints  # (l,) knots along one axis
    low: Ints  # (l,) first term of the field
    high: Ints  # (l,) the term after the last
    spacing: Floats  # (l,) pixel


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


@inner()
def _wide(levels):
    """The number of the level of wings, which comes last; of levels where there is none."""
    last = levels.side.size - 1
    return last if last > 0 and levels.low[last] == 0 else last + 1


class _Runs(NamedTuple):
    """The coefficients that one pixel depends on, as runs of neighbouring ones."""

    begin: Ints  # a run's first coefficient
    sample: Ints  # the sample that a run of a level that varies is of; -1 of other levels
    first: Ints  # (runs + 1,) where its values begin
    values: Floats  # derivatives of the pixel's expected counts


@inner()
def _add_runs(levels, samples, n, scaled, runs, size):
    """Append the runs of a sample, whose terms times its light are `scaled`; returns their number.

    Knots along a come one after the other, and a knot's terms within it, so each of a level's four
    rows of knots is one run.
    """
    begin, first, values = runs.begin, runs.first, runs.values
    wx, wy, spare = np.empty(4), np.empty(4), np.empty(4)
    for level in range(_wide(levels)):
        side, h = levels.side[level], levels.spacing[level]
        low, terms = levels.low[level], levels.high[level] - levels.low[level]
        i = _splines(samples.a[n] / h, side, wx, spare)
        j = _splines(samples.b[n] / h, side, wy, spare)
        left, right = max(0, -i), min(4, side - i)
        if right <= left:
            continue
        for q in range(max(0, -j), min(4, side - j)):
            begin[size] = levels.start[level] + ((j + q) * side + i + left) * terms
            runs.sample[size] = n if low > 0 else -1
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
    """Add weight times the runs' outer product: of two runs once, of one with itself half.

    Runs of one sample in a level that varies are left out, see `_add_variation`.
    """
    begin, sample, first, values = runs
    for r in range(size):
        for k in range(first[r], first[r + 1]):
            line, value = matrix[begin[r] + k - first[r]], weight * values[k]
            for other in range(r, size):
                if sample[r] >= 0 and sample[r] == sample[other]:
                    continue
                share = value if other > r else 0.5 * value
                at, length = first[other], first[other + 1] - first[other]
                target = line[begin[other] : begin[other] + length]
                for o in range(length):
                    target[o] += share * values[at + o]


@inner(fastmath=FAST)
def _add_columns(runs, size, columns, target):
    """Add to the columns of target, at the runs' rows, the runs times a pixel's numbers."""
    begin, first, values = runs.begin, runs.first, runs.values
    for r in range(size):
        for k in range(first[r], first[r + 1]):
            line, value = target[begin[r] + k - first[r]], values[k]
            for m in range(columns.size):
                line[m] += value * columns[m]


@inner(fastmath=FAST)
def _add_row(runs, size, factor, target):
    """Add to target, at the runs' places, the runs times a factor."""
    begin, first, values = runs.begin, runs.first, runs.values
    for r in range(size):
        at, length = first[r], first[r + 1] - first[r]
        own = target[begin[r] : begin[r] + length]
        for o in range(length):
            own[o] += factor * values[at + o]


@inner()
def _by_source(samples, sources):
    """The samples of every source one after the other, and where each source's begin."""
    first = np.zeros(sources + 1, np.int64)
    for s in samples.source:
        first[s + 1] += 1
    first = np.cumsum(first)
    order, at = np.empty(samples.source.size, np.int64), first[:-1].copy()
    for n in range(order.size):
        s = samples.source[n]
        order[at[s]] = n
        at[s] += 1
    return order, first


@inner(fastmath=FAST)
def _add_gram(samples, n, grid, weight, gram):
    """Add weight times the outer product of the B-splines at a sample, of knots of one grid.

    `gram` has a row for every knot, of the knots up to three rows and columns on.
    """
    side, h = grid
    wx, wy, spare = np.empty(4), np.empty(4), np.empty(4)
    i = _splines(samples.a[n] / h, side, wx, spare)
    j = _splines(samples.b[n] / h, side, wy, spare)
    left, right, bottom = max(0, -i), min(4, side - i), min(4, side - j)
    for q in range(max(0, -j), bottom):
        for p in range(left, right):
            line = gram[(j + q) * side + i + p]
            own = weight * wx[p] * wy[q]
            line[NEAR // 2] += 0.5 * own * wx[p] * wy[q]
            for o in range(p + 1, right):
                line[NEAR // 2 + o - p] += own * wx[o] * wy[q]
            for r in range(q + 1, bottom):
                for o in range(left, right):
                    line[(r - q) * NEAR + NEAR // 2 + o - p] += own * wx[o] * wy[r]


@inner(fastmath=FAST)
def _add_line(factor, line, target):
    """Add to target a line times a factor."""
    for o in range(line.size):
        target[o] += factor * line[o]


@inner()
def _add_squares(lines, matrix):
    """Add half the products of lines with themselves."""
    products = np.dot(lines.T, lines)
    for i in range(products.shape[0]):
        _add_line(0.5, products[i], matrix[i])


@inner()
def _add_wings(levels, samples, flux, i, out):
    """Add the B-splines of pixel i in the level of wings, times the light; all knots' values."""
    level = _wide(levels)
    side, h = levels.side[level], levels.spacing[level]
    wx, wy, spare = np.empty(4), np.empty(4), np.empty(4)
    for n in range(samples.first[i], samples.first[i + 1]):
        light = flux[samples.source[n]] * samples.size[n]
        column = _splines(samples.a[n] / h, side, wx, spare)
        row = _splines(samples.b[n] / h, side, wy, spare)
        for q in range(max(0, -row), min(4, side - row)):
            for p in range(max(0, -column), min(4, side - column)):
                out[(row + q) * side + column + p] += light * wx[p] * wy[q]


@inner()
def _add_variation(levels, field, samples, flux, weight, matrix):
    """Add what the level that varies over the field shares with itself, sample by sample.

    And with the wings. Within a source the terms of the field are constant, so its samples make one
    matrix of knots, which is multiplied by the terms' products; those of many sources at once are a
    matrix product.
    """
    side, h, start = levels.side[1], levels.spacing[1], levels.start[1]
    low, high = levels.low[1], levels.high[1]
    terms, sources, knots = high - low, field.shape[0], side * side
    owner = np.empty(samples.source.size, np.int64)
    for i in range(weight.size):
        owner[samples.first[i] : samples.first[i + 1]] = i
    order, first = _by_source(samples, sources)
    wings = matrix.shape[0] - levels.start[2] if levels.side.size > 2 else 0
    total, wide = np.zeros((knots * 4 * NEAR, terms * terms)), np.zeros((terms, knots * wings))
    grams, products = np.empty((TOGETHER, knots, 4 * NEAR)), np.empty((TOGETHER, terms * terms))
    crosses, line = np.empty((TOGETHER, knots, wings)), np.empty(wings)
    wx, wy, spare = np.empty(4), np.empty(4), np.empty(4)
    for begin in range(0, sources, TOGETHER):
        some = min(TOGETHER, sources - begin)
        grams[:some], crosses[:some] = 0.0, 0.0
        for m in range(some):
            s = begin + m
            for n in order[first[s] : first[s + 1]]:
                light = flux[s] * samples.size[n]
                _add_gram(samples, n, (side, h), weight[owner[n]] * light**2, grams[m])
                if wings == 0:
                    continue
                i = _splines(samples.a[n] / h, side, wx, spare)
                j = _splines(samples.b[n] / h, side, wy, spare)
                if i <= -4 or j <= -4 or i >= side or j >= side:
                    continue
                line[:] = 0.0
                _add_wings(levels, samples, flux, owner[n], line)
                for q in range(max(0, -j), min(4, side - j)):
                    for p in range(max(0, -i), min(4, side - i)):
                        share = weight[owner[n]] * light * wx[p] * wy[q]
                        _add_line(share, line, crosses[m, (j + q) * side + i + p])
            for t in range(terms):
                for o in range(terms):
                    products[m, t * terms + o] = field[s, low + t] * field[s, low + o]
        total += np.dot(grams.reshape(TOGETHER, -1)[:some].T, products[:some])
        own = np.ascontiguousarray(field[begin : begin + some, low:high].T)
        if wings > 0:
            wide += np.dot(own, crosses.reshape(TOGETHER, -1)[:some])
    for knot in range(knots):
        for o in range(4 * NEAR):
            i, j = knot % side + o % NEAR - NEAR // 2, knot // side + o // NEAR
            if 0 <= i < side and j < side:
                row, column = start + knot * terms, start + (j * side + i) * terms
                both = total[knot * 4 * NEAR + o]
                for t in range(terms):
                    squares = both[t * terms : (t + 1) * terms]
                    _add_line(1.0, squares, matrix[row + t, column : column + terms])
        for t in range(terms):
            own = wide[t, knot * wings : (knot + 1) * wings]
            _add_line(1.0, own, matrix[start + knot * terms + t, matrix.shape[0] - wings :])


@inner()
def _room(levels, samples, pixels):
    """Runs with room for those of any pixel."""
    crowd, width = 1, 0
    for i in range(pixels):
        crowd = max(crowd, samples.first[i + 1] - samples.first[i])
    for level in range(levels.side.size):
        width += KNOTS * (levels.high[level] - levels.low[level])
    most = crowd * 4 * levels.side.size
    return _Runs(
        np.empty(most, np.int64), np.empty(most, np.int64), np.zeros(most + 1, np.int64),
        np.empty(crowd * width),
    )  # fmt: skip


@inner()
def _runs_of(grids, samples, flux, i, runs, scaled):
    """Fill the runs of pixel i, given levels and field; returns their number."""
    (levels, field), size = grids, 0
    for n in range(samples.first[i], samples.first[i + 1]):
        s = samples.source[n]
        for t in range(scaled.size):
            scaled[t] = flux[s] * samples.size[n] * field[s, t]
        size = _add_runs(levels, samples, n, scaled, runs, size)
    return size


@inner()
def _add_outer(runs, size, weight, line, begin, matrix):
    """Add weight times the outer product of the runs of levels that do not vary with a line."""
    for r in range(size):
        if runs.sample[r] < 0:
            for k in range(runs.first[r], runs.first[r + 1]):
                share = weight * runs.values[k]
                _add_line(share, line, matrix[runs.begin[r] + k - runs.first[r], begin:])


@entry()
def psf_information(levels, field, samples, pixels, templates):
    """The information about all coefficients, beside the templates and the background's terms.

    `pixels` are the flux of every source, and of every pixel the weight and the background's terms;
    `templates` has shape (3, samples). Returns the matrix of the coefficients, shape (c, c), of
    which the sum with its transpose is the information; the couplings with the templates, shape (3
    sources, c); and with the background's terms, shape (c, terms).
    """
    flux, weight, background = pixels
    last, wide = levels.side.size - 1, _wide(levels)
    total = levels.start[last] + levels.side[last] ** 2 * (levels.high[last] - levels.low[last])
    matrix, others = np.zeros((total, total)), np.zeros((total, background.shape[1]))
    coupling = np.zeros((TEMPLATES * flux.size, total))
    runs, scaled = _room(levels, samples, weight.size), np.empty(field.shape[1])
    begin = levels.start[wide] if wide <= last else total
    lines, filled = np.zeros((LINES, total - begin)), 0
    for i in range(weight.size):
        w = weight[i]
        if w == 0.0:
            continue
        size = _runs_of((levels, field), samples, flux, i, runs, scaled)
        _add_square(runs, size, w, matrix)
        _add_columns(runs, size, w * background[i], others)
        for n in range(samples.first[i], samples.first[i + 1]):
            for m in range(TEMPLATES):
                target = coupling[TEMPLATES * samples.source[n] + m]
                _add_row(runs, size, w * templates[m, n], target)
        if wide <= last and samples.first[i + 1] > samples.first[i]:
            line = lines[filled]
            line[:] = 0.0
            _add_wings(levels, samples, flux, i, line)
            _add_outer(runs, size, w, line, begin, matrix)
            for m in range(background.shape[1]):
                _add_line(w * background[i, m], line, others[begin:, m])
            for n in range(samples.first[i], samples.first[i + 1]):
                for m in range(TEMPLATES):
                    target = coupling[TEMPLATES * samples.source[n] + m]
                    _add_line(w * templates[m, n], line, target[begin:])
            line *= math.sqrt(w)
            filled += 1
            if filled == LINES:
                _add_squares(lines, matrix[begin:, begin:])
                filled = 0
    _add_squares(lines[:filled], matrix[begin:, begin:])
    if levels.high[-1 if wide > last else -2] > 1:
        _add_variation(levels, field, samples, flux, weight, matrix)
    return matrix, coupling, others


@entry()
def psf_slope(levels, field, samples, flux, score):
    """The log-likelihood's slope by all coefficients, shape (c,), given that by every pixel."""
    last, wide = levels.side.size - 1, _wide(levels)
    total = levels.start[last] + levels.side[last] ** 2 * (levels.high[last] - levels.low[last])
    out, runs = np.zeros(total), _room(levels, samples, score.size)
    scaled, begin = np.empty(field.shape[1]), levels.start[wide] if wide <= last else total
    line = np.empty(total - begin)
    for i in range(score.size):
        size = _runs_of((levels, field), samples, flux, i, runs, scaled)
        _add_row(runs, size, score[i], out)
        if wide <= last and samples.first[i + 1] > samples.first[i]:
            line[:] = 0.0
            _add_wings(levels, samples, flux, i, line)
            _add_line(score[i], line, out[begin:])
    return out
