"""The hypotheses that the background is not the polynomial that was fitted, or no background."""

import math
from collections.abc import Iterator

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.causes.cause import Cause, Finding
from bayesfred.analysis.causes.context import Context
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS, MOST_ORDER
from bayesfred.model.noise import SubtractedNoise
from bayesfred.optimize.local_background import structure_outside
from bayesfred.optimize.wings import wings_outside

NOTICEABLE = 5.0  # standard deviations
TILES_A_TERM = 2  # at least, for a polynomial to be tried


def wings(context: Context) -> Finding | None:
    """Light of the sources outside their footprints, which is taken for background within them."""
    found = wings_outside(context.posterior, context.params)
    if found is None:
        return None
    cause = Cause("wings", 0.0, found.sentence, found.remedy)
    return Finding(cause, min(found.squares, abs(context.excess)), "background")


def background_between(
    context: Context, tiles: tuple[Floats, Floats, Floats], ratio: float, everywhere: float
) -> Iterator[Finding]:
    """A background that is not the polynomial that was fitted."""
    mean, size, _ = tiles
    squares = float(np.sum(size * mean**2))
    if not _noticed(squares, ratio, mean.size):
        return
    held = squares - ratio * mean.size
    excess = held / float(np.sum(size))  # of what the noise of so few pixels makes of the means
    by = float((excess * np.median(context.variance[context.used])) ** 0.5)
    mending = _mending_order(context.posterior.nuisances.background_order, tiles, ratio)
    cause = _uneven(context, "between the sources", by, mending)
    yield Finding(cause, min(held * everywhere, abs(context.excess)), "background")


def background_outside(context: Context) -> Iterator[Finding]:
    """A background whose structure the pixels outside the footprints show.

    It explains what adding it to the model would, the fluxes and the mean being fitted again.
    """
    found = structure_outside(context.posterior, context.params)
    if found is None:
        return
    used, inverse = context.used, 1.0 / context.variance
    structure = np.where(used, found.counts, 0.0)
    structure -= np.average(structure[used], weights=inverse[used])
    light = context.expected - context.background
    pull = context.per_source(light * structure * inverse, np.inf)
    share = pull / np.maximum(context.per_source(light**2 * inverse, np.inf), 1e-300)
    left = structure - np.where(context.owner < 0, 0.0, share[context.owner] * light)
    gained = np.sum((2.0 * context.residual - left)[used] * (left * inverse)[used])
    if gained < NOTICEABLE * 2.0 * float(np.sum((left**2 * inverse)[used])) ** 0.5:
        return
    by = float(np.std(structure[used]))
    size = np.maximum(context.source_pixels, 1.0)
    mean = context.per_source(structure * np.sqrt(inverse)) / size
    place = context.light.position / (0.5 * np.array(used.shape[::-1]))
    seen = context.light.inside
    tiles = mean[seen], size[seen], place[seen].T
    mending = _mending_order(context.posterior.nuisances.background_order, tiles, 1.0)
    cause = _uneven(context, "outside the footprints", by, mending, found.scale)
    yield Finding(cause, float(gained), "background")


def _uneven(
    context: Context, where: str, by: float, mending: int | None, scale: float | None = None
) -> Cause:
    """A background that differs from the model's by so many counts."""
    remedy = f"set nuisances.background_order = {mending}"
    if mending is None:
        remedy = f"{_structured(context, scale)}, or mask what is not background"
    return Cause(
        "background", 0.0,
        f"the background {where} differs from the model's by {by:.2g} counts a pixel "
        "(root mean square), from one part of the frame to another",
        remedy,
    )  # fmt: skip


def _structured(context: Context, scale: float | None) -> str:
    """What to do about structure that no polynomial follows."""
    if isinstance(context.posterior.noise.pixelwise, SubtractedNoise):
        return f"narrow frame.background_scale{f', to {scale:g}' if scale else ''}"
    if scale:
        return f"set frame.background_scale = {scale:g}"
    return "measure it outside footprints (nuisances.footprint and frame.background_scale)"


def _mending_order(order: int, tiles: tuple[Floats, Floats, Floats], ratio: float) -> int | None:
    """The least order, above the one that was fitted, that leaves nothing to notice."""
    mean, size, (u, v) = tiles
    root = np.sqrt(size)
    for more in range(order + 1, MOST_ORDER + 1):
        powers = BACKGROUND_POWERS[: math.comb(more + 2, 2)]
        if mean.size < TILES_A_TERM * len(powers):
            break
        design = np.stack([u**m * v**n for m, n in powers], axis=1) * root[:, None]
        found, *_ = np.linalg.lstsq(design, mean * root, rcond=None)
        left = float(np.sum((mean * root - design @ found) ** 2))
        if not _noticed(left, ratio, mean.size - len(powers)):
            return more
    return None


def _noticed(squares: float, ratio: float, number: int) -> bool:
    """Whether squares of that sum are more than chance, given their mean by chance."""
    return squares > ratio * (number + NOTICEABLE * math.sqrt(2.0 * number))
