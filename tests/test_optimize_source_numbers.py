"""How many fluxes and shifts of sources a fit takes from the counts: closed forms, and the sums of
fitted frames."""

from typing import Any

import numpy as np
import pytest

import bayesfred as bf
from bayesfred.optimize.fit_statistics import fit_statistics, misfit
from bayesfred.optimize.source_numbers import determined_numbers, own_radius

TERMS = bf.PolynomialDistortion(f_terms=[(1, 0, 0, 0)], g_terms=[(0, 1, 0, 0)])
FRAMES = 12


def posterior_of(
    sources: bf.SourceCatalog, scatter: float, rng: np.random.Generator, **options: Any
) -> tuple[bf.Posterior, np.ndarray]:
    """A simulated frame's posterior with free fluxes and shifts, and the true parameters."""
    model = bf.ForwardModel(bf.Detector((64, 64)), sources, bf.GaussianPSF(1.5), TERMS)
    nuisances = bf.Nuisances("free", position_scatter=True)
    moved = scatter * rng.standard_normal((2, len(sources)))
    true = bf.SourceCatalog(sources.x + moved[0], sources.y + moved[1], sources.flux)
    counts = bf.simulate(
        bf.ForwardModel(model.detector, true, model.psf, TERMS), [0.0, 0.0], 20.0,
        seed=int(rng.integers(2**31)),
    )  # fmt: skip
    posterior = bf.Posterior(model, counts, nuisances=nuisances, **options)
    known = {"background": 20.0, "position_scatter": scatter}
    return posterior, np.array([known.get(name, 0.0) for name in posterior.parameter_names])


@pytest.mark.parametrize(("scatter", "numbers"), [(1e-5, 2.0), (0.5, 6.0)])
def test_a_number_that_its_prior_holds_is_not_counted(scatter: float, numbers: float) -> None:
    sources = bf.SourceCatalog([-12.0, 10.0, 300.0], [0.0, 5.0, 0.0], [1e6, 1e6, 1e6])
    posterior, truth = posterior_of(sources, scatter, np.random.default_rng(1))
    assert determined_numbers(posterior, truth) == pytest.approx(numbers, abs=0.02)
    counted = fit_statistics(posterior, truth)["n_fitted"]
    assert counted == posterior.n_parameters + numbers


@pytest.mark.parametrize("flux", [30.0, 300.0, 3e3])
def test_a_number_that_both_tell_of_is_counted_in_part(flux: float) -> None:
    """Against differences of the expected counts, where priors and counts tell about as much."""
    scatter, h = 0.1, 1e-4
    posterior, truth = posterior_of(
        bf.SourceCatalog([0.3], [-0.2], [flux]), scatter, np.random.default_rng(4)
    )
    fitted = float(posterior.likelihood.fluxes(truth)[0])
    # the maximum's shift is within the prior's width, whose curvature it lowers
    *_, shifts = posterior.likelihood.own_pixels(truth, own_radius(posterior, truth))

    def counts(flux: float, x: float, y: float) -> np.ndarray:
        place = np.array([0.3 + x, -0.2 + y]) + shifts[0]
        source = bf.SourceCatalog(place[:1], place[1:], [flux])
        model = bf.ForwardModel(bf.Detector((64, 64)), source, bf.GaussianPSF(1.5), TERMS)
        return model.expected_counts([0.0, 0.0], 20.0)

    mean = counts(fitted, 0.0, 0.0)
    slopes = np.stack([
        counts(2.0 * fitted, 0.0, 0.0) - mean,  # by the relative flux
        (counts(fitted, h, 0.0) - counts(fitted, -h, 0.0)) / (2.0 * h),
        (counts(fitted, 0.0, h) - counts(fitted, 0.0, -h)) / (2.0 * h),
    ]).reshape(3, -1)  # fmt: skip
    known = (slopes / mean.ravel()) @ slopes.T
    k = 5.0 / (3.0 * scatter**2 + float(np.sum(shifts**2)))  # Student's t, 3 degrees of freedom
    expected = np.trace(known @ np.linalg.inv(known + np.diag([2.0, k, k])))
    assert 0.5 < expected < 2.9
    assert determined_numbers(posterior, truth) == pytest.approx(expected, abs=0.03)


def test_fixed_fluxes_are_not_counted() -> None:
    sources = bf.SourceCatalog([0.0], [0.0], [1e4])
    posterior, _ = posterior_of(sources, 0.1, np.random.default_rng(2))
    fixed = bf.Posterior(posterior.model, posterior.counts)
    assert determined_numbers(fixed, np.array([0.0, 0.0, 20.0])) == 0.0


def test_sums_of_frames_with_faint_sources_have_the_stated_mean() -> None:
    rng, z = np.random.default_rng(3), []
    for _ in range(FRAMES):
        x, y = np.meshgrid(np.arange(-25.0, 26.0, 10.0), np.arange(-25.0, 26.0, 10.0))
        x = np.concatenate([x.ravel(), 60.0 + 10.0 * np.arange(60.0)])
        y = np.concatenate([y.ravel(), np.zeros(60)])  # those are not in the frame
        sources = bf.SourceCatalog(x, y, np.where(np.arange(x.size) % 3, 300.0, 5e3))
        posterior, truth = posterior_of(sources, 0.02, rng)
        best = bf.find_map(posterior, start=truth)
        z.append(misfit(fit_statistics(posterior, best.params), "pearson"))
    # with three numbers of each of the 96 sources the mean would be 2.4
    assert abs(np.mean(z)) < 4.0 / FRAMES**0.5
