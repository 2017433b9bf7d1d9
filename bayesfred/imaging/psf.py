"""Reference point spread functions: the p of the Fredholm model, normalised to unit volume.

`forward.py` samples them through the compiled loops; widths are in pixels of the fine grid.
"""

import math
from dataclasses import dataclass
from typing import Any

from bayesfred.errors import InputError


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

    def write(self, group: Any) -> None:
        """Store the PSF in an HDF5 group."""
        group.attrs["sigma"] = self.sigma

    @classmethod
    def read(cls, group: Any) -> "GaussianPSF":
        """The PSF stored in an HDF5 group by `write`."""
        return cls(float(group.attrs["sigma"]))
