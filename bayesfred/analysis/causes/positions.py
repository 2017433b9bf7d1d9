"""Hypotheses about where the sources are imaged.

The displacements of the sources' light from their images are regressed on patterns, each set
including the one before: what the model's own coefficients can still do, a constant, a linear map,
then every term of degree 2, of degree 3, up to two degrees more than the model has. The model's own
patterns come first because a fit with terms that are missing bends those that it has: what is
missing is only visible beside them. The smallest set is named that explains nearly what the largest
does, if that is more than so many numbers explain of displacements without a pattern. Images far
from their light have no displacement that could be measured; then the catalogue is searched for
among the peaks.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.causes.cause import (
    MISSING,
    RICHER,
    Cause,
    Finding,
    scatter_remedy,
    terms_remedy,
)
from bayesfred.analysis.causes.context import BRIGHT, Context
from bayesfred.analysis.causes.search import Placement, find_placement
from bayesfred.optimize.matching import Field

HIGHEST = 3  # degree of the patterns that are tried at least
ENOUGH = 0.85  # of what the largest set of patterns explains
MOST_LOST = 0.05  # share of the sources that are seen nowhere near their image
MORE = 1.1  # times as many sources as the fit matches
NEAR_HALF = 0.04  # of the frame's side: distance of a shift from half of it
WRONG = 30.0  # times the median square: sources whose squares count as no more
MORE_NUMBERS = 2  # times as many coordinates as patterns, or these describe anything
ROUNDS = 6


class Displaced(NamedTuple):
    """Sources with displacements.

    Attributes
    ----------
    sources : ndarray, shape (n,)
    position : ndarray, shape (n, 2), recorded pixel
        Where their light is.
    displacement : ndarray, shape (n, 2), recorded pixel
        Of the light from the image.
    power : ndarray, shape (n,)
        Squared signal to noise.
    """

    sources: Ints
    position: Floats
    displacement: Floats
    power: Floats


def placement(context: Context) -> Finding | None:
    """What is wrong with the images' places, if it is something that they share."""
    light, bright = context.light, context.bright
    seen = int((light.matched & bright).sum())
    few = light.inside.sum() < 0.5 * len(light.inside)
    if few or seen < (1.0 - MOST_LOST) * bright.sum():
        found = find_placement(context)
        if found is not None and found.sources.size >= MORE * light.matched.sum() + 1.0:
            return _misplaced(context, found)
    if seen < 0.5 * bright.sum() or not light.matched.any():
        return unmatched(context)
    near = np.flatnonzero(light.matched & (context.power > 0.0))
    measured = Displaced(
        near, light.position[near] + light.displacement[near], light.displacement[near],
        context.power[near],
    )  # fmt: skip
    return _patterns(context, measured)


def scatter(context: Context) -> Finding | None:
    """Displacements that every source has for itself: those that no pattern describes."""
    light = context.light
    near = np.flatnonzero(light.matched & (context.power > BRIGHT))
    if context.posterior.nuisances.position_scatter or near.size < 2:
        return None
    measured = Displaced(near, light.position[near], light.displacement[near], context.power[near])
    for matrix in _designs(context, measured)[-1:]:
        measured = measured._replace(displacement=_rest(matrix, measured))
    own = measured.displacement
    explained = _gained(context, measured, np.zeros_like(own)) - own.size
    size = float(np.median(np.abs(own))) / 0.6745
    cause = Cause(
        "positions", 0.0,
        f"the sources lie off their places, by {size:.2g} pixels along each axis (68 % of them)",
        scatter_remedy(context.posterior),
    )  # fmt: skip
    return Finding(cause, explained, "light position", RICHER) if explained > 0.0 else None


def unmatched(context: Context) -> Finding:
    """The catalogue's sources are not in the frame, wherever they are looked for."""
    light = context.light
    missed = light.inside & ~light.matched
    dark = float(np.minimum(context.power, context.catalogue_power)[missed].sum())
    found = context.detections
    explained = dark + float(found.power.sum()) + float(
        np.maximum(context.source_excess, 0.0)[light.matched].sum()
    )  # fmt: skip
    sources = len(light.matched)
    cause = Cause(
        "unmatched", 0.0,
        f"{light.matched.sum()} of {sources} sources are matched, {light.inside.sum()} should be "
        f"in the frame, and {len(found.power)} detections belong to none",
        "check that the catalogue is of this field, the columns, their unit and origin, and the "
        "PSF's width",
    )  # fmt: skip
    return Finding(cause, explained, "position")


def _misplaced(context: Context, found: Placement) -> Finding | None:
    """What has to be done to the catalogue to find it in the frame."""
    light = context.light
    displacement = found.position - light.position[found.sources]
    power = context.catalogue_power[found.sources]
    measured = Displaced(found.sources, found.position, displacement, power)
    parity = np.linalg.det(found.map) < 0.0
    angle = float(np.rad2deg(np.arctan2(found.map[1, 0], found.map[0, 0])))
    how = f"{light.matched.sum()} of {len(light.matched)} sources are matched"
    many = f"{found.sources.size} are"
    corner = _by_half(context, found)
    if parity:
        axis = "x and y are exchanged" if abs(found.map[0, 1]) > abs(found.map[0, 0]) else (
            "x runs the other way" if found.map[0, 0] < 0.0 else "y runs the other way"
        )  # fmt: skip
        also = ", and positions count from the corner" if corner else ""
        cause = Cause(
            "parity", 0.0, f"{how}; {many} if {axis}{also}",
            "mirror the catalogue: change the sign of a column, or exchange the columns",
        )  # fmt: skip
    elif corner:
        cause = Cause(
            "origin", 0.0,
            f"{how}; {many} if positions are shifted by {found.shift[0]:.1f}, {found.shift[1]:.1f} "
            "pixels, half of the frame: they count from its corner",
            "subtract the middle of the frame, ((nx - 1) / 2, (ny - 1) / 2), from x and y",
        )  # fmt: skip
    elif abs(angle) > 5.0:
        scale = abs(np.linalg.det(found.map)) ** 0.5
        cause = Cause(
            "rotation or scale", 0.0,
            f"{how}; {many} if the catalogue is rotated by {angle:.1f} degrees and scaled by "
            f"{scale:.3f}",
            "rotate and scale the catalogue first; linear terms take up the rest",
        )  # fmt: skip
    else:
        return _patterns(context, measured, how=f"{how}; {many} with their light: ")
    return Finding(cause, _gained(context, measured, np.zeros_like(displacement)), "position")


def _by_half(context: Context, found: Placement) -> bool:
    """Whether the shift is half of the frame along both axes."""
    sides = np.array(context.expected.shape[::-1], dtype=float)
    return bool(np.all(np.abs(np.abs(found.shift) - 0.5 * sides) < NEAR_HALF * sides + 2.0))


def _gained(context: Context, measured: Displaced, rest: Floats) -> float:
    """Sum of squares that goes if the displacements become `rest`."""
    before, after = (_held(context, measured, by) for by in (measured.displacement, rest))
    return float(np.sum(before - after))


def _held(context: Context, measured: Displaced, by: Floats) -> Floats:
    """Sum of squares of each source that is displaced `by` so much; see the package's head."""
    s = context.light.width
    squared = np.sum(np.where(np.isfinite(by), by, 1e3 * s) ** 2, axis=1)
    apart = -np.expm1(-squared / (4.0 * s**2))
    # the farther from the model's light, the less variance the model has where light is
    missing = context.missing_power[measured.sources]
    return np.asarray(apart * (2.0 * measured.power + apart * (missing - measured.power)))


def _patterns(context: Context, measured: Displaced, how: str = "") -> Finding | None:
    """Which set of patterns explains the displacements."""
    sets = _designs(context, measured)
    rests = [_rest(matrix, measured) for matrix in sets]
    gains = [_gained(context, measured, rest) for rest in rests]
    numbers = [matrix.shape[1] for matrix in sets]
    if not gains:
        return None
    # the square that noise or scatter leaves of a coordinate, but for a few wrong sources
    held = _held(context, measured, rests[-1])
    each = np.minimum(held, WRONG * np.median(held)).sum() / (2 * held.size - numbers[-1])
    if gains[-1] < 5.0 * numbers[-1] * max(each, 1.0):
        return None
    level = int(np.argmax(np.array(gains) >= ENOUGH * max(gains)))
    name = ("own", "shift", "rotation or scale", MISSING)[min(level, 3)]
    explained = gains[level] - numbers[level]
    taken = rests[0] - rests[level] if level else measured.displacement
    size = np.hypot(*taken.T)
    largest = int(np.argmax(size))
    at = ", ".join(f"{value:.0f}" for value in measured.position[largest])
    if level == 0:
        if not how:
            return None
        cause = Cause(
            "unmatched", 0.0, how + "the model's own terms reach them, and the search did not",
            "begin elsewhere (start), widen the priors, or fit fewer terms first",
        )  # fmt: skip
    elif name == "shift":
        u, v = np.mean(taken, axis=0)
        cause = Cause(
            name, 0.0, f"{how}all sources are shifted by {u:+.3g}, {v:+.3g} pixels",
            "widen the prior of offset_x and offset_y" if context.posterior.nuisances.offset
            else "set nuisances.offset = true",
        )  # fmt: skip
    elif name == "rotation or scale":
        cause = Cause(
            name, 0.0,
            f"{how}displacements grow linearly over the field, up to {size[largest]:.3g} pixels at "
            f"u, v = {at}",
            "correct the catalogue's position angle and pixel scale, or add linear terms, x and y "
            "in f and g",
        )  # fmt: skip
    else:
        cause = Cause(
            name, 0.0,
            f"{how}displacements that the terms do not describe vary smoothly over the field, up "
            f"to {size[largest]:.3g} pixels at u, v = {at}",
            terms_remedy(level - 1),
        )  # fmt: skip
    return Finding(cause, explained, "position")


def _designs(context: Context, measured: Displaced) -> list[Floats]:
    """Patterns of displacement at the sources, shape (2 n, k), each set with the ones before."""
    model, n = context.posterior.model, measured.sources.size
    step = model.detector.binning
    own = Field(context.posterior).design(measured.sources, measured.position * step)
    half = 0.5 * max(model.detector.fine_shape)
    x, y = model.sources.x[measured.sources] / half, model.sources.y[measured.sources] / half
    lens = model.polynomial
    fitted = set(lens.f_terms) & set(lens.g_terms) if lens.basis is None else set()
    sets, matrix = [], own.reshape(2 * n, -1)
    top = max(HIGHEST, 2 + max(sum(term) for term in (*lens.f_terms, *lens.g_terms)))
    for degree in range(-1, top + 1):  # none, then a constant
        powers = [(i, degree - i) for i in range(degree + 1)]
        terms = [x**i * y**j for i, j in powers if (i, j, 0, 0) not in fitted]
        more = [np.concatenate(pair) for t in terms for pair in ((t, 0.0 * t), (0.0 * t, t))]
        matrix = np.column_stack([matrix, *more])
        if 2 * n < MORE_NUMBERS * matrix.shape[1] + 4:
            break
        sets.append(matrix / np.maximum(np.linalg.norm(matrix, axis=0), 1e-300))
    return sets


def _rest(matrix: Floats, measured: Displaced) -> Floats:
    """Displacements less the patterns, fitted with weights that fall for a few wrong sources."""
    root, right = np.sqrt(np.tile(measured.power, 2)), measured.displacement.T.ravel()
    keep = np.ones(measured.sources.size)
    rest = right
    for _ in range(ROUNDS):
        weight = root * np.tile(keep, 2)
        found, *_ = np.linalg.lstsq(matrix * weight[:, None], right * weight, rcond=1e-10)
        rest = right - matrix @ found
        size = np.hypot(*rest.reshape(2, -1))
        scale = max(float(np.median(size)) / 1.18, 1e-6)
        keep = 1.0 / (1.0 + (size / (4.0 * scale)) ** 2) ** 0.5
    return np.asarray(rest.reshape(2, -1).T)
