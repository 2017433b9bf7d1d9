"""A ranking of models of frames by how well they predict sources that were left out: the record.

`bayesfred.analysis.comparison` makes it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.extra_parameters import ExtraParameters

__all__ = ["Comparison", "Score", "error_of_sum"]


@dataclass(frozen=True)
class Score:
    """How well one model predicts sources that it has not seen.

    Attributes
    ----------
    name : str
    n_parameters : int
        Free numbers: parameters, every source's flux and shifts where these are free, and what
        the counts determine of a PSF that was measured on the frame.
    elpd, elpd_se : float
        Expected log predictive density of the frame, leaving out one fold of the sources at a
        time, and its standard error.
    difference, difference_se : float
        The best model's elpd less this one's, and its standard error from the folds' differences;
        0 for the best.
    weight : float
        In the mixture of models that predicts the folds best (stacking).
    log_evidence, evidence_error : float
        Logarithm of the evidence, with the standard deviation of its Monte Carlo error; nan where
        a PSF was measured on the frame.
    pareto_k : float
        Largest shape of the weights of a fold's evidence; -inf where none has a tail, inf where
        a few draws have all the weight of one.
    n_unreliable : int
        Folds whose shape exceeds 1 - 1 / log10(200): their part of elpd is not to be trusted.
    by_fold : ndarray, shape (K,)
        The parts of elpd.
    explained, explained_se : float
        Where a PSF was measured on the frame: the share of what the worst model leaves, beyond the
        noise, of sources that were left out, that this one does not leave, and its standard error
        from the folds. 0 for the worst; nan where it leaves nothing to be explained.
    """

    name: str
    n_parameters: int
    elpd: float
    elpd_se: float
    difference: float
    difference_se: float
    weight: float
    log_evidence: float
    evidence_error: float
    pareto_k: float
    n_unreliable: int
    by_fold: Floats = field(repr=False, compare=False)
    explained: float = math.nan
    explained_se: float = math.nan


@dataclass(frozen=True)
class Comparison:
    """Models of the same frame or frames, ranked by predictive accuracy.

    Attributes
    ----------
    scores : tuple of Score
        The best model first.
    chosen : str
        The model with the fewest parameters among those that predict as well as the best: whose
        elpd is less than 4, or less than twice the difference's standard error, below the best
        one's. Of few folds K it is not twice, but the quantile of Student's distribution.
    folds : tuple of tuple of int or str
        The sources of each fold, as numbered in the catalogue from 0; of several frames with the
        frame's name, such as `a.3`.
    extra : mapping of (str, str) to ExtraParameters
        By the names of a leaner and a larger model that contains it, whether the parameters that
        only the larger one has are real.
    """

    scores: tuple[Score, ...]
    chosen: str
    folds: tuple[tuple[int | str, ...], ...]
    extra: Mapping[tuple[str, str], ExtraParameters]

    @property
    def reliable(self) -> bool:
        """Whether every fold's evidence can be trusted."""
        return not any(score.n_unreliable for score in self.scores)

    @property
    def sentences(self) -> tuple[str, ...]:
        """What was chosen, which parameters are real, and which sources decide."""
        return (
            f"chosen: {self.chosen}, the one with the fewest parameters that predicts sources as "
            "well as the best",
            *(self._extra_said(*pair) for pair in self.extra if self.chosen in pair),
            *(self._explained_said(score) for score in self.scores if score.explained_se > 0.0),
            self._decisive(),
        )

    def _extra_said(self, leaner: str, larger: str) -> str:
        found = self.extra[leaner, larger]
        gain, error = difference(self._score(larger), self._score(leaner))
        doubt = ", but uncertain to predict better" if self.chosen == leaner else ""
        what = f"real{doubt}" if found.real else "not seen"
        return (
            f"{larger} beside {leaner}: what it adds is {what} ({found}); gain in prediction "
            f"{gain:.1f} +- {error:.1f}"
        )

    def _explained_said(self, score: Score) -> str:
        worst = next(each for each in self.scores if each.explained == 0.0)
        return (
            f"{score.name}: explains {score.explained:.0%} +- {score.explained_se:.0%} of what "
            f"{worst.name} leaves, beyond the noise, of sources that are left out"
        )

    def _decisive(self) -> str:
        best, second = self.scores[:2]
        gain = best.by_fold - second.by_fold
        first = np.argsort(-np.abs(gain), kind="stable")[:3]
        parts = (f"{', '.join(map(str, self.folds[k]))} ({gain[k]:+.1f})" for k in first)
        return f"sources that decide most between the first two: {'; '.join(parts)}"

    def _score(self, name: str) -> Score:
        return next(score for score in self.scores if score.name == name)


def error_of_sum(values: Floats) -> float:
    """Standard error of the sum of independent values, from their scatter."""
    return float(np.sqrt(values.size * np.var(values, ddof=1)))


def difference(one: Score, other: Score) -> tuple[float, float]:
    gain = one.by_fold - other.by_fold
    return float(gain.sum()), error_of_sum(gain)
