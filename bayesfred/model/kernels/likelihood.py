"""The log-likelihood of an image, and the score and weight of its pixels.

Only pixels that a source reaches are visited one by one: `Workspace.flags` marks them in segments,
and where the background is constant the noise model may sum up the rest. The workspace's image is
zero between calls; the reader clears it.
"""

import math
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner, leaf, shared
from bayesfred.imaging.kernels.contexts import LANES, SEGMENT, Optics, SourceNuisances
from bayesfred.imaging.kernels.fastmath import FAST, wide_vectors
from bayesfred.imaging.kernels.geometry import find_footprints, locate, new_geometry
from bayesfred.model.kernels.contexts import (
    BACKGROUND_POWERS,
    LIMIT,
    STRETCH,
    Unreached,
    Workspace,
)
from bayesfred.model.kernels.noise_dispatch import derivatives, given, summed, unreached

LEAST = 1e-200  # weight of a pixel that tells anything
U = np.uint64  # an index that has no sign need not be compared with zero


# Coefficients of the background on a row of pixels, in powers of u, which runs from -1 to 1.
BackgroundRow: TypeAlias = tuple[float, float, float, float, float]


class Stretch(NamedTuple):
    """Pixels of a row: from pixel `first` of the padded frame on."""

    values: Floats
    image: Floats
    first: int
    row: BackgroundRow  # at x = u + step i
    u: float
    step: float


def new_workspace(o: Optics, nuisances: SourceNuisances, free: Literal[True] | None) -> Workspace:
    """Buffers for one thread.

    With free fluxes they hold the templates as they are without a distortion and a quarter more.
    With fixed ones nothing needs score and weight at once, which then share their memory.
    """
    ny, pitch = o.ny, o.ramp.size
    span = np.tile(np.array([pitch, -1]), (ny, 1))
    size, more = ny * pitch, 0
    if free is not None:
        samples = count_samples(o, nuisances)
        more = size + (5 if nuisances.position_scatter == 0.0 else 15) * samples // 4
    flags = np.zeros(size // SEGMENT, np.uint8)
    image, score, heap = map(_aligned, (size, size, more))
    weight, ratio = (score, _aligned(0)) if free is None else map(_aligned, (size, size))
    scratch = _aligned(4 * STRETCH).reshape(4, STRETCH)
    one, two, three, four = map(_aligned, (size,) * 4)
    return Workspace(
        image, flags, span, score, weight, ratio, heap, scratch, (one, two, three, four)
    )


def _aligned(size: int) -> Floats:
    """Zeros that begin where a line of the caches does, which spares the loops a tenth."""
    room = np.zeros(size + 8)
    first = -room.ctypes.data % 64 // 8
    return room[first : first + size]


@entry()
def count_samples(o, nuisances):
    """How many pixels all sources reach without a distortion, each source's counted by itself."""
    geometry = new_geometry(o)
    locate(o, np.zeros(o.f_powers.shape[0] + o.g_powers.shape[0]), nuisances, geometry)
    return find_footprints(o, geometry).start[-1]


@inner()
def room(w, first, size):
    """A part of the workspace's heap, or new memory where it is too small."""
    return w.heap[first : first + size] if first + size <= w.heap.size else np.empty(size)


@inner()
def counted(frame, o, geometry):
    """The sources' footprints, without pixels at the ends of their rows that are masked."""
    fp = find_footprints(o, geometry)
    if frame.pixels < o.ny * o.nx:
        _trim(frame.values, o, geometry.peak, fp)
    return fp


@shared()
def _trim(values, o, peaks, fp):
    """Shorten the footprints' rows to the pixels that count.

    A source whose middle is masked keeps all: how much of it is seen tells where the search for its
    flux begins. A source's rows follow each other, so those that do not count stay between others.
    """
    pitch, start = values.size // o.ny, 0
    for s in range(peaks.shape[0]):
        j = round(peaks[s, 1] / o.step + 0.5 * (o.ny - 1))
        i = round(peaks[s, 0] / o.step + 0.5 * (o.nx - 1))
        inside = 0 <= j < o.ny and 0 <= i < o.nx and values[j * pitch + i] > LIMIT
        for p in range(fp.first[s], fp.first[s + 1]):
            low, size = fp.low[p], fp.size[p]
            a, b = fp.row[p] * pitch + low, fp.row[p] * pitch + low + size
            while inside and a < b and values[a] <= LIMIT:
                a += 1
            while inside and a < b and values[b - 1] <= LIMIT:
                b -= 1
            n = max(-(-(b - a) // LANES), 1) * LANES
            fp.low[p] = min(a - fp.row[p] * pitch, low + size - n)
            fp.size[p] = n
            fp.start[p] = start
            start += n
    fp.start[fp.row.size] = start


@shared()
def mark(frame, fp, w):
    """Mark the segments that are visited: those that a source reaches, or all that count."""
    _mark_sources(fp, w)
    if frame.everywhere:
        _mark_counted(frame, w)


@inner()
def _mark_sources(fp, w):
    """Mark the segments that the sources' rows of pixels lie in."""
    flags, span, lows, rows, sizes = w.flags, w.span, fp.low, fp.row, fp.size
    per_row = flags.size // span.shape[0]
    pitch = per_row + 1
    # change in the number of rows on a segment: two writes for a row of any length
    change = np.zeros(span.shape[0] * pitch, np.int32)
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


@leaf()
def _mark_counted(frame, w):
    """Mark every segment with a pixel in the likelihood."""
    per_row = w.flags.size // w.span.shape[0]
    for j in range(w.span.shape[0]):
        for k in range(per_row):
            if frame.segment_pixels[j * per_row + k] > 0.0:
                w.flags[j * per_row + k] = 1
                w.span[j, 0] = min(w.span[j, 0], k)
                w.span[j, 1] = max(w.span[j, 1], k)


@leaf()
def next_run(w, j, k):
    """The next marked stretch of row j at or after segment k, as segments [start, stop).

    start < 0 if there is none.
    """
    last = w.span[j, 1]
    base = j * (w.flags.size // w.span.shape[0])
    while k <= last and w.flags[base + k] == 0:
        k += 1
    if k > last:
        return -1, -1
    start = k
    while k <= last and w.flags[base + k] != 0:
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
def blank(w, image):
    """Make the marked segments of an image zero, and return it."""
    for k in range(w.flags.size):
        if w.flags[k] != 0:
            image[k * SEGMENT : (k + 1) * SEGMENT] = 0.0
    return image


@leaf()
def background_row(background, j, ny):
    """The background on row j; its coefficients are in the order of `BACKGROUND_POWERS`."""
    v, k = (2 * j - ny + 1) / ny, background
    constant = k[0] + v * (k[2] + v * (k[5] + v * (k[9] + v * k[14])))
    linear = k[1] + v * (k[4] + v * (k[8] + v * k[13]))
    return constant, linear, k[3] + v * (k[7] + v * k[12]), k[6] + v * k[11], k[10]


@inner(inline="always")
def rise(row, x):
    """By how much the background of a row is higher at x than in its middle."""
    return x * (row[1] + x * (row[2] + x * (row[3] + x * row[4])))


@inner(inline="always")
def stretch(frame, background, j, first, image):
    """The pixels of row j from pixel `first` of the padded frame on, as many as in `image`."""
    low = first - j * (frame.values.size // frame.ny)
    row = background_row(background, j, frame.ny)
    u, step = (2 * low - frame.nx + 1) / frame.nx, 2.0 / frame.nx
    return Stretch(frame.values[first : first + image.size], image, first, row, u, step)


@leaf(fastmath=FAST)
def weigh_run(noise, part, score, weight, ratio):
    """Score d log L/d mu and weight -d^2 log L/d mu^2 of a stretch, zero where masked.

    And, unless `ratio` is None, the ratio of d^3 log L/d mu^3 to twice the weight. Without a
    weight, which may be None, the score alone.
    """
    values, image, first = part.values, part.image, part.first
    row, u, step = part.row, part.u, part.step
    for i in range(values.size):
        mu = image[i] + (row[0] + rise(row, u + step * i))
        counted = values[i] > LIMIT
        s, w, c = derivatives(noise, values[i] if counted else mu, mu, image[i], U(first + i))
        score[i] = s if counted else 0.0
        if weight is not None:
            weight[i] = w if counted else 0.0
        if ratio is not None:
            ratio[i] = c / w if counted and w > LEAST else 0.0


@shared(_nrt=False)
def weigh_rows(frame, noise, w, place, weights, ratios):
    """Score of the marked pixels of rows (first, last + 1), with the background there: `place`.

    And their weights and ratios, each unless it is None.
    """
    background, rows = place
    pitch = frame.values.size // frame.ny
    for j in range(rows[0], rows[1]):
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            a, b = j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT
            part = stretch(frame, background, j, a, w.image[a:b])
            ratio = None if ratios is None else ratios[a:b]
            weight = None if weights is None else weights[a:b]
            weigh_run(noise, part, w.score[a:b], weight, ratio)
            start, stop = next_run(w, j, stop)


@shared(_nrt=False, fastmath=FAST)
def slope_run(part, out):
    """The image of a stretch plus the part of the background that varies along it."""
    for i in range(out.size):
        out[i] = part.image[i] + rise(part.row, part.u + part.step * i)


@leaf()
def add_background_sums(frame, w, image, out):
    """Add the sums of the image times the background's terms over the marked pixels."""
    pitch = frame.values.size // frame.ny
    for j in range(frame.ny):
        zero, one, two, three, four = 0.0, 0.0, 0.0, 0.0, 0.0  # times powers of u
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                if frame.values[p] > LIMIT:
                    u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                    square = u * u
                    zero += image[p]
                    one += image[p] * u
                    two += image[p] * square
                    three += image[p] * (square * u)
                    four += image[p] * (square * square)
            start, stop = next_run(w, j, stop)
        v, sums = (2 * j - frame.ny + 1) / frame.ny, (zero, one, two, three, four)
        for k in range(out.size):
            m, n = BACKGROUND_POWERS[k]
            out[k] += sums[m] * v**n


@leaf()
def _count_unreached(frame, w):
    """How many pixels no source reaches, and the sum of their counts."""
    per_row = w.flags.size // frame.ny
    pixels, counts = frame.pixels, frame.total
    for j in range(frame.ny):
        for k in range(j * per_row + w.span[j, 0], j * per_row + w.span[j, 1] + 1):
            if w.flags[k] != 0:
                pixels -= frame.segment_pixels[k]
                counts -= frame.segment_sum[k]
    return pixels, counts


@inner()
def unreached_pixels(frame, w):
    """The pixels that no source reaches."""
    pixels, counts = _count_unreached(frame, w)
    return Unreached(pixels, counts, w.flags)


@shared()
def log_likelihood(frame, w, parameters):
    """Log-likelihood of the workspace's image plus the background.

    What depends on the counts alone is left out.
    """
    noise, background = given(frame.noise, parameters), parameters.background
    rest, _, _ = unreached(noise, unreached_pixels(frame, w), background[0])
    total = rest + _sum_marked(frame, noise, w, background)
    return -math.inf if total < LIMIT else total


@leaf()
def _sum_marked(frame, noise, w, background):
    """Sum of the log-densities of the marked pixels."""
    wide_vectors()
    pitch, total = frame.values.size // frame.ny, 0.0
    for j in range(frame.ny):
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            a, b = j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT
            light = w.image[a:b]
            level, image = background[0], light
            if frame.varies:
                part = stretch(frame, background, j, a, light)
                level, image = part.row[0], w.score[a:b]
                slope_run(part, image)
            mean = (image, level, None)
            total += summed(noise, frame.values[a:b], light, mean, (a, w.scratch))
            start, stop = next_run(w, j, stop)
    return total
