"""Terms and bases of the named polynomial distortions.

A term is a tuple of powers (i, j, m, n) of x, y, u, v. A basis is a matrix T with a row for every
monomial, those of f before those of g, and a column for every coefficient: monomial coefficients
= T theta. `PolynomialDistortion` in `distortion` turns what is here into displacements.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from bayesfred._typing import Floats
from bayesfred.errors import InputError
from bayesfred.imaging.monomials import Exponents

Powers = tuple[int, int]
Sum = dict[Powers, float]  # coefficients of x^i y^j

# The paper's f in the equation's order: ux, vx, u^2 x, v^2 x, u x^2, v x^2.
PAPER_X: tuple[Exponents, ...] = (
    (1, 0, 1, 0),
    (1, 0, 0, 1),
    (1, 0, 2, 0),
    (1, 0, 0, 2),
    (2, 0, 1, 0),
    (2, 0, 0, 1),
)
PAPER_Y: tuple[Exponents, ...] = tuple((j, i, m, n) for i, j, m, n in PAPER_X)
PINHOLE_F = ((2, 0, 0, 0), (1, 1, 0, 0), (3, 0, 0, 0), (1, 2, 0, 0))
PINHOLE_G = ((1, 1, 0, 0), (0, 2, 0, 0), (2, 1, 0, 0), (0, 3, 0, 0))


class Basis(NamedTuple):
    """What `PolynomialDistortion` is made of."""

    f_terms: tuple[Exponents, ...]
    g_terms: tuple[Exponents, ...]
    basis: Floats  # (monomials, coefficients)
    labels: str  # the coefficients' names, separated by spaces


def object_terms(degree: int) -> Iterator[Exponents]:
    """Every x^i y^j with 1 <= i + j <= degree, by degree and falling power of x."""
    for total in range(1, degree + 1):
        yield from ((i, total - i, 0, 0) for i in range(total, -1, -1))


def all_terms(degree: int) -> Iterator[Exponents]:
    """Every monomial of total degree 2 to `degree` with i + j >= 1.

    By degree, then by falling powers of u, of v and of x.
    """
    for total in range(2, degree + 1):
        for m in range(total, -1, -1):
            for n in range(total - m, -1, -1):
                rest = total - m - n
                if rest > 0:
                    yield from ((i, rest - i, m, n) for i in range(rest, -1, -1))


def zernike(degree: int, radius: float) -> Basis:
    """Zernike's polynomials in (x, y) / radius less their constants, for f and for g."""
    columns: dict[str, tuple[Sum, Sum]] = {}
    for letter in "fg":
        for n in range(1, degree + 1):
            for m in range(-n, n + 1, 2):
                scaled = {
                    (i, j): value / radius ** (i + j)
                    for (i, j), value in _zernike(n, m).items()
                    if i + j > 0
                }
                name = f"{letter}_z{n}_{'m' if m < 0 else ''}{abs(m)}"
                columns[name] = (scaled, {}) if letter == "f" else ({}, scaled)
    return _combined(columns)


def radial_tangential(focal_length: float) -> Basis:
    """OpenCV's k1, k2, k3, p1, p2, with x and y in units of the focal length."""
    columns: dict[str, tuple[Sum, Sum]] = {}
    for k in (1, 2, 3):
        scale = -(focal_length ** (-2.0 * k))
        radial = {powers: scale * value for powers, value in _radius_squared(k).items()}
        columns[f"k{k}"] = (
            {(i + 1, j): value for (i, j), value in radial.items()},
            {(i, j + 1): value for (i, j), value in radial.items()},
        )
    scale = -1.0 / focal_length
    both, squares_x, squares_y = (
        {(1, 1): 2.0 * scale},
        {(2, 0): 3.0 * scale, (0, 2): scale},
        {(2, 0): scale, (0, 2): 3.0 * scale},
    )
    columns |= {"p1": (both, squares_y), "p2": (squares_x, both)}
    return _combined(columns)


def _zernike(n: int, m: int) -> Sum:
    """R_n^|m|(r) cos(m phi), or sin(|m| phi) for m < 0, in x and y; R(1) = 1.

    R_n^q(r) = sum over k of (-1)^k (n - k)! / (k! ((n + q)/2 - k)! ((n - q)/2 - k)!) r^(n - 2k),
    and r^q exp(i q phi) = (x + i y)^q.
    """
    q, f = abs(m), math.factorial
    total: Sum = {}
    for k in range((n - q) // 2 + 1):
        radial = (-1) ** k * f(n - k) / (f(k) * f((n + q) // 2 - k) * f((n - q) // 2 - k))
        for (i, j), value in _radius_squared((n - q) // 2 - k).items():
            for b in range(int(m < 0), q + 1, 2):
                powers = (i + q - b, j + b)
                angular = (-1) ** (b // 2) * math.comb(q, b)
                total[powers] = total.get(powers, 0.0) + radial * value * angular
    return {powers: value for powers, value in total.items() if value != 0.0}


def _radius_squared(power: int) -> Sum:
    """(x^2 + y^2)^power."""
    return {(2 * a, 2 * (power - a)): float(math.comb(power, a)) for a in range(power + 1)}


def _combined(columns: Mapping[str, tuple[Sum, Sum]]) -> Basis:
    """A basis from the polynomials that a unit of each coefficient adds to f and to g."""
    terms: list[list[Powers]] = [
        sorted({powers for both in columns.values() for powers in both[axis]}, key=_by_degree)
        for axis in (0, 1)
    ]
    rows = [(axis, powers) for axis in (0, 1) for powers in terms[axis]]
    basis = [[both[axis].get(powers, 0.0) for both in columns.values()] for axis, powers in rows]
    f_terms, g_terms = (tuple((i, j, 0, 0) for i, j in each) for each in terms)
    return Basis(f_terms, g_terms, np.array(basis), " ".join(columns))


def _by_degree(powers: Powers) -> Powers:
    """Sorts by degree, then by falling power of x."""
    return sum(powers), -powers[0]


def checked_basis(basis: ArrayLike, monomials: int) -> Floats:
    """A read-only copy of the matrix, or an InputError that says what is wrong with it."""
    try:
        checked = np.array(basis, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise InputError("basis: got values that are not numbers, expected a matrix") from None
    if checked.ndim != 2 or len(checked) != monomials or checked.shape[1] == 0:
        raise InputError(
            f"basis: got shape {checked.shape}, expected ({monomials}, number of coefficients): "
            "one row for every monomial of f, then of g"
        )
    if not np.isfinite(checked).all():
        raise InputError("basis: got values that are not finite, expected numbers")
    if not checked.any(axis=0).all():
        empty = int(np.argmin(checked.any(axis=0)))
        raise InputError(
            f"basis: got zeros alone in column {empty}, expected a monomial in every column"
        )
    checked.setflags(write=False)
    return checked
