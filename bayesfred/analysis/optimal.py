r"""Which few of many contributions to an information tell most: greedy choice and exchange.

The information of a choice is a sum, M = P + sum of n_s E_s: P is that of the prior, E_s that of a
source or a frame, which is chosen n_s times. Two criteria judge it. With the covariance C = M^-1,

    D:  the determinant of M's block of the coefficients, all others eliminated: det M / det M_NN,
        with N the others. Its root is one over the volume of the coefficients' error ellipsoid;
    G:  the largest variance of the displacement over the field: at a point with the derivatives J
        of the displacement, half the trace of J C J^T.

E_s = V V^T has few columns, because a source tells of few directions. So with T = C V and the small
matrix S = 1 + V^T T adding E_s multiplies det M by det S (and det M_NN likewise), and makes the
covariance C - T S^-1 T^T. That judges all candidates without another inverse.

Greedy choice adds the best candidate again and again. Exchange then replaces each member of a
choice in turn by the best candidate, until a whole round changes nothing. It ends in a choice that
no replacement of one member improves, which need not be the best one. For G it often is not, so
exchange begins several times: with the greedy choice of either criterion, and at random as long as
that takes little time.

References
----------
V. V. Fedorov (1972), Theory of Optimal Experiments; R. D. Cook & C. J. Nachtsheim (1980),
Technometrics 22, 315: exchange of every member in turn.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice
from typing import Literal, NamedTuple, Self, get_args

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.optimize.estimate import inverse

__all__ = ["Criterion", "Field", "Information", "exchange", "greedy", "search"]

Criterion = Literal["D", "G"]

FLOOR = 1e-12
NEGLIGIBLE = 1e-9  # share of a contribution's largest eigenvalue
BETTER = 1e-9  # by which a logarithm has to grow for an exchange
ROUNDS = 50
STARTS = 6  # at random, fewer if members times candidates times starts were more than `WORK`
WORK = 20_000


class Field(NamedTuple):
    """The points over which an error of the displacement is taken.

    Attributes
    ----------
    derivatives : ndarray, shape (p, 2, d), pixel
        Of the displacement with respect to the parameters.
    weights : ndarray, shape (p,)
        Of the points in the average.
    """

    derivatives: Floats
    weights: Floats

    def variance(self, covariance: Floats) -> Floats:
        """Mean of the two variances of the displacement at every point, shape (p,), pixel^2."""
        flat = self.derivatives.reshape(-1, len(covariance))
        return np.asarray(0.5 * np.sum((flat @ covariance) * flat, axis=1).reshape(-1, 2).sum(1))

    def errors(self, covariance: Floats) -> tuple[float, float]:
        """Root mean square and largest error of the displacement, pixel."""
        variance = self.variance(covariance)
        return math.sqrt(np.average(variance, weights=self.weights)), math.sqrt(variance.max())


@dataclass(frozen=True, eq=False)
class Information:
    """What there is to choose from, and how a choice is judged.

    Attributes
    ----------
    base : ndarray, shape (d, d)
        Information without any choice.
    parts : ndarray, shape (n, d, d)
        What each candidate adds; positive semidefinite.
    wanted : ndarray of int, shape (m,)
        The coefficients among the parameters.
    field : Field
    criterion : {"D", "G"}
    """

    base: Floats
    parts: Floats
    wanted: Ints
    field: Field
    criterion: Criterion

    @classmethod
    def scaled(
        cls, base: Floats, parts: Floats, wanted: Ints, field: Field, criterion: Criterion
    ) -> Self:
        """The same in units in which all candidates together tell 1 of every parameter.

        There every parameter is given a negligible information of its own, so that a choice of few
        has a covariance where the prior is flat.
        """
        scale = 1.0 / np.sqrt(np.diag(base + parts.sum(axis=0)))
        both = np.outer(scale, scale)
        field = field._replace(derivatives=field.derivatives * scale)
        floor = FLOOR * np.eye(len(base))
        return cls(base * both + floor, parts * both, wanted, field, criterion)

    def of(self, numbers: Ints | Floats) -> Floats:
        """The information, shape (d, d), if candidates are chosen this many times, shape (n,)."""
        return np.asarray(self.base + np.tensordot(numbers, self.parts, 1))

    def errors(self, information: Floats) -> tuple[float, float]:
        """Root mean square and largest error of the displacement over the field, pixel."""
        return self.field.errors(inverse(information))

    def value(self, information: Floats) -> float:
        """The criterion: a logarithm, the larger the better."""
        covariance = inverse(information)
        if self.criterion == "G":
            return -math.log(self.field.variance(covariance).max())
        return float(-np.linalg.slogdet(covariance[np.ix_(self.wanted, self.wanted)])[1])

    def values(self, information: Floats) -> Floats:
        """The criterion with each candidate added, shape (n,): a logarithm, the larger the better.

        That of D lacks a constant, which is the same for all candidates.
        """
        covariance, v = inverse(information), self._factors
        t = covariance @ v
        small = np.eye(v.shape[2]) + v.swapaxes(1, 2) @ t
        if self.criterion == "D":
            others, out = self._others, np.linalg.slogdet(small)[1]
            if others.size:
                v = v[:, others]
                t = inverse(information[np.ix_(others, others)]) @ v
                out = out - np.linalg.slogdet(np.eye(v.shape[2]) + v.swapaxes(1, 2) @ t)[1]
            return np.asarray(out)
        root = np.linalg.inv(np.linalg.cholesky(small)).swapaxes(1, 2)
        n, d, rank = t.shape
        flat = (t @ root).transpose(1, 0, 2).reshape(d, n * rank)
        gained = (self.field.derivatives.reshape(-1, d) @ flat) ** 2
        gained = 0.5 * gained.reshape(-1, 2, n, rank).sum(axis=(1, 3))
        left = self.field.variance(covariance)[:, None] - gained
        return np.asarray(-np.log(np.maximum(left.max(axis=0), np.finfo(float).tiny)))

    @cached_property
    def _others(self) -> Ints:
        return np.setdiff1d(np.arange(len(self.base)), self.wanted)

    @cached_property
    def _factors(self) -> Floats:
        """V of every candidate, shape (n, d, rank)."""
        values, vectors = np.linalg.eigh(self.parts)
        values = np.where(values > NEGLIGIBLE * values[:, -1:], values, 0.0)
        rank = max(1, int(np.count_nonzero(values, axis=1).max()))
        return np.asarray((vectors * np.sqrt(values)[:, None, :])[:, :, -rank:])


def greedy(information: Information, *, repeats: bool = False) -> Iterator[tuple[int, Floats]]:
    """Choose the best candidate, then the best beside it, and so on.

    Parameters
    ----------
    information : Information
    repeats : bool
        Whether a candidate may be chosen again; the choice has no end then.

    Yields
    ------
    chosen : int
        The candidate.
    total : ndarray, shape (d, d)
        Information of all that are chosen so far.

    Examples
    --------
    >>> known = Information(
    ...     np.eye(1), np.array([[[1.0]], [[9.0]], [[4.0]]]), np.array([0]),
    ...     Field(np.ones((1, 2, 1)), np.ones(1)), "D")
    >>> [(chosen, float(total[0, 0])) for chosen, total in greedy(known)]
    [(1, 10.0), (2, 14.0), (0, 15.0)]
    """
    total, free = information.base, np.ones(len(information.parts), dtype=bool)
    while free.any():
        values = np.where(free, information.values(total), -np.inf)
        best = int(np.argmax(values))
        free[best] = repeats
        total = total + information.parts[best]
        yield best, total


def exchange(information: Information, numbers: Ints, *, repeats: bool = False) -> Ints:
    """Replace the members of a choice in turn until no replacement of one improves it.

    Parameters
    ----------
    information : Information
    numbers : ndarray of int, shape (n,)
        How many times each candidate is chosen.
    repeats : bool
        Whether a candidate may be chosen more than once.

    Returns
    -------
    ndarray of int, shape (n,)

    Examples
    --------
    >>> known = Information(
    ...     np.eye(1), np.array([[[1.0]], [[9.0]], [[4.0]]]), np.array([0]),
    ...     Field(np.ones((1, 2, 1)), np.ones(1)), "D")
    >>> exchange(known, np.array([1, 0, 0])).tolist()
    [0, 1, 0]
    """
    numbers = np.array(numbers)
    for _ in range(ROUNDS):
        before = numbers.copy()
        for member in np.flatnonzero(before):
            numbers[member] -= 1
            values = information.values(information.of(numbers))
            allowed = (numbers == 0) | repeats
            best = int(np.argmax(np.where(allowed, values, -np.inf)))
            better = values[best] > values[member] + BETTER
            numbers[best if better else member] += 1
        if np.array_equal(numbers, before):
            break
    return numbers


def search(information: Information, number: int, *, repeats: bool = False) -> Ints:
    """The best of the choices in which exchange ends from several starts.

    Parameters
    ----------
    information : Information
    number : int
        How many to choose.
    repeats : bool
        Whether a candidate may be chosen more than once.

    Returns
    -------
    ndarray of int, shape (n,)
        How many times each candidate is chosen.

    Examples
    --------
    >>> known = Information(
    ...     np.eye(1), np.array([[[1.0]], [[9.0]], [[4.0]]]), np.array([0]),
    ...     Field(np.ones((1, 2, 1)), np.ones(1)), "G")
    >>> search(known, 2).tolist()
    [0, 1, 1]
    """
    n, rng = len(information.parts), np.random.default_rng(0)
    starts = [
        [chosen for chosen, _ in islice(greedy(each, repeats=repeats), number)]
        for each in (replace(information, criterion=c) for c in get_args(Criterion))
    ]
    for _ in range(min(STARTS, WORK // (n * number))):
        starts.append(rng.choice(n, number, replace=repeats).tolist())
    ends = [exchange(information, np.bincount(s, minlength=n), repeats=repeats) for s in starts]
    return max(ends, key=lambda numbers: information.value(information.of(numbers)))
