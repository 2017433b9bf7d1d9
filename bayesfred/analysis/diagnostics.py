"""What a finished run is worth: did the chain converge, and does the model fit the counts.

`diagnose` puts both into one record. Convergence is judged on R-hat, effective sample sizes, acceptance and
the optimiser's own verdict (`bayesfred.inference.convergence` holds the estimators). The fit is judged at
the MAP by three sums over the pixels that enter the likelihood: the paper's normalised chi-square,
Pearson's statistic and the deviance. The last two come with the expectation and standard deviation they
have when the model is true, worked out for Poisson counts of any mean, so that a z-score can be read even
where a pixel holds 0.01 counts.

Expectations at a fitted model ------------------------------ Let T = sum t(n_i, mu_i) with e(mu) = E t and
v(mu) = Var t, and write cov(t, n) = mu c: c = 1/mu for Pearson's t, and c = e'(mu) for the unit deviance,
whose derivative in mu has mean zero. The part of T that is linear in the counts, sum c_i (n_i - mu_i), is
what a fit can remove: every model of this package fits a background, whose score equation sets sum (n_i -
mu_i) / mu_i to zero. Projecting that direction out leaves the variance

    sum v_i - (sum c_i)^2 / (sum 1/mu_i),

for Pearson 2 N instead of the N (2 + 1/mu) of a known mean: at 0.01 counts a pixel the two standard
deviations differ by a factor 7. Each fitted number lowers the expectation by one. Where the paper's noise
is fitted, a Gaussian of mean and variance lambda to counts that are Poisson, the same argument for the
score of lambda, A / lambda + B / (2 lambda^2) with A = sum r, B = sum (r^2 - lambda), leaves Pearson's
statistic (B - A) / (lambda + 1/2), of variance 2 N (lambda / (lambda + 1/2))^2.

References
----------
R. Sun, S. Zhou, section on noise: the estimate of lambda and the normalised chi-square.
P. McCullagh (1985), International Statistical Review 53, 61: moments of goodness of fit after a fit.
A. Sokal (1996), Monte Carlo methods in statistical mechanics: the window of the autocorrelation time.
"""

import math
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.special import xlogy
from scipy.stats import poisson

from bayesfred.inference.chainfile import Chain
from bayesfred.inference.convergence import autocorrelation, convergence
from bayesfred.inference.noise import BackgroundNoise
from bayesfred.inference.posterior import Posterior

__all__ = ["Diagnostics", "autocorrelation_time", "deviance_moments", "diagnose"]

MAX_RHAT = 1.01
MIN_ACCEPTANCE = 0.1
SERIES_FROM = 1e3
SMALL_UNTIL = 1e-6


@dataclass(frozen=True)
class Diagnostics:
    """Verdict on a chain and on the fit of its model.

    Attributes
    ----------
    converged : bool
        Whether every criterion of `message` is met.
    message : str
        One line: the criteria and their values, or which ones failed.
    rhat : dict of str to float
        Rank-normalised split R-hat between ensembles, by parameter.
    ess_bulk, ess_tail : dict of str to float
        Effective numbers of draws for the centre and for the 5 % and 95 % quantiles, by parameter.
    tau : dict of str to float
        Integrated autocorrelation time, in steps, by parameter; a lower bound where the chain is shorter
        than 10 tau.
    acceptance : float
        Mean fraction of accepted moves, burn-in included.
    n_draws : int
        Draws after burn-in, all ensembles and walkers.
    n_pixels : int
        Pixels that enter the likelihood.
    n_fitted : int
        Fitted numbers: parameters, and every source's flux and position where these are free.
    background_estimate : float
        The paper's lambda-hat, counts per pixel: mean of counts less the source image. nan unless the
        background is a constant.
    chi2_paper : float
        The paper's normalised chi-square, about 1 where the sources add no noise of their own. nan as above.
    pearson, pearson_expected, pearson_sd : float
        Sum of (n - mu)^2 / variance, and what a true model, fitted, would give.
    deviance, deviance_expected, deviance_sd : float
        Sum of 2 (n log(n / mu) - n + mu), likewise.
    """

    converged: bool
    message: str
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    tau: dict[str, float]
    acceptance: float
    n_draws: int
    n_pixels: int
    n_fitted: int
    background_estimate: float
    chi2_paper: float
    pearson: float
    pearson_expected: float
    pearson_sd: float
    deviance: float
    deviance_expected: float
    deviance_sd: float


def diagnose(chain: Chain, *, target_ess: float = 1000.0) -> Diagnostics:
    """Judge whether a chain has converged and whether its model fits the counts.

    Converged means: largest R-hat at most 1.01, every bulk and tail effective sample size at least
    `target_ess`, at least one move in ten accepted, and a MAP at which the optimiser converged.

    Parameters
    ----------
    chain : Chain
        A finished or running chain.
    target_ess : float, optional
        Effective draws demanded of every parameter.

    Returns
    -------
    Diagnostics

    References
    ----------
    Sun and Zhou, the equations of lambda-hat and of the normalised chi-square, for `background_estimate` and
    `chi2_paper`.
    """
    names = chain.parameter_names
    kept = chain.chain[:, chain.burn_in :]
    n_ensembles, n_steps, n_walkers, _ = kept.shape
    rhat, bulk, tail = convergence(kept)
    walkers = kept.transpose(3, 0, 2, 1).reshape(len(names), n_ensembles * n_walkers, n_steps)
    tau = np.array([autocorrelation_time(series) for series in walkers])
    total_steps = max(chain.chain.shape[1], 1)
    acceptance = float(np.mean(chain.accepted)) / total_steps
    converged, message = _verdict(rhat, np.minimum(bulk, tail), acceptance, chain, target_ess)
    return Diagnostics(
        converged=converged,
        message=message,
        rhat=_by_name(names, rhat),
        ess_bulk=_by_name(names, bulk),
        ess_tail=_by_name(names, tail),
        tau=_by_name(names, tau),
        acceptance=acceptance,
        n_draws=n_ensembles * n_steps * n_walkers,
        **_fit(chain.posterior(), chain.estimate.params),
    )


def autocorrelation_time(series: NDArray[np.float64], window: float = 5.0) -> float:
    """Integrated autocorrelation time by Sokal's window.

    1 + 2 sum rho_t up to the first lag M >= window tau(M), with the autocorrelation pooled over chains
    about their common mean. For long chains this is what `emcee.autocorr.integrated_time` estimates; for
    short ones it lacks the bias of subtracting each walker's own mean.

    Parameters
    ----------
    series : ndarray, shape (n_chains, n_steps)
        One parameter's chains, any unit.
    window : float, optional
        Sokal's c.

    Returns
    -------
    float, steps
        A lower bound where it exceeds a tenth of the chain; nan for a series that does not vary.
    """
    if series.shape[1] < 2 or not np.all(np.isfinite(series)) or np.ptp(series) == 0.0:
        return float("nan")
    tau = 2.0 * np.cumsum(autocorrelation(series)) - 1.0
    closed = np.flatnonzero(np.arange(tau.size) >= window * tau)
    return float(tau[closed[0] if closed.size else -1])


def deviance_moments(
    mu: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Mean, variance and the mean's slope of the unit deviance of a Poisson count.

    The unit deviance is D(n; mu) = 2 (n log(n / mu) - n + mu), n ~ Poisson(mu). Its covariance with the
    count is mu times the slope, because dD/dmu = 2 (1 - n / mu) has mean zero. Sums over n on a grid of log
    mu are interpolated; below the grid the terms n <= 1 suffice, above it the first terms in 1/mu do.
    Relative error below 1e-4.

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
    mean = np.where(small, -2.0 * mu * log_mu, np.where(large, 1.0 + (1.0 + 1.0 / mu) / (6.0 * mu), mean))
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


def _by_name(names: tuple[str, ...], values: NDArray[np.float64]) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _verdict(
    rhat: NDArray[np.float64], ess: NDArray[np.float64], acceptance: float, chain: Chain, target_ess: float
) -> tuple[bool, str]:
    """Whether all criteria are met, and the line that says which are not."""
    names = chain.parameter_names
    worst, least = int(np.argmax(rhat)), int(np.argmin(ess))
    failures = []
    if not rhat[worst] <= MAX_RHAT:
        failures.append(f"R-hat {rhat[worst]:.3f} of {names[worst]} exceeds {MAX_RHAT}")
    if not ess[least] >= target_ess:
        failures.append(f"effective sample size {ess[least]:.0f} of {names[least]} is below {target_ess:.0f}")
    if not acceptance >= MIN_ACCEPTANCE:
        failures.append(f"acceptance {acceptance:.1%} is below {MIN_ACCEPTANCE:.0%}")
    if not chain.estimate.converged:
        failures.append(f"the MAP did not converge ({chain.estimate.message})")
    if failures:
        return False, "not converged: " + "; ".join(failures)
    return True, (
        f"converged: R-hat at most {rhat[worst]:.4f}, effective sample size at least {ess[least]:.0f}, "
        f"acceptance {acceptance:.1%}"
    )


def _fit(posterior: Posterior, params: NDArray[np.float64]) -> dict[str, Any]:
    """The fields of `Diagnostics` that judge the fit, at `params`."""
    used = posterior.mask
    n = posterior.counts[used]
    mu = posterior.expected_counts(params)[used]
    constant = posterior.nuisances.background_order == 0
    background = float(params[posterior.parameter_names.index("background")]) if constant else math.nan
    residual = n - (mu - background)
    estimate = float(np.mean(residual))
    profiled = posterior.nuisances.profiled * posterior.model.sources.flux.size
    fit: dict[str, Any] = {
        "n_pixels": n.size,
        "n_fitted": posterior.n_parameters + profiled,
        "background_estimate": estimate,
        "chi2_paper": float(np.mean((residual - estimate) ** 2) / estimate) if estimate > 0.0 else math.nan,
        "pearson_expected": float(n.size - posterior.n_parameters - profiled),
        "pearson_sd": math.sqrt(2.0 * n.size),
    }
    if isinstance(posterior.noise, BackgroundNoise):
        # the counts are not Poisson(mu) there: every pixel varies as the background does
        fit["pearson"] = float(np.sum((n - mu) ** 2) / background)
        fit["pearson_sd"] *= background / (background + 0.5)
        return fit | {key.replace("pearson", "deviance"): fit[key] for key in fit if "pearson" in key}
    shift = posterior.noise.read_noise**2
    n, mu = n + shift, mu + shift
    with np.errstate(all="ignore"):  # a mean of zero makes a statistic infinite, which is its value
        mean, variance, slope = deviance_moments(mu)
        # a fitted background removes the part that is linear in the counts: see the head of the module
        left = np.sum(variance) - np.sum(slope) ** 2 / np.sum(1.0 / mu)
        fit["pearson"] = float(np.sum((n - mu) ** 2 / mu))
        fit["deviance"] = float(np.sum(2.0 * (xlogy(n, np.maximum(n, 0.0) / mu) - n + mu)))
    return fit | {
        "deviance_expected": float(np.sum(mean)) - fit["n_fitted"],
        "deviance_sd": float(np.sqrt(left)),
    }
