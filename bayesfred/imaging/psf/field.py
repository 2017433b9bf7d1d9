"""What a PSF that varies over the field varies by: powers of the position, and nodes."""

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats


def field_powers(degree: int) -> tuple[tuple[int, int], ...]:
    """Powers of x and y of a polynomial's terms, the constant first.

    Parameters
    ----------
    degree : int

    Returns
    -------
    tuple of (int, int)

    Examples
    --------
    >>> field_powers(1)
    ((0, 0), (1, 0), (0, 1))
    """
    return tuple((k - j, j) for k in range(degree + 1) for j in range(k + 1))


def field_terms(
    x: npt.ArrayLike, y: npt.ArrayLike, degree: int, radius: float, nodes: int = 0
) -> Floats:
    """The terms (x / radius)^i (y / radius)^j of a polynomial over the field, then those of nodes.

    A node's term is 1 there and falls linearly to 0 at its neighbours, on a square grid over the
    field; beyond it the terms are those at its edge.

    Parameters
    ----------
    x, y : array_like, shape (n,), pixel
    degree : int
    radius : float, pixel
    nodes : int
        Along each axis, from -radius to radius.

    Returns
    -------
    ndarray, shape (n, terms)

    Examples
    --------
    >>> field_terms([20.0], [-5.0], 1, 10.0).tolist()
    [[1.0, 2.0, -0.5]]
    >>> field_terms([5.0], [-10.0], 0, 10.0, 2).tolist()
    [[1.0, 0.25, 0.75, 0.0, 0.0]]
    """
    s, t = np.asarray(x, dtype=float) / radius, np.asarray(y, dtype=float) / radius
    powers = [s**i * t**j for i, j in field_powers(degree)]
    at = [0.5 * (np.clip(z, -1.0, 1.0) + 1.0) * (nodes - 1) for z in (s, t)]
    along_x, along_y = ([np.maximum(1.0 - np.abs(z - k), 0.0) for k in range(nodes)] for z in at)
    return np.stack(powers + [b * a for b in along_y for a in along_x], axis=-1)
