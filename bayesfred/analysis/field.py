"""By how much a frame displaces its objects, and how well that is known, over the whole field.

The displacement is (u - x, v - y) of the object that is imaged at (u, v). Its error at a point is
the root of the mean of its two variances, along u and along v. Over the field both are averaged
over a grid on the frame, in squares, with the weights of the trapezoidal rule. Points outside the
convex hull of the sources' images are extrapolated: only the terms of the distortion say what
happens there. They do not enter the averages.

The posterior's draws give the covariance at every point. To first order it is J C J^T, with the
covariance C of the parameters and the derivatives J of `imaging.inverse`; this is what there is
where nothing was drawn.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import spatial

from bayesfred._typing import Flags, Floats
from bayesfred.imaging.forward import ForwardModel
from bayesfred.model.parameters import displacing
from bayesfred.model.posterior import Posterior
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.displacement import displacement, frame_posterior

__all__ = [
    "DisplacementField",
    "FieldPoints",
    "displacement_covariance",
    "displacement_derivatives",
    "displacement_field",
    "field_error",
    "field_points",
    "hull_of",
    "images_of",
    "inside_hull",
    "pixel_unit",
    "rms",
]

POINTS = 21  # of the grid along the frame's longer side, from edge to edge
FEWEST = 4  # of them among the sources, or all of them count


class FieldPoints(NamedTuple):
    """The points of a frame at which displacements are computed.

    Attributes
    ----------
    u, v : ndarray, shape (rows, columns), pixel of the fine grid
        From one edge of the frame to the other.
    hull : ndarray, shape (n, 2), pixel of the fine grid
        Vertices of the convex hull of the sources' images, counterclockwise; none if there are
        fewer than three images, or all are on a line.
    inside : ndarray of bool, shape (rows, columns)
        Whether a point lies within it.
    weights : ndarray, shape (rows, columns)
        Of the average over the field: 0 outside the hull, unless all points are.
    """

    u: Floats
    v: Floats
    hull: Floats
    inside: Flags
    weights: Floats


@dataclass(frozen=True, eq=False)
class DisplacementField:
    """The displacement over a frame with its error.

    Attributes
    ----------
    points : FieldPoints
    displacement : ndarray, shape (rows, columns, 2), pixel of the fine grid
        Posterior mean of (u - x, v - y); NaN where no object is imaged.
    covariance : ndarray, shape (rows, columns, 2, 2), pixel^2
    sd : ndarray, shape (rows, columns), pixel
        The error at a point: root of the mean of its two variances.
    rms, largest : float, pixel
        Root mean square and largest value of the displacement's length among the sources.
    largest_at : tuple of float, (u, v), pixel
    error_rms, error_largest : float, pixel
        Root mean square and largest value of `sd` among the sources.
    corner, corner_error : float, pixel
        The largest displacement and the largest `sd` in the frame's four corners.
    message : str
        One line: these numbers.
    """

    points: FieldPoints
    displacement: Floats
    covariance: Floats
    sd: Floats
    rms: float
    largest: float
    largest_at: tuple[float, float]
    error_rms: float
    error_largest: float
    corner: float
    corner_error: float
    message: str


def displacement_field(chain: Chain) -> DisplacementField:
    """The displacement over the frame of a chain, with its error.

    Parameters
    ----------
    chain : Chain
        Of a frame.

    Returns
    -------
    DisplacementField
        The errors hold for the stated model and noise: they omit errors of the catalogue, the PSF
        and the model itself.

    Raises
    ------
    InputError
        If the chain is of a density that is no frame's.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]))
    >>> posterior = bf.Posterior(model, bf.simulate(model, [0.02, 0.02], 2.0, seed=1))
    >>> chain = bf.sample(posterior, seed=1, target_ess=200, progress=False)
    >>> print(displacement_field(chain).message)
    Displacement: rms 0.351 px, up to 0.563 px at (u, v) = (-20, -20); known to ...
    """
    posterior = frame_posterior(chain)
    points = field_points(posterior, chain.estimate.params)
    at = displacement(chain, points.u, points.v)
    return _field(points, *at, pixel_unit(posterior.model))


def field_points(posterior: Posterior, params: Floats) -> FieldPoints:
    """The points of a frame at which displacements are computed.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
        They say where the sources are imaged. Sources whose image is not on a pixel of the
        likelihood are not counted.

    Returns
    -------
    FieldPoints
    """
    half_v, half_u = (0.5 * n for n in posterior.model.detector.fine_shape)
    longer = max(half_u, half_v)
    columns, rows = (max(2, math.ceil((POINTS - 1) * h / longer) + 1) for h in (half_u, half_v))
    u, v = np.meshgrid(np.linspace(-half_u, half_u, columns), np.linspace(-half_v, half_v, rows))
    hull = hull_of(images_of(posterior, params))
    inside = inside_hull(hull, u, v)
    edge_u, edge_v = (np.isin(np.arange(n), (0, n - 1)) for n in (columns, rows))
    weights = np.where(edge_u, 0.5, 1.0) * np.where(edge_v, 0.5, 1.0)[:, None]
    return FieldPoints(u, v, hull, inside, weights * inside if inside.sum() >= FEWEST else weights)


def displacement_covariance(
    posterior: Posterior, params: Floats, covariance: Floats, u: Floats, v: Floats
) -> Floats:
    """The displacement's covariance at points to first order: J C J^T.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    covariance : ndarray, shape (d, d)
        Of the parameters.
    u, v : ndarray, shape (...), pixel of the fine grid

    Returns
    -------
    ndarray, shape (..., 2, 2), pixel^2
        NaN where no object is imaged.
    """
    derivatives = displacement_derivatives(posterior, params, u, v)
    return np.asarray(derivatives @ covariance @ derivatives.swapaxes(-1, -2))


def displacement_derivatives(posterior: Posterior, params: Floats, u: Floats, v: Floats) -> Floats:
    """Derivatives of the displacement at points with respect to the parameters.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    u, v : ndarray, shape (...), pixel of the fine grid

    Returns
    -------
    ndarray, shape (..., 2, d), pixel per unit of each parameter
        NaN where no object is imaged.
    """
    theta, offset = displacing(posterior.parameters, params)
    jacobian = posterior.model.polynomial.displacement_jacobian(
        theta, u.ravel(), v.ravel(), offset=offset
    )
    # which of the parameters the Jacobian's columns are
    columns = np.column_stack(displacing(posterior.parameters, np.eye(params.size)))
    return np.asarray((jacobian @ columns.T).reshape(*u.shape, 2, params.size))


def field_error(points: FieldPoints, covariance: Floats) -> float:
    """The rms error over the field: root of the mean variance along one axis.

    Parameters
    ----------
    points : FieldPoints
    covariance : ndarray, shape (rows, columns, 2, 2), pixel^2

    Returns
    -------
    float, pixel
    """
    return rms(points.weights, _sd(covariance))


def rms(weights: Floats, values: Floats) -> float:
    """Weighted root mean square of the values that are finite; NaN if there is none.

    Parameters
    ----------
    weights, values : ndarray, of one shape

    Returns
    -------
    float
    """
    known = np.isfinite(values) & (weights > 0.0)
    if not known.any():
        return math.nan
    return math.sqrt(np.average(values[known] ** 2, weights=weights[known]))


def pixel_unit(model: ForwardModel) -> str:
    """What a pixel is called in which displacements are given.

    Parameters
    ----------
    model : ForwardModel

    Returns
    -------
    str
    """
    return "px" if model.detector.binning == 1 else "fine px"


def _sd(covariance: Floats) -> Floats:
    return np.asarray(np.sqrt(0.5 * np.trace(covariance, axis1=-2, axis2=-1)))


def images_of(posterior: Posterior, params: Floats) -> Floats:
    """Where the sources are imaged on pixels of the likelihood.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    ndarray, shape (n, 2), pixel of the fine grid
        u and v.
    """
    detector, at = posterior.model.detector, posterior.likelihood.image_positions(params)
    at = at[np.isfinite(at).all(axis=1)]
    shape = np.array(detector.shape[::-1])
    pixel = np.rint(at / detector.binning + 0.5 * (shape - 1.0))
    kept = ((pixel >= 0.0) & (pixel < shape)).all(axis=1)
    column, row = pixel[kept].astype(int).T
    return np.asarray(at[kept][posterior.mask[row, column]])


def hull_of(images: Floats) -> Floats:
    """Vertices of the convex hull of points, counterclockwise.

    Parameters
    ----------
    images : ndarray, shape (n, 2)

    Returns
    -------
    ndarray, shape (k, 2)
        None if there are fewer than three points, or all are on a line.
    """
    try:
        return np.asarray(images[spatial.ConvexHull(images).vertices])
    except (spatial.QhullError, ValueError):  # fewer than three, or on a line
        return np.empty((0, 2))


def inside_hull(hull: Floats, u: Floats, v: Floats) -> Flags:
    """Whether points lie within a convex hull, or on an edge.

    Parameters
    ----------
    hull : ndarray, shape (k, 2)
        Vertices, counterclockwise.
    u, v : ndarray, shape (...)

    Returns
    -------
    ndarray of bool, shape (...)
        False if the hull has no vertices.
    """
    inside = np.full(u.shape, len(hull) > 0)
    for (u_0, v_0), (u_1, v_1) in zip(hull, np.roll(hull, -1, axis=0), strict=True):
        length = math.hypot(u_1 - u_0, v_1 - v_0)
        inside &= (u_1 - u_0) * (v - v_0) - (v_1 - v_0) * (u - u_0) >= -1e-9 * length
    return inside


def _field(points: FieldPoints, mean: Floats, covariance: Floats, unit: str) -> DisplacementField:
    """The record of displacements at the points of a frame."""
    length, sd = np.hypot(mean[..., 0], mean[..., 1]), _sd(covariance)
    counted = np.where(points.weights > 0.0, length, np.nan)
    known = bool(np.isfinite(counted).any())
    worst = np.unravel_index(np.nanargmax(counted) if known else 0, length.shape)
    corners = np.ix_([0, -1], [0, -1])
    numbers = {
        "rms": rms(points.weights, length),
        "largest": float(length[worst]),
        "error_rms": rms(points.weights, sd),
        "error_largest": float(np.max(sd[np.isfinite(counted)], initial=-np.inf)),
        "corner": float(np.max(length[corners])),
        "corner_error": float(np.max(sd[corners])),
    }
    at = float(points.u[worst]), float(points.v[worst])
    message = "Displacement: no object is imaged on the frame."
    if known:
        message = _sentence(points, numbers, at, unit)
    return DisplacementField(
        points, mean, covariance, sd, **numbers, largest_at=at, message=message
    )


def _sentence(
    points: FieldPoints, numbers: dict[str, float], at: tuple[float, float], unit: str
) -> str:
    """The field's numbers in one line."""
    rms, largest = (_digits(numbers[key], 3) for key in ("rms", "largest"))
    error, worst, corner = (
        _digits(numbers[key], 2) for key in ("error_rms", "error_largest", "corner_error")
    )
    text = (
        f"Displacement: rms {rms} {unit}, up to {largest} {unit} at (u, v) = "
        f"({at[0]:.0f}, {at[1]:.0f}); known to {error} {unit} rms, {worst} {unit} at worst"
    )
    if not points.inside.any():
        return f"{text}, over the whole frame: the sources enclose no part of it."
    if points.inside.all():
        return f"{text}."
    if not math.isfinite(numbers["corner_error"]):
        return f"{text}; no object is imaged in a corner of the frame, beyond the sources."
    return f"{text}; in the frame's corners, beyond the sources, to {corner} {unit}."


def _digits(value: float, digits: int) -> str:
    """A number with this many significant digits, and no exponent unless it is tiny."""
    return f"{value:.0f}" if value >= 10.0**digits else f"{value:.{digits}g}"
