"""Frames and catalogues on disk: FITS, HDF5 and NPY images, CSV and ECSV tables.

Files come in as records that own their arrays and know nothing of the model: :func:`read_frame`
turns stored numbers into counts and says which pixels to trust, :func:`read_catalogue` gives
positions and fluxes. What a file gets wrong is said in one line
(:class:`bayesfred.errors.InputError`). Writing goes through a temporary file in the same folder, so
that a reader never meets half a file. Which files a run uses is said in `bayesfred.settings`.
"""

from __future__ import annotations

import contextlib
import gzip
import io
import math
import os
import secrets
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import ArrayLike, NDArray

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError, printable

__all__ = [
    "CatalogueRecord", "FrameRecord", "TableRecord", "appending", "read_catalogue", "read_frame", "read_table", "require_memory",
    "write_bytes", "write_catalogue", "write_frame", "write_table",
]  # fmt: skip

_FITS_SUFFIXES = (".fits", ".fit", ".fts")
_FRAME_FORMATS = {
    **dict.fromkeys(_FITS_SUFFIXES, "FITS"),
    ".h5": "HDF5",
    ".hdf5": "HDF5",
    ".npy": "NPY",
}
_CATALOGUE_FORMATS = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv"}

# Counts up to here are whole numbers of their own in float64.
_MOST_COUNTS = 2.0**53

# What a fit takes at its peak, for each pixel: frame, mask and model in their copies, and a
# workspace a thread. Measured.
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


@dataclass(frozen=True, eq=False)
class CatalogueRecord:
    """Positions and fluxes of known sources.

    Attributes
    ----------
    x, y : ndarray, shape (n,), pixel
        Undistorted positions from the middle of the frame, x along columns and y along rows.
    flux : ndarray, shape (n,), counts
        Expected counts of each source over the whole of its image.
    """

    x: Floats
    y: Floats
    flux: Floats


@dataclass(frozen=True, eq=False)
class TableRecord:
    """A table of results.

    Attributes
    ----------
    columns : dict of str to ndarray, shape (n,)
        Numbers or texts by name.
    meta : dict
        What the numbers are: plain values, lists and dicts of them.
    """

    columns: dict[str, NDArray[Any]]
    meta: dict[str, Any]


def read_frame(
    path: str | Path,
    *,
    gain: float | None = None,
    pedestal: float = 0.0,
    saturation: float | None = None,
    name: str | None = None,
) -> FrameRecord:
    """Read one frame as counts.

    Parameters
    ----------
    path : str or Path
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
        may leave counts below zero, and they stay.

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
    kind = _frame_format(path)
    if gain is not None and not (math.isfinite(gain) and gain > 0):
        raise InputError(f"{path}: gain: got {gain}, expected a positive number of e-/adu")
    for label, level in (("pedestal", pedestal), ("saturation", saturation)):
        if level is not None and not math.isfinite(level):
            raise InputError(
                f"{path}: {label}: got {level}, expected a finite number in stored units"
            )
    _require_file(path)
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
        np.abs(counts) > _MOST_COUNTS,
        f"counts of at most {_MOST_COUNTS:.0e}; check gain and pedestal",
    )
    if gain is None:
        counts = _require_counts(path, counts)
    n_masked = int(valid.size - valid.sum())
    masked = f"{n_masked} masked ({reasons})" if n_masked else "none masked"
    return FrameRecord(
        counts, valid, n_masked, f"{printable(path.name)}: {_by(stored.shape)} pixels, {masked}"
    )


def read_catalogue(
    path: str | Path,
    *,
    x: str = "x",
    y: str = "y",
    flux: str = "flux",
    magnitude: str | None = None,
    zero_point: float | None = None,
) -> CatalogueRecord:
    r"""Read a catalogue of sources.

    Parameters
    ----------
    path : str or Path
        A .csv or .ecsv file with one row a source.
    x, y : str
        Columns of the positions (pixel, from the middle of the frame).
    flux : str
        Column of the fluxes (counts); not looked at where `magnitude` is given.
    magnitude : str, optional
        Column of magnitudes, from which flux = 10**(-0.4 (magnitude - zero_point)).
    zero_point : float, optional
        Magnitude of a source of one count.

    Returns
    -------
    CatalogueRecord

    Raises
    ------
    InputError
        The file is missing, damaged or empty; a column is absent; a value is no finite number; a
        flux is not positive, or more than 9e15; two rows have the same position. Rows are numbered
        from 1, the heading not counted.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "stars.csv").write_text("x,y,mag\n-3.5,2,17.5\n")
    ...     read_catalogue(f"{folder}/stars.csv", magnitude="mag", zero_point=25.0).flux
    array([1000.])
    """
    path = Path(path)
    table_format = _catalogue_format(path)
    if magnitude is not None and (zero_point is None or not math.isfinite(zero_point)):
        raise InputError(
            f"{path}: zero_point: got {zero_point}, expected a number with magnitude; give both"
        )
    _require_file(path)
    with _readable(path, "table"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        # A byte order mark would become part of the first column's name.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        # Astropy's fast reader drops what follows an unclosed quotation mark, without a word.
        table = Table.read(lines, format=table_format, fast_reader=False) if any(lines) else Table()
    if len(table) == 0:
        raise InputError(
            f"{path}: got an empty catalogue, expected a heading and at least one source"
        )

    columns = [_column(path, table, column) for column in (x, y, magnitude or flux)]
    if magnitude is not None and zero_point is not None:
        with np.errstate(over="ignore", under="ignore"):
            columns[2] = 10.0 ** (-0.4 * (columns[2] - zero_point))
    record = CatalogueRecord(*columns)
    bad = np.flatnonzero(~((record.flux > 0) & (record.flux <= _MOST_COUNTS)))
    if bad.size:
        where = f"row {bad[0] + 1}, column {magnitude or flux!r}"
        got = f"a flux of {record.flux[bad[0]]:.9g}"
        raise InputError(
            f"{path}: {where}: got {got}, expected a positive one of at most {_MOST_COUNTS:.0e} "
            "counts"
        )
    _require_distinct(path, record)
    return record


def write_frame(path: str | Path, counts: ArrayLike, *, overwrite: bool = False) -> None:
    """Write one frame as float64, in the format its suffix names (see :func:`read_frame`).

    Parameters
    ----------
    path : str or Path
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
    kind = _frame_format(path)
    image = np.asarray(counts)
    _require_image(path, image.shape, image.dtype)
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
    write_bytes(
        path,
        gzip.compress(content) if path.suffix.lower() == ".gz" else content,
        overwrite=overwrite,
    )


def write_catalogue(path: str | Path, record: CatalogueRecord, *, overwrite: bool = False) -> None:
    """Write a catalogue with columns x, y (pixel) and flux (counts), every digit kept.

    Parameters
    ----------
    path : str or Path
        A .csv or .ecsv file.
    record : CatalogueRecord
        The sources.
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        The suffix is unknown; the file exists; the folder cannot be written.
    """
    path = Path(path)
    table_format = _catalogue_format(path)
    buffer = io.StringIO()
    Table([record.x, record.y, record.flux], names=["x", "y", "flux"]).write(
        buffer, format=table_format
    )
    write_bytes(path, buffer.getvalue().encode(), overwrite=overwrite)


def read_table(path: str | Path) -> TableRecord:
    """Read a table that `write_table` wrote, with the rows that were appended since.

    Parameters
    ----------
    path : str or Path
        An .ecsv file. A last row that was cut short, as by a kill, is left out.

    Returns
    -------
    TableRecord

    Raises
    ------
    InputError
        The file is missing, damaged or no such table.
    """
    path = Path(path)
    _require_file(path)
    with _readable(path, "table"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        lines = path.read_text(encoding="utf-8")
        table = Table.read(
            lines[: lines.rfind("\n") + 1].splitlines(), format="ascii.ecsv", fill_values=None
        )
    return TableRecord({name: np.asarray(table[name]) for name in table.colnames}, dict(table.meta))


def write_table(path: str | Path, record: TableRecord, *, overwrite: bool = False) -> None:
    """Write a table as ECSV, every digit kept: `astropy.table.Table.read` and anything that reads CSV understand it.

    Parameters
    ----------
    path : str or Path
        An .ecsv file.
    record : TableRecord
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        The suffix is another; the file exists; the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_table(f"{folder}/t.ecsv", TableRecord({"x": np.array([0.1]), "note": np.array(["a, b"])}, {"seed": 1}))
    ...     with appending(Path(folder, "t.ecsv")) as append:
    ...         append([0.2, "c"])
    ...     table = read_table(f"{folder}/t.ecsv")
    >>> table.columns["x"].tolist(), table.columns["note"].tolist(), table.meta["seed"]
    ([0.1, 0.2], ['a, b', 'c'], 1)
    """
    path = Path(path)
    if path.suffix.lower() != ".ecsv":
        raise InputError(f"{path}: got a table file ending in {path.suffix!r}, expected .ecsv")
    buffer = io.StringIO()
    Table(dict(record.columns), meta=dict(record.meta)).write(
        buffer, format="ascii.ecsv", delimiter=","
    )
    write_bytes(path, buffer.getvalue().encode(), overwrite=overwrite)


@contextlib.contextmanager
def appending(path: Path) -> Iterator[Callable[[Sequence[float | str]], None]]:
    """Append rows to a table that `write_table` wrote; each is in the file, in one write, before the next is begun.

    Parameters
    ----------
    path : Path
        The table. A last row that was cut short is removed first.

    Yields
    ------
    callable
        Takes one row, numbers and texts in the order of the columns.

    Raises
    ------
    InputError
        The file cannot be written.
    """

    def cell(value: float | str) -> str:
        return (
            f'"{printable(value).replace(chr(34), chr(39))}"'
            if isinstance(value, str)
            else repr(value)
        )

    def append(row: Sequence[float | str]) -> None:
        line = (",".join(map(cell, row)) + "\n").encode()
        with _writable(path):
            while line:
                line = line[stream.write(line) :]

    with _writable(path):
        stream = path.open("r+b", buffering=0)
    with stream:
        with _writable(path):
            stream.truncate(stream.read().rfind(b"\n") + 1)
            stream.seek(0, io.SEEK_END)
        yield append
        with _writable(path):
            os.fsync(stream.fileno())


@contextlib.contextmanager
def _writable(path: Path) -> Iterator[None]:
    """Turn what a disk refuses into one line."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}), expected room and a file "
            "that can be"
        ) from error


def write_bytes(path: Path, content: bytes, *, overwrite: bool = False) -> None:
    """Write a file in one step: a reader meets the old file or the new one, and a link is replaced, not followed.

    Parameters
    ----------
    path : Path
    content : bytes
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        The file exists; the folder cannot be written.
    """
    if os.path.lexists(path) and not overwrite:
        raise InputError(
            f"{path}: exists already, expected a new file; rename it or give --overwrite"
        )
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        with temporary.open("xb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.replace(temporary, path)
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{path}: cannot be written ({reason}), expected a folder that can be"
        ) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


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


def _frame_format(path: Path) -> str:
    suffixes = [suffix.lower() for suffix in path.suffixes]
    if suffixes[-1:] in ([".gz"], [".fz"]) and suffixes[-2:-1] and suffixes[-2] in _FITS_SUFFIXES:
        return "FITS"
    if not suffixes or suffixes[-1] not in _FRAME_FORMATS:
        expected = f"one of {' '.join(_FRAME_FORMATS)}, FITS also with .gz or .fz"
        raise InputError(f"{path}: got a frame file ending in {path.suffix!r}, expected {expected}")
    return _FRAME_FORMATS[suffixes[-1]]


def _catalogue_format(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _CATALOGUE_FORMATS:
        expected = " or ".join(_CATALOGUE_FORMATS)
        raise InputError(
            f"{path}: got a catalogue file ending in {path.suffix!r}, expected {expected}"
        )
    return _CATALOGUE_FORMATS[suffix]


def _require_file(path: Path) -> None:
    if not os.path.exists(path):  # unlike Path.exists, whatever the path
        raise InputError(f"{path}: no such file, expected one to read; check the path")
    if not path.is_file():
        raise InputError(f"{path}: not a file, expected one to read; check the path")


@contextlib.contextmanager
def _readable(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a damaged file makes a reader raise into one line."""
    try:
        yield
    except InputError:
        raise
    except (
        Exception
    ) as error:  # astropy, h5py and numpy raise errors of many types, TypeError among them
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"{path}: damaged or no {kind} ({reason}), expected a whole {kind} file"
        ) from error


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
    with _readable(path, "FITS"), warnings.catch_warnings():
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
    with _readable(path, "HDF5"), h5py.File(path, "r") as file:
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
    with _readable(path, "NPY"):
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


def _column(path: Path, table: Table, name: str) -> Floats:
    if name not in table.colnames:
        present = ", ".join(map(repr, table.colnames))
        raise InputError(
            f"{path}: got no column {name!r}, expected one of: {present}; give its name"
        )
    values = np.empty(len(table))
    for row, cell in enumerate(table[name]):
        values[row] = np.nan if np.ma.is_masked(cell) else _number(cell)
        if not math.isfinite(values[row]):
            got = "nothing" if np.ma.is_masked(cell) else repr(str(cell))
            raise InputError(
                f"{path}: row {row + 1}, column {name!r}: got {got}, expected a finite number"
            )
    return values


def _number(cell: Any) -> float:
    """Give a table's cell as a float, NaN where it is none."""
    if isinstance(cell, bool | np.bool_):
        return np.nan
    try:
        return float(cell)
    except (TypeError, ValueError):
        return np.nan


def _require_distinct(path: Path, record: CatalogueRecord) -> None:
    first: dict[tuple[float, float], int] = {}
    for row, position in enumerate(zip(record.x.tolist(), record.y.tolist(), strict=True), start=1):
        if first.setdefault(position, row) != row:
            got = f"({position[0]:.9g}, {position[1]:.9g}) again, as in row {first[position]}"
            raise InputError(
                f"{path}: row {row}: got position {got}, expected each once; remove one row"
            )
