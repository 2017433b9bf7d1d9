"""Displacement of the sources as a function of their position within a pixel.

A PSF or a pixel response that is wrong displaces an image by an amount that depends on where in its
pixel the image lies, as soon as pixels are coarse. So the displacements y of the sources from the
model are fitted by a constant and two harmonics of the phase, sin and cos of 2 pi phase and 4 pi
phase. The fit of the model has taken its part of y: with V its variances, D the derivatives of the
images by the parameters and C the covariance of these, the covariance of y is V - D C D^T. The
chi-square of the four amplitudes is judged by what of it is left to them.

Where positions scatter, y has the heavy tails of Student's distribution with nu degrees of freedom.
A shift r counts by its score s = (nu + 2) r / (nu tau^2 + r^2), whose variance along one axis is
the information I = (nu + 2) / ((nu + 4) tau^2). So y is s / I, of variance 1 / I: a source far off
counts little. The variance of the counts adds to r / s and to 1 / I. The scatter at the maximum is
too small by what the coefficients took, so the rest of y gives the scale of the errors, and the
ratio of the two is an F.

References
----------
J. Anderson, I. R. King (2000), PASP 112, 1360: pixel-phase errors.
K. L. Lange, R. J. A. Little, J. M. G. Taylor (1989), JASA 84, 881: information of Student's t.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy import linalg

from bayesfred._typing import Floats
from bayesfred.analysis.absorbed import responses
from bayesfred.analysis.checks import Check, deviate, deviate_of_ratio, not_tested
from bayesfred.analysis.sources import SourceFits
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.posterior import Posterior

__all__ = ["PixelPhase", "harmonics", "phase_check", "pixel_phase"]

FEWEST = 12  # sources
HARMONICS = 2
LEFT = 0.1  # share of an amplitude's variance that the fit must leave


class PixelPhase(NamedTuple):
    """Displacement along one axis as a function of the image's position within its pixel."""

    phase: Floats  # (n,) -0.5 to 0.5, of the sources that take part
    displacement: Floats  # (n,) pixel; one far off where positions scatter is shortened
    sd: Floats  # (n,) pixel
    coefficients: Floats  # (5,) of 1, and sin and cos of 2 pi phase and 4 pi phase; pixel
    covariance: Floats  # (4, 4) of the last four
    chi2: float  # of the last four
    dof: int  # 0 where nothing could be tested
    left: float  # degrees of freedom that give the scale of the errors; inf where it is known


def harmonics(phase: Floats) -> Floats:
    """1, and sin and cos of 2 pi phase and of 4 pi phase, shape (n, 5)."""
    angles = 2.0 * np.pi * np.outer(phase, np.arange(1, HARMONICS + 1))
    waves = np.stack([np.sin(angles), np.cos(angles)], axis=2).reshape(len(phase), 2 * HARMONICS)
    return np.column_stack([np.ones(len(phase)), waves])


def pixel_phase(
    posterior: Posterior, params: Floats, covariance: Floats, fits: SourceFits
) -> tuple[PixelPhase, PixelPhase]:
    """Displacements along u against the phase along u, and along v against that along v.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
        Of the parameters.
    fits : SourceFits

    Returns
    -------
    along_u, along_v : PixelPhase
    """
    step = float(posterior.model.detector.binning)
    moves = fits.to_image @ responses(posterior, params, fits)[:, 1:3] / step
    displacement = fits.moved / step
    variance = np.diagonal(fits.moved_covariance, axis1=1, axis2=2) / step**2
    if posterior.nuisances.position_scatter:
        scatter = fits.scatter[:, None] * np.sum(fits.to_image**2, axis=2) / step**2
        expected = variance + scatter * fits.place_weight[:, None] * (DOF + 4.0) / DOF
        displacement = displacement * expected / (variance + scatter)
        variance = expected
    middle = 0.5 * (np.array(posterior.counts.shape[::-1]) - 1.0)
    place = fits.own.image / step + middle
    phase = place - np.rint(place)
    u, v = (
        _fit_harmonics(
            phase[:, k], displacement[:, k], variance[:, k], (moves[:, k], covariance),
            scaled=posterior.nuisances.position_scatter,
        )
        for k in range(2)
    )  # fmt: skip
    return u, v


def _fit_harmonics(
    phase: Floats,
    displacement: Floats,
    variance: Floats,
    absorbs: tuple[Floats, Floats],
    *,
    scaled: bool = False,
) -> PixelPhase:
    """Weighted least squares of the harmonics, with the covariance that the fit leaves them."""
    some = np.isfinite(displacement) & np.isfinite(variance) & np.isfinite(phase)
    y, sd = displacement[some], np.sqrt(variance[some])
    waves, (moves, covariance) = harmonics(phase[some]), absorbs
    size = waves.shape[1]
    none = PixelPhase(
        phase[some], y, sd, np.zeros(size), np.zeros((size - 1, size - 1)), math.nan, 0, math.inf
    )
    if y.size < FEWEST:
        return none
    weighted = waves / sd[:, None]
    normal = weighted.T @ weighted
    if np.linalg.cond(weighted) > 1e3:  # the phases do not differ
        return none
    inverse = np.linalg.inv(normal)
    gain = inverse @ (weighted / sd[:, None]).T
    beta, taken = gain @ y, gain @ moves[some]
    left = (inverse - taken @ covariance @ taken.T)[1:, 1:]
    values, vectors = linalg.eigh(left, inverse[1:, 1:])
    kept = values > LEFT
    amplitudes = (vectors[:, kept].T @ beta[1:]) ** 2 / values[kept]
    chi2, rest = float(amplitudes.sum()), math.inf
    if scaled:
        taken = moves[some] / sd[:, None]
        rest = y.size - size - float(np.trace(taken @ covariance @ taken.T))
        if rest < 1.0:
            return none
        scale_squared = float(np.sum(((y - waves @ beta) / sd) ** 2)) / rest
        left, chi2 = left * scale_squared, chi2 / scale_squared
    return PixelPhase(phase[some], y, sd, beta, left, chi2, int(kept.sum()), rest)


def phase_check(fit: PixelPhase, axis: str) -> Check:
    """Whether displacements depend on the position within the pixel."""
    name = f"pixel phase along {axis}"
    if not fit.dof:
        return not_tested(name, f"fewer than {FEWEST} sources whose phases differ")
    trace = max(float(np.trace(fit.covariance)), 0.0)
    expected = math.sqrt(trace)
    sd = math.sqrt(float(np.sum(fit.covariance**2)) / (2.0 * trace)) if trace else math.nan
    if math.isinf(fit.left):
        z = deviate(fit.chi2, fit.dof)
    else:
        z = deviate_of_ratio(fit.chi2 / fit.dof, fit.dof, fit.left)
    return Check(
        name, float(np.linalg.norm(fit.coefficients[1:])), expected, sd, z,
        "displacement of the sources that depends on the position within the pixel, pixel",
    )  # fmt: skip
