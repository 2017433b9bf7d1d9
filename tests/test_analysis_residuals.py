"""Checks of the residuals: against dense algebra, calibrated on simulated frames, with controls."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from test_recipes_noise import VarianceNoise

from bayesfred.analysis.absorbed import absorbed
from bayesfred.analysis.checks import check_table, deviate, deviate_of_ratio
from bayesfred.analysis.pixel_phase import _fit_harmonics, harmonics
from bayesfred.analysis.residuals import (
    Residuals,
    judge_residuals,
    predictive_checks,
    randomised_pit,
)
from bayesfred.analysis.sources import fit_sources
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import BackgroundNoise, GaussianNoise, Noise, PoissonNoise
from bayesfred.model.noise.poisson import blurred_cdf
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.reporting.goodness import described_residuals, residual_panels

Floats = NDArray[np.float64]

RESIDUALS = 7  # checks, after those of test_analysis_score.py
LIMIT = 4.0  # Monte Carlo errors: exceeded by chance in 1 of 16,000
SHAPE = (60, 75)
FIELD = PolynomialDistortion([(1, 0, 1, 0), (1, 0, 2, 0)], [(0, 1, 0, 1)])


def frame(
    seed: int, nuisances: Nuisances = Nuisances(), noise: Noise = PoissonNoise(), level: float = 9.0
) -> tuple[Posterior, Floats]:
    """A simulated frame of 16 sources, and the true parameters."""
    rng = np.random.default_rng([seed, 31])
    grid = SourceCatalog.grid(4, 14.0, 3e3)
    x, y = np.array([grid.x, grid.y]) + rng.uniform(-3.0, 3.0, (2, 16))
    model = ForwardModel(Detector(SHAPE), SourceCatalog(x, y, grid.flux), GaussianPSF(1.6), FIELD)
    empty = Posterior(model, np.full(SHAPE, level), noise=noise, nuisances=nuisances)
    truth = dict(zip(empty.parameter_names, empty.start(), strict=True)) | {"background": level}
    if nuisances.position_scatter:
        truth["position_scatter"] = 0.1
    params = np.array(list(truth.values()))
    counts = empty.simulate(params, rng)
    return Posterior(model, counts, noise=noise, nuisances=nuisances), params


def judged(posterior: Posterior) -> Residuals:
    best = find_map(posterior)
    return judge_residuals(posterior, best.params, best.covariance)


# --- distribution functions -----------------------------------------------------------------------


@pytest.mark.parametrize("mean", [0.02, 3.0, 45.0, 60.0, 800.0])
@pytest.mark.parametrize("read_noise", [0.1, 0.6, 3.0, 9.0])
def test_blurred_poisson_is_the_sum_over_all_counts(mean: float, read_noise: float) -> None:
    x = mean + np.sqrt(mean + read_noise**2) * np.linspace(-4.0, 5.0, 91)
    n = np.arange(int(mean + 14.0 * np.sqrt(mean)) + 40)
    exact = stats.poisson.pmf(n, mean) @ stats.norm.cdf((x - n[:, None]) / read_noise)
    assert blurred_cdf(x, np.full(x.size, mean), read_noise) == pytest.approx(exact, abs=2e-4)


NOISES = {
    "poisson": (PoissonNoise(), 4.0),
    "few": (PoissonNoise(), 0.05),
    "read noise": (PoissonNoise(2.0), 4.0),
    "gaussian": (GaussianNoise(16.0), 4.0),
    "background": (BackgroundNoise(), 4.0),
}


def uniformity(noise: Noise, assumed: Noise, level: float, rounded: float = 0.0) -> float:
    """Kolmogorov-Smirnov p-value of the PIT of a frame at the true parameters."""
    posterior, params = frame(1, noise=noise, level=level)
    counts = posterior.counts
    if rounded:
        counts = rounded * np.rint(counts / rounded)
    posterior = Posterior(posterior.model, counts, noise=assumed)
    pit = randomised_pit(posterior, params, fit_sources(posterior, params), seed=2)
    assert pit is not None
    return float(stats.kstest(pit, "uniform").pvalue)


@pytest.mark.parametrize("case", NOISES)
def test_the_pit_of_a_true_model_is_uniform(case: str) -> None:
    noise, level = NOISES[case]
    assert uniformity(noise, noise, level) > 1e-4


@pytest.mark.parametrize("case", ["read noise", "gaussian"])
def test_the_pit_of_rounded_counts_is_uniform(case: str) -> None:
    noise, level = NOISES[case]
    assert uniformity(noise, noise, level, rounded=1.0) > 1e-4


@pytest.mark.parametrize(
    ("true", "assumed"),
    [
        (PoissonNoise(2.0), PoissonNoise(1.0)),
        (PoissonNoise(2.0), GaussianNoise(8.0)),  # the same variance in the background
        (GaussianNoise(16.0), GaussianNoise(20.0)),
    ],
)
def test_the_pit_of_a_wrong_distribution_is_not(true: Noise, assumed: Noise) -> None:
    """The negative control."""
    assert uniformity(true, assumed, 4.0) < 1e-4


@pytest.mark.slow
def test_noise_without_a_distribution_function_is_not_tested() -> None:
    noise = VarianceNoise(np.full(SHAPE, 9.0))
    posterior, _ = frame(2, noise=noise)
    checks = {check.name: check for check in judged(posterior).checks}
    assert np.isnan(checks["PIT"].z) and checks["PIT"].meaning.startswith("not tested")
    assert np.isfinite(checks["correlation along u, lag 1"].z)


# --- what the fit absorbs -------------------------------------------------------------------------


def test_leverages_are_those_of_the_dense_projection() -> None:
    """With J the Jacobian and C = (J^T w J)^-1 the leverages are the diagonal of w J C J^T."""
    nuisances = Nuisances("scale", offset=True, psf_sigma=True)
    posterior, params = frame(3, nuisances)
    jacobian = []
    for k in range(params.size):
        step = np.zeros(params.size)
        step[k] = 1e-4 / np.sqrt(posterior.fisher(params)[k, k])
        change = posterior.expected_counts(params + step) - posterior.expected_counts(params - step)
        jacobian.append(change.ravel() / (2.0 * step[k]))
    j = np.array(jacobian) / np.sqrt(posterior.expected_counts(params)).ravel()
    covariance = np.linalg.inv(j @ j.T)
    hat = (j.T @ covariance @ j).reshape(*SHAPE, *SHAPE)
    dense = np.einsum("ijij->ij", hat)
    found = absorbed(posterior, params, covariance, fit_sources(posterior, params))
    # beyond the sources' own pixels, and the background's share everywhere, it is left out
    assert dense.sum() == pytest.approx(params.size, rel=1e-6)
    assert found.leverage.sum() == pytest.approx(params.size - 1, rel=0.1)
    near = found.leverage.reshape(SHAPE) > 1e-3
    assert np.corrcoef(found.leverage.reshape(SHAPE)[near], dense[near])[0, 1] > 0.95
    lost = sum(hat[r, c, r, c + 1] for r in range(SHAPE[0]) for c in range(SHAPE[1] - 1))
    checks = judge_residuals(posterior, params, covariance).checks
    expected = next(c for c in checks if c.name == "correlation along u, lag 1").expected
    assert -expected * SHAPE[0] * (SHAPE[1] - 1) == pytest.approx(lost, rel=0.1)


def test_whiteness_is_the_mean_product_of_neighbours() -> None:
    posterior, params = frame(4)
    mask = np.random.default_rng(5).random(SHAPE) < 0.8
    posterior = Posterior(posterior.model, posterior.counts, mask=mask)
    mu = posterior.expected_counts(params)
    r = (posterior.counts - mu) / np.sqrt(mu)
    checks = {
        c.name: c for c in judge_residuals(posterior, params, np.zeros((params.size,) * 2)).checks
    }
    for axis, (up, right) in {"u": (0, 1), "v": (1, 0)}.items():
        for lag in (1, 2):
            products = [
                r[i, j] * r[i + lag * up, j + lag * right]
                for i in range(SHAPE[0] - lag * up)
                for j in range(SHAPE[1] - lag * right)
                if mask[i, j] and mask[i + lag * up, j + lag * right]
            ]
            check = checks[f"correlation along {axis}, lag {lag}"]
            assert check.value == pytest.approx(np.mean(products), abs=1e-12)
            assert check.sd == pytest.approx(len(products) ** -0.5)


def test_harmonics_are_generalised_least_squares() -> None:
    """What a fit of the model took is projected out: the chi-square has its four degrees."""
    rng = np.random.default_rng(6)
    n, values = 40, []
    phase, sd = rng.uniform(-0.5, 0.5, n), rng.uniform(0.5, 2.0, n)
    moves = rng.standard_normal((n, 6))
    covariance = np.linalg.inv((moves / sd[:, None] ** 2).T @ moves)
    for _ in range(400):
        y = sd * rng.standard_normal(n)
        y = y - moves @ covariance @ (moves / sd[:, None] ** 2).T @ y  # the model is fitted
        values.append(_fit_harmonics(phase, y, sd**2, (moves, covariance)).chi2)
    # its variance is 8, so the mean of 400 is known to 0.14
    assert np.mean(values) == pytest.approx(4.0, abs=LIMIT * np.sqrt(8.0 / 400.0))
    ignored = [_fit_harmonics(phase, y, sd**2, (moves, 0.0 * covariance)).chi2 for _ in range(1)]
    assert ignored[0] < values[-1]  # negative control: the errors would be too large


def test_a_planted_phase_error_is_measured() -> None:
    rng = np.random.default_rng(7)
    phase, sd = rng.uniform(-0.5, 0.5, 60), np.full(60, 0.01)
    wave = harmonics(phase) @ np.array([0.0, 0.02, 0.0, 0.0, 0.01])
    none = np.zeros((60, 1)), np.zeros((1, 1))
    fit = _fit_harmonics(phase, wave + sd * rng.standard_normal(60), sd**2, none)
    error = np.sqrt(np.diag(fit.covariance))
    assert np.all(np.abs(fit.coefficients[1:] - [0.02, 0.0, 0.0, 0.01]) < LIMIT * error)
    assert deviate(fit.chi2, fit.dof) > 5.0
    still = _fit_harmonics(phase, sd * rng.standard_normal(60), sd**2, none)
    assert deviate(still.chi2, still.dof) < LIMIT
    alike = _fit_harmonics(0.0 * phase, wave, sd**2, none)
    assert alike.dof == 0  # phases that do not differ tell nothing


@pytest.mark.parametrize("p", [0.9, 0.5, 0.1, 1e-3, 1e-5])
def test_deviates_are_exceeded_as_rarely(p: float) -> None:
    z = stats.norm.isf(p)
    assert deviate(stats.chi2.isf(p, 4), 4) == pytest.approx(z, abs=0.12)
    assert deviate(stats.chi2.isf(p, 19), 19) == pytest.approx(z, abs=0.05)
    assert deviate_of_ratio(stats.f.isf(p, 4, 30), 4, 30) == pytest.approx(z, abs=0.1)


# --- calibration on fitted frames -----------------------------------------------------------------

FITS = {
    "fixed": Nuisances(),
    "free": Nuisances("free", offset=True),
    "scattered": Nuisances("free", position_scatter=True),
}


def deviates(case: str, frames: int, **changes: Any) -> Floats:
    """z of the residuals' checks, shape (frames, checks), of frames that are fitted."""
    out = []
    for seed in range(frames):
        posterior, _ = frame(seed, FITS[case])
        if changes:
            model = replace(posterior.model, **changes)
            posterior = Posterior(model, posterior.counts, nuisances=posterior.nuisances)
        out.append([check.z for check in judged(posterior).checks[-RESIDUALS:]])
    return np.array(out)


def calibrated(z: Floats) -> bool:
    """Whether each check's z has mean 0 and sd 1, within 4 Monte Carlo errors.

    Of n frames the mean is known to 1/sqrt(n), the standard deviation to 1/sqrt(2 n).
    """
    n = len(z)
    mean, sd = z.mean(axis=0), z.std(axis=0)
    near = (np.abs(mean) < LIMIT / np.sqrt(n)) & (np.abs(sd - 1.0) < LIMIT / np.sqrt(2 * n))
    return bool(np.all(near))


@pytest.mark.parametrize("case", ["fixed", "free"])
def test_checks_of_a_true_model_are_standard_normal(case: str) -> None:
    assert calibrated(deviates(case, 16))


def test_checks_of_a_wrong_psf_are_not() -> None:
    """The negative control."""
    z = deviates("fixed", 4, psf=GaussianPSF(1.45))
    assert not calibrated(z) and z[:, 1:3].min() > 4.0


@pytest.mark.statistics
@pytest.mark.parametrize("case", FITS)
def test_checks_of_200_frames_are_standard_normal(case: str) -> None:
    assert calibrated(deviates(case, 200))


def test_the_table_has_a_row_for_each_check() -> None:
    posterior, params = frame(5)
    residuals = judge_residuals(posterior, params, np.zeros((params.size,) * 2))
    table = check_table(residuals.checks[-RESIDUALS:])
    assert table.colnames == ["name", "value", "expected", "sd", "z", "meaning"]
    assert len(table) == RESIDUALS and table["name"][0] == "PIT"
    assert check_table([]).colnames == table.colnames


# --- posterior predictive draws -------------------------------------------------------------------


def test_predicted_frames_are_like_the_observed_one_or_not() -> None:
    posterior, params = frame(6)
    draws = np.random.default_rng(8).multivariate_normal(
        params, np.linalg.inv(posterior.fisher(params)), 30
    )
    assert all(abs(check.z) < 2.3 for check in predictive_checks(posterior, draws))
    wrong = replace(posterior.model, psf=GaussianPSF(1.3))
    checks = predictive_checks(Posterior(wrong, posterior.counts), draws)
    # the most that 30 draws can tell
    assert [check.z for check in checks] == pytest.approx([stats.norm.isf(0.5 / 31)] * 4)


@pytest.mark.parametrize("mean", [0.0, 0.01, 5.0, 300.0, 1e5])
def test_bounds_of_the_pit_are_those_of_poissons_distribution(mean: float) -> None:
    """Of whole counts, of counts between them and of counts in steps; also in the tails."""
    n = np.concatenate([np.arange(9.0), np.rint(mean * np.linspace(0.5, 2.0, 50))])
    mu = np.full(n.shape, mean)
    for counts, grain in ((n, 1.0), (n + 0.2, 0.5), (3.0 * n, 3.0)):
        found = PoissonNoise().cumulative(counts, mu, mean, grain)
        half = 0.5 * max(grain, 1.0)
        for bound, at in zip(found, (counts - half, counts + half), strict=True):
            np.testing.assert_allclose(bound, stats.poisson.cdf(at, mu), atol=2e-12)
        assert np.all(found[0] >= 0.0) and np.all(found[0] <= found[1])


# --- frames that tell little ----------------------------------------------------------------------

SPARSE = {
    "one source": (Detector((40, 40)), [0.0], None),
    "a source outside the frame": (Detector((40, 40)), [0.0, 500.0], None),
    "one pixel": (Detector((1, 1), pixel="box"), [0.0], None),
    "a row of pixels": (Detector((1, 60), pixel="box"), [0.0], None),
    "no counts": (Detector((40, 40)), [0.0], 0.0),
}


@pytest.mark.parametrize("case", SPARSE)
def test_frames_that_tell_little_are_judged_and_shown(case: str) -> None:
    detector, x, counts = SPARSE[case]
    sources = SourceCatalog(x, np.zeros(len(x)), np.full(len(x), 1e3))
    model = ForwardModel(detector, sources, GaussianPSF(2.0), FIELD)
    params = np.array([0.0, 0.0, 0.0, 3.0])
    posterior = Posterior(model, np.full(detector.shape, 3.0 if counts is None else counts))
    residuals = judge_residuals(posterior, params, np.zeros((4, 4)))
    assert len(residuals.sources) == len(x)
    phases = [check for check in residuals.checks if check.name.startswith("pixel phase")]
    assert all(check.meaning.startswith("not tested") for check in phases)
    (sheet,) = residual_panels(residuals, detector.shape).axes
    texts = {text.get_text() for text in sheet.texts}
    assert {"Distribution", "no source whose place is known", "chi-square: excess / sd"} <= texts
    assert any(text.startswith("Sources") for text in texts)
    assert described_residuals(residuals)
