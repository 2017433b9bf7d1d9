"""Checks of a fit: numbers beside what a true model makes of them, and their table.

References
----------
E. Paulson (1942), Annals of Mathematical Statistics 13, 233: a normal deviate from a ratio F.
E. B. Wilson, M. M. Hilferty (1931), PNAS 17, 684: a normal deviate from a chi-square.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from bayesfred.io.summary_table import Table, make_table

__all__ = [
    "Check",
    "check_table",
    "deviate",
    "deviate_of_ratio",
    "largest_deviate",
    "not_tested",
    "sums",
]


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
    texts = {"name", "meaning"}
    columns = {name: [getattr(check, name) for check in checks] for name in Check._fields}
    return make_table(
        {
            name: column if name in texts else np.array(column, dtype=np.float64)
            for name, column in columns.items()
        }
    )


def not_tested(name: str, why: str) -> Check:
    """The row of what could not be tested."""
    return Check(name, math.nan, math.nan, math.nan, math.nan, f"not tested: {why}")


def deviate_of_ratio(f: float, dof: int, left: float) -> float:
    """The normal deviate that is exceeded about as rarely as this F of dof and left degrees."""
    one, other, root = 2.0 / (9.0 * dof), 2.0 / (9.0 * left), f ** (1.0 / 3.0)
    return float(((1.0 - other) * root - 1.0 + one) / math.sqrt(other * root**2 + one))


def deviate(chi2: Any, dof: Any) -> Any:
    """The normal deviate that is exceeded about as rarely as this chi-square."""
    part = 2.0 / (9.0 * dof)
    return ((chi2 / dof) ** (1.0 / 3.0) - 1.0 + part) / np.sqrt(part)


def largest_deviate(z: float, number: int) -> float:
    """The normal deviate that is exceeded as rarely as this |z| by the largest of several."""
    one = 2.0 * special.ndtr(-abs(z))
    if one < 1e-290:  # hardly any number of tests makes a difference then
        return abs(float(z))
    return float(-special.ndtri(-special.expm1(number * special.log1p(-one))))


def sums(fit: Mapping[str, float]) -> list[Check]:
    """Pearson's statistic and the deviance, from `fit_statistics`."""
    meanings = {
        "Pearson": "sum of squared residuals in standard deviations",
        "deviance": "twice the log-likelihood that a perfect model would gain",
    }
    checks = []
    for name, meaning in meanings.items():
        value, expected, sd = (fit[f"{name.lower()}{part}"] for part in ("", "_expected", "_sd"))
        z = (value - expected) / sd if sd > 0.0 else math.nan
        checks.append(Check(name, value, expected, sd, z, meaning))
    return checks
