"""Noise that pixels share: the likelihood's power, and whether errors hold with it."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_cli import invoke
from test_model import make_posterior, make_truth
from test_model_derivatives import STEP, errors, five_point, full_information, touching
from test_pipeline_frames import write

import bayesfred as bf
from bayesfred.analysis.residuals import judge_residuals
from bayesfred.analysis.sources import fit_sources
from bayesfred.analysis.verdict import judge_fit
from bayesfred.errors import InputError
from bayesfred.model.noise import Noise
from bayesfred.model.parameters import Nuisances
from bayesfred.optimize.fit_statistics import fit_statistics

Floats = NDArray[np.float64]

SHAPE = (60, 75)
RATIO = 1.5
RNG = np.random.default_rng(930)
PIXELWISE: dict[str, Noise] = {
    "photons": bf.PoissonNoise(),
    "read noise": bf.PoissonNoise(2.0),
    "flat": bf.FlatFieldNoise(bf.PoissonNoise(1.5), RNG.uniform(0.5, 1.5, SHAPE)),
    "variance": bf.GaussianNoise(RNG.uniform(3.0, 9.0, SHAPE)),
    "background": bf.BackgroundNoise(),
    "subtracted": bf.SubtractedNoise(bf.PoissonNoise(1.0), RNG.uniform(0.0, 30.0, SHAPE)),
}


def pair(case: str, nuisances: Nuisances) -> tuple[bf.Posterior, bf.Posterior, Floats]:
    """A frame with a tenth masked, taken for independent pixels and not; the true parameters."""
    rng, model = np.random.default_rng(931), touching()
    mask, truth = rng.random(SHAPE) < 0.9, make_truth(model, rng, 3.0)
    plain, params = make_posterior(model, truth, rng, nuisances, PIXELWISE[case], mask=mask)
    return plain, replace(plain, noise=bf.CorrelatedNoise(PIXELWISE[case], RATIO)), params


def log_likelihood(posterior: bf.Posterior, params: Floats) -> float:
    return posterior.log_prob(params) - posterior.log_prior(params)[0]


@pytest.mark.parametrize("case", PIXELWISE)
def test_the_likelihood_of_fixed_fluxes_is_a_power_of_that_of_independent_pixels(case: str) -> None:
    plain, shared, params = pair(case, Nuisances("scale"))
    power = RATIO**-2
    assert log_likelihood(shared, params) == pytest.approx(
        power * log_likelihood(plain, params), rel=1e-13
    )
    information = plain.fisher(params)
    assert shared.fisher(params) == pytest.approx(
        power * information, rel=1e-11, abs=1e-12 * np.abs(information).max()
    )
    params[plain.parameter_names.index("background")] = -1.0
    assert shared.log_prob(params) == -math.inf


@pytest.mark.slow
@pytest.mark.parametrize("case", ["photons", "read noise"])
def test_a_model_error_is_shared_as_the_noise_is(case: str) -> None:
    plain, shared, params = pair(case, Nuisances("scale", model_error=True))
    assert log_likelihood(shared, params) == pytest.approx(
        RATIO**-2 * log_likelihood(plain, params), rel=1e-13
    )
    k = plain.parameter_names.index("model_error")
    assert params[k] > 0.0
    assert shared.fisher(params)[k, k] == pytest.approx(plain.fisher(params)[k, k] / RATIO**2)
    assert shared.sigma(params) == pytest.approx(plain.sigma(params), rel=1e-14)


@pytest.mark.parametrize(
    ("case", "nuisances"),
    [
        ("photons", Nuisances("scale", background_order=1)),
        pytest.param("background", Nuisances("scale"), marks=pytest.mark.slow),
        pytest.param("photons", Nuisances("free", offset=True), marks=pytest.mark.slow),
        pytest.param("read noise", Nuisances("free", model_error=True), marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_log_prob(case: str, nuisances: Nuisances) -> None:
    _, posterior, params = pair(case, nuisances)
    scale = errors(posterior, params)
    if nuisances.flux != "free" and case != "background":
        expected = full_information(posterior, params, None) * np.outer(scale, scale)
        assert posterior.fisher(params) * np.outer(scale, scale) == pytest.approx(
            expected, abs=1e-5
        )
    params += 0.5 * scale * np.random.default_rng(932).uniform(-1, 1, params.size)
    numerical = [
        five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(params.size)
    ]
    assert posterior.gradient(params) * scale == pytest.approx(
        np.array(numerical) * scale, rel=2e-6, abs=2e-6
    )


def test_free_fluxes_have_the_power_for_their_likelihood_and_not_for_their_prior() -> None:
    """One source: log of the integral over its flux, by quadrature."""
    model = bf.ForwardModel(
        bf.Detector((15, 15)), bf.SourceCatalog([0.3], [-0.2], [400.0]), bf.GaussianPSF(1.5),
        bf.PolynomialDistortion([(1, 0, 1, 0)], []),
    )  # fmt: skip
    counts, noise = (
        bf.simulate(model, [0.0], 2.0, seed=933),
        bf.CorrelatedNoise(bf.PoissonNoise(), RATIO),
    )
    free = Nuisances("free")
    params = np.array([1e-4, 2.1])
    template = (model.expected_counts(params[:1], 2.1) - 2.1) / 400.0
    flux = np.linspace(250.0, 650.0, 4001)
    each = np.array([noise.log_likelihood(counts, f * template + 2.1, 2.1).sum() for f in flux])
    shape = free.flux_shape
    prior = (
        (shape - 1.0) * np.log(flux) - shape * flux / 400.0
        + shape * math.log(shape / 400.0) - math.lgamma(shape)
    )  # fmt: skip
    top = (each + prior).max()
    exact = top + math.log(np.trapezoid(np.exp(each + prior - top), flux))
    found = log_likelihood(bf.Posterior(model, counts, noise=noise, nuisances=free), params)
    assert found == pytest.approx(exact, abs=2e-3)
    # the control: a power of the whole integral
    plain = bf.Posterior(model, counts, nuisances=free)
    assert abs(log_likelihood(plain, params) / RATIO**2 - exact) > 0.5


@pytest.mark.parametrize("case", PIXELWISE)
def test_a_pixel_by_itself_is_as_before(case: str) -> None:
    before, mean = PIXELWISE[case], np.full(SHAPE, 4.0)
    noise = bf.CorrelatedNoise(before, RATIO)
    counts = before.draw(np.zeros(SHAPE), mean, np.random.default_rng(934))
    assert np.array_equal(counts, noise.draw(np.zeros(SHAPE), mean, np.random.default_rng(934)))
    for name in ("residual", "deviance"):
        ours, theirs = (getattr(n, name)(counts, mean, 4.0) for n in (noise, before))
        assert np.array_equal(ours, theirs)
    assert np.array_equal(noise.pearson_variance(mean, 4.0), before.pearson_variance(mean, 4.0))
    for name, power in (("fisher_weight", -2), ("counts_variance", 2)):
        ours, theirs = (getattr(n, name)(mean, 4.0) for n in (noise, before))
        assert ours == pytest.approx(RATIO**power * theirs, rel=1e-14)
    assert noise.score(counts, mean, 4.0) * RATIO**2 == pytest.approx(
        before.score(counts, mean, 4.0), rel=1e-14
    )


@pytest.mark.slow
def test_sums_over_pixels_are_those_of_independent_ones() -> None:
    plain, shared, params = pair("read noise", Nuisances("free", model_error=True))
    one, other = (fit_statistics(posterior, params) for posterior in (plain, shared))
    for name in ("deviance", "deviance_sd", "pearson", "pearson_sd"):
        assert other[name] == pytest.approx(one[name], rel=1e-4), name
    errors_of = [fit_sources(posterior, params) for posterior in (plain, shared)]
    assert errors_of[0].expected == pytest.approx(errors_of[1].expected, rel=0.05)


# --- errors that hold -----------------------------------------------------------------------------


def smoothed(z: Floats) -> Floats:
    """Resampled half-way between pixels, of unit variance."""
    for axis in (0, 1):
        z = 0.5 * (z + np.roll(z, 1, axis))
    return 2.0 * z


def resampled(seed: int) -> tuple[bf.Posterior, Floats]:
    """A frame whose pixels share noise, and its true distortion."""
    rng, terms = np.random.default_rng([935, seed]), bf.PolynomialDistortion.polynomial(2)
    model = bf.ForwardModel(
        bf.Detector((80, 90)), bf.SourceCatalog.grid(4, 18.0, 2e4), bf.GaussianPSF(1.4), terms
    )
    theta = rng.normal(0.0, 1e-4, terms.n_terms)
    mean = model.expected_counts(theta, 30.0)
    counts = mean + np.sqrt(mean) * smoothed(rng.standard_normal(mean.shape))
    # the least read noise is for counts that are no whole numbers
    return bf.Posterior(
        model, counts, noise=bf.PoissonNoise(0.1), nuisances=Nuisances("free")
    ), theta


def judged(posterior: bf.Posterior) -> Any:
    best = bf.find_map(posterior)
    residuals = judge_residuals(posterior, best.params, best.covariance)
    fit = fit_statistics(posterior, best.params)
    return judge_fit(posterior, best, fit, residuals), residuals.shared


@pytest.mark.slow
def test_errors_hold_with_the_ratio_that_the_verdict_tells() -> None:
    """60 frames of 10 coefficients: shares within 4 Monte Carlo errors, correlated ones included.

    The control: independent pixels, whose errors hold in 43 % and 73 %.
    """
    pulls = np.empty((60, 2, 10))
    ratios = []
    for k, pull in enumerate(pulls):
        posterior, theta = resampled(k)
        if k < 3:
            _, shared = judged(posterior)
            ratios.append(shared.ratio)
        correlated = replace(
            posterior, noise=bf.CorrelatedNoise(posterior.noise, round(ratios[0], 2))
        )
        for row, one in zip(pull, (posterior, correlated), strict=True):
            best = bf.find_map(one)
            row[:] = (best.params[:10] - theta) / np.sqrt(np.diag(best.covariance)[:10])
    assert ratios == pytest.approx([1.76] * 3, rel=0.05)
    for bound, share, without in ((1.0, 0.683, 0.43), (1.96, 0.95, 0.73)):
        within = np.mean(np.abs(pulls) < bound, axis=2)  # by frame
        error = 4.0 * within.std(axis=0) / len(pulls) ** 0.5
        held = within.mean(axis=0)
        assert abs(held[1] - share) < error[1], held
        assert abs(held[0] - without) < error[0] and share - held[0] > 2.0 * error[0], held


def test_the_verdict_asks_for_the_ratio_and_is_content_with_it() -> None:
    posterior, _ = resampled(0)
    verdict, shared = judged(posterior)
    assert not verdict.fits_data
    (cause,) = verdict.causes
    assert cause.name == "correlated pixels"
    value = f"{shared.ratio:.2g}"
    assert cause.remedy.startswith(f"set frame.noise_correlation_ratio = {value}, or fit")
    verdict, shared = judged(
        replace(posterior, noise=bf.CorrelatedNoise(posterior.noise, float(value)))
    )
    assert verdict.fits_data and shared is None


@pytest.mark.parametrize("ratio", [1.4, 2.2, 3.1])
def test_a_wrong_ratio_is_told(ratio: float) -> None:
    """Also one that is the square of the true one."""
    posterior, _ = resampled(1)
    verdict, shared = judged(replace(posterior, noise=bf.CorrelatedNoise(posterior.noise, ratio)))
    assert shared is not None and shared.known == ratio
    assert not verdict.fits_data
    assert f"independent pixels, not {ratio:g} times" in verdict.causes[0].sentence


def test_independent_pixels_are_not_taken_for_correlated_ones() -> None:
    posterior, theta = resampled(2)
    counts = bf.simulate(posterior.model, theta, 30.0, seed=936)
    verdict, shared = judged(replace(posterior, counts=counts))
    assert verdict.fits_data and shared is None
    noise = bf.CorrelatedNoise(posterior.noise, 1.3)
    verdict, shared = judged(replace(posterior, counts=counts, noise=noise))
    assert not verdict.fits_data and shared.ratio == pytest.approx(1.0, abs=0.05)


# --- what is refused, and what others see ---------------------------------------------------------


@pytest.mark.parametrize(
    ("noise", "ratio", "line"),
    [
        (bf.PoissonNoise(), 0.0, "ratio: got 0.0, expected a number from 0.1 to 10"),
        (bf.PoissonNoise(), 11.0, "ratio: got 11.0"),
        (bf.PoissonNoise(), math.nan, "ratio: got nan"),
        (bf.PoissonNoise(), "1.2", "ratio: got '1.2'"),
        (1.0, 1.2, "noise: got float, expected that of every pixel"),
        (bf.CorrelatedNoise(bf.PoissonNoise(), 1.2), 1.2, "noise: got CorrelatedNoise"),
    ],
)
def test_arguments_are_checked(noise: Any, ratio: Any, line: str) -> None:
    with pytest.raises(InputError, match=f"noise: {line}"):
        bf.CorrelatedNoise(noise, ratio)


def test_studies_and_comparisons_refuse_it(tmp_path: Path) -> None:
    posterior, theta = resampled(3)
    noise = bf.CorrelatedNoise(bf.PoissonNoise(), 1.2)
    with pytest.raises(InputError, match="noise study: noise: got CorrelatedNoise, expected that"):
        bf.noise_study(
            posterior.model, theta, [30.0], noise=noise, replicates=2, path=tmp_path / "n.ecsv",
            seed=1,
        )  # fmt: skip
    with pytest.raises(InputError, match="calibration: noise: got CorrelatedNoise"):
        bf.simulation_based_calibration(
            replace(posterior, noise=noise), replicates=2, path=tmp_path / "s.ecsv", seed=1
        )
    chains = {}
    for name, one in (
        ("plain", posterior.noise),
        ("shared", bf.CorrelatedNoise(posterior.noise, 1.2)),
    ):
        other = replace(posterior, noise=one)
        chains[name] = bf.laplace(other, bf.find_map(other), draws=500, seed=1)
    with pytest.raises(
        InputError, match=r"noise: got a correlation ratio of 1\.2, and 1 for plain"
    ):
        bf.compare(chains)


def test_run_file(tmp_path: Path) -> None:
    run = write(tmp_path, '[nuisances]\nflux = "free"\n')
    text = run.read_text()
    for key, code in (("noise_correlation_ratio = 1.3", 0), ("noise_correlation_ratio = 0.0", 2)):
        run.write_text(text.replace('"frame.fits"', f'"frame.fits"\n{key}'))
        output = invoke(tmp_path, "fit", "run.toml", "--map-only", "--overwrite")
        assert (output.code == 2) == (code == 2)
        if code:
            assert output.stderr.count("\n") == 1
            assert "frame.noise_correlation_ratio: got 0" in output.stderr
            continue
        chain = bf.open_chain(tmp_path / "chains" / "run.h5")
        noise = chain.posterior().noise
        assert noise == bf.CorrelatedNoise(noise.pixelwise, 1.3)
        assert hash(noise) == hash(bf.CorrelatedNoise(noise.pixelwise, 1.3))
        page = (tmp_path / "chains" / "run.html").read_text()
        assert "noise, noise correlation ratio 1.3" in page
        # these frames have independent pixels
        assert output.code == 3 and "share noise" in output.stdout


def test_structure_of_the_background_is_subtracted_below_it() -> None:
    posterior, _ = resampled(4)
    posterior = bf.follow_images(
        replace(
            posterior, nuisances=Nuisances("free", footprint=6.0),
            noise=bf.CorrelatedNoise(posterior.noise, 1.7),
        )
    )  # fmt: skip
    even = bf.subtract_background(posterior, bf.find_map(posterior), 6.0)
    assert isinstance(even.noise, bf.CorrelatedNoise) and even.noise.ratio == 1.7
    assert isinstance(even.noise.pixelwise, bf.SubtractedNoise)
    assert even.noise.pixelwise.noise == posterior.noise.pixelwise
