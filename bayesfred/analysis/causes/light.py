"""Hypotheses about the sources' light: fluxes, the PSF, single sources, what no catalogue has."""

from collections.abc import Iterator

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.causes.cause import Cause, Finding
from bayesfred.analysis.causes.context import BRIGHT, Context

ENOUGH = 0.85  # of what fluxes of their own explain
RICHER = 0.9  # weight of a hypothesis that contains others
FEW = 0.2  # of the sources: more than these are not the ones to blame
OUTLYING = 6.0  # times the typical misfit of a source as bright
NOTICEABLE = 6.0  # standard deviations
NAMED = 5  # sources listed
RINGS, REACH = 8, 4.0  # of the PSF's residual, and their outer radius in PSF widths


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


def single_sources(context: Context) -> Iterator[Finding]:
    """Few sources that hold most of the misfit, and light that belongs to no source."""
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
        order = np.argsort(-own)[: min(NAMED, int(wrong.sum()))]
        s = context.posterior.model.sources
        names = "; ".join(f"{k} at x, y = {s.x[k]:.1f}, {s.y[k]:.1f}" for k in order)
        dim = f", {dark.sum()} of them with no light at their image" if dark.any() else ""
        more = ", ..." if wrong.sum() > len(order) else ""
        cause = Cause(
            "wrong sources", 0.0,
            f"{wrong.sum()} of {light.inside.sum()} sources hold the misfit{dim}: rows of the "
            f"catalogue, from 0: {names}{more}",
            "correct their positions and fluxes, or set frame.reject_outliers = true",
        )  # fmt: skip
        explained = float(own.sum() + found.power[near].sum())
        yield Finding(cause, explained, "position")
    rest = found.power[len(near) and near.sum() :]
    if rest.size and power.size:
        at = ", ".join(f"{value:.0f}" for value in found.position[len(found.power) - rest.size])
        cause = Cause(
            "uncatalogued sources", 0.0,
            f"{rest.size} detections belong to no source of the catalogue, the brightest at "
            f"u, v = {at}",
            "set frame.reject_outliers = true, or footprint, or complete the catalogue",
        )  # fmt: skip
        yield Finding(cause, float(rest.sum()), "position")


def psf(context: Context) -> Finding | None:
    """Residuals that all sources share: another profile than the model's.

    Stacked around the sources' images, relative to their fluxes, in rings and in the two ways in
    which a ring can be drawn out, each constant or linear over the field. A dipole is left out: it
    is a displacement.
    """
    light, s = context.light, context.light.width
    good = light.matched & (context.power > BRIGHT)
    if good.sum() < 2:
        return None
    near = context.used & (context.distance <= REACH * s + 1.0)
    near &= good[context.owner] & (context.owner >= 0)
    row, column = np.nonzero(near)
    source = context.owner[row, column]
    shape = np.array(context.expected.shape)
    u = column - 0.5 * (shape[1] - 1.0) - light.position[source, 0]
    v = row - 0.5 * (shape[0] - 1.0) - light.position[source, 1]
    flux = np.maximum(context.posterior.fluxes(context.params), 0.0)[source]
    template = flux / np.sqrt(context.variance[row, column])
    z = context.z[row, column]
    radius, angle = np.hypot(u, v), 2.0 * np.arctan2(v, u)
    ring = np.minimum((radius / (REACH * s) * RINGS).astype(int), RINGS)
    inside = ring < RINGS
    x, y = (c / (0.5 * shape.max()) for c in light.position[source].T)
    shapes = [np.ones(z.size), np.cos(angle), np.sin(angle)]
    over = [np.ones(z.size)] if good.sum() < 12 else [np.ones(z.size), x, y]
    explained, profile = 0.0, np.zeros(RINGS)
    for k in range(RINGS):
        here = inside & (ring == k)
        if here.sum() < 5:
            continue
        columns = np.stack([(a * b * template)[here] for a in shapes for b in over], axis=1)
        found, *_ = np.linalg.lstsq(columns, z[here], rcond=1e-10)
        explained += float(np.sum((columns @ found) ** 2)) - columns.shape[1]
        profile[k] = float(columns[:, 0] @ z[here] / max(columns[:, 0] @ columns[:, 0], 1e-300))
    return _shape(context, explained, profile)


def _shape(context: Context, explained: float, profile: Floats) -> Finding | None:
    if explained < NOTICEABLE * (2.0 * 9 * RINGS) ** 0.5:
        return None
    s = context.light.width
    peak = 1.0 / (2.0 * np.pi * s**2)
    worst = int(np.argmax(np.abs(profile)))
    ring = (worst + 0.5) * REACH / RINGS * s
    side = "more" if profile[worst] > 0.0 else "less"
    also = _turns(profile)
    mode = context.posterior.nuisances.psf_sigma
    impulse = context.posterior.model.detector.pixel == "impulse"
    box = ', or pixel = "box" if it is narrow' if impulse else ""
    cause = Cause(
        "PSF", 0.0,
        f"around the sources the counts have {side} light than the PSF, by "
        f"{abs(profile[worst]) / peak:.2%} of its peak at {ring:.1f} pixels{also}",
        f'fit another PSF: kind = "moffat" or "sampled"{box}' if mode
        else "set nuisances.psf_sigma = true, or fit another PSF",
    )  # fmt: skip
    return Finding(cause, explained, "light", RICHER)


def _turns(profile: Floats) -> str:
    """In words, whether the residual changes its sign outward."""
    large: Flags = np.abs(profile) > 0.1 * np.abs(profile).max()
    signs = np.sign(profile[large])
    return ", and the opposite farther out or in" if np.any(signs != signs[0]) else ""
