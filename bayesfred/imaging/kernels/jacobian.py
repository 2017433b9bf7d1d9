"""Derivatives of an image with respect to the coefficients and to what else moves, scales or widens its sources."""

from typing import NamedTuple

import numba as nb
import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE
from bayesfred.imaging.kernels.geometry import footprints, locate, new_maps, new_work
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row
from bayesfred.imaging.kernels.psf_profiles import psf_bends, psf_slopes


class Basis(NamedTuple):
    """What derivatives are made of: the unit-flux kernel's derivative with respect to single monomials of f and g.

    d K / d theta_k of a source is lever[s, k] times row[k] of the basis: first the monomials u^m
    v^n of f, then those of g, then K itself (flux), then dK/dsigma.
    """

    f: Ints  # (., 2) powers of u and v
    g: Ints
    row: Ints  # (parameters,)
    lever: Floats  # (s, parameters)


@nb.njit(inline="always")
def _polynomial_row(out, ramp, t0, coefficients, degree):
    """out[i] = a polynomial at t = t0 + ramp[i]."""
    top = len(degree)
    for i in range(out.size):
        t = t0 + ramp[i]
        p = coefficients[top]
        for m in range(top):
            p = p * t + coefficients[top - 1 - m]
        out[i] = p


@nb.njit(inline="always")
def _times_polynomial(out, source, factor, ramp, t0, coefficients, degree):
    """out[i] = factor times source[i] times a polynomial at t = t0 + ramp[i]."""
    top = len(degree)
    for i in range(out.size):
        t = t0 + ramp[i]
        p = coefficients[top]
        for m in range(top):
            p = p * t + coefficients[top - 1 - m]
        out[i] = p * factor * source[i]


@nb.njit(inline="always")
def _slopes_row(psf, sigma, weight, p, a, b):
    """From a and b to weight times p, p_a and p_b."""
    for i in range(p.size):
        k, x, y = psf_slopes(psf, sigma, a[i], b[i])
        p[i], a[i], b[i] = weight * k, -weight * x, -weight * y


@nb.njit(inline="always")
def _bends_row(psf, sigma, weight, along_a, p, a, b):
    """The same for -p_a, or for -p_b, in place of p."""
    for i in range(p.size):
        x, y, xx, xy, yy = psf_bends(psf, sigma, a[i], b[i])
        p[i] = weight * (x if along_a else y)
        a[i], b[i] = -weight * (xx if along_a else xy), -weight * (xy if along_a else yy)


@nb.njit(inline="always")
def _times_determinant(p, size, signed):
    """From D in `signed` to size = p |D| and p sign(D)."""
    for i in range(p.size):
        size[i] = p[i] * abs(signed[i])
        signed[i] = p[i] if signed[i] > 0.0 else -p[i]


@nb.njit(inline="always")
def _times_absolute(a, b, d):
    for i in range(d.size):
        a[i] *= abs(d[i])
        b[i] *= abs(d[i])


@nb.njit(inline="always")
def _add_widening(out, size, order, along_a, along_b, sigma, ramp, t0, ra, rb, degree):
    """Add dP/dsigma = -(order P + a P_a + b P_b) / sigma, P being homogeneous of degree -order in a, b and sigma."""
    top = len(degree)
    for i in range(out.size):
        t = t0 + ramp[i]
        a, b = ra[top], rb[top]
        for m in range(top):
            a = a * t + ra[top - 1 - m]
            b = b * t + rb[top - 1 - m]
        out[i] -= (order * size[i] + a * along_a[i] + b * along_b[i]) / sigma


@inner(fastmath=FAST, error_model="numpy")
def _samples_row(
    psf,
    sigma,
    weight,
    template,
    ramp,
    t,
    ra,
    rb,
    rd,
    degree,
    d_degree,
    e,
    size,
    signed,
    along_a,
    along_b,
):
    """P |D|, s P, P_a |D| and P_b |D| of a template at u - u_peak from t on, the names being those of `basis_row`."""
    _polynomial_row(along_a, ramp, t, ra, degree)
    _polynomial_row(along_b, ramp, t, rb, degree)
    if template == 0:
        _slopes_row(psf, sigma, weight, e, along_a, along_b)
    else:
        _bends_row(psf, sigma, weight, template == 1, e, along_a, along_b)
    _polynomial_row(signed, ramp, t, rd, d_degree)
    _times_absolute(along_a, along_b, signed)
    _times_determinant(e, size, signed)


@nb.njit(inline="always")
def _add_row_of(out, row):
    for i in range(row.size):
        out[i] += row[i]


@nb.njit(inline="always")
def _powers_row(powers, ramp, u0, n):
    """powers[m] = u^m at u = u0 + ramp[i]."""
    powers[0, :n] = 1.0
    for m in range(1, powers.shape[0]):
        before, row = powers[m - 1], powers[m]
        for i in range(n):
            row[i] = before[i] * (u0 + ramp[i])


@nb.njit(inline="always")
def _add_monomials(basis_powers, v, n, along, first, second, powers, out, start):
    """Rows of the basis from `start` on: B along + B_u first + B_v second for the monomials B = u^m v^q of f (or of g)."""
    for k in range(basis_powers.shape[0]):
        m = basis_powers[k, 0]
        q = basis_powers[k, 1]
        vq = v**q
        by = q * v ** (q - 1) if q > 0 else 0.0
        row, power = out[start + k], powers[m]
        for i in range(n):
            row[i] += power[i] * (vq * along[i] + by * second[i])
        if m > 0:
            bx = m * vq
            lower = powers[m - 1]
            for i in range(n):
                row[i] += bx * lower[i] * first[i]


@inner(fastmath=FAST, error_model="numpy")
def basis_row(o, maps, basis, s, j, low, n, sigma, template, out, samples, powers, work):
    """out[:, :n] = the basis of a unit source in n pixels of row j from pixel `low` on.

    An f-term changes a by B, hence p by p_a B and D = a_u b_v - a_v b_u by B_u b_v - B_v b_u; a
    g-term changes b, hence p by p_b B and D by B_v a_u - B_u a_v. With P = weight p and s = sign(D)
    the rows of `samples` are P, P |D|, s P, P_a |D|, P_b |D|, s P b_v, -s P b_u, -s P a_v, s P a_u.

    Template 0 is the kernel K itself. Templates 1 and 2 are its derivatives as the source is
    shifted along a and along b, X = -p_a |D| and Y = -p_b |D|: the same with p replaced by -p_a or
    by -p_b. The number comes as an np.int64: of a literal one this function would be compiled anew.
    """
    ra, rb, rav, rbv, rd, slope = work[0], work[1], work[2], work[3], work[4], work[5]
    ramp, conserve = o.ramp, len(o.d_degree) > 0
    n_f, n_g = basis.f.shape[0], basis.g.shape[0]
    for k in range(out.shape[0]):
        out[k, :n] = 0.0
    order = 2.0 if template == 0 else 3.0
    widens = (
        basis.row.size > 0 and basis.row[-1] == n_f + n_g + 1
    )  # the width is the last parameter, if it is one
    v_row = (j - 0.5 * (o.ny - 1)) * o.step
    u_row = (low - 0.5 * (o.nx - 1)) * o.step
    e, size, signed, along_a, along_b = (
        samples[0, :n],
        samples[1, :n],
        samples[2, :n],
        samples[3, :n],
        samples[4, :n],
    )
    f_u, f_v, g_u, g_v = samples[5, :n], samples[6, :n], samples[7, :n], samples[8, :n]
    row_k, row_s = out[n_f + n_g, :n], out[n_f + n_g + 1, :n]
    top = len(o.degree)
    slope[:] = 0.0
    for q in range(o.offsets.size):
        v = v_row + o.offsets[q]
        map_on_row(maps.a[s], maps.b[s], v - maps.peak[s, 1], ra, rb, rav, rbv, o.degree)
        polynomial_on_row(maps.d[s], v - maps.peak[s, 1], 1.0, rd, o.d_degree)
        for p in range(o.offsets.size):
            u = u_row + o.offsets[p]
            t = u - maps.peak[s, 0]
            weight = o.weights[q] * o.weights[p] * o.psf.norm / (sigma * sigma)
            _samples_row(
                o.psf,
                sigma,
                weight,
                template,
                ramp,
                t,
                ra,
                rb,
                rd,
                o.degree,
                o.d_degree,
                e,
                size,
                signed,
                along_a,
                along_b,
            )
            if conserve:
                _times_polynomial(f_u, signed, 1.0, ramp, t, rbv, o.degree)
                _times_polynomial(g_u, signed, -1.0, ramp, t, rav, o.degree)
                for m in range(top):
                    slope[m] = -(m + 1) * rb[m + 1]
                _times_polynomial(f_v, signed, 1.0, ramp, t, slope, o.degree)
                for m in range(top):
                    slope[m] = (m + 1) * ra[m + 1]
                _times_polynomial(g_v, signed, 1.0, ramp, t, slope, o.degree)
            else:
                samples[5:] = 0.0
            _add_row_of(row_k, size)
            if widens:
                _add_widening(
                    row_s, size, order, along_a, along_b, sigma, ramp, t, ra, rb, o.degree
                )
            _powers_row(powers, ramp, u, n)
            _add_monomials(basis.f, v, n, along_a, f_u, f_v, powers, out, 0)
            _add_monomials(basis.g, v, n, along_b, g_u, g_v, powers, out, n_f)


@inner(fastmath=REDUCE)
def _weigh_row(weight, size, a, b, e):
    """Multiply a, b and e by the weight; returns the sum of weight times size."""
    total = 0.0
    for i in range(weight.size):
        total += weight[i] * size[i]
        a[i] *= weight[i]
        b[i] *= weight[i]
        e[i] *= weight[i]
    return total


@inner(fastmath=REDUCE)
def _two_moments(power, ramp, t0, a, b, e, out):
    """Sums of a, b and e times power and times power t, at t = t0 + ramp[i], into the columns of out; power becomes power t^2."""
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


@inner()
def _multiply_out(e, a, b, degree, f_u, f_v, g_u, g_v):
    """From sums over t^m w^n times E, e[m, n], to those times b_v E, -b_u E, -a_v E and a_u E."""
    top = len(degree)
    for m in range(top + 1):
        for n in range(top + 1):
            f_u[m, n], f_v[m, n], g_u[m, n], g_v[m, n] = 0.0, 0.0, 0.0, 0.0
            for i in range(top + 1):
                for k in range(top):
                    f_u[m, n] += (k + 1) * b[i, k + 1] * e[m + i, n + k]
                    f_v[m, n] -= (k + 1) * b[k + 1, i] * e[m + k, n + i]
                    g_u[m, n] -= (k + 1) * a[i, k + 1] * e[m + i, n + k]
                    g_v[m, n] += (k + 1) * a[k + 1, i] * e[m + k, n + i]


@inner()
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


@inner()
def _add_sums(basis_powers, along, first, second, out):
    """Add to out the sums over B along + B_u first + B_v second for the monomials B = u^m v^n of f (or of g)."""
    for k in range(basis_powers.shape[0]):
        m, n = basis_powers[k, 0], basis_powers[k, 1]
        out[k] += along[m, n]
        if m > 0:
            out[k] += m * first[m - 1, n]
        if n > 0:
            out[k] += n * second[m, n - 1]


@inner(fastmath=FAST, error_model="numpy")
def add_basis_sums(o, maps, fp, basis, s, sigma, template, weight, out, samples, sums, work):
    """Add to out[k] the sum over a source's pixels of weight times row k of the basis, see `basis_row`.

    About the source's peak a_u, a_v, b_u and b_v are polynomials in t and w. So the sums follow,
    however many monomials there are, from those over t^m w^n times A = weight P_a |D|, B = weight
    P_b |D| and E = weight s P: `sums`, which holds beside them what `_multiply_out` makes of the
    last.
    """
    top, rows = len(o.degree), range(fp.first[s], fp.first[s + 1])
    n_f, n_g = basis.f.shape[0], basis.g.shape[0]
    order = 2.0 if template == 0 else 3.0
    widens = basis.row.size > 0 and basis.row[-1] == n_f + n_g + 1
    a, b, d, h, k = maps.a[s], maps.b[s], maps.d[s], maps.peak[s, 0], maps.peak[s, 1]
    ra, rb, rav, rbv, rd, moments = work[0], work[1], work[2], work[3], work[4], work[5:8]
    begin, ramp, offsets = fp.start[fp.first[s]], o.ramp, o.offsets
    sums[:] = 0.0
    flux = 0.0
    for r in rows:
        n = fp.size[r]
        own = weight[fp.start[r] - begin : fp.start[r] - begin + n]
        e, size, signed = samples[0, :n], samples[1, :n], samples[2, :n]
        along_a, along_b, power = samples[3, :n], samples[4, :n], samples[5, :n]
        for q in range(offsets.size):
            w = (fp.row[r] - 0.5 * (o.ny - 1)) * o.step + offsets[q] - k
            map_on_row(a, b, w, ra, rb, rav, rbv, o.degree)
            polynomial_on_row(d, w, 1.0, rd, o.d_degree)
            for p in range(offsets.size):
                t = (fp.low[r] - 0.5 * (o.nx - 1)) * o.step + offsets[p] - h
                norm = o.weights[q] * o.weights[p] * o.psf.norm / (sigma * sigma)
                _samples_row(
                    o.psf,
                    sigma,
                    norm,
                    template,
                    ramp,
                    t,
                    ra,
                    rb,
                    rd,
                    o.degree,
                    o.d_degree,
                    e,
                    size,
                    signed,
                    along_a,
                    along_b,
                )
                flux += _weigh_row(own, size, along_a, along_b, signed)
                power[:] = 1.0
                for m in range(0, 2 * top, 2):
                    _two_moments(power, ramp, t, along_a, along_b, signed, moments[:, m:])
                factor = 1.0
                for i in range(2 * top):
                    for m in range(2 * top):
                        sums[0, m, i] += factor * moments[0, m]
                        sums[1, m, i] += factor * moments[1, m]
                        sums[2, m, i] += factor * moments[2, m]
                    factor *= w
    out[n_f + n_g] += flux
    if widens:
        wide = order * flux
        for m in range(top + 1):
            for i in range(top + 1):
                wide += a[m, i] * sums[0, m, i] + b[m, i] * sums[1, m, i]
        out[n_f + n_g + 1] -= wide / sigma
    if len(o.d_degree) > 0:
        _multiply_out(sums[2], a, b, o.degree, sums[3], sums[4], sums[5], sums[6])
    for i in range(7):
        _shift_sums(sums[i], h, k, o.degree)
    _add_sums(basis.f, sums[0], sums[3], sums[4], out[:n_f])
    _add_sums(basis.g, sums[1], sums[5], sums[6], out[n_f : n_f + n_g])


@inner(fastmath=FAST)
def add_jacobian_rows(o, maps, fp, basis, flux, sigma, first, last, out):
    """Add the derivatives of rows first..last-1 to out (parameters, rows, padded row)."""
    work = new_work(o)
    width = out.shape[2]
    rows = np.empty((basis.f.shape[0] + basis.g.shape[0] + 2, width))
    samples = np.empty((9, width))
    powers = np.empty((len(o.degree) + 1, width))
    for s in range(o.x.size):
        if maps.rows[s, 0] >= last or maps.rows[s, 1] <= first:
            continue
        for p in range(fp.first[s], fp.first[s + 1]):
            j, low, n = fp.row[p], fp.low[p], fp.size[p]
            if not first <= j < last:
                continue
            basis_row(o, maps, basis, s, j, low, n, sigma, np.int64(0), rows, samples, powers, work)
            for k in range(basis.row.size):
                c = flux[s] * basis.lever[s, k]
                if c != 0.0:
                    source = rows[basis.row[k]]
                    target = out[k, j - first, low : low + n]
                    for i in range(n):
                        target[i] += c * source[i]


@entry()
def jacobian(o, theta, sigma, flux, basis, out):
    """d image / d parameters into out (parameters, ny, padded row)."""
    maps = new_maps(o)
    locate(o, theta, 0.0, 0.0, sigma, 0.0, maps)
    add_jacobian_rows(o, maps, footprints(o, maps), basis, flux, sigma, 0, o.ny, out)
