"""Unmatched sources and spurious detections are rejected.

A detection that belongs to no source of the catalogue, or a source without an image, pulls the
coefficients farther than all other stars hold them: with many coefficients, which change the shapes
of images too, until the map folds. A source that lacks its light is taken off the catalogue. What
else exceeds the noise is masked, as far as its light reaches.

The excess is measured in the frame less its expectation, filtered with minus the Laplacian of the
PSF, which no smooth background passes. An image of flux F and width s has the height F / 4 pi s^4
in it, and a pixel variance B becomes B / 2 pi s^6. Around an image there is a dark ring, which
looks as if its neighbours lacked light. So the highest peaks are explained first, each as a missing
source or as a detection of its own, and the others are measured in what these leave.

Wrong parameters make every bright star exceed the noise. So what may still be their fault is
tolerated: a share of the light of the stars nearby, the smallest one with which most stars remain.
Fitted to these, the parameters get better and the share smaller, until it is zero: then, but for
close calls, the search rejects what the true parameters would reject, wherever it began.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import ndimage, spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.geometry import image_positions
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.newton import maximize
from bayesfred.optimize.peaks import vertex

# Standard deviations by which a rejected detection exceeds the noise. It has the square of this
# number of counts at least.
SIGNIFICANCE = 5.0
TOLERANCES = (0.0, 0.03, 0.1, 0.3, 1.0)  # shares of the stars' light nearby
COARSE = TOLERANCES[-2:]  # for parameters that are predicted, not fitted
ALIKE = 2.0  # a missing source is as bright as the dark image that it leaves, within this factor

# A pixel is masked where detections have more than this share of the noise's standard deviation.
FAINT = 0.3

# Of the stars at most this share is rejected: else the parameters are wrong, not the catalogue.
MOST = 0.7
SOME = 0.2  # with a PSF that is not the frame's, while what it may leave can be tolerated
# Parameters that reject more than this share of the sources fit what they were fitted to. In
# crowded fields with a tenth missing and a tenth foreign, wrong ones lose 0.44 to 0.7 of them,
# right ones 0.27 to 0.48.
BREAKDOWN = 0.4
LOOKS = 10  # for peaks, also for those hidden by others
MOSTLY = 0.5  # share of the frame's pixels in parts of it, from which it is filtered as a whole
ROUNDS = 8
STEPS = 8  # of Newton's method between two rejections


Region = tuple[slice, slice]  # rows and columns


class Kept(NamedTuple):
    """What is kept of a posterior.

    Attributes
    ----------
    posterior : Posterior
        Of the sources and pixels that remain; the one that was given where nothing is rejected.
    missing : ndarray of bool, shape (n,)
        Which sources of the given posterior are not in this one.
    lost : ndarray of bool, shape (n,)
        The missing sources, and those whose middle is masked.
    share : float
        Of the sources in the frame that are lost.
    """

    posterior: Posterior
    missing: Flags
    lost: Flags
    share: float


def keep_all(posterior: Posterior, params: Floats) -> tuple[Kept, Floats, int]:
    """All of a posterior, and the same parameters: `reject` without rejecting."""
    none = np.zeros(len(posterior.model.sources), bool)
    return Kept(posterior, none, none, 0.0), params, 0


def reject(
    posterior: Posterior,
    params: Floats,
    tolerances: Sequence[float] = TOLERANCES,
    most: float = MOST,
) -> tuple[Kept, Floats, int]:
    """Reject and maximise in turns until the same is rejected again.

    With `tolerances` and `most` as of `reject_once`.

    Returns
    -------
    kept : Kept
    params : ndarray, shape (d,)
        Where the searches led.
    evaluations : int
        Log-posteriors evaluated.
    """
    kept, params, evaluations = keep_all(posterior, params)
    seen: set[bytes] = set()
    for _ in range(ROUNDS):
        if not np.isfinite(posterior.log_prob(params)):  # folded where a source is missing
            break
        found = reject_once(posterior, params, tolerances, most)
        key = found.missing.tobytes() + found.lost.tobytes()
        if key in seen:
            break
        seen.add(key)
        kept, top = found, maximize(found.posterior, params, steps=STEPS)
        params, evaluations = top.params, evaluations + top.evaluations
    return kept, params, evaluations


def share_lost(given: Posterior, kept: Posterior, params: Floats) -> float:
    """The share of the sources in a posterior's pixels that are not in what is kept of it.

    Parameters
    ----------
    given, kept : Posterior
    params : ndarray, shape (d,)
        Of the kept one.

    Returns
    -------
    float
        Of sources that were removed, and those whose middle is masked.
    """
    step, (ny, nx) = given.model.detector.binning, given.mask.shape
    place = kept.likelihood.image_positions(params)[:, ::-1] / step + 0.5 * np.array(
        [ny - 1, nx - 1]
    )
    row, column = np.rint(place[np.isfinite(place).all(axis=1)]).astype(int).T
    inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
    row, column = row[inside], column[inside]
    removed = len(given.model.sources) - len(kept.model.sources)
    held, all_of_them = kept.mask[row, column].sum(), given.mask[row, column].sum() + removed
    return 1.0 - float(held / max(all_of_them, 1))


def reject_once(
    posterior: Posterior,
    params: Floats,
    tolerances: Sequence[float] = TOLERANCES,
    most: float = MOST,
) -> Kept:
    """Reject what these parameters do not explain.

    The tolerance is the least one at which no more than a share `most` of the stars is lost; with
    the last one it is `MOST`.
    """
    residuals = _Residuals(posterior, params)
    for tolerance in tolerances:
        missing, mask = residuals.outliers(tolerance)
        lost = missing | ~mask[residuals.row, residuals.column]
        left = mask.any() and not residuals.none_left(missing)
        share = residuals.share(lost)
        if left and share <= (most if tolerance < tolerances[-1] else MOST):
            return Kept(_part(posterior, missing, mask), missing, lost, share)
    return keep_all(posterior, params)[0]


class _Residuals:
    """A frame beside what parameters make of it, filtered."""

    def __init__(self, posterior: Posterior, params: Floats) -> None:
        model, names = posterior.model, posterior.parameter_names
        step = model.detector.binning
        self.posterior, self.params = posterior, params
        self.width = s = np.hypot(model.psf.sigma / step, 12.0**-0.5)
        known = dict(zip(names, params, strict=True))
        d = model.polynomial
        theta = d.monomial_coefficients(params[: d.n_terms].copy())
        offset = [known.get(name, 0.0) for name in ("offset_x", "offset_y")]
        u, v = image_positions(model.optics(), theta, *offset, model.psf.sigma).T / step
        ny, nx = model.detector.shape
        self.positions = np.stack([v + 0.5 * (ny - 1), u + 0.5 * (nx - 1)], axis=1)
        nearest = np.rint(self.positions).astype(int)
        self.row, self.column = np.clip(nearest, 0, [ny - 1, nx - 1]).T
        self.inside = np.all(nearest == np.stack([self.row, self.column], axis=1), axis=1)
        self.inside &= posterior.mask[self.row, self.column]
        self.flux = known.get("flux_scale", 1.0) * model.sources.flux
        self.height = 4.0 * np.pi * s**4  # of flux over height
        self.near = 2 * int(np.ceil(3.0 * s)) + 1
        self.reach = int(4.0 * s + 0.5)  # of the filters
        self.noise, self.level = posterior.noise_at(params), known["background"]
        self.expected = posterior.expected_counts(params)

    @cached_property
    def stars(self) -> Floats:
        """The light of the stars nearby, filtered, shape (ny, nx)."""
        return self._nearby(self.expected)

    def _nearby(self, expected: Floats) -> Floats:
        out = np.zeros_like(expected)
        for region in self._regions(self.posterior.mask):
            wide, core = self._wider(region)
            filtered = self._filtered(expected[wide], self.posterior.mask[wide])
            out[region] = ndimage.maximum_filter(filtered, self.near)[core]
        return out

    def _regions(self, some: Flags) -> list[Region]:
        """Where filters see some pixels, as rectangles."""
        shape, reach = some.shape, self.reach + self.near
        found = []
        for box in ndimage.find_objects(ndimage.label(some)[0]):
            found.append(_padded(box, reach, shape))
        area = sum((r.stop - r.start) * (c.stop - c.start) for r, c in found)
        if area <= MOSTLY * some.size:
            return found
        rows, columns = (np.flatnonzero(some.any(axis=axis)) for axis in (1, 0))
        box = (slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1))
        return [_padded(box, reach, shape)]

    def _wider(self, region: Region) -> tuple[Region, Region]:
        """A region with what filters see of its surroundings, and where the region is in that."""
        wide = _padded(region, self.reach + self.near, self.expected.shape)
        core = tuple(
            slice(inner.start - outer.start, inner.stop - outer.start)
            for inner, outer in zip(region, wide, strict=True)
        )
        return wide, (core[0], core[1])

    def share(self, lost: Flags) -> float:
        """Sources in the frame that are lost."""
        return float(lost[self.inside].sum() / max(int(self.inside.sum()), 1))

    def none_left(self, missing: Flags) -> bool:
        """Whether no source remains in the frame, of which a posterior could be made."""
        s, (ny, nx) = self.posterior.model.sources, self.posterior.model.detector.fine_shape
        return not np.any(~missing & (np.abs(s.x) <= 0.5 * nx) & (np.abs(s.y) <= 0.5 * ny))

    def outliers(self, tolerance: float) -> tuple[Flags, Flags]:
        """Which sources are missing, shape (n,), and the pixels without detections, (ny, nx)."""
        p, missing, expected = self.posterior, np.zeros(self.flux.size, bool), self.expected
        stars = tolerance * self.stars if tolerance else None
        light, mask = np.zeros(p.counts.shape), p.mask.copy()
        regions = self._regions(p.mask)
        for _ in range(LOOKS):
            positions, flux = self._peaks(regions, expected, light, stars)
            if not flux.size:
                break
            absent = self._absent(positions, flux, missing)
            missing[absent[absent >= 0]] = True
            if self.none_left(missing):
                break
            added = self._image(positions[absent < 0], flux[absent < 0])
            light += added
            changed = added != 0.0
            if np.any(absent >= 0):
                before, expected = expected, _part(p, missing, p.mask).expected_counts(self.params)
                stars = tolerance * self._nearby(expected) if tolerance else None
                changed |= expected != before
            # elsewhere another look would find what this one did
            regions = self._regions(changed)
            for region in regions:
                mask[region] = self._without_detections(region, expected, light)
            if self.share(missing | ~mask[self.row, self.column]) > MOST:
                break
        return missing, mask

    def _peaks(
        self, regions: list[Region], expected: Floats, light: Floats, stars: Floats | None
    ) -> tuple[Floats, Floats]:
        """What exceeds the noise and what is tolerated of the light of the stars nearby.

        Returns
        -------
        positions : ndarray, shape (n, 2), recorded pixel
            Row and column.
        flux : ndarray, shape (n,), counts
            Negative where light is missing.
        """
        p, s, nx = self.posterior, self.width, expected.shape[1]
        pixels, positions, flux = [np.empty(0, int)], [np.empty((0, 2))], [np.empty(0)]
        for region in regions:
            wide, core = self._wider(region)
            used, known = p.mask[wide], expected[wide] + np.maximum(light[wide], 0.0)
            each = self.noise.at(wide).counts_variance(known, self.level)
            variance = ndimage.gaussian_filter(np.where(used, each, 0.0), s)
            limit = SIGNIFICANCE * np.sqrt(variance / (2.0 * np.pi * s**6))
            limit += SIGNIFICANCE**2 / self.height
            if stars is not None:
                limit += stars[wide]
            excess = self._filtered(p.counts[wide] - expected[wide] - light[wide], used)
            height = np.abs(excess)
            peak = np.zeros(used.shape, bool)
            peak[core] = (height > limit)[core]
            row, column = np.nonzero(peak)
            highest = _highest(height, row, column, self.near // 2)
            row, column = row[highest], column[highest]
            origin = np.array([wide[0].start, wide[1].start])
            pixels.append((row + origin[0]) * nx + column + origin[1])
            positions.append(vertex(height, row, column) + origin)
            flux.append(self.height * excess[row, column])
        # regions overlap
        first = np.unique(np.concatenate(pixels), return_index=True)[1]
        return np.concatenate(positions)[first], np.concatenate(flux)[first]

    def _without_detections(self, region: Region, expected: Floats, light: Floats) -> Flags:
        """Which pixels of a region in use detections hardly reach."""
        wide, core = self._wider(region)
        wider = 2 * int(np.ceil(0.25 * self.width)) + 1  # for detections of another width
        spread = ndimage.maximum_filter(np.abs(light[wide]), wider)[core]
        variance = self.noise.at(region).counts_variance(expected[region], self.level)
        return np.asarray(self.posterior.mask[region] & (spread <= FAINT * np.sqrt(variance)))

    def _absent(self, positions: Floats, flux: Floats, missing: Flags) -> Ints:
        """The source whose absence leaves a dark image with this flux; -1 where none does."""
        absent = np.full(flux.size, -1)
        there = np.flatnonzero(self.inside & ~missing)
        if not there.size:
            return absent
        near = spatial.cKDTree(self.positions[there]).query_ball_point(positions, self.width)
        for k in np.flatnonzero(flux < 0.0):
            unlike = np.abs(np.log(self.flux[there[near[k]]]) - np.log(-flux[k]))
            if unlike.min(initial=np.inf) < np.log(ALIKE):
                absent[k] = there[near[k][np.argmin(unlike)]]
        return absent

    def _image(self, positions: Floats, flux: Floats) -> Floats:
        """Detections as the sources' distortion images them, shape (ny, nx).

        Sources that it cannot have imaged are rendered as the PSF alone.
        """
        model = self.posterior.model
        theta = self.params[: model.distortion.n_terms]
        v, u = (positions - 0.5 * (np.array(model.detector.shape) - 1.0)).T * model.detector.binning
        x, y = model.polynomial.object_position(theta, u, v)
        known = np.isfinite(x + y)
        image = _signed_image(model, theta, x[known], y[known], flux[known])
        if not np.isfinite(image).all():
            known[:], image = False, np.zeros_like(image)
        return image + _signed_image(
            model, np.zeros_like(theta), u[~known], v[~known], flux[~known]
        )

    def _filtered(self, image: Floats, used: Flags) -> Floats:
        return np.asarray(-ndimage.gaussian_laplace(np.where(used, image, 0.0), self.width))


def _padded(box: Region, by: int, shape: tuple[int, ...]) -> Region:
    row, column = (
        slice(max(side.start - by, 0), min(side.stop + by, size))
        for side, size in zip(box, shape, strict=True)
    )
    return row, column


def _highest(height: Floats, row: Ints, column: Ints, near: int) -> Flags:
    """Which pixels are the highest of all as near along either axis."""
    ny, nx = height.shape
    highest = np.ones(row.size, bool)
    for i in range(-near, near + 1):
        some = np.flatnonzero(highest)
        rows = np.clip(row[some] + i, 0, ny - 1)[:, None]
        columns = np.clip(column[some, None] + np.arange(-near, near + 1), 0, nx - 1)
        highest[some] = height[rows, columns].max(axis=1) <= height[row[some], column[some]]
    return highest


def _signed_image(model: ForwardModel, theta: Floats, x: Floats, y: Floats, flux: Floats) -> Floats:
    """The image of sources of which some take light away, shape (ny, nx)."""
    image = np.zeros(model.detector.shape)
    for sign in (1.0, -1.0):
        some = sign * flux > 0.0
        if some.any():
            image += sign * replace(
                model, sources=SourceCatalog(x[some], y[some], np.abs(flux[some]))
            ).expected_counts(theta)
    return image


def _part(posterior: Posterior, missing: Flags, mask: Flags) -> Posterior:
    """The posterior of these pixels, without the missing sources."""
    model, s = posterior.model, posterior.model.sources
    if missing.any():
        kept = replace(s, x=s.x[~missing], y=s.y[~missing], flux=s.flux[~missing])
        model = replace(model, sources=kept)
    elif np.array_equal(mask, posterior.mask):
        return posterior
    noise, nuisances = posterior.noise, posterior.nuisances
    return Posterior(
        model, posterior.counts, prior=posterior.prior, noise=noise, mask=mask,
        nuisances=nuisances, psf_errors=posterior.psf_errors,
    )  # fmt: skip
