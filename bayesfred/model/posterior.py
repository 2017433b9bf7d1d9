"""The posterior of a field distortion: prior times likelihood of a frame, as functions of a parameter vector.

Parameters are the distortion coefficients, the background and whatever `Nuisances` leaves free. The
likelihood and its derivatives are in `kernels`; `estimate.py` finds the maximum, `sampling.py`
draws.
"""

import copy
import os
import queue
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar, Literal, get_args

import numba
import numpy as np
import numpy.typing as npt

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.contexts import SEGMENT, Basis, Optics, SourceNuisances, stride
from bayesfred.imaging.kernels.render import render as render_sources
from bayesfred.model import priors
from bayesfred.model.extrapolation import FluxExtrapolation, flux_extrapolation
from bayesfred.model.kernels.contexts import (
    LIMIT,
    MASKED,
    Frame,
    Parameters,
    Problem,
    Rendered,
    Turns,
    Vectors,
    Workspace,
    parameters_of,
)
from bayesfred.model.kernels.evaluate import log_likelihoods, render
from bayesfred.model.kernels.fisher import fisher
from bayesfred.model.kernels.gradient import gradient
from bayesfred.model.kernels.likelihood import clear, new_workspace
from bayesfred.model.noise import Noise, PoissonNoise, read_noise_model

FluxMode = Literal["fixed", "scale", "free"]

BACKGROUND_TERMS = (
    "background",
    "background_u",
    "background_v",
    "background_u2",
    "background_uv",
    "background_v2",
)
SOURCE_NUISANCES = SourceNuisances._fields

_pool: ThreadPoolExecutor | None = None


def _threads() -> ThreadPoolExecutor:
    """The threads that share an ensemble's walkers with the calling one; their number follows numba's setting."""
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, "bayesfred")
    return _pool


def _forget_threads() -> None:
    global _pool
    _pool = None


os.register_at_fork(after_in_child=_forget_threads)


@contextmanager
def one_thread() -> Iterator[None]:
    """Evaluate ensembles in the calling thread alone: for work of which every core does its own."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


@dataclass(frozen=True)
class Nuisances:
    """What else is unknown beside the distortion and a constant background.

    Parameters
    ----------
    flux : {"fixed", "scale", "free"}
        Catalogue fluxes are exact; or right but for a common factor, the parameter `flux_scale`; or
        each is free. Free fluxes are not sampled: the likelihood takes its maximum over them, with
        the Laplace term, under a prior Gamma(2) whose mean is the catalogue's flux.
    offset : bool
        Whether the pointing is unknown: parameters `offset_x`, `offset_y`, pixel, added to every
        source's position.
    psf_sigma : bool
        Whether the PSF's width is unknown: parameter `psf_sigma`, pixel, the `sigma` that a PSF of
        any kind has.
    background_order : {0, 1, 2}
        Degree of the background polynomial in u and v, which run from -1 to 1 over the frame:
        parameters `background`, then `background_u`, `background_v`, then `background_u2`,
        `background_uv`, `background_v2`, counts per pixel.
    footprint : float or None, pixel
        Only pixels within this distance of a catalogue position enter the likelihood; for frames
        with sources that the catalogue lacks.
    position_scatter : bool
        Whether the sources lie off their catalogue positions, by normal errors of unknown standard
        deviation along each axis: parameter `position_scatter`, pixel, as imaged. Needs free
        fluxes. Like these, the shifts are not sampled.

    Raises
    ------
    InputError
        If a value is not one of those listed, or positions scatter with fluxes that are not free.

    Examples
    --------
    >>> Nuisances(flux="scale", offset=True).names
    ('flux_scale', 'offset_x', 'offset_y')
    """

    flux: FluxMode = "fixed"
    offset: bool = False
    psf_sigma: bool = False
    background_order: int = 0
    footprint: float | None = None
    position_scatter: bool = False

    def __post_init__(self) -> None:
        if self.flux not in get_args(FluxMode):
            raise InputError(
                f"nuisances: flux: got {self.flux!r}, expected one of "
                f"{', '.join(get_args(FluxMode))}"
            )
        if self.background_order not in (0, 1, 2):
            raise InputError(
                f"nuisances: background_order: got {self.background_order!r}, expected 0, 1 or 2"
            )
        if self.footprint is not None and not (np.isfinite(self.footprint) and self.footprint > 0):
            raise InputError(
                f"nuisances: footprint: got {self.footprint}, expected a radius in pixels > 0"
            )
        if self.position_scatter and self.flux != "free":
            raise InputError(
                f"nuisances: position_scatter: got it with {self.flux} fluxes, expected free "
                "ones: set flux to free"
            )

    @property
    def source_names(self) -> tuple[str, ...]:
        """The nuisance parameters that act on the sources."""
        free = (
            self.flux == "scale",
            self.offset,
            self.offset,
            self.psf_sigma,
            self.position_scatter,
        )
        return tuple(name for name, is_free in zip(SOURCE_NUISANCES, free, strict=True) if is_free)

    @property
    def background_names(self) -> tuple[str, ...]:
        """The coefficients of the background polynomial."""
        return BACKGROUND_TERMS[: (1, 3, 6)[self.background_order]]

    @property
    def profiled(self) -> int:
        """Numbers of every source that are not sampled: flux, and shift along u and v."""
        return 3 if self.position_scatter else int(self.flux == "free")

    @property
    def names(self) -> tuple[str, ...]:
        """All nuisance parameters but the constant background."""
        return (*self.source_names, *self.background_names[1:])

    def write(self, group: Any) -> None:
        """Store the choices in an HDF5 group."""
        for f in fields(self):
            value = getattr(self, f.name)
            group.attrs[f.name] = (
                0.0 if value is None else np.bytes_(value) if isinstance(value, str) else value
            )

    @classmethod
    def read(cls, group: Any) -> "Nuisances":
        """The choices stored in an HDF5 group by `write`."""
        a = group.attrs
        footprint = float(a["footprint"]) or None
        flux: Any = bytes(a["flux"]).decode()
        order, scatter = int(a["background_order"]), bool(a["position_scatter"])
        return cls(flux, bool(a["offset"]), bool(a["psf_sigma"]), order, footprint, scatter)


def _usable(
    model: ForwardModel,
    counts: Floats,
    mask: npt.ArrayLike | None,
    noise: Noise,
    nuisances: Nuisances,
) -> Flags:
    """The pixels for the likelihood, after checking that the frame can be explained at all."""
    shape = model.detector.shape
    used = np.ones(shape, bool) if mask is None else np.array(mask, dtype=bool)
    for name, array in (("counts", counts), ("mask", used)):
        if array.shape != shape:
            raise InputError(f"{name}: got shape {array.shape}, expected the detector's {shape}")
    ny, nx = model.detector.fine_shape
    sources = model.sources
    if not np.any((np.abs(sources.x) <= 0.5 * nx) & (np.abs(sources.y) <= 0.5 * ny)):
        raise InputError(
            f"catalogue: got {len(sources)} sources, all outside the frame of {nx} x {ny} pixels, "
            "expected positions in pixels "
            "from the frame's middle: check the columns, their unit and their origin"
        )
    if nuisances.footprint is not None:
        used &= _footprint(model, nuisances.footprint)
    if not used.any():
        raise InputError(
            "counts: every pixel is masked, expected pixels to fit: check the mask and the "
            "footprint"
        )
    n_bad = int(np.sum(used & ~np.isfinite(counts)))
    if n_bad:
        raise InputError(
            f"counts: got {n_bad} pixels that are not finite, expected numbers: mask them"
        )
    noise.check(counts, used, nuisances.flux, nuisances.background_order)
    return used


def _footprint(model: ForwardModel, radius: float) -> Flags:
    """Pixels within `radius` of a source's catalogue position."""
    u, v = model.detector.pixel_centres()
    inside = np.zeros((v.size, u.size), bool)
    for x, y in zip(model.sources.x, model.sources.y, strict=True):
        across, along = np.abs(u - x) <= radius, np.abs(v - y) <= radius
        inside[np.ix_(along, across)] |= (u[across] - x) ** 2 + (
            v[along, None] - y
        ) ** 2 <= radius**2
    return inside


def _square(background: Floats) -> Floats:
    """The background's coefficients of 1, u, v, u^2, uv, v^2 as a matrix [power of u, power of v]."""
    b = background
    return np.array([[b[0], b[2], b[5]], [b[1], b[4], 0.0], [b[3], 0.0, 0.0]])


@dataclass(frozen=True, eq=False, init=False)
class Posterior:
    """Posterior of distortion, background and nuisances given a frame.

    Parameters
    ----------
    model : ForwardModel
    counts : array_like, shape (ny, nx), counts
    prior : mapping of str to frozen scipy.stats distribution, optional
        By parameter name; the others get `priors.default_prior`. Parameters are independent a
        priori. A distortion that leaves a source without an image, or folds the frame (D <= 0)
        within two of the PSF's widths of one, has probability zero.
    noise : Noise
        `PoissonNoise`, `GaussianNoise`, `BackgroundNoise` or a model of your own.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is to be used.
    nuisances : Nuisances

    Attributes
    ----------
    counts : ndarray, shape (ny, nx), counts; 0 where not finite
    mask : ndarray of bool, shape (ny, nx)
        Pixels in the likelihood: those asked for, within the footprint.

    Raises
    ------
    InputError
        If the frame does not fit the detector, holds values that no noise model explains, every
        pixel is masked, no source lies in the frame, or a prior is unusable.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> posterior.parameter_names
    ('f_ux', 'background')
    """

    model: ForwardModel
    counts: Floats
    prior: Mapping[str, Any]
    noise: Noise
    mask: Flags
    nuisances: Nuisances

    _extrapolation: ClassVar[FluxExtrapolation | None] = None

    def __init__(
        self,
        model: ForwardModel,
        counts: npt.ArrayLike,
        *,
        prior: Mapping[str, Any] | None = None,
        noise: Noise = PoissonNoise(),
        mask: npt.ArrayLike | None = None,
        nuisances: Nuisances = Nuisances(),
    ) -> None:
        frame = np.array(counts, dtype=np.float64)
        used = _usable(model, frame, mask, noise, nuisances)
        for name, value in (
            ("model", model),
            ("counts", np.where(np.isfinite(frame), frame, 0.0)),
            ("noise", noise),
            ("mask", used),
            ("nuisances", nuisances),
        ):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "prior", self._complete(dict(prior or {})))

    def _complete(self, given: dict[str, Any]) -> dict[str, Any]:
        """The given priors checked, the default ones added."""
        unknown = sorted(set(given) - set(self.parameter_names))
        if unknown:
            raise InputError(
                f"prior: got {', '.join(unknown)}, expected names among "
                f"{', '.join(self.parameter_names)}"
            )
        for name, distribution in given.items():
            priors.check(name, distribution)
        return {name: given.get(name) or self.default_prior(name) for name in self.parameter_names}

    def default_prior(self, name: str) -> Any:
        """The prior that a parameter has unless another is given."""
        m = self.model
        return priors.default_prior(name, m.distortion, m.detector, self._level, m.psf.sigma)

    @cached_property
    def _level(self) -> float:
        """Mean counts per pixel, at least one in the frame."""
        return max(float(np.mean(self.counts[self.mask])), 1.0 / float(self.mask.sum()))

    @cached_property
    def parameter_names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of every parameter vector."""
        return (*self.model.distortion.names, "background", *self.nuisances.names)

    @property
    def n_parameters(self) -> int:
        """Length of a parameter vector."""
        return len(self.parameter_names)

    def log_prob(self, params: npt.ArrayLike) -> Any:
        """Log-posterior density up to the evidence; the likelihood is normalised.

        Parameters
        ----------
        params : array_like, shape (d,) or (n, d)

        Returns
        -------
        float or ndarray, shape (n,)
            -inf outside the prior's support, and where the arithmetic gives NaN or +inf.

        Raises
        ------
        InputError
            If a parameter vector has another length.
        """
        values = self.unchecked_log_prob(self._vectors(params))
        values[~(values < np.inf)] = -np.inf
        return float(values[0]) if np.ndim(params) == 1 else values

    def unchecked_log_prob(self, vectors: Floats) -> Floats:
        """`log_prob` of vectors of shape (n, d) as the arithmetic gives it, with its NaN and +inf."""
        prior = self.log_prior(vectors)
        out = np.where(np.isnan(prior), -np.inf, prior)
        arguments = self._arguments(vectors)
        extrapolated = self._extrapolation and self._extrapolation.at(vectors)
        turns = Turns(np.zeros(1, np.int64), out)

        def evaluate() -> None:
            with self._workspace() as w:
                log_likelihoods(self._problem, w, arguments, extrapolated, turns)

        helpers = [
            _threads().submit(evaluate)
            for _ in range(min(numba.get_num_threads(), len(vectors)) - 1)
        ]
        evaluate()
        for helper in helpers:
            helper.result()
        out += np.where(np.isfinite(out), prior + self._constant, 0.0)
        out[np.isnan(prior)] = np.nan
        return out

    def near(self, params: Floats, covariance: Floats) -> "Posterior":
        """The same posterior, with a `log_prob` that is several times faster around `params` where fluxes are free.

        It extrapolates the most likely fluxes from those at `params`. Where that fails it looks for
        them as usual; values differ by rounding and at most 5e-5, by some 1e-6 within a few
        standard deviations.

        Parameters
        ----------
        params : ndarray, shape (d,)
        covariance : ndarray, shape (d, d)
            How far around.

        Returns
        -------
        Posterior

        Raises
        ------
        InputError
            If there are more or fewer parameters than the posterior has.

        Examples
        --------
        >>> import bayesfred as bf
        >>> model = bf.ForwardModel(
        ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
        ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
        >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1), nuisances=bf.Nuisances("free"))
        >>> best = bf.find_map(posterior)
        >>> near = posterior.near(best.params, best.covariance)
        >>> bool(abs(near.log_prob(best.params) - posterior.log_prob(best.params)) < 1e-6)
        True
        """
        if self.nuisances.profiled != 1:
            return self
        out = np.zeros(self._basis.row.size), np.zeros(6)
        with self._rendered(self._vectors(params)) as (w, rendered, parameters):
            slope, z = gradient(self._problem, w, rendered, parameters, self._basis, out)
        close = copy.copy(self)
        if np.isfinite(slope):
            object.__setattr__(
                close,
                "_extrapolation",
                flux_extrapolation(self.fluxes, rendered, z[:, 0], params, covariance),
            )
        return close

    def log_prior(self, params: npt.ArrayLike) -> Floats:
        """Log-density of the prior for parameter vectors of shape (n, d)."""
        return self._log_prior(self._vectors(params))

    @cached_property
    def support(self) -> tuple[Floats, Floats]:
        """The least and the largest value that the prior admits of every parameter, shape (d,) each."""
        low, high = np.array([distribution.support() for distribution in self.prior.values()]).T
        return low, high

    def gradient(self, params: npt.ArrayLike) -> Floats:
        """Exact gradient of `log_prob`, shape (d,); NaN outside the prior's support."""
        vector = self._vectors(params)[0]
        if not np.isfinite(self.log_prior(vector)[0]):
            return np.full(vector.size, np.nan)
        sources, background = np.zeros(self._basis.row.size), np.zeros(6)
        with self._rendered(vector[None]) as (w, rendered, parameters):
            out = sources, background
            slope, _ = gradient(self._problem, w, rendered, parameters, self._basis, out)
        if np.isnan(slope):
            return np.full(vector.size, np.nan)
        terms = len(self.nuisances.background_names)
        scatter = [slope] if self.nuisances.position_scatter else []
        slopes = np.concatenate([sources, scatter, background[:terms]])[self._order]
        if self.nuisances.flux == "scale":
            slopes[self.parameter_names.index("flux_scale")] /= parameters.nuisances.flux_scale
        slopes += [priors.slope(p, x)[0] for p, x in zip(self.prior.values(), vector, strict=True)]
        return slopes

    def fisher(self, params: npt.ArrayLike) -> Floats:
        """Fisher information of the frame about the parameters, free fluxes profiled out; without the prior.

        Returns
        -------
        ndarray, shape (d, d); NaN outside the prior's support
        """
        vector = self._vectors(params)[0]
        if not np.isfinite(self.log_prior(vector)[0]):
            return np.full((vector.size, vector.size), np.nan)
        size = self._basis.row.size + len(self.nuisances.background_names)
        out = np.zeros((size, size))
        with self._rendered(vector[None]) as (w, rendered, parameters):
            known = fisher(self._problem, w, rendered, parameters, self._basis, out)
        if np.isnan(known):
            return np.full((vector.size, vector.size), np.nan)
        if (
            self.nuisances.position_scatter
        ):  # independent of the others: it is known by the shifts' size alone
            k = self._basis.row.size
            out = np.insert(np.insert(out, k, 0.0, axis=0), k, 0.0, axis=1)
            out[k, k] = known
        if self.nuisances.flux == "scale":
            k = len(self.model.distortion.names)
            out[k] /= parameters.nuisances.flux_scale
            out[:, k] /= parameters.nuisances.flux_scale
        return out[np.ix_(self._order, self._order)]

    def information(self, params: npt.ArrayLike, fisher: Floats | None = None) -> Floats:
        """Fisher information, if not given, plus the prior's curvature: the inverse is the Laplace approximation's covariance."""
        vector = self._vectors(params)[0]
        curvature = [
            max(priors.slope(p, x)[1], 0.0)
            for p, x in zip(self.prior.values(), vector, strict=True)
        ]
        return (self.fisher(vector) if fisher is None else fisher) + np.diag(curvature)

    def simulate(self, params: npt.ArrayLike, rng: np.random.Generator) -> Floats | None:
        """Draw a frame given the parameters; what is not sampled, free fluxes and the sources' shifts, is drawn from its prior.

        Returns
        -------
        ndarray, shape (ny, nx), counts
            None where the posterior would have no density: a source is folded or has no image, or
            expected counts are negative.
        """
        vector = self._vectors(params)[0]
        theta, nuisances, background = parameters_of(self._arguments(vector[None]), 0)
        flux = (
            nuisances.flux_scale * self._flux
            if not self._free
            else self._flux * rng.gamma(2.0, 0.5, self._flux.size)
        )
        ny, nx = self.model.detector.shape
        optics, out = self._optics, np.zeros(ny * stride(nx))
        at_rest = nuisances._replace(position_scatter=0.0)
        unfolded = render_sources(optics, theta, at_rest, flux, out)
        # a shift is as imaged: it moves the image, and leaves the distortion that of the
        # catalogue's position
        if nuisances.position_scatter:
            by_x, by_y = nuisances.position_scatter * rng.standard_normal((2, flux.size))
            out[:] = 0.0
            moved = optics._replace(x=optics.x + by_x, y=optics.y + by_y)
            render_sources(moved, theta, at_rest, flux, out)
        sources, level = (
            out.reshape(ny, -1)[:, :nx],
            self._polynomial(background) - self.noise.shift,
        )
        if not (unfolded and np.all((sources + level)[self.mask] >= 0.0)):
            return None
        return self.noise.draw(sources, np.maximum(level, -sources), rng)

    def expected_counts(self, params: npt.ArrayLike) -> Floats:
        """Expected counts of every pixel, free fluxes at their most likely values; NaN where a map folds.

        Returns
        -------
        ndarray, shape (ny, nx), counts per pixel
        """
        return self._expected(params)[0]

    def sigma(self, params: npt.ArrayLike) -> Floats:
        """Standard deviation of every pixel's counts under the noise model, shape (ny, nx)."""
        level = self._vectors(params)[0][self.parameter_names.index("background")]
        return np.asarray(self.noise.fisher_weight(self.expected_counts(params), level) ** -0.5)

    def fluxes(self, params: npt.ArrayLike) -> Floats:
        """Flux of every source, counts: the catalogue's, scaled, or the most likely ones."""
        return self._expected(params)[1]

    def _expected(self, params: npt.ArrayLike) -> tuple[Floats, Floats]:
        vector = self._vectors(params)[0]
        ny, nx = self.model.detector.shape
        with self._rendered(vector[None]) as (w, rendered, parameters):
            sources = w.image.reshape(ny, -1)[:, :nx].copy()
        bad = 0.0 if rendered.extra > -np.inf else np.nan
        level = self._polynomial(parameters.background) - self.noise.shift
        return sources + level + bad, rendered.fluxes + bad

    def _polynomial(self, background: Floats) -> Floats:
        """The background polynomial at every pixel."""
        u, v = (np.arange(1 - n, n, 2) / n for n in self.model.detector.shape[::-1])
        order = self.nuisances.background_order + 1
        return np.asarray(
            np.polynomial.polynomial.polygrid2d(u, v, _square(background)[:order, :order]).T
        )

    def start(self) -> Floats:
        """Parameters to begin a search from: no distortion, the frame's median as background, nuisances as given."""
        median = float(np.median(self.counts[self.mask]))
        level = median if median > 0 else max(0.1 * float(np.mean(self.counts[self.mask])), 1e-6)
        sigma = self.model.psf.sigma
        known = {
            "background": level,
            "flux_scale": 1.0,
            "psf_sigma": sigma,
            "position_scatter": 0.1 * sigma,
        }
        return np.array([known.get(name, 0.0) for name in self.parameter_names])

    def _vectors(self, params: npt.ArrayLike) -> Floats:
        vectors = np.atleast_2d(np.asarray(params, dtype=np.float64))
        if vectors.ndim != 2 or vectors.shape[1] != self.n_parameters:
            raise InputError(
                f"params: got shape {np.shape(params)}, expected ({self.n_parameters},) or (n, "
                f"{self.n_parameters}) for " + ", ".join(self.parameter_names)
            )
        return vectors

    def _arguments(self, vectors: Floats) -> Vectors:
        """Distortion coefficients, source nuisances and background coefficients, one row a parameter vector."""
        nuisances = np.zeros((len(vectors), len(SOURCE_NUISANCES)))
        background = np.zeros((len(vectors), len(BACKGROUND_TERMS)))
        nuisances[:, SOURCE_NUISANCES.index("flux_scale")] = 1.0
        nuisances[:, SOURCE_NUISANCES.index("psf_sigma")] = self.model.psf.sigma
        for values, names in ((nuisances, SOURCE_NUISANCES), (background, BACKGROUND_TERMS)):
            for k, name in enumerate(names):
                if name in self.parameter_names:
                    values[:, k] = vectors[:, self.parameter_names.index(name)]
        background[:, 0] += self.noise.shift
        theta = np.ascontiguousarray(vectors[:, : self.model.distortion.n_terms])
        return Vectors(theta, nuisances, background)

    @contextmanager
    def _workspace(self) -> Iterator[Workspace]:
        """A workspace that no other thread uses meanwhile."""
        try:
            workspace = self._workspaces.get_nowait()
        except queue.Empty:
            typical = parameters_of(self._arguments(self.start()[None]), 0).nuisances
            workspace = new_workspace(self._optics, typical, self._free)
        yield workspace
        self._workspaces.put(workspace)

    @contextmanager
    def _rendered(self, vectors: Floats) -> Iterator[tuple[Workspace, Rendered, Parameters]]:
        """A workspace in which the sources are rendered, for one parameter vector."""
        parameters = parameters_of(self._arguments(vectors), 0)
        with self._workspace() as w:
            yield w, render(self._problem, w, parameters), parameters
            clear(w)

    @cached_property
    def _workspaces(self) -> "queue.SimpleQueue[Workspace]":
        return queue.SimpleQueue()

    @cached_property
    def _order(self) -> list[int]:
        """Where each parameter stands among source parameters followed by background coefficients."""
        kernel = (
            *self.model.distortion.names,
            *self.nuisances.source_names,
            *self.nuisances.background_names,
        )
        return [kernel.index(name) for name in self.parameter_names]

    @cached_property
    def _log_prior(self) -> Callable[[Floats], Floats]:
        return priors.log_density(self.prior)

    @cached_property
    def _optics(self) -> Optics:
        narrowest = self.prior["psf_sigma"].ppf(1e-6) if self.nuisances.psf_sigma else None
        return self.model.optics(narrowest)

    @cached_property
    def _basis(self) -> Basis:
        return self.model.basis(
            [name for name in self.nuisances.source_names if name != "position_scatter"]
        )

    @property
    def _flux(self) -> Floats:
        return self.model.sources.flux

    @property
    def _free(self) -> Literal[True] | None:
        return (
            True if self.nuisances.flux == "free" else None
        )  # what None leaves out is not compiled

    @cached_property
    def _problem(self) -> Problem:
        return Problem(self._optics, self._frame, self._flux, self._free)

    @cached_property
    def _frame(self) -> Frame:
        ny, nx = self.model.detector.shape
        values = np.full((ny, stride(nx)), MASKED)
        values[:, :nx] = np.where(self.mask, self.counts + self.noise.shift, MASKED)
        used = (values > LIMIT).reshape(-1, SEGMENT)
        total = np.where(used, values.reshape(-1, SEGMENT), 0.0).sum(axis=1)
        noise, varies = self.noise.terms(values), self.nuisances.background_order > 0
        return Frame(
            values.ravel(), used.sum(axis=1).astype(float), total, float(used.sum()),
            float(total.sum()), ny, nx, noise, varies,
            everywhere=varies or not hasattr(noise, "unreached"),
        )  # fmt: skip

    @cached_property
    def _constant(self) -> float:
        """The part of the log-likelihood that depends on the counts alone."""
        return self.noise.constant(self.counts, self.mask)

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def write(self, group: Any) -> None:
        """Store frame, mask, model, noise, nuisances and priors in an HDF5 group."""
        group.create_dataset("counts", data=self.counts, fletcher32=True)
        group.create_dataset("mask", data=self.mask, fletcher32=True)
        for name in ("model", "noise", "nuisances"):
            getattr(self, name).write(group.create_group(name))
        priors.write(self.prior, group.create_group("prior"))

    @classmethod
    def read(cls, group: Any) -> "Posterior":
        """The posterior stored in an HDF5 group by `write`."""
        return cls(
            ForwardModel.read(group["model"]),
            group["counts"][()],
            prior=priors.read(group["prior"]),
            noise=read_noise_model(group["noise"]),
            mask=group["mask"][()],
            nuisances=Nuisances.read(group["nuisances"]),
        )
