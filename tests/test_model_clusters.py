"""The linear algebra of clusters of sources, against dense matrices."""

import numpy as np
import pytest
from numba import njit

from bayesfred.model.kernels.clusters import cholesky, invert
from bayesfred.model.kernels.contexts import Group


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
