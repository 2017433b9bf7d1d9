"""Posteriors that differ from their Laplace approximation.

They are cut by a prior, come from few photons, or are given a wrong covariance.

Long versions, `pytest -m statistics tests/test_optimize_hard.py`, compare whole runs with emcee's
differential evolution.
"""

from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import emcee
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from test_model import LIMIT
from test_sampling_exactness import SHORT, WithoutHastings, independent, steps_of, worst_moment
from threadpoolctl import threadpool_limits

from bayesfred.analysis.verify import verify
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import convergence
from bayesfred.sampling.ensembles import DE_SHARE, adapted
from bayesfred.sampling.moves import LaplaceMove
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

MOST = 15.0  # likelihoods per effective draw


def make(
    side: int,
    flux: float,
    background: float,
    *,
    spacing: float = 20.0,
    sigma: float = 4.0,
    **options: Any,
) -> Posterior:
    """The paper's frame at 0.4 times its scale, or the middle of it."""
    distortion = options.pop("distortion", PolynomialDistortion.mirrored())
    n = round(spacing * (side - 1) + 43)
    model = ForwardModel(
        Detector((n, n)), SourceCatalog.grid(side, spacing, flux), GaussianPSF(sigma), distortion
    )
    counts = simulate(model, np.zeros(distortion.n_terms), background, seed=1)
    return Posterior(model, counts, **options)


def cut(posterior: Posterior, at: float) -> Posterior:
    """The posterior with a lower bound of the first coefficient.

    The bound is this many standard deviations above the most probable value.
    """
    top = find_map(posterior)
    sd = top.covariance[0, 0] ** 0.5
    bound = stats.uniform(top.params[0] + at * sd, 100.0 * sd)
    return Posterior(posterior.model, posterior.counts, prior={posterior.parameter_names[0]: bound})


@pytest.fixture(scope="module")
def easy() -> Posterior:
    return make(5, 1e4, 2.0, spacing=16.0, sigma=3.0)


@pytest.fixture(scope="module")
def estimate(easy: Posterior) -> MapEstimate:
    return find_map(easy)


def run(posterior: Posterior, estimate: MapEstimate | None, path: Path, **options: Any) -> Chain:
    return sample(posterior, estimate, path=path, seed=2, progress=False, **options)


def apart(a: Floats, b: Floats) -> float:
    """Largest difference of means and of spreads between two runs, in Monte Carlo errors.

    The draws have the shape (ensembles, steps, walkers, d). The error of a standard deviation s
    from n effective draws is s sqrt((kurtosis - 1) / 4 n).
    """
    means, spreads, errors = [], [], []
    for chain in (a, b):
        _, bulk, tail = convergence(chain)
        draws = chain.reshape(-1, chain.shape[3])
        sd, size = draws.std(axis=0), np.minimum(bulk, tail)
        means.append(draws.mean(axis=0))
        spreads.append(sd)
        errors.append(
            [sd**2 / size, sd**2 * (stats.kurtosis(draws, fisher=False) - 1.0) / (4.0 * size)]
        )
    error = np.sqrt(np.sum(errors, axis=0))
    return float(np.abs(np.array([means[0] - means[1], spreads[0] - spreads[1]]) / error).max())


# --- a prior that ends near the maximum -----------------------------------------------------------


@pytest.mark.parametrize("at", [-1.0, 0.5, 5.0])
def test_the_maximum_of_a_cut_posterior_is_found(
    easy: Posterior, estimate: MapEstimate, at: float
) -> None:
    posterior = cut(easy, at)
    found = find_map(posterior)
    assert (
        found.at_maximum
        and found.fits_data
        and ("f_ux at a bound of the prior" in found.message) == (at >= 0.0)
    )
    # the posterior is close to a Gaussian: the others move with the one that is held, as their
    # covariances say
    c, sd = estimate.covariance, np.sqrt(np.diag(estimate.covariance))
    expected = estimate.params + c[:, 0] / c[0, 0] * max(at, 0.0) * sd[0]
    assert np.all(np.abs(found.params - expected) < 0.1 * sd)


def test_an_end_of_the_support_that_is_ignored_is_no_maximum(easy: Posterior) -> None:
    # negative control
    posterior = cut(easy, 1.0)
    start = find_map(posterior).params
    posterior.__dict__["support"] = np.full(13, -np.inf), np.full(13, np.inf)
    assert not find_map(posterior, start).at_maximum


@pytest.mark.parametrize("mean", [0.0, 3.0, -8.0])
def test_draws_within_the_support_follow_the_density(mean: float) -> None:
    a = np.random.default_rng(5).standard_normal((3, 6))
    covariance = a @ a.T
    # of the second parameter both bounds are near, of the third one
    support = np.array([-np.inf, -1.0, 0.0]), np.array([np.inf, 2.0, 1e3])
    move = LaplaceMove(np.array([0.0, mean, mean]), covariance, support=support)
    x = move.draw(100_000, np.random.RandomState(3))
    inside = np.all((x >= support[0]) & (x <= support[1]), axis=1)
    assert inside.mean() > 0.95  # of all but the share with heavy tails
    log_p = (
        stats.norm(0.0, 1.0).logpdf(x[:, 0])
        + stats.uniform(-1.0, 3.0).logpdf(x[:, 1])
        + stats.expon().logpdf(x[:, 2])
    )
    weight = np.exp(log_p - move.log_density(x))
    assert abs(weight.mean() - 1.0) < LIMIT * weight.std() / np.sqrt(weight.size)
    # negative control: the density of a proposal that is not cut
    wrong = np.exp(log_p - LaplaceMove(np.array([0.0, mean, mean]), covariance).log_density(x))
    assert abs(wrong.mean() - 1.0) > LIMIT * wrong.std() / np.sqrt(wrong.size)


def test_a_cut_target_is_sampled() -> None:
    bound = np.full(2, -0.5), np.full(2, np.inf)
    target = independent(stats.truncnorm(-0.5, np.inf), 2, 0.0, 1.0)
    move = LaplaceMove(target.mean, target.covariance, support=bound)
    coords = np.stack(list(islice(steps_of(target, move, 41), 60)))
    assert np.mean(np.any(np.diff(coords, axis=0) != 0.0, axis=2)) > 0.9
    assert worst_moment(target, steps_of(target, move, 41), SHORT) < LIMIT
    wrong = WithoutHastings(target.mean, 2.0 * target.covariance, support=bound)
    assert worst_moment(target, steps_of(target, wrong, 41), SHORT) > LIMIT


@pytest.mark.parametrize("at", [0.0, 4.0])
def test_a_cut_posterior_is_sampled(
    easy: Posterior, estimate: MapEstimate, at: float, tmp_path: Path
) -> None:
    chain = run(cut(easy, at), None, tmp_path / "chain.h5", target_ess=2000)
    z = (chain.draws()[:, 0] - estimate.params[0]) / estimate.covariance[0, 0] ** 0.5
    _, bulk, tail = convergence(chain.chain[:, chain.burn_in :])
    expected = stats.truncnorm(at, np.inf)
    assert z.min() >= at
    assert (
        abs(z.mean() - expected.mean()) < LIMIT * expected.std() / np.sqrt(bulk[0]) + 0.03
    )  # it is not quite Gaussian
    assert chain.log_prob.size / min(bulk.min(), tail.min()) < 3.0


# --- proposals that do not fit --------------------------------------------------------------------


@pytest.mark.parametrize("scale", [pytest.param(1 / 25, marks=pytest.mark.statistics), 25.0])
def test_a_wrong_covariance_is_noticed_and_corrected(
    easy: Posterior, estimate: MapEstimate, scale: float, tmp_path: Path
) -> None:
    wrong = replace(estimate, covariance=scale * estimate.covariance)
    chain = run(easy, wrong, tmp_path / "chain.h5", target_ess=1000)
    made = adapted(chain.chain)
    assert 0 < made <= chain.burn_in
    kept = chain.chain[:, chain.burn_in :]
    rhat, bulk, tail = convergence(kept)
    assert rhat.max() <= 1.01 and min(bulk.min(), tail.min()) >= 1000
    assert kept[..., 0].size / min(bulk.min(), tail.min()) < MOST
    right = run(easy, estimate, tmp_path / "right.h5", target_ess=4000)
    assert adapted(right.chain) == 0
    assert apart(kept, right.chain[:, right.burn_in :]) < LIMIT
    # negative control: draws too wide by a tenth
    assert (
        apart(
            kept.mean(axis=(0, 1, 2)) + 1.1 * (kept - kept.mean(axis=(0, 1, 2))),
            right.chain[:, right.burn_in :],
        )
        > LIMIT
    )


def longest_rest(coords: Floats) -> int:
    """Most steps in a row in which a walker did not move; coords has shape (steps, walkers, d)."""
    rest = np.zeros(coords.shape[1], int)
    longest = 0
    for moved in np.any(np.diff(coords, axis=0) != 0.0, axis=2):
        rest = np.where(moved, 0, rest + 1)
        longest = max(longest, int(rest.max()))
    return longest


@pytest.mark.slow
def test_without_adaptation_the_run_stalls(easy: Posterior, estimate: MapEstimate) -> None:
    """Negative control: the moves that a run would keep making, on the same walkers."""
    wrong = replace(estimate, covariance=25.0 * estimate.covariance)
    adapting = sample(easy, wrong, seed=2, ensembles=2, steps=400, progress=False)
    moves = [
        (LaplaceMove.of(easy, wrong), 1.0 - DE_SHARE),
        (emcee.moves.DEMove(live_dangerously=True), DE_SHARE),
    ]
    sampler = emcee.EnsembleSampler(32, 13, easy.log_prob, moves=moves, vectorize=True)
    random = np.random.RandomState(4).get_state()
    with threadpool_limits(1, user_api="blas"):
        sampler.run_mcmc(emcee.State(adapting.chain[0, 0], random_state=random), 1000)
    made = adapted(adapting.chain)
    assert longest_rest(sampler.get_chain()) > 300
    assert max(longest_rest(coords[made:]) for coords in adapting.chain) < 100


def test_an_adapted_run_is_resumed_bit_for_bit_and_verified(
    easy: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    wrong = replace(estimate, covariance=25.0 * estimate.covariance)
    whole = run(easy, wrong, tmp_path / "whole.h5", steps=40, walkers=48)
    assert adapted(whole.chain[:, :9]) == 8  # before the last step that `verify` makes again
    part = run(easy, wrong, tmp_path / "part.h5", steps=7, walkers=48)
    for steps in (8, 12, 16, 31, 40):
        part = run(easy, wrong, part.path, steps=steps, walkers=48, resume=True)
    assert (
        np.array_equal(part.chain, whole.chain)
        and part.path.read_bytes() == whole.path.read_bytes()
    )
    failed = {check.what for check in verify(whole.path) if not check.holds}
    assert failed == {"covariance"}  # the one that was scaled


# --- whole runs against differential evolution ----------------------------------------------------


def complete_to_degree_3() -> dict[str, Any]:
    """28 terms, f's in x, y, u and g's in x, y, v; with pointing and background 31 parameters."""
    terms = PolynomialDistortion.full_polynomial(3)
    distortion = PolynomialDistortion(
        [t for t in terms.f_terms if t[3] == 0], [t for t in terms.g_terms if t[2] == 0]
    )
    return {"distortion": distortion, "nuisances": Nuisances(offset=True)}


HARD = {
    "200 photons": lambda: make(9, 200.0, 0.05),
    "4 sources": lambda: make(2, 1e5, 5.0, spacing=80.0),
    "cut in half": lambda: cut(make(9, 1e5, 5.0), 0.0),
    "31 parameters": lambda: make(9, 1e5, 5.0, **complete_to_degree_3()),
}


@pytest.mark.statistics
@pytest.mark.parametrize("name", HARD)
def test_hard_posteriors_agree_with_differential_evolution(name: str, tmp_path: Path) -> None:
    posterior = HARD[name]()
    estimate = find_map(posterior)
    chain = run(posterior, estimate, tmp_path / "chain.h5")
    kept = chain.chain[:, chain.burn_in :]
    rhat, bulk, tail = convergence(kept)
    least = min(bulk.min(), tail.min())
    assert estimate.at_maximum and rhat.max() <= 1.01 and least >= 1000
    assert chain.log_prob.size / least < MOST
    walkers, steps = 2 * posterior.n_parameters + 22, 1200
    start = LaplaceMove.of(posterior, estimate).draw(4 * walkers, np.random.RandomState(3))
    start = start[np.isfinite(posterior.log_prob(start))][:walkers]
    move = emcee.moves.DEMove()
    sampler = emcee.EnsembleSampler(*start.shape, posterior.log_prob, moves=move, vectorize=True)
    sampler.run_mcmc(emcee.State(start, random_state=np.random.RandomState(4).get_state()), steps)
    reference = sampler.get_chain(discard=steps // 5)[None]
    _, bulk, tail = convergence(reference)
    assert min(bulk.min(), tail.min()) > 200
    assert apart(kept, reference) < LIMIT
    middle = kept.mean(axis=(0, 1, 2))
    assert (
        apart(middle + 1.2 * (kept - middle), reference) > LIMIT
    )  # negative control: draws too wide by a fifth
