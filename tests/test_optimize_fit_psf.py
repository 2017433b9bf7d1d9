"""The PSF that is measured on a frame, against known ones."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage

import bayesfred as bf
from bayesfred.model.added_errors import added_draws
from bayesfred.model.kernels.psf_normal import psf_information, psf_slope, sample_psf
from bayesfred.model.kernels.psf_samples import SourceSamples
from bayesfred.model.psf_errors import PsfErrors
from bayesfred.optimize import psf_start
from bayesfred.optimize.fit_psf import find_psf
from bayesfred.optimize.psf_equations import PsfEquations, PsfInformation, observed
from bayesfred.optimize.psf_levels import PsfGrid
from bayesfred.optimize.psf_marginal import occam_factor, shared_information
from bayesfred.optimize.psf_samples import PsfSamples
from bayesfred.optimize.psf_start import starting_grid, starting_state
from bayesfred.optimize.psf_turns import solved

LINEAR = bf.PolynomialDistortion.polynomial(1)


def cubic(x):
    """The cubic B-spline, by its definition as a truncated power."""
    powers = [np.maximum(x + 2.0 - k, 0.0) ** 3 for k in range(5)]
    return sum(c * p for c, p in zip((1, -4, 6, -4, 1), powers, strict=True)) / 6.0


def dense_design(levels, field, samples):
    """p of every sample as a linear function of the coefficients, by loops."""
    last = len(levels.side) - 1
    size = levels.start[last] + levels.side[last] ** 2 * (levels.high[last] - levels.low[last])
    out = np.zeros((len(samples.a), size))
    for n, (s, a, b) in enumerate(zip(samples.source, samples.a, samples.b, strict=True)):
        for k, side in enumerate(levels.side):
            terms, h = levels.high[k] - levels.low[k], levels.spacing[k]
            for j in range(side):
                for i in range(side):
                    middle = 0.5 * (side - 1)
                    value = cubic(a / h + middle - i) * cubic(b / h + middle - j)
                    at = levels.start[k] + (j * side + i) * terms
                    out[n, at : at + terms] = value * field[s, levels.low[k] : levels.high[k]]
    return out


def crowded(rng, n_pixels=40, n_sources=3):
    """Samples of sources that share pixels, some beyond the grids."""
    first = np.concatenate([[0], np.cumsum(rng.integers(1, n_sources + 1, n_pixels))])
    size = first[-1]
    source = rng.integers(0, n_sources, size)
    a, b = rng.uniform(-6.0, 6.0, (2, size))
    return SourceSamples(first, source, a, b, rng.uniform(0.9, 1.1, size))


@pytest.mark.slow
@pytest.mark.parametrize(("degree", "wings"), [(1, True), (1, False), (0, True), (0, False)])
def test_information_and_slope_agree_with_a_dense_design_matrix(degree, wings):
    rng = np.random.default_rng(1)
    grid = PsfGrid(1.3, 0.8, degree, 5.6, 16.8 if wings else 0.0)
    samples = crowded(rng)
    field = np.column_stack([np.ones(3), rng.normal(size=(3, 2 * degree))])
    levels, n = grid.unknown, len(samples.first) - 1
    design = dense_design(levels, field, samples)
    flux, weight = rng.uniform(1.0, 2.0, 3), rng.uniform(0.0, 1.0, n)
    residual, background = rng.normal(size=n), rng.normal(size=(n, 2))
    templates = rng.normal(size=(3, len(samples.a)))
    owner = np.repeat(np.arange(n), np.diff(samples.first))
    rows = np.zeros((n, design.shape[1]))
    np.add.at(rows, owner, design * (flux[samples.source] * samples.size)[:, None])
    light = np.zeros((n, 9))
    for m in range(3):
        np.add.at(light, (owner, 3 * samples.source + m), templates[m])
    half, coupling, others = psf_information(
        levels, field, samples, (flux, weight, background), templates
    )
    slope = psf_slope(levels, field, samples, flux, weight * residual)
    weighed = rows.T * weight
    np.testing.assert_allclose(half + half.T, weighed @ rows, atol=1e-11)
    np.testing.assert_allclose(coupling.T, weighed @ light, atol=1e-11)
    np.testing.assert_allclose(others, weighed @ background, atol=1e-11)
    np.testing.assert_allclose(slope, weighed @ residual, atol=1e-11)
    coefficients = rng.normal(size=design.shape[1])
    p, p_a, p_b = sample_psf(levels, field, samples, coefficients)
    np.testing.assert_allclose(p, design @ coefficients, atol=1e-11)
    step = 1e-6
    for slope, key in ((p_a, "a"), (p_b, "b")):
        moved = [
            sample_psf(levels, field, samples._replace(**{key: getattr(samples, key) + h}),
                       coefficients)[0]
            for h in (step, -step)
        ]  # fmt: skip
        np.testing.assert_allclose(slope, (moved[0] - moved[1]) / (2 * step), atol=1e-8)


@pytest.mark.parametrize(
    "distortion",
    [bf.PolynomialDistortion.full_polynomial(3), bf.PolynomialDistortion.zernike(3)],
    ids=["general", "zernike"],
)
def test_samples_are_those_that_loops_over_pixels_find(distortion):
    rng = np.random.default_rng(5)
    sources = bf.SourceCatalog([-8.0, -5.0, 9.1], [3.3, 4.0, -6.7], [1e3, 1e3, 1e3])
    model = bf.ForwardModel(bf.Detector((31, 33)), sources, bf.GaussianPSF(1.5), distortion)
    mask = rng.random((31, 33)) < 0.8
    nuisances = bf.Nuisances(flux="free", offset=True)
    posterior = bf.Posterior(model, np.full(mask.shape, 9.0), mask=mask, nuisances=nuisances)
    params = posterior.start()
    design = model.polynomial.design_matrix(*(np.array([9.0]),) * 4)
    params[: design.shape[-1]] = 0.02 * rng.normal(size=design.shape[-1]) / np.abs(design).max()
    names = posterior.parameter_names
    params[names.index("offset_x")], params[names.index("offset_y")] = 0.3, -0.6
    shifts, theta = rng.normal(scale=0.2, size=(3, 2)), params[: distortion.n_terms]
    data, radius, expected = PsfSamples.at(posterior, params, shifts, 5.0), 5.0, []
    for row, column in np.argwhere(mask):
        for s, (x, y) in enumerate(zip(sources.x, sources.y, strict=True)):
            u, v = column - 16.0, row - 15.0
            f, g = distortion.displacement(theta, u, v, x, y)
            a, b = u - x + f - 0.3 - shifts[s, 0], v - y + g + 0.6 - shifts[s, 1]
            if np.hypot(a, b) <= radius:
                size = abs(distortion.determinant(theta, u, v, x, y))
                expected.append((row * 33 + column, s, a, b, size))
    samples = data.samples
    found = (data.pixel[data.owner], samples.source, samples.a, samples.b, samples.size)
    assert len(expected) > 150
    np.testing.assert_allclose(np.stack(found, axis=1), expected, atol=1e-12)
    assert sorted(data.pixel) == sorted(np.flatnonzero(mask))


def test_the_grids_together_are_one_fine_grid():
    rng = np.random.default_rng(2)
    grid = PsfGrid(4.0, 0.7, 2, 4.9, 14.7)
    c = rng.normal(size=grid.conventions.shape[1])
    psf = grid.combined(c)
    n = psf.shape[-1]
    x = np.arange(n) - 0.5 * (n - 1)
    a, b = rng.uniform(-4.0, 4.0, (2, 30))
    field = np.column_stack([np.ones(2), rng.normal(size=(2, 5))])
    source = rng.integers(0, 2, 30)
    samples = SourceSamples(np.arange(31), source, a, b, np.ones(30))
    one = np.einsum("st,tji->sji", field, psf)[source]
    expected = np.einsum(
        "sji,sj,si->s", one, cubic(b[:, None] * 4.0 - x), cubic(a[:, None] * 4.0 - x)
    )
    np.testing.assert_allclose(sample_psf(grid.levels, field, samples, c)[0], expected, atol=1e-12)


def frame_of(psf, fwhm, *, side=6, seed=1, pixel="box"):
    """A frame of stars at random places near a grid, and a posterior with a Gaussian PSF."""
    rng = np.random.default_rng(seed)
    spacing = max(6.0 * fwhm, 10.0)
    grid = bf.SourceCatalog.grid(side, spacing, 1e5)
    jitter = rng.uniform(-0.5, 0.5, (2, len(grid)))
    sources = bf.SourceCatalog(grid.x + jitter[0], grid.y + jitter[1], grid.flux)
    size = int(spacing * (side + 1)) | 1
    d = bf.PolynomialDistortion.polynomial(1)
    model = bf.ForwardModel(bf.Detector((size, size), pixel=pixel), sources, psf, d)
    theta = 1e-3 * rng.normal(size=d.n_terms) * (np.arange(d.n_terms) < 2)
    counts = bf.simulate(model, theta, 5.0, seed=seed)
    start = replace(model, psf=bf.GaussianPSF(fwhm / 2.3548))
    nuisances = bf.Nuisances(flux="free", offset=True, psf_sigma=True)
    return model, theta, bf.Posterior(start, counts, nuisances=nuisances)


def in_pixels(psf, a, b):
    """A PSF integrated over pixels, on a grid of points, by the midpoint rule."""
    offsets = (np.arange(25) - 12.0) / 25.0
    u, v = np.asarray(a)[..., None, None] + offsets, np.asarray(b)[..., None, None]
    return psf.density(u, v + offsets[:, None]).mean(axis=(-1, -2))


def z_of(measured, true, a, b, **at):
    """The error of a measured PSF at some points in units of its own."""
    drawn = np.array([draw.density(a, b, **at) for draw in measured.drawn()])
    return (measured.density(a, b, **at) - true) / drawn.std(axis=0)


def donut():
    """A pupil's image, blurred: a ring of 4 pixels across."""
    x = np.arange(-60, 61) / 6.0
    r = np.hypot(x, x[:, None])
    return bf.SampledPSF(np.exp(-0.5 * ((r - 2.0) / 0.8) ** 2), 6.0)


@pytest.mark.parametrize(
    ("psf", "fwhm"),
    [
        pytest.param(bf.GaussianPSF(0.5), 1.18, marks=pytest.mark.slow),
        (bf.MoffatPSF(3.0, 4.765), 3.0),
        (donut(), 5.0),
    ],
    ids=["undersampled Gaussian", "Moffat", "donut"],
)
def test_a_known_psf_is_recovered_to_its_errors(psf, fwhm):
    _, _, posterior = frame_of(psf, fwhm)
    measured = bf.fit_psf(posterior, bf.find_map(posterior))
    assert measured.model_error == 0.0
    x = np.linspace(-fwhm, fwhm, 13)
    true = in_pixels(psf, x + 0.0 * x[:, None], x[:, None] + 0.0 * x)
    z = z_of(measured, true, x, x[:, None])
    # some tens of independent numbers: the rms scatters by about 0.15
    assert 0.3 < np.sqrt(np.mean(z**2)) < 1.5
    assert np.abs(measured.density(x, x[:, None]) - true).max() < 0.02 * true.max()


def defocused(seed):
    """A disc with sharp edges, a pinhole's image out of focus, on sources of all pixel phases."""
    x = np.arange(-64, 65) / 16.0
    disc = ndimage.gaussian_filter((np.hypot(x, x[:, None]) < 2.5).astype(float), 0.3 * 16.0)
    model = bf.ForwardModel(
        bf.Detector((260, 260), pixel="box"), bf.SourceCatalog.grid(11, 21.37, 2e5),
        bf.SampledPSF(disc, 16.0), bf.PolynomialDistortion.polynomial(1),
    )  # fmt: skip
    theta = np.array([1e-3, -5e-4, 4e-4, 2e-4])
    counts = bf.simulate(model, theta, 50.0, seed=seed)
    start = replace(model, psf=bf.GaussianPSF(1.5))
    return theta, bf.Posterior(start, counts, nuisances=bf.Nuisances(flux="free", offset=True))


def off_by(seed):
    """The errors of the distortion in units of their own, and whether the model fits."""
    theta, posterior = defocused(seed)
    _, estimate = bf.measure_psf(posterior, bf.find_map(posterior))
    z = (estimate.params - np.append(theta, np.zeros(len(estimate.params) - 4)))[:4]
    return z / np.sqrt(np.diag(estimate.covariance))[:4], estimate.fits_data


@pytest.mark.slow
def test_sharp_edges_are_resolved(monkeypatch):
    _, fits = off_by(0)
    assert fits
    # with the knots of a smooth PSF of that width the frame does not fit
    monkeypatch.setattr(psf_start, "SHARP", 1.0)
    assert not off_by(0)[1]


@pytest.mark.statistics
@pytest.mark.parametrize("sharp", [None, 1.0], ids=["as it is", "knots of a smooth PSF"])
def test_errors_hold_for_a_defocused_psf(sharp, monkeypatch):
    if sharp:
        monkeypatch.setattr(psf_start, "SHARP", sharp)
    z = np.array([off_by(seed)[0] for seed in range(24)])
    # 96 numbers: the mean square scatters by sqrt(2 / 96) = 0.14
    holds = abs(np.mean(z**2) - 1.0) < 3.0 * np.sqrt(2.0 / z.size)
    assert holds == (sharp is None), np.mean(z**2)


def comatic():
    """A Gaussian with the pixel in it, and coma that grows outward but moves no centroid."""
    x = np.arange(-24, 25) / 4.0
    a, b = x + 0.0 * x[:, None], x[:, None] + 0.0 * x
    sigma = 1.2
    core = np.exp(-0.5 * (a**2 + b**2) / sigma**2)
    coma = 0.15 * core**1.5 * ((a**2 + b**2) / sigma**2 - 1.6) * np.stack([a, b]) / sigma
    return bf.MeasuredPSF(np.stack([core, *coma]), 4.0, 60.0)


@pytest.mark.slow
def test_coma_that_grows_outward_is_recovered_only_by_a_psf_that_varies():
    true = comatic()
    _, _, posterior = frame_of(true, 2.8, pixel="impulse")
    estimate = bf.find_map(posterior)
    constant, varying = (bf.fit_psf(posterior, estimate, degree=k) for k in (0, 1))
    assert constant.model_error > 0.02 and varying.model_error < 0.01
    x = np.linspace(-3.0, 3.0, 13)
    for at in ((-40.0, 30.0), (35.0, 35.0)):
        expected = true.density(x, x[:, None], at=at)
        off = [np.abs(psf.density(x, x[:, None], at=at) - expected).max() / true.peak
               for psf in (varying, constant)]  # fmt: skip
        # the variation's grid, a third of the FWHM apart, cannot hold more of so sharp a coma
        assert off[0] < 0.03 and off[1] > 2.0 * off[0], off


def test_wings_that_vary_over_the_field_are_recovered():
    """At 6 widths: what varies reaches as far out as what does not."""
    x, sigma = np.arange(-26, 27) / 4.0, 0.8
    a, b = x + 0.0 * x[:, None], x[:, None] + 0.0 * x
    core = np.exp(-0.5 * (a**2 + b**2) / sigma**2)
    ring = 0.02 * np.exp(-(((np.hypot(a, b) - 4.8) / 0.6) ** 2))
    turned = ring * np.cos(2.0 * np.arctan2(b, a))
    true = bf.MeasuredPSF(np.stack([core + 1.2 * ring, turned, 0.0 * ring]), 4.0, 40.0)
    _, _, posterior = frame_of(true, 2.3548 * sigma, pixel="impulse")
    measured = bf.fit_psf(posterior, bf.find_map(posterior), degree=1)
    along, across = np.array([4.8, -4.8, 0.0, 0.0]), np.array([0.0, 0.0, 4.8, -4.8])
    expected, found = (
        psf.density(along, across, at=(35.0, 0.0)) - psf.density(along, across, at=(-35.0, 0.0))
        for psf in (true, measured)
    )
    assert np.abs(expected).min() > 0.01 * true.peak
    np.testing.assert_allclose(found, expected, rtol=0.2)


def began(posterior, estimate, degree):
    return starting_state(posterior, estimate, starting_grid(posterior, estimate, 4.0, degree))


@pytest.mark.long
def test_errors_of_the_psf_are_those_of_a_joint_fit():
    """The former come from draws of the PSF, the joint fit from one matrix."""
    _, _, posterior = frame_of(bf.MoffatPSF(1.2, 4.765), 1.2, side=4)
    estimate = bf.find_map(posterior)
    measured, known = bf.measure_psf(posterior, estimate)
    equations = solved(posterior, began(posterior, estimate, 0))
    size = equations.state.deviations.size
    kept = [size + k for k, name in enumerate(posterior.parameter_names)
            if name in measured.parameter_names and name != "background"]  # fmt: skip
    joint = equations.draws(20_000)[kept].std(axis=1)
    own = [k for k, name in enumerate(measured.parameter_names) if name != "background"]
    marginal = np.sqrt(np.diag(known.covariance))[own]
    conditional = np.linalg.inv(measured.information(known.params))
    widening = marginal / np.sqrt(np.diag(conditional))[own]
    # 100 draws know what is added to a variance to 14 %
    np.testing.assert_allclose(marginal, joint, rtol=0.1)
    # draws have them too: 4,000 know a standard deviation to 1.1 %
    drawn = bf.laplace(measured, known, seed=1, draws=4000, progress=False)
    np.testing.assert_allclose(drawn.draws().std(axis=0)[own], marginal, rtol=0.05)
    fixed = drawn.chain.reshape(4000, -1)[:, own].std(axis=0)
    np.testing.assert_allclose(fixed, np.sqrt(np.diag(conditional))[own], rtol=0.05)
    assert np.all(widening > 1.02) and widening.max() > 1.2


@pytest.mark.slow
def test_conventions_of_volume_and_centroid():
    _, _, posterior = frame_of(bf.MoffatPSF(3.0, 4.765), 3.0, side=5)
    estimate = bf.find_map(posterior)
    psf = bf.fit_psf(posterior, estimate, degree=1)
    n, h = psf.coefficients.shape[-1], 1.0 / psf.oversampling
    x = (np.arange(n) - 0.5 * (n - 1)) * h
    np.testing.assert_allclose(psf.coefficients.sum(axis=(1, 2)) * h * h, [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(psf.draws.sum(axis=(2, 3)) * h * h, 100 * [[1, 0, 0]], atol=1e-9)
    sigma = math.hypot(estimate.params[posterior.parameter_names.index("psf_sigma")], 12**-0.5)
    window = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / sigma**2)
    for axis in (x, x[:, None]):
        centroids = (psf.coefficients * window * axis).sum(axis=(1, 2)) * h * h
        np.testing.assert_allclose(centroids, 0.0, atol=1e-9)


def test_conventions_are_those_of_all_grids_combined():
    """Grids of 1, 2 and 8 fine knots have them, so it does not matter which has what."""
    grid = PsfGrid(4.0, 1.3, 1, 6.0, wings=12.0)
    c = np.random.default_rng(1).normal(size=grid.conventions.shape[1])
    terms, h = grid.combined(c), 1.0 / grid.oversampling
    x = (np.arange(terms.shape[1]) - 0.5 * (terms.shape[1] - 1)) * h
    window = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / grid.sigma**2)
    rows = np.stack([np.ones_like(window), x * window, x[:, None] * window])
    expected = np.tensordot(terms, rows, ((1, 2), (1, 2))) * h * h
    np.testing.assert_allclose((grid.conventions @ c).reshape(3, 3), expected, rtol=1e-9)


def test_the_psf_leaves_pixels_that_tell_the_background():
    """Within footprints of 5 pixels it ends before; without them 7 widths from its middle."""
    sources = bf.SourceCatalog.grid(7, 12.0, 1e5)
    model = bf.ForwardModel(
        bf.Detector((97, 97), pixel="box"), sources, bf.GaussianPSF(1.3),
        bf.PolynomialDistortion.polynomial(1),
    )  # fmt: skip
    counts = bf.simulate(model, np.zeros(4), 100.0, seed=1)
    radii = []
    for footprint in (5.0, None):
        nuisances = bf.Nuisances(flux="free", offset=True, footprint=footprint)
        posterior = bf.Posterior(model, counts, nuisances=nuisances)
        psf = bf.fit_psf(posterior, bf.find_map(posterior))
        radii.append(0.5 * (psf.coefficients.shape[-1] - 1) / psf.oversampling)
        assert abs(psf.sigma - math.hypot(1.3, 12**-0.5)) < 0.02
    # a tenth of a disk's pixels lie beyond 0.95 of its radius; a grid ends at a whole knot
    np.testing.assert_allclose(radii[0], 0.95 * 5.0, atol=0.5)
    assert radii[1] > 6.5  # the middle between four stars is 8.5 pixels from them


@pytest.mark.parametrize("wings", [7.0, 8.54, 11.3, 15.0, 30.0])
def test_wings_end_where_pixels_tell_the_background(wings):
    """To half a knot; the equations see all of them along an axis."""
    grid = PsfGrid(4.0, 1.5, 0, 6.0, wings)
    c, level = np.zeros(grid.conventions.shape[1]), grid.levels
    c[level.start[-1] :] = 1.0
    psf = bf.MeasuredPSF(grid.combined(c), grid.oversampling, 100.0)
    a = np.arange(0.0, 40.0, 0.01)
    last = a[psf.density(a, 0.0) > 1e-9 * psf.density(0.0, 0.0)].max()
    assert last <= grid.radius < last + 0.05
    assert abs(last - wings) < 0.5 * level.spacing[-1] + 0.05


def test_what_a_psf_adds_is_that_of_a_joint_fit():
    """Against Schur's complement, of a posterior that is normal in parameters and PSF."""
    rng = np.random.default_rng(3)
    half = rng.normal(size=(7, 9))
    joint = half @ half.T
    i, k, c = joint[:3, :3], joint[:3, 3:], joint[3:, 3:]
    marginal = np.linalg.inv(c - k.T @ np.linalg.inv(i) @ k)
    draws = rng.multivariate_normal(np.zeros(4), marginal, 20_000)
    errors = PsfErrors.of(("a", "b", "c"), i, np.cov(k @ draws.T))
    schur = np.linalg.inv(i - k @ np.linalg.inv(c) @ k.T)
    np.testing.assert_allclose(np.linalg.inv(i) + errors.covariance, schur, rtol=0.02, atol=2e-3)
    moved = added_draws(errors.covariance, 20_000, 1)
    np.testing.assert_allclose(np.cov(moved.T), errors.covariance, rtol=0.1)
    np.testing.assert_array_equal(moved, added_draws(errors.covariance, 20_000, 1))
    assert not np.any(moved == added_draws(errors.covariance, 20_000, 2))
    scale = PsfErrors.of(("a", "b", "position_scatter"), i, np.cov(k @ draws.T))
    assert not np.any(scale.covariance[2]) and np.all(np.diag(scale.covariance)[:2] > 0.0)


@pytest.mark.slow
def test_what_a_psf_shares_with_parameters_is_the_slope_of_their_gradient():
    """Of counts without noise, whose residuals do not change with the PSF's slopes."""
    _, _, posterior = frame_of(bf.MoffatPSF(3.0, 4.765), 3.0, side=4)
    psf, state, drawn = find_psf(posterior, bf.find_map(posterior), 4, 1, 0)
    bare = posterior.with_psf(psf)
    params = bf.find_map(bare).params
    bare = replace(bare, counts=bare.expected_counts(params))

    def gradient(deviations):
        coefficients = state.grid.combined(state.deviating(state.deviations + deviations))
        return bare.with_psf(replace(psf, coefficients=coefficients, draws=None)).gradient(params)

    differences = np.array([gradient(0.1 * d) - gradient(-0.1 * d) for d in drawn[:4]]) / -0.2
    size = np.sqrt(np.diag(bare.information(params)))
    found = drawn[:4] @ shared_information(bare, state, params)
    np.testing.assert_allclose(found / size, differences / size, atol=0.01)
    assert np.abs(found / size).max() > 0.5
    fixed = replace(bare, nuisances=replace(bare.nuisances, flux="fixed"))
    alone = drawn[:4] @ shared_information(fixed, state, params)
    assert not np.allclose(alone / size, differences / size, atol=0.01)


@pytest.mark.slow
def test_volume_of_a_psf_grows_with_the_model_error_as_its_information_falls():
    """Against tr(A^-1 dA / d eps), by draws: 4,000 know the traces to some per cent."""
    _, _, posterior = frame_of(bf.MoffatPSF(3.0, 4.765), 3.0, side=4)
    psf, state, _ = find_psf(posterior, bf.find_map(posterior), 4, 1, 0)
    bare = posterior.with_psf(psf)
    bare = replace(bare, nuisances=replace(bare.nuisances, model_error=True))
    params = np.append(bf.find_map(posterior.with_psf(psf)).params, 0.0)
    params[bare.parameter_names.index("model_error")] = error = 0.05
    assert bare.parameter_names[-1] == "model_error"
    state = replace(state, params=params)
    data = PsfSamples.at(bare, params, state.shifts, state.grid.radius)

    def at(share):
        pixels = observed(bare, state, data, share, math.inf)
        return PsfInformation.of(bare, state, pixels)

    def whole(matrix):
        return np.tril(matrix) + np.tril(matrix, -1).T

    h = 0.02 * error
    slope = (whole(at(error + h).matrix) - whole(at(error - h).matrix)) / (2.0 * h)
    known, size = at(error), state.deviations.size
    equations = PsfEquations(state, known, np.zeros(len(known.matrix)), np.zeros(0), error)
    drawn = equations.draws(4000)
    own = slope[size:, size:]
    joint = np.sum(drawn * (slope @ drawn)) / 4000
    expected = -0.5 * (joint - np.trace(np.linalg.solve(whole(known.matrix)[size:, size:], own)))
    factor = occam_factor(bare, state, params)
    assert expected * error > 5.0
    assert abs(factor.slope(error) / expected - 1.0) < 0.1


@pytest.mark.long
def test_positions_that_scatter_are_sampled_with_a_measured_psf():
    """Where stars scatter, what is lost to the PSF shrinks too: a constant loss once won over them.

    Then walkers left for a scatter of many times the true one, and a fifth of their moves was
    accepted.
    """
    model, theta, given = frame_of(bf.MoffatPSF(1.2, 4.765), 1.2, side=6)
    rng = np.random.default_rng(2)
    s = model.sources
    moved = bf.SourceCatalog(*(np.stack([s.x, s.y]) + 0.01 * rng.normal(size=(2, len(s)))), s.flux)
    counts = bf.simulate(replace(model, sources=moved), theta, 5.0, seed=2)
    nuisances = replace(given.nuisances, position_scatter=True)
    posterior = bf.Posterior(given.model, counts, nuisances=nuisances)
    posterior, estimate = bf.measure_psf(posterior, bf.find_map(posterior))
    chain = bf.sample(posterior, estimate, seed=1, steps=100, progress=False)
    assert chain.accepted.mean() > 0.5 * 100
    draws, k = chain.draws(), posterior.parameter_names.index("position_scatter")
    assert 0.005 < np.median(draws[:, k]) < 0.02
    raw = chain.chain[:, chain.burn_in :].reshape(draws.shape)
    added = draws.var(axis=0) / raw.var(axis=0) - 1.0
    assert added[k] == 0.0 and np.all((added[:4] > 0.01) & (added[:4] < 1.0))
    claimed = np.sqrt(np.diag(estimate.covariance))[:4]
    np.testing.assert_allclose(draws.std(axis=0)[:4], claimed, rtol=0.35)
    assert np.all(np.abs(draws.mean(axis=0)[:4] - theta) < 4.5 * claimed)


def varying_model(rng):
    c = rng.normal(size=(3, 13, 13)) * 0.01
    x = np.arange(-6, 7) / 3.0
    c[0] += np.exp(-0.5 * (x**2 + x[:, None] ** 2))
    psf = bf.MeasuredPSF(c, 3.0, 20.0)
    sources = bf.SourceCatalog([-8.0, 5.2, 9.1], [3.3, -6.7, 4.0], [1e3, 2e3, 3e3])
    d = bf.PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 0)])
    return bf.ForwardModel(bf.Detector((31, 33)), sources, psf, d, tolerance=0.0), [1e-3, -2e-3]


@pytest.mark.slow
def test_a_psf_that_varies_over_the_field_is_rendered_as_its_definition_says():
    model, theta = varying_model(np.random.default_rng(4))
    d, s, psf = model.distortion, model.sources, model.psf
    u, v = model.detector.pixel_centres()
    u, v = np.broadcast_arrays(u, v[:, None])
    expected = np.zeros(model.detector.shape)
    x = np.arange(13) - 6.0
    for star in zip(s.x, s.y, s.flux, strict=True):
        c = np.tensordot([1.0, star[0] / 20.0, star[1] / 20.0], psf.coefficients, 1)
        f, g = d.displacement(theta, u, v, *star[:2])
        a, b = 3.0 * (u - star[0] + f), 3.0 * (v - star[1] + g)
        p = np.einsum("ji,vuj,vui->vu", c, cubic(b[..., None] - x), cubic(a[..., None] - x))
        expected += star[2] * p * np.abs(d.determinant(theta, u, v, *star[:2]))
    # the oracle's truncated powers cancel to 1e-11 of a peak of some thousand
    np.testing.assert_allclose(model.expected_counts(theta), expected, atol=1e-7)
    steps = np.diag([1e-6, 1e-6])
    slopes = [
        (model.expected_counts(theta + e) - model.expected_counts(theta - e)) / 2e-6 for e in steps
    ]
    np.testing.assert_allclose(model.jacobian(theta), slopes, atol=1e-4 * np.abs(slopes).max())


@pytest.mark.long
def test_gradient_and_information_with_a_psf_that_varies():
    model, theta = varying_model(np.random.default_rng(4))
    counts = bf.simulate(model, theta, 20.0, seed=1)
    posterior = bf.Posterior(model, counts, nuisances=bf.Nuisances(flux="free", offset=True))
    at = np.array([*theta, 20.0, 0.01, -0.02])[
        [["f_ux", "g_y", "background", "offset_x", "offset_y"].index(n)
         for n in posterior.parameter_names]]  # fmt: skip
    errors = np.diag(np.linalg.inv(posterior.information(at))) ** 0.5
    slopes = [
        (posterior.log_prob(at + e) - posterior.log_prob(at - e)) / (2e-4 * s)
        for e, s in zip(1e-4 * np.diag(errors), errors, strict=True)
    ]
    np.testing.assert_allclose(posterior.gradient(at) * errors, slopes * errors, atol=1e-5)


def test_bad_psfs_are_refused_in_one_line():
    good = np.ones((1, 5, 5))
    for coefficients, oversampling, radius in (
        (np.ones((2, 5, 5)), 2.0, 1.0), (np.ones((1, 4, 4)), 2.0, 1.0), (np.nan * good, 2.0, 1.0),
        (-good, 2.0, 1.0), (good, 0.5, 1.0), (good, 2.0, 0.0),
    ):  # fmt: skip
        with pytest.raises(bf.InputError, match="psf: "):
            bf.MeasuredPSF(coefficients, oversampling, radius)
    psf = bf.MeasuredPSF(good, 2.0, 1.0)
    sources = bf.SourceCatalog([0.0], [0.0], [1e3])
    with pytest.raises(bf.InputError, match="has the pixel's response in it"):
        bf.ForwardModel(bf.Detector((9, 9), pixel="box"), sources, psf, LINEAR)


def fitted_errors(fwhm, frames):
    """Errors over claimed errors of frames fitted with their PSF measured, and with a Gaussian."""
    measured, gaussian = [], []
    for seed in range(frames):
        model, theta, posterior = frame_of(bf.MoffatPSF(fwhm, 4.765), fwhm, seed=seed)
        truth = dict(zip(model.distortion.names, theta, strict=True))
        estimate = bf.find_map(posterior)
        for kept, known, out in (
            (posterior, estimate, gaussian),
            (*bf.measure_psf(posterior, estimate), measured),
        ):
            errors = np.sqrt(np.diag(known.covariance))
            rows = zip(kept.parameter_names, known.params, errors, strict=True)
            names = (*truth, "offset_x", "offset_y")
            out.append([(value - truth.get(n, 0.0)) / e for n, value, e in rows if n in names])
    return np.abs(measured), np.abs(gaussian)


@pytest.mark.statistics
@pytest.mark.parametrize("fwhm", [1.2, 3.0])
def test_coverage_with_a_psf_that_was_measured(fwhm):
    """Of 200 frames with 36 stars: 1,200 z-scores know 68 % to 1.3 %, and 95 % to 0.6 %.

    The errors of a Gaussian of the best width are the control; it is too easily right of stars
    that are well sampled.
    """
    measured, gaussian = fitted_errors(fwhm, 200)
    assert abs(np.mean(measured < 1.0) - 0.683) < 0.05
    assert abs(np.mean(measured < 1.96) - 0.95) < 0.03
    if fwhm < 2.0:
        assert np.mean(gaussian < 1.0) < 0.6 and np.mean(gaussian < 1.96) < 0.88


@pytest.mark.slow
def test_strengths_to_begin_with_do_not_matter():
    """Strengths that stopped on their way left PSFs 15 standard deviations apart."""
    model = bf.ForwardModel(
        bf.Detector((123, 123), pixel="box"), bf.SourceCatalog.grid(9, 13.7, 5e4),
        bf.MoffatPSF(1.3, 3.0), bf.PolynomialDistortion.polynomial(2),
    )  # fmt: skip
    theta = 1e-5 * np.random.default_rng(2).standard_normal(model.distortion.n_terms)
    posterior = bf.Posterior(
        replace(model, psf=bf.GaussianPSF(0.55)), bf.simulate(model, theta, 5.0, seed=3),
        nuisances=bf.Nuisances(flux="free", offset=True),
    )  # fmt: skip
    start = began(posterior, bf.find_map(posterior), 1)
    found = [
        solved(posterior, replace(start, strengths=np.full(len(start.strengths), strength)))
        for strength in (1.0, 1e5)
    ]
    one, other = (
        np.concatenate([each.state.deviations, each.state.params]) + each.step for each in found
    )
    upper, scale = found[0].factor
    apart = upper @ ((one - other) / scale)
    assert apart @ apart < 1.0  # squared standard deviations, of 350 numbers together
    # negative control: another strength is another PSF
    stronger = found[0].state.strengths * np.where(np.arange(3) == 0, 30.0, 1.0)
    moved = replace(found[0], state=replace(found[0].state, strengths=stronger)).measured
    assert moved @ moved > 1.0
