"""What the package asks of a noise model.

A noise model is one module with two classes. The public frozen dataclass derives from `Noise`: it
draws frames and gives, pixel by pixel, the log-likelihood, its derivative with respect to the mean
(the score), the expected information (the Fisher weight) and the deviance. These are the
definitions. The compiled half evaluates the same formulas over whole frames; it is described in
`model/kernels/noise_dispatch`.
"""

from abc import abstractmethod
from typing import Any, Protocol, Self

import numpy as np

from bayesfred._typing import Flags, Floats


class Noise(Protocol):
    """A distribution of counts; `background` and `mean` are counts per pixel.

    Every argument of a method is an array or a number. The arrays of a model whose pixels differ
    belong to all pixels of the frame, or to those of `at`.
    """

    @property
    def discrete(self) -> bool:
        """Whether counts are integers that have probabilities; others have densities."""
        return False

    @property
    def pixelwise(self) -> "Noise":
        """The noise of every pixel by itself."""
        return self

    @abstractmethod
    def terms(self, values: Floats) -> Any:
        """The compiled half for a frame of padded rows, MASKED where a pixel is not used."""

    def with_unreached(self, terms: Any, values: Floats) -> Any:
        """That compiled half with what its `unreached` needs, where it is asked at all."""
        return terms

    def constant(self, counts: Floats, used: Flags) -> float:
        """The part of the log-likelihood that depends on the counts alone, for the pixels in use.

        The compiled half leaves it out.
        """
        return 0.0

    def check(self, counts: Floats, used: Flags, flux: str, background_order: int) -> None:
        """Raise InputError if the model explains no such counts, or admits no such nuisances."""
        return

    def at(self, pixels: Any) -> Self:
        """The noise of the pixels that an index selects."""
        return self

    def highest(self, counts: Floats) -> Floats | None:
        """Supremum over the mean of the compiled log-density, for the counts of every pixel.

        None where the model admits no model error.
        """
        return None

    @abstractmethod
    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        """A frame drawn from the expected counts of the sources and of the background."""

    @abstractmethod
    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """Log-probability (density) of each pixel's counts."""

    @abstractmethod
    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        """Expected information about the mean."""

    def counts_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """Variance of the counts."""
        return np.asarray(1.0 / self.fisher_weight(mean, background))

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """Derivative of the log-likelihood with respect to the mean."""
        return (counts - mean) * self.fisher_weight(mean, background)

    def residual(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """(counts - mean) in standard deviations."""
        return np.asarray((counts - mean) / np.sqrt(self.counts_variance(mean, background)))

    def deviance(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """Unit deviance, twice the log-likelihood lost by a mean that is not the counts."""
        return self.residual(counts, mean, background) ** 2

    def deviance_moments(
        self, mean: Floats, background: float | Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Mean and variance of the unit deviance if the model is true, and the mean's slope."""
        ones = np.ones_like(mean)
        return ones, self.pearson_variance(mean, background), 0.0 * ones

    def cumulative(
        self, counts: Floats, mean: Floats, background: float | Floats, grain: float
    ) -> tuple[Floats, Floats] | None:
        """Probabilities of fewer counts than these, and of these or fewer.

        Counts come in steps of `grain`, of which a continuous distribution has the interval around
        each. None where the model does not say.
        """
        return None

    def deviance_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """Variance of the unit deviance for a background that is known."""
        return self.deviance_moments(mean, background)[1]

    def pearson_variance(self, mean: Floats, background: float | Floats) -> Floats:
        """Variance of a squared residual, less what a fitted background explains of it."""
        return 2.0 * np.ones_like(mean)
