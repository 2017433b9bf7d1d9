"""Wings of the sources beyond their footprints, which a fit takes for background.

Around each image mean counts in rings outside the footprint are compared with those farther out,
where structure of the background is the same. What they exceed these by grows with the source's
flux. What is not in proportion to it, such as that of another source, is left out.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, spatial

from bayesfred._typing import Floats
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.local_background import LARGEST, MAD

MOST, FEWEST = 300, 8  # sources that are looked at, the brightest ones
OUTER = 3.0  # radii of the footprint, to which pixels are looked at
PIXELS = 3  # of a ring, at least
CLIP, ROUNDS = 4.0, 4  # standard deviations at which a source is left out
FAR = 0.75  # of the pixels around the images are nearer than those that they are compared with
SURE = 5.0  # standard deviations of a ring's excess
NOTICEABLE, ENDED = 5.0, 1.0  # standard deviations of the misfit: of all rings, of each
DIMMEST = 1e-3  # counts per pixel of a background
DARK = 1.1  # times as wide a footprint has pixels, too, that tell the background


class Wings(NamedTuple):
    """Light of the sources outside their footprints.

    Attributes
    ----------
    radius : float, pixel
        Of footprints that hold them, as far as a fit would notice.
    is_bound : bool
        Whether there may be more, which cannot be seen.
    counts : float
        A pixel, beside the footprint of a source as bright as their root mean square.
    squares : float
        Their sum, in units of the background's variance: the misfit that they would make.
    """

    radius: float
    is_bound: bool
    counts: float
    squares: float

    @property
    def sentence(self) -> str:
        """What was found."""
        return (
            f"the sources have light outside their footprints, {self.counts:.2g} counts a pixel "
            "beside them, which is taken for background within them"
        )

    @property
    def remedy(self) -> str:
        """What to do."""
        more = ", or more" if self.is_bound else ""
        return f"set nuisances.footprint = {self.radius:.3g}{more}"


def wings_outside(posterior: Posterior, params: Floats) -> Wings | None:
    """The wings that pixels outside the footprints show, if a fit would notice them.

    Parameters
    ----------
    posterior : Posterior
        With its footprints in the mask, as `follow_images` puts them there.
    params : ndarray, shape (d,)

    Returns
    -------
    Wings or None
    """
    outside, step = posterior.valid & ~posterior.mask, float(posterior.model.detector.binning)
    images, flux = posterior.likelihood.image_positions(params) / step, posterior.fluxes(params)
    half = 0.5 * (np.array(outside.shape[::-1]) - 1.0)
    seen = np.all(np.abs(images) < half, axis=1) & (flux > 0.0)
    images, flux = images[seen] + half, flux[seen]
    if outside.size > LARGEST or len(images) < FEWEST or not outside.any():
        return None
    column, row = np.rint(images.T).astype(int)
    radius = float(np.median(ndimage.distance_transform_edt(~outside)[row, column]))
    background = posterior.likelihood.background(params)
    excess = np.where(outside, posterior.counts - background, np.nan)
    brightest = np.argsort(-flux)[:MOST]
    mean, number = _rings(excess, images, brightest, radius)
    # where the fit went wrong it may have none
    level = np.maximum(background, max(np.median(posterior.counts[outside]), DIMMEST))
    variance = posterior.noise_at(params).pixelwise.counts_variance(level, 0.0)
    noise = float(np.median(variance[outside]))
    power = float(np.sum(flux**2))
    spread = (2.0 * np.sum(posterior.mask)) ** 0.5  # of the misfit
    rings: list[tuple[float, float]] = []
    for k in range(mean.shape[1] - 1):
        found, sd = _proportion(flux[brightest], mean[:, [k, -1]], number[:, [k, -1]], noise)
        squares = found**2 * power * 2.0 * np.pi * (radius + k + 0.5) / noise
        if not (found > SURE * sd and squares > ENDED * spread):
            break
        rings.append((found, squares))
    total = sum(squares for _, squares in rings)
    if not total > NOTICEABLE * spread:
        return None
    return Wings(
        radius=float(np.ceil(DARK * (radius + len(rings)))) * step,
        is_bound=len(rings) == mean.shape[1] - 1,
        counts=rings[0][0] * (power / flux.size) ** 0.5,
        squares=total,
    )


def _rings(
    excess: Floats, images: Floats, sources: NDArray[np.intp], radius: float
) -> tuple[Floats, Floats]:
    """Mean and number of the pixels of every source's rings, a pixel wide; the last has the rest.

    A pixel belongs to the nearest image; rings are those within which most of the pixels lie.
    """
    tree, reach = spatial.cKDTree(images), OUTER * radius
    ring, source, value = [], [], []
    for n, (x, y) in enumerate(images[sources]):
        rows, columns = (
            slice(max(int(np.ceil(at - reach)), 0), int(at + reach) + 1) for at in (y, x)
        )
        row, column = np.nonzero(np.isfinite(excess[rows, columns]))
        place = np.stack([column + columns.start, row + rows.start], axis=1)
        distance, nearest = tree.query(place)
        own = (nearest == sources[n]) & (distance > radius) & (distance <= reach)
        ring.append((distance[own] - radius).astype(int))
        value.append(excess[rows, columns][row[own], column[own]])
        source.append(np.full(own.sum(), n))
    k, s, z = np.concatenate(ring), np.concatenate(source), np.concatenate(value)
    last = int(np.quantile(k, FAR)) if k.size else 0
    at = s * (last + 1) + np.minimum(k, last)
    number = np.bincount(at, minlength=len(sources) * (last + 1)).astype(float)
    total = np.bincount(at, z, number.size)
    shape = len(sources), last + 1
    return (total / np.maximum(number, 1.0)).reshape(shape), number.reshape(shape)


def _proportion(flux: Floats, mean: Floats, number: Floats, noise: float) -> tuple[float, float]:
    """What a ring has more than the last, by unit of flux, and its standard deviation."""
    enough = np.all(number >= PIXELS, axis=1)
    sd = np.sqrt(noise * np.sum(1.0 / number[enough], axis=1))
    light, pull = flux[enough] / sd, (mean[enough, 0] - mean[enough, 1]) / sd
    found, wider, kept = 0.0, np.inf, np.ones(light.size, bool)
    for _ in range(ROUNDS):
        if kept.sum() < FEWEST:
            return 0.0, np.inf
        found = float(light[kept] @ pull[kept] / np.sum(light[kept] ** 2))
        off = np.abs(pull - found * light)
        wider = max(float(np.median(off)) / MAD, 1.0)
        before, kept = kept, off <= CLIP * wider
        if np.array_equal(before, kept):
            break
    return found, wider / float(np.sum(light[before] ** 2)) ** 0.5
