"""Proposals for emcee.

`LaplaceMove` proposes from the Laplace approximation, independently of where a walker stands. Where
the posterior is close to Gaussian, as it is for frames with enough photons, nearly every proposal
is accepted and a draw is worth almost an independent one. `ensembles` mixes it with differential
evolution for posteriors that are not.
"""

from collections.abc import Sequence
from types import MappingProxyType

import numpy as np
import numpy.typing as npt
from emcee.moves import RedBlueMove
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.special import gammaln, ndtr
from scipy.stats import norm, truncnorm

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model.parameters import SCALES
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.sampling.approximations import approximations
from bayesfred.sampling.normal_scores import (
    NormalScores,
    Scores,
    log_slopes,
    to_scores,
    to_values,
)

HEAVY_SHARE = 0.05
DEGREES_OF_FREEDOM = 5.0

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

    Where some parameters are scales that set the errors of the others, the posterior is a funnel.
    The distances of the others from m are then multiplied by exp(g (x - m)), g being zero but for
    the scales. Near a bound of the prior they are not.

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
    scores : mapping of int to NormalScores, optional
        Of parameters for whose scores m, C and the support are given.
    funnel : array_like, shape (d,), optional
        g.

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
        scores: Scores = MappingProxyType({}),
        funnel: npt.ArrayLike = 0.0,
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
        self.heavy_share, self.scores = heavy_share, scores
        self.funnel = np.broadcast_to(np.asarray(funnel, np.float64), d)[self.order]
        self.widened = (self.funnel == 0.0) & ~near[self.order]  # by the funnel

    @classmethod
    def of(
        cls,
        posterior: TargetDensity,
        estimate: MapEstimate,
        *,
        heavy_share: float = HEAVY_SHARE,
    ) -> "LaplaceMove":
        """The move for a posterior, given its maximum: see `approximations`.

        Raises
        ------
        InputError
            If the posterior has more than one hyperparameter.
        """
        means, covariances, weights = approximations(
            posterior, estimate, standing_for_it=not heavy_share
        )
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
        columns = [k for k, name in enumerate(posterior.parameter_names) if name in SCALES]
        scores = {k: NormalScores.of_draws(draws[:, k]) for k in columns}
        y, support = to_scores(draws, scores), np.array(posterior.support)
        support[:, columns] = [[-np.inf], [np.inf]]
        means, sds = modes.means.copy(), np.sqrt(np.diagonal(modes.covariances, axis1=1, axis2=2))
        means[:, columns] = np.maximum(means, sds)[:, columns]  # a scale may be at zero
        means = to_scores(means, scores)
        units = np.exp(log_slopes(means, scores))
        covariances = modes.covariances / (units[:, :, None] * units[:, None, :])
        own, number, funnel = modes.assign(draws), np.ones(len(means)), np.zeros(d)
        if 0 < len(columns) < d:
            funnel[columns] = funnel_of(y, columns)
        for k in range(len(means)):
            some = y[own == k]
            if len(some) > 2 * d or len(means) == 1:
                means[k], covariances[k] = moments(some, funnel)
            number[k] += len(some)
        bounds = support[0], support[1]
        weights = number / number.sum()
        return cls(means, covariances, weights, bounds, scores=scores, funnel=funnel)

    def draw(self, n: int, random: np.random.RandomState, heavy: Flags | None = None) -> Floats:
        """n draws from the proposal, shape (n, d); `heavy` ones are from the share with tails.

        By default chance decides which these are.
        """
        k = random.choice(len(self.weights), n, p=self.weights)
        z = random.standard_normal((n, self.means.shape[1]))
        stretch = np.sqrt(DEGREES_OF_FREEDOM / random.chisquare(DEGREES_OF_FREEDOM, n))
        if heavy is None:
            heavy = random.random_sample(n) < self.heavy_share
        for i in range(len(self.bounds)):
            a, b = self._interval(i, self.means[k], self.lowers[k, i], z)
            z[:, i] = np.where(heavy, z[:, i], truncnorm.ppf(ndtr(z[:, i]), a, b))
        z *= np.where(heavy, stretch, 1.0)[:, None]
        x = np.empty_like(z)
        for j, (mean, lower) in enumerate(zip(self.means, self.lowers, strict=True)):
            own, off = k == j, np.einsum("ij,nj->ni", lower, z[k == j])
            off[:, self.widened] *= np.exp(off @ self.funnel)[:, None]
            x[np.ix_(own, self.order)] = mean + off
        return to_values(x, self.scores)

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
        parts, x = [], to_scores(x, self.scores)
        for mean, lower, weight in zip(self.means, self.lowers, self.weights, strict=True):
            off = x[:, self.order] - mean
            wider = off @ self.funnel
            off[:, self.widened] *= np.exp(-wider)[:, None]
            z = solve_triangular(lower, off.T, lower=True).T
            squared = (z**2).sum(axis=1)
            normal = np.log1p(-self.heavy_share) - 0.5 * squared - 0.5 * d * np.log(2.0 * np.pi)
            for i in range(len(self.bounds)):
                normal += truncnorm.logpdf(
                    z[:, i], *self._interval(i, mean, lower[i], z)
                ) - norm.logpdf(z[:, i])
            if self.heavy_share:
                student = peak - 0.5 * (nu + d) * np.log1p(squared / nu)
                normal = np.logaddexp(normal, np.log(self.heavy_share) + student)
            normal -= np.log(np.diag(lower)).sum() + self.widened.sum() * wider
            parts.append(normal + np.log(weight))
        slopes = log_slopes(x, self.scores).sum(axis=1)
        return np.asarray(np.logaddexp.reduce(parts, axis=0) - slopes)

    def get_proposal(
        self, s: Floats, c: Sequence[Floats], random: np.random.RandomState
    ) -> tuple[Floats, Floats]:
        """New positions for the walkers at s, and log q(s) - log q(new).

        The other walkers c are not used.
        """
        new = self.draw(len(s), random)
        before, after = np.split(self.log_density(np.concatenate([s, new])), 2)
        return new, before - after


def funnel_of(draws: Floats, scales: Sequence[int]) -> Floats:
    """How scales widen the other parameters: see `LaplaceMove`.

    Parameters
    ----------
    draws : ndarray, shape (n, d)
    scales : sequence of int
        Columns of the scales.

    Returns
    -------
    ndarray, shape (scales,)
        By how much the logarithm of the others' distance from their mean grows with each.

    Raises
    ------
    InputError
        If the draws spread in too few directions.
    """
    of = np.column_stack([np.ones(len(draws)), draws[:, scales] - draws[:, scales].mean(axis=0)])
    others = np.delete(draws, scales, axis=1)
    left = others - of @ np.linalg.lstsq(of, others)[0]
    try:
        lower = cholesky(np.atleast_2d(np.cov(left.T, ddof=0)), lower=True)
    except LinAlgError:
        raise InputError("draws: got too few, expected them to spread in all directions") from None
    z = solve_triangular(lower, left.T, lower=True)
    return np.asarray(np.linalg.lstsq(of, 0.5 * np.log((z**2).mean(axis=0)))[0][1:])


def moments(draws: Floats, funnel: Floats) -> tuple[Floats, Floats]:
    """Mean and covariance of draws, shape (n, d), without what the funnel widens."""
    mean = draws.mean(axis=0)
    off = draws - mean
    off[:, funnel == 0.0] *= np.exp(-off @ funnel)[:, None]
    return mean, np.cov(off.T, ddof=0)
