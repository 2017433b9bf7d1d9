"""What a fit absorbs of the residuals.

Around source s the fitted parameters theta change the coefficients of its four templates by G_s
d(theta), and free fluxes and shifts add their own. With C the covariance of theta and K the
information (prior included) of the free ones, B_s = K^-1 + G' C G'^T is the covariance of the
coefficients, G' being G_s once the free ones have followed theta. So the residuals' variance is 1 -
h_i with h_i = w_i t_i^T B_s t_i, and the mean product of residuals i and j is - sqrt(w_i w_j) t_i^T
B_s t_j. Free numbers with a prior are drawn from it, for which both are exact.

References
----------
A. C. Davison, C.-L. Tsai (1992), International Statistical Review 60, 337: residuals and leverage.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.sources import SourceFits
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.posterior import Posterior

__all__ = ["Absorbed", "absorbed", "responses"]


class Absorbed(NamedTuple):
    """The part of the residuals that the fit takes away."""

    leverage: Floats  # (ny * nx,)
    modes: Floats  # (samples, 4): their products within a source are minus the covariances
    response: Floats  # (s, 4, d) G', changes of the template coefficients by the parameters
    spread: Floats  # (s, 4, 4) B, covariance of the template coefficients
    alone: Floats  # (s, 4, 4) K^-1, what of it remains if the parameters are known


def responses(posterior: Posterior | FrameLikelihood, params: Floats, fits: SourceFits) -> Floats:
    """Changes of the sources' template coefficients by the parameters, shape (s, 4, d)."""
    model, sources = posterior.model, posterior.model.sources
    out = np.zeros((fits.fluxes.size, 4, params.size))
    u, v = np.nan_to_num(fits.own.image).T
    design = model.polynomial.design_matrix(u, v, sources.x, sources.y)
    for k, parameter in enumerate(posterior.parameters):
        if parameter.kind == "distortion":  # f adds to a, which a shift lowers
            out[:, 1:3, k] = -design[:, :, parameter.slot].T
        elif parameter.name in ("offset_x", "offset_y"):
            out[:, 1 if parameter.name == "offset_x" else 2, k] = 1.0
        elif parameter.name in ("flux_scale", "psf_sigma"):  # relative
            out[:, 0 if parameter.name == "flux_scale" else 3, k] = 1.0 / params[k]
    return out


def absorbed(
    posterior: Posterior, params: Floats, covariance: Floats, fits: SourceFits
) -> Absorbed:
    """Leverages and covariances of the residuals."""
    own, owner, weight = fits.own, fits.owner, fits.sums.weight
    response, free = responses(posterior, params, fits), posterior.nuisances.profiled
    alone = np.zeros((fits.fluxes.size, 4, 4))
    if free:
        prior = np.zeros((fits.fluxes.size, free, free))
        prior[:, 0, 0] = posterior.nuisances.flux_shape  # of a relative flux
        for k in range(1, free):
            prior[:, k, k] = 1.0 / fits.scatter
        inverse = np.linalg.inv(fits.information[:, :free, :free] + prior)
        response[:, :free] -= inverse @ fits.information[:, :free] @ response
        alone[:, :free, :free] = inverse
    spread = alone + response @ covariance @ response.swapaxes(1, 2)
    values, vectors = np.linalg.eigh(spread)
    factors = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    modes = np.zeros((own.pixel.size, 4))
    for k in range(4):
        for m in range(4):
            modes[:, k] += own.templates[m] * factors[owner, m, k]
    modes *= np.sqrt(weight)[:, None]
    leverage = np.bincount(own.pixel, np.sum(modes**2, axis=1), posterior.mask.size)
    return Absorbed(np.minimum(leverage, 0.99), modes, response, spread, alone)
