"""What the loops ask of a noise model, answered at compile time by its type.

The compiled half of a noise model is a named tuple class. Its fields are numbers and arrays; its
static methods are compiled into the loops. n are counts, mu is their mean, and light is the part of
the mean that comes from sources. p is the pixel's place in the frame's padded, flattened rows. A
model has

    log_density(noise, n, mu, light, p)
                                      log-density, up to what depends on the counts alone; MASKED
                                      or less where mu is impossible
    derivatives(noise, n, mu, light, p)
                                      s = d log_density / d mu, W = -ds / d mu, C = -1/2 dW / d mu
    information(noise, mu, light, p)  the expectation of W

These see a pixel outside the likelihood, too, as one with n = mu; what they return for it is not
used. They must not branch where a loop shall vectorise. A model may have its own way to sum over
whole segments of a row. There the mean is (image + level) response, or image + level if the
response is None:

    summed(noise, values, light, mean, place)
                                      the sum of log_density; `mean` is (image, level, response),
                                      `place` the first pixel's, and the `scratch` of `Workspace`

A model whose log_density takes long has a field `near`, a `MeanSeries`. It is empty unless the
frame is to be evaluated near known means. Where it serves, `summed` is not called. What never needs
it calls

    summed_exactly(noise, values, light, mean, place)

Where the background is constant, it may spare the loops the pixels that no source reaches:

    unreached(noise, rest, level)     the sum of log_density over them, its derivative in the level,
                                      and the sum of information; `rest` is an `Unreached`

A model that admits a model error, see `model_error.py`, has

    spread(noise, mu, p)              the variance of the counts and its derivative in mu

A model that depends on parameters beyond the mean has

    given(noise, parameters)          the model for these, itself a noise's compiled half
    level_derivatives(noise, pixels, level, value)
                                      what that adds to the derivative of the log-likelihood, whose
                                      value is given, and to the information
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload

from bayesfred.imaging.kernels.compilation import leaf
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.imaging.kernels.fastmath import REDUCE, wide_vectors
from bayesfred.imaging.kernels.psf_dispatch import by_type
from bayesfred.model.kernels.contexts import LIMIT, STRETCH
from bayesfred.model.kernels.mean_series import BLOCK, sum_polynomials

MANY = 64.0  # pixels out of range, for which a whole stretch is summed by the formula


def _optional(name: str, default: Callable[..., Any]) -> Callable[..., Any]:
    return by_type(lambda family: getattr(family, name, default))


def _same(noise, parameters):
    return noise


def _no_pixels(noise, rest, level):
    return 0.0, 0.0, 0.0


def _no_derivatives(noise, pixels, level, value):
    return 0.0, 0.0


log_density = by_type(lambda family: family.log_density)
derivatives = by_type(lambda family: family.derivatives)
information = by_type(lambda family: family.information)
unreached = _optional("unreached", _no_pixels)


def scaled(mean: Any, response: Any, i: Any) -> Any:
    """The mean times the response of pixel i, if there is one."""
    raise NotImplementedError("for compiled code")


@overload(scaled, inline="always", strict=False)
def _choose_scaled(mean: Any, response: Any, i: Any) -> Any:
    if isinstance(response, types.NoneType):
        return lambda mean, response, i: mean
    return lambda mean, response, i: mean * response[i]


def part_of(mean: Any, first: Any, size: Any) -> Any:
    """What `summed` calls `mean`, of some of the pixels."""
    raise NotImplementedError("for compiled code")


@overload(part_of, inline="always", strict=False)
def _choose_part(mean: Any, first: Any, size: Any) -> Any:
    if isinstance(mean[2], types.NoneType):
        return lambda mean, first, size: (mean[0][first : first + size], mean[1], None)
    return lambda mean, first, size: (
        mean[0][first : first + size],
        mean[1],
        mean[2][first : first + size],
    )


@leaf(fastmath=REDUCE)
def sum_pixels(noise, values, light, mean, first):
    """Sum of the log-densities of the unmasked pixels of a stretch, one by one."""
    wide_vectors()
    (image, level, response), total = mean, 0.0
    for i in range(image.size):
        mu = scaled(image[i] + level, response, i)
        counted = values[i] > LIMIT
        n = values[i] if counted else mu
        term = log_density(noise, n, mu, light[i], np.uint64(first + i))
        total += term if counted else 0.0
    return total


def _pixel_by_pixel(noise, values, light, mean, place):
    return sum_pixels(noise, values, light, mean, place[0])


def _exact(noise):
    return True


def _no_slopes(noise, n, mu, light, p):
    return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0


def _no_information(noise, mu, light, p):
    return 0.0


summed_exactly = _optional("summed", _pixel_by_pixel)


def _summed_near(noise, values, light, mean, place):
    """The sum from the polynomials of `near`, but for the pixels out of their range.

    Where these are few, only their segments are summed by the formula.
    """
    blocks, constants = noise.near
    total, a, step = 0.0, 0, STRETCH if constants.size else values.size
    while a < values.size:
        b = min(a + step, values.size)
        value, outside = 0.0, MANY
        if constants.size:
            i, j = (place[0] + a) // SEGMENT, (place[0] + b) // SEGMENT
            block = blocks[i * BLOCK : j * BLOCK]
            value, outside = sum_polynomials(block, constants[i:j], mean[0][a:b], mean[1])
        if 0.0 < outside < MANY and b - a > SEGMENT:
            step = SEGMENT
            continue
        if outside > 0.0:
            first = place[0] + a
            part = part_of(mean, a, b - a)
            value = summed_exactly(noise, values[a:b], light[a:b], part, (first, place[1]))
        total += value
        a = b
        step = step if a % STRETCH else STRETCH
    return total


summed = by_type(
    lambda family: (
        _summed_near if hasattr(family, "near") else getattr(family, "summed", _pixel_by_pixel)
    )
)
spread = by_type(lambda family: family.spread)
given = _optional("given", _same)


def by_exactness(exact: Callable[..., Any], inexact: Callable[..., Any]) -> Callable[..., Any]:
    """A function of a noise model with another code for families that have `exact_weight`."""
    return by_type(lambda family: inexact if hasattr(family, "exact_weight") else exact)


# What a model error adds, see `model_error.py`.
exact_weight = _optional("exact_weight", _exact)
error_slopes = _optional("error_slopes", _no_slopes)
error_information = _optional("error_information", _no_information)
level_derivatives = _optional("level_derivatives", _no_derivatives)
