"""Counts from which known light was subtracted: their noise is that of the counts before.

A pixel that records n counts, b of which are expected from light that the model does not describe,
such as a ghost, has n - b in the frame that is fitted. Its mean is that of the model, mu, so the
light, the background, their derivatives and their residuals stay what they are in a frame without
such light. Only the noise knows b, and exactly, as b does not depend on mu:

    log p(n - b | mu) = log p_0(n | mu + b),

p_0 being the noise's law of the recorded counts. Score, weight and C are those of p_0 at mu + b.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.kernels.noise_dispatch import derivatives, information, log_density, spread
from bayesfred.model.noise.flat_field import FlatFieldNoise
from bayesfred.model.noise.poisson import PoissonNoise
from bayesfred.model.noise.protocol import Noise


class SubtractedTerms(NamedTuple):
    """A noise of counts that lack known light, see `model/kernels/noise_dispatch`."""

    base: Any  # the compiled half of the noise of the recorded counts
    known: Floats  # (ny * stride,) counts that were subtracted

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        b = noise.known[p]
        return log_density(noise.base, n + b, mu + b, light, p)

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        b = noise.known[p]
        return derivatives(noise.base, n + b, mu + b, light, p)

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        return information(noise.base, mu + noise.known[p], light, p)

    @staticmethod
    def spread(noise: Any, mu: Any, p: Any) -> Any:
        return spread(noise.base, mu + noise.known[p], p)


@serializable("subtracted")
@dataclass(frozen=True, eq=False)
class SubtractedNoise(Noise):
    """The noise of counts from which known light was subtracted.

    The counts of a `Posterior` with this noise are the recorded ones less `light`; expected counts
    and the background are what is expected besides. `simulate` draws such counts, too. Errors of
    the light itself are not included. `subtract_background` makes such a posterior.

    Parameters
    ----------
    noise : PoissonNoise or FlatFieldNoise
        Of the counts before.
    light : array_like, shape (ny, nx), counts
        What was subtracted, not negative. Under a flat field: from the flat-fielded counts.

    Raises
    ------
    InputError
        If some light is negative or not finite, or the noise is another one. Gaussian noise needs
        no such class, as its variance does not depend on the mean.

    Examples
    --------
    >>> noise = SubtractedNoise(PoissonNoise(), [0.0, 30.0])
    >>> noise.counts_variance(np.array([8.0, 8.0]), 8.0)
    array([ 8., 38.])
    """

    noise: PoissonNoise | FlatFieldNoise
    light: Floats

    def __post_init__(self) -> None:
        if not isinstance(self.noise, PoissonNoise | FlatFieldNoise):
            raise InputError(
                f"noise: noise: got {type(self.noise).__name__} with known light, expected "
                "PoissonNoise or FlatFieldNoise: a GaussianNoise is that of the counts after, too"
            )
        try:
            light = np.array(self.light, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("noise: light: got no numbers, expected counts") from None
        bad = ~(np.isfinite(light) & (light >= 0.0))
        if bad.any() or not light.ndim:
            raise InputError(
                f"noise: light: got {light[bad][0] if bad.any() else light:g} in "
                f"{max(bad.sum(), 1)} pixels, expected an array of counts >= 0"
            )
        light.flags.writeable = False
        object.__setattr__(self, "light", light)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, SubtractedNoise)
            and self.noise == other.noise
            and np.array_equal(self.light, other.light)
        )

    def __hash__(self) -> int:
        return hash((self.noise, self.light.tobytes()))

    @property
    def discrete(self) -> bool:
        return self.noise.discrete

    def terms(self, values: Floats) -> SubtractedTerms:
        known = np.zeros(values.shape)
        known[:, : self.light.shape[1]] = self.light
        recorded = np.where(values > LIMIT, values + known, MASKED)
        return SubtractedTerms(self.noise.terms(recorded), known.ravel())

    def constant(self, counts: Floats, used: Flags) -> float:
        return self.noise.constant(self._recorded(counts), used)

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        if self.light.shape != counts.shape:
            raise InputError(
                f"noise: light: got shape {self.light.shape}, expected the frame's shape "
                f"{counts.shape}"
            )
        self.noise.check(self._recorded(counts), used, flux, background_order)

    def at(self, pixels: Any) -> "SubtractedNoise":
        return SubtractedNoise(self.noise.at(pixels), self.light[pixels])

    def highest(self, counts: Floats) -> Floats | None:
        return self.noise.highest(self._recorded(counts))

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        return self.noise.draw(sources, background + self.light, rng) - self.light

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.log_likelihood(self._recorded(counts), mean + self.light, 0.0)

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.score(self._recorded(counts), mean + self.light, 0.0)

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.fisher_weight(mean + self.light, 0.0)

    def counts_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.counts_variance(mean + self.light, 0.0)

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.pearson_variance(mean + self.light, 0.0)

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float | Floats
    ) -> tuple[Floats, Floats]:
        # under a model error these are no whole numbers
        return self.noise.cumulative(counts + self.light, mean + self.light, 0.0, grain)

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.deviance(self._recorded(counts), mean + self.light, 0.0)

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        return self.noise.deviance_moments(mean + self.light, 0.0)

    def _recorded(self, counts: Floats) -> Floats:
        """The counts before; whole numbers again where photons alone are counted."""
        recorded = counts + self.light
        plain = self.noise if isinstance(self.noise, PoissonNoise) else None
        return np.rint(recorded) if plain is not None and plain.discrete else recorded
