"""Noise that neighbouring pixels share: what it does to errors, and what is not it."""

from dataclasses import replace

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from bayesfred.analysis.residuals import judge_residuals
from bayesfred.analysis.shared_noise import shared_noise
from bayesfred.analysis.verdict import judge_fit
from bayesfred.model.noise import PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.fit_statistics import fit_statistics

Floats = NDArray[np.float64]
SHAPE = (160, 200)
WIDTH = 1.4


def noise(seed: int, shape: tuple[int, int] = SHAPE) -> Floats:
    return np.random.default_rng(seed).standard_normal(shape)


def smoothed(z: Floats, share: float = 0.5) -> Floats:
    """Resampled at a place between pixels, of unit variance."""
    for axis in (0, 1):
        z = (1.0 - share) * z + share * np.roll(z, 1, axis)
    return np.asarray(z / np.hypot(1.0 - share, share) ** 2)


def everywhere(z: Floats) -> NDArray[np.bool_]:
    return np.ones(z.shape, bool)


def scatter_of_positions(z: Floats) -> float:
    """Of noise filtered with the slope of an image, in that of independent pixels."""
    reach = np.arange(-8, 9)
    image = np.exp(-(reach**2) / (2.0 * WIDTH**2))
    slope = image[:, None] * (reach * image)
    pulls = [ndimage.correlate(z, each, mode="wrap") for each in (slope, slope.T)]
    return float(np.mean(np.square(pulls)) / np.sum(slope**2)) ** 0.5


@pytest.mark.parametrize("share", [0.5, 0.25])
def test_errors_are_those_of_positions_in_such_noise(share: float) -> None:
    """The factor against what the noise does; 2e6 pixels tell it to 0.2 %."""
    z = smoothed(noise(1, (1400, 1500)), share)
    found = shared_noise(z, everywhere(z), WIDTH)
    assert found is not None
    beside = share * (1.0 - share) / (1.0 - 2.0 * share * (1.0 - share))
    assert found.along == pytest.approx([beside, beside], abs=0.005)
    assert found.ratio == pytest.approx(scatter_of_positions(z), rel=0.01)
    # the control: as if diagonal neighbours shared none
    square = 0.25 / WIDTH**2
    without = (1.0 + 4.0 * beside * np.exp(-square) * (1.0 - square)) ** 0.5
    assert without < 0.97 * scatter_of_positions(z)


def test_an_uneven_background_is_no_part_of_a_correlation() -> None:
    """A wave of the sky of a quarter of the noise would add 0.015, ten times the error."""
    z = smoothed(noise(9, (600, 700)))
    wave = 0.25 * np.sin(np.arange(700) / 40.0)
    found = shared_noise(z + wave, everywhere(z), WIDTH)
    assert found is not None
    assert found.along == pytest.approx([0.5, 0.5], abs=0.007)


def test_a_sharpened_frame_has_errors_that_are_smaller() -> None:
    z = noise(2)
    z = z - 0.6 * ndimage.uniform_filter(z, 3, mode="wrap")
    found = shared_noise(z / z.std(), everywhere(z), WIDTH)
    assert found is not None
    assert found.ratio < 0.8
    assert max(found.along) < 0.0


def test_independent_pixels_share_none() -> None:
    """A correlation is noticeable at 5 standard deviations: of 300 frames none has one."""
    counts = np.random.default_rng(3).poisson(0.05, (300, *SHAPE))
    for frame in (counts - 0.05) / 0.05**0.5:
        assert shared_noise(frame, everywhere(frame), WIDTH) is None


def test_what_hardly_changes_errors_is_not_told() -> None:
    """A detector's own crosstalk of 2 %, noticed at 30 standard deviations, widens them by 3 %."""
    z = smoothed(noise(10, (1400, 1500)), 0.02)
    assert shared_noise(z, everywhere(z), WIDTH) is None
    assert np.mean(z[:, 1:] * z[:, :-1]) > 20.0 / z.size**0.5


def test_other_faults_are_not_it() -> None:
    z = noise(4)
    row, column = np.indices(SHAPE)
    others = {
        "uneven background": 0.5 * np.sin(column / 30.0),
        "rows with constants": noise(5)[:, :1],
        "amplifiers": 0.5 * (column % 2),
        "colour filter": 0.5 * ((column + row) % 2),
    }
    for name, more in others.items():
        assert shared_noise(z + more, everywhere(z), WIDTH) is None, name
    hit = np.where(np.random.default_rng(6).random(SHAPE) < 1e-3, 40.0, 0.0)
    trails = np.maximum(hit, np.roll(hit, 1, 1))
    assert shared_noise(z + trails, everywhere(z), WIDTH) is None


def test_only_pairs_of_pixels_between_sources_count() -> None:
    z, row = smoothed(noise(7)), np.arange(SHAPE[0])[:, None]
    assert shared_noise(z, everywhere(z) & (row % 7 > 2), WIDTH) is not None
    assert shared_noise(z, everywhere(z) & (row % 4 == 0), WIDTH) is None  # no pairs along v
    assert shared_noise(z, np.zeros(SHAPE, bool), WIDTH) is None
    stained = np.where(row % 7 > 2, z, np.nan)
    assert shared_noise(stained, row % 7 + 0 * z > 2, WIDTH) == shared_noise(
        z, row % 7 + 0 * z > 2, WIDTH
    )


@pytest.mark.slow
def test_a_resampled_frame_fails_where_gain_and_read_noise_were_set_until_sums_agree() -> None:
    posterior = planted.resampled(8)
    sources = posterior.model.sources
    tuned = replace(
        posterior,
        counts=4.0 * posterior.counts,
        model=replace(posterior.model, sources=replace(sources, flux=4.0 * sources.flux)),
        noise=PoissonNoise(read_noise=6.0),
        nuisances=Nuisances("free", offset=True, psf_sigma=True, position_scatter=True),
    )
    best = find_map(tuned)
    fit = fit_statistics(tuned, best.params)
    residuals = judge_residuals(tuned, best.params, best.covariance)
    verdict = judge_fit(tuned, best, fit, residuals)
    assert not verdict.fits_data
    assert verdict.causes[0].name == "correlated pixels"
    assert "where sums over all pixels do not show it" in verdict.sentence
    silent = judge_fit(tuned, best, fit, replace(residuals, shared=None))
    assert silent.fits_data
