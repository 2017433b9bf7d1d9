"""Hot and dead pixels within images, which show once the frame's PSF is known."""

from dataclasses import replace

import numpy as np
import pytest

import bayesfred as bf
from bayesfred._typing import Flags
from bayesfred.optimize.find_map import approach
from bayesfred.optimize.fit_psf import find_psf
from bayesfred.optimize.sharp_pixels import sharp_pixels

FRAMES, PLANTED = 5, 6


def posterior_of(fwhm: float, rng: np.random.Generator, kind: str) -> tuple[bf.Posterior, Flags]:
    """Stars of 2,000 to 60,000 photons, and the pixels of their images that were changed."""
    grid = np.arange(-3, 4) * 20.3
    x, y = (each.ravel() + rng.uniform(-0.5, 0.5, 49) for each in np.meshgrid(grid, grid))
    sources = bf.SourceCatalog(x, y, 10.0 ** rng.uniform(3.3, 4.8, x.size))
    lens = bf.PolynomialDistortion(f_terms=[(1, 0, 0, 0)], g_terms=[(0, 1, 0, 0)])
    detector = bf.Detector((161, 161), pixel="box")
    true = bf.ForwardModel(detector, sources, bf.MoffatPSF(fwhm, 3.0), lens)
    light = true.expected_counts(np.zeros(2))
    counts, changed = rng.poisson(light + 20.0).astype(float), np.zeros(light.shape, bool)
    order = rng.choice(len(sources), PLANTED, replace=False)
    column, row = (np.rint(each[order]).astype(int) + 80 for each in (x, y))
    if kind in ("hot", "dead"):
        row += 1
        changed[row, column] = True
        more = 30.0 * np.sqrt(light[row, column] + 20.0) + 0.5 * light[row, column]
        counts[row, column] = counts[row, column] + more if kind == "hot" else 0.0
    if kind == "companions":
        beside = bf.SourceCatalog(x[order] + 1.5 * fwhm, y[order], 0.3 * sources.flux[order])
        companions = replace(true, sources=beside).expected_counts(np.zeros(2))
        counts += rng.poisson(companions)
    model = replace(true, psf=bf.MoffatPSF(1.05 * fwhm if kind == "PSF" else fwhm, 3.0))
    nuisances = bf.Nuisances(flux="free", footprint=3.0 * fwhm + 2.0)
    return bf.Posterior(model, counts, nuisances=nuisances), changed


@pytest.mark.slow
@pytest.mark.parametrize("fwhm", [1.2, 3.0])
def test_planted_pixels_are_found_and_nothing_else(fwhm: float) -> None:
    """Of 30 hot pixels 28, of 30 dead ones, some of which hold little light, 18 at least.

    In five frames of each kind one other pixel at most: not of noise, of companions, or where the
    PSF is 5 % too wide.
    """
    rng, found, others = np.random.default_rng(7), {}, {}
    for kind in ("hot", "dead", "nothing", "companions", "PSF"):
        found[kind] = others[kind] = 0
        for _ in range(FRAMES):
            posterior, changed = posterior_of(fwhm, rng, kind)
            sharp = sharp_pixels(posterior, bf.find_map(posterior).params)
            found[kind] += int(sharp[changed].sum())
            others[kind] += int(sharp[~changed].sum())
    assert found["hot"] >= 28 and found["dead"] >= 18, found
    assert max(others.values()) <= 1, others


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["companions", "nothing"])
def test_what_a_measured_psf_does_not_explain_is_left_out(kind: str) -> None:
    """Companions of six stars, which searches with a rough PSF have to tolerate.

    Chi-square of the distortion, two coefficients, exceeds 18.4 for one in 10,000.
    """
    posterior, _ = posterior_of(2.0, np.random.default_rng(2), kind)
    rough = replace(
        posterior.with_psf(bf.GaussianPSF(0.9)),
        nuisances=replace(posterior.nuisances, psf_sigma=True),
    )
    kept, estimate = approach(rough, rejecting=True)
    left, errors = {}, {}
    for reject in (False, True):
        measured, top = bf.measure_psf(kept, estimate, model_error=True, reject_outliers=reject)
        left[reject] = measured.mask
        errors[reject] = top.params[measured.parameter_names.index("model_error")]
        off, covariance = top.params[:2], top.covariance[:2, :2]
        assert off @ np.linalg.solve(covariance, off) < 18.4
    if kind == "nothing":
        np.testing.assert_array_equal(left[True], left[False])
    else:
        assert errors[False] > 0.1 and errors[True] < 0.02
        assert 0 < np.sum(left[False] & ~left[True]) < 0.1 * kept.mask.sum()


@pytest.mark.slow
@pytest.mark.parametrize(("photons", "beta"), [(1e4, 20.0), (1e6, 2.5)])
def test_a_psf_is_the_same_from_its_own_solution(photons: float, beta: float) -> None:
    """With the grid for wings, which bright stars need, and without: within 0.1 of its errors."""
    model = bf.ForwardModel(
        bf.Detector((121, 121), pixel="box"), bf.SourceCatalog.grid(4, 26.3, photons),
        bf.MoffatPSF(2.5, beta), bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]),
    )  # fmt: skip
    counts = bf.simulate(model, [1e-3, 0.0], 5.0, seed=3)
    rough = bf.Posterior(replace(model, psf=bf.GaussianPSF(1.2)), counts)
    estimate = bf.find_map(rough)
    cold, state, _ = find_psf(rough, estimate, 4, 0, 0)
    assert bool(state.grid.wings) == (beta < 3.0)
    warm, again, _ = find_psf(rough, estimate, 4, 0, 0, state)
    assert again.grid == state.grid
    difference = warm.coefficients - cold.coefficients
    assert np.all(np.abs(difference) <= 0.1 * cold.draws.std(axis=0) + 1e-9)
