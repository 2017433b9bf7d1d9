"""Log p of one read noise from a table, for photons with read noise.

The function g of `poisson_gaussian` has one variable, so that a table of it gives log p for a
logarithm and a polynomial, whatever the read noise. If r >= 1 it has polynomials of degree 4 on
cells of width 1/8, which are right to 5e-10 of the fifth derivative, the fifth cumulant of k, which
is below r^2. If r < 1 its range, up to n / r^2, is longer, and cells that the fastest cache does
not hold cost more than further terms. So there the degree is 6 on cells of width 1/2, right to
2e-10 of the seventh cumulant, which is below 1. Rounding counts where g is large, so the table ends
at `WIDEST`; the formulas are used for brighter pixels.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.special import wrightomega

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST, as_bits
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.kernels.poisson_gaussian import WIDE, density_of, kind_of, left_out

NEAREST = 6755399441055744.0  # added to a number, it leaves the nearest integer in the lowest bits
NEAREST_BITS = int(np.float64(NEAREST).view(np.int64))
FINE, FEW = 0.125, 5  # width of the cells of the table of g, and coefficients of its polynomials
COARSE, MANY = 0.5, 7  # the same for read noise below 1
WIDEST = 4096.0  # the largest n / r^2 that it serves
MARGIN = 28.0  # of its range: g(1 / 2 r^2 - 28) is below 1e-12, and exp(28) no expected count


class CumulantTable(NamedTuple):
    """The function g of one read noise, in cells whose middles are `first` + i / `density`."""

    first: float
    last: float  # number of the last cell
    density: float
    terms: tuple[int, ...]  # of a polynomial, their number as the length of a tuple
    # (terms cells,) polynomials in the distance from the middle in cells, 1 first; the last cell is
    # zero
    cells: Floats
    left_out: Floats  # (segments,) what a segment's sum leaves out; MASKED if it is too bright


@inner(fastmath=FAST, forceinline=True)
def table_cell(table, x, counted):
    """The cell of the table of g at x, and where in it; the cell of zeros if not counted."""
    x = min(max((x - table.first) * table.density, 0.0), table.last)
    x = x if counted else table.last + 1.0
    shifted = x + NEAREST  # rounded, see `fastmath.exp2`
    return as_bits(shifted) - NEAREST_BITS, x - (shifted - NEAREST)


@inner(fastmath=FAST, forceinline=True)
def table_value(table, cell, w):
    """g in a cell; log p without what depends on n alone is that less mu."""
    terms, g = len(table.terms), 0.0
    at = np.uint64(cell) * np.uint64(terms)
    for j in range(terms - 1, -1, -1):
        g = g * w + table.cells[at + np.uint64(j)]
    return g


@entry(fastmath=FAST, error_model="numpy")
def _densities(kind, n, mu, variance, out):
    for i in range(out.size):
        out[i] = density_of(kind, n[i], mu[i], variance)


def cumulant_table(variance: float, values: Floats, segment: int) -> CumulantTable:
    """The table of g for a frame of padded rows, whose segments have `segment` pixels."""
    used = values > LIMIT
    served = np.where(used & (values <= WIDEST * variance), values, 0.0)
    width, terms = (FINE, FEW) if variance >= WIDE else (COARSE, MANY)
    first = 0.5 / variance - MARGIN
    cells = math.ceil((float(served.max()) / variance + MARGIN - first) / width) + 1
    nodes = 0.5 * np.cos(np.pi * (np.arange(terms) + 0.5) / terms)
    x = first + width * (np.arange(cells)[:, None] + nodes)
    # g does not depend on n and mu apart: at the mean itself the density is right to rounding
    mean = np.real(wrightomega(x - math.log(variance))).ravel() * variance
    g = np.empty(mean.size)
    _densities(kind_of(variance), mean, mean, variance, g)
    g += mean + left_out(mean, variance) - _left_out_of_table(mean, variance)
    polynomials = np.linalg.solve(np.vander(nodes, increasing=True), g.reshape(x.shape).T).T
    part = _left_out_of_table(served, variance) - left_out(served, variance)
    left = np.where(used, part, 0.0).reshape(-1, segment).sum(axis=1)
    left[(used & (values > WIDEST * variance)).reshape(-1, segment).any(axis=1)] = MASKED
    padded = np.append(polynomials, np.zeros(terms))
    return CumulantTable(first, cells - 1.0, 1.0 / width, (0,) * terms, padded, left)


def _left_out_of_table(counts: Floats, variance: float) -> Floats:
    """What g less mu leaves out of log p."""
    return -0.5 * (counts * counts / variance + math.log(2.0 * math.pi * variance))
