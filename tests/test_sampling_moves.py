"""LaplaceMove's proposals against scipy's densities.

What it samples is tested in `test_sampling_exactness.py`.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special, stats
from test_model import LIMIT

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.moves import DEGREES_OF_FREEDOM, HEAVY_SHARE, LaplaceMove

Floats = NDArray[np.float64]


def correlated(d: int, rng: np.random.Generator, decades: int = 6) -> Floats:
    """A correlated covariance whose scales span some decades up to 1."""
    a = rng.standard_normal((d, 2 * d))
    scale = 10.0 ** np.linspace(-decades, 0, d)
    return np.asarray(a @ a.T / (2 * d) * np.outer(scale, scale))


# --- the proposal itself --------------------------------------------------------------------------


@dataclass(frozen=True)
class Mixture:
    """Gaussians of known means, covariances and weights."""

    means: Floats
    covariances: Floats
    weights: Floats

    @classmethod
    def of(cls, d: int, k: int) -> "Mixture":
        rng = np.random.default_rng(10 * d + k)
        covariances = [correlated(d, rng, decades=1) for _ in range(k)]
        return cls(
            0.1 * rng.standard_normal((k, d)), np.array(covariances), rng.dirichlet(np.full(k, 5.0))
        )

    @property
    def move(self) -> LaplaceMove:
        if len(self.weights) == 1:
            return LaplaceMove(self.means[0], self.covariances[0])
        return LaplaceMove(self.means, self.covariances, self.weights)

    def log_density(self, x: Floats, heavy: float) -> Floats:
        """Of the mixture with a share of Student's distributions, by scipy."""
        parts, shares = [], []
        for mean, covariance, weight in zip(
            self.means, self.covariances, self.weights, strict=True
        ):
            parts.append(np.ravel(stats.multivariate_normal(mean, covariance).logpdf(x)))
            parts.append(
                np.ravel(stats.multivariate_t(mean, covariance, DEGREES_OF_FREEDOM).logpdf(x))
            )
            shares += [[weight * (1 - heavy)], [weight * heavy]]
        return np.asarray(special.logsumexp(parts, axis=0, b=shares))


@pytest.mark.parametrize(("d", "k"), [(1, 1), (2, 1), (5, 1), (13, 1), (1, 3), (5, 2)])
def test_hastings_factor_is_the_ratio_of_densities(d: int, k: int) -> None:
    mixture, rng = Mixture.of(d, k), np.random.default_rng(d)
    old = (
        mixture.means[0]
        + 3.0 * (np.linalg.cholesky(mixture.covariances[0]) @ rng.standard_normal((d, 40))).T
    )
    new, factor = mixture.move.get_proposal(old, [], np.random.RandomState(2))
    assert new.shape == (40, d)
    expected = mixture.log_density(old, HEAVY_SHARE) - mixture.log_density(new, HEAVY_SHARE)
    assert factor == pytest.approx(expected, rel=1e-10, abs=1e-10)


@pytest.mark.parametrize(("d", "k"), [(1, 1), (5, 1), (13, 1), (1, 3), (5, 2)])
def test_draws_follow_the_density(d: int, k: int) -> None:
    # under draws from q the mean of p(x) / q(x) is 1 for any density p, here both parts of q and a
    # narrower Gaussian
    mixture = Mixture.of(d, k)
    x = mixture.move.draw(200_000, np.random.RandomState(3))
    log_q = mixture.move.log_density(x)
    narrower = stats.multivariate_normal(mixture.means[0], 0.64 * mixture.covariances[0])
    for log_p in (
        mixture.log_density(x, 0.0),
        mixture.log_density(x, 1.0),
        np.ravel(narrower.logpdf(x)),
    ):
        weight = np.exp(log_p - log_q)
        assert abs(weight.mean() - 1) < LIMIT * weight.std() / np.sqrt(weight.size)


def usable(move: LaplaceMove, posterior: Posterior) -> float:
    """Effective share of the move's draws as draws of the posterior, by importance weights."""
    draws = move.draw(2000, np.random.RandomState(4))
    log_weight = posterior.log_prob(draws) - move.log_density(draws)
    weight = np.exp(log_weight - log_weight.max())
    return float(weight.sum() ** 2 / (weight**2).sum() / len(draws))


def test_scattered_positions_get_a_nested_approximation() -> None:
    rng = np.random.default_rng(43)
    terms = [(1, 0, 0, 0), (0, 1, 0, 0)]  # of many, given the scatter, no Gaussian is good either
    distortion = PolynomialDistortion(terms, terms)
    grid = SourceCatalog.grid(4, 17.5, 5e3)
    off = 0.2 * rng.standard_normal((2, 16))

    def model(x: Floats, y: Floats) -> ForwardModel:
        return ForwardModel(
            Detector((80, 80)), SourceCatalog(x, y, grid.flux), GaussianPSF(1.5), distortion
        )

    counts = simulate(
        model(grid.x + off[0], grid.y + off[1]), np.zeros(distortion.n_terms), 2.0, seed=44
    )
    nuisances = Nuisances("free", offset=True, position_scatter=True)
    posterior = Posterior(model(grid.x, grid.y), counts, nuisances=nuisances)
    estimate = find_map(posterior)
    nested = LaplaceMove.of(posterior, estimate)
    assert len(nested.weights) > 1 and usable(nested, posterior) > 0.5
    # negative control: a single Gaussian is hardly of use
    assert usable(LaplaceMove(estimate.params, estimate.covariance), posterior) < 0.1
