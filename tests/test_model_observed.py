"""The observed information of the parameters that displace images, against dense differences."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import bayesfred as bf
from bayesfred.model.observed import displacing_parameters
from bayesfred.sampling import approximations
from bayesfred.sampling.laplace import check_approximation

Floats = NDArray[np.float64]

LENS = bf.PolynomialDistortion(
    [(1, 0, 0, 0), (0, 1, 0, 0), (2, 0, 0, 0)], [(1, 0, 0, 0), (0, 1, 0, 0), (1, 1, 0, 0)]
)
THETA = [2e-3, 1e-3, 1e-5, -1e-3, 1e-3, 2e-5]
SCATTER = bf.Nuisances("free", offset=True, position_scatter=True, model_error=True)


def stars(
    seed: int, number: int = 40, blended: float = 0.0, distortion: Any = LENS, theta: Any = THETA
) -> tuple[bf.Posterior, bf.MapEstimate]:
    """Stars whose positions scatter normally, of which some have a neighbour."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-85.0, 85.0, (2, number))
    near = rng.random(number) < blended
    x, y = np.append(x, x[near] + 4.0), np.append(y, y[near])
    sources = bf.SourceCatalog(x, y, 1e4 * rng.lognormal(0.0, 0.5, x.size))
    moved = replace(sources, x=x + rng.normal(0.0, 0.1, x.size), y=y + rng.normal(0.0, 0.1, x.size))
    model = bf.ForwardModel(bf.Detector((201, 201)), sources, bf.GaussianPSF(1.6), distortion)
    counts = bf.simulate(replace(model, sources=moved), theta, 20.0, seed=seed)
    posterior = bf.Posterior(model, counts, nuisances=SCATTER)
    return posterior, bf.find_map(posterior)


def by_differences(posterior: bf.Posterior, params: Floats, which: Floats, share: float) -> Floats:
    """Differences of the gradient over that share of an error to either side."""
    covariance = np.linalg.inv(posterior.information(params)[np.ix_(which, which)])
    root, out = np.linalg.cholesky(covariance), []
    for column in root.T:
        step = np.zeros(params.size)
        step[which] = share * column
        above, below = (posterior.gradient(at)[which] for at in (params + step, params - step))
        out.append((below - above) @ root / (2.0 * share))
    return np.array(out)  # in units of the errors


def relative(posterior: bf.Posterior, params: Floats, which: Floats) -> Floats:
    expected = posterior.information(params)
    root = np.linalg.cholesky(np.linalg.inv(expected[np.ix_(which, which)]))
    covariance = np.linalg.inv(expected)
    return np.asarray(root.T @ posterior.observed_information(params, covariance)[1] @ root)


@pytest.mark.parametrize("basis", [False, True])
def test_it_is_the_gradients_difference(basis: bool) -> None:
    """Of sources by themselves, displaced by as much as typical draws displace them."""
    lens = LENS
    if basis:  # coefficients of combinations of terms
        mixed = np.random.default_rng(1).normal(size=(6, 3)) * np.array([[1.0, 1, 1e-2] * 2]).T
        lens = bf.PolynomialDistortion(LENS.f_terms, LENS.g_terms, mixed, "one two three")
    posterior, best = stars(1, distortion=lens, theta=np.zeros(lens.n_terms))
    which = displacing_parameters(posterior.likelihood)
    names = [posterior.parameter_names[k] for k in which]
    assert names == [*lens.names, "offset_x", "offset_y"]
    found = relative(posterior, best.params, which)
    exact = by_differences(posterior, best.params, which, 1.0)
    assert found == pytest.approx(exact, abs=0.02)
    # which the Fisher information is not
    assert np.abs(exact - np.eye(which.size)).max() > 0.1


def test_blended_sources_are_displaced_alike() -> None:
    posterior, best = stars(3, blended=0.5)
    which = displacing_parameters(posterior.likelihood)
    found = relative(posterior, best.params, which)
    exact = by_differences(posterior, best.params, which, 1.0)
    assert found == pytest.approx(exact, abs=0.03)


def test_the_priors_curvature_is_in_it() -> None:
    """A prior of a coefficient as narrow as its error doubles the information about it."""
    posterior, best = stars(5)
    sd = float(np.linalg.inv(posterior.information(best.params))[0, 0] ** 0.5)
    narrow = {"f_x": stats.norm(best.params[0], sd)}
    other = replace(posterior, prior={**posterior.prior, **narrow})
    before, after = (
        each.observed_information(best.params, best.covariance)[1] for each in (posterior, other)
    )
    added = np.zeros_like(before)
    added[0, 0] = sd**-2 - posterior.prior_curvature(best.params)[0]
    np.testing.assert_allclose(after - before, added, rtol=1e-6, atol=1e-6 * before.max())


def test_where_it_is_not_told() -> None:
    posterior, best = stars(4)
    bends = replace(posterior.model, distortion=bf.PolynomialDistortion([(1, 0, 1, 0)], []))
    for other in (
        bf.Posterior(bends, posterior.counts, nuisances=SCATTER),
        bf.Posterior(posterior.model, posterior.counts, nuisances=replace(SCATTER, offset=False)),
    ):
        assert displacing_parameters(other.likelihood).size == 0
        assert approximations._observed(other, other.start(), np.eye(other.n_parameters)) is None
    # nor where the posterior is not normal
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(approximations, "WIDEST", 1.01)
        assert approximations._observed(posterior, best.params, best.covariance) is None
    # or where a source has no image
    nowhere = (np.arange(8), np.full((8, 8), np.nan))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bf.Posterior, "observed_information", lambda *_: nowhere)
        assert approximations._observed(posterior, best.params, best.covariance) is None
    assert approximations._observed(posterior, best.params, best.covariance) is not None


@pytest.mark.slow
def test_draws_have_the_errors_that_it_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """The importance efficiency of draws with it, less that without it: each is known to 0.06."""
    terms = [(n - j, j, 0, 0) for n in (1, 2, 3) for j in range(n + 1)]
    lens = bf.PolynomialDistortion(terms, terms)
    gained = []
    for seed in range(4):
        posterior, best = stars(50 + seed, 150, distortion=lens, theta=np.zeros(18))
        with_it = check_approximation(bf.laplace(posterior, best, seed=1, progress=False))
        with monkeypatch.context() as patch:
            patch.setattr(approximations, "_observed", lambda *_: None)
            without = check_approximation(bf.laplace(posterior, best, seed=1, progress=False))
        gained.append(with_it.efficiency - without.efficiency)
    assert np.mean(gained) > 0.1
