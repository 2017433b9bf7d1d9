"""Iterations towards a fixed point, accelerated by what their last changes have in common.

An iteration moves a place z by a change f(z), which vanishes at the fixed point. Over the last few
places f is taken to be linear: the combination of them at which it would be least is moved by the
same combination of their changes.

References
----------
H. Walker & P. Ni, SIAM Journal on Numerical Analysis 49, 1715 (2011).
"""

from collections.abc import Sequence

import numpy as np

from bayesfred._typing import Floats


def accelerated(points: Sequence[tuple[Floats, Floats, Floats]]) -> Floats:
    """How far to go from the last of some places.

    Parameters
    ----------
    points : sequence of tuple of ndarray
        A place, its change, and the change as its length is measured; the latest last.

    Returns
    -------
    ndarray

    Examples
    --------
    Of a linear iteration two places along a line tell where it ends.

    >>> places = [np.array([8.0]), np.array([4.0])]
    >>> float(accelerated([(z, -0.5 * z, -0.5 * z) for z in places])[0])
    -4.0
    """
    _, change, measured = points[-1]
    if len(points) == 1:
        return change
    moved, changed, by = (np.diff(np.array(part), axis=0) for part in zip(*points, strict=True))
    shares = np.linalg.lstsq(by.T, measured)[0]
    return np.asarray(change - shares @ (moved + changed))
