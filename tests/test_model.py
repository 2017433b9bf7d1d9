"""Noise and the log-posterior against scipy and dense images; the frames that all tests of
inference use."""

import dataclasses
import math
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba as nb
import numpy as np
import oracles
import pytest
from numpy.typing import NDArray
from scipy import stats

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE, exp2, log, take_turn, wide_vectors
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import BackgroundNoise, PoissonNoise, simulate
from bayesfred.model.parameters import BACKGROUND_TERMS, Nuisances
from bayesfred.model.posterior import Posterior

Floats = NDArray[np.float64]
Noise = PoissonNoise | BackgroundNoise

MIRRORED = PolynomialDistortion.mirrored()
EVERYTHING = Nuisances("scale", offset=True, psf_sigma=True, background_order=4)
LIMIT = 4.0  # Monte Carlo errors: exceeded by chance in 1 of 16,000


# --- frames ---------------------------------------------------------------------------------------


def make_model(
    sources: SourceCatalog | None = None,
    *,
    detector: Detector = Detector((60, 75)),
    sigma: float = 2.5,
    tolerance: float = 0.0,
    conserve_flux: bool = True,
) -> ForwardModel:
    """Nine overlapping sources in a frame of 60 x 75 fine pixels, unless other ones are given."""
    sources = sources or SourceCatalog.grid(3, 17.0, 4e3)
    return ForwardModel(
        detector,
        sources,
        GaussianPSF(sigma),
        MIRRORED,
        conserve_flux=conserve_flux,
        tolerance=tolerance,
    )


def make_truth(
    model: ForwardModel, rng: np.random.Generator, background: float = 3.0
) -> dict[str, float]:
    """Values of all parameters that there are; every distortion term moves a corner star by about
    half a pixel."""
    ny, nx = model.detector.fine_shape
    terms = (*model.distortion.f_terms, *model.distortion.g_terms)
    levers = [(nx / 2) ** (i + m) * (ny / 2) ** (j + n) for i, j, m, n in terms]
    theta = 0.5 * rng.standard_normal(len(levers)) / levers
    slopes = background * np.append(
        rng.uniform(-0.15, 0.15, 5), np.random.default_rng(9).uniform(-0.05, 0.05, 9)
    )
    names = BACKGROUND_TERMS[1:]
    return {
        **dict(zip(model.distortion.names, theta, strict=True)),
        "background": background,
        "flux_scale": 1.1,
        "offset_x": 0.7,
        "offset_y": -0.4,
        "psf_sigma": 1.04 * model.psf.sigma,
        "model_error": 0.03,
        **dict(zip(names, slopes, strict=True)),
    }


def known(truth: Mapping[str, float], nuisances: Nuisances) -> dict[str, float]:
    """The truth with what the nuisances do not leave free at its nominal value."""
    names = {*MIRRORED.names, "background", *nuisances.names}
    return {name: value for name, value in truth.items() if name in names}


def dense_image(
    model: ForwardModel, named: Mapping[str, float], fluxes: Floats | None = None, order: int = 7
) -> Floats:
    """The sources' image from the formulas; the pointing offset is a constant term of f and g with
    a minus."""
    d, detector, constant = model.distortion, model.detector, (0, 0, 0, 0)
    theta = [named[name] for name in d.names]
    f = [*theta[: len(d.f_terms)], -named.get("offset_x", 0.0)]
    g = [*theta[len(d.f_terms) :], -named.get("offset_y", 0.0)]
    if fluxes is None:
        fluxes = model.sources.flux * named.get("flux_scale", 1.0)
    arguments = (
        (*d.f_terms, constant),
        (*d.g_terms, constant),
        np.array(f + g),
        (model.sources.x, model.sources.y, fluxes),
        named.get("psf_sigma", model.psf.sigma),
        detector.shape,
        detector.binning,
    )
    if detector.pixel == "box":
        return oracles.box_counts(*arguments, conserve_flux=model.conserve_flux, order=order)
    return oracles.impulse_counts(*arguments, conserve_flux=model.conserve_flux)


def background_image(shape: tuple[int, int], named: Mapping[str, float]) -> Floats:
    """The background polynomial in coordinates from -1 to 1 over the frame."""
    ny, nx = shape
    u = oracles.middle_out(nx) * 2 / nx
    v = oracles.middle_out(ny)[:, None] * 2 / ny
    powers = {
        "": 1, "_u": u, "_v": v, "_u2": u**2, "_uv": u * v, "_v2": v**2,
        "_u3": u**3, "_u2v": u**2 * v, "_uv2": u * v**2, "_v3": v**3,
        "_u4": u**4, "_u3v": u**3 * v, "_u2v2": u**2 * v**2, "_uv3": u * v**3, "_v4": v**4,
    }  # fmt: skip
    terms = [
        named.get("background" + name, 0.0) * power * np.ones(shape)
        for name, power in powers.items()
    ]
    return np.asarray(np.sum(terms, axis=0))


def make_posterior(
    model: ForwardModel,
    truth: Mapping[str, float],
    rng: np.random.Generator,
    nuisances: Nuisances = Nuisances(),
    noise: Noise = PoissonNoise(),
    **options: Any,
) -> tuple[Posterior, Floats]:
    """The posterior given a frame that is drawn from the dense image, and the true parameters."""
    named = known(truth, nuisances)
    frame = noise.draw(
        dense_image(model, named), background_image(model.detector.shape, named), rng
    )
    posterior = Posterior(model, frame, noise=noise, nuisances=nuisances, **options)
    return posterior, np.array([named[name] for name in posterior.parameter_names])


def flat_priors(names: tuple[str, ...], truth: Mapping[str, float]) -> dict[str, Any]:
    """Uniform priors that hold the truth: the posterior is the likelihood."""
    return {
        name: stats.uniform(truth[name] - abs(truth[name]), 2 * abs(truth[name])) for name in names
    }


# --- noise ----------------------------------------------------------------------------------------

MEANS = np.array([0.05, 0.7, 3.0, 40.0, 900.0])
NOISES: list[Noise] = [PoissonNoise(), PoissonNoise(1.7), BackgroundNoise()]


def test_poisson_log_likelihood_equals_scipys() -> None:
    n = np.arange(60.0)[:, None]
    assert PoissonNoise().log_likelihood(n, MEANS, 0.0) == pytest.approx(
        stats.poisson(MEANS).logpmf(n), rel=1e-13, abs=1e-13
    )


def test_background_log_likelihood_equals_scipys() -> None:
    n, background = np.linspace(-5, 50, 12)[:, None], np.array([0.2, 1.0, 5.0, 9.0, 30.0])
    expected = stats.norm(MEANS, np.sqrt(background)).logpdf(n)
    assert BackgroundNoise().log_likelihood(n, MEANS, background) == pytest.approx(
        expected, rel=1e-13
    )


@pytest.mark.parametrize("noise", NOISES, ids=repr)
def test_score_is_the_slope_of_the_log_likelihood(noise: Noise) -> None:
    n, background = np.array([-1.0, 0.0, 1.0, 12.0, 700.0])[:, None], 0.04
    n = np.maximum(n, 0.0) if noise == PoissonNoise() else n
    blur = getattr(noise, "read_noise", 0.0) ** 2
    h = 1e-3 * MEANS  # the five-point rule errs by h^4 / 30 of the fifth derivative
    ahead = [noise.log_likelihood(n, MEANS + k * h, background) for k in (-2, -1, 1, 2)]
    slope = (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / (12 * h)
    scale = np.abs(n) / (MEANS + blur) + 1.0
    assert noise.score(n, MEANS, background) / scale == pytest.approx(slope / scale, abs=1e-8)


@pytest.mark.parametrize("noise", NOISES[::2], ids=repr)
@pytest.mark.parametrize("mean", [0.05, 3.0, 40.0])
def test_score_has_mean_zero_and_the_fisher_weight_as_variance(noise: Noise, mean: float) -> None:
    background = 0.7 * mean if isinstance(noise, BackgroundNoise) else 0.0
    rate = background or mean  # of the photons that are random
    photons = np.arange(200.0)
    counts = mean - rate + photons
    probability = stats.poisson(rate).pmf(photons)
    score, residual = (
        noise.score(counts, np.array(mean), background),
        noise.residual(counts, np.array(mean), background),
    )
    assert np.sum(probability * score) == pytest.approx(0.0, abs=1e-12)
    assert np.sum(probability * score**2) == pytest.approx(
        float(noise.fisher_weight(np.array(mean), background)), rel=1e-11
    )
    assert np.sum(probability * residual**2) == pytest.approx(1.0, rel=1e-11)


def moment_errors(frame: Floats, mean: float, variance: float) -> tuple[float, float]:
    """How far mean and variance of a frame are from the given ones, in Monte Carlo errors."""
    deviation = frame - mean
    z_mean = deviation.mean() / math.sqrt(variance / frame.size)
    z_variance = (np.mean(deviation**2) - variance) / (np.std(deviation**2) / math.sqrt(frame.size))
    return float(z_mean), float(z_variance)


@pytest.mark.parametrize(
    ("noise", "variance"), [(NOISES[0], 6.0), (NOISES[1], 6.0 + 1.7**2), (NOISES[2], 2.0)], ids=repr
)
def test_draws_have_the_right_moments(noise: Noise, variance: float) -> None:
    frame = noise.draw(np.full((300, 400), 4.0), 2.0, np.random.default_rng(1))
    assert max(map(abs, moment_errors(frame, 6.0, variance))) < LIMIT
    # negative control: draws that leave 2 % of the variance out, known to 0.5 %, are noticed
    assert abs(moment_errors(6.0 + math.sqrt(0.98) * (frame - 6.0), 6.0, variance)[1]) > LIMIT


def test_simulate_is_reproducible() -> None:
    model = make_model()
    draws = [
        simulate(model, np.zeros(12), 2.0, seed=seed)
        for seed in (5, 5, 6, np.random.SeedSequence(5))
    ]
    assert np.array_equal(draws[0], draws[1]) and np.array_equal(draws[0], draws[3])
    assert not np.array_equal(draws[0], draws[2])
    paper = simulate(
        model, np.zeros(12), 2.0, seed=5, noise=BackgroundNoise()
    ) - model.expected_counts(np.zeros(12))
    assert paper == pytest.approx(np.round(paper), abs=1e-9) and paper.min() > -0.5


@pytest.mark.parametrize("background", [-1.0, math.nan, math.inf])
def test_simulate_refuses_a_background_that_is_none(background: float) -> None:
    with pytest.raises(InputError, match="background: got"):
        simulate(make_model(), np.zeros(12), background, seed=1)


@pytest.mark.parametrize("read_noise", [-1.0, math.nan, math.inf])
def test_read_noise_is_checked(read_noise: float) -> None:
    with pytest.raises(InputError, match="read_noise: got"):
        PoissonNoise(read_noise)


# --- elementary functions -------------------------------------------------------------------------


def vectorised(function: Any, flags: set[str]) -> Callable[[Floats], Floats]:
    @nb.njit(fastmath=flags)
    def apply(x, out):  # type: ignore[no-untyped-def]
        for i in range(x.size):
            out[i] = function(x[i])
        return out

    return lambda x: np.asarray(apply(x, np.empty_like(x)))


def test_log_is_exact_to_rounding() -> None:
    rng = np.random.default_rng(1)
    x = np.concatenate(
        [
            10.0 ** rng.uniform(-300, 300, 200_000),
            rng.uniform(0.3, 3.0, 200_000),
            [1e-300, 1.0, 1e300],
        ]
    )
    exact = np.log(x.astype(np.longdouble))
    for flags in (FAST, REDUCE):
        error = np.abs(vectorised(log, flags)(x) - exact) / np.maximum(np.abs(exact), 1.0)
        assert error.max() < 3e-16


def test_exp2_is_as_exact_as_it_says() -> None:
    x = np.concatenate(
        [np.random.default_rng(1).uniform(-1000, 1000, 400_000), [-1000.0, 0.0, 999.0]]
    )
    exact = np.exp2(x.astype(np.longdouble))
    assert np.abs(vectorised(exp2, FAST)(x) / exact - 1).max() < 1.5e-14


def test_only_functions_that_ask_for_them_have_wide_vectors() -> None:
    @nb.njit
    def wide(x: Any) -> Any:
        wide_vectors()
        return 2.0 * x

    @nb.njit
    def plain(x: Any) -> Any:
        return 2.0 * x

    assert wide(3.0) == plain(3.0) == 6.0
    texts = [next(iter(f.inspect_llvm().values())) for f in (wide, plain)]
    assert ['"prefer-vector-width"="512"' in text for text in texts] == [True, False]


def test_threads_that_take_turns_miss_and_repeat_none() -> None:
    @nb.njit(nogil=True)
    def take(turn: Any, taken: Any) -> Any:
        mine, i = 0, take_turn(turn)
        while i < taken.size:
            taken[i] += 1
            mine += 1
            i = take_turn(turn)
        return mine

    turn, taken = np.zeros(1, np.int64), np.zeros(10_000_000, np.int8)
    take(turn.copy(), taken[:0])  # compiled before the threads start
    with ThreadPoolExecutor(4) as pool:
        shares = list(pool.map(lambda _: take(turn, taken), range(4)))
    assert np.all(taken == 1) and sum(shares) == taken.size


# --- log-posterior --------------------------------------------------------------------------------


def dense_log_prob(posterior: Posterior, params: Floats, order: int = 7) -> tuple[float, float]:
    """The log-posterior summed pixel by pixel, and the sum of its terms' sizes: the rounding's
    scale."""
    named = dict(zip(posterior.parameter_names, params, strict=True))
    background = background_image(posterior.model.detector.shape, named)
    mean = dense_image(posterior.model, named, order=order) + background
    terms = posterior.noise.log_likelihood(posterior.counts, mean, background)[posterior.mask]
    size = np.abs(terms)
    if isinstance(
        posterior.noise, BackgroundNoise
    ):  # the squares of dark pixels are what the bright ones' leave of the total
        size = size + 0.1 * posterior.counts[posterior.mask] ** 2 / named["background"]
    prior = [
        float(distribution.logpdf(x))
        for distribution, x in zip(posterior.prior.values(), params, strict=True)
    ]
    return math.fsum([*terms, *prior]), float(size.sum())


@pytest.mark.parametrize(
    "detector",
    [*map(Detector, [(60, 75), (20, 25), (30, 37)], [1, 3, 2]), Detector((60, 75), 1, "box")],
)
@pytest.mark.parametrize(
    ("nuisances", "noise"),
    [
        (Nuisances(), PoissonNoise()),
        (Nuisances("scale", psf_sigma=True), BackgroundNoise()),
        (Nuisances(offset=True, background_order=1), PoissonNoise(1.3)),
        (EVERYTHING, PoissonNoise()),
    ],
    ids=["fixed", "paper", "offset", "everything"],
)
def test_log_prob_is_the_sum_over_pixels(
    detector: Detector, nuisances: Nuisances, noise: Noise
) -> None:
    rng = np.random.default_rng(7)
    for conserve_flux in (True, False):
        model = make_model(detector=detector, conserve_flux=conserve_flux)
        mask = rng.random(detector.shape) < 0.8
        posterior, truth = make_posterior(
            model, make_truth(model, rng), rng, nuisances, noise, mask=mask
        )
        narrowest = (
            posterior.prior["psf_sigma"].ppf(1e-6) if nuisances.psf_sigma else model.psf.sigma
        )
        order = detector.quadrature(narrowest)[
            0
        ].size  # the box rule itself is judged in the tests of imaging
        for params in (truth, truth * rng.uniform(0.9, 1.1, truth.size)):
            expected, scale = dense_log_prob(posterior, params, order)
            assert posterior.log_prob(params) == pytest.approx(
                expected, abs=1e-14 * scale, rel=1e-12
            )


def test_log_prob_of_box_pixels_agrees_with_a_finer_rule() -> None:
    rng = np.random.default_rng(8)
    model = make_model(detector=Detector((20, 25), 3, "box"))
    posterior, truth = make_posterior(model, make_truth(model, rng), rng)
    # the package's rule errs by at most 6e-7 of the peak, which some 9 x 25 pixels' scores of 1 /
    # sqrt(peak) weigh
    peak = dense_image(model, dict(zip(posterior.parameter_names, truth, strict=True))).max()
    assert posterior.log_prob(truth) == pytest.approx(
        dense_log_prob(posterior, truth)[0], rel=0, abs=225 * 6e-7 * math.sqrt(peak)
    )


def test_bright_sources_leave_the_papers_likelihood_its_digits() -> None:
    model = make_model(SourceCatalog.grid(2, 30.0, 1e8), tolerance=1e-8)
    rng = np.random.default_rng(15)
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, noise=BackgroundNoise())
    params = truth + 0.1 * np.eye(13)[12]
    mean = model.expected_counts(truth[:12]) + params[-1]
    expected = math.fsum(posterior.noise.log_likelihood(posterior.counts, mean, params[-1]).ravel())
    assert posterior.log_prob(params) - posterior.log_prior(params)[0] == pytest.approx(
        expected, abs=1e-6
    )


def test_tolerance_changes_log_prob_by_as_little_as_it_says() -> None:
    rng = np.random.default_rng(9)
    sources = SourceCatalog.grid(3, 17.0, 4e3)
    exact, truth = make_posterior(make_model(sources), make_truth(make_model(), rng), rng)
    near = Posterior(make_model(sources, tolerance=1e-8), exact.counts)
    # nine sources leave out less than 1e-8 of their peaks in 4500 pixels, whose scores are some
    # (n/mu - 1) ~ 1
    change = abs(near.log_prob(truth) - exact.log_prob(truth))
    assert 0.0 < change < 9 * 4500 * 1e-8 * 4e3 * near.model.psf.peak


@pytest.fixture
def two_threads() -> Any:
    if nb.config.NUMBA_NUM_THREADS < 2:
        pytest.skip("one core")
    before = nb.get_num_threads()
    yield
    nb.set_num_threads(before)


@pytest.mark.parametrize(
    "nuisances",
    [EVERYTHING, pytest.param(Nuisances("free"), marks=pytest.mark.slow)],
    ids=["scale", "free"],
)
def test_log_prob_of_a_batch_has_the_same_bits_for_any_threads(
    two_threads: Any, nuisances: Nuisances
) -> None:
    rng = np.random.default_rng(10)
    model = make_model(tolerance=1e-8)
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, nuisances)
    batch = truth * rng.uniform(0.95, 1.05, (7, truth.size))
    batch[2, posterior.parameter_names.index("background")] = -1.0
    singly = np.array([posterior.log_prob(params) for params in batch])
    assert isinstance(posterior.log_prob(truth), float) and singly[2] == -math.inf
    for threads in (1, 2, 2, 2):
        nb.set_num_threads(threads)
        assert posterior.log_prob(batch).tobytes() == singly.tobytes()


def test_log_prob_outside_the_support_is_minus_infinity() -> None:
    rng = np.random.default_rng(11)
    model = make_model()
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, EVERYTHING)
    for name, value in (
        ("background", -0.1),
        ("flux_scale", -1.0),
        ("psf_sigma", 9.0),
        ("background_u", 4.0),
        ("f_ux", 0.3),
    ):
        params = truth.copy()
        params[posterior.parameter_names.index(name)] = (
            value  # the last folds the map: D = 1 + f_u = 1 + 0.3 x < 0 at x = -17
        )
        assert posterior.log_prob(params) == -math.inf, name
    assert math.isfinite(posterior.log_prob(truth))


@pytest.mark.parametrize(
    "nuisances",
    [
        EVERYTHING,
        Nuisances("free", offset=True, psf_sigma=True),
    ],
    ids=["scale", "free"],
)
def test_log_prob_is_never_nan(nuisances: Nuisances) -> None:
    rng = np.random.default_rng(12)
    model = make_model(tolerance=1e-8)
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, nuisances)
    wild = truth * rng.standard_normal((300, truth.size)) * 10.0 ** rng.uniform(-3, 5, (300, 1))
    odd = np.repeat(truth[None], 4 * truth.size, axis=0)
    for k, value in enumerate((math.nan, math.inf, -math.inf, 1e100)):
        odd[k * truth.size : (k + 1) * truth.size][np.diag_indices(truth.size)] = value
    values = posterior.log_prob(np.concatenate([wild, odd, truth[None]]))
    assert not np.isnan(values).any() and not np.isposinf(values).any()
    assert np.isneginf(values[300 : 300 + 3 * truth.size]).all()
    assert (
        values[-1] == posterior.log_prob(truth) > -math.inf
    )  # whatever went before leaves no trace


@pytest.mark.parametrize("junk", [math.nan, math.inf, -1e9, 1e300])
def test_a_masked_pixels_value_is_irrelevant(junk: float) -> None:
    rng = np.random.default_rng(13)
    model = make_model()
    mask = rng.random((60, 75)) < 0.7
    clean, truth = make_posterior(model, make_truth(model, rng), rng, mask=mask)
    frame = np.where(mask, clean.counts, junk)
    dirty = Posterior(model, frame, mask=mask)
    assert dirty.log_prob(truth) == clean.log_prob(truth)
    assert np.array_equal(dirty.gradient(truth), clean.gradient(truth))
    assert np.array_equal(dirty.fisher(truth), clean.fisher(truth))
    with pytest.raises(InputError, match="counts: got"):
        Posterior(model, np.where(mask, clean.counts, -1.0))


@pytest.mark.parametrize("detector", [Detector((60, 75)), Detector((30, 25), 2)])
def test_footprint_keeps_pixels_near_sources(detector: Detector) -> None:
    model = make_model(
        SourceCatalog([3.2, -20.0, 60.0], [1.0, 12.5, 0.0], [1e3] * 3), detector=detector
    )
    mask = np.random.default_rng(14).random(detector.shape) < 0.9
    posterior = Posterior(
        model, np.ones(detector.shape), mask=mask, nuisances=Nuisances(footprint=7.5)
    )
    u, v = np.meshgrid(*detector.pixel_centres())
    near = [
        np.hypot(u - x, v - y) <= 7.5 for x, y in zip(model.sources.x, model.sources.y, strict=True)
    ]
    assert np.array_equal(posterior.mask, mask & np.any(near, axis=0))


@pytest.mark.parametrize("nuisances", [Nuisances(), Nuisances("free", offset=True)])
def test_pixels_beyond_the_mask_are_left_out_of_the_likelihood_alone(nuisances: Nuisances) -> None:
    rng = np.random.default_rng(16)
    model = make_model()
    u, v = np.meshgrid(*model.detector.pixel_centres())
    x, y = model.sources.x, model.sources.y
    near = np.any([np.hypot(u - a, v - b) < 5.0 for a, b in zip(x, y, strict=True)], axis=0)
    # rows through a source beside its middle, and all of the middle of another
    mask = near & (np.abs(v - y[0] - 3.0) > 1.0) & (np.hypot(u - x[1], v - y[1]) > 2.0)
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, nuisances, mask=mask)
    if nuisances.flux == "fixed":
        expected, scale = dense_log_prob(posterior, truth)
        assert posterior.log_prob(truth) == pytest.approx(expected, abs=1e-14 * scale, rel=1e-12)
    likelihood = posterior.likelihood
    with likelihood.expected(truth) as whole:
        fluxes, light = whole.fluxes.copy(), whole.light.copy()
    found = likelihood._found(truth[None])[0, :, 0]
    assert found == pytest.approx(fluxes, rel=1e-9)
    named = dict(zip(posterior.parameter_names, truth, strict=True))
    sources = dataclasses.replace(model.sources, flux=fluxes)
    dense = dense_image(dataclasses.replace(model, sources=sources), named)
    assert light == pytest.approx(dense, abs=1e-9 * dense.max())
    assert light[~mask].max() > 0.1 * dense.max()  # pictures show it


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"counts": np.ones((5, 5))}, "counts: got shape"),
        ({"mask": np.ones((5, 5), bool)}, "mask: got shape"),
        ({"mask": np.zeros((60, 75), bool)}, "every pixel is masked"),
        ({"counts": np.full((60, 75), math.nan)}, "not finite"),
        ({"counts": np.full((60, 75), -1.0)}, "without read noise"),
        ({"model": make_model(SourceCatalog([400.0], [0.0], [1e3]))}, "all outside the frame"),
        (
            {
                "model": make_model(SourceCatalog(*np.random.default_rng(1).random((3, 4501)))),
                "nuisances": Nuisances("free"),
            },
            "got 4501 free fluxes in the frame and 4500 pixels",
        ),
        ({"prior": {"f_nonsense": stats.norm()}}, "prior: got f_nonsense"),
        ({"prior": {"background": stats.beta(2, 2)}}, "background: got beta"),
        ({"prior": {"background": 3.0}}, "background: got float"),
        ({"noise": BackgroundNoise(), "nuisances": Nuisances("free")}, "BackgroundNoise with free"),
        (
            {"noise": BackgroundNoise(), "nuisances": Nuisances(background_order=1)},
            "varying background",
        ),
    ],
)
def test_posterior_refuses_what_it_cannot_use(options: dict[str, Any], message: str) -> None:
    arguments = {"model": make_model(), "counts": np.ones((60, 75)), **options}
    with pytest.raises(InputError, match=message):
        Posterior(arguments.pop("model"), arguments.pop("counts"), **arguments)
    with pytest.raises(InputError, match="params: got shape"):
        Posterior(make_model(), np.ones((60, 75))).log_prob(np.zeros(3))


@pytest.mark.parametrize(
    "choice",
    [{"flux": "loose"}, {"background_order": 5}, {"footprint": 0.0}, {"footprint": math.nan}],
)
def test_nuisances_are_checked(choice: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"nuisances: {next(iter(choice))}: got"):
        Nuisances(**choice)


@pytest.mark.parametrize(
    ("scatter", "model_error"),
    [
        (False, False),
        # what costs most to compile is among the slow ones
        pytest.param(False, True, marks=pytest.mark.slow),
        pytest.param(True, False, marks=pytest.mark.slow),
        pytest.param(True, True, marks=pytest.mark.slow),
    ],
)
def test_derivatives_begin_with_what_log_prob_found(scatter: bool, model_error: bool) -> None:
    """They are those of a search of their own, and what they begin with is used."""
    model = make_model()
    nuisances = Nuisances("free", position_scatter=scatter, model_error=model_error)
    truth = {**make_truth(model, np.random.default_rng(1)), "position_scatter": 0.05}
    fresh, params = make_posterior(model, truth, np.random.default_rng(2), nuisances)
    after = dataclasses.replace(fresh)
    after.log_prob(params)
    known = after.likelihood._last.at(params)
    assert np.array_equal(after.gradient(params), dataclasses.replace(fresh).gradient(params))
    assert known[:, 0] == pytest.approx(fresh.fluxes(params), rel=1e-7)
    assert after.likelihood._last.at(params + 1e-9).size == 0
    sd = np.sqrt(np.diag(np.linalg.inv(fresh.information(params))))
    alone = dataclasses.replace(fresh)
    assert after.gradient(params) * sd == pytest.approx(alone.gradient(params) * sd, abs=1e-6)
    found, wanted = (each.information(params) * np.outer(sd, sd) for each in (after, alone))
    assert found == pytest.approx(wanted, abs=1e-6)
    # from elsewhere it is the same maximum, and from nowhere there is none
    for factor, same in ((1.02, True), (math.nan, False)):
        moved = dataclasses.replace(fresh)
        moved.likelihood._last.keep(params[None], np.zeros(1), (factor * known)[None])
        close = moved.gradient(params) * sd == pytest.approx(alone.gradient(params) * sd, abs=1e-6)
        assert close == same


def test_workspaces_are_used_again() -> None:
    posterior, truth = make_posterior(
        make_model(), make_truth(make_model(), np.random.default_rng(1)), np.random.default_rng(2)
    )
    for _ in range(5):
        posterior.log_prob(np.repeat(truth[None], 6, axis=0))
        posterior.gradient(truth)
    idle = posterior.likelihood._workspaces._idle.qsize()
    assert 1 <= idle <= nb.config.NUMBA_NUM_THREADS


@pytest.mark.parametrize("noise", [PoissonNoise(), PoissonNoise(3.0), BackgroundNoise()])
def test_sigma_is_the_spread_of_drawn_counts(noise: PoissonNoise | BackgroundNoise) -> None:
    model = make_model()
    theta, level, n = np.zeros(model.distortion.n_terms), 4.0, 2000
    posterior = Posterior(model, np.full(model.detector.shape, 4.0), noise=noise)
    rng = np.random.default_rng(40)
    block = np.s_[24:36, 31:43]  # a source in the middle of the frame
    sources = model.expected_counts(theta)[block]
    drawn = np.stack([noise.draw(sources, level, rng) for _ in range(n)])
    sigma = posterior.sigma(np.append(theta, level))[block]
    ratio = np.mean(drawn.var(axis=0, ddof=1) / sigma**2)
    # the variance of a Poisson variance estimate is (2 + 1 / mean) / n of its square, the mean is
    # at least 4
    error = math.sqrt((2 + 1 / level) / n / sigma.size)
    assert abs(ratio - 1) < LIMIT * error
    # negative control: the root of the model's counts is the spread of plain photon noise alone
    plain = np.mean(drawn.var(axis=0, ddof=1) / (sources + level))
    assert (abs(plain - 1) > LIMIT * error) == (noise != PoissonNoise())


@pytest.mark.parametrize(
    "method", ["gradient", "fisher", "information", "expected_counts", "sigma", "fluxes"]
)
def test_several_vectors_are_refused_where_one_is_answered(method: str) -> None:
    """Only `log_prob` and `log_prior` promise batches; the others used row 0 without a word."""
    model = make_model()
    posterior, truth = make_posterior(
        model, make_truth(model, np.random.default_rng(1)), np.random.default_rng(2)
    )
    several, d = np.stack([truth, truth + 1.0]), truth.size
    assert posterior.log_prob(several).shape == posterior.log_prior(several).shape == (2,)
    expected = rf"params: got shape \(2, {d}\), expected one vector of shape \({d},\)"
    with pytest.raises(InputError, match=expected):
        getattr(posterior, method)(several)
    with pytest.raises(InputError, match=expected):
        posterior.simulate(several, np.random.default_rng(3))
