"""The verdict on several frames: whether the model fits the counts of each, and they agree."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from bayesfred.analysis.frame_agreement import FrameAgreement
from bayesfred.analysis.sensitivity import Sensitivities
from bayesfred.analysis.verdict import FitVerdict
from bayesfred.model.joint import JointPosterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.fit_statistics import misfit

if TYPE_CHECKING:
    from bayesfred.analysis.diagnostics import Diagnostics

__all__ = ["frame_sensitivities", "judge_frames", "total_fit"]

SUMS = ("pearson", "pearson_expected", "deviance", "deviance_expected")
MOST_NAMED = 5


def total_fit(frames: Mapping[str, "Diagnostics"], joint: JointPosterior) -> dict[str, Any]:
    """The numbers that judge a fit, see `fit_statistics`, of all frames together.

    Parameters
    ----------
    frames : mapping of str to Diagnostics
    joint : JointPosterior

    Returns
    -------
    dict of str to number
    """
    found = list(frames.values())
    again = sum(len(part.columns) - len(part.own) for part in joint.parts) - joint.n_shared
    total: dict[str, Any] = {name: sum(getattr(each, name) for each in found) for name in SUMS}
    for name in ("pearson_sd", "deviance_sd"):
        total[name] = math.sqrt(sum(getattr(each, name) ** 2 for each in found))
    total["n_pixels"] = sum(each.n_pixels for each in found)
    total["n_fitted"] = sum(each.n_fitted for each in found) - again
    return total | {"background_estimate": math.nan, "chi2_paper": math.nan}


def frame_sensitivities(
    frames: Mapping[str, "Diagnostics"], joint: JointPosterior
) -> Sensitivities:
    """Sensitivities to prior and likelihood; of a shared parameter, the first frame's.

    Parameters
    ----------
    frames : mapping of str to Diagnostics
    joint : JointPosterior

    Returns
    -------
    Sensitivities
    """
    prior, likelihood = np.full((2, joint.n_parameters), np.nan)
    dominated = np.zeros(joint.n_parameters, dtype=bool)
    for part, found in reversed(list(zip(joint.parts, frames.values(), strict=True))):
        prior[part.columns] = list(found.prior_sensitivity.values())
        likelihood[part.columns] = list(found.likelihood_sensitivity.values())
        dominated[part.columns] = [name in found.prior_dominated for name in found.rhat]
    return Sensitivities(prior, likelihood, dominated)


def judge_frames(
    frames: Mapping[str, "Diagnostics"],
    agreement: FrameAgreement,
    fit: Mapping[str, float],
    estimate: MapEstimate,
) -> FitVerdict:
    """Judge whether a model fits the counts of several frames.

    It does where it fits those of every frame, and the frames agree about what they share.

    Parameters
    ----------
    frames : mapping of str to Diagnostics
    agreement : FrameAgreement
    fit : mapping of str to float
        See `total_fit`.
    estimate : MapEstimate

    Returns
    -------
    FitVerdict
        Its causes are those of the frame that fits worst.
    """
    wrong = {name: each for name, each in frames.items() if not each.fits_data}
    sizes = {name: abs(misfit(vars(each), "deviance")) for name, each in frames.items()}
    worst = max(wrong or frames, key=lambda name: sizes[name])
    fits = not wrong and agreement.agree
    count = len(frames)
    if wrong:
        named = ", ".join(list(wrong)[:MOST_NAMED])
        more = f" and {len(wrong) - MOST_NAMED} more" if len(wrong) > MOST_NAMED else ""
        sentence = (
            f"The model does not fit the counts of {len(wrong)} of {count} frames ({named}{more}); "
            f"{worst}: {frames[worst].sentences[0]}"
        )
    else:
        excess = misfit(fit, "deviance")
        side = "below" if excess < 0.0 else "above"
        sentence = (
            f"The model fits the counts of all {count} frames: deviance {abs(excess):.1f} standard "
            f"deviations {side} expectation, {sizes[worst]:.1f} in the worst ({worst})."
        )
    if not estimate.fits_data and not wrong:
        fits, sentence = False, f"The parameters may be wrong: {estimate.message}."
    sentence = f"{sentence} {agreement.message}" if agreement.agree else (
        f"{agreement.message} {sentence}"
    )  # fmt: skip
    unmatched = [name for name, each in wrong.items() if "too few sources" in each.sentences[0]]
    return FitVerdict(
        fits, frames[worst].causes, sentence, frames[worst].sentences[2], ", ".join(unmatched)
    )
