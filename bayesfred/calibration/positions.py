"""Positions on both planes with their covariance, from draws of a distortion's coefficients.

To first order the covariance of a position is that of the delta method,

    cov(x, y) = A^-1 B C B^T A^-T,    cov(u, v) = D^-1 B C B^T D^-T,

with C the covariance of the coefficients and the offset, B the derivatives of a and b with respect
to them, and A and D the matrices of `imaging/inverse`. The draws give the same without that
approximation, for few points.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.inverse import slopes
from bayesfred.imaging.monomials import Exponents
from bayesfred.model.threads import one_blas_thread

__all__ = ["Method", "Positions", "broadcast_points"]

Method = Literal["delta", "draws"]
BLOCK = 2**13  # points whose covariances are computed at once: what fits the caches


class _Powers:
    """Powers of u, v, x and y at points, each computed once; of shape (points,)."""

    def __init__(self, u: Floats, v: Floats, x: Floats, y: Floats) -> None:
        self._of: list[list[Floats]] = [[np.ones_like(p), p] for p in (x, y, u, v)]

    def sums(self, terms: Sequence[Exponents], coefficients: Floats) -> Floats:
        """Sums of monomials with coefficients, shape (k, n_terms); shape (k, points)."""
        if not terms:
            return np.zeros((len(coefficients), self._of[0][0].size))
        return np.asarray(coefficients @ np.array([self._monomial(term) for term in terms]))

    def _monomial(self, term: Exponents) -> Floats:
        out = None
        for powers, exponent in zip(self._of, term, strict=True):
            while len(powers) <= exponent:
                powers.append(powers[-1] * powers[1])
            if exponent:
                out = powers[exponent] if out is None else out * powers[exponent]
        return self._of[0][0] if out is None else out


@dataclass(frozen=True, eq=False)
class Positions:
    """The map between object and image plane.

    Parameters
    ----------
    distortion : PolynomialDistortion
    draws : ndarray, shape (n, n_terms + 2)
        Draws of its coefficients and of the offset (pixel).
    """

    distortion: PolynomialDistortion
    draws: Floats

    @cached_property
    def mean(self) -> Floats:
        """Mean of the coefficients and the offset, shape (n_terms + 2,)."""
        return np.asarray(self.draws.mean(axis=0))

    @cached_property
    def covariance(self) -> Floats:
        """Their covariance, shape (n_terms + 2, n_terms + 2)."""
        return np.atleast_2d(np.cov(self.draws, rowvar=False))

    @cached_property
    def root(self) -> Floats:
        """A triangular matrix R with covariance = R R^T.

        It is taken from the draws, so that coefficients of high powers, which are many orders of
        magnitude smaller than others, keep their digits.
        """
        triangle = np.linalg.qr(self.draws - self.mean).R
        return np.asarray(triangle.T / np.sqrt(len(self.draws) - 1.0))

    def image(
        self, x: Floats, y: Floats, method: Method = "delta"
    ) -> tuple[Floats, Floats, Floats]:
        """Images of object points, as `Calibration.to_image`.

        Parameters
        ----------
        x, y : ndarray, shape (...), pixel of the fine grid
        method : {"delta", "draws"}

        Returns
        -------
        u, v : ndarray, shape (...), pixel
        covariance : ndarray, shape (..., 2, 2), pixel^2
        """
        if method == "draws":
            return self._of_draws(x, y, images=True)
        with _threads(x.size):
            u, v = self.distortion.image_position(self.mean[:-2], x, y, offset=self.mean[-2:])
            return u, v, self._delta((u, v, x, y), images=True)

    def object(
        self, u: Floats, v: Floats, method: Method = "delta"
    ) -> tuple[Floats, Floats, Floats]:
        """Objects that are imaged at points, as `Calibration.to_object`.

        Parameters
        ----------
        u, v : ndarray, shape (...), pixel of the fine grid
        method : {"delta", "draws"}

        Returns
        -------
        x, y : ndarray, shape (...), pixel
        covariance : ndarray, shape (..., 2, 2), pixel^2
        """
        if method == "draws":
            return self._of_draws(u, v, images=False)
        with _threads(u.size):
            x, y = self.distortion.object_position(self.mean[:-2], u, v, offset=self.mean[-2:])
            return x, y, self._delta((u, v, x, y), images=False)

    def slope(self, at: tuple[Floats, Floats, Floats, Floats], *, images: bool = True) -> Floats:
        """The matrix D of images, or A of objects.

        Parameters
        ----------
        at : tuple of ndarray, shape (...), pixel
            Image points and the objects that are imaged there: u, v, x, y.
        images : bool

        Returns
        -------
        ndarray, shape (..., 2, 2)
        """
        theta = self.distortion.monomial_coefficients(self.mean[None, :-2])
        split = len(self.distortion.f_terms)
        f = theta[:, :split], self.distortion.f_terms
        g = theta[:, split:], self.distortion.g_terms
        u, v, x, y = (np.ravel(p) for p in at)
        return slopes(f, g, (u, v, x, y), images=images).reshape(*at[0].shape, 2, 2)

    def _of_draws(self, p: Floats, q: Floats, *, images: bool) -> tuple[Floats, Floats, Floats]:
        """Mean and covariance of the positions that the draws give."""
        to = self.distortion.image_position if images else self.distortion.object_position
        found = np.array(to(self.draws[:, :-2], p, q, offset=self.draws[:, -2:]))
        mean = found.mean(axis=1)
        off = found - mean[:, None]
        covariance = np.einsum("in...,jn...->...ij", off, off) / (len(self.draws) - 1)
        return mean[0], mean[1], covariance

    def _delta(self, at: tuple[Floats, Floats, Floats, Floats], *, images: bool) -> Floats:
        """The covariance to first order at points u, v, x, y, shape (..., 2, 2)."""
        split, root = len(self.distortion.f_terms), self.root
        basis = self.distortion.basis
        terms = root[:-2] if basis is None else basis @ root[:-2]  # of the monomials
        u, v, x, y = (np.ravel(p) for p in at)
        out = np.empty((u.size, 2, 2))
        for first in range(0, u.size, BLOCK):
            some = slice(first, first + BLOCK)
            part = u[some], v[some], x[some], y[some]
            powers = _Powers(*part)
            a = powers.sums(self.distortion.f_terms, terms[:split].T) - root[-2, :, None]
            b = powers.sums(self.distortion.g_terms, terms[split:].T) - root[-1, :, None]
            left, cross, right = (np.einsum("kp,kp->p", p, q) for p, q in ((a, a), (a, b), (b, b)))
            m = self.slope(part, images=images)
            inverse = np.empty_like(m)  # of many small matrices at once
            inverse[:, 0, 0], inverse[:, 1, 1] = m[:, 1, 1], m[:, 0, 0]
            inverse[:, 0, 1], inverse[:, 1, 0] = -m[:, 0, 1], -m[:, 1, 0]
            determinant = m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 1, 0]
            inverse /= determinant[:, None, None]
            middle = np.moveaxis(np.array([[left, cross], [cross, right]]), 2, 0)
            out[some] = inverse @ middle @ inverse.swapaxes(1, 2)
        return out.reshape(*at[0].shape, 2, 2)


def _threads(size: int) -> AbstractContextManager[object]:
    """One thread for the small matrix products of many blocks; setting that takes a millisecond."""
    return one_blas_thread() if size > BLOCK else nullcontext()


def broadcast_points(p: npt.ArrayLike, q: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Two arrays of one shape.

    Parameters
    ----------
    p, q : array_like

    Returns
    -------
    ndarray, ndarray

    Raises
    ------
    InputError
        If they are no numbers, or cannot be broadcast against each other.
    """
    try:
        first, second = np.broadcast_arrays(
            np.asarray(p, dtype=np.float64), np.asarray(q, dtype=np.float64)
        )
    except (TypeError, ValueError):
        raise InputError(
            f"points: got {np.shape(p)} and {np.shape(q)}, expected numbers that can be broadcast "
            "against each other"
        ) from None
    return first, second
