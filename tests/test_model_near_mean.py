"""Log-posteriors from polynomials in the pixels' means, against those from the formulas."""

import copy
import math
import pickle
from dataclasses import replace
from functools import cache
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

import bayesfred as bf
from bayesfred.analysis.verify import verify
from bayesfred.errors import InputError
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.model.frame_evaluator import LocalFrames
from bayesfred.model.kernels import expansion_of_mean
from bayesfred.model.kernels.mean_series import BLOCK, MeanSeries

Floats = NDArray[np.float64]

AGREE = 1e-4  # see `Posterior.near`
SHAPE = (90, 120)
RNG = np.random.default_rng(77)
MAP, FLAT = RNG.uniform(1.0, 3.0, SHAPE), RNG.uniform(0.5, 1.5, SHAPE)
READ = bf.PoissonNoise
NOISES: dict[str, Any] = {
    "0.5": READ(0.5),
    "2": READ(2.0),
    "above 1": READ(MAP),
    "below 1": READ(0.25 * MAP),
    "around 1": READ(0.5 * MAP),
    "flat, 2": bf.FlatFieldNoise(READ(2.0), FLAT),
    "flat, map": bf.FlatFieldNoise(READ(MAP), FLAT),
}
LONG = {"0.5", "below 1", "around 1", "flat, 2", "flat, map"}
NAMES = [pytest.param(name, marks=pytest.mark.slow if name in LONG else ()) for name in NOISES]


@cache
def made(name: str, pixel: str = "impulse", order: int = 0) -> tuple[bf.Posterior, Floats, Floats]:
    """A frame of which a tenth is masked, the true parameters and their covariance."""
    model = bf.ForwardModel(
        bf.Detector(SHAPE, pixel=pixel), bf.SourceCatalog.grid(4, 22.0, 3e3), bf.GaussianPSF(2.0),
        bf.PolynomialDistortion.mirrored(),
    )  # fmt: skip
    noise, rng = NOISES[name], np.random.default_rng(78)
    posterior = bf.Posterior(
        model, bf.simulate(model, np.zeros(12), 4.0, seed=79, noise=noise), noise=noise,
        mask=rng.random(SHAPE) < 0.9, nuisances=bf.Nuisances(background_order=order),
    )  # fmt: skip
    truth = np.where(np.array(posterior.parameter_names) == "background", 4.0, 0.0)
    return posterior, truth, np.linalg.inv(posterior.fisher(truth))


def draws(truth: Floats, covariance: Floats, sd: float) -> Floats:
    """Draws of the Laplace approximation, so many times as wide."""
    whitened = np.random.default_rng(80).standard_normal((12, truth.size))
    return np.asarray(truth + sd * whitened @ np.linalg.cholesky(covariance).T)


def series(near: bf.Posterior) -> MeanSeries:
    found: MeanSeries = near.likelihood.near_problem.frame.noise.near
    return found


def replaced(near: bf.Posterior, changed: MeanSeries) -> bf.Posterior:
    """The same with other polynomials."""
    other = copy.copy(near)
    likelihood = copy.copy(near.likelihood)
    problem = near.likelihood.near_problem
    noise = problem.frame.noise._replace(near=changed)
    vars(likelihood)["near_problem"] = problem._replace(frame=problem.frame._replace(noise=noise))
    vars(other)["likelihood"] = likelihood
    return other


def compare(case: tuple[bf.Posterior, Floats, Floats]) -> None:
    posterior, truth, covariance = case
    near = posterior.near(truth, covariance)
    for sd in (0.0, 0.1, 1.0, 2.0, 4.0):
        params = draws(truth, covariance, sd)
        exact, found = posterior.log_prob(params), near.log_prob(params)
        assert found == pytest.approx(exact, rel=0, abs=AGREE)
        if sd == 1.0:  # other digits: they are not from the formulas once more
            assert np.all(found != exact)
    blocks = series(near).blocks.reshape(-1, BLOCK // SEGMENT, SEGMENT)
    used = int(posterior.mask.sum())
    assert np.count_nonzero(blocks[:, 1]) == used  # masked pixels are never out of range
    assert np.sum(blocks[:, 1] == np.float32(expansion_of_mean.NEVER)) < 0.01 * used


@pytest.mark.parametrize("name", NAMES)
def test_near_the_maximum_log_prob_is_the_same(name: str) -> None:
    compare(made(name))


def test_with_a_background_polynomial() -> None:
    compare(made("2", order=2))


@pytest.mark.slow
def test_with_box_pixels() -> None:
    compare(made("above 1", pixel="box"))


@pytest.mark.parametrize("name", NAMES)
def test_far_from_it_log_prob_is_the_same(name: str) -> None:
    posterior, truth, covariance = made(name)
    near = posterior.near(truth, covariance)
    for sd in (10.0, 100.0, 1e4):
        params = draws(truth, covariance, sd)
        exact, found = posterior.log_prob(params), near.log_prob(params)
        assert np.array_equal(np.isfinite(exact), np.isfinite(found))
        finite = np.isfinite(exact)
        assert found[finite] == pytest.approx(exact[finite], rel=1e-12, abs=AGREE)


def test_out_of_range_the_formulas_serve() -> None:
    """Polynomials about means that are never met change rounding alone."""
    posterior, truth, covariance = made("2")
    near = posterior.near(truth, 1e-12 * covariance)
    params = draws(truth, covariance, 1.0)
    assert near.log_prob(params) == pytest.approx(posterior.log_prob(params), rel=1e-13)


def test_polynomials_of_other_pixels_are_told() -> None:
    """Negative control: with coefficients of neighbours the sum is another."""
    posterior, truth, covariance = made("2")
    near = posterior.near(truth, covariance)
    known, params = series(near), draws(truth, covariance, 1.0)
    exact = posterior.log_prob(params)
    blocks = known.blocks.reshape(-1, BLOCK // SEGMENT, SEGMENT).copy()
    blocks[:, 2:] = np.roll(blocks[:, 2:], 1, axis=2)
    wrong = replaced(near, known._replace(blocks=blocks.ravel()))
    assert np.abs(wrong.log_prob(params) - exact).max() > 100.0 * AGREE
    shifted = replaced(near, known._replace(constants=known.constants + 1e-3))
    assert np.abs(shifted.log_prob(params) - exact).min() > 100.0 * AGREE
    same = replaced(near, known)
    assert np.array_equal(same.log_prob(params), near.log_prob(params))


def test_impossible_means_have_no_density() -> None:
    posterior, truth, covariance = made("2", order=2)
    near, params = posterior.near(truth, covariance), truth.copy()
    params[posterior.parameter_names.index("background_u")] = 40.0
    assert posterior.log_prob(params) == near.log_prob(params) == -math.inf
    params[:] = truth
    params[0] = 1e3  # every source is out of the frame, or folded
    assert near.log_prob(params) == posterior.log_prob(params)


def test_where_nothing_is_known_it_is_the_same() -> None:
    posterior, truth, covariance = made("2")
    params = draws(truth, covariance, 1.0)
    nowhere = truth.copy()
    nowhere[:12] = 1e3
    for near in (posterior.near(truth, -covariance), posterior.near(nowhere, covariance)):
        assert np.array_equal(near.log_prob(params), posterior.log_prob(params))


def test_derivatives_are_those_of_the_formulas() -> None:
    posterior, truth, covariance = made("above 1")
    near = posterior.near(truth, covariance)
    near.log_prob(truth)
    assert np.array_equal(near.gradient(truth), posterior.gradient(truth))
    assert np.array_equal(near.fisher(truth), posterior.fisher(truth))


def test_a_vector_has_the_same_bits_whatever_others_there_are() -> None:
    posterior, truth, covariance = made("2")
    near, params = posterior.near(truth, covariance), draws(truth, covariance, 2.0)
    every, threads = near.log_prob(params), numba.get_num_threads()
    assert [near.log_prob(each) for each in params] == list(every)
    try:
        numba.set_num_threads(1)
        assert np.array_equal(near.log_prob(params), every)
    finally:
        numba.set_num_threads(threads)


def test_copies_evaluate_around_the_same() -> None:
    posterior, truth, covariance = made("above 1")
    near, params = posterior.near(truth, covariance), draws(truth, covariance, 1.0)
    found = near.log_prob(params)
    prior = {"background": near.prior["background"]}
    for again in (pickle.loads(pickle.dumps(near)), copy.copy(near), replace(near, prior=prior)):
        assert again.log_prob(params).tobytes() == found.tobytes()
    assert len(pickle.dumps(near)) < len(pickle.dumps(posterior)) + 10_000
    there = posterior.near(truth + 1e-3 * (params[0] - truth), covariance)
    moved = near.near(there.extrapolation.params, covariance)  # type: ignore[union-attr]
    assert moved.log_prob(params).tobytes() == there.log_prob(params).tobytes()


def test_a_copy_with_another_frame_is_that_frames() -> None:
    posterior, truth, covariance = made("above 1")
    near, params = posterior.near(truth, covariance), draws(truth, covariance, 1.0)
    near.log_prob(params)
    changes: tuple[dict[str, Any], ...] = (
        {"mask": posterior.mask & (np.arange(SHAPE[1]) > 50)},
        {"noise": READ(2.0)},
        {"counts": posterior.counts[::-1]},
    )
    for change in changes:
        exact = replace(posterior, **change).log_prob(params)
        assert replace(near, **change).log_prob(params) == pytest.approx(exact, rel=0, abs=AGREE)
    with pytest.raises(InputError, match="extrapolation: got one about 13 parameters, expected 15"):
        replace(near, nuisances=bf.Nuisances(background_order=1))


def test_other_noises_have_nothing_to_expand() -> None:
    posterior, _, _ = made("2")
    changes: tuple[dict[str, Any], ...] = (
        {"noise": bf.GaussianNoise(4.0)},
        {"noise": READ(), "counts": np.maximum(posterior.counts, 0.0)},
        {"noise": bf.FlatFieldNoise(READ(), FLAT), "counts": np.maximum(posterior.counts, 0.0)},
        {"nuisances": bf.Nuisances(model_error=True)},
    )
    for change in changes:
        other = replace(posterior, **change)
        size = other.n_parameters
        assert other.near(other.start(), np.eye(size)) is other


def test_frames_of_a_joint_posterior() -> None:
    posterior, truth, covariance = made("2")
    frames = LocalFrames({"one": posterior, "two": replace(posterior)})
    params = draws(truth, covariance, 1.0)
    wanted = np.ones((2, len(params)), bool)
    exact = frames.log_likelihood([params, params], wanted)
    near = frames.near([truth, truth], [covariance, covariance])
    found = near.log_likelihood([params, params], wanted)
    assert found == pytest.approx(exact, rel=0, abs=AGREE) and np.all(found != exact)


def test_a_chain_holds_the_log_prob_of_its_draws(tmp_path: Any) -> None:
    posterior, truth, _ = made("2")
    best = bf.find_map(posterior, truth)
    path = tmp_path / "chain.h5"
    chain = bf.sample(posterior, best, path=path, seed=5, walkers=32, steps=4, progress=False)
    flat = chain.chain.reshape(-1, truth.size)
    assert chain.log_prob.ravel() == pytest.approx(posterior.log_prob(flat), rel=0, abs=AGREE)
    assert all(check.holds for check in verify(path))
