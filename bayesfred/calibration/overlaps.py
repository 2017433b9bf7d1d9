"""Counts of pixels on another grid, by the areas in which quadrilaterals and pixels overlap.

This is drizzling (Fruchter & Hook 2002, PASP 114, 144) with the pixels' full size; `drizzle`
computes the areas. It returns weighted means, in single precision. With the areas A_i as weights
and d_i / A_i as data, the sum of the weights is the area that is covered, and its product with the
mean is F_j = sum_i d_i overlap_ij / A_i.

The mean density of the counts over a side of an output pixel is the change of the counts before it
when the grid is shifted: the difference between the cumulative sums of two frames.
"""

from dataclasses import dataclass

import numpy as np
from drizzle.resample import Drizzle

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError

__all__ = ["corners", "extent", "require_size", "resampled", "signed_areas"]

LARGEST = 2**27  # output pixels, of which all planes take 10 GB
SHIFT = 0.02  # pixel, of the grid, to find the density on its sides
ROUNDING = 1e-6  # pixel, by which a frame may stand out of its grid


def resampled(
    data: tuple[Floats, Floats, Flags], at: tuple[Floats, Floats], shape: tuple[int, int]
) -> Floats:
    """F, variance, coverage and density on the sides, on the grid and one more pixel around it.

    `drizzle` works on a grid that holds the pixels as a whole. At the limits of a smaller one it
    decides by straight lines between the corners of a frame which pixels it omits. The ring of
    pixels without weight makes the corners of the outermost ones as good as the others.

    Parameters
    ----------
    data : tuple of ndarray, shape (ny, nx)
        Counts, their variance, and True where a pixel is good.
    at : tuple of ndarray, shape (ny + 2, nx + 2)
        Columns and rows on the grid of the pixels' centres, with a ring of pixels around the frame.
    shape : tuple of int, (rows, columns)
        Of the grid.

    Returns
    -------
    ndarray, shape (5, rows + 2, columns + 2)
        Counts, their variance, the covered area, and the mean densities on the right and on the
        upper side of each pixel.

    Raises
    ------
    InputError
        If no pixel of the frame falls on the grid, or its pixels are far too small.
    """
    rows, columns = part = _part(at, shape)
    column, row = (p[rows.start : rows.stop + 2, columns.start : columns.stop + 2] for p in at)
    area = np.abs(signed_areas(corners(column), corners(row)))
    counts, variance, good = (p[part] for p in data)
    x, y = (corners(np.pad(p, 1, "reflect", reflect_type="odd")) for p in (column, row))
    low, around = extent(x, y, margin=1)
    require_size("wcs", around)
    pixels = _Pixels(
        np.pad(counts / area, 1),
        np.pad(variance / area**2, 1),
        np.pad(area * good, 1),
        np.dstack([column - low[0], row - low[1]]),
        around,
    )
    found = [*pixels.drizzled(), pixels.sides(0), pixels.sides(1)]
    out = np.zeros((len(found), shape[0] + 2, shape[1] + 2))
    vertical = _overlap(low[1] + 1, around[0], shape[0] + 2)
    horizontal = _overlap(low[0] + 1, around[1], shape[1] + 2)
    for p, plane in zip(out, found, strict=True):
        p[vertical[0], horizontal[0]] = plane[vertical[1], horizontal[1]]
    return out


@dataclass(frozen=True, eq=False)
class _Pixels:
    """Pixels of a frame with a ring around them, on a grid on which all of them are."""

    density: Floats
    variance: Floats
    area: Floats
    at: Floats
    shape: tuple[int, int]

    def drizzled(self, shift: tuple[float, float] = (0.0, 0.0)) -> tuple[Floats, Floats, Floats]:
        """F, its variance and the coverage, after a shift along columns and rows."""
        drizzle = Drizzle("square", 0.0, 0.0, out_shape=self.shape, disable_ctx=True)
        drizzle.add_image(
            self.density.astype(np.float32),
            exptime=1.0,
            pixmap=self.at + shift,
            data2=self.variance.astype(np.float32),
            weight_map=self.area.astype(np.float32),
        )
        area = drizzle.out_wht.astype(np.float64)
        return drizzle.out_img * area, drizzle.out_img2[0] * area**2, area

    def sides(self, axis: int) -> Floats:
        """The density on the upper side of each output pixel along columns (0) or rows (1)."""
        shift = SHIFT * np.eye(2)[axis]
        change = self.drizzled(tuple(-shift))[0] - self.drizzled(tuple(shift))[0]
        return np.asarray(np.cumsum(change, axis=1 - axis) / (2.0 * SHIFT))


def _part(at: tuple[Floats, Floats], shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of the frame that hold all its pixels on the grid."""
    on = np.ones([n - 2 for n in at[0].shape], dtype=bool)
    for p, n in zip(map(corners, at), shape[::-1], strict=True):
        four = np.stack([p[:-1, :-1], p[1:, :-1], p[:-1, 1:], p[1:, 1:]])
        on &= (four.max(axis=0) > -1.5) & (four.min(axis=0) < n + 0.5)
    if not on.any():
        raise InputError(
            "wcs: got a grid on which no pixel of the frame falls, expected one that overlaps it"
        )
    rows, columns = (np.flatnonzero(on.any(axis=k)) for k in (1, 0))
    return slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)


def _overlap(first: int, n: int, m: int) -> tuple[slice, slice]:
    """Where n pixels from `first` on are among m, and which of the n these are."""
    begin, end = max(0, first), min(m, first + n)
    end = max(begin, end)
    return slice(begin, end), slice(begin - first, end - first)


def corners(centres: Floats) -> Floats:
    """Corners between pixels from their centres, as `drizzle` has them: the means of four.

    Parameters
    ----------
    centres : ndarray, shape (n + 1, m + 1)

    Returns
    -------
    ndarray, shape (n, m)
    """
    return np.asarray(
        0.25 * (centres[1:, 1:] + centres[:-1, 1:] + centres[1:, :-1] + centres[:-1, :-1])
    )


def signed_areas(x: Floats, y: Floats) -> Floats:
    """Areas of the quadrilaterals between corners: half the cross product of the diagonals.

    Parameters
    ----------
    x, y : ndarray, shape (n + 1, m + 1), pixel

    Returns
    -------
    ndarray, shape (n, m), pixel^2
        Negative where the order of the corners is reversed.
    """
    one = x[1:, 1:] - x[:-1, :-1], y[1:, 1:] - y[:-1, :-1]
    two = x[1:, :-1] - x[:-1, 1:], y[1:, :-1] - y[:-1, 1:]
    return np.asarray(0.5 * (one[0] * two[1] - one[1] * two[0]))


def extent(x: Floats, y: Floats, margin: int = 0) -> tuple[tuple[int, int], tuple[int, int]]:
    """The first column and row, and the shape, of the grid that holds all corners.

    Parameters
    ----------
    x, y : ndarray, pixel
    margin : int
        Pixels to add on each side.

    Returns
    -------
    first : tuple of int, (column, row)
    shape : tuple of int, (rows, columns)
    """
    first_x, first_y = (int(np.floor(p.min() + 0.5 + ROUNDING)) - margin for p in (x, y))
    last_x, last_y = (int(np.ceil(p.max() - 0.5 - ROUNDING)) + margin for p in (x, y))
    return (first_x, first_y), (max(0, last_y - first_y) + 1, max(0, last_x - first_x) + 1)


def require_size(where: str, shape: tuple[int, int], most: int = LARGEST) -> None:
    """Refuse a grid of too many pixels.

    Parameters
    ----------
    where : str
        What asks for it, to begin the line with.
    shape : tuple of int, (rows, columns)
    most : int
        Pixels.

    Raises
    ------
    InputError
        With what to do.
    """
    if shape[0] * shape[1] > most:
        raise InputError(
            f"{where}: got an output grid of {shape[0]} x {shape[1]} pixels, expected at most "
            f"{most}: take larger pixels or a smaller part, and see whether the distortion is "
            "known at the frame's edges"
        )
