"""Convergence and sensitivity against known answers, measures of fit against simulated refits."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from emcee.autocorr import integrated_time
from numpy.typing import NDArray
from scipy.special import rel_entr, xlogy
from scipy.stats import norm, poisson

from bayesfred.analysis.diagnostics import Diagnostics, autocorrelation_time, diagnose
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import BackgroundNoise, PoissonNoise, simulate
from bayesfred.model.noise.poisson import deviance_moments
from bayesfred.model.parameters import Nuisances
from bayesfred.model.pixels import Expected
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.convergence import convergence, effective_size, rank_rhat
from bayesfred.sampling.sampler import sample

Floats = NDArray[np.float64]

array_stats: Any = import_module("arviz_stats.base").array_stats


def ar1(rng: np.random.Generator, shape: tuple[int, ...], phi: float) -> Floats:
    """Stationary AR(1) processes of unit variance along the last axis.

    Their tau is (1 + phi) / (1 - phi).
    """
    x = rng.standard_normal(shape)
    for t in range(1, shape[-1]):
        x[..., t] = phi * x[..., t - 1] + np.sqrt(1.0 - phi**2) * x[..., t]
    return x


def ensembles(
    rng: np.random.Generator, n_steps: int, phi: float = 0.0, d: int = 1, n_walkers: int = 32
) -> Floats:
    """A chain (4, n_steps, n_walkers, d) of independent AR(1) walkers."""
    return np.ascontiguousarray(ar1(rng, (4, n_walkers, d, n_steps), phi).transpose(0, 3, 1, 2))


# --- convergence ----------------------------------------------------------------------------------


@pytest.mark.parametrize("n_steps", [8, 10, 13, 20, 50, 200])
@pytest.mark.parametrize("phi", [0.0, 0.5, 0.9])
def test_effective_size_is_unbiased_for_chains_of_any_length(n_steps: int, phi: float) -> None:
    chain = ensembles(np.random.default_rng([n_steps, int(10 * phi)]), n_steps, phi, d=12)
    _, bulk, tail = convergence(chain)
    draws = chain[..., 0].size
    expected = draws * (1.0 - phi) / (1.0 + phi)
    assert np.all(bulk <= draws) and np.all(tail <= draws) and np.all(tail > 0.0)
    # a single estimate scatters by up to 15 %; the mean of twelve is known to 5 %
    assert np.mean(bulk) == pytest.approx(expected, rel=0.15)


def test_usual_estimator_fails_where_this_one_does_not() -> None:
    # the negative control of the test above: what it would say of an estimator with a mean per
    # chain
    walkers = ar1(np.random.default_rng(2), (128, 8), 0.9)
    truth = walkers.size * 0.1 / 1.9
    assert array_stats.ess(walkers) > 30.0 * truth
    assert effective_size(walkers) < 1.5 * truth


def test_effective_size_agrees_with_the_usual_estimator_for_long_chains() -> None:
    chain = ensembles(np.random.default_rng(3), 2000, 0.7)
    _, bulk, tail = convergence(chain)
    walkers = chain[..., 0].transpose(0, 2, 1).reshape(-1, 2000)
    assert bulk[0] == pytest.approx(array_stats.ess(walkers, method="bulk"), rel=0.05)
    assert tail[0] == pytest.approx(
        array_stats.ess(walkers, method="tail", prob=(0.05, 0.95)), rel=0.05
    )


def test_effective_size_predicts_the_error_of_the_mean() -> None:
    # judged against the scatter of 400 means, itself known to 1 / sqrt(2 * 400) = 3.5 %
    rng = np.random.default_rng(4)
    runs = ar1(rng, (400, 16, 200), 0.8)
    true = 1.0 / np.var(runs.mean(axis=(1, 2)))
    claimed = np.mean([effective_size(run) for run in runs[:40]])
    assert claimed == pytest.approx(true, rel=4 * np.sqrt(2.0 / 400))


def test_rank_rhat_equals_reference() -> None:
    rng = np.random.default_rng(5)
    for chains in (
        rng.normal(size=(4, 200)),
        rng.standard_cauchy((3, 101)),
        rng.poisson(2.0, (4, 50)).astype(float),
    ):
        assert rank_rhat(chains) == pytest.approx(float(array_stats.rhat(chains)), rel=1e-12)


@pytest.mark.parametrize("fault", ["shifted", "wider", "drifting"])
def test_disagreeing_ensembles_raise_rhat(fault: str) -> None:
    chain = ensembles(np.random.default_rng(6), 40)
    healthy = convergence(chain)[0][0]
    if fault == "shifted":
        chain[0] += 0.5
    elif fault == "wider":
        chain[0] *= 1.8
    else:
        chain += np.linspace(-0.6, 0.6, 40)[None, :, None, None]
    assert healthy < 1.005
    assert convergence(chain)[0][0] > 1.01


@pytest.mark.parametrize("n_steps", [0, 1, 2, 3, 5])
def test_too_few_steps_never_count(n_steps: int) -> None:
    rhat, bulk, tail = convergence(ensembles(np.random.default_rng(7), n_steps, d=3))
    for value in (rhat, bulk, tail):
        assert not np.any(np.isnan(value))
    assert np.all(bulk <= 4 * 32 * n_steps)
    if n_steps < 2:
        assert np.all(bulk == 0.0)


def test_stuck_and_broken_chains_do_not_converge() -> None:
    rng = np.random.default_rng(8)
    stuck = np.repeat(rng.normal(size=(4, 1, 32, 1)), 50, axis=1)
    constant = np.ones((4, 50, 32, 1))
    broken = ensembles(rng, 50)
    broken[2, 3, 4] = np.nan
    for chain in (stuck, constant, broken):
        rhat, bulk, tail = convergence(chain)
        assert min(bulk[0], tail[0]) < 64.0 and not np.isnan(rhat[0])
    assert convergence(constant)[0][0] == np.inf


def test_autocorrelation_time_agrees_with_emcee_and_with_the_truth() -> None:
    rng = np.random.default_rng(9)
    long = ar1(rng, (32, 5000), 0.8)
    theirs = integrated_time(long.T[:, :, None], quiet=True, tol=0)[0]
    assert autocorrelation_time(long) == pytest.approx(theirs, rel=0.02)
    assert autocorrelation_time(long) == pytest.approx(9.0, rel=0.1)
    short = np.mean([autocorrelation_time(ar1(rng, (128, 10), 0.0)) for _ in range(20)])
    assert short == pytest.approx(1.0, abs=0.1)
    assert np.isnan(autocorrelation_time(np.ones((4, 10))))


# --- goodness of fit ------------------------------------------------------------------------------


def direct_moments(mu: float) -> tuple[float, float, float]:
    """Mean, variance and mean's slope of the unit deviance, summed over the counts."""
    reach = 14.0 * np.sqrt(mu)
    n = np.arange(max(0, int(mu - reach)), int(mu + reach) + 40, dtype=float)
    chance = poisson.pmf(n, mu)
    deviance = 2.0 * (xlogy(n, n / mu) - n + mu)
    mean = float(chance @ deviance)
    return (
        mean,
        float(chance @ (deviance - mean) ** 2),
        float(chance @ ((deviance - mean) * (n - mu))) / mu,
    )


def test_deviance_moments_equal_direct_sums() -> None:
    grid = np.geomspace(1e-8, 1e5, 200)
    direct = np.array([direct_moments(mu) for mu in grid]).T
    mean, variance, slope = deviance_moments(grid)
    np.testing.assert_allclose(mean, direct[0], rtol=1e-4)
    np.testing.assert_allclose(variance, direct[1], rtol=1e-4)
    # the slope passes through zero: judged against the scale it enters the variance with
    assert np.max(np.abs(slope - direct[2]) * np.sqrt(grid / direct[1])) < 1e-4


@pytest.mark.parametrize("mu", [0.01, 0.7, 30.0])
def test_deviance_moments_agree_with_monte_carlo(mu: float) -> None:
    n = np.random.default_rng(10).poisson(mu, 400_000).astype(float)
    draws = 2.0 * (xlogy(n, n / mu) - n + mu)
    mean, variance, _ = (float(m[0]) for m in deviance_moments(np.array([mu])))
    fourth = np.mean((draws - mean) ** 4)
    assert abs(draws.mean() - mean) < 4.0 * np.sqrt(variance / n.size)
    assert abs(draws.var() - variance) < 4.0 * np.sqrt((fourth - variance**2) / n.size)


SHAPE = (40, 40)


def profile() -> Floats:
    """A spot of unit flux in the middle of a small frame."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]] - 19.5
    return np.asarray(np.exp(-(u**2 + v**2) / 18.0) / (18.0 * np.pi))


def linear_posterior(counts: Floats, noise: Any, mask: NDArray[np.bool_] | None = None) -> Any:
    """Stand-in for what `diagnose` reads: a source of free flux on a constant background."""
    spot = profile()

    @contextmanager
    def expected(params: Floats) -> Iterator[Expected]:
        yield Expected(params[0] * spot, np.full(SHAPE, params[1]), params[:1])

    return SimpleNamespace(
        counts=counts,
        mask=np.ones(SHAPE, bool) if mask is None else mask,
        parameter_names=("flux_scale", "background"),
        n_parameters=2,
        log_prob=lambda params: 0.0,
        noise=noise,
        nuisances=Nuisances("scale"),
        model=SimpleNamespace(
            sources=SimpleNamespace(flux=np.ones(1)), polynomial=SimpleNamespace(n_terms=0)
        ),
        likelihood=SimpleNamespace(expected=expected),
        psf_errors=None,
        noise_at=lambda params: noise,
        log_prior=lambda draws: np.zeros(len(draws)),
    )


def most_likely(counts: Floats, start: tuple[float, float], read_noise: float = 0.0) -> Floats:
    """Maximum of the (shifted) Poisson likelihood over flux and background, by Fisher scoring."""
    design = np.column_stack([profile().ravel(), np.ones(counts.size)])
    params = np.array(start)
    for _ in range(12):
        mu = design @ params + read_noise**2
        weighted = design / mu[:, None]
        step = np.linalg.solve(
            weighted.T @ design, weighted.T @ (counts.ravel() + read_noise**2 - mu)
        )
        params = np.maximum(params + step, 1e-6)
    return params


def chain_at(params: Floats, posterior: Any, **changes: Any) -> Any:
    """Stand-in for a chain of independent draws around `params`."""
    draws = np.random.default_rng(11).normal(size=(4, 15, 32, 2)) * 0.1 + params
    estimate = MapEstimate(params, np.eye(2), 0.0, 1, "done")
    fields = {
        "parameter_names": posterior.parameter_names,
        "chain": draws,
        "log_prob": np.zeros(draws.shape[:3]),
        "accepted": np.full((4, 32), 12),
        "burn_in": 3,
        "method": "mcmc",
        "record": None,
        "estimate": estimate,
        "posterior": lambda: posterior,
    }
    return SimpleNamespace(**(fields | changes))


def refits(flux: float, background: float, read_noise: float = 0.0, n: int = 300) -> list[Any]:
    """`diagnose` of many simulated and refitted frames."""
    rng = np.random.default_rng(int(flux))
    mu = flux * profile() + background
    out = []
    for _ in range(n):
        counts = (
            rng.poisson(mu) + rng.normal(0.0, read_noise, SHAPE)
            if read_noise
            else rng.poisson(mu).astype(float)
        )
        posterior = linear_posterior(counts, PoissonNoise(read_noise))
        params = most_likely(counts, (flux, background), read_noise)
        out.append(diagnose(chain_at(params, posterior), target_ess=100.0))
    return out


@pytest.mark.parametrize(("flux", "background"), [(3000.0, 5.0), (400.0, 0.1)])
@pytest.mark.parametrize("statistic", ["pearson", "deviance"])
def test_statistics_of_fitted_frames_have_the_stated_mean_and_sd(
    flux: float, background: float, statistic: str
) -> None:
    results = refits(flux, background)
    z = np.array(
        [
            (getattr(r, statistic) - getattr(r, f"{statistic}_expected"))
            / getattr(r, f"{statistic}_sd")
            for r in results
        ]
    )
    error = 1.0 / np.sqrt(z.size)
    assert abs(z.mean()) < 4.0 * error
    assert abs(z.std() - 1.0) < 4.0 * error / np.sqrt(2.0)


def test_sd_of_a_known_mean_would_fail_at_low_counts() -> None:
    # the negative control: N (2 + 1/mu) forgets that the background was fitted
    results = refits(400.0, 0.1)
    mu = 400.0 * profile() + 0.1
    z = np.array([r.pearson - r.pearson_expected for r in results]) / np.sqrt(
        np.sum(2.0 + 1.0 / mu)
    )
    assert z.std() < 0.6


def test_read_noise_is_part_of_the_variance() -> None:
    results = refits(3000.0, 5.0, read_noise=3.0, n=200)
    z = np.array([(r.pearson - r.pearson_expected) / r.pearson_sd for r in results])
    assert abs(z.mean()) < 0.3 and 0.8 < z.std() < 1.2


def test_paper_statistics_on_background_noise() -> None:
    # lambda-hat and the normalised chi-square: Sun and Zhou print 5.0025 and 1.0076 for lambda = 5
    rng = np.random.default_rng(12)
    z, chi2 = [], []
    for _ in range(200):
        noise = rng.poisson(5.0, SHAPE).astype(float)
        # the background at which a Gaussian of mean and variance lambda is most likely
        background = 0.5 * (np.sqrt(1.0 + 4.0 * np.mean(noise**2)) - 1.0)
        posterior = linear_posterior(1e4 * profile() + noise, BackgroundNoise())
        result = diagnose(chain_at(np.array([1e4, background]), posterior), target_ess=100.0)
        assert result.background_estimate == pytest.approx(noise.mean(), rel=1e-9)
        assert result.deviance == result.pearson and result.deviance_sd == result.pearson_sd
        chi2.append(result.chi2_paper)
        # the flux is not refitted here, so that one fitted number is one too many
        z.append((result.pearson - result.pearson_expected - 1.0) / result.pearson_sd)
    assert np.mean(chi2) == pytest.approx(1.0, abs=4.0 * np.std(chi2) / np.sqrt(200) + 1e-3)
    assert abs(np.mean(z)) < 4.0 / np.sqrt(200) and abs(np.std(z) - 1.0) < 4.0 / np.sqrt(400)


def test_wrong_model_is_seen_and_masked_pixels_are_not() -> None:
    rng = np.random.default_rng(13)
    mu = 3000.0 * profile() + 5.0
    counts = rng.poisson(mu).astype(float)
    counts[:5] += 40.0
    params = np.array([3000.0, 5.0])
    mask = np.ones(SHAPE, bool)
    mask[:5] = False
    noise = PoissonNoise()
    bad = diagnose(chain_at(params, linear_posterior(counts, noise)), target_ess=100.0)
    good = diagnose(chain_at(params, linear_posterior(counts, noise, mask)), target_ess=100.0)
    for result, low, high in ((bad, 20.0, np.inf), (good, -4.0, 4.0)):
        assert low < (result.pearson - result.pearson_expected) / result.pearson_sd < high
        assert low < (result.deviance - result.deviance_expected) / result.deviance_sd < high
    assert good.n_pixels == 35 * 40 and good.n_fitted == 2


def test_a_varying_background_has_no_paper_statistic() -> None:
    posterior = linear_posterior(np.full(SHAPE, 5.0), PoissonNoise())
    posterior.nuisances = Nuisances(background_order=1)
    result = diagnose(chain_at(np.array([1.0, 5.0]), posterior))
    assert np.isnan(result.background_estimate) and np.isnan(result.chi2_paper)


# --- sensitivity ----------------------------------------------------------------------------------


def weighed(prior: Any, likelihood: Any, steps: int = 300) -> Any:
    """`diagnose` of draws from a posterior that is normal in both parameters.

    Prior and likelihood are normal distributions of the first parameter; the second's likelihood is
    standard normal.
    """
    weights = np.array([part.std() ** -2 for part in (prior, likelihood)])
    mean, sd = weights @ [prior.mean(), likelihood.mean()] / weights.sum(), weights.sum() ** -0.5
    draws = np.random.default_rng(14).normal(size=(4, steps, 32, 2)) * [sd, 1.0] + [mean, 0.0]
    log_prob = (
        prior.logpdf(draws[..., 0]) + likelihood.logpdf(draws[..., 0]) + norm.logpdf(draws[..., 1])
    )
    posterior = linear_posterior(np.full(SHAPE, 5.0), PoissonNoise())
    posterior.log_prior = lambda x: prior.logpdf(x[:, 0])
    return diagnose(chain_at(np.array([1.0, 5.0]), posterior, chain=draws, log_prob=log_prob))


def distance(p: Any, q: Any) -> float:
    """Cumulative Jensen-Shannon distance of two normals over the range of 38,400 draws.

    The integrals' scale is the integral of the distribution functions, which grows with the range.
    """
    x = np.linspace(*p.ppf([0.5 / 38_400, 1.0 - 0.5 / 38_400]), 20_001)
    sides = []
    for one, other in ((p.cdf(x), q.cdf(x)), (p.sf(x), q.sf(x))):
        middle = 0.5 * (one + other)
        apart = (rel_entr(one, middle) + rel_entr(other, middle)) / np.log(2)
        sides.append(np.trapezoid(apart, x) / np.trapezoid(one + other, x))
    return float(np.sqrt(max(sides)))


def sensitivity(scaled: Any, fixed: Any) -> float:
    """Sensitivity of a normal posterior to the power of one of its two normal factors."""

    def posterior(alpha: float) -> Any:
        a, b = alpha / scaled.var(), 1.0 / fixed.var()
        return norm((a * scaled.mean() + b * fixed.mean()) / (a + b), (a + b) ** -0.5)

    moved = [
        distance(posterior(1.0), posterior(alpha)) / abs(np.log2(alpha)) for alpha in (0.99, 1.01)
    ]
    return float(np.mean(moved))


FRAME = norm(0.0, 1.0)  # a likelihood


@pytest.mark.parametrize("prior", [norm(0.0, 1.0), norm(2.0, 1.0), norm(1.0, 0.3), norm(3.0, 10.0)])
def test_sensitivity_of_a_conjugate_normal_is_known(prior: Any) -> None:
    # over seeds the sensitivity scatters by up to 3.6 %, or 1e-4 where it is small
    result = weighed(prior, FRAME)
    assert result.prior_sensitivity["flux_scale"] == pytest.approx(
        sensitivity(prior, FRAME), rel=0.15, abs=4e-4
    )
    assert result.likelihood_sensitivity["flux_scale"] == pytest.approx(
        sensitivity(FRAME, prior), rel=0.15, abs=4e-4
    )
    assert result.prior_sensitivity["background"] < 0.01  # but for chance the prior has no say
    assert result.likelihood_sensitivity["background"] > 0.05


def test_narrow_priors_are_named_and_broad_ones_are_not() -> None:
    # 2,560 draws, as a short run has; the frame's value lies a typical distance from the middle of
    # the prior
    for sd, named in ((0.5, True), (1.0, True), (10.0, False), (1000.0, False)):
        prior = norm(np.hypot(sd, 1.0), sd)
        assert weighed(prior, FRAME, steps=20).prior_dominated == (("flux_scale",) if named else ())


def test_sensitivity_needs_draws_that_vary() -> None:
    for chain in (np.ones((4, 15, 32, 2)), np.random.default_rng(15).normal(size=(2, 4, 4, 2))):
        posterior = linear_posterior(np.full(SHAPE, 5.0), PoissonNoise())
        posterior.log_prior = lambda x: -0.5 * x[:, 0] ** 2
        result = diagnose(
            chain_at(
                np.array([1.0, 5.0]), posterior, chain=chain, log_prob=-0.5 * chain[..., 0] ** 2
            )
        )
        assert result.prior_dominated == ()


# --- verdict --------------------------------------------------------------------------------------


def healthy_chain(**changes: Any) -> Any:
    counts = np.random.default_rng(16).poisson(profile() + 5.0).astype(float)
    posterior = linear_posterior(counts, PoissonNoise())
    return chain_at(np.array([1.0, 5.0]), posterior, **changes)


def test_healthy_chain_is_trustworthy() -> None:
    result = diagnose(healthy_chain())
    assert result.sampled_well and result.fits_data and result.trustworthy
    assert result.message.startswith("trustworthy: The model fits the counts: ")
    assert "Sampled well: R-hat" in result.message
    assert result.acceptance == pytest.approx(12 / 15)
    assert result.n_draws == 4 * 12 * 32
    assert set(result.rhat) == set(result.tau) == {"flux_scale", "background"}
    assert "\n" not in result.message


def shifted() -> Floats:
    draws = np.array(healthy_chain().chain)
    draws[0, ..., 1] += 0.1
    return draws


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"chain": shifted()}, "R-hat"),
        ({"accepted": np.full((4, 32), 1)}, "acceptance"),
        ({"burn_in": 9}, "effective sample size"),
        ({"burn_in": 15}, "R-hat"),
        ({"estimate": MapEstimate(np.array([1.0, 5.0]), np.eye(2), 0.0, 1, "lost", False)}, "lost"),
    ],
    ids=["ensembles disagree", "hardly accepts", "too short", "no draws", "no MAP"],
)
def test_faults_of_sampling_are_named(changes: dict[str, Any], reason: str) -> None:
    result = diagnose(healthy_chain(**changes))
    assert not result.sampled_well and not result.trustworthy
    assert result.fits_data and result.message.startswith("not trustworthy: The model fits ")
    assert "Not sampled well: " in result.message
    assert reason in result.message and "\n" not in result.message


def with_psf(sigma: float) -> tuple[MapEstimate, Diagnostics]:
    """Maximum and verdict of a frame whose PSF is a Gaussian of 2.5 pixels, not of `sigma`."""
    distortion = PolynomialDistortion([(1, 0, 1, 0)], [(0, 1, 0, 1)])
    sources = SourceCatalog.grid(3, 16.0, 5e3)

    def model(width: float) -> ForwardModel:
        return ForwardModel(Detector((60, 75)), sources, GaussianPSF(width), distortion)

    counts = simulate(model(2.5), [2e-4, -3e-4], 3.0, seed=1)
    posterior = Posterior(model(sigma), counts)
    estimate = find_map(posterior)
    with TemporaryDirectory() as folder:
        chain = sample(posterior, estimate, path=Path(folder, "c.h5"), seed=1, progress=False)
        return estimate, diagnose(chain)


def test_a_psf_that_is_too_wide_is_sampled_well_and_does_not_fit() -> None:
    estimate, verdict = with_psf(1.2 * 2.5)
    assert estimate.at_maximum and not estimate.fits_data
    assert verdict.sampled_well and not verdict.fits_data and not verdict.trustworthy
    assert re.match(
        r"not trustworthy: The model does not fit the counts: deviance \d+\.\d standard deviations "
        r"above and Pearson's statistic \d+\.\d standard deviations above expectation \(at most 5 "
        r"if it did\), 9 of 9 sources matched\. Probable cause: PSF \(\d+% of the misfit\): "
        r".* Remedy: .*\. Sampled well: R-hat .*\. The error bars leave out .*\.$",
        verdict.message,
    )
    assert verdict.causes[0].name == "PSF"


def test_the_right_psf_is_trustworthy() -> None:
    estimate, verdict = with_psf(2.5)
    assert estimate.at_maximum and estimate.fits_data
    assert verdict.sampled_well and verdict.fits_data and verdict.trustworthy
