"""The next term of the integral over the fluxes after Laplace's, source by source and pair by pair.

Symbols are those of `fluxes.py` and `gradient.py`; T = F K, rho = C / W. As a function of w = log F
let f be log L + log p, H = -f'' at the maximum and S = H^-1. To first order in the inverse number
of photons

    log integral = Laplace + c,   c = 1/8 f_ijkl S_ij S_kl + 1/8 v_i S_ij v_j + 1/12 f_ijk f_lmn
    S_il S_jm S_kn,   v_i = f_ijk S_jk.

Poisson counts have the derivatives n/mu - 1, -W, 2C and -6 W rho^2 in mu with rho = 1/mu; so have
any counts whose distribution is near a shifted Poisson's, and Gaussian ones with rho = 0. With
the sums N_ab = sum_p W rho^(a+b-2) T_s^a T_t^b over the pixels of sources s and t, the prior adding
its shape to N_20, N_30, N_40 and N_02, N_03, N_04, the derivatives in w_s and w_t are

    H_ss = N_20, H_st = N_11, f_sss = 2 N_30 - 3 N_20, f_sst = 2 N_21 - N_11, f_ssss = 12 N_30 -
    6 N_40 - 7 N_20, f_ssst = 6 N_21 - 6 N_31 - N_11, f_sstt = 2 N_21 + 2 N_12 - 6 N_22 - N_11.

For many sources c is expanded in groups of one and two, the others staying at the maximum: the sum
of c_s over the sources and of c_st - c_s - c_t over the pairs that overlap. What this leaves out
needs three sources on one place. Shifts of the sources are not expanded, and bright sources are
left out: c is of the order of 1/H.

Its derivatives by N_ab, called a_k = dc/dN_k0 and b_ab, give those by anything, as d(W rho^m) = -(m
+ 2) W rho^(m+1) dmu: by mu and by T_s they are, with X = rho T,

    -C sum_s T_s^2 (2 a_2 + 3 a_3 X_s + 4 a_4 X_s^2) + the pairs',
    W T_s (2 a_2 + 3 a_3 X_s + 4 a_4 X_s^2) + the pairs'.

References
----------
L. Tierney, J. B. Kadane (1986), Journal of the American Statistical Association 81, 82; Z. Shun, P.
McCullagh (1995), Journal of the Royal Statistical Society B 57, 749, equation 3: the term c.
"""

from typing import NamedTuple

import numpy as np

from bayesfred._typing import Floats, Ints
from bayesfred.imaging.kernels.compilation import inner, leaf, shared
from bayesfred.imaging.kernels.fastmath import REDUCE
from bayesfred.model.kernels.clusters import copy, run_end, touch

OVERLAP = 1e-4  # the least |H_st| / sqrt(H_ss H_tt) that counts
POWERS = ((1, 1), (2, 1), (1, 2), (3, 1), (2, 2), (1, 3))  # of the mixed sums N


class Pixels(NamedTuple):
    """Pixels of a frame or of a part of it."""

    weight: Floats  # W
    ratio: Floats  # rho
    at: Ints  # where the footprints' rows begin


class Slopes(NamedTuple):
    """What the derivatives of a cluster's c are made of."""

    own: Floats  # (m, 3) a_2, a_3, a_4
    first: Ints  # (pairs,) places of the two sources in the cluster
    second: Ints
    mixed: Floats  # (pairs, 6) b_11, b_21, b_12, b_31, b_22, b_13


@leaf(fastmath=REDUCE)
def own_run(light, weight, ratio, sums):
    """Add the samples of a source's T to N_20, N_30 and N_40."""
    n2, n3, n4 = sums
    for k in range(light.size):
        x, part = ratio[k] * light[k], weight[k] * light[k] * light[k]
        n2 += part
        n3 += part * x
        n4 += part * x * x
    return n2, n3, n4


@leaf(fastmath=REDUCE)
def shared_run(left, right, weight, ratio, sums):
    """Add the samples of two sources' T to N_11, N_21, N_12, N_31, N_22 and N_13."""
    n11, n21, n12, n31, n22, n13 = sums
    for k in range(left.size):
        x, y, part = ratio[k] * left[k], ratio[k] * right[k], weight[k] * left[k] * right[k]
        n11 += part
        n21 += part * x
        n12 += part * y
        n31 += part * x * x
        n22 += part * x * y
        n13 += part * y * y
    return n11, n21, n12, n31, n22, n13


@inner()
def _fill_own(touching, s, flux, pixels, out):
    """N of source s; its template is one of unit flux."""
    fp, stamp, at, sums = touching.footprints, touching.stamps[0], pixels.at, (0.0, 0.0, 0.0)
    i = fp.first[s]
    while i < fp.first[s + 1]:
        end = run_end(fp, i, fp.first[s + 1], at)
        first, last = fp.start[i], fp.start[end]
        here = slice(at[i], at[i] + last - first)
        sums = own_run(stamp[first:last], pixels.weight[here], pixels.ratio[here], sums)
        i = end
    for k in range(3):
        out[k] = sums[k] * flux ** (k + 2)


@inner()
def _fill_shared(touching, s, t, fluxes, pixels, out):
    """N of sources s and t."""
    fp, boxes, stamp, at = touching.footprints, touching.boxes, touching.stamps[0], pixels.at
    sums = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    for j in range(max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])):
        p, q = fp.first[s] + j - boxes[s, 0], fp.first[t] + j - boxes[t, 0]
        a = max(fp.low[p], fp.low[q])
        b = min(fp.low[p] + fp.size[p], fp.low[q] + fp.size[q])
        if a < b:
            ps, qs, here = fp.start[p] - fp.low[p], fp.start[q] - fp.low[q], at[p] - fp.low[p]
            weight, ratio = pixels.weight[here + a : here + b], pixels.ratio[here + a : here + b]
            sums = shared_run(stamp[ps + a : ps + b], stamp[qs + a : qs + b], weight, ratio, sums)
    for k in range(6):
        out[k] = sums[k] * fluxes[s] ** POWERS[k][0] * fluxes[t] ** POWERS[k][1]


@inner()
def single(own, shape, slopes):
    """c of one source from its N; fills `slopes`, shape (3,)."""
    h, n3, n4 = own[0] + shape, own[1] + shape, own[2] + shape
    f3, f4 = 2.0 * n3 - 3.0 * h, 12.0 * n3 - 6.0 * n4 - 7.0 * h
    by_3, by_4 = 5.0 * f3 / (12.0 * h**3), 1.0 / (8.0 * h**2)
    by_h = -f4 / (4.0 * h**3) - 5.0 * f3**2 / (8.0 * h**4)
    slopes[0] = by_h - 3.0 * by_3 - 7.0 * by_4
    slopes[1] = 2.0 * by_3 + 12.0 * by_4
    slopes[2] = -6.0 * by_4
    return by_4 * f4 + 0.5 * by_3 * f3


@inner()
def pair(one, other, mixed, shape, slopes):
    """c of two sources from their N; fills `slopes`, shape (12,), in the order of the arguments."""
    h0, h1, h2 = one[0] + shape, mixed[0], other[0] + shape
    p3, p4, q3, q4 = one[1] + shape, one[2] + shape, other[1] + shape, other[2] + shape
    m21, m12, m31, m22, m13 = mixed[1], mixed[2], mixed[3], mixed[4], mixed[5]
    f0, f1, f2, f3 = 2.0 * p3 - 3.0 * h0, 2.0 * m21 - h1, 2.0 * m12 - h1, 2.0 * q3 - 3.0 * h2
    g0, g4 = 12.0 * p3 - 6.0 * p4 - 7.0 * h0, 12.0 * q3 - 6.0 * q4 - 7.0 * h2
    g1, g3 = 6.0 * m21 - 6.0 * m31 - h1, 6.0 * m12 - 6.0 * m13 - h1
    g2 = 2.0 * m21 + 2.0 * m12 - 6.0 * m22 - h1
    d = h0 * h2 - h1 * h1
    a, b, d = h2 / d, -h1 / d, h0 / d  # S
    v0, v1 = a * f0 + 2.0 * b * f1 + d * f2, a * f1 + 2.0 * b * f2 + d * f3
    r0, r1 = a * v0 + b * v1, b * v0 + d * v1
    # u = f_ijk raised by S on all indices, e_ij = f_ikl f_jmn S_km S_ln
    u0 = a * a * a * f0 + 3.0 * a * a * b * f1 + 3.0 * a * b * b * f2 + b * b * b * f3
    u1 = a * a * b * f0 + (a * a * d + 2.0 * a * b * b) * f1
    u1 += (2.0 * a * b * d + b * b * b) * f2 + b * b * d * f3
    u2 = a * b * b * f0 + (2.0 * a * b * d + b * b * b) * f1
    u2 += (a * d * d + 2.0 * b * b * d) * f2 + b * d * d * f3
    u3 = b * b * b * f0 + 3.0 * b * b * d * f1 + 3.0 * b * d * d * f2 + d * d * d * f3
    k00, k01, k10, k11 = a * f0 + b * f1, a * f1 + b * f2, b * f0 + d * f1, b * f1 + d * f2
    l00, l01, l10, l11 = a * f1 + b * f2, a * f2 + b * f3, b * f1 + d * f2, b * f2 + d * f3
    e0 = k00 * k00 + 2.0 * k01 * k10 + k11 * k11
    e1 = k00 * l00 + k01 * l10 + k10 * l01 + k11 * l11
    e2 = l00 * l00 + 2.0 * l01 * l10 + l11 * l11
    # by the fourth derivatives, the third ones and S
    y0, y1, y2 = 0.125 * a * a, 0.5 * a * b, 0.25 * a * d + 0.5 * b * b
    y3, y4 = 0.5 * b * d, 0.125 * d * d
    x0, x1 = 0.25 * a * r0 + u0 / 6.0, 0.5 * b * r0 + 0.25 * a * r1 + 0.5 * u1
    x2, x3 = 0.25 * d * r0 + 0.5 * b * r1 + 0.5 * u2, 0.25 * d * r1 + u3 / 6.0
    s0 = 0.25 * (a * g0 + 2.0 * b * g1 + d * g2 + r0 * f0 + r1 * f1 + e0) + 0.125 * v0 * v0
    s1 = 0.25 * (a * g1 + 2.0 * b * g2 + d * g3 + r0 * f1 + r1 * f2 + e1) + 0.125 * v0 * v1
    s2 = 0.25 * (a * g2 + 2.0 * b * g3 + d * g4 + r0 * f2 + r1 * f3 + e2) + 0.125 * v1 * v1
    # by H: -S s S
    t0 = -(a * a * s0 + 2.0 * a * b * s1 + b * b * s2)
    t1 = -(a * b * s0 + (a * d + b * b) * s1 + b * d * s2)
    t2 = -(b * b * s0 + 2.0 * b * d * s1 + d * d * s2)
    slopes[0], slopes[3] = t0 - 3.0 * x0 - 7.0 * y0, t2 - 3.0 * x3 - 7.0 * y4
    slopes[1], slopes[4] = 2.0 * x0 + 12.0 * y0, 2.0 * x3 + 12.0 * y4
    slopes[2], slopes[5] = -6.0 * y0, -6.0 * y4
    slopes[6] = 2.0 * t1 - x1 - x2 - y1 - y2 - y3
    slopes[7], slopes[8] = 2.0 * x1 + 6.0 * y1 + 2.0 * y2, 2.0 * x2 + 6.0 * y3 + 2.0 * y2
    slopes[9], slopes[10], slopes[11] = -6.0 * y1, -6.0 * y2, -6.0 * y3
    fourth = y0 * g0 + y1 * g1 + y2 * g2 + y3 * g3 + y4 * g4
    third = f0 * u0 + 3.0 * f1 * u1 + 3.0 * f2 * u2 + f3 * u3
    return fourth + 0.125 * (v0 * r0 + v1 * r1) + third / 12.0


@inner()
def _both(touching, s, t):
    """Whether two sources may share pixels, and are faint."""
    return touching.faint[s] and touching.faint[t] and touch(touching.boxes, s, t)


@shared()
def expand(touching, group, fluxes, shape, pixels):
    """The sum of c over the faint sources of a cluster, and its slopes."""
    members, size = group.members, touching.stamps.shape[0]
    count = 0
    for i in range(members.size):
        for k in range(group.lead[i * size] // size, i):
            count += _both(touching, members[i], members[k])
    own, slopes = np.empty((members.size, 3)), np.empty((members.size, 3))
    first, second = np.empty(count, np.int64), np.empty(count, np.int64)
    mixed, by = np.empty((count, 6)), np.empty(12)
    alone = np.empty((members.size, 4))  # c of one source with its slopes
    value, count = 0.0, 0
    for i in range(members.size):
        s = members[i]
        slopes[i], alone[i] = 0.0, 0.0
        if not touching.faint[s]:
            continue
        _fill_own(touching, s, fluxes[s], pixels, own[i])
        alone[i, 0] = single(own[i], shape, alone[i, 1:])
        value += alone[i, 0]
        copy(alone[i, 1:], slopes[i])
        for k in range(group.lead[i * size] // size, i):
            t = members[k]
            if _both(touching, s, t):
                _fill_shared(touching, s, t, fluxes, pixels, mixed[count])
                if related(own[i, 0], own[k, 0], mixed[count, 0], shape):
                    value += pair(own[i], own[k], mixed[count], shape, by)
                    value -= alone[i, 0] + alone[k, 0]
                    for n in range(3):
                        slopes[i, n] += by[n] - alone[i, 1 + n]
                        slopes[k, n] += by[3 + n] - alone[k, 1 + n]
                    copy(by[6:], mixed[count])
                    first[count], second[count] = i, k
                    count += 1
    return value, Slopes(slopes, first[:count], second[:count], mixed[:count])


@inner()
def related(one, other, mixed, shape):
    """Whether two sources overlap so much that it counts."""
    return mixed * mixed > OVERLAP * OVERLAP * (one + shape) * (other + shape)


@shared()
def add_slopes(touching, group, fluxes, pixels, slopes, out):
    """Add dc/dmu over C to an image, and dc/dT over W to an array of shape (samples,)."""
    h, light = out
    fp, boxes, stamp = touching.footprints, touching.boxes, touching.stamps[0]
    members, ratio, at = group.members, pixels.ratio, pixels.at
    for i in range(members.size):
        s, a2, a3, a4 = members[i], slopes.own[i, 0], slopes.own[i, 1], slopes.own[i, 2]
        if not touching.faint[s]:
            continue
        for p in range(fp.first[s], fp.first[s + 1]):
            for k in range(fp.size[p]):
                t = fluxes[s] * stamp[fp.start[p] + k]
                x = ratio[at[p] + k] * t
                slope = t * (2.0 * a2 + x * (3.0 * a3 + x * 4.0 * a4))
                h[at[p] + k] -= t * slope
                light[fp.start[p] + k] += slope
    for e in range(slopes.first.size):
        s, t = members[slopes.first[e]], members[slopes.second[e]]
        b = slopes.mixed[e]
        for j in range(max(boxes[s, 0], boxes[t, 0]), min(boxes[s, 1], boxes[t, 1])):
            p, q = fp.first[s] + j - boxes[s, 0], fp.first[t] + j - boxes[t, 0]
            begin = max(fp.low[p], fp.low[q])
            end = min(fp.low[p] + fp.size[p], fp.low[q] + fp.size[q])
            for u in range(begin, end):
                m, n, pixel = (
                    fp.start[p] + u - fp.low[p],
                    fp.start[q] + u - fp.low[q],
                    at[p] + u - fp.low[p],
                )
                one, other = fluxes[s] * stamp[m], fluxes[t] * stamp[n]
                x, y = ratio[pixel] * one, ratio[pixel] * other
                third, fourth = b[1] * x + b[2] * y, b[3] * x * x + b[4] * x * y + b[5] * y * y
                h[pixel] -= one * other * (2.0 * b[0] + 3.0 * third + 4.0 * fourth)
                by_x = b[1] * x + 2.0 * b[3] * x * x + b[4] * x * y
                by_y = b[2] * y + 2.0 * b[5] * y * y + b[4] * x * y
                light[m] += other * (b[0] + third + fourth + by_x)
                light[n] += one * (b[0] + third + fourth + by_y)
