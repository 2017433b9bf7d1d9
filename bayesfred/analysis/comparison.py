"""Which model of frames predicts sources best that it has not seen, and which is more probable.

Pixels of one star share its errors: its position, its flux, the PSF there. A model that fits these
with needless terms predicts every single pixel better from the others of the same star, and the
next star no better. So whole sources are left out. They are dealt to folds that each cover the
field (`folds`); of up to 20 sources each is a fold of its own. The pixels F of a fold are predicted
from the others, R:

    log p(F | R) = log Z(F, R) - log Z(R),

Z the evidence, the integral of likelihood times prior. Z(F, R) is that of the chain, by bridge
sampling, and Z(R) that of a fit without the fold, by importance sampling from its own proposal
(`evidence`). Free fluxes and shifts of the sources are integrated out of the likelihoods, those of
the sources in F too. What a prior is multiplied with cancels. A source that several frames show is
left out of all of them (`joint_folds`). A PSF that was measured on the frame is measured again
without the sources that are left out (`left_out`); then there is no evidence, and there is the
share of the sources' variety that a model explains.

A model is scored by elpd, the sum over folds, and differences are judged by the scatter of the
folds' differences. The weights of stacking are those of the mixture of all models that predicts the
folds best. The evidence says something else: how probable the whole frame is under a model and its
priors. It takes the noise at its word, as leaving out sources does not.

References
----------
A. Vehtari, A. Gelman, J. Gabry (2017), Statistics and Computing 27, 1413: elpd, K folds, errors.
D. R. Roberts et al. (2017), Ecography 40, 913: leaving out what shares its errors.
Y. Yao, A. Vehtari, D. Simpson, A. Gelman (2018), Bayesian Analysis 13, 917: stacking.
T. Sivula, M. Magnusson, A. Vehtari (2020), arXiv:2008.10296: what a difference smaller than 4 says.
"""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from bayesfred._typing import Floats
from bayesfred.analysis.comparable import comparable_posteriors, require_sampled
from bayesfred.analysis.evidence import (
    Evidence,
    draws_needed,
    evidence_with_ratios,
    importance_evidence,
    random_numbers,
)
from bayesfred.analysis.extra_parameters import ExtraParameters, contained, judge_extra
from bayesfred.analysis.folds import FEWEST
from bayesfred.analysis.joint_folds import (
    AnyPosterior,
    FrameFolds,
    fold_frames,
    frame_views,
    require_visible,
)
from bayesfred.analysis.left_out import LeftOut, Weights, leave_out, measured_here
from bayesfred.analysis.ranking import Comparison, Score, error_of_sum
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.newton import NEAR, maximize
from bayesfred.sampling.chain import Chain

__all__ = ["Comparison", "Score", "compare"]

FOLDS = 20
DRAWS = 200  # of the proposal without a fold, at most
ENOUGH = 0.05  # error of a fold's log-density: those of 20 add up to a twentieth of NEGLIGIBLE
SHAPE = 1.0 - 1.0 / math.log10(DRAWS)  # of the weights, above which they are not to be trusted

# Differences of elpd below this, or below twice their standard error, decide nothing.
NEGLIGIBLE = 4.0
STANDARD_ERRORS = 2.0

STEPS = 5  # towards the maximum without a fold, near which draws know the rest
OPTIMAL = 1e-6  # of the mean predictive density, relative


class _Fitted(NamedTuple):
    """A model fitted to the frame, and to the frame without each fold."""

    chain: Chain
    posterior: AnyPosterior
    evidence: Evidence
    by_fold: Floats  # (K,) log predictive density of each fold
    error: float  # of their sum, from the draws
    shapes: Floats  # (K,) of the weights
    influence: Floats  # (K, d) of each fold on the estimates
    change: Floats  # (K, d) of the estimates when it is left out


def compare(chains: Mapping[str, Chain]) -> Comparison:
    """Compare models of the same counts by how well they predict sources that are left out.

    Parameters
    ----------
    chains : mapping of str to Chain
        Chains of one frame, or all of the same frames, with the same counts and masks, sampled
        well, by the names to call their models.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If there are fewer than two chains, one is not of frames, not sampled well or has several
        modes, their frames, counts or masks differ, or some give probabilities of integer counts
        and others densities; if fewer than three sources have their image in a frame.

    Notes
    -----
    It takes some 20 fits and 500 to 5,000 log-posteriors of each model.

    References
    ----------
    A. Vehtari, A. Gelman, J. Gabry (2017), Statistics and Computing 27, 1413, Eq. 24.

    Examples
    --------
    >>> import bayesfred as bf
    >>> chains = {}
    >>> for name, terms in {"right": [(1, 0, 1, 0)], "wrong": [(1, 0, 0, 1)]}.items():
    ...     model = bf.ForwardModel(
    ...         bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...         bf.PolynomialDistortion(terms, []))
    ...     counts = counts if chains else bf.simulate(model, [1e-3], 2.0, seed=1)
    ...     chains[name] = bf.laplace(bf.Posterior(model, counts), seed=1, progress=False)
    >>> bf.compare(chains).chosen
    'right'
    """
    if len(chains) < 2:
        raise InputError(
            f"chains: got {len(chains)}, expected at least two models of one frame to compare"
        )
    posteriors = comparable_posteriors(chains)
    if any(map(measured_here, posteriors.values())):
        with one_blas_thread():
            return _with_psfs_measured_again(chains, posteriors)
    for name, chain in chains.items():
        require_sampled(name, chain)
    with one_blas_thread():
        evidence = {name: evidence_with_ratios(chain) for name, chain in chains.items()}
        likely = max(chains, key=lambda name: evidence[name][0].log_evidence)
        folds = fold_frames(posteriors[likely], chains[likely].estimate.params, FOLDS)
        require_visible(folds, FEWEST, "to predict some from the others")
        fitted = {
            name: _left_out(chain, posteriors[name], evidence[name], folds)
            for name, chain in chains.items()
        }
    return _ranked(fitted, folds)


def _with_psfs_measured_again(
    chains: Mapping[str, Chain], posteriors: Mapping[str, AnyPosterior]
) -> Comparison:
    """Compare models of one frame of which some have a PSF that was measured on it."""
    single = {name: own for name, own in posteriors.items() if isinstance(own, Posterior)}
    likely = max(single, key=lambda name: chains[name].estimate.log_prob)
    folds = fold_frames(single[likely], chains[likely].estimate.params, FOLDS)
    require_visible(folds, FEWEST, "to predict some from the others")
    leanest = min(single, key=lambda name: _count_free(single[name]))
    weights = Weights.of(single[leanest], chains[leanest].estimate.params)
    found, fitted = dict[str, LeftOut](), dict[str, _Fitted]()
    for name, own in single.items():
        estimate, random = chains[name].estimate, random_numbers(chains[name])
        left = found[name] = leave_out(own, estimate, folds.frames[""], weights, random)
        none = np.zeros((left.log_density.size, 0))
        shapes = np.full(left.log_density.size, -np.inf)
        evidence = Evidence(math.nan, math.nan)
        fitted[name] = _Fitted(
            chains[name], own, evidence, left.log_density, left.error, shapes, none, none
        )
    ranked = _ranked(fitted, folds)
    most = max((left.misfit for left in found.values()), key=np.sum)
    share = {name: _explained(most, left.misfit) for name, left in found.items()}
    scores = [replace(s, explained=share[s.name][0], explained_se=share[s.name][1])
              for s in ranked.scores]  # fmt: skip
    return replace(ranked, scores=tuple(scores))


def _explained(before: Floats, after: Floats) -> tuple[float, float]:
    """The share of a misfit that is gone, and its error; nan where there was none to be seen."""
    if before.sum() < STANDARD_ERRORS * error_of_sum(before):
        return math.nan, math.nan
    share = 1.0 - float(after.sum() / before.sum())
    return share, error_of_sum(after - (1.0 - share) * before) / float(before.sum())


def _ranked(fitted: Mapping[str, _Fitted], folds: FrameFolds) -> Comparison:
    weights = _stacking(np.array([fit.by_fold for fit in fitted.values()]).T)
    scores = _scores(fitted, dict(zip(fitted, weights, strict=True)))
    factor = stats.t.isf(stats.norm.sf(STANDARD_ERRORS), len(scores[0].by_fold) - 1)
    good = [s for s in scores if s.difference <= max(NEGLIGIBLE, factor * s.difference_se)]
    return Comparison(
        scores,
        min(good, key=lambda s: s.n_parameters).name,
        folds.members,
        _extra(fitted),
    )


def _left_out(
    chain: Chain, posterior: AnyPosterior, known: tuple[Evidence, Floats], folds: FrameFolds
) -> _Fitted:
    """Leave out fold after fold; `known` is what `evidence_with_ratios` found."""
    random, start = random_numbers(chain), chain.estimate.params
    found, shapes, gradients, params = [], [], [], []
    evidence, number = known[0], draws_needed(known[1], ENOUGH, DRAWS)
    for k in range(int(folds.sources.max()) + 1):
        rest = folds.without(posterior, k)
        top = maximize(rest, start, steps=STEPS)
        if top.distance > NEAR:
            top = maximize(rest, top.params)
        at = MapEstimate(top.params, top.covariance, top.log_prob, top.evaluations, "")
        without, shape = importance_evidence(rest, at, number, random)
        found.append(without)
        shapes.append(shape)
        gradients.append(-rest.gradient(start))  # of the fold, as that of all vanishes
        params.append(top.params)
    log_z, errors = np.array(found).T
    by_fold = evidence.log_evidence - log_z
    error = math.hypot(by_fold.size * evidence.error, *errors)
    return _Fitted(
        chain, posterior, evidence, by_fold, error, np.array(shapes),
        np.array(gradients) @ chain.estimate.covariance, start - np.array(params),
    )  # fmt: skip


def _scores(fitted: Mapping[str, _Fitted], weights: Mapping[str, float]) -> tuple[Score, ...]:
    """The models' scores, the best first."""
    ranked = sorted(fitted, key=lambda name: -fitted[name].by_fold.sum())
    best = fitted[ranked[0]]
    scores = []
    for name in ranked:
        fit = fitted[name]
        behind = best.by_fold - fit.by_fold
        error = 0.0 if fit is best else math.hypot(error_of_sum(behind), best.error, fit.error)
        scores.append(
            Score(
                name,
                _count_free(fit.posterior),
                float(fit.by_fold.sum()),
                math.hypot(error_of_sum(fit.by_fold), fit.error),
                float(behind.sum()),
                error,
                float(weights[name]),
                *fit.evidence,
                float(fit.shapes.max()),
                int(np.sum(~(fit.shapes <= SHAPE))),
                fit.by_fold,
            )
        )
    return tuple(scores)


def _count_free(posterior: AnyPosterior) -> int:
    """Parameters, every source's flux and shifts where these are free, and a measured PSF's."""
    frames = [view.posterior for view in frame_views(posterior)]
    profiled = sum(frame.nuisances.profiled * len(frame.model.sources) for frame in frames)
    measured = sum(f.psf_errors.absorbed for f in frames if f.psf_errors is not None)
    return posterior.n_parameters + profiled + round(measured)


def _stacking(log_density: Floats) -> Floats:
    """Weights of the mixture of models with the largest log predictive density.

    Expectation maximisation of the sum over folds of log sum_m w_m p_m. With the gradient's
    largest element G per fold, the maximum is at most log G higher per fold.

    Parameters
    ----------
    log_density : ndarray, shape (K, models)
    """
    density = np.exp(log_density - log_density.max(axis=1, keepdims=True))
    weights = np.full(density.shape[1], 1.0 / density.shape[1])
    for _ in range(100_000):
        gradient = np.mean(density / (density @ weights)[:, None], axis=0)
        if gradient.max() < 1.0 + OPTIMAL:
            break
        weights *= gradient
    return np.asarray(weights / weights.sum())


def _extra(fitted: Mapping[str, _Fitted]) -> dict[tuple[str, str], ExtraParameters]:
    """Judge the parameters of every model that contains another one."""
    found = {}
    for leaner, one in fitted.items():
        for larger, other in fitted.items():
            values = contained(one.posterior, one.chain.estimate.params, other.posterior)
            if values is None or not one.change.size:
                continue
            names = other.posterior.parameter_names
            added = [k for k, name in enumerate(names) if name not in one.posterior.parameter_names]
            estimate = other.chain.estimate
            found[leaner, larger] = judge_extra(
                tuple(names[k] for k in added),
                (estimate.params - values)[added],
                estimate.covariance[np.ix_(added, added)],
                other.influence[:, added],
                other.change[:, added],
            )
    return found
