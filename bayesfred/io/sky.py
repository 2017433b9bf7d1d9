"""What astropy knows of the sky: coordinate systems of headers, angles in tables, proper motions.

Everything that comes in becomes degrees (ICRS) and a `TangentPlane`. A header's coordinate system
may have distortion terms and any projection. It is used as a first guess, so its value and slope
in the middle of the frame are enough: the distortion is what the fit is for.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from astropy import units
from astropy.coordinates import Angle, SkyCoord
from astropy.time import Time
from astropy.utils.exceptions import AstropyWarning
from astropy.wcs import WCS, FITSFixedWarning

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import TangentPlane, rows

__all__ = ["degrees", "header_date", "header_plane", "icrs", "moved", "plane_of_wcs"]

STEP = 0.5  # pixel, of the slope: small beside any distortion, large beside rounding
DATES = ("DATE-OBS", "DATE_OBS", "DATE-BEG", "DATE-AVG")
DAYS = ("MJD-OBS", "MJD-BEG", "MJD-AVG")


def plane_of_wcs(wcs: Any, shape: tuple[int, int], *, binning: int = 1) -> TangentPlane:
    """The tangent plane of a coordinate system in the middle of a frame.

    Parameters
    ----------
    wcs : astropy.wcs.WCS or other
        What has astropy's common interface for coordinate systems, with celestial axes.
    shape : (int, int), recorded pixel
        Rows and columns of the frame.
    binning : int
        Fine pixels a recorded one, along either axis.

    Returns
    -------
    TangentPlane

    Raises
    ------
    InputError
        If the coordinate system has no celestial axes, or none in the middle of the frame.

    Examples
    --------
    >>> wcs = WCS(naxis=2)
    >>> wcs.wcs.ctype, wcs.wcs.crpix = ("RA---TAN", "DEC--TAN"), (50.5, 50.5)
    >>> wcs.wcs.crval, wcs.wcs.cdelt = (180.0, 60.0), (-0.01, 0.01)
    >>> round(plane_of_wcs(wcs, (100, 100)).pixel_scale, 6)
    36.0
    """
    v, u = (0.5 * (n - 1) for n in shape)
    steps = np.array([(0.0, 0.0), (STEP, 0.0), (-STEP, 0.0), (0.0, STEP), (0.0, -STEP)])
    try:
        at = wcs.pixel_to_world(u + steps[:, 0], v + steps[:, 1])
        ra, dec = icrs(at)
    except Exception as error:  # coordinate systems raise errors of many types
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"wcs: got a coordinate system without a place on the sky ({reason}), expected "
            "celestial axes"
        ) from None
    if not np.isfinite([ra, dec]).all():
        raise InputError("wcs: got no place on the sky in the middle of the frame, expected one")
    unit = TangentPlane(ra[0], dec[0], ((1.0, 0.0), (0.0, 1.0)))
    xi, eta = unit.to_plane(ra, dec)
    slope = np.array([[p[1] - p[2], p[3] - p[4]] for p in (xi, eta)]) / (2.0 * STEP * binning)
    return TangentPlane(float(ra[0]), float(dec[0]), rows(slope))


def header_plane(header: Any, shape: tuple[int, int]) -> TangentPlane | None:
    """The tangent plane that a FITS header states; None where it states none that can be used.

    Parameters
    ----------
    header : astropy.io.fits.Header
    shape : (int, int), recorded pixel

    Returns
    -------
    TangentPlane or None
        In recorded pixels.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        warnings.simplefilter("ignore", FITSFixedWarning)
        try:
            wcs = WCS(header).celestial
            return plane_of_wcs(wcs, shape) if wcs.naxis == 2 else None
        except Exception:  # what cannot be read is as good as absent: [sky] says what to do
            return None


def header_date(header: Mapping[str, Any]) -> str | None:
    """When a FITS header says that the frame was taken; None where it does not."""
    found = next((str(header[key]) for key in DATES if str(header.get(key, "")).strip()), None)
    if found is None:
        days = next((header[key] for key in DAYS if isinstance(header.get(key), int | float)), None)
        found = None if days is None else str(Time(days, format="mjd").isot)
    return found


def icrs(coordinates: Any) -> tuple[Floats, Floats]:
    """Right ascension and declination of astropy's coordinates.

    Parameters
    ----------
    coordinates : astropy.coordinates.SkyCoord

    Returns
    -------
    ra, dec : ndarray, degree
        ICRS.

    Raises
    ------
    InputError
        If they are no coordinates on the sky.
    """
    try:
        at = SkyCoord(coordinates).icrs
    except Exception as error:  # frames raise errors of many types
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"coordinates: got what is no place on the sky ({reason}), expected a SkyCoord"
        ) from None
    return np.asarray(at.ra.deg), np.asarray(at.dec.deg)


def degrees(values: Any, unit: Any, *, hours: bool) -> Floats:
    """Angles of a table in degrees.

    Parameters
    ----------
    values : sequence
        Numbers, or texts such as '12:34:56.7', '12h34m56.7s' and '-12d34m'.
    unit : astropy unit or None
        Of the column. Numbers without one are degrees.
    hours : bool
        Whether texts without a unit are hours: those of right ascensions.

    Returns
    -------
    ndarray, degree

    Raises
    ------
    ValueError
        If a text is no angle.

    Examples
    --------
    >>> degrees(["12:00:00", "1d30m"], None, hours=True).round(6).tolist()
    [180.0, 1.5]
    """
    texts = np.asarray(values).dtype.kind in "OSU"
    if texts:
        unit = units.hourangle if hours else units.deg
        return np.array([Angle(str(value), unit=unit).deg for value in values], dtype=np.float64)
    return np.asarray(Angle(np.asarray(values, np.float64), unit=unit or units.deg).deg)


def moved(
    ra: Floats, dec: Floats, motion: tuple[Floats, Floats], epoch: float, date: str
) -> tuple[Floats, Floats]:
    """Positions of stars at another date.

    Parameters
    ----------
    ra, dec : ndarray, shape (n,), degree
    motion : (ndarray, ndarray), shape (n,), milliarcsecond a year
        Proper motion along right ascension, its cosine of the declination included, and along
        declination.
    epoch : float, Julian year
        Of the positions.
    date : str
        ISO 8601, as in DATE-OBS.

    Returns
    -------
    ra, dec : ndarray, shape (n,), degree

    Raises
    ------
    InputError
        If the date is none.

    Examples
    --------
    >>> ra, dec = moved(np.array([269.452]), np.array([4.6934]),
    ...     (np.array([-802.8]), np.array([10362.5])), 2000.0, "2020-01-01")
    >>> print(dec.round(4))
    [4.751]
    """
    try:
        when = Time(date)
    except ValueError:
        raise InputError(f"date: got {date!r}, expected one such as 2019-07-29T20:47:26") from None
    rate = units.mas / units.yr
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # distances are not known: the motion is along a circle
        stars = SkyCoord(
            ra * units.deg, dec * units.deg, pm_ra_cosdec=motion[0] * rate,
            pm_dec=motion[1] * rate, obstime=Time(epoch, format="jyear"),
        )  # fmt: skip
        then = stars.apply_space_motion(new_obstime=when)
    if not (math.isfinite(epoch) and np.isfinite(then.ra.deg).all()):
        raise InputError(f"epoch: got {epoch}, expected a Julian year such as 2000.0")
    return np.asarray(then.ra.deg), np.asarray(then.dec.deg)
