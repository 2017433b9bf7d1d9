"""Columns of results as an astropy Table, which keeps them outside the package's own files."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from astropy.table import Table, vstack
from numpy.typing import NDArray

__all__ = ["Table", "make_table", "vstack"]


def make_table(columns: Mapping[str, NDArray[Any] | Sequence[str]]) -> Table:
    """Put columns of equal length into a table.

    Parameters
    ----------
    columns : mapping of str to ndarray or sequence of str, length n
        Numbers or texts by name.

    Returns
    -------
    astropy.table.Table
        A row for each of the n values.

    Examples
    --------
    >>> make_table({"name": ["background"], "mean": [5.0]}).colnames
    ['name', 'mean']
    """
    table = Table(dict(columns))
    for name in table.colnames:
        if table[name].dtype.kind == "f":
            table[name].info.format = ".6g"  # as printed; the numbers keep their digits
    return table


def stacked(tables: Mapping[str, Table], key: str) -> Table:
    """Put tables below each other, with a first column that says where a row is from.

    Parameters
    ----------
    tables : mapping of str to Table
        They need not have the same columns: what one lacks is nan or empty there.
    key : str
        Name of the column.

    Returns
    -------
    astropy.table.Table

    Examples
    --------
    >>> one = make_table({"x": [1.0, 2.0]})
    >>> both = stacked({"a": one, "b": one[:1]}, "frame")
    >>> both["frame"].tolist(), both["x"].tolist()
    (['a', 'a', 'b'], [1.0, 2.0, 1.0])
    """
    parts = []
    for name, table in tables.items():
        part = Table(table, copy=True)
        part.add_column([name] * len(part), name=key, index=0)
        parts.append(part)
    found = vstack(parts, metadata_conflicts="silent")
    for name in found.colnames:
        if np.ma.isMaskedArray(found[name]):
            found[name] = found[name].filled("" if found[name].dtype.kind in "US" else np.nan)
    return make_table({name: found[name].data for name in found.colnames})
