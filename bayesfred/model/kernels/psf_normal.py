"""The normal equations of a PSF that is measured on a frame.

The PSF of a source is a sum of cubic B-splines on square grids ("levels"), and over the field every
coefficient is a sum of terms P_t(x, y):

    p(a, b; x, y) = sum_levels sum_knots sum_t c[level, knot, t] P_t(x, y) B(a / h - i) B(b / h - j)

so the expected counts are linear in c. A sample is a pair of a source and a pixel that it reaches,
and a pixel's row of the design matrix is the sum over its samples: overlapping sources share one
row. Beside c every source has three templates: its kernel K, and the derivatives X and Y of its
light as it is shifted along a and along b. The distortion's coefficients act through X and Y, so
the equations hold for them too.

Within a source the terms of the field are constant. So its samples make one matrix of 16 by 16
products each, and the products of the terms multiply that matrix as a whole:

    information[(knot, t), (knot', t')] = sum_s P_t(s) P_t'(s) gram_s[knot, knot']

of many sources at once this is a matrix product. A level h has a spline on knots 2 h apart as an
exact sum of finer ones, so that what two levels share follows from the grams of the finer one.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.model.kernels.psf_grids import (
    EDGE,
    NEAR,
    ROWS,
    add_crosses,
    add_light,
    add_spline,
    add_squares,
    add_values,
)
from bayesfred.model.kernels.psf_pairs import TEMPLATES, add_pairs
from bayesfred.model.kernels.psf_samples import SourceSamples

ROOM = 2**20  # numbers that the matrices of several sources together have at most
HALVED = (1.0, 4.0, 6.0, 4.0, 1.0)  # a cubic B-spline in those on knots half as far apart, eighths


class Levels(NamedTuple):
    """The grids of B-splines; coefficient (knot, t) of level l is start + knot (high - low) + t.

    The first grid is the fine one. What varies over the field is on one twice as coarse; wings are
    on a coarser one, and do not vary.
    """

    start: Ints  # (l,) a level's first coefficient
    side: Ints  # (l,) knots along one axis
    low: Ints  # (l,) first term of the field
    high: Ints  # (l,) the term after the last
    spacing: Floats  # (l,) pixel

    def size(self) -> int:
        """How many coefficients there are."""
        return int(self.start[-1] + self.side[-1] ** 2 * (self.high[-1] - self.low[-1]))

    def terms(self, k: int) -> slice:
        """The terms of the field that level k has."""
        return slice(int(self.low[k]), int(self.high[k]))

    def shape(self, k: int) -> tuple[int, int, int]:
        """Of level k's coefficients: knots along b and along a, terms."""
        return int(self.side[k]), int(self.side[k]), int(self.high[k] - self.low[k])

    def where(self, k: int) -> slice:
        """Where level k's coefficients are."""
        return slice(int(self.start[k]), int(self.start[k]) + math.prod(self.shape(k)))

    def part(self, k: int, values: Floats) -> Floats:
        """Level k's own along the last axis, shape (..., side, side, terms)."""
        return values[..., self.where(k)].reshape(*values.shape[:-1], *self.shape(k))

    def block(self, k: int, other: int, matrix: Floats) -> Floats:
        """What two levels share, shape (side, side, terms, side, side, terms)."""
        own = matrix[self.where(k), self.where(other)]
        return own.reshape(*self.shape(k), *self.shape(other))


class _Kinds(NamedTuple):
    """Which levels are which, by number."""

    levels: Levels
    narrow: list[int]  # all but the wings
    varying: list[int]
    wings: list[int]
    side: int  # of a fine grid that has room for all but the wings

    @classmethod
    def of(cls, levels: Levels) -> "_Kinds":
        every = range(levels.side.size)
        varying = [k for k in every if levels.low[k] > 0]
        wings = [k for k in every if levels.spacing[k] > levels.spacing[0] and k not in varying]
        sides = [int(levels.side[0]), *(2 * int(levels.side[k]) + 3 for k in varying)]
        narrow = [k for k in every if k not in wings]
        return cls(levels, narrow, varying, wings, max(sides))

    def inside(self, side: int) -> slice:
        """Where so many knots are among those of the fine grid."""
        edge = (self.side - side) // 2
        return slice(edge, self.side - edge)

    def refined(self, side: int) -> Floats:
        """The matrix from a coarser grid's coefficients along an axis to those on the fine grid."""
        out = np.zeros((self.side, side))
        out[self.inside(2 * side + 3)] = halved(side)
        return out

    def on_level(self, k: int, sums: Floats) -> Floats:
        """Sums of the fine grid's splines, along the last two axes, as those of a level's."""
        side = int(self.levels.side[k])
        if k not in self.varying:
            return sums[..., self.inside(side), self.inside(side)]
        finer = self.refined(side)
        return np.asarray(finer.T @ sums @ finer)


def halved(side: int) -> Floats:
    """The matrix from splines' coefficients to those on knots half as far apart, a row each."""
    out = np.zeros((2 * side + 3, side))
    for k, share in enumerate(HALVED):
        out[2 * np.arange(side) + k, np.arange(side)] = share / 8.0
    return out


def _padded(side: int) -> int:
    return side + 2 * EDGE


def _own(values: Floats) -> Floats:
    """Without the EDGE knots around a grid along axes 1 and 2."""
    return values[:, EDGE:-EDGE, EDGE:-EDGE]


def sample_psf(
    levels: Levels, field: Floats, samples: SourceSamples, coefficients: Floats
) -> Floats:
    """p, p_a and p_b at every sample, shape (3, samples), per square pixel.

    Parameters
    ----------
    levels : Levels
    field : ndarray, shape (s, terms)
        The field's terms of every source, of which the first is 1.
    samples : SourceSamples
    coefficients : ndarray, shape (c,), per square pixel

    Returns
    -------
    ndarray, shape (3, samples)
    """
    kinds, out = _Kinds.of(levels), np.zeros((3, samples.source.size))
    terms = np.zeros((field.shape[1], kinds.side, kinds.side))
    for k in kinds.narrow:
        own, side = np.moveaxis(levels.part(k, coefficients), -1, 0), int(levels.side[k])
        if k in kinds.varying:
            finer = halved(side)
            own, side = finer @ own @ finer.T, len(finer)
        terms[levels.terms(k), kinds.inside(side), kinds.inside(side)] += own
    splines = np.tensordot(field, terms, 1) if len(terms) > 1 else terms
    sums = [(levels.spacing[0], splines)]
    for k in kinds.wings:
        sums.append((levels.spacing[k], np.moveaxis(levels.part(k, coefficients), -1, 0)))
    for spacing, c in sums:
        add_spline(np.pad(c, [(0,), (EDGE,), (EDGE,)]), spacing, samples, out)
    return out


def psf_slope(
    levels: Levels, field: Floats, samples: SourceSamples, flux: Floats, score: Floats
) -> Floats:
    """The log-likelihood's slope by all coefficients, given that by every pixel.

    Parameters
    ----------
    levels, field, samples
        As for `sample_psf`.
    flux : ndarray, shape (s,), counts
    score : ndarray, shape (pixels,)

    Returns
    -------
    ndarray, shape (c,)
    """
    kinds, out = _Kinds.of(levels), np.zeros(levels.size())
    values = flux[samples.source] * samples.size * np.repeat(score, np.diff(samples.first))
    every = np.arange(values.size)

    def sums(spacing: float, side: int, sources: int) -> Floats:
        room = np.zeros((sources, _padded(side), _padded(side), 1))
        add_values(spacing, samples, (0, every), values[:, None], room)
        return _own(room)[..., 0]

    fine = np.tensordot(field.T, sums(levels.spacing[0], kinds.side, len(field)), 1)
    for k in kinds.narrow:
        own = kinds.on_level(k, fine[levels.terms(k)])
        levels.part(k, out)[:] = np.moveaxis(own, 0, -1)
    for k in kinds.wings:
        levels.part(k, out)[..., 0] = sums(levels.spacing[k], int(levels.side[k]), 1)[0]
    return out


class _Weighed(NamedTuple):
    """The samples and what they weigh."""

    samples: SourceSamples
    light: Floats  # (samples,)
    weight: Floats  # (samples,) of their pixels
    field: Floats  # (s, terms)

    def batches(self, numbers: int) -> Iterator[tuple[slice, tuple[int, Ints]]]:
        """Sources and their samples, as many together as have room with so many numbers each."""
        source, together, size = self.samples.source, max(1, ROOM // numbers), len(self.field)
        order = np.argsort(source, kind="stable")
        ends = np.searchsorted(source[order], np.arange(size + 1))
        for begin in range(0, size, together):
            end = min(begin + together, size)
            yield slice(begin, end), (begin, order[ends[begin] : ends[end]])


def psf_information(
    levels: Levels,
    field: Floats,
    samples: SourceSamples,
    pixels: tuple[Floats, Floats, Floats],
    templates: Floats,
) -> tuple[Floats, Floats, Floats]:
    """The information about all coefficients, beside the templates and the background's terms.

    Parameters
    ----------
    levels, field, samples
        As for `sample_psf`.
    pixels : tuple of ndarray
        The flux of every source, and of every pixel the weight and the background's terms.
    templates : ndarray, shape (3, samples)

    Returns
    -------
    matrix : ndarray, shape (c, c)
        Its sum with its transpose is the information.
    coupling : ndarray, shape (3 s, c)
        With the templates.
    others : ndarray, shape (c, terms)
        With the background's terms.
    """
    flux, weight, background = pixels
    kinds, size = _Kinds.of(levels), levels.size()
    owner = np.repeat(np.arange(weight.size), np.diff(samples.first))
    light = flux[samples.source] * samples.size
    weighed = _Weighed(samples, light, weight[owner], field)
    matrix, coupling = np.zeros((size, size)), np.zeros((TEMPLATES * flux.size, size))
    others = np.zeros((background.shape[1], size))
    columns = np.concatenate([templates, background.T[:, owner]]).T * weighed.weight[:, None]
    _add_narrow(kinds, weighed, matrix)
    _add_columns(kinds, weighed, columns, coupling, others)
    if kinds.wings:
        _add_wings(kinds, weighed, columns, matrix, coupling, others)
    if np.diff(samples.first).max(initial=0) > 1:
        narrow = Levels._make(each[kinds.narrow] for each in levels)
        add_pairs((narrow, field), samples, (light, weight), templates, matrix, coupling)
    return matrix, coupling, others.T


def _grams(weighed: _Weighed, grid: tuple[float, int], factors: Floats) -> Floats:
    """The sum of all sources' products of splines times factors.

    Shape (side, side, ROWS, NEAR, factors), see `add_squares`.
    """
    spacing, side = grid
    out = np.zeros((side * side * ROWS * NEAR, factors.shape[1]))
    squares = weighed.weight * weighed.light**2
    for some, order in weighed.batches(len(out)):
        each = np.zeros((some.stop - some.start, _padded(side), _padded(side), ROWS, NEAR))
        add_squares(spacing, weighed.samples, order, squares, each)
        out += _own(each).reshape(len(each), -1).T @ factors[some]
    return out.reshape(side, side, ROWS, NEAR, -1)


def _fill(grams: Floats, block: Floats) -> None:
    """Write products of splines, shape (side, side, ROWS, NEAR, terms, terms), into a block."""
    n = len(grams)
    target = np.moveaxis(block, 2, 4)  # (side, side, side, side, terms, terms)
    for row in range(min(ROWS, n)):
        for column in range(-(NEAR // 2), NEAR // 2 + 1):
            j, i = np.arange(n - row)[:, None], np.arange(max(0, -column), n - max(0, column))
            target[j, i, j + row, i + column] = grams[j, i, row, column + NEAR // 2]


def _add_narrow(kinds: _Kinds, weighed: _Weighed, matrix: Floats) -> None:
    """Add what the levels but the wings share."""
    levels = kinds.levels
    side, field, first = kinds.side, weighed.field, kinds.inside(int(levels.side[0]))
    fine = _grams(weighed, (levels.spacing[0], side), field)
    _fill(fine[first, first, :, :, :1, None], levels.block(0, 0, matrix))
    for k in kinds.varying:
        terms, cross = levels.terms(k), levels.block(0, k, matrix)
        for t in range(terms.start, terms.stop):
            half = np.zeros((side, side, 1, side, side, 1))
            _fill(fine[..., t, None, None], half)
            square = half.reshape(side * side, -1)
            both = (square + square.T).reshape((side,) * 4)[first, first]
            cross[:, :, 0, :, :, t - terms.start] = kinds.on_level(k, both)
        row, column = np.triu_indices(terms.stop - terms.start)
        own = field[:, terms]
        grams = _grams(
            weighed, (levels.spacing[k], int(levels.side[k])), own[:, row] * own[:, column]
        )
        every = np.empty((*grams.shape[:-1], *(terms.stop - terms.start,) * 2))
        every[..., row, column] = every[..., column, row] = grams
        _fill(every, levels.block(k, k, matrix))


def _add_columns(
    kinds: _Kinds,
    weighed: _Weighed,
    columns: Floats,
    coupling: Floats,
    others: Floats,
) -> None:
    """Add what the levels but the wings share with the templates and the background's terms.

    `columns` are the weighed ones of both at every sample, the templates of its own source.
    """
    levels = kinds.levels
    values = columns * weighed.light[:, None]
    samples, side = weighed.samples, _padded(kinds.side)
    for some, order in weighed.batches(side**2 * values.shape[1]):
        sums = np.zeros((some.stop - some.start, side, side, values.shape[1]))
        add_values(levels.spacing[0], samples, order, values, sums)
        sums = np.ascontiguousarray(np.moveaxis(_own(sums), -1, 1))
        rows = coupling[TEMPLATES * some.start : TEMPLATES * some.stop]
        for k in kinds.narrow:
            own, terms = kinds.on_level(k, sums), weighed.field[some, levels.terms(k)]
            levels.part(k, others)[:] += np.tensordot(own[:, TEMPLATES:], terms, (0, 0))
            own = own[:, :TEMPLATES].reshape(len(rows), -1, 1)
            np.matmul(
                own,
                np.repeat(terms, TEMPLATES, 0)[:, None],
                rows[:, levels.where(k)].reshape(*own.shape[:2], -1),
            )


def _add_wings(
    kinds: _Kinds,
    weighed: _Weighed,
    columns: Floats,
    matrix: Floats,
    coupling: Floats,
    others: Floats,
) -> None:
    """Add what the level of wings shares, with all samples of a pixel together."""
    levels, k, samples, field = kinds.levels, kinds.wings[0], weighed.samples, weighed.field
    wide, inside = _padded(int(levels.side[k])), slice(EDGE, -EDGE)
    light, squares = (levels.spacing[k], weighed.light), weighed.light * weighed.weight

    def shared(other: int) -> Floats:
        side, terms = _padded(int(levels.side[other])), field[:, levels.terms(other)]
        out = np.zeros((side, side, wide, wide * terms.shape[1]))
        terms = np.ascontiguousarray(terms)
        add_crosses(levels.spacing[other], samples, squares, light, terms, out)
        out = out.reshape(*out.shape[:3], wide, -1)[(inside,) * 4]
        return np.moveaxis(out, 4, 2)  # (side, side, terms, side, side)

    for narrow in kinds.narrow:
        levels.block(narrow, k, matrix)[..., 0] = shared(narrow)
    levels.block(k, k, matrix)[..., 0] = 0.5 * shared(k)
    lit = np.zeros((len(field), TEMPLATES, wide, wide))
    add_light(samples, light, columns, lit)
    rows = levels.part(k, coupling)[..., 0]
    rows[:] = lit[..., inside, inside].reshape(rows.shape)
    every = 0, np.arange(samples.source.size)
    sums = np.zeros((1, wide, wide, columns.shape[1]))
    add_values(levels.spacing[k], samples, every, columns * weighed.light[:, None], sums)
    levels.part(k, others)[..., 0] = np.moveaxis(_own(sums)[0, :, :, TEMPLATES:], -1, 0)
