"""One search for a maximum of a density, from a given start.

The Fisher information plus the prior's curvature is positive definite everywhere. Newton steps with
it in the place of the Hessian go far and converge fast where the model fits. Where it does not,
they overshoot or crawl, so that the differences of gradients over the last few steps correct it:
BFGS updates, damped as Powell does to keep it positive definite. Where that does not help, scipy's
BFGS takes over, in coordinates in which the information is the identity. Where the map folds there
is no density; the search meets the paraboloid that its start predicts instead. Where a prior ends,
a Newton step goes to the highest point, within the prior's support, of the paraboloid at hand, but
not all the way to an edge that is far: a scatter of zero would be hard to leave again. Where that
step vanishes is the maximum, inside the support or at its edge, where the gradient points out of
it.
"""

import itertools
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from bayesfred._typing import Flags, Floats
from bayesfred.model.protocol import TargetDensity

# Standard deviations from the maximum at which the search ends. There log_prob differs from the
# maximum by 5e-8; sums over frames round at 1e-9.
CLOSE_ENOUGH = 3e-4
NEAR = 0.1  # the same where the number of steps is limited
UNNOTICED = 1e-3  # of a log-posterior: a fall that is no reason to stop close to the maximum
# The density is rough where, near the maximum, this many steps do not shorten the next one.
PATIENCE, CLOSER = 2, 0.9
MOST_EVALUATIONS = 300  # after which no more searches begin

SECANTS = 10  # steps that correct the information
LEAST_CURVATURE = 0.1  # of what is known already: less is damped
# Standard deviations from the maximum within which the information changes less than it differs
# from the curvature anyway: it is computed again where it is reported, or where it does not serve.
KEPT = 3.0

# Of the way to an edge of the prior's support that lies farther than a standard deviation.
TOWARDS_EDGE = 0.9

# A Newton step is followed by another if it gains this part of what it predicts.
AS_PREDICTED = 0.1

NO_DENSITY = (
    "start: the posterior has no density there, expected parameters within the prior whose map "
    "does not fold, and about where the images are if fluxes or positions are free"
)


class NewtonResult(NamedTuple):
    """Where a search ended.

    Attributes
    ----------
    params : ndarray, shape (d,)
    log_prob : float
    covariance : ndarray, shape (d, d)
        Inverse of Fisher information plus prior curvature there, or nearby where the number of
        steps is limited.
    distance : float
        Length of a Newton step from there in standard deviations, that of the gradient unless the
        prior's support ends before; inf where there is no covariance.
    evaluations : int
        Log-posteriors evaluated, with a gradient each.
    """

    params: Floats
    log_prob: float
    covariance: Floats
    distance: float
    evaluations: int


class _Step(NamedTuple):
    """A Newton step and the coordinates in which its information is the identity."""

    step: Floats  # (d,)
    distance: float  # its length, standard deviations
    predicted: float  # gain in log-probability
    scale: Floats  # (d,)
    scaled: Floats  # (d, d) the information of params / scale
    covariance: Floats  # (d, d)


def maximize(
    posterior: TargetDensity,
    start: Floats,
    *,
    steps: int | None = None,
    information: Floats | None = None,
) -> NewtonResult:
    """Find the maximum above a start, or make a number of Newton steps towards it.

    Parameters
    ----------
    posterior : TargetDensity
    start : ndarray, shape (d,)
        With density.
    steps : int, optional
    information : ndarray, shape (d, d), optional
        `posterior.information` at the start, where it is known already.

    Returns
    -------
    NewtonResult

    References
    ----------
    J. Nocedal & S. Wright, Numerical Optimization, 2nd ed., chapters 3 and 6.
    """
    params, value, evaluations, taken = start, float(posterior.log_prob(start)), 0, 0
    low, high = posterior.support
    close_enough = CLOSE_ENOUGH if steps is None else NEAR
    nearest, stalled, is_own = np.inf, 0, True
    points: deque[tuple[Floats, Floats]] = deque(maxlen=SECANTS + 1)
    while True:
        if information is None:
            information, is_own = posterior.information(params), True
        gradient = posterior.gradient(params)
        try:
            newton = _newton_step(posterior.support, params, gradient, information)
            serves = close_enough < newton.distance < CLOSER * nearest
            if not (is_own or steps or (serves and evaluations < MOST_EVALUATIONS)):
                information, is_own = posterior.information(params), True
                newton = _newton_step(posterior.support, params, gradient, information)
        except linalg.LinAlgError:  # a flat prior and a frame that says nothing
            unknown = np.full_like(information, np.nan)
            return NewtonResult(params, value, unknown, np.inf, evaluations)
        points.append((params, gradient))
        way = newton
        if len(points) > 1:
            with suppress(linalg.LinAlgError):
                curvature = _corrected(information, points)
                way = _newton_step(posterior.support, params, gradient, information, curvature)
        closer = newton.distance < CLOSER * nearest
        nearest, stalled = (newton.distance, 0) if closer else (nearest, stalled + 1)
        if (
            newton.distance < close_enough
            or (newton.distance < NEAR and stalled == PATIENCE)
            or evaluations >= MOST_EVALUATIONS
            or taken == steps
        ):
            break
        taken += 1
        params, value, gain, fraction, spent = _advance(posterior, params, value, way, newton)
        evaluations += spent
        gains = 0.0 < gain < np.inf
        predicted = way.predicted * fraction * (2.0 - fraction)
        if gains and (steps is not None or gain > AS_PREDICTED * predicted):
            information = information if newton.distance < KEPT else None
            is_own = False
            continue
        information = None
        if not is_own:
            continue
        if steps is not None:
            break
        directions = _free_directions(newton, (low < params) & (params < high))
        result = _search(posterior, params, value, directions)
        evaluations += result.nfev
        if result.fun < 0.0:
            params = params + directions @ result.x
            value = float(posterior.log_prob(params))
        elif not gains:
            break
    return NewtonResult(params, value, newton.covariance, newton.distance, evaluations)


def _advance(
    posterior: TargetDensity, params: Floats, value: float, way: _Step, newton: _Step
) -> tuple[Floats, float, float, float, int]:
    """Where the largest part of a step that gains leads, its value and gain, and the part.

    At last how many log-posteriors that took. The parts are 1, 1/2, ... 1/512.
    """
    gain, fraction, evaluations = -np.inf, 1.0, 0
    for fraction in 0.5 ** np.arange(10):
        there = np.clip(params + fraction * way.step, *posterior.support)
        higher = float(posterior.log_prob(there))
        gain = higher - value
        evaluations += 1
        if newton.distance < NEAR and -UNNOTICED < gain <= 0.0:
            # the gradient's root is the maximum: for a model error it is that of log_prob to
            # some hundredths of a standard deviation only
            return there, higher, way.predicted, fraction, evaluations
        if 0.0 < gain < np.inf:
            return there, higher, gain, fraction, evaluations
    return params, value, gain, fraction, evaluations


def _reach(
    support: tuple[Floats, Floats], params: Floats, information: Floats
) -> tuple[Floats, Floats]:
    """How far a step may go: to the support's edges, or most of the way to those that are far.

    Where some source lies off its place, the density of the scatter of positions rises from zero as
    a power: Newton's steps from there would only double it.
    """
    low, high = (
        np.where(
            np.abs(edge - params) * np.sqrt(np.diag(information)) > 1.0,
            params + TOWARDS_EDGE * (edge - params),
            edge,
        )
        for edge in support
    )
    return low, high


def _newton_step(
    support: tuple[Floats, Floats],
    params: Floats,
    gradient: Floats,
    information: Floats,
    curvature: Floats | None = None,
) -> _Step:
    """The step to the top of the paraboloid within reach; LinAlgError if it has none.

    Its curvature is the information, or another one that is better known.
    """
    low, high = _reach(support, params, information)
    information = _at_edges(
        information if curvature is None else curvature, params, gradient, (low, high)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = 1.0 / np.sqrt(np.diag(information))  # rows differ by many orders of magnitude
    scaled = information * np.outer(scale, scale)
    if not np.isfinite(scaled).all():
        raise linalg.LinAlgError
    lower = linalg.cholesky(scaled, lower=True)
    whiten = scale[:, None] * linalg.solve_triangular(lower, np.eye(scale.size), lower=True).T
    slope = whiten.T @ gradient
    step, length = whiten @ slope, slope
    if np.any(params + step < low) or np.any(params + step > high):
        bounds = ((low - params) / scale, (high - params) / scale)
        shares = optimize.lsq_linear(lower.T, slope, bounds, method="bvls").x
        step, length = scale * shares, lower.T @ shares
    predicted = float(slope @ length - 0.5 * length @ length)
    return _Step(step, float(np.linalg.norm(length)), predicted, scale, scaled, whiten @ whiten.T)


def _corrected(information: Floats, points: Sequence[tuple[Floats, Floats]]) -> Floats:
    """The information with the curvature that was met between points where the gradient is known.

    References
    ----------
    J. Nocedal & S. Wright, Numerical Optimization, 2nd ed., procedure 18.2 (damped BFGS).
    """
    out = information.copy()
    for (params, gradient), (later, then) in itertools.pairwise(points):
        step, met = later - params, gradient - then
        known = out @ step
        expected, found = step @ known, step @ met
        if not (expected > 0.0 and np.isfinite(found)):
            continue
        if found < LEAST_CURVATURE * expected:
            share = (1.0 - LEAST_CURVATURE) * expected / (expected - found)
            met = share * met + (1.0 - share) * known
            found = step @ met
        out += np.outer(met, met) / found - np.outer(known, known) / expected
    return out


def _at_edges(
    information: Floats, params: Floats, gradient: Floats, support: tuple[Floats, Floats]
) -> Floats:
    """The information as far as it describes the density where a prior's support ends.

    Where the background has no counts, the log-posterior falls linearly from its edge, while the
    information about it has no bound. A fall by exp(-g x) has the standard deviation 1/g; it stands
    for information that predicts less. A maximum inside is no such fall, however close the edge:
    there a Newton step does not go there.
    """
    information, known = information.copy(), np.diag(information).copy()
    room = np.where(gradient < 0.0, params - support[0], support[1] - params)
    falls = (room * np.sqrt(known) <= 1.0) & (np.abs(gradient) >= 0.5 * known * room)
    for k in np.flatnonzero(falls | (room <= 0.0)):
        if known[k] > gradient[k] ** 2 > 0.0:
            information[k], information[:, k] = 0.0, 0.0
            information[k, k] = gradient[k] ** 2
    return information


def _free_directions(newton: _Step, is_inside: Flags) -> Floats:
    """Whitened directions, shape (d, n), of the n parameters that are not at a bound."""
    inside = np.flatnonzero(is_inside)
    lower = linalg.cholesky(newton.scaled[np.ix_(inside, inside)], lower=True)
    whiten = linalg.solve_triangular(lower, np.eye(inside.size), lower=True).T
    directions = np.zeros((newton.scale.size, inside.size))
    directions[inside] = newton.scale[inside, None] * whiten
    return directions


def _search(
    posterior: TargetDensity, origin: Floats, value: float, directions: Floats
) -> optimize.OptimizeResult:
    """BFGS on what log_prob lacks of its value at the origin."""

    def cost(z: Floats) -> tuple[float, Floats]:
        params = origin + directions @ z
        here = float(posterior.log_prob(params))
        if not np.isfinite(here):
            return 1.0 + 0.5 * float(z @ z), z
        return value - here, -(directions.T @ posterior.gradient(params))

    options = {"gtol": CLOSE_ENOUGH, "norm": 2, "maxiter": 100}
    start = np.zeros(directions.shape[1])
    return optimize.minimize(cost, start, jac=True, method="BFGS", options=options)
