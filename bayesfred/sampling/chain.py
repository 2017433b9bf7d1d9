"""The result of a run: its draws, and everything needed to judge, replay and resume it.

`sampler.sample` makes a `Chain`; `chainfile` writes one to a file and reads it back.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import xarray as xr

from bayesfred._typing import Floats, Ints
from bayesfred.io.summary_table import Table
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
        Versions of the packages that made the run.
    target_ess : float
        The number of effective draws that was asked for.
    n_invalid : int
        Number of log-probabilities that were NaN or +inf and were taken as -inf.
    method : {"mcmc", "laplace"}
        How the draws were made: by the sampler, or independently from the Laplace approximation,
        see `laplace`.
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
    method: Method = "mcmc"
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
        """All draws after burn-in, shape (n, d), parameter units.

        Where the PSF was measured its errors are in them: those of the sampler have the PSF fixed.
        """
        kept = self.chain[:, self.burn_in :].reshape(-1, len(self.parameter_names))
        errors = getattr(self.density, "psf_errors", None)
        if errors is None:
            return kept
        moved = kept + errors.displacements(len(kept), self.seed)
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
