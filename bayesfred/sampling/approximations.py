"""Normal approximations of a posterior: one, or a mixture.

Of every mode there is the normal distribution whose mean is the maximum and whose covariance is the
inverse of the information. What follows is corrected for.

A hyperparameter tau, such as the scatter of the sources' positions, sets the errors of other
parameters, so that one Gaussian for all its values is a poor approximation. The approximation is
nested then. Its values tau_k are a geometric series, half an error apart, which extends to either
side as far as there is weight and the prior goes (the mean lies above the maximum, as for any
scatter about a fit). Given tau_k the other parameters have their Laplace approximation, one Newton
step from the estimate; where tau is known well, those of most tau_k are interpolated between
others. The k-th weight is proportional to the posterior there times the root of the determinant of
the covariance.

A scale without a nested approximation, such as the model error, has its mean and variance in every
part from the marginal density at three of its values. Where there are scales the curvature of the
posterior is not its Fisher information. About what displaces images it is the observed one, see
`model.observed`, and what is left in all directions alike is in `_widened`.

References
----------
H. Rue, S. Martino & N. Chopin (2009), JRSS B 71, 319, Section 3: nested Laplace approximations.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.linalg import LinAlgError, cholesky, eigh, solve_triangular
from scipy.special import logsumexp

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import SCALES
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate, inverse

NESTED = 30  # approximations to either side, at most
APART = 4  # of them from one to the next that is not interpolated, at most
SMOOTH = 0.4  # ... and how far they may be apart in log tau for that
NEGLIGIBLE = 7.0  # in log weight below the largest: e^-7 = 1e-3

WIDEST = 2.0  # correction of variances for which the posterior still is about normal
STEP = 2.0  # standard deviations to either side at which a scale's marginal density is taken


def approximations(
    posterior: TargetDensity, estimate: MapEstimate, *, standing_for_it: bool
) -> tuple[Floats, Floats, Floats]:
    """Approximate a posterior by normal distributions.

    Parameters
    ----------
    posterior : TargetDensity
    estimate : MapEstimate
        Its maximum; of several modes each has its approximations, with its weight.
    standing_for_it : bool
        Whether the approximation stands for the posterior. Then the standard deviation of tau in
        each part is half the distance between the tau_k. It is that distance in a proposal, for
        which too wide is harmless.

    Returns
    -------
    means : ndarray, shape (k, d)
    covariances : ndarray, shape (k, d, d)
    weights : ndarray, shape (k,)

    Raises
    ------
    InputError
        If the posterior has more than one hyperparameter.
    """
    if len(posterior.hyperparameters) > 1:
        raise InputError(
            f"posterior: got the hyperparameters {', '.join(posterior.hyperparameters)}, "
            "expected at most one: proposals are nested on a single one"
        )
    modes, parts = estimate.mixture, []
    for k, weight in enumerate(modes.weights):
        mean, covariance = modes.means[k], modes.covariances[k]
        added = getattr(posterior, "added_covariance", None)
        if added is not None and estimate.modes is None:  # which log_prob has not
            covariance = covariance - added
        scales, (low, high) = [], posterior.support
        outside = np.any((mean <= low) | (mean >= high))  # where the paraboloid's top is
        if k < modes.count and (posterior.hyperparameters or not outside):
            scales = [
                _marginal(posterior, mean, covariance, j)
                for j, name in enumerate(posterior.parameter_names)
                if name in SCALES and name not in posterior.hyperparameters
            ]
        if posterior.hyperparameters and k < modes.count:
            width = 0.5 if standing_for_it else 1.0
            known = _observed(posterior, mean, covariance)
            means, covariances, weights = _nested(posterior, mean, covariance, scales, width, known)
        else:
            if scales:
                known = _observed(posterior, mean, covariance)
                mean, covariance, _ = _given(posterior, mean, covariance, scales, None, known)
            elif outside:
                mean = mean + covariance @ posterior.gradient(mean)
            means, covariances, weights = mean[None], covariance[None], np.ones(1)
        parts.append((means, covariances, weight * weights))
    means, covariances, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
    return means, covariances, weights


class _Scale(NamedTuple):
    """How the marginal density of a parameter differs from that of a normal approximation."""

    parameter: int
    shift: float = 0.0  # of its mean, in standard deviations
    widening: float = 1.0  # of its variance


def _given(
    posterior: TargetDensity,
    params: Floats,
    covariance: Floats,
    scales: list[_Scale],
    j: int | None = None,
    observed: Floats | None = None,
) -> tuple[Floats, Floats, float]:
    """The Laplace approximation of all parameters, or of those but the j-th, given that.

    The scales have the mean and the variance that their marginal densities say. The others are one
    Newton step from `params`, moved with the scales as `covariance` says: as if the density of each
    scale had its maximum at its mean. It is the mean, shape (d,), the covariance, shape (d, d),
    whose row and column j are zero, and the log-density at the mean. Where there is none, as at a
    bound, the mean is where the step begins.
    """
    at, free = params.copy(), np.arange(params.size) != j
    for scale in scales:
        slopes = covariance[:, scale.parameter] * free
        at += scale.shift * slopes / np.sqrt(slopes[scale.parameter])
    found, gradient = np.zeros(covariance.shape), posterior.gradient(at)
    found[np.ix_(free, free)] = inverse(posterior.information(at)[np.ix_(free, free)])
    if observed is not None:
        found = observed @ found @ observed.T
    gradient[[scale.parameter for scale in scales]] = 0.0
    mean = np.clip(at + found @ gradient, *posterior.support)
    value = float(posterior.log_prob(mean))
    if not np.isfinite(value):
        mean, value = at, float(posterior.log_prob(at))
    found = _widened(posterior, mean, found, value)
    for scale in scales:
        slopes = found[:, scale.parameter] / np.sqrt(found[scale.parameter, scale.parameter])
        found += (scale.widening - 1.0) * np.outer(slopes, slopes)
    return mean, found, value


def _observed(posterior: TargetDensity, params: Floats, covariance: Floats) -> Floats | None:
    """What turns the errors by the Fisher information into those by the observed one, (d, d).

    None where it is known of no parameter, or where the two differ by so much that the posterior is
    not normal.
    """
    which, observed = posterior.observed_information(params, covariance)
    block = np.ix_(which, which)
    if not which.size or not np.all(np.isfinite(observed)):
        return None
    root = cholesky(inverse(inverse(covariance)[block]), lower=True)  # the others known
    values, vectors = eigh(root.T @ observed @ root)
    if not np.all((values > WIDEST**-2) & (values < WIDEST**2)):
        return None
    change = root @ (vectors / np.sqrt(values)) @ vectors.T
    out = np.eye(params.size)
    out[block] = solve_triangular(root, change.T, lower=True, trans=1).T
    return out


def _widened(posterior: TargetDensity, mean: Floats, covariance: Floats, value: float) -> Floats:
    """An approximation's covariance, as wide as the posterior is.

    The information is an expectation over data. The curvature of the posterior differs from it
    where the data scatter otherwise than the model says: normal scatter where the model has
    Student's distribution makes it a tenth smaller in all directions. It is measured in one random
    direction, at the distance of typical draws, in which all parameters but scales move.
    """
    location = np.array([name not in SCALES for name in posterior.parameter_names])
    free = np.diag(covariance) > 0.0
    step, moved = np.zeros(mean.size), free & location
    signs = np.random.RandomState(0).choice([-1.0, 1.0], np.count_nonzero(moved))
    try:
        known = inverse(covariance[np.ix_(free, free)])[np.ix_(moved[free], moved[free])]
        step[moved] = solve_triangular(cholesky(known, lower=True), signs, lower=True, trans=1)
    except (LinAlgError, ValueError):  # no covariance, which the move refuses
        return covariance
    ends = posterior.log_prob(np.stack([mean - step, mean + step]))
    ratio = (2.0 * value - float(np.sum(ends))) / signs.size
    if not 1.0 / WIDEST < ratio < WIDEST:
        return covariance
    wider = np.where(location, ratio**-0.5, 1.0)
    return np.asarray(covariance * np.outer(wider, wider))


def _marginal(posterior: TargetDensity, params: Floats, covariance: Floats, j: int) -> _Scale:
    r"""The marginal density of a scale tau, from its values at the estimate and to either side.

    It is proportional to p(x(tau), tau) det(C(tau))^(1/2), x(tau) and C(tau) the mean and the
    covariance of the other parameters given tau. C grows with tau, so that the mean of tau lies
    above the maximum. The Fisher information of tau, of which `covariance` is made, is not minus
    the second derivative where the data scatter otherwise than the model says. The normal density
    through three values has both. Where there is none the approximation is left as it is.
    """
    error = float(np.sqrt(covariance[j, j]))
    step, logs = min(STEP * error, 0.5 * params[j]), []
    for value in (params[j] - step, params[j], params[j] + step):
        at = params.copy()
        at[j] = value
        try:
            _, given, log_prob = _given(posterior, at, covariance, [], j)
        except (LinAlgError, ValueError):  # no density there
            return _Scale(j)
        given[j, j] = 1.0
        logs.append(log_prob + 0.5 * np.linalg.slogdet(given)[1])
    below, top, above = logs
    slope, curvature = 0.5 * (above - below), 2.0 * top - above - below  # times step, step^2
    if not abs(slope) < curvature < np.inf:
        return _Scale(j)
    return _Scale(j, slope / curvature * step / error, (step / error) ** 2 / curvature)


def _nested(
    posterior: TargetDensity,
    params: Floats,
    covariance: Floats,
    scales: list[_Scale],
    width: float,
    observed: Floats | None,
) -> tuple[Floats, Floats, Floats]:
    """Means, covariances and weights of approximations nested on the hyperparameter.

    See `approximations`; `width` times the distance between its values is its standard deviation.
    """
    j = posterior.parameter_names.index(posterior.hyperparameters[0])
    ratio, (low, high) = 0.5 * np.sqrt(covariance[j, j]) / params[j], posterior.support
    known: dict[int, tuple[Floats, Floats, float]] = {}

    def nest(k: int) -> float:
        at = params.copy()
        at[j] *= np.exp(k * ratio)
        if not low[j] <= at[j] <= high[j]:
            return -np.inf
        try:
            mean, given, value = _given(posterior, at, covariance, scales, j, observed)
            given[j, j] = (ratio * mean[j] * width) ** 2
            lower = cholesky(given, lower=True)
        except (LinAlgError, ValueError):  # no density there
            return -np.inf
        log = value + 0.5 * float(np.linalg.slogdet(given)[1])
        if np.isfinite(log):
            known[k] = mean, lower, log
        return log

    top, most = nest(0), max(1, int(min(APART, SMOOTH / ratio)))
    if not known:
        return params[None], covariance[None], np.ones(1)
    for outward in (1, -1):
        k, apart, log = 0, most, top
        while apart and k < NESTED and log > top - NEGLIGIBLE:
            log = nest(outward * (k + apart))
            if np.isfinite(log):
                k += apart
            else:
                apart, log = apart // 2, top
    at = sorted(known)
    every = np.arange(at[0], at[-1] + 1)
    means, lowers, logs = (
        make_interp_spline(at, np.array(values), k=min(3, len(at) - 1))(every)
        for values in zip(*(known[k] for k in at), strict=True)
    )
    means[:, j] = params[j] * np.exp(ratio * every)
    some = logs > logs.max() - NEGLIGIBLE
    covariances = lowers[some] @ lowers[some].transpose(0, 2, 1)
    return means[some], covariances, np.exp(logs[some] - logsumexp(logs[some]))
