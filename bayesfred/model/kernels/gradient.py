"""Exact gradient of the log-likelihood, the Laplace term included. F, K, B and H are those of `fluxes.py`.

Gradient of the Laplace term. Per pixel let r = n/mu - 1, W = n/mu^2, C = n/mu^3, and for sources s,
t let Q = H^-1, q_s = sum_t Q_st K_t, h = sum_s K_s q_s. Because dW = -2 C dmu and the maximising F
moves by dF = Q d(dL/dF), the chain rule gives for any parameter, with z = Q (sum_p C h K + Q_tt /
F_t^3) and y = sum_t z_t K_t,

    d log L = sum_p A dB + sum_s sum_p c_s dK_s,   A = r + C h - W y,   c_s = F_s A + z_s r - W q_s.

The 1/F_t^3 is the prior's share: it adds 1/F_t^2 to H. With fixed fluxes A = r and c_s = F_s r.

Free positions. With three templates T of every source this holds with q_t = sum_u Q_tu T_u, h =
sum_t T_t q_t, y = sum_t z_t T_t, and z = G^-1 e, where G is H with the second derivatives and e is
what moving phi does to -1/2 log det H:

    e_F = sum_p [C h K - W (q_1 X + q_2 Y)] + Q_00/F^3,    e_dx = sum_p [C h F X - W (q_0 X + q_1 F
    K_xx + q_2 F K_xy)],

e_dy likewise. Every source gives d log L the terms c_0 dK + c_1 dX + c_2 dY,

    c_0 = F A + z_0 r - W q_0,   c_1 = F (z_1 r - W q_1),   c_2 = F (z_2 r - W q_2),

and d log L/d tau = sum_s [(dx^2 + dy^2 + Q_11 + Q_22 + 2 z_1 dx + 2 z_2 dy)/tau^3 - 2/tau].
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.geometry import SEGMENT, new_work, row_starts
from bayesfred.imaging.kernels.jacobian import Basis, add_basis_sums, basis_row
from bayesfred.model.kernels.clusters import (
    add_block,
    cholesky,
    draw_template,
    gram,
    one_cluster,
    solve,
    touch,
)
from bayesfred.model.kernels.likelihood import (
    LIMIT,
    POISSON,
    background_row,
    log_likelihood,
    next_run,
)


class Rows(NamedTuple):
    """Buffers for a row of a basis."""

    out: Floats
    samples: Floats
    powers: Floats
    work: Floats


@inner()
def _new_rows(o, basis, width):
    rows = np.empty((basis.f.shape[0] + basis.g.shape[0] + 2, width))
    return Rows(rows, np.empty((9, width)), np.empty((len(o.degree) + 1, width)), new_work(o))


@inner()
def _constants():
    """The basis of the monomial 1: its rows are -dT/d dx, -dT/d dy, T and dT/dsigma of a template T."""
    one = np.zeros((1, 2), np.int64)
    return Basis(one, one, np.empty(0, np.int64), np.empty((0, 0)))


@inner()
def _weigh(counts, w, background, curve):
    """Score d log L/d mu and weight -d^2 log L/d mu^2 of every marked pixel; curve = -1/2 d weight/d mu."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    for j in range(ny):
        c0, c1, c2 = background_row(background, j, ny)
        start, stop = next_run(w.flags, w.span, per_row, j, w.span[j, 0])
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
                    w.score[p], w.weight[p], curve[p] = (
                        n / mu - 1.0,
                        n / (mu * mu),
                        n / (mu * mu * mu),
                    )
                else:
                    w.score[p], w.weight[p], curve[p] = (n - mu) / c0, 1.0 / c0, 0.0
            start, stop = next_run(w.flags, w.span, per_row, j, stop)


@inner()
def _mix(fp, boxes, members, lead, start, lower, stamps, out):
    """The templates q = Q T of a cluster's sources, added to `out`; returns the diagonal of Q."""
    size = stamps.shape[0]
    diagonal, column = np.empty(lead.size), np.empty(lead.size)
    for i in range(lead.size):
        s, a = members[i // size], i % size
        column[:] = 0.0
        column[i] = 1.0
        solve(lower, lead, start, column)
        diagonal[i] = column[i]
        for m in range(lead[i] // size, members.size):
            t = members[m]
            if boxes[t, 0] >= boxes[s, 1]:
                break
            if not touch(boxes, s, t):
                continue
            for j in range(max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])):
                p = fp.first[s] + j - boxes[s, 0]
                q = fp.first[t] + j - boxes[t, 0]
                first, last = (
                    max(fp.low[p], fp.low[q]),
                    min(fp.low[p] + fp.size[p], fp.low[q] + fp.size[q]),
                )
                ps, qs = fp.start[p] - fp.low[p], fp.start[q] - fp.low[q]
                for b in range(size):
                    for k in range(first, last):
                        out[a, ps + k] += column[m * size + b] * stamps[b, qs + k]
    return diagonal


@inner()
def _second_derivatives(o, w, drawn, s, sigma, mixed, constants, rows, part, i, start, g):
    """What a source's second derivatives K_xx, K_xy, K_yy and X, Y as dK add to its rows of e and G."""
    fp, stamps, flux = drawn.fitted.footprints, drawn.fitted.stamps, drawn.fitted.fluxes[s]
    pitch = w.image.size // w.span.shape[0]
    xx, xy, yy = np.empty(pitch), np.empty(pitch), np.empty(pitch)
    for p in range(fp.first[s], fp.first[s + 1]):
        j, low, n = fp.row[p], fp.low[p], fp.size[p]
        basis_row(
            o,
            drawn.maps,
            constants,
            s,
            j,
            low,
            n,
            sigma,
            np.int64(1),
            rows.out,
            rows.samples,
            rows.powers,
            rows.work,
        )
        xx[:n], xy[:n] = -flux * rows.out[0, :n], -flux * rows.out[1, :n]
        basis_row(
            o,
            drawn.maps,
            constants,
            s,
            j,
            low,
            n,
            sigma,
            np.int64(2),
            rows.out,
            rows.samples,
            rows.powers,
            rows.work,
        )
        yy[:n] = -flux * rows.out[1, :n]
        for k in range(n):
            at, pixel = fp.start[p] + k, j * pitch + low + k
            x, y = stamps[1, at] / flux, stamps[2, at] / flux
            r, weight = w.score[pixel], w.weight[pixel]
            q0, q1, q2 = mixed[0, at], mixed[1, at], mixed[2, at]
            part[0] -= weight * (q1 * x + q2 * y)
            part[1] -= weight * (q0 * x + q1 * xx[k] + q2 * xy[k])
            part[2] -= weight * (q0 * y + q1 * xy[k] + q2 * yy[k])
            add_block(i, start, g, -r * x, -r * y, -r * xx[k], -r * xy[k], -r * yy[k])


@inner()
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
        members, lead, start = one_cluster(clusters, c, size)
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
            gram(fp, boxes, members, lead, start, stamps, w.weight, at, g)
            for i in range(n):
                g[start[i] + i] += (
                    1.0 / flux[members[i // size]] ** 2 if i % size == 0 else 1.0 / scatter**2
                )
            for i in range(members.size):
                own = part[i * size : (i + 1) * size]
                _second_derivatives(
                    o, w, drawn, members[i], sigma, mixed, constants, rows, own, i, start, g
                )
            if cholesky(
                g, lead, start
            ):  # it is positive definite at a maximum; elsewhere H has to do
                lower = g
        solve(lower, lead, start, part)
        for i in range(n):
            s, t = members[i // size], i % size
            z[s, t] = part[i]
            draw_template(fp, s, stamps[t], part[i], at, y)
            if t > 0:
                d = shift[s, t - 1]
                slope += (d * d + diagonal[i] + 2.0 * part[i] * d) / scatter**3 - 1.0 / scatter
    for j in range(w.span.shape[0]):
        for p in range(
            j * pitch + w.span[j, 0] * SEGMENT, j * pitch + (w.span[j, 1] + 1) * SEGMENT
        ):
            if w.flags[p // SEGMENT]:
                h[p] = w.score[p] + curve[p] * h[p] - w.weight[p] * y[p]
    return z, mixed, h, slope


@inner()
def _background_gradient(counts, w, background, image, out):
    """Sum of the image times 1, u, v, u^2, uv, v^2 over the likelihood's pixels."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    pixels, rest = counts.pixels, counts.total
    for j in range(ny):
        v = (2 * j - ny + 1) / ny
        start, stop = next_run(w.flags, w.span, per_row, j, w.span[j, 0])
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
            start, stop = next_run(w.flags, w.span, per_row, j, stop)
    if pixels > 0.0:
        out[0] += (
            rest / background[0] - pixels
            if counts.kind == POISSON
            else (rest - background[0] * pixels) / background[0]
        )


@entry()
def gradient(o, counts, w, drawn, nuisances, background, free, basis, out, out_background):
    """Exact gradient of the log-likelihood: source parameters in `out`, background coefficients in `out_background`.

    Returns the derivative with respect to position_scatter, NaN where the likelihood is zero, and
    z.
    """
    if not drawn.extra + log_likelihood(counts, w, background) > -math.inf:
        return math.nan, np.empty((0, 0))
    maps, fp, fluxes, sigma = drawn.maps, drawn.fitted.footprints, drawn.fitted.fluxes, nuisances[3]
    size = drawn.fitted.stamps.shape[0]
    curve = np.empty(w.image.size)
    _weigh(counts, w, background, curve)
    image = w.score
    z, mixed, slope = np.zeros((fluxes.size, size)), np.empty((size, 0)), 0.0
    if free is not None:
        z, mixed, image, slope = _laplace_adjoint(o, w, drawn, sigma, nuisances[4], curve)
    _background_gradient(counts, w, background, image, out_background)
    pitch = w.image.size // o.ny
    most, reach = 0, 2 * len(o.degree) + 1
    for s in range(o.x.size):
        most = max(most, fp.start[fp.first[s + 1]] - fp.start[fp.first[s]])
    samples, work, sums = np.empty((6, pitch)), np.empty((8, reach)), np.empty((7, reach, reach))
    c, moments = np.empty(most), np.empty(basis.f.shape[0] + basis.g.shape[0] + 2)
    for s in range(o.x.size):
        moments[:] = 0.0
        begin = fp.start[fp.first[s]]
        for t in range(size):
            for p in range(fp.first[s], fp.first[s + 1]):
                q, n, at = fp.start[p], fp.size[p], fp.row[p] * pitch + fp.low[p]
                for k in range(n):
                    c[q - begin + k] = fluxes[s] * image[at + k] if t == 0 else 0.0
                if free is not None:
                    amplitude = 1.0 if t == 0 else fluxes[s]
                    for k in range(n):
                        c[q - begin + k] += amplitude * (
                            z[s, t] * w.score[at + k] - w.weight[at + k] * mixed[t, q + k]
                        )
            add_basis_sums(o, maps, fp, basis, s, sigma, t, c, moments, samples, sums, work)
        for k in range(basis.row.size):
            out[k] += basis.lever[s, k] * moments[basis.row[k]]
    return slope, z
