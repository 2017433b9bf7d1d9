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
from bayesfred.imaging.kernels.contexts import SEGMENT, Basis
from bayesfred.imaging.kernels.geometry import layout_of, row_starts
from bayesfred.imaging.kernels.sums import add_basis_sums, new_sums
from bayesfred.model.kernels.contexts import LIMIT, Nearby
from bayesfred.model.kernels.laplace import laplace_adjoint
from bayesfred.model.kernels.likelihood import (
    U,
    add_background_sums,
    background_row,
    blank,
    log_likelihood,
    next_run,
    rise,
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
        row = background_row(background, j, frame.ny)
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                if frame.values[p] > LIMIT:
                    u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                    mu = w.image[p] + row[0] + rise(row, u)
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
        row = background_row(background, j, frame.ny)
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                more = 0.0
                if frame.values[p] > LIMIT:
                    u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                    mu = w.image[p] + row[0] + rise(row, u)
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
    """Add the sums over every source's pixels to its row."""
    sums, weights = buffers
    for s in range(amplitudes.fluxes.size):
        sums.out[:] = 0.0
        for t in range(amplitudes.z.shape[1]):
            _fill_weights(w, layout.footprints, amplitudes, s, t, weights)
            add_basis_sums(layout, basis, s, t, weights, sums)
        for k in range(sums.out.size):
            out[s, k] += sums.out[k]


def room_for(sources: int, basis: Basis) -> Floats:
    """What the sources' parts of the derivatives go into, shape (sources, rows of the basis)."""
    return np.zeros((sources, len(basis.f) + len(basis.g) + 2))


def from_sources(basis: Basis, parts: Floats) -> Floats:
    """The derivatives with respect to the source parameters, from those of `room_for`."""
    terms = (f @ parts[:, row] for f, row in zip(basis.factors.T, basis.row, strict=True))
    return np.fromiter(terms, np.float64, basis.row.size)


@entry()
def gradient(problem, w, rendered, parameters, basis, out):
    """Exact gradient of the log-likelihood.

    `out` are two arrays: for every source's part of the derivatives with respect to the basis, see
    `from_sources`, and for those with respect to the background coefficients. Returns the
    derivatives with respect to position_scatter and model_error, NaN where the likelihood is zero,
    and what helps to search nearby.
    """
    o, frame, background = problem.optics, problem.frame, parameters.background
    level, noise = background[0], given(frame.noise, parameters)
    value = log_likelihood(frame, w, parameters)
    if not rendered.extra + value > -math.inf:
        nothing = np.empty((0, 0))
        return (math.nan, math.nan), Nearby(nothing, np.empty(0), nothing)
    fp, pitch = rendered.footprints, w.image.size // o.ny
    layout = layout_of(o, rendered.geometry, fp, parameters.nuisances.psf_sigma)
    wanted = _wanted(rendered.profiled, w)
    weigh_rows(frame, noise, w, (background, (0, o.ny)), wanted[0], wanted[1])
    scatter, profiled = parameters.nuisances.position_scatter, rendered.profiled
    response = _responses(noise, frame, w, background)
    z, mixed, h, y, slope, nearby = laplace_adjoint(
        w, layout, rendered, profiled, scatter, response
    )
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
    return (slope, by_error), nearby
