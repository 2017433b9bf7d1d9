"""Scales by their normal scores, and funnels: see `normal_scores.py` and `LaplaceMove`."""

from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import log_ndtr
from test_model import LIMIT

from bayesfred._typing import Floats
from bayesfred.model.protocol import TargetDensity
from bayesfred.optimize.estimate import MapEstimate, Modes
from bayesfred.sampling.moves import DEGREES_OF_FREEDOM, LaplaceMove, funnel_of, moments
from bayesfred.sampling.normal_scores import NormalScores, log_slopes, to_scores

DIMENSIONS = 8  # besides the scale, of the funnel


class Funnel(TargetDensity):
    """A scale, and parameters of which it is the standard deviation."""

    parameter_names = ("position_scatter", *(f"x{i}" for i in range(DIMENSIONS)))  # type: ignore[assignment]
    support = (np.empty(0), np.empty(0))

    def __init__(self, shape: float, cut: float = -np.inf) -> None:
        self.scale, self.cut = stats.gamma(shape, scale=0.1), cut
        self.support = (
            np.array([0.0, cut, *[-np.inf] * (DIMENSIONS - 1)]),
            np.full(1 + DIMENSIONS, np.inf),
        )

    def log_prob(self, params: Any) -> Floats:
        tau, x = params[:, 0], params[:, 1:]
        wide = 0.3 + tau[:, None]
        inside = np.where(x[:, 0] > self.cut, -stats.norm.logsf(self.cut, 1.0, wide[:, 0]), -np.inf)
        own = stats.norm.logpdf(x, 1.0, wide).sum(axis=1)
        return np.asarray(self.scale.logpdf(tau) + own + inside)

    def draws(self, n: int) -> Floats:
        random = np.random.RandomState(1)
        tau = self.scale.rvs(n, random_state=random)
        x = 1.0 + (0.3 + tau[:, None]) * random.standard_normal((n, DIMENSIONS))
        x[:, 0] = stats.truncnorm.rvs(
            (self.cut - 1.0) / (0.3 + tau), np.inf, 1.0, 0.3 + tau, random_state=random
        )
        return np.column_stack([tau, x])

    @property
    def fitted(self) -> LaplaceMove:
        draws = self.draws(4000)
        estimate = MapEstimate(draws.mean(axis=0), np.cov(draws.T), 0.0, 1, "", True, True)
        return LaplaceMove.fitted(self, estimate, draws)


def half_normal(n: int) -> Floats:
    return np.abs(np.random.default_rng(1).standard_normal(n))


SCORES = [
    NormalScores.log_normal(0.01, 0.8),
    NormalScores.of_draws(half_normal(2000)),
    NormalScores.of_draws(5.0 + np.random.default_rng(2).standard_normal(2000)),
]


@pytest.mark.parametrize("scores", SCORES)
def test_values_have_their_scores_and_slopes(scores: NormalScores) -> None:
    z = np.linspace(-8.0, 8.0, 123)
    assert scores.at(scores.values(z)) == pytest.approx(z, abs=1e-9)
    assert np.all(scores.values(np.array([-60.0, 60.0])) > 0.0)  # no double underflows
    z = z[np.abs(z[:, None] - scores.scores).min(axis=1) > 1e-3]  # slopes have steps at the knots
    h = 1e-6
    slope = np.log((scores.values(z + h) - scores.values(z - h)) / (2.0 * h))
    assert scores.log_slope(z) == pytest.approx(slope, abs=1e-7)


@pytest.mark.parametrize("scores", SCORES)
def test_no_score_is_of_an_enormous_value(scores: NormalScores) -> None:
    """Likelihoods of a scatter as wide as the frame take minutes; a heavy tail would propose them.

    One in 10^6 draws of Student's distribution is above z. There the tail of a power would be at
    more than 10^9 of the last knot, that of a log-normal distribution at 10^8 of the first case's.
    """
    z = np.array([stats.t.isf(1e-6, DEGREES_OF_FREEDOM)])
    assert scores.values(z) < 150.0 * np.exp(scores.logs[-1])
    powers = (log_ndtr(-scores.scores[-1]) - log_ndtr(-z)) / scores.high
    assert np.exp(powers) > 1e9


def test_scores_of_draws_are_normal() -> None:
    """Shares of 40,000 draws below quantiles, whose knots are those of others; error 0.005."""
    scores = NormalScores.of_draws(half_normal(10_000))
    z = scores.at(np.abs(np.random.default_rng(3).standard_normal(40_000)))
    for q in (0.01, 0.1, 0.5, 0.9, 0.99):
        assert np.mean(z < stats.norm.ppf(q)) == pytest.approx(q, abs=0.02)
    assert np.mean(np.log(half_normal(40_000)) < stats.norm.ppf(0.1)) > 0.15  # logarithms are not


@pytest.mark.parametrize("mode", [0.0, 1.5])
def test_a_scale_that_may_be_zero_is_proposed_there(mode: float) -> None:
    """The posterior's density over the proposal's, where a walker might not leave zero."""
    target, s = stats.truncnorm(-mode, np.inf, mode), np.geomspace(1e-9, mode + 3.5, 500)[:, None]
    draws = target.rvs(10_000, random_state=np.random.RandomState(1))
    scores = {0: NormalScores.of_draws(draws)}
    y, logs = to_scores(draws[:, None], scores), np.log(draws)
    log_p = target.logpdf(s[:, 0])
    by_scores = LaplaceMove(y.mean(axis=0), np.cov(y.T).reshape(1, 1), scores=scores)
    assert np.max(log_p - by_scores.log_density(s)) < np.log(1.5)
    by_logs = LaplaceMove(logs.mean(keepdims=True), np.cov(logs).reshape(1, 1), heavy_share=0.0)
    assert np.max(log_p - by_logs.log_density(np.log(s)) + np.log(s[:, 0])) > np.log(100.0)


@pytest.mark.parametrize("shape", [3.0, 10.0, 400.0])
def test_a_scale_told_from_zero_is_proposed_on_both_sides(shape: float) -> None:
    """The posterior's density over the proposal's; a uniform lower tail misses what is just below.

    Between the 2,000th parts; the share of draws below a knot errs by 4 %.
    """
    target = stats.gamma(shape, scale=1.0 / shape)
    s = target.ppf(np.linspace(0.0005, 0.9995, 500))
    scores = NormalScores.of_draws(target.rvs(10_000, random_state=np.random.RandomState(1)))

    def highest(scores: NormalScores) -> float:
        z = scores.at(s)
        return float(np.exp(target.logpdf(s) - stats.norm.logpdf(z) + scores.log_slope(z)).max())

    assert highest(scores) < 1.5
    assert highest(scores._replace(low=1.0)) > min(1.5, 0.5 * scores.low)


@pytest.mark.parametrize("cut", [-np.inf, 0.5])
def test_draws_from_a_funnel_follow_its_density(cut: float) -> None:
    """Under draws from q the mean of p / q is 1, but not without the scores' or funnel's volume."""
    target = Funnel(3.0, cut)
    move, widened = target.fitted, DIMENSIONS - np.isfinite(cut)
    assert move.scores.keys() == {0} and move.funnel.max() > 0.1 and move.widened.sum() == widened
    x = move.draw(200_000, np.random.RandomState(3))
    log_q, y = move.log_density(x), to_scores(x, move.scores)
    slopes = log_slopes(y, move.scores)[:, 0]
    wider = widened * ((y[:, move.order] - move.means) @ move.funnel)
    off = []
    for more in (0.0, slopes, wider):
        weight = np.exp(target.log_prob(x) - log_q - more)
        off.append(abs(weight.mean() - 1.0) / (weight.std() / np.sqrt(weight.size)))
    assert off[0] < LIMIT and min(off[1:]) > 3.0 * LIMIT


def test_funnel_of_draws() -> None:
    """A tenth of the slope is five errors with 4,000 draws of 10 parameters."""
    random = np.random.default_rng(5)
    scales, others = random.standard_normal((4000, 2)), random.standard_normal((4000, 10))
    mixed = random.standard_normal((10, 10))
    others = (others * np.exp(scales @ [0.15, -0.05])[:, None]) @ mixed
    draws = np.column_stack([others[:, :4], scales, others[:, 4:]])
    assert funnel_of(draws, [4, 5]) == pytest.approx([0.15, -0.05], abs=0.015)
    _, covariance = moments(draws, np.array([0.0] * 4 + [0.15, -0.05] + [0.0] * 6))
    own = np.delete(np.delete(covariance, [4, 5], 0), [4, 5], 1)
    expected = mixed.T @ mixed
    assert own == pytest.approx(expected, abs=0.1 * np.diag(expected).max())
    assert np.trace(np.cov(draws.T)) > 1.04 * np.trace(covariance)


def accepted(move: LaplaceMove, target: Funnel) -> Floats:
    """The share of proposals that each of 2,000 draws of the target accepts, 50 proposals each."""
    x, random = target.draws(2000), np.random.RandomState(4)
    new = move.draw(50, random)
    gain = target.log_prob(new) - move.log_density(new)
    here = target.log_prob(x) - move.log_density(x)
    return np.asarray(np.exp(np.minimum(gain - here[:, None], 0.0)).mean(axis=1))


@pytest.mark.parametrize("shape", [1.0, 3.0])
def test_walkers_are_not_stuck_where_a_scale_is_small(shape: float) -> None:
    """The tenth that moves least, by adapted proposals and by those that a plain normal makes."""
    target = Funnel(shape)
    x = target.draws(4000)
    plain = LaplaceMove(x.mean(axis=0), np.cov(x.T), support=target.support)
    least = [np.quantile(accepted(move, target), 0.1) for move in (target.fitted, plain)]
    assert least[0] > 3.0 * least[1]


def test_a_mode_of_few_draws_keeps_its_approximation() -> None:
    """In the scores of the others' draws, where a scale of zero has none."""
    target = Funnel(3.0)
    draws = target.draws(4000)
    mean, covariance = draws.mean(axis=0), np.diag(np.r_[0.01, np.full(DIMENSIONS, 0.2)])
    far = np.r_[0.0, np.full(DIMENSIONS, 30.0)]
    modes = Modes(np.array([mean, far]), np.array([covariance, covariance]), np.full(2, 0.5), 2)
    estimate = MapEstimate(mean, covariance, 0.0, 1, "", True, True, modes)
    move = LaplaceMove.fitted(target, estimate, draws)
    x = move.draw(400_000, np.random.RandomState(2))
    x = x[x[:, 1] > 15.0]
    assert len(x) > 50
    assert np.quantile(x[:, 0], 0.5) == pytest.approx(0.1, rel=0.3)
    low, middle, high = np.quantile(x[:, 1], [0.16, 0.5, 0.84])
    assert middle == pytest.approx(30.0, abs=0.3)
    assert 0.5 * (high - low) == pytest.approx(np.sqrt(0.2), rel=0.5)
