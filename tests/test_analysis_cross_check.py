"""Two halves of the sources, fitted apart: exact formulas, uniform p-values, and errors that are
wrong."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from typer.testing import CliRunner

from bayesfred import commands
from bayesfred.analysis.agreement import Agreement
from bayesfred.analysis.cross_check import CrossCheck, cross_check
from bayesfred.analysis.folds import fold_sources
from bayesfred.cli import app
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io.frames import write_frame
from bayesfred.model.noise import BackgroundNoise, GaussianNoise, PoissonNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map

Floats = NDArray[np.float64]

QUADRATIC = PolynomialDistortion.polynomial(2)
LEVEL = 3.0


def make_model(
    distortion: PolynomialDistortion = QUADRATIC, side: int = 6, **options: Any
) -> ForwardModel:
    shape = options.pop("shape", (71, 71))
    flux = options.pop("flux", 4e3)
    catalogue = options.pop("sources", SourceCatalog.grid(side, 66.0 / side, flux))
    return ForwardModel(Detector(shape), catalogue, GaussianPSF(1.8), distortion, **options)


def make_theta(distortion: PolynomialDistortion, rng: np.random.Generator) -> Floats:
    """Coefficients that move images by some tenths of a pixel each."""
    scale = distortion.largest_displacement(35.0, 35.0).max(axis=0)
    return np.asarray(rng.normal(0.0, 0.3, distortion.n_terms) / scale)


def frame_of(
    seed: int, *, scatter: float = 0.0, noise: Any = None, **options: Any
) -> tuple[Posterior, Floats]:
    """The posterior of a simulated frame, and parameters to begin a search from."""
    rng = np.random.default_rng([20, seed])
    model = make_model(**options.pop("model", {}))
    theta, s = make_theta(model.polynomial, rng), model.sources
    x, y = np.array([s.x, s.y]) + scatter * rng.standard_normal((2, len(s)))
    true = replace(model, sources=SourceCatalog(x, y, s.flux))
    drawn, fitted = noise or (PoissonNoise(), PoissonNoise())
    counts = simulate(true, theta, LEVEL, seed=seed, noise=drawn)
    posterior = Posterior(model, counts, noise=fitted, **options)
    known = dict(zip(model.distortion.names, theta, strict=True))
    known |= {"background": LEVEL, "position_scatter": scatter}
    start = [known.get(p.name, p.start) for p in posterior.parameters]
    return posterior, np.array(start)


def checked(seed: int, **options: Any) -> CrossCheck:
    posterior, start = frame_of(seed, **options)
    return cross_check(posterior, estimate=find_map(posterior, start))


def p_values(n: int, **options: Any) -> Floats:
    found = (checked(seed, **options) for seed in range(n))
    return np.array([(c.displacement_p, c.coefficients_p, c.positions[0].p) for c in found])


def test_halves_of_a_regular_grid_are_a_checkerboard_that_shares_no_pixel() -> None:
    posterior, start = frame_of(1)
    folds = fold_sources(posterior, start, 2)
    rows, columns = np.divmod(np.arange(36), 6)
    assert np.array_equal(folds.sources, (rows + columns) % 2)
    one, two = (folds.only(posterior, k).mask for k in (0, 1))
    assert not np.any(one & two) and np.array_equal(one | two, posterior.mask)
    assert np.array_equal(folds.without(posterior, 0).mask, two)


def test_pixels_belong_to_the_source_whose_light_dominates() -> None:
    rng = np.random.default_rng(2)
    catalogue = SourceCatalog(*rng.uniform(-20.0, 20.0, (2, 9)), rng.uniform(1e3, 1e5, 9))
    model = make_model(sources=catalogue, shape=(51, 45), tolerance=0.0)
    theta = make_theta(QUADRATIC, rng)
    posterior = Posterior(model, simulate(model, theta, LEVEL, seed=2))
    folds = fold_sources(posterior, np.append(theta, LEVEL), 9)
    light = np.stack(
        [
            replace(
                model, sources=SourceCatalog([x], [y], [flux]), conserve_flux=False
            ).expected_counts(theta)
            for x, y, flux in zip(catalogue.x, catalogue.y, catalogue.flux, strict=True)
        ]
    )
    dominant = folds.sources[np.argmax(light, axis=0)]
    brightest, second = np.sort(light, axis=0)[:-3:-1]
    clear = (brightest > 0.01 * LEVEL) & (brightest > 1.2 * second)  # images are not quite round
    assert clear.sum() > 500
    assert np.array_equal(folds.pixels[clear], dominant[clear])


def test_folds_are_as_large_as_each_other_whatever_the_field() -> None:
    rng = np.random.default_rng(3)
    catalogue = SourceCatalog(*rng.uniform(-40.0, 40.0, (2, 60)), np.full(60, 1e3))
    posterior = Posterior(make_model(sources=catalogue), np.full((71, 71), 5.0))
    folds = fold_sources(posterior, posterior.start(), 2)
    inside = np.abs([catalogue.x, catalogue.y]).max(axis=0) < 35.4
    assert np.array_equal(folds.sources >= 0, inside)
    assert abs(np.diff(np.bincount(folds.sources[inside]))) <= 1


FLAT = {"background": stats.uniform(0.0, 1e3)} | {
    name: stats.uniform(-1.0, 2.0) for name in QUADRATIC.names
}


BRIGHT = {"flux": 4e5}  # errors so small that the likelihoods are quadratic over them


def direct(posterior: Posterior, start: Floats, wanted: int) -> float:
    """Chi-square of the difference of the halves' maxima, without a prior."""
    flat = replace(posterior, prior=FLAT, extrapolation=None)
    folds = fold_sources(flat, start, 2)
    one, two = (find_map(folds.only(flat, k), start) for k in (0, 1))
    difference = (one.params - two.params)[:wanted]
    covariance = (one.covariance + two.covariance)[:wanted, :wanted]
    return float(difference @ np.linalg.solve(covariance, difference))


def test_chi_square_is_that_of_the_maxima_of_the_likelihoods() -> None:
    posterior, start = frame_of(4, model=BRIGHT)
    found = cross_check(posterior)
    assert found.coefficients.dof == found.displacement.dof == 10
    assert found.coefficients.chi2 == pytest.approx(direct(posterior, start, 10), rel=0.01)
    assert found.coefficients_p == pytest.approx(stats.chi2.sf(found.coefficients.chi2, 10))
    assert found.params.shape == (2, 11)


def test_a_prior_that_pulls_does_not_change_the_difference() -> None:
    posterior, _ = frame_of(4, model=BRIGHT)
    before = cross_check(posterior)
    errors = np.sqrt(np.diag(find_map(posterior).covariance))
    pulling = {
        name: stats.norm(2.0 * error, 3.0 * error)
        for name, error in zip(QUADRATIC.names, errors, strict=False)
    }
    after = cross_check(replace(posterior, prior={**posterior.prior, **pulling}))
    assert after.coefficients.dof == 10
    assert after.coefficients.chi2 == pytest.approx(before.coefficients.chi2, rel=0.05)
    pulled, free = (np.diff(c.params[:, :10], axis=0) / errors[:10] for c in (after, before))
    assert not 0.5 < np.sum(pulled**2) / np.sum(free**2) < 2.0  # of the maxima themselves


def test_directions_that_the_prior_decides_are_not_counted() -> None:
    posterior, _ = frame_of(4)
    narrow = {name: stats.norm(0.0, 1e-9) for name in QUADRATIC.names if len(name) > 3}
    found = cross_check(replace(posterior, prior={**posterior.prior, **narrow}))
    assert found.coefficients.dof == 4


def test_factor_interval_and_power_are_those_of_a_chi_square() -> None:
    n, dof, factor = 40_000, 12, 1.7
    rng = np.random.default_rng(5)
    error = np.sqrt(0.95 * 0.05 / n)
    found = [Agreement(chi2, dof, 0.5) for chi2 in factor**2 * rng.chisquare(dof, n)]
    low, high = np.array([a.factor_interval for a in found[:2000]]).T
    held = np.mean((low < factor) & (factor < high))
    assert held == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / 2000))
    a = found[0]
    z = a.detectable * rng.standard_normal((n, dof))
    caught = np.mean([Agreement.of(each).verdict == "too small" for each in z[:4000]])
    assert caught == pytest.approx(0.9, abs=4.0 * np.sqrt(0.9 * 0.1 / 4000))
    right = np.mean([Agreement.of(each).verdict == "right" for each in z[:4000] / a.detectable])
    assert right == pytest.approx(0.98, abs=4.0 * error * np.sqrt(n / 4000))


NUISANCES = {
    "fixed": Nuisances(),
    "free": Nuisances("free", offset=True, psf_sigma=True, background_order=1),
    "scale": Nuisances("scale", offset=True),
    "scatter": Nuisances("free", offset=True, position_scatter=True),
}
KINDS: dict[str, dict[str, Any]] = {
    "fixed": {},
    "free": {"nuisances": NUISANCES["free"]},
    "scale": {"nuisances": NUISANCES["scale"]},
    "scatter": {"nuisances": NUISANCES["scatter"], "scatter": 0.1},
    "background noise": {"noise": (BackgroundNoise(), BackgroundNoise())},
    "gaussian": {"noise": (GaussianNoise(25.0), GaussianNoise(25.0))},
    "read noise": {"noise": (PoissonNoise(3.0), PoissonNoise(3.0))},
}


@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] if k == "scatter" else []) for k in KINDS]
)
def test_right_errors_are_found_right(kind: str) -> None:
    found = checked(6, **KINDS[kind])
    assert found.verdict == "right" and found.holds, found.message
    assert "the halves agree" in found.message
    assert 0.4 < found.displacement_rms / found.displacement_expected < 2.0
    assert all(0.7 < a.factor < 1.4 for a in found.positions)


def test_p_values_of_a_few_frames_are_uniform() -> None:
    # the mean of n uniform numbers has the standard deviation 1 / sqrt(12 n): 0.059
    p = p_values(24)
    assert p.mean(axis=0) == pytest.approx(0.5, abs=4.0 / np.sqrt(12.0 * 24))


# With 18 degrees of freedom errors too small by 1.8 are found in 90 % of cases.
CUBIC = {"distortion": PolynomialDistortion.polynomial(3), "side": 7}
WRONG: dict[str, tuple[str, dict[str, Any]]] = {
    "errors halved": (
        "too small",
        {"noise": (GaussianNoise(25.0), GaussianNoise(6.25)), "model": CUBIC},
    ),
    "errors tripled": (
        "too large",
        {"noise": (GaussianNoise(25.0), GaussianNoise(225.0)), "model": CUBIC},
    ),
    "scatter ignored": (
        "too small",
        {"scatter": 0.1, "nuisances": NUISANCES["free"], "model": CUBIC},
    ),
}


@pytest.mark.parametrize("what", WRONG)
def test_wrong_errors_are_found(what: str) -> None:
    verdict, options = WRONG[what]
    found = checked(7, **options)
    assert found.verdict == verdict and not found.holds
    if what != "scatter ignored":
        low, high = found.deciding.factor_interval
        assert low < {"too small": 2.0, "too large": 1.0 / 3.0}[verdict] < high
    assert f"the errors are {verdict}: multiply them by" in found.message
    assert "in 90 % of cases" in found.message


@pytest.mark.statistics
@pytest.mark.parametrize("kind", KINDS)
def test_p_values_are_uniform(kind: str) -> None:
    # the largest distance between the distribution functions of 200 uniform numbers exceeds
    # 1.95 / sqrt(200) = 0.138 once in a thousand times
    p = p_values(200, **KINDS[kind])
    distances = [stats.kstest(column, "uniform").statistic for column in p.T]
    assert max(distances[:2]) < 0.138, distances
    outside = np.mean((p[:, :2] < 0.01) | (p[:, :2] > 0.99))
    assert outside < 0.02 + 4.0 * np.sqrt(0.02 * 0.98 / 200)


@pytest.mark.statistics
@pytest.mark.parametrize("what", WRONG)
def test_p_values_of_wrong_errors_are_not_uniform(what: str) -> None:
    verdict, options = WRONG[what]
    p = p_values(50, **options)[:, 0]
    assert stats.kstest(p, "uniform").statistic > 0.5
    assert np.mean(p < 0.01 if verdict == "too small" else p > 0.99) > 0.8


def test_a_basis_and_sources_outside_the_frame_are_no_obstacle() -> None:
    rng = np.random.default_rng(8)
    s = SourceCatalog.grid(7, 12.0, 4e3)
    x, y = np.append(s.x, [80.0, -300.0]), np.append(s.y, [0.0, 300.0])
    catalogue = SourceCatalog(x, y, np.full(x.size, 4e3))
    zernike = PolynomialDistortion.zernike(2, radius=50.0)
    model = make_model(zernike, sources=catalogue)
    posterior = Posterior(model, simulate(model, make_theta(zernike, rng), LEVEL, seed=8))
    found = cross_check(posterior)
    assert found.holds and found.coefficients.dof == 10
    assert np.array_equal(found.sources[-2:], [-1, -1])


@pytest.mark.parametrize("number", [1, 2, 3])
def test_few_sources_are_refused_or_checked_for_what_they_tell(number: int) -> None:
    linear = PolynomialDistortion([(1, 0, 0, 0)], [])
    catalogue = SourceCatalog(
        [20.0, -20.0, 15.0][:number], [5.0, 8.0, -9.0][:number], [1e4] * number
    )
    model = make_model(linear, sources=catalogue)
    posterior = Posterior(model, simulate(model, [1e-3], LEVEL, seed=9))
    if number == 1:
        with pytest.raises(InputError, match="got 1 sources with an image in the frame"):
            cross_check(posterior)
    else:
        found = cross_check(posterior)
        assert found.coefficients.dof == 1


RUN = """
[frame]
path = "frame.fits"
[catalogue]
path = "stars.csv"
[psf]
sigma = 1.8
[distortion]
terms = "polynomial"
degree = 2
[nuisances]
flux = "free"
offset = true
psf_sigma = true
"""


@pytest.mark.parametrize(("scatter", "code"), [(0.0, 0), (0.2, 3)])
def test_the_command_prints_the_verdict_and_exits_by_it(
    tmp_path: Path, scatter: float, code: int
) -> None:
    posterior, _ = frame_of(7, scatter=scatter)
    write_frame(tmp_path / "frame.fits", posterior.counts)
    s = posterior.model.sources
    rows = (f"{x},{y},{f}" for x, y, f in zip(s.x, s.y, s.flux, strict=True))
    (tmp_path / "stars.csv").write_text("\n".join(["x,y,flux", *rows]))
    run = tmp_path / "run.toml"
    run.write_text(RUN)
    result = CliRunner().invoke(app, ["crosscheck", str(run), "--json"])
    assert result.exit_code == code, result.output
    found = json.loads(result.output)
    assert found["verdict"] == ("right" if code == 0 else "too small")
    assert {"displacement_p", "coefficients_p", "message"} <= set(found)
    result = CliRunner().invoke(app, ["crosscheck", str(run)])
    assert result.exit_code == code
    assert result.output.rstrip().splitlines()[-1].startswith("the errors are")
    assert max(map(len, result.output.split("displacements of")[0].splitlines())) <= 80


STARS = Path(os.environ["BAYESFRED_DATA"], "startracker_alt60_azi45.fits")


@pytest.mark.long
@pytest.mark.skipif(not STARS.exists(), reason=f"no star tracker's frame {STARS}")
@pytest.mark.parametrize(("scatter", "verdict"), [("false", "too small"), ("true", "right")])
def test_halves_of_a_real_frame_agree_only_if_positions_scatter(
    tmp_path: Path, scatter: str, verdict: str
) -> None:
    text = Path(__file__).parents[1].joinpath("examples/startracker.toml").read_text()
    run = tmp_path / "run.toml"
    run.write_text(
        re.sub("^position_scatter = true", f"position_scatter = {scatter}", text, flags=re.M)
    )
    assert commands.crosscheck(run).verdict == verdict
