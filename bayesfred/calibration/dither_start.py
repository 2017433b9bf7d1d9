"""Dithered frames of counts as a posterior: sources found, frames placed, pixels chosen.

Sources are peaks that two frames or more show (`optimize.dithers`). A frame's posterior has all
sources that it may show, also those whose peak it hides. Light of no source, peaks of one frame
alone, is masked as far as it exceeds a tenth of the background's noise.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import spatial

from bayesfred._typing import Flags, Floats, Ints
from bayesfred.calibration.dither_outliers import lit_pixels
from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import PSF, has_pixel
from bayesfred.io.arrays import frame_given
from bayesfred.model.dither_layout import rotation
from bayesfred.model.dithered import DitheredPosterior
from bayesfred.model.noise import Noise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.dithers import Links, link_peaks, shifts_between
from bayesfred.optimize.peaks import bright_peaks

__all__ = ["Dithers"]

FIRST = 8.0  # widths of the PSF within which peaks are linked at first
AGAIN = 2.0  # ... and when the frames are nearly in place
SURE = 3.0  # standard deviations of a pointing within which its sources are looked for
BESIDE = 3.0  # widths of the PSF beyond the frame's edge from where sources still shine
EDGE = 1.0  # widths from the edge within which a peak's position says nothing
APART = 2.0  # widths from a source's image beyond which a peak is another's
BACK = 0.5  # pixel: an object and what is imaged where it is are the same


class _Peaks(NamedTuple):
    """Peaks of a frame, positions in fine pixels and fluxes in counts, brightest first."""

    at: Floats
    fluxes: Floats
    beside: Floats  # at the frame's edge
    fluxes_beside: Floats


@dataclass(frozen=True, eq=False)
class Dithers:
    """Frames of one field, and what is known of them beforehand.

    Attributes
    ----------
    counts : mapping of str to ndarray, shape (ny, nx), counts
    masks : mapping of str to ndarray of bool, shape (ny, nx)
    model : ForwardModel
        Its sources are of no meaning.
    noise : Noise
    nuisances : Nuisances
    pointings : mapping of str to (float, float), pixel, or None
    pointing_sd : float or None, pixel
    turns : mapping of str to float, degree, or None
    prior : mapping of str to frozen scipy.stats distribution
    """

    counts: Mapping[str, Floats]
    masks: Mapping[str, Flags]
    model: ForwardModel
    noise: Noise
    nuisances: Nuisances
    pointings: Mapping[str, Any] | None
    pointing_sd: float | None
    turns: Mapping[str, float] | None
    prior: Mapping[str, Any]

    @classmethod
    def of(
        cls,
        frames: Mapping[str, Any],
        instrument: tuple[Detector, PSF, PolynomialDistortion],
        statistics: tuple[Noise, Nuisances, Mapping[str, Any]],
        known: tuple[Mapping[str, Any] | None, float | None, Mapping[str, float] | None],
    ) -> "Dithers":
        """Frames as users give them, checked; see `self_calibrate` for what is refused."""
        detector, psf, distortion = instrument
        noise, nuisances, prior = statistics
        pointings, pointing_sd, turns = known
        if len(frames) < 2:
            raise InputError(f"frames: got {len(frames)}, expected at least two of one field")
        if pointing_sd is not None and pointings is None:
            raise InputError("pointing_sd: got it without pointings, expected both: give pointings")
        if pointing_sd is not None and not (np.isfinite(pointing_sd) and pointing_sd > 0.0):
            raise InputError(f"pointing_sd: got {pointing_sd}, expected a number of pixels > 0")
        _check("pointings", pointings, frames, (2,), "two numbers of pixels")
        _check("turns", turns, frames, (), "an angle in degrees")
        counts, masks = {}, {}
        for name, frame in frames.items():
            values, mask = frame_given(frame, None, getattr(noise, "variance", None))
            if values.shape != detector.shape:
                raise InputError(
                    f"frames: {name}: got shape {values.shape}, expected the detector's "
                    f"{detector.shape}"
                )
            counts[name], masks[name] = values, np.isfinite(values) if mask is None else mask
        somewhere = SourceCatalog(np.zeros(1), np.zeros(1), np.ones(1))
        model = ForwardModel(detector, somewhere, psf, distortion)
        return cls(
            counts, masks, model, noise, nuisances, pointings, pointing_sd, turns, dict(prior)
        )

    def posterior(
        self, links: Links | None = None, fixed: Mapping[str, float] | None = None
    ) -> tuple[DitheredPosterior, Floats, Links]:
        """The posterior of all frames, with where to begin.

        Parameters
        ----------
        links : Links, optional
            Found before, where coefficients have to be fixed.
        fixed : mapping of str to float, optional

        Returns
        -------
        posterior : DitheredPosterior
        start : ndarray, shape (d,)
        links : Links

        Raises
        ------
        InputError
            If the frames cannot be placed.
        """
        links = self._linked(links, fixed or {})
        links, shown = self._shown(links)
        members = dict(zip(self.counts, shown, strict=True))
        flux = self._mean_fluxes(links)
        posteriors = {}
        own = {k: p for k, p in self.prior.items() if k in self.model.polynomial.names}
        for i, name in enumerate(self.counts):
            x, y, turn = links.pointings[i]
            at = links.positions[members[name]] @ rotation(turn).T + [x, y]
            catalog = SourceCatalog(at[:, 0], at[:, 1], flux[members[name]])
            images = np.stack(self.model.polynomial.image_position(links.theta, *at.T), axis=1)
            posteriors[name] = Posterior(
                replace(self.model, sources=catalog), self.counts[name], prior=own,
                noise=self.noise, mask=self.masks[name] & ~self._foreign(links, i, images),
                nuisances=self.nuisances,
            )  # fmt: skip
        posterior = DitheredPosterior(
            posteriors, members, self._poses(links), pointing_sd=self.pointing_sd,
            turned=self.turns is not None, fixed=fixed, prior=self.prior,
        )  # fmt: skip
        return posterior, _start(posterior, links), links

    @cached_property
    def _width(self) -> float:
        """The PSF's, the pixel included, in recorded pixels."""
        detector, psf = self.model.detector, self.model.psf
        apart = (detector.pixel == "box" or detector.binning > 1) and not has_pixel(psf)
        return float(np.hypot(psf.sigma / detector.binning, 12.0**-0.5 if apart else 0.0))

    @cached_property
    def _peaks(self) -> dict[str, _Peaks]:
        """The peaks of every frame."""
        detector, width, found = self.model.detector, self._width, {}
        inside = 0.5 * np.array(detector.shape[::-1]) - EDGE * width
        for name, frame in self.counts.items():
            mask = self.masks[name]
            filled = np.where(mask, frame, np.median(frame[mask]))
            at, heights = bright_peaks(filled, mask, width)
            fluxes = 4.0 * np.pi * width**4 * heights
            kept = (np.abs(at) < inside).all(axis=1)
            at = detector.binning * at
            found[name] = _Peaks(at[kept], fluxes[kept], at[~kept], fluxes[~kept])
        return found

    def _mean_fluxes(self, links: Links) -> Floats:
        """Mean flux of every source's peaks, shape (n,), counts."""
        total, count = np.zeros((2, len(links.positions)))
        for peaks, source in zip(self._peaks.values(), links.source, strict=True):
            linked = source >= 0
            np.add.at(total, source[linked], peaks.fluxes[linked])
            np.add.at(count, source[linked], 1.0)
        return np.asarray(total / count)

    def _linked(self, links: Links | None, fixed: Mapping[str, float]) -> Links:
        """Peaks linked to sources, from what is known of the pointings."""
        names, field = list(self.counts), self.model.polynomial
        width = self._width * self.model.detector.binning
        peaks = {name: found.at for name, found in self._peaks.items()}
        turns = np.array([(self.turns or {}).get(name, 0.0) for name in names])
        farthest = FIRST * width
        if links is not None:
            poses, farthest = links.pointings, AGAIN * width
        elif self.pointings is not None:
            poses = np.array([[*self.pointings[n], a] for n, a in zip(names, turns, strict=True)])
            farthest = max(farthest, SURE * (self.pointing_sd or 0.0))
        else:
            found = shifts_between(list(peaks.values()), turns, width, names)
            poses = np.column_stack([found, turns])
        ny, nx = self.model.detector.fine_shape
        f, g = field.largest_displacement(0.5 * nx, 0.5 * ny)
        sd = 0.1 / np.maximum(f / (0.5 * nx), g / (0.5 * ny))  # of the default priors
        return link_peaks(
            peaks, field, poses, width, farthest=farthest, sd=sd, turned=self.turns is not None,
            fixed=fixed,
        )  # fmt: skip

    def _poses(self, links: Links) -> dict[str, tuple[float, ...]]:
        """Pointings and turns as they are known, or as they were found."""
        poses: dict[str, tuple[float, ...]] = {}
        for name, pose in zip(self.counts, links.pointings, strict=True):
            x, y = pose[:2] if self.pointing_sd is None else (self.pointings or {})[name]
            poses[name] = (float(x), float(y), float(pose[2]))
        return poses

    def _shown(self, links: Links) -> tuple[Links, list[Ints]]:
        """Sources whose light reaches two frames and more, and every frame's numbers of them."""
        field, detector = self.model.polynomial, self.model.detector
        beyond = BESIDE * self._width * detector.binning
        half = 0.5 * np.array(detector.fine_shape[::-1]) + beyond
        reached = np.zeros((len(links.pointings), len(links.positions)), bool)
        for near, (x, y, turn) in zip(reached, links.pointings, strict=True):
            at = (links.positions @ rotation(turn).T + [x, y]).T
            u, v = field.image_position(links.theta, *at)
            near[:] = (np.abs(u) < half[0]) & (np.abs(v) < half[1])
            # beyond a fold objects have images that are none
            back = np.array(field.object_position(links.theta, u[near], v[near])) - at[:, near]
            near[near] = np.hypot(*back) < BACK
        kept = reached.sum(axis=0) > 1
        number = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)  # of -1 too
        source = tuple(number[each] for each in links.source)
        links = links._replace(positions=links.positions[kept], source=source)
        return links, [np.flatnonzero(near[kept]) for near in reached]

    def _foreign(self, links: Links, i: int, images: Floats) -> Flags:
        """Pixels of a frame that hold light of peaks that are no image of a source."""
        name = list(self.counts)[i]
        counts, peaks, alone = self.counts[name], self._peaks[name], links.source[i] < 0
        at = np.concatenate([peaks.at[alone], peaks.beside])
        flux = np.concatenate([peaks.fluxes[alone], peaks.fluxes_beside])
        level = max(float(np.median(counts[self.masks[name]])), 1e-9)
        variance = self.noise.counts_variance(np.full(counts.shape, level), level)
        noise = float(np.sqrt(np.median(variance)))
        distance, _ = spatial.cKDTree(images).query(at)
        other = distance > APART * self._width * self.model.detector.binning
        return lit_pixels(self.model, at[other], flux[other], noise)


def _start(posterior: DitheredPosterior, links: Links) -> Floats:
    """Where a search begins."""
    layout, start = posterior.layout, posterior.start()
    theta = layout.parts[0].theta
    start[: theta.size] = links.theta[theta]
    for part, pose in zip(layout.parts, links.pointings, strict=True):
        free = part.pointing >= 0
        start[part.pointing[free]] = pose[free]
    start[layout.n_dense :] = links.positions.ravel()
    return np.clip(start, *posterior.support)


def _check(
    what: str,
    given: Mapping[str, Any] | None,
    frames: Iterable[str],
    shape: tuple[int, ...],
    expected: str,
) -> None:
    """Refuse what is not one value, or two, for each of the frames."""
    for name in frames if given is not None else ():
        value = np.array((given or {}).get(name, np.nan), dtype=np.float64)
        if value.shape != shape or not np.isfinite(value).all():
            raise InputError(f"{what}: {name}: got {(given or {}).get(name)}, expected {expected}")
