"""Sampling: independent emcee ensembles, run side by side until their draws suffice.

Every ensemble starts from draws of the Laplace approximation, of several modes each in another, and
moves by `LaplaceMove`, now and then by differential evolution. Where too few moves are accepted the
proposals are adapted to the draws so far, which are then left out, see `ensembles`. After growing
numbers of steps R-hat between the ensembles and the effective sample sizes are computed; the run
ends when they meet the target, see `stopping`. The chain stays in memory. With a path,
`checkpoints` also saves it to a file every half minute and at the end, so that a run that was
stopped can be resumed.
"""

import math
import platform
from collections.abc import Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np

from bayesfred._typing import Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.io.lock import only_writer
from bayesfred.io.memory import require_room
from bayesfred.io.paths import may_write
from bayesfred.model.protocol import TargetDensity
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import changed_parts, fingerprint, open_chain, write_chain
from bayesfred.sampling.checkpoints import Checkpoints, in_memory
from bayesfred.sampling.ensembles import Step, advance, begin, check_start
from bayesfred.sampling.progress import progress_bar, working
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.stopping import (
    FIRST_CHECK,
    burn_in,
    bytes_a_step,
    checks,
    most_burn_in,
    most_steps,
    sufficient,
)

__all__ = ["Run", "check_density", "check_estimate", "check_output", "sample", "versions"]

PACKAGES = ("bayesfred", "emcee", "numba", "numpy", "scipy")


def sample(
    posterior: TargetDensity,
    estimate: MapEstimate | None = None,
    *,
    seed: int,
    path: PathLike | None = None,
    ensembles: int = 4,
    walkers: int = 32,
    target_ess: float = 1000,
    steps: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: bool = True,
    record: RunRecord | None = None,
) -> Chain:
    """Draw from a posterior, in memory or into a chain file.

    Parameters
    ----------
    posterior : Posterior or TargetDensity
        A frame's posterior, or any density that offers what `model.protocol.TargetDensity` lists.
    estimate : MapEstimate, optional
        Its maximum; by default found by `find_map`, once the file has been locked. A resumed run
        keeps the one in the file.
    seed : int
        The same seed, posterior and estimate give the same draws, for any number of threads.
    path : path-like, optional
        The chain file, HDF5. Without it the chain is kept in memory alone, and an interrupt loses
        it.
    ensembles : int
        Independent ensembles, at least 2, because R-hat compares them.
    walkers : int
        Walkers of each ensemble, even and at least 4.
    target_ess : float
        Sampling ends when every parameter's bulk and tail effective sample sizes reach this and its
        R-hat is at most 1.01, or after 100,000 steps, or when memory is full.
    steps : int, optional
        Run to this total number of steps instead.
    resume : bool
        Resume the run in the file, which has to be of this posterior, seed, and numbers of
        ensembles and walkers.
    overwrite : bool
        Replace the file.
    progress : bool
        Show progress on standard error: a bar in a terminal, a line every half minute elsewhere.
    record : RunRecord, optional
        What the chain keeps of the run beside its draws; a resumed run keeps the one it has unless
        another is given.

    Returns
    -------
    Chain

    Raises
    ------
    InputError
        If the file exists (and neither `resume` nor `overwrite` is given), is to be resumed with
        another posterior, seed or number of ensembles or walkers, cannot hold such a posterior or
        cannot be written, or another process, which is named, is writing it; if the numbers of
        ensembles or walkers are too small, or their steps would not fit in memory; if the walkers
        have no posterior density to start from or do not spread in every direction, or if they are
        stuck: what was sampled until then is saved.
    KeyboardInterrupt
        With a path, after everything up to the last complete step was saved.

    References
    ----------
    D. Foreman-Mackey et al. (2013), PASP 125, 306 (emcee). A. Vehtari et al. (2021), Bayesian
    Analysis 16, 667 (R-hat).

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> chain = sample(posterior, seed=1, progress=False)
    >>> chain.draws().shape[1], chain.posterior() is posterior
    (2, True)
    """
    _check_numbers(ensembles, walkers, target_ess, steps)
    n_steps, d = steps or FIRST_CHECK, len(posterior.parameter_names)
    require_room(
        f"sampling: got {ensembles} ensembles of {walkers} walkers, whose first {n_steps} steps",
        n_steps * bytes_a_step(ensembles * walkers, d),
        "ask for fewer",
    )

    def fresh() -> Run:
        found = estimate
        if found is None:
            with working(show=progress):
                found = find_map(posterior)
        return Run(posterior, found, seed, ensembles=ensembles, walkers=walkers, record=record)

    with one_blas_thread():  # idle BLAS threads spin and take half the cores
        if path is None:
            if resume or overwrite:
                raise InputError(
                    "sampling: path: got none with resume or overwrite, expected the chain file"
                )
            return fresh().until(target_ess, steps, in_memory(), show=progress)
        path = Path(path)
        parts = check_output(path, posterior)
        with only_writer(path):
            if may_write(path, resume=resume, overwrite=overwrite):
                chain = open_chain(path)
                if chain.method != "mcmc":
                    raise InputError(
                        f"{path}: got draws of the Laplace approximation, expected a sampled run "
                        "to resume: start over with overwrite, or write to another file"
                    )
                _check_same(path, fingerprint(chain.posterior()), parts)
                _check_same_draws(path, chain, seed, ensembles, walkers)
                check_density(posterior, chain.estimate)
                run = Run.resumed(posterior, replace(chain, record=record or chain.record))
            else:
                run = fresh()
            checkpoints = Checkpoints(lambda chain: write_chain(replace(chain, path=path)))
            try:
                chain = run.until(target_ess, steps, checkpoints, show=progress)
            except KeyboardInterrupt as stop:
                if run.steps:
                    stop.add_note(f"{path} holds {len(run.steps)} steps: resume it with --resume")
                raise
            return replace(chain, path=path)


def check_output(path: Path, posterior: TargetDensity) -> dict[str, str]:
    """The posterior's fingerprint, where a chain file can be written that holds it."""
    if not path.parent.is_dir():
        raise InputError(
            f"{path}: no folder {path.parent}, expected one to write the chain to: create it"
        )
    try:
        return fingerprint(posterior)
    except InputError as error:  # no file can hold it
        raise InputError(f"{path}: {error}, or sample it in memory, without a path") from None


def check_estimate(posterior: TargetDensity, estimate: MapEstimate) -> None:
    """Refuse the maximum of a posterior with other parameters."""
    expected = len(posterior.parameter_names)
    if np.shape(estimate.params) != (expected,):
        raise InputError(
            f"estimate: got {np.size(estimate.params)} parameters, expected {expected}: find "
            "this posterior's maximum"
        )


def check_density(posterior: TargetDensity, estimate: MapEstimate) -> None:
    """Refuse what is no maximum: a file may hold anything."""
    if not np.isfinite(posterior.log_prob(estimate.params)):
        raise InputError(
            "estimate: got parameters without posterior density, expected a maximum: restore a "
            "copy, or run again"
        )


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that the numbers depend on."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


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


def _check_same(path: Path, before: dict[str, str], parts: dict[str, str]) -> None:
    """Refuse a chain file whose frame, model, noise or priors are not those of the posterior."""
    changed = changed_parts(before, parts)
    if changed:
        raise InputError(
            f"{path}: the run was made with other {', '.join(changed)}, expected the same to "
            "resume: write to another file, or start over with overwrite"
        )


def _check_same_draws(path: Path, chain: Chain, seed: int, ensembles: int, walkers: int) -> None:
    """Refuse to resume with numbers that would have made other draws from the first step on."""
    made = {"seed": chain.seed, "ensembles": len(chain.chain), "walkers": chain.chain.shape[2]}
    given = {"seed": seed, "ensembles": ensembles, "walkers": walkers}
    changed = [name for name in made if made[name] != given[name]]
    if changed:
        was, now = (", ".join(f"{k} {of[k]}" for k in changed) for of in (made, given))
        raise InputError(
            f"{path}: the run was made with {was}, got {now}, expected the same to resume: write "
            "to another file, or start over with overwrite"
        )


class Run:
    """A run in progress: what is sampled, and the steps so far.

    Parameters
    ----------
    posterior : TargetDensity
    estimate : MapEstimate
    seed : int
    ensembles, walkers : int
        Of a run without steps. Its walkers start at draws of the Laplace approximation.
    steps : sequence of Step
        The steps that were made already.
    record : RunRecord, optional
        Kept with the chain.
    before : Chain, optional
        The one that is resumed.
    """

    def __init__(
        self,
        posterior: TargetDensity,
        estimate: MapEstimate,
        seed: int,
        *,
        ensembles: int = 4,
        walkers: int = 32,
        steps: Sequence[Step] = (),
        record: RunRecord | None = None,
        before: Chain | None = None,
    ) -> None:
        check_estimate(posterior, estimate)
        expected = len(posterior.parameter_names)
        if record is not None and record.truth is not None and record.truth.shape != (expected,):
            raise InputError(
                f"record: got a truth of {record.truth.size} parameters, expected {expected}"
            )
        self.posterior, self.estimate, self.seed = posterior, estimate, seed
        self.record, self.before = record, before
        self.near = posterior.near(estimate.params, estimate.covariance)
        self.steps = list(steps)
        self.start = steps[-1] if steps else begin(self.near, estimate, seed, ensembles, walkers)
        check_start(posterior.parameter_names, self.start)

    @classmethod
    def resumed(cls, posterior: TargetDensity, chain: Chain) -> "Run":
        """The run that made a chain, after its last step."""
        states = list(chain.random_states)
        steps = [
            Step(coords, log_prob, chain.accepted, states, chain.n_invalid)
            for coords, log_prob in zip(
                chain.chain.swapaxes(0, 1), chain.log_prob.swapaxes(0, 1), strict=True
            )
        ]
        return cls(
            posterior, chain.estimate, chain.seed, steps=steps, record=chain.record, before=chain
        )

    def until(
        self, target_ess: float, steps: int | None, checkpoints: Checkpoints, *, show: bool
    ) -> Chain:
        """Run until the target is met, or to the given number of steps.

        Whatever ends the run, its steps are saved first.
        """
        try:
            with progress_bar("sampling", show=show) as update:
                for share in self._advance(target_ess, steps):
                    n = len(self.steps)
                    total = max(n + 1, math.ceil(n / share)) if share > 0.0 else None
                    update(n, steps or total, f"{n} steps")
                    if checkpoints.due():
                        checkpoints.save(self._chain(target_ess))
            chain = self._chain(target_ess)
            chain = replace(chain, burn_in=burn_in(chain.chain))
        except BaseException:
            if self.steps:
                checkpoints.save(self._chain(target_ess))
            raise
        checkpoints.save(chain)
        return chain

    def _advance(self, target_ess: float, steps: int | None) -> Iterator[float]:
        """Make steps until there are enough; after each, the share of what is wanted."""
        made = advance(self.near, self.estimate, self.start, self.steps)
        due = checks()  # the same ones in a resumed run, so that it ends where it would have ended
        check = next(n for n in due if n >= len(self.steps))
        enough, share = False, 0.0
        if steps is None and len(self.steps) == check:
            enough, share = sufficient(self._positions(), target_ess)
            check = next(due)
        most = steps or most_steps(self.start.log_prob.size, self.start.coords.shape[-1])
        while not enough and len(self.steps) < most:
            self.steps.append(next(made))  # all of a step or nothing, whenever an interrupt comes
            if steps is not None:
                share = len(self.steps) / steps
            elif len(self.steps) == check:
                enough, share = sufficient(self._positions(), target_ess)
                check = next(due)
            yield share

    def _positions(self) -> Floats:
        return np.stack([step.coords for step in self.steps], axis=1)

    def _chain(self, target_ess: float) -> Chain:
        """The run so far, with the longest burn-in there can be: finding it takes time."""
        last, positions = self.steps[-1], self._positions()
        made_by, earlier = self._versions()
        return Chain(
            path=None,
            density=self.posterior,
            chain=positions,
            log_prob=np.stack([step.log_prob for step in self.steps], axis=1),
            accepted=last.accepted,
            random_states=tuple(last.random),
            burn_in=most_burn_in(positions),
            seed=self.seed,
            estimate=self.estimate,
            versions=made_by,
            target_ess=target_ess,
            n_invalid=last.n_invalid,
            record=self.record,
            earlier=earlier,
        )

    def _versions(self) -> tuple[dict[str, str], tuple[tuple[int, dict[str, str]], ...]]:
        """What made the last step, and what made those before; see `Chain.earlier`."""
        today, before = versions(), self.before
        if before is None:
            return today, ()
        begun = before.chain.shape[1]
        if today == before.versions or len(self.steps) == begun:
            return before.versions, before.earlier
        return today, (*before.earlier, (begun, before.versions))
