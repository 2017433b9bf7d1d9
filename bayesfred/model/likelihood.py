"""The likelihood of one frame, with its derivatives, as functions of a parameter vector.

Here the table of parameters meets the compiled loops of `kernels`: a parameter vector becomes their
arguments, and what they differentiate by becomes parameters again, through one linear map. Each
thread evaluates in a workspace of its own, which is kept for the next call.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.contexts import Basis, Optics, stride
from bayesfred.imaging.kernels.render import render as render_sources
from bayesfred.model.buffers import NOTHING, LastProfiled, Workspaces, new_turns
from bayesfred.model.extrapolation import Extrapolation, extrapolate
from bayesfred.model.kernels.clusters import DOF
from bayesfred.model.kernels.contexts import (
    Evaluation,
    Frame,
    Parameters,
    Problem,
    Turns,
    Vectors,
    parameters_of,
)
from bayesfred.model.kernels.evaluate import log_likelihoods, render
from bayesfred.model.kernels.fisher import fisher
from bayesfred.model.kernels.gradient import from_sources, gradient, room_for
from bayesfred.model.kernels.likelihood import clear, new_workspace
from bayesfred.model.kernels.sources import OwnPixels, own_pixels
from bayesfred.model.near_mean import Around, problem_near
from bayesfred.model.noise import Noise, with_model_error
from bayesfred.model.parameters import (
    BACKGROUND_TERMS,
    SCALES,
    SOURCE_NUISANCES,
    Nuisances,
    Parameter,
    chain_rule,
    displacing,
)
from bayesfred.model.pixels import (
    Expected,
    counts_constant,
    faint_fluxes,
    padded_frame,
    polynomial_background,
)
from bayesfred.model.psf_errors import OccamFactor
from bayesfred.model.threads import share


@dataclass(frozen=True, eq=False)
class FrameLikelihood:
    """Likelihood of a frame of counts given distortion, background and nuisances.

    Parameters
    ----------
    model : ForwardModel
    counts : ndarray, shape (ny, nx), counts; finite
    noise : Noise
    mask : ndarray of bool, shape (ny, nx)
        Pixels in the likelihood.
    nuisances : Nuisances
    parameters : tuple of Parameter
        The table, in the order of every parameter vector.
    narrowest : float, optional, pixel
        Width of the narrowest PSF for which pixels have to be integrated well.
    extrapolation : FluxExtrapolation, ShiftExtrapolation or Around, optional
        What `near` knows of the parameters around which the likelihood is evaluated.
    occam : OccamFactor, optional
        What a PSF that was measured on the frame says of the model error.
    """

    model: ForwardModel
    counts: Floats
    noise: Noise
    mask: Flags
    nuisances: Nuisances
    parameters: tuple[Parameter, ...]
    narrowest: float | None = None
    extrapolation: Extrapolation | Around | None = None
    occam: OccamFactor | None = None

    def log_likelihood(self, vectors: Floats, wanted: Flags) -> Floats:
        """Log-likelihood of n vectors, shape (n, d), in as many threads as numba may use.

        It is -inf where it is not `wanted`, shape (n,), or where the distortion has no density.
        """
        out = np.where(wanted, 0.0, -np.inf)
        arguments, rows = self._arguments(vectors), np.arange(len(vectors))
        if isinstance(self.extrapolation, Extrapolation):
            self._evaluate(arguments, *self.extrapolation.work(vectors, out))
            rows = np.flatnonzero(np.isnan(out))
        left = np.nan_to_num(out[rows], neginf=-np.inf)
        found = self._last.room(vectors[rows])
        some = Vectors(*(each[rows] for each in arguments))
        self._evaluate(some, log_likelihoods, new_turns(left, found))
        out[rows] = left
        self._last.keep(vectors[rows], left, found)
        if self.occam:
            there = out > -np.inf
            out[there] += self.occam.log(vectors[there, self._error])
        return out + self._constant

    def _evaluate(self, vectors: Vectors, kernel: Any, turns: Turns) -> None:
        problem = self.near_problem

        def work() -> None:
            with self._workspaces.one() as w:
                kernel(problem, w, vectors, turns=turns)

        if turns.values.size:  # what nothing needs is not compiled
            share(work, len(turns.values))

    def _found(self, vectors: Floats) -> Floats:
        """Fluxes and shifts of all sources for n vectors, shape (n, s, 3); NaN without any."""
        out, found = np.zeros(len(vectors)), np.empty((len(vectors), len(self.model.sources), 3))
        self._evaluate(self._arguments(vectors), log_likelihoods, new_turns(out, found))
        found[out == -np.inf] = np.nan
        return found

    def near(self, params: Floats, covariance: Floats) -> "FrameLikelihood":
        """The same likelihood, faster to evaluate around `params`: see `Posterior.near`."""
        if not self._free:
            slow = not self.noise.discrete and hasattr(self._frame.noise, "near")
            return self._with(Around(params, covariance)) if slow else self
        known = *self.slopes(params, self._basis)[2:], (params, covariance)
        return self._with(extrapolate(self.model, self._found, *known))

    def _with(self, extrapolation: Extrapolation | Around | None) -> "FrameLikelihood":
        close = replace(self, extrapolation=extrapolation)
        vars(close).update((k, made) for k, made in vars(self).items() if k[0] == "_")  # large
        return close

    def share_workspaces(self, other: "FrameLikelihood") -> None:
        """Use another's workspaces where its frame is of the same kind: they are large."""
        same = self.mask.shape == other.mask.shape
        if same and self.nuisances.profiled == other.nuisances.profiled:
            vars(self)["_workspaces"] = other._workspaces

    def share_frame(self, other: "FrameLikelihood") -> None:
        """Use what another made of the same counts and noise: series of the noise take long."""
        varies, frame = self.nuisances.background_order > 0, other._frame
        vars(self)["_frame"] = frame._replace(varies=varies, everywhere=varies or frame.everywhere)

    def slopes(self, params: Floats, basis: Basis) -> tuple[Floats, Floats, Any, Any]:
        """Every source's part of the derivatives, and those by `SCALES` and the background."""
        out = room_for(len(self.model.sources), basis), np.zeros(len(BACKGROUND_TERMS))
        with self._rendered(params) as (w, rendered, parameters):
            scales, nearby = gradient(self._problem, w, rendered, parameters, basis, out)
        return out[0], np.append(scales, out[1]), rendered, nearby

    def gradient(self, params: Floats) -> Floats:
        """Exact gradient of the log-likelihood, shape (d,); NaN where that is -inf."""
        parts, others, *_ = self.slopes(params, self._basis)
        if np.isnan(others[0]):
            return np.full(len(self.parameters), np.nan)
        found = np.append(from_sources(self._basis, parts), others) @ self._chain_rule(params)
        if self.occam:
            found[self._error] += self.occam.slope(params[self._error])
        return np.asarray(found)

    def fisher(self, params: Floats) -> Floats:
        """Fisher information, free fluxes profiled out, shape (d, d); NaN where there is none."""
        sources, terms = self._basis.row.size, len(self.nuisances.background_names)
        others = np.zeros((sources + terms, sources + terms))
        with self._rendered(params) as (w, rendered, parameters):
            known = fisher(self._problem, w, rendered, parameters, self._basis, others)
        if np.isnan(known[0]):
            return np.full((len(self.parameters),) * 2, np.nan)
        # of scatter and model error the size of shifts and residuals tells, whatever the others
        apart, size = len(SCALES), sources + len(SCALES) + len(BACKGROUND_TERMS)
        out = np.zeros((size, size))
        index = [*range(sources), *range(sources + apart, sources + apart + terms)]
        out[np.ix_(index, index)] = others
        own = slice(sources, sources + apart)
        out[own, own] = np.diag(known)
        found = (change := self._chain_rule(params)).T @ out @ change
        if self.occam:
            k = self._error
            found[k, k] -= self.occam.lost(params[k], found[k, k])
        return np.asarray(found)

    def expected_counts(self, params: Floats) -> Floats:
        """Expected counts: see `Posterior.expected_counts`."""
        with self.expected(params) as found:
            return found.light + found.level

    def fluxes(self, params: Floats) -> Floats:
        """Flux of every source, counts: see `Posterior.fluxes`."""
        with self.expected(params) as found:
            return found.fluxes

    @contextmanager
    def expected(self, params: Floats) -> Iterator[Expected]:
        """Expected counts in the memory where they are rendered, which then serves others again."""
        ny, nx = self.model.detector.shape
        with self._rendered(params, whole=True) as (w, rendered, parameters):
            bad = 0.0 if rendered.extra > -np.inf else np.nan
            level = polynomial_background(self.mask.shape, parameters.background + bad)
            yield Expected(w.image.reshape(ny, -1)[:, :nx], level, rendered.fluxes + bad)

    def own_pixels(self, params: Floats, radius: float) -> tuple[OwnPixels, Floats, Floats, Floats]:
        """The sources' own pixels and templates, and the model that these belong to.

        Parameters
        ----------
        params : ndarray, shape (d,)
        radius : float, fine pixel
            Distance in the coordinates (a, b) of the PSF within which a pixel is a source's own.

        Returns
        -------
        OwnPixels
        expected : ndarray, shape (ny, nx), counts per pixel
        fluxes : ndarray, shape (s,), counts
        shifts : ndarray, shape (s, 2), fine pixel
            Most likely shifts along a and b; zero unless positions scatter.

        Raises
        ------
        InputError
            Where the likelihood is zero because the map folds.
        """
        with self._rendered(params, whole=True) as (w, rendered, parameters):
            if not rendered.extra > -np.inf:
                raise InputError(
                    "params: got parameters that leave a source without an image, expected ones "
                    "of a positive likelihood, such as those of find_map"
                )
            fluxes, profiled = rendered.fluxes, rendered.profiled
            shifts = np.zeros((fluxes.size, 2)) if profiled is None else profiled.shifts
            optics = self._optics._replace(support_radius=radius / parameters.nuisances.psf_sigma)
            frame = self.mask, w.image.reshape(self.mask.shape[0], -1)
            own = own_pixels(optics, parameters, (fluxes, shifts), radius, frame)
            sources = frame[1][:, : self.mask.shape[1]].copy()
        level = polynomial_background(self.mask.shape, parameters.background)
        return own, sources + level, fluxes, shifts

    def draw_fluxes(self, rng: np.random.Generator) -> Floats:
        """Free fluxes of all sources from their prior, shape (s,), counts."""
        flux, shape = self.model.sources.flux, self.nuisances.flux_shape
        return flux * rng.gamma(shape, 1.0 / shape, flux.size)

    def simulate(
        self, params: Floats, rng: np.random.Generator, fluxes: Floats | None = None
    ) -> Floats | None:
        """Draw a frame given the parameters; shifts, and fluxes if not given, from their prior.

        Returns
        -------
        ndarray, shape (ny, nx), counts
            None where the likelihood is zero whatever the counts: a source is folded or has no
            image, or expected counts are negative.
        """
        theta, nuisances, background = self._one(params)
        flux = nuisances.flux_scale * self.model.sources.flux
        if self._free:
            flux = self.draw_fluxes(rng) if fluxes is None else fluxes
        ny, nx = self.model.detector.shape
        optics, out = self._optics, np.zeros(ny * stride(nx))
        at_rest = nuisances._replace(position_scatter=0.0)
        unfolded = render_sources(optics, theta, at_rest, flux, out)
        if nuisances.position_scatter:
            # as imaged: a shift moves the image, the distortion is that of the catalogue's position
            scale = nuisances.position_scatter * np.sqrt(DOF / rng.chisquare(DOF, flux.size))
            by_x, by_y = scale * rng.standard_normal((2, flux.size))
            out[:] = 0.0
            moved = optics._replace(x=optics.x + by_x, y=optics.y + by_y)
            render_sources(moved, theta, at_rest, flux, out)
        sources = out.reshape(ny, -1)[:, :nx]
        level = polynomial_background(self.mask.shape, background)
        if not (unfolded and np.all((sources + level)[self.mask] >= 0.0)):
            return None
        return self.noise_at(params).draw(sources, np.maximum(level, -sources), rng)

    def noise_at(self, params: Floats) -> Noise:
        """The noise with the model error that the parameters state."""
        if not self.nuisances.model_error:
            return self.noise
        _, nuisances, level = self._one(params)
        slope = polynomial_background(self.mask.shape, level) - level[0]
        return with_model_error(self.noise, nuisances.model_error, slope)

    def image_positions(self, params: Floats) -> Floats:
        """Where the sources are imaged, shape (s, 2), fine pixel; nan without an image."""
        theta, offset = displacing(self.parameters, params)
        d, s = self.model.polynomial, self.model.sources
        return np.stack(d.image_position(theta, s.x, s.y, offset=offset), axis=1)

    def background(self, params: Floats) -> Floats:
        """The background polynomial at every pixel, shape (ny, nx), counts per pixel."""
        return polynomial_background(self.mask.shape, self._one(params).background).copy()

    def _arguments(self, vectors: Floats) -> Vectors:
        """Distortion coefficients, source nuisances and background coefficients, a row a vector."""
        distortion = self.model.polynomial
        source = np.tile(self._neutral, (len(vectors), 1))
        background = np.zeros((len(vectors), len(BACKGROUND_TERMS)))
        for k, parameter in enumerate(self.parameters):
            if parameter.kind != "distortion":
                values = source if parameter.kind == "source" else background
                values[:, parameter.slot] = vectors[:, k]
        theta = distortion.monomial_coefficients(vectors[:, : distortion.n_terms])
        return Vectors(np.ascontiguousarray(theta), source, background)

    def _one(self, params: Floats) -> Parameters:
        """The arguments of one parameter vector."""
        parameters: Parameters = parameters_of(self._arguments(params[None]), 0)
        return parameters

    @cached_property
    def _neutral(self) -> Floats:
        """The source nuisances where none is free."""
        return np.array([row.neutral(self.model.psf.sigma) for row in SOURCE_NUISANCES])

    def _chain_rule(self, params: Floats) -> Floats:
        return chain_rule(self.parameters, params, self.model.polynomial, self._moving)

    @contextmanager
    def _rendered(self, params: Floats, whole: bool = False) -> Iterator[Evaluation]:
        """A workspace in which the sources are rendered, on all pixels or where they count."""
        problem, parameters = self._problem, self._one(params)
        with self._workspaces.one() as w:
            if not whole and self._last.missing(params):  # to the bit the same whatever came before
                self._last.keep_rendered(params, render(problem, w, parameters, NOTHING, False))
                clear(w)
            known = NOTHING._replace(start=self._last.at(params))
            yield w, render(problem, w, parameters, known, whole), parameters
            clear(w)

    @cached_property
    def _last(self) -> LastProfiled:
        return LastProfiled(len(self.model.sources) if self._free else 0)

    @cached_property
    def _workspaces(self) -> Workspaces:
        start = self._one(np.array([parameter.start for parameter in self.parameters]))
        return Workspaces(partial(new_workspace, self._optics, start.nuisances, self._free))

    @cached_property
    def _optics(self) -> Optics:
        return self.model.optics(self.narrowest)

    @cached_property
    def _basis(self) -> Basis:
        return self.model.basis(self._moving)

    @property
    def _moving(self) -> list[str]:
        """The free nuisances that change the expected counts."""
        return [name for name in self.nuisances.source_names if name not in SCALES]

    @property
    def _error(self) -> int:
        """Where the model error is among the parameters."""
        return [parameter.name for parameter in self.parameters].index("model_error")

    @property
    def _free(self) -> Literal[True] | None:
        return True if self.nuisances.flux == "free" else None  # code for None is not compiled

    @cached_property
    def _faint(self) -> Flags:
        """Free fluxes for which Laplace's approximation is not enough."""
        if not self._free:
            return np.zeros(len(self.model.sources), bool)
        return faint_fluxes(self.model, self.counts, self.mask, self.noise)

    @cached_property
    def _problem(self) -> Problem:
        flux, n = self.model.sources.flux, self.nuisances
        kinds = self._free, n.position_scatter or None
        return Problem(self._optics, self._frame, flux, n.flux_shape, self._faint, *kinds)

    @cached_property
    def near_problem(self) -> Problem:
        """The problem as `log_likelihood` has it; not that of others that `near` makes."""
        if not isinstance(self.extrapolation, Around):
            return self._problem
        return problem_near(self._problem, self.expected_counts, self.extrapolation)

    @cached_property
    def _frame(self) -> Frame:
        return padded_frame(self.counts, self.mask, self.noise, self.nuisances)

    @cached_property
    def _constant(self) -> float:
        return counts_constant(self.counts, self.mask, self.noise)

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}
