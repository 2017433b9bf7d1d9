"""Pixels that respond differently to light: the noise of counts divided by a flat field.

A pixel of relative response f that should count mu counts n, of mean f mu. The frame that is fitted
is n / f, as every reduced frame is: its mean is mu, so the light, the background, their derivatives
and their residuals stay what they are without a flat field. Only the noise knows f, and exactly:

    log p(n / f | mu) = log p_0(n | f mu) + log f,

p_0 being the noise's density of the counts themselves; where these have probabilities, there is no
log f. By mu the score is f s, the weight f^2 W and C becomes f^3 C, taken at f mu.

Over the pixels that no source reaches, counts and their sum do not suffice any longer. Their sum of
log p is a series in the level, as `model/kernels/read_noise` has it.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.contexts import LIMIT, MASKED
from bayesfred.model.kernels.mean_series import MeanSeries, no_mean_series
from bayesfred.model.kernels.noise_dispatch import (
    derivatives,
    information,
    log_density,
    spread,
    summed_exactly,
)
from bayesfred.model.kernels.read_noise import LevelSeries, level_series, no_series, sum_unreached
from bayesfred.model.noise.poisson import PoissonNoise
from bayesfred.model.noise.protocol import Noise

LEAST_RESPONSE, MOST_RESPONSE = 0.01, 100.0


class FlatFieldTerms(NamedTuple):
    """A noise of counts divided by a flat field, see `model/kernels/noise_dispatch`."""

    base: Any  # the compiled half of the noise of the counts themselves
    counts: Floats  # (ny * stride,) themselves, MASKED where a pixel is not used
    response: Floats  # (ny * stride,)
    level: LevelSeries
    near: MeanSeries

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        f = noise.response[p]
        return log_density(noise.base, f * n, f * mu, f * light, p)

    @staticmethod
    def summed(noise: Any, values: Any, light: Any, mean: Any, place: Any) -> Any:
        a, b = place[0], place[0] + values.size
        scaled = (mean[0], mean[1], noise.response[a:b])
        return summed_exactly(noise.base, noise.counts[a:b], light, scaled, place)

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        f = noise.response[p]
        s, w, c = derivatives(noise.base, f * n, f * mu, f * light, p)
        return f * s, f * f * w, f * f * f * c

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        f = noise.response[p]
        return f * f * information(noise.base, f * mu, f * light, p)

    @staticmethod
    def spread(noise: Any, mu: Any, p: Any) -> Any:
        f = noise.response[p]
        variance, slope = spread(noise.base, f * mu, p)
        return variance / (f * f), slope / f

    @staticmethod
    def unreached(noise: Any, rest: Any, level: Any) -> Any:
        return sum_unreached(noise, rest, level)


@serializable("flat_field")
@dataclass(frozen=True, eq=False)
class FlatFieldNoise(Noise):
    """The noise of counts that were divided by a flat field.

    The counts of a `Posterior` with this noise are flat-fielded: the recorded counts over the
    response. Expected counts, fluxes and the background are those of pixels of response 1. Pixels
    that respond little are noisier then, and the model knows by how much: the recorded counts, not
    the flat-fielded ones, have Poisson's distribution. `simulate` draws flat-fielded counts, too.
    Errors of the flat field itself are not included.

    Parameters
    ----------
    noise : PoissonNoise
        Of the recorded counts. Its read noise is in recorded counts.
    response : array_like, shape (ny, nx)
        Counts that a pixel records for one that a pixel of response 1 records. Give a dead pixel
        any response, and mask it.

    Raises
    ------
    InputError
        If a response is not between 0.01 and 100, or the noise is another one. Gaussian noise needs
        no such class: give `GaussianNoise(variance / response**2)`.

    Examples
    --------
    >>> noise = FlatFieldNoise(PoissonNoise(), [0.5, 1.0])
    >>> noise.counts_variance(np.array([8.0, 8.0]), 8.0)
    array([16.,  8.])
    """

    noise: PoissonNoise
    response: Floats

    def __post_init__(self) -> None:
        if not isinstance(self.noise, PoissonNoise):
            raise InputError(
                f"noise: noise: got {type(self.noise).__name__} under a flat field, expected "
                "PoissonNoise: give GaussianNoise(variance / response**2) as it is"
            )
        try:
            response = np.array(self.response, dtype=np.float64)
        except (TypeError, ValueError):
            raise InputError("noise: response: got no numbers, expected a flat field") from None
        bad = ~((response >= LEAST_RESPONSE) & (response <= MOST_RESPONSE))
        if bad.any() or not response.ndim:
            raise InputError(
                f"noise: response: got {response[bad][0] if bad.any() else response:g} in "
                f"{max(bad.sum(), 1)} pixels, expected an array of numbers from "
                f"{LEAST_RESPONSE:g} to {MOST_RESPONSE:g}, 1 being normal: mask such pixels and "
                "give them any response"
            )
        response.flags.writeable = False
        object.__setattr__(self, "response", response)

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, FlatFieldNoise)
            and self.noise == other.noise
            and np.array_equal(self.response, other.response)
        )

    def __hash__(self) -> int:
        return hash((self.noise, self.response.tobytes()))

    @property
    def discrete(self) -> bool:
        return self.noise.discrete

    def terms(self, values: Floats) -> FlatFieldTerms:
        response = np.ones(values.shape)
        response[:, : self.response.shape[1]] = self.response
        counts = np.where(values > LIMIT, values * response, MASKED)
        return FlatFieldTerms(
            self.noise.terms(counts),
            counts.ravel(),
            response.ravel(),
            no_series(),
            no_mean_series(),
        )

    def with_unreached(self, terms: FlatFieldTerms, values: Floats) -> FlatFieldTerms:
        variance = float(np.median(np.square(self.noise.read_noise)))
        return terms._replace(level=level_series(terms, values, variance))

    def constant(self, counts: Floats, used: Flags) -> float:
        return self.noise.constant(counts * self.response, used) + float(
            np.sum(self._log_response()[used])
        )

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        if self.response.shape != counts.shape:
            raise InputError(
                f"noise: response: got shape {self.response.shape}, expected the frame's shape "
                f"{counts.shape}"
            )
        self.noise.check(counts * self.response, used, flux, background_order)

    def at(self, pixels: Any) -> "FlatFieldNoise":
        return FlatFieldNoise(self.noise.at(pixels), self.response[pixels])

    def highest(self, counts: Floats) -> Floats | None:
        return self.noise.highest(counts * self.response)

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        f = self.response
        return self.noise.draw(sources * f, background * f, rng) / f

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        f = self.response
        return self.noise.log_likelihood(counts * f, mean * f, 0.0) + self._log_response()

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        f = self.response
        return self.noise.score(counts * f, mean * f, 0.0) * f

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.fisher_weight(mean * self.response, 0.0) * self.response**2

    def counts_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.counts_variance(mean * self.response, 0.0) / self.response**2

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.pearson_variance(mean * self.response, 0.0)

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float | Floats
    ) -> tuple[Floats, Floats]:
        f = self.response
        return self.noise.cumulative(counts * f, mean * f, 0.0, grain * f)

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return self.noise.deviance(counts * self.response, mean * self.response, 0.0)

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        expected, variance, slope = self.noise.deviance_moments(mean * self.response, 0.0)
        return expected, variance, slope * self.response

    def _log_response(self) -> Floats:
        return np.zeros(self.response.shape) if self.discrete else np.log(self.response)
