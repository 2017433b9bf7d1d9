"""How well a model with given parameters fits the counts.

These are sums over pixels, with what they are if the model is true.

The paper's normalised chi-square, Pearson's statistic and the deviance. The last two come with the
expectation and standard deviation they have when the model is true, from the noise model's moments:
for Poisson counts of any mean, so that a z-score can be read even where a pixel holds 0.01 counts.

Expectations at a fitted model. Let T = sum t(n_i, mu_i) with e(mu) = E t and v(mu) = Var t, and
write cov(t, n) = mu c: c = 1/mu for Pearson's t, and c = e'(mu) for the unit deviance, whose
derivative in mu has mean zero. The part of T that is linear in the counts, sum c_i (n_i - mu_i), is
what a fit can remove: every model of this package fits a background, whose score equation sets sum
(n_i - mu_i) / mu_i to zero. Projecting that direction out leaves the variance

    sum v_i - (sum c_i)^2 / (sum 1/mu_i),

for Pearson 2 N instead of the N (2 + 1/mu) of a known mean: at 0.01 counts a pixel the two standard
deviations differ by a factor 7. Each fitted number lowers the expectation by one, and one that a
prior holds too by less (`bayesfred.optimize.source_numbers`). Where the paper's noise is fitted, a
Gaussian of mean and variance lambda to counts that are Poisson, the same argument for the score of
lambda, A / lambda + B / (2 lambda^2) with A = sum r, B = sum (r^2 - lambda), leaves Pearson's
statistic (B - A) / (lambda + 1/2), of variance 2 N (lambda / (lambda + 1/2))^2.

References
----------
R. Sun, S. Zhou, section on noise: the estimate of lambda and the normalised chi-square.
P. McCullagh (1985), International Statistical Review 53, 61: moments of goodness of fit after a
fit.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from bayesfred._typing import Floats
from bayesfred.model.noise import Noise
from bayesfred.model.pixels import Expected
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.source_numbers import determined_numbers

BLOCK = 2**16  # pixels
PART = 2**21  # pixels of a frame that are gathered at once

# The model fits where deviance and Pearson's statistic are within this many standard deviations of
# their expectations.
CONSISTENT = 5.0


def fit_statistics(posterior: Posterior, params: Floats) -> dict[str, Any]:
    """The numbers that judge a fit, by the names that `Diagnostics` gives them."""
    level = float(params[posterior.parameter_names.index("background")])
    background = level if posterior.nuisances.background_order == 0 else math.nan
    noise = posterior.noise_at(params).pixelwise
    sums, moments = np.zeros(7), np.zeros(3)
    # a mean of zero makes a statistic infinite, which is its value
    with posterior.likelihood.expected(params) as expected, np.errstate(all="ignore"):
        for n, mu, own in _parts(posterior, expected, noise):
            residual = n - (mu - background)
            moments += n.size, np.sum(residual), 0.0
            # frames of intermediate numbers would not fit the caches
            for first in range(0, n.size, BLOCK):
                block = slice(first, first + BLOCK)
                sums += _sums(own.at(block), n[block], mu[block], level)
        number, estimate = int(moments[0]), float(moments[1] / moments[0])
        for n, mu, _ in _parts(posterior, expected, noise):
            moments[2] += np.sum((n - (mu - background) - estimate) ** 2)
        pearson, pearson_variance, deviance, mean, variance, slope, inverse = sums.tolist()
        # a fitted background removes the part that is linear in the counts: see the head of the
        # module
        left = variance - slope**2 / np.float64(inverse)
        folded = bool(np.isnan(expected.fluxes).any())
    fitted = _fitted(posterior, params, folded=folded)
    scaled = float(moments[2] / number / estimate) if estimate > 0.0 else math.nan
    return {
        "n_pixels": number,
        "n_fitted": fitted,
        "background_estimate": estimate,
        "chi2_paper": scaled,
        "pearson": pearson,
        "pearson_expected": float(number - fitted),
        "pearson_sd": math.sqrt(pearson_variance),
        "deviance": deviance,
        "deviance_expected": mean - fitted,
        "deviance_sd": float(np.sqrt(left)),
    }


def _fitted(posterior: Posterior, params: Floats, *, folded: bool) -> int:
    """How many numbers the fit takes from the counts."""
    fitted = float(posterior.n_parameters)
    if posterior.nuisances.profiled and not folded:
        fitted += determined_numbers(posterior, params)
    if posterior.psf_errors is not None:
        fitted += posterior.psf_errors.absorbed
    return round(fitted)


def _parts(
    posterior: Posterior, expected: Expected, noise: Noise
) -> Iterator[tuple[Floats, Floats, Noise]]:
    """Counts, their means and the noise of the pixels in use, some rows at a time."""
    ny, nx = posterior.mask.shape
    rows = max(1, PART // nx)
    for first in range(0, ny, rows):
        some = slice(first, first + rows)
        used = posterior.mask[some]
        mu = (expected.light[some] + expected.level[some])[used]
        yield np.asarray(posterior.counts[some][used], np.float64), mu, noise.at(some).at(used)


def _sums(noise: Noise, n: Floats, mu: Floats, level: float) -> Floats:
    parts = (
        noise.residual(n, mu, level) ** 2,
        noise.pearson_variance(mu, level),
        noise.deviance(n, mu, level),
        *noise.deviance_moments(mu, level),
        noise.fisher_weight(mu, level),
    )
    return np.array([np.sum(part) for part in parts])


def misfit(fit: Mapping[str, float], name: str = "deviance") -> float:
    """By how many standard deviations a sum of `fit_statistics` exceeds its expectation."""
    return float((fit[name] - fit[f"{name}_expected"]) / fit[f"{name}_sd"])


def consistent(fit: Mapping[str, float]) -> bool:
    """Whether deviance and Pearson's statistic are what the noise makes them."""
    return all(abs(misfit(fit, name)) <= CONSISTENT for name in ("deviance", "pearson"))
