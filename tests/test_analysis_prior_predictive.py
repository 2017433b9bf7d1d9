"""Prior predictive draws, and draws of free fluxes, against exact integrals."""

import numpy as np
import pytest
from scipy import stats

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.analysis.flux_draws import draw_fluxes
from bayesfred.errors import InputError


def posterior(
    x: tuple[float, ...], flux: float, background: float = 1.0, seed: int = 1
) -> bf.Posterior:
    """Sources in a row, whose fluxes are free."""
    catalog = bf.SourceCatalog(list(x), [0.0] * len(x), [flux] * len(x))
    model = bf.ForwardModel(
        bf.Detector((25, 31)),
        catalog,
        bf.GaussianPSF(2.0),
        bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]),
    )
    counts = bf.simulate(model, [0.0], background, seed=seed)
    return bf.Posterior(model, counts, nuisances=bf.Nuisances("free"))


def weights(target: bf.Posterior, nodes: Floats) -> Floats:
    """The posterior of the fluxes at theta 0 and background 1, on a grid in every one."""
    sources = target.model.sources
    v, u = (np.arange(n) - 0.5 * (n - 1) for n in target.counts.shape)
    templates = [np.exp(-((u - x) ** 2 + v[:, None] ** 2) / 8.0) / (8.0 * np.pi) for x in sources.x]
    mesh = np.meshgrid(*[nodes] * len(sources), indexing="ij")
    log = sum(stats.gamma.logpdf(f, 2.0, scale=0.5 * sources.flux[0]) for f in mesh)
    log = np.array(log)
    for place in np.ndindex(target.counts.shape):
        mu = 1.0 + sum(f * t[place] for f, t in zip(mesh, templates, strict=True))
        log += target.counts[place] * np.log(mu) - mu
    return np.asarray(np.exp(log - log.max()))


@pytest.mark.slow
@pytest.mark.parametrize("x", [(0.0,), (-1.0, 1.0)])
@pytest.mark.parametrize("flux", [5.0, 500.0])
def test_fluxes_are_drawn_from_their_posterior(x: tuple[float, ...], flux: float) -> None:
    """Alone, and in pairs one width apart; 400 draws, refused in one of 1,000 if right."""
    target, params = posterior(x, flux), np.array([0.0, 1.0])
    rng = np.random.default_rng(7)
    draws = np.array([draw_fluxes(target, params, range(len(x)), rng) for _ in range(400)])
    nodes = np.linspace(1e-3, 10.0 * flux if flux < 50.0 else 2.0 * flux, 240)
    density = weights(target, nodes)
    for s in range(len(x)):
        marginal = density.sum(axis=tuple(set(range(len(x))) - {s}))
        share = np.concatenate([[0.0], np.cumsum(marginal)[:-1] + 0.5 * marginal[1:]])
        pit = np.interp(draws[:, s], nodes, share / share[-1])
        assert stats.kstest(pit, "uniform").pvalue > 1e-3
        if flux < 50.0:  # the Gaussian of mode and curvature is not the posterior
            mode, mean = nodes[np.argmax(marginal)], marginal @ nodes / marginal.sum()
            spread = np.sqrt(marginal @ nodes**2 / marginal.sum() - mean**2)
            normal = stats.norm(mode, spread).rvs(400, random_state=rng)
            assert (
                stats.kstest(np.interp(normal, nodes, share / share[-1]), "uniform").pvalue < 1e-3
            )


@pytest.mark.slow
def test_a_close_pair_needs_several_sweeps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half a width apart. Of 400 draws a standard deviation has an error of 3.5 %."""
    target, params = posterior((-0.5, 0.5), 500.0), np.array([0.0, 1.0])
    nodes = np.linspace(1.0, 1200.0, 300)
    density = weights(target, nodes)
    a, b = np.meshgrid(nodes, nodes, indexing="ij")
    exact = np.cov(np.stack([a.ravel(), b.ravel()]), aweights=density.ravel())
    rng, found = np.random.default_rng(3), {}
    for sweeps in (10, 1):  # the second is the negative control
        monkeypatch.setattr("bayesfred.analysis.flux_draws.SWEEPS", sweeps)
        draws = np.array([draw_fluxes(target, params, range(2), rng) for _ in range(400)])
        found[sweeps] = np.cov(draws.T)
    assert exact[0, 1] < -0.8 * np.sqrt(exact[0, 0] * exact[1, 1])
    ratio = {k: np.sqrt(np.diag(each) / np.diag(exact)) for k, each in found.items()}
    assert np.all(np.abs(ratio[10] - 1.0) < 4.0 * 0.035)
    assert found[10][0, 1] == pytest.approx(exact[0, 1], rel=4.0 * 0.07)
    assert ratio[1][0] < 1.0 - 4.0 * 0.035


def test_fixed_fluxes_are_not_drawn() -> None:
    free = posterior((0.0,), 500.0)
    fixed = bf.Posterior(free.model, free.counts)
    with pytest.raises(InputError, match="expected free fluxes"):
        draw_fluxes(fixed, np.array([0.0, 1.0]), [0], np.random.default_rng(1))


def test_prior_predictive_frames_are_those_of_the_prior() -> None:
    """Moments of 400 draws within 4 Monte Carlo errors."""
    free = posterior((-6.0, 6.0), 500.0)
    prior = {"f_ux": stats.norm(0.0, 1e-3), "background": stats.gamma(4.0, scale=0.5)}
    target = bf.Posterior(free.model, free.counts, prior=prior, nuisances=free.nuisances)
    drawn = bf.prior_predictive(target, 400, seed=1)
    assert drawn.params.shape == (400, 2) and drawn.counts.shape == (400, 25, 31)
    background, total = drawn.params[:, 1], drawn.counts.sum(axis=(1, 2))
    assert background.mean() == pytest.approx(2.0, abs=4.0 / 20.0)
    light = total - background * 25 * 31
    assert light.mean() == pytest.approx(1000.0, abs=4.0 * light.std() / 20.0)
    # two fluxes of Gamma(2, 250), and the counts' own noise: a sd of 500 and 51
    assert light.std() == pytest.approx(502.6, rel=4.0 * 0.045)
    assert drawn.refused < 0.01
    again = bf.prior_predictive(target, 3, seed=1)
    assert np.array_equal(again.counts, drawn.counts[:3])


def test_a_prior_that_folds_is_said_so() -> None:
    """Where |f_ux| exceeds 1 / 6, of 1,600 draws and more within 4 standard errors."""
    free = posterior((-6.0, 6.0), 500.0)
    wide = bf.Posterior(free.model, free.counts, prior={"f_ux": stats.norm(0.0, 0.1)})
    folding = 2.0 * stats.norm.cdf(-1.0 / 6.0, scale=0.1)
    error = np.sqrt(folding * (1.0 - folding) / 1600.0)
    assert bf.prior_predictive(wide, 1600, seed=1).refused == pytest.approx(
        folding, abs=4.0 * error
    )
    folded = bf.Posterior(free.model, free.counts, prior={"f_ux": stats.norm(-0.5, 0.01)})
    with pytest.raises(InputError, match="all fold"):
        bf.prior_predictive(folded, 1, seed=1)
    with pytest.raises(InputError, match="draws: got 0"):
        bf.prior_predictive(wide, 0, seed=1)
