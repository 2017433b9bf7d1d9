"""Sums of log p over stretches of pixels, for photons with read noise.

The formulas are those of `poisson_gaussian`. They take long chains of operations, each of which
waits for the one before, and a processor works on a pixel's and its neighbours' chains at a time
only if these are short. So a stretch is summed in several passes, whose results stay in the fastest
cache in between. What needs few digits is float32, of which a register holds twice as many. A table
is read one number at a time, because instructions that gather several are slower. The logarithm of
four pixels' factors is that of their product. Where some pixels need one formula and some the
other, what a frame knows of them is sorted by formula beforehand, and a sum gathers their means
alone.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import types
from numba.extending import overload

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import inner, leaf
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE, as_bits, as_float, log
from bayesfred.model.kernels.contexts import LIMIT, MASKED, STRETCH
from bayesfred.model.kernels.cumulants import table_cell, table_value
from bayesfred.model.kernels.noise_dispatch import part_of, scaled
from bayesfred.model.kernels.poisson_gaussian import (
    LEAST,
    LEAST_SINGLE,
    SINGLE,
    correction,
    density_of,
    improved,
    nearest,
    photon_sum,
    rough_log,
    rough_omega,
    rough_tilt,
    tilted_mean,
)

GROUP = 16  # gathered pixels come in whole groups: loops are slow where they end within a vector


class Alike(NamedTuple):
    """The pixels in a frame's likelihood that need the same formula, in the frame's order.

    So those of some successive segments lie one after another here, too.
    """

    first: Ints  # (segments + 1,) number of the first one in a segment or later
    place: npt.NDArray[np.int32]  # (n,) in the padded frame
    counts: Floats  # (n + GROUP,)
    constants: tuple[Floats, ...]  # likewise; the sum's steps, or the variance of the read noise


@leaf(fastmath=REDUCE)
def _find_cells(table, values, mean, cells, places):
    """The cells of a stretch's pixels in the table of g, and the sum of -mu."""
    (image, level, response), total = mean, 0.0
    for i in range(image.size):
        n, mu = values[i], scaled(image[i] + level, response, i)
        cell, places[i] = table_cell(table, n, log(max(mu, LEAST)))
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
def _sum_tabulated(table, values, mean, scratch):
    cells, places, total = scratch[0], scratch[1], 0.0
    for a in range(0, values.size, STRETCH):
        n = values[a : a + STRETCH]
        cell, place = cells[: n.size], places[: n.size]
        total += _find_cells(table, n, part_of(mean, a, n.size), cell, place)
        total += _sum_cells(table, cell, place)
    return total


@leaf(fastmath=REDUCE)
def _sum(x):
    total = 0.0
    for i in range(x.size):
        total += x[i]
    return total


@leaf(fastmath=REDUCE)
def _sum_densities(kind, variance, values, mean):
    """The sum from the formulas, one pixel after another."""
    (image, level, response), total = mean, 0.0
    for i in range(image.size):
        mu = scaled(image[i] + level, response, i)
        counted = values[i] > LIMIT
        n = values[i] if counted else mu
        term = density_of(kind, n, mu, variance) if mu >= 0.0 else MASKED
        total += term if counted else 0.0
    return total


@leaf()
def _sum_segments(table, noise, values, mean, place):
    """The sum from the table, or from the formulas where it does not serve."""
    (kind, variance), (first, scratch), total, k = noise, place, 0.0, 0
    last = values.size // SEGMENT
    left_out = table.left_out[first // SEGMENT :][:last]
    whole = _sum(left_out)
    if whole > LIMIT:  # the table serves all of them
        return whole + _sum_tabulated(table, values, mean, scratch)
    while k < last:
        begin, served = k, left_out[k] > LIMIT
        while k < last and (left_out[k] > LIMIT) == served:
            total += left_out[k] if served else 0.0
            k += 1
        n = values[begin * SEGMENT : k * SEGMENT]
        part = part_of(mean, begin * SEGMENT, n.size)
        if served:
            total += _sum_tabulated(table, n, part, scratch)
        else:
            total += _sum_densities(kind, variance, n, part)
    return total


@leaf(fastmath=FAST)
def _in_singles(values, mean, mu, n, m):
    """The mean, MASKED where a pixel does not count, and float32 counts and mean."""
    image, level, response = mean
    for i in range(image.size):
        counted, expected = values[i] > LIMIT, scaled(image[i] + level, response, i)
        mu[i] = expected if counted else MASKED
        n[i] = values[i] if counted else 0.0
        m[i] = max(expected, LEAST)


@leaf(fastmath=FAST)
def _invert(variance, inverse):
    for i in range(variance.size):
        inverse[i] = SINGLE(1.0) / SINGLE(variance[i])


@leaf(fastmath=FAST)
def _find_x(slope, level, inverse):
    """n / r^2, log(mu / r^2) and x, in place of n, mu and 1 / r^2."""
    for i in range(inverse.size):
        slope[i] *= inverse[i]
        level[i] = rough_log(max(level[i] * inverse[i], LEAST_SINGLE))
        inverse[i] = slope[i] + level[i]


@leaf(fastmath=FAST)
def _guess_omega(x, w):
    for i in range(x.size):
        w[i] = rough_omega(x[i])


@leaf(fastmath=FAST)
def _compare_omega(level, x, w):
    """log(w r^2 / mu) and x - log(w) - w."""
    for i in range(x.size):
        log_w = rough_log(w[i])
        level[i] = log_w - level[i]
        x[i] -= log_w + w[i]


@leaf(fastmath=FAST)
def _find_tilts(slope, level, x, w):
    """The tilts, in place of the slopes."""
    for i in range(x.size):
        slope[i] = rough_tilt(slope[i], level[i], x[i], w[i])


@leaf(fastmath=FAST)
def _find_means(mu, s, y):
    for i in range(s.size):
        y[i] = tilted_mean(max(mu[i], LEAST), float(s[i]))


@leaf(fastmath=REDUCE)
def _sum_tilted(variance, values, mu, tilts, v):
    """The sum of log p without log phi, and v = y + r^2."""
    (s, y), total = tilts, 0.0
    for i in range(mu.size):
        term, _, _, spread = improved(values[i], mu[i], variance[i], float(s[i]), y[i])
        counted = mu[i] > LIMIT
        v[i] = spread if counted else 1.0
        term = term if mu[i] >= 0.0 else MASKED
        total += term if counted else 0.0
    return total


@leaf(fastmath=REDUCE)
def _sum_corrections(variance, mu, v):
    total = 0.0
    for i in range(v.size):
        term = correction(v[i], variance[i])
        total += term if mu[i] > LIMIT else 0.0
    return total


@leaf(fastmath=REDUCE)
def _sum_logs(q):
    quarter, total = q.size // 4, 0.0
    for i in range(quarter):
        a, b = q[i] * q[i + quarter], q[i + 2 * quarter] * q[i + 3 * quarter]
        total += log(a * b)
    return total


@leaf()
def _sum_expansion(variance, values, mean, scratch):
    """The sum of the saddlepoint expansion over pixels that differ in their read noise."""
    one, two, total = scratch[0].view(SINGLE), scratch[1].view(SINGLE), 0.0
    for a in range(0, values.size, STRETCH):
        n, r = values[a : a + STRETCH], variance[a : a + STRETCH]
        slope, level = one[: n.size], one[STRETCH : STRETCH + n.size]
        x, w = two[: n.size], two[STRETCH : STRETCH + n.size]
        # v has the room of x and w
        y, v, mu = scratch[2, : n.size], scratch[1, : n.size], scratch[3, : n.size]
        _in_singles(n, part_of(mean, a, n.size), mu, slope, level)
        _invert(r, x)
        _find_x(slope, level, x)
        _guess_omega(x, w)
        _compare_omega(level, x, w)
        _find_tilts(slope, level, x, w)
        _find_means(mu, slope, y)
        total += _sum_tilted(r, n, mu, (slope, y), v)
        total += _sum_corrections(r, mu, v) - 0.5 * _sum_logs(v)
    return total


@leaf(fastmath=FAST)
def _find_sums(steps, values, mean, sums, mu):
    """The photon sums, and the mean, which is MASKED where a pixel does not count."""
    (up, down), (image, level, response) = steps, mean
    for i in range(image.size):
        mu[i] = scaled(image[i] + level, response, i) if values[i] > LIMIT else MASKED
        sums[i] = photon_sum(nearest(values[i]), max(mu[i], LEAST), up[i], down[i])


@leaf(fastmath=REDUCE)
def _sum_powers(values, mu, sums):
    """The sum of k log(mu) - mu, and photon sums of 1 where a pixel does not count."""
    total = 0.0
    for i in range(mu.size):
        term = nearest(values[i]) * log(max(mu[i], LEAST)) - mu[i]
        counted = mu[i] > LIMIT
        sums[i] = sums[i] if counted else 1.0
        term = term if mu[i] >= 0.0 else MASKED
        total += term if counted else 0.0
    return total


@leaf()
def _sum_photons(steps, values, mean, scratch):
    """The sum of log p over pixels that differ in their read noise, from the steps of each."""
    (up, down), total = steps, 0.0
    for a in range(0, values.size, STRETCH):
        n, here = values[a : a + STRETCH], (up[a : a + STRETCH], down[a : a + STRETCH])
        sums, mu = scratch[0, : n.size], scratch[3, : n.size]
        _find_sums(here, n, part_of(mean, a, n.size), sums, mu)
        total += _sum_powers(n, mu, sums) + _sum_logs(sums)
    return total


@leaf(fastmath=FAST)
def _gather(place, start, mean, mu):
    """The means of pixels in these places, and MASKED up to a whole group; how many that makes."""
    image, level, response = mean
    for i in range(place.size):
        j = np.uint64(place[i] - start)
        mu[i] = scaled(image[j] + level, response, j)
    filled = (place.size + GROUP - 1) // GROUP * GROUP
    for i in range(place.size, filled):
        mu[i] = MASKED
    return filled


@leaf()
def _sum_mixed(few, many, mean, place):
    """The sum over pixels some of which need one formula, some the other."""
    (start, scratch), total = place, 0.0
    begin, end, mu = start // SEGMENT, (start + mean[0].size) // SEGMENT, scratch[4]
    (up, down), variance, last = few.constants, many.constants[0], few.first[end]
    for a in range(few.first[begin], last, STRETCH):
        b = a + _gather(few.place[a : min(a + STRETCH, last)], start, mean, mu)
        own = (mu[: b - a], 0.0, None)
        total += _sum_photons((up[a:b], down[a:b]), few.counts[a:b], own, scratch)
    last = many.first[end]
    for a in range(many.first[begin], last, STRETCH):
        b = a + _gather(many.place[a : min(a + STRETCH, last)], start, mean, mu)
        total += _sum_expansion(variance[a:b], many.counts[a:b], (mu[: b - a], 0.0, None), scratch)
    return total


@inner(inline="always")
def _steps_of(noise, first, size):
    return noise.steps[0][first : first + size], noise.steps[1][first : first + size]


def sum_up(noise: Any, values: Any, mean: Any, place: Any) -> Any:
    """Sum of log p over segments, from the table of one read noise where there is one."""
    raise NotImplementedError("for compiled code")


@overload(sum_up, inline="always", strict=False)
def _choose_sum(noise: Any, values: Any, mean: Any, place: Any) -> Any:
    """Of the noise only what is used: to pass all of it on costs half as much as a row's pixels."""
    kinds = dict(zip(noise.fields, noise.types, strict=True))
    if not isinstance(kinds["variance"], types.Array):
        return lambda noise, values, mean, place: _sum_segments(
            noise.cumulants, (noise.kind, noise.variance), values, mean, place
        )
    if len(kinds["kind"]) == 0:
        return lambda noise, values, mean, place: _sum_photons(
            _steps_of(noise, place[0], values.size), values, mean, place[1]
        )
    if len(kinds["kind"]) == 1:
        return lambda noise, values, mean, place: _sum_expansion(
            noise.variance[place[0] : place[0] + values.size], values, mean, place[1]
        )
    return lambda noise, values, mean, place: _sum_mixed(
        noise.alike[0], noise.alike[1], mean, place
    )
