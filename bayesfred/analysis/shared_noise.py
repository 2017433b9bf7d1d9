"""Noise that neighbouring pixels share: frames that were resampled, smoothed or sharpened.

The likelihood takes the noise of pixels to be independent. If it has the correlation rho(l) between
pixels at a distance l, an estimate with the template t has the variance

    sigma^2 sum_l rho(l) (t * t)(l) / sum t^2    in units of    sigma^2,

that of independent pixels of the same scatter. For a position along x under a Gaussian image of
width s, t is the image's derivative, with the autocorrelation exp(-l^2 / 4 s^2) (1 - lx^2 / 2 s^2);
the mean over both axes is exp(-l^2 / 4 s^2) (1 - l^2 / 4 s^2).

What is correlated far away, too, such as an uneven background or rows with constants of their own,
is no noise of this kind.

References
----------
S. Casertano et al. (2000), Astronomical Journal 120, 2747, appendix A: noise of resampled frames.
"""

from itertools import product
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats

REACH = 2  # pixels along each axis to which noise is looked for
FAR = ((0, 5), (5, 0), (5, 5), (5, -5))  # rows and columns, at which there should be none
OUTLYING = 3.0  # standard deviations, as which a pixel counts at most
NOTICEABLE = 5.0  # standard deviations of a correlation
SHORT = 0.25  # of the largest covariance: more than this far away is another fault
WIDER = 1.1  # times wider errors, from which it matters


class SharedNoise(NamedTuple):
    """How neighbouring pixels are correlated.

    Attributes
    ----------
    along : tuple of two floats
        Correlation of pixels side by side along u, and along v.
    ratio : float
        Errors of positions over those with independent pixels of the same scatter.
    known : float
        What the errors take that for.
    """

    along: tuple[float, float]
    ratio: float
    known: float = 1.0


def shared_noise(z: Floats, quiet: Flags, width: float, known: float = 1.0) -> SharedNoise | None:
    """Look for correlations of noise that falsify errors by a tenth or more.

    Parameters
    ----------
    z : ndarray, shape (ny, nx)
        Residuals in standard deviations.
    quiet : ndarray of bool, shape (ny, nx)
        The pixels between the sources.
    width : float
        Standard deviation of an image, pixel.
    known : float
        What the errors take the ratio for.

    Returns
    -------
    SharedNoise or None
        None where the ratio is what it is taken for, as far as the pixels tell.
    """
    z = np.where(quiet, np.clip(z, -OUTLYING, OUTLYING), 0.0)
    every = product(range(REACH + 1), range(-REACH, REACH + 1))
    half = [lag for lag in every if lag > (0, 0)]
    near = np.array([_covariance(z, quiet, lag) for lag in half])
    far = np.array([_covariance(z, quiet, lag) for lag in FAR])
    if min(near[:, 1].min(), far[:, 1].min()) < 1.0:
        return None
    common = float(far[:, 0].mean())
    variance = float(np.sum(z**2) / quiet.sum()) - common
    rho = (near[:, 0] - common) / max(variance, 1e-300)
    square = np.sum(np.square(half), axis=1) / (4.0 * width**2)
    weight = 2.0 * np.exp(-square) * (1.0 - square)
    scatter = max(1.0 + float(rho @ weight), 0.0)  # of positions
    noticed = (np.abs(rho) * np.sqrt(near[:, 1])).max() > NOTICEABLE
    if known != 1.0:
        sd = float(np.sqrt(np.sum(weight**2 / near[:, 1])))
        noticed = abs(scatter - known**2) > NOTICEABLE * sd
    if not noticed or 1.0 / WIDER < scatter**0.5 / known < WIDER:
        return None
    noise = NOTICEABLE * variance / np.sqrt(far[:, 1])
    if (np.abs(far[:, 0]) > SHORT * np.abs(rho).max() * variance + noise).any():
        return None
    along = float(rho[half.index((0, 1))]), float(rho[half.index((1, 0))])
    return SharedNoise(along, scatter**0.5, known)


def _covariance(z: Floats, quiet: Flags, lag: tuple[int, int]) -> tuple[float, int]:
    """Mean product of pixels so many rows and columns apart, and how many pairs there are."""
    down, across = lag
    nx = z.shape[1]
    first = slice(None, -down or None), slice(max(-across, 0), nx - max(across, 0))
    second = slice(down, None), slice(max(across, 0), nx - max(-across, 0))
    pairs = int(np.sum(quiet[first] & quiet[second]))
    return float(np.sum(z[first] * z[second])) / max(pairs, 1), pairs
