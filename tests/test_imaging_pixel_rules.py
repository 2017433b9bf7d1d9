"""Rules with samples that pixels share: against exact integrals, and images against Gauss's."""

import math

import numpy as np
import pytest
from scipy.special import erf

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import BOX_TOLERANCE, BOX_TOLERANCE_NARROWED, Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.contexts import PixelRule, SourceNuisances, stride
from bayesfred.imaging.kernels.render import render
from bayesfred.imaging.pixel_rules import shared_rule
from bayesfred.imaging.psf import PSF, GaussianPSF, MoffatPSF

NARROWER = 1.3


def worst_error(rule: PixelRule, sigma: float, beta: float) -> float:
    """The largest error of a pixel's integral wherever the PSF is, in units of its peak."""
    reach = len(rule.weights) // 2
    at = rule.offsets + np.arange(-reach, reach + 1)[:, None]
    u = np.linspace(0.0, 8.0 * sigma, 801)
    nodes, weights = np.polynomial.legendre.leggauss(40)

    def profile(x: np.ndarray) -> np.ndarray:
        if math.isinf(beta):
            return np.exp(-0.5 * (x / sigma) ** 2)
        return (1.0 + x**2 / (2.0 * beta * sigma**2)) ** -beta

    exact = profile(u[:, None] + 0.5 * nodes) @ (0.5 * weights)
    if math.isinf(beta):
        root = math.sqrt(2.0) * sigma
        by_erf = 0.5 * (erf((u + 0.5) / root) - erf((u - 0.5) / root))
        np.testing.assert_allclose(exact, by_erf * sigma * math.sqrt(2.0 * math.pi), atol=1e-14)
    found = (profile(u[:, None, None] + at) * rule.weights).sum(axis=(1, 2))
    return float(np.abs(found - exact).max())


@pytest.mark.parametrize("beta", [math.inf, 3.0, 1.5])
@pytest.mark.parametrize("sigma", [0.7, 0.9, 1.0, 1.4, 2.0, 3.3, 10.0])
def test_a_rule_errs_within_its_tolerances(sigma: float, beta: float) -> None:
    rule = shared_rule(sigma, beta, BOX_TOLERANCE, BOX_TOLERANCE_NARROWED)
    if rule is None:
        assert sigma < 1.0 and beta < math.inf  # `quadrature` serves there
        return
    assert worst_error(rule, sigma, beta) <= BOX_TOLERANCE
    assert worst_error(rule, sigma / NARROWER, beta) <= BOX_TOLERANCE_NARROWED
    # a rule is no better than it must be: three times as narrow a PSF is beyond it
    assert worst_error(rule, sigma / 3.0, beta) > BOX_TOLERANCE


@pytest.mark.parametrize(
    ("psf", "binning"),
    [
        (GaussianPSF(0.8), 1),
        (GaussianPSF(1.4), 1),
        (GaussianPSF(1.4), 2),
        (GaussianPSF(2.0), 1),
        (GaussianPSF(5.0), 1),  # rows that reach both borders
        (MoffatPSF(3.3, 3.0), 1),
    ],
)
def test_images_are_those_of_gauss_and_legendre(psf: PSF, binning: int) -> None:
    """Sources on the frame, at its borders and beyond them, moved and sheared."""
    rng = np.random.default_rng(1)
    shape, n = (41, 40), 30
    half = 0.5 * binning * np.array(shape)
    sources = SourceCatalog(
        rng.uniform(-half[1] - 3.0, half[1] + 3.0, n),
        rng.uniform(-half[0] - 3.0, half[0] + 3.0, n),
        rng.uniform(0.5, 1.0, n),
    )
    distortion = PolynomialDistortion.mirrored()
    model = ForwardModel(Detector(shape, binning=binning, pixel="box"), sources, psf, distortion)
    theta = rng.normal(0.0, 0.3, 12) / np.abs(distortion.largest_displacement(*half[::-1])).max(0)
    optics = model.optics()
    assert len(optics.rule.weights) > 1
    gauss = optics._replace(rule=PixelRule(optics.offsets, optics.weights[None]))
    centre = optics._replace(rule=PixelRule(np.zeros(1), np.full((1, 1), float(binning))))
    shared, by_gauss, at_centre = np.zeros((3, shape[0] * stride(shape[1])))
    nuisances = SourceNuisances(1.0, 0.0, 0.0, psf.sigma, 0.0, 0.0)
    for each, out in ((optics, shared), (gauss, by_gauss), (centre, at_centre)):
        assert render(each, theta, nuisances, sources.flux, out)
    peak = psf.peak * binning**2
    assert np.abs(shared - by_gauss).max() < 1e-7 * peak
    assert np.abs(at_centre - by_gauss).max() > 1e-3 * peak  # a rule that is wrong
