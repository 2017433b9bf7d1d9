"""Modes beside the first maximum: aliases of regular masks, noise, and where there are none."""

import math
from dataclasses import replace

import multimodal
import numpy as np
import planted
import pytest
from multimodal import PITCH, REACH
from scipy import stats

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map, reject_outliers
from bayesfred.optimize.modes import find_modes
from bayesfred.optimize.newton import maximize


def test_a_regular_mask_has_a_mode_every_pitch() -> None:
    """The frame sees the same wherever the mask is shifted by a pitch: the prior alone decides."""
    estimate = find_map(multimodal.masked(1, 3.0))
    modes = estimate.modes
    assert modes is not None
    assert estimate.fits_data and f"{modes.count} modes, the largest with 61% and 37%" in (
        estimate.message
    )
    offset = modes.means[:, 2]
    assert np.diff(np.sort(offset)) == pytest.approx(PITCH, abs=0.05)
    assert offset[0] == estimate.params[2]
    exact = np.exp(-0.5 * (offset / REACH) ** 2)
    assert modes.weights == pytest.approx(exact / exact.sum(), abs=0.01)
    beyond = np.array([offset.min() - PITCH, offset.max() + PITCH])
    assert np.all(np.exp(-0.5 * (beyond / REACH) ** 2) / exact.sum() < 1e-3)


def test_an_irregular_mask_has_one_mode() -> None:
    assert find_map(multimodal.masked(1, 3.0, jitter=1.5)).modes is None


def test_a_better_mode_becomes_the_maximum() -> None:
    posterior = multimodal.masked(2, 1.0)
    best, other = find_map(posterior), find_map(posterior, [0.0, 2.0, 1.0 - PITCH, 0.0])
    assert abs(best.params[2] - 1.0) < 0.2
    assert other.params == pytest.approx(best.params, abs=1e-4)
    # negative control: from there the search alone ends a pitch away
    alone = maximize(posterior, np.array([0.0, 2.0, 1.0 - PITCH, 0.0]))
    assert abs(alone.params[2] - 1.0 + PITCH) < 0.2


def test_a_mask_within_the_frame_loses_a_row_where_it_is_shifted() -> None:
    given = multimodal.masked(1, 3.0)
    within = replace(given.model, sources=SourceCatalog.grid(4, PITCH, 300.0))
    counts = simulate(within, [0.0], 2.0, seed=1)
    posterior = Posterior(within, counts, prior=given.prior, nuisances=given.nuisances)
    top = maximize(posterior, find_map(posterior).params)
    search = find_modes(posterior, top)
    assert search.modes is None and search.evaluations == 0


def test_a_square_of_stars_looks_the_same_when_turned() -> None:
    """Eight ways to lay a square onto itself, all as likely where the prior is that wide."""
    square = SourceCatalog([-9.0, 9.0, -9.0, 9.0], [-9.0, -9.0, 9.0, 9.0], [2e3] * 4)
    linear = PolynomialDistortion([(1, 0, 0, 0), (0, 1, 0, 0)], [(1, 0, 0, 0), (0, 1, 0, 0)])
    model = ForwardModel(Detector((49, 49)), square, GaussianPSF(2.0), linear)
    prior = {name: stats.norm(0.0, 3.0) for name in linear.names}
    posterior = Posterior(model, simulate(model, np.zeros(4), 1.0, seed=3), prior=prior)
    modes = find_map(posterior).modes
    assert modes is not None and modes.count == 8
    maps = np.eye(2) - modes.means[:, :4].reshape(-1, 2, 2)
    assert np.abs(np.linalg.det(maps)) == pytest.approx(1.0, abs=0.05)
    images = maps @ np.array([9.0, 9.0])
    assert np.abs(images) == pytest.approx(9.0, abs=0.3)
    # the coefficients of a turn by half a circle are 2: exp(-(2^2 + 2^2) / 2 3^2) as likely
    squared = (modes.means[:, :4] ** 2).sum(axis=1)
    exact = np.exp(-squared / 18.0)
    assert modes.weights == pytest.approx(exact / exact.sum(), rel=0.1)


@pytest.mark.parametrize("seed", range(1, 7))
def test_the_maximum_of_faint_stars_is_the_grids(seed: int) -> None:
    posterior = multimodal.faint(seed)
    estimate = find_map(posterior)
    grid = np.linspace(-4.5, 4.5, 91) * multimodal.SPREAD
    x, y = (c.ravel() for c in np.meshgrid(grid, grid))
    params = np.column_stack([np.zeros_like(x), np.full_like(x, 0.3), x, y])
    assert estimate.log_prob > posterior.log_prob(params).max() - 1e-3
    assert estimate.modes is not None and estimate.modes.weights.sum() == pytest.approx(1.0)


@pytest.mark.parametrize("nuisances", [Nuisances(), Nuisances(flux="free", offset=True)])
def test_bright_stars_leave_nothing_to_look_for(nuisances: Nuisances) -> None:
    model = planted.camera(planted.field(4))
    posterior = Posterior(model, planted.counts(model, 4), nuisances=nuisances)
    top = maximize(posterior, find_map(posterior).params)
    search = find_modes(posterior, top)
    assert search.top is top and search.modes is None and search.evaluations == 0


@pytest.mark.parametrize(
    "nuisances",
    [
        Nuisances(offset=True),
        Nuisances(offset=True, flux="free"),
        Nuisances(offset=True, flux="free", position_scatter=True),
        Nuisances(offset=True, flux="scale", psf_sigma=True, background_order=1),
    ],
)
def test_one_faint_star_is_searched_for_with_every_nuisance(nuisances: Nuisances) -> None:
    given = multimodal.faint(3, sources=1)
    prior = {name: given.prior[name] for name in ("offset_x", "offset_y", "f_x")}
    posterior = Posterior(given.model, given.counts, prior=prior, nuisances=nuisances)
    estimate = find_map(posterior)
    if estimate.modes is not None:
        assert np.isfinite(estimate.modes.means).all()
        assert np.linalg.eigvalsh(estimate.modes.covariances).min() > 0.0
    assert math.isfinite(estimate.log_prob)


def test_modes_are_those_of_what_is_kept() -> None:
    given = multimodal.masked(5, 2.0)
    counts = given.counts.copy()
    counts[20:23, 10:13] += 400.0  # in no catalogue
    posterior = Posterior(
        given.model, counts, prior=given.prior, nuisances=given.nuisances, noise=given.noise
    )
    kept, estimate = reject_outliers(posterior)
    assert not kept.mask[21, 11] and estimate.modes is not None
    offset = np.sort(estimate.modes.means[:, 2])
    assert np.diff(offset) == pytest.approx(PITCH, abs=0.05)


def test_draws_belong_to_the_nearest_mode() -> None:
    estimate = find_map(multimodal.masked(1, 3.0))
    order = np.array([1, 0, 1])
    assert estimate.mixture.assign(estimate.mixture.means[order]).tolist() == order.tolist()
    assert replace(estimate, modes=None).mixture.count == 1
