"""Proposals for emcee.

`LaplaceMove` proposes from the Laplace approximation, independently of where a walker stands. Where
the posterior is close to Gaussian, as it is for frames with enough photons, nearly every proposal
is accepted and a draw is worth almost an independent one. `ensembles` mixes it with differential
evolution for posteriors that are not.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from emcee.moves import RedBlueMove
from scipy.interpolate import make_interp_spline
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.special import gammaln, logsumexp, ndtr
from scipy.stats import norm, truncnorm

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import SCALES
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate, inverse

HEAVY_SHARE = 0.05
DEGREES_OF_FREEDOM = 5.0

NESTED = 30  # approximations to either side, at most
APART = 4  # of them from one to the next that is not interpolated, at most
SMOOTH = 0.4  # ... and how far they may be apart in log tau for that
NEGLIGIBLE = 7.0  # in log weight below the largest: e^-7 = 1e-3

WIDEST = 2.0  # correction of variances for which the posterior still is about normal
STEP = 2.0  # standard deviations to either side at which a scale's marginal density is taken

NEAR = 6.0  # standard deviations from the mean within which a bound of the prior counts


class LaplaceMove(RedBlueMove):  # type: ignore[misc]
    r"""Independence proposal: the Laplace approximation with a heavy-tailed share.

    With m and C the approximation's mean and covariance and d^2 = (x - m)^T C^-1 (x - m), the
    proposal's density is

        q(x) = (1 - w) N(x | m, C) + w t_nu(x | m, C),

    t_nu the multivariate Student distribution; and since it does not depend on the walker's
    position s, the Hastings factor is q(s) / q(x). Where the posterior is Gaussian the ratio of
    posterior to proposal is at most 1 / (1 - w), so hardly a move is rejected; a Student
    distribution alone, at 10 degrees of freedom in 13 dimensions, would have a quarter of them
    rejected. The share w keeps the ratio bounded where the posterior's tails are heavier than a
    Gaussian's.

    Several approximations make q a mixture of such densities: see `of`.

    Where a prior ends near m, the parameters concerned are drawn one after the other, before the
    others, from what the support leaves of their normal distribution given those before: x = m + L
    z with L lower triangular, and z_i a normal variable cut to an interval that depends on z_1 to
    z_(i-1). That divides the normal density by the product of the intervals' masses.

    Parameters
    ----------
    mean : ndarray, shape (d,) or (k, d)
        m, the posterior's maximum; of k approximations.
    covariance : ndarray, shape (d, d) or (k, d, d)
        C, the Laplace approximation's covariance.
    weights : array_like, shape (k,), optional
        Shares of the approximations; they sum to 1.
    support : tuple of ndarray, shape (d,), optional
        Least and largest values that the prior admits.
    heavy_share : float
        w; 0 leaves the normal distributions alone.

    Raises
    ------
    InputError
        If the covariance is not a positive definite matrix of finite numbers.

    References
    ----------
    L. Tierney (1994), Annals of Statistics 22, 1701, Section 2.3.4 (independence chains). T.
    Hesterberg (1995), Technometrics 37, 185 (defensive mixtures). A. Genz (1992), J. Comp. Graph.
    Stat. 1, 141 (variables cut one after the other).

    Examples
    --------
    >>> move = LaplaceMove(np.zeros(1), np.eye(1))
    >>> q, log_factor = move.get_proposal(np.zeros((3, 1)), [], np.random.RandomState(1))
    >>> q.shape, log_factor.shape
    ((3, 1), (3,))
    """

    def __init__(
        self,
        mean: Floats,
        covariance: Floats,
        weights: npt.ArrayLike = (1.0,),
        support: tuple[npt.ArrayLike, npt.ArrayLike] = (-np.inf, np.inf),
        *,
        heavy_share: float = HEAVY_SHARE,
    ) -> None:
        # the proposal does not come from the ensemble, whatever its size: all walkers move at once
        super().__init__(nsplits=1, randomize_split=False, live_dangerously=True)
        means = np.atleast_2d(mean)
        d = means.shape[1]
        low, high = (np.broadcast_to(bound, d) for bound in support)
        try:
            covariances = np.reshape(covariance, (-1, d, d))
            margin = NEAR * np.sqrt(np.abs(np.diagonal(covariances, axis1=1, axis2=2)))
            near = np.any((means - low < margin) | (high - means < margin), axis=0)
            self.order = np.argsort(~near, kind="stable")  # parameters near a bound first
            self.lowers = np.array(
                [cholesky(c[np.ix_(self.order, self.order)], lower=True) for c in covariances]
            )
        except (LinAlgError, ValueError):
            raise InputError(
                "estimate: got no positive definite covariance, expected the maximum's: see "
                "find_map"
            ) from None
        self.bounds = np.stack([low, high], axis=1)[near]
        self.means = means[:, self.order]
        self.weights = np.asarray(weights, dtype=np.float64)
        self.heavy_share = heavy_share

    @classmethod
    def of(
        cls,
        posterior: TargetDensity,
        estimate: MapEstimate,
        *,
        heavy_share: float = HEAVY_SHARE,
    ) -> "LaplaceMove":
        """The move for a posterior, given its maximum.

        A hyperparameter tau, such as the scatter of the sources' positions, sets the errors of
        other parameters, so that one Gaussian for all its values is a poor approximation. The
        approximation is nested then. Its values tau_k are a geometric series, half an error apart,
        which extends to either side as far as there is weight (the mean lies above the maximum, as
        for any scatter about a fit). Given tau_k the other parameters have their Laplace
        approximation, one Newton step from the estimate. The k-th weight is proportional to the
        posterior there times the root of the determinant of the covariance, in which the variance
        of tau is the squared distance between the tau_k; a quarter of it without a heavy share.

        A scale without a nested approximation, such as the model error, has its mean and variance
        in every part from the marginal density at three of its values: see `_marginal`. Where
        there are scales the posterior may be wider than its information says, in all directions:
        see `_widened`.

        Of a posterior of several modes each mode has such approximations, with its weight.

        Raises
        ------
        InputError
            If the posterior has more than one hyperparameter.

        References
        ----------
        H. Rue, S. Martino & N. Chopin (2009), JRSS B 71, 319, Section 3.
        """
        if len(posterior.hyperparameters) > 1:
            raise InputError(
                f"posterior: got the hyperparameters {', '.join(posterior.hyperparameters)}, "
                "expected at most one: proposals are nested on a single one"
            )
        modes, parts = estimate.mixture, []
        for k, weight in enumerate(modes.weights):
            mean, covariance = modes.means[k], modes.covariances[k]
            errors = getattr(posterior, "psf_errors", None)
            if errors is not None and estimate.modes is None:  # which log_prob has not
                covariance = covariance - errors.covariance
            scales, (low, high) = [], posterior.support
            outside = np.any((mean <= low) | (mean >= high))  # where the paraboloid's top is
            if k < modes.count and (posterior.hyperparameters or not outside):
                scales = [
                    _marginal(posterior, mean, covariance, j)
                    for j, name in enumerate(posterior.parameter_names)
                    if name in SCALES and name not in posterior.hyperparameters
                ]
            if posterior.hyperparameters and k < modes.count:
                # too wide in tau is harmless; without a heavy share it stands for the posterior
                width = 1.0 if heavy_share else 0.5
                means, covariances, weights = _nested(posterior, mean, covariance, scales, width)
            else:
                if scales:
                    mean, covariance, _ = _given(posterior, mean, covariance, scales)
                elif outside:
                    mean = mean + covariance @ posterior.gradient(mean)
                means, covariances, weights = mean[None], covariance[None], np.ones(1)
            parts.append((means, covariances, weight * weights))
        means, covariances, weights = (np.concatenate(each) for each in zip(*parts, strict=True))
        return cls(means, covariances, weights, posterior.support, heavy_share=heavy_share)

    @classmethod
    def fitted(
        cls, posterior: TargetDensity, estimate: MapEstimate, draws: Floats
    ) -> "LaplaceMove":
        """The move with the mean and covariance of draws, shape (n, d), of every mode its own.

        A mode of fewer draws than parameters keeps those of its Laplace approximation.

        Raises
        ------
        InputError
            If the draws spread in too few directions.
        """
        modes, d = estimate.mixture, draws.shape[1]
        means, covariances = modes.means.copy(), modes.covariances.copy()
        own, number = modes.assign(draws), np.ones(len(means))
        for k in range(len(means)):
            some = draws[own == k]
            if len(some) > 2 * d or len(means) == 1:
                means[k], covariances[k] = some.mean(axis=0), np.cov(some.T, ddof=0)
            number[k] += len(some)
        return cls(means, covariances, number / number.sum(), posterior.support)

    def draw(self, n: int, random: np.random.RandomState) -> Floats:
        """n draws from the proposal, shape (n, d)."""
        k = random.choice(len(self.weights), n, p=self.weights)
        z = random.standard_normal((n, self.means.shape[1]))
        stretch = np.sqrt(DEGREES_OF_FREEDOM / random.chisquare(DEGREES_OF_FREEDOM, n))
        heavy = random.random_sample(n) < self.heavy_share
        for i in range(len(self.bounds)):
            a, b = self._interval(i, self.means[k], self.lowers[k, i], z)
            z[:, i] = np.where(heavy, z[:, i], truncnorm.ppf(ndtr(z[:, i]), a, b))
        z *= np.where(heavy, stretch, 1.0)[:, None]
        x = np.empty_like(z)
        for j, (mean, lower) in enumerate(zip(self.means, self.lowers, strict=True)):
            own = k == j
            x[np.ix_(own, self.order)] = mean + np.einsum("ij,nj->ni", lower, z[own])
        return x

    def _interval(self, i: int, means: Floats, row: Floats, z: Floats) -> Floats:
        """The interval of z_i that keeps the i-th of the parameters near a bound in the support.

        It depends on the z before it; both ends, shape (2, n). `row` is the i-th of L.
        """
        given = means[..., i] + np.einsum("...j,...j->...", row[..., :i], z[:, :i])
        return np.asarray((self.bounds[i][:, None] - given) / row[..., i])

    def log_density(self, x: Floats) -> Floats:
        """log q at x, shape (n, d)."""
        d, nu = x.shape[1], DEGREES_OF_FREEDOM
        peak = gammaln(0.5 * (nu + d)) - gammaln(0.5 * nu) - 0.5 * d * np.log(nu * np.pi)
        parts = []
        for mean, lower, weight in zip(self.means, self.lowers, self.weights, strict=True):
            z = solve_triangular(lower, (x[:, self.order] - mean).T, lower=True).T
            squared = (z**2).sum(axis=1)
            normal = np.log1p(-self.heavy_share) - 0.5 * squared - 0.5 * d * np.log(2.0 * np.pi)
            for i in range(len(self.bounds)):
                normal += truncnorm.logpdf(
                    z[:, i], *self._interval(i, mean, lower[i], z)
                ) - norm.logpdf(z[:, i])
            if self.heavy_share:
                student = peak - 0.5 * (nu + d) * np.log1p(squared / nu)
                normal = np.logaddexp(normal, np.log(self.heavy_share) + student)
            parts.append(normal + np.log(weight) - np.log(np.diag(lower)).sum())
        return np.asarray(np.logaddexp.reduce(parts, axis=0))

    def get_proposal(
        self, s: Floats, c: Sequence[Floats], random: np.random.RandomState
    ) -> tuple[Floats, Floats]:
        """New positions for the walkers at s, and log q(s) - log q(new).

        The other walkers c are not used.
        """
        new = self.draw(len(s), random)
        before, after = np.split(self.log_density(np.concatenate([s, new])), 2)
        return new, before - after


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
        _, given, log_prob = _given(posterior, at, covariance, [], j)
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
) -> tuple[Floats, Floats, Floats]:
    """Means, covariances and weights of approximations nested on the hyperparameter.

    See `LaplaceMove.of`; `width` times the distance between its values is its standard deviation.
    """
    j = posterior.parameter_names.index(posterior.hyperparameters[0])
    ratio, (low, high) = 0.5 * np.sqrt(covariance[j, j]) / params[j], posterior.support
    known: dict[int, tuple[Floats, Floats, float]] = {}

    def nest(k: int) -> float:
        at = params.copy()
        at[j] *= np.exp(k * ratio)
        if not low[j] <= at[j] <= high[j]:
            return -np.inf
        mean, given, value = _given(posterior, at, covariance, scales, j)
        given[j, j] = (ratio * mean[j] * width) ** 2
        log = value + 0.5 * float(np.linalg.slogdet(given)[1])
        try:
            lower = cholesky(given, lower=True)
        except (LinAlgError, ValueError):
            return -np.inf
        if np.isfinite(log):
            known[k] = mean, lower, log
        return log

    top, most = nest(0), min(APART, max(1, int(SMOOTH / ratio)))
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
