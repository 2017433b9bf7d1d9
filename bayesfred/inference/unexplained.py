"""What of a frame the catalogue does not explain: spots that no source foretells, sources that have no spot.

A bright spot that belongs to no source, or a source without a spot, can pull a climb farther than all others hold it: where many
coefficients change the shapes of the spots too, the map bends until it folds. So on the way to the maximum the spots' pixels are
masked and the sources get no light. Only the last climb, which begins near the maximum, is one of the whole posterior.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from bayesfred.imaging.kernels.maps import image_positions
from bayesfred.imaging.scene import SourceCatalog
from bayesfred.inference.ascent import climb
from bayesfred.inference.posterior import Posterior

Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

SIGNIFICANCE = 5.0  # of what is unexplained, in standard deviations of the filtered frame
BRIGHT = 0.4  # an unexplained spot has at least this share of the median source's flux
MISSING = 0.5  # a missing source lacks more than this share of the light that is foretold at its place
SWAMPED = 0.1  # a pixel is masked if unexplained spots have more than this share of its expected counts
MOST = 0.5  # unexplained spots and missing sources per source; where there are more, the parameters are wrong, not the catalogue
ROUNDS = 2


def settled(posterior: Posterior, params: Floats, steps: int) -> Floats:
    """Where climbs lead that leave out what is unexplained; the same parameters where nothing is."""
    for _ in range(ROUNDS):
        part = explained(posterior, params)
        there = params if part is posterior else climb(part, params, steps=steps).params
        if there is params or not np.isfinite(posterior.log_prob(there)):
            break
        params = there
    return params


def explained(posterior: Posterior, params: Floats) -> Posterior:
    """The posterior without what these parameters do not explain; itself where that is nothing, or too much to be left out."""
    missing, spots, image = unexplained(posterior, params)
    mask = posterior.mask & (image <= SWAMPED * posterior.expected_counts(params))
    if not 0 < missing.sum() + spots < MOST * missing.size or not mask.any():
        return posterior
    s = posterior.model.sources
    return Posterior(
        replace(posterior.model, sources=SourceCatalog(s.x, s.y, np.where(missing, 1e-9, 1.0) * s.flux)),
        posterior.counts,
        prior=posterior.prior,
        noise=posterior.noise,
        mask=mask,
        nuisances=replace(posterior.nuisances, footprint=None),
    )


def unexplained(posterior: Posterior, params: Floats) -> tuple[Flags, int, Floats]:
    """Which sources are missing from the frame; the number of spots that no source foretells, and their image.

    Frame and expectation are filtered with minus the Laplacian of the PSF, which no smooth background passes. A spot of flux F and
    width s then has the height F / 4 pi s^4, and B counts a pixel have the variance B / 2 pi s^6.

    Returns
    -------
    missing : ndarray of bool, shape (n,)
    spots : int
    image : ndarray, shape (ny, nx), counts per pixel
    """
    model, names, step = posterior.model, posterior.parameter_names, posterior.model.detector.binning
    s = np.hypot(model.psf.sigma / step, 12.0**-0.5)
    mean = np.where(posterior.mask, posterior.expected_counts(params), 0.0)
    excess = -ndimage.gaussian_laplace(np.where(posterior.mask, posterior.counts, 0.0) - mean, s)
    flux = 4.0 * np.pi * s**4 * excess
    if np.abs(flux).max() < BRIGHT * model.sources.flux.min():
        return np.zeros(len(model.sources), bool), 0, np.zeros_like(mean)
    variance = ndimage.gaussian_filter(np.maximum(mean + posterior.noise.shift, 0.0), s) / (2.0 * np.pi * s**6)
    noise = SIGNIFICANCE * np.sqrt(variance)
    spot = (excess == ndimage.maximum_filter(excess, 2 * int(np.ceil(s)) + 1)) & (excess > noise)
    flux[~spot | (flux < BRIGHT * np.median(model.sources.flux))] = 0.0

    foretold = -ndimage.gaussian_laplace(mean, s)
    offset = [params[names.index(name)] if name in names else 0.0 for name in ("offset_x", "offset_y")]
    theta = params[: model.distortion.n_terms].copy()
    u, v = image_positions(model.optics(), theta, *offset, model.psf.sigma).T / step
    at = [v + 0.5 * (model.detector.shape[0] - 1), u + 0.5 * (model.detector.shape[1] - 1)]
    lack, limit, light = (ndimage.map_coordinates(frame, at, order=1) for frame in (-excess, noise, foretold))
    return (lack > limit) & (lack > MISSING * light), int(np.sum(flux > 0.0)), ndimage.gaussian_filter(flux, s, truncate=6.0)
