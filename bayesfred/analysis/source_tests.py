"""Tests of every source by itself, and of what may vary from source to source.

A source whose catalogue entry is wrong, or which is no point, stands out among the others long
before a sum over all pixels shows it. Its counts are compared with the model in four ways: their
chi-square; their light; their place; their size and shape. But for the chi-square these are
scores, weighted sums t^T w r of the residuals r over the source's own pixels, along the templates
of `bayesfred.analysis.sources`: the light S, its derivatives X and Y, dS/dln(sigma), and the two
quadrupoles (X^2 - Y^2) / S and 2 X Y / S. For a Gaussian S these are (a^2 - b^2) S and 2 a b S.
Each is taken beside the ones before it: L^-1 u, with the Cholesky factor L of the scores'
information A, has unit variances in a frame whose model is known.

What the fit takes off is known: with B_s the covariance of the template coefficients that the fit
allows (`bayesfred.analysis.absorbed`) the scores have the covariance A - A B_s A, so z is divided
by the root of the variance that is left. Where less than a tenth is, as of the light of a source
whose flux is free, nothing is tested.

Tails. To be sure of one source in two thousand, deviations of five standard deviations have to be
as rare as they are said to be, and few counts are not Gaussian. The noise model gives the variance
V of a pixel's counts as a function of their mean. With the slope g = dV/dmu (1 of photons, 0 of
Gaussian noise) the counts are taken as g times a Poisson number of mean V / g^2, so a sum of them
with weights a has the cumulant generating function

    K(s) = sum V / g^2 (exp(g a s) - 1 - g a s),

and the normal deviate of a sum x is r + log(q / r) / r, where K'(s) = x, r = sign(s) sqrt(2 (s x -
K)) and q = s sqrt(K''): Barndorff-Nielsen's form of the saddlepoint approximation. The chi-square
is compared with a scaled chi-square variable of its mean and variance. A score that rests on fewer
than some 25 counts is left to the sums.

False discoveries. Benjamini and Hochberg's rule decides which sources fail. If the model is true
it names any source in at most `FALSE_ALARM` of all frames; where several are wrong, at most that
share of those it names are named wrongly.

What varies from source to source: positions that scatter, and fluxes. A spread of variance v adds v
A_s to the variance of each source's score u_s, so the derivative of the log-likelihood by v is half
of T = sum (u_s^2 - A_s). It is compared with a gamma variable of its mean and variance.

References
----------
Y. Benjamini, Y. Hochberg (1995), Journal of the Royal Statistical Society B 57, 289.
O. E. Barndorff-Nielsen (1986), Biometrika 73, 307: the modified signed root.
T. S. Breusch, A. R. Pagan (1980), Review of Economic Studies 47, 239: scores of variances.
"""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import sparse, special, stats

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.analysis.absorbed import Absorbed
from bayesfred.analysis.checks import Check, deviate, largest_deviate, not_tested
from bayesfred.analysis.sources import SourceFits
from bayesfred.model.posterior import Posterior

__all__ = ["SourceTests", "are_bright", "source_tests"]

# The columns of `SourceTests.z`.
KINDS = {"chi-square": [0], "light": [1], "position": [2, 3], "size and shape": [4, 5, 6]}
PLACE = [1, 2]  # of the scores
LEFT = 0.1  # share of a score's variance that the fit must leave
FEWEST = 25.0  # counts that a score rests on, or its tail is not known
NORMAL = 2.5  # standard deviations up to which no tail is looked at
CERTAIN = 40.0  # standard deviations that nothing makes probable
ITERATIONS = 30
STEP = 1e-3  # share of the variance by which the mean is changed to find the variance's slope
DETERMINED = 1e-4  # share of a template that earlier ones leave, or it is not told from them
FALSE_ALARM = 0.003  # chance that any source fails if the model is true
FALSE_ALARM_OF_SPREADS = 0.001
BY_CHANCE = 1e-4  # that so many of the brightest are among few sources


class Spread(NamedTuple):
    """Whether a property of the sources varies from one to the next."""

    name: str
    ratio: float  # of the mean square of its scores to that of a true model
    sd: float  # of the ratio, if the model is true
    z: float
    estimate: float  # standard deviation between sources, pixel or share of the flux


@dataclass(frozen=True, eq=False)
class SourceTests:
    """How far every source is from what the noise makes of the model.

    Attributes
    ----------
    z : ndarray, shape (s, 7)
        Normal deviates of the chi-square, the light, the place along a and b, the size, and the
        shape along and across the axes; nan where not tested.
    failed : ndarray of bool, shape (s,)
        Which sources do not fit.
    spreads : tuple of Spread
        Of what is not free for every source.
    """

    z: Floats
    failed: Flags
    spreads: tuple[Spread, ...]

    @property
    def failed_spreads(self) -> tuple[Spread, ...]:
        """What varies from source to source."""
        limit = -special.ndtri(FALSE_ALARM_OF_SPREADS / max(len(self.spreads), 1))
        return tuple(spread for spread in self.spreads if spread.z > limit)

    @property
    def checks(self) -> tuple[Check, ...]:
        """The source that is farthest off in each way, and what varies from source to source."""
        rows = []
        for kind, columns in KINDS.items():
            z = np.abs(self.z[:, columns])
            number, name = int(np.sum(np.isfinite(z))), f"{kind} of a source"
            if not number:
                rows.append(not_tested(name, "free in the fit, or too few counts"))
                continue
            row = int(np.nanargmax(z)) // len(columns)
            largest = float(np.nanmax(z))
            rows.append(
                Check(
                    name, largest, math.nan, math.nan, largest_deviate(largest, number),
                    f"standard deviations of the source that is farthest off, row {row} of the "
                    "catalogue, from 0",
                )
            )  # fmt: skip
        return (
            *rows,
            *(
                Check(
                    f"spread of {spread.name}", spread.ratio, 1.0, spread.sd, spread.z,
                    "mean square of the sources' deviations over that of a true model",
                )
                for spread in self.spreads
            ),
        )  # fmt: skip


def source_tests(
    posterior: Posterior, params: Floats, covariance: Floats, fits: SourceFits, taken: Absorbed
) -> SourceTests:
    """Test every source, and what varies from source to source.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        The MAP.
    covariance : ndarray, shape (d, d)
        Of the parameters.
    fits : SourceFits
    taken : Absorbed
        What the fit takes off the residuals.

    Returns
    -------
    SourceTests
    """
    first, free = fits.own.first, posterior.nuisances.profiled
    templates = _templates(fits.own.templates)
    score = _by_source(first, templates, fits.sums.pull[None])[..., 0]
    weighted = templates * fits.sums.weight
    information = _by_source(first, weighted, templates)
    root, known = _inverse_root(information)
    z = np.einsum("skj,sj->sk", root, score)
    cross = root @ information[:, :, :4]
    alone = 1.0 - _diagonal(cross, taken.alone)
    share = 1.0 - _diagonal(cross, taken.spread)
    tested = known & (share > LEFT * np.where(alone > 0.0, alone, 1.0))
    tested[:, 0] &= not free
    z = np.where(tested, z / np.sqrt(np.where(tested, share, 1.0)), np.nan)
    if posterior.nuisances.position_scatter and tested[:, PLACE].any():
        # the scatter at the maximum is too small by what the coefficients took
        z[:, PLACE] *= np.sqrt(np.mean((share / alone)[:, PLACE][tested[:, PLACE]]))
    variance, slope = 1.0 / fits.sums.weight, _slope(posterior, params, fits)
    for each, (begin, end) in zip(root, pairwise(first), strict=True):
        weighted[:, begin:end] = each @ weighted[:, begin:end]
    for k, weights in enumerate(weighted):
        z[:, k] = _deviates(z[:, k], (weights, variance, slope), fits.owner)
    z = np.column_stack([_chi_square(fits, taken, free), z])
    return SourceTests(z, _discoveries(z), _spreads(covariance, fits, taken, slope, free))


def are_bright(fluxes: Floats, failed: Flags) -> bool:
    """Whether sources that do not fit are brighter than the others.

    Parameters
    ----------
    fluxes : ndarray, shape (s,), counts
    failed : ndarray of bool, shape (s,)

    Returns
    -------
    bool
    """
    test = stats.mannwhitneyu(fluxes[failed], fluxes[~failed], alternative="greater")
    return bool(test.pvalue < BY_CHANCE)


def _templates(own: Floats) -> Floats:
    """Light, shifts along a and b, width and the two quadrupoles, shape (6, samples)."""
    s, x, y, width = own
    inverse = np.divide(1.0, s, np.zeros_like(s), where=s > 0.0)
    return np.stack([s, x, y, width, (x**2 - y**2) * inverse, 2.0 * x * y * inverse])


def _by_source(first: Ints, left: Floats, right: Floats) -> Floats:
    """Sums of products over each source's samples, shape (s, k, m)."""
    ends = pairwise(first)
    return np.array([left[:, begin:end] @ right[:, begin:end].T for begin, end in ends])


def _diagonal(cross: Floats, spread: Floats) -> Floats:
    return np.asarray(np.einsum("ski,sij,skj->sk", cross, spread, cross, optimize=True))


def _inverse_root(information: Floats) -> tuple[Floats, Flags]:
    """L^-1 with A = L L^T, shape (s, k, k), and what of it the pixels tell apart, (s, k)."""
    size = information.shape[1]
    scale = np.sqrt(np.einsum("skk->sk", information))
    scale = np.divide(1.0, scale, np.zeros_like(scale), where=scale > 0.0)
    lower = np.linalg.cholesky(
        information * scale[:, :, None] * scale[:, None, :] + DETERMINED**2 * np.eye(size)
    )
    known = np.logical_and.accumulate(np.einsum("skk->sk", lower) > 2.0 * DETERMINED, axis=1)
    return np.linalg.inv(lower) * scale[:, None, :], known


def _slope(posterior: Posterior, params: Floats, fits: SourceFits) -> Floats:
    """By how much the variance of the counts grows with their mean, shape (samples,).

    Light and background share the growth, of which one noise model has the one, another the other.
    """
    level = float(params[posterior.parameter_names.index("background")])
    pixel, variance = fits.own.pixel, 1.0 / fits.sums.weight
    noise = posterior.noise_at(params).at(np.unravel_index(pixel, posterior.counts.shape))
    step = STEP * variance
    more = noise.counts_variance(fits.expected.ravel()[pixel] + step, level + step)
    return np.asarray((more - variance) / step)


def _deviates(z: Floats, terms: tuple[Floats, Floats, Floats], owner: Ints) -> Floats:
    """Normal deviates of sums in standard deviations; nan where they rest on too few counts.

    `terms` are the weights, and each sample's variance with its slope.
    """
    a, variance, slope = terms
    kurtosis = np.bincount(owner, (a * a * slope) ** 2 * variance, z.size)
    z = np.where(kurtosis * FEWEST <= 1.0, z, np.nan)
    far = (np.abs(z) > NORMAL) & (np.abs(z) < CERTAIN)
    if not far.any():
        return z
    here = far[owner]
    index = (np.cumsum(far) - 1)[owner[here]]
    a, variance, slope, x = a[here], variance[here], slope[here], z[far]
    # a sum below the least that counts allow has no such s: it stays as far as it is
    with np.errstate(all="ignore"):
        corrected = _saddlepoint(x, a, variance, slope, index)
    out = z.copy()
    out[far] = np.where(np.isfinite(corrected), corrected, x)
    return out


def _saddlepoint(x: Floats, a: Floats, variance: Floats, slope: Floats, index: Ints) -> Floats:
    """Barndorff-Nielsen's form: see the head of the module."""
    s = x.copy()
    for _ in range(ITERATIONS):
        g = slope * a * s[index]
        first = np.bincount(index, variance * a**2 * special.exprel(g), x.size) * s
        second = np.bincount(index, variance * a**2 * np.exp(g), x.size)
        s -= (first - x) / second
    g = slope * a * s[index]
    small = np.abs(g) < 1e-5
    half = np.where(small, 0.5, (special.exprel(g) - 1.0) / np.where(small, 1.0, g))
    k = np.bincount(index, variance * a**2 * half, x.size) * s**2
    second = np.bincount(index, variance * a**2 * np.exp(g), x.size)
    r = np.sign(s) * np.sqrt(2.0 * np.maximum(s * x - k, 1e-12))
    return np.asarray(r + np.log(s * np.sqrt(second) / r) / r)


def _chi_square(fits: SourceFits, taken: Absorbed, free: int) -> Floats:
    """Normal deviates of the sources' deviances, shape (s,)."""
    sums = fits.sums
    lost = np.bincount(fits.owner, np.sum(taken.modes**2, axis=1), fits.fluxes.size)
    mean = sums.expected + free - lost
    good = (mean > 0.0) & (sums.variance > 0.0) & np.isfinite(sums.deviance)
    z = np.full(mean.size, np.nan)
    dof = 2.0 * mean[good] ** 2 / sums.variance[good]
    z[good] = deviate(sums.deviance[good] / mean[good] * dof, dof)
    return z


def _discoveries(z: Floats) -> Flags:
    """Which rows hold a deviate that Benjamini and Hochberg's rule rejects, shape (s,)."""
    p = np.where(np.isfinite(z), 2.0 * special.ndtr(-np.abs(z)), 1.0)
    p[:, 0] = np.where(z[:, 0] > 0.0, 0.5 * p[:, 0], 1.0)  # of a chi-square only excess counts
    ordered, number = np.sort(p[np.isfinite(z)]), int(np.sum(np.isfinite(z)))
    passing = np.flatnonzero(ordered <= FALSE_ALARM * np.arange(1, number + 1) / max(number, 1))
    limit = ordered[passing[-1]] if passing.size else -1.0
    return np.asarray(np.any(p <= limit, axis=1))


def _spreads(
    covariance: Floats, fits: SourceFits, taken: Absorbed, slope: Floats, free: int
) -> tuple[Spread, ...]:
    """Fluxes and positions, unless they are free."""
    tests = [("fluxes", [0])] * (not free) + [("positions", [1, 2])] * (free < 3)
    found = (_spread(covariance, fits, taken, slope, test) for test in tests)
    return tuple(spread for spread in found if spread is not None)


def _spread(
    covariance: Floats,
    fits: SourceFits,
    taken: Absorbed,
    slope: Floats,
    test: tuple[str, list[int]],
) -> Spread | None:
    """The sum of the squared scores against its mean and variance for a true model."""
    (name, rows), own, weight, number = test, fits.own, fits.sums.weight, fits.fluxes.size
    templates = own.templates[rows]
    diagonal = np.einsum("skk->sk", fits.information)[:, rows]
    score = _by_source(own.first, templates, fits.sums.pull[None])
    left = fits.information - fits.information @ taken.spread @ fits.information
    expected = float(np.einsum("skk->k", left)[rows].sum())
    # sources that share pixels have correlated scores
    pixels = int(own.pixel.max(initial=0)) + 1
    half = sparse.hstack(
        [
            sparse.csc_matrix((template * np.sqrt(weight), own.pixel, own.first), (pixels, number))
            for template in templates
        ]
    )
    overlaps = (half.T @ half).tocsr()
    absorbed = np.concatenate([(fits.information @ taken.response)[:, k] for k in rows])
    inner = covariance @ (absorbed.T @ absorbed)
    squares = float(overlaps.multiply(overlaps).sum())
    lost = 2.0 * np.trace(covariance @ (absorbed.T @ (overlaps @ absorbed)))
    # counts are not Gaussian: the fourth cumulants
    tail = float(np.sum((templates * templates * weight * slope) ** 2 * weight))
    variance = 2.0 * (squares - lost + float(np.trace(inner @ inner))) + tail
    if not (expected > LEFT * diagonal.sum() and variance > 0.0):
        return None
    ratio, dof = float(np.sum(score**2)) / expected, 2.0 * expected**2 / variance
    between = max(ratio - 1.0, 0.0) * expected / float(np.sum(diagonal**2))
    return Spread(
        name, ratio, math.sqrt(variance) / expected, float(deviate(ratio * dof, dof)),
        math.sqrt(between),
    )  # fmt: skip
