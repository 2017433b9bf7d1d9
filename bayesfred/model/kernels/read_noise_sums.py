"""Sums of log p over stretches of pixels, for photons with read noise.

The formulas are those of `poisson_gaussian`. They take long chains of operations, each of which
waits for the one before, and a processor works on a pixel's and its neighbours' chains at a time
only if these are short. So a stretch is summed in several passes, whose results stay in the fastest
cache in between. A table is read one number at a time, because instructions that gather several are
slower. The logarithm of four pixels' factors is that of their product.
"""

from typing import Any

from numba import types
from numba.extending import overload

from bayesfred.imaging.kernels.compilation import leaf
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE, as_bits, as_float, log
from bayesfred.model.kernels.contexts import LIMIT, MASKED, STRETCH
from bayesfred.model.kernels.cumulants import table_cell, table_value
from bayesfred.model.kernels.poisson_gaussian import (
    TINY,
    at,
    correction,
    density_of,
    improved,
    rough_omega,
    rough_x,
    rougher_omega,
    tilted_mean,
)


@leaf(fastmath=REDUCE, error_model="numpy")
def _find_cells(table, values, image, level, cells, places):
    """The cells of a stretch's pixels in the table of g, and the sum of -mu."""
    total = 0.0
    for i in range(image.size):
        n, mu = values[i], image[i] + level
        cell, places[i] = table_cell(table, n, log(max(mu, TINY)))
        cells[i] = as_float(cell)
        less = -mu if mu >= 0.0 else MASKED
        total += less if n > LIMIT else 0.0
    return total


@leaf(fastmath=FAST)
def _sum_cells(table, cells, places):
    """Sum of g; without leave to reassociate, so that it is not made to gather.

    Four sums, so that an addition need not wait for the one before.
    """
    a, b, c, d = 0.0, 0.0, 0.0, 0.0
    step = cells.size // 4
    for i in range(step):
        j, k, m = i + step, i + 2 * step, i + 3 * step
        a += table_value(table, as_bits(cells[i]), places[i])
        b += table_value(table, as_bits(cells[j]), places[j])
        c += table_value(table, as_bits(cells[k]), places[k])
        d += table_value(table, as_bits(cells[m]), places[m])
    return (a + b) + (c + d)


@leaf()
def _sum_tabulated(table, values, image, level, scratch):
    cells, places, total = scratch[0], scratch[1], 0.0
    for a in range(0, image.size, STRETCH):
        n, light = values[a : a + STRETCH], image[a : a + STRETCH]
        cell, place = cells[: n.size], places[: n.size]
        total += _find_cells(table, n, light, level, cell, place)
        total += _sum_cells(table, cell, place)
    return total


@leaf(fastmath=REDUCE)
def _sum(x):
    total = 0.0
    for i in range(x.size):
        total += x[i]
    return total


@leaf(fastmath=REDUCE, error_model="numpy")
def _sum_densities(kind, variance, values, image, level):
    """The sum from the formulas, one pixel after another."""
    total = 0.0
    for i in range(image.size):
        mu = image[i] + level
        counted = values[i] > LIMIT
        n = values[i] if counted else mu
        term = density_of(kind, n, mu, at(variance, i)) if mu >= 0.0 else MASKED
        total += term if counted else 0.0
    return total


@leaf()
def _sum_segments(table, noise, values, image, level, place):
    """The sum from the table, or from the formulas where it does not serve."""
    (kind, variance), (first, scratch), total, k = noise, place, 0.0, 0
    last = image.size // SEGMENT
    left_out = table.left_out[first // SEGMENT :][:last]
    whole = _sum(left_out)
    if whole > LIMIT:  # the table serves all of them
        return whole + _sum_tabulated(table, values, image, level, scratch)
    while k < last:
        begin, served = k, left_out[k] > LIMIT
        while k < last and (left_out[k] > LIMIT) == served:
            total += left_out[k] if served else 0.0
            k += 1
        a, b = begin * SEGMENT, k * SEGMENT
        if served:
            total += _sum_tabulated(table, values[a:b], image[a:b], level, scratch)
        else:
            total += _sum_densities(kind, variance, values[a:b], image[a:b], level)
    return total


@leaf(fastmath=FAST, error_model="numpy")
def _find_x(variance, values, image, level, x, q):
    for i in range(image.size):
        q[i] = 1.0 / variance[i]
        x[i] = rough_x(values[i], max(image[i] + level, TINY), q[i])


@leaf(fastmath=FAST)
def _guess_omega(x, w):
    for i in range(x.size):
        w[i] = rougher_omega(x[i])


@leaf(fastmath=FAST, error_model="numpy")
def _find_tilt(values, x, w, q):
    """The tilts s in place of x, and 1 / (y + r^2) roughly in place of 1 / r^2."""
    for i in range(x.size):
        omega, known = rough_omega(x[i], w[i])
        x[i] = values[i] * q[i] - omega
        q[i] *= known


@leaf(fastmath=FAST, error_model="numpy")
def _find_means(image, level, s, y):
    for i in range(s.size):
        y[i] = tilted_mean(max(image[i] + level, TINY), s[i])


@leaf(fastmath=REDUCE, error_model="numpy")
def _sum_tilted(variance, values, image, level, rough):
    """The sum of log p without log phi, and 1 / (y + r^2) in place of its rough value."""
    (s, y, q), total = rough, 0.0
    for i in range(image.size):
        n, mu = values[i], image[i] + level
        term, _, _, known = improved(n, mu, variance[i], s[i], y[i], q[i])
        q[i] = known if n > LIMIT else 1.0
        term = term if mu >= 0.0 else MASKED
        total += term if n > LIMIT else 0.0
    return total


@leaf(fastmath=REDUCE, error_model="numpy")
def _sum_corrections(variance, values, q):
    total = 0.0
    for i in range(q.size):
        term = correction(q[i], 1.0 - variance[i] * q[i])
        total += term if values[i] > LIMIT else 0.0
    return total


@leaf(fastmath=REDUCE, error_model="numpy")
def _sum_logs(q):
    quarter, total = q.size // 4, 0.0
    for i in range(quarter):
        a, b = q[i] * q[i + quarter], q[i + 2 * quarter] * q[i + 3 * quarter]
        total += log(a * b)
    return total


@leaf()
def _sum_expansion(variance, values, image, level, scratch):
    """The sum of the saddlepoint expansion over pixels that differ in their read noise."""
    total = 0.0
    for a in range(0, image.size, STRETCH):
        n, light, r = values[a : a + STRETCH], image[a : a + STRETCH], variance[a : a + STRETCH]
        s, y, q = scratch[0, : n.size], scratch[1, : n.size], scratch[2, : n.size]
        _find_x(r, n, light, level, s, q)
        _guess_omega(s, y)
        _find_tilt(n, s, y, q)
        _find_means(light, level, s, y)
        total += _sum_tilted(r, n, light, level, (s, y, q))
        total += _sum_corrections(r, n, q) + 0.5 * _sum_logs(q)
    return total


def sum_up(noise: Any, values: Any, image: Any, level: Any, place: Any) -> Any:
    """Sum of log p over segments, from the table of one read noise where there is one."""
    raise NotImplementedError("for compiled code")


@overload(sum_up, inline="always", strict=False)
def _choose_sum(noise: Any, values: Any, image: Any, level: Any, place: Any) -> Any:
    """Of the noise only what is used: to pass all of it on costs half as much as a row's pixels."""
    kinds = dict(zip(noise.fields, noise.types, strict=True))
    if not isinstance(kinds["variance"], types.Array):
        return lambda noise, values, image, level, place: _sum_segments(
            noise.cumulants, (noise.kind, noise.variance), values, image, level, place
        )
    if len(kinds["kind"]) == 1:
        return lambda noise, values, image, level, place: _sum_expansion(
            noise.variance[place[0] : place[0] + image.size],
            values,
            image,
            level,
            place[1],
        )
    return lambda noise, values, image, level, place: _sum_densities(
        noise.kind, noise.variance[place[0] : place[0] + image.size], values, image, level
    )
