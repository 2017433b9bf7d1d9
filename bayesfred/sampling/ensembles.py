"""Ensembles of walkers: where they start, and their steps, which emcee makes.

This module deals with what an ensemble may meet: a log-probability that is not a number, walkers
from which no run can start, walkers that are stuck, and proposals that are hardly ever accepted.
Such proposals are adapted to the draws so far, at a few steps fixed beforehand. Everything they
depend on is in the chain, so a resumed run adapts in the same way. After the last time they are
fixed, so that the draws from there on come from a Markov chain that leaves the posterior invariant.
The draws before it are left out.

References
----------
C. Andrieu & J. Thoms (2008), Statistics and Computing 18, 343 (adaptation that ends).
"""

import itertools
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import emcee
import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.errors import InputError
from bayesfred.model.joint import JointPosterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.sampling.frame_moves import FrameMove, Parts
from bayesfred.sampling.moves import LaplaceMove

DE_SHARE = 0.05  # of the steps after the first look move by differential evolution
# Share of accepted moves below which proposals are adapted. Early it costs few draws, but they have
# to be enough for a covariance: of many parameters that is at a later look.
POOR, POOR_EARLY, EARLY, DRAWS_A_PARAMETER = 0.3, 0.5, 32, 25
LOOKS = (8, 16, 32, 64, 128, 256)  # steps after which this is checked, over the latter half of them
DE_SHARE_ADAPTED = 0.2  # ... where proposals had to be adapted
STUCK = 1000  # proposals refused in a row, to one walker or to a whole ensemble, that end a run
# share of the largest spread, in standard deviations, below which there is none in a direction
DEPENDENT = 1e-8


class Step(NamedTuple):
    """All ensembles after a step."""

    coords: Floats  # (ensembles, walkers, d)
    log_prob: Floats  # (ensembles, walkers)
    accepted: Ints  # (ensembles, walkers) moves accepted so far
    random: list[tuple[Any, ...]]  # state of each ensemble's random numbers
    n_invalid: int  # log-probabilities so far that were NaN or +inf

    @classmethod
    def of(cls, states: list[emcee.State], accepted: Ints, n_invalid: int) -> "Step":
        """A copy of the ensembles' states."""
        coords, log_prob = (
            np.stack([s.coords for s in states]),
            np.stack([s.log_prob for s in states]),
        )
        return cls(coords, log_prob, accepted, [s.random_state for s in states], n_invalid)

    def states(self) -> list[emcee.State]:
        """The ensembles as emcee takes them."""
        parts = zip(self.coords, self.log_prob, self.random, strict=True)
        return [
            emcee.State(coords, log_prob=log_prob, random_state=random)
            for coords, log_prob, random in parts
        ]


class _LogProb:
    """The log-posterior for emcee: NaN and +inf, which are no densities, become -inf.

    They are counted.
    """

    def __init__(self, posterior: TargetDensity, n_invalid: int) -> None:
        self.posterior, self.n_invalid = posterior, n_invalid

    def __call__(self, params: Floats) -> Floats:
        values = self.posterior.log_prob(params)
        return self._checked(values)

    def parts(self, params: Floats, wanted: Flags | None) -> Floats:
        """The parts of several frames' log-posterior."""
        assert isinstance(self.posterior, JointPosterior), "who else has parts"
        return self._checked(self.posterior.log_parts(params, wanted))

    def _checked(self, values: Floats) -> Floats:
        invalid = ~(values < np.inf)
        self.n_invalid += int(invalid.sum())
        return np.where(invalid, -np.inf, values)


class _Sampler(emcee.EnsembleSampler):  # type: ignore[misc]
    """emcee's sampler, but whatever is raised while its random numbers are set is raised."""

    @property
    def random_state(self) -> Any:
        """As RandomState takes it."""
        return self._random.get_state()

    @random_state.setter
    def random_state(self, state: Any) -> None:
        self._random.set_state(state)  # emcee's own setter swallows it, also a Ctrl-C


def begin(
    posterior: TargetDensity, estimate: MapEstimate, seed: int, ensembles: int, walkers: int
) -> Step:
    """Walkers at draws of the Laplace approximation that the prior admits.

    Every ensemble starts in one mode, different ones in different modes: R-hat shows whether they
    have reached each other's.

    Raises
    ------
    InputError
        If there is no density around the estimate.
    """
    modes = estimate.mixture
    moves = [
        LaplaceMove.of(posterior, replace(estimate, params=mean, covariance=covariance, modes=None))
        for mean, covariance in zip(modes.means, modes.covariances, strict=True)
    ][: modes.count]
    log_prob_of = _LogProb(posterior, 0)
    states = []
    for child, move in zip(
        np.random.SeedSequence(seed).spawn(ensembles), itertools.cycle(moves), strict=False
    ):
        random = np.random.RandomState(np.random.MT19937(child))
        coords, log_prob = np.empty((0, len(posterior.parameter_names))), np.empty(0)
        for _ in range(100):
            drawn = move.draw(walkers, random)
            values = log_prob_of(drawn)
            good = np.isfinite(values)
            coords, log_prob = (
                np.concatenate([coords, drawn[good]]),
                np.concatenate([log_prob, values[good]]),
            )
            if len(coords) >= walkers:
                break
        else:
            raise InputError(
                "estimate: the posterior has no density around it, expected its maximum: see "
                "find_map"
            )
        states.append(
            emcee.State(
                coords[:walkers], log_prob=log_prob[:walkers], random_state=random.get_state()
            )
        )
    return Step.of(states, np.zeros((ensembles, walkers), np.int64), log_prob_of.n_invalid)


def check_start(names: tuple[str, ...], start: Step) -> None:
    """Refuse ensembles from which no run can start or be resumed.

    Parameters
    ----------
    names : tuple of str, length d
        The parameters.
    start : Step

    Raises
    ------
    InputError
        If a walker has no posterior density, or the walkers of an ensemble do not spread in as
        many directions as their number allows.
    """
    lost = int(np.sum(~(np.isfinite(start.coords).all(axis=2) & np.isfinite(start.log_prob))))
    if lost:
        raise InputError(
            f"start: got {lost} of {start.log_prob.size} walkers without posterior density, "
            "expected a finite log-probability of "
            "each: start the run over"
        )
    for coords in start.coords:
        still = [
            name
            for name, spread in zip(names, np.ptp(coords, axis=0), strict=True)
            if spread == 0.0
        ]
        if still:
            raise InputError(
                f"start: got the same {', '.join(still)} for all walkers of an ensemble, expected "
                "them to spread: "
                "see the estimate's covariance"
            )
        standardised = (coords - coords.mean(axis=0)) / coords.std(axis=0)
        rank, full = (
            np.linalg.matrix_rank(standardised, rtol=DEPENDENT),
            min(len(coords) - 1, len(names)),
        )
        if rank < full:
            raise InputError(
                f"start: got walkers that spread in {rank} directions only, expected {full}: see "
                "the estimate's covariance"
            )


def adapted(chain: Floats) -> int:
    """The step after which proposals were adapted last, 0 for those of the Laplace approximation.

    Parameters
    ----------
    chain : ndarray, shape (ensembles, steps, walkers, d)
    """
    looks = [look for look in LOOKS if look <= chain.shape[1] and _poor(chain, look)]
    return max(looks, default=0)


def _poor(chain: Floats, look: int) -> bool:
    """Whether too few moves are accepted before a look."""
    ensembles, _, walkers, d = chain.shape
    draws = ensembles * walkers * (look - look // 2)
    enough = DRAWS_A_PARAMETER * d
    early = draws >= enough and (look <= EARLY or draws // 2 < enough)  # or the first of enough
    return _accepted(chain, look) < (POOR_EARLY if early else POOR)


def _accepted(chain: Floats, look: int) -> float:
    """Share of accepted moves in the latter half of the steps before a look.

    Every move that is accepted changes all parameters; of several frames it is that of the shared
    ones or of a frame's own, the least of which counts.
    """
    moved = np.diff(chain[:, look // 2 : look], axis=1) != 0.0
    return float(moved.mean(axis=(0, 1, 2)).min())


def moves_after(
    posterior: TargetDensity, estimate: MapEstimate, chain: Floats, log_parts: Parts | None = None
) -> list[tuple[emcee.moves.Move, float]]:
    """The moves that make the step after those in the chain, each with its share.

    Differential evolution frees walkers from positions where a likelier one is hardly ever
    proposed. That matters in the long run only: before the first look it would only cost draws. In
    the many dimensions of several frames it is of no use.

    Parameters
    ----------
    posterior : TargetDensity
    estimate : MapEstimate
    chain : ndarray, shape (ensembles, steps, walkers, d)
    log_parts : callable, optional
        Of several frames: that of `JointPosterior`, unless another is given.
    """
    made = adapted(chain)
    draws = chain[:, made // 2 : made].reshape(-1, chain.shape[3])
    if isinstance(posterior, JointPosterior):
        parts = log_parts or posterior.log_parts
        with suppress(InputError):  # of too few draws: the next look has more
            if made:
                return [(FrameMove.fitted(posterior, draws, parts), 1.0)]
        return [(FrameMove.of(posterior, estimate, parts), 1.0)]
    move, share = LaplaceMove.of(posterior, estimate), DE_SHARE * (chain.shape[1] >= LOOKS[0])
    if made:
        share = DE_SHARE_ADAPTED
        with suppress(InputError):
            move = LaplaceMove.fitted(posterior, estimate, draws)
    return [(move, 1.0 - share), (emcee.moves.DEMove(live_dangerously=True), share)]


def advance(
    posterior: TargetDensity, estimate: MapEstimate, start: Step, steps: Sequence[Step] = ()
) -> Iterator[Step]:
    """Step all ensembles in turn, without end; a step is complete when all have made it.

    Parameters
    ----------
    posterior : TargetDensity
    estimate : MapEstimate
    start : Step
        From `begin`.
    steps : sequence of Step
        The steps that were made already.

    Raises
    ------
    InputError
        If walkers are stuck.
    """
    past, last = [step.coords for step in steps], steps[-1] if steps else start
    log_prob = _LogProb(posterior, last.n_invalid)
    ensembles, walkers, d = last.coords.shape
    generators: list[Iterator[emcee.State]] = []
    idle = np.zeros(last.log_prob.shape, np.int64)  # steps since each walker moved
    while True:
        if not generators or len(past) in LOOKS:
            moves = moves_after(
                posterior,
                estimate,
                np.array(past).reshape(-1, ensembles, walkers, d).swapaxes(0, 1),
                log_prob.parts,
            )
            generators = []
            for state in last.states():
                sampler = _Sampler(walkers, d, log_prob, moves=moves, vectorize=True)
                sampler.log_prob_fn = (
                    log_prob  # emcee's wrapper would print a traceback when interrupted
                )
                generators.append(
                    sampler.sample(
                        state, iterations=None, store=False, skip_initial_state_check=True
                    )
                )
        states = [next(generator) for generator in generators]
        moved = np.stack(
            [
                state.coords[:, 0] != before[:, 0]
                for state, before in zip(states, last.coords, strict=True)
            ]
        )
        last = Step.of(states, last.accepted + moved, log_prob.n_invalid)
        past.append(last.coords)
        yield last
        idle = np.where(moved, 0, idle + 1)
        longest = int(idle.max())
        if longest >= STUCK or idle.min(axis=1).max() * walkers >= STUCK:
            raise InputError(
                f"sampling: got {np.sum(idle == longest)} of {idle.size} walkers stuck, {longest} "
                "steps without a move, expected "
                "an estimate that describes the posterior: find the maximum from another start, "
                "or fit fewer terms"
            )
