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

from bayesfred.imaging.kernels.compilation import inner, shared
from bayesfred.imaging.kernels.contexts import Canvas
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.imaging.kernels.geometry import move
from bayesfred.model.kernels.clusters import (
    DOF,
    SHARE,
    Prior,
    add_block,
    add_prior,
    add_template,
    bend_prior,
    cholesky,
    copy,
    gram,
    one_cluster,
    project,
    shift_prior,
    solve,
)
from bayesfred.model.kernels.expansion import Pixels, expand
from bayesfred.model.kernels.flux_newton import (
    Cluster,
    make_templates,
    maximize_fluxes,
    start,
)
from bayesfred.model.kernels.likelihood import slope_run, stretch
from bayesfred.model.kernels.noise_dispatch import exact_weight, given, sum_pixels
from bayesfred.model.kernels.patches import add_patch, fill_excess, new_patch, weigh_patch
from bayesfred.model.kernels.shift_modes import other_mode

LONGEST = 8.0  # Newton steps in one
CLOSE = 1e-16  # square of the distance from the maximum, in standard deviations
TRIES = 4  # other modes that are looked at in a cluster
TIE = -2.0  # in log-density: another mode that is predicted to be this much lower is looked at


@inner()
def _fill_gradient(cluster, out):
    """The gradient of log L + log p in a cluster's fluxes and shifts."""
    fp, stamps, members = cluster.layout.footprints, cluster.touching.stamps, cluster.group.members
    size = stamps.shape[0]
    for i in range(out.size):
        s, t = members[i // size], i % size
        out[i] = project(fp, s, stamps[t], cluster.patch.score, cluster.canvas.at)
        if t == 0:
            out[i] += cluster.prior.shape / cluster.fluxes[s] - 1.0 / cluster.scale[s]
        else:
            _, weight = shift_prior(cluster.shifts[s], cluster.prior.scatter)
            out[i] -= weight * cluster.shifts[s, t - 1]


@inner()
def _relative(cluster, step, i):
    """The largest relative change that a step makes in the flux and shift of source i."""
    size, flux = cluster.touching.stamps.shape[0], cluster.fluxes[cluster.group.members[i]]
    largest = abs(step[i * size]) / flux
    for k in range(i * size + 1, (i + 1) * size):
        largest = max(largest, abs(step[k]) / cluster.layout.sigma)
    return largest


@inner()
def _change(cluster, s, flux, dx, dy):
    """Change a source's flux and shift."""
    fp, stamps, fluxes = cluster.layout.footprints, cluster.touching.stamps, cluster.fluxes
    rows = fp.first[s], fp.first[s + 1]
    add_template(fp, rows, stamps[0], -fluxes[s], cluster.canvas)
    fluxes[s] += flux
    cluster.shifts[s, 0] += dx
    cluster.shifts[s, 1] += dy
    move(cluster.layout.optics, cluster.layout.geometry, s, dx, dy)
    make_templates(cluster, s, fluxes[s])
    add_template(fp, rows, stamps[0], fluxes[s], cluster.canvas)


@inner()
def _take_step(cluster, step, shares, together):
    """Move by at most these shares of a Newton step, or by the smallest; leave them in `shares`.

    Returns the largest relative change of the whole step.
    """
    fp, stamps, members = cluster.layout.footprints, cluster.touching.stamps, cluster.group.members
    fluxes, size, most, least = cluster.fluxes, cluster.touching.stamps.shape[0], 0.0, math.inf
    for i in range(members.size):
        largest = _relative(cluster, step, i)
        most = max(most, largest)
        if shares[i] * largest >= 0.5:
            shares[i] = min(shares[i], 1.0 / (1.0 + largest))
        least = min(least, shares[i])
    if together:
        shares[:] = least
    for i in range(members.size):
        s, own = members[i], shares[i] * step[i * size : (i + 1) * size]
        if size > 1:
            _change(cluster, s, own[0], own[1], own[2])
        else:
            fluxes[s] += own[0]
            add_template(fp, (fp.first[s], fp.first[s + 1]), stamps[0], own[0], cluster.canvas)
    return most


@inner(fastmath=REDUCE)
def _subtract_second_derivatives(cluster, i, out):
    """Subtract from a source's block of H the second derivatives times the score.

    K_xx = X^2/K - K/sigma^2, K_xy = X Y/K are a Gaussian's that no pixel blurs: near enough to make
    the steps that H gives converge several times faster, for any PSF where it falls no faster than
    a Gaussian does within eight widths. The prior's second derivatives are exact.
    """
    fp, stamps, sigma = cluster.layout.footprints, cluster.touching.stamps, cluster.layout.sigma
    score, at, s = cluster.patch.score, cluster.canvas.at, cluster.group.members[i]
    flux = cluster.fluxes[s]
    fx, fy = 0.0, 0.0
    xx, xy, yy = bend_prior(cluster.shifts[s], cluster.prior.scatter)
    for p in range(fp.first[s], fp.first[s + 1]):
        first = fp.start[p]
        for k in range(fp.size[p]):
            own, x, y = stamps[0, first + k] * flux, stamps[1, first + k], stamps[2, first + k]
            near = own > 1e-200 and x * x + y * y < (8.0 * own / sigma) ** 2
            r = -score[at[p] + k] if near else 0.0
            inverse = 1.0 / max(own, 1e-200)
            fx += r * x
            fy += r * y
            xx += r * (x * x * inverse - own / (sigma * sigma))
            xy += r * x * y * inverse
            yy += r * (y * y * inverse - own / (sigma * sigma))
    add_block(i, cluster.group.start, out, (fx / flux, fy / flux, xx, xy, yy))


@inner()
def _factor(cluster, h, lower):
    """Cholesky's factor of H, less the second derivatives where that is possible, in `lower`."""
    if cluster.touching.stamps.shape[0] > 1:
        copy(h, lower)
        for i in range(cluster.group.members.size):
            _subtract_second_derivatives(cluster, i, lower)
        if cholesky(lower, cluster.group):
            return True
        copy(h, lower)  # far from the maximum
    return cholesky(lower, cluster.group)


@inner()
def _secant(gradient, step, distances, shares, most):
    """The shares of the next step, given the last one and the gradient where it led.

    Where the weights are not the second derivatives a step goes too far, or not far enough. Two of
    them tell which share of it ends where the gradient along it vanishes, for every source.
    """
    size = step.size // shares.size
    for i in range(shares.size):
        if distances[i] > 0.0:
            own = slice(i * size, (i + 1) * size)
            left = np.dot(gradient[own], step[own]) / distances[i]
            shares[i] = min(most, shares[i] / max(1.0 - left, 0.1))


@inner()
def _maximize(frame, parameters, cluster, h):
    """Newton's iteration for a cluster; leaves Cholesky's factor of H in h. False if it fails."""
    touching, group, patch, at = cluster.touching, cluster.group, cluster.patch, cluster.canvas.at
    if touching.stamps.shape[0] == 1 and exact_weight(given(frame.noise, parameters)):
        return maximize_fluxes(frame, parameters, cluster, h)
    size, noise = touching.stamps.shape[0], given(frame.noise, parameters)
    exact = exact_weight(noise)
    step, lower = np.zeros(group.lead.size), h.copy() if size > 1 else h
    distance, rate, converged = 0.0, 1.0, False
    shares, distances = np.ones(group.members.size), np.zeros(group.members.size)
    gradient = np.empty(step.size)
    for _ in range(100):
        weigh_patch(frame, noise, parameters.background, patch, (0, patch.first.size), None)
        fresh = converged or rate > 0.01  # otherwise the last matrix serves
        if fresh:
            gram(touching, group, patch.weight, at, h)
            add_prior(h, group, cluster.prior, cluster.fluxes, cluster.shifts, SHARE)
        if converged:
            return cholesky(h, group)
        _fill_gradient(cluster, gradient)
        if fresh and not _factor(cluster, h, lower):
            return False
        if not exact:
            _secant(gradient, step, distances, shares, LONGEST if size == 1 else 1.0)
        copy(gradient, step)
        solve(lower, group, step)
        # The square of the distance in standard deviations, and what a step leaves of it: in a
        # Newton step of fluxes alone the square of the largest relative change.
        before, distance = distance, np.dot(gradient, step)
        if fresh and distance <= CLOSE:
            return size == 1 or cholesky(h, group)
        for i in range(shares.size):
            own = slice(i * size, (i + 1) * size)
            distances[i] = np.dot(gradient[own], step[own])
        if exact:
            shares[:] = 1.0
        largest = _take_step(cluster, step, shares, exact)
        rate = distance / before if before > 0.0 else 1.0
        if fresh and size == 1 and exact:
            rate = largest * largest
        converged = distance * min(rate, 1.0) <= CLOSE
    return False


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
def _log_density(frame, parameters, cluster, h):
    """What the log-density of a cluster's mode and its width say, up to constants."""
    patch, noise, value = cluster.patch, given(frame.noise, parameters), 0.0
    for j in range(patch.first.size):
        a, b, first = patch.start[j], patch.start[j + 1], patch.first[j]
        image = patch.image[a:b]
        part = stretch(frame, parameters.background, patch.top + j, first, image)
        slope_run(part, patch.score[a:b])
        mean = (patch.score[a:b], part.c0, None)
        value += sum_pixels(noise, part.values, image, mean, first)
    return value + _log_prior(cluster, h)


@inner()
def _log_prior(cluster, h):
    """Of a cluster's fluxes and shifts, less half the logarithm of H's determinant."""
    prior, start, value = cluster.prior, cluster.group.start, 0.0
    constant = 0.5 * math.log(2.0 * math.pi) - math.lgamma(prior.shape)
    for i in range(start.size):
        value -= math.log(h[start[i] + i])
    for s in cluster.group.members:
        scale, flux = cluster.scale[s], cluster.fluxes[s]
        value += (prior.shape - 1.0) * math.log(flux / scale) - flux / scale
        value += constant - math.log(scale)
        if prior.scatter > 0.0:
            ratio, _ = shift_prior(cluster.shifts[s], prior.scatter)
            value -= (0.5 * DOF + 1.0) * math.log1p(ratio) + 2.0 * math.log(prior.scatter)
    return value


@inner()
def _climb(frame, parameters, cluster, h):
    """The same for the highest mode: a shift may have two, see `shift_modes.py`."""
    found = _maximize(frame, parameters, cluster, h)
    if not found or cluster.touching.stamps.shape[0] == 1:
        return found
    members, fluxes, shifts = cluster.group.members, cluster.fluxes, cluster.shifts
    gains, ratios = np.empty(members.size), np.empty(members.size)
    for i in range(members.size):
        known, shift = _known(cluster, members[i]), math.sqrt(np.sum(shifts[members[i]] ** 2))
        gains[i], ratios[i] = other_mode(shift, known, cluster.prior.scatter, cluster.layout.sigma)
    value, factor = math.nan, np.empty(0)
    for _ in range(TRIES):
        i = gains.argmax()
        if gains[i] < TIE:
            break
        if factor.size == 0:
            value, factor = _log_density(frame, parameters, cluster, h), np.empty(h.size)
        gains[i] = -math.inf
        old_fluxes, old_shifts = fluxes[members], shifts[members]
        dx, dy = (ratios[i] - 1.0) * old_shifts[i]
        _change(cluster, members[i], 0.0, dx, dy)
        if _maximize(frame, parameters, cluster, factor):
            there = _log_density(frame, parameters, cluster, factor)
            if there > value:
                value = there
                copy(factor, h)
                continue
        for j in range(members.size):
            s = members[j]
            back_x, back_y = old_shifts[j] - shifts[s]
            _change(cluster, s, old_fluxes[j] - fluxes[s], back_x, back_y)
    return True


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
def profile(problem, layout, w, parameters, profiled, fluxes):
    """Fill the fluxes and `profiled` with their maximum; add the sources to the image.

    Returns what the integral over them adds to the log-likelihood, or -inf without a maximum.
    With three templates the shifts are free, and `layout` is left with the shifted sources.
    """
    touching, factors, shifts = profiled.touching, profiled.factors, profiled.shifts
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
        if problem.start.size > 0:
            _resume(cluster, problem.start)
        else:
            fill_excess(problem.frame, parameters.background, patch)
            start(cluster, max(parameters.background[0], 1.0))
        if not _climb(problem.frame, parameters, cluster, h):
            return -math.inf
        if np.any(touching.faint[group.members]):
            noise = given(problem.frame.noise, parameters)
            rows = 0, patch.first.size
            weigh_patch(problem.frame, noise, parameters.background, patch, rows, patch.ratio)
            pixels = Pixels(patch.weight, patch.ratio, at)
            value += expand(touching, group, fluxes, shape, pixels)[0]
        value += _log_prior(cluster, h)
        add_patch(patch, w.image)
    return value
