"""Sigma clipping: spots of no source, and sources without a spot, are left out, and the error bars
of the rest hold."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize import outliers
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map, reject_outliers
from bayesfred.optimize.matching import Field
from bayesfred.optimize.outliers import reject, reject_once, share_lost

Floats = NDArray[np.float64]

COMPLETE = PolynomialDistortion.full_polynomial(3)
FLUX, BACKGROUND = 1e4, 2.0


def frame(
    seed: int,
    n: int = 8,
    spacing: float = 20.0,
    sigma: float = 2.0,
    nuisances: Nuisances = Nuisances(),
    binning: int = 1,
) -> tuple[Posterior, Floats, NDArray[np.int64], Floats]:
    """A grid of 9 x 9 stars without n of them, and with n spots elsewhere: posterior, truth, stars
    without a spot, spots."""
    rng = np.random.default_rng(seed)
    sources = SourceCatalog.grid(9, spacing, FLUX)
    detector = Detector((round(11 * spacing / binning),) * 2, binning)
    model = ForwardModel(detector, sources, GaussianPSF(sigma), COMPLETE)
    missing = np.sort(rng.choice(81, n, replace=False))
    spots = rng.uniform(-4.0, 4.0, (2, n)) * spacing
    scale = Field(Posterior(model, np.ones(detector.shape))).scale
    theta = 0.03 * scale * rng.standard_normal(scale.size)
    x, y = (
        np.append(np.delete(axis, missing), more)
        for axis, more in zip((sources.x, sources.y), spots, strict=True)
    )
    real = ForwardModel(detector, SourceCatalog(x, y, np.full(x.size, FLUX)), model.psf, COMPLETE)
    counts = simulate(real, theta, BACKGROUND * binning**2, seed=seed)
    posterior = Posterior(model, counts, nuisances=nuisances)
    known = dict(zip(COMPLETE.names, theta, strict=True)) | {
        "background": BACKGROUND * binning**2,
        "flux_scale": 1.0,
    }
    return (
        posterior,
        np.array([known.get(name, 0.0) for name in posterior.parameter_names]),
        missing,
        spots.T,
    )


def square(truth: Floats, estimate: MapEstimate) -> float:
    """Squared Mahalanobis distance of the truth, which is chi-square distributed where error bars
    hold."""
    d = truth - estimate.params
    return float(d @ np.linalg.solve(estimate.covariance, d))


def pixels(posterior: Posterior, places: Floats) -> NDArray[np.int64]:
    """Columns and rows of places in fine pixels."""
    detector = posterior.model.detector
    return np.rint(places / detector.binning + 0.5 * (detector.shape[0] - 1)).astype(int).T


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"sigma": 3.0, "binning": 2},
        {"nuisances": Nuisances(offset=True)},
        {"nuisances": Nuisances("scale")},
    ],
)
def test_missing_sources_and_foreign_spots_are_left_out_and_nothing_else(
    options: dict[str, Any],
) -> None:
    posterior, truth, missing, spots = frame(1, **options)
    found = reject_once(posterior, truth)
    assert np.flatnonzero(found.missing).tolist() == missing.tolist()
    column, row = pixels(posterior, spots)
    assert not found.posterior.mask[row, column].any()
    v, u = np.nonzero(~found.posterior.mask)
    distance = np.hypot(u[:, None] - column, v[:, None] - row).min(axis=1)
    assert distance.max() < 7.0 * posterior.model.psf.sigma / posterior.model.detector.binning
    s = posterior.model.sources
    assert np.array_equal(found.posterior.model.sources.x, np.delete(s.x, missing))
    assert 0.85 < found.posterior.mask.mean() < 1.0
    # negative control: of a frame that holds what the catalogue says nothing is left out
    clean, truth, *_ = frame(1, n=0, **options)
    assert reject_once(clean, truth).posterior is clean


def test_what_is_masked_is_the_light_of_the_spots() -> None:
    posterior, truth, _, spots = frame(1)
    found, model = reject_once(posterior, truth), posterior.model
    foreign = ForwardModel(
        model.detector, SourceCatalog(*spots.T, np.full(8, FLUX)), model.psf, COMPLETE
    )
    light = foreign.expected_counts(truth[: COMPLETE.n_terms]) / found.posterior.sigma(truth)
    assert light[found.posterior.mask].max() < 0.5  # standard deviations
    assert found.posterior.mask[light < 1e-6].all()


def test_a_faint_neighbour_of_a_bright_spot_is_not_missing() -> None:
    sources = SourceCatalog(
        [0.0, 30.0, -30.0, 0.0], [0.0, 30.0, 30.0, -35.0], [2e3, FLUX, FLUX, FLUX]
    )
    model = ForwardModel(Detector((101, 101)), sources, GaussianPSF(2.0), COMPLETE)
    theta = np.zeros(COMPLETE.n_terms)
    foreign = replace(
        model, sources=SourceCatalog([6.0, *sources.x], [0.0, *sources.y], [4e4, *sources.flux])
    )
    posterior = Posterior(model, simulate(foreign, theta, BACKGROUND, seed=1))
    found = reject_once(posterior, np.append(theta, BACKGROUND))
    assert not found.missing.any() and not found.posterior.mask[50, 56]
    # negative control: in the filtered frame it stands in the spot's dark ring, and lacks more than
    # its light
    residual = posterior.counts - posterior.expected_counts(np.append(theta, BACKGROUND))
    assert ndimage.gaussian_laplace(residual, 2.0)[50, 50] > 2e3 / (4.0 * np.pi * 2.0**4)
    # and the other way round: the faint source is missing, the spot, now in the catalogue, is there
    without = replace(
        model,
        sources=SourceCatalog(
            [6.0, *sources.x[1:]], [0.0, *sources.y[1:]], [4e4, *sources.flux[1:]]
        ),
    )
    lacking = Posterior(foreign, simulate(without, theta, BACKGROUND, seed=1))
    assert np.flatnonzero(reject_once(lacking, np.append(theta, BACKGROUND)).missing).tolist() == [
        1
    ]


def test_spots_are_bent_as_the_distortion_bends_them() -> None:
    """Near the corner of a field that makes spots a third wider there, looks with round spots leave
    3.9 instead of 0.2."""
    model = ForwardModel(
        Detector((201, 201)), SourceCatalog.grid(7, 25.0, 3e4), GaussianPSF(3.0), COMPLETE
    )
    theta = np.zeros(COMPLETE.n_terms)
    theta[[COMPLETE.names.index("f_u2x"), COMPLETE.names.index("g_v2y")]] = -4e-5
    star = replace(model, sources=SourceCatalog([62.0], [62.0], [3e5]))
    posterior = Posterior(
        model, simulate(model, theta, BACKGROUND, seed=1) + simulate(star, theta, 0.0, seed=2)
    )
    found = reject_once(posterior, np.append(theta, BACKGROUND))
    noise = found.posterior.sigma(np.append(theta, BACKGROUND))
    light = star.expected_counts(theta) / noise
    assert light[found.posterior.mask].max() < 0.5 and not found.missing.any()
    # negative control: what a round spot in its place does not cover
    u, v = COMPLETE.image_position(theta, 62.0, 62.0)
    round_spot = replace(
        model, sources=SourceCatalog([float(u)], [float(v)], [3e5])
    ).expected_counts(np.zeros_like(theta))
    assert light[round_spot < 0.3 * noise].max() > 2.0


def test_dead_pixels_are_masked() -> None:
    posterior, truth, *_ = frame(2, n=0)
    counts = posterior.counts.copy()
    counts[108:113, 108:113] = 0.0  # the star in the middle, half of it
    dead = Posterior(posterior.model, counts)
    found = reject_once(dead, truth)
    assert found.missing[40] or not found.posterior.mask[108:113, 108:113].any()
    assert found.missing.sum() <= 1


def test_wrong_parameters_are_not_blamed_on_the_catalogue() -> None:
    posterior, truth, *_ = frame(1)
    elsewhere = Posterior(posterior.model, np.roll(posterior.counts, 10, axis=1))  # half a spacing
    assert reject_once(elsewhere, truth, (0.0, 0.3)).posterior is elsewhere
    assert reject_once(elsewhere, truth).missing.sum() < 10
    # half a PSF's width off, bright stars stand out as much as foreign spots, but for a tolerance
    shifted = Posterior(posterior.model, np.roll(posterior.counts, 1, axis=1))
    assert reject_once(shifted, truth, (0.0,)).posterior is shifted
    assert 8 <= reject_once(shifted, truth).missing.sum() < 20
    # where no pixel would be left, none is left out
    few = np.zeros(posterior.counts.shape, bool)
    few[100:103, 100:103] = True
    bright = Posterior(posterior.model, np.where(few, 1e4, 0.0), mask=few)
    assert reject_once(bright, truth).posterior is bright


def test_free_fluxes_fall_where_a_source_is_missing() -> None:
    posterior, truth, missing, spots = frame(1, nuisances=Nuisances("free"))
    found = reject_once(posterior, truth)
    column, row = pixels(posterior, spots)
    assert not found.posterior.mask[row, column].any()
    s = (
        posterior.model.sources
    )  # a star that a spot touches took its light, and lacks it in its middle
    touched = (
        np.hypot(s.x[:, None] - spots[:, 0], s.y[:, None] - spots[:, 1]).min(axis=1)
        < 4.0 * posterior.model.psf.sigma
    )
    assert not found.missing[~touched].any()
    assert posterior.fluxes(truth)[missing].max() < 0.5 * FLUX


def test_masked_pixels_hold_nothing_to_reject() -> None:
    posterior, truth, missing, spots = frame(1)
    v, u = np.indices(posterior.counts.shape) - 0.5 * (posterior.counts.shape[0] - 1)
    s = posterior.model.sources
    mask = np.ones(posterior.counts.shape, bool)
    for x, y in [*spots, *zip(s.x[missing], s.y[missing], strict=True)]:
        mask &= (u - x) ** 2 + (v - y) ** 2 > 12.0**2
    counts = np.where(mask, posterior.counts, 1e6)
    masked = Posterior(posterior.model, counts, mask=mask)
    assert reject_once(masked, truth).posterior is masked
    clipped, estimate = reject_outliers(masked)
    assert clipped is masked and "left out" not in estimate.message


def test_clean_frames_are_fitted_whole() -> None:
    posterior, *_ = frame(3, n=0)
    clipped, estimate = reject_outliers(posterior)
    assert clipped is posterior and square(find_map(posterior).params, estimate) < 1e-5
    assert "left out" not in estimate.message and "left out" not in find_map(posterior).message


@pytest.mark.statistics
def test_error_bars_hold_where_a_tenth_is_missing_and_a_tenth_foreign() -> None:
    """Ten frames: their mean chi-square per parameter has a Monte Carlo error of sqrt(2 / 470) =
    0.065."""
    squares, whole = [], []
    for seed in range(10):
        posterior, truth, missing, _ = frame(seed)
        clipped, estimate = reject_outliers(posterior)
        assert (
            estimate.at_maximum
            and estimate.fits_data
            and f"{81 - len(clipped.model.sources)} sources" in estimate.message
        )
        assert len(clipped.model.sources) == 81 - len(missing)
        squares.append(square(truth, estimate) / truth.size)
        whole.append(find_map(posterior, truth))
    assert abs(np.mean(squares) - 1.0) < 4.0 * 0.065
    # negative control: of the whole posterior, though the search begins at the truth, none fits
    assert not any(estimate.at_maximum and estimate.fits_data for estimate in whole)
    assert (
        sum(
            estimate.at_maximum and square(truth, estimate) < 4.0 * truth.size for estimate in whole
        )
        == 0
    )


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_same_is_left_out_wherever_the_search_begins(seed: int) -> None:
    posterior, truth, *_ = frame(seed)
    mine, estimate = reject_outliers(posterior)
    other, best = reject_outliers(posterior, truth)
    assert np.array_equal(mine.model.sources.x, other.model.sources.x)
    assert square(best.params, estimate) < 0.1
    # negative control: what is left out from a start a quarter of a PSF's width off, before any
    # climb
    off = truth.copy()
    off[: COMPLETE.n_terms] += 0.01 * Field(posterior).scale
    assert not np.array_equal(reject_once(posterior, off).posterior.mask, mine.mask)
    assert np.array_equal(reject(posterior, off)[0].missing, reject_once(posterior, truth).missing)


def crowded(seed: int) -> tuple[Posterior, Floats]:
    """196 stars 2.6 widths apart, a tenth of them missing and as many foreign ones."""
    rng = np.random.default_rng(seed)
    grid = SourceCatalog.grid(14, 5.2, 1e3)
    terms = [(1, 0, 1, 0), (1, 0, 0, 1), (2, 0, 1, 0)], [(0, 1, 0, 1), (0, 1, 1, 0), (0, 2, 0, 1)]
    detector, distortion = Detector((101, 101)), PolynomialDistortion(*terms)
    model = ForwardModel(detector, grid, GaussianPSF(2.0), distortion)
    priors = Posterior(model, np.ones((101, 101))).prior.values()
    while True:  # until a map is not folded
        theta = 3.0 * np.array([p.std() for p in list(priors)[:6]]) * rng.standard_normal(6)
        there = np.sort(rng.permutation(196)[20:])
        kept = SourceCatalog(grid.x[there], grid.y[there], grid.flux[there])
        mean = replace(model, sources=kept).expected_counts(theta) + 2.0
        if np.all(np.isfinite(mean)):
            break
    spots = SourceCatalog(*rng.uniform(-45.0, 45.0, (2, 20)), np.full(20, 1e3))
    mean += replace(model, sources=spots).expected_counts(np.zeros(6))
    return Posterior(model, rng.poisson(mean).astype(float)), np.append(theta, 2.0)


@pytest.mark.statistics
def test_crowded_fields_are_right_or_said_not_to_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """40 frames in which half of the field can be taken for outliers.

    What is said to fit is at the truth: of the seven parameters none is off by ten standard
    deviations, as all are that were found half a pitch away.
    """

    def off(said: MapEstimate, truth: Floats) -> float:
        return float(np.abs((said.params - truth) / np.sqrt(np.diag(said.covariance))).max())

    right, silent = 0, 0
    for seed in range(40):
        posterior, truth = crowded(seed)
        with monkeypatch.context() as patched:
            _, estimate = reject_outliers(posterior)
            patched.setattr("bayesfred.optimize.find_map.BREAKDOWN", 1.0)  # negative control
            _, careless = reject_outliers(posterior)
        wrong = off(estimate, truth) > 10.0
        right += not wrong and estimate.fits_data
        silent += off(careless, truth) > 10.0 and careless.fits_data
        assert not (wrong and estimate.fits_data), f"seed {seed}: {estimate.message}"
    assert right >= 20
    assert silent >= 1


def test_more_is_tolerated_where_more_than_some_would_be_lost() -> None:
    """Of 81 stars 8 are lost with either limit, 24 with the higher one alone."""
    for n, tolerated in (8, False), (24, True):
        posterior, truth, *_ = frame(2, n=n)
        share, fewer = (
            reject_once(posterior, truth, outliers.COARSE, most).share
            for most in (outliers.MOST, outliers.SOME)
        )
        assert share >= n / 81
        assert (fewer == share) != tolerated
        assert fewer <= outliers.SOME


def test_the_share_of_lost_sources_counts_removed_and_masked_ones() -> None:
    posterior, truth, *_ = frame(3, n=0)
    s = posterior.model.sources
    kept = replace(s, x=s.x[5:], y=s.y[5:], flux=s.flux[5:])  # 5 removed
    mask = posterior.mask.copy()
    mask[:60] = False
    rest = Posterior(replace(posterior.model, sources=kept), posterior.counts, mask=mask)
    images = posterior.likelihood.image_positions(truth)
    row = np.rint(images[:, 1] + 0.5 * (len(mask) - 1))
    lost = 5 + np.sum(row[5:] < 60)
    assert 10 < lost < 40
    assert share_lost(posterior, rest, truth) == pytest.approx(lost / 81)
    assert share_lost(posterior, posterior, truth) == 0.0
    assert share_lost(replace(posterior, mask=mask), rest, truth) == pytest.approx(
        5 / (5 + np.sum(row[5:] >= 60))
    )  # masked before


@pytest.mark.parametrize("tolerance", [0.0, 0.3])
def test_looks_at_parts_of_a_frame_find_what_looks_at_all_of_it_do(
    tolerance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    posterior, truth, *_ = frame(3, spacing=12.0)
    posterior.mask[40:60, 70:90] = False
    wrong = truth + np.append(0.3 * truth[:-1], 0.0)

    def found() -> tuple[Any, Any]:
        return outliers._Residuals(posterior, wrong).outliers(tolerance)

    monkeypatch.setattr(outliers, "MOSTLY", 1.0)
    in_parts = found()
    ny, nx = posterior.mask.shape
    everything = [(slice(0, ny), slice(0, nx))]
    monkeypatch.setattr(outliers._Residuals, "_regions", lambda self, some: everything)
    whole = found()
    assert all(np.array_equal(a, b) for a, b in zip(in_parts, whole, strict=True))
    assert whole[0].any() and not whole[1].all()
    # negative control: later looks are needed
    monkeypatch.setattr(outliers, "LOOKS", 1)
    assert not np.array_equal(found()[1], whole[1])
