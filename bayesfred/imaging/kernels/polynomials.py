"""Polynomials in two variables as matrices of coefficients.

On a row of pixels they are polynomials in u alone. Their degree reaches the innermost loop as the
length of a tuple, that is as a compile-time constant, so that the loop over pixels vectorises for
every degree.
"""

from bayesfred.imaging.kernels.compilation import leaf
from bayesfred.imaging.kernels.fastmath import FAST


@leaf(fastmath={"contract"})
def evaluate(c, u, v, degree):
    """The polynomial c and its derivatives with respect to u and v."""
    top = len(degree)
    value, c_u, c_v = 0.0, 0.0, 0.0
    for i in range(top + 1):
        m = top - i
        row, row_v = c[m, top], 0.0
        for k in range(top):  # Horner's scheme carries the derivative along
            row_v = row_v * v + row
            row = row * v + c[m, top - 1 - k]
        c_u = c_u * u + value
        value = value * u + row
        c_v = c_v * u + row_v
    return value, c_u, c_v


@leaf()
def shift(c, h, k, degree):
    """c(u, v) -> c(u + h, v + k) in place, by repeated synthetic division."""
    top = len(degree)
    for n in range(top + 1):
        for i in range(top):
            for m in range(top - 1, i - 1, -1):
                c[m, n] += h * c[m + 1, n]
    for m in range(top + 1):
        for i in range(top):
            for n in range(top - 1, i - 1, -1):
                c[m, n] += k * c[m, n + 1]


@leaf(fastmath=FAST)
def multiply(a, b, conserve, q, d):
    """Coefficients of a^2 + b^2, and of a_u b_v - a_v b_u if flux is conserved, else of 1."""
    q[:] = 0.0
    d[:] = 0.0
    if not conserve:
        d[0, 0] = 1.0
    for m in range(a.shape[0]):
        for n in range(a.shape[1]):
            for i in range(a.shape[0]):
                for j in range(a.shape[1]):
                    q[n + j, m + i] += a[m, n] * a[i, j] + b[m, n] * b[i, j]
                    if conserve and m * j != n * i:
                        d[n + j - 1, m + i - 1] += (m * j - n * i) * a[m, n] * b[i, j]


@leaf(fastmath=FAST)
def map_on_row(source, w, work, degree):
    """Fill work[2:6] with a, b, a_v and b_v in powers of t = u - u_peak at v = v_peak + w."""
    a, b = source.a, source.b
    ra, rb, rav, rbv = work[2], work[3], work[4], work[5]
    for m in range(len(degree) + 1):
        pa, pb, pav, pbv = 0.0, 0.0, 0.0, 0.0
        for k in range(a.shape[1]):
            n = a.shape[1] - 1 - k
            pav = pav * w + pa  # Horner's scheme carries the derivative along
            pbv = pbv * w + pb
            pa = pa * w + a[m, n]
            pb = pb * w + b[m, n]
        ra[m], rb[m], rav[m], rbv[m] = pa, pb, pav, pbv


@leaf(fastmath=FAST)
def polynomial_on_row(c, w, factor, out, degree):
    """Coefficients in t of factor times the polynomial with coefficients c[n, m] of w^n t^m."""
    top = len(degree)
    for m in range(top + 1):
        p = c[top, m]
        for n in range(top):
            p = p * w + c[top - 1 - n, m]
        out[m] = factor * p
