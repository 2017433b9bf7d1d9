"""Sources in the frame that the catalogue lacks.

What is left of a frame without its catalogued sources and the background is filtered with minus the
Laplacian of a Gaussian of width s, which passes what is as narrow as a source. An image of flux F
and width w has the height F / pi (s^2 + w^2)^2 there; the variance of a pixel V becomes the sum of
V k^2 around it, k being the filter. Peaks above 5 standard deviations are light that no source
explains.

A PSF that is not quite right leaves such peaks around bright stars. But they are about the same
share of the light at the same distance from every star, whereas a source that the catalogue lacks
stands near one star of many. So near stars a peak has to exceed, too, 2.5 times the share that is
common: the 75 % quantile of the bright stars', or that of a star's neighbours in the frame where it
is larger, for a PSF varies over the field. Where such peaks stand near more than a few stars, it is
the PSF still, and the share is doubled until they do not.

Light within the filter's reach of masked pixels at a star's image, such as saturated ones, is that
star's: its wings end at a hole there, and no fainter star shows as much of the PSF's misfit.

Light that is sharper than the stars' is no source but a hot pixel or a cosmic ray. What the eight
pixels beside a star's middle one hold of what that one holds is least where the image is in the
middle of the pixel: rho, the 10 % quantile of the bright stars'. A pixel with less than half of rho
beside it, and less than its own light, by 5 standard deviations, is masked by itself before
anything is filtered. Where no test can tell, it counts as a source.

A catalogued source that would keep less than half of its light says little but where it might be:
behind the mask, as bright as can be. It is left out with all of its pixels.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage, signal, spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.outliers import FAINT, SIGNIFICANCE
from bayesfred.optimize.peaks import above_ring, vertex

COMMON = 0.75  # quantile of the bright stars' shares that is the PSF's
MISFIT = 2.5  # times that
STARS = 40  # of which it is measured, the brightest third and at least 5
CLOSE = 4  # filter widths, to which it is measured about every star, too
ENOUGH = 20  # of a star's neighbours that are not much fainter; STARS of twice as many, at most
FARTHEST = 8.0  # filter widths from a star to which the PSF's misfit is followed
TRUNCATED = 4.0  # filter widths at which the filter ends
RINGS = 2  # a filter width
FEW, MANY = 5, 0.05  # so many near stars, or this share of the stars, may be found
LOOSER = 6  # times the misfit is doubled, at most, until they are so few: then it is the PSF's
LOOKS = 5  # for peaks, also for those hidden by others
NAMED = 10  # sources in the message
SHARPEST, FEWEST = 0.1, 5  # quantile of the bright stars' images, and how many tell it
SHARP = 0.5  # of what these have beside their middle
MOST_BESIDE = 1.0  # whatever the stars have: more is no single pixel's light
LEFT = 0.5  # share of its light that a source must keep, or it is left out with the light beside it


@dataclass(frozen=True, eq=False)
class UncataloguedSources:
    """Light in a frame that no catalogued source explains.

    Attributes
    ----------
    u, v : ndarray, shape (n,), pixel
        Where it is, from the middle of the frame; the brightest first.
    photons, sd : ndarray, shape (n,), counts
        Its flux, for an image like the PSF, and the standard deviation from the noise.
    sharp : ndarray of bool, shape (ny, nx)
        Pixels of the posterior whose light is sharper than the stars': hot ones, cosmic rays.
    mask : ndarray of bool, shape (ny, nx)
        The posterior's pixels but for those that this light reaches, for sharp ones, and for those
        of catalogued sources that are hidden.
    hidden : ndarray of int
        These sources' numbers in the catalogue, from 0.
    message : str
        One line: how many there are, the brightest ones' positions and photons, and what they hide;
        how many pixels are sharp.
    """

    u: Floats
    v: Floats
    photons: Floats
    sd: Floats
    sharp: Flags
    mask: Flags
    hidden: Ints
    message: str


def find_uncatalogued(posterior: Posterior, estimate: MapEstimate) -> UncataloguedSources:
    """Find the sources that the catalogue lacks whose light reaches the pixels in use.

    Parameters
    ----------
    posterior : Posterior
    estimate : MapEstimate
        Where the catalogued sources are imaged.

    Returns
    -------
    UncataloguedSources
        `dataclasses.replace(posterior, mask=found.mask)` is the posterior without them.

    Examples
    --------
    >>> import bayesfred as bf
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(2.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> other = bf.ForwardModel(
    ...     model.detector, bf.SourceCatalog([7.0], [6.0], [2e3]), model.psf, model.distortion)
    >>> counts = bf.simulate(model, [1e-4], 2.0, seed=1) + other.expected_counts([0.0])
    >>> posterior = bf.Posterior(model, counts.round())
    >>> bf.find_uncatalogued(posterior, bf.find_map(posterior)).message
    '1 source that the catalogue lacks: (7.0, 6.0) 1975 photons'
    """
    frame = _Filtered(posterior, estimate.params)
    for _ in range(LOOSER):
        found = frame.search()
        if frame.near(found) <= max(FEW, MANY * len(frame.flux)):
            break
        frame.looser *= 2.0
    light = frame.light(found)
    spread = ndimage.maximum_filter(light, 2 * int(np.ceil(0.25 * frame.width)) + 1)
    covered = spread > FAINT * np.sqrt(frame.variance)
    # of those that reach the pixels in use
    labels, _ = ndimage.label(covered)
    at = tuple(np.clip(np.rint(found[:, :2]).astype(int), 0, np.array(light.shape) - 1).T)
    sd = frame.area * frame.noise(frame.variance + light)[at]
    reaching = np.flatnonzero(np.isin(labels[at], labels[posterior.mask & covered]))
    order = reaching[np.argsort(-found[reaching, 2], kind="stable")]
    found, sd = found[order], sd[order]
    detector = posterior.model.detector
    v, u = (found[:, :2] - 0.5 * (np.array(detector.shape) - 1.0)).T * detector.binning
    kept, hidden = frame.without_hidden(posterior.mask & ~covered & ~frame.sharp)
    sharp = posterior.mask & frame.sharp
    message = _message(u, v, found[:, 2], hidden)
    if n := int(sharp.sum()):
        message += f"; {n} pixel{'s' * (n > 1)} sharper than the stars: hot pixels or cosmic rays"
    return UncataloguedSources(u, v, found[:, 2], sd, sharp, kept, hidden, message)


def _message(u: Floats, v: Floats, photons: Floats, hidden: Ints) -> str:
    n = len(u)
    if not n:
        return "no source that the catalogue lacks"
    named = zip(u[:NAMED], v[:NAMED], photons[:NAMED], strict=True)
    places = ", ".join(f"({a:.1f}, {b:.1f}) {flux:.0f} photons" for a, b, flux in named)
    more = f" and {n - NAMED} fainter ones" if n > NAMED else ""
    rows = ", ".join(map(str, hidden[:NAMED])) + ", ..." * (hidden.size > NAMED)
    lost = f"; hidden by them: rows {rows} of the catalogue, from 0" if hidden.size else ""
    return f"{n} source{'s' * (n > 1)} that the catalogue lacks: {places}{more}{lost}"


class _Filtered:
    """A frame without what its model explains, filtered."""

    def __init__(self, posterior: Posterior, params: Floats) -> None:
        model, step = posterior.model, posterior.model.detector.binning
        known = dict(zip(posterior.parameter_names, params, strict=True))
        self.posterior = posterior
        integrated = 12.0**-0.5 if model.detector.pixel == "box" or step > 1 else 0.0
        image = np.hypot(known.get("psf_sigma", model.psf.sigma) / step, integrated)
        self.width = max(float(image), 1.0)  # in narrower filters pixels show
        self.area = np.pi * (self.width**2 + image**2) ** 2  # of flux over height
        expected = posterior.expected_counts(params)
        self.residual = posterior.counts - expected
        self.variance = posterior.noise.counts_variance(expected, known["background"])
        ny, nx = model.detector.shape
        images = posterior.likelihood.image_positions(params)[:, ::-1] / step
        images = images + 0.5 * (np.array([ny, nx]) - 1.0)  # row, column
        self.flux = posterior.fluxes(params)
        seen = np.isfinite(images).all(axis=1) & np.isfinite(self.flux)
        self.rows, self.images, self.flux = np.flatnonzero(seen), images[seen], self.flux[seen]
        self.sharp = self._sharp()
        self.valid = posterior.valid & ~self.sharp
        reach = 2 * int(np.ceil(TRUNCATED * self.width)) + 1
        delta = np.zeros((reach, reach))
        delta[reach // 2, reach // 2] = 1.0
        self.square = ndimage.gaussian_laplace(delta, self.width) ** 2
        self.own = self._beside_masked()
        self.sd = self.noise(self.variance)
        self.looser = 1.0
        self._unexplained = np.maximum(np.abs(self._excess(np.zeros((0, 3)))) - 3.0 * self.sd, 0.0)
        self._tree = spatial.cKDTree(self.images) if len(self.images) else None
        self._share = functools.cache(self._share_of)
        self._common = self._quantile(self._brightest()[:STARS])
        self.misfit = functools.cache(self._misfit)

    def _sharp(self) -> Flags:
        """Pixels that hold light sharper than the stars'."""
        valid, stars = self.posterior.valid, self._brightest()
        whole = ndimage.minimum_filter(valid, 5, mode="constant", cval=False)
        # not the residual, which a wrong PSF makes sharp; above the 16 pixels farther out, so that
        # no background is needed, and their share of the variance
        own, beside, _ = above_ring(np.where(valid, self.posterior.counts, 0.0))
        at = tuple(np.rint(self.images[stars]).astype(int).T)
        usable = whole[at] & (own[at] > 0.0)
        if usable.sum() < FEWEST:
            return np.zeros(valid.shape, bool)
        sharpest = float(np.quantile(beside[at][usable] / own[at][usable], SHARPEST))
        share = min(SHARP * sharpest, MOST_BESIDE)
        variance = (12.0 + share**2) * self.variance + share * (1.0 + share) * np.abs(own)
        missing = share * own - np.maximum(beside, 0.0)
        return np.asarray(whole & (missing > SIGNIFICANCE * np.sqrt(variance)))

    def _beside_masked(self) -> Flags:
        """Pixels within the filter's reach of a star's masked ones: their light is the star's.

        Masked pixels that touch each other are a star's where its image is on or next to them.
        """
        masked, _ = ndimage.label(~self.posterior.valid, np.ones((3, 3)))
        at = tuple(np.rint(self.images[self._inside()]).astype(int).T)
        owned = np.setdiff1d(ndimage.maximum_filter(masked, 3)[at], 0)
        if not owned.size:
            return np.zeros(masked.shape, bool)
        distance = ndimage.distance_transform_edt(~np.isin(masked, owned))
        return np.asarray(distance <= TRUNCATED * self.width)

    def _inside(self) -> Flags:
        """Which images are in the frame."""
        shape = np.array(self.residual.shape)
        return np.asarray(np.all((self.images > 0) & (self.images < shape - 1), axis=1))

    def _brightest(self) -> Ints:
        """The brightest third of the stars in the frame, at least 5."""
        inside = self._inside()
        order = np.flatnonzero(inside)[np.argsort(-self.flux[inside])]
        return order[: max(len(order) // 3, 5)]

    def noise(self, variance: Floats) -> Floats:
        """Standard deviation of the filtered frame, for a variance of every pixel."""
        valid = np.where(self.valid, variance, 0.0)
        total = signal.fftconvolve(valid, self.square, mode="same")
        return np.asarray(np.sqrt(np.maximum(total, 1e-12 * total.max())))

    def _excess(self, found: Floats) -> Floats:
        left = np.where(self.valid, self.residual - self.light(found), 0.0)
        return np.asarray(-ndimage.gaussian_laplace(left, self.width))

    def light(self, found: Floats) -> Floats:
        """The image of what was found, shape (ny, nx)."""
        model = self.posterior.model
        if not len(found):
            return np.zeros(model.detector.shape)
        at = (found[:, :2] - 0.5 * (np.array(model.detector.shape) - 1.0)) * model.detector.binning
        sources = SourceCatalog(at[:, 1], at[:, 0], found[:, 2])
        theta = np.zeros(model.distortion.n_terms)
        return replace(model, sources=sources).expected_counts(theta)

    def _share_of(self, star: int) -> Floats:
        """Share of a star's light that the model leaves beside noise, by distance from the star."""
        row, column = self.images[star]
        j, i, reach = round(row), round(column), int(np.ceil(FARTHEST * self.width))
        top, left = max(0, j - reach), max(0, i - reach)
        window = self._unexplained[top : j + reach + 1, left : i + reach + 1]
        y, x = np.indices(window.shape)
        ring = RINGS * np.hypot(y + top - row, x + left - column) / self.width
        share = np.zeros(int(FARTHEST * RINGS))
        near = ring < share.size
        np.maximum.at(share, ring[near].astype(int), window[near])
        return np.asarray(share / max(self.flux[star], 1.0))

    def _quantile(self, stars: Ints) -> Floats:
        shares = [self._share(int(star)) for star in stars] or [np.zeros(int(FARTHEST * RINGS))]
        return MISFIT * np.quantile(shares, COMMON, axis=0)

    def _misfit(self, star: int) -> Floats:
        """The share that is the PSF's, at a star or at another light that was found."""
        if self._tree is None or star >= len(self.images):
            return self._common
        nearest = self._tree.query(self.images[star], 2 * STARS + 1)[1][1:]
        nearest = nearest[nearest < len(self.images)]
        alike = nearest[self.flux[nearest] >= LEFT * self.flux[star]]
        if len(alike) < ENOUGH:
            return self._common
        around = self._quantile(alike[:STARS])
        around[CLOSE * RINGS :] = 0.0  # farther out it is others' light by chance
        return np.maximum(self._common, around)

    def without_hidden(self, kept: Flags) -> tuple[Flags, Ints]:
        """A mask without the sources that keep too little of their light, and their rows."""
        out = kept.copy()
        hidden: list[int] = []
        if not len(self.images):
            return out, np.array(hidden, dtype=np.int64)
        tree, reach = spatial.cKDTree(self.images), int(np.ceil(FARTHEST * self.width))
        for k, (row, column) in enumerate(np.rint(self.images).astype(int)):
            rows, columns = (slice(max(0, m - reach), max(0, m + reach + 1)) for m in (row, column))
            at = np.stack(np.nonzero(self.posterior.mask[rows, columns]), axis=1)
            at += (rows.start, columns.start)
            light = np.exp(-((at - self.images[k]) ** 2).sum(axis=1) / (2.0 * self.width**2))
            left = kept[tuple(at.T)]
            if light @ left < LEFT * light.sum():
                out[tuple(at[tree.query(at)[1] == k].T)] = False
                hidden.append(int(self.rows[k]))
        return out, np.array(hidden, dtype=np.int64)

    def search(self) -> Floats:
        """Row, column and photons of what is found."""
        found = np.zeros((0, 3))
        for _ in range(LOOKS):
            new = self.peaks(found)
            if not len(new):
                break
            found = np.concatenate([found, new])
        return found

    def near(self, found: Floats) -> int:
        """How many of these stand on pixels in use and within the reach of a star's misfit."""
        if self._tree is None:
            return 0
        row, column = np.clip(np.rint(found[:, :2]).astype(int), 0, np.array(self.sd.shape) - 1).T
        distance, _ = self._tree.query(found[:, :2])
        used = self.posterior.mask[row, column]
        return int(np.sum(used & (distance < FARTHEST * self.width)))

    def peaks(self, found: Floats) -> Floats:
        """Peaks that neither stars nor what was found explain: row, column, photons."""
        excess, size = self._excess(found), 2 * int(np.ceil(2.0 * self.width)) + 1
        limit = SIGNIFICANCE * self.sd + SIGNIFICANCE**2 / self.area
        peak = np.zeros(excess.shape, bool)
        inner = slice(int(np.ceil(self.width)), -int(np.ceil(self.width)))  # the edge is mirrored
        peak[inner, inner] = (self.valid & ~self.own & (excess > limit))[inner, inner]
        row, column = np.nonzero(peak & (excess == ndimage.maximum_filter(excess, size)))
        places = np.stack([row, column], axis=1).astype(np.float64)
        above = excess[row, column] - limit[row, column]
        lights = np.concatenate([self.images, found[:, :2]])
        if len(lights) and len(row):
            fluxes = np.concatenate([self.flux, found[:, 2]])
            near = spatial.cKDTree(lights).query_ball_point(places, FARTHEST * self.width)
            for k, some in enumerate(near):
                distance = np.hypot(*(lights[some] - places[k]).T) / self.width
                ring = np.minimum((RINGS * distance).astype(int), self._common.size - 1)
                shares = [self.misfit(i)[r] for i, r in zip(some, ring, strict=True)]
                above[k] -= self.looser * np.sum(fluxes[some] * shares)
                if np.any(distance < 1.0):  # a star of another brightness or width
                    above[k] = -np.inf
        row, column = row[above > 0.0], column[above > 0.0]
        positions, t = vertex(excess, row, column), np.sqrt(self.area / np.pi)
        off = ((positions - np.column_stack([row, column])) ** 2).sum(axis=1) / (2.0 * t)
        height = excess[row, column] / ((1.0 - off) * np.exp(-off))  # between pixels
        return np.column_stack([positions, self.area * height])
