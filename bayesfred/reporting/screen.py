"""Results as tables for a terminal. They are only formatted here; `bayesfred.cli` prints them."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from rich.markup import escape
from rich.table import Table

from bayesfred.analysis.comparison import Comparison
from bayesfred.analysis.cross_check import CrossCheck
from bayesfred.analysis.noise_study import VARIABLES, NoiseStudy
from bayesfred.analysis.photons import rounded
from bayesfred.analysis.sbc import PosteriorCalibration
from bayesfred.analysis.verify import Check
from bayesfred.errors import printable
from bayesfred.reporting.labels import scale_of, with_error

__all__ = [
    "check_table",
    "comparison_table",
    "cross_check_table",
    "parameter_table",
    "study_table",
]


def parameter_table(summary: Any) -> Table:
    """Lay out the table of parameters: values, how well they are sampled, and the prior's part.

    Parameters
    ----------
    summary : astropy.table.Table
        See `bayesfred.sampling.summary.summary`, with `Diagnostics.columns`.

    Returns
    -------
    rich.table.Table
        Every row's numbers are in one power of ten; the effective sample size is the smaller of
        those of the centre and of the tails.
    """
    with_truth = "truth" in summary.colnames
    heads = ["MAP", "posterior mean +- sd"]
    table = _table(
        "parameter", *(["truth", *heads, "z"] if with_truth else heads),
        "px at corner", "R-hat", "ESS", "prior",
    )  # fmt: skip
    for row in summary:
        scale = scale_of(row["mean"], row["sd"])
        power = f" e{scale.exponent:+03d}" if scale.exponent else ""
        cells = [scale.number(row["MAP"]) + power, with_error(row["mean"], row["sd"])]
        if with_truth:
            cells = [scale.number(row["truth"]) + power, *cells, f"{row['z']:+.2f}"]
        table.add_row(
            row["name"],
            *cells,
            with_error(row["corner"], row["corner_sd"]),
            f"{row['rhat']:.3f}",
            f"{min(row['ess_bulk'], row['ess_tail']):.0f}",
            f"{row['prior_sensitivity']:.3f}",
        )
    return table


def study_table(result: NoiseStudy | PosteriorCalibration) -> Table:
    """Lay out a study's findings: a row for each noise level, or for each quantity.

    Parameters
    ----------
    result : NoiseStudy or PosteriorCalibration

    Returns
    -------
    rich.table.Table
    """
    if isinstance(result, NoiseStudy):
        whole = result.cells["parameter"] == "theta"
        rows = {key: values[whole] for key, values in result.cells.items()}
        heads = [name for name in VARIABLES if len(set(rows[name])) > 1] or ["background"]
        heads += ["frames", "failed"]
        shown = ["displacement_rms", "displacement_predicted", "photons"]
        shown += ["efficiency", "coverage_68", "coverage_95"]
    else:
        rows, heads = result.quantities, ["quantity"]
        shown = ["coverage_68", "coverage_95", "pull", "uniformity"]
    names = {
        "coverage_68": "% in 68 %", "coverage_95": "% in 95 %",
        "displacement_rms": "rms error / px", "displacement_predicted": "predicted",
    }  # fmt: skip
    table = Table()
    for head in (*heads, *shown):
        table.add_column(names.get(head, head), justify="right", no_wrap=True)

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
        return f"{factor * value:.{digits}f} ± {factor * error:.{digits}f}"

    for k in range(len(rows[heads[0]])):
        table.add_row(*(cell(key, k) for key in (*heads, *shown)))
    return table


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


def comparison_table(compared: Comparison) -> Table:
    """Lay out a ranking of models.

    Parameters
    ----------
    compared : Comparison

    Returns
    -------
    rich.table.Table
    """
    table = Table("model", "parameters", "elpd", "p_loo", "behind the best", "Pareto k")
    best = compared.scores[0]
    for score in compared.scores:
        behind = f"{score.difference:.1f} +- {score.difference_se:.1f}"
        table.add_row(
            escape(printable(score.name)),
            str(score.n_parameters),
            f"{score.elpd:.1f} +- {score.elpd_se:.1f}",
            f"{score.p_loo:.1f}",
            "" if score is best else behind,
            f"{score.pareto_k:.2f}" if np.isfinite(score.pareto_k) else "",
        )
    return table


def cross_check_table(found: CrossCheck) -> Table:
    """Lay out how well two halves agree.

    Parameters
    ----------
    found : CrossCheck

    Returns
    -------
    rich.table.Table
    """
    table = _table("halves agree in", "chi2", "dof", "p", "errors times", "found from")
    rows = {
        "displacement": found.displacement,
        "coefficients": found.coefficients,
        "positions, half 1": found.positions[0],
        "positions, half 2": found.positions[1],
    }
    for name, a in rows.items():
        low, high = a.factor_interval
        scaling = f"{a.factor:.2f} ({low:.2f}-{high:.2f})"
        table.add_row(
            name, f"{a.chi2:.1f}", str(a.dof), f"{a.p:.2g}", scaling, f"{a.detectable:.2f}"
        )
    return table


def _table(first: str, *heads: str) -> Table:
    """A table whose first column is a text and whose others are numbers."""
    table = Table()
    table.add_column(first, no_wrap=True)
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    return table
