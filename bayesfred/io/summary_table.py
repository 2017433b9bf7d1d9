"""Columns of results as an astropy Table, which keeps them outside the package's own files."""

from collections.abc import Mapping, Sequence
from typing import Any

from astropy.table import Table
from numpy.typing import NDArray

__all__ = ["Table", "make_table"]


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
