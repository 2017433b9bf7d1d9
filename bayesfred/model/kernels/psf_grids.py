"""Sums over the samples of a measured PSF, with the B-splines of one square grid.

`psf_normal` makes normal equations of them. Around a grid there are EDGE knots more, where samples
beyond it add what nobody reads. `some` are samples, after the number of the source that the sums
begin with; sums with room for one source are over all.
"""

import numpy as np

from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.imaging.kernels.splines import spline_cell, spline_slopes

EDGE = 4  # knots, as `spline_cell` asks for
NEAR = 7  # columns on which B-splines overlap one
ROWS = 4  # rows on which they do, from its own on


@inner()
def find_splines(spacing, samples, n, side, wx, wy):
    """The first knot along a and along b of the 16 around a sample, and their splines."""
    i, x = spline_cell(side, samples.a[n] / spacing)
    j, y = spline_cell(side, samples.b[n] / spacing)
    for f, weights in ((x, wx), (y, wy)):
        g = 1.0 - f
        weights[0], weights[3] = g * g * g / 6.0, f * f * f / 6.0
        weights[1] = 2.0 / 3.0 - f * f * (1.0 - 0.5 * f)
        weights[2] = 2.0 / 3.0 - g * g * (1.0 - 0.5 * g)
    return i, j


@inner(fastmath=FAST)
def _add_line(factor, line, target):
    for o in range(line.size):
        target[o] += factor * line[o]


@entry()
def add_spline(c, spacing, samples, out):
    """Add p, p_a and p_b to `out`, shape (3, samples), of a spline a source or one for all."""
    side = c.shape[1]
    for n in range(samples.source.size):
        i, x = spline_cell(side, samples.a[n] / spacing)
        j, y = spline_cell(side, samples.b[n] / spacing)
        own = c[min(samples.source[n], c.shape[0] - 1)]
        p, p_x, p_y = spline_slopes(own, j * side + i, y, x)
        out[0, n] += p
        out[1, n] += p_x / spacing
        out[2, n] += p_y / spacing


@entry()
def add_values(spacing, samples, some, values, out):
    """Add B-splines times the samples' values to `out`, shape (s, side, side, values)."""
    (begin, order), side = some, out.shape[1]
    wx, wy = np.empty(4), np.empty(4)
    for n in order:
        i, j = find_splines(spacing, samples, n, side, wx, wy)
        own = out[min(samples.source[n] - begin, out.shape[0] - 1)]
        for q in range(4):
            for p in range(4):
                _add_line(wx[p] * wy[q], values[n], own[j + q, i + p])


@inner(fastmath=FAST)
def _add_square(weight, wx, wy, gram):
    for q in range(4):
        for p in range(4):
            line, own = gram[q, p], weight * wx[p] * wy[q]
            line[0, NEAR // 2] += 0.5 * own * wx[p] * wy[q]
            for o in range(p + 1, 4):
                line[0, NEAR // 2 + o - p] += own * wx[o] * wy[q]
            for r in range(q + 1, 4):
                for o in range(4):
                    line[r - q, NEAR // 2 + o - p] += own * wx[o] * wy[r]


@entry()
def add_squares(spacing, samples, some, weight, out):
    """Add products of B-splines times weights to `out`, shape (s, side, side, ROWS, NEAR).

    A knot has products with itself, halved, and with knots up to three columns and rows on.
    """
    (begin, order), side = some, out.shape[1]
    wx, wy = np.empty(4), np.empty(4)
    for n in order:
        i, j = find_splines(spacing, samples, n, side, wx, wy)
        _add_square(weight[n], wx, wy, out[samples.source[n] - begin, j : j + 4, i : i + 4])


@inner()
def _fill_light(samples, pixel, light, out, low, high):
    """The light of a pixel's samples, times their B-splines.

    `light` are the spacing of the splines' grid and the samples' light. Of every row of `out`, the
    columns from `low` to `high` may hold some; they are emptied first.
    """
    (spacing, every), side = light, out.shape[0]
    wx, wy = np.empty(4), np.empty(4)
    for row in range(side):
        out[row, low[row] : high[row]] = 0.0
        low[row], high[row] = side, 0
    for n in range(samples.first[pixel], samples.first[pixel + 1]):
        i, j = find_splines(spacing, samples, n, side, wx, wy)
        for q in range(4):
            low[j + q], high[j + q] = min(low[j + q], i), max(high[j + q], i + 4)
            for p in range(4):
                out[j + q, i + p] += every[n] * wx[p] * wy[q]


@inner()
def _no_light(side):
    """An empty grid, and the columns that hold light in its rows."""
    return np.zeros((side, side)), np.full(side, side), np.zeros(side, np.int64)


@inner(fastmath=FAST)
def _add_rows(factor, lines, low, high, terms, target):
    for row in range(low.size):
        for o in range(terms * low[row], terms * high[row]):
            target[row, o] += factor * lines[row, o]


@entry()
def add_light(samples, light, values, out):
    """Add the light of the samples' pixels times values, shape (s, values, side, side)."""
    lit, low, high = _no_light(out.shape[2])
    for pixel in range(samples.first.size - 1):
        _fill_light(samples, pixel, light, lit, low, high)
        for n in range(samples.first[pixel], samples.first[pixel + 1]):
            for k in range(out.shape[1]):
                _add_rows(values[n, k], lit, low, high, 1, out[samples.source[n], k])


@entry()
def add_crosses(spacing, samples, weight, light, field, out):
    """Add B-splines times weights, the light of the samples' pixels and the field's terms.

    `out` has the shape (side, side, side of the light's grid, side of it times terms).
    """
    side, terms = out.shape[0], field.shape[1]
    wx, wy = np.empty(4), np.empty(4)
    lit, low, high = _no_light(out.shape[2])
    each = np.empty((low.size, low.size * terms))
    for pixel in range(samples.first.size - 1):
        _fill_light(samples, pixel, light, lit, low, high)
        for n in range(samples.first[pixel], samples.first[pixel + 1]):
            i, j = find_splines(spacing, samples, n, side, wx, wy)
            if min(i, j) == 0 or max(i, j) == side - EDGE:
                continue
            for row in range(low.size):
                for column in range(low[row], high[row]):
                    for t in range(terms):
                        at = column * terms + t
                        each[row, at] = lit[row, column] * field[samples.source[n], t]
            for q in range(4):
                for p in range(4):
                    factor = weight[n] * wx[p] * wy[q]
                    _add_rows(factor, each, low, high, terms, out[j + q, i + p])
