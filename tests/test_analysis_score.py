"""Tests of what is not fitted and of every source: exact, calibrated, powerful, with controls."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import bayesfred as bf
from bayesfred.analysis import source_tests
from bayesfred.analysis.causes import hidden_causes
from bayesfred.analysis.checks import largest_deviate
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.residuals import Residuals, judge_residuals
from bayesfred.analysis.score_tests import (
    FALSE_ALARM,
    ScoreTests,
    score_tests,
    with_more_terms,
)
from bayesfred.analysis.verdict import FitVerdict, judge_fit
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.monomials import degree_of
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import BackgroundNoise, GaussianNoise, PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.fit_statistics import consistent, fit_statistics
from bayesfred.sampling.laplace import laplace

Floats = NDArray[np.float64]

LIMIT = 4.0  # Monte Carlo errors: exceeded by chance in 1 of 16,000
FRAMES = 50
SIGMA = 2.0
POLYNOMIAL = PolynomialDistortion.polynomial


def simulated(model: ForwardModel, seed: int, level: float = 5.0, **fitted: Any) -> Posterior:
    """A frame of Poisson counts without distortion; `fitted` changes the model that is fitted."""
    theta = np.zeros(model.distortion.n_terms)
    counts = np.random.default_rng([seed, 16]).poisson(model.expected_counts(theta, level))
    return Posterior(replace(model, **fitted), counts)


def stars(photons: float = 1e4) -> ForwardModel:
    """49 stars and the paper's 12 terms."""
    sources = SourceCatalog.grid(7, 17.0, photons)
    lens = PolynomialDistortion.mirrored()
    return ForwardModel(Detector((129, 129)), sources, GaussianPSF(SIGMA), lens)


def wide_psf(seed: int, wider: float = 1.03, photons: float = 1e4) -> Posterior:
    """The PSF is wider than the model has it."""
    model = stars(photons)
    return simulated(replace(model, psf=GaussianPSF(wider * SIGMA)), seed, psf=model.psf)


def slightly_wide_psf(seed: int) -> Posterior:
    return wide_psf(seed, 1.01, 1e5)


def displaced_star(seed: int) -> Posterior:
    """A star in the corner is 0.3 pixel off."""
    model = stars()
    x = model.sources.x.copy()
    x[-1] += 0.3
    return simulated(
        replace(model, sources=replace(model.sources, x=x)), seed, sources=model.sources
    )


def faint_displaced_stars(seed: int) -> Posterior:
    """All stars lie off their places by some 0.05 pixel."""
    model, rng = stars(), np.random.default_rng([seed, 17])
    x, y = np.array([model.sources.x, model.sources.y]) + rng.normal(0.0, 0.05, (2, 49))
    moved = replace(model.sources, x=x, y=y)
    return simulated(replace(model, sources=moved), seed, sources=model.sources)


def tilted_background(seed: int) -> Posterior:
    """The background rises by 12 % from one side to the other."""
    model, rng = stars(), np.random.default_rng([seed, 18])
    level = 5.0 * (1.0 + np.linspace(-0.06, 0.06, 129))
    return Posterior(model, rng.poisson(model.expected_counts(np.zeros(12)) + level))


def missing_terms(seed: int) -> Posterior:
    """A cubic lens is fitted with a polynomial of degree 2; it moves the corner by 0.05 pixel."""
    model = replace(stars(), distortion=POLYNOMIAL(3))
    theta = np.zeros(18)
    theta[model.distortion.names.index("f_x3")] = 0.15 / 60.0**3
    counts = np.random.default_rng([seed, 16]).poisson(model.expected_counts(theta, 5.0))
    return Posterior(replace(model, distortion=POLYNOMIAL(2)), counts)


HIDDEN = {
    "PSF 3 % wider": (wide_psf, "PSF"),
    "PSF 1 % wider": (slightly_wide_psf, "PSF"),
    "a displaced star": (displaced_star, "wrong sources"),
    "displaced stars": (faint_displaced_stars, "positions"),
    "a tilted background": (tilted_background, "background"),
    "missing terms": (missing_terms, "missing terms"),
}


def judged(posterior: Posterior, start: Floats | None = None) -> tuple[FitVerdict, Residuals, bool]:
    """The verdict at the maximum, the tests, and whether the sums alone would pass."""
    best = find_map(posterior, start)
    residuals = judge_residuals(posterior, best.params, best.covariance)
    fit = fit_statistics(posterior, best.params)
    return judge_fit(posterior, best, fit, residuals), residuals, consistent(fit)


# --- exact ----------------------------------------------------------------------------------------


def dense_scores(posterior: Posterior, params: Floats, more: ForwardModel) -> tuple[Floats, Floats]:
    """Scores and their covariance from Jacobians by differences, of every number in the table."""
    full = Nuisances("scale", offset=True, psf_sigma=True, background_order=2)
    large = Posterior(more, posterior.counts, nuisances=full)
    known = dict(zip(posterior.parameter_names, params, strict=True))
    at = np.array([known.get(p.name, p.neutral) for p in large.parameters])
    mu, columns = large.expected_counts(at).ravel(), []
    for k in range(at.size):
        step = np.zeros(at.size)
        step[k] = 1e-4 / np.sqrt(large.fisher(at)[k, k])
        change = large.expected_counts(at + step) - large.expected_counts(at - step)
        columns.append(change.ravel() / (2.0 * step[k]))
    j = np.array(columns)
    score, information = j @ (posterior.counts.ravel() / mu - 1.0), (j / mu) @ j.T
    own = [k for k, name in enumerate(large.parameter_names) if name in known]
    rest = [k for k, name in enumerate(large.parameter_names) if name not in known]
    fitted = information[np.ix_(own, own)] + posterior.prior_information(params)
    taken = np.linalg.solve(fitted, information[np.ix_(own, rest)])
    left = information[np.ix_(rest, rest)] - information[np.ix_(rest, own)] @ taken
    # at the maximum the prior balances the gradient
    return score[rest] - taken.T @ (score[own] + posterior.gradient(params)
                                    - posterior.likelihood.gradient(params)), left  # fmt: skip


def test_scores_are_those_of_dense_algebra() -> None:
    model = ForwardModel(
        Detector((40, 47)), SourceCatalog.grid(3, 11.0, 2e3), GaussianPSF(1.7), POLYNOMIAL(1)
    )
    posterior = simulated(model, 1)
    params = find_map(posterior).params
    found = score_tests(posterior, params)
    more = replace(model, distortion=with_more_terms(model.polynomial))
    score, covariance = dense_scores(posterior, params, more)
    scale = np.sqrt(np.diag(covariance))
    assert len(found.names) == 4 + 5 + 6 + 8
    assert found.score / scale == pytest.approx(score / scale, abs=1e-5)
    assert found.covariance / np.outer(scale, scale) == pytest.approx(
        covariance / np.outer(scale, scale), abs=1e-5
    )


@pytest.mark.parametrize(
    "noise",
    [PoissonNoise(2.0), pytest.param(PoissonNoise(np.full((65, 65), 0.7)), marks=pytest.mark.slow)],
)
def test_a_frame_is_shared_by_models_of_other_backgrounds(noise: PoissonNoise) -> None:
    """A likelihood is what it is when all is made for it, also of a background that varies."""
    sources = SourceCatalog.grid(3, 17.0, 1e3)
    model = ForwardModel(Detector((65, 65)), sources, GaussianPSF(SIGMA), POLYNOMIAL(1))
    counts = bf.simulate(model, np.zeros(4), 5.0, seed=2, noise=noise)
    plain, sloped = (
        Posterior(model, counts, noise=noise, nuisances=Nuisances(background_order=order))
        for order in (0, 1)
    )
    params = np.array([1e-3, -2e-3, 1e-3, 0.0, 5.0, 0.01, -0.02])
    own = [sloped.likelihood.gradient(params), sloped.likelihood.fisher(params)]
    shared = replace(sloped.likelihood)
    shared.share_frame(plain.likelihood)
    for expected, found in zip(own, (shared.gradient(params), shared.fisher(params)), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize(
    "lens",
    [
        PolynomialDistortion.paper(),
        PolynomialDistortion.radial_tangential(30.0),
        PolynomialDistortion([], [(0, 2, 0, 0)]),
    ],
)
def test_added_terms_leave_the_others_as_they_are(lens: PolynomialDistortion) -> None:
    more, rng = with_more_terms(lens), np.random.default_rng(2)
    names, point = more.names, rng.uniform(-30.0, 30.0, 4)
    design, own = more.design_matrix(*point), lens.design_matrix(*point)
    assert design[:, : lens.n_terms] == pytest.approx(own, rel=1e-12)
    x, y = point[2:]
    degree = 2 + max(sum(term) for term in (*lens.f_terms, *lens.g_terms))
    assert len(set(names)) == len(names)
    assert f"f_x{degree}" in names and f"g_y{degree}" in names and f"f_x{degree + 1}" not in names
    assert design[:, names.index("f_xy")] == pytest.approx([x * y, 0.0])
    assert design[:, names.index("g_x2")] == pytest.approx([0.0, x**2])


def test_one_wrong_number_is_named_once() -> None:
    """Two scores that share nine tenths: one number explains both."""
    covariance = np.array([[1.0, 0.9, 0.0], [0.9, 1.0, 0.0], [0.0, 0.0, 4.0]])
    names, values = ("a", "b", "c"), np.array([1.0, 2.0, 3.0])
    tested = np.ones(3, bool)

    def leading(score: Floats) -> list[str]:
        return [lead.name for lead in ScoreTests(names, values, score, covariance, tested).leading]

    assert leading(10.0 * covariance[0]) == ["a"]
    assert leading(10.0 * covariance[0] + 5.0 * covariance[2]) == ["a", "c"]
    assert leading(np.array([2.0, -2.0, 4.0])) == []
    first = ScoreTests(names, values, 10.0 * covariance[0], covariance, tested).leading[0]
    assert (first.z, first.value, first.step) == pytest.approx((10.0, 1.0, 10.0))


def test_deviates_of_few_counts_are_those_of_poissons_distribution() -> None:
    """A sum of 30 pixels of 2 counts each: against the exact tails; a Gaussian is far off them."""
    pixels, mean = 30, 2.0
    total, worst = pixels * mean, 0.0
    for n in (30, 36, 90, 105):
        z = np.array([(n - total) / np.sqrt(total)])
        weights = np.full(pixels, total**-0.5)
        terms = weights, np.full(pixels, mean), np.ones(pixels)
        found = source_tests._deviates(z, terms, np.zeros(pixels, int))[0]
        # between the probabilities of n or fewer and of fewer than n
        low, high = stats.norm.isf(stats.poisson.sf([n - 1, n], total))
        assert low - 0.05 < found < high + 0.05
        worst = max(worst, abs(z[0] - found))
        none = terms[0], terms[1], np.zeros(pixels)
        assert source_tests._deviates(z, none, np.zeros(pixels, int))[0] == pytest.approx(z[0])
    assert worst > 0.5


def test_discoveries_are_those_of_the_rule() -> None:
    rng = np.random.default_rng(3)
    z = rng.standard_normal((40, 7))
    z[:6, 2], z[7, 0], z[8, 0], z[9:20, 5] = [-9.0, 5.0, 4.1, 3.9, 3.6, 3.0], 6.0, -8.0, np.nan
    p = 2.0 * stats.norm.sf(np.abs(z))
    p[:, 0] = np.where(z[:, 0] > 0.0, stats.norm.sf(z[:, 0]), 1.0)
    ordered = np.sort(p[np.isfinite(z)])
    largest = max(k for k, value in enumerate(ordered, 1)
                  if value <= k * source_tests.FALSE_ALARM / ordered.size)  # fmt: skip
    expected = [any(value <= ordered[largest - 1] for value in row) for row in p]
    assert source_tests._discoveries(z).tolist() == expected
    assert expected[0] and expected[7] and not expected[8]
    assert not source_tests._discoveries(rng.standard_normal((40, 7))).any()


def test_the_largest_of_many_is_judged_as_such() -> None:
    assert largest_deviate(-2.5, 1) == pytest.approx(stats.norm.isf(2 * stats.norm.sf(2.5)))
    p = 1.0 - (1.0 - 2.0 * stats.norm.sf(4.0)) ** 300
    assert largest_deviate(4.0, 300) == pytest.approx(stats.norm.isf(p))
    assert largest_deviate(60.0, 300) == 60.0


# --- hidden misfits -------------------------------------------------------------------------------


def flagged(name: str, seeds: range) -> tuple[int, int, int]:
    """In how many frames the misfit is found, named first, and seen by the sums."""
    plant, cause = HIDDEN[name]
    found = named = seen = 0
    for seed in seeds:
        verdict, _, passed = judged(plant(seed))
        found += not verdict.fits_data
        named += bool(verdict.causes) and verdict.causes[0].name == cause
        seen += not passed
    return found, named, seen


def test_limits_share_the_level_out() -> None:
    """All of it, and of the terms of the highest degree so little that the others lose nothing."""
    posterior = missing_terms(0)
    tests = score_tests(posterior, find_map(posterior).params)
    chance = np.where(tests.tested, 2.0 * stats.norm.sf(tests.limits), 0.0)
    assert chance.sum() == pytest.approx(FALSE_ALARM, rel=1e-9)
    fourth = np.array([degree_of(name) == 4 and name[1] == "_" for name in tests.names])
    assert fourth.sum() == 10 and np.all(tests.limits[fourth] > 4.2)
    alone = stats.norm.isf(0.5 * FALSE_ALARM / np.sum(tests.tested & ~fourth))
    assert tests.limits[~fourth] == pytest.approx(alone, abs=0.01)


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_misfit_is_found_and_named(name: str) -> None:
    assert flagged(name, range(101, 103))[:2] == (2, 2)


@pytest.mark.statistics
@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_misfit_is_found_in_all_frames(name: str, record_property: Any) -> None:
    """The negative control is the sums alone. 50 of 50 is a rate above 0.94 with 95 %."""
    found, named, seen = flagged(name, range(FRAMES))
    record_property("found, named first, seen by the sums, of 50", (found, named, seen))
    assert found == FRAMES and named >= 0.8 * FRAMES and seen <= 0.5 * FRAMES


def test_the_verdict_names_the_number_and_the_remedy() -> None:
    chain = laplace(wide_psf(5), seed=1, draws=200, progress=False)
    found = diagnose(chain)
    assert not found.fits_data and not found.trustworthy
    sentence = found.sentences[0]
    assert sentence.startswith("The model does not fit the counts: psf_sigma is 2")
    assert "standard deviations from zero score" in sentence
    assert "nuisances.psf_sigma = true" in sentence and found.causes[0].name == "PSF"
    row = found.checks[found.checks["name"] == "score of psf_sigma"][0]
    assert row["value"] == pytest.approx(0.03 * SIGMA, abs=4.0 * row["sd"])
    assert abs(row["z"]) > 15.0 and "failed" in found.sources.colnames


def test_a_number_is_named_where_many_sources_are_slightly_off() -> None:
    """Their squares' sum, 6,900, hides none that fails; a change in the fifth digit is shown."""
    posterior = simulated(stars(), 3)
    z = np.where(np.arange(7) == 3, 0.0, np.full((49, 7), 5.0))
    tests = source_tests.SourceTests(z, np.zeros(49, bool), ())
    scores = ScoreTests(
        ("psf_sigma", "background_u"), np.array([SIGMA, 0.0]), np.array([2e5, 10.0]),
        np.diag([1e9, 4.0]), np.ones(2, bool),
    )  # fmt: skip
    causes = hidden_causes(posterior, np.zeros(posterior.n_parameters), scores, tests)
    assert [cause.name for cause in causes] == ["PSF", "background"]
    assert [cause.share for cause in causes] == pytest.approx([40.0 / 65.0, 25.0 / 65.0])
    sentence = "psf_sigma is 6 standard deviations from zero score: the counts ask for 2.0002 in"
    assert causes[0].sentence.startswith(sentence)


def test_wrong_sources_are_listed() -> None:
    verdict, residuals, passed = judged(displaced_star(7))
    assert passed and residuals.tests.failed[48] and residuals.tests.failed.sum() <= 3
    assert "rows of the catalogue, from 0: 48 at x, y = 51.0, 51.0" in verdict.sentence


@pytest.mark.parametrize(("are_bright", "wider"), [(True, 1.01), (False, 1.03)])
def test_the_brightest_sources_tell_of_the_psf(are_bright: bool, wider: float) -> None:
    """Six images are wider: of the brightest, or, as the negative control, of any."""
    nuisances = Nuisances("free", psf_sigma=True)
    for seed in (8, 9):
        rng = np.random.default_rng(seed)
        flux = rng.permutation(np.geomspace(3e3, 3e5, 49))
        six = (flux if are_bright else rng.random(49)).argsort()[-6:]
        narrow = replace(stars(), sources=replace(stars().sources, flux=flux))
        s = narrow.sources
        some = SourceCatalog(s.x[six], s.y[six], flux[six])
        expected = 5.0 + narrow.expected_counts(np.zeros(12))
        for sign, width in ((-1.0, 1.0), (1.0, wider)):
            model = replace(narrow, sources=some, psf=GaussianPSF(width * SIGMA))
            expected += sign * model.expected_counts(np.zeros(12))
        counts = rng.poisson(np.maximum(expected, 0.0))
        verdict, _, _ = judged(Posterior(narrow, counts, nuisances=nuisances))
        assert verdict.causes[0].name == ("PSF" if are_bright else "wrong sources")
        assert ("they are bright" in verdict.sentence) == are_bright


# --- calibration ----------------------------------------------------------------------------------

TRUE = {
    "fixed": (Nuisances(), PoissonNoise(), 1e4, 5.0),
    "scaled": (
        Nuisances("scale", offset=True, psf_sigma=True, background_order=1), PoissonNoise(),
        1e4, 5.0,
    ),
    "free": (Nuisances("free", offset=True), PoissonNoise(), 1e4, 5.0),
    "scattered": (Nuisances("free", position_scatter=True), PoissonNoise(), 1e4, 5.0),
    "read noise": (Nuisances(), PoissonNoise(3.0), 3e3, 2.0),
    "few counts": (Nuisances(), PoissonNoise(), 1e2, 0.05),
    "few counts, free": (Nuisances("free"), PoissonNoise(), 3e2, 0.05),
    "gaussian": (Nuisances(), GaussianNoise(9.0), 1e3, 2.0),
    "background": (Nuisances(), BackgroundNoise(), 1e4, 5.0),
    "background of few counts": (Nuisances(), BackgroundNoise(), 1e4, 0.05),
}  # fmt: skip


def true(case: str, seed: int, side: int = 7) -> tuple[Posterior, Floats]:
    """A frame of the model that is fitted, everything free drawn from its prior, and the truth."""
    nuisances, noise, photons, level = TRUE[case]
    size, sources = 13 * side + 12, SourceCatalog.grid(side, 13.0, photons)
    model = ForwardModel(Detector((size, size)), sources, GaussianPSF(SIGMA), POLYNOMIAL(2))
    frame, rng = np.full((size, size), level), np.random.default_rng([seed, 19, *case.encode()])
    empty = Posterior(model, frame, nuisances=nuisances, noise=noise)
    known = {p.name: p.start for p in empty.parameters} | {"background": level}
    if nuisances.position_scatter:
        known["position_scatter"] = 0.1
    params = np.array(list(known.values()))
    counts, mask = empty.simulate(params, rng), rng.random(frame.shape) < 0.9
    return Posterior(model, counts, nuisances=nuisances, noise=noise, mask=mask), params


def deviates(case: str, frames: int) -> tuple[Floats, Floats, int]:
    """z of the scores, z of the sources, and false alarms, of frames that are fitted."""
    scores, sources, alarms = [], [], 0
    for seed in range(frames):
        verdict, residuals, _ = judged(*true(case, seed))
        scores.append(residuals.scores.z)
        sources.append(residuals.tests.z)
        alarms += not verdict.fits_data
    some = np.concatenate(sources)
    return np.array(scores), some[:, np.isfinite(some).any(axis=0)], alarms


def standard_normal(z: Floats) -> bool:
    """Whether each column's mean and sd are 0 and 1, within 4 Monte Carlo errors."""
    z = z[:, np.isfinite(z).all(axis=0)]
    n = len(z)
    mean, sd = z.mean(axis=0), z.std(axis=0)
    return bool(
        np.all(np.abs(mean) < LIMIT * n**-0.5)
        and np.all(np.abs(sd - 1.0) < LIMIT * (2.0 * n) ** -0.5)
    )


@pytest.mark.parametrize("case", ["fixed", "free"])
def test_deviates_of_true_models_are_standard_normal(case: str) -> None:
    scores, sources, alarms = deviates(case, 8)
    assert standard_normal(scores) and standard_normal(sources) and not alarms


@pytest.mark.statistics
@pytest.mark.parametrize("case", TRUE)
def test_true_models_are_hardly_ever_flagged(case: str, record_property: Any) -> None:
    """Of 100 frames at most 4: at a rate of 1 % there are more in 0.4 % of such runs.

    Scores are N(0, 1) within 4 errors; sources' scores are at most 10 % off 1, which the linear
    treatment of what the fit absorbs allows.
    """
    scores, sources, alarms = deviates(case, 100)
    record_property("false alarms of 100", alarms)
    assert alarms <= 4 and standard_normal(scores)
    assert np.all(np.abs(np.nanstd(sources, axis=0) - 1.0) < 0.1)


def test_the_information_alone_is_the_wrong_variance() -> None:
    """The negative control: I of psf_sigma is larger than what the paper's terms leave of it.

    The variance ratio of 24 frames is known to a share (2 / 24)^1/2 = 0.29.
    """
    z, wrong = [], []
    for seed in range(24):
        posterior = simulated(replace(stars(), sources=SourceCatalog.grid(3, 17.0, 1e4),
                                      detector=Detector((65, 65))), seed)  # fmt: skip
        params = find_map(posterior).params
        found = score_tests(posterior, params)
        k = found.names.index("psf_sigma")
        free = replace(posterior, nuisances=Nuisances(psf_sigma=True), prior={})
        information = free.fisher(np.append(params, SIGMA))[-1, -1]
        z.append(found.z[k])
        wrong.append(found.score[k] / np.sqrt(information))
    assert abs(np.std(z) - 1.0) < LIMIT * (2 * 24) ** -0.5
    assert np.std(wrong) < 0.7 * np.std(z) and np.std(wrong) < 1.0 - 2.0 * (2 * 24) ** -0.5


def test_scores_are_normal_over_a_prior_that_decides() -> None:
    """Truths drawn from the prior; without the prior in it the variance is too small.

    The mean of 60 squares is known to (2 / 60)^1/2 = 0.18.
    """
    lens = PolynomialDistortion([(1, 0, 0, 0)], [])
    sources = SourceCatalog([4.0, 10.0, 17.0], [-12.0, 0.0, 12.0], [300.0] * 3)
    model = ForwardModel(Detector((49, 49)), sources, GaussianPSF(SIGMA), lens)
    noise, width, squares, without = GaussianNoise(9.0), 0.01, [], []
    for seed in range(60):
        rng = np.random.default_rng([seed, 20])
        counts = noise.draw(model.expected_counts(rng.normal(0.0, width, 1)), 2.0, rng)
        posterior = Posterior(model, counts, prior={"f_x": stats.norm(0.0, width)}, noise=noise)
        params = find_map(posterior).params
        flat = replace(posterior, prior={"f_x": stats.norm(0.0, 1e3 * width)})
        found, wrong = score_tests(posterior, params), score_tests(flat, params)
        k = found.names.index("f_x2")
        squares.append(found.z[k] ** 2)
        without.append(found.score[k] ** 2 / wrong.covariance[k, k])
    assert np.mean(squares) == pytest.approx(1.0, abs=LIMIT * 0.18)
    assert np.mean(without) > 2.0 * np.mean(squares)


# --- what cannot be tested ------------------------------------------------------------------------


def test_noise_that_admits_no_slopes_is_not_tested_for_them() -> None:
    posterior, _ = true("background", 1, side=3)
    names = score_tests(posterior, find_map(posterior).params).names
    assert "psf_sigma" in names and not any(name.startswith("background") for name in names)


def test_one_source_and_one_parameter() -> None:
    model = ForwardModel(
        Detector((41, 41)), SourceCatalog([6.3], [4.1], [1e4]), GaussianPSF(SIGMA),
        PolynomialDistortion([(1, 0, 0, 0)], []),
    )  # fmt: skip
    verdict, residuals, _ = judged(simulated(model, 1))
    tested = dict(zip(residuals.scores.names, residuals.scores.tested, strict=True))
    assert (
        verdict.fits_data and tested["offset_y"] and not tested["offset_x"] and not tested["f_x2"]
    )
    assert np.isnan(residuals.tests.z[0, 2]) and np.isfinite(residuals.tests.z[0, [0, 1, 4]]).all()


def test_sources_without_pixels_and_parameters_at_a_bound() -> None:
    model = stars()
    posterior = simulated(model, 3)
    mask = np.ones((129, 129), bool)
    mask[:40] = False
    low = {"background": stats.uniform(5.3, 4.0)}
    posterior = Posterior(model, posterior.counts, mask=mask, prior=low)
    best = find_map(posterior)
    assert best.params[12] == 5.3
    residuals = judge_residuals(posterior, best.params, best.covariance)
    hidden = model.sources.y < -40.0
    assert np.isnan(residuals.tests.z[hidden]).all() and not residuals.tests.failed[hidden].any()
    assert np.isfinite(residuals.scores.z[residuals.scores.tested]).all()
