"""The summary of a noise study: a row for every cell and parameter, with Monte Carlo errors."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.study_helpers import LEVELS, coverage_error, covered

__all__ = ["summarise"]


def summarise(
    names: Sequence[str],
    n_terms: int,
    cells: Sequence[Mapping[str, float]],
    rows: Mapping[str, npt.NDArray[Any]],
    photons: Sequence[float],
) -> dict[str, npt.NDArray[Any]]:
    """Summarise what the frames of every cell say of every parameter, and of theta as a whole.

    Parameters
    ----------
    names : sequence of str
        The parameters, the coefficients first.
    n_terms : int
        The number of coefficients.
    cells : sequence of mapping of str to float
        The noise levels of every cell.
    rows : mapping of str to ndarray
        The table of all frames, `NoiseStudy.replicates`.
    photons : sequence of float
        Mean flux of the sources that the wanted error takes, of every cell.

    Returns
    -------
    dict of str to ndarray
        Columns, as `noise_study` describes them.
    """
    table: list[dict[str, Any]] = []
    cell = rows["task"] % len(cells)
    good = rows["message"] == ""
    d = n_terms
    for j, variables in enumerate(cells):
        mine = (cell == j) & good
        n = int(mine.sum())
        head: dict[str, Any] = {
            **variables,
            "frames": n,
            "failed": int(((cell == j) & ~good).sum()),
        }
        for key in ("chi2", "lambda"):
            head[key], head[f"{key}_error"] = _mean(
                rows[key][mine][np.isfinite(rows[key][mine])]
            )  # chi2 needs lambda > 0
        unknown = dict.fromkeys(
            ("truth", "width", "bias", "bias_error", "scatter", "bound"), math.nan
        )
        efficiency = d / _mean(rows["theta.distance"][mine])[0]
        every = np.stack([rows[f"{term}.pit"][mine] for term in names[:d]], axis=1)
        whole = {
            "efficiency": efficiency,
            "efficiency_error": efficiency * math.sqrt(2.0 / max(n * d, 1)),
        }
        table.append(
            {
                **head, "parameter": "theta", **unknown, **whole, **_coverage(every),
                **_displacement(rows, mine), "photons": photons[j],
            }
        )  # fmt: skip
        for name in names:
            truth, estimate, sd, bound, pit = (
                rows[f"{name}.{w}"][mine] for w in ("truth", "estimate", "sd", "bound", "pit")
            )
            bias, error = _mean(estimate - truth)
            scatter, least = error * math.sqrt(n), math.sqrt(_mean(bound**2)[0])
            efficiency = least**2 / scatter**2 if scatter else math.nan
            own = {
                "truth": _mean(truth)[0],
                "width": _mean(sd)[0],
                "bias": bias,
                "bias_error": error,
                "scatter": scatter,
            }
            own |= {
                "bound": least,
                "efficiency": efficiency,
                "efficiency_error": efficiency * math.sqrt(2.0 / max(n - 1, 1)),
            }
            table.append({**head, "parameter": name, **own, **_coverage(pit[:, None])})
    return {key: np.array([row.get(key, math.nan) for row in table]) for key in table[0]}


def _displacement(rows: Mapping[str, npt.NDArray[Any]], mine: Flags) -> dict[str, float]:
    """The rms error of the displacement over field and frames, its own error, and its prediction.

    The error of a root mean square is that of the mean square over twice the root.
    """
    square, error = _mean(rows["displacement.error"][mine] ** 2)
    predicted, _ = _mean(rows["displacement.predicted"][mine] ** 2)
    root = math.sqrt(square)
    return {
        "displacement_rms": root,
        "displacement_rms_error": error / (2.0 * root) if root else 0.0,
        "displacement_predicted": math.sqrt(predicted),
    }


def _mean(values: Floats) -> tuple[float, float]:
    """Mean and its error; NaN of fewer than two values."""
    n = values.size
    return (
        (float(values.mean()), float(values.std(ddof=1)) / math.sqrt(n))
        if n > 1
        else (math.nan, math.nan)
    )


def _coverage(pit: Floats) -> dict[str, float]:
    """Share of the intervals that hold the truth, and its error.

    The intervals of one frame, a row, are not independent.
    """
    out: dict[str, float] = {}
    for level in LEVELS:
        share, among = _mean(covered(pit, level).mean(axis=1))
        key = f"coverage_{100 * level:.0f}"
        out |= {
            key: share,
            f"{key}_error": among if pit.shape[1] > 1 else coverage_error(level, len(pit)),
        }
    return out
