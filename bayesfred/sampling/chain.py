"""The result of a run: its draws, and everything needed to judge, replay and resume it.

`sampler.sample` makes a `Chain`; `chainfile` writes one to a file and reads it back.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import arviz_base
import xarray as xr

from bayesfred._typing import Floats, Ints
from bayesfred.io.summary_table import Table
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.summary import summary

__all__ = ["Chain"]


@dataclass(frozen=True, eq=False)
class Chain:
    """The draws of a run and where they came from.

    Attributes
    ----------
    path : Path or None
        The chain file; None where the run is kept in memory alone.
    density : TargetDensity
        The posterior that was sampled, see `posterior`.
    chain : ndarray, shape (n_ensembles, n_steps, n_walkers, d), parameter units
        Positions after every step, burn-in included.
    log_prob : ndarray, shape (n_ensembles, n_steps, n_walkers)
    accepted : ndarray, shape (n_ensembles, n_walkers)
        Number of accepted moves.
    random_states : tuple of tuple, length n_ensembles
        State of each ensemble's random numbers after its last step; a run resumes from them.
    burn_in : int
        Number of steps that `draws` leaves out. In a run that is not finished it is half of all
        steps, or more.
    seed : int
    estimate : MapEstimate
        The maximum that the proposals are centred on.
    versions : dict of str to str
        Versions of the packages that made the run.
    target_ess : float
        The number of effective draws that was asked for.
    n_invalid : int
        Number of log-probabilities that were NaN or +inf and were taken as -inf.
    record : RunRecord or None
        Title, frame, settings, notes and truth of the run, where they were given.
    """

    path: Path | None
    density: TargetDensity
    chain: Floats
    log_prob: Floats
    accepted: Ints
    random_states: tuple[tuple[Any, ...], ...]
    burn_in: int
    seed: int
    estimate: MapEstimate
    versions: dict[str, str]
    target_ess: float = 1000.0
    n_invalid: int = 0
    record: RunRecord | None = None

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the last axis of `chain`; length d."""
        return self.density.parameter_names

    def posterior(self) -> Any:
        """The posterior that was sampled: of frames a `Posterior`, or what `sample` was given.

        The chain holds it. What happens to the file afterwards does not change it.
        """
        return self.density

    def draws(self) -> Floats:
        """All draws after burn-in, shape (n, d), parameter units."""
        return self.chain[:, self.burn_in :].reshape(-1, len(self.parameter_names))

    def summary(self) -> Table:
        """What the draws say of every parameter, a row each, see `summary.summary`."""
        return summary(self)

    def to_datatree(self) -> xr.DataTree:
        """The draws after burn-in for arviz.

        Returns
        -------
        xarray.DataTree
            `posterior` with a variable for each parameter and `sample_stats` with `lp`, of shape
            (n_ensembles, n_steps * n_walkers): an ensemble is a chain. Its draws are in the order
            of the steps: those of all walkers after a step, then those after the next.

        Notes
        -----
        arviz takes the draws of a chain as one series in time. Its R-hat compares ensembles, and
        the first half of each with the second, and is the one that the package reports. Its
        effective sample sizes and Monte Carlo errors assume that draws which are close in the
        series are the correlated ones. Here the next draw is another walker's, and a walker's own
        next draw comes `n_walkers` draws later, beyond the lags at which arviz stops to sum. So
        arviz sees next to nothing of the correlation between steps, and its effective sample
        sizes are too large: on four ensembles of 32 walkers whose steps have a correlation of 0.9,
        about 18 times. `summary` has sizes that count it.
        """
        kept = self.chain[:, self.burn_in :].reshape(len(self.chain), -1, self.chain.shape[3])
        log_prob = self.log_prob[:, self.burn_in :].reshape(kept.shape[:2])
        posterior = {name: kept[..., k] for k, name in enumerate(self.parameter_names)}
        return arviz_base.from_dict({"posterior": posterior, "sample_stats": {"lp": log_prob}})
