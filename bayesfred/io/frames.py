"""Frames on disk: FITS, HDF5 and NPY images.

:func:`read_frame` turns stored numbers into counts and says which pixels to trust. A frame comes in
as a record that owns its arrays and knows nothing of the model. What a file gets wrong is said in
one line (:class:`bayesfred.errors.InputError`). `atomic.replace` does the writing.
"""

from __future__ import annotations

import gzip
import io
import math
import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import ArrayLike

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.errors import InputError, printable
from bayesfred.io.atomic import replace
from bayesfred.io.paths import may_write
from bayesfred.io.reading import readable, require_file

__all__ = ["LARGEST_COUNT", "FrameRecord", "read_frame", "require_memory", "write_frame"]

_FITS_SUFFIXES = (".fits", ".fit", ".fts")
_FORMATS = {
    **dict.fromkeys(_FITS_SUFFIXES, "FITS"),
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".npy": "NPY",
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
        One line: the file, its shape, how many pixels are masked and why.
    """

    counts: Floats
    valid: Flags
    n_masked: int
    description: str


def read_frame(
    path: PathLike,
    *,
    gain: float | None = None,
    pedestal: float = 0.0,
    saturation: float | None = None,
    name: str | None = None,
) -> FrameRecord:
    """Read one frame as counts.

    Parameters
    ----------
    path : path-like
        A FITS (.fits .fit .fts, also followed by .gz or .fz), HDF5 (.h5 .hdf5) or NumPy (.npy)
        file.
    gain : float, optional, e-/adu
        Counts are (stored - pedestal) * gain. Without a gain the stored numbers, less the pedestal,
        must be counts already: whole and not negative.
    pedestal : float, stored units
        Level that no light would give.
    saturation : float, optional, stored units
        Pixels at or above this level are masked.
    name : str, optional
        FITS extension or HDF5 dataset. By default the first 2-D image of a FITS file, and `counts`
        in an HDF5 file.

    Returns
    -------
    FrameRecord
        Pixels that hold NaN or infinity, or that are saturated, are masked. With a gain, read noise
        may leave counts below zero. They are kept.

    Raises
    ------
    InputError
        The file is missing, damaged or of another kind; it holds no such image; a fit of it would
        not fit in memory; its numbers are not counts and no gain is given; no pixel is left.

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
    kind = _format(path)
    if gain is not None and not (math.isfinite(gain) and gain > 0):
        raise InputError(f"{path}: gain: got {gain}, expected a positive number of e-/adu")
    for label, level in (("pedestal", pedestal), ("saturation", saturation)):
        if level is not None and not math.isfinite(level):
            raise InputError(
                f"{path}: {label}: got {level}, expected a finite number in stored units"
            )
    require_file(path)
    stored = _READERS[kind](path, name)

    finite = np.isfinite(stored)
    saturated = finite & (stored >= (np.inf if saturation is None else saturation))
    valid = finite & ~saturated
    masks = {"NaN": np.isnan(stored), "infinite": np.isinf(stored), "saturated": saturated}
    reasons = ", ".join(f"{mask.sum()} {reason}" for reason, mask in masks.items() if mask.any())
    if not valid.any():
        raise InputError(f"{path}: got every pixel masked ({reasons}), expected some to use")

    with np.errstate(over="ignore"):
        counts = (np.where(valid, stored, pedestal) - pedestal) * (1.0 if gain is None else gain)
    _refuse(
        path,
        counts,
        np.abs(counts) > LARGEST_COUNT,
        f"counts of at most {LARGEST_COUNT:.0e}; check gain and pedestal",
    )
    if gain is None:
        counts = _require_counts(path, counts)
    n_masked = int(valid.size - valid.sum())
    masked = f"{n_masked} masked ({reasons})" if n_masked else "none masked"
    return FrameRecord(
        counts, valid, n_masked, f"{printable(path.name)}: {_by(stored.shape)} pixels, {masked}"
    )


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
    """Refuse a frame of which a fit would not fit in this machine's memory.

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
    need, memory = (
        math.prod(shape) * _BYTES_A_PIXEL,
        os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
    )
    if need > memory:
        raise InputError(
            f"{where}: got {_by(shape)} pixels, whose fit would need about {need / 1e9:.3g} GB of "
            "memory, expected at most the "
            f"{memory / 1e9:.3g} GB of this machine: cut the frame or bin it"
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


class _Stream(io.BufferedReader):
    """A file in which a seek beyond the end, as absurd headers ask for, goes to the end."""

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return super().seek(min(offset, os.fstat(self.fileno()).st_size), whence)


def _read_fits(path: Path, name: str | None) -> Floats:
    seen = []
    with readable(path, "FITS"), warnings.catch_warnings():
        # Warnings are about headers; data that are cut short raise.
        warnings.simplefilter("ignore", AstropyWarning)
        zipped = path.suffix.lower() == ".gz"
        # uint=False: as unsigned integers BLANK pixels would come through as ordinary numbers.
        with (
            gzip.open(path) if zipped else _Stream(io.FileIO(path)) as stream,
            fits.open(stream, memmap=False, uint=False) as hdus,
        ):
            for index, hdu in enumerate(hdus):
                if not hdu.is_image:
                    continue
                seen.append(f"{hdu.name or index} {_by(hdu.shape) or 'without data'}")
                if (
                    len(hdu.shape) == 2
                    and min(hdu.shape) > 0
                    and (name or hdu.name).upper() == hdu.name
                ):
                    require_memory(f"{path}: {hdu.name or index}", hdu.shape)
                    image = np.asarray(hdu.data, dtype=np.float64)
                    while zipped and stream.read(1 << 20):
                        pass  # up to the checksum, which astropy does not reach
                    return image
    wanted = "a 2-D image" if name is None else f"a 2-D image in extension {name!r}"
    raise InputError(f"{path}: got {', '.join(seen) or 'no image'}, expected {wanted}")


def _read_hdf5(path: Path, name: str | None) -> Floats:
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
        return np.asarray(dataset[()], dtype=np.float64)


def _read_npy(path: Path, name: str | None) -> Floats:
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
        return np.array(stored, dtype=np.float64)


_READERS: dict[str, Callable[[Path, str | None], Floats]] = {
    "FITS": _read_fits,
    "HDF5": _read_hdf5,
    "NPY": _read_npy,
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
