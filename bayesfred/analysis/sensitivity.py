"""How far the posterior of a parameter moves when the prior, or the likelihood, counts a bit more.

Read off the draws, weighted as if the factor were raised to a power near 1.

References
----------
N. Kallioinen, T. Paananen, P.-C. Buerkner, A. Vehtari (2024), Statistics and Computing 34, 57:
power-scaling.
"""

import warnings
from typing import NamedTuple

import arviz_base
import lazy_loader
import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.sampling.chain import Chain

__all__ = ["Sensitivities", "sensitivities"]

# takes long to load, and most of what imports this module judges no chain
arviz_stats = lazy_loader.load("arviz_stats")

FEWEST = 100  # draws from which a sensitivity is read
FLAT = 1e-6  # difference of log densities that moves no posterior
FIELD_POINTS = 9  # along each axis of the frame
INFORMATIVE = 0.05  # sensitivity; the threshold of Kallioinen et al., and of arviz


class Sensitivities(NamedTuple):
    """Sensitivity of every parameter to the two factors of the posterior, each of shape (d,)."""

    prior: Floats
    likelihood: Floats
    prior_dominated: Flags  # see `Diagnostics`


def sensitivities(chain: Chain) -> Sensitivities:
    """Power-scaling sensitivity of every parameter to prior and likelihood.

    Parameters
    ----------
    chain : Chain

    Returns
    -------
    Sensitivities
        nan where draws are too few or do not vary.
    """
    posterior, draws = chain.posterior(), _draws(chain)
    log_prob = chain.log_prob[:, chain.burn_in :].swapaxes(1, 2).ravel()
    log_prior = posterior.log_prior(draws)
    prior = _sensitivity(draws, log_prior)
    dominated = prior >= INFORMATIVE
    dominated[dominated] = _visible(chain, posterior, np.flatnonzero(dominated))
    return Sensitivities(prior, _sensitivity(draws, log_prob - log_prior), dominated)


def _visible(chain: Chain, posterior: Posterior, parameters: Ints) -> Flags:
    """Which of these parameters matter to what is measured, shape (number of parameters,).

    A frame hardly tells u x from x^2, as u is nearly x: it knows the sum of two such coefficients,
    the prior their difference, and the difference moves nothing. So a coefficient of the distortion
    is judged by displacements. With W the design matrix of f and g at points all over the frame,
    W theta is the displacement, and (W^T W theta)_k its component along the pattern that a unit of
    coefficient k makes. It is this component whose sensitivity to the prior counts.
    """
    d = posterior.model.polynomial
    visible = np.ones(parameters.size, dtype=bool)
    terms = parameters[parameters < d.n_terms]
    if not terms.size:
        return visible
    half = 0.5 * np.array(posterior.model.detector.fine_shape[::-1], dtype=np.float64)
    x, y = (c.ravel() for c in np.meshgrid(*np.linspace(-half, half, FIELD_POINTS).T))
    u, v = d.image_position(chain.estimate.params[: d.n_terms], x, y)
    imaged = np.isfinite(u + v)
    design = d.design_matrix(u[imaged], v[imaged], x[imaged], y[imaged]).reshape(-1, d.n_terms)
    draws = _draws(chain)
    components = draws[:, : d.n_terms] @ (design.T @ design[:, terms])
    sensitivity = _sensitivity(components, posterior.log_prior(draws))
    visible[parameters < d.n_terms] = sensitivity >= INFORMATIVE
    return visible


def _draws(chain: Chain) -> Floats:
    """All draws after burn-in, walker by walker, shape (n, d)."""
    kept = chain.chain[:, chain.burn_in :]
    return kept.swapaxes(1, 2).reshape(-1, len(chain.parameter_names))


def _sensitivity(draws: Floats, log_part: Floats) -> Floats:
    """Sensitivity of every column of the draws to one factor of the posterior, shape (d,).

    `log_part` is the factor's logarithm at the draws, shape (n,).
    """
    if len(draws) < FEWEST or not np.all(np.isfinite(log_part)):
        return np.full(draws.shape[1], np.nan)
    if np.ptp(log_part) < FLAT:
        return np.zeros(draws.shape[1])
    # one variable of d numbers: of d variables each would take as long
    groups = {"posterior": {"draws": draws[None]}, "log_prior": {"part": log_part[None]}}
    data = arviz_base.from_dict(groups)
    with (
        warnings.catch_warnings(),
        np.errstate(invalid="ignore"),
        one_blas_thread(),
    ):
        warnings.filterwarnings("ignore", message="Number of tail draws")
        try:
            sensitivity = arviz_stats.psense(data)
        except ValueError:  # hardly a draw differs from another
            return np.full(draws.shape[1], np.nan)
    return np.asarray(sensitivity["draws"], dtype=np.float64)
