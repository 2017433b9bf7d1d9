"""The table of sources against planted faults, refits and simulated frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bayesfred.analysis.sources import source_table
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF, MoffatPSF
from bayesfred.model.noise import BackgroundNoise, GaussianNoise, Noise, PoissonNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior

Floats = NDArray[np.float64]

SHEAR = PolynomialDistortion([(1, 0, 1, 0), (1, 0, 2, 0)], [(0, 1, 0, 1)])
THETA = np.array([3e-4, -1e-6, -4e-4])
LEVEL = 20.0
PARAMS = np.array([*THETA, LEVEL])
LIMIT = 4.0  # Monte Carlo errors: exceeded by chance in 1 of 16,000


def make_model(n: int = 25, *, seed: int = 1, flux: float = 2e4, **options: Any) -> ForwardModel:
    """Sources on a jittered grid in a frame of 130 x 140 pixels."""
    rng = np.random.default_rng(seed)
    side = round(np.sqrt(n))
    grid = SourceCatalog.grid(side, 110.0 / side, flux)
    x, y = np.array([grid.x, grid.y]) + rng.uniform(-2.0, 2.0, (2, n))
    detector = options.pop("detector", Detector((130, 140)))
    psf = options.pop("psf", GaussianPSF(2.0))
    sources = SourceCatalog(x, y, grid.flux * rng.uniform(0.5, 1.5, n))
    return ForwardModel(detector, sources, psf, options.pop("distortion", SHEAR), **options)


def faulty(model: ForwardModel, s: int, dx: float, dy: float, flux: float) -> ForwardModel:
    """The model with source s displaced in the catalogue, its flux multiplied."""
    x, y, fluxes = (np.array(c) for c in (model.sources.x, model.sources.y, model.sources.flux))
    x[s], y[s], fluxes[s] = x[s] + dx, y[s] + dy, fluxes[s] * flux
    return replace(model, sources=SourceCatalog(x, y, fluxes))


def table_of(model: ForwardModel, counts: Floats, **options: Any) -> Any:
    return source_table(Posterior(model, counts, **options), PARAMS)


def pulls(table: Any) -> Floats:
    """Of flux, du, dv, width and chi-square, shape (5, n), for a true model."""
    return np.array(
        [
            (table["flux_ratio"] - 1.0) / table["flux_ratio_sd"],
            table["du"] / table["du_sd"],
            table["dv"] / table["dv_sd"],
            (table["width_ratio"] - 1.0) / table["width_ratio_sd"],
            table["chi2_z"],
        ]
    )


# --- planted faults, without noise ----------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"detector": Detector((130, 140), pixel="box"), "psf": MoffatPSF(4.5, 2.5)},
        {"detector": Detector((65, 70), binning=2, pixel="box")},
        {"conserve_flux": False},
    ],
)
def test_planted_faults_are_found_to_second_order(options: dict[str, Any]) -> None:
    model = make_model(**options)
    step = model.detector.binning
    truth = faulty(model, 12, 0.05, -0.03, 1.02)
    table = table_of(model, truth.expected_counts(THETA, LEVEL))
    image = SHEAR.image_position(THETA, truth.sources.x, truth.sources.y)
    before = SHEAR.image_position(THETA, model.sources.x, model.sources.y)
    du, dv = (np.asarray(image) - np.asarray(before)) / step
    assert table["u"] == pytest.approx(before[0] / step, abs=1e-9)
    # a displacement of 1/40 of the width: what is of second order is a few per cent of it
    assert table["du"] == pytest.approx(du, abs=3e-2 * 0.05 / step)
    assert table["dv"] == pytest.approx(dv, abs=3e-2 * 0.05 / step)
    flux = np.where(np.arange(25) == 12, 1.02, 1.0)
    assert table["flux_ratio"] == pytest.approx(flux, abs=1e-3)
    assert table["width_ratio"] == pytest.approx(np.ones(25), abs=1e-3)
    assert np.abs(table["chi2_z"])[12] > 0 and np.argmax(table["chi2_z"]) == 12


def test_a_wider_psf_is_found_in_every_source() -> None:
    model = make_model()
    wide = replace(model, psf=GaussianPSF(2.02))
    table = table_of(model, wide.expected_counts(THETA, LEVEL))
    assert table["width_ratio"] == pytest.approx(np.full(25, 1.01), abs=3e-4)
    assert table["flux_ratio"] == pytest.approx(np.ones(25), abs=1e-3)
    assert np.hypot(table["du"], table["dv"]).max() < 1e-4


# --- against refits by independent code -----------------------------------------------------------

NOTHING = np.zeros(3)


def rendered(sources: list[list[float]], sigma: float, shape: tuple[int, int]) -> Floats:
    """Undistorted images from the formula: sources are rows of x, y, flux and ln(width ratio)."""
    u, v = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape[::-1]))
    image = np.zeros(shape)
    for x, y, flux, wider in sources:
        s = sigma * np.exp(wider)
        image += flux * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * s**2)) / (2 * np.pi * s**2)
    return image


def naive(
    sources: list[list[float]], sigma: float, counts: Floats, level: float, radius: float
) -> tuple[Floats, Floats]:
    """Weighted least squares with numerical derivatives: L - 1, du, dv, d ln(width) and their sd.

    Every source's templates are cut off at its radius. Shape (2, n, 4).
    """
    shape, model = counts.shape, rendered(sources, sigma, counts.shape) + level
    u, v = np.meshgrid(*(np.arange(n) - (n - 1) / 2 for n in shape[::-1]))
    templates = []
    for source in sources:
        own = np.hypot(u - source[0], v - source[1]) <= radius
        light = rendered([source], sigma, shape)
        templates.append(light * own)
        for k in (0, 1, 3):
            up, down = list(source), list(source)
            up[k], down[k] = up[k] + 1e-5, down[k] - 1e-5
            slope = rendered([up], sigma, shape) - rendered([down], sigma, shape)
            templates.append(slope / 2e-5 * own)
    t = np.array(templates).reshape(len(templates), -1)
    weight = 1.0 / model.ravel()
    covariance = np.linalg.inv((t * weight) @ t.T)
    c = covariance @ (t * weight) @ (counts - model).ravel()
    return c.reshape(-1, 4), np.sqrt(np.diag(covariance)).reshape(-1, 4)


@pytest.mark.parametrize(
    "sources",
    [
        [[3.2, -1.7, 4e3, 0.0]],
        [[-4.0, 0.3, 5e3, 0.0], [2.0, 1.1, 9e3, 0.0]],
        [[-4.0, 0.3, 5e3, 0.0], [2.0, 1.1, 9e3, 0.0], [0.5, 7.0, 2e3, 0.0]],
    ],
)
def test_it_is_the_joint_least_squares_fit(sources: list[list[float]]) -> None:
    shape, sigma, level = (41, 43), 2.0, 10.0
    truth = [[x + 0.02, y - 0.03, 1.01 * flux, 0.01] for x, y, flux, _ in sources]
    counts = np.random.default_rng(3).poisson(rendered(truth, sigma, shape) + level).astype(float)
    columns = np.array(sources).T[:3]
    model = ForwardModel(Detector(shape), SourceCatalog(*columns), GaussianPSF(sigma), SHEAR)
    table = source_table(Posterior(model, counts), np.array([*NOTHING, level]))
    c, sd = naive(sources, sigma, counts, level, 3.0 * sigma + 0.75)
    light = 1.0 + c[:, 0]
    assert table["flux_ratio"] == pytest.approx(light, abs=1e-6)
    assert table["flux_ratio_sd"] == pytest.approx(sd[:, 0], rel=1e-6)
    assert table["du"] == pytest.approx(c[:, 1] / light, abs=1e-6)
    assert table["dv"] == pytest.approx(c[:, 2] / light, abs=1e-6)
    assert table["width_ratio"] == pytest.approx(1.0 + c[:, 3] / light, abs=1e-6)
    # the error of a ratio also has that of its denominator
    assert table["du_sd"] == pytest.approx(sd[:, 1] / light, rel=3e-2)
    if len(sources) > 1:  # negative control: each source by itself is another answer
        alone = np.array([naive([s], sigma, counts, level, 6.75)[1][0] for s in sources])
        assert np.abs(alone[:, 0] / sd[:, 0] - 1.0).max() > 1e-2


# --- calibration ----------------------------------------------------------------------------------


def simulated_pulls(noise: Noise, assumed: Noise, frames: int) -> Floats:
    """Pulls of 25 sources a frame, shape (5, frames * 25), at the true parameters."""
    out = []
    for seed in range(frames):
        model = make_model(seed=seed, flux=4e3)
        counts = simulate(model, THETA, LEVEL, seed=seed, noise=noise)
        out.append(pulls(table_of(model, counts, noise=assumed)))
    return np.concatenate(out, axis=1)


@pytest.mark.parametrize(
    "noise", [PoissonNoise(), PoissonNoise(3.0), GaussianNoise(30.0), BackgroundNoise()]
)
def test_pulls_are_standard_normal(noise: Noise) -> None:
    """Over 400 sources a mean is known to 0.05 and a standard deviation to 0.035."""
    z = simulated_pulls(noise, noise, 16)
    assert np.abs(z.mean(axis=1)).max() < LIMIT / np.sqrt(400)
    assert np.abs(z.std(axis=1) - 1.0).max() < LIMIT / np.sqrt(800)


def test_pulls_of_a_wrong_variance_are_not_standard_normal() -> None:
    """The negative control: a variance that is half the true one."""
    z = simulated_pulls(GaussianNoise(30.0), GaussianNoise(15.0), 8)
    assert np.abs(z.std(axis=1) - 1.0).min() > LIMIT / np.sqrt(400)


@pytest.mark.statistics
@pytest.mark.parametrize("noise", [PoissonNoise(), BackgroundNoise()])
def test_pulls_of_many_sources_are_standard_normal(noise: Noise) -> None:
    z = simulated_pulls(noise, noise, 200)
    assert np.abs(z.mean(axis=1)).max() < LIMIT / np.sqrt(5000)
    # what is of second order in the errors adds a per cent
    assert np.abs(z.std(axis=1) - 1.0).max() < LIMIT / np.sqrt(10000) + 0.01


def test_scattered_positions_are_counted_from_the_distortion() -> None:
    model, scatter = make_model(), 0.3
    rng = np.random.default_rng(5)
    by = scatter * rng.standard_normal((2, 25))
    x, y = model.sources.x + by[0], model.sources.y + by[1]
    moved = replace(model, sources=SourceCatalog(x, y, model.sources.flux))
    counts = simulate(moved, THETA, LEVEL, seed=6)
    posterior = Posterior(model, counts, nuisances=Nuisances("free", position_scatter=True))
    params = np.array([*THETA, LEVEL, scatter])
    table = source_table(posterior, params)
    image = SHEAR.image_position(THETA, x, y)
    # the residual alone, which a fit of the shifts leaves, would be 20 times smaller
    assert np.std(table["du"]) > 0.7 * scatter
    z = np.array([(image[0] - table["u"] - table["du"]) / table["du_sd"],
                  (image[1] - table["v"] - table["dv"]) / table["dv_sd"]])  # fmt: skip
    assert np.sqrt(np.mean(z**2)) < 1.0 + LIMIT / np.sqrt(100)


# --- what cannot be known -------------------------------------------------------------------------


def test_sources_that_the_counts_do_not_tell_are_nan() -> None:
    """One outside the frame, one whose light is absent, one whose pixels are masked."""
    catalogue = SourceCatalog([0.0, 200.0, -20.0, 20.0], [0.0, 0.0, 5.0, -5.0], [5e3] * 4)
    model = ForwardModel(Detector((65, 65)), catalogue, GaussianPSF(2.0), SHEAR)
    without = replace(model, sources=SourceCatalog([0.0, 20.0], [0.0, -5.0], [5e3] * 2))
    counts = simulate(without, NOTHING, 10.0, seed=1)
    mask = np.ones((65, 65), bool)
    mask[:, 42:] = False
    table = source_table(Posterior(model, counts, mask=mask), np.array([*NOTHING, 10.0]))
    assert table["n_pixels"].tolist()[1::2] == [0, 0]
    for name in ("chi2", "chi2_z", "flux_ratio", "du", "width_ratio", "peak"):
        lit = name not in ("du", "width_ratio")
        assert np.isfinite(table[name]).tolist() == [True, False, lit, False]
    assert table["u"].tolist() == pytest.approx([0.0, 200.0, -20.0, 20.0])
    assert abs(table["flux_ratio"][2]) < 5 * table["flux_ratio_sd"][2]
    assert table["isolated"].tolist() == [True, False, True, False]


def test_an_image_within_one_pixel_has_no_width_or_place() -> None:
    model = ForwardModel(
        Detector((5, 5), binning=40), SourceCatalog([0.0], [0.0], [5e3]), GaussianPSF(2.0), SHEAR
    )
    counts = simulate(model, NOTHING, 10.0, seed=1)
    table = source_table(Posterior(model, counts), np.array([*NOTHING, 10.0]))
    assert np.isfinite(table["flux_ratio"][0]) and np.isnan(table["width_ratio"][0])


def test_a_frame_of_one_pixel_has_a_table() -> None:
    model = ForwardModel(
        Detector((1, 1), pixel="box"), SourceCatalog([0.0], [0.0], [50.0]), GaussianPSF(2.0), SHEAR
    )
    table = source_table(Posterior(model, [[9.0]]), np.array([*NOTHING, 1.0]))
    assert table["n_pixels"][0] == 1 and np.isnan(table["du"][0])


def test_order_of_the_catalogue_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    x, y = rng.uniform(-25.0, 25.0, (2, 40))  # crowded: every source has several neighbours
    flux = rng.uniform(1e3, 5e3, 40)
    model = ForwardModel(Detector((65, 65)), SourceCatalog(x, y, flux), GaussianPSF(2.0), SHEAR)
    counts = simulate(model, NOTHING, 10.0, seed=2)
    order = rng.permutation(40)
    shuffled = replace(model, sources=SourceCatalog(x[order], y[order], flux[order]))
    params = np.array([*NOTHING, 10.0])
    one, other = (source_table(Posterior(m, counts), params) for m in (model, shuffled))
    for name in ("chi2_z", "flux_ratio", "du", "dv_sd", "width_ratio"):
        assert other[name] == pytest.approx(np.asarray(one[name])[order], rel=1e-6, nan_ok=True)


def test_parameters_without_a_likelihood_are_refused() -> None:
    model = make_model()
    posterior = Posterior(model, np.ones((130, 140)))
    with pytest.raises(InputError, match="without an image"):
        source_table(posterior, np.array([-1.0, 0.0, 0.0, 1.0]))
