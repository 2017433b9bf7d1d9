"""Hot pixels, told from stars before anything is known of a frame."""

import numpy as np
import pytest

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.optimize.hot_pixels import hot_pixels

SIZE = 300
READ_NOISE = 3.0


def field_of(fwhm: float, background: float, rng: np.random.Generator) -> Floats:
    """200 stars, some of them close pairs."""
    place, fluxes = rng.uniform(-0.5 * SIZE, 0.5 * SIZE, (2, 200)), 10.0 ** rng.uniform(3, 5.5, 200)
    model = bf.ForwardModel(
        bf.Detector((SIZE, SIZE), pixel="box"), bf.SourceCatalog(*place, fluxes),
        bf.MoffatPSF(fwhm, 3.0), bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]),
    )  # fmt: skip
    light = rng.poisson(model.expected_counts(np.zeros(2)) + background)
    return np.asarray(light + rng.normal(0.0, READ_NOISE, light.shape))


@pytest.mark.parametrize("background", [5.0, 200.0])
@pytest.mark.parametrize("fwhm", [0.5, 0.8, 1.2, 2.5, 6.0])
def test_hot_pixels_are_found_and_no_stars(fwhm: float, background: float) -> None:
    """Of pixels with 300 to 30,000 counts too many 17 in 20, and nothing else.

    Of stars that fit into a pixel nothing is.
    """
    rng = np.random.default_rng(8)
    counts, valid = field_of(fwhm, background, rng), np.ones((SIZE, SIZE), bool)
    noise = bf.PoissonNoise(READ_NOISE)
    assert not hot_pixels(counts, valid, noise).any()
    row, column = rng.integers(0, SIZE, (2, 100))
    counts[row, column] += 10.0 ** rng.uniform(2.5, 4.5, 100)
    found = hot_pixels(counts, valid, noise)
    assert fwhm < 1.0 or found[row, column].sum() >= 85
    found[row, column] = False
    assert not found.any()


def test_frames_without_peaks_have_no_hot_pixels() -> None:
    noise, valid = bf.PoissonNoise(READ_NOISE), np.ones((40, 40), bool)
    assert not hot_pixels(np.full((40, 40), 7.0), valid, noise).any()
    assert not hot_pixels(np.full((40, 40), 7.0), ~valid, noise).any()
    assert not hot_pixels(np.full((3, 3), 7.0), np.ones((3, 3), bool), noise).any()
