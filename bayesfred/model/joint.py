r"""The posterior of several frames of one instrument: a prior times a likelihood for each frame.

Parameters of the lens and the detector are shared, phi; each frame i has its own, nu_i, such as
pose and background. Given phi the frames are independent,

    log p(phi, nu_1, ..., nu_k) = log prior + sum_i log L_i(A_i (phi, nu_i)),

where A_i picks the parameters of frame i, or adds a drift (`drift`). So gradient and information
are sums over frames, and the information is an arrowhead: no two frames' own parameters share an
entry. Given phi each nu_i can be found, drawn and judged by itself.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.serialize import serializable
from bayesfred.model import priors
from bayesfred.model.displacement_errors import DisplacementErrors
from bayesfred.model.drift import Drift, DriftColumn
from bayesfred.model.frame_density import FrameDensity
from bayesfred.model.frame_evaluator import FrameEvaluator, LocalFrames
from bayesfred.model.parameters import SCALES, Parameter
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import PsfErrors
from bayesfred.model.shared_parameters import (
    Part,
    agreed_priors,
    largest_displacements,
    lens_terms,
    require_names,
)


@serializable("joint_posterior")
@dataclass(frozen=True, eq=False, init=False)
class JointPosterior(FrameDensity):
    """Posterior of the parameters that several frames share and of each frame's own.

    Parameters
    ----------
    frames : mapping of str to Posterior
        By a name of letters, digits, underscores and hyphens. It may load a frame when asked.
    shared : sequence of str, optional
        Parameters that all frames have in common; by default the distortion's terms of degree 2
        and higher, which belong to the lens. They are named as they are, a frame's own parameters
        with the frame's name before them: `a.background`.
    prior : mapping of str to frozen scipy.stats distribution, optional
        By those names; the others are the frames' own. Frames that share a parameter have to agree
        about its prior.
    drift : Drift, optional
        Shared terms that change with time.
    psf_errors : PsfErrors, optional
        What the errors of the frames' measured PSFs add: see `optimize.joint_map`.
    displacement_errors : DisplacementErrors, optional
        What displacements that neighbouring sources of a frame have in common add.
    evaluator : FrameEvaluator, optional
        Where the frames are evaluated; by default in this process.

    Raises
    ------
    InputError
        If there is no frame, a name is unusable, a frame lacks a shared parameter, the frames do
        not agree about the meaning or the prior of one, or nothing is shared.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> frames = {
    ...     name: bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=k))
    ...     for k, name in enumerate("ab")}
    >>> joint = JointPosterior(frames)
    >>> joint.parameter_names
    ('f_ux', 'a.background', 'b.background')
    >>> bf.find_map(joint).at_maximum
    True
    """

    frames: Mapping[str, Posterior]
    shared: tuple[str, ...]
    prior: Mapping[str, Any]
    drift: Drift | None
    psf_errors: PsfErrors | None
    displacement_errors: DisplacementErrors | None = field(metadata={"since": 10})
    evaluator: FrameEvaluator = field(metadata={"stored": False})

    def __init__(
        self,
        frames: Mapping[str, Posterior],
        shared: Sequence[str] | None = None,
        *,
        prior: Mapping[str, Any] | None = None,
        drift: Drift | None = None,
        psf_errors: PsfErrors | None = None,
        displacement_errors: DisplacementErrors | None = None,
        evaluator: FrameEvaluator | None = None,
    ) -> None:
        require_names(frames)
        first = next(iter(frames.values()))
        common = lens_terms(first) if shared is None else tuple(dict.fromkeys(shared))
        given = agreed_priors(frames, common, prior or {})
        where = evaluator or LocalFrames(frames)
        self._set_fields(frames, common, {}, drift, psf_errors, displacement_errors, where)
        object.__setattr__(self, "prior", priors.with_defaults(given, self.parameters))
        for errors in (psf_errors, displacement_errors):
            if errors is not None:
                errors.require_names(self.parameter_names)

    @cached_property
    def parameters(self) -> tuple[Parameter, ...]:
        """The table of parameters: the shared ones, their drift, and those of every frame."""
        first = next(iter(self._tables.values()))
        named = {parameter.name: parameter for parameter in first}
        own = [
            replace(parameter, name=f"{name}.{parameter.name}")
            for name, table in self._tables.items()
            for parameter in table
            if parameter.name not in self.shared
        ]
        drifting = [column.parameter for column in self._drifts]
        return (*(named[name] for name in self.shared), *drifting, *own)

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of every parameter vector."""
        return tuple(parameter.name for parameter in self.parameters)

    @property
    def n_shared(self) -> int:
        """Number of parameters that no frame has to itself: the shared ones and their drift."""
        return len(self.shared) + len(self._drifts)

    @cached_property
    def scales(self) -> Flags:
        """Which parameters are scales of single frames, such as their model errors; shape (d,)."""
        scales = np.array([name.endswith(SCALES) for name in self.parameter_names])
        return scales & (np.arange(scales.size) >= self.n_shared)

    @cached_property
    def parts(self) -> tuple[Part, ...]:
        """Where every frame's parameters are."""
        place = {name: k for k, name in enumerate(self.parameter_names)}
        found = []
        for i, (name, table) in enumerate(self._tables.items()):
            is_own = np.array([parameter.name not in self.shared for parameter in table])
            columns = np.array(
                [
                    place[f"{name}.{parameter.name}" if own else parameter.name]
                    for parameter, own in zip(table, is_own, strict=True)
                ]
            )
            matrix = np.zeros((len(table), self.n_shared))
            matrix[~is_own, columns[~is_own]] = 1.0
            where = {parameter.name: k for k, parameter in enumerate(table)}
            for k, column in enumerate(self._drifts, start=len(self.shared)):
                matrix[where[column.term], k] = column.weights[i]
            found.append(Part(columns, columns[is_own], np.flatnonzero(is_own), matrix))
        return tuple(found)

    def part_of(self, name: str) -> Part:
        """Where the parameters of a frame are.

        Raises
        ------
        InputError
            If there is no such frame.
        """
        if name not in self.frames:
            raise InputError(f"frame: got {name!r}, expected one of {', '.join(self.frames)}")
        return self.parts[list(self.frames).index(name)]

    def frame(self, name: str) -> Posterior:
        """The posterior of a frame, with the priors and the added errors that it has here.

        Parameters
        ----------
        name : str

        Raises
        ------
        InputError
            If there is no such frame.
        """
        self.part_of(name)
        frame = self.frames[name]
        prior = {
            each: self.prior[each if each in self.shared else f"{name}.{each}"]
            for each in frame.parameter_names
        }
        errors = frame.psf_errors
        if self.psf_errors is not None:
            covariance = self.frame_covariance(name, self.psf_errors.covariance)
            own = (errors.absorbed, errors.occam) if errors else ()
            errors = PsfErrors(frame.parameter_names, covariance, *own)
        moved = frame.displacement_errors
        if self.displacement_errors is not None:
            covariance = self.frame_covariance(name, self.displacement_errors.covariance)
            field = moved.field if moved else None
            moved = DisplacementErrors(frame.parameter_names, covariance, *(field or ()))
        return replace(frame, prior=prior, psf_errors=errors, displacement_errors=moved)

    def frame_params(self, name: str, params: npt.ArrayLike) -> Floats:
        """The parameters of a frame's own posterior.

        Parameters
        ----------
        name : str
        params : array_like, shape (d,) or (n, d)

        Returns
        -------
        ndarray, shape (d_i,) or (n, d_i)

        Raises
        ------
        InputError
            If there is no such frame.
        """
        return self._frame_params(self.part_of(name), np.asarray(params, dtype=np.float64))

    def frame_covariance(self, name: str, covariance: Floats) -> Floats:
        """The covariance of a frame's parameters, from that of all."""
        part, p = self.part_of(name), self.n_shared
        change = np.zeros((part.columns.size, p + part.own.size))
        change[:, :p] = part.matrix
        change[part.places, p + np.arange(part.own.size)] = 1.0
        columns = [*range(p), *part.own]
        return np.asarray(change @ covariance[np.ix_(columns, columns)] @ change.T)

    def start(self) -> Floats:
        """Parameters to begin a search from, those of every frame's table."""
        return np.array([parameter.start for parameter in self.parameters])

    def log_prob(self, params: npt.ArrayLike) -> Any:
        """Log-posterior density up to the evidence; the likelihood is normalised.

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
        out = self.log_parts(vectors).sum(axis=0)
        return float(out[0]) if np.ndim(params) == 1 else out

    def log_parts(self, vectors: Floats, wanted: Flags | None = None) -> Floats:
        """The log-posterior in parts: one a frame, and the prior of what no frame has to itself.

        Parameters
        ----------
        vectors : ndarray, shape (n, d)
        wanted : ndarray of bool, shape (k,), optional
            Frames to evaluate, all if not given; the others' parts are -inf.

        Returns
        -------
        ndarray, shape (k + 1, n)
            A frame's likelihood times the prior of its own parameters; then the rest of the prior.
        """
        prior = np.array([density(vectors[:, columns]) for columns, density in self._log_priors])
        some = np.ones(len(self.parts), bool) if wanted is None else wanted
        admitted = (prior > -np.inf).all(axis=0) & some[:, None]
        out = self.evaluator.log_likelihood(
            [self._frame_params(part, vectors) for part in self.parts], admitted
        )
        return np.concatenate([np.where(out > -np.inf, out + prior[:-1], out), prior[-1:]])

    def gradient(self, params: npt.ArrayLike) -> Floats:
        """Exact gradient of `log_prob`, shape (d,); NaN outside the prior's support."""
        vector = self._vector(params)
        out = self.prior_gradient(vector)
        for part, (slope, _) in zip(self.parts, self.derivatives(vector), strict=True):
            out[: self.n_shared] += part.matrix.T @ slope
            out[part.own] += slope[part.places]
        return out

    def fisher(self, params: npt.ArrayLike) -> Floats:
        """Fisher information about the parameters, shape (d, d), without the prior."""
        return self.assembled([each[1] for each in self.derivatives(params)])

    def assembled(self, matrices: Sequence[Floats]) -> Floats:
        """The sum over frames of matrices of their parameters, each (d_i, d_i), as one (d, d)."""
        p = self.n_shared
        out = np.zeros((self.n_parameters, self.n_parameters))
        for part, matrix in zip(self.parts, matrices, strict=True):
            through = part.matrix.T @ matrix
            out[:p, :p] += through @ part.matrix
            out[:p, part.own] = through[:, part.places]
            out[part.own, :p] = through[:, part.places].T
            out[np.ix_(part.own, part.own)] = matrix[np.ix_(part.places, part.places)]
        return out

    def derivatives(self, params: npt.ArrayLike) -> list[tuple[Floats, Floats]]:
        """Gradient and Fisher information of every frame by its own parameters.

        Those of the last parameters are kept: a search asks for the two one after the other.
        """
        vector = self._vector(params)
        key, kept = vector.tobytes(), self._kept
        if not kept or kept[0][0] != key:
            vectors = [self._frame_params(part, vector) for part in self.parts]
            kept[:] = [(key, self.evaluator.derivatives(vectors))]
        return kept[0][1]

    def near(self, params: Floats, covariance: Floats) -> "JointPosterior":
        """The same posterior, faster around `params` where fluxes are free: `Posterior.near`."""
        vectors = [self._frame_params(part, params) for part in self.parts]
        covariances = [self.frame_covariance(name, covariance) for name in self.frames]
        return self.with_evaluator(self.evaluator.near(vectors, covariances))

    def with_evaluator(self, evaluator: FrameEvaluator) -> "JointPosterior":
        """The same posterior, whose frames are evaluated elsewhere."""
        return replace(self, evaluator=evaluator)

    @cached_property
    def _tables(self) -> dict[str, tuple[Parameter, ...]]:
        """The table of every frame's parameters."""
        return {name: frame.parameters for name, frame in self.frames.items()}

    @cached_property
    def _drifts(self) -> list[DriftColumn]:
        """The parameters of the drift."""
        if self.drift is None:
            return []
        first = next(iter(self.frames.values()))
        named = {p.name: p for p in first.parameters if p.name in self.shared}
        largest = largest_displacements(first, self.shared)
        return self.drift.columns(list(self.frames), named, largest)

    @cached_property
    def _log_priors(self) -> list[tuple[Ints, Any]]:
        """The prior of every frame's own parameters, and that of the others, with their columns."""
        every, found = list(self.prior), []
        for columns in (*(part.own for part in self.parts), np.arange(self.n_shared)):
            some = {every[k]: self.prior[every[k]] for k in columns}
            found.append((columns, priors.log_density(some)))
        return found

    @cached_property
    def _kept(self) -> list[tuple[bytes, list[tuple[Floats, Floats]]]]:
        return []

    def _frame_params(self, part: Part, vectors: Floats) -> Floats:
        out = vectors[..., part.columns]
        for k in range(len(self.shared), self.n_shared):
            # one after the other, so that a vector has the same bits in any number of vectors
            for j in np.flatnonzero(part.matrix[:, k]):
                out[..., j] += part.matrix[j, k] * vectors[..., k]
        return np.ascontiguousarray(out)
