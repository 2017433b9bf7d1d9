"""Whether numbers are uniform on [0, 1]: exact bands for a whole empirical distribution function.

The empirical distribution function of n uniform numbers, times n, is binomial at every z. A band
made of pointwise central intervals, each with tails of at most g/2, holds the whole function with a
probability that is smaller than 1 - g; the counts C_1, C_2, ... at the points z_1 < z_2 < ... are a
Markov chain (given C_i, C_{i+1} - C_i is binomial among the n - C_i numbers left), so that
probability is a sum over the counts inside the band, point after point.

References
----------
T. Saeilynoja, P.-C. Buerkner, A. Vehtari (2022), Statistics and Computing 32, 32, Sections 2 and 3.
"""

from functools import lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaln, xlogy
from scipy.stats import binom

from bayesfred._typing import Floats

__all__ = ["band", "ecdf", "points", "uniformity"]

MOST_POINTS = 100


def points(n: int) -> Floats:
    """Where the distribution function of n numbers is evaluated.

    At most 100 evenly spaced points inside (0, 1).
    """
    number = min(n, MOST_POINTS)
    return np.arange(1, number) / number


def ecdf(values: Floats) -> Floats:
    """Share of the values at or below each of the `points`."""
    return np.searchsorted(np.sort(values), points(values.size), side="right") / values.size


@lru_cache(maxsize=16)
def band(n: int, probability: float = 0.95) -> tuple[Floats, Floats]:
    """The band that holds the whole distribution function of n uniform numbers with a probability.

    Parameters
    ----------
    n : int
        At least 2.
    probability : float
        At least this much: counts are whole numbers.

    Returns
    -------
    low, high : ndarray, dimensionless
        At the `points`.

    Examples
    --------
    >>> low, high = band(1000)
    >>> print((high - low).max().round(3))
    0.094
    """
    least = np.log(1e-12)
    tail = np.exp(
        brentq(lambda log: _inside(n, np.exp(log)) - probability, least, np.log(0.5), xtol=1e-4)
    )
    low, high = _limits(n, float(tail * np.exp(-2e-4)))
    return low / n, high / n


def uniformity(values: Floats) -> float:
    """p-value of uniformity.

    A band that just touches the distribution function of these numbers is left by that of uniform
    numbers with this probability.

    Parameters
    ----------
    values : ndarray, shape (n,), between 0 and 1
        Independent numbers, at least 2.

    Returns
    -------
    float
        Uniform on [0, 1], or larger as counts are whole, for uniform numbers.

    Examples
    --------
    >>> print(uniformity(np.arange(0.5, 100) / 100), f"{uniformity(np.arange(0.5, 100) / 150):.0e}")
    1.0 1e-12
    """
    n, z = values.size, points(values.size)
    counts = np.rint(ecdf(values) * n)
    tail = 2.0 * float(np.min([binom.cdf(counts, n, z), binom.sf(counts - 1, n, z)]))
    return max(1.0 - _inside(n, tail * (1.0 + 1e-9)), 1e-12) if tail < 1.0 else 1.0


def _limits(n: int, tail: float) -> tuple[Floats, Floats]:
    """Least and largest count at every point of which neither tail is as small as `tail`/2."""
    z = points(n)
    return np.asarray(binom.ppf(0.5 * tail, n, z)), np.asarray(binom.isf(0.5 * tail, n, z))


def _inside(n: int, tail: float) -> float:
    """Probability that n uniform numbers stay within the pointwise limits at every point."""
    z = np.append(0.0, points(n))
    low, high = (np.append(0, limit).astype(int) for limit in _limits(n, tail))
    chance = np.ones(1)
    for i in range(1, z.size):
        before, now = (
            np.arange(low[i - 1], high[i - 1] + 1)[:, None],
            np.arange(low[i], high[i] + 1),
        )
        left, added, p = n - before, now - before, (z[i] - z[i - 1]) / (1.0 - z[i - 1])
        possible = (added >= 0) & (added <= left)
        k = np.where(possible, added, 0)
        log = (
            gammaln(left + 1)
            - gammaln(k + 1)
            - gammaln(left - k + 1)
            + xlogy(k, p)
            + xlogy(left - k, 1.0 - p)
        )
        chance = chance @ np.where(possible, np.exp(log), 0.0)
    return float(chance.sum())
