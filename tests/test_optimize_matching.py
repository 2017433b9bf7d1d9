"""Starts from counts alone: peaks, matching outward, growing disks; and what `find_map` says about
where it ended."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import spatial

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.logarithm import LogDistortion
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import BackgroundNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize import find_map as search
from bayesfred.optimize import starts
from bayesfred.optimize.find_map import find_map, reject_outliers
from bayesfred.optimize.growing_disk import maximize_outward
from bayesfred.optimize.matching import Field, match
from bayesfred.optimize.newton import NewtonResult, maximize
from bayesfred.optimize.peaks import find_peaks
from bayesfred.optimize.starts import find_start

Floats = NDArray[np.float64]

MIRRORED = PolynomialDistortion.mirrored()
PINHOLE = PolynomialDistortion.pinhole()
# the cubic lens of the pinhole camera, r -> r (1 - k r^2), pointing inwards for k > 0
CUBIC = PolynomialDistortion([(3, 0, 0, 0), (1, 2, 0, 0)], [(2, 1, 0, 0), (0, 3, 0, 0)])


def grid(
    side: int = 9,
    spacing: float = 20.0,
    sigma: float = 2.0,
    distortion: PolynomialDistortion = CUBIC,
) -> ForwardModel:
    """A square of stars with a margin of one and a half spacings."""
    n = round((side + 2) * spacing) | 1
    return ForwardModel(
        Detector((n, n)), SourceCatalog.grid(side, spacing, 5e3), GaussianPSF(sigma), distortion
    )


def lens(model: ForwardModel, moved: float) -> Floats:
    """Coefficients of CUBIC that move the corner star inwards by so many pixels."""
    radius = np.hypot(model.sources.x, model.sources.y).max()
    return np.full(4, moved / radius**3)


def bent(model: ForwardModel, moved: float) -> Floats:
    """Coefficients of PINHOLE that shift stars along x by up to so many pixels and shear them along
    y."""
    theta = np.zeros(8)
    theta[[0, 4]] = np.array([-0.8, 0.8]) * moved / model.sources.x.max() ** 2
    return theta


def images(model: ForwardModel, theta: Floats) -> Floats:
    return np.stack(
        model.distortion.image_position(theta, model.sources.x, model.sources.y), axis=1
    )


def error(model: ForwardModel, theta: Floats, truth: Floats) -> float:
    """Largest distance between predicted and true images."""
    return float(np.hypot(*(images(model, theta) - images(model, truth)).T).max())


def distance(posterior: Posterior, truth: Floats) -> float:
    """Between the maxima found from counts alone and from the truth, in standard deviations."""
    found, best = find_map(posterior), find_map(posterior, truth)
    d = found.params - best.params
    return float(np.sqrt(d @ np.linalg.solve(best.covariance, d)))


# --- linear least squares and matching ------------------------------------------------------------


@pytest.mark.parametrize(
    "distortion", [PolynomialDistortion.paper(), MIRRORED, PolynomialDistortion.pinhole()]
)
def test_exact_positions_give_the_coefficients(distortion: PolynomialDistortion) -> None:
    rng = np.random.default_rng(1)
    model = grid(distortion=distortion)
    posterior = Posterior(model, np.ones(model.detector.shape), nuisances=Nuisances(offset=True))
    field = Field(posterior)
    z = 0.3 * field.scale * rng.standard_normal(field.scale.size)
    z[-2:] = 3.0, -2.0
    position = field.predict(z)
    # the equations hold at the images, whose offset moves the source and not the lever
    residual = (
        field.design(field.everyone, position) @ z + position.T - [model.sources.x, model.sources.y]
    )
    assert np.abs(residual).max() < 1e-9
    solved, covariance = field.fit(field.everyone, position, 1e-6)
    assert np.abs((solved - z) / field.scale).max() < 1e-6
    assert np.abs(solved - z).max() < 10.0 * np.sqrt(np.diag(covariance)).max()


@pytest.mark.parametrize("moved", [10.0, 30.0])
def test_missing_and_spurious_peaks_do_not_bend_the_match(moved: float) -> None:
    rng = np.random.default_rng(2)
    model = grid(distortion=PINHOLE)
    truth = bent(model, moved)
    field = Field(Posterior(model, np.ones(model.detector.shape)))
    errors = []
    for _ in range(20):
        true = images(model, truth)
        seen = true[rng.random(len(true)) > 0.1]
        peaks = np.concatenate(
            [seen + 0.1 * rng.standard_normal(seen.shape), rng.uniform(-110, 110, (8, 2))]
        )
        z, _, matched = match(field, rng.permutation(peaks))
        assert matched <= len(seen) + 8
        errors.append(error(model, z, truth))
    assert max(errors) < model.psf.sigma


def test_nearest_neighbours_alone_fail_where_stars_move_by_more_than_their_spacing() -> None:
    """The negative control of the next test: without going outward the same least squares is
    lost."""
    model = grid(distortion=PINHOLE)
    truth = bent(model, 30.0)
    posterior = Posterior(model, simulate(model, truth, 2.0, seed=3))
    field = Field(posterior)
    peaks = images(model, truth)
    undistorted = np.stack([model.sources.x, model.sources.y], axis=1)
    _, nearest = spatial.cKDTree(peaks).query(undistorted)
    assert error(model, field.fit(field.everyone, peaks[nearest], 0.4)[0], truth) > 20.0
    assert error(model, match(field, peaks)[0], truth) < 0.1
    # and so is the climb from no distortion
    assert maximize(posterior, posterior.start()).log_prob < find_map(posterior).log_prob - 1e4


@pytest.mark.parametrize("nuisances", [Nuisances(), Nuisances("free"), Nuisances("scale")])
def test_maximum_is_found_where_stars_move_by_one_and_a_half_spacings(nuisances: Nuisances) -> None:
    model = grid(distortion=PINHOLE)
    truth = bent(model, 30.0)
    moved = images(model, truth) - np.stack([model.sources.x, model.sources.y], axis=1)
    assert np.hypot(*moved.T).max() > 30.0
    posterior = Posterior(model, simulate(model, truth, 2.0, seed=3), nuisances=nuisances)
    assert distance(posterior, np.append(truth, [2.0, 1.0])[: posterior.n_parameters]) < 0.01
    best = find_map(posterior)
    assert (
        best.at_maximum
        and best.fits_data
        and "matched peaks" in best.message
        and "81 of 81 sources" in best.message
    )


def test_distortions_that_the_prior_holds_for_unlikely_are_found() -> None:
    model = grid(distortion=PINHOLE)
    truth = np.append(-30.0 / model.sources.x.max() ** 2, np.zeros(7))
    posterior = Posterior(model, simulate(model, truth, 2.0, seed=3))
    assert abs(truth[0]) > 5.0 * posterior.prior["f_x2"].std()
    assert distance(posterior, np.append(truth, 2.0)) < 0.01


def test_an_unknown_pointing_is_found_on_a_grid() -> None:
    """Pointings that differ by the grid's spacing put most stars on peaks; only the right one puts
    all of them there."""
    model = grid()
    truth = lens(model, 20.0)
    counts = np.roll(simulate(model, truth, 2.0, seed=3), (-7, 12), axis=(0, 1))
    best = find_map(Posterior(model, counts, nuisances=Nuisances(offset=True)))
    assert best.at_maximum and best.fits_data
    assert (
        np.abs((best.params - [*truth, 2.0, 12.0, -7.0]) / np.sqrt(np.diag(best.covariance))).max()
        < 5.0
    )


def test_blends_of_unequal_stars_with_some_missing_and_some_spurious() -> None:
    rng = np.random.default_rng(12)
    x, y = rng.uniform(-80.0, 80.0, (2, 80))
    flux = 5e3 * rng.lognormal(0.0, 1.0, 80)
    here = rng.random(80) > 0.1
    model = ForwardModel(Detector((221, 221)), SourceCatalog(x, y, flux), GaussianPSF(2.0), PINHOLE)
    spots = SourceCatalog(
        np.append(x[here], rng.uniform(-80, 80, 8)),
        np.append(y[here], rng.uniform(-80, 80, 8)),
        np.append(flux[here], rng.choice(flux, 8)),
    )
    frame = simulate(
        ForwardModel(model.detector, spots, model.psf, PINHOLE), bent(model, 20.0), 2.0, seed=12
    )
    posterior = Posterior(model, frame)
    assert 0.2 < np.mean(Field(posterior).alone) < 0.9
    assert distance(posterior, np.append(bent(model, 20.0), 2.0)) < 0.01
    best = find_map(posterior)
    assert (
        best.at_maximum
        and not best.fits_data
        and "unmatched sources or spurious detections" in best.message
    )


# --- peaks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sigma", "detector"),
    [
        (2.0, Detector((181, 181))),
        (9.0, Detector((181, 181))),
        (3.0, Detector((60, 61), 3, "box")),
    ],
)
def test_peaks_stand_where_stars_are_imaged(sigma: float, detector: Detector) -> None:
    sources = SourceCatalog([-50.3, 20.7, 60.1, 4.4], [-40.2, -35.6, 50.9, 44.3], [2e4] * 4)
    model = ForwardModel(detector, sources, GaussianPSF(sigma), CUBIC)
    posterior = Posterior(model, simulate(model, np.zeros(4), 3.0, seed=4))
    peaks = find_peaks(posterior)
    near, _ = spatial.cKDTree(peaks[:4]).query(np.stack([sources.x, sources.y], axis=1))
    assert near.max() < 0.15 * sigma + 0.1 * detector.binning


def test_masked_pixels_hold_no_peaks() -> None:
    model = grid()
    counts = simulate(model, np.zeros(4), 2.0, seed=5)
    mask = np.ones(counts.shape, bool)
    mask[80:140, 60:130] = False
    counts[100, 100] = 1e6
    peaks = find_peaks(Posterior(model, counts, mask=mask))
    centre = 0.5 * (counts.shape[0] - 1)
    column, row = np.rint(peaks + centre).astype(int).T
    assert len(peaks) > 50 and mask[row, column].all()
    assert distance(Posterior(model, counts, mask=mask), np.append(np.zeros(4), 2.0)) < 0.01


def test_a_frame_without_peaks_still_gives_a_start() -> None:
    model = grid(side=3)
    begun = find_start(
        Posterior(model, np.random.default_rng(6).poisson(2.0, model.detector.shape))
    )
    assert begun.matched < 3 and np.abs(begun.params[:4]).max() < 1e-4


# --- folds ----------------------------------------------------------------------------------------


def test_no_start_folds(monkeypatch: pytest.MonkeyPatch) -> None:
    model = grid(side=5, distortion=MIRRORED)
    posterior = Posterior(model, simulate(model, np.zeros(12), 2.0, seed=7))
    folded = np.zeros(12)
    folded[
        [2, 8]
    ] = -1e-3  # u^2 x and u^2 y: u - x - u^2 x / 1000 = 0 has no solution for the outer stars
    assert posterior.log_prob(np.append(folded, 2.0)) == -np.inf
    monkeypatch.setattr(starts, "match", lambda field, peaks: (folded, np.zeros((12, 12)), 25))
    begun = starts.find_start(posterior)
    assert np.isfinite(posterior.log_prob(begun.params))
    # without the way back there would be nowhere to climb from
    monkeypatch.setattr(starts, "with_density", lambda posterior, params, plain: params)
    assert starts.find_start(posterior).path == "the prior's medians"


def test_a_search_that_ends_at_no_maximum_is_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    model = grid(side=5, distortion=MIRRORED)
    posterior = Posterior(model, simulate(model, np.zeros(12), 2.0, seed=7))
    begun = starts.find_start(posterior)
    lost = NewtonResult(
        begun.params, float(posterior.log_prob(begun.params)), np.full((13, 13), np.nan), np.inf, 9
    )
    monkeypatch.setattr(
        search,
        "maximize",
        lambda p, begin, **known: (
            lost if np.array_equal(begin, begun.params) else maximize(p, begin)
        ),
    )
    found = find_map(posterior)
    assert found.at_maximum and found.fits_data and "the prior's medians" in found.message
    assert found.n_evaluations > lost.evaluations
    monkeypatch.setattr(search, "other_starts", lambda posterior, tried: iter(()))
    assert not find_map(posterior).at_maximum


@pytest.mark.parametrize("conserve_flux", [True, False])
def test_a_second_image_in_the_frame_is_outside_the_prior(conserve_flux: bool) -> None:
    """u - x + c x u^2 = 0 has a second root, where D < 0, at u = -46 for x = 40 and c = 1e-3, and
    at -285 for c = 1e-4."""
    distortion = PolynomialDistortion([(1, 0, 2, 0)], [])
    for x, half, c, folds in [
        (40.0, 60, 1e-3, True),
        (40.0, 60, 1e-4, False),
        (40.0, 300, 1e-4, True),
        (40.0, 200, 1e-4, False),
    ]:
        detector = Detector((61, 2 * half + 1))
        model = ForwardModel(
            detector,
            SourceCatalog([x], [0.0], [1e4]),
            GaussianPSF(2.0),
            distortion,
            conserve_flux=conserve_flux,
        )
        u, v = distortion.image_position([c], x, 0.0)
        assert (
            distortion.determinant([c], u, v, x, 0.0) > 0.0
        )  # the star itself is imaged, and not mirrored
        posterior = Posterior(model, np.ones(detector.shape))
        assert np.isfinite(posterior.log_prob([c, 1.0])) != folds


def test_spots_that_are_no_images_of_the_catalogue_give_starts_with_density() -> None:
    rng = np.random.default_rng(7)
    model = grid(side=5, distortion=MIRRORED)
    for _ in range(2):
        spots = SourceCatalog(*rng.uniform(-60.0, 60.0, (2, 25)), np.full(25, 5e3))
        frame = simulate(
            ForwardModel(model.detector, spots, model.psf, MIRRORED), np.zeros(12), 2.0, seed=7
        )
        posterior = Posterior(model, frame)
        assert np.isfinite(posterior.log_prob(find_start(posterior).params))


# --- the growing disk -----------------------------------------------------------------------------


def test_stars_too_faint_for_peaks_are_found_on_a_growing_disk() -> None:
    sources = SourceCatalog.grid(9, 20.0, 80.0)  # of 81 stars four make a peak
    model = ForwardModel(Detector((221, 221)), sources, GaussianPSF(2.0), PINHOLE)
    truth = np.append(bent(model, 30.0), 10.0)
    posterior = Posterior(model, simulate(model, truth[:8], 10.0, seed=8))
    assert len(find_peaks(posterior)) < 20
    found, best = find_map(posterior), find_map(posterior, truth)
    assert "growing disk" in found.message
    assert found.log_prob == pytest.approx(best.log_prob, abs=1e-3)
    # negative control: the same climb from where the disk began is trapped
    assert maximize(posterior, posterior.start()).log_prob < best.log_prob - 100.0


@pytest.mark.filterwarnings("error")
def test_a_source_of_next_to_no_flux_overflows_nothing() -> None:
    model = grid(3)
    flux = np.append(5e-324, model.sources.flux[1:])
    faint = replace(model, sources=SourceCatalog(model.sources.x, model.sources.y, flux))
    posterior = Posterior(faint, simulate(model, np.zeros(faint.distortion.n_terms), 2.0, seed=1))
    assert not Field(posterior).alone[0] and Field(posterior).alone[8]
    assert np.isfinite(posterior.log_prob(find_start(posterior).params))
    clipped, _ = reject_outliers(posterior)  # its spot belongs to no source that is bright enough
    assert not clipped.mask.all()


def test_a_disk_grows_where_positions_scatter_too() -> None:
    model = grid(7, distortion=PolynomialDistortion([(1, 0, 2, 0)], [(0, 1, 0, 2)]))
    posterior = Posterior(
        model,
        simulate(model, [1e-5, 2e-5], 2.0, seed=1),
        nuisances=Nuisances("free", position_scatter=True),
    )
    params = maximize_outward(Field(posterior), posterior.start())
    np.testing.assert_allclose(params[:2], [1e-5, 2e-5], atol=1e-6)
    assert params.size == posterior.n_parameters == 4


def test_overlapping_stars_are_found() -> None:
    sources = SourceCatalog.grid(9, 12.0, 5e3)
    model = ForwardModel(Detector((133, 133)), sources, GaussianPSF(5.0), PINHOLE)
    truth = np.append(bent(model, 15.0), 1.0)
    posterior = Posterior(model, simulate(model, truth[:8], 1.0, seed=8))
    assert distance(posterior, truth) < 0.01
    grown = maximize(posterior, maximize_outward(Field(posterior), posterior.start()))
    assert grown.log_prob == pytest.approx(find_map(posterior, truth).log_prob, abs=1e-3)


def test_logarithmic_distortion_is_followed() -> None:
    """A distortion outside the model: corner stars move by 1.1 spacings, and the polynomial follows
    to a part of the PSF."""
    detector, sources, psf = (
        Detector((253, 253)),
        SourceCatalog.grid(9, 25.0, 2e4),
        GaussianPSF(5.0),
    )
    bent = LogDistortion(4e-5)
    posterior = Posterior(
        ForwardModel(detector, sources, psf, MIRRORED),
        simulate(ForwardModel(detector, sources, psf, bent), [], 5.0, seed=9),
    )
    u, v = bent.image_position([], sources.x, sources.y)
    assert np.hypot(u - sources.x, v - sources.y).max() > 27.5
    best = find_map(posterior)
    assert best.at_maximum and "81 of 81 sources" in best.message
    assert (
        np.hypot(*(images(posterior.model, best.params[:12]) - np.stack([u, v], axis=1)).T).max()
        < 1.0
    )


FIGURE_2C = [
    ("mirrored", MIRRORED),
    pytest.param(
        "full_polynomial(4)", PolynomialDistortion.full_polynomial(4), marks=pytest.mark.long
    ),
]


@pytest.mark.parametrize(("name", "distortion"), FIGURE_2C)
def test_the_papers_logarithmic_frame_is_fitted(
    name: str, distortion: PolynomialDistortion, record_property: Callable[[str, object], None]
) -> None:
    """Fig. 2c: corner stars move by 60 pixels, spacing 50. The paper's V, of frames of unit flux,
    is 2.8e-3."""
    detector, sources, psf = (
        Detector((505, 505)),
        SourceCatalog.grid(9, 50.0, 1e5),
        GaussianPSF(10.0),
    )
    frame = ForwardModel(
        detector, sources, psf, LogDistortion(1e-5), conserve_flux=False
    ).expected_counts([], 5.0)
    posterior = Posterior(
        ForwardModel(detector, sources, psf, distortion, conserve_flux=False),
        frame,
        noise=BackgroundNoise(),
    )
    best = find_map(posterior)
    v = float(np.sum((frame - posterior.expected_counts(best.params)) ** 2) / 1e10)
    record_property(f"V of {name}, beside the paper's 2.8e-3", v)
    assert best.at_maximum and v < 2.8e-3


# --- the verdict ----------------------------------------------------------------------------------


def test_verdict() -> None:
    model = grid(side=5)
    counts = simulate(model, np.zeros(4), 2.0, seed=10)
    good = find_map(Posterior(model, counts))
    assert good.fits_data and good.at_maximum and good.message.startswith("found")
    wrong = ForwardModel(model.detector, model.sources, GaussianPSF(2.5), CUBIC)
    bad = find_map(Posterior(wrong, counts))
    assert bad.at_maximum and not bad.fits_data
    assert "exceed the noise" in bad.message and "PSF" in bad.message
    quiet = find_map(Posterior(model, model.expected_counts(np.zeros(4), 2.0)))
    assert quiet.at_maximum and not quiet.fits_data and "check gain" in quiet.message


def test_a_psf_wider_than_the_frame_leaves_no_peaks() -> None:
    model = ForwardModel(
        Detector((24, 30)), SourceCatalog.grid(2, 10.0, 5e3), GaussianPSF(71.0), CUBIC
    )
    posterior = Posterior(model, simulate(model, np.zeros(4), 0.1, seed=1))
    assert find_peaks(posterior).shape == (0, 2)


def test_peaks_along_a_ridge_have_a_place() -> None:
    """A bright row, as a faulty detector reads out: no column of it is higher than its
    neighbours."""
    model = grid(side=3)
    counts = np.ones(model.detector.shape)
    counts[60] = 3e6
    peaks = find_peaks(Posterior(model, counts))
    assert len(peaks) > 9 and np.isfinite(peaks).all()
    assert np.abs(peaks[:, 1] - 60.0 + 0.5 * (counts.shape[0] - 1)).max() < 1e-9


def test_consistent_frames_are_called_so() -> None:
    """The deviance of true models is within 5 standard deviations of its expectation, at 0.05
    counts a pixel too."""
    model = grid(side=5)
    for seed, level in enumerate([0.05, 0.05, 0.05, 1.0, 1.0, 30.0, 30.0]):
        assert find_map(
            Posterior(model, simulate(model, lens(model, 5.0), level, seed=seed))
        ).fits_data


def test_terms_that_differ_by_the_distortion_alone_are_not_refused() -> None:
    """u x and x^2 cannot be told apart where u is nearly x, and nothing depends on it."""
    model = grid(distortion=PolynomialDistortion.full_polynomial(3))
    assert find_map(
        Posterior(model, simulate(model, np.zeros(model.distortion.n_terms), 2.0, seed=11))
    ).fits_data


class Misleading(TargetDensity):
    """A normal density whose gradient points away from its top."""

    parameter_names = ("x",)
    support = np.array([-np.inf]), np.array([np.inf])

    def log_prob(self, params: Any) -> Any:
        return -0.5 * np.sum(np.square(params), axis=-1)

    def gradient(self, params: Any) -> Floats:
        return np.asarray(params, dtype=np.float64)

    def information(self, params: Any) -> Floats:
        return np.eye(1)


def test_a_search_that_ends_below_its_start_is_not_followed() -> None:
    """Neither Newton steps nor the search in their place gain anything; both end where they
    began."""
    reached = maximize(Misleading(), np.array([1.0]))
    assert reached.params == 1.0 and reached.log_prob == -0.5 and reached.distance == 1.0
