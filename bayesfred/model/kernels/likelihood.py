"""The frame and a thread's buffers as the loops need them, and the log-likelihood of an image.

Only pixels that a source reaches are visited one by one: `Workspace.flags` marks them in segments,
and where the background is constant the rest enters through its counts and number alone. The
workspace's image is zero between calls; whoever reads it clears it.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE, log
from bayesfred.imaging.kernels.geometry import SEGMENT, footprints, locate, new_maps

Flags = npt.NDArray[np.uint8]

MASKED = -1e300  # stands for the counts of a pixel outside the likelihood
LIMIT = -1e299

POISSON = 0
GAUSSIAN = 1  # variance equal to the background: the paper's noise


class Counts(NamedTuple):
    """The frame as the loops need it; rows are padded to `stride`, pixels outside the likelihood are MASKED.

    Read noise is in it already: its variance is added to the values here and to the constant
    background on every call.
    """

    values: Floats  # (ny * stride,)
    segment_pixels: Floats  # (ny * stride / SEGMENT,) how many pixels count
    segment_sum: Floats  # of their counts
    segment_squares: Floats
    pixels: float
    total: float
    nx: int
    kind: int
    varies: bool  # whether the background is a polynomial of order > 0


class Workspace(NamedTuple):
    """A thread's buffers."""

    image: Floats  # (ny * stride,), zero between calls
    flags: Flags  # (ny * stride / SEGMENT,) segments that a source reaches
    span: Ints  # (ny, 2) first and last marked segment of a row
    score: Floats  # (ny * stride,) scratch
    weight: Floats
    # what profiling fills anew on every call, kept because new memory costs more than its use
    heap: Floats


@entry()
def new_workspace(o, nuisances, free):
    """Buffers for one thread; with free fluxes they hold the templates as they are without a distortion and a quarter more."""
    ny, pitch = o.ny, o.ramp.size
    span = np.empty((ny, 2), np.int64)
    span[:, 0] = pitch
    span[:, 1] = -1
    size, room = ny * pitch, 0
    if free is not None:
        maps = new_maps(o)
        locate(
            o,
            np.zeros(o.f_powers.shape[0] + o.g_powers.shape[0]),
            0.0,
            0.0,
            nuisances[3],
            6.0 * nuisances[4],
            maps,
        )
        fp = footprints(o, maps)
        room = 3 * size + (5 if nuisances[4] == 0.0 else 15) * fp.start[fp.row.size] // 4
    return Workspace(
        np.zeros(size),
        np.zeros(size // SEGMENT, np.uint8),
        span,
        np.empty(size),
        np.empty(size),
        np.empty(room),
    )


@inner()
def room(w, first, size):
    """A part of the workspace's heap, or new memory where it is too small."""
    return w.heap[first : first + size] if first + size <= w.heap.size else np.empty(size)


@inner()
def mark_sources(fp, w):
    """Mark the segments that the sources' rows of pixels lie in."""
    flags, span, lows, rows, sizes = w.flags, w.span, fp.low, fp.row, fp.size
    per_row = flags.size // span.shape[0]
    pitch = per_row + 1
    change = np.zeros(
        span.shape[0] * pitch, np.int32
    )  # in the number of rows on a segment: two writes for a row of any length
    for i in range(rows.size):
        j, a, b = rows[i], lows[i] // SEGMENT, (lows[i] + sizes[i] - 1) // SEGMENT
        span[j, 0] = min(span[j, 0], a)
        span[j, 1] = max(span[j, 1], b)
        change[j * pitch + a] += 1
        change[j * pitch + b + 1] -= 1
    for j in range(span.shape[0]):
        depth = 0
        for k in range(span[j, 0], span[j, 1] + 1):
            depth += change[j * pitch + k]
            flags[j * per_row + k] = depth > 0


@inner()
def mark_counted(counts, w):
    """Mark every segment with a pixel in the likelihood: a background that varies must be visited everywhere."""
    per_row = w.flags.size // w.span.shape[0]
    for j in range(w.span.shape[0]):
        for k in range(per_row):
            if counts.segment_pixels[j * per_row + k] > 0.0:
                w.flags[j * per_row + k] = 1
                w.span[j, 0] = min(w.span[j, 0], k)
                w.span[j, 1] = max(w.span[j, 1], k)


@inner()
def next_run(flags, span, per_row, j, k):
    """The next marked stretch of row j at or after segment k, as segments [start, stop); start < 0 if there is none."""
    last = span[j, 1]
    base = j * per_row
    while k <= last and flags[base + k] == 0:
        k += 1
    if k > last:
        return -1, -1
    start = k
    while k <= last and flags[base + k] != 0:
        k += 1
    return start, k


@entry()
def clear(w):
    """Make a workspace's image zero again."""
    per_row = w.flags.size // w.span.shape[0]
    for j in range(w.span.shape[0]):
        if w.span[j, 1] >= 0:
            a = j * per_row + w.span[j, 0]
            b = j * per_row + w.span[j, 1] + 1
            w.flags[a:b] = 0
            w.image[a * SEGMENT : b * SEGMENT] = 0.0
            w.span[j, 0] = per_row
            w.span[j, 1] = -1


@inner()
def background_row(background, j, ny):
    """Coefficients of the background polynomial on row j in powers of u; u, v run from -1 to 1 over the frame."""
    v = (2 * j - ny + 1) / ny
    c0 = background[0] + v * (background[2] + v * background[5])
    return c0, background[1] + v * background[4], background[3]


@inner(fastmath=FAST)
def _slope_run(image, u, step, c1, c2, out):
    """The image of a stretch plus the part of the background that varies along it."""
    for i in range(image.size):
        x = u + step * i
        out[i] = image[i] + x * (c1 + x * c2)


@inner(fastmath=REDUCE, error_model="numpy")
def _poisson_run(image, values, level):
    """Sum of n log(mu) - mu over the unmasked pixels of a stretch; MASKED or less if one of these has no positive mu."""
    total = 0.0
    for i in range(image.size):
        mu = image[i] + level
        n = values[i]
        term = (
            n * log(mu) - mu if mu > 0.0 else MASKED
        )  # neither a branch nor a minimum: the loop would not vectorise
        total += term if n > LIMIT else 0.0
    return total


@inner(fastmath=REDUCE)
def _sum(values):
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total


@inner(fastmath=REDUCE, error_model="numpy")
def _square_run(image, values, level):
    """Sum of (n - mu)^2 over the unmasked pixels of a stretch."""
    total = 0.0
    for i in range(image.size):
        d = values[i] - (image[i] + level)
        total += d * d if values[i] > LIMIT else 0.0
    return total


@inner()
def log_likelihood(counts, w, background):
    """Log-likelihood of the workspace's image plus the background; what depends on the counts alone is left out."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    total = 0.0
    pixels, rest = counts.pixels, counts.total
    for j in range(ny):
        c0, c1, c2 = background_row(background, j, ny)
        start, stop = next_run(w.flags, w.span, per_row, j, w.span[j, 0])
        while start >= 0:
            a = (j * per_row + start) * SEGMENT
            b = (j * per_row + stop) * SEGMENT
            image = w.image[a:b]
            if counts.varies:
                image = w.score[a:b]
                u = (2 * start * SEGMENT - counts.nx + 1) / counts.nx
                _slope_run(w.image[a:b], u, 2.0 / counts.nx, c1, c2, image)
            if counts.kind == POISSON:
                total += _poisson_run(image, counts.values[a:b], c0)
            else:
                total += _square_run(image, counts.values[a:b], c0)
            pixels -= _sum(counts.segment_pixels[j * per_row + start : j * per_row + stop])
            rest -= _sum(counts.segment_sum[j * per_row + start : j * per_row + stop])
            start, stop = next_run(w.flags, w.span, per_row, j, stop)
    level = background[0]
    if (
        counts.kind == GAUSSIAN
    ):  # afresh: what is left of the totals would have lost its digits to bright sources
        pixels, rest, squares = 0.0, 0.0, 0.0
        for k in range(w.flags.size):
            if w.flags[k] == 0:
                pixels += counts.segment_pixels[k]
                rest += counts.segment_sum[k]
                squares += counts.segment_squares[k]
    if total < LIMIT or (level <= 0.0 and (pixels > 0.0 or counts.kind == GAUSSIAN)):
        return -math.inf
    if counts.kind == GAUSSIAN:
        total += squares - 2.0 * level * rest + level * level * pixels
        return -0.5 * total / level - 0.5 * counts.pixels * math.log(2.0 * math.pi * level)
    if pixels > 0.0:
        total += rest * math.log(level) - pixels * level
    return total
