"""Figures of studies: noise levels, and simulation-based calibration.

Every function returns a `matplotlib.figure.Figure` that belongs to no window and no pyplot state;
the caller saves it.
"""

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from bayesfred._typing import Floats
from bayesfred.analysis.ecdf_bands import band, ecdf, points
from bayesfred.analysis.noise_study import VARIABLES, NoiseStudy
from bayesfred.analysis.sbc import SBCResult
from bayesfred.analysis.study_helpers import LEVELS
from bayesfred.model.parameters import Parameter
from bayesfred.reporting.labels import axis_label, math_symbol
from bayesfred.reporting.style import ENSEMBLE_COLOURS, POSTERIOR_COLOUR, TRUTH_COLOUR

__all__ = ["calibration_plot", "noise_plot"]

VARIABLE_LABELS = {
    "background": "background / counts per pixel",
    "flux": "mean flux / counts",
    "sources": "number of sources",
    "psf_sigma": "PSF sigma / pixel",
    "exposure": "exposure / the model's",
}


def noise_plot(study: NoiseStudy, parameters: Sequence[Parameter]) -> Figure:
    """Every parameter's width over the noise level, the error in pixels, efficiency and coverage.

    Parameters
    ----------
    study : NoiseStudy
        Its first variable of several values is the abscissa; combinations of the others are series.
    parameters : sequence of Parameter
        Those of the study's model, for their symbols and units.

    Returns
    -------
    Figure
    """
    cells = study.cells
    varied = [name for name in VARIABLES if len(set(cells[name])) > 1] or [VARIABLES[0]]
    abscissa, others = varied[0], varied[1:]
    of = np.array(
        [
            ", ".join(f"{name.replace('_', ' ')} {cells[name][k]:g}" for name in others)
            for k in range(len(cells["failed"]))
        ]
    )
    series = list(dict.fromkeys(of.tolist()))
    names = study.parameter_names
    rows = -(-len(names) // 4)
    columns = max(-(-len(names) // rows), 2)
    heights = (0.6 + 2.6 * rows, 3.6)
    fig = Figure(figsize=(3.6 * max(columns, 3), sum(heights)), dpi=100, layout="constrained")
    # an array, whatever the stubs of the version say
    parts: Any = fig.subfigures(2, 1, height_ratios=heights)
    upper, lower = parts
    widths = upper.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    pixels, *shares = lower.subplots(1, 3)
    for s, label in enumerate(series):
        colour = ENSEMBLE_COLOURS[s % len(ENSEMBLE_COLOURS)]
        for ax, name in zip(widths, names, strict=False):
            mine = np.flatnonzero((cells["parameter"] == name) & (of == label))
            _width(ax, {key: values[mine] for key, values in cells.items()}, abscissa, colour)
        mine = np.flatnonzero((cells["parameter"] == "theta") & (of == label))
        # so that points of a noise level do not hide each other
        x = cells[abscissa][mine] * (1.0 + 0.05 * (s - 0.5 * (len(series) - 1)))
        whole = {key: values[mine] for key, values in cells.items()}
        _shares(shares, x, whole, colour)
        _pixels(pixels, x, whole, colour)
    every = cells[abscissa]
    for ax in (*widths[: len(names)], pixels, *shares):
        ax.set_xscale("log" if every.max() > 3.0 * every.min() else "linear")
        ax.tick_params(labelsize=8)
    labels = {parameter.name: axis_label(parameter, 0) for parameter in parameters}
    for k, ax in enumerate(widths):
        ax.set_visible(k < len(names))
        if k < len(names):
            _logarithmic(ax)
            ax.set_title(f"sd of {labels[names[k]]}", fontsize=9.5)
            ax.tick_params(which="both", labelbottom=k + columns >= len(names), labelsize=8)
        if k < len(names) <= k + columns:
            ax.set_xlabel(VARIABLE_LABELS[abscissa], fontsize=8.5)
    handles = _noise_handles(series if others else [])
    upper.legend(
        handles=handles,
        loc="outside upper center",
        ncols=min(len(handles), 6),
        frameon=False,
        fontsize=9,
    )
    pixels.set(
        xlabel=VARIABLE_LABELS[abscissa],
        ylabel="rms over the field / px",
        title="error of the displacement",
    )
    _logarithmic(pixels)
    lowest = np.nanmin(cells["coverage_68"][cells["parameter"] == "theta"], initial=0.5)
    _name_shares(shares, VARIABLE_LABELS[abscissa], float(lowest) - 0.05)
    return fig


def _logarithmic(ax: Axes) -> None:
    """A logarithmic scale upward, where anything is above zero."""
    if np.isfinite(ax.dataLim.minposy):
        ax.set_yscale("log")


def _width(ax: Axes, cells: Mapping[str, Floats], abscissa: str, colour: str) -> None:
    """Bound, posterior standard deviation and scatter of one parameter in one series."""
    x, width, bound, scatter = (cells[key] for key in (abscissa, "width", "bound", "scatter"))
    order = np.argsort(x)
    error = scatter / np.sqrt(2.0 * np.maximum(cells["frames"] - 1, 1))
    ax.plot(x[order], bound[order], color=colour, linewidth=1.0)
    ax.errorbar(
        x * 1.04, scatter, error, fmt="s", mfc="white", color=colour, markersize=4.5, linewidth=1.0
    )
    ax.plot(x / 1.04, width, "o", color=colour, markersize=4.5)


def _shares(axes: Sequence[Axes], x: Floats, cells: Mapping[str, Floats], colour: str) -> None:
    """Efficiency and coverage of all coefficients in one series."""
    efficiency, coverage = axes
    efficiency.errorbar(
        x, cells["efficiency"], cells["efficiency_error"], fmt="o", color=colour, capsize=3
    )
    for level, mark in zip(LEVELS, "os", strict=True):
        key = f"coverage_{100 * level:.0f}"
        coverage.errorbar(x, cells[key], cells[f"{key}_error"], fmt=mark, color=colour, capsize=3)


def _pixels(ax: Axes, x: Floats, cells: Mapping[str, Floats], colour: str) -> None:
    """Predicted and found rms error of the displacement in one series."""
    order = np.argsort(x)
    ax.plot(x[order], cells["displacement_predicted"][order], color=colour, linewidth=1.0)
    found, error = cells["displacement_rms"], cells["displacement_rms_error"]
    ax.errorbar(x, found, error, fmt="s", mfc="white", color=colour, markersize=4.5)


def _name_shares(axes: Sequence[Axes], label: str, low: float) -> None:
    efficiency, coverage = axes
    efficiency.axhline(1.0, color="0.3", linewidth=0.8)
    efficiency.set(
        xlabel=label,
        ylabel="bound / variance of the estimates",
        title="efficiency, all coefficients",
    )
    coverage.set(
        xlabel=label,
        ylabel="share of intervals that hold the truth",
        title="coverage, all coefficients",
    )
    _level_axis(coverage, low)


def _level_axis(ax: Axes, low: float) -> None:
    """The axis of coverages, with a line at each nominal level."""
    for level in LEVELS:
        ax.axhline(level, color="0.3", linewidth=0.8)
    ax.set_ylim(low, 1.02)
    ax.set_yticks([*LEVELS, 1.0], [f"{level:.0%}" for level in (*LEVELS, 1.0)])


def _noise_handles(series: Sequence[str]) -> list[Line2D]:
    """The legend's entries: what the marks are, and the colour of each series."""
    points: dict[str, Any] = {"linestyle": "", "markersize": 4.5}
    return [
        Line2D([], [], color="0.3", linewidth=1.0, label="Cramér–Rao bound, prediction"),
        Line2D([], [], color="0.3", marker="o", label="posterior sd", **points),
        Line2D(
            [], [], color="0.3", marker="s", mfc="white", label="scatter of the estimates", **points
        ),
        *(
            Line2D(
                [],
                [],
                linewidth=3.0,
                color=ENSEMBLE_COLOURS[s % len(ENSEMBLE_COLOURS)],
                label=label,
            )
            for s, label in enumerate(series)
        ),
    ]


def calibration_plot(calibration: SBCResult, parameters: Sequence[Parameter]) -> Figure:
    """Every quantity's ranks less the uniform distribution with its 95 % band, coverage, and pulls.

    Parameters
    ----------
    calibration : SBCResult
    parameters : sequence of Parameter
        Those of the posterior, for their symbols.

    Returns
    -------
    Figure
    """
    n, found = calibration.n, calibration.quantities
    symbols = {parameter.name: math_symbol(parameter) for parameter in parameters}
    labels = {name: symbols.get(name) or _quantity(name) for name in calibration.pit}
    if not labels:
        fig = Figure(figsize=(8, 2), dpi=100)
        fig.text(0.5, 0.5, "no frame has a posterior", ha="center", va="center")
        return fig
    columns = 4
    rows = -(-len(labels) // columns)
    heights = (0.4 + 2.2 * rows, 3.9)
    fig = Figure(figsize=(14, sum(heights)), dpi=100, layout="constrained")
    # an array, whatever the stubs of the version say
    parts: Any = fig.subfigures(2, 1, height_ratios=heights)
    upper, lower = parts
    panels = upper.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    for ax in panels[len(labels) :]:
        ax.set_visible(False)
    for k, (name, label) in enumerate(labels.items()):
        _ranks(panels[k], calibration.pit[name])
        last = k + columns >= len(labels)
        panels[k].set_title(f"{label}   p = {found['uniformity'][k]:.2g}", fontsize=9.5)
        panels[k].tick_params(labelsize=8, labelbottom=last)
        panels[k].set_ylabel("" if k % columns else "ECDF - z", fontsize=8.5)
        panels[k].set_xlabel("z: rank of the truth" if last else "", fontsize=8.5)
    upper.suptitle(f"{n} frames; band: 95 % of uniform ranks stay inside all along", fontsize=10)
    coverage, pull = lower.subplots(1, 2)
    position = np.arange(len(labels), dtype=np.float64)
    for level, mark in zip(LEVELS, "os", strict=True):
        key = f"coverage_{100 * level:.0f}"
        coverage.errorbar(
            position,
            found[key],
            yerr=found[f"{key}_error"],
            fmt=mark,
            color=POSTERIOR_COLOUR,
            capsize=3,
            markersize=4.5,
        )
    coverage.set_title("share of intervals that hold the truth")
    _level_axis(coverage, min(0.5, float(found["coverage_68"].min()) - 0.05))
    _pulls(pull, position, found["pull"], 1.0 / math.sqrt(n))
    for ax in (coverage, pull):
        ax.set_xticks(
            position,
            list(labels.values()),
            rotation=60,
            ha="right",
            rotation_mode="anchor",
            fontsize=8,
        )
    return fig


def _ranks(ax: Axes, pit: Floats) -> None:
    """Distribution of one quantity's ranks less the uniform one; in another colour if it leaves."""
    z, (low, high) = points(len(pit)), band(len(pit))
    off = ecdf(pit)
    leaves = np.any((off < low - 1e-9) | (off > high + 1e-9))
    colour = TRUTH_COLOUR if leaves else POSTERIOR_COLOUR
    ax.fill_between(z, low - z, high - z, color="0.4", alpha=0.2, linewidth=0)
    ax.step(z, off - z, where="post", color=colour, linewidth=1.1)
    ax.axhline(0.0, color="0.3", linewidth=0.6)
    ax.set_xlim(0, 1)


def _pulls(ax: Axes, position: Floats, pulls: Floats, error: float) -> None:
    """Mean pulls with the band in which they scatter."""
    ax.axhspan(-3.0 * error, 3.0 * error, color="0.4", alpha=0.15, linewidth=0)
    ax.axhline(0.0, color="0.3", linewidth=0.8)
    ax.errorbar(
        position, pulls, yerr=error, fmt="o", color=POSTERIOR_COLOUR, capsize=3, markersize=4.5
    )
    limit = max(4.5 * error, 1.15 * float(np.abs(pulls).max()) + error)
    ax.set(
        title="mean of (posterior mean - truth) / sd; band: 3 standard errors", ylim=(-limit, limit)
    )


def _quantity(name: str) -> str:
    """What else a calibration ranks: log-likelihood, displacement at a point, a source's flux."""
    name = re.sub(r"^displacement_([xy])(\(.*\))$", r"displacement $\1$\2 px", name)
    return re.sub(r"^flux\((.*)\)$", r"flux of source \1", name).replace("_", " ")
