"""What dithered frames show beside the sources that are fitted, and sources that do not fit.

A blend of two stars, something that moves or is no point would be fitted at the others' cost. Such
sources are found near the maximum by the deviance of their pixels and the scatter of their images,
and left out of all frames, with the pixels that they light. If most sources deviate it is the model
that is wrong: only those count that deviate several times more than the median, and no more than a
fifth are left out.

Light that no source explains is masked frame by frame, as `optimize.outliers` does in a single one;
a source that lacks its light in a frame is taken off that frame. Sources of fewer than two frames
are left out.
"""

from dataclasses import replace

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.calibration.dither_tables import source_summary
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import ForwardModel
from bayesfred.model.dithered import DitheredPosterior
from bayesfred.model.pixels import footprints
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.outliers import reject_once

__all__ = ["lit_pixels", "without_outliers"]

ROUNDS = 4
STEPS = 8  # of Newton's method before each
MOST = 0.2  # share of the sources that may be left out
BEYOND = 5.0  # medians of the sources' deviations beyond which one is left out
CORE = 2.5  # widths from a source's image within which pixels are its own
FAINT = 0.1  # of the noise of the background: light that may remain
SHARES = (1e-4, 0.3)  # of a peak, down to which its light is masked


def without_outliers(
    posterior: DitheredPosterior, start: Floats
) -> tuple[DitheredPosterior, Floats, Floats]:
    """A posterior of what fits, near its maximum.

    Parameters
    ----------
    posterior : DitheredPosterior
    start : ndarray, shape (d,)

    Returns
    -------
    posterior : DitheredPosterior
    params : ndarray, shape (d',)
    rejected : ndarray, shape (k, 2), fine pixel
        Where sources stood that were left out.
    """
    rejected, most = np.zeros((0, 2)), MOST * posterior.layout.n_sources
    masks = {name: frame.mask for name, frame in posterior.frames.items()}
    for _ in range(ROUNDS):
        near = maximize(posterior, start, steps=STEPS)
        start, none = near.params, np.zeros(posterior.layout.n_sources)
        table = source_summary(posterior, start, near.covariance, none)
        z = np.fmax(np.array(table["chi2_z"]), np.array(table["place_z"]))
        failed = np.array(table["failed"], dtype=bool) & (z > BEYOND * np.nanmedian(np.abs(z)))
        if failed.sum() + len(rejected) > most:
            failed[:] = False
        before = posterior
        posterior, start, gone = _reduced(posterior, start, failed, masks)
        rejected = np.concatenate([rejected, gone])
        if not len(gone) and all(
            np.array_equal(frame.mask, before.frames[name].mask)
            and len(frame.model.sources) == len(before.frames[name].model.sources)
            for name, frame in posterior.frames.items()
        ):
            break
    return posterior, start, rejected


def _reduced(
    posterior: DitheredPosterior, params: Floats, dropped: Flags, masks: dict[str, Flags]
) -> tuple[DitheredPosterior, Floats, Floats]:
    """A posterior without some sources and what they light, and without foreign light.

    `masks` are the pixels before, without those of sources that were left out earlier, and change.
    Returns the parameters, and where the sources stood, too.
    """
    layout = posterior.layout
    frames: dict[str, Posterior] = {}
    while True:
        members, count = {}, np.zeros(layout.n_sources, dtype=np.int64)
        for name in posterior.frames:
            rows, own = layout.members[name], layout.frame_params(name, params)
            frame = replace(posterior.frame_posterior(name, params), mask=masks[name])
            out = dropped[rows]
            masks[name] = masks[name] & ~_lit(frame, own, out)
            rest = _part(frame, ~out, masks[name])
            missing = reject_once(rest, own).missing
            rest, rows = _part(rest, ~missing, masks[name]), rows[~out][~missing]
            frames[name], members[name] = _without_light(rest, own), rows
            count[rows[_seen(frames[name], own)]] += 1
        lost = (count < 2) & ~dropped
        if not lost.any():
            break
        dropped = dropped | lost
    number = np.cumsum(~dropped) - 1
    members = {name: number[there] for name, there in members.items()}
    changed = replace(posterior, frames=frames, members=members)
    at = layout.positions(params)
    return changed, np.append(params[: layout.n_dense], at[~dropped]), at[dropped]


def _without_light(frame: Posterior, own: Floats) -> Posterior:
    """A frame's posterior without pixels that hold other light, as far as no source is there.

    What a wrong PSF leaves of a source is no reason to mask it.
    """
    clean = reject_once(frame, own).posterior.mask
    images = frame.likelihood.image_positions(own)
    images = images[np.isfinite(images).all(axis=1)]
    near = footprints(frame.model.detector, images, CORE * frame.model.psf.sigma)
    return replace(frame, mask=frame.mask & (clean | near))


def _seen(frame: Posterior, own: Floats) -> Flags:
    """Which of a frame's sources have their image on a pixel that is used."""
    detector, at = frame.model.detector, frame.likelihood.image_positions(own)
    shape = np.array(detector.shape[::-1])
    pixel = np.rint(at / detector.binning + 0.5 * (shape - 1.0))
    seen = np.asarray(((pixel >= 0.0) & (pixel < shape)).all(axis=1))
    column, row = pixel[seen].astype(int).T
    seen[seen] = frame.mask[row, column]
    return seen


def _part(frame: Posterior, kept: Flags, mask: Flags) -> Posterior:
    """A frame's posterior of some of its sources and pixels."""
    s = frame.model.sources
    model = replace(frame.model, sources=SourceCatalog(s.x[kept], s.y[kept], s.flux[kept]))
    return replace(frame, model=model, mask=mask)


def _lit(frame: Posterior, own: Floats, some: Flags) -> Flags:
    """Pixels that some of a frame's sources light."""
    level = own[frame.parameter_names.index("background")]
    variance = frame.noise_at(own).counts_variance(frame.likelihood.background(own), level)
    images = frame.likelihood.image_positions(own)[some]
    noise = float(np.sqrt(np.median(variance)))
    return lit_pixels(frame.model, images, frame.fluxes(own)[some], noise)


def lit_pixels(model: ForwardModel, images: Floats, fluxes: Floats, noise: float) -> Flags:
    """Pixels in which sources exceed a tenth of the background's noise.

    Parameters
    ----------
    model : ForwardModel
    images : ndarray, shape (n, 2), fine pixel
        Where they are imaged; nan where they are not.
    fluxes : ndarray, shape (n,), counts
    noise : float, counts
        Standard deviation of a pixel without light.

    Returns
    -------
    ndarray of bool, shape (ny, nx)
    """
    detector, psf = model.detector, model.psf
    out = np.zeros(detector.shape, bool)
    for at, flux in zip(images, fluxes, strict=True):
        height = flux * psf.peak * detector.binning**2
        radius = psf.support_radius(float(np.clip(FAINT * noise / height, *SHARES)))
        out |= footprints(detector, at[None], radius + 0.5 * detector.binning)
    return out
