"""Checks of several frames: their sources in folds, halves fitted apart, and models compared.

What they find is held against dense formulas, refits, grids and single frames, all of which use
nothing of the code for several frames but the fold of each source.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.special import logsumexp

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.analysis.evidence import log_evidence
from bayesfred.analysis.extra_parameters import contained
from bayesfred.analysis.folds import fold_sources
from bayesfred.analysis.joint_folds import fold_frames
from bayesfred.analysis.sources import source_table
from bayesfred.io.tangent_plane import TangentPlane

LINEAR = [(1, 0, 0, 0)], [(0, 1, 0, 0)]
TERMS = bf.PolynomialDistortion([*LINEAR[0], (3, 0, 0, 0)], [*LINEAR[1], (0, 3, 0, 0)])
CUBIC = {"f_x3": 8e-6, "g_y3": -6e-6}
GRID = bf.SourceCatalog.grid(5, 13.0, 4e3)
LEVEL = 3.0
NUISANCES = bf.Nuisances(flux="scale", offset=True)
SCATTERED = bf.Nuisances(flux="free", offset=True, position_scatter=True)


def model_of(
    catalogue: bf.SourceCatalog = GRID, terms: bf.PolynomialDistortion = TERMS
) -> bf.ForwardModel:
    return bf.ForwardModel(bf.Detector((71, 71)), catalogue, bf.GaussianPSF(1.8), terms)


def frame(
    seed: int, *, off: Floats | None = None, catalogue: bf.SourceCatalog = GRID, **options: Any
) -> bf.Posterior:
    """A simulated frame of a lens with cubic terms, whose sources lie `off` their positions."""
    model = model_of(catalogue)
    theta = np.array([CUBIC.get(name, 0.0) for name in TERMS.names])
    x, y = np.array([catalogue.x, catalogue.y]) + (0.0 if off is None else off)
    true = replace(model, sources=bf.SourceCatalog(x, y, catalogue.flux))
    counts = bf.simulate(true, theta, LEVEL, seed=seed)
    return bf.Posterior(model, counts, **{"nuisances": NUISANCES, **options})


def joint_of(seed: int, k: int = 3, *, scatter: float = 0.0, **options: Any) -> bf.JointPosterior:
    off = scatter * np.random.default_rng([41, seed]).standard_normal((k, 2, len(GRID)))
    return bf.JointPosterior(
        {"abc"[i]: frame(100 * seed + i, off=off[i], **options) for i in range(k)}
    )


@pytest.fixture(scope="module")
def joint() -> bf.JointPosterior:
    return joint_of(1)


# --- folds ----------------------------------------------------------------------------------------


def test_halves_of_every_frame_are_a_checkerboard_that_shares_no_pixel(
    joint: bf.JointPosterior,
) -> None:
    folds = fold_frames(joint, joint.start(), 2)
    for name, posterior in joint.frames.items():
        assert np.array_equal(folds.frames[name].sources, np.arange(25) % 2)
        one, two = (folds.only(joint, k).frames[name].mask for k in (0, 1))
        assert not np.any(one & two) and np.array_equal(one | two, posterior.mask)
        assert np.array_equal(folds.without(joint, 0).frames[name].mask, two)
    assert np.array_equal(folds.sources, np.tile(np.arange(25) % 2, 3))
    assert folds.members[1][:2] == ("a.1", "a.3") and "c.23" in folds.members[1]


@pytest.mark.parametrize("number", [2, 7])
def test_folds_of_one_frame_are_those_of_the_frame(joint: bf.JointPosterior, number: int) -> None:
    posterior = joint.frames["b"]
    wanted = fold_sources(posterior, posterior.start(), number)
    alone = bf.JointPosterior({"b": posterior})
    for found in (
        fold_frames(posterior, posterior.start(), number).frames[""],
        fold_frames(alone, alone.start(), number).frames["b"],
    ):
        assert np.array_equal(found.sources, wanted.sources)
        assert np.array_equal(found.pixels, wanted.pixels)


@pytest.mark.parametrize("on_the_sky", [False, True])
def test_a_source_that_several_frames_show_is_in_one_fold(*, on_the_sky: bool) -> None:
    """The second frame lacks the first source, the third shows three new ones as well.

    On the sky the frames point elsewhere, so that a source has another position in each.
    """
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-30.0, 30.0, (2, 23))
    shows = {"a": np.arange(20), "b": np.arange(1, 20), "c": np.arange(3, 23)}
    frames = {}
    for k, (name, rows) in enumerate(shows.items()):
        plane = TangentPlane(10.0, 20.0, ((-0.01, 0.0), (0.0, 0.01)), (2.0 * k, -1.0 * k))
        shift = np.array(plane.origin) if on_the_sky else np.zeros(2)
        catalogue = bf.SourceCatalog(
            x[rows] + shift[0], y[rows] + shift[1], np.full(rows.size, 4e3),
            plane if on_the_sky else None,
        )  # fmt: skip
        frames[name] = bf.Posterior(model_of(catalogue), np.full((71, 71), LEVEL))
    joint = bf.JointPosterior(frames)
    folds = fold_frames(joint, joint.start(), 2)
    dealt: dict[int, int] = {}
    for name, rows in shows.items():
        own = folds.frames[name].sources
        assert all(dealt.setdefault(row, k) == k for row, k in zip(rows, own, strict=True))
        assert abs(np.diff(np.bincount(own))) <= 2
    # dealt for itself the second frame has others together
    alone = fold_sources(frames["b"], frames["b"].start(), 2).sources
    assert len({*zip(alone.tolist(), folds.frames["b"].sources.tolist(), strict=True)}) > 2


def test_frames_of_few_sources_fill_all_folds_and_no_frame_is_in_one() -> None:
    rng = np.random.default_rng(2)
    frames = {}
    for k in range(6):
        x, y = rng.uniform(-30.0, 30.0, (2, 5))
        model = model_of(bf.SourceCatalog(x, y, np.full(5, 4e3)))
        frames[f"f{k}"] = bf.Posterior(model, np.full((71, 71), LEVEL))
    joint = bf.JointPosterior(frames)
    assert set(np.bincount(fold_frames(joint, joint.start(), 10).sources)) == {3}
    one = bf.SourceCatalog(GRID.x[[0, 2, 4]], GRID.y[[0, 2, 4]], GRID.flux[:3])  # of one half
    same = {"a": frame(1), "b": frame(2, catalogue=one)}
    joint = bf.JointPosterior(same)
    assert set(fold_frames(joint, joint.start(), 2).frames["b"].sources) == {0, 1}


# --- halves ---------------------------------------------------------------------------------------

BRIGHT = bf.SourceCatalog(GRID.x, GRID.y, 100.0 * GRID.flux)  # likelihoods are quadratic


def nearest(posterior: bf.Posterior, images: Floats | None = None) -> Any:
    """The source that is nearest to each pixel: all have one flux. By default they do not move."""
    u, v = np.meshgrid(*posterior.model.detector.pixel_centres())
    sources = posterior.model.sources
    x, y = (sources.x, sources.y) if images is None else images.T
    return np.argmin((u[..., None] - x) ** 2 + (v[..., None] - y) ** 2, axis=-1)


def halves_of(joint: bf.JointPosterior, sources: Floats) -> list[bf.JointPosterior]:
    rows = sources.reshape(len(joint.frames), -1)
    return [
        bf.JointPosterior(
            {
                name: replace(each, mask=(row == k)[nearest(each)], extrapolation=None)
                for (name, each), row in zip(joint.frames.items(), rows, strict=True)
            },
            joint.shared, prior=joint.prior, drift=joint.drift,
        )
        for k in (0, 1)
    ]  # fmt: skip


def displaced(joint: bf.JointPosterior, name: str, params: Floats, points: Floats) -> Floats:
    """By how much the objects that are imaged at points are displaced, (2 n,): u, then v."""
    posterior, own = joint.frames[name], joint.frame_params(name, params)
    values = dict(zip(posterior.parameter_names, own, strict=True))
    offset = np.array([values["offset_x"], values["offset_y"]])
    theta = own[: TERMS.n_terms]
    x, y = posterior.model.polynomial.object_position(theta, *points.T, offset=offset)
    return np.concatenate([points[:, 0] - x, points[:, 1] - y])


def slopes(joint: bf.JointPosterior, name: str, params: Floats, points: Floats) -> Floats:
    """Their derivatives by all parameters, by differences, (2 n, d)."""
    steps = np.diag(0.1 * np.diag(joint.information(params)) ** -0.5)
    return np.array(
        [
            (
                displaced(joint, name, params + step, points)
                - displaced(joint, name, params - step, points)
            )
            / (2.0 * step.sum())
            for step in steps
        ]
    ).T


def drifting(frames: Mapping[str, bf.Posterior]) -> bf.JointPosterior:
    times = {"a": 0.0, "b": 1.0, "c": 3.0}
    return bf.JointPosterior(frames, drift=bf.Drift(times, ("f_x3",)))


@pytest.fixture(scope="module", params=[False, True], ids=["constant", "drifting"])
def bright(request: pytest.FixtureRequest) -> bf.JointPosterior:
    frames = {name: frame(10 + k, catalogue=BRIGHT) for k, name in enumerate("abc")}
    return drifting(frames) if request.param else bf.JointPosterior(frames)


def test_differences_are_those_of_refits(bright: bf.JointPosterior) -> None:
    """The prior of bright frames is as good as flat. Half of the sources are fitted by hand."""
    joint, whole = bright, bf.find_map(bright)
    found = bf.cross_check(joint, estimate=whole)
    one, two = (bf.find_map(half) for half in halves_of(joint, found.sources))
    sd = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose((found.params - [one.params, two.params]) / sd, 0.0, atol=0.01)
    some = np.arange(joint.n_shared)
    difference = (one.params - two.params)[some]
    covariance = (one.covariance + two.covariance)[np.ix_(some, some)]
    chi2 = difference @ np.linalg.solve(covariance, difference)
    assert found.coefficients.dof == joint.n_shared
    assert found.coefficients.chi2 == pytest.approx(chi2, rel=0.01)
    folds = fold_frames(joint, whole.params, 2)
    squares, expected = [], []
    for name in joint.frames:
        points = folds.frames[name].points
        away = [displaced(joint, name, top.params, points) for top in (one, two)]
        squares.append((away[0] - away[1]) ** 2)
        slope = slopes(joint, name, whole.params, points)
        expected.append(np.sum(slope @ (one.covariance + two.covariance) * slope, axis=1))
    assert found.displacement_rms == pytest.approx(np.sqrt(np.mean(squares)), rel=0.01)
    assert found.displacement_expected == pytest.approx(np.sqrt(np.mean(expected)), rel=0.01)
    assert joint.n_shared < found.displacement.dof <= joint.n_parameters - 6


def test_predicted_positions_are_judged_by_the_dense_covariance(bright: bf.JointPosterior) -> None:
    """The field is to first order in the distortion, whose slopes are up to 0.03 here."""
    found = bf.cross_check(bright)
    one, two = halves_of(bright, found.sources)
    params, covariance = found.params[1], np.linalg.inv(two.information(found.params[1]))
    away, slope, own = [], [], []
    for k, (name, posterior) in enumerate(one.frames.items()):
        mine = found.sources[25 * k : 25 * k + 25] == 0
        table = source_table(posterior, one.frame_params(name, params))[mine]
        points = np.column_stack([table["u"], table["v"]])
        off = np.concatenate([table["du"], table["dv"]])
        errors = np.concatenate([table["du_sd"], table["dv_sd"]]) ** 2
        field = slopes(one, name, params, points)
        alone = off @ np.linalg.solve(np.diag(errors) + field @ covariance @ field.T, off)
        assert found.frames[name].positions[0].chi2 == pytest.approx(alone, rel=0.01)
        assert found.frames[name].positions[0].dof == off.size
        for rows, values in ((away, off), (slope, field), (own, errors)):
            rows.append(values)
    off, field, errors = (np.concatenate(rows) for rows in (away, slope, own))
    chi2 = off @ np.linalg.solve(np.diag(errors) + field @ covariance @ field.T, off)
    assert found.positions[0].chi2 == pytest.approx(chi2, rel=0.01)
    assert found.positions[0].dof == off.size == 78


OPTIONS = {
    "scale": {},
    "scatter": {"nuisances": SCATTERED},
    "shared scatter": {"nuisances": SCATTERED},
}


@pytest.mark.parametrize(
    "kind",
    [pytest.param(k, marks=[pytest.mark.slow] if "scatter" in k else []) for k in OPTIONS],
)
def test_one_frame_is_judged_as_a_joint_posterior_as_alone(kind: str) -> None:
    """With every coefficient shared; the scatter is held at the same value either way."""
    off = 0.1 * np.random.default_rng(5).standard_normal((2, 25)) if "scatter" in kind else None
    posterior = frame(3, off=off, **OPTIONS[kind])
    moving = [*TERMS.names, "offset_x", "offset_y"]
    shared = [*moving, "position_scatter"] if kind == "shared scatter" else moving
    alone = bf.cross_check(posterior)
    found = bf.cross_check(bf.JointPosterior({"a": posterior}, shared))
    for one, other in (
        (alone.displacement, found.displacement), (alone.coefficients, found.coefficients),
        *zip(alone.positions, found.positions, strict=True),
        (alone.displacement, found.frames["a"].displacement),
    ):  # fmt: skip
        assert one.dof == other.dof
        assert other.chi2 == pytest.approx(one.chi2, rel=5e-3)
    assert found.displacement_rms == pytest.approx(alone.displacement_rms, rel=5e-3)


@pytest.mark.slow
def test_frames_that_share_nothing_of_the_lens_are_judged_as_alone() -> None:
    """They share a background that is known; their coefficients are all there is to compare."""
    known = {"background": stats.norm(LEVEL, 1e-4)}
    rng = np.random.default_rng(6)
    frames = {
        name: frame(
            k, off=0.1 * rng.standard_normal((2, 25)), prior=known, nuisances=SCATTERED
        )
        for k, name in enumerate("ab")
    }  # fmt: skip
    found = bf.cross_check(bf.JointPosterior(frames, ["background"]))
    alone = {name: bf.cross_check(each) for name, each in frames.items()}
    assert found.coefficients.dof == sum(each.coefficients.dof for each in alone.values())
    total = sum(each.coefficients.chi2 for each in alone.values())
    assert found.coefficients.chi2 == pytest.approx(total, rel=0.01)
    for name, each in alone.items():
        own = found.frames[name]
        assert own.displacement.chi2 == pytest.approx(each.displacement.chi2, rel=0.01)
        for one, other in zip(own.positions, each.positions, strict=True):
            assert one.chi2 == pytest.approx(other.chi2, rel=0.01)


# --- verdicts -------------------------------------------------------------------------------------


def test_right_errors_are_found_right(joint: bf.JointPosterior) -> None:
    found = bf.cross_check(joint)
    assert found.holds and "the halves agree" in found.message
    assert found.coefficients.dof == 2 and found.displacement.dof > 10
    assert list(found.frames) == list(found.record()["frames"]) == ["a", "b", "c"]
    for own in found.frames.values():  # the root of chi-square / n is known to 1 / sqrt(2 n)
        assert all(abs(a.factor - 1.0) < 4.0 / np.sqrt(2.0 * a.dof) for a in own.positions)
    assert found.record()["frames"]["b"]["displacement_p"] == found.frames["b"].displacement.p


def test_a_catalogue_that_is_wrong_is_found() -> None:
    """Positions scattered by some five of their errors."""
    found = bf.cross_check(joint_of(2, scatter=0.15))
    assert found.verdict == "too small" and found.displacement.factor > 2.0
    assert "; 3 of 3 frames show it alone (a, b, c); " in found.message


def test_one_frame_with_a_wrong_catalogue_is_named() -> None:
    frames = dict(joint_of(3).frames)
    off = 0.2 * np.random.default_rng(7).standard_normal((2, 25))
    found = bf.cross_check(bf.JointPosterior({**frames, "b": frame(9, off=off)}))
    assert found.verdict == "too small"
    assert "; 1 of 3 frames show it alone (b); " in found.message


def test_too_few_sources_are_refused_by_the_frames_name() -> None:
    one = bf.SourceCatalog(GRID.x[:1], GRID.y[:1], GRID.flux[:1])
    few = bf.Posterior(model_of(one), bf.simulate(model_of(one), np.zeros(4), LEVEL, seed=1))
    joint = bf.JointPosterior({"a": frame(1, nuisances=bf.Nuisances()), "b": few}, TERMS.names)
    with pytest.raises(bf.InputError, match=r"got 1 sources .* in frame b, .* or leave it out"):
        bf.cross_check(joint)


def chi_squares(n: int, **options: Any) -> Floats:
    """p of the displacement, the shared coefficients, and positions in both halves: (n, 4)."""
    found = (bf.cross_check(joint_of(200 + k, **options)) for k in range(n))
    return np.array(
        [(c.displacement_p, c.coefficients_p, *(a.p for a in c.positions)) for c in found]
    )


@pytest.mark.statistics
def test_chi_squares_of_simulated_sets_are_uniform() -> None:
    """30 sets of 3 frames; of uniform numbers the mean p has the Monte Carlo error 0.053.

    The negative control has sources off their positions by about one of their errors.
    """
    p = chi_squares(30)
    assert p.mean(axis=0) == pytest.approx(0.5, abs=4.0 * 0.053)
    assert min(stats.kstest(column, "uniform").pvalue for column in p.T) > 1e-3
    wrong = chi_squares(10, scatter=0.04)
    assert stats.kstest(wrong[:, 0], "uniform").pvalue < 1e-3


@pytest.mark.statistics
def test_errors_of_the_catalogue_that_frames_have_in_common_are_found() -> None:
    """Positions scatter alike in all frames, which are taken as independent.

    Three frames share their coefficients. Those have errors too small by the root of 3 then, and a
    chi-square of 18 for 6 degrees of freedom on average, where independent errors give 6. The means
    of 20 sets have errors of 2.3 and 0.77. Positions scatter as the model says: Student's t.
    """
    shared = [*TERMS.names, "offset_x", "offset_y"]
    means = {}
    for alike in (True, False):
        found = []
        for k in range(20):
            rng = np.random.default_rng([8, k])
            off = 0.1 * rng.standard_normal((3, 2, 25))
            off /= np.sqrt(rng.chisquare(3.0, (3, 1, 25)) / 3.0)
            frames = {
                name: frame(1000 + 3 * k + i, off=off[0 if alike else i], nuisances=SCATTERED)
                for i, name in enumerate("abc")
            }
            found.append(bf.cross_check(bf.JointPosterior(frames, shared)).coefficients)
        assert {a.dof for a in found} == {6}
        means[alike] = np.mean([a.chi2 for a in found])
    assert means[False] == pytest.approx(6.0, abs=4.0 * 0.77)
    assert means[True] > 6.0 + 4.0 * 0.77


# --- models compared ------------------------------------------------------------------------------

PLACES = np.array([[-12.0, 12.0, 0.0], [-8.0, -10.0, 12.0]])
KNOWN = {"background": stats.norm(LEVEL, 1e-4)}
THETA = np.linspace(-0.02, 0.06, 401)


def small(places: Floats, seed: int) -> bf.Posterior:
    """Three sources far apart, which one coefficient moves; the background is known."""
    model = bf.ForwardModel(
        bf.Detector((43, 43)), bf.SourceCatalog(*places, [2000.0] * 3), bf.GaussianPSF(1.5),
        bf.PolynomialDistortion([(1, 0, 0, 0)], []),
    )  # fmt: skip
    return bf.Posterior(model, bf.simulate(model, [0.02], LEVEL, seed=seed), prior=KNOWN)


def by_pixel(posterior: bf.Posterior) -> Floats:
    """Log-probability of every pixel's counts for every theta, (n, ny, nx)."""
    mu = np.array([posterior.model.expected_counts([theta], LEVEL) for theta in THETA])
    return np.asarray(stats.poisson.logpmf(posterior.counts, mu))


@pytest.fixture(scope="module", params=["one catalogue", "two catalogues"])
def pair(request: pytest.FixtureRequest) -> bf.JointPosterior:
    other = PLACES if request.param == "one catalogue" else -PLACES
    return bf.JointPosterior({"a": small(PLACES, 1), "b": small(other, 2)}, ["f_x"])


def test_the_evidence_is_that_of_a_grid(pair: bf.JointPosterior) -> None:
    """By bridge sampling, and from draws of the Laplace approximation."""
    pixels = sum(by_pixel(each).sum(axis=(1, 2)) for each in pair.frames.values())
    prior = pair.prior["f_x"].logpdf(THETA)
    exact = logsumexp(pixels + prior) + np.log(THETA[1] - THETA[0])
    for chain in (
        bf.sample(pair, seed=1, target_ess=300, progress=False),
        bf.laplace(pair, seed=1, progress=False),
    ):
        found = log_evidence(chain)
        assert found.error < 0.05
        assert abs(found.log_evidence - exact) < 4.0 * found.error + 1e-3
    twice = logsumexp(pixels + 2.0 * prior) + np.log(THETA[1] - THETA[0])  # a prior of each frame
    assert abs(found.log_evidence - twice) > 1.0


def test_sources_are_predicted_as_exact_refits_do(pair: bf.JointPosterior) -> None:
    """A source that both frames show is left out of both."""
    chain = bf.laplace(pair, seed=1, progress=False)
    found = bf.compare({"one": chain, "other": chain})
    alike = np.array_equal(*(each.model.sources.x for each in pair.frames.values()))
    assert len(found.folds) == (3 if alike else 6)
    every = {f"{name}.{k}" for name in "ab" for k in range(3)}
    assert {name for fold in found.folds for name in fold} == every
    if alike:
        assert sorted(found.folds) == [(f"a.{k}", f"b.{k}") for k in range(3)]
    prior = pair.prior["f_x"].logpdf(THETA)
    parts = {}
    for name, each in pair.frames.items():
        images = each.likelihood.image_positions(pair.frame_params(name, chain.estimate.params))
        pixels, owner = by_pixel(each), nearest(each, images)
        parts |= {f"{name}.{k}": pixels[:, owner == k].sum(axis=1) for k in range(3)}
    whole = sum(parts.values()) + prior
    for fold, value in zip(found.folds, found.scores[0].by_fold, strict=True):
        rest = whole - sum(parts[str(name)] for name in fold)
        assert value == pytest.approx(logsumexp(whole) - logsumexp(rest), abs=0.1)


def fitted(frames: Mapping[str, bf.Posterior], terms: bf.PolynomialDistortion) -> bf.Chain:
    """Draws of the same frames with other terms, those of degree 2 and higher shared."""
    joint = bf.JointPosterior(
        {
            name: bf.Posterior(model_of(terms=terms), each.counts, nuisances=NUISANCES)
            for name, each in frames.items()
        }
    )
    return bf.laplace(joint, seed=1, progress=False)


ONE = bf.PolynomialDistortion(TERMS.f_terms, LINEAR[1] + [(0, 2, 0, 0)])
MORE = bf.PolynomialDistortion(
    [*TERMS.f_terms, (2, 0, 0, 0), (1, 1, 0, 0)], [*TERMS.g_terms, (0, 2, 0, 0)]
)


@pytest.fixture(scope="module")
def chains() -> dict[str, bf.Chain]:
    frames = joint_of(1, 2).frames
    return {
        name: fitted(frames, terms)
        for name, terms in {"right": TERMS, "wrong": ONE, "more": MORE}.items()
    }


def test_the_right_shared_terms_are_chosen(chains: dict[str, bf.Chain]) -> None:
    found = bf.compare(chains)
    scores = {score.name: score for score in found.scores}
    assert found.chosen == "right" and found.reliable
    assert scores["wrong"].difference > 10.0 and scores["wrong"].weight < 0.01
    assert [scores[name].n_parameters for name in ("right", "more")] == [14, 17]
    assert scores["right"].log_evidence > scores["wrong"].log_evidence + 10.0
    assert set(found.extra) == {("right", "more"), ("wrong", "more")}
    extra = found.extra["right", "more"]
    assert extra.names == ("f_x2", "f_xy", "g_y2") and not extra.real
    assert found.extra["wrong", "more"].real
    assert "a." in found.sentences[-1] and "b." in found.sentences[-1]
    assert len(found.folds) == 20 and all(len(fold) in (2, 4) for fold in found.folds)


def test_a_wider_model_of_frames_contains_a_leaner_one(chains: dict[str, bf.Chain]) -> None:
    leaner, params = chains["right"].posterior(), chains["right"].estimate.params
    times = {"a": 0.0, "b": 1.0}
    wider = bf.JointPosterior(leaner.frames, drift=bf.Drift(times, ("g_y3",)))
    values = contained(leaner, params, wider)
    assert values is not None
    known = dict(zip(wider.parameter_names, values, strict=True))
    assert known.pop("g_y3.drift") == 0.0
    assert known == dict(zip(leaner.parameter_names, params, strict=True))
    assert contained(wider, values, leaner) is None
    free, loose = (
        {name: frame(k, nuisances=each) for k, name in enumerate("ab")}
        for each in (bf.Nuisances("free", offset=True), SCATTERED)
    )
    one, other = bf.JointPosterior(free), bf.JointPosterior(loose)
    assert contained(one, one.start(), other) is None  # no scatter is the prior's bound


def test_models_of_other_frames_are_refused(chains: dict[str, bf.Chain]) -> None:
    right = chains["right"]
    joint = right.posterior()
    a, b = joint.frames.values()
    mask = np.ones(b.counts.shape, bool)
    mask[0, 0] = False
    read = replace(b, noise=bf.PoissonNoise(3.0))
    for other, said in (
        (
            bf.JointPosterior({"a": a, "c": b}),
            "frames: got frames a, c where right has frames a, b",
        ),
        (bf.JointPosterior({"a": a}), "frames: got frames a where"),
        (a, "frames: got one frame where right has frames a, b"),
        (bf.JointPosterior({"a": a, "b": replace(b, counts=b.counts + 1.0)}), "frame b: counts"),
        (bf.JointPosterior({"a": a, "b": replace(b, mask=mask)}), "frame b: mask"),
        (bf.JointPosterior({"a": a, "b": read}), "frame b: noise: got a density"),
    ):
        with pytest.raises(bf.InputError, match=f"^other: {said}"):
            bf.compare({"right": right, "other": replace(right, density=other)})
    swapped = bf.JointPosterior({"b": b, "a": a})  # the order is no matter
    chain = bf.laplace(swapped, seed=1, progress=False)
    found = bf.compare({"right": right, "swapped": chain})
    np.testing.assert_allclose(found.scores[1].difference, 0.0, atol=0.5)
