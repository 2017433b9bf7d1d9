"""The polynomials of `mean_series`, from a noise's log-density.

Each is the interpolation at Chebyshev's nodes, one of which is the middle of the range. Where it
differs too much from log p in between, the range is halved a few times. After that, or where the
mean is not positive, the pixel is always out of range and its log p is evaluated.
"""

import math
from typing import Any

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.model.kernels.contexts import LIMIT
from bayesfred.model.kernels.mean_series import BLOCK, DEGREE, FIELDS, MeanSeries
from bayesfred.model.kernels.noise_dispatch import log_density

TOLERANCE = 5e-6  # of the sum, if the errors of pixels at the ends of their ranges are independent
LARGE = 1e5  # mean from which on rounding counts, and the tolerance is proportional to it
HALVINGS = 3  # of a range
LEAST_RANGE = 1e-3  # in units of the photon noise: large against the rounding of float32
MOST_RANGE = 0.5  # in units of the mean: log p is singular nowhere but at negative means
NEVER = 1e18  # 1 / R of pixels that are always out of range

NODES = np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
BETWEEN = np.cos(np.pi * np.arange(DEGREE + 2) / (DEGREE + 1))  # where the error is largest
POINTS = np.concatenate([NODES, BETWEEN])
MIDDLE = DEGREE // 2
FROM_NODES = np.linalg.inv(np.vander(NODES, increasing=True))[1:]  # coefficients of t, t^2, ...


@inner(fastmath=FAST)
def _evaluate(noise, values, first, centre, reach, out):
    """Log p of a segment's pixels at POINTS of their ranges."""
    for j in range(POINTS.size):
        for i in range(SEGMENT):
            mu = centre[i] + reach[i] * POINTS[j]
            n = values[i] if values[i] > LIMIT else mu
            out[j, i] = log_density(noise, n, mu, 0.0, np.uint64(first + i))


@inner()
def _fit(known, i, block):
    """Coefficients of pixel i into its block, and the largest error."""
    middle, error = known[MIDDLE, i], 0.0
    for k in range(DEGREE):
        total = 0.0
        for j in range(DEGREE + 1):
            total += FROM_NODES[k, j] * (known[j, i] - middle)
        block[(2 + k) * SEGMENT + i] = total
    for j in range(DEGREE + 1, POINTS.size):
        p = 0.0
        for k in range(DEGREE - 1, -1, -1):
            p = (p + block[(2 + k) * SEGMENT + i]) * POINTS[j]
        error = max(error, abs(known[j, i] - middle - p))
    return error


@entry()
def _expand(noise, values, means, tolerance, blocks, constants):
    """The polynomials of all segments; means are (mean, change), see `expand`."""
    mean, change = means
    known, centre, reach = np.empty((POINTS.size, SEGMENT)), np.ones(SEGMENT), np.ones(SEGMENT)
    left = np.zeros(SEGMENT, np.bool_)
    for s in range(constants.size):
        first, some = s * SEGMENT, 0
        block, n = blocks[s * BLOCK : (s + 1) * BLOCK], values[first : first + SEGMENT]
        for i in range(SEGMENT):
            left[i] = n[i] > LIMIT
            centre[i] = np.float32(mean[first + i]) if left[i] else 1.0
            some += left[i]
            positive = max(centre[i], 1e-30)
            most = max(change[first + i], LEAST_RANGE * np.sqrt(positive))
            reach[i] = min(most, MOST_RANGE * positive)
        for halving in range(HALVINGS + 1):
            if some == 0:
                break
            _evaluate(noise, n, first, centre, reach, known)
            for i in range(SEGMENT):
                if not left[i]:
                    continue
                if halving == 0:
                    constants[s] += known[MIDDLE, i]
                block[i] = centre[i]
                allowed = tolerance * max(1.0, centre[i] / LARGE)
                if centre[i] > 0.0 and _fit(known, i, block) <= allowed:
                    block[SEGMENT + i] = 1.0 / reach[i]
                    left[i] = False
                    some -= 1
                else:
                    reach[i] *= 0.5
        for i in range(SEGMENT):
            if left[i]:
                block[SEGMENT + i] = NEVER
                for k in range(DEGREE):
                    block[(2 + k) * SEGMENT + i] = 0.0


def expand(noise: Any, values: Floats, mean: Floats, change: Floats) -> MeanSeries:
    """The polynomials of a frame.

    Parameters
    ----------
    noise : compiled half of a noise model
    values : ndarray, shape (ny * stride,), counts; MASKED where a pixel is not used
    mean : ndarray, shape (ny * stride,), counts
        About which log p is expanded.
    change : ndarray, shape (ny * stride,), counts
        By how much a mean may move.

    Returns
    -------
    MeanSeries
    """
    segments = values.size // SEGMENT
    blocks, constants = np.zeros(segments * FIELDS * SEGMENT, np.float32), np.zeros(segments)
    tolerance = TOLERANCE / math.sqrt(max(int(np.sum(values > LIMIT)), 1))
    _expand(noise, values, (mean, change), tolerance, blocks, constants)
    return MeanSeries(blocks, constants)
