"""Hypotheses about the sources' light: fluxes, the PSF, single sources, what no catalogue has.

A wrong PSF leaves the same residual at all sources, in proportion to their flux; companions that no
catalogue has leave one at some sources, in different directions. So what sources have in common is
taken off before companions are looked for.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy import ndimage, stats

from bayesfred._typing import Flags
from bayesfred.analysis.causes.cause import (
    MISSING,
    RICHER,
    Cause,
    Finding,
    psf_remedy,
    rows_named,
)
from bayesfred.analysis.causes.common import REACH, RINGS, CommonPattern, common_pattern
from bayesfred.analysis.causes.context import BRIGHT, DETECTED, Context

ENOUGH = 0.85  # of what fluxes of their own explain
FEW = 0.2  # of the sources: more than these are not the ones to blame
OUTLYING = 6.0  # times the typical misfit of a source as bright
NOTICEABLE = 6.0  # standard deviations
RIM = 0.01  # chance that sources lie as far out, where terms are known to be missing
RICHEST = 0.7  # weight of companions, which near enough are displacements, too, and other PSFs
REJECT = "set frame.reject_outliers = true"
VARIES = 0.3  # of the common residual, below which its mean over the sources says little
ORDERS = range(5)  # of the pattern that is no companion, coma and trefoil included


def fluxes(context: Context) -> Finding | None:
    """Fluxes that are taken to be known and are not."""
    mode = context.posterior.nuisances.flux
    light = context.light
    some = light.matched & (context.power > BRIGHT)
    if mode == "free" or some.sum() < 2:
        return None
    power, off = context.power[some], context.off[some]
    own = float(np.sum(power * off**2)) - some.sum()
    factor = float(power @ off / power.sum())
    common = factor**2 * float(power.sum())
    if own < NOTICEABLE * (2.0 * some.sum()) ** 0.5:
        return None
    if common >= ENOUGH * own:
        cause = Cause(
            "fluxes", 0.0, f"all sources have {1.0 + factor:.3g} times the model's light",
            'set nuisances.flux = "scale"',
        )  # fmt: skip
        return Finding(cause, common, "light")
    scatter = float(np.sqrt(np.median(off**2)) / 0.6745)
    cause = Cause(
        "fluxes", 0.0,
        f"the sources have other fluxes than the catalogue's, by {scatter:.1%} (68 % of them)",
        'set nuisances.flux = "free"',
    )  # fmt: skip
    return Finding(cause, own, "light", RICHER)


def single_sources(context: Context, place: Finding | None) -> Iterator[Finding]:
    """Few sources that hold most of the misfit, and light that belongs to no source.

    `place` is what is wrong with the images' places: where terms are missing, few sources are the
    outermost ones.
    """
    light, excess = context.light, context.source_excess
    power = np.maximum(context.power, context.catalogue_power * light.inside)
    dark = context.bright & ~light.matched
    like = context.typical * context.power
    noise = np.sqrt(2.0 * np.maximum(context.source_pixels, 1.0))
    odd = light.matched & (excess > NOTICEABLE * noise + OUTLYING * like)
    wrong = dark | odd
    found = context.detections
    own = np.where(wrong, np.maximum(excess - like, 0.0), 0.0)
    near = np.zeros(0, bool)
    if 0 < wrong.sum() <= max(2, FEW * light.inside.sum()):
        # where a source is missing there is often one too many: it is imaged elsewhere
        near = np.arange(len(found.power)) < 2 * dark.sum()
        order = np.argsort(-own)[: wrong.sum()]
        leave_out = "leave them out" if context.rejected else REJECT
        dim = f", {dark.sum()} of them with no light at their image" if dark.any() else ""
        held = f"{wrong.sum()} of {light.inside.sum()} sources hold the misfit{dim}"
        cause = Cause(
            "wrong sources", 0.0, f"{held}: {rows_named(context.posterior.model.sources, order)}",
            f"correct their positions and fluxes, or {leave_out}",
        )  # fmt: skip
        if place is not None and place.cause.name == MISSING and _outermost(context, wrong):
            lacking = f"{place.cause.sentence}; {held}, and they are the outermost"
            cause = replace(place.cause, sentence=lacking)
        explained = float(own.sum() + found.power[near].sum())
        yield Finding(cause, explained, "position")
    rest = found.power[len(near) and near.sum() :]
    if rest.size and power.size:
        at = ", ".join(f"{value:.0f}" for value in found.position[len(found.power) - rest.size])
        cause = Cause(
            "uncatalogued sources", 0.0,
            f"{rest.size} detections belong to no source of the catalogue, the brightest at "
            f"u, v = {at}",
            "complete the catalogue" if context.rejected
            else f"{REJECT}, or footprint, or complete the catalogue",
        )  # fmt: skip
        yield Finding(cause, float(rest.sum()), "position")


def _outermost(context: Context, some: Flags) -> bool:
    """Whether sources lie farther out than the others."""
    position, inside = context.light.position, context.light.inside
    radius = np.hypot(*(position - np.mean(position[inside], axis=0)).T)
    others = inside & ~some
    test = stats.mannwhitneyu(radius[some], radius[others], alternative="greater")
    return bool(test.pvalue < RIM)


def psf(context: Context) -> Finding | None:
    """Residuals that all sources share: another profile than the model's.

    Rings, and the two ways in which a ring can be drawn out. A dipole is left out: it is a
    displacement.
    """
    found = common_pattern(context, (0, 2))
    if found is None or found.explained < NOTICEABLE * (2.0 * found.numbers) ** 0.5:
        return None
    mode = context.posterior.nuisances.psf_sigma
    impulse = context.posterior.model.detector.pixel == "impulse"
    box = ', or pixel = "box" if it is narrow' if impulse else ""
    cause = Cause(
        "PSF", 0.0,
        _difference(found, context.light.width),
        psf_remedy(
            context.posterior,
            f'fit another PSF: kind = "moffat" or "sampled"{box}' if mode
            else "set nuisances.psf_sigma = true, or fit another PSF",
        ),
    )  # fmt: skip
    return Finding(cause, found.explained, "light", RICHER)


def _difference(found: CommonPattern, width: float) -> str:
    """In words, how the light around the sources differs from the PSF."""
    profile = found.profile
    varies = np.abs(profile).max() < VARIES * found.spread.max()
    size = found.spread if varies else np.abs(profile)
    worst = int(np.argmax(size))
    share = size[worst] * 2.0 * np.pi * width**2
    at = f"{share:.2%} of its peak at {(worst + 0.5) * REACH / RINGS * width:.1f} pixels"
    if varies:
        return (
            f"around the sources the light differs from the PSF by {at} (root mean square), "
            "and differently from one part of the frame to another"
        )
    side = "more" if profile[worst] > 0.0 else "less"
    large: Flags = np.abs(profile) > 0.1 * np.abs(profile).max()
    turns = np.unique(np.sign(profile[large])).size > 1
    also = ", and the opposite farther out or in" if turns else ""
    return f"around the sources the counts have {side} light than the PSF, by {at}{also}"


def companions(context: Context) -> Finding | None:
    """Light beside the sources that is not their PSF's and in no catalogue.

    The best place of one companion to each source, by a matched filter.
    """
    found = common_pattern(context, ORDERS)
    if found is None:
        return None
    s, shape, used = context.light.width, context.expected.shape, context.used
    z = np.zeros(shape)
    z[found.pixels] = context.z[found.pixels] - found.pattern
    inverse = np.where(used, 1.0 / context.variance, 0.0)
    pull = ndimage.gaussian_filter(z * np.sqrt(inverse), s, mode="constant")
    information = ndimage.gaussian_filter(inverse, s / 2.0**0.5, mode="constant")
    power = np.maximum(pull, 0.0) ** 2 * 4.0 * np.pi * s**2 / np.maximum(information, 1e-300)
    best = np.zeros(context.flux.size)
    np.maximum.at(best, found.source, power[found.pixels])
    some = best > DETECTED**2
    if not some.any():
        return None
    first = int(np.argmax(best))
    here = np.flatnonzero(found.source == first)
    pixel = here[np.argmax(power[found.pixels][here])]
    catalog = context.posterior.model.sources
    cause = Cause(
        "companions", 0.0,
        f"beside {some.sum()} of {context.light.matched.sum()} sources there is light of no "
        "catalogued source, which differs from source to source, as that of a wrong PSF would "
        f"not: the most at {np.hypot(found.u[pixel], found.v[pixel]):.1f} pixels from row {first} "
        f"of the catalogue, from 0, at x, y = {catalog.x[first]:.1f}, {catalog.y[first]:.1f}",
        "complete the catalogue" if context.rejected
        else f"{REJECT}, which leaves out the sources concerned, or complete the catalogue",
    )  # fmt: skip
    return Finding(cause, float(best[some].sum()), "light position", RICHEST)
