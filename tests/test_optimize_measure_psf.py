"""Measured PSFs of frames with light that is no source's."""

from dataclasses import replace

import numpy as np
import pytest

import bayesfred as bf
from bayesfred.errors import InputError
from bayesfred.model.kernels.clusters import DOF
from bayesfred.optimize import measure_psf as measuring
from bayesfred.optimize import psf_equations
from bayesfred.optimize.measure_psf import psf_message
from bayesfred.optimize.psf_samples import likely_error

THETA, FLUX, GHOSTS = [1e-3, 0.0], 2e5, 3
SCATTER = 0.004


def frame_with_ghosts(seed: int, flux: float, width: float) -> bf.Posterior:
    """64 pinholes, three of which have a broad ghost within a few pixels, which no PSF explains."""
    pinholes, rng = bf.SourceCatalog.grid(8, 16.0, FLUX), np.random.default_rng(seed)
    lens = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    detector = bf.Detector((137, 137), pixel="box")
    which, angle = rng.choice(64, GHOSTS, replace=False), rng.uniform(0.0, 2.0 * np.pi, GHOSTS)
    x = pinholes.x[which] + 4.0 * np.cos(angle)
    y = pinholes.y[which] + 4.0 * np.sin(angle)
    ghosts = bf.SourceCatalog(x, y, np.full(GHOSTS, flux))
    mean = bf.ForwardModel(detector, pinholes, bf.MoffatPSF(3.0, 4.0), lens).expected_counts(
        THETA, 50.0
    ) + bf.ForwardModel(detector, ghosts, bf.GaussianPSF(width), lens).expected_counts(THETA, 0.0)
    return bf.Posterior(
        bf.ForwardModel(detector, pinholes, bf.GaussianPSF(1.3), lens),
        rng.poisson(mean).astype(float),
        nuisances=bf.Nuisances(flux="free", offset=True),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "flux", "width"), [(1, 3e5, 2.5), (2, 3e5, 2.5), (1, 1e6, 2.5), (1, 1e6, 4.0)]
)
def test_a_ghost_beside_a_source_runs_away_with_nothing(
    seed: int, flux: float, width: float
) -> None:
    """Once the error was 0.6 of the light and a flux 100 times the others', or there was no PSF.

    The ghost would be explained by a model error that a large flux makes large.
    """
    posterior = frame_with_ghosts(seed, flux, width)
    found, estimate = bf.measure_psf(
        posterior, bf.find_map(posterior), model_error=True, reject_outliers=True
    )
    known = dict(zip(found.parameter_names, estimate.params, strict=True))
    sd = dict(zip(found.parameter_names, np.sqrt(np.diag(estimate.covariance)), strict=True))
    assert known["model_error"] < 0.01
    off = [
        (known[name] - value) / sd[name] for name, value in zip(("f_x", "g_y"), THETA, strict=True)
    ]
    assert np.abs(off).max() < 4.5  # of 8 numbers in all
    assert sd["f_x"] < 3e-5
    assert found.likelihood.fluxes(estimate.params).max() < 5.0 * FLUX  # of one that is masked
    # what is left of broad ghosts is said: 8 standard deviations of the last one
    assert estimate.fits_data == (width < 3.0)


@pytest.mark.slow
def test_a_source_that_shows_its_wings_alone_is_masked_with_a_model_error():
    """Else its flux grows until its error covers what is wrong there."""
    posterior = frame_with_ghosts(1, 1.0, 2.5)  # of a photon
    psf, state, _ = measuring.find_psf(posterior, bf.find_map(posterior), 4, 0, 0)
    (u, v), pinholes = posterior.model.detector.pixel_centres(), posterior.model.sources
    distance = np.hypot(u - pinholes.x[27], v[:, None] - pinholes.y[27])
    hidden = replace(posterior, mask=posterior.mask & (distance > 6.0))
    for model_error in (True, False):
        found, _ = measuring._with(hidden, (psf, state), model_error, {})
        assert found.mask[(distance > 6.0) & (distance < 7.5)].all() != model_error
        assert found.mask[distance > 12.0].all()


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1])
def test_a_frame_without_a_background_has_a_psf(degree: int) -> None:
    """Its wings are known to some counts, so that means would be below 0."""
    pinholes = bf.SourceCatalog.grid(8, 16.0, FLUX)
    lens = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    detector, rng = bf.Detector((137, 137), pixel="box"), np.random.default_rng(1)
    mean = bf.ForwardModel(detector, pinholes, bf.GaussianPSF(1.5), lens).expected_counts(
        THETA, 0.0
    )
    posterior = bf.Posterior(
        bf.ForwardModel(detector, pinholes, bf.GaussianPSF(1.3), lens),
        rng.poisson(mean) + rng.normal(0.0, 5.0, mean.shape),
        noise=bf.PoissonNoise(read_noise=5.0),
        nuisances=bf.Nuisances(flux="free", offset=True),
    )
    rough = bf.find_map(posterior)
    psf, state, _ = measuring.find_psf(posterior, rough, 4, degree, 0)
    # the control: as the PSF is
    assert not np.isfinite(posterior.with_psf(psf).log_prob(state.params))
    found, estimate = bf.measure_psf(posterior, rough, degree=degree)
    assert estimate.fits_data
    known = dict(zip(found.parameter_names, estimate.params, strict=True))
    sd = dict(zip(found.parameter_names, np.sqrt(np.diag(estimate.covariance)), strict=True))
    for name, value in zip(("f_x", "g_y"), THETA, strict=True):
        assert abs(known[name] - value) < 4.0 * sd[name]
    assert known["background"] < 0.5


def test_a_wrong_background_is_no_error_of_the_light():
    """Of 1,000 bright pixels and 50,000 faint ones, whose background is off by two deviations."""
    rng, error = np.random.default_rng(1), 0.05
    light = np.concatenate([np.full(1000, 2000.0), np.full(50_000, 1.0)])
    variance = light + 100.0
    residual = rng.normal(size=light.size) * np.sqrt(variance + (error * light) ** 2)
    residual[1000:] += 20.0
    found = likely_error(residual, variance, light)
    assert abs(found - error) < 5.0 * error / np.sqrt(2.0 * 1000)
    assert likely_error(residual[1000:], variance[1000:], light[1000:]) == 0.0


@pytest.mark.slow
def test_a_psf_that_leaves_much_should_vary_more():
    posterior = frame_with_ghosts(1, 3e5, 2.5)
    known = dict(zip(posterior.parameter_names, bf.find_map(posterior).params, strict=True))
    coefficients = np.zeros((1, 9, 9))
    coefficients[0, 3:6, 3:6] = 4.0 / 9.0
    posterior = replace(
        posterior.with_psf(bf.MeasuredPSF(coefficients, 2.0, 80.0)),
        nuisances=replace(posterior.nuisances, model_error=True),
    )
    for error, said in ((0.05, "5.0% of the light unexplained"), (0.2, "(psf.degree = 2)")):
        params = np.array([{**known, "model_error": error}[n] for n in posterior.parameter_names])
        estimate = bf.find_map(posterior, params)
        assert psf_message(posterior, replace(estimate, params=params)).endswith(said)


def widening(seed: int, number: int, side: int, most: float) -> bf.Posterior:
    """Stars of a Moffat's shape that is up to `most` wider outward, taken for a Gaussian."""
    rng, terms = np.random.default_rng(seed), [(1, 0, 0, 0), (0, 1, 0, 0)]
    x, y = rng.uniform(-0.5 * side, 0.5 * side, (2, number))
    flux, lens = 10.0 ** rng.uniform(3.0, 6.0, number), bf.PolynomialDistortion(terms, terms)
    detector = bf.Detector((side, side), pixel="box")
    rings = np.digitize((x**2 + y**2) / (0.5 * side) ** 2, [0.1, 0.3, 0.6, 1.0, 1.4])
    mean = np.full((side, side), 20.0)
    for ring in np.unique(rings):
        own = bf.SourceCatalog(*(column[rings == ring] for column in (x, y, flux)))
        psf = bf.MoffatPSF(1.6 * (1.0 + most * ring / 5.0), 3.5)
        mean += bf.ForwardModel(detector, own, psf, lens).expected_counts(np.zeros(4), 0.0)
    x, y = np.stack([x, y]) + 0.02 * rng.normal(size=(2, number))
    model = bf.ForwardModel(detector, bf.SourceCatalog(x, y, flux), bf.GaussianPSF(1.0), lens)
    nuisances = bf.Nuisances("free", offset=True, position_scatter=True, footprint=7.0)
    return bf.Posterior(model, rng.poisson(mean), nuisances=nuisances)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "number", "side", "most"), [(0, 300, 301, 0.6), (2, 500, 401, 0.8)]
)
def test_one_psf_is_found_where_the_images_widen_outward(
    seed: int, number: int, side: int, most: float
) -> None:
    """Steps went to and fro for all 40 turns, and nothing said that the PSF should vary.

    Of the second frame they do so without the secants, of both if the end has to be exact.
    """
    posterior = widening(seed, number, side, most)
    psf, *_ = measuring.find_psf(posterior, bf.find_map(posterior), 4, 0, 0)
    assert psf.model_error > 0.1


def undersampled(seed: int) -> tuple[bf.Posterior, np.ndarray]:
    """144 stars of a FWHM of 1.2 pixels that lie off the catalogue, the PSF taken for a Gaussian.

    And the true coefficients.
    """
    rng = np.random.default_rng(seed)
    terms = [(1, 0, 0, 0), (0, 1, 0, 0), (2, 0, 0, 0), (1, 1, 0, 0), (0, 2, 0, 0)]
    lens, grid = bf.PolynomialDistortion(terms, terms), bf.SourceCatalog.grid(12, 13.6, 1e5)
    x, y = np.stack([grid.x, grid.y]) + rng.uniform(-0.5, 0.5, (2, len(grid)))
    theta = np.tile([2e-3, 2e-3, 1e-5, 1e-5, 1e-5], 2) * rng.normal(size=10)
    off = SCATTER * np.sqrt(DOF / rng.chisquare(DOF, len(grid))) * rng.normal(size=(2, len(grid)))
    detector = bf.Detector((185, 185), pixel="box")
    there = replace(grid, x=x + off[0], y=y + off[1])
    true = bf.ForwardModel(detector, there, bf.MoffatPSF(0.6, 2.5), lens)
    taken = bf.ForwardModel(detector, replace(grid, x=x, y=y), bf.GaussianPSF(0.5), lens)
    nuisances = bf.Nuisances("free", offset=True, psf_sigma=True, position_scatter=True)
    counts = bf.simulate(true, theta, 20.0, seed=seed)
    return bf.Posterior(taken, counts, nuisances=nuisances), theta


@pytest.mark.slow
def test_a_poor_first_psf_does_not_pass_for_scattered_positions(monkeypatch) -> None:
    """With a Gaussian the stars seem to scatter by 0.027 px, which hides the phase of their pixels.

    A PSF that was measured with that scatter alone leaves twice the true one, the control.
    """
    posterior, _ = undersampled(0)
    gaussian, off = bf.find_map(posterior), []
    for rounds in (measuring.ROUNDS, 0):
        monkeypatch.setattr(measuring, "ROUNDS", rounds)
        found, estimate = bf.measure_psf(posterior, gaussian)
        k = found.parameter_names.index("position_scatter")
        off.append((estimate.params[k] - SCATTER) / np.sqrt(estimate.covariance[k, k]))
    assert abs(off[0]) < 3.0
    assert off[1] > 5.0


@pytest.mark.slow
def test_a_psf_is_measured_where_positions_do_not_scatter_at_all(monkeypatch) -> None:
    """A scatter of 1e-11 pixels, that of a search which ended there, is the same as one of 1e-6.

    Without a least one, the control, rounding makes the equations singular.
    """
    posterior, _ = undersampled(0)
    gaussian, k = bf.find_map(posterior), posterior.parameter_names.index("position_scatter")

    def measured(scatter: float) -> np.ndarray:
        params = gaussian.params.copy()
        params[k] = scatter
        return bf.fit_psf(posterior, replace(gaussian, params=params)).coefficients

    known = measured(1e-6)
    np.testing.assert_allclose(measured(1e-11), known, atol=1e-6 * known.max())
    monkeypatch.setattr(psf_equations, "LEAST_SCATTER", 0.0)
    try:
        singular = measured(1e-11)
    except (InputError, np.linalg.LinAlgError):
        return
    assert np.abs(singular - known).max() > 1e-3 * known.max()


@pytest.mark.statistics
def test_errors_hold_where_undersampled_stars_scatter() -> None:
    """20 frames, 10 coefficients: the mean square is known to sqrt(2 / 200) = 0.1.

    The control are the errors of stars that do not scatter.
    """
    squares, controls = [], []
    for seed in range(20):
        posterior, theta = undersampled(seed)
        found, estimate = bf.measure_psf(posterior, bf.find_map(posterior))
        own = [found.parameter_names.index(name) for name in found.model.distortion.names]
        off = estimate.params[own] - theta
        squares.append(off @ np.linalg.solve(estimate.covariance[np.ix_(own, own)], off))
        at_rest = estimate.params.copy()
        at_rest[found.parameter_names.index("position_scatter")] *= 0.1
        fixed = np.linalg.inv(found.information(at_rest))[np.ix_(own, own)]
        controls.append(off @ np.linalg.solve(fixed, off))
    assert 0.7 < np.mean(squares) / 10.0 < 1.3
    assert np.mean(controls) / 10.0 > 2.0
