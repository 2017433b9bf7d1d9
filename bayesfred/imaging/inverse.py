"""Which object point is imaged at a place, and where, for one or many sets of coefficients.

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

Of many points the roots are followed on a grid, and Newton's method begins from what a spline puts
between its points. At a fixed object point the same equations are polynomials in (u, v): the image
is the root near (x, y) + offset, with

    D = [[1 + f_u, f_v], [g_u, 1 + g_v]],    D d(u, v) = -(df, dg) + d(offset).

`PolynomialDistortion.object_position`, `.image_position` and `.displacement_jacobian` offer this to
users.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.interpolate import RectBivariateSpline

from bayesfred._typing import Floats
from bayesfred.imaging.monomials import Exponents, U, V, X, Y, newton

STEPS = 8  # from the axis to a point
MANY = 2**12  # points, from which on the roots of a grid are followed in their place
GRID = 33  # points along each side of that grid
BLOCK = 2**14  # roots that are looked for at once: what fits the caches

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
    mean = tuple(c.mean(axis=0, keepdims=True) for c in (f[0], g[0], offset))
    middle = (mean[0], f[1]), (mean[1], g[1]), mean[2]
    near = _between(*middle, u, v) if u.size > MANY else None
    out = np.empty((2, len(f[0]), u.size))
    for some in _blocks(u.size):
        at = u[some], v[some]
        if near is None:
            start = _followed(*middle, *at)
        else:
            x, y = near[0][:, some], near[1][:, some]
            start = x, y, np.array(_objects(*middle[:2], *at, middle[2])(x, y)[2:])
        for n in _blocks(len(f[0]), max(BLOCK // at[0].size, 1)):
            equations = _objects((f[0][n], f[1]), (g[0][n], g[1]), *at, offset[n])
            out[:, n, some] = _root(equations, *start)[:2]
    return out


def image_positions(f: Terms, g: Terms, x: Floats, y: Floats, offset: Floats) -> Floats:
    """Where objects are imaged, shape (2, n, points), pixel; NaN where Newton's method fails.

    Parameters
    ----------
    f, g : tuple of ndarray, shape (n, n_terms), and sequence of exponents
    x, y : ndarray, shape (points,), pixel
    offset : ndarray, shape (n, 2), pixel

    Returns
    -------
    ndarray, shape (2, n, points), pixel
    """
    out = np.empty((2, len(f[0]), x.size))
    for some in _blocks(x.size):
        by_x, by_y = x[some] + offset[:, :1], y[some] + offset[:, 1:]
        equations = _Equations((f, g), (x[some], y[some]), (-by_x, -by_y), images=True)
        out[:, :, some] = newton(equations, by_x, by_y)
    return out


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
    matrix = slopes(f, g, at, images=False)
    change = np.concatenate(
        [design, np.broadcast_to(-np.eye(2)[:, None], (2, len(matrix), 2))], axis=2
    )
    known = np.isfinite(matrix).all(axis=(1, 2))
    out = np.full((len(matrix), 2, change.shape[2]), np.nan)
    out[known] = np.linalg.solve(matrix[known], change.transpose(1, 0, 2)[known])
    return out


def slopes(
    f: Terms, g: Terms, at: tuple[Floats, Floats, Floats, Floats], *, images: bool
) -> Floats:
    """The matrix D of images, or A of objects, shape (points, 2, 2).

    Parameters
    ----------
    f, g : tuple of ndarray, shape (1, n_terms), and sequence of exponents
    at : tuple of ndarray, shape (points,), pixel
        Image points and the objects that are imaged there: u, v, x, y.
    images : bool

    Returns
    -------
    ndarray, shape (points, 2, 2)
    """
    u, v, x, y = at
    none = np.zeros((1, 1))
    fixed, free = ((x, y), (u, v)) if images else ((u, v), (x, y))
    found = _Equations((f, g), fixed, (none, none), images=images)(free[0][None], free[1][None])
    return np.moveaxis(np.array(found[2:]).reshape(2, 2, u.size), 2, 0)


class _Equations:
    """a, b and their derivatives where (u, v) or (x, y) are fixed, as functions of the others.

    They are a = c + s p + f and b = d + s q + g, with s = -1 for objects (p, q) = (x, y) and s = 1
    for images (p, q) = (u, v); f is a polynomial in p and q.
    """

    def __init__(
        self,
        terms: tuple[Terms, Terms],
        fixed: tuple[Floats, Floats],
        constants: tuple[Floats, Floats],
        *,
        images: bool,
    ) -> None:
        axes = ((X, Y), (U, V)) if images else ((U, V), (X, Y))
        self.f, self.g = (_reduced(*each, fixed, *axes) for each in terms)
        self.c, self.d = constants
        self.sign = 1.0 if images else -1.0

    def __call__(self, p: Floats, q: Floats) -> tuple[Floats, ...]:
        f, f_p, f_q = _evaluated(self.f, p, q)
        g, g_p, g_q = _evaluated(self.g, p, q)
        s = self.sign
        return self.c + s * p + f, self.d + s * q + g, f_p + s, f_q, g_p, g_q + s


def _objects(f: Terms, g: Terms, u: Floats, v: Floats, offset: Floats) -> _Equations:
    """The equations of the objects that are imaged at (u, v)."""
    constants = u - offset[:, :1], v - offset[:, 1:]
    return _Equations((f, g), (u, v), constants, images=False)


def _followed(
    f: Terms, g: Terms, offset: Floats, u: Floats, v: Floats
) -> tuple[Floats, Floats, Floats]:
    """The root of one set of coefficients followed from the axis to (u, v), and A there."""
    by_x, by_y = offset[0]
    x, y = (u - by_x)[None] / STEPS, (v - by_y)[None] / STEPS
    before = np.broadcast_to(np.array([-1.0, 0.0, 0.0, -1.0])[:, None, None], (4, *x.shape))
    for k in range(1, STEPS + 1):
        at = by_x + (u - by_x) * k / STEPS, by_y + (v - by_y) * k / STEPS
        x, y, before = _root(_objects(f, g, *at, offset), x, y, before)
        if k < STEPS:
            x, y = x * (k + 1) / k, y * (k + 1) / k
    return x, y, before


def _between(
    f: Terms, g: Terms, offset: Floats, u: Floats, v: Floats
) -> tuple[Floats, Floats] | None:
    """Objects by splines between those of a grid, shape (1, points); None if one is lost."""
    if not np.isfinite(u + v).all():
        return None
    along = [np.linspace(p.min(), p.max(), GRID) for p in (v, u)]
    if min(np.ptp(axis) for axis in along) <= 0.0:
        return None
    rows, columns = np.meshgrid(*along, indexing="ij")
    x, y, _ = _followed(f, g, offset, columns.ravel(), rows.ravel())
    if not np.isfinite(x + y).all():
        return None
    splines = (RectBivariateSpline(*along, p.reshape(GRID, GRID)) for p in (x, y))
    found_x, found_y = (spline.ev(v, u)[None] for spline in splines)
    return found_x, found_y


def _blocks(size: int, most: int = BLOCK) -> Iterator[slice]:
    return (slice(first, first + most) for first in range(0, size, most))


def _root(
    equations: _Equations, x: Floats, y: Floats, before: Floats
) -> tuple[Floats, Floats, Floats]:
    """The roots near (x, y) and the matrix A there; NaN unless it is like the one before.

    It is not where its determinant has changed its sign, or where it has turned by more than a
    right angle: that is a root of another branch.
    """
    shape = np.broadcast_shapes(x.shape, equations.c.shape)
    x, y = newton(equations, np.broadcast_to(x, shape), np.broadcast_to(y, shape))
    with np.errstate(all="ignore"):  # roots that are NaN
        matrix = np.array(equations(x, y)[2:])
        determinant = matrix[0] * matrix[3] - matrix[1] * matrix[2]
        same = (determinant > 0.0) & (np.sum(matrix * before, axis=0) > 0.0)
    return np.where(same, x, np.nan), np.where(same, y, np.nan), matrix


def _reduced(
    theta: Floats,
    terms: Sequence[Exponents],
    fixed: tuple[Floats, Floats],
    at: tuple[int, int],
    free: tuple[int, int],
) -> Reduced:
    """The coefficients of the powers of the free variables, shape (n, points) or (n, 1) each."""
    by_power: dict[tuple[int, int], list[int]] = {}
    for k, term in enumerate(terms):
        by_power.setdefault((term[free[0]], term[free[1]]), []).append(k)
    p, q = fixed
    found: Reduced = {}
    for power, some in by_power.items():
        if any(terms[k][axis] for k in some for axis in at):
            powers = np.array([p ** terms[k][at[0]] * q ** terms[k][at[1]] for k in some])
            found[power] = theta[:, some] @ powers
        else:  # the same at all points
            found[power] = theta[:, some].sum(axis=1, keepdims=True)
    return found


def _evaluated(reduced: Reduced, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
    """The sum of c_ij x^i y^j and its derivatives along x and y, by Horner's scheme."""
    value, along_x, along_y = (np.zeros_like(x) for _ in range(3))
    for i in range(max((i for i, _ in reduced), default=-1), -1, -1):
        row: Floats | float = 0.0  # the polynomial in y that x^i is multiplied by
        slope: Floats | float = 0.0
        for j in range(max((j for k, j in reduced if k == i), default=-1), -1, -1):
            slope = slope * y + row
            row = row * y + reduced.get((i, j), 0.0)
        along_x = along_x * x + value
        value = value * x + row
        along_y = along_y * x + slope
    return value, along_x, along_y
