"""The maximum of a posterior with its Laplace approximation, as a record."""

from dataclasses import dataclass, field

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable


@serializable("modes")
@dataclass(frozen=True, eq=False)
class Modes:
    """The posterior as a mixture of normal distributions, where one does not describe it.

    Attributes
    ----------
    means : ndarray, shape (k, d)
        Of `count` modes, in the order of their masses. Where a frame is so faint that parameters
        between the modes are likely too, one more stands for all that the prior admits.
    covariances : ndarray, shape (k, d, d)
        A mode's is that of its Laplace approximation.
    weights : ndarray, shape (k,)
        Share of the posterior's mass; they sum to 1.
    count : int
        Number of modes.
    complete : bool
        Whether all modes of any weight are among them: a search ends after a hundred aliases.
    """

    means: Floats
    covariances: Floats
    weights: Floats
    count: int
    complete: bool = True

    def __post_init__(self) -> None:
        if not 1 <= self.count <= len(self.weights) or not np.all(self.weights > 0.0):
            raise InputError(
                "modes: got none or without weight, expected one or more: see find_map"
            )

    def assign(self, params: Floats) -> Ints:
        """The component that each parameter vector, shape (n, d), most likely belongs to."""
        logs = []
        for mean, covariance, weight in zip(
            self.means, self.covariances, self.weights, strict=True
        ):
            lower = linalg.cholesky(covariance, lower=True)
            z = linalg.solve_triangular(lower, (params - mean).T, lower=True)
            scale = np.log(weight) - np.log(np.diag(lower)).sum()
            logs.append(scale - 0.5 * (z**2).sum(axis=0))
        return np.asarray(np.argmax(logs, axis=0))


@serializable("map_estimate")
@dataclass(frozen=True, eq=False)
class MapEstimate:
    """The posterior's maximum.

    Attributes
    ----------
    params : ndarray, shape (d,)
        Most probable parameters, in the order of `Posterior.parameter_names`.
    covariance : ndarray, shape (d, d)
        Inverse of Fisher information plus prior curvature there: the Laplace approximation. It
        takes the model as true. Where `fits_data` is False the errors are too small, and are not
        widened here.
    log_prob : float
        Log-posterior density there.
    n_evaluations : int
        Log-posteriors evaluated.
    message : str
        How the search ended and where it began; what to do where it found no maximum, or the
        model does not fit.
    at_maximum : bool
        Whether the gradient vanishes within 1e-3 standard deviations, however well the model fits;
        of parameters at a bound of their prior it may point out of the support.
    fits_data : bool
        Whether deviance and Pearson's statistic there are what the noise makes them, within 5
        standard deviations, and enough sources are matched. It is False where the parameters may
        be wrong although they are: where most sources were rejected, or the catalogue is symmetric
        and another pose of the frame fits as well. `diagnose` tests more.
    modes : Modes or None
        All modes, that of `params` among them, where the posterior has several or has mass
        between them; None where `params` and `covariance` describe it.
    """

    params: Floats
    covariance: Floats
    log_prob: float
    n_evaluations: int
    message: str
    at_maximum: bool = True
    fits_data: bool = True
    modes: Modes | None = field(default=None, metadata={"stored": False})  # see `chainfile`

    @property
    def mixture(self) -> Modes:
        """`modes`; where there are none, the one of `params` and `covariance`."""
        one = Modes(self.params[None], self.covariance[None], np.ones(1), 1)
        return one if self.modes is None else self.modes


def inverse(matrix: Floats) -> Floats:
    """Inverse of a symmetric positive definite matrix whose rows differ in scale."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = linalg.inv(matrix * np.outer(scale, scale))
    return np.asarray(0.5 * (inverse + inverse.T) * np.outer(scale, scale))
