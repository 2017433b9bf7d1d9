"""What displacements that neighbouring sources have in common add to the parameters' errors.

`position_scatter` takes sources for displaced independently of each other. Ghosts whose light has a
slope, a target that was machined in strokes, or a distortion finer than the terms displace
neighbours alike. Such displacements d are a random field along each axis, of covariance

    K(r) = sd^2 (1 + q) exp(-q),        q = sqrt(3) r / length,

between sources at a distance r: Matern's of smoothness 3/2, whose fields have a slope everywhere
and no curvature. Beside it each source has a scatter t of its own. With F_s the derivative of
source s's image by the parameters and D_s the variance that the fit takes its position to have, of
which tau_s^2 is the scatter's, the gradient of the log-posterior is moved by sum_s F_s^T D_s^-1
d_s. To its covariance, the information, this adds

    G = sum over s and t of F_s^T D_s^-1 K'(r_st) D_t^-1 F_t,

where K' is K, but sd^2 + t^2 - tau_s^2 for s = t. G makes the covariance W of `added_errors`; where
it would make errors smaller, they are left.

The frame tells the field where the terms do not follow it. How strong it is on the scale of the
frame, where they do, is what K makes of that.

References
----------
M. L. Stein (1999), Interpolation of Spatial Data, section 2.7: Matern's covariance.
T. G. Conley (1999), Journal of Econometrics 92, 1: errors of correlated observations.
"""

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.io.serialize import serializable
from bayesfred.model.added_errors import AddedErrors


class RandomField(NamedTuple):
    """A random field of displacements along each axis.

    Attributes
    ----------
    sd, length : float, pixel
    scatter : float, pixel
        Standard deviation of what displaces each source by itself.
    """

    sd: float
    length: float
    scatter: float = 0.0

    def covariance(self, distance: Floats) -> Floats:
        """Of the displacements at places that are so far from each other.

        Examples
        --------
        >>> RandomField(2.0, 10.0).covariance(np.array([0.0, 100.0])).round(3).tolist()
        [4.0, 0.0]
        """
        q = 3.0**0.5 / self.length * distance
        return np.asarray(self.sd**2 * (1.0 + q) * np.exp(-q))


@serializable("displacement_errors")
@dataclass(frozen=True, eq=False)
class DisplacementErrors(AddedErrors):
    """The covariance that displacements of neighbouring sources add to that of the parameters.

    Attributes
    ----------
    names : tuple of str, length d
        Parameters.
    covariance : ndarray, shape (d, d)
        W.
    sd, length, scatter : float, pixel
        Of the field; 0 of several frames together, each of which has its own.

    Raises
    ------
    InputError
        If the shapes differ.

    Examples
    --------
    >>> DisplacementErrors(("f_x",), np.array([[4.0]]), 0.01, 30.0, 0.002).field
    RandomField(sd=0.01, length=30.0, scatter=0.002)
    """

    label: ClassVar[str] = "displacement_errors"

    sd: float = 0.0
    length: float = 0.0
    scatter: float = 0.0

    @property
    def field(self) -> RandomField | None:
        """The field of a single frame."""
        return RandomField(self.sd, self.length, self.scatter) if self.sd > 0.0 else None
