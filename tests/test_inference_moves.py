"""LaplaceMove against scipy's densities and, in emcee, on targets whose moments are known.

Walkers start from exact draws of the target, so a kernel that leaves the target alone keeps its moments at every step
and a wrong one drifts off. The Monte Carlo error of a moment comes from the scatter between walkers' time averages:
differential evolution makes them depend on each other, by one pair of 256 a step, which is far below what is tested.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import emcee
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from test_inference import LIMIT

from bayesfred.inference.ensembles import DE_SHARE
from bayesfred.inference.moves import DEGREES_OF_FREEDOM, HEAVY_SHARE, LaplaceMove

Floats = NDArray[np.float64]

WALKERS = 512
STEPS = 60


def correlated(d: int, rng: np.random.Generator, decades: int = 6) -> Floats:
    """A correlated covariance whose scales span some decades up to 1."""
    a = rng.standard_normal((d, 2 * d))
    scale = 10.0 ** np.linspace(-decades, 0, d)
    return np.asarray(a @ a.T / (2 * d) * np.outer(scale, scale))


# --- the proposal itself ----------------------------------------------------------------------------------


def proposal_density(move: LaplaceMove, covariance: Floats, x: Floats) -> Floats:
    normal = stats.multivariate_normal(move.mean, covariance).logpdf(x)
    student = stats.multivariate_t(move.mean, covariance, DEGREES_OF_FREEDOM).logpdf(x)
    return np.asarray(np.logaddexp(np.log1p(-HEAVY_SHARE) + normal, np.log(HEAVY_SHARE) + student))


@pytest.mark.parametrize("d", [1, 2, 5, 13])
def test_hastings_factor_is_the_ratio_of_densities(d: int) -> None:
    rng = np.random.default_rng(d)
    covariance = correlated(d, rng, decades=1)
    move = LaplaceMove(rng.standard_normal(d), covariance)
    old = move.mean + 3.0 * (np.linalg.cholesky(covariance) @ rng.standard_normal((d, 40))).T
    new, factor = move.get_proposal(old, [], np.random.RandomState(2))
    assert new.shape == (40, d)
    expected = np.ravel(proposal_density(move, covariance, old) - proposal_density(move, covariance, new))
    assert factor == pytest.approx(expected, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("d", [1, 5, 13])
def test_draws_follow_the_density(d: int) -> None:
    # under draws from q the mean of p(x) / q(x) is 1 for any density p, here both parts of q and a narrower Gaussian
    covariance = correlated(d, np.random.default_rng(d))
    lower = np.linalg.cholesky(covariance)
    move = LaplaceMove(np.arange(d) + 1.0, covariance)
    x = move.draw(200_000, np.random.RandomState(3))
    z = np.linalg.solve(lower, (x - move.mean).T).T
    log_q = move.log_density(x)  # leaves the determinant out: the density of z
    log_p = [
        stats.norm.logpdf(z).sum(axis=1),
        np.ravel(stats.multivariate_t(np.zeros(d), np.eye(d), DEGREES_OF_FREEDOM).logpdf(z)),
        stats.norm.logpdf(z, scale=0.8).sum(axis=1),
    ]
    for values in log_p:
        weight = np.exp(values - log_q)
        assert abs(weight.mean() - 1) < LIMIT * weight.std() / np.sqrt(weight.size)


# --- targets ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Target:
    """A distribution, its exact first and second moments about zero, and a proposal that does not fit it well."""

    log_prob: Callable[[Floats], Floats]
    draw: Callable[[np.random.Generator, int], Floats]
    first: Floats
    second: Floats
    mean: Floats
    covariance: Floats


def gaussian(d: int) -> Target:
    covariance = correlated(d, np.random.default_rng(100 + d))
    lower = np.linalg.cholesky(covariance)
    scale = np.sqrt(np.diag(covariance))

    def log_prob(x: Floats) -> Floats:
        return np.asarray(-0.5 * np.sum(np.linalg.solve(lower, x.T) ** 2, axis=0))

    def draw(rng: np.random.Generator, n: int) -> Floats:
        return np.asarray(rng.standard_normal((n, d)) @ lower.T)

    # off by a third of an error and 1.2 times too wide along every axis
    return Target(log_prob, draw, np.zeros(d), scale**2, 0.3 * scale / np.sqrt(d), 1.44 * covariance)


def independent(distribution: Any, d: int, mean: float, variance: float) -> Target:
    first, second = (np.full(d, distribution.moment(k)) for k in (1, 2))

    def log_prob(x: Floats) -> Floats:
        return np.asarray(distribution.logpdf(x).sum(axis=1))

    def draw(rng: np.random.Generator, n: int) -> Floats:
        return np.asarray(distribution.rvs((n, d), random_state=rng))

    return Target(log_prob, draw, first, second, np.full(d, mean), variance * np.eye(d))


TARGETS = {
    "gaussian 1": gaussian(1),
    "gaussian 2": gaussian(2),
    "gaussian 5": gaussian(5),
    "gaussian 13": gaussian(13),
    "cut gaussian": independent(stats.truncnorm(-0.5, np.inf), 2, 0.0, 1.0),
    "gamma": independent(stats.gamma(3.0), 2, 2.0, 2.0),  # the mode and the curvature there
}


class WithoutHastings(LaplaceMove):
    """The deliberately wrong sampler."""

    def get_proposal(self, s: Any, c: Any, random: Any) -> tuple[Any, Any]:
        new, factor = super().get_proposal(s, c, random)
        return new, np.zeros_like(factor)


def worst_moment(target: Target, moves: Any, seed: int) -> tuple[float, float]:
    """Largest deviation of a first or second moment in Monte Carlo errors, and the share of moves accepted."""
    coords = target.draw(np.random.default_rng(seed), WALKERS)
    sampler = emcee.EnsembleSampler(*coords.shape, target.log_prob, moves=moves, vectorize=True)
    state = emcee.State(coords, random_state=np.random.RandomState(seed + 1).get_state())
    sampler.run_mcmc(state, STEPS, skip_initial_state_check=True)
    chain = sampler.get_chain()
    z = []
    for power, exact in ((1, target.first), (2, target.second)):
        averages = np.mean(chain**power, axis=0)  # of every walker, over time
        z.append((averages.mean(axis=0) - exact) / (averages.std(axis=0) / np.sqrt(WALKERS)))
    return float(np.abs(z).max()), float(np.mean(sampler.acceptance_fraction))


@pytest.mark.parametrize("mixed", [False, True], ids=["alone", "mixed"])
@pytest.mark.parametrize("name", TARGETS)
def test_known_targets_are_sampled(name: str, mixed: bool) -> None:
    target = TARGETS[name]
    move = LaplaceMove(target.mean, target.covariance)
    moves = [(move, 1.0 - DE_SHARE), (emcee.moves.DEMove(live_dangerously=True), DE_SHARE)] if mixed else move
    worst, accepted = worst_moment(target, moves, seed=41)
    assert worst < LIMIT and 0.1 < accepted < 1.0


@pytest.mark.parametrize("name", TARGETS)
def test_a_missing_hastings_factor_is_noticed(name: str) -> None:
    target = TARGETS[name]
    assert worst_moment(target, WithoutHastings(target.mean, 2.0 * target.covariance), seed=41)[0] > LIMIT


def test_a_fitting_proposal_is_nearly_always_accepted() -> None:
    target = TARGETS["gaussian 13"]
    fitting = LaplaceMove(np.zeros(13), target.covariance / 1.44)
    # the ratio of target to proposal is at most 1 / (1 - w)
    assert worst_moment(target, fitting, seed=42)[1] > 1.0 - HEAVY_SHARE
