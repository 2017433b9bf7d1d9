"""Cubic splines on square grids: from values at the knots to coefficients, and back."""

import numpy as np
from scipy import linalg, ndimage

from bayesfred._typing import Floats


def spline_coefficients(values: Floats) -> Floats:
    """Coefficients of the cubic spline through the values.

    Along either axis (c[i - 1] + 4 c[i] + c[i + 1]) / 6 = value, with zeros outside.

    Parameters
    ----------
    values : ndarray, shape (n, n)

    Returns
    -------
    ndarray, shape (n, n)
    """
    bands = np.array([np.full(len(values), 1.0 / 6.0), np.full(len(values), 4.0 / 6.0)])
    return np.asarray(linalg.solveh_banded(bands, linalg.solveh_banded(bands, values).T).T)


def values_at_knots(c: Floats) -> Floats:
    """The values of a spline at its knots.

    Parameters
    ----------
    c : ndarray, shape (n, n)
        Its coefficients.

    Returns
    -------
    ndarray, shape (n, n)

    Examples
    --------
    >>> float(values_at_knots(np.ones((3, 3)))[1, 1].round(9))
    1.0
    """
    kernel = np.array([1.0, 4.0, 1.0]) / 6.0
    once = ndimage.convolve1d(c, kernel, axis=0, mode="constant")
    return np.asarray(ndimage.convolve1d(once, kernel, axis=1, mode="constant"))
