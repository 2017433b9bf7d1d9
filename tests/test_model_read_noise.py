"""Photon noise with read noise: the density against its sum, derivatives, moments, frames, files.

Negative controls use the shifted Poisson distribution, in which counts + r^2 stand for Poisson
counts of mean mu + r^2.
"""

import math
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special
from test_model import (
    background_image,
    dense_image,
    make_model,
    make_posterior,
    make_truth,
)
from test_model_derivatives import STEP, errors, five_point, touching
from test_sampling_chain import reseal

import bayesfred as bf
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import PoissonNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.fit_statistics import fit_statistics, misfit
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

READ_NOISES = [0.05, 0.3, 0.7, 0.95, 1.0, 1.5, 3.0, 10.0, 30.0]
MEANS = np.array([1e-3, 0.05, 1.0, 5.0, 50.0, 1e3, 1e5])
SHAPE = (60, 75)


def summed(n: Floats, mu: float, r: float) -> Floats:
    """log p from the sum over all photon numbers that matter, shape of n."""
    reach = 12.0 * math.sqrt(mu + r * r) + 12.0 * r + 40.0
    k = np.arange(max(0.0, math.floor(min(n.min(), mu) - reach)), max(n.max(), mu) + reach)
    terms = special.xlogy(k, mu) - mu - special.gammaln(k + 1.0)
    terms = terms - 0.5 * ((n[:, None] - k) / r) ** 2
    return special.logsumexp(terms, axis=1) - 0.5 * math.log(2.0 * math.pi) - math.log(r)


def shifted(n: Floats, mu: float | Floats, r: float) -> Floats:
    """log p of the shifted Poisson distribution, which read noise used to be."""
    shift = r * r
    return np.asarray(
        special.xlogy(n + shift, mu + shift)
        - (mu + shift)
        - special.gammaln(np.maximum(n + shift, 0.0) + 1.0)
    )


def lattice(mu: float, r: float) -> tuple[Floats, float]:
    """Counts within 9 standard deviations for the trapezoidal rule, and their step."""
    step = min(r, r * r) / 10.0
    reach = 9.0 * math.sqrt(mu + r * r) + 12.0
    first = max(mu - reach, -9.0 * r)
    return 0.5 + step * np.arange(math.floor((first - 0.5) / step), (mu + reach) / step), step


@pytest.mark.parametrize("r", READ_NOISES)
def test_log_likelihood_is_that_of_the_sum(r: float) -> None:
    noise, tolerance = PoissonNoise(r), 2e-9 if r < 1.0 else 1e-5
    for mu in MEANS:
        n = mu + math.sqrt(mu + r * r) * np.linspace(-6.0, 6.0, 41)
        error = np.abs(noise.log_likelihood(n, np.array([mu]), 0.0) - summed(n, mu, r))
        assert error.max() < tolerance
    # far outside it is finite, and no count is worth more than one that is nearer
    n = np.array([-1e9, -1e5, -50.0 * r, 0.0, 1e5, 1e9])
    far = noise.log_likelihood(n, np.array([3.0]), 0.0)
    assert np.isfinite(far).all() and np.all(np.diff(far[:4]) > 0.0) and np.all(far[4:] < far[3])


@pytest.mark.parametrize("r", [0.3, 1.0, 3.0])
@pytest.mark.parametrize("mu", [0.05, 5.0])
def test_density_is_normalised(r: float, mu: float) -> None:
    n, step = lattice(mu, r)
    density = np.exp(PoissonNoise(r).log_likelihood(n, np.array([mu]), 0.0))
    assert step * density.sum() == pytest.approx(1.0, abs=2e-5)
    assert step * (density @ n) == pytest.approx(mu, abs=1e-4)
    if r < 1.0 and mu < 1.0:  # negative control
        assert step * np.exp(shifted(n, mu, r)).sum() > 2.0


@pytest.mark.parametrize("r", [0.3, 0.95, 1.0, 3.0, 30.0])
def test_score_is_the_slope_and_the_information_its_variance(r: float) -> None:
    noise = PoissonNoise(r)
    for mu in (0.05, 1.0, 50.0):
        n, step = lattice(mu, r)
        at, h = np.full(n.size, mu), 1e-3 * (mu + min(r * r, 1.0) * 0.04)
        ahead = [noise.log_likelihood(n, at + k * h, 0.0) for k in (-2, -1, 1, 2)]
        slope = (ahead[0] - 8.0 * ahead[1] + 8.0 * ahead[2] - ahead[3]) / (12.0 * h)
        score = noise.score(n, at, 0.0)
        assert score / (1.0 + np.abs(n) / mu) == pytest.approx(
            slope / (1.0 + np.abs(n) / mu), abs=1e-7
        )
        chance = step * np.exp(noise.log_likelihood(n, at, 0.0))
        information = float(chance @ score**2)
        assert chance @ score == pytest.approx(0.0, abs=3e-4 * math.sqrt(information))
        stated = float(noise.fisher_weight(np.array([mu]), 0.0)[0])
        assert stated == pytest.approx(information, rel=3e-4)
        # negative control: one over the variance is less than the information at few counts
        assert 1.0 / (mu + r * r) < information * (1.0 - 3e-4) or mu > 0.05 or r > 3.0


@pytest.mark.parametrize("r", [0.3, 1.0, 3.0])
def test_moments_of_the_deviance(r: float) -> None:
    noise = PoissonNoise(r)
    for mu in (1e-3, 0.05, 2.0, 50.0, 5e3):
        n, step = lattice(mu, r)
        at = np.full(n.size, mu)
        chance = step * np.exp(noise.log_likelihood(n, at, 0.0))
        deviance = noise.deviance(n, at, 0.0)
        assert np.isfinite(deviance).all() and deviance.min() >= 0.0
        mean, variance, slope = (
            float(each[0]) for each in noise.deviance_moments(np.array([mu]), 0.0)
        )
        assert mean == pytest.approx(chance @ deviance, rel=3e-4)
        assert variance == pytest.approx(chance @ (deviance - mean) ** 2, rel=1e-3)
        covariance = chance @ (deviance * noise.score(n, at, 0.0))
        scale = math.sqrt(variance * float(noise.fisher_weight(np.array([mu]), 0.0)[0]))
        assert slope == pytest.approx(covariance, abs=2e-3 * scale)


def test_deviance_is_what_the_best_mean_gains() -> None:
    n = np.array([-1e4, -30.0, 0.4, 0.6, 2.3, 40.0, 1e6])
    for r in (0.3, 1.0, 3.0):
        noise, mu = PoissonNoise(r), np.full(n.size, 2.0)
        value = noise.log_likelihood(n, mu, 0.0)
        grid = np.concatenate([[0.0], np.geomspace(1e-6, 1e7, 20_001)])
        best = [noise.log_likelihood(np.full(grid.size, x), grid, 0.0).max() for x in n]
        gain = 2.0 * (np.array(best) - value)
        assert noise.deviance(n, mu, 0.0) == pytest.approx(gain, rel=1e-5, abs=1e-4)


# --- frames ---------------------------------------------------------------------------------------

RNG = np.random.default_rng(700)
MAP = np.exp(RNG.uniform(math.log(0.4), math.log(4.0), SHAPE))
FRAMES: dict[str, tuple[Any, Nuisances, float]] = {
    "small": (0.4, Nuisances("scale", offset=True), 0.3),
    "large": (2.0, Nuisances("scale", psf_sigma=True), 3.0),
    "map": (MAP, Nuisances("scale", offset=True, background_order=1), 3.0),
    "free": (2.0, Nuisances("free"), 3.0),
}


def frame(case: str) -> tuple[Posterior, Floats]:
    """A frame in which a tenth of the pixels are masked and most are reached by no source."""
    read_noise, nuisances, background = FRAMES[case]
    rng, model = np.random.default_rng(701), touching()
    mask = rng.random(SHAPE) < 0.9
    truth = make_truth(model, rng, background)
    return make_posterior(model, truth, rng, nuisances, PoissonNoise(read_noise), mask=mask)


@pytest.mark.parametrize("case", ["small", "large", pytest.param("map", marks=pytest.mark.slow)])
def test_log_prob_is_the_sum_over_all_pixels(case: str) -> None:
    posterior, params = frame(case)
    for factor in (1.0, 1.4, 5.0):  # at the last the pixels are summed one by one
        params[posterior.parameter_names.index("background")] *= factor
        named = dict(zip(posterior.parameter_names, params, strict=True))
        mean = dense_image(posterior.model, named) + background_image(SHAPE, named)
        terms = posterior.noise.log_likelihood(posterior.counts, mean, 0.0)[posterior.mask]
        value = posterior.log_prob(params) - posterior.log_prior(params)[0]
        assert value == pytest.approx(float(terms.sum()), rel=1e-9)


@pytest.mark.parametrize("r", [0.05, 0.5, 1.0, 30.0])
def test_bright_dark_and_masked_pixels_are_summed_alike(r: float) -> None:
    # few enough counts for the table of one read noise, more than it serves, and far below zero
    model, rng, noise = touching(), np.random.default_rng(710), PoissonNoise(r)
    truth = make_truth(model, rng, 3.0)
    theta, mean = [truth[name] for name in model.distortion.names], model.expected_counts
    image = mean(np.array(theta), 3.0)
    counts = noise.draw(image - 3.0, 3.0, rng)
    counts[5, ::7], counts[20:22, 3:40], counts[30, 8] = 5e3 * r * r, 1e6, -60.0 * r
    mask = rng.random(SHAPE) < 0.9
    params = np.array([*theta, 3.0])
    value, expected = [], []
    for level in (3.0, 3.3, 9.0):
        params[-1] = level
        posterior = Posterior(model, counts, noise=noise, mask=mask)
        value.append(posterior.log_prob(params) - posterior.log_prior(params)[0])
        terms = noise.log_likelihood(counts, image - 3.0 + level, 0.0)[mask]
        expected.append(math.fsum(terms))
    assert value == pytest.approx(expected, rel=1e-9)
    # what a step in the level changes is not lost in the sums' constant part
    ours, theirs = np.diff(value), np.diff(expected)
    assert ours == pytest.approx(theirs, rel=1e-8 if r < 1.0 else 1e-6)


WIDE = (12, 1100)  # more columns than are summed at a time
EXTREMES: dict[str, Any] = {
    "one": 0.6,
    "map": RNG.uniform(1.0, 3.0, WIDE),
    "a very noisy pixel": np.where(np.arange(1100) == 600, 1e6, 2.0) * np.ones(WIDE),
    "an almost noiseless pixel": np.where(np.arange(1100) == 600, 0.01, 2.0) * np.ones(WIDE),
    "a map below 1": RNG.uniform(0.05, 0.95, WIDE),
    "a map around 1": RNG.uniform(0.3, 3.0, WIDE),
}


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=() if case == "one" else pytest.mark.slow) for case in EXTREMES],
)
def test_wide_frames_and_extreme_pixels_are_summed_pixel_by_pixel(case: str) -> None:
    sources = SourceCatalog(np.arange(-500.0, 501.0, 50.0), np.zeros(21), np.full(21, 3e3))
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    model = ForwardModel(Detector(WIDE), sources, GaussianPSF(9.0), distortion)
    noise, rng = PoissonNoise(EXTREMES[case]), np.random.default_rng(711)
    for background in (0.05, 5.0, 200.0):
        image = model.expected_counts([0.0, 0.0], background)
        counts = noise.draw(image, 0.0, rng)
        counts[3, 500:520], counts[4, 511:514] = -40.0, 2e4
        mask = rng.random(WIDE) < 0.95
        posterior = Posterior(model, counts, noise=noise, mask=mask)
        params = np.array([0.0, 0.0, background])
        value = posterior.log_prob(params) - posterior.log_prior(params)[0]
        terms = noise.log_likelihood(counts, image, 0.0)[mask]
        assert value == pytest.approx(math.fsum(terms), rel=1e-9)
        assert posterior.log_prob(params * [1.0, 1.0, -1.0]) == -math.inf
        assert np.isfinite(noise.log_likelihood(counts, np.full(WIDE, 1e-12), 0.0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("least", [0.1, 0.9])
def test_counts_that_no_mean_explains_are_summed_as_pixels(least: float) -> None:
    """Four pixels' sums are multiplied before their logarithm is taken, and must not overflow."""
    shape, rng = (21, 48), np.random.default_rng(712)
    source = SourceCatalog([0.0], [0.0], [100.0])
    distortion = PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    model = ForwardModel(Detector(shape), source, GaussianPSF(1.4), distortion)
    noise = PoissonNoise(rng.uniform(least, 0.95, shape))
    counts = noise.draw(model.expected_counts([0.0, 0.0], 5.0), 0.0, rng)
    counts[10, 17:20], counts[10, 28:32] = 2e4, 3e4
    posterior = Posterior(model, counts, noise=noise)
    for background in (1e-3, 1e-20):
        params = np.array([0.0, 0.0, background])
        value = posterior.log_prob(params) - posterior.log_prior(params)[0]
        image = model.expected_counts([0.0, 0.0], background)
        terms = noise.log_likelihood(counts, image, 0.0)
        assert value == pytest.approx(math.fsum(terms.ravel()), rel=1e-9)


NARROW = (13, 1103)  # no multiples of anything
TAIL = np.where(RNG.random(NARROW) < 0.05, RNG.uniform(2.0, 6.0, NARROW), 0.0)
SIDES: dict[str, Floats] = {
    "uniform": RNG.uniform(0.5, 1.5, NARROW),
    "sCMOS": np.maximum(1.1 * np.exp(RNG.normal(0.0, 0.25, NARROW)), TAIL),
    "amplifiers": np.where(np.arange(1103) < 597, 0.7, 2.0) * np.ones(NARROW),
}


@pytest.mark.parametrize("has_flat", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("case", SIDES)
def test_maps_on_both_sides_of_1_are_summed_as_by_scipy(case: str, has_flat: bool) -> None:
    # sources in two corners and on their own, so that what they reach begins and ends anywhere
    x = np.array([-551.0, -300.0, -280.0, 11.0, 551.4])
    sources = SourceCatalog(x, np.array([-6.4, 0.0, 2.0, 1.0, 6.0]), np.full(5, 2e3))
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    model = ForwardModel(Detector(NARROW), sources, GaussianPSF(2.0), distortion)
    rng, r, background = np.random.default_rng(712), SIDES[case], 0.7
    response = rng.uniform(0.5, 1.5, NARROW) if has_flat else np.ones(NARROW)
    own = PoissonNoise(r)
    noise = bf.FlatFieldNoise(own, response) if has_flat else own
    image = model.expected_counts([0.0, 0.0], background)
    counts, mask = own.draw(image * response, 0.0, rng) / response, rng.random(NARROW) < 0.9
    mu, n = (image * response)[mask], (counts * response)[mask]
    terms = special.xlogy(k := np.arange(400.0), mu[:, None]) - mu[:, None] - special.gammaln(k + 1)
    terms -= 0.5 * ((n[:, None] - k) / r[mask][:, None]) ** 2
    exact = special.logsumexp(terms, axis=1) - np.log(r[mask] * math.sqrt(2.0 * math.pi))
    exact += np.log(response[mask])
    posterior = Posterior(model, counts, noise=noise, mask=mask)
    params = np.array([0.0, 0.0, background])
    values = posterior.log_prob(np.tile(params, (4, 1))) - posterior.log_prior(params)[0]
    assert values == pytest.approx(math.fsum(exact), abs=1e-5 * np.count_nonzero(r[mask] >= 1.0))
    assert np.ptp(values) == 0.0  # whichever thread evaluates it
    assert np.abs(exact).max() > 1.0 and np.abs(exact).min() > 0.2  # a pixel's part would be seen


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", [pytest.param(k, marks=[pytest.mark.long] * (k == "map")) for k in FRAMES]
)
def test_gradient_is_that_of_log_prob(case: str) -> None:
    posterior, truth = frame(case)
    scale = errors(posterior, truth)
    params = truth + 0.5 * scale * np.random.default_rng(702).uniform(-1, 1, truth.size)
    numerical = np.array(
        [five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(truth.size)]
    )
    assert posterior.gradient(params) * scale == pytest.approx(
        numerical * scale, rel=2e-6, abs=2e-6
    )


@pytest.mark.slow
def test_map_of_equal_read_noises_is_one_read_noise() -> None:
    posterior, params = frame("large")
    equal = Posterior(
        posterior.model,
        posterior.counts,
        noise=PoissonNoise(np.full(SHAPE, 2.0)),
        mask=posterior.mask,
        nuisances=posterior.nuisances,
    )
    assert equal.log_prob(params) == pytest.approx(posterior.log_prob(params), abs=1e-8)
    assert equal.fisher(params) == pytest.approx(posterior.fisher(params), rel=1e-9)
    fit, fit_equal = fit_statistics(posterior, params), fit_statistics(equal, params)
    assert fit == pytest.approx(fit_equal, rel=1e-9)


def test_gain_map_is_applied_before() -> None:
    # adu of a detector whose amplifiers differ: in electrons the frame is one of this model
    rng, gain = np.random.default_rng(703), np.where(np.arange(SHAPE[1]) < 37, 0.8, 2.5)
    electrons = rng.poisson(5.0, SHAPE) + rng.normal(0.0, 3.0 * gain, SHAPE)
    adu = 100.0 + electrons / gain
    noise = PoissonNoise(np.broadcast_to(3.0 * gain, SHAPE))
    converted = (adu - 100.0) * gain
    residual = noise.residual(converted, np.full(SHAPE, 5.0), 5.0)
    assert np.mean(residual**2) == pytest.approx(1.0, abs=4.0 * math.sqrt(2.1 / residual.size))


@pytest.mark.parametrize(
    ("read_noise", "line"),
    [
        (np.zeros(SHAPE), "got 0 in 4500 pixels"),
        (-np.ones(SHAPE), "got -1 in 4500 pixels"),
        ("many", "got no numbers"),
        (np.ones((3, 4)), r"got shape \(3, 4\)"),
    ],
)
def test_maps_are_checked(read_noise: Any, line: str) -> None:
    with pytest.raises(InputError, match=f"read_noise: {line}"):
        Posterior(make_model(), np.ones(SHAPE), noise=PoissonNoise(read_noise))


# --- verdicts -------------------------------------------------------------------------------------


def false_alarms(r: float, background: float, frames: int, law: str = "own") -> int:
    """In how many frames of sky whose level is fitted the deviance is 3 sd too high."""
    rng, noise, size = np.random.default_rng(704), PoissonNoise(r), 4000
    mean = np.full(size, background)
    alarms = 0
    for _ in range(frames):
        n = noise.draw(np.zeros(size), mean, rng)
        if law == "shifted":
            positive = n + r * r
            deviance = 2.0 * (
                special.xlogy(positive, np.maximum(positive, 0.0) / (background + r * r))
                - n
                + background
            )
            moments = 1.0 + 1.0 / (6.0 * (background + r * r))
            alarms += int((deviance.sum() - size * moments) / math.sqrt(2.0 * size) > 3.0)
            continue
        level = background
        for _ in range(8):  # scoring
            at = np.full(size, level)
            known = noise.fisher_weight(at[:1], level)[0]
            level = max(level + noise.score(n, at, level).sum() / (size * known), 1e-6)
        at = np.full(size, level)
        expected, variance, slope = (each[0] for each in noise.deviance_moments(at[:1], level))
        left = variance - slope**2 / noise.fisher_weight(at[:1], level)[0]
        excess = noise.deviance(n, at, level).sum() - size * expected + 1.0
        alarms += int(excess / math.sqrt(size * left) > 3.0)
    return alarms


@pytest.mark.parametrize("r", [0.3, 1.0, 3.0, 10.0])
def test_true_models_are_not_declared_misfits(r: float) -> None:
    # at 3 sd 0.13 % are expected of a normal statistic; 2 of 30 have a probability below 1e-3
    assert false_alarms(r, 5.0, 30) < 2


def test_shifted_poisson_would_be_declared_a_misfit() -> None:
    # the negative control: it is infinite in every frame
    assert false_alarms(1.0, 0.05, 10, "shifted") == 10


@pytest.mark.statistics
@pytest.mark.parametrize("r", [0.3, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("background", [0.05, 5.0, 50.0])
def test_false_alarms_are_at_most_one_per_cent(r: float, background: float) -> None:
    # 300 frames at a true rate of 0.5 % give more than 5 with a probability of 0.4 %
    assert false_alarms(r, background, 300) <= 5


def test_verdict_of_a_fitted_frame() -> None:
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    sources = SourceCatalog.grid(4, 14.0, 2e3)
    model = ForwardModel(Detector(SHAPE), sources, GaussianPSF(2.0), distortion)
    noise = PoissonNoise(2.0)
    for background in (0.05, 5.0):
        counts = simulate(model, [1e-4, -1e-4], background, seed=705, noise=noise)
        posterior = Posterior(model, counts, noise=noise)
        best = find_map(posterior)
        assert best.at_maximum
        assert abs(misfit(fit_statistics(posterior, best.params))) < 4.0


@pytest.mark.statistics
def test_compare_prefers_the_true_read_noise() -> None:
    model = make_model(SourceCatalog.grid(3, 17.0, 2e3), sigma=2.0, tolerance=1e-8)
    truth = np.zeros(12)
    counts = simulate(model, truth, 5.0, seed=706, noise=PoissonNoise(2.0))
    chains = {}
    for r in (0.3, 2.0, 3.0):
        posterior = Posterior(model, counts, noise=PoissonNoise(r))
        chains[f"{r:g}"] = sample(posterior, seed=707, steps=40, progress=False)
    result = bf.compare(chains)
    assert result.scores[0].name == "2"
    behind = {score.name: score.difference / score.difference_se for score in result.scores[1:]}
    assert min(behind.values()) > 4.0


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("read_noise", [0.0, 2.0, MAP])
def test_chains_of_the_shifted_poisson_are_refused(read_noise: Any, tmp_path: Path) -> None:
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    sources = SourceCatalog.grid(4, 14.0, 2e4)
    model = ForwardModel(Detector(SHAPE), sources, GaussianPSF(2.0), distortion)
    noise, path = PoissonNoise(read_noise), tmp_path / "chain.h5"
    counts = simulate(model, [1e-4, -1e-4], 3.0, seed=708, noise=noise)
    posterior = Posterior(model, counts, noise=noise)
    sample(posterior, seed=709, path=path, steps=4, progress=False)
    again = open_chain(path).posterior()
    params = np.array([1e-4, -1e-4, 3.0])
    assert again.noise == noise and again.log_prob(params) == posterior.log_prob(params)
    if np.ndim(read_noise):
        return  # schema 3 had no maps
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = 3
    reseal(path)
    if read_noise:
        with pytest.raises(InputError, match=r"got read noise 2 as the shifted Poisson .* sample"):
            open_chain(path)
    else:
        assert open_chain(path).posterior().noise == noise
