"""Factors and inverses of the matrices of clusters, against dense matrices."""

import numpy as np
import pytest
from numba import njit

from bayesfred.model.kernels.contexts import Group
from bayesfred.model.kernels.factors import cholesky, invert


@njit
def inverse(h, group):  # type: ignore[no-untyped-def]
    cholesky(h, group)
    return invert(h, group)


@pytest.mark.parametrize("seed", range(20))
def test_inverse_is_that_of_the_dense_matrix_where_the_factor_has_elements(seed: int) -> None:
    """Rows begin anywhere: before those of earlier rows, or at their own diagonal."""
    rng, size = np.random.default_rng(seed), 30
    rows = np.arange(size)
    lead = np.maximum(rows - rng.integers(0, 12, size), 0)
    lead[20] = 1  # far before the rows around it
    lengths = rows + 1 - lead
    start = np.cumsum(lengths) - lengths - lead
    stored = (rows[None] >= lead[:, None]) & (rows[None] <= rows[:, None])
    h = np.where(stored, rng.standard_normal((size, size)), 0.0)
    h += np.tril(h, -1).T + size * np.eye(size)
    found, dense = inverse(h[stored], Group(rows, lead, start)), np.linalg.inv(h)
    np.testing.assert_allclose(found, dense[stored], rtol=1e-9, atol=1e-14)
    assert np.abs(dense[~stored & (rows[None] < rows[:, None])]).max() > 0.0  # it is full


@pytest.mark.parametrize(("wide", "high"), [(6, 40), (60, 8), (700, 2)])
@pytest.mark.parametrize("least", [1e-9, 1e-2])
def test_negligible_elements_are_zero_and_change_nothing(
    wide: int, high: int, least: float
) -> None:
    """Of a grid of sources that touch their neighbours, faintly or not, row after row."""
    rng, size = np.random.default_rng(wide), wide * high
    rows = np.arange(size)
    place = np.stack(np.divmod(rows, wide), axis=1)
    near = np.abs(place[:, None] - place[None]).max(axis=2) <= 1
    h = np.where(near, least * 10.0 ** rng.uniform(0.0, 1.0, near.shape), 0.0)
    h = np.tril(h, -1) + np.tril(h, -1).T + np.eye(size)
    scale = 10.0 ** rng.uniform(-6.0, 6.0, size)  # of fluxes and of shifts
    scales = np.multiply.outer(scale, scale)
    lead = np.where(near, rows[None], size).min(axis=1)
    lengths = rows + 1 - lead
    group = Group(rows, lead, np.cumsum(lengths) - lengths - lead)
    stored = (rows[None] >= lead[:, None]) & (rows[None] <= rows[:, None])
    factor = (scales * h)[stored]
    found = scales[stored] * inverse(factor, group)
    by_row = np.repeat(scale, lengths)
    assert np.abs(factor / by_row - np.linalg.cholesky(h)[stored]).max() < 1e-15
    assert np.abs(found - np.linalg.inv(h)[stored])[near[stored]].max() < 1e-14
    assert np.abs(factor[factor != 0.0]).min() > 1e-40
    if wide > 6 and least < 1e-3:
        assert (factor == 0.0).mean() > 0.7
