"""The image in a FITS file, with what the file says of its pixels.

Checksums (CHECKSUM, DATASUM) are verified, and an extension that flags pixels (DQ, MASK, BPM) goes
with the image of its shape and its version number.
"""

from __future__ import annotations

import gzip
import io
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError, printable
from bayesfred.io.headers import KEYWORDS
from bayesfred.io.reading import readable
from bayesfred.io.sky import header_date, header_plane
from bayesfred.io.tangent_plane import TangentPlane

__all__ = ["StoredImage", "read_fits"]

FLAGS = ("DQ", "MASK", "BPM")  # extensions that are not zero where a pixel is bad
ERRORS = ("ERR", "UNCERT", "SIGMA", "VAR", "VARIANCE", "IVAR", "WHT", "WEIGHT")
MOST_FLAGGED = 0.9  # share of the pixels


class StoredImage(NamedTuple):
    """The image in a file, with what the file says of its pixels; FITS files alone say much.

    Attributes
    ----------
    stored : ndarray, shape (ny, nx), stored units
    header : mapping
        The `KEYWORDS` of the file and of the image, which counts more.
    flags : mapping of str to ndarray of bool, shape (ny, nx)
        The pixels that each extension flags as bad, by its name.
    unused : tuple of str
        Names of extensions with errors or weights, of which no use is made.
    sky : TangentPlane or None
        Where the header places the frame on the sky, in stored pixels.
    date : str or None
        When it was taken.
    largest : float or None
        The largest number of its type, for pictures.
    """

    stored: Floats
    header: Mapping[str, Any] = MappingProxyType({})
    flags: Mapping[str, Flags] = MappingProxyType({})
    unused: tuple[str, ...] = ()
    sky: TangentPlane | None = None
    date: str | None = None
    largest: float | None = None


class _Stream(io.BufferedReader):
    """A file in which a seek beyond the end, as absurd headers ask for, goes to the end."""

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return super().seek(min(offset, os.fstat(self.fileno()).st_size), whence)


def read_fits(
    path: Path, name: str | None, require_room: Callable[[str, tuple[int, int]], None]
) -> StoredImage:
    """Read the first image with two dimensions, or the one of a name.

    Parameters
    ----------
    path : Path
    name : str, optional
        Of the extension.
    require_room : callable
        Told the image's name and shape before it is read; raises where that is too large.

    Returns
    -------
    StoredImage

    Raises
    ------
    InputError
        The file is damaged, a checksum is wrong, or there is no such image.
    """
    with readable(path, "FITS"), warnings.catch_warnings(record=True) as caught:
        # Warnings are about headers and checksums; data that are cut short raise.
        warnings.simplefilter("always", AstropyWarning)
        zipped = path.suffix.lower() == ".gz"
        # uint=False: as unsigned integers BLANK pixels would come through as ordinary numbers.
        with (
            gzip.open(path) if zipped else _Stream(io.FileIO(path)) as stream,
            fits.open(stream, memmap=False, uint=False, checksum=True) as hdus,
        ):
            images = [(hdu.name or str(k), hdu) for k, hdu in enumerate(hdus) if hdu.is_image]
            _require_checksums(path, caught)
            wanted = None if name is None else name.upper()
            for label, hdu in images:
                two = len(hdu.shape) == 2 and min(hdu.shape) > 0
                if two and wanted in (None, hdu.name):
                    require_room(f"{path}: {printable(label)}", hdu.shape)
                    image = np.asarray(hdu.data, dtype=np.float64)
                    same = [(n, h) for n, h in images if h is not hdu and h.ver == hdu.ver]
                    flags = {n: _flags(path, n, h, image.shape) for n, h in same if n in FLAGS}
                    unused = tuple(n for n, h in same if n in ERRORS and h.shape == hdu.shape)
                    while zipped and stream.read(1 << 20):
                        pass  # up to the checksum, which astropy does not reach
                    both = (hdus[0].header, hdu.header)
                    header = {key: h[key] for h in both for key in KEYWORDS if key in h}
                    date = header_date(hdu.header) or header_date(hdus[0].header)
                    sky = header_plane(hdu.header, hdu.shape)
                    return StoredImage(image, header, flags, unused, sky, date)
            seen = [f"{label} {' x '.join(map(str, h.shape)) or 'without data'}"
                    for label, h in images]  # fmt: skip
    expected = "a 2-D image" if name is None else f"a 2-D image in extension {name!r}"
    raise InputError(f"{path}: got {', '.join(seen) or 'no image'}, expected {expected}")


def _require_checksums(path: Path, caught: list[warnings.WarningMessage]) -> None:
    for warning in caught:
        text = " ".join(str(warning.message).split())
        if "verification failed" in text:
            raise InputError(
                f"{path}: {text.split(' verification')[0].upper()}: got a wrong one "
                f"({printable(text)}), expected the file as it was written: get it again or, if "
                "it was edited on purpose, remove CHECKSUM and DATASUM"
            )


def _flags(path: Path, name: str, hdu: Any, shape: tuple[int, ...]) -> Flags:
    """The pixels that an extension flags."""
    if hdu.shape != shape:
        raise InputError(
            f"{path}: {name}: got an extension of {' x '.join(map(str, hdu.shape))}, expected the "
            f"frame's {' x '.join(map(str, shape))} pixels: remove it or cut it to the frame"
        )
    flagged = np.asarray(hdu.data != 0)
    if flagged.mean() > MOST_FLAGGED:
        raise InputError(
            f"{path}: {name}: got {flagged.mean():.0%} of the pixels flagged, expected zero where "
            "a pixel is good: invert the extension or remove it"
        )
    return flagged
