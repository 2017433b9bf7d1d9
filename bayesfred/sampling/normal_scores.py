"""Positive parameters as normal scores z, whose distribution is nearly the standard normal one.

A scale, such as the scatter of a frame's positions, is known to a factor at best where sources are
few. No normal distribution, of it or of its logarithm, is near its posterior. Between knots, which
are quantiles, log s is interpolated linearly in z. Beyond them the tails are a power's and an
exponential one,

    Phi(z) = Phi(z_1) (s / s_1)^a,        Phi(-z) = Phi(-z_n) exp(b (1 - s / s_n)),

with a and b such that the density is continuous at the knots, but a at most 1 where it would be
below 2. That is the power of a density that is finite at s = 0, as where the counts hardly tell a
scale from zero; the upper tail is that of the default priors. So proposals made by normal scores
are nowhere much rarer than the posterior's draws: there walkers would stick. Nor are they far above
them: with the tail of a power, scores of Student's distribution reach scales of many times a
frame's width, whose likelihoods take minutes.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.special import log_ndtr, ndtri, ndtri_exp

from bayesfred._typing import Floats

SHARES = (0.05, 0.15, 0.3, 0.5, 0.7, 0.85, 0.95)  # of the draws below the knots
LEAST = -300.0  # logarithm of a scale
AWAY = 2.0  # a of a scale that is told from zero


class NormalScores(NamedTuple):
    """The normal scores of one parameter.

    Parameters
    ----------
    logs : ndarray, shape (n,)
        Logarithms of the knots, ascending.
    scores : ndarray, shape (n,)
        Their scores.
    low, high : float
        a and b.
    """

    logs: Floats
    scores: Floats
    low: float
    high: float

    @classmethod
    def through(cls, logs: Floats, scores: Floats) -> "NormalScores":
        """Those with these knots."""
        slopes, hazards = np.diff(scores) / np.diff(logs), np.exp(_log_hazard(np.abs(scores)))
        low = hazards[0] * slopes[0]
        return cls(logs, scores, low if low > AWAY else min(low, 1.0), hazards[-1] * slopes[-1])

    @classmethod
    def log_normal(cls, median: float, sd: float) -> "NormalScores":
        """Those of a log-normal distribution with this standard deviation of its logarithm."""
        scores = ndtri(np.array([SHARES[0], SHARES[-1]]))
        return cls.through(np.log(median) + sd * scores, scores)

    @classmethod
    def of_draws(cls, draws: Floats) -> "NormalScores":
        """Those of positive draws, shape (n,)."""
        knots, first = np.unique(np.quantile(draws, SHARES), return_index=True)
        return cls.through(np.log(knots), ndtri(np.array(SHARES))[first])

    def at(self, values: Floats) -> Floats:
        """The scores of values."""
        logs = np.log(values)
        low = log_ndtr(self.scores[0]) + self.low * np.minimum(logs - self.logs[0], 0.0)
        above = np.expm1(np.maximum(logs - self.logs[-1], 0.0))
        high = log_ndtr(-self.scores[-1]) - self.high * above
        z = np.interp(logs, self.logs, self.scores)
        outer = np.where(logs < self.logs[0], ndtri_exp(low), -ndtri_exp(high))
        return np.where((logs < self.logs[0]) | (logs > self.logs[-1]), outer, z)

    def values(self, z: Floats) -> Floats:
        """The values of scores."""
        return np.asarray(np.exp(self._logs(z)))

    def _logs(self, z: Floats) -> Floats:
        first, last = self.scores[0], self.scores[-1]
        low = self.logs[0] + (log_ndtr(z) - log_ndtr(first)) / self.low
        high = self.logs[-1] + np.log1p(self._above(z))
        logs = np.interp(z, self.scores, self.logs)
        return np.where(z < first, np.maximum(low, LEAST), np.where(z > last, high, logs))

    def _above(self, z: Floats) -> Floats:
        """s / s_n - 1 above the last knot."""
        last = self.scores[-1]
        return np.asarray((log_ndtr(-last) - log_ndtr(-np.maximum(z, last))) / self.high)

    def log_slope(self, z: Floats) -> Floats:
        """Logarithm of the derivative of values by scores."""
        widths = np.log(np.diff(self.logs) / np.diff(self.scores))
        between = widths[np.clip(np.searchsorted(self.scores, z) - 1, 0, widths.size - 1)]
        low = _log_hazard(-z) - np.log(self.low)
        high = _log_hazard(z) - np.log(self.high) - np.log1p(self._above(z))
        outer = np.where(z < self.scores[0], low, high)
        inside = (z >= self.scores[0]) & (z <= self.scores[-1])
        return self._logs(z) + np.where(inside, between, outer)


Scores = Mapping[int, NormalScores]  # of some parameters, by their place


def to_scores(x: Floats, scores: Scores) -> Floats:
    """Parameter vectors, shape (n, d), with the scores of those that have some."""
    y = x.copy()
    for k, each in scores.items():
        y[:, k] = each.at(x[:, k])
    return y


def to_values(y: Floats, scores: Scores) -> Floats:
    """The opposite of `to_scores`."""
    x = y.copy()
    for k, each in scores.items():
        x[:, k] = each.values(y[:, k])
    return x


def log_slopes(y: Floats, scores: Scores) -> Floats:
    """Logarithms of the derivatives of values by scores, shape (n, d); 0 where there are none."""
    out = np.zeros(y.shape)
    for k, each in scores.items():
        out[:, k] = each.log_slope(y[:, k])
    return out


def _log_hazard(z: Floats) -> Floats:
    """Logarithm of the standard normal density over what lies above z."""
    return np.asarray(-0.5 * (z * z + np.log(2.0 * np.pi)) - log_ndtr(-z))
