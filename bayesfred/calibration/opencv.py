"""A calibration as OpenCV's camera: matrix, distortion coefficients, and a turn about the axis.

OpenCV takes a point (X, Y, Z) in front of the camera to (x', y') = (X / Z, Y / Z), turned by a
rotation R, and from there with r^2 = x'^2 + y'^2 to the pixel, counted from 0,

    column = fx (x' (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x' y' + p2 (r^2 + 2 x'^2)) + cx,
    row    = fy (y' (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y'^2) + 2 p2 x' y') + cy.

An object point is at (x, y, f), f the focal length: of a frame of the sky it follows from the pixel
scale, otherwise it must be given, since the object plane has no depth of its own.

fx, fy and a turn about the optical axis are three of the four linear terms that a distortion may
have, so R is such a turn. The fourth, a skew, OpenCV leaves out. A tilt of the axis is not fitted:
in a field of a few degrees it cannot be told from a shift of (cx, cy) with p1 and p2.

The coefficients c are those of least squares at nodes over the whole frame: the gradient g(c) of
half the sum of squares is zero. A draw has other objects at the nodes, and so another gradient; to
first order its coefficients are c - H^-1 g(c), with H = dg/dc of the mean. H keeps the curvature of
the images, since the residuals are not small where OpenCV's terms do not suffice.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from bayesfred._typing import Floats, PathLike
from bayesfred.calibration.plate import nodes, objects, on_plane, truncation
from bayesfred.errors import InputError
from bayesfred.io.atomic import replace
from bayesfred.io.paths import may_write

if TYPE_CHECKING:
    from bayesfred.calibration.calibration import Calibration

__all__ = ["NAMES", "opencv_camera", "write_opencv"]

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "angle")
POWERS = np.array([1, 1, 0, 0, 3, 5, 2, 2, 7, 1])  # of the radius that a coefficient comes with
TOLERANCE = 1e-14
STEP = 1e-3  # pixel, of the differences of gradients
TINY = 1e-20j  # a step without rounding


def opencv_camera(calibration: Calibration, *, focal_length: float | None = None) -> dict[str, Any]:
    """A calibration as OpenCV's camera.

    Parameters
    ----------
    calibration : Calibration
    focal_length : float, optional, recorded pixel
        At which depth the object plane is. Of a frame of the sky it is known.

    Returns
    -------
    dict
        `camera_matrix`, (3, 3), and `distortion_coefficients`, (5,): k1, k2, p1, p2, k3.
        `rotation`, (3, 3), takes object points (x, y, f) to the camera, f in the unit of x and y.
        `image_size`: columns and rows. `truncation_error_px`: `rms` and `max` over the frame, in
        recorded pixels. `draws`, (n, 10): the coefficients `names` of every draw, the angle of
        the turn (radian) the last. `focal_length`: that of the object plane, recorded pixel.
        Of a frame of the sky, `axes`, (3, 3), takes a unit vector (ICRS) to the object's frame;
        its determinant is -1 where the parity of `sky` is "sky": OpenCV's rows count downwards.

    Raises
    ------
    InputError
        If the focal length is missing, is known already, or is not a number above 0, or the
        distortion maps no object to a part of the frame.

    Examples
    --------
    >>> import bayesfred as bf
    >>> theta = [-0.1, 0.02, 0.0, 1e-3, 0.0, 0.5, 0.0]
    >>> calibration = bf.Calibration(
    ...     bf.PolynomialDistortion.radial_tangential(focal_length=500.0), [theta, theta],
    ...     bf.Detector((300, 401)), bf.GaussianPSF(1.0), 1.0, [[0.0, 0.0]])
    >>> camera = opencv_camera(calibration, focal_length=500.0)
    >>> print(camera["camera_matrix"].round(6).tolist()[0])
    [500.0, 0.0, 200.5]
    >>> print(abs(camera["distortion_coefficients"]).round(6).tolist())
    [0.1, 0.02, 0.001, 0.0, 0.0]
    """
    pixels = nodes(calibration.detector.shape)
    focal, place, axes = _object_frame(calibration, focal_length)
    points = np.moveaxis(place(objects(calibration, pixels)), 1, 0)  # (2, 1 + n, points)
    mean = points[:, 0]
    radius = float(np.hypot(*mean).max())
    # in steps that displace the image by a pixel where the radius is the largest
    scale = np.where(np.arange(10) < 4, 1.0, 1.0 / focal) / radius**POWERS
    start = np.array([focal, focal, *(pixels - focal * mean).mean(axis=1), *np.zeros(6)])
    fit = least_squares(
        lambda steps: (_image(start + scale * steps, mean) - pixels).ravel(),
        np.zeros(10),
        jac="cs",
        xtol=TOLERANCE,
        ftol=TOLERANCE,
        gtol=TOLERANCE,
    )
    best = start + scale * fit.x
    gradient, *gradients = _gradients(best, scale, points, pixels)
    hessian = [
        _gradients(best + step, scale, points[:, :1], pixels)[0]
        - _gradients(best - step, scale, points[:, :1], pixels)[0]
        for step in np.diag(STEP * scale)
    ]
    steps = np.linalg.solve(np.array(hessian).T, 2.0 * STEP * (gradient - gradients).T).T
    even = nodes(calibration.detector.shape, even=True)
    found = _image(best, place(objects(calibration, even, draws=False)[0]))
    error = truncation(found, even)
    fx, fy, cx, cy, *distortion, angle = best.tolist()
    camera = {
        "camera_matrix": np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]),
        "distortion_coefficients": np.array(distortion),
        "rotation": Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix(),
        "image_size": calibration.detector.shape[::-1],
        "truncation_error_px": {"rms": error.rms, "max": error.largest},
        "focal_length": focal,
        "names": NAMES,
        "draws": best + scale * steps,
    }
    return camera if axes is None else {**camera, "axes": axes}


def write_opencv(path: PathLike, camera: Mapping[str, Any], *, overwrite: bool = False) -> None:
    """Write what `opencv_camera` returns as JSON that `cv2.FileStorage` reads.

    Parameters
    ----------
    path : path-like
        OpenCV knows the format by the name: .json.
    camera : mapping
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        If the name does not end in .json, or the file exists or cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise InputError(f"{path}: got a camera file ending in {path.suffix!r}, expected .json")
    may_write(path, overwrite=overwrite)
    content = {
        key: _matrix(value) if isinstance(value, np.ndarray) else value
        for key, value in camera.items()
    }
    replace(path, (json.dumps(content, indent=1) + "\n").encode())


def _matrix(values: Floats) -> dict[str, Any]:
    """An array as OpenCV keeps it."""
    rows, columns = np.atleast_2d(values).shape
    kind = {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d"}
    return {**kind, "data": values.ravel().tolist()}


def _object_frame(
    calibration: Calibration, focal_length: float | None
) -> tuple[float, Callable[[Floats], Floats], Floats | None]:
    """The focal length, object points as (X / Z, Y / Z), and the axes of the object's frame.

    The matrix of a tangent plane is a turn, perhaps with a mirror, times a symmetric matrix: the
    latter takes pixels to (X / Z, Y / Z), the former their axes to east and north.
    """
    sky, binning = calibration.sky, calibration.detector.binning
    if sky is None:
        if focal_length is None or not 0.0 < focal_length < np.inf:
            raise InputError(
                f"focal_length: got {focal_length}, expected one in pixels, above 0: the object "
                "plane is not that of the sky, and has no depth of its own"
            )
        return focal_length, lambda at: at / (focal_length * binning), None
    if focal_length is not None:
        raise InputError(
            f"focal_length: got {focal_length} of a frame of the sky, expected none: it follows "
            "from the pixel scale"
        )
    matrix = np.radians(np.array(sky.matrix))
    left, stretch, right = np.linalg.svd(matrix)
    turn = left @ right
    along = Rotation.from_euler("zy", [-sky.ra, sky.dec], degrees=True).as_matrix()
    axes = np.vstack([turn.T @ along[1:], along[:1]])
    focal = float(1.0 / np.sqrt(stretch.prod()) / binning)
    return focal, lambda at: turn.T @ np.radians(on_plane(sky, at)), axes


def _gradients(values: Floats, scale: Floats, points: Floats, pixels: Floats) -> Floats:
    """Gradients along steps of the coefficients, shape (n, 10), for points of shape (2, n, ...)."""
    residual = _image(values, points) - pixels[:, None]
    slopes = (_image(values + TINY * step, points).imag / TINY.imag for step in np.diag(scale))
    return np.stack([np.sum(slope * residual, axis=(0, 2)) for slope in slopes], axis=1)


def _image(values: NDArray[Any], points: Floats) -> NDArray[Any]:
    """Column and row of (X / Z, Y / Z), shape (2, ...), with the coefficients `NAMES`.

    It takes complex coefficients, whose steps give exact derivatives.
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3, angle = values
    x = np.cos(angle) * points[0] - np.sin(angle) * points[1]
    y = np.sin(angle) * points[0] + np.cos(angle) * points[1]
    square = x**2 + y**2
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    column = fx * (x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x**2)) + cx
    row = fy * (y * radial + p1 * (square + 2.0 * y**2) + 2.0 * p2 * x * y) + cy
    return np.array([column, row])
