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
from scipy import special, stats
from test_inference import LIMIT

from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.imaging.scene import SourceCatalog
from bayesfred.inference.ensembles import DE_SHARE
from bayesfred.inference.estimate import find_map
from bayesfred.inference.moves import DEGREES_OF_FREEDOM, HEAVY_SHARE, LaplaceMove
from bayesfred.inference.noise import simulate
from bayesfred.inference.posterior import Nuisances, Posterior

Floats = NDArray[np.float64]

WALKERS = 512
STEPS = 60


def correlated(d: int, rng: np.random.Generator, decades: int = 6) -> Floats:
    """A correlated covariance whose scales span some decades up to 1."""
    a = rng.standard_normal((d, 2 * d))
    scale = 10.0 ** np.linspace(-decades, 0, d)
    return np.asarray(a @ a.T / (2 * d) * np.outer(scale, scale))


# --- the proposal itself ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Mixture:
    """Gaussians of known means, covariances and weights."""

    means: Floats
    covariances: Floats
    weights: Floats

    @classmethod
    def of(cls, d: int, k: int) -> "Mixture":
        rng = np.random.default_rng(10 * d + k)
        covariances = [correlated(d, rng, decades=1) for _ in range(k)]
        return cls(0.1 * rng.standard_normal((k, d)), np.array(covariances), rng.dirichlet(np.full(k, 5.0)))

    @property
    def move(self) -> LaplaceMove:
        if len(self.weights) == 1:
            return LaplaceMove(self.means[0], self.covariances[0])
        return LaplaceMove(self.means, self.covariances, self.weights)

    def log_density(self, x: Floats, heavy: float) -> Floats:
        """Of the mixture with a share of Student's distributions, by scipy."""
        parts, shares = [], []
        for mean, covariance, weight in zip(self.means, self.covariances, self.weights, strict=True):
            parts.append(np.ravel(stats.multivariate_normal(mean, covariance).logpdf(x)))
            parts.append(np.ravel(stats.multivariate_t(mean, covariance, DEGREES_OF_FREEDOM).logpdf(x)))
            shares += [[weight * (1 - heavy)], [weight * heavy]]
        return np.asarray(special.logsumexp(parts, axis=0, b=shares))


@pytest.mark.parametrize(("d", "k"), [(1, 1), (2, 1), (5, 1), (13, 1), (1, 3), (5, 2)])
def test_hastings_factor_is_the_ratio_of_densities(d: int, k: int) -> None:
    mixture, rng = Mixture.of(d, k), np.random.default_rng(d)
    old = mixture.means[0] + 3.0 * (np.linalg.cholesky(mixture.covariances[0]) @ rng.standard_normal((d, 40))).T
    new, factor = mixture.move.get_proposal(old, [], np.random.RandomState(2))
    assert new.shape == (40, d)
    expected = mixture.log_density(old, HEAVY_SHARE) - mixture.log_density(new, HEAVY_SHARE)
    assert factor == pytest.approx(expected, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize(("d", "k"), [(1, 1), (5, 1), (13, 1), (1, 3), (5, 2)])
def test_draws_follow_the_density(d: int, k: int) -> None:
    # under draws from q the mean of p(x) / q(x) is 1 for any density p, here both parts of q and a narrower Gaussian
    mixture = Mixture.of(d, k)
    x = mixture.move.draw(200_000, np.random.RandomState(3))
    log_q = mixture.move.log_density(x)
    narrower = stats.multivariate_normal(mixture.means[0], 0.64 * mixture.covariances[0])
    for log_p in (mixture.log_density(x, 0.0), mixture.log_density(x, 1.0), np.ravel(narrower.logpdf(x))):
        weight = np.exp(log_p - log_q)
        assert abs(weight.mean() - 1) < LIMIT * weight.std() / np.sqrt(weight.size)


def usable(move: LaplaceMove, posterior: Posterior) -> float:
    """Share of the move's draws that are worth an independent one of the posterior, by importance weights."""
    draws = move.draw(2000, np.random.RandomState(4))
    log_weight = posterior.log_prob(draws) - move.log_density(draws)
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum() / len(draws))


def test_scattered_positions_get_a_nested_approximation() -> None:
    rng = np.random.default_rng(43)
    terms = [(i, j, 0, 0) for i in range(4) for j in range(4 - i) if i + j > 0]
    distortion = PolynomialDistortion(terms, terms)
    grid = SourceCatalog.grid(5, 14.0, 5e3)
    off = 0.2 * rng.standard_normal((2, 25))

    def model(x: Floats, y: Floats) -> ForwardModel:
        return ForwardModel(Detector((80, 80)), SourceCatalog(x, y, grid.flux), GaussianPSF(1.5), distortion)

    counts = simulate(model(grid.x + off[0], grid.y + off[1]), np.zeros(distortion.n_terms), 2.0, seed=44)
    nuisances = Nuisances("free", offset=True, position_scatter=True)
    posterior = Posterior(model(grid.x, grid.y), counts, nuisances=nuisances)
    estimate = find_map(posterior)
    nested = LaplaceMove.of(posterior, estimate)
    assert len(nested.weights) > 1 and usable(nested, posterior) > 0.5
    # negative control: a single Gaussian is hardly of use
    assert usable(LaplaceMove(estimate.params, estimate.covariance), posterior) < 0.1


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
