"""Photon noise, alone or with the read noise of `poisson_gaussian`."""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import gammaln, ndtr, pdtr, xlogy
from scipy.stats import poisson

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.fastmath import log
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.contexts import MASKED
from bayesfred.model.kernels.poisson_gaussian import left_out
from bayesfred.model.kernels.read_noise import ReadNoiseTerms, level_series
from bayesfred.model.noise.moments import (
    deviance,
    frame_terms,
    highest_density,
    information,
    log_likelihood,
    moment_table,
    score,
)
from bayesfred.model.noise.protocol import Noise

NOTHING = 1e-300  # stands for an expected count of zero, at which nothing but zero can be counted
MOST_COUNTS = 1e18  # of an expected pixel that can be drawn: more are no integers of 64 bits
LEAST_READ_NOISE = 0.01  # below it only whole numbers of photons have any density
MOST_READ_NOISE = 1e6
SERIES_FROM = 1e3
SMALL_UNTIL = 1e-6

# From this variance on, and from this read noise on, an Edgeworth series is right to 2e-4.
SMOOTH_FROM = 50.0
BLURRED_FROM = 0.5
TAIL = 8.0  # standard deviations of the read noise


class PoissonTerms(NamedTuple):
    """n log(mu) - mu, see `model/kernels/noise_dispatch`."""

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        # neither a branch nor a minimum: the loop would not vectorise
        return n * log(mu) - mu if mu > 0.0 else MASKED

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        inverse = 1.0 / max(mu, NOTHING)
        score = n * inverse
        return score - 1.0, score * inverse, score * inverse * inverse

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        return 1.0 / max(mu, NOTHING)

    @staticmethod
    def spread(noise: Any, mu: Any, p: Any) -> Any:
        return max(mu, NOTHING), 1.0

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        if rest.pixels <= 0.0:
            return 0.0, 0.0, 0.0
        if level <= 0.0:
            return MASKED, 0.0, 0.0
        value = rest.counts * math.log(level) - rest.pixels * level
        return value, rest.counts / level - rest.pixels, rest.pixels / level


@serializable("noise.poisson")
@dataclass(frozen=True, eq=False)
class PoissonNoise(Noise):
    """Photon noise, and Gaussian read noise.

    Counts are Poisson(mean) without read noise, and with it the sum of such a number and a normal
    one: their density is the convolution of the two distributions. Counts are electrons, so that
    a gain map is applied to the frame (counts = (adu - pedestal) * gain) and to the read noise
    (electrons = adu * gain) before they are given here. Counts that were divided by a flat field
    are no longer Poisson: see `FlatFieldNoise`.

    Parameters
    ----------
    read_noise : float or array_like, shape (ny, nx), counts
        Standard deviation r of the read noise, of all pixels or of each: the square root of a map
        of read-out variance. In an array every number is positive; give a pixel without one any,
        and mask it.

    Raises
    ------
    InputError
        If `read_noise` is negative or not finite, or zero in an array.

    References
    ----------
    D. L. Snyder, A. M. Hammoud, R. L. White (1993), Journal of the Optical Society of America A 10,
    1014: image recovery from data acquired with a charge-coupled-device camera.

    Examples
    --------
    >>> PoissonNoise().log_likelihood(np.array([0.0]), np.array([2.0]), 2.0)
    array([-2.])
    >>> PoissonNoise(0.5).log_likelihood(np.array([-0.2, 1.3]), np.array([2.0]), 2.0).round(3)
    array([-2.191, -1.326])
    """

    read_noise: float | Floats = 0.0

    def __post_init__(self) -> None:
        try:
            read_noise = np.array(self.read_noise, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("noise: read_noise: got no numbers, expected counts") from None
        bad = ~((read_noise >= LEAST_READ_NOISE) & (read_noise <= MOST_READ_NOISE))
        if not read_noise.ndim:
            if bad and read_noise != 0.0:
                raise InputError(
                    f"noise: read_noise: got {self.read_noise}, expected a standard deviation in "
                    f"counts, from {LEAST_READ_NOISE:g} to {MOST_READ_NOISE:g}, or 0"
                )
            object.__setattr__(self, "read_noise", float(read_noise))
            return
        if bad.any():
            raise InputError(
                f"noise: read_noise: got {read_noise[bad][0]:g} in {bad.sum()} pixels, expected "
                f"numbers from {LEAST_READ_NOISE:g} to {MOST_READ_NOISE:g}: mask such pixels and "
                "give them any read noise"
            )
        read_noise.flags.writeable = False
        object.__setattr__(self, "read_noise", read_noise)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PoissonNoise) and np.array_equal(self.read_noise, other.read_noise)

    def __hash__(self) -> int:
        return hash(np.asarray(self.read_noise).tobytes())

    @property
    def discrete(self) -> bool:
        return isinstance(self.read_noise, float) and self.read_noise == 0.0

    @property
    def _variance(self) -> float | Floats:
        """Variance of the read noise."""
        return self.read_noise**2

    def terms(self, values: Floats) -> PoissonTerms | ReadNoiseTerms:
        if self.discrete:
            return PoissonTerms()
        if isinstance(self.read_noise, float):
            return frame_terms(self.read_noise, values)
        padded = np.full(values.shape, np.median(self.read_noise))
        padded[:, : self.read_noise.shape[1]] = self.read_noise
        return frame_terms(padded.ravel(), values)

    def with_unreached(self, terms: Any, values: Floats) -> Any:
        if self.discrete:
            return terms
        level = level_series(terms, values, float(np.median(self._variance)))
        return terms._replace(level=level)

    def constant(self, counts: Floats, used: Flags) -> float:
        if self.discrete:
            return -float(np.sum(gammaln(np.maximum(counts[used], 0.0) + 1.0)))
        variance = np.broadcast_to(self._variance, counts.shape)[used]
        return float(np.sum(left_out(counts[used], variance)))

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        if np.shape(self.read_noise) not in ((), counts.shape):
            raise InputError(
                f"noise: read_noise: got shape {np.shape(self.read_noise)}, expected a number or "
                f"the frame's shape {counts.shape}"
            )
        if self.discrete and counts[used].min() < 0:
            raise InputError(
                f"counts: got {counts[used].min():g}, expected counts >= 0 without read noise: "
                "check gain and pedestal, give read_noise, or mask these pixels"
            )

    def at(self, pixels: Any) -> "PoissonNoise":
        if isinstance(self.read_noise, float):
            return self
        return PoissonNoise(self.read_noise[pixels])

    def highest(self, counts: Floats) -> Floats:
        if not self.discrete:
            return highest_density(counts, self.read_noise)
        return np.asarray(xlogy(counts, np.maximum(counts, NOTHING)) - counts)

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        counts = drawn(sources + background, rng)
        if self.discrete:
            return counts
        return counts + rng.normal(0.0, self.read_noise, counts.shape)

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        if not self.discrete:
            return log_likelihood(counts, mean, self.read_noise)
        return np.asarray(xlogy(counts, mean) - mean - gammaln(np.maximum(counts, 0.0) + 1.0))

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        if not self.discrete:
            return score(counts, mean, self.read_noise)
        return counts / np.maximum(mean, NOTHING) - 1.0

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        if not self.discrete:
            return information(mean, self.read_noise)
        return 1.0 / np.maximum(mean, NOTHING)

    def counts_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return np.maximum(mean, NOTHING) + self._variance

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """Kurtosis of the counts less what the background explains of it; 2 without read noise."""
        if self.discrete:
            return 2.0 * np.ones_like(mean)
        inverse = 1.0 / self.counts_variance(mean, background)
        explained = inverse / self.fisher_weight(mean, background)
        return 2.0 + inverse * inverse * mean - inverse * explained

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float | Floats
    ) -> tuple[Floats, Floats]:
        if not self.discrete:
            half = 0.5 * grain
            return (
                blurred_cdf(counts - half, mean, self.read_noise),
                blurred_cdf(counts + half, mean, self.read_noise),
            )
        half = 0.5 * np.maximum(grain, 1.0)
        upto = poisson_cdf(counts + half, mean)
        if np.all(half == 0.5) and np.all(counts == np.rint(counts)):
            chance = np.exp(self.log_likelihood(counts, mean, background))  # takes a third
            return np.maximum(upto - chance, 0.0), upto
        return poisson_cdf(counts - half, mean), upto

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        if not self.discrete:
            return deviance(counts, mean, self.read_noise)
        n = counts
        return np.asarray(2.0 * (xlogy(n, np.maximum(n, 0.0) / mean) - n + mean))

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        if not self.discrete:
            return moment_table(self.read_noise).deviance(mean, self.read_noise)
        return deviance_moments(mean)


def poisson_cdf(n: Floats, mu: float | Floats) -> Floats:
    """P(N <= n) of Poisson counts N; n need not be an integer."""
    return np.where(n < 0.0, 0.0, pdtr(np.maximum(n, 0.0), mu))


def blurred_cdf(x: Floats, mu: Floats, read_noise: float | Floats) -> Floats:
    """P(N + e <= x) of Poisson counts N and Gaussian read noise e.

    The sum over N of P(N) Phi((x - N) / r), over the counts within eight r of x, or where the
    distribution is smooth enough the Edgeworth series to the fourth cumulant.

    References
    ----------
    H. Cramer (1946), Mathematical Methods of Statistics, chapter 17: the series.

    Examples
    --------
    >>> blurred_cdf(np.array([5.0, 500.0]), np.array([5.0, 500.0]), 2.0).round(4)
    array([0.5124, 0.5029])
    """
    variance, r = mu + read_noise**2, np.broadcast_to(read_noise, np.shape(x))
    smooth = (variance >= SMOOTH_FROM) & (r >= BLURRED_FROM)
    out = np.empty(np.shape(x))
    m, v = mu[smooth], variance[smooth]
    z, s, k = (x[smooth] - m) / np.sqrt(v), m * v**-1.5, m / v**2
    terms = s * (z**2 - 1.0) / 6.0 + k * (z**3 - 3.0 * z) / 24.0
    terms += s**2 * (z**5 - 10.0 * z**3 + 15.0 * z) / 72.0
    out[smooth] = ndtr(z) - terms * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    x, mu, r = x[~smooth], mu[~smooth], r[~smooth]
    lowest = np.maximum(np.ceil(x - TAIL * r), 0.0)
    total, log_mu = poisson_cdf(lowest - 1.0, mu), np.log(np.maximum(mu, NOTHING))
    for j in range(math.ceil(2.0 * TAIL * np.max(r, initial=0.0)) + 1):
        n = lowest + j
        total += np.exp(n * log_mu - mu - gammaln(n + 1.0)) * ndtr((x - n) / r)
    out[~smooth] = total
    return out


def deviance_moments(mu: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean, variance and the mean's slope of the unit deviance of a Poisson count.

    The unit deviance is D(n; mu) = 2 (n log(n / mu) - n + mu), n ~ Poisson(mu). Its covariance with
    the count is mu times the slope, because dD/dmu = 2 (1 - n / mu) has mean zero. Sums over n on a
    grid of log mu are interpolated; below the grid the terms n <= 1 suffice, above it the first
    terms in 1/mu do. Relative error below 1e-4.

    Parameters
    ----------
    mu : ndarray, any shape, counts, positive

    Returns
    -------
    mean, variance, slope : ndarray, shape of `mu`; the slope per count

    Examples
    --------
    >>> mean, variance, slope = deviance_moments(np.array([0.01, 5.0, 1e6]))
    >>> mean.round(4), variance.round(4)
    (array([0.0922, 1.0467, 1.    ]), array([0.5243, 2.2668, 2.    ]))
    """
    spline = _deviance_table()
    small, large = mu < SMALL_UNTIL, mu > SERIES_FROM
    inside = np.clip(mu, SMALL_UNTIL, SERIES_FROM)
    log_mean, log_variance = np.moveaxis(spline(np.log(inside)), -1, 0)
    mean, variance = np.exp(log_mean), np.exp(log_variance)
    slope = mean / inside * spline(np.log(inside), 1)[..., 0]
    log_mu = np.log(mu)
    mean = np.where(
        small, -2.0 * mu * log_mu, np.where(large, 1.0 + (1.0 + 1.0 / mu) / (6.0 * mu), mean)
    )
    variance = np.where(
        small, 4.0 * mu * (1.0 + log_mu) ** 2, np.where(large, 2.0 + 2.0 / (3.0 * mu), variance)
    )
    slope = np.where(small, -2.0 * (1.0 + log_mu), np.where(large, -1.0 / (6.0 * mu**2), slope))
    return mean, variance, slope


@cache
def _deviance_table() -> CubicSpline:
    """Logarithms of mean and variance of the unit deviance over log mu, from sums over n."""
    grid = np.geomspace(SMALL_UNTIL, SERIES_FROM, 361)
    moments = np.empty((grid.size, 2))
    for k, mu in enumerate(grid):
        half = 12.0 * np.sqrt(mu)
        n = np.arange(max(0, int(mu - half)), int(mu + half) + 25, dtype=np.float64)
        chance = poisson.pmf(n, mu)
        deviance = 2.0 * (xlogy(n, n / mu) - n + mu)
        mean = chance @ deviance
        moments[k] = mean, chance @ (deviance - mean) ** 2
    return CubicSpline(np.log(grid), np.log(moments))


def drawn(expected: Floats, rng: np.random.Generator) -> Floats:
    """Counts with Poisson noise.

    Raises
    ------
    InputError
        If counts are expected that no random numbers are as large as.
    """
    if not np.all((expected >= 0.0) & (expected <= MOST_COUNTS)):
        raise InputError(
            f"counts: got up to {expected.max():.3g} expected in a pixel, expected numbers from 0 "
            f"to {MOST_COUNTS:g}: check fluxes, background, distortion and the sources' positions"
        )
    return rng.poisson(expected).astype(np.float64)
