"""Derivatives of an image: by coefficients, and by what else moves, scales or widens its sources.

An f-term changes a by B, hence p by p_a B and D = a_u b_v - a_v b_u by B_u b_v - B_v b_u; a g-term
changes b, hence p by p_b B and D by B_v a_u - B_u a_v. `sums.py` sums such derivatives over a
source's pixels without making them.
"""

from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner, leaf, shared
from bayesfred.imaging.kernels.contexts import Degrees, SourceNuisances
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.imaging.kernels.geometry import (
    lay_out,
    locate,
    new_geometry,
    one_source,
)
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row
from bayesfred.imaging.kernels.products import (
    fill_second_derivatives,
    is_product_row,
    lines_of,
)
from bayesfred.imaging.kernels.psf_dispatch import (
    psf_of_source,
    psf_second_derivatives,
    psf_slopes,
)


class Line(NamedTuple):
    """Pixels of a row, at t = u - u_peak = t0 + ramp[i]."""

    ramp: Floats
    t0: float


class Samples(NamedTuple):
    """What is sampled in a row's pixels, s = sign(D)."""

    p: Floats  # P
    size: Floats  # P |D|
    signed: Floats  # s P
    along_a: Floats  # P_a |D|
    along_b: Floats  # P_b |D|


class Sampler(NamedTuple):
    """What a row's samples are made of.

    It is taken out of the layout once a source: every access to a tuple counts references to all
    the arrays in it, which costs more than a short row.
    """

    psf: Any
    inverse: float  # 1 / sigma
    work: Floats  # the row's polynomials
    degrees: Degrees


@inner(inline="always")
def new_sampler(layout):
    """The sampler of a layout's sources; `of_source` makes one source's of it."""
    o = layout.optics
    return Sampler(o.psf, 1.0 / layout.sigma, layout.work, o.degrees)


@inner(inline="always")
def of_source(sampler, source):
    """The sampler of one source."""
    psf, inverse, work, degrees = sampler
    return Sampler(psf_of_source(psf, source.number), inverse, work, degrees)


class PixelGrid(NamedTuple):
    """Where pixels are: u = (column - middle_u) step, v likewise."""

    middle_u: float
    middle_v: float
    step: float


@leaf()
def pixel_grid(layout):
    """The grid of a layout's frame."""
    o = layout.optics
    return PixelGrid(0.5 * (o.nx - 1), 0.5 * (o.ny - 1), o.step)


class Rows(NamedTuple):
    """What the rows of a basis share, and their buffers."""

    sampler: Sampler
    offsets: Floats  # quadrature nodes and weights of a pixel
    weights: Floats
    ramp: Floats
    f: Ints  # powers of u and v of the monomials of f and g
    g: Ints
    is_wider: bool  # whether the width is a parameter
    out: Floats  # (monomials of f and g + 2, row)
    samples: Floats  # (9, row)
    powers: Floats  # (degree + 1, row)


@inner()
def new_rows(layout, basis, width):
    """Room for a row of a basis."""
    o, n = layout.optics, basis.f.shape[0] + basis.g.shape[0] + 2
    sampler, top = new_sampler(layout), len(o.degrees.ab)
    out, samples, powers = np.empty((n, width)), np.empty((9, width)), np.empty((top + 1, width))
    f, g, is_wider = basis.f, basis.g, widens(basis)
    return Rows(sampler, o.offsets, o.weights, o.ramp, f, g, is_wider, out, samples, powers)


@leaf()
def widens(basis):
    """Whether the width is a parameter: it is the last, then."""
    size = basis.row.size
    return size > 0 and basis.row[-1] == basis.f.shape[0] + basis.g.shape[0] + 1


@leaf(fastmath=FAST)
def _polynomial_row(out, line, coefficients, degree):
    """out[i] = a polynomial of t."""
    top, ramp, t0 = len(degree), line.ramp, line.t0
    for i in range(out.size):
        t = t0 + ramp[i]
        p = coefficients[top]
        for m in range(top):
            p = p * t + coefficients[top - 1 - m]
        out[i] = p


@leaf(fastmath=FAST)
def _times_polynomial(out, source, factor, line, coefficients, degree):
    """out[i] = factor times source[i] times a polynomial of t."""
    top, ramp, t0 = len(degree), line.ramp, line.t0
    for i in range(out.size):
        t = t0 + ramp[i]
        p = coefficients[top]
        for m in range(top):
            p = p * t + coefficients[top - 1 - m]
        out[i] = p * factor * source[i]


@leaf(fastmath=FAST)
def _slopes_row(psf, inverse, weight, p, a, b):
    """From a and b to weight times p, p_a and p_b."""
    slope = -weight * inverse
    for i in range(p.size):
        k, x, y = psf_slopes(psf, inverse * a[i], inverse * b[i])
        p[i], a[i], b[i] = weight * k, slope * x, slope * y


@leaf(fastmath=FAST)
def _second_derivatives_row(psf, inverse, weight, along_a, samples):
    """The same for -p_a, or for -p_b, in place of p."""
    p, a, b = samples.p, samples.along_a, samples.along_b
    slope, second = weight * inverse, -weight * inverse * inverse
    for i in range(p.size):
        x, y, xx, xy, yy = psf_second_derivatives(psf, inverse * a[i], inverse * b[i])
        p[i] = slope * (x if along_a else y)
        a[i], b[i] = second * (xx if along_a else xy), second * (xy if along_a else yy)


@leaf(fastmath=FAST)
def _times_determinant(p, size, signed):
    """From D in `signed` to size = p |D| and p sign(D)."""
    for i in range(p.size):
        size[i] = p[i] * abs(signed[i])
        signed[i] = p[i] if signed[i] > 0.0 else -p[i]


@leaf(fastmath=FAST)
def _times_absolute(a, b, d):
    for i in range(d.size):
        a[i] *= abs(d[i])
        b[i] *= abs(d[i])


@leaf(fastmath=FAST)
def samples_row(sampler, weight, template, line, samples):
    """Sample P = weight p and what comes with it on the row that `sampler.work` describes.

    Template 0 is the kernel K itself. Templates 1 and 2 are its derivatives as the source is
    shifted along a and along b, X = -p_a |D| and Y = -p_b |D|: the same with p replaced by -p_a or
    by -p_b.
    """
    psf, inverse, work, degrees = sampler
    along_a, along_b = samples.along_a, samples.along_b
    norm = weight * psf.norm * inverse * inverse
    _polynomial_row(along_a, line, work[2], degrees.ab)
    _polynomial_row(along_b, line, work[3], degrees.ab)
    if template == 0:
        _slopes_row(psf, inverse, norm, samples.p, along_a, along_b)
    else:
        _second_derivatives_row(psf, inverse, norm, template == 1, samples)
    _polynomial_row(samples.signed, line, work[1], degrees.d)
    _times_absolute(along_a, along_b, samples.signed)
    _times_determinant(samples.p, samples.size, samples.signed)


@leaf(fastmath=FAST)
def _add_widening(out, order, samples, sampler, line):
    """Add dP/dsigma = -(order P + a P_a + b P_b) / sigma.

    P is homogeneous of degree -order in a, b and sigma.
    """
    ra, rb, top = sampler.work[2], sampler.work[3], len(sampler.degrees.ab)
    inverse = sampler.inverse
    size, along_a, along_b = samples.size, samples.along_a, samples.along_b
    ramp, t0 = line.ramp, line.t0
    for i in range(out.size):
        t = t0 + ramp[i]
        a, b = ra[top], rb[top]
        for m in range(top):
            a = a * t + ra[top - 1 - m]
            b = b * t + rb[top - 1 - m]
        out[i] -= (order * size[i] + a * along_a[i] + b * along_b[i]) * inverse


@leaf(fastmath=FAST)
def _add_row_of(out, row):
    for i in range(row.size):
        out[i] += row[i]


@leaf(fastmath=FAST)
def _powers_row(powers, ramp, u0, n):
    """powers[m] = u^m at u = u0 + ramp[i]."""
    powers[0, :n] = 1.0
    for m in range(1, powers.shape[0]):
        before, row = powers[m - 1], powers[m]
        for i in range(n):
            row[i] = before[i] * (u0 + ramp[i])


@leaf(fastmath=FAST)
def _add_monomials(basis_powers, v, terms, powers, out, start):
    """Add B along + B_u first + B_v second to the rows of the basis from `start` on.

    B are the monomials u^m v^q of f (or of g); the terms are (along, first, second).
    """
    along, first, second = terms
    for k in range(basis_powers.shape[0]):
        m = basis_powers[k, 0]
        q = basis_powers[k, 1]
        vq = v**q
        by = q * v ** (q - 1) if q > 0 else 0.0
        row, power = out[start + k], powers[m]
        for i in range(along.size):
            row[i] += power[i] * (vq * along[i] + by * second[i])
        if m > 0:
            bx = m * vq
            lower = powers[m - 1]
            for i in range(along.size):
                row[i] += bx * lower[i] * first[i]


@shared(_nrt=False, fastmath=FAST)
def basis_row(rows, source, u_row, v_row, n, template):
    """Fill rows.out with the basis of a unit source in n pixels from (u_row, v_row) on.

    rows.samples are P, P |D|, s P, P_a |D|, P_b |D|, s P b_v, -s P b_u, -s P a_v, s P a_u. For the
    templates see `samples_row`. The number comes as an np.int64: of a literal one this function
    would be compiled again.
    """
    every, offsets, weights, ramp, f, g, is_wider, out, buffer, powers = rows
    sampler = of_source(every, source)
    work, degree, conserves = sampler.work, sampler.degrees.ab, len(sampler.degrees.d) > 0
    ra, rb, rav, rbv, slope = work[2], work[3], work[4], work[5], work[6]
    n_f, n_g, top = f.shape[0], g.shape[0], len(degree)
    for k in range(out.shape[0]):
        out[k, :n] = 0.0
    order = 2.0 if template == 0 else 3.0
    samples = Samples(buffer[0, :n], buffer[1, :n], buffer[2, :n], buffer[3, :n], buffer[4, :n])
    signed = samples.signed
    f_u, f_v, g_u, g_v = buffer[5, :n], buffer[6, :n], buffer[7, :n], buffer[8, :n]
    row_k, row_s = out[n_f + n_g, :n], out[n_f + n_g + 1, :n]
    slope[:] = 0.0
    for q in range(offsets.size):
        v = v_row + offsets[q]
        map_on_row(source, v - source.v, work, degree)
        polynomial_on_row(source.d, v - source.v, 1.0, work[1], sampler.degrees.d)
        for p in range(offsets.size):
            u = u_row + offsets[p]
            line = Line(ramp, u - source.u)
            samples_row(sampler, weights[q] * weights[p], template, line, samples)
            if conserves:
                _times_polynomial(f_u, signed, 1.0, line, rbv, degree)
                _times_polynomial(g_u, signed, -1.0, line, rav, degree)
                for m in range(top):
                    slope[m] = -(m + 1) * rb[m + 1]
                _times_polynomial(f_v, signed, 1.0, line, slope, degree)
                for m in range(top):
                    slope[m] = (m + 1) * ra[m + 1]
                _times_polynomial(g_v, signed, 1.0, line, slope, degree)
            else:
                buffer[5:] = 0.0
            _add_row_of(row_k, samples.size)
            if is_wider:
                _add_widening(row_s, order, samples, sampler, line)
            _powers_row(powers, ramp, u, n)
            _add_monomials(f, v, (samples.along_a, f_u, f_v), powers, out, 0)
            _add_monomials(g, v, (samples.along_b, g_u, g_v), powers, out, n_f)


@shared(fastmath=FAST)
def second_derivatives(layout, rows, s, flux):
    """Flux times K_xx, K_xy and K_yy of source s in the pixels of its footprint, shape (3, pixels).

    `rows` are those of a basis with the monomial 1 alone.
    """
    fp, grid, out = layout.footprints, pixel_grid(layout), rows.out
    first, last = fp.first[s], fp.first[s + 1]
    source, begin = one_source(layout.geometry, s), fp.start[first]
    second = np.empty((3, fp.start[last] - begin))
    lines = lines_of(layout, s, first, last)
    if fill_second_derivatives(lines, fp, s, flux, second):
        return second
    for p in range(first, last):
        n, own = fp.size[p], fp.start[p] - begin
        u = (fp.low[p] - grid.middle_u) * grid.step
        v = (fp.row[p] - grid.middle_v) * grid.step
        basis_row(rows, source, u, v, n, np.int64(1))
        for k in range(n):
            second[0, own + k], second[1, own + k] = -flux * out[0, k], -flux * out[1, k]
        basis_row(rows, source, u, v, n, np.int64(2))
        for k in range(n):
            second[2, own + k] = -flux * out[1, k]
    return second


@leaf(fastmath=FAST)
def _add_derivatives(flux, factors, index, basis_rows, out):
    """Add those of a row of pixels, shape (parameters, pixels)."""
    for k in range(index.size):
        c = flux * factors[k]
        if c != 0.0:
            derivative, target = basis_rows[index[k]], out[k]
            for i in range(target.size):
                target[i] += c * derivative[i]


@leaf(fastmath=FAST)
def _add_source_rows(place, basis, rows, flux, band, out):
    """Add the derivatives of a source in rows band[0] to band[1] - 1."""
    (layout, s, lines), (first, last) = place, band
    fp, grid, inverse = layout.footprints, pixel_grid(layout), 1.0 / layout.sigma
    source, lows, sizes, numbers = one_source(layout.geometry, s), fp.low, fp.size, fp.row
    factors, index, basis_rows = basis.factors[s], basis.row, rows.out
    monomials = len(rows.f), len(rows.g), rows.is_wider
    for p in range(fp.first[s], fp.first[s + 1]):
        j, low, n = numbers[p], lows[p], sizes[p]
        if not first <= j < last:
            continue
        if not is_product_row(lines, monomials, inverse, (j, low, n), basis_rows):
            u, v = (low - grid.middle_u) * grid.step, (j - grid.middle_v) * grid.step
            basis_row(rows, source, u, v, n, np.int64(0))
        _add_derivatives(flux, factors, index, basis_rows, out[:, j - first, low : low + n])


@shared()
def add_jacobian_rows(layout, basis, flux, first, last, out):
    """Add the derivatives of rows first..last-1 to out (parameters, rows, padded row)."""
    rows = new_rows(layout, basis, out.shape[2])
    begins, reached = layout.footprints.first, layout.geometry.rows
    for s in range(flux.size):
        if reached[s, 0] < last and reached[s, 1] > first:
            lines = lines_of(layout, s, begins[s], begins[s + 1])
            _add_source_rows((layout, s, lines), basis, rows, flux[s], (first, last), out)


@entry()
def jacobian(o, theta, sigma, flux, basis, out):
    """d image / d parameters into out (parameters, ny, padded row)."""
    geometry = new_geometry(o)
    locate(o, theta, SourceNuisances(1.0, 0.0, 0.0, sigma, 0.0, 0.0), geometry)
    add_jacobian_rows(lay_out(o, geometry, sigma), basis, flux, 0, o.ny, out)
