"""Where the sources are imaged, and which pixels they reach.

For one source the displacement is a polynomial in (u, v) alone, so the kernel's arguments

    a = u - x + f(u, v, x, y) - offset_x,        b = v - y + g(u, v, x, y) - offset_y

are two small coefficient matrices. They are expanded about the source's peak, where a = b = 0,
which makes them well conditioned and gives the window of pixels to visit. So are a^2 + b^2 and the
Jacobian determinant D = a_u b_v - a_v b_u, multiplied out once per source.

`forward.py` binds these modules' functions to the public objects; the loops over counts are in
`inference/kernels`.
"""

import math
from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import entry, inner
from bayesfred.imaging.kernels.fastmath import FAST
from bayesfred.imaging.kernels.polynomials import evaluate, multiply, shift
from bayesfred.imaging.kernels.psf_profiles import Gaussian, Moffat, Spline

# rows are visited in multiples of this many pixels, which spares the loops their scalar remainders
LANES = 8
CORE = 2.0  # widths of the PSF about a source's image within which its map must not fold
SEGMENT = 16  # pixels that are marked together as reached by a source


class Optics(NamedTuple):
    """A forward model as the loops need it; s counts sources, k terms."""

    psf: Gaussian | Moffat | Spline
    x: Floats  # (s,) pixel
    y: Floats
    f_powers: Ints  # (k, 2) powers of u and v
    g_powers: Ints
    f_lever: Floats  # (s, k) x^i y^j
    g_lever: Floats
    offsets: Floats  # quadrature nodes of a pixel along one axis, pixel
    weights: Floats
    step: float  # pitch of the recorded pixels in fine pixels
    ny: int
    nx: int
    reach: float  # (a, b) that lie farther from 0 are below the tolerance, sigma
    ramp: Floats  # (padded row,) u of pixels counted from a row's first
    degree: tuple[int, ...]  # its length is the degree of a and b in u or v, whichever is higher
    q_degree: tuple[int, ...]  # of a^2 + b^2
    d_degree: tuple[int, ...]  # of D; empty where flux is not conserved


class Maps(NamedTuple):
    """Where the sources are imaged and which pixels they reach."""

    a: Floats  # (s, degree + 1, degree + 1) coefficients about the peak, powers of u first
    b: Floats
    q: Floats  # (s, q_degree + 1, q_degree + 1) of a^2 + b^2, powers of v first
    d: Floats  # (s, d_degree + 1, d_degree + 1) of D, or 1 where flux is not conserved
    peak: Floats  # (s, 2) u, v
    ellipse: Floats  # (s, 4) alpha, beta, gamma, R^2: alpha t^2 + 2 beta t w + gamma w^2 <= R^2
    rows: Ints  # (s, 2) first row and the one after the last


class Footprints(NamedTuple):
    """The pixels of every source, as rows: of source s those from first[s] to first[s + 1]."""

    first: Ints  # (s + 1,)
    low: Ints  # (rows,) first pixel
    size: Ints  # pixels
    start: Ints  # (rows + 1,) where the row's samples begin, counted over all sources
    row: Ints  # the frame's row


def stride(nx: int) -> int:
    """Pixels a padded image row takes: an odd number of segments, lest the rows' pixels fall on the same cache lines."""
    return (-(-(nx + LANES) // SEGMENT) | 1) * SEGMENT


@inner()
def new_maps(o):
    """Room for the maps of all sources."""
    size = o.x.size
    n, n_q, n_d = len(o.degree) + 1, len(o.q_degree) + 1, len(o.d_degree) + 1
    a, b = np.empty((size, n, n)), np.empty((size, n, n))
    q, d = np.empty((size, n_q, n_q)), np.empty((size, n_d, n_d))
    return Maps(a, b, q, d, np.empty((size, 2)), np.empty((size, 4)), np.empty((size, 2), np.int64))


@inner()
def new_work(o):
    """Room for a row's polynomials."""
    return np.empty((7, 2 * len(o.degree) + 1))


@inner()
def _fill(o, s, theta, offset_x, offset_y, a, b):
    """Coefficients of a and b of source s in powers of u and v, about the frame's middle."""
    a[:] = 0.0
    b[:] = 0.0
    a[0, 0] = -o.x[s] - offset_x
    b[0, 0] = -o.y[s] - offset_y
    a[1, 0] = 1.0
    b[0, 1] = 1.0
    n_f = o.f_powers.shape[0]
    for k in range(n_f):
        a[o.f_powers[k, 0], o.f_powers[k, 1]] += theta[k] * o.f_lever[s, k]
    for k in range(o.g_powers.shape[0]):
        b[o.g_powers[k, 0], o.g_powers[k, 1]] += theta[n_f + k] * o.g_lever[s, k]


@inner()
def _find_peak(o, s, theta, offset_x, offset_y, a, b):
    """Newton's iteration for a = b = 0, leaving a and b expanded about the solution. Returns u, v, found."""
    u = o.x[s] + offset_x
    v = o.y[s] + offset_y
    far = 4.0 * o.step * (o.nx + o.ny)
    found = False
    _fill(o, s, theta, offset_x, offset_y, a, b)
    for _ in range(50):
        a_0, a_u, a_v = evaluate(a, u, v, o.degree)
        b_0, b_u, b_v = evaluate(b, u, v, o.degree)
        det = a_u * b_v - a_v * b_u
        if det == 0.0:
            break
        h = (a_v * b_0 - b_v * a_0) / det
        k = (b_u * a_0 - a_u * b_0) / det
        if not (abs(h) + abs(k) < far):
            break
        u += h
        v += k
        if (
            abs(h) + abs(k) <= 1e-9
        ):  # quadratic convergence: the next step would be far below rounding
            found = True
            break
    if not found:
        u = o.x[s]
        v = o.y[s]
    shift(a, u, v, o.degree)
    shift(b, u, v, o.degree)
    return u, v, found and a[1, 0] * b[0, 1] - a[0, 1] * b[1, 0] > 0.0


@inner()
def _reach(o, a, b, u, v, radius, core, bounds, stack):
    """Radius R' of the ellipse |J d| <= R' that holds every pixel with |(a, b)| <= R = radius, -1 if D <= 0 where it is <= core.

    With d the distance from the peak, (a, b) = J d + r, and |r| <= rho(|d|) = sum over m + n >= 2
    of |c_mn| |d|^(m + n). On the ellipse |J d| = R' one has |d| <= R'/s, s the smaller singular
    value of J, hence |(a, b)| >= R' - rho(R'/s) >= R as soon as R' >= R + rho(R'/s). The smallest
    such R' is a fixed point. What lies farther, up to the frame's farthest corner, is beyond R too
    if that corner is, for s |d| - rho(|d|) is concave. Otherwise the frame is surveyed. A pixel is
    visited if its centre is within the ellipse enlarged by its farthest quadrature node.
    """
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
        reach = radius
        for _ in range(60):
            rest = _rest(bounds, reach / smallest)
            if radius + rest <= reach * (1.0 + 1e-6):
                return reach * (1.0 + 1e-6) + margin
            reach = radius + rest
            if reach > 4.0 * radius:
                break
    reach = _survey(o, a, b, u, v, radius, core, bounds, stack)
    return reach + margin if reach >= 0.0 else -1.0


@inner()
def _rest(bounds, d):
    """rho at distance d."""
    rest = 0.0
    for k in range(bounds.size - 1, 1, -1):
        rest = (rest + bounds[k]) * d
    return rest * d


@inner()
def _survey(o, a, b, u, v, radius, core, bounds, stack):
    """The largest |J d| in the frame where |(a, b)| <= radius, at most; -1 if D <= 0 where |(a, b)| <= core.

    The frame is halved along both axes and so are its parts, unless they lie beyond the radius: at
    distance r from a part's middle (a, b) differs from its value there by at most |J| r + M r^2 /
    2, M = sum of |c_mn| k (k - 1) |d|^(k - 2), k = m + n. Parts are not halved below a twelfth of
    the radius; there the middle stands for the part.
    """
    across, along = 0.5 * o.nx * o.step, 0.5 * o.ny * o.step
    stack[0, 0], stack[0, 1], stack[0, 2] = -u, -v, 1.0
    size, reach = 1, 0.0
    while size > 0:
        size -= 1
        t, w, part = stack[size, 0], stack[size, 1], stack[size, 2]
        half_t, half_w = part * across, part * along
        r = math.hypot(half_t, half_w)
        a_0, a_u, a_v = evaluate(a, t, w, o.degree)
        b_0, b_u, b_v = evaluate(b, t, w, o.degree)
        here = math.hypot(a_0, b_0)
        far = math.hypot(t, w) + r
        bend = 0.0
        for k in range(bounds.size - 1, 1, -1):
            bend = bend * far + k * (k - 1) * bounds[k]
        if here > radius + r * (
            math.sqrt(a_u * a_u + a_v * a_v + b_u * b_u + b_v * b_v) + 0.5 * bend * r
        ):
            continue
        if max(half_t, half_w) <= radius / 12.0:
            if here <= core and a_u * b_v - a_v * b_u <= 0.0:
                return -1.0
            for i in range(4):
                t_i, w_i = t + (half_t if i % 2 else -half_t), w + (half_w if i < 2 else -half_w)
                reach = max(
                    reach, math.hypot(a[1, 0] * t_i + a[0, 1] * w_i, b[1, 0] * t_i + b[0, 1] * w_i)
                )
            continue
        for i in range(4):
            stack[size, 0] = t + (0.5 * half_t if i % 2 else -0.5 * half_t)
            stack[size, 1] = w + (0.5 * half_w if i < 2 else -0.5 * half_w)
            stack[size, 2] = 0.5 * part
            size += 1
    return reach


@inner()
def locate(o, theta, offset_x, offset_y, sigma, margin, maps):
    """Fill `maps`; False where a source has no image, or the map folds (D <= 0) within two of the PSF's widths of one.

    Windows hold the pixels above the tolerance, and those above it once a source moves by up to
    `margin` in (a, b).
    """
    unfolded = True
    radius = sigma * o.reach + margin
    bounds, stack = np.empty(2 * len(o.degree) + 1), np.empty((256, 3))
    for s in range(o.x.size):
        a = maps.a[s]
        b = maps.b[s]
        u, v, ok = _find_peak(o, s, theta, offset_x, offset_y, a, b)
        reach = _reach(o, a, b, u, v, radius, CORE * sigma, bounds, stack) if ok else math.inf
        unfolded = unfolded and ok and reach >= 0.0
        multiply(a, b, len(o.d_degree) > 0, maps.q[s], maps.d[s])
        maps.peak[s, 0] = u
        maps.peak[s, 1] = v
        if 0.0 <= reach < math.inf:
            alpha = a[1, 0] ** 2 + b[1, 0] ** 2
            maps.ellipse[s, 0] = alpha
            maps.ellipse[s, 1] = a[1, 0] * a[0, 1] + b[1, 0] * b[0, 1]
            maps.ellipse[s, 2] = a[0, 1] ** 2 + b[0, 1] ** 2
            maps.ellipse[s, 3] = reach * reach
            height = reach * math.sqrt(alpha) / abs(a[1, 0] * b[0, 1] - a[0, 1] * b[1, 0])
            centre = 0.5 * (o.ny - 1)
            low = min(max((v - height) / o.step + centre, -1.0), 1.0 * o.ny)
            high = min(max((v + height) / o.step + centre, -1.0), 1.0 * o.ny)
            maps.rows[s, 0] = max(math.ceil(low), 0)
            maps.rows[s, 1] = min(math.floor(high), o.ny - 1) + 1
        else:
            maps.ellipse[s] = 0.0
            maps.rows[s, 0] = 0
            maps.rows[s, 1] = o.ny
    return unfolded


@inner()
def move(o, maps, s, by_x, by_y):
    """Shift source s along a and b."""
    maps.a[s, 0, 0] -= by_x
    maps.b[s, 0, 0] -= by_y
    multiply(maps.a[s], maps.b[s], len(o.d_degree) > 0, maps.q[s], maps.d[s])


@inner(fastmath=FAST, error_model="numpy")
def footprints(o, maps):
    """The rows of pixels that every source reaches, their lengths multiples of LANES."""
    sources, size = maps.peak.shape[0], 0
    for s in range(sources):
        size += max(0, maps.rows[s, 1] - maps.rows[s, 0])
    first = np.zeros(sources + 1, np.int64)
    low, count, row = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    start = np.zeros(size + 1, np.int64)
    ny, nx, step = o.ny, o.nx, o.step
    i = 0
    for s in range(sources):
        alpha, beta, gamma, square = (
            maps.ellipse[s, 0],
            maps.ellipse[s, 1],
            maps.ellipse[s, 2],
            maps.ellipse[s, 3],
        )
        # In columns, row v_peak + w has its chord's middle at middle + slope w, and half the chord
        # squared is half - bend w^2.
        middle, slope, half, bend = 0.0, 0.0, 1.0 * nx * nx, 0.0
        if alpha > 0.0:
            middle = maps.peak[s, 0] / step + 0.5 * (nx - 1)
            slope = -beta / (alpha * step)
            half = square / (alpha * step * step)
            bend = (alpha * gamma - beta * beta) / (alpha * step) ** 2
        top = maps.peak[s, 1] + 0.5 * (ny - 1) * step
        for j in range(maps.rows[s, 0], maps.rows[s, 1]):
            w = j * step - top
            reach = math.sqrt(max(half - bend * w * w, 0.0))
            at = math.ceil(min(max(middle + slope * w - reach, 0.0), 1.0 * nx))
            n = math.floor(min(max(middle + slope * w + reach, -1.0), nx - 1.0)) + 1 - at
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


@entry()
def image_positions(o, theta, offset_x, offset_y, sigma):
    """Where the sources are imaged, shape (s, 2); a source without an image stays at its place."""
    maps = new_maps(o)
    locate(o, theta, offset_x, offset_y, sigma, 0.0, maps)
    return maps.peak
