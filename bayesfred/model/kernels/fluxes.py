"""Fluxes and positions at their maximum, where these are free.

Free fluxes. Given everything else the expected counts mu = B + sum_s F_s K_s are linear in the
fluxes F, and the prior is F_s ~ Gamma(a, scale c_s/a). What is integrated over is log F, whose
density is F times that of F: it is nearer to a normal one, and no F > 0 is out of its reach. With
log p(log F) = a log F - a F/c, log L + log p is concave in F wherever the log-density of counts is
concave in mu: for Poisson counts a sum of n log(mu), log(F) and linear terms. Along a Newton step
let d be the largest relative change of any of these mu and F. A fraction t < 1/d of the step raises
the second derivative by no more than 1/(1 - t d)^2, so the gain is largest, for certain, at t =
1/(1 + d): mu and F stay positive, the iteration converges from any start, and quadratically as d
vanishes. With H minus the Hessian in F at the maximum, that in log F
being F_s H_st F_t there,

    log L(theta) = max_F [log L(theta, F) + log p(log F)] + n_s/2 log(2 pi) - 1/2 log det H
                   - sum_s log F_s + c,

Laplace's approximation and the next term, see `expansion.py`.

Free positions. Where the catalogue's positions scatter, every source has three free numbers phi =
(F, dx, dy) and three templates T = d mu/d phi: K, F X and F Y with X = dK/d dx, Y = dK/d dy,
rebuilt as the source moves. The shifts dx and dy of a and b have Student's t distribution with nu =
`DOF` degrees of freedom as their prior, so that a few sources far off do not widen the others',

    log p(dx, dy) = -(nu/2 + 1) log(1 + rho) - log(2 pi tau^2),    rho = (dx^2 + dy^2) / nu tau^2,

whose derivative by dx is -k dx with k = (nu + 2) / nu tau^2 (1 + rho). H = sum_p W T T^T +
diag(a/F^2, k', k'), W = -d^2 log L/d mu^2, leaves out the second derivatives, which it weighs with
residuals of mean zero. With k' = k nu / (nu + 2) it is positive definite anywhere, and the integral
over the shifts is right where the counts say much of them, so that k' does not count, and where
they say nothing, so that it is that of the prior, 1.
"""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import inner, leaf, shared
from bayesfred.imaging.kernels.contexts import Canvas
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.imaging.kernels.geometry import move
from bayesfred.model.kernels.clusters import (
    Prior,
    add_template,
    copy,
    one_cluster,
)
from bayesfred.model.kernels.expansion import Pixels, expand
from bayesfred.model.kernels.flux_newton import (
    Cluster,
    make_templates,
    maximize_fluxes,
)
from bayesfred.model.kernels.noise_dispatch import by_exactness, given
from bayesfred.model.kernels.patches import add_patch, fill_excess, new_patch, weigh_patch
from bayesfred.model.kernels.settling import alone, maximize, settle
from bayesfred.model.kernels.shift_modes import other_mode
from bayesfred.model.kernels.shift_newton import change_source, log_density, log_prior
from bayesfred.model.kernels.starts import start

TRIES = 4  # other modes that are looked at in a cluster
LONE = 0.02  # of a source's light: what others may have in its image
TIE = -2.0  # in log-density: another mode that is predicted to be this much lower is looked at


@inner(fastmath=REDUCE)
def _known(cluster, s):
    """What the pixels tell of a source's shift along itself, its flux unknown."""
    fp, stamps, at = cluster.layout.footprints, cluster.touching.stamps, cluster.canvas.at
    weight, (dx, dy) = cluster.patch.weight, cluster.shifts[s]
    own, cross, along = 1e-300, 0.0, 0.0
    for p in range(fp.first[s], fp.first[s + 1]):
        first = fp.start[p]
        for k in range(fp.size[p]):
            w, unit = weight[at[p] + k], stamps[0, first + k]
            slope = stamps[1, first + k] * dx + stamps[2, first + k] * dy
            own += w * unit * unit
            cross += w * unit * slope
            along += w * slope * slope
    return (along - cross * cross / own) / (dx * dx + dy * dy)


@inner()
def _half_log_determinant(cluster, h):
    """Of H in the logarithms of the fluxes, from Cholesky's factor of H."""
    start, value = cluster.group.start, 0.0
    for i in range(start.size):
        value += math.log(h[start[i] + i])
    for s in cluster.group.members:
        value += math.log(cluster.fluxes[s])
    return value


@inner()
def _log_evidence(frame, parameters, cluster, h):
    """What the log-density of a cluster's mode and its width say, up to constants."""
    return log_density(frame, parameters, cluster) - _half_log_determinant(cluster, h)


@leaf(fastmath=REDUCE)
def _lone(cluster, s):
    """Whether a source's image has hardly any light of others in it."""
    fp, unit, at = cluster.layout.footprints, cluster.touching.stamps[0], cluster.canvas.at
    image, own, every = cluster.patch.image, 0.0, 0.0
    for p in range(fp.first[s], fp.first[s + 1]):
        first = fp.start[p]
        for k in range(fp.size[p]):
            own += unit[first + k] * unit[first + k]
            every += unit[first + k] * image[at[p] + k]
    return every < (1.0 + LONE) * cluster.fluxes[s] * own


@inner()
def _settled(frame, parameters, source):
    """What they say of one source, the others being as they are."""
    h = np.empty(6)
    if not settle(frame, parameters, source, h):
        return math.nan
    return _log_evidence(frame, parameters, source, h)


@inner()
def _climb(frame, parameters, cluster, known, h):
    """The same for the highest mode: a shift may have two, see `shift_modes.py`."""
    gain = maximize(frame, parameters, cluster, known, h)
    if math.isnan(gain):
        return gain
    members, fluxes, shifts = cluster.group.members, cluster.fluxes, cluster.shifts
    gains, ratios = np.empty(members.size), np.empty(members.size)
    for i in range(members.size):
        told, shift = _known(cluster, members[i]), math.sqrt(np.sum(shifts[members[i]] ** 2))
        gains[i], ratios[i] = other_mode(shift, told, cluster.prior.scatter, cluster.layout.sigma)
    value, factor = math.nan, np.empty(0)
    for _ in range(TRIES):
        i = gains.argmax()
        if gains[i] < TIE:
            break
        gains[i] = -math.inf
        source, s, higher = alone(cluster, i), members[i], math.nan
        old_fluxes, old_shifts = fluxes[members], shifts[members]
        if factor.size == 0:
            value, factor = gain + _log_evidence(frame, parameters, cluster, h), np.empty(h.size)
        lone = _lone(cluster, s)
        if lone:
            higher = -_settled(frame, parameters, source)
        dx, dy = ratios[i] * old_shifts[i] - shifts[s]
        change_source(cluster, s, 0.0, dx, dy, 0.0)
        if lone:  # it tells by itself whether the other mode is higher
            higher += _settled(frame, parameters, source)
        if not higher <= TIE:
            more = maximize(frame, parameters, cluster, known, factor)
            if not math.isnan(more):
                there = more + _log_evidence(frame, parameters, cluster, factor)
                if there > value:
                    value, gain = there, more
                    copy(factor, h)
                    continue
        for j in range(members.size):
            s = members[j]
            flux, (dx, dy) = old_fluxes[j] - fluxes[s], old_shifts[j] - shifts[s]
            if flux != 0.0 or dx != 0.0 or dy != 0.0:
                change_source(cluster, s, flux, dx, dy, 0.0)
    return gain


def _flux_maximum(noise, frame, parameters, cluster, known, h):
    return 0.0 if maximize_fluxes(frame, parameters, cluster, h) else math.nan


def _newton_maximum(noise, frame, parameters, cluster, known, h):
    return maximize(frame, parameters, cluster, known, h)


# The maximum of fluxes alone.
_maximum_of_fluxes = by_exactness(_flux_maximum, _newton_maximum)


@inner()
def _highest(problem, parameters, cluster, known, h, scatters):
    """Leave a cluster at its highest maximum, as `maximize` does at one."""
    frame = problem.frame
    if scatters is None or cluster.touching.stamps.shape[0] == 1:  # or by a scatter of 0
        return _maximum_of_fluxes(frame.noise, frame, parameters, cluster, known, h)
    return _climb(frame, parameters, cluster, known, h)


@inner()
def _resume(cluster, start):
    """Templates and image of fluxes and shifts that are known already."""
    fp, stamps = cluster.layout.footprints, cluster.touching.stamps
    for s in cluster.group.members:
        cluster.fluxes[s] = start[s, 0]
        if stamps.shape[0] > 1:
            copy(start[s, 1:], cluster.shifts[s])
            move(cluster.layout.optics, cluster.layout.geometry, s, start[s, 1], start[s, 2])
        make_templates(cluster, s, start[s, 0])
        rows = fp.first[s], fp.first[s + 1]
        add_template(fp, rows, stamps[0], start[s, 0], cluster.canvas)


@shared()
def profile(problem, layout, w, parameters, known, profiled):
    """Fill `profiled` with the maximum; add the sources to the image.

    Returns what the integral over them adds to the log-likelihood. Where no maximum is found that
    is -inf, or NaN if the search might have ended early: another may find it.
    With three templates the shifts are free, and `layout` is left with the shifted sources.
    """
    touching, factors = profiled.touching, profiled.factors
    fluxes, shifts = profiled.fluxes, profiled.shifts
    fp, clusters, size = layout.footprints, touching.clusters, touching.stamps.shape[0]
    at = np.empty(fp.row.size, np.int64)
    shape, scatter = problem.shape, parameters.nuisances.position_scatter
    scale, value = problem.flux / shape, 0.0
    shifts[:] = 0.0
    for c in range(clusters.first.size - 1):
        group = one_cluster(clusters, c, size)
        h = factors[clusters.begin[c] : clusters.begin[c + 1]]
        patch = new_patch(w, touching, group, at)
        canvas = Canvas(patch.image, at)
        cluster = Cluster(
            layout, touching, group, patch, canvas, fluxes, shifts, Prior(shape, scatter), scale
        )
        if known.start.size > 0:
            _resume(cluster, known.start)
        else:
            fill_excess(problem.frame, parameters.background, patch)
            start(cluster, max(parameters.background[0], 1.0))
        gain = _highest(problem, parameters, cluster, known, h, touching.scatters)
        if math.isnan(gain):
            return math.nan if known.nearby.e.size > 0 else -math.inf
        if np.any(touching.faint[group.members]):
            noise = given(problem.frame.noise, parameters)
            rows = 0, patch.first.size
            weigh_patch(problem.frame, noise, parameters.background, patch, rows, patch.ratio)
            pixels = Pixels(patch.weight, patch.ratio, at)
            value += expand(touching, group, fluxes, shape, pixels)[0]
        value += gain + log_prior(cluster) - _half_log_determinant(cluster, h)
        add_patch(patch, w.image)
    return value
