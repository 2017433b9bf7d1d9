"""The PSF of a frame, from all images of its sources.

The expected counts are linear in the PSF's coefficients c, and nearly so in the other parameters
over a step of Newton's method. So c, the distortion, the background and the fluxes are solved for
together, by Fisher scoring of the likelihood and the priors: what a coefficient of the PSF shares
with the distortion or with a flux is neither's alone, and positions are tied to the distortion's
polynomial, which breaks the feedback between pixel phase and PSF. Fluxes and shifts of single
sources, thousands of them, are eliminated.

Two things are the same parameter twice, and conventions tell them apart: the PSF's volume is one
(fluxes are fluxes), and its centroid within a Gaussian of the start's width is zero (the offset and
the distortion say where a source is). Both hold for the variation over the field too.
"""

import math
from dataclasses import replace

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.psf import MeasuredPSF
from bayesfred.imaging.psf.measured import check_choices
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.psf_equations import PsfEquations, PsfState, field_radius
from bayesfred.optimize.psf_levels import STRENGTH
from bayesfred.optimize.psf_nodes import NEAR, PRECISE, NodeEquations
from bayesfred.optimize.psf_samples import PsfSamples
from bayesfred.optimize.psf_split import split
from bayesfred.optimize.psf_start import reach, starting_grid, starting_state, suited_grid
from bayesfred.optimize.psf_turns import TURNS, change_of, how_far, moved, near, solved

LITTLE = 0.3  # standard deviations by which a parameter may be off
SETTLED = 0.95  # of the model error before
NEARBY = 3.0  # squared standard deviations of all that does not vary, beside what does
FALLING = 0.5  # times what they were before, at the most
DRAWS = 100
WINGS = 21.0  # of the grid for wings
WINGS_SEEN = 5.0  # standard deviations of light beyond the fine grid that call for a wider one


def fit_psf(
    posterior: Posterior,
    estimate: MapEstimate,
    *,
    oversampling: int = 4,
    degree: int = 0,
    nodes: int = 0,
) -> MeasuredPSF:
    """Measure the PSF on all images of a frame's sources.

    Parameters
    ----------
    posterior : Posterior
        Its PSF is where the search begins: a Gaussian or a Moffat function of about the right
        width, samples, or a PSF measured on another frame.
    estimate : MapEstimate
        Its maximum.
    oversampling : int
        Knots per pixel, of PSFs with a FWHM up to 1.5 pixels; wider ones have as many per FWHM, and
        2.5 times as many if their edges are sharp, as out of focus.
    degree : int
        Of the polynomial by which the PSF varies over the field; 0 if it does not. The variation
        has half as many knots per pixel, three per FWHM.
    nodes : int
        Instead of a polynomial: so many nodes along each axis of the field, between which the PSF
        varies linearly. It takes hundreds of sources, ten or more a node, and less time than a
        degree of 4.

    Returns
    -------
    MeasuredPSF
        With draws from its posterior: its errors, those of the distortion included.

    Raises
    ------
    InputError
        If `oversampling`, `degree` or `nodes` cannot be used, the detector bins pixels, the
        distortion is no polynomial, too few pixels see a source, or the search does not come to an
        end.

    References
    ----------
    J. Anderson & I. King, PASP 112, 1360 (2000), for the effective PSF. D. MacKay, Neural
    Computation 4, 415 (1992), for the choice of the prior's strength.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65), pixel="box"), bf.SourceCatalog.grid(4, 14.0, 1e5),
    ...     bf.GaussianPSF(1.2), bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-3, 0.0], 5.0, seed=1))
    >>> psf = bf.fit_psf(posterior, bf.find_map(posterior))
    >>> abs(psf.sigma - math.hypot(1.2, 12**-0.5)) < 0.01  # the pixel is in it
    True
    """
    return find_psf(posterior, estimate, oversampling, degree, nodes)[0]


def find_psf(
    posterior: Posterior,
    estimate: MapEstimate,
    oversampling: int,
    degree: int,
    nodes: int,
    start: PsfState | None = None,
) -> tuple[MeasuredPSF, PsfState, Floats]:
    """Measure the PSF as `fit_psf` does, and keep what its errors are made of.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
    oversampling, degree, nodes : int
    start : PsfState, optional
        The solution for nearly the same pixels.

    Returns
    -------
    psf : MeasuredPSF
    state : PsfState
        Where the PSF was found.
    drawn : ndarray, shape (draws, deviations)
        What the draws from the PSF's posterior add to the state's deviations; none with nodes, see
        `node_slopes`.
    """
    check_choices(oversampling, degree, nodes)
    if posterior.model.detector.binning != 1:
        raise InputError(
            f"detector: binning: got {posterior.model.detector.binning}, expected 1: a measured "
            "PSF has one pixel in it; describe the frame in recorded pixels"
        )
    with one_blas_thread():
        if start is not None and start.nodes is not None:
            return _measured_at_nodes(posterior, start)
        begin = start or _start(posterior, estimate, float(oversampling), degree)
        state = near(posterior, begin)
        if not state.grid.wings:
            wider = _with_wings(posterior, state)
            if _light_beyond(posterior, wider) > WINGS_SEEN:
                state = near(posterior, wider, exact=False)
        if nodes:
            return _measured_at_nodes(posterior, state.with_nodes(nodes))
        return _measured(posterior, solved(posterior, state, exact=False))


def _start(
    posterior: Posterior, estimate: MapEstimate, oversampling: float, degree: int
) -> PsfState:
    """Where the search begins: a PSF that does not vary tells which grids it needs."""
    grid = starting_grid(posterior, estimate, oversampling, degree)
    if grid.oversampling == oversampling:
        return starting_state(posterior, estimate, grid)
    constant = starting_state(posterior, estimate, replace(grid, degree=0))
    known = near(posterior, constant)
    suited = suited_grid(grid, known, oversampling)
    if suited is grid and degree == 0:
        return known
    return replace(
        starting_state(posterior, estimate, suited),
        params=known.params, fluxes=known.fluxes, shifts=known.shifts,
    )  # fmt: skip


def _light_beyond(posterior: Posterior, state: PsfState) -> float:
    """By how many standard deviations light that falls as r^-4 lies between fine grid and wings."""
    radius, wings = state.grid.fine_radius, state.grid.wings
    data = PsfSamples.at(posterior, state.params, state.shifts, wings)
    farther = (data.samples.a**2 + data.samples.b**2) / radius**2
    bright = state.fluxes[data.samples.source]
    falling = bright / np.maximum(farther, 1.0) ** 2
    wing = data.image(np.where(farther > 1.0, falling, 0.0))
    beyond = data.image(np.asarray(farther <= 1.0, dtype=np.float64)) == 0.0
    residual, variance = data.residual(posterior, state.params, np.zeros(len(wing)))
    weight = np.where(beyond, 1.0 / variance, 0.0)
    wing = wing - (weight @ wing / weight.sum() if beyond.any() else 0.0)  # of any background
    spread = float(weight @ wing**2)
    return float(weight @ (wing * residual)) / math.sqrt(spread) if spread > 0.0 else 0.0


def _with_wings(posterior: Posterior, state: PsfState) -> PsfState:
    """The state with a grid for wings, which are none yet."""
    wings = min(WINGS * state.grid.sigma, reach(posterior, state.params))
    grid = replace(state.grid, wings=max(wings, state.grid.fine_radius))
    more = grid.conventions.shape[1] - state.coefficients.size
    return replace(
        state,
        grid=grid,
        coefficients=np.append(state.coefficients, np.zeros(more)),
        strengths=np.append(state.strengths, STRENGTH),
    )


def _measured(
    posterior: Posterior, equations: PsfEquations
) -> tuple[MeasuredPSF, PsfState, Floats]:
    """The PSF at the solution, its state, and draws from its posterior."""
    state = equations.state
    size = state.deviations.size
    there = state.deviating(state.deviations + equations.step[:size])
    state = replace(state, coefficients=there)
    drawn = equations.draws(DRAWS)[:size].T
    psf = MeasuredPSF(
        state.grid.combined(there),
        state.grid.oversampling,
        field_radius(posterior),
        draws=np.array(
            [state.grid.combined(state.deviating(state.deviations + one)) for one in drawn]
        ),
        model_error=equations.model_error,
        determined=float(equations.determined().sum()),
    )
    return psf, state, drawn


def _measured_at_nodes(
    posterior: Posterior, state: PsfState
) -> tuple[MeasuredPSF, PsfState, Floats]:
    """The PSF that varies between nodes, its state, and no draws: the nodes' errors are theirs.

    What does not vary, and the background, take steps of their own: where the search began they
    stand for what varies, too.
    """
    state, equations = _in_turns(posterior, _in_turns(posterior, state, NEAR)[0], PRECISE)
    nodes = state.nodes
    assert nodes is not None, "it has as many as before"
    every = state.grid.combined(state.coefficients, nodes.coefficients)
    common = np.tensordot(equations.share, every[1:], 1)
    every[0] += common
    every[1:] -= common
    drawn = state.grid.combined(state.coefficients, equations.draws(nodes.strength, DRAWS))[1:]
    psf = MeasuredPSF(
        every,
        state.grid.oversampling,
        field_radius(posterior, nodes.number),
        nodes=nodes.number,
        draws=(every[0] + drawn)[:, None],
        model_error=equations.model_error,
        determined=nodes.determined,
    )
    return psf, state, np.zeros((0, state.deviations.size))


def _in_turns(
    posterior: Posterior, state: PsfState, precise: float
) -> tuple[PsfState, NodeEquations]:
    """The state where the nodes, and what does not vary, are found in turns; the nodes' equations.

    Turns that come no nearer, for their weights change, end where they were nearest.
    """
    found = best = _at_nodes(posterior, state, precise)
    nearest = math.inf
    while True:
        shared = PsfEquations.of(posterior, split(found[0])).with_strengths(1)
        far = how_far(shared)
        best = found if far < nearest else best
        if far < NEARBY or far > FALLING * nearest:
            return best
        nearest = far
        state = split(moved(posterior, shared.state, change_of(shared)))
        found = _at_nodes(posterior, state, precise)


def _at_nodes(
    posterior: Posterior, state: PsfState, precise: float
) -> tuple[PsfState, NodeEquations]:
    """The state where the nodes are found, as precisely as this, and the equations there."""
    nodes, error, now = state.nodes, math.inf, NEAR
    assert nodes is not None, "the PSF varies between them"
    for _ in range(TURNS):
        equations = NodeEquations.of(posterior, state)
        nodes, change, far = equations.solved(nodes, now)
        error, before = equations.model_error, error
        if far < LITTLE and error >= SETTLED * before:
            if now <= precise:
                return replace(state, nodes=nodes), equations
            now = precise
        every = np.concatenate([np.zeros_like(state.deviations), change])
        state = moved(posterior, replace(state, nodes=nodes), every)
    raise InputError(
        f"psf: no PSF found in {TURNS} turns between {nodes.number} x {nodes.number} nodes: "
        "expected sources at most of them: set fewer nodes"
    )
