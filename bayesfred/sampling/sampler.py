"""Drawing from the posterior: independent emcee ensembles, run side by side until their draws suffice.

Every ensemble starts from draws of the Laplace approximation and moves by `LaplaceMove`, now and
then by differential evolution. Where too few moves are accepted the proposals are made anew from
the draws so far, which are then left out, see `ensembles.py`. After growing numbers of steps the
rank-normalised R-hat between ensembles and the effective sample sizes are computed; the run ends
when they meet the target. The chain stays in memory, and a checkpoint replaces the file, every half
minute and at the end, so that a run that was stopped goes on where it was.
"""

import math
import platform
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.status import Status
from threadpoolctl import threadpool_limits

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io.lock import only_writer
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chainfile import (
    Chain,
    check_same_posterior,
    open_chain,
    random_states,
    write_chain,
)
from bayesfred.sampling.convergence import bulk_sizes, effective_sizes, rhats
from bayesfred.sampling.ensembles import Step, adapted, advance, begin, check_start

RHAT = 1.01
FIRST_CHECK = 8  # steps; fewer say nothing about autocorrelation
GROWTH = 1.1  # of the number of steps between checks
MOST_STEPS = 100_000
CHECKPOINT = 30.0  # seconds from one to the next, or more:
CHECKPOINT_SHARE = 0.01  # of a run's time goes into them
PACKAGES = ("bayesfred", "emcee", "numba", "numpy", "scipy")


def sample(
    posterior: Posterior,
    estimate: MapEstimate | None = None,
    *,
    path: PathLike,
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
        Found by `find_map` if not given, once it is certain that no other process writes the file.
    path : path-like
        The chain file, HDF5.
    seed : int
        The same seed, posterior and estimate give the same draws, for any number of threads.
    ensembles : int
        Independent ensembles, at least 2: R-hat compares them.
    walkers : int
        Walkers of each ensemble, even and at least 4.
    target_ess : float
        Sampling ends when every parameter's bulk and tail effective sample sizes reach this and its
        R-hat is at most 1.01.
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
        If the file exists (and neither `resume` nor `overwrite` is given), belongs to another
        posterior, or is being written by another process, which is named, or cannot be written; if
        the numbers of ensembles or walkers are too small; if the walkers have no posterior density
        to start from or do not spread in every direction, or if they are stuck: what was sampled
        until then is saved.
    KeyboardInterrupt
        After everything up to the last complete step was saved.

    References
    ----------
    D. Foreman-Mackey et al. (2013), PASP 125, 306 (emcee). A. Vehtari et al. (2021), Bayesian
    Analysis 16, 667 (R-hat).
    """
    path = Path(path)
    _check_numbers(ensembles, walkers, target_ess, steps)
    if not path.parent.is_dir():
        raise InputError(
            f"{path}: no folder {path.parent}, expected one to write the chain to: create it"
        )
    # idle BLAS threads spin, and take half the likelihood's cores
    with only_writer(path), threadpool_limits(1, user_api="blas"):
        if path.exists() and not (resume or overwrite):
            raise InputError(
                f"{path}: exists, expected a new file: resume the run in it (resume), or replace "
                "it (overwrite)"
            )
        if resume and path.exists():
            check_same_posterior(path, posterior)
            chain = open_chain(path)
            run = _Run.resumed(
                posterior.near(chain.estimate.params, chain.estimate.covariance),
                chain,
                random_states(path),
            )
        else:
            if estimate is None:
                with searching() if progress else nullcontext():
                    estimate = find_map(posterior)
            posterior = posterior.near(estimate.params, estimate.covariance)
            run = _Run(
                posterior,
                estimate,
                path,
                seed,
                begin(posterior, estimate, seed, ensembles, walkers),
            )
        return run.until(target_ess, steps, progress)


def searching() -> Status:
    """Says on the screen, within its `with` block, that the maximum is being searched for."""
    return Console(stderr=True).status(
        "searching for the maximum (the first run on a machine compiles: half a minute)"
    )


def _check_numbers(ensembles: int, walkers: int, target_ess: float, steps: int | None) -> None:
    if ensembles < 2:
        raise InputError(
            f"sampling: ensembles: got {ensembles}, expected at least 2, because R-hat compares "
            "them"
        )
    if walkers < 4 or walkers % 2:
        raise InputError(f"sampling: walkers: got {walkers}, expected an even number of at least 4")
    if not target_ess > 0:
        raise InputError(
            f"sampling: target_ess: got {target_ess}, expected a positive number of effective draws"
        )
    if steps is not None and steps < 1:
        raise InputError(f"sampling: steps: got {steps}, expected at least 1")


def burn_in(chain: Floats) -> int:
    """Steps to leave out: those before the proposals were made for the last time, and of the others at most half.

    Walkers start from the Laplace approximation, so what must be forgotten is its difference from
    the posterior. Were the slowest parameter's correlations r^k after k steps, its autocorrelation
    time would be tau = (1 + r)/(1 - r); the first step that is kept is the one after which at most
    a twentieth is left, r^k <= 1/20.
    """
    made: int = min(adapted(chain), chain.shape[1] - 1)
    n_steps: int = chain.shape[1] - made
    kept = chain[:, made + n_steps // 4 :]
    effective = float(np.min(bulk_sizes(kept)))
    draws = kept.shape[0] * kept.shape[1] * kept.shape[2]
    half = n_steps // 2
    if not effective * half > draws:  # tau is longer
        return made + half
    tau = max(draws / effective, 1.1)
    return made + min(half, math.ceil(math.log(20.0) / math.log((tau + 1.0) / (tau - 1.0))) - 1)


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that the numbers depend on."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


@contextmanager
def _unbroken() -> Iterator[None]:
    """Keep Ctrl-C and termination waiting until what is inside is done; other threads never get them."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    before = {
        number: signal.signal(number, lambda n, _: arrived.append(n))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if arrived:
            signal.raise_signal(arrived[0])


class _Run:
    """A run in progress: the steps so far and the ensembles that make more."""

    def __init__(
        self, posterior: Posterior, estimate: MapEstimate, path: Path, seed: int, start: Step
    ) -> None:
        check_start(posterior.parameter_names, start)
        self.posterior, self.estimate, self.path, self.seed, self.start = (
            posterior,
            estimate,
            path,
            seed,
            start,
        )
        self.steps: list[Step] = []

    @classmethod
    def resumed(cls, posterior: Posterior, chain: Chain, random: list[tuple[Any, ...]]) -> "_Run":
        """The run in a chain file, after its last step."""
        positions = zip(chain.chain.swapaxes(0, 1), chain.log_prob.swapaxes(0, 1), strict=True)
        steps = [
            Step(coords, log_prob, chain.accepted, random, chain.n_invalid)
            for coords, log_prob in positions
        ]
        run = cls(posterior, chain.estimate, chain.path, chain.seed, steps[-1])
        run.steps = steps
        return run

    def until(self, target_ess: float, steps: int | None, progress: bool) -> Chain:
        """Go on until the target is met, or to the given number of steps."""
        check = FIRST_CHECK
        while steps is None and check < len(
            self.steps
        ):  # the checks fall on the same steps in a resumed run
            check = max(check + 1, int(check * GROWTH))
        due = time.monotonic() + CHECKPOINT
        state = TextColumn("{task.fields[state]}")
        columns = (
            TextColumn("sampling"),
            BarColumn(),
            state,
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=Console(stderr=True), disable=not progress) as bar:
            task = bar.add_task("", total=steps, completed=len(self.steps), state="")
            try:
                enough = steps is None and bool(self.steps) and self._enough(target_ess)[0]
                for _ in self._advance(0 if enough else MOST_STEPS if steps is None else steps):
                    n = len(self.steps)
                    bar.update(task, completed=n, state=f"{n} steps")
                    if steps is None and n >= check:
                        enough, share = self._enough(target_ess)
                        if enough:
                            break
                        bar.update(task, total=max(n + 1, math.ceil(n / max(share, 0.05))))
                        check = max(check + 1, int(check * GROWTH))
                    if time.monotonic() >= due:
                        began = time.monotonic()
                        self._save(self._unfinished(target_ess))
                        now = time.monotonic()
                        due = now + max(CHECKPOINT, (now - began) / CHECKPOINT_SHARE)
                chain = self._unfinished(target_ess)
                chain = replace(chain, burn_in=burn_in(chain.chain))
                self._save(chain)
                return chain
            except BaseException:
                if self.steps:
                    self._save(self._unfinished(target_ess))
                raise

    def _advance(self, total: int) -> Iterator[None]:
        """Make steps until there are so many."""
        steps = advance(self.posterior, self.estimate, self.start, self.steps)
        while len(self.steps) < total:
            self.steps.append(next(steps))  # all of a step or nothing, wherever an interrupt comes
            yield

    def _enough(self, target_ess: float) -> tuple[bool, float]:
        """Whether the draws so far suffice, and which share of the effective draws wanted they are."""
        chain = np.stack([step.coords for step in self.steps], axis=1)
        kept = chain[:, burn_in(chain) :]
        draws = kept[..., 0].size
        if draws < target_ess:  # effective draws are not more than draws
            return False, draws / target_ess
        share = float(np.min(effective_sizes(kept)) / target_ess)
        return bool(share >= 1.0 and rhats(kept).max() <= RHAT), share

    def _unfinished(self, target_ess: float) -> Chain:
        """The run so far, with the most burn-in there can be, because finding the right one takes longer than to save it."""
        steps = list(self.steps)
        chain = np.stack([step.coords for step in steps], axis=1)
        log_prob = np.stack([step.log_prob for step in steps], axis=1)
        return Chain(
            self.path,
            self.posterior.parameter_names,
            chain,
            log_prob,
            steps[-1].accepted,
            max(len(steps) // 2, min(adapted(chain), len(steps) - 1)),
            self.seed,
            self.estimate,
            versions(),
            target_ess,
            steps[-1].n_invalid,
        )

    def _save(self, chain: Chain) -> None:
        with _unbroken():
            write_chain(chain, self.posterior, self.steps[-1].random)
