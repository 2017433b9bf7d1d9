"""The table of sources: how well the model of each one agrees with the counts.

Around a source the model is linear in what may be wrong with it. Its light S times a factor L,
displaced by (du, dv) and widened by a factor w changes the expected counts by

    (L - 1) S + L (dS/du du + dS/dv dv) + L dS/dln(sigma) ln(w),

so weighted least squares of the residual n - mu with the noise model's Fisher weights gives all
four with their errors: the step of Fisher's scoring. The derivatives are exact, those of the PSF at
the pixel's own quadrature nodes. They are taken along a and b, the coordinates of the PSF, and the
map's Jacobian in the middle of the image carries them over to u and v. What is left out is of
second order: a displacement of a tenth of the PSF's width is found too small by some 1 %, one of
half the width by some 10 %, and a source farther from its image than two widths is not found.

A source's own pixels are those within three widths of its image. Sources that share pixels are
solved for jointly, each with up to eight neighbours (`bayesfred.model.kernels.sources`).

What a fit absorbs. The residual is that of a fitted model: free fluxes leave a flux ratio near 1,
and the distortion's coefficients take some of every displacement, a share d / 2n on average of n
sources and d coefficients. The errors are those of the source's counts alone, so what a fit absorbs
makes the columns scatter by less than they say. Where positions scatter, the shift that the fit
gave to the source is added: du and dv are counted from where the distortion has the image.

The deviance of a source's pixels is compared with its moments for a true model. A free flux takes 1
off its expectation, free shifts 2 more; a free flux also removes the part of the variance that is
linear in the counts (see `bayesfred.optimize.fit_statistics`).

References
----------
J. Anderson, I. R. King (2000), PASP 112, 1360: fits of stars with the derivatives of the PSF.
P. McCullagh, J. A. Nelder (1989), Generalized Linear Models, chapter 2: Fisher's scoring.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import spatial

from bayesfred._typing import Floats, Ints
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.kernels.sources import OwnPixels, fit_templates
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.source_numbers import own_radius

__all__ = ["SourceFits", "fit_sources", "source_table", "tabulate"]

SIGNIFICANT = 3.0  # standard deviations of light without which nothing is said of its place
ALONE = 0.01  # share of a source's light that others may have among its pixels
BLOCK = 2**18  # samples


class SourceSums(NamedTuple):
    """Sums over each source's pixels, shape (s,), and what every sample enters a fit with."""

    deviance: Floats
    expected: Floats
    variance: Floats
    peak: Floats
    others: Floats  # light of other sources
    weight: Floats  # (samples,)
    pull: Floats  # (samples,) weight times residual


@dataclass(frozen=True, eq=False)
class SourceFits:
    """What the counts say of every source; lengths in fine pixels.

    Attributes
    ----------
    own : OwnPixels
        Every source's pixels, a sample each, and its templates there.
    owner : ndarray, shape (samples,)
        The source of every sample.
    expected : ndarray, shape (ny, nx), counts per pixel
        The model.
    fluxes : ndarray, shape (s,), counts
        As the model has them.
    sums : SourceSums
        Of the counts against the model.
    information : ndarray, shape (s, 4, 4)
        About the coefficients of a source's own templates.
    found, covariance : ndarray, shape (s, 4) and (s, 4, 4)
        L, the shifts along a and b, and the logarithm of the width's ratio.
    moved, moved_covariance : ndarray, shape (s, 2) and (s, 2, 2)
        Displacements of the images along u and v from where the distortion has them.
    to_image : ndarray, shape (s, 2, 2)
        Displacement of the image by a shift along a and b.
    scatter : ndarray, shape (s,), pixel^2
        Where positions scatter, the variance of a normal prior of the curvature that theirs has at
        the shift found, large for a source far off; 0 where they do not.
    place_weight : ndarray, shape (s,)
        By which factor that curvature is less than for a source in its place.
    """

    own: OwnPixels
    owner: Ints
    expected: Floats
    fluxes: Floats
    sums: SourceSums
    information: Floats
    found: Floats
    covariance: Floats
    moved: Floats
    moved_covariance: Floats
    to_image: Floats
    scatter: Floats
    place_weight: Floats


def source_table(posterior: Posterior, params: Floats) -> Table:
    """Compare every source's light with the counts.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        Where to judge it: the MAP, or a draw.

    Returns
    -------
    astropy.table.Table
        A row for each source of the catalogue. `id` is its row there, from 0; `x`, `y` its position
        in fine pixels; `u`, `v` the middle of its image; `flux` its counts in the model. `n_pixels`
        counts its pixels in the likelihood; `chi2` is their deviance, `chi2_z` its excess over the
        expectation in standard deviations. `flux_ratio` is the light found over the model's, `du`,
        `dv` by how much the image is displaced from where the model has it, `width_ratio` the width
        of the PSF found over the model's; `_sd` is a standard deviation. `place_weight` is 1 for a
        source that tells of the distortion as others do, and small where positions scatter and its
        own lies far off. `peak` is the largest
        count, `phase_u`, `phase_v` the image's position within its pixel, -0.5 to 0.5; `isolated`
        is whether other sources have less than 1 % of its light among its pixels. Image positions
        and displacements are in recorded pixels, u and v from the middle of the frame.

        nan stands for what the counts do not tell: all columns of a source without pixels, `du` and
        `dv` of one whose light is not found with 3 standard deviations, the width of an image
        within one pixel.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog([5.0], [0.0], [1e4]), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> displaced = bf.ForwardModel(
    ...     model.detector, bf.SourceCatalog([5.1], [0.0], [1.2e4]), model.psf, model.distortion)
    >>> posterior = bf.Posterior(model, displaced.expected_counts([0.0], 2.0))
    >>> table = source_table(posterior, np.array([0.0, 2.0]))
    >>> [round(float(table[name][0]), 2) for name in ("flux_ratio", "du", "width_ratio")]
    [1.2, 0.1, 1.0]
    """
    return tabulate(posterior, fit_sources(posterior, params))


def fit_sources(posterior: Posterior, params: Floats) -> SourceFits:
    """Fit what may be wrong with every source.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    SourceFits
    """
    named = dict(zip(posterior.parameter_names, np.asarray(params).tolist(), strict=True))
    radius = own_radius(posterior, np.asarray(params))
    own, expected, fluxes, shifts = posterior.likelihood.own_pixels(params, radius)
    owner = np.repeat(np.arange(fluxes.size), np.diff(own.first))
    sums = _sum_up(posterior, (own, owner), expected.ravel(), np.asarray(params))
    near = _neighbours(own, radius)
    found, covariance, information = fit_templates(own, sums.weight, sums.pull, near)
    found, covariance = _per_light(found, covariance)
    slopes = np.where(np.isfinite(own.image[:, :1]), own.slopes, np.eye(2).ravel())
    to_image = np.linalg.inv(slopes.reshape(-1, 2, 2))
    tau = named.get("position_scatter", 0.0)
    off = np.sum(shifts**2, axis=1) / (DOF * tau**2) if tau else np.zeros(fluxes.size)
    return SourceFits(
        own, owner, expected, fluxes, sums, information, found, covariance,
        moved=np.einsum("sij,sj->si", to_image, shifts + found[:, 1:3]),
        moved_covariance=to_image @ covariance[:, 1:3, 1:3] @ to_image.swapaxes(1, 2),
        to_image=to_image,
        scatter=tau**2 * (1.0 + off) * DOF / (DOF + 2.0),
        place_weight=1.0 / (1.0 + off),
    )  # fmt: skip


def tabulate(posterior: Posterior, fits: SourceFits) -> Table:
    """The table of `source_table` from fits that are at hand.

    Parameters
    ----------
    posterior : Posterior
    fits : SourceFits
        What `fit_sources` found.

    Returns
    -------
    astropy.table.Table
    """
    model, own, sums, found = posterior.model, fits.own, fits.sums, fits.found
    step, size = float(model.detector.binning), np.diff(own.first)
    spread = np.sqrt(np.where(size > 0, sums.variance, np.nan))
    middle = 0.5 * (np.array(model.detector.shape[::-1]) - 1.0)
    image = own.image / step
    phase = image + middle - np.rint(image + middle)
    light = np.bincount(fits.owner, own.templates[0], size.size)
    return make_table(
        {
            "id": np.arange(size.size),
            "x": model.sources.x,
            "y": model.sources.y,
            "u": image[:, 0],
            "v": image[:, 1],
            "flux": fits.fluxes,
            "n_pixels": size,
            "chi2": np.where(size > 0, sums.deviance, np.nan),
            "chi2_z": (sums.deviance - sums.expected) / spread,
            "flux_ratio": found[:, 0],
            "flux_ratio_sd": np.sqrt(fits.covariance[:, 0, 0]),
            "du": fits.moved[:, 0] / step,
            "dv": fits.moved[:, 1] / step,
            "du_sd": np.sqrt(fits.moved_covariance[:, 0, 0]) / step,
            "dv_sd": np.sqrt(fits.moved_covariance[:, 1, 1]) / step,
            "place_weight": fits.place_weight,
            "width_ratio": 1.0 + found[:, 3],
            "width_ratio_sd": np.sqrt(fits.covariance[:, 3, 3]),
            "peak": sums.peak,
            "phase_u": phase[:, 0],
            "phase_v": phase[:, 1],
            "isolated": (sums.others <= ALONE * light) & (size > 0),
        }
    )


def _sum_up(
    posterior: Posterior, pixels: tuple[OwnPixels, Ints], expected: Floats, params: Floats
) -> SourceSums:
    """Compare the counts of all sources' pixels with their expectation."""
    (own, owner), counts = pixels, posterior.counts.ravel()
    law, level = posterior.noise_at(params), params[posterior.parameter_names.index("background")]
    size, profiled = own.first.size - 1, posterior.nuisances.profiled
    sums, peak = np.zeros((6, size)), np.full(size, -np.inf)
    weight, pull = np.empty(own.pixel.size), np.empty(own.pixel.size)
    for first in range(0, own.pixel.size, BLOCK):
        block = slice(first, first + BLOCK)
        pixel, source, light = own.pixel[block], owner[block], own.templates[0, block]
        n, mu = counts[pixel], expected[pixel]
        noise = law.at(np.unravel_index(pixel, posterior.counts.shape))
        with np.errstate(all="ignore"):  # what is not finite is said so
            w = 1.0 / noise.counts_variance(mu, level)
            mean, _, slope = noise.deviance_moments(mu, level)
            variance = noise.deviance_variance(mu, level)
            deviance = noise.deviance(n, mu, level)
        weight[block], pull[block] = w, w * (n - mu)
        parts = (
            deviance,
            mean,
            variance,
            slope * light,
            w * light**2,
            own.all_light[block] - light,
        )
        sums += [np.bincount(source, part, size) for part in parts]
        np.maximum.at(peak, source, n)
    deviance, mean, variance, slope, information, others = sums
    if profiled:  # a fitted flux removes what is along its own template
        variance -= np.divide(slope**2, information, np.zeros(size), where=information > 0.0)
    peak[np.diff(own.first) == 0] = np.nan
    return SourceSums(deviance, mean - profiled, variance, peak, others, weight, pull)


def _neighbours(own: OwnPixels, radius: float) -> tuple[Ints, Ints]:
    """The sources whose pixels may be those of source s: others[first[s]:first[s + 1]]."""
    size = own.first.size - 1
    there = np.flatnonzero((np.diff(own.first) > 0) & np.isfinite(own.image[:, 0]))
    if not there.size:
        return np.zeros(size + 1, np.int64), np.empty(0, np.int64)
    largest = 1.0 / np.linalg.svd(own.slopes[there].reshape(-1, 2, 2), compute_uv=False)[:, -1]
    tree = spatial.cKDTree(own.image[there])
    pairs = there[tree.query_pairs(2.0 * radius * float(largest.max()), output_type="ndarray")]
    both = np.concatenate([pairs, pairs[:, ::-1]])
    both = both[np.lexsort(both.T[::-1])]
    first = np.searchsorted(both[:, 0], np.arange(size + 1))
    return first, np.ascontiguousarray(both[:, 1])


def _per_light(c: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """L, and the other coefficients over L with the covariance of the four.

    The coefficients are those of S, X, Y and dS/dln(sigma): L - 1 and L times what is wanted. The
    errors of a ratio r = q / L follow from those of q - r L.
    """
    unknown = np.isnan(c)
    c, covariance = np.nan_to_num(c), np.nan_to_num(covariance)
    light = 1.0 + c[:, 0]
    seen = light > SIGNIFICANT * np.sqrt(covariance[:, 0, 0])
    out, change = c / np.where(seen, light, np.nan)[:, None], np.tile(np.eye(4), (light.size, 1, 1))
    change[:, 1:, 0] = -out[:, 1:]
    change[:, 1:] /= np.where(seen, light, np.nan)[:, None, None]
    errors = change @ covariance @ change.swapaxes(1, 2)
    out[:, 0], errors[:, 0, 0] = light, covariance[:, 0, 0]
    out[unknown] = np.nan
    errors[unknown] = np.nan
    return out, errors
