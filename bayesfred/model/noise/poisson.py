"""Photon noise."""

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
from bayesfred.model.noise.protocol import Noise

NOTHING = 1e-300  # stands for an expected count of zero, at which nothing but zero can be counted
SERIES_FROM = 1e3
SMALL_UNTIL = 1e-6

# From this variance on, and from this read noise on, an Edgeworth series is right to 2e-4.
SMOOTH_FROM = 50.0
BLURRED_FROM = 0.5
TAIL = 8.0  # standard deviations of the read noise


class PoissonTerms(NamedTuple):
    """n log(mu) - mu, see `model/kernels/noise_dispatch`."""

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, p: Any) -> Any:
        # neither a branch nor a minimum: the loop would not vectorise
        return n * log(mu) - mu if mu > 0.0 else MASKED

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, p: Any) -> Any:
        inverse = 1.0 / max(mu, NOTHING)
        score = n * inverse
        return score - 1.0, score * inverse, score * inverse * inverse

    @staticmethod
    def information(noise: Any, mu: Any, p: Any) -> Any:
        return 1.0 / max(mu, NOTHING)

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        if rest.pixels <= 0.0:
            return 0.0, 0.0, 0.0
        if level <= 0.0:
            return MASKED, 0.0, 0.0
        value = rest.counts * math.log(level) - rest.pixels * level
        return value, rest.counts / level - rest.pixels, rest.pixels / level


@serializable("noise.poisson")
@dataclass(frozen=True)
class PoissonNoise(Noise):
    """Photon noise, with read noise as the shifted Poisson distribution.

    Counts are Poisson(mean). Gaussian read noise of variance r^2 is matched in mean and variance by
    treating counts + r^2 as Poisson(mean + r^2). Where read noise takes counts below -r^2 the same
    expression is used, whose score keeps the expectation zero.

    Parameters
    ----------
    read_noise : float, counts
        Standard deviation r of the read noise.

    Raises
    ------
    InputError
        If `read_noise` is negative or not finite.

    Examples
    --------
    >>> PoissonNoise().log_likelihood(np.array([0.0]), np.array([2.0]), 2.0)
    array([-2.])
    """

    read_noise: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.read_noise) and self.read_noise >= 0):
            raise InputError(
                f"noise: read_noise: got {self.read_noise}, expected a standard deviation >= 0 in "
                "counts"
            )

    @property
    def shift(self) -> float:
        """Variance of the read noise."""
        return self.read_noise**2

    def terms(self, values: Floats) -> PoissonTerms:
        return PoissonTerms()

    def constant(self, counts: Floats, used: Flags) -> float:
        return -float(np.sum(gammaln(np.maximum(counts[used] + self.shift, 0.0) + 1.0)))

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        if self.read_noise == 0 and counts[used].min() < 0:
            raise InputError(
                f"counts: got {counts[used].min():g}, expected counts >= 0 without read noise: "
                "check gain and pedestal, give read_noise, or mask these pixels"
            )

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        counts = rng.poisson(sources + background).astype(np.float64)
        return (
            counts + rng.normal(0.0, self.read_noise, counts.shape)
            if self.read_noise > 0
            else counts
        )

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        n, mu = counts + self.shift, mean + self.shift
        return np.asarray(xlogy(n, mu) - mu - gammaln(np.maximum(n, 0.0) + 1.0))

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return (counts + self.shift) / np.maximum(mean + self.shift, NOTHING) - 1.0

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return 1.0 / np.maximum(mean + self.shift, NOTHING)

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float
    ) -> tuple[Floats, Floats]:
        """Of the sum of Poisson counts and Gaussian read noise, not of what stands for it."""
        if self.read_noise > 0.0:
            half = 0.5 * grain
            return (
                blurred_cdf(counts - half, mean, self.read_noise),
                blurred_cdf(counts + half, mean, self.read_noise),
            )
        half = 0.5 * max(grain, 1.0)
        return poisson_cdf(counts - half, mean), poisson_cdf(counts + half, mean)

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        n, mu = counts + self.shift, mean + self.shift
        # read noise may take counts below zero, where the best mean is zero
        positive = np.maximum(n, 0.0)
        return np.asarray(2.0 * (xlogy(positive, positive / mu) - n + mu))

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        return deviance_moments(mean + self.shift)


def poisson_cdf(n: Floats, mu: float | Floats) -> Floats:
    """P(N <= n) of Poisson counts N; n need not be an integer."""
    return np.where(n < 0.0, 0.0, pdtr(np.maximum(n, 0.0), mu))


def blurred_cdf(x: Floats, mu: Floats, read_noise: float) -> Floats:
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
    variance = mu + read_noise**2
    smooth = (variance >= SMOOTH_FROM) & (read_noise >= BLURRED_FROM)
    out = np.empty(np.shape(x))
    m, v = mu[smooth], variance[smooth]
    z, s, k = (x[smooth] - m) / np.sqrt(v), m * v**-1.5, m / v**2
    terms = s * (z**2 - 1.0) / 6.0 + k * (z**3 - 3.0 * z) / 24.0
    terms += s**2 * (z**5 - 10.0 * z**3 + 15.0 * z) / 72.0
    out[smooth] = ndtr(z) - terms * np.exp(-0.5 * z**2) / math.sqrt(2.0 * math.pi)
    x, mu = x[~smooth], mu[~smooth]
    lowest = np.maximum(np.ceil(x - TAIL * read_noise), 0.0)
    total, log_mu = poisson_cdf(lowest - 1.0, mu), np.log(np.maximum(mu, NOTHING))
    for j in range(math.ceil(2.0 * TAIL * read_noise) + 1):
        n = lowest + j
        total += np.exp(n * log_mu - mu - gammaln(n + 1.0)) * ndtr((x - n) / read_noise)
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
