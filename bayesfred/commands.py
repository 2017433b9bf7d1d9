"""Whole runs from a run file: build the posterior, fit, sample, judge, write the report.

Every command returns a record and prints nothing. What should be known while it works goes to
`say`, which is told one line at a time. `show.py` prints the records.
"""

import os
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from bayesfred import build, pipeline, settings
from bayesfred._typing import Floats, PathLike
from bayesfred.analysis import comparison, cross_check
from bayesfred.analysis import verify as verification
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.executor import cluster
from bayesfred.analysis.noise_study import NoiseStudy, noise_study
from bayesfred.analysis.photons import photons_needed
from bayesfred.analysis.sbc import SBCResult, simulation_based_calibration
from bayesfred.errors import InputError
from bayesfred.imaging.psf import MeasuredPSF
from bayesfred.io import outputs, paths
from bayesfred.io.catalogues import CatalogueRecord, write_catalogue
from bayesfred.io.frames import write_frame
from bayesfred.pipeline import Say
from bayesfred.proposal import init as init
from bayesfred.records import Compared, Result, Simulated, Study
from bayesfred.reporting.comparison import ComparedRun, write_comparison
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import versions

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
    example = Path(__file__).with_name("example.toml")
    run = settings.read_settings(example).seeded(seed)
    posterior, truth = build.simulated(run, example, seed)
    job = pipeline.Job(run, Path("demo"), output, (DEMO_NOTE,), truth)
    result = pipeline.fit_frame(job, posterior, map_only=map_only, overwrite=overwrite, say=say)
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
    if run.frame.gain is not None or run.frame.pedestal:
        raise InputError(
            f"{run_file}: frame.gain: got a gain or a pedestal, expected neither, because counts "
            "are written: remove them"
        )
    posterior, truth = build.simulated(run, run_file, simulation.seed)
    # written beside the run file, whatever lies in the data folder
    folder, grid = run_file.parent, simulation.grid is not None
    frame = paths.within(folder, run.frame.path, f"{run_file}: frame.path")
    catalogue = paths.within(folder, run.catalogue.path, f"{run_file}: catalogue.path")
    paths.may_write(frame, overwrite=overwrite, beside=(catalogue,) if grid else ())
    if grid:
        s = posterior.model.sources
        record = CatalogueRecord(s.x, s.y, s.flux)
        write_catalogue(catalogue, record, overwrite=overwrite)
    write_frame(frame, posterior.counts, overwrite=overwrite)
    return Simulated(posterior, truth, frame, catalogue if grid else None)


def fit(
    run_file: PathLike,
    *,
    map_only: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    say: Say | None = None,
) -> Result:
    """Fit the frame of a run file: MAP, draws, diagnostics, report.

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
    say : callable, optional
        Told what is known early, a line at a time. Without it no progress is shown either.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the run file, the frame or the catalogue is unusable, or the output file exists.
    """
    run_file = Path(run_file)
    run = settings.read_settings(run_file)
    given = run.output.path or Path("chains", f"{run_file.stem}.h5")
    # inside the folder in which the run is started, whatever a run file from elsewhere says
    output = paths.within(".", given, f"{run_file}: output.path")
    frame = paths.resolve(run.frame.path, run_file, must_exist=True)
    if os.path.exists(output) and output.samefile(frame):
        raise InputError(
            f"{run_file}: output.path: got the frame's file, expected another: the chain would "
            "replace the frame"
        )
    posterior, estimate, notes = pipeline.read_frame(run, run_file, say)
    if run.output.path is None:
        outputs.make_folder(output)
    job = pipeline.Job(run, run_file, output, notes)
    return pipeline.fit_frame(
        job, posterior, estimate, map_only=map_only, resume=resume, overwrite=overwrite, say=say
    )


def study(
    run_file: PathLike,
    *,
    kind: str | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
    say: Say | None = None,
) -> Study:
    """Do the study of a run file's [study]: a row for each frame, a summary and a figure.

    Parameters
    ----------
    run_file : path-like
    kind : {"noise", "sbc"}, optional
        By default the run file's.
    scheduler : str, optional
        Address of a Dask scheduler whose workers do the work; by default a pool of processes does.
    workers : int, optional
        Processes of that pool, by default one a core.
    resume, overwrite : bool
        Resume the study in the table; replace it.
    say : callable, optional
        Told what is known early, a line at a time. Without it no progress is shown either.

    Returns
    -------
    Study

    Raises
    ------
    InputError
        If the run file is unusable, describes no study, or the table exists.
    """
    run_file = Path(run_file)
    run = settings.read_settings(run_file)
    if run.distortion.terms == "choose":
        raise InputError(
            f"{run_file}: distortion.terms: got 'choose', expected the terms themselves: a study "
            "is of one model"
        )
    s, simulation = run.study or settings.StudySettings(), run.simulation
    kind = kind or s.kind
    given = s.path or Path("chains", f"{run_file.stem}.{kind}.ecsv")
    table = paths.within(".", given, f"{run_file}: study.path")
    others = outputs.beside_study(table)
    paths.may_write(table, overwrite=overwrite, resume=resume, beside=others)
    if kind == "noise":
        build.simulation(run, run_file)
    truth: Floats | None = None
    if simulation is None:
        posterior, _, _ = pipeline.read_frame(run, run_file, say)
    else:
        posterior, truth = build.simulated(run, run_file, simulation.seed)
    if s.path is None:
        outputs.make_folder(table)
    with ExitStack() as stack:
        stack.enter_context(pipeline.naming(run_file))
        executor = stack.enter_context(cluster(scheduler)) if scheduler else None
        how: dict[str, Any] = {
            "replicates": s.replicates, "seed": s.seed, "path": table, "executor": executor,
            "workers": workers, "resume": resume, "overwrite": overwrite,
            "progress": say is not None,
        }  # fmt: skip
        if kind == "noise" and simulation is not None and truth is not None:
            model = posterior.model
            result: NoiseStudy | SBCResult = noise_study(
                model, truth[: model.distortion.n_terms], s.background or simulation.background,
                flux=s.flux or (), sources=s.sources or (), psf_sigma=s.psf_sigma or (),
                exposure=s.exposure or (), method=s.method or "laplace", noise=posterior.noise,
                nuisances=posterior.nuisances, prior=build.priors_given(run), error=s.error, **how,
            )  # fmt: skip
        else:
            result = simulation_based_calibration(posterior, method=s.method or "mcmc", **how)
    return pipeline.write_study(result, posterior, table)


def report(
    chain_file: PathLike,
    *,
    target_ess: float | None = None,
    corner: Sequence[str] = (),
    out: PathLike | None = None,
    overwrite: bool = False,
) -> Result:
    """Judge a chain file again, and write its page and picture.

    Parameters
    ----------
    chain_file : path-like
    target_ess : float, optional
        Effective draws to ask of every parameter; by default the number that the run was made for.
    corner : sequence of str, optional
        Parameters to show in pairs; by default all, or of more than twelve those of the most
        correlated pairs.
    out : path-like, optional
        The page, .html; by default beside the chain. The other files go beside the page.
    overwrite : bool
        Replace page, picture and table.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the chain is missing, damaged, or named as its page or picture would be; if a page,
        picture or table exists, or `corner` names what is no parameter.
    """
    path, chain = Path(chain_file), open_chain(chain_file)
    default, *others = outputs.beside(path if out is None else Path(out))
    page = default if out is None else Path(out)
    if isinstance(chain.posterior().model.psf, MeasuredPSF):
        others.append(outputs.psf_beside(page))
    outputs.may_write_page(page, *others, inputs=(path,), overwrite=overwrite)
    ess = target_ess or chain.target_ess
    return pipeline.write_results(chain, path, page, target_ess=ess, corner=corner)


def verify(chain_file: PathLike, *, every_draw: bool = False) -> verification.Verification:
    """Compute again what a chain file holds.

    Parameters
    ----------
    chain_file : path-like
    every_draw : bool
        Compute the log-probability of every draw, not of 1,000 evenly spaced ones.

    Returns
    -------
    Verification

    Raises
    ------
    InputError
        If the chain is missing or damaged.
    """
    checks = verification.verify(Path(chain_file), every_draw=every_draw)
    made = open_chain(chain_file).versions
    others = (
        f"{name} {made.get(name)} (here {here})"
        for name, here in versions().items()
        if made.get(name) != here
    )
    return verification.Verification(tuple(checks), tuple(others))


def compare(
    chain_files: Sequence[PathLike], *, out: PathLike | None = None, overwrite: bool = False
) -> Compared:
    """Rank models of one frame by how well they predict sources, and show runs side by side.

    Parameters
    ----------
    chain_files : sequence of path-like
        At least two.
    out : path-like, optional
        A page to write, .html. It is written of runs that cannot be ranked, too.
    overwrite : bool
        Replace the page.

    Returns
    -------
    Compared

    Raises
    ------
    InputError
        If a chain cannot be read, is named twice, the page exists, or without a page the models
        cannot be compared.
    """
    names = [Path(file) for file in chain_files]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{name}: got it twice, expected chains of different models: name each once"
            )
    page = None if out is None else Path(out)
    if page:
        outputs.may_write_page(page, inputs=names, overwrite=overwrite)
    chains = {str(name): open_chain(name) for name in names}
    ranking, reason = None, ""
    try:
        ranking = comparison.compare(chains)
    except InputError as error:
        if page is None or len(chains) < 2:
            raise
        reason = str(error)
    if page:
        runs = [
            ComparedRun(name, chain, diagnose(chain, target_ess=chain.target_ess))
            for name, chain in chains.items()
        ]
        write_comparison(page, runs, ranking, reason)
    return Compared(ranking, reason, page)


def crosscheck(run_file: PathLike, *, say: Say | None = None) -> cross_check.CrossCheck:
    """Fit two halves of a run file's sources apart, and ask whether the errors are right.

    Parameters
    ----------
    run_file : path-like
    say : callable, optional
        Told what was read, a line at a time.

    Returns
    -------
    CrossCheck

    Raises
    ------
    InputError
        If the run file, the frame or the catalogue is unusable, or the sources are too few.
    """
    run_file = Path(run_file)
    posterior, estimate, _ = pipeline.read_frame(settings.read_settings(run_file), run_file, say)
    with pipeline.naming(run_file):
        return cross_check.cross_check(posterior, estimate=estimate)
