"""The Gaussian PSF."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.fastmath import LOG2_E, exp2
from bayesfred.io.serialize import serializable


class GaussianProfile(NamedTuple):
    """norm exp(-(a^2 + b^2) / 2), see `imaging/kernels/psf_dispatch`."""

    norm: float

    @staticmethod
    def radial_scale(psf: Any) -> Any:
        return -0.5 * LOG2_E

    @staticmethod
    def radial(psf: Any, z: Any) -> Any:
        return exp2(z)

    @staticmethod
    def line(psf: Any, a: Any) -> Any:
        f = exp2(-0.5 * LOG2_E * a * a)
        return f, a * f, a * a * f - f

    @staticmethod
    def slopes(psf: Any, a: Any, b: Any) -> Any:
        p = exp2(-0.5 * LOG2_E * (a * a + b * b))
        return p, a * p, b * p

    @staticmethod
    def second_derivatives(psf: Any, a: Any, b: Any) -> Any:
        p = exp2(-0.5 * LOG2_E * (a * a + b * b))
        return a * p, b * p, a * a * p - p, a * b * p, b * b * p - p


@serializable("psf.gaussian")
@dataclass(frozen=True)
class GaussianPSF:
    """Circular Gaussian, p(a, b) = exp(-(a^2 + b^2) / 2 sigma^2) / (2 pi sigma^2).

    Parameters
    ----------
    sigma : float, pixel
        Standard deviation along each axis; the full width at half maximum is 2.355 sigma.

    Raises
    ------
    InputError
        If `sigma` is not a positive finite number.

    References
    ----------
    Sun & Zhou, Section 2.3 (the reference PSF of their simulations).

    Examples
    --------
    >>> round(GaussianPSF(10.0).peak, 9)
    0.001591549
    """

    sigma: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma) and self.sigma > 0):
            raise InputError(f"psf: sigma: got {self.sigma}, expected a positive width in pixels")
        object.__setattr__(self, "sigma", float(self.sigma))

    @property
    def peak(self) -> float:
        """Largest value of the PSF, per square pixel."""
        return 1.0 / (2.0 * math.pi * self.sigma**2)

    @property
    def core(self) -> tuple[float, float]:
        """See `PSF`; the width is the one that the peak's curvature gives."""
        return self.sigma, math.inf

    @property
    def profile(self) -> GaussianProfile:
        """The PSF of unit width as the compiled loops need it."""
        return GaussianProfile(1.0 / (2.0 * math.pi))

    def support_radius(self, tolerance: float) -> float:
        """Distance from the middle beyond which p is below `tolerance` times its peak, pixel."""
        return self.sigma * math.sqrt(-2.0 * math.log(tolerance)) if tolerance > 0 else math.inf

    def density(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Floats:
        """The PSF at (a, b), pixel from its middle; per square pixel."""
        return np.asarray(self.peak * np.exp(-0.5 * (np.square(a) + np.square(b)) / self.sigma**2))
