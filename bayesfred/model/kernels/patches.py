"""The pixels of a cluster, one after another: on every row all that its footprints span."""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import leaf, shared
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.model.kernels.contexts import LIMIT
from bayesfred.model.kernels.likelihood import rise, room, stretch, weigh_run


class Patch(NamedTuple):
    """A cluster's pixels; its rows follow each other in the frame, the first being `top`."""

    top: int
    first: Ints  # (rows,) where a row begins in the padded frame
    start: Ints  # (rows + 1,) and here
    image: Floats
    score: Floats
    weight: Floats
    ratio: Floats


@shared()
def new_patch(w, touching, group, at):
    """A cluster's pixels without sources; where its footprints' rows begin goes into `at`."""
    fp, boxes, members = touching.footprints, touching.boxes, group.members
    pitch = w.image.size // w.span.shape[0]
    top, bottom = boxes[members[0], 0], 0
    for s in members:
        bottom = max(bottom, boxes[s, 1])
    rows = max(bottom - top, 0)
    low, high = np.full(rows, pitch), np.zeros(rows, np.int64)
    for s in members:
        for i in range(fp.first[s], fp.first[s + 1]):
            j = fp.row[i] - top
            low[j] = min(low[j], fp.low[i])
            high[j] = max(high[j], fp.low[i] + fp.size[i])
    start = np.zeros(rows + 1, np.int64)
    for j in range(rows):
        start[j + 1] = start[j] + max(high[j] - low[j], 0)
    for s in members:
        for i in range(fp.first[s], fp.first[s + 1]):
            j = fp.row[i] - top
            at[i] = start[j] + fp.low[i] - low[j]
    for j in range(rows):
        low[j] += (top + j) * pitch
    size = start[rows]
    image = room(w, 0, size)
    image[:] = 0.0
    return Patch(top, low, start, image, w.score[:size], w.weight[:size], w.ratio[:size])


@shared(_nrt=False)
def weigh_patch(frame, noise, background, patch, rows, ratios):
    """Score and weight of rows of a patch; their ratios into `ratios` unless it is None."""
    for j in range(rows[0], rows[1]):
        a, b = patch.start[j], patch.start[j + 1]
        part = stretch(frame, background, patch.top + j, patch.first[j], patch.image[a:b])
        ratio = None if ratios is None else ratios[a:b]
        weigh_run(noise, part, patch.score[a:b], patch.weight[a:b], ratio)


@leaf(fastmath=FAST)
def _excess_run(part, score, weight):
    for i in range(score.size):
        counted = part.values[i] > LIMIT
        above = part.values[i] - (part.row[0] + rise(part.row, part.u + part.step * i))
        score[i], weight[i] = above if counted else 0.0, 1.0 if counted else 0.0


@leaf()
def fill_excess(frame, background, patch):
    """Counts less background in place of the score, and a weight of 1; both zero where masked."""
    for j in range(patch.first.size):
        a, b = patch.start[j], patch.start[j + 1]
        part = stretch(frame, background, patch.top + j, patch.first[j], patch.image[a:b])
        _excess_run(part, patch.score[a:b], patch.weight[a:b])


@shared(_nrt=False, fastmath=FAST)
def add_patch(patch, image):
    """Add a patch's image to that of the frame."""
    for j in range(patch.first.size):
        a, b, first = patch.start[j], patch.start[j + 1], patch.first[j]
        for k in range(b - a):
            image[first + k] += patch.image[a + k]
