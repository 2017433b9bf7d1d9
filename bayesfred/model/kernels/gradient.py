"""Exact gradient of the log-likelihood, the integral over the fluxes included.

F, K, B and H are those of `fluxes.py`.

Gradient of that integral. Per pixel let r be the score, W = -dr/dmu and C = -1/2 dW/dmu; of
Poisson counts n/mu - 1, n/mu^2 and n/mu^3. For sources s, t let Q = H^-1, q_s = sum_t Q_st K_t, h =
sum_s K_s q_s. Because dW = -2 C dmu and the maximising F moves by dF = Q d(dL/dF), the chain rule
gives for any parameter, with z = Q (sum_p C h K + a Q_tt/F_t^3 - 1/F_t) and y = sum_t z_t K_t,

    d log L = sum_p A dB + sum_s sum_p c_s dK_s,   A = r + C h - W y,   c_s = F_s A + z_s r - W q_s.

The prior Gamma(a) adds a/F_t^2 to H, and the flux's logarithm -log F_t. The term c of
`expansion.py` adds dc/dmu to C h, K_t dc/dT_t to the sum in z, and -F_s/W dc/dT_s to q_s. With
fixed fluxes A = r and c_s = F_s r.

Free positions. With three templates T of every source this holds with q_t = sum_u Q_tu T_u, h =
sum_t T_t q_t, y = sum_t z_t T_t, and z = G^-1 e, where G is H with the second derivatives and e is
what moving phi does to -1/2 log det H:

    e_F = sum_p [C h K - W (q_1 X + q_2 Y)] + a Q_00/F^3 - 1/F,
    e_dx = sum_p [C h F X - W (q_0 X + q_1 F K_xx + q_2 F K_xy)],

e_dy likewise. Every source gives d log L the terms c_0 dK + c_1 dX + c_2 dY,

    c_0 = F A + z_0 r - W q_0,   c_1 = F (z_1 r - W q_1),   c_2 = F (z_2 r - W q_2),

With k, k' and rho of `fluxes.py`, G has k - 2 k dx^2 / nu tau^2 (1 + rho) and so on for the prior,
e_dx gains (Q_11 + Q_22) k' dx / nu tau^2 (1 + rho), and

    d log L/d tau = sum_s [k (dx^2 + dy^2) - 2 + (k' Q_11 + k' Q_22 + 2 k z_1 dx + 2 k z_2 dy) /
                    (1 + rho)] / tau.

Model error. The weight W of `model_error.py` is not -dr/dmu, which then replaces it in G and in W
y; and a change of the background is not that of the light. So the derivatives in the background and
the model error have an A of their own, of the derivatives of log L, W and r by these.
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner, leaf
from bayesfred.imaging.kernels.contexts import SEGMENT, Basis, Canvas, Layout
from bayesfred.imaging.kernels.geometry import layout_of, row_starts
from bayesfred.imaging.kernels.jacobian import Rows, new_rows, second_derivatives
from bayesfred.imaging.kernels.sums import add_basis_sums, new_sums
from bayesfred.model.kernels.clusters import (
    DOF,
    SHARE,
    Prior,
    add_block,
    add_prior,
    add_template,
    bend_prior,
    cholesky,
    gram,
    invert,
    one_cluster,
    shift_prior,
    solve,
    touch,
)
from bayesfred.model.kernels.contexts import LIMIT, Touching
from bayesfred.model.kernels.expansion import Pixels, add_slopes, expand
from bayesfred.model.kernels.likelihood import (
    U,
    add_background_sums,
    background_row,
    blank,
    log_likelihood,
    next_run,
    unreached_pixels,
    weigh_rows,
)
from bayesfred.model.kernels.noise_dispatch import (
    by_exactness,
    error_slopes,
    given,
    level_derivatives,
    unreached,
)


class _Amplitudes(NamedTuple):
    """What the weights c_t of the module's derivation are made of."""

    fluxes: Floats
    z: Floats  # (s, templates); zero where fluxes are fixed
    mixed: Floats  # the templates q = Q T; without samples where fluxes are fixed
    image: Floats  # A
    at: Ints  # where the footprints' rows begin in the padded frame


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
            add_block(i, group.start, g, (-r * x, -r * y, -r * xx, -r * xy, -r * yy))


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
def _hessian(adjoint, group, prior, shifts, part, lower):
    """Cholesky's factor of G; it is positive definite at a maximum, elsewhere H has to do."""
    size, g = adjoint.mixed.shape[0], np.empty(lower.size)
    gram(adjoint.touching, group, adjoint.response, adjoint.at, g)
    add_prior(g, group, prior, adjoint.fluxes, shifts, SHARE)
    for i in range(group.members.size if size > 1 else 0):
        _second_derivatives(adjoint, group, i, part[i * size : (i + 1) * size], g)
        xx, xy, yy = bend_prior(shifts[group.members[i]], prior.scatter)
        add_block(i, group.start, g, (0.0, 0.0, xx, xy, yy))
    return g if cholesky(g, group) else lower


@inner()
def _laplace_adjoint(w, layout, rendered, profiled, scatter, response):
    """z, the templates q, the images h and y and the derivative by tau of the derivation."""
    if profiled is None:
        none = np.empty(0)
        return np.zeros((rendered.fluxes.size, 1)), np.empty((1, 0)), none, none, 0.0
    touching, flux, shift = profiled.touching, rendered.fluxes, profiled.shifts
    shape = profiled.shape
    fp, clusters, stamps = touching.footprints, touching.clusters, touching.stamps
    size, pitch = stamps.shape[0], w.image.size // w.span.shape[0]
    h, y, z = blank(w, w.images[0]), blank(w, w.images[1]), np.empty((flux.size, size))
    at, mixed, light = row_starts(fp, pitch), np.zeros(stamps.shape), np.zeros(stamps.shape[1])
    rows = new_rows(layout, _constants(), pitch)
    curve = w.weight if response.size == 0 else response
    adjoint = _Adjoint(layout, touching, flux, w.score, w.weight, curve, at, mixed, light, rows)
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
            if size > 1:
                ratio, k = shift_prior(shift[group.members[i // size]], scatter)
                more = (diagonal[i + 1] + diagonal[i + 2]) * SHARE * k
                more /= DOF * scatter**2 * (1.0 + ratio)
                part[i + 1] += more * shift[group.members[i // size], 0]
                part[i + 2] += more * shift[group.members[i // size], 1]
        if size > 1 or response.size > 0:
            lower = _hessian(adjoint, group, prior, shift, part, lower)
        solve(lower, group, part)
        for i in range(part.size):
            s, t = group.members[i // size], i % size
            z[s, t] = part[i]
            add_template(fp, (fp.first[s], fp.first[s + 1]), stamps[t], part[i], Canvas(y, at))
            if t > 0:
                d, (ratio, k) = shift[s, t - 1], shift_prior(shift[s], scatter)
                moved = (SHARE * diagonal[i] + 2.0 * part[i] * d) / (1.0 + ratio)
                slope += (k * (d * d + moved) - 1.0) / scatter
    return z, mixed, h, y, slope


@inner()
def _wanted(profiled, w):
    """Where weights and ratios of the workspace are wanted; None where fluxes are fixed."""
    if profiled is None:
        return None, None
    return w.weight, w.ratio


def _no_responses(noise, frame, w, background):
    return np.empty(0)


def _light_responses(noise, frame, w, background):
    return _fill_responses(noise, frame, w, background)


# -dr/dmu of the marked pixels where the weight is not that.
_responses = by_exactness(_no_responses, _light_responses)


@inner()
def _fill_responses(noise, frame, w, background):
    out, pitch = blank(w, w.images[2]), w.image.size // frame.ny
    for j in range(frame.ny):
        c0, c1, c2 = background_row(background, j, frame.ny)
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                if frame.values[p] > LIMIT:
                    u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                    mu = w.image[p] + c0 + u * (c1 + u * c2)
                    out[p] = -error_slopes(noise, frame.values[p], mu, w.image[p], U(p))[0]
            start, stop = next_run(w, j, stop)
    return out


def _exact_images(noise, frame, w, background, h, y):
    if h.size == 0:  # fluxes are fixed
        return w.score, w.score, 0.0
    for k in range(w.flags.size):
        if w.flags[k] != 0:
            for p in range(k * SEGMENT, (k + 1) * SEGMENT):
                h[p] = w.score[p] + w.weight[p] * (w.ratio[p] * h[p] - y[p])
    return h, h, 0.0


def _light_images(noise, frame, w, background, h, y):
    return _fill_images(noise, frame, w, background, h, y)


# A of the light and of the background, and the sum that is the slope by the model error.
_images = by_exactness(_exact_images, _light_images)


@inner()
def _fill_images(noise, frame, w, background, h, y):
    profiled = h.size > 0
    light, level, slope = w.images[0], blank(w, w.images[3]), 0.0  # where h is, too
    pitch = w.image.size // frame.ny
    for j in range(frame.ny):
        c0, c1, c2 = background_row(background, j, frame.ny)
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                more = 0.0
                if frame.values[p] > LIMIT:
                    u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                    mu = w.image[p] + c0 + u * (c1 + u * c2)
                    by = error_slopes(noise, frame.values[p], mu, w.image[p], U(p))
                    a, b = (h[p], y[p]) if profiled else (0.0, 0.0)
                    curve = w.weight[p] * w.ratio[p] * a if profiled else 0.0
                    more = curve + by[0] * b
                    level[p] = by[1] + by[2] * a + by[3] * b
                    slope += by[4] + by[5] * a + by[6] * b
                light[p] = w.score[p] + more
            start, stop = next_run(w, j, stop)
    return light, level, slope


@leaf()
def _fill_weights(w, fp, a, s, t, out):
    """c_t of source s at every sample of its footprint."""
    flux, z, begin = a.fluxes[s], a.z[s, t], fp.start[fp.first[s]]
    image, mixed, score, weight, ats = a.image, a.mixed, w.score, w.weight, a.at
    amplitude = 1.0 if t == 0 else flux
    for p in range(fp.first[s], fp.first[s + 1]):
        n, at = fp.size[p], ats[p]
        own = out[fp.start[p] - begin : fp.start[p] - begin + n]
        for k in range(n):
            own[k] = flux * image[at + k] if t == 0 else 0.0
        if mixed.size > 0:
            template = mixed[t, fp.start[p] : fp.start[p] + n]
            for k in range(n):
                own[k] += amplitude * (z * score[at + k] - weight[at + k] * template[k])


@leaf()
def _add_sources(layout, basis, w, amplitudes, buffers, out):
    """Add the sums over all sources' pixels to the gradient."""
    sums, weights = buffers
    for s in range(amplitudes.fluxes.size):
        sums.out[:] = 0.0
        for t in range(amplitudes.z.shape[1]):
            _fill_weights(w, layout.footprints, amplitudes, s, t, weights)
            add_basis_sums(layout, basis, s, t, weights, sums)
        for k in range(basis.row.size):
            out[k] += basis.factors[s, k] * sums.out[basis.row[k]]


@entry()
def gradient(problem, w, rendered, parameters, basis, out):
    """Exact gradient of the log-likelihood.

    `out` are two arrays: for the source parameters and the background coefficients. Returns the
    derivatives with respect to position_scatter and model_error, NaN where the likelihood is zero,
    and z.
    """
    o, frame, background = problem.optics, problem.frame, parameters.background
    level, noise = background[0], given(frame.noise, parameters)
    value = log_likelihood(frame, w, parameters)
    if not rendered.extra + value > -math.inf:
        return (math.nan, math.nan), np.empty((0, 0))
    fp, pitch = rendered.footprints, w.image.size // o.ny
    layout = layout_of(o, rendered.geometry, fp, parameters.nuisances.psf_sigma)
    wanted = _wanted(rendered.profiled, w)
    weigh_rows(frame, noise, w, (background, (0, o.ny)), wanted[0], wanted[1])
    scatter, profiled = parameters.nuisances.position_scatter, rendered.profiled
    response = _responses(noise, frame, w, background)
    z, mixed, h, y, slope = _laplace_adjoint(w, layout, rendered, profiled, scatter, response)
    image, below, by_error = _images(noise, frame, w, background, h, y)
    add_background_sums(frame, w, below, out[1])
    out[1][0] += unreached(noise, unreached_pixels(frame, w), level)[1]
    out[1][0] += level_derivatives(frame.noise, frame.pixels, level, value)[0]
    most = 0
    for s in range(o.x.size):
        most = max(most, fp.start[fp.first[s + 1]] - fp.start[fp.first[s]])
    sums, weights = new_sums(o, basis, pitch), np.empty(most)
    amplitudes = _Amplitudes(rendered.fluxes, z, mixed, image, row_starts(fp, pitch))
    _add_sources(layout, basis, w, amplitudes, (sums, weights), out[0])
    return (slope, by_error), z
