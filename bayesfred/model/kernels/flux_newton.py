"""Fluxes of a cluster at their maximum, where nothing else is free of every source.

Symbols are those of `fluxes.py`. The pixels of a cluster are visited as seldom as the result needs:

- To begin with, pairs of sources are looked at in some of the rows that they share. A step needs no
  more: H errs by a small part of its elements off the diagonal. Pairs that hardly overlap are then
  left out for good: the square of their correlation is below the rounding of log det H.
- A Newton step d is followed by H^-1 T d^2 / 2 (Chebyshev's method), where T has the third
  derivatives of a source alone, 2 sum_p C K^3 + 2 a/F^3. They are sums over some of its rows, too.
  Of a relative change L it leaves the part L^2, and some percent of L.
- H changes by the factor 1 - 2 beta d/F along a source's own flux, beta = (sum_p C K^3 + a/F^3) F /
  H_ss. So H becomes D H D with D = 1 - beta d/F, near enough for further steps without another H.
- At the end H is needed in full. The step that it gives, of 1e-7 or less, is taken as well, and
  changes H as before.

Where that does not converge, Newton's steps with H in full do, see `fluxes.py`.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import inner, leaf
from bayesfred.imaging.kernels.contexts import Canvas, Layout
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.imaging.kernels.render import add_source, add_templates
from bayesfred.model.kernels.clusters import Prior, shared_rows, touch
from bayesfred.model.kernels.contexts import Group, Touching
from bayesfred.model.kernels.factors import cholesky, solve
from bayesfred.model.kernels.likelihood import U
from bayesfred.model.kernels.noise_dispatch import given
from bayesfred.model.kernels.patches import Patch, weigh_patch

BAND = 64  # rows that are visited at a time: their templates stay in the caches
ROWS = 8  # of those that two sources share, which a first look at their overlap visits
FAR = 1e-5  # overlap of two sources, as a correlation, whose square is lost in rounding
PROJECT, ROUGH, FULL = 0, 1, 2  # kinds of visits
LONG = 0.1  # relative change of a flux after which H is made again
LAST = 1e-7  # ... that the last step makes at most
LAG = 0.1  # share of a relative change that Chebyshev's step, and D H D, leave of it
PLAIN = 8  # steps after which they are plain Newton steps


class Cluster(NamedTuple):
    """One cluster's sources, whose fluxes and shifts are looked for."""

    layout: Layout
    touching: Touching
    group: Group
    patch: Patch
    canvas: Canvas  # the patch's image
    fluxes: Floats
    shifts: Floats
    prior: Prior
    scale: Floats  # of the fluxes' Gamma prior, the catalogue's flux over the shape


@leaf()
def make_templates(cluster, s, flux):
    """Fill the templates of source s."""
    stamps, fp = cluster.touching.stamps, cluster.layout.footprints
    first, last = fp.first[s], fp.first[s + 1]
    stamps[:, fp.start[first] : fp.start[last]] = 0.0
    if stamps.shape[0] > 1:
        _add_three(cluster.layout, s, flux, stamps, cluster.touching.scatters)
    else:
        canvas = Canvas(stamps[0], fp.start)
        add_source(cluster.layout, s, (first, last), 1.0, canvas, None)


@leaf()
def _add_three(layout, s, flux, stamps, scatters):
    if scatters is not None:
        add_templates(layout, s, flux, stamps, None)


@inner()
def _correct(cluster, lower, slopes, step):
    """Add Chebyshev's correction to a Newton step."""
    group, fluxes = cluster.group, cluster.fluxes
    lead, start, more = group.lead, group.start, np.empty(step.size)
    for i in range(step.size):
        own = 0.0
        for k in range(start[i] + lead[i], start[i] + i + 1):
            own += lower[k] * lower[k]
        more[i] = own * slopes[i] * step[i] * step[i] / fluxes[group.members[i]]
    solve(lower, group, more)
    for i in range(step.size):
        step[i] += more[i]


@leaf()
def _scale(cluster, lower, slopes, step):
    """Make Cholesky's factor of H that of D H D, before the step is taken."""
    group = cluster.group
    for i in range(step.size):
        factor = 1.0 - slopes[i] * step[i] / cluster.fluxes[group.members[i]]
        for k in range(group.start[i] + group.lead[i], group.start[i] + i + 1):
            lower[k] *= factor


@leaf()
def _rows(cluster, s, band):
    """Which of the footprints' rows are those of source s in a band of rows of the frame."""
    fp, box = cluster.layout.footprints, cluster.touching.boxes[s]
    begin, end = max(band[0], box[0]), min(band[1], box[1])
    return fp.first[s] + begin - box[0], fp.first[s] + max(end, begin) - box[0]


@leaf()
def _add_step(cluster, rows, step):
    """Add a step of a source's flux to rows of the image."""
    fp, stamp, at = cluster.layout.footprints, cluster.touching.stamps[0], cluster.canvas.at
    image, starts, sizes = cluster.canvas.image, fp.start, fp.size
    for p in range(rows[0], rows[1]):
        i, j = U(starts[p]), U(at[p])
        for k in range(U(sizes[p])):
            image[j + k] += step * stamp[i + k]


@leaf(fastmath=REDUCE)
def _project(cluster, rows):
    """The sum of K times the score over rows of a source."""
    fp, stamp, at = cluster.layout.footprints, cluster.touching.stamps[0], cluster.canvas.at
    score, starts, sizes, total = cluster.patch.score, fp.start, fp.size, 0.0
    for p in range(rows[0], rows[1]):
        i, j = U(starts[p]), U(at[p])
        for k in range(U(sizes[p])):
            total += stamp[i + k] * score[j + k]
    return total


@leaf(fastmath=REDUCE)
def _moments(cluster, rows):
    """Sums of K times the score, of W K^2 and of C K^3 over rows of a source."""
    fp, stamp, at = cluster.layout.footprints, cluster.touching.stamps[0], cluster.canvas.at
    score, weight, ratio = cluster.patch.score, cluster.patch.weight, cluster.patch.ratio
    starts, sizes, slope, square, cube = fp.start, fp.size, 0.0, 0.0, 0.0
    for p in range(rows[0], rows[1]):
        i, j = U(starts[p]), U(at[p])
        for k in range(U(sizes[p])):
            own = stamp[i + k]
            part = weight[j + k] * own * own
            slope += own * score[j + k]
            square += part
            cube += part * ratio[j + k] * own
    return slope, square, cube


@leaf(fastmath=REDUCE)
def _product(cluster, pair, rows):
    """The sum of W K_s K_t over rows first, first + step, ... of the frame, up to but for last."""
    fp, boxes, stamp = cluster.layout.footprints, cluster.touching.boxes, cluster.touching.stamps[0]
    weight, at = cluster.patch.weight, cluster.canvas.at
    lows, sizes, starts = fp.low, fp.size, fp.start
    (s, t), total = pair, 0.0
    for row in range(rows[0], rows[1], rows[2]):
        p, q = fp.first[s] + row - boxes[s, 0], fp.first[t] + row - boxes[t, 0]
        a = max(lows[p], lows[q])
        n = min(lows[p] + sizes[p], lows[q] + sizes[q]) - a
        if n > 0:
            i, m, j = starts[p] + a - lows[p], starts[q] + a - lows[q], at[p] + a - lows[p]
            i, m, j = U(i), U(m), U(j)
            for k in range(U(n)):
                total += stamp[i + k] * stamp[m + k] * weight[j + k]
    return total


@leaf()
def _add_pairs(cluster, near, band, h):
    """Add what a band gives to the elements of H off the diagonal, of pairs that are near."""
    touching, group = cluster.touching, cluster.group
    for i in range(group.members.size):
        s = group.members[i]
        for k in range(group.lead[i], i):
            place = group.start[i] + k
            if near[place]:
                first, last = shared_rows(touching, s, group.members[k])
                rows = max(first, band[0]), min(last, band[1]), 1
                h[place] += _product(cluster, (s, group.members[k]), rows)


@leaf()
def _look(cluster, near, sums, h):
    """Estimate the elements of H off the diagonal, and find out which pairs are near."""
    touching, group = cluster.touching, cluster.group
    for i in range(group.members.size):
        s = group.members[i]
        for k in range(group.lead[i], i):
            place, pair = group.start[i] + k, (s, group.members[k])
            h[place], near[place] = 0.0, False
            if touch(touching.boxes, s, group.members[k]):
                first, last = shared_rows(touching, s, group.members[k])
                step = max((last - first) // ROWS, 1)
                rows = first + step // 2, last, step
                h[place] = step * _product(cluster, pair, rows)
                near[place] = h[place] ** 2 > FAR**2 * sums[i, 1] * sums[k, 1]


@inner()
def _visit(frame, parameters, cluster, step, kind, pairs):
    """Take a step in the image, and return the sums of `_moments` over every source's pixels.

    `kind` is PROJECT for the first of these alone, ROUGH for all and a look at the pairs, or FULL
    for all and `pairs`, which says which of them are near and has H.
    """
    group, patch, noise = cluster.group, cluster.patch, given(frame.noise, parameters)
    sums, rows, (near, h) = np.zeros((step.size, 3)), patch.first.size, pairs
    if kind == FULL:
        h[:] = 0.0
    for first in range(0, rows, BAND):
        last = min(first + BAND, rows)
        band = patch.top + first, patch.top + last
        for i in range(step.size):
            if step[i] != 0.0:
                s = group.members[i]
                _add_step(cluster, _rows(cluster, s, band), step[i])
        ratio = None if kind == PROJECT else patch.ratio
        weigh_patch(frame, noise, parameters.background, patch, (first, last), ratio)
        for i in range(step.size):
            s = group.members[i]
            if kind == PROJECT:
                sums[i, 0] += _project(cluster, _rows(cluster, s, band))
            else:
                slope, square, cube = _moments(cluster, _rows(cluster, s, band))
                sums[i, 0] += slope
                sums[i, 1] += square
                sums[i, 2] += cube
        if kind == FULL:
            _add_pairs(cluster, near, band, h)
    if kind == ROUGH:
        _look(cluster, near, sums, h)
    return sums


@leaf()
def _newton_step(cluster, sums, slopes, fresh, h, step):
    """Fill a Newton step; if `fresh`, H's diagonal from the sums, then its factor, and beta."""
    group, fluxes, prior = cluster.group, cluster.fluxes, cluster.prior
    for i in range(step.size):
        s = group.members[i]
        flux = fluxes[s]
        step[i] = sums[i, 0] + prior.shape / flux - 1.0 / cluster.scale[s]
        if fresh:
            own = sums[i, 1] + prior.shape / flux**2
            h[group.start[i] + i] = own
            slopes[i] = (sums[i, 2] * flux + prior.shape / flux**2) / own
    if fresh and not cholesky(h, group):
        return False
    solve(h, group, step)
    return True


@leaf()
def _largest(cluster, step):
    """The largest relative change that a step makes."""
    largest = 0.0
    for i in range(step.size):
        largest = max(largest, abs(step[i]) / cluster.fluxes[cluster.group.members[i]])
    return largest


@inner()
def maximize_fluxes(frame, parameters, cluster, h):
    """Find a cluster's fluxes; leaves Cholesky's factor of H in h. False if it fails."""
    members = cluster.group.members
    step, slopes, near = np.zeros(members.size), np.empty(members.size), np.empty(h.size, np.bool_)
    whole, since, before = False, np.inf, np.inf
    for visit in range(100):
        plain = visit >= PLAIN
        kind = FULL if whole or plain else (PROJECT if since <= LONG else ROUGH)
        sums = _visit(frame, parameters, cluster, step, kind, (near, h))
        if not _newton_step(cluster, sums, slopes, kind != PROJECT, h, step):
            if kind == FULL:
                return False
            step[:] = 0.0
            whole = True
            continue
        largest = _largest(cluster, step)
        if kind != PROJECT and largest <= LONG:
            if not plain:
                _correct(cluster, h, slopes, step)
            _scale(cluster, h, slopes, step)
        if largest >= 0.5:
            for i in range(step.size):
                step[i] /= 1.0 + largest
        for i in range(step.size):
            cluster.fluxes[members[i]] += step[i]
        if kind == FULL and largest <= LAST:
            first = cluster.layout.footprints.first
            for i in range(step.size):
                rows = first[members[i]], first[members[i] + 1]
                _add_step(cluster, rows, step[i])
            return True
        if kind != PROJECT:
            since = largest
        elif largest > 0.3 * before:
            since = np.inf
        before = largest
        # what the next step is expected to be
        whole = largest * (LAG + since) * since <= LAST
    return False
