"""The part of the gradient that is the derivative of Laplace's integral.

Its derivation is that of `gradient.py`.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import inner, leaf
from bayesfred.imaging.kernels.contexts import Basis, Canvas, Layout
from bayesfred.imaging.kernels.geometry import row_starts
from bayesfred.imaging.kernels.jacobian import Rows, new_rows, second_derivatives
from bayesfred.model.kernels.clusters import (
    DOF,
    SHARE,
    Prior,
    add_block,
    add_prior,
    add_template,
    bend_prior,
    gram,
    one_cluster,
    shift_prior,
    touch,
)
from bayesfred.model.kernels.contexts import Nearby, Touching
from bayesfred.model.kernels.expansion import Pixels, add_slopes, expand
from bayesfred.model.kernels.factors import cholesky, invert, solve
from bayesfred.model.kernels.likelihood import blank


class _Adjoint(NamedTuple):
    """What the derivative of the Laplace term is made of."""

    layout: Layout
    touching: Touching
    fluxes: Floats
    score: Floats
    weight: Floats
    response: Floats  # -dr/dmu
    at: Ints  # where the footprints' rows begin in the padded frame
    mixed: Floats  # the templates q = Q T
    light: Floats  # (samples,) dc/dT over W
    rows: Rows
    bends: Floats  # (s, 6) what sources' blocks of G have beyond those of H, less the prior's


@inner()
def _constants():
    """The basis of the monomial 1: its rows are -dT/d dx, -dT/d dy, T and dT/dsigma of T."""
    one = np.zeros((1, 2), np.int64)
    return Basis(one, one, np.empty(0, np.int64), np.empty((0, 0)))


@leaf()
def _add_mixed(touching, s, t, column, out):
    """Add sum_b column[b] T_b of source t, where it overlaps source s, to out, a template of s."""
    fp, boxes, stamps = touching.footprints, touching.boxes, touching.stamps
    firsts, lows, sizes, starts = fp.first, fp.low, fp.size, fp.start
    for j in range(max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])):
        p = firsts[s] + j - boxes[s, 0]
        q = firsts[t] + j - boxes[t, 0]
        first = max(lows[p], lows[q])
        last = min(lows[p] + sizes[p], lows[q] + sizes[q])
        ps, qs = starts[p] - lows[p], starts[q] - lows[q]
        for b in range(stamps.shape[0]):
            for k in range(first, last):
                out[ps + k] += column[b] * stamps[b, qs + k]


@inner()
def _mix(adjoint, group, lower):
    """Add a cluster's q = Q T to `mixed`; returns the diagonal of Q."""
    boxes, members, mixed = adjoint.touching.boxes, group.members, adjoint.mixed
    lead, start, touching, size = group.lead, group.start, adjoint.touching, mixed.shape[0]
    q, column, diagonal = invert(lower, group), np.empty(size), np.empty(lead.size)
    for i in range(lead.size):
        s = members[i // size]
        diagonal[i] = q[start[i] + i]
        for m in range(lead[i] // size, members.size):
            t = members[m]
            if boxes[t, 0] >= boxes[s, 1]:
                break
            if touch(boxes, s, t):
                for b in range(size):
                    k = m * size + b
                    column[b] = q[start[max(i, k)] + min(i, k)]
                _add_mixed(touching, s, t, column, mixed[i % size])
    return diagonal


@inner()
def _second_derivatives(adjoint, group, i, part, g):
    """Add what a source's K_xx, K_xy, K_yy, and X, Y as dK, give to its rows of e and G."""
    fp, stamps, mixed = adjoint.touching.footprints, adjoint.touching.stamps, adjoint.mixed
    ats, score, weights, s = adjoint.at, adjoint.score, adjoint.weight, group.members[i]
    starts, sizes, flux = fp.start, fp.size, adjoint.fluxes[s]
    second = second_derivatives(adjoint.layout, adjoint.rows, s, flux)
    bends, more = adjoint.bends[s], np.zeros(6)
    for p in range(fp.first[s], fp.first[s + 1]):
        begin = starts[p] - starts[fp.first[s]]
        for k in range(sizes[p]):
            at, pixel, own = starts[p] + k, ats[p] + k, begin + k
            xx, xy, yy = second[0, own], second[1, own], second[2, own]
            x, y = stamps[1, at] / flux, stamps[2, at] / flux
            r, weight = score[pixel], weights[pixel]
            q0, q1, q2 = mixed[0, at], mixed[1, at], mixed[2, at]
            part[0] -= weight * (q1 * x + q2 * y)
            part[1] -= weight * (q0 * x + q1 * xx + q2 * xy)
            part[2] -= weight * (q0 * y + q1 * xy + q2 * yy)
            bends[1] -= r * x
            bends[2] -= r * y
            bends[3] -= r * xx
            bends[4] -= r * xy
            bends[5] -= r * yy
            beyond, n = adjoint.response[pixel] - weight, 0
            for a in range(3):
                for b in range(a, 3):
                    more[n] += beyond * stamps[a, at] * stamps[b, at]
                    n += 1
    add_block(i, group.start, g, bends)
    bends += more


@inner()
def _fill_part(adjoint, group, shape, ratio, h, part):
    """Fill e with a cluster's sums over pixels, h and q including what the term c adds to them."""
    fp, stamps, at = adjoint.touching.footprints, adjoint.touching.stamps, adjoint.at
    size, mixed, members, fluxes = stamps.shape[0], adjoint.mixed, group.members, adjoint.fluxes
    first, starts, sizes = fp.first, fp.start, fp.size
    for s in members:
        for p in range(first[s], first[s + 1]):
            for t in range(size):
                for k in range(sizes[p]):
                    h[at[p] + k] += stamps[t, starts[p] + k] * mixed[t, starts[p] + k]
    pixels, light = Pixels(adjoint.weight, ratio, at), adjoint.light
    _, slopes = expand(adjoint.touching, group, fluxes, shape, pixels)
    add_slopes(adjoint.touching, group, fluxes, pixels, slopes, (h, light))
    for i in range(part.size):
        s, t = members[i // size], i % size
        part[i] = 0.0
        for p in range(first[s], first[s + 1]):
            for k in range(sizes[p]):
                pixel, own = at[p] + k, starts[p] + k
                change = ratio[pixel] * h[pixel] + (light[own] if t == 0 else 0.0)
                part[i] += adjoint.weight[pixel] * change * stamps[t, own]
                if t == 0:
                    mixed[0, own] -= fluxes[s] * light[own]


@inner()
def _bend(adjoint, group, scattered, part, g, scatters):
    """Add all second derivatives of a cluster, those of the shifts' prior included."""
    if scatters is not None:
        prior, shifts = scattered
        for i in range(group.members.size):
            _second_derivatives(adjoint, group, i, part[3 * i : 3 * i + 3], g)
            xx, xy, yy = bend_prior(shifts[group.members[i]], prior.scatter)
            add_block(i, group.start, g, (0.0, 0.0, 0.0, xx, xy, yy))


@inner()
def _hessian(adjoint, group, prior, shifts, part, lower):
    """Cholesky's factor of G; it is positive definite at a maximum, elsewhere H has to do."""
    g = np.empty(lower.size)
    gram(adjoint.touching, group, adjoint.response, adjoint.at, g)
    add_prior(g, group, prior, adjoint.fluxes, shifts, SHARE)
    if adjoint.mixed.shape[0] > 1:
        _bend(adjoint, group, (prior, shifts), part, g, adjoint.touching.scatters)
    return g if cholesky(g, group) else lower


@inner()
def laplace_adjoint(w, layout, rendered, profiled, scatter, response):
    """z, the templates q, the images h and y and the derivative by tau of the derivation."""
    if profiled is None:
        none, nothing = np.empty(0), np.empty((1, 0))
        nearby = Nearby(nothing, none, nothing)
        return np.zeros((rendered.fluxes.size, 1)), nothing, none, none, 0.0, nearby
    touching, flux, shift = profiled.touching, rendered.fluxes, profiled.shifts
    shape = profiled.shape
    fp, clusters, stamps = touching.footprints, touching.clusters, touching.stamps
    size, pitch = stamps.shape[0], w.image.size // w.span.shape[0]
    h, y, z = blank(w, w.images[0]), blank(w, w.images[1]), np.empty((flux.size, size))
    at, mixed, light = row_starts(fp, pitch), np.zeros(stamps.shape), np.zeros(stamps.shape[1])
    rows = new_rows(layout, _constants(), pitch)
    curve = w.weight if response.size == 0 else response
    nearby = Nearby(np.empty(z.shape), np.zeros(flux.size), np.zeros((flux.size, 6)))
    adjoint = _Adjoint(
        layout, touching, flux, w.score, w.weight, curve, at, mixed, light, rows, nearby.bends
    )
    prior = Prior(shape, scatter if size > 1 else 0.0)
    slope = 0.0
    for c in range(clusters.first.size - 1):
        group = one_cluster(clusters, c, size)
        lower = profiled.factors[clusters.begin[c] : clusters.begin[c + 1]]
        diagonal = _mix(adjoint, group, lower)
        part = np.empty(diagonal.size)
        _fill_part(adjoint, group, shape, w.ratio, h, part)
        for i in range(0, part.size, size):
            own = flux[group.members[i // size]]
            part[i] += shape * diagonal[i] / own**3 - 1.0 / own
        if size > 1 or response.size > 0:
            lower = _hessian(adjoint, group, prior, shift, part, lower)
        for i in range(part.size):
            s, t = group.members[i // size], i % size
            nearby.e[s, t] = part[i]
            if t > 0:
                ratio, k = shift_prior(shift[s], scatter)
                more = (diagonal[i - t + 1] + diagonal[i - t + 2]) * SHARE * k
                part[i] += more * shift[s, t - 1] / (DOF * scatter**2 * (1.0 + ratio))
                nearby.spread[s] += diagonal[i]
        solve(lower, group, part)
        for i in range(part.size):
            s, t = group.members[i // size], i % size
            z[s, t] = part[i]
            add_template(fp, (fp.first[s], fp.first[s + 1]), stamps[t], part[i], Canvas(y, at))
            if t > 0:
                d, (ratio, k) = shift[s, t - 1], shift_prior(shift[s], scatter)
                moved = (SHARE * diagonal[i] + 2.0 * part[i] * d) / (1.0 + ratio)
                slope += (k * (d * d + moved) - 1.0) / scatter
    return z, mixed, h, y, slope, nearby
