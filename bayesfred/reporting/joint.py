"""The page of a run of several frames: the verdict on all, what they share, how they agree.

Every frame has a page of its own, see `bayesfred.reporting.html`, to which this one leads.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import quote

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from bayesfred._typing import PathLike
from bayesfred.analysis.diagnostics import Diagnostics
from bayesfred.analysis.frame_estimates import FrameEstimates
from bayesfred.io import atomic
from bayesfred.io.marks import marked
from bayesfred.io.summary_table import Table
from bayesfred.model.parameters import Parameter
from bayesfred.reporting.figures import PageFigure
from bayesfred.reporting.html import (
    described_frames,
    embedded_figures,
    made_with,
    parameter_rows,
    provenance,
    render,
)
from bayesfred.reporting.labels import axis_label, html_symbols, power_of_ten
from bayesfred.reporting.pairs import corner_plot, described_pairs, pairs_caption
from bayesfred.reporting.posteriors import trace_plot
from bayesfred.reporting.style import POSTERIOR_COLOUR, TRUTH_COLOUR, png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.record import RunRecord

__all__ = ["agreement_plot", "joint_figures", "write_joint_report"]

# columns of the table of frames, their heads, and how they are printed
CELLS: dict[str, tuple[str, str]] = {
    "time": ("time", "g"), "sources": ("sources", "d"), "pixels": ("pixels", "d"),
    "deviance_z": ("deviance / sd", "+.1f"), "fits_data": ("fits", ""),
    "agreement_p": ("agreement p", ".2g"), "agrees": ("agrees", ""),
}  # fmt: skip
MOST_NAMED = 12  # frames, below an axis
COLUMNS = 3  # of panels
FAR = 3.0  # standard deviations from which on a frame is shown in another colour


def write_joint_report(
    path: PathLike,
    *,
    chain: Chain,
    shared: Table,
    diagnostics: Diagnostics,
    frames: Table,
    pages: Mapping[str, Path],
    figures: Sequence[PageFigure],
    result: str,
) -> Path:
    """Write the page of several frames as one HTML file, in one step: the old page stays till then.

    Parameters
    ----------
    path : path-like
        Where the page goes; an existing file is replaced.
    chain : Chain
        Of a `JointPosterior`.
    shared : astropy.table.Table
        The rows of the summary about what the frames share, with the column `corner`.
    diagnostics : Diagnostics
        What `diagnose` said of `chain`.
    frames : astropy.table.Table
        A row for each frame, see `JointResult.frame_table`.
    pages : mapping of str to Path
        Those of the frames, beside this one.
    figures : sequence of PageFigure
    result : str
        A sentence with what was found.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    InputError
        If the page cannot be written.
    """
    path = Path(path)
    posterior, record = chain.posterior(), chain.record or RunRecord(path.stem)
    heading = record.title or path.stem
    subtitle = described_frames(posterior)
    made = made_with(chain)
    cells = {key: cell for key, cell in CELLS.items() if key in frames.colnames}
    page = render(
        "joint.html",
        title=f"{heading}: {subtitle}; {made}",
        heading=heading,
        subtitle=subtitle,
        made=made,
        result=result,
        diagnostics=diagnostics,
        heads=[head for head, _ in cells.values()],
        frames=[
            {
                "name": row["frame"],
                "page": quote(pages[row["frame"]].name),
                "cells": [_cell(row[key], form) for key, (_, form) in cells.items()],
            }
            for row in frames
        ],
        rows=parameter_rows(chain, shared),
        prior_dominated=html_symbols(
            diagnostics.prior_dominated, posterior.parameters[: posterior.n_shared]
        ),
        has_truth=False,
        has_robust=False,
        figures=embedded_figures(figures),
        **provenance(chain, diagnostics),
    )
    atomic.replace(path, marked(page, chain.identity))
    return path


def _cell(value: float | np.bool_, form: str) -> str:
    if isinstance(value, np.bool_):
        return "yes" if value else "no"
    return format(value, form).replace("-", "−") if np.isfinite(value) else ""


def joint_figures(
    chain: Chain, estimates: FrameEstimates, *, picture: bytes, shown: Sequence[int]
) -> list[PageFigure]:
    """The figures of the page of several frames.

    Parameters
    ----------
    chain : Chain
        Of a `JointPosterior`.
    estimates : FrameEstimates
        Of its `shared` parameters.
    picture : bytes
        The PNG file of `agreement_plot`.
    shown : sequence of int
        Indices of the parameters shown in pairs.

    Returns
    -------
    list of PageFigure
    """
    posterior = chain.posterior()
    draws, parameters = chain.draws()[:, : posterior.n_shared], posterior.parameters
    figures = [
        PageFigure(
            "Frames and what they share",
            "Points: what each frame alone says, with its own pose and background. Line and band: "
            "all frames together, with the standard deviation. Orange: more than "
            f"{FAR:.0f} standard deviations away.",
            _described(chain, estimates),
            picture,
        ),
        PageFigure(
            "Posterior of what the frames share",
            pairs_caption(len(shown), posterior.n_shared),
            described_pairs(draws, chain.parameter_names[: posterior.n_shared], shown),
            png(
                corner_plot(
                    draws,
                    parameters[: posterior.n_shared],
                    shown=shown,
                    estimate=chain.estimate.params[: posterior.n_shared],
                )
            ),
        ),
    ]
    if chain.method == "mcmc":
        common = replace(chain, chain=chain.chain[..., : posterior.n_shared])
        figures.append(
            PageFigure(
                "Chain",
                "Median and middle 68 % of each ensemble's walkers; histograms of their ranks, "
                "flat at 1 when all ensembles sample one distribution.",
                f"Traces and rank histograms of {posterior.n_shared} parameters.",
                png(trace_plot(common, parameters[: posterior.n_shared]), shades=False),
            )
        )
    return figures


def agreement_plot(estimates: FrameEstimates, parameters: Sequence[Parameter]) -> Figure:
    """What each frame alone says of every shared parameter, beside what all say together.

    Parameters
    ----------
    estimates : FrameEstimates
        Of the first p of the parameters.
    parameters : sequence of Parameter, length p or more

    Returns
    -------
    Figure
    """
    k, d = estimates.values.shape
    columns = min(COLUMNS, d)
    rows = -(-d // columns)
    longest = max(map(len, estimates.names))
    named = k <= MOST_NAMED and estimates.times is None
    below = 0.08 * longest if named and longest > 6 else 0.3
    fig = Figure(figsize=(13, 0.3 + below + 2.1 * rows), dpi=100, layout="constrained")
    axes = fig.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[d:]:
        ax.set_visible(False)
    at = np.arange(k) if estimates.times is None else estimates.times
    order = np.argsort(at, kind="stable")
    margin = 0.04 * np.ptp(at) + 0.3 * (estimates.times is None)
    line = np.array([at.min() - margin, *at[order], at.max() + margin])  # from edge to edge
    through = np.array([order[0], *order, order[-1]])
    far = np.abs(estimates.pulls) > FAR
    for j, ax in enumerate(axes[:d]):
        values, sd, joint, spread = (
            array[:, j]
            for array in (estimates.values, estimates.sd, estimates.joint, estimates.joint_sd)
        )
        exponent = power_of_ten(np.array([*joint, *values[np.isfinite(values)]]))
        scale = 10.0**exponent
        ax.fill_between(
            line, (joint - spread)[through] / scale, (joint + spread)[through] / scale, color="0.5",
            alpha=0.3, linewidth=0,
        )  # fmt: skip
        ax.plot(line, joint[through] / scale, color="0.3", linewidth=0.9)
        for which, colour in ((~far[:, j], POSTERIOR_COLOUR), (far[:, j], TRUTH_COLOUR)):
            ax.errorbar(
                at[which], values[which] / scale, sd[which] / scale, fmt="o", color=colour,
                markersize=4, capsize=2 if named else 0, linewidth=1.0,
            )  # fmt: skip
        ax.set_ylabel(axis_label(parameters[j], exponent), fontsize=9.5)
        ax.yaxis.set_major_locator(MaxNLocator(5))
        ax.ticklabel_format(axis="y", useOffset=False)
        ax.tick_params(labelsize=8)
        ax.set_xlim(line[0], line[-1])
        lowest = j + columns >= d
        if named:
            names = estimates.names if lowest else [""] * k
            ax.set_xticks(at, names, rotation=90 if longest > 6 else 0)
        elif lowest:
            ax.set_xlabel(
                "frame, in the run file's order" if estimates.times is None else "time", fontsize=9
            )
    return fig


def _described(chain: Chain, estimates: FrameEstimates) -> str:
    pulls = estimates.pulls
    i, j = np.unravel_index(np.argmax(np.abs(pulls)), pulls.shape)
    return (
        f"{len(estimates.names)} frames' values of {pulls.shape[1]} parameters. The farthest from "
        f"all together is {chain.parameter_names[j]} of {estimates.names[i]}, by "
        f"{abs(pulls[i, j]):.1f} standard deviations."
    )
