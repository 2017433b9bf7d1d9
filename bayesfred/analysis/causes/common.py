"""The residual that all sources have in common, in units of their flux."""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.causes.context import BRIGHT, Context

RINGS, REACH = 8, 4.0  # around each image, and their outer radius in PSF widths
EACH = 6  # sources for each term over the field
MOST = 4  # degree over the field
FEWEST = 5  # pixels of a ring


class CommonPattern(NamedTuple):
    """Residuals around the images, and what of them is common.

    Attributes
    ----------
    pixels : tuple of two ndarrays, shape (n,)
        Rows and columns.
    source : ndarray, shape (n,)
        Whose image is nearest.
    u, v : ndarray, shape (n,), recorded pixel
        From that image.
    pattern : ndarray, shape (n,)
        The common residual, in standard deviations.
    explained : float
        Sum of squares, less what noise gives to the numbers fitted.
    numbers : int
        How many numbers were fitted.
    profile, spread : ndarray, shape (RINGS,)
        Of each ring, the residual over the sources' flux: its mean, and the root mean square of
        what is common.
    """

    pixels: tuple[Ints, Ints]
    source: Ints
    u: Floats
    v: Floats
    pattern: Floats
    explained: float
    numbers: int
    profile: Floats
    spread: Floats


def common_pattern(context: Context, orders: Iterable[int]) -> CommonPattern | None:
    """Stack the residuals around the sources' images in rings, relative to fluxes.

    Parameters
    ----------
    context : Context
    orders : iterable of int
        Of the harmonics of the angle along a ring, 0 first. Each varies over the field, with as
        high a degree as the number of sources allows, at most 4.

    Returns
    -------
    CommonPattern or None
        None of less than two bright sources.
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
    radius, angle = np.hypot(u, v), np.arctan2(v, u)
    ring = (radius / (REACH * s) * RINGS).astype(int)
    x, y = (c / (0.5 * shape.max()) for c in light.position[source].T)
    shapes = [f(m * angle) for m in orders for f in ((np.cos, np.sin) if m else (np.cos,))]
    degree = max(n for n in range(MOST + 1) if n == 0 or good.sum() >= EACH * math.comb(n + 2, 2))
    over = [x**i * y ** (n - i) for n in range(degree + 1) for i in range(n + 1)]
    pattern, numbers, (profile, spread) = np.zeros(z.size), 0, np.zeros((2, RINGS))
    for k in range(RINGS):
        here = ring == k
        if here.sum() < FEWEST:
            continue
        columns = np.stack([(a * b * template)[here] for a in shapes for b in over], axis=1)
        found, *_ = np.linalg.lstsq(columns, z[here], rcond=1e-10)
        pattern[here] = columns @ found
        numbers += columns.shape[1]
        square = max(float(columns[:, 0] @ columns[:, 0]), 1e-300)
        profile[k] = float(columns[:, 0] @ z[here]) / square
        spread[k] = float(pattern[here] @ pattern[here] / square) ** 0.5
    explained = float(pattern @ pattern) - numbers
    return CommonPattern((row, column), source, u, v, pattern, explained, numbers, profile, spread)
