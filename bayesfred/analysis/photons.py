"""How many photons it takes to know the displacement to so many pixels.

The covariance of the parameters is the inverse of Fisher information plus prior curvature. With the
fluxes of all sources multiplied by a factor and the background as it is, that gives the error over
the field as a function of the factor, and `photons_needed` solves for the factor. Where the
sources' own photons are the noise, the error goes with the root of their number; where the
background is, with their number; near the prior's width, or with sources that scatter about their
positions, more photons help little or not at all. So no power law is assumed.
"""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import optimize

from bayesfred._typing import Floats
from bayesfred.analysis.field import (
    FieldPoints,
    displacement_covariance,
    field_error,
    field_points,
    pixel_unit,
)
from bayesfred.analysis.planned import planned
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import inverse

__all__ = ["PhotonsNeeded", "laplace_error", "photons_needed", "rounded"]

WIDEST = 1e6  # largest factor, either way
MOST_PHOTONS = 2.0**53  # of a source: a catalogue holds no more
PRECISION = 1e-3  # of the factor's logarithm


@dataclass(frozen=True)
class PhotonsNeeded:
    """What it takes to know a displacement to a given error.

    Attributes
    ----------
    error : float, pixel of the fine grid
        The rms error over the field that was asked for, see `DisplacementField.error_rms`.
    factor : float
        By what the flux of every source has to be multiplied. 0 where a millionth would do: the
        prior alone is that narrow. Infinite where a million times would not.
    flux : float, photons
        Mean flux of the sources then.
    message : str
        One line.
    """

    error: float
    factor: float
    flux: float
    message: str


def photons_needed(posterior: Posterior, params: npt.ArrayLike, error: float) -> PhotonsNeeded:
    """How bright the sources have to be for the displacement to be known to a given error.

    Parameters
    ----------
    posterior : Posterior
        Of a frame. Its background, pixels, noise and priors stay as they are.
    params : array_like, shape (d,)
        The maximum, or the true parameters of a simulation.
    error : float, pixel of the fine grid
        The rms error over the field, among the sources, along one axis.

    Returns
    -------
    PhotonsNeeded

    Raises
    ------
    InputError
        If `error` is not a finite number > 0.

    Notes
    -----
    It is the Laplace approximation's error. It assumes that the model is true: a wrong PSF or
    missing terms do not become better with more photons.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [0.02, 0.02], 2.0, seed=1))
    >>> print(photons_needed(posterior, [0.02, 0.02, 2.0], 0.001).message)
    For an error of 0.001 px rms: sources of 610,000 photons on average, 61 times as bright, ...
    """
    if not (math.isfinite(error) and error > 0.0):
        raise InputError(f"error: got {error!r}, expected a finite number of pixels > 0")
    params = np.asarray(params, dtype=np.float64)
    points, fluxes = field_points(posterior, params), posterior.fluxes(params)

    @functools.cache
    def excess(log_factor: float) -> float:
        brighter = _brighter(posterior, params, math.exp(log_factor) * fluxes)
        return math.log(laplace_error(brighter, params, points) / error)

    low = -math.log(WIDEST)
    high = min(-low, math.log(MOST_PHOTONS) - math.log(fluxes.max()))
    guess = min(max(2.0 * excess(0.0), low), high)  # the root's law
    step = math.log(2.0)
    below, above = max(guess - step, low), min(guess + step, high)
    while excess(below) < 0.0 and below > low:
        step, below = 2.0 * step, max(below - 2.0 * step, low)
    while excess(above) > 0.0 and above < high:
        step, above = 2.0 * step, min(above + 2.0 * step, high)
    if excess(above) > 0.0:
        factor = math.inf
    elif excess(below) < 0.0:
        factor = 0.0
    else:
        factor = math.exp(optimize.brentq(excess, below, above, xtol=PRECISION))
    flux = factor * float(fluxes.mean())
    return PhotonsNeeded(error, factor, flux, _sentence(posterior, error, factor, flux))


def _brighter(posterior: Posterior, params: Floats, fluxes: Floats) -> Posterior:
    """The posterior of a frame without noise whose sources have these fluxes."""
    names, sources = posterior.parameter_names, posterior.model.sources
    scale = params[names.index("flux_scale")] if "flux_scale" in names else 1.0
    model = replace(posterior.model, sources=replace(sources, flux=fluxes / scale))
    return planned(replace(posterior, model=model, extrapolation=None), params)


def laplace_error(posterior: Posterior, params: Floats, points: FieldPoints) -> float:
    """The rms error over the field that Fisher information and prior predict.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    points : FieldPoints

    Returns
    -------
    float, pixel
    """
    covariance = inverse(posterior.information(params))
    if posterior.added_covariance is not None:
        covariance = covariance + posterior.added_covariance
    return field_error(
        points, displacement_covariance(posterior, params, covariance, points.u, points.v)
    )


def rounded(value: float) -> str:
    """A number to three digits, without an exponent.

    Parameters
    ----------
    value : float

    Returns
    -------
    str

    Examples
    --------
    >>> rounded(4382123.4), rounded(0.0248)
    ('4,380,000', '0.0248')
    """
    return f"{float(f'{value:.3g}'):,.10g}"


def _sentence(posterior: Posterior, error: float, factor: float, flux: float) -> str:
    wanted = f"For an error of {error:g} {pixel_unit(posterior.model)} rms"
    if math.isinf(factor):
        return f"{wanted}: no number of photons is enough."
    if factor == 0.0:
        return f"{wanted}: no photons are needed, the prior is that narrow."
    return (
        f"{wanted}: sources of {rounded(flux)} photons on average, {rounded(factor)} times as "
        "bright, over the same background."
    )
