"""Drawing from the posterior: independent emcee ensembles, run side by side until their draws suffice.

Every ensemble starts from draws of the Laplace approximation and moves by `LaplaceMove`, now and then by differential
evolution. After growing numbers of steps the rank-normalised R-hat between ensembles and the effective sample sizes
are computed; the run ends when they meet the target. The chain stays in memory, and a checkpoint replaces the file, every
half minute and at the end, so that a run that was stopped goes on where it was.
"""

import math
import os
import platform
import time
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import emcee
import filelock
import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from threadpoolctl import threadpool_limits

from bayesfred.errors import InputError
from bayesfred.inference.chainfile import Chain, check_same_posterior, open_chain, random_states, write_chain
from bayesfred.inference.convergence import convergence
from bayesfred.inference.estimate import MapEstimate, find_map
from bayesfred.inference.moves import LaplaceMove
from bayesfred.inference.posterior import Posterior

Floats = npt.NDArray[np.float64]

RHAT = 1.01
FIRST_CHECK = 8  # steps; fewer say nothing about autocorrelation
GROWTH = 1.2  # of the number of steps between checks
MOST_STEPS = 100_000
DE_SHARE = 0.05  # of the steps move by differential evolution
CHECKPOINT = 30.0  # seconds
PACKAGES = ("bayesfred", "emcee", "numba", "numpy", "scipy")


def sample(
    posterior: Posterior,
    estimate: MapEstimate | None = None,
    *,
    path: str | os.PathLike[str],
    seed: int,
    ensembles: int = 4,
    walkers: int = 32,
    target_ess: float = 1000,
    steps: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
) -> Chain:
    """Draw from the posterior into a chain file.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate, optional
        Found by `find_map` if not given.
    path : path-like
        The chain file, HDF5.
    seed : int
        The same seed, posterior and estimate give the same draws, for any number of threads.
    ensembles : int
        Independent ensembles, at least 2: R-hat compares them.
    walkers : int
        Walkers of each ensemble, even and at least 4.
    target_ess : float
        Sampling ends when every parameter's bulk and tail effective sample sizes reach this and its R-hat is at most 1.01.
    steps : int, optional
        Run to this total number of steps instead.
    resume : bool
        Go on with the run in the file.
    overwrite : bool
        Replace the file.
    progress : bool
        Show a progress bar on standard error.

    Returns
    -------
    Chain

    Raises
    ------
    InputError
        If the file exists (and neither `resume` nor `overwrite` is given), belongs to another posterior, or is being
        written by another process; if the numbers of ensembles or walkers are too small.
    KeyboardInterrupt
        After everything up to the last complete step was saved.

    References
    ----------
    D. Foreman-Mackey et al. (2013), PASP 125, 306 (emcee). A. Vehtari et al. (2021), Bayesian Analysis 16, 667 (R-hat).
    """
    path = Path(path)
    _check_numbers(ensembles, walkers, target_ess, steps)
    if not path.parent.is_dir():
        raise InputError(f"{path}: no folder {path.parent}, expected one to write the chain to: create it")
    if path.exists() and not (resume or overwrite):
        raise InputError(f"{path}: exists, expected a new file: resume the run in it (resume), or replace it (overwrite)")
    with _lock(path):
        if resume and path.exists():
            check_same_posterior(path, posterior)
            run = _Run.resumed(posterior, open_chain(path), random_states(path))
        else:
            run = _Run.begun(posterior, estimate or find_map(posterior), path, seed, ensembles, walkers)
        with threadpool_limits(1, user_api="blas"):  # idle BLAS threads spin, and take half the likelihood's cores
            return run.until(target_ess, steps, progress)


def _check_numbers(ensembles: int, walkers: int, target_ess: float, steps: int | None) -> None:
    if ensembles < 2:
        raise InputError(f"sampling: ensembles: got {ensembles}, expected at least 2, because R-hat compares them")
    if walkers < 4 or walkers % 2:
        raise InputError(f"sampling: walkers: got {walkers}, expected an even number of at least 4")
    if not target_ess > 0:
        raise InputError(f"sampling: target_ess: got {target_ess}, expected a positive number of effective draws")
    if steps is not None and steps < 1:
        raise InputError(f"sampling: steps: got {steps}, expected at least 1")


def _lock(path: Path) -> filelock.BaseFileLock:
    """A lock on the chain file that says who holds it."""
    lock = filelock.FileLock(path.with_name(f".{path.name}.lock"), timeout=1.0)
    try:
        lock.acquire()
    except filelock.Timeout:
        raise InputError(
            f"{path}: another process is writing this chain, expected to be the only one: wait for it, or stop it"
        ) from None
    return lock


def burn_in(chain: Floats) -> int:
    """Steps to leave out: twice the slowest parameter's autocorrelation time, at most half the run.

    Walkers start from the Laplace approximation, so what must be forgotten is its difference from the posterior.
    """
    n_steps = chain.shape[1]
    kept = chain[:, n_steps // 4 :]
    _, bulk, tail = convergence(kept)
    effective = float(min(bulk.min(), tail.min()))
    draws = kept.shape[0] * kept.shape[1] * kept.shape[2]
    half: int = n_steps // 2
    return min(half, math.ceil(2.0 * draws / effective)) if effective > 0 else half


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that the numbers depend on."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


class _Step(NamedTuple):
    """All ensembles after a step."""

    coords: Floats  # (ensembles, walkers, d)
    log_prob: Floats  # (ensembles, walkers)
    accepted: npt.NDArray[np.int64]  # (ensembles, walkers) moves accepted so far
    random: list[tuple[Any, ...]]  # state of each ensemble's random numbers

    @classmethod
    def of(cls, states: list[emcee.State], accepted: npt.NDArray[np.int64]) -> "_Step":
        """A copy of the ensembles' states."""
        coords, log_prob = np.stack([s.coords for s in states]), np.stack([s.log_prob for s in states])
        return cls(coords, log_prob, accepted, [s.random_state for s in states])

    def states(self) -> list[emcee.State]:
        """The ensembles for emcee to go on with."""
        parts = zip(self.coords, self.log_prob, self.random, strict=True)
        return [emcee.State(coords, log_prob=log_prob, random_state=random) for coords, log_prob, random in parts]


class _Run:
    """A run in progress: the steps so far and the ensembles that make more."""

    def __init__(self, posterior: Posterior, estimate: MapEstimate, path: Path, seed: int, states: list[emcee.State]) -> None:
        self.posterior, self.estimate, self.path, self.seed = posterior, estimate, path, seed
        self.steps: list[_Step] = []
        self.start = _Step.of(states, np.zeros((len(states), len(states[0].coords)), np.int64))

    @classmethod
    def begun(cls, posterior: Posterior, estimate: MapEstimate, path: Path, seed: int, ensembles: int, walkers: int) -> "_Run":
        """Walkers at draws of the Laplace approximation that the prior admits."""
        move = LaplaceMove.of(posterior, estimate)
        states = []
        for child in np.random.SeedSequence(seed).spawn(ensembles):
            random = np.random.RandomState(np.random.MT19937(child))
            coords, log_prob = np.empty((0, posterior.n_parameters)), np.empty(0)
            for _ in range(100):
                drawn = move.draw(walkers, random)
                values = posterior.log_prob(drawn)
                good = np.isfinite(values)
                coords, log_prob = np.concatenate([coords, drawn[good]]), np.concatenate([log_prob, values[good]])
                if len(coords) >= walkers:
                    break
            else:
                raise InputError("estimate: the posterior has no density around it, expected its maximum: see find_map")
            states.append(emcee.State(coords[:walkers], log_prob=log_prob[:walkers], random_state=random.get_state()))
        return cls(posterior, estimate, path, seed, states)

    @classmethod
    def resumed(cls, posterior: Posterior, chain: Chain, random: list[tuple[Any, ...]]) -> "_Run":
        """The run in a chain file, after its last step."""
        states = [
            emcee.State(chain.chain[k, -1], log_prob=chain.log_prob[k, -1], random_state=state)
            for k, state in enumerate(random)
        ]
        run = cls(posterior, chain.estimate, chain.path, chain.seed, states)
        positions = zip(chain.chain.swapaxes(0, 1), chain.log_prob.swapaxes(0, 1), strict=True)
        run.steps = [_Step(coords, log_prob, chain.accepted, random) for coords, log_prob in positions]
        return run

    def until(self, target_ess: float, steps: int | None, progress: bool) -> Chain:
        """Go on until the target is met, or to the given number of steps."""
        check = FIRST_CHECK
        while steps is None and check < len(self.steps):  # the checks fall on the same steps in a resumed run
            check = math.ceil(check * GROWTH)
        saved = time.monotonic()
        state = TextColumn("{task.fields[state]}")
        columns = (TextColumn("sampling"), BarColumn(), state, TimeElapsedColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), disable=not progress) as bar:
            task = bar.add_task("", total=steps, completed=len(self.steps), state="")
            try:
                if steps is None and self.steps and self._enough(target_ess)[0]:
                    return self.chain(target_ess)
                for _ in self._advance(MOST_STEPS if steps is None else steps):
                    n = len(self.steps)
                    bar.update(task, completed=n, state=f"{n} steps")
                    if steps is None and n >= check:
                        enough, share = self._enough(target_ess)
                        if enough:
                            break
                        bar.update(task, total=max(n + 1, math.ceil(n / max(share, 0.05))))
                        check = math.ceil(check * GROWTH)
                    if time.monotonic() - saved > CHECKPOINT:
                        self._save(target_ess)
                        saved = time.monotonic()
            finally:
                if self.steps:
                    self._save(target_ess)
        return self.chain(target_ess)

    def _advance(self, total: int) -> Iterator[None]:
        """Step all ensembles in turn; a step counts when every ensemble has made it."""
        moves = [
            (LaplaceMove.of(self.posterior, self.estimate), 1.0 - DE_SHARE),
            (emcee.moves.DEMove(live_dangerously=True), DE_SHARE),
        ]
        last = self.steps[-1] if self.steps else self.start
        _, walkers, d = last.coords.shape
        generators = []
        for state in last.states():
            sampler = emcee.EnsembleSampler(walkers, d, self.posterior.log_prob, moves=moves, vectorize=True)
            sampler.log_prob_fn = self.posterior.log_prob  # emcee's wrapper would print a traceback when interrupted
            generators.append(sampler.sample(state, iterations=None, store=False, skip_initial_state_check=True))
        while len(self.steps) < total:
            states = [next(generator) for generator in generators]
            moved = np.stack([np.any(state.coords != before, axis=1) for state, before in zip(states, last.coords, strict=True)])
            last = _Step.of(states, last.accepted + moved)
            self.steps.append(last)  # all of a step or nothing, wherever an interrupt comes
            yield

    def _enough(self, target_ess: float) -> tuple[bool, float]:
        """Whether the draws so far suffice, and which share of the effective draws wanted they are."""
        chain = np.stack([step.coords for step in self.steps], axis=1)
        rhat, bulk, tail = convergence(chain[:, burn_in(chain) :])
        share = float(min(bulk.min(), tail.min()) / target_ess)
        return bool(share >= 1.0 and rhat.max() <= RHAT), share

    def chain(self, target_ess: float) -> Chain:
        """The run so far."""
        steps = list(self.steps)
        chain = np.stack([step.coords for step in steps], axis=1)
        return Chain(
            self.path,
            self.posterior.parameter_names,
            chain,
            np.stack([step.log_prob for step in steps], axis=1),
            steps[-1].accepted,
            burn_in(chain),
            self.seed,
            self.estimate,
            versions(),
            target_ess,
        )

    def _save(self, target_ess: float) -> None:
        write_chain(self.chain(target_ess), self.posterior, self.steps[-1].random)
