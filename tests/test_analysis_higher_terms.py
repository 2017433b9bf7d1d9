"""Terms of degree 5 that a polynomial of degree 3 lacks are not called positions that scatter.

The lens is symmetric about its axis, so that it has no terms of degree 4. Stars are narrower than
two pixels, their fluxes are free and their images lie at all pixel phases.
"""

from dataclasses import replace

import numpy as np
import pytest

import bayesfred as bf
from bayesfred.analysis.causes.cause import Cause
from bayesfred.analysis.residuals import judge_residuals
from bayesfred.analysis.score_tests import ScoreTests
from bayesfred.analysis.verdict import FitVerdict, judge_fit
from bayesfred.imaging.monomials import degree_of
from bayesfred.optimize.fit_statistics import consistent, fit_statistics

FRAMES = 30
SIZE, HALF = 401, 188.0
POLYNOMIAL = bf.PolynomialDistortion.polynomial
CORNER = np.hypot(HALF, HALF)
RADIAL = {
    3: {"f_x3": 1.0, "f_xy2": 1.0, "g_x2y": 1.0, "g_y3": 1.0},
    5: {"f_x5": 1.0, "f_x3y2": 2.0, "f_xy4": 1.0, "g_x4y": 1.0, "g_x2y3": 2.0, "g_y5": 1.0},
}  # of r^(n - 1) (x, y)


def frame(
    seed: int, photons: float, *, quintic: float, scatter: float = 0.0, side: int = 14
) -> bf.Posterior:
    """196 stars; `quintic` and `scatter` are the corner's and every star's displacement, pixel."""
    rng = np.random.default_rng([seed, 23])
    x, y = np.meshgrid(*[np.linspace(-HALF, HALF, side)] * 2)
    x, y = (c.ravel() + rng.uniform(-8.0, 8.0, c.size) for c in (x, y))
    catalogue = bf.SourceCatalog(x, y, photons * 10.0 ** rng.uniform(-0.5, 0.5, x.size))
    dx, dy = scatter * rng.normal(size=(2, x.size))
    lens = POLYNOMIAL(5)
    theta = np.zeros(lens.n_terms)
    for degree, size in ((3, 2.0), (5, quintic)):
        for name, factor in RADIAL[degree].items():
            theta[lens.names.index(name)] = factor * size / CORNER**degree
    detector = bf.Detector((SIZE, SIZE), pixel="box")
    sources = replace(catalogue, x=x + dx, y=y + dy)
    true = bf.ForwardModel(detector, sources, bf.GaussianPSF(0.85), lens)
    counts = rng.poisson(true.expected_counts(theta, 20.0))
    model = replace(true, sources=catalogue, distortion=POLYNOMIAL(3))
    return bf.Posterior(model, counts, nuisances=bf.Nuisances("free", offset=True))


def judged(posterior: bf.Posterior, *, measured: bool = False) -> tuple[FitVerdict, bool]:
    """The verdict at the maximum, and whether the sums alone would pass."""
    best = bf.find_map(posterior)
    if measured:
        posterior, best = bf.measure_psf(posterior, best)
    residuals = judge_residuals(posterior, best.params, best.covariance)
    fit = fit_statistics(posterior, best.params)
    return judge_fit(posterior, best, fit, residuals), consistent(fit)


def first(verdict: FitVerdict) -> Cause:
    assert not verdict.fits_data
    return verdict.causes[0]


@pytest.mark.parametrize(
    ("photons", "quintic", "hidden"), [(1e4, 0.3, True), (3e4, 0.1, True), (1e5, 0.5, False)]
)
def test_a_symmetric_lens_lacks_terms_of_degree_5(
    photons: float, quintic: float, hidden: bool
) -> None:
    """Where sums over all pixels hide it and where they show it."""
    verdict, passed = judged(frame(1, photons, quintic=quintic))
    assert passed == hidden
    assert first(verdict).name == "missing terms"
    assert "polynomial of degree 5 (distortion.degree)" in first(verdict).remedy


@pytest.mark.slow
@pytest.mark.parametrize("quintic", [0.1, 0.5])
def test_a_symmetric_lens_lacks_terms_of_degree_5_with_a_measured_psf(quintic: float) -> None:
    verdict, _ = judged(frame(1, 3e4, quintic=quintic), measured=True)
    assert first(verdict).name == "missing terms" and "degree 5" in first(verdict).remedy


@pytest.mark.parametrize(
    ("photons", "scatter", "hidden"), [(1e4, 0.01, True), (1e5, 0.03, False), (1e5, 0.1, False)]
)
def test_positions_that_scatter_are_no_missing_terms(
    photons: float, scatter: float, hidden: bool
) -> None:
    """The negative control: scatter that gives large scores to terms of all degrees."""
    verdict, passed = judged(frame(1, photons, quintic=0.0, scatter=scatter))
    assert passed == hidden and first(verdict).name == "positions"


def test_a_true_model_of_degree_3_fits() -> None:
    for photons in (1e4, 1e5):
        verdict, _ = judged(frame(2, photons, quintic=0.0))
        assert verdict.fits_data and verdict.causes == ()


@pytest.mark.statistics
@pytest.mark.parametrize(
    ("quintic", "scatter", "name"),
    [(0.3, 0.0, "missing terms"), (0.0, 0.02, "positions"), (0.0, 0.0, "")],
)
def test_the_right_cause_is_named_in_all_frames(quintic: float, scatter: float, name: str) -> None:
    """30 of 30 is a rate above 0.9 with 95 %; of true frames at most 1 % have a cause."""
    for seed in range(FRAMES):
        verdict, _ = judged(frame(seed, 3e4, quintic=quintic, scatter=scatter))
        assert (verdict.causes[0].name if verdict.causes else "") == name


def test_few_sources_that_scatter_are_no_smooth_pattern() -> None:
    """Patterns with nearly as many numbers as there are coordinates describe anything."""
    for seed in range(5):
        verdict, _ = judged(frame(seed, 1e5, quintic=0.0, scatter=0.1, side=6))
        assert first(verdict).name == "positions"


def test_the_joint_chi_square_is_that_of_the_numbers_told_apart() -> None:
    """Of two equal numbers one counts; those of another name and those not tested do not."""
    covariance = np.array([[4.0, 4.0, 0.0], [4.0, 4.0, 0.0], [0.0, 0.0, 9.0]])
    covariance = np.pad(covariance, (0, 2))
    covariance[3, 3] = covariance[4, 4] = 1.0
    score = np.array([6.0, 6.0, 6.0, 50.0, 50.0])
    names = ("f_x4", "f_x5", "g_y4", "g_y5", "psf_sigma")
    tested = np.array([True, True, True, False, True])
    tests = ScoreTests(names, np.zeros(5), score, covariance, tested)
    chi_square, number = tests.joint(("f_", "g_"))
    assert (chi_square, number) == (pytest.approx(9.0 + 4.0), 2)


def test_degree_of_a_term_is_that_of_its_name() -> None:
    lens = bf.PolynomialDistortion([(3, 2, 0, 0), (1, 0, 1, 0)], [(0, 1, 2, 3), (0, 12, 0, 0)])
    assert [degree_of(name) for name in lens.names] == [5, 2, 6, 12]
