"""Which pixels see which sources where in the PSF: the samples that a PSF is measured on."""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.polynomials import evaluate

LARGEST_SCALE = 1.25  # a window is so much larger than the PSF, for images that are magnified


class SourceSamples(NamedTuple):
    """Pairs of sources and pixels, sorted by pixel."""

    first: Ints  # (pixels + 1,) samples of pixel i are those from first[i] to first[i + 1]
    source: Ints  # (samples,)
    a: Floats  # (samples,) pixel, from the middle of the source's image
    b: Floats
    size: Floats  # (samples,) |D|, or 1 where flux is not conserved


@inner()
def _window(place, half, size):
    """First and last pixel, and the one after, along an axis of `size` pixels."""
    nearest = np.int64(np.rint(place + 0.5 * (size - 1)))
    return max(0, nearest - half), min(size, nearest + half + 1)


@entry()
def find_samples(maps, imaged, shifts, mask, radius, conserve):
    """All pairs of a source and a pixel in `mask` within a radius of its image in (a, b).

    `maps` are a and b of the sources in powers of u and v, shape (s, n, n), and `imaged` is where
    their images are, shape (s, 2), NaN for none. Returns where the samples of every pixel begin,
    the pixels that have any, and the last four fields of `SourceSamples`.
    """
    (a, b), (ny, nx) = maps, mask.shape
    half = np.int64(np.ceil(LARGEST_SCALE * radius))
    at, degree = np.zeros(ny * nx + 1, np.int64), a[0, 0, 1:]
    size = 0
    source, samples = np.empty(0, np.int64), np.empty((3, 0))
    for counting in (True, False):
        if not counting:
            size = at.sum()
            source, samples = np.empty(size, np.int64), np.empty((3, size))
            at = np.cumsum(at)
        for s in range(imaged.shape[0]):
            if not (abs(imaged[s, 0]) < nx + ny and abs(imaged[s, 1]) < nx + ny):
                continue
            left, right = _window(imaged[s, 0], half, nx)
            low, high = _window(imaged[s, 1], half, ny)
            for j in range(low, high):
                for i in range(left, right):
                    if not mask[j, i]:
                        continue
                    u, v = i - 0.5 * (nx - 1), j - 0.5 * (ny - 1)
                    if (u - imaged[s, 0]) ** 2 + (v - imaged[s, 1]) ** 2 > half**2:
                        continue
                    own_a, a_u, a_v = evaluate(a[s], u, v, degree)
                    own_b, b_u, b_v = evaluate(b[s], u, v, degree)
                    own_a, own_b = own_a - shifts[s, 0], own_b - shifts[s, 1]
                    if own_a**2 + own_b**2 > radius**2:
                        continue
                    if counting:
                        at[j * nx + i + 1] += 1
                    else:
                        n = at[j * nx + i]
                        source[n], samples[0, n], samples[1, n] = s, own_a, own_b
                        samples[2, n] = abs(a_u * b_v - a_v * b_u) if conserve else 1.0
                        at[j * nx + i] += 1
    # every pixel's beginning has moved to its end
    seen = np.empty(ny * nx, np.int64)
    first, number, before = np.zeros(ny * nx + 1, np.int64), 0, 0
    for k in range(ny * nx):
        if at[k] > before:
            seen[number], first[number + 1] = k, at[k]
            number += 1
            before = at[k]
    return first[: number + 1], seen[:number], (source, samples[0], samples[1], samples[2])
