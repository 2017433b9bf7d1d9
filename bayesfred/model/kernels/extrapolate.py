"""The likelihood with free fluxes where these are nearly known beforehand.

Symbols are those of `fluxes.py`, derivatives and steps being relative to F: templates are F K. At
fluxes F close to the maximum let g be the gradient of log L(theta, F) + log p(F), H minus its
Hessian, and d = H^-1 g the Newton step. Then

    max_F [log L(theta, F) + log p(F)] = log L(theta, F) + log p(F) + 1/2 g d + O(N d^3),      N
    counts of a source,

and 1/2 log det H differs from its value at the maximum by sum_s b_s d_s + O(d^2), |b_s| being less
than one or so: on a source's pixels mu changes by no more than d_s mu, and H by twice as much. b is
known from other parameters nearby; it is -F e with the e of `gradient.py`. Where D =
sum_s |d_s| is little, the pixels need to be visited once. They are visited in bands of rows, whose
templates stay in the caches while they are rendered, weighed and multiplied. The term c of
`expansion.py` is that of F: it changes by less than d.
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner, leaf
from bayesfred.imaging.kernels.contexts import Canvas, Layout
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.imaging.kernels.geometry import layout_of, locate, new_geometry, row_starts
from bayesfred.imaging.kernels.render import add_source
from bayesfred.model.kernels.clusters import bounding_boxes, one_cluster
from bayesfred.model.kernels.contexts import Clusters
from bayesfred.model.kernels.expansion import OVERLAP, own_run, pair, shared_run, single
from bayesfred.model.kernels.factors import cholesky, solve
from bayesfred.model.kernels.likelihood import (
    U,
    counted,
    log_likelihood,
    mark,
    room,
    weigh_rows,
)
from bayesfred.model.kernels.noise_dispatch import given

BAND = 16  # rows visited at a time
VISITS = 3  # of all pixels, after which the fluxes count as not known beforehand
ENOUGH = 5e-5  # the largest D


class Extrapolated(NamedTuple):
    """Fluxes near the maximum for every parameter vector, and what is known of H."""

    fluxes: Floats  # (vectors, s)
    clusters: Clusters
    diagonal: Ints  # (s,) where H_ss is in the clusters' storage
    first: Ints  # (s,) source s has the pairs from first[s] to last[s]
    last: Ints
    other: Ints  # (pairs,)
    place: Ints  # (pairs,) where their elements are in the storage
    slope: Floats  # (s,) b


class _Visit(NamedTuple):
    """The sources of one parameter vector, and what is summed over the pixels."""

    layout: Layout
    boxes: Ints
    canvas: Canvas  # the frame
    templates: Canvas  # a band's
    known: Extrapolated
    g: Floats
    h: Floats
    faint: Flags  # (s,) that of `Problem`
    own: Floats  # (s, 3) N of `expansion.py`, zero unless faint
    mixed: Floats  # (pairs, 6)


@entry()
def describe(profiled, fluxes, e):
    """`diagonal` to `slope` of `Extrapolated`, from H's Cholesky factors and e nearby."""
    clusters, factors, size = profiled.touching.clusters, profiled.factors, fluxes.size
    diagonal, first = np.empty(size, np.int64), np.empty(size, np.int64)
    last, slope = np.empty(size, np.int64), -fluxes * e
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
                if k == i:
                    norm[i] = math.sqrt(h)
                    continue
                if abs(h) > OVERLAP * norm[i] * norm[k]:
                    other[n], place[n] = t, begin + start[i] + k
                    n += 1
            last[s] = n
    return diagonal, first, last, other[:n], place[:n], slope


@leaf(fastmath=REDUCE)
def _own_row(templates, i, score, weight, j, n):
    """Sums of template times score and template squared times weight, n samples from i, j on."""
    g, h = 0.0, 0.0
    for k in range(n):
        g += templates[i + k] * score[j + k]
        h += templates[i + k] * templates[i + k] * weight[j + k]
    return g, h


@leaf(fastmath=REDUCE)
def _shared_row(templates, i, m, weight, j, n):
    """Sum of two templates' product times weight, n samples from i, m and j on."""
    total = 0.0
    for k in range(n):
        total += templates[i + k] * templates[m + k] * weight[j + k]
    return total


@leaf()
def _multiply_band(w, visit, top, last):
    """Add what a band's pixels give to g and H."""
    fp, boxes, known, h = visit.layout.footprints, visit.boxes, visit.known, visit.h
    templates, place, at = visit.templates.image, visit.templates.at, visit.canvas.at
    low, size, score, weight, ratio = fp.low, fp.size, w.score, w.weight, w.ratio
    for s in range(visit.g.size):
        begin, end = max(top, boxes[s, 0]), min(last, boxes[s, 1])
        if begin >= end:
            continue
        own = fp.first[s] - boxes[s, 0]
        square, sums = 0.0, (0.0, 0.0, 0.0)
        for p in range(own + begin, own + end):
            i, k, n = place[p], at[p], size[p]
            g_row, h_row = _own_row(templates, U(i), score, weight, U(k), U(n))
            visit.g[s] += g_row
            square += h_row
            if visit.faint[s]:
                here = slice(k, k + n)
                sums = own_run(templates[i : i + n], weight[here], ratio[here], sums)
        h[known.diagonal[s]] += square
        for m in range(3):
            visit.own[s, m] += sums[m]
        for e in range(known.first[s], known.last[s]):
            t = known.other[e]
            others = fp.first[t] - boxes[t, 0]
            total, products = 0.0, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            both = visit.faint[s] and visit.faint[t]
            for j in range(max(begin, boxes[t, 0]), min(end, boxes[t, 1])):
                p, q = own + j, others + j
                a = max(low[p], low[q])
                n = min(low[p] + size[p], low[q] + size[q]) - a
                if n > 0:
                    i, m, k = place[p] + a - low[p], place[q] + a - low[q], at[p] + a - low[p]
                    total += _shared_row(templates, U(i), U(m), weight, U(k), U(n))
                    if both:
                        left, right = templates[i : i + n], templates[m : m + n]
                        here = slice(k, k + n)
                        products = shared_run(left, right, weight[here], ratio[here], products)
            h[known.place[e]] += total
            for m in range(6):
                visit.mixed[e, m] += products[m]


@leaf()
def _sum_up(frame, given_noise, w, visit, fluxes, expanded):
    """Render the sources with these fluxes and sum g and H, without the prior's share."""
    layout, boxes, place = visit.layout, visit.boxes, visit.templates.at
    fp, (noise, background) = layout.footprints, given_noise
    visit.g[:] = 0.0
    visit.h[:] = 0.0
    visit.own[:] = 0.0
    visit.mixed[:] = 0.0
    for top in range(0, frame.ny, BAND):
        last = min(top + BAND, frame.ny)
        used = 0
        for s in range(fluxes.size):
            begin, end = max(top, boxes[s, 0]), min(last, boxes[s, 1])
            if begin >= end:
                continue
            p, q = fp.first[s] + begin - boxes[s, 0], fp.first[s] + end - boxes[s, 0]
            for i in range(p, q):
                place[i] = used + fp.start[i] - fp.start[p]
            used += fp.start[q] - fp.start[p]
            add_source(layout, s, (p, q), fluxes[s], visit.canvas, visit.templates)
        rows = background, (top, last)
        if expanded:
            weigh_rows(frame, noise, w, rows, w.weight, w.ratio)
        else:
            weigh_rows(frame, noise, w, rows, w.weight, None)
        _multiply_band(w, visit, top, last)


@inner()
def _newton(visit, clusters, shape, scale, fluxes):
    """One Newton step of the fluxes; returns the extrapolated terms and D, NaN if it fails."""
    value, change = 0.0, 0.0
    constant = 0.5 * math.log(2.0 * math.pi) - math.lgamma(shape)
    for c in range(clusters.first.size - 1):
        group = one_cluster(clusters, c, 1)
        lower, start = visit.h[clusters.begin[c] : clusters.begin[c + 1]], group.start
        step = np.empty(group.members.size)
        for i in range(step.size):
            s = group.members[i]
            lower[start[i] + i] += shape
            visit.g[s] += shape - fluxes[s] / scale[s]
            step[i] = visit.g[s]
        if not cholesky(lower, group):
            return math.nan, math.nan
        solve(lower, group, step)
        for i in range(step.size):
            s = group.members[i]
            value += shape * math.log(fluxes[s] / scale[s]) - fluxes[s] / scale[s]
            value += constant - math.log(lower[start[i] + i])
            value += (0.5 * visit.g[s] - visit.known.slope[s]) * step[i]
            change += abs(step[i])
            fluxes[s] *= 1.0 + step[i]
    return value, change


@inner()
def _next_term(visit, shape):
    """The sum of c of `expansion.py`."""
    known, own, mixed, slopes = visit.known, visit.own, visit.mixed, np.empty(12)
    alone, value = np.zeros(visit.g.size), 0.0
    for s in range(alone.size):
        if visit.faint[s]:
            alone[s] = single(own[s], shape, slopes)
            value += alone[s]
    for s in range(alone.size):
        for e in range(known.first[s], known.last[s]):
            t = known.other[e]
            if visit.faint[s] and visit.faint[t]:
                value += pair(own[s], own[t], mixed[e], shape, slopes) - alone[s] - alone[t]
    return value


@leaf()
def _are_positive(fluxes):
    positive = 0
    for flux in fluxes:
        positive += flux > 0.0
    return positive == fluxes.size


@inner()
def profile_extrapolated(problem, w, parameters, fluxes, known):
    """The log-likelihood; NaN where the fluxes are too far from the maximum.

    The caller clears the workspace.
    """
    o, frame, nuisances = problem.optics, problem.frame, parameters.nuisances
    geometry = new_geometry(o)
    if not locate(o, parameters.theta, nuisances, geometry):
        return -math.inf
    if not _are_positive(fluxes):
        return math.nan
    fp, clusters = counted(frame, o, geometry), known.clusters
    layout = layout_of(o, geometry, fp, nuisances.psf_sigma)
    mark(frame, fp, w)
    visit = _Visit(
        layout,
        bounding_boxes(fp),
        Canvas(w.image, row_starts(fp, w.image.size // o.ny)),
        Canvas(room(w, 0, fp.start[fp.row.size]), np.empty(fp.row.size, np.int64)),
        known,
        np.empty(fluxes.size),
        np.empty(clusters.begin[-1]),
        problem.faint,
        np.empty((fluxes.size, 3)),
        np.empty((known.other.size, 6)),
    )
    given_noise = given(frame.noise, parameters), parameters.background
    scale, expanded = problem.flux / problem.shape, np.any(problem.faint)
    for i in range(VISITS):
        if i > 0:
            w.image[:] = 0.0
        _sum_up(frame, given_noise, w, visit, fluxes, expanded)
        value, change = _newton(visit, clusters, problem.shape, scale, fluxes)
        if change < ENOUGH:
            value += _next_term(visit, problem.shape)
            return value + log_likelihood(frame, w, parameters)
        if not (change < 0.5 * fluxes.size and _are_positive(fluxes)):
            break
    return math.nan
