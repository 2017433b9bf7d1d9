"""Several frames in one posterior: sums over frames, drift, maximum, proposals, files, verdict."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from emcee import State
from scipy import stats

import bayesfred as bf
from bayesfred._typing import Flags, Floats
from bayesfred.analysis.frame_agreement import frame_agreement
from bayesfred.errors import InputError
from bayesfred.model.joint import JointPosterior
from bayesfred.sampling.ensembles import adapted, moves_after
from bayesfred.sampling.frame_moves import FrameMove
from bayesfred.sampling.normal_scores import NormalScores, to_scores

TERMS = bf.PolynomialDistortion([(1, 0, 0, 0), (3, 0, 0, 0)], [(0, 1, 0, 0), (0, 3, 0, 0)])
MODEL = bf.ForwardModel(
    bf.Detector((97, 97)), bf.SourceCatalog.grid(5, 18.0, 1e4), bf.GaussianPSF(2.0), TERMS
)
CUBIC = {"f_x3": 4e-6, "g_y3": -3e-6}
NUISANCES = bf.Nuisances(flux="scale", offset=True)


def frame(seed: int, **known: float) -> bf.Posterior:
    """A simulated frame with the cubic terms of one lens, unless others are given."""
    theta = np.array([{**CUBIC, **known}.get(name, 0.0) for name in TERMS.names])
    counts = bf.simulate(MODEL, theta, 2.0, seed=seed)
    return bf.Posterior(MODEL, counts, nuisances=NUISANCES)


@pytest.fixture(scope="module")
def frames() -> dict[str, bf.Posterior]:
    return {name: frame(seed, f_x=1e-3 * seed) for seed, name in enumerate("abc")}


@pytest.fixture(scope="module")
def joint(frames: dict[str, bf.Posterior]) -> bf.JointPosterior:
    return bf.JointPosterior(frames)


@pytest.fixture(scope="module")
def estimate(joint: bf.JointPosterior) -> bf.MapEstimate:
    return bf.find_map(joint)


def drifting(frames: Mapping[str, bf.Posterior], walk: float | None) -> bf.JointPosterior:
    times = {"a": 3.0, "b": 0.0, "c": 1.0}
    return bf.JointPosterior(frames, drift=bf.Drift(times, ("f_x3", "g_y3"), walk=walk))


def test_terms_of_degree_two_and_higher_are_shared(joint: bf.JointPosterior) -> None:
    own = ("f_x", "g_y", "background", "flux_scale", "offset_x", "offset_y")
    expected = ("f_x3", "g_y3", *(f"{name}.{each}" for name in "abc" for each in own))
    assert joint.parameter_names == expected
    assert bf.JointPosterior({"a": frame(1)}, ["background", "g_y"]).parameter_names[:3] == (
        "background", "g_y", "a.f_x",
    )  # fmt: skip


@pytest.mark.parametrize("walk", [None, 0.2])
@pytest.mark.parametrize("with_drift", [False, True])
def test_log_prob_is_the_prior_times_every_frames_likelihood(
    frames: dict[str, bf.Posterior], estimate: bf.MapEstimate, *, with_drift: bool,
    walk: float | None,
) -> None:  # fmt: skip
    joint = drifting(frames, walk) if with_drift else bf.JointPosterior(frames)
    random = np.random.default_rng(1)
    known = dict(zip(bf.JointPosterior(frames).parameter_names, estimate.params, strict=True))
    params = np.array([known.get(name, 0.0) for name in joint.parameter_names])
    vectors = params + 1e-7 * random.standard_normal((3, params.size))
    by_hand = np.zeros(3)
    for k, vector in enumerate(vectors):
        values = dict(zip(joint.parameter_names, vector, strict=True))
        for name, posterior in frames.items():
            own = {}
            for each in posterior.parameter_names:
                own[each] = values.get(each, values.get(f"{name}.{each}"))
                if with_drift and walk is None and f"{each}.drift" in values:
                    time = {"a": 3.0, "b": 0.0, "c": 1.0}[name]
                    own[each] += values[f"{each}.drift"] * (time - 4.0 / 3.0)
                if with_drift and walk and each in CUBIC:  # in the order b, c, a
                    own[each] += {"b": 0.0, "c": 1.0, "a": 1.0}[name] * values[f"{each}.step_c"]
                    own[each] += {"b": 0.0, "c": 0.0, "a": 1.0}[name] * values[f"{each}.step_a"]
            theirs = np.array([own[each] for each in posterior.parameter_names])
            by_hand[k] += posterior.log_prob(theirs) - posterior.log_prior(theirs)[0]
        by_hand[k] += sum(joint.prior[name].logpdf(x) for name, x in values.items())
    np.testing.assert_allclose(joint.log_prob(vectors), by_hand, rtol=1e-12)
    assert joint.log_prob(vectors[1]) == joint.log_prob(vectors)[1]  # the same bits
    outside = vectors[0].copy()
    outside[joint.parameter_names.index("b.background")] = -1.0
    assert joint.log_prob(outside) == -np.inf


@pytest.mark.parametrize("method", ["gradient", "fisher", "information", "prior_gradient"])
def test_several_vectors_are_refused_where_one_is_answered(
    frames: dict[str, bf.Posterior], estimate: bf.MapEstimate, method: str
) -> None:
    joint, several = bf.JointPosterior(frames), np.stack([estimate.params, estimate.params])
    assert joint.log_prob(several).shape == joint.log_prior(several).shape == (2,)
    with pytest.raises(InputError, match="expected one vector of shape"):
        getattr(joint, method)(several)


@pytest.mark.parametrize("walk", [None, 0.2])
def test_derivatives_with_a_drift(frames: dict[str, bf.Posterior], walk: float | None) -> None:
    joint = drifting(frames, walk)
    params = bf.find_map(joint).params
    sd = np.diag(joint.information(params)) ** -0.5
    params = params + 0.5 * sd
    numeric = [
        (joint.log_prob(params + step) - joint.log_prob(params - step)) / (2.0 * 0.01 * s)
        for step, s in zip(np.diag(0.01 * sd), sd, strict=True)
    ]
    np.testing.assert_allclose(joint.gradient(params) * sd, numeric * sd, atol=2e-4)
    # the mean outer product of scores is the information: of the frames' own, summed by hand
    total = np.zeros((params.size, params.size))
    for name, posterior in frames.items():
        change = np.zeros((posterior.n_parameters, params.size))
        for k in range(params.size):
            unit = np.zeros(params.size)
            unit[k] = 1.0
            change[:, k] = joint.frame_params(name, unit)
        total += change.T @ posterior.fisher(joint.frame_params(name, params)) @ change
    np.testing.assert_allclose(joint.fisher(params), total, rtol=1e-12, atol=1e-12 * total.max())


def test_the_maximum_is_found_in_few_evaluations(
    joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    assert estimate.at_maximum and estimate.fits_data
    assert estimate.n_evaluations <= 15
    length = np.sqrt(np.diag(estimate.covariance)) * joint.gradient(estimate.params)
    assert np.abs(length).max() < 1e-3
    alone = [bf.find_map(each).covariance[1, 1] for each in joint.frames.values()]
    together = 1.0 / np.sum(1.0 / np.array(alone))
    assert estimate.covariance[0, 0] == pytest.approx(together, rel=0.02)


def test_a_start_far_off_ends_at_the_same_maximum(
    joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    sd = np.sqrt(np.diag(estimate.covariance))
    again = bf.find_map(joint, estimate.params + 10.0 * sd)
    np.testing.assert_allclose((again.params - estimate.params) / sd, 0.0, atol=2e-3)


def test_a_drift_is_found() -> None:
    """Slopes of simulated frames come out within their errors, and a walk follows them."""
    times = {f"f{k}": float(k) for k in range(6)}
    slope = 1.5e-6
    frames = {
        name: frame(k, f_x3=4e-6 + slope * (time - 2.5))
        for k, (name, time) in enumerate(times.items())
    }
    plain = bf.find_map(bf.JointPosterior(frames))
    assert not frame_agreement(bf.JointPosterior(frames), plain.params).agree
    linear = bf.JointPosterior(frames, drift=bf.Drift(times, ("f_x3",)))
    found = bf.find_map(linear)
    k = linear.parameter_names.index("f_x3.drift")
    sd = found.covariance[k, k] ** 0.5
    assert abs(found.params[k] - slope) < 4.0 * sd < slope
    assert frame_agreement(linear, found.params).agree
    walking = bf.JointPosterior(frames, drift=bf.Drift(times, ("f_x3",), walk=0.5))
    found = bf.find_map(walking)
    steps = [k for k, name in enumerate(walking.parameter_names) if ".step_" in name]
    assert len(steps) == 5
    total = found.params[steps].sum()
    error = np.sqrt(found.covariance[np.ix_(steps, steps)].sum())
    assert abs(total - 5.0 * slope) < 4.0 * error


def test_frames_that_cannot_determine_a_parameter_are_refused() -> None:
    """What one frame cannot tell others may: only what none can is refused."""
    few = bf.SourceCatalog(np.array([20.0]), np.array([10.0]), np.array([1e4]))
    model = bf.ForwardModel(bf.Detector((97, 97)), few, bf.GaussianPSF(2.0), TERMS)
    counts = bf.simulate(model, np.zeros(4), 2.0, seed=1)
    poor = bf.Posterior(model, counts, nuisances=bf.Nuisances(offset=True))
    with pytest.raises(bf.InputError, match=r"frames cannot determine .*a\.f_x"):
        bf.find_map(bf.JointPosterior({"a": poor, "b": poor}))
    fixed = bf.Posterior(model, counts)
    terms = TERMS.names
    rich = frame(1)
    found = bf.find_map(bf.JointPosterior({"rich": rich, "poor": fixed}, terms))
    assert found.at_maximum


class Banana:
    """A density of the arrowhead's kind, known in closed form: shared phi, own nu_1 to nu_k.

    nu_i - phi is a Gumbel variable, and phi has a prior; so phi has the marginal of its prior.
    """

    hyperparameters: ClassVar[tuple[str, ...]] = ()
    added_covariance = None

    def __init__(self, k: int) -> None:
        from bayesfred.model.shared_parameters import Part

        self.n_shared, self.n_parameters = 1, k + 1
        self.parts = tuple(
            Part(np.array([0, i]), np.array([i]), np.array([1]), np.array([[1.0], [0.0]]))
            for i in range(1, k + 1)
        )
        self.support = np.full(k + 1, -np.inf), np.full(k + 1, np.inf)
        self.scales = np.zeros(k + 1, bool)

    def log_parts(self, x: Floats, wanted: Flags | None = None) -> Floats:
        own = stats.gumbel_r.logpdf(x[:, 1:] - x[:, :1]).T
        if wanted is not None:
            own[~wanted] = -np.inf
        return np.concatenate([own, stats.logistic.logpdf(x[:, :1]).T])


class Funnel:
    """The same with scales: tau_i has a Gamma distribution, nu_i - phi is tau_i times a normal."""

    hyperparameters: ClassVar[tuple[str, ...]] = ()
    added_covariance = None

    def __init__(self, k: int) -> None:
        from bayesfred.model.shared_parameters import Part

        self.n_shared, self.n_parameters, self.k = 1, 1 + 2 * k, k
        matrix = np.array([[1.0], [0.0], [0.0]])
        self.parts = tuple(
            Part(np.array([0, i, i + 1]), np.array([i, i + 1]), np.array([1, 2]), matrix)
            for i in range(1, 1 + 2 * k, 2)
        )
        self.scales = np.arange(1 + 2 * k) % 2 == 0
        self.scales[0] = False
        self.support = np.full(1 + 2 * k, -np.inf), np.full(1 + 2 * k, np.inf)

    def log_parts(self, x: Floats, wanted: Flags | None = None) -> Floats:
        nu, tau = x[:, 1::2], x[:, 2::2]
        own = (stats.gamma.logpdf(tau, 3.0) + stats.norm.logpdf(nu, x[:, :1], tau)).T
        if wanted is not None:
            own[~wanted] = -np.inf
        return np.concatenate([own, stats.logistic.logpdf(x[:, :1]).T])

    def draws(self, n: int) -> Floats:
        random = np.random.RandomState(5)
        x = np.empty((n, self.n_parameters))
        x[:, 0] = stats.logistic.rvs(size=n, random_state=random)
        x[:, 2::2] = stats.gamma.rvs(3.0, size=(n, self.k), random_state=random)
        x[:, 1::2] = x[:, :1] + x[:, 2::2] * random.standard_normal((n, self.k))
        return x


class Wide(Funnel):
    """One frame, with tau also the mean and standard deviation of phi."""

    def __init__(self) -> None:
        super().__init__(1)

    def log_parts(self, x: Floats, wanted: Flags | None = None) -> Floats:
        own, rest = super().log_parts(x, wanted)
        return np.array([own + stats.norm.logpdf(x[:, 0], x[:, 2], x[:, 2]), 0.0 * rest])

    def draws(self, n: int) -> Floats:
        x = super().draws(n)
        phi = x[:, 2] * (1.0 + np.random.RandomState(6).standard_normal(n))
        x[:, :2] += (phi - x[:, 0])[:, None]
        return x


def sampled(move: FrameMove, posterior: Any, steps: int, walkers: int) -> Floats:
    """Draws after a tenth of the steps, (n, d)."""

    class Model:
        random = np.random.RandomState(7)

    x = np.abs(np.random.RandomState(3).standard_normal((walkers, posterior.n_parameters)))
    state, kept = State(x, log_prob=posterior.log_parts(x).sum(axis=0)), []
    for step in range(steps):
        before = state.coords
        state, _ = move.propose(Model, state)
        near = np.isclose(state.coords, before, rtol=1e-13, atol=0.0)
        assert np.array_equal(state.coords[near], before[near])  # what stays, to the last bit
        np.testing.assert_array_equal(state.log_prob, posterior.log_parts(state.coords).sum(axis=0))
        if step >= steps // 10:
            kept.append(state.coords)
    return np.concatenate(kept)


def farthest(*drawn: tuple[Floats, Any]) -> float:
    """How far shares of draws below quantiles of their distributions are off, at most."""
    return max(
        abs(float(np.mean(values < family.ppf(q))) - q)
        for values, family in drawn
        for q in (0.1, 0.5, 0.9)
    )


class Careless(FrameMove):
    """Forgets the proposal's density of the frames' own parameters."""

    def _redraw(self, i: int, x: Floats, random: np.random.RandomState) -> Floats:
        return 0.0 * super()._redraw(i, x, random)


@pytest.mark.parametrize("k", [1, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("together", [False, True, None])
def test_frame_moves_sample_the_right_distribution(k: int, together: bool | None) -> None:
    """Quantiles of phi and of nu_i - phi, whether frames are drawn together or one by one.

    With some 6,000 effective draws of each, a tail probability of 0.1 has an error of 0.004; the
    careless move is off by more than twice the tolerance.
    """
    posterior: Any = Banana(k)
    worst = {}
    for kind in (FrameMove, Careless):
        covariance = np.full((k + 1, k + 1), 3.3)
        covariance[np.arange(1, k + 1), np.arange(1, k + 1)] += 1.6
        mean = np.full(k + 1, 0.5)
        mean[0] = 0.0
        move = kind(posterior, mean, covariance, posterior.log_parts)
        if together is not None:
            move.together[:] = together
        draws = sampled(move, posterior, 500, 64)
        worst[kind] = farthest(
            (draws[:, 0], stats.logistic),
            *((draws[:, i] - draws[:, 0], stats.gumbel_r) for i in range(1, k + 1)),
        )
    assert worst[FrameMove] < 0.02 and worst[Careless] > 0.04


class Forgetful(FrameMove):
    """Takes the density of a scale for that of its score."""

    def _volumes(self, y: Floats) -> Floats:
        return 0.0 * super()._volumes(y)


class Unaware(FrameMove):
    """Forgets that scales widen what a walker's shared parameters are proposed from."""

    def _drawn(self, x: Floats, random: np.random.RandomState) -> tuple[Floats, Floats]:
        new, _ = super()._drawn(x, random)
        p = self.centre.size
        return new, self.shared.log_density(x[:, :p]) - self.shared.log_density(new[:, :p])


@pytest.mark.parametrize("fitted", [False, True])
def test_scales_of_frames_have_the_right_distribution(*, fitted: bool) -> None:
    """Quantiles of phi, tau_i and (nu_i - phi) / tau_i, to 0.02 with some 4,000 effective draws."""
    posterior: Any = Funnel(2)
    x = posterior.draws(4000)
    scores = {k: NormalScores.log_normal(2.5, 0.6) for k in (2, 4)}
    y, worst = to_scores(x, scores), {}
    for kind in (FrameMove, Forgetful):
        if fitted:
            move = kind.fitted(posterior, x, posterior.log_parts)
            residual = move.own[0].residual
            assert residual.funnel[1] > 0.2  # without which the others are narrower
            assert residual.lowers[0, 0, 0] < 0.9 * np.std(x[:, 1] - x[:, 0])
        else:
            move = kind(posterior, y.mean(axis=0), np.cov(y.T), posterior.log_parts, scores)
        draws = sampled(move, posterior, 600, 64)
        tau = draws[:, 2::2]
        worst[kind] = farthest(
            (draws[:, 0], stats.logistic),
            *((own, stats.gamma(3.0)) for own in tau.T),
            *((own, stats.norm()) for own in ((draws[:, 1::2] - draws[:, :1]) / tau).T),
        )
    assert worst[FrameMove] < 0.02 and worst[Forgetful] > 0.1


@pytest.mark.parametrize("together", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_scales_that_widen_what_is_shared_leave_its_distribution(
    *, together: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Quantiles of tau and phi / tau, to 0.02 with some 4,000 effective draws."""
    posterior: Any = Wide()
    monkeypatch.setattr(FrameMove, "_together", lambda self: np.array([together]))
    x, worst = posterior.draws(4000), {}
    for kind in (FrameMove, Unaware):
        move = kind.fitted(posterior, x, posterior.log_parts)
        assert (move.funnel[2] > 0.2) is not together
        assert move.own[0].slopes[1, 0] == 0.0  # what widens stays
        draws = sampled(move, posterior, 600, 64)
        phi, tau = draws[:, 0], draws[:, 2]
        worst[kind] = farthest((tau, stats.gamma(3.0)), (phi / tau - 1.0, stats.norm()))
    assert worst[FrameMove] < 0.02 and (together or worst[Unaware] > 0.03)


def test_scales_do_not_widen_what_a_prior_cuts() -> None:
    posterior: Any = Wide()
    posterior.support[0][0] = -1.0
    assert not np.any(
        FrameMove.fitted(posterior, posterior.draws(4000), posterior.log_parts).funnel
    )


def test_proposals_are_adapted_to_the_frame_that_moves_least() -> None:
    random = np.random.default_rng(1)
    chain = random.standard_normal((2, 40, 8, 3))
    assert adapted(chain) == 0
    stuck = np.repeat(chain[:, ::8, :, 2], 8, axis=1)
    chain[..., 2] = stuck
    assert adapted(chain) == 32


@pytest.mark.parametrize(("accepted", "made"), [(0.6, 0), (0.4, 32), (0.2, 64)])
def test_proposals_are_adapted_early_for_little(accepted: float, made: int) -> None:
    """Before step 32 where half of the moves are refused, later where most are.

    Where draws before step 32 do not tell the covariance, the first that do count as early.
    """
    random = np.random.default_rng(1)
    moved = random.random((2, 64, 200, 1)) < accepted
    chain = np.cumsum(moved, axis=1).astype(float)
    assert adapted(chain) == made
    assert adapted(np.repeat(chain, 100, axis=3)) == made
    many = np.repeat(chain, 257, axis=3)  # of which 6,400 draws do not tell the covariance
    assert adapted(many[:, :63]) == (32 if accepted < 0.3 else 0)
    assert adapted(many) == (0 if accepted > 0.5 else 64)


def test_proposals_are_not_adapted_to_too_few_draws(
    joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    """Eight walkers that never move spread in no more than eight directions."""
    walkers = np.random.RandomState(1).multivariate_normal(
        estimate.params, estimate.covariance, size=(2, 1, 4)
    )
    chain = np.repeat(walkers, 8, axis=1)
    assert adapted(chain) == 8 < joint.n_parameters
    (move, share), *_ = moves_after(joint, estimate, chain)
    plain = FrameMove.of(joint, estimate, joint.log_parts)
    assert share == 1.0 and isinstance(move, FrameMove)
    np.testing.assert_array_equal(move.shared.lowers, plain.shared.lowers)


def test_nearly_normal_frames_are_drawn_together(
    joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    assert FrameMove.of(joint, estimate, joint.log_parts).together.all()
    posterior: Any = Banana(30)
    covariance = np.full((31, 31), 3.3) + np.diag([0.0, *[1.6] * 30])
    assert not FrameMove(posterior, np.zeros(31), covariance, posterior.log_parts).together.any()


def test_sampling_agrees_with_the_laplace_approximation_where_it_holds(
    joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    """With 1,000 effective draws a mean is off by 0.03 sd, a standard deviation by 2 %."""
    chain = bf.sample(joint, estimate, seed=1, progress=False)
    sd = np.sqrt(np.diag(estimate.covariance))
    draws = chain.draws()
    np.testing.assert_allclose((draws.mean(axis=0) - estimate.params) / sd, 0.0, atol=0.15)
    np.testing.assert_allclose(draws.std(axis=0) / sd, 1.0, atol=0.12)
    assert bf.diagnose(chain, target_ess=500).trustworthy


def test_a_joint_run_is_resumed_bit_by_bit(
    joint: bf.JointPosterior, estimate: bf.MapEstimate, tmp_path: Path
) -> None:
    path = tmp_path / "joint.h5"
    bf.sample(joint, estimate, seed=2, path=path, steps=5, progress=False)
    resumed = bf.sample(joint, seed=2, path=path, steps=10, resume=True, progress=False)
    straight = bf.sample(joint, estimate, seed=2, steps=10, progress=False)
    np.testing.assert_array_equal(resumed.chain, straight.chain)
    read = bf.open_chain(path)
    assert isinstance(read.posterior(), JointPosterior)
    np.testing.assert_array_equal(read.chain, straight.chain)
    np.testing.assert_array_equal(
        read.posterior().log_prob(read.chain[0, -1]), read.log_prob[0, -1]
    )


def test_a_frame_of_a_chain_is_a_chain_of_the_frame(
    joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    chain = bf.laplace(joint, estimate, seed=3, progress=False)
    own = chain.frame("b")
    assert own.parameter_names == joint.frames["b"].parameter_names
    places = {name: k for k, name in enumerate(joint.parameter_names)}
    columns = [places.get(name, places.get(f"b.{name}")) for name in own.parameter_names]
    np.testing.assert_array_equal(own.draws(), chain.draws()[:, columns])
    covariance = estimate.covariance[np.ix_(columns, columns)]
    np.testing.assert_allclose(own.estimate.covariance, covariance, rtol=1e-12)
    u, _, covariance = bf.Calibration.from_chain(own).to_image([30.0], [0.0])
    assert u[0] == pytest.approx(
        30.0 - 1e-3 * 30.0 - 4e-6 * 30.0**3, abs=5.0 * covariance[0, 0, 0] ** 0.5
    )
    with pytest.raises(bf.InputError, match=r'expected that of a frame: chain.frame\("a"\)'):
        bf.Calibration.from_chain(chain)
    with pytest.raises(bf.InputError, match="expected one of a, b, c"):
        chain.frame("d")
    with pytest.raises(bf.InputError, match="several frames"):
        own.frame("a")


def test_the_verdict_is_that_of_all_frames(
    frames: dict[str, bf.Posterior], joint: bf.JointPosterior, estimate: bf.MapEstimate
) -> None:
    good = bf.diagnose(bf.laplace(joint, estimate, seed=1, progress=False))
    assert good.trustworthy and good.agreement is not None and good.agreement.agree
    assert list(good.frames) == ["a", "b", "c"]
    assert len(good.sources) == 75 and good.sources["frame"][30] == "b"
    assert good.deviance == pytest.approx(sum(each.deviance for each in good.frames.values()))
    assert good.n_fitted == joint.n_parameters
    wrong = bf.ForwardModel(MODEL.detector, MODEL.sources, bf.GaussianPSF(2.3), TERMS)
    bad = bf.Posterior(wrong, frames["b"].counts, nuisances=NUISANCES)
    found = bf.JointPosterior({**frames, "b": bad})
    verdict = bf.diagnose(bf.laplace(found, seed=1, progress=False))
    assert not verdict.fits_data
    assert "does not fit the counts of 1 of 3 frames (b); b: " in verdict.message


@pytest.mark.parametrize("odd", [0, 2])
def test_a_frame_of_another_instrument_is_named(odd: int) -> None:
    """Its cubic term differs by eight of its own standard deviations."""
    frames = {
        name: frame(10 + k, **({"f_x3": 9e-6} if k == odd else {})) for k, name in enumerate("abcd")
    }
    joint = bf.JointPosterior(frames)
    verdict = bf.diagnose(bf.laplace(joint, seed=1, progress=False))
    assert verdict.agreement is not None and verdict.agreement.odd == ("abcd"[odd],)
    assert not verdict.fits_data
    assert f"Frame {'abcd'[odd]} does not share what the others share" in verdict.message


def test_what_is_no_set_of_frames_is_refused(frames: dict[str, bf.Posterior]) -> None:
    def refused(match: str, *args: Any, **keywords: Any) -> None:
        with pytest.raises(bf.InputError, match=match):
            bf.JointPosterior(*args, **keywords)

    refused("got none", {})
    refused("name 'a b'", {"a b": frames["a"]})
    refused("name 'kind'", {"kind": frames["a"]})
    refused("got f_x9, which frame a does not have", frames, ["f_x9"])
    other = bf.Posterior(
        MODEL, frames["a"].counts, nuisances=NUISANCES, prior={"f_x3": stats.norm(0.0, 1e-3)}
    )
    refused("got another one of f_x3 in frame b", {"a": frames["a"], "b": other})
    agreed = bf.JointPosterior(
        {"a": frames["a"], "b": other}, prior={"f_x3": stats.norm(0.0, 1e-4)}
    )
    assert agreed.frame("b").prior["f_x3"].std() == 1e-4
    plain = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    flat = bf.Posterior(
        bf.ForwardModel(MODEL.detector, MODEL.sources, MODEL.psf, plain), frames["a"].counts
    )
    refused("no terms of degree 2 or higher", {"a": flat})
    refused("other terms or pixels in frame b", {"a": frames["a"], "b": flat}, ["f_x"])
    refused(
        "got background, expected names among", frames, prior={"background": stats.norm(0.0, 1.0)}
    )
    times = {"a": 0.0, "b": 1.0}
    refused("times: got those of a, b", frames, drift=bf.Drift(times, ("f_x3",)))
    refused(
        "terms: got background", frames, ["f_x3", "background"],
        drift=bf.Drift({**times, "c": 2.0}, ("background",)), prior={"background": stats.norm()},
    )  # fmt: skip
    for bad in ({"times": {"a": 0.0}}, {"times": {"a": 0.0, "b": np.nan}}, {"walk": -1.0}):
        with pytest.raises(bf.InputError, match="drift"):
            bf.Drift(**{"times": times, "terms": ("f_x3",), **bad})
    with pytest.raises(bf.InputError, match="got none, expected names"):
        bf.Drift(times, ())


def simulated_sets(n: int, k: int) -> Floats:
    """(found - true) / sd of the cubic terms of n sets of k frames, and sd, (n, 2, 2)."""
    truth, out = np.array(list(CUBIC.values())), np.empty((n, 2, 2))
    for i in range(n):
        joint = bf.JointPosterior({f"f{j}": frame(1000 + k * i + j) for j in range(k)})
        found = bf.find_map(joint)
        sd = np.sqrt(np.diag(found.covariance)[:2])
        out[i] = (found.params[:2] - truth) / sd, sd
    return out


@pytest.mark.statistics
def test_shared_terms_of_four_frames_cover_the_truth() -> None:
    """Of 200 sets of 4 frames, two terms each: 68.3 % within a standard deviation.

    The Monte Carlo error is 2.3 %. Errors of one frame in the place of those of four, twice as
    wide, would cover 95 %.
    """
    z, sd = np.moveaxis(simulated_sets(200, 4), 1, 0)
    assert np.mean(np.abs(z) < 1.0) == pytest.approx(0.683, abs=0.05)
    assert np.mean(np.abs(z) < 2.0) > 0.9  # ... as these are
    one = bf.find_map(frame(5)).covariance
    alone = np.sqrt([one[1, 1], one[3, 3]])
    np.testing.assert_allclose(np.mean(sd, axis=0) / alone, 0.5, rtol=0.05)


@pytest.mark.statistics
def test_frames_of_one_instrument_are_said_to_agree() -> None:
    """False alarms in at most 1 % of sets, and p-values uniform: Kolmogorov and Smirnov's test."""
    chances, alarms = [], 0
    for i in range(100):
        joint = bf.JointPosterior({f"f{j}": frame(5000 + 4 * i + j) for j in range(4)})
        found = frame_agreement(joint, bf.find_map(joint).params)
        alarms += not found.agree
        chances.append(found.p[0])
    assert alarms <= 4  # 1 is expected; more than 4 have a probability of 0.004
    assert stats.kstest(chances, "uniform").pvalue > 1e-3
    wrong = np.array(chances) ** 2  # as errors too small would make them
    assert stats.kstest(wrong, "uniform").pvalue < 1e-3


def test_pairs_of_frames_are_combined_in_any_order(frames: dict[str, bf.Posterior]) -> None:
    """The order of the frames changes nothing but rounding."""
    orders = list(itertools.permutations("abc"))[:2]
    found = [bf.find_map(bf.JointPosterior({name: frames[name] for name in o})) for o in orders]
    np.testing.assert_allclose(found[0].params[:2], found[1].params[:2], rtol=1e-4)
