"""Moffat and sampled PSFs against slow images, closed forms, scipy's splines and refits."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numba as nb
import numpy as np
import oracles
import pytest
from numpy.typing import NDArray
from scipy import integrate, interpolate, ndimage
from test_imaging import (
    EXACT,
    assert_jacobian_is_right,
    fine_determinant,
    random_sources,
    random_theta,
    star,
)
from test_model import LIMIT
from test_model_derivatives import STEP, errors, five_point
from test_optimize_map import excess
from test_sampling_chain import reseal, run

from bayesfred import build, settings
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector, correct_sampling
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.psf_dispatch import psf_second_derivatives, psf_slopes
from bayesfred.imaging.logarithm import LogDistortion
from bayesfred.imaging.psf import FWHM, PSF, GaussianPSF, MoffatPSF, SampledPSF
from bayesfred.model.noise import simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chainfile import open_chain

Floats = NDArray[np.float64]

SHAPE = (60, 75)
MIRRORED = PolynomialDistortion.mirrored()


def lopsided(sigma: float, oversampling: int = 4, half: float = 6.0) -> Floats:
    """Samples of a spot that is neither round nor symmetric, `half` widths to either side."""
    n = round(half * sigma * oversampling)
    a = np.arange(-n, n + 1) / (oversampling * sigma)
    b = a[:, None]
    return np.asarray(
        np.exp(-0.5 * (a**2 + 0.6 * a * b + 1.4 * b**2))
        * (1.0 + 0.3 * np.tanh(a) + 0.2 * np.sin(b))
    )


def spline(psf: SampledPSF, a: Floats, b: Floats) -> Floats:
    """The cubic spline through the samples by scipy, scaled to unit volume.

    It is zero two samples beyond them.
    """
    n = len(psf.values)
    samples = np.arange(n) - (n - 1) / 2
    knots = (
        np.arange(n + 10) - (n + 9) / 2
    )  # three coefficients, which stay zero, more to either side: it ends beyond the support
    full = interpolate.BSpline.design_matrix(samples, knots, 3).toarray()
    c = np.zeros((n + 6, n + 6))
    c[3:-3, 3:-3] = np.linalg.solve(full[:, 3:-3], np.linalg.solve(full[:, 3:-3], psf.values).T).T
    inside = np.clip(
        np.stack(np.broadcast_arrays(b, a), axis=-1) * psf.oversampling, -(n + 3) / 2, (n + 3) / 2
    )
    return np.asarray(
        interpolate.NdBSpline((knots, knots), c, 3)(inside) / c.sum() * psf.oversampling**2
    )


def moffat(psf: MoffatPSF, a: Floats, b: Floats) -> Floats:
    """From the definition: half the peak at half the FWHM, unit volume."""
    square = (psf.fwhm / 2) ** 2 / (2 ** (1 / psf.beta) - 1)
    return np.asarray((psf.beta - 1) / (np.pi * square) * (1 + (a**2 + b**2) / square) ** -psf.beta)


def formula(psf: PSF, a: Floats, b: Floats) -> Floats:
    if isinstance(psf, SampledPSF):
        return spline(psf, a, b)
    if isinstance(psf, MoffatPSF):
        return moffat(psf, a, b)
    return np.asarray(np.exp(-(a**2 + b**2) / (2 * psf.sigma**2)) / (2 * np.pi * psf.sigma**2))


def dense(model: ForwardModel, theta: Floats, nodes: tuple[Floats, Floats]) -> Floats:
    """The image at every pair of nodes, from the formulas."""
    d, (u, v) = model.distortion, np.meshgrid(*nodes)
    split, image = len(d.f_terms), np.zeros(u.shape)
    for x, y, flux in zip(model.sources.x, model.sources.y, model.sources.flux, strict=True):
        f, f_u, f_v = oracles.polynomial(d.f_terms, theta[:split], u, v, x, y)
        g, g_u, g_v = oracles.polynomial(d.g_terms, theta[split:], u, v, x, y)
        size = np.abs((1 + f_u) * (1 + g_v) - f_v * g_u) if model.conserve_flux else 1.0
        image += flux * size * formula(model.psf, u - x + f, v - y + g)
    return image


def impulse(model: ForwardModel, theta: Floats) -> Floats:
    return oracles.bin_fine(
        dense(model, theta, oracles.impulse_nodes(model.detector.shape, model.detector.binning)),
        model.detector.binning,
    )


KINDS: dict[str, PSF] = {"moffat": MoffatPSF(4.1, 2.6), "sampled": SampledPSF(lopsided(2.0), 4)}


@pytest.fixture(params=KINDS)
def psf(request: pytest.FixtureRequest) -> PSF:
    return KINDS[request.param]


# --------------------------------------------------------------------------------------------------
# Expected counts


def test_counts_equal_the_dense_image(psf: PSF) -> None:
    rng = np.random.default_rng(80)
    for _ in range(5):
        theta = random_theta(rng, MIRRORED, SHAPE, 2.0)
        model = ForwardModel(
            Detector(SHAPE), random_sources(rng, SHAPE, 6), psf, MIRRORED, tolerance=0.0
        )
        expected = impulse(model, theta)
        assert model.expected_counts(theta, 2.5) == pytest.approx(
            expected + 2.5, rel=0, abs=EXACT * expected.max()
        )


def test_density_equals_the_formula(psf: PSF) -> None:
    a, b = 4.0 * np.random.default_rng(81).standard_normal((2, 500))
    assert psf.density(a, b) == pytest.approx(formula(psf, a, b), rel=0, abs=EXACT * psf.peak)


def test_sampled_psf_interpolates_its_samples() -> None:
    values = lopsided(2.0)
    at = (np.arange(len(values)) - (len(values) - 1) / 2) / 4
    ratio = SampledPSF(values, 4).density(at, at[:, None]) / values
    inner = values > 1e-6
    assert ratio[inner] == pytest.approx(ratio[inner].mean(), rel=1e-9)
    # of samples that vanish at their border, the spline is scipy.ndimage's
    fine = ndimage.map_coordinates(values, np.mgrid[20:70:0.3, 20:70:0.3], order=3)
    a = (np.arange(20, 70, 0.3) - (len(values) - 1) / 2) / 4
    assert SampledPSF(values, 4).density(a, a[:, None]) == pytest.approx(
        fine * ratio[inner].mean(), rel=0, abs=1e-8
    )


def test_sampled_gaussian_is_nearly_the_gaussian() -> None:
    """With samples 1/8 sigma apart the spline errs by 4e-6 of the peak.

    That is (1/8)^4 / 384 times the fourth derivatives, 6 together.
    """
    x = np.arange(-56, 57) / 4
    model = ForwardModel(
        Detector(SHAPE),
        star(3.3, -2.4, 1e4),
        SampledPSF(np.exp(-(x**2 + x[:, None] ** 2) / 8), 4),
        MIRRORED,
    )
    exact = ForwardModel(
        Detector(SHAPE), model.sources, GaussianPSF(2.0), MIRRORED
    ).expected_counts(np.zeros(12))
    assert model.psf.sigma == pytest.approx(2.0, rel=1e-3)
    assert model.expected_counts(np.zeros(12)) == pytest.approx(
        exact, rel=0, abs=4e-6 * exact.max()
    )


@pytest.mark.parametrize("log", [False, True])
def test_distortion_that_is_not_polynomial_has_any_psf(psf: PSF, log: bool) -> None:
    distortion = LogDistortion(1e-9) if log else MIRRORED  # so weak that there is none
    counts = ForwardModel(
        Detector((30, 35)), star(2.0, -3.0, 1e3), psf, distortion
    ).expected_counts(np.zeros(0 if log else 12))
    expected = 1e3 * formula(
        psf, *(np.meshgrid(*oracles.impulse_nodes((30, 35))) - np.array([2.0, -3.0])[:, None, None])
    )
    assert counts == pytest.approx(expected, rel=0, abs=1e-6 * expected.max())


@pytest.mark.parametrize("binning", [1, 2])
@pytest.mark.parametrize(
    "psf",
    [MoffatPSF(1.6, 1.5), MoffatPSF(2.5, 4.0), SampledPSF(lopsided(1.0, 7), 7)],
    ids=["1.5", "4", "sampled"],
)
def test_box_pixels_equal_fine_quadrature(psf: PSF, binning: int) -> None:
    """A spline is no polynomial within a pixel.

    Where samples are 1/7 sigma apart that costs 1e-5 of the peak.
    """
    rng = np.random.default_rng(82)
    detector = Detector((22, 29), binning, "box")
    model = ForwardModel(
        detector, random_sources(rng, detector.fine_shape, 3), psf, MIRRORED, tolerance=0.0
    )
    theta = random_theta(rng, MIRRORED, detector.fine_shape, 0.2)
    order = 16
    weights = np.polynomial.legendre.leggauss(order)[1] / 2
    image = dense(model, theta, oracles.box_nodes(detector.shape, binning, order))
    image *= (
        np.tile(weights, detector.fine_shape[1]) * np.tile(weights, detector.fine_shape[0])[:, None]
    )
    expected = oracles.bin_fine(image, binning * order)
    allowed = 1e-5 if isinstance(psf, SampledPSF) else 1e-6
    assert model.expected_counts(theta) == pytest.approx(
        expected, rel=0, abs=allowed * expected.max()
    )


@pytest.mark.slow
def test_jacobian_equals_central_differences(psf: PSF) -> None:
    rng = np.random.default_rng(83)
    for detector in (Detector((40, 51)), Detector((20, 25), 2, "box")):
        model = ForwardModel(
            detector, random_sources(rng, detector.fine_shape, 3), psf, MIRRORED, tolerance=0.0
        )
        assert_jacobian_is_right(model, random_theta(rng, MIRRORED, detector.fine_shape, 0.5))


# --------------------------------------------------------------------------------------------------
# Volume and support


def test_unit_volume() -> None:
    for beta in (1.5, 3.0, 90.0):
        moffat_psf = MoffatPSF(3.0, beta)
        volume, _ = integrate.quad(
            lambda r, p=moffat_psf: 2 * np.pi * r * p.density(r, 0.0), 0, np.inf
        )
        assert volume == pytest.approx(1.0, abs=1e-8)
    sampled = KINDS["sampled"]
    x = (
        np.arange(-200, 200) / 12 + 0.01
    )  # cubic splines' sums over three samples a step are their integrals
    assert sampled.density(x, x[:, None]).sum() / 144 == pytest.approx(1.0, abs=1e-6)
    assert sampled.density(20.0, 0.0) == 0.0
    counts = ForwardModel(
        Detector((81, 81)), star(0.2, 0.3, 1.0), sampled, MIRRORED
    ).expected_counts(np.zeros(12))
    assert counts.sum() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("tolerance", [1e-3, 1e-5])
@pytest.mark.parametrize("shift", [1.0, 6.0])
def test_every_pixel_above_the_tolerance_is_present(
    psf: PSF, shift: float, tolerance: float
) -> None:
    rng = np.random.default_rng(84)
    tried = truncated = 0
    shape = (90, 110)
    while tried < 8:
        theta = random_theta(rng, MIRRORED, shape, shift)
        model = ForwardModel(
            Detector(shape), random_sources(rng, shape, 1), psf, MIRRORED, tolerance=tolerance
        )
        determinant = fine_determinant(model, theta, 0)
        if determinant.min() <= 0.0:
            continue
        tried += 1
        expected, counts = impulse(model, theta), model.expected_counts(theta)
        truncated += (counts == 0.0).mean() > 0.1
        missed = (
            np.abs(counts - expected)
            > tolerance * model.sources.flux[0] * psf.peak * determinant + EXACT * expected.max()
        )
        assert not missed.any(), f"{missed.sum()} pixels, {theta.tolist()}"
    assert truncated > 3  # a window as large as the frame would prove nothing


def test_windows_are_little_larger_than_needed(psf: PSF) -> None:
    reach, x = psf.support_radius(1e-4), np.arange(-400, 401) / 10
    beyond = np.hypot(x, x[:, None])[psf.density(x, x[:, None]) > 1e-4 * psf.peak].max()
    assert beyond <= reach <= beyond + 1.0
    assert psf.support_radius(0.0) == np.inf


# --------------------------------------------------------------------------------------------------
# Inference

CASES = {
    "scale": (Nuisances("scale", offset=True, psf_sigma=True), Detector(SHAPE)),
    "free, scattered, box": (
        Nuisances("free", psf_sigma=True, position_scatter=True),
        Detector((30, 37), 2, "box"),
    ),
}


LONG = pytest.mark.long  # what costs most to compile


def make_posterior(
    psf: PSF, nuisances: Nuisances, detector: Detector, seed: int
) -> tuple[Posterior, Floats]:
    """A frame of nine sources from the model itself, which is tested above."""
    rng = np.random.default_rng(seed)
    model = ForwardModel(detector, SourceCatalog.grid(3, 17.0, 2e4), psf, MIRRORED, tolerance=0.0)
    theta = random_theta(rng, MIRRORED, detector.fine_shape, 0.3)
    posterior = Posterior(model, simulate(model, theta, 3.0, seed=seed), nuisances=nuisances)
    truth = posterior.start()
    truth[:12] = theta
    truth[posterior.parameter_names.index("background")] = 3.0
    return posterior, truth


@pytest.mark.slow
@pytest.mark.parametrize("case", ["scale", pytest.param("free, scattered, box", marks=LONG)])
def test_gradient_is_that_of_log_prob(psf: PSF, case: str) -> None:
    posterior, truth = make_posterior(psf, *CASES[case], 85)
    scale = errors(posterior, truth)
    params = truth + 0.5 * scale * np.random.default_rng(85).uniform(-1, 1, truth.size)
    numerical = [
        five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(truth.size)
    ]
    assert posterior.gradient(params) * scale == pytest.approx(
        np.array(numerical) * scale, rel=1e-6, abs=1e-6
    )


@nb.njit
def slopes_and_their_derivatives(profile: Any, a: float, b: float) -> Any:
    return psf_slopes(profile, a, b), psf_second_derivatives(profile, a, b)


@pytest.mark.slow
def test_second_derivatives_are_those_of_slopes(psf: PSF) -> None:
    """A family's methods return p, -p_a, -p_b, and then -p_a, -p_b, p_aa, p_ab, p_bb."""
    rng, step = np.random.default_rng(89), 1e-4
    for at in rng.uniform(-2.0, 2.0, (20, 2)):
        slopes, found = slopes_and_their_derivatives(psf.profile, *at)

        def of(point: Floats) -> Floats:
            return np.array(slopes_and_their_derivatives(psf.profile, *point)[0])

        p_a, p_b = (five_point(of, at, k, step) for k in range(2))
        assert slopes[1:] == pytest.approx([-p_a[0], -p_b[0]], abs=1e-9)
        assert found == pytest.approx([*slopes[1:], -p_a[1], -p_a[2], -p_b[2]], abs=1e-9)
        assert -p_b[1] == pytest.approx(found[3], abs=1e-9)


@pytest.mark.slow
def test_fisher_is_that_of_the_images(psf: PSF) -> None:
    """With the PSF's width among the parameters."""
    posterior, params = make_posterior(psf, *CASES["scale"], 86)
    scale = errors(posterior, params)
    columns = [
        five_point(posterior.expected_counts, params, k, STEP * scale[k]) * scale[k]
        for k in range(params.size)
    ]
    jacobian = np.stack(columns).reshape(params.size, -1)
    expected = jacobian / posterior.expected_counts(params).ravel() @ jacobian.T
    assert posterior.fisher(params) * np.outer(scale, scale) == pytest.approx(expected, abs=1e-7)


def test_width_is_that_of_a_wider_psf() -> None:
    wide = {"moffat": MoffatPSF(1.1 * 4.1, 2.6), "sampled": SampledPSF(lopsided(2.0), 4 / 1.1)}
    for kind, psf in KINDS.items():
        posterior, truth = make_posterior(psf, *CASES["scale"], 87)
        k = posterior.parameter_names.index("psf_sigma")
        truth[k] *= 1.1
        m = posterior.model
        wider = ForwardModel(m.detector, m.sources, wide[kind], m.distortion, tolerance=0.0)
        assert wider.psf.sigma == pytest.approx(truth[k], rel=1e-3)
        truth[k] = 1.1 * psf.sigma
        expected = wider.expected_counts(truth[:12], 3.0)
        assert posterior.expected_counts(truth) == pytest.approx(
            expected, rel=0, abs=1e-12 * expected.max()
        )


@pytest.mark.statistics
def test_refits_scatter_as_the_covariance_says(psf: PSF) -> None:
    """The mean of 20 Mahalanobis distances of 15 parameters, in its own Monte Carlo errors."""
    deviations, covariances = [], []
    for seed in range(20):
        posterior, truth = make_posterior(psf, *CASES["scale"], 100 + seed)
        estimate = find_map(posterior)
        assert estimate.at_maximum and estimate.fits_data
        deviations.append(estimate.params - truth)
        covariances.append(estimate.covariance)
    assert abs(excess(np.array(deviations), np.array(covariances))) < LIMIT
    # negative control: errors too small by a third
    assert excess(np.array(deviations), np.array(covariances) / 1.5**2) > LIMIT


def test_a_gaussian_fitted_to_a_moffat_is_noticed() -> None:
    posterior, _ = make_posterior(KINDS["moffat"], *CASES["scale"], 88)
    m = posterior.model
    wrong = Posterior(
        ForwardModel(m.detector, m.sources, GaussianPSF(m.psf.sigma), MIRRORED, tolerance=0.0),
        posterior.counts,
        nuisances=posterior.nuisances,
    )
    right, wrong_map = find_map(posterior), find_map(wrong)
    assert right.fits_data and not wrong_map.fits_data
    assert right.log_prob > wrong_map.log_prob + 100


# --------------------------------------------------------------------------------------------------
# Files


@pytest.mark.slow
def test_chain_files_hold_any_psf(psf: PSF, tmp_path: Path) -> None:
    posterior, _ = make_posterior(psf, *CASES["scale"], 89)
    chain = run(posterior, find_map(posterior), tmp_path / "chain.h5", steps=4, walkers=32)
    again = open_chain(chain.path).posterior()
    assert type(again.model.psf) is type(psf)
    draws = chain.chain.reshape(-1, posterior.n_parameters)[:5]
    assert np.array_equal(again.log_prob(draws), posterior.log_prob(draws))
    if isinstance(psf, SampledPSF):
        for name, value, words in HOSTILE:
            with h5py.File(chain.path, "a", libver="v110") as file:
                group = file["posterior/model/psf"]
                before = group.attrs["oversampling"], group["values"][()]
                if name == "values":
                    del group["values"]
                    group["values"] = value
                else:
                    group.attrs[name] = value
            reseal(chain.path)
            with pytest.raises(InputError, match=rf"chain\.h5: .*{words}") as caught:
                open_chain(chain.path).posterior()
            assert "\n" not in str(caught.value)
            with h5py.File(chain.path, "a", libver="v110") as file:
                group = file["posterior/model/psf"]
                group.attrs["oversampling"] = before[0]
                del group["values"]
                group["values"] = before[1]


def test_run_files_name_any_psf(tmp_path: Path) -> None:
    example = (Path(settings.__file__).parent / "example.toml").read_text(encoding="utf-8")
    assert example.count("sigma = 10.0") == 1
    run_file = tmp_path / "run.toml"

    def named(section: str) -> PSF:
        run_file.write_text(
            example.replace('kind = "gaussian"', "").replace("sigma = 10.0", section),
            encoding="utf-8",
        )
        return build.reference_psf(settings.read_settings(run_file), run_file)

    assert named("sigma = 2.5") == GaussianPSF(2.5)
    assert named('kind = "moffat"\nfwhm = 4.0\nbeta = 3.0') == MoffatPSF(4.0, 3.0)
    values = lopsided(2.0)
    values[0, 0] = -1e-3
    sampled = 'kind = "sampled"\npath = "psf.npy"\noversampling = 4'
    with pytest.raises(InputError, match=r"run\.toml: got 'psf\.npy', expected a file"):
        named(sampled)
    for array, words in (
        (values, None),
        (values[1:], r"psf: values: got shape \(96, 97\)"),
        (-values, "expected a positive one"),
        (np.where(values > 0.5, np.nan, values), "pixels that are not finite"),
    ):
        np.save(tmp_path / "psf.npy", array)
        if words is None:
            psf = named(sampled)
            assert (
                isinstance(psf, SampledPSF)
                and np.array_equal(psf.values, values)
                and psf.oversampling == 4.0
            )
        else:
            with pytest.raises(InputError, match=rf"psf\.npy: .*{words}"):
                named(sampled)


HOSTILE: list[tuple[str, Any, str]] = [
    ("values", np.zeros(9), r"values: got shape \(9,\)"),
    ("values", np.ones((4, 4)), r"values: got shape \(4, 4\), expected \(n, n\) with n odd"),
    ("values", np.ones((3, 5)), r"values: got shape \(3, 5\)"),
    ("values", np.ones((1003, 1003)), r"values: got shape \(1003, 1003\), expected .* 3 to 1001"),
    ("values", np.full((3, 3), np.nan), "values: got 9 that are not finite"),
    ("values", np.full((3, 3), 1e308), "values: got a sum of inf"),
    ("values", -np.ones((3, 3)), "values: got a sum of -9"),
    ("oversampling", 0.5, "oversampling: got 0.5"),
    ("oversampling", np.nan, "oversampling: got nan"),
    ("oversampling", 1e300, r"oversampling: got 1e\+300"),
    ("oversampling", np.zeros(3), "damaged"),
    ("oversampling", np.bytes_("four"), "damaged"),
]


def test_bad_psfs_are_refused() -> None:
    for name, value, words in HOSTILE:
        if words != "damaged":
            arguments = {"values": lopsided(2.0), "oversampling": 4, name: value}
            with pytest.raises(InputError, match=words):
                SampledPSF(**arguments)
    with pytest.raises(InputError, match="values: not numbers"):
        SampledPSF([["x"]], 4)  # type: ignore[arg-type]
    for fwhm, beta, words in (
        (0.0, 3.0, "fwhm"),
        (np.inf, 3.0, "fwhm"),
        (2.0, 1.0, "beta"),
        (2.0, np.nan, "beta"),
        (2.0, 101.0, "beta"),
    ):
        with pytest.raises(InputError, match=f"psf: {words}: got "):
            MoffatPSF(fwhm, beta)
    with pytest.raises(InputError, match="use pixel = 'box'"):
        ForwardModel(Detector(SHAPE), star(0.0, 0.0, 1.0), MoffatPSF(1.0, 3.0), MIRRORED)


# --------------------------------------------------------------------------------------------------
# Measuring a PSF


def spot(
    sigma: float,
    position: tuple[float, float],
    flux: float,
    background: float,
    pixel: str = "impulse",
) -> Floats:
    detector = Detector((71, 80), pixel=pixel)  # type: ignore[arg-type]
    return ForwardModel(
        detector, star(*position, flux), GaussianPSF(sigma), MIRRORED, tolerance=0.0
    ).expected_counts(np.zeros(12), background)


@pytest.mark.parametrize("sigma", [2.0, 3.0])
@pytest.mark.parametrize("oversampling", [1, 4, 5])
def test_measured_psf_is_the_true_one_without_noise(sigma: float, oversampling: int) -> None:
    """Aliases of a Gaussian are below exp(-pi^2 sigma^2 / 2) of its peak, 3e-9 at sigma 2; the
    window's border is below 4e-8."""
    position, half_width = (0.37, -1.45), round(6.5 * sigma)
    psf = SampledPSF.measured(
        spot(sigma, position, 1e4, 7.0),
        position,
        half_width,
        background=7.0,
        oversampling=oversampling,
    )
    n = (len(psf.values) - 1) // 2
    assert n == (2 * half_width - 1) * oversampling // 2
    a = np.arange(-n, n + 1) / oversampling
    true = 1e4 * GaussianPSF(sigma).density(a, a[:, None])
    assert psf.values == pytest.approx(true, rel=0, abs=1e-7 * true.max())
    # negative control: measured around a point 0.01 pixel away it is not
    off = SampledPSF.measured(
        spot(sigma, position, 1e4, 7.0),
        (0.38, -1.45),
        half_width,
        background=7.0,
        oversampling=oversampling,
    )
    assert np.abs(off.values - true).max() > 1e-3 * true.max()
    if oversampling > 1:
        fine = np.linspace(-3 * sigma, 3 * sigma, 57)
        exact = GaussianPSF(sigma).density(fine, fine[:, None])
        assert psf.density(fine, fine[:, None]) == pytest.approx(
            exact, rel=0, abs=(2 / sigma) ** 4 * 5e-6 * exact.max()
        )


def test_measured_psf_s_noise_is_that_of_the_counts() -> None:
    """Chi-square of samples one pixel apart in 100 frames, against the variances that a shift by
    Fourier gives them."""
    position, half_width, background = (0.5 + 0.37, -0.21), 15, 20.0
    mean = spot(2.0, position, 1e5, background)
    n = 2 * half_width + 1
    window = mean[35 - half_width : 35 + half_width + 1, 40 - half_width : 40 + half_width + 1]
    turns = 2j * np.pi * np.fft.fftfreq(n)[:, None]
    squares = [
        np.fft.ifft(np.exp(turns * by) * np.fft.fft(np.eye(n), axis=0), axis=0).real ** 2
        for by in (0.37, -0.21)
    ]
    variance = squares[1] @ window @ squares[0].T
    at = np.arange(-14, 15)
    true = 1e5 * GaussianPSF(2.0).density(at, at[:, None])
    rng, chi2 = np.random.default_rng(90), []
    for _ in range(100):
        psf = SampledPSF.measured(rng.poisson(mean), position, half_width, background=background)
        z = (psf.values[2:-2:4, 2:-2:4] - true) / np.sqrt(variance[1:-1, 1:-1])
        chi2.append(np.mean(z**2))
    error = np.std(chi2) / 10  # 0.5 %
    assert abs(np.mean(chi2) - 1) < LIMIT * error
    # negative control: the variance of the nearest pixel in place of it is noticed
    nearest = np.mean(chi2) * np.mean(variance[1:-1, 1:-1] / window[1:-1, 1:-1])
    assert abs(nearest - 1) > LIMIT * error


def test_pixels_are_taken_out_of_the_frame_before_a_psf_is_measured() -> None:
    position = (0.2, -0.3)
    boxed = spot(2.0, position, 1e4, 0.0, "box")
    a = np.arange(-20, 21) / 4
    true = GaussianPSF(2.0).density(a, a[:, None])
    right = SampledPSF.measured(correct_sampling(boxed), position, 13).density(a, a[:, None])
    blurred = SampledPSF.measured(boxed, position, 13).density(a, a[:, None])
    assert right == pytest.approx(true, rel=0, abs=1e-5 * true.max())
    assert np.abs(blurred - true).max() > 1e-2 * true.max()


@pytest.mark.parametrize(
    ("position", "half_width", "words"),
    [
        ((30.0, 0.0), 15, "window within"),
        ((np.nan, 0.0), 15, "window within"),
        ((0.0, 0.0), 0, "at least 1"),
        ((0.0, 0.0), 15, "sum of"),
    ],
)
def test_spots_that_cannot_be_measured_are_refused(
    position: tuple[float, float], half_width: int, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        SampledPSF.measured(np.zeros((71, 80)), position, half_width)
    with pytest.raises(InputError, match="two dimensions"):
        SampledPSF.measured(np.zeros(71), position, half_width)


def test_width_is_that_of_the_gaussian_as_wide_at_half_maximum() -> None:
    assert MoffatPSF(3.0, 2.5).sigma == 3.0 / FWHM
    assert MoffatPSF(3.0, 2.5).density(1.5, 0.0) == pytest.approx(
        0.5 * MoffatPSF(3.0, 2.5).peak, rel=1e-14
    )
    x = np.arange(-60, 61) / 6
    for true in (MoffatPSF(3.0, 2.5), GaussianPSF(1.2)):
        assert SampledPSF(true.density(x, x[:, None]), 6).sigma == pytest.approx(
            true.sigma, rel=2e-3
        )
