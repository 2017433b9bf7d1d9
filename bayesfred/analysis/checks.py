"""Checks of a fit: numbers beside what a true model makes of them, and their table.

References
----------
E. B. Wilson, M. M. Hilferty (1931), PNAS 17, 684: a normal deviate from a chi-square.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bayesfred.io.summary_table import Table, make_table

__all__ = ["Check", "check_table", "deviate", "not_tested"]


class Check(NamedTuple):
    """A number that a true model predicts.

    z is (value - expected) / sd where the value is normal, and otherwise the normal deviate that is
    exceeded as rarely; nan where nothing could be tested.
    """

    name: str
    value: float
    expected: float
    sd: float
    z: float
    meaning: str


def check_table(checks: Sequence[Check]) -> Table:
    """A table with a row for each check."""
    rows = list(zip(*checks, strict=True))
    texts = {"name", "meaning"}
    return make_table(
        {
            name: list(column) if name in texts else np.array(column, dtype=np.float64)
            for name, column in zip(Check._fields, rows, strict=True)
        }
    )


def not_tested(name: str, why: str) -> Check:
    """The row of what could not be tested."""
    return Check(name, math.nan, math.nan, math.nan, math.nan, f"not tested: {why}")


def deviate(chi2: float, dof: int) -> float:
    """The normal deviate that is exceeded about as rarely as this chi-square."""
    part = 2.0 / (9.0 * dof)
    return float(((chi2 / dof) ** (1.0 / 3.0) - 1.0 + part) / math.sqrt(part))
