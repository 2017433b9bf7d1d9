"""Sums over a source's pixels of a weight times the derivatives of `jacobian.py`.

About the source's peak a_u, a_v, b_u and b_v are polynomials in t and w. So the sums follow,
however many monomials there are, from those over t^m w^n times A = weight P_a |D|, B = weight
P_b |D| and E = weight s P.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import inner, leaf, shared
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE
from bayesfred.imaging.kernels.geometry import one_source
from bayesfred.imaging.kernels.jacobian import (
    Line,
    Samples,
    new_sampler,
    of_source,
    pixel_grid,
    samples_row,
    widens,
)
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row
from bayesfred.imaging.kernels.products import lines_of, product_sums


class Sums(NamedTuple):
    """Buffers of `add_basis_sums`."""

    samples: Floats  # (6, row)
    moments: Floats  # (3, powers of t) on one row
    # (7, powers of t, powers of w) of A, B, E and of E times b_v, -b_u, -a_v, a_u
    sums: Floats
    out: Floats  # (monomials of f and g + 2,) the result


@inner()
def new_sums(o, basis, width):
    """Room for the sums of one source, whose rows have up to `width` pixels."""
    n, size = 2 * len(o.degrees.ab) + 1, basis.f.shape[0] + basis.g.shape[0] + 2
    return Sums(np.empty((6, width)), np.empty((3, n)), np.empty((7, n, n)), np.zeros(size))


@leaf(fastmath=REDUCE)
def _weigh_row(weight, samples):
    """Multiply A, B and E by the weight; returns the sum of weight times P |D|."""
    size, a, b, e = samples.size, samples.along_a, samples.along_b, samples.signed
    total = 0.0
    for i in range(weight.size):
        total += weight[i] * size[i]
        a[i] *= weight[i]
        b[i] *= weight[i]
        e[i] *= weight[i]
    return total


@leaf(fastmath=REDUCE)
def _two_moments(power, line, samples, out):
    """Sums of A, B and E times power and times power t into the columns of out.

    The power becomes power t^2.
    """
    a, b, e, ramp, t0 = samples.along_a, samples.along_b, samples.signed, line.ramp, line.t0
    a0, a1, b0, b1, e0, e1 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(power.size):
        t, p = t0 + ramp[i], power[i]
        q = p * t
        a0 += p * a[i]
        a1 += q * a[i]
        b0 += p * b[i]
        b1 += q * b[i]
        e0 += p * e[i]
        e1 += q * e[i]
        power[i] = q * t
    out[0, 0], out[0, 1], out[1, 0], out[1, 1], out[2, 0], out[2, 1] = a0, a1, b0, b1, e0, e1


@leaf()
def _multiply_out(sums, a, b, degree):
    """From sums over t^m w^n times E to those times b_v E, -b_u E, -a_v E and a_u E."""
    top, e = len(degree), sums[2]
    f_u, f_v, g_u, g_v = sums[3], sums[4], sums[5], sums[6]
    for m in range(top + 1):
        for n in range(top + 1):
            f_u[m, n], f_v[m, n], g_u[m, n], g_v[m, n] = 0.0, 0.0, 0.0, 0.0
            for i in range(top + 1):
                for k in range(top):
                    f_u[m, n] += (k + 1) * b[i, k + 1] * e[m + i, n + k]
                    f_v[m, n] -= (k + 1) * b[k + 1, i] * e[m + k, n + i]
                    g_u[m, n] -= (k + 1) * a[i, k + 1] * e[m + i, n + k]
                    g_v[m, n] += (k + 1) * a[k + 1, i] * e[m + k, n + i]


@leaf()
def _shift_sums(sums, h, k, degree):
    """From sums over t^m w^n to sums over (t + h)^m (w + k)^n, in place."""
    top = len(degree)
    for i in range(1, top + 1):
        for m in range(top, i - 1, -1):
            for n in range(top + 1):
                sums[m, n] += h * sums[m - 1, n]
    for i in range(1, top + 1):
        for n in range(top, i - 1, -1):
            for m in range(top + 1):
                sums[m, n] += k * sums[m, n - 1]


@leaf()
def _add_sums(basis_powers, along, first, second, out):
    """Add the sums over B along + B_u first + B_v second, B = u^m v^n of f (or of g), to out."""
    for k in range(basis_powers.shape[0]):
        m, n = basis_powers[k, 0], basis_powers[k, 1]
        out[k] += along[m, n]
        if m > 0:
            out[k] += m * first[m - 1, n]
        if n > 0:
            out[k] += n * second[m, n - 1]


@leaf()
def _add_moments(sums, moments, w):
    """Add a row's moments times w^k to the sums over t^m w^k."""
    size = sums.shape[1] - 1
    factor = 1.0
    for k in range(size):
        for m in range(size):
            sums[0, m, k] += factor * moments[0, m]
            sums[1, m, k] += factor * moments[1, m]
            sums[2, m, k] += factor * moments[2, m]
        factor *= w


@leaf(fastmath=FAST)
def _sample_sums(layout, source, rows, template, weight, buffers):
    """Fill the sums of A, B and E over these rows of the footprints; returns that of P |D|."""
    # what the rows share is taken out of the tuples once, see `Sampler`
    o, fp, sampler = layout.optics, layout.footprints, of_source(new_sampler(layout), source)
    lows, sizes, starts, numbers = fp.low, fp.size, fp.start, fp.row
    offsets, weights, ramp = o.offsets, o.weights, o.ramp
    middle_u, middle_v, step = pixel_grid(layout)
    sums, moments, buffer = buffers.sums, buffers.moments, buffers.samples
    work, degrees, d, u, v = sampler.work, sampler.degrees, source.d, source.u, source.v
    top, begin, flux = len(degrees.ab), starts[rows[0]], 0.0
    sums[:] = 0.0
    for i in range(rows[0], rows[1]):
        n = sizes[i]
        own = weight[starts[i] - begin : starts[i] - begin + n]
        samples = Samples(buffer[0, :n], buffer[1, :n], buffer[2, :n], buffer[3, :n], buffer[4, :n])
        power = buffer[5, :n]
        for q in range(offsets.size):
            w = (numbers[i] - middle_v) * step + offsets[q] - v
            map_on_row(source, w, work, degrees.ab)
            polynomial_on_row(d, w, 1.0, work[1], degrees.d)
            for p in range(offsets.size):
                line = Line(ramp, (lows[i] - middle_u) * step + offsets[p] - u)
                samples_row(sampler, weights[q] * weights[p], template, line, samples)
                flux += _weigh_row(own, samples)
                power[:] = 1.0
                for m in range(0, 2 * top, 2):
                    _two_moments(power, line, samples, moments[:, m:])
                _add_moments(sums, moments, w)
    return flux


@leaf()
def _add_weighted(place, basis, template, weight, buffers):
    layout, s, lines = place
    sums, out, degrees = buffers.sums, buffers.out, layout.optics.degrees
    source, fp, first = one_source(layout.geometry, s), layout.footprints, layout.footprints.first
    a, b, n_f, n_g = source.a, source.b, basis.f.shape[0], basis.g.shape[0]
    is_product, flux, by_a, by_b, wide = product_sums(lines, fp, s, template, weight)
    if is_product:
        for k in range(n_f):
            out[k] += by_a
        for k in range(n_f, n_f + n_g):
            out[k] += by_b
        out[n_f + n_g] += flux
        if widens(basis):
            out[n_f + n_g + 1] -= ((2.0 if template == 0 else 3.0) * flux + wide) / layout.sigma
        return
    flux = _sample_sums(layout, source, (first[s], first[s + 1]), template, weight, buffers)
    out[n_f + n_g] += flux
    if widens(basis):
        wide = (2.0 if template == 0 else 3.0) * flux
        for m in range(len(degrees.ab) + 1):
            for i in range(len(degrees.ab) + 1):
                wide += a[m, i] * sums[0, m, i] + b[m, i] * sums[1, m, i]
        out[n_f + n_g + 1] -= wide / layout.sigma
    if len(degrees.d) > 0:
        _multiply_out(sums, a, b, degrees.ab)
    for i in range(7):
        _shift_sums(sums[i], source.u, source.v, degrees.ab)
    _add_sums(basis.f, sums[0], sums[3], sums[4], out[:n_f])
    _add_sums(basis.g, sums[1], sums[5], sums[6], out[n_f : n_f + n_g])


@shared()
def add_basis_sums(layout, basis, s, template, weight, buffers):
    """Add to buffers.out[k] the sum over a source's pixels of weight times row k of the basis."""
    first = layout.footprints.first
    lines = lines_of(layout, s, first[s], first[s + 1])
    _add_weighted((layout, s, lines), basis, template, weight, buffers)
