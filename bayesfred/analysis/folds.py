"""Parts of a frame by its sources: each part covers the field, no two share a pixel.

Sources are ordered along a path that visits the field in bands, to and fro, and are dealt in turn
to the folds. On a regular grid two folds are a checkerboard. Every pixel belongs to the source
whose light dominates there, and where no light comes to the one that is nearest by the same
measure. For a Gaussian PSF of width s, source k dominates where |p - q_k|^2 - 2 s^2 log F_k is
least: a power diagram, which is a search for nearest neighbours with one coordinate more.

A fold's likelihood keeps the pixels of its sources. The other sources stay in the model, because
their light reaches these pixels. So the counts of two folds are independent given the parameters.

References
----------
F. Aurenhammer (1987), SIAM Journal on Computing 16, 78: power diagrams.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy import spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.analysis.field import field_points
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior

FEWEST = 3  # sources


@dataclass(frozen=True, eq=False)
class Folds:
    """Which part of the frame sources and pixels belong to.

    Attributes
    ----------
    sources : ndarray of int, shape (n,)
        Fold of each source of the catalogue, from 0; -1 where no pixel of the likelihood holds its
        image.
    pixels : ndarray of int, shape (ny, nx)
        Fold of each pixel; -1 where it is not in the likelihood.
    points : ndarray, shape (m, 2), pixel
        A grid (u, v) over the frame within the convex hull of the images, or the images themselves
        where they are too few for a hull.
    """

    sources: Ints
    pixels: Ints
    points: Floats

    def without(self, posterior: Posterior, fold: int) -> Posterior:
        """The posterior without the pixels of a fold."""
        return _masked(posterior, (self.pixels >= 0) & (self.pixels != fold))

    def only(self, posterior: Posterior, fold: int) -> Posterior:
        """The posterior of the pixels of one fold."""
        return _masked(posterior, self.pixels == fold)


def fold_sources(posterior: Posterior, params: Floats, number: int) -> Folds:
    """Deal the sources to folds, and give each fold its pixels.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        Where the images stand.
    number : int
        Folds; some are empty where there are fewer sources.

    Returns
    -------
    Folds
    """
    there = visible(posterior, params)
    sources = np.full(len(posterior.model.sources), -1)
    sources[there] = np.arange(there.size) % number
    return share_pixels(posterior, params, sources)


def visible(posterior: Posterior, params: Floats) -> Ints:
    """Sources whose image is on a pixel of the likelihood.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    ndarray of int, shape (m,)
        In the order of a path along the images that visits the field in bands, to and fro.
    """
    positions = posterior.likelihood.image_positions(params)
    ny, nx = posterior.model.detector.shape
    step = posterior.model.detector.binning
    pixel = np.rint(positions / step + 0.5 * (np.array([nx, ny]) - 1.0))
    pixel = np.nan_to_num(pixel, nan=-1.0).astype(int)  # without an image, in no pixel
    column, row = np.clip(pixel, 0, [nx - 1, ny - 1]).T
    seen = np.all(pixel == np.stack([column, row], axis=1), axis=1)
    there = np.flatnonzero(seen & posterior.mask[row, column])
    return there[_path(positions[there])]


def share_pixels(posterior: Posterior, params: Floats, sources: Ints) -> Folds:
    """Give folds of sources their pixels.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    sources : ndarray of int, shape (n,)
        Fold of each source, -1 for those whose image is on no pixel of the likelihood.

    Returns
    -------
    Folds
    """
    positions = posterior.likelihood.image_positions(params)
    there = np.flatnonzero(sources >= 0)
    pixels = np.full(posterior.mask.shape, -1)
    if there.size:
        owner = _owners(posterior, params, positions[there], posterior.fluxes(params)[there])
        pixels[posterior.mask] = sources[there][owner]
    return Folds(sources, pixels, _field_points(posterior, params, positions[there]))


def require_sources(folds: Folds) -> None:
    """Raise InputError if there are too few sources to predict some from the others."""
    number = int(np.sum(folds.sources >= 0))
    if number < FEWEST:
        raise InputError(
            f"catalogue: got {number} sources with an image in the frame, expected at least "
            f"{FEWEST} to predict some from the others: check positions and mask"
        )


def _masked(posterior: Posterior, mask: Flags) -> Posterior:
    # the errors of a measured PSF are common to all folds
    return replace(
        posterior, mask=mask, extrapolation=None, psf_errors=None, displacement_errors=None
    )


def _path(positions: Floats) -> Ints:
    """The order of points along bands of v, to and fro in u."""
    n = len(positions)
    bands = max(1, round(np.sqrt(n)))
    band = np.empty(n, dtype=int)
    band[np.argsort(positions[:, 1], kind="stable")] = np.arange(n) * bands // max(n, 1)
    across = np.where(band % 2, -positions[:, 0], positions[:, 0])
    return np.lexsort([across, band])


def _owners(posterior: Posterior, params: Floats, positions: Floats, flux: Floats) -> Ints:
    """The dominant source of every pixel of the likelihood."""
    known = dict(zip(posterior.parameter_names, params, strict=True))
    width = known.get("psf_sigma", posterior.model.psf.sigma)
    lead = np.log(flux / flux.max())
    lifted = np.column_stack([positions, width * np.sqrt(-2.0 * lead)])
    u, v = posterior.model.detector.pixel_centres()
    row, column = np.nonzero(posterior.mask)
    pixels = np.column_stack([u[column], v[row], np.zeros(row.size)])
    return np.asarray(spatial.cKDTree(lifted).query(pixels)[1])


def _field_points(posterior: Posterior, params: Floats, positions: Floats) -> Floats:
    points = field_points(posterior, params)
    grid = np.stack([points.u[points.inside], points.v[points.inside]], axis=1)
    return grid if len(grid) else positions
