"""Whether a chain file is what it says it is: its numbers are computed again and compared.

On the machine and with the packages that made a run, everything agrees bit for bit. Others round
differently in the last digits, so a check allows for that much, and reports the difference.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import (
    changed_parts,
    fingerprint,
    open_whole,
)
from bayesfred.sampling.laplace import laplace
from bayesfred.sampling.moves import LaplaceMove
from bayesfred.sampling.sampler import sample
from bayesfred.sampling.stopping import burn_in, most_burn_in

DRAWS = 1000  # whose log-probability is computed again, unless those of all draws are
STEPS = 10  # replayed from the seed
ROUNDING = 1e-6  # of a log-probability, and of a draw in standard deviations
NEAR = 0.01  # standard deviations between the stored maximum and the one found from it


class Check(NamedTuple):
    """One thing that was checked."""

    what: str
    finding: str
    holds: bool


@dataclass(frozen=True)
class Verification:
    """What could be computed again of a chain file.

    Attributes
    ----------
    checks : tuple of Check
    other_versions : tuple of str
        Packages that were of another version when the chain was made.
    """

    checks: tuple[Check, ...]
    other_versions: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether everything holds."""
        return all(check.holds for check in self.checks)


def verify(path: Path, *, every_draw: bool = False) -> list[Check]:
    """Compute again what a chain file holds.

    Parameters
    ----------
    path : Path
    every_draw : bool
        Compute the log-probability of every draw, not of 1,000 evenly spaced ones, and replay every
        step, not the first 10.

    Returns
    -------
    list of Check

    Raises
    ------
    InputError
        If the file is refused before anything can be computed; see `sampling.chainfile.open_chain`.
    """
    chain, stored, digest = open_whole(path)
    posterior = chain.posterior()
    if chain.method == "laplace":
        computed = [*_maximum(chain, posterior), _laplace_draws(chain)]
    else:
        near = posterior.near(chain.estimate.params, chain.estimate.covariance)  # as in the run
        computed = [_log_prob(chain, near, every_draw), *_maximum(chain, posterior)]
        computed += [*_steps(chain, every_draw), _burn_in(chain)]
    return [
        Check("file", f"SHA-256 {digest}", True),  # it has been opened
        _posterior(stored, posterior),
        *computed,
        Check("not checked", "what nothing follows from: target ESS, versions, record", True),
    ]


def _posterior(stored: dict[str, str], posterior: Posterior) -> Check:
    rebuilt = fingerprint(posterior)
    changed = changed_parts(stored, rebuilt)
    if changed:
        return Check("posterior", f"differs when rebuilt: {', '.join(changed)}", False)
    parts = ", ".join(f"{name} {digest[:8]}" for name, digest in rebuilt.items())
    return Check("posterior", f"rebuilt with the same hashes: {parts}", True)


def _log_prob(chain: Chain, posterior: Posterior, every_draw: bool) -> Check:
    draws, stored = chain.chain.reshape(-1, posterior.n_parameters), chain.log_prob.ravel()
    n = stored.size if every_draw else min(DRAWS, stored.size)
    chosen = np.linspace(0, stored.size - 1, n).astype(int)
    again = np.concatenate(
        [posterior.log_prob(draws[part]) for part in np.array_split(chosen, -(-n // DRAWS))]
    )
    off, share = _farthest(again, stored[chosen])
    return Check(
        "log-probability", f"{n} of {stored.size} draws: differ by at most {off:.2g}", share <= 1.0
    )


def _farthest(a: Floats, b: Floats) -> tuple[float, float]:
    """The largest difference of two sets of log-probabilities, and in units of what is allowed."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return np.inf, np.inf
    off = np.abs(a - b)
    return float(off.max()), float((off / (ROUNDING + 1e-12 * np.abs(a))).max())


def _maximum(chain: Chain, posterior: Posterior) -> list[Check]:
    stored = chain.estimate
    off, share = _farthest(
        np.array([posterior.log_prob(stored.params)]), np.array([stored.log_prob])
    )
    value = Check("MAP's log-probability", f"differs by {off:.2g}", share <= 1.0)
    if not stored.at_maximum:
        return [value, Check("MAP", "was stored as not at the maximum", True)]
    try:
        again = find_map(posterior, stored.params)
        lower = LaplaceMove(again.params, again.covariance).lowers[0]
    except InputError as error:
        return [value, Check("MAP", str(error), False)]
    distance = float(
        np.linalg.norm(solve_triangular(lower, stored.params - again.params, lower=True))
    )
    sd = np.sqrt(np.diag(again.covariance))
    excess = float(np.abs((stored.covariance - again.covariance) / np.outer(sd, sd)).max())
    return [
        value,
        Check("MAP", f"found again, {distance:.1g} standard deviations away", distance <= NEAR),
        Check("covariance", f"found again, correlations within {excess:.1g}", excess <= NEAR),
    ]


def _burn_in(chain: Chain) -> Check:
    expected = {burn_in(chain.chain), most_burn_in(chain.chain)}  # of a run that ended, or not
    says = " or ".join(str(steps) for steps in sorted(expected))
    return Check("burn-in", f"{chain.burn_in} steps, {says} follow", chain.burn_in in expected)


def _steps(chain: Chain, every_step: bool) -> list[Check]:
    """The first steps or all replayed, the numbers of accepted moves, and the random state.

    A chain does not show which moves of the first step were accepted; the replay does.
    """
    ensembles, n_steps, walkers = chain.log_prob.shape
    try:
        replay = sample(
            chain.posterior(),
            chain.estimate,
            seed=chain.seed,
            ensembles=ensembles,
            walkers=walkers,
            steps=n_steps if every_step else min(STEPS, n_steps),
            progress=False,
        )
    except InputError as error:
        return [Check("first steps", str(error), False)]
    steps = replay.chain.shape[1]
    again, stored = replay.chain, chain.chain[:, :steps]
    off = np.abs(again - stored) / np.sqrt(np.diag(chain.estimate.covariance))
    wrong = np.flatnonzero(~(off.max(axis=(0, 2, 3)) <= ROUNDING))
    finding = f"{steps} replayed from seed {chain.seed}: "
    if wrong.size:
        finding += f"differ from step {wrong[0] + 1} on"
    elif np.array_equal(again, stored):
        finding += "equal bit for bit"
    else:
        finding += f"differ by at most {off.max():.1g} standard deviations"
    moved = replay.accepted - _moved(again) + _moved(chain.chain)
    counted = (
        f"{n_steps} steps of {ensembles} x {walkers} walkers, {chain.accepted.sum()} moves accepted"
    )
    return [
        Check("first steps", finding, not wrong.size),
        Check(
            "numbers",
            f"{counted}, {moved.sum()} counted again",
            np.array_equal(moved, chain.accepted),
        ),
        _random_state(chain, replay),
    ]


def _random_state(chain: Chain, replay: Chain) -> Check:
    """The state from which a resumed run goes on, where the replay came as far."""
    if replay.chain.shape[1] < chain.chain.shape[1]:
        return Check("random state", "not compared: only a replay of every step reaches it", True)
    same = all(
        np.array_equal(again[1], stored[1]) and again[2:] == stored[2:]
        for again, stored in zip(replay.random_states, chain.random_states, strict=True)
    )
    return Check("random state", "reached again" if same else "another one is reached", same)


def _laplace_draws(chain: Chain) -> Check:
    """All draws of a Laplace approximation made again, with its log-density there."""
    n = chain.log_prob.size
    try:
        again = laplace(chain.posterior(), chain.estimate, seed=chain.seed, draws=n)
    except InputError as error:
        return Check("draws", str(error), False)
    sd = np.sqrt(np.diag(chain.estimate.covariance))
    off = float((np.abs(again.chain - chain.chain) / sd).max())
    off_log, share = _farthest(again.log_prob.ravel(), chain.log_prob.ravel())
    finding = (
        f"{n} drawn again from seed {chain.seed}: differ by at most {off:.1g} standard "
        f"deviations, their log-densities by at most {off_log:.2g}"
    )
    return Check("draws", finding, off <= ROUNDING and share <= 1.0)


def _moved(chain: Floats) -> Ints:
    """How often each walker moved after the first step, shape (ensembles, walkers)."""
    return np.asarray(np.any(np.diff(chain, axis=1) != 0.0, axis=3).sum(axis=1))
