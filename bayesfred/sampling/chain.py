"""The result of a run: its draws, and everything needed to judge, replay and resume it.

`sampler.sample` makes a `Chain`; `chainfile` writes one to a file and reads it back.
"""

import hashlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.summary_table import Table
from bayesfred.model.added_errors import added_draws
from bayesfred.model.joint import JointPosterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.sampling.datatree import to_datatree
from bayesfred.sampling.displacement import displacement
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.summary import summary

__all__ = ["Chain", "Method"]

Method = Literal["mcmc", "laplace"]


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
        The posterior's log-density there; the approximation's where `method` is "laplace".
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
        Versions of the packages that made the run, the last of its steps where it was resumed.
    target_ess : float
        The number of effective draws that was asked for.
    n_invalid : int
        Number of log-probabilities that were NaN or +inf and were taken as -inf.
    method : {"mcmc", "laplace"}
        How the draws were made: by the sampler, or independently from the Laplace approximation,
        see `laplace`.
    record : RunRecord or None
        Title, frame, settings, notes and truth of the run, where they were given.
    whole : Chain or None
        Of a frame among several, see `frame`: the chain of all.
    earlier : tuple of (int, dict of str to str)
        Of a run that was resumed with other versions: the number of steps that there were then, and
        the versions that had made the last of them.
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
    method: Method = "mcmc"
    record: RunRecord | None = None
    whole: "Chain | None" = field(default=None, repr=False)
    earlier: tuple[tuple[int, dict[str, str]], ...] = ()

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the last axis of `chain`; length d."""
        return self.density.parameter_names

    @property
    def identity(self) -> str:
        """What the run is known by, whatever became of it since: a hash of its first step.

        It is that of posterior, estimate, seed and walkers, on the machine that began the run. One
        of several frames is known by the run of all.
        """
        if self.whole is not None:
            return self.whole.identity
        return hashlib.sha256(self.chain[:, 0].tobytes()).hexdigest()[:32]

    @property
    def version_history(self) -> str:
        """The versions as a text; where the run was resumed with others, what they were before."""
        names = [f"{name} {version}" for name, version in sorted(self.versions.items())]
        before = [
            f"; until step {steps} {name} {versions.get(name, 'not there')}"
            for steps, versions in self.earlier
            for name in sorted({**versions, **self.versions})
            if versions.get(name) != self.versions.get(name)
        ]
        return ", ".join(names) + "".join(before)

    def posterior(self) -> Any:
        """The posterior that was sampled: of frames a `Posterior`, or what `sample` was given.

        The chain holds it. What happens to the file afterwards does not change it.
        """
        return self.density

    def frame(self, name: str) -> "Chain":
        """What a chain of several frames says of one of them: draws of its own posterior.

        They are marginal: the other frames have narrowed what is shared. So the log-densities are
        those of all frames, and `whole` is the chain of all.

        Parameters
        ----------
        name : str

        Returns
        -------
        Chain

        Raises
        ------
        InputError
            If the chain is not of several frames, or has no such frame.
        """
        joint = self.density
        if not isinstance(joint, JointPosterior):
            raise InputError(
                f"frame: got {name!r}, expected a chain of several frames to pick from"
            )
        density, best = joint.frame(name), self.estimate
        estimate = replace(
            best,
            params=joint.frame_params(name, best.params),
            covariance=joint.frame_covariance(name, best.covariance),
            modes=None,
            fits_data=True,  # which is asked of every frame again
        )
        record = self.record and replace(
            self.record,
            title=f"{self.record.title}: {name}",
            truth=None
            if self.record.truth is None
            else joint.frame_params(name, self.record.truth),
        )
        flat = self.chain.reshape(-1, self.chain.shape[3])
        own = joint.frame_params(name, flat).reshape(*self.chain.shape[:3], -1)
        return replace(
            self, density=density, chain=own, estimate=estimate, record=record, whole=self
        )

    def draws(self) -> Floats:
        """All draws after burn-in, shape (n, d), parameter units.

        Errors that the posterior adds, such as those of a measured PSF, are in them.
        """
        kept = self.chain[:, self.burn_in :].reshape(-1, len(self.parameter_names))
        added = getattr(self.density, "added_covariance", None)
        if added is None:
            return kept
        moved = kept + added_draws(added, len(kept), self.seed)
        return np.asarray(np.clip(moved, *self.density.support))

    def summary(self) -> Table:
        """What the draws say of every parameter, a row each, see `summary.summary`."""
        return summary(self)

    def displacement(self, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Floats, Floats]:
        """By how much the objects imaged at (u, v) are displaced, with the error of that.

        Parameters
        ----------
        u, v : array_like, shape (n,), pixel of the fine grid
            Image points from the middle of the frame.

        Returns
        -------
        mean : ndarray, shape (n, 2), pixel of the fine grid
            (u - x, v - y) of the object imaged at (u, v), the pointing's offset included. NaN where
            no object is imaged.
        covariance : ndarray, shape (n, 2, 2), pixel^2

        Raises
        ------
        InputError
            If the chain is of a density that is no frame's.

        Notes
        -----
        At most 1,000 draws are used, spread over the chain; see
        `bayesfred.sampling.displacement.displacement`.

        Examples
        --------
        >>> import bayesfred as bf
        >>> model = bf.ForwardModel(
        ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
        ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
        >>> posterior = bf.Posterior(model, bf.simulate(model, [0.02, 0.02], 2.0, seed=1))
        >>> chain = bf.sample(posterior, seed=1, target_ess=200, progress=False)
        >>> mean, covariance = chain.displacement([0.0, 30.0], [0.0, 30.0])
        >>> print(mean.round(1), (covariance[:, 0, 0] ** 0.5).round(2))
        [[ 0.   0. ]
         [-0.6 -0.6]] [0.   0.02]
        """
        return displacement(self, u, v)

    def to_datatree(self, *, log_likelihood: bool = False) -> xr.DataTree:
        """The draws after burn-in for arviz, with frame and catalogue, see `datatree`.

        An ensemble is a chain. With `log_likelihood` that of the pixels of every source is
        computed too.
        """
        return to_datatree(self, log_likelihood=log_likelihood)
