"""Where the catalogue is in the frame, if it is not where the model has it.

What people get wrong is tried on the detected peaks: an origin in the corner, axes that run the
other way or are exchanged, a shift, a rotation, a scale. For a map M of the catalogue every pair of
a peak p and a source c votes for the shift p - M c; the right map puts many votes into one place.
From there the matching goes on with affine maps and then cubic ones, which bend with the lens.
"""

from itertools import product
from typing import NamedTuple

import numpy as np
from scipy import spatial

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.causes.context import Context
from bayesfred.optimize.peaks import find_peaks

MOST_SOURCES, MOST_PEAKS = 80, 160  # that vote
COARSE = 0.02  # of the frame's side: how far a lens may move what votes for one place
FEWEST = 6  # sources that have to be found
MORE = 1.2  # times as many votes as the catalogue as it is, or it stays as it is
ANGLES, SCALES = np.arange(0.0, 360.0, 4.0), np.geomspace(0.8, 1.25, 7)
CUBIC_FROM = 16  # pairs
TURNS = 12
WIDER = 1.5  # times the tolerance of the votes, for the first matches


class Placement(NamedTuple):
    """The catalogue as the peaks show it.

    Attributes
    ----------
    sources : ndarray, shape (n,)
        Rows of the catalogue that have a peak.
    position : ndarray, shape (n, 2), recorded pixel
        Their peaks, from the frame's middle.
    map : ndarray, shape (2, 2)
        What turns the catalogue's positions into those of the peaks, but for the shift.
    shift : ndarray, shape (2,), recorded pixel
    """

    sources: Ints
    position: Floats
    map: Floats
    shift: Floats


def find_placement(context: Context) -> Placement | None:
    """Look for the catalogue among the peaks; None where it is not found."""
    model = context.posterior.model
    step = model.detector.binning
    peaks = find_peaks(context.posterior) / step
    catalogue = np.stack([model.sources.x, model.sources.y], axis=1) / step
    if min(len(peaks), len(catalogue)) < FEWEST:
        return None
    brightest = catalogue[np.argsort(-model.sources.flux)[:MOST_SOURCES]]
    votes = _Votes(peaks[:MOST_PEAKS], brightest, context)
    as_it_is = np.eye(2)
    best = votes.count(as_it_is), as_it_is
    for signs in product((1.0, -1.0), repeat=2):
        for swap in (False, True):
            other = np.diag(signs)[::-1] if swap else np.diag(signs)
            best = _better(best, (votes.count(other), other))
    if best[0][0] < 0.5 * min(len(brightest), len(peaks)):
        for parity, angle, scale in product((1.0, -1.0), np.deg2rad(ANGLES), SCALES):
            c, s = scale * np.cos(angle), scale * np.sin(angle)
            other = np.array([[c, -s * parity], [s, c * parity]])
            best = _better(best, (votes.count(other), other))
    (_, shift), found = best
    return _refine(context, peaks, catalogue, (found, shift, WIDER * votes.tolerance))


def _better(
    best: tuple[tuple[float, Floats], Floats], other: tuple[tuple[float, Floats], Floats]
) -> tuple[tuple[float, Floats], Floats]:
    """The other, if it has more votes; clearly more than the catalogue as it is."""
    same = np.array_equal(best[1], np.eye(2))
    return other if other[0][0] > (MORE if same else 1.0) * best[0][0] else best


class _Votes:
    """Pairs of peaks and sources vote for a shift."""

    def __init__(self, peaks: Floats, sources: Floats, context: Context) -> None:
        self.peaks, self.sources = peaks, sources
        side = max(context.expected.shape)
        self.tolerance = max(2.5 * context.light.width, COARSE * side)
        self.across = int(np.ceil(2.0 * side / self.tolerance)) + 2

    def count(self, matrix: Floats) -> tuple[float, Floats]:
        """Most votes in a square of two tolerances, and its middle."""
        shifts = (self.peaks[:, None] - self.sources @ matrix.T).reshape(-1, 2)
        cell = np.floor(shifts / self.tolerance).astype(int) + self.across // 2
        inside = ((cell >= 0) & (cell < self.across - 1)).all(axis=1)
        flat = cell[inside, 0] * self.across + cell[inside, 1]
        number = np.bincount(flat, minlength=self.across**2).reshape(self.across, -1)
        square = number[:-1, :-1] + number[1:, :-1] + number[:-1, 1:] + number[1:, 1:]
        best = int(np.argmax(square))
        corner = np.array(divmod(best, square.shape[1])) + 1 - self.across // 2
        near = np.abs(shifts - corner * self.tolerance).max(axis=1) <= self.tolerance
        # a source votes once for a place
        voters = np.flatnonzero(near) % len(self.sources)
        middle = shifts[near].mean(axis=0) if near.any() else np.zeros(2)
        return float(np.unique(voters).size), middle


def _refine(
    context: Context, peaks: Floats, catalogue: Floats, guess: tuple[Floats, Floats, float]
) -> Placement | None:
    """Match with maps of growing freedom."""
    matrix, shift, tolerance = guess
    predicted, tree = catalogue @ matrix.T + shift, spatial.cKDTree(peaks)
    least = 2.0 * context.light.width
    pairs = np.empty((2, 0), int)
    for turn in range(TURNS):
        distance, nearest = tree.query(predicted)
        close = np.flatnonzero(distance < tolerance)
        close = close[np.argsort(distance[close])]
        _, first = np.unique(nearest[close], return_index=True)  # each peak is the nearest one's
        pairs = np.stack([close[first], nearest[close[first]]])
        if pairs.shape[1] < FEWEST:
            return None
        degree = 3 if turn > 1 and pairs.shape[1] >= CUBIC_FROM else 1
        predicted, affine = _polynomial(catalogue, pairs, peaks, degree)
        tolerance = max(least, 0.85 * tolerance)
    area = float(np.prod(np.ptp(peaks, axis=0))) + 1.0
    half = 0.5 * np.array(context.expected.shape[::-1])
    seen = (np.abs(predicted) < half).all(axis=1)
    by_chance = seen.sum() * min(1.0, len(peaks) * np.pi * tolerance**2 / area)
    # as many pairs as there are terms lie on the polynomial whatever they are
    terms = 10 if degree == 3 else 3
    if pairs.shape[1] - terms < max(0.5 * (seen.sum() - terms), 1.5 * by_chance):
        return None
    return Placement(pairs[0], peaks[pairs[1]], affine[1:].T, affine[0])


def _polynomial(
    catalogue: Floats, pairs: Ints, peaks: Floats, degree: int
) -> tuple[Floats, Floats]:
    """Positions of all sources by a polynomial through the pairs, and its affine part."""
    unit = np.abs(catalogue).max() + 1e-9
    powers = [(i, j) for n in range(degree + 1) for i in range(n, -1, -1) for j in (n - i,)]
    design = np.stack([(catalogue[:, 0] / unit) ** i * (catalogue[:, 1] / unit) ** j
                       for i, j in powers], axis=1)  # fmt: skip
    found, *_ = np.linalg.lstsq(design[pairs[0]], peaks[pairs[1]], rcond=1e-9)
    scaled = found[:3].copy()
    scaled[1:] /= unit
    return np.asarray(design @ found), scaled
