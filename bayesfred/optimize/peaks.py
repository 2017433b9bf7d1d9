"""Peaks of a frame: where something as wide as the PSF is imaged."""

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.model.posterior import Posterior

PART = 2**21  # pixels of a large frame that are filtered at once
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

    frame = _Binned(posterior, block, (ny, nx))
    # Large frames are filtered in bands of rows, with as many beside them as the filters reach.
    rows, margin = max(1, PART // (nx * block**2)), int(4.0 * s + 0.5) + 2
    level = frame.level(rows)
    places, heights = [np.empty((0, 2))], [np.empty(0)]
    for first in range(0, ny, rows):
        top, last = max(first - margin, 0), min(first + rows + margin, ny)
        counts, each, used = frame.filled(slice(top, last), level)
        variance = ndimage.gaussian_filter(each, s) / (2.0 * np.pi * s**6)
        filtered = -ndimage.gaussian_laplace(counts, s)
        peak = filtered == ndimage.maximum_filter(filtered, 3)
        peak &= filtered > SIGNIFICANCE * np.sqrt(variance)
        peak &= used > 0.5 * block**2
        peak[[0, -1]] = peak[:, [0, -1]] = False
        peak[: first - top], peak[first - top + rows :] = False, False
        j, i = np.nonzero(peak)
        places.append(vertex(filtered, j, i) + np.array([top, 0.0]))
        heights.append(filtered[j, i])
    order = np.argsort(-np.concatenate(heights))[: 3 * len(posterior.model.sources)]
    # from a block's index to the frame's middle, in fine pixels
    positions = block * (np.concatenate(places)[order] + 0.5) - 0.5 * np.array(detector.shape)
    return np.asarray(positions[:, ::-1] * step)


class _Binned:
    """A frame in blocks of pixels, of which some rows are needed at a time."""

    def __init__(self, posterior: Posterior, block: int, shape: tuple[int, int]) -> None:
        self.posterior, self.block, self.shape = posterior, block, shape

    def _sums(self, pixels: Floats | Flags) -> Floats:
        nx, block = self.shape[1], self.block
        return np.asarray(
            pixels[:, : nx * block].reshape(-1, block, nx, block).sum(axis=(1, 3), dtype=np.float64)
        )

    def level(self, rows: int) -> float:
        """The median of the blocks' means."""
        means, size = np.empty(self.shape[0] * self.shape[1]), 0
        for first in range(0, self.shape[0], rows):
            last = min(first + rows, self.shape[0])
            pixels = slice(first * self.block, last * self.block)
            mask = self.posterior.mask[pixels]
            used = self._sums(mask)
            total = self._sums(np.where(mask, self.posterior.counts[pixels], 0.0))
            some = total[used > 0] / used[used > 0]
            means[size : size + some.size] = some
            size += some.size
        return float(np.median(means[:size], overwrite_input=True)) if size else 0.0

    def filled(self, rows: slice, level: float) -> tuple[Floats, Floats, Floats]:
        """Counts of rows of blocks, their variance, and how many of the pixels are in use.

        Others count as at the level.
        """
        posterior = self.posterior
        pixels = slice(rows.start * self.block, rows.stop * self.block)
        mask = posterior.mask[pixels]
        counts = np.where(mask, posterior.counts[pixels], level)
        noise = posterior.noise.at(pixels)
        each = noise.counts_variance(np.maximum(counts, 1e-9), max(level, 1e-9))
        return self._sums(counts), self._sums(each), self._sums(mask)


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


def beside(image: Floats) -> Floats:
    """The sum of the eight pixels beside each, shape (ny, nx)."""
    return np.asarray(9.0 * ndimage.uniform_filter(image, 3) - image)


def above_ring(image: Floats) -> tuple[Floats, Floats, Floats]:
    """What a pixel holds, and the eight beside it, above the mean of the 16 around these; the mean.

    Each has the image's shape.
    """
    nine = 9.0 * ndimage.uniform_filter(image, 3)
    level = (25.0 * ndimage.uniform_filter(image, 5) - nine) / 16.0
    return image - level, nine - image - 8.0 * level, level
