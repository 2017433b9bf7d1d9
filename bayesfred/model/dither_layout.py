"""Where the parameters of dithered frames are, and what they say of every frame.

`dithered` has the equations. A vector holds the free coefficients of the distortion, then of every
frame its pointing, turn and own parameters, then x and y of every source.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.io.serialize import KEY, TAGS
from bayesfred.model.movable import Matrix
from bayesfred.model.posterior import Posterior

POINTING = ("pointing_x", "pointing_y", "turn")


class FramePart(NamedTuple):
    """Where the parameters of a frame are in a vector of all.

    Attributes
    ----------
    theta : ndarray of int
        Which of the frame's parameters are free coefficients of the distortion.
    own : ndarray of int
        Which of them are its own.
    columns : ndarray of int
        Where the latter are among all parameters.
    pointing : ndarray of int, shape (3,)
        Where the pointing and the turn are; -1 where they are given.
    members : ndarray of int, shape (s,)
        Numbers of the frame's sources.
    """

    theta: Ints
    own: Ints
    columns: Ints
    pointing: Ints
    members: Ints


@dataclass(frozen=True, eq=False)
class DitherLayout:
    """The order of the parameters of a `DitheredPosterior`, which documents the fields."""

    frames: Mapping[str, Posterior]
    members: Mapping[str, Ints]
    pointings: Mapping[str, tuple[float, ...]]
    turned: bool
    fixed: Mapping[str, float]

    @cached_property
    def n_sources(self) -> int:
        """Number of sources."""
        return 1 + max(int(rows.max()) for rows in self.members.values())

    @property
    def coefficients(self) -> tuple[str, ...]:
        """Names of the distortion's coefficients, the fixed ones among them."""
        return next(iter(self.frames.values())).model.polynomial.names

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Coefficients, every frame's own parameters, then x and y of every source."""
        field = self.coefficients
        names = [name for name in field if name not in self.fixed]
        for k, (name, frame) in enumerate(self.frames.items()):
            if k > 0:
                names += [f"{name}.{each}" for each in POINTING[: 3 if self.turned else 2]]
            names += [f"{name}.{each}" for each in frame.parameter_names if each not in field]
        return (*names, *(f"{axis}_{s}" for s in range(self.n_sources) for axis in "xy"))

    @property
    def n_dense(self) -> int:
        """Number of parameters that are no positions; they come first."""
        return len(self.names) - 2 * self.n_sources

    def start(self) -> Floats:
        """Where a search may begin: no distortion, and positions from the frames' catalogues."""
        out = np.zeros(len(self.names))
        count, total = np.zeros(self.n_sources), np.zeros((self.n_sources, 2))
        for (name, frame), part in zip(self.frames.items(), self.parts, strict=True):
            x, y, turn = self.pointings[name]
            free = part.pointing >= 0
            out[part.pointing[free]] = np.array([x, y, turn])[free]
            out[part.columns] = frame.start()[part.own]
            sources = np.stack([frame.model.sources.x, frame.model.sources.y], axis=1)
            total[part.members] += (sources - [x, y]) @ rotation(turn)
            count[part.members] += 1.0
        out[self.n_dense :] = (total / count[:, None]).ravel()
        return out

    @cached_property
    def parts(self) -> tuple[FramePart, ...]:
        """Where every frame's parameters are."""
        place = {name: k for k, name in enumerate(self.names)}
        field = self.coefficients
        free = [k for k, name in enumerate(field) if name not in self.fixed]
        found = []
        for name, frame in self.frames.items():
            own = [k for k, each in enumerate(frame.parameter_names) if each not in field]
            columns = [place[f"{name}.{frame.parameter_names[k]}"] for k in own]
            pointing = [place.get(f"{name}.{each}", -1) for each in POINTING]
            theta, mine, at, pose = (
                np.array(each, dtype=np.int64) for each in (free, own, columns, pointing)
            )
            found.append(FramePart(theta, mine, at, pose, self.members[name]))
        return tuple(found)

    def positions(self, params: Floats) -> Floats:
        """The sources' positions in the object plane, shape (n, 2), fine pixel."""
        return np.asarray(params)[self.n_dense :].reshape(-1, 2)

    def pose(self, name: str, params: Floats) -> tuple[Floats, float]:
        """The pointing of a frame, shape (2,), fine pixel, and its turn, degree.

        Parameters
        ----------
        name : str
        params : ndarray, shape (d,)
        """
        part = self.parts[list(self.frames).index(name)]
        given = self.pointings[name]
        x, y, turn = (
            g if k < 0 else float(params[k]) for k, g in zip(part.pointing, given, strict=True)
        )
        return np.array([x, y]), turn

    def frame_params(self, name: str, params: Floats) -> Floats:
        """The parameters of a frame's own posterior, shape (d_i,).

        Parameters
        ----------
        name : str
        params : ndarray, shape (d,)
        """
        part = self.parts[list(self.frames).index(name)]
        out = np.zeros(self.frames[name].n_parameters)
        out[: len(self.coefficients)] = self.theta(params)
        out[part.own] = params[part.columns]
        return out

    def theta(self, params: Floats) -> Floats:
        """All coefficients of the distortion, the fixed ones among them, shape (n_terms,)."""
        out = np.array([self.fixed.get(name, 0.0) for name in self.coefficients])
        out[self.parts[0].theta] = params[: self.parts[0].theta.size]
        return out

    def frame_positions(self, name: str, params: Floats) -> Floats:
        """Where a frame's sources are in its own field, shape (s, 2), fine pixel.

        Parameters
        ----------
        name : str
        params : ndarray, shape (d,)
        """
        shift, turn = self.pose(name, params)
        return self.positions(params)[self.members[name]] @ rotation(turn).T + shift

    def change(self, name: str, vector: Floats) -> Matrix:
        """Derivatives of a frame's parameters and its sources' positions by all parameters.

        Parameters
        ----------
        name : str
        vector : ndarray, shape (d,)

        Returns
        -------
        sparse matrix, shape (d_i + 2 s, d)
        """
        part = self.parts[list(self.frames).index(name)]
        size, d = self.frames[name].n_parameters, vector.size
        s, (_, turn) = part.members.size, self.pose(name, vector)
        theta = np.arange(part.theta.size)
        rows, columns = [part.theta, part.own], [theta, part.columns]
        values = [np.ones(theta.size), np.ones(part.own.size)]
        matrix, each = rotation(turn), size + 2 * np.arange(s)
        for i in (0, 1):
            for j in (0, 1):
                rows.append(each + i)
                columns.append(self.n_dense + 2 * part.members + j)
                values.append(np.full(s, matrix[i, j]))
        at = self.positions(vector)[part.members]
        by_turn = at @ np.radians(rotation(turn + 90.0)).T  # R' = R(a + 90 degrees), per degree
        moves = np.broadcast_to(np.eye(2)[:, :, None], (2, 2, s)), by_turn.T[:, None]
        for i in (0, 1):
            for k, move in zip(part.pointing, (*moves[0][i], *moves[1][i]), strict=True):
                if k >= 0:
                    rows.append(each + i)
                    columns.append(np.full(s, k))
                    values.append(move)
        at_rows, at_columns = np.concatenate(rows), np.concatenate(columns)
        return sparse.csr_matrix((np.concatenate(values), (at_rows, at_columns)), (size + 2 * s, d))


def rotation(turn: float) -> Floats:
    """The matrix R(a) of an angle in degrees, shape (2, 2)."""
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    return np.array([[c, -s], [s, c]])


def check_frames(
    frames: Mapping[str, Posterior],
    members: Mapping[str, Any],
    pointings: Mapping[str, Sequence[float]],
) -> None:
    """Refuse frames that are not of one instrument, or whose sources cannot be moved.

    Raises
    ------
    InputError
        It names the frame.
    """
    if not frames:
        raise InputError("frames: got none, expected at least one")
    if wrong := [name for name in frames if name in TAGS or not KEY.fullmatch(name)]:
        raise InputError(
            f"frames: got the name {wrong[0]!r}, expected letters, digits, underscores and "
            "hyphens, and neither kind nor keys"
        )
    first = next(iter(frames.values()))
    for name, frame in frames.items():
        n = frame.nuisances
        if n.flux != "free" or n.offset or n.position_scatter or n.footprint is not None:
            raise InputError(
                f"frames: {name}: nuisances: got flux = {n.flux!r}, offset = {n.offset}, "
                f"position_scatter = {n.position_scatter}, footprint = {n.footprint}, expected "
                "free fluxes and none of the others: positions and pointings are free already"
            )
        if frame.model.polynomial != first.model.polynomial:
            raise InputError(f"frames: {name}: got another distortion than the first frame's")
        if np.shape(members.get(name, ())) != (len(frame.model.sources),):
            raise InputError(
                f"members: {name}: got {np.shape(members.get(name, ()))}, expected a number for "
                f"each of its {len(frame.model.sources)} sources"
            )
        if np.shape(pointings.get(name, ())) != (3,):
            raise InputError(
                f"pointings: {name}: got {pointings.get(name)}, expected x and y in pixels and a "
                "turn in degrees"
            )
