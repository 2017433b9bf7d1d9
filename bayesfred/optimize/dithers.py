r"""Dithered frames without a catalogue: which peaks are one source, and where everything is.

Pointings. Where frame j shows the sources of frame i displaced by t, the differences of their peaks
gather at t, blurred by what the distortion changes over a dither. All differences vote in a
histogram; of several widths of its cells the one counts whose highest cell is the least likely by
chance. The pairs of frames that agree best connect all to the first (a spanning tree).

Links. With coefficients theta, pointings t_i and turns a_i, a peak at (u, v) of frame i shows the
object x(u, v; theta) and stands in the common plane at R(a_i)^T (x - t_i). Peaks of different
frames that stand there within a distance r, alone on both sides, are one source. At the peaks

    u - x + f(u, v, x, y) = 0,    v - y + g(u, v, x, y) = 0,    x = R(a_i) X_s + t_i

are solved for theta, t_i, a_i and X_s by Gauss and Newton's method, with Cauchy's weights, under
the prior of theta. Then more peaks are linked, until no more are; then r is halved. So the links
grow from where the distortion changes little, and end at the error of a peak.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import ndimage, sparse, spatial, stats
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from scipy.sparse.linalg import splu

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.imaging.inverse import slopes
from bayesfred.imaging.polynomial import Polynomial
from bayesfred.model.dither_layout import rotation
from bayesfred.model.movable import Matrix

__all__ = ["Links", "link_peaks", "shifts_between"]

BRIGHTEST = 200  # peaks of a frame that vote for its pointing
CELLS = (1.0, 2.0, 4.0, 8.0)  # widths of the PSF: sides of a histogram's cells
CHANCE = 1e-6  # largest probability that the votes agree by chance
CENTROID = 0.2  # error of a peak's position, in widths of the PSF
CLOSEST = 5.0  # such errors: distance within which peaks are linked at last
ROUNDS = 10  # of linking at one distance
STEPS = 3  # of Gauss and Newton's method between them
FEWEST = 3  # sources that two frames must share


class Links(NamedTuple):
    """Peaks that are linked to sources, and what follows from their positions.

    Attributes
    ----------
    theta : ndarray, shape (n_terms,)
    pointings : ndarray, shape (k, 3): fine pixel, fine pixel, degree
    positions : ndarray, shape (n, 2), fine pixel
        Of the sources in the common plane.
    source : tuple of ndarray of int
        For every peak of every frame the number of its source; -1 where it has none.
    """

    theta: Floats
    pointings: Floats
    positions: Floats
    source: tuple[Ints, ...]


def shifts_between(
    peaks: Sequence[Floats], turns: Floats, width: float, names: Sequence[str]
) -> Floats:
    """The pointings of frames from their peaks alone, shape (k, 2), fine pixel.

    Parameters
    ----------
    peaks : sequence of ndarray, shape (n_i, 2), fine pixel
        Positions from the middle of the frame, brightest first.
    turns : ndarray, shape (k,), degree
    width : float, fine pixel
        The PSF's.
    names : sequence of str, length k

    Returns
    -------
    ndarray, shape (k, 2), fine pixel
        That of the first frame is 0.

    Raises
    ------
    InputError
        If a frame's peaks agree with no other frame's.

    Examples
    --------
    >>> sky = np.random.default_rng(1).uniform(-60.0, 60.0, (40, 2))
    >>> shifts_between([sky, sky + [12.0, -5.0]], np.zeros(2), 1.5, ["a", "b"]).round(1).tolist()
    [[0.0, 0.0], [12.0, -5.0]]
    """
    k = len(peaks)
    upright = [p[:BRIGHTEST] @ rotation(a) for p, a in zip(peaks, turns, strict=True)]  # R^T p
    cost, shift = np.zeros((k, k)), np.zeros((k, k, 2))
    for i in range(k):
        for j in range(i + 1, k):
            shift[i, j], log_chance = _vote(upright[i], upright[j], width)
            if log_chance < np.log(CHANCE):
                cost[i, j] = log_chance
    tree = minimum_spanning_tree(sparse.csr_matrix(cost))
    order, before = breadth_first_order(tree, 0, directed=False)
    if len(order) < k:
        lost = ", ".join(names[i] for i in range(k) if i not in order)
        raise InputError(
            f"frames: {lost}: got peaks that agree with {names[0]}'s at no displacement, expected "
            "frames of one field that overlap: check psf.sigma, or give their pointings and turns"
        )
    out = np.zeros((k, 2))
    for j in order[1:]:
        i = before[j]
        out[j] = out[i] + (shift[i, j] if i < j else -shift[j, i])
    return np.array([rotation(a) @ t for a, t in zip(turns, out, strict=True)])


def _vote(one: Floats, other: Floats, width: float) -> tuple[Floats, float]:
    """The displacement on which most pairs agree, and the logarithm of the chance of that."""
    if min(len(one), len(other)) < FEWEST:
        return np.zeros(2), 0.0
    votes = (other[None] - one[:, None]).reshape(-1, 2)
    spans = [np.ptp(p, axis=0) + width for p in (one, other)]
    best, found = 0.0, np.zeros(2)
    for cell in CELLS:
        side = cell * width
        edges = [np.arange(v.min() - 2 * side, v.max() + 3 * side, side) for v in votes.T]
        count, _ = np.histogramdd(votes, bins=edges)
        count = 9.0 * ndimage.uniform_filter(count, 3, mode="constant")
        top = np.unravel_index(np.argmax(count), count.shape)
        middle = np.array([e[i] + 0.5 * side for e, i in zip(edges, top, strict=True)])
        # two fields of uniform density, displaced by this, share this part of their area
        overlap = np.prod(np.maximum(0.5 * (spans[0] + spans[1]) - np.abs(middle), side))
        mean = len(one) * len(other) * overlap * 9.0 * side**2 / np.prod(spans[0] * spans[1])
        log_chance = float(stats.poisson.logsf(round(count[top]) - 1, mean) + np.log(count.size))
        if log_chance < best:
            near = np.abs(votes - middle).max(axis=1) < 1.5 * side
            best, found = log_chance, np.median(votes[near], axis=0)
    return found, best


def link_peaks(
    peaks: Mapping[str, Floats],
    field: Polynomial,
    pointings: Floats,
    width: float,
    *,
    farthest: float,
    sd: Floats,
    turned: bool = False,
    fixed: Mapping[str, float] | None = None,
) -> Links:
    """Link the peaks of all frames to sources.

    Parameters
    ----------
    peaks : mapping of str to ndarray, shape (n_i, 2), fine pixel
        By the frames' names.
    field : Polynomial
    pointings : ndarray, shape (k, 3): fine pixel, fine pixel, degree
        Where to begin.
    width : float, fine pixel
        The PSF's.
    farthest : float, fine pixel
        Distance within which peaks are linked at first.
    sd : ndarray, shape (n_terms,)
        Standard deviations of the prior of theta, whose mean is 0.
    turned : bool
        Whether the turns of all frames but the first are free.
    fixed : mapping of str to float, optional
        Coefficients that are given.

    Returns
    -------
    Links

    Raises
    ------
    InputError
        If a frame shares fewer than three sources with the others.
    """
    given = np.array([(fixed or {}).get(name, np.nan) for name in field.names])
    search = _Search(list(peaks.values()), field, CENTROID * width, sd, turned, given)
    theta, pointings = np.where(np.isnan(given), 0.0, given), pointings.copy()
    links = search.link(theta, pointings, farthest)
    near = farthest
    while True:
        before: list[bytes] = []
        for _ in range(ROUNDS):
            now = b"".join(s.tobytes() for s in links.source)
            if now in before:
                break
            before.append(now)
            for _ in range(STEPS):
                links = search.step(links)
            links = search.link(links.theta, links.pointings, near)
        if near <= CLOSEST * search.error:
            break
        near = max(0.5 * near, CLOSEST * search.error)
        links = search.link(links.theta, links.pointings, near)
    shared = np.array([np.sum(s >= 0) for s in links.source])
    if shared.min() < FEWEST:
        name = list(peaks)[int(np.argmin(shared))]
        raise InputError(
            f"frames: {name}: got {shared.min()} sources that other frames show too, expected at "
            f"least {FEWEST}: check psf.sigma, or give the pointings"
        )
    return links


class _Search:
    """Peaks, and the linear equations of what is linked."""

    def __init__(
        self,
        peaks: Sequence[Floats],
        field: Polynomial,
        error: float,
        sd: Floats,
        turned: bool,
        given: Floats,
    ) -> None:
        self.peaks, self.field, self.error, self.sd = peaks, field, error, sd
        self.free = np.flatnonzero(np.isnan(given))
        self.own = 3 if turned else 2  # numbers of a pointing

    def link(self, theta: Floats, pointings: Floats, near: float) -> Links:
        """Sources of peaks of two frames and more that stand within a distance of each other."""
        places, mean, count = [], np.empty((0, 2)), np.empty(0)
        labels: list[Ints] = []
        for peaks, (x, y, turn) in zip(self.peaks, pointings, strict=True):
            at = np.stack(self.field.object_position(theta, *peaks.T), axis=1) - [x, y]
            at = at @ rotation(turn)
            known = np.flatnonzero(np.isfinite(at).all(axis=1))
            label = np.full(len(at), -1)
            if len(mean) and known.size:
                tree, others = spatial.cKDTree(mean), spatial.cKDTree(at[known])
                alone = others.query_ball_point(mean, near, return_length=True) == 1
                for k, each in zip(known, tree.query_ball_point(at[known], near), strict=True):
                    if len(each) == 1 and alone[each[0]]:
                        label[k] = each[0]
            joined = np.flatnonzero(label >= 0)
            s = label[joined]
            mean[s] += (at[joined] - mean[s]) / (count[s] + 1.0)[:, None]
            count[s] += 1.0
            new = known[label[known] < 0]
            label[new] = len(mean) + np.arange(new.size)
            mean, count = np.vstack([mean, at[new]]), np.append(count, np.ones(new.size))
            places.append(at)
            labels.append(label)
        several = count > 1.0
        number = np.append(np.where(several, np.cumsum(several) - 1, -1), -1)  # of -1 too
        return Links(theta, pointings, mean[several], tuple(number[each] for each in labels))

    def step(self, links: Links) -> Links:
        """A step of Gauss and Newton's method for the links as they are."""
        n, k, p = len(links.positions), len(self.peaks), self.free.size
        if n == 0:
            return links
        rows, right = [], []
        dense = p + self.own * (k - 1)
        for i, (peaks, source) in enumerate(zip(self.peaks, links.source, strict=True)):
            linked = np.flatnonzero(source >= 0)
            row, residual = self._equations(links, i, peaks[linked], source[linked])
            rows.append(row)
            right.append(residual)
        matrix, residual = sparse.vstack(rows).tocsr(), np.concatenate(right)
        off = np.hypot(*residual.reshape(-1, 2).T)
        scale = max(self.error, float(np.median(off)) / 1.18)  # of a two-dimensional normal
        weight = np.repeat(1.0 / (1.0 + (off / (3.0 * scale)) ** 2), 2) / scale**2
        known = np.zeros(dense + 2 * n)
        known[:p] = self.sd[self.free] ** -2.0
        unit = np.ones(known.size)
        unit[:p] = self.sd[self.free]
        scaled = matrix @ sparse.diags(unit)
        normal = scaled.T @ sparse.diags(weight) @ scaled + sparse.diags(known * unit**2)
        normal += sparse.diags(np.full(known.size, 1e-12 * normal.diagonal().max()))
        pull = scaled.T @ (weight * residual)
        pull[:p] -= unit[:p] * known[:p] * links.theta[self.free]
        change = unit * splu(normal.tocsc()).solve(pull)
        theta, pointings = links.theta.copy(), links.pointings.copy()
        theta[self.free] += change[:p]
        pointings[1:, : self.own] += change[p:dense].reshape(-1, self.own)
        positions = links.positions + change[dense:].reshape(-1, 2)
        return Links(theta, pointings, positions, links.source)

    def _equations(
        self, links: Links, i: int, peaks: Floats, source: Ints
    ) -> tuple[Matrix, Floats]:
        """Rows of the linear equations of a frame's linked peaks, and their right-hand side."""
        n, s = len(links.positions), len(peaks)
        turn = links.pointings[i, 2]
        at = links.positions[source]
        x = at @ rotation(turn).T + links.pointings[i, :2]
        point = (*peaks.T, *x.T)
        f, g = self.field.displacement(links.theta, *point)
        residual = np.stack([x[:, 0] - peaks[:, 0] - f, x[:, 1] - peaks[:, 1] - g], axis=1)
        theta = self.field.monomial_coefficients(links.theta)[None]
        split = len(self.field.f_terms)
        terms = (theta[:, :split], self.field.f_terms), (theta[:, split:], self.field.g_terms)
        moves = slopes(*terms, point, images=False)  # derivatives of a, b by x, y
        design = self.field.design_matrix(*point)[..., self.free].transpose(1, 0, 2)
        own = np.zeros((s, 2, self.own * (len(self.peaks) - 1)))
        if i > 0:
            first = self.own * (i - 1)
            own[..., first : first + 2] = moves
            if self.own == 3:
                by_turn = at @ np.radians(rotation(turn + 90.0)).T
                own[..., first + 2] = np.einsum("sij,sj->si", moves, by_turn)
        dense = np.concatenate([design, own], axis=2).reshape(2 * s, -1)
        blocks = moves @ rotation(turn)
        each = np.arange(2 * s).reshape(s, 2)
        rows = np.broadcast_to(each[:, :, None], (s, 2, 2))
        columns = np.broadcast_to(2 * source[:, None, None] + np.arange(2), (s, 2, 2))
        sources = sparse.csr_matrix(
            (blocks.ravel(), (rows.ravel(), columns.ravel())), (2 * s, 2 * n)
        )
        return sparse.hstack([sparse.csr_matrix(dense), sources]).tocsr(), residual.ravel()
