"""Sums of log p over pixels whose means are near known ones, for noise that is slow to evaluate.

While a posterior is sampled every pixel's mean moves by little, and log p is nearly a parabola
there. With c the pixel's mean at the maximum and R its range, log p(n | mu) is log p(n | c) plus a
polynomial in t = (mu - c) / R on -1 <= t <= 1, whatever the noise. `expansion_of_mean` finds it.

A pixel's numbers are read once for each sum, and reading takes longer than the arithmetic. So they
are float32 and those of a segment's pixels lie together. They lose nothing: c is a float32 number,
t is evaluated in float64, and log p(n | c) is in the segments' sums, which are float64.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import leaf
from bayesfred.imaging.kernels.contexts import SEGMENT

DEGREE = 4  # of the polynomials; even, so that t = 0 is among the nodes
FIELDS = DEGREE + 2  # numbers of a pixel: c, 1 / R, and the coefficients of t, t^2, ...
BLOCK = FIELDS * SEGMENT


class MeanSeries(NamedTuple):
    """Polynomials for log p of every pixel, in blocks of SEGMENT pixels; none if there are none."""

    blocks: npt.NDArray[np.float32]  # (segments * BLOCK,) of a segment every c, every 1 / R, ...
    constants: Floats  # (segments,) sum of log p at c


def no_mean_series() -> MeanSeries:
    """The polynomials of no pixels."""
    return MeanSeries(np.empty(0, np.float32), np.empty(0))


# means may be infinite or NaN here
@leaf(fastmath={"contract", "reassoc", "nsz"})
def sum_polynomials(blocks, constants, image, level):
    """The sum of log p over a stretch of segments, and how many pixels are out of range."""
    total, outside = 0.0, 0.0
    for k in range(constants.size):
        total += constants[k]
    for k in range(constants.size):
        b, light = blocks[k * BLOCK : (k + 1) * BLOCK], image[k * SEGMENT : (k + 1) * SEGMENT]
        for i in range(SEGMENT):
            t = (light[i] + level - b[i]) * b[SEGMENT + i]
            outside += 0.0 if t * t <= 1.0 else 1.0
            p = float(b[5 * SEGMENT + i])
            p = p * t + b[4 * SEGMENT + i]
            p = p * t + b[3 * SEGMENT + i]
            p = p * t + b[2 * SEGMENT + i]
            total += p * t
    return total, outside
