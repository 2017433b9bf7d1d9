"""How wide the images of a frame are, by its brightest peaks, before anything else is known of it.

Of a Gaussian of flux F and width s, the height is F / 2 pi s^2.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from bayesfred._typing import Floats, Ints
from bayesfred.optimize.peaks import beside

STARS = 30  # peaks by which the width is measured
MANY = 1000  # peaks by which it is compared, the middle of the frame with the rest
HIGH = 30.0  # height of these over the scatter of the background
SHARP = 0.25  # of a peak's height beside it; an image of FWHM 1 has more, also in a pixel's middle
START = 1.5  # pixels
MOST = 2048  # rows and columns in the middle of a large frame, which are looked at
LARGE = 2**24  # pixels, of more of which widths are not compared
NARROWEST, WIDEST = 0.5, 20.0  # pixels
SIGNIFICANT = 5.0  # standard deviations


class ImageWidths(NamedTuple):
    """Widths of the brightest images, with the pixel in them.

    Attributes
    ----------
    low, typical, high : float, pixel
        The quartiles.
    """

    low: float
    typical: float
    high: float


def image_widths(image: Floats) -> ImageWidths | None:
    """Measure the widths of the brightest images.

    Pixels beside which there is next to nothing are hot. Of a large frame the middle is enough.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        In any unit; nan where a pixel cannot be trusted.

    Returns
    -------
    ImageWidths or None
        None where there is no peak.
    """
    top, left = (max(side - MOST, 0) // 2 for side in image.shape)
    image = image[top : top + MOST, left : left + MOST]
    if not np.isfinite(image).any():
        return None
    level, found, sigma = _without_background(image), None, START
    for _ in range(3):
        _, cuts = _brightest(level, sigma, STARS)
        squares = [cut.sum() / (2.0 * np.pi * cut.max()) for cut in cuts if cut.max() > 0.0]
        if not squares:
            break
        quartiles = np.sqrt(np.maximum(np.quantile(squares, [0.25, 0.5, 0.75]), 0.0))
        found = ImageWidths(*np.clip(quartiles, NARROWEST, WIDEST).tolist())
        sigma = found.typical
    return found


class OutwardWidths(NamedTuple):
    """Median widths of images, with the pixel in them.

    Attributes
    ----------
    middle, outside : float, pixel
        Of the third that is nearest to the frame's middle, and of that farthest from it.
    number : int
        Of images that were compared.
    """

    middle: float
    outside: float
    number: int


def outward_widths(image: Floats, sigma: float) -> OutwardWidths | None:
    """Compare the widths of images in the middle of a frame with those outside.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        In any unit; nan where a pixel cannot be trusted.
    sigma : float, pixel
        What `image_widths` says.

    Returns
    -------
    OutwardWidths or None
        None where they do not differ by 5 standard deviations.
    """
    valid = np.isfinite(image)
    if image.size > LARGE or not valid.any():
        return None
    level = _without_background(image)
    noise = float(np.median(np.abs(level))) / 0.6745
    places, cuts = _brightest(level, sigma, MANY)
    reach = (len(cuts[0]) - 1) // 2 if cuts else 0
    whole = ~ndimage.binary_dilation(~valid, np.ones((2 * reach + 1, 2 * reach + 1), bool))
    heights, sums = (np.array([of(cut) for cut in cuts]) for of in (np.max, np.sum))
    good = (heights > HIGH * noise) & (sums > 0.0) & whole[tuple(places.T)]
    if good.sum() < STARS:
        return None
    widths = np.sqrt(sums[good] / (2.0 * np.pi * heights[good]))
    radius = np.hypot(*(places[good] - 0.5 * (np.array(image.shape) - 1.0)).T)
    low, high = np.quantile(radius, [1.0 / 3.0, 2.0 / 3.0])
    parts = widths[radius <= low], widths[radius >= high]
    (middle, first), (outside, second) = (_median(part) for part in parts)
    if abs(outside - middle) <= SIGNIFICANT * math.hypot(first, second):
        return None
    return OutwardWidths(middle, outside, len(widths))


def _median(values: Floats) -> tuple[float, float]:
    """The median and, by the scatter about it, its error for normal values."""
    middle = float(np.median(values))
    scatter = float(np.median(np.abs(values - middle))) / 0.6745
    return middle, scatter * math.sqrt(0.5 * math.pi / len(values))


def _without_background(image: Floats) -> Floats:
    """The image less what is around, without pixels that are hot."""
    valid = np.isfinite(image)
    filled = np.where(valid, image, np.median(image[valid]))
    around = ndimage.median_filter(filled[::4, ::4], 9).repeat(4, 0).repeat(4, 1)
    filled = filled - around[: image.shape[0], : image.shape[1]]
    hot = beside(filled) < SHARP * filled
    return np.asarray(np.where(hot, ndimage.median_filter(filled, 3), filled))


def _brightest(level: Floats, sigma: float, number: int) -> tuple[Ints, list[Floats]]:
    """The brightest peaks: row and column, shape (peaks, 2), and the image around each."""
    smooth, r = ndimage.gaussian_filter(level, 1.0), int(np.ceil(3.5 * sigma))
    peak = smooth == ndimage.maximum_filter(smooth, 2 * r + 1)
    peak[:r], peak[-r:], peak[:, :r], peak[:, -r:] = False, False, False, False
    places = np.argwhere(peak)
    places = places[np.argsort(-smooth[tuple(places.T)])[:number]]
    return places, [level[j - r : j + r + 1, i - r : i + r + 1] for j, i in places]
