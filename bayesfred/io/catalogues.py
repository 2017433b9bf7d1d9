"""Catalogues of known sources on disk: CSV and ECSV tables of positions and fluxes.

Positions are pixels of the object plane, or right ascension and declination.
What a file gets wrong is said in one line (:class:`bayesfred.errors.InputError`), with its row and
its column. `atomic.replace` does the writing.
"""

from __future__ import annotations

import csv
import io
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import units
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.frames import LARGEST_COUNT
from bayesfred.io.paths import may_write
from bayesfred.io.reading import read_lines, readable, require_file
from bayesfred.io.sky import degrees, moved

__all__ = [
    "CatalogueRecord",
    "SkyRecord",
    "read_catalogue",
    "read_sky_catalogue",
    "write_catalogue",
]

MOTION = units.mas / units.yr
HEADING = "heading"
_FORMATS = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv"}


@dataclass(frozen=True, eq=False)
class CatalogueRecord:
    """Positions and fluxes of known sources.

    Attributes
    ----------
    x, y : ndarray, shape (n,), pixel
        Undistorted positions from the middle of the frame, x along columns and y along rows.
    flux : ndarray, shape (n,), counts
        Expected counts of each source over the whole of its image; nan where the file has none.
    """

    x: Floats
    y: Floats
    flux: Floats


@dataclass(frozen=True, eq=False)
class SkyRecord:
    """Directions and fluxes of known stars.

    Attributes
    ----------
    ra, dec : ndarray, shape (n,), degree
        ICRS.
    flux : ndarray, shape (n,), counts
        Nan where the file has none.
    """

    ra: Floats
    dec: Floats
    flux: Floats


def read_catalogue(
    path: PathLike,
    *,
    x: str = "x",
    y: str = "y",
    flux: str | None = "flux",
    magnitude: str | None = None,
    zero_point: float | None = None,
) -> CatalogueRecord:
    r"""Read a catalogue of sources.

    Parameters
    ----------
    path : path-like
        A .csv or .ecsv file with one row a source.
    x, y : str
        Columns of the positions (pixel, from the middle of the frame).
    flux : str or None
        Column of the fluxes (counts); ignored where `magnitude` is given. None where fluxes are not
        needed: they are nan unless there is a column `flux`.
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
    table = _table(path)
    record = CatalogueRecord(
        _column(path, table, x),
        _column(path, table, y),
        _fluxes(path, table, flux, magnitude, zero_point),
    )
    _require_distinct(path, record.x, record.y)
    return record


def read_sky_catalogue(
    path: PathLike,
    *,
    ra: str = "ra",
    dec: str = "dec",
    flux: str | None = "flux",
    magnitude: str | None = None,
    zero_point: float | None = None,
    motion: tuple[str, str] | None = None,
    epoch: float = 2000.0,
    date: str | None = None,
) -> SkyRecord:
    r"""Read a catalogue of stars with their directions.

    Parameters
    ----------
    path : path-like
        A .csv or .ecsv file with one row a star.
    ra, dec : str
        Columns of the directions (ICRS): in the unit of the column, or numbers in degrees, or texts
        such as 12:34:56.7 (hours for `ra`) and -12d34m56s.
    flux, magnitude, zero_point
        As for `read_catalogue`.
    motion : (str, str), optional
        Columns of the proper motions, in the unit of the column or milliarcsecond a year: along
        right ascension, with the cosine of the declination, and along declination.
    epoch : float, Julian year
        Of the directions.
    date : str, optional
        ISO 8601: when the frame was taken; needed with `motion`.

    Returns
    -------
    SkyRecord
        At the date of the frame, if there are proper motions.

    Raises
    ------
    InputError
        As `read_catalogue`; a declination is beyond a pole; there are proper motions, but no date.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = Path(folder, "stars.csv").write_text("ra,dec,flux\n18:36:56.3,38d47m1s,9e4\n")
    ...     print(read_sky_catalogue(f"{folder}/stars.csv").ra.round(4))
    [279.2346]
    """
    path = Path(path)
    table = _table(path)
    fluxes = _fluxes(path, table, flux, magnitude, zero_point)
    right, up = (_angles(path, table, name, hours=name == ra) for name in (ra, dec))
    beyond = np.flatnonzero(np.abs(up) > 90.0)
    if beyond.size:
        raise InputError(
            f"{path}: row {beyond[0] + 1}, column {dec!r}: got {up[beyond[0]]:g}, expected a "
            "declination from -90 to 90 degrees"
        )
    if motion is not None:
        if date is None:
            raise InputError(
                f"{path}: got proper motions, expected the date of the frame too: give sky.date"
            )
        rates = _rates(path, table, motion[0]), _rates(path, table, motion[1])
        right, up = moved(right, up, rates, epoch, date)
    _require_distinct(path, right, up)
    return SkyRecord(right, up, fluxes)


def write_catalogue(path: PathLike, record: CatalogueRecord, *, overwrite: bool = False) -> None:
    """Write a catalogue with columns x, y (pixel) and flux (counts), every digit kept.

    Parameters
    ----------
    path : path-like
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
    table_format = _format(path)
    may_write(path, overwrite=overwrite)
    buffer = io.StringIO()
    Table([record.x, record.y, record.flux], names=["x", "y", "flux"]).write(
        buffer, format=table_format
    )
    replace(path, buffer.getvalue().encode())


def _format(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        expected = " or ".join(_FORMATS)
        raise InputError(
            f"{path}: got a catalogue file ending in {path.suffix!r}, expected {expected}"
        )
    return _FORMATS[suffix]


def _table(path: Path) -> Table:
    """The table in a file, with at least one row."""
    table_format = _format(path)
    require_file(path)
    with readable(path, "table"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        lines = read_lines(path)
        # Astropy's fast reader silently drops what follows an unclosed quotation mark.
        table = Table.read(lines, format=table_format, fast_reader=False) if any(lines) else Table()
        table.meta = {HEADING: _heading(lines, ecsv=table_format == "ascii.ecsv")}
    if len(table) == 0:
        raise InputError(
            f"{path}: got an empty catalogue, expected a heading and at least one source"
        )
    return table


def _heading(lines: list[str], *, ecsv: bool) -> list[str]:
    """The names of the columns as they are written: astropy gives one that comes again another."""
    comma = not ecsv or "# delimiter: ','" in lines
    named = (line for line in lines if line.strip() and not (ecsv and line.startswith("#")))
    return [name.strip() for name in next(csv.reader(named, delimiter="," if comma else " "), [])]


def _fluxes(
    path: Path, table: Table, flux: str | None, magnitude: str | None, zero_point: float | None
) -> Floats:
    """The fluxes of a table, which are nan where it has none and needs none."""
    if magnitude is not None and (zero_point is None or not math.isfinite(zero_point)):
        raise InputError(
            f"{path}: zero_point: got {zero_point}, expected a number with magnitude; give both"
        )
    light = magnitude or flux or ("flux" if "flux" in table.colnames else None)
    if light is None:
        return np.full(len(table), np.nan)
    fluxes = _column(path, table, light)
    if magnitude is not None and zero_point is not None:
        with np.errstate(over="ignore", under="ignore"):
            fluxes = 10.0 ** (-0.4 * (fluxes - zero_point))
    bad = np.flatnonzero(~((fluxes > 0) & (fluxes <= LARGEST_COUNT)))
    if bad.size:
        where = f"row {bad[0] + 1}, column {light!r}"
        raise InputError(
            f"{path}: {where}: got a flux of {fluxes[bad[0]]:.9g}, expected a positive one of at "
            f"most {LARGEST_COUNT:.0e} counts"
        )
    return fluxes


def _angles(path: Path, table: Table, name: str, *, hours: bool) -> Floats:
    """A column of angles in degrees."""
    column = _present(path, table, name)
    if column.dtype.kind not in "OSU":
        try:
            return degrees(_column(path, table, name), column.unit, hours=hours)
        except units.UnitsError:
            raise InputError(
                f"{path}: column {name!r}: got the unit {str(column.unit)!r}, expected that of an "
                "angle, such as deg"
            ) from None
    angles = np.empty(len(table))
    for row, cell in enumerate(column):
        try:
            angles[row] = degrees([cell], None, hours=hours)[0]
        except ValueError:
            angles[row] = np.nan
        if not abs(angles[row]) <= 360.0:
            raise InputError(
                f"{path}: row {row + 1}, column {name!r}: got {str(cell)!r}, expected degrees, or "
                "a text such as 12:34:56.7"
            )
    return angles


def _rates(path: Path, table: Table, name: str) -> Floats:
    """A column of proper motions in milliarcsecond a year, which it is in without a unit."""
    values, unit = _column(path, table, name), table[name].unit
    try:
        return np.asarray(values if unit is None else (values * unit).to_value(MOTION))
    except (TypeError, units.UnitConversionError):
        raise InputError(
            f"{path}: column {name!r}: got the unit {str(unit)!r}, expected that of a proper "
            "motion, such as mas/yr"
        ) from None


def _present(path: Path, table: Table, name: str) -> Any:
    """A column, or one line that says which there are."""
    if name not in table.colnames:
        present = ", ".join(map(repr, table.colnames))
        raise InputError(
            f"{path}: got no column {name!r}, expected one of: {present}; give its name"
        )
    if table.meta[HEADING].count(name) > 1:
        raise InputError(
            f"{path}: got column {name!r} {table.meta[HEADING].count(name)} times, expected it "
            "once: remove or rename the others"
        )
    return table[name]


def _column(path: Path, table: Table, name: str) -> Floats:
    """A column of finite numbers."""
    column = _present(path, table, name)
    values = np.empty(len(table))
    for row, cell in enumerate(column):
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


def _require_distinct(path: Path, x: Floats, y: Floats) -> None:
    first: dict[tuple[float, float], int] = {}
    for row, position in enumerate(zip(x.tolist(), y.tolist(), strict=True), start=1):
        if first.setdefault(position, row) != row:
            got = f"({position[0]:.9g}, {position[1]:.9g}) again, as in row {first[position]}"
            raise InputError(
                f"{path}: row {row}: got position {got}, expected each once; remove one row"
            )
