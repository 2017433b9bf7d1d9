"""The model error: density, frames, derivatives, files, and errors that hold with a wrong PSF.

Negative controls are the same noise without it.
"""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from test_model import LIMIT, background_image, dense_image, make_model, make_posterior, make_truth
from test_model_derivatives import STEP, errors, five_point, touching
from test_sampling_chain import reseal

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import (
    BackgroundNoise,
    GaussianNoise,
    ModelErrorNoise,
    PoissonNoise,
    simulate,
)
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import OccamFactor, PsfErrors
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

SHAPE = (60, 75)


@pytest.mark.parametrize("error", [0.01, 0.03, 0.1])
@pytest.mark.parametrize("light", [0.1, 3.0, 100.0, 3e4])
def test_density_of_photons_is_a_distribution_of_the_stated_variance(
    error: float, light: float
) -> None:
    for background in (0.01, 1.0, 100.0):
        mean, variance = light + background, light + background + (error * light) ** 2
        reach = 12.0 * math.sqrt(variance) + 30.0
        n = np.arange(max(0.0, math.floor(mean - reach)), mean + reach)
        noise, at = ModelErrorNoise(PoissonNoise(), error), np.full(n.size, mean)
        chance = np.exp(noise.log_likelihood(n, at, background))
        assert chance.sum() == pytest.approx(1.0, abs=0.15 * error**2 + 1e-9)
        chance /= chance.sum()
        assert chance @ n == pytest.approx(mean, abs=0.1 * error**2 * math.sqrt(variance) + 1e-9)
        assert chance @ (n - mean) ** 2 == pytest.approx(variance, rel=0.2 * error**2 + 1e-9)
        assert noise.counts_variance(at[:1], background) == pytest.approx(variance)


def test_density_is_that_of_gaussian_noise_and_without_an_error_that_of_the_noise() -> None:
    n, mean = np.array([3.0, 90.0, 700.0]), np.array([5.0, 100.0, 800.0])
    wide = stats.norm(mean, np.sqrt(9.0 + (0.05 * (mean - 5.0)) ** 2)).logpdf(n)
    noise = ModelErrorNoise(GaussianNoise(9.0), 0.05)
    assert noise.log_likelihood(n, mean, 5.0) == pytest.approx(wide, rel=1e-12)
    for own in (PoissonNoise(), PoissonNoise(2.0), GaussianNoise(9.0)):
        none = ModelErrorNoise(own, 0.0)
        assert none.log_likelihood(n, mean, 5.0) == pytest.approx(
            own.log_likelihood(n, mean, 5.0), rel=1e-14
        )
        assert none.deviance(n, mean, 5.0) == pytest.approx(own.deviance(n, mean, 5.0), rel=1e-14)


@pytest.mark.parametrize("own", [PoissonNoise(), PoissonNoise(3.0), GaussianNoise(30.0)])
def test_drawn_counts_have_the_moments_that_judge_them(own: Any) -> None:
    rng, error, size = np.random.default_rng(720), 0.05, 40_000
    noise = ModelErrorNoise(own, error)
    for light, level in ((0.0, 5.0), (30.0, 5.0), (2e3, 50.0)):
        mean = np.full(size, light + level)
        n = noise.draw(mean - level, level, rng)
        z = noise.residual(n, mean, level)
        assert abs(np.mean(z**2) - 1.0) < LIMIT * math.sqrt(2.5 / size)
        deviance = noise.deviance(n, mean, level)
        expected, variance, _ = (each[0] for each in noise.deviance_moments(mean[:1], level))
        assert abs(deviance.mean() - expected) < LIMIT * math.sqrt(variance / size) + error**2
        below, upto = noise.cumulative(n, mean, level, 1.0 if noise.discrete else 0.0) or (z, z)
        pit = below + rng.random(size) * (upto - below)
        assert stats.kstest(pit, "uniform").statistic < 1.9 / math.sqrt(size) + error / 10.0
        # negative control: without the error the counts of bright pixels scatter too much
        assert light < 1e3 or np.mean(own.residual(n, mean, level) ** 2) > 2.0


# --- frames ---------------------------------------------------------------------------------------

RICH = Nuisances("scale", offset=True, psf_sigma=True, background_order=1, model_error=True)
CASES: dict[str, tuple[Any, Nuisances, float]] = {
    "photons": (PoissonNoise(), RICH, 0.1),
    "read noise": (PoissonNoise(2.0), Nuisances("scale", model_error=True), 0.1),
    "gaussian": (GaussianNoise(9.0), Nuisances("scale", offset=True, model_error=True), 0.1),
    "free": (PoissonNoise(), Nuisances("free", offset=True, model_error=True), 0.1),
    "scatter": (
        PoissonNoise(),
        Nuisances("free", background_order=1, position_scatter=True, model_error=True),
        0.05,
    ),
}
COSTLY = [pytest.param(case, marks=pytest.mark.long) for case in ("read noise", "gaussian")]
COSTLIER = [pytest.param(case, marks=pytest.mark.long) for case in ("free", "scatter")]


def frame(case: str) -> tuple[Posterior, Floats]:
    """A frame of which a tenth of the pixels are masked."""
    noise, nuisances, error = CASES[case]
    rng, model = np.random.default_rng(701), touching()
    mask = rng.random(SHAPE) < 0.9
    truth = {**make_truth(model, rng, 3.0), "model_error": error}
    truth.setdefault("position_scatter", 0.1)
    return make_posterior(model, truth, rng, nuisances, noise, mask=mask)


@pytest.mark.parametrize("case", ["photons", *COSTLY])
def test_log_prob_is_the_sum_over_all_pixels(case: str) -> None:
    posterior, params = frame(case)
    named = dict(zip(posterior.parameter_names, params, strict=True))
    base = background_image(SHAPE, named)
    mean = dense_image(posterior.model, named) + base
    error = named["model_error"]
    own = posterior.noise
    growth = 1.0 + (error * (mean - base)) ** 2 / own.counts_variance(mean, 0.0)
    lost = 0.5 * own.deviance(posterior.counts, mean, 0.0)
    best = own.log_likelihood(posterior.counts, mean, 0.0) + lost
    terms = (best - lost / growth - 0.5 * np.log(growth))[posterior.mask]
    value = posterior.log_prob(params) - posterior.log_prior(params)[0]
    assert value == pytest.approx(float(terms.sum()), rel=1e-8)
    given = posterior.noise_at(params)
    same = given.log_likelihood(posterior.counts, mean, named["background"])[posterior.mask]
    assert same == pytest.approx(terms, rel=1e-9, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["photons", *COSTLY, *COSTLIER])
def test_gradient_is_that_of_log_prob(case: str) -> None:
    posterior, truth = frame(case)
    scale = errors(posterior, truth)
    params = truth + 0.5 * scale * np.random.default_rng(702).uniform(-1, 1, truth.size)
    numerical = np.array(
        [five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(truth.size)]
    )
    assert posterior.gradient(params) * scale == pytest.approx(
        numerical * scale, rel=1e-6, abs=1e-6
    )


def test_occam_factor_of_a_measured_psf_is_in_density_and_gradient() -> None:
    posterior, params = frame("photons")
    k = posterior.parameter_names.index("model_error")
    occam = OccamFactor(np.array([9.0, 30.0]), np.array([0.03, 0.2]))
    none = np.zeros((params.size, params.size))
    errors = PsfErrors(posterior.parameter_names, none, 39.0, occam)
    other = replace(posterior, psf_errors=errors)
    more = occam.log(params[k])
    assert more == pytest.approx(4.5 * math.log(1 + (0.1 / 0.03) ** 2) + 15 * math.log(1.25))
    assert other.log_prob(params) - posterior.log_prob(params) == pytest.approx(more)
    change = other.gradient(params) - posterior.gradient(params)
    h = 1e-5
    numerical = (occam.log(params[k] + h) - occam.log(params[k] - h)) / (2.0 * h)
    assert change[k] == pytest.approx(numerical, rel=1e-6)
    assert not np.any(np.delete(change, k))
    known, left = posterior.fisher(params)[k, k], other.fisher(params)[k, k]
    slopes = 2.0 * 0.1 / (np.array([0.03, 0.2]) ** 2 + 0.1**2)
    assert known - left == pytest.approx(0.5 * slopes**2 @ [9.0, 30.0])


@pytest.mark.slow
def test_scores_of_drawn_frames_have_the_information_as_covariance() -> None:
    rng, model = np.random.default_rng(721), touching(2e4)
    truth = {**make_truth(model, rng, 3.0), "model_error": 0.08}
    posterior, params = make_posterior(model, truth, rng, RICH)
    prior = posterior.gradient(params) - posterior.likelihood.gradient(params)
    information = posterior.fisher(params)
    squares, own = [], []
    k = posterior.parameter_names.index("model_error")
    for _ in range(200):
        counts = posterior.simulate(params, rng)
        assert counts is not None
        drawn = Posterior(model, counts, nuisances=RICH, prior=posterior.prior)
        score = drawn.gradient(params) - prior
        squares.append(score @ np.linalg.solve(information, score))
        own.append(score[k] / math.sqrt(information[k, k]))
    assert np.mean(squares) == pytest.approx(params.size, abs=4.0 * math.sqrt(params.size / 100.0))
    # the deviances of pixels with few counts have heavier tails than a chi-square: 10 %
    assert np.mean(own) == pytest.approx(0.0, abs=4.0 / math.sqrt(200.0))
    assert np.var(own) == pytest.approx(1.0, abs=0.1 + 4.0 * math.sqrt(2.0 / 200.0))


@pytest.mark.slow
@pytest.mark.parametrize("scatters", [False, pytest.param(True, marks=pytest.mark.long)])
def test_fluxes_and_shifts_take_information_about_the_model_error(scatters: bool) -> None:
    """4000 frames of undersampled sources: the score's variance is known to 2 %.

    The information that the pixels have where fluxes are known, the control, is far more.
    """
    sources = SourceCatalog.grid(6, 9.0, 2e5)
    lens = PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    model = ForwardModel(Detector((61, 61)), sources, GaussianPSF(0.6), lens)
    nuisances = Nuisances("free", model_error=True, position_scatter=scatters)
    posterior = Posterior(model, np.full((61, 61), 10.0), nuisances=nuisances)
    truth = {"f_x": 1e-3, "background": 10.0, "model_error": 0.03, "position_scatter": 0.05}
    params = np.array([truth.get(name, 0.0) for name in posterior.parameter_names])
    k, rng = posterior.parameter_names.index("model_error"), np.random.default_rng(731)
    prior, scores, known = posterior.prior_gradient(params), [], []
    for i in range(4000):
        drawn = replace(posterior, counts=posterior.simulate(params, rng))
        scores.append((drawn.gradient(params) - prior)[k])
        if i < 100:
            known.append(drawn.fisher(params)[k, k])
    light = model.expected_counts(params[:2])
    slopes = 2.0 * 0.03 * light**2 / (light + 10.0 + (0.03 * light) ** 2)
    allowed = 4.0 * math.sqrt(2.0 / 4000.0)
    assert np.var(scores) / np.mean(known) == pytest.approx(1.0, abs=allowed)
    assert np.var(scores) / np.sum(0.5 * slopes**2) < 1.0 - allowed


def test_background_noise_admits_no_model_error() -> None:
    with pytest.raises(InputError, match="model_error: got it with BackgroundNoise, expected Pois"):
        Posterior(
            make_model(), np.ones(SHAPE), noise=BackgroundNoise(),
            nuisances=Nuisances(model_error=True),
        )  # fmt: skip


def test_chain_files_without_the_field_are_read(tmp_path: Path) -> None:
    model = ForwardModel(
        Detector(SHAPE), SourceCatalog.grid(4, 14.0, 2e3), GaussianPSF(2.0),
        PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)]),
    )  # fmt: skip
    posterior = Posterior(model, simulate(model, [1e-4, -1e-4], 3.0, seed=1))
    path = tmp_path / "chain.h5"
    sample(posterior, seed=1, path=path, steps=4, progress=False)
    assert open_chain(path).posterior().nuisances == Nuisances()
    with h5py.File(path, "r+") as file:
        file.attrs["schema"] = 5
        del file["posterior/nuisances"].attrs["model_error"]
    reseal(path)
    assert open_chain(path).posterior().nuisances == Nuisances()
    with h5py.File(path, "r+") as file:  # positions that scattered normally are another density
        file["posterior/nuisances"].attrs["position_scatter"] = True
    reseal(path)
    with pytest.raises(InputError, match="got positions that scatter normally"):
        open_chain(path)


# --- errors that hold -----------------------------------------------------------------------------

TERMS = PolynomialDistortion(
    [(1, 0, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0)], [(0, 1, 0, 0), (2, 1, 0, 0), (0, 3, 0, 0)]
)
FIELD = ForwardModel(
    Detector((128, 128)), SourceCatalog.grid(7, 17.3, 2e4), GaussianPSF(1.5), TERMS
)
THETA = np.array([1e-3, 1e-6, -1e-6, -1e-3, 2e-6, 1e-6])


def pulls(error: float, frames: int, seed: int) -> dict[bool, tuple[Floats, Floats]]:
    """Pulls of the coefficients and their widths, with and without a model error in the fit.

    In every frame the light of each pixel is wrong by a fraction of standard deviation `error`.
    """
    rng = np.random.default_rng(seed)
    light, found = FIELD.expected_counts(THETA, 0.0), {True: [], False: []}
    for _ in range(frames):
        wrong = light * np.maximum(1.0 + error * rng.standard_normal(light.shape), 0.0)
        counts = rng.poisson(wrong + 20.0).astype(float)
        for fitted in (True, False):
            nuisances = Nuisances("free", offset=True, model_error=fitted)
            best = find_map(Posterior(FIELD, counts, nuisances=nuisances))
            sd = np.sqrt(np.diag(best.covariance))[:6]
            found[fitted].append(((best.params[:6] - THETA) / sd, sd))
    return {
        key: tuple(np.array(each) for each in zip(*rows, strict=True))
        for key, rows in found.items()
    }


@pytest.mark.statistics
def test_errors_hold_where_the_light_is_wrong() -> None:
    found = pulls(0.05, 100, 722)
    z = np.abs(found[True][0])
    # 600 pulls, of which the coefficients' are nearly independent: 1.9 % and 0.9 %
    assert np.mean(z < 1.0) == pytest.approx(0.683, abs=0.05)
    assert np.mean(z < 1.96) == pytest.approx(0.95, abs=0.03)
    # negative control: photon noise alone does not explain the errors
    assert np.mean(np.abs(found[False][0]) < 1.0) < 0.60


@pytest.mark.statistics
def test_a_model_error_costs_little_where_there_is_none() -> None:
    found = pulls(0.0, 20, 723)
    assert np.mean(found[True][1] / found[False][1]) < 1.2
    assert np.mean(np.abs(found[True][0]) < 1.0) > 0.6


@pytest.mark.long
def test_most_likely_fluxes_are_found_with_any_model_error():
    """Of stars that touch, with another PSF than theirs, some on the edge of a ghost.

    There the weights are far from second derivatives: full Newton steps found no maximum.
    """
    model = ForwardModel(
        Detector((61, 61), pixel="box"), SourceCatalog.grid(5, 9.0, 1e5), GaussianPSF(1.0),
        PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]),
    )  # fmt: skip
    counts = simulate(model, [0.0, 0.0], 100.0, seed=1)
    counts[:20, :14] += 5e3
    wrong = replace(model, psf=GaussianPSF(1.7))
    posterior = Posterior(wrong, counts, nuisances=Nuisances(flux="free", model_error=True))
    k, prior = posterior.parameter_names.index("model_error"), stats.gamma(2.0, scale=5e4)
    for error in (0.01, 0.03, 0.1, 0.2, 0.3, 0.6, 1.0):
        params = posterior.start()
        params[k] = error
        assert np.isfinite(posterior.log_prob(params)), error
        fluxes = posterior.fluxes(params)
        for s in (0, 12):
            values = []
            for factor in (0.99, 1.0, 1.01):
                given = np.where(np.arange(25) == s, factor * fluxes, fluxes)
                sources = SourceCatalog(model.sources.x, model.sources.y, given)
                fixed = Posterior(
                    replace(wrong, sources=sources), counts,
                    nuisances=Nuisances(flux="fixed", model_error=True),
                )  # fmt: skip
                value = fixed.likelihood.log_likelihood(params[None], np.ones(1, bool))[0]
                values.append(value + prior.logpdf(given[s]) + np.log(given[s]))
            assert values[1] > max(values[0], values[2]), (error, s)
