"""A calibration as the header of a FITS file: TAN-SIP or TPV, with its errors.

Both conventions describe a plane that touches the sky at CRVAL, which the pixel CRPIX images, the
middle of the first pixel being 1. SIP distorts the pixels that CD takes to the plane, and brings
polynomials for the way back, AP and BP; TPV distorts what CD makes of the pixels,

    xi  = sum of PV1_k x^i y^j,    eta = sum of PV2_k y^i x^j,    (x, y) = CD (h, k) in degrees,

where k counts 1, x, y, r, x^2, xy, y^2, x^3, ... and the powers of r are not used here. Polynomials
of the same degree are the same in both conventions.

The errors that a header states are those of the header: astropy reads its text and evaluates it.
The table DRAWS has a row for every draw of the calibration, and a column for every keyword that
differs from draw to draw: a header with the values of a row in place of its own is that draw's.

References
----------
D. L. Shupe et al. (2005), ASP Conf. Ser. 347, 491: the SIP convention.
M. R. Calabretta, E. W. Greisen (2002), A&A 395, 1077: TAN. The registry of FITS conventions: TPV.
"""

from __future__ import annotations

import io
import textwrap
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy import units
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from bayesfred._typing import Floats, PathLike
from bayesfred.calibration.plate import (
    Plate,
    Truncation,
    checked_degree,
    fit_plate,
    known_sky,
    nodes,
    objects,
    substituted,
    truncation,
)
from bayesfred.errors import printable
from bayesfred.io.atomic import replace
from bayesfred.io.paths import may_write

if TYPE_CHECKING:
    from bayesfred.calibration.calibration import Calibration

__all__ = ["HeaderExport", "sip", "tpv"]

DRAWS = "DRAWS"
CARD = 72  # characters of a comment
FIRST_PV = (0, 1, 4, 7, 12, 17, 24, 31)  # k of x^n, by the degree n
_ERRORS = {
    "BFFWDRMS": "[pixel] rms error of the header, pixel to sky",
    "BFFWDMAX": "[pixel] largest error, pixel to sky",
    "BFINVRMS": "[pixel] rms error of the header, sky to pixel",
    "BFINVMAX": "[pixel] largest error, sky to pixel",
}


@dataclass(frozen=True, eq=False)
class HeaderExport:
    """A calibration as a FITS header.

    Attributes
    ----------
    header : astropy.io.fits.Header
        Of the posterior mean. IMAGEW and IMAGEH are the columns and rows of the frame.
    draws : astropy.table.Table
        A row for every draw, a column for every keyword whose value differs between them.
    forward : Truncation
        The error of the header where pixels point, in recorded pixels of the object plane.
    inverse : Truncation
        Its error where directions are imaged. TPV has no polynomials for this way: its own are
        inverted by iteration.
    """

    header: fits.Header
    draws: Table
    forward: Truncation
    inverse: Truncation

    @property
    def wcs(self) -> WCS:
        """The header as astropy's WCS of the frame."""
        wcs = WCS(self.header)
        wcs.pixel_shape = self.header["IMAGEW"], self.header["IMAGEH"]
        return wcs

    def write(self, path: PathLike, *, overwrite: bool = False) -> None:
        """Write a FITS file: the header without an image, and the table DRAWS.

        Parameters
        ----------
        path : path-like
        overwrite : bool
            Replace a file that exists.

        Raises
        ------
        InputError
            If the file exists or cannot be written.
        """
        path = Path(path)
        may_write(path, overwrite=overwrite)
        table = fits.table_to_hdu(self.draws)
        table.name = DRAWS
        buffer = io.BytesIO()
        fits.HDUList([fits.PrimaryHDU(header=self.header), table]).writeto(buffer, checksum=True)
        replace(path, buffer.getvalue())


def sip(calibration: Calibration, degree: int = 3) -> HeaderExport:
    """A calibration as a header of the convention TAN-SIP.

    Parameters
    ----------
    calibration : Calibration
    degree : int
        Of A and B, from 2 to 9. AP and BP have the lowest degree from there to 9 that makes their
        error no larger than that of A and B.

    Returns
    -------
    HeaderExport

    Raises
    ------
    InputError
        If it is not known where the object plane is on the sky, the distortion maps no object to
        a part of the frame, or there are no keywords for such a degree.

    Examples
    --------
    >>> import bayesfred as bf
    >>> from bayesfred.io.tangent_plane import TangentPlane
    >>> calibration = bf.Calibration(
    ...     bf.PolynomialDistortion([(3, 0, 0, 0), (1, 2, 0, 0)], [(0, 3, 0, 0), (2, 1, 0, 0)]),
    ...     [[1e-7, 1e-7, 1e-7, 1e-7, 0.5, 0.0], [1.1e-7, 1e-7, 1e-7, 1e-7, 0.6, 0.0]],
    ...     bf.Detector((300, 400)), bf.GaussianPSF(1.0), 1.0, [[0.0, 0.0]],
    ...     sky=TangentPlane(180.0, 60.0, ((-0.01, 0.0), (0.0, 0.01))))
    >>> export = sip(calibration, degree=3)
    >>> round(export.header["CRPIX1"], 2), export.draws["CRPIX1"].round(2).tolist()
    (201.05, [201.0, 201.1])
    >>> for degree in (3, 5, 7):
    ...     print(degree, f"{sip(calibration, degree).forward.largest:.0e} pixel")
    3 3e-03 pixel
    5 2e-05 pixel
    7 1e-07 pixel
    """
    degree = checked_degree(degree, 2, 9)
    plate = fit_plate(calibration, degree)
    order = plate.inverse.shape[-1] - 1
    values = _linear(plate)
    for letters, c in ((("A", "B"), plate.forward), (("AP", "BP"), plate.inverse)):
        for axis, letter in enumerate(letters):
            for i, j in _exponents(c.shape[-1] - 1, 2 if letter in "AB" else 0):
                values[f"{letter}_{i}_{j}"] = c[:, axis, i, j], units.pix ** (1 - i - j)
    orders = {"A_ORDER": degree, "B_ORDER": degree, "AP_ORDER": order, "BP_ORDER": order}
    return _export(calibration, plate, ("RA---TAN-SIP", "DEC--TAN-SIP"), values, orders)


def tpv(calibration: Calibration, degree: int = 3) -> HeaderExport:
    """A calibration as a header of the convention TPV.

    Parameters
    ----------
    calibration : Calibration
    degree : int
        Of the polynomials, from 1 to 7.

    Returns
    -------
    HeaderExport

    Raises
    ------
    InputError
        As `sip` does.

    Examples
    --------
    >>> import bayesfred as bf
    >>> from bayesfred.io.tangent_plane import TangentPlane
    >>> calibration = bf.Calibration(
    ...     bf.PolynomialDistortion([(2, 0, 0, 0)], []), [[1e-5, 0.5, 0.0], [1e-5, 0.6, 0.0]],
    ...     bf.Detector((300, 400)), bf.GaussianPSF(1.0), 1.0, [[0.0, 0.0]],
    ...     sky=TangentPlane(180.0, 60.0, ((-0.01, 0.0), (0.0, 0.01))))
    >>> header = tpv(calibration, degree=4).header
    >>> round(header["PV1_1"], 9), round(header["PV2_1"], 9), round(header["PV1_4"], 4)
    (1.0, 1.0, -0.001)
    """
    degree = checked_degree(degree, 1, 7)
    plate = fit_plate(calibration, degree)
    c = plate.forward.copy()
    c[:, (0, 1), (1, 0), (0, 1)] += 1.0
    c = substituted(np.einsum("nab,nbij->naij", plate.cd, c), np.asarray(np.linalg.inv(plate.cd)))
    values = _linear(plate)
    for axis in (0, 1):
        for i, j in _exponents(degree, 1):
            k = FIRST_PV[i + j] + (j, i)[axis]
            values[f"PV{axis + 1}_{k}"] = c[:, axis, i, j], units.deg ** (1 - i - j)
    return _export(calibration, plate, ("RA---TPV", "DEC--TPV"), values, {})


def _linear(plate: Plate) -> dict[str, tuple[Floats, units.UnitBase]]:
    """The reference pixel, counted from 1, and CD: values and unit by keyword."""
    values = {f"CRPIX{k + 1}": (plate.reference[:, k] + 1.0, units.pix) for k in (0, 1)}
    for k in (0, 1):
        for m in (0, 1):
            values[f"CD{k + 1}_{m + 1}"] = plate.cd[:, k, m], units.deg / units.pix
    return values


def _exponents(degree: int, lowest: int) -> list[tuple[int, int]]:
    return [(n - j, j) for n in range(lowest, degree + 1) for j in range(n + 1)]


def _export(
    calibration: Calibration,
    plate: Plate,
    types: tuple[str, str],
    values: dict[str, tuple[Floats, units.UnitBase]],
    orders: dict[str, int],
) -> HeaderExport:
    """The header, with its errors, and the table of draws."""
    header = fits.Header()
    rows, columns = calibration.detector.shape
    header["WCSAXES"] = 2
    header["IMAGEW"] = columns, "columns of the frame"
    header["IMAGEH"] = rows, "rows of the frame"
    for k, name in enumerate(types, 1):
        header[f"CTYPE{k}"], header[f"CUNIT{k}"] = name, "deg"
    header["CRVAL1"], header["CRVAL2"] = plate.sky.ra, plate.sky.dec
    header["LONPOLE"], header["RADESYS"] = 180.0, "ICRS"
    header.update(orders)
    header.update({name: float(each[0]) for name, (each, _) in values.items()})
    forward, inverse = _truncation(calibration, header)
    errors = forward.rms, forward.largest, inverse.rms, inverse.largest
    for (key, comment), error in zip(_ERRORS.items(), errors, strict=True):
        header[key] = float(f"{error:.3g}"), comment
    for text in (
        "Posterior mean of a calibration by bayesfred. The errors BF... are those of this header "
        "against the calibration, over the whole frame. The calibration's own are in the table "
        f"{DRAWS}: the values of these keywords for every draw.",
        calibration.title,
        calibration.message,
    ):
        plain = printable(text).encode("ascii", "backslashreplace").decode()
        for line in textwrap.wrap(plain, CARD):
            header["COMMENT"] = line
    table = Table({name: each[1:] * unit for name, (each, unit) in values.items()})
    return HeaderExport(header, table, forward, inverse)


def _truncation(calibration: Calibration, header: fits.Header) -> tuple[Truncation, Truncation]:
    """The errors of a header's text, as astropy evaluates it."""
    wcs = WCS(fits.Header.fromstring(header.tostring()))
    sky, binning = known_sky(calibration), calibration.detector.binning
    pixels = nodes(calibration.detector.shape, even=True)
    (true,) = objects(calibration, pixels, draws=False)
    found = np.array(sky.to_plane(*wcs.all_pix2world(*pixels, 0)))
    forward = truncation(found / binning, true / binning)
    focal = np.array(wcs.wcs_world2pix(*sky.to_sky(*true), 1))
    if wcs.sip is not None:
        focal = np.array(wcs.sip_foc2pix(*(focal - wcs.wcs.crpix[:, None]), 1))
    return forward, truncation(focal - 1.0, pixels)
