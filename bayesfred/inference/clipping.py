"""Sigma clipping: what the frame and the catalogue do not have in common is left out.

A spot that belongs to no source of the catalogue, or a source that has no spot, pulls the coefficients farther than all other
stars hold them: where there are many coefficients, which change the spots' shapes too, until the map folds. A source that lacks
its light is taken off the catalogue. What else stands out of the noise is masked, as far as its light goes.

What stands out is looked for in the frame less its expectation, filtered with minus the Laplacian of the PSF, which no smooth
background passes. A spot of flux F and width s has the height F / 4 pi s^4 in it, and a pixel variance B becomes B / 2 pi s^6.

Parameters that are wrong make every bright star stand out. So what may still be their fault is tolerated: a share of the light
of the stars nearby, the smallest one with which most stars remain. Fitted to these the parameters get better and the share
smaller, until it is zero: then the same is left out that the true parameters would leave out, wherever the search began.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import ndimage, spatial

from bayesfred.imaging.kernels.maps import image_positions
from bayesfred.imaging.scene import SourceCatalog
from bayesfred.inference.ascent import climb
from bayesfred.inference.posterior import Posterior

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

SIGNIFICANCE = 5.0  # of what is left out, in standard deviations; so it has this number's square of counts at least
TOLERANCES = (0.0, 0.03, 0.1, 0.3, 1.0)  # shares of the stars' light nearby
COARSE = TOLERANCES[-2:]  # for parameters that are foretold, not fitted
LACK = 0.5  # a missing source lacks more than this share of its light
FAINT = 0.3  # a pixel is masked where a spot has more than this share of the noise's standard deviation
MOST = 0.6  # of the stars are left out; where there would be more, the parameters are wrong, not the catalogue
ROUNDS = 8
STEPS = 8  # of a climb on the way


class Clipped(NamedTuple):
    """What is left of a posterior.

    Attributes
    ----------
    posterior : Posterior
        Of the sources and pixels that remain; the very one that was given where nothing is left out.
    missing : ndarray of bool, shape (n,)
        Which sources of the given posterior are not in this one.
    spots : ndarray of bool, shape (ny, nx)
        The peaks of what is masked, bright or dark.
    """

    posterior: Posterior
    missing: Flags
    spots: Flags


def whole(posterior: Posterior, params: Floats) -> tuple[Clipped, Floats, int]:
    """All of a posterior and the same parameters: what `settle` returns where nothing stands out, without a look."""
    return Clipped(posterior, np.zeros(len(posterior.model.sources), bool), np.zeros(posterior.counts.shape, bool)), params, 0


def settle(posterior: Posterior, params: Floats) -> tuple[Clipped, Floats, int]:
    """What is left once clipping and climbing, in turns, leave out the same again; where they led; log-posteriors evaluated."""
    clipped, params, evaluations = whole(posterior, params)
    seen: set[bytes] = set()
    for _ in range(ROUNDS):
        found = clip(posterior, params)
        key = found.missing.tobytes() + found.spots.tobytes()
        if key in seen or not np.isfinite(found.posterior.log_prob(params)):
            break
        seen.add(key)
        clipped, top = found, climb(found.posterior, params, steps=STEPS)
        params, evaluations = top.params, evaluations + top.evaluations
    return clipped, params, evaluations


def clip(posterior: Posterior, params: Floats, tolerances: Sequence[float] = TOLERANCES) -> Clipped:
    """The posterior without what these parameters do not explain, with the least tolerance at which most stars remain."""
    look = _Look(posterior, params)
    for tolerance in tolerances:
        missing, expected = look.missing(tolerance)
        spots, mask = look.spots(expected, tolerance)
        lost = missing | ~mask[look.row, look.column]
        if mask.any() and lost[look.inside].sum() <= MOST * look.inside.sum():
            break
    else:
        missing[:], spots[:] = False, False
    if not missing.any() and not spots.any():
        return Clipped(posterior, missing, spots)
    return Clipped(_part(posterior, missing, mask), missing, spots)


class _Look:
    """A frame beside what parameters make of it, filtered."""

    def __init__(self, posterior: Posterior, params: Floats) -> None:
        model, names, step = posterior.model, posterior.parameter_names, posterior.model.detector.binning
        self.posterior, self.params = posterior, params
        self.width = s = np.hypot(model.psf.sigma / step, 12.0**-0.5)
        known = dict(zip(names, params, strict=True))
        theta, offset = params[: model.distortion.n_terms].copy(), [known.get(name, 0.0) for name in ("offset_x", "offset_y")]
        u, v = image_positions(model.optics(), theta, *offset, model.psf.sigma).T / step
        ny, nx = model.detector.shape
        row, column = (np.rint(at + 0.5 * (n - 1)).astype(int) for at, n in ((v, ny), (u, nx)))
        inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
        self.row, self.column = np.clip(row, 0, ny - 1), np.clip(column, 0, nx - 1)
        self.inside = inside & posterior.mask[self.row, self.column]
        self.height = known.get("flux_scale", 1.0) * model.sources.flux / (4.0 * np.pi * s**4)
        self.level = known["background"]

    def _filtered(self, expected: Floats, tolerance: float) -> tuple[Floats, Floats]:
        """What the frame has more than is expected, and how much is too much."""
        p, s = self.posterior, self.width
        excess, light = (-ndimage.gaussian_laplace(np.where(p.mask, image, 0.0), s) for image in (p.counts - expected, expected))
        variance = np.where(p.mask, 1.0 / p.noise.fisher_weight(expected, self.level), 0.0)
        noise = np.sqrt(ndimage.gaussian_filter(variance, s) / (2.0 * np.pi * s**6))
        limit = SIGNIFICANCE * noise + SIGNIFICANCE**2 / (4.0 * np.pi * s**4)
        return excess, limit + tolerance * ndimage.maximum_filter(light, 2 * int(np.ceil(3.0 * s)) + 1)

    def missing(self, tolerance: float) -> tuple[Flags, Floats]:
        """Which sources lack their light, shape (n,), and what is expected without them, shape (ny, nx)."""
        missing = np.zeros(self.height.size, bool)
        while True:
            expected = _part(self.posterior, missing, self.posterior.mask).expected_counts(self.params)
            excess, limit = (image[self.row, self.column] for image in self._filtered(expected, tolerance))
            more = np.flatnonzero(self.inside & ~missing & (-excess > np.maximum(limit, LACK * self.height)))
            # where several overlap, the brightest may be all that is missing
            places = spatial.cKDTree(np.stack([self.row, self.column], axis=1)[more])
            pairs = places.query_pairs(2.0 * self.width, output_type="ndarray")
            first, second = self.height[more][pairs].T
            more = np.delete(more, np.where(first < second, *pairs.T))
            if not more.size or missing.sum() + more.size == missing.size:
                return missing, expected
            missing[more] = True

    def spots(self, expected: Floats, tolerance: float) -> tuple[Flags, Flags]:
        """The peaks of what else stands out, and the pixels that its light leaves, both of shape (ny, nx)."""
        s = self.width
        excess, limit = self._filtered(expected, tolerance)
        height = np.abs(excess)
        spots = (height == ndimage.maximum_filter(height, 2 * int(np.ceil(s)) + 1)) & (height > limit)
        light = ndimage.gaussian_filter(np.where(spots, 4.0 * np.pi * s**4 * height, 0.0), s, truncate=6.0)
        light = ndimage.maximum_filter(light, 2 * int(np.ceil(0.25 * s)) + 1)  # of a peak between pixels, of another width
        noise = self.posterior.noise.fisher_weight(expected, self.level) ** -0.5
        return spots, self.posterior.mask & (light <= FAINT * noise)


def _part(posterior: Posterior, missing: Flags, mask: Flags) -> Posterior:
    """The posterior of these pixels, without the missing sources."""
    model, s = posterior.model, posterior.model.sources
    if missing.any():
        model = replace(model, sources=SourceCatalog(s.x[~missing], s.y[~missing], s.flux[~missing]))
    elif mask is posterior.mask:
        return posterior
    noise, nuisances = posterior.noise, posterior.nuisances
    return Posterior(model, posterior.counts, prior=posterior.prior, noise=noise, mask=mask, nuisances=nuisances)
