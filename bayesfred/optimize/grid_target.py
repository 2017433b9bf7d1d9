"""Calibration targets with a regular grid of marks, indexed from the image without a list.

`grid_marks` finds what may be marks, and `grid_lattice` gives each its cell. What is left are the
symmetries of the lattice. Of those under which the cells make up the rows and columns of the
target, the one is taken that needs no mirroring, and of these the one that rotates least.

Undistorted positions are a regular lattice where it touches the image: a similarity, the nearest to
the derivative of the marks' positions in the middle of the frame, with the same value there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.errors import InputError
from bayesfred.optimize.grid_lattice import BASIS, Lattice, index_points, local_fit, orientations
from bayesfred.optimize.grid_marks import find_marks

__all__ = ["GridImage", "GridTarget", "index_grid"]

FEWEST = 9  # marks that are a grid
SCATTER = 0.05  # largest scatter of a lattice, in pitches
SHARE = 0.35  # of the marks that are not much fainter, on the grid
BORDER, MOST = 0.5, 0.6  # shares of its border and of all marks by which a grid is seen whole
STRAY = 0.03  # share of the marks that may lie beyond the target's rows and columns
FAINTEST = 0.2  # of the median flux of as many peaks as there are marks: no mark
MIDDLE = 60  # marks from which the lattice in the middle of the frame is taken


@dataclass(frozen=True)
class GridTarget:
    """A target of equal marks on a regular grid.

    Attributes
    ----------
    rows, columns : int
        At least 3 each.
    pitch : float or None, pixel
        Distance between neighbours near the middle of the frame. It is found from the image; one
        that differs is said in the message.
    layout : {"square", "hexagonal"}
        Hexagonal rows are sqrt(3)/2 pitches apart, the second, fourth, ... of them shifted by half
        a pitch along the columns.
    marks : {"pinholes", "dots"}
        Bright on dark or dark on bright.

    Raises
    ------
    InputError
        If a value is none of these.

    Examples
    --------
    >>> GridTarget(rows=9, columns=12).layout
    'square'
    """

    rows: int
    columns: int
    pitch: float | None = None
    layout: Literal["square", "hexagonal"] = "square"
    marks: Literal["pinholes", "dots"] = "pinholes"

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 3:
                raise InputError(f"{name}: got {value!r}, expected an integer of at least 3")
        if self.pitch is not None and not (np.isfinite(self.pitch) and self.pitch > 0.0):
            raise InputError(f"pitch: got {self.pitch!r}, expected a number of pixels > 0, or none")
        for name, known in (("layout", tuple(BASIS)), ("marks", ("pinholes", "dots"))):
            if getattr(self, name) not in known:
                got = getattr(self, name)
                raise InputError(f"{name}: got {got!r}, expected {known[0]} or {known[1]}")


@dataclass(frozen=True, eq=False)
class GridImage:
    """The marks of a target that were found in a frame, row by row.

    Attributes
    ----------
    row, column : ndarray of int, shape (n,)
        From 0 where the whole target is seen, else from the mark nearest to the middle.
    u, v : ndarray, shape (n,), pixel
        Centroids, from the middle of the frame; their errors are up to twice the photons' limit.
    flux : ndarray, shape (n,), counts
        Of each mark, roughly; of a dot, what it keeps away.
    x, y : ndarray, shape (n,), pixel
        Undistorted positions: a regular lattice that touches the marks' in the middle of the frame.
    pitch : float, pixel
        Of that lattice.
    message : str
        One line: what was found and what was left out.
    """

    row: Ints
    column: Ints
    u: Floats
    v: Floats
    flux: Floats
    x: Floats
    y: Floats
    pitch: float
    message: str


def index_grid(counts: Floats, valid: Flags, target: GridTarget, width: float) -> GridImage:
    """Find the marks of a target and say which is which.

    Parameters
    ----------
    counts : ndarray, shape (ny, nx), counts
    valid : ndarray of bool, shape (ny, nx)
        The pixels to use.
    target : GridTarget
    width : float, recorded pixel
        Gaussian width of a mark's image, within a factor of 2.

    Returns
    -------
    GridImage
        A grid looks the same when it is turned: columns run as nearly along u as the numbers of
        rows and columns allow, rows along v.

    Raises
    ------
    InputError
        There is no such grid in the frame, or it has more rows or columns.

    Examples
    --------
    >>> v, u = np.mgrid[:61, :81]
    >>> waves = np.cos(np.pi * u / 10.0) ** 8 * np.cos(np.pi * v / 10.0) ** 8
    >>> frame = np.round(5.0 + 1000.0 * waves)
    >>> index_grid(frame, frame >= 0.0, GridTarget(rows=5, columns=7), width=1.5).message
    '35 of 5 x 7 marks found, pitch 10.00 pixels, rotated by 0.00 degrees'
    """
    if not (np.isfinite(width) and width > 0.0):
        raise InputError(f"width: got {width!r}, expected a number of pixels > 0")
    sign = -1.0 if target.marks == "dots" else 1.0
    variance = np.maximum(counts, 1.0)
    points, flux = find_marks(sign * counts, variance, valid, width, target.rows * target.columns)
    # peaks of the noise beside a mark can take its place in the lattice
    brightest = np.sort(flux)[-target.rows * target.columns :]
    real = flux > FAINTEST * np.median(brightest) if len(flux) else np.zeros(0, dtype=bool)
    points, flux = points[real], flux[real]
    lattice = index_points(points, flux, target.layout)
    number = len(lattice.points)
    bright = np.sum(flux > 0.3 * np.median(flux[lattice.points])) if number else 0
    if number < max(FEWEST, SHARE * bright) or lattice.scatter > SCATTER:
        raise InputError(
            f"grid: got {len(points)} marks in the frame of which {number} lie on a grid, expected "
            f"{target.rows} x {target.columns} {target.marks} in a {target.layout} grid: check the "
            "layout, the marks and the width of the PSF"
        )
    peaks, points, flux = len(points), points[lattice.points], flux[lattice.points]
    kept, row, column, whole, mirrored = _label(points, lattice, target)
    order = np.lexsort((column[kept], row[kept]))
    kept = kept[order]
    row, column, points, flux = row[kept], column[kept], points[kept], flux[kept]
    position, pitch, angle = _place(points, row, column, target.layout)
    said = [
        f"{len(row)} of {target.rows} x {target.columns} marks found",
        f"pitch {pitch:.2f} pixels",
        f"rotated by {round(angle, 2) + 0.0:.2f} degrees" + (" and mirrored" if mirrored else ""),
    ]
    if target.pitch is not None and not 0.8 < pitch / target.pitch < 1.25:
        said[1] += f" (not {target.pitch:g} as given)"
    left = peaks - len(row)
    notes = [
        "; not the whole grid: rows and columns count from the mark nearest to the middle"
        if not whole else "",
        f"; other peaks left out: {left}" if left else "",
    ]  # fmt: skip
    u, v = points.T.copy()
    x, y = position.T.copy()
    return GridImage(row, column, u, v, flux, x, y, pitch, ", ".join(said) + "".join(notes))


def _label(
    points: Floats, lattice: Lattice, target: GridTarget
) -> tuple[Ints, Ints, Ints, bool, bool]:
    """Which points belong to the target, their rows and columns, whether all of it, and mirrored.

    Rows and columns are of all points.
    """
    near = np.argsort(np.hypot(*points.T))[:MIDDLE]
    cells = lattice.cells - lattice.cells[near[0]]
    fit, _ = local_fit(cells[near].astype(np.float64), points[near], 1)
    choices = []
    for matrix in orientations(target.layout):
        turned = np.rint(cells @ matrix.T).astype(np.int64)
        along = np.linalg.inv(matrix)[:, 0] @ fit[1:3]
        angle = round(abs(float(np.arctan2(along[1], along[0]))), 6)
        kept, row, column = _window(turned, target)
        row, column = row - row[kept].min(), column - column[kept].min()
        rows, columns = int(row[kept].max()) + 1, int(column[kept].max()) + 1
        whole = rows == target.rows and columns == target.columns
        whole = whole and _complete(row[kept], column[kept], target)
        if not whole:
            row, column = _rows(turned, target, 0)
        mirrored = bool(np.linalg.det(matrix) < 0.0)
        rank = len(cells) - len(kept), not whole, mirrored, angle
        choices.append((rank, kept, row, column))
    rank, kept, row, column = min(choices, key=lambda choice: choice[0])
    beyond, partial, mirrored = rank[:3]
    if beyond > max(2, STRAY * len(cells)):
        raise InputError(
            f"grid: got {np.ptp(row) + 1} rows and {np.ptp(column) + 1} columns in the frame, "
            f"expected at most {target.rows} and {target.columns}: correct rows, columns or layout"
        )
    return kept, row, column, not partial, mirrored


def _rows(cells: Ints, target: GridTarget, first: int) -> tuple[Ints, Ints]:
    """Rows, from a first one that is not shifted, and columns."""
    row = cells[:, 1] - first
    return row, cells[:, 0] + (row // 2 if target.layout == "hexagonal" else 0)


def _window(cells: Ints, target: GridTarget) -> tuple[Ints, Ints, Ints]:
    """The points in those rows and columns, as many as the target has, that hold most points."""
    first = _fullest(cells[:, 1], target.rows)
    row, column = _rows(cells, target, first)
    kept = (row >= 0) & (row < target.rows)
    column = column - _fullest(column[kept], target.columns)
    return np.flatnonzero(kept & (column >= 0) & (column < target.columns)), row, column


def _complete(row: Ints, column: Ints, target: GridTarget) -> bool:
    """Whether the marks are most of the target, up to its border on all four sides.

    Part of a hexagonal grid may by chance have the right numbers along another axis.
    """
    across = np.bincount(row)[[0, -1]] >= BORDER * target.columns
    along = np.bincount(column)[[0, -1]] >= BORDER * target.rows
    return bool(all(across) and all(along) and len(row) > MOST * target.rows * target.columns)


def _fullest(numbers: Ints, length: int) -> int:
    """Where the window of a length begins that holds most numbers."""
    least = int(numbers.min())
    each = np.bincount(numbers - least)
    return least + int(np.argmax(np.convolve(each, np.ones(length, np.int64))[length - 1 :]))


def _place(points: Floats, row: Ints, column: Ints, layout: str) -> tuple[Floats, float, float]:
    """Undistorted positions, shape (n, 2), the pitch in pixels and the rotation in degrees."""
    shifted = 0.5 * (row % 2) if layout == "hexagonal" else 0.0
    plane = np.stack([column + shifted, row * BASIS[layout][1, 1]], axis=1)
    distance = np.hypot(*points.T)
    nearest = int(np.argmin(distance))
    spacing = np.sort(np.hypot(*(points - points[nearest]).T))[1]
    # where the middle of the frame is off the grid, the mark nearest to it takes its place
    middle = np.zeros(2) if distance[nearest] < spacing else points[nearest]
    near = np.argsort(np.hypot(*(points - middle).T))[:MIDDLE]
    place = plane[nearest]
    for _ in range(4):
        fits = (local_fit(plane[near] - place, points[near], degree) for degree in (3, 2, 1))
        fit = next(fit for fit, leverage in fits if leverage < 1.0)
        place = place + np.linalg.solve(fit[1:3].T, middle - fit[0])
    side = np.array([1.0, np.sign(np.linalg.det(fit[1:3]))])
    derivative = fit[1:3].T * side
    c = 0.5 * (derivative[0, 0] + derivative[1, 1])
    s = 0.5 * (derivative[1, 0] - derivative[0, 1])
    turn = np.array([[c, -s], [s, c]]) * side
    position = middle + (plane - place) @ turn.T
    return np.asarray(position), float(np.hypot(c, s)), float(np.degrees(np.arctan2(s, c)))
