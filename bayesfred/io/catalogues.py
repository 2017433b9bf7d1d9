"""Catalogues of known sources on disk: CSV and ECSV tables of positions and fluxes.

What a file gets wrong is said in one line (:class:`bayesfred.errors.InputError`), with its row and
its column. `atomic.replace` does the writing.
"""

from __future__ import annotations

import io
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.frames import LARGEST_COUNT
from bayesfred.io.paths import may_write
from bayesfred.io.reading import readable, require_file

__all__ = ["CatalogueRecord", "read_catalogue", "write_catalogue"]

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
    table_format = _format(path)
    if magnitude is not None and (zero_point is None or not math.isfinite(zero_point)):
        raise InputError(
            f"{path}: zero_point: got {zero_point}, expected a number with magnitude; give both"
        )
    require_file(path)
    with readable(path, "table"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        # A byte order mark would become part of the first column's name.
        lines = path.read_text(encoding="utf-8-sig").splitlines()
        # Astropy's fast reader silently drops what follows an unclosed quotation mark.
        table = Table.read(lines, format=table_format, fast_reader=False) if any(lines) else Table()
    if len(table) == 0:
        raise InputError(
            f"{path}: got an empty catalogue, expected a heading and at least one source"
        )

    light = magnitude or flux or ("flux" if "flux" in table.colnames else None)
    columns = [_column(path, table, column) for column in (x, y, light) if column is not None]
    if light is None:
        columns.append(np.full(len(table), np.nan))
    if magnitude is not None and zero_point is not None:
        with np.errstate(over="ignore", under="ignore"):
            columns[2] = 10.0 ** (-0.4 * (columns[2] - zero_point))
    record = CatalogueRecord(*columns)
    bad = np.flatnonzero(~((record.flux > 0) & (record.flux <= LARGEST_COUNT)))
    if bad.size and light is not None:
        where = f"row {bad[0] + 1}, column {light!r}"
        got = f"a flux of {record.flux[bad[0]]:.9g}"
        raise InputError(
            f"{path}: {where}: got {got}, expected a positive one of at most {LARGEST_COUNT:.0e} "
            "counts"
        )
    _require_distinct(path, record)
    return record


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
