"""What the package asks of a family of PSFs.

Every family has one width, `sigma`: that of the Gaussian with the same full width at half maximum,
FWHM = 2.355 sigma. Where inference leaves the width free, this is the parameter, and p widens as a
whole, p(a s, b s) s^2 with s the ratio of widths. Lengths are in pixels of the fine grid.

A family is one module with two classes: the public frozen dataclass, and its compiled half, which
is described in `imaging/kernels/psf_dispatch`. One that varies over the field, or has the pixel's
response in it, has more attributes, see `measured.py`; the functions here answer for those that do
not.
"""

import math
from typing import Any, Protocol

import numpy.typing as npt

from bayesfred._typing import Floats

FWHM = math.sqrt(8.0 * math.log(2.0))  # of a Gaussian of unit width


class PSF(Protocol):
    """A point spread function p(a, b) of unit volume."""

    @property
    def sigma(self) -> float:
        """Width of the Gaussian with the same full width at half maximum, pixel."""
        ...

    @property
    def peak(self) -> float:
        """Largest value, per square pixel."""
        ...

    @property
    def core(self) -> tuple[float, float]:
        """Arguments of `Detector.quadrature`: the core's width, pixel, and the wings' exponent.

        The exponent beta is that of wings that fall as r^(-2 beta); infinity for a Gaussian's.
        """
        ...

    @property
    def profile(self) -> Any:
        """The PSF of unit width as the compiled loops need it: an instance of the compiled half."""
        ...

    def support_radius(self, tolerance: float) -> float:
        """Distance from the middle beyond which p is below `tolerance` times its peak, pixel."""
        ...

    def density(self, a: npt.ArrayLike, b: npt.ArrayLike) -> Floats:
        """p at (a, b), pixel from the middle; per square pixel."""
        ...


def has_pixel(psf: PSF) -> bool:
    """Whether the pixel's response is part of the PSF."""
    return bool(getattr(psf, "has_pixel", False))


def profile_of(psf: PSF, x: Floats, y: Floats, binning: int) -> Any:
    """The compiled half of a PSF for sources at these positions, shape (s,), pixel."""
    varying = getattr(psf, "profile_of", None)
    if varying is not None:
        return varying(x, y)
    binned = getattr(psf, "binned_profile", None)
    return psf.profile if binned is None else binned(binning)


def density_at(
    psf: PSF, a: npt.ArrayLike, b: npt.ArrayLike, position: tuple[float, float]
) -> Floats:
    """p at (a, b) of a source at a position x, y on the field, pixel; per square pixel."""
    at: dict[str, Any] = {"at": position} if hasattr(psf, "profile_of") else {}
    return psf.density(a, b, **at)
