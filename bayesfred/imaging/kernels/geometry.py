"""Where the sources are imaged, and which pixels they reach.

For one source the displacement is a polynomial in (u, v) alone, so the kernel's arguments

    a = u - x + f(u, v, x, y) - offset_x,        b = v - y + g(u, v, x, y) - offset_y

are two small coefficient matrices. They are expanded about the source's peak, where a = b = 0,
which makes them well conditioned and gives the window of pixels to visit. So are a^2 + b^2 and the
Jacobian determinant D = a_u b_v - a_v b_u, multiplied out once per source.

`forward.py` binds these modules' functions to the public objects; the loops over counts are in
`model/kernels`.
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import entry, inner, leaf, shared
from bayesfred.imaging.kernels.contexts import (
    LANES,
    Footprints,
    Geometry,
    Layout,
    Source,
    SourceNuisances,
)
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.imaging.kernels.polynomials import evaluate, multiply, shift
from bayesfred.imaging.kernels.psf_dispatch import new_places

CORE = 2.0  # widths of the PSF about a source's image within which its map must not fold
SCATTER = 6.0  # standard deviations by which positions that scatter may move


class _Search(NamedTuple):
    """What the search for a source's window knows: radii in (a, b), and its memory."""

    radius: float
    core: float
    bounds: Floats  # coefficients of rho
    stack: Floats  # parts of the frame


@shared()
def new_geometry(o):
    """Room for the geometry of all sources."""
    size = o.x.size
    n, n_q, n_d = len(o.degrees.ab) + 1, len(o.degrees.q) + 1, len(o.degrees.d) + 1
    a, b = np.empty((size, n, n)), np.empty((size, n, n))
    q, d = np.empty((size, n_q, n_q)), np.empty((size, n_d, n_d))
    peak, ellipse, rows = np.empty((size, 2)), np.empty((size, 4)), np.empty((size, 2), np.int64)
    return Geometry(a, b, q, d, peak, ellipse, rows, 0)


@inner()
def new_work(o):
    """Room for a row's polynomials."""
    return np.empty((7, 2 * len(o.degrees.ab) + 1))


@inner(inline="always")
def one_source(geometry, s):
    """Source s alone."""
    u, v = geometry.peak[s, 0], geometry.peak[s, 1]
    number = geometry.first + s
    return Source(geometry.a[s], geometry.b[s], geometry.q[s], geometry.d[s], u, v, number)


@inner()
def some_sources(geometry, first, last):
    """The sources from first to last - 1."""
    every = slice(first, last)
    a, b, q, d = geometry.a[every], geometry.b[every], geometry.q[every], geometry.d[every]
    peak, ellipse, rows = geometry.peak[every], geometry.ellipse[every], geometry.rows[every]
    return Geometry(a, b, q, d, peak, ellipse, rows, geometry.first + first)


@leaf()
def _fill(o, s, theta, nuisances, a, b):
    """Coefficients of a and b of source s in powers of u and v, about the frame's middle."""
    a[:] = 0.0
    b[:] = 0.0
    a[0, 0] = -o.x[s] - nuisances.offset_x
    b[0, 0] = -o.y[s] - nuisances.offset_y
    a[1, 0] = 1.0
    b[0, 1] = 1.0
    n_f = o.f_powers.shape[0]
    for k in range(n_f):
        a[o.f_powers[k, 0], o.f_powers[k, 1]] += theta[k] * o.f_object_powers[s, k]
    for k in range(o.g_powers.shape[0]):
        b[o.g_powers[k, 0], o.g_powers[k, 1]] += theta[n_f + k] * o.g_object_powers[s, k]


@leaf()
def _find_peak(o, s, theta, nuisances, a, b):
    """Newton's iteration for a = b = 0, leaving a and b expanded about the solution.

    Returns u, v, found.
    """
    u = o.x[s] + nuisances.offset_x
    v = o.y[s] + nuisances.offset_y
    far = 4.0 * o.step * (o.nx + o.ny)
    found = False
    _fill(o, s, theta, nuisances, a, b)
    for _ in range(50):
        a_0, a_u, a_v = evaluate(a, u, v, o.degrees.ab)
        b_0, b_u, b_v = evaluate(b, u, v, o.degrees.ab)
        det = a_u * b_v - a_v * b_u
        if det == 0.0:
            break
        h = (a_v * b_0 - b_v * a_0) / det
        k = (b_u * a_0 - a_u * b_0) / det
        if not (abs(h) + abs(k) < far):
            break
        u += h
        v += k
        # quadratic convergence: the next step would be far below rounding
        if abs(h) + abs(k) <= 1e-9:
            found = True
            break
    if not found:
        u = o.x[s]
        v = o.y[s]
    shift(a, u, v, o.degrees.ab)
    shift(b, u, v, o.degrees.ab)
    return u, v, found and a[1, 0] * b[0, 1] - a[0, 1] * b[1, 0] > 0.0


@leaf()
def _support_radius(o, source, search):
    """Radius R' of the ellipse |J d| <= R' that holds every pixel with |(a, b)| <= R = radius.

    It is -1 if D <= 0 anywhere that |(a, b)| <= core.

    With d the distance from the peak, (a, b) = J d + r, and |r| <= rho(|d|) = sum over m + n >= 2
    of |c_mn| |d|^(m + n). On the ellipse |J d| = R' one has |d| <= R'/s, s the smaller singular
    value of J, hence |(a, b)| >= R' - rho(R'/s) >= R as soon as R' >= R + rho(R'/s). The smallest
    such R' is a fixed point. What lies farther, up to the frame's farthest corner, is beyond R too
    if that corner is, for s |d| - rho(|d|) is concave. Otherwise the frame is surveyed. A pixel is
    visited if its centre is within the ellipse enlarged by its farthest quadrature node.
    """
    a, b, u, v = source.a, source.b, source.u, source.v
    radius, bounds = search.radius, search.bounds
    j11, j12, j21, j22 = a[1, 0], a[0, 1], b[1, 0], b[0, 1]
    half = 0.5 * (j11 * j11 + j12 * j12 + j21 * j21 + j22 * j22)
    det = j11 * j22 - j12 * j21
    root = math.sqrt(max(half * half - det * det, 0.0))
    largest = math.sqrt(half + root)
    smallest = det / largest
    if not radius < math.inf:
        return math.inf
    bounds[:] = 0.0  # rho's coefficients
    for m in range(a.shape[0]):
        for n in range(a.shape[1]):
            bounds[m + n] += math.sqrt(a[m, n] * a[m, n] + b[m, n] * b[m, n])
    margin = largest * math.sqrt(2.0) * abs(o.offsets[0])
    farthest = math.hypot(abs(u) + 0.5 * o.nx * o.step, abs(v) + 0.5 * o.ny * o.step)
    if smallest * farthest - _rest(bounds, farthest) > radius:
        largest_d = radius
        for _ in range(60):
            rest = _rest(bounds, largest_d / smallest)
            if radius + rest <= largest_d * (1.0 + 1e-6):
                return largest_d * (1.0 + 1e-6) + margin
            largest_d = radius + rest
            if largest_d > 4.0 * radius:
                break
    largest_d = _survey(o, source, search)
    return largest_d + margin if largest_d >= 0.0 else -1.0


@leaf()
def _rest(bounds, d):
    """rho at distance d."""
    rest = 0.0
    for k in range(bounds.size - 1, 1, -1):
        rest = (rest + bounds[k]) * d
    return rest * d


@leaf()
def _survey(o, source, search):
    """A bound of |J d| in the frame where |(a, b)| <= radius; -1 if D <= 0 where it is <= core.

    The frame is halved along both axes and so are its parts, unless they lie beyond the radius: at
    distance r from a part's middle (a, b) differs from its value there by at most |J| r + M r^2 /
    2, M = sum of |c_mn| k (k - 1) |d|^(k - 2), k = m + n. Parts are not halved below a twelfth of
    the radius; there the middle stands for the part.
    """
    a, b, bounds, stack = source.a, source.b, search.bounds, search.stack
    radius, core = search.radius, search.core
    across, along = 0.5 * o.nx * o.step, 0.5 * o.ny * o.step
    stack[0, 0], stack[0, 1], stack[0, 2] = -source.u, -source.v, 1.0
    size, largest = 1, 0.0
    while size > 0:
        size -= 1
        t, w, part = stack[size, 0], stack[size, 1], stack[size, 2]
        half_t, half_w = part * across, part * along
        r = math.hypot(half_t, half_w)
        a_0, a_u, a_v = evaluate(a, t, w, o.degrees.ab)
        b_0, b_u, b_v = evaluate(b, t, w, o.degrees.ab)
        here = math.hypot(a_0, b_0)
        far = math.hypot(t, w) + r
        curvature = 0.0
        for k in range(bounds.size - 1, 1, -1):
            curvature = curvature * far + k * (k - 1) * bounds[k]
        slope = math.sqrt(a_u * a_u + a_v * a_v + b_u * b_u + b_v * b_v)
        if here > radius + r * (slope + 0.5 * curvature * r):
            continue
        if max(half_t, half_w) <= radius / 12.0:
            if here <= core and a_u * b_v - a_v * b_u <= 0.0:
                return -1.0
            for i in range(4):
                t_i, w_i = t + (half_t if i % 2 else -half_t), w + (half_w if i < 2 else -half_w)
                j_a, j_b = a[1, 0] * t_i + a[0, 1] * w_i, b[1, 0] * t_i + b[0, 1] * w_i
                largest = max(largest, math.hypot(j_a, j_b))
            continue
        for i in range(4):
            stack[size, 0] = t + (0.5 * half_t if i % 2 else -0.5 * half_t)
            stack[size, 1] = w + (0.5 * half_w if i < 2 else -0.5 * half_w)
            stack[size, 2] = 0.5 * part
            size += 1
    return largest


@shared()
def locate(o, theta, nuisances, geometry):
    """Fill `geometry`; False where the distortion is not admissible.

    That is where a source has no image, or the map folds (D <= 0) within two of the PSF's widths of
    one. Windows hold the pixels above the tolerance, and those above it once a source moves by as
    much in (a, b) as positions scatter.
    """
    sigma = nuisances.psf_sigma
    search = _Search(
        sigma * o.support_radius + SCATTER * nuisances.position_scatter,
        CORE * sigma,
        np.empty(2 * len(o.degrees.ab) + 1),
        np.empty((256, 3)),
    )
    return _locate_sources(o, theta, nuisances, geometry, search)


@leaf()
def _locate_sources(o, theta, nuisances, geometry, search):
    unfolded, rows, ellipse = True, geometry.rows, geometry.ellipse
    for s in range(o.x.size):
        a = geometry.a[s]
        b = geometry.b[s]
        u, v, ok = _find_peak(o, s, theta, nuisances, a, b)
        geometry.peak[s, 0] = u
        geometry.peak[s, 1] = v
        radius = _support_radius(o, one_source(geometry, s), search) if ok else math.inf
        unfolded = unfolded and ok and radius >= 0.0
        multiply(a, b, len(o.degrees.d) > 0, geometry.q[s], geometry.d[s])
        if 0.0 <= radius < math.inf:
            alpha = a[1, 0] ** 2 + b[1, 0] ** 2
            ellipse[s, 0] = alpha
            ellipse[s, 1] = a[1, 0] * a[0, 1] + b[1, 0] * b[0, 1]
            ellipse[s, 2] = a[0, 1] ** 2 + b[0, 1] ** 2
            ellipse[s, 3] = radius * radius
            height = radius * math.sqrt(alpha) / abs(a[1, 0] * b[0, 1] - a[0, 1] * b[1, 0])
            centre = 0.5 * (o.ny - 1)
            low = min(max((v - height) / o.step + centre, -1.0), 1.0 * o.ny)
            high = min(max((v + height) / o.step + centre, -1.0), 1.0 * o.ny)
            rows[s, 0] = max(math.ceil(low), 0)
            rows[s, 1] = min(math.floor(high), o.ny - 1) + 1
        else:
            ellipse[s] = 0.0
            rows[s, 0] = 0
            rows[s, 1] = o.ny
    return unfolded


@shared()
def move(o, geometry, s, by_x, by_y):
    """Shift source s along a and b."""
    a, b = geometry.a[s], geometry.b[s]
    a[0, 0] -= by_x
    b[0, 0] -= by_y
    multiply(a, b, len(o.degrees.d) > 0, geometry.q[s], geometry.d[s])


@shared(fastmath=FAST)
def find_footprints(o, geometry):
    """The rows of pixels that every source reaches, their lengths multiples of LANES."""
    sources, size = geometry.peak.shape[0], 0
    for s in range(sources):
        size += max(0, geometry.rows[s, 1] - geometry.rows[s, 0])
    first = np.zeros(sources + 1, np.int64)
    low, count, row = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    start = np.zeros(size + 1, np.int64)
    ny, nx, step = o.ny, o.nx, o.step
    i = 0
    for s in range(sources):
        ellipse = geometry.ellipse[s]
        alpha, beta, gamma, square = ellipse[0], ellipse[1], ellipse[2], ellipse[3]
        # In columns, row v_peak + w has its chord's middle at middle + slope w, and half the chord
        # squared is half - decrease w^2.
        middle, slope, half, decrease = 0.0, 0.0, 1.0 * nx * nx, 0.0
        if alpha > 0.0:
            middle = geometry.peak[s, 0] / step + 0.5 * (nx - 1)
            slope = -beta / (alpha * step)
            half = square / (alpha * step * step)
            decrease = (alpha * gamma - beta * beta) / (alpha * step) ** 2
        top = geometry.peak[s, 1] + 0.5 * (ny - 1) * step
        for j in range(geometry.rows[s, 0], geometry.rows[s, 1]):
            w = j * step - top
            chord = math.sqrt(max(half - decrease * w * w, 0.0))
            at = math.ceil(min(max(middle + slope * w - chord, 0.0), 1.0 * nx))
            n = math.floor(min(max(middle + slope * w + chord, -1.0), nx - 1.0)) + 1 - at
            if n > 0:
                n = -(-n // LANES) * LANES
                low[i], count[i], row[i] = at, n, j
                start[i + 1] = start[i] + n
                i += 1
        first[s + 1] = i
    return Footprints(first, low[:i], count[:i], start[: i + 1], row[:i])


@inner()
def row_starts(fp, pitch):
    """Where every row of pixels begins in a padded, flattened image."""
    at = np.empty(fp.row.size, np.int64)
    for i in range(at.size):
        at[i] = fp.row[i] * pitch + fp.low[i]
    return at


@inner()
def layout_of(o, geometry, fp, sigma):
    """The sources as they lie on the frame, their footprints known."""
    return Layout(o, geometry, fp, sigma, new_work(o), new_places(o.psf, o.ramp.size))


@inner()
def lay_out(o, geometry, sigma):
    """The sources as they lie on the frame once they are located."""
    return layout_of(o, geometry, find_footprints(o, geometry), sigma)


@entry()
def image_positions(o, theta, offset_x, offset_y, sigma):
    """Where the sources are imaged, shape (s, 2); one without an image stays where it is."""
    geometry = new_geometry(o)
    locate(o, theta, SourceNuisances(1.0, offset_x, offset_y, sigma, 0.0, 0.0), geometry)
    return geometry.peak
