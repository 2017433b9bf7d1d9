"""Measured PSFs on disk, as FITS, and as the models of photutils.

The primary image of a file is the PSF in the middle of the field, sampled at its knots, for any
program to look at; COEFFICIENTS and DRAWS hold what it is made of. A file is whole or not there, as
`atomic.replace` writes it, and its checksums are verified when it is read.
"""

import io
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.nddata import NDData
from astropy.utils.exceptions import AstropyWarning

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.marks import fits_mark
from bayesfred.io.paths import may_write
from bayesfred.io.reading import require_file

__all__ = ["photutils_model", "read_psf", "write_psf"]

_KEYS = {
    "oversampling": ("BFOVERS", "samples per pixel"),
    "field_radius": ("BFRADIUS", "[pixel] unit of x and y in the field's terms"),
    "determined": ("BFDETERM", "numbers that the counts determined"),
    "model_error": ("BFERROR", "share of the light left unexplained"),
    "nodes": ("BFNODES", "along each axis of the field's grid"),
}
_COEFFICIENTS, _DRAWS = "COEFFICIENTS", "DRAWS"


def write_psf(
    path: PathLike,
    image: Floats,
    arrays: Mapping[str, Floats | None],
    numbers: Mapping[str, float],
    *,
    overwrite: bool = False,
    run: str | None = None,
) -> None:
    """Write a measured PSF.

    Parameters
    ----------
    path : path-like
    image : ndarray, shape (n, n), per square pixel
        The PSF in the middle of the field.
    arrays : mapping
        `coefficients`, and `draws` or None.
    numbers : mapping
        `oversampling`, `field_radius`, `determined`, `model_error`, `nodes`.
    overwrite : bool
        Replace a file that exists.
    run : str, optional
        The run that makes the file, see `marks`.

    Raises
    ------
    InputError
        If the file exists or cannot be written.
    """
    path = Path(path)
    may_write(path, overwrite=overwrite)
    primary = fits.PrimaryHDU(image)
    primary.header["BUNIT"] = "pixel-2"
    for name, (key, comment) in _KEYS.items():
        primary.header[key] = numbers[name], comment
    extensions = [
        fits.ImageHDU(arrays[name.lower()], name=name)
        for name in (_COEFFICIENTS, _DRAWS)
        if arrays[name.lower()] is not None
    ]
    file = fits.HDUList([primary, *extensions])
    if run is not None:
        buffer = io.BytesIO()
        file.writeto(buffer)
        primary.header.update(fits_mark(buffer.getvalue(), run))
    buffer = io.BytesIO()
    file.writeto(buffer, checksum=True)
    replace(path, buffer.getvalue())


def read_psf(path: PathLike) -> dict[str, Any]:
    """Read what `write_psf` wrote.

    Parameters
    ----------
    path : path-like

    Returns
    -------
    dict
        The arrays and the numbers by name.

    Raises
    ------
    InputError
        If it is no such file, or is damaged.
    """
    path = Path(path)
    require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyWarning)
            # of a file that is damaged astropy would leave the handle open
            with fits.open(io.BytesIO(path.read_bytes()), checksum=True) as file:
                header = file[0].header
                header.setdefault(_KEYS["nodes"][0], 0)  # of files from before there were any
                found: dict[str, Any] = {name: float(header[key]) for name, (key, _) in
                                         _KEYS.items()}  # fmt: skip
                found["nodes"] = int(found["nodes"])
                found["coefficients"] = np.asarray(file[_COEFFICIENTS].data, dtype=np.float64)
                found["draws"] = None
                if _DRAWS in file:
                    found["draws"] = np.asarray(file[_DRAWS].data, dtype=np.float64)
    except (OSError, KeyError, TypeError, ValueError, AstropyWarning) as error:
        said = str(error).strip().splitlines() or [type(error).__name__]
        raise InputError(
            f"{path}: not a measured PSF, or damaged ({said[0]}), expected a file that "
            "MeasuredPSF.write or bayesfred fit wrote"
        ) from None
    return found


def photutils_model(images: Floats, positions: Floats, oversampling: int) -> Any:
    """The PSFs at some positions as a model of photutils.

    Parameters
    ----------
    images : ndarray, shape (k, n, n), per pixel
    positions : ndarray, shape (k, 2), pixel
        Where each is the PSF, x and y from the first pixel of a frame, on a rectangular grid.
    oversampling : int

    Returns
    -------
    photutils.psf.ImagePSF or photutils.psf.GriddedPSFModel

    Raises
    ------
    InputError
        If photutils is not installed.
    """
    try:
        from photutils.psf import (  # noqa: PLC0415 - an optional dependency
            GriddedPSFModel,
            ImagePSF,
        )
    except ImportError:
        raise InputError(
            "photutils is not installed, expected it: pip install 'bayesfred[photutils]'"
        ) from None
    if len(images) == 1:
        return ImagePSF(images[0], oversampling=oversampling)
    meta = {"grid_xypos": [tuple(xy) for xy in positions], "oversampling": oversampling}
    return GriddedPSFModel(NDData(images, meta=meta))
