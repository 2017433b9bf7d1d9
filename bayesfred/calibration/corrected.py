"""A corrected frame and its file.

The FITS file has the counts as its first image and an extension for each plane: VAR, CALVAR, DQ and
COVERAGE, all with the coordinate system. Of the header of the frame only the cards about the
exposure are kept. Those about its pixels, such as gains and sections, are no longer true.
`correct` makes corrected frames.
"""

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io import atomic
from bayesfred.io.fits_images import open_fits
from bayesfred.io.frames import require_memory
from bayesfred.io.paths import may_write
from bayesfred.io.reading import readable, require_file

__all__ = ["CorrectedFrame", "read_cards", "read_grid"]

# what a header says of the exposure as a whole
KEPT = (
    "AIRMASS", "CAMERA", "DATE-AVG", "DATE-BEG", "DATE-END", "DATE-OBS", "DETECTOR", "EXPOSURE",
    "EXPTIME", "FILTER", "FILTER1", "FILTER2", "INSTRUME", "MJD-AVG", "MJD-BEG", "MJD-END",
    "MJD-OBS", "OBJECT", "OBSERVAT", "OBSERVER", "OBSGEO-X", "OBSGEO-Y", "OBSGEO-Z", "ORIGIN",
    "PROGRAM", "PROPOSID", "REFERENC", "SITELAT", "SITELONG", "TELESCOP", "TIME-OBS", "TIMESYS",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class CorrectedFrame:
    """A frame in undistorted coordinates.

    The errors of neighbouring pixels are correlated, because an input pixel is divided among
    several: by 0.25 on average and by at most 0.5 along rows and columns, where the pixels have the
    same size. The variance of one pixel is 4/9 of the input's on average. So the variance of a sum
    over many pixels is 9/4 of the sum of their variances, without the calibration's part. The
    errors of the calibration are correlated over the whole frame: they do not average out.

    Attributes
    ----------
    counts : ndarray, shape (rows, columns), counts
        Of the light on each output pixel; 0 where there are no good pixels. A pixel that is covered
        in part has counts of that part.
    variance : ndarray, shape (rows, columns), counts^2
        Of the counts' noise and of the calibration. NaN where that of the calibration is not known.
    calibration_variance : ndarray, shape (rows, columns), counts^2
        The calibration's part, to first order.
    valid : ndarray of bool, shape (rows, columns)
        True where good pixels cover the whole output pixel.
    coverage : ndarray, shape (rows, columns)
        Share of the output pixel's area that good pixels cover.
    wcs : astropy.wcs.WCS
        The coordinates of the output pixels: the sky if it is known, else the object plane in
        pixels of the fine grid.
    message : str
        One line: what is on the grid, what is extrapolated, and what the calibration's errors do.
    """

    counts: Floats
    variance: Floats
    calibration_variance: Floats
    valid: Flags
    coverage: Floats
    wcs: WCS
    message: str

    def write(
        self, path: PathLike, *, header: Mapping[str, Any] | None = None, overwrite: bool = False
    ) -> None:
        """Write the frame as FITS with float32 images.

        The first image, SCI, has the counts; VAR, CALVAR and COVERAGE the planes of their names;
        DQ is 1 where a pixel is not valid and 0 elsewhere.

        Parameters
        ----------
        path : path-like
        header : mapping, optional
            Header of the frame, such as `read_cards` reads. Of its cards those are written that are
            about the exposure, such as OBJECT and DATE-OBS.
        overwrite : bool
            Replace a file that exists.

        Raises
        ------
        InputError
            If the file exists or cannot be written, or a card cannot.
        """
        path = Path(path)
        may_write(path, overwrite=overwrite)
        where = self.wcs.to_header(relax=True)
        first = fits.Header()
        for key in KEPT:
            if header is not None and key in header:
                try:
                    first[key] = header[key]
                except ValueError as error:
                    raise InputError(
                        f"header: {key}: got {header[key]!r}, expected what FITS can hold ({error})"
                    ) from None
        first.update(where)
        first["BUNIT"] = "electron"
        first.add_history("Resampled by bayesfred with the pixels' overlaps:")
        first.add_history(self.message)
        planes = {
            "VAR": (self.variance.astype(np.float32), "electron2"),
            "CALVAR": (self.calibration_variance.astype(np.float32), "electron2"),
            "DQ": ((~self.valid).astype(np.uint8), ""),
            "COVERAGE": (self.coverage.astype(np.float32), ""),
        }
        first["EXTNAME"] = "SCI"
        images = fits.HDUList([fits.PrimaryHDU(self.counts.astype(np.float32), first)])
        for name, (plane, unit) in planes.items():
            image = fits.ImageHDU(plane, where, name=name)
            image.header["BUNIT"] = unit
            images.append(image)
        content = io.BytesIO()
        images.writeto(content, checksum=True)
        atomic.replace(path, content.getbuffer())


def read_cards(path: PathLike) -> fits.Header:
    """The header cards of a FITS file's first image, with those of the file.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    astropy.io.fits.Header
        Empty for a file of another format.

    Raises
    ------
    InputError
        If a FITS file cannot be read.
    """
    path = Path(path)
    if not {".fits", ".fit", ".fts"} & {suffix.lower() for suffix in path.suffixes}:
        return fits.Header()
    return _first_image(path)[0]


def read_grid(path: PathLike) -> tuple[WCS, tuple[int, int]]:
    """The pixel grid of a FITS file's first image.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    wcs : astropy.wcs.WCS
    shape : tuple of int, (rows, columns)

    Raises
    ------
    InputError
        If the file cannot be read, or its coordinate system is none.
    """
    header, shape = _first_image(Path(path))
    with readable(Path(path), "FITS"):
        return WCS(header, naxis=2), shape


def _first_image(path: Path) -> tuple[fits.Header, tuple[int, int]]:
    """The header of the first image with two axes, and its shape."""
    require_file(path)
    with open_fits(path) as hdus:
        header = hdus[0].header.copy()
        for hdu in hdus:
            if hdu.is_image and len(hdu.shape) == 2:
                require_memory(f"{path}", hdu.shape)
                header.update(hdu.header)
                return header, (int(hdu.shape[0]), int(hdu.shape[1]))
    raise InputError(f"{path}: got no image with two axes, expected one")
