"""The degree of a polynomial distortion, chosen by how well it predicts sources that it has not
seen."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from threadpoolctl import threadpool_limits

from bayesfred import commands
from bayesfred.analysis import choose_terms as module
from bayesfred.analysis.choose_terms import TermChoice, choose_terms
from bayesfred.analysis.folds import fold_sources
from bayesfred.commands import pipeline
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io.frames import write_frame
from bayesfred.model.noise import GaussianNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.settings.run import read_settings

Floats = NDArray[np.float64]

LEVEL = 3.0
SHAPE = (71, 71)
LENS = {"f_x": 2e-3, "g_y": 2e-3, "f_x3": -7e-6, "f_xy2": -7e-6, "g_x2y": -7e-6, "g_y3": -7e-6}


def make_model(distortion: PolynomialDistortion, side: int = 6, flux: float = 4e3) -> ForwardModel:
    sources = SourceCatalog.grid(side, 66.0 / side, flux)
    return ForwardModel(Detector(SHAPE), sources, GaussianPSF(1.8), distortion)


def truth_of(degree: int, seed: int) -> tuple[PolynomialDistortion, Floats]:
    """Every term of a degree, each moving images at the frame's edge by some tenths of a pixel."""
    distortion = PolynomialDistortion.polynomial(degree)
    scale = distortion.largest_displacement(35.0, 35.0).max(axis=0)
    rng = np.random.default_rng([30, seed])
    signs = rng.choice([-1.0, 1.0], distortion.n_terms)
    return distortion, np.asarray(signs * rng.uniform(0.2, 0.6, distortion.n_terms) / scale)


def posterior_of(
    distortion: PolynomialDistortion, theta: Any, seed: int, *, side: int = 6, **options: Any
) -> Posterior:
    """The posterior of a simulated frame, with terms that say nothing of the truth."""
    counts = simulate(make_model(distortion, side), theta, LEVEL, seed=seed)
    return Posterior(make_model(PolynomialDistortion.mirrored(), side), counts, **options)


def lens(seed: int, **options: Any) -> Posterior:
    """A lens: linear and cubic terms, and no quadratic ones."""
    distortion = PolynomialDistortion.polynomial(3)
    theta = [LENS.get(name, 0.0) for name in distortion.names]
    return posterior_of(distortion, theta, seed, **options)


def degree_of(choice: TermChoice) -> int:
    (row,) = choice.tried[choice.tried["n_terms"] == choice.distortion.n_terms]
    assert row["cost"] == row["change"] == 0.0
    return int(row["degree"])


def test_densities_of_folds_are_those_of_a_normal_distribution() -> None:
    # Of Gaussian noise and a model linear in its parameters all pixels together are normal.
    distortion, theta = truth_of(1, 0)
    variance = 9.0
    model = replace(
        make_model(distortion, side=3, flux=5e3),
        sources=SourceCatalog.grid(3, 8.0, 5e3), detector=Detector((29, 29)),
    )  # fmt: skip
    counts = simulate(model, theta, LEVEL, seed=1, noise=GaussianNoise(variance))
    prior = {"background": stats.norm(LEVEL, 1.0)}
    posterior = Posterior(model, counts, prior=prior, noise=GaussianNoise(variance))
    top = find_map(posterior)
    folds = fold_sources(posterior, top.params, 9)
    found = module._predicted(module._Fit(1, posterior, top), folds).score
    slopes = [*model.jacobian(top.params[:4]), np.ones(model.detector.shape)]
    jacobian = np.stack([slope.ravel() for slope in slopes], axis=1)
    means, sds = np.array([(p.mean(), p.std()) for p in posterior.prior.values()]).T
    expected = posterior.expected_counts(top.params).ravel() + jacobian @ (means - top.params)
    covariance = (jacobian * sds**2) @ jacobian.T + variance * np.eye(counts.size)

    def log_density(pixels: NDArray[np.bool_]) -> float:
        normal = stats.multivariate_normal(expected[pixels], covariance[np.ix_(pixels, pixels)])
        return float(normal.logpdf(counts.ravel()[pixels]))

    every = folds.pixels.ravel()
    with threadpool_limits(1, user_api="blas"):
        whole = log_density(every >= 0)
        direct = [whole - log_density((every >= 0) & (every != k)) for k in range(9)]
    assert found == pytest.approx(np.array(direct), abs=0.05)


@pytest.mark.parametrize(("degree", "seed"), [(1, 1), (2, 2), (3, 3)])
def test_the_degree_of_the_truth_is_chosen(degree: int, seed: int) -> None:
    choice = choose_terms(posterior_of(*truth_of(degree, seed), seed))
    assert degree_of(choice) == degree
    assert choice.distortion == PolynomialDistortion.polynomial(degree)
    assert choice.posterior.model.distortion == choice.distortion
    assert choice.estimate.params.size == choice.posterior.n_parameters
    assert choice.message.startswith(f"polynomial of degree {degree} ({choice.distortion.n_terms}")


@pytest.mark.statistics
@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_degree_of_the_truth_is_chosen_in_nine_of_ten_frames(degree: int) -> None:
    # 50 frames: the share has a standard error of 0.04 at 0.9
    frames = (posterior_of(*truth_of(degree, seed), seed) for seed in range(50))
    assert np.mean([degree_of(choose_terms(frame)) == degree for frame in frames]) >= 0.9


def test_likelihood_of_the_pixels_fitted_to_would_always_choose_more() -> None:
    # The negative control: judged on the pixels that it is fitted to, a larger degree always wins.
    posterior = posterior_of(*truth_of(2, 2), 2)
    choice = choose_terms(posterior)
    seen = []
    for degree in choice.tried["degree"]:
        grown = module._of_degree(posterior, int(degree))
        fitted = find_map(grown).params
        seen.append(float(grown.likelihood.log_likelihood(fitted[None], np.ones(1, bool))[0]))
    assert np.all(np.diff(seen) > 0.0)
    assert np.argmax(choice.tried["elpd"]) == 1


def test_cubic_terms_are_found_behind_quadratic_ones_that_bring_nothing() -> None:
    choice = choose_terms(lens(4))
    assert degree_of(choice) == 3
    one, two = choice.tried[0], choice.tried[1]
    assert two["elpd"] < one["elpd"] + one["elpd_se"]
    # what the lens does beyond its linear terms, and these take some of it up
    assert 0.05 < one["change"] < 0.6
    assert one["cost"] > 2.0 * one["cost_se"] > 0.0
    leaner = min((one, two), key=lambda row: row["cost"])
    assert f"degree {leaner['degree']}, with {leaner['n_terms']} terms" in choice.message
    assert f"{leaner['cost']:.1f} +- {leaner['cost_se']:.1f}" in choice.message
    assert len(choice.lines()) == len(choice.tried)


def test_terms_of_other_degrees_are_judged_by_their_size() -> None:
    choice = choose_terms(posterior_of(*truth_of(2, 2), 2))
    leaner, chosen, *larger = choice.tried["p"]
    assert leaner < 1e-6 and np.isnan(chosen) and min(larger) > 0.01
    table = choice.tried.copy()
    table["p"][-1] = 0.002
    said = f"though terms of degree {table['degree'][-1]} (p = 0.002) are real"
    assert said in module._message(table, 1) and said not in choice.message
    assert choice.lines()[0].endswith(f"other terms are chance with p = {leaner:.2g}")


def test_no_distortion_and_one_too_small_to_matter_take_the_leanest_polynomial() -> None:
    cubic = PolynomialDistortion.polynomial(3)
    for size in (0.0, 1e-4):
        theta = size * np.array([LENS.get(name, 0.0) for name in cubic.names])
        choice = choose_terms(posterior_of(cubic, theta, 5))
        assert degree_of(choice) == 1 and "the leanest one" in choice.message


def test_everything_else_of_the_posterior_is_kept() -> None:
    nuisances = Nuisances("scale", offset=True, psf_sigma=True, background_order=1)
    mask = np.ones(SHAPE, bool)
    mask[10:14, 20:30] = False
    prior = {"background": stats.gamma(9.0, scale=LEVEL / 9.0), "offset_x": stats.norm(0.0, 0.5)}
    noise = GaussianNoise(9.0)
    given = lens(6, nuisances=nuisances, mask=mask, prior=prior, noise=noise)
    kept = choose_terms(given).posterior
    assert kept.nuisances == nuisances and kept.noise == noise
    assert np.array_equal(kept.mask, mask) and np.array_equal(kept.counts, given.counts)
    assert {name: kept.prior[name] for name in prior} == prior


def test_priors_of_terms_that_the_polynomial_has_are_kept() -> None:
    cubic = PolynomialDistortion.polynomial(3)
    counts = lens(6).counts
    prior = {"f_x2": stats.norm(0.0, 1e-7)}
    posterior = Posterior(make_model(cubic), counts, prior=prior)
    assert choose_terms(posterior).posterior.prior["f_x2"] is prior["f_x2"]


def test_few_sources_end_the_search() -> None:
    choice = choose_terms(lens(7, side=2))
    assert choice.distortion.n_terms <= 10
    assert "the frame does not determine degree" in choice.message


def test_fewer_than_three_sources_are_refused() -> None:
    linear = PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
    catalogue = SourceCatalog([20.0, -15.0], [5.0, -20.0], [1e4, 1e4])
    model = replace(make_model(linear), sources=catalogue)
    posterior = Posterior(model, simulate(model, [1e-3, 1e-3], LEVEL, seed=8))
    with pytest.raises(InputError, match="got 2 sources with an image in the frame, expected at"):
        choose_terms(posterior)


RUN = """
[frame]
path = "frame.fits"
[catalogue]
path = "stars.csv"
[psf]
sigma = 1.8
[distortion]
terms = "choose"
"""


def write_run(folder: Path) -> Path:
    posterior = lens(9)
    write_frame(folder / "frame.fits", posterior.counts)
    s = posterior.model.sources
    rows = (f"{x},{y},{f}" for x, y, f in zip(s.x, s.y, s.flux, strict=True))
    (folder / "stars.csv").write_text("\n".join(["x,y,flux", *rows]))
    run = folder / "run.toml"
    run.write_text(RUN)
    return run


def test_a_run_file_chooses_before_it_samples(tmp_path: Path) -> None:
    run, said = write_run(tmp_path), []
    posterior, estimate, notes = pipeline.read_frame(read_settings(run), run, said.append)
    assert posterior.model.distortion == PolynomialDistortion.polynomial(3)
    assert estimate is not None and estimate.params.size == posterior.n_parameters
    assert any(line.startswith("degree 1: 4 terms, predicts sources worse by") for line in said)
    assert said[-1].startswith("terms: polynomial of degree 3") and notes == said


def test_a_study_of_chosen_terms_is_refused(tmp_path: Path) -> None:
    run = write_run(tmp_path)
    with pytest.raises(InputError, match=r"distortion.terms: got 'choose', expected the terms"):
        commands.study(run, kind="noise")
