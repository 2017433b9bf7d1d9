"""Log p of one read noise from a table, for photons with read noise.

The function g of `poisson_gaussian` has one variable, so that a table of it gives log p for a
logarithm and a polynomial, whatever the read noise. On cells of width 1/8 polynomials of degree 4
are right to 5e-10 of the fifth derivative, the fifth cumulant of k given n, which is below r^2 or,
if r < 1, below 1. Wider cells with further terms cost more, also where the fastest cache does not
hold the table. Rounding counts where g is large, so the table ends at `WIDEST`; the formulas are
used for brighter pixels.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import wrightomega

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST, as_bits
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.kernels.poisson_gaussian import density_of, kind_of, left_out

NEAREST = 6755399441055744.0  # added to a number, it leaves the nearest integer in the lowest bits
NEAREST_BITS = int(np.float64(NEAREST).view(np.int64))
WIDTH, TERMS = 0.125, 5  # of the cells of the table of g, and coefficients of its polynomials
WIDEST = 4096.0  # the largest n / r^2 that it serves
MARGIN = 28.0  # of its range: g(1 / 2 r^2 - 28) is below 1e-12, and exp(28) no expected count


class CumulantTable(NamedTuple):
    """The function g of one read noise, in cells of `WIDTH`.

    The first one is zero: it serves masked pixels, and all x for which g is zero.
    """

    slope: float  # x = log(mu) + n / r^2 lies log(mu) / WIDTH + n * slope - start cells from the
    start: float  # middle of the first one
    last: float  # number of the last cell
    cells: Floats  # (TERMS cells,) polynomials in the distance from the middle in cells, 1 first
    left_out: Floats  # (segments,) what a segment's sum leaves out; MASKED if it is too bright


@inner(fastmath=FAST, forceinline=True)
def table_cell(table, n, log_mu):
    """The cell of the table of g, and where in it."""
    x = log_mu * (1.0 / WIDTH) + (n * table.slope - table.start)
    x = min(max(x, 0.0), table.last)
    shifted = x + NEAREST  # rounded, see `fastmath.exp2`
    return as_bits(shifted) - NEAREST_BITS, x - (shifted - NEAREST)


@inner(fastmath=FAST, forceinline=True)
def table_value(table, cell, w):
    """g in a cell; log p without what depends on n alone is that less mu."""
    at, g = np.uint64(cell) * np.uint64(TERMS), 0.0
    for j in range(TERMS - 1, -1, -1):
        g = g * w + table.cells[at + np.uint64(j)]
    return g


@entry(fastmath=FAST)
def _densities(kind, n, mu, variance, out):
    for i in range(out.size):
        out[i] = density_of(kind, n[i], mu[i], variance)


def cumulant_table(variance: float, values: Floats, segment: int) -> CumulantTable:
    """The table of g for a frame of padded rows, whose segments have `segment` pixels."""
    used = values > LIMIT
    served = np.where(used & (values <= WIDEST * variance), values, 0.0)
    first = 0.5 / variance - MARGIN
    cells = math.ceil((float(served.max()) / variance + MARGIN - first) / WIDTH) + 1
    nodes = 0.5 * np.cos(np.pi * (np.arange(TERMS) + 0.5) / TERMS)
    x = first + WIDTH * (np.arange(cells)[:, None] + nodes)
    # g does not depend on n and mu apart: at the mean itself the density is right to rounding
    mean = np.real(wrightomega(x - math.log(variance))).ravel() * variance
    g = np.empty(mean.size)
    _densities(kind_of(variance), mean, mean, variance, g)
    g += mean + left_out(mean, variance) - _left_out_of_table(mean, variance)
    polynomials = np.linalg.solve(np.vander(nodes, increasing=True), g.reshape(x.shape).T).T
    part = _left_out_of_table(served, variance) - left_out(served, variance)
    left = np.where(used, part, 0.0).reshape(-1, segment).sum(axis=1)
    left[(used & (values > WIDEST * variance)).reshape(-1, segment).any(axis=1)] = MASKED
    padded = np.append(np.zeros(TERMS), polynomials)
    return CumulantTable(1.0 / (WIDTH * variance), first / WIDTH - 1.0, float(cells), padded, left)


def _left_out_of_table(counts: Floats, variance: float) -> Floats:
    """What g less mu leaves out of log p."""
    return -0.5 * (counts * counts / variance + math.log(2.0 * math.pi * variance))
