"""Counts from which known light was subtracted: the likelihood is that of the counts before."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_model import background_image, dense_image, make_posterior, make_truth
from test_model_derivatives import STEP, errors, five_point, full_information, touching

import bayesfred as bf
from bayesfred.errors import InputError
from bayesfred.model.noise import Noise
from bayesfred.model.parameters import Nuisances

Floats = NDArray[np.float64]

SHAPE = (60, 75)
RNG = np.random.default_rng(910)
LIGHT = RNG.uniform(0.0, 30.0, SHAPE)
BEFORE: dict[str, Any] = {
    "photons": bf.PoissonNoise(),
    "read noise": bf.PoissonNoise(2.0),
    "flat": bf.FlatFieldNoise(bf.PoissonNoise(1.5), RNG.uniform(0.5, 1.5, SHAPE)),
}


def frame(case: str, nuisances: Nuisances) -> tuple[bf.Posterior, Floats]:
    """A frame of which a tenth is masked, and the true parameters."""
    rng, model = np.random.default_rng(911), touching()
    mask = rng.random(SHAPE) < 0.9
    noise = bf.SubtractedNoise(BEFORE[case], LIGHT)
    truth = make_truth(model, rng, 3.0)
    return make_posterior(model, truth, rng, nuisances, noise, mask=mask)


@pytest.mark.parametrize("case", BEFORE)
def test_log_prob_is_that_of_the_counts_before(case: str) -> None:
    posterior, params = frame(case, Nuisances("scale", offset=True))
    named = dict(zip(posterior.parameter_names, params, strict=True))
    mean = dense_image(posterior.model, named) + background_image(SHAPE, named) + LIGHT
    before: Noise = BEFORE[case]
    expected = before.log_likelihood(posterior.counts + LIGHT, mean, 0.0)[posterior.mask].sum()
    value = posterior.log_prob(params) - posterior.log_prior(params)[0]
    assert value == pytest.approx(float(expected), rel=1e-11)
    params[posterior.parameter_names.index("background")] = -1.0
    assert posterior.log_prob(params) == -math.inf


@pytest.mark.slow
def test_model_error_is_beside_the_variance_of_the_counts_before() -> None:
    posterior, params = frame("photons", Nuisances("scale", model_error=True))
    named = dict(zip(posterior.parameter_names, params, strict=True))
    light, level = dense_image(posterior.model, named), named["background"]
    wrong = (named["model_error"] * light) ** 2
    before, mean = bf.PoissonNoise(), light + level + LIGHT
    counts = posterior.counts + LIGHT
    top = before.log_likelihood(counts, np.maximum(counts, 1e-12), 0.0)
    lost = top - before.log_likelihood(counts, mean, 0.0)
    share = mean / (mean + wrong)  # the double Poisson distribution, whose variance that is
    expected = (top + 0.5 * np.log(share) - lost * share)[posterior.mask].sum()
    value = posterior.log_prob(params) - posterior.log_prior(params)[0]
    assert named["model_error"] > 0.0
    assert value == pytest.approx(float(expected), rel=1e-10)


@pytest.mark.parametrize(
    ("case", "nuisances"),
    [
        ("photons", Nuisances("scale", background_order=1)),
        pytest.param("flat", Nuisances("scale", psf_sigma=True), marks=pytest.mark.slow),
        pytest.param("photons", Nuisances("free", offset=True), marks=pytest.mark.slow),
        pytest.param("read noise", Nuisances("free", model_error=True), marks=pytest.mark.slow),
    ],
)
def test_derivatives_are_those_of_log_prob(case: str, nuisances: Nuisances) -> None:
    posterior, params = frame(case, nuisances)
    scale = errors(posterior, params)
    if nuisances.flux != "free":
        expected = full_information(posterior, params, None) * np.outer(scale, scale)
        assert posterior.fisher(params) * np.outer(scale, scale) == pytest.approx(
            expected, abs=1e-5
        )
    params += 0.5 * scale * np.random.default_rng(912).uniform(-1, 1, params.size)
    numerical = [
        five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(params.size)
    ]
    assert posterior.gradient(params) * scale == pytest.approx(
        np.array(numerical) * scale, rel=2e-6, abs=2e-6
    )


@pytest.mark.parametrize("case", BEFORE)
def test_no_light_is_no_change(case: str) -> None:
    before: Noise = BEFORE[case]
    noise, mean = bf.SubtractedNoise(BEFORE[case], np.zeros(SHAPE)), np.full(SHAPE, 4.0)
    counts = before.draw(np.zeros(SHAPE), mean, np.random.default_rng(913))
    for name in ("log_likelihood", "score", "deviance"):
        ours, theirs = (getattr(n, name)(counts, mean, 0.0) for n in (noise, before))
        assert ours == pytest.approx(theirs, rel=1e-14)
    for name in ("fisher_weight", "counts_variance", "pearson_variance"):
        ours, theirs = (getattr(n, name)(mean, 0.0) for n in (noise, before))
        assert ours == pytest.approx(theirs, rel=1e-14)


def test_law_of_the_counts() -> None:
    """The probabilities add up to 1, with the mean, variance, information and moments stated."""
    b, mu = 5.5, 2.0  # what was subtracted need not be a whole number
    n = np.arange(80.0) - b
    law, at = bf.SubtractedNoise(bf.PoissonNoise(), np.full(80, b)), np.full(80, mu)
    one, noise = np.array([mu]), bf.SubtractedNoise(bf.PoissonNoise(), [b])
    chance = np.exp(law.log_likelihood(n, at, 0.0))
    assert law.discrete and chance.sum() == pytest.approx(1.0, abs=1e-12)
    assert chance @ n == pytest.approx(mu, abs=1e-12)
    assert chance @ (n - mu) ** 2 == pytest.approx(noise.counts_variance(one, 0.0)[0], rel=1e-12)
    score = law.score(n, at, 0.0)
    assert chance @ score**2 == pytest.approx(noise.fisher_weight(one, 0.0)[0], rel=1e-12)
    deviance = law.deviance(n, at, 0.0)
    mean, variance, slope = (each[0] for each in noise.deviance_moments(one, 0.0))
    assert chance @ deviance == pytest.approx(mean, rel=3e-4)
    assert chance @ (deviance - mean) ** 2 == pytest.approx(variance, rel=1e-3)
    assert chance @ (deviance * score) == pytest.approx(slope, abs=2e-3)
    below, upto = law.cumulative(n, at, 0.0, 1e-9)
    assert np.cumsum(chance) == pytest.approx(upto, abs=1e-12)
    assert upto - below == pytest.approx(chance, abs=1e-12)


def test_draws_have_the_right_moments() -> None:
    noise = bf.SubtractedNoise(bf.PoissonNoise(1.5), np.full(100_000, 7.0))
    counts = noise.draw(np.full(100_000, 1.0), 4.0, np.random.default_rng(914))
    variance = 12.0 + 1.5**2
    assert counts.mean() == pytest.approx(5.0, abs=4.0 * math.sqrt(variance / counts.size))
    assert counts.var() == pytest.approx(variance, rel=4.0 * math.sqrt(2.1 / counts.size))


@pytest.mark.parametrize(
    ("light", "line"),
    [
        (-LIGHT, "got -"),
        (np.where(LIGHT > 15.0, np.nan, 1.0), "got nan in"),
        (1.0, "got 1 in 1 pixels, expected an array"),
        ("light", "got no numbers"),
        (np.ones((3, 4)), r"got shape \(3, 4\), expected the frame's shape"),
    ],
)
def test_light_is_checked(light: Any, line: str) -> None:
    with pytest.raises(InputError, match=f"light: {line}"):
        bf.Posterior(touching(), np.ones(SHAPE), noise=bf.SubtractedNoise(bf.PoissonNoise(), light))


def test_other_noise_is_refused() -> None:
    with pytest.raises(InputError, match="got GaussianNoise with known light"):
        bf.SubtractedNoise(bf.GaussianNoise(1.0), LIGHT)  # type: ignore[arg-type]


def test_it_is_stored_with_a_chain(tmp_path: Path) -> None:
    rng, sources = np.random.default_rng(915), bf.SourceCatalog.grid(3, 14.0, 2e3)
    model = bf.ForwardModel(
        bf.Detector(SHAPE), sources, bf.GaussianPSF(2.0),
        bf.PolynomialDistortion([(1, 0, 1, 0)], []),
    )  # fmt: skip
    noise = bf.SubtractedNoise(BEFORE["flat"], LIGHT)
    counts = noise.draw(model.expected_counts([1e-4]), 3.0, rng)
    posterior, params = bf.Posterior(model, counts, noise=noise), np.array([1e-4, 3.0])
    best = bf.find_map(posterior, params)
    bf.laplace(posterior, best, path=tmp_path / "one.h5", draws=20, seed=1)
    again = bf.open_chain(tmp_path / "one.h5").posterior()
    assert again.noise == posterior.noise != bf.SubtractedNoise(BEFORE["flat"], LIGHT + 1.0)
    assert hash(again.noise) == hash(posterior.noise)
    assert again.log_prob(params) == posterior.log_prob(params)
