"""How well a model with given parameters fits the counts: sums over pixels, and what they are if the model is true.

The paper's normalised chi-square, Pearson's statistic and the deviance. The last two come with the
expectation and standard deviation they have when the model is true, worked out for Poisson counts
of any mean, so that a z-score can be read even where a pixel holds 0.01 counts.

Expectations at a fitted model. Let T = sum t(n_i, mu_i) with e(mu) = E t and v(mu) = Var t, and
write cov(t, n) = mu c: c = 1/mu for Pearson's t, and c = e'(mu) for the unit deviance, whose
derivative in mu has mean zero. The part of T that is linear in the counts, sum c_i (n_i - mu_i), is
what a fit can remove: every model of this package fits a background, whose score equation sets sum
(n_i - mu_i) / mu_i to zero. Projecting that direction out leaves the variance

    sum v_i - (sum c_i)^2 / (sum 1/mu_i),

for Pearson 2 N instead of the N (2 + 1/mu) of a known mean: at 0.01 counts a pixel the two standard
deviations differ by a factor 7. Each fitted number lowers the expectation by one. Where the paper's
noise is fitted, a Gaussian of mean and variance lambda to counts that are Poisson, the same
argument for the score of lambda, A / lambda + B / (2 lambda^2) with A = sum r, B = sum (r^2 -
lambda), leaves Pearson's statistic (B - A) / (lambda + 1/2), of variance 2 N (lambda / (lambda +
1/2))^2.

References
----------
R. Sun, S. Zhou, section on noise: the estimate of lambda and the normalised chi-square.
P. McCullagh (1985), International Statistical Review 53, 61: moments of goodness of fit after a
fit.
"""

import math
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.special import xlogy
from scipy.stats import poisson

from bayesfred._typing import Floats
from bayesfred.model.noise import BackgroundNoise
from bayesfred.model.posterior import Posterior

SERIES_FROM = 1e3
SMALL_UNTIL = 1e-6
BLOCK = 2**16  # pixels

# The model fits where the deviance is within this many standard deviations of its expectation.
CONSISTENT = 5.0


def deviance_moments(
    mu: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Mean, variance and the mean's slope of the unit deviance of a Poisson count.

    The unit deviance is D(n; mu) = 2 (n log(n / mu) - n + mu), n ~ Poisson(mu). Its covariance with
    the count is mu times the slope, because dD/dmu = 2 (1 - n / mu) has mean zero. Sums over n on a
    grid of log mu are interpolated; below the grid the terms n <= 1 suffice, above it the first
    terms in 1/mu do. Relative error below 1e-4.

    Parameters
    ----------
    mu : ndarray, any shape, counts, positive

    Returns
    -------
    mean, variance, slope : ndarray, shape of `mu`; the slope per count

    Examples
    --------
    >>> mean, variance, slope = deviance_moments(np.array([0.01, 5.0, 1e6]))
    >>> mean.round(4), variance.round(4)
    (array([0.0922, 1.0467, 1.    ]), array([0.5243, 2.2668, 2.    ]))
    """
    spline = _deviance_table()
    small, large = mu < SMALL_UNTIL, mu > SERIES_FROM
    inside = np.clip(mu, SMALL_UNTIL, SERIES_FROM)
    log_mean, log_variance = np.moveaxis(spline(np.log(inside)), -1, 0)
    mean, variance = np.exp(log_mean), np.exp(log_variance)
    slope = mean / inside * spline(np.log(inside), 1)[..., 0]
    log_mu = np.log(mu)
    mean = np.where(
        small, -2.0 * mu * log_mu, np.where(large, 1.0 + (1.0 + 1.0 / mu) / (6.0 * mu), mean)
    )
    variance = np.where(
        small, 4.0 * mu * (1.0 + log_mu) ** 2, np.where(large, 2.0 + 2.0 / (3.0 * mu), variance)
    )
    slope = np.where(small, -2.0 * (1.0 + log_mu), np.where(large, -1.0 / (6.0 * mu**2), slope))
    return mean, variance, slope


@cache
def _deviance_table() -> CubicSpline:
    """Logarithms of mean and variance of the unit deviance over log mu, from sums over n."""
    grid = np.geomspace(SMALL_UNTIL, SERIES_FROM, 361)
    moments = np.empty((grid.size, 2))
    for k, mu in enumerate(grid):
        reach = 12.0 * np.sqrt(mu)
        n = np.arange(max(0, int(mu - reach)), int(mu + reach) + 25, dtype=np.float64)
        chance = poisson.pmf(n, mu)
        deviance = 2.0 * (xlogy(n, n / mu) - n + mu)
        mean = chance @ deviance
        moments[k] = mean, chance @ (deviance - mean) ** 2
    return CubicSpline(np.log(grid), np.log(moments))


def fit_statistics(posterior: Posterior, params: Floats) -> dict[str, Any]:
    """The numbers that judge a fit, by the names that `Diagnostics` gives them."""
    used = posterior.mask
    n = posterior.counts[used]
    mu = posterior.expected_counts(params)[used]
    constant = posterior.nuisances.background_order == 0
    background = (
        float(params[posterior.parameter_names.index("background")]) if constant else math.nan
    )
    residual = n - (mu - background)
    estimate = float(np.mean(residual))
    profiled = posterior.nuisances.profiled * posterior.model.sources.flux.size
    fit: dict[str, Any] = {
        "n_pixels": n.size,
        "n_fitted": posterior.n_parameters + profiled,
        "background_estimate": estimate,
        "chi2_paper": float(np.mean((residual - estimate) ** 2) / estimate)
        if estimate > 0.0
        else math.nan,
        "pearson_expected": float(n.size - posterior.n_parameters - profiled),
        "pearson_sd": math.sqrt(2.0 * n.size),
    }
    if isinstance(posterior.noise, BackgroundNoise):
        # the counts are not Poisson(mu) there: every pixel varies as the background does
        fit["pearson"] = float(np.sum((n - mu) ** 2) / background)
        fit["pearson_sd"] *= background / (background + 0.5)
        return fit | {
            key.replace("pearson", "deviance"): fit[key] for key in fit if "pearson" in key
        }
    shift = posterior.noise.read_noise**2
    n, mu = n + shift, mu + shift
    with np.errstate(all="ignore"):  # a mean of zero makes a statistic infinite, which is its value
        sums = np.zeros(6)
        for first in range(
            0, n.size, BLOCK
        ):  # whole frames of intermediate numbers would not fit the caches, or the memory
            some, here = n[first : first + BLOCK], mu[first : first + BLOCK]
            pearson, deviance = (
                (some - here) ** 2 / here,
                2.0 * (xlogy(some, np.maximum(some, 0.0) / here) - some + here),
            )
            sums += [
                np.sum(part) for part in (pearson, deviance, *deviance_moments(here), 1.0 / here)
            ]
        fit["pearson"], fit["deviance"], mean, variance, slope, inverse = sums.tolist()
        # a fitted background removes the part that is linear in the counts: see the head of the
        # module
        left = variance - slope**2 / np.float64(inverse)
    return fit | {
        "deviance_expected": mean - fit["n_fitted"],
        "deviance_sd": float(np.sqrt(left)),
    }


def misfit(fit: Mapping[str, float]) -> float:
    """By how many standard deviations the deviance of `fit_statistics` exceeds its expectation."""
    return float((fit["deviance"] - fit["deviance_expected"]) / fit["deviance_sd"])
