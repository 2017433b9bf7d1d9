"""The sky as a plane: the gnomonic projection of the object plane of a frame.

An ideal camera maps the direction s on the sky to the point (xi, eta) where the line through s
meets the plane that touches the sphere at r, with e and n the unit vectors to the east and the
north of r:

    s = (r + xi e + eta n) / rho,    rho = sqrt(1 + xi^2 + eta^2).

The object plane of a frame, in pixels, is this plane shifted, turned, scaled and, if need be,
mirrored: (xi, eta) = M (x - x0, y - y0). Since E.s = N.s = 0 for the unit vectors E to the east and
N to the north of s, a step on the plane is a step on the sky of

    [E.ds]   1   [E.e  E.n]
    [    ] = --- [        ] d(xi, eta).
    [N.ds]   rho [N.e  N.n]

`sky` makes a plane from the headers of frames; `optimize/pose` finds one from stars.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable

__all__ = ["ARCSEC", "Parity", "TangentPlane", "rows"]

Parity = Literal["sky", "mirrored"]

ARCSEC = 3600.0  # in a degree


@serializable("tangent_plane")
@dataclass(frozen=True)
class TangentPlane:
    """A gnomonic projection between the sky and the object plane of a frame.

    Attributes
    ----------
    ra, dec : float, degree
        The direction, ICRS, in which the plane touches the sky.
    matrix : tuple of 2 tuples of 2 float, degree per pixel
        xi to the east and eta to the north: (xi, eta) = matrix (x - x0, y - y0).
    origin : tuple of 2 float, pixel of the fine grid
        x0 and y0, where the plane touches the sky.

    Raises
    ------
    InputError
        If a number is not finite, `dec` is beyond a pole, or the matrix is singular.

    Examples
    --------
    >>> plane = TangentPlane(180.0, 60.0, ((-0.01, 0.0), (0.0, 0.01)))
    >>> plane.pixel_scale, plane.position_angle, plane.parity
    (36.0, 0.0, 'sky')
    >>> ra, dec = plane.to_sky([0.0, 100.0], [100.0, 0.0])
    >>> print(ra.round(4), dec.round(4))
    [180.     178.0008] [60.9999 59.9849]
    """

    ra: float
    dec: float
    matrix: tuple[tuple[float, float], tuple[float, float]]
    origin: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        matrix = self.matrix
        numbers = np.array([self.ra, self.dec, *self.origin, *np.ravel(self.matrix)])
        if numbers.size != 8 or not np.isfinite(numbers).all() or abs(self.dec) > 90.0:
            raise InputError(
                f"pointing: got RA {self.ra}, Dec {self.dec}, matrix {matrix}, expected finite "
                "numbers and a declination from -90 to 90 degrees"
            )
        if not abs(self._determinant) > 0.0:
            raise InputError(f"matrix: got the singular {matrix}, expected one with an inverse")

    @property
    def pixel_scale(self) -> float:
        """Arcseconds per pixel: root of the area that a pixel covers in the middle."""
        return ARCSEC * math.sqrt(abs(self._determinant))

    @property
    def position_angle(self) -> float:
        """Angle from the north through the east to the direction in which y grows, degree."""
        return math.degrees(math.atan2(self.matrix[0][1], self.matrix[1][1]))

    @property
    def parity(self) -> Parity:
        """Whether east is on the left where north is up, as seen on the sky, or it is mirrored.

        Up is where y grows.
        """
        return "sky" if self._determinant < 0.0 else "mirrored"

    @property
    def _determinant(self) -> float:
        (a, b), (c, d) = self.matrix
        return a * d - b * c

    def to_sky(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Where object points are on the sky.

        Parameters
        ----------
        x, y : array_like, pixel of the fine grid
            From the middle of the frame, broadcast against each other.

        Returns
        -------
        ra, dec : ndarray, the broadcast shape, degree
            ICRS, `ra` from 0 to 360.
        """
        s = self._direction(x, y)[0]
        ra = np.degrees(np.arctan2(s[1], s[0])) % 360.0
        return ra, np.degrees(np.arctan2(s[2], np.hypot(s[0], s[1])))

    def to_plane(self, ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Floats, Floats]:
        """Where directions of the sky are on the object plane: the inverse of `to_sky`.

        Parameters
        ----------
        ra, dec : array_like, degree
            ICRS, broadcast against each other.

        Returns
        -------
        x, y : ndarray, the broadcast shape, pixel of the fine grid
            NaN for directions 90 degrees or more from where the plane touches the sky.
        """
        ra, dec = (np.radians(np.asarray(angle, dtype=np.float64)) for angle in (ra, dec))
        s = np.stack(
            np.broadcast_arrays(np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec))
        )
        along, east, north = (np.tensordot(axis, s, 1) for axis in _axes(self.ra, self.dec))
        with np.errstate(divide="ignore", invalid="ignore"):
            xi, eta = (
                np.where(along > 0.0, np.degrees(part / along), np.nan) for part in (east, north)
            )
        (a, b), (c, d) = np.linalg.inv(np.array(self.matrix))
        return a * xi + b * eta + self.origin[0], c * xi + d * eta + self.origin[1]

    def jacobian(self, x: npt.ArrayLike, y: npt.ArrayLike) -> Floats:
        """Steps on the sky to the east and north for steps along x and y.

        Parameters
        ----------
        x, y : array_like, pixel of the fine grid
            Broadcast against each other.

        Returns
        -------
        ndarray, shape (..., 2, 2), arcsecond per pixel
        """
        s, rho = self._direction(x, y)
        sin_dec, cos_dec = s[2], np.hypot(s[0], s[1])
        with np.errstate(invalid="ignore", divide="ignore"):
            cos_ra, sin_ra = (
                np.where(cos_dec > 0.0, p / cos_dec, q)
                for p, q in zip(s[:2], (1.0, 0.0), strict=True)
            )
        _, e, n = _axes(self.ra, self.dec)
        scaled = ARCSEC * np.array(self.matrix)
        out = np.empty((*rho.shape, 2, 2))
        for column in (0, 1):
            step = scaled[0, column] * e + scaled[1, column] * n  # along x, and along y
            along = cos_ra * step[0] + sin_ra * step[1]
            out[..., 0, column] = (cos_ra * step[1] - sin_ra * step[0]) / rho
            out[..., 1, column] = (cos_dec * step[2] - sin_dec * along) / rho
        return out

    def _direction(self, x: npt.ArrayLike, y: npt.ArrayLike) -> tuple[Floats, Floats]:
        """The unit vectors of object points, shape (3, ...), and rho, shape (...)."""
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        x, y = x - self.origin[0], y - self.origin[1]
        xi, eta = (np.radians(a * x + b * y) for a, b in self.matrix)
        rho = np.sqrt(1.0 + xi**2 + eta**2)
        r, e, n = (axis.reshape(3, *(1,) * x.ndim) for axis in _axes(self.ra, self.dec))
        return (r + xi * e + eta * n) / rho, rho


def rows(matrix: Floats) -> tuple[tuple[float, float], tuple[float, float]]:
    """A 2 x 2 array as a plane holds it."""
    (a, b), (c, d) = matrix.tolist()
    return (a, b), (c, d)


def _axes(ra: float, dec: float) -> tuple[Floats, Floats, Floats]:
    """Unit vectors to a direction, and to the east and north of it."""
    a, d = math.radians(ra), math.radians(dec)
    return (
        np.array([math.cos(d) * math.cos(a), math.cos(d) * math.sin(a), math.sin(d)]),
        np.array([-math.sin(a), math.cos(a), 0.0]),
        np.array([-math.sin(d) * math.cos(a), -math.sin(d) * math.sin(a), math.cos(d)]),
    )
