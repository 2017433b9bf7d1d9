"""Sigma clipping: what the frame and the catalogue do not have in common is left out.

A spot that belongs to no source of the catalogue, or a source that has no spot, pulls the
coefficients farther than all other stars hold them: where there are many coefficients, which change
the spots' shapes too, until the map folds. A source that lacks its light is taken off the
catalogue. What else stands out of the noise is masked, as far as its light goes.

What stands out is looked for in the frame less its expectation, filtered with minus the Laplacian
of the PSF, which no smooth background passes. A spot of flux F and width s has the height F / 4 pi
s^4 in it, and a pixel variance B becomes B / 2 pi s^6. Around a spot there is a dark ring, which
looks as if its neighbours lacked light. So the highest peaks are explained first, each as a missing
source or as a spot of its own, and the others looked for in what these leave.

Parameters that are wrong make every bright star stand out. So what may still be their fault is
tolerated: a share of the light of the stars nearby, the smallest one with which most stars remain.
Fitted to these the parameters get better and the share smaller, until it is zero: then, but for
close calls, what the true parameters would leave out is left out, wherever it began.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage, spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.kernels.geometry import image_positions
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.newton import maximize

# of what is left out, in standard deviations; so it has this number's square of counts at least
SIGNIFICANCE = 5.0
TOLERANCES = (0.0, 0.03, 0.1, 0.3, 1.0)  # shares of the stars' light nearby
COARSE = TOLERANCES[-2:]  # for parameters that are foretold, not fitted
ALIKE = 2.0  # a missing source is as bright as the dark spot that it leaves, within this factor
FAINT = (
    0.3  # a pixel is masked where spots have more than this share of the noise's standard deviation
)
# of the stars are left out; where there would be more, the parameters are wrong, not the catalogue
MOST = 0.7
LOOKS = 10  # for peaks, those that others hid among them
ROUNDS = 8
STEPS = 8  # of a climb on the way


class Clipped(NamedTuple):
    """What is left of a posterior.

    Attributes
    ----------
    posterior : Posterior
        Of the sources and pixels that remain; the very one that was given where nothing is left
        out.
    missing : ndarray of bool, shape (n,)
        Which sources of the given posterior are not in this one.
    lost : ndarray of bool, shape (n,)
        The missing sources, and those whose middle is masked.
    """

    posterior: Posterior
    missing: Flags
    lost: Flags


def whole(posterior: Posterior, params: Floats) -> tuple[Clipped, Floats, int]:
    """All of a posterior, and the same parameters: `settle` without clipping."""
    none = np.zeros(len(posterior.model.sources), bool)
    return Clipped(posterior, none, none), params, 0


def settle(posterior: Posterior, params: Floats) -> tuple[Clipped, Floats, int]:
    """What is left once clipping and climbing, in turns, leave out the same again; where they led; log-posteriors evaluated."""
    clipped, params, evaluations = whole(posterior, params)
    seen: set[bytes] = set()
    for _ in range(ROUNDS):
        if not np.isfinite(posterior.log_prob(params)):  # folded where a source is missing
            break
        found = clip(posterior, params)
        key = found.missing.tobytes() + found.lost.tobytes()
        if key in seen:
            break
        seen.add(key)
        clipped, top = found, maximize(found.posterior, params, steps=STEPS)
        params, evaluations = top.params, evaluations + top.evaluations
    return clipped, params, evaluations


def clip(posterior: Posterior, params: Floats, tolerances: Sequence[float] = TOLERANCES) -> Clipped:
    """The posterior without what these parameters do not explain, with the least tolerance at which most stars remain."""
    look = _Look(posterior, params)
    for tolerance in tolerances:
        missing, mask = look.outliers(tolerance)
        lost = missing | ~mask[look.row, look.column]
        if mask.any() and not look.too_many(lost):
            return Clipped(_part(posterior, missing, mask), missing, lost)
    return whole(posterior, params)[0]


class _Look:
    """A frame beside what parameters make of it, filtered."""

    def __init__(self, posterior: Posterior, params: Floats) -> None:
        model, names, step = (
            posterior.model,
            posterior.parameter_names,
            posterior.model.detector.binning,
        )
        self.posterior, self.params = posterior, params
        self.width = s = np.hypot(model.psf.sigma / step, 12.0**-0.5)
        known = dict(zip(names, params, strict=True))
        d = model.polynomial
        theta = d.monomial_coefficients(params[: d.n_terms].copy())
        offset = [known.get(name, 0.0) for name in ("offset_x", "offset_y")]
        u, v = image_positions(model.optics(), theta, *offset, model.psf.sigma).T / step
        ny, nx = model.detector.shape
        self.places = np.stack([v + 0.5 * (ny - 1), u + 0.5 * (nx - 1)], axis=1)
        nearest = np.rint(self.places).astype(int)
        self.row, self.column = np.clip(nearest, 0, [ny - 1, nx - 1]).T
        self.inside = (
            np.all(nearest == np.stack([self.row, self.column], axis=1), axis=1)
            & posterior.mask[self.row, self.column]
        )
        self.flux = known.get("flux_scale", 1.0) * model.sources.flux
        self.height = 4.0 * np.pi * s**4  # of flux over height
        self.level = known["background"]
        self.expected = posterior.expected_counts(params)

    def too_many(self, lost: Flags) -> bool:
        return bool(lost[self.inside].sum() > MOST * self.inside.sum())

    def outliers(self, tolerance: float) -> tuple[Flags, Flags]:
        """Which sources are missing, shape (n,), and the pixels that the light of spots leaves, shape (ny, nx)."""
        p, s = self.posterior, self.width
        missing, expected, light = (
            np.zeros(self.flux.size, bool),
            self.expected,
            np.zeros(p.counts.shape),
        )
        mask, near = p.mask, 2 * int(np.ceil(3.0 * s)) + 1
        for _ in range(LOOKS):
            variance = np.where(
                p.mask,
                1.0 / p.noise.fisher_weight(expected + np.maximum(light, 0.0), self.level),
                0.0,
            )
            limit = SIGNIFICANCE * np.sqrt(
                ndimage.gaussian_filter(variance, s) / (2.0 * np.pi * s**6)
            )
            limit += SIGNIFICANCE**2 / self.height
            if tolerance:
                limit += tolerance * ndimage.maximum_filter(self._filtered(expected), near)
            excess = self._filtered(p.counts - expected - light)
            height = np.abs(excess)
            row, column = np.nonzero(
                (height > limit) & (height == ndimage.maximum_filter(height, near))
            )
            if not row.size:
                break
            flux = self.height * excess[row, column]
            places = vertex(height, row, column)
            absent = self._absent(places, flux, missing)
            missing[absent[absent >= 0]] = True
            if missing.all():
                break
            if np.any(absent >= 0):
                expected = _part(p, missing, p.mask).expected_counts(self.params)
            light += self._image(places[absent < 0], flux[absent < 0])
            spread = ndimage.maximum_filter(
                np.abs(light), 2 * int(np.ceil(0.25 * s)) + 1
            )  # of another width
            mask = p.mask & (spread <= FAINT * p.noise.fisher_weight(expected, self.level) ** -0.5)
            if self.too_many(missing | ~mask[self.row, self.column]):
                break
        return missing, mask

    def _absent(self, places: Floats, flux: Floats, missing: Flags) -> Ints:
        """The source whose absence leaves a dark spot with this flux, shape (number of spots,); -1 where none does."""
        absent = np.full(flux.size, -1)
        there = np.flatnonzero(self.inside & ~missing)
        if not there.size:
            return absent
        near = spatial.cKDTree(self.places[there]).query_ball_point(places, self.width)
        for k in np.flatnonzero(flux < 0.0):
            unlike = np.abs(np.log(self.flux[there[near[k]]]) - np.log(-flux[k]))
            if unlike.min(initial=np.inf) < np.log(ALIKE):
                absent[k] = there[near[k][np.argmin(unlike)]]
        return absent

    def _image(self, places: Floats, flux: Floats) -> Floats:
        """Spots as the sources' distortion makes them, shape (ny, nx); those that it cannot have made, as the PSF alone."""
        model = self.posterior.model
        theta = self.params[: model.distortion.n_terms]
        v, u = (places - 0.5 * (np.array(model.detector.shape) - 1.0)).T * model.detector.binning
        x, y = model.polynomial.object_position(theta, u, v)
        bent = np.isfinite(x + y)
        image = _bright(model, theta, x[bent], y[bent], flux[bent])
        if not np.isfinite(image).all():
            bent[:], image = False, np.zeros_like(image)
        return image + _bright(model, np.zeros_like(theta), u[~bent], v[~bent], flux[~bent])

    def _filtered(self, image: Floats) -> Floats:
        return np.asarray(
            -ndimage.gaussian_laplace(np.where(self.posterior.mask, image, 0.0), self.width)
        )


def _bright(model: ForwardModel, theta: Floats, x: Floats, y: Floats, flux: Floats) -> Floats:
    """The image of sources of which some take light away, shape (ny, nx)."""
    image = np.zeros(model.detector.shape)
    for sign in (1.0, -1.0):
        some = sign * flux > 0.0
        if some.any():
            image += sign * replace(
                model, sources=SourceCatalog(x[some], y[some], np.abs(flux[some]))
            ).expected_counts(theta)
    return image


def vertex(image: Floats, row: Ints, column: Ints) -> Floats:
    """Places of peaks between pixels, shape (n, 2), where a parabola through three pixels has its vertex."""
    ny, nx = image.shape
    top = image[row, column]

    def shift(before: Floats, after: Floats) -> Floats:
        curvature = before + after - 2.0 * top
        along = np.zeros_like(top)  # along a ridge
        return np.asarray(
            np.divide(0.5 * (before - after), curvature, out=along, where=curvature < 0.0)
        )

    up = shift(image[np.maximum(row - 1, 0), column], image[np.minimum(row + 1, ny - 1), column])
    right = shift(image[row, np.maximum(column - 1, 0)], image[row, np.minimum(column + 1, nx - 1)])
    return np.stack([row + up, column + right], axis=1)


def _part(posterior: Posterior, missing: Flags, mask: Flags) -> Posterior:
    """The posterior of these pixels, without the missing sources."""
    model, s = posterior.model, posterior.model.sources
    if missing.any():
        model = replace(
            model, sources=SourceCatalog(s.x[~missing], s.y[~missing], s.flux[~missing])
        )
    elif np.array_equal(mask, posterior.mask):
        return posterior
    noise, nuisances = posterior.noise, posterior.nuisances
    return Posterior(
        model, posterior.counts, prior=posterior.prior, noise=noise, mask=mask, nuisances=nuisances
    )
