"""What all hypotheses look at: residuals, and which pixels belong to which source."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import ndimage, spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.model.noise import Noise
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.matched import SourceLight, source_light

CORE = 3.0  # PSF widths around an image that are called the source's pixels
QUIET = 5.0  # PSF widths from every image and detection at which pixels hold background alone
DETECTED = 5.0  # standard deviations of a detection
NEARBY = 0.1  # share of the light around it that a detection exceeds, or it is a wing
LEAST = 0.1  # of expected counts, to which an earlier cause may lower them
BRIGHT = 64.0  # squared signal to noise of a source that has to be seen
AROUND = 12  # sources, as whose typical one those near a source count


@dataclass(frozen=True, eq=False)
class Detections:
    """Light in places where the model has none.

    Attributes
    ----------
    position : ndarray, shape (n, 2), recorded pixel
        u, v from the frame's middle, strongest first.
    power : ndarray, shape (n,)
        Squared signal to noise.
    """

    position: Floats
    power: Floats


@dataclass(frozen=True, eq=False)
class Context:
    """A posterior at some parameters, and its residuals.

    Attributes
    ----------
    posterior : Posterior
    params : ndarray, shape (d,)
    left_out : ndarray of bool, shape (ny, nx)
        Pixels that an earlier cause has explained.
    rejected : bool
        Whether outliers were rejected already.
    corrected : ndarray, shape (ny, nx), optional
        Expected counts with what an earlier cause has explained.
    """

    posterior: Posterior
    params: Floats
    left_out: Flags
    rejected: bool = False
    corrected: Floats | None = None

    @cached_property
    def light(self) -> SourceLight:
        """What the counts show where the model images its sources."""
        return source_light(self.posterior, self.params)

    @cached_property
    def expected(self) -> Floats:
        """Expected counts, shape (ny, nx)."""
        if self.corrected is not None:
            return self.corrected
        return self.posterior.expected_counts(self.params)

    @cached_property
    def noise(self) -> Noise:
        """That of every pixel's counts by themselves, with the model error."""
        return self.posterior.noise_at(self.params).pixelwise

    def corrected_by(self, change: Floats) -> "Context":
        """What is left if so many more counts are expected; a tenth of what were, at the least."""
        least = np.where(self.expected > 0.0, LEAST * self.expected, -np.inf)
        return replace(self, corrected=np.maximum(self.expected + change, least))

    @property
    def level(self) -> float:
        """The background's constant, counts per pixel."""
        return float(self.params[self.posterior.parameter_names.index("background")])

    @cached_property
    def used(self) -> Flags:
        """The pixels that are judged, shape (ny, nx)."""
        return self.posterior.mask & ~self.left_out & np.isfinite(self.expected)

    @cached_property
    def variance(self) -> Floats:
        """Of every pixel's counts under the noise model."""
        variance = self.noise.counts_variance(self.expected, self.level)
        return np.where(np.isfinite(variance) & (variance > 0.0), variance, 1.0)

    @cached_property
    def residual(self) -> Floats:
        """Counts less their expectation; 0 where not used."""
        return np.where(self.used, self.posterior.counts - self.expected, 0.0)

    @cached_property
    def z(self) -> Floats:
        """The residual in standard deviations."""
        return np.asarray(self.residual / np.sqrt(self.variance))

    @cached_property
    def excess(self) -> float:
        """The misfit: sum of z^2 - 1."""
        return float(np.sum(self.z**2) - np.sum(self.used))

    @property
    def spread(self) -> float:
        """Standard deviation of the misfit of a true model, about."""
        noise = self.noise.at(self.used)
        one = noise.pearson_variance(self.expected[self.used], self.level)
        return float(np.sqrt(np.sum(one)))

    @cached_property
    def background(self) -> Floats:
        """The background polynomial at every pixel, shape (ny, nx)."""
        return self.posterior.likelihood.background(self.params)

    @cached_property
    def power(self) -> Floats:
        """Squared signal to noise of the sources' light in the model, shape (n,)."""
        return self.per_source((self.expected - self.background) ** 2 / self.variance)

    @cached_property
    def off(self) -> Floats:
        """Light found over light of the model, less 1, by least squares, shape (n,)."""
        pull = self.per_source((self.expected - self.background) * self.residual / self.variance)
        return np.asarray(pull / np.maximum(self.power, 1e-300))

    @cached_property
    def flux(self) -> Floats:
        """Of the sources, as the catalogue has them, counts."""
        known = dict(zip(self.posterior.parameter_names, self.params, strict=True))
        return np.asarray(self.posterior.model.sources.flux * known.get("flux_scale", 1.0))

    @cached_property
    def catalogue_power(self) -> Floats:
        """Squared signal to noise that sources of the catalogue's flux have.

        A Gaussian image S of flux F, on a background of variance B, has the integral of S^2 /
        (B + S), which is F (1 - log(1 + x) / x) with x = F / (2 pi s^2 B); where the noise is not
        the photons', that of S^2 / B, see `missing_power`.
        """
        bright = np.full_like(self.expected, 1e9)
        if self.noise.counts_variance(bright, self.level).max() < 1e8:
            return self.missing_power
        x = self._contrast
        return np.asarray(self.flux * (1.0 - np.log1p(x) / np.maximum(x, 1e-12)))

    @property
    def missing_power(self) -> Floats:
        """The same where the model has no light, F x / 2: the noise is then the background's."""
        return np.asarray(0.5 * self.flux * self._contrast)

    @cached_property
    def _contrast(self) -> Floats:
        level = float(np.median(self.variance[self.used])) if self.used.any() else 1.0
        return np.asarray(self.flux / (2.0 * np.pi * self.light.width**2 * max(level, 1e-9)))

    @cached_property
    def bright(self) -> Flags:
        """Sources in the frame that have to be seen, shape (n,)."""
        return self.light.inside & (self.catalogue_power > BRIGHT)

    @cached_property
    def _nearest(self) -> tuple[Floats, Ints]:
        """Every pixel's distance from the nearest image, pixel, and whose that is, or -1."""
        shape = self.expected.shape
        index = np.full(shape, -1)
        position = self.light.position
        place = np.rint(position[:, ::-1] + 0.5 * (np.array(shape) - 1.0))
        there = np.isfinite(place).all(axis=1)
        there &= ((place >= 0) & (place < np.array(shape))).all(axis=1)
        row, column = place[there].astype(int).T
        index[row, column] = np.flatnonzero(there)
        if not there.any():
            return np.full(shape, np.inf), index
        distance, (j, i) = ndimage.distance_transform_edt(index < 0, return_indices=True)
        return np.asarray(distance), np.asarray(index[j, i])

    @property
    def distance(self) -> Floats:
        """Of every pixel from the nearest image, pixel."""
        return self._nearest[0]

    @property
    def owner(self) -> Ints:
        """The source whose image is nearest to a pixel."""
        return self._nearest[1]

    def per_source(self, image: Floats, radius: float = CORE) -> Floats:
        """Sum of an image over every source's used pixels, shape (n,)."""
        near = self.used & (self.distance <= radius * self.light.width)
        return np.asarray(
            np.bincount(self.owner[near], image[near], self.flux.size), dtype=np.float64
        )

    @cached_property
    def source_pixels(self) -> Floats:
        """Number of every source's pixels, shape (n,)."""
        return self.per_source(np.ones(self.expected.shape))

    @cached_property
    def source_excess(self) -> Floats:
        """Every source's part of the misfit, shape (n,)."""
        return self.per_source(self.z**2) - self.source_pixels

    @cached_property
    def typical(self) -> Floats:
        """Misfit of a typical source, in units of its squared signal to noise, shape (n,).

        The median of matched ones, or of those nearby if it is larger: a PSF may be wrong in one
        part of the frame.
        """
        some = np.flatnonzero(self.light.matched & (self.power > BRIGHT))
        if not some.size:
            return np.zeros(self.flux.size)
        each = self.source_excess[some] / self.power[some]
        place = np.where(np.isfinite(self.light.position), self.light.position, 0.0)
        number = min(AROUND, some.size)
        _, near = spatial.cKDTree(place[some]).query(place, number)
        nearby = np.median(each[near.reshape(-1, number)], axis=1)
        return np.asarray(np.maximum(nearby, max(float(np.median(each)), 0.0)))

    @cached_property
    def detections(self) -> Detections:
        """Peaks of the residual away from all images."""
        s = self.light.width
        filtered = ndimage.gaussian_filter(self.residual, s, mode="constant")
        noise = ndimage.gaussian_filter(
            np.where(self.used, self.variance, 0.0), s / 2.0**0.5, mode="constant"
        ) / (4.0 * np.pi * s**2)
        sources = ndimage.gaussian_filter(
            np.abs(self.expected - self.background), s, mode="constant"
        )
        size = 2 * int(np.ceil(2.0 * s)) + 1
        near = ndimage.maximum_filter(sources, 2 * int(np.ceil(3.0 * s)) + 1)
        peak = (filtered == ndimage.maximum_filter(filtered, size)) & self.used
        peak &= filtered > DETECTED * np.sqrt(np.maximum(noise, 1e-300)) + NEARBY * near
        peak &= self.distance > 2.0 * s
        row, column = np.nonzero(peak)
        power = filtered[row, column] ** 2 / noise[row, column]
        order = np.argsort(-power)
        ny, nx = peak.shape
        position = np.stack([column - 0.5 * (nx - 1), row - 0.5 * (ny - 1)], axis=1)
        return Detections(position[order], power[order])

    @cached_property
    def quiet(self) -> Flags:
        """Pixels of background alone, shape (ny, nx)."""
        far = self.used & (self.distance > QUIET * self.light.width)
        if len(self.detections.position):
            spots = np.ones(far.shape, bool)
            place = self.detections.position[:, ::-1] + 0.5 * (np.array(far.shape) - 1.0)
            row, column = np.rint(place).astype(int).T
            spots[row, column] = False
            far &= ndimage.distance_transform_edt(spots) > QUIET * self.light.width
        return np.asarray(far)
