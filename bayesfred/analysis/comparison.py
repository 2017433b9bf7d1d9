"""Which model predicts a frame best, by leave-one-out predictive accuracy of every pixel.

It is computed from the draws of each model's chain.

A model is scored by elpd, the sum over pixels of log p(n_i | the other pixels). With draws theta_s
of the whole frame's posterior, p(n_i | the others) is the harmonic mean of p(n_i | theta_s):
leaving a pixel out weights the draws by 1 / p(n_i | theta_s). A frame has so many pixels that
hardly any weights differ: where all of a pixel's lie within a factor e^`SPREAD` their plain mean is
known to a hundredth, and elsewhere their largest are replaced by those of a fitted Pareto
distribution, whose shape says whether the weights can be trusted. Differences of elpd are judged by
the scatter of the pixels' differences.

References
----------
A. Vehtari, A. Gelman, J. Gabry (2017), Statistics and Computing 27, 1413: leave-one-out by
importance sampling.
A. Vehtari et al. (2024), Journal of Machine Learning Research 25, 72: Pareto smoothing.
T. Sivula, M. Magnusson, A. Vehtari (2020), arXiv:2008.10296: what a difference smaller than 4 says.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from arviz_stats.base import array_stats

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import convergence

__all__ = ["Comparison", "Score", "compare"]


# Pixels whose log-likelihood varies by less over the draws need no smoothing.
SPREAD = 0.5

# Numbers in memory at a time, as all draws of a pixel are needed together.
BLOCK = 2**24

# Differences of elpd below this, or below twice their standard error, decide nothing.
NEGLIGIBLE = 4.0
STANDARD_ERRORS = 2.0


@dataclass(frozen=True)
class Score:
    """How well one model predicts pixels that it has not seen.

    Attributes
    ----------
    name : str
    n_parameters : int
    elpd, elpd_se : float
        Expected log predictive density of the frame, leaving out one pixel at a time, and its
        standard error.
    p_loo : float
        Effective number of parameters: how much better the model predicts pixels that it has seen.
    difference, difference_se : float
        The best model's elpd less this one's, and its standard error from the pixels' differences;
        0 for the best.
    pareto_k : float
        Largest shape of a pixel's weights; -inf where no pixel's weights spread enough to have a
        tail.
    n_unreliable : int
        Pixels whose shape exceeds min(1 - 1 / log10(draws), 0.7): their part of elpd is not to be
        trusted.
    """

    name: str
    n_parameters: int
    elpd: float
    elpd_se: float
    p_loo: float
    difference: float
    difference_se: float
    pareto_k: float
    n_unreliable: int


@dataclass(frozen=True)
class Comparison:
    """Models of one frame, ranked by predictive accuracy.

    Attributes
    ----------
    scores : tuple of Score
        The best model first.
    chosen : str
        The model with the fewest parameters among those that predict as well as the best: whose
        elpd is less than 4, or less than twice the difference's standard error, below the best
        one's.
    """

    scores: tuple[Score, ...]
    chosen: str

    @property
    def reliable(self) -> bool:
        """Whether every pixel's weights can be trusted."""
        return not any(score.n_unreliable for score in self.scores)


def compare(chains: Mapping[str, Chain], *, draws: int = 400) -> Comparison:
    """Compare models of one frame by leave-one-out predictive accuracy.

    Parameters
    ----------
    chains : mapping of str to Chain
        Converged chains of the same counts and mask, by the names to call their models.
    draws : int, optional
        Draws to use of each chain, evenly spaced.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If there are fewer than two chains, their counts or masks differ, or a model's fluxes are
        free: these are fitted to the very pixels that are to be predicted.

    References
    ----------
    A. Vehtari, A. Gelman, J. Gabry (2017), Statistics and Computing 27, 1413, Eq. 7 and 24.
    """
    if len(chains) < 2:
        raise InputError(
            f"chains: got {len(chains)}, expected at least two models of one frame to compare"
        )
    if draws < 100:
        raise InputError(f"draws: got {draws}, expected at least 100")
    posteriors = {name: chain.posterior() for name, chain in chains.items()}
    first = next(iter(posteriors))
    for name, posterior in posteriors.items():
        if posterior.nuisances.profiled:
            raise InputError(
                f"{name}: fluxes: got free ones, fitted to the very pixels that are to be "
                "predicted, expected fixed or scaled "
                "fluxes: fit it again with these"
            )
        for what in ("counts", "mask"):
            if not np.array_equal(getattr(posterior, what), getattr(posteriors[first], what)):
                raise InputError(
                    f"{name}: {what}: got others than those of {first}, expected models of the "
                    "same frame and pixels"
                )
    pointwise = {
        name: _leave_one_out(posteriors[name], chain, draws) for name, chain in chains.items()
    }
    elpd = {name: float(np.sum(values[0])) for name, values in pointwise.items()}
    ranked = sorted(chains, key=lambda name: -elpd[name])
    best = pointwise[ranked[0]][0]
    scores = []
    for name in ranked:
        each, p_loo, shape, n_unreliable = pointwise[name]
        behind = best - each
        difference = float(np.sum(behind)), _error_of_sum(behind)
        count = posteriors[name].n_parameters
        scores.append(
            Score(
                name,
                count,
                elpd[name],
                _error_of_sum(each),
                p_loo,
                *difference,
                shape,
                n_unreliable,
            )
        )
    good = [s for s in scores if s.difference <= max(NEGLIGIBLE, STANDARD_ERRORS * s.difference_se)]
    return Comparison(tuple(scores), min(good, key=lambda s: s.n_parameters).name)


def _error_of_sum(values: Floats) -> float:
    return float(np.sqrt(values.size * np.var(values)))


def _leave_one_out(
    posterior: Posterior, chain: Chain, n_draws: int
) -> tuple[Floats, float, float, int]:
    """Score a model pixel by pixel.

    Returns elpd of every pixel, the effective number of parameters, the largest Pareto shape, and
    the number of pixels whose shape is too large.
    """
    every = chain.draws()
    draws = every[np.linspace(0, len(every) - 1, min(n_draws, len(every))).round().astype(int)]
    effective = convergence(chain.chain[:, chain.burn_in :])[1].min()
    r_eff = float(min(1.0, effective / len(draws)))
    reference = next(_log_likelihoods(posterior, draws.mean(axis=0, keepdims=True)))
    low, high = np.full(reference.shape, np.inf), np.full(reference.shape, -np.inf)
    mean, inverse_mean = np.zeros(reference.shape), np.zeros(reference.shape)
    with np.errstate(over="ignore", divide="ignore"):  # of pixels that are done again below
        for value in _log_likelihoods(posterior, draws):
            value -= reference
            np.minimum(low, value, out=low)
            np.maximum(high, value, out=high)
            density = np.exp(value)
            mean += density
            inverse_mean += 1.0 / density
        elpd = reference - np.log(inverse_mean / len(draws))
        seen = reference + np.log(mean / len(draws))
    wide = np.flatnonzero(high - low > SPREAD)
    shape = np.full(reference.shape, -np.inf)
    for part in np.array_split(wide, math.ceil(wide.size * len(draws) / BLOCK) or 1):
        values = np.stack([value[part] for value in _log_likelihoods(posterior, draws)], axis=-1)
        if part.size:
            with np.errstate(
                all="ignore"
            ):  # a tail of draws that are all alike has no shape: NaN, which is not reliable
                elpd[part], shape[part], p = array_stats.loo(
                    values, chain_axis=None, draw_axis=-1, r_eff=r_eff
                )
            seen[part] = elpd[part] + p
    limit = min(1.0 - 1.0 / math.log10(len(draws)), 0.7)
    return elpd, float(np.sum(seen - elpd)), float(shape.max()), int(np.sum(~(shape <= limit)))


def _log_likelihoods(posterior: Posterior, draws: Floats) -> Iterator[Floats]:
    """Log-likelihood of every pixel in use, draw by draw."""
    used = posterior.mask
    counts = posterior.counts[used]
    noise, constant = posterior.noise.at(used), posterior.parameter_names.index("background")
    for draw in draws:
        yield noise.log_likelihood(counts, posterior.expected_counts(draw)[used], draw[constant])
