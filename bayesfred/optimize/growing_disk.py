"""The likelihood maximised on a growing disk, where stars cannot be matched one by one.

Where stars overlap or are too faint, the likelihood itself goes outward: it is maximised on a disk
around the axis that grows as far as the last maximum predicts stars within the PSF's width, and
with a wider PSF, on a blurred frame, where even the innermost are predicted less surely. From every
disk only the positions of its stars are taken over, under the prior. The searches on the way leave
out unmatched sources and spurious detections, see `outliers`.
"""

from dataclasses import replace

import numpy as np
from scipy import ndimage

from bayesfred._typing import Flags, Floats
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.parameters import SCALES
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.matching import CENTROID, FEWEST, Field
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.outliers import COARSE, STEPS, reject_once

PREDICTED = 0.7  # the likelihood finds a star that is predicted to this many PSF widths


def maximize_outward(field: Field, params: Floats) -> Floats:
    """Maximise on disks around the axis.

    Each extends as far as the one before predicts stars within the PSF's width.
    """
    posterior, params = field.posterior, params.copy()
    sigma = posterior.model.psf.sigma
    pixels = np.hypot(*np.meshgrid(*posterior.model.detector.pixel_centres()))
    covariance, radius, width = np.diag(field.scale**2), 0.0, np.inf
    while radius < pixels.max() or width > sigma:
        predicted = field.predict(params[field.columns])
        spread = field.spread(field.everyone, predicted, covariance)
        distance = np.hypot(*predicted.T)
        innermost = np.sort(distance)[: min(FEWEST, distance.size)].max() + 2.0 * sigma
        radius = max(
            distance[spread > PREDICTED * sigma].min(initial=np.inf), 1.15 * radius, innermost
        )
        inside = distance < radius
        width = max(sigma, min(spread[inside].max() / PREDICTED, 0.7 * width))
        disk = posterior.mask & (pixels < radius)
        if not disk.any():
            continue
        part = _part(posterior, distance < radius + 4.0 * width, disk, width)
        names = part.parameter_names
        shared = [k for k, name in enumerate(posterior.parameter_names) if name in names]
        index = [part.parameter_names.index(posterior.parameter_names[k]) for k in shared]
        begin, background = part.start(), part.parameter_names.index("background")
        begin[index] = np.clip(params, *posterior.support)[shared]
        begin[background] = part.start()[background]
        begin = with_density(part, begin, part.start())
        if not np.isfinite(part.log_prob(begin)):
            break
        top = maximize(reject_once(part, begin, COARSE).posterior, begin, steps=STEPS)
        if not np.isfinite(top.distance):
            break
        params[shared], columns = top.params[index], [index[shared.index(k)] for k in field.columns]
        # photons measure bright stars better than the model is right: no star counts for more than
        # a centroid
        sources, positions = field.everyone[inside], field.predict(params[field.columns])[inside]
        params[field.columns], error = field.fit(sources, positions, CENTROID * width)
        covariance = top.covariance[np.ix_(columns, columns)] + error
    return params


def _part(posterior: Posterior, sources: Flags, pixels: Flags, width: float) -> Posterior:
    """The posterior of some sources in some pixels, the frame blurred to a PSF width."""
    model, s = posterior.model, posterior.model.sources
    blur = np.sqrt(width**2 - model.psf.sigma**2) / model.detector.binning
    few = replace(s, x=s.x[sources], y=s.y[sources], flux=s.flux[sources])
    flux = posterior.nuisances.flux
    return Posterior(
        replace(model, sources=few, psf=GaussianPSF(width) if blur > 0 else model.psf),
        ndimage.gaussian_filter(posterior.counts, blur, output=np.float64)
        if blur > 0
        else posterior.counts,
        prior={name: prior for name, prior in posterior.prior.items() if name not in SCALES},
        noise=posterior.noise,
        mask=pixels,
        nuisances=replace(
            posterior.nuisances,
            flux="scale" if flux == "free" else flux,
            footprint=None,
            position_scatter=False,
            model_error=False,
        ),
    )


def with_density(posterior: Posterior, params: Floats, plain: Floats) -> Floats:
    """Parameters with density: a distortion that folds is reduced towards none."""
    for _ in range(60):
        if np.isfinite(posterior.log_prob(params)):
            return params
        params = plain + 0.9 * (params - plain)
    return plain
