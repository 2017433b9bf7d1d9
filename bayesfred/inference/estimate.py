"""The posterior's maximum and its Laplace approximation.

scipy's trust-region method gets the exact gradient and, as Hessian, the Fisher information plus the prior's curvature,
which is positive definite everywhere. The search runs in coordinates in which that matrix is the identity at the start.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import linalg, optimize

from bayesfred.errors import InputError
from bayesfred.inference import priors
from bayesfred.inference.posterior import Posterior

Floats = npt.NDArray[np.float64]

# A combination of parameters about which the frame adds less than this share to its prior's information is not measured.
LEAST_INFORMATION = 0.01

# The maximum is found where a Newton step from it would move no parameter by more than this share of its error.
CLOSENESS = 1e-3


@dataclass(frozen=True, eq=False)
class MapEstimate:
    """The posterior's maximum.

    Attributes
    ----------
    params : ndarray, shape (d,)
        Most probable parameters, in the order of `Posterior.parameter_names`.
    covariance : ndarray, shape (d, d)
        Inverse of Fisher information plus prior curvature there: the Laplace approximation.
    log_prob : float
        Log-posterior density there.
    converged : bool
        Whether the gradient vanishes within 1e-3 standard deviations.
    n_evaluations : int
        Log-posteriors evaluated.
    message : str
        How the search ended.
    """

    params: Floats
    covariance: Floats
    log_prob: float
    converged: bool
    n_evaluations: int
    message: str

    def write(self, group: Any) -> None:
        """Store the estimate in an HDF5 group."""
        group.create_dataset("params", data=self.params)
        group.create_dataset("covariance", data=self.covariance)
        group.attrs["message"] = np.bytes_(self.message.encode())
        for name in ("log_prob", "converged", "n_evaluations"):
            group.attrs[name] = getattr(self, name)

    @classmethod
    def read(cls, group: Any) -> "MapEstimate":
        """The estimate stored in an HDF5 group by `write`."""
        a = group.attrs
        return cls(
            group["params"][()],
            group["covariance"][()],
            float(a["log_prob"]),
            bool(a["converged"]),
            int(a["n_evaluations"]),
            bytes(a["message"]).decode(),
        )


def undetermined(posterior: Posterior, params: Floats) -> tuple[str, ...]:
    """Parameters about which neither the frame nor a prior that was given says anything.

    With S the default priors' standard deviations, the eigenvalues of S I S compare, direction by direction, what is known
    with what the default priors know; I is the Fisher information plus what the given priors know more than the default ones.
    The names are those that make up the directions whose eigenvalue is below `LEAST_INFORMATION`.
    """
    sd = np.array([posterior.default_prior(name).std() for name in posterior.parameter_names])
    given = np.array([priors.slope(p, x)[1] for p, x in zip(posterior.prior.values(), params, strict=True)])
    information = posterior.fisher(params) + np.diag(np.maximum(given - sd**-2.0, 0.0))
    values, vectors = np.linalg.eigh(information * np.outer(sd, sd))
    weak = (vectors[:, values < LEAST_INFORMATION] ** 2).sum(axis=1) > 0.1
    return tuple(name for name, is_weak in zip(posterior.parameter_names, weak, strict=True) if is_weak)


def find_map(posterior: Posterior, start: Sequence[float] | Floats | None = None) -> MapEstimate:
    """Maximise the posterior.

    Parameters
    ----------
    posterior : Posterior
    start : array_like, shape (d,), optional
        Where to begin; by default without distortion, see `Posterior.start`.

    Returns
    -------
    MapEstimate

    Raises
    ------
    InputError
        If the start has no posterior density, or the frame cannot determine some parameters, which are named.

    References
    ----------
    J. Nocedal & S. Wright, Numerical Optimization, 2nd ed., chapter 4.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=1))
    >>> find_map(posterior).converged
    True
    """
    origin = posterior.start() if start is None else np.array(start, dtype=np.float64)
    if not np.isfinite(posterior.log_prob(origin)):
        raise InputError("start: the posterior has no density there, expected parameters within the prior whose map does not fold")
    weak = undetermined(posterior, origin)
    if weak:
        raise InputError(
            f"parameters: the frame cannot determine {', '.join(weak)}, expected each to move the counts by more than their "
            "noise: leave out terms, add sources, or give these parameters a narrower prior"
        )
    whiten = linalg.inv(linalg.cholesky(posterior.information(origin), lower=True)).T
    n_evaluations = 0

    def place(z: Floats) -> Floats:
        return np.asarray(origin + whiten @ z)

    def cost(z: Floats) -> float:
        nonlocal n_evaluations
        n_evaluations += 1
        return -float(posterior.log_prob(place(z)))

    def curvature(z: Floats) -> Floats:
        matrix = whiten.T @ posterior.information(place(z)) @ whiten
        # NaN where there is no density; scipy asks there too, before it steps back
        return matrix if np.isfinite(matrix).all() else np.eye(z.size)

    result = optimize.minimize(
        cost,
        np.zeros(origin.size),
        method="trust-exact",
        jac=lambda z: -(whiten.T @ posterior.gradient(place(z))),
        hess=curvature,
        options={"gtol": 1e-7, "maxiter": 300, "initial_trust_radius": 100.0, "max_trust_radius": 1e6},
    )
    params = place(result.x)
    covariance = inverse(posterior.information(params))
    gradient = posterior.gradient(params)
    distance = float(np.sqrt(np.maximum(gradient @ covariance @ gradient, 0.0)))
    converged = distance < CLOSENESS
    message = f"gradient {distance:.1g} standard deviations from zero after {result.nit} iterations"
    if not converged:
        message += ": begin elsewhere (start), or fit fewer terms first"
    return MapEstimate(params, covariance, -float(result.fun), converged, n_evaluations, message)


def inverse(matrix: Floats) -> Floats:
    """Inverse of a symmetric positive definite matrix whose rows differ in scale."""
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = linalg.inv(matrix * np.outer(scale, scale))
    return np.asarray(0.5 * (inverse + inverse.T) * np.outer(scale, scale))
