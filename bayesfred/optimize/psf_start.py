"""Where the search for a PSF begins: the grids that suit a frame, and the start's spline on them.

A smooth PSF has as many knots in its FWHM, however wide it is. One with sharp edges, such as a
defocused one, has more of its light where it exceeds half its peak, and needs more knots.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.polynomial.legendre import leggauss
from scipy import spatial

from bayesfred._typing import Floats
from bayesfred.imaging.psf import FWHM, PSF, MeasuredPSF, density_at, has_pixel
from bayesfred.imaging.psf.spline_values import spline_coefficients, values_at_knots
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.psf_equations import WIDTH, PsfState
from bayesfred.optimize.psf_levels import STRENGTH, PsfGrid

FULLY_SAMPLED = 1.5  # pixel: PSFs of a larger FWHM have fewer knots per pixel
SHARP = 0.6  # of the light is where a PSF exceeds half its peak; of a Gaussian, a half
FINER = 2.5  # times as many knots then
MOST = 4000  # coefficients of a sharp PSF, whose equations take time as their cube
LIT = 0.02  # of the peak that the light of a sharp PSF exceeds
MARGIN = 2.0  # pixel around that
DARK = 0.1  # of the pixels are beyond the PSF of every source, where that can be
RADIUS = 7.0  # of the fine grid, widths of the PSF
NARROWEST = 4.0  # of the fine grid, of sharp PSFs and where stars leave no pixels between them


def starting_grid(
    posterior: Posterior, estimate: MapEstimate, oversampling: float, degree: int
) -> PsfGrid:
    """The grids of a smooth PSF of the start's width.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
    oversampling : float
        Knots per pixel, of a narrow PSF.
    degree : int
        Of the variation over the field.

    Returns
    -------
    PsfGrid
    """
    width = math.hypot(*_widths(posterior, estimate.params))
    knots = max(1.0, min(oversampling, oversampling * FULLY_SAMPLED / (FWHM * width)))
    radius = min(RADIUS * width, max(NARROWEST * width, reach(posterior, estimate.params)))
    return PsfGrid(knots, width, degree, radius)


def suited_grid(smooth: PsfGrid, constant: PsfState, oversampling: float) -> PsfGrid:
    """The grids that a frame needs.

    Parameters
    ----------
    smooth : PsfGrid
        Those of `starting_grid`.
    constant : PsfState
        At the solution with a PSF that does not vary, on such grids.
    oversampling : float
        Knots per pixel, at the most.

    Returns
    -------
    PsfGrid
    """
    spline = constant.grid.combined(constant.coefficients)[0]
    if not _is_sharp(spline):
        return smooth
    image = values_at_knots(spline)
    lit = np.argwhere(image >= LIT * image.max()) - 0.5 * (len(image) - 1)
    light = float(np.hypot(*lit.T).max()) / smooth.oversampling + MARGIN
    radius = min(smooth.fine_radius, max(NARROWEST * smooth.sigma, light))
    grid = replace(
        smooth,
        oversampling=min(oversampling, FINER * smooth.oversampling),
        fine_radius=radius,
    )
    fewer = min(1.0, math.sqrt(MOST / grid.unknown.size()))
    return replace(grid, oversampling=max(smooth.oversampling, fewer * grid.oversampling))


def _is_sharp(spline: Floats) -> bool:
    image = values_at_knots(spline)
    bright = image >= 0.5 * image.max()
    return float(image[bright].sum()) > SHARP * float(image.sum())


def oversampling_of(psf: MeasuredPSF) -> int:
    """The oversampling that gives a PSF such as this one as many knots as it has.

    Parameters
    ----------
    psf : MeasuredPSF

    Returns
    -------
    int
    """
    finer = FINER if _is_sharp(psf.coefficients[0]) else 1.0
    knots = psf.oversampling / finer * max(1.0, FWHM * psf.sigma / FULLY_SAMPLED)
    return math.ceil(max(knots, psf.oversampling))


def starting_state(posterior: Posterior, estimate: MapEstimate, grid: PsfGrid) -> PsfState:
    """The posterior's own PSF on grids, with its pixel.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
    grid : PsfGrid

    Returns
    -------
    PsfState
    """
    psf, knots = posterior.model.psf, grid.oversampling
    sigma, pixel = _widths(posterior, estimate.params)
    side = int(grid.levels.side[0])
    x = np.linspace(-0.5, 0.5, side) * ((side - 1) / knots)
    c = spline_coefficients(_pixel_density(psf, psf.sigma / sigma, pixel * math.sqrt(12.0), x))
    coefficients = np.zeros(grid.conventions.shape[1])
    coefficients[: c.size] = c.ravel() * (knots**2 / c.sum())
    _, _, fluxes, shifts = posterior.likelihood.own_pixels(estimate.params, grid.radius)
    strengths = np.full(len(grid.blocks), STRENGTH)
    return PsfState(grid, coefficients, strengths, estimate.params, fluxes, shifts)


def _widths(posterior: Posterior, params: Floats) -> tuple[float, float]:
    """Of the start's PSF and of the pixel, if that is not in it; pixel."""
    psf, names = posterior.model.psf, posterior.parameter_names
    sigma = float(params[names.index(WIDTH)]) if WIDTH in names else psf.sigma
    inside = has_pixel(psf) or posterior.model.detector.pixel == "impulse"
    return sigma, 0.0 if inside else 1.0 / math.sqrt(12.0)


def _pixel_density(psf: PSF, scale: float, pixel: float, x: Floats) -> Floats:
    """The PSF narrowed by a factor, integrated over a pixel around the points of a grid."""
    nodes, weights = leggauss(8) if pixel else (np.zeros(1), np.full(1, 2.0))
    out = np.zeros((x.size, x.size))
    for s, w_s in zip(0.5 * pixel * nodes, 0.5 * weights, strict=True):
        for t, w_t in zip(0.5 * pixel * nodes, 0.5 * weights, strict=True):
            a, b = scale * (x + s), scale * (x[:, None] + t)
            out += w_s * w_t * density_at(psf, a, b, (0.0, 0.0)) * scale**2
    return out


def reach(posterior: Posterior, params: Floats) -> float:
    """How far from their sources the PSF may reach and leave pixels that tell the background.

    Where all pixels have light of some source, a pedestal under every star is no different from the
    background.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    float
    """
    images = posterior.likelihood.image_positions(params)
    ny, nx = posterior.mask.shape
    pixels = np.argwhere(posterior.mask)[:, ::-1] - 0.5 * np.array([nx - 1, ny - 1])
    distance, _ = spatial.cKDTree(images[np.isfinite(images).all(axis=1)]).query(pixels)
    return float(np.quantile(distance, 1.0 - DARK))
