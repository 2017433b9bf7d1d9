"""Fisher information from the Jacobian, what is free of every source profiled out."""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner, leaf, shared
from bayesfred.imaging.kernels.contexts import SEGMENT
from bayesfred.imaging.kernels.geometry import layout_of, row_starts
from bayesfred.imaging.kernels.jacobian import add_jacobian_rows
from bayesfred.model.kernels.clusters import (
    DOF,
    Prior,
    add_prior,
    dot,
    gram,
    one_cluster,
    shift_prior,
)
from bayesfred.model.kernels.contexts import BACKGROUND_POWERS, LIMIT
from bayesfred.model.kernels.factors import cholesky, invert, solve
from bayesfred.model.kernels.likelihood import (
    U,
    background_row,
    log_likelihood,
    next_run,
    rise,
    unreached_pixels,
)
from bayesfred.model.kernels.noise_dispatch import (
    by_exactness,
    error_information,
    given,
    information,
    level_derivatives,
    unreached,
)

BAND = 16  # rows of the Jacobian held at a time
MOST_LOST = 0.9  # of the information about the model error; more is rounding
EXPECTED = (DOF + 2.0) / (DOF + 4.0)


class _Band(NamedTuple):
    """Rows of the Jacobian."""

    jacobian: Floats  # (parameters, rows, padded row)
    top: int
    last: int


@leaf()
def _fill_weight(frame, noise, w, background):
    """Expected information per marked pixel into w.weight, zero where masked.

    Returns the information about the model error.
    """
    known = 0.0
    pitch = frame.values.size // frame.ny
    for j in range(frame.ny):
        row = background_row(background, j, frame.ny)
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                mu = w.image[p] + row[0] + rise(row, u)
                counted = frame.values[p] > LIMIT
                w.weight[p] = information(noise, mu, w.image[p], U(p)) if counted else 0.0
                known += error_information(noise, mu, w.image[p], U(p)) if counted else 0.0
            start, stop = next_run(w, j, stop)
    return known


@leaf()
def _fill_background(frame, band, sources):
    """Derivatives with respect to the background's coefficients."""
    left, step = 1.0 / frame.nx - 1.0, 2.0 / frame.nx
    for j in range(band.top, band.last):
        v, i = (2 * j - frame.ny + 1) / frame.ny, j - band.top
        rows = band.jacobian[sources:, i]
        for t in range(rows.shape[0]):
            m, n = BACKGROUND_POWERS[t]
            if m == 0:
                rows[t] = v**n
            else:
                lower = rows[t - m - n]  # of the term with a power less of u
                for k in range(rows.shape[1]):
                    rows[t, k] = (left + step * k) * lower[k]


@leaf()
def _add_products(w, band, out):
    """Add the band's J W J^T to the lower triangle."""
    jacobian, top, weights = band.jacobian, band.top, w.weight
    pitch = jacobian.shape[2]
    for j in range(top, band.last):
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            a, b = start * SEGMENT, stop * SEGMENT
            weight = weights[j * pitch + a : j * pitch + b]
            for k in range(out.shape[0]):
                left = jacobian[k, j - top, a:b]
                for m in range(k + 1):
                    out[k, m] += dot(left, jacobian[m, j - top, a:b], weight)
            start, stop = next_run(w, j, stop)


@leaf()
def _add_cross(w, band, profiled, cross):
    """Add the band's products of the sources' templates and J to C^T."""
    if profiled is not None:
        touching, (jacobian, top, last), weights = profiled.touching, band, w.weight
        fp, boxes, stamps = touching.footprints, touching.boxes, touching.stamps
        first, lows, sizes, starts = fp.first, fp.low, fp.size, fp.start
        templates, pitch = stamps.shape[0], jacobian.shape[2]
        for s in range(boxes.shape[0]):
            for j in range(max(top, boxes[s, 0]), min(last, boxes[s, 1])):
                i = first[s] + j - boxes[s, 0]
                a, b = lows[i], lows[i] + sizes[i]
                weight = weights[j * pitch + a : j * pitch + b]
                for t in range(templates):
                    stamp = stamps[t, starts[i] : starts[i + 1]]
                    for k in range(cross.shape[1]):
                        row = jacobian[k, j - top, a:b]
                        cross[s * templates + t, k] += dot(row, stamp, weight)


@inner()
def _known_scatter(h, group, profiled, templates, scatter):
    """Information about position_scatter from a cluster's sources."""
    share = DOF / (DOF + 4.0)
    known = 0.0
    if templates > 1:
        q = invert(h, group)
        for i in range(group.lead.size):
            if i % templates > 0:
                shift = profiled.shifts[group.members[i // templates]]
                own = q[group.start[i] + i]
                left = 1.0 - EXPECTED * shift_prior(shift, scatter)[1] * own
                known += share * 2.0 * (left / scatter) ** 2
    return known


@inner()
def _subtract_profiled(w, rendered, profiled, scatter, cross, out):
    """Subtract C H^-1 C^T from the lower triangle; returns the information about the scatter."""
    known = 0.0
    if profiled is not None:
        touching = profiled.touching
        fp, clusters, templates = touching.footprints, touching.clusters, touching.stamps.shape[0]
        at = row_starts(fp, w.image.size // w.span.shape[0])
        for c in range(clusters.first.size - 1):
            group = one_cluster(clusters, c, templates)
            members, column = group.members, np.empty(group.lead.size)
            h = profiled.factors[clusters.begin[c] : clusters.begin[c + 1]]
            gram(touching, group, w.weight, at, h)
            prior = Prior(profiled.shape, scatter)
            add_prior(h, group, prior, rendered.fluxes, profiled.shifts, EXPECTED)
            cholesky(h, group)  # positive definite: the prior's curvature is
            known += _known_scatter(h, group, profiled, templates, scatter)
            for m in range(out.shape[0]):
                for i in range(column.size):
                    column[i] = cross[members[i // templates] * templates + i % templates, m]
                solve(h, group, column)
                for k in range(m, out.shape[0]):
                    for i in range(column.size):
                        row = members[i // templates] * templates + i % templates
                        out[k, m] -= cross[row, k] * column[i]
    return known


@leaf()
def _weigh_by_error(frame, noise, w, background):
    """W c into w.score and W c^2 into w.ratio, where c = d ln variance / d eps."""
    pitch = frame.values.size // frame.ny
    for j in range(frame.ny):
        row = background_row(background, j, frame.ny)
        start, stop = next_run(w, j, w.span[j, 0])
        while start >= 0:
            for p in range(j * pitch + start * SEGMENT, j * pitch + stop * SEGMENT):
                u = (2 * (p - j * pitch) - frame.nx + 1) / frame.nx
                mu = w.image[p] + row[0] + rise(row, u)
                c = math.sqrt(2.0 * error_information(noise, mu, w.image[p], U(p)))
                w.score[p] = w.weight[p] * c
                w.ratio[p] = w.score[p] * c
            start, stop = next_run(w, j, stop)


@leaf()
def _trace(q, a, group):
    """Tr Q A of symmetric matrices that are stored as A is."""
    out = 0.0
    for i in range(group.lead.size):
        for j in range(group.start[i] + group.lead[i], group.start[i] + i):
            out += 2.0 * q[j] * a[j]
        out += q[group.start[i] + i] * a[group.start[i] + i]
    return out


@leaf()
def _entry(matrix, group, i, j):
    return matrix[group.start[max(i, j)] + min(i, j)]


@leaf()
def _trace_of_square(q, b, group, templates):
    """Tr Q B Q B of every source's own blocks."""
    out = 0.0
    for first in range(0, group.lead.size, templates):
        for i in range(first, first + templates):
            for j in range(first, first + templates):
                forth, back = 0.0, 0.0
                for k in range(first, first + templates):
                    forth += _entry(q, group, i, k) * _entry(b, group, k, j)
                    back += _entry(q, group, j, k) * _entry(b, group, k, i)
                out += forth * back
    return out


@shared()
def _lost(frame, noise, w, background, profiled):
    """What fluxes and shifts take of the information about the model error: they fit residuals.

    The information of the restricted likelihood is Tr (P V')^2 / 2, where V' = c V are the
    variances' derivatives and P = V^-1 - V^-1 T H^-1 T^T V^-1. With A = T^T (c^2 / V) T and B = T^T
    (c / V) T it is that of the pixels less Tr H^-1 A - Tr (H^-1 B)^2 / 2. The second trace is that
    of single sources: those that overlap have little of it in common.

    References
    ----------
    H. D. Patterson, R. Thompson, Biometrika 58, 545 (1971).
    """
    lost = 0.0
    if profiled is not None:
        touching = profiled.touching
        clusters, templates = touching.clusters, touching.stamps.shape[0]
        at = row_starts(touching.footprints, w.image.size // w.span.shape[0])
        _weigh_by_error(frame, noise, w, background)
        for c in range(clusters.first.size - 1):
            group = one_cluster(clusters, c, templates)
            q = invert(profiled.factors[clusters.begin[c] : clusters.begin[c + 1]], group)
            products = np.empty(q.size)
            gram(touching, group, w.ratio, at, products)
            lost += _trace(q, products, group)
            gram(touching, group, w.score, at, products)
            lost -= 0.5 * _trace_of_square(q, products, group, templates)
    return lost


def _none_lost(noise, frame, w, background, profiled):
    return 0.0


def _some_lost(noise, frame, w, background, profiled):
    return _lost(frame, noise, w, background, profiled)


_lost_to_sources = by_exactness(_none_lost, _some_lost)


@entry()
def fisher(problem, w, rendered, parameters, basis, out):
    """Fisher information of source parameters, then of as many background coefficients as fit.

    I = sum over pixels of J J^T / variance, band by band of rows; with free fluxes the Schur
    complement I - C H^-1 C^T over the sources' templates, where H carries the priors' curvature.

    Returns the information about position_scatter and about model_error, NaN where the likelihood
    is zero. A coordinate that is measured with variance s^2, and whose variance given the prior is
    Q, tells of a normal scatter 2 tau^2 / (tau^2 + s^2)^2 = 2 (1 - Q / tau^2)^2 / tau^2. Student's
    distribution gives nu / (nu + 4) of that, and on average (nu + 2) / (nu + 4) of the curvature k
    as information about a shift.
    """
    o, frame, background = problem.optics, problem.frame, parameters.background
    level, noise = background[0], given(frame.noise, parameters)
    value = log_likelihood(frame, w, parameters)
    if not rendered.extra + value > -math.inf:
        return math.nan, math.nan
    profiled, scatter = rendered.profiled, parameters.nuisances.position_scatter
    known_error = _fill_weight(frame, noise, w, background)
    sigma = parameters.nuisances.psf_sigma
    layout = layout_of(o, rendered.geometry, rendered.footprints, sigma)
    sources, size = basis.row.size, out.shape[0]
    cross = np.zeros((rendered.fluxes.size * (3 if scatter > 0.0 else 1), size))
    jacobian = np.empty((size, BAND, w.image.size // o.ny))
    for top in range(0, o.ny, BAND):
        band = _Band(jacobian, top, min(top + BAND, o.ny))
        jacobian[:] = 0.0
        add_jacobian_rows(layout, basis, rendered.fluxes, top, band.last, jacobian)
        _fill_background(frame, band, sources)
        _add_products(w, band, out)
        _add_cross(w, band, profiled, cross)
    out[sources, sources] += unreached(noise, unreached_pixels(frame, w), level)[2]
    out[sources, sources] += level_derivatives(frame.noise, frame.pixels, level, value)[1]
    known = _subtract_profiled(w, rendered, profiled, scatter, cross, out)
    for k in range(size):
        for m in range(k):
            out[m, k] = out[k, m]
    lost = _lost_to_sources(noise, frame, w, background, profiled)
    return known, known_error - min(lost, MOST_LOST * known_error)
