"""Compiled loops over counts: log-likelihood, its exact gradient, Fisher information, profiled fluxes.

Only pixels that a source reaches are visited one by one: `Workspace.flags` marks them in segments, and where the
background is constant the rest enters through its counts and number alone. The workspace's image is zero between
calls; whoever reads it clears it.

Free fluxes. Given everything else the expected counts mu = B + sum_s F_s K_s are linear in the fluxes F, and with the
prior F_s ~ Gamma(2, scale c_s/2) the log-posterior in F is concave: a sum of n log(mu), log(F) and linear terms. Along a
Newton step let d be the largest relative change of any of these mu and F. A fraction t < 1/d of the step raises the second
derivative by no more than 1/(1 - t d)^2, so the gain is largest, for certain, at t = 1/(1 + d): mu and F stay positive,
the iteration climbs from any start, and converges quadratically as d vanishes. With H minus the Hessian at the maximum,

    log L(theta) = max_F [log L(theta, F) + log p(F)] + n_s/2 log(2 pi) - 1/2 log det H          (Laplace)

H couples only sources whose footprints share pixels, so everything is done cluster by cluster of touching footprints.

Gradient of the Laplace term. Per pixel let r = n/mu - 1, W = n/mu^2, C = n/mu^3, and for sources s, t let
Q = H^-1, q_s = sum_t Q_st K_t, h = sum_s K_s q_s. Because dW = -2 C dmu and the maximising F moves by
dF = Q d(dL/dF), the chain rule gives for any parameter, with z = Q (sum_p C h K + Q_tt / F_t^3) and y = sum_t z_t K_t,

    d log L = sum_p A dB + sum_s sum_p c_s dK_s,   A = r + C h - W y,   c_s = F_s A + z_s r - W q_s.

The 1/F_t^3 is the prior's share: it adds 1/F_t^2 to H. With fixed fluxes A = r and c_s = F_s r.

Free positions. Where the catalogue's positions scatter, every source has three free numbers phi = (F, dx, dy), the shifts dx
and dy of a and b having the prior N(0, tau^2), and three templates T = d mu/d phi: K, F X and F Y with X = dK/d dx, Y = dK/d dy,
made anew as the source moves. H = sum_p W T T^T + diag(1/F^2, 1/tau^2, 1/tau^2) leaves out the second derivatives, which it
weighs with residuals of mean zero; that makes it positive definite anywhere. What is said above then holds with Q = H^-1,
q_t = sum_u Q_tu T_u, h = sum_t T_t q_t, y = sum_t z_t T_t, and z = G^-1 e, where G is H with the second derivatives and e is what
moving phi does to -1/2 log det H:

    e_F = sum_p [C h K - W (q_1 X + q_2 Y)] + Q_00/F^3,    e_dx = sum_p [C h F X - W (q_0 X + q_1 F K_xx + q_2 F K_xy)],

e_dy likewise. Every source gives d log L the terms c_0 dK + c_1 dX + c_2 dY,

    c_0 = F A + z_0 r - W q_0,   c_1 = F (z_1 r - W q_1),   c_2 = F (z_2 r - W q_2),

and d log L/d tau = sum_s [(dx^2 + dy^2 + Q_11 + Q_22 + 2 z_1 dx + 2 z_2 dy)/tau^3 - 2/tau].
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt

from bayesfred.imaging._kernels import (
    FAST,
    REDUCE,
    SEGMENT,
    Basis,
    Floats,
    Footprints,
    Ints,
    Maps,
    add_jacobian_rows,
    add_source,
    add_templates,
    basis_row,
    footprints,
    inner,
    locate,
    log,
    move,
    new_maps,
    new_work,
    row_starts,
)

Flags = npt.NDArray[np.uint8]

MASKED = -1e300  # stands for the counts of a pixel outside the likelihood
LIMIT = -1e299

POISSON = 0
GAUSSIAN = 1  # variance equal to the background: the paper's noise


class Counts(NamedTuple):
    """The frame as the loops need it; rows are padded to `stride`, pixels outside the likelihood are MASKED.

    Read noise is in it already: its variance is added to the values here and to the constant background on every call.
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
    heap: Floats  # what profiling fills anew on every call, kept because new memory costs more than its use


class Clusters(NamedTuple):
    """Groups of sources whose footprints share pixels: group c holds members[first[c]:first[c + 1]], from top to bottom.

    A group's symmetric matrices, a row for each template of each member, are stored row after row from the first member that
    shares pixels with the row's own up to the diagonal. What is left out stays zero in Cholesky's factor.
    """

    members: Ints
    first: Ints
    lead: Ints  # column at which a row's storage begins, counted within the group
    start: Ints  # where a row's column 0 would be in the group's storage
    begin: Ints  # where the group's storage begins in a flat array


@nb.njit(cache=True)
def new_workspace(o, nuisances, free):
    """Buffers for one thread; with free fluxes they hold the templates as they are without a distortion and a quarter more."""
    ny, pitch = o.ny, o.ramp.size
    span = np.empty((ny, 2), np.int64)
    span[:, 0] = pitch
    span[:, 1] = -1
    size, room = ny * pitch, 0
    if free:
        maps = new_maps(o)
        locate(o, np.zeros(o.f_powers.shape[0] + o.g_powers.shape[0]), 0.0, 0.0, nuisances[3], 6.0 * nuisances[4], maps)
        fp = footprints(o, maps)
        room = 3 * size + (5 if nuisances[4] == 0.0 else 15) * fp.start[fp.row.size] // 4
    return Workspace(np.zeros(size), np.zeros(size // SEGMENT, np.uint8), span, np.empty(size), np.empty(size), np.empty(room))


@inner(cache=True)
def _mark_sources(fp, w):
    """Mark the segments that the sources' rows of pixels lie in."""
    flags, span, lows, rows, sizes = w.flags, w.span, fp.low, fp.row, fp.size
    per_row = flags.size // span.shape[0]
    pitch = per_row + 1
    change = np.zeros(span.shape[0] * pitch, np.int32)  # in the number of rows on a segment: two writes for a row of any length
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


@inner(cache=True)
def _mark_counted(counts, w):
    """Mark every segment with a pixel in the likelihood: a background that varies must be visited everywhere."""
    per_row = w.flags.size // w.span.shape[0]
    for j in range(w.span.shape[0]):
        for k in range(per_row):
            if counts.segment_pixels[j * per_row + k] > 0.0:
                w.flags[j * per_row + k] = 1
                w.span[j, 0] = min(w.span[j, 0], k)
                w.span[j, 1] = max(w.span[j, 1], k)


@inner(cache=True)
def _next_run(flags, span, per_row, j, k):
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


@nb.njit(cache=True)
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


@inner(cache=True)
def _background_row(background, j, ny):
    """Coefficients of the background polynomial on row j in powers of u; u, v run from -1 to 1 over the frame."""
    v = (2 * j - ny + 1) / ny
    c0 = background[0] + v * (background[2] + v * background[5])
    return c0, background[1] + v * background[4], background[3]


@inner(cache=True, fastmath=FAST)
def _slope_run(image, u, step, c1, c2, out):
    """The image of a stretch plus the part of the background that varies along it."""
    for i in range(image.size):
        x = u + step * i
        out[i] = image[i] + x * (c1 + x * c2)


@inner(cache=True, fastmath=REDUCE, error_model="numpy")
def _poisson_run(image, values, level):
    """Sum of n log(mu) - mu over the unmasked pixels of a stretch; MASKED or less if one of these has no positive mu."""
    total = 0.0
    for i in range(image.size):
        mu = image[i] + level
        n = values[i]
        term = n * log(mu) - mu if mu > 0.0 else MASKED  # neither a branch nor a minimum: the loop would not vectorise
        total += term if n > LIMIT else 0.0
    return total


@inner(cache=True, fastmath=REDUCE)
def _sum(values):
    total = 0.0
    for i in range(values.size):
        total += values[i]
    return total


@inner(cache=True, fastmath=REDUCE, error_model="numpy")
def _square_run(image, values, level):
    """Sum of (n - mu)^2 over the unmasked pixels of a stretch."""
    total = 0.0
    for i in range(image.size):
        d = values[i] - (image[i] + level)
        total += d * d if values[i] > LIMIT else 0.0
    return total


@inner(cache=True)
def _log_likelihood(counts, w, background):
    """Log-likelihood of the workspace's image plus the background; what depends on the counts alone is left out."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    total = 0.0
    pixels, rest = counts.pixels, counts.total
    for j in range(ny):
        c0, c1, c2 = _background_row(background, j, ny)
        start, stop = _next_run(w.flags, w.span, per_row, j, w.span[j, 0])
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
            start, stop = _next_run(w.flags, w.span, per_row, j, stop)
    level = background[0]
    if counts.kind == GAUSSIAN:  # afresh: what is left of the totals would have lost its digits to bright sources
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


class Rows(NamedTuple):
    """Buffers for a row of a basis."""

    out: Floats
    samples: Floats
    powers: Floats
    work: Floats


@inner(cache=True)
def _new_rows(o, basis, width):
    rows = np.empty((basis.f.shape[0] + basis.g.shape[0] + 2, width))
    return Rows(rows, np.empty((9, width)), np.empty((len(o.degree) + 1, width)), new_work(o))


@inner(cache=True)
def _constants():
    """The basis of the monomial 1: its rows are -dT/d dx, -dT/d dy, T and dT/dsigma of a template T."""
    one = np.zeros((1, 2), np.int64)
    return Basis(one, one, np.empty(0, np.int64), np.empty((0, 0)))


@inner(cache=True)
def _make_templates(o, maps, fp, s, sigma, flux, stamps, work):
    """Fill the rows of source s in the templates `stamps`, shape (3, samples)."""
    stamps[:, fp.start[fp.first[s]] : fp.start[fp.first[s + 1]]] = 0.0
    add_templates(o, maps, fp, s, sigma, flux, stamps[0], stamps[1], stamps[2], work)


@inner(cache=True)
def _boxes(fp):
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


@inner(cache=True)
def _group(keys, size):
    """Indices in the order of their keys, which are less than size, and where each key's begin among them."""
    first = np.zeros(size + 2, np.int64)
    for i in range(keys.size):
        first[keys[i] + 2] += 1
    for k in range(size):
        first[k + 1] += first[k]
    order = np.empty(keys.size, np.int64)
    for i in range(keys.size):  # after which first[k + 1] has moved from the beginning of key k to its end
        order[first[keys[i] + 1]] = i
        first[keys[i] + 1] += 1
    return order, first[:-1]


@inner(cache=True)
def _clusters(boxes, ny, templates):
    """Groups of sources connected by overlapping boxes: union-find along a sweep over the rows."""
    size = boxes.shape[0]
    parent, reach = np.arange(size), np.arange(size)
    order = _group(boxes[:, 0], ny)[0]
    for i in range(size):
        s = order[i]
        for k in range(i + 1, size):
            t = order[k]
            if boxes[t, 0] >= boxes[s, 1]:
                break
            if boxes[t, 2] < boxes[s, 3] and boxes[s, 2] < boxes[t, 3]:
                reach[k] = min(reach[k], i)
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
    lead, start, begin = np.empty(size * templates, np.int64), np.empty(size * templates, np.int64), np.zeros(groups + 1, np.int64)
    for c in range(groups):
        total = 0
        for i in range(first[c], first[c + 1]):
            column = within[reach[place[i]]] * templates
            for t in range(templates):
                row = i * templates + t
                lead[row] = column
                start[row] = total - column
                total += (i - first[c]) * templates + t + 1 - column
        begin[c + 1] = begin[c] + total
    return Clusters(order[place], first, lead, start, begin)


@inner(cache=True)
def _cluster(clusters, c, templates):
    """A group's members, and lead and start of its rows."""
    a, b = clusters.first[c], clusters.first[c + 1]
    rows = slice(a * templates, b * templates)
    return clusters.members[a:b], clusters.lead[rows], clusters.start[rows]


@inner(cache=True, fastmath=REDUCE, error_model="numpy")
def _dot(a, b, weight):
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i] * weight[i]
    return total


@inner(cache=True)
def _touch(boxes, s, t):
    """Whether two footprints may share pixels."""
    apart = boxes[t, 2] >= boxes[s, 3] or boxes[s, 2] >= boxes[t, 3] or boxes[t, 0] >= boxes[s, 1] or boxes[s, 0] >= boxes[t, 1]
    return not apart


@inner(cache=True)
def _gram(fp, boxes, members, lead, start, stamps, weight, at, out):
    """out[i, k] = sum over pixels of weight T_i T_k, the lower triangle; a source's templates follow each other.

    Row r of the footprints has its weights from weight[at[r]] on.
    """
    size = stamps.shape[0]
    for i in range(members.size):
        s = members[i]
        for m in range(size):
            row = i * size + m
            out[start[row] + lead[row] : start[row] + row + 1] = 0.0
        p = fp.first[s]
        while p < fp.first[s + 1]:
            end = _run(fp, s, p, at)
            first, last = fp.start[p], fp.start[end]
            for m in range(size):
                for n in range(m + 1):
                    part = weight[at[p] : at[p] + last - first]
                    out[start[i * size + m] + i * size + n] += _dot(stamps[m, first:last], stamps[n, first:last], part)
            p = end
        for k in range(lead[i * size] // size, i):
            t = members[k]
            if not _touch(boxes, s, t):
                continue
            for j in range(max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])):
                p = fp.first[s] + j - boxes[s, 0]
                q = fp.first[t] + j - boxes[t, 0]
                a = max(fp.low[p], fp.low[q])
                b = min(fp.low[p] + fp.size[p], fp.low[q] + fp.size[q])
                if a < b:
                    ps, qs = fp.start[p] - fp.low[p], fp.start[q] - fp.low[q]
                    part = weight[at[p] - fp.low[p] + a : at[p] - fp.low[p] + b]
                    for m in range(size):
                        left, row = stamps[m, ps + a : ps + b], start[i * size + m] + k * size
                        for n in range(size):
                            out[row + n] += _dot(left, stamps[n, qs + a : qs + b], part)


@inner(cache=True)
def _run(fp, s, i, at):
    """The first of a source's rows after row i that does not follow the one before it both in its template and in an image."""
    last = fp.first[s + 1]
    i += 1
    while i < last and at[i] == at[i - 1] + fp.size[i - 1]:
        i += 1
    return i


@inner(cache=True, fastmath=REDUCE)
def _inner(a, b):
    total = 0.0
    for i in range(a.size):
        total += a[i] * b[i]
    return total


@inner(cache=True)
def _cholesky(h, lead, start):
    """Lower triangle in place; False where the matrix is not positive definite."""
    for i in range(lead.size):
        at = start[i]
        for k in range(lead[i], i + 1):
            first = max(lead[i], lead[k])
            total = h[at + k] - _inner(h[at + first : at + k], h[start[k] + first : start[k] + k])
            if i > k:
                h[at + k] = total / h[start[k] + k]
            elif total > 0.0:
                h[at + i] = math.sqrt(total)
            else:
                return False
    return True


@inner(cache=True)
def _solve(lower, lead, start, x):
    """x <- (L L^T)^-1 x, in place."""
    for i in range(x.size):
        at = start[i]
        x[i] = (x[i] - _inner(lower[at + lead[i] : at + i], x[lead[i] : i])) / lower[at + i]
    for i in range(x.size - 1, -1, -1):
        at = start[i]
        x[i] /= lower[at + i]
        for m in range(lead[i], i):
            x[m] -= lower[at + m] * x[i]


@inner(cache=True)
def _draw(fp, s, template, amplitude, at, out):
    """Add amplitude times one of a source's templates, shape (samples,), to an image."""
    i = fp.first[s]
    while i < fp.first[s + 1]:
        end = _run(fp, s, i, at)
        stamp = template[fp.start[i] : fp.start[end]]
        target = out[at[i] : at[i] + stamp.size]
        for k in range(stamp.size):
            target[k] += amplitude * stamp[k]
        i = end


@inner(cache=True)
def _project(fp, s, template, image, at):
    """Sum over a source's pixels of one of its templates times an image."""
    total = 0.0
    i = fp.first[s]
    while i < fp.first[s + 1]:
        end = _run(fp, s, i, at)
        stamp = template[fp.start[i] : fp.start[end]]
        total += _inner(stamp, image[at[i] : at[i] + stamp.size])
        i = end
    return total


@inner(cache=True)
def _room(w, first, size):
    """A part of the workspace's heap, or new memory where it is too small."""
    return w.heap[first : first + size] if first + size <= w.heap.size else np.empty(size)


class Patch(NamedTuple):
    """The pixels of a cluster, one after another: on every row the stretch that holds all its footprints."""

    values: Floats
    background: Floats
    image: Floats
    score: Floats
    weight: Floats


@inner(cache=True)
def _patch(counts, w, fp, boxes, members, background, at):
    """A cluster's pixels, without sources; where its footprints' rows begin among them goes into `at`."""
    ny = w.span.shape[0]
    pitch = w.image.size // ny
    top, bottom = boxes[members[0], 0], 0
    for s in members:
        bottom = max(bottom, boxes[s, 1])
    low, high = np.full(max(bottom - top, 0), pitch), np.zeros(max(bottom - top, 0), np.int64)
    for s in members:
        for i in range(fp.first[s], fp.first[s + 1]):
            j = fp.row[i] - top
            low[j] = min(low[j], fp.low[i])
            high[j] = max(high[j], fp.low[i] + fp.size[i])
    start = np.zeros(low.size + 1, np.int64)
    for j in range(low.size):
        start[j + 1] = start[j] + max(high[j] - low[j], 0)
    size = start[low.size]
    values, level, image = (_room(w, 0, size), _room(w, w.image.size, size), _room(w, 2 * w.image.size, size))
    patch = Patch(values, level, image, w.score[:size], w.weight[:size])
    patch.image[:] = 0.0
    for j in range(low.size):
        c0, c1, c2 = _background_row(background, top + j, ny)
        for k in range(low[j], high[j]):
            u = (2 * k - counts.nx + 1) / counts.nx
            i = start[j] + k - low[j]
            patch.values[i] = counts.values[(top + j) * pitch + k]
            patch.background[i] = c0 + u * (c1 + u * c2)
    for s in members:
        for i in range(fp.first[s], fp.first[s + 1]):
            j = fp.row[i] - top
            at[i] = start[j] + fp.low[i] - low[j]
    return patch


@inner(cache=True, fastmath=FAST, error_model="numpy")
def _weigh_patch(patch):
    """Score n/mu - 1 and weight n/mu^2 of Poisson counts, zero where masked."""
    values, background, image, score, weight = patch
    for i in range(values.size):
        inverse = 1.0 / (image[i] + background[i])
        n = values[i] if values[i] > LIMIT else 0.0
        score[i] = n * inverse - (1.0 if values[i] > LIMIT else 0.0)
        weight[i] = n * inverse * inverse


@inner(cache=True, fastmath=REDUCE)
def _flux_run(stamp, values, background):
    """Sums of template times counts less background, and of template squared."""
    above, below = 0.0, 0.0
    for i in range(stamp.size):
        k = stamp[i] if values[i] > LIMIT else 0.0
        above += k * (values[i] - background[i])
        below += k * k
    return above, below


@inner(cache=True)
def _first_flux(fp, s, template, patch, at):
    """Least-squares flux of one source, its neighbours ignored."""
    above, below = 0.0, 0.0
    i = fp.first[s]
    while i < fp.first[s + 1]:
        end = _run(fp, s, i, at)
        stamp, pixels = template[fp.start[i] : fp.start[end]], slice(at[i], at[i] + fp.start[end] - fp.start[i])
        more, norm = _flux_run(stamp, patch.values[pixels], patch.background[pixels])
        above += more
        below += norm
        i = end
    return above / below if below > 0.0 else 0.0


@inner(cache=True)
def _add_block(i, start, out, first_second, first_third, second, second_third, third):
    """Add to a source's own block of a matrix what its shifts are concerned with."""
    row, column = start[3 * i + 1 : 3 * i + 3], 3 * i
    out[row[0] + column] += first_second
    out[row[1] + column] += first_third
    out[row[0] + column + 1] += second
    out[row[1] + column + 1] += second_third
    out[row[1] + column + 2] += third


@inner(cache=True, fastmath=REDUCE, error_model="numpy")
def _bend(fp, s, stamps, flux, score, at, sigma, i, start, out):
    """Subtract from a source's block of H the second derivatives times the score, as they are for a PSF that no pixel blurs.

    K_xx = X^2/K - K/sigma^2, K_xy = X Y/K are a Gaussian's: near enough to make the steps that H gives converge several times
    faster, for any PSF where it falls no faster than a Gaussian does within eight widths.
    """
    fx, fy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(fp.first[s], fp.first[s + 1]):
        first = fp.start[p]
        for k in range(fp.size[p]):
            own, x, y = stamps[0, first + k] * flux, stamps[1, first + k], stamps[2, first + k]
            r = -score[at[p] + k] if own > 1e-200 and x * x + y * y < (8.0 * own / sigma) ** 2 else 0.0
            inverse = 1.0 / max(own, 1e-200)
            fx += r * x
            fy += r * y
            xx += r * (x * x * inverse - own / (sigma * sigma))
            xy += r * x * y * inverse
            yy += r * (y * y * inverse - own / (sigma * sigma))
    _add_block(i, start, out, fx / flux, fy / flux, xx, xy, yy)


@inner(cache=True, error_model="numpy")
def _profile(o, maps, counts, w, fp, boxes, clusters, stamps, sigma, scatter, background, scale, flux, shift, factors):
    """Fill `flux` and `shift` with their maximum and `factors` with the Cholesky factors of H; add the sources to the image.

    Returns the log-prior of the fluxes and shifts plus the Laplace term, or -inf without a maximum. The prior of flux s is
    Gamma(2, scale[s]), with density F exp(-F / scale) / scale^2. With three templates the shifts are free, and `maps` is left
    with the shifted sources.
    """
    size = stamps.shape[0]
    work = new_work(o)
    at, frame = np.empty(fp.row.size, np.int64), row_starts(fp, w.image.size // w.span.shape[0])
    value = 0.0
    shift[:] = 0.0
    for c in range(clusters.first.size - 1):
        members, lead, start = _cluster(clusters, c, size)
        h = factors[clusters.begin[c] : clusters.begin[c + 1]]
        n = members.size * size
        step = np.empty(n)
        patch = _patch(counts, w, fp, boxes, members, background, at)
        for s in members:
            if size > 1:
                _make_templates(o, maps, fp, s, sigma, 1.0, stamps, work)
            else:
                stamps[0, fp.start[fp.first[s]] : fp.start[fp.first[s + 1]]] = 0.0
                add_source(o, maps, fp, s, sigma, 1.0, fp.start, stamps[0], work)
            flux[s] = max(_first_flux(fp, s, stamps[0], patch, at), 0.01 * scale[s])
            stamps[1:, fp.start[fp.first[s]] : fp.start[fp.first[s + 1]]] *= flux[s]
            _draw(fp, s, stamps[0], flux[s], at, patch.image)
        lower = h.copy() if size > 1 else h
        distance, rate, converged, factored = 0.0, 1.0, False, False
        for _ in range(100):
            _weigh_patch(patch)
            fresh = converged or rate > 0.01  # otherwise the last matrix serves
            if fresh:
                _gram(fp, boxes, members, lead, start, stamps, patch.weight, at, h)
                for i in range(n):
                    h[start[i] + i] += 1.0 / flux[members[i // size]] ** 2 if i % size == 0 else 1.0 / scatter**2
            if converged:
                factored = _cholesky(h, lead, start)
                break
            for i in range(n):
                s, t = members[i // size], i % size
                step[i] = _project(fp, s, stamps[t], patch.score, at)
                step[i] += 1.0 / flux[s] - 1.0 / scale[s] if t == 0 else -shift[s, t - 1] / scatter**2
            gradient = step.copy()
            if fresh and size > 1:
                lower[:] = h
                for i in range(members.size):
                    _bend(fp, members[i], stamps, flux[members[i]], patch.score, at, sigma, i, start, lower)
            factored = not fresh or _cholesky(lower, lead, start)
            if size > 1 and not factored:  # far from the maximum
                lower[:] = h
                factored = _cholesky(lower, lead, start)
            if not factored:
                break
            _solve(lower, lead, start, step)
            largest = 0.0
            for i in range(n):
                largest = max(largest, abs(step[i]) / (flux[members[i // size]] if i % size == 0 else sigma))
            step *= 1.0 if largest < 0.5 else 1.0 / (1.0 + largest)
            for i in range(members.size):
                s = members[i]
                if size > 1:
                    _draw(fp, s, stamps[0], -flux[s], at, patch.image)
                    flux[s] += step[i * size]
                    shift[s] += step[i * size + 1 : i * size + 3]
                    move(o, maps, s, step[i * size + 1], step[i * size + 2])
                    _make_templates(o, maps, fp, s, sigma, flux[s], stamps, work)
                    _draw(fp, s, stamps[0], flux[s], at, patch.image)
                else:
                    flux[s] += step[i]
                    _draw(fp, s, stamps[0], step[i], at, patch.image)
            # The square of the distance in standard deviations, and what a step leaves of it: in a Newton step of fluxes alone the
            # square of the largest relative change.
            before, distance = distance, np.dot(gradient, step)
            rate = distance / before if before > 0.0 else 1.0
            if fresh and size == 1:
                rate = largest * largest
            converged = distance * min(rate, 1.0) <= 1e-16
        if not (converged and factored):
            return -math.inf
        for i in range(n):
            value -= math.log(h[start[i] + i])
        for s in members:
            value += math.log(flux[s] / scale[s] ** 2) - flux[s] / scale[s] + 0.5 * math.log(2.0 * math.pi)
            if size > 1:
                value -= 0.5 * (shift[s, 0] ** 2 + shift[s, 1] ** 2) / scatter**2 + 2.0 * math.log(scatter)
            _draw(fp, s, stamps[0], flux[s], frame, w.image)
    return value


class Fitted(NamedTuple):
    """What the profiling knows of the sources; empty arrays where fluxes are fixed."""

    footprints: Footprints
    boxes: Ints
    clusters: Clusters
    stamps: Floats  # (templates, samples)
    factors: Floats  # Cholesky factors of H
    fluxes: Floats
    shifts: Floats  # (s, 2) pixel


class Drawn(NamedTuple):
    """The sources as they are drawn in a workspace's image, and what the derivatives need of them."""

    extra: float  # what profiling adds to the log-likelihood; -inf where a map folds, or the fluxes have no maximum
    maps: Maps
    fitted: Fitted


@nb.njit(cache=True, nogil=True)
def draw(o, counts, w, theta, nuisances, background, flux, free):
    """Draw all sources, profiling their fluxes if they are free; whoever uses the image clears the workspace.

    Nuisances are flux_scale, offset_x, offset_y, psf_sigma, position_scatter.
    """
    maps = new_maps(o)
    sigma, scatter = nuisances[3], nuisances[4]
    extra = 0.0
    if not (scatter >= 0.0 and locate(o, theta, nuisances[1], nuisances[2], sigma, 6.0 * scatter, maps)):
        extra = -math.inf
        maps.rows[:] = 0
    fp = footprints(o, maps)
    _mark_sources(fp, w)
    if counts.varies:
        _mark_counted(counts, w)
    templates = 3 if scatter > 0.0 else 1
    boxes = _boxes(fp) if free else np.empty((0, 4), np.int64)
    clusters = _clusters(boxes, o.ny, templates)
    factors = np.empty(clusters.begin[-1])
    fluxes, shifts = np.empty(flux.size), np.zeros((flux.size, 2))
    if free:
        stamps = _room(w, 3 * w.image.size, templates * fp.start[fp.row.size]).reshape(templates, -1)
        extra += _profile(
            o, maps, counts, w, fp, boxes, clusters, stamps, sigma, scatter, background, 0.5 * flux, fluxes, shifts, factors
        )
    else:
        stamps = np.empty((1, 0))
        work = new_work(o)
        at = row_starts(fp, w.image.size // o.ny)
        for s in range(o.x.size):
            fluxes[s] = nuisances[0] * flux[s]
            add_source(o, maps, fp, s, sigma, fluxes[s], at, w.image, work)
    return Drawn(extra, maps, Fitted(fp, boxes, clusters, stamps, factors, fluxes, shifts))


@nb.njit(cache=True, nogil=True)
def log_likelihoods(o, counts, w, theta, nuisances, background, flux, free, first, step, out):
    """Log-likelihoods of rows first, first + step, ... into `out`; rows where it is -inf already are left alone."""
    for i in range(first, out.size, step):
        if out[i] > -math.inf:
            out[i] = draw(o, counts, w, theta[i], nuisances[i], background[i], flux, free).extra
            if out[i] > -math.inf:
                out[i] += _log_likelihood(counts, w, background[i])
            clear(w)


@inner(cache=True)
def _weigh(counts, w, background, curve):
    """Score d log L/d mu and weight -d^2 log L/d mu^2 of every marked pixel; curve = -1/2 d weight/d mu."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    for j in range(ny):
        c0, c1, c2 = _background_row(background, j, ny)
        start, stop = _next_run(w.flags, w.span, per_row, j, w.span[j, 0])
        while start >= 0:
            for p in range((j * per_row + start) * SEGMENT, (j * per_row + stop) * SEGMENT):
                u = (2 * (p - j * per_row * SEGMENT) - counts.nx + 1) / counts.nx
                mu = w.image[p] + c0 + u * (c1 + u * c2)
                n = counts.values[p]
                if n <= LIMIT:
                    w.score[p], w.weight[p], curve[p] = 0.0, 0.0, 0.0
                elif counts.kind == POISSON and n == 0.0:  # whatever mu: it may be zero, too
                    w.score[p], w.weight[p], curve[p] = -1.0, 0.0, 0.0
                elif counts.kind == POISSON:
                    w.score[p], w.weight[p], curve[p] = n / mu - 1.0, n / (mu * mu), n / (mu * mu * mu)
                else:
                    w.score[p], w.weight[p], curve[p] = (n - mu) / c0, 1.0 / c0, 0.0
            start, stop = _next_run(w.flags, w.span, per_row, j, stop)


@inner(cache=True)
def _mix(fp, boxes, members, lead, start, lower, stamps, out):
    """The templates q = Q T of a cluster's sources, added to `out`; returns the diagonal of Q."""
    size = stamps.shape[0]
    diagonal, column = np.empty(lead.size), np.empty(lead.size)
    for i in range(lead.size):
        s, a = members[i // size], i % size
        column[:] = 0.0
        column[i] = 1.0
        _solve(lower, lead, start, column)
        diagonal[i] = column[i]
        for m in range(lead[i] // size, members.size):
            t = members[m]
            if boxes[t, 0] >= boxes[s, 1]:
                break
            if not _touch(boxes, s, t):
                continue
            for j in range(max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])):
                p = fp.first[s] + j - boxes[s, 0]
                q = fp.first[t] + j - boxes[t, 0]
                first, last = max(fp.low[p], fp.low[q]), min(fp.low[p] + fp.size[p], fp.low[q] + fp.size[q])
                ps, qs = fp.start[p] - fp.low[p], fp.start[q] - fp.low[q]
                for b in range(size):
                    for k in range(first, last):
                        out[a, ps + k] += column[m * size + b] * stamps[b, qs + k]
    return diagonal


@inner(cache=True)
def _second_derivatives(o, w, drawn, s, sigma, mixed, constants, rows, part, i, start, g):
    """What a source's second derivatives K_xx, K_xy, K_yy and X, Y as dK add to its rows of e and G."""
    fp, stamps, flux = drawn.fitted.footprints, drawn.fitted.stamps, drawn.fitted.fluxes[s]
    pitch = w.image.size // w.span.shape[0]
    xx, xy, yy = np.empty(pitch), np.empty(pitch), np.empty(pitch)
    for p in range(fp.first[s], fp.first[s + 1]):
        j, low, n = fp.row[p], fp.low[p], fp.size[p]
        basis_row(o, drawn.maps, constants, s, j, low, n, sigma, np.int64(1), rows.out, rows.samples, rows.powers, rows.work)
        xx[:n], xy[:n] = -flux * rows.out[0, :n], -flux * rows.out[1, :n]
        basis_row(o, drawn.maps, constants, s, j, low, n, sigma, np.int64(2), rows.out, rows.samples, rows.powers, rows.work)
        yy[:n] = -flux * rows.out[1, :n]
        for k in range(n):
            at, pixel = fp.start[p] + k, j * pitch + low + k
            x, y = stamps[1, at] / flux, stamps[2, at] / flux
            r, weight = w.score[pixel], w.weight[pixel]
            q0, q1, q2 = mixed[0, at], mixed[1, at], mixed[2, at]
            part[0] -= weight * (q1 * x + q2 * y)
            part[1] -= weight * (q0 * x + q1 * xx[k] + q2 * xy[k])
            part[2] -= weight * (q0 * y + q1 * xy[k] + q2 * yy[k])
            _add_block(i, start, g, -r * x, -r * y, -r * xx[k], -r * xy[k], -r * yy[k])


@inner(cache=True)
def _laplace_adjoint(o, w, drawn, sigma, scatter, curve):
    """z, the templates q, the image A and the derivative by tau of the module's derivation."""
    fp, boxes, clusters, stamps, factors, flux, shift = drawn.fitted
    pitch = w.image.size // w.span.shape[0]
    size, at = stamps.shape[0], row_starts(fp, w.image.size // w.span.shape[0])
    h, y = np.zeros(w.image.size), np.zeros(w.image.size)
    z = np.empty((flux.size, size))
    mixed = np.zeros(stamps.shape)
    constants = _constants()
    rows = _new_rows(o, constants, pitch)
    slope = 0.0
    for c in range(clusters.first.size - 1):
        members, lead, start = _cluster(clusters, c, size)
        n = members.size * size
        lower = factors[clusters.begin[c] : clusters.begin[c + 1]]
        diagonal = _mix(fp, boxes, members, lead, start, lower, stamps, mixed)
        for s in members:
            for p in range(fp.first[s], fp.first[s + 1]):
                for t in range(size):
                    for k in range(fp.size[p]):
                        h[at[p] + k] += stamps[t, fp.start[p] + k] * mixed[t, fp.start[p] + k]
        part = np.zeros(n)
        for i in range(n):
            s, t = members[i // size], i % size
            for p in range(fp.first[s], fp.first[s + 1]):
                for k in range(fp.size[p]):
                    part[i] += curve[at[p] + k] * h[at[p] + k] * stamps[t, fp.start[p] + k]
            if t == 0:
                part[i] += diagonal[i] / flux[s] ** 3
        if size > 1:
            g = np.empty(lower.size)
            _gram(fp, boxes, members, lead, start, stamps, w.weight, at, g)
            for i in range(n):
                g[start[i] + i] += 1.0 / flux[members[i // size]] ** 2 if i % size == 0 else 1.0 / scatter**2
            for i in range(members.size):
                own = part[i * size : (i + 1) * size]
                _second_derivatives(o, w, drawn, members[i], sigma, mixed, constants, rows, own, i, start, g)
            if _cholesky(g, lead, start):  # it is positive definite at a maximum; elsewhere H has to do
                lower = g
        _solve(lower, lead, start, part)
        for i in range(n):
            s, t = members[i // size], i % size
            z[s, t] = part[i]
            _draw(fp, s, stamps[t], part[i], at, y)
            if t > 0:
                d = shift[s, t - 1]
                slope += (d * d + diagonal[i] + 2.0 * part[i] * d) / scatter**3 - 1.0 / scatter
    for j in range(w.span.shape[0]):
        for p in range(j * pitch + w.span[j, 0] * SEGMENT, j * pitch + (w.span[j, 1] + 1) * SEGMENT):
            if w.flags[p // SEGMENT]:
                h[p] = w.score[p] + curve[p] * h[p] - w.weight[p] * y[p]
    return z, mixed, h, slope


@nb.njit(cache=True, nogil=True)
def gradient(o, counts, w, drawn, nuisances, background, free, basis, out, out_background):
    """Exact gradient of the log-likelihood: source parameters in `out`, background coefficients in `out_background`.

    Returns the derivative with respect to position_scatter, NaN where the likelihood is zero.
    """
    if not drawn.extra + _log_likelihood(counts, w, background) > -math.inf:
        return math.nan
    maps, fp, fluxes, sigma = drawn.maps, drawn.fitted.footprints, drawn.fitted.fluxes, nuisances[3]
    size = drawn.fitted.stamps.shape[0]
    curve = np.empty(w.image.size)
    _weigh(counts, w, background, curve)
    image = w.score
    z, mixed, slope = np.zeros((fluxes.size, size)), np.empty((size, 0)), 0.0
    if free:
        z, mixed, image, slope = _laplace_adjoint(o, w, drawn, sigma, nuisances[4], curve)
    _background_gradient(counts, w, background, image, out_background)
    pitch = w.image.size // o.ny
    rows = _new_rows(o, basis, pitch)
    ones, c = np.ones(pitch), np.empty(pitch)
    moments = np.empty(rows.out.shape[0])
    for s in range(o.x.size):
        moments[:] = 0.0
        for p in range(fp.first[s], fp.first[s + 1]):
            j, low, n = fp.row[p], fp.low[p], fp.size[p]
            at = j * pitch + low
            for t in range(size):
                for k in range(n):
                    c[k] = fluxes[s] * image[at + k] if t == 0 else 0.0
                if free:
                    q, amplitude = fp.start[p], 1.0 if t == 0 else fluxes[s]
                    for k in range(n):
                        c[k] += amplitude * (z[s, t] * w.score[at + k] - w.weight[at + k] * mixed[t, q + k])
                basis_row(o, maps, basis, s, j, low, n, sigma, t, rows.out, rows.samples, rows.powers, rows.work)
                for k in range(moments.size):
                    moments[k] += _dot(rows.out[k, :n], c[:n], ones[:n])
        for k in range(basis.row.size):
            out[k] += basis.lever[s, k] * moments[basis.row[k]]
    return slope


@inner(cache=True)
def _background_gradient(counts, w, background, image, out):
    """Sum of the image times 1, u, v, u^2, uv, v^2 over the likelihood's pixels."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    pixels, rest = counts.pixels, counts.total
    for j in range(ny):
        v = (2 * j - ny + 1) / ny
        start, stop = _next_run(w.flags, w.span, per_row, j, w.span[j, 0])
        while start >= 0:
            for p in range((j * per_row + start) * SEGMENT, (j * per_row + stop) * SEGMENT):
                if counts.values[p] > LIMIT:
                    u = (2 * (p - j * per_row * SEGMENT) - counts.nx + 1) / counts.nx
                    out[0] += image[p]
                    out[1] += image[p] * u
                    out[2] += image[p] * v
                    out[3] += image[p] * u * u
                    out[4] += image[p] * u * v
                    out[5] += image[p] * v * v
            for k in range(j * per_row + start, j * per_row + stop):
                pixels -= counts.segment_pixels[k]
                rest -= counts.segment_sum[k]
            start, stop = _next_run(w.flags, w.span, per_row, j, stop)
    if pixels > 0.0:
        out[0] += rest / background[0] - pixels if counts.kind == POISSON else (rest - background[0] * pixels) / background[0]


@inner(cache=True)
def _fisher_weight(counts, w, background):
    """Expected information 1 / variance per marked pixel into w.weight, zero where masked; returns the unmarked pixels."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    pixels = counts.pixels
    for j in range(ny):
        c0, c1, c2 = _background_row(background, j, ny)
        start, stop = _next_run(w.flags, w.span, per_row, j, w.span[j, 0])
        while start >= 0:
            for p in range((j * per_row + start) * SEGMENT, (j * per_row + stop) * SEGMENT):
                u = (2 * (p - j * per_row * SEGMENT) - counts.nx + 1) / counts.nx
                mu = w.image[p] + c0 + u * (c1 + u * c2)
                counted = counts.values[p] > LIMIT
                w.weight[p] = (1.0 / (max(mu, 1e-300) if counts.kind == POISSON else c0)) if counted else 0.0
            for k in range(j * per_row + start, j * per_row + stop):
                pixels -= counts.segment_pixels[k]
            start, stop = _next_run(w.flags, w.span, per_row, j, stop)
    return pixels


BAND = 16  # rows of the Jacobian held at a time


@nb.njit(cache=True, nogil=True)
def fisher(o, counts, w, drawn, nuisances, background, terms, free, basis, out):
    """Fisher information of source parameters, then the first `terms` background coefficients, fluxes profiled out.

    I = sum over pixels of J J^T / mu, band by band of rows; with free fluxes the Schur complement
    I - C H^-1 C^T over the sources' templates, where H carries the priors' curvature.

    Returns the information about position_scatter: a coordinate measured with variance s^2 scatters by tau^2 + s^2 about
    the catalogue's, which gives 2 tau^2 / (tau^2 + s^2)^2 = 2 (tau^2 - Q)^2 / tau^6 with Q its variance given the prior. NaN where
    the likelihood is zero.
    """
    if not drawn.extra + _log_likelihood(counts, w, background) > -math.inf:
        return math.nan
    fp, boxes, clusters, stamps, factors, fitted, _ = drawn.fitted
    sigma, scatter, templates = nuisances[3], nuisances[4], stamps.shape[0]
    pixels = _fisher_weight(counts, w, background)
    ny, pitch = o.ny, w.image.size // o.ny
    per_row = w.flags.size // ny
    sources = basis.row.size
    size = sources + terms
    cross = np.zeros((fitted.size * templates, size))
    band = np.empty((size, BAND, pitch))
    for top in range(0, ny, BAND):
        last = min(top + BAND, ny)
        band[:] = 0.0
        add_jacobian_rows(o, drawn.maps, fp, basis, fitted, sigma, top, last, band)
        for j in range(top, last):
            v = (2 * j - ny + 1) / ny
            for i in range(pitch):
                u = (2 * i - o.nx + 1) / o.nx
                band[sources, j - top, i] = 1.0
                if terms > 1:
                    band[sources + 1, j - top, i], band[sources + 2, j - top, i] = u, v
                if terms > 3:
                    band[sources + 3, j - top, i], band[sources + 4, j - top, i] = u * u, u * v
                    band[sources + 5, j - top, i] = v * v
            start, stop = _next_run(w.flags, w.span, per_row, j, w.span[j, 0])
            while start >= 0:
                a, b = start * SEGMENT, stop * SEGMENT
                weight = w.weight[j * pitch + a : j * pitch + b]
                for k in range(size):
                    left = band[k, j - top, a:b]
                    for m in range(k + 1):
                        out[k, m] += _dot(left, band[m, j - top, a:b], weight)
                start, stop = _next_run(w.flags, w.span, per_row, j, stop)
        if free:
            for s in range(fitted.size):
                for j in range(max(top, boxes[s, 0]), min(last, boxes[s, 1])):
                    i = fp.first[s] + j - boxes[s, 0]
                    a, b = fp.low[i], fp.low[i] + fp.size[i]
                    weight = w.weight[j * pitch + a : j * pitch + b]
                    for t in range(templates):
                        stamp = stamps[t, fp.start[i] : fp.start[i + 1]]
                        for k in range(size):
                            cross[s * templates + t, k] += _dot(band[k, j - top, a:b], stamp, weight)
    out[sources, sources] += pixels / background[0] if pixels > 0.0 else 0.0
    known = 0.0
    if free:
        at = row_starts(fp, pitch)
        for c in range(clusters.first.size - 1):
            members, lead, start = _cluster(clusters, c, templates)
            n = members.size * templates
            h = factors[clusters.begin[c] : clusters.begin[c + 1]]
            _gram(fp, boxes, members, lead, start, stamps, w.weight, at, h)
            for i in range(n):
                h[start[i] + i] += 1.0 / fitted[members[i // templates]] ** 2 if i % templates == 0 else 1.0 / scatter**2
            _cholesky(h, lead, start)  # positive definite: the prior's curvature is
            column = np.empty(n)
            for i in range(n):
                if i % templates > 0:
                    column[:] = 0.0
                    column[i] = 1.0
                    _solve(h, lead, start, column)
                    known += 2.0 * (scatter**2 - column[i]) ** 2 / scatter**6
            for m in range(size):
                for i in range(n):
                    column[i] = cross[members[i // templates] * templates + i % templates, m]
                _solve(h, lead, start, column)
                for k in range(m, size):
                    for i in range(n):
                        out[k, m] -= cross[members[i // templates] * templates + i % templates, k] * column[i]
    for k in range(size):
        for m in range(k):
            out[m, k] = out[k, m]
    return known
