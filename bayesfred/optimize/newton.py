"""One climb to a maximum of a posterior, from a given start.

The Fisher information plus the prior's curvature is positive definite everywhere. Newton steps with
it in the place of the Hessian go far and converge fast where the model fits. Where it does not,
they overshoot or crawl; there scipy's BFGS takes over, in coordinates in which that matrix is the
identity, and learns from gradients alone how the Hessian differs from it. Where the map folds there
is no density; the search meets the bowl that its start predicts instead. Where a prior ends, a
Newton step goes to the highest point, within the prior's support, of the paraboloid that it climbs.
Where that step vanishes is the maximum, inside the support or at its edge, where the gradient
points out of it.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from bayesfred._typing import Floats
from bayesfred.model.posterior import Posterior

# standard deviations from the maximum, where log_prob differs from it by 5e-8; sums over frames
# round at 1e-9
CLOSE_ENOUGH = 3e-4
NEAR = 0.1  # ... where only so many steps are asked for
MOST_EVALUATIONS = 300  # after which no more searches begin
AS_PREDICTED = (
    0.5  # a Newton step whose gain is what it predicts to within this part is followed by another
)


class NewtonResult(NamedTuple):
    """Where a climb ended.

    Attributes
    ----------
    params : ndarray, shape (d,)
    log_prob : float
    covariance : ndarray, shape (d, d)
        Inverse of Fisher information plus prior curvature there.
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


def maximize(
    posterior: Posterior, start: Floats, *, steps: int | None = None, fisher: Floats | None = None
) -> NewtonResult:
    """The maximum above a start at which the posterior has density, or where so many Newton steps towards it lead.

    Parameters
    ----------
    posterior : Posterior
    start : ndarray, shape (d,)
    steps : int, optional
    fisher : ndarray, shape (d, d), optional
        The Fisher information at the start, where it is known already.

    Returns
    -------
    NewtonResult

    References
    ----------
    J. Nocedal & S. Wright, Numerical Optimization, 2nd ed., chapters 3 and 6.
    """
    params, value, evaluations, taken = start, float(posterior.log_prob(start)), 0, 0
    low, high = posterior.support
    while True:
        gradient = posterior.gradient(params)
        information = _information(posterior, params, gradient, fisher)
        fisher = None
        scale = 1.0 / np.sqrt(
            np.diag(information)
        )  # rows differ in scale by many orders of magnitude
        try:
            lower = linalg.cholesky(information * np.outer(scale, scale), lower=True)
        except linalg.LinAlgError:  # a flat prior and a frame that says nothing
            return NewtonResult(
                params, value, np.full_like(information, np.nan), np.inf, evaluations
            )
        whiten = scale[:, None] * linalg.solve_triangular(lower, np.eye(scale.size), lower=True).T
        slope = whiten.T @ gradient
        step, length = whiten @ slope, slope
        if np.any(params + step < low) or np.any(params + step > high):
            bounds = ((low - params) / scale, (high - params) / scale)
            shares = optimize.lsq_linear(lower.T, slope, bounds, method="bvls").x
            step, length = scale * shares, lower.T @ shares
        distance, predicted = (
            float(np.linalg.norm(length)),
            float(slope @ length - 0.5 * length @ length),
        )
        if (
            distance < (CLOSE_ENOUGH if steps is None else NEAR)
            or evaluations >= MOST_EVALUATIONS
            or taken == steps
        ):
            break
        gain, taken = -np.inf, taken + 1
        for fraction in 0.5 ** np.arange(10):
            there = np.clip(params + fraction * step, low, high)
            gain = float(posterior.log_prob(there)) - value
            evaluations += 1
            if gain > 0.0:
                params, value = there, value + gain
                break
        if gain > 0.0 and (steps is not None or abs(gain / predicted - 1.0) < AS_PREDICTED):
            continue
        if steps is not None:
            break
        inside = np.flatnonzero(
            (low < params) & (params < high)
        )  # the others stay at their bounds in this search
        lower = linalg.cholesky(
            (information * np.outer(scale, scale))[np.ix_(inside, inside)], lower=True
        )
        directions = np.zeros((params.size, inside.size))
        directions[inside] = (
            scale[inside, None] * linalg.solve_triangular(lower, np.eye(inside.size), lower=True).T
        )
        result = _search(posterior, params, value, directions)
        evaluations += result.nfev
        if result.fun < 0.0:
            params, value = params + directions @ result.x, value - result.fun
        elif not gain > 0.0:
            break
    return NewtonResult(
        params, float(posterior.log_prob(params)), whiten @ whiten.T, distance, evaluations
    )


def _information(
    posterior: Posterior, params: Floats, gradient: Floats, fisher: Floats | None
) -> Floats:
    """Fisher information plus prior curvature, as far as it describes the posterior where a prior's support ends.

    Where the background has no counts, the log-posterior falls linearly from its edge, while the
    information about it has no bound. A fall by exp(-g x) has the standard deviation 1/g; it stands
    for information that predicts less.
    """
    information = (
        posterior.information(params) if fisher is None else posterior.information(params, fisher)
    )
    known = np.diag(information).copy()
    room = np.where(
        gradient < 0.0, params - posterior.support[0], posterior.support[1] - params
    )  # towards which it climbs
    for k in np.flatnonzero((room * np.sqrt(known) <= 1.0) | (room <= 0.0)):
        if known[k] > gradient[k] ** 2 > 0.0:
            information[k], information[:, k] = 0.0, 0.0
            information[k, k] = gradient[k] ** 2
    return information


def _search(
    posterior: Posterior, origin: Floats, value: float, whiten: Floats
) -> optimize.OptimizeResult:
    """BFGS on what log_prob lacks of its value at the origin."""

    def cost(z: Floats) -> tuple[float, Floats]:
        params = origin + whiten @ z
        here = float(posterior.log_prob(params))
        if not np.isfinite(here):
            return 1.0 + 0.5 * float(z @ z), z
        return value - here, -(whiten.T @ posterior.gradient(params))

    options = {"gtol": CLOSE_ENOUGH, "norm": 2, "maxiter": 100}
    return optimize.minimize(
        cost, np.zeros(whiten.shape[1]), jac=True, method="BFGS", options=options
    )
