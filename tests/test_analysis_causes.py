"""Causes of a misfit: planted faults are named first, a true model has none, the sums are right."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import planted
import pytest
from scipy import stats

from bayesfred.analysis.causes import Cause, common, find_causes, light
from bayesfred.analysis.causes.cause import Finding, psf_remedy, scatter_remedy
from bayesfred.analysis.causes.context import Context
from bayesfred.analysis.causes.find import ranked
from bayesfred.analysis.causes.pixels import full_pixels
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.residuals import judge_residuals
from bayesfred.analysis.verdict import judge_fit
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF, MeasuredPSF
from bayesfred.model.noise import BackgroundNoise, GaussianNoise, PoissonNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map, reject_outliers
from bayesfred.optimize.fit_statistics import fit_statistics
from bayesfred.sampling.laplace import laplace
from bayesfred.sampling.record import RunRecord

FRAMES = 50


def judged(posterior: Posterior) -> Any:
    """The verdict on the fit at the maximum."""
    best = find_map(posterior)
    residuals = judge_residuals(posterior, best.params, best.covariance)
    return judge_fit(posterior, best, fit_statistics(posterior, best.params), residuals)


def named_first(name: str, seeds: range) -> int:
    """In how many frames the planted fault is the first cause."""
    plant, right = planted.FAULTS[name]
    hits = 0
    for seed in seeds:
        verdict = judged(plant(seed))
        assert not verdict.fits_data
        hits += bool(verdict.causes) and verdict.causes[0].name in right
    return hits


@pytest.mark.parametrize("seed", [101, pytest.param(102, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", planted.FAULTS)
def test_planted_fault_is_named_first(name: str, seed: int) -> None:
    assert named_first(name, range(seed, seed + 1)) == 1


@pytest.mark.statistics
@pytest.mark.parametrize("name", planted.FAULTS)
def test_planted_fault_is_named_first_in_nine_of_ten_frames(
    name: str, record_property: Any
) -> None:
    """Of 50 frames; a rate of 0.9 has a binomial error of 0.04."""
    hits = named_first(name, range(1, FRAMES + 1))
    record_property("named first, of 50", hits)
    assert hits >= 0.9 * FRAMES


@pytest.mark.statistics
@pytest.mark.parametrize("name", [n for n, (_, right) in planted.FAULTS.items() if "PSF" in right])
def test_a_wrong_psf_is_not_called_companions(name: str, record_property: Any) -> None:
    """Of 50 frames at most 2: a rate of 0.04 has a binomial error of 0.03."""
    plant, _ = planted.FAULTS[name]
    named = [{cause.name for cause in judged(plant(seed)).causes} for seed in range(1, FRAMES + 1)]
    false = sum("companions" in names for names in named)
    record_property("companions named, of 50", false)
    assert false <= 0.04 * FRAMES


def test_a_psf_that_varies_as_a_cubic_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where a pattern of the second degree is all that is looked for, sources are blamed.

    The widths follow a Legendre polynomial of the third degree, which has no part in lower ones.
    """
    s, sigma = SourceCatalog.grid(18, 15.0, 2e5), 1.4
    model = ForwardModel(Detector((281, 281)), s, GaussianPSF(sigma), planted.LENS)
    v, u = np.indices(model.detector.shape) - 140.0
    mean = np.full(u.shape, 20.0)
    x = s.x / s.x.max()
    wide = sigma * (1.0 + 0.08 * (2.5 * x**3 - 1.5 * x))
    for x_s, y_s, w in zip(s.x, s.y, wide, strict=True):
        r2 = (u - x_s) ** 2 + (v - y_s) ** 2
        mean += 2e5 * np.exp(-0.5 * r2 / w**2) / (2.0 * np.pi * w**2)
    counts = np.random.default_rng(1).poisson(mean).astype(float)
    posterior = Posterior(model, counts, nuisances=Nuisances(flux="free"))
    params = find_map(posterior).params
    first = find_causes(posterior, params)[0]
    assert first.name == "PSF"
    assert "differently from one part of the frame to another" in first.sentence
    monkeypatch.setattr(common, "MOST", 2)
    assert find_causes(posterior, params)[0].name != "PSF"


@pytest.mark.slow
def test_outermost_sources_show_missing_terms(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two or three hold most of the misfit of these frames, and would be called wrong sources."""
    frames = [planted.fisheye(seed) for seed in (3, 5, 7)]
    assert [judged(frame).causes[0].name for frame in frames] == 3 * ["missing terms"]
    monkeypatch.setattr(light, "_outermost", lambda *given: False)
    assert [judged(frame).causes[0].name for frame in frames] == 3 * ["wrong sources"]


def test_a_polynomial_is_no_remedy_for_dark_corners() -> None:
    """Vignetting is one of the second or fourth degree; the edge of an image circle is not."""
    true = planted.true(3, flux="free")
    v, u = np.indices(planted.SHAPE) - planted.HALF
    dark = np.random.default_rng(1).poisson(1.0, planted.SHAPE).astype(float)
    edge = replace(true, counts=np.where(np.hypot(u, v) < 95.0, true.counts, dark))
    assert "mask what is not background" in judged(edge).causes[0].remedy
    light = true.model.expected_counts(planted.THETA, 10.0 * planted.LEVEL)
    for order in (2, 4):
        dimmed = light * (1.0 - 0.2 * (np.hypot(u, v) / planted.HALF) ** order)
        vignetted = replace(true, counts=np.random.default_rng(2).poisson(dimmed).astype(float))
        remedy = f"set nuisances.background_order = {order}"
        assert judged(vignetted).causes[0].remedy == remedy


def test_what_is_typical_is_that_of_the_sources_nearby() -> None:
    """Where a PSF is wrong all hold more than elsewhere; one that does so alone is not typical."""
    posterior = planted.true(1)
    context = Context(posterior, find_map(posterior).params, np.zeros(planted.SHAPE, bool))
    far = context.light.position[:, 0] > 25.0
    assert 12 < far.sum() < 20
    each = np.where(far, 0.5, 0.1)
    alone = int(np.argmin(context.light.position[:, 0]))
    each[alone] = 3.0
    vars(context)["source_excess"] = each * context.power
    assert context.typical[alone] == pytest.approx(0.1)
    assert context.typical[np.argmax(context.light.position[:, 0])] == pytest.approx(0.5)
    assert context.typical.min() == pytest.approx(0.1)


def test_leaving_out_outliers_cures_companions() -> None:
    """The remedy that the verdict names: coefficients within their errors, which they were not."""
    posterior = planted.companions(101)
    kept, cured = reject_outliers(posterior)
    for estimate, is_cured in ((find_map(posterior), False), (cured, True)):
        off = (estimate.params - np.append(planted.THETA, planted.LEVEL))[:4]
        inverse = np.linalg.inv(estimate.covariance[:4, :4])
        assert (off @ inverse @ off < stats.chi2(4).isf(1e-4)) == is_cured
    assert kept.mask.sum() < posterior.mask.sum()


@pytest.mark.parametrize("name", ["companions", "uncatalogued sources", "wrong sources"])
def test_no_remedy_is_one_that_the_run_file_has(name: str) -> None:
    plant = next(make for make, right in planted.FAULTS.values() if right[0] == name)
    chain = laplace(plant(101), seed=1)
    for value, expected in (("false", True), ("true", False)):
        record = RunRecord(settings=f"[frame]\nreject_outliers = {value}\n")
        verdict = diagnose(replace(chain, record=record))
        assert verdict.causes[0].name == name
        assert ("reject_outliers" in verdict.message) == expected
        assert verdict.causes[0].remedy


@pytest.mark.parametrize("steepness", [0.1, 0.7])
def test_an_uneven_background_is_stated_without_its_noise(steepness: float) -> None:
    """The root mean square of a slope across the frame, which the model takes for flat."""
    true = planted.true(1)
    slope = planted.LEVEL * steepness * np.linspace(-1.0, 1.0, planted.SHAPE[1])
    more = np.random.default_rng(1).poisson(slope + planted.LEVEL * steepness, planted.SHAPE)
    cause = judged(replace(true, counts=true.counts + more)).causes[0]
    assert cause.name == "background"
    stated = float(cause.sentence.split("model's by ")[1].split()[0])
    assert stated == pytest.approx(slope.std(), rel=0.25)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 1.07, 1.4])
def test_the_verdict_says_of_a_large_model_error_that_it_is_one(factor: float) -> None:
    """A model that needs it may fit the counts, and nothing else would tell of the PSF.

    One that leaves more than a tenth of the light is said before all causes.
    """
    posterior = planted.true(1)
    wrong = posterior.with_psf(GaussianPSF(factor * posterior.model.psf.sigma))
    verdict = judged(replace(wrong, nuisances=replace(wrong.nuisances, model_error=True)))
    assert verdict.fits_data or factor > 1.0
    said, cause, _ = verdict.sentence.partition("Probable cause")
    for text in ("of the light unexplained", "psf.kind"):
        assert (text in verdict.omitted) == (factor == 1.07)
        assert (text in said) == (factor == 1.4)
    assert bool(cause) == (factor > 1.0)


def test_remedies_are_those_that_a_run_can_take() -> None:
    """Of positions that scatter with free fluxes, and of a PSF that was measured."""
    posterior = planted.true(1, flux="free")
    assert scatter_remedy(posterior) == "set nuisances.position_scatter = true"
    assert scatter_remedy(planted.true(1)).startswith('set nuisances.flux = "free" and ')
    assert psf_remedy(posterior, "another") == "another"
    coefficients = np.zeros((6, 9, 9))  # of degree 2
    coefficients[0, 3:6, 3:6] = 4.0 / 9.0
    measured = posterior.with_psf(MeasuredPSF(coefficients, 2.0, 80.0))
    assert "psf.degree = 4" in psf_remedy(measured, "another")
    most = measured.with_psf(MeasuredPSF(np.pad(coefficients, [(0, 9), (0, 0), (0, 0)]), 2.0, 80.0))
    assert "psf.nodes = 7 in place of psf.degree" in psf_remedy(most, "another")
    between = MeasuredPSF(coefficients[:5], 2.0, 80.0, nodes=2)
    assert "psf.nodes = 6" in psf_remedy(measured.with_psf(between), "another")


def test_a_true_model_has_no_cause() -> None:
    for seed in (1, 2, 3):
        for nuisances in ({}, {"flux": "free", "offset": True, "psf_sigma": True}):
            verdict = judged(planted.true(seed, **nuisances))
            assert verdict.fits_data and verdict.causes == ()
            assert verdict.sentence.startswith("The model fits the counts: deviance ")


@pytest.mark.statistics
def test_true_models_fit_in_all_frames() -> None:
    """Two sums beyond 5 standard deviations are one in a million of normal ones."""
    assert all(judged(planted.true(seed)).fits_data for seed in range(1, FRAMES + 1))


def test_the_wrong_cause_is_not_named() -> None:
    """The negative control of the tests above: a fault is not found where another is planted."""
    plant, _ = planted.FAULTS["read noise"]
    planted_names = {right[0] for _, right in planted.FAULTS.values()} - {"read noise"}
    names = {cause.name for cause in judged(plant(101)).causes}
    assert names == {"read noise"} and not names & planted_names


def test_numbers_in_the_sentences_are_those_planted() -> None:
    causes = {name: judged(planted.FAULTS[name][0](7)).causes[0] for name in
              ("gain", "read noise", "pedestal", "shift", "rotation by 25 degrees", "origin",
               "a factor of all fluxes")}  # fmt: skip

    def number(name: str, after: str, text: str = "sentence") -> float:
        words = getattr(causes[name], text).split(after)[1].split()
        return float(words[0].strip(",;:"))

    assert number("gain", "gain: ", "remedy") == pytest.approx(4.0, rel=0.05)
    assert number("read noise", "about ", "remedy") == pytest.approx(8.0, rel=0.05)
    assert number("pedestal", "more: ") == pytest.approx(60.0, rel=0.05)
    assert number("shift", "shifted by ") == pytest.approx(2.5, abs=0.5)
    assert number("rotation by 25 degrees", "rotated by ") == pytest.approx(25.0, abs=1.0)
    assert number("origin", "shifted by ") == pytest.approx(-planted.HALF, abs=5.0)
    assert number("a factor of all fluxes", "sources have ") == pytest.approx(1.6, rel=0.05)
    assert "nuisances.offset = true" in causes["shift"].remedy


def test_the_read_noise_to_set_is_all_of_it() -> None:
    """Also where some is known already; its Monte Carlo error is 1 %."""
    posterior = replace(planted.read_noise(7), noise=PoissonNoise(read_noise=6.0))
    (cause,) = judged(posterior).causes
    assert cause.name == "read noise"
    number = float(cause.remedy.split("about ")[1])
    assert number == pytest.approx(8.0, rel=0.05)
    assert number != pytest.approx(math.sqrt(8.0**2 - 6.0**2), rel=0.1)


def test_excess_of_a_displaced_source_is_what_the_derivation_says() -> None:
    """(q + q') (1 - exp(-e^2 / 4 s^2)) against images, where the background makes the noise."""
    s, e = 2.0, 1.7
    bright = {"detector": Detector((61, 61)), "psf": GaussianPSF(s), "distortion": planted.LENS}
    here = ForwardModel(sources=SourceCatalog([0.0], [0.0], [100.0]), **bright)
    there = ForwardModel(sources=SourceCatalog([e], [0.0], [100.0]), **bright)
    images = [model.expected_counts(np.zeros(4)) for model in (here, there)]
    excess = np.sum((images[0] - images[1]) ** 2)
    q = np.sum(images[0] ** 2)
    assert excess == pytest.approx(2.0 * q * -np.expm1(-(e**2) / (4.0 * s**2)), rel=1e-6)


def test_power_of_the_catalogue_is_the_integral() -> None:
    posterior = planted.true(5)
    context = Context(posterior, np.append(planted.THETA, planted.LEVEL), ~posterior.mask)
    image = planted.camera(posterior.model.sources).expected_counts(planted.THETA)
    assert context.power.sum() == pytest.approx(np.sum(image**2 / (image + 20.0)), rel=0.02)
    assert context.catalogue_power.sum() == pytest.approx(context.power.sum(), rel=0.05)
    assert context.missing_power.sum() == pytest.approx(np.sum(image**2 / 20.0), rel=0.07)


def test_equal_counts_of_faint_frames_are_no_pile() -> None:
    rng = np.random.default_rng(1)
    for level in (0.01, 1.0, 30.0):
        posterior = Posterior(planted.camera(planted.field(1)), rng.poisson(level, (161, 161)))
        params = np.append(planted.THETA, level)
        assert not full_pixels(Context(posterior, params, ~posterior.mask))[0].any()


def test_shares_are_claimed_once_and_the_simpler_hypothesis_leads() -> None:
    def finding(name: str, explained: float, family: str, weight: float = 1.0) -> Finding:
        return Finding(Cause(name, 0.0, name, name), explained, family, weight)

    simple, rich = finding("simple", 90.0, "light"), finding("rich", 95.0, "light", 0.9)
    other = finding("other", 30.0, "noise")
    causes = ranked([rich, other, simple], 100.0)
    assert [cause.name for cause in causes] == ["simple", "other"]
    assert sum(cause.share for cause in causes) == pytest.approx(1.0)
    richer = finding("rich", 120.0, "light", 0.9)
    assert ranked([simple, richer], 130.0)[0].name == "rich"
    assert ranked([], 100.0) == ()


# --- frames of all kinds --------------------------------------------------------------------------


def odd_frames() -> dict[str, Posterior]:
    s, rng = planted.field(3), np.random.default_rng(3)
    frame = planted.counts(planted.camera(s), 3)
    one = SourceCatalog([3.0], [-2.0], [5e3])
    narrow = ForwardModel(Detector((9, 41)), one, GaussianPSF(1.0), planted.LENS)
    dark = np.zeros(planted.SHAPE)
    holes = frame.copy()
    holes[rng.random(planted.SHAPE) < 0.05] = np.nan
    binned = ForwardModel(
        Detector((80, 80), binning=2, pixel="box"), s, GaussianPSF(2.0), planted.LENS
    )
    return {
        "one source on a strip": Posterior(narrow, rng.poisson(4.0, (9, 41)).astype(float) * 3.0),
        "all zero": Posterior(planted.camera(s), dark),
        "holes": Posterior(planted.camera(s), 2.0 * holes, mask=np.isfinite(holes)),
        "binned": Posterior(binned, rng.poisson(9.0, (80, 80)).astype(float)),
        "background noise": Posterior(planted.camera(s), 2.0 * frame, noise=BackgroundNoise()),
        "gaussian noise": Posterior(planted.camera(s), frame, noise=GaussianNoise(9.0)),
        "scatter": Posterior(
            planted.camera(s), 3.0 * frame,
            nuisances=Nuisances("free", position_scatter=True, background_order=2),
        ),
        "footprint": Posterior(
            planted.camera(s), 3.0 * frame, nuisances=Nuisances("free", footprint=6.0)
        ),
    }  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=pytest.mark.slow if name == "scatter" else ())  # to compile
        for name in odd_frames()
    ],
)
def test_causes_of_odd_frames_are_sentences(name: str) -> None:
    posterior = odd_frames()[name]
    params = np.append(np.zeros(4), posterior.start()[4:])
    for cause in find_causes(posterior, params):
        assert 0.0 < cause.share <= 1.0
        text = f"{cause.sentence} {cause.remedy}"
        assert text.isprintable() and "nan" not in text.split()


@pytest.mark.slow
@pytest.mark.parametrize("read_noise", [0.3, np.full(planted.SHAPE, 0.5)])
def test_read_noise_counts_as_variance(read_noise: Any) -> None:
    """Information is not its inverse: at 0.05 counts a pixel of sky they differ threefold."""
    lens, noise = planted.LENS, PoissonNoise(read_noise)
    model = ForwardModel(
        Detector(planted.SHAPE), SourceCatalog.grid(5, 25.0, 300.0),
        GaussianPSF(2.0), lens,
    )  # fmt: skip
    params = np.array([*np.zeros(lens.n_terms), 0.05])
    counts = simulate(model, params[:-1], 0.05, seed=1, noise=noise)
    posterior = Posterior(model, counts, noise=noise)
    context = Context(posterior, params, np.zeros(counts.shape, bool))
    assert abs(context.excess) < 5.0 * context.spread
    mu, variance = model.expected_counts(params[:-1], 0.05), np.asarray(read_noise) ** 2
    light = (mu - 0.05) ** 2 / (mu + variance)
    assert context.power.sum() == pytest.approx(light.sum(), rel=0.02)
    assert np.isfinite(context.catalogue_power).all()


def test_a_cause_leaves_some_counts_expected() -> None:
    """A constant that is larger than all counts of a line: their variance would be none."""
    posterior = planted.true(1)
    context = Context(posterior, np.append(planted.THETA, planted.LEVEL), ~posterior.mask)
    assert np.allclose(
        context.corrected_by(np.full(planted.SHAPE, 7.0)).residual, -7.0 + context.residual
    )
    less = context.corrected_by(np.full(planted.SHAPE, -1e6))
    assert np.allclose(less.expected, 0.1 * context.expected) and less.variance.min() > 1.0
