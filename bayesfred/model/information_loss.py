"""What a posterior does not know because its PSF was measured.

With the PSF fixed at its estimate the parameters have the information I. The PSF's own errors,
propagated, widen their covariance from I^-1 to I^-1 + I^-1 G I^-1, with G the covariance of the
log-posterior's gradient at its maximum as the PSF is drawn from its own posterior. The information
that remains is R, its inverse, and S = I - R is lost. For a PSF that was measured on the same frame
R is Schur's complement of the joint information of parameters and PSF (Woodbury's identity). The
log-posterior with the PSF integrated out is, to that order,

    log p(theta) + (theta - centre)^T S (theta - centre) / 2

The second term could outgrow the first far away, where neither expansion holds. So it is bounded
where the remaining information puts theta beyond `FARTHEST` standard deviations.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable

FARTHEST = 30.0
MOST = 0.9999  # of the information in any direction that may be lost


@serializable("information_loss")
@dataclass(frozen=True, eq=False)
class InformationLoss:
    """Information that the errors of a PSF take from the parameters.

    Attributes
    ----------
    names : tuple of str, length d
        Parameters.
    centre : ndarray, shape (d,)
        Their most probable values, about which the loss is known.
    lost, remaining : ndarray, shape (d, d)
        S and R.
    absorbed : float
        How many numbers of the PSF the same frame's counts determined: they are fitted, too.

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> loss = InformationLoss(("f_x",), np.zeros(1), np.array([[3.0]]), np.array([[1.0]]))
    >>> loss.log_factor(np.array([[2.0]]))
    array([6.])
    """

    names: tuple[str, ...]
    centre: Floats
    lost: Floats
    remaining: Floats
    absorbed: float = 0.0

    def __post_init__(self) -> None:
        d = len(self.names)
        if self.centre.shape != (d,) or not self.lost.shape == self.remaining.shape == (d, d):
            raise InputError(
                f"loss: got shapes {self.centre.shape}, {self.lost.shape} and "
                f"{self.remaining.shape}, expected ({d},) and ({d}, {d})"
            )

    @classmethod
    def of(
        cls,
        names: tuple[str, ...],
        centre: Floats,
        information: Floats,
        gradients: Floats,
        absorbed: float = 0.0,
    ) -> Self:
        """The loss that gradients of the log-posterior, one for each draw of a PSF, stand for.

        Parameters
        ----------
        names : tuple of str, length d
        centre : ndarray, shape (d,)
        information : ndarray, shape (d, d)
            With the PSF fixed, I.
        gradients : ndarray, shape (draws, d)
        absorbed : float

        Returns
        -------
        InformationLoss
        """
        scale = 1.0 / np.sqrt(np.diag(information))
        lower = linalg.cholesky(information * np.outer(scale, scale), lower=True)
        white = linalg.solve_triangular(lower, (gradients * scale).T, lower=True)
        added = np.atleast_2d(np.cov(white))  # in units in which I is the identity
        half = linalg.solve(np.eye(len(added)) + added, added, assume_a="pos")
        back = lower / scale[:, None]
        lost = back @ (0.5 * (half + half.T)) @ back.T
        return cls(names, centre, lost, information - lost, absorbed)

    def log_factor(self, params: Floats) -> Floats:
        """What the log-posterior gains at parameter vectors, shape (n, d)."""
        d = params - self.centre
        gained = np.einsum("ni,ij,nj->n", d, self.lost, d)
        far = np.einsum("ni,ij,nj->n", d, self.remaining, d) / FARTHEST**2
        return np.asarray(0.5 * gained / np.maximum(far, 1.0))

    def gradient(self, params: Floats) -> Floats:
        """Derivatives of `log_factor` at one parameter vector, shape (d,)."""
        d = params - self.centre
        slope, gained = self.lost @ d, d @ self.lost @ d
        far = d @ self.remaining @ d / FARTHEST**2
        if far <= 1.0:
            return np.asarray(slope)
        return np.asarray(slope / far - gained / far**2 * (self.remaining @ d) / FARTHEST**2)

    def left_of(self, information: Floats) -> Floats:
        """What is left of information, shape (d, d), about the parameters."""
        scale = 1.0 / np.sqrt(np.diag(information))
        lower = linalg.cholesky(information * np.outer(scale, scale), lower=True)
        white = linalg.solve_triangular(lower, self.lost * np.outer(scale, scale), lower=True)
        shares, axes = linalg.eigh(linalg.solve_triangular(lower, white.T, lower=True))
        kept = (lower / scale[:, None]) @ axes * np.sqrt(1.0 - np.clip(shares, 0.0, MOST))
        return np.asarray(kept @ kept.T)
