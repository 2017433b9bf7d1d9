"""Distortion, catalogue, detector and forward model against slow, independent images."""

from __future__ import annotations

import pickle
import warnings
from collections.abc import Callable

import h5py
import numpy as np
import oracles
import pytest
from numpy.typing import NDArray
from scipy.special import erf, eval_jacobi

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector, correct_sampling, sampling_matrix
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io.serialize import read, write

FloatArray = NDArray[np.float64]

SHAPE = (60, 75)
EXACT = 1e-13  # of the peak
TERMS = [
    (i, j, m, n)
    for i in range(5)
    for j in range(5 - i)
    for m in range(5 - i - j)
    for n in range(5 - i - j - m)
    if i + j >= 1
]
# The truth of the paper's Table 2 (unit 1e-6) in `mirrored`'s order: ux, vx, u2x, v2x, ux2, vx2,
# then with y.
TABLE2 = 1e-6 * np.array([0, 2, 0, -2, 1, 2, 0, 3, 0, 1, 1, -1])


def random_distortion(rng: np.random.Generator) -> PolynomialDistortion:
    """Up to seven terms of degree 1 to 4 in f and in g; one of the two may stay empty."""
    sizes = rng.integers(0, 8, 2)
    sizes[rng.integers(2)] += sizes.sum() == 0
    f_terms, g_terms = (
        tuple(TERMS[k] for k in rng.choice(len(TERMS), size, False)) for size in sizes
    )
    return PolynomialDistortion(f_terms, g_terms)


def random_theta(
    rng: np.random.Generator, distortion: PolynomialDistortion, shape: tuple[int, int], shift: float
) -> FloatArray:
    """Coefficients with which each term moves a star in the corner by about `shift` pixels."""
    half_y, half_x = shape[0] / 2, shape[1] / 2
    terms = (*distortion.f_terms, *distortion.g_terms)
    levers = np.array([half_x ** (i + m) * half_y ** (j + n) for i, j, m, n in terms])
    return np.asarray(shift * rng.standard_normal(distortion.n_terms) / levers)


def random_sources(rng: np.random.Generator, shape: tuple[int, int], n: int) -> SourceCatalog:
    """Stars over the fine frame and a little beyond it."""
    x, y = 0.55 * np.array([[shape[1]], [shape[0]]]) * rng.uniform(-1, 1, (2, n))
    return SourceCatalog(x, y, rng.uniform(1e3, 1e4, n))


def star(x: float, y: float, flux: float) -> SourceCatalog:
    return SourceCatalog(np.array([x]), np.array([y]), np.array([flux]))


def make_model(
    distortion: PolynomialDistortion,
    sources: SourceCatalog,
    sigma: float = 3.0,
    detector: Detector | None = None,
    *,
    conserve_flux: bool = True,
    tolerance: float = 0.0,
) -> ForwardModel:
    return ForwardModel(
        detector or Detector(SHAPE),
        sources,
        GaussianPSF(sigma),
        distortion,
        conserve_flux=conserve_flux,
        tolerance=tolerance,
    )


def oracle(counts: Callable[..., FloatArray], model: ForwardModel, theta: FloatArray) -> FloatArray:
    """The same image by `oracles.impulse_counts` or `oracles.box_counts`."""
    sources = (model.sources.x, model.sources.y, model.sources.flux)
    distortion, detector = model.distortion, model.detector
    return counts(
        distortion.f_terms,
        distortion.g_terms,
        theta,
        sources,
        model.psf.sigma,
        detector.shape,
        detector.binning,
        conserve_flux=model.conserve_flux,
    )


def fine_determinant(model: ForwardModel, theta: FloatArray, source: int) -> FloatArray:
    """D of one source over the fine frame, from the exponents."""
    d = model.distortion
    u, v = np.meshgrid(*oracles.impulse_nodes(model.detector.shape, model.detector.binning))
    at = (u, v, model.sources.x[source], model.sources.y[source])
    _, f_u, f_v = oracles.polynomial(d.f_terms, theta[: len(d.f_terms)], *at)
    _, g_u, g_v = oracles.polynomial(d.g_terms, theta[len(d.f_terms) :], *at)
    return np.asarray((1 + f_u) * (1 + g_v) - f_v * g_u)


# --------------------------------------------------------------------------------------------------
# Expected counts


@pytest.mark.parametrize("conserve_flux", [True, False])
@pytest.mark.parametrize("seed", range(20))
def test_counts_equal_the_dense_image(seed: int, conserve_flux: bool) -> None:
    rng = np.random.default_rng(seed)
    distortion = random_distortion(rng)
    sigma = rng.uniform(3, 6)
    model = make_model(
        distortion, random_sources(rng, SHAPE, 6), sigma, conserve_flux=conserve_flux
    )
    theta = random_theta(rng, distortion, SHAPE, 2.0)
    dense = oracle(oracles.impulse_counts, model, theta)
    assert model.expected_counts(theta) == pytest.approx(dense, rel=0, abs=EXACT * dense.max())


@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (40, 1), (16, 48), (33, 47), (64, 17), (7, 8)])
@pytest.mark.parametrize("tolerance", [0.0, 1e-8])
def test_counts_in_frames_of_any_shape(shape: tuple[int, int], tolerance: float) -> None:
    rng = np.random.default_rng(3)
    distortion = PolynomialDistortion.full_polynomial(3)
    model = make_model(
        distortion, random_sources(rng, shape, 4), 1.5, Detector(shape), tolerance=tolerance
    )
    theta = random_theta(rng, distortion, shape, 0.02 * min(shape))
    dense = oracle(oracles.impulse_counts, model, theta)
    allowed = EXACT * dense.max() + 4 * tolerance * 1e4 * model.psf.peak
    assert model.expected_counts(theta, background=2.5) == pytest.approx(
        dense + 2.5, rel=0, abs=allowed
    )


def test_single_source_on_the_axis_is_the_reference_psf() -> None:
    model = make_model(
        PolynomialDistortion.mirrored(), star(0.0, 0.0, 7.0), 3.0, Detector((31, 41))
    )
    u, v = np.meshgrid(*oracles.impulse_nodes((31, 41)))
    psf = np.exp(-(u**2 + v**2) / 18) / (18 * np.pi)
    # The distortion-free condition: no coefficient has any effect on the axis.
    assert model.expected_counts(np.full(12, 1e-3)) == pytest.approx(
        7 * psf, rel=0, abs=EXACT * 7 * psf.max()
    )


def test_source_imaged_outside_the_frame_leaves_it_dark() -> None:
    distortion = PolynomialDistortion(((1, 0, 0, 0),), ())
    sources = star(30.0, 0.0, 1e5)
    model = make_model(distortion, sources, 3.0, tolerance=1e-8)
    assert model.expected_counts([0.0]).sum() > 9e4
    outside = model.expected_counts([-3.0])  # u = 4 x = 120, the frame ends at 37
    assert outside.shape == SHAPE
    assert np.abs(outside).max() <= 1e-8 * 1e5 * model.psf.peak


def test_source_outside_the_frame_can_be_imaged_inside() -> None:
    distortion = PolynomialDistortion(((1, 0, 0, 0),), ())
    model = make_model(distortion, star(60.0, 5.5, 1e5), 3.0, tolerance=1e-8)
    counts = model.expected_counts([0.75])  # u = x / 4 = 15
    expected = oracle(oracles.impulse_counts, model, np.array([0.75]))
    assert counts == pytest.approx(expected, rel=0, abs=1e-8 * expected.max())
    assert counts.sum() == pytest.approx(1e5, rel=1e-6)
    assert counts.argmax() == 35 * SHAPE[1] + 52


@pytest.mark.parametrize("binning", [1, 2, 3])
@pytest.mark.parametrize("sigma", [0.7, 1.0, 1.5, 3.0, 10.0])
def test_box_pixels_equal_fine_quadrature(sigma: float, binning: int) -> None:
    rng = np.random.default_rng(11)
    detector = Detector((22, 29), binning, "box")
    distortion = PolynomialDistortion.mirrored()
    model = make_model(distortion, random_sources(rng, detector.fine_shape, 4), sigma, detector)
    theta = random_theta(rng, distortion, detector.fine_shape, 0.02 * min(detector.fine_shape))
    dense = oracle(oracles.box_counts, model, theta)
    assert model.expected_counts(theta) == pytest.approx(dense, rel=0, abs=1e-6 * dense.max())


@pytest.mark.parametrize("binning", [2, 3, 5])
def test_impulse_binning_sums_the_fine_image(binning: int) -> None:
    rng = np.random.default_rng(12)
    detector = Detector((22, 29), binning)
    distortion = PolynomialDistortion.full_polynomial(3)
    model = make_model(distortion, random_sources(rng, detector.fine_shape, 4), 3.0, detector)
    theta = random_theta(rng, distortion, detector.fine_shape, 0.5)
    dense = oracle(oracles.impulse_counts, model, theta)
    assert model.expected_counts(theta) == pytest.approx(dense, rel=0, abs=EXACT * dense.max())


# --------------------------------------------------------------------------------------------------
# Derivatives


@pytest.mark.parametrize("conserve_flux", [True, False])
@pytest.mark.parametrize(
    "detector", [Detector((40, 51)), Detector((20, 25), 2, "box")], ids=["impulse", "box"]
)
@pytest.mark.parametrize(
    "distortion",
    [
        PolynomialDistortion.mirrored(),
        PolynomialDistortion.full_polynomial(3),
        PolynomialDistortion(((1, 0, 2, 1),), ()),
    ],
    ids=["mirrored", "full_polynomial", "f-only"],
)
def test_jacobian_equals_central_differences(
    distortion: PolynomialDistortion, detector: Detector, conserve_flux: bool
) -> None:
    """Each coefficient apart, to 1e-6 of its own largest derivative.

    The step moves no part of any spot by more than e = 3e-5 sigma. The truncation error is then e^2
    / 6 times the ratio of a Gaussian's largest third and first derivatives (2.3): 3e-10 of the
    largest derivative. Rounding of two images, 1e-15 or so of the peak each, adds a few 1e-15 / e =
    1e-10: both far below 1e-6.
    """
    rng = np.random.default_rng(5)
    sources = random_sources(rng, detector.fine_shape, 3)
    model = make_model(distortion, sources, 3.0, detector, conserve_flux=conserve_flux)
    assert_jacobian_is_right(model, random_theta(rng, distortion, detector.fine_shape, 0.5))


def assert_jacobian_is_right(model: ForwardModel, theta: FloatArray) -> None:
    distortion, detector, sources = model.distortion, model.detector, model.sources
    jacobian = model.jacobian(theta)
    assert jacobian.shape == (distortion.n_terms, *detector.shape)
    half_u, half_v = detector.fine_shape[1] / 2, detector.fine_shape[0] / 2
    for k, (i, j, m, n) in enumerate((*distortion.f_terms, *distortion.g_terms)):
        largest = np.abs(sources.x**i * sources.y**j).max() * half_u**m * half_v**n
        step = np.zeros(distortion.n_terms)
        step[k] = 3e-5 * model.psf.sigma / largest
        above, below = model.expected_counts(theta + step), model.expected_counts(theta - step)
        difference = (above - below) / (2 * step[k])
        assert jacobian[k] == pytest.approx(
            difference, rel=0, abs=1e-6 * np.abs(difference).max()
        ), k


def test_mirror_images_keep_a_positive_kernel() -> None:
    """Where D < 0 the kernel carries |D| and its derivative sign(D)."""
    distortion = PolynomialDistortion(((1, 0, 1, 0), (1, 0, 1, 1)), ((1, 0, 0, 1),))
    theta = np.array([-2.5 / 12, 1e-4, 1e-3])  # a is about -1.5 u - x for the source at x = 12
    model = make_model(distortion, star(12.0, 5.0, 1e4))
    assert fine_determinant(model, theta, 0).max() < 0
    dense = oracle(oracles.impulse_counts, model, theta)
    assert dense.sum() == pytest.approx(1e4, rel=1e-6)
    assert model.expected_counts(theta) == pytest.approx(dense, rel=0, abs=EXACT * dense.max())
    window = make_model(distortion, star(12.0, 5.0, 1e4), tolerance=1e-8).expected_counts(theta)
    assert window == pytest.approx(dense, rel=0, abs=1e-8 * dense.max())
    assert_jacobian_is_right(model, theta)


def test_folded_images_are_exact_at_tolerance_zero() -> None:
    distortion = PolynomialDistortion(((1, 0, 2, 0),), ((0, 1, 1, 1),))
    theta = np.array([1.5e-3, 5e-4])
    model = make_model(distortion, star(20.0, -12.0, 1e4))
    determinant = fine_determinant(model, theta, 0)
    assert determinant.min() < 0 < determinant.max()
    dense = oracle(oracles.impulse_counts, model, theta)
    assert model.expected_counts(theta) == pytest.approx(dense, rel=0, abs=EXACT * dense.max())


def test_truncation_hardly_touches_the_jacobian() -> None:
    # At tolerance 1e-8 the radius is 6.07 sigma, where |p_a| is 6.07 / 0.61 x 1e-8 = 1e-7 of its
    # maximum. Allow for monomials that are three times larger there than at the peak, and for all
    # three stars at once.
    rng = np.random.default_rng(6)
    distortion = PolynomialDistortion.mirrored()
    sources = random_sources(rng, SHAPE, 3)
    theta = random_theta(rng, distortion, SHAPE, 1.0)
    whole = make_model(distortion, sources).jacobian(theta)
    window = make_model(distortion, sources, tolerance=1e-8).jacobian(theta)
    largest = np.abs(whole).max(axis=(1, 2))
    assert (np.abs(window - whole).max(axis=(1, 2)) <= 3 * 3e-7 * largest).all()


# --------------------------------------------------------------------------------------------------
# Flux


@pytest.mark.parametrize(
    ("sigma", "detector"),
    [
        (1.5, Detector((101, 121))),
        (4.0, Detector((101, 121))),
        (0.7, Detector((101, 121), 1, "box")),
        (4.0, Detector((34, 41), 3, "box")),
    ],
    ids=["impulse 1.5", "impulse 4", "box 0.7", "box binned"],
)
def test_flux_is_conserved(sigma: float, detector: Detector) -> None:
    """Impulse sampling alone changes the flux by 4 exp(-2 pi^2 sigma^2): 2e-19 at sigma 1.5."""
    rng = np.random.default_rng(21)
    distortion = PolynomialDistortion.mirrored()
    sources = star(21.3, -12.6, 1.0)
    for _ in range(5):
        theta = random_theta(rng, distortion, (100, 120), 6.0)
        model = make_model(distortion, sources, sigma, detector, tolerance=1e-8)
        assert model.expected_counts(theta).sum() == pytest.approx(1.0, rel=0, abs=1e-6)
        printed = make_model(
            distortion, sources, sigma, detector, conserve_flux=False, tolerance=1e-8
        )
        u, v = distortion.image_position(theta, 21.3, -12.6)
        expected = 1 / distortion.determinant(theta, u, v, 21.3, -12.6)
        assert abs(expected - 1) > 1e-3
        # What is left is D's curvature over the spot.
        left = printed.expected_counts(theta).sum()
        assert left == pytest.approx(expected, rel=0, abs=0.1 * float(abs(expected - 1)))


def test_the_paper_s_kernel_loses_flux_in_the_corner() -> None:
    """Of the four corner sources of the paper's grid, in a frame that holds their whole spots."""
    distortion = PolynomialDistortion.mirrored()
    detector = Detector((605, 605))
    kept = []
    for x, y in ((-200.0, -200.0), (-200.0, 200.0), (200.0, -200.0), (200.0, 200.0)):
        corner = star(x, y, 1.0)
        conserving = make_model(distortion, corner, 10.0, detector, tolerance=1e-8)
        assert conserving.expected_counts(TABLE2).sum() == pytest.approx(1.0, rel=0, abs=1e-6)
        printed = make_model(
            distortion, corner, 10.0, detector, conserve_flux=False, tolerance=1e-8
        )
        kept.append(printed.expected_counts(TABLE2).sum())
        u, v = distortion.image_position(TABLE2, x, y)
        assert kept[-1] == pytest.approx(
            1 / distortion.determinant(TABLE2, u, v, x, y), rel=0, abs=2e-3
        )
    assert [min(kept), max(kept)] == pytest.approx([0.924, 0.930], abs=1e-3)


# --------------------------------------------------------------------------------------------------
# Support


@pytest.mark.parametrize("conserve_flux", [True, False])
@pytest.mark.parametrize("shift", [1.0, 6.0, 20.0])
def test_every_pixel_above_the_tolerance_is_present(shift: float, conserve_flux: bool) -> None:
    """Single stars under random distortions, mild to strong, that do not fold in the frame."""
    rng = np.random.default_rng(int(shift))
    shape, tolerance, tried, truncated = (90, 110), 1e-8, 0, 0
    while tried < 40:
        distortion = random_distortion(rng)
        theta = random_theta(rng, distortion, shape, shift)
        sources, sigma = random_sources(rng, shape, 1), rng.uniform(1, 4)
        model = make_model(
            distortion,
            sources,
            sigma,
            Detector(shape),
            conserve_flux=conserve_flux,
            tolerance=tolerance,
        )
        determinant = fine_determinant(model, theta, 0)
        if determinant.min() <= 0.0:
            continue
        tried += 1
        dense = oracle(oracles.impulse_counts, model, theta)
        counts = model.expected_counts(theta)
        truncated += (counts == 0.0).mean() > 0.1
        peak = sources.flux[0] * model.psf.peak * (determinant if conserve_flux else 1.0)
        missed = np.abs(counts - dense) > tolerance * peak + EXACT * dense.max()
        assert not missed.any(), f"{missed.sum()} pixels, {distortion}, {theta.tolist()}, {sources}"
    assert truncated > 20  # a window as large as the frame would prove nothing


def test_images_of_many_sources_are_truncated_by_their_number() -> None:
    rng = np.random.default_rng(8)
    distortion = PolynomialDistortion.full_polynomial(3)
    sources = random_sources(rng, SHAPE, 20)
    for shift in (0.3, 1.0, 1.5):
        theta = random_theta(rng, distortion, SHAPE, shift)
        model = make_model(distortion, sources, 2.0, tolerance=1e-8)
        peaks = [
            flux * model.psf.peak * np.abs(fine_determinant(model, theta, s)).max()
            for s, flux in enumerate(sources.flux)
        ]
        difference = np.abs(
            model.expected_counts(theta) - oracle(oracles.impulse_counts, model, theta)
        )
        assert difference.max() <= len(sources) * 1e-8 * max(peaks)


def test_the_window_is_little_larger_than_needed() -> None:
    model = make_model(PolynomialDistortion.mirrored(), star(3.2, -4.1, 1.0), 3.0, tolerance=1e-8)
    counts = model.expected_counts(np.zeros(12))
    needed = (counts > 1e-8 * model.psf.peak).sum()
    assert 0.9 * needed <= 2 * np.pi * np.log(1e8) * 9 <= 1.1 * needed
    assert (counts != 0).sum() <= 1.4 * needed


# --------------------------------------------------------------------------------------------------
# Forward model: construction


@pytest.mark.parametrize("tolerance", [-1e-9, 1.0, np.nan])
def test_tolerance_is_checked(tolerance: float) -> None:
    with pytest.raises(InputError, match="tolerance"):
        make_model(PolynomialDistortion.paper(), star(0.0, 0.0, 1.0), tolerance=tolerance)


def test_impulse_sampling_of_a_psf_narrower_than_a_pixel_is_refused() -> None:
    sources = star(0.0, 0.0, 1.0)
    with pytest.raises(InputError, match="box"):
        make_model(PolynomialDistortion.paper(), sources, 0.3)
    make_model(PolynomialDistortion.paper(), sources, 0.3, Detector(SHAPE, 1, "box"))


@pytest.mark.parametrize("shape", [(), (11,), (13,), (12, 1)])
def test_model_checks_the_shape_of_theta(shape: tuple[int, ...]) -> None:
    model = make_model(PolynomialDistortion.paper(), star(0.0, 0.0, 1.0))
    for method in (model.expected_counts, model.jacobian):
        with pytest.raises(InputError, match=r"theta.*\(12,\).*f_ux"):
            method(np.zeros(shape))


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan, np.inf])
def test_psf_width_is_checked(sigma: float) -> None:
    with pytest.raises(InputError, match="sigma"):
        GaussianPSF(sigma)


def test_models_survive_a_file() -> None:
    distortion = PolynomialDistortion(((1, 0, 2, 0), (2, 0, 0, 1)), ())
    sources = random_sources(np.random.default_rng(1), SHAPE, 3)
    model = make_model(
        distortion, sources, 2.5, Detector((30, 37), 2, "box"), conserve_flux=False, tolerance=1e-7
    )
    with h5py.File("model.h5", "w", driver="core", backing_store=False) as file:
        write(file, model)
        again = read(file, ForwardModel)
        assert file["distortion/f_terms"].dtype == np.int64
    assert (again.detector, again.psf, again.distortion) == (
        model.detector,
        model.psf,
        model.distortion,
    )
    assert (again.conserve_flux, again.tolerance) == (False, 1e-7)
    theta = [1e-6, 2e-6]
    assert np.array_equal(again.expected_counts(theta), model.expected_counts(theta))


# --------------------------------------------------------------------------------------------------
# Distortion


def test_names_give_the_powers_of_u_v_x_y() -> None:
    f_terms = ((1, 0, 2, 0), (2, 0, 0, 1), (1, 0, 0, 0), (0, 3, 1, 12))
    distortion = PolynomialDistortion(f_terms, ((1, 1, 1, 1),))
    assert distortion.names == ("f_u2x", "f_vx2", "f_x", "f_uv12y3", "g_uvxy")
    assert distortion.n_terms == 5
    lists = ([list(term) for term in f_terms], np.array([[1, 1, 1, 1]]))
    assert PolynomialDistortion(*lists) == distortion  # type: ignore[arg-type]
    assert (
        len(set(PolynomialDistortion.full_polynomial(4).names))
        == PolynomialDistortion.full_polynomial(4).n_terms
    )


def test_named_bases() -> None:
    in_x = ("f_ux", "f_vx", "f_u2x", "f_v2x", "f_ux2", "f_vx2")
    assert PolynomialDistortion.paper().names == (
        *in_x,
        *(name.replace("f_", "g_") for name in in_x),
    )
    assert PolynomialDistortion.mirrored().names == (
        *in_x,
        "g_uy",
        "g_vy",
        "g_u2y",
        "g_v2y",
        "g_uy2",
        "g_vy2",
    )
    assert PolynomialDistortion.pinhole().names[:4] == ("f_x2", "f_xy", "f_x3", "f_xy2")
    assert PolynomialDistortion.pinhole().names[4:] == ("g_xy", "g_y2", "g_x2y", "g_y3")


def test_polynomial_has_every_term_of_x_and_y() -> None:
    distortion = PolynomialDistortion.polynomial(3)
    names = ("x", "y", "x2", "xy", "y2", "x3", "x2y", "xy2", "y3")
    assert distortion.names == tuple(f"{letter}_{name}" for letter in "fg" for name in names)


@pytest.mark.parametrize("radius", [250.0, 1.0])
def test_zernike_polynomials_are_those_of_their_definition(radius: float) -> None:
    """In polar coordinates, with Jacobi's polynomials for the radial part."""
    degree = 6
    distortion = PolynomialDistortion.zernike(degree, radius)
    orders = [(n, m) for n in range(1, degree + 1) for m in range(-n, n + 1, 2)]
    names = [f"z{n}_{'m' * (m < 0)}{abs(m)}" for n, m in orders]
    assert distortion.names == tuple(f"{letter}_{name}" for letter in "fg" for name in names)
    assert len(distortion.f_terms) == len(orders)
    x, y = radius * np.random.default_rng(1).uniform(-1.0, 1.0, (2, 20))
    r, phi = np.hypot(x, y) / radius, np.arctan2(y, x)
    f, g = distortion.design_matrix(x, y, x, y)
    for k, (n, m) in enumerate(orders):
        half = (n - abs(m)) // 2
        jacobi = eval_jacobi(half, abs(m), 0.0, 1.0 - 2.0 * r**2)
        angular = np.cos(m * phi) if m >= 0 else np.sin(-m * phi)
        constant = (-1.0) ** (n // 2) if m == 0 else 0.0
        expected = (-1.0) ** half * r ** abs(m) * jacobi * angular - constant
        assert f[:, k] == pytest.approx(expected, abs=1e-12)
        assert g[:, len(orders) + k] == pytest.approx(expected, abs=1e-12)
    assert not f[:, len(orders) :].any() and not g[:, : len(orders)].any()


@pytest.mark.parametrize("focal_length", [800.0, 1.0])
def test_lens_model_is_that_of_opencv(focal_length: float) -> None:
    """As its documentation defines x'' and y'', in pixels of a camera matrix with f_x = f_y."""
    distortion = PolynomialDistortion.radial_tangential(focal_length)
    assert distortion.names == ("k1", "k2", "k3", "p1", "p2")
    rng = np.random.default_rng(2)
    x, y = 0.3 * focal_length * rng.uniform(-1.0, 1.0, (2, 20))
    k1, k2, k3, p1, p2 = theta = np.array([-0.28, 0.07, 0.01, 2e-3, -1e-3])
    a, b = x / focal_length, y / focal_length
    r2 = a**2 + b**2
    radial = 1.0 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = focal_length * (a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a**2))
    v = focal_length * (b * radial + p1 * (r2 + 2.0 * b**2) + 2.0 * p2 * a * b)
    image = distortion.image_position(theta, x, y)
    assert np.array(image) == pytest.approx(np.array([u, v]), rel=1e-12)


@pytest.mark.parametrize(
    ("maker", "message"),
    [
        (lambda: PolynomialDistortion.polynomial(0), "degree: got 0, expected .* at least 1"),
        (lambda: PolynomialDistortion.zernike(0), "degree: got 0, expected .* at least 1"),
        (lambda: PolynomialDistortion.zernike(2, radius=0.0), "radius: got 0.0, expected"),
        (lambda: PolynomialDistortion.radial_tangential(np.nan), "focal_length: got nan"),
    ],
)
def test_bases_refuse_what_makes_no_sense(maker: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        maker()


def test_largest_displacement_of_monomials_is_that_in_the_corner() -> None:
    distortion = PolynomialDistortion.full_polynomial(4)
    half_x, half_y = 60.0, 40.0
    in_f, in_g = distortion.largest_displacement(half_x, half_y)
    powers = [(i + m, j + n) for i, j, m, n in distortion.f_terms]
    expected = np.array([half_x**along * half_y**across for along, across in powers])
    n = len(powers)
    assert in_f[:n] == pytest.approx(expected, rel=1e-14) and not in_f[n:].any()
    assert in_g[n:] == pytest.approx(expected, rel=1e-14) and not in_g[:n].any()


@pytest.mark.parametrize(
    "distortion",
    [PolynomialDistortion.zernike(6, 70.0), PolynomialDistortion.radial_tangential(200.0)],
    ids=["zernike", "radial_tangential"],
)
def test_largest_displacement_bounds_that_of_every_source(
    distortion: PolynomialDistortion,
) -> None:
    x, y = np.array([[60.0], [40.0]]) * np.random.default_rng(3).uniform(-1.0, 1.0, (2, 20000))
    largest = distortion.largest_displacement(60.0, 40.0)
    dense = np.abs(distortion.design_matrix(x, y, x, y)).max(axis=1)
    # Between points h = 1/8 of a half-width apart, a polynomial of degree n = 6 (or 7) rises by
    # at most the part (n h / 2)^2 / 2: 7 % (or 10 %).
    assert (dense <= 1.1 * largest).all()
    assert (dense >= 0.9 * largest).all()


def test_a_coefficient_that_only_exchanges_u_for_x_has_a_displacement() -> None:
    basis = [[1.0, 1.0], [-1.0, 1.0]]
    distortion = PolynomialDistortion([(1, 0, 1, 0), (2, 0, 0, 0)], [], basis, "exchange both")
    assert not distortion.design_matrix(5.0, 5.0, 5.0, 5.0)[0, 0]
    assert distortion.largest_displacement(10.0, 10.0)[0] == pytest.approx([10.0, 200.0])


@pytest.mark.parametrize("shape", [(), (7,), (3, 4)])
def test_design_matrix_is_the_displacement_of_unit_coefficients(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(4)
    for _ in range(5):
        distortion = random_distortion(rng)
        point = rng.uniform(-3.0, 3.0, (4, *shape))
        design = distortion.design_matrix(*point)
        assert design.shape == (2, *shape, distortion.n_terms)
        theta = rng.standard_normal(distortion.n_terms)
        expected = np.array(distortion.displacement(theta, *point))
        assert design @ theta == pytest.approx(expected, rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(("degree", "count"), [(2, 7), (3, 23), (4, 53)])
def test_complete_has_every_term(degree: int, count: int) -> None:
    # Monomials of total degree d in four variables less those in (u, v) alone: C(d + 3, 3) - (d +
    # 1).
    distortion = PolynomialDistortion.full_polynomial(degree)
    assert len(distortion.f_terms) == len(set(distortion.f_terms)) == count
    assert distortion.g_terms == distortion.f_terms
    assert all(2 <= sum(term) <= degree and term[0] + term[1] >= 1 for term in distortion.f_terms)
    totals = [sum(term) for term in distortion.f_terms]
    assert totals == sorted(totals)


@pytest.mark.parametrize(
    ("f_terms", "message"),
    [
        ([(0, 0, 2, 0)], r"f_u2 .*distortion-free condition at the axis.*i \+ j >= 1"),
        ([(0, 0, 0, 0)], "f_1 .*distortion-free"),
        ([(2, 0, -1, 0)], r"f_terms.*\(2, 0, -1, 0\).*>= 0"),
        ([(1, 0, 0.5, 0)], "f_terms.*four integers"),
        ([(1, 0, 0)], "f_terms.*four integers"),
        ([3], "f_terms.*four integers"),
        ([(1, 0, 2, 0), (1, 0, 2, 0)], "f_u2x .*twice"),
        ([], "no term"),
    ],
)
def test_bad_terms_are_refused_in_one_line(
    f_terms: list[tuple[int, int, int, int]], message: str
) -> None:
    with pytest.raises(InputError, match=message) as error:
        PolynomialDistortion(tuple(f_terms), ())
    assert "\n" not in str(error.value)


def test_bad_terms_of_g_and_bad_degrees_are_refused() -> None:
    with pytest.raises(InputError, match=r"g_v3 .*distortion-free"):
        PolynomialDistortion(((1, 0, 0, 0),), ((0, 0, 0, 3),))
    for degree in (1, 2.0, "3"):
        with pytest.raises(InputError, match="degree"):
            PolynomialDistortion.full_polynomial(degree)  # type: ignore[arg-type]


def test_displacement_and_determinant_follow_the_exponents() -> None:
    rng = np.random.default_rng(31)
    for _ in range(10):
        distortion = random_distortion(rng)
        theta = random_theta(rng, distortion, SHAPE, 2.0)
        u, v = np.meshgrid(np.linspace(-30, 30, 7), np.linspace(-20, 20, 5))
        split = len(distortion.f_terms)
        f, f_u, f_v = oracles.polynomial(distortion.f_terms, theta[:split], u, v, 11.0, -7.0)
        g, g_u, g_v = oracles.polynomial(distortion.g_terms, theta[split:], u, v, 11.0, -7.0)
        values = distortion.displacement(theta, u, v, 11.0, -7.0)
        assert values[0] == pytest.approx(f, rel=1e-13, abs=1e-13)
        assert values[1] == pytest.approx(g, rel=1e-13, abs=1e-13)
        determinant = (1 + f_u) * (1 + g_v) - f_v * g_u
        assert distortion.determinant(theta, u, v, 11.0, -7.0) == pytest.approx(
            determinant, rel=1e-13, abs=1e-13
        )


def test_displacement_broadcasts() -> None:
    distortion = PolynomialDistortion.paper()
    f, g = distortion.displacement(
        np.ones(12), np.zeros((5, 1)), np.zeros(4), np.zeros((3, 1, 1)), 1.0
    )
    assert f.shape == g.shape == (3, 5, 4)


@pytest.mark.parametrize(
    "distortion",
    [
        PolynomialDistortion.paper(),
        PolynomialDistortion.mirrored(),
        PolynomialDistortion.full_polynomial(3),
    ],
    ids=["paper", "mirrored", "full_polynomial"],
)
def test_image_and_object_positions_are_inverse(distortion: PolynomialDistortion) -> None:
    rng = np.random.default_rng(32)
    theta = random_theta(rng, distortion, (500, 500), 5.0)
    x, y = np.meshgrid(np.linspace(-200, 200, 9), np.linspace(-200, 200, 9))
    u, v = distortion.image_position(theta, x, y)
    f, g = distortion.displacement(theta, u, v, x, y)
    assert np.hypot(u - x, v - y).max() > 3.0
    assert np.abs([u - x + f, v - y + g]).max() <= 1e-11
    back_x, back_y = distortion.object_position(theta, u, v)
    assert np.hypot(back_x - x, back_y - y).max() <= 1e-9


def test_pinhole_image_position_is_the_paper_s_formula() -> None:
    k = np.array([1e-4, -2e-4, 3e-7, -1e-7, 2e-4, 1e-4, -2e-7, 1e-7])
    x, y = np.meshgrid(np.linspace(-200, 200, 5), np.linspace(-150, 150, 4))
    u, v = PolynomialDistortion.pinhole().image_position(-k, x, y)
    assert u == pytest.approx(x * (1 + k[0] * x + k[1] * y + k[2] * x**2 + k[3] * y**2), rel=1e-13)
    assert v == pytest.approx(y * (1 + k[4] * x + k[5] * y + k[6] * x**2 + k[7] * y**2), rel=1e-13)


def test_positions_that_do_not_exist_are_nan_without_a_warning() -> None:
    # u - x + c x u^2 = 0 has a real solution only where 1 + 4 c x^2 >= 0; seen from u it is linear
    # in x.
    distortion = PolynomialDistortion(((1, 0, 2, 0),), ())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        u, v = distortion.image_position([-1e-2], [1.0, 50.0, -3.0], 0.0)
        x, _ = distortion.object_position([1e-2], [1.0, 10.0], 0.0)
    assert np.isnan(u).tolist() == np.isnan(v).tolist() == [False, True, False]
    assert u[0] - 1.0 - 1e-2 * u[0] ** 2 == pytest.approx(0.0, abs=1e-12)
    assert x[0] == pytest.approx(1 / (1 - 1e-2), rel=1e-12)
    assert np.isnan(x[1])  # the factor of x vanishes there


def test_distortion_checks_the_shape_of_theta() -> None:
    distortion = PolynomialDistortion.pinhole()
    for call in (
        lambda theta: distortion.displacement(theta, 0.0, 0.0, 0.0, 0.0),
        lambda theta: distortion.determinant(theta, 0.0, 0.0, 0.0, 0.0),
        lambda theta: distortion.image_position(theta, 0.0, 0.0),
        lambda theta: distortion.object_position(theta, 0.0, 0.0),
    ):
        with pytest.raises(
            InputError, match=r"theta: got shape \(7,\), expected \(8,\).*f_x2, .*g_y3"
        ):
            call(np.zeros(7))


# --------------------------------------------------------------------------------------------------
# Catalogue


def test_grid_is_the_paper_s_object() -> None:
    grid = SourceCatalog.grid(9, 50.0, 1e5)
    assert len(grid) == 81
    assert grid.x[:3].tolist() == [-200.0, -150.0, -100.0]
    assert grid.y[:9].tolist() == [-200.0] * 9
    assert (grid.x.sum(), grid.y.sum(), grid.flux.sum()) == (0.0, 0.0, 81e5)
    assert SourceCatalog.grid(1, 3.0, 1.0).x.tolist() == [0.0]


def test_catalogue_copies_its_columns_and_keeps_them() -> None:
    x = np.array([1.0, 2.0])
    catalogue = SourceCatalog(x, [3, 4], [5, 6])  # type: ignore[arg-type]
    x[0] = 9.0
    assert catalogue.x.tolist() == [1.0, 2.0]
    assert catalogue.y.dtype == np.float64
    with pytest.raises(ValueError, match="read-only"):
        catalogue.flux[0] = 0.0


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (([], [], []), "x: got shape"),
        (([[1.0]], [1.0], [1.0]), "x: got shape"),
        (([1.0, 2.0], [1.0], [1.0]), "2, 1 and 1 values"),
        (([1.0], [np.nan], [1.0]), "y: got nan for source 0"),
        (([1.0, 1.0], [1.0, 1.0], [1.0, np.inf]), "flux: got inf for source 1"),
        (([1.0, 1.0], [1.0, 1.0], [1.0, 0.0]), "flux: got 0 for source 1, expected > 0"),
        (
            ([1.0, 1.0], [1.0, 1.0], [1.0, 1e200]),
            "flux: got 1e.200 for source 1, expected > 0 and at most 9e15",
        ),
        (([1.0], ["east"], [1.0]), "y: .*not numbers"),
    ],
)
def test_bad_catalogues_are_refused(
    columns: tuple[list[float], list[float], list[float]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        SourceCatalog(*columns)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("side", "spacing", "flux"), [(0, 1.0, 1.0), (2.5, 1.0, 1.0), (3, -1.0, 1.0), (3, 1.0, 0.0)]
)
def test_bad_grids_are_refused(side: int, spacing: float, flux: float) -> None:
    with pytest.raises(InputError, match=r"side|spacing|flux"):
        SourceCatalog.grid(side, spacing, flux)


# --------------------------------------------------------------------------------------------------
# Detector


def test_pixel_centres_are_in_fine_pixels_from_the_middle() -> None:
    detector = Detector((3, 4), 5)
    u, v = detector.pixel_centres()
    assert detector.fine_shape == (15, 20)
    fine_u, fine_v = oracles.impulse_nodes(detector.shape, 5)
    assert u.tolist() == fine_u.reshape(4, 5).mean(axis=1).tolist()
    assert v.tolist() == fine_v.reshape(3, 5).mean(axis=1).tolist()
    offsets, weights = detector.quadrature(3.0)
    assert (u[0] + offsets).tolist() == fine_u[:5].tolist()
    assert weights.tolist() == [1.0] * 5


@pytest.mark.parametrize("width", [0.01, 0.2, 1.0, 1 / 0.7, 3 / 0.7, 5.0, 12.0])
def test_box_quadrature_integrates_a_gaussian(width: float) -> None:
    binning = 3
    sigma = binning / width
    offsets, weights = Detector((4, 4), binning, "box").quadrature(sigma)
    assert weights.sum() == pytest.approx(binning, rel=1e-14)
    for narrowing, allowed in ((1.0, 1e-7), (1.3, 5e-7)):  # along one axis; a frame has two
        s = sigma / narrowing
        centres = np.linspace(-4, 4, 101) * (sigma + binning)
        rule = (np.exp(-((centres[:, None] + offsets) ** 2) / (2 * s**2)) * weights).sum(axis=1)
        edges = (centres[:, None] + np.array([-0.5, 0.5]) * binning) / (np.sqrt(2) * s)
        exact = np.sqrt(np.pi / 2) * s * np.diff(erf(edges), axis=1)[:, 0]
        assert rule == pytest.approx(exact, rel=0, abs=allowed * exact.max())


def test_box_quadrature_takes_few_points_for_wide_psfs() -> None:
    orders = [
        len(Detector((4, 4), 1, "box").quadrature(sigma)[0])
        for sigma in (0.7, 1.0, 3.0, 10.0, 100.0)
    ]
    assert orders == [5, 5, 3, 3, 2]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 5),), "shape"),
        (((5,),), "shape"),
        (((5, 5, 5),), "shape"),
        (((5.0, 5.0),), "shape"),
        ((7,), "shape"),
        (((5, 5), 0), "binning"),
        (((5, 5), 1.5), "binning"),
        (((5, 5), 1, "square"), "pixel.*'impulse', 'box'"),
    ],
)
def test_bad_detectors_are_refused(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Detector(*arguments)  # type: ignore[arg-type]


def test_bad_widths_are_refused() -> None:
    for sigma in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="sigma"):
            Detector((5, 5)).quadrature(sigma)


def test_sampling_matrix_integrates_sinc() -> None:
    matrix = sampling_matrix(127)
    assert np.array_equal(matrix, matrix.T)
    assert np.array_equal(matrix[1:, 1:], matrix[:-1, :-1])
    # The sum over all integers of sinc(u - m) is one; a row cut at distance k lacks about 1 / (pi^2
    # k) of it.
    assert matrix[63].sum() == pytest.approx(1.0, abs=2 / (np.pi**2 * 63))
    nodes, weights = np.polynomial.legendre.leggauss(30)
    for k in (0, 1, 2, 10):
        assert matrix[0, k] == pytest.approx(
            (np.sinc(nodes / 2 - k) * weights).sum() / 2, abs=1e-15
        )


def gaussian_spot(n: int, sigma: float) -> tuple[FloatArray, FloatArray]:
    """A spot of peak one at the middle: sampled, and integrated over pixels exactly."""
    u = oracles.middle_out(n)
    edges = np.append(u - 0.5, u[-1] + 0.5) / (np.sqrt(2) * sigma)
    return np.exp(-(u**2) / (2 * sigma**2)), np.sqrt(np.pi / 2) * sigma * np.diff(erf(edges))


@pytest.mark.parametrize("shape", [(127, 127), (90, 127)])
def test_sampling_correction_recovers_the_paper_s_spot(shape: tuple[int, int]) -> None:
    (ideal_v, recorded_v), (ideal_u, recorded_u) = (gaussian_spot(n, 3.0) for n in shape)
    ideal, recorded = np.outer(ideal_v, ideal_u), np.outer(recorded_v, recorded_u)
    assert np.abs(recorded - ideal).max() == pytest.approx(1e-2, rel=0.2)
    assert np.abs(correct_sampling(recorded) - ideal).max() <= 2e-12


def test_sampling_correction_turns_box_counts_into_impulse_counts() -> None:
    rng = np.random.default_rng(41)
    distortion = PolynomialDistortion.mirrored()
    sources = SourceCatalog(*np.array([[-12.0, 15.0, 3.0], [-10.0, 4.0, 11.0], [1e3, 2e3, 3e3]]))
    theta = random_theta(rng, distortion, (60, 75), 2.0)
    impulse = make_model(distortion, sources, 2.0).expected_counts(theta)
    box = make_model(distortion, sources, 2.0, Detector(SHAPE, 1, "box")).expected_counts(theta)
    assert np.abs(box - impulse).max() > 1e-2 * impulse.max()
    assert correct_sampling(box) == pytest.approx(impulse, rel=0, abs=1e-6 * impulse.max())


@pytest.mark.parametrize(
    "frame", [np.zeros(5), np.zeros((2, 3, 4)), np.zeros((0, 3)), np.full((3, 3), np.nan)]
)
def test_bad_frames_are_refused(frame: FloatArray) -> None:
    with pytest.raises(InputError, match="frame"):
        correct_sampling(frame)


def test_bad_sampling_sizes_are_refused() -> None:
    for n in (0, -3, 2.5):
        with pytest.raises(InputError, match="n: got"):
            sampling_matrix(n)  # type: ignore[arg-type]


def test_a_pickled_catalogue_needs_no_other_compiled_code() -> None:
    """Arrays that may be written to have another type there than those that may not."""
    sources = SourceCatalog([0.0, 30.0], [0.0, -20.0], [1e4, 2e4])
    again = pickle.loads(pickle.dumps(sources))
    for name in ("x", "y", "flux"):
        column = getattr(again, name)
        assert np.array_equal(column, getattr(sources, name)) and not column.flags.writeable
    # negative control: what pickling does to an array
    assert pickle.loads(pickle.dumps(sources.x)).flags.writeable
