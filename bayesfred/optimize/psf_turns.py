"""Turns of the equations of a PSF, towards their solution."""

from collections import deque
from dataclasses import replace

import numpy as np

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.psf.field import field_terms
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.anderson import accelerated
from bayesfred.optimize.psf_equations import SECANTS, STILL, PsfEquations, PsfState, field_radius

TURNS = 40
LATE, NEARLY = 16, 0.01  # turns after which this of an unknown's variance is near enough
CHOOSING = 8  # turns of the strengths of the prior within one
ROUGH = 100.0  # squared standard deviations of an unknown, of a state to begin from
EXACT = 4  # turns in which the model is taken to be exact, at the most
PATIENCE = 6  # turns without a nearer place after which an information leads no more
FARTHER = 10.0  # than the nearest place: there it leads no more at all
LARGEST = 0.4  # change of the PSF in one turn, share of its peak
LEAST = 0.125  # share of a turn's step
DARKEST = 0.1  # of its value that a flux may fall to in one turn


def near(posterior: Posterior, state: PsfState, *, exact: bool = True) -> PsfState:
    """A state near the solution, from which another search can begin."""
    equations = solved(posterior, state, exact=exact, rough=True)
    return moved(posterior, equations.state, change_of(equations))


def solved(
    posterior: Posterior, state: PsfState, *, exact: bool = True, rough: bool = False
) -> PsfEquations:
    """The equations where their solution is.

    Parameters
    ----------
    posterior : Posterior
    state : PsfState
        Where to begin.
    exact : bool
        Take the model to be exact in the first turns.
    rough : bool
        Be content with a state from which another search can begin.

    Returns
    -------
    PsfEquations

    Raises
    ------
    InputError
        If no solution is found.
    """
    close, share, before = False, 1.0, None
    for turn in range(TURNS):
        equations = PsfEquations.of(posterior, state, exact=exact)
        # strengths that are iterated until they rest are the same whatever the start
        equations = equations.with_strengths(CHOOSING if close else 1)
        far = how_far(equations)
        if before is not None and not exact:
            share = float(np.clip(_secant(equations, before, share), LEAST, 1.0))
        close = far < (ROUGH if rough else 1.0) * equations.pull.size
        enough = STILL if turn < LATE else NEARLY * equations.pull.size
        if not exact and (far < enough or (close and rough)):
            return equations
        if close and not exact:
            equations = _followed(posterior, equations)
        before = equations.step
        state = moved(posterior, equations.state, share * change_of(equations))
        # a model error that came first would explain what a PSF too smooth leaves
        exact = exact and not close and turn + 1 < EXACT
    raise InputError(
        f"psf: no PSF found in {TURNS} turns: expected a start that resembles it: fit the width "
        "first (nuisances: psf_sigma), or begin from another PSF"
    )


def _secant(equations: PsfEquations, before: Floats, share: float) -> float:
    """The share of a step that would have ended where nothing is left of it, along itself.

    Weights follow the light, so that steps may go to and fro.
    """
    upper, scale = equations.factor
    taken = upper @ (before / scale)
    left = float(taken @ equations.measured) / float(taken @ taken)
    return share / (1.0 - left) if left < 1.0 else 1.0


def how_far(equations: PsfEquations) -> float:
    """The step's squared length, in standard deviations of all unknowns together."""
    return float(equations.measured @ equations.measured)


def _followed(posterior: Posterior, equations: PsfEquations) -> PsfEquations:
    """The equations where their information and strengths lead, or nearest to it.

    Weights follow the light, and fluxes and positions the PSF: steps turn back or lag behind.
    """
    best, points, since = equations, deque[tuple[Floats, Floats, Floats]](maxlen=SECANTS), 0
    nearest = how_far(best)
    while since < PATIENCE:
        points.append((_place(equations.state), change_of(equations), equations.measured))
        state = moved(posterior, equations.state, accelerated(points))
        equations = PsfEquations.of(posterior, state, known=equations)
        far = how_far(equations)
        since += 1
        if far < nearest:
            best, nearest, since = equations, far, 0
        if far < STILL or not far < FARTHER * nearest:
            break
    return best


def _place(state: PsfState) -> Floats:
    """All that a step changes: deviations, parameters, fluxes and shifts."""
    own = np.column_stack([state.fluxes, state.shifts])
    return np.concatenate([state.deviations, state.params, own.ravel()])


def change_of(equations: PsfEquations) -> Floats:
    """The step as a change of all these."""
    information, step = equations.information, equations.step
    own = np.zeros(3 * equations.state.fluxes.size)
    own[information.which] = equations.own_step - information.response @ step
    return np.concatenate([step, own])


def moved(posterior: Posterior, state: PsfState, change: Floats) -> PsfState:
    """The state after a change, or as much of it as leaves the PSF recognisable."""
    size, unknowns = state.deviations.size, state.deviations.size + state.params.size
    wider = state.grid.combined(np.concatenate([np.zeros(state.grid.fixed), change[:size]]))
    peak = np.abs(state.grid.combined(state.coefficients)[0]).max()
    s = posterior.model.sources
    terms = field_terms(s.x, s.y, state.grid.degree, field_radius(posterior))
    terms = np.unique(terms, axis=0)  # one row where nothing varies
    largest = float(np.abs(terms @ wider.reshape(len(wider), -1)).max())
    change = change * min(1.0, LARGEST * peak / max(largest, 1e-300))
    params, fluxes = state.params + change[size:unknowns], state.fluxes.copy()
    own = change[unknowns:].reshape(-1, 3)
    names = posterior.parameter_names
    if "flux_scale" in names:
        k = names.index("flux_scale")
        params[k] = max(params[k], DARKEST * state.params[k])
        fluxes *= params[k] / state.params[k]
    fluxes = np.maximum(fluxes + own[:, 0], DARKEST * fluxes)
    shifts = state.shifts + own[:, 1:]
    coefficients = state.deviating(state.deviations + change[:size])
    return replace(state, coefficients=coefficients, params=params, fluxes=fluxes, shifts=shifts)
