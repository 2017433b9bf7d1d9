"""Gaussian noise: of known variance, or of a variance that is the background.

With r = counts - mean and w = 1 / variance a pixel's log-likelihood is 1/2 log(w / 2 pi) - w r^2 /
2. Over the pixels that no source reaches, where the mean is the level b, the sum of w r^2 is that
of w n^2 - 2 b w n + b^2 w. Where the variance is b, too, as in the paper, log L depends on it
beyond the mean: with N pixels and S the sum of r^2

    d log L / d b = S / (2 b^2) - N / (2 b),        information N / (2 b^2).
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numba import types
from numba.extending import overload
from scipy.special import ndtr

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.noise.poisson import drawn, poisson_cdf
from bayesfred.model.noise.protocol import Noise


class GaussianTerms(NamedTuple):
    """norm - 1/2 scale weight (n - mu)^2, see `model/kernels/noise_dispatch`."""

    scale: float
    norm: float
    weights: Floats | None  # of the pixels of padded rows; None where all are 1
    sums: Floats  # (3, segments) of w, w n and w n^2

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        r = n - mu
        return noise.norm - 0.5 * noise.scale * _weight(noise.weights, p) * (r * r)

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        w = noise.scale * _weight(noise.weights, p)
        return w * (n - mu), w, 0.0

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        return noise.scale * _weight(noise.weights, p)

    @staticmethod
    def spread(noise: Any, mu: Any, p: Any) -> Any:
        return 1.0 / (noise.scale * _weight(noise.weights, p)), 0.0

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        one, n, square = 0.0, 0.0, 0.0
        # summed afresh: the frame's totals would lose their digits to bright sources
        for k in range(rest.flags.size):
            if rest.flags[k] == 0:
                one += noise.sums[0, k]
                n += noise.sums[1, k]
                square += noise.sums[2, k]
        squares = square - 2.0 * level * n + level * level * one
        value = rest.pixels * noise.norm - 0.5 * noise.scale * squares
        return value, noise.scale * (n - level * one), noise.scale * one


class BackgroundTerms(NamedTuple):
    """The same with the background as the variance."""

    sums: Floats

    @staticmethod
    def given(noise: Any, parameters: Any) -> Any:
        level = parameters.background[0]
        scale = 1.0 / level if level > 0.0 else 1.0
        norm = 0.5 * math.log(scale / (2.0 * math.pi)) if level > 0.0 else MASKED
        return GaussianTerms(scale, norm, None, noise.sums)

    @staticmethod
    def level_derivatives(noise: Any, pixels: Any, level: Any, value: Any) -> Any:
        squares = -2.0 * level * (value + 0.5 * pixels * math.log(2.0 * math.pi * level))
        return 0.5 * (squares / level - pixels) / level, 0.5 * pixels / (level * level)


def _weight(weights: Any, p: Any) -> Any:
    raise NotImplementedError("for compiled code")


@overload(_weight, inline="always", strict=False)
def _choose_weight(weights: Any, p: Any) -> Any:
    if isinstance(weights, types.NoneType):
        return lambda weights, p: 1.0
    return lambda weights, p: weights[p]


def _sums(values: Floats, weights: Floats | float) -> Floats:
    """Sums of w, w n and w n^2 over the used pixels of every segment, shape (3, segments)."""
    w = np.where(values > LIMIT, weights, 0.0)
    n = np.where(values > LIMIT, values, 0.0)
    return np.stack([(w * n**k).reshape(-1, SEGMENT).sum(axis=1) for k in range(3)])


class _Gaussian(Noise):
    """What follows from the variance."""

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        weight = self.fisher_weight(mean, background)
        return np.asarray(0.5 * (np.log(weight / (2.0 * np.pi)) - weight * (counts - mean) ** 2))


@serializable("noise.gaussian")
@dataclass(frozen=True, eq=False)
class GaussianNoise(_Gaussian):
    """Gaussian noise of known variance, whatever the mean.

    It is for frames whose counts are no longer Poisson and come with an error estimate: sums and
    differences of frames, or frames in physical units.

    Parameters
    ----------
    variance : float or array_like, shape (ny, nx), counts^2
        The variance of every pixel. Give a pixel without one any positive number, and mask it.

    Raises
    ------
    InputError
        If a variance is not a positive finite number.

    Examples
    --------
    >>> noise = GaussianNoise(4.0)
    >>> noise.residual(np.array([3.0]), np.array([1.0]), 0.0)
    array([1.])
    """

    variance: float | Floats

    def __post_init__(self) -> None:
        try:
            variance = np.array(self.variance, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("noise: variance: got no numbers, expected counts^2") from None
        bad = ~(np.isfinite(variance) & (variance > 0.0))
        if bad.any():
            raise InputError(
                f"noise: variance: got {variance[bad].ravel()[0]:g} in {bad.sum()} pixels, "
                "expected positive numbers: mask such pixels and give them any variance"
            )
        variance.flags.writeable = False
        object.__setattr__(self, "variance", variance if variance.ndim else float(variance))

    def terms(self, values: Floats) -> GaussianTerms:
        norm = -0.5 * math.log(2.0 * math.pi)
        if isinstance(self.variance, float):
            norm -= 0.5 * math.log(self.variance)
            return GaussianTerms(1.0 / self.variance, norm, None, _sums(values, 1.0))
        weights = np.ones(values.shape)
        weights[:, : self.variance.shape[1]] = 1.0 / self.variance
        return GaussianTerms(1.0, norm, weights.ravel(), _sums(values, weights))

    def constant(self, counts: Floats, used: Flags) -> float:
        if isinstance(self.variance, float):
            return 0.0
        return -0.5 * float(np.sum(np.log(self.variance[used])))

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        if np.shape(self.variance) not in ((), counts.shape):
            raise InputError(
                f"noise: variance: got shape {np.shape(self.variance)}, expected a number or the "
                f"frame's shape {counts.shape}"
            )

    def highest(self, counts: Floats) -> Floats:
        norm = -0.5 * math.log(2.0 * math.pi)
        if isinstance(self.variance, float):
            norm -= 0.5 * math.log(self.variance)
        return np.full(counts.shape, norm)

    def at(self, pixels: Any) -> "GaussianNoise":
        if isinstance(self.variance, float):
            return self
        return GaussianNoise(self.variance[pixels])

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        return rng.normal(sources + background, np.sqrt(self.variance))

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return np.ones_like(mean) / self.variance

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float
    ) -> tuple[Floats, Floats]:
        r, sd = counts - mean, np.sqrt(self.variance)
        return ndtr((r - 0.5 * grain) / sd), ndtr((r + 0.5 * grain) / sd)


@serializable("noise.background")
@dataclass(frozen=True)
class BackgroundNoise(_Gaussian):
    """The paper's noise: the sources' image is exact, the background alone is random.

    A frame is the source image plus Poisson(lambda). It is fitted as a Gaussian of mean source
    image + lambda and variance lambda, for which the most likely theta minimises the paper's
    V(theta), the sum of squared residuals.

    References
    ----------
    Sun & Zhou, Section 4.2.

    Examples
    --------
    >>> BackgroundNoise().fisher_weight(np.array([25.0]), 5.0)
    array([0.2])
    """

    def terms(self, values: Floats) -> BackgroundTerms:
        return BackgroundTerms(_sums(values, 1.0))

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        if flux == "free" or background_order:
            raise InputError(
                "noise: got BackgroundNoise with free fluxes or a varying background, expected "
                "fixed or scaled fluxes and background_order 0: use PoissonNoise"
            )

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        return sources + drawn(np.broadcast_to(background, sources.shape), rng)

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return np.ones_like(mean) / background

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float
    ) -> tuple[Floats, Floats]:
        """Of the Poisson counts of the background, which are integers but for errors of the fit."""
        n = counts - mean + background
        return poisson_cdf(n - 0.5, background), poisson_cdf(n + 0.5, background)

    def deviance_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """Of counts that are Poisson, not Gaussian."""
        return (2.0 + 1.0 / background) * np.ones_like(mean)

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """Of counts that are Poisson, fitted as a Gaussian: see `optimize/fit_statistics`."""
        return 2.0 * np.ones_like(mean) * (background / (background + 0.5)) ** 2
