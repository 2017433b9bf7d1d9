"""Commands that judge: studies, checks of a chain, comparisons, halves of the sources."""

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from bayesfred import build, settings
from bayesfred._typing import Floats, PathLike
from bayesfred.analysis import comparison, cross_check
from bayesfred.analysis import verify as verification
from bayesfred.analysis.dask_cluster import cluster
from bayesfred.analysis.diagnostics import diagnose
from bayesfred.analysis.noise_study import NoiseStudy, noise_study
from bayesfred.analysis.sbc import SBCResult, simulation_based_calibration
from bayesfred.analysis.study_table import known_by
from bayesfred.build import naming
from bayesfred.commands import joint_pipeline, pipeline
from bayesfred.commands.records import Compared, Study
from bayesfred.commands.results import Say
from bayesfred.errors import InputError
from bayesfred.io import atomic, marks, outputs, paths, tables
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.reporting.comparison import ComparedRun, write_comparison
from bayesfred.reporting.studies import calibration_plot, noise_plot
from bayesfred.reporting.style import png
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.progress import working
from bayesfred.sampling.sampler import versions
from bayesfred.settings.joint import JointRun, read_run
from bayesfred.settings.simulation import StudySettings


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
    s, simulation = run.study or StudySettings(), run.simulation
    kind = kind or s.kind
    given = s.path or Path("chains", f"{run_file.stem}.{kind}.ecsv")
    table = paths.within(".", given, f"{run_file}: study.path")
    others = outputs.beside_study(table)
    paths.require_plain(table, *others, *paths.hidden(table))
    inputs = build.inputs(run, run_file)
    if paths.may_write(table, overwrite=overwrite, resume=resume, beside=others, inputs=inputs):
        marks.may_replace(known_by(table), *others)
    if kind == "noise":
        build.simulation(run, run_file)
    truth: Floats | None = None
    if simulation is None:
        posterior = pipeline.read_doubted(run, run_file, say)[0]
    else:
        posterior, truth = build.simulated(run, run_file, simulation.seed)
    if s.path is None:
        outputs.make_folder(table)
    with ExitStack() as stack:
        stack.enter_context(naming(run_file))
        executor = stack.enter_context(cluster(scheduler, say=say)) if scheduler else None
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
    return _write_study(result, posterior, table, overwrite=overwrite)


def _write_study(
    result: NoiseStudy | SBCResult, posterior: Posterior, table: Path, *, overwrite: bool
) -> Study:
    """Write the summary and the figure of a study beside its table."""
    findings, picture = outputs.beside_study(table)
    if isinstance(result, NoiseStudy):
        kind, found, figure = "noise", result.cells, noise_plot(result, posterior.parameters)
    else:
        figure = calibration_plot(result, posterior.parameters)
        kind, found = "sbc", result.quantities
    record = tables.TableRecord(found, {"study": kind, "message": result.message})
    run = known_by(table)
    if not overwrite:  # asked again, as what was not there may have come in the meantime
        marks.may_replace(run, findings, picture)
    tables.write_table(findings, record, overwrite=True, run=run)
    atomic.replace(picture, marks.marked(png(figure, 150), run))
    return Study(result, table, findings, picture)


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
    chain_files: Sequence[PathLike],
    *,
    out: PathLike | None = None,
    overwrite: bool = False,
    say: Say | None = None,
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
    say : callable, optional
        Without it no progress is shown.

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
        with working("predicting sources that are left out", show=say is not None):
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
        outputs.may_write_page(page, inputs=names, overwrite=overwrite)  # it may have come since
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
    run = read_run(run_file)
    posterior: Posterior | JointPosterior
    if isinstance(run, JointRun):
        joint_pipeline.require_frames(run, run_file)
        posterior, estimate, _ = joint_pipeline.read_frames(run, run_file, say)
    else:
        posterior, estimate, _ = pipeline.read_frame(run, run_file, say)
    with naming(run_file):
        return cross_check.cross_check(posterior, estimate=estimate)
