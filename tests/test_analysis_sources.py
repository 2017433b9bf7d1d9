"""The table of sources against planted faults, refits and simulated frames."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from bayesfred.analysis.sources import source_table
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF, MoffatPSF
from bayesfred.model.posterior import Posterior

Floats = NDArray[np.float64]

SHEAR = PolynomialDistortion([(1, 0, 1, 0), (0, 1, 1, 0)], [(0, 1, 0, 1)])
THETA = np.array([3e-4, -2e-4, -4e-4])
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
