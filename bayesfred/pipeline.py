"""The steps that commands share: read a frame, fit it, report.

Nothing is printed. What should be known while a step works goes to `say`, one line at a time.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from bayesfred import build, settings
from bayesfred._typing import Floats
from bayesfred.analysis.choose_terms import choose_terms
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.field import displacement_field
from bayesfred.analysis.noise_study import NoiseStudy
from bayesfred.analysis.sbc import SBCResult
from bayesfred.errors import InputError, printable
from bayesfred.imaging.psf import PSF, MeasuredPSF, PSFToMeasure, has_pixel
from bayesfred.io import atomic, frames, outputs, paths, tables
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import approach, find_map, reject_outliers
from bayesfred.optimize.follow import follow_images
from bayesfred.optimize.measure_psf import marginalize_psf, measure_psf, psf_message
from bayesfred.optimize.uncatalogued import find_uncatalogued
from bayesfred.records import Result, Study
from bayesfred.reporting.figures import page_figures
from bayesfred.reporting.frames import FittedFrame
from bayesfred.reporting.html import write_report
from bayesfred.reporting.posteriors import corner_parameters, overview
from bayesfred.reporting.studies import calibration_plot, noise_plot
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.laplace import laplace
from bayesfred.sampling.progress import searching
from bayesfred.sampling.record import RunRecord
from bayesfred.sampling.sampler import sample
from bayesfred.sections import toml
from bayesfred.sources import bright, find_sources

__all__ = [
    "Job",
    "Say",
    "fit_frame",
    "naming",
    "read_frame",
    "write_results",
    "write_study",
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
    """Read the frame of a run file; reject outliers and choose terms if it asks for that.

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
        Its maximum, if outliers were rejected or terms chosen.
    notes : list of str
        What was read, what was removed, and what was chosen.

    Raises
    ------
    InputError
        If frame, catalogue or settings are unusable.
    """
    notes: list[str] = []

    def note(*lines: str) -> None:
        for line in filter(None, lines):
            notes.append(line)
            if say:
                say(line)

    f = run.frame
    path = paths.resolve(f.path, run_file, must_exist=True)
    frame = frames.read_frame(
        path, gain=f.gain, pedestal=f.pedestal, saturation=f.saturation, name=f.name
    )
    noise, line = build.noise_given(run, frame.read_noise)
    note(frame.description, line)
    shape = (frame.counts.shape[0], frame.counts.shape[1])
    psf = build.reference_psf(run, run_file)
    with searching("finding the sources") if say else nullcontext():
        sources, lines = find_sources(run, run_file, shape, psf, frame)
    note(*lines)
    counts, noise = bright(run, run_file, frame, noise)
    with naming(run_file):
        model = build.forward_model(run, shape, sources, psf)
        posterior = build.posterior_given(run, model, counts, frame.valid, noise)
        estimate, rough = None, isinstance(psf, PSFToMeasure)
        if posterior.nuisances.footprint is not None:
            with searching() if say else nullcontext():
                posterior, estimate, lines = _follow(posterior, rough=rough)
            note(*lines)
        if f.reject_outliers:
            with searching() if say else nullcontext():
                start = None if estimate is None else estimate.params
                reject = partial(approach, rejecting=True) if rough else reject_outliers
                kept, estimate = reject(posterior, start)
            note(_census(posterior, kept))
            posterior = kept
        if run.distortion.terms == "choose":
            with searching() if say else nullcontext():
                choice = choose_terms(posterior)
            posterior, estimate = choice.posterior, choice.estimate
            note(*choice.lines())
        if has_pixel(posterior.model.psf) or rough:
            with searching("measuring the PSF") if say else nullcontext():
                posterior, estimate = _with_measured_psf(posterior, estimate, psf, run)
            note(psf_message(posterior))
    return posterior, estimate, notes


def _follow(posterior: Posterior, *, rough: bool) -> tuple[Posterior, MapEstimate, list[str]]:
    """Footprints around the images, without sources that the catalogue lacks; the maximum."""
    followed = follow_images(posterior)
    shared = int(np.sum(followed.mask & posterior.mask))
    lines = [
        f"footprints: {followed.mask.sum()} pixels around the images, {shared} of which are as "
        "near to the catalogue's positions"
    ]
    estimate = approach(followed)[1] if rough else find_map(followed)
    found = find_uncatalogued(followed, estimate)
    if lost := int(np.sum(followed.mask & ~found.mask)):
        lines.append(f"{found.message}; {lost} pixels masked")
        followed = replace(followed, mask=found.mask, extrapolation=None)
        start = estimate.params
        estimate = approach(followed, start)[1] if rough else find_map(followed, start)
    return followed, estimate, lines


def _with_measured_psf(
    posterior: Posterior, estimate: MapEstimate | None, psf: PSF, run: settings.RunSettings
) -> tuple[Posterior, MapEstimate]:
    """The posterior with the errors of its PSF, which is measured first if that is asked for."""
    estimate = estimate or find_map(posterior)
    if isinstance(psf, PSFToMeasure):
        return measure_psf(
            posterior, estimate, oversampling=psf.oversampling, degree=psf.degree,
            model_error=run.nuisances.model_error, prior=build.priors_given(run),
        )  # fmt: skip
    posterior = marginalize_psf(posterior, estimate)
    return posterior, find_map(posterior, estimate.params)


def _census(posterior: Posterior, kept: Posterior) -> str:
    """How many sources and pixels of a posterior were rejected as outliers."""
    number = len(posterior.model.sources)
    masked = int(np.sum(posterior.mask & ~kept.mask))
    return (
        f"outliers: {number - len(kept.model.sources)} unmatched of {number} sources removed, "
        f"{masked} of {posterior.mask.sum()} pixels masked"
    )


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
    others: tuple[Path, ...] = outputs.beside(output)
    if isinstance(posterior.model.psf, MeasuredPSF):
        others += (outputs.psf_beside(output),)
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
            record = _record(job, open_chain(output) if resume else None)
            if map_only:
                chain = laplace(
                    posterior, estimate, path=output, seed=s.seed, overwrite=overwrite,
                    progress=say is not None, record=record,
                )  # fmt: skip
            else:
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
    field = displacement_field(chain)
    table = diagnostics.summary(chain, truth=truth)
    fitted = FittedFrame.at(posterior, chain.estimate.params)
    page, picture, sources = outputs.beside(page)
    write_report(
        page,
        chain=chain,
        summary=table,
        diagnostics=diagnostics,
        figures=page_figures(fitted, chain, diagnostics, field, shown=shown, truth=truth),
        result=field.message,
    )
    atomic.replace(picture, png(overview(fitted, chain.draws(), posterior.parameters, truth=truth)))
    if isinstance(posterior.model.psf, MeasuredPSF):
        posterior.model.psf.write(outputs.psf_beside(page), overwrite=True)
    columns = {name: column.data for name, column in diagnostics.sources.columns.items()}
    tables.write_table(sources, tables.TableRecord(columns, SOURCES_META), overwrite=True)
    return Result(chain, diagnostics, field, table, path, page, picture, sources)


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


def write_study(result: NoiseStudy | SBCResult, posterior: Posterior, table: Path) -> Study:
    """Write the summary and the figure of a study beside its table.

    Parameters
    ----------
    result : NoiseStudy or SBCResult
    posterior : Posterior
        Of one of its frames.
    table : Path
        With a row for each frame.

    Returns
    -------
    Study

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    findings, picture = outputs.beside_study(table)
    if isinstance(result, NoiseStudy):
        kind, found, figure = "noise", result.cells, noise_plot(result, posterior.parameters)
    else:
        figure = calibration_plot(result, posterior.parameters)
        kind, found = "sbc", result.quantities
    record = tables.TableRecord(found, {"study": kind, "message": result.message})
    tables.write_table(findings, record, overwrite=True)
    atomic.replace(picture, png(figure))
    return Study(result, table, findings, picture)
