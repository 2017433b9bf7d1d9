"""Tables of results on disk: ECSV files that grow by a row at a time.

A row is in the file, in one write, before the next is computed, so that a study that is stopped
resumes behind its last whole row. Each such row ends with a check, the first 16 digits of

    SHA-256(key, newline, the row's text before the check),

with a key that stands for what the table is of. So a digit that changed, a row of another table and
a row that stands there twice are noticed, and the line is named. `atomic.replace` writes a table as
a whole.
"""

from __future__ import annotations

import contextlib
import hashlib
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
from bayesfred.io.marks import marked
from bayesfred.io.paths import may_write
from bayesfred.io.reading import readable, require_file

__all__ = [
    "CHECK",
    "TableRecord",
    "appending",
    "parse",
    "read_table",
    "read_text",
    "require_checks",
    "with_meta",
    "write_table",
]

CHECK = "check"  # name of the column that ends rows with a check


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
    return parse(path, read_text(path))


def read_text(path: Path) -> str:
    """Read a table's text, but for a last row that was cut short.

    Parameters
    ----------
    path : Path

    Returns
    -------
    str

    Raises
    ------
    InputError
        The file is missing, cannot be read, or is no text.
    """
    require_file(path)
    with readable(path, "table"):
        text = path.read_bytes().decode().replace("\r\n", "\n")
    return text[: text.rfind("\n") + 1]


def parse(path: Path, text: str) -> TableRecord:
    """Make the table of its text.

    Parameters
    ----------
    path : Path
        Where it is from, to begin the line of an error with.
    text : str

    Returns
    -------
    TableRecord

    Raises
    ------
    InputError
        It is damaged or no such table.
    """
    with readable(path, "table"), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        table = Table.read(text.split("\n"), format="ascii.ecsv", fill_values=None)
    return TableRecord({name: np.asarray(table[name]) for name in table.colnames}, dict(table.meta))


def require_checks(path: Path, text: str, key: str) -> None:
    """Refuse a table of which a row is not as it was appended, or stands there twice.

    Parameters
    ----------
    path : Path
        Where it is from.
    text : str
        Of a table whose rows begin with numbers of their own and end with checks.
    key : str
        As `appending` was given it.

    Raises
    ------
    InputError
        With the number of the line.
    """
    lines, first = _rows(text)
    seen: dict[str, int] = {}
    for at, line in enumerate(lines, first):
        body, _, check = line.rpartition(",")
        if check != _check(key, body):
            raise InputError(
                f"{path}: line {at}: got a row that differs from its check, expected it as it "
                "was written: remove the line, and its task is done again"
            )
        before = seen.setdefault(body.partition(",")[0], at)
        if before != at:
            raise InputError(
                f"{path}: line {at}: got the row of line {before} again, expected each task once: "
                "remove one of the lines"
            )


def with_meta(path: Path, text: str, record: TableRecord) -> None:
    """Replace what a table says of itself; its rows stay as they are, to the bit.

    Parameters
    ----------
    path : Path
    text : str
        The table.
    record : TableRecord
        With the table's columns, and what it is to say.

    Raises
    ------
    InputError
        The file cannot be written.
    """
    empty = {name: values[:0] for name, values in record.columns.items()}
    rows = "".join(f"{line}\n" for line in _rows(text)[0])
    replace(path, _ecsv(TableRecord(empty, record.meta)).encode(), rows.encode())


def _rows(text: str) -> tuple[list[str], int]:
    """The lines below the names of the columns, and the number of the first, counted from 1."""
    lines = text.removesuffix("\n").split("\n")
    names = next((k for k, line in enumerate(lines) if not line.startswith("#")), len(lines))
    return lines[names + 1 :], names + 2


def _check(key: str, body: str) -> str:
    """The last cell of a row."""
    return hashlib.sha256(f"{key}\n{body}".encode()).hexdigest()[:16]


def _ecsv(record: TableRecord) -> str:
    buffer = io.StringIO()
    Table(dict(record.columns), meta=dict(record.meta)).write(
        buffer, format="ascii.ecsv", delimiter=","
    )
    return buffer.getvalue()


def write_table(
    path: PathLike, record: TableRecord, *, overwrite: bool = False, run: str | None = None
) -> None:
    """Write a table as ECSV, every digit kept.

    `astropy.table.Table.read` reads it, and so does anything that reads CSV.

    Parameters
    ----------
    path : path-like
        An .ecsv file.
    record : TableRecord
    overwrite : bool
        Replace a file that exists.
    run : str, optional
        The run that makes the table, see `marks`.

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
    content = _ecsv(record).encode()
    replace(path, content if run is None else marked(content, run))


@contextlib.contextmanager
def appending(
    path: Path, key: str | None = None
) -> Iterator[Callable[[Sequence[float | str]], None]]:
    """Append rows to a table that `write_table` wrote, each in one write.

    Parameters
    ----------
    path : Path
        The table. A last row that was cut short is removed first.
    key : str, optional
        What the table is of: with it every row gets a check in the last column.

    Yields
    ------
    callable
        Takes one row, numbers and texts in the order of the columns, without the check.

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
        body = ",".join(map(cell, row))
        line = f"{body}\n" if key is None else f"{body},{_check(key, body)}\n"
        left = line.encode()
        with writing(path):
            while left:
                left = left[stream.write(left) :]

    with writing(path):
        stream = path.open("r+b", buffering=0)
    with stream:
        with writing(path):
            stream.truncate(stream.read().rfind(b"\n") + 1)
            stream.seek(0, io.SEEK_END)
        yield append
        with writing(path):
            os.fsync(stream.fileno())
