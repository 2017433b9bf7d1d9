"""Free fluxes of sources that overlap, against Newton's method on dense templates."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import gammaln

import bayesfred as bf

Floats = NDArray[np.float64]

THETA = [1e-4, -5e-5, 1e-4]
BACKGROUND = 3.0


def field(sigma: float, close: float, wrong: float) -> tuple[bf.Posterior, bf.ForwardModel]:
    """Nine sources that overlap, a tenth beside the middle one, and catalogue fluxes that err."""
    grid = bf.SourceCatalog.grid(3, 4.0 * sigma, 3e5)
    x, y = np.append(grid.x, close), np.append(grid.y, 0.5 * close)
    flux = np.append(grid.flux * np.linspace(0.3, 1.7, 9), 2e5)
    side = int(20 * sigma) | 1
    model = bf.ForwardModel(
        bf.Detector((side, side)),
        bf.SourceCatalog(x, y, flux),
        bf.GaussianPSF(sigma),
        bf.PolynomialDistortion([(1, 0, 1, 0), (0, 1, 1, 0)], [(0, 1, 0, 1)]),
    )
    counts = bf.simulate(model, THETA, BACKGROUND, seed=1)
    catalogue = bf.SourceCatalog(x, y, flux * wrong)
    known = bf.ForwardModel(model.detector, catalogue, model.psf, model.distortion)
    return bf.Posterior(known, counts, nuisances=bf.Nuisances(flux="free")), known


def dense(posterior: bf.Posterior, model: bf.ForwardModel) -> float:
    """The profiled log-likelihood, every pixel of every source, by plain Newton steps."""
    s, params = model.sources, np.array([*THETA, BACKGROUND])
    k = np.stack(
        [
            bf.ForwardModel(
                model.detector, bf.SourceCatalog([a], [b], [1.0]), model.psf, model.distortion
            ).expected_counts(THETA)
            for a, b in zip(s.x, s.y, strict=True)
        ]
    ).reshape(len(s), -1)
    n, shape = posterior.counts.ravel(), posterior.nuisances.flux_shape
    scale, flux = s.flux / shape, s.flux.copy()
    for _ in range(60):
        mu = flux @ k + params[-1]
        hessian = (k * (n / mu**2)) @ k.T + np.diag(shape / flux**2)
        step = np.linalg.solve(hessian, k @ (n / mu - 1.0) + shape / flux - 1.0 / scale)
        largest = np.abs(step / flux).max()
        flux += step / (1.0 + largest if largest > 0.5 else 1.0)
    mu = flux @ k + params[-1]
    prior = (shape - 1.0) * np.log(flux / scale) - flux / scale - gammaln(shape) - np.log(scale)
    value = np.sum(n * np.log(mu) - mu - gammaln(n + 1.0)) + np.sum(prior)
    _, determinant = np.linalg.slogdet(hessian)
    return float(value + 0.5 * len(s) * np.log(2.0 * np.pi) - 0.5 * determinant)


@pytest.mark.parametrize("sigma", [1.5, 8.0])
@pytest.mark.parametrize("close", [1.2, 0.3])  # widths of the PSF, times sigma below
@pytest.mark.parametrize("wrong", [1.0, 0.02, 30.0])
def test_fluxes_that_overlap_are_those_of_plain_newton_steps(
    sigma: float, close: float, wrong: float
) -> None:
    posterior, model = field(sigma, close * sigma, wrong)
    params = np.array([*THETA, BACKGROUND])
    found = posterior.log_prob(params) - posterior.log_prior(params[None])[0]
    # bright sources have no next term of the expansion; the PSF's tails differ by the tolerance
    assert not posterior.likelihood._faint.any() or wrong < 1.0
    assert abs(found - dense(posterior, model)) < 2e-6 + 0.1 * posterior.likelihood._faint.any()


def test_a_step_of_every_parameter_changes_the_likelihood_as_the_gradient_says() -> None:
    posterior, _ = field(8.0, 9.0, 1.0)
    params = np.array([*THETA, BACKGROUND])
    errors = np.sqrt(np.diag(np.linalg.inv(posterior.fisher(params))))
    slope = posterior.gradient(params) * errors
    for k, error in enumerate(errors):
        step = np.zeros(params.size)
        step[k] = 0.01 * error
        change = posterior.log_prob(params + step) - posterior.log_prob(params - step)
        assert abs(change / 0.02 - slope[k]) < 1e-4 * max(1.0, np.abs(slope).max())
