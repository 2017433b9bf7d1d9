"""The pose of a camera: which part of the sky a frame shows, from the pattern of its stars.

A guess of the pointing and the pixel scale is refined by asterisms. Two stars of the catalogue and
two peaks of the frame determine a similarity: with the positions as complex numbers, s on the
tangent plane of the guess and d on the frame,

    d = a s + b,    a = (d_2 - d_1) / (s_2 - s_1),    b = d_1 - a s_1,

or the same with the conjugate of s for a mirrored image. Every pair of bright peaks is held against
every pair of bright stars whose distance agrees within `SCALE_ERROR`, and what |a| and b leave is
scored by the number of peaks that it brings near to a star. So the search is exhaustive, needs no
random numbers, and knows how many peaks would agree by chance. Similarity and tangent point are
then fitted to all stars that agree. The terms of degree 1 and the offset of the distortion take
over from there.

Where the catalogue is symmetric, other poses bring as many peaks to stars: `pose_aliases` finds
them. The one that explains positions and brightness best is taken. Where it does so no better than
another, but for chance, the pose says that it is ambiguous.
"""

import itertools
from collections.abc import Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import spatial, stats

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import ARCSEC, Parity, TangentPlane, rows
from bayesfred.optimize.pose_aliases import find_aliases, log_evidence
from bayesfred.optimize.pose_refine import Complex, Raster, RefinedPose, Stars, moved, refine

__all__ = ["Pose", "find_pose"]

POINTING_ERROR = 1.0  # degree: largest error of the guess
NEARER = (0.1, 0.3, 1.0)  # shares of it that are tried in turn: the cost grows with the area
SCALE_ERROR = 0.05
ANGLE_ERROR = 5.0  # degree, of a position angle that is given
BRIGHTEST = (30, 50)  # peaks that make pairs; the second where the first show no pose
MORE_STARS = 1.5  # ... and stars for the same area, as the brightest peaks may be none of them
SHORTEST = 0.15  # shortest distance of a pair, of the frame's diagonal
NEAR = 0.006  # a peak is near to a star, of the frame's diagonal
CHANCE = 1e-6  # largest probability that peaks agree by chance
MOST_PEAKS = 100
DEEPER = 4.0  # the brightest stars against which a pose is tested, for each peak of the frame
BLOCK = 2**17  # similarities that are tested at once: what fits the memory
LONGEST = 3e7  # similarities of one search; those of the brightest peaks come first
MOST_TRIED = 1e10  # similarities: of so many none agrees by chance with what ends a search early
MOST_STARS = 6000  # among which aliases are looked for
MOST_NAMED = 3  # pointings
SEEN = {"sky": "as on the sky", "mirrored": "mirrored"}


class Pose(NamedTuple):
    """Which part of the sky a frame shows.

    Attributes
    ----------
    plane : TangentPlane
        It touches the sky where the middle of the frame points.
    matched : int
        Number of stars with a peak.
    rms : float, pixel
        Of their distances along one axis, by the similarity alone: distortion is left in.
    message : str
        One line.
    ambiguous : str
        Which other poses fit alike, and what would tell; empty where there is none.
    """

    plane: TangentPlane
    matched: int
    rms: float
    message: str
    ambiguous: str


def find_pose(
    peaks: Floats,
    stars: Stars,
    guess: TangentPlane,
    shape: tuple[int, int],
    *,
    heights: Floats | None = None,
    angle: float | None = None,
    parity: Parity | None = None,
) -> Pose:
    """Find the pose of a frame within 1 degree and 5 % in scale of a guess.

    Of poses that a symmetric catalogue makes alike the one is taken that explains positions and
    brightness best; of equally good ones that which points nearest to the guess.

    Parameters
    ----------
    peaks : ndarray, shape (n, 2), pixel of the fine grid
        Positions u, v of the frame's peaks from its middle, brightest first.
    stars : tuple of 3 ndarray, shape (m,): degree, degree, counts
        Right ascension, declination and flux.
    guess : TangentPlane
        Its direction and pixel scale are used.
    shape : (int, int), pixel of the fine grid
        Rows and columns of the frame.
    heights : ndarray, shape (n,), optional
        Of the peaks, in any unit: their brightness.
    angle : float, optional, degree
        Position angle, known to 5 degrees; by default any.
    parity : {"sky", "mirrored"}, optional
        By default either.

    Returns
    -------
    Pose

    Raises
    ------
    InputError
        If there are fewer than 3 peaks, or no pose brings more of them to stars than chance would.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> ra, dec = 180.0 + rng.uniform(-4.0, 4.0, 200), rng.uniform(-4.0, 4.0, 200)
    >>> truth = TangentPlane(180.2, 0.3, ((-0.006, 0.008), (0.008, 0.006)))
    >>> peaks = np.stack(truth.to_plane(ra, dec), axis=1)
    >>> guess = TangentPlane(180.0, 0.0, ((0.0103, 0.0), (0.0, 0.0103)))
    >>> inside = (abs(peaks) < 200.0).all(axis=1)
    >>> found = find_pose(peaks[inside], (ra, dec, np.ones(200)), guess, (401, 401))
    >>> print(found.message)
    pose: 56 stars matched to peaks within 1 px (rms 0.00); RA 180.2000, Dec 0.3000 degrees, ...
    """
    if len(peaks) < 3:
        raise InputError(
            f"frame: got {len(peaks)} peaks as wide as the PSF, expected at least 3 to find the "
            "pointing: check psf.sigma"
        )
    on_frame = peaks[:, 0] + 1j * peaks[:, 1]
    diagonal = float(np.hypot(*shape))
    bright = np.argsort(-stars[2], kind="stable")
    found = None
    for number, share in itertools.product(BRIGHTEST, NEARER):
        if found is None:
            reach = share * POINTING_ERROR
            found = _search(on_frame, stars, bright, guess, shape, (number, reach, angle, parity))
    if found is None:
        limits = "" if angle is None else f", {ANGLE_ERROR:g} degrees of the position angle"
        limits += "" if parity is None else f", parity {parity!r}"
        raise InputError(
            f"sky: got no pose within {POINTING_ERROR:g} degree of RA {guess.ra:.4f}, Dec "
            f"{guess.dec:.4f}{limits} and {SCALE_ERROR:.0%} of {guess.pixel_scale:.4g} arcsec per "
            f"pixel at which the frame's {len(peaks)} peaks are stars of the catalogue's "
            f"{len(stars[0])}, more of them than by chance, expected one: check pointing, "
            "pixel_scale and the units of the catalogue"
        )
    pose = refine(on_frame, stars, found, NEAR * diagonal)
    some = _around(pose.plane, stars, len(peaks), shape)
    first = refine(on_frame, some, pose.plane, pose.near)
    possible = partial(_possible, guess=guess, angle=angle, parity=parity)
    aliases = find_aliases(on_frame, some, first, shape, NEAR * diagonal, possible)
    if not aliases:
        return _described(pose, [])
    poses = [first, *aliases]
    number = len(first.star)
    evidence = np.array(
        [log_evidence(on_frame, heights, some, each, shape, number) for each in poses]
    )
    alike = np.flatnonzero(evidence > evidence.max() + np.log(CHANCE))
    away = [_away(poses[k].plane, guess) for k in alike]
    best, *others = [poses[k] for k in alike[np.argsort(away, kind="stable")]]
    return _described(best, [other.plane for other in others])


def _around(plane: TangentPlane, stars: Stars, peaks: int, shape: tuple[int, int]) -> Stars:
    """Stars as bright as those of the frame, in and around it: of equal ones the nearest."""
    x, y = plane.to_plane(*stars[:2])
    distance = np.hypot(x, y)
    radius = 0.5 * float(np.hypot(*shape)) + 2.0 * POINTING_ERROR * ARCSEC / plane.pixel_scale
    share = np.pi * radius**2 / (shape[0] * shape[1])
    order = np.lexsort((distance, -stars[2]))
    order = order[distance[order] < radius]
    order = order[: min(int(DEEPER * share * peaks), MOST_STARS)]
    return stars[0][order], stars[1][order], stars[2][order]


def _possible(
    plane: TangentPlane, guess: TangentPlane, angle: float | None, parity: Parity | None
) -> bool:
    """Whether a pose is within the limits of the guess."""
    turned = 0.0 if angle is None else _turned(plane, angle)
    near = _away(plane, guess) < POINTING_ERROR and abs(turned) < ANGLE_ERROR
    return near and parity in (None, plane.parity)


def _away(plane: TangentPlane, guess: TangentPlane) -> float:
    """How far a pose points from the guess, in degrees."""
    offset = np.hypot(*guess.to_plane(plane.ra, plane.dec))
    return float(offset) * guess.pixel_scale / ARCSEC


def _turned(plane: TangentPlane, angle: float) -> float:
    """By how much a pose is turned from a position angle, -180 to 180 degrees."""
    return (plane.position_angle - angle + 180.0) % 360.0 - 180.0


def _described(pose: RefinedPose, alike: Sequence[TangentPlane]) -> Pose:
    """A pose in words, with others that fit alike."""
    plane = pose.plane
    message = (
        f"pose: {len(pose.star)} stars matched to peaks within {pose.near:.2g} px (rms "
        f"{pose.rms:.2f}); RA {plane.ra:.4f}, Dec {plane.dec:.4f} degrees, "
        f"{plane.pixel_scale:.3f} arcsec per pixel, position angle {plane.position_angle:.2f} "
        f"degrees, {SEEN[plane.parity]}"
    )
    return Pose(plane, len(pose.star), pose.rms, message, _ambiguous(plane, alike))


def _ambiguous(plane: TangentPlane, alike: Sequence[TangentPlane]) -> str:
    """One sentence about other poses; empty where there is none."""
    if not alike:
        return ""
    tell, angles, pointings = set[str](), dict[Parity, list[str]](), []
    for other in alike:
        turned = _turned(other, plane.position_angle)
        if abs(turned) < ANGLE_ERROR and other.parity == plane.parity:
            pointings.append(f"RA {other.ra:.4f}, Dec {other.dec:.4f}")
            continue
        tell.add("sky.parity" if other.parity != plane.parity else "sky.position_angle")
        angle = f"{round(other.position_angle, 1) + 0.0:.1f}"
        if angle not in angles.setdefault(other.parity, []):
            angles[other.parity].append(angle)
    others = [
        f"position angle {' or '.join(found)} degrees {SEEN[seen]}"
        for seen, found in angles.items()
    ]
    if pointings:
        others.append(" or ".join(pointings[:MOST_NAMED]) + " degrees")
    given = "".join(f"{key}, " for key in sorted(tell, reverse=True))
    return (
        "but the catalogue is symmetric, and its stars fit the frame as well at "
        f"{', or '.join(others)}, so that the pose may be wrong: give {given}a catalogue with "
        "fluxes that differ, or sources that break the symmetry"
    )


def _search(
    peaks: Complex,
    stars: Stars,
    bright: Ints,
    guess: TangentPlane,
    shape: tuple[int, int],
    known: tuple[int, float, float | None, Parity | None],
) -> TangentPlane | None:
    """The best similarity of all pairs; None if chance could have made it."""
    number, reach, angle, parity = known
    scale, diagonal = guess.pixel_scale / ARCSEC, float(np.hypot(*shape))
    flat = TangentPlane(guess.ra, guess.dec, ((scale, 0.0), (0.0, scale)))
    xi, eta = flat.to_plane(*stars[:2])
    radius = 0.5 * diagonal + reach / scale
    order = bright[np.hypot(xi[bright], eta[bright]) < (1.0 + SCALE_ERROR) * radius]
    share = np.pi * radius**2 / (shape[0] * shape[1])
    # stars much fainter than the frame's would be near to every point
    order = order[: int(DEEPER * share * min(len(peaks), MOST_PEAKS))]
    field = xi[order] + 1j * eta[order]
    some = field[: int(MORE_STARS * number * share)]
    if len(some) < 2:
        return None
    by_chance = (
        len(peaks[:number]) * len(field) * np.pi * (NEAR * diagonal) ** 2 / (np.pi * radius**2)
    )

    def chance(agreeing: int, tried: float) -> float:
        # two peaks of every similarity agree by its making
        return float(tried * stats.poisson.sf(agreeing - 3, by_chance))

    best, plane, tried, made = 0, None, 0, 0
    for mirrored in (False, True):
        if parity is not None and mirrored != (parity == "mirrored"):
            continue
        lookup = Raster(_flipped(field, mirrored=mirrored), NEAR * diagonal)
        for a, b in _similarities(peaks[:number], _flipped(some, mirrored=mirrored), diagonal):
            made += a.size
            if made > LONGEST:
                break
            kept = np.abs(b) < reach / scale
            if angle is not None:
                turn = np.degrees(np.angle(a)) if mirrored else -np.degrees(np.angle(a))
                kept &= np.abs((turn - angle + 180.0) % 360.0 - 180.0) < ANGLE_ERROR
            a, b = a[kept], b[kept]
            tried += a.size
            agree = lookup.agreeing(peaks[:number], a, b)
            if agree.size and agree.max() > best:
                first = int(np.argmax(agree))
                best = int(agree[first])
                plane = _plane(flat, a[first], b[first], mirrored=mirrored)
                if chance(best, MOST_TRIED) < CHANCE:
                    return plane
    return plane if chance(best, tried) < CHANCE else None


def _flipped(stars: Complex, *, mirrored: bool) -> Complex:
    """Stars with xi counted backwards where the image is not mirrored: east is on the left."""
    return stars if mirrored else np.asarray(-stars.conj())


def _similarities(
    peaks: Complex, stars: Complex, diagonal: float
) -> Iterator[tuple[Complex, Complex]]:
    """a and b of all pairs of peaks and of stars with a similar distance, some at a time."""
    i, j = np.triu_indices(len(peaks), 1)
    wanted = np.abs(peaks[i] - peaks[j])
    long = wanted > SHORTEST * diagonal
    i, j, wanted = i[long], j[long], wanted[long]
    tree = spatial.cKDTree(np.stack([stars.real, stars.imag], axis=1))
    longest = (1.0 + SCALE_ERROR) * float(wanted.max(initial=0.0))
    k, m = tree.query_pairs(longest, output_type="ndarray").T
    lengths = np.abs(stars[k] - stars[m])
    order = np.argsort(lengths)
    k, m, lengths = k[order], m[order], lengths[order]
    low = np.searchsorted(lengths, wanted * (1.0 - SCALE_ERROR))
    high = np.searchsorted(lengths, wanted * (1.0 + SCALE_ERROR))
    for pair in range(i.size):
        for first in range(low[pair], high[pair], BLOCK):
            some = slice(first, min(first + BLOCK, high[pair]))
            s_1 = np.concatenate([stars[k[some]], stars[m[some]]])
            s_2 = np.concatenate([stars[m[some]], stars[k[some]]])
            a = (peaks[j[pair]] - peaks[i[pair]]) / (s_2 - s_1)
            yield a, peaks[i[pair]] - a * s_1


def _plane(flat: TangentPlane, a: complex, b: complex, *, mirrored: bool) -> TangentPlane:
    """The plane on which d = a s + b, s counted backwards along xi unless mirrored."""
    scale = flat.matrix[0][0]
    inverse = scale / a
    matrix = np.array([[inverse.real, -inverse.imag], [inverse.imag, inverse.real]])
    if not mirrored:
        matrix[0] *= -1.0
    return moved(TangentPlane(flat.ra, flat.dec, rows(matrix), (b.real, b.imag)))
