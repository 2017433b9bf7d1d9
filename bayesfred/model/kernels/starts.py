"""Where the search for a cluster's fluxes and shifts begins.

A source begins where it is predicted, with the flux that is most likely if its neighbours are
ignored. With v the counts' variance, that of the background, with A the sum of its template K
times the counts above the background, and with B that of K^2, over the pixels in the likelihood,

    log L + log p = (F A - F^2 B / 2) / v + a log F - F / c + constants,

whose maximum is positive. A source of which hardly more is seen than its neighbours' light in its
wings begins at the prior's maximum.

Newton's steps reach an image from about a width of the PSF. Where positions scatter by as much a
source begins at the shift, in whole pixels, at which the same and the prior of the shift are
largest, and between the pixels where a parabola through A is largest. What the catalogue has as
brighter chooses first. Its light is then subtracted, lest a fainter neighbour choose it, too.
"""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import inner, leaf
from bayesfred.imaging.kernels.contexts import Canvas
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.imaging.kernels.geometry import SCATTER, move
from bayesfred.model.kernels.clusters import DOF, add_template, shift_prior
from bayesfred.model.kernels.flux_newton import make_templates
from bayesfred.model.kernels.likelihood import U

FIRST_ROWS = 32  # of a source, which its first flux is fitted to
SEEN = 0.01  # of the sum of K^2 over its pixels, at the least, for that
WIDE = 0.5  # widths of the PSF by which positions scatter where images are looked for
CORE = 0.1  # of a template's largest sample: smaller ones do not say where its image is


@leaf(fastmath=REDUCE)
def _least_squares(cluster, s):
    """Sums over some of a source's rows: K times counts above the background, K^2, and K^2 of all.

    The last has the pixels, too, that are not in the likelihood.
    """
    fp, stamp, at = cluster.layout.footprints, cluster.touching.stamps[0], cluster.canvas.at
    values, weights, starts, sizes = cluster.patch.score, cluster.patch.weight, fp.start, fp.size
    above, below, every = 0.0, 0.0, 0.0
    step = max((fp.first[s + 1] - fp.first[s]) // FIRST_ROWS, 1)
    for p in range(fp.first[s] + step // 2, fp.first[s + 1], step):
        i, j = U(starts[p]), U(at[p])
        for k in range(U(sizes[p])):
            square = stamp[i + k] * stamp[i + k]
            above += stamp[i + k] * values[j + k] * weights[j + k]
            below += square * weights[j + k]
            every += square
    return step * above, step * below, step * every


@leaf()
def _first_flux(prior, scale, above, below):
    """The most likely flux, given A and B in units of the counts' variance."""
    slope = above - 1.0 / scale
    more = 0.5 * (abs(slope) + math.sqrt(slope * slope + 4.0 * prior.shape * below))
    return more / below if slope > 0.0 else prior.shape / more


@leaf()
def _core(cluster, s):
    """The rows of a source's template, and columns, outside of which it is small."""
    fp, stamp, largest = cluster.layout.footprints, cluster.touching.stamps[0], 0.0
    for i in range(fp.start[fp.first[s]], fp.start[fp.first[s + 1]]):
        largest = max(largest, stamp[i])
    top, bottom, left, right = fp.first[s + 1], fp.first[s], np.iinfo(np.int64).max, 0
    for p in range(fp.first[s], fp.first[s + 1]):
        for k in range(fp.size[p]):
            if stamp[fp.start[p] + k] > CORE * largest:
                top, bottom = min(top, p), p + 1
                left, right = min(left, fp.low[p] + k), max(right, fp.low[p] + k + 1)
    return top, bottom, left, right


@leaf(fastmath=REDUCE)
def _moved(cluster, s, core, by):
    """A and B of the core of a source's template that is moved by whole pixels, (columns, rows)."""
    fp, stamp, at = cluster.layout.footprints, cluster.touching.stamps[0], cluster.canvas.at
    values, weights, above, below = cluster.patch.score, cluster.patch.weight, 0.0, 0.0
    for p in range(core[0], core[1]):
        q = p + by[1]
        if fp.first[s] <= q < fp.first[s + 1]:
            low = max(core[2], fp.low[p], fp.low[q] - by[0])
            high = min(core[3], fp.low[p] + fp.size[p], fp.low[q] + fp.size[q] - by[0])
            i, j = fp.start[p] - fp.low[p], at[q] - fp.low[q] + by[0]
            for k in range(low, high):
                part = stamp[i + k] * weights[j + k]
                above += part * values[j + k]
                below += part * stamp[i + k]
    return above, below


@leaf()
def _height(cluster, s, told, shift):
    """Log L + log p of a source that is shifted, given A and B there in units of the variance."""
    prior, (above, below) = cluster.prior, told
    if not below > 0.0:
        return -math.inf
    flux = _first_flux(prior, cluster.scale[s], above, below)
    ratio, _ = shift_prior(shift, prior.scatter)
    value = flux * (above - 0.5 * flux * below - 1.0 / cluster.scale[s])
    return value + prior.shape * math.log(flux) - (0.5 * DOF + 1.0) * math.log1p(ratio)


@leaf()
def _between(cluster, s, core, by, along):
    """Where between whole pixels the parabola through A along columns or rows is largest."""
    (i, j), (m, n) = by, along
    before = _moved(cluster, s, core, (i - m, j - n))[0]
    here = _moved(cluster, s, core, by)[0]
    after = _moved(cluster, s, core, (i + m, j + n))[0]
    bend = 2.0 * here - before - after
    return 0.5 * (after - before) / bend if bend > abs(after - before) else 0.0


@leaf()
def _match(cluster, s, level):
    """Shift a source to where its image is most likely."""
    layout, core, reach = cluster.layout, _core(cluster, s), SCATTER * cluster.prior.scatter
    a, b, pitch = layout.geometry.a[s], layout.geometry.b[s], layout.optics.step
    a_u, a_v, b_u, b_v = pitch * a[1, 0], pitch * a[0, 1], pitch * b[1, 0], pitch * b[0, 1]
    det = a_u * b_v - a_v * b_u
    step = max(int(layout.sigma / math.sqrt(det)), 1)
    columns = int(min(reach * math.hypot(a_v, b_v) / det, layout.optics.nx)) // step * step
    rows = int(min(reach * math.hypot(a_u, b_u) / det, layout.optics.ny)) // step * step
    highest, best = -math.inf, (0, 0)
    for j in range(-rows, rows + 1, step):
        for i in range(-columns, columns + 1, step):
            shift = a_u * i + a_v * j, b_u * i + b_v * j
            if math.hypot(shift[0], shift[1]) <= reach:
                above, below = _moved(cluster, s, core, (i, j))
                height = _height(cluster, s, (above / level, below / level), shift)
                if height > highest:
                    highest, best = height, (i, j)
    i = best[0] + _between(cluster, s, core, best, (1, 0))
    j = best[1] + _between(cluster, s, core, best, (0, 1))
    cluster.shifts[s, 0], cluster.shifts[s, 1] = a_u * i + a_v * j, b_u * i + b_v * j
    move(layout.optics, layout.geometry, s, cluster.shifts[s, 0], cluster.shifts[s, 1])


@leaf()
def _far(cluster):
    """Whether sources may be farther from where they are predicted than Newton's steps reach."""
    return cluster.prior.scatter > WIDE * cluster.layout.sigma


@leaf()
def _place(cluster, s, level, scatters):
    """Make a source's templates where the search for it begins."""
    make_templates(cluster, s, 1.0)
    if scatters is not None and _far(cluster):
        _match(cluster, s, level)
        make_templates(cluster, s, 1.0)


@inner()
def _in_turn(cluster, scatters):
    """The cluster's sources in the order in which they choose their images."""
    if scatters is None or not _far(cluster):
        return cluster.group.members
    order, scale = cluster.group.members.copy(), cluster.scale
    for i in range(order.size):
        for j in range(i + 1, order.size):
            if scale[order[j]] > scale[order[i]]:
                order[i], order[j] = order[j], order[i]
    return order


@inner()
def start(cluster, level):
    """Fill templates, fluxes and shifts, and the image."""
    fp, stamps, fluxes = cluster.layout.footprints, cluster.touching.stamps, cluster.fluxes
    scatters, rest = cluster.touching.scatters, Canvas(cluster.patch.score, cluster.canvas.at)
    for s in _in_turn(cluster, scatters):
        _place(cluster, s, level, scatters)
        above, below, every = _least_squares(cluster, s)
        fluxes[s] = cluster.prior.shape * cluster.scale[s]
        if below > SEEN * every:
            fluxes[s] = _first_flux(cluster.prior, cluster.scale[s], above / level, below / level)
        for m in range(1, stamps.shape[0]):
            for i in range(fp.start[fp.first[s]], fp.start[fp.first[s + 1]]):
                stamps[m, i] *= fluxes[s]
        rows = fp.first[s], fp.first[s + 1]
        add_template(fp, rows, stamps[0], fluxes[s], cluster.canvas)
        if scatters is not None and _far(cluster):
            add_template(fp, rows, stamps[0], -fluxes[s], rest)
