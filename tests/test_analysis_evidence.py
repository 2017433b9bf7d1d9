"""The evidence against closed forms, grids and nested sampling; its error against its scatter.

The negative controls are a density that is a tenth wider than the closed form says, and errors
that take correlated draws for independent ones.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from scipy.special import logsumexp
from test_sampling_protocol import RHO, SD, CutGaussian, Wider, top

import bayesfred as bf
from bayesfred.analysis import evidence as module
from bayesfred.analysis.evidence import log_evidence
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.newton import maximize
from bayesfred.sampling.moves import LaplaceMove

Floats = NDArray[np.float64]
# two normal variables, their correlation, and half of a third one
CUT = float(np.log(2.0 * np.pi * SD.prod() * (1.0 - RHO**2) ** 0.5 * (0.5 * np.pi) ** 0.5))


class Linear(TargetDensity):
    """Five coefficients of a line through normal data, with normal priors."""

    parameter_names = tuple("abcde")
    support = np.full(5, -np.inf), np.full(5, np.inf)
    design = np.vander(np.linspace(-1.0, 1.0, 30), 5)
    data = design @ np.arange(5.0) + np.random.default_rng(1).normal(0.0, 0.5, 30)
    width = np.array([10.0, 3.0, 5.0, 2.0, 8.0])

    def log_prob(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)
        likelihood = stats.norm(x @ self.design.T, 0.5).logpdf(self.data).sum(axis=-1)
        return np.asarray(likelihood + stats.norm(0.0, self.width).logpdf(x).sum(axis=-1))

    def gradient(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)
        return np.asarray(self.design.T @ (self.data - self.design @ x) / 0.25 - x / self.width**2)

    def information(self, params: ArrayLike) -> Floats:
        return np.asarray(self.design.T @ self.design / 0.25 + np.diag(self.width**-2.0))

    def closed(self) -> float:
        """The data are normal, and the coefficients widen them."""
        covariance = (self.design * self.width**2) @ self.design.T + 0.25 * np.eye(30)
        return float(stats.multivariate_normal(np.zeros(30), covariance).logpdf(self.data))


def maximum(density: TargetDensity) -> MapEstimate:
    found = maximize(density, np.zeros(len(density.parameter_names)))
    return MapEstimate(found.params, found.covariance, found.log_prob, found.evaluations, "")


def frame(**options: Any) -> bf.Posterior:
    """One source of 200 photons; two parameters unless others are asked for."""
    model = bf.ForwardModel(
        bf.Detector((21, 21)), bf.SourceCatalog([5.0], [2.0], [200.0]), bf.GaussianPSF(1.5),
        bf.PolynomialDistortion([(1, 0, 0, 0)], []),
    )  # fmt: skip
    return bf.Posterior(model, bf.simulate(model, [0.02], 1.0, seed=2), **options)


@pytest.mark.parametrize("sampler", [bf.sample, bf.laplace])
def test_closed_forms(sampler: Any) -> None:
    options = {"seed": 1, "progress": False}
    linear = Linear()
    for density, estimate, exact in (
        (linear, maximum(linear), linear.closed()), (CutGaussian(), top(CutGaussian()), CUT),
    ):  # fmt: skip
        found = log_evidence(sampler(density, estimate, **options))
        assert found.error < 0.02
        assert abs(found.log_evidence - exact) < 4.0 * found.error
    # the negative control is off by log 1.1 = 0.095
    wider = log_evidence(sampler(Wider(), top(Wider()), **options))
    assert abs(wider.log_evidence - CUT) > 4.0 * wider.error


def test_a_frame_has_the_evidence_of_a_grid() -> None:
    posterior = frame()
    found = log_evidence(bf.sample(posterior, seed=1, target_ess=400, progress=False))
    estimate = bf.find_map(posterior)
    sd = np.sqrt(np.diag(estimate.covariance))
    axes = [
        np.linspace(m - 9.0 * s, m + 9.0 * s, 121) for m, s in zip(estimate.params, sd, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    # every pixel and both priors again, by scipy
    mu = np.array([posterior.model.expected_counts(p[:1]) + p[1] for p in points[::40]])
    direct = stats.poisson.logpmf(posterior.counts, mu).sum(axis=(1, 2))
    direct += sum(p.logpdf(points[::40, k]) for k, p in enumerate(posterior.prior.values()))
    values = posterior.log_prob(points)
    likely = direct > direct.max() - 20.0
    assert values[::40][likely] == pytest.approx(direct[likely], abs=1e-4)
    cell = float(np.log(np.prod([axis[1] - axis[0] for axis in axes])))
    assert abs(found.log_evidence - logsumexp(values) - cell) < 4.0 * found.error + 1e-3
    assert found.error < 0.02


def test_free_fluxes_are_integrated_out() -> None:
    """On a grid of flux as well, whose prior is Gamma(2)."""
    posterior = frame(nuisances=bf.Nuisances(flux="free"))
    found = log_evidence(bf.laplace(posterior, seed=1, progress=False))
    theta, level, flux = (np.linspace(*ends, 25) for ends in ((-0.15, 0.2), (0.7, 1.3), (80, 330)))
    unit = np.array([posterior.model.expected_counts([t]) for t in theta]) / 200.0
    mu = flux[:, None, None] * unit[:, None] + level[:, None, None, None, None]
    values = stats.poisson.logpmf(posterior.counts, mu).sum(axis=(-2, -1))
    f_x, background = posterior.prior.values()
    values += f_x.logpdf(theta)[:, None] + background.logpdf(level)[:, None, None]
    values += stats.gamma(2.0, scale=100.0).logpdf(flux)
    cell = np.log(np.prod([axis[1] - axis[0] for axis in (theta, level, flux)]))
    # the Laplace approximation over a flux known to 9 % is right to 1 / (12 shape) = 0.001
    assert found.log_evidence == pytest.approx(logsumexp(values) + cell, abs=0.02)


def test_no_posterior_at_the_maximum_is_refused() -> None:
    density = CutGaussian()
    far = MapEstimate(np.array([30.0, -2e-3, -50.0]), np.diag([1.0, 1e-6, 1e-6]), 0.0, 1, "")
    with pytest.raises(bf.InputError, match="finds no posterior"):
        module._proposed(density, LaplaceMove(far.params, far.covariance), 10,
                         np.random.RandomState(1))  # fmt: skip


def test_a_proposal_elsewhere_or_too_wide_is_noticed() -> None:
    density, random = Linear(), np.random.RandomState(4)
    found = maximum(density)
    good, shape = module.importance_evidence(density, found, 200, random)
    assert shape == -np.inf and good.error < 0.03
    for wrong in (
        MapEstimate(found.params, 1e4 * found.covariance, found.log_prob, 1, ""),
        MapEstimate(found.params + 0.7, 0.01 * found.covariance, found.log_prob, 1, ""),
    ):
        assert module.importance_evidence(density, wrong, 200, random)[1] > 0.7


class Tails(TargetDensity):
    """Student's distribution in three dimensions, of which normal ones are a poor proposal."""

    parameter_names = tuple("abc")
    support = np.full(3, -np.inf), np.full(3, np.inf)
    density = stats.multivariate_t(np.zeros(3), np.eye(3), df=15)

    def log_prob(self, params: ArrayLike) -> Floats:
        return np.asarray(self.density.logpdf(np.asarray(params)))

    def gradient(self, params: Floats) -> Floats:
        return np.asarray(-18.0 * params / (15.0 + params @ params))

    def information(self, params: Floats) -> Floats:
        return np.eye(3) * 18.0 / 15.0


class Normal(TargetDensity):
    """Twenty variables, of which draws of the wide share have less weight."""

    parameter_names = tuple("abcdefghijklmnopqrst")
    support = np.full(20, -np.inf), np.full(20, np.inf)

    def log_prob(self, params: ArrayLike) -> Floats:
        return np.asarray(stats.norm.logpdf(np.asarray(params)).sum(axis=-1))

    def gradient(self, params: Floats) -> Floats:
        return -params

    def information(self, params: Floats) -> Floats:
        return np.eye(20)


@pytest.mark.parametrize("density", [Tails(), Normal()])
def test_errors_of_importance_sampling_are_those_quoted(density: TargetDensity) -> None:
    """Mean square of 400 errors over that of quoted ones, which has a Monte Carlo error of 0.1.

    The negative control knows of no share with tails.
    """
    random, found = np.random.RandomState(4), maximum(density)
    move, errors, without = LaplaceMove.of(density, found), [], []
    for _ in range(400):
        ratios = module._proposed(density, move, 200, random)
        errors.append(module._mean(ratios))
        without.append(np.exp(ratios[~module._heavy(200)]).std() / 200**0.5)
    error, quoted = np.array(errors).T
    assert 0.6 < np.mean(error**2) / np.mean(quoted**2) < 1.4
    assert np.mean(error**2) / np.mean(np.square(without)) > 1.4


def test_few_wide_draws_may_have_missed_the_bound_of_a_prior() -> None:
    """Of 100 draws five are wide, half of them beyond it: in one set of 16 all of these or none.

    The negative control takes the variance of the five for that of the share.
    """
    density, random = CutGaussian(), np.random.RandomState(4)
    move, z, control = LaplaceMove.of(density, top(density)), [], []
    for _ in range(400):
        ratios = module._proposed(density, move, 100, random)
        found = module._mean(ratios)
        weights, heavy = np.exp(ratios - found.log_evidence), module._heavy(100)
        alone = np.where(heavy, weights[heavy].var(), weights[~heavy].var()).mean() / 100.0
        z.append((found.log_evidence - CUT) / found.error)
        control.append((found.log_evidence - CUT) / alone**0.5)
    assert np.abs(z).max() < 5.0 and 0.6 < np.std(z) < 1.4
    assert np.abs(control).max() > 10.0


def test_few_proposals_are_drawn_where_their_error_is_small() -> None:
    """The error with the number that is said to be needed: of 400, to 0.0035 by chance."""
    random, density = np.random.RandomState(4), Tails()
    found = maximum(density)
    ratios = module._proposed(density, LaplaceMove.of(density, found), 1000, random)
    number = module.draws_needed(ratios, 0.05, 200)
    assert 20 < number < 200 and module.draws_needed(ratios, 1e-3, 200) == 200
    several = [module.importance_evidence(density, found, number, random)[0] for _ in range(400)]
    error = np.sqrt(np.mean([one.log_evidence**2 for one in several]))
    assert 0.03 < error < 0.06
    linear = Linear()
    ratios = module._proposed(linear, LaplaceMove.of(linear, maximum(linear)), 1000, random)
    assert module.draws_needed(ratios, 0.05, 200) == module.PERIOD


def test_proposals_outside_the_support_count_as_zero() -> None:
    """Half of a normal distribution, from a proposal that does not know of the bound."""
    rng = np.random.default_rng(3)
    draws, proposed = np.abs(rng.normal(size=(40, 100))), rng.normal(size=4000)
    ratio = np.where(proposed >= 0.0, 0.0, -np.inf)
    found = module._bridge(np.zeros_like(draws), ratio)
    assert abs(found.log_evidence - np.log(0.5)) < 4.0 * found.error
    assert found.error == pytest.approx(1.0 / 4000**0.5, rel=0.1)


def bridge_z(seed: int, *, shuffled: bool) -> float:
    """Deviation in errors from draws of a normal distribution that follow each other at 0.9."""
    rng = np.random.default_rng([7, seed])
    series = np.empty((20, 100))
    series[:, 0] = rng.normal(size=20)
    for t in range(1, 100):
        series[:, t] = 0.9 * series[:, t - 1] + np.sqrt(1.0 - 0.81) * rng.normal(size=20)
    if shuffled:
        series = rng.permuted(series.ravel()).reshape(series.shape)
    proposal = stats.t(5.0, loc=0.3, scale=1.2)
    proposed = proposal.rvs(1000, random_state=rng)
    found = module._bridge(*(stats.norm.logpdf(x) - proposal.logpdf(x) for x in (series, proposed)))
    return found.log_evidence / found.error


def test_errors_are_those_of_correlated_draws() -> None:
    """The rms of 100 deviations in errors is known to 0.07."""
    rms = [
        np.sqrt(np.mean([bridge_z(k, shuffled=shuffled) ** 2 for k in range(100)]))
        for shuffled in (False, True)
    ]
    assert 0.8 < rms[0] < 1.2
    assert rms[1] > 1.4


def nested_sampling(posterior: bf.Posterior, seed: int, live: int = 300) -> tuple[float, float]:
    """Log-evidence and its error, of points that climb through shells of the prior.

    Walks of 25 steps from another live point, in the prior's unit cube, with a step of the scatter
    of the live points (J. Skilling 2006, Bayesian Analysis 1, 833).
    """
    rng, d = np.random.default_rng(seed), posterior.n_parameters
    priors = tuple(posterior.prior.values())

    def value(cube: Floats) -> Floats:
        points = np.stack([p.ppf(c) for p, c in zip(priors, cube.T, strict=True)], axis=1)
        inside = np.all((cube > 0.0) & (cube < 1.0), axis=1)
        return posterior.likelihood.log_likelihood(np.where(inside[:, None], points, 1.0), inside)

    cube = rng.random((live, d))
    values, total, batch, shells = value(cube), -np.inf, live // 10, 0
    information = 0.0
    while True:
        # the worst tenth leaves together, each with the shrinkage of its rank
        order = np.argsort(values)
        gone, kept = order[:batch], order[batch:]
        for rank, k in enumerate(gone):
            volume = shells
            shells -= 1.0 / (live - rank)
            shell = values[k] + volume + np.log(-np.expm1(shells - volume))
            total = np.logaddexp(total, shell)
        floor = values[gone[-1]]
        if values.max() + shells < total - 5.0:
            break
        start = rng.choice(kept, batch)
        point, at, step = cube[start], values[start], cube[kept].std(axis=0)
        for _ in range(25):
            trial = point + rng.normal(size=(batch, d)) * step * rng.choice([1.0, 0.3, 0.1])
            new = value(trial)
            up = new > floor
            point, at = np.where(up[:, None], trial, point), np.where(up, new, at)
        cube[gone], values[gone] = point, at
    remaining = float(logsumexp(values[kept])) - np.log(len(kept)) + shells
    information = float(values.max()) - total
    return float(np.logaddexp(total, remaining)), float(np.sqrt(max(information, 1.0) / live))


@pytest.mark.statistics
@pytest.mark.parametrize("nuisances", [bf.Nuisances(), bf.Nuisances(psf_sigma=True)])
def test_nested_sampling_finds_the_same(nuisances: bf.Nuisances) -> None:
    """Its error is some 0.15; four runs halve it."""
    posterior = frame(nuisances=nuisances)
    found = log_evidence(bf.sample(posterior, seed=1, progress=False))
    runs = [nested_sampling(posterior, seed) for seed in range(4)]
    mean, error = np.mean([run[0] for run in runs]), np.mean([run[1] for run in runs]) / 2.0
    assert error < 0.12
    assert abs(found.log_evidence - mean) < 4.0 * np.hypot(error, found.error)
