"""A calibration over the field: displacement and PSF on a grid, and the FITS file of both.

Near an object's image the PSF is seen through the distortion's slope D: K(u, v) = p(D (du, dv))
|D|. Its shape is that of its second moments with the weight of a circular Gaussian of the PSF's own
width, from which the weight is taken out again: with the weighted moments Q_w and the weight's W,

    Q = (Q_w^-1 - W^-1)^-1,    e1 = (Q_uu - Q_vv) / (Q_uu + Q_vv),    e2 = 2 Q_uv / (Q_uu + Q_vv),

which are exact for a Gaussian and finite for wide wings. Its size is the full width at half maximum
of the PSF in the middle of the field without distortion, of moments Q_0, times (det Q / det
Q_0)^(1/4).
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from astropy.io import fits

from bayesfred._typing import Flags, Floats, PathLike
from bayesfred.errors import InputError
from bayesfred.imaging.psf.protocol import FWHM, density_at
from bayesfred.io.atomic import replace
from bayesfred.io.paths import may_write

if TYPE_CHECKING:
    from bayesfred.calibration.calibration import Calibration

__all__ = ["DisplacementMap", "PSFMap", "displacement_map", "psf_map", "write_maps"]

MOST_POINTS = 10**7
SAMPLES = 61  # a side, of the PSF at a point
REACH = 4.0  # widths of the PSF that they span, either way


@dataclass(frozen=True, eq=False)
class DisplacementMap:
    """The displacement on a grid of image points.

    Attributes
    ----------
    u, v : ndarray, shape (columns,) and (rows,), pixel of the fine grid
        From the middle of the frame, which is one of the points.
    displacement : ndarray, shape (rows, columns, 2), pixel
        (u - x, v - y) of the object that is imaged there; NaN where there is none.
    covariance : ndarray, shape (rows, columns, 2, 2), pixel^2
    inside : ndarray of bool, shape (rows, columns)
        Whether a point is among the sources; elsewhere only the terms say what happens.
    """

    u: Floats
    v: Floats
    displacement: Floats
    covariance: Floats
    inside: Flags

    @property
    def sd(self) -> Floats:
        """Standard deviations along u and v, shape (rows, columns, 2), pixel."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))


@dataclass(frozen=True, eq=False)
class PSFMap:
    """Size and shape of the images of point sources on a grid.

    Attributes
    ----------
    u, v : ndarray, shape (columns,) and (rows,), pixel of the fine grid
    fwhm : ndarray, shape (rows, columns), pixel of the fine grid
        Full width at half maximum, of all directions.
    ellipticity : ndarray, shape (rows, columns, 2)
        e1 along u (positive) or v, and e2 along the diagonals; 0 for a round image.
    inside : ndarray of bool, shape (rows, columns)
    """

    u: Floats
    v: Floats
    fwhm: Floats
    ellipticity: Floats
    inside: Flags


def displacement_map(calibration: Calibration, step: float) -> DisplacementMap:
    """The displacement every `step` pixels of the fine grid, see `Calibration.displacement_map`."""
    u, v, grid = _grid(calibration, step)
    x, y, covariance = calibration.positions.object(*grid)
    displacement = np.stack([grid[0] - x, grid[1] - y], axis=-1)
    return DisplacementMap(u, v, displacement, covariance, calibration.inside(*grid))


def psf_map(calibration: Calibration, step: float) -> PSFMap:
    """Size and shape of images every `step` pixels, see `Calibration.psf_map`."""
    u, v, grid = _grid(calibration, step)
    x, y, _ = calibration.positions.object(*grid)
    slope = calibration.positions.slope((*grid, x, y)).reshape(-1, 2, 2)
    moments = [
        _moments(calibration, d, at) for d, at in zip(slope, zip(x.flat, y.flat, strict=True),
                                                      strict=True)
    ]  # fmt: skip
    q = np.array(moments).reshape(*x.shape, 2, 2)
    with np.errstate(invalid="ignore"):
        plain = _moments(calibration, np.eye(2), (0.0, 0.0))
        fwhm = FWHM * calibration.psf_sigma * (np.linalg.det(q) / np.linalg.det(plain)) ** 0.25
        trace = q[..., 0, 0] + q[..., 1, 1]
        ellipticity = np.stack(
            [(q[..., 0, 0] - q[..., 1, 1]) / trace, 2.0 * q[..., 0, 1] / trace], axis=-1
        )
    return PSFMap(u, v, fwhm, ellipticity, calibration.inside(*grid))


def write_maps(
    calibration: Calibration, path: PathLike, step: float, *, overwrite: bool = False
) -> None:
    """Write displacement, its standard deviation and the PSF's shape as images of a FITS file.

    Parameters
    ----------
    calibration : Calibration
    path : path-like
        A .fits file. Its extensions are DISP_U, DISP_V, SD_U, SD_V, FWHM, E1, E2 and INSIDE; their
        linear coordinates are u and v.
    step : float, pixel of the fine grid
    overwrite : bool
        Replace a file that exists.

    Raises
    ------
    InputError
        If the file exists or cannot be written, or the step is too small or not positive.
    """
    path = Path(path)
    may_write(path, overwrite=overwrite)
    moved, shape = displacement_map(calibration, step), psf_map(calibration, step)
    images = {
        "DISP_U": moved.displacement[..., 0], "DISP_V": moved.displacement[..., 1],
        "SD_U": moved.sd[..., 0], "SD_V": moved.sd[..., 1], "FWHM": shape.fwhm,
        "E1": shape.ellipticity[..., 0], "E2": shape.ellipticity[..., 1],
        "INSIDE": moved.inside.astype(np.uint8),
    }  # fmt: skip
    hdus = fits.HDUList([fits.PrimaryHDU()])
    hdus[0].header["COMMENT"] = "u, v: pixels from the middle of the frame. INSIDE: among sources"
    for name, image in images.items():
        hdu = fits.ImageHDU(image, name=name)
        for axis, (label, at) in enumerate((("U", moved.u), ("V", moved.v)), start=1):
            hdu.header[f"CTYPE{axis}"], hdu.header[f"CUNIT{axis}"] = label, "pixel"
            hdu.header[f"CRPIX{axis}"], hdu.header[f"CRVAL{axis}"] = 1.0, float(at[0])
            hdu.header[f"CDELT{axis}"] = float(step)
        if not name.startswith(("E", "INSIDE")):
            hdu.header["BUNIT"] = "pixel"
        hdus.append(hdu)
    content = io.BytesIO()
    hdus.writeto(content, checksum=True)
    replace(path, content.getvalue())


def _grid(calibration: Calibration, step: float) -> tuple[Floats, Floats, tuple[Floats, Floats]]:
    """Points `step` apart that cover the frame, the middle among them."""
    rows, columns = calibration.detector.fine_shape
    if not 0.0 < step < np.inf or rows * columns > MOST_POINTS * step**2:
        raise InputError(
            f"step: got {step}, expected a positive number of pixels that makes at most "
            f"{MOST_POINTS:.0e} points"
        )
    halves = (int(0.5 * n / step) for n in (columns, rows))
    u, v = (step * np.arange(-half, half + 1.0) for half in halves)
    grid_u, grid_v = np.meshgrid(u, v)
    return np.asarray(u), np.asarray(v), (np.asarray(grid_u), np.asarray(grid_v))


def _moments(calibration: Calibration, slope: Floats, at: tuple[float, float]) -> Floats:
    """Q of the image of a source at an object point, shape (2, 2)."""
    if not np.isfinite([*slope.flat, *at]).all():
        return np.full((2, 2), np.nan)
    width = calibration.psf_sigma / np.sqrt(abs(np.linalg.det(slope)))
    offset = REACH * width * np.linspace(-1.0, 1.0, SAMPLES)
    du, dv = (p.ravel() for p in np.meshgrid(offset, offset))
    a, b = slope @ np.stack([du, dv]) * (calibration.psf.sigma / calibration.psf_sigma)
    light = density_at(calibration.psf, a, b, at) * np.exp(-0.5 * (du**2 + dv**2) / width**2)
    total = light.sum()
    du, dv = du - light @ du / total, dv - light @ dv / total
    uu, uv, vv = (light @ (p * q) / total for p, q in ((du, du), (du, dv), (dv, dv)))
    weighted = np.linalg.inv(np.array([[uu, uv], [uv, vv]]))
    return np.asarray(np.linalg.inv(weighted - np.eye(2) / width**2))
