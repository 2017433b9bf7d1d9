"""The recipe for a noise model: a Gaussian with a variance image, defined in this file alone.

It must agree with `GaussianNoise`, which sums up the pixels that no source reaches; this one leaves
that out, so that every pixel is visited.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from test_model import (
    background_image,
    dense_image,
    flat_priors,
    known,
    make_model,
    make_posterior,
    make_truth,
)
from test_model_derivatives import STEP, errors, five_point

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io import serialize
from bayesfred.model.noise import GaussianNoise, Noise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.fit_statistics import fit_statistics
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

SHAPE = (60, 75)


class VarianceTerms(NamedTuple):
    """-1/2 w (n - mu)^2; w in the frame's padded rows."""

    w: Floats

    @staticmethod
    def log_density(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        return -0.5 * noise.w[p] * (n - mu) * (n - mu)

    @staticmethod
    def derivatives(noise: Any, n: Any, mu: Any, light: Any, p: Any) -> Any:
        return noise.w[p] * (n - mu), noise.w[p], 0.0

    @staticmethod
    def information(noise: Any, mu: Any, light: Any, p: Any) -> Any:
        return noise.w[p]


@dataclass(frozen=True, eq=False)
class VarianceNoise(Noise):
    """Gaussian noise with a variance for every pixel."""

    variance: Floats

    def terms(self, values: Floats) -> VarianceTerms:
        w = np.ones(values.shape)
        w[:, : self.variance.shape[1]] = 1.0 / self.variance
        return VarianceTerms(w.ravel())

    def constant(self, counts: Floats, used: Any) -> float:
        return -0.5 * float(np.sum(np.log(2.0 * np.pi * self.variance[used])))

    def at(self, pixels: Any) -> VarianceNoise:
        return VarianceNoise(self.variance[pixels])

    def draw(self, sources: Floats, background: float | Floats, rng: np.random.Generator) -> Floats:
        return rng.normal(sources + background, np.sqrt(self.variance))

    def log_likelihood(self, counts: Floats, mean: Floats, background: float | Floats) -> Floats:
        return np.asarray(stats.norm(mean, np.sqrt(self.variance)).logpdf(counts))

    def fisher_weight(self, mean: Floats, background: float | Floats) -> Floats:
        return 1.0 / self.variance


VARIANCE = np.random.default_rng(190).uniform(2.0, 30.0, SHAPE)
OWN = VarianceNoise(VARIANCE)
TOUCHING = SourceCatalog([-20.0, -13.0, 20.0], [-5.0, -2.0, 3.0], [4e3, 1.6e3, 2.8e3])
CASES = {
    "fixed": Nuisances(),
    "scale": Nuisances("scale", offset=True, psf_sigma=True, background_order=2),
    "free": Nuisances("free", offset=True),
    "scattered": Nuisances("free", position_scatter=True),
}

# what costs most to compile is among the long runs
NAMES = [
    pytest.param(name, marks=pytest.mark.long if CASES[name].flux == "free" else ())
    for name in CASES
]


def made(case: str, noise: Noise = OWN) -> tuple[Posterior, Floats]:
    """A frame with this noise and a tenth of its pixels masked, and the true parameters."""
    rng = np.random.default_rng(191)
    model = make_model(TOUCHING, sigma=2.0, tolerance=1e-10)
    truth = make_truth(model, rng) | {"position_scatter": 0.1}
    mask = rng.random(SHAPE) < 0.9
    return make_posterior(model, truth, rng, CASES[case], noise, mask=mask)


def fitted(flux: str) -> Posterior:
    """A frame with this noise that determines all parameters."""
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    sources = SourceCatalog.grid(4, 14.0, 2e4)
    model = ForwardModel(Detector(SHAPE), sources, GaussianPSF(2.0), distortion)
    counts = simulate(model, [1e-4, -1e-4], 3.0, seed=192, noise=OWN)
    return Posterior(model, counts, noise=OWN, nuisances=Nuisances(flux))


def test_log_prob_is_that_of_the_dense_image() -> None:
    posterior, params = made("scale")
    named = dict(zip(posterior.parameter_names, params, strict=True))
    mean = dense_image(posterior.model, named) + background_image(SHAPE, named)
    terms = OWN.log_likelihood(posterior.counts, mean, 0.0)[posterior.mask]
    value = posterior.log_prob(params) - posterior.log_prior(params)[0]
    assert value == pytest.approx(float(terms.sum()), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("case", NAMES)
def test_it_agrees_with_the_packages_own(case: str) -> None:
    posterior, params = made(case)
    own = Posterior(
        posterior.model,
        posterior.counts,
        noise=GaussianNoise(VARIANCE),
        mask=posterior.mask,
        nuisances=posterior.nuisances,
    )
    scale = errors(posterior, params)
    params = params + 0.3 * scale
    assert own.log_prob(params) == pytest.approx(posterior.log_prob(params), abs=1e-8)
    assert own.gradient(params) * scale == pytest.approx(
        posterior.gradient(params) * scale, abs=1e-8
    )
    square = np.outer(scale, scale)
    assert own.fisher(params) * square == pytest.approx(posterior.fisher(params) * square, abs=1e-9)
    assert own.fluxes(params) == pytest.approx(posterior.fluxes(params), rel=1e-9)
    if not posterior.nuisances.position_scatter:
        judged, judged_own = fit_statistics(posterior, params), fit_statistics(own, params)
        assert judged == pytest.approx(judged_own, rel=1e-9, nan_ok=True)
        assert judged["deviance"] == judged["pearson"]
    # negative control: the mean variance everywhere is another model
    flat = Posterior(
        posterior.model,
        posterior.counts,
        noise=GaussianNoise(float(VARIANCE.mean())),
        mask=posterior.mask,
        nuisances=posterior.nuisances,
    )
    assert abs(flat.log_prob(params) - posterior.log_prob(params)) > 10.0


@pytest.mark.parametrize("case", NAMES)
def test_gradient_is_that_of_log_prob(case: str) -> None:
    posterior, truth = made(case)
    scale = errors(posterior, truth)
    params = truth + 0.5 * scale * np.random.default_rng(192).uniform(-1, 1, truth.size)
    numerical = np.array(
        [five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(truth.size)]
    )
    assert posterior.gradient(params) * scale == pytest.approx(
        numerical * scale, rel=1e-6, abs=1e-6
    )


@pytest.mark.long
def test_extrapolated_fluxes_are_those_that_are_searched_for() -> None:
    posterior = fitted("free")
    best = find_map(posterior)
    assert best.at_maximum
    near = posterior.near(best.params, best.covariance)
    draws = np.random.default_rng(193).multivariate_normal(best.params, best.covariance, 8)
    searched = posterior.log_prob(draws)
    assert near.log_prob(draws) == pytest.approx(searched, rel=0, abs=1e-5)
    assert np.mean(near.log_prob(draws) != searched) > 0.5


@pytest.mark.slow
def test_scores_of_drawn_frames_have_the_information_as_covariance() -> None:
    rng = np.random.default_rng(194)
    model = make_model(TOUCHING, sigma=2.0, tolerance=1e-10)
    truth = known(make_truth(model, rng), CASES["fixed"])
    prior = flat_priors(tuple(truth), truth)
    squares = []
    for _ in range(200):
        posterior, params = make_posterior(model, truth, rng, CASES["fixed"], OWN, prior=prior)
        score, information = posterior.gradient(params), posterior.fisher(params)
        squares.append(score @ np.linalg.solve(information, score))
    # chi-squares with 13 degrees of freedom: their mean scatters by sqrt(26 / 200)
    assert np.mean(squares) == pytest.approx(13.0, abs=4.0 * np.sqrt(26.0 / 200.0))


def test_it_is_sampled_stored_and_read_back(tmp_path: Path) -> None:
    serialize.serializable("noise.variance")(VarianceNoise)
    posterior = fitted("fixed")
    best = find_map(posterior)
    path = tmp_path / "chain.h5"
    sample(posterior, best, path=path, seed=1, walkers=32, steps=40, progress=False)
    chain = open_chain(path)
    draws = chain.chain[:, 10:].reshape(-1, posterior.n_parameters)
    scale = np.sqrt(np.diag(best.covariance))
    assert np.abs((draws.mean(axis=0) - best.params) / scale).max() < 0.5
    again = chain.posterior()
    assert np.array_equal(again.noise.variance, VARIANCE)
    assert again.log_prob(best.params) == posterior.log_prob(best.params)
