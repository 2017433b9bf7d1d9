"""The image in a FITS file, with what the file says of its pixels.

Checksums (CHECKSUM, DATASUM) are verified, and an extension that flags pixels (DQ, MASK, BPM) goes
with the image of its shape and its version number.
"""

from __future__ import annotations

import gzip
import io
import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
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

__all__ = ["StoredImage", "open_fits", "read_fits"]

FLAGS = ("DQ", "MASK", "BPM")  # extensions that are not zero where a pixel is bad
ERRORS = ("ERR", "UNCERT", "SIGMA", "VAR", "VARIANCE", "IVAR", "WHT", "WEIGHT")
MOST_FLAGGED = 0.9  # share of the pixels
HEADER_BLOCK = 2880  # bytes
MOST_HEADER_BLOCKS = 2000  # in a row: 72,000 cards


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


class _EndingHeaders:
    """A stream in which a header ends, be it a gigabyte of zeros, which gzip makes of a megabyte.

    Headers are read a block at a time until one has the card END.
    """

    blocks = 0

    def read(self, size: int | None = -1, /) -> bytes:
        self.blocks = self.blocks + 1 if size == HEADER_BLOCK else 0
        if self.blocks > MOST_HEADER_BLOCKS:
            return b""
        return super().read(size)  # type: ignore[misc,no-any-return]


class _Stream(_EndingHeaders, io.BufferedReader):
    """A file in which a seek beyond the end, as absurd headers ask for, goes to the end."""

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return super().seek(min(offset, os.fstat(self.fileno()).st_size), whence)


class _Unzipped(_EndingHeaders, gzip.GzipFile):
    pass


@contextmanager
def open_fits(path: Path, **options: Any) -> Iterator[Any]:
    """The HDUs of a FITS file; whatever is wrong with it becomes one line.

    Parameters
    ----------
    path : Path
    **options
        Of `astropy.io.fits.open`.

    Yields
    ------
    astropy.io.fits.HDUList

    Raises
    ------
    InputError
        The file is damaged.
    """
    zipped = path.suffix.lower() == ".gz"
    with (
        readable(path, "FITS"),
        # of headers; data that are cut short raise
        warnings.catch_warnings(action="ignore", category=AstropyWarning),
        _Unzipped(path) if zipped else _Stream(io.FileIO(path)) as stream,
        fits.open(stream, memmap=False, **options) as hdus,
    ):
        yield hdus
        while zipped and stream.read(1 << 20):
            pass  # up to the checksum, which astropy does not reach


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
        The file is damaged, a checksum of what is read is wrong, or there is no such image.
    """
    # uint=False: as unsigned integers BLANK pixels would come through as ordinary numbers.
    with open_fits(path, uint=False) as hdus:
        images = [(hdu.name or str(k), hdu) for k, hdu in enumerate(hdus) if hdu.is_image]
        wanted = None if name is None else name.upper()
        for label, hdu in images:
            two = len(hdu.shape) == 2 and min(hdu.shape) > 0
            if two and wanted in (None, hdu.name):
                require_room(f"{path}: {printable(label)}", hdu.shape)
                if hdus[0].size == 0:
                    _require_checksum(path, hdus, hdus[0])
                _require_checksum(path, hdus, hdu)
                image = np.asarray(hdu.data, dtype=np.float64)
                same = [(n, h) for n, h in images if h is not hdu and h.ver == hdu.ver]
                flags = {n: _flags(path, hdus, h, image.shape) for n, h in same if n in FLAGS}
                unused = tuple(n for n, h in same if n in ERRORS and h.shape == hdu.shape)
                both = (hdus[0].header, hdu.header)
                header = {key: h[key] for h in both for key in KEYWORDS if key in h}
                date = header_date(hdu.header) or header_date(hdus[0].header)
                sky = header_plane(hdu.header, hdu.shape)
                return StoredImage(image, header, flags, unused, sky, date)
        seen = [f"{label} {' x '.join(map(str, h.shape)) or 'without data'}"
                for label, h in images]  # fmt: skip
    expected = "a 2-D image" if name is None else f"a 2-D image in extension {name!r}"
    raise InputError(f"{path}: got {', '.join(seen) or 'no image'}, expected {expected}")


def _require_checksum(path: Path, hdus: Any, hdu: Any) -> None:
    """Refuse an HDU that differs from its checksums.

    HDUs that are not used are not asked: they may be large.
    """
    if isinstance(hdu, fits.CompImageHDU):  # the sums are those of the table that holds it
        with open_fits(path, disable_image_compression=True) as stored:
            _require_checksum(path, stored, stored[hdus.index(hdu)])
        return
    where = printable(hdu.name) or hdus.index(hdu)
    for word, verify in (("CHECKSUM", hdu.verify_checksum), ("DATASUM", hdu.verify_datasum)):
        if verify() == 0:
            raise InputError(
                f"{path}: {word}: got a wrong one in {where}, expected the file as it was written: "
                "get it again or, if it was edited on purpose, remove CHECKSUM and DATASUM"
            )


def _flags(path: Path, hdus: Any, hdu: Any, shape: tuple[int, ...]) -> Flags:
    """The pixels that an extension flags."""
    name = hdu.name
    if hdu.shape != shape:
        raise InputError(
            f"{path}: {name}: got an extension of {' x '.join(map(str, hdu.shape))}, expected the "
            f"frame's {' x '.join(map(str, shape))} pixels: remove it or cut it to the frame"
        )
    _require_checksum(path, hdus, hdu)
    flagged = np.asarray(hdu.data != 0)
    if flagged.mean() > MOST_FLAGGED:
        raise InputError(
            f"{path}: {name}: got {flagged.mean():.0%} of the pixels flagged, expected zero where "
            "a pixel is good: invert the extension or remove it"
        )
    return flagged
