"""Rules that integrate an image over every pixel, with samples that neighbouring pixels share.

A pixel's light is a sum over m points of its own along one axis, and over those of the `reach`
pixels on either side of it,

    integral over pixel i = sum_d sum_p W[d, p] I(i + d + x_p),    d = -reach ... reach,

and the same rule serves both axes. Pixels are of the same size, so that a sample serves 2 reach + 1
of them along either axis, and a frame takes m^2 samples a pixel. A rule of Gauss and Legendre
(`reach` 0) takes 16 where two points and their neighbours, 4 samples, have the same error.

Of an image with the spectrum F(k) along an axis the error at any point is at most

    1/(2 pi) integral |F(k)| |sum W cos(k (d + x_p)) - sin(k/2) / (k/2)| dk.

The weights make the square of the integrand least, and the integral is what a rule is chosen by.
The spectrum of a Gaussian is a Gaussian, that of a Moffat function k^(beta-1/2) K(k alpha), K the
modified Bessel function of order beta - 1/2. Both are positive, so that the integral of |F| is the
peak, which is the unit of the error.
"""

from functools import lru_cache

import numpy as np
from scipy.special import kve

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.contexts import PixelRule

# A pixel's own points, in units of its side, by (m, reach): where the rule's error is least.
POINTS = {
    (1, 1): (0.0,),
    (1, 2): (0.0,),
    (2, 1): (-0.2604, 0.2604),
    (2, 2): (-0.2552, 0.2552),
    (3, 1): (-0.352, 0.0, 0.352),
    (3, 2): (-0.347, 0.0, 0.347),
    (4, 1): (-0.37, -0.11, 0.11, 0.37),
    (4, 2): (-0.37, -0.12, 0.12, 0.37),
}
NARROWER = 1.3  # as much as distortion may narrow an image
KNOTS = 1000  # at which the spectrum is taken
LARGEST = 18.0  # widths times wave number at which it ends


def _spectrum(k: Floats, sigma: float, beta: float) -> Floats:
    """Spectrum of a Gaussian or a Moffat function at equally spaced k, of sum 1."""
    if np.isinf(beta):
        out = np.exp(-0.5 * (sigma * k) ** 2)
    else:
        x = np.maximum(k * sigma * np.sqrt(2.0 * beta), 1e-6)
        out = x ** (beta - 0.5) * kve(beta - 0.5, x) * np.exp(-x)
    return np.asarray(out / out.sum())


@lru_cache(maxsize=64)
def shared_rule(sigma: float, beta: float, tolerance: float, most: float) -> PixelRule | None:
    """The cheapest rule that integrates the PSF over a pixel within a tolerance.

    Parameters
    ----------
    sigma, beta : float
        The PSF as in `Detector.quadrature`, in units of the pixel's side.
    tolerance : float
        Bound on the error along an axis, in units of the peak.
    most : float
        The same where distortion narrows the image `NARROWER` times.

    Returns
    -------
    PixelRule or None
        In units of the pixel's side; None where no rule will do.
    """
    k = np.linspace(0.0, LARGEST * NARROWER / sigma, KNOTS)
    pixel = np.sinc(k / (2.0 * np.pi))
    spectra = [_spectrum(k, width, beta) for width in (sigma, sigma / NARROWER)]
    weight = spectra[0] / tolerance + spectra[1] / most
    for (m, reach), points in POINTS.items():
        offsets = np.array(points)
        at = (offsets + np.arange(-reach, reach + 1)[:, None]).ravel()
        waves = np.cos(k[:, None] * at[at >= 0.0]) * np.where(at[at >= 0.0] > 0.0, 2.0, 1.0)
        half = np.linalg.lstsq(waves * weight[:, None], pixel * weight, rcond=1e-14)[0]
        error = np.abs(waves @ half - pixel)
        if error @ spectra[0] <= tolerance and error @ spectra[1] <= most:
            weights = np.concatenate([half[::-1], half[at.size % 2 :]])
            return PixelRule(offsets, weights.reshape(-1, m), True)
    return None
