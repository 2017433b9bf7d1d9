"""Every source's own pixels with its templates, and how far the counts there are from them.

The templates of a source are the derivatives of its light S: S itself (by the logarithm of the
flux), X and Y (as it moves along a and b), and dS/dln(sigma). With residuals r and weights w the
coefficients c of all sources' templates T solve the normal equations A c = T^T w r, A = T^T w T.
A couples neighbours only. So each source is solved for together with the neighbours that its
templates overlap most, which it is then marginalised over: the last block of Cholesky's factor of
their part of A. Nothing is as large as the number of sources squared. For a true model the
covariance of T^T w r is A, hence that of c is A^-1 whatever neighbours are left out.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.geometry import (
    find_footprints,
    lay_out,
    locate,
    move,
    new_geometry,
    one_source,
    some_sources,
)
from bayesfred.imaging.kernels.polynomials import map_on_row
from bayesfred.imaging.kernels.render import BATCH, add_templates

TEMPLATES = 4
NEIGHBOURS = 8  # solved for together with a source
COUPLED = 0.01  # overlap of two sources' templates, as a correlation, that is too small to matter
DETERMINED = 1e-6  # share of a template that the others must leave


class OwnPixels(NamedTuple):
    """The pixels of every source, those of source s from first[s] to first[s + 1].

    They are in the likelihood, and their centres lie within the given radius in (a, b).
    """

    first: Ints  # (s + 1,)
    pixel: Ints  # (samples,) row nx + column, ascending
    templates: Floats  # (4, samples) S, X, Y, dS/dln(sigma), counts and counts per fine pixel
    all_light: Floats  # (samples,) of all sources, counts
    image: Floats  # (s, 2) u and v of the middle, fine pixel; nan without an image
    slopes: Floats  # (s, 4) a_u, a_v, b_u, b_v there


@entry()
def own_pixels(o, parameters, placed, radius, frame):
    """Find the pixels within a radius (a, b) of the sources, and their templates.

    `placed` are the sources' fluxes and shifts, `frame` the pixels in the likelihood and the light
    of all sources in padded rows. The optics' support radius is that of `radius`.
    """
    fluxes, shifts = placed
    mask, light = frame
    nuisances = parameters.nuisances
    geometry, work = new_geometry(o), np.empty(o.ramp.size)
    locate(o, parameters.theta, nuisances, geometry)
    size, total = fluxes.size, find_footprints(o, geometry).start[-1]
    first, pixel = np.zeros(size + 1, np.int64), np.empty(total, np.int64)
    templates, slopes = np.empty((TEMPLATES, total)), np.empty((size, 4))
    all_light = np.empty(total)
    image = geometry.peak.copy()
    used = 0
    for begin in range(0, size, BATCH):
        part = some_sources(geometry, begin, begin + BATCH)
        a, b = part.a, part.b
        layout = lay_out(o, part, nuisances.psf_sigma)
        fp = layout.footprints
        stamps = np.zeros((TEMPLATES, fp.start[fp.row.size]))
        for i in range(part.peak.shape[0]):
            s = begin + i
            slopes[s, 0], slopes[s, 1] = a[i, 1, 0], a[i, 0, 1]
            slopes[s, 2], slopes[s, 3] = b[i, 1, 0], b[i, 0, 1]
            if max(abs(a[i, 0, 0]), abs(b[i, 0, 0])) > 1e-6 * o.step:
                image[s] = np.nan
            move(o, part, i, shifts[s, 0], shifts[s, 1])
            add_templates(layout, i, fluxes[s], stamps[:3], stamps[3])
            for p in range(fp.first[i], fp.first[i + 1]):
                n, low, row = fp.size[p], fp.low[p], fp.row[p]
                _distances(layout, one_source(part, i), low, row, work[:n])
                for k in range(n):
                    if low + k < o.nx and mask[row, low + k] and work[k] <= radius * radius:
                        pixel[used] = row * o.nx + low + k
                        for t in range(TEMPLATES):
                            templates[t, used] = stamps[t, fp.start[p] + k]
                        templates[0, used] *= fluxes[s]
                        all_light[used] = light[row, low + k]
                        used += 1
            first[s + 1] = used
    return OwnPixels(first, pixel[:used], templates[:, :used], all_light[:used], image, slopes)


@inner()
def _distances(layout, source, low, row, out):
    """The squared distances a^2 + b^2 of a row's pixel centres."""
    o, work = layout.optics, layout.work
    w = (row - 0.5 * (o.ny - 1)) * o.step - source.v
    t0 = (low - 0.5 * (o.nx - 1)) * o.step - source.u
    map_on_row(source, w, work, o.degrees.ab)
    top = len(o.degrees.ab)
    for n in range(out.size):
        t = t0 + o.ramp[n]
        a, b = work[2, top], work[3, top]
        for m in range(top):
            a = a * t + work[2, top - 1 - m]
            b = b * t + work[3, top - 1 - m]
        out[n] = a * a + b * b


@inner()
def _overlap(own, weight, s, t, block):
    """block = sum over the pixels that sources s and t share of w T_s T_t."""
    first, pixel, templates = own.first, own.pixel, own.templates
    block[:] = 0.0
    i, k = first[s], first[t]
    while i < first[s + 1] and k < first[t + 1]:
        if pixel[i] < pixel[k]:
            i += 1
        elif pixel[i] > pixel[k]:
            k += 1
        else:
            for m in range(TEMPLATES):
                for n in range(TEMPLATES):
                    block[m, n] += weight[i] * templates[m, i] * templates[n, k]
            i += 1
            k += 1


@inner()
def _coupling(block, one, other):
    """The largest correlation of two sources' templates."""
    largest = 0.0
    for m in range(TEMPLATES):
        for n in range(TEMPLATES):
            scale = one[m, m] * other[n, n]
            if scale > 0.0:
                largest = max(largest, abs(block[m, n]) / np.sqrt(scale))
    return largest


@inner()
def _companions(own, weight, near, s, squares):
    """The neighbours of source s that overlap it most, the closest last, and then s."""
    firsts, others = near
    found, strength = np.empty(NEIGHBOURS + 1, np.int64), np.zeros(NEIGHBOURS + 1)
    size, block = 0, np.empty((TEMPLATES, TEMPLATES))
    for e in range(firsts[s], firsts[s + 1]):
        t = others[e]
        _overlap(own, weight, s, t, block)
        coupling = _coupling(block, squares[s], squares[t])
        if coupling < COUPLED or (size == NEIGHBOURS and coupling <= strength[0]):
            continue
        if size < NEIGHBOURS:
            size += 1
        else:  # the weakest makes room
            for j in range(size - 1):
                found[j], strength[j] = found[j + 1], strength[j + 1]
        k = size - 1
        while k > 0 and strength[k - 1] > coupling:
            found[k], strength[k] = found[k - 1], strength[k - 1]
            k -= 1
        found[k], strength[k] = t, coupling
    found[size] = s
    return found[: size + 1]


@inner()
def _factor(matrix, vector, known):
    """Cholesky's factor in place, and the vector solved by it forward.

    A row that the earlier ones determine is left out: it and its unknown become zero.
    """
    for i in range(vector.size):
        known[i] = True
        for k in range(i + 1):
            total = matrix[i, k]
            for m in range(k):
                total -= matrix[i, m] * matrix[k, m]
            if k < i:
                matrix[i, k] = total / matrix[k, k] if known[k] else 0.0
            else:
                known[i] = total > DETERMINED
                matrix[i, i] = np.sqrt(total) if known[i] else 1.0
        if not known[i]:
            matrix[i, :i] = 0.0
        total = vector[i]
        for m in range(i):
            total -= matrix[i, m] * vector[m]
        vector[i] = total / matrix[i, i] if known[i] else 0.0


@entry()
def fit_templates(own, weight, pull, near):
    """Coefficients of every source's templates, shape (s, 4), and covariances, (s, 4, 4).

    The third result is each source's own part of the information, shape (s, 4, 4).

    `pull` is w r of the samples, `near` are (firsts, others): the neighbours of source s are
    others[firsts[s]:firsts[s + 1]]. Where a template is not determined its coefficient is nan.
    """
    size = own.first.size - 1
    projected, squares = np.zeros((size, TEMPLATES)), np.zeros((size, TEMPLATES, TEMPLATES))
    for s in range(size):
        for i in range(own.first[s], own.first[s + 1]):
            for m in range(TEMPLATES):
                projected[s, m] += pull[i] * own.templates[m, i]
                for n in range(TEMPLATES):
                    squares[s, m, n] += weight[i] * own.templates[m, i] * own.templates[n, i]
    out, covariance = np.empty((size, TEMPLATES)), np.empty((size, TEMPLATES, TEMPLATES))
    most = (NEIGHBOURS + 1) * TEMPLATES
    matrices, rows, flags = np.empty((most, most)), np.empty((2, most)), np.empty(most, np.bool_)
    for s in range(size):
        members = _companions(own, weight, near, s, squares)
        n = members.size * TEMPLATES
        matrix, vector, scale, known = matrices[:n, :n], rows[0, :n], rows[1, :n], flags[:n]
        _fill_equations(own, weight, members, (projected, squares), (matrix, vector, scale))
        _factor(matrix, vector, known)
        _solve_last(matrix, vector, known, scale, (out[s], covariance[s]))
    return out, covariance, squares


@inner()
def _fill_equations(own, weight, members, sums, equations):
    """The normal equations of some sources, scaled to a diagonal of 1."""
    projected, squares = sums
    matrix, vector, scale = equations
    block = np.empty((TEMPLATES, TEMPLATES))
    for i in range(members.size):
        s = members[i]
        for k in range(i + 1):
            if k < i:
                _overlap(own, weight, s, members[k], block)
            part = block if k < i else squares[s]
            for m in range(TEMPLATES):
                for n in range(TEMPLATES):
                    matrix[i * TEMPLATES + m, k * TEMPLATES + n] = part[m, n]
        for m in range(TEMPLATES):
            vector[i * TEMPLATES + m] = projected[s, m]
    for i in range(vector.size):
        scale[i] = 1.0 / np.sqrt(matrix[i, i]) if matrix[i, i] > 0.0 else 0.0
        vector[i] *= scale[i]
        for k in range(i + 1):
            matrix[i, k] *= scale[i] * scale[k]


@inner()
def _solve_last(matrix, vector, known, scale, results):
    """The last block's solution and covariance, from Cholesky's factor."""
    out, covariance = results
    at = vector.size - TEMPLATES
    inverse = np.zeros((TEMPLATES, TEMPLATES))  # of the factor's last block
    for k in range(TEMPLATES):
        if known[at + k]:
            inverse[k, k] = 1.0 / matrix[at + k, at + k]
            for i in range(k + 1, TEMPLATES):
                total = 0.0
                for m in range(k, i):
                    total -= matrix[at + i, at + m] * inverse[m, k]
                inverse[i, k] = total / matrix[at + i, at + i]
    for i in range(TEMPLATES):
        out[i] = 0.0
        for m in range(TEMPLATES):
            out[i] += inverse[m, i] * vector[at + m] * scale[at + i]
        for k in range(TEMPLATES):
            covariance[i, k] = 0.0
            for m in range(TEMPLATES):
                covariance[i, k] += inverse[m, i] * inverse[m, k] * scale[at + i] * scale[at + k]
    for i in range(TEMPLATES):
        if not known[at + i]:
            out[i] = np.nan
            covariance[i, :] = np.nan
            covariance[:, i] = np.nan
