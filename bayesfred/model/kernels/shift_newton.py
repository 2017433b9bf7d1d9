"""Fluxes and shifts of a cluster at their maximum, see `fluxes.py`.

Newton's iteration, with H less the second derivatives where that is positive definite.

Far from the maximum the steps of blended sources go too far, again and again. So after some visits
a step is halved until log L + log p(log F) is not lower than before: it is a direction uphill, as
its matrix is positive definite.

Where one of two maxima of a shift is about to end the log-density is so flat that steps crawl, and
after some more visits a place near enough will do: log p is off by some 0.01.

Nearby. Where e and G - H of `gradient.py` are known from other parameters nearby the search ends
early. Let g be the gradient and d the step that is left. Then at the maximum log L + log p is
higher by 1/2 g d, and -1/2 log det H by e d. Of d a step leaves the share sqrt(rate), by which
1/2 g d errs; e d errs by the share `VAGUE`.
"""

import math

import numpy as np

from bayesfred.imaging.kernels.compilation import inner, leaf
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE
from bayesfred.imaging.kernels.geometry import move
from bayesfred.model.kernels.clusters import (
    DOF,
    SHARE,
    add_block,
    add_prior,
    add_template,
    bend_prior,
    copy,
    gram,
    project,
    shift_prior,
)
from bayesfred.model.kernels.factors import cholesky, solve
from bayesfred.model.kernels.flux_newton import make_templates
from bayesfred.model.kernels.likelihood import slope_run, stretch
from bayesfred.model.kernels.noise_dispatch import exact_weight, given, sum_pixels
from bayesfred.model.kernels.patches import weigh_patch

# Shifts, in widths of the PSF, that change templates to first order: log det H changes by as much,
# or less, with every source.
STILL = 1e-8
STILL_EARLY = 3e-6  # where the search ends early
LONGEST = 8.0  # Newton steps in one
CLOSE = 1e-16  # square of a distance from the maximum, in standard deviations, for every source
VAGUE = 0.2  # of a change of log det H, since e depends on the parameters
PATIENT, HALVES = 10, 8  # visits before steps are only taken uphill; how often one is halved
CERTAIN = 0.01  # square of the distance from which on they are anyway
ENDLESS, FLAT = 60, 1e-3  # visits after which so small a square of the distance will do
AS_ONE = 100  # visits after which all sources take the same share of a step, uphill
MOST_VISITS = 200  # of all pixels in a search
VISITS = 8  # after which one does not end early
ENOUGH = 3e-6  # error of the log-likelihood for every source, with which a search ends early


@inner()
def fill_gradient(cluster, out):
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


@leaf(fastmath=FAST)
def _bent(own, x, y, sigma):
    """F times K_xx, K_xy and K_yy from F times K, X and Y.

    They are those of a Gaussian that no pixel blurs, X^2/K - K/sigma^2 and X Y/K: near enough for
    any PSF where it falls no faster than a Gaussian does within eight widths, elsewhere zero.
    """
    near = own > 1e-200 and x * x + y * y < (8.0 * own / sigma) ** 2
    inverse, width = (1.0 / max(own, 1e-200), own / (sigma * sigma)) if near else (0.0, 0.0)
    return x * x * inverse - width, x * y * inverse, y * y * inverse - width


@leaf(fastmath=FAST)
def _follow(cluster, s, flux, dx, dy):
    """Change the templates of source s to first order in its shift."""
    fp, stamps, sigma = cluster.layout.footprints, cluster.touching.stamps, cluster.layout.sigma
    before, after = cluster.fluxes[s], 1.0 + flux / cluster.fluxes[s]
    for i in range(fp.start[fp.first[s]], fp.start[fp.first[s + 1]]):
        x, y = stamps[1, i], stamps[2, i]
        xx, xy, yy = _bent(before * stamps[0, i], x, y, sigma)
        stamps[0, i] += (x * dx + y * dy) / before
        stamps[1, i] = after * (x + xx * dx + xy * dy)
        stamps[2, i] = after * (y + xy * dx + yy * dy)


@inner()
def change_source(cluster, s, flux, dx, dy, still):
    """Change a source's flux and shift; one of less than `still` makes no new templates."""
    fp, stamps, fluxes = cluster.layout.footprints, cluster.touching.stamps, cluster.fluxes
    rows = fp.first[s], fp.first[s + 1]
    add_template(fp, rows, stamps[0], -fluxes[s], cluster.canvas)
    cluster.shifts[s, 0] += dx
    cluster.shifts[s, 1] += dy
    move(cluster.layout.optics, cluster.layout.geometry, s, dx, dy)
    if max(abs(dx), abs(dy)) < still * cluster.layout.sigma:
        _follow(cluster, s, flux, dx, dy)
        fluxes[s] += flux
    else:
        fluxes[s] += flux
        make_templates(cluster, s, fluxes[s])
    add_template(fp, rows, stamps[0], fluxes[s], cluster.canvas)


@inner()
def take_step(cluster, step, shares, together, still):
    """Move by at most these shares of a Newton step, or by the smallest; leave them in `shares`."""
    fp, stamps, members = cluster.layout.footprints, cluster.touching.stamps, cluster.group.members
    fluxes, size, least = cluster.fluxes, cluster.touching.stamps.shape[0], math.inf
    for i in range(members.size):
        largest = _relative(cluster, step, i)
        if shares[i] * largest >= 0.5:
            shares[i] = min(shares[i], 1.0 / (1.0 + largest))
        least = min(least, shares[i])
    if together:
        shares[:] = least
    for i in range(members.size):
        s, own = members[i], shares[i] * step[i * size : (i + 1) * size]
        if size > 1:
            change_source(cluster, s, own[0], own[1], own[2], still)
        else:
            fluxes[s] += own[0]
            add_template(fp, (fp.first[s], fp.first[s + 1]), stamps[0], own[0], cluster.canvas)


@inner(fastmath=REDUCE)
def _subtract_second_derivatives(cluster, i, out):
    """Subtract from a source's block of H the second derivatives times the score.

    With them the steps that H gives converge several times faster.
    """
    fp, stamps, sigma = cluster.layout.footprints, cluster.touching.stamps, cluster.layout.sigma
    score, at, s = cluster.patch.score, cluster.canvas.at, cluster.group.members[i]
    flux = cluster.fluxes[s]
    fx, fy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(fp.first[s], fp.first[s + 1]):
        first = fp.start[p]
        for k in range(fp.size[p]):
            own, x, y = stamps[0, first + k] * flux, stamps[1, first + k], stamps[2, first + k]
            r, bent = -score[at[p] + k], _bent(own, x, y, sigma)
            fx += r * x
            fy += r * y
            xx += r * bent[0]
            xy += r * bent[1]
            yy += r * bent[2]
    add_block(i, cluster.group.start, out, (0.0, fx / flux, fy / flux, xx, xy, yy))


@inner()
def curve(cluster, bends, h, out):
    """Fill H less the second derivatives."""
    copy(h, out)
    start, members = cluster.group.start, cluster.group.members
    for i in range(members.size):
        if bends.size > 0:
            add_block(i, start, out, bends[members[i]])
        else:
            _subtract_second_derivatives(cluster, i, out)
        xx, xy, yy = bend_prior(cluster.shifts[members[i]], cluster.prior.scatter)
        add_block(i, start, out, (0.0, 0.0, 0.0, xx, xy, yy))


@inner()
def _factor(cluster, bends, h, lower):
    """Cholesky's factor of H, less the second derivatives where that is possible, in `lower`."""
    if cluster.touching.stamps.shape[0] > 1:
        curve(cluster, bends, h, lower)
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
def log_prior(cluster):
    """The log-density of the logarithms of a cluster's fluxes, and of its shifts."""
    prior, value = cluster.prior, 0.0
    constant = 0.5 * math.log(2.0 * math.pi) - math.lgamma(prior.shape)
    for s in cluster.group.members:
        ratio = cluster.fluxes[s] / cluster.scale[s]
        value += constant + prior.shape * math.log(ratio) - ratio
        if prior.scatter > 0.0:
            far, _ = shift_prior(cluster.shifts[s], prior.scatter)
            value -= (0.5 * DOF + 1.0) * math.log1p(far) + 2.0 * math.log(prior.scatter)
    return value


@inner()
def _sum_run(frame, noise, background, patch, place):
    """Log L of pixels [a, b) of a patch, which are in row j of it."""
    j, a, b = place
    image, first = patch.image[a:b], patch.first[j] + a - patch.start[j]
    part = stretch(frame, background, patch.top + j, first, image)
    slope_run(part, patch.score[a:b])
    return sum_pixels(noise, part.values, image, (patch.score[a:b], part.row[0], None), first)


@inner()
def log_density(frame, parameters, cluster):
    """Log L + log p of a cluster's fluxes and shifts, up to constants.

    Of one source in its own pixels.
    """
    patch, noise, value = cluster.patch, given(frame.noise, parameters), log_prior(cluster)
    fp, members, at = cluster.layout.footprints, cluster.group.members, cluster.canvas.at
    if members.size == 1:
        for p in range(fp.first[members[0]], fp.first[members[0] + 1]):
            place = fp.row[p] - patch.top, at[p], at[p] + fp.size[p]
            value += _sum_run(frame, noise, parameters.background, patch, place)
    else:
        for j in range(patch.first.size):
            place = j, patch.start[j], patch.start[j + 1]
            value += _sum_run(frame, noise, parameters.background, patch, place)
    return value


@inner()
def _walk(cluster, way, factor):
    """Take so many times the shares of a step, of every source."""
    step, shares = way
    for i in range(shares.size):
        own = factor * shares[i] * step[3 * i : 3 * i + 3]
        change_source(cluster, cluster.group.members[i], own[0], own[1], own[2], 0.0)


@inner()
def turn_back(frame, parameters, cluster, way, value):
    """Go back by half a step, and half of that, until the log-density is not lower than `value`.

    Blended sources far from their maximum may go too far again and again. `way` is the step and
    what share of it was taken. Returns the log-density.
    """
    _, shares = way
    for _ in range(HALVES):
        here = log_density(frame, parameters, cluster)
        if here >= value:
            break
        shares *= 0.5
        _walk(cluster, way, -1.0)
    return here


@inner()
def go_on(frame, parameters, cluster, way, value):
    """Go as far again as the step led, and twice as far, as long as the log-density rises.

    Where the second derivatives are left out steps may be far too short. `way` is the step and what
    share of it was taken. Returns the log-density.
    """
    step, shares = way
    for _ in range(HALVES):
        for i in range(shares.size):
            if shares[i] * _relative(cluster, step, i) >= 0.5:
                return value
        _walk(cluster, way, 1.0)
        here = log_density(frame, parameters, cluster)
        if here <= value:
            _walk(cluster, way, -1.0)
            return value
        value = here
        shares *= 2.0
    return value


@inner()
def _change_of_width(cluster, nearby, shares, step):
    """By how much -1/2 log det H changes on the rest of the way, see `gradient.py`."""
    total, scatter = 0.0, cluster.prior.scatter
    for i in range(shares.size):
        s, change = cluster.group.members[i], shares[i] * step[3 * i : 3 * i + 3]
        shift, (ratio, k) = cluster.shifts[s], shift_prior(cluster.shifts[s], scatter)
        by = nearby.spread[s] * SHARE * k / (DOF * scatter**2 * (1.0 + ratio))
        total += nearby.e[s, 0] * change[0]
        total += (nearby.e[s, 1] + by * shift[0]) * change[1]
        total += (nearby.e[s, 2] + by * shift[1]) * change[2]
    return total


@leaf()
def _count_left(distances):
    """How many sources are not at their maximum yet."""
    left = 0
    for distance in distances:
        left += distance > CLOSE
    return left


@inner()
def search(frame, parameters, cluster, known, h, left):
    """Newton's iteration for a cluster; leaves Cholesky's factor of H in h.

    Returns what the rest of the way to the maximum gains, which is nothing unless e is known; NaN
    if it fails; infinity where no more sources are left than the second of `left`. Into the first
    go the squares of the sources' distances.
    """
    touching, group, patch, at = cluster.touching, cluster.group, cluster.patch, cluster.canvas.at
    size, noise = touching.stamps.shape[0], given(frame.noise, parameters)
    exact, early = exact_weight(noise), known.nearby.e.size > 0
    close, enough = CLOSE * group.members.size, ENOUGH * group.members.size
    step, lower = np.zeros(group.lead.size), h.copy() if size > 1 else h
    distance, rate, converged = 0.0, 1.0, False
    shares, gradient = np.ones(group.members.size), np.empty(step.size)
    distances, few = left
    distances[:] = 0.0
    value = -math.inf
    for visit in range(VISITS if early else MOST_VISITS):
        weigh_patch(frame, noise, parameters.background, patch, (0, patch.first.size), None)
        fresh = converged or rate > 0.01  # otherwise the last matrix serves
        if fresh:
            gram(touching, group, patch.weight, at, h)
            add_prior(h, group, cluster.prior, cluster.fluxes, cluster.shifts, SHARE)
        if converged and not early:
            return 0.0 if cholesky(h, group) else math.nan
        fill_gradient(cluster, gradient)
        if fresh and not converged and not _factor(cluster, known.nearby.bends, h, lower):
            return math.nan
        if not exact:
            _secant(gradient, step, distances, shares, LONGEST if size == 1 else 1.0)
        copy(gradient, step)
        solve(lower, group, step)
        # the square of the distance in standard deviations, and what a step leaves of it
        before, distance = distance, np.dot(gradient, step)
        rate = distance / before if before > 0.0 else 1.0
        if fresh and distance <= close:
            return 0.0 if size == 1 or cholesky(h, group) else math.nan
        for i in range(shares.size):
            own = slice(i * size, (i + 1) * size)
            distances[i] = np.dot(gradient[own], step[own])
        # shares of single sources may make a step that leads downhill; a common one never does
        if exact or visit >= AS_ONE or np.dot(shares, distances) <= 0.0:
            shares[:] = 1.0
        if early and fresh:
            width = _change_of_width(cluster, known.nearby, shares, step)
            error = 0.5 * distance * math.sqrt(min(rate, 1.0)) + VAGUE * abs(width)
            if error <= enough:
                gain = 0.5 * np.dot(shares, distances) + width
                return gain if cholesky(h, group) else math.nan
        if 0 < _count_left(distances) <= few:
            return math.inf
        # templates follow by second derivatives that are right only about: steps must get shorter
        still = 0.0 if rate > 0.1 else (STILL_EARLY if early else STILL)
        take_step(cluster, step, shares, exact, still)
        if visit >= PATIENT and size > 1 and distance > (CERTAIN if visit < AS_ONE else FLAT):
            way = step, shares
            value = turn_back(frame, parameters, cluster, way, value)
            if visit >= ENDLESS:
                value = go_on(frame, parameters, cluster, way, value)
        if visit > ENDLESS and size > 1 and distance <= FLAT:
            return 0.0 if cholesky(h, group) else math.nan
        rest = distance * min(rate, 1.0)
        converged = rest <= close or (early and 0.5 * rest * math.sqrt(rate) <= enough)
    return math.nan
