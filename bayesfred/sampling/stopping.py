"""When a run has enough draws, and which of them to leave out."""

import math
from collections.abc import Iterator

import numpy as np

from bayesfred._typing import Floats
from bayesfred.io.memory import allowed_memory
from bayesfred.sampling.convergence import bulk_sizes, effective_sizes, rhats
from bayesfred.sampling.ensembles import adapted

__all__ = [
    "burn_in",
    "bytes_a_step",
    "checks",
    "forgetting",
    "most_burn_in",
    "most_steps",
    "sufficient",
]

RHAT = 1.01
MOST_STEPS = 100_000
COPIES = 10.0  # of all draws in memory when a run is judged, measured
FIRST_CHECK = 8  # steps; fewer say nothing about autocorrelation
GROWTH = 1.1  # of the number of steps between checks


def bytes_a_step(walkers: int, n_parameters: int) -> float:
    """Memory that a step of this many walkers, of all ensembles, takes in the end."""
    return 8.0 * COPIES * walkers * (n_parameters + 1)


def most_steps(walkers: int, n_parameters: int) -> int:
    """Steps at which a run ends in any case: 100,000, or fewer where memory holds no more."""
    affordable = allowed_memory() / bytes_a_step(walkers, n_parameters)
    return max(FIRST_CHECK, int(min(MOST_STEPS, affordable)))


def checks() -> Iterator[int]:
    """Numbers of steps after which a run is checked."""
    steps = FIRST_CHECK
    while True:
        yield steps
        steps = max(steps + 1, int(steps * GROWTH))


def sufficient(chain: Floats, target_ess: float) -> tuple[bool, float]:
    """Whether the draws suffice, and the share of the effective draws wanted that there are.

    They suffice where every parameter's bulk and tail effective sample sizes reach the target and
    its R-hat is at most 1.01. The share is 0 while it cannot be known.

    Parameters
    ----------
    chain : ndarray, shape (n_ensembles, n_steps, n_walkers, d)
        All draws so far.
    target_ess : float
    """
    kept = chain[:, burn_in(chain) :]
    draws = kept[..., 0].size
    if draws < target_ess:  # there are no more effective draws than draws
        return False, 0.0
    share = float(np.min(effective_sizes(kept)) / target_ess)
    return bool(share >= 1.0 and rhats(kept).max() <= RHAT), share


def burn_in(chain: Floats) -> int:
    """Number of steps to leave out.

    They are those before the proposals were adapted for the last time, and of the others those in
    which the start is forgotten, see `forgetting`.

    Parameters
    ----------
    chain : ndarray, shape (n_ensembles, n_steps, n_walkers, d)
    """
    made: int = min(adapted(chain), chain.shape[1] - 1)
    n_steps: int = chain.shape[1] - made
    kept = chain[:, made + n_steps // 4 :]
    return made + forgetting(n_steps, float(np.min(bulk_sizes(kept))), kept[..., 0].size)


def most_burn_in(chain: Floats) -> int:
    """Number of steps to leave out of a run that has not ended; see `burn_in`."""
    n_steps: int = chain.shape[1]
    return max(n_steps // 2, min(adapted(chain), n_steps - 1))


def forgetting(n_steps: int, effective: float, draws: int) -> int:
    """Number of steps in which walkers forget where they started, at most half of all.

    Walkers start from the Laplace approximation, so what must be forgotten is its difference from
    the posterior. Were the slowest parameter's correlation r^k after k steps, its autocorrelation
    time would be tau = (1 + r)/(1 - r). The first step that is kept is the one after which at most
    a twentieth of the difference is left, r^k <= 1/20.

    Parameters
    ----------
    n_steps : int
        Steps of the run.
    effective, draws : float
        Effective sample size of the slowest parameter, and the number of draws that have it.

    Examples
    --------
    >>> forgetting(80, 500.0, 1500), forgetting(80, 0.0, 1500)
    (4, 40)
    """
    half = n_steps // 2
    if not effective * half > draws:  # tau is longer, and may be too long for a float
        return half
    tau = max(draws / effective, 1.1)
    return min(half, math.ceil(math.log(20.0) / math.log((tau + 1.0) / (tau - 1.0))) - 1)
