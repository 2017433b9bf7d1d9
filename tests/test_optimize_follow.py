"""Footprints follow the images; light of sources that the catalogue lacks is masked and named."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import planted
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from scipy import stats
from test_pipeline_frames import GAIN, RUN, write

import bayesfred as bf
from bayesfred.commands import pipeline
from bayesfred.optimize.find_map import approach
from bayesfred.settings.run import read_settings

Floats = NDArray[np.float64]

RADIUS = 6.0
LINEAR = bf.PolynomialDistortion([(1, 0, 0, 0), (3, 0, 0, 0)], [(0, 1, 0, 0), (0, 3, 0, 0)])
SCALE = np.array([0.1, 1e-6, 0.1, 1e-6])  # moves sources by up to 7 pixels


def displaced(seed: int) -> tuple[bf.Posterior, Floats]:
    """A frame whose stars stand up to more than a footprint off their places, among 30 others."""
    rng = np.random.default_rng(seed)
    sources = planted.field(seed)
    model = planted.camera(sources, distortion=LINEAR)
    theta = SCALE * np.array([1.0, rng.normal(), 1.0, rng.normal()])
    places = rng.uniform(-75.0, 75.0, (2, 200))
    alone = np.hypot(*(places[:, :, None] - np.array([sources.x, sources.y])[:, None])).min(1) > 6.0
    others = bf.SourceCatalog(*places[:, alone][:, :30], rng.uniform(400.0, 1600.0, 30))
    light = replace(model, sources=others).expected_counts(theta)
    counts = np.random.default_rng(seed).poisson(model.expected_counts(theta, 20.0) + light)
    return bf.Posterior(model, counts, nuisances=bf.Nuisances(footprint=RADIUS)), theta


def test_footprints_are_where_the_images_are() -> None:
    posterior, theta = displaced(1)
    followed = bf.follow_images(posterior)
    images = posterior.likelihood.image_positions(np.append(theta, 20.0))
    v, u = np.indices(posterior.counts.shape) - planted.HALF
    distance = np.hypot(u[..., None] - images[:, 0], v[..., None] - images[:, 1]).min(axis=-1)
    assert followed.mask[distance < RADIUS - 0.2].all()
    assert not followed.mask[distance > RADIUS + 0.2].any()
    # negative control: the catalogue's positions are elsewhere
    assert np.mean(posterior.mask[distance < RADIUS]) < 0.7
    assert followed.nuisances.footprint is None and bf.follow_images(followed) is followed
    # from an estimate, too, and whatever the frame masks stays masked
    masked = replace(posterior, valid=distance > 1.0)
    again = bf.follow_images(masked, bf.find_map(followed))
    assert not again.mask[distance < 1.0].any()
    assert again.mask[(distance > 1.0) & (distance < RADIUS - 0.3)].all()


def test_the_coefficients_are_found_where_the_images_left_the_footprints() -> None:
    z, before = [], []
    for seed in range(12):
        posterior, theta = displaced(seed)
        followed = bf.follow_images(posterior)
        estimate = bf.find_map(followed)
        kept = replace(followed, mask=bf.find_uncatalogued(followed, estimate).mask)
        estimate = bf.find_map(kept)
        sd = np.sqrt(np.diag(estimate.covariance))[:4]
        z.append((estimate.params[:4] - theta) / sd)
        before.append((bf.find_map(posterior).params[:4] - theta) / sd)
    square = np.mean(np.square(z))  # of 48 numbers, which scatters by 0.2 if they are normal
    assert square < 1.0 + 3.0 * 0.2
    # negative control: around the catalogue's positions the fit is lost
    assert np.mean(np.square(before)) > 3.0


def companions(seed: int, psf: bf.GaussianPSF | bf.MoffatPSF, share: float = 0.15) -> bf.Posterior:
    """A frame in which 4 of 48 stars have a companion of this share of their light."""
    rng = np.random.default_rng(seed)
    sources = planted.field(seed)
    model = planted.camera(sources, psf=psf)
    few, angle = np.arange(4), rng.uniform(0.0, 2.0 * np.pi, 4)
    distance = rng.uniform(5.0, 7.0, 4)
    near = bf.SourceCatalog(
        sources.x[few] + distance * np.cos(angle),
        sources.y[few] + distance * np.sin(angle),
        share * sources.flux[few] + 1e-9,
    )
    light = replace(model, sources=near).expected_counts(planted.THETA)
    counts = rng.poisson(model.expected_counts(planted.THETA, planted.LEVEL) + light)
    nuisances = bf.Nuisances("free", offset=True, psf_sigma=True, footprint=9.0)
    return bf.Posterior(replace(model, psf=bf.GaussianPSF(1.8)), counts, nuisances=nuisances)


def looked(posterior: bf.Posterior) -> bf.UncataloguedSources:
    followed = bf.follow_images(posterior)
    return bf.find_uncatalogued(followed, bf.find_map(followed))


@pytest.mark.parametrize("seeds", [range(2), pytest.param(range(40), marks=pytest.mark.statistics)])
def test_companions_are_found_and_nothing_else(seeds: range) -> None:
    """Companions of 15 % at 3 to 4 widths from their stars."""
    number = [len(looked(companions(seed, bf.GaussianPSF(1.8))).u) for seed in seeds]
    assert 3.0 < np.mean(number) <= 4.1
    # negative control: no companions, nothing found but by chance
    clean = [looked(companions(seed, bf.GaussianPSF(1.8), 0.0)) for seed in seeds]
    assert sum(len(found.u) for found in clean) <= 1
    assert clean[0].message == "no source that the catalogue lacks"
    assert clean[0].mask.sum() > 0


HOT = 40


def undersampled(seed: int, hot: int) -> tuple[bf.Posterior, Floats, Floats]:
    """Stars of 1.2 pixels' FWHM, 6 others in pixels' middles, and hot pixels."""
    rng = np.random.default_rng(seed)
    grid = bf.SourceCatalog.grid(12, 12.0, 3e3)
    sources = bf.SourceCatalog(
        *(np.array([grid.x, grid.y]) + rng.uniform(-1, 1, (2, 144))), grid.flux
    )
    model = bf.ForwardModel(
        bf.Detector((161, 161), pixel="box"), sources, bf.GaussianPSF(0.5), LINEAR
    )
    cells = rng.permutation(121)[: 6 + HOT]
    places = np.stack(np.divmod(cells, 11)) * 12.0 - 60.0 + rng.integers(-1, 2, (2, 6 + HOT))
    others = bf.SourceCatalog(*places[:, :6], np.geomspace(300.0, 3e3, 6))
    light = replace(model, sources=others).expected_counts(np.zeros(4))
    counts = rng.poisson(model.expected_counts(np.zeros(4), 20.0) + light).astype(float)
    u, v = (places[:, 6 : 6 + hot] + 80).astype(int)
    counts[v, u] += rng.uniform(300.0, 3e3, hot).round()
    nuisances = bf.Nuisances("free", psf_sigma=True, footprint=9.0)
    narrow = replace(model, psf=bf.GaussianPSF(0.6))
    posterior = bf.Posterior(narrow, counts, noise=bf.PoissonNoise(3.0), nuisances=nuisances)
    return posterior, places[:, :6], np.stack([u, v])


@pytest.mark.slow  # to compile
def test_hot_pixels_are_no_sources_though_stars_are_undersampled() -> None:
    posterior, stars, hot = undersampled(1, HOT)
    found = looked(posterior)
    at = set(zip(*np.nonzero(found.sharp), strict=True))
    assert at == set(zip(hot[1], hot[0], strict=True))
    assert not found.mask[hot[1], hot[0]].any() and "40 pixels sharper" in found.message
    # the others are found, and they alone, though the sharpest image possible is theirs
    distance = np.hypot(*(np.array([found.u, found.v])[:, :, None] - stars[:, None])).min(axis=1)
    assert len(found.u) == 6 and np.all(distance < 0.5)
    # negative control
    none = looked(undersampled(1, 0)[0])
    assert not none.sharp.any() and "sharper" not in none.message


def test_rings_of_defocused_stars_are_no_hot_pixels() -> None:
    rng = np.random.default_rng(3)
    x = np.arange(-48, 49) / 4.0
    ring = np.exp(-((np.hypot(x, x[:, None]) - 3.0) ** 2) / (2.0 * 0.7**2))
    model = planted.camera(planted.field(3), psf=bf.SampledPSF(ring, 4))
    counts = rng.poisson(model.expected_counts(planted.THETA, planted.LEVEL))
    nuisances = bf.Nuisances("free", offset=True, psf_sigma=True, footprint=9.0)
    rough = replace(model, psf=bf.GaussianPSF(2.5))
    found = looked(bf.Posterior(rough, counts, nuisances=nuisances))
    assert not found.sharp.any()


@pytest.mark.statistics
def test_wings_of_the_psf_are_no_companions() -> None:
    """Moffat images fitted with a Gaussian leave a ring around every bright star."""
    wide = bf.MoffatPSF(4.2, 3.0)
    found = [looked(companions(seed, wide, 0.0)) for seed in range(20)]
    assert sum(len(each.u) for each in found) <= 10  # half a star of 48 a frame
    # what exceeds the wings is found
    more = [looked(companions(seed, wide, 0.5)) for seed in range(20)]
    assert np.mean([len(each.u) for each in more]) > 2.5


def test_tails_that_grow_outward_are_no_companions() -> None:
    """Stars in the corners have tails of 9 % three widths off; four others have companions.

    With what is common to the brightest stars alone, 260 tails are taken for companions.
    """
    lens, half = bf.PolynomialDistortion.polynomial(1), 160.0
    x, y = (c.ravel() for c in np.mgrid[-half : half + 1 : 14, -half : half + 1 : 14])
    radius = np.hypot(x, y) / np.hypot(half, half)
    bright = bf.SourceCatalog(x, y, 5e4 * (1.0 - 0.4 * radius**2))
    model = bf.ForwardModel(bf.Detector((361, 361), pixel="box"), bright, bf.GaussianPSF(0.8), lens)
    tails = bf.SourceCatalog(
        x * (1 + 2.6 / half), y * (1 + 2.6 / half), 0.09 * bright.flux * radius**4
    )
    some = np.array([200, 240, 290, 330])
    others = bf.SourceCatalog(x[some] + 2.6, y[some], np.full(4, 4.5e3))
    light = sum(
        replace(model, sources=more).expected_counts(np.zeros(4)) for more in (tails, others)
    )
    counts = np.random.default_rng(8).poisson(model.expected_counts(np.zeros(4), 30.0) + light)
    nuisances = bf.Nuisances("free", psf_sigma=True, footprint=5.0)
    found = looked(bf.Posterior(model, counts, nuisances=nuisances))
    distance = np.hypot(found.u[:, None] - others.x, found.v[:, None] - others.y)
    assert np.all(distance.min(axis=0) < 0.6)
    assert np.sum(distance.min(axis=1) > 7.0) <= 2  # half a pitch


def saturated(seed: int, full: float, *, others: bool) -> tuple[bf.Posterior, Floats]:
    """Moffat images fitted with a Gaussian: two bright stars and 60 whose wings noise hides.

    Pixels with more than `full` counts are masked. Of two other sources one stands 4 pixels from a
    faint star and one 14 pixels from the brightest.
    """
    rng = np.random.default_rng([seed, 31])
    x, y = (c.ravel() + rng.uniform(-5.0, 5.0, 64) for c in np.mgrid[-105:106:30, -105:106:30])
    flux = np.append([1e6, 3e5], 1.5e3 * 10.0 ** rng.uniform(-0.3, 0.3, 62))
    order = rng.permutation(64)
    sources = bf.SourceCatalog(x[order], y[order], flux)
    lens = bf.PolynomialDistortion.polynomial(1)
    detector = bf.Detector((257, 257), pixel="box")
    model = bf.ForwardModel(detector, sources, bf.MoffatPSF(1.5, 3.5), lens)
    mean = model.expected_counts(np.zeros(4), 500.0)
    places = np.array([sources.x[[2, 0]] + [4.0, 14.0], sources.y[[2, 0]]])
    more = replace(model, sources=bf.SourceCatalog(*places, [3e3, 3e3]))
    counts = rng.poisson(mean + others * more.expected_counts(np.zeros(4)))
    nuisances = bf.Nuisances("free", offset=True, footprint=16.0)
    narrow = replace(model, psf=bf.GaussianPSF(0.64))
    return bf.Posterior(narrow, counts, mask=counts < full, nuisances=nuisances), places


def test_light_beside_a_saturated_star_is_its_own() -> None:
    """It had been 10 to 31 sources a frame; one in ten frames takes a star's misfit for one."""
    false = 0
    for seed in range(4):
        posterior, places = saturated(seed, 1e4, others=True)
        found, none = looked(posterior), looked(saturated(seed, 1e4, others=False)[0])
        off = np.hypot(*(np.array([found.u, found.v])[:, :, None] - places[:, None]))
        assert np.all(off.min(axis=0) < 0.3)
        assert not set(found.hidden) & {0, 1} and not set(none.hidden) & {0, 1}
        false += len(found.u) - 2 + len(none.u)
    assert false <= 2


def test_masked_pixels_that_are_no_stars_hide_nothing() -> None:
    """The negative control: a masked column beside a source that the catalogue lacks."""
    posterior, places = saturated(0, 1e4, others=True)
    u, v = places[:, 0]
    column = round(u + 128) + 2
    valid = posterior.valid.copy()
    rows = slice(round(v + 128) - 9, round(v + 128) + 10)
    assert np.hypot(posterior.model.sources.x - u - 2.0, posterior.model.sources.y - v).min() > 4.0
    valid[rows, column] = False
    found = looked(replace(posterior, valid=valid, mask=posterior.mask & valid))
    off = np.hypot(*(np.array([found.u, found.v])[:, :, None] - places[:, None]))
    assert np.all(off.min(axis=0) < 0.3)


def test_a_source_far_off_its_place_is_left_out_whole() -> None:
    """It is taken for one that the catalogue lacks, and little else is left of its pixels."""
    sources = planted.field(5)
    model = planted.camera(sources, psf=bf.GaussianPSF(1.2))
    there = replace(sources, x=sources.x + 4.0 * (np.arange(len(sources)) == 7))
    mean = replace(model, sources=there).expected_counts(planted.THETA, planted.LEVEL)
    counts = np.random.default_rng(5).poisson(mean)
    nuisances = bf.Nuisances("free", offset=True, footprint=6.0)
    posterior = bf.Posterior(model, counts, nuisances=nuisances)
    found = looked(posterior)
    assert found.hidden.tolist() == [7]
    assert found.message.endswith("hidden by them: rows 7 of the catalogue, from 0")
    image = posterior.likelihood.image_positions(bf.find_map(posterior).params)[7]
    u, v = model.detector.pixel_centres()
    near = np.hypot(u - image[0], v[:, None] - image[1]) < 6.0
    assert near.any() and not found.mask[near].any()
    estimate = bf.find_map(replace(bf.follow_images(posterior), mask=found.mask))
    assert estimate.at_maximum and estimate.fits_data


def test_positions_and_photons_have_their_errors() -> None:
    model = planted.camera(planted.field(3))
    rng, z, off = np.random.default_rng(3), [], []
    at, flux = (30.3, -71.6), 3000.0
    light = replace(model, sources=bf.SourceCatalog(*np.array([at]).T, [flux]))
    mean = model.expected_counts(planted.THETA, 20.0) + light.expected_counts(0 * planted.THETA)
    for _ in range(100):
        posterior = bf.Posterior(model, rng.poisson(mean))
        params = np.append(planted.THETA, 20.0)
        found = bf.find_uncatalogued(posterior, estimate_at(params))
        k = np.argmin(np.hypot(found.u - at[0], found.v - at[1]))
        z.append((found.photons[k] - flux) / found.sd[k])
        off.append([found.u[k] - at[0], found.v[k] - at[1]])
    assert 0.75 < np.std(z) < 1.25  # +- 0.07; it is the highest of nearby pixels, too
    assert abs(np.mean(z)) < 0.4  # +- 0.1
    assert np.all(np.abs(np.mean(off, axis=0)) < 0.1) and np.abs(off).max() < 0.5


def estimate_at(params: Floats) -> bf.MapEstimate:
    return bf.MapEstimate(params, np.eye(params.size), 0.0, 0, "")


@pytest.mark.parametrize("rejecting", [True, False])
def test_a_rough_search_ends_near_the_maximum(rejecting: bool) -> None:
    sources = planted.field(6)
    model = planted.camera(sources)
    counts = planted.counts(model, 6)
    row, column = np.argwhere(model.expected_counts(planted.THETA) < 1e-3)[500]
    counts[row : row + 3, column : column + 3] += 300.0 * rejecting  # of no source
    posterior = bf.Posterior(model, counts, nuisances=bf.Nuisances("free", offset=True))
    kept, near = approach(posterior, rejecting=rejecting)
    assert kept.mask[row + 1, column + 1] != rejecting
    assert len(kept.model.sources) == len(sources)
    top = bf.find_map(kept, near.params)
    off = near.params - top.params
    assert np.sqrt(off @ np.linalg.solve(top.covariance, off)) < 0.2
    # negative control: where it began
    off = posterior.start() - top.params
    assert np.sqrt(off @ np.linalg.solve(top.covariance, off)) > 5.0


def test_a_rough_search_refuses_what_the_frame_cannot_determine() -> None:
    sources = bf.SourceCatalog([0.0, 20.0], [0.0, 5.0], [5e3, 5e3])
    model = planted.camera(sources, distortion=bf.PolynomialDistortion.polynomial(3))
    counts = bf.simulate(model, np.zeros(18), 5.0, seed=1)
    flat = {name: stats.norm(0.0, 1e3) for name in model.distortion.names}
    with pytest.raises(bf.InputError, match="the frame cannot determine"):
        approach(bf.Posterior(model, counts, prior=flat))


def test_a_run_prints_what_it_masks(tmp_path: Path) -> None:
    run = write(tmp_path, '[nuisances]\nflux = "free"\nfootprint = 8.0')
    frame = tmp_path / "frame.fits"
    with fits.open(frame) as hdus:
        stored, header = np.array(hdus[0].data), hdus[0].header
    v, u = np.indices(stored.shape) - 59.5
    stored += 2000.0 / (8.0 * np.pi * GAIN) * np.exp(-((u - 6.0) ** 2 + (v - 4.0) ** 2) / 8.0)
    fits.PrimaryHDU(stored, header).writeto(frame, overwrite=True)
    posterior, estimate, notes = pipeline.read_frame(read_settings(run), run, None)
    assert notes[2].startswith("footprints: ")
    assert notes[3].startswith("1 source that the catalogue lacks: (5.9, 3.9) ")
    assert notes[3].endswith(" pixels masked")
    assert estimate is not None and estimate.fits_data
    assert not posterior.mask[round(59.5 + 4.0), round(59.5 + 6.0)]
    # negative control: without footprints nothing is asked, and the model does not fit
    (tmp_path / "run.toml").write_text(RUN + '[nuisances]\nflux = "free"')
    posterior, estimate, notes = pipeline.read_frame(read_settings(run), run, None)
    assert estimate is None and not bf.find_map(posterior).fits_data
