"""Single pixels within images that no PSF explains: hot ones, dead ones, cosmic rays.

A star hides them until its image is known. With the frame's own PSF they are what stands out of the
residuals by 5 standard deviations, sharper than any image: the eight pixels beside have less of the
same sign, by 5 standard deviations, than half of what the sharpest stars have beside their middle.
Of stars hardly wider than a pixel a PSF that is not quite right may leave that, too. So a residual
has to exceed also five times the share of the light that is common in the frame.
"""

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.outliers import SIGNIFICANCE
from bayesfred.optimize.peaks import beside
from bayesfred.optimize.uncatalogued import COMMON, MOST_BESIDE, SHARP, SHARPEST

BRIGHT = 10.0  # standard deviations of the noise: light that tells what the PSF leaves
COMMON_SD = 1.15  # standard deviations that `COMMON` of normal residuals do not exceed


def sharp_pixels(posterior: Posterior, params: Floats) -> Flags:
    """Find the pixels whose residuals exceed the noise and are sharper than the PSF.

    Parameters
    ----------
    posterior : Posterior
        With the PSF that was measured on the frame.
    params : ndarray, shape (d,)
        Its maximum.

    Returns
    -------
    ndarray of bool, shape (ny, nx)
        Such pixels of the posterior.
    """
    mask = posterior.mask
    expected = posterior.expected_counts(params)
    background = posterior.likelihood.background(params)
    level = params[posterior.parameter_names.index("background")]
    variance = posterior.noise_at(params).counts_variance(np.maximum(expected, 0.0), level)
    residual = np.where(mask, posterior.counts - expected, 0.0)
    light = np.maximum(expected - background, 0.0)
    bright = mask & (light > BRIGHT * np.sqrt(variance))
    middle = bright & (light == ndimage.maximum_filter(light, 3))
    if not middle.any():
        return np.zeros_like(mask)
    sharpest = float(np.quantile(beside(light)[middle] / light[middle], SHARPEST))
    share = min(SHARP * sharpest, MOST_BESIDE)
    common = float(np.quantile(np.abs(residual[bright]) / light[bright], COMMON)) / COMMON_SD
    own = np.abs(residual)
    least = SIGNIFICANCE * np.maximum(np.sqrt(variance), common * light)
    missing = share * own - np.maximum(np.sign(residual) * beside(residual), 0.0)
    sd = np.sqrt(np.maximum(beside(variance) + share**2 * variance, 0.0))
    exceeds = own > np.maximum(least, SIGNIFICANCE**2)
    return np.asarray(mask & exceeds & (missing > SIGNIFICANCE * sd))
