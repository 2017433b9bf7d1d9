"""Neighbouring sources that are displaced alike: found, and independent ones not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table
from numpy.typing import NDArray

import bayesfred as bf
from bayesfred.analysis.causes.pixels import displaced_alike
from bayesfred.analysis.neighbours import NOTICEABLE, neighbours
from bayesfred.analysis.residuals import judge_residuals
from bayesfred.analysis.verdict import judge_fit
from bayesfred.model.parameters import Nuisances
from bayesfred.optimize.fit_statistics import fit_statistics

Floats = NDArray[np.float64]


def table_of(places: Floats, displacements: Floats, sd: float = 0.01) -> Table:
    """Sources at some places, (n, 2), and where they are found, (n, 2)."""
    columns = dict(zip(("u", "v", "du", "dv"), [*places.T, *displacements.T], strict=True))
    same = np.full(len(places), sd)
    return Table(columns | {"du_sd": same, "dv_sd": same, "isolated": np.ones(len(places), bool)})


def test_independent_displacements_are_not_alike() -> None:
    """Of 1,000 fields of 25 to 400 sources, half of them with heavy tails, none is noticed.

    The mean of z within 4 Monte Carlo errors, its standard deviation within 4 errors of 2.2 %.
    """
    rng, z = np.random.default_rng(940), []
    for k in range(1000):
        places = rng.uniform(-100.0, 100.0, (int(rng.integers(25, 400)), 2))
        shape = places.shape
        moved = rng.standard_normal(shape) if k % 2 else rng.standard_t(3.0, shape)
        found = neighbours(table_of(places, 0.01 * moved), 0.0)
        assert found is not None and not found.alike and found.factor == 1.0
        # the mean was subtracted, which leaves -1/n
        z.append((found.correlation + 1.0 / len(places)) / found.sd)
    assert np.mean(z) == pytest.approx(0.0, abs=4.0 * 1000**-0.5)
    assert np.std(z) == pytest.approx(1.0, abs=0.09)


def test_a_smooth_field_is_found_with_what_it_does_to_a_mean() -> None:
    """Noise smoothed over 1.5 pitches: the factor is that of the mean of a patch of the field."""
    rng, factors, means = np.random.default_rng(941), [], []
    side = np.arange(40) * 20.0
    places = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    kernel = np.exp(-(np.arange(-6, 7) ** 2) / (2.0 * 1.5**2))
    for _ in range(200):
        field = rng.standard_normal((2, 52, 52))
        for axis in (1, 2):
            field = np.apply_along_axis(np.convolve, axis, field, kernel, "valid")
        moved = (field / np.sum(kernel**2)).reshape(2, -1).T
        found = neighbours(table_of(places, 0.01 * moved), 0.0)
        assert found is not None and found.alike
        factors.append(found.factor)
        inner = moved.reshape(40, 40, 2)[10:30, 10:30]
        means.append(inner.mean(axis=(0, 1)) * 20.0)
    # the standard deviation of means, which 400 of them tell to 3.5 %
    assert np.median(factors) == pytest.approx(np.std(means), rel=0.2)
    assert np.median(factors) > 4.0


def test_what_is_not_told() -> None:
    rng = np.random.default_rng(942)
    places, moved = rng.uniform(-100.0, 100.0, (200, 2)), rng.standard_normal((200, 2))
    assert neighbours(table_of(places[:19], moved[:19]), 0.0) is None
    assert neighbours(table_of(places * [1.0, 0.0], moved), 0.0) is None  # on a line
    alike = np.stack([np.sin(places[:, 0] / 15.0), np.cos(places[:, 1] / 15.0)], axis=1)
    table = table_of(places, alike)
    found = neighbours(table, 0.0)
    assert found is not None and found.alike
    table["isolated"][19:] = False  # the others share their light
    assert neighbours(table, 0.0) is None


def test_a_displacement_counts_in_units_of_its_error_and_of_the_scatter() -> None:
    rng = np.random.default_rng(943)
    places, moved = rng.uniform(-100.0, 100.0, (200, 2)), 0.05 * rng.standard_t(3.0, (200, 2))
    table = table_of(places, moved)
    for name in ("du_sd", "dv_sd"):
        table[name] = rng.uniform(0.005, 0.1, 200)
    wider = table.copy()
    for name in ("du_sd", "dv_sd"):
        wider[name] = np.hypot(table[name], 0.05)
    found, same, other = neighbours(table, 0.05), neighbours(wider, 0.0), neighbours(table, 0.0)
    assert found is not None and same is not None and other is not None
    assert found.correlation == pytest.approx(same.correlation, rel=1e-12)
    assert abs(found.correlation - other.correlation) > 1e-3


def pinholes(seed: int, *, ripple: float, scatter: float = 0.0) -> bf.Posterior:
    """A target whose marks were machined with a ripple, or independently off their places."""
    rng, detector = np.random.default_rng(seed), bf.Detector((200, 210))
    listed = bf.SourceCatalog.grid(10, 19.3, 2e4)
    x, y = listed.x, listed.y
    wave = ripple * np.stack([np.sin(x / 17.0 + y / 23.0), np.cos(y / 19.0 - x / 29.0)])
    off = wave + scatter * rng.standard_normal((2, x.size))
    lens, psf = bf.PolynomialDistortion.polynomial(2), bf.GaussianPSF(1.6)
    drilled = bf.ForwardModel(detector, replace(listed, x=x + off[0], y=y + off[1]), psf, lens)
    counts = bf.simulate(drilled, np.zeros(lens.n_terms), 20.0, seed=seed)
    model = bf.ForwardModel(detector, listed, psf, lens)
    return bf.Posterior(
        model, counts, nuisances=Nuisances("free", offset=True, position_scatter=True)
    )


def test_the_verdict_names_it_and_cross_check_does_not_trust_halves() -> None:
    for seed, ripple, scatter in ((1, 0.0, 0.03), (2, 0.04, 0.0)):
        posterior = pinholes(seed, ripple=ripple, scatter=scatter)
        best = bf.find_map(posterior)
        residuals = judge_residuals(posterior, best.params, best.covariance)
        fit = fit_statistics(posterior, best.params)
        verdict = judge_fit(posterior, best, fit, residuals)
        found = bf.cross_check(posterior, estimate=best)
        assert residuals.neighbours is not None
        (check,) = [c for c in residuals.checks if c.name == "displacement of neighbours"]
        assert (check.z > NOTICEABLE) == (ripple > 0.0)
        if not ripple:
            assert verdict.fits_data and found.verdict == "right"
            continue
        assert not verdict.fits_data and verdict.causes[-1].name == "displaced neighbours"
        assert "neighbouring sources are displaced alike" in verdict.sentence
        assert verdict.causes[-1].remedy == "add terms to the distortion"
        fixed = displaced_alike(residuals.neighbours, scatters=False)
        assert "set nuisances.position_scatter = true" in fixed.remedy
        assert found.verdict == "too small" and not found.holds
        assert "which both halves have in common" in found.message
        assert found.record()["neighbours_correlation"] > 0.3
        assert found.record()["neighbours_factor"] > 1.3
        # the control: the halves alone are content, or call the errors too large
        assert replace(found, neighbours=None).verdict != "too small"


def test_what_errors_have_already_is_not_said_again() -> None:
    """A field, all or half of which is in the errors."""
    rng = np.random.default_rng(944)
    places = rng.uniform(-200.0, 200.0, (400, 2))
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))
    whole = np.exp(-0.5 * (apart / 25.0) ** 2)
    lower = np.linalg.cholesky(whole + 1e-9 * np.eye(400))
    table = table_of(places, 0.03 * lower @ rng.standard_normal((400, 2)), 0.01)
    table["isolated"][::7] = False  # pairs are those of the table

    def shared(part: float) -> Callable[[NDArray[np.int64]], Floats]:
        return lambda pairs: part * 9e-4 * np.tile(whole[pairs[:, 0], pairs[:, 1]], (2, 1))

    none, half, all_of_it = (
        neighbours(table, 0.03, known) for known in (None, shared(0.3), shared(1.0))
    )
    assert none is not None and half is not None and all_of_it is not None
    assert none.alike and half.alike and not all_of_it.alike
    assert half.correlation == none.correlation
    assert half.expected == pytest.approx(0.3 * all_of_it.expected)
    assert half.sd == pytest.approx(np.hypot(none.sd, 0.1 * half.expected))
    assert none.expected == 0.0 and none.factor / 3.0 < half.factor < 0.7 * none.factor
