"""Design before the exposure: what a planned frame would tell of the displacement.

No counts are needed. The Fisher information of the expected counts, with the prior's, gives the
covariance of the parameters, and through it the error of the displacement over the frame.
`planned` divides the information among sources and pointings, `optimal` chooses those that tell
most, and `photons` says how bright sources have to be.

A choice of sources is judged by the information of their own pixels in the planned frame, where the
light of the others is noise. A target that holds the chosen sources alone is known a little better.
Its error is computed exactly, too.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import get_args

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Floats, Ints
from bayesfred.analysis.field import (
    FieldPoints,
    displacement_derivatives,
    field_points,
    pixel_unit,
)
from bayesfred.analysis.optimal import Criterion, Information, greedy, search
from bayesfred.analysis.photons import PhotonsNeeded, photons_needed
from bayesfred.analysis.planned import (
    by_pointing,
    by_source,
    of_field,
    planned,
    selected,
    shared_field,
    shifted,
    without_noise,
)
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import inverse

__all__ = ["Choice", "Design", "design"]

RANDOM = 25  # orders of sources to compare with
MOST_FRAMES = 1000


@dataclass(frozen=True, eq=False)
class Choice:
    """Which candidates tell most, and the error over the field that they reach.

    Attributes
    ----------
    order : ndarray of int, shape (n,)
        Candidates in the order of the greedy choice; a pointing may come again.
    rms, largest : ndarray, shape (n,), pixel
        Root mean square and largest error over the field with the first 1, 2, ... of them.
    chosen : ndarray of int, shape (k,)
        The best k candidates that were found, ascending.
    chosen_rms, chosen_largest : float, pixel
        Errors with these.
    needed : float
        How many of `order` reach the wanted rms error; infinite if none do.
    """

    order: Ints
    rms: Floats
    largest: Floats
    chosen: Ints
    chosen_rms: float
    chosen_largest: float
    needed: float


@dataclass(frozen=True, eq=False)
class Design:
    """What a planned frame would tell of the displacement.

    Attributes
    ----------
    points : FieldPoints
        Of the frame. Points that are not `points.inside` are extrapolated.
    images : ndarray, shape (s, 2), pixel of the fine grid
        Where the catalogue's sources are imaged.
    sd : ndarray, shape (rows, columns), pixel
        The error at each point: root of the mean of its two variances. NaN where no object is
        imaged.
    error_rms, error_largest : float, pixel
        Root mean square and largest value of `sd` among the sources.
    error : float, pixel
        The rms error that is wanted.
    criterion : {"D", "G"}
    sources : Choice
        Of the sources, by their rows in the catalogue.
    random_rms, random_largest : ndarray, shape (n,), pixel
        Errors with 1, 2, ... sources at random, the median of 25 orders.
    exact_rms, exact_largest : float, pixel
        Errors of a frame that holds the chosen sources alone, without approximation.
    photons : PhotonsNeeded
        How bright all sources have to be for the wanted error.
    dithers : ndarray, shape (c, 2), pixel
        The candidate pointings.
    frames : Choice or None
        Of the pointings: errors of the field that frames share, over the part of the frame that any
        pointing covers, less a pose; see `planned`. None without pointings.
    unit : str
        What a pixel is called.
    """

    points: FieldPoints
    images: Floats
    sd: Floats
    error_rms: float
    error_largest: float
    error: float
    criterion: Criterion
    sources: Choice
    random_rms: Floats
    random_largest: Floats
    exact_rms: float
    exact_largest: float
    photons: PhotonsNeeded
    dithers: Floats
    frames: Choice | None
    unit: str

    @property
    def lines(self) -> tuple[str, ...]:
        """A sentence each of the frame, the sources, the photons and the pointings."""
        wanted = f"{self.error:g} {self.unit} rms"
        all_sources = len(self.sources.order)
        if math.isinf(self.sources.needed):
            enough = f"all {all_sources} sources do not reach {wanted}"
        else:
            by_chance = _first(self.random_rms, self.error)
            enough = (
                f"{self.sources.needed:.0f} of {all_sources} sources reach {wanted}, at random "
                f"{'more than all' if math.isinf(by_chance) else f'{by_chance:.0f}'}"
            )
        lines = [
            f"Displacement of the planned frame: known to {self.error_rms:.2g} {self.unit} rms, "
            f"{self.error_largest:.2g} {self.unit} at worst, among the sources.",
            f"Sources: {enough}; a target of the best {len(self.sources.chosen)} alone: "
            f"{self.exact_rms:.2g} {self.unit} rms, {self.exact_largest:.2g} at worst.",
            self.photons.message,
        ]
        if self.frames is not None:
            lines.append(self._frames_line(self.frames, wanted))
        return tuple(lines)

    def _frames_line(self, frames: Choice, wanted: str) -> str:
        enough = "1 frame reaches" if frames.needed == 1 else f"{frames.needed:.0f} frames reach"
        if math.isinf(frames.needed):
            enough = f"{MOST_FRAMES:,} frames do not reach"
        taken, times = np.unique(frames.chosen, return_counts=True)
        at = ", ".join(
            f"{n} at ({x:g}, {y:g})" for n, (x, y) in zip(times, self.dithers[taken], strict=True)
        )
        return (
            f"Pointings: {enough} {wanted} in the field that they share; the best "
            f"{len(frames.chosen)}, {at}: {frames.chosen_rms:.2g} {self.unit} rms, "
            f"{frames.chosen_largest:.2g} at worst."
        )


def design(
    posterior: Posterior,
    params: Floats,
    *,
    error: float = 0.01,
    criterion: Criterion = "D",
    sources: int | None = None,
    dithers: Sequence[tuple[float, float]] = (),
    frames: int | None = None,
) -> Design:
    """What a planned frame would tell: its error over the field, the best sources and pointings.

    Parameters
    ----------
    posterior : Posterior
        Of a frame of the planned kind. Its counts are not used. Fluxes are those of its catalogue.
    params : array_like, shape (d,)
        The true parameters.
    error : float, pixel of the fine grid
        The rms error over the field, along one axis, that is wanted.
    criterion : {"D", "G"}
        What a choice is judged by: "D", the volume of the coefficients' error ellipsoid, or "G",
        the largest error of the displacement over the field.
    sources : int, optional
        How many sources to choose; by default the fewest in the greedy order that reach `error`,
        or all.
    dithers : sequence of (float, float), pixel of the fine grid
        Pointings to choose from, by how far each displaces the catalogue along x and y. A pointing
        may be chosen several times. Without (0, 0) the planned one is not among them.
    frames : int, optional
        How many frames to choose; by default the fewest that reach `error`, or one a pointing.

    Returns
    -------
    Design

    Raises
    ------
    InputError
        If an argument is out of range; if `params` have no probability density, the frame shows no
        source, or prior and frame leave a parameter undetermined; if a pointing shows no source, or
        folds one; if pointings share no term.

    Notes
    -----
    It assumes that the model is true, that errors are small enough for the linear approximation,
    and that the PSF is known. The choices need not be the best ones: no replacement of one member
    improves them. See `optimal`.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [0.02, 0.02], 2.0, seed=1))
    >>> plan = design(posterior, [0.02, 0.02, 2.0], sources=4)
    >>> plan.sources.chosen.tolist(), round(plan.exact_rms, 3)
    ([0, 2, 6, 8], 0.01)
    """
    params = np.asarray(params, dtype=np.float64)
    if criterion not in get_args(Criterion):
        raise InputError(f"criterion: got {criterion!r}, expected D or G")
    if not (math.isfinite(error) and error > 0.0):
        raise InputError(f"error: got {error!r}, expected a finite number of pixels > 0")
    candidates = _pointings(dithers)
    with one_blas_thread():
        prior = posterior.prior_information(params)
        plan = planned(posterior, params)
        told = plan.fisher(params) + prior
        _require_known(plan, told)
        points = field_points(plan, params)
        slopes = displacement_derivatives(plan, params, points.u, points.v)
        sd = np.sqrt(0.5 * np.einsum("rcik,kl,rcil->rc", slopes, inverse(told), slopes))
        field = of_field(plan, params, points)
        rms, largest = field.errors(inverse(told))
        seen, parts = by_source(plan, params)
        if not seen.size:
            raise InputError(
                "catalogue: got no source whose image is on a pixel in use, expected some: check "
                "positions and mask"
            )
        terms = np.array([q.kind == "distortion" for q in plan.parameters])
        known = Information.scaled(prior, parts, np.flatnonzero(terms), field, criterion)
        choice = _choice(known, error, _number("sources", sources, len(seen)), seen)
        alone = without_noise(
            posterior, params, selected(plan.model.sources, choice.chosen)
        ).fisher(params)
        exact = field.errors(inverse(alone + prior))
        frames_chosen = None
        if len(candidates):
            wanted = _number("frames", frames, MOST_FRAMES)
            frames_chosen = _frames(plan, params, candidates, (error, criterion, wanted))
        return Design(
            points, plan.likelihood.image_positions(params), sd, rms, largest, error, criterion,
            choice, *_at_random(known), *exact, photons_needed(plan, params, error), candidates,
            frames_chosen, pixel_unit(plan.model),
        )  # fmt: skip


def _pointings(dithers: npt.ArrayLike) -> Floats:
    """The candidate pointings, shape (c, 2)."""
    try:
        out = np.asarray(dithers, dtype=np.float64)
    except (TypeError, ValueError):
        out = np.full(1, np.nan)
    if not out.size:
        return np.empty((0, 2))
    if out.ndim != 2 or out.shape[1] != 2 or not np.isfinite(out).all():
        raise InputError(
            f"dithers: got {dithers!r}, expected pairs of finite numbers, pixels along x and y"
        )
    return out


def _number(name: str, number: int | None, most: int) -> int | None:
    whole = isinstance(number, int | np.integer) and not isinstance(number, bool)
    if number is not None and not (whole and 1 <= number <= most):
        raise InputError(f"{name}: got {number!r}, expected an integer from 1 to {most}")
    return number


def _require_known(posterior: Posterior, information: Floats) -> None:
    """Raise InputError if there is no information, or none about some parameter."""
    if not np.isfinite(information).all():
        raise InputError(
            "params: got pixels whose expected counts are 0, expected more in all of them: give "
            "the frame a background"
        )
    unknown = np.flatnonzero(np.diag(information) <= 0.0)
    if unknown.size:
        names = ", ".join(posterior.parameter_names[k] for k in unknown)
        raise InputError(
            f"params: got a frame that says nothing of {names}, expected one that does, or a prior "
            "with a curvature: hold it, or give it a normal prior"
        )


def _choice(known: Information, error: float, number: int | None, rows: Ints) -> Choice:
    """The greedy order of all sources, and the best of them."""
    order, errors = [], []
    for chosen, total in greedy(known):
        order.append(chosen)
        errors.append(known.errors(total))
    rms, largest = np.array(errors).T
    needed = _first(rms, error)
    number = number or int(min(needed, len(order)))
    return _searched(known, (np.array(order), rms, largest, needed), number, rows)


def _searched(
    known: Information,
    found: tuple[Ints, Floats, Floats, float],
    number: int,
    rows: Ints,
    *,
    repeats: bool = False,
) -> Choice:
    """The record of a greedy order, with the best choice of so many."""
    order, rms, largest, needed = found
    numbers = search(known, number, repeats=repeats)
    chosen = rows[np.repeat(np.arange(len(numbers)), numbers)]
    return Choice(rows[order], rms, largest, chosen, *known.errors(known.of(numbers)), needed)


def _first(rms: Floats, error: float) -> float:
    """The number from which on the errors are as small as wanted."""
    reached = np.flatnonzero(rms <= error)
    return float(reached[0] + 1) if reached.size else math.inf


def _at_random(known: Information) -> tuple[Floats, Floats]:
    """Median errors with 1, 2, ... candidates at random, rms and largest."""
    rng, n = np.random.default_rng(0), len(known.parts)
    errors = np.empty((RANDOM, n, 2))
    for each in errors:
        total = known.base
        for k, candidate in enumerate(rng.permutation(n)):
            total = total + known.parts[candidate]
            each[k] = known.errors(total)
    rms, largest = np.median(errors, axis=0).T
    return rms, largest


def _frames(
    plan: Posterior,
    params: Floats,
    pointings: Floats,
    wanted: tuple[float, Criterion, int | None],
) -> Choice:
    """Which pointings tell most of the field that their frames share."""
    error, criterion, number = wanted
    shared, prior, parts = by_pointing(plan, params, pointings)
    model = replace(plan.model, sources=shifted(plan.model.sources, pointings))
    covered = Posterior(
        model, plan.counts, prior=plan.prior, noise=plan.noise, mask=plan.valid,
        nuisances=plan.nuisances,
    )  # fmt: skip
    field = of_field(plan, params, field_points(covered, params))
    known = Information.scaled(
        prior, parts, np.arange(shared.size), shared_field(plan, field, shared), criterion
    )
    order, errors = [], []
    for chosen, total in islice(greedy(known, repeats=True), MOST_FRAMES):
        order.append(chosen)
        errors.append(known.errors(total))
        if errors[-1][0] <= error and len(order) >= (number or 1):
            break
    rms, largest = np.array(errors).T
    needed = _first(rms, error)
    number = number or int(min(needed, len(pointings)))
    shown = number if math.isinf(needed) else max(number, int(needed))
    found = np.array(order[:shown]), rms[:shown], largest[:shown], needed
    return _searched(known, found, number, np.arange(len(pointings)), repeats=True)
