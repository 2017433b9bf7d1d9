"""Corrected frames: the counts of a frame resampled to the undistorted plane or to the sky.

The corners of a recorded pixel i are mapped with the calibration's mean and make a quadrilateral of
area A_i on the output grid. Its counts d_i are spread evenly over it, so that output pixel j gets

    F_j = sum_i w_ij d_i,    var_j = sum_i w_ij^2 var_i,    w_ij = overlap_ij / A_i.

The quadrilaterals share their corners and tile the plane: no count is lost or made. `overlaps`
computes them.

An error of the calibration moves light. If it displaces the objects by delta, the density rho of
the counts flows through the sides of output pixels, and F_j changes by minus the sum of rho delta_n
over its sides: that is the gradient of F along delta, and the change of the area over which light
is spread. To first order delta = J R z, with J the derivatives of the position with respect to the
coefficients and the offset, R R^T their covariance and z independent standard normal variables. So
the calibration's part of the variance is

    sum over k of (sum over the sides of j of rho (J R_k)_n)^2.

`corrected` holds the result and writes it.
"""

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS, NoConvergence

from bayesfred._typing import Flags, Floats
from bayesfred.calibration.calibration import Calibration
from bayesfred.calibration.corrected import CorrectedFrame
from bayesfred.calibration.overlaps import (
    LARGEST,
    corners,
    extent,
    require_size,
    resampled,
    signed_areas,
)
from bayesfred.errors import InputError
from bayesfred.io.arrays import frame_given
from bayesfred.io.frames import LARGEST_COUNT
from bayesfred.io.sky import icrs

__all__ = ["correct"]

FULL = 1.0 - 1e-4  # coverage of a pixel that is wholly covered, but for rounding
MOST = 16  # pixels of the object plane for each pixel of the frame
BLOCK = 2**16  # pixels whose derivatives are computed at once: what fits the memory

Plane = Callable[[Floats, Floats], tuple[Floats, Floats]]


@dataclass(frozen=True, eq=False)
class _Grid:
    """An output grid, and the object points (x, y) of its columns and rows."""

    wcs: WCS
    shape: tuple[int, int]
    plane: Plane


def correct(
    frame: Any,
    calibration: Calibration,
    *,
    wcs: WCS | None = None,
    shape: tuple[int, int] | None = None,
    variance: npt.ArrayLike | None = None,
    mask: npt.ArrayLike | None = None,
) -> CorrectedFrame:
    """Resample a frame to undistorted coordinates, conserving its counts.

    Parameters
    ----------
    frame : array_like, MaskedArray, Quantity, NDData or CCDData, shape (ny, nx), counts
    calibration : Calibration
        Of the same detector.
    wcs : astropy.wcs.WCS, optional
        The output grid: two celestial axes. By default the object plane, with pixels of the size of
        the recorded ones, and all of the frame on it.
    shape : tuple of int, (rows, columns), optional
        Of the output grid; by default that which `wcs` knows. Without `wcs` the shape is given by
        the frame.
    variance : array_like, shape (ny, nx) or a number, counts^2, optional
        Of the frame's counts. By default the counts themselves, but at least 1: Poisson noise, and
        a pixel without counts does not get a weight without limit. Where a few counts a pixel are
        expected, that is too much on average; better give the expected counts. Read noise is not
        part of it.
    mask : array_like of bool, shape (ny, nx), optional
        True where a pixel is good. Counts of other pixels are not used.

    Returns
    -------
    CorrectedFrame

    Raises
    ------
    InputError
        If the frame is not the detector's, a good pixel is not finite, or none is good; if `wcs`
        has not two celestial axes, the calibration's place on the sky is not known, or no pixel
        falls on the grid; if the distortion folds within the frame.

    Notes
    -----
    Within a pixel counts are spread evenly. That widens a PSF: by a sixth of a squared pixel in
    variance along each axis. Where the scale of the output differs by a share s from the frame's,
    recorded and output pixels beat, and centroids waver by up to s / 3 pixel. A PSF that is
    symmetric on the frame is not quite so afterwards: its centroid moves by half its variance times
    the curvature of the map. In single precision, counts are conserved to some 1e-8.

    Examples
    --------
    >>> import bayesfred as bf
    >>> calibration = bf.Calibration(
    ...     bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)]),
    ...     [[-0.1, -0.1, 0.0, 0.0], [-0.101, -0.1, 0.0, 0.0]],
    ...     bf.Detector((21, 21)), bf.GaussianPSF(2.0), 2.0, [[0.0, 0.0]])
    >>> corrected = correct(np.full((21, 21), 121.0), calibration)
    >>> corrected.counts.shape, round(corrected.counts.sum()), round(corrected.counts[9, 9])
    ((21, 21), 53361, 146)
    """
    counts, good = _frame(frame, mask, calibration.detector.shape)
    spread = _variance(variance, counts, good)
    x, y = _objects(calibration)
    if wcs is None:
        if shape is not None:
            raise InputError(f"shape: got {shape} without wcs, expected both or neither")
        at, grid = _object_grid(calibration, x, y)
    else:
        at, grid = _sky_grid(calibration, wcs, shape, x, y)
    found, noise, coverage, *sides = resampled((counts, spread, good), at, grid.shape)
    moved = _calibration_variance(calibration, grid, sides, coverage > 0.0)
    found, noise, share = (p[1:-1, 1:-1].copy() for p in (found, noise, coverage))
    total, share = noise + moved, np.minimum(share, 1.0)
    valid = (share > FULL) & np.isfinite(total)
    message = _message(calibration, found, (counts, good), (moved, total), valid)
    return CorrectedFrame(found, total, moved, valid, share, grid.wcs, message)


def _frame(frame: Any, mask: npt.ArrayLike | None, shape: tuple[int, int]) -> tuple[Floats, Flags]:
    """Counts, 0 in pixels that are not good, and the good pixels."""
    try:
        counts, good = frame_given(frame, mask)
    except InputError:
        raise
    except (TypeError, ValueError):
        raise InputError(
            f"frame: got {type(frame).__name__}, expected an array of counts"
        ) from None
    good = np.ones(counts.shape, dtype=bool) if good is None else good
    for name, found in (("frame", counts.shape), ("mask", good.shape)):
        if found != shape:
            raise InputError(
                f"{name}: got shape {found}, expected {shape}, that of the calibration's detector"
            )
    if not good.any():
        raise InputError("mask: got no good pixel, expected some (True where a pixel is good)")
    bad = good & ~(np.abs(counts) <= LARGEST_COUNT)
    if bad.any():
        row, column = np.argwhere(bad)[0]
        raise InputError(
            f"frame: got {counts[row, column]:.9g} at row {row}, column {column}, expected finite "
            f"counts of at most {LARGEST_COUNT:.0e}: mask such pixels"
        )
    return np.where(good, counts, 0.0), good


def _variance(variance: npt.ArrayLike | None, counts: Floats, good: Flags) -> Floats:
    if variance is None:
        return np.where(good, np.maximum(counts, 1.0), 0.0)
    try:
        given = np.broadcast_to(np.asarray(variance, dtype=np.float64), counts.shape)
    except (TypeError, ValueError):
        raise InputError(
            f"variance: got shape {np.shape(variance)}, expected {counts.shape} or a number"
        ) from None
    if not ((given >= 0.0) & (given <= LARGEST_COUNT))[good].all():
        raise InputError(
            "variance: got NaN, infinite or negative values, expected numbers from 0 to "
            f"{LARGEST_COUNT:.0e}"
        )
    return np.where(good, given, 0.0)


def _objects(calibration: Calibration) -> tuple[Floats, Floats]:
    """Object points of the pixels' centres, with one more pixel on each side of the frame."""
    ny, nx = calibration.detector.shape
    rows, columns = np.indices((ny + 2, nx + 2)) - 1.0
    mean = calibration.positions.mean
    x, y = calibration.distortion.object_position(
        mean[:-2], *calibration.from_index(columns, rows), offset=mean[-2:]
    )
    lost = np.isnan(corners(x) + corners(y))
    if not lost.any():
        size = signed_areas(corners(x), corners(y))
        lost = size * np.median(size) <= 0.0
    if lost.any():
        row, column = np.argwhere(lost)[0]
        raise InputError(
            f"calibration: got a distortion that folds at row {row}, column {column}, expected "
            "one object point for each pixel: fit one with fewer terms, or more sources there"
        )
    return x, y


def _object_grid(
    calibration: Calibration, x: Floats, y: Floats
) -> tuple[tuple[Floats, Floats], _Grid]:
    """Pixels of the object plane, and where the frame's pixels are on them."""
    at = calibration.index(x, y)
    low, shape = extent(corners(at[0]), corners(at[1]))
    require_size("calibration", shape, min(MOST * x.size, LARGEST))

    def plane(column: Floats, row: Floats) -> tuple[Floats, Floats]:
        return calibration.from_index(column + low[0], row + low[1])

    sky, binning = calibration.sky, calibration.detector.binning
    wcs = WCS(naxis=2)
    middle = calibration.index(*((0.0, 0.0) if sky is None else sky.origin))
    wcs.wcs.crpix = [float(p) - first + 1.0 for p, first in zip(middle, low, strict=True)]
    if sky is None:
        wcs.wcs.ctype, wcs.wcs.cunit = ("X", "Y"), ("pixel", "pixel")
        wcs.wcs.cdelt = binning, binning
    else:
        wcs.wcs.ctype, wcs.wcs.cunit = ("RA---TAN", "DEC--TAN"), ("deg", "deg")
        wcs.wcs.crval, wcs.wcs.cd = (sky.ra, sky.dec), np.array(sky.matrix) * binning
        wcs.wcs.radesys = "ICRS"
    wcs.array_shape = shape
    wcs.wcs.set()
    return (at[0] - low[0], at[1] - low[1]), _Grid(wcs, shape, plane)


def _sky_grid(
    calibration: Calibration, wcs: Any, shape: tuple[int, int] | None, x: Floats, y: Floats
) -> tuple[tuple[Floats, Floats], _Grid]:
    """Pixels of a coordinate system, and where the frame's pixels are on them."""
    sky = calibration.sky
    if sky is None:
        raise InputError(
            "wcs: got one for a calibration whose object plane has no place on the sky, expected "
            "none, or a calibration of a catalogue with ra and dec"
        )
    if not isinstance(wcs, WCS) or wcs.naxis != 2 or not wcs.has_celestial:
        axes = f" with axes {list(wcs.wcs.ctype)}" if isinstance(wcs, WCS) else ""
        raise InputError(
            f"wcs: got {type(wcs).__name__}{axes}, expected an astropy.wcs.WCS with two celestial "
            "axes: take its celestial part"
        )
    given = wcs.array_shape if shape is None else shape
    try:
        rows, columns = (operator.index(n) for n in given)
    except (TypeError, ValueError):
        rows = columns = 0
    if min(rows, columns) < 1:
        raise InputError(f"shape: got {given}, expected rows and columns of the output grid")
    require_size("shape", (rows, columns))
    try:
        column, row = wcs.world_to_pixel(_coordinates(*sky.to_sky(x, y)))
    except NoConvergence:
        column, row = np.full_like(x, np.nan), np.full_like(x, np.nan)
    if not np.isfinite(column + row).all():
        raise InputError(
            "wcs: got one in which parts of the frame have no place, expected a projection that "
            "has the whole frame: take one with its centre nearer to the frame"
        )

    def plane(column: Floats, row: Floats) -> tuple[Floats, Floats]:
        return sky.to_plane(*icrs(wcs.pixel_to_world(column, row)))

    return (column, row), _Grid(wcs.deepcopy(), (rows, columns), plane)


def _coordinates(ra: Floats, dec: Floats) -> SkyCoord:
    return SkyCoord(ra * units.deg, dec * units.deg)


def _calibration_variance(
    calibration: Calibration, grid: _Grid, sides: list[Floats], covered: Flags
) -> Floats:
    """The calibration's part of the variance, shape of the grid, from densities with a ring."""
    root = calibration.positions.root
    out = np.zeros(grid.shape)
    step = max(1, BLOCK // covered.shape[1])
    for first in range(0, grid.shape[0], step):
        some = slice(first, min(first + step, grid.shape[0]))
        band = slice(some.start, some.stop + 2)
        used = covered[band]
        if not used.any():
            continue
        right, top = sides[0][band][1:-1, :-1], sides[1][band][:-1, 1:-1]
        index = np.indices(used.shape, dtype=np.float64)
        plane = grid.plane(index[1] - 1.0, index[0] + (first - 1.0))
        turn, a, b = _moved(calibration, plane, used)
        a, b = a @ root[:-2] - root[-2], b @ root[:-2] - root[-1]
        delta = np.zeros((2, *used.shape))
        for k in range(root.shape[1]):
            for axis in (0, 1):
                delta[axis, used] = turn[:, axis, 0] * a[:, k] + turn[:, axis, 1] * b[:, k]
            x, y = delta[0, 1:-1], delta[1, :, 1:-1]
            across, along = right * (x[:, 1:] + x[:, :-1]), top * (y[1:] + y[:-1])
            out[some] += (0.5 * (np.diff(across, axis=1) + np.diff(along, axis=0))) ** 2
    return out


def _moved(
    calibration: Calibration, plane: tuple[Floats, Floats], used: Flags
) -> tuple[Floats, Floats, Floats]:
    """How the coefficients displace the objects at output pixels.

    The matrices from changes of (a, b) to columns and rows, shape (n, 2, 2), and the changes of a
    and b with each coefficient, shape (n, n_terms).
    """
    positions = calibration.positions
    mean = positions.mean
    slopes = [np.gradient(p) for p in plane]
    pixel = np.stack([np.stack([p[1][used], p[0][used]], -1) for p in slopes], -2)
    x, y = (p[used] for p in plane)
    u, v = calibration.distortion.image_position(mean[:-2], x, y, offset=mean[-2:])
    turn = np.linalg.inv(positions.slope((u, v, x, y), images=False) @ pixel)
    a, b = calibration.distortion.design_matrix(u, v, x, y)
    return turn, a, b


def _message(
    calibration: Calibration,
    found: Floats,
    frame: tuple[Floats, Flags],
    variances: tuple[Floats, Floats],
    valid: Flags,
) -> str:
    """One line: what is on the grid, what is extrapolated, and what the calibration's errors do."""
    counts, good = frame
    rows, columns = np.nonzero(good)
    beyond = np.mean(~calibration.inside(*calibration.from_index(columns, rows)))
    moved, total = variances
    known = valid & (total > 0.0)
    share = np.sqrt(np.max(moved[known] / total[known], initial=0.0))
    return (
        f"{found.shape[0]} x {found.shape[1]} pixels with {found.sum():.9g} of {counts.sum():.9g} "
        f"counts; the calibration makes at most {100.0 * share:.2g} % of the error of a pixel; "
        f"{100.0 * beyond:.2g} % of the frame is beyond the sources, where only the terms of the "
        "distortion say what happens"
    )
