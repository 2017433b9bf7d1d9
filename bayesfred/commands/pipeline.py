"""The steps that commands share: read a frame, fit it, report.

Nothing is printed. What should be known while a step works goes to `say`, one line at a time.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bayesfred import build, settings
from bayesfred._typing import Floats
from bayesfred.analysis.causes import find_causes
from bayesfred.analysis.choose_terms import choose_terms
from bayesfred.analysis.displacements import (
    SomePosterior,
    displacement_lines,
    marginalize_displacements,
)
from bayesfred.analysis.failed_sources import leave_out_failed
from bayesfred.build import naming
from bayesfred.commands.records import Result
from bayesfred.commands.results import How, Job, Say, make_chain, write_results
from bayesfred.errors import InputError
from bayesfred.imaging.psf import PSF, MeasuredPSF, PSFToMeasure, has_pixel
from bayesfred.io import outputs, paths
from bayesfred.io.frames import FrameRecord
from bayesfred.io.pixel_maps import read_mapped_frame
from bayesfred.model.noise import Noise
from bayesfred.model.posterior import Posterior
from bayesfred.model.psf_errors import refuse_nodes
from bayesfred.optimize.alternating import alternating_message
from bayesfred.optimize.dark_marks import dark_marks_message
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import MOSTLY_REJECTED, approach, find_map, reject_outliers
from bayesfred.optimize.follow import followed_images
from bayesfred.optimize.hot_pixels import hot_pixels, pixels_named
from bayesfred.optimize.image_widths import image_widths
from bayesfred.optimize.local_background import background_message, subtract_background
from bayesfred.optimize.measure_psf import marginalize_psf, measure_psf, psf_message
from bayesfred.optimize.outliers import BREAKDOWN, share_lost
from bayesfred.optimize.uncatalogued import find_uncatalogued
from bayesfred.optimize.wings import wings_outside
from bayesfred.sampling.progress import working
from bayesfred.sources import bright, find_sources

__all__ = ["doubted", "fit_frame", "read_doubted", "read_frame", "with_displacements"]

DARKEST = 1e-3  # counts per pixel of a background to begin with
ANOTHER = 2.0  # times the frame's own width: a start that is farther off is not used


def read_frame(
    run: settings.RunSettings, run_file: Path, say: Say | None, *, psf: PSF | None = None
) -> tuple[Posterior, MapEstimate | None, list[str]]:
    """Read the frame of a run file; reject outliers and choose terms if it asks for that.

    Parameters
    ----------
    run : RunSettings
    run_file : Path
    say : callable, optional
        Told every note at once.
    psf : PSF, optional
        That of [psf], where it is at hand.

    Returns
    -------
    posterior : Posterior
    estimate : MapEstimate or None
        Its maximum, if outliers were rejected or terms chosen, positions scatter, or where there
        are doubts: then the model does not fit, and the message says why.
    notes : list of str
        What was read, what was removed, and what was chosen.

    Raises
    ------
    InputError
        If frame, catalogue or settings are unusable.
    """
    posterior, estimate, notes, doubts = read_doubted(run, run_file, say, psf=psf)
    lines, scatters = list[str](), posterior.nuisances.position_scatter
    with naming(run_file), working(show=say is not None):
        if estimate is None and (doubts or scatters):
            estimate = find_map(posterior)
        if scatters and estimate is not None:
            posterior, estimate, lines = with_displacements(posterior, estimate)
    if say:
        for line in lines:
            say(line)
    return posterior, estimate and doubted(estimate, doubts), [*notes, *lines]


def with_displacements(
    posterior: SomePosterior, estimate: MapEstimate
) -> tuple[SomePosterior, MapEstimate, list[str]]:
    """Put displacements that neighbouring sources have in common into the errors.

    Parameters
    ----------
    posterior : Posterior or JointPosterior
        With positions that scatter.
    estimate : MapEstimate
        Its maximum.

    Returns
    -------
    posterior : Posterior or JointPosterior
    estimate : MapEstimate
        The same, with the wider errors.
    lines : list of str
        What is said of that; none where there are no such displacements.
    """
    if not estimate.at_maximum:
        return posterior, estimate, []
    widened = marginalize_displacements(posterior, estimate)
    errors = widened.displacement_errors
    if errors is None:
        return widened, estimate, []
    lines = displacement_lines(widened, estimate.covariance)
    return widened, replace(estimate, covariance=estimate.covariance + errors.covariance), lines


def doubted(estimate: MapEstimate, doubts: Sequence[str]) -> MapEstimate:
    """A maximum that does not fit if there are doubts, which its message says.

    Parameters
    ----------
    estimate : MapEstimate
    doubts : sequence of str

    Returns
    -------
    MapEstimate
    """
    new = [doubt for doubt in doubts if doubt not in estimate.message]
    message = "; ".join([estimate.message, *new])
    return replace(estimate, message=message, fits_data=estimate.fits_data and not doubts)


def read_doubted(
    run: settings.RunSettings, run_file: Path, say: Say | None, *, psf: PSF | None = None
) -> tuple[Posterior, MapEstimate | None, list[str], list[str]]:
    """Read the frame of a run file as `read_frame` does, and say apart what no residuals show.

    Parameters
    ----------
    run : RunSettings
    run_file : Path
    say : callable, optional
    psf : PSF, optional

    Returns
    -------
    posterior : Posterior
    estimate : MapEstimate or None
        Its maximum, if outliers were rejected or terms chosen.
    notes : list of str
    doubts : list of str
        Why parameters may be wrong although the model fits: another pose fits as well, or most of
        the sources were rejected.

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
    maps = build.maps_given(run, run_file)
    frame = read_mapped_frame(
        path, maps, gain=f.gain, pedestal=f.pedestal, saturation=f.saturation, name=f.name
    )
    noise, line = build.noise_given(run, run_file, maps, frame.read_noise)
    warnings = [
        tell(frame.counts, frame.valid) for tell in (alternating_message, dark_marks_message)
    ]
    note(frame.description, line, *warnings)
    psf = psf or _reference_psf(run, run_file)
    psf, frame, lines = _by_its_peaks(run, psf, frame, noise)
    note(*lines)
    with working("finding the sources", show=say is not None):
        sources, lines, ambiguous = find_sources(run, run_file, frame.counts.shape, psf, frame)
    note(*lines)
    counts, noise = bright(run, run_file, frame, noise)
    with naming(run_file):
        model = build.forward_model(run, frame.counts.shape, sources, psf)
        posterior = build.posterior_given(run, model, counts, frame.valid, noise)
        estimate, rough = None, isinstance(psf, PSFToMeasure)
        if posterior.nuisances.footprint is not None:
            with working(show=say is not None):
                posterior, estimate, lines = _follow(posterior, f.background_scale, rough=rough)
            note(*lines)
        given = posterior
        if f.reject_outliers:
            with working(show=say is not None):
                start = None if estimate is None else estimate.params
                reject = partial(approach, rejecting=True) if rough else reject_outliers
                kept, estimate = reject(posterior, start)
            note(_census(posterior, kept))
            posterior = kept
        if run.distortion.terms == "choose":
            with working(show=say is not None):
                choice = choose_terms(posterior)
            posterior, estimate = choice.posterior, choice.estimate
            note(*choice.lines())
        if has_pixel(posterior.model.psf) or rough:
            with working("measuring the PSF", show=say is not None):
                posterior, estimate, lines = _with_measured_psf(posterior, estimate, psf, run)
            note(*lines)
        if f.reject_outliers and estimate is not None:
            with working("testing the sources", show=say is not None):
                posterior, estimate, line = leave_out_failed(posterior, estimate)
            note(line)
    doubts = [_rejected(given, posterior, estimate), ambiguous]
    return posterior, estimate, notes, list(filter(None, doubts))


def _reference_psf(run: settings.RunSettings, run_file: Path) -> PSF:
    """The PSF of [psf], unless it lacks errors that a fit has to know."""
    psf = build.reference_psf(run, run_file)
    if isinstance(psf, MeasuredPSF):
        with naming(run_file):
            refuse_nodes(psf)
    return psf


def _by_its_peaks(
    run: settings.RunSettings, psf: PSF, frame: FrameRecord, noise: Noise
) -> tuple[PSF, FrameRecord, list[str]]:
    """The PSF to measure with about the width of the frame's images, and no pixels that are hot.

    Searches with a far narrower PSF find no images, and a search among many hot pixels others.
    """
    lines: list[str] = []
    if run.catalogue.grid is not None and run.catalogue.grid.marks == "dots":
        return psf, frame, lines
    if run.frame.reject_outliers:
        hot = hot_pixels(frame.counts, frame.valid, noise)
        frame = replace(frame, valid=frame.valid & ~hot)
        lines += [f"hot pixels or cosmic rays: {pixels_named(hot)}, masked"] if hot.any() else []
    if isinstance(psf, PSFToMeasure):
        widths = image_widths(np.where(frame.valid, frame.counts, np.nan))
        if widths and not widths.low / ANOTHER < psf.sigma < widths.high * ANOTHER:
            lines.append(
                f"psf: sigma {psf.sigma:g} is not that of the brightest images, "
                f"{widths.typical:.2g} pixels, which is the start in its place"
            )
            psf = replace(psf, sigma=widths.typical)
    return psf, frame, lines


def _follow(
    posterior: Posterior, scale: float | None, *, rough: bool
) -> tuple[Posterior, MapEstimate, list[str]]:
    """Footprints around the images, without sources that the catalogue lacks; the maximum."""
    followed, near = followed_images(posterior)
    shared = int(np.sum(followed.mask & posterior.mask))
    lines = [
        f"footprints: {followed.mask.sum()} pixels around the images, {shared} of which are as "
        "near to the catalogue's positions"
    ]
    estimate = approach(followed, near)[1] if rough else find_map(followed)
    wings = wings_outside(followed, estimate.params)
    if wings is not None:
        lines.append(f"footprints: {wings.sentence}: {wings.remedy}")
    if scale is not None:
        even = subtract_background(followed, estimate, scale)
        light = followed.counts - even.counts
        start = _darker(followed, estimate.params, light)
        estimate = approach(even, start)[1] if rough else find_map(even, start)
        lines.append(
            f"background: structure of up to {light[even.mask].max():.3g} counts a pixel, measured "
            f"outside the footprints at every {scale:g} pixels, subtracted"
        )
        followed = even
    elif wings is None:
        lines.append(background_message(followed, estimate.params))
    found = find_uncatalogued(followed, estimate)
    if lost := int(np.sum(followed.mask & ~found.mask)):
        lines.append(f"{found.message}; {lost} pixels masked")
        followed = replace(followed, mask=found.mask, extrapolation=None)
        start = estimate.params
        estimate = approach(followed, start)[1] if rough else find_map(followed, start)
    return followed, estimate, lines


def _darker(posterior: Posterior, params: Floats, light: Floats) -> Floats:
    """Parameters whose background is a constant: about what it is without some light."""
    rest = (posterior.likelihood.background(params) - light)[posterior.mask].mean()
    terms = [name.startswith("background") for name in posterior.parameter_names]
    darker = np.where(terms, 0.0, params)
    darker[posterior.parameter_names.index("background")] = max(rest, DARKEST)
    return darker


def _with_measured_psf(
    posterior: Posterior, estimate: MapEstimate | None, psf: PSF, run: settings.RunSettings
) -> tuple[Posterior, MapEstimate, list[str]]:
    """The posterior with the errors of its PSF, which is measured first if that is asked for."""
    estimate = estimate or find_map(posterior)
    if isinstance(psf, PSFToMeasure):
        try:
            measured, estimate = measure_psf(
                posterior, estimate, oversampling=psf.oversampling, degree=psf.degree,
                nodes=psf.nodes, model_error=run.nuisances.model_error,
                prior=build.priors_given(run), reject_outliers=run.frame.reject_outliers,
            )  # fmt: skip
        except InputError as error:
            others = _other_causes(posterior, estimate, run.frame.reject_outliers)
            raise InputError(f"{error}{others}") from None
    else:
        measured = marginalize_psf(posterior, estimate)
        estimate = find_map(measured, estimate.params)
    lost = posterior.mask & ~measured.mask
    line = f"not explained by the PSF: {pixels_named(lost)}, masked" if lost.any() else ""
    return measured, estimate, [line, psf_message(measured, estimate)]


def _other_causes(posterior: Posterior, estimate: MapEstimate, rejected: bool) -> str:
    """What else is wrong than the PSF, where none could be measured, and what to do about it."""
    causes = find_causes(posterior, estimate.params, rejected=rejected)
    for cause in causes:
        if cause.name != "PSF":
            return f". Or it is the {cause.name}: {cause.sentence}: {cause.remedy}"
    return ""


def _rejected(given: Posterior, kept: Posterior, estimate: MapEstimate | None) -> str:
    """What is said where most of the sources were rejected on the way to a maximum."""
    if estimate is None or share_lost(given, kept, estimate.params) <= BREAKDOWN:
        return ""
    return MOSTLY_REJECTED


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
    how: How = How(),
    *,
    say: Say | None,
) -> Result:
    """Find the maximum, sample or draw from the Laplace approximation, and write the results.

    Parameters
    ----------
    job : Job
    posterior : Posterior
    estimate : MapEstimate, optional
        Found if not given.
    how : How
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
    beside: tuple[Path, ...] = outputs.beside(job.output)
    if isinstance(posterior.model.psf, MeasuredPSF):
        beside += (outputs.psf_beside(job.output),)
    chain = make_chain(job, posterior, estimate, how, beside=beside, say=say)
    target = job.run.sampling.target_ess
    return write_results(
        chain, job.output, job.output, target_ess=target, overwrite=how.overwrite, say=say
    )
