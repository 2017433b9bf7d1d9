"""LaplaceMove's proposals against scipy's densities.

What it samples is tested in `test_sampling_exactness.py`.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
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
from bayesfred.model.parameters import SCALES, Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.moves import DEGREES_OF_FREEDOM, HEAVY_SHARE, LaplaceMove

Floats = NDArray[np.float64]

WIDTH = 0.06  # of the scales of `Scaled`


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


def usable(move: LaplaceMove, posterior: TargetDensity) -> float:
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


@dataclass(frozen=True)
class Scaled(TargetDensity):
    """Twenty normal parameters around zero whose deviation is the product of scales.

    Given the others a scale is normal around one, the first one as far as `largest`. The
    information is `overstated` times what minus the Hessian says at the maximum.
    """

    scales: tuple[str, ...]
    overstated: float = 1.3
    largest: float = np.inf

    @property
    def hyperparameters(self) -> tuple[str, ...]:
        return self.scales[:-1]

    @property
    def parameter_names(self) -> tuple[str, ...]:
        return (*(f"x{i}" for i in range(20)), *self.scales)

    @property
    def support(self) -> tuple[Floats, Floats]:
        low = np.repeat([-np.inf, 0.0], [20, len(self.scales)])
        high = np.full(low.size, np.inf)
        high[20] = self.largest
        return low, high

    def log_prob(self, params: npt.ArrayLike) -> Any:
        x, scales = np.split(np.asarray(params), [20], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            deviation = scales.prod(axis=-1)
            own = -20.0 * np.log(deviation) - 0.5 * (x**2).sum(axis=-1) / deviation**2
            out = own - 0.5 * ((scales - 1.0) ** 2).sum(axis=-1) / WIDTH**2
        inside = (scales > 0.0).all(axis=-1) & (scales[..., 0] <= self.largest)
        return np.where(inside, out, -np.inf)

    def gradient(self, params: npt.ArrayLike) -> Floats:
        x, scales = np.split(np.asarray(params), [20])
        squared = x @ x / scales.prod() ** 2
        return np.append(
            -x / scales.prod() ** 2, (squared - 20.0) / scales - (scales - 1.0) / WIDTH**2
        )

    def information(self, params: npt.ArrayLike) -> Floats:
        scales = np.asarray(params)[20:]
        known = np.append(np.full(20, scales.prod() ** -2.0), np.full(scales.size, WIDTH**-2.0))
        return np.diag(self.overstated * known)

    @property
    def estimate(self) -> MapEstimate:
        # s (s - 1) = -20 WIDTH^2 where the gradient by a scale s is zero
        top = 0.5 + np.sqrt(0.25 - 20.0 * WIDTH**2)
        params = np.append(np.zeros(20), np.full(len(self.scales), top))
        covariance = np.linalg.inv(self.information(params))
        return MapEstimate(params, covariance, float(self.log_prob(params)), 0, "")


@pytest.mark.parametrize("scales", [SCALES[1:], SCALES])
def test_scales_and_errors_are_those_of_the_posterior(scales: tuple[str, ...]) -> None:
    density = Scaled(scales)
    estimate = density.estimate
    assert density.gradient(estimate.params) == pytest.approx(0.0, abs=1e-9)
    move = LaplaceMove.of(density, estimate)
    draws = move.draw(20_000, np.random.RandomState(5))
    # given the scales the integral over the others does not depend on them
    expected = stats.norm(1.0, WIDTH)
    limit = LIMIT / np.sqrt(len(draws))
    assert abs(draws[:, -1].mean() - expected.mean()) < 0.1 * WIDTH + limit * WIDTH
    assert draws[:, -1].std() == pytest.approx(WIDTH, rel=0.1)
    # which a verdict asks for; known to 0.01 of 2,000 draws
    assert usable(move, density) > 0.8
    # negative control: the information and the maximum alone
    assert usable(LaplaceMove(estimate.params, estimate.covariance), density) < 0.5


@pytest.mark.parametrize("largest", [1.2, 1.05, 0.95])  # the maximum is at 0.92
def test_a_scatter_is_nested_as_far_as_its_prior_goes(largest: float) -> None:
    density = Scaled(SCALES, largest=largest)
    move = LaplaceMove.of(density, density.estimate)
    scatters = move.means[:, list(move.order).index(20)]
    assert 0.97 * largest < scatters.max() < largest
    # 0.01 of it Monte Carlo error; approximations beyond the prior, drawn to its edge, had 0.003
    assert usable(move, density) > 0.6
