"""Sources that were left out, where the PSF is measured on the frame.

A PSF that was measured on a source knows its shape, and predicts it better than another source's.
So it is measured again without the sources that are to be predicted, from a Gaussian of its width.
A fifth of the folds (`folds`) is left out at a time. With R the pixels of the other sources and F
those of a fold,

    log p(F | R) = log of the mean over draws of p(F, R | theta) / p(R | theta),

theta drawn from the normal approximation of what R says, the errors of the PSF in it. Fluxes and
shifts of single sources are integrated out of both.

Misfit. Where a model is wrong by w a pixel's squared residual r^2 has the expectation V + w^2, V
the variance of the noise. The sum of (r^2 - V) / T over the pixels of the sources that were left
out tells how much the model leaves of them, their shapes above all. T weighs pixels alike for all
models: it is the variance that one model expects, its model error in it.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import linalg, special

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.folds import Folds
from bayesfred.analysis.sources import source_table
from bayesfred.imaging.psf import GaussianPSF, MeasuredPSF
from bayesfred.io.summary_table import Table, vstack
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.measure_psf import measure_psf
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.psf_start import oversampling_of

__all__ = ["LeftOut", "Weights", "leave_out", "measured_here"]

ROUNDS = 5
DRAWS = 50
PIXEL_VARIANCE = 1.0 / 12.0  # pixel^2
NARROWEST = 0.3  # pixel, of a Gaussian to begin with


class Weights(NamedTuple):
    """What the squared residuals of all models are compared with, shape (ny, nx)."""

    noise: Floats  # V
    total: Floats  # T

    @classmethod
    def of(cls, posterior: Posterior, params: Floats) -> "Weights":
        """The variance of the noise, and with the model error, as a posterior expects them."""
        level = params[posterior.parameter_names.index("background")]
        noise = posterior.noise.pixelwise.counts_variance(posterior.expected_counts(params), level)
        return cls(noise, posterior.sigma(params) ** 2)


class LeftOut(NamedTuple):
    """What the other sources predict of those that were left out.

    Attributes
    ----------
    log_density : ndarray, shape (K,)
        Of the pixels of each fold.
    error : float
        Standard deviation of the sum's Monte Carlo error.
    misfit : ndarray, shape (K,)
        Of each fold.
    sources : astropy.table.Table
        As `source_table` has them: `du`, `dv` are counted from where the others predict the image.
    """

    log_density: Floats
    error: float
    misfit: Floats
    sources: Table


def measured_here(posterior: object) -> bool:
    """Whether a posterior's PSF was measured on its own frame.

    Parameters
    ----------
    posterior : object

    Returns
    -------
    bool
    """
    return (
        isinstance(posterior, Posterior)
        and isinstance(posterior.model.psf, MeasuredPSF)
        and posterior.psf_errors is not None
        and posterior.psf_errors.absorbed > 0.0
    )


def leave_out(
    posterior: Posterior,
    estimate: MapEstimate,
    folds: Folds,
    weights: Weights,
    random: np.random.RandomState,
) -> LeftOut:
    """Predict the folds of the sources, a fifth of them at a time, from the others.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
        Its maximum.
    folds : Folds
    weights : Weights
    random : numpy.random.RandomState

    Returns
    -------
    LeftOut

    Raises
    ------
    InputError
        If no PSF is found without some sources.
    """
    number = int(folds.sources.max()) + 1
    density, errors, misfit = np.zeros((3, number))
    tables = []
    for first in range(min(ROUNDS, number)):
        left = range(first, number, ROUNDS)
        others = (folds.pixels >= 0) & ~np.isin(folds.pixels, left)
        fitted, found = _fitted(_seeing(posterior, others), estimate)
        draws = _draws(found, random)
        known = _likelihoods(_seeing(fitted, others), draws)
        for k in left:
            both = _likelihoods(_seeing(fitted, others | (folds.pixels == k)), draws)
            density[k], errors[k] = _log_mean(known, both)
        whole = _seeing(fitted, folds.pixels >= 0)
        residual = posterior.counts - whole.expected_counts(found.params)
        excess = (residual**2 - weights.noise) / weights.total
        misfit[left] = [excess[folds.pixels == k].sum() for k in left]
        tables.append(source_table(whole, found.params)[np.isin(folds.sources, left)])
    sources = vstack(tables)
    sources.sort("id")
    return LeftOut(density, float(np.linalg.norm(errors)), misfit, sources)


def _seeing(posterior: Posterior, mask: Flags) -> Posterior:
    return replace(
        posterior, mask=mask, extrapolation=None, psf_errors=None, displacement_errors=None
    )


def _fitted(rest: Posterior, estimate: MapEstimate) -> tuple[Posterior, MapEstimate]:
    """The posterior of some sources, whose PSF is measured on these if it was on all."""
    psf = rest.model.psf
    if not isinstance(psf, MeasuredPSF):
        top = maximize(rest, estimate.params)
        return rest, MapEstimate(top.params, top.covariance, top.log_prob, top.evaluations, "")
    finest = oversampling_of(psf)
    optical = math.sqrt(max(psf.sigma**2 - PIXEL_VARIANCE, NARROWEST**2))
    model = replace(
        rest.model, psf=GaussianPSF(optical), detector=replace(rest.model.detector, pixel="box")
    )
    return measure_psf(
        replace(rest, model=model),
        estimate,
        oversampling=finest,
        degree=psf.degree,
        nodes=psf.nodes,
    )


def _draws(found: MapEstimate, random: np.random.RandomState) -> Floats:
    scale = np.sqrt(np.diag(found.covariance))
    lower = linalg.cholesky(found.covariance / np.outer(scale, scale), lower=True)
    normal = random.standard_normal((DRAWS, scale.size))
    return np.asarray(found.params + scale * (normal @ lower.T))


def _likelihoods(posterior: Posterior, draws: Floats) -> Floats:
    low, high = posterior.support
    inside = np.all((draws >= low) & (draws <= high), axis=1)
    return posterior.likelihood.log_likelihood(draws, inside)


def _log_mean(known: Floats, both: Floats) -> tuple[float, float]:
    """The log of the mean of e^(both - known), and its error; draws without density are none."""
    drawn = np.isfinite(known)
    ratio = both[drawn] - known[drawn]
    mean = float(special.logsumexp(ratio)) - math.log(ratio.size)
    share = np.exp(ratio - mean)
    return mean, float(share.std(ddof=1)) / math.sqrt(ratio.size)
