"""Which chains can be compared: those of models of the same counts, each sampled well."""

from collections.abc import Mapping

import numpy as np

from bayesfred.analysis.joint_folds import AnyPosterior, FrameView, frame_views
from bayesfred.analysis.verdict import judge_approximation, judge_sampling
from bayesfred.errors import InputError
from bayesfred.model.joint import JointPosterior
from bayesfred.model.noise import correlation_ratio
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import convergence
from bayesfred.sampling.displacement import frame_posterior
from bayesfred.sampling.laplace import check_approximation

__all__ = ["comparable_posteriors", "require_sampled"]


def comparable_posteriors(chains: Mapping[str, Chain]) -> dict[str, AnyPosterior]:
    """The posteriors of chains whose models can be compared.

    Parameters
    ----------
    chains : mapping of str to Chain

    Returns
    -------
    dict of str to Posterior or JointPosterior

    Raises
    ------
    InputError
        If one is not of a frame or several, their frames, counts or masks differ, or some give
        probabilities of integer counts and others densities.
    """
    posteriors = {name: _posterior(name, chain) for name, chain in chains.items()}
    first, *others = posteriors
    wanted = {view.name: view for view in frame_views(posteriors[first])}
    for name in others:
        found = {view.name: view for view in frame_views(posteriors[name])}
        if set(found) != set(wanted):
            raise InputError(
                f"{name}: frames: got {_listed(found)} where {first} has {_listed(wanted)}, "
                "expected models of the same frames"
            )
        for own in wanted:
            _require_same(first, wanted[own], name, found[own])
    return posteriors


def require_sampled(name: str, chain: Chain) -> None:
    """Refuse a chain whose draws do not represent a posterior of one mode.

    Parameters
    ----------
    name : str
        What to call it.
    chain : Chain

    Raises
    ------
    InputError
    """
    if chain.estimate.modes is not None:  # each would need a refit without every fold
        raise InputError(
            f"{name}: got a posterior of several modes, expected one: narrow the priors"
        )
    if chain.method == "mcmc":
        rhat, *ess = convergence(chain.chain[:, chain.burn_in :])
        acceptance = float(np.mean(chain.accepted)) / max(chain.chain.shape[1], 1)
        well, said = judge_sampling(chain, rhat, np.minimum(*ess), acceptance, chain.target_ess, "")
    else:
        approximation = check_approximation(chain)
        well = approximation.holds and chain.estimate.at_maximum
        said = judge_approximation(chain, approximation)
    if not well:
        raise InputError(
            f"{name}: got draws that do not represent the posterior, expected a well sampled "
            f"chain: {said}"
        )


def _posterior(name: str, chain: Chain) -> AnyPosterior:
    if isinstance(chain.density, JointPosterior):
        return chain.density
    try:
        return frame_posterior(chain)
    except InputError as error:
        raise InputError(f"{name}: {error}") from None


def _listed(frames: Mapping[str, FrameView]) -> str:
    return "one frame" if "" in frames else f"frames {', '.join(frames)}"


def _require_same(first: str, one: FrameView, name: str, other: FrameView) -> None:
    """Refuse other pixels of a frame, or noise of another kind."""
    frame = f"frame {other.name}: " if other.name else ""
    for what in ("counts", "mask"):
        if not np.array_equal(getattr(one.posterior, what), getattr(other.posterior, what)):
            raise InputError(
                f"{name}: {frame}{what}: got others than those of {first}, expected models of the "
                "same frame and pixels"
            )
    known, ratio = (correlation_ratio(view.posterior.noise) for view in (one, other))
    if known != ratio:
        raise InputError(
            f"{name}: {frame}noise: got a correlation ratio of {ratio:g}, and {known:g} for "
            f"{first}, expected one: likelihoods of the same noise are compared"
        )
    if one.posterior.noise.discrete != other.posterior.noise.discrete:
        discrete, density = (first, name) if one.posterior.noise.discrete else (name, first)
        raise InputError(
            f"{density}: {frame}noise: got a density, and probabilities of integer counts for "
            f"{discrete}, expected noise models of one kind: fit both with read noise, or "
            "both without"
        )
