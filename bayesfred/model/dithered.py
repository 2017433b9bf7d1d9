r"""The posterior of dithered frames whose sources' positions are parameters.

A field of sources is exposed k times, displaced by a pointing t_i and turned by an angle a_i. The
positions X_s in an object plane that all frames share are unknown. Frame i has its sources at

    x_si = R(a_i) X_s + t_i,    R(a) = [[cos a, -sin a], [sin a, cos a]],

and the distortion is a function of x_si: an instrument distorts where a source stands in its own
field. (`offset_x` of a frame's posterior is another thing: it moves images behind the distortion.)

Parameters. The coefficients theta of the distortion belong to the instrument. Each frame has its
own pointing, turn, background and PSF width. Then come the positions. Fluxes are free in every
frame and are integrated over, as in a `Posterior`. The chain rule from x_si to these is linear, so
gradient and information are sums over frames of those that `movable` gives. The information is
dense in the first parameters, which are few, and sparse in the positions: a source shares pixels
with few others.

Common shift. Nothing changes when all X_s move by c and every t_i by -R(a_i) c. So the pointing of
the first frame, the reference, is no parameter, and neither is its turn: they say where the plane's
origin and its axes are. Pointings that are known to be n_i with independent errors of standard
deviation sigma know nothing of that c. With c integrated over, the prior of d_i = t_i - n_i is

    -2 sigma^2 log p = sum |d_i|^2 - |sum R(a_i)^T d_i|^2 / k,    a_i as given.

Positions, turns and pointings without such a prior have flat priors, which do not shrink them.
"""

import itertools
import queue
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import sparse

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.model import priors
from bayesfred.model.dither_layout import DitherLayout, check_frames, rotation
from bayesfred.model.frame_density import FrameDensity
from bayesfred.model.movable import Matrix, MovableLikelihood
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import share


@serializable("dithered_posterior")
@dataclass(frozen=True, eq=False, init=False)
class DitheredPosterior(FrameDensity):
    """Posterior of distortion, pointings and source positions given dithered frames.

    `self_calibrate` makes it from counts alone.

    Parameters
    ----------
    frames : mapping of str to Posterior
        Of one instrument, with free fluxes. The catalogue of each has the sources that it shows;
        its positions are where a search begins.
    members : mapping of str to array_like of int
        Which source each row of a frame's catalogue is, counted from 0.
    pointings : mapping of str to (float, float, float): pixel, pixel, degree
        What is added to the positions in each frame, and by which angle they are turned before,
        from x to y. Those of the first frame are exact: they define the object plane.
    pointing_sd : float, optional, pixel
        Standard deviation of the errors of the pointings; without it those of the others are free.
    turned : bool
        Whether the turns of the other frames are parameters.
    fixed : mapping of str to float, optional
        Coefficients of the distortion that are no parameters, with their values.
    prior : mapping of str to frozen scipy.stats distribution, optional
        By name, of coefficients and of frames' own parameters; by default those of the frames.

    Raises
    ------
    InputError
        If there is no frame, one has fluxes that are not free, or an offset, or positions that
        scatter, or another distortion; if a name is unknown, or the numbers do not fit each other.

    Examples
    --------
    >>> import bayesfred as bf
    >>> sky = np.random.default_rng(1).uniform(-30.0, 30.0, (12, 2))
    >>> lens = bf.PolynomialDistortion([(3, 0, 0, 0)], [(0, 3, 0, 0)])
    >>> frames = {}
    >>> for k, (name, shift) in enumerate({"a": 0.0, "b": 8.0}.items()):
    ...     sources = bf.SourceCatalog(sky[:, 0] + shift, sky[:, 1], np.full(12, 1e4))
    ...     model = bf.ForwardModel(bf.Detector((81, 81)), sources, bf.GaussianPSF(2.0), lens)
    ...     counts = bf.simulate(model, [1e-5, 1e-5], 2.0, seed=k)
    ...     frames[name] = bf.Posterior(model, counts, nuisances=bf.Nuisances(flux="free"))
    >>> everyone = {name: np.arange(12) for name in frames}
    >>> posterior = DitheredPosterior(frames, everyone, {"a": (0, 0, 0), "b": (8.0, 0, 0)})
    >>> posterior.parameter_names[:7]
    ('f_x3', 'g_y3', 'a.background', 'b.pointing_x', 'b.pointing_y', 'b.background', 'x_0')
    >>> bf.find_map(posterior, posterior.start()).at_maximum
    True
    """

    frames: Mapping[str, Posterior]
    members: Mapping[str, Ints]
    pointings: Mapping[str, tuple[float, ...]]
    pointing_sd: float | None
    turned: bool
    fixed: Mapping[str, float]
    prior: Mapping[str, Any]

    def __init__(
        self,
        frames: Mapping[str, Posterior],
        members: Mapping[str, npt.ArrayLike],
        pointings: Mapping[str, Sequence[float]],
        *,
        pointing_sd: float | None = None,
        turned: bool = False,
        fixed: Mapping[str, float] | None = None,
        prior: Mapping[str, Any] | None = None,
    ) -> None:
        check_frames(frames, members, pointings)
        self._set_fields(
            dict(frames),
            {name: np.array(members[name], dtype=np.int64) for name in frames},
            {name: tuple(float(value) for value in pointings[name]) for name in frames},
            pointing_sd,
            turned,
            dict(fixed or {}),
            {},
        )
        field = self.reference.model.polynomial.names
        if unknown := sorted(set(self.fixed) - set(field)):
            raise InputError(
                f"fixed: got {', '.join(unknown)}, expected names among {', '.join(field)}"
            )
        known = {}
        for k, (name, frame) in enumerate(self.frames.items()):
            for parameter, distribution in frame.prior.items():
                if parameter not in field:
                    known[f"{name}.{parameter}"] = distribution
                elif k == 0 and parameter not in self.fixed:
                    known[parameter] = distribution
        given = {name: each for name, each in (prior or {}).items() if name not in self.fixed}
        if unknown := sorted(set(given) - set(known)):
            raise InputError(
                f"prior: got {', '.join(unknown)}, expected names among {', '.join(known)}"
            )
        for name, distribution in given.items():
            priors.check(name, distribution)
        object.__setattr__(self, "prior", {n: given.get(n, p) for n, p in known.items()})

    @property
    def reference(self) -> Posterior:
        """The first frame."""
        return next(iter(self.frames.values()))

    @cached_property
    def layout(self) -> DitherLayout:
        """Where the parameters are in a vector, and what they say of every frame."""
        return DitherLayout(self.frames, self.members, self.pointings, self.turned, self.fixed)

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Coefficients, every frame's own parameters, then x and y of every source."""
        return self.layout.names

    def start(self) -> Floats:
        """Where a search may begin: no distortion, and positions from the frames' catalogues."""
        return self.layout.start()

    def likelihood(self, name: str, params: Floats) -> MovableLikelihood:
        """The likelihood of a frame with its sources where the parameters have them."""
        return self._movable[name].moved(self.layout.frame_positions(name, params))

    def log_prob(self, params: npt.ArrayLike) -> Any:
        """Log-posterior density up to a constant.

        Parameters
        ----------
        params : array_like, shape (d,) or (n, d)

        Returns
        -------
        float or ndarray, shape (n,)
            -inf outside the prior's support.

        Raises
        ------
        InputError
            If a parameter vector has another length.
        """
        vectors = self._vectors(params)
        prior = self.log_prior(vectors)
        wanted = np.isfinite(prior) & np.isfinite(vectors).all(axis=1)
        parts = np.full((len(self.frames), len(vectors)), -np.inf)

        def evaluate(i: int, n: int) -> None:
            name, vector = list(self.frames)[i], vectors[n]
            own = self.layout.frame_params(name, vector)[None]
            parts[i, n] = self.likelihood(name, vector).log_likelihood(own, np.ones(1, bool))[0]

        both = itertools.product(range(len(parts)), np.flatnonzero(wanted).tolist())
        _do([partial(evaluate, i, n) for i, n in both])
        out = parts.sum(axis=0)
        out = np.where(out > -np.inf, out + prior, out)
        out[np.isnan(prior)] = np.nan
        return float(out[0]) if np.ndim(params) == 1 else out

    def log_prior(self, params: npt.ArrayLike) -> Floats:
        """Log-density of the prior for parameter vectors of shape (n, d), flat ones left out."""
        mean, precision = self._pointing_prior
        off = self._vectors(params)[:, self._pointing_columns] - mean
        own = super().log_prior(params)
        return np.asarray(own - 0.5 * np.einsum("nk,kl,nl->n", off, precision, off))

    def prior_gradient(self, params: npt.ArrayLike) -> Floats:
        """Gradient of the prior's log-density, shape (d,); NaN outside its support."""
        out = super().prior_gradient(params)
        mean, precision = self._pointing_prior
        out[self._pointing_columns] -= precision @ (
            self._vector(params)[self._pointing_columns] - mean
        )
        return out

    def gradient(self, params: npt.ArrayLike) -> Floats:
        """Exact gradient of `log_prob`, shape (d,); NaN outside the prior's support."""
        vector, out = self._vector(params), self.prior_gradient(params)
        if np.isnan(out).any():
            return out
        found: dict[str, Floats] = {}

        def evaluate(name: str) -> None:
            own = self.layout.frame_params(name, vector)
            by_params, by_position = self.likelihood(name, vector).gradients(own)
            found[name] = np.append(by_params, by_position)

        _do([partial(evaluate, name) for name in self.frames])
        for name in self.frames:
            out += self.layout.change(name, vector).T @ found[name]
        return out

    def fisher(self, params: npt.ArrayLike) -> Matrix:
        """Information of the frames about all parameters, without the prior, fluxes eliminated.

        Returns
        -------
        sparse matrix, shape (d, d)
            See `movable` for what it neglects.
        """
        vector = self._vector(params)
        found: dict[str, Matrix] = {}

        def evaluate(name: str) -> None:
            own, change = self.layout.frame_params(name, vector), self.layout.change(name, vector)
            known = self.likelihood(name, vector).template_information(own)
            found[name] = change.T @ known @ change

        _do([partial(evaluate, name) for name in self.frames])
        return sum(found[name] for name in self.frames)

    def information(self, params: npt.ArrayLike) -> Floats:
        """Information of the frames plus the prior's curvature, shape (d, d)."""
        return np.asarray((self.fisher(params) + self.prior_information(params)).toarray())

    def prior_information(
        self, params: npt.ArrayLike, names: Sequence[str] | None = None
    ) -> Matrix:
        """Curvature of the prior where it is positive, sparse, shape (d, d).

        Parameters
        ----------
        params : array_like, shape (d,)
        names : sequence of str, optional
            Only of these parameters and of the pointings.
        """
        out = self.prior_curvature(params)
        if names is not None:
            out[[name not in names for name in self.parameter_names]] = 0.0
        pick = np.zeros((out.size, self._pointing_columns.size))
        pick[self._pointing_columns, np.arange(pick.shape[1])] = 1.0
        known = sparse.csr_matrix(pick) @ self._pointing_prior[1] @ pick.T
        return sparse.csr_matrix(known) + sparse.diags(out)

    def frame_posterior(self, name: str, params: Floats) -> Posterior:
        """An ordinary posterior of a frame, of a catalogue that is known.

        Parameters
        ----------
        name : str
        params : ndarray, shape (d,)
            They say where its sources are. `layout.frame_params` has its parameters.

        Returns
        -------
        Posterior
        """
        return replace(self.frames[name], model=self.likelihood(name, params).model)

    @cached_property
    def _movable(self) -> dict[str, MovableLikelihood]:
        return {n: MovableLikelihood.of(frame.likelihood) for n, frame in self.frames.items()}

    @cached_property
    def _pointing_columns(self) -> Ints:
        of_others = [part.pointing[:2] for part in self.layout.parts[1:]]
        return np.array(of_others, dtype=np.int64).ravel()

    @cached_property
    def _pointing_prior(self) -> tuple[Floats, Floats]:
        """Mean and precision of the pointings of all frames but the first."""
        given = np.array(list(self.pointings.values()))
        k = len(given)
        mean = given[1:, :2].ravel()
        if self.pointing_sd is None:
            return mean, np.zeros((mean.size, mean.size))
        turns = np.vstack([rotation(turn) for turn in given[:, 2]])  # sum R^T d = turns^T d
        return mean, ((np.eye(2 * k) - turns @ turns.T / k) / self.pointing_sd**2)[2:, 2:]


def _do(tasks: Sequence[Callable[[], None]]) -> None:
    """Do the tasks in as many threads as numba may use."""
    left: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
    for task in tasks:
        left.put(task)

    def work() -> None:
        while True:
            try:
                task = left.get_nowait()
            except queue.Empty:
                return
            task()

    share(work, len(tasks))
