"""A density that has nothing to do with frames is maximised, sampled and judged like any other."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from scipy import stats
from test_model import LIMIT

import bayesfred as bf
from bayesfred.errors import InputError
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize import newton
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.newton import maximize
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.convergence import convergence

Floats = NDArray[np.float64]

MEAN, SD, RHO = np.array([30.0, -2e-3]), np.array([4.0, 1e-3]), 0.8


class CutGaussian(TargetDensity):
    """Two correlated normal variables and half of a third one, which its prior ends at 0."""

    parameter_names = ("a", "b", "half")
    support = np.array([-np.inf, -np.inf, 0.0]), np.full(3, np.inf)
    precision = np.linalg.inv(np.outer(SD, SD) * np.array([[1.0, RHO], [RHO, 1.0]]))

    def log_prob(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)
        off, half = x[..., :2] - MEAN, x[..., 2]
        inside = -0.5 * np.einsum("...i,ij,...j", off, self.precision, off) - 0.5 * half**2
        return np.asarray(np.where(half >= 0.0, inside, -np.inf))

    def gradient(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)
        return np.append(-self.precision @ (x[:2] - MEAN), -x[2])

    def information(self, params: ArrayLike) -> Floats:
        out = np.eye(3)
        out[:2, :2] = self.precision
        return out


class Wider(CutGaussian):
    """Negative control: the first variable's standard deviation is a tenth larger."""

    precision = CutGaussian.precision / np.outer([1.1, 1.0], [1.1, 1.0])


def top(density: TargetDensity) -> MapEstimate:
    found = maximize(density, np.array([0.0, 0.0, 3.0]))
    return MapEstimate(found.params, found.covariance, found.log_prob, found.evaluations, "")


def worst_moment(chain: Chain) -> float:
    """Largest deviation of a mean, a second moment or the correlation, in Monte Carlo errors.

    The error of a mean of n effective draws is their standard deviation over the root of n. Every
    moment is the mean of a function of the draws, whose own effective sample size is taken.
    """
    kept = chain.chain[:, chain.burn_in :]
    z = (kept[..., :2] - MEAN) / SD
    half = kept[..., 2]
    functions = np.stack(
        [*np.moveaxis(z, -1, 0), *np.moveaxis(z**2, -1, 0), z.prod(axis=-1), half, half**2],
        axis=-1,
    )
    exact = np.array([0.0, 0.0, 1.0, 1.0, RHO, stats.halfnorm.mean(), 1.0])
    _, bulk, _ = convergence(functions)
    error = functions.std(axis=(0, 1, 2)) / np.sqrt(bulk)
    return float(np.abs((functions.mean(axis=(0, 1, 2)) - exact) / error).max())


def test_it_is_maximised() -> None:
    """The maximum is at the bound of the third parameter, where the gradient vanishes."""
    estimate = top(CutGaussian())
    assert np.all(np.abs(estimate.params[:2] - MEAN) < 1e-3 * SD) and estimate.params[2] == 0.0
    assert np.sqrt(np.diag(estimate.covariance)[:2]) == pytest.approx(SD, rel=1e-9)


def test_it_is_sampled_in_memory() -> None:
    density = CutGaussian()
    chain = bf.sample(density, top(density), seed=1, target_ess=10_000, progress=False)
    assert chain.posterior() is density and chain.path is None
    assert chain.parameter_names == ("a", "b", "half") and chain.draws()[:, 2].min() >= 0.0
    assert worst_moment(chain) < LIMIT


def test_another_density_has_other_moments() -> None:
    # negative control
    density = Wider()
    chain = bf.sample(density, top(density), seed=1, target_ess=10_000, progress=False)
    assert worst_moment(chain) > LIMIT


def test_it_is_sampled_alike_by_anybody() -> None:
    """The seed makes the draws, without a file too."""
    first, again, other = (
        bf.sample(CutGaussian(), top(CutGaussian()), seed=seed, steps=5, progress=False)
        for seed in (1, 1, 2)
    )
    assert np.array_equal(first.chain, again.chain) and not np.array_equal(first.chain, other.chain)


def test_a_file_cannot_hold_it(tmp_path: Path) -> None:
    density = CutGaussian()
    with pytest.raises(InputError, match="sample it in memory") as refused:
        bf.sample(density, top(density), seed=1, path=tmp_path / "chain.h5", progress=False)
    assert "\n" not in str(refused.value) and list(tmp_path.iterdir()) == []


class Nested(CutGaussian):
    """More scale parameters than proposals can be nested on."""

    hyperparameters = ("a", "half")


def test_two_hyperparameters_are_refused() -> None:
    with pytest.raises(InputError, match="hyperparameters a, half, expected at most one"):
        bf.sample(Nested(), top(Nested()), seed=1, progress=False)


def test_a_gradient_that_is_nearly_right() -> None:
    """Its root is the maximum if log_prob differs by hundredths of a standard deviation."""

    class Tilted(CutGaussian):
        def log_prob(self, params: ArrayLike) -> Floats:
            x = np.asarray(params)
            return np.asarray(super().log_prob(x) + 0.02 * (x[..., 0] - MEAN[0]) / SD[0])

    near = np.array([MEAN[0] + 0.01 * SD[0], MEAN[1], 0.0])
    result = maximize(Tilted(), near)
    assert result.distance < 1e-3
    assert np.abs((result.params[:2] - MEAN) / SD).max() < 1e-3


class Rising(CutGaussian):
    """A scale whose density rises from zero as a power, as where some source lies off its place."""

    parameter_names = ("scale",)
    support = np.zeros(1), np.full(1, np.inf)

    def log_prob(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)[..., 0]
        with np.errstate(invalid="ignore"):
            inside = 5.0 * np.log(x + 1e-18) - (x / 0.012) ** 4
        return np.asarray(np.where(x >= 0.0, inside, -np.inf))

    def gradient(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)
        return np.asarray(5.0 / (x + 1e-18) - 4.0 * x**3 / 0.012**4)

    def information(self, params: ArrayLike) -> Floats:
        x = np.asarray(params)  # less than the curvature far out: the first step is too long
        return np.asarray([5.0 / (x + 1e-18) ** 2 + 2.0 * x**2 / 0.012**4])


def test_a_scale_does_not_fall_to_zero_in_one_step(monkeypatch: pytest.MonkeyPatch) -> None:
    start, most_likely = np.array([0.06]), 0.012 * 1.25**0.25
    assert Rising().log_prob([0.0]) > Rising().log_prob(start)
    assert maximize(Rising(), start, steps=8).params == pytest.approx(most_likely, rel=1e-2)
    monkeypatch.setattr(newton, "TOWARDS_EDGE", 1.0)  # negative control
    assert maximize(Rising(), start, steps=8).params < 1e-12
