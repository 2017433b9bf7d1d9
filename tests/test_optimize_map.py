"""Priors against scipy; the posterior's maximum and its covariance against refits, grids and
scipy's least squares."""

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import optimize, stats
from test_model import (
    EVERYTHING,
    LIMIT,
    MIRRORED,
    background_image,
    dense_image,
    known,
    make_model,
    make_posterior,
    make_truth,
)

from bayesfred.analysis.diagnostics import diagnose
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io.serialize import read, serializable, write
from bayesfred.model import priors
from bayesfred.model.noise import BackgroundNoise, PoissonNoise, simulate
from bayesfred.model.parameters import Nuisances, parameter_table
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.newton import maximize
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

# --- priors ---------------------------------------------------------------------------------------

FAMILIES = {
    "norm": stats.norm(1.0, 2.0),
    "truncnorm": stats.truncnorm(-1.5, 2.0, loc=3.0, scale=1.4),
    "halfnorm": stats.halfnorm(1.0, 2.5),
    "uniform": stats.uniform(-1.0, 4.0),
    "expon": stats.expon(0.5, 3.0),
    "gamma": stats.gamma(2.7, 0.3, 1.9),
    "lognorm": stats.lognorm(0.8, 0.1, 2.0),
    "t": stats.t(4.2, 1.0, 0.7),
    "cauchy": stats.cauchy(-1.0, 0.6),
    "loguniform": stats.loguniform(0.2, 7.0, loc=1.0, scale=1.5),
}


def test_every_family_is_tested() -> None:
    assert set(FAMILIES) == set(priors.DENSITIES)


@pytest.mark.parametrize("family", FAMILIES)
def test_slope_is_that_of_the_log_density(family: str) -> None:
    p = FAMILIES[family]
    for x in p.ppf([0.03, 0.2, 0.5, 0.8, 0.97]):
        h = 1e-3 * float(p.ppf(0.6) - p.ppf(0.4))
        f = [float(p.logpdf(x + k * h)) for k in (-2, -1, 0, 1, 2)]
        first = (f[0] - 8 * f[1] + 8 * f[3] - f[4]) / (12 * h)
        second = (-f[0] + 16 * f[1] - 30 * f[2] + 16 * f[3] - f[4]) / (12 * h**2)
        # rounding of 1e-15 over h and h^2, where h is some 1e-3
        assert priors.slope(p, float(x)) == pytest.approx((first, -second), rel=1e-7, abs=1e-7)


def test_log_density_is_that_of_scipy_inside_and_outside_the_support() -> None:
    prior = {name: FAMILIES[name] for name in FAMILIES} | {
        f"{name} again": p for name, p in FAMILIES.items()
    }
    x = np.random.default_rng(1).uniform(-3.0, 12.0, (200, len(prior)))
    x[0] = [p.support()[0] for p in prior.values()]
    density = priors.log_density(prior)
    for k, p in enumerate(
        prior.values()
    ):  # one parameter at a time: elsewhere the others would hide it in -inf
        vectors = np.tile([q.median() for q in prior.values()], (200, 1))
        rest = sum(float(q.logpdf(q.median())) for i, q in enumerate(prior.values()) if i != k)
        vectors[:, k] = x[:, k]
        expected = p.logpdf(x[:, k])
        np.testing.assert_allclose(density(vectors) - rest, expected, rtol=1e-12, atol=1e-12)


@serializable("test.priors")
@dataclass(frozen=True)
class Priors:
    prior: Mapping[str, Any]


@pytest.mark.parametrize("family", FAMILIES)
def test_priors_survive_the_file(family: str) -> None:
    with h5py.File(io.BytesIO(), "w") as file:
        write(file, Priors({"background": FAMILIES[family]}))
        (name, p), *rest = read(file, Priors).prior.items()
        file["prior/background"].attrs["family"] = np.bytes_("zipf")
        with pytest.raises(InputError, match="zipf"):
            read(file, Priors)
    x = FAMILIES[family].ppf(np.linspace(0.01, 0.99, 9))
    assert name == "background" and not rest
    assert np.array_equal(p.logpdf(x), FAMILIES[family].logpdf(x))


@pytest.mark.parametrize(
    ("family", "parameters"),
    [
        ("beta", {"a": 1, "b": 2}),
        ("norm", {"location": 1}),
        ("lognorm", {}),
        ("gamma", {"a": -1}),
        ("truncnorm", {"a": 2, "b": 1}),
        ("norm", {"scale": "wide"}),
    ],
)
def test_make_refuses_what_is_no_distribution(family: str, parameters: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"prior\.f_ux: "):
        priors.make("f_ux", family, parameters)


@pytest.mark.parametrize(
    "parameters", [{"scale": -1.0}, {"scale": 0.0}, {"loc": math.nan}, {"loc": math.inf}]
)
def test_make_refuses_unusable_locations_and_scales(parameters: dict[str, float]) -> None:
    with pytest.raises(InputError, match=r"prior\.f_ux: "):
        priors.make("f_ux", "norm", parameters)


def test_make_takes_scipys_keywords() -> None:
    assert priors.make("f_ux", "t", {"df": 2.0, "scale": 3.0}).logpdf(1.0) == stats.t(
        2.0, scale=3.0
    ).logpdf(1.0)


def default_priors(
    distortion: PolynomialDistortion, nuisances: Nuisances = Nuisances()
) -> dict[str, Any]:
    """Of a frame of 60 x 100 fine pixels with 3 counts a pixel and a PSF of 2.5 pixels."""
    sources = SourceCatalog.grid(2, 10.0, 1e3)
    model = ForwardModel(Detector((30, 50), 2), sources, GaussianPSF(2.5), distortion)
    table = parameter_table(model, nuisances, np.full(1500, 3.0))
    return {parameter.name: parameter.prior for parameter in table}


def test_default_prior_moves_a_corner_star_by_a_tenth_of_the_half_width() -> None:
    for distortion in (PolynomialDistortion.full_polynomial(4), PolynomialDistortion.pinhole()):
        corner = {"u": 50.0, "v": 30.0, "x": 50.0, "y": 30.0}
        defaults = default_priors(distortion)
        for k, name in enumerate(distortion.names):
            scale = defaults[name].std()
            moved = distortion.displacement(scale * np.eye(distortion.n_terms)[k], **corner)
            expected = 0.1 * (50.0 if name[0] == "f" else 30.0)
            assert moved[name[0] == "g"] == pytest.approx(expected, rel=1e-12)


def test_default_priors_of_nuisances() -> None:
    free = Nuisances("scale", offset=True, psf_sigma=True, background_order=2)
    default = default_priors(MIRRORED, free)
    assert (default["offset_x"].std(), default["offset_y"].std()) == pytest.approx((5.0, 3.0))
    assert default["background"].support() == (0.0, math.inf)
    assert default["background"].median() == pytest.approx(30.0 * stats.halfnorm.median())
    assert default["background_u2"].std() == pytest.approx(3.0)
    assert default["flux_scale"].ppf(stats.norm.cdf(1.0)) == pytest.approx(math.e)
    assert default["psf_sigma"].support() == pytest.approx((1.5, 5.0))


# --- maximum --------------------------------------------------------------------------------------


def excess(deviations: Floats, covariances: Floats) -> float:
    """Mean chi-square of the deviations minus their number of parameters, in Monte Carlo errors."""
    squares = np.array(
        [d @ np.linalg.solve(c, d) for d, c in zip(deviations, covariances, strict=True)]
    )
    return float((squares.mean() - deviations.shape[1]) / (squares.std() / math.sqrt(squares.size)))


# Coefficients are some 1e-5: the frame alone determines them, and the mean chi-square is their
# number.
FLAT = {name: stats.norm(0.0, 1.0) for name in MIRRORED.names}


@pytest.mark.parametrize(
    ("nuisances", "n"),
    [
        (Nuisances(), 120),
        (EVERYTHING, 70),
        pytest.param(Nuisances("free", offset=True), 100, marks=pytest.mark.slow),
    ],
    ids=["fixed", "all", "free"],
)
def test_refits_scatter_as_the_covariance_says(nuisances: Nuisances, n: int) -> None:
    rng = np.random.default_rng(30)
    model = make_model(SourceCatalog.grid(3, 17.0, 2e4), tolerance=1e-8)
    truth = known(make_truth(model, rng), nuisances)
    mean = dense_image(model, truth) + background_image((60, 75), truth)
    fits = []
    for _ in range(n):
        posterior = Posterior(model, rng.poisson(mean), nuisances=nuisances, prior=FLAT)
        values = np.array([truth[name] for name in posterior.parameter_names])
        fits.append(find_map(posterior, values))
    assert all(fit.at_maximum and fit.fits_data for fit in fits)
    deviations = np.array([fit.params for fit in fits]) - values
    covariances = np.array([fit.covariance for fit in fits])
    assert abs(excess(deviations, covariances)) < 3.0
    # each parameter's deviation in its errors, whose mean has a Monte Carlo error of 1 / sqrt(n)
    pulls = deviations / np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert np.abs(pulls.mean(axis=0)).max() < LIMIT / math.sqrt(n)
    # negative control: errors 10 % too small are noticed, by some 0.19 sqrt(n d / 2) = 5
    assert excess(deviations, 0.81 * covariances) > 3.0


def test_map_is_found_from_afar_and_reports_itself() -> None:
    rng = np.random.default_rng(31)
    model = make_model(tolerance=1e-8)
    # 14 slopes of a background, all of them five errors off, would make it negative
    nuisances = replace(EVERYTHING, background_order=2)
    posterior, truth = make_posterior(model, make_truth(model, rng), rng, nuisances)
    best = find_map(posterior)
    assert best.log_prob == posterior.log_prob(best.params) > posterior.log_prob(truth)
    assert best.covariance == pytest.approx(
        np.linalg.inv(posterior.information(best.params)), rel=1e-6
    )
    assert "gradient" in best.message and best.n_evaluations < 30
    error = np.sqrt(np.diag(best.covariance))
    for factor in (-5.0, 5.0):
        again = find_map(posterior, truth + factor * error * rng.uniform(0, 1, truth.size))
        assert (
            again.at_maximum
            and again.fits_data
            and np.abs((again.params - best.params) / error).max() < 2e-3
        )
    with h5py.File(io.BytesIO(), "w") as file:
        write(file, best)
        copy = read(file, MapEstimate)
    assert np.array_equal(copy.params, best.params) and np.array_equal(
        copy.covariance, best.covariance
    )
    fields = ("log_prob", "n_evaluations", "message", "at_maximum", "fits_data")
    assert [getattr(copy, name) for name in fields] == [getattr(best, name) for name in fields]


def test_map_and_variance_of_the_background_are_those_of_a_grid() -> None:
    distortion = PolynomialDistortion([(1, 0, 2, 0)], [])
    model = ForwardModel(
        Detector((40, 50)),
        SourceCatalog.grid(2, 17.0, 500.0),
        GaussianPSF(2.5),
        distortion,
        tolerance=0.0,
    )
    frame = simulate(model, [0.0], 0.4, seed=32)
    free = Posterior(model, frame)
    # the narrowest prior by which the frame still says something: it leaves the background alone to
    # 2 %
    fixed = stats.norm(0.0, 0.15 / math.sqrt(free.fisher([0.0, 0.4])[0, 0]))
    best = find_map(Posterior(model, frame, prior={"f_u2x": fixed}))
    sources = dense_image(model, {"f_u2x": 0.0})
    grid = np.linspace(0.3, 0.5, 4001)
    values = np.array([stats.poisson(sources + b).logpmf(frame).sum() for b in grid[::40]])
    values = np.interp(
        grid, grid[::40], np.polyval(np.polyfit(grid[::40] - 0.4, values, 8), grid[::40] - 0.4)
    )
    values = values + free.prior["background"].logpdf(grid)
    weight = np.exp(values - values.max())
    mean = np.average(grid, weights=weight)
    variance = np.average((grid - mean) ** 2, weights=weight)
    # 800 photons of background: the mean is off the maximum by skewness, 1/2 of 1/sqrt(800) errors;
    # the variance by 1/800
    assert best.params[1] == pytest.approx(mean, abs=0.05 * math.sqrt(variance))
    assert best.covariance[1, 1] == pytest.approx(variance, rel=0.03)


@pytest.mark.slow
def test_map_of_the_papers_noise_is_its_least_squares() -> None:
    rng = np.random.default_rng(33)
    model = make_model()
    posterior, truth = make_posterior(
        model, make_truth(model, rng, 20.0), rng, noise=BackgroundNoise(), prior=FLAT
    )
    best = find_map(posterior)
    error = np.sqrt(np.diag(best.covariance))[:-1]

    def residual(z: Floats) -> Floats:
        named = dict(zip(model.distortion.names, truth[:-1] + error * z, strict=True))
        return (posterior.counts - dense_image(model, named) - best.params[-1]).ravel()

    fit = optimize.least_squares(residual, np.zeros(12), xtol=1e-12, ftol=1e-12, gtol=1e-10)
    # a maximum counts as found within 1e-3 errors
    assert (best.params[:-1] - truth[:-1]) / error == pytest.approx(fit.x, abs=2e-3)


def test_the_information_is_worked_out_once_a_place(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(tolerance=1e-8)
    posterior = Posterior(model, simulate(model, np.zeros(12), 3.0, seed=34))
    real, places = Posterior.fisher, []

    def fisher(self: Posterior, params: Any) -> Any:
        places.append(np.asarray(params).tobytes())
        return real(self, params)

    monkeypatch.setattr(Posterior, "fisher", fisher)
    assert find_map(posterior, posterior.start()).fits_data
    assert len(places) == len(set(places)) > 1


def test_undetermined_parameters_are_named() -> None:
    model = make_model(SourceCatalog([20.0], [10.0], [4e3]), tolerance=1e-8)
    posterior = Posterior(model, simulate(model, np.zeros(12), 3.0, seed=34))
    with pytest.raises(InputError, match="the frame cannot determine") as caught:
        find_map(posterior)
    named = str(caught.value).split("determine ")[1].split(" by its 1 source, ")[0].split(", ")
    assert {"f_ux2", "g_uy2"} <= set(named) <= set(MIRRORED.names)
    # two terms that it can
    few = PolynomialDistortion([(1, 0, 2, 0)], [(0, 1, 2, 0)])
    model = ForwardModel(model.detector, model.sources, model.psf, few)
    assert find_map(Posterior(model, posterior.counts)).fits_data


@pytest.mark.slow  # to compile
@pytest.mark.parametrize(
    ("make", "sources", "degree"),
    [
        (PolynomialDistortion.polynomial, 9, 2),  # 10 terms of degree 3 a coordinate
        (PolynomialDistortion.polynomial, 5, 1),
        (partial(PolynomialDistortion.zernike, radius=50.0), 5, 1),
    ],
)
def test_the_degree_that_the_sources_determine_is_named(
    make: Callable[[int], PolynomialDistortion], sources: int, degree: int
) -> None:
    rng = np.random.default_rng(3)
    x, y = rng.uniform(-30.0, 30.0, (2, sources))
    base = make_model(SourceCatalog(x, y, np.full(sources, 2e4)), tolerance=1e-8)

    def frame_of(fitted: int) -> Posterior:
        model = replace(base, distortion=make(fitted))
        counts = simulate(model, np.zeros(model.distortion.n_terms), 3.0, seed=34)
        return Posterior(model, counts, nuisances=Nuisances("free", offset=True))

    with pytest.raises(InputError, match=f"degree above {degree} .*degree = {degree} in a run"):
        find_map(frame_of(3))
    find_map(frame_of(degree))
    with pytest.raises(InputError, match="cannot determine"):
        find_map(frame_of(degree + 1))


def test_sources_that_are_not_matched_are_told_where_terms_are_not_determined() -> None:
    rng = np.random.default_rng(3)
    here, there = (SourceCatalog(*rng.uniform(-30.0, 30.0, (2, 5)), np.full(5, 2e4)) for _ in "ab")
    base = make_model(here, tolerance=1e-8)
    model = replace(base, distortion=PolynomialDistortion.polynomial(3))
    for sources, told in ((here, False), (there, True)):
        counts = simulate(replace(base, sources=sources), np.zeros(12), 3.0, seed=34)
        with pytest.raises(InputError, match="cannot determine") as caught:
            find_map(Posterior(model, counts))
        assert (" of 5 sources are matched to peaks" in str(caught.value)) == told


@pytest.mark.parametrize("flux", ["fixed", "scale", "free"])
@pytest.mark.parametrize(
    ("counts", "said"),
    [(0.0, "got 0 in each of"), (100.0, "got 100 in each of"), (None, "got at most 1.4e-13 of")],
)
def test_a_frame_without_information_is_refused_at_once(
    flux: Any, counts: float | None, said: str
) -> None:
    """Where the model's light is not in the frame, sampling went on for 100,000 steps."""
    model = make_model()
    frame = np.full(model.detector.shape, counts or 0.0)
    if counts is None:
        frame = 1e-15 * np.random.default_rng(1).poisson(90.0, frame.shape)
    posterior = Posterior(model, frame, nuisances=Nuisances(flux))
    with pytest.raises(InputError, match=f"counts: {said} .* holds no information"):
        find_map(posterior)


def test_a_frame_of_noise_is_not_one_without_information() -> None:
    model = make_model()
    frame = np.random.default_rng(2).poisson(0.5, model.detector.shape)
    find_map(Posterior(model, frame))


def test_a_narrow_prior_determines_a_parameter() -> None:
    model = make_model(tolerance=1e-8)
    posterior = Posterior(
        model, simulate(model, np.zeros(12), 3.0, seed=35), prior={"f_ux": stats.norm(0.0, 1e-9)}
    )
    best = find_map(posterior)
    assert best.covariance[0, 0] == pytest.approx(1e-18)


@pytest.mark.parametrize("background", [-1.0, math.nan])
def test_map_refuses_a_start_without_density(background: float) -> None:
    model = make_model(tolerance=1e-8)
    posterior = Posterior(model, simulate(model, np.zeros(12), 3.0, seed=36))
    with pytest.raises(InputError, match="start: "):
        find_map(posterior, [0.0] * 12 + [background])


@pytest.mark.parametrize("level", [0.0, 0.02, 3.0])
def test_start_has_density(level: float) -> None:
    rng = np.random.default_rng(37)
    model = make_model(SourceCatalog.grid(2, 20.0, 50.0), tolerance=1e-8)
    for noise in (PoissonNoise(), PoissonNoise(2.0)):
        frame = noise.draw(model.expected_counts(np.zeros(12)), level, rng)
        for nuisances in (EVERYTHING, Nuisances("free")):
            posterior = Posterior(model, frame, noise=noise, nuisances=nuisances)
            assert math.isfinite(posterior.log_prob(posterior.start()))


def test_a_frame_without_background_is_fitted_and_sampled(tmp_path: Path) -> None:
    """Its background's posterior is an exponential distribution, whose rate is how much of the
    frame no source outshines."""
    sources = SourceCatalog([-5.0, -5.0, 5.0, 5.0], [-5.5, 4.5, -5.5, 4.5], np.full(4, 5e3))
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    model = ForwardModel(Detector((24, 24)), sources, GaussianPSF(1.5), distortion)
    posterior = Posterior(model, simulate(model, [0.0, 0.0], 1e-9, seed=2))
    best = find_map(posterior)
    assert best.at_maximum and best.params[2] < 1e-4
    chain = sample(posterior, best, path=tmp_path / "chain.h5", seed=1, progress=False)
    assert diagnose(chain).sampled_well
    # the marginal likelihood of the background, the distortion being known well
    level = np.linspace(0.0, 0.2, 2001)[1:]
    density = posterior.log_prob(
        np.column_stack([np.tile(best.params[:2], (level.size, 1)), level])
    )
    weight = np.exp(density - density.max())
    mean = float(level @ weight / weight.sum())
    sd = float(np.sqrt((level - mean) ** 2 @ weight / weight.sum()))
    assert abs(chain.draws()[:, 2].mean() - mean) < 4.0 * sd / np.sqrt(1000.0)


def test_a_background_at_zero_gives_finite_numbers() -> None:
    """Pixels between a source's reach and a segment's end have no expected counts then, and are in
    the likelihood."""
    sources = SourceCatalog([-5.0, -5.0, 5.0, 5.0], [-5.5, 4.5, -5.5, 4.5], np.full(4, 5e3))
    model = ForwardModel(
        Detector((24, 24)),
        sources,
        GaussianPSF(1.5),
        PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)]),
    )
    counts = simulate(model, [0.0, 0.0], 3.0, seed=1)
    posterior = Posterior(model, counts, mask=counts < 1)
    at = np.zeros(3)
    assert np.isfinite(posterior.log_prob(at)) and np.all(
        posterior.expected_counts(at)[posterior.mask] >= 0.0
    )
    assert np.all(np.isfinite(posterior.gradient(at))) and np.all(
        np.isfinite(posterior.information(at))
    )
    assert np.all(
        np.isfinite(
            posterior.noise.residual(posterior.counts, posterior.expected_counts(at), 0.0)[
                posterior.mask
            ]
        )
    )
    assert maximize(posterior, at).params[2] == 0.0
