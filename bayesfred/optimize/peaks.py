"""Peaks of a frame: where something as wide as the PSF is imaged."""

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.model.posterior import Posterior

SIGNIFICANCE = 4.0  # of a peak, in standard deviations of the filtered frame


def find_peaks(posterior: Posterior) -> Floats:
    """Positions of peaks as wide as the PSF on any smooth background, strongest first.

    There are at most 3 a source. The frame, binned to what the PSF resolves, is filtered with minus
    the Laplacian of the PSF. Where there are B counts a pixel, the filtered frame's variance is
    B / 2 pi s^6, s being the PSF's width.

    Returns
    -------
    ndarray, shape (n, 2), fine pixel
        u, v.
    """
    detector = posterior.model.detector
    step = detector.binning
    width = np.hypot(posterior.model.psf.sigma / step, 12.0**-0.5)
    block = max(1, min(int(width / 1.5), min(detector.shape) // 3))
    s = max(np.sqrt(width**2 + (block**2 - 1) / 12.0) / block, 1.0)
    ny, nx = (n // block for n in detector.shape)

    def binned(frame: Floats) -> Floats:
        return np.asarray(
            frame[: ny * block, : nx * block].reshape(ny, block, nx, block).sum(axis=(1, 3))
        )

    used = binned(posterior.mask.astype(np.float64))
    total = binned(np.where(posterior.mask, posterior.counts, 0.0))
    level = float(np.median(total[used > 0] / used[used > 0])) if used.any() else 0.0
    filled = np.where(posterior.mask, posterior.counts, level)
    each = posterior.noise.counts_variance(np.maximum(filled, 1e-9), max(level, 1e-9))
    variance = ndimage.gaussian_filter(binned(each), s) / (2.0 * np.pi * s**6)
    filtered = -ndimage.gaussian_laplace(binned(filled), s)
    peak = filtered == ndimage.maximum_filter(filtered, 3)
    peak &= filtered > SIGNIFICANCE * np.sqrt(variance)
    peak &= used > 0.5 * block**2
    peak[[0, -1]] = peak[:, [0, -1]] = False
    j, i = np.nonzero(peak)
    order = np.argsort(-filtered[j, i])[: 3 * len(posterior.model.sources)]
    # from a block's index to the frame's middle, in fine pixels
    positions = block * (vertex(filtered, j, i)[order] + 0.5) - 0.5 * np.array(detector.shape)
    return np.asarray(positions[:, ::-1] * step)


def typical_flux(counts: Floats, mask: Flags, width: float, number: int) -> float:
    """The mean flux of the brightest peaks as wide as the PSF, on any smooth background.

    A Gaussian image of flux F and width s has the height F / 4 pi s^4 in the frame filtered with
    minus the Laplacian of such a one.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), counts
    mask : ndarray of bool, shape (ny, nx)
        The pixels to use.
    width : float, recorded pixel
        The PSF's, pixels included.
    number : int
        How many peaks: the number of sources.

    Returns
    -------
    float, counts
        At least 1.
    """
    heights = bright_peaks(counts, mask, width)[1][:number]
    return max(4.0 * np.pi * width**4 * float(np.mean(heights)), 1.0) if heights.size else 1.0


def bright_peaks(counts: Floats, mask: Flags, width: float) -> tuple[Floats, Floats]:
    """Peaks as wide as the PSF, on any smooth background, of a frame without a model.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), counts
    mask : ndarray of bool, shape (ny, nx)
        The pixels to use.
    width : float, recorded pixel
        The PSF's, pixels included.

    Returns
    -------
    positions : ndarray, shape (n, 2), recorded pixel
        u and v from the middle of the frame, highest first.
    heights : ndarray, shape (n,)
        In the frame filtered with minus the Laplacian of a Gaussian of this width.
    """
    filled = np.where(mask, counts, np.median(counts[mask]))
    filtered = -ndimage.gaussian_laplace(filled, width)
    peak = filtered == ndimage.maximum_filter(filtered, 2 * int(np.ceil(width)) + 1)
    noise = 1.4826 * np.median(np.abs(filtered - np.median(filtered)))
    row, column = np.nonzero(peak & mask & (filtered > SIGNIFICANCE * noise))
    order = np.argsort(-filtered[row, column], kind="stable")
    row, column = row[order], column[order]
    middle = 0.5 * (np.array(counts.shape) - 1.0)
    positions = (vertex(filtered, row, column) - middle)[:, ::-1]
    return np.asarray(positions), np.asarray(filtered[row, column])


def vertex(image: Floats, row: Ints, column: Ints) -> Floats:
    """Positions of peaks between pixels, shape (n, 2): the vertices of parabolas through three."""
    ny, nx = image.shape
    top = image[row, column]

    def shift(before: Floats, after: Floats) -> Floats:
        curvature = before + after - 2.0 * top
        along = np.zeros_like(top)  # along a ridge
        return np.asarray(
            np.divide(0.5 * (before - after), curvature, out=along, where=curvature < 0.0)
        )

    up = shift(image[np.maximum(row - 1, 0), column], image[np.minimum(row + 1, ny - 1), column])
    right = shift(image[row, np.maximum(column - 1, 0)], image[row, np.minimum(column + 1, nx - 1)])
    return np.stack([row + up, column + right], axis=1)
