"""The compiled half of photon noise with read noise, for whole frames and for arrays of pixels.

The density is that of `poisson_gaussian`. It has no sufficient statistic, so the pixels that no
source reaches cannot be summed up by their counts. But where their mean is one level b, the sum of
log p over a segment of a row is an analytic function of log b, whose nearest singularity is at a
distance of pi from the real axis. So for levels within a factor of 2 of a typical one it is a
Chebyshev series of `VALUE_TERMS` terms, to 1e-11 of its size. That of the information has
`INFORMATION_TERMS`. At other levels the pixels are summed one by one.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.kernels.cumulants import CumulantTable
from bayesfred.model.kernels.mean_series import MeanSeries, no_mean_series
from bayesfred.model.kernels.noise_dispatch import derivatives, information, log_density
from bayesfred.model.kernels.poisson_gaussian import (
    SINGLE,
    WIDE,
    at,
    density_of,
    derivatives_of,
    kind_of,
    nearest,
    steps,
)
from bayesfred.model.kernels.read_noise_sums import GROUP, Alike, sum_up

VALUE_TERMS = 12
INFORMATION_TERMS = 6
HALF_WIDTH = math.log(2.0)  # of the interval in log b
CELLS = 96  # of the table of information, in log mu


class InformationRows(NamedTuple):
    """A table of log(information (mu + r^2)) over log mu, a row for some values of r."""

    first: Floats  # (rows,) log mu at which a row begins
    step: Floats  # (rows,) of its cells
    table: Floats  # (rows, CELLS, 4) cubics, the highest power first


class LevelSeries(NamedTuple):
    """Sums over the pixels of segments as functions of log b; none if there are no segments."""

    middle: float  # of the interval in log b
    series: Floats  # (segments, VALUE_TERMS + INFORMATION_TERMS)
    total: Floats  # (VALUE_TERMS + INFORMATION_TERMS,)
    values: Floats  # the padded frame


class ReadNoiseTerms(NamedTuple):
    """Poisson and Gaussian convolved, see `model/kernels/noise_dispatch`."""

    kind: tuple[int, ...]  # see `kind_of`
    variance: float | Floats  # of the read noise, counts^2: one number, or for padded rows
    alike: tuple[Alike, Alike] | None  # of a frame whose pixels differ in their read noise
    row: float | Floats  # in the table of information
    first: Floats  # these three are `InformationRows`
    step: Floats
    table: Floats
    level: LevelSeries
    cumulants: CumulantTable | None  # of a frame with one read noise
    near: MeanSeries

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        """log p less what depends on n alone."""
        return density_of(noise.kind, n, mu, at(noise.variance, p)) if mu >= 0.0 else MASKED

    @staticmethod
    def summed(noise: Any, values: Any, light: Any, mean: Any, place: Any) -> Any:
        """Sum of log_density over segments."""
        return sum_up(noise, values, mean, place)

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        """Score, weight and C."""
        return derivatives_of(noise.kind, n, mu, at(noise.variance, p))

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        """The expectation of the weight."""
        return _information(noise, mu, at(noise.variance, p), at(noise.row, p))

    @staticmethod
    def spread(noise: Any, mu: Any, p: Any) -> Any:
        """Variance of the counts, and its slope."""
        return max(mu, 0.0) + at(noise.variance, p), 1.0

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        """Sums over the pixels that no source reaches."""
        return sum_unreached(noise, rest, level)


@inner()
def _row_value(noise, row, mu):
    """Log of information (mu + r^2) from one row of the table."""
    x = (math.log(mu) - noise.first[row]) / noise.step[row]
    cell = min(max(int(x), 0), CELLS - 1)
    x = min(max(x - cell, 0.0), 1.0)
    c = noise.table[row, cell]
    return c[3] + x * (c[2] + x * (c[1] + x * c[0]))


@inner()
def _information(noise, mu, variance, row):
    """Expected information, between the rows of the table that are next to the read noise."""
    mu = max(mu, 1e-30)
    low = min(int(row), noise.first.size - 1)
    high = min(low + 1, noise.first.size - 1)
    value = _row_value(noise, low, mu)
    if high > low:
        value += (row - low) * (_row_value(noise, high, mu) - value)
    return math.exp(value) / (mu + variance)


@inner()
def sum_unreached(noise, rest, level):
    """The pixels that no source reaches, from the Chebyshev series where these hold."""
    if rest.pixels <= 0.0:
        return 0.0, 0.0, 0.0
    if level <= 0.0:
        return MASKED, 0.0, 0.0
    x = (math.log(level) - noise.level.middle) / HALF_WIDTH
    if not -1.0 <= x <= 1.0:
        return _sum_unreached(noise, rest.flags, level)
    sums = _sum_series(noise.level.series, noise.level.total, rest.flags)
    value, slope = _clenshaw(sums[:VALUE_TERMS], x)
    known, _ = _clenshaw(sums[VALUE_TERMS:], x)
    return value, slope / (HALF_WIDTH * level), known


@inner()
def _sum_series(series, total, flags):
    """Sum of the segments' series over flags of 0, from these or from the others."""
    reached = 0
    for k in range(flags.size):
        reached += flags[k] != 0
    fewer = 2 * reached < flags.size
    sums = total.copy() if fewer else np.zeros(total.size)
    sign = -1.0 if fewer else 1.0
    for k in range(flags.size):
        if (flags[k] != 0) == fewer:
            for j in range(sums.size):
                sums[j] += sign * series[k, j]
    return sums


@inner()
def _clenshaw(series, x):
    """A Chebyshev series and its derivative."""
    value, before, slope, slope_before = 0.0, 0.0, 0.0, 0.0
    for j in range(series.size - 1, 0, -1):
        slope, slope_before = 2.0 * (value + x * slope) - slope_before, slope
        value, before = series[j] + 2.0 * x * value - before, value
    return series[0] + x * value - before, value + x * slope - slope_before


@inner(fastmath=REDUCE)
def _segment_density(noise, values, level, first):
    total = 0.0
    for i in range(values.size):
        counted = values[i] > LIMIT
        n = values[i] if counted else level
        term = log_density(noise, n, level, 0.0, np.uint64(first + i))
        total += term if counted else 0.0
    return total


@inner(fastmath=REDUCE)
def _segment_score(noise, values, level, first):
    total = 0.0
    for i in range(values.size):
        counted = values[i] > LIMIT
        n = values[i] if counted else level
        term = derivatives(noise, n, level, 0.0, np.uint64(first + i))[0]
        total += term if counted else 0.0
    return total


@inner()
def _segment_information(noise, values, level, first):
    total = 0.0
    for i in range(values.size):
        if values[i] > LIMIT:
            total += information(noise, level, 0.0, np.uint64(first + i))
    return total


@inner()
def _sum_unreached(noise, flags, level):
    """The same, pixel by pixel."""
    value, slope, known = 0.0, 0.0, 0.0
    for k in range(flags.size):
        if flags[k] == 0:
            first = k * SEGMENT
            part = noise.level.values[first : first + SEGMENT]
            value += _segment_density(noise, part, level, first)
            slope += _segment_score(noise, part, level, first)
            known += _segment_information(noise, part, level, first)
    return value, slope, known


@entry()
def _segment_sums(noise, values, level, informed, out):
    """Sum of the log-densities, or of the information, of every segment's pixels."""
    for k in range(out.size):
        part = values[k * SEGMENT : (k + 1) * SEGMENT]
        if informed:
            out[k] = _segment_information(noise, part, level, k * SEGMENT)
        else:
            out[k] = _segment_density(noise, part, level, k * SEGMENT)


@entry(fastmath=FAST)
def log_densities(noise, n, mu, out):
    """Log-densities of pixels, less what depends on the counts alone."""
    for i in range(out.size):
        out[i] = log_density(noise, n[i], mu[i], 0.0, np.uint64(i))


@entry(fastmath=FAST)
def scores(noise, n, mu, out):
    """Derivatives of the log-densities by mu."""
    for i in range(out.size):
        out[i] = derivatives(noise, n[i], mu[i], 0.0, np.uint64(i))[0]


@entry()
def informations(noise, mu, out):
    """Expected information of pixels."""
    for i in range(out.size):
        out[i] = information(noise, mu[i], 0.0, np.uint64(i))


@entry()
def most_likely(noise, n, out):
    """The means at which log p of counts n is highest, 0 where it falls from there on.

    Newton's method: the score falls and is convex, so that from a mean that is too small it
    converges without overshooting.
    """
    for i in range(out.size):
        mu = max(n[i], 1e-3)
        for _ in range(200):
            s, w, _ = derivatives(noise, n[i], mu, 0.0, np.uint64(i))
            before, mu = mu, max(mu + s / w, 0.1 * mu) if w > 0.0 else 0.1 * mu
            if mu < 1e-25 or abs(mu - before) <= 1e-9 * mu:
                break
        out[i] = mu if n[i] > 0.5 else 0.0


@entry(fastmath=FAST)
def _find_steps(n, variance, photons, up, down):
    for i in range(n.size):
        photons[i] = nearest(n[i])
        up[i], down[i] = steps(n[i], 1.0 / variance[i])


def alike_pixels(values: Floats, variance: Floats) -> tuple[Alike, Alike]:
    """The pixels of padded rows that need the sum, and those that need the expansion."""
    counts, wide = values.ravel(), variance >= WIDE
    few, many = (_alike(counts, variance, (counts > LIMIT) & own) for own in (~wide, wide))
    photons, up, down = (np.empty(few.counts.size) for _ in range(3))
    _find_steps(few.counts, *few.constants, photons, up, down)
    inverse = 1.0 / many.constants[0]
    single = (many.counts * inverse).astype(SINGLE), inverse.astype(SINGLE)
    return (
        few._replace(counts=photons, constants=(up, down)),
        many._replace(constants=(*many.constants, *single)),
    )


def _alike(counts: Floats, variance: Floats, chosen: Flags) -> Alike:
    first = np.append(0, np.cumsum(np.count_nonzero(chosen.reshape(-1, SEGMENT), axis=1)))
    n, r2 = (np.append(each[chosen], np.ones(GROUP)) for each in (counts, variance))
    return Alike(first, np.flatnonzero(chosen).astype(np.uint32), n, (r2,))


def _typical_level(counts: Floats, variance: float) -> float:
    """About the level of the sky: the mean of the counts within 3 sd of it."""
    level = float(np.median(counts)) if counts.size else 1.0
    for _ in range(20):
        level = max(level, 1e-3)
        near = counts[np.abs(counts - level) <= 3.0 * math.sqrt(level + variance)]
        level = float(np.mean(near)) if near.size else level
    return max(level, 1e-3)


def level_series(noise: Any, values: Floats, variance: float) -> LevelSeries:
    """The series of a frame of padded rows, whose read noise has about this variance."""
    middle = math.log(_typical_level(values[values > LIMIT], variance))
    flat, parts = values.ravel(), []
    for terms, informed in ((VALUE_TERMS, False), (INFORMATION_TERMS, True)):
        angle = np.pi * (np.arange(terms) + 0.5) / terms
        at_nodes = np.empty((terms, flat.size // SEGMENT))
        for x, out in zip(np.cos(angle), at_nodes, strict=True):
            _segment_sums(noise, flat, math.exp(middle + HALF_WIDTH * x), informed, out)
        weights = np.cos(np.outer(np.arange(terms), angle)) * (2.0 / terms)
        weights[0] *= 0.5
        parts.append(weights @ at_nodes)
    series = np.ascontiguousarray(np.concatenate(parts).T)
    return LevelSeries(middle, series, series.sum(axis=0), flat)


def no_series() -> LevelSeries:
    """The series of no pixels."""
    none = np.empty((0, 0))
    return LevelSeries(0.0, none, none.ravel(), none.ravel())


def new_terms(
    variance: float | Floats, rows: InformationRows, row: float | Floats
) -> ReadNoiseTerms:
    """The compiled half for pixels in the order in which they are given, without a frame."""
    return ReadNoiseTerms(
        kind_of(variance), variance, None, row, *rows, no_series(), None, no_mean_series()
    )
