"""The steps of a run of several frames: read every one, fit all together, report on each.

A frame is read as if it were alone (`pipeline.read_frame`): its footprint, outliers and PSF are its
own. What is sampled and judged is the posterior of all.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bayesfred import build
from bayesfred._typing import Floats
from bayesfred.analysis.diagnostics import Diagnostics, diagnose
from bayesfred.analysis.frame_estimates import frame_estimates
from bayesfred.analysis.remote_frames import RemoteFrames
from bayesfred.build import naming
from bayesfred.commands import pipeline
from bayesfred.commands.records import JointResult, Result
from bayesfred.commands.results import (
    How,
    Job,
    Say,
    make_chain,
    write_page,
    write_sources,
)
from bayesfred.errors import InputError
from bayesfred.imaging.psf import PSF, MeasuredPSF
from bayesfred.io import atomic, marks, outputs, paths
from bayesfred.io.summary_table import Table, make_table
from bayesfred.model.drift import Drift
from bayesfred.model.joint import JointPosterior
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import refuse_nodes
from bayesfred.optimize.estimate import MapEstimate, inverse
from bayesfred.optimize.find_map import MOST_NAMED, find_map
from bayesfred.optimize.fit_statistics import misfit
from bayesfred.optimize.joint_map import marginalize_joint_psf
from bayesfred.reporting.joint import agreement_plot, joint_figures, write_joint_report
from bayesfred.reporting.pairs import corner_parameters
from bayesfred.reporting.style import png
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.progress import working
from bayesfred.sampling.record import LONGEST, RunRecord
from bayesfred.settings.joint import JointRun

__all__ = ["files_beside", "fit_frames", "read_frames", "require_frames", "write_joint_results"]


def require_frames(run: JointRun, run_file: Path) -> None:
    """Refuse a run whose frames are missing or are one: before any is read.

    Parameters
    ----------
    run : JointRun
    run_file : Path

    Raises
    ------
    InputError
    """
    seen: dict[tuple[str, str | None], str] = {}
    for name, own in run.frames.items():
        path = paths.resolve(own.frame.path, run_file, must_exist=True)
        same = seen.setdefault((os.path.realpath(path), own.frame.name), name)
        if same != name:
            raise InputError(
                f"{run_file}: frames: got {path} as {same} and as {name}, expected each frame once"
            )


def read_frames(
    run: JointRun, run_file: Path, say: Say | None
) -> tuple[JointPosterior, MapEstimate | None, list[str]]:
    """Read the frames of a run file, each as `pipeline.read_frame` does, and put them together.

    Parameters
    ----------
    run : JointRun
    run_file : Path
    say : callable, optional
        Told every note at once.

    Returns
    -------
    posterior : JointPosterior
        With the errors of PSFs that were measured.
    estimate : MapEstimate or None
        Its maximum, if frames' own maxima were needed to read them, or where there are doubts of a
        frame: then the model does not fit, and the message names the frame.
    notes : list of str
        Those of every frame, after its name.

    Raises
    ------
    InputError
        If a frame, catalogue or the settings are unusable.
    """
    frames: dict[str, Posterior] = {}
    alone: list[MapEstimate | None] = []
    doubts: list[str] = []
    psfs: dict[str, PSF] = {}  # frames with the PSF of one file have its errors in common
    notes, lines = list[str](), list[str]()
    for own in run.frames.values():
        if repr(own.psf) not in psfs:
            psfs[repr(own.psf)] = build.reference_psf(own, run_file)
        with naming(run_file):  # before minutes have gone by
            refuse_nodes(psfs[repr(own.psf)])
    for name, own in run.frames.items():
        psf = psfs[repr(own.psf)]
        told = say and partial(_prefixed, say, name)
        try:
            read = pipeline.read_doubted(own, run_file, told, psf=psf)
        except InputError as error:
            raise InputError(f"{error} (frame {name})") from None
        frames[name], estimate, said, why = read
        alone.append(estimate)
        notes += [f"{name}: {line}" for line in said]
        doubts += [f"{name}: {'; '.join(why)}"] if why else []
    with naming(run_file), working(show=say is not None):
        joint = _joint(run, frames)
        start, found = _start(joint, alone), None
        if any(isinstance(frame.model.psf, MeasuredPSF) for frame in frames.values()):
            start = find_map(joint, start).params
            joint = marginalize_joint_psf(joint, start)
        scatters = any(frame.nuisances.position_scatter for frame in frames.values())
        if start is not None or doubts or scatters:
            found = find_map(joint, start)
        if scatters and found is not None:
            joint, found, lines = pipeline.with_displacements(joint, found)
    if say:
        for line in lines:
            say(line)
    return joint, found and pipeline.doubted(found, _named(doubts)), _kept([*notes, *lines])


def _named(doubts: Sequence[str]) -> list[str]:
    """Those of the first frames, and how many more there are."""
    more = len(doubts) - MOST_NAMED
    return [*doubts[:MOST_NAMED], *([f"and {more} more frames"] if more > 0 else [])]


def _prefixed(say: Say, name: str, line: str) -> None:
    say(f"{name}: {line}")


def _joint(run: JointRun, frames: Mapping[str, Posterior]) -> JointPosterior:
    """The posterior of all frames with the drift and the priors of the run file."""
    shared, given, drift = run.joint.shared, run.joint.drift, None
    if given is not None:
        terms = given.terms
        if terms is None:
            plain = JointPosterior(frames, shared)
            kinds = zip(plain.shared, plain.parameters, strict=False)
            terms = tuple(name for name, p in kinds if p.kind == "distortion")
        drift = Drift(run.times, terms, given.walk)
    return JointPosterior(frames, shared, prior=build.priors_given(run), drift=drift)


def _start(joint: JointPosterior, alone: Sequence[MapEstimate | None]) -> Floats | None:
    """Where to begin, from the maxima of the frames alone; None where not all are known.

    Shared parameters have the frames' mean, weighted with its information; own ones move with them
    along their correlation.
    """
    count = len(joint.shared)
    weights, weighted = np.zeros((count, count)), np.zeros(count)
    for part, estimate in zip(joint.parts, alone, strict=True):
        if estimate is None:
            return None
        common = np.flatnonzero(part.columns < count)
        weight = inverse(estimate.covariance[np.ix_(common, common)])
        columns = part.columns[common]
        weights[np.ix_(columns, columns)] += weight
        weighted[columns] += weight @ estimate.params[common]
    start = joint.start()
    start[:count] = inverse(weights) @ weighted
    for part, estimate in zip(joint.parts, alone, strict=True):
        assert estimate is not None, "seen above"
        common = np.flatnonzero(part.columns < count)
        cross = estimate.covariance[np.ix_(part.places, common)]
        moved = inverse(estimate.covariance[np.ix_(common, common)]) @ (
            start[part.columns[common]] - estimate.params[common]
        )
        start[part.own] = estimate.params[part.places] + cross @ moved
    start = np.clip(start, *joint.support)
    return start if np.isfinite(joint.log_prob(start)) else None


def _kept(notes: Sequence[str]) -> list[str]:
    """The notes that a record can hold: of a hundred frames not all."""
    room = LONGEST // (max((len(note.encode()) for note in notes), default=0) or 1)
    if len(notes) <= room:
        return list(notes)
    left = f"{len(notes) - room + 1} more notes are not kept"
    return [*notes[: room - 1], left]


def fit_frames(
    job: Job,
    posterior: JointPosterior,
    estimate: MapEstimate | None,
    how: How,
    *,
    executor: Any | None,
    say: Say | None,
) -> JointResult:
    """Sample or draw from the Laplace approximation, and write the results.

    Parameters
    ----------
    job : Job
    posterior : JointPosterior
    estimate : MapEstimate or None
        Found if None.
    how : How
    executor : PlacedExecutor, or anything with `submit`, or None
        What evaluates the frames, see `RemoteFrames`; this process if None.
    say : callable or None

    Returns
    -------
    JointResult

    Raises
    ------
    InputError
        If the output file exists or cannot be written, or the posterior cannot be sampled.
    """
    beside = files_beside(job.output, posterior.frames)
    remote = executor and posterior.with_evaluator(RemoteFrames(posterior.frames, executor))
    chain = make_chain(job, remote or posterior, estimate, how, beside=beside, say=say)
    chain = replace(chain, density=posterior)
    target = job.run.sampling.target_ess
    return write_joint_results(
        chain, job.output, job.output, target_ess=target, overwrite=how.overwrite, say=say
    )


def files_beside(path: Path, frames: Mapping[str, Posterior | None]) -> tuple[Path, ...]:
    """What is written with a chain of several frames, or with their page.

    Parameters
    ----------
    path : Path
    frames : mapping of str to Posterior or None
        None where a frame has not been read yet.

    Returns
    -------
    tuple of Path
        The page, the picture and the table of sources first.
    """
    files: tuple[Path, ...] = outputs.beside(path)
    for name, frame in frames.items():
        own = outputs.of_frame(path, name)
        files += outputs.beside(own)[:2]
        if frame is not None and isinstance(frame.model.psf, MeasuredPSF):
            files += (outputs.psf_beside(own),)
    return files


def write_joint_results(
    chain: Chain,
    path: Path,
    page: Path,
    *,
    target_ess: float,
    corner: Sequence[str] = (),
    overwrite: bool,
    say: Say | None = None,
) -> JointResult:
    """Judge a chain of several frames; write a page of all and of each, pictures and sources.

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
        Shared parameters to show in pairs; by default chosen.
    overwrite : bool
        Replace files that this run did not make, too.
    say : callable, optional
        Told which frame is reported on.

    Returns
    -------
    JointResult

    Raises
    ------
    InputError
        If a file cannot be written or is another's, or `corner` names what frames do not share.
    """
    posterior: JointPosterior = chain.posterior()
    page, picture, sources = outputs.beside(page)
    shared = chain.parameter_names[: posterior.n_shared]
    shown = corner_parameters(chain.draws()[:, : len(shared)], shared, corner)
    with working("judging the fit", show=say is not None):
        diagnostics = diagnose(chain, target_ess=target_ess)
    if not overwrite:  # asked again, as what was not there may have come while the run was made
        marks.may_replace(chain.identity, *files_beside(page, posterior.frames))
    results = {}
    for name, judged in diagnostics.frames.items():
        if say:
            say(f"{name}: drawing its page")
        alone = replace(chain.frame(name), record=_record_of(chain, name))
        pairs = [parameter for parameter in corner if parameter in alone.parameter_names]
        own = outputs.of_frame(page, name)
        with working("drawing it", show=say is not None):
            result = write_page(
                alone, path, own, diagnostics=judged, corner=pairs, home=page, overwrite=overwrite
            )
        results[name] = replace(result, sources=sources)
    table, estimates = diagnostics.summary(chain), frame_estimates(chain)
    common = _with_corner(table[: len(shared)], results)
    frames = _frame_table(diagnostics, posterior)
    if not overwrite:
        marks.may_replace(chain.identity, page, picture, sources)
    content = png(agreement_plot(estimates, posterior.parameters))
    write_joint_report(
        page,
        chain=chain,
        shared=common,
        diagnostics=diagnostics,
        frames=frames,
        pages={name: result.page for name, result in results.items()},
        figures=joint_figures(chain, estimates, picture=content, shown=shown),
        result=estimates.message,
    )
    atomic.replace(picture, marks.marked(content, chain.identity))
    write_sources(sources, diagnostics, chain.identity)
    return JointResult(
        chain, diagnostics, table, common, frames, estimates.message, path, page, picture, sources,
        results,
    )  # fmt: skip


def _record_of(chain: Chain, name: str) -> RunRecord:
    """What is told of a frame's part of a run."""
    whole, before = chain.record or RunRecord(), f"{name}: "
    notes = tuple(note.removeprefix(before) for note in whole.notes if note.startswith(before))
    title = f"{whole.title}: {name}" if whole.title else name
    return RunRecord(title, f"frame {name}", None, notes, None, whole.made)


def _with_corner(shared: Table, results: Mapping[str, Result]) -> Table:
    """The table of what frames share, with the displacement in the corner of the first frame."""
    first = next(iter(results.values())).summary
    known = {row["name"]: (row["corner"], row["corner_sd"]) for row in first}
    corners = [known.get(name, (np.nan, np.nan)) for name in shared["name"]]
    return make_table(
        {
            **{name: shared[name] for name in shared.colnames},
            **dict(zip(("corner", "corner_sd"), np.array(corners).T, strict=True)),
        }
    )


def _frame_table(diagnostics: Diagnostics, joint: JointPosterior) -> Table:
    """The table of frames, see `JointResult`."""
    found, agreement = diagnostics.frames.values(), diagnostics.agreement
    assert agreement is not None, "several frames were judged"
    drift, posteriors = joint.drift, joint.frames.values()
    times = (
        {} if drift is None else {"time": np.array([drift.times[name] for name in joint.frames])}
    )
    return make_table(
        {
            "frame": list(joint.frames),
            **times,
            "sources": np.array([len(posterior.model.sources) for posterior in posteriors]),
            "pixels": np.array([d.n_pixels for d in found]),
            "deviance_z": np.array([misfit(vars(d), "deviance") for d in found]),
            "fits_data": np.array([d.fits_data for d in found]),
            "agreement_p": agreement.p,
            "agrees": np.array([name not in agreement.odd for name in joint.frames]),
        }
    )
