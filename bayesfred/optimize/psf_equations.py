"""The equations that a measured PSF, the distortion, the background and the fluxes solve together.

One step of Fisher scoring of the penalised likelihood: unknowns are the deviations of the PSF's
coefficients from a start (`psf_levels`) and the posterior's parameters. Fluxes and shifts of single
sources, thousands of them, are eliminated: their block of the information couples overlapping
sources only, and is sparse. Pixels that are far off count less, and where residuals exceed the
noise a model error, a share of the light, is added to the variance.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg, sparse
from scipy.optimize import brentq
from scipy.sparse.linalg import splu

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.imaging.psf.measured import field_terms
from bayesfred.model import priors
from bayesfred.model.kernels.psf_normal import normal_equations, sample_psf
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.psf_levels import LIMITS, PsfGrid
from bayesfred.optimize.psf_samples import PsfSamples, source_columns, template_products

OUTLYING = 6.0  # standard deviations beyond which a pixel counts less
PROBES = 40  # draws from which the number of determined coefficients is estimated
FASTEST = 30.0  # factor by which a strength may change in a turn
SCATTER, WIDTH = "position_scatter", "psf_sigma"
HELD = (SCATTER, WIDTH, "model_error")  # parameters that are not solved for here


@dataclass(frozen=True, eq=False)
class PsfState:
    """What is known of a PSF and a frame after some turns.

    Attributes
    ----------
    grid : PsfGrid
    coefficients : ndarray, per square pixel
        Of all grids, the start's first.
    strengths : ndarray, shape (blocks,)
        Of the prior of every block of deviations.
    params : ndarray, shape (d,)
    fluxes : ndarray, shape (s,), counts
    shifts : ndarray, shape (s, 2), pixel
    """

    grid: PsfGrid
    coefficients: Floats
    strengths: Floats
    params: Floats
    fluxes: Floats
    shifts: Floats

    @property
    def deviations(self) -> Floats:
        """The coefficients but for the start's."""
        return self.coefficients[self.grid.fixed :]

    def deviating(self, deviations: Floats) -> Floats:
        """All coefficients, with other deviations from the start."""
        return np.concatenate([self.coefficients[: self.grid.fixed], deviations])


class Eliminated(NamedTuple):
    """Fluxes and shifts: which of the templates, and how they follow the other unknowns."""

    which: Ints
    step: Floats
    response: Floats


@dataclass(frozen=True, eq=False)
class PsfEquations:
    """The equations of one step from a state.

    Attributes
    ----------
    state : PsfState
    information : ndarray, shape (unknowns, unknowns)
        Without the PSF's prior.
    pull : ndarray, shape (unknowns,)
        The slope of the log-likelihood and the parameters' priors.
    eliminated : Eliminated
    model_error : float
        Share of the light by which the model is off.
    """

    state: PsfState
    information: Floats
    pull: Floats
    eliminated: Eliminated
    model_error: float

    @classmethod
    def of(cls, posterior: Posterior, state: PsfState, *, exact: bool = False) -> "PsfEquations":
        """The equations at a state, for a frame; an exact model has no error of its own."""
        grid, params, fluxes = state.grid, state.params, state.fluxes
        sources = posterior.model.sources
        data = PsfSamples.at(posterior, params, state.shifts, grid.radius)
        seen = int(np.sum(np.diff(data.samples.first) > 0))
        if seen <= len(params) + 10:
            raise InputError(
                f"psf: got {seen} pixels that see a source, expected more: widen the "
                "footprint or the mask"
            )
        terms = field_terms(sources.x, sources.y, grid.degree, field_radius(posterior))
        p = sample_psf(grid.levels, terms, data.samples, state.coefficients)
        bright = fluxes[data.samples.source]
        templates = data.samples.size * np.stack([p[0], -bright * p[1], -bright * p[2]])
        light = data.image(bright * templates[0])
        residual, variance = data.residual(posterior, params, light)
        error = 0.0 if exact else _model_error(residual, variance, light)
        variance = variance + (error * light) ** 2
        weight = 1.0 / (variance * np.maximum(1.0, residual**2 / (variance * OUTLYING**2)))
        pixels = fluxes, weight, residual, data.background
        psf = normal_equations(grid.unknown, terms, data.samples, pixels, templates)
        own = template_products(data, templates, weight, residual, len(fluxes))
        squares = data.background.T @ (weight[:, None] * data.background)
        background = squares, data.background.T @ (weight * residual)
        joined = _joined(posterior, state, psf, own, background)
        return cls(state, *joined, error)

    @cached_property
    def conventions(self) -> Floats:
        """Rows of what has a prescribed value, of all unknowns."""
        rows = self.state.grid.conventions[:, self.state.grid.fixed :]
        return np.pad(rows, [(0, 0), (0, len(self.pull) - rows.shape[1])])

    @cached_property
    def factor(self) -> tuple[Floats, Floats]:
        """Cholesky's factor of the information with the priors, and the unknowns' scales."""
        matrix = self.information.copy()
        for block, strength in zip(self.state.grid.blocks, self.state.strengths, strict=True):
            n = np.arange(len(matrix))[block.where]
            entries = block.roughness.tocoo()
            matrix[n[entries.row], n[entries.col]] += strength * entries.data
            matrix[n, n] += block.amplitude
        scale = 1.0 / np.sqrt(np.diag(matrix))
        rows = self.conventions * scale
        matrix *= scale[:, None]
        matrix *= scale
        # makes directions definite that the conventions will fix
        matrix += rows.T @ (rows / (rows**2).sum(axis=1)[:, None])
        return linalg.cholesky(matrix, lower=True, overwrite_a=True), scale

    def _constrained(self, solution: Floats, target: Floats) -> Floats:
        """The solution that meets the conventions and is nearest by the information."""
        rows = self.conventions
        lower, scale = self.factor
        towards = scale[:, None] * linalg.cho_solve((lower, True), scale[:, None] * rows.T)
        excess = np.linalg.solve(rows @ towards, rows @ solution - target)
        return np.asarray(solution - towards @ excess)

    @cached_property
    def step(self) -> Floats:
        """How far the solution is, of all unknowns."""
        state = self.state
        pull, size = self.pull.copy(), state.deviations.size
        for block, strength in zip(state.grid.blocks, state.strengths, strict=True):
            own = state.deviations[block.where]
            pull[:size][block.where] -= strength * (block.roughness @ own) + block.amplitude * own
        lower, scale = self.factor
        free = scale * linalg.cho_solve((lower, True), scale * pull)
        target = -state.grid.conventions @ state.coefficients
        target[0] += 1.0
        return self._constrained(free, target)

    def draws(self, number: int) -> Floats:
        """Draws from the posterior of all unknowns, less its maximum, a column each."""
        lower, scale = self.factor
        normal = np.random.default_rng(0).standard_normal((len(scale), number))
        free = scale[:, None] * linalg.solve_triangular(lower, normal, trans=1, lower=True)
        return self._constrained(free, np.zeros((len(self.conventions), number)))

    def determined(self) -> Floats:
        """How many coefficients of every block the counts determine."""
        drawn, out = self.draws(PROBES), []
        for block, strength in zip(self.state.grid.blocks, self.state.strengths, strict=True):
            own = drawn[: self.state.deviations.size][block.where]
            spread = float(np.sum(own * (block.roughness @ own))) / PROBES
            out.append(len(own) - strength * spread)
        return np.maximum(out, 1.0)

    def with_strengths(self) -> "PsfEquations":
        """The equations with the strengths that the evidence prefers."""
        state = self.state
        there = state.deviations + self.step[: state.deviations.size]
        parts = [(there[block.where], block.roughness) for block in state.grid.blocks]
        squares = np.array([own @ (roughness @ own) for own, roughness in parts])
        best = self.determined() / np.maximum(squares, 1e-300)
        best = np.clip(best, state.strengths / FASTEST, state.strengths * FASTEST)
        return replace(self, state=replace(state, strengths=np.clip(best, *LIMITS)))


def field_radius(posterior: Posterior) -> float:
    """Half the frame's diagonal, pixel."""
    return 0.5 * math.hypot(*posterior.model.detector.fine_shape)


def _joined(
    posterior: Posterior,
    state: PsfState,
    psf: tuple[Floats, Floats, Floats],
    own: tuple[Any, Floats, Floats],
    background: tuple[Floats, Floats],
) -> tuple[Floats, Floats, Eliminated]:
    """Information and pull of coefficients and parameters, fluxes and shifts eliminated."""
    half, coupling, others = psf
    matrix, offset, pull = half + half.T, others[:, :-1], others[:, -1]
    templates, with_background, own_pull = own
    columns = source_columns(posterior, state.params, state.fluxes)
    levels = [k for k, p in enumerate(posterior.parameters) if p.kind == "background"]
    select = np.eye(posterior.n_parameters)[levels]
    mixed = columns.T @ (with_background @ select)
    inner = columns.T @ (templates @ columns) + mixed + mixed.T
    inner += select.T @ background[0] @ select + posterior.prior_information(state.params)
    idle = np.diag(inner) <= 0.0
    inner[idle, idle] = 1.0
    given = zip(posterior.prior.values(), state.params, strict=True)
    inner_pull = columns.T @ own_pull + select.T @ background[1]
    inner_pull += [priors.slope(prior, x)[0] for prior, x in given]
    inner_pull[[name in HELD for name in posterior.parameter_names]] = 0.0
    cross = coupling.T @ columns + offset @ select
    joint = np.block([[matrix, cross], [cross.T, inner]])
    joint_pull = np.concatenate([pull, inner_pull])
    free = np.zeros((len(state.fluxes), 3), bool)
    free[:, 0] = posterior.nuisances.flux == "free"
    free[:, 1:] = posterior.nuisances.position_scatter
    index = np.flatnonzero(free.ravel() & (templates.diagonal() > 0.0))
    if not index.size:
        nothing = Eliminated(index, np.zeros(0), np.zeros((0, len(joint_pull))))
        return joint, joint_pull, nothing
    precision, own_pull = np.zeros(index.size), own_pull[index].copy()
    if posterior.nuisances.position_scatter:
        precision[index % 3 > 0] = _scatter(posterior, state.params) ** -2.0
        shifts = np.column_stack([state.fluxes, state.shifts]).ravel()[index]
        own_pull -= precision * shifts
    solver = splu((templates[index][:, index] + sparse.diags_array(precision)).tocsc())
    shared = columns.T @ templates[:, index] + (with_background[index] @ select).T
    outer = np.concatenate([coupling[index].T, shared])
    eliminated = Eliminated(index, solver.solve(own_pull), solver.solve(outer.T))
    joint -= outer @ eliminated.response
    joint_pull -= outer @ eliminated.step
    return joint, joint_pull, eliminated


def _scatter(posterior: Posterior, params: Floats) -> float:
    return float(params[posterior.parameter_names.index(SCATTER)])


def _model_error(residual: Floats, variance: Floats, light: Floats) -> float:
    """The most likely share of the light by which the model is off; 0 if the noise explains all."""

    def excess(error: float) -> float:
        total = variance + (error * light) ** 2
        z = np.minimum(residual**2 / total, OUTLYING**2)
        return float(np.sum(light**2 / total * (z - 1.0)))

    # the score of the squared error, in its standard deviations
    if excess(0.0) < 3.0 * math.sqrt(2.0 * float(np.sum((light**2 / variance) ** 2))):
        return 0.0
    return float(brentq(excess, 0.0, 10.0, xtol=1e-4)) if excess(10.0) < 0.0 else 10.0
