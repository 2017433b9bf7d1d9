r"""What dithered frames without a catalogue cannot see.

Where sources are imaged is all that the frames tell. With the map P from object to image, u = P(x),
another instrument P' with other positions and pointings shows the same frames if h = P'^-1 P does

    h(R_i X + t_i) = R'_i X' + t'_i    for every source X and frame i.

Shifts alone (R_i = R'_i = 1). Then h(x + t_i) - h(x + t_j) is the same for all x. Every linear map
h(x) = A x does that, with X' = A X and t'_i = A t_i: scale, rotation and two shears. Among
polynomials nothing else does as long as the dithers are not all on one line: if h(x + t) - h(x) is
constant, so is the derivative of h along t, and two directions t make h linear. Of dithers along
one line the functions of the coordinate across it remain too. (A lattice of dithers does not see
what has its period, either; polynomials have none.)

Turned frames. A R_i A^-1 has to be a rotation for every i. Scale and rotation do that, shears do
not, unless all turns are multiples of 180 degrees. Turns that are free but small see shears as
poorly as they are small. With free turns and dithers on one line, R'_i - 1 need not vanish: one
quadratic function more remains.

Known pointings. A (t_i - t_j) = t_i - t_j in two directions makes A = 1, up to their errors over
their distance.

The image of the object (0, 0) is (0, 0), as f and g have no constant: so h(0) = 0. A family of
distortions that cannot follow P h^-1 tells h by itself. A cubic term without linear ones, say, sets
the scale on the axis to 1.

Numbers. None of this is assumed. The information of the frames and of the priors that were given,
without the default priors, is reduced to coefficients, pointings and turns by Schur complements. In
units of the default priors' standard deviations its eigenvalues compare the frames with these
priors. Linear maps that nothing shows have eigenvalues of 1e-8, from rounding, others 1e5. As many
coefficients are fixed as there are eigenvalues below `NONE`, for which a step of the prior's width
changes the log-likelihood by less than 1/2. That is a convention and no loss, as other values
describe the same images with other positions. To first order h = 1 + E changes f by (1 - D f) E x,
so where there is distortion a linear map changes the terms of higher degree a little: their values
and errors are those for the fixed ones.

Directions between `NONE` and `LEAST` are seen a little, by what is of second order: a quadratic h
of dithers on a line, or shears by frames that are hardly turned. To fix them would be an
assumption. They are left to their priors, which move the result by more than 1 %, and are said not
to be measured.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.sparse.linalg import splu

from bayesfred._typing import Floats, Ints
from bayesfred.errors import InputError
from bayesfred.model.dithered import DitheredPosterior

__all__ = ["Degeneracy", "lost_directions"]

LEAST = 100.0  # information of a direction that is measured, in units of its default prior's
NONE = 1.0  # ... and of one that nothing shows
LEAST_EFFECT = 0.01  # share of what the priors allow that a direction must move
SHARE = 0.1  # of a prior's scale, in half-widths or radians: that of pointings and turns
GRID = 9  # points along each axis of the frame
ALIKE = 0.1  # share of a field's mean square that others may leave of it
PIVOT = 1e-3  # of a lost direction that a coefficient must make up to stand for it
WEAK = 0.1  # square of a coefficient's share of lost directions for which it is named

# Displacement fields of the linear maps.
LINEAR = {
    "scale": ((1.0, 0.0), (0.0, 1.0)),
    "rotation": ((0.0, -1.0), (1.0, 0.0)),
    "stretch along x against y": ((1.0, 0.0), (0.0, -1.0)),
    "shear": ((0.0, 1.0), (1.0, 0.0)),
}


@dataclass(frozen=True, eq=False)
class Degeneracy:
    """Directions that the frames do not measure.

    Attributes
    ----------
    what : str
        In words.
    parameters : tuple of str
        Coefficients that are fixed for it, by convention; or that are left to their priors.
    fixed : bool
        Which of the two.
    directions : ndarray, shape (k, n_terms)
        A basis of the changes of the coefficients that leave all images where they are, together
        with changes of positions and pointings.
    remedy : str
        What would make them visible.
    """

    what: str
    parameters: tuple[str, ...]
    fixed: bool
    directions: Floats
    remedy: str


def lost_directions(
    posterior: DitheredPosterior, params: Floats, given: Collection[str] = ()
) -> tuple[Degeneracy | None, Degeneracy | None]:
    """The directions of the coefficients that the frames do not measure.

    Parameters
    ----------
    posterior : DitheredPosterior
    params : ndarray, shape (d,)
        Near the maximum.
    given : collection of str
        Parameters whose priors are measurements, not default ones.

    Returns
    -------
    unseen : Degeneracy or None
        Nothing shows them; `parameters` stand for them.
    poor : Degeneracy or None
        Their priors decide about them.

    Raises
    ------
    InputError
        If a pointing is lost: a frame shows too little of what others show.
    """
    columns = _geometry(posterior)
    scale = _scales(posterior, columns)
    known = _reduced(posterior, params, columns, given) * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(known)
    free = posterior.layout.parts[0].theta
    p, field = free.size, posterior.reference.model.polynomial
    half = 0.5 * np.array(posterior.reference.model.detector.fine_shape[::-1], dtype=np.float64)
    x, y = (c.ravel() for c in np.meshgrid(*np.linspace(-half, half, GRID).T))
    moves = field.design_matrix(x, y, x, y).reshape(2 * x.size, -1)[:, free] * scale[:p]
    effect = ((moves @ vectors[:p]) ** 2).sum(axis=0) / (moves**2).sum()
    effect += (vectors[p:] ** 2).sum(axis=0)
    found: list[Degeneracy | None] = []
    for low, high in ((-np.inf, NONE), (NONE, LEAST)):
        lost = vectors[:, (low < values) & (values < high) & (effect > LEAST_EFFECT)]
        if not lost.shape[1]:
            found.append(None)
            continue
        if high == NONE:
            names = tuple(field.names[k] for k in free[_pivots(posterior, columns, lost, p)])
        else:
            weak = (lost[:p] ** 2).sum(axis=1) > WEAK
            names = tuple(field.names[k] for k in free[weak])
        directions = np.zeros((lost.shape[1], field.n_terms))
        directions[:, free] = (lost[:p] * scale[:p, None]).T
        what = _in_words(moves @ lost[:p], (x, y))
        remedy = _remedy(posterior, what)
        found.append(Degeneracy(what, names, high == NONE, directions, remedy))
    return found[0], found[1]


def _pivots(posterior: DitheredPosterior, columns: Ints, lost: Floats, p: int) -> Ints:
    """The coefficients that stand for lost directions best."""
    _, triangle, order = linalg.qr(lost[:p].T, pivoting=True)
    depth = np.abs(np.diag(triangle))
    if depth.size < lost.shape[1] or depth.min() < PIVOT:
        weak = (lost[p:] ** 2).sum(axis=1) > PIVOT
        names = ", ".join(posterior.parameter_names[k] for k in columns[p:][weak])
        raise InputError(
            f"frames: got frames that do not determine {names}, expected dithers that show sources "
            "of each other: leave out terms or frames, or give the pointings with their error"
        )
    return np.sort(order[: lost.shape[1]])


def _geometry(posterior: DitheredPosterior) -> Ints:
    """Columns of the coefficients, pointings and turns."""
    parts = posterior.layout.parts
    pointing = [k for part in parts for k in part.pointing if k >= 0]
    return np.array([*range(parts[0].theta.size), *pointing], dtype=np.int64)


def _scales(posterior: DitheredPosterior, columns: Ints) -> Floats:
    """Standard deviations of the default priors, and what corresponds to them."""
    frame, free = posterior.reference, posterior.layout.parts[0].theta
    ny, nx = frame.model.detector.fine_shape
    of = {"pointing_x": SHARE * 0.5 * nx, "pointing_y": SHARE * 0.5 * ny, "turn": np.degrees(SHARE)}
    theta = [frame.parameters[k].prior.std() for k in free]
    names = [posterior.parameter_names[k] for k in columns[len(theta) :]]
    return np.array([*theta, *(of[name.rsplit(".", 1)[1]] for name in names)])


def _reduced(
    posterior: DitheredPosterior, params: Floats, columns: Ints, given: Collection[str]
) -> Floats:
    """Information about some parameters, all others eliminated."""
    all_known = posterior.fisher(params) + posterior.prior_information(params, list(given))
    all_known, d = all_known.tocsc(), posterior.layout.n_dense
    cross = all_known[d:, :d].toarray()
    dense = all_known[:d, :d].toarray() - cross.T @ splu(all_known[d:, d:]).solve(cross)
    rest = np.setdiff1d(np.arange(d), columns)
    some = dense[np.ix_(columns, columns)]
    if rest.size:
        beside = dense[np.ix_(rest, columns)]
        some = some - beside.T @ np.linalg.solve(dense[np.ix_(rest, rest)], beside)
    return np.asarray(0.5 * (some + some.T))


def _in_words(fields: Floats, at: tuple[Floats, Floats]) -> str:
    """What displacement fields, shape (2 points, k), have among them."""
    basis = linalg.orth(fields)
    found = []
    for name, matrix in LINEAR.items():
        field = (np.array(matrix) @ np.stack(at)).ravel()
        left = field - basis @ (basis.T @ field)
        if left @ left < ALIKE * (field @ field):
            found.append(name)
    if len(found) == len(LINEAR):
        words = "scale, rotation and shear of the field"
    else:
        words = " and ".join(found) + " of the field" if found else ""
    more = fields.shape[1] - len(found)
    if more:
        plural = "s" if more > 1 else ""
        other = f"{more} combination{plural} of coefficients"
        words = f"{words}, and {other}" if words else other
    return words


def _remedy(posterior: DitheredPosterior, what: str) -> str:
    """What would show the lost directions."""
    catalogue = "one frame with a catalogue"
    turned = posterior.turned or any(pose[2] != 0.0 for pose in posterior.pointings.values())
    if "combination" in what:
        more = "larger turns" if turned else "turned frames"
        return f"dithers in two directions, {more} or {catalogue}"
    known = f"pointings that are known (pointing_sd) or {catalogue}"
    return known if turned else f"{known}, or turned frames for the shear"
