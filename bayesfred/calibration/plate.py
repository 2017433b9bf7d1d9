"""The polynomials of a plate: from pixels to the plane that touches the sky, and back.

FITS headers and gwcs describe a distorted frame by polynomials about a reference pixel, whose
direction is where the plane touches the sky. With (h, k) the pixel counted from there,

    (xi, eta) = CD (h + A(h, k), k + B(h, k)),
    (h, k) = (U + AP(U, V), V + BP(U, V)),    (U, V) = CD^-1 (xi, eta),

with A and B of the degrees 2 to N. They are fitted to the calibration by least squares, at nodes of
Chebyshev over the whole frame, which keeps the largest error small. The fit is a polynomial about
the middle of the frame; the reference pixel is its root, found by Newton's method, and the
polynomial is expanded again, about that pixel, which changes no value.

A calibration need not be a polynomial of degree N, so the fit has a truncation error. Every draw of
the calibration is fitted in the same way. `wcs` and `generalized_wcs` write what comes out.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly, chebvander
from numpy.polynomial.polynomial import polyval2d
from scipy.special import comb

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import TangentPlane
from bayesfred.model.threads import one_blas_thread

if TYPE_CHECKING:
    from bayesfred.calibration.calibration import Calibration

__all__ = [
    "Plate",
    "Truncation",
    "checked_degree",
    "fit_plate",
    "known_sky",
    "nodes",
    "objects",
    "on_plane",
    "substituted",
    "truncation",
]

SIDE = 25  # nodes along each axis of the frame: 625 for the 55 terms of degree 9
CHECKS = 41  # points along each axis at which the error is measured, evenly spaced
HIGHEST = 9  # degree that the convention of SIP has keywords for
EXACT = 1e-6  # pixel, an error of the inverse that needs no higher degree
STEPS = 20  # of Newton's method
CLOSE = 1e-9  # of the half-width of a frame: the last step


@dataclass(frozen=True)
class Truncation:
    """By how much an export differs from its calibration, over the whole frame.

    Attributes
    ----------
    rms, largest : float, recorded pixel
        Root mean square and maximum of the distance at 41 x 41 points, those on the edges included.
    """

    rms: float
    largest: float


@dataclass(frozen=True, eq=False)
class Plate:
    """Polynomials of the posterior mean, in the first row, and of every draw.

    Attributes
    ----------
    sky : TangentPlane
    reference : ndarray, shape (1 + n, 2), recorded pixel
        The reference pixel, column and row from 0.
    cd : ndarray, shape (1 + n, 2, 2), degree per pixel
    forward : ndarray, shape (1 + n, 2, N + 1, N + 1), pixel^(1 - i - j)
        Coefficients of h^i k^j in A and B.
    inverse : ndarray, shape (1 + n, 2, M + 1, M + 1), pixel^(1 - i - j)
        Coefficients of U^i V^j in AP and BP, those of the degrees 0 and 1 included.
    """

    sky: TangentPlane
    reference: Floats
    cd: Floats
    forward: Floats
    inverse: Floats


def fit_plate(calibration: Calibration, degree: int) -> Plate:
    """Fit polynomials to a calibration and to each of its draws.

    Parameters
    ----------
    calibration : Calibration
    degree : int
        Of A and B. That of the inverse is the lowest from there to 9 that makes its error no
        larger than theirs.

    Returns
    -------
    Plate

    Raises
    ------
    InputError
        If it is not known where the object plane is on the sky, the distortion maps no object to
        a part of the frame, or the sky's plane touches the sky too far beyond the frame.
    """
    sky = known_sky(calibration)
    shape = calibration.detector.shape
    pixels = nodes(shape)
    plane = on_plane(sky, objects(calibration, pixels))
    middle, half = 0.5 * (np.array(shape[::-1]) - 1.0), 0.5 * np.array(shape[::-1])
    unit = (pixels - middle[:, None]) / half[:, None]
    c = _solved(_basis(unit, degree), np.concatenate(plane).T, degree)
    c = c.reshape(*plane.shape[:2], degree + 1, degree + 1)
    c, root = _about_root(c, (_start(calibration, sky) - middle) / half)
    c /= _powers(half[0], degree)[:, None] * _powers(half[1], degree)
    cd = np.stack([c[:, :, 1, 0], c[:, :, 0, 1]], axis=2)
    forward = np.einsum("nab,nbij->naij", np.linalg.inv(cd), c)
    forward[:, :, (0, 1, 0), (0, 0, 1)] = 0.0
    reference = middle + half * root
    focal = np.linalg.inv(cd) @ plane
    offset = pixels - reference[:, :, None] - focal
    wanted = max(_misfit(pixels, reference[0], focal[0], forward[0]), EXACT)
    trials = {}  # largest error by degree
    for trial in range(degree, HIGHEST + 1):
        (c,) = _fits(focal[:1], offset[:1], trial)
        trials[trial] = float(np.hypot(*(_evaluated(c, focal[0]) - offset[0])).max())
        if trials[trial] <= wanted:
            break
    inverse = _fits(focal, offset, min(trials, key=lambda m: trials[m]))
    return Plate(sky, reference, cd, forward, inverse)


def nodes(shape: tuple[int, int], *, even: bool = False) -> Floats:
    """Points over a frame, from edge to edge.

    Parameters
    ----------
    shape : (int, int), recorded pixel
        Rows and columns of the frame.
    even : bool
        The evenly spaced points at which errors are measured, not Chebyshev's nodes.

    Returns
    -------
    ndarray, shape (2, points), recorded pixel
        Column and row from 0, so that the first pixel begins at -0.5.

    Examples
    --------
    >>> columns, rows = nodes((10, 20), even=True)
    >>> columns.size, columns.min().item(), columns.max().item(), rows.max().item()
    (1681, -0.5, 19.5, 9.5)
    """
    unit = np.linspace(-1.0, 1.0, CHECKS) if even else np.cos(np.linspace(np.pi, 0.0, SIDE))
    column, row = (0.5 * (n - 1) + 0.5 * n * unit for n in shape[::-1])
    return np.array([p.ravel() for p in np.meshgrid(column, row)])


def objects(calibration: Calibration, pixels: Floats, *, draws: bool = True) -> Floats:
    """The object points that are imaged at pixels.

    Parameters
    ----------
    calibration : Calibration
    pixels : ndarray, shape (2, points), recorded pixel
        Column and row from 0.
    draws : bool
        Those of every draw, too.

    Returns
    -------
    ndarray, shape (1 + n, 2, points) or (1, 2, points), pixel of the fine grid
        x and y, of the posterior mean in the first row.

    Raises
    ------
    InputError
        If no object is imaged at one of them.
    """
    values = calibration.positions.mean[None]
    if draws:
        values = np.vstack([values, calibration.draws])
    position = calibration.distortion.object_position
    u, v = calibration.from_index(*pixels)
    found = np.stack(position(values[:, :-2], u, v, offset=values[:, -2:]), axis=1)
    lost = int(np.sum(~np.isfinite(found).all(axis=(0, 1))))
    if lost:
        raise InputError(
            f"calibration: got a distortion that maps no object to {lost} of {u.size} points of "
            "the frame, expected one that covers it: fit fewer terms, or a smaller frame"
        )
    return found


def known_sky(calibration: Calibration) -> TangentPlane:
    """Where a calibration's object plane is on the sky.

    Parameters
    ----------
    calibration : Calibration

    Returns
    -------
    TangentPlane

    Raises
    ------
    InputError
        If that is not known.
    """
    if calibration.sky is None:
        raise InputError(
            "sky: got a calibration whose object plane has no place on the sky, expected one of a "
            "catalogue with ra and dec"
        )
    return calibration.sky


def on_plane(sky: TangentPlane, points: Floats) -> Floats:
    """xi and eta, degree, of object points x and y: both have the shape (..., 2, points)."""
    return np.asarray(np.array(sky.matrix) @ (points - np.array(sky.origin)[:, None]))


def substituted(c: Floats, matrix: Floats) -> Floats:
    """Polynomials of (p, q) as polynomials of (x, y), where (p, q) = matrix (x, y).

    Parameters
    ----------
    c : ndarray, shape (k, 2, N + 1, N + 1)
        Coefficients of p^i q^j.
    matrix : ndarray, shape (k, 2, 2)

    Returns
    -------
    ndarray, shape (k, 2, N + 1, N + 1)
        Coefficients of x^i y^j.

    Examples
    --------
    >>> c = np.zeros((1, 2, 3, 3))
    >>> c[0, 0, 1, 1] = 1.0  # p q, with p = x + y and q = x - y
    >>> substituted(c, np.array([[[1.0, 1.0], [1.0, -1.0]]]))[0, 0].tolist()
    [[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    """
    out = np.zeros_like(c)
    (a, b), (d, e) = np.moveaxis(matrix, 0, 2)[..., None]
    for i, j in zip(*_exponents(c.shape[-1] - 1), strict=True):
        for s in range(i + 1):  # powers of y, from p^i and from q^j
            for t in range(j + 1):
                number = comb(i, s) * comb(j, t)
                factor = number * a ** (i - s) * b**s * d ** (j - t) * e**t
                out[:, :, i + j - s - t, s + t] += factor * c[:, :, i, j]
    return out


def truncation(found: Floats, expected: Floats) -> Truncation:
    """The distances between points, both of shape (2, points) and in recorded pixels."""
    distance = np.hypot(*(found - expected))
    return Truncation(float(np.sqrt(np.mean(distance**2))), float(distance.max()))


def checked_degree(degree: int, lowest: int, highest: int) -> int:
    """A degree that a convention has keywords for.

    Raises
    ------
    InputError
        If it is not an integer from `lowest` to `highest`.
    """
    try:
        number = operator.index(degree)
    except TypeError:
        number = lowest - 1
    if not lowest <= number <= highest:
        raise InputError(
            f"degree: got {degree!r}, expected an integer from {lowest} to {highest}: what the "
            "convention has keywords for"
        )
    return number


def _start(calibration: Calibration, sky: TangentPlane) -> Floats:
    """Column and row where the calibration images the point in which the plane touches the sky."""
    mean = calibration.positions.mean
    u, v = calibration.distortion.image_position(mean[:-2], *sky.origin, offset=mean[-2:])
    return np.array(calibration.index(u, v))


def _about_root(c: Floats, start: Floats) -> tuple[Floats, Floats]:
    """Polynomials expanded about their common root, and the root, found by Newton's method."""
    root = np.broadcast_to(start, (len(c), 2))
    c, step = _shifted(c, root), np.full((1, 2), np.nan)
    with np.errstate(all="ignore"):  # what is not finite is told below
        for _ in range(STEPS):
            (p, q), (r, s) = (np.moveaxis(c[:, :, i, j], 0, 1) for i, j in ((1, 0), (0, 1)))
            f, g = c[:, 0, 0, 0], c[:, 1, 0, 0]
            step = np.stack([g * r - f * s, f * q - g * p], axis=1) / (p * s - q * r)[:, None]
            c, root = _shifted(c, step), root + step
    if not np.abs(step).max() < CLOSE:
        raise InputError(
            f"sky: got a plane that touches the sky where the frame has no image ({start[0]:.3g}, "
            f"{start[1]:.3g} half-widths from its middle), expected it in the frame or near it"
        )
    return c, root


def _fits(points: Floats, values: Floats, degree: int) -> Floats:
    """Polynomials in points that differ from fit to fit, all of shape (k, 2, points)."""
    low, high = points[0].min(axis=1), points[0].max(axis=1)
    middle, half = 0.5 * (low + high)[:, None], 0.5 * (high - low)[:, None]
    with one_blas_thread():  # matrices too small to be shared
        c = np.array(
            [
                _solved(_basis((at - middle) / half, degree), to.T, degree)
                for at, to in zip(points, values, strict=True)
            ]
        )
    c = _shifted(c, np.broadcast_to((-middle / half).ravel(), (len(c), 2)))
    return c / (_powers(half[0, 0], degree)[:, None] * _powers(half[1, 0], degree))


def _misfit(pixels: Floats, reference: Floats, focal: Floats, forward: Floats) -> float:
    """The largest error of A and B at the nodes, pixel."""
    offset = pixels - reference[:, None]
    return float(np.hypot(*(offset + _evaluated(forward, offset) - focal)).max())


def _basis(points: Floats, degree: int) -> Floats:
    """T_i(p) T_j(q) with i + j <= degree, shape (points, terms)."""
    first, second = (chebvander(p, degree) for p in points)
    i, j = _exponents(degree)
    return np.asarray(first[:, i] * second[:, j])


def _solved(basis: Floats, values: Floats, degree: int) -> Floats:
    """Least squares: coefficients of p^i q^j, shape (k, degree + 1, degree + 1).

    Chebyshev's polynomials are nearly orthogonal at the nodes, so that the normal equations, which
    are the quickest to solve, are well conditioned.
    """
    found = np.zeros((values.shape[1], degree + 1, degree + 1))
    i, j = _exponents(degree)
    found[:, i, j] = np.linalg.solve(basis.T @ basis, basis.T @ values).T
    powers = np.zeros((degree + 1, degree + 1))  # of each T_i, in a column
    for k, one in enumerate(np.eye(degree + 1)):
        powers[: k + 1, k] = cheb2poly(one)[: k + 1]
    return np.asarray(powers @ found @ powers.T)


def _exponents(degree: int) -> tuple[Ints, Ints]:
    i, j = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    return i[i + j <= degree], j[i + j <= degree]


def _evaluated(c: Floats, points: Floats) -> Floats:
    """Two polynomials at points, shape (2, points)."""
    return np.array([polyval2d(points[0], points[1], each) for each in c])


def _shifted(c: Floats, to: Floats) -> Floats:
    """Polynomials expanded about other points, shape (k, 2): sum of c_ij (p + p0)^i (q + q0)^j."""
    degree = c.shape[-1] - 1
    index = np.arange(degree + 1)
    binomial = comb(index, index[:, None])  # of i over a, zero where a > i
    power = np.maximum(index - index[:, None], 0)
    left, right = (binomial * at[:, None, None] ** power for at in to.T)
    return np.asarray(np.einsum("nai,nkij,nbj->nkab", left, c, right, optimize=True))


def _powers(unit: float, degree: int) -> Floats:
    return np.asarray(unit ** np.arange(degree + 1.0))
