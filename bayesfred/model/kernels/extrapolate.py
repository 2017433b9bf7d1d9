"""The likelihood with free fluxes where these are nearly known beforehand.

Symbols are those of `fluxes.py`, derivatives and steps being relative to F: templates are F K. At
fluxes F close to the maximum let g be the gradient of log L(theta, F) + log p(F), H minus its
Hessian, and d = H^-1 g the Newton step. Then

    max_F [log L(theta, F) + log p(F)] = log L(theta, F) + log p(F) + 1/2 g d + O(N d^3),      N
    counts of a source,

and 1/2 log det H differs from its value at the maximum by sum_s b_s d_s + O(d^2), |b_s| being less
than one or so: on a source's pixels mu changes by no more than d_s mu, and H by twice as much. b is
known from other parameters nearby; it is -F e with the e of `gradient.py`, which is H z. Where D =
sum_s |d_s| is little, the pixels need to be visited once. They are visited in bands of rows, whose
templates stay in the caches while they are drawn, weighed and multiplied.
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE
from bayesfred.imaging.kernels.geometry import (
    SEGMENT,
    footprints,
    locate,
    new_maps,
    new_work,
    row_starts,
)
from bayesfred.imaging.kernels.render import add_source
from bayesfred.model.kernels.clusters import Clusters, bounding_boxes, cholesky, one_cluster, solve
from bayesfred.model.kernels.likelihood import (
    LIMIT,
    background_row,
    log_likelihood,
    mark_counted,
    mark_sources,
    next_run,
    room,
)

BAND = 16  # rows visited at a time
VISITS = 3  # of all pixels, after which the fluxes count as not known beforehand
ENOUGH = 5e-5  # the largest D
OVERLAP = 1e-4  # the least |H_st| / sqrt(H_ss H_tt) that counts: log det H changes by its square
U = np.uint64  # an index that has no sign need not be compared with zero


class Extrapolated(NamedTuple):
    """Fluxes near the maximum for every parameter vector, and what is known of H."""

    fluxes: Floats  # (vectors, s)
    clusters: Clusters
    diagonal: Ints  # (s,) where H_ss is in the clusters' storage
    first: Ints  # (s,) source s has the pairs from first[s] to last[s]
    last: Ints
    other: Ints  # (pairs,)
    place: Ints  # (pairs,) where their elements are in the storage
    bend: Floats  # (s,) b


@entry()
def describe(fitted, z):
    """`diagonal` to `bend` of `Extrapolated`, from H's Cholesky factors and z at parameters nearby."""
    clusters, factors, size = fitted.clusters, fitted.factors, fitted.fluxes.size
    diagonal, first, last, bend = (
        np.empty(size, np.int64),
        np.empty(size, np.int64),
        np.empty(size, np.int64),
        np.zeros(size),
    )
    other, place = np.empty(factors.size, np.int64), np.empty(factors.size, np.int64)
    n = 0
    for c in range(clusters.first.size - 1):
        members, lead, start = one_cluster(clusters, c, 1)
        begin = clusters.begin[c]
        lower = factors[begin : clusters.begin[c + 1]]
        norm = np.empty(members.size)
        for i in range(members.size):
            s = members[i]
            first[s] = n
            diagonal[s] = begin + start[i] + i
            for k in range(i, lead[i] - 1, -1):
                t = members[k]
                h = 0.0
                for m in range(max(lead[i], lead[k]), k + 1):
                    h += lower[start[i] + m] * lower[start[k] + m]
                bend[s] -= h * z[t] * fitted.fluxes[s]
                if k == i:
                    norm[i] = math.sqrt(h)
                    continue
                bend[t] -= h * z[s] * fitted.fluxes[t]
                if abs(h) > OVERLAP * norm[i] * norm[k]:
                    other[n], place[n] = t, begin + start[i] + k
                    n += 1
            last[s] = n
    return diagonal, first, last, other[:n], place[:n], bend


@inner(fastmath=FAST, error_model="numpy")
def _weigh_run(values, image, u, step, c0, c1, c2, score, weight):
    """Score n/mu - 1 and weight n/mu^2 of Poisson counts, zero where masked."""
    for i in range(values.size):
        x = u + step * i
        inverse = 1.0 / (image[i] + (c0 + x * (c1 + x * c2)))
        n = values[i] if values[i] > LIMIT else 0.0
        score[i] = n * inverse - (1.0 if values[i] > LIMIT else 0.0)
        weight[i] = n * inverse * inverse


@inner()
def _weigh_band(counts, w, background, top, last):
    """Score and weight of a band's marked pixels."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    for j in range(top, last):
        c0, c1, c2 = background_row(background, j, ny)
        start, stop = next_run(w.flags, w.span, per_row, j, w.span[j, 0])
        while start >= 0:
            a, b = (j * per_row + start) * SEGMENT, (j * per_row + stop) * SEGMENT
            u = (2 * start * SEGMENT - counts.nx + 1) / counts.nx
            _weigh_run(
                counts.values[a:b],
                w.image[a:b],
                u,
                2.0 / counts.nx,
                c0,
                c1,
                c2,
                w.score[a:b],
                w.weight[a:b],
            )
            start, stop = next_run(w.flags, w.span, per_row, j, stop)


@inner(fastmath=REDUCE)
def _own_row(templates, i, score, weight, j, n):
    """Sums of template times score and of template squared times weight, n samples from i and j on."""
    g, h = 0.0, 0.0
    for k in range(n):
        g += templates[i + k] * score[j + k]
        h += templates[i + k] * templates[i + k] * weight[j + k]
    return g, h


@inner(fastmath=REDUCE)
def _shared_row(templates, i, m, weight, j, n):
    """Sum of two templates' product times weight, n samples from i, m and j on."""
    total = 0.0
    for k in range(n):
        total += templates[i + k] * templates[m + k] * weight[j + k]
    return total


@inner()
def _multiply_band(w, fp, boxes, extrapolated, templates, place, at, top, last, g, h):
    """Add what a band's pixels give to g and H; row i's template is at place[i], its pixels are at at[i]."""
    low, size, score, weight = fp.low, fp.size, w.score, w.weight
    for s in range(g.size):
        begin, end = max(top, boxes[s, 0]), min(last, boxes[s, 1])
        if begin >= end:
            continue
        own = fp.first[s] - boxes[s, 0]
        square = 0.0
        for p in range(own + begin, own + end):
            g_row, h_row = _own_row(templates, U(place[p]), score, weight, U(at[p]), U(size[p]))
            g[s] += g_row
            square += h_row
        h[extrapolated.diagonal[s]] += square
        for e in range(extrapolated.first[s], extrapolated.last[s]):
            t = extrapolated.other[e]
            others = fp.first[t] - boxes[t, 0]
            total = 0.0
            for j in range(max(begin, boxes[t, 0]), min(end, boxes[t, 1])):
                p, q = own + j, others + j
                a = max(low[p], low[q])
                n = min(low[p] + size[p], low[q] + size[q]) - a
                if n > 0:
                    i, m, k = place[p] + a - low[p], place[q] + a - low[q], at[p] + a - low[p]
                    total += _shared_row(templates, U(i), U(m), weight, U(k), U(n))
            h[extrapolated.place[e]] += total


@inner()
def _visit(
    o, counts, w, maps, fp, boxes, at, sigma, background, flux, extrapolated, templates, g, h
):
    """Draw the sources with these fluxes and sum g and H, without the prior's share, over the pixels."""
    place, work = np.empty(fp.row.size, np.int64), new_work(o)
    g[:], h[:] = 0.0, 0.0
    for top in range(0, o.ny, BAND):
        last = min(top + BAND, o.ny)
        used = 0
        for s in range(flux.size):
            begin, end = max(top, boxes[s, 0]), min(last, boxes[s, 1])
            if begin >= end:
                continue
            p, q = fp.first[s] + begin - boxes[s, 0], fp.first[s] + end - boxes[s, 0]
            for i in range(p, q):
                place[i] = used + fp.start[i] - fp.start[p]
            used += fp.start[q] - fp.start[p]
            add_source(o, maps, fp, s, p, q, sigma, flux[s], at, w.image, work, place, templates)
        _weigh_band(counts, w, background, top, last)
        _multiply_band(w, fp, boxes, extrapolated, templates, place, at, top, last, g, h)


@inner()
def profile_extrapolated(o, counts, w, theta, nuisances, background, scale, flux, extrapolated):
    """The log-likelihood; NaN where the fluxes in `flux` are too far from the maximum. Whoever calls clears the workspace."""
    sigma = nuisances[3]
    maps = new_maps(o)
    if not locate(o, theta, nuisances[1], nuisances[2], sigma, 0.0, maps):
        return -math.inf
    if not np.min(flux) > 0.0:
        return math.nan
    fp = footprints(o, maps)
    mark_sources(fp, w)
    if counts.varies:
        mark_counted(counts, w)
    boxes, at, clusters = (
        bounding_boxes(fp),
        row_starts(fp, w.image.size // o.ny),
        extrapolated.clusters,
    )
    templates = room(w, 0, fp.start[fp.row.size])
    g, h = np.empty(flux.size), np.empty(clusters.begin[-1])
    for visit in range(VISITS):
        if visit > 0:
            w.image[:] = 0.0
        _visit(
            o,
            counts,
            w,
            maps,
            fp,
            boxes,
            at,
            sigma,
            background,
            flux,
            extrapolated,
            templates,
            g,
            h,
        )
        value, change = 0.0, 0.0
        for c in range(clusters.first.size - 1):
            members, lead, start = one_cluster(clusters, c, 1)
            lower = h[clusters.begin[c] : clusters.begin[c + 1]]
            step = np.empty(members.size)
            for i in range(members.size):
                s = members[i]
                lower[start[i] + i] += 1.0
                g[s] += 1.0 - flux[s] / scale[s]
                step[i] = g[s]
            if not cholesky(lower, lead, start):
                return math.nan
            solve(lower, lead, start, step)
            for i in range(members.size):
                s = members[i]
                value += (
                    2.0 * math.log(flux[s] / scale[s])
                    - flux[s] / scale[s]
                    + 0.5 * math.log(2.0 * math.pi)
                )
                value += (0.5 * g[s] - extrapolated.bend[s]) * step[i] - math.log(
                    lower[start[i] + i]
                )
                change += abs(step[i])
                flux[s] *= 1.0 + step[i]
        if change < ENOUGH:
            return value + log_likelihood(counts, w, background)
        if not (change < 0.5 * flux.size and np.min(flux) > 0.0):
            break
    return math.nan
