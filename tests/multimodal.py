"""Frames whose posteriors have several modes, and their exact marginals on grids."""

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior

PITCH, REACH = 8.0, 4.0  # of the mask's grid and of its offset's prior, pixel
SPREAD = 2.5  # of the faint stars' offset, pixel
LEVELS = np.array([0.05, 0.25, 0.5, 0.75, 0.95])

Floats = NDArray[np.float64]


def masked(seed: int, offset: float, *, jitter: float = 0.0) -> Posterior:
    """A regular mask, larger than the frame, that was shifted along x."""
    grid, rng = SourceCatalog.grid(13, PITCH, 300.0), np.random.default_rng(seed)
    mask = SourceCatalog(
        grid.x + rng.normal(0.0, jitter, len(grid)),
        grid.y + rng.normal(0.0, jitter, len(grid)),
        grid.flux,
    )
    return _posterior(mask, (offset, 0.0), 2.0, seed, (REACH, 1e-3), side=33, sigma=1.5)


def faint(seed: int, *, sources: int = 4) -> Posterior:
    """Four stars of 8 photons, the offset drawn from its prior."""
    stars = SourceCatalog(
        [-6.0, 7.0, -5.0, 7.5][:sources], [-7.0, -5.0, 6.0, 7.0][:sources], [8.0] * sources
    )
    x, y = np.random.default_rng(seed).normal(0.0, SPREAD, 2)
    return _posterior(stars, (x, y), 0.3, seed, (SPREAD, SPREAD), side=33, sigma=2.0)


def _posterior(
    sources: SourceCatalog,
    offset: tuple[float, float],
    level: float,
    seed: int,
    spread: tuple[float, float],
    *,
    side: int,
    sigma: float,
) -> Posterior:
    """Priors hold the coefficient and the background, so that the offset alone is unknown."""
    model = ForwardModel(
        Detector((side, side)),
        sources,
        GaussianPSF(sigma),
        PolynomialDistortion([(1, 0, 0, 0)], []),
    )
    there = SourceCatalog(sources.x + offset[0], sources.y + offset[1], sources.flux)
    moved = ForwardModel(model.detector, there, model.psf, model.distortion)
    prior = {
        "f_x": stats.norm(0.0, 1e-6),
        "background": stats.norm(level, 1e-5),
        "offset_x": stats.norm(0.0, spread[0]),
        "offset_y": stats.norm(0.0, spread[1]),
    }
    return Posterior(
        model,
        simulate(moved, [0.0], level, seed=seed),
        prior=prior,
        nuisances=Nuisances(offset=True),
    )


def marginals(posterior: Posterior, *grids: Floats) -> list[Floats]:
    """Masses of the offset's marginals on a grid along x, and along y; if only x, at y = 0."""
    axes = np.meshgrid(*grids, indexing="ij")
    params = np.zeros((axes[0].size, 4))
    params[:, 1] = posterior.prior["background"].mean()
    for axis, values in enumerate(axes):
        params[:, 2 + axis] = values.ravel()
    log_prob = posterior.log_prob(params).reshape(axes[0].shape)
    mass = np.exp(log_prob - log_prob.max())
    mass /= mass.sum()
    return [mass.sum(axis=tuple({*range(len(grids))} - {axis})) for axis in range(len(grids))]


def quantile_error(draws: Floats, effective: float, grid: Floats, mass: Floats) -> float:
    """The largest error of a quantile, in standard deviations of the exact distribution.

    Where 3 Monte Carlo errors of the cumulative share move the exact quantile by more than 0.1
    standard deviations, as between two modes, the error is what is beyond those.
    """
    mean = grid @ mass
    sd = float(np.sqrt((grid - mean) ** 2 @ mass))
    share = np.cumsum(mass) - 0.5 * mass
    found = np.quantile(draws, LEVELS)
    error = np.abs(found - np.interp(LEVELS, share, grid)) / sd
    slack = 3.0 * np.sqrt(LEVELS * (1.0 - LEVELS) / effective)
    low, high = (np.interp(LEVELS + side * slack, share, grid) for side in (-1.0, 1.0))
    beyond = np.maximum(np.maximum(low - found, found - high), 0.0) / sd
    return float(np.where(high - low > 0.2 * sd, beyond, error).max())
