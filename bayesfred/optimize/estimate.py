"""The maximum of a posterior with its Laplace approximation, as a record."""

from dataclasses import dataclass

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.io.serialize import serializable


@serializable("map_estimate")
@dataclass(frozen=True, eq=False)
class MapEstimate:
    """The posterior's maximum.

    Attributes
    ----------
    params : ndarray, shape (d,)
        Most probable parameters, in the order of `Posterior.parameter_names`.
    covariance : ndarray, shape (d, d)
        Inverse of Fisher information plus prior curvature there: the Laplace approximation.
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
        standard deviations, and enough sources are matched. `diagnose` tests more.
    """

    params: Floats
    covariance: Floats
    log_prob: float
    n_evaluations: int
    message: str
    at_maximum: bool = True
    fits_data: bool = True


def inverse(matrix: Floats) -> Floats:
    """Inverse of a symmetric positive definite matrix whose rows differ in scale."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = linalg.inv(matrix * np.outer(scale, scale))
    return np.asarray(0.5 * (inverse + inverse.T) * np.outer(scale, scale))
