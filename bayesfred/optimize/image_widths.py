"""How wide the images of a frame are, by its brightest peaks, before anything else is known of it.

Of a Gaussian of flux F and width s, the height is F / 2 pi s^2.
"""

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from bayesfred._typing import Floats
from bayesfred.optimize.peaks import beside

STARS = 30  # peaks by which the width is measured
SHARP = 0.25  # of a peak's height beside it; an image of FWHM 1 has more, also in a pixel's middle
START = 1.5  # pixels
MOST = 2048  # rows and columns in the middle of a large frame, which are looked at
NARROWEST, WIDEST = 0.5, 20.0  # pixels


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
    valid = np.isfinite(image)
    if not valid.any():
        return None
    filled = np.where(valid, image, np.median(image[valid]))
    filled = (
        filled
        - ndimage.median_filter(filled[::4, ::4], 9)
        .repeat(4, 0)
        .repeat(4, 1)[: image.shape[0], : image.shape[1]]
    )
    filled = np.where(beside(filled) < SHARP * filled, ndimage.median_filter(filled, 3), filled)
    smooth = ndimage.gaussian_filter(filled, 1.0)
    found, sigma = None, START
    for _ in range(3):
        r = int(np.ceil(3.5 * sigma))
        peak = smooth == ndimage.maximum_filter(smooth, 2 * r + 1)
        peak[:r], peak[-r:], peak[:, :r], peak[:, -r:] = False, False, False, False
        row, column = np.nonzero(peak)
        brightest = np.argsort(-smooth[row, column])[:STARS]
        cuts = [
            filled[j - r : j + r + 1, i - r : i + r + 1]
            for j, i in zip(row[brightest], column[brightest], strict=True)
        ]
        squares = [cut.sum() / (2.0 * np.pi * cut.max()) for cut in cuts if cut.max() > 0.0]
        if not squares:
            break
        quartiles = np.sqrt(np.maximum(np.quantile(squares, [0.25, 0.5, 0.75]), 0.0))
        found = ImageWidths(*np.clip(quartiles, NARROWEST, WIDEST).tolist())
        sigma = found.typical
    return found
