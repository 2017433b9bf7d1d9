"""Clusters of touching footprints, and what their matrices consist of.

The matrix H of `fluxes.py` couples only sources whose footprints share pixels, so everything is
done cluster by cluster.
"""

from typing import NamedTuple

import numpy as np

from bayesfred.imaging.kernels.compilation import inner, leaf, shared
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.model.kernels.contexts import Clusters, Group
from bayesfred.model.kernels.factors import inner_product

DOF = 3.0  # of Student's distribution of the shifts
SHARE = DOF / (DOF + 2.0)  # of k in H, see `fluxes.py`


class Prior(NamedTuple):
    """The prior of a source's flux and shift."""

    shape: float  # of the Gamma distribution of the flux
    scatter: float  # tau; 0 where positions do not scatter


@shared()
def bounding_boxes(fp):
    """First row, last row + 1, first column, last column + 1 of every footprint."""
    size = fp.first.size - 1
    boxes = np.zeros((size, 4), np.int64)
    for s in range(size):
        a, b = fp.first[s], fp.first[s + 1]
        if b > a:
            boxes[s, 0], boxes[s, 1], boxes[s, 2] = fp.row[a], fp.row[b - 1] + 1, fp.low[a]
            for i in range(a, b):
                boxes[s, 2] = min(boxes[s, 2], fp.low[i])
                boxes[s, 3] = max(boxes[s, 3], fp.low[i] + fp.size[i])
    return boxes


@inner()
def _group(keys, size):
    """Indices in the order of their keys < size, and where each key's begin among them."""
    first = np.zeros(size + 2, np.int64)
    for i in range(keys.size):
        first[keys[i] + 2] += 1
    for k in range(size):
        first[k + 1] += first[k]
    order = np.empty(keys.size, np.int64)
    # after which first[k + 1] has moved from the beginning of key k to its end
    for i in range(keys.size):
        order[first[keys[i] + 1]] = i
        first[keys[i] + 1] += 1
    return order, first[:-1]


@shared()
def find_clusters(boxes, ny, templates):
    """Groups of sources connected by overlapping boxes: union-find along a sweep over the rows."""
    size = boxes.shape[0]
    parent, earliest = np.arange(size), np.arange(size)
    order = _group(boxes[:, 0], ny)[0]
    for i in range(size):
        s = order[i]
        for k in range(i + 1, size):
            t = order[k]
            if boxes[t, 0] >= boxes[s, 1]:
                break
            if boxes[t, 2] < boxes[s, 3] and boxes[s, 2] < boxes[t, 3]:
                earliest[k] = min(earliest[k], i)
                p, q = s, t
                while parent[p] != p:
                    parent[p] = parent[parent[p]]
                    p = parent[p]
                while parent[q] != q:
                    parent[q] = parent[parent[q]]
                    q = parent[q]
                parent[max(p, q)] = min(p, q)
    label = np.empty(size, np.int64)
    groups = 0
    for s in range(size):  # a root is the smallest of its group, so it is labelled first
        p = s
        while parent[p] != p:
            p = parent[p]
        if p == s:
            label[s] = groups
            groups += 1
        else:
            label[s] = label[p]
    place, first = _group(label[order], groups)
    within = np.empty(size, np.int64)  # how many of a group come before each in the order
    for c in range(groups):
        for i in range(first[c], first[c + 1]):
            within[place[i]] = i - first[c]
    lead, start = np.empty(size * templates, np.int64), np.empty(size * templates, np.int64)
    begin = np.zeros(groups + 1, np.int64)
    for c in range(groups):
        total = 0
        for i in range(first[c], first[c + 1]):
            column = within[earliest[place[i]]] * templates
            for t in range(templates):
                row = i * templates + t
                lead[row] = column
                start[row] = total - column
                total += (i - first[c]) * templates + t + 1 - column
        begin[c + 1] = begin[c] + total
    return Clusters(order[place], first, lead, start, begin)


@inner()
def one_cluster(clusters, c, templates):
    """Group c."""
    a, b = clusters.first[c], clusters.first[c + 1]
    rows = slice(a * templates, b * templates)
    return Group(clusters.members[a:b], clusters.lead[rows], clusters.start[rows])


@leaf()
def touch(boxes, s, t):
    """Whether two footprints may share pixels."""
    apart = (
        boxes[t, 2] >= boxes[s, 3]
        or boxes[s, 2] >= boxes[t, 3]
        or boxes[t, 0] >= boxes[s, 1]
        or boxes[s, 0] >= boxes[t, 1]
    )
    return not apart


@leaf()
def run_end(fp, i, last, at):
    """The first of a source's rows after row i, before `last`, that does not continue the others.

    A row continues the one before if it follows it both in its template and in an image.
    """
    i += 1
    while i < last and at[i] == at[i - 1] + fp.size[i - 1]:
        i += 1
    return i


@leaf(fastmath=REDUCE)
def dot(a, b, weight):
    """The sum of weight a b."""
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i] * weight[i]
    return total


@leaf()
def copy(values, out):
    """Copy a row of numbers, which numba's own assignment would not compile in less than 4 s."""
    for i in range(values.size):
        out[i] = values[i]


@leaf()
def add_overlap(touching, pair, weight, at, rows, block):
    """block[m, n] += sum over the pixels that sources s and t share of weight T_sm T_tn.

    Of rows first, first + step, ... of the frame, up to but for last.
    """
    fp, boxes, stamps = touching.footprints, touching.boxes, touching.stamps
    (s, t), (first, last, step) = pair, rows
    for j in range(first, last, step):
        p = fp.first[s] + j - boxes[s, 0]
        q = fp.first[t] + j - boxes[t, 0]
        a = max(fp.low[p], fp.low[q])
        b = min(fp.low[p] + fp.size[p], fp.low[q] + fp.size[q])
        if a < b:
            ps, qs = fp.start[p] - fp.low[p], fp.start[q] - fp.low[q]
            part = weight[at[p] - fp.low[p] + a : at[p] - fp.low[p] + b]
            for m in range(stamps.shape[0]):
                left = stamps[m, ps + a : ps + b]
                for n in range(stamps.shape[0]):
                    block[m, n] += dot(left, stamps[n, qs + a : qs + b], part)


@leaf()
def shared_rows(touching, s, t):
    """The first row that two footprints share, and the one after the last."""
    boxes = touching.boxes
    return max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])


@shared()
def gram(touching, group, weight, at, out):
    """out[i, k] = sum over pixels of weight T_i T_k, the lower triangle.

    A source's templates follow each other. Row r of the footprints has its weights from
    weight[at[r]] on.
    """
    fp, stamps, members, start = touching.footprints, touching.stamps, group.members, group.start
    size = stamps.shape[0]
    block = np.empty((size, size))
    for i in range(members.size):
        s = members[i]
        for m in range(size):
            row = i * size + m
            out[start[row] + group.lead[row] : start[row] + row + 1] = 0.0
        p = fp.first[s]
        while p < fp.first[s + 1]:
            end = run_end(fp, p, fp.first[s + 1], at)
            first, last = fp.start[p], fp.start[end]
            for m in range(size):
                for n in range(m + 1):
                    part = weight[at[p] : at[p] + last - first]
                    out[start[i * size + m] + i * size + n] += dot(
                        stamps[m, first:last], stamps[n, first:last], part
                    )
            p = end
        for k in range(group.lead[i * size] // size, i):
            if touch(touching.boxes, s, members[k]):
                block[:] = 0.0
                first, last = shared_rows(touching, s, members[k])
                add_overlap(touching, (s, members[k]), weight, at, (first, last, 1), block)
                for m in range(size):
                    row = start[i * size + m] + k * size
                    copy(block[m], out[row : row + size])


@leaf()
def shift_prior(shift, scatter):
    """Rho and k of a source's shift, see `fluxes.py`."""
    ratio = (shift[0] ** 2 + shift[1] ** 2) / (DOF * scatter**2)
    return ratio, (DOF + 2.0) / (DOF * scatter**2 * (1.0 + ratio))


@leaf()
def bend_prior(shift, scatter):
    """What -d^2 log p of a shift has beyond its share in H: dx dx, dx dy and dy dy."""
    ratio, k = shift_prior(shift, scatter)
    c, more = -2.0 * k / (DOF * scatter**2 * (1.0 + ratio)), (1.0 - SHARE) * k
    return more + c * shift[0] ** 2, c * shift[0] * shift[1], more + c * shift[1] ** 2


@shared(_nrt=False)
def add_prior(h, group, prior, fluxes, shifts, share):
    """Add the priors' curvature to H: a/F^2 for a flux, a share of k for a shift."""
    size = 3 if prior.scatter > 0.0 else 1
    for i in range(group.lead.size):
        s = group.members[i // size]
        if i % size == 0:
            h[group.start[i] + i] += prior.shape / fluxes[s] ** 2
        else:
            h[group.start[i] + i] += share * shift_prior(shifts[s], prior.scatter)[1]


@leaf()
def add_block(i, start, out, block):
    """Add second derivatives to a source's own block of a matrix.

    The block is (F F, F dx, F dy, dx dx, dx dy, dy dy).
    """
    row, column = start[3 * i : 3 * i + 3], 3 * i
    out[row[0] + column] += block[0]
    out[row[1] + column] += block[1]
    out[row[2] + column] += block[2]
    out[row[1] + column + 1] += block[3]
    out[row[2] + column + 1] += block[4]
    out[row[2] + column + 2] += block[5]


@leaf()
def add_template(fp, rows, template, amplitude, canvas):
    """Add amplitude times rows of one of a source's templates, shape (samples,), to a canvas."""
    at, out, i = canvas.at, canvas.image, rows[0]
    while i < rows[1]:
        end = run_end(fp, i, rows[1], at)
        stamp = template[fp.start[i] : fp.start[end]]
        target = out[at[i] : at[i] + stamp.size]
        for k in range(stamp.size):
            target[k] += amplitude * stamp[k]
        i = end


@leaf()
def project(fp, s, template, image, at):
    """Sum over a source's pixels of one of its templates times an image."""
    total = 0.0
    i = fp.first[s]
    while i < fp.first[s + 1]:
        end = run_end(fp, i, fp.first[s + 1], at)
        stamp = template[fp.start[i] : fp.start[end]]
        total += inner_product(stamp, image[at[i] : at[i] + stamp.size])
        i = end
    return total
