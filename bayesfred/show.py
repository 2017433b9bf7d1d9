"""What commands found, printed: tables first, then files, and the verdict in the last line.

Every function prints the record of a function in `commands` and returns whether all is well.
"""

import json
import math
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bayesfred.analysis.cross_check import CrossCheck
from bayesfred.analysis.verify import Verification
from bayesfred.commands.proposal import Proposed
from bayesfred.commands.records import (
    Calibrated,
    Compared,
    Corrected,
    JointResult,
    Planned,
    Result,
    Simulated,
    Study,
)
from bayesfred.errors import printable
from bayesfred.io.summary_table import Table
from bayesfred.reporting import screen

MOST_NAMED = 20  # parameters in a line


def show_run(result: Result | JointResult, *, as_json: bool = False) -> bool:
    """Print what a run found; whether it is trustworthy is the last line, and what is returned.

    With `as_json` one JSON object is printed instead, see `run_record`.
    """
    chain, diagnostics = result.chain, result.diagnostics
    if as_json:
        print(json.dumps(run_record(result), allow_nan=False))
        return diagnostics.trustworthy
    console = _console()
    if isinstance(result, JointResult):
        console.print(screen.parameter_table(result.shared, console.width))
        console.print(screen.frame_table(result.frame_table, console.width))
    else:
        console.print(screen.parameter_table(result.summary, console.width))
    if chain.n_invalid:
        print(
            f"{chain.n_invalid} log-probabilities were NaN or infinite and taken as -inf: "
            "narrower priors avoid that"
        )
    if names := diagnostics.prior_dominated:
        more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
        print(
            f"prior-dominated: {', '.join(names[:MOST_NAMED])}{more}: the counts do not decide "
            "alone, see the report"
        )
    _print_files(
        chain=result.path, report=result.page, picture=result.picture, sources=result.sources
    )
    if isinstance(result, JointResult):
        print(result.gain)
    else:
        print(result.field.message)
        if result.photons:
            print(result.photons.message)
    print(diagnostics.message)
    return diagnostics.trustworthy


def run_record(result: Result | JointResult) -> dict[str, Any]:
    """What a run found, as JSON can hold it: numbers that are not finite are None.

    Parameters
    ----------
    result : Result or JointResult

    Returns
    -------
    dict
        `sampled_well` (None where nothing was sampled), `fits_data`, `trustworthy` and `message`
        of the verdict; `modes`, the draws' shares in the posterior's modes if there are several;
        `causes`, a dict for each; `displacement`, the sentence; `parameters`, a
        dict for each row of the summary, by its columns; `files`, the paths of `chain`, `report`,
        `picture` and `sources`. Of several frames without `displacement`, and with `frames`, by
        their names: such a dict of each, with its row of the table of frames.
    """
    diagnostics = result.diagnostics
    files = {
        "chain": result.path, "report": result.page, "picture": result.picture,
        "sources": result.sources,
    }  # fmt: skip
    record: dict[str, Any] = {
        **diagnostics.verdict,
        "causes": [asdict(cause) for cause in diagnostics.causes],
        "parameters": _rows(result.summary),
        "files": {key: str(path) for key, path in files.items()},
    }
    if isinstance(result, Result):
        return record | {"displacement": result.field.message}
    rows = zip(result.frames.values(), _rows(result.frame_table), strict=True)
    return record | {"frames": {row.pop("frame"): run_record(own) | row for own, row in rows}}


def _rows(table: Table) -> list[dict[str, Any]]:
    return [{key: _plain(row[key]) for key in table.colnames} for row in table]


def _plain(value: Any) -> str | float | bool | None:
    """A table's text, flag or number."""
    if isinstance(value, str | np.bool_):
        return value.item() if isinstance(value, np.bool_) else str(value)
    return float(value) if math.isfinite(value) else None


def show_simulated(simulated: Simulated) -> bool:
    """Print which files were written."""
    posterior = simulated.posterior
    ny, nx = posterior.counts.shape
    if simulated.catalogue:
        print(f"{printable(str(simulated.catalogue))}: {len(posterior.model.sources)} sources")
    shown = f"{ny} x {nx} pixels, {posterior.counts.sum():.0f} counts"
    print(f"{printable(str(simulated.frame))}: {shown}")
    return True


def show_proposal(proposed: Proposed) -> bool:
    """Print what a frame's noise says, and where the run file is."""
    print(proposed.message)
    print(f"{printable(str(proposed.path))}: look at it, give it a catalogue, then bayesfred fit")
    return True


def show_calibration(done: Calibrated) -> bool:
    """Print where a calibration is, by how much exports differ from it, and whether to trust it."""
    _print_files(**done.files)
    for line in done.lines:
        print(line)
    print(done.calibration.message)
    return done.calibration.trustworthy


def show_corrected(done: Corrected) -> bool:
    """Print what was read and what was written."""
    print(done.description)
    _print_files(frame=done.path)
    print(done.frame.message)
    return True


def show_design(planned: Planned) -> bool:
    """Print what a planned frame would tell."""
    _print_files(table=planned.table, picture=planned.picture)
    for line in planned.plan.lines:
        print(line)
    return True


def show_study(done: Study) -> bool:
    """Print a study's findings."""
    console = _console()
    console.print(screen.study_table(done.result, console.width))
    _print_files(table=done.table, summary=done.summary, picture=done.picture)
    print(done.result.message)
    return done.holds


def show_verification(found: Verification) -> bool:
    """Print what holds."""
    _console().print(screen.check_table(found.checks))
    if found.other_versions:
        print(f"made with {', '.join(found.other_versions)}")
    return found.holds


def show_comparison(compared: Compared) -> bool:
    """Print the ranking of models, or why there is none."""
    ranking = compared.ranking
    if ranking is not None:
        console = _console()
        console.print(screen.comparison_table(ranking, console.width))
    if compared.page:
        _print_files(page=compared.page)
    if ranking is None:
        print(f"not ranked: {compared.reason}")
        return False
    for sentence in ranking.sentences:
        print(printable(sentence))
    if not ranking.reliable:
        print("not reliable: few draws decide the evidence without some sources (Pareto k)")
    return ranking.reliable


def show_cross_check(found: CrossCheck, *, as_json: bool = False) -> bool:
    """Print how well the halves agree, as a table and a sentence or as one JSON object."""
    if as_json:
        print(json.dumps(found.record()))
        return found.holds
    console = _console()
    console.print(screen.cross_check_table(found, console.width))
    print(
        f"displacements of the halves differ by {found.displacement_rms:.2g} pixel rms, expected "
        f"{found.displacement_expected:.2g}"
    )
    print(found.message)
    return found.holds


def _console() -> Console:
    """Standard output. A file or a pipe has no width of its own: COLUMNS says it, or it is 80."""
    wide = sys.stdout.isatty() or os.environ.get("COLUMNS", "").isdigit()
    plain = bool(os.environ.get("NO_COLOR"))  # rich would still print bold
    return Console(
        width=None if wide else 80, force_jupyter=False, color_system=None if plain else "auto"
    )


def _print_files(**named: Path) -> None:
    width = max(8, *(len(label) + 1 for label in named))
    for label, path in named.items():
        print(f"{label:{width}}{printable(str(path))}")
