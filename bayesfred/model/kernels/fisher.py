"""Fisher information from the Jacobian, what is free of every source profiled out."""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.geometry import SEGMENT, row_starts
from bayesfred.imaging.kernels.jacobian import add_jacobian_rows
from bayesfred.model.kernels.clusters import cholesky, dot, gram, one_cluster, solve
from bayesfred.model.kernels.likelihood import (
    LIMIT,
    POISSON,
    background_row,
    log_likelihood,
    next_run,
)

BAND = 16  # rows of the Jacobian held at a time


@inner()
def _fisher_weight(counts, w, background):
    """Expected information 1 / variance per marked pixel into w.weight, zero where masked; returns the unmarked pixels."""
    ny = w.span.shape[0]
    per_row = w.flags.size // ny
    pixels = counts.pixels
    for j in range(ny):
        c0, c1, c2 = background_row(background, j, ny)
        start, stop = next_run(w.flags, w.span, per_row, j, w.span[j, 0])
        while start >= 0:
            for p in range((j * per_row + start) * SEGMENT, (j * per_row + stop) * SEGMENT):
                u = (2 * (p - j * per_row * SEGMENT) - counts.nx + 1) / counts.nx
                mu = w.image[p] + c0 + u * (c1 + u * c2)
                counted = counts.values[p] > LIMIT
                w.weight[p] = (
                    (1.0 / (max(mu, 1e-300) if counts.kind == POISSON else c0)) if counted else 0.0
                )
            for k in range(j * per_row + start, j * per_row + stop):
                pixels -= counts.segment_pixels[k]
            start, stop = next_run(w.flags, w.span, per_row, j, stop)
    return pixels


@entry()
def fisher(o, counts, w, drawn, nuisances, background, terms, free, basis, out):
    """Fisher information of source parameters, then the first `terms` background coefficients, fluxes profiled out.

    I = sum over pixels of J J^T / mu, band by band of rows; with free fluxes the Schur complement
    I - C H^-1 C^T over the sources' templates, where H carries the priors' curvature.

    Returns the information about position_scatter: a coordinate measured with variance s^2 scatters
    by tau^2 + s^2 about the catalogue's, which gives 2 tau^2 / (tau^2 + s^2)^2 = 2 (tau^2 - Q)^2 /
    tau^6 with Q its variance given the prior. NaN where the likelihood is zero.
    """
    if not drawn.extra + log_likelihood(counts, w, background) > -math.inf:
        return math.nan
    fp, boxes, clusters, stamps, factors, fitted, _ = drawn.fitted
    sigma, scatter, templates = nuisances[3], nuisances[4], stamps.shape[0]
    pixels = _fisher_weight(counts, w, background)
    ny, pitch = o.ny, w.image.size // o.ny
    per_row = w.flags.size // ny
    sources = basis.row.size
    size = sources + terms
    cross = np.zeros((fitted.size * templates, size))
    band = np.empty((size, BAND, pitch))
    for top in range(0, ny, BAND):
        last = min(top + BAND, ny)
        band[:] = 0.0
        add_jacobian_rows(o, drawn.maps, fp, basis, fitted, sigma, top, last, band)
        for j in range(top, last):
            v = (2 * j - ny + 1) / ny
            for i in range(pitch):
                u = (2 * i - o.nx + 1) / o.nx
                band[sources, j - top, i] = 1.0
                if terms > 1:
                    band[sources + 1, j - top, i], band[sources + 2, j - top, i] = u, v
                if terms > 3:
                    band[sources + 3, j - top, i], band[sources + 4, j - top, i] = u * u, u * v
                    band[sources + 5, j - top, i] = v * v
            start, stop = next_run(w.flags, w.span, per_row, j, w.span[j, 0])
            while start >= 0:
                a, b = start * SEGMENT, stop * SEGMENT
                weight = w.weight[j * pitch + a : j * pitch + b]
                for k in range(size):
                    left = band[k, j - top, a:b]
                    for m in range(k + 1):
                        out[k, m] += dot(left, band[m, j - top, a:b], weight)
                start, stop = next_run(w.flags, w.span, per_row, j, stop)
        if free is not None:
            for s in range(fitted.size):
                for j in range(max(top, boxes[s, 0]), min(last, boxes[s, 1])):
                    i = fp.first[s] + j - boxes[s, 0]
                    a, b = fp.low[i], fp.low[i] + fp.size[i]
                    weight = w.weight[j * pitch + a : j * pitch + b]
                    for t in range(templates):
                        stamp = stamps[t, fp.start[i] : fp.start[i + 1]]
                        for k in range(size):
                            cross[s * templates + t, k] += dot(band[k, j - top, a:b], stamp, weight)
    out[sources, sources] += pixels / background[0] if pixels > 0.0 else 0.0
    known = 0.0
    if free is not None:
        at = row_starts(fp, pitch)
        for c in range(clusters.first.size - 1):
            members, lead, start = one_cluster(clusters, c, templates)
            n = members.size * templates
            h = factors[clusters.begin[c] : clusters.begin[c + 1]]
            gram(fp, boxes, members, lead, start, stamps, w.weight, at, h)
            for i in range(n):
                h[start[i] + i] += (
                    1.0 / fitted[members[i // templates]] ** 2
                    if i % templates == 0
                    else 1.0 / scatter**2
                )
            cholesky(h, lead, start)  # positive definite: the prior's curvature is
            column = np.empty(n)
            for i in range(n):
                if i % templates > 0:
                    column[:] = 0.0
                    column[i] = 1.0
                    solve(h, lead, start, column)
                    known += 2.0 * (scatter**2 - column[i]) ** 2 / scatter**6
            for m in range(size):
                for i in range(n):
                    column[i] = cross[members[i // templates] * templates + i % templates, m]
                solve(h, lead, start, column)
                for k in range(m, size):
                    for i in range(n):
                        out[k, m] -= (
                            cross[members[i // templates] * templates + i % templates, k]
                            * column[i]
                        )
    for k in range(size):
        for m in range(k):
            out[m, k] = out[k, m]
    return known
