"""Moments of photon noise with read noise: information, and mean and variance of the deviance.

They are integrals over the counts n of the density p(n | mu) of `poisson_gaussian`,

    I = E (d log p / d mu)^2,    D(n; mu) = 2 (sup_mu log p(n | mu) - log p(n | mu)),

by the trapezoidal rule, which errs by less than 1e-6 for such smooth functions at the steps used
here. The second derivative of D jumps at n = 1/2, which is a node. A table holds the moments for
some read noises r, 10 % apart, as cubic splines over log mu. Between two of its rows they are
interpolated in log r. The relative error is below 3e-4 for a single r, and below 2e-3 between rows.
Far above the table they approach those of a Gaussian like 1 / (mu + r^2).
The supremum is at mu = 0 for n <= 1/2, where the score at mu = 0 is negative.
"""

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.model.kernels.cumulants import cumulant_table
from bayesfred.model.kernels.poisson_gaussian import left_out
from bayesfred.model.kernels.read_noise import (
    CELLS,
    InformationRows,
    ReadNoiseTerms,
    alike_pixels,
    informations,
    log_densities,
    most_likely,
    new_terms,
    scores,
)

SMALLEST, LARGEST = 0.1, 30.0  # read noises; below, as for photons alone; above, mu scales with r
ROW_STEP = 0.1  # at most, in log r
NO_ROWS = InformationRows(np.empty(0), np.empty(0), np.empty((0, 0, 0)))


@dataclass(frozen=True, eq=False)
class MomentTable:
    """Moments for read noises within a range.

    Attributes
    ----------
    read_noise : ndarray, shape (rows,), counts
    grid : ndarray, shape (rows, CELLS + 1)
        log mu.
    splines : tuple of CubicSpline
        Logarithms of information (mu + r^2), mean and variance of the deviance, for every row.
    """

    read_noise: Floats
    grid: Floats
    splines: tuple[CubicSpline, ...]

    @property
    def information(self) -> InformationRows:
        """The table of information as the compiled code needs it."""
        cubics = np.stack([spline.c[:, :, 0].T for spline in self.splines])
        step = self.grid[:, 1] - self.grid[:, 0]
        # in units of a cell
        return InformationRows(
            self.grid[:, 0].copy(),
            step,
            np.ascontiguousarray(cubics * step[:, None, None] ** np.arange(3, -1, -1)),
        )

    def row(self, read_noise: float | Floats) -> float | Floats:
        """Where read noises lie among the rows."""
        places = np.arange(self.read_noise.size, dtype=float)
        found = np.interp(np.log(read_noise), np.log(self.read_noise), places)
        return found if np.ndim(found) else float(found)

    def deviance(self, mean: Floats, read_noise: float | Floats) -> tuple[Floats, Floats, Floats]:
        """Mean and variance of the unit deviance, and the mean's slope.

        Parameters
        ----------
        mean : ndarray, any shape, counts
        read_noise : float or ndarray, shape of `mean`, counts

        Returns
        -------
        mean, variance, slope : ndarray, shape of `mean`; the slope per count
        """
        r = np.broadcast_to(read_noise, mean.shape)
        place = np.broadcast_to(self.row(read_noise), mean.shape)
        low = np.minimum(place.astype(int), self.read_noise.size - 1)
        out = np.zeros((3, *mean.shape))
        for row in range(self.read_noise.size):
            for here, share in ((low == row, 1.0 - (place - low)), (low == row - 1, place - low)):
                if here.any():
                    out[:, here] += share[here] * self._one_row(row, mean[here], r[here])
        return out[0], out[1], out[2]

    def _one_row(self, row: int, mean: Floats, r: Floats) -> Floats:
        """The moments from one row, shape (3, n)."""
        scale = np.where(r > LARGEST, LARGEST / r, 1.0)
        mu = np.maximum(mean * scale, 1e-300)
        first, last = np.exp(self.grid[row, [0, -1]])
        inside = np.clip(mu, first, last)
        values = self.splines[row](np.log(inside))
        expected, variance = np.exp(values[:, 1]), np.exp(values[:, 2])
        slope = expected * self.splines[row](np.log(inside), 1)[:, 1] / inside * scale
        own = self.read_noise[row] ** 2
        far = (last + own) / (np.maximum(mu, last) + own)
        beyond = (1.0 - expected) * far / (mu + own) * scale
        return np.stack(
            [
                1.0 + (expected - 1.0) * far,
                2.0 + (variance - 2.0) * far,
                np.where(mu > last, beyond, slope),
            ]
        )


def moment_table(read_noise: float | Floats) -> MomentTable:
    """The table for the range of some read noises."""
    low, high = (float(np.clip(end(read_noise), SMALLEST, LARGEST)) for end in (np.min, np.max))
    rows = 1 + math.ceil(math.log(high / low) / ROW_STEP)
    return _table(low, high, rows)


@cache
def _table(low: float, high: float, rows: int) -> MomentTable:
    noises = np.geomspace(low, high, rows)
    grids = np.stack([np.linspace(*_range(r), CELLS + 1) for r in noises])
    splines = [
        CubicSpline(grid, np.log(_moments(np.exp(grid), float(r))))
        for grid, r in zip(grids, noises, strict=True)
    ]
    return MomentTable(noises, grids, tuple(splines))


def _range(r: float) -> tuple[float, float]:
    """The range of a row in log mu."""
    return math.log(1e-6 * max(r, 1.0)), math.log(100.0 + 30.0 * r * r)


def _moments(means: Floats, r: float) -> Floats:
    """Information (mu + r^2), mean and variance of the deviance, shape (n, 3)."""
    step = min(r, r * r) / 4.0
    top = means[-1] + 9.0 * math.sqrt(means[-1]) + 9.0 * r + 12.0
    n = 0.5 + step * np.arange(math.floor(-9.0 * r / step), math.ceil(top / step))
    constant, terms = left_out(n, r * r), new_terms(r * r, NO_ROWS, 0.0)
    best, highest, value, score = (np.empty(n.size) for _ in range(4))
    most_likely(terms, n, best)
    log_densities(terms, n, best, highest)
    out = np.empty((means.size, 3))
    for k, mu in enumerate(means):
        reach = 9.0 * math.sqrt(mu + r * r) + 12.0
        some = slice(*np.searchsorted(n, (mu - reach, mu + reach)))
        mean = np.full(n[some].size, mu)
        log_densities(terms, n[some], mean, value[some])
        scores(terms, n[some], mean, score[some])
        chance = step * np.exp(value[some] + constant[some])
        deviance = np.maximum(2.0 * (highest[some] - value[some]), 0.0)
        expected = chance @ deviance
        out[k] = (
            (mu + r * r) * (chance @ score[some] ** 2),
            expected,
            chance @ (deviance - expected) ** 2,
        )
    return out


def frame_terms(read_noise: float | Floats, values: Floats) -> ReadNoiseTerms:
    """The compiled half for a frame of padded rows."""
    terms = _terms(read_noise)
    if isinstance(read_noise, float):
        return terms._replace(cumulants=cumulant_table(read_noise**2, values, SEGMENT))
    return terms._replace(alike=alike_pixels(values, read_noise**2))


def _terms(read_noise: float | Floats) -> ReadNoiseTerms:
    table = moment_table(read_noise)
    return new_terms(read_noise**2, table.information, table.row(read_noise))


def log_likelihood(counts: Floats, mean: Floats, read_noise: float | Floats) -> Floats:
    """Log-density of counts; the arguments are broadcast against each other."""
    n, mu, r, out = _alike(counts, mean, read_noise)
    log_densities(_quadrature_terms(r), n, mu, out.ravel())
    return out + left_out(counts, np.asarray(read_noise) ** 2)


def score(counts: Floats, mean: Floats, read_noise: float | Floats) -> Floats:
    """Derivative of the log-density by the mean."""
    n, mu, r, out = _alike(counts, mean, read_noise)
    scores(_quadrature_terms(r), n, mu, out.ravel())
    return out


def information(mean: Floats, read_noise: float | Floats) -> Floats:
    """Expected information about the mean."""
    mu, _, r, out = _alike(mean, mean, read_noise)
    informations(_terms(r), mu, out.ravel())
    return out


def highest_density(counts: Floats, read_noise: float | Floats) -> Floats:
    """Supremum over the mean of the log-density, less what depends on the counts alone."""
    n, _, r, out = _alike(counts, counts, read_noise)
    terms, best = _quadrature_terms(r), np.empty(n.size)
    most_likely(terms, n, best)
    log_densities(terms, n, best, out.ravel())
    return out


def deviance(counts: Floats, mean: Floats, read_noise: float | Floats) -> Floats:
    """Unit deviance, finite for any counts."""
    n, mu, r, out = _alike(counts, mean, read_noise)
    terms, best, highest = _quadrature_terms(r), np.empty(n.size), np.empty(n.size)
    most_likely(terms, n, best)
    log_densities(terms, n, best, highest)
    log_densities(terms, n, mu, out.ravel())
    return np.maximum(2.0 * (highest.reshape(out.shape) - out), 0.0)


def _quadrature_terms(read_noise: float | Floats) -> ReadNoiseTerms:
    """The compiled half without information."""
    return new_terms(read_noise**2, NO_ROWS, 0.0 if isinstance(read_noise, float) else read_noise)


def _alike(
    first: Floats, second: Floats, read_noise: float | Floats
) -> tuple[Floats, Floats, float | Floats, Floats]:
    """The arguments flattened to one size, and an array of their common shape for the result."""
    shape = np.broadcast_shapes(np.shape(first), np.shape(second), np.shape(read_noise))
    flat = [
        np.ascontiguousarray(np.broadcast_to(each, shape), dtype=np.float64).ravel()
        for each in (first, second)
    ]
    r = read_noise
    if not isinstance(r, float):
        r = np.ascontiguousarray(np.broadcast_to(r, shape)).ravel()
    return flat[0], flat[1], r, np.empty(shape)
