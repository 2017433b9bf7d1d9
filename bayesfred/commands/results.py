"""A run and what it writes: the chain file, the page, the picture and the table of sources.

`pipeline` makes the posterior of a frame, `joint_pipeline` that of many; here it is sampled, judged
and written.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from bayesfred import settings
from bayesfred._typing import Floats
from bayesfred.analysis.diagnostics import Diagnostics, diagnose
from bayesfred.analysis.field import displacement_field
from bayesfred.build import naming
from bayesfred.commands.records import Result
from bayesfred.errors import InputError, printable
from bayesfred.imaging.psf import MeasuredPSF
from bayesfred.io import atomic, marks, outputs, paths, tables
from bayesfred.model.protocol import TargetDensity
from bayesfred.model.threads import one_blas_thread
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.reporting.figures import page_figures
from bayesfred.reporting.frames import FittedFrame
from bayesfred.reporting.html import write_report
from bayesfred.reporting.pairs import corner_parameters
from bayesfred.reporting.posteriors import overview
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.laplace import laplace
from bayesfred.sampling.progress import working
from bayesfred.sampling.record import LONGEST, RunRecord
from bayesfred.sampling.sampler import sample
from bayesfred.settings.joint import JointRun
from bayesfred.settings.sections import toml

__all__ = [
    "How",
    "Job",
    "Say",
    "make_chain",
    "may_write_run",
    "write_page",
    "write_results",
    "write_sources",
]

Say = Callable[[str], None]

SOURCES_META = {
    "x, y": "catalogue position, fine pixel from the middle of the frame",
    "u, v, du, dv, phase": "recorded pixel, u and v from the middle of the frame",
    "flux, peak": "counts",
    "columns": "see bayesfred.analysis.sources.source_table",
}


@dataclass(frozen=True, eq=False)
class Job:
    """A run to be made.

    Attributes
    ----------
    run : RunSettings or JointRun
    run_file : Path
        Where the settings are from; its stem is the title.
    output : Path
        The chain file.
    notes : sequence of str
        Paragraphs for the page.
    truth : ndarray, shape (d,), parameter units, optional
        Values that a simulation used.
    inputs : sequence of Path, optional
        Files that are read, which the run does not replace.
    """

    run: settings.RunSettings | JointRun
    run_file: Path
    output: Path
    notes: Sequence[str]
    truth: Floats | None = None
    inputs: Sequence[Path] = ()


@dataclass(frozen=True)
class How:
    """What is asked of a run beside its settings.

    Attributes
    ----------
    map_only : bool
        Do not sample: draw from the Laplace approximation.
    resume, overwrite : bool
        Resume the run in the output file; replace it.
    """

    map_only: bool = False
    resume: bool = False
    overwrite: bool = False


def may_write_run(
    output: Path, how: How, beside: Sequence[Path], inputs: Sequence[Path] = ()
) -> bool:
    """Refuse to write a run where something is that nobody asked to replace, or that is read.

    Parameters
    ----------
    output : Path
        The chain file.
    how : How
    beside : sequence of Path
        What is written with it.
    inputs : sequence of Path, optional
        Files that are read.

    Returns
    -------
    bool
        Whether there is a run to resume.

    Raises
    ------
    InputError
        If a file exists, its folder does not, or a link or a folder has its name; if a file would
        be replaced that is read, or that the run to resume did not make.
    """
    if not output.parent.is_dir():
        raise InputError(
            f"{output}: no folder {output.parent}, expected one to write the chain to: create it"
        )
    paths.require_plain(output, *beside, *paths.hidden(output))
    if how.map_only and how.resume:
        raise InputError(
            f"{output}: got both --map-only and --resume, expected one: there are no steps to "
            "resume where nothing is sampled"
        )
    resume = None if how.map_only else how.resume
    resumed = paths.may_write(
        output, overwrite=how.overwrite, resume=resume, beside=beside, inputs=inputs
    )
    if resumed:
        marks.may_replace(open_chain(output).identity, *beside)
    return resumed


def make_chain(
    job: Job,
    posterior: TargetDensity,
    estimate: MapEstimate | None,
    how: How,
    *,
    beside: Sequence[Path],
    say: Say | None,
) -> Chain:
    """Sample a posterior, or draw from its Laplace approximation, into the job's chain file.

    Parameters
    ----------
    job : Job
    posterior : TargetDensity
    estimate : MapEstimate or None
        Its maximum; found if None.
    how : How
    beside : sequence of Path
        What is written with the chain.
    say : callable or None

    Returns
    -------
    Chain

    Raises
    ------
    InputError
        If a file exists or cannot be written, or the posterior cannot be sampled.
    """
    output, s = job.output, job.run.sampling
    resume = may_write_run(output, how, beside, job.inputs)
    try:
        with naming(job.run_file):
            record = _record(job)
            if how.map_only:
                chain = laplace(
                    posterior, estimate, path=output, seed=s.seed, overwrite=how.overwrite,
                    progress=say is not None, record=record,
                )  # fmt: skip
            else:
                chain = sample(
                    posterior, estimate, path=output, seed=s.seed, ensembles=s.ensembles,
                    walkers=s.walkers, target_ess=s.target_ess, steps=s.steps, resume=resume,
                    overwrite=how.overwrite, progress=say is not None, record=record,
                )  # fmt: skip
    except OSError as error:
        raise InputError(
            f"{output}: cannot be written ({error.strerror or error}), expected room and a folder "
            "that can be written"
        ) from error
    if say:
        say(f"maximum: {chain.estimate.message}")
        if chain.earlier:
            say(f"resumed with other versions: {chain.version_history}")
    return chain


def _record(job: Job) -> RunRecord:
    """What the chain keeps of a run."""
    run = job.run
    title, text = printable(job.run_file.stem), toml(run)
    if isinstance(run, JointRun):
        kept = text if len(text.encode()) <= LONGEST else None  # hundreds of frames are too long
        return RunRecord(title, f"{len(run.frames)} frames", kept, tuple(job.notes))
    frame = printable(Path(run.frame.path).name) if job.truth is None else "simulated frame"
    return RunRecord(title, frame, text, tuple(job.notes), job.truth)


@one_blas_thread()  # matrices too small to be shared
def write_results(
    chain: Chain,
    path: Path,
    page: Path,
    *,
    target_ess: float,
    corner: Sequence[str] = (),
    overwrite: bool,
    say: Say | None = None,
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
    overwrite : bool
        Replace files that this run did not make, too.
    say : callable, optional
        Without it no progress is shown.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If a file cannot be written or is another's, or `corner` names what is no parameter.
    """
    corner_parameters(chain.draws(), chain.parameter_names, corner)  # refuses before judging
    with working("judging the fit", show=say is not None):
        diagnostics = diagnose(chain, target_ess=target_ess)
    with working("drawing the report", show=say is not None):
        result = write_page(
            chain, path, page, diagnostics=diagnostics, corner=corner, overwrite=overwrite
        )
    write_sources(result.sources, diagnostics, chain.identity)
    return result


@one_blas_thread()  # matrices too small to be shared
def write_page(
    chain: Chain,
    path: Path,
    page: Path,
    *,
    diagnostics: Diagnostics,
    corner: Sequence[str] = (),
    home: Path | None = None,
    overwrite: bool,
) -> Result:
    """Write the page and the picture of a chain, and its PSF where that was measured.

    Parameters
    ----------
    chain : Chain
        Of a frame.
    path : Path
        The chain's file.
    page : Path
        A file with the page's name but for the suffix.
    diagnostics : Diagnostics
        What `diagnose` said of the chain.
    corner : sequence of str, optional
        Parameters to show in pairs; by default chosen.
    home : Path, optional
        The page of all frames.
    overwrite : bool
        Replace files that this run did not make, too.

    Returns
    -------
    Result
        Its table of sources is not written.

    Raises
    ------
    InputError
        If a file cannot be written or is another's, or `corner` names what is no parameter.
    """
    posterior = chain.posterior()
    truth = chain.record.truth if chain.record else None
    shown = corner_parameters(chain.draws(), chain.parameter_names, corner)
    field = displacement_field(chain)
    table = diagnostics.summary(chain, truth=truth)
    fitted = FittedFrame.at(posterior, chain.estimate.params)
    page, picture, sources = outputs.beside(page)
    run, psf_file = chain.identity, outputs.psf_beside(page)
    measured = isinstance(posterior.model.psf, MeasuredPSF)
    if not overwrite:  # asked again, as what was not there may have come while the run was made
        own = [psf_file] * measured + [sources] * (home is None)
        marks.may_replace(run, page, picture, *own)
    content = png(overview(fitted, chain.draws(), posterior.parameters, truth=truth))
    write_report(
        page,
        chain=chain,
        summary=table,
        diagnostics=diagnostics,
        figures=page_figures(
            fitted, chain, diagnostics, field, picture=content, shown=shown, truth=truth
        ),
        result=field.message,
        home=home,
    )
    atomic.replace(picture, marks.marked(content, run))
    if measured:
        posterior.model.psf.write(psf_file, overwrite=True, run=run)
    return Result(chain, diagnostics, field, table, path, page, picture, sources)


def write_sources(path: Path, diagnostics: Diagnostics, run: str) -> None:
    """Write the table of sources of a chain, of one frame or of several.

    Parameters
    ----------
    path : Path
    diagnostics : Diagnostics
    run : str
        What the run is known by, see `marks`.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    columns = {name: column.data for name, column in diagnostics.sources.columns.items()}
    record = tables.TableRecord(columns, SOURCES_META)
    tables.write_table(path, record, overwrite=True, run=run)
