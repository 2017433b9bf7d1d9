"""What the errors of a measured PSF add to those of the parameters.

The posterior has the PSF fixed at its estimate. Had it been another one, drawn from its own
posterior, the parameters would have come out elsewhere: `added_errors` says by how much, with G the
covariance of the gradients that such PSFs give at the old maximum. For a PSF that was measured on
the same frame the information that remains, the inverse of I^-1 + W, is Schur's complement of the
joint information of parameters and PSF (Woodbury's identity).

W hardly depends on how much positions or light scatter about the model, unlike the information that
is lost: the scatter widens what every source says, the PSF moves all of them together.

A model error is another matter. The PSF's numbers fit what the model lacks on their own stars, so
the residuals are too small for it. With the PSF integrated out, its likelihood is multiplied by the
volume of the PSF's posterior, which grows as the model error takes information away: see
`OccamFactor`.
"""

from dataclasses import dataclass, field
from typing import ClassVar, Self

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.psf import PSF, MeasuredPSF, PSFToMeasure
from bayesfred.io.serialize import serializable
from bayesfred.model.added_errors import AddedErrors, moved_by

MOST_LOST = 0.9  # of the information about the model error


def covariance_of(slopes: Floats) -> Floats:
    """The covariance of the gradients that draws of a PSF give, without those that have none.

    Parameters
    ----------
    slopes : ndarray, shape (draws, d)

    Returns
    -------
    ndarray, shape (d, d)
    """
    return np.atleast_2d(np.cov(slopes[np.isfinite(slopes).all(axis=1)].T))


def refuse_nodes(psf: PSF) -> None:
    """Refuse a PSF, also one to be measured, whose draws will not hold all of its errors.

    Parameters
    ----------
    psf : PSF

    Raises
    ------
    InputError
        If it varies between nodes.
    """
    if isinstance(psf, MeasuredPSF | PSFToMeasure) and psf.nodes:
        raise InputError(
            f"psf: got one that varies between {psf.nodes} x {psf.nodes} nodes, expected one with "
            "a degree for several frames: with nodes only the errors of what all sources have in "
            "common are kept; measure it with degree"
        )


@serializable("occam_factor")
@dataclass(frozen=True, eq=False)
class OccamFactor:
    """What the volume of a PSF's posterior says of the model error.

    Its logarithm is that of the volume at a model error eps over that without one,

        sum over k of n_k / 2 log(1 + (eps / s_k)^2):

    n_k numbers of the PSF are known by pixels whose noise is a share s_k of their light. This is
    the restricted likelihood of a variance.

    Attributes
    ----------
    numbers : ndarray, shape (k,)
        n.
    scales : ndarray, shape (k,)
        s.

    References
    ----------
    D. MacKay, Neural Computation 4, 415 (1992), Sect. 3. H. D. Patterson, R. Thompson (1971),
    Biometrika 58, 545: restricted maximum likelihood.

    Examples
    --------
    >>> factor = OccamFactor(np.array([2.0]), np.array([0.1]))
    >>> round(float(factor.log(0.1)), 6), round(float(factor.slope(0.1)), 6)
    (0.693147, 10.0)
    """

    numbers: Floats
    scales: Floats

    def log(self, error: Floats | float) -> Floats:
        """The logarithm at model errors, shape (n,)."""
        ratio = np.asarray(error)[..., None] / self.scales
        return np.asarray(0.5 * np.log1p(ratio**2) @ self.numbers)

    def slope(self, error: float) -> float:
        """The derivative of the logarithm."""
        return float(error / (self.scales**2 + error**2) @ self.numbers)

    def lost(self, error: float, known: float) -> float:
        """What is lost of the information that is known about the model error, to these numbers.

        A pixel's residual, of variance proportional to s^2 + eps^2, tells (d ln variance / d eps)^2
        / 2. The residuals of as many pixels as there are numbers tell nothing. Where these are
        about all, what is left is rounding.
        """
        lost = 2.0 * (error / (self.scales**2 + error**2)) ** 2 @ self.numbers
        return min(float(lost), MOST_LOST * known)


@serializable("psf_errors")
@dataclass(frozen=True, eq=False)
class PsfErrors(AddedErrors):
    """The covariance that the errors of a PSF add to that of the parameters.

    Attributes
    ----------
    names : tuple of str, length d
        Parameters.
    covariance : ndarray, shape (d, d)
        W.
    absorbed : float
        How many numbers of the PSF the same frame's counts determined: they are fitted, too.
    occam : OccamFactor or None
        What they say of the model error; None where it is no parameter.

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> PsfErrors(("f_x",), np.array([[4.0]])).absorbed
    0.0
    """

    absorbed: float = 0.0
    occam: OccamFactor | None = field(default=None, metadata={"since": 8})

    label: ClassVar[str] = "psf_errors"

    @classmethod
    def of(
        cls,
        names: tuple[str, ...],
        information: Floats,
        slopes: Floats,
        absorbed: float = 0.0,
        occam: OccamFactor | None = None,
    ) -> Self:
        """The errors that the slopes of the log-posterior with PSFs of their posterior stand for.

        Parameters
        ----------
        names : tuple of str, length d
        information : ndarray, shape (d, d)
            With the PSF fixed, I.
        slopes : ndarray, shape (d, d)
            Their covariance, G.
        absorbed : float
        occam : OccamFactor, optional

        Returns
        -------
        PsfErrors
        """
        return cls(names, moved_by(names, information, slopes), absorbed, occam)
