"""The likelihood of a frame as it is near one parameter vector, see `kernels/mean_series`.

There the mean of a pixel varies by s, the standard deviation that the parameters give it. A draw at
a distance of z standard deviations in whitened parameters moves no mean by more than z s, to first
order. The distance of draws in d dimensions is about sqrt(d).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.model.kernels.contexts import Problem
from bayesfred.model.kernels.expansion_of_mean import expand

FARTHER = 5.0  # standard deviations beyond sqrt(d) up to which the polynomials serve


class Around(NamedTuple):
    """Where a posterior is evaluated often."""

    params: Floats  # (d,)
    covariance: Floats  # (d, d)


def whitening(covariance: Floats) -> Floats | None:
    """Cholesky's factor of a covariance; None if there is none."""
    try:
        return np.asarray(linalg.cholesky(covariance, lower=True))
    except (ValueError, linalg.LinAlgError):
        return None


def problem_near(problem: Problem, mean_at: Callable[[Floats], Floats], around: Around) -> Problem:
    """The problem with polynomials for log p about the mean at `around.params`.

    It is the same where the mean is not finite there. Along whitened axes on which it is not, the
    mean is taken as constant.
    """
    frame = problem.frame
    axes, mean = whitening(around.covariance), mean_at(around.params)
    if axes is None or not np.isfinite(mean).all():
        return problem
    variance = np.zeros(mean.shape)
    for axis in axes.T:
        variance += np.square(np.nan_to_num(mean_at(around.params + axis) - mean))
    change = np.zeros((frame.ny, frame.values.size // frame.ny))
    about = np.ones_like(change)
    change[:, : frame.nx] = (math.sqrt(len(axes)) + FARTHER) * np.sqrt(variance)
    about[:, : frame.nx] = mean
    near = expand(frame.noise, frame.values, about.ravel(), change.ravel())
    return problem._replace(frame=frame._replace(noise=frame.noise._replace(near=near)))
