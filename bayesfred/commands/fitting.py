"""Commands that make and fit frames: simulate them, fit them, report."""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from bayesfred import build, settings
from bayesfred._typing import PathLike
from bayesfred.analysis.dask_cluster import DaskWorkers, cluster
from bayesfred.analysis.photons import photons_needed
from bayesfred.analysis.processes import Processes, processes
from bayesfred.commands import joint_pipeline, pipeline
from bayesfred.commands.records import JointResult, Result, Simulated
from bayesfred.commands.results import How, Job, Say, may_write_run, write_results
from bayesfred.errors import InputError
from bayesfred.imaging.psf import MeasuredPSF
from bayesfred.io import outputs, paths
from bayesfred.io.catalogues import CatalogueRecord, write_catalogue
from bayesfred.io.frames import write_frame
from bayesfred.model.joint import JointPosterior
from bayesfred.sampling.chainfile import open_chain
from bayesfred.settings.joint import JointRun, read_run

DEMO_ERROR = 0.001  # pixel
DEMO_NOTE = (
    "The paper's first figure: 9 x 9 sources of 100,000 photons, 50 pixels apart, and a Gaussian "
    "PSF of 10 pixels. The coefficients are those of its Table 2, read with g in y and the columns "
    "in the order u2x, v2x, ux, vx, ux2, vx2: one of the readings in which the paper's results are "
    "possible."
)


def demo(
    folder: PathLike,
    *,
    seed: int = 1,
    map_only: bool = False,
    overwrite: bool = False,
    say: Say | None = None,
) -> Result:
    """Simulate the frame of the example run file, which is the paper's, and fit it.

    Parameters
    ----------
    folder : path-like
        Where demo.h5 goes; created if it does not exist.
    seed : int
        Seed of the frame and of the sampler.
    map_only : bool
        Do not sample, see `fit`.
    overwrite : bool
        Replace an earlier demo.
    say : callable, optional
        Told what is known early, a line at a time. Without it no progress is shown either.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the folder cannot be created, or holds a demo already.
    """
    output = Path(folder, "demo.h5")
    outputs.make_folder(output)
    example = Path(settings.__file__).with_name("example.toml")
    run = settings.read_settings(example).seeded(seed)
    posterior, truth = build.simulated(run, example, seed)
    job = Job(run, Path("demo"), output, (DEMO_NOTE,), truth)
    how = How(map_only=map_only, overwrite=overwrite)
    result = pipeline.fit_frame(job, posterior, None, how, say=say)
    needed = photons_needed(posterior, result.chain.estimate.params, DEMO_ERROR)
    return replace(result, photons=needed)


def simulate_frame(run_file: PathLike, *, overwrite: bool = False) -> Simulated:
    """Simulate the frame that a run file describes, and write it and its source grid, if any.

    Parameters
    ----------
    run_file : path-like
        Its [simulation] describes the frame.
    overwrite : bool
        Replace frame and catalogue.

    Returns
    -------
    Simulated

    Raises
    ------
    InputError
        If there is no [simulation], it cannot be simulated, or a file exists.
    """
    run_file = Path(run_file)
    run = settings.read_settings(run_file)
    simulation = build.simulation(run, run_file)
    if run.frame.gain not in (None, 1.0) or run.frame.pedestal or run.frame.gain_map:
        raise InputError(
            f"{run_file}: frame.gain: got a gain or a pedestal, expected neither, because counts "
            "are written: remove them"
        )
    posterior, truth = build.simulated(run, run_file, simulation.seed)
    # written beside the run file, whatever lies in the data folder
    folder, grid = run_file.parent, simulation.grid is not None
    frame = paths.within(folder, run.frame.path, f"{run_file}: frame.path")
    catalogue = paths.within(folder, run.catalogue.path or "", f"{run_file}: catalogue.path")
    written = (frame, catalogue) if grid else (frame,)
    inputs = build.inputs(run, run_file, build.SECTIONS[len(written) :])  # the others are made
    paths.may_write(frame, overwrite=overwrite, beside=written[1:], inputs=inputs)
    if grid:
        s = posterior.model.sources
        record = CatalogueRecord(s.x, s.y, s.flux)
        write_catalogue(catalogue, record, overwrite=overwrite)
    recorded = posterior.counts * getattr(posterior.noise.pixelwise, "response", 1.0)
    write_frame(frame, recorded, overwrite=overwrite)
    return Simulated(posterior, truth, frame, catalogue if grid else None)


def fit(
    run_file: PathLike,
    *,
    map_only: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    scheduler: str | None = None,
    workers: int | None = None,
    say: Say | None = None,
) -> Result | JointResult:
    """Fit the frame of a run file, or its frames together: MAP, draws, diagnostics, report.

    Parameters
    ----------
    run_file : path-like
        TOML, see `bayesfred fit --help`.
    map_only : bool
        Do not sample: draw from the Laplace approximation at the maximum, see `bf.laplace`.
    resume : bool
        Resume the run in the output file.
    overwrite : bool
        Replace the output file.
    scheduler : str, optional
        Address of a Dask scheduler whose workers evaluate the frames, of which there are several.
    workers : int, optional
        Processes of this machine that do so; by default this one does.
    say : callable, optional
        Told what is known early, a line at a time. Without it no progress is shown either.

    Returns
    -------
    Result or JointResult

    Raises
    ------
    InputError
        If the run file, the frame or the catalogue is unusable, the output file exists, or workers
        are given one frame, or are given twice.
    """
    run_file = Path(run_file)
    run = read_run(run_file)
    if scheduler and workers:
        raise InputError("fit: got both --scheduler and --workers, expected one of them")
    given = run.output.path or Path("chains", f"{run_file.stem}.h5")
    # inside the folder in which the run is started, whatever a run file from elsewhere says
    output = paths.within(".", given, f"{run_file}: output.path")
    how = How(map_only=map_only, resume=resume, overwrite=overwrite)
    if isinstance(run, JointRun):
        with ExitStack() as stack:
            executor: DaskWorkers | Processes | None = None
            if scheduler:
                executor = stack.enter_context(cluster(scheduler, say=say))
            elif workers:
                executor = stack.enter_context(processes(workers))
            return _fit_frames(run, run_file, output, how, executor, say)
    if scheduler or workers:
        raise InputError(
            f"{run_file}: got {'--scheduler' if scheduler else '--workers'} for one frame, "
            "expected several, in [[frames]]: without it threads share the frame's rows"
        )
    paths.resolve(run.frame.path, run_file, must_exist=True)
    inputs = build.inputs(run, run_file)
    paths.may_write(output, overwrite=True, inputs=inputs, beside=outputs.beside(output))
    posterior, estimate, notes = pipeline.read_frame(run, run_file, say)
    if run.output.path is None:
        outputs.make_folder(output)
    job = Job(run, run_file, output, notes, inputs=inputs)
    return pipeline.fit_frame(job, posterior, estimate, how, say=say)


def _fit_frames(
    run: JointRun,
    run_file: Path,
    output: Path,
    how: How,
    executor: DaskWorkers | Processes | None,
    say: Say | None,
) -> JointResult:
    """Fit several frames together; what would be refused at the end is refused before."""
    joint_pipeline.require_frames(run, run_file)
    inputs = build.inputs(run, run_file)
    beside = joint_pipeline.files_beside(output, dict.fromkeys(run.frames))
    paths.may_write(output, overwrite=True, inputs=inputs, beside=beside)
    if run.output.path is None:
        outputs.make_folder(output)
    may_write_run(output, how, beside, inputs)
    posterior, estimate, notes = joint_pipeline.read_frames(run, run_file, say)
    job = Job(run, run_file, output, notes, inputs=inputs)
    return joint_pipeline.fit_frames(job, posterior, estimate, how, executor=executor, say=say)


def report(
    chain_file: PathLike,
    *,
    target_ess: float | None = None,
    corner: Sequence[str] = (),
    out: PathLike | None = None,
    overwrite: bool = False,
    say: Say | None = None,
) -> Result | JointResult:
    """Judge a chain file again, and write its page and picture.

    Parameters
    ----------
    chain_file : path-like
    target_ess : float, optional
        Effective draws to ask of every parameter; by default the number that the run was made for.
    corner : sequence of str, optional
        Parameters to show in pairs; by default all, or of more than eight those of the most
        correlated pairs.
    out : path-like, optional
        The page, .html; by default beside the chain. The other files go beside the page.
    overwrite : bool
        Replace page, picture and table.
    say : callable, optional
        Told which of several frames is reported on. Without it no progress is shown either.

    Returns
    -------
    Result or JointResult

    Raises
    ------
    InputError
        If the chain is missing, damaged, or named as its page or picture would be; if a page,
        picture or table exists, or `corner` names what is no parameter.
    """
    path, chain = Path(chain_file), open_chain(chain_file)
    posterior, start = chain.posterior(), path if out is None else Path(out)
    if isinstance(posterior, JointPosterior):
        default, *others = joint_pipeline.files_beside(start, posterior.frames)
    else:
        default, *others = outputs.beside(start)
        if isinstance(posterior.model.psf, MeasuredPSF):
            others.append(outputs.psf_beside(start))
    page = default if out is None else start
    outputs.may_write_page(page, *others, inputs=(path,), overwrite=overwrite)
    ess = target_ess or chain.target_ess
    if isinstance(posterior, JointPosterior):
        return joint_pipeline.write_joint_results(
            chain, path, page, target_ess=ess, corner=corner, overwrite=overwrite, say=say
        )
    return write_results(
        chain, path, page, target_ess=ess, corner=corner, overwrite=overwrite, say=say
    )
