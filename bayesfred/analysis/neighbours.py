"""Displacements of neighbouring sources, which have nothing in common if the model is true.

Whatever displaces sources apart from noise is taken for independent from source to source, by
`position_scatter` or, without it, by nothing at all. A distortion finer than the terms, ghosts
whose light has a slope, or a target that was machined in strokes displace neighbours alike.
Coefficients of terms that change little from one source to the next then err as if there were fewer
sources: with the correlation rho(l) of sources at a distance l their variance is 1 + sum_l rho(l)
times that of independent ones. The sum is taken up to where the correlation ends. Where positions
scatter, `marginalize_displacements` puts such a field into the errors; then neighbours are compared
with what it lets expect.

Halves that alternate do not see it, as `cross_check` takes them: both have it.

References
----------
P. A. P. Moran (1950), Biometrika 37, 17: the mean product of neighbours.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import spatial

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.checks import Check, not_tested
from bayesfred.io.summary_table import Table

FEWEST = 20  # sources
OUTLYING = 3.0  # standard deviations, as which a displacement counts at most
NOTICEABLE = 5.0  # standard deviations of the correlation
FIELD = 0.1  # of the correlation that a field lets expect: its standard deviation, and its form's
LONGEST = 2.0  # median distances between neighbours, beyond which two are none
FOLLOWED = 8  # median distances to which the correlation is followed

NAME = "displacement of neighbours"


class Neighbours(NamedTuple):
    """How far neighbouring sources are displaced alike.

    Attributes
    ----------
    correlation : float
        Of the displacements of neighbours.
    expected : float
        What it is if they have nothing in common but the field that is in the errors, if any.
    sd : float
        Its standard deviation then.
    factor : float
        Errors of coefficients over those with nothing in common but that field.
    """

    correlation: float
    expected: float
    sd: float
    factor: float

    @property
    def z(self) -> float:
        """By how many standard deviations they are displaced alike."""
        return (self.correlation - self.expected) / self.sd

    @property
    def alike(self) -> bool:
        """Whether they are."""
        return self.z > NOTICEABLE

    @property
    def check(self) -> Check:
        """The correlation among the checks."""
        return Check(
            NAME, self.correlation, self.expected, self.sd, self.z,
            "correlation of the displacements of neighbouring sources",
        )  # fmt: skip


def neighbours(
    sources: Table, scatter: float, shared: Callable[[Ints], Floats] | None = None
) -> Neighbours | None:
    """Compare the displacements of isolated sources with those of their neighbours.

    Parameters
    ----------
    sources : astropy.table.Table
        As `source_table` has them.
    scatter : float, pixel
        The scale of their own scatter; 0 without.
    shared : callable, optional
        For pairs of sources, (p, 2), the covariance of their displacements along u and along v that
        is in the errors already, (2, p), pixel^2.

    Returns
    -------
    Neighbours or None
        None where they are too few.
    """
    columns = ("u", "v", "du", "dv", "du_sd", "dv_sd")
    table = np.stack([np.asarray(sources[name], np.float64) for name in columns])
    told = np.isfinite(table).all(axis=0) & np.asarray(sources["isolated"], bool)
    table, numbers = table[:, told], np.flatnonzero(told)
    places = table[:2].T
    if len(places) < FEWEST:
        return None
    try:
        pairs = _neighbours(places)
    except spatial.QhullError:  # on a line
        return None
    errors = np.hypot(table[4:], scatter)
    z = np.clip(table[2:4] / errors, -OUTLYING, OUTLYING)
    z -= z.mean(axis=1, keepdims=True)
    spread = np.maximum(z.std(axis=1, keepdims=True), 1e-300)
    z /= spread
    units = errors * spread

    def products(pairs: Ints) -> tuple[float, float]:
        """Sums over pairs of the displacements' products, and of what they are expected to be."""
        one, two = pairs.T
        expected = 0.0
        if shared is not None:
            expected = float(np.sum(shared(numbers[pairs]) / (units[:, one] * units[:, two])))
        return float(np.sum(z[:, one] * z[:, two])), expected

    mean, expected = (total / (2.0 * len(pairs)) for total in products(pairs))
    sd = np.hypot((2.0 * len(pairs)) ** -0.5, FIELD * expected)
    found = Neighbours(mean, expected, float(sd), 1.0)
    return found._replace(factor=_factor(products, places, pairs)) if found.alike else found


def distance_of_neighbours(places: Floats) -> float:
    """The median distance between neighbours among some places, (n, 2)."""
    return float(np.median(_lengths(places, _neighbours(places))))


def neighbours_check(found: Neighbours | None) -> Check:
    """The row of the checks."""
    return not_tested(NAME, "too few isolated sources") if found is None else found.check


def _neighbours(places: Floats) -> Ints:
    """Pairs of neighbours, shape (n, 2): sides of Delaunay's triangles that are not long."""
    corners = spatial.Delaunay(places).simplices
    sides = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    sides = np.unique(np.sort(sides, axis=1), axis=0)
    length = _lengths(places, sides)
    return np.asarray(sides[length <= LONGEST * np.median(length)])


def _lengths(places: Floats, pairs: Ints) -> Floats:
    return np.asarray(np.hypot(*(places[pairs[:, 0]] - places[pairs[:, 1]]).T))


def _factor(products: Callable[[Ints], tuple[float, float]], places: Floats, pairs: Ints) -> float:
    """Root of 1 + sum of the correlations, up to where they end, over what it is expected to be."""
    step = float(np.median(_lengths(places, pairs)))
    tree, total, told, before = spatial.cKDTree(places), 1.0, 1.0, 0.0
    for lag in range(1, FOLLOWED + 1):
        found, expected = products(tree.query_pairs((lag + 0.5) * step, output_type="ndarray"))
        if found <= before:
            break
        total, told, before = 1.0 + found / len(places), 1.0 + expected / len(places), found
    return float((total / max(told, 1.0)) ** 0.5)
