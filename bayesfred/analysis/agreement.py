"""Whether differences are as large as their errors say: a chi-square, two-sided, with its power.

A chi-square of k degrees of freedom is too large where the errors are too small, and the reverse.
Errors that are too small by a factor c make it c^2 times a chi-square variable, which gives the
factor with its confidence interval, and the factor that would be found with a given probability.
"""

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from scipy import stats

from bayesfred._typing import Floats

Verdict = Literal["too small", "right", "too large"]

SIGNIFICANCE = 0.01  # probability of chance on either side below which errors are not right
POWER = 0.9
LEVEL = 0.95  # of the interval of the factor


@dataclass(frozen=True)
class Agreement:
    """How well two halves agree, in units of their errors.

    Attributes
    ----------
    chi2 : float
        Sum of squared differences in units of their standard deviations.
    dof : int
        Degrees of freedom.
    p : float
        Probability of a larger chi-square if the errors are right.
    """

    chi2: float
    dof: int
    p: float

    @classmethod
    def of(cls, z: Floats) -> Self:
        """The agreement of independent differences in units of their standard deviations."""
        chi2 = float(z @ z)
        return cls(chi2, z.size, float(stats.chi2.sf(chi2, z.size)))

    @property
    def verdict(self) -> Verdict:
        """Whether the errors are too small, right or too large: p outside 0.01 to 0.99 says so."""
        if self.p < SIGNIFICANCE:
            return "too small"
        return "too large" if self.p > 1.0 - SIGNIFICANCE else "right"

    @property
    def factor(self) -> float:
        """By what to multiply the errors, as estimated: root of chi2 / dof; nan without degrees."""
        return float(np.sqrt(self.chi2 / self.dof)) if self.dof else np.nan

    @property
    def factor_interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of the factor."""
        tail = 0.5 * (1.0 - LEVEL)
        low, high = (self.chi2 / stats.chi2.isf(q, self.dof) for q in (tail, 1.0 - tail))
        return float(np.sqrt(low)), float(np.sqrt(high))

    @property
    def detectable(self) -> float:
        """Factor by which errors must be too small to be found with probability 0.9.

        The statistic is then the factor's square times a chi-square variable, which exceeds the
        critical value with that probability.
        """
        critical = stats.chi2.isf(SIGNIFICANCE, self.dof)
        return float(np.sqrt(critical / stats.chi2.isf(POWER, self.dof)))
