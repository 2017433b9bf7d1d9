"""The tuples that the loops over counts pass to each other."""

from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from numba.extending import register_jitable

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.kernels.contexts import Footprints, Geometry, Optics, SourceNuisances

Bytes = npt.NDArray[np.uint8]

MASKED = -1e300  # stands for the counts of a pixel outside the likelihood
LIMIT = -1e299
STRETCH = 512  # pixels that are summed at a time where it takes several passes
MOST_ORDER = 4  # of the background polynomial
# Of u and v, the terms of the background one after another.
BACKGROUND_POWERS = tuple(
    (order - n, n) for order in range(MOST_ORDER + 1) for n in range(order + 1)
)


class Frame(NamedTuple):
    """The counts as the loops need them.

    Rows are padded to `stride`, pixels outside the likelihood are MASKED.
    """

    values: Floats  # (ny * stride,)
    segment_pixels: Floats  # (ny * stride / SEGMENT,) how many pixels count
    segment_sum: Floats  # of their counts
    pixels: float
    total: float
    ny: int
    nx: int
    noise: Any  # a noise model's compiled half, see `noise_dispatch`
    varies: bool  # whether the background is a polynomial of order > 0
    everywhere: bool  # whether every pixel that counts is visited


class Problem(NamedTuple):
    """What all parameter vectors share."""

    optics: Optics
    frame: Frame
    flux: Floats  # (s,) of the catalogue, counts
    shape: float  # of the fluxes' Gamma prior
    faint: Flags  # (s,) sources for which the term of `expansion.py` counts
    # None where fluxes are fixed: a type of its own, for which what profiles them is not compiled
    free: Literal[True] | None
    scatters: Literal[True] | None  # whether positions are free, too; None where not, likewise


class Nearby(NamedTuple):
    """Numbers of `gradient.py` at other parameters, with which a search ends early."""

    e: Floats  # (s, templates) but for the prior's k'
    spread: Floats  # (s,) Q_11 + Q_22
    bends: Floats  # (s, 6) blocks of G - H, but for the prior's


class Known(NamedTuple):
    """What is known of fluxes and shifts before their maximum is looked for; no rows: nothing."""

    start: Floats  # (s, 3) where the search begins
    nearby: Nearby


class Workspace(NamedTuple):
    """A thread's buffers."""

    image: Floats  # (ny * stride,), zero between calls
    flags: Bytes  # (ny * stride / SEGMENT,) segments that a source reaches
    span: Ints  # (ny, 2) first and last marked segment of a row
    score: Floats  # (ny * stride,) scratch
    weight: Floats
    ratio: Floats
    # what profiling fills again on every call, kept because new memory costs more than its use
    heap: Floats
    scratch: Floats  # (4, STRETCH)
    # images of the gradient, of which the marked segments are made zero before they are used
    images: tuple[Floats, Floats, Floats, Floats]


class Vectors(NamedTuple):
    """Parameter vectors as the loops need them, one row each."""

    theta: Floats  # (n, k)
    nuisances: Floats  # (n, 6) in the order of SourceNuisances
    background: Floats  # (n, 15) coefficients in the order of `BACKGROUND_POWERS`


class Parameters(NamedTuple):
    """One parameter vector."""

    theta: Floats
    nuisances: SourceNuisances
    background: Floats


class Clusters(NamedTuple):
    """Groups of sources whose footprints share pixels.

    Group c holds members[first[c]:first[c + 1]], from top to bottom. A group's symmetric matrices,
    a row for each template of each member, are stored row after row from the first member that
    shares pixels with the row's own up to the diagonal. The rest stays zero in Cholesky's factor.
    """

    members: Ints
    first: Ints
    lead: Ints  # column at which a row's storage begins, counted within the group
    start: Ints  # where a row's column 0 would be in the group's storage
    begin: Ints  # where the group's storage begins in a flat array


class Group(NamedTuple):
    """One of the clusters, with a row of its matrices for each template of each member."""

    members: Ints
    lead: Ints
    start: Ints


class Touching(NamedTuple):
    """Sources with their templates, and which of them share pixels."""

    footprints: Footprints
    boxes: Ints  # (s, 4) first row, last row + 1, first column, last column + 1
    clusters: Clusters
    stamps: Floats  # (templates, samples)
    faint: Flags  # (s,) that of `Problem`
    scatters: Literal[True] | None  # that, too


class Profiled(NamedTuple):
    """Sources whose fluxes, and shifts, are at their maximum."""

    touching: Touching
    factors: Floats  # Cholesky factors of H
    fluxes: Floats  # (s,) counts
    shifts: Floats  # (s, 2) pixel
    shape: float  # of the fluxes' Gamma prior


class Rendered(NamedTuple):
    """The sources as rendered in a workspace's image, and what derivatives need of them."""

    # what profiling adds to the log-likelihood; -inf where a map folds, or the fluxes have no
    # maximum
    extra: float
    geometry: Geometry
    footprints: Footprints
    fluxes: Floats
    profiled: Profiled | None  # None where fluxes are fixed


Evaluation = tuple[Workspace, Rendered, Parameters]  # of one parameter vector


class Unreached(NamedTuple):
    """The pixels in the likelihood that no source reaches: those of segments whose flag is 0."""

    pixels: float
    counts: float
    flags: Bytes


class Turns(NamedTuple):
    """Rows that threads share, and the next one's number."""

    turn: Ints
    values: Floats
    found: Floats  # (rows, s, 3) fluxes and shifts; of no source where they are not wanted
    start: Floats  # (rows, s, 3) with `nearby`: see `Known`
    nearby: Nearby


@register_jitable
def parameters_of(vectors, i):
    """Row i of the parameter vectors."""
    n = vectors.nuisances[i]
    nuisances = SourceNuisances(n[0], n[1], n[2], n[3], n[4], n[5])
    return Parameters(vectors.theta[i], nuisances, vectors.background[i])
