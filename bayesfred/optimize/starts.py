"""Where the search for the maximum begins: from counts alone to parameters inside its basin.

Peaks matched to the catalogue give a start wherever enough stars stand alone; a growing disk gives
one elsewhere. Both have no local minima to be trapped in.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.growing_disk import PREDICTED, maximize_outward, with_density
from bayesfred.optimize.matching import Field, lost, match
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.outliers import COARSE, STEPS, reject_once
from bayesfred.optimize.peaks import find_peaks

LOST = 0.3  # a match is not trusted if more of the stars that stand alone have no peak
LOST_AT_MOST = 0.45  # ... nor a search from it
PLAIN, DISK = "the prior's medians", "a growing disk"


class Start(NamedTuple):
    """Where to begin.

    Attributes
    ----------
    params : ndarray, shape (d,)
    path : str
        How they were found.
    matched : int
        Sources that were matched to a peak.
    """

    params: Floats
    path: str
    matched: int


@one_blas_thread()  # matrices too small to be shared
def find_start(posterior: Posterior) -> Start:
    """Parameters from which a search finds the maximum.

    They have density wherever the prior's medians do.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    Start

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((165, 165)), bf.SourceCatalog.grid(7, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 2, 0)], g_terms=[]))
    >>> start = find_start(bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1)))
    >>> start.path, start.matched, start.params.round(5)
    ('matched peaks', 49, array([1.e-04, 2.e+00]))
    """
    peaks = find_peaks(posterior)
    matches = []
    for looseness in (1.0, 4.0):  # the second for distortions that the prior holds for unlikely
        field = Field(posterior, looseness)
        z, covariance, matched = match(field, peaks)
        spread = field.spread(field.everyone, field.predict(z), covariance).max()
        sure = spread <= PREDICTED * posterior.model.psf.sigma
        trusted = sure and lost(field, peaks, z) < LOST
        matches.append((trusted, matched, z))
        if trusted:
            break
    trusted, matched, z = max(matches, key=lambda each: each[:2])
    field, plain = Field(posterior), _plain(posterior)
    params = plain.copy()
    params[field.columns] = z
    params = with_density(posterior, np.clip(params, *posterior.support), plain)
    if not np.isfinite(posterior.log_prob(params)):
        return Start(plain, PLAIN, matched)
    if trusted:
        return Start(params, "matched peaks", matched)
    if lost(field, peaks, z) < LOST_AT_MOST:
        kept = reject_once(posterior, params, COARSE).posterior
        params = maximize(kept, params, steps=STEPS).params
        params = with_density(posterior, params, plain)
        if lost(field, peaks, params[field.columns]) < LOST_AT_MOST:
            return Start(params, "matched peaks and a first search", matched)
    grown = with_density(posterior, maximize_outward(field, plain), plain)
    if posterior.log_prob(grown) > posterior.log_prob(params):
        return Start(grown, DISK, matched)
    return Start(params, "matched peaks", matched)


def other_starts(posterior: Posterior, tried: Start) -> Iterator[Start]:
    """Where to restart after no maximum was found from a start, as at the edge of folding."""
    plain = _plain(posterior)
    if tried.path != PLAIN:
        yield Start(plain, PLAIN, 0)
    if tried.path != DISK:
        grown = maximize_outward(Field(posterior), plain)
        yield Start(with_density(posterior, grown, plain), DISK, 0)


def _plain(posterior: Posterior) -> Floats:
    """No distortion, or the least that the priors admit."""
    field, plain = Field(posterior), posterior.start()
    plain[field.columns] = field.centre
    return np.clip(plain, *posterior.support)
