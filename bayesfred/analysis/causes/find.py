"""The hypotheses ranked by what they explain."""

from dataclasses import replace

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.causes.background import wings
from bayesfred.analysis.causes.cause import Cause, Finding
from bayesfred.analysis.causes.context import Context
from bayesfred.analysis.causes.light import companions, fluxes, psf, single_sources
from bayesfred.analysis.causes.pixels import alternation, background_and_noise, lines, saturation
from bayesfred.analysis.causes.positions import placement, scatter, unmatched
from bayesfred.model.posterior import Posterior

NOTICEABLE = 5.0  # standard deviations of a misfit
LEAST = 0.05  # share of the misfit below which a cause is not named


def find_causes(
    posterior: Posterior, params: Floats, *, rejected: bool = False
) -> tuple[Cause, ...]:
    """Look for the reasons why a model does not fit the counts.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        The maximum. The model is taken not to fit there: of one that fits, this is to be called
        only if hardly a source is matched.
    rejected : bool
        Whether outliers were rejected already, so that this is no remedy.

    Returns
    -------
    tuple of Cause
        The most likely one first; empty where nothing explains 5 % of the misfit.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((97, 97)), bf.SourceCatalog.grid(4, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> counts = 3.0 * bf.simulate(model, [1e-4], 20.0, seed=1)
    >>> posterior = bf.Posterior(model, counts, nuisances=bf.Nuisances(flux="scale"))
    >>> find_causes(posterior, bf.find_map(posterior).params)[0].name
    'gain'
    """
    none = np.zeros(posterior.counts.shape, bool)
    context = Context(posterior, params, none, rejected)
    total = abs(context.excess)
    findings: list[Finding | None] = []
    saturated, spoiled = saturation(context)
    findings.append(saturated)
    if saturated is not None:
        context = Context(posterior, params, spoiled, rejected)
    if not context.light.matched.any() and abs(context.excess) < NOTICEABLE * context.spread:
        return (replace(unmatched(context).cause, share=1.0),)
    if context.light.matched.any():
        for read_out in (alternation, lines):
            found, context = read_out(context)
            findings += found
    if context.light.matched.any() or context.bright.any():
        place = placement(context)
        # where both explain all of it the first one counts, and wings look like a background
        findings += [place, wings(context), *background_and_noise(context)]
        if place is None or place.cause.name != "unmatched":
            findings += [fluxes(context), psf(context), companions(context), scatter(context)]
            findings += single_sources(context, place)
    else:
        findings += [unmatched(context), *background_and_noise(context)]
    return ranked([f for f in findings if f is not None], total)


def ranked(findings: list[Finding], total: float) -> tuple[Cause, ...]:
    """Causes by what they explain, each with a share that none before has claimed."""
    rest = list(findings)
    left = 1.0
    causes: list[Cause] = []
    while rest:
        best = max(rest, key=lambda f: f.weight * f.explained)
        rest = [
            replace(f, explained=f.explained - best.explained * f.shares(best))
            for f in rest
            if f is not best
        ]
        share = float(min(best.explained / max(total, 1e-300), left))
        if (share < LEAST and causes) or best.explained <= 0.0:
            continue
        left -= share
        causes.append(replace(best.cause, share=share))
    return tuple(cause for cause in causes if cause.share >= LEAST)
