"""Draws of the free fluxes: what the posterior says of every source's light.

Free fluxes are no parameters: the likelihood has them integrated out. Given the parameters theta
their posterior is

    p(F | theta, n) ~ prod_p p(n_p | B_p + sum_s F_s K_sp) prod_s p(F_s),

so draws of theta, each with one of F, are draws of the joint posterior. The density of one flux,
given the others, has a single maximum. It is tabulated where it is not negligible, and drawn from
by its distribution function. Sources without light in common are independent, so that each is drawn
beside the most likely fluxes of the others. Where some have more than `COUPLED` of it in common,
all are drawn in turn, from the most likely fluxes on, and the sweeps of this Gibbs sampler are
repeated.

References
----------
S. Geman, D. Geman (1984), IEEE Trans. Pattern Analysis 6, 721.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.kernels.sources import OwnPixels
from bayesfred.model.posterior import Posterior

__all__ = ["draw_fluxes"]

SWEEPS = 10  # where sources share light
COUPLED = (
    0.03  # of a source's light squared; the variance of a flux is left too small by its square
)
NEGLIGIBLE = 25.0  # in log-density below the largest: e^-25 = 1e-11
UNSEEN = 1e-4  # of the PSF's peak, where pixels tell nothing of a flux any more
COARSE, FINE = 33, 101  # nodes, between which a density is linear
CLOSE = 6  # of the coarse nodes at least are not negligible before it is tabulated finely
SMALLEST = 1e-6  # of the catalogue's flux
NOTHING = 1e-300  # counts


def draw_fluxes(
    posterior: Posterior, params: Floats, sources: Sequence[int], rng: np.random.Generator
) -> Floats:
    """Draw the fluxes of some sources, given the parameters.

    Parameters
    ----------
    posterior : Posterior
        With free fluxes, and positions that are certain.
    params : ndarray, shape (d,)
    sources : sequence of int, length n
        Whose fluxes are wanted.
    rng : numpy.random.Generator

    Returns
    -------
    ndarray, shape (n,), counts

    Raises
    ------
    InputError
        If the fluxes are not free or positions scatter, or a map folds there.
    """
    if posterior.nuisances.profiled != 1:
        raise InputError(
            "posterior: fluxes: got fixed ones or positions that scatter, expected free fluxes and "
            "certain positions"
        )
    psf, named = posterior.model.psf, dict(zip(posterior.parameter_names, params, strict=True))
    reach = psf.support_radius(UNSEEN)
    reach *= named.get("psf_sigma", psf.sigma) / psf.sigma
    own, expected, fluxes, _ = posterior.likelihood.own_pixels(params, reach)
    law = posterior.noise_at(params)
    mean, counts, drawn = expected.ravel(), posterior.counts.ravel(), fluxes.copy()
    shape = posterior.nuisances.flux_shape
    coupled = _coupling(own) > COUPLED
    for _ in range(SWEEPS if coupled else 1):
        for s in range(fluxes.size) if coupled else sources:
            some = slice(own.first[s], own.first[s + 1])
            pixel, template = own.pixel[some], own.templates[0, some] / fluxes[s]
            others = mean[pixel] - drawn[s] * template
            noise = law.at(np.unravel_index(pixel, posterior.counts.shape))
            mean_flux = float(posterior.model.sources.flux[s])

            def log_density(
                flux: Floats,
                n: Floats = counts[pixel],
                noise: Any = noise,
                linear: tuple[Floats, Floats] = (others, template),
                mean_flux: float = mean_flux,
            ) -> Floats:
                mu = np.maximum(linear[0] + flux[:, None] * linear[1], NOTHING)
                likelihood = noise.log_likelihood(n, mu, named["background"]).sum(axis=1)
                prior = (shape - 1.0) * np.log(flux) - shape * flux / mean_flux
                return np.asarray(likelihood + prior)

            brightest = 2.0 * fluxes[s] + 12.0 * mean_flux
            new = _draw(log_density, (SMALLEST * mean_flux, brightest), rng)
            mean[pixel] += (new - drawn[s]) * template
            drawn[s] = new
    return np.asarray(drawn[list(sources)])


def _coupling(own: OwnPixels) -> float:
    """The largest overlap of a source's light with that of all others, relative to its own."""
    owner = np.repeat(np.arange(own.first.size - 1), np.diff(own.first))
    light = own.templates[0]
    shared, squared = (
        np.bincount(owner, light * other, own.first.size - 1)
        for other in (own.all_light - light, light)
    )
    return float(np.max(shared / np.maximum(squared, NOTHING), initial=0.0))


def _draw(
    log_density: Callable[[Floats], Floats], between: tuple[float, float], rng: np.random.Generator
) -> float:
    """A draw from a density of one variable with a single maximum."""
    x = np.geomspace(*between, COARSE)
    while True:
        log = log_density(x)
        near = np.flatnonzero(log > log.max() - NEGLIGIBLE)
        low, high = x[max(near[0] - 1, 0)], x[min(near[-1] + 1, x.size - 1)]
        if near.size >= CLOSE:
            break
        x = np.linspace(low, high, COARSE)
    x = np.linspace(low, high, FINE)
    log = log_density(x)
    density = np.exp(log - log.max())
    share = np.cumsum(0.5 * (density[1:] + density[:-1]))
    return float(np.interp(rng.random() * share[-1], np.concatenate([[0.0], share]), x))
