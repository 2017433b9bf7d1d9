"""What commands found, printed: tables first, then files, and the verdict in the last line.

Every function prints the record of a function in `commands.py` and returns whether all is well.
"""

import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bayesfred.analysis import comparison
from bayesfred.errors import printable
from bayesfred.pipeline import Result, Simulated, Study, Verification
from bayesfred.reporting import screen


def show_run(result: Result) -> bool:
    """Print what a run found; whether it is trustworthy is the last line, and what is returned."""
    chain, diagnostics = result.chain, result.diagnostics
    _print(screen.parameter_table(result.summary))
    if chain.n_invalid:
        print(
            f"{chain.n_invalid} log-probabilities were NaN or infinite and taken as -inf: "
            "narrower priors avoid that"
        )
    if diagnostics.prior_dominated:
        print(
            f"prior-dominated: {', '.join(diagnostics.prior_dominated)}: the frame does not "
            "decide alone, see the report"
        )
    _print_files(
        chain=result.path, report=result.page, picture=result.picture, sources=result.sources
    )
    print(diagnostics.message)
    return diagnostics.trustworthy


def show_simulated(simulated: Simulated) -> bool:
    """Print which files were written."""
    posterior = simulated.posterior
    ny, nx = posterior.counts.shape
    if simulated.catalogue:
        print(f"{printable(str(simulated.catalogue))}: {len(posterior.model.sources)} sources")
    shown = f"{ny} x {nx} pixels, {posterior.counts.sum():.0f} counts"
    print(f"{printable(str(simulated.frame))}: {shown}")
    return True


def show_study(done: Study) -> bool:
    """Print a study's findings."""
    _print(screen.study_table(done.result))
    _print_files(table=done.table, summary=done.summary, picture=done.picture)
    print(done.result.message)
    return done.holds


def show_verification(found: Verification) -> bool:
    """Print what holds."""
    _print(screen.check_table(found.checks))
    if found.other_versions:
        print(f"made with {', '.join(found.other_versions)}")
    return found.holds


def show_comparison(compared: comparison.Comparison) -> bool:
    """Print the ranking of models."""
    _print(screen.comparison_table(compared))
    print(
        f"chosen: {printable(compared.chosen)}, the one with the fewest parameters that predicts "
        "as well as the best"
    )
    if not compared.reliable:
        print("not reliable: few draws decide some pixels' weights (Pareto k): find bad pixels")
    return compared.reliable


def _print(table: Table) -> None:
    # a file or a pipe has no width of its own
    Console(width=None if sys.stdout.isatty() else 120).print(table)


def _print_files(**named: Path) -> None:
    for label, path in named.items():
        print(f"{label:8}{printable(str(path))}")
