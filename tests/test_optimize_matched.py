"""Which sources the counts show at a maximum, and what the optimiser says of it."""

from dataclasses import replace

import numpy as np
import planted
import pytest

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map, reject_outliers
from bayesfred.optimize.matched import FARTHEST, enough_matched, source_light

TRUTH = np.append(planted.THETA, planted.LEVEL)


def displaced(distance: float, seed: int = 1) -> Posterior:
    """Every source lies this many PSF widths beside its image, each in another direction."""
    s = planted.field(seed)
    angle = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(s))
    by = distance * planted.SIGMA * np.array([np.cos(angle), np.sin(angle)])
    there = planted.camera(planted.moved(s, s.x + by[0], s.y + by[1]))
    return Posterior(planted.camera(s), planted.counts(there, seed))


@pytest.mark.parametrize("distance", [0.0, 1.0, 3.0])
def test_light_is_matched_within_two_widths(distance: float) -> None:
    light = source_light(displaced(distance), TRUTH)
    assert light.inside.all()
    share = np.mean(light.matched)
    assert share == 1.0 if distance < 1.5 else share < 0.1
    assert distance < FARTHEST - 0.5 or distance > FARTHEST + 0.5


def test_light_found_is_what_a_naive_sum_over_the_frame_finds() -> None:
    posterior = displaced(0.7)
    light = source_light(posterior, TRUTH)
    expected = posterior.expected_counts(TRUTH)
    v, u = np.mgrid[: planted.SHAPE[0], : planted.SHAPE[1]] - planted.HALF
    ratio, power = [], []
    for (a, b), flux in zip(light.position, posterior.model.sources.flux, strict=True):
        kernel = np.exp(-((u - a) ** 2 + (v - b) ** 2) / (2.0 * light.width**2))
        kernel /= 2.0 * np.pi * light.width**2
        own = flux * np.sum(kernel**2)
        ratio.append(1.0 + np.sum(kernel * (posterior.counts - expected)) / own)
        power.append(own**2 / np.sum(kernel**2 * expected))
    # the package's sum ends at 3 widths, beyond which the kernel holds 1 %
    assert light.ratio == pytest.approx(np.array(ratio), abs=0.02)
    assert light.power == pytest.approx(np.array(power), rel=0.02)


def test_nothing_but_noise_matches_nothing() -> None:
    estimate = find_map(planted.empty(1))
    assert estimate.at_maximum and not estimate.fits_data
    assert "0 of 48 sources matched" in estimate.message
    assert "consistent with the noise, but too few sources are matched" in estimate.message


def test_faint_sources_of_known_flux_count_together() -> None:
    """One by one they are lost in the noise, 48 of them are not; without their light they are."""
    s = planted.field(4)
    faint = planted.camera(replace(s, flux=np.full(48, 40.0)))
    for model, enough in (
        (faint, True),
        (replace(faint, sources=replace(s, flux=s.flux * 1e-9)), False),
    ):
        posterior = Posterior(faint, planted.counts(model, 4))
        light = source_light(posterior, TRUTH)
        assert light.matched.sum() < 5 and enough_matched(posterior, light) == enough


def test_sources_are_counted_at_the_maximum_not_at_the_start() -> None:
    posterior = planted.true(1)
    begun = find_map(posterior, TRUTH * np.array([*[1.01] * 4, 1.0]))
    assert "48 of 48 sources matched" in begun.message


def test_rejected_sources_are_not_counted() -> None:
    s = planted.field(2)
    bright = replace(s, flux=2.0 * s.flux)
    extra = SourceCatalog(
        np.append(bright.x, [75.0, -75.0]), np.append(bright.y, [75.0, -75.0]),
        np.append(bright.flux, [2e4, 2e4]),
    )  # fmt: skip
    posterior = Posterior(planted.camera(extra), planted.counts(planted.camera(bright), 2))
    assert "48 of 50 sources matched" in find_map(posterior).message
    assert "48 of 48 sources matched, 2 sources" in reject_outliers(posterior)[1].message


def test_sources_beyond_the_pixels_that_are_used_are_told_from_lost_ones() -> None:
    """Three of 51, one of them behind the mask; of all others nothing is said."""
    s = planted.field(2)
    more = SourceCatalog(
        np.append(s.x, [900.0, -900.0, 75.0]), np.append(s.y, [0.0, 0.0, 75.0]),
        np.append(s.flux, [2e4, 2e4, 2e4]),
    )  # fmt: skip
    counts, mask = planted.counts(planted.camera(s), 2), np.ones(planted.SHAPE, bool)
    j, i = (round(0.5 * (side - 1) + 75.0) for side in planted.SHAPE)
    mask[j - 8 : j + 9, i - 8 : i + 9] = False
    posterior = Posterior(planted.camera(more), counts, mask=mask)
    said = "48 of 51 sources matched, 3 outside the pixels that are used"
    assert said in find_map(posterior).message
    everything = Posterior(planted.camera(s), counts)
    assert "outside the pixels" not in find_map(everything).message


def test_sources_outside_of_the_likelihood_are_not_judged() -> None:
    s = planted.field(3)
    posterior = planted.true(3)
    half = np.tile(np.arange(planted.SHAPE[1]) > planted.HALF, (planted.SHAPE[0], 1))
    masked = Posterior(posterior.model, posterior.counts, mask=half, nuisances=Nuisances("free"))
    light = source_light(masked, TRUTH)
    assert light.inside[s.x > 4.0].all() and not light.inside[s.x < -4.0].any()
    assert light.matched[light.inside].all() and not light.matched[~light.inside].any()
