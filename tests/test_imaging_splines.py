"""Sums over a spline's coefficients against scipy's B-splines, apart from any PSF."""

from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
import pytest
from scipy.interpolate import BSpline

from bayesfred.imaging.kernels.splines import (
    spline_cell,
    spline_second_derivatives,
    spline_slopes,
    spline_value,
)

ROWS, COLUMNS = 9, 12  # not square, so that the two axes cannot be mistaken for each other

VALUE = [(0, 0)]
SLOPES = [(0, 0), (0, 1), (1, 0)]
SECOND = [(0, 1), (1, 0), (0, 2), (1, 1), (2, 0)]


def points(function: Any, n: int) -> Callable[..., np.ndarray]:
    """The function's sums at many points, counted in samples from the grid's middle."""

    @nb.njit
    def evaluate(c: Any, y: Any, x: Any) -> Any:
        out = np.empty((n, x.size))
        for k in range(x.size):
            j, fy = spline_cell(c.shape[0], y[k])
            i, fx = spline_cell(c.shape[1], x[k])
            sums = function(c, j * c.shape[1] + i, fy, fx)
            for m in range(n):
                out[m, k] = sums[m]
        return out

    return evaluate  # type: ignore[no-any-return]


def basis(z: np.ndarray, size: int, order: int) -> np.ndarray:
    """Derivatives of all B-splines of one axis, shape (points, size)."""
    knots = np.arange(-2.0, 3.0)
    one = BSpline.basis_element(knots, extrapolate=False).derivative(order) if order else (
        BSpline.basis_element(knots, extrapolate=False)
    )  # fmt: skip
    off = z[:, None] + 0.5 * (size - 1) - np.arange(size)
    return np.nan_to_num(one(off))


@pytest.mark.parametrize(
    ("function", "orders"),
    [(spline_value, VALUE), (spline_slopes, SLOPES), (spline_second_derivatives, SECOND)],
)
def test_sums_are_scipys(function: Any, orders: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(1)
    c = rng.standard_normal((ROWS, COLUMNS))
    y, x = rng.uniform(-3.0, 2.5, 500), rng.uniform(-4.5, 4.0, 500)
    x[:8] = np.arange(-4.0, 4.0) + 0.5  # where cells meet
    found = points(function, len(orders))(c, y, x)
    for values, (by_y, by_x) in zip(found, orders, strict=True):
        wanted = np.einsum("pj,ji,pi->p", basis(y, ROWS, by_y), c, basis(x, COLUMNS, by_x))
        np.testing.assert_allclose(values, wanted, rtol=0.0, atol=1e-13)
        turned = np.einsum("pj,ij,pi->p", basis(y, COLUMNS, by_y), c, basis(x, ROWS, by_x))
        assert np.abs(values - turned).max() > 0.1  # the axes the other way round
