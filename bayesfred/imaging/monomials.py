"""Polynomials in x, y, u and v as lists of terms, and Newton's method in the plane.

A term is a tuple of powers (i, j, m, n), the monomial x^i y^j u^m v^n. `distortion` builds the
displacements f and g from these functions.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from bayesfred._typing import Floats
from bayesfred.errors import InputError

Exponents = tuple[int, int, int, int]
Point = tuple[Floats, ...]  # x, y, u, v

X, Y, U, V = range(4)  # a variable's index in an exponent tuple (i, j, m, n)

# Newton's method stops when a step is this small, relative to the point's coordinates (at least one
# pixel).
RELATIVE_TOLERANCE = 1e-12
MAX_ITERATIONS = 50


def checked_terms(letter: str, terms: Sequence[Sequence[int]]) -> tuple[Exponents, ...]:
    """The terms as tuples of integers; an InputError names the first bad one."""
    checked: list[Exponents] = []
    for term in terms:
        try:
            i, j, m, n = (operator.index(power) for power in term)
        except (TypeError, ValueError):
            raise InputError(
                f"{letter}_terms: got {term!r}, expected four integers (i, j, m, n): the powers "
                "of x, y, u, v"
            ) from None
        powers = (i, j, m, n)
        if min(powers) < 0:
            raise InputError(f"{letter}_terms: got {powers}, expected powers (i, j, m, n) >= 0")
        named = f"{letter}_terms: got {term_name(letter, powers)} {powers}"
        if i + j < 1:
            raise InputError(
                f"{named}, which breaks the distortion-free condition at the axis; expected i + j "
                ">= 1: give the term a power of x or y, or remove it"
            )
        if powers in checked:
            raise InputError(f"{named} twice, expected every term once: remove one")
        checked.append(powers)
    return tuple(checked)


def term_name(letter: str, term: Sequence[int]) -> str:
    """The letter, then the powers of u, v, x, y: f_u2x."""
    powers = [(symbol, term[place]) for symbol, place in (("u", U), ("v", V), ("x", X), ("y", Y))]
    written = [
        symbol if power == 1 else f"{symbol}{power}" for symbol, power in powers if power > 0
    ]
    return f"{letter}_{''.join(written) or '1'}"


def degree_of(name: str) -> int:
    """The sum of the powers of a term by its name: 3 of f_u2x."""
    return sum(int(power or 1) for power in re.findall(r"[uvxy](\d*)", name[2:]))


def broadcast(u: ArrayLike, v: ArrayLike, x: ArrayLike, y: ArrayLike) -> Point:
    """The four coordinates broadcast, in the order of an exponent tuple."""
    return np.broadcast_arrays(*(np.asarray(value, dtype=float) for value in (x, y, u, v)))


def monomials(terms: Sequence[Exponents], point: Point) -> Floats:
    """Every term at every point, shape (*points, n_terms)."""
    powers = np.array(terms, dtype=np.int64).reshape(-1, 4)
    product = np.ones((*point[0].shape, len(powers)))
    for value, power in zip(point, powers.T, strict=True):
        if top := int(power.max(initial=0)):
            factors = np.ones((*value.shape, top + 1))
            for k in range(top):  # faster than powers of floats
                np.multiply(factors[..., k], value, out=factors[..., k + 1])
            product *= factors[..., power]
    return product


def polynomial(
    theta: Floats,
    terms: Sequence[Sequence[int]],
    point: Point,
    along: int | None = None,
) -> Floats:
    """The sum of theta x^i y^j u^m v^n, or its derivative along one of the four variables."""
    total = np.zeros(point[0].shape)
    for coefficient, term in zip(theta, terms, strict=True):
        powers = list(term)
        if along is not None:
            coefficient = coefficient * powers[along]
            powers[along] -= 1
        if coefficient == 0.0:  # also leaves out x^-1, the derivative of a term without x
            continue
        monomial = np.full(point[0].shape, coefficient)
        for value, power in zip(point, powers, strict=True):
            if power > 0:
                monomial *= value**power
        total += monomial
    return total


def newton(
    residual: Callable[[Floats, Floats], tuple[Floats, ...]],
    p: Floats,
    q: Floats,
) -> tuple[Floats, Floats]:
    """Solve two equations at every point, from (p, q).

    `residual` gives (r, s, r_p, r_q, s_p, s_q); a step is Cramer's rule on [[r_p, r_q], [s_p,
    s_q]]. A point is done with the first step below the tolerance and is then left alone: the next
    would be rounding. Where no step is that small, or one is not finite, the result is NaN.
    """
    scale = np.maximum(np.maximum(np.abs(p), np.abs(q)), 1.0)
    p, q = p.copy(), q.copy()
    moving, lost = np.ones(p.shape, dtype=bool), np.zeros(p.shape, dtype=bool)
    with np.errstate(all="ignore"):  # a point that diverges overflows; it becomes NaN below
        for _ in range(MAX_ITERATIONS):
            r, s, r_p, r_q, s_p, s_q = residual(p, q)
            determinant = r_p * s_q - r_q * s_p
            step_p = (r * s_q - s * r_q) / determinant
            step_q = (s * r_p - r * s_p) / determinant
            p = np.where(moving, p - step_p, p)
            q = np.where(moving, q - step_q, q)
            moving &= ~(np.maximum(np.abs(step_p), np.abs(step_q)) <= RELATIVE_TOLERANCE * scale)
            lost |= ~np.isfinite(p + q)
            moving &= ~lost
            if not moving.any():
                break
    none = moving | lost
    return np.where(none, np.nan, p), np.where(none, np.nan, q)
