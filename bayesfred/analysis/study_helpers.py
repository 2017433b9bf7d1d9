"""What studies do with one simulated frame: fit it as `find_map` and `sample` do, in memory, and count intervals that hold."""

import math
from typing import Literal, get_args

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.convergence import convergence
from bayesfred.sampling.ensembles import advance, begin, check_start
from bayesfred.sampling.sampler import burn_in

Method = Literal["laplace", "mcmc"]

LEVELS = (0.68, 0.95)  # of the intervals whose coverage is counted

WALKERS = 32
FIRST_STEPS = 13
MOST_STEPS = 20_000


def check(what: str, replicates: int, method: str) -> None:
    """Refuse settings that no study can have."""
    if replicates < 2:
        raise InputError(f"{what}: replicates: got {replicates}, expected at least 2")
    if method not in get_args(Method):
        raise InputError(
            f"{what}: method: got {method!r}, expected one of {', '.join(get_args(Method))}"
        )


def seeds(seed: int, k: int) -> np.random.SeedSequence:
    """Child k of `SeedSequence(seed).spawn`."""
    return np.random.SeedSequence(seed, spawn_key=(k,))


def maximum(posterior: Posterior) -> MapEstimate:
    """The posterior's maximum, found from the counts alone."""
    estimate = find_map(posterior)
    if not estimate.at_maximum:
        raise InputError(f"maximum {estimate.message}")
    return estimate


def draws(
    posterior: Posterior,
    estimate: MapEstimate,
    method: Method,
    seed: np.random.SeedSequence,
    ess: int,
) -> Floats:
    """Nearly independent draws, shape (n, d), n about `ess` or more.

    Of a chain that is long enough for so many effective draws those are kept that lie an
    autocorrelation time apart.
    """
    if method == "laplace":
        normal = np.random.default_rng(seed).multivariate_normal(
            estimate.params, estimate.covariance, ess, method="cholesky"
        )
        return np.asarray(
            normal[np.isfinite(posterior.log_prob(normal))]
        )  # those that the prior admits
    walkers = max(WALKERS, 2 * (posterior.n_parameters + 1))
    start = begin(posterior, estimate, int(seed.generate_state(1, np.uint64)[0]), 1, walkers)
    check_start(posterior.parameter_names, start)
    steps, due = advance(posterior, estimate, start), FIRST_STEPS
    kept: list[Floats] = []
    while due <= MOST_STEPS:
        kept += [next(steps).coords[0] for _ in range(due - len(kept))]
        chain = np.stack(kept)[None]
        chain = chain[:, burn_in(chain) :]
        _, bulk, tail = convergence(chain)
        effective = float(min(bulk.min(), tail.min()))
        if effective >= ess:
            apart = round(
                chain[..., 0].size / effective
            )  # of 300 draws correlated by less, ranks spread 0.3 % more
            return np.asarray(chain[0, ::apart].reshape(-1, posterior.n_parameters))
        due = math.ceil(1.5 * due)
    raise InputError(
        f"sampling: got {effective:.0f} effective draws after {len(kept)} steps, expected {ess}"
    )


def coverage_error(level: float, n: int) -> float:
    """Standard deviation of the share of n intervals that hold the truth."""
    return math.sqrt(level * (1.0 - level) / max(n, 1))


def covered(pit: Floats, level: float) -> Flags:
    """Whether the central interval of a probability holds the truth."""
    return np.abs(pit - 0.5) <= 0.5 * level


def given(template: Posterior, counts: Floats) -> Posterior:
    """The same posterior of another frame."""
    t = template
    return Posterior(
        t.model, counts, prior=t.prior, noise=t.noise, mask=t.mask, nuisances=t.nuisances
    )
