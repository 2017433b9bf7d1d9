"""Counts whose noise neighbouring pixels share, as after a frame was resampled or smoothed.

Let v be the variance of a pixel's counts and rho(l) the correlation of pixels at a distance l. The
estimate of a source's position weighs pixels by a template t that changes little from one pixel to
the next, and its variance is c^2 times that with independent pixels of the same scatter v, with c^2
= sum_l rho(l) (t * t)(l) / sum t^2. Let s and H be the score and the information of independent
pixels. Then s has the covariance c^2 H, and

    log p / c^2

has the score s / c^2, of the covariance H / c^2, which is its information: the posterior that it
makes is as wide as the maximum scatters. The maximum itself is that of independent pixels. What a
pixel by itself does, such as its deviance, is not changed.

References
----------
S. Casertano et al. (2000), Astronomical Journal 120, 2747, appendix A: noise of resampled frames.
C. Varin, N. Reid, D. Firth (2011), Statistica Sinica 21, 5: composite likelihoods, their power.
"""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.noise_dispatch import (
    derivatives,
    error_information,
    error_slopes,
    given,
    information,
    level_derivatives,
    log_density,
    summed,
    unreached,
)
from bayesfred.model.noise.model_error import ModelErrorNoise
from bayesfred.model.noise.protocol import Noise

LARGEST = 10.0  # ratio


class CorrelatedTerms(NamedTuple):
    """A noise that pixels share, see `model/kernels/noise_dispatch`."""

    base: Any  # the compiled half of the noise of independent pixels
    share: float  # 1 / c^2

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        return noise.share * log_density(noise.base, n, mu, light, p)

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        s, w, c = derivatives(noise.base, n, mu, light, p)
        return noise.share * s, noise.share * w, noise.share * c

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        return noise.share * information(noise.base, mu, light, p)

    @staticmethod
    def summed(noise: Any, values: Any, light: Any, mean: Any, place: Any) -> Any:
        return noise.share * summed(noise.base, values, light, mean, place)

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        value, slope, known = unreached(noise.base, rest, level)
        return noise.share * value, noise.share * slope, noise.share * known

    @staticmethod
    def given(noise: Any, parameters: Any) -> Any:
        return CorrelatedTerms(given(noise.base, parameters), noise.share)

    @staticmethod
    def level_derivatives(noise: Any, pixels: Any, level: Any, value: Any) -> Any:
        slope, known = level_derivatives(noise.base, pixels, level, value / noise.share)
        return noise.share * slope, noise.share * known


class CorrelatedErrorTerms(CorrelatedTerms):
    """The same of a noise with a model error, `ModelErrorTerms`."""

    @staticmethod
    def given(noise: Any, parameters: Any) -> Any:
        return CorrelatedErrorTerms(given(noise.base, parameters), noise.share)

    @staticmethod
    def exact_weight(noise: Any) -> Any:
        return False

    @staticmethod
    def error_information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        return noise.share * error_information(noise.base, mu, light, p)

    @staticmethod
    def error_slopes(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        a, b, c, d, e, f, g = error_slopes(noise.base, n, mu, light, p)
        k = noise.share
        return k * a, k * b, k * c, k * d, k * e, k * f, k * g


@serializable("correlated")
@dataclass(frozen=True)
class CorrelatedNoise(Noise):
    """Noise that neighbouring pixels share: of frames that were resampled, smoothed or sharpened.

    Every pixel's counts scatter as `noise` says, but not independently. The verdict of a fit tells
    the ratio where it finds such noise. The posterior is as wide as positions and distortion are
    uncertain; where pixels are correlated positively, fluxes and the background are more uncertain
    still. `simulate` draws independent pixels.

    Parameters
    ----------
    noise : Noise
        Of every pixel by itself. In a frame that was smoothed it is less than that of the photons:
        a gain by photon transfer takes that into account.
    ratio : float
        The noise correlation ratio of positions: their errors over those with independent pixels
        of the same scatter.

    Raises
    ------
    InputError
        If the ratio is below 0.1 or above 10; if the noise is a correlated one itself.

    Examples
    --------
    >>> from bayesfred.model.noise import PoissonNoise
    >>> noise, mean = CorrelatedNoise(PoissonNoise(), 2.0), np.array([100.0])
    >>> noise.fisher_weight(mean, 9.0), noise.residual(np.array([120.0]), mean, 9.0)
    (array([0.0025]), array([2.]))
    """

    noise: Noise
    ratio: float

    def __post_init__(self) -> None:
        if not hasattr(self.noise, "terms") or isinstance(self.noise, CorrelatedNoise):
            raise InputError(
                f"noise: noise: got {type(self.noise).__name__}, expected that of every pixel by "
                "itself, such as PoissonNoise"
            )
        if not (isinstance(self.ratio, int | float) and 1.0 / LARGEST <= self.ratio <= LARGEST):
            raise InputError(
                f"noise: ratio: got {self.ratio!r}, expected a number from {1.0 / LARGEST:g} to "
                f"{LARGEST:g}"
            )

    @property
    def discrete(self) -> bool:
        return self.noise.discrete

    @property
    def pixelwise(self) -> Noise:
        return self.noise

    @property
    def share(self) -> float:
        """1 / c^2."""
        return 1.0 / self.ratio**2

    def terms(self, values: Floats) -> CorrelatedTerms:
        return CorrelatedTerms(self.noise.terms(values), self.share)

    def constant(self, counts: Floats, used: Flags) -> float:
        return self.share * self.noise.constant(counts, used)

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        self.noise.check(counts, used, flux, background_order)

    def at(self, pixels: Any) -> "CorrelatedNoise":
        return CorrelatedNoise(self.noise.at(pixels), self.ratio)

    def highest(self, counts: Floats) -> Floats | None:
        return self.noise.highest(counts)

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        return self.noise.draw(sources, background, rng)

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.share * self.noise.log_likelihood(counts, mean, background)

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.share * self.noise.score(counts, mean, background)

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return self.share * self.noise.fisher_weight(mean, background)

    def counts_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """As independent pixels would need it for sources to be as uncertain as they are."""
        return self.noise.counts_variance(mean, background) / self.share

    # what a pixel does by itself

    def residual(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.residual(counts, mean, background)

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.deviance(counts, mean, background)

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        return self.noise.deviance_moments(mean, background)

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.pearson_variance(mean, background)

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float
    ) -> tuple[Floats, Floats] | None:
        return self.noise.cumulative(counts, mean, background, grain)


def with_model_error(noise: Noise, error: float, slope: Floats) -> Noise:
    """A noise with a model error, see `ModelErrorNoise`, correlated as it is."""
    alone = ModelErrorNoise(noise.pixelwise, error, slope)
    return replace(noise, noise=alone) if isinstance(noise, CorrelatedNoise) else alone


def correlated_terms(noise: Noise, terms: Any) -> Any:
    """The compiled half of a noise, given that of its pixels by themselves."""
    if not isinstance(noise, CorrelatedNoise):
        return terms
    kind = CorrelatedErrorTerms if hasattr(terms, "exact_weight") else CorrelatedTerms
    return kind(terms, noise.share)


def correlation_ratio(noise: Noise) -> float:
    """The ratio of a `CorrelatedNoise`; 1 of any other."""
    return noise.ratio if isinstance(noise, CorrelatedNoise) else 1.0
