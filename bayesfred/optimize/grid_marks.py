"""Marks of a calibration target found in a frame, and dark ones made bright.

Marks are peaks of the frame filtered with minus the Laplacian of a Gaussian: that knows neither a
level nor a slope of the illumination. Filtered so with width s, an image of flux F and width w has
the height F / pi (w^2 + s^2)^2. Times s^2 that is highest at s = w. So the width is the one, of
some around a guess, at which the strongest marks are highest.

Dots are dark on a bright field, and sources of light are bright on a background. With the counts n
inverted to L - n the light that a dot keeps away is a source; the noise is still that of n.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, spatial

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError

__all__ = ["find_marks", "invert_dots"]

SIGNIFICANCE = 4.0  # of a mark, in standard deviations of the filtered frame
WIDTHS = (0.5, 0.7, 1.0, 1.4, 2.0)  # tried, in units of the guess
LONE = 0.85  # share of its height by which a pixel exceeds its highest neighbour: not an image
STEPS = 8


def invert_dots(counts: Floats, valid: Flags) -> tuple[Floats, Floats]:
    """Turn dark dots on a bright field into bright ones, with the variance of their noise.

    The variance of a pixel is the count that its neighbours let expect: the value there of a
    polynomial of degree 2 fitted to the 24 pixels around it. It is independent of the noise of the
    pixel itself, or pixels with fewer photons would count for more.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), photo-electrons
    valid : ndarray of bool, shape (ny, nx)
        The pixels to use.

    Returns
    -------
    inverted : ndarray, shape (ny, nx), counts
        Twice the level that one pixel in a thousand exceeds, less the counts.
    variance : ndarray, shape (ny, nx), counts^2
        Of `bayesfred.GaussianNoise`; read noise has to be added. At least 1.

    Raises
    ------
    InputError
        No pixel is valid.

    Examples
    --------
    >>> inverted, variance = invert_dots(np.full((9, 9), 100.0), np.ones((9, 9), dtype=bool))
    >>> float(inverted[4, 4]), round(variance[4, 4])
    (100.0, 100)
    """
    if not valid.any():
        raise InputError("valid: got no valid pixel, expected some to use")
    # twice the brightest: the background of what is inverted stays well above zero
    level = float(np.ceil(2.0 * np.percentile(counts[valid], 99.9)))
    filled = _filled(counts, valid, 1.0)
    y, x = np.mgrid[-2:3, -2:3].reshape(2, -1)
    others = (x != 0) | (y != 0)
    powers = np.stack([np.ones(25), x, y, x * x, x * y, y * y], axis=1)
    weights = np.zeros(25)
    weights[others] = np.linalg.pinv(powers[others])[0]
    expected = ndimage.correlate(filled, weights.reshape(5, 5), mode="nearest")
    # The mean of 1 / variance is 1 / expected (1 + w.w / expected): w.w more makes that right.
    return level - counts, np.maximum(expected + weights @ weights, 1.0)


def _filled(image: Floats, valid: Flags, width: float) -> Floats:
    """The image with the mean of what surrounds them in pixels that are not valid."""
    if valid.all():
        return image.astype(np.float64)
    weight = ndimage.gaussian_filter(valid.astype(np.float64), width, truncate=6.0)
    total = ndimage.gaussian_filter(np.where(valid, image, 0.0), width, truncate=6.0)
    level = float(np.median(image[valid]))
    near = np.divide(total, weight, out=np.full(image.shape, level), where=weight > 1e-6)
    return np.asarray(np.where(valid, image, near))


def find_marks(
    image: Floats, variance: Floats, valid: Flags, guess: float, number: int
) -> tuple[Floats, Floats]:
    """Centroids and fluxes of what may be a mark.

    Parameters
    ----------
    image : ndarray, shape (ny, nx), counts
        Marks are bright.
    variance : ndarray, shape (ny, nx), counts^2
    valid : ndarray of bool, shape (ny, nx)
        The pixels to use.
    guess : float, recorded pixel
        Of a mark's Gaussian width, within a factor of 2.
    number : int
        How many marks there are; at most 3 times as many peaks are looked at.

    Returns
    -------
    position : ndarray, shape (m, 2), pixel
        u and v from the middle of the frame, strongest first.
    flux : ndarray, shape (m,), counts
        Of a Gaussian with the height of the mark.

    Raises
    ------
    InputError
        No pixel is valid.
    """
    if not valid.any():
        raise InputError("valid: got no valid pixel, expected some to use")
    most = 3 * number
    lone = np.zeros(image.shape, dtype=bool)
    for side in (image, -image):
        highest = _highest(side)
        lowest = ndimage.minimum_filter(side, 3)
        lone |= (side - highest > LONE * (side - lowest)) & (
            side - highest > SIGNIFICANCE * np.sqrt(variance)
        )
    filled = _filled(image, valid & ~lone, guess)
    best: tuple[float, float, Floats, Floats] | None = None
    for s in sorted({max(0.7, factor * guess) for factor in WIDTHS}):
        filtered = -ndimage.gaussian_laplace(filled, s)
        error = np.sqrt(ndimage.gaussian_filter(variance, s) / (2.0 * np.pi * s**6))
        peak = filtered == ndimage.maximum_filter(filtered, 2 * int(np.ceil(s)) + 1)
        peak &= (filtered > SIGNIFICANCE * error) & valid
        row, column = np.nonzero(peak)
        order = np.argsort(-filtered[row, column])[:most]
        if not order.size:
            continue
        heights = filtered[row[order], column[order]]
        strong = heights[: min(number, max(25, number // 4))]
        strength = s**2 * float(np.median(strong))
        if best is None or strength > best[0]:
            best = (
                strength,
                s,
                np.stack([row[order], column[order]], axis=1).astype(np.float64),
                heights,
            )
    if best is None:
        return np.zeros((0, 2)), np.zeros(0)
    _, s, pixels, heights = best
    position = _centroids(filled, pixels, s)
    shape = np.array(image.shape)
    good = np.all((position > 0.5 * s) & (position < shape - 1.0 - 0.5 * s), axis=1)
    position, heights = position[good], heights[good]
    pairs = spatial.cKDTree(position).query_pairs(2.0 * s, output_type="ndarray")
    alone = np.ones(len(position), dtype=bool)
    alone[pairs.max(axis=1, initial=0)[: len(pairs)]] = False  # the weaker of two
    middle = 0.5 * (shape - 1.0)
    return (position[alone] - middle)[:, ::-1], 4.0 * np.pi * s**4 * heights[alone]


def _highest(image: Floats) -> Floats:
    """The highest of the eight neighbours of each pixel."""
    ring = np.ones((3, 3), dtype=bool)
    ring[1, 1] = False
    return np.asarray(ndimage.maximum_filter(image, footprint=ring))


def _centroids(image: Floats, pixels: Floats, s: float) -> Floats:
    """Where the filtered image is highest between pixels, shape (n, 2): row and column.

    With q = r^2 / 2 s^2 its gradient is the sum of the counts times (2 - q) exp(-q) times the
    vector to the pixel. Newton's method makes that vanish.
    """
    reach = int(np.ceil(4.5 * s))
    padded = np.pad(image, reach, mode="edge")
    step = np.arange(-reach, reach + 1)
    found = pixels.copy()
    for k, (row, column) in enumerate(pixels.astype(np.int64)):
        stamp = padded[row : row + 2 * reach + 1, column : column + 2 * reach + 1]
        stamp = stamp - stamp.mean()
        shift = np.zeros(2)
        for _ in range(STEPS):
            dy, dx = step - shift[0], step - shift[1]
            q = 0.5 * (dy[:, None] ** 2 + dx**2) / s**2
            light = stamp * np.exp(-q)
            first, second = (2.0 - q) * light, (q - 3.0) * light
            gradient = np.array([dy @ first.sum(axis=1), first.sum(axis=0) @ dx])
            mixed = dy @ second @ dx
            hessian = np.array(
                [[dy**2 @ second.sum(axis=1), mixed], [mixed, second.sum(axis=0) @ dx**2]]
            ) / s**2 + first.sum() * np.eye(2)  # fmt: skip
            if np.linalg.det(hessian) <= 0.0 or hessian[0, 0] <= 0.0:
                shift = np.zeros(2)
                break
            change = np.linalg.solve(hessian, gradient)
            shift = np.clip(shift + change, -s - 1.0, s + 1.0)
            if np.abs(change).max() < 1e-4:
                break
        found[k] += shift
    return found
