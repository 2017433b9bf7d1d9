"""Polynomial field distortion: the displacement (f, g) of a point between the object and the image plane.

A point source at (x, y) of the object plane reaches the image point (u, v) with the reference PSF
at

    a = u - x + f(u, v, x, y),   b = v - y + g(u, v, x, y),

so its image stands where a = b = 0. f and g are sums of monomials theta_k x^i y^j u^m v^n; the
distortion-free condition (a source on the axis is not distorted) asks i + j >= 1 of every one of
them. The pinhole camera with polynomial distortion is the special case m = n = 0. What is here
serves positions and maps; the images themselves come from `forward`.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable

Exponents = tuple[int, int, int, int]

X, Y, U, V = range(4)  # a variable's place in an exponent tuple (i, j, m, n)

# Newton's method stops when a step is this small, relative to the point's coordinates (at least one
# pixel).
RELATIVE_TOLERANCE = 1e-12
MAX_ITERATIONS = 50

# The paper's f in the equation's order: ux, vx, u^2 x, v^2 x, u x^2, v x^2.
_PAPER_X: tuple[Exponents, ...] = (
    (1, 0, 1, 0),
    (1, 0, 0, 1),
    (1, 0, 2, 0),
    (1, 0, 0, 2),
    (2, 0, 1, 0),
    (2, 0, 0, 1),
)
_PAPER_Y: tuple[Exponents, ...] = tuple((j, i, m, n) for i, j, m, n in _PAPER_X)
_PINHOLE_F = ((2, 0, 0, 0), (1, 1, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0))
_PINHOLE_G = ((1, 1, 0, 0), (0, 2, 0, 0), (2, 1, 0, 0), (0, 3, 0, 0))


@serializable("distortion.polynomial")
@dataclass(frozen=True)
class PolynomialDistortion:
    """The terms of f and g; their coefficients theta are an argument of every method.

    theta holds the coefficients of f's terms and then those of g's, in the terms' order. The unit
    of a coefficient is pixel^(1 - i - j - m - n), written pixel^(1 - degree) below.

    Attributes
    ----------
    f_terms, g_terms : tuple of (i, j, m, n)
        Powers of x, y, u and v of each term; any sequences of integers will do. One of the two may
        be empty.

    Raises
    ------
    InputError
        If a term is not four integers >= 0, has i + j < 1, or stands twice in f or in g; if there
        is none.

    References
    ----------
    Sun & Zhou, section 2.2 (polynomial approximation of the distortion functions).

    Examples
    --------
    >>> PolynomialDistortion(f_terms=[(1, 0, 2, 0), (2, 0, 0, 1)], g_terms=[(0, 1, 1, 1)]).names
    ('f_u2x', 'f_vx2', 'g_uvy')
    """

    f_terms: tuple[Exponents, ...]
    g_terms: tuple[Exponents, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "f_terms", _checked_terms("f", self.f_terms))
        object.__setattr__(self, "g_terms", _checked_terms("g", self.g_terms))
        if self.n_terms == 0:
            raise InputError("f_terms, g_terms: got no term, expected at least one (i, j, m, n)")

    @classmethod
    def paper(cls) -> Self:
        """Take the 12 terms as the paper prints them: f and g both in ux, vx, u^2 x, v^2 x, u x^2, v x^2.

        Examples
        --------
        >>> PolynomialDistortion.paper().names[6:]
        ('g_ux', 'g_vx', 'g_u2x', 'g_v2x', 'g_ux2', 'g_vx2')
        """
        return cls(_PAPER_X, _PAPER_X)

    @classmethod
    def mirrored(cls) -> Self:
        """Take the 12 terms of the paper's Fig. 2b: f as in `paper`, g in uy, vy, u^2 y, v^2 y, u y^2, v y^2.

        Examples
        --------
        >>> PolynomialDistortion.mirrored().names[6:]
        ('g_uy', 'g_vy', 'g_u2y', 'g_v2y', 'g_uy2', 'g_vy2')
        """
        return cls(_PAPER_X, _PAPER_Y)

    @classmethod
    def pinhole(cls) -> Self:
        """Take the 8 terms of the pinhole camera that the paper compares with.

        x_d = x (1 + k1 x + k2 y + k3 x^2 + k4 y^2) is the place u where u - x + f vanishes for f =
        -(k1 x^2 + k2 xy + k3 x^3 + k4 x y^2), and y_d = y (1 + k5 x + k6 y + k7 x^2 + k8 y^2)
        likewise: theta = -(k1, ..., k8).

        Examples
        --------
        >>> PolynomialDistortion.pinhole().names
        ('f_x2', 'f_xy', 'f_x3', 'f_xy2', 'g_xy', 'g_y2', 'g_x2y', 'g_y3')
        """
        return cls(_PINHOLE_F, _PINHOLE_G)

    @classmethod
    def full_polynomial(cls, degree: int) -> Self:
        """Take every term of total degree i + j + m + n from 2 to `degree` with i + j >= 1, in f and in g.

        They are ordered by total degree and, within one degree, by falling power of u, then of v,
        then of x.

        Parameters
        ----------
        degree : int
            Highest total degree, at least 2.

        Raises
        ------
        InputError
            If `degree` is not an integer >= 2.

        Examples
        --------
        >>> PolynomialDistortion.full_polynomial(2).names[:7]
        ('f_ux', 'f_uy', 'f_vx', 'f_vy', 'f_x2', 'f_xy', 'f_y2')
        """
        if not isinstance(degree, int | np.integer) or degree < 2:
            raise InputError(f"degree: got {degree!r}, expected an integer of at least 2")
        terms = tuple(_complete_terms(int(degree)))
        return cls(terms, terms)

    @property
    def n_terms(self) -> int:
        """Number of coefficients, those of f and of g together."""
        return len(self.f_terms) + len(self.g_terms)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coefficient in theta's order: the letter, then the powers of u, v, x, y."""
        f_names = tuple(_term_name("f", term) for term in self.f_terms)
        return f_names + tuple(_term_name("g", term) for term in self.g_terms)

    def displacement(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Evaluate f and g.

        Parameters
        ----------
        theta : array_like, shape (n_terms,), pixel^(1 - degree)
            Coefficients.
        u, v : array_like, pixel
            Image point, from the middle of the frame.
        x, y : array_like, pixel
            Object point; all four are broadcast against each other.

        Returns
        -------
        f, g : ndarray, the broadcast shape, pixel

        Raises
        ------
        InputError
            If `theta` does not have one value a term.

        Examples
        --------
        >>> f, g = PolynomialDistortion([(1, 0, 0, 1)], []).displacement([1e-3], u=1.0, v=20.0, x=30.0, y=4.0)
        >>> print(f, g)
        0.6 0.0
        """
        f_theta, g_theta = self._split(theta)
        point = _point(u, v, x, y)
        return _polynomial(f_theta, self.f_terms, point), _polynomial(g_theta, self.g_terms, point)

    def determinant(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> Floats:
        """Jacobian determinant D = (1 + f_u)(1 + g_v) - f_v g_u of (a, b) with respect to (u, v).

        |D| is the factor that makes the kernel integrate to one over (u, v); where D changes sign
        the image folds. Arguments and errors are those of `displacement`.

        Returns
        -------
        determinant : ndarray, the broadcast shape, dimensionless
        """
        f_theta, g_theta = self._split(theta)
        point = _point(u, v, x, y)
        f_u, f_v = (_polynomial(f_theta, self.f_terms, point, along) for along in (U, V))
        g_u, g_v = (_polynomial(g_theta, self.g_terms, point, along) for along in (U, V))
        return np.asarray((1.0 + f_u) * (1.0 + g_v) - f_v * g_u)

    def image_position(self, theta: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Where the image of an object point stands: the (u, v) with u - x + f = 0 and v - y + g = 0.

        Newton's method with the analytic derivatives, from (u, v) = (x, y).

        Parameters
        ----------
        theta : array_like, shape (n_terms,), pixel^(1 - degree)
            Coefficients.
        x, y : array_like, pixel
            Object points, broadcast against each other.

        Returns
        -------
        u, v : ndarray, the broadcast shape, pixel
            NaN where Newton's method does not converge.

        Raises
        ------
        InputError
            If `theta` does not have one value a term.

        Examples
        --------
        >>> u, v = PolynomialDistortion([(2, 0, 0, 0)], []).image_position([-1e-3], x=100.0, y=50.0)
        >>> print(u, v)
        110.0 50.0
        """
        f_theta, g_theta = self._split(theta)
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))

        def residual(u: Floats, v: Floats) -> tuple[Floats, ...]:
            point = (x, y, u, v)
            return (
                u - x + _polynomial(f_theta, self.f_terms, point),
                v - y + _polynomial(g_theta, self.g_terms, point),
                1.0 + _polynomial(f_theta, self.f_terms, point, U),
                _polynomial(f_theta, self.f_terms, point, V),
                _polynomial(g_theta, self.g_terms, point, U),
                1.0 + _polynomial(g_theta, self.g_terms, point, V),
            )

        return _newton(residual, x, y)

    def object_position(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Which object point is imaged at (u, v): the inverse of `image_position`, solved the same way.

        Parameters
        ----------
        theta : array_like, shape (n_terms,), pixel^(1 - degree)
            Coefficients.
        u, v : array_like, pixel
            Image points, broadcast against each other.

        Returns
        -------
        x, y : ndarray, the broadcast shape, pixel
            NaN where Newton's method does not converge.

        Raises
        ------
        InputError
            If `theta` does not have one value a term.
        """
        f_theta, g_theta = self._split(theta)
        u, v = np.broadcast_arrays(np.asarray(u, dtype=float), np.asarray(v, dtype=float))

        def residual(x: Floats, y: Floats) -> tuple[Floats, ...]:
            point = (x, y, u, v)
            return (
                u - x + _polynomial(f_theta, self.f_terms, point),
                v - y + _polynomial(g_theta, self.g_terms, point),
                _polynomial(f_theta, self.f_terms, point, X) - 1.0,
                _polynomial(f_theta, self.f_terms, point, Y),
                _polynomial(g_theta, self.g_terms, point, X),
                _polynomial(g_theta, self.g_terms, point, Y) - 1.0,
            )

        return _newton(residual, u, v)

    def _split(self, theta: ArrayLike) -> tuple[Floats, Floats]:
        """Theta's two halves, those of f and of g, after a check of its shape."""
        values = np.asarray(theta, dtype=float)
        if values.shape != (self.n_terms,):
            raise InputError(
                f"theta: got shape {values.shape}, expected ({self.n_terms},): one value each for "
                f"{', '.join(self.names)}"
            )
        return values[: len(self.f_terms)], values[len(self.f_terms) :]


def _checked_terms(letter: str, terms: Sequence[Sequence[int]]) -> tuple[Exponents, ...]:
    """Turn the terms into tuples of integers, or raise an InputError that names the first bad one."""
    checked: list[Exponents] = []
    for term in terms:
        try:
            i, j, m, n = (operator.index(power) for power in term)
        except (TypeError, ValueError):
            raise InputError(
                f"{letter}_terms: got {term!r}, expected four integers (i, j, m, n): the powers "
                "of x, y, u, v"
            ) from None
        powers = (i, j, m, n)
        if min(powers) < 0:
            raise InputError(f"{letter}_terms: got {powers}, expected powers (i, j, m, n) >= 0")
        named = f"{letter}_terms: got {_term_name(letter, powers)} {powers}"
        if i + j < 1:
            raise InputError(
                f"{named}, which breaks the distortion-free condition at the axis; expected i + j "
                ">= 1: "
                "give the term a power of x or y, or leave it out"
            )
        if powers in checked:
            raise InputError(f"{named} twice, expected every term once: remove one")
        checked.append(powers)
    return tuple(checked)


def _complete_terms(degree: int) -> Iterator[Exponents]:
    for total in range(2, degree + 1):
        for m in range(total, -1, -1):
            for n in range(total - m, -1, -1):
                rest = total - m - n
                if rest > 0:
                    yield from ((i, rest - i, m, n) for i in range(rest, -1, -1))


def _term_name(letter: str, term: Sequence[int]) -> str:
    powers = [(symbol, term[place]) for symbol, place in (("u", U), ("v", V), ("x", X), ("y", Y))]
    written = [
        symbol if power == 1 else f"{symbol}{power}" for symbol, power in powers if power > 0
    ]
    return f"{letter}_{''.join(written) or '1'}"


def _point(u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[Floats, ...]:
    """Broadcast the four coordinates, in the order of an exponent tuple."""
    return np.broadcast_arrays(*(np.asarray(value, dtype=float) for value in (x, y, u, v)))


def _polynomial(
    theta: Floats,
    terms: Sequence[Sequence[int]],
    point: tuple[Floats, ...],
    along: int | None = None,
) -> Floats:
    """Sum theta x^i y^j u^m v^n over the terms, or its derivative along one of the four variables."""
    total = np.zeros(point[0].shape)
    for coefficient, term in zip(theta, terms, strict=True):
        powers = list(term)
        if along is not None:
            coefficient = coefficient * powers[along]
            powers[along] -= 1
        if coefficient == 0.0:  # also leaves out x^-1, the derivative of a term without x
            continue
        monomial = np.full(point[0].shape, coefficient)
        for value, power in zip(point, powers, strict=True):
            if power > 0:
                monomial *= value**power
        total += monomial
    return total


def _newton(
    residual: Callable[[Floats, Floats], tuple[Floats, ...]],
    p: Floats,
    q: Floats,
) -> tuple[Floats, Floats]:
    """Solve two equations at every point, from (p, q).

    `residual` gives (r, s, r_p, r_q, s_p, s_q); a step is Cramer's rule on [[r_p, r_q], [s_p,
    s_q]]. A point is done with the first step below the tolerance and is then left alone: the next
    would be rounding.
    """
    scale = np.maximum(np.maximum(np.abs(p), np.abs(q)), 1.0)
    p, q = p.copy(), q.copy()
    moving = np.ones(p.shape, dtype=bool)
    with np.errstate(all="ignore"):  # a point that diverges overflows; it becomes NaN below
        for _ in range(MAX_ITERATIONS):
            r, s, r_p, r_q, s_p, s_q = residual(p, q)
            determinant = r_p * s_q - r_q * s_p
            step_p = (r * s_q - s * r_q) / determinant
            step_q = (s * r_p - r * s_p) / determinant
            p = np.where(moving, p - step_p, p)
            q = np.where(moving, q - step_q, q)
            moving &= ~(np.maximum(np.abs(step_p), np.abs(step_q)) <= RELATIVE_TOLERANCE * scale)
            if not moving.any():
                break
    return np.where(moving, np.nan, p), np.where(moving, np.nan, q)
