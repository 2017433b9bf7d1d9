"""The steps that commands share (read a frame, fit it, report), and the records they return.

Nothing is printed. What should be known while a step works goes to `say`, one line at a time.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bayesfred import build, settings
from bayesfred._typing import Floats
from bayesfred.analysis.diagnostics import Diagnostics, diagnose
from bayesfred.analysis.noise_study import NoiseStudy
from bayesfred.analysis.sbc import PosteriorCalibration
from bayesfred.analysis.verify import Check
from bayesfred.errors import InputError, printable
from bayesfred.io import atomic, frames, outputs, paths, tables
from bayesfred.io.summary_table import Table
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import reject_outliers
from bayesfred.reporting.figures import page_figures
from bayesfred.reporting.frames import FittedFrame
from bayesfred.reporting.html import write_report
from bayesfred.reporting.posteriors import corner_parameters, overview
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.sampler import sample, searching
from bayesfred.sampling.summary import summary
from bayesfred.sections import toml

__all__ = [
    "Job",
    "Result",
    "Say",
    "Simulated",
    "Study",
    "Verification",
    "fit_frame",
    "naming",
    "read_frame",
    "write_results",
]

Say = Callable[[str], None]

SOURCES_META = {
    "x, y": "catalogue position, fine pixel from the middle of the frame",
    "u, v, du, dv, phase": "recorded pixel, u and v from the middle of the frame",
    "flux, peak": "counts",
    "columns": "see bayesfred.analysis.sources.source_table",
}


@dataclass(frozen=True, eq=False)
class Result:
    """What a finished run left.

    Attributes
    ----------
    chain : Chain
    diagnostics : Diagnostics
    summary : astropy.table.Table
        The parameters, see `bayesfred.sampling.summary.summary`, with `Diagnostics.columns`.
    path, page, picture, sources : Path
        The files: the chain, its report, its picture and its table of sources.
    """

    chain: Chain
    diagnostics: Diagnostics
    summary: Table
    path: Path
    page: Path
    picture: Path
    sources: Path


@dataclass(frozen=True, eq=False)
class Simulated:
    """A simulated frame.

    Attributes
    ----------
    posterior : Posterior
        Its `counts` are the frame.
    truth : ndarray, shape (d,), parameter units
    frame : Path
        The frame's file.
    catalogue : Path or None
        The file of the sources, if they were made with the frame.
    """

    posterior: Posterior
    truth: Floats
    frame: Path
    catalogue: Path | None


@dataclass(frozen=True, eq=False)
class Study:
    """What a study found and where it is.

    Attributes
    ----------
    result : NoiseStudy or PosteriorCalibration
    table, summary, picture : Path
        The files: a row for each frame, the findings, their figure.
    """

    result: NoiseStudy | PosteriorCalibration
    table: Path
    summary: Path
    picture: Path

    @property
    def holds(self) -> bool:
        """Whether every frame could be fitted or, in a calibration, the error bars hold."""
        if isinstance(self.result, PosteriorCalibration):
            return self.result.calibrated
        return not self.result.cells["failed"].any()


@dataclass(frozen=True)
class Verification:
    """What could be computed again of a chain file.

    Attributes
    ----------
    checks : tuple of Check
    other_versions : tuple of str
        Packages that were of another version when the chain was made.
    """

    checks: tuple[Check, ...]
    other_versions: tuple[str, ...]

    @property
    def holds(self) -> bool:
        """Whether everything holds."""
        return all(check.holds for check in self.checks)


@dataclass(frozen=True, eq=False)
class Job:
    """A run to be made.

    Attributes
    ----------
    run : RunSettings
    run_file : Path
        Where the settings are from; its stem is the title.
    output : Path
        The chain file.
    notes : sequence of str
        Paragraphs for the page.
    truth : ndarray, shape (d,), parameter units, optional
        Values that a simulation used.
    """

    run: settings.RunSettings
    run_file: Path
    output: Path
    notes: Sequence[str]
    truth: Floats | None = None


def read_frame(
    run: settings.RunSettings, run_file: Path, say: Say | None
) -> tuple[Posterior, MapEstimate | None, list[str]]:
    """Read the frame of a run file, and reject outliers if it asks for that.

    Parameters
    ----------
    run : RunSettings
    run_file : Path
    say : callable, optional
        Told every note at once.

    Returns
    -------
    posterior : Posterior
    estimate : MapEstimate or None
        Its maximum, if outliers were rejected.
    notes : list of str
        What was read, and what was removed.

    Raises
    ------
    InputError
        If frame, catalogue or settings are unusable.
    """
    notes: list[str] = []

    def note(line: str) -> None:
        notes.append(line)
        if say:
            say(line)

    f = run.frame
    path = paths.resolve(f.path, run_file, must_exist=True)
    frame = frames.read_frame(
        path, gain=f.gain, pedestal=f.pedestal, saturation=f.saturation, name=f.name
    )
    note(frame.description)
    shape = (frame.counts.shape[0], frame.counts.shape[1])
    psf = build.reference_psf(run, run_file)
    sources, census = build.catalogue(run, run_file, shape, psf)
    note(census)
    with naming(run_file):
        model = build.forward_model(run, shape, sources, psf)
        posterior = build.posterior_given(run, model, frame.counts, frame.valid)
        if not f.reject_outliers:
            return posterior, None, notes
        with searching() if say else nullcontext():
            kept, estimate = reject_outliers(posterior)
    unmatched = len(sources) - len(kept.model.sources)
    masked = int(np.sum(posterior.mask & ~kept.mask))
    note(
        f"outliers: {unmatched} unmatched of {len(sources)} sources removed, {masked} of "
        f"{posterior.mask.sum()} pixels masked"
    )
    return kept, estimate, notes


def fit_frame(
    job: Job,
    posterior: Posterior,
    estimate: MapEstimate | None = None,
    *,
    resume: bool = False,
    overwrite: bool,
    say: Say | None,
) -> Result:
    """Find the maximum, sample, and write the results.

    Parameters
    ----------
    job : Job
    posterior : Posterior
    estimate : MapEstimate, optional
        Found if not given.
    resume, overwrite : bool
        Resume the run in the output file; replace it.
    say : callable, optional
        Told what the search found; without it no progress is shown.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the output file exists or cannot be written, or the posterior cannot be sampled.
    """
    output, s = job.output, job.run.sampling
    if not output.parent.is_dir():
        raise InputError(
            f"{output}: no folder {output.parent}, expected one to write the chain to: create it"
        )
    others = outputs.beside(output)
    hidden = (output.with_name(f".{output.name}.{kind}") for kind in ("lock", "tmp", "writer"))
    for path in (output, *others, *hidden):
        if os.path.islink(path) or os.path.isdir(path):
            raise InputError(
                f"{path}: got a link or a folder, expected a file or nothing there: remove it, or "
                "write elsewhere"
            )
    resume = paths.may_write(output, overwrite=overwrite, resume=resume, beside=others)
    try:
        with naming(job.run_file):
            record = _record(job, open_chain(output) if resume else None)
            chain = sample(
                posterior, estimate, path=output, seed=s.seed, ensembles=s.ensembles,
                walkers=s.walkers, target_ess=s.target_ess, steps=s.steps, resume=resume,
                overwrite=overwrite, progress=say is not None, record=record,
            )  # fmt: skip
    except OSError as error:
        raise InputError(
            f"{output}: cannot be written ({error.strerror or error}), expected room and a folder "
            "that can be written"
        ) from error
    if say:
        say(f"maximum: {chain.estimate.message}")
    return write_results(chain, output, output, target_ess=s.target_ess)


def _record(job: Job, before: Chain | None) -> RunRecord:
    """What the chain keeps of a run; a resumed one has the seed and ensembles of its beginning."""
    run = job.run
    if before is not None:
        ensembles, _, walkers, _ = before.chain.shape
        used = {"seed": before.seed, "ensembles": ensembles, "walkers": walkers}
        run = run.model_copy(update={"sampling": run.sampling.model_copy(update=used)})
    return RunRecord(
        printable(job.run_file.stem),
        printable(Path(run.frame.path).name) if job.truth is None else "simulated frame",
        toml(run),
        tuple(job.notes),
        job.truth,
    )


def write_results(
    chain: Chain, path: Path, page: Path, *, target_ess: float, corner: Sequence[str] = ()
) -> Result:
    """Judge a chain, and write its page, picture and table of sources.

    Parameters
    ----------
    chain : Chain
    path : Path
        The chain's file.
    page : Path
        A file with the page's name but for the suffix.
    target_ess : float
        Effective draws to ask of every parameter.
    corner : sequence of str, optional
        Parameters to show in pairs; by default chosen.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If a file cannot be written, or `corner` names what is no parameter.
    """
    posterior = chain.posterior()
    truth = chain.record.truth if chain.record else None
    shown = corner_parameters(chain.draws(), chain.parameter_names, corner)
    diagnostics = diagnose(chain, target_ess=target_ess)
    table = summary(chain, truth=truth, columns=diagnostics.columns)
    fitted = FittedFrame.at(posterior, chain.estimate.params)
    page, picture, sources = outputs.beside(page)
    write_report(
        page,
        chain=chain,
        summary=table,
        diagnostics=diagnostics,
        figures=page_figures(fitted, chain, diagnostics, shown=shown, truth=truth),
    )
    atomic.replace(picture, png(overview(fitted, chain.draws(), posterior.parameters, truth=truth)))
    found = diagnostics.sources
    columns = {name: found[name].data for name in found.colnames}
    tables.write_table(sources, tables.TableRecord(columns, SOURCES_META), overwrite=True)
    return Result(chain, diagnostics, table, path, page, picture, sources)


@contextmanager
def naming(run_file: Path) -> Iterator[None]:
    """Begin the line of an error with the run file that describes what was refused.

    Parameters
    ----------
    run_file : Path

    Raises
    ------
    InputError
        In place of the one raised within.
    """
    try:
        yield
    except InputError as error:
        raise InputError(f"{run_file}: {error}") from None
