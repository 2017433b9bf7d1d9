"""What studies do with a simulated frame: fit it as users do, and count intervals that hold."""

import math
from typing import Literal, get_args

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model.noise import Noise
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.convergence import effective_sizes
from bayesfred.sampling.sampler import sample

Method = Literal["laplace", "mcmc"]

LEVELS = (0.68, 0.95)  # of the intervals whose coverage is counted

ENSEMBLES = 2
WALKERS = 16  # of each, at least


def check(what: str, replicates: int, method: str, noise: Noise) -> None:
    """Refuse settings that no study can have."""
    if noise.pixelwise is not noise:
        raise InputError(
            f"{what}: noise: got {type(noise).__name__}, expected that of independent pixels, such "
            "as simulated frames have"
        )
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

    Of a chain with this many effective draws, draws an autocorrelation time apart are kept.
    It is `sample` that makes the chain, with the stopping rule that every user gets, so that a
    calibration judges that rule, too. Two ensembles are the fewest that R-hat can compare.
    """
    if method == "laplace":
        normal = np.random.default_rng(seed).multivariate_normal(
            estimate.params, estimate.covariance, ess, method="cholesky"
        )
        return np.asarray(
            normal[np.isfinite(posterior.log_prob(normal))]
        )  # draws that the prior admits
    chain = sample(
        posterior,
        estimate,
        seed=int(seed.generate_state(1, np.uint64)[0]),
        ensembles=ENSEMBLES,
        walkers=max(WALKERS, 2 * (posterior.n_parameters // 2 + 1)),  # they span all directions
        target_ess=ess,
        progress=False,
    )
    kept = chain.chain[:, chain.burn_in :]
    effective = float(np.min(effective_sizes(kept)))
    if effective < ess:
        raise InputError(
            f"sampling: got {effective:.0f} effective draws after {chain.chain.shape[1]} steps, "
            f"expected {ess}"
        )
    # of 300 draws whose correlation is less, ranks spread 0.3 % more
    apart = round(kept[..., 0].size / effective)
    every = chain.draws().reshape(kept.shape)
    return np.asarray(every[:, ::apart].reshape(-1, posterior.n_parameters))


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
