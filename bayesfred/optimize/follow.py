"""Footprints around the images of the sources, wherever the distortion puts them.

A `footprint` keeps the likelihood to pixels near the sources, because the frame shows others that
the catalogue lacks. The catalogue's positions are where it begins. Where images stand off these by
more than a part of the radius, the footprints lose their light and gain that of others. So they are
put around the images, the posterior is maximised, and so on until no pixel changes.
"""

from dataclasses import replace

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.model.pixels import footprints
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.starts import find_start

ROUNDS = 10
ENOUGH = 0.9  # of the sources matched near their catalogue positions, all within half the radius
STEPS = 8  # of Newton's method between two moves of the footprints


def follow_images(posterior: Posterior, estimate: MapEstimate | None = None) -> Posterior:
    """Put the footprints around the images of the sources in place of the catalogue's positions.

    Parameters
    ----------
    posterior : Posterior
        With a `footprint` among its nuisances; any other is returned as it is.
    estimate : MapEstimate, optional
        Where the images are to begin with. By default peaks of the whole frame are matched to the
        catalogue, as `find_map` does.

    Returns
    -------
    Posterior
        Its mask has the pixels within the radius of an image at the maximum of its own density; its
        `nuisances.footprint` is None, as the footprints are in the mask.

    Raises
    ------
    InputError
        If no image lies on a valid pixel.

    Examples
    --------
    >>> import bayesfred as bf
    >>> sources = bf.SourceCatalog([-10.0, 20.0], [0.0, 5.0], [1e4, 1e4])
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), sources, bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 0, 0)], g_terms=[]))
    >>> posterior = bf.Posterior(
    ...     model, bf.simulate(model, [0.2], 2.0, seed=1), nuisances=bf.Nuisances(footprint=5.0))
    >>> followed = bf.follow_images(posterior)  # the source at x = 20 is imaged at 20 / 1.2
    >>> u = np.flatnonzero(followed.mask[37]) - 32
    >>> int(u.min()), int(u.max())
    (12, 21)
    """
    if posterior.nuisances.footprint is None:
        return posterior
    return followed_images(posterior, None if estimate is None else estimate.params)[0]


def followed_images(
    posterior: Posterior, start: Floats | None = None
) -> tuple[Posterior, Floats | None]:
    """The posterior as of `follow_images`, and about where its maximum is, if it has density there.

    Parameters
    ----------
    posterior : Posterior
        With a `footprint`.
    start : ndarray, shape (d,), optional

    Returns
    -------
    posterior : Posterior
    params : ndarray, shape (d,), or None
    """
    radius, seen = posterior.nuisances.footprint, set[bytes]()
    assert radius is not None, "there are footprints"
    params = _start(posterior) if start is None else start
    for _ in range(ROUNDS):
        followed = _around(posterior, params, radius)
        key = followed.mask.tobytes()
        if key in seen:
            break
        if not np.isfinite(followed.log_prob(params)):
            return followed, None
        seen.add(key)
        params = maximize(followed, params, steps=STEPS).params
    return followed, params


def _start(posterior: Posterior) -> Floats:
    """Where peaks of the whole frame, or those near the catalogue's positions, match better."""
    near = find_start(posterior)
    s, radius = posterior.model.sources, posterior.nuisances.footprint or 0.0
    images = posterior.likelihood.image_positions(near.params)
    off = np.hypot(images[:, 0] - s.x, images[:, 1] - s.y)
    if near.matched >= ENOUGH * len(s) and np.all(off < 0.5 * radius):
        return near.params
    anywhere = find_start(_within(posterior, posterior.valid))
    return near.params if near.matched > anywhere.matched else anywhere.params


def _around(posterior: Posterior, params: Floats, radius: float) -> Posterior:
    images = posterior.likelihood.image_positions(params)
    near = footprints(posterior.model.detector, images, radius)
    return _within(posterior, posterior.valid & near)


def _within(posterior: Posterior, pixels: Flags) -> Posterior:
    nuisances = replace(posterior.nuisances, footprint=None)
    return replace(posterior, mask=pixels, nuisances=nuisances, extrapolation=None)
