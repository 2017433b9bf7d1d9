"""What noise does to expected counts, one class a distribution.

Each class draws frames and gives, pixel by pixel, the log-likelihood, its derivative with respect
to the mean (the score), the expected information (the Fisher weight) and the standardised residual.
These are the definitions; the compiled loops in `kernels` evaluate the same formulas over whole
frames.
"""

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
import numpy.typing as npt
from scipy.special import gammaln, xlogy

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.forward import ForwardModel
from bayesfred.io.serialize import serializable
from bayesfred.model.kernels.likelihood import GAUSSIAN, POISSON

NOTHING = 1e-300  # stands for an expected count of zero, at which nothing but zero can be counted


class Noise(Protocol):
    """What a noise model offers; `background` and `mean` are counts per pixel."""

    kind: ClassVar[int]

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        """A frame drawn from the expected counts of the sources and of the background."""

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """Log-probability (density) of each pixel's counts."""

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """Derivative of the log-likelihood with respect to the mean."""

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        """Expected information about the mean, one over the variance."""

    def residual(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        """(counts - mean) in standard deviations."""


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
    kind: ClassVar[int] = POISSON

    def __post_init__(self) -> None:
        if not (math.isfinite(self.read_noise) and self.read_noise >= 0):
            raise InputError(
                f"noise: read_noise: got {self.read_noise}, expected a standard deviation >= 0 in "
                "counts"
            )

    @property
    def shift(self) -> float:
        """Variance of the read noise, added to counts and mean."""
        return self.read_noise**2

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

    def residual(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return (counts - mean) / np.sqrt(np.maximum(mean + self.shift, NOTHING))


@serializable("noise.background")
@dataclass(frozen=True)
class BackgroundNoise(Noise):
    """The paper's noise: the sources' image is exact and only the background, Poisson(lambda), is random.

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

    kind: ClassVar[int] = GAUSSIAN
    read_noise: ClassVar[float] = 0.0
    shift: ClassVar[float] = 0.0

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        return sources + rng.poisson(np.broadcast_to(background, sources.shape))

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return np.asarray(
            -0.5 * (counts - mean) ** 2 / background - 0.5 * np.log(2.0 * np.pi * background)
        )

    def score(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return (counts - mean) / background

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return np.ones_like(mean) / background

    def residual(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return np.asarray((counts - mean) / np.sqrt(background))


def simulate(
    model: ForwardModel,
    theta: npt.ArrayLike,
    background: float,
    *,
    seed: int | np.random.SeedSequence,
    noise: PoissonNoise | BackgroundNoise = PoissonNoise(),
) -> Floats:
    """Draw a frame.

    Parameters
    ----------
    model : ForwardModel
    theta : array_like, shape (n_terms,), pixel^(1 - degree of the term)
    background : float, counts per pixel
        Constant background, >= 0.
    seed : int or SeedSequence
    noise : PoissonNoise or BackgroundNoise

    Returns
    -------
    ndarray, shape (ny, nx), counts

    Raises
    ------
    InputError
        If the background is negative or not finite, or `theta` has another shape.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((33, 33)), bf.SourceCatalog([0.0], [0.0], [100.0]), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion.mirrored())
    >>> bf.simulate(model, np.zeros(12), 1.0, seed=1).shape
    (33, 33)
    """
    if not (math.isfinite(background) and background >= 0):
        raise InputError(
            f"background: got {background}, expected a number of counts per pixel >= 0"
        )
    return noise.draw(model.expected_counts(theta), background, np.random.default_rng(seed))
