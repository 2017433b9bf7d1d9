"""Whole runs from a run file: build the posterior, fit, sample, judge, report.

`cli.py` is the same from a shell; `assembly.py` makes the settings objects.
"""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from bayesfred import build, settings
from bayesfred._typing import Floats, PathLike
from bayesfred.analysis import comparison
from bayesfred.analysis import verify as verification
from bayesfred.analysis.diagnostics import Diagnostics, diagnose
from bayesfred.analysis.executor import cluster
from bayesfred.analysis.noise_study import VARIABLES, NoiseStudy, noise_study
from bayesfred.analysis.sbc import PosteriorCalibration, calibrate_posterior
from bayesfred.errors import InputError, printable
from bayesfred.io.atomic import replace
from bayesfred.io.catalogues import CatalogueRecord, write_catalogue
from bayesfred.io.frames import read_frame, write_frame
from bayesfred.io.paths import resolve, within
from bayesfred.io.tables import TableRecord, write_table
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import reject_outliers
from bayesfred.reporting import html, plots
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain
from bayesfred.sampling.sampler import sample, searching, versions

DEMO_NOTE = (
    "The paper's first figure: 9 x 9 sources of 100,000 photons, 50 pixels apart, and a Gaussian "
    "PSF of 10 pixels. The "
    "coefficients are those of its Table 2, read with g in y and the columns in the order u2x, "
    "v2x, ux, vx, ux2, vx2: one of the "
    "readings in which the paper's results are possible."
)


@dataclass(frozen=True)
class Result:
    """What a finished run left.

    Attributes
    ----------
    chain : Chain
    diagnostics : Diagnostics
    """

    chain: Chain
    diagnostics: Diagnostics


def demo(folder: PathLike, *, seed: int = 1, overwrite: bool = False) -> Result:
    """Simulate the frame of the example run file, which is the paper's, and fit it into folder/demo.h5.

    Parameters
    ----------
    folder : path-like
        Made if it does not exist.
    seed : int
        Seed of the frame and of the sampler.
    overwrite : bool
        Replace an earlier demo.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the folder cannot be made, or holds a demo already.
    """
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made a folder ({error.strerror}), expected a place for the "
            "demo's files"
        ) from None
    example = Path(__file__).with_name("example.toml")
    run = settings.read_settings(example)
    run = run.model_copy(update={"sampling": run.sampling.model_copy(update={"seed": seed})})
    posterior, truth = build.simulated(run, example, seed)
    return _fit(
        posterior,
        Path(folder) / "demo.h5",
        run,
        Path("demo"),
        [DEMO_NOTE],
        truth=truth,
        overwrite=overwrite,
    )


def simulate_frame(run_file: PathLike, *, overwrite: bool = False) -> None:
    """Draw the frame that a run file's [simulation] describes, and write it and its source grid, if it has one.

    Parameters
    ----------
    run_file : path-like
    overwrite : bool
        Replace frame and catalogue.

    Raises
    ------
    InputError
        If there is no [simulation], it cannot be drawn, or a file exists.
    """
    run = settings.read_settings(Path(run_file))
    if run.simulation is None:
        raise InputError(
            f"{run_file}: simulation: no such section, expected shape, theta and background: see "
            "bayesfred fit --help"
        )
    if run.frame.gain is not None or run.frame.pedestal != 0.0:
        raise InputError(
            f"{run_file}: frame.gain: got a gain or a pedestal, expected neither, because counts "
            "are written: leave them out"
        )
    posterior, _ = build.simulated(run, Path(run_file), run.simulation.seed)
    # written beside the run file, whatever lies in the data folder
    folder = Path(run_file).parent
    frame = within(folder, run.frame.path, f"{run_file}: frame.path")
    catalogue = within(folder, run.catalogue.path, f"{run_file}: catalogue.path")
    if os.path.lexists(frame) and not overwrite:  # before the catalogue is written
        raise InputError(
            f"{frame}: exists, expected a new file: rename it, or replace it with --overwrite"
        )
    if run.simulation.grid is not None:
        s = posterior.model.sources
        write_catalogue(catalogue, CatalogueRecord(s.x, s.y, s.flux), overwrite=overwrite)
        print(f"{printable(str(catalogue))}: {len(s)} sources")
    write_frame(frame, posterior.counts, overwrite=overwrite)
    ny, nx = posterior.counts.shape
    print(f"{printable(str(frame))}: {ny} x {nx} pixels, {posterior.counts.sum():.0f} counts")


def fit(run_file: PathLike, *, resume: bool = False, overwrite: bool = False) -> Result:
    """Fit the frame of a run file: MAP, draws, diagnostics, report.

    Parameters
    ----------
    run_file : path-like
        TOML, see `bayesfred fit --help`.
    resume : bool
        Go on with the run in the output file.
    overwrite : bool
        Replace the output file.

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
    output = _output(run, run_file)
    path = resolve(run.frame.path, run_file, must_exist=True)
    if os.path.exists(output) and output.samefile(path):
        raise InputError(
            f"{run_file}: output.path: got the frame's file, expected another: the chain would "
            "replace the frame"
        )
    posterior, estimate, notes = _framed(run, run_file)
    if run.output.path is None and not output.parent.is_dir():
        with _writing(output):
            output.parent.mkdir()
    return _fit(
        posterior,
        output,
        run,
        run_file,
        notes,
        estimate=estimate,
        resume=resume,
        overwrite=overwrite,
    )


def _framed(
    run: settings.RunSettings, run_file: Path
) -> tuple[Posterior, MapEstimate | None, list[str]]:
    """The posterior of the frame that a run file names, its maximum where clipping has found it, and what there is to say."""
    f = run.frame
    path = resolve(f.path, run_file, must_exist=True)
    frame = read_frame(path, gain=f.gain, pedestal=f.pedestal, saturation=f.saturation, name=f.name)
    print(frame.description)
    ny, nx = frame.counts.shape
    psf = build.reference_psf(run, run_file)
    sources, census = build.catalogue(run, run_file, (ny, nx), psf)
    print(census)
    with _naming(run_file):
        model = build.forward_model(run, (ny, nx), sources, psf)
        posterior = build.posterior_given(run, model, frame.counts, frame.valid)
        if not f.reject_outliers:
            return posterior, None, [frame.description, census]
        with searching():
            clipped, estimate = reject_outliers(posterior)
    lost, pixels = (
        len(sources) - len(clipped.model.sources),
        int(np.sum(posterior.mask & ~clipped.mask)),
    )
    clipping = (
        f"sigma clipping: {lost} of {len(sources)} sources and {pixels} of "
        f"{posterior.mask.sum()} pixels left out"
    )
    print(clipping)
    return clipped, estimate, [frame.description, census, clipping]


def study(
    run_file: PathLike,
    *,
    kind: str | None = None,
    scheduler: str | None = None,
    workers: int | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> bool:
    """Do the study of a run file's [study]: a table with a row a frame, a summary and a picture beside it.

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
        Go on with the study in the table; replace it.

    Returns
    -------
    bool
        Whether every frame could be fitted and, in a calibration, the error bars hold.

    Raises
    ------
    InputError
        If the run file is unusable, describes no study, or the table exists.
    """
    run_file = Path(run_file)
    run = settings.read_settings(run_file)
    s, simulation = run.study or settings.StudySettings(), run.simulation
    kind = kind or s.kind
    table = within(
        ".", s.path or Path("chains", f"{run_file.stem}.{kind}.ecsv"), f"{run_file}: study.path"
    )
    summary, picture = table.with_name(f"{table.stem}.summary.ecsv"), table.with_suffix(".png")
    if resume and overwrite:
        raise InputError(
            "--resume and --overwrite: got both, expected one: go on with the study, or replace it"
        )
    for path in (table, summary, picture):
        if os.path.lexists(path) and not (overwrite or resume):
            raise InputError(
                f"{path}: exists, expected a new file: go on with --resume, or replace it with "
                "--overwrite"
            )
    if simulation is None and kind == "noise":
        raise InputError(
            f"{run_file}: simulation: no such section, expected shape, theta and background: see "
            "bayesfred fit --help"
        )
    posterior, truth = (
        build.simulated(run, run_file, simulation.seed)
        if simulation
        else (_framed(run, run_file)[0], None)
    )
    if s.path is None and not table.parent.is_dir():
        with _writing(table):
            table.parent.mkdir()
    with ExitStack() as stack:
        stack.enter_context(_naming(run_file))
        executor = stack.enter_context(cluster(scheduler)) if scheduler else None
        how: dict[str, Any] = {
            "replicates": s.replicates, "seed": s.seed, "path": table, "executor": executor, "workers": workers, "resume": resume,
            "overwrite": overwrite,
        }  # fmt: skip
        if kind == "noise" and simulation is not None and truth is not None:
            model = posterior.model
            result: NoiseStudy | PosteriorCalibration = noise_study(
                model, truth[: model.distortion.n_terms], s.background or simulation.background, flux=s.flux or (),
                sources=s.sources or (), psf_sigma=s.psf_sigma or (), exposure=s.exposure or (), method=s.method or "laplace",
                noise=posterior.noise, nuisances=posterior.nuisances, prior=build.priors_given(run), **how,
            )  # fmt: skip
        else:
            result = calibrate_posterior(posterior, method=s.method or "mcmc", **how)
    found = result.cells if isinstance(result, NoiseStudy) else result.quantities
    write_table(
        summary,
        TableRecord(found, {"study": kind, "message": result.message}),
        overwrite=True,
    )
    figure = (
        plots.noise_plot(result)
        if isinstance(result, NoiseStudy)
        else plots.calibration_plot(result)
    )
    replace(picture, plots.png(figure))
    Console(width=None if sys.stdout.isatty() else 120).print(_studied(result))
    print(result.message)
    for label, path in (("table", table), ("summary", summary), ("picture", picture)):
        print(f"{label:8}{printable(str(path))}")
    return (
        result.calibrated
        if isinstance(result, PosteriorCalibration)
        else not result.cells["failed"].any()
    )


def _studied(result: NoiseStudy | PosteriorCalibration) -> Table:
    """A study's findings: a row a noise level, or a row a quantity."""
    if isinstance(result, NoiseStudy):
        rows = {
            key: values[result.cells["parameter"] == "theta"]
            for key, values in result.cells.items()
        }
        heads = [name for name in VARIABLES if len(set(rows[name])) > 1] or ["background"]
        heads += ["frames", "failed"]
        shown = ["efficiency", "coverage_68", "coverage_95", "chi2", "lambda"]
    else:
        rows, heads, shown = (
            result.quantities,
            ["quantity"],
            ["coverage_68", "coverage_95", "pull", "uniformity"],
        )
    table = Table()
    for head in (*heads, *shown):
        table.add_column(
            {"coverage_68": "% in 68 %", "coverage_95": "% in 95 %"}.get(head, head),
            justify="right",
            no_wrap=True,
        )

    def cell(key: str, k: int) -> str:
        value = rows[key][k]
        if key in ("chi2", "uniformity"):
            return f"{value:.3g}"
        if f"{key}_error" not in rows:
            return f"{value:g}" if rows[key].dtype.kind == "f" else str(value)
        factor, digits = (100.0, 1) if "coverage" in key else (1.0, 3)
        return f"{factor * value:.{digits}f} ± {factor * rows[f'{key}_error'][k]:.{digits}f}"

    for k in range(len(rows[heads[0]])):
        table.add_row(*(cell(key, k) for key in (*heads, *shown)))
    return table


def report(chain_file: PathLike, *, target_ess: float | None = None) -> Result:
    """Judge a chain file anew, and write its report and overview beside it.

    Parameters
    ----------
    chain_file : path-like
    target_ess : float, optional
        Effective draws to ask of every parameter; by default as many as the run was made for.

    Returns
    -------
    Result

    Raises
    ------
    InputError
        If the chain is missing, damaged, or named as its page or picture would be.
    """
    chain = open_chain(chain_file)
    assert chain.path is not None, "read from a file"
    if chain.path in _beside(chain.path):
        raise InputError(
            f"{chain_file}: got a chain named as its report, which would replace it, expected "
            "NAME.h5: rename it"
        )
    return _report(
        chain,
        chain.posterior(),
        Path(chain_file).stem,
        [],
        target_ess=target_ess or chain.target_ess,
    )


def verify(chain_file: PathLike, *, every_draw: bool = False) -> bool:
    """Compute again what a chain file holds, and print what holds as a table.

    Parameters
    ----------
    chain_file : path-like
    every_draw : bool
        Compute the log-probability of every draw, not of 1,000 evenly spaced ones.

    Returns
    -------
    bool
        Whether everything holds.
    """
    checks = verification.verify(Path(chain_file), every_draw=every_draw)
    table = Table("what", "finding", "holds")
    for check in checks:
        table.add_row(check.what, escape(check.finding), "yes" if check.holds else "no")
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    made = open_chain(chain_file).versions
    others = [
        f"{name} {made.get(name)} (here {here})"
        for name, here in versions().items()
        if made.get(name) != here
    ]
    if others:
        print(f"made with {', '.join(others)}")
    return all(check.holds for check in checks)


def compare(chain_files: Sequence[PathLike]) -> comparison.Comparison:
    """Rank models of one frame by leave-one-out predictive accuracy, and print the ranking as a table.

    Parameters
    ----------
    chain_files : sequence of path-like
        At least two.

    Returns
    -------
    Comparison

    Raises
    ------
    InputError
        If a chain cannot be read, is named twice, or the models cannot be compared.
    """
    paths = [Path(file) for file in chain_files]
    for path in paths:
        if paths.count(path) > 1:
            raise InputError(
                f"{path}: got it twice, expected chains of different models: name each once"
            )
    compared = comparison.compare({str(path): open_chain(path) for path in paths})
    table = Table("model", "parameters", "elpd", "p_loo", "behind the best", "Pareto k")
    for score in compared.scores:
        behind = (
            f"{score.difference:.1f} +- {score.difference_se:.1f}"
            if score is not compared.scores[0]
            else ""
        )
        shape = f"{score.pareto_k:.2f}" if np.isfinite(score.pareto_k) else ""
        table.add_row(
            escape(printable(score.name)), str(score.n_parameters), f"{score.elpd:.1f} +- "
                                                                    f"{score.elpd_se:.1f}",
            f"{score.p_loo:.1f}", behind, shape,
        )  # fmt: skip
    Console(width=None if sys.stdout.isatty() else 120).print(table)
    print(
        f"chosen: {printable(compared.chosen)}, the one with the fewest parameters that predicts "
        "as well as the best"
    )
    if not compared.reliable:
        print(
            "not reliable: pixels whose weights have too heavy a tail (Pareto k), which single "
            "draws decide: look for bad pixels"
        )
    return compared


def _output(run: settings.RunSettings, run_file: Path) -> Path:
    """Where the chain goes: inside the folder that the run is started in, whatever a run file from elsewhere says."""
    return within(
        ".", run.output.path or Path("chains", f"{run_file.stem}.h5"), f"{run_file}: output.path"
    )


def _beside(chain: Path) -> tuple[Path, Path]:
    """Page and picture of a chain file."""
    return chain.with_suffix(".html"), chain.with_suffix(".png")


@contextmanager
def _naming(run_file: Path) -> Iterator[None]:
    """Begin the line of what the objects of a run refuse with the file that describes them."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{run_file}: {error}") from None


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn what a disk or a file system refuses into one line."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{path}: cannot be written ({reason}), expected room and a folder that can be"
        ) from error


def _fit(
    posterior: Posterior,
    output: Path,
    run: settings.RunSettings,
    run_file: Path,
    notes: Sequence[str],
    *,
    estimate: MapEstimate | None = None,
    truth: Floats | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> Result:
    """Find the maximum, sample, report."""
    s = run.sampling
    if resume and overwrite:
        raise InputError(
            "--resume and --overwrite: got both, expected one: go on with the run, or replace it"
        )
    if not output.parent.is_dir():
        raise InputError(
            f"{output}: no folder {output.parent}, expected one to write the chain to: create it"
        )
    page, picture = _beside(output)
    hidden = (output.with_name(f".{output.name}.{kind}") for kind in ("lock", "tmp", "writer"))
    for path in (output, page, picture, *hidden):
        if os.path.islink(path) or os.path.isdir(path):
            raise InputError(
                f"{path}: got a link or a folder, expected a file or nothing there: remove it, or "
                "write elsewhere"
            )
    resume = resume and os.path.exists(output)
    for path in (output, page, picture):  # said before the work, not after it
        if os.path.exists(path) and not (overwrite or resume):
            remedy = (
                "go on with --resume, or replace it with --overwrite"
                if path == output
                else "move it, or use --overwrite"
            )
            raise InputError(f"{path}: exists, expected a new file: {remedy}")
    with _writing(output), _naming(run_file):
        chain = sample(
            posterior, estimate, path=output, seed=s.seed, ensembles=s.ensembles, walkers=s.walkers,
            target_ess=s.target_ess, steps=s.steps, resume=resume, overwrite=overwrite,
        )  # fmt: skip
    print(f"maximum: {chain.estimate.message}")
    return _report(
        chain, posterior, run_file.stem, notes, target_ess=s.target_ess, truth=truth, run=run
    )


def _report(
    chain: Chain,
    posterior: Posterior,
    title: str,
    notes: Sequence[str],
    *,
    target_ess: float,
    truth: Floats | None = None,
    run: settings.RunSettings | None = None,
) -> Result:
    """Table on the screen, page and picture beside the chain."""
    diagnostics = diagnose(chain, target_ess=target_ess)
    # a file or a pipe has no width of its own
    Console(width=None if sys.stdout.isatty() else 120).print(_table(chain, diagnostics, truth))
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
    assert chain.path is not None, "in a file"
    page, picture = _beside(chain.path)
    with _writing(page):
        html.write_report(
            page, title=printable(title), chain=chain, diagnostics=diagnostics, posterior=posterior, truth=truth, notes=notes,
            settings=run.model_dump_json(indent=2) if run else None,
        )  # fmt: skip
    expected = posterior.expected_counts(chain.estimate.params)
    sigma = posterior.sigma(chain.estimate.params)
    figure = plots.overview(
        posterior.counts,
        expected,
        sigma,
        posterior.mask,
        chain.draws(),
        chain.parameter_names,
        truth=truth,
    )
    replace(picture, plots.png(figure))
    print(diagnostics.message)
    for label, path in (("chain", chain.path), ("report", page), ("picture", picture)):
        print(f"{label:8}{printable(str(path))}")
    return Result(chain, diagnostics)


def _table(chain: Chain, diagnostics: Diagnostics, truth: Floats | None) -> Table:
    """Coefficient, truth, MAP, posterior mean +- sd, z, how well it is sampled, and how it responds to the prior."""
    table = Table()
    heads = (
        ("MAP", "posterior mean +- sd")
        if truth is None
        else ("truth", "MAP", "posterior mean +- sd", "z")
    )
    for head in ("coefficient", *heads, "R-hat", "ESS", "prior sens."):
        table.add_column(head, justify="left" if head == "coefficient" else "right", no_wrap=True)
    draws = chain.draws()
    for k, name in enumerate(chain.parameter_names):
        mean, sd = float(draws[:, k].mean()), float(draws[:, k].std(ddof=1))
        exponent = int(np.floor(np.log10(max(abs(mean), sd)))) if sd > 0 else 0
        exponent = 0 if -3 < exponent < 4 else exponent
        places = max(0, exponent + 1 - int(np.floor(np.log10(sd)))) if sd > 0 else 6

        def number(value: float, exponent: int = exponent, places: int = places) -> str:
            return f"{value / 10.0**exponent:.{places}f}"

        power = f" e{exponent:+03d}" if exponent else ""
        cells = [number(chain.estimate.params[k]) + power, f"{number(mean)} +- {number(sd)}{power}"]
        if truth is not None:
            cells = [number(truth[k]) + power, *cells, f"{(mean - truth[k]) / sd:+.2f}"]
        ess = min(diagnostics.ess_bulk[name], diagnostics.ess_tail[name])
        table.add_row(
            name,
            *cells,
            f"{diagnostics.rhat[name]:.3f}",
            f"{ess:.0f}",
            f"{diagnostics.prior_sensitivity[name]:.3f}",
        )
    return table
