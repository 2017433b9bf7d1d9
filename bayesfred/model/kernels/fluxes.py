"""Sources drawn, their fluxes and positions profiled where these are free.

Free fluxes. Given everything else the expected counts mu = B + sum_s F_s K_s are linear in the
fluxes F, and with the prior F_s ~ Gamma(2, scale c_s/2) the log-posterior in F is concave: a sum of
n log(mu), log(F) and linear terms. Along a Newton step let d be the largest relative change of any
of these mu and F. A fraction t < 1/d of the step raises the second derivative by no more than 1/(1
- t d)^2, so the gain is largest, for certain, at t = 1/(1 + d): mu and F stay positive, the
iteration climbs from any start, and converges quadratically as d vanishes. With H minus the Hessian
at the maximum,

    log L(theta) = max_F [log L(theta, F) + log p(F)] + n_s/2 log(2 pi) - 1/2 log det H
    (Laplace)

Free positions. Where the catalogue's positions scatter, every source has three free numbers phi =
(F, dx, dy), the shifts dx and dy of a and b having the prior N(0, tau^2), and three templates T = d
mu/d phi: K, F X and F Y with X = dK/d dx, Y = dK/d dy, made anew as the source moves. H = sum_p W T
T^T + diag(1/F^2, 1/tau^2, 1/tau^2), W = n/mu^2, leaves out the second derivatives, which it weighs
with residuals of mean zero; that makes it positive definite anywhere.
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST, REDUCE, take_turn
from bayesfred.imaging.kernels.geometry import (
    Footprints,
    Maps,
    footprints,
    locate,
    move,
    new_maps,
    new_work,
    row_starts,
)
from bayesfred.imaging.kernels.render import add_source, add_templates
from bayesfred.model.kernels.clusters import (
    Clusters,
    add_block,
    bounding_boxes,
    cholesky,
    draw_template,
    find_clusters,
    gram,
    one_cluster,
    project,
    run_end,
    solve,
)
from bayesfred.model.kernels.extrapolate import profile_extrapolated
from bayesfred.model.kernels.likelihood import (
    LIMIT,
    background_row,
    clear,
    log_likelihood,
    mark_counted,
    mark_sources,
    room,
)


class Patch(NamedTuple):
    """The pixels of a cluster, one after another: on every row the stretch that holds all its footprints."""

    values: Floats
    background: Floats
    image: Floats
    score: Floats
    weight: Floats


class Fitted(NamedTuple):
    """What the profiling knows of the sources; empty arrays where fluxes are fixed."""

    footprints: Footprints
    boxes: Ints
    clusters: Clusters
    stamps: Floats  # (templates, samples)
    factors: Floats  # Cholesky factors of H
    fluxes: Floats
    shifts: Floats  # (s, 2) pixel


class Drawn(NamedTuple):
    """The sources as they are drawn in a workspace's image, and what the derivatives need of them."""

    # what profiling adds to the log-likelihood; -inf where a map folds, or the fluxes have no
    # maximum
    extra: float
    maps: Maps
    fitted: Fitted


@inner()
def _patch(counts, w, fp, boxes, members, background, at):
    """A cluster's pixels, without sources; where its footprints' rows begin among them goes into `at`."""
    ny = w.span.shape[0]
    pitch = w.image.size // ny
    top, bottom = boxes[members[0], 0], 0
    for s in members:
        bottom = max(bottom, boxes[s, 1])
    low, high = np.full(max(bottom - top, 0), pitch), np.zeros(max(bottom - top, 0), np.int64)
    for s in members:
        for i in range(fp.first[s], fp.first[s + 1]):
            j = fp.row[i] - top
            low[j] = min(low[j], fp.low[i])
            high[j] = max(high[j], fp.low[i] + fp.size[i])
    start = np.zeros(low.size + 1, np.int64)
    for j in range(low.size):
        start[j + 1] = start[j] + max(high[j] - low[j], 0)
    size = start[low.size]
    values, level, image = (
        room(w, 0, size),
        room(w, w.image.size, size),
        room(w, 2 * w.image.size, size),
    )
    patch = Patch(values, level, image, w.score[:size], w.weight[:size])
    patch.image[:] = 0.0
    for j in range(low.size):
        c0, c1, c2 = background_row(background, top + j, ny)
        for k in range(low[j], high[j]):
            u = (2 * k - counts.nx + 1) / counts.nx
            i = start[j] + k - low[j]
            patch.values[i] = counts.values[(top + j) * pitch + k]
            patch.background[i] = c0 + u * (c1 + u * c2)
    for s in members:
        for i in range(fp.first[s], fp.first[s + 1]):
            j = fp.row[i] - top
            at[i] = start[j] + fp.low[i] - low[j]
    return patch


@inner(fastmath=FAST, error_model="numpy")
def _weigh_patch(patch):
    """Score n/mu - 1 and weight n/mu^2 of Poisson counts, zero where masked."""
    values, background, image, score, weight = patch
    for i in range(values.size):
        inverse = 1.0 / (image[i] + background[i])
        n = values[i] if values[i] > LIMIT else 0.0
        score[i] = n * inverse - (1.0 if values[i] > LIMIT else 0.0)
        weight[i] = n * inverse * inverse


@inner(fastmath=REDUCE)
def _flux_run(stamp, values, background):
    """Sums of template times counts less background, and of template squared."""
    above, below = 0.0, 0.0
    for i in range(stamp.size):
        k = stamp[i] if values[i] > LIMIT else 0.0
        above += k * (values[i] - background[i])
        below += k * k
    return above, below


@inner()
def _first_flux(fp, s, template, patch, at):
    """Least-squares flux of one source, its neighbours ignored."""
    above, below = 0.0, 0.0
    i = fp.first[s]
    while i < fp.first[s + 1]:
        end = run_end(fp, s, i, at)
        stamp, pixels = (
            template[fp.start[i] : fp.start[end]],
            slice(at[i], at[i] + fp.start[end] - fp.start[i]),
        )
        more, norm = _flux_run(stamp, patch.values[pixels], patch.background[pixels])
        above += more
        below += norm
        i = end
    return above / below if below > 0.0 else 0.0


@inner()
def _make_templates(o, maps, fp, s, sigma, flux, stamps, work):
    """Fill the rows of source s in the templates `stamps`, shape (3, samples)."""
    stamps[:, fp.start[fp.first[s]] : fp.start[fp.first[s + 1]]] = 0.0
    add_templates(o, maps, fp, s, sigma, flux, stamps[0], stamps[1], stamps[2], work)


@inner(fastmath=REDUCE, error_model="numpy")
def _bend(fp, s, stamps, flux, score, at, sigma, i, start, out):
    """Subtract from a source's block of H the second derivatives times the score, as they are for a PSF that no pixel blurs.

    K_xx = X^2/K - K/sigma^2, K_xy = X Y/K are a Gaussian's: near enough to make the steps that H
    gives converge several times faster, for any PSF where it falls no faster than a Gaussian does
    within eight widths.
    """
    fx, fy, xx, xy, yy = 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(fp.first[s], fp.first[s + 1]):
        first = fp.start[p]
        for k in range(fp.size[p]):
            own, x, y = stamps[0, first + k] * flux, stamps[1, first + k], stamps[2, first + k]
            r = (
                -score[at[p] + k]
                if own > 1e-200 and x * x + y * y < (8.0 * own / sigma) ** 2
                else 0.0
            )
            inverse = 1.0 / max(own, 1e-200)
            fx += r * x
            fy += r * y
            xx += r * (x * x * inverse - own / (sigma * sigma))
            xy += r * x * y * inverse
            yy += r * (y * y * inverse - own / (sigma * sigma))
    add_block(i, start, out, fx / flux, fy / flux, xx, xy, yy)


@inner(error_model="numpy")
def _profile(
    o,
    maps,
    counts,
    w,
    fp,
    boxes,
    clusters,
    stamps,
    sigma,
    scatter,
    background,
    scale,
    flux,
    shift,
    factors,
):
    """Fill `flux` and `shift` with their maximum and `factors` with the Cholesky factors of H; add the sources to the image.

    Returns the log-prior of the fluxes and shifts plus the Laplace term, or -inf without a maximum.
    The prior of flux s is Gamma(2, scale[s]), with density F exp(-F / scale) / scale^2. With three
    templates the shifts are free, and `maps` is left with the shifted sources.
    """
    size = stamps.shape[0]
    work = new_work(o)
    at, frame = np.empty(fp.row.size, np.int64), row_starts(fp, w.image.size // w.span.shape[0])
    value = 0.0
    shift[:] = 0.0
    for c in range(clusters.first.size - 1):
        members, lead, start = one_cluster(clusters, c, size)
        h = factors[clusters.begin[c] : clusters.begin[c + 1]]
        n = members.size * size
        step = np.empty(n)
        patch = _patch(counts, w, fp, boxes, members, background, at)
        for s in members:
            if size > 1:
                _make_templates(o, maps, fp, s, sigma, 1.0, stamps, work)
            else:
                stamps[0, fp.start[fp.first[s]] : fp.start[fp.first[s + 1]]] = 0.0
                add_source(
                    o,
                    maps,
                    fp,
                    s,
                    fp.first[s],
                    fp.first[s + 1],
                    sigma,
                    1.0,
                    fp.start,
                    stamps[0],
                    work,
                    None,
                    None,
                )
            flux[s] = max(_first_flux(fp, s, stamps[0], patch, at), 0.01 * scale[s])
            stamps[1:, fp.start[fp.first[s]] : fp.start[fp.first[s + 1]]] *= flux[s]
            draw_template(fp, s, stamps[0], flux[s], at, patch.image)
        lower = h.copy() if size > 1 else h
        distance, rate, converged, factored = 0.0, 1.0, False, False
        for _ in range(100):
            _weigh_patch(patch)
            fresh = converged or rate > 0.01  # otherwise the last matrix serves
            if fresh:
                gram(fp, boxes, members, lead, start, stamps, patch.weight, at, h)
                for i in range(n):
                    h[start[i] + i] += (
                        1.0 / flux[members[i // size]] ** 2 if i % size == 0 else 1.0 / scatter**2
                    )
            if converged:
                factored = cholesky(h, lead, start)
                break
            for i in range(n):
                s, t = members[i // size], i % size
                step[i] = project(fp, s, stamps[t], patch.score, at)
                step[i] += (
                    1.0 / flux[s] - 1.0 / scale[s] if t == 0 else -shift[s, t - 1] / scatter**2
                )
            gradient = step.copy()
            if fresh and size > 1:
                lower[:] = h
                for i in range(members.size):
                    _bend(
                        fp,
                        members[i],
                        stamps,
                        flux[members[i]],
                        patch.score,
                        at,
                        sigma,
                        i,
                        start,
                        lower,
                    )
            factored = not fresh or cholesky(lower, lead, start)
            if size > 1 and not factored:  # far from the maximum
                lower[:] = h
                factored = cholesky(lower, lead, start)
            if not factored:
                break
            solve(lower, lead, start, step)
            largest = 0.0
            for i in range(n):
                largest = max(
                    largest, abs(step[i]) / (flux[members[i // size]] if i % size == 0 else sigma)
                )
            step *= 1.0 if largest < 0.5 else 1.0 / (1.0 + largest)
            for i in range(members.size):
                s = members[i]
                if size > 1:
                    draw_template(fp, s, stamps[0], -flux[s], at, patch.image)
                    flux[s] += step[i * size]
                    shift[s] += step[i * size + 1 : i * size + 3]
                    move(o, maps, s, step[i * size + 1], step[i * size + 2])
                    _make_templates(o, maps, fp, s, sigma, flux[s], stamps, work)
                    draw_template(fp, s, stamps[0], flux[s], at, patch.image)
                else:
                    flux[s] += step[i]
                    draw_template(fp, s, stamps[0], step[i], at, patch.image)
            # The square of the distance in standard deviations, and what a step leaves of it: in a
            # Newton step of fluxes alone the square of the largest relative change.
            before, distance = distance, np.dot(gradient, step)
            rate = distance / before if before > 0.0 else 1.0
            if fresh and size == 1:
                rate = largest * largest
            converged = distance * min(rate, 1.0) <= 1e-16
        if not (converged and factored):
            return -math.inf
        for i in range(n):
            value -= math.log(h[start[i] + i])
        for s in members:
            value += (
                math.log(flux[s] / scale[s] ** 2)
                - flux[s] / scale[s]
                + 0.5 * math.log(2.0 * math.pi)
            )
            if size > 1:
                value -= 0.5 * (shift[s, 0] ** 2 + shift[s, 1] ** 2) / scatter**2 + 2.0 * math.log(
                    scatter
                )
            draw_template(fp, s, stamps[0], flux[s], frame, w.image)
    return value


@entry()
def draw(o, counts, w, theta, nuisances, background, flux, free):
    """Draw all sources, profiling their fluxes if they are free; whoever uses the image clears the workspace.

    Nuisances are flux_scale, offset_x, offset_y, psf_sigma, position_scatter. Here and wherever
    else it is passed, `free` is True, or None where fluxes are fixed: a type of its own, for which
    what profiles them is not compiled.
    """
    maps = new_maps(o)
    sigma, scatter = nuisances[3], nuisances[4]
    extra = 0.0
    if not (
        scatter >= 0.0 and locate(o, theta, nuisances[1], nuisances[2], sigma, 6.0 * scatter, maps)
    ):
        extra = -math.inf
        maps.rows[:] = 0
    fp = footprints(o, maps)
    mark_sources(fp, w)
    if counts.varies:
        mark_counted(counts, w)
    templates = 3 if scatter > 0.0 else 1
    fluxes, shifts = np.empty(flux.size), np.zeros((flux.size, 2))
    if free is not None:
        boxes = bounding_boxes(fp)
        clusters = find_clusters(boxes, o.ny, templates)
        factors = np.empty(clusters.begin[-1])
        stamps = room(w, 3 * w.image.size, templates * fp.start[fp.row.size]).reshape(templates, -1)
        extra += _profile(
            o,
            maps,
            counts,
            w,
            fp,
            boxes,
            clusters,
            stamps,
            sigma,
            scatter,
            background,
            0.5 * flux,
            fluxes,
            shifts,
            factors,
        )
    else:
        none = np.empty(0, np.int64)
        boxes, clusters = np.empty((0, 4), np.int64), Clusters(none, none, none, none, none)
        factors, stamps = np.empty(0), np.empty((1, 0))
        work = new_work(o)
        at = row_starts(fp, w.image.size // o.ny)
        for s in range(o.x.size):
            fluxes[s] = nuisances[0] * flux[s]
            add_source(
                o,
                maps,
                fp,
                s,
                fp.first[s],
                fp.first[s + 1],
                sigma,
                fluxes[s],
                at,
                w.image,
                work,
                None,
                None,
            )
    return Drawn(extra, maps, Fitted(fp, boxes, clusters, stamps, factors, fluxes, shifts))


@entry()
def log_likelihoods(
    o, counts, w, theta, nuisances, background, flux, free, extrapolated, turn, out
):
    """Log-likelihoods of rows into `out`; rows where it is -inf already are left alone.

    `extrapolated` is None, or fluxes near their maximum. Each row is whose turn it is: threads that
    share `turn` share the rows, and one that is held up takes fewer.
    """
    while True:
        i = take_turn(turn)
        if i >= out.size:
            break
        if out[i] > -math.inf:
            value = math.nan
            if extrapolated is not None:
                fluxes = extrapolated.fluxes[i].copy()
                value = profile_extrapolated(
                    o,
                    counts,
                    w,
                    theta[i],
                    nuisances[i],
                    background[i],
                    0.5 * flux,
                    fluxes,
                    extrapolated,
                )
                clear(w)
            if math.isnan(value):
                value = draw(o, counts, w, theta[i], nuisances[i], background[i], flux, free).extra
                if value > -math.inf:
                    value += log_likelihood(counts, w, background[i])
                clear(w)
            out[i] = value
