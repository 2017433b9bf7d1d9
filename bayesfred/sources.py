"""From `[catalogue]` and `[sky]` to the sources of a frame, in pixels from its middle.

A catalogue has positions on the object plane, or directions on the sky; a target's grid is indexed
from the frame. In the second case
`[sky]` or the frame's header gives a guess of the pointing, which `optimize.pose` refines by the
stars of the frame. A frame that is still to be simulated has none: there the guess is the truth.
"""

import math
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from bayesfred import settings
from bayesfred._typing import Floats
from bayesfred.errors import InputError, printable
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import require_image
from bayesfred.imaging.psf import PSF
from bayesfred.io.catalogues import SkyRecord, read_catalogue, read_sky_catalogue
from bayesfred.io.frames import FrameRecord
from bayesfred.io.paths import resolve
from bayesfred.io.tangent_plane import ARCSEC, Parity, TangentPlane
from bayesfred.model.noise import GaussianNoise, Noise, PoissonNoise
from bayesfred.optimize.grid_marks import invert_dots
from bayesfred.optimize.grid_target import GridTarget, index_grid
from bayesfred.optimize.peaks import bright_peaks, typical_flux
from bayesfred.optimize.pose import find_pose

__all__ = ["bright", "find_sources"]

# Share of the frame's half-width by which images may stand away from their sources: three standard
# deviations of a term's default prior. Sources whose light is farther from the frame than that are
# left out.
STRAY = 0.3


def find_sources(
    run: settings.RunSettings,
    run_file: Path,
    shape: tuple[int, int],
    psf: PSF,
    frame: FrameRecord | None = None,
) -> tuple[SourceCatalog, list[str], str]:
    """The catalogue's sources whose light can reach the frame.

    A source is at the edge if the frame's border is within three widths of the PSF, or between it
    and the frame; and outside if no light reaches the frame from an image that stands `STRAY`
    nearer. If all are outside, all are kept: the posterior says so. Where fluxes are free and the
    catalogue has none, all begin at the mean flux of the frame's brightest peaks.

    Parameters
    ----------
    run : RunSettings
    run_file : Path
    shape : (int, int), recorded pixel
        Rows and columns of the frame.
    psf : PSF
    frame : FrameRecord, optional
        None where it is still to be simulated.

    Returns
    -------
    sources : SourceCatalog
    notes : list of str
        Where the frame points, if that was searched for, and how many sources there are.
    ambiguous : str
        Which other poses of the frame fit alike; empty where there is none.

    Raises
    ------
    InputError
        If the catalogue cannot be used, or the frame's pose is not found.
    """
    c, ny, nx = run.catalogue, *(run.detector.binning * side for side in shape)
    require_image(psf.sigma, (ny, nx), f"{run_file}: ")
    if c.path is None:
        return _target(run, run_file, psf, frame)
    path = resolve(c.path, run_file, must_exist=True)
    free = frame is not None and run.nuisances.flux == "free"
    column = None if free and "flux" not in c.model_fields_set else c.flux
    binning = run.detector.binning
    width = math.hypot(psf.sigma / binning, 12.0**-0.5)
    sky, notes, ambiguous = None, [], ""
    if c.ra is None or c.dec is None:
        record = read_catalogue(
            path, x=c.x, y=c.y, flux=column, magnitude=c.magnitude, zero_point=c.zero_point
        )
        x, y, flux = record.x, record.y, record.flux
    else:
        motion = None if c.pm_ra is None or c.pm_dec is None else (c.pm_ra, c.pm_dec)
        date = run.sky.date or (frame.date if frame else None)
        stars = read_sky_catalogue(
            path, ra=c.ra, dec=c.dec, flux=column, magnitude=c.magnitude,
            zero_point=c.zero_point, motion=motion, epoch=c.epoch or 2000.0, date=date,
        )  # fmt: skip
        sky, line, ambiguous = _plane(run, run_file, shape, width, (stars, frame))
        notes += [line] if line else []
        x, y = sky.to_plane(stars.ra, stars.dec)
        seen = np.isfinite(x)
        x, y, flux = x[seen], y[seen], stars.flux[seen]
    half = 0.5 * binning * np.array(shape)[::-1, None]
    beyond = np.abs([x, y]) - half  # pixels, negative inside
    outside = (beyond > psf.support_radius(run.model.tolerance) + STRAY * half).any(axis=0)
    kept = ~outside if not outside.all() else outside
    at_edge = kept & (beyond > -3.0 * psf.sigma).any(axis=0)
    numbers = (
        f"{len(x)} sources, {at_edge.sum()} at the frame's edge, {(~kept).sum()} outside removed"
    )
    if frame is not None and np.isnan(flux).all():
        inside = int((beyond < 0.0).all(axis=0).sum())
        flux = np.full_like(flux, typical_flux(frame.counts, frame.valid, width, max(inside, 1)))
        numbers += f"; without fluxes, which are free and begin at {flux[0]:.3g} counts"
    sources = SourceCatalog(x[kept], y[kept], flux[kept], sky)
    return sources, [*notes, f"{printable(path.name)}: {numbers}"], ambiguous


def _target(
    run: settings.RunSettings, run_file: Path, psf: PSF, frame: FrameRecord | None
) -> tuple[SourceCatalog, list[str], str]:
    """The marks of a target that the frame shows."""
    grid, binning = run.catalogue.grid, run.detector.binning
    if frame is None or grid is None:
        raise InputError(
            f"{run_file}: catalogue.grid: got a target to be indexed from a frame that is still to "
            "be simulated, expected [simulation.grid] and catalogue.path"
        )
    if run.nuisances.flux != "free":
        raise InputError(
            f"{run_file}: nuisances.flux: got {run.nuisances.flux!r}, expected 'free' with "
            "catalogue.grid, as the marks' fluxes are known roughly only"
        )
    target = GridTarget(grid.rows, grid.columns, grid.pitch, grid.layout, grid.marks)
    width = math.hypot(psf.sigma / binning, 12.0**-0.5)
    try:
        found = index_grid(frame.counts, frame.valid, target, width)
    except InputError as error:
        raise InputError(f"{run_file}: catalogue.{error}") from None
    flux = np.maximum(found.flux, 1.0)
    sources = SourceCatalog(binning * found.x, binning * found.y, flux)
    notes = [f"grid: {found.message}"]
    if grid.marks == "dots":
        notes.append("dots: counts inverted, twice the white level less the counts")
    # positions are in the frame's own axes, whichever row of the target is called the first
    return sources, notes, ""


def bright(
    run: settings.RunSettings, run_file: Path, frame: FrameRecord, noise: Noise
) -> tuple[Floats, Noise]:
    """The counts to fit: as they are, or inverted for dark dots, with the noise of the frame.

    Parameters
    ----------
    run : RunSettings
    run_file : Path
    frame : FrameRecord
    noise : Noise
        That of [noise].

    Returns
    -------
    counts : ndarray, shape (ny, nx), counts
    noise : Noise

    Raises
    ------
    InputError
        If dots are dark and [noise] names another noise than Poisson's.
    """
    if run.catalogue.grid is None or run.catalogue.grid.marks != "dots":
        return frame.counts, noise
    if not isinstance(noise, PoissonNoise):
        raise InputError(
            f"{run_file}: noise: got {type(noise).__name__} with marks = 'dots', expected kind = "
            "'poisson', whose read noise is used, and no frame.flat"
        )
    counts, variance = invert_dots(frame.counts, frame.valid)
    return counts, GaussianNoise(variance + noise.read_noise**2)


def _plane(
    run: settings.RunSettings,
    run_file: Path,
    shape: tuple[int, int],
    width: float,
    seen: tuple[SkyRecord, FrameRecord | None],
) -> tuple[TangentPlane, str, str]:
    """The object plane of a frame on the sky, in fine pixels, in words, and others that fit."""
    s, (stars, frame), binning = run.sky, seen, run.detector.binning
    angle, parity = s.position_angle, s.parity
    if s.pointing is not None and s.pixel_scale is not None:
        guess = _pointing(s.pointing, s.pixel_scale / binning, angle or 0.0, parity or "sky")
    elif frame is not None and frame.sky is not None:
        (a, b), (c, d) = (tuple(entry / binning for entry in row) for row in frame.sky.matrix)
        guess = replace(frame.sky, matrix=((a, b), (c, d)))
    else:
        raise InputError(
            f"{run_file}: sky: got neither a pointing nor a coordinate system in the frame's "
            "header, expected one for a catalogue with ra and dec: give sky.pointing and "
            "sky.pixel_scale"
        )
    if frame is None:
        return guess, "", ""
    peaks, heights = bright_peaks(frame.counts, frame.valid, width)
    flux = np.where(np.isfinite(stars.flux), stars.flux, 1.0)
    fine: tuple[int, int] = (shape[0] * binning, shape[1] * binning)
    find = partial(
        find_pose, binning * peaks, (stars.ra, stars.dec, flux), guess, fine, heights=heights
    )
    try:
        pose = find(angle=angle, parity=parity)
    except InputError as error:
        raise InputError(f"{run_file}: {error}") from None
    if pose.ambiguous and s.pointing is None:  # a header that is right knows the angle, too
        with suppress(InputError):
            angle = guess.position_angle if angle is None else angle
            pose = find(angle=angle, parity=parity or guess.parity)
    lines = (pose.message, pose.ambiguous)
    return pose.plane, "; ".join(filter(None, lines)), pose.ambiguous


def _pointing(
    pointing: tuple[float, float], scale: float, angle: float, parity: Parity
) -> TangentPlane:
    """The plane of a pointing (degree), a scale (arcsecond per pixel) and an angle (degree)."""
    sin, cos = (scale / ARCSEC * f(math.radians(angle)) for f in (math.sin, math.cos))
    right = -1.0 if parity == "sky" else 1.0  # where x grows, seen with north up
    return TangentPlane(*pointing, ((right * cos, sin), (-right * sin, cos)))
