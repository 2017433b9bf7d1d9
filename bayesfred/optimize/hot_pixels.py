"""Hot pixels and cosmic rays, found before anything is known of a frame but its images' width.

They are the brightest peaks of many a frame, and a search would match them to the catalogue. A hot
pixel is a peak beside which there is less, by 5 standard deviations, than half of what is beside
the middle of an image, and less than its own light. Of images with a FWHM below a pixel nothing can
be told.
"""

import numpy as np
from scipy import ndimage, special

from bayesfred._typing import Flags, Floats
from bayesfred.model.noise import Noise
from bayesfred.optimize.image_widths import image_widths
from bayesfred.optimize.outliers import SIGNIFICANCE
from bayesfred.optimize.peaks import above_ring
from bayesfred.optimize.uncatalogued import MOST_BESIDE, SHARP

LEAST = 0.55  # pixels: the narrower images' width, with the pixel in it
NAMED = 5  # pixels in a message
RING = np.pad(np.zeros((3, 3), bool), 1, constant_values=True)
MEDIAN = np.pi / 2.0  # variance of a median over that of the mean


def hot_pixels(counts: Floats, valid: Flags, noise: Noise) -> Flags:
    """Find single pixels whose light is sharper than the frame's images.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), counts
    valid : ndarray of bool, shape (ny, nx)
        Pixels that can be trusted.
    noise : Noise

    Returns
    -------
    ndarray of bool, shape (ny, nx)

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> counts = bf.simulate(model, [1e-4], 2.0, seed=1)
    >>> counts[40, 21] += 500.0
    >>> np.argwhere(hot_pixels(counts, counts >= 0.0, bf.PoissonNoise())).tolist()
    [[40, 21]]
    """
    found = np.zeros(valid.shape, bool)
    widths = image_widths(np.where(valid, counts, np.nan))
    if widths is None or widths.low < LEAST:
        return found
    within = special.erf(np.array([0.5, 1.5]) / np.sqrt(2.0 * widths.low**2 - 1.0 / 6.0)) ** 2
    share = min(SHARP * (within[1] / within[0] - 1.0), MOST_BESIDE)
    counts = np.where(valid, counts, 0.0)
    typical = max(float(np.median(counts[valid])), 1e-9)

    def sharper(own: Floats, beside: Floats, level: Floats, each: Floats, ring: float) -> Flags:
        """Whether it is, with the variance of a pixel and that of the level in units of it."""
        variance = (8.0 + share**2 + (8.0 - share) ** 2 * ring) * each
        variance += share * (1.0 + share) * np.abs(own)
        missing = share * own - np.maximum(beside, 0.0)
        return np.asarray((own > SIGNIFICANCE**2) & (missing > SIGNIFICANCE * np.sqrt(variance)))

    own, beside, level = above_ring(counts)
    each = noise.counts_variance(np.maximum(level, 1e-9), typical)
    whole = ndimage.minimum_filter(valid, 5, mode="constant", cval=False)
    peak = whole & (counts == ndimage.maximum_filter(counts, 3))
    row, column = np.nonzero(peak & sharper(own, beside, level, each, 1.0 / RING.sum()))
    # a neighbour lifts the mean of the 16 pixels, but not their median
    k = np.arange(-2, 3)
    window = counts[row[:, None, None] + k[:, None], column[:, None, None] + k]
    middle, level = counts[row, column], np.median(window[:, RING], axis=1)
    beside = window[:, ~RING].sum(axis=1) - middle - 8.0 * level
    sure = sharper(middle - level, beside, level, each[row, column], MEDIAN / RING.sum())
    found[row[sure], column[sure]] = True
    return found


def pixels_named(pixels: Flags) -> str:
    """Say how many pixels there are, and where the first ones are.

    Parameters
    ----------
    pixels : ndarray of bool, shape (ny, nx)

    Returns
    -------
    str

    Examples
    --------
    >>> pixels_named(np.eye(3, dtype=bool))
    '3 pixels at row, column (0, 0), (1, 1), (2, 2)'
    """
    places = np.argwhere(pixels)
    number = len(places)
    named = ", ".join(f"({row}, {column})" for row, column in places[:NAMED])
    more = f" and {number - NAMED} more" if number > NAMED else ""
    return f"{number} pixel{'s' * (number != 1)} at row, column {named}{more}"
