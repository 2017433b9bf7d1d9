"""Tables of results on disk: ECSV files that grow by a row at a time.

A row is in the file, in one write, before the next is computed, so that a study that is stopped
resumes behind its last whole row. `atomic.replace` writes a table as a whole.
"""

from __future__ import annotations

import contextlib
import io
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import NDArray

from bayesfred._typing import PathLike
from bayesfred.errors import InputError, printable
from bayesfred.io.atomic import replace, writing
from bayesfred.io.paths import may_write
from bayesfred.io.reading import readable, require_file

__all__ = ["TableRecord", "appending", "read_table", "write_table"]


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


def read_table(path: PathLike) -> TableRecord:
    """Read a table that `write_table` wrote, with the rows that were appended since.

    Parameters
    ----------
    path : path-like
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
    require_file(path)
    with readable(path, "table"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        lines = path.read_text(encoding="utf-8")
        table = Table.read(
            lines[: lines.rfind("\n") + 1].splitlines(), format="ascii.ecsv", fill_values=None
        )
    return TableRecord({name: np.asarray(table[name]) for name in table.colnames}, dict(table.meta))


def write_table(path: PathLike, record: TableRecord, *, overwrite: bool = False) -> None:
    """Write a table as ECSV, every digit kept.

    `astropy.table.Table.read` reads it, and so does anything that reads CSV.

    Parameters
    ----------
    path : path-like
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
    ...     columns = {"x": np.array([0.1]), "note": np.array(["a, b"])}
    ...     write_table(f"{folder}/t.ecsv", TableRecord(columns, {"seed": 1}))
    ...     with appending(Path(folder, "t.ecsv")) as append:
    ...         append([0.2, "c"])
    ...     table = read_table(f"{folder}/t.ecsv")
    >>> table.columns["x"].tolist(), table.columns["note"].tolist(), table.meta["seed"]
    ([0.1, 0.2], ['a, b', 'c'], 1)
    """
    path = Path(path)
    if path.suffix.lower() != ".ecsv":
        raise InputError(f"{path}: got a table file ending in {path.suffix!r}, expected .ecsv")
    may_write(path, overwrite=overwrite)
    buffer = io.StringIO()
    Table(dict(record.columns), meta=dict(record.meta)).write(
        buffer, format="ascii.ecsv", delimiter=","
    )
    replace(path, buffer.getvalue().encode())


@contextlib.contextmanager
def appending(path: Path) -> Iterator[Callable[[Sequence[float | str]], None]]:
    """Append rows to a table that `write_table` wrote, each in one write.

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
        with writing(path):
            while line:
                line = line[stream.write(line) :]

    with writing(path):
        stream = path.open("r+b", buffering=0)
    with stream:
        with writing(path):
            stream.truncate(stream.read().rfind(b"\n") + 1)
            stream.seek(0, io.SEEK_END)
        yield append
        with writing(path):
            os.fsync(stream.fileno())
