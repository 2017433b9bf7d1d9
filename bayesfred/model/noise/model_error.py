"""A model whose light is right to a fraction: what a noise model becomes with a model error.

A PSF is never known to the last per cent, so the variance of a pixel's counts is V + (eps S)^2,
where V is that of the noise, S the expected light of the sources and eps the model error. With g =
1 + (eps S)^2 / V and the unit deviance D = 2 (l* - l), which the noise's log-density l lacks to its
supremum l* over the mean,

    log p = l* - 1/2 log g - D / 2 g.

For Gaussian noise this is the Gaussian of that variance. For photons it is the double Poisson
distribution, whose sum is 1 to 0.15 eps^2, because g is near 1 unless counts are many: g - 1 is at
most eps^2 mu, and the sum differs from 1 by about (g - 1) / 12 mu. At eps = 0, and where there is
no light, it is the noise itself.

Derivatives. With s, W and C those of l, q = 1 / (V + (eps S)^2), h = V q = 1 / g, u = D / 2 and V'
= dV/dmu, which is constant, let a, b and c be the derivatives of log g by S, the background B and
eps:

    a = q (2 eps^2 S - (eps S)^2 V' / V),   b = -q (eps S)^2 V' / V,   c = 2 q eps S^2.

Then r = d log p / dS = s h + a (u h - 1/2). Its derivative is not of one sign, so the weight that
the integral over free fluxes is made of is W h, with C h + 1/2 W h a as -1/2 of its derivative. The
derivative of log p by B is s h + b (u h - 1/2), that by eps is c (u h - 1/2), and r has the
derivatives

    -W h m - s h k + a_k (u h - 1/2) - a (s h m + u h k)

with k = a, b, c, m = 1, 1, 0 and a_k those of a. The information about eps is 1/2 c^2, exact for
Gaussian noise; that about S is W's expectation times h. Both leave out terms of the order of eps^2.

References
----------
B. Efron (1986), Journal of the American Statistical Association 81, 709: double Poisson.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.imaging.kernels.fastmath import log
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.kernels.noise_dispatch import (
    derivatives,
    given,
    information,
    log_density,
    spread,
    unreached,
)
from bayesfred.model.noise.protocol import Noise

SMALLEST = 1e-7  # model error below which light is drawn as exact


class ModelErrorTerms(NamedTuple):
    """A noise with a model error, see `model/kernels/noise_dispatch`."""

    base: Any  # the noise's compiled half
    error: float  # eps
    highest: Floats  # (ny * stride,) l*

    @staticmethod
    def given(noise: Any, parameters: Any) -> Any:
        base, error = given(noise.base, parameters), parameters.nuisances.model_error
        return ModelErrorTerms(base, error, noise.highest)

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        own, _ = spread(noise.base, mu, p)
        low, top = log_density(noise.base, n, mu, light, p), noise.highest[p]
        wrong = noise.error * light
        h = own / (own + wrong * wrong)
        return top + 0.5 * log(h) - (top - low) * h if low > LIMIT else MASKED

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        own, slope = spread(noise.base, mu, p)
        s, w, c = derivatives(noise.base, n, mu, light, p)
        unit = noise.highest[p] - log_density(noise.base, n, mu, light, p)
        wrong = noise.error * light
        q = 1.0 / (own + wrong * wrong)
        h = own * q
        a = q * (2.0 * noise.error * wrong - wrong * wrong * slope / own)
        return s * h + a * (unit * h - 0.5), w * h, c * h + 0.5 * w * h * a

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        own, _ = spread(noise.base, mu, p)
        wrong = noise.error * light
        return information(noise.base, mu, light, p) * own / (own + wrong * wrong)

    @staticmethod
    def spread(noise: Any, mu: Any, p: Any) -> Any:
        return spread(noise.base, mu, p)

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        return unreached(noise.base, rest, level)

    @staticmethod
    def exact_weight(noise: Any) -> Any:
        return False

    @staticmethod
    def error_information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        own, _ = spread(noise.base, mu, p)
        wrong = noise.error * light
        c = 2.0 * wrong * light / (own + wrong * wrong)
        return 0.5 * c * c

    @staticmethod
    def error_slopes(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        """dr/dS, then d log p, -1/2 d(W h) and dr by B, and the same by eps."""
        own, slope = spread(noise.base, mu, p)
        s, w, curve = derivatives(noise.base, n, mu, light, p)
        eps = noise.error
        wrong = eps * light
        square = wrong * wrong
        q = 1.0 / (own + square)
        h, ratio = own * q, slope / own
        u = (noise.highest[p] - log_density(noise.base, n, mu, light, p)) * h
        e, s, w, curve = u - 0.5, s * h, w * h, curve * h
        grows = slope + 2.0 * eps * wrong
        a, b = q * (2.0 * eps * wrong - square * ratio), -q * square * ratio
        c = 2.0 * q * wrong * light
        aa = 2.0 * eps * eps * q - grows * grows * q * q + ratio * ratio
        ab = -grows * slope * q * q + ratio * ratio
        ac = 4.0 * wrong * q - 2.0 * grows * wrong * light * q * q
        by_light = -w - s * a + aa * e - a * (s + u * a)
        by_level = -w - s * b + ab * e - a * (s + u * b)
        by_error = -s * c + ac * e - a * u * c
        return (
            by_light,
            s + b * e, curve + 0.5 * w * b, by_level,
            c * e, 0.5 * w * c, by_error,
        )  # fmt: skip


def model_error_terms(
    noise: Noise, base: Any, pitch: int, counts: Floats, used: Flags
) -> ModelErrorTerms:
    """The compiled half of a noise, `base`, with a model error, for a frame of padded rows."""
    highest = np.zeros((len(counts), pitch))
    highest[:, : counts.shape[1]][used] = noise.at(used).highest(counts[used])
    return ModelErrorTerms(base, 0.0, highest.ravel())


@dataclass(frozen=True, eq=False)
class ModelErrorNoise(Noise):
    """A noise with a model error, for pixels whose light is their mean less their background.

    Parameters
    ----------
    noise : Noise
    error : float
        The model error eps, a fraction of the sources' light.
    slope : float or ndarray, shape (ny, nx), counts
        What the background of a pixel is beyond the constant that the methods are given.

    Examples
    --------
    >>> from bayesfred.model.noise import PoissonNoise
    >>> noise = ModelErrorNoise(PoissonNoise(), 0.1)
    >>> noise.counts_variance(np.array([5.0, 105.0]), 5.0)
    array([  5., 205.])
    """

    noise: Noise
    error: float
    slope: float | Floats = 0.0

    @property
    def discrete(self) -> bool:
        return self.noise.discrete

    def terms(self, values: Floats) -> Any:
        return self.noise.terms(values)

    def at(self, pixels: Any) -> "ModelErrorNoise":
        slope = self.slope if np.ndim(self.slope) == 0 else np.asarray(self.slope)[pixels]
        return ModelErrorNoise(self.noise.at(pixels), self.error, slope)

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        """Every pixel's light is multiplied by a Gamma number of mean 1 and variance eps^2."""
        if self.error > SMALLEST:
            sources = sources * rng.gamma(self.error**-2, self.error**2, sources.shape)
        return self.noise.draw(sources, background, rng)

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        growth = self._growth(mean, background)
        lost = 0.5 * self.noise.deviance(counts, mean, background)
        value = self.noise.log_likelihood(counts, mean, background)
        return np.asarray(value + lost * (1.0 - 1.0 / growth) - 0.5 * np.log(growth))

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        weight = self.noise.fisher_weight(mean, background)
        return np.asarray(weight / self._growth(mean, background))

    def counts_variance(self, mean: Floats, background: float | Floats) -> Floats:
        variance = self.noise.counts_variance(mean, background)
        return np.asarray(variance * self._growth(mean, background))

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        lost = self.noise.deviance(counts, mean, background)
        return np.asarray(lost / self._growth(mean, background))

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Those of the noise: where the two differ counts are many, and both like a Gaussian's."""
        return self.noise.deviance_moments(mean, background)

    def deviance_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.deviance_variance(mean, background)

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.pearson_variance(mean, background)

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float
    ) -> tuple[Floats, Floats] | None:
        """That of the noise, its residual being as many standard deviations."""
        wider = np.sqrt(self._growth(mean, background))
        nearer = mean + (counts - mean) / wider
        return self.noise.cumulative(np.where(wider > 1.0, nearer, counts), mean, background, grain)

    def _growth(self, mean: Floats, background: float | Floats) -> Floats:
        """The variance over that of the noise."""
        wrong = self.error * np.maximum(mean - background - self.slope, 0.0)
        own = np.maximum(self.noise.counts_variance(mean, background), math.ulp(0.0))
        return np.asarray(1.0 + wrong**2 / own)
