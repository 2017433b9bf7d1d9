"""Raw frames whose pixels differ by whether row and column are even, told before any fit.

A search for images, a target's marks or a PSF may fail on the raw frame of a colour camera, so that
no residuals tell why.
"""

import numpy as np

from bayesfred._typing import Flags, Floats

APART = 0.25  # share of the squares by which more of them have one kind of pixel above the others
MOST = 2048  # pixels along each axis, about the middle, that are looked at
FEWEST = 1000  # squares of 2 x 2 pixels, of which that share is known to 0.016


def alternating_message(counts: Floats, valid: Flags) -> str:
    """Say that pixels of even and odd rows and columns differ; empty if they do not.

    It is said if one kind is the brighter or the darker one in three quarters of all squares of 2 x
    2 pixels: of images on a grid, whose middles may all be in even pixels, it is in two thirds.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), counts
    valid : ndarray of bool, shape (ny, nx)
        Pixels that can be trusted.

    Returns
    -------
    str

    Examples
    --------
    >>> counts = np.random.default_rng(1).poisson(50.0, (80, 80)).astype(float)
    >>> alternating_message(counts, counts >= 0.0)
    ''
    >>> counts[::2, ::2] *= 0.6
    >>> alternating_message(counts, counts >= 0.0)[:37]
    'even and odd rows and columns differ:'
    """
    middle = middle_of(counts.shape)
    kept = np.where(valid[middle], counts[middle], np.nan)
    ny, nx = kept.shape
    squares = kept.reshape(ny // 2, 2, nx // 2, 2)
    kinds = squares.transpose(1, 3, 0, 2).reshape(4, -1)
    kinds = kinds[:, np.isfinite(kinds).all(axis=0)]
    if kinds.shape[1] < FEWEST:
        return ""
    above = np.sign(kinds - kinds.mean(axis=0)).mean(axis=1) / 2.0
    if np.abs(above - above.mean()).max() <= APART:
        return ""
    a, b, c, d = (f"{level:.4g}" for level in np.median(kinds, axis=1))
    return (
        f"even and odd rows and columns differ: {a} and {b} counts in even rows, {c} and {d} in "
        "odd ones; of a colour camera take the pixels of one colour, or set frame.flat to the "
        "relative response of every pixel; if amplifiers add constants, subtract a dark frame"
    )


def middle_of(shape: tuple[int, ...]) -> tuple[slice, ...]:
    """The part of a frame that is looked at: even numbers of pixels, from even ones on."""
    sides = [min(n, MOST) // 2 * 2 for n in shape]
    first = [(n - side) // 4 * 2 for n, side in zip(shape, sides, strict=True)]
    return tuple(slice(a, a + side) for a, side in zip(first, sides, strict=True))
