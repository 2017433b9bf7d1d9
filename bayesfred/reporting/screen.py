"""Results as tables for a terminal. They are only formatted here; `bayesfred.show` prints them.

A table has the columns that fit the terminal's width. What says least gives way first.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from rich.markup import escape
from rich.table import Table

from bayesfred.analysis.comparison import Comparison
from bayesfred.analysis.cross_check import CrossCheck
from bayesfred.analysis.noise_study import VARIABLES, NoiseStudy
from bayesfred.analysis.photons import rounded
from bayesfred.analysis.ranking import Score
from bayesfred.analysis.sbc import SBCResult
from bayesfred.analysis.verify import Check
from bayesfred.errors import printable
from bayesfred.reporting.labels import scale_of, with_error

__all__ = [
    "check_table",
    "comparison_table",
    "cross_check_table",
    "frame_table",
    "parameter_table",
    "study_table",
]


class _Column(NamedTuple):
    """A column of numbers, or of texts."""

    head: str
    cells: list[str]
    gives_way: int = 0  # the largest first; 0: never
    justify: Literal["left", "right"] = "right"


def parameter_table(summary: Any, width: int) -> Table:
    """Lay out the table of parameters: values, how well they are sampled, and the prior's part.

    Parameters
    ----------
    summary : astropy.table.Table
        See `bayesfred.sampling.summary.summary`, with `Diagnostics.columns`.
    width : int
        Characters in a line. Where they do not suffice, columns are left out: prior first, then
        MAP, R-hat, truth, ESS, z and the displacement at the corner.

    Returns
    -------
    rich.table.Table
        Every row's numbers are in one power of ten; the effective sample size is the smaller of
        those of the centre and of the tails. Columns without numbers are left out.
    """
    scales = [scale_of(row["mean"], row["sd"]) for row in summary]
    powers = [f" e{scale.exponent:+03d}" if scale.exponent else "" for scale in scales]

    def values(key: str) -> list[str]:
        if key not in summary.colnames:
            return []
        shown = zip(scales, summary[key], powers, strict=True)
        return [
            scale.number(value) + power if np.isfinite(value) else ""
            for scale, value, power in shown
        ]

    def numbers(key: str, form: str) -> list[str]:
        if key not in summary.colnames:
            return []
        return [format(value, form) if np.isfinite(value) else "" for value in summary[key]]

    means = [with_error(row["mean"], row["sd"]) for row in summary]
    corners = [with_error(row["corner"], row["corner_sd"]) for row in summary]
    least = np.minimum(summary["ess_bulk"], summary["ess_tail"])
    columns = [
        _Column("parameter", [str(name) for name in summary["name"]], justify="left"),
        _Column("truth", values("truth"), 4),
        _Column("MAP", values("MAP"), 6),
        _Column("posterior mean +- sd", means),
        _Column("robust sd", values("robust_sd")),
        _Column("z", numbers("z", "+.2f"), 2),
        _Column("px at corner", corners, 1),
        _Column("R-hat", numbers("rhat", ".3f"), 5),
        _Column("ESS", [f"{ess:.0f}" if np.isfinite(ess) else "" for ess in least], 3),
        _Column("prior", numbers("prior_sensitivity", ".3f"), 7),
    ]
    return _table([column for column in columns if any(column.cells)], width)


def frame_table(frames: Any, width: int) -> Table:
    """Lay out the table of frames: how each fits, and whether it agrees with the others.

    Parameters
    ----------
    frames : astropy.table.Table
        See `JointResult.frame_table`.
    width : int
        Characters in a line. Where they do not suffice, columns are left out: agreement p
        first, then pixels, sources and times.

    Returns
    -------
    rich.table.Table
    """

    def numbers(key: str, form: str) -> list[str]:
        if key not in frames.colnames:
            return []
        return [format(value, form) if np.isfinite(value) else "" for value in frames[key]]

    columns = [
        _Column("frame", [str(name) for name in frames["frame"]], justify="left"),
        _Column("time", numbers("time", "g"), 1),
        _Column("sources", numbers("sources", "d"), 2),
        _Column("pixels", numbers("pixels", "d"), 3),
        _Column("deviance z", numbers("deviance_z", "+.1f")),
        _Column("fits", ["yes" if fits else "no" for fits in frames["fits_data"]]),
        _Column("agreement p", numbers("agreement_p", ".2g"), 4),
        _Column("agrees", ["yes" if agrees else "no" for agrees in frames["agrees"]]),
    ]
    return _table([column for column in columns if any(column.cells)], width)


def study_table(result: NoiseStudy | SBCResult, width: int) -> Table:
    """Lay out a study's findings: a row for each noise level, or for each quantity.

    Parameters
    ----------
    result : NoiseStudy or SBCResult
    width : int
        Characters in a line. Where they do not suffice, columns are left out: lambda first, then
        chi2, the coverage of 68 %, pull and efficiency.

    Returns
    -------
    rich.table.Table
    """
    if isinstance(result, NoiseStudy):
        whole = result.cells["parameter"] == "theta"
        rows = {key: values[whole] for key, values in result.cells.items()}
        heads = [name for name in VARIABLES if len(set(rows[name])) > 1] or ["background"]
        heads += ["frames", "failed"]
        shown = {"displacement_rms": 0, "displacement_predicted": 2, "photons": 1}
        shown |= {"efficiency": 3, "coverage_68": 5, "coverage_95": 4}
    else:
        rows, heads = result.quantities, ["quantity"]
        shown = {"coverage_68": 3, "coverage_95": 0, "pull": 2, "uniformity": 0}
    names = {
        "coverage_68": "% in 68 %", "coverage_95": "% in 95 %",
        "displacement_rms": "rms error / px", "displacement_predicted": "predicted",
    }  # fmt: skip

    def cell(key: str, k: int) -> str:
        value = rows[key][k]
        if key in ("uniformity", "displacement_predicted"):
            return f"{value:.3g}"
        if key == "photons":
            return rounded(value)
        if f"{key}_error" not in rows:
            return f"{value:g}" if rows[key].dtype.kind == "f" else str(value)
        error = rows[f"{key}_error"][k]
        factor, digits = (100.0, 1) if "coverage" in key else (1.0, 2)
        if key == "displacement_rms" and error > 0.0:  # the error to one digit
            digits = max(0, -math.floor(math.log10(error)))
        return f"{factor * value:.{digits}f} +- {factor * error:.{digits}f}"

    return _table(
        [
            _Column(names.get(key, key), [cell(key, k) for k in range(len(rows[key]))], gives_way)
            for key, gives_way in (dict.fromkeys(heads, 0) | shown).items()
            if key in rows  # none where every frame failed
        ],
        width,
    )


def check_table(checks: Iterable[Check]) -> Table:
    """Lay out what was checked in a chain file.

    Parameters
    ----------
    checks : iterable of Check

    Returns
    -------
    rich.table.Table
    """
    table = Table("what", "finding", "holds")
    for check in checks:
        table.add_row(check.what, escape(check.finding), "yes" if check.holds else "no")
    return table


def comparison_table(compared: Comparison, width: int) -> Table:
    """Lay out a ranking of models.

    Parameters
    ----------
    compared : Comparison
    width : int
        Characters in a line. Where they do not suffice, columns are left out: elpd first, then
        Pareto k, the stacking weight and the number of parameters.

    Returns
    -------
    rich.table.Table
    """
    scores = compared.scores
    return _table(
        [
            _Column("model", [escape(printable(s.name)) for s in scores], justify="left"),
            _Column("parameters", [str(s.n_parameters) for s in scores], 1),
            _Column("elpd", [f"{s.elpd:.1f} +- {s.elpd_se:.1f}" for s in scores], 4),
            _Column(
                "behind the best",
                ["", *(f"{s.difference:.1f} +- {s.difference_se:.1f}" for s in scores[1:])],
            ),
            _Column("weight", [f"{s.weight:.2f}" for s in scores], 2),
            *_evidence(scores),
            _Column(
                "Pareto k",
                [f"{s.pareto_k:.2f}" if s.pareto_k > -np.inf else "" for s in scores],
                3,
            ),
        ],
        width,
    )


def _evidence(scores: Sequence[Score]) -> list[_Column]:
    """No column where PSFs were measured on the frame, which leaves the evidence unknown."""
    if any(math.isnan(s.log_evidence) for s in scores):
        return []
    cells = [f"{s.log_evidence:.1f} +- {s.evidence_error:.2f}" for s in scores]
    return [_Column("log evidence", cells)]


def cross_check_table(found: CrossCheck, width: int) -> Table:
    """Lay out how well two halves agree.

    Parameters
    ----------
    found : CrossCheck
    width : int
        Characters in a line.

    Returns
    -------
    rich.table.Table
    """
    rows = {
        "displacement": found.displacement,
        "coefficients": found.coefficients,
        "positions, half 1": found.positions[0],
        "positions, half 2": found.positions[1],
    }
    scaling = [
        f"{a.factor:.2f} ({a.factor_interval[0]:.2f}-{a.factor_interval[1]:.2f})"
        for a in rows.values()
    ]
    return _table(
        [
            _Column("halves agree in", list(rows), justify="left"),
            _Column("chi2", [f"{a.chi2:.1f}" for a in rows.values()], 2),
            _Column("dof", [str(a.dof) for a in rows.values()], 3),
            _Column("p", [f"{a.p:.2g}" for a in rows.values()]),
            _Column("errors times", scaling),
            _Column("found from", [f"{a.detectable:.2f}" for a in rows.values()], 1),
        ],
        width,
    )


def _table(columns: Sequence[_Column], width: int) -> Table:
    """A table of the columns that fit; the first one is folded where it alone is too wide."""
    kept = list(columns)

    def needed() -> int:
        return 1 + sum(3 + max(len(text) for text in (c.head, *c.cells)) for c in kept)

    while needed() > width and (least := max(kept, key=lambda c: c.gives_way)).gives_way:
        kept.remove(least)
    table = Table()
    for column in kept:
        first = column is kept[0]
        table.add_column(
            column.head,
            justify=column.justify,
            no_wrap=not first,
            overflow="fold" if first else "crop",
        )
    for row in zip(*(column.cells for column in kept), strict=True):
        table.add_row(*row)
    return table
