"""Which sources the counts show where the model images them.

The residual is filtered with the PSF, a Gaussian G of width s in recorded pixels, and the source's
own light F S is put back. At the image's place, of a source that lies there,

    M = F / (4 pi s^2) + (G * r)(u, v),        Var M = (G^2 * V)(u, v),

with the residual r = n - mu and its variance V. Around the true place of a lone source M is
proportional to exp(-d^2 / 4 s^2), so that the slope there says how far away the true place is:

    d = 2 s^2 grad M / M.

A source is matched if its light exceeds the noise, is a fair share of the model's, and peaks
within two widths of its image. Beyond that it is another's light, or none.

References
----------
G. L. Turin (1960), IRE Transactions on Information Theory 6, 311: matched filters.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.matching import Field
from bayesfred.optimize.peaks import SIGNIFICANCE

FAINTEST = 0.3  # share of the model's light that a matched source has at least
FARTHEST = 2.0  # PSF widths between a matched source's image and its light
COVERED = 0.5  # share of a source's light in the likelihood's pixels, or it cannot be judged
BLOCK = 2**20  # pixels that are gathered at once


@dataclass(frozen=True, eq=False)
class SourceLight:
    """What the counts show where the model images its sources.

    Attributes
    ----------
    position : ndarray, shape (n, 2), recorded pixel
        u, v of the images from the frame's middle.
    width : float, recorded pixel
        The PSF's, pixels included.
    inside : ndarray of bool, shape (n,)
        Which sources have at least half of their light in the likelihood's pixels.
    matched : ndarray of bool, shape (n,)
        Which of these the counts show.
    power : ndarray, shape (n,)
        Square of the signal to noise of the light that the model has; 0 outside.
    ratio : ndarray, shape (n,)
        Light found over light of the model; nan outside.
    displacement : ndarray, shape (n, 2), recorded pixel
        Of the matched sources' light from their images, along u and v; nan elsewhere.
    displacement_sd : ndarray, shape (n,), recorded pixel
        Its standard deviation along either axis.
    """

    position: Floats
    width: float
    inside: Flags
    matched: Flags
    power: Floats
    ratio: Floats
    displacement: Floats
    displacement_sd: Floats

    @property
    def count(self) -> str:
        """How many sources are matched, in words."""
        beyond = int(np.sum(~self.inside))
        more = f", {beyond} outside the pixels that are used" if beyond else ""
        return f"{self.matched.sum()} of {self.matched.size} sources matched{more}"

    @property
    def pooled(self) -> float:
        """Signal to noise of all sources' light together, if their fluxes are known."""
        power = self.power[self.inside]
        total = float(power.sum())
        return float(power @ self.ratio[self.inside]) / total**0.5 if total > 0.0 else 0.0


def image_width(posterior: Posterior, params: Floats) -> float:
    """Standard deviation of an image along an axis, the pixel in it, recorded pixel."""
    known = dict(zip(posterior.parameter_names, params, strict=True))
    model = posterior.model
    sigma = known.get("psf_sigma", model.psf.sigma) / model.detector.binning
    return float(np.hypot(sigma, 12.0**-0.5))


def source_light(posterior: Posterior, params: Floats) -> SourceLight:
    """Look for the sources' light at given parameters.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    SourceLight

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> int(source_light(posterior, np.array([1e-4, 2.0])).matched.sum())
    9
    """
    model, field = posterior.model, Field(posterior)
    detector, step = model.detector, model.detector.binning
    known = dict(zip(posterior.parameter_names, params, strict=True))
    s = image_width(posterior, params)
    position = field.predict(params[field.columns]) / step
    place = (position + 0.5 * (np.array(detector.shape[::-1]) - 1.0))[:, ::-1]
    noise_at, sums = posterior.noise_at(params), np.zeros((5, len(position)))
    reach = np.arange(-int(np.ceil(3.0 * s)), int(np.ceil(3.0 * s)) + 1)
    several = max(1, BLOCK // reach.size**2)
    with posterior.likelihood.expected(params) as expected:

        def gathered(here: tuple[Ints, Ints]) -> tuple[Floats, Floats]:
            mean, used = expected.light[here] + expected.level[here], posterior.mask[here]
            variance = noise_at.at(here).counts_variance(mean, known["background"])
            residual = np.where(used, posterior.counts[here] - mean, 0.0)
            return residual, np.where(used, variance, 0.0)

        for first in range(0, len(position), several):
            some = slice(first, first + several)
            sums[:, some] = _filtered(place[some], reach, s, gathered, posterior.mask)
        fluxes = expected.fluxes
    light, along_u, along_v, noise, covered = sums
    own = np.maximum(fluxes, 0.0) * covered
    light = light + own
    noise = np.sqrt(np.maximum(noise, 1e-300))
    covered = 4.0 * np.pi * s**2 * covered
    inside = (covered > COVERED) & np.isfinite(own) & (own > 0.0)
    with np.errstate(all="ignore"):
        ratio = np.where(inside, light / own, np.nan)
        # s^2 grad M is the sum of the offsets, weighted
        displacement = 2.0 * np.stack([along_u, along_v], axis=1) / light[:, None]
        matched = inside & (light > SIGNIFICANCE * noise) & (ratio > FAINTEST)
        matched &= np.hypot(*displacement.T) < FARTHEST * s
        # the slope of G has half the integral of its square over s^2
        displacement_sd = np.where(matched, 2.0**0.5 * s * noise / light, np.nan)
    displacement[~matched] = np.nan
    power = np.where(inside, (own / noise) ** 2, 0.0)
    return SourceLight(position, s, inside, matched, power, ratio, displacement, displacement_sd)


def enough_matched(posterior: Posterior, light: SourceLight) -> bool:
    """Whether the counts show sources enough for the fit to mean anything.

    Half of the sources in the frame, or half as many as there are coefficients to be found: a
    source gives two equations. Sources of known flux that are too faint one by one count together.

    Parameters
    ----------
    posterior : Posterior
    light : SourceLight

    Returns
    -------
    bool
    """
    faint = posterior.nuisances.flux != "free" and light.pooled > SIGNIFICANCE
    if faint and light.pooled > FAINTEST * float(np.sqrt(light.power.sum())):
        return True
    coefficients = posterior.model.distortion.n_terms + 2 * posterior.nuisances.offset
    needed = 0.5 * min(int(light.inside.sum()), coefficients)
    return bool(light.matched.sum() >= max(needed, 1.0))


def _filtered(
    place: Floats,
    reach: Ints,
    s: float,
    gathered: Callable[[tuple[Ints, Ints]], tuple[Floats, Floats]],
    mask: Flags,
) -> Floats:
    """Sums over the pixels around some images, weighted with the filter G, shape (5, n).

    `gathered` returns the residual and its variance in the pixels that an index selects.

    Of G r, G r times the offsets along u and v, G^2 V, and G^2 over the pixels in use.
    """
    ny, nx = mask.shape
    nearest = np.rint(np.where(np.isfinite(place), place, -1e6)).astype(int)
    row, column = (nearest[:, k, None] + reach for k in (0, 1))
    off_v, off_u = row - place[:, :1], column - place[:, 1:]
    g_v, g_u = (np.exp(-0.5 * (off / s) ** 2) for off in (off_v, off_u))
    g_v *= (row >= 0) & (row < ny)
    g_u *= ((column >= 0) & (column < nx)) / (2.0 * np.pi * s**2)
    here = np.clip(row, 0, ny - 1)[:, :, None], np.clip(column, 0, nx - 1)[:, None]
    (r, variance), squares = gathered(here), (g_v**2, g_u**2)

    def total(image: Floats, along: tuple[Floats, Floats]) -> Floats:
        rows = (image @ along[1][:, :, None])[:, :, 0]
        return np.asarray(np.sum(rows * along[0], axis=1))

    return np.stack(
        [
            total(r, (g_v, g_u)),
            total(r, (g_v, g_u * off_u)),
            total(r, (g_v * off_v, g_u)),
            total(variance, squares),
            total(mask[here].astype(float), squares),
        ]
    )
