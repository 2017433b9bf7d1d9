"""Points indexed as a lattice that a camera distorts, without a list of positions.

A cell is a pair of whole numbers (i, j). Undistorted, its point lies at i e1 + j e2 in the plane of
the target, in units of the pitch: e1 = (1, 0), and e2 = (0, 1) for a square lattice or (1/2,
sqrt(3)/2) for a hexagonal one. Between neighbours any distortion is smooth. So a lattice is seeded
with the two vectors that are repeated most among a few neighbouring points. It grows by the cells
next to it: each is predicted by a polynomial of degree 2 (or 1) through the cells around it, and
filled with the point within `GATE` pitches of the prediction. A point that two cells claim goes to
the nearer one. Then every point is compared with the polynomial through the others around it, and
what does not agree is removed before the lattice grows again.

A lattice looks the same after the rotations and mirrorings of its symmetry group. `orientations`
lists them, for `grid_target` to choose one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy import spatial

from bayesfred._typing import Flags, Floats, Ints

__all__ = ["BASIS", "Lattice", "index_points", "local_fit", "orientations"]

BASIS = {
    "square": np.eye(2),
    "hexagonal": np.array([[1.0, 0.5], [0.0, 0.75**0.5]]),  # columns e1 and e2
}
GATE = 0.2  # farthest a point lies from its prediction, in pitches
REACH = 2.3  # a cell is predicted from marks nearer than this, in pitches: across one missing row
WIDE = 3.3  # ... or, where these do not determine it, nearer than this
ALIKE = 0.18  # two vectors of a seed are taken for one, in parts of their length
OUTLIER = 6.0  # of a residual, in standard deviations of all, where it is more than ...
SLACK = 0.04  # ... this, in pitches
ROUGH = 3.0  # a prediction by a plane is less good by this factor
FLUX = 4.0  # a mark is brighter or fainter than its neighbours by less than this factor
SEEDS = 24
ROUNDS = 4
LOCAL = 25  # points from which a seed's vectors are found


class Lattice(NamedTuple):
    """Points and their cells.

    Attributes
    ----------
    points : ndarray of int, shape (n,)
        Which points are on the lattice.
    cells : ndarray of int, shape (n, 2)
        i and j of each.
    scatter : float, pitch
        Typical distance between a point and the prediction of the others around it.
    """

    points: Ints
    cells: Ints
    scatter: float


def orientations(layout: str) -> list[Ints]:
    """The symmetry group of a lattice, as matrices that act on cells."""
    turn = np.array([[0, -1], [1, int(layout == "hexagonal")]])
    turns = [np.linalg.matrix_power(turn, k) for k in range(6 if layout == "hexagonal" else 4)]
    swap = np.array([[0, 1], [1, 0]])
    return [*turns, *(swap @ t for t in turns)]


def index_points(points: Floats, flux: Floats, layout: str) -> Lattice:
    """Index the points of the largest lattice that grows from a seed near the middle.

    Parameters
    ----------
    points : ndarray, shape (m, 2), pixel
        From the middle of the frame; the points of no lattice may be among them.
    flux : ndarray, shape (m,), any unit
    layout : {"square", "hexagonal"}

    Returns
    -------
    Lattice
        Cells count from a point of the lattice; e2 is turned from e1 as v from u. No points where
        there is no lattice.

    Examples
    --------
    >>> v, u = np.mgrid[-20:21:10, -20:21:10].reshape(2, -1)
    >>> lattice = index_points(np.stack([u, v], axis=1) + 0.5, np.ones(25), "square")
    >>> len(lattice.points), np.ptp(lattice.cells, axis=0).tolist()
    (25, [4, 4])
    """
    best = Lattice(np.zeros(0, np.int64), np.zeros((0, 2), np.int64), np.inf)
    if len(points) < 4:
        return best
    tree = spatial.cKDTree(points)
    tried = np.zeros(len(points), dtype=bool)
    # a seed in what has been indexed, or beside one that failed, would give the same again
    for seed in np.argsort(np.hypot(*points.T))[: 10 * SEEDS].tolist():
        if tried[seed] or len(best.points) > 0.5 * len(points) or tried.sum() > SEEDS * LOCAL:
            continue
        vectors = _vectors(points, tree, seed, layout)
        tried[seed] = True
        if vectors is None:
            continue
        found = _Growth(points, flux, tree, layout, vectors).run(seed)
        if len(found.points) > len(best.points):
            best = found
        tried[found.points] = True
    return best


def local_fit(plane: Floats, position: Floats, degree: int) -> tuple[Floats, float]:
    """Fit positions with a polynomial of the place in the lattice's plane.

    Parameters
    ----------
    plane : ndarray, shape (n, 2), pitch
        From the point where the polynomial is wanted.
    position : ndarray, shape (n, 2), pixel
    degree : int

    Returns
    -------
    coefficients : ndarray, shape (k, 2)
        Of 1, x, y and then the higher powers.
    leverage : float
        Variance of the value there, in units of a position's variance; infinite where the points do
        not determine it.
    """
    powers = [(n - m, m) for n in range(degree + 1) for m in range(n + 1)]
    if len(plane) < len(powers):
        return np.zeros((len(powers), 2)), np.inf
    matrix = np.stack([plane[:, 0] ** i * plane[:, 1] ** j for i, j in powers], axis=1)
    size = np.sqrt((matrix**2).sum(axis=0))
    left, values, right = np.linalg.svd(matrix / np.maximum(size, 1e-9), full_matrices=False)
    if values[-1] < 1e-3 * values[0]:
        return np.zeros((len(powers), 2)), np.inf
    inverse = right.T / values / size[:, None]
    return inverse @ (left.T @ position), float(np.sum(inverse[0] ** 2))


def _vectors(points: Floats, tree: Any, seed: int, layout: str) -> Floats | None:
    """Two lattice vectors at a point, as the columns of a matrix; None where none are repeated."""
    number = min(LOCAL, len(points))
    _, near = tree.query(points[seed], k=number)
    _, others = tree.query(points[near], k=min(9, number))
    all_ = (points[others[:, 1:]] - points[near][:, None]).reshape(-1, 2)
    all_ = np.concatenate([all_, -all_])
    length = np.hypot(*all_.T)
    apart = np.hypot(*(all_[:, None] - all_[None]).T).T
    alike = apart < ALIKE * length[:, None]
    votes = alike.sum(axis=1)
    frequent = np.flatnonzero(votes >= max(0.5 * votes.max(), 4))
    if not frequent.size:
        return None
    first = all_[alike[frequent[np.argmin(length[frequent])]]].mean(axis=0)
    angle = np.pi / 3.0 if layout == "hexagonal" else np.pi / 2.0
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    there = np.hypot(*(all_ - turn @ first).T) < 0.3 * np.hypot(*first)
    if not there.any():
        return None
    second = all_[alike[np.flatnonzero(there)[np.argmax(votes[there])]] & there].mean(axis=0)
    return np.stack([first, second], axis=1)


class _Growth:
    """A lattice that grows from a seed."""

    def __init__(
        self, points: Floats, flux: Floats, tree: Any, layout: str, vectors: Floats
    ) -> None:
        self.points, self.flux, self.tree = points, flux, tree
        self.basis = BASIS[layout]
        self.vectors = vectors @ np.linalg.inv(self.basis)  # pixels per pitch
        span = np.arange(-4, 5)
        steps = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
        distance = np.hypot(*(self.basis @ steps.T))
        order = np.argsort(distance, kind="stable")
        order = order[(distance[order] > 0.0) & (distance[order] < WIDE)]
        self.wide = [(int(i), int(j)) for i, j in steps[order]]
        self.around = self.wide[: int(np.sum(distance[order] < REACH))]
        self.places = {step: self.basis @ step for step in self.wide}
        self.next = self.around[: 6 if layout == "hexagonal" else 4]
        self.cells: dict[tuple[int, int], int] = {}
        self.banned: set[tuple[tuple[int, int], int]] = set()

    def run(self, seed: int) -> Lattice:
        self.cells = {(0, 0): seed}
        scatter = np.inf
        for _ in range(ROUNDS):
            self._grow()
            scatter, removed = self._reject()
            if not removed:
                break
        if (0, 0) not in self.cells and len(self.cells) < 4:
            self.cells = {}
        cells = np.array(list(self.cells), dtype=np.int64).reshape(-1, 2)
        return Lattice(np.array(list(self.cells.values()), dtype=np.int64), cells, scatter)

    def _near(self, cell: tuple[int, int], steps: list[tuple[int, int]]) -> list[tuple[int, int]]:
        """Those of the steps from a cell that lead to filled ones."""
        i, j = cell
        return [step for step in steps if (i + step[0], j + step[1]) in self.cells]

    def _predict(self, cell: tuple[int, int]) -> tuple[Floats, float, int] | None:
        """Where a cell's point should be, the pitch there in pixels, and the degree of the fit."""
        for degree, steps, fewest, most in (
            (2, self.around, 8, 12.0), (2, self.wide, 8, 12.0), (1, self.around, 4, 4.0),
        ):  # fmt: skip
            near = self._near(cell, steps)
            place = np.array([self.places[step] for step in near]).reshape(-1, 2)
            position = self.points[[self.cells[cell[0] + i, cell[1] + j] for i, j in near]]
            if len(near) >= fewest:
                fit, leverage = local_fit(place, position, degree)
                if leverage < most:
                    scale = abs(float(np.linalg.det(fit[1:3]))) ** 0.5
                    return fit[0], scale, degree
        if near and len(self.cells) < 6:  # so far the seed's vectors alone are known
            pitch = abs(float(np.linalg.det(self.vectors))) ** 0.5
            return (position - place @ self.vectors.T).mean(axis=0), pitch, 0
        return None

    def _grow(self) -> None:
        """Fill cells until nothing is next to the lattice."""
        failed: dict[tuple[int, int], int] = {}
        while True:
            claims: dict[Any, tuple[float, tuple[int, int]]] = {}
            taken = set(self.cells.values())
            candidates = {
                (i + step[0], j + step[1])
                for i, j in self.cells
                for step in (self.next if len(self.cells) < 6 else self.around)
            } - self.cells.keys()
            for cell in candidates:
                support = len(self._near(cell, self.wide))
                if failed.get(cell) == support:
                    continue
                failed[cell] = support
                predicted = self._predict(cell)
                if predicted is None:
                    continue
                centre, pitch, _ = predicted
                distance, point = self.tree.query(centre, distance_upper_bound=GATE * pitch)
                free = point not in taken and (cell, point) not in self.banned
                if np.isfinite(distance) and free:
                    claims[point] = min(claims.get(point, (np.inf, cell)), (distance, cell))
            if not claims:
                return
            self.cells |= {cell: point for point, (_, cell) in claims.items()}

    def _reject(self) -> tuple[float, bool]:
        """Remove what does not agree with its neighbours: the scatter, and whether any was."""
        if len(self.cells) < 4:
            return np.inf, False
        cells = list(self.cells)
        residual = np.full(len(cells), np.inf)
        ratio = np.ones(len(cells))
        for k, cell in enumerate(cells):
            predicted = self._predict(cell)
            near = [self.cells[cell[0] + i, cell[1] + j] for i, j in self._near(cell, self.around)]
            if near:
                ratio[k] = self.flux[self.cells[cell]] / np.median(self.flux[near])
            if predicted is not None and predicted[1] > 0.0:
                residual[k] = np.hypot(*(self.points[self.cells[cell]] - predicted[0]))
                residual[k] /= predicted[1] * (1.0 if predicted[2] == 2 else ROUGH)
        known = np.isfinite(residual)
        if not known.any():
            return np.inf, False
        # 1.18 is the median of a two-dimensional normal's distance
        scatter = float(np.median(residual[known])) / 1.18
        bad: Flags = residual > max(OUTLIER * scatter, SLACK)
        bad |= (ratio > FLUX) | (ratio < 1.0 / FLUX)
        # a bad point spoils the predictions of those around it: the worst there goes first
        worst = {cell: residual[k] if known[k] else GATE for k, cell in enumerate(cells)}
        removed = []
        for i, j in (cells[k] for k in np.flatnonzero(bad)):
            dim = not 1.0 / FLUX <= ratio[cells.index((i, j))] <= FLUX
            if dim or worst[i, j] >= max(worst.get((i + a, j + b), 0.0) for a, b in self.next):
                removed.append((i, j))
        self.banned |= {(cell, self.cells.pop(cell)) for cell in removed}
        return scatter, bool(removed)
