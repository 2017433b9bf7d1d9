"""Error bars that do not trust the noise model: what the sources say of each other's agreement.

Where a model does not fit, the inverse Fisher information is no longer the scatter of the maximum:
a catalogue's positions are wrong by more than the photons show, or residuals within a star belong
together. The sources are then the only independent witnesses. With u_s the gradient of the
log-likelihood over the pixels that source s owns (`bayesfred.analysis.folds`), J_s^T w J_s its
information and H that of all with the prior, the maximum without source s lies at

    theta - (H - I_s)^-1 u_s

in linear approximation, and the jackknife over the n sources has the covariance

    (n - 1) / n sum (delta_s - mean delta)^2,    delta_s = (H - I_s)^-1 u_s.

To first order this is the sandwich H^-1 (sum u_s u_s^T) H^-1. The difference matters for few
sources: u_s is that of a fit which source s took part in, and (H - I_s)^-1 puts back what it drew
to itself. The jackknife's variance is not too small on average, also where errors differ from
source to source.

It holds for errors that are independent from source to source. It does not know of those that all
share, such as a PSF that is too wide: these displace theta and leave no scatter.

References
----------
B. Efron, C. Stein (1981), Annals of Statistics 9, 586: the jackknife is conservative.
H. White (1982), Econometrica 50, 1: the sandwich.
J. G. MacKinnon, M. O. Nielsen, M. D. Webb (2023), Journal of Applied Econometrics 38, 671: CV3.
"""

import numpy as np
from scipy import sparse

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.absorbed import absorbed
from bayesfred.analysis.folds import fold_sources
from bayesfred.analysis.sources import fit_sources
from bayesfred.model.parameters import BACKGROUND_POWERS
from bayesfred.model.posterior import Posterior

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
        Inverse of information and prior curvature there.

    Returns
    -------
    ndarray, shape (d,), parameter units
        nan with fewer than two sources in the frame, and of `position_scatter`, of which no single
        source tells.
    """
    fits = fit_sources(posterior, params)
    number, shape = fits.fluxes.size, fits.expected.shape
    owned = _by_owner(fold_sources(posterior, params, number).pixels.ravel())
    if len(owned) < FEWEST:
        return np.full(params.size, np.nan)
    level = float(params[posterior.parameter_names.index("background")])
    weight = 1.0 / posterior.noise.counts_variance(fits.expected, level)
    pull = (weight * (posterior.counts - fits.expected)).ravel()
    weight = weight.ravel()
    # in units in which the covariance is 1
    root = np.linalg.cholesky(covariance)
    response = absorbed(posterior, params, covariance, fits).response @ root
    own = fits.own
    light = [
        sparse.csc_matrix((template, own.pixel, own.first), (weight.size, number)).tocsr()
        for template in own.templates
    ]
    rows = [posterior.parameter_names.index(name) for name in posterior.nuisances.background_names]
    deltas = np.empty((len(owned), params.size))
    for k, pixels in enumerate(owned):
        jacobian = (
            _background_design(np.unravel_index(pixels, shape), shape)[:, : len(rows)] @ root[rows]
        )
        for m, template in enumerate(light):
            jacobian += template[pixels] @ response[:, m]
        values, vectors = np.linalg.eigh(jacobian.T @ (jacobian * weight[pixels, None]))
        score = vectors.T @ (jacobian.T @ pull[pixels])
        deltas[k] = vectors @ (score / (1.0 - np.minimum(values, DECISIVE)))
    deltas = (deltas - deltas.mean(axis=0)) @ root.T
    variance = (len(owned) - 1) / len(owned) * np.sum(deltas**2, axis=0)
    unknown = np.isin(posterior.parameter_names, posterior.hyperparameters)
    return np.where(unknown, np.nan, np.sqrt(variance))


def _by_owner(fold: Ints) -> list[Ints]:
    """The pixels of every source that has some."""
    order = np.argsort(fold, kind="stable")
    order = order[np.searchsorted(fold[order], 0) :]
    return np.split(order, np.flatnonzero(np.diff(fold[order])) + 1) if order.size else []


def _background_design(pixels: tuple[Ints, ...], shape: tuple[int, ...]) -> Floats:
    """The background polynomial's terms at some pixels, shape (n, 6)."""
    v, u = ((2.0 * index - (n - 1)) / n for index, n in zip(pixels, shape, strict=True))
    return np.stack([u**m * v**n for m, n in BACKGROUND_POWERS], axis=1)
