"""The equations that a measured PSF, the distortion, the background and the fluxes solve together.

One step of Fisher scoring of the penalised likelihood: unknowns are the deviations of the PSF's
coefficients from a start (`psf_levels`) and the posterior's parameters. Fluxes and shifts of single
sources, thousands of them, are eliminated: their block of the information couples overlapping
sources only, and is sparse. Pixels that are far off count less, and where residuals exceed the
noise a model error, a share of the light, is added to the variance.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.errors import InputError
from bayesfred.imaging.psf.field import field_terms
from bayesfred.model import priors
from bayesfred.model.kernels.psf_grids import EDGE, add_spline
from bayesfred.model.kernels.psf_normal import psf_information, psf_slope, sample_psf
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.anderson import accelerated
from bayesfred.optimize.psf_levels import LIMITS, STRENGTH, PsfGrid, PsfNodes
from bayesfred.optimize.psf_samples import (
    OUTLYING,
    PsfSamples,
    likely_error,
    source_columns,
    template_products,
    template_pulls,
)

TOGETHER = 512  # rows of a matrix
PROBES = 40  # draws from which the number of determined coefficients is estimated
SEEN = 0.1  # of a source's light that its flux and place are found by, at the least
STILL = 0.1  # squared standard deviations, of all unknowns together, by which a solution is off
FASTEST = 3.4  # logarithm of the factor by which a strength may change in a turn
SECANTS = 6  # turns that accelerate the next
RATES = (0.5, 5.0)  # times the evidence's own change that a strength goes
LEAST_DETERMINED = 1e-2  # coefficients of a block
LARGEST_ERROR = 0.1  # that weights know of: with more, what surrounds a source tells its flux
LEAST_SCATTER = 1e-6  # pixel: less is not seen, and lost in the rounding of the equations
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
    nodes : PsfNodes or None
    """

    grid: PsfGrid
    coefficients: Floats
    strengths: Floats
    params: Floats
    fluxes: Floats
    shifts: Floats
    nodes: PsfNodes | None = None

    @property
    def deviations(self) -> Floats:
        """The coefficients but for the start's."""
        return self.coefficients[self.grid.fixed :]

    def deviating(self, deviations: Floats) -> Floats:
        """All coefficients, with other deviations from the start."""
        return np.concatenate([self.coefficients[: self.grid.fixed], deviations])

    def with_nodes(self, number: int) -> "PsfState":
        """The state with so many nodes along each axis, at which nothing deviates yet."""
        side = self.grid.at_nodes[0]
        return replace(self, nodes=PsfNodes(np.zeros((number**2, side, side)), STRENGTH, 0.0))


class Pixels(NamedTuple):
    """The pixels of a frame at a state: what they say of the model's light."""

    data: PsfSamples
    terms: Floats  # (s, terms) of the field
    templates: Floats  # (3, samples)
    weight: Floats
    score: Floats
    model_error: float


@dataclass(frozen=True, eq=False)
class PsfInformation:
    """The information about all unknowns but fluxes and shifts, without the PSF's prior.

    Attributes
    ----------
    matrix : ndarray, shape (unknowns, unknowns)
        Its lower triangle.
    which : ndarray of int
        The templates whose fluxes and shifts are eliminated.
    outer : ndarray, shape (eliminated, unknowns)
        What they share with the others.
    response : ndarray, shape (eliminated, unknowns)
        How they follow the others.
    solve : callable
        With their own information.
    """

    matrix: Floats
    which: Ints
    outer: Floats
    response: Floats
    solve: Callable[[Floats], Floats]

    @classmethod
    def of(cls, posterior: Posterior, state: PsfState, pixels: Pixels) -> "PsfInformation":
        """The information at a state."""
        data, weight = pixels.data, pixels.weight
        half, coupling, offset = psf_information(
            state.grid.unknown, pixels.terms, data.samples,
            (state.fluxes, weight, data.background), pixels.templates,
        )  # fmt: skip
        own, with_background = template_products(data, pixels.templates, weight, len(state.fluxes))
        columns, select = acting_columns(posterior, state)
        mixed = columns.T @ (with_background @ select)
        inner = columns.T @ (own @ columns) + mixed + mixed.T
        inner += select.T @ (data.background.T @ (weight[:, None] * data.background)) @ select
        inner += posterior.prior_information(state.params)
        idle = np.diag(inner) <= 0.0
        inner[idle, idle] = 1.0
        size = len(half)
        joint = np.zeros((size + len(inner), size + len(inner)))
        np.add(half, half.T, out=joint[:size, :size])
        joint[size:, :size] = (coupling.T @ columns + offset @ select).T
        joint[size:, size:] = inner
        free = free_templates(posterior, state, pixels)
        which = np.flatnonzero(free.ravel() & (own.diagonal() > 0.0))
        if not which.size:
            none = np.zeros((0, len(joint)))
            return cls(joint, which, none, none, np.copy)
        precision = shift_precision(posterior, state)[which]
        solve = splu((own[which][:, which] + sparse.diags_array(precision)).tocsc()).solve
        shared = own[which] @ columns + with_background[which] @ select
        outer = np.concatenate([coupling[which], shared], axis=1)
        response = solve(outer)
        for begin in range(0, len(joint), TOGETHER):
            end = begin + TOGETHER
            joint[begin:end, :end] -= outer[:, begin:end].T @ response[:, :end]
        return cls(joint, which, outer, response, solve)


@dataclass(frozen=True, eq=False)
class PsfEquations:
    """The equations of one step from a state.

    Attributes
    ----------
    state : PsfState
    information : PsfInformation
    pull : ndarray, shape (unknowns,)
        The slope of the log-likelihood and the parameters' priors.
    own_step : ndarray, shape (eliminated,)
        Of fluxes and shifts, while the other unknowns stay.
    model_error : float
        Share of the light by which the model is off.
    """

    state: PsfState
    information: PsfInformation
    pull: Floats
    own_step: Floats
    model_error: float

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        state: PsfState,
        *,
        exact: bool = False,
        known: "PsfEquations | None" = None,
    ) -> "PsfEquations":
        """The equations at a state, for a frame; an exact model has no error of its own.

        With equations that are `known` at a state nearby their information serves once more.
        """
        data = PsfSamples.at(posterior, state.params, state.shifts, state.grid.radius)
        pixels = observed(posterior, state, data, 0.0 if exact else None)
        score = pixels.score
        information = known.information if known else PsfInformation.of(posterior, state, pixels)
        psf = psf_slope(state.grid.unknown, pixels.terms, data.samples, state.fluxes, score)
        own = template_pulls(data, pixels.templates, score, len(state.fluxes))
        columns, select = acting_columns(posterior, state)
        inner = columns.T @ own + select.T @ (data.background.T @ score)
        given = zip(posterior.prior.values(), state.params, strict=True)
        inner += [priors.slope(prior, x)[0] for prior, x in given]
        inner[[name in HELD for name in posterior.parameter_names]] = 0.0
        shifts = np.column_stack([state.fluxes, state.shifts]).ravel()
        own -= shift_precision(posterior, state) * shifts
        step = information.solve(own[information.which])
        pull = np.concatenate([psf, inner]) - step @ information.outer
        out = cls(state, information, pull, step, pixels.model_error)
        if known and known.state.strengths is state.strengths:
            out.__dict__["factor"] = known.factor  # of the same matrix
        return out

    @cached_property
    def conventions(self) -> Floats:
        """Rows of what has a prescribed value, of all unknowns."""
        rows = self.state.grid.conventions[:, self.state.grid.fixed :]
        return np.pad(rows, [(0, 0), (0, len(self.pull) - rows.shape[1])])

    @cached_property
    def factor(self) -> tuple[Floats, Floats]:
        """Cholesky's upper factor of the information with the priors, and the unknowns' scales."""
        matrix = self.information.matrix.copy()
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
        # LAPACK's matrices are the transposed ones: their upper triangle
        return linalg.cholesky(matrix.T, overwrite_a=True, check_finite=False), scale

    def _solved(self, pull: Floats) -> Floats:
        """The product of the information's inverse, without conventions, with columns."""
        upper, scale = self.factor
        columns = (scale * pull.T).T
        return np.asarray(
            (scale * linalg.cho_solve((upper, False), columns, check_finite=False).T).T
        )

    def _constrained(self, solution: Floats, target: Floats) -> Floats:
        """The solution that meets the conventions and is nearest by the information."""
        rows, towards = self.conventions, self.towards
        excess = np.linalg.solve(rows @ towards, rows @ solution - target)
        return np.asarray(solution - towards @ excess)

    @cached_property
    def towards(self) -> Floats:
        """How the unknowns follow the conventions."""
        return self._solved(self.conventions.T)

    @cached_property
    def step(self) -> Floats:
        """How far the solution is, of all unknowns."""
        state = self.state
        pull, size = self.pull.copy(), state.deviations.size
        for block, strength in zip(state.grid.blocks, state.strengths, strict=True):
            own = state.deviations[block.where]
            pull[:size][block.where] -= strength * (block.roughness @ own) + block.amplitude * own
        target = -state.grid.conventions @ state.coefficients
        target[0] += 1.0
        return self._constrained(self._solved(pull), target)

    @property
    def measured(self) -> Floats:
        """The step in standard deviations: the squares' sum is that of all unknowns together."""
        upper, scale = self.factor
        return np.asarray(upper @ (self.step / scale))

    def draws(self, number: int) -> Floats:
        """Draws from the posterior of all unknowns, less its maximum, a column each."""
        return self._drawn(self._normal(number))

    def _normal(self, number: int) -> Floats:
        return np.random.default_rng(0).standard_normal((len(self.pull), number))

    def _drawn(self, normal: Floats) -> Floats:
        upper, scale = self.factor
        free = scale[:, None] * linalg.solve_triangular(upper, normal, check_finite=False)
        return self._constrained(free, np.zeros((len(self.conventions), normal.shape[1])))

    def determined(self) -> Floats:
        """How many coefficients of every block the counts determine, from a few draws."""
        size = self.state.deviations.size
        (upper, scale), normal = self.factor, self._normal(PROBES)
        drawn, known, out = self._drawn(normal), (upper.T @ normal / scale[:, None])[:size], []
        for block, strength in zip(self.state.grid.blocks, self.state.strengths, strict=True):
            own = drawn[:size][block.where]
            # less the prior's part of the same draws, in whose noise little would be lost
            prior = strength * (block.roughness @ own) + block.amplitude[:, None] * own
            out.append(float(np.sum(own * (known[block.where] - prior))) / PROBES)
        return np.maximum(out, LEAST_DETERMINED)

    def with_strengths(self, turns: int) -> "PsfEquations":
        """The equations with the strengths that the evidence prefers, or after a few turns."""
        out, points = self, deque[tuple[Floats, Floats, Floats]](maxlen=SECANTS)
        for _ in range(turns):
            determined, state = out.determined(), out.state
            there = state.deviations + out.step[: state.deviations.size]
            parts = [(there[block.where], block.roughness) for block in state.grid.blocks]
            squares = np.array([own @ (roughness @ own) for own, roughness in parts])
            off = np.log(determined / np.maximum(state.strengths * squares, 1e-300))
            off = np.clip(off, *np.log(np.divide.outer(LIMITS, state.strengths)))
            off = np.clip(off, -FASTEST, FASTEST)
            measured = np.sqrt(determined) * off  # by how much the solution would move
            if float(measured @ measured) < STILL:
                break
            points.append((np.log(state.strengths), off, measured))
            with np.errstate(divide="ignore", invalid="ignore"):
                rate = np.clip(np.nan_to_num(accelerated(points) / off, nan=1.0), *RATES)
            change = np.clip(rate * off, -FASTEST, FASTEST)
            strengths = np.clip(state.strengths * np.exp(change), *LIMITS)
            out = replace(out, state=replace(state, strengths=strengths))
        return out


def field_radius(posterior: Posterior, nodes: int = 0) -> float:
    """Half the frame's diagonal, or half its longer side for nodes; pixel."""
    shape = posterior.model.detector.fine_shape
    return 0.5 * (max(shape) if nodes else math.hypot(*shape))


def node_weights(posterior: Posterior, nodes: int) -> sparse.csr_array:
    """What the nodes, so many along each axis, count for every source, shape (s, nodes)."""
    s = posterior.model.sources
    terms = field_terms(s.x, s.y, 0, field_radius(posterior, nodes), nodes)
    return sparse.csr_array(terms[:, 1:])


def observed(
    posterior: Posterior,
    state: PsfState,
    data: PsfSamples,
    error: float | None,
    outlying: float = OUTLYING,
) -> Pixels:
    """What the pixels say; without a model error that is given the residuals tell it."""
    grid, fluxes, sources = state.grid, state.fluxes, posterior.model.sources
    seen = int(np.sum(np.diff(data.samples.first) > 0))
    if seen <= len(state.params) + 10:
        raise InputError(
            f"psf: got {seen} pixels that see a source, expected more: widen the footprint or the "
            "mask"
        )
    terms = field_terms(sources.x, sources.y, grid.degree, field_radius(posterior))
    p = sample_psf(grid.levels, terms, data.samples, state.coefficients)
    if state.nodes is not None:
        own = state.nodes.splines(node_weights(posterior, state.nodes.number))
        own = np.pad(own, [(0, 0), (EDGE, EDGE), (EDGE, EDGE)])
        add_spline(own, 2.0 / grid.oversampling, data.samples, p)
    bright = fluxes[data.samples.source]
    templates = data.samples.size * np.stack([p[0], -bright * p[1], -bright * p[2]])
    light = data.image(bright * templates[0])
    residual, variance = data.residual(posterior, state.params, light)
    known = error is not None
    error = likely_error(residual, variance, light) if error is None else error
    variance = variance + ((error if known else min(error, LARGEST_ERROR)) * light) ** 2
    weight = 1.0 / (variance * np.maximum(1.0, residual**2 / (variance * outlying**2)))
    return Pixels(data, terms, templates, weight, weight * residual, error)


def acting_columns(posterior: Posterior, state: PsfState) -> tuple[Floats, Floats]:
    """How the parameters act on the templates, and on which the background's terms do.

    Shapes are (3 s, d) and (terms, d).
    """
    levels = [k for k, p in enumerate(posterior.parameters) if p.kind == "background"]
    columns = source_columns(posterior, state.params, state.fluxes)
    return columns, np.eye(posterior.n_parameters)[levels]


def free_templates(posterior: Posterior, state: PsfState, pixels: Pixels) -> Flags:
    """Which of every source's flux and shifts are free, shape (s, 3)."""
    free = np.zeros((len(state.fluxes), 3), bool)
    free[:, 0] = posterior.nuisances.flux == "free"
    free[:, 1:] = posterior.nuisances.position_scatter
    light = np.bincount(pixels.data.samples.source, pixels.templates[0], len(free))
    free[light < SEEN] = False  # wings alone would make of noise any flux
    return free


def shift_precision(posterior: Posterior, state: PsfState) -> Floats:
    """The prior's, of every source's flux and shifts, shape (3 s,): 0 of fluxes."""
    out = np.zeros((len(state.fluxes), 3))
    if posterior.nuisances.position_scatter:
        scatter = state.params[posterior.parameter_names.index(SCATTER)]
        out[:, 1:] = max(scatter, LEAST_SCATTER) ** -2.0
    return out.ravel()
