"""Error bars that do not trust the noise model: what the sources say of each other's agreement.

Where a model does not fit, the inverse Fisher information is no longer the scatter of the maximum:
a catalogue's positions are wrong by more than the photons show, or residuals within a star belong
together. The sources are then the only independent witnesses. With u_s the gradient of the
log-likelihood over the pixels that source s owns (`bayesfred.analysis.folds`), and H the
information of all with the prior, the sandwich

    H^-1 (sum u_s u_s^T) H^-1

is the covariance of the maximum. But u_s is that of a fit in which source s took part, and which
drew it to itself. With I_s the information of its pixels and H = R^-1 R^-T, u_s has for a true
model the covariance I_s - I_s H^-1 I_s. So in units of R, where I_s is M = R^T I_s R, it is
multiplied by (1 - M)^-1/2, which makes the sandwich of a true model H^-1 I H^-1 on average.

Free fluxes and shifts of the sources, which have priors, are at their maximum given theta: u_s is
the gradient as they stay, and I_s that of the pixels' derivatives as they stay with those as they
follow. Where positions scatter, the shifts' own width pulls on theta against u_s: that is left out,
and the errors of a true model come out 1.07 times the plain ones of 196 sources, 1.19 times of 25.

Errors that are added, such as those of a measured PSF, are in the covariance, but in no source's
u_s: H is then without them. In units of R the sandwich tells how much farther the maximum scatters
than it should. The covariance R' R'^T with them becomes that many times larger: R' is put in R's
place.

It holds for errors that are independent from source to source. It does not know of those that all
share, such as a PSF that is too wide: these displace theta and leave no scatter. Of few sources it
is itself uncertain, by a share of some (2 n)^-1/2.

References
----------
H. White (1982), Econometrica 50, 1: the sandwich.
R. M. Bell, D. F. McCaffrey (2002), Survey Methodology 28, 169: its correction for few clusters.
"""

import itertools
from dataclasses import replace

import numpy as np
from scipy import sparse

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.absorbed import absorbed, responses
from bayesfred.analysis.folds import fold_sources
from bayesfred.analysis.sources import SourceFits, fit_sources
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS
from bayesfred.model.kernels.fisher import EXPECTED
from bayesfred.model.parameters import SCALES
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import inverse

__all__ = ["robust_sd"]

DECISIVE = 0.99  # share of a direction's information that one source may have
FEWEST = 2  # sources


def robust_sd(posterior: Posterior, params: Floats, covariance: Floats) -> Floats:
    """Standard deviations from the scatter between sources.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        The MAP.
    covariance : ndarray, shape (d, d)
        Inverse of information and prior curvature there, with the errors that are added.

    Returns
    -------
    ndarray, shape (d,), parameter units
        nan with fewer than two sources in the frame, and of `position_scatter` and `model_error`,
        of which no single source tells.
    """
    fits = fit_sources(posterior, params)
    number, shape = fits.fluxes.size, fits.expected.shape
    owner = fold_sources(posterior, params, number).pixels.ravel()
    order = np.argsort(owner, kind="stable")
    order = order[owner[order] >= 0]  # source after source
    ends = np.append(np.flatnonzero(np.diff(owner[order])) + 1, order.size)
    if len(ends) < FEWEST:
        return np.full(params.size, np.nan)
    level = float(params[posterior.parameter_names.index("background")])
    residual = (posterior.counts - fits.expected).ravel()[order]
    weight = 1.0 / posterior.noise_at(params).counts_variance(fits.expected, level).ravel()[order]
    added = posterior.added_covariance is not None
    known = inverse(posterior.information(params)) if added else covariance
    root = np.linalg.cholesky(known)  # units in which this covariance is 1
    # as the information takes it: the average curvature of the shifts' prior
    expected = replace(fits, scatter=fits.scatter / EXPECTED)
    at_rest, followed = (
        (response @ root).swapaxes(0, 1).reshape(-1, params.size)  # by template, then by source
        for response in (
            responses(posterior, params, fits),
            absorbed(posterior, params, known, expected).response,
        )
    )
    light = _by_pixel(fits, owner.size)[order]
    names = posterior.nuisances.background_names
    level_moves = root[[posterior.parameter_names.index(name) for name in names]]
    level_terms = _background_terms(np.unravel_index(order, shape), shape, len(names))
    scores = np.empty((len(ends), params.size))
    for k, (first, last) in enumerate(itertools.pairwise([0, *ends.tolist()])):
        own = slice(first, last)
        level_moved = level_terms[own] @ level_moves
        weighted = (light[own] @ at_rest + level_moved) * weight[own, None]
        values, vectors = np.linalg.eigh(weighted.T @ (light[own] @ followed + level_moved))
        share = np.minimum(values, DECISIVE)
        scores[k] = vectors @ ((vectors.T @ (weighted.T @ residual[own])) / np.sqrt(1.0 - share))
    sd = np.sqrt(np.sum((scores @ np.linalg.cholesky(covariance).T) ** 2, axis=0))
    return np.where(np.isin(posterior.parameter_names, SCALES), np.nan, sd)


def _by_pixel(fits: SourceFits, pixels: int) -> sparse.csr_matrix:
    """The templates as a matrix of pixels by sources, template after template."""
    own, number = fits.own, fits.fluxes.size
    each = (sparse.csc_matrix((t, own.pixel, own.first), (pixels, number)) for t in own.templates)
    return sparse.hstack(list(each)).tocsr()


def _background_terms(pixels: tuple[Ints, ...], shape: tuple[int, ...], terms: int) -> Floats:
    """The background polynomial's terms at some pixels, shape (n, terms)."""
    v, u = ((2.0 * index - (n - 1)) / n for index, n in zip(pixels, shape, strict=True))
    return np.stack([u**m * v**n for m, n in BACKGROUND_POWERS[:terms]], axis=1)
