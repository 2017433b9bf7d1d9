"""Has the camera changed? The difference of two calibrations, with its significance.

The positions that two calibrations give to the same points of the detector differ by what changed
in the camera and by where it pointed. Of the pose, the shift and the rotation are always fitted and
taken out; the scale is reported by itself, since a lens may have changed it and a target may have
been at another distance. Over the field the covariance of the difference is the sum of both,

    C = J_a C_a J_a^T + J_b C_b J_b^T,

and the part P d that no pose makes has the covariance P C P^T, with P the projection on what is
orthogonal to the pose. Of its principal components, the ones that make up 99 % of the mean square
expected over the field are kept; the sum of their squares, in units of their errors, is a
chi-square. On the sky both are compared on the tangent plane, in pixels of the first.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from bayesfred._typing import Floats
from bayesfred.analysis.agreement import Agreement
from bayesfred.analysis.field import hull_of, inside_hull
from bayesfred.errors import InputError
from bayesfred.io.tangent_plane import ARCSEC

if TYPE_CHECKING:
    from bayesfred.calibration.calibration import Calibration

__all__ = ["CalibrationDifference", "difference"]

POINTS = 15  # of the grid along the frame's longer side
FIELD = 0.99  # share of the mean square over the field that is tested
LEAST = 8  # points that both calibrations know


@dataclass(frozen=True, eq=False)
class CalibrationDifference:
    """What changed between two calibrations.

    Attributes
    ----------
    u, v : ndarray, shape (n,), pixel of the fine grid
        Points of a grid that are among the sources of both.
    difference : ndarray, shape (n, 2), pixel of the fine grid
        Object position of the second less that of the first, without shift, rotation and scale.
    covariance : ndarray, shape (n, 2, 2), pixel^2
    agreement : Agreement
        Chi-square of that difference, its degrees of freedom and its probability `p` if nothing
        changed.
    scale, scale_sd : float
        By how much the second counts more pixels for the same object, as a fraction, and its error.
    rms : float, pixel
        Of the difference along one axis, noise included.
    changed : bool
        Whether `p` is below 0.01.
    message : str
        One line.
    """

    u: Floats
    v: Floats
    difference: Floats
    covariance: Floats
    agreement: Agreement
    scale: float
    scale_sd: float
    rms: float
    changed: bool
    message: str


def difference(a: Calibration, b: Calibration) -> CalibrationDifference:
    """Compare two calibrations of one camera, see `Calibration.difference`."""
    if a.detector.fine_shape != b.detector.fine_shape:
        raise InputError(
            f"detector: got frames of {a.detector.fine_shape} and {b.detector.fine_shape} pixels, "
            "expected those of one camera"
        )
    if (a.sky is None) != (b.sky is None):
        raise InputError(
            "sky: got one calibration with a place on the sky and one without, expected both or "
            "neither"
        )
    u, v = _common(a, b)
    scale = 1.0 if a.sky is None else ARCSEC / a.sky.pixel_scale  # pixels of a per degree
    fields = [_field(c, u, v, scale) for c in (a, b)]
    positions = [field.mean(axis=0) for field in fields]
    turned = _aligned(positions[0], positions[1])
    # the pose is removed to first order about the positions of the first
    x, y = positions[0]
    one, none = np.ones_like(x), np.zeros_like(x)
    pose = np.stack([(one, none), (none, one), (-y, x), (x, y)]).reshape(4, -1)
    other = (
        turned @ (fields[1] - positions[1].mean(axis=1)[:, None])
        + np.mean(positions[0], axis=1)[:, None]
    )
    moved = (other.mean(axis=0) - positions[0]).ravel()
    spread = [(field - field.mean(axis=0)).reshape(len(field), -1) for field in (fields[0], other)]
    covariance = sum(s.T @ s / (len(s) - 1) for s in spread)
    solve = np.linalg.pinv(pose.T)
    found = solve @ moved
    left = np.eye(moved.size) - pose.T @ solve
    rest, rest_covariance = left @ moved, left @ covariance @ left
    values, vectors = np.linalg.eigh(rest_covariance)
    order = np.argsort(-values)
    share = np.cumsum(values[order]) / values.sum()
    kept = order[: int(np.searchsorted(share, FIELD)) + 1]
    # the inverse of a covariance of finitely many draws is too large on average (Wishart)
    number = sum(len(field) - 1 for field in fields)
    correction = np.sqrt(max(number - len(kept) - 1, 1) / number)
    z = vectors[:, kept].T @ rest / np.sqrt(values[kept]) * correction
    agreement = Agreement.of(z)
    n = u.size
    each = np.stack([[rest_covariance[i * n : (i + 1) * n, j * n : (j + 1) * n].diagonal()
                      for j in (0, 1)] for i in (0, 1)])  # fmt: skip
    return _result(u, v, rest, (each, agreement), (found[3], (solve @ covariance @ solve.T)[3, 3]))


def _result(
    u: Floats,
    v: Floats,
    rest: Floats,
    tested: tuple[Floats, Agreement],
    scale: tuple[float, float],
) -> CalibrationDifference:
    each, agreement = tested
    rms, changed = float(np.sqrt(np.mean(rest**2))), agreement.p < 0.01
    verdict = "the camera has changed" if changed else "no change is seen"
    sd = float(np.sqrt(np.trace(each).mean() / 2.0))
    message = (
        f"{verdict}: beyond shift, rotation and scale the positions differ by {rms:.2g} px rms "
        f"({sd:.2g} expected from the errors; chi-square {agreement.chi2:.1f} for {agreement.dof}, "
        f"p = {agreement.p:.2g}); the scale by {scale[0]:.2g} +- {np.sqrt(scale[1]):.2g}"
    )
    return CalibrationDifference(
        u, v, rest.reshape(2, -1).T, np.moveaxis(each, 2, 0), agreement, float(scale[0]),
        float(np.sqrt(scale[1])), rms, changed, message,
    )  # fmt: skip


def _common(a: Calibration, b: Calibration) -> tuple[Floats, Floats]:
    """Points of a grid that are among the sources of both."""
    rows, columns = a.detector.fine_shape
    step = max(rows, columns) / POINTS
    halves = (int(0.5 * n / step) for n in (columns, rows))
    u, v = np.meshgrid(*(step * np.arange(-half, half + 1.0) for half in halves))
    both = np.all([inside_hull(hull_of(c.sources), u, v) for c in (a, b)], axis=0)
    if both.sum() < LEAST:
        raise InputError(
            f"sources: got {both.sum()} of {both.size} points of the frame among the sources of "
            f"both calibrations, expected at least {LEAST}: compare calibrations of one field"
        )
    return u[both], v[both]


def _field(calibration: Calibration, u: Floats, v: Floats, scale: float) -> Floats:
    """Positions by every draw, shape (draws, 2, points), on the plane that is compared."""
    found = np.array(
        calibration.distortion.object_position(
            calibration.draws[:, :-2], u, v, offset=calibration.draws[:, -2:]
        )
    ).swapaxes(0, 1)
    sky = calibration.sky
    if sky is None:
        return np.asarray(found)
    off = found - np.array(sky.origin)[:, None]
    return np.asarray(scale * (np.array(sky.matrix) @ off))


def _aligned(to: Floats, positions: Floats) -> Floats:
    """The rotation, mirrored if need be, that brings positions, shape (2, n), next to others."""
    left, right = (p - p.mean(axis=1, keepdims=True) for p in (to, positions))
    one, _, two = np.linalg.svd(left @ right.T)
    return np.asarray(one @ two)
