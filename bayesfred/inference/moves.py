"""Proposals for emcee.

`LaplaceMove` proposes from the Laplace approximation, independently of where a walker stands. Where the posterior is
close to Gaussian, as it is for frames with enough photons, nearly every proposal is accepted and a draw is worth almost an
independent one; `sampling.py` mixes it with differential evolution for posteriors that are not.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from emcee.moves import RedBlueMove
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.special import gammaln

from bayesfred.errors import InputError

Floats = npt.NDArray[np.float64]

HEAVY_SHARE = 0.1
DEGREES_OF_FREEDOM = 5.0


class LaplaceMove(RedBlueMove):  # type: ignore[misc]
    r"""Independence proposal: the Laplace approximation with a heavy-tailed share.

    With m and C the approximation's mean and covariance and d^2 = (x - m)^T C^-1 (x - m), the proposal's density is

        q(x) = (1 - w) N(x | m, C) + w t_nu(x | m, C),

    t_nu the multivariate Student distribution; and since it does not depend on the walker's position s, the Hastings
    factor is q(s) / q(x). Where the posterior is Gaussian the ratio of posterior to proposal is at most 1 / (1 - w), so hardly
    a move is rejected; a Student distribution alone, at 10 degrees of freedom in 13 dimensions, would have a quarter of
    them rejected. The share w keeps the ratio bounded where the posterior's tails are heavier than a Gaussian's.

    Parameters
    ----------
    mean : ndarray, shape (d,)
        m, the posterior's maximum.
    covariance : ndarray, shape (d, d)
        C, the Laplace approximation's covariance.

    Raises
    ------
    InputError
        If the covariance is not a positive definite matrix of finite numbers.

    References
    ----------
    L. Tierney (1994), Annals of Statistics 22, 1701, Section 2.3.4 (independence chains). T. Hesterberg (1995),
    Technometrics 37, 185 (defensive mixtures).

    Examples
    --------
    >>> move = LaplaceMove(np.zeros(1), np.eye(1))
    >>> q, log_factor = move.get_proposal(np.zeros((3, 1)), [], np.random.RandomState(1))
    >>> q.shape, log_factor.shape
    ((3, 1), (3,))
    """

    def __init__(self, mean: Floats, covariance: Floats) -> None:
        super().__init__(live_dangerously=True)  # the proposal does not come from the ensemble, whatever its size
        self.mean = mean
        try:
            self.lower = cholesky(np.reshape(covariance, (mean.size, mean.size)), lower=True)
        except (LinAlgError, ValueError):
            raise InputError("estimate: got no positive definite covariance, expected the maximum's: see find_map") from None

    def draw(self, n: int, random: np.random.RandomState) -> Floats:
        """n draws from the proposal, shape (n, d)."""
        z = random.standard_normal((n, self.mean.size))
        stretch = np.sqrt(DEGREES_OF_FREEDOM / random.chisquare(DEGREES_OF_FREEDOM, n))
        heavy = random.random_sample(n) < HEAVY_SHARE
        return np.asarray(self.mean + (z * np.where(heavy, stretch, 1.0)[:, None]) @ self.lower.T)

    def log_density(self, x: Floats) -> Floats:
        """log q at x, shape (n, d), up to the constant that q(m) depends on through C alone."""
        z = solve_triangular(self.lower, (x - self.mean).T, lower=True)
        squared, d, nu = (z**2).sum(axis=0), self.mean.size, DEGREES_OF_FREEDOM
        normal = np.log1p(-HEAVY_SHARE) - 0.5 * squared - 0.5 * d * np.log(2.0 * np.pi)
        peak = gammaln(0.5 * (nu + d)) - gammaln(0.5 * nu) - 0.5 * d * np.log(nu * np.pi)
        student = np.log(HEAVY_SHARE) + peak - 0.5 * (nu + d) * np.log1p(squared / nu)
        return np.asarray(np.logaddexp(normal, student))

    def get_proposal(self, s: Floats, c: Sequence[Floats], random: np.random.RandomState) -> tuple[Floats, Floats]:
        """New positions for the walkers at s, and log q(s) - log q(new); the other walkers c are not used."""
        new = self.draw(len(s), random)
        return new, self.log_density(s) - self.log_density(new)
