"""The Moffat PSF: a core like a Gaussian's, wings that fall as a power."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.fastmath import exp2, log2
from bayesfred.imaging.psf.protocol import FWHM
from bayesfred.io.serialize import serializable

LARGEST_BETA = 100.0  # beyond, (1 + x)^-beta loses digits, and is a Gaussian to 1 %


class MoffatProfile(NamedTuple):
    """norm (1 + (a^2 + b^2) / square)^-beta, see `imaging/kernels/psf_dispatch`.

    With z = 1 + (a^2 + b^2) / square and w = 2 beta / (square z), p_a = -a w p and
    p_aa = w ((1 + 1/beta) w a^2 - 1) p.
    """

    norm: float
    square: float
    beta: float

    @staticmethod
    def radial_scale(psf: Any) -> Any:
        return 1.0 / psf.square

    @staticmethod
    def new_places(psf: Any, width: Any) -> Any:
        return np.empty(width)

    @staticmethod
    def find_places(psf: Any, pixels: Any, work: Any, degrees: Any, places: Any) -> Any:
        # logarithms first: two short loops have more pixels in flight than a long one
        (t0, ramp, size), r, top, power = pixels, work[0], len(degrees.q), -psf.beta
        for n in range(size):
            t = t0 + ramp[n]
            z = r[top]
            for m in range(top):
                z = z * t + r[top - 1 - m]
            places[n] = power * log2(z + 1.0)

    @staticmethod
    def at_place(psf: Any, places: Any, n: Any) -> Any:
        return exp2(places[n])

    @staticmethod
    def slopes(psf: Any, a: Any, b: Any) -> Any:
        z = (a * a + b * b) * (1.0 / psf.square) + 1.0
        p = exp2(-psf.beta * log2(z))
        k = 2.0 * psf.beta / (psf.square * z) * p
        return p, k * a, k * b

    @staticmethod
    def second_derivatives(psf: Any, a: Any, b: Any) -> Any:
        z = (a * a + b * b) * (1.0 / psf.square) + 1.0
        w = 2.0 * psf.beta / (psf.square * z)
        k = w * exp2(-psf.beta * log2(z))
        h = (1.0 + 1.0 / psf.beta) * w * k
        return k * a, k * b, h * a * a - k, h * a * b, h * b * b - k


@serializable("psf.moffat")
@dataclass(frozen=True)
class MoffatPSF:
    """Circular Moffat function.

    p(a, b) = (beta - 1) / (pi alpha^2) (1 + (a^2 + b^2) / alpha^2)^-beta.

    Its wings fall as a power and reach far: with beta 3 it is above 1e-8 of its peak within 21
    alpha. Beyond a tolerance t lies the part t^(1 - 1/beta) of the flux, which is not counted: 5e-6
    of it in this case.

    Parameters
    ----------
    fwhm : float, pixel
        Full width at half maximum, 2 alpha sqrt(2^(1/beta) - 1).
    beta : float
        Exponent of the wings: > 1, without which their flux has no bound, and at most 100. It tends
        to a Gaussian as beta grows.

    Raises
    ------
    InputError
        If `fwhm` is not a positive finite number, or `beta` is out of range.

    References
    ----------
    A. F. J. Moffat, "A theoretical investigation of focal stellar images in the photographic
    emulsion and application to photographic photometry", Astronomy & Astrophysics 3, 455 (1969).

    Examples
    --------
    >>> psf = MoffatPSF(fwhm=4.0, beta=3.0)
    >>> round(float(psf.density(2.0, 0.0) / psf.peak), 9), round(psf.sigma, 3)
    (0.5, 1.699)
    """

    fwhm: float
    beta: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.fwhm) and self.fwhm > 0):
            raise InputError(f"psf: fwhm: got {self.fwhm}, expected a positive width in pixels")
        if not 1.0 < self.beta <= LARGEST_BETA:
            raise InputError(
                f"psf: beta: got {self.beta}, expected 1 < beta <= {LARGEST_BETA:g}: use a "
                "Gaussian in place of larger ones"
            )
        object.__setattr__(self, "fwhm", float(self.fwhm))
        object.__setattr__(self, "beta", float(self.beta))

    @property
    def sigma(self) -> float:
        """Width of the Gaussian with the same full width at half maximum, pixel."""
        return self.fwhm / FWHM

    @property
    def alpha(self) -> float:
        """Radius of the core, pixel."""
        return 0.5 * self.fwhm / math.sqrt(math.expm1(math.log(2.0) / self.beta))

    @property
    def peak(self) -> float:
        """Largest value of the PSF, per square pixel."""
        return (self.beta - 1.0) / (math.pi * self.alpha**2)

    @property
    def core(self) -> tuple[float, float]:
        """See `PSF`; the width is the one that the peak's curvature gives."""
        return self.alpha / math.sqrt(2.0 * self.beta), self.beta

    @property
    def profile(self) -> MoffatProfile:
        """The PSF of unit width as the compiled loops need it."""
        square = (self.alpha / self.sigma) ** 2
        return MoffatProfile((self.beta - 1.0) / (math.pi * square), square, self.beta)

    def support_radius(self, tolerance: float) -> float:
        """Distance from the middle beyond which p is below `tolerance` times its peak, pixel."""
        return (
            self.alpha * math.sqrt(tolerance ** (-1.0 / self.beta) - 1.0)
            if tolerance > 0
            else math.inf
        )

    def density(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Floats:
        """The PSF at (a, b), pixel from its middle; per square pixel."""
        return np.asarray(
            self.peak * (1.0 + (np.square(a) + np.square(b)) / self.alpha**2) ** -self.beta
        )
