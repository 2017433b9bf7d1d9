"""Sums over a spline's coefficients against scipy's B-splines, apart from any PSF."""

from collections.abc import Callable
from typing import Any

import numba as nb
import numpy as np
import pytest
from scipy.interpolate import BSpline

from bayesfred.imaging.kernels.contexts import Degrees
from bayesfred.imaging.kernels.psf_dispatch import find_places, new_places
from bayesfred.imaging.kernels.splines import (
    spline_cell,
    spline_second_derivatives,
    spline_slopes,
)
from bayesfred.imaging.psf.sampled import new_spline_places, spline_profile

ROWS, COLUMNS = 9, 12  # not square, so that the two axes cannot be mistaken for each other

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
    [(spline_slopes, SLOPES), (spline_second_derivatives, SECOND)],
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


@nb.njit
def row_values(psf: Any, t0: Any, ramp: Any, work: Any) -> Any:
    places = new_places(psf, ramp.size)
    find_places(psf, (t0, ramp, ramp.size), work, Degrees((0, 0), (), ()), places)
    return places[3][: ramp.size]


@pytest.mark.parametrize("stride", [1, 3, 4])
@pytest.mark.parametrize("drift", [0.0, 0.01, -0.3])
def test_rows_of_pixels_are_scipys(stride: int, drift: float) -> None:
    """However far points drift off the stride, beyond the grid's ends, and where cells meet."""
    rng = np.random.default_rng(1)
    c = np.zeros((31, 31))
    c[4:-4, 4:-4] = rng.standard_normal((23, 23))
    ramp, t0 = np.arange(24.0), -11.0
    for a0 in (0.0, 0.3):
        work = np.zeros((4, 3))
        work[2] = a0, stride * (1.0 + drift), 0.01 * drift
        work[3] = 0.5 - a0, 3.0 * drift, -0.02 * drift
        t = t0 + ramp
        x, y = (row[0] + t * (row[1] + t * row[2]) for row in work[2:])
        found = row_values(spline_profile(1.0, c, 1.0, stride), t0, ramp, work)
        by_x, by_y = basis(x, 31, 0), basis(y, 31, 0)
        np.testing.assert_allclose(
            found, np.einsum("pj,ji,pi->p", by_y, c, by_x), rtol=0.0, atol=1e-13
        )
        turned = np.einsum("pj,ij,pi->p", by_y, c, by_x)
        assert np.abs(found - turned).max() > 0.1  # the axes the other way round


@nb.njit
def places_where_denormal_numbers_were(width: Any) -> Any:
    for _ in range(8):
        size = width + 8
        left = [np.full(size, 5e-324) for _ in range(4)]
        left.clear()
    _, y, x, _ = new_spline_places(width)
    return y, x


def test_what_memory_held_is_not_calculated_with() -> None:
    """The last pixels of a row take others along, and arithmetic with denormal numbers is slow."""
    for width in (64, 528, 4112):
        y, x = places_where_denormal_numbers_were(width)
        assert not y.any() and not x.any()
