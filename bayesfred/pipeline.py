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
from bayesfred.io import atomic, frames, paths
from bayesfred.io.summary_table import Table
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import reject_outliers
from bayesfred.reporting.frames import FittedFrame
from bayesfred.reporting.html import page_figures, write_report
from bayesfred.reporting.posteriors import overview
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.laplace import laplace
from bayesfred.sampling.progress import searching
from bayesfred.sampling.sampler import sample
from bayesfred.sampling.summary import summary

__all__ = [
    "Job",
    "Result",
    "Say",
    "Simulated",
    "Study",
    "Verification",
    "beside",
    "fit_frame",
    "make_folder",
    "naming",
    "read_frame",
    "write_results",
]

Say = Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Result:
    """What a finished run left.

    Attributes
    ----------
    chain : Chain
    diagnostics : Diagnostics
    summary : astropy.table.Table
        The parameters, see `bayesfred.sampling.summary.summary`, with `Diagnostics.columns`.
    path, page, picture : Path
        The files: the chain, its report and its picture.
    """

    chain: Chain
    diagnostics: Diagnostics
    summary: Table
    path: Path
    page: Path
    picture: Path


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
    map_only: bool = False,
    say: Say | None,
) -> Result:
    """Find the maximum, sample or draw from the Laplace approximation, and write the results.

    Parameters
    ----------
    job : Job
    posterior : Posterior
    estimate : MapEstimate, optional
        Found if not given.
    resume, overwrite : bool
        Resume the run in the output file; replace it.
    map_only : bool
        Do not sample: draw from the Laplace approximation.
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
    others = beside(output)
    hidden = (output.with_name(f".{output.name}.{kind}") for kind in ("lock", "tmp", "writer"))
    for path in (output, *others, *hidden):
        if os.path.islink(path) or os.path.isdir(path):
            raise InputError(
                f"{path}: got a link or a folder, expected a file or nothing there: remove it, or "
                "write elsewhere"
            )
    if map_only and resume:
        raise InputError(
            f"{output}: got both --map-only and --resume, expected one: there are no steps to "
            "resume where nothing is sampled"
        )
    can_resume = None if map_only else resume
    resume = paths.may_write(output, overwrite=overwrite, resume=can_resume, beside=others)
    try:
        with naming(job.run_file):
            if map_only:
                chain = laplace(
                    posterior, estimate, path=output, seed=s.seed, overwrite=overwrite,
                    progress=say is not None,
                )  # fmt: skip
            else:
                chain = sample(
                    posterior, estimate, path=output, seed=s.seed, ensembles=s.ensembles,
                    walkers=s.walkers, target_ess=s.target_ess, steps=s.steps, resume=resume,
                    overwrite=overwrite, progress=say is not None,
                )  # fmt: skip
    except OSError as error:
        raise InputError(
            f"{output}: cannot be written ({error.strerror or error}), expected room and a folder "
            "that can be written"
        ) from error
    if say:
        say(f"maximum: {chain.estimate.message}")
    return write_results(chain, output, job, target_ess=s.target_ess)


def write_results(chain: Chain, path: Path, job: Job | None = None, *, target_ess: float) -> Result:
    """Judge a chain, and write page and picture beside it.

    Parameters
    ----------
    chain : Chain
    path : Path
        The chain's file.
    job : Job, optional
        The run that made the chain, if it is known.
    target_ess : float
        Effective draws to ask of every parameter.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If page or picture cannot be written.
    """
    posterior, truth = chain.posterior(), job.truth if job else None
    diagnostics = diagnose(chain, target_ess=target_ess)
    table = summary(chain, truth=truth, columns=diagnostics.columns)
    fitted = FittedFrame.at(posterior, chain.estimate.params)
    page, picture = beside(path)
    write_report(
        page,
        title=printable((job.run_file if job else path).stem),
        chain=chain,
        summary=table,
        diagnostics=diagnostics,
        figures=page_figures(fitted, chain, truth=truth),
        notes=job.notes if job else (),
        settings=job.run.model_dump_json(indent=2) if job else None,
    )
    atomic.replace(picture, png(overview(fitted, chain.draws(), posterior.parameters, truth=truth)))
    return Result(chain, diagnostics, table, path, page, picture)


def beside(chain: Path) -> tuple[Path, Path]:
    """Name the page and the picture of a chain file.

    Parameters
    ----------
    chain : Path

    Returns
    -------
    page, picture : Path

    Examples
    --------
    >>> [path.name for path in beside(Path("run.h5"))]
    ['run.html', 'run.png']
    """
    return chain.with_suffix(".html"), chain.with_suffix(".png")


def make_folder(path: Path) -> None:
    """Create the folder of an output file, unless it exists.

    Parameters
    ----------
    path : Path
        The file.

    Raises
    ------
    InputError
        If the folder cannot be created.
    """
    with atomic.writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)


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
