"""The kinds of PSF, and what the loops ask of one of width sigma, norm / sigma^2 left out.

`psf_arguments` fills a row's polynomials, from which `psf_value` makes p at t; from a and b
`psf_slopes` makes p, -p_a and -p_b, and `psf_bends` -p_a, -p_b, p_aa, p_ab and p_bb. The kind
reaches them as a type: what is compiled holds the code of one kind alone.
"""

from typing import Any, NamedTuple

import numba as nb
import numpy as np
from numba.extending import overload

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.fastmath import LOG2_E, exp2, log
from bayesfred.imaging.kernels.polynomials import map_on_row, polynomial_on_row


class Gaussian(NamedTuple):
    """norm exp(-(a^2 + b^2) / 2). Here and below, a and b in units of sigma."""

    norm: float


class Moffat(NamedTuple):
    """norm (1 + (a^2 + b^2) / square)^-beta."""

    norm: float
    square: float
    beta: float


class Spline(NamedTuple):
    """norm times the sum of c[j, i] B(y - j) B(x - i), B the cubic B-spline; from the middle, x = a / pitch and y = b / pitch.

    The four outermost rows and columns of c are zero.
    """

    norm: float
    c: Floats
    pitch: float


def of_kind(gaussian: Any, moffat: Any, spline: Any) -> Any:
    """A function that is compiled, into its caller, as the one for the kind of PSF that is its first argument."""
    kinds = {Gaussian: gaussian, Moffat: moffat, Spline: spline}

    def function(psf: Any, *arguments: Any) -> Any:
        raise NotImplementedError("for compiled code")

    @overload(function, inline="always", strict=False)
    def choose(psf: Any, *arguments: Any) -> Any:
        return kinds[psf.instance_class]

    return function


def _gaussian_arguments(psf, maps, s, w, sigma, work, degree, q_degree):
    polynomial_on_row(maps.q[s], w, -0.5 * LOG2_E / (sigma * sigma), work[0], q_degree)


def _moffat_arguments(psf, maps, s, w, sigma, work, degree, q_degree):
    polynomial_on_row(maps.q[s], w, 1.0 / (psf.square * sigma * sigma), work[0], q_degree)
    work[0, 0] += 1.0


def _spline_arguments(psf, maps, s, w, sigma, work, degree, q_degree):
    map_on_row(maps.a[s], maps.b[s], w, work[0], work[2], work[3], work[4], degree)
    for m in range(len(degree) + 1):
        work[0, m] /= psf.pitch * sigma
        work[2, m] /= psf.pitch * sigma


def _gaussian_value(psf, t, r, r2, degree, q_degree):
    top = len(q_degree)
    e = r[top]
    for m in range(top):
        e = e * t + r[top - 1 - m]
    return exp2(e)


def _moffat_value(psf, t, r, r2, degree, q_degree):
    top = len(q_degree)
    e = r[top]
    for m in range(top):
        e = e * t + r[top - 1 - m]
    return exp2(-LOG2_E * psf.beta * log(e))


def _spline_value(psf, t, r, r2, degree, q_degree):
    top = len(degree)
    x, y = r[top], r2[top]
    for m in range(top):
        x = x * t + r[top - 1 - m]
        y = y * t + r2[top - 1 - m]
    i, x = _cell(psf.c.shape[1], x)
    j, y = _cell(psf.c.shape[0], y)
    w0, w1, w2, w3 = _weights(x)
    v0, v1, v2, v3 = _weights(y)
    r0, r1, r2, r3 = _four(psf.c, j, i, w0, w1, w2, w3)
    return v0 * r0 + v1 * r1 + v2 * r2 + v3 * r3


@nb.njit(inline="always")
def _cell(size, x):
    """The first of the four coefficients that matter at x samples from their middle, and where between the middle two x is.

    Beyond the outermost coefficients the spline is zero, as it is among the last four.
    """
    x = min(max(x + 0.5 * (size - 1), 1.0), size - 2.5)
    i = np.int64(x)
    return i - 1, x - i


@nb.njit(inline="always")
def _weights(f):
    """The B-splines of four neighbouring samples, f of a step after the second."""
    g = 1.0 - f
    return (
        g * g * g / 6.0,
        2.0 / 3.0 - f * f * (1.0 - 0.5 * f),
        2.0 / 3.0 - g * g * (1.0 - 0.5 * g),
        f * f * f / 6.0,
    )


@nb.njit(inline="always")
def _slope_weights(f):
    g = 1.0 - f
    return -0.5 * g * g, f * (1.5 * f - 2.0), -g * (1.5 * g - 2.0), 0.5 * f * f


@nb.njit(inline="always")
def _bend_weights(f):
    g = 1.0 - f
    return g, 3.0 * f - 2.0, 3.0 * g - 2.0, f


@nb.njit(inline="always")
def _four(c, j, i, w0, w1, w2, w3):
    """The weighted sums of four coefficients on four rows."""
    return (
        w0 * c[j, i] + w1 * c[j, i + 1] + w2 * c[j, i + 2] + w3 * c[j, i + 3],
        w0 * c[j + 1, i] + w1 * c[j + 1, i + 1] + w2 * c[j + 1, i + 2] + w3 * c[j + 1, i + 3],
        w0 * c[j + 2, i] + w1 * c[j + 2, i + 1] + w2 * c[j + 2, i + 2] + w3 * c[j + 2, i + 3],
        w0 * c[j + 3, i] + w1 * c[j + 3, i + 1] + w2 * c[j + 3, i + 2] + w3 * c[j + 3, i + 3],
    )


# A Gaussian and a Moffat alike have p_a = -a w p and p_aa = w (kappa w a^2 - 1) p, with w = 1 /
# sigma^2 and kappa = 1, or w = 2 beta / (square sigma^2 + a^2 + b^2) and kappa = 1 + 1 / beta.


@nb.njit(inline="always")
def _gaussian_radial(psf, sigma, a, b):
    inverse = 1.0 / (sigma * sigma)
    return exp2(-0.5 * LOG2_E * inverse * (a * a + b * b)), inverse, 1.0


@nb.njit(inline="always")
def _moffat_radial(psf, sigma, a, b):
    core = psf.square * sigma * sigma
    z = 1.0 / core * (a * a + b * b) + 1.0
    return exp2(-LOG2_E * psf.beta * log(z)), 2.0 * psf.beta / (core * z), 1.0 + 1.0 / psf.beta


@nb.njit(inline="always")
def _radial_bends(p, w, kappa, a, b):
    k = w * p
    h = kappa * w * k
    return k * a, k * b, h * a * a - k, h * a * b, h * b * b - k


def _gaussian_slopes(psf, sigma, a, b):
    p, w, _ = _gaussian_radial(psf, sigma, a, b)
    return p, w * p * a, w * p * b


def _moffat_slopes(psf, sigma, a, b):
    p, w, _ = _moffat_radial(psf, sigma, a, b)
    return p, w * p * a, w * p * b


def _spline_slopes(psf, sigma, a, b):
    k = 1.0 / (psf.pitch * sigma)
    i, x = _cell(psf.c.shape[1], k * a)
    j, y = _cell(psf.c.shape[0], k * b)
    w0, w1, w2, w3 = _weights(x)
    d0, d1, d2, d3 = _slope_weights(x)
    v0, v1, v2, v3 = _weights(y)
    e0, e1, e2, e3 = _slope_weights(y)
    r0, r1, r2, r3 = _four(psf.c, j, i, w0, w1, w2, w3)
    s0, s1, s2, s3 = _four(psf.c, j, i, d0, d1, d2, d3)
    return (
        v0 * r0 + v1 * r1 + v2 * r2 + v3 * r3,
        -k * (v0 * s0 + v1 * s1 + v2 * s2 + v3 * s3),
        -k * (e0 * r0 + e1 * r1 + e2 * r2 + e3 * r3),
    )


def _gaussian_bends(psf, sigma, a, b):
    p, w, kappa = _gaussian_radial(psf, sigma, a, b)
    return _radial_bends(p, w, kappa, a, b)


def _moffat_bends(psf, sigma, a, b):
    p, w, kappa = _moffat_radial(psf, sigma, a, b)
    return _radial_bends(p, w, kappa, a, b)


def _spline_bends(psf, sigma, a, b):
    k = 1.0 / (psf.pitch * sigma)
    i, x = _cell(psf.c.shape[1], k * a)
    j, y = _cell(psf.c.shape[0], k * b)
    w0, w1, w2, w3 = _weights(x)
    d0, d1, d2, d3 = _slope_weights(x)
    h0, h1, h2, h3 = _bend_weights(x)
    v0, v1, v2, v3 = _weights(y)
    e0, e1, e2, e3 = _slope_weights(y)
    g0, g1, g2, g3 = _bend_weights(y)
    r0, r1, r2, r3 = _four(psf.c, j, i, w0, w1, w2, w3)
    s0, s1, s2, s3 = _four(psf.c, j, i, d0, d1, d2, d3)
    q0, q1, q2, q3 = _four(psf.c, j, i, h0, h1, h2, h3)
    return (
        -k * (v0 * s0 + v1 * s1 + v2 * s2 + v3 * s3),
        -k * (e0 * r0 + e1 * r1 + e2 * r2 + e3 * r3),
        k * k * (v0 * q0 + v1 * q1 + v2 * q2 + v3 * q3),
        k * k * (e0 * s0 + e1 * s1 + e2 * s2 + e3 * s3),
        k * k * (g0 * r0 + g1 * r1 + g2 * r2 + g3 * r3),
    )


psf_arguments = of_kind(_gaussian_arguments, _moffat_arguments, _spline_arguments)
psf_value = of_kind(_gaussian_value, _moffat_value, _spline_value)
psf_slopes = of_kind(_gaussian_slopes, _moffat_slopes, _spline_slopes)
psf_bends = of_kind(_gaussian_bends, _moffat_bends, _spline_bends)
