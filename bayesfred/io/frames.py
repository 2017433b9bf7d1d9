"""Frames on disk: FITS, HDF5, NPY, TIFF and PNG images.

:func:`read_frame` turns stored numbers into counts and says which pixels to trust. A frame comes in
as a record that owns its arrays and knows nothing of the model. What a file gets wrong is said in
one line (:class:`bayesfred.errors.InputError`). `atomic.replace` does the writing.
"""

from __future__ import annotations

import gzip
import io
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits
from numpy.typing import ArrayLike

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.errors import InputError, printable
from bayesfred.io.atomic import replace
from bayesfred.io.fits_images import StoredImage, read_fits
from bayesfred.io.headers import conversion
from bayesfred.io.memory import require_room
from bayesfred.io.paths import may_write
from bayesfred.io.pictures import read_picture
from bayesfred.io.reading import readable, require_file
from bayesfred.io.saturation import plateau, suspicion
from bayesfred.io.tangent_plane import TangentPlane

__all__ = [
    "LARGEST_COUNT",
    "FrameRecord",
    "read_frame",
    "read_stored",
    "require_memory",
    "write_frame",
]

_FITS_SUFFIXES = (".fits", ".fit", ".fts")
_FORMATS = {
    **dict.fromkeys(_FITS_SUFFIXES, "FITS"),
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".npy": "NPY",
    **dict.fromkeys((".png", ".tif", ".tiff"), "picture"),
}

# Up to this count float64 has every whole number.
LARGEST_COUNT = 2.0**53

# What a fit takes at its peak, for each pixel: frame, mask and model in their copies, and a
# workspace for each thread. Measured.
_BYTES_A_PIXEL = 150 + 24 * (os.cpu_count() or 1)


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """One frame of counts and the pixels that can be trusted.

    Attributes
    ----------
    counts : ndarray, shape (ny, nx), counts
        Photo-electrons where a gain was given, else the stored counts; 0 in masked pixels.
    valid : ndarray of bool, shape (ny, nx)
        True where the pixel holds a measurement.
    n_masked : int
        Number of pixels that are not valid.
    description : str
        One line: the file, its shape, how many pixels are masked and why, and what was taken from
        its header or not.
    read_noise : float or None, e-
        As a FITS header has it.
    sky : TangentPlane or None
        Where a FITS header places the frame on the sky, in recorded pixels.
    date : str or None
        When a FITS header says that it was taken.
    """

    counts: Floats
    valid: Flags
    n_masked: int
    description: str
    read_noise: float | None = None
    sky: TangentPlane | None = None
    date: str | None = None


def read_frame(
    path: PathLike,
    *,
    gain: float | None = None,
    pedestal: float | None = None,
    saturation: float | None = None,
    name: str | None = None,
) -> FrameRecord:
    """Read one frame as counts.

    Parameters
    ----------
    path : path-like
        A FITS (.fits .fit .fts, also followed by .gz or .fz), HDF5 (.h5 .hdf5), NumPy (.npy), TIFF
        (.tif .tiff) or PNG (.png) file. Pictures have to hold linear grey values, and their
        orientation is not applied.
    gain : float, optional, e-/adu
        Counts are (stored - pedestal) * gain. By default a FITS header's EGAIN or GAIN, or 1 where
        its BUNIT is electrons. Without a gain the stored numbers, less the pedestal, must be counts
        already: whole and not negative.
    pedestal : float, optional, stored units
        Level that no light would give, by default 0. A header's PEDESTAL is refused, as programs
        differ in its sign.
    saturation : float, optional, stored units
        Pixels at or above this level are masked. By default a header's SATURATE; without one, the
        pixels at the frame's maximum if there are so many that it looks like a plateau. Infinity
        masks none.
    name : str, optional
        FITS extension or HDF5 dataset. By default the first 2-D image of a FITS file, and `counts`
        in an HDF5 file.

    Returns
    -------
    FrameRecord
        Pixels that hold NaN or infinity, that are or seem saturated, or that a FITS extension (DQ,
        MASK, BPM) flags are masked. With a gain, read noise may leave counts below zero. They are
        kept.

    Raises
    ------
    InputError
        The file is missing, damaged or of another kind; a checksum is wrong; it holds no such
        image; a fit of it would not fit in memory; its numbers are not counts and no gain is given;
        its header cannot be taken at its word; no pixel is left.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_frame(f"{folder}/frame.fits", [[3, 0], [1, 9]])
    ...     frame = read_frame(f"{folder}/frame.fits", saturation=9)
    >>> frame.description
    'frame.fits: 2 x 2 pixels, 1 masked (1 saturated)'
    """
    path = Path(path)
    _format(path)
    if gain is not None and not (math.isfinite(gain) and gain > 0):
        raise InputError(f"{path}: gain: got {gain}, expected a positive number of e-/adu")
    if pedestal is not None and not math.isfinite(pedestal):
        raise InputError(
            f"{path}: pedestal: got {pedestal}, expected a finite number in stored units"
        )
    if saturation is not None and not saturation > -math.inf:
        raise InputError(f"{path}: saturation: got {saturation}, expected a level in stored units")
    image = read_stored(path, name)
    stored = image.stored
    known = conversion(path, image.header, gain=gain, pedestal=pedestal, saturation=saturation)
    notes = [*known.notes, *(f"{unused} not used" for unused in image.unused)]

    finite = np.isfinite(stored)
    masks = {"NaN": np.isnan(stored), "infinite": np.isinf(stored)}
    masks |= {f"flagged in {flagging}": flags for flagging, flags in image.flags.items()}
    if image.largest is not None and known.gain is None:
        notes.append("no gain: stored numbers taken as photo-electrons")
    level, why = known.saturation, "saturated"
    if level is None:
        level, why = plateau(stored[finite], image.largest), "suspected of saturation"
        if level is not None:
            notes.append(suspicion(path, level, float(np.mean(stored[finite] >= level))))
    if level is not None:
        masks[why] = finite & (stored >= level)
    valid = ~np.any(list(masks.values()), axis=0)
    reasons = ", ".join(f"{mask.sum()} {reason}" for reason, mask in masks.items() if mask.any())
    if not valid.any():
        raise InputError(f"{path}: got every pixel masked ({reasons}), expected some to use")

    with np.errstate(over="ignore"):
        counts = np.where(valid, stored, known.pedestal) - known.pedestal
        counts *= 1.0 if known.gain is None else known.gain
    _refuse(
        path,
        counts,
        np.abs(counts) > LARGEST_COUNT,
        f"counts of at most {LARGEST_COUNT:.0e}; check gain and pedestal",
    )
    if known.gain is None:
        counts = _require_counts(path, counts)
    n_masked = int(valid.size - valid.sum())
    masked = f"{n_masked} masked ({reasons})" if n_masked else "none masked"
    said = "; ".join([f"{_by(stored.shape)} pixels, {masked}", *notes])
    said = f"{printable(path.name)}: {said}"
    return FrameRecord(counts, valid, n_masked, said, known.read_noise, image.sky, image.date)


def read_stored(path: PathLike, name: str | None = None) -> StoredImage:
    """Read one frame as it is stored, with what its file says of it.

    Parameters
    ----------
    path : path-like
        As `read_frame` takes it.
    name : str, optional
        FITS extension or HDF5 dataset.

    Returns
    -------
    StoredImage

    Raises
    ------
    InputError
        As `read_frame` does of files.
    """
    path = Path(path)
    kind = _format(path)
    require_file(path)
    return _READERS[kind](path, name)


def write_frame(path: PathLike, counts: ArrayLike, *, overwrite: bool = False) -> None:
    """Write one frame as float64, in the format its suffix names (see :func:`read_frame`).

    Parameters
    ----------
    path : path-like
        HDF5 files get one dataset, `counts`; .fz files are compressed without loss.
    counts : array_like, shape (ny, nx), counts
        The frame.
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        The array is not a 2-D image; the suffix is unknown; the file exists; the folder cannot be
        written.
    """
    path = Path(path)
    kind = _format(path)
    if kind == "picture":
        raise InputError(
            f"{path}: got a picture to write, expected FITS, HDF5 or NPY, which hold every bit of "
            "a count: change its suffix"
        )
    image = np.asarray(counts)
    _require_image(path, image.shape, image.dtype)
    may_write(path, overwrite=overwrite)
    image = image.astype(np.float64)
    buffer = io.BytesIO()
    if kind == "NPY":
        np.save(buffer, image, allow_pickle=False)
    elif kind == "HDF5":
        with h5py.File(buffer, "w") as file:
            file["counts"] = image
    elif path.suffix.lower() == ".fz":
        # The default quantises floats; this pair of settings keeps every bit.
        packed = fits.CompImageHDU(image, compression_type="GZIP_2", quantize_level=0.0)
        fits.HDUList([fits.PrimaryHDU(), packed]).writeto(buffer)
    else:
        fits.PrimaryHDU(image).writeto(buffer)
    content = buffer.getvalue()
    replace(path, gzip.compress(content) if path.suffix.lower() == ".gz" else content)


def require_memory(where: str, shape: tuple[int, int]) -> None:
    """Refuse a frame of which a fit would not fit in memory, see `memory.allowed_memory`.

    Parameters
    ----------
    where : str
        What claims to have this shape, to begin the line with.
    shape : tuple of int, (ny, nx)

    Raises
    ------
    InputError
        With the estimate.
    """
    require_room(
        f"{where}: got {_by(shape)} pixels, whose fit",
        math.prod(shape) * _BYTES_A_PIXEL,
        "cut the frame or bin it",
    )


def _format(path: Path) -> str:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] in ([".gz"], [".fz"]) and suffixes[-2:-1] and suffixes[-2] in _FITS_SUFFIXES:
        return "FITS"
    if not suffixes or suffixes[-1] not in _FORMATS:
        expected = f"one of {' '.join(_FORMATS)}, FITS also with .gz or .fz"
        raise InputError(f"{path}: got a frame file ending in {path.suffix!r}, expected {expected}")
    return _FORMATS[suffixes[-1]]


def _by(shape: tuple[int, ...]) -> str:
    return " x ".join(map(str, shape))


def _require_image(
    path: Path, shape: tuple[int, ...] | None, dtype: np.dtype[Any], name: str = ""
) -> None:
    where = f"{path}: {name}" if name else f"{path}"
    if shape is None or len(shape) != 2 or min(shape) < 1:
        got = f"an array of {_by(shape)}" if shape else "no array"
        raise InputError(f"{where}: got {got}, expected a 2-D image (rows, columns) of counts")
    if dtype.kind not in "iuf":
        raise InputError(f"{where}: got values of type {dtype}, expected real numbers")


def _read_fits(path: Path, name: str | None) -> StoredImage:
    return read_fits(path, name, require_memory)


def _read_hdf5(path: Path, name: str | None) -> StoredImage:
    key = name or "counts"
    with readable(path, "HDF5"), h5py.File(path, "r") as file:
        dataset = file.get(key)
        if not isinstance(dataset, h5py.Dataset):
            present = ", ".join(map(repr, file)) or "nothing"
            raise InputError(
                f"{path}: got no dataset {key!r}, expected one of: {present}; give its name"
            )
        _require_image(path, dataset.shape, dataset.dtype, key)
        if dataset.file != file or dataset.external or dataset.is_virtual:
            raise InputError(
                f"{path}: {key}: got a dataset kept in another file, expected it in this one; "
                "copy it"
            )
        require_memory(f"{path}: {key}", dataset.shape)
        return StoredImage(np.asarray(dataset[()], dtype=np.float64))


def _read_npy(path: Path, name: str | None) -> StoredImage:
    if name is not None:
        raise InputError(
            f"{path}: got name {name!r}, expected none, as an NPY file holds one array"
        )
    with readable(path, "NPY"):
        # A map checks the file's length before memory is taken for what its heading claims. No
        # pickles.
        stored = np.lib.format.open_memmap(path, mode="r")
        _require_image(path, stored.shape, stored.dtype)
        require_memory(f"{path}", stored.shape)
        return StoredImage(np.array(stored, dtype=np.float64))


def _read_picture(path: Path, name: str | None) -> StoredImage:
    if name is not None:
        raise InputError(f"{path}: got name {name!r}, expected none, as a picture holds one image")
    stored = read_picture(path, require_memory)
    largest = None if stored.dtype.kind == "f" else float(np.iinfo(stored.dtype).max)
    return StoredImage(stored.astype(np.float64), largest=largest)


_READERS: dict[str, Callable[[Path, str | None], StoredImage]] = {
    "FITS": _read_fits,
    "HDF5": _read_hdf5,
    "NPY": _read_npy,
    "picture": _read_picture,
}


def _require_counts(path: Path, counts: Floats) -> Floats:
    whole: Floats = np.rint(counts) + 0.0  # + 0.0 turns -0.0 into 0.0
    bad = (np.abs(counts - whole) > 1e-9) | (whole < 0)
    _refuse(
        path, counts, bad, "counts (whole numbers, not negative); give gain (e-/adu) and pedestal"
    )
    return whole


def _refuse(path: Path, counts: Floats, bad: Flags, expected: str) -> None:
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"{path}: got {counts[row, column]:.9g} at row {row}, column {column}, expected "
            f"{expected}"
        )
