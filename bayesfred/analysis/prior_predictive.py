"""Frames that a prior expects: prior predictive draws.

A prior is seen in what it predicts. Parameters are drawn from it, free fluxes and scattered
positions too, and a frame is simulated of each. Parameters with which the map folds have no
probability, so they are drawn again; how often says whether the prior is wider than the model.

References
----------
J. Gabry, D. Simpson, A. Vehtari, M. Betancourt, A. Gelman (2019), JRSS A 182, 389, Section 3.
"""

from dataclasses import dataclass

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior

__all__ = ["PriorPredictive", "drawn_from_prior", "prior_predictive"]

REDRAWS = 1000


@dataclass(frozen=True, eq=False)
class PriorPredictive:
    """Draws of parameters from a prior, each with a frame.

    Attributes
    ----------
    params : ndarray, shape (n, d)
    counts : ndarray, shape (n, ny, nx), counts
    refused : float
        Share of the draws that were drawn again, as the map folds or the expected counts are
        negative.
    """

    params: Floats
    counts: Floats
    refused: float


def prior_predictive(posterior: Posterior, draws: int, *, seed: int) -> PriorPredictive:
    """Draw parameters from the prior, and a frame of each.

    Parameters
    ----------
    posterior : Posterior
        Of any frame: the model, priors, noise and nuisances are used, the counts are not, but for
        the mean that the default prior of the background has.
    draws : int
        How many, at least 1.
    seed : int

    Returns
    -------
    PriorPredictive

    Raises
    ------
    InputError
        If fewer than one draw is asked for, or the prior hardly admits an unfolded frame.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, np.full((65, 65), 2.0))
    >>> expected = prior_predictive(posterior, 20, seed=1)
    >>> expected.counts.shape, expected.refused < 0.5
    ((20, 65, 65), True)
    """
    if draws < 1:
        raise InputError(f"prior: draws: got {draws}, expected at least 1")
    rng = np.random.default_rng(seed)
    params, counts, refused = zip(
        *(drawn_from_prior(posterior, rng) for _ in range(draws)), strict=True
    )
    again = sum(refused)
    return PriorPredictive(np.array(params), np.array(counts), again / (again + draws))


def drawn_from_prior(
    posterior: Posterior, rng: np.random.Generator, fluxes: Floats | None = None
) -> tuple[Floats, Floats, int]:
    """Draw parameters from the prior until they give a frame.

    Parameters
    ----------
    posterior : Posterior
    rng : numpy.random.Generator
    fluxes : ndarray, shape (s,), counts, optional
        The free fluxes, by default drawn from their prior.

    Returns
    -------
    params : ndarray, shape (d,)
    counts : ndarray, shape (ny, nx)
    refused : int
        How many were drawn before.

    Raises
    ------
    InputError
        If 1,000 draws in a row all fold.
    """
    for refused in range(REDRAWS):
        params = np.array([prior.rvs(random_state=rng) for prior in posterior.prior.values()])
        counts = posterior.simulate(params, rng, fluxes)
        if counts is not None:
            return params, counts, refused
    raise InputError(
        f"prior: got {REDRAWS} draws that all fold a source's image, expected some that do not: "
        "narrow it"
    )
