"""Whether the parameters that a larger model has and a leaner one lacks are real.

In the leaner model they have a fixed value, zero for terms of a distortion. With the difference d
of their p values at the maximum from that one, and their covariance C there, d^T C^-1 d is a
chi-square variable if the model is true and they are not real. It is not if the sources lie off
their catalogue positions, or the PSF is wrong: such errors are common to all pixels of a source,
and C does not know of them. But fits without each of K folds of the sources do. With the gradient
g_k of a fold's log-likelihood at the maximum, C g_k is the fold's influence on the estimates, and
d_k is by how much they change when the fold is left out. A fit follows each fold by its leverage h,
so that residuals, and with them the influences, are too small by (1 - h); the changes are not, for
they are influences divided by (1 - h). Where all sources have errors of one size, which widen C by
a factor r, the mean of the products is therefore exact,

    r = sum_k (C g_k)^T C^-1 d_k / p,

and d^T C^-1 d / (p r) is compared with the F distribution of p and p (K - 1) degrees of freedom.

Such a parameter may be real and yet too small to be of use: it improves predictions by half its
square in standard deviations, less what its own error costs, and that is soon less than the
scatter of the prediction.

References
----------
J. G. MacKinnon, H. White (1985), Journal of Econometrics 29, 305: leverage in errors of a maximum
where the model is wrong.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.analysis.joint_folds import AnyPosterior, are_scales, columns_of
from bayesfred.model.joint import JointPosterior
from bayesfred.optimize.estimate import inverse

__all__ = ["REAL", "ExtraParameters", "contained", "judge_extra"]

SAME = 1e-3  # in log-likelihood
REAL = 0.01  # probability by chance below which parameters are called real


@dataclass(frozen=True)
class ExtraParameters:
    """What a larger model's estimates say of the parameters that a leaner one lacks.

    Attributes
    ----------
    names : tuple of str
    chi2 : float
        Of their differences from the leaner model's values, by the posterior's errors.
    widening : float
        Errors from leaving out sources over the posterior's errors.
    p : float
        Probability of such a chi-square, for errors that are wider by that factor, if the
        parameters are not real.
    """

    names: tuple[str, ...]
    chi2: float
    widening: float
    p: float

    @property
    def real(self) -> bool:
        """Whether chance explains them with a probability below 0.01 only."""
        return self.p < REAL

    def __str__(self) -> str:
        """Size and probability, in words."""
        size = (
            f"{self.names[0]} {math.sqrt(self.chi2):.1f} sd from the leaner model's value"
            if len(self.names) == 1
            else f"{len(self.names)} parameters with chi-square {self.chi2:.1f}"
        )
        return (
            f"{size}; p = {self.p:.2g} by the scatter of sources, which makes errors "
            f"{self.widening:.1f} times the posterior's"
        )


def judge_extra(
    names: tuple[str, ...],
    difference: Floats,
    covariance: Floats,
    influence: Floats,
    change: Floats,
) -> ExtraParameters:
    """Judge whether p parameters differ from a leaner model's values.

    Parameters
    ----------
    names : tuple of str, length p
    difference : ndarray, shape (p,), parameter units
        Their estimates from all sources, less those values.
    covariance : ndarray, shape (p, p)
        Of the estimates, from the posterior.
    influence : ndarray, shape (K, p), parameter units
        Of each fold of the sources: covariance times the gradient of its log-likelihood.
    change : ndarray, shape (K, p), parameter units
        Estimates from all sources less those without each fold.

    Returns
    -------
    ExtraParameters

    Examples
    --------
    >>> change = np.array([[-0.6], [-0.1], [0.7]])
    >>> judged = judge_extra(("f_x",), np.array([9.0]), np.eye(1), 0.9 * change, change)
    >>> print(f"{judged.chi2:.0f}, {judged.widening:.2f}, {judged.p:.4f}, {judged.real}")
    81, 0.88, 0.0094, True
    """
    inverted, size = inverse(covariance), difference.size
    chi2 = float(difference @ inverted @ difference)
    products = np.einsum("ki,ij,kj->k", influence, inverted, change)
    ratio = float(np.sum(np.abs(products))) / size  # those below zero are small
    p = float(stats.f.sf(chi2 / (size * ratio), size, size * (len(change) - 1)))
    return ExtraParameters(names, chi2, math.sqrt(ratio), p)


def contained(leaner: AnyPosterior, params: Floats, larger: AnyPosterior) -> Floats | None:
    """The larger model's parameters at which it is the leaner one.

    Parameters
    ----------
    leaner : Posterior or JointPosterior
    params : ndarray, shape (d,), parameter units
        Its parameters.
    larger : Posterior or JointPosterior
        Of the same frame or frames.

    Returns
    -------
    ndarray, shape (D,), parameter units, or None
        None where the larger model does not contain the leaner one, or adds a hyperparameter, whose
        value in the leaner model is a bound.
    """
    added = set(larger.parameter_names) - set(leaner.parameter_names)
    scales = columns_of(larger, are_scales)
    if not added or added & set(np.array(larger.parameter_names)[scales].tolist()):
        return None
    if set(leaner.parameter_names) - set(larger.parameter_names):
        return None
    known = dict(zip(leaner.parameter_names, params, strict=True))
    values = np.array([known.get(p.name, p.neutral) for p in larger.parameters])
    one, other = (_log_likelihood(model, at) for model, at in ((leaner, params), (larger, values)))
    return values if abs(one - other) < SAME else None


def _log_likelihood(posterior: AnyPosterior, params: Floats) -> float:
    if isinstance(posterior, JointPosterior):
        return float(posterior.log_prob(params) - posterior.log_prior(params)[0])
    return float(posterior.likelihood.log_likelihood(params[None], np.ones(1, bool))[0])
