"""The logarithmic distortion against its definition and against integrals of its images."""

import numpy as np
import pytest

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.logarithm import LogDistortion
from bayesfred.imaging.psf import GaussianPSF

LOG = LogDistortion(1e-5)


def test_images_stand_where_both_equations_vanish() -> None:
    x, y = np.random.default_rng(1).uniform(-250.0, 250.0, (2, 100))
    x[0] = y[0] = 0.0
    u, v = LOG.image_position([], x, y)
    f, g = LOG.displacement([], u, v, x, y)
    assert np.abs(u - x + f).max() < 1e-9 and np.abs(v - y + g).max() < 1e-9
    # the paper's figure: f = x log(1 + c (u^2 + v^2)) moves a corner star at (200, 200) by about 60
    # pixels along each axis
    assert LOG.displacement([], 100.0, 50.0, 30.0, 40.0) == pytest.approx(
        (30.0 * np.log(1.125), 40.0 * np.log(1.125))
    )


def test_determinant_is_that_of_differences() -> None:
    u, v, x, y = np.random.default_rng(2).uniform(-250.0, 250.0, (4, 50))
    h = 1e-4
    f_u, g_u = (
        b - a
        for a, b in zip(
            LOG.displacement([], u - h, v, x, y), LOG.displacement([], u + h, v, x, y), strict=True
        )
    )
    f_v, g_v = (
        b - a
        for a, b in zip(
            LOG.displacement([], u, v - h, x, y), LOG.displacement([], u, v + h, x, y), strict=True
        )
    )
    f_u, g_u, f_v, g_v = (d / (2 * h) for d in (f_u, g_u, f_v, g_v))
    assert LOG.determinant([], u, v, x, y) == pytest.approx(
        (1 + f_u) * (1 + g_v) - f_v * g_u, rel=1e-6
    )


@pytest.mark.parametrize(
    "detector", [Detector((301, 281)), Detector((100, 93), 3), Detector((100, 93), 3, "box")]
)
def test_image_keeps_flux_and_stands_at_its_place(detector: Detector) -> None:
    sources = SourceCatalog([90.0], [-110.0], [1e4])
    model = ForwardModel(detector, sources, GaussianPSF(6.0), LOG)
    image = model.expected_counts([])
    assert image.sum() == pytest.approx(1e4, rel=1e-6)
    u, v = detector.pixel_centres()
    j, i = np.unravel_index(np.argmax(image), image.shape)
    at = [float(value[0]) for value in LOG.image_position([], sources.x, sources.y)]
    assert abs(u[i] - at[0]) < 2.0 * detector.binning and abs(v[j] - at[1]) < 2.0 * detector.binning
    printed = ForwardModel(
        detector, sources, GaussianPSF(6.0), LOG, conserve_flux=False
    ).expected_counts([])
    determinant = LOG.determinant([], *at, sources.x, sources.y)[0]
    assert printed.sum() == pytest.approx(1e4 / determinant, rel=0.03) and determinant > 1.2


def test_without_strength_it_is_no_distortion() -> None:
    sources = SourceCatalog([20.0, -5.0], [3.0, 30.0], [1e4, 2e4])
    image = ForwardModel(
        Detector((101, 101)), sources, GaussianPSF(4.0), LogDistortion(0.0)
    ).expected_counts([], 2.0)
    v, u = np.mgrid[-50:51, -50:51]
    expected = 2.0 + sum(
        f * np.exp(-((u - x) ** 2 + (v - y) ** 2) / 32.0) / (32.0 * np.pi)
        for x, y, f in zip(sources.x, sources.y, sources.flux, strict=True)
    )
    assert image == pytest.approx(expected, rel=1e-12)


def test_it_is_simulated_not_fitted() -> None:
    model = ForwardModel(
        Detector((51, 51)), SourceCatalog([0.0], [0.0], [1e3]), GaussianPSF(3.0), LOG
    )
    with pytest.raises(InputError, match="expected PolynomialDistortion"):
        model.jacobian([])
    with pytest.raises(InputError, match="c: got"):
        LogDistortion(-1.0)
