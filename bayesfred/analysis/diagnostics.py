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

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.causes import Cause
from bayesfred.analysis.checks import check_table, sums
from bayesfred.analysis.frame_agreement import FrameAgreement, frame_agreement
from bayesfred.analysis.frame_verdict import frame_sensitivities, judge_frames, total_fit
from bayesfred.analysis.residuals import Residuals, judge_residuals, predictive_checks
from bayesfred.analysis.robust import robust_sd
from bayesfred.analysis.sensitivity import sensitivities
from bayesfred.analysis.verdict import (
    judge_approximation,
    judge_fit,
    judge_sampling,
    mode_shares,
)
from bayesfred.io.summary_table import Table, make_table, stacked
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.fit_statistics import fit_statistics
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import autocorrelation, convergence
from bayesfred.sampling.laplace import ApproximationCheck, check_approximation
from bayesfred.sampling.sampler import check_density
from bayesfred.sampling.summary import summary

__all__ = ["Diagnostics", "autocorrelation_time", "diagnose"]


@dataclass(frozen=True)
class Diagnostics:
    """Verdict on a chain and on the fit of its model.

    Attributes
    ----------
    sampled_well : bool or None
        Whether R-hat, effective sample sizes and acceptance are as they should be, the MAP is at
        the maximum, and enough sources are matched for the search to have found them. It says
        nothing else of the model. None where nothing was sampled: the draws are
        those of the Laplace approximation, and what is said of sampling below is nan.
    fits_data : bool
        Whether deviance and Pearson's statistic are what the noise makes them, within 5 standard
        deviations, enough sources are matched, and no score test and no source fails. It says
        nothing of the sampling.
    sentences : tuple of str, length 3
        How well the model fits, and probably why it does not; how well it is sampled; what the
        error bars leave out.
    causes : tuple of Cause
        Why the model does not fit, the most likely cause first; empty where it fits.
    modes : tuple of float
        The shares of the draws that lie in the posterior's modes, largest first.
    rhat : dict of str to float
        Rank-normalised split R-hat between ensembles, by parameter.
    ess_bulk, ess_tail : dict of str to float
        Effective numbers of draws for the centre and for the 5 % and 95 % quantiles, by parameter.
    approximation : ApproximationCheck or None
        How well draws of the Laplace approximation represent the posterior, see
        `bayesfred.sampling.laplace`; None of a sampled chain.
    at_maximum : bool
        Whether the MAP is at the maximum.
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
        Fitted numbers: parameters, and where they are free the fluxes and positions of sources, as
        many as the counts determine; a measured PSF's, too.
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
    robust_sd : dict of str to float
        Where the model does not fit: standard deviations that follow from the scatter between
        sources, by parameter, see `bayesfred.analysis.robust`. Empty where it fits, and of a frame
        among several.
    residuals : Residuals or None
        The table of sources, and what the residuals show; None for a density that is not a
        `Posterior` of a frame.
    checks : astropy.table.Table
        A row for each check of the fit, with the columns name, value, expected, sd, z and meaning:
        the two sums above, the scores of what is not fitted, the source that is farthest off in
        each way, the randomised PIT, the whiteness of the residuals, displacement against pixel
        phase, and the posterior predictive draws that were asked for. Of several frames they are
        the two sums, and the agreement of each.
    frames : mapping of str to Diagnostics
        Of several frames, what there is to say of each; empty of a single one.
    agreement : FrameAgreement or None
        Of several frames, whether they agree about what they share.
    """

    sampled_well: bool | None
    fits_data: bool
    sentences: tuple[str, str, str]
    causes: tuple[Cause, ...]
    modes: tuple[float, ...]
    rhat: dict[str, float]
    ess_bulk: dict[str, float]
    ess_tail: dict[str, float]
    approximation: ApproximationCheck | None
    at_maximum: bool
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
    robust_sd: dict[str, float]
    residuals: Residuals | None = field(repr=False, compare=False)
    checks: Table = field(repr=False, compare=False)
    frames: Mapping[str, "Diagnostics"] = field(default_factory=dict, repr=False)
    agreement: FrameAgreement | None = None

    @property
    def sources(self) -> Table:
        """How well every source agrees with the counts, see `analysis.sources.source_table`.

        Of several frames there is a column `frame` before the others.
        """
        if self.frames:
            return stacked({name: each.sources for name, each in self.frames.items()}, "frame")
        return make_table({}) if self.residuals is None else self.residuals.sources

    @property
    def trustworthy(self) -> bool:
        """Whether the model fits the counts, and the draws represent the posterior.

        They do where the run is sampled well; those of a Laplace approximation where the MAP is at
        the maximum, and the approximation holds.
        """
        if self.approximation is not None:
            return self.fits_data and self.at_maximum and self.approximation.holds
        return bool(self.sampled_well) and self.fits_data

    @property
    def message(self) -> str:
        """One line: whether the run is trustworthy, and the three sentences."""
        return f"{'' if self.trustworthy else 'not '}trustworthy: {' '.join(self.sentences)}"

    @property
    def verdict(self) -> dict[str, Any]:
        """What every output says of the run: flags, message and, of several, the modes' shares."""
        several = {"modes": list(self.modes)} if len(self.modes) > 1 else {}
        return {
            "sampled_well": self.sampled_well,
            "fits_data": self.fits_data,
            "trustworthy": self.trustworthy,
            "message": self.message,
            **several,
        }

    def summary(self, chain: Chain, *, truth: Floats | None = None) -> Table:
        """The table of parameters, with what is said of each here and the verdict as its `meta`.

        Parameters
        ----------
        chain : Chain
            The one that was judged.
        truth : ndarray, shape (d,), parameter units, optional
            Values that a simulation used.

        Returns
        -------
        astropy.table.Table
            See `bayesfred.sampling.summary.summary`. Where the model does not fit there is a column
            `robust_sd` besides, see `bayesfred.analysis.robust`.
        """
        table = summary(chain, truth=truth, columns=self.columns)
        table.meta.update(self.verdict)
        return table

    @property
    def columns(self) -> dict[str, dict[str, float]]:
        """What there is to say of every parameter, for `bayesfred.sampling.summary.summary`."""
        robust = {"robust_sd": self.robust_sd} if self.robust_sd else {}
        return robust | {
            "rhat": self.rhat,
            "ess_bulk": self.ess_bulk,
            "ess_tail": self.ess_tail,
            "tau": self.tau,
            "prior_sensitivity": self.prior_sensitivity,
            "likelihood_sensitivity": self.likelihood_sensitivity,
        }


@one_blas_thread()  # matrices too small to be shared
def diagnose(chain: Chain, *, target_ess: float = 1000.0, predictive: int = 0) -> Diagnostics:
    """Judge how a chain is sampled, whether its model fits the counts, and what its prior does.

    Sampled well means: largest R-hat at most 1.01, every bulk and tail effective sample size at
    least `target_ess`, at least one move in ten accepted, and a MAP at which the gradient vanishes.
    The model fits where deviance and Pearson's statistic at the MAP are within 5 standard
    deviations of their expectations, enough sources are matched, and no score test and no source
    fails; else `causes` says why. Of draws of the Laplace approximation the importance efficiency
    is judged instead.

    Parameters
    ----------
    chain : Chain
        A finished or running chain, or one that `laplace` made. Of several frames each is judged,
        and whether they agree about what they share.
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
    posterior, best = chain.posterior(), chain.estimate
    check_density(posterior, best)
    names = chain.parameter_names
    kept = chain.chain[:, chain.burn_in :]
    n_ensembles, n_steps, n_walkers, _ = kept.shape
    residuals, robust, frames, agreement = None, {}, {}, None
    if isinstance(posterior, JointPosterior):
        frames = {
            name: diagnose(chain.frame(name), target_ess=target_ess, predictive=predictive)
            for name in posterior.frames
        }
        agreement = frame_agreement(posterior, best.params)
        fit = total_fit(frames, posterior)
        fitted, checks = judge_frames(frames, agreement, fit, best), sums(fit)
    else:
        fit = fit_statistics(posterior, best.params)
        checks = sums(fit)
        if isinstance(posterior, Posterior):
            residuals = judge_residuals(posterior, best.params, best.covariance)
            checks += residuals.checks
        settings = (chain.record and chain.record.settings) or ""
        rejected = "reject_outliers = true" in settings.splitlines()
        fitted = judge_fit(posterior, best, fit, residuals, rejected=rejected)
    rhat, bulk, tail, tau = np.full((4, len(names)), np.nan)
    acceptance, approximation, sampled_well = np.nan, None, None
    if chain.method == "mcmc":
        rhat, bulk, tail = convergence(kept)
        walkers = kept.transpose(3, 0, 2, 1).reshape(len(names), n_ensembles * n_walkers, n_steps)
        tau = np.array([autocorrelation_time(series) for series in walkers])
        acceptance = float(np.mean(chain.accepted)) / max(chain.chain.shape[1], 1)
        sampled_well, sampling = judge_sampling(
            chain, rhat, np.minimum(bulk, tail), acceptance, target_ess, fitted.unmatched
        )
    else:
        approximation = check_approximation(chain)
        sampling = judge_approximation(chain, approximation)
    if residuals is not None and not fitted.fits_data and chain.whole is None:
        robust = _by_name(names, robust_sd(posterior, best.params, best.covariance))
    if predictive and not frames:
        draws = chain.draws()
        some = np.linspace(0, len(draws) - 1, min(predictive, len(draws))).astype(int)
        checks += predictive_checks(posterior, draws[some], seed=chain.seed)
    sensitivity = frame_sensitivities(frames, posterior) if frames else sensitivities(chain)
    return Diagnostics(
        sampled_well=sampled_well,
        fits_data=fitted.fits_data,
        sentences=(fitted.sentence, sampling, fitted.omitted),
        causes=fitted.causes,
        modes=mode_shares(chain),
        rhat=_by_name(names, rhat),
        ess_bulk=_by_name(names, bulk),
        ess_tail=_by_name(names, tail),
        approximation=approximation,
        at_maximum=chain.estimate.at_maximum,
        tau=_by_name(names, tau),
        acceptance=acceptance,
        n_draws=n_ensembles * n_steps * n_walkers,
        prior_sensitivity=_by_name(names, sensitivity.prior),
        likelihood_sensitivity=_by_name(names, sensitivity.likelihood),
        prior_dominated=tuple(np.array(names)[sensitivity.prior_dominated].tolist()),
        robust_sd=robust,
        residuals=residuals,
        checks=check_table(checks),
        frames=frames,
        agreement=agreement,
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


def _by_name(names: tuple[str, ...], values: Floats) -> dict[str, float]:
    return {name: float(value) for name, value in zip(names, values, strict=True)}
