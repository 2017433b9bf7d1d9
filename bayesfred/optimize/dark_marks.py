"""Targets of dark marks on a bright ground, told before any fit: the model has light alone."""

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats
from bayesfred.optimize.alternating import middle_of

SMOOTH = 1.5  # pixels, over which a frame is averaged
LOWEST, HIGHEST = 1e-3, 3e-4  # shares of the pixels: a few are dead, and fewer are hot
DEEP = 10.0  # standard deviations of most pixels
DEEPER = 4.0  # times the height of what is brightest
FEWEST = 6  # marks: a frame has four dark corners


def dark_marks_message(counts: Floats, valid: Flags) -> str:
    """Say that a frame shows dark marks on a bright ground; empty if it does not.

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
    >>> counts = np.random.default_rng(1).poisson(900.0, (80, 80)).astype(float)
    >>> dark_marks_message(counts, counts >= 0.0)
    ''
    >>> counts[10:80:20, 10:80:20] = counts[11:80:20, 10:80:20] = 100.0
    >>> dark_marks_message(counts, counts >= 0.0)[:40]
    'the marks are darker than the ground: th'
    """
    middle = middle_of(counts.shape)
    counts, valid = counts[middle], valid[middle]
    if not valid.any():
        return ""
    # dead rows and columns are no marks
    change = counts - np.median(np.where(valid, counts, np.median(counts[valid])), axis=0)
    change = np.where(valid, change, np.median(change[valid]))
    change -= np.median(change, axis=1, keepdims=True)
    smooth = ndimage.gaussian_filter(change, SMOOTH)
    sd = float(np.median(np.abs(smooth[valid]))) / 0.6745
    low, high = np.quantile(smooth[valid], (LOWEST, 1.0 - HIGHEST))
    if not -low > max(DEEP * sd, DEEPER * high):
        return ""
    if ndimage.label(smooth < 0.5 * low)[1] < FEWEST:
        return ""
    return (
        "the marks are darker than the ground: the model has light alone; invert the frame (a "
        'number less each pixel), with noise.kind = "gaussian" and the variance of the ground'
    )
