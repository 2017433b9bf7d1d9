"""Sums of log p over stretches of pixels, for photons with read noise.

The formulas are those of `poisson_gaussian`. They take long chains of operations, each of which
waits for the one before, and a processor works on a pixel's and its neighbours' chains at a time
only if these are short. So a stretch is summed in several passes, whose results stay in the fastest
cache in between. What needs few digits is float32, of which a register holds twice as many. A table
is read one number at a time, because instructions that gather several are slower. The logarithm of
four pixels' factors is that of their product. Where pixels differ in their read noise, what a frame
knows of them is sorted by formula beforehand, and a sum gathers their means alone.
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import types
from numba.extending import overload

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import leaf
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
    photon_sum,
    rough_log,
    rough_omega,
    rough_tilt,
    tilted_mean,
)

INFINITE = 1e30  # variance of counts at which log phi has no correction
GROUP = 8  # gathered pixels come in whole groups: loops are slow where they end within a vector


class Alike(NamedTuple):
    """The pixels in a frame's likelihood that need the same formula, in the frame's order.

    So those of some successive segments lie one after another here, too. The sum's `constants` are
    its steps. Those of the expansion are r^2, and n / r^2 and 1 / r^2 as float32.
    """

    first: Ints  # (segments + 1,) number of the first one in a segment or later
    place: npt.NDArray[np.uint32]  # (n,) in the padded frame
    counts: Floats  # (n + GROUP,); for the sum the nearest numbers of photons
    constants: tuple[Any, ...]  # likewise


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
def _in_singles(mu, single):
    for i in range(mu.size):
        single[i] = SINGLE(max(mu[i], LEAST))  # MASKED has no finite float32


@leaf(fastmath=FAST)
def _find_x(mu, slope, inverse, level, x):
    """log(mu / r^2) and x."""
    for i in range(x.size):
        level[i] = rough_log(max(mu[i] * inverse[i], LEAST_SINGLE))
        x[i] = slope[i] + level[i]


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
    """The tilts, in place of the levels."""
    for i in range(x.size):
        level[i] = rough_tilt(slope[i], level[i], x[i], w[i])


@leaf(fastmath=FAST)
def _find_means(mu, s, y):
    for i in range(s.size):
        y[i] = tilted_mean(max(mu[i], LEAST), float(s[i]))


@leaf(fastmath=REDUCE)
def _sum_tilted(variance, counts, mu, tilts, v):
    """The sum of log p without log phi, and v = y + r^2."""
    (s, y), total = tilts, 0.0
    for i in range(mu.size):
        term, _, _, spread = improved(counts[i], mu[i], variance[i], float(s[i]), y[i])
        v[i] = spread
        total += term if mu[i] > LIMIT else 0.0
    return total


@leaf(fastmath=REDUCE)
def _sum_corrections(variance, v):
    total = 0.0
    for i in range(v.size):
        total += correction(v[i], variance[i])
    return total


@leaf(fastmath=REDUCE)
def _sum_logs(q):
    quarter, total = q.size // 4, 0.0
    for i in range(quarter):
        a, b = q[i] * q[i + quarter], q[i + 2 * quarter] * q[i + 3 * quarter]
        total += log(a * b)
    return total


@leaf()
def _sum_expansion(counts, constants, mu, size, scratch):
    """The sum of the saddlepoint expansion over the first pixels of whole groups."""
    (variance, slope, inverse), y = constants, scratch[2, : mu.size]
    one, two = scratch[0].view(SINGLE), scratch[1].view(SINGLE)
    level, m = one[: mu.size], one[STRETCH : STRETCH + mu.size]
    x, w = two[: mu.size], two[STRETCH : STRETCH + mu.size]
    _in_singles(mu, m)
    _find_x(m, slope, inverse, level, x)
    _guess_omega(x, w)
    _compare_omega(level, x, w)
    _find_tilts(slope, level, x, w)
    _find_means(mu, level, y)
    v = scratch[1, : mu.size]  # in place of x and w
    total = _sum_tilted(variance, counts, mu, (level, y), v)
    v[size:] = INFINITE
    total += _sum_corrections(variance, v)
    v[size:] = 1.0
    return total - 0.5 * _sum_logs(v)


@leaf(fastmath=FAST)
def _find_sums(photons, steps, mu, sums):
    up, down = steps
    for i in range(mu.size):
        sums[i] = photon_sum(photons[i], max(mu[i], LEAST), up[i], down[i])


@leaf(fastmath=REDUCE)
def _sum_powers(photons, mu):
    """The sum of k log(mu) - mu."""
    total = 0.0
    for i in range(mu.size):
        total += photons[i] * log(max(mu[i], LEAST)) - mu[i]
    return total


@leaf()
def _sum_photons(photons, steps, mu, size, scratch):
    """The sum of log p over the first pixels of whole groups; the others' mean becomes 1."""
    sums = scratch[0, : mu.size]
    _find_sums(photons, steps, mu, sums)
    sums[size:], mu[size:] = 1.0, 1.0
    return _sum_powers(photons, mu) + (mu.size - size) + _sum_logs(sums)


@leaf(fastmath=REDUCE)
def _gather(place, start, mean, mu):
    """The means of pixels in these places, and MASKED up to a whole group; the least of them."""
    (image, level, response), begin, least = mean, np.uint64(start), 0.0
    for i in range(place.size):
        j = np.uint64(place[i]) - begin
        mu[i] = scaled(image[j] + level, response, j)
        least = min(least, mu[i])
    mu[place.size :] = MASKED
    return least


@leaf()
def _sum_map(few, many, mean, place):
    """The sum over pixels that differ in their read noise, from the formula that each needs."""
    (start, scratch), total, least = place, 0.0, 0.0
    begin, end = start // SEGMENT, (start + mean[0].size) // SEGMENT
    (up, down), last = few.constants, few.first[end]
    for a in range(few.first[begin], last, STRETCH):
        places = few.place[a : min(a + STRETCH, last)]
        b = a + (places.size + GROUP - 1) // GROUP * GROUP
        mu = scratch[3, : b - a]
        least = min(least, _gather(places, start, mean, mu))
        total += _sum_photons(few.counts[a:b], (up[a:b], down[a:b]), mu, places.size, scratch)
    (variance, slope, inverse), last = many.constants, many.first[end]
    for a in range(many.first[begin], last, STRETCH):
        places = many.place[a : min(a + STRETCH, last)]
        b = a + (places.size + GROUP - 1) // GROUP * GROUP
        mu, own = scratch[3, : b - a], (variance[a:b], slope[a:b], inverse[a:b])
        least = min(least, _gather(places, start, mean, mu))
        total += _sum_expansion(many.counts[a:b], own, mu, places.size, scratch)
    return total if least >= 0.0 else MASKED


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
    return lambda noise, values, mean, place: _sum_map(noise.alike[0], noise.alike[1], mean, place)
