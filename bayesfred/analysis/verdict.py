"""The verdict in words: does the model fit, is the posterior sampled, what do errors leave out.

There are three sentences, in order of loudness: a model that does not fit spoils every other
number, and says so first, with the probable cause and what to do. All places that show the verdict
show these sentences: the page, the terminal, tables and JSON.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.causes import (
    Cause,
    correlated_pixels,
    displaced_alike,
    find_causes,
    hidden_causes,
)
from bayesfred.analysis.causes.cause import psf_remedy
from bayesfred.analysis.residuals import Residuals
from bayesfred.model.noise import SubtractedNoise
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.fit_statistics import CONSISTENT, consistent, misfit
from bayesfred.optimize.matched import enough_matched, source_light
from bayesfred.optimize.psf_equations import LARGEST_ERROR
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.laplace import ApproximationCheck

__all__ = [
    "FitVerdict",
    "judge_approximation",
    "judge_fit",
    "judge_sampling",
    "mode_shares",
]

MAX_RHAT = 1.01
MIN_ACCEPTANCE = 0.1
LEAST_MODE = 0.01  # share of the draws from which a mode is told of
HARDLY = 0.1  # share of its weight below which a source far off its position is named
MOST_NAMED = 10
WIDER = 1.1  # factor of the errors from which it is said
CHECKED = 0.04  # model error up to which refits of simulated frames confirm the errors


@dataclass(frozen=True)
class FitVerdict:
    """Whether a model fits the counts, and why not.

    Attributes
    ----------
    fits_data : bool
    causes : tuple of Cause
        The most likely first; empty where the model fits.
    sentence : str
        How well it fits, or how badly, probably why and what to do.
    omitted : str
        What the error bars leave out.
    unmatched : str
        How many sources are matched, where too few are; empty elsewhere.
    """

    fits_data: bool
    causes: tuple[Cause, ...]
    sentence: str
    omitted: str
    unmatched: str


def judge_fit(
    posterior: Any,
    estimate: MapEstimate,
    fit: Mapping[str, float],
    residuals: Residuals | None,
    *,
    rejected: bool = False,
) -> FitVerdict:
    """Judge whether a model fits the counts at its maximum.

    It does where deviance and Pearson's statistic are within 5 standard deviations of their
    expectations, enough sources are matched (see `bayesfred.optimize.matched`), neither a score
    test nor a source fails, pixels between the sources share no noise, neighbouring sources are not
    displaced alike, the maximum was not found by
    rejecting a large part of the sources, and no other pose of a frame on the sky fits as well.
    Of true models at most 1 % fail, all tests together.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
    fit : mapping of str to float
        See `fit_statistics`.
    residuals : Residuals or None
        See `judge_residuals`. None for another density with counts: only the sums are judged.
    rejected : bool
        Whether outliers were rejected already, so that this is no remedy.

    Returns
    -------
    FitVerdict
    """
    consist, failures, causes = consistent(fit), "", tuple[Cause, ...]()
    params, matched, unmatched = estimate.params, "", ""
    if residuals is not None:
        light = source_light(posterior, params)
        matched = f", {light.count}"
        if not enough_matched(posterior, light):
            consist, unmatched = False, matched.removeprefix(", ")
        failures = _failures(residuals)
        if not consist:
            causes = find_causes(posterior, params, rejected=rejected)
        elif residuals.shared is not None:
            causes = (correlated_pixels(residuals.shared),)
        causes = causes or hidden_causes(posterior, params, residuals.scores, residuals.tests)
        if consist and residuals.neighbours is not None and residuals.neighbours.alike:
            scatters = posterior.nuisances.position_scatter
            causes = (*causes, displaced_alike(residuals.neighbours, scatters=scatters))
    fits = consist and not failures
    sums = " and ".join(_sum(fit, name) for name in ("deviance", "pearson"))
    poor = _poor_psf(posterior, params)
    why = poor + _why(causes)
    if fits and not estimate.fits_data:
        fits, sentence = False, f"The parameters may be wrong: {estimate.message}."
    elif fits:
        sentence = f"The model fits the counts: {sums} expectation{matched}."
    elif consist:
        sentence = (
            f"The model does not fit the counts: {failures}, where sums over all pixels do not "
            f"show it ({sums} expectation{matched}). {why}"
        )
    else:
        bound = f"expectation (at most {CONSISTENT:.0f} if it did){matched}"
        sentence = f"The model does not fit the counts: {sums} {bound}. {why}"
    sentence += _far_off(residuals) + _in_common(posterior)
    omitted = _omitted(posterior, fit, fits)
    if not (poor and poor in sentence):
        omitted += _unexplained(posterior, params)
    return FitVerdict(fits, causes, sentence, omitted, unmatched)


def judge_sampling(
    chain: Chain,
    rhat: Floats,
    ess: Floats,
    acceptance: float,
    target_ess: float,
    unmatched: str,
) -> tuple[bool, str]:
    """Judge how a chain is sampled.

    Where too few sources are matched the search may have missed the sources altogether, and no
    agreement of the draws can tell.

    Parameters
    ----------
    chain : Chain
    rhat, ess : ndarray, shape (d,)
        Of every parameter; the smaller of its two effective sample sizes.
    acceptance : float
    target_ess : float
    unmatched : str
        See `FitVerdict`.

    Returns
    -------
    well : bool
    sentence : str
        All criteria, or the failed ones.
    """
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
    failures += _not_at_maximum(chain)
    if unmatched:
        failures.append(f"{unmatched}, so that other modes may have been missed")
    failures += _incomplete(chain)
    if failures:
        return False, f"Not sampled well: {'; '.join(failures)}.{_several(chain)}"
    return True, (
        f"Sampled well: R-hat at most {rhat.max():.4f}, effective sample size at least "
        f"{ess.min():.0f}, acceptance {acceptance:.1%}.{_several(chain)}"
    )


def judge_approximation(chain: Chain, approximation: ApproximationCheck) -> str:
    """Say whether the draws of a Laplace approximation represent the posterior.

    Parameters
    ----------
    chain : Chain
    approximation : ApproximationCheck

    Returns
    -------
    str
    """
    failures = _not_at_maximum(chain) + _incomplete(chain)
    if not approximation.holds:
        failures.append(f"the posterior is not normal ({approximation}): sample it")
    if failures:
        wrong = "; ".join(failures)
        return (
            f"Not sampled, and errors of the Laplace approximation do not hold: {wrong}."
            f"{_several(chain)}"
        )
    return (
        f"Not sampled: errors are those of the information at the maximum ({approximation})."
        f"{_several(chain)}"
    )


def mode_shares(chain: Chain) -> tuple[float, ...]:
    """The shares of the draws that lie in the posterior's modes, largest first.

    Modes with less than a hundredth of the draws are left out; so are draws between modes. Of a
    single mode the share is 1.
    """
    modes = chain.estimate.mixture
    if modes.count == 1:
        return (1.0,)
    draws = chain.draws()
    shares = np.bincount(modes.assign(draws), minlength=modes.count)[: modes.count] / len(draws)
    return tuple(sorted((float(share) for share in shares if share >= LEAST_MODE), reverse=True))


def _several(chain: Chain) -> str:
    """What is said of several modes."""
    shares = mode_shares(chain)
    if len(shares) < 2:
        return ""
    largest = " and ".join(f"{share:.0%}" for share in shares[:2])
    return (
        f" The posterior has {len(shares)} modes, the largest with {largest} of the draws: mean "
        "and standard deviation describe none of them."
    )


def _not_at_maximum(chain: Chain) -> list[str]:
    if chain.estimate.at_maximum:
        return []
    return [f"the MAP is not at the maximum ({chain.estimate.message})"]


def _incomplete(chain: Chain) -> list[str]:
    if chain.estimate.mixture.complete:
        return []
    return ["there are more modes than are searched for (narrow the prior of the offset)"]


def _sum(fit: Mapping[str, float], name: str) -> str:
    excess = misfit(fit, name)
    side = "below" if excess < 0.0 else "above"
    head = "deviance" if name == "deviance" else "Pearson's statistic"
    return f"{head} {abs(excess):.1f} standard deviations {side}"


def _failures(residuals: Residuals) -> str:
    """The score tests and the sources that fail, in words."""
    scores, tests = residuals.scores, residuals.tests
    parts = ["neighbouring pixels share noise"] if residuals.shared is not None else []
    parts += [
        f"{lead.name} is {abs(lead.z):.0f} standard deviations from zero score"
        for lead in scores.leading[:1]
    ]
    if residuals.neighbours is not None and residuals.neighbours.alike:
        parts.append("neighbouring sources are displaced alike")
    if tests.failed.any():
        parts.append(f"{tests.failed.sum()} of {tests.failed.size} sources do not fit")
    parts += [
        f"the sources' {spread.name} scatter by {spread.z:.0f} standard deviations too much"
        for spread in tests.failed_spreads
    ]
    return ", ".join(parts)


def _far_off(residuals: Residuals | None) -> str:
    """The sources so far off their positions that they hardly count, by name."""
    if residuals is None:
        return ""
    table = residuals.sources
    far = table[table["place_weight"] < HARDLY]
    if not len(far):
        return ""
    far.sort("place_weight")
    named = [f"{row['id']} by {np.hypot(row['du'], row['dv']):.2g} px" for row in far[:MOST_NAMED]]
    more = f" and {len(far) - MOST_NAMED} more" if len(far) > MOST_NAMED else ""
    return (
        f" {len(far)} of {len(table)} sources lie far off the catalogue and hardly count: "
        f"{', '.join(named)}{more}."
    )


def _in_common(posterior: Any) -> str:
    """The displacements that neighbouring sources have in common, where errors have them."""
    errors = getattr(posterior, "displacement_errors", None)
    if errors is None or errors.field is None:
        return ""
    return (
        f" Neighbouring sources are displaced alike, by {errors.sd:.2g} px over "
        f"{errors.length:.2g} px, which the errors have in them."
    )


def _why(causes: tuple[Cause, ...]) -> str:
    """The first cause with what to do, and the names of the others."""
    if not causes:
        return "No cause was found: look at the residuals."
    first, *others = causes
    more = ", ".join(f"{cause.name} ({cause.share:.0%})" for cause in others)
    also = f" Further causes: {more}." if more else ""
    return (
        f"Probable cause: {first.name} ({first.share:.0%} of the misfit): {first.sentence}. "
        f"Remedy: {first.remedy}.{also}"
    )


def _listed(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]] if len(names) > 1 else names)


def _omitted(posterior: Any, fit: Mapping[str, float], fits: bool) -> str:
    """What the error bars leave out."""
    nuisances = posterior.nuisances
    left_out = [] if nuisances.position_scatter else ["the catalogue's positions"]
    left_out += ["its fluxes"] if nuisances.flux == "fixed" else []
    if not nuisances.model_error:
        left_out.append("the PSF's shape" if nuisances.psf_sigma else "the PSF")
    if isinstance(posterior.noise.pixelwise, SubtractedNoise):
        left_out.append("the background that was subtracted")
    left_out += ["the choice of terms"]
    sentence = f"The error bars leave out errors of {_listed(left_out)}"
    factor = (max(fit["pearson"], 0.0) / max(fit["pearson_expected"], 1.0)) ** 0.5
    if fits or not WIDER < factor < np.inf:
        return f"{sentence}{'' if fits else ', and the misfit'}."
    return f"{sentence}, and the misfit: as mere noise it would make them {factor:.2g} times wider."


def _unexplained(posterior: Any, params: Floats) -> str:
    """Say of a large model error that it is one."""
    error = _model_error(posterior, params)
    if error <= CHECKED:
        return ""
    return (
        f" The PSF leaves {error:.0%} of the light unexplained, and errors were checked up to "
        f"{CHECKED:.0%}: {_other_psf(posterior)}, or test them with bayesfred crosscheck."
    )


def _poor_psf(posterior: Any, params: Floats) -> str:
    """Say of a PSF that leaves much of the light that this comes before all other causes."""
    error = _model_error(posterior, params)
    if error <= LARGEST_ERROR:
        return ""
    return (
        f"The PSF leaves {error:.0%} of the light unexplained, which hides what else is wrong: "
        f"{_other_psf(posterior)}. "
    )


def _model_error(posterior: Any, params: Floats) -> float:
    if not posterior.nuisances.model_error:
        return 0.0
    return float(params[posterior.parameter_names.index("model_error")])


def _other_psf(posterior: Any) -> str:
    return psf_remedy(posterior, 'measure it on the frame (psf.kind = "measured")')
