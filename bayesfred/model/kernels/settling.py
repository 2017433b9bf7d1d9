"""A cluster's maximum: by the steps of `shift_newton.py`, and the last few sources by themselves.

After some visits most sources of a cluster are at their maximum. Of hundreds there may be one that
crawls, as where one of two maxima of its shift is about to end, while all others wait. So where few
are left each is settled by itself, the others being as they are, in its own pixels. What its steps
tell of the second derivatives is used there, which takes a fraction of the visits. Then all are
visited again.
"""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import inner, leaf
from bayesfred.model.kernels.clusters import SHARE, add_prior, copy, gram
from bayesfred.model.kernels.contexts import Group
from bayesfred.model.kernels.factors import cholesky, solve
from bayesfred.model.kernels.flux_newton import Cluster
from bayesfred.model.kernels.likelihood import stretch, weigh_run
from bayesfred.model.kernels.noise_dispatch import given
from bayesfred.model.kernels.shift_newton import (
    CLOSE,
    ENDLESS,
    FLAT,
    change_source,
    curve,
    fill_gradient,
    log_density,
    search,
    take_step,
    turn_back,
)

FEW, ROUNDS = 8, 4  # one of so many sources is few; how often they are settled
ROUNDING = 1e-8  # of a scalar product, below which it tells nothing
SLACK = 1e-6  # by which log L + log p may be lower after a step, for rounding


@inner()
def alone(cluster, i):
    """Source i of a cluster whose positions scatter, as a cluster of its own in the same pixels."""
    members, start = cluster.group.members[i : i + 1], np.empty(3, np.int64)
    for t in range(3):
        start[t] = t * (t + 1) // 2
    return Cluster(
        cluster.layout,
        cluster.touching,
        Group(members, np.zeros(3, np.int64), start),
        cluster.patch,
        cluster.canvas,
        cluster.fluxes,
        cluster.shifts,
        cluster.prior,
        cluster.scale,
    )


@inner()
def _weigh(frame, noise, background, source):
    """Score and weight of the pixels of one source."""
    fp, patch, at = source.layout.footprints, source.patch, source.canvas.at
    s = source.group.members[0]
    for p in range(fp.first[s], fp.first[s + 1]):
        j, a, b = fp.row[p] - patch.top, at[p], at[p] + fp.size[p]
        first = patch.first[j] + a - patch.start[j]
        part = stretch(frame, background, fp.row[p], first, patch.image[a:b])
        weigh_run(noise, part, patch.score[a:b], patch.weight[a:b], None)


@leaf()
def _learn(change, step, h):
    """Change a source's matrix H to the nearest one with H d = y that differs by a rank of 1.

    d is a step, and y by how much the gradient is less after it.
    """
    rest, along, most = change, 0.0, 0.0
    for i in range(3):
        for k in range(3):
            m, n = max(i, k), min(i, k)
            rest[i] -= h[m * (m + 1) // 2 + n] * step[k]
        along += rest[i] * step[i]
        most += abs(rest[i] * step[i])
    if abs(along) > ROUNDING * most:
        for i in range(3):
            for k in range(i + 1):
                h[i * (i + 1) // 2 + k] += rest[i] * rest[k] / along


@inner()
def _fill_h(cluster, h):
    """H, or a source's block of it."""
    gram(cluster.touching, cluster.group, cluster.patch.weight, cluster.canvas.at, h)
    add_prior(h, cluster.group, cluster.prior, cluster.fluxes, cluster.shifts, SHARE)


@inner()
def _factor_curvature(source, h, curvature, lower):
    """Leave a source's H in h, less the second derivatives if that has a factor in `curvature`."""
    _fill_h(source, h)
    curve(source, np.empty((0, 6)), h, curvature)
    copy(curvature, lower)
    if cholesky(lower, source.group):
        return True
    copy(h, curvature)
    copy(h, lower)
    return cholesky(lower, source.group)


@inner()
def settle(frame, parameters, source, h):
    """Find the maximum of one source that is `alone`, the others being as they are.

    Leaves Cholesky's factor of its block of H in h, and returns whether it was found; otherwise the
    source is left as it was.
    """
    group, noise, background = source.group, given(frame.noise, parameters), parameters.background
    s = group.members[0]
    flux, (x, y) = source.fluxes[s], source.shifts[s]
    gradient, before, step, share = np.empty(3), np.empty(3), np.empty(3), np.ones(1)
    curvature, lower, known = np.empty(6), np.empty(6), False
    value = log_density(frame, parameters, source)
    for visit in range(ENDLESS):
        _weigh(frame, noise, background, source)
        fill_gradient(source, gradient)
        if known:
            _learn(before - gradient, share[0] * step, curvature)
            copy(curvature, lower)
            known = cholesky(lower, group)
        if not known and not _factor_curvature(source, h, curvature, lower):
            break
        known = True
        copy(gradient, before)
        copy(gradient, step)
        solve(lower, group, step)
        if np.dot(gradient, step) <= (CLOSE if visit + 1 < ENDLESS else FLAT):
            _fill_h(source, h)
            return cholesky(h, group)
        share[0] = 1.0
        take_step(source, step, share, True, 0.0)
        value = turn_back(frame, parameters, source, (step, share), value - SLACK)
    dx, dy = x - source.shifts[s, 0], y - source.shifts[s, 1]
    change_source(source, s, flux - source.fluxes[s], dx, dy, 0.0)
    return False


@inner()
def maximize(frame, parameters, cluster, known, h):
    """Find a cluster's maximum; leaves Cholesky's factor of H in h.

    Returns what the rest of the way to the maximum gains, which is nothing unless e is known; NaN
    if it fails.
    """
    members, own = cluster.group.members, np.empty(6)
    distances, few = np.empty(members.size), max(members.size // FEW, 1)
    settles = cluster.touching.stamps.shape[0] > 1 and known.nearby.e.size == 0
    for _ in range(ROUNDS if settles and members.size > 1 else 0):
        gain = search(frame, parameters, cluster, known, h, (distances, few))
        if gain < math.inf:
            return gain
        for i in range(members.size):
            if not abs(distances[i]) <= CLOSE:
                settle(frame, parameters, alone(cluster, i), own)
    gain = search(frame, parameters, cluster, known, h, (distances, 0))
    if settles and math.isnan(gain):
        # far from any maximum of the parameters the place where it ended will do
        _fill_h(cluster, h)
        return 0.0 if cholesky(h, cluster.group) else math.nan
    return gain
