"""The recipe for a PSF family: an elliptical Gaussian, defined in this file alone.

It is simulated, fitted, sampled and stored as the package's own families are, and no file of the
package knows it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import oracles
import pytest
from numpy.typing import NDArray
from test_imaging import EXACT, assert_jacobian_is_right, random_sources, random_theta
from test_model_derivatives import STEP, errors, five_point

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import PSF, GaussianPSF
from bayesfred.io import serialize
from bayesfred.model.noise import simulate
from bayesfred.model.posterior import Nuisances, Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

SHAPE = (60, 75)
MIRRORED = PolynomialDistortion.mirrored()


class EllipticalProfile(NamedTuple):
    """norm exp(-(aa a^2 + 2 ab a b + bb b^2) / 2), a and b in units of sigma."""

    norm: float
    aa: float
    ab: float
    bb: float

    @staticmethod
    def value(psf: Any, a: Any, b: Any) -> Any:
        return math.exp(-0.5 * (psf.aa * a * a + 2.0 * psf.ab * a * b + psf.bb * b * b))

    @staticmethod
    def slopes(psf: Any, a: Any, b: Any) -> Any:
        x, y = psf.aa * a + psf.ab * b, psf.ab * a + psf.bb * b
        p = math.exp(-0.5 * (a * x + b * y))
        return p, x * p, y * p

    @staticmethod
    def second_derivatives(psf: Any, a: Any, b: Any) -> Any:
        x, y = psf.aa * a + psf.ab * b, psf.ab * a + psf.bb * b
        p = math.exp(-0.5 * (a * x + b * y))
        return x * p, y * p, (x * x - psf.aa) * p, (x * y - psf.ab) * p, (y * y - psf.bb) * p


@dataclass(frozen=True)
class EllipticalPSF:
    """Gaussian whose axes are sigma ratio and sigma / ratio, the first at `angle` from u."""

    sigma: float
    ratio: float
    angle: float

    @property
    def peak(self) -> float:
        return 1.0 / (2.0 * math.pi * self.sigma**2)

    @property
    def core(self) -> tuple[float, float]:
        return self.sigma / self.ratio, math.inf

    @property
    def profile(self) -> EllipticalProfile:
        c, s, square = math.cos(self.angle), math.sin(self.angle), self.ratio**2
        aa, bb = c * c / square + s * s * square, s * s / square + c * c * square
        return EllipticalProfile(1.0 / (2.0 * math.pi), aa, c * s * (1.0 / square - square), bb)

    def support_radius(self, tolerance: float) -> float:
        if tolerance == 0.0:
            return math.inf
        return self.sigma * self.ratio * math.sqrt(-2.0 * math.log(tolerance))

    def density(self, a: Any, b: Any) -> Floats:
        c, s = math.cos(self.angle), math.sin(self.angle)
        along, across = (c * a + s * b) / self.ratio, (c * b - s * a) * self.ratio
        return np.asarray(self.peak * np.exp(-0.5 * (along**2 + across**2) / self.sigma**2))


ELLIPTICAL: PSF = EllipticalPSF(2.2, 1.3, 0.4)


def dense(model: ForwardModel, theta: Floats) -> Floats:
    """The image from the formulas, with the covariance matrix of a bivariate normal density."""
    d, psf, (u, v) = model.distortion, model.psf, np.meshgrid(*oracles.impulse_nodes(SHAPE))
    axes = np.array([psf.sigma * psf.ratio, psf.sigma / psf.ratio])
    turn = np.array(
        [[np.cos(psf.angle), -np.sin(psf.angle)], [np.sin(psf.angle), np.cos(psf.angle)]]
    )
    covariance = turn @ np.diag(axes**2) @ turn.T
    inverse, image = np.linalg.inv(covariance), np.zeros(SHAPE)
    for x, y, flux in zip(model.sources.x, model.sources.y, model.sources.flux, strict=True):
        f, f_u, f_v = oracles.polynomial(d.f_terms, theta[:6], u, v, x, y)
        g, g_u, g_v = oracles.polynomial(d.g_terms, theta[6:], u, v, x, y)
        ab = np.stack([u - x + f, v - y + g])
        p = np.exp(-0.5 * np.einsum("i...,ij,j...", ab, inverse, ab))
        p /= 2.0 * np.pi * np.sqrt(np.linalg.det(covariance))
        image += flux * p * np.abs((1 + f_u) * (1 + g_v) - f_v * g_u)
    return image


def test_counts_equal_the_dense_image() -> None:
    rng = np.random.default_rng(180)
    sources = random_sources(rng, SHAPE, 6)
    model = ForwardModel(Detector(SHAPE), sources, ELLIPTICAL, MIRRORED, tolerance=0.0)
    cut = ForwardModel(Detector(SHAPE), sources, ELLIPTICAL, MIRRORED, tolerance=1e-6)
    for _ in range(3):
        theta = random_theta(rng, MIRRORED, SHAPE, 1.0)
        expected = dense(model, theta)
        exact = EXACT * expected.max()
        assert model.expected_counts(theta) == pytest.approx(expected, rel=0, abs=exact)
        missed = np.abs(cut.expected_counts(theta) - expected).max()
        assert exact < missed < 1.5e-6 * sources.flux.sum() * ELLIPTICAL.peak


def test_jacobian_equals_central_differences() -> None:
    rng = np.random.default_rng(181)
    for detector in (Detector((40, 51)), Detector((20, 25), 2, "box")):
        sources = random_sources(rng, detector.fine_shape, 3)
        model = ForwardModel(detector, sources, ELLIPTICAL, MIRRORED, tolerance=0.0)
        assert_jacobian_is_right(model, random_theta(rng, MIRRORED, detector.fine_shape, 0.5))


def made(
    nuisances: Nuisances, detector: Detector = Detector(SHAPE), psf: PSF = ELLIPTICAL
) -> tuple[Posterior, Floats]:
    """The posterior of a frame with elliptical images, and the true parameters."""
    rng = np.random.default_rng(182)
    sources = SourceCatalog.grid(3, 17.0, 2e4)
    theta = random_theta(rng, MIRRORED, detector.fine_shape, 0.3)
    truth = ForwardModel(detector, sources, ELLIPTICAL, MIRRORED, tolerance=0.0)
    model = ForwardModel(detector, sources, psf, MIRRORED, tolerance=0.0)
    frame = simulate(truth, theta, 3.0, seed=182)
    posterior = Posterior(model, frame, nuisances=nuisances)
    params = posterior.start()
    params[:12] = theta
    params[posterior.parameter_names.index("background")] = 3.0
    return posterior, params


@pytest.mark.parametrize(
    ("nuisances", "detector"),
    [
        pytest.param(
            Nuisances("scale", offset=True, psf_sigma=True),
            Detector(SHAPE),
            marks=pytest.mark.long,
        ),
        pytest.param(
            Nuisances("free", psf_sigma=True, position_scatter=True),
            Detector((30, 37), 2, "box"),
            marks=pytest.mark.long,
        ),
    ],
    ids=["scale", "free, scattered, box"],
)
def test_gradient_is_that_of_log_prob(nuisances: Nuisances, detector: Detector) -> None:
    posterior, truth = made(nuisances, detector)
    scale = errors(posterior, truth)
    params = truth + 0.5 * scale * np.random.default_rng(183).uniform(-1, 1, truth.size)
    numerical = np.array(
        [five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(truth.size)]
    )
    assert posterior.gradient(params) * scale == pytest.approx(
        numerical * scale, rel=1e-6, abs=1e-6
    )


@pytest.mark.slow
def test_fit_finds_the_truth_which_a_circular_one_does_not_explain() -> None:
    posterior, truth = made(Nuisances("scale", psf_sigma=True))
    best = find_map(posterior)
    assert best.at_maximum and best.fits_data
    deviation = best.params - truth
    # of 15 parameters: a chi-square exceeds 45 with a chance of 8e-5
    assert deviation @ np.linalg.solve(best.covariance, deviation) < 45.0
    # negative control
    circular, _ = made(posterior.nuisances, psf=GaussianPSF(ELLIPTICAL.sigma))
    wrong = find_map(circular)
    assert wrong.log_prob < best.log_prob - 1000.0


@pytest.mark.slow
def test_it_is_sampled_stored_and_read_back(tmp_path: Path) -> None:
    serialize.serializable("psf.elliptical")(EllipticalPSF)
    posterior, _ = made(Nuisances("scale"))
    best = find_map(posterior)
    path = tmp_path / "chain.h5"
    sample(posterior, best, path=path, seed=1, walkers=32, steps=40, progress=False)
    chain = open_chain(path)
    draws = chain.chain[:, 10:].reshape(-1, posterior.n_parameters)
    scale = np.sqrt(np.diag(best.covariance))
    assert np.abs((draws.mean(axis=0) - best.params) / scale).max() < 0.5
    again = chain.posterior()
    assert again.model.psf == ELLIPTICAL
    assert again.log_prob(best.params) == posterior.log_prob(best.params)
