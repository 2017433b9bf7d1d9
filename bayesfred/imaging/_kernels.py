"""Compiled loops of the forward model: arrays in, arrays out, no validation.

For one source the displacement is a polynomial in (u, v) alone, so the kernel's arguments

    a = u - x + f(u, v, x, y) - offset_x,        b = v - y + g(u, v, x, y) - offset_y

are two small coefficient matrices. They are expanded about the source's peak, where a = b = 0, which makes
them well conditioned and gives the window of pixels to visit. So are a^2 + b^2 and the Jacobian determinant
D = a_u b_v - a_v b_u, multiplied out once per source. Along a row of pixels they are polynomials in u alone: a sample of
a Gaussian's kernel costs two Horner sweeps and one exponential. The degree in u reaches the innermost loop as the length of a
tuple, that is as a compile-time constant, so that the loop over pixels vectorises for every degree. So does the kind of the PSF,
as a type: what is compiled holds the code of one kind alone.

`forward.py` binds these functions to the public objects; the loops over counts are in `inference/_kernels.py`.
"""

import math
from functools import partial
from typing import Any, NamedTuple

import numba as nb
import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba.extending import intrinsic, overload

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# Reassociation is left out where a result's last digits matter: it would undo the range reduction of exp2.
FAST = {"contract", "arcp", "nsz", "nnan", "ninf"}
REDUCE = FAST | {"reassoc"}

# For functions that only compiled code calls (Python must not: it would crash): wrappers for other callers would add a seventh
# to the time of compilation.
inner = partial(nb.njit, no_cpython_wrapper=True, no_cfunc_wrapper=True)

LANES = 8  # rows are visited in multiples of this many pixels, which spares the loops their scalar remainders
LOG2_E = 1.4426950408889634
BATCH = 32  # sources whose rows are listed at a time: of many sources the list would outgrow the caches
CORE = 2.0  # widths of the PSF about a source's image within which its map must not fold
SEGMENT = 16  # pixels that are marked together as reached by a source


class Gaussian(NamedTuple):
    """norm exp(-(a^2 + b^2) / 2). Here and below, a and b in units of sigma."""

    norm: float


class Moffat(NamedTuple):
    """norm (1 + (a^2 + b^2) / square)^-beta."""

    norm: float
    square: float
    beta: float


class Spline(NamedTuple):
    """norm times the sum of c[j, i] B(y - j) B(x - i), B the cubic B-spline; from the middle, x = a / pitch and y = b / pitch.

    The four outermost rows and columns of c are zero.
    """

    norm: float
    c: Floats
    pitch: float


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


@intrinsic
def as_float(typingctx: Any, bits: Any) -> Any:
    """The float64 with these bits, without leaving a SIMD loop."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.DoubleType())

    return nb.types.float64(nb.types.int64), codegen


@intrinsic
def as_bits(typingctx: Any, value: Any) -> Any:
    """The bits of a float64 as an int64."""

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(64))

    return nb.types.int64(nb.types.float64), codegen


@nb.njit(fastmath=FAST, inline="always")
def exp2(x):
    """2^x for -1000 <= x < 1000 to 3e-16 relative, smaller x being taken for -1000.

    x = n + f with n the nearest integer, which adding 1.5 * 2^52 leaves in the sum's lowest bits; the polynomial of degree 11
    that is nearest to 2^f on [-1/2, 1/2] (Remez, 3e-18 relative); n added to the exponent's bits.
    """
    x = max(x, -1000.0)
    shifted = x + 6755399441055744.0
    f = x - (shifted - 6755399441055744.0)
    p = 4.4352827069572771511e-10
    p = p * f + 7.0741056135081427963e-09
    p = p * f + 1.0178198021671930844e-07
    p = p * f + 1.321543308967639918e-06
    p = p * f + 1.5252733489988525649e-05
    p = p * f + 1.5403530462514432062e-04
    p = p * f + 1.3333558146789921722e-03
    p = p * f + 9.6181291075883352443e-03
    p = p * f + 5.5504108664819921605e-02
    p = p * f + 2.4022650695910156204e-01
    p = p * f + 6.9314718055994533046e-01
    p = p * f + 1.0
    return as_float(as_bits(p) + (as_bits(shifted) << 52))


@nb.njit(fastmath=FAST, inline="always")
def log(x):
    """log(x) of a positive normal number to 3e-16 (absolute near 1).

    The mantissa m in [0.7, 1.41] by bits, then 2 artanh(s) with s = (m - 1) / (m + 1): 2 s + 2 s^3 p(s^2), p being the polynomial
    of degree 6 nearest to 1/3 + z/5 + z^2/7 + ... (Remez, 5e-18 of the result).
    """
    bits = as_bits(x)
    k = (bits - 4604544271217802189) >> 52  # exponent, counted from sqrt(1/2)
    m = as_float(bits - (k << 52))
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    p = 7.3089406919315180756e-02
    p = p * z + 7.6657981172986236734e-02
    p = p * z + 9.0914466202426646721e-02
    p = p * z + 1.1111105536283593608e-01
    p = p * z + 1.4285714313200197706e-01
    p = p * z + 1.9999999999949222791e-01
    p = p * z + 3.3333333333333348644e-01
    return k * 6.93147180369123816490e-01 + (2.0 * s + (2.0 * s * z * p + k * 1.90821492927058770002e-10))


@inner(cache=True)
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


@inner(cache=True)
def _shift(c, h, k, degree):
    """c(u, v) -> c(u + h, v + k) in place, by repeated synthetic division."""
    top = len(degree)
    for n in range(top + 1):
        for i in range(top):
            for m in range(top - 1, i - 1, -1):
                c[m, n] += h * c[m + 1, n]
    for m in range(top + 1):
        for i in range(top):
            for n in range(top - 1, i - 1, -1):
                c[m, n] += k * c[m, n + 1]


@inner(cache=True, fastmath={"contract"})
def _evaluate(c, u, v, degree):
    """The polynomial c and its derivatives with respect to u and v."""
    top = len(degree)
    value, c_u, c_v = 0.0, 0.0, 0.0
    for i in range(top + 1):
        m = top - i
        row, row_v = c[m, top], 0.0
        for k in range(top):  # Horner's scheme carries the derivative along
            row_v = row_v * v + row
            row = row * v + c[m, top - 1 - k]
        c_u = c_u * u + value
        value = value * u + row
        c_v = c_v * u + row_v
    return value, c_u, c_v


@inner(cache=True)
def _find_peak(o, s, theta, offset_x, offset_y, a, b):
    """Newton's iteration for a = b = 0, leaving a and b expanded about the solution. Returns u, v, found."""
    u = o.x[s] + offset_x
    v = o.y[s] + offset_y
    far = 4.0 * o.step * (o.nx + o.ny)
    found = False
    _fill(o, s, theta, offset_x, offset_y, a, b)
    for _ in range(50):
        a_0, a_u, a_v = _evaluate(a, u, v, o.degree)
        b_0, b_u, b_v = _evaluate(b, u, v, o.degree)
        det = a_u * b_v - a_v * b_u
        if det == 0.0:
            break
        h = (a_v * b_0 - b_v * a_0) / det
        k = (b_u * a_0 - a_u * b_0) / det
        if not (abs(h) + abs(k) < far):
            break
        u += h
        v += k
        if abs(h) + abs(k) <= 1e-9:  # quadratic convergence: the next step would be far below rounding
            found = True
            break
    if not found:
        u = o.x[s]
        v = o.y[s]
    _shift(a, u, v, o.degree)
    _shift(b, u, v, o.degree)
    return u, v, found and a[1, 0] * b[0, 1] - a[0, 1] * b[1, 0] > 0.0


@inner(cache=True, fastmath=FAST)
def _multiply(a, b, conserve, q, d):
    """Coefficients of a^2 + b^2, and of a_u b_v - a_v b_u if flux is conserved, else of 1."""
    q[:] = 0.0
    d[:] = 0.0
    if not conserve:
        d[0, 0] = 1.0
    for m in range(a.shape[0]):
        for n in range(a.shape[1]):
            for i in range(a.shape[0]):
                for j in range(a.shape[1]):
                    q[n + j, m + i] += a[m, n] * a[i, j] + b[m, n] * b[i, j]
                    if conserve and m * j != n * i:
                        d[n + j - 1, m + i - 1] += (m * j - n * i) * a[m, n] * b[i, j]


@inner(cache=True)
def _reach(o, a, b, u, v, radius, core, bounds, stack):
    """Radius R' of the ellipse |J d| <= R' that holds every pixel with |(a, b)| <= R = radius, -1 if D <= 0 where it is <= core.

    With d the distance from the peak, (a, b) = J d + r, and |r| <= rho(|d|) = sum over m + n >= 2 of
    |c_mn| |d|^(m + n). On the ellipse |J d| = R' one has |d| <= R'/s, s the smaller singular value of J, hence
    |(a, b)| >= R' - rho(R'/s) >= R as soon as R' >= R + rho(R'/s). The smallest such R' is a fixed point. What lies
    farther, up to the frame's farthest corner, is beyond R too if that corner is, for s |d| - rho(|d|) is concave.
    Otherwise the frame is surveyed. A pixel is visited if its centre is within the ellipse enlarged by its farthest
    quadrature node.
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


@inner(cache=True)
def _rest(bounds, d):
    """rho at distance d."""
    rest = 0.0
    for k in range(bounds.size - 1, 1, -1):
        rest = (rest + bounds[k]) * d
    return rest * d


@inner(cache=True)
def _survey(o, a, b, u, v, radius, core, bounds, stack):
    """The largest |J d| in the frame where |(a, b)| <= radius, at most; -1 if D <= 0 where |(a, b)| <= core.

    The frame is halved along both axes and so are its parts, unless they lie beyond the radius: at distance r from
    a part's middle (a, b) differs from its value there by at most |J| r + M r^2 / 2, M = sum of |c_mn| k (k - 1) |d|^(k - 2),
    k = m + n. Parts are not halved below a twelfth of the radius; there the middle stands for the part.
    """
    across, along = 0.5 * o.nx * o.step, 0.5 * o.ny * o.step
    stack[0, 0], stack[0, 1], stack[0, 2] = -u, -v, 1.0
    size, reach = 1, 0.0
    while size > 0:
        size -= 1
        t, w, part = stack[size, 0], stack[size, 1], stack[size, 2]
        half_t, half_w = part * across, part * along
        r = math.hypot(half_t, half_w)
        a_0, a_u, a_v = _evaluate(a, t, w, o.degree)
        b_0, b_u, b_v = _evaluate(b, t, w, o.degree)
        here = math.hypot(a_0, b_0)
        far = math.hypot(t, w) + r
        bend = 0.0
        for k in range(bounds.size - 1, 1, -1):
            bend = bend * far + k * (k - 1) * bounds[k]
        if here > radius + r * (math.sqrt(a_u * a_u + a_v * a_v + b_u * b_u + b_v * b_v) + 0.5 * bend * r):
            continue
        if max(half_t, half_w) <= radius / 12.0:
            if here <= core and a_u * b_v - a_v * b_u <= 0.0:
                return -1.0
            for i in range(4):
                t_i, w_i = t + (half_t if i % 2 else -half_t), w + (half_w if i < 2 else -half_w)
                reach = max(reach, math.hypot(a[1, 0] * t_i + a[0, 1] * w_i, b[1, 0] * t_i + b[0, 1] * w_i))
            continue
        for i in range(4):
            stack[size, 0] = t + (0.5 * half_t if i % 2 else -0.5 * half_t)
            stack[size, 1] = w + (0.5 * half_w if i < 2 else -0.5 * half_w)
            stack[size, 2] = 0.5 * part
            size += 1
    return reach


@inner(cache=True)
def locate(o, theta, offset_x, offset_y, sigma, margin, maps):
    """Fill `maps`; False where a source has no image, or the map folds (D <= 0) within two of the PSF's widths of one.

    Windows hold the pixels above the tolerance, and those above it once a source moves by up to `margin` in (a, b).
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
        _multiply(a, b, len(o.d_degree) > 0, maps.q[s], maps.d[s])
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


@inner(cache=True, fastmath=FAST)
def _row(a, b, w, ra, rb, rav, rbv, degree):
    """Coefficients in t = u - u_peak of a, b, a_v and b_v on the row at v = v_peak + w."""
    for m in range(len(degree) + 1):
        pa, pb, pav, pbv = 0.0, 0.0, 0.0, 0.0
        for k in range(a.shape[1]):
            n = a.shape[1] - 1 - k
            pav = pav * w + pa  # Horner's scheme carries the derivative along
            pbv = pbv * w + pb
            pa = pa * w + a[m, n]
            pb = pb * w + b[m, n]
        ra[m], rb[m], rav[m], rbv[m] = pa, pb, pav, pbv


@inner(cache=True, fastmath=FAST)
def _along(c, w, factor, out, degree):
    """Coefficients in t of factor times the polynomial with coefficients c[n, m] of w^n t^m."""
    top = len(degree)
    for m in range(top + 1):
        p = c[top, m]
        for n in range(top):
            p = p * w + c[top - 1 - n, m]
        out[m] = factor * p


@inner(cache=True, fastmath=FAST, error_model="numpy")
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
        alpha, beta, gamma, square = maps.ellipse[s, 0], maps.ellipse[s, 1], maps.ellipse[s, 2], maps.ellipse[s, 3]
        # In columns, row v_peak + w has its chord's middle at middle + slope w, and half the chord squared is half - bend w^2.
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


@inner(cache=True)
def row_starts(fp, pitch):
    """Where every row of pixels begins in a padded, flattened image."""
    at = np.empty(fp.row.size, np.int64)
    for i in range(at.size):
        at[i] = fp.row[i] * pitch + fp.low[i]
    return at


# --- the PSF ----------------------------------------------------------------------------------------------------------
#
# What the loops ask of a PSF of width sigma, norm / sigma^2 left out: `_arguments` fills a row's polynomials, from which `_value`
# makes p at t; from a and b `_slopes` makes p, -p_a and -p_b, and `_bends` -p_a, -p_b, p_aa, p_ab and p_bb.


def of_kind(gaussian: Any, moffat: Any, spline: Any) -> Any:
    """A function that is compiled, into its caller, as the one for the kind of PSF that is its first argument."""
    kinds = {Gaussian: gaussian, Moffat: moffat, Spline: spline}

    def function(psf: Any, *arguments: Any) -> Any:
        raise NotImplementedError("for compiled code")

    @overload(function, inline="always", strict=False)
    def choose(psf: Any, *arguments: Any) -> Any:
        return kinds[psf.instance_class]

    return function


def _gaussian_arguments(psf, maps, s, w, sigma, work, degree, q_degree):
    _along(maps.q[s], w, -0.5 * LOG2_E / (sigma * sigma), work[0], q_degree)


def _moffat_arguments(psf, maps, s, w, sigma, work, degree, q_degree):
    _along(maps.q[s], w, 1.0 / (psf.square * sigma * sigma), work[0], q_degree)
    work[0, 0] += 1.0


def _spline_arguments(psf, maps, s, w, sigma, work, degree, q_degree):
    _row(maps.a[s], maps.b[s], w, work[0], work[2], work[3], work[4], degree)
    for m in range(len(degree) + 1):
        work[0, m] /= psf.pitch * sigma
        work[2, m] /= psf.pitch * sigma


def _gaussian_value(psf, t, r, r2, degree, q_degree):
    top = len(q_degree)
    e = r[top]
    for m in range(top):
        e = e * t + r[top - 1 - m]
    return exp2(e)


def _moffat_value(psf, t, r, r2, degree, q_degree):
    top = len(q_degree)
    e = r[top]
    for m in range(top):
        e = e * t + r[top - 1 - m]
    return exp2(-LOG2_E * psf.beta * log(e))


def _spline_value(psf, t, r, r2, degree, q_degree):
    top = len(degree)
    x, y = r[top], r2[top]
    for m in range(top):
        x = x * t + r[top - 1 - m]
        y = y * t + r2[top - 1 - m]
    i, x = _cell(psf.c.shape[1], x)
    j, y = _cell(psf.c.shape[0], y)
    w0, w1, w2, w3 = _weights(x)
    v0, v1, v2, v3 = _weights(y)
    r0, r1, r2, r3 = _four(psf.c, j, i, w0, w1, w2, w3)
    return v0 * r0 + v1 * r1 + v2 * r2 + v3 * r3


@nb.njit(inline="always")
def _cell(size, x):
    """The first of the four coefficients that matter at x samples from their middle, and where between the middle two x is.

    Beyond the outermost coefficients the spline is zero, as it is among the last four.
    """
    x = min(max(x + 0.5 * (size - 1), 1.0), size - 2.5)
    i = np.int64(x)
    return i - 1, x - i


@nb.njit(inline="always")
def _weights(f):
    """The B-splines of four neighbouring samples, f of a step after the second."""
    g = 1.0 - f
    return g * g * g / 6.0, 2.0 / 3.0 - f * f * (1.0 - 0.5 * f), 2.0 / 3.0 - g * g * (1.0 - 0.5 * g), f * f * f / 6.0


@nb.njit(inline="always")
def _slope_weights(f):
    g = 1.0 - f
    return -0.5 * g * g, f * (1.5 * f - 2.0), -g * (1.5 * g - 2.0), 0.5 * f * f


@nb.njit(inline="always")
def _bend_weights(f):
    g = 1.0 - f
    return g, 3.0 * f - 2.0, 3.0 * g - 2.0, f


@nb.njit(inline="always")
def _four(c, j, i, w0, w1, w2, w3):
    """The weighted sums of four coefficients on four rows."""
    return (
        w0 * c[j, i] + w1 * c[j, i + 1] + w2 * c[j, i + 2] + w3 * c[j, i + 3],
        w0 * c[j + 1, i] + w1 * c[j + 1, i + 1] + w2 * c[j + 1, i + 2] + w3 * c[j + 1, i + 3],
        w0 * c[j + 2, i] + w1 * c[j + 2, i + 1] + w2 * c[j + 2, i + 2] + w3 * c[j + 2, i + 3],
        w0 * c[j + 3, i] + w1 * c[j + 3, i + 1] + w2 * c[j + 3, i + 2] + w3 * c[j + 3, i + 3],
    )


# A Gaussian and a Moffat alike have p_a = -a w p and p_aa = w (kappa w a^2 - 1) p, with w = 1 / sigma^2 and kappa = 1, or
# w = 2 beta / (square sigma^2 + a^2 + b^2) and kappa = 1 + 1 / beta.


@nb.njit(inline="always")
def _gaussian_radial(psf, sigma, a, b):
    inverse = 1.0 / (sigma * sigma)
    return exp2(-0.5 * LOG2_E * inverse * (a * a + b * b)), inverse, 1.0


@nb.njit(inline="always")
def _moffat_radial(psf, sigma, a, b):
    core = psf.square * sigma * sigma
    z = 1.0 / core * (a * a + b * b) + 1.0
    return exp2(-LOG2_E * psf.beta * log(z)), 2.0 * psf.beta / (core * z), 1.0 + 1.0 / psf.beta


@nb.njit(inline="always")
def _radial_bends(p, w, kappa, a, b):
    k = w * p
    h = kappa * w * k
    return k * a, k * b, h * a * a - k, h * a * b, h * b * b - k


def _gaussian_slopes(psf, sigma, a, b):
    p, w, _ = _gaussian_radial(psf, sigma, a, b)
    return p, w * p * a, w * p * b


def _moffat_slopes(psf, sigma, a, b):
    p, w, _ = _moffat_radial(psf, sigma, a, b)
    return p, w * p * a, w * p * b


def _spline_slopes(psf, sigma, a, b):
    k = 1.0 / (psf.pitch * sigma)
    i, x = _cell(psf.c.shape[1], k * a)
    j, y = _cell(psf.c.shape[0], k * b)
    w0, w1, w2, w3 = _weights(x)
    d0, d1, d2, d3 = _slope_weights(x)
    v0, v1, v2, v3 = _weights(y)
    e0, e1, e2, e3 = _slope_weights(y)
    r0, r1, r2, r3 = _four(psf.c, j, i, w0, w1, w2, w3)
    s0, s1, s2, s3 = _four(psf.c, j, i, d0, d1, d2, d3)
    return (
        v0 * r0 + v1 * r1 + v2 * r2 + v3 * r3,
        -k * (v0 * s0 + v1 * s1 + v2 * s2 + v3 * s3),
        -k * (e0 * r0 + e1 * r1 + e2 * r2 + e3 * r3),
    )


def _gaussian_bends(psf, sigma, a, b):
    p, w, kappa = _gaussian_radial(psf, sigma, a, b)
    return _radial_bends(p, w, kappa, a, b)


def _moffat_bends(psf, sigma, a, b):
    p, w, kappa = _moffat_radial(psf, sigma, a, b)
    return _radial_bends(p, w, kappa, a, b)


def _spline_bends(psf, sigma, a, b):
    k = 1.0 / (psf.pitch * sigma)
    i, x = _cell(psf.c.shape[1], k * a)
    j, y = _cell(psf.c.shape[0], k * b)
    w0, w1, w2, w3 = _weights(x)
    d0, d1, d2, d3 = _slope_weights(x)
    h0, h1, h2, h3 = _bend_weights(x)
    v0, v1, v2, v3 = _weights(y)
    e0, e1, e2, e3 = _slope_weights(y)
    g0, g1, g2, g3 = _bend_weights(y)
    r0, r1, r2, r3 = _four(psf.c, j, i, w0, w1, w2, w3)
    s0, s1, s2, s3 = _four(psf.c, j, i, d0, d1, d2, d3)
    q0, q1, q2, q3 = _four(psf.c, j, i, h0, h1, h2, h3)
    return (
        -k * (v0 * s0 + v1 * s1 + v2 * s2 + v3 * s3),
        -k * (e0 * r0 + e1 * r1 + e2 * r2 + e3 * r3),
        k * k * (v0 * q0 + v1 * q1 + v2 * q2 + v3 * q3),
        k * k * (e0 * s0 + e1 * s1 + e2 * s2 + e3 * s3),
        k * k * (g0 * r0 + g1 * r1 + g2 * r2 + g3 * r3),
    )


_arguments = of_kind(_gaussian_arguments, _moffat_arguments, _spline_arguments)
_value = of_kind(_gaussian_value, _moffat_value, _spline_value)
_slopes = of_kind(_gaussian_slopes, _moffat_slopes, _spline_slopes)
_bends = of_kind(_gaussian_bends, _moffat_bends, _spline_bends)

# ----------------------------------------------------------------------------------------------------------------------


@inner(cache=True, fastmath=FAST, error_model="numpy")
def add_source(o, maps, fp, s, sigma, flux, at, out, work):
    """Add source s to `out`, the samples of row i from at[i] on."""
    # What the rows share is taken out of the tuples once, and the loop over pixels stays in this function: a call costs more
    # than a short row.
    d, u, v = maps.d[s], maps.peak[s, 0], maps.peak[s, 1]
    offsets, weights, step, lows, rows, sizes = o.offsets, o.weights, o.step, fp.low, fp.row, fp.size
    middle_u, middle_v = 0.5 * (o.nx - 1), 0.5 * (o.ny - 1)
    r, rd, r2, ramp, psf = work[0], work[1], work[2], o.ramp, o.psf
    d_top = len(o.d_degree)
    norm = flux * psf.norm / (sigma * sigma)
    for i in range(fp.first[s], fp.first[s + 1]):
        w = (rows[i] - middle_v) * step - v
        t_low = (lows[i] - middle_u) * step - u
        row = out[at[i] : at[i] + sizes[i]]
        for y in range(offsets.size):
            _arguments(psf, maps, s, w + offsets[y], sigma, work, o.degree, o.q_degree)
            for x in range(offsets.size):
                _along(d, w + offsets[y], norm * weights[y] * weights[x], rd, o.d_degree)
                t0 = t_low + offsets[x]
                for n in range(row.size):
                    t = t0 + ramp[n]
                    j = rd[d_top]
                    for m in range(d_top):
                        j = j * t + rd[d_top - 1 - m]
                    row[n] += _value(psf, t, r, r2, o.degree, o.q_degree) * abs(j)


@inner(cache=True)
def move(o, maps, s, by_x, by_y):
    """Shift source s along a and b."""
    maps.a[s, 0, 0] -= by_x
    maps.b[s, 0, 0] -= by_y
    _multiply(maps.a[s], maps.b[s], len(o.d_degree) > 0, maps.q[s], maps.d[s])


@inner(cache=True, fastmath=FAST, error_model="numpy")
def add_templates(o, maps, fp, s, sigma, flux, image, along, across, work):
    """Like `add_source` at unit flux, and F X and F Y beside it: X = -p_a |D| is K's derivative as s moves along a."""
    u, v = maps.peak[s, 0], maps.peak[s, 1]
    offsets, weights, step, ramp = o.offsets, o.weights, o.step, o.ramp
    rd, ra, rb, rav, rbv = work[1], work[2], work[3], work[4], work[5]
    d_top, top = len(o.d_degree), len(o.degree)
    for i in range(fp.first[s], fp.first[s + 1]):
        w = (fp.row[i] - 0.5 * (o.ny - 1)) * step - v
        t_low = (fp.low[i] - 0.5 * (o.nx - 1)) * step - u
        first, last = fp.start[i], fp.start[i + 1]
        row, row_a, row_b = image[first:last], along[first:last], across[first:last]
        for y in range(offsets.size):
            _row(maps.a[s], maps.b[s], w + offsets[y], ra, rb, rav, rbv, o.degree)
            for x in range(offsets.size):
                weight = weights[y] * weights[x] * o.psf.norm / (sigma * sigma)
                _along(maps.d[s], w + offsets[y], weight, rd, o.d_degree)
                t0 = t_low + offsets[x]
                for n in range(row.size):
                    t = t0 + ramp[n]
                    j = rd[d_top]
                    for m in range(d_top):
                        j = j * t + rd[d_top - 1 - m]
                    a, b = ra[top], rb[top]
                    for m in range(top):
                        a = a * t + ra[top - 1 - m]
                        b = b * t + rb[top - 1 - m]
                    k, k_a, k_b = _slopes(o.psf, sigma, a, b)
                    row[n] += k * abs(j)
                    row_a[n] += flux * k_a * abs(j)
                    row_b[n] += flux * k_b * abs(j)


@inner(cache=True)
def new_maps(o):
    """Room for the maps of all sources."""
    size = o.x.size
    n, n_q, n_d = len(o.degree) + 1, len(o.q_degree) + 1, len(o.d_degree) + 1
    a, b = np.empty((size, n, n)), np.empty((size, n, n))
    q, d = np.empty((size, n_q, n_q)), np.empty((size, n_d, n_d))
    return Maps(a, b, q, d, np.empty((size, 2)), np.empty((size, 4)), np.empty((size, 2), np.int64))


@inner(cache=True)
def new_work(o):
    """Room for a row's polynomials."""
    return np.empty((7, 2 * len(o.degree) + 1))


@nb.njit(cache=True, nogil=True)
def image(o, theta, offset_x, offset_y, sigma, flux, out):
    """Add all sources to the padded, flattened image `out`. Returns False where a source's map folds."""
    maps = new_maps(o)
    work = new_work(o)
    unfolded = locate(o, theta, offset_x, offset_y, sigma, 0.0, maps)
    for s in range(0, flux.size, BATCH):
        e = s + BATCH
        a, b, q, d = maps.a[s:e], maps.b[s:e], maps.q[s:e], maps.d[s:e]
        part = Maps(a, b, q, d, maps.peak[s:e], maps.ellipse[s:e], maps.rows[s:e])
        fp = footprints(o, part)
        at = row_starts(fp, out.size // o.ny)
        for i in range(part.peak.shape[0]):
            add_source(o, part, fp, i, sigma, flux[s + i], at, out, work)
    return unfolded


@nb.njit(cache=True)
def image_positions(o, theta, offset_x, offset_y, sigma):
    """Where the sources are imaged, shape (s, 2); a source without an image stays at its place."""
    maps = new_maps(o)
    locate(o, theta, offset_x, offset_y, sigma, 0.0, maps)
    return maps.peak


class Basis(NamedTuple):
    """What derivatives are made of: the unit-flux kernel's derivative with respect to single monomials of f and g.

    d K / d theta_k of a source is lever[s, k] times row[k] of the basis: first the monomials u^m v^n of f,
    then those of g, then K itself (flux), then dK/dsigma.
    """

    f: Ints  # (., 2) powers of u and v
    g: Ints
    row: Ints  # (parameters,)
    lever: Floats  # (s, parameters)


@nb.njit(inline="always")
def _polynomial_row(out, ramp, t0, coefficients, degree):
    """out[i] = a polynomial at t = t0 + ramp[i]."""
    top = len(degree)
    for i in range(out.size):
        t = t0 + ramp[i]
        p = coefficients[top]
        for m in range(top):
            p = p * t + coefficients[top - 1 - m]
        out[i] = p


@nb.njit(inline="always")
def _times_polynomial(out, source, factor, ramp, t0, coefficients, degree):
    """out[i] = factor times source[i] times a polynomial at t = t0 + ramp[i]."""
    top = len(degree)
    for i in range(out.size):
        t = t0 + ramp[i]
        p = coefficients[top]
        for m in range(top):
            p = p * t + coefficients[top - 1 - m]
        out[i] = p * factor * source[i]


@nb.njit(inline="always")
def _slopes_row(psf, sigma, weight, p, a, b):
    """From a and b to weight times p, p_a and p_b."""
    for i in range(p.size):
        k, x, y = _slopes(psf, sigma, a[i], b[i])
        p[i], a[i], b[i] = weight * k, -weight * x, -weight * y


@nb.njit(inline="always")
def _bends_row(psf, sigma, weight, along_a, p, a, b):
    """The same for -p_a, or for -p_b, in place of p."""
    for i in range(p.size):
        x, y, xx, xy, yy = _bends(psf, sigma, a[i], b[i])
        p[i] = weight * (x if along_a else y)
        a[i], b[i] = -weight * (xx if along_a else xy), -weight * (xy if along_a else yy)


@nb.njit(inline="always")
def _times_determinant(p, size, signed):
    """From D in `signed` to size = p |D| and p sign(D)."""
    for i in range(p.size):
        size[i] = p[i] * abs(signed[i])
        signed[i] = p[i] if signed[i] > 0.0 else -p[i]


@nb.njit(inline="always")
def _times_absolute(a, b, d):
    for i in range(d.size):
        a[i] *= abs(d[i])
        b[i] *= abs(d[i])


@nb.njit(inline="always")
def _add_widening(out, size, order, along_a, along_b, sigma, ramp, t0, ra, rb, degree):
    """Add dP/dsigma = -(order P + a P_a + b P_b) / sigma, P being homogeneous of degree -order in a, b and sigma."""
    top = len(degree)
    for i in range(out.size):
        t = t0 + ramp[i]
        a, b = ra[top], rb[top]
        for m in range(top):
            a = a * t + ra[top - 1 - m]
            b = b * t + rb[top - 1 - m]
        out[i] -= (order * size[i] + a * along_a[i] + b * along_b[i]) / sigma


@nb.njit(inline="always")
def _add_row_of(out, row):
    for i in range(row.size):
        out[i] += row[i]


@nb.njit(inline="always")
def _powers_row(powers, ramp, u0, n):
    """powers[m] = u^m at u = u0 + ramp[i]."""
    powers[0, :n] = 1.0
    for m in range(1, powers.shape[0]):
        before, row = powers[m - 1], powers[m]
        for i in range(n):
            row[i] = before[i] * (u0 + ramp[i])


@nb.njit(inline="always")
def _add_monomials(basis_powers, v, n, along, first, second, powers, out, start):
    """Rows of the basis from `start` on: B along + B_u first + B_v second for the monomials B = u^m v^q of f (or of g)."""
    for k in range(basis_powers.shape[0]):
        m = basis_powers[k, 0]
        q = basis_powers[k, 1]
        vq = v**q
        by = q * v ** (q - 1) if q > 0 else 0.0
        row, power = out[start + k], powers[m]
        for i in range(n):
            row[i] += power[i] * (vq * along[i] + by * second[i])
        if m > 0:
            bx = m * vq
            lower = powers[m - 1]
            for i in range(n):
                row[i] += bx * lower[i] * first[i]


@inner(cache=True, fastmath=FAST, error_model="numpy")
def basis_row(o, maps, basis, s, j, low, n, sigma, template, out, samples, powers, work):
    """out[:, :n] = the basis of a unit source in n pixels of row j from pixel `low` on.

    An f-term changes a by B, hence p by p_a B and D = a_u b_v - a_v b_u by B_u b_v - B_v b_u; a g-term changes
    b, hence p by p_b B and D by B_v a_u - B_u a_v. With P = weight p and s = sign(D) the rows of `samples` are P, P |D|, s P,
    P_a |D|, P_b |D|, s P b_v, -s P b_u, -s P a_v, s P a_u.

    Template 0 is the kernel K itself. Templates 1 and 2 are its derivatives as the source is shifted along a and along b,
    X = -p_a |D| and Y = -p_b |D|: the same with p replaced by -p_a or by -p_b. The number comes as an np.int64: of a literal one
    this function would be compiled anew.
    """
    ra, rb, rav, rbv, rd, slope = work[0], work[1], work[2], work[3], work[4], work[5]
    ramp, conserve = o.ramp, len(o.d_degree) > 0
    n_f, n_g = basis.f.shape[0], basis.g.shape[0]
    for k in range(out.shape[0]):
        out[k, :n] = 0.0
    order = 2.0 if template == 0 else 3.0
    widens = basis.row.size > 0 and basis.row[-1] == n_f + n_g + 1  # the width is the last parameter, if it is one
    v_row = (j - 0.5 * (o.ny - 1)) * o.step
    u_row = (low - 0.5 * (o.nx - 1)) * o.step
    e, size, signed, along_a, along_b = samples[0, :n], samples[1, :n], samples[2, :n], samples[3, :n], samples[4, :n]
    f_u, f_v, g_u, g_v = samples[5, :n], samples[6, :n], samples[7, :n], samples[8, :n]
    row_k, row_s = out[n_f + n_g, :n], out[n_f + n_g + 1, :n]
    top = len(o.degree)
    slope[:] = 0.0
    for q in range(o.offsets.size):
        v = v_row + o.offsets[q]
        _row(maps.a[s], maps.b[s], v - maps.peak[s, 1], ra, rb, rav, rbv, o.degree)
        _along(maps.d[s], v - maps.peak[s, 1], 1.0, rd, o.d_degree)
        for p in range(o.offsets.size):
            u = u_row + o.offsets[p]
            t = u - maps.peak[s, 0]
            weight = o.weights[q] * o.weights[p] * o.psf.norm / (sigma * sigma)
            _polynomial_row(along_a, ramp, t, ra, o.degree)
            _polynomial_row(along_b, ramp, t, rb, o.degree)
            if template == 0:
                _slopes_row(o.psf, sigma, weight, e, along_a, along_b)
            else:
                _bends_row(o.psf, sigma, weight, template == 1, e, along_a, along_b)
            _polynomial_row(signed, ramp, t, rd, o.d_degree)
            _times_absolute(along_a, along_b, signed)
            _times_determinant(e, size, signed)
            if conserve:
                _times_polynomial(f_u, signed, 1.0, ramp, t, rbv, o.degree)
                _times_polynomial(g_u, signed, -1.0, ramp, t, rav, o.degree)
                for m in range(top):
                    slope[m] = -(m + 1) * rb[m + 1]
                _times_polynomial(f_v, signed, 1.0, ramp, t, slope, o.degree)
                for m in range(top):
                    slope[m] = (m + 1) * ra[m + 1]
                _times_polynomial(g_v, signed, 1.0, ramp, t, slope, o.degree)
            else:
                samples[5:] = 0.0
            _add_row_of(row_k, size)
            if widens:
                _add_widening(row_s, size, order, along_a, along_b, sigma, ramp, t, ra, rb, o.degree)
            _powers_row(powers, ramp, u, n)
            _add_monomials(basis.f, v, n, along_a, f_u, f_v, powers, out, 0)
            _add_monomials(basis.g, v, n, along_b, g_u, g_v, powers, out, n_f)


@inner(cache=True, fastmath=FAST)
def add_jacobian_rows(o, maps, fp, basis, flux, sigma, first, last, out):
    """Add the derivatives of rows first..last-1 to out (parameters, rows, padded row)."""
    work = new_work(o)
    width = out.shape[2]
    rows = np.empty((basis.f.shape[0] + basis.g.shape[0] + 2, width))
    samples = np.empty((9, width))
    powers = np.empty((len(o.degree) + 1, width))
    for s in range(o.x.size):
        if maps.rows[s, 0] >= last or maps.rows[s, 1] <= first:
            continue
        for p in range(fp.first[s], fp.first[s + 1]):
            j, low, n = fp.row[p], fp.low[p], fp.size[p]
            if not first <= j < last:
                continue
            basis_row(o, maps, basis, s, j, low, n, sigma, np.int64(0), rows, samples, powers, work)
            for k in range(basis.row.size):
                c = flux[s] * basis.lever[s, k]
                if c != 0.0:
                    source = rows[basis.row[k]]
                    target = out[k, j - first, low : low + n]
                    for i in range(n):
                        target[i] += c * source[i]


@nb.njit(cache=True, nogil=True)
def jacobian(o, theta, sigma, flux, basis, out):
    """d image / d parameters into out (parameters, ny, padded row)."""
    maps = new_maps(o)
    locate(o, theta, 0.0, 0.0, sigma, 0.0, maps)
    add_jacobian_rows(o, maps, footprints(o, maps), basis, flux, sigma, 0, o.ny, out)
