"""Posteriors of several modes: draws against exact grids, and what is said of them."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import emcee
import h5py
import multimodal
import numpy as np
import pytest
from multimodal import PITCH, REACH, SPREAD
from test_sampling_chain import reseal

from bayesfred.analysis.diagnostics import diagnose
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling import ensembles
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.laplace import laplace
from bayesfred.sampling.sampler import sample

EFFECTIVE = 10_000  # draws: a 5 % quantile of a normal distribution is then known to 0.021 sd


def worst(posterior: Posterior, chain: Chain, *grids: np.ndarray) -> float:
    """The largest error of a quantile of the offset, see `multimodal.quantile_error`."""
    exact = multimodal.marginals(posterior, *grids)
    effective = diagnose(chain, target_ess=100.0).ess_bulk
    return max(
        multimodal.quantile_error(chain.draws()[:, 2 + k], effective[name], grid, mass)
        for k, (name, grid, mass) in enumerate(
            zip(chain.parameter_names[2:], grids, exact, strict=False)
        )
    )


def fine_grid() -> np.ndarray:
    return np.arange(-4.5 * REACH, 4.5 * REACH, 0.005)


@pytest.mark.slow
def test_draws_of_a_mask_are_those_of_the_grid() -> None:
    posterior = multimodal.masked(1, 3.0)
    estimate = find_map(posterior)
    chain = sample(posterior, estimate, seed=1, target_ess=4000, progress=False)
    assert worst(posterior, chain, fine_grid()) < 0.1
    assert chain.draws()[:, 2].std() > 3.5
    # negative control: from one mode the run says converged and knows nothing of the others
    alone = replace(estimate, modes=None)
    chain = sample(posterior, alone, seed=1, target_ess=4000, progress=False)
    assert diagnose(chain).sampled_well and chain.draws()[:, 2].std() < 0.05
    assert worst(posterior, chain, fine_grid()) > 1.0


@pytest.mark.statistics
@pytest.mark.parametrize("first", range(0, 50, 10))
def test_quantiles_in_one_dimension(first: int) -> None:
    """Masks at 50 random places. Errors are at most 0.1 standard deviations in every frame."""
    errors, alone = [], []
    for seed in range(first, first + 10):
        posterior = multimodal.masked(seed, np.random.default_rng(seed).normal(0.0, REACH))
        estimate = find_map(posterior)
        chain = sample(posterior, estimate, seed=seed, target_ess=EFFECTIVE, progress=False)
        errors.append(worst(posterior, chain, fine_grid()))
        one = sample(posterior, replace(estimate, modes=None), seed=seed, progress=False)
        alone.append(worst(posterior, one, fine_grid()))
    assert max(errors) < 0.1
    assert np.sum(np.array(alone) > 0.1) >= 8


@pytest.mark.statistics
@pytest.mark.parametrize("first", range(0, 50, 10))
def test_quantiles_in_two_dimensions(first: int) -> None:
    """Four stars of 8 photons in 50 frames."""
    grid = np.linspace(-4.5, 4.5, 121) * SPREAD
    errors = []
    for seed in range(first, first + 10):
        posterior = multimodal.faint(seed)
        chain = sample(posterior, seed=seed, target_ess=EFFECTIVE, progress=False)
        errors.append(worst(posterior, chain, grid, grid))
    assert max(errors) < 0.1


def test_walkers_of_an_ensemble_start_in_one_mode() -> None:
    posterior = multimodal.masked(1, 3.0)
    estimate = find_map(posterior)
    step = ensembles.begin(posterior, estimate, 1, 4, 32)
    mode = estimate.mixture.assign(step.coords.reshape(-1, 4)).reshape(4, 32)
    assert np.all(mode == np.arange(4)[:, None] % estimate.mixture.count)


def test_r_hat_sees_modes_that_are_not_reached(monkeypatch: pytest.MonkeyPatch) -> None:
    """With moves that stay in a mode the ensembles differ."""
    posterior = multimodal.masked(1, 3.0)
    estimate = find_map(posterior)
    stretch = [(emcee.moves.StretchMove(live_dangerously=True), 1.0)]
    monkeypatch.setattr(ensembles, "moves_after", lambda *_: stretch)
    chain = sample(posterior, estimate, seed=1, steps=100, progress=False)
    verdict = diagnose(chain)
    assert verdict.rhat["offset_x"] > 1.5 and not verdict.sampled_well


def test_proposals_are_fitted_to_the_draws_of_each_mode() -> None:
    posterior = multimodal.masked(1, 3.0)
    estimate = find_map(posterior)
    modes = estimate.mixture
    wide = replace(estimate, modes=replace(modes, covariances=modes.covariances * 25.0))
    chain = sample(posterior, wide, seed=1, target_ess=1000, progress=False)
    assert ensembles.adapted(chain.chain) > 0
    (move, _), _ = ensembles.moves_after(posterior, wide, chain.chain)
    error = np.sqrt(modes.covariances[0, 2, 2])
    k = int(np.argmin(np.abs(move.means - modes.means[0, 2]).sum(axis=1)))
    spread = np.sqrt(np.diag(move.lowers[k] @ move.lowers[k].T)).max()
    assert 0.5 * error < spread < 2.0 * error
    # negative control: one normal distribution for the draws of all modes spans them
    one = ensembles.LaplaceMove.fitted(posterior, replace(wide, modes=None), chain.draws())
    assert np.sqrt(np.diag(one.lowers[0] @ one.lowers[0].T)).max() > 3.0


def test_a_resumed_run_is_the_same(tmp_path: Path) -> None:
    posterior = multimodal.faint(3)
    estimate = find_map(posterior)
    assert estimate.modes is not None
    whole = sample(posterior, estimate, seed=1, steps=24, progress=False)
    path = tmp_path / "chain.h5"
    sample(posterior, estimate, seed=1, steps=11, path=path, progress=False)
    stored = open_chain(path).estimate.modes
    assert stored is not None and stored.count == estimate.modes.count
    for name in ("means", "covariances", "weights"):
        assert np.array_equal(getattr(stored, name), getattr(estimate.modes, name))
    again = sample(posterior, seed=1, steps=24, path=path, resume=True, progress=False)
    assert np.array_equal(again.chain, whole.chain)


def test_a_file_of_one_mode_is_read_and_resumed(tmp_path: Path) -> None:
    """Files of schema 4 hold no modes."""
    posterior, path = multimodal.masked(1, 3.0), tmp_path / "chain.h5"
    alone = replace(find_map(posterior), modes=None)
    whole = sample(posterior, alone, seed=1, steps=12, progress=False)
    sample(posterior, alone, seed=1, steps=5, path=path, progress=False)
    with h5py.File(path, "r+", libver="v110") as file:
        assert "modes" not in file
        file.attrs["schema"] = 4
    reseal(path)
    again = sample(posterior, seed=1, steps=12, path=path, resume=True, progress=False)
    assert np.array_equal(again.chain, whole.chain)


def test_laplace_draws_come_from_all_modes() -> None:
    posterior = multimodal.masked(1, 3.0)
    estimate = find_map(posterior)
    chain = laplace(posterior, estimate, seed=1, progress=False)
    offset, modes = chain.draws()[:, 2], estimate.mixture
    near = np.abs(offset[:, None] - modes.means[:, 2]) < 0.5 * PITCH
    error = np.sqrt(modes.weights * (1.0 - modes.weights) / len(offset))
    assert np.all(np.abs(near.mean(axis=0) - modes.weights) < 5.0 * error + 1e-3)
    verdict = diagnose(chain)
    assert verdict.approximation.efficiency > 0.9 and "modes" in verdict.verdict


def test_modes_are_told() -> None:
    posterior = multimodal.masked(1, 3.0)
    chain = sample(posterior, find_map(posterior), seed=1, progress=False)
    verdict = diagnose(chain)
    share = np.mean(np.abs(chain.draws()[:, 2] - 3.0) < 0.5 * PITCH)
    assert verdict.sampled_well and verdict.verdict["modes"][0] == pytest.approx(share, abs=1e-9)
    said = f"has {len(verdict.modes)} modes, the largest with {share:.0%} and "
    assert said in verdict.message
    assert verdict.summary(chain).meta["modes"] == list(verdict.modes)
    one = replace(chain, estimate=replace(chain.estimate, modes=None))
    assert "modes" not in diagnose(one).verdict and "modes" not in diagnose(one).message


def unmatched() -> Iterator[tuple[Posterior, MapEstimate]]:
    """Faint frames in which the search matches no source."""
    for seed in range(1, 40):
        posterior = multimodal.faint(seed)
        estimate = find_map(posterior)
        if "0 of 4 sources matched" in estimate.message:
            yield posterior, estimate


def test_no_run_without_matched_sources_is_sampled_well() -> None:
    posterior, estimate = next(unmatched())
    verdict = diagnose(sample(posterior, estimate, seed=1, progress=False))
    assert max(verdict.rhat.values()) < 1.01 and min(verdict.ess_tail.values()) > 1000.0
    assert not verdict.sampled_well and not verdict.trustworthy
    assert "0 of 4 sources matched, so that other modes may have been missed" in verdict.message
