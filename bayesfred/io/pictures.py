"""TIFF and PNG frames: greyscale pictures read as the numbers that they store.

Pictures are made to be looked at, and what is done to please the eye would change counts. So a
picture is read only where its numbers are unambiguous: one page of grey values of 8 bits or more,
which grow with the light. Nothing is scaled, inverted or rotated: an orientation (EXIF) is ignored,
and row 0 is the first row that is stored. A gamma or a colour profile is not undone, so the camera
has to write linear values. TIFF files compressed with JPEG are read, but such counts are not what
the detector gave.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import TiffImageFile

from bayesfred.errors import InputError
from bayesfred.io.reading import readable

__all__ = ["read_picture"]

Stored = np.ndarray[tuple[Any, ...], np.dtype[Any]]

_GREY = ("L", "I", "I;16", "I;16B", "I;16L", "F")  # Pillow's modes
_BITS, _COMPRESSION, _PHOTOMETRIC, _ORIENTATION, _SAMPLES, _FORMAT = 258, 259, 262, 274, 277, 339
_UNSIGNED, _SIGNED = 1, 2  # of _FORMAT
_SWAPPED = ((8, _UNSIGNED), (8, _SIGNED), (16, _UNSIGNED))  # right in every Pillow

# Pillow rotates a TIFF picture by its orientation; these bring back the rows that are stored.
_STORED: dict[int, Callable[[Any], Any]] = {
    2: np.fliplr,
    3: lambda shown: shown[::-1, ::-1],
    4: np.flipud,
    5: np.transpose,
    6: np.rot90,
    7: lambda shown: shown[::-1, ::-1].T,
    8: lambda shown: np.rot90(shown, -1),
}


def read_picture(path: Path, require_room: Callable[[str, tuple[int, int]], None]) -> Stored:
    """Read the grey values of a TIFF (.tif .tiff) or PNG (.png) file.

    Parameters
    ----------
    path : Path
    require_room : callable
        Told the picture's name and shape before it is read; raises where that is too large.

    Returns
    -------
    ndarray, shape (ny, nx), stored units
        Of the type that is stored (int16 as int32). Row 0 is the first row that is stored, whatever
        the orientation (EXIF) says.

    Raises
    ------
    InputError
        The file is damaged or of another kind; it holds colours, transparency, several pages,
        values of less than 8 bits, or values that fall as the light grows; it is too large.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "frame.png"
    ...     Image.fromarray(np.array([[3, 0], [1, 900]], np.uint16)).save(path)
    ...     read_picture(path, lambda where, shape: None).tolist()
    [[3, 0], [1, 900]]
    """
    # Pillow warns of odd headings, which do not change the numbers, and of large pictures.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if path.suffix.lower() == ".png":
            return _png(path, require_room)
        return _tiff(path, require_room)


def _png(path: Path, require_room: Callable[[str, tuple[int, int]], None]) -> Stored:
    with readable(path, "PNG"), path.open("rb") as stream:
        heading = stream.read(25)
        stream.seek(0)
        with PngImageFile(stream) as picture:
            _require_grey(path, picture, heading[24])  # the bit depth: Pillow scales a small one
            require_room(f"{path}", picture.size[::-1])
            return np.asarray(picture).astype(np.uint8 if heading[24] == 8 else np.uint16)


def _tiff(path: Path, require_room: Callable[[str, tuple[int, int]], None]) -> Stored:
    with readable(path, "TIFF"), path.open("rb") as stream, _opened(path, stream) as picture:
        tags = picture.tag_v2
        bits, kind = tags.get(_BITS, (1,))[0], tags.get(_FORMAT, (_UNSIGNED,))[0]
        samples, orientation = tags.get(_SAMPLES, 1), tags.get(_ORIENTATION, 1)
        _require_grey(path, picture, bits)
        if samples != 1:
            raise InputError(
                f"{path}: got {samples} samples a pixel, expected one: save the plane of counts "
                "alone"
            )
        if tags.get(_PHOTOMETRIC) != 1:
            raise InputError(
                f"{path}: got PhotometricInterpretation {tags.get(_PHOTOMETRIC, 'missing')}, "
                "expected 1 (black is zero): save it with values that grow with the light"
            )
        # of these, Pillow would swap the bytes of some a second time
        if tags.prefix == b"MM" and tags.get(_COMPRESSION, 1) != 1 and (bits, kind) not in _SWAPPED:
            raise InputError(
                f"{path}: got compressed big-endian values of {bits} bits, expected them "
                "little-endian or not compressed: save it so"
            )
        require_room(f"{path}", picture.size[::-1])
        try:
            stored = np.asarray(picture)
        except Image.DecompressionBombError:
            raise InputError(
                f"{path}: got {math.prod(picture.size)} pixels, expected at most "
                f"{2 * (Image.MAX_IMAGE_PIXELS or 0)}: cut the frame or save it as FITS"
            ) from None
        # Pillow keeps the bits of these two kinds, but not their sign
        if (bits, kind) == (32, _UNSIGNED):
            stored = stored.view(np.uint32)
        elif (bits, kind) == (8, _SIGNED):
            stored = stored.view(np.int8)
        stored = _STORED.get(orientation, np.asarray)(stored)
        return np.ascontiguousarray(stored, stored.dtype.newbyteorder("="))


def _opened(path: Path, stream: Any) -> TiffImageFile:
    try:
        return TiffImageFile(stream)
    except SyntaxError as error:
        if "unknown pixel mode" not in str(error):
            raise
        raise InputError(
            f"{path}: got a TIFF file of an unusual kind, expected grey values (black is zero) of "
            "8 or 16 bits, or of 32 bits and little-endian: save it so, or as FITS"
        ) from None


def _require_grey(path: Path, picture: PngImageFile | TiffImageFile, bits: int) -> None:
    pages = picture.n_frames
    if pages != 1:
        raise InputError(f"{path}: got {pages} pages, expected one: save the frame's page alone")
    if picture.mode not in (*_GREY, "1"):
        raise InputError(
            f"{path}: got colours or transparency ({picture.mode}), expected grey values: separate "
            "the planes of a colour camera first, without interpolation, and take one"
        )
    if "transparency" in picture.info:
        raise InputError(
            f"{path}: got a transparent grey value, expected none: save it without transparency"
        )
    if bits < 8:
        raise InputError(
            f"{path}: got values of {bits} bits, expected 8 or more: save it as the camera gave it"
        )
