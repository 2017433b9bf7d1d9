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
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, spatial, stats

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import ARCSEC, Parity, TangentPlane, rows

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
LEAST_NEAR = 1.0  # pixel: least distance within which stars and peaks are matched in the end
ROUNDS = 10
FINE = 3  # cells of the raster for the distance within which a peak is near to a star
LARGEST = 8192  # cells along a side of the raster
MOST_PEAKS = 100
DEEPER = 4.0  # the brightest stars against which a pose is tested, for each peak of the frame
BLOCK = 2**17  # similarities that are tested at once: what fits the memory
LONGEST = 3e7  # similarities of one search; those of the brightest peaks come first
MOST_TRIED = 1e10  # similarities: of so many none agrees by chance with what ends a search early

Complex = NDArray[np.complex128]


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
    """

    plane: TangentPlane
    matched: int
    rms: float
    message: str


def find_pose(
    peaks: Floats,
    stars: tuple[Floats, Floats, Floats],
    guess: TangentPlane,
    shape: tuple[int, int],
    *,
    angle: float | None = None,
    parity: Parity | None = None,
) -> Pose:
    """Find the pose of a frame within 1 degree and 5 % in scale of a guess.

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
    return _refined(on_frame, stars, found, NEAR * diagonal)


def _search(
    peaks: Complex,
    stars: tuple[Floats, Floats, Floats],
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
        lookup = _Raster(_flipped(field, mirrored=mirrored), NEAR * diagonal)
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


class _Raster:
    """Which cells of the plane are near to a star: similarities are looked up there."""

    def __init__(self, stars: Complex, near: float) -> None:
        low, high = (f([f(stars.real), f(stars.imag)]) for f in (np.min, np.max))
        self.low, self.cell = low, max(near / FINE, (high - low) / LARGEST)
        side = int((high - low) / self.cell) + 3
        empty = np.ones((side, side), dtype=bool)
        row, column = (
            np.rint((p - low) / self.cell).astype(int) + 1 for p in (stars.imag, stars.real)
        )
        empty[row, column] = False
        self.occupied = ndimage.distance_transform_edt(empty) < near / self.cell
        # what is beyond the catalogue ends here
        self.occupied[[0, -1], :] = self.occupied[:, [0, -1]] = False

    def agreeing(self, peaks: Complex, a: Complex, b: Complex) -> Ints:
        """How many peaks each similarity brings near to a star."""
        at = (peaks[None] - b[:, None]) / a[:, None]
        row, column = (
            np.clip(np.rint((p - self.low) / self.cell) + 1.0, 0, len(self.occupied) - 1)
            for p in (at.imag, at.real)
        )
        near = self.occupied[row.astype(int), column.astype(int)]
        return np.asarray(near.sum(axis=1, dtype=np.int64))


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
    return _moved(TangentPlane(flat.ra, flat.dec, rows(matrix), (b.real, b.imag)))


def _moved(plane: TangentPlane) -> TangentPlane:
    """The plane that touches the sky where the middle of the frame points, of the same slope."""
    ra, dec = plane.to_sky(0.0, 0.0)
    unit = TangentPlane(float(ra), float(dec), ((1.0, 0.0), (0.0, 1.0)))
    step = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    xi, eta = unit.to_plane(*plane.to_sky(*step))
    matrix = 0.5 * np.array([[p[0] - p[1], p[2] - p[3]] for p in (xi, eta)])
    return TangentPlane(float(ra), float(dec), rows(matrix))


def _refined(
    peaks: Complex, stars: tuple[Floats, Floats, Floats], plane: TangentPlane, near: float
) -> Pose:
    """The similarity that fits all stars with a peak, and the plane in the frame's middle."""
    tree = spatial.cKDTree(np.stack([peaks.real, peaks.imag], axis=1))
    mirrored = plane.parity == "mirrored"
    matched, rms = 0, np.inf
    for _ in range(ROUNDS):
        x, y = plane.to_plane(*stars[:2])
        known = np.flatnonzero(np.isfinite(x))
        distance, peak = tree.query(
            np.stack([x[known], y[known]], axis=1), distance_upper_bound=near
        )
        some = np.flatnonzero(np.isfinite(distance))
        some = some[np.argsort(distance[some], kind="stable")]
        some = some[np.unique(peak[some], return_index=True)[1]]  # the nearest star of each peak
        if len(some) < 3:
            break
        star, d = known[some], peaks[peak[some]]
        s = x[star] + 1j * y[star]
        centre, middle = s.mean(), d.mean()
        a = np.vdot(s - centre, d - middle) / np.vdot(s - centre, s - centre)
        b = middle - a * centre
        left = np.abs(d - a * s - b)
        matched, rms = len(some), float(np.sqrt(0.5 * np.mean(left**2)))
        turn = np.array([[a.real, -a.imag], [a.imag, a.real]])
        matrix = np.array(plane.matrix) @ np.linalg.inv(turn)
        # a shift by b of the frame's coordinates
        plane = _moved(TangentPlane(plane.ra, plane.dec, rows(matrix), (b.real, b.imag)))
        near = max(LEAST_NEAR, min(near, 3.0 * float(np.sqrt(2.0) * rms)))
    seen = "mirrored" if mirrored else "as on the sky"
    message = (
        f"pose: {matched} stars matched to peaks within {near:.2g} px (rms {rms:.2f}); RA "
        f"{plane.ra:.4f}, Dec {plane.dec:.4f} degrees, {plane.pixel_scale:.3f} "
        f"arcsec per pixel, position angle {plane.position_angle:.2f} degrees, {seen}"
    )
    return Pose(plane, matched, rms, message)
