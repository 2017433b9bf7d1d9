"""Distortions: the displacement (f, g) of a point between the object and the image plane.

A point source at (x, y) of the object plane reaches the image point (u, v) with the reference PSF
at

    a = u - x + f(u, v, x, y),   b = v - y + g(u, v, x, y),

so its image stands where a = b = 0. `PolynomialDistortion` is what frames are fitted with: sums of
monomials x^i y^j u^m v^n, or of linear combinations of them. The distortion-free condition (a
source on the axis is not distorted) asks i + j >= 1 of every monomial. The pinhole camera with
polynomial distortion is the special case m = n = 0. `Distortion` is what a frame is simulated with;
`logarithm` has one that is not polynomial.

Here are the named distortions; `polynomial` evaluates them, `bases` has their terms, and the images
themselves come from `forward`.
"""

from __future__ import annotations

import math
import operator
from typing import Protocol, Self

from numpy.typing import ArrayLike

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging import bases
from bayesfred.imaging.polynomial import Polynomial
from bayesfred.io.serialize import serializable


class Distortion(Protocol):
    """What a frame is simulated with: a displacement, its determinant and image positions.

    Methods take the coefficients theta, shape (n_terms,), first; see `PolynomialDistortion`.
    """

    @property
    def n_terms(self) -> int:
        """Number of coefficients."""

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coefficient."""

    def displacement(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> tuple[Floats, Floats]:
        """Evaluate f and g, pixel."""

    def determinant(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike
    ) -> Floats:
        """Jacobian determinant of (a, b) with respect to (u, v)."""

    def image_position(self, theta: ArrayLike, x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
        """Where the image of an object point stands, pixel."""


@serializable("distortion.polynomial")
class PolynomialDistortion(Polynomial):
    """The terms of f and g; their coefficients theta are an argument of every method.

    theta holds the coefficients of f's terms and then those of g's, in the terms' order, or with a
    basis the coefficients that it names. The unit of a monomial's coefficient is
    pixel^(1 - i - j - m - n), written pixel^(1 - degree) below; the basis decides about others.

    Attributes
    ----------
    f_terms, g_terms : tuple of (i, j, m, n)
        Powers of x, y, u and v of each monomial; any sequences of integers will do. One of the two
        may be empty.
    basis : ndarray, shape (n_monomials, n_terms), optional
        Matrix T: the monomials of f, then those of g, have the coefficients T theta. None: theta
        itself. It is copied and made read-only.
    labels : str, optional
        With a basis, the names of its coefficients, separated by spaces; a sequence of names will
        do. They are identifiers that differ from each other.

    Raises
    ------
    InputError
        If a term is not four integers >= 0, has i + j < 1, or stands twice in f or in g; if there
        is none; if the basis is not a matrix of finite numbers with a row for every monomial and no
        column of zeros; if there are not as many valid labels as columns.

    References
    ----------
    Sun & Zhou, section 2.2 (polynomial approximation of the distortion functions).

    Examples
    --------
    >>> PolynomialDistortion(f_terms=[(1, 0, 2, 0), (2, 0, 0, 1)], g_terms=[(0, 1, 1, 1)]).names
    ('f_u2x', 'f_vx2', 'g_uvy')
    >>> scale = PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)], [[1.0], [1.0]], "scale")
    >>> scale.names, scale.monomial_coefficients([0.25]).tolist()
    (('scale',), [0.25, 0.25])
    """

    @classmethod
    def paper(cls) -> Self:
        """Take the 12 terms as the paper prints them.

        f and g are both in ux, vx, u^2 x, v^2 x, u x^2, v x^2.

        Examples
        --------
        >>> PolynomialDistortion.paper().names[6:]
        ('g_ux', 'g_vx', 'g_u2x', 'g_v2x', 'g_ux2', 'g_vx2')
        """
        return cls(bases.PAPER_X, bases.PAPER_X)

    @classmethod
    def mirrored(cls) -> Self:
        """Take the 12 terms of the paper's Fig. 2b.

        f is that of `paper`; g is in uy, vy, u^2 y, v^2 y, u y^2, v y^2.

        Examples
        --------
        >>> PolynomialDistortion.mirrored().names[6:]
        ('g_uy', 'g_vy', 'g_u2y', 'g_v2y', 'g_uy2', 'g_vy2')
        """
        return cls(bases.PAPER_X, bases.PAPER_Y)

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
        return cls(bases.PINHOLE_F, bases.PINHOLE_G)

    @classmethod
    def polynomial(cls, degree: int) -> Self:
        """Take every x^i y^j with 1 <= i + j <= degree, in f and in g: a polynomial of that order.

        The linear terms are among them: scale, rotation and shear of the field.

        Parameters
        ----------
        degree : int
            Highest degree, at least 1.

        Raises
        ------
        InputError
            If `degree` is not an integer >= 1.

        Examples
        --------
        >>> PolynomialDistortion.polynomial(2).names[:5]
        ('f_x', 'f_y', 'f_x2', 'f_xy', 'f_y2')
        """
        terms = tuple(bases.object_terms(_checked_degree(degree, 1)))
        return cls(terms, terms)

    @classmethod
    def full_polynomial(cls, degree: int) -> Self:
        """Take every term in u, v, x, y of total degree 2 to `degree` with i + j >= 1, in f and g.

        They are ordered by total degree and, within one degree, by falling power of u, then of v,
        then of x.

        Parameters
        ----------
        degree : int
            Highest total degree i + j + m + n, at least 2.

        Raises
        ------
        InputError
            If `degree` is not an integer >= 2.

        Examples
        --------
        >>> PolynomialDistortion.full_polynomial(2).names[:7]
        ('f_ux', 'f_uy', 'f_vx', 'f_vy', 'f_x2', 'f_xy', 'f_y2')
        """
        terms = tuple(bases.all_terms(_checked_degree(degree, 2)))
        return cls(terms, terms)

    @classmethod
    def radial_tangential(cls, focal_length: float = 1.0) -> Self:
        """Take OpenCV's lens model: k1, k2, k3, p1, p2 act on f and g alike.

        With x' = x / focal_length, y' = y / focal_length and r^2 = x'^2 + y'^2, the object point
        (x, y) is imaged at u = focal_length x'' and v = focal_length y'',

            x'' = x' (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x' y' + p2 (r^2 + 2 x'^2),
            y'' = y' (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y'^2) + 2 p2 x' y',

        so that f = x - u and g = y - v. OpenCV stores the same coefficients in the order k1, k2,
        p1, p2, k3.

        Parameters
        ----------
        focal_length : float, pixel
            OpenCV's f_x = f_y; the coefficients are then dimensionless. By default 1, which makes
            those of x and y in pixels: k1 in pixel^-2, k2 in pixel^-4, k3 in pixel^-6, p1 and p2 in
            pixel^-1.

        Raises
        ------
        InputError
            If `focal_length` is not a finite number > 0.

        References
        ----------
        OpenCV, "Camera Calibration and 3D Reconstruction", https://docs.opencv.org. D. C. Brown
        (1966), Photogrammetric Engineering 32, 444.

        Examples
        --------
        >>> lens = PolynomialDistortion.radial_tangential(focal_length=1000.0)
        >>> u, v = lens.image_position([-0.1, 0.0, 0.0, 0.0, 0.0], x=300.0, y=400.0)
        >>> print(u, v)
        292.5 390.0
        """
        return cls(*bases.radial_tangential(_checked_length("focal_length", focal_length)))

    @classmethod
    def zernike(cls, degree: int, radius: float = 1.0) -> Self:
        """Take Zernike's polynomials in (x, y) / radius up to radial degree `degree`, in f and g.

        Coefficient f_z3_1 belongs to R_3^1(r) cos(phi) and f_z3_m1 to R_3^1(r) sin(phi), pixel,
        with R(1) = 1. Constants, which the distortion-free condition forbids, are subtracted. The
        polynomials span the same distortions as `polynomial`.

        Parameters
        ----------
        degree : int
            Highest radial degree, at least 1.
        radius : float, pixel
            Where r = 1: the half-width of the frame, or the radius of the field. The coefficients
            are nearly uncorrelated for stars that fill this disc. By default 1, which leaves x and
            y in pixels; then the highest power dominates each polynomial, and the coefficients are
            as correlated as those of `polynomial`.

        Raises
        ------
        InputError
            If `degree` is not an integer >= 1, or `radius` is not a finite number > 0.

        References
        ----------
        M. Born & E. Wolf, Principles of Optics, section 9.2.1.

        Examples
        --------
        >>> field = PolynomialDistortion.zernike(2, radius=250.0)
        >>> field.names[:5]
        ('f_z1_m1', 'f_z1_1', 'f_z2_m2', 'f_z2_0', 'f_z2_2')
        >>> theta = [0.0, 0.0, 0.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
        >>> f, g = field.displacement(theta, u=0.0, v=0.0, x=250.0, y=0.0)
        >>> print(f, g)
        3.0 0.0
        """
        return cls(*bases.zernike(_checked_degree(degree, 1), _checked_length("radius", radius)))


def _checked_degree(degree: int, least: int) -> int:
    try:
        checked = operator.index(degree)
    except TypeError:
        checked = least - 1
    if checked < least:
        raise InputError(f"degree: got {degree!r}, expected an integer of at least {least}")
    return checked


def _checked_length(name: str, length: float) -> float:
    if not (math.isfinite(length) and length > 0.0):
        raise InputError(f"{name}: got {length!r}, expected a finite number of pixels > 0")
    return float(length)
