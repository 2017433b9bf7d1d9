"""The unknown part of a PSF: grids of B-splines, what is thought of them before, and their sum.

The start's spline c0 is kept, and deviations from it are looked for on two grids: a fine one for
the PSF at the field's middle, and one twice as coarse, whose splines are exact sums of finer ones,
for its variation over the field. A third one, eight times as coarse (or four times, where sources
leave little room) and three times as wide, is for wings that the fine one cannot hold.

Before the counts speak, a block of deviations (a grid and a term of the field) is a smooth function
within an envelope E(r), which falls off as a PSF's wings do, or a pedestal under every star could
not be told from the background: with z = c / E its log-density is

    -strength / 2 (sum of squared second differences of z) - AMPLITUDE / 2 (sum of z^2)

and the counts choose the strength: the evidence is largest where strength z^T Q z is the number of
differences that the counts determine (D. MacKay, "Bayesian interpolation", Neural Computation 4
(1992), Eq. 4.11).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import sparse

from bayesfred._typing import Floats
from bayesfred.imaging.psf.field import field_powers
from bayesfred.model.kernels.psf_normal import Levels, halved

AMPLITUDE = 0.03  # 1 over the square of the 6 knots in a FWHM: a bump of that size is E high
STRENGTH = 100.0  # to begin with
LEAST_WINGS = 6  # knots of the grid for wings along a radius
LIMITS = (1e-3, 1e6)  # of a strength: the evidence would take a good start for exact


class PsfBlock(NamedTuple):
    """A block of deviations: where it is among all, and the two parts of its prior's precision."""

    where: slice
    roughness: sparse.csr_array  # to be multiplied by the strength
    amplitude: Floats  # a diagonal


@dataclass(frozen=True, eq=False)
class PsfNodes:
    """Deviations at the nodes of a grid over the field, on a grid twice as coarse as the fine one.

    Attributes
    ----------
    coefficients : ndarray, shape (nodes, side, side), per square pixel
    strength : float
        Of the prior.
    determined : float
        How many numbers the counts determine.
    """

    coefficients: Floats
    strength: float
    determined: float

    @property
    def number(self) -> int:
        """Of nodes along each axis of the field."""
        return math.isqrt(len(self.coefficients))

    def splines(self, weights: sparse.csr_array) -> Floats:
        """The coefficients of sources, given the nodes' weights, shape (s, side, side)."""
        side = self.coefficients.shape[1]
        every = weights @ self.coefficients.reshape(weights.shape[1], -1)
        return np.asarray(every).reshape(-1, side, side)


@dataclass(frozen=True, eq=False)
class PsfGrid:
    """The grids of deviations from a start.

    Attributes
    ----------
    oversampling : float
        Fine knots per pixel.
    sigma : float, pixel
        Width of the start.
    degree : int
        Of the variation over the field.
    fine_radius : float, pixel
        Of the fine grid, and of that for the variation over the field.
    wings : float, pixel
        Radius of the grid for wings; 0 where there is none.
    """

    oversampling: float
    sigma: float
    degree: int
    fine_radius: float
    wings: float = 0.0

    @property
    def radius(self) -> float:
        """Distance from the middle that the grids cover, and the splines of wings; pixel."""
        if not self.wings:
            return self.fine_radius
        last = 0.5 * (float(self.levels.side[-1]) + 3.0) * float(self.levels.spacing[-1])
        return max(last, self.fine_radius)

    @cached_property
    def levels(self) -> Levels:
        """The grids as the compiled loops need them: start, fine, then coarser ones."""
        terms = len(field_powers(self.degree))
        rows = [(1, self.fine_radius, 0, 1), (1, self.fine_radius, 0, 1)]
        if terms > 1:
            rows.append((2, self.fine_radius, 1, terms))
        if self.wings:
            # its splines end about there, where the background begins
            times = 8 if self.wings * self.oversampling > 8 * LEAST_WINGS else 4
            rows.append((times, self.wings - 2.0 * times / self.oversampling, 0, 1))
        h = np.array([times / self.oversampling for times, *_ in rows])
        side = np.array(
            [2 * round(radius / step) + 1 for step, (_, radius, *_) in zip(h, rows, strict=True)]
        )
        low, high = np.array([row[2:] for row in rows]).T
        start = np.concatenate([[0], np.cumsum(side**2 * (high - low))])[:-1]
        return Levels(start, side, low, high, h)

    @property
    def fixed(self) -> int:
        """How many coefficients come first that are the start's and are not solved for."""
        return int(self.levels.start[1])

    @cached_property
    def unknown(self) -> Levels:
        """The grids of deviations alone, numbered from 0."""
        every = self.levels
        return Levels(
            every.start[1:] - self.fixed, every.side[1:], every.low[1:], every.high[1:],
            every.spacing[1:],
        )  # fmt: skip

    @cached_property
    def blocks(self) -> list[PsfBlock]:
        """The blocks of deviations."""
        out = []
        levels = self.unknown
        for k, side in enumerate(levels.side):
            terms, envelope = int(levels.high[k] - levels.low[k]), self.envelope(k)
            roughness, amplitude = _roughness(envelope, int(side)), AMPLITUDE / envelope**2
            for t in range(terms):
                begin = int(levels.start[k]) + t
                where = slice(begin, begin + terms * int(side) ** 2, terms)
                out.append(PsfBlock(where, roughness, amplitude))
        return out

    def envelope(self, k: int) -> Floats:
        """E at the knots of a grid of deviations, per square pixel: the wings of a Moffat PSF."""
        n, h = int(self.unknown.side[k]), float(self.unknown.spacing[k])
        x = (np.arange(n) - 0.5 * (n - 1)) * h / (2.0 * self.sigma)
        peak = 1.0 / (2.0 * np.pi * self.sigma**2)
        return np.asarray(peak * (1.0 + x**2 + x[:, None] ** 2) ** -2.0).ravel()

    @cached_property
    def conventions(self) -> Floats:
        """Volume and centroid of every term of the field, shape (3 terms, coefficients).

        The centroid is that within a Gaussian of the start's width. It is that of the fine grid's
        coefficients, which coarser ones are combined to: so it does not matter which grid has what
        several could have.
        """
        levels = self.levels
        last = levels.side.size - 1
        size = levels.start[last] + levels.side[last] ** 2 * (levels.high[last] - levels.low[last])
        out = np.zeros((3 * len(field_powers(self.degree)), int(size)))
        for k, side in enumerate(levels.side):
            finer = self._finer(k)
            m, n, h = len(finer), int(side), 1.0 / self.oversampling
            x = (np.arange(m) - 0.5 * (m - 1)) * h
            weight = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / self.sigma**2)
            rows = np.stack([np.ones((m, m)), x * weight, x[:, None] * weight])
            rows = finer.T @ rows @ finer
            terms = int(levels.high[k] - levels.low[k])
            for t in range(terms):
                begin, term = int(levels.start[k]) + t, int(levels.low[k]) + t
                every = slice(begin, begin + terms * n * n, terms)
                out[3 * term : 3 * term + 3, every] = rows.reshape(3, -1) * h**2
        return out

    @cached_property
    def at_nodes(self) -> tuple[int, PsfBlock, Floats]:
        """A grid for what varies: knots a side, a term's prior and its conventions, a row each."""
        one = replace(self, degree=1, wings=0.0)
        first, side = 2, int(one.levels.side[-1])
        block = one.blocks[-first]
        rows = one.conventions[3 : 3 * first, one.fixed :][:, block.where]
        return side, block, rows

    def _finer(self, k: int) -> Floats:
        """What makes coefficients along an axis of a grid those of the fine one's spacing."""
        out = np.eye(int(self.levels.side[k]))
        for _ in range(round(self.levels.spacing[k] * self.oversampling).bit_length() - 1):
            out = halved(len(out)) @ out
        return out

    def combined(self, coefficients: Floats, nodes: Floats | None = None) -> Floats:
        """All grids' coefficients as those of one fine grid, shape (terms, n, n).

        The terms of nodes follow, if these have coefficients, shape (nodes, side, side).
        """
        levels, parts = self.levels, []
        for k, side in enumerate(levels.side):
            terms = int(levels.high[k] - levels.low[k])
            begin = int(levels.start[k])
            part = coefficients[begin : begin + terms * side**2].reshape(side, side, terms)
            finer = self._finer(k)
            part = finer @ np.moveaxis(part, 2, 0) @ finer.T
            parts.append((int(levels.low[k]), part))
        terms = len(field_powers(self.degree))
        if nodes is not None:
            finer = halved(nodes.shape[1])
            parts.append((terms, finer @ nodes @ finer.T))
            terms += len(nodes)
        n = max(part.shape[1] for _, part in parts)
        out = np.zeros((terms, n, n))
        for low, part in parts:
            edge = (n - part.shape[1]) // 2
            out[low : low + len(part), edge : n - edge, edge : n - edge] += part
        return out


def _roughness(envelope: Floats, n: int) -> sparse.csr_array:
    """The sum of squared second differences of c / E as a matrix; zeros surround the grid."""
    inverse, one, first = sparse.diags_array(1.0 / envelope), sparse.eye_array(n), np.ones(n)
    second = sparse.diags_array([first[1:], -2.0 * first, first[1:]], offsets=[-1, 0, 1])
    ends = sparse.csr_array(([1.0, 1.0], ([0, 1], [0, n - 1])), (2, n))
    second = sparse.vstack([second, ends])
    slope = sparse.diags_array([-first, first[1:]], offsets=[0, 1])
    xx, yy, xy = sparse.kron(one, second), sparse.kron(second, one), sparse.kron(slope, slope)
    return sparse.csr_array(inverse @ (xx.T @ xx + yy.T @ yy + 2.0 * xy.T @ xy) @ inverse)
