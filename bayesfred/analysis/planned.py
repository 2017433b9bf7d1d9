"""The information of frames that are planned: source by source, and pointing by pointing.

The frames are free of noise, and their fluxes are the catalogue's, also where they are free. So
nothing here depends on counts.

Sources. With every pixel given to the source whose light dominates there (`folds`), the information
of a frame is a sum over sources: that of source s is of its pixels in the light of all sources,
with the free fluxes of s and of its neighbours eliminated. For fluxes that are not free the sum
over all sources is the information of the frame. Free fluxes are eliminated from each source's
pixels apart, so the sum tells less than the frame: the pixels of a neighbour, which say what its
flux is, are not there. (Their prior counts once for each source, which matters less.)

Pointings. Each frame has nuisances of its own: pointing, background, width and fluxes, and the
linear terms of the distortion, because scale, rotation and shear differ from one pointing to the
next. Terms of degree 2 and higher belong to the instrument and are shared. With the own parameters
o of a frame eliminated under their prior P, it tells

    S = I_ss - I_so (I_oo + P_oo)^-1 I_os

of the shared ones s, and frames add up. The field that they share is known but for a pose: its
derivatives are those of the shared terms less their best fit, over the field, by those of offset
and linear terms, as far as these are parameters.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.analysis.field import FieldPoints, displacement_derivatives
from bayesfred.analysis.folds import fold_sources
from bayesfred.analysis.optimal import Field
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.parameters import SCALES
from bayesfred.model.pixels import footprints
from bayesfred.model.posterior import Posterior

__all__ = [
    "by_pointing",
    "by_source",
    "of_field",
    "planned",
    "selected",
    "shared_field",
    "shared_terms",
    "shifted",
    "without_noise",
]

REACHED = 1e-4  # of the PSF's peak: light of sources beyond does not count among another's pixels


def selected(sources: SourceCatalog, rows: Ints | Flags) -> SourceCatalog:
    """Some rows of a catalogue.

    Parameters
    ----------
    sources : SourceCatalog
    rows : ndarray of int or bool

    Returns
    -------
    SourceCatalog
    """
    return replace(sources, x=sources.x[rows], y=sources.y[rows], flux=sources.flux[rows])


def shifted(sources: SourceCatalog, pointings: Iterable[Floats]) -> SourceCatalog:
    """The sources as they lie in the object plane at one pointing after the other.

    Parameters
    ----------
    sources : SourceCatalog
    pointings : iterable of ndarray, shape (2,), pixel

    Returns
    -------
    SourceCatalog
    """
    x, y = (
        np.concatenate([values + shift for shift in along])
        for values, along in zip((sources.x, sources.y), zip(*pointings, strict=True), strict=True)
    )
    return SourceCatalog(x, y, np.resize(sources.flux, x.size))


def without_noise(posterior: Posterior, params: Floats, sources: SourceCatalog) -> FrameLikelihood:
    """The likelihood of a frame that holds these sources and no noise.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    sources : SourceCatalog

    Returns
    -------
    FrameLikelihood
        Its footprints are around the images.
    """
    p, n = posterior, posterior.nuisances
    frame = replace(
        p.likelihood, model=replace(p.model, sources=sources), mask=p.valid,
        nuisances=replace(n, footprint=None), extrapolation=None,
    )  # fmt: skip
    if n.footprint is not None:
        images = frame.image_positions(params)
        near = footprints(p.model.detector, images, n.footprint)
        frame = replace(frame, mask=p.valid & near)
    # free fluxes would be those of the old counts, and the scales are no part of the mean
    flux = "fixed" if n.flux == "free" else n.flux
    kept = np.array([parameter.name not in SCALES for parameter in p.parameters])
    known = replace(
        frame,
        nuisances=replace(frame.nuisances, flux=flux, position_scatter=False, model_error=False),
        parameters=tuple(q for q, keep in zip(p.parameters, kept, strict=True) if keep),
    )
    return replace(frame, counts=known.expected_counts(params[kept]))


def planned(posterior: Posterior, params: Floats) -> Posterior:
    """The posterior of the frame without noise.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)

    Returns
    -------
    Posterior

    Raises
    ------
    InputError
        If the parameters have no probability density.
    """
    frame = without_noise(posterior, params, posterior.model.sources)
    if not (np.isfinite(frame.counts).all() and np.isfinite(posterior.log_prior(params)).all()):
        raise InputError(
            "params: got parameters that the prior excludes or that fold a source's image, "
            "expected those of a frame that can be: see the start and the prior of each"
        )
    return Posterior(
        frame.model, frame.counts, prior=posterior.prior, noise=posterior.noise, mask=frame.mask,
        nuisances=frame.nuisances, valid=posterior.valid,
    )  # fmt: skip


def by_source(posterior: Posterior, params: Floats) -> tuple[Ints, Floats]:
    """What each source's pixels tell.

    Parameters
    ----------
    posterior : Posterior
        Of a frame without noise.
    params : ndarray, shape (d,)

    Returns
    -------
    seen : ndarray of int, shape (n,)
        The sources whose image is on a pixel of the likelihood.
    information : ndarray, shape (n, d, d)
        Of each about all parameters, without the prior. A pixel is that of the seen source whose
        light dominates there.
    """
    p, frame = posterior, posterior.likelihood
    folds = fold_sources(p, params, len(p.model.sources))
    seen = np.flatnonzero(folds.sources >= 0)
    images, radius = frame.image_positions(params), p.model.psf.support_radius(REACHED)
    u, v = p.model.detector.pixel_centres()
    out = np.zeros((seen.size, params.size, params.size))
    for k, source in enumerate(seen):
        own = folds.pixels == folds.sources[source]
        if own.any():
            across, along = u[own.any(axis=0)], v[own.any(axis=1)]
            low, high = np.array([(across[0], along[0]), (across[-1], along[-1])])
            beyond = np.maximum(np.maximum(low - images, images - high), 0.0)
            near = selected(p.model.sources, np.hypot(*beyond.T) <= radius)
            model = replace(p.model, sources=near)
            out[k] = replace(frame, model=model, mask=own).fisher(params)
    return seen, out


def by_pointing(
    posterior: Posterior, params: Floats, pointings: Floats
) -> tuple[Ints, Floats, Floats]:
    """What frames at several pointings tell of the terms that they share.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    pointings : ndarray, shape (c, 2), pixel
        By how far each displaces the catalogue.

    Returns
    -------
    shared : ndarray of int, shape (m,)
        The shared terms among the parameters.
    prior : ndarray, shape (m, m)
        Their prior information, which counts once.
    information : ndarray, shape (c, m, m)
        Of each frame, own parameters eliminated.

    Raises
    ------
    InputError
        If no term is shared, or a pointing has no image of a source or folds one.
    """
    s = shared_terms(posterior)
    o = np.setdiff1d(np.arange(params.size), s)
    prior, out = posterior.prior_information(params), []
    for pointing in pointings:
        sources = shifted(posterior.model.sources, [pointing])
        told = without_noise(posterior, params, sources).fisher(params)
        at = "({:g}, {:g})".format(*pointing)
        if not np.isfinite(told).all():
            raise InputError(
                f"dithers: got {at}, where the distortion folds a source's image, expected "
                "pointings nearer to the planned one"
            )
        if not np.diag(told)[s].any():
            raise InputError(
                f"dithers: got {at}, where the frame shows no source, expected pixels by which "
                "the catalogue is displaced"
            )
        own = told[np.ix_(o, o)] + prior[np.ix_(o, o)]
        own += np.diag(np.diag(own) == 0.0)  # nothing is known of it, nor does it matter
        through = np.linalg.solve(own, told[np.ix_(o, s)])
        out.append(told[np.ix_(s, s)] - told[np.ix_(s, o)] @ through)
    return s, prior[np.ix_(s, s)], np.array(out)


def shared_terms(posterior: Posterior) -> Ints:
    """The coefficients with a monomial of degree 2 or higher, which frames share.

    Parameters
    ----------
    posterior : Posterior

    Returns
    -------
    ndarray of int
        Among the parameters.

    Raises
    ------
    InputError
        If there is none.
    """
    d = posterior.model.polynomial
    high = np.array([sum(term) > 1 for term in (*d.f_terms, *d.g_terms)])
    if d.basis is not None:
        high = (d.basis[high] != 0.0).any(axis=0)
    table = enumerate(posterior.parameters)
    out = [k for k, q in table if q.kind == "distortion" and high[q.slot]]
    if not out:
        raise InputError(
            "dithers: got a distortion of linear terms, which belong to each frame's pose, "
            "expected one of degree 2 or more, which frames share: plan without pointings"
        )
    return np.array(out)


def of_field(posterior: Posterior, params: Floats, points: FieldPoints) -> Field:
    """The points of a frame that count in averages, with the derivatives there.

    Parameters
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    points : FieldPoints

    Returns
    -------
    Field

    Raises
    ------
    InputError
        If no object is imaged at any of them.
    """
    counted = points.weights > 0.0
    every = displacement_derivatives(posterior, params, points.u[counted], points.v[counted])
    known = np.isfinite(every).all(axis=(1, 2))
    if not known.any():
        raise InputError(
            "params: got a distortion that images no object at any point of the field, expected a "
            "weaker one"
        )
    return Field(every[known], points.weights[counted][known])


def shared_field(posterior: Posterior, field: Field, shared: Ints) -> Field:
    """A field's derivatives by the shared terms, less the pose that fits each of them best.

    Parameters
    ----------
    posterior : Posterior
    field : Field
        By all parameters.
    shared : ndarray of int, shape (m,)

    Returns
    -------
    Field
        By the shared terms.
    """
    moving = [
        k for k, q in enumerate(posterior.parameters)
        if q.kind == "distortion" or q.name.startswith("offset")
    ]  # fmt: skip
    pose = np.setdiff1d(moving, shared)
    flat = field.derivatives.reshape(-1, field.derivatives.shape[2])
    root = np.sqrt(np.repeat(field.weights, 2))[:, None]
    scale = 1.0 / np.sqrt(np.sum((root * flat[:, pose]) ** 2, axis=0))
    fit = np.linalg.lstsq(root * flat[:, pose] * scale, root * flat[:, shared], rcond=None)[0]
    left = flat[:, shared] - flat[:, pose] * scale @ fit
    return Field(left.reshape(-1, 2, shared.size), field.weights)
