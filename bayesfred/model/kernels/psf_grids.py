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
def _fill_light(samples, n, light, out):
    """The light of all samples of sample n's pixel, times their B-splines.

    `light` are the spacing of the splines' grid, the samples' pixels and their light.
    """
    spacing, owner, every = light
    pixel = owner[n]
    wx, wy = np.empty(4), np.empty(4)
    out[:] = 0.0
    for n in range(samples.first[pixel], samples.first[pixel + 1]):
        i, j = find_splines(spacing, samples, n, out.shape[0], wx, wy)
        for q in range(4):
            for p in range(4):
                out[j + q, i + p] += every[n] * wx[p] * wy[q]


@entry()
def add_light(samples, light, values, out):
    """Add the light of the samples' pixels times values, shape (s, values, side, side)."""
    lit = np.empty((out.shape[2], out.shape[3]))
    for n in range(samples.source.size):
        _fill_light(samples, n, light, lit)
        for k in range(out.shape[1]):
            _add_line(values[n, k], lit.ravel(), out[samples.source[n], k].ravel())


@entry()
def add_crosses(spacing, samples, some, weight, light, out):
    """Add B-splines times weights and the light of the samples' pixels.

    `out` has the shape (s, side, side, side of the light's grid, side of it).
    """
    (begin, order), side = some, out.shape[1]
    wx, wy, lit = np.empty(4), np.empty(4), np.empty((out.shape[3], out.shape[4]))
    for n in order:
        i, j = find_splines(spacing, samples, n, side, wx, wy)
        if min(i, j) == 0 or max(i, j) == side - EDGE:
            continue
        _fill_light(samples, n, light, lit)
        own = out[min(samples.source[n] - begin, out.shape[0] - 1)]
        for q in range(4):
            for p in range(4):
                target = own[j + q, i + p].ravel()
                _add_line(weight[n] * wx[p] * wy[q], lit.ravel(), target)
