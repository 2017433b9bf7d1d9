"""Errors that are in no likelihood, and are added to those of the parameters.

What a likelihood takes for known moves the parameters theta, if it was another, by I^-1 times the
gradient that it would have at the old maximum, I the information. With G the covariance of such
gradients theta's covariance grows by

    W = I^-1 G I^-1.

With what is not known integrated out, the posterior of theta is the one in which it is fixed,
convolved with a normal distribution of covariance W: to every draw from the one a draw of the other
is added. Parameters that are scales are left as they are.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import SCALES

STREAM = 0x507F  # of random numbers, beside those of a run's steps


@dataclass(frozen=True, eq=False)
class AddedErrors:
    """A covariance that is added to that of the parameters.

    Attributes
    ----------
    names : tuple of str, length d
        Parameters.
    covariance : ndarray, shape (d, d)
        W.

    Raises
    ------
    InputError
        If the shapes differ.
    """

    label: ClassVar[str]  # the field of a posterior that holds them

    names: tuple[str, ...]
    covariance: Floats

    def __post_init__(self) -> None:
        d = len(self.names)
        if self.covariance.shape != (d, d):
            got = self.covariance.shape
            raise InputError(f"{self.label}: got shape {got}, expected ({d}, {d})")

    def require_names(self, names: tuple[str, ...]) -> None:
        """Refuse errors of other parameters than these."""
        if self.names != names:
            raise InputError(
                f"{self.label}: got those of {', '.join(self.names)}, expected those of "
                f"{', '.join(names)}"
            )


def moved_by(names: tuple[str, ...], information: Floats, slopes: Floats) -> Floats:
    """The covariance of the parameters that slopes of the log-posterior stand for.

    Parameters
    ----------
    names : tuple of str, length d
    information : ndarray, shape (d, d)
        I.
    slopes : ndarray, shape (d, d)
        Their covariance, G.

    Returns
    -------
    ndarray, shape (d, d)
        W; 0 of scales.

    Examples
    --------
    >>> moved_by(("f_x", "a.model_error"), np.diag([4.0, 1.0]), np.ones((2, 2))).tolist()
    [[0.0625, 0.0], [0.0, 0.0]]
    """
    moved = np.flatnonzero([not name.endswith(SCALES) for name in names])
    block = information[np.ix_(moved, moved)]
    scale = 1.0 / np.sqrt(np.diag(block))
    factor = linalg.cho_factor(block * np.outer(scale, scale))
    half = scale[:, None] * linalg.cho_solve(factor, np.diag(scale))
    covariance = np.zeros_like(information)
    covariance[np.ix_(moved, moved)] = half @ slopes[np.ix_(moved, moved)] @ half.T
    return covariance


def added_draws(covariance: Floats, n: int, seed: int) -> Floats:
    """Draws of what is added to the parameters; the same number and seed give the same draws.

    Parameters
    ----------
    covariance : ndarray, shape (d, d)
        W.
    n : int
    seed : int

    Returns
    -------
    ndarray, shape (n, d)

    Examples
    --------
    >>> bool(abs(added_draws(np.array([[4.0]]), 10_000, 1).std() - 2.0) < 0.1)
    True
    """
    scale = np.sqrt(np.diag(covariance))
    scale[scale == 0.0] = 1.0
    variances, axes = linalg.eigh(covariance / np.outer(scale, scale))
    half = scale[:, None] * axes * np.sqrt(np.maximum(variances, 0.0))
    random = np.random.default_rng([STREAM, seed])
    return np.asarray(random.standard_normal((n, len(half))) @ half.T)
