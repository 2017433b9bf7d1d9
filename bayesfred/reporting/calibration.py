"""The figure of a calibration: displacement, its error, and the PSF over the field."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from bayesfred._typing import Floats
from bayesfred.calibration.calibration import Calibration
from bayesfred.calibration.maps import DisplacementMap, PSFMap
from bayesfred.reporting.field import SIZES, arrows, hatch

__all__ = ["STEPS", "calibration_plot"]

STEPS = 24  # of the maps along the frame's longer side
WIDTH = 14.0  # inch
ERRORS, WIDTHS = "viridis", "cividis"


def calibration_plot(
    calibration: Calibration, moved: DisplacementMap, shape: PSFMap, hull: Floats
) -> Figure:
    """Displacement, its error, and size and ellipticity of images over the frame.

    Parameters
    ----------
    calibration : Calibration
    moved : DisplacementMap
    shape : PSFMap
        On the same grid.
    hull : ndarray, shape (k, 2), pixel of the fine grid
        Convex hull of the sources' images, counterclockwise.

    Returns
    -------
    Figure
        Four panels. What is hatched is beyond the sources.
    """
    rows, columns = calibration.detector.fine_shape
    ratio = min(max(rows / columns, 0.4), 1.6)
    fig = Figure(figsize=(WIDTH, 1.6 + 0.74 * WIDTH * ratio), dpi=100, layout="constrained")
    axes = fig.subplots(2, 2)
    unit = "px" if calibration.detector.binning == 1 else "fine px"
    for ax in axes.flat:
        ax.set(
            xlim=(-0.5 * columns, 0.5 * columns), ylim=(-0.5 * rows, 0.5 * rows), aspect="equal",
            xlabel=f"u / {unit}", ylabel=f"v / {unit}",
        )  # fmt: skip
        hatch(ax, hull)
    _displacement(fig, axes[0, 0], moved, unit)
    _error(fig, axes[0, 1], moved, unit)
    _size(fig, axes[1, 0], shape, unit)
    _ellipticity(fig, axes[1, 1], shape)
    return fig


def _shown(ax: Axes, u: Floats, v: Floats, values: Floats, **how: object) -> object:
    return ax.pcolormesh(u, v, np.ma.masked_invalid(values), rasterized=True, **how)  # type: ignore[arg-type]


def _displacement(fig: Figure, ax: Axes, moved: DisplacementMap, unit: str) -> None:
    length = np.hypot(moved.displacement[..., 0], moved.displacement[..., 1])
    image = _shown(ax, moved.u, moved.v, length, cmap=SIZES, vmin=0.0)
    fig.colorbar(image, ax=ax, label=f"displacement / {unit}", shrink=0.8)  # type: ignore[arg-type]
    some = (slice(None, None, 2), slice(None, None, 2))
    known = np.isfinite(length[some])
    u, v = np.meshgrid(moved.u[::2], moved.v[::2])
    step = 2.0 * float(moved.u[1] - moved.u[0])
    at = np.stack([u[known], v[known]], axis=1)
    ax.set_title(
        f"displacement (u - x, v - y){arrows(ax, at, moved.displacement[some][known], step, unit)}",
        loc="left", fontsize=11,
    )  # fmt: skip


def _error(fig: Figure, ax: Axes, moved: DisplacementMap, unit: str) -> None:
    sd = np.sqrt(0.5 * np.sum(moved.sd**2, axis=-1))
    image = _shown(ax, moved.u, moved.v, sd, cmap=ERRORS, norm=LogNorm())
    bar = fig.colorbar(image, ax=ax, label=f"standard deviation along one axis / {unit}",  # type: ignore[arg-type]
                       shrink=0.8)  # fmt: skip
    bar.ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    bar.ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    among = sd[moved.inside]
    known = f": {np.sqrt(np.mean(among**2)):.2g} {unit} rms among the sources" if among.size else ""
    ax.set_title(f"error of the displacement{known}", loc="left", fontsize=11)


def _size(fig: Figure, ax: Axes, shape: PSFMap, unit: str) -> None:
    low, high = np.nanmin(shape.fwhm), np.nanmax(shape.fwhm)
    margin = max(0.5 * (high - low), 0.005 * high)  # a constant size is no range of colours
    middle = 0.5 * (low + high)
    image = _shown(
        ax, shape.u, shape.v, shape.fwhm, cmap=WIDTHS, vmin=middle - margin, vmax=middle + margin
    )
    fig.colorbar(image, ax=ax, label=f"full width at half maximum / {unit}", shrink=0.8)  # type: ignore[arg-type]
    ax.set_title(f"size of images: {low:.3f} to {high:.3f} {unit}", loc="left", fontsize=11)


def _ellipticity(fig: Figure, ax: Axes, shape: PSFMap) -> None:
    one, two = shape.ellipticity[..., 0], shape.ellipticity[..., 1]
    size, angle = np.hypot(one, two), 0.5 * np.arctan2(two, one)
    top = max(float(np.nanmax(size)), 1e-6)
    image = _shown(ax, shape.u, shape.v, size, cmap=SIZES, vmin=0.0, vmax=1.2 * top)
    fig.colorbar(image, ax=ax, label="ellipticity", shrink=0.8)  # type: ignore[arg-type]
    some = (slice(None, None, 2), slice(None, None, 2))
    step = 2.0 * float(shape.u[1] - shape.u[0])
    u, v = np.meshgrid(shape.u[::2], shape.v[::2])
    length = 0.45 * step * size[some] / top
    du, dv = length * np.cos(angle[some]), length * np.sin(angle[some])
    known = np.isfinite(du)
    ends = np.array([[u - du, u + du], [v - dv, v + dv]])[..., known]
    ax.plot(ends[0], ends[1], color="k", linewidth=1.0)
    ax.set_title(
        f"ellipticity of images, along the lines: up to {top:.2g}", loc="left", fontsize=11
    )
