"""The variation of a PSF between the nodes of a grid over the field.

A polynomial says badly what crosses the PSF from one side of the field to the other, such as the
edge of a vignetted pupil: it would take a degree of ten, and its equations grow as the cube of the
number of terms. Between the nodes of a grid the PSF varies linearly, and a source knows only the
four nodes around it. The PSF's deviations at the nodes, tens of thousands of numbers, are solved
for by conjugate gradients, on top of a PSF that does not vary. All other parameters, and flux and
place of every source where they are free, are eliminated.

With A_s the splines of a source, weighed and without what is eliminated, and h_s its weights of the
nodes, the information about the nodes is sum_s h_s h_s^T (x) A_s^T A_s. Sources that differ only in
brightness have A_s^T A_s in proportion to their weight w_s. Then it is a Kronecker product,

    (sum_s w_s h_s h_s^T) (x) (sum_s A_s^T A_s),    sum_s w_s = 1,

with eigenvalues mu_n lambda_k where the prior is its strength times the identity. That
approximation conditions the exact equations, so that few steps solve them. It also tells how many
numbers the counts determine, and thereby the prior's strength (`psf_levels`).
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import linalg, sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import LinearOperator, SuperLU, cg, splu

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.psf_equations import (
    PsfState,
    acting_columns,
    free_templates,
    node_weights,
    observed,
    shift_precision,
)
from bayesfred.optimize.psf_levels import LIMITS, PsfNodes
from bayesfred.optimize.psf_samples import OUTLYING, PsfSamples

SUPPORT = 4  # B-splines that are not zero at a point of an axis
CHOICES = 10  # of the strength, at the most
SETTLED = 0.1  # change of its logarithm
NEAR = 1e-3  # of a solution that others will follow
PRECISE = 1e-5  # of the last one: the whole is thousands of standard deviations long
ROUGH = 3e-3  # where its product with the slope is wanted, which is off by the square
STEPS = 2000  # of conjugate gradients
TINY = 1e-9  # of its information that is added to what a source says of itself


@dataclass(frozen=True, eq=False)
class NodeEquations:
    """The equations of a PSF's deviations at nodes, all else given.

    Attributes
    ----------
    residual : ndarray, shape (pixels,)
        Of the model without the nodes, in standard deviations.
    splines : sparse array, shape (pixels, s knots)
        Derivatives of the pixels by the coefficients of every source.
    templates : sparse array, shape (pixels, 3 s + terms)
        By the flux and the shifts of every source, and by the background's terms.
    parameters : ndarray, shape (3 s + terms, d)
        How the parameters act on these.
    eliminated : sparse array, shape (3 s + terms, 3 s + d)
        How what is eliminated acts on these: the flux and the shifts of every source, and
        the parameters; the pixels' derivatives by it have unit length, or are 0 where it is known.
    lengths : ndarray, shape (3 s + d,)
        That these had.
    known : ndarray, shape (2, 3 s + d)
        Of these, the precision that they have without the counts, and times their values.
    weights : sparse array, shape (s, nodes)
        Of the nodes for every source.
    precision : ndarray, shape (knots, knots)
        Of the prior of strength 1.
    conventions : ndarray, shape (3, knots)
        What is 0 at every node: volume and centroid.
    model_error : float
        Share of the light by which the model is off.
    """

    residual: Floats
    splines: sparse.csr_array
    templates: sparse.csr_array
    parameters: Floats
    eliminated: sparse.csr_array
    lengths: Floats
    known: Floats
    weights: sparse.csr_array
    precision: Floats
    conventions: Floats
    model_error: float

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        state: PsfState,
        error: float | None = None,
        outlying: float = OUTLYING,
    ) -> "NodeEquations":
        """The equations at a state; without a model error that is given the residuals tell it."""
        data = PsfSamples.at(posterior, state.params, state.shifts, state.grid.radius)
        pixels = observed(posterior, state, data, error, outlying)
        side, prior, conventions = state.grid.at_nodes
        assert state.nodes is not None, "the PSF varies between them"
        root, source, sources = np.sqrt(pixels.weight), data.samples.source, len(state.fluxes)
        light = state.fluxes[source] * data.samples.size * root[data.owner]
        knots = np.stack([data.samples.a, data.samples.b]) * (0.5 * state.grid.oversampling)
        inside = np.abs(knots).max(axis=0) < 0.5 * (side + 3)
        shape = data.pixel.size, sources
        splines = _splines(
            knots[:, inside], side, light[inside], source[inside], data.owner[inside], shape
        )
        own = pixels.templates * root[data.owner]
        columns = 3 * source[:, None] + np.arange(3)
        templates = sparse.csr_array(
            (own.T.ravel(), columns.ravel(), 3 * data.samples.first), (shape[0], 3 * sources)
        )
        templates = sparse.hstack([templates, root[:, None] * data.background]).tocsr()
        parameters = np.concatenate(acting_columns(posterior, state))
        free = free_templates(posterior, state, pixels).ravel()
        own_shape = templates.shape[1], free.size
        free = sparse.diags_array(1.0 * free, shape=own_shape)
        eliminated = sparse.hstack([free, parameters]).tocsr()
        gram = templates.T @ templates
        squares = eliminated.multiply(gram @ eliminated).sum(axis=0)
        lengths = np.sqrt(np.asarray(squares, dtype=np.float64).ravel())
        lengths[lengths == 0.0] = np.inf  # what is known changes by 0
        eliminated = (eliminated @ sparse.diags_array(1.0 / lengths)).tocsr()
        values = np.column_stack([state.fluxes, state.shifts]).ravel()
        precision, known = shift_precision(posterior, state), np.zeros((2, lengths.size))
        known[:, : precision.size] = precision, precision * values
        weights = node_weights(posterior, state.nodes.number)
        residual = pixels.score / root + splines @ state.nodes.splines(weights).ravel()
        return cls(
            residual, splines, templates, parameters, eliminated, lengths, known, weights,
            prior.roughness.toarray() + np.diag(prior.amplitude), conventions, pixels.model_error,
        )  # fmt: skip

    @property
    def knots(self) -> int:
        """How many coefficients a node has."""
        return len(self.precision)

    @cached_property
    def _about_eliminated(self) -> sparse.csc_array:
        """The information about what is eliminated."""
        own = self.eliminated.T @ (self.templates.T @ self.templates) @ self.eliminated
        known = self.known[0] / self.lengths**2 + TINY
        return (own + sparse.diags_array(known)).tocsc()

    @cached_property
    def _own(self) -> SuperLU:
        return splu(self._about_eliminated)

    def _explained(self, values: Floats, tied: Floats | float = 0.0) -> Floats:
        """The change of what is eliminated that explains values, in columns of unit length.

        `tied` is the pull of what is known of them beside the counts.
        """
        pull = self.eliminated.T @ (self.templates.T @ values)
        return np.asarray(self._own.solve(pull + tied))

    def _remaining(self, values: Floats, tied: Floats | float = 0.0) -> Floats:
        """Without what is eliminated explains."""
        explained = self.eliminated @ self._explained(values, tied)
        return np.asarray(values - self.templates @ explained)

    def _pull(self, values: Floats) -> Floats:
        """The slope by the nodes' coefficients, given that by the pixels."""
        each = (self.splines.T @ values).reshape(-1, self.knots)
        return np.asarray(self.weights.T @ each)

    @property
    def _tied(self) -> Floats:
        """The pull of what is known of the eliminated beside the counts."""
        return np.asarray(-self.known[1] / self.lengths)

    @property
    def pull(self) -> Floats:
        """The slope by the nodes' coefficients where they are 0, shape (nodes, knots)."""
        return self._pull(self._remaining(self.residual, self._tied))

    @cached_property
    def _bright(self) -> Floats:
        """The sources' shares of what the counts say, w."""
        whose = self.splines.indices // self.knots
        each = np.bincount(whose, self.splines.data**2, self.weights.shape[0])
        return np.asarray(each / each.sum())

    @cached_property
    def share(self) -> Floats:
        """Those of the nodes, shape (nodes,)."""
        return np.asarray(self.weights.T @ self._bright)

    @cached_property
    def coordinates(self) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats]]:
        """Eigenvalues and axes over the nodes and over the knots, see the module."""
        knot = self.splines.indices % self.knots
        shape = len(self.residual), self.knots
        every = sparse.csr_array((self.splines.data, knot, self.splines.indptr), shape)
        shared = self.eliminated.T @ (self.templates.T @ every).toarray()
        gram = (every.T @ every).toarray() - shared.T @ self._own.solve(shared)
        over = self.weights.T @ sparse.diags_array(self._bright) @ self.weights
        seen, combinations = linalg.eigh(over.toarray())
        free = linalg.null_space(self.conventions)
        known, axes = linalg.eigh(free.T @ gram @ free, free.T @ self.precision @ free)
        return (np.maximum(seen, 0.0), combinations), (np.maximum(known, 0.0), free @ axes)

    def information(self) -> Floats:
        """About the combinations of nodes and of knots, nearly; in units of the prior's."""
        (seen, _), (known, _) = self.coordinates
        return np.multiply.outer(seen, known)

    def solution(
        self, strength: float, pull: Floats, start: Floats, precise: float = PRECISE
    ) -> Floats:
        """The coefficients that a slope leads to with a prior's strength, shape (nodes, knots).

        Raises
        ------
        InputError
            If conjugate gradients do not come to an end.
        """
        (_, combinations), (_, axes) = self.coordinates
        scale = 1.0 / np.sqrt(strength + self.information())
        prior = (strength * scale**2).ravel()

        def coefficients(scaled: Floats) -> Floats:
            return np.asarray(combinations @ (scale * scaled.reshape(scale.shape)) @ axes.T)

        def scaled_slope(slope: Floats) -> Floats:
            return np.asarray((scale * (combinations.T @ slope @ axes)).ravel())

        def product(scaled: Floats) -> Floats:
            light = self.splines @ (self.weights @ coefficients(scaled)).ravel()
            return scaled_slope(self._pull(self._remaining(light))) + prior * scaled

        operator = LinearOperator((scale.size, scale.size), matvec=product, dtype=np.float64)
        begin = ((combinations.T @ start @ self.precision @ axes) / scale).ravel()
        found, left = cg(operator, scaled_slope(pull), begin, rtol=precise, maxiter=STEPS)
        if left:
            raise InputError(
                f"psf: nodes: no PSF found in {STEPS} steps: expected sources at every node: set "
                "fewer nodes"
            )
        return coefficients(found)

    def solved(self, before: PsfNodes, precise: float = PRECISE) -> tuple[PsfNodes, Floats, float]:
        """The nodes, with the strength of their prior that the evidence prefers.

        Parameters
        ----------
        before : PsfNodes
        precise : float
            How far the solution may be off, of its length.

        Returns
        -------
        nodes : PsfNodes
        change : ndarray, shape (d + 3 s,)
            Of the parameters, and of every source's flux and shifts.
        far : float
            Largest change of a parameter, in its standard deviations with a known PSF.
        """
        pull, strength = self.pull, before.strength
        found = before.coefficients.reshape(-1, self.knots)
        for _ in range(CHOICES):
            found = self.solution(strength, pull, found, precise)
            known = self.information()
            determined = float(np.sum(known / (strength + known)))
            square = float(np.sum(found * (found @ self.precision)))
            better = float(np.clip(determined / max(square, 1e-300), *LIMITS))
            settled = abs(math.log(better / strength)) < SETTLED
            strength = better
            if settled:
                break
        side, d = math.isqrt(self.knots), self.parameters.shape[1]
        light = self.splines @ (self.weights @ found).ravel()
        own = self._explained(self.residual - light, self._tied)
        each = self._own.solve(np.eye(own.size, d, d - own.size))[-d:]
        far = float(np.max(np.abs(own[-d:]) / np.sqrt(np.diag(each))))
        own /= self.lengths
        change = np.concatenate([own[-d:], own[:-d]])
        return PsfNodes(found.reshape(-1, side, side), strength, determined), change, far

    def draws(self, strength: float, number: int) -> Floats:
        """Draws of what sources have in common, less its mean; nearly, see the module.

        Parameters
        ----------
        strength : float
            Of the prior.
        number : int

        Returns
        -------
        ndarray, shape (number, side, side)
        """
        (_, combinations), (_, axes) = self.coordinates
        scale = 1.0 / np.sqrt(strength + self.information())
        random = np.random.default_rng(0).standard_normal((number, *scale.shape))
        side = math.isqrt(self.knots)
        return (((self.share @ combinations) @ (scale * random)) @ axes.T).reshape(-1, side, side)

    def log_volume(self, strength: float) -> float:
        """Of the nodes' posterior, up to a constant."""
        return -0.5 * float(np.sum(np.log(strength + self.information())))

    def covariance_of_slopes(self, strength: float) -> Floats:
        """Of a log-posterior's slopes by its parameters, as the nodes follow their posterior.

        Parameters
        ----------
        strength : float
            Of the prior.

        Returns
        -------
        ndarray, shape (d, d)
        """
        # fluxes and shifts of single sources follow the parameters, too
        images, size = self.templates @ self.parameters, self.parameters.shape[1]
        single = self.templates @ self.eliminated[:, :-size]
        images -= single @ splu(self._about_eliminated[:-size, :-size]).solve(single.T @ images)
        pulls = [self._pull(image) for image in images.T]
        none = np.zeros_like(pulls[0])
        moved = [
            self.solution(strength, pull, none, ROUGH) if pull.any() else none for pull in pulls
        ]
        out = np.reshape(pulls, (size, -1)) @ np.reshape(moved, (size, -1)).T
        return np.asarray(0.5 * (out + out.T))


def _splines(
    at: Floats, side: int, light: Floats, source: Ints, owner: Ints, shape: tuple[int, int]
) -> sparse.csr_array:
    """Derivatives of the pixels by the coefficients of every source.

    `at` are the samples' places in the PSF in knots from its middle, shape (2, samples); `shape`
    the numbers of pixels and of sources.
    """
    pixels, sources = shape
    first = -0.5 * (side - 1) - SUPPORT - 1.0  # of the knots of B-splines that reach inside
    parts = []
    for places in at:
        design = BSpline.design_matrix(places, first + np.arange(side + 10), 3)
        parts.append((design.indices.reshape(-1, SUPPORT) - 3, design.data.reshape(-1, SUPPORT)))
    (i, wx), (j, wy) = parts
    values = light[:, None, None] * wy[:, :, None] * wx[:, None, :]
    within = ((j >= 0) & (j < side))[:, :, None] & ((i >= 0) & (i < side))[:, None, :]
    knot = (source[:, None] * side + j)[:, :, None] * side + i[:, None, :]
    counts = np.bincount(owner, within.sum(axis=(1, 2)), pixels)
    ends, size = np.concatenate([[0], np.cumsum(counts)]), (pixels, sources * side**2)
    index = sparse.get_index_dtype(maxval=max(size[1], int(ends[-1])))  # small ones are faster
    return sparse.csr_array((values[within], knot[within].astype(index), ends.astype(index)), size)
