"""Which object point is imaged at a place, for one or many sets of coefficients.

At a fixed image point (u, v) the displacements are polynomials in the object point alone:

    f = sum of c_ij x^i y^j,    c_ij = sum of theta_k u^m v^n over the terms with these i and j,

so that the c_ij of many coefficients and points are one matrix product, and an evaluation costs as
much as there are different powers (i, j). The object is the root of

    a = u - x + f - offset_x = 0,    b = v - y + g - offset_y = 0,

found by Newton's method in (x, y). A polynomial has other roots, which are no objects: the root is
followed from the axis, whose object (0, 0) is imaged at the offset, along a straight line to
(u, v). It is lost where the matrix

    A = [[a_x, a_y], [b_x, b_y]],

-1 times the unit matrix on the axis, becomes singular: there the map from object to image folds,
and beyond it no object is imaged that is connected with the axis. The implicit function theorem
gives the change of the root with the coefficients: A d(x, y) = -(df, dg) + d(offset).
`PolynomialDistortion.object_position` and `.displacement_jacobian` offer this to users.
"""

from collections.abc import Sequence

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.monomials import Exponents, U, V, newton

STEPS = 8  # from the axis to a point

Terms = tuple[Floats, Sequence[Exponents]]  # coefficients, shape (n, n_terms), and their monomials
Reduced = dict[tuple[int, int], Floats]  # c_ij by (i, j)


def object_positions(f: Terms, g: Terms, u: Floats, v: Floats, offset: Floats) -> Floats:
    """The objects that are imaged at (u, v), shape (2, n, points), pixel; NaN where there is none.

    Parameters
    ----------
    f, g : tuple of ndarray, shape (n, n_terms), and sequence of exponents
        Coefficients that resemble each other, as draws do: the root is followed from the axis for
        their mean, and the others begin from there.
    u, v : ndarray, shape (points,), pixel
    offset : ndarray, shape (n, 2), pixel

    Returns
    -------
    ndarray, shape (2, n, points), pixel
    """
    f_mean, g_mean, mean = (c.mean(axis=0, keepdims=True) for c in (f[0], g[0], offset))
    by_x, by_y = mean[0]
    x, y = (u - by_x)[None] / STEPS, (v - by_y)[None] / STEPS
    before = np.broadcast_to(np.array([-1.0, 0.0, 0.0, -1.0])[:, None, None], (4, *x.shape))
    for k in range(1, STEPS + 1):
        at = by_x + (u - by_x) * k / STEPS, by_y + (v - by_y) * k / STEPS
        equations = _Equations((f_mean, f[1]), (g_mean, g[1]), *at, mean)
        x, y, before = _root(equations, x, y, before)
        if k < STEPS:
            x, y = x * (k + 1) / k, y * (k + 1) / k
    return np.array(_root(_Equations(f, g, u, v, offset), x, y, before)[:2])


def displacement_jacobian(
    design: Floats, f: Terms, g: Terms, at: tuple[Floats, Floats, Floats, Floats]
) -> Floats:
    """Derivatives of (u - x, v - y) with respect to the coefficients and the offset.

    Parameters
    ----------
    design : ndarray, shape (2, points, n_coefficients)
        f and g of a unit of every coefficient at the points.
    f, g : tuple of ndarray, shape (1, n_terms), and sequence of exponents
    at : tuple of ndarray, shape (points,), pixel
        Image points and the objects that are imaged there: u, v, x, y.

    Returns
    -------
    ndarray, shape (points, 2, n_coefficients + 2)
        The last two columns are the derivatives with respect to the offset.
    """
    u, v, x, y = at
    a_x, a_y, b_x, b_y = _Equations(f, g, u, v, np.zeros((1, 2)))(x[None], y[None])[2:]
    matrix = np.array([[a_x, a_y], [b_x, b_y]])[:, :, 0].transpose(2, 0, 1)
    change = np.concatenate([design, np.broadcast_to(-np.eye(2)[:, None], (2, u.size, 2))], axis=2)
    known = np.isfinite(x + y)
    out = np.full((u.size, 2, change.shape[2]), np.nan)
    out[known] = np.linalg.solve(matrix[known], change.transpose(1, 0, 2)[known])
    return out


class _Equations:
    """a, b, a_x, a_y, b_x and b_y at fixed image points, as functions of the object points."""

    def __init__(self, f: Terms, g: Terms, u: Floats, v: Floats, offset: Floats) -> None:
        self.f, self.g = (_reduced(*terms, u, v) for terms in (f, g))
        self.u, self.v = u - offset[:, :1], v - offset[:, 1:]

    def __call__(self, x: Floats, y: Floats) -> tuple[Floats, ...]:
        f, f_x, f_y = _evaluated(self.f, x, y)
        g, g_x, g_y = _evaluated(self.g, x, y)
        return self.u - x + f, self.v - y + g, f_x - 1.0, f_y, g_x, g_y - 1.0


def _root(
    equations: _Equations, x: Floats, y: Floats, before: Floats
) -> tuple[Floats, Floats, Floats]:
    """The roots near (x, y) and the matrix A there; NaN unless it is like the one before.

    It is not where its determinant has changed its sign, or where it has turned by more than a
    right angle: that is a root of another branch.
    """
    shape = np.broadcast_shapes(x.shape, equations.u.shape)
    x, y = newton(equations, np.broadcast_to(x, shape), np.broadcast_to(y, shape))
    with np.errstate(all="ignore"):  # roots that are NaN
        matrix = np.array(equations(x, y)[2:])
        determinant = matrix[0] * matrix[3] - matrix[1] * matrix[2]
        same = (determinant > 0.0) & (np.sum(matrix * before, axis=0) > 0.0)
    return np.where(same, x, np.nan), np.where(same, y, np.nan), matrix


def _reduced(theta: Floats, terms: Sequence[Exponents], u: Floats, v: Floats) -> Reduced:
    """The coefficients c_ij, shape (n, points) each."""
    by_power: dict[tuple[int, int], list[int]] = {}
    for k, (i, j, _, _) in enumerate(terms):
        by_power.setdefault((i, j), []).append(k)
    return {
        power: theta[:, some] @ np.array([u ** terms[k][U] * v ** terms[k][V] for k in some])
        for power, some in by_power.items()
    }


def _evaluated(reduced: Reduced, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """The sum of c_ij x^i y^j and its derivatives along x and y."""
    degrees = np.max([(0, 0), *reduced], axis=0)
    xs, ys = ([np.ones_like(p)] for p in (x, y))
    for powers, p, degree in zip((xs, ys), (x, y), degrees, strict=True):
        for _ in range(degree):
            powers.append(powers[-1] * p)
    value, along_x, along_y = (np.zeros_like(x) for _ in range(3))
    for (i, j), c in reduced.items():
        value += c * xs[i] * ys[j]
        if i:
            along_x += c * (i * xs[i - 1] * ys[j])
        if j:
            along_y += c * (j * xs[i] * ys[j - 1])
    return value, along_x, along_y
