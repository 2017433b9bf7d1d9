"""What is imaged: a catalogue of point sources with known positions and fluxes.

Positions are object-plane coordinates in pixels of the fine grid, from the middle of the frame: x
along columns, y along rows. `forward` turns a catalogue and a distortion into expected counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.io.sky import icrs, plane_of_wcs
from bayesfred.io.tangent_plane import TangentPlane


@serializable("catalog")
@dataclass(frozen=True, eq=False)
class SourceCatalog:
    """Point sources; the arrays are copied, converted to float64 and made read-only.

    Attributes
    ----------
    x, y : ndarray, shape (n_sources,), pixel
        Positions in the object plane from the middle of the frame. They may lie outside the frame.
    flux : ndarray, shape (n_sources,), photons
        Expected photons of each source over the whole plane, > 0 and at most 2**53: float64 counts
        no further.
    sky : TangentPlane, optional
        Where the object plane is on the sky, where that is known.

    Raises
    ------
    InputError
        If an array is not one-dimensional, is empty or not finite, if their lengths differ, or if a
        flux is not > 0 or more than 2**53.

    Examples
    --------
    >>> len(SourceCatalog(x=[0.0, 30.0], y=[0.0, -20.0], flux=[1e4, 2e4]))
    2
    """

    x: Floats
    y: Floats
    flux: Floats
    sky: TangentPlane | None = field(default=None, metadata={"since": 7})

    def __post_init__(self) -> None:
        for name in ("x", "y", "flux"):
            object.__setattr__(self, name, _column(name, getattr(self, name)))
        if not len(self.x) == len(self.y) == len(self.flux):
            raise InputError(
                f"x, y, flux: got {len(self.x)}, {len(self.y)} and {len(self.flux)} values, "
                "expected one of each for every source"
            )
        good = (self.flux > 0.0) & (self.flux <= 2.0**53)
        if not good.all():
            first = int(np.argmin(good))
            raise InputError(
                f"flux: got {self.flux[first]:g} for source {first}, expected > 0 and at most "
                "9e15: remove it or correct it"
            )

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for column in (self.x, self.y, self.flux):
            column.setflags(write=False)  # which pickling forgets, and compiled code is typed by

    @classmethod
    def grid(cls, side: int, spacing: float, flux: float) -> Self:
        """Lay out a square array of equal sources centred on the axis, row by row.

        The paper's object is `grid(9, 50.0, 1e5)`.

        Parameters
        ----------
        side : int
            Sources along each side.
        spacing : float, pixel
            Distance between neighbours.
        flux : float, photons
            Flux of every source.

        Raises
        ------
        InputError
            If `side` is not an integer >= 1, or `spacing` or `flux` is not a finite number > 0.

        References
        ----------
        Sun & Zhou, Fig. 1.

        Examples
        --------
        >>> SourceCatalog.grid(side=2, spacing=50.0, flux=1e5).x.tolist()
        [-25.0, 25.0, -25.0, 25.0]
        """
        if not isinstance(side, int | np.integer) or side < 1:
            raise InputError(f"side: got {side!r}, expected an integer of at least 1")
        if not (np.isfinite(spacing) and spacing > 0.0):
            raise InputError(f"spacing: got {spacing!r}, expected a finite number of pixels > 0")
        axis = (np.arange(side) - (side - 1) / 2.0) * spacing
        y, x = np.meshgrid(axis, axis, indexing="ij")
        return cls(x.ravel(), y.ravel(), np.full(x.size, flux))

    @classmethod
    def from_sky(cls, coordinates: Any, flux: npt.ArrayLike, wcs: Any, *, binning: int = 1) -> Self:
        """Place stars on the object plane of a frame.

        Parameters
        ----------
        coordinates : astropy.coordinates.SkyCoord, shape (n_sources,)
        flux : array_like, shape (n_sources,), photons
        wcs : astropy.wcs.WCS
            The frame's, with its size (`pixel_shape`). It need not be exact, and its distortion is
            not used: its value and slope in the middle of the frame are the object plane.
        binning : int
            Fine pixels a recorded one, along either axis.

        Returns
        -------
        SourceCatalog
            With positions in fine pixels from the middle of the frame, and `sky`.

        Raises
        ------
        InputError
            If the coordinate system has no size or no celestial axes, or a star is 90 degrees or
            more from the middle of the frame.

        Examples
        --------
        >>> from astropy.coordinates import SkyCoord
        >>> from astropy.wcs import WCS
        >>> wcs = WCS(naxis=2)
        >>> wcs.wcs.ctype, wcs.wcs.crpix = ("RA---TAN", "DEC--TAN"), (50.5, 50.5)
        >>> wcs.wcs.crval, wcs.wcs.cdelt = (180.0, 0.0), (-0.01, 0.01)
        >>> wcs.pixel_shape = (100, 100)
        >>> stars = SourceCatalog.from_sky(SkyCoord([179.8], [0.1], unit="deg"), [1e4], wcs)
        >>> print(stars.x.round(2), stars.y.round(2))
        [20.] [10.]
        """
        if getattr(wcs, "array_shape", None) is None:
            raise InputError(
                "wcs: got a coordinate system without a size, expected the frame's: set "
                "wcs.pixel_shape to (columns, rows)"
            )
        sky = plane_of_wcs(wcs, wcs.array_shape, binning=binning)
        x, y = sky.to_plane(*icrs(coordinates))
        if not np.isfinite(x).all():
            first = int(np.argmin(np.isfinite(x)))
            raise InputError(
                f"coordinates: got star {first} more than 90 degrees from the middle of the "
                "frame, expected stars that it may show: remove the others"
            )
        return cls(x, y, np.asarray(flux), sky)

    def __len__(self) -> int:
        """Count the sources."""
        return len(self.x)


def _column(name: str, values: object) -> Floats:
    """Make a read-only float64 copy of one column, or raise an InputError that names it."""
    try:
        column = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(
            f"{name}: got values that are not numbers, expected one number a source"
        ) from None
    if column.ndim != 1 or column.size == 0:
        raise InputError(
            f"{name}: got shape {column.shape}, expected one dimension and at least one source"
        )
    if not np.isfinite(column).all():
        first = int(np.argmin(np.isfinite(column)))
        raise InputError(
            f"{name}: got {column[first]} for source {first}, expected a finite number"
        )
    column.setflags(write=False)
    return column
