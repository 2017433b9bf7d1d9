"""Photons counted with Gaussian read noise: the convolution of the two distributions.

A pixel's n = k + e has k ~ Poisson(mu) and e ~ N(0, r^2), so that with theta = log(mu)

    p(n | mu) = sum_k Poisson(k; mu) N(n - k; r^2) = exp(-mu - n^2 / 2 r^2 + g(theta + n / r^2)).

The function g is the logarithm of sum_k exp(k t - k^2 / 2 r^2) / k!. Its first three derivatives
G1, G2, G3 are the cumulants of k given n. The score is G1 / mu - 1, the weight W = -d score / d mu
is (G1 - G2) / mu^2, and C = -1/2 dW / d mu is (G3 - 3 G2 + 2 G1) / 2 mu^3. As a function of mu all
zeros of exp(g) are real and negative, so log p is concave in mu.

Read noise below 1: the sum itself. Of the k around n, `BELOW` and `ABOVE` on either side are taken.
The ratio of successive terms is exp((n - k - 1/2) / r^2) mu / (k + 1). So in units of the term at n
the sum is a polynomial in mu, with a common denominator that depends on n alone, and one in 1 / mu.
Within 6 standard deviations of the mean the error of log p is below 2e-8, and within 15 below 1.5:
there n is so far above a small mean that the likely k are out of reach.

Read noise from 1 on: tilting by exp(s n) turns the distribution into one of the same kind with mean
y = mu exp(s). If s is chosen so that the tilted mean of n is n itself,

    y + r^2 log(y / mu) = n,    log p = y - mu + s (r^2 s / 2 - n) + log phi(y),    s = log(y / mu),

without approximation, where phi(y) is the density of Poisson(y) + N(0, r^2) at its mean. With v = y
+ r^2, q = 1 / v and rho = y / v the saddlepoint expansion of phi begins

    log phi = -1/2 log(2 pi v) + q (rho / 8 - 5 rho^2 / 24) + ...,

and `CORRECTION` is a polynomial that goes on to q^3. It was fitted to the sum, from which it
differs by less than 1e-5 for any y. The mean is y = r^2 omega(log(mu / r^2) + n / r^2), where omega
+ log omega = x. A rough omega gives s to 2e-3, for which the digits of float32 suffice, and a step
of Newton's method with its second-order term makes that 1e-8.

References
----------
D. L. Snyder, C. W. Helstrom, A. D. Lanterman, M. Faisal, R. L. White (1995), Journal of the Optical
Society of America A 12, 272: saddlepoint approximation for photon counts with read-out noise.
H. E. Daniels (1954), Annals of Mathematical Statistics 25, 631: saddlepoint approximations.
R. M. Corless, D. J. Jeffrey (2002), LNCS 2385, 76: the Wright omega function.
"""

import math
from typing import Any

import numpy as np
from numba import types
from numba.extending import overload
from scipy.special import gammaln

from bayesfred._typing import Floats
from bayesfred.imaging.kernels.compilation import inner
from bayesfred.imaging.kernels.fastmath import FAST, LOG2_E, exp2, log, split_single

BELOW, ABOVE = 8, 7  # terms of the sum on either side of n, see `photon_sum`
WIDE = 1.0  # variance of the read noise from which on the saddlepoint expansion serves
LEAST = 1e-30  # stands for smaller expected counts, whose powers must not underflow
STEEPEST = 1e30  # of the ratios of successive terms
MOST = 1e75  # of the sum in units of its term at n: four of them are multiplied
NEGLIGIBLE = 1e-25  # of successive terms, whose products shall not become denormal numbers
FARTHEST = 35.0  # exponents of a step's factors: smaller ones than exp(-35) change no sum
SINGLE = np.float32  # serves what is rough anyway
LEAST_SINGLE = SINGLE(1e-37)  # of float32 numbers that are normal

# log phi + 1/2 log(2 pi v): coefficients of q^i rho^j, a row for i = 1, 2, 3, from j = 1 on
CORRECTION = (
    (1 / 8, -5 / 24),
    (-0.01966183926947379, 0.22304878295513086, -0.5170116244823475, 0.3179110858392214),
    (0.0011830114308505552, -0.08585417212460593, 0.6067678293230436, -2.779207981131074,
     16.007686898374327, -56.830514686197134, 100.23868418598953, -84.27288563281161,
     27.13986351939822),
)  # fmt: skip


def _correction_table() -> Floats:
    """The coefficients of q^i tau^j, tau = 1 - rho, times (i + j)^n: shape (n, i, j)."""
    out = np.zeros((4, 3, 10))
    for i, row in enumerate(CORRECTION):
        in_tau = np.polynomial.Polynomial([0.0, *row])(np.polynomial.Polynomial([1.0, -1.0])).coef
        for n in range(4):
            power = np.arange(in_tau.size, dtype=np.float64) + (i + 1)
            out[n, i, : in_tau.size] = np.asarray(in_tau, dtype=float) * power**n
    return out


CORRECTIONS = _correction_table()


@inner(fastmath=FAST, forceinline=True)
def _correct(n, q, tau):
    """(q d/dq)^n of the correction, at constant r."""
    total = 0.0
    for i in range(2, -1, -1):
        row = 0.0
        for j in range(9, -1, -1):
            row = row * tau + CORRECTIONS[n, i, j]
        total = (total + row) * q
    return total


@inner(fastmath=FAST, forceinline=True)
def _exp(x):
    """exp(x); not inlined before its own rules of arithmetic hold, see `fastmath.FAST`."""
    return exp2(x * LOG2_E)


@inner(fastmath=FAST, forceinline=True)
def nearest(n):
    """The photon number that terms of the sum are relative to."""
    return max(np.rint(n), 0.0)


@inner(fastmath=FAST, forceinline=True)
def _factor(excess, inverse):
    return _exp(min(max((excess - 0.5) * inverse, -FARTHEST), FARTHEST))


@inner(fastmath=FAST, forceinline=True)
def steps(n, inverse):
    """Ratios of the Gaussians at one photon more, and at one less, to that at the nearest.

    `inverse` is 1 / r^2. Each step farther multiplies the ratio of its Gaussians by their product
    q = exp(-1 / r^2). Below zero, where no step leads to less, the second serves q alone.
    """
    excess = n - nearest(n)
    return _factor(excess, inverse), _factor(-excess, inverse)


@inner(fastmath=FAST, forceinline=True)
def _above(k, step, series, common):
    common *= k
    return common + step * series, common


@inner(fastmath=FAST, forceinline=True)
def _sum_above(k, a, q):
    """(k + 1) ... (k + 7) (1 + a / (k + 1) (1 + a q / (k + 2) (1 + ...))), and the product."""
    q2, a2 = q * q, a * q
    q4, a3, a4 = q2 * q2, a * q2, a2 * q2
    series, common = _above(k + 7.0, a3 * q4, 1.0, 1.0)
    series, common = _above(k + 6.0, a2 * q4, series, common)
    series, common = _above(k + 5.0, a * q4, series, common)
    series, common = _above(k + 4.0, a4, series, common)
    series, common = _above(k + 3.0, a3, series, common)
    series, common = _above(k + 2.0, a2, series, common)
    return _above(k + 1.0, a, series, common)


@inner(fastmath=FAST, forceinline=True)
def _sum_below(k, b, q):
    """b k (1 + b q (k - 1) (1 + ...))."""
    q2, b2 = q * q, b * q
    q4, b3, b4 = q2 * q2, b * q2, b2 * q2
    series = 1.0 + b4 * q4 * (k - 7.0)
    series = 1.0 + series * (b3 * q4 * (k - 6.0))
    series = 1.0 + series * (b2 * q4 * (k - 5.0))
    series = 1.0 + series * (b * q4 * (k - 4.0))
    series = 1.0 + series * (b4 * (k - 3.0))
    series = 1.0 + series * (b3 * (k - 2.0))
    series = 1.0 + series * (b2 * (k - 1.0))
    return series * (b * k)


@inner(fastmath=FAST, forceinline=True)
def photon_sum(k, mu, up, down):
    """The sum, in units of its term at k photons."""
    q = up * down
    above, common = _sum_above(k, up * mu, q)
    return min(_sum_below(k, min(down / mu, STEEPEST), q) + above / common, MOST)


@inner(fastmath=FAST, forceinline=True)
def _sum_density(n, mu, variance):
    """log p of the sum, less what depends on n alone."""
    k, mu = nearest(n), max(mu, LEAST)
    up, down = steps(n, 1.0 / variance)
    return k * log(mu) - mu + log(photon_sum(k, mu, up, down))


@inner(fastmath=FAST, forceinline=True)
def _derivatives(mu, first, second, third):
    """Score, weight and C from the cumulants of the photon number given n."""
    inverse = 1.0 / mu
    weight = max(first - second, 0.0) * inverse * inverse
    curve = 0.5 * (third - 3.0 * second + 2.0 * first) * inverse * inverse * inverse
    return first * inverse - 1.0, weight, curve


@inner(fastmath=FAST, forceinline=True)
def _sum_derivatives(n, mu, variance):
    """Score, weight and C of the sum."""
    k, mu = nearest(n), max(mu, LEAST)
    up, down = steps(n, 1.0 / variance)
    q = up * down
    total, photons, first, second, third = 1.0, k, 0.0, 0.0, 0.0
    a, power, step, fixed = max(up * mu, NEGLIGIBLE), 1.0, 1.0, 1.0
    for j in range(1, ABOVE + 1):
        power *= a / (k + j)
        term = power * fixed
        step *= q
        fixed = max(fixed * step, NEGLIGIBLE)
        total += term
        photons += (k + j) * term
        first += j * term
        second += j * j * term
        third += j * j * j * term
    a, power, step, fixed = max(down, NEGLIGIBLE) / mu, 1.0, 1.0, 1.0
    for j in range(1, BELOW + 1):
        power *= a * (k - j + 1.0)
        term = power * fixed
        step *= q
        fixed = max(fixed * step, NEGLIGIBLE)
        total += term
        photons += (k - j) * term
        first -= j * term
        second += j * j * term
        third -= j * j * j * term
    inverse = 1.0 / total
    m1, m2, m3 = first * inverse, second * inverse, third * inverse
    third = m3 - m1 * (3.0 * m2 - 2.0 * m1 * m1)
    return _derivatives(mu, photons * inverse, m2 - m1 * m1, third)


@inner(fastmath=FAST, forceinline=True)
def rough_log(x):
    """log(x) of a positive normal float32 to 1e-4, without a division; see `fastmath.log`."""
    k, m = split_single(x)
    m -= SINGLE(1.0)
    p = SINGLE(-0.50246549) + m * (SINGLE(0.35871218) - m * SINGLE(0.22848254))
    return k * SINGLE(math.log(2.0)) + m * (SINGLE(0.99935223) + m * p)


@inner(fastmath=FAST, forceinline=True)
def rough_omega(x):
    """omega(x) within 7 % where it is above 0.05: a square and a line."""
    u = min(max(x, SINGLE(-6.0)), SINGLE(3.0))
    root = SINGLE(0.75107911) + u * (SINGLE(0.21642757) + u * SINGLE(0.01549135))
    return max(root * root, SINGLE(0.93841083) * x - SINGLE(0.89488641))


@inner(fastmath=FAST, forceinline=True)
def rough_tilt(slope, level, x, w):
    """The tilt to 2e-3: a step of Newton's method from the rough omega w.

    `slope` is n / r^2, `level` log(w r^2 / mu) and `x` what x - log(w) - w is. Where omega is large
    its logarithm tells s, and not n / r^2 - omega, whose digits cancel.
    """
    change = x / (SINGLE(1.0) + w)  # of log(omega), to first order
    large = level + change * (SINGLE(1.0) - change * (SINGLE(0.5) - change * SINGLE(1 / 3)))
    return large if w > SINGLE(0.1) else slope - max(w + w * change, SINGLE(0.0))


@inner(fastmath=FAST, forceinline=True)
def tilted_mean(mu, s):
    """y of a tilt s."""
    return mu * _exp(s)


@inner(fastmath=FAST, forceinline=True)
def improved(n, mu, variance, s, y):
    """log p without log phi from rough s and y, and s, y and v = y + r^2 to 1e-11.

    log p is stationary in s, so that the change of s counts by its square.
    """
    total, tilt = y + variance, variance * s
    q = 1.0 / total
    less = y + tilt - n
    change, rho = less * q, y * q
    third = change * rho * (1.0 / 6.0 + change * (0.125 * rho - 1.0 / 24.0))
    term = y - mu + s * (0.5 * tilt - n) - less * change * (0.5 + third)
    change *= 1.0 + change * rho * (0.5 + change * (0.5 * rho - 1.0 / 6.0))
    less -= variance * change  # y + r^2 s = n
    return term, s - change, y - less, total - less


@inner(fastmath=FAST, forceinline=True)
def correction(v, variance):
    """log phi + 1/2 log(2 pi v)."""
    q = 1.0 / v
    rho = 1.0 - variance * q
    one, two, three = CORRECTION
    total = three[8]
    for j in range(7, -1, -1):
        total = total * rho + three[j]
    by = two[3]
    for j in range(2, -1, -1):
        by = by * rho + two[j]
    return rho * q * (one[0] + rho * one[1] + q * (by + q * total))


@inner(fastmath=FAST, forceinline=True)
def _tilt(n, mu, variance):
    """log p without log phi, and s, y and v to 1e-11."""
    inverse = SINGLE(1.0 / variance)
    slope = SINGLE(n) * inverse
    level = rough_log(max(SINGLE(mu) * inverse, LEAST_SINGLE))
    w = rough_omega(slope + level)
    log_w = rough_log(w)
    s = float(rough_tilt(slope, log_w - level, slope + level - log_w - w, w))
    return improved(n, mu, variance, s, tilted_mean(mu, s))


@inner(fastmath=FAST, forceinline=True)
def _tilted_density(n, mu, variance):
    """log p of the saddlepoint expansion, less -1/2 log(2 pi)."""
    term, _, _, v = _tilt(n, max(mu, LEAST), variance)
    return term - 0.5 * log(v) + correction(v, variance)


@inner(fastmath=FAST, forceinline=True)
def _tilted_derivatives(n, mu, variance):
    """Score, weight and C of the saddlepoint expansion.

    The cumulants of the photon number given n are derivatives by log mu. With L that derivative
    and M = q d/dq, L y = y tau and L = -rho tau M for functions of q.
    """
    mu = max(mu, LEAST)
    _, s, y, v = _tilt(n, mu, variance)
    y = mu * _exp(s - (y + variance * s - n) / v)  # to rounding
    q = 1.0 / (y + variance)
    tau, rho = variance * q, y * q
    m1, m2, m3 = 0.5 + _correct(1, q, tau), _correct(2, q, tau), _correct(3, q, tau)
    by = -rho * tau
    by1 = -rho * tau * tau * (tau - rho)
    by2 = -rho * tau * tau * tau * (1.0 - rho * (7.0 - 8.0 * rho))
    second = y * tau + by1 * m1 + by * by * m2
    third = y * tau * tau * tau + by2 * m1 + 3.0 * by * by1 * m2 + by * by * by * m3
    return _derivatives(mu, y + by * m1, second, third)


def at(values: Any, p: Any) -> Any:
    """Pixel p of an array, or the number that all pixels have."""
    raise NotImplementedError("for compiled code")


@overload(at, inline="always", strict=False)
def _choose_at(values: Any, p: Any) -> Any:
    if isinstance(values, types.Array):
        return lambda values, p: values[p]
    return lambda values, p: values


def _choice(few: Any, many: Any, mixed: Any) -> Any:
    """A function of (kind, n, mu, variance) that the length of the tuple `kind` chooses."""

    def function(kind: Any, n: Any, mu: Any, variance: Any) -> Any:
        raise NotImplementedError("for compiled code")

    @overload(function, inline="always", strict=False)
    def choose(kind: Any, n: Any, mu: Any, variance: Any) -> Any:
        return (few, many, mixed)[len(kind)]

    return function


def _density_few(kind, n, mu, variance):
    return _sum_density(n, mu, variance)


def _density_many(kind, n, mu, variance):
    return _tilted_density(n, mu, variance)


def _density_mixed(kind, n, mu, variance):
    few = _sum_density(n, mu, min(variance, WIDE))
    many = _tilted_density(n, mu, max(variance, WIDE))
    return few if variance < WIDE else many


def _derivatives_few(kind, n, mu, variance):
    return _sum_derivatives(n, mu, variance)


def _derivatives_many(kind, n, mu, variance):
    return _tilted_derivatives(n, mu, variance)


def _derivatives_mixed(kind, n, mu, variance):
    few = _sum_derivatives(n, mu, min(variance, WIDE))
    many = _tilted_derivatives(n, mu, max(variance, WIDE))
    return few if variance < WIDE else many


density_of = _choice(_density_few, _density_many, _density_mixed)
derivatives_of = _choice(_derivatives_few, _derivatives_many, _derivatives_mixed)


def kind_of(variance: float | Floats) -> tuple[int, ...]:
    """Which formulas the pixels need: the sum (), the expansion (0,) or both (0, 0)."""
    wide = np.asarray(variance) >= WIDE
    return () if not wide.any() else (0,) if wide.all() else (0, 0)


def left_out(counts: Floats, variance: float | Floats) -> Floats:
    """The part of log p that depends on counts and read noise alone."""
    k = np.maximum(np.rint(counts), 0.0)
    few = gammaln(k + 1.0) + 0.5 * ((counts - k) ** 2 / variance + np.log(variance))
    return -0.5 * math.log(2.0 * math.pi) - np.where(np.asarray(variance) < WIDE, few, 0.0)
