"""What a finished run is worth: how it is sampled, whether it fits the counts, what the prior does.

`diagnose` puts all into one record. Sampling is judged on R-hat, effective sample sizes,
acceptance and the optimiser's own verdict (`bayesfred.sampling.convergence` holds the estimators).
The fit is judged at the MAP by three sums over the pixels that enter the likelihood: the paper's
normalised chi-square, Pearson's statistic and the deviance. The last two come with the expectation
and standard deviation they have when the model is true, see `bayesfred.optimize.fit_statistics`.
What the prior does to the posterior is read off the draws, weighted as if prior or likelihood were
raised to a power near 1.

References
----------
N. Kallioinen, T. Paananen, P.-C. Buerkner, A. Vehtari (2024), Statistics and Computing 34, 57:
power-scaling.
R. Sun, S. Zhou, section on noise: the estimate of lambda and the normalised chi-square.
A. Sokal (1996), Monte Carlo methods in statistical mechanics: the window of the autocorrelation
time.
"""

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field

import arviz_base
import lazy_loader
import numpy as np
from threadpoolctl import threadpool_limits

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.analysis.checks import Check, check_table
from bayesfred.analysis.residuals import Residuals, judge_residuals, predictive_checks
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.fit_statistics import CONSISTENT, fit_statistics, misfit
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import autocorrelation, convergence

__all__ = ["Diagnostics", "autocorrelation_time", "diagnose"]

# takes long to load, and most of what imports this module judges no chain
arviz_stats = lazy_loader.load("arviz_stats")

MAX_RHAT = 1.01
MIN_ACCEPTANCE = 0.1
FEWEST = 100  # draws from which a sensitivity is read
FLAT = 1e-6  # difference of log densities that moves no posterior
FIELD_POINTS = 9  # along each axis of the frame
INFORMATIVE = 0.05  # sensitivity; the threshold of Kallioinen et al., and of arviz


@dataclass(frozen=True)
class Diagnostics:
    """Verdict on a chain and on the fit of its model.

    Attributes
    ----------
    sampled_well : bool
        Whether R-hat, effective sample sizes and acceptance are as they should be, and the MAP is
        at the maximum. It says nothing of the model.
    fits_data : bool
        Whether the deviance is what the noise makes it, within 5 standard deviations. It says
        nothing of the sampling.
    message : str
        One line: whether the run is trustworthy, how well the model fits, and how well it is
        sampled, a sentence each.
    rhat : dict of str to float
        Rank-normalised split R-hat between ensembles, by parameter.
    ess_bulk, ess_tail : dict of str to float
        Effective numbers of draws for the centre and for the 5 % and 95 % quantiles, by parameter.
    tau : dict of str to float
        Integrated autocorrelation time, in steps, by parameter; a lower bound where the chain is
        shorter than 10 tau.
    acceptance : float
        Mean fraction of accepted moves, burn-in included.
    n_draws : int
        Draws after burn-in, all ensembles and walkers.
    n_pixels : int
        Pixels that enter the likelihood.
    n_fitted : int
        Fitted numbers: parameters, and every source's flux and position where these are free.
    background_estimate : float
        The paper's lambda-hat, counts per pixel: mean of counts less the source image. nan unless
        the background is a constant.
    chi2_paper : float
        The paper's normalised chi-square, about 1 where the sources add no noise of their own. nan
        as above.
    pearson, pearson_expected, pearson_sd : float
        Sum of (n - mu)^2 / variance, and what a true model, fitted, would give.
    deviance, deviance_expected, deviance_sd : float
        Sum of 2 (n log(n / mu) - n + mu), likewise.
    prior_sensitivity, likelihood_sensitivity : dict of str to float
        How far each parameter's posterior moves when the prior, or the likelihood, is raised to a
        power alpha: cumulative Jensen-Shannon distance per unit of log2(alpha) at alpha = 1. nan
        where draws are too few or do not vary.
    prior_dominated : tuple of str
        Parameters whose prior sensitivity is at least 0.05: the frame alone does not decide them.
        A coefficient of the distortion is among them only if the prior decides a displacement that
        it takes part in: the sensitivity of the displacement along the coefficient's pattern over
        the frame is at least 0.05 too.
    residuals : Residuals or None
        The table of sources, and what the residuals show; None for a density that is not a
        `Posterior` of a frame.
    checks : astropy.table.Table
        A row for each check of the fit, with the columns name, value, expected, sd, z and meaning:
        the two sums above, the randomised PIT, the whiteness of the residuals, displacement against
        pixel phase, and the posterior predictive draws that were asked for.
    """

    sampled_well: bool
    fits_data: bool
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
    prior_sensitivity: dict[str, float]
    likelihood_sensitivity: dict[str, float]
    prior_dominated: tuple[str, ...]
    residuals: Residuals | None = field(repr=False, compare=False)
    checks: Table = field(repr=False, compare=False)

    @property
    def sources(self) -> Table:
        """How well every source agrees with the counts, see `analysis.sources.source_table`."""
        return make_table({}) if self.residuals is None else self.residuals.sources

    @property
    def trustworthy(self) -> bool:
        """Whether the run is sampled well and its model fits the counts."""
        return self.sampled_well and self.fits_data

    @property
    def columns(self) -> dict[str, dict[str, float]]:
        """What there is to say of every parameter, for `bayesfred.sampling.summary.summary`."""
        return {
            "rhat": self.rhat,
            "ess_bulk": self.ess_bulk,
            "ess_tail": self.ess_tail,
            "tau": self.tau,
            "prior_sensitivity": self.prior_sensitivity,
            "likelihood_sensitivity": self.likelihood_sensitivity,
        }


def diagnose(chain: Chain, *, target_ess: float = 1000.0, predictive: int = 0) -> Diagnostics:
    """Judge how a chain is sampled, whether its model fits the counts, and what its prior does.

    Sampled well means: largest R-hat at most 1.01, every bulk and tail effective sample size at
    least `target_ess`, at least one move in ten accepted, and a MAP at which the gradient vanishes.
    The model fits where the deviance at the MAP is within 5 standard deviations of its expectation.

    Parameters
    ----------
    chain : Chain
        A finished or running chain.
    target_ess : float, optional
        Effective draws demanded of every parameter.
    predictive : int, optional
        Number of draws, 50 say, at which a frame is simulated for posterior predictive checks;
        each takes as long as all other checks.

    Returns
    -------
    Diagnostics

    References
    ----------
    Sun and Zhou, the equations of lambda-hat and of the normalised chi-square, for
    `background_estimate` and `chi2_paper`. Kallioinen et al. (2024) for the sensitivities.
    """
    posterior = chain.posterior()
    names = chain.parameter_names
    kept = chain.chain[:, chain.burn_in :]
    n_ensembles, n_steps, n_walkers, _ = kept.shape
    rhat, bulk, tail = convergence(kept)
    walkers = kept.transpose(3, 0, 2, 1).reshape(len(names), n_ensembles * n_walkers, n_steps)
    tau = np.array([autocorrelation_time(series) for series in walkers])
    total_steps = max(chain.chain.shape[1], 1)
    acceptance = float(np.mean(chain.accepted)) / total_steps
    failures = _failures(rhat, np.minimum(bulk, tail), acceptance, chain, target_ess)
    fit = fit_statistics(posterior, chain.estimate.params)
    fits_data = abs(misfit(fit)) <= CONSISTENT
    message = f"{'not ' if failures or not fits_data else ''}trustworthy: {_fit_sentence(fit)} " + (
        f"Not sampled well: {'; '.join(failures)}."
        if failures
        else f"Sampled well: R-hat at most {rhat.max():.4f}, effective sample size at least "
        f"{min(bulk.min(), tail.min()):.0f}, acceptance {acceptance:.1%}."
    )
    residuals, checks = None, _sums(fit)
    if isinstance(posterior, Posterior):
        residuals = judge_residuals(posterior, chain.estimate.params, chain.estimate.covariance)
        checks += residuals.checks
    if predictive:
        draws = _draws(chain)
        some = np.linspace(0, len(draws) - 1, min(predictive, len(draws))).astype(int)
        checks += predictive_checks(posterior, draws[some], seed=chain.seed)
    prior, likelihood = _sensitivities(chain, posterior)
    dominated = prior >= INFORMATIVE
    dominated[dominated] = _visible(chain, posterior, np.flatnonzero(dominated))
    return Diagnostics(
        sampled_well=not failures,
        fits_data=fits_data,
        message=message,
        rhat=_by_name(names, rhat),
        ess_bulk=_by_name(names, bulk),
        ess_tail=_by_name(names, tail),
        tau=_by_name(names, tau),
        acceptance=acceptance,
        n_draws=n_ensembles * n_steps * n_walkers,
        prior_sensitivity=_by_name(names, prior),
        likelihood_sensitivity=_by_name(names, likelihood),
        prior_dominated=tuple(np.array(names)[dominated].tolist()),
        residuals=residuals,
        checks=check_table(checks),
        **fit,
    )


def autocorrelation_time(series: Floats, window: float = 5.0) -> float:
    """Integrated autocorrelation time by Sokal's window.

    1 + 2 sum rho_t up to the first lag M >= window tau(M), with the autocorrelation pooled over
    chains about their common mean. For long chains this is what `emcee.autocorr.integrated_time`
    estimates; for short ones it lacks the bias of subtracting each walker's own mean.

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


def _visible(chain: Chain, posterior: Posterior, parameters: Ints) -> Flags:
    """Which of these parameters matter to what is measured, shape (number of parameters,).

    A frame hardly tells u x from x^2, as u is nearly x: it knows the sum of two such coefficients,
    the prior their difference, and the difference moves nothing. So a coefficient of the distortion
    is judged by displacements. With W the design matrix of f and g at points all over the frame,
    W theta is the displacement, and (W^T W theta)_k its component along the pattern that a unit of
    coefficient k makes. It is this component whose sensitivity to the prior counts.
    """
    d = posterior.model.polynomial
    visible = np.ones(parameters.size, dtype=bool)
    terms = parameters[parameters < d.n_terms]
    if not terms.size:
        return visible
    half = 0.5 * np.array(posterior.model.detector.fine_shape[::-1], dtype=np.float64)
    x, y = (c.ravel() for c in np.meshgrid(*np.linspace(-half, half, FIELD_POINTS).T))
    u, v = d.image_position(chain.estimate.params[: d.n_terms], x, y)
    imaged = np.isfinite(u + v)
    design = d.design_matrix(u[imaged], v[imaged], x[imaged], y[imaged]).reshape(-1, d.n_terms)
    draws, names = _draws(chain), tuple(chain.parameter_names[k] for k in terms)
    components = draws[:, : d.n_terms] @ (design.T @ design[:, terms])
    sensitivity = _sensitivity(names, components, posterior.log_prior(draws))
    visible[parameters < d.n_terms] = sensitivity >= INFORMATIVE
    return visible


def _draws(chain: Chain) -> Floats:
    """All draws after burn-in, walker by walker, shape (n, d)."""
    kept = chain.chain[:, chain.burn_in :]
    return kept.swapaxes(1, 2).reshape(-1, len(chain.parameter_names))


def _sensitivities(chain: Chain, posterior: Posterior) -> tuple[Floats, Floats]:
    """Power-scaling sensitivity of every parameter to prior and likelihood, each shape (d,)."""
    names = chain.parameter_names
    draws = _draws(chain)
    log_prob = chain.log_prob[:, chain.burn_in :].swapaxes(1, 2).ravel()
    log_prior = posterior.log_prior(draws)
    return _sensitivity(names, draws, log_prior), _sensitivity(names, draws, log_prob - log_prior)


def _sensitivity(names: tuple[str, ...], draws: Floats, log_part: Floats) -> Floats:
    """Sensitivity of every parameter to one factor of the posterior, shape (d,).

    `log_part` is the factor's logarithm at the draws, shape (n,).
    """
    if len(draws) < FEWEST or not np.all(np.isfinite(log_part)):
        return np.full(len(names), np.nan)
    if np.ptp(log_part) < FLAT:
        return np.zeros(len(names))
    posterior = {name: draws[None, :, k] for k, name in enumerate(names)}
    data = arviz_base.from_dict({"posterior": posterior, "log_prior": {"part": log_part[None]}})
    with (
        warnings.catch_warnings(),
        np.errstate(invalid="ignore"),
        threadpool_limits(1, user_api="blas"),
    ):
        warnings.filterwarnings("ignore", message="Number of tail draws")
        try:
            sensitivity = arviz_stats.psense(data)
        except ValueError:  # hardly a draw differs from another
            return np.full(len(names), np.nan)
    return np.array([float(sensitivity[name]) for name in names])


def _by_name(names: tuple[str, ...], values: Floats) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def _sums(fit: Mapping[str, float]) -> list[Check]:
    """Pearson's statistic and the deviance."""
    meanings = {
        "Pearson": "sum of squared residuals in standard deviations",
        "deviance": "twice the log-likelihood that a perfect model would gain",
    }
    checks = []
    for name, meaning in meanings.items():
        value, expected, sd = (fit[f"{name.lower()}{part}"] for part in ("", "_expected", "_sd"))
        z = (value - expected) / sd if sd > 0.0 else float("nan")
        checks.append(Check(name, value, expected, sd, z, meaning))
    return checks


def _fit_sentence(fit: Mapping[str, float]) -> str:
    """Say whether the model fits the counts."""
    excess = misfit(fit)
    side = "below" if excess < 0 else "above"
    deviance = f"deviance {abs(excess):.1f} standard deviations {side} its expectation"
    if abs(excess) <= CONSISTENT:
        return f"The model fits the counts: {deviance}."
    return f"The model does not fit the counts: {deviance}, expected at most {CONSISTENT:.0f}."


def _failures(
    rhat: Floats, ess: Floats, acceptance: float, chain: Chain, target_ess: float
) -> list[str]:
    """What is wrong with the sampling, criterion by criterion."""
    names = chain.parameter_names
    worst, least = int(np.argmax(rhat)), int(np.argmin(ess))
    failures = []
    if not rhat[worst] <= MAX_RHAT:
        failures.append(f"R-hat {rhat[worst]:.3f} of {names[worst]} exceeds {MAX_RHAT}")
    if not ess[least] >= target_ess:
        failures.append(
            f"effective sample size {ess[least]:.0f} of {names[least]} is below {target_ess:.0f}"
        )
    if not acceptance >= MIN_ACCEPTANCE:
        failures.append(f"acceptance {acceptance:.1%} is below {MIN_ACCEPTANCE:.0%}")
    if not chain.estimate.at_maximum:
        failures.append(f"the MAP is not at the maximum ({chain.estimate.message})")
    return failures
