"""f and g as polynomials in any linear basis: evaluated, inverted, linear in their coefficients.

The coefficients theta of a distortion are those of its monomials, or of any linear combinations of
them: with a basis T the monomials have the coefficients T theta. The compiled loops know monomials
alone. A derivative with respect to theta is T^T times that with respect to the monomials'
coefficients, and the Fisher information T^T I T. `distortion` gives this class its constructors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.bases import checked_basis
from bayesfred.imaging.inverse import (
    Terms,
    displacement_jacobian,
    image_positions,
    object_positions,
)
from bayesfred.imaging.monomials import (
    Exponents,
    U,
    V,
    broadcast,
    checked_terms,
    monomials,
    polynomial,
    term_name,
)

# The default priors let a term move an image by a tenth of the frame's half-width. So much may u
# differ from x, and v from y.
SHRINKAGES = (1.0, 0.9)
GRID = 17  # points along each axis of the frame at which displacements are computed


@dataclass(frozen=True, eq=False)
class Polynomial:
    """A polynomial displacement field; `distortion.PolynomialDistortion` documents the fields."""

    f_terms: tuple[Exponents, ...]
    g_terms: tuple[Exponents, ...]
    basis: Floats | None = None
    labels: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "f_terms", checked_terms("f", self.f_terms))
        object.__setattr__(self, "g_terms", checked_terms("g", self.g_terms))
        monomials = len(self.f_terms) + len(self.g_terms)
        if monomials == 0:
            raise InputError("f_terms, g_terms: got no term, expected at least one (i, j, m, n)")
        if self.basis is not None:
            object.__setattr__(self, "basis", checked_basis(self.basis, monomials))
        labels = self.labels.split() if isinstance(self.labels, str) else list(self.labels)
        expected = 0 if self.basis is None else self.basis.shape[1]
        if len(set(labels)) != expected or not all(map(str.isidentifier, labels)):
            raise InputError(
                f"labels: got {', '.join(labels) or 'none'}, expected {expected} different "
                "identifiers: one name for every column of the basis"
            )
        object.__setattr__(self, "labels", " ".join(labels))

    @property
    def n_terms(self) -> int:
        """Number of coefficients, those of f and of g together."""
        monomials = len(self.f_terms) + len(self.g_terms)
        return monomials if self.basis is None else int(self.basis.shape[1])

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coefficient in theta's order.

        The basis' labels; or of a monomial the letter, then the powers of u, v, x, y.
        """
        if self.basis is not None:
            return tuple(self.labels.split())
        f_names = tuple(term_name("f", term) for term in self.f_terms)
        return f_names + tuple(term_name("g", term) for term in self.g_terms)

    def __eq__(self, other: object) -> bool:
        """Whether both have the same terms in the same basis."""
        return type(other) is type(self) and self._identity == other._identity

    def __hash__(self) -> int:
        """Agrees with equality."""
        return hash(self._identity)

    @property
    def _identity(self) -> tuple[object, ...]:
        basis = None if self.basis is None else self.basis.tobytes()
        return self.f_terms, self.g_terms, basis, self.labels

    def monomial_coefficients(self, theta: ArrayLike) -> Floats:
        """Coefficients of the monomials of f, then of g: T theta.

        Parameters
        ----------
        theta : array_like, shape (n_terms,) or (n, n_terms)
            Coefficients in this basis.

        Returns
        -------
        ndarray, shape (n_monomials,) or (n, n_monomials), pixel^(1 - degree)
            A row's values do not depend on the other rows, to the last bit.

        Raises
        ------
        InputError
            If `theta` does not have one value a term.
        """
        values = np.asarray(theta, dtype=np.float64)
        if values.ndim not in (1, 2) or values.shape[-1] != self.n_terms:
            raise self._misshapen(values)
        if self.basis is None:
            return values
        total = np.zeros((*values.shape[:-1], len(self.basis)))
        for k, column in enumerate(
            self.basis.T
        ):  # a matrix product rounds as the rows' number has it
            total += values[..., k, None] * column
        return total

    def pull_back(self, derivatives: Floats) -> Floats:
        """Derivatives with respect to theta from those with respect to the monomials: T^T d.

        Parameters
        ----------
        derivatives : ndarray, shape (n_monomials + k, ...)
            Along the first axis, derivatives with respect to the monomials' coefficients, then to
            any k other parameters, which are returned as they are.

        Returns
        -------
        ndarray, shape (n_terms + k, ...)

        Examples
        --------
        >>> import bayesfred as bf
        >>> scale = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)], [[1], [2]], "scale")
        >>> scale.pull_back(np.array([3.0, 4.0, 5.0])).tolist()
        [11.0, 5.0]
        """
        if self.basis is None:
            return derivatives
        n = len(self.basis)
        return np.concatenate([np.tensordot(self.basis.T, derivatives[:n], 1), derivatives[n:]])

    def design_matrix(self, u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike) -> Floats:
        """f and g of a unit of every coefficient: f, g = design_matrix(u, v, x, y) @ theta.

        Parameters
        ----------
        u, v, x, y : array_like, pixel
            Image and object points, broadcast against each other.

        Returns
        -------
        ndarray, shape (2, the broadcast shape, n_terms), pixel per unit of the coefficient

        Examples
        --------
        >>> import bayesfred as bf
        >>> field = bf.PolynomialDistortion([(1, 0, 0, 1)], [(0, 1, 0, 0)])
        >>> field.design_matrix(1.0, 20.0, 30.0, 4.0)
        array([[600.,   0.],
               [  0.,   4.]])
        """
        split = len(self.f_terms)
        each = monomials((*self.f_terms, *self.g_terms), broadcast(u, v, x, y))
        design = np.zeros((2, *each.shape))
        design[0, ..., :split] = each[..., :split]
        design[1, ..., split:] = each[..., split:]
        return design if self.basis is None else np.asarray(design @ self.basis)

    def largest_displacement(self, half_width: float, half_height: float) -> Floats:
        """The largest |f| and |g| over a frame that a unit of every coefficient makes.

        They are those at a grid of object points whose images stand where the sources do, or up
        to a tenth nearer to the axes: so a coefficient that only exchanges u for x has a
        displacement too. Between the grid's points displacements may exceed them by a few per cent.

        Parameters
        ----------
        half_width, half_height : float, pixel
            The frame extends to these values of |x| and |y|.

        Returns
        -------
        ndarray, shape (2, n_terms), pixel per unit of the coefficient

        Examples
        --------
        >>> import bayesfred as bf
        >>> field = bf.PolynomialDistortion([(2, 0, 1, 0)], [(0, 1, 0, 0)])
        >>> field.largest_displacement(10.0, 5.0)
        array([[1000.,    0.],
               [   0.,    5.]])
        """
        if self.basis is None:  # monomials are largest in the corner
            return np.abs(self.design_matrix(half_width, half_height, half_width, half_height))
        x, y = np.meshgrid(
            half_width * np.linspace(-1.0, 1.0, GRID), half_height * np.linspace(-1.0, 1.0, GRID)
        )
        shrunk = [(s * x, t * y) for s in SHRINKAGES for t in SHRINKAGES]
        images = [np.abs(self.design_matrix(u, v, x, y)).max(axis=(1, 2)) for u, v in shrunk]
        return np.asarray(np.max(images, axis=0))

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
        >>> import bayesfred as bf
        >>> field = bf.PolynomialDistortion([(1, 0, 0, 1)], [])
        >>> f, g = field.displacement([1e-3], u=1.0, v=20.0, x=30.0, y=4.0)
        >>> print(f, g)
        0.6 0.0
        """
        f, g = self._split(theta)
        point = broadcast(u, v, x, y)
        return polynomial(*f, point), polynomial(*g, point)

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
        f, g = self._split(theta)
        point = broadcast(u, v, x, y)
        f_u, f_v = (polynomial(*f, point, along) for along in (U, V))
        g_u, g_v = (polynomial(*g, point, along) for along in (U, V))
        return np.asarray((1.0 + f_u) * (1.0 + g_v) - f_v * g_u)

    def image_position(
        self, theta: ArrayLike, x: ArrayLike, y: ArrayLike, *, offset: ArrayLike = (0.0, 0.0)
    ) -> tuple[Floats, Floats]:
        """Where the image of an object point stands.

        It is the (u, v) with u - x + f = offset_x and v - y + g = offset_y, found by Newton's
        method with the analytic derivatives from (x, y) + offset.

        Parameters
        ----------
        theta : array_like, shape (n_terms,) or (n, n_terms), pixel^(1 - degree)
            Coefficients of one distortion, or of n.
        x, y : array_like, pixel
            Object points, broadcast against each other.
        offset : array_like, shape (2,) or (n, 2), pixel
            The pointing: `offset_x` and `offset_y` of a posterior.

        Returns
        -------
        u, v : ndarray, the broadcast shape, after n if there are n, pixel
            NaN where Newton's method does not converge.

        Raises
        ------
        InputError
            If `theta` does not have one value a term.

        Examples
        --------
        >>> import bayesfred as bf
        >>> field = bf.PolynomialDistortion([(2, 0, 0, 0)], [])
        >>> u, v = field.image_position([-1e-3], x=100.0, y=50.0)
        >>> print(u, v)
        110.0 50.0
        """
        x, y = np.broadcast_arrays(np.asarray(x, dtype=float), np.asarray(y, dtype=float))
        values = self.monomial_coefficients(theta)
        f, g = self._parts(np.atleast_2d(values))
        shifts = np.broadcast_to(np.asarray(offset, dtype=float), (len(f[0]), 2))
        u, v = image_positions(f, g, x.ravel(), y.ravel(), shifts)
        shape = (*values.shape[:-1], *x.shape)
        return u.reshape(shape), v.reshape(shape)

    def object_position(
        self, theta: ArrayLike, u: ArrayLike, v: ArrayLike, *, offset: ArrayLike = (0.0, 0.0)
    ) -> tuple[Floats, Floats]:
        """Which object point is imaged at (u, v): the inverse of `image_position`.

        Parameters
        ----------
        theta : array_like, shape (n_terms,) or (n, n_terms), pixel^(1 - degree)
            Coefficients: of one distortion, or of n that resemble each other, such as draws of a
            posterior.
        u, v : array_like, pixel
            Image points, broadcast against each other.
        offset : array_like, shape (2,) or (n, 2), pixel
            As for `image_position`.

        Returns
        -------
        x, y : ndarray, the broadcast shape, after n if there are n, pixel
            NaN where no object is imaged: beyond a fold of the map, seen from the axis.

        Raises
        ------
        InputError
            If `theta` does not have one value a term.

        Examples
        --------
        >>> import bayesfred as bf
        >>> field = bf.PolynomialDistortion([(2, 0, 0, 0)], [])
        >>> x, y = field.object_position([[-1e-3], [0.0]], u=110.0, v=50.0)
        >>> print(x, y)
        [100. 110.] [50. 50.]
        """
        u, v = np.broadcast_arrays(np.asarray(u, dtype=float), np.asarray(v, dtype=float))
        values = self.monomial_coefficients(theta)
        f, g = self._parts(np.atleast_2d(values))
        shifts = np.broadcast_to(np.asarray(offset, dtype=float), (len(f[0]), 2))
        x, y = object_positions(f, g, u.ravel(), v.ravel(), shifts)
        shape = (*values.shape[:-1], *u.shape)
        return x.reshape(shape), y.reshape(shape)

    def displacement_jacobian(
        self, theta: ArrayLike, u: Floats, v: Floats, *, offset: ArrayLike = (0.0, 0.0)
    ) -> Floats:
        """Derivatives of (u - x, v - y), the displacement of what is imaged at (u, v).

        Parameters
        ----------
        theta : array_like, shape (n_terms,), pixel^(1 - degree)
        u, v : ndarray, shape (points,), pixel
        offset : array_like, shape (2,), pixel
            As for `image_position`.

        Returns
        -------
        ndarray, shape (points, 2, n_terms + 2)
            With respect to the coefficients, pixel per unit of each, and to the offset. NaN where
            no object is imaged.

        Examples
        --------
        >>> import bayesfred as bf
        >>> scale = bf.PolynomialDistortion([(1, 0, 0, 0)], [])
        >>> scale.displacement_jacobian([0.0], np.array([30.0]), np.array([7.0]))[:, 0]
        array([[-30.,   1.,   0.]])
        """
        x, y = self.object_position(theta, u, v, offset=offset)
        f, g = self._parts(np.atleast_2d(self.monomial_coefficients(theta)))
        return displacement_jacobian(self.design_matrix(u, v, x, y), f, g, (u, v, x, y))

    def _split(self, theta: ArrayLike) -> tuple[Terms, Terms]:
        """The monomials of f and of g with their coefficients, after a check of theta's shape."""
        values = self.monomial_coefficients(theta)
        if values.ndim != 1:
            raise self._misshapen(values)
        return self._parts(values)

    def _parts(self, coefficients: Floats) -> tuple[Terms, Terms]:
        """The coefficients of f and of g, each with its monomials."""
        split = len(self.f_terms)
        return (
            (coefficients[..., :split], self.f_terms),
            (coefficients[..., split:], self.g_terms),
        )

    def _misshapen(self, values: Floats) -> InputError:
        return InputError(
            f"theta: got shape {values.shape}, expected ({self.n_terms},): one value each for "
            f"{', '.join(self.names)}"
        )
