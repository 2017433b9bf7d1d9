"""Aliases of a pose: others with which the stars of a catalogue take each other's places.

A regular grid of equal stars looks the same after half a turn, a square one after a quarter, and
mirrored; where it is larger than the frame, also when it is shifted by a pitch. A similarity

    s_k -> a s_k + b,  or of the conjugate of s_k,    |a| = 1,

of the plane of a pose is an alias if it puts a star near to the place of nearly every star that has
a peak. Two of these, i and j, and every two stars k and m as far apart determine one. Of random
fields there are none.

What tells a pose from its aliases is, where n stars have a peak,

- positions: with the residuals' variance V from a polynomial, -n log V;
- brightness: with the correlation r of the logarithms of heights and fluxes, -n/2 log(1 - r^2);
- -`ALONE` for every peak without a star, and for every star in the frame without a peak.

The first two are log-likelihoods of normal errors at their maximum, but for a constant. The
polynomial, of a degree up to `DEGREE`, stands for the distortion.
"""

from collections.abc import Callable

import numpy as np
from scipy import spatial

from bayesfred._typing import Floats, Ints
from bayesfred.io.tangent_plane import TangentPlane, rows
from bayesfred.optimize.pose_refine import (
    Complex,
    Raster,
    RefinedPose,
    Stars,
    matched,
    moved,
    refine,
)

__all__ = ["find_aliases", "log_evidence"]

SHARE = 0.9  # of the stars with a peak in whose place an alias puts a star
FEW = 16  # stars of which that is asked first
MOST_ALIASES = 200
SAME = 2.0  # distances within which stars and peaks are matched: poses that differ by less are one
DEGREE = 5
ENOUGH = 3  # stars for each coefficient of the polynomial
LEAST_ERROR = 0.02  # pixel
LEAST_SCATTER = 1e-3  # of brightness: share of its variance
ALONE = 3.0  # a peak or a star that the other lacks, in log-likelihood: 1 in 20


def find_aliases(
    peaks: Complex,
    stars: Stars,
    pose: RefinedPose,
    shape: tuple[int, int],
    near: float,
    possible: Callable[[TangentPlane], bool],
) -> list[RefinedPose]:
    """Find the poses with which the stars take each other's places.

    Parameters
    ----------
    peaks : ndarray of complex, shape (n,), pixel
        u + i v from the middle of the frame.
    stars : tuple of 3 ndarray, shape (m,): degree, degree, counts
        Those that the frame may show.
    pose : RefinedPose
        Of these stars.
    shape : (int, int), pixel
        Rows and columns of the frame.
    near : float, pixel
        Distance within which a star is in another's place.
    possible : callable
        Whether what is known of the pose admits one.

    Returns
    -------
    list of RefinedPose
        Without the pose itself.
    """
    if len(pose.star) < 3:
        return []
    x, y = pose.plane.to_plane(*stars[:2])
    field = x + 1j * y
    here, field = field[pose.star], field[np.isfinite(field)]
    found, corners = [pose], _corners(shape)
    for a, b, mirrored in _similarities(here, field, near):
        plane = _mapped(pose.plane, a, b, mirrored=mirrored)
        if not possible(plane):
            continue
        alias = refine(peaks, stars, plane, near)
        sky = alias.plane.to_sky(*corners)
        apart = (np.hypot(*(np.array(p.plane.to_plane(*sky)) - corners)).max() for p in found)
        if len(alias.star) >= SHARE * len(pose.star) and min(apart) > SAME * near:
            found.append(alias)
            if len(found) > MOST_ALIASES:
                break
    return found[1:]


def _corners(shape: tuple[int, int]) -> Floats:
    v, u = 0.5 * np.array(shape)
    return np.array([[-u, u, -u, u], [-v, -v, v, v]])


def _similarities(
    here: Complex, field: Complex, near: float
) -> list[tuple[complex, complex, bool]]:
    """a and b that put stars of a field near to these places, and whether of the mirrored field."""
    i = int(np.argmin(np.abs(here - here.mean())))
    j = int(np.argmax(np.abs(here - here[i])))
    some = here[np.linspace(0, len(here) - 1, min(FEW, len(here))).astype(int)]
    length = abs(here[j] - here[i])
    if length < 2.0 * near:
        return []
    apart = [np.flatnonzero(np.abs(np.abs(field - s) - length) < near) for s in field]
    k = np.repeat(np.arange(len(field)), [len(at) for at in apart])
    m, found = np.concatenate(apart), list[tuple[complex, complex, bool]]()
    for mirrored in (False, True):
        there = field.conj() if mirrored else field
        raster = Raster(there, near)
        a = (here[j] - here[i]) / (there[m] - there[k])
        b = here[i] - a * there[k]
        for places in (some, here):
            agree = raster.agreeing(places, a, b) >= SHARE * len(places)
            a, b = a[agree], b[agree]
        found += [(one, shift, mirrored) for one, shift in zip(a.tolist(), b.tolist(), strict=True)]
    return found


def _mapped(plane: TangentPlane, a: complex, b: complex, *, mirrored: bool) -> TangentPlane:
    """The plane on which s is at a s + b, or at that of its conjugate."""
    side = np.diag([1.0, -1.0 if mirrored else 1.0])
    turn = np.array([[a.real, -a.imag], [a.imag, a.real]]) @ side
    origin = turn @ plane.origin + [b.real, b.imag]
    matrix = np.array(plane.matrix) @ np.linalg.inv(turn)
    return moved(TangentPlane(plane.ra, plane.dec, rows(matrix), (origin[0], origin[1])))


def log_evidence(
    peaks: Complex,
    heights: Floats | None,
    stars: Stars,
    pose: RefinedPose,
    shape: tuple[int, int],
    number: int,
) -> float:
    """How well a pose explains positions and brightness, as a log-likelihood but for a constant.

    Only differences between aliases of one frame have a meaning.

    Parameters
    ----------
    peaks : ndarray of complex, shape (n,), pixel
        u + i v from the middle of the frame.
    heights : ndarray, shape (n,), or None
        Of the peaks, in any unit.
    stars : tuple of 3 ndarray, shape (m,): degree, degree, counts
        Those that the frame may show.
    pose : RefinedPose
        Of these stars.
    shape : (int, int), pixel
        Rows and columns of the frame.
    number : int
        Of stars with a peak, for all aliases.

    Returns
    -------
    float
    """
    positions = np.stack(pose.plane.to_plane(*stars[:2]), axis=1)
    at = np.stack([peaks.real, peaks.imag], axis=1)
    tree, half = spatial.cKDTree(at), 0.5 * np.array(shape[::-1])
    star, peak = pose.star, pose.peak
    inside = np.flatnonzero((np.abs(positions) < half).all(axis=1))
    for _ in range(2):
        predicted, variance = _smooth(positions / half.max(), at, star, peak)
        shown = np.full_like(positions, np.nan)
        shown[inside] = predicted[inside]
        star, peak = matched(tree, shown, pose.near)
        if len(star) < 3:
            return -np.inf
    out = -number * float(np.log(variance + LEAST_ERROR**2))
    out -= ALONE * (len(peaks) + len(inside) - 2 * len(star))
    if heights is not None:
        light = np.log(np.stack([np.maximum(heights[peak], 1e-300), stars[2][star]]))
        if np.all(np.ptp(light, axis=1) > 0.0):
            r = max(float(np.corrcoef(light)[0, 1]), 0.0)
            out -= 0.5 * number * float(np.log(max(1.0 - r**2, LEAST_SCATTER)))
    return out


def _smooth(positions: Floats, at: Floats, star: Ints, peak: Ints) -> tuple[Floats, float]:
    """Where a polynomial through the matched stars images all, and the residuals' variance."""
    degree = max(
        d for d in range(1, DEGREE + 1) if d == 1 or (d + 1) * (d + 2) * ENOUGH <= 2 * len(star)
    )
    powers = [(n - m, m) for n in range(degree + 1) for m in range(n + 1)]
    x, y = positions.T
    matrix = np.stack([x**i * y**j for i, j in powers], axis=1)
    fit = np.linalg.lstsq(matrix[star], at[peak], rcond=None)[0]
    left = at[peak] - matrix[star] @ fit
    return matrix @ fit, float(np.sum(left**2) / max(2 * (len(star) - len(powers)), 1))
