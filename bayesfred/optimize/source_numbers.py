"""How many numbers of the sources a fit takes from the counts.

Fluxes and shifts that are free have priors. Let I be the information of the counts about the
relative flux and the shifts of a source, and P that of their priors. Of the squared residuals'
expectation the fit then removes

    tr I (I + P)^-1,

the effective number of parameters: one for each number that the counts determine, none for one that
its prior holds. A source without pixels takes none, and neither does a faint one whose light tells
less of its place than the scatter of positions.

References
----------
D. MacKay, Neural Computation 4, 415 (1992), Eq. 4.9. T. Hastie, R. Tibshirani, J. Friedman (2009),
The Elements of Statistical Learning, Sect. 7.6.
"""

import numpy as np

from bayesfred._typing import Floats
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.posterior import Posterior

__all__ = ["determined_numbers", "own_radius"]

WIDTHS = 3.0  # radius of a source's own pixels, in widths of the PSF
REACH = 0.75  # pixel, added so that the pixel of the image's middle is always among them


def own_radius(posterior: Posterior, params: Floats) -> float:
    """Distance from a source's image within which pixels are its own, fine pixel.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    float
    """
    known = dict(zip(posterior.parameter_names, params, strict=True))
    sigma = float(known.get("psf_sigma", posterior.model.psf.sigma))
    return WIDTHS * sigma + REACH * float(posterior.model.detector.binning)


def determined_numbers(posterior: Posterior, params: Floats) -> float:
    """How many free fluxes and shifts of sources the counts determine.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        Of a positive likelihood.

    Returns
    -------
    float

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog([0.0, 200.0], [5.0, 0.0], [1e4, 1e4]),
    ...     bf.GaussianPSF(2.0), bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> counts = bf.simulate(model, [0.0], 5.0, seed=1)
    >>> posterior = bf.Posterior(model, counts, nuisances=bf.Nuisances(flux="free"))
    >>> round(determined_numbers(posterior, np.array([0.0, 5.0])), 2)  # one is not in the frame
    1.0
    """
    free = posterior.nuisances.profiled
    if not free:
        return 0.0
    radius = own_radius(posterior, params)
    own, expected, fluxes, shifts = posterior.likelihood.own_pixels(params, radius)
    level = float(params[posterior.parameter_names.index("background")])
    noise = posterior.noise_at(params).at(np.unravel_index(own.pixel, posterior.counts.shape))
    variance = noise.counts_variance(expected.ravel()[own.pixel], level)
    owner = np.repeat(np.arange(fluxes.size), np.diff(own.first))
    spread = np.full((fluxes.size, free), posterior.nuisances.flux_shape**-0.5)  # of the priors
    if free > 1:
        tau = float(params[posterior.parameter_names.index("position_scatter")])
        far = DOF * tau**2 + np.sum(shifts**2, axis=1)
        spread[:, 1:] = np.sqrt(far / (DOF + 2.0))[:, None]
    known = np.empty((fluxes.size, free, free))
    for k in range(free):
        for m in range(free):
            products = own.templates[k] * own.templates[m] / variance
            sums = np.bincount(owner, products, fluxes.size)
            known[:, k, m] = spread[:, k] * spread[:, m] * sums
    determined = np.linalg.solve(known + np.eye(free), known)
    return float(np.trace(determined, axis1=1, axis2=2).sum())
