"""A pose fitted to all stars that have a peak, and where stars are: for `pose` and its aliases."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, spatial

from bayesfred._typing import Floats, Ints
from bayesfred.io.tangent_plane import TangentPlane, rows

__all__ = ["Complex", "Raster", "RefinedPose", "Stars", "matched", "moved", "refine"]

LEAST_NEAR = 1.0  # pixel: least distance within which stars and peaks are matched in the end
ROUNDS = 10
FINE = 3  # cells of the raster for the distance within which a peak is near to a star
LARGEST = 8192  # cells along a side of the raster

Complex = NDArray[np.complex128]
Stars = tuple[Floats, Floats, Floats]


class RefinedPose(NamedTuple):
    """A pose, and which stars have a peak.

    Attributes
    ----------
    plane : TangentPlane
        It touches the sky where the middle of the frame points.
    star, peak : ndarray of int, shape (n,)
        Numbers of the stars that have a peak, and of these peaks.
    near : float, pixel
        Distance within which they are matched.
    rms : float, pixel
        Of their distances along one axis.
    """

    plane: TangentPlane
    star: Ints
    peak: Ints
    near: float
    rms: float


class Raster:
    """Which cells of the plane are near to a star: similarities are looked up there."""

    def __init__(self, stars: Complex, near: float) -> None:
        low, high = (f([f(stars.real), f(stars.imag)]) for f in (np.min, np.max))
        self.low, self.cell = low, max(near / FINE, (high - low) / LARGEST)
        side = int(np.ceil((high - low) / self.cell)) + 3
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


def refine(peaks: Complex, stars: Stars, plane: TangentPlane, near: float) -> RefinedPose:
    """The similarity that fits all stars with a peak, and the plane in the frame's middle.

    Parameters
    ----------
    peaks : ndarray of complex, shape (n,), pixel
        u + i v from the middle of the frame.
    stars : tuple of 3 ndarray, shape (m,): degree, degree, counts
        Right ascension, declination and flux.
    plane : TangentPlane
        Where to begin.
    near : float, pixel
        Distance within which stars and peaks are matched at first.

    Returns
    -------
    RefinedPose
    """
    tree = spatial.cKDTree(np.stack([peaks.real, peaks.imag], axis=1))
    star = peak = np.zeros(0, np.int64)
    rms = np.inf
    for _ in range(ROUNDS):
        x, y = plane.to_plane(*stars[:2])
        some, nearest = matched(tree, np.stack([x, y], axis=1), near)
        if len(some) < 3:
            break
        star, peak = some, nearest
        s, d = x[star] + 1j * y[star], peaks[peak]
        centre, middle = s.mean(), d.mean()
        a = np.vdot(s - centre, d - middle) / np.vdot(s - centre, s - centre)
        b = middle - a * centre
        left = np.abs(d - a * s - b)
        rms = float(np.sqrt(0.5 * np.mean(left**2)))
        turn = np.array([[a.real, -a.imag], [a.imag, a.real]])
        matrix = np.array(plane.matrix) @ np.linalg.inv(turn)
        # a shift by b of the frame's coordinates
        plane = moved(TangentPlane(plane.ra, plane.dec, rows(matrix), (b.real, b.imag)))
        near = max(LEAST_NEAR, min(near, 3.0 * float(np.sqrt(2.0) * rms)))
    return RefinedPose(plane, star, peak, near, rms)


def matched(tree: Any, positions: Floats, near: float) -> tuple[Ints, Ints]:
    """The stars at positions that have a peak of a tree, and the peak of each.

    Every peak has its nearest star, no farther than `near`.
    """
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    distance, peak = tree.query(positions[known], distance_upper_bound=near)
    some = np.flatnonzero(np.isfinite(distance))
    some = some[np.argsort(distance[some], kind="stable")]
    some = some[np.unique(peak[some], return_index=True)[1]]
    return known[some], peak[some]


def moved(plane: TangentPlane) -> TangentPlane:
    """The plane that touches the sky where the middle of the frame points, of the same slope."""
    ra, dec = plane.to_sky(0.0, 0.0)
    unit = TangentPlane(float(ra), float(dec), ((1.0, 0.0), (0.0, 1.0)))
    step = np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    xi, eta = unit.to_plane(*plane.to_sky(*step))
    matrix = 0.5 * np.array([[p[0] - p[1], p[2] - p[3]] for p in (xi, eta)])
    return TangentPlane(float(ra), float(dec), rows(matrix))
