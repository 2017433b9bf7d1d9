"""Sources that do not fit are left out: what `reject_outliers` does once the model is known.

Peaks of the residuals show single sources before the PSF is known. What is off by less, such as a
star with a faint companion or a pinhole on a ghost, shows in the tests of every source at the
maximum, and one in a thousand fails the verdict.
"""

from dataclasses import replace

import numpy as np
from scipy import spatial

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.absorbed import absorbed
from bayesfred.analysis.causes.cause import rows_named
from bayesfred.analysis.source_tests import are_bright, source_tests
from bayesfred.analysis.sources import fit_sources
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.matched import image_width

__all__ = ["leave_out_failed"]

MOST = 0.1  # of the sources: where more do not fit, it is the model
RADIUS = 7.0  # around an image that is left out, widths of it
FAR = 0.5  # of the largest deviation
ROUNDS = 8


def leave_out_failed(
    posterior: Posterior, estimate: MapEstimate
) -> tuple[Posterior, MapEstimate, str]:
    """Mask the pixels of single sources that do not fit, and maximise without them.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
        Its maximum.

    Returns
    -------
    posterior : Posterior
        The one that was given where all sources fit; where more than a tenth do not, or the
        brightest, in which what is wrong with all shows first.
    estimate : MapEstimate
        Its maximum.
    message : str
        Which sources were left out; empty where none was.
    """
    out = np.zeros(len(posterior.model.sources), bool)
    kept, found, fluxes = posterior, estimate, posterior.fluxes(estimate.params)
    for _ in range(ROUNDS):
        worst = _worst(kept, found)
        if not worst.any():
            break
        out |= worst
        many = out.sum() > max(1.0, MOST * out.size)
        if many or are_bright(fluxes, out) or not found.at_maximum:
            return posterior, estimate, ""
        kept = replace(kept, mask=kept.mask & ~_own_pixels(kept, found.params, out))
        found = find_map(kept, found.params)
    rows = rows_named(posterior.model.sources, np.flatnonzero(out))
    message = f"{out.sum()} of {out.size} sources do not fit and are left out: {rows}"
    return kept, found, message if out.any() else ""


def _worst(posterior: Posterior, estimate: MapEstimate) -> Flags:
    """The sources that fail by far, which others may fail for: they pull the coefficients."""
    params, covariance = estimate.params, estimate.covariance
    fits = fit_sources(posterior, params)
    taken = absorbed(posterior, params, covariance, fits)
    tests = source_tests(posterior, params, covariance, fits, taken)
    z = np.where(tests.failed, np.nan_to_num(np.abs(tests.z)).max(axis=1), 0.0)
    return np.asarray(tests.failed & (z >= FAR * z.max(initial=0.0)))


def _own_pixels(posterior: Posterior, params: Floats, some: Flags) -> Flags:
    """The pixels that are nearer to some sources' images than to all others, shape (ny, nx)."""
    step, shape = posterior.model.detector.binning, np.array(posterior.mask.shape)
    images = posterior.likelihood.image_positions(params)[:, ::-1] / step + 0.5 * (shape - 1.0)
    seen = np.flatnonzero(np.isfinite(images).all(axis=1))
    tree, reach = spatial.cKDTree(images[seen]), RADIUS * image_width(posterior, params)
    out = np.zeros(shape, bool)
    for k in seen[some[seen]]:
        first, last = np.clip(np.rint([images[k] - reach, images[k] + reach + 1.0]), 0, shape)
        box = tuple(slice(int(begin), int(end)) for begin, end in zip(first, last, strict=True))
        distance, nearest = tree.query(np.moveaxis(np.mgrid[box], 0, -1))
        out[box] |= (seen[nearest] == k) & (distance <= reach)
    return out
