"""Gradient, Fisher information and free fluxes against finite differences, quadrature and scipy's
optimisers."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from oracles import next_term
from scipy import optimize, special, stats
from test_model import (
    EVERYTHING,
    LIMIT,
    Noise,
    background_image,
    dense_image,
    flat_priors,
    known,
    make_model,
    make_posterior,
    make_truth,
)

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.forward import ForwardModel
from bayesfred.model.noise import BackgroundNoise, GaussianNoise, PoissonNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior

Floats = NDArray[np.float64]

FREE = Nuisances("free")
FREE_AND_ALL = Nuisances("free", offset=True, psf_sigma=True, background_order=4)
# of a parameter's error, the others fixed: what the five-point rule leaves out is STEP^4 / 30 =
# 5e-9 of it
STEP = 0.02


def five_point(function: Callable[[Floats], Any], at: Floats, k: int, step: float) -> Any:
    """Derivative with respect to parameter k."""
    shifts = step * np.eye(at.size)[k]
    before, after = (function(at - m * shifts) - function(at + m * shifts) for m in (2, 1))
    return (before - 8 * after) / (12 * step)


def overlapping(flux: float = 4e3, **options: Any) -> ForwardModel:
    """Nine sources 17 pixels apart: with tolerance 0 each reaches the whole frame."""
    return make_model(SourceCatalog.grid(3, 17.0, flux), **options)


def isolated(flux: float = 4e3) -> ForwardModel:
    """Four sources 34 pixels apart, cut at 1e-14 of the peak, 8 sigma = 12 pixels: their windows do
    not touch."""
    grid = SourceCatalog.grid(2, 34.0, flux)
    return make_model(grid, sigma=1.5, tolerance=1e-14, detector=Detector((64, 80)))


def touching(flux: float = 4e3) -> ForwardModel:
    """Two sources whose images overlap and one apart."""
    catalogue = SourceCatalog(
        [-20.0, -13.0, 20.0], [-5.0, -2.0, 3.0], np.array([1.0, 0.4, 0.7]) * flux
    )
    return make_model(catalogue, sigma=2.0, tolerance=1e-14)


def errors(posterior: Posterior, params: Floats) -> Floats:
    """Every parameter's error if the others were known."""
    return np.asarray(1.0 / np.sqrt(np.diag(posterior.information(params))))


CASES: dict[str, tuple[ForwardModel, Nuisances, Noise, float]] = {
    "fixed": (overlapping(), Nuisances(), PoissonNoise(), 3.0),
    "printed kernel": (overlapping(conserve_flux=False), Nuisances("scale"), PoissonNoise(), 3.0),
    "scale": (overlapping(), Nuisances("scale"), PoissonNoise(), 3.0),
    "offset": (overlapping(), Nuisances(offset=True), PoissonNoise(), 3.0),
    "psf": (overlapping(), Nuisances(psf_sigma=True), PoissonNoise(), 3.0),
    "slopes": (overlapping(), Nuisances(background_order=1), PoissonNoise(), 3.0),
    "curved": (isolated(), Nuisances(background_order=4), PoissonNoise(), 3.0),
    "everything": (overlapping(), EVERYTHING, PoissonNoise(1.5), 3.0),
    "paper": (
        overlapping(),
        Nuisances("scale", offset=True, psf_sigma=True),
        BackgroundNoise(),
        3.0,
    ),
    "gaussian": (isolated(), Nuisances("scale", psf_sigma=True), GaussianNoise(20.0), 3.0),
    "gaussian, curved": (
        isolated(),
        Nuisances("scale", background_order=3),
        GaussianNoise(20.0),
        3.0,
    ),
    "variance image": (
        isolated(),
        Nuisances("scale", offset=True),
        GaussianNoise(np.random.default_rng(30).uniform(5.0, 50.0, (64, 80))),
        3.0,
    ),
    "free, gaussian": (
        touching(),
        FREE_AND_ALL,
        GaussianNoise(np.random.default_rng(31).uniform(5.0, 50.0, (60, 75))),
        3.0,
    ),
    "footprint": (isolated(), Nuisances(footprint=9.0), PoissonNoise(), 3.0),
    "binned": (overlapping(detector=Detector((20, 25), 3)), EVERYTHING, PoissonNoise(), 20.0),
    "box": (overlapping(detector=Detector((30, 37), 2, "box")), EVERYTHING, PoissonNoise(), 9.0),
    "free, isolated": (isolated(), FREE, PoissonNoise(), 3.0),
    "free, touching": (touching(), FREE_AND_ALL, PoissonNoise(), 3.0),
    "free, overlapping": (overlapping(), FREE_AND_ALL, PoissonNoise(1.5), 3.0),
    "free, few photons": (touching(60.0), Nuisances("free", offset=True), PoissonNoise(), 0.05),
    "free, box": (
        overlapping(detector=Detector((30, 37), 2, "box")),
        FREE_AND_ALL,
        PoissonNoise(),
        9.0,
    ),
}


# what costs most to compile is not in the default run
COSTLY = {
    "gaussian": pytest.mark.slow,
    "gaussian, curved": pytest.mark.slow,
    "variance image": pytest.mark.slow,
    "free, gaussian": pytest.mark.long,
}


@pytest.mark.parametrize("case", [pytest.param(c, marks=COSTLY.get(c, ())) for c in CASES])
def test_gradient_is_that_of_log_prob(case: str) -> None:
    model, nuisances, noise, background = CASES[case]
    rng = np.random.default_rng(20)
    mask = rng.random(model.detector.shape) < 0.9
    posterior, truth = make_posterior(
        model, make_truth(model, rng, background), rng, nuisances, noise, mask=mask
    )
    scale = errors(posterior, truth)
    params = truth + 0.5 * scale * rng.uniform(-1, 1, truth.size)
    numerical = [
        five_point(posterior.log_prob, params, k, STEP * scale[k]) for k in range(truth.size)
    ]
    # log_prob is rounded at 1e-12, which the step makes 1e-10
    assert posterior.gradient(params) * scale == pytest.approx(
        np.array(numerical) * scale, rel=1e-6, abs=1e-6
    )


# --- Fisher information ---------------------------------------------------------------------------


def full_information(posterior: Posterior, params: Floats, fluxes: Floats | None) -> Floats:
    """J^T diag(1 / variance) J from dense images; with fluxes, these are further parameters with
    the prior's 1 / F^2."""
    model, shape = posterior.model, posterior.model.detector.shape
    order = model.detector.quadrature(model.psf.sigma)[0].size

    def mean(values: Floats) -> Floats:
        named = dict(zip(posterior.parameter_names, values, strict=True))
        return dense_image(model, named, fluxes, order) + background_image(shape, named)

    scale = errors(posterior, params)
    columns = [five_point(mean, params, k, STEP * scale[k]) for k in range(params.size)]
    named = dict(zip(posterior.parameter_names, params, strict=True))
    if fluxes is not None:
        columns += [dense_image(model, named, one, order) for one in np.eye(fluxes.size)]
    jacobian = np.stack(columns)[:, posterior.mask]
    background = background_image(shape, named)[posterior.mask]
    noise = posterior.noise.at(posterior.mask)
    jacobian_weighted = jacobian * noise.fisher_weight(mean(params)[posterior.mask], background)
    information = jacobian_weighted @ jacobian.T
    if isinstance(posterior.noise, BackgroundNoise):  # the background is the variance, too
        k = posterior.parameter_names.index("background")
        information[k, k] += 0.5 * np.sum(background**-2.0)
    if fluxes is not None:
        shape = posterior.nuisances.flux_shape
        information[params.size :, params.size :] += np.diag(shape * fluxes**-2)
    return np.asarray(information)


@pytest.mark.parametrize(
    "case",
    [pytest.param(c, marks=COSTLY.get(c, ())) for c in CASES if "free" not in c and c != "box"],
)
def test_fisher_is_that_of_the_dense_jacobian(case: str) -> None:
    model, nuisances, noise, background = CASES[case]
    rng = np.random.default_rng(21)
    mask = rng.random(model.detector.shape) < 0.9
    posterior, params = make_posterior(
        model, make_truth(model, rng, background), rng, nuisances, noise, mask=mask
    )
    scale = np.outer(errors(posterior, params), errors(posterior, params))
    assert posterior.fisher(params) * scale == pytest.approx(
        full_information(posterior, params, None) * scale, abs=1e-7
    )


@pytest.mark.parametrize(
    "case",
    [
        "free, isolated",
        "free, touching",
        "free, overlapping",
        "free, few photons",
        pytest.param("free, gaussian", marks=COSTLY["free, gaussian"]),
    ],
)
def test_fisher_with_free_fluxes_is_the_schur_complement(case: str) -> None:
    model, nuisances, noise, background = CASES[case]
    rng = np.random.default_rng(22)
    posterior, params = make_posterior(
        model, make_truth(model, rng, background), rng, nuisances, noise
    )
    full, d = full_information(posterior, params, posterior.fluxes(params)), params.size
    expected = full[:d, :d] - full[:d, d:] @ np.linalg.solve(full[d:, d:], full[d:, :d])
    scale = np.outer(errors(posterior, params), errors(posterior, params))
    assert posterior.fisher(params) * scale == pytest.approx(expected * scale, abs=1e-6)
    assert (
        np.linalg.eigvalsh(full[:d, :d] * scale - posterior.fisher(params) * scale).min() > -1e-9
    )  # free fluxes cost


def score_excess(scores: Floats, information: Floats) -> float:
    """Mean of |s|^2 in units of the information, and its distance from d in Monte Carlo errors."""
    squares = np.sum(scores * np.linalg.solve(information, scores.T).T, axis=1)
    return float(
        (squares.mean() - information.shape[0]) / (squares.std() / math.sqrt(squares.size))
    )


SCORED = [(EVERYTHING, PoissonNoise()), (Nuisances("scale", offset=True), BackgroundNoise())]


@pytest.mark.slow
@pytest.mark.parametrize(("nuisances", "noise"), SCORED)
def test_fisher_is_the_covariance_of_the_score(nuisances: Nuisances, noise: Noise) -> None:
    rng = np.random.default_rng(23)
    # the paper's noise is fitted as a Gaussian, whose information about the variance is right for
    # many photons
    model, background = overlapping(detector=Detector((20, 25), 3), flux=2e3), 200.0
    truth = make_truth(model, rng, background)
    prior = flat_priors((*model.distortion.names, "background", *nuisances.names), truth)
    scores = []
    for _ in range(400):
        posterior, params = make_posterior(model, truth, rng, nuisances, noise, prior=prior)
        scores.append(posterior.gradient(params))
    information, drawn = posterior.fisher(params), np.array(scores)
    assert abs(score_excess(drawn, information)) < LIMIT
    whitened = np.linalg.solve(np.linalg.cholesky(information), drawn.T)
    # entries of a sample covariance scatter by 1 / sqrt(n), and by sqrt(2 / n) on the diagonal;
    # there are up to 171
    assert np.abs(np.cov(whitened) - np.eye(params.size)).max() < 1.25 * LIMIT * math.sqrt(2 / 400)
    assert np.abs(whitened.mean(axis=1)).max() < LIMIT / math.sqrt(400)
    # negative control: information 15 % too small is noticed
    assert abs(score_excess(drawn, 0.85 * information)) > LIMIT


# --- free fluxes ----------------------------------------------------------------------------------


def parts(posterior: Posterior, params: Floats) -> tuple[Floats, Floats]:
    """Unit-flux images of all sources, and the background, in the likelihood's pixels."""
    named = dict(zip(posterior.parameter_names, params, strict=True))
    stamps = [
        dense_image(posterior.model, named, one)[posterior.mask]
        for one in np.eye(len(posterior.model.sources))
    ]
    return np.array(stamps), background_image(posterior.model.detector.shape, named)[posterior.mask]


def joint(posterior: Posterior, stamps: Floats, background: Floats, fluxes: Floats) -> Floats:
    """Log-likelihood plus log-prior of log F for fluxes F, shape (n, n_sources), by scipy."""
    counts = posterior.counts[posterior.mask]
    terms = posterior.noise.log_likelihood(counts, fluxes @ stamps + background, 0.0)
    shape = posterior.nuisances.flux_shape
    prior = stats.gamma(shape, scale=posterior.model.sources.flux / shape).logpdf(fluxes)
    return np.asarray(np.sum(terms, axis=-1) + np.sum(prior + np.log(fluxes), axis=-1))


@pytest.mark.parametrize(
    "case", ["free, isolated", "free, touching", "free, overlapping", "free, few photons"]
)
def test_profiled_fluxes_are_the_maximum_and_log_prob_the_integral_s_expansion(case: str) -> None:
    model, nuisances, noise, background = CASES[case]
    rng = np.random.default_rng(24)
    mask = rng.random(model.detector.shape) < 0.9
    posterior, params = make_posterior(
        model, make_truth(model, rng, background), rng, nuisances, noise, mask=mask
    )
    stamps, level = parts(posterior, params)
    counts = posterior.counts[mask]
    catalogue, shape = posterior.model.sources.flux, nuisances.flux_shape

    def slope(log_flux: Floats) -> Floats:
        flux = np.exp(log_flux)
        score = noise.score(counts, flux @ stamps + level, 0.0)
        return np.asarray(-flux * (stamps @ score + shape / flux - shape / catalogue))

    found = optimize.minimize(
        lambda z: -joint(posterior, stamps, level, np.exp(z)),
        np.log(catalogue),
        jac=slope,
        method="BFGS",
        options={"gtol": 1e-5},
    )
    profiled = posterior.fluxes(params)
    at = profiled @ stamps + level
    step = 1e-4 * at
    ahead = [noise.score(counts, at + k * step, 0.0) for k in (-2, -1, 1, 2)]
    weight = -(ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / (12 * step)
    information = (stamps * weight) @ stamps.T + np.diag(shape * profiled**-2)
    error = np.sqrt(np.diag(np.linalg.inv(information)))
    assert slope(np.log(profiled)) / profiled * error == pytest.approx(0.0, abs=1e-7)
    assert profiled == pytest.approx(np.exp(found.x), abs=1e-3 * error.min(), rel=1e-6)
    information *= np.outer(profiled, profiled)  # about the logarithms
    middle = noise.score(counts, at, 0.0)
    curve = (16 * (ahead[1] + ahead[2]) - ahead[0] - ahead[3] - 30 * middle) / (24 * step**2)
    faint = posterior.likelihood._faint
    more = next_term((profiled[:, None] * stamps)[faint], weight, curve, shape)
    laplace = (
        0.5 * len(model.sources) * math.log(2 * math.pi) - 0.5 * np.linalg.slogdet(information)[1]
    )
    expected = joint(posterior, stamps, level, profiled) + laplace + more
    value = posterior.log_prob(params) - posterior.log_prior(params)[0]
    assert value == pytest.approx(float(expected), rel=1e-11)


def frame_of_touching_sources(trouble: str) -> tuple[float, Floats]:
    """The background that is assumed, and a frame of counts that it does not explain."""
    model, rng = touching(), np.random.default_rng(25)
    truth = known(make_truth(model, rng, 3.0), FREE)
    frame = rng.poisson(dense_image(model, truth) + 3.0).astype(float)
    hot = np.zeros(frame.shape)
    hot[28, 20] = 1e6
    return {
        "dark": (1e-3, 0 * frame),
        "one photon": (1e-3, 1.0 * (hot > 0)),
        "brighter": (300.0, 100 * frame),
        "hot pixel": (1.0, frame + hot),
        "bright sky": (1.0, frame + 100),
    }[trouble]


@pytest.mark.parametrize(
    "trouble",
    [
        "dark",
        "one photon",
        "brighter",
        "hot pixel",
        "bright sky",
    ],
)
def test_profiled_fluxes_are_found_in_any_frame(trouble: str) -> None:
    # the problem is concave, whatever the frame
    model = touching()
    background, frame = frame_of_touching_sources(trouble)
    posterior = Posterior(model, frame, nuisances=FREE, prior={"background": stats.uniform(0, 1e4)})
    params = np.array([0.0] * 12 + [background])
    stamps, level = parts(posterior, params)
    flux = posterior.fluxes(params)
    score = stamps @ (frame.ravel() / (flux @ stamps + level) - 1)
    slope = score + 2 / flux - 2 / model.sources.flux
    assert posterior.log_prob(params) > -math.inf
    assert (flux > 0).all() and slope * flux == pytest.approx(
        0.0, abs=1e-6 * (1 + frame.sum()) ** 0.5
    )


def quadrature(posterior: Posterior, params: Floats) -> float:
    """Log of the integral of the joint density over the logarithms of all fluxes, by the
    trapezoidal rule over +-10 errors."""
    stamps, level = parts(posterior, params)
    best = posterior.fluxes(params)
    counts = posterior.counts[posterior.mask]
    information = (stamps * counts / (best @ stamps + level) ** 2) @ stamps.T
    information = information * np.outer(best, best) + 2 * np.eye(best.size)
    lower = np.linalg.cholesky(np.linalg.inv(information))
    axis = np.linspace(-10, 10, 161)
    z = np.stack(np.meshgrid(*[axis] * best.size), axis=-1).reshape(-1, best.size)
    fluxes = best * np.exp(z @ lower.T)
    values = np.concatenate(
        [
            joint(posterior, stamps, level, part)
            for part in np.array_split(fluxes, 1 + len(fluxes) // 1000)
        ]
    )
    return float(
        special.logsumexp(values)
        + best.size * math.log(axis[1] - axis[0])
        + np.log(np.diag(lower)).sum()
    )


@pytest.mark.parametrize("background", [0.01, 1.0])
def test_integral_over_an_isolated_flux(background: float) -> None:
    # Laplace's error is of the order 1/n in the number of photons, that of the next term 1/n^2
    relative = []
    for flux in (100.0, 1000.0, 10000.0):
        model = make_model(
            SourceCatalog([3.0], [-2.0], [flux]), detector=Detector((24, 32)), sigma=2.0
        )
        rng = np.random.default_rng(26)
        posterior, params = make_posterior(model, make_truth(model, rng, background), rng, FREE)
        value = posterior.log_prob(params) - posterior.log_prior(params)[0]
        relative.append(flux * (quadrature(posterior, params) - value))
    assert abs(relative[0]) < 0.03  # expanded: of the order of 1 / flux
    assert np.abs(relative).max() < 0.25


def test_integral_over_two_touching_fluxes() -> None:
    model = make_model(
        SourceCatalog([-1.0, 1.5], [0.0, 1.0], [900.0, 400.0]),
        detector=Detector((20, 26)),
        sigma=2.0,
    )
    rng = np.random.default_rng(27)
    posterior, params = make_posterior(model, make_truth(model, rng, 0.5), rng, FREE)
    stamps, _ = parts(posterior, params)
    value = posterior.log_prob(params) - posterior.log_prior(params)[0]
    error = quadrature(posterior, params) - value
    assert abs(error) < 1 / 900 + 1 / 400  # of the order of one over each source's photons
    # negative control: without the correlation of the two fluxes the integral is visibly another
    best, counts = posterior.fluxes(params), posterior.counts.ravel()
    mean = posterior.expected_counts(params).ravel()
    information = (stamps * counts / mean**2) @ stamps.T + np.diag(2 * best**-2)
    alone = 0.5 * np.log(np.diag(information)).sum() - 0.5 * np.linalg.slogdet(information)[1]
    assert alone > 0.01


# --- outside the support --------------------------------------------------------------------------


@pytest.mark.parametrize("background", [-1.0, 0.0])
def test_derivatives_are_nan_where_the_background_has_no_likelihood(background: float) -> None:
    rng = np.random.default_rng(28)
    posterior, params = make_posterior(
        make_model(tolerance=1e-8), make_truth(make_model(), rng), rng
    )
    params[-1] = background
    assert posterior.log_prob(params) == -math.inf
    assert np.isnan(posterior.gradient(params)).all() and np.isnan(posterior.fisher(params)).all()


@pytest.mark.parametrize("nuisances", [Nuisances(), FREE], ids=["fixed", "free"])
def test_derivatives_are_nan_where_a_map_folds(nuisances: Nuisances) -> None:
    rng = np.random.default_rng(29)
    posterior, params = make_posterior(make_model(), make_truth(make_model(), rng), rng, nuisances)
    value, gradient = posterior.log_prob(params), posterior.gradient(params)
    folded = params.copy()
    folded[0] = 0.3
    assert np.isnan(posterior.gradient(folded)).all() and np.isnan(posterior.fisher(folded)).all()
    assert np.isnan(posterior.expected_counts(folded)).all()
    assert posterior.log_prob(params) == value and np.array_equal(
        posterior.gradient(params), gradient
    )
