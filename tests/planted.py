"""Frames in which one thing is wrong that the model does not know of, for the tests of causes.

Every fault is planted into the same kind of frame: 48 sources of various fluxes in 161 x 161
pixels, a Gaussian PSF of 1.8 pixels, a background of 20 counts, a cubic lens. Everything random
follows from the seed.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF, MoffatPSF, SampledPSF
from bayesfred.model.noise import PoissonNoise, simulate
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior

Floats = NDArray[np.float64]

SHAPE = (161, 161)
HALF = 0.5 * (SHAPE[0] - 1)
SIGMA = 1.8
LEVEL = 20.0
LENS = PolynomialDistortion([(3, 0, 0, 0), (1, 2, 0, 0)], [(2, 1, 0, 0), (0, 3, 0, 0)])
THETA = np.full(4, 2.0 / HALF**3)  # moves a source at the frame's edge by 2 pixels


def field(seed: int, n: int = 48) -> SourceCatalog:
    """Sources that stand apart by 6 widths or more, within 70 pixels of the middle."""
    rng = np.random.default_rng(seed)
    kept: list[Floats] = []
    while len(kept) < n:
        new = rng.uniform(-70.0, 70.0, 2)
        if all(np.hypot(*(new - old)) > 6.0 * SIGMA for old in kept):
            kept.append(new)
    x, y = np.array(kept).T
    return SourceCatalog(x, y, 4e3 * rng.lognormal(0.0, 0.5, n))


def camera(sources: SourceCatalog, **changes: Any) -> ForwardModel:
    """The model of the frame."""
    given = {"detector": Detector(SHAPE), "psf": GaussianPSF(SIGMA), "distortion": LENS}
    return ForwardModel(sources=sources, **(given | changes))


def counts(model: ForwardModel, seed: int, level: float = LEVEL) -> Floats:
    theta = THETA if model.distortion is LENS else np.zeros(model.distortion.n_terms)
    return simulate(model, theta, level, seed=seed + 10_000)


def moved(s: SourceCatalog, x: Floats, y: Floats) -> SourceCatalog:
    return SourceCatalog(x, y, s.flux)


def true(seed: int, **nuisances: Any) -> Posterior:
    """Nothing is wrong."""
    model = camera(field(seed))
    return Posterior(model, counts(model, seed), nuisances=Nuisances(**nuisances))


def saturation(seed: int) -> Posterior:
    """The brightest pixels hold the most that the detector can."""
    model = camera(field(seed))
    frame = counts(model, seed)
    full = np.sort(model.sources.flux)[-24] / (2.0 * np.pi * SIGMA**2)
    return Posterior(model, np.minimum(frame, np.round(full)))


def gain(seed: int) -> Posterior:
    """A frame in adu of 4 electrons is taken for counts."""
    model = camera(field(seed))
    frame = counts(model, seed) / 4.0
    small = replace(model, sources=replace(model.sources, flux=model.sources.flux / 4.0))
    return Posterior(small, frame)


def gain_too_large(seed: int) -> Posterior:
    """Counts that were multiplied by 3 are taken for counts."""
    model = camera(field(seed))
    frame = counts(model, seed) * 3.0
    large = replace(model, sources=replace(model.sources, flux=model.sources.flux * 3.0))
    return Posterior(large, frame)


def read_noise(seed: int) -> Posterior:
    """Nobody said that there is read noise of 8 counts."""
    model = camera(field(seed))
    frame = counts(model, seed, 40.0)
    frame += np.random.default_rng(seed + 20_000).normal(0.0, 8.0, SHAPE)
    return Posterior(model, np.maximum(frame, 0.0))


def pedestal(seed: int) -> Posterior:
    """A pedestal of 60 counts was not subtracted."""
    model = camera(field(seed))
    return Posterior(model, counts(model, seed) + 60.0)


def over_dispersion(seed: int) -> Posterior:
    """Every pixel's sensitivity is another, by 20 %."""
    model = camera(field(seed))
    rng = np.random.default_rng(seed + 20_000)
    flat = rng.gamma(25.0, 1.0 / 25.0, SHAPE)
    return Posterior(model, rng.poisson(flat * model.expected_counts(THETA, 100.0)).astype(float))


def colour_filter(seed: int) -> Posterior:
    """A raw frame of a colour camera: red, green, green and blue pixels."""
    model = camera(field(seed))
    response = np.ones(SHAPE)
    response[::2, ::2], response[1::2, 1::2] = 0.6, 0.5
    rng = np.random.default_rng(seed + 20_000)
    expected = response * model.expected_counts(THETA, LEVEL)
    return Posterior(model, rng.poisson(expected).astype(float), nuisances=Nuisances("free"))


def two_amplifiers(seed: int) -> Posterior:
    """Every other column is read by an amplifier that adds 4 counts."""
    posterior = true(seed)
    more = np.where(np.arange(SHAPE[1]) % 2 == 1, 4.0, 0.0)
    return replace(posterior, counts=posterior.counts + more)


def dead_columns(seed: int) -> Posterior:
    """Two columns are dead, and one records half."""
    posterior = true(seed, flux="free")
    frame = posterior.counts.copy()
    frame[:, [40, 90]] = 0.0
    frame[:, 120] = np.floor(0.5 * frame[:, 120])
    return replace(posterior, counts=frame)


def banding(seed: int) -> Posterior:
    """The read-out adds a constant to every row, of 3 counts (rms)."""
    posterior = true(seed)
    more = np.random.default_rng(seed + 20_000).normal(0.0, 3.0, (SHAPE[0], 1))
    return replace(posterior, counts=np.maximum(np.round(posterior.counts + more), 0.0))


def resampled(seed: int) -> Posterior:
    """The frame was shifted by half a pixel along each axis, by means of four pixels."""
    model, rng = camera(field(seed)), np.random.default_rng(seed + 20_000)
    frame = counts(model, seed) + rng.normal(0.0, 3.0, SHAPE)
    frame = 0.25 * sum(np.roll(frame, (-i, -j), (0, 1)) for i in (0, 1) for j in (0, 1))
    wider = replace(model, psf=GaussianPSF((SIGMA**2 + 0.25) ** 0.5))
    noise = PoissonNoise(read_noise=3.0)
    return Posterior(wider, frame, noise=noise, nuisances=Nuisances(offset=True))


def varying_psf(seed: int) -> Posterior:
    """Images are wider the farther out they are, by a third at the frame's edge."""
    model = camera(field(seed))
    s, expected = model.sources, np.full(SHAPE, LEVEL)
    for x, y, flux in zip(s.x, s.y, s.flux, strict=True):
        own = GaussianPSF(SIGMA * (1.0 + (x * x + y * y) / (3.0 * HALF**2)))
        one = camera(SourceCatalog([x], [y], [flux]), psf=own)
        expected += one.expected_counts(THETA, 0.0)
    frame = np.random.default_rng(seed + 20_000).poisson(expected).astype(float)
    return Posterior(model, frame, nuisances=Nuisances("free", psf_sigma=True))


def narrow_psf_on_grid(seed: int) -> Posterior:
    """Sources, all in even rows and columns, are wider than 0.6 pixels."""
    model = camera(SourceCatalog.grid(15, 8.0, 2e4), psf=GaussianPSF(0.6))
    wider = replace(model, psf=GaussianPSF(0.7))
    return Posterior(model, simulate(wider, 0.05 * THETA, LEVEL, seed=seed + 10_000))


def background(seed: int) -> Posterior:
    """The background is twice as high on one side as on the other."""
    model = camera(field(seed))
    slope = LEVEL * (1.0 + np.linspace(-1 / 3, 1 / 3, SHAPE[1]))
    rng = np.random.default_rng(seed + 20_000)
    return Posterior(model, rng.poisson(model.expected_counts(THETA) + slope).astype(float))


def origin(seed: int) -> Posterior:
    """The catalogue counts pixels from the frame's corner."""
    s = field(seed)
    return Posterior(camera(moved(s, s.x + HALF, s.y + HALF)), counts(camera(s), seed))


def parity(seed: int) -> Posterior:
    """The catalogue's x runs the other way."""
    s = field(seed)
    return Posterior(camera(moved(s, -s.x, s.y)), counts(camera(s), seed))


def shift(seed: int, by: float = 2.5) -> Posterior:
    """The frame is shifted, and there is no offset to fit."""
    s = field(seed)
    return Posterior(camera(s), counts(camera(moved(s, s.x + by, s.y - 0.6 * by)), seed))


def far_shift(seed: int) -> Posterior:
    return shift(seed, 11.0)


def rotation(seed: int, degrees: float = 3.0) -> Posterior:
    """The camera is rotated about its axis, and there are no linear terms."""
    s, angle = field(seed), np.deg2rad(degrees)
    x, y = np.cos(angle) * s.x - np.sin(angle) * s.y, np.sin(angle) * s.x + np.cos(angle) * s.y
    return Posterior(camera(s), counts(camera(moved(s, x, y)), seed))


def far_rotation(seed: int) -> Posterior:
    return rotation(seed, 25.0)


def scale(seed: int) -> Posterior:
    """The pixel scale is wrong by 4 %."""
    s = field(seed)
    return Posterior(camera(s), counts(camera(moved(s, 1.04 * s.x, 1.04 * s.y)), seed))


def missing_terms(seed: int) -> Posterior:
    """The lens is tilted, too: x^2 and x y."""
    s = field(seed)
    tilt = 2.5 / HALF**2
    x, y = s.x + tilt * s.x**2, s.y + tilt * s.x * s.y
    return Posterior(camera(s), counts(camera(moved(s, x, y)), seed))


def far_missing_terms(seed: int) -> Posterior:
    s = field(seed)
    tilt = 12.0 / HALF**2
    x, y = s.x + tilt * s.x**2, s.y + tilt * s.x * s.y
    return Posterior(camera(s), counts(camera(moved(s, x, y)), seed))


def fisheye(seed: int) -> Posterior:
    """A cubic lens where the true one has terms of the fifth degree, which few sources show."""
    terms = [(i, d - i, 0, 0) for d in (1, 2, 3) for i in range(d, -1, -1)]
    model = camera(field(seed, 60), distortion=PolynomialDistortion(terms, terms))
    x, y = model.sources.x / HALF, model.sources.y / HALF
    r2 = x * x + y * y
    more = 8.0 * r2**2 - 20.0 * r2
    true_field = moved(model.sources, model.sources.x + more * x, model.sources.y + more * y)
    frame = counts(replace(model, sources=true_field), seed)
    return Posterior(model, frame, nuisances=Nuisances("free"))


def unmatched(seed: int) -> Posterior:
    """The catalogue is of another field; every flux is free."""
    return Posterior(
        camera(field(seed)),
        counts(camera(field(seed + 30_000)), seed),
        nuisances=Nuisances(flux="free"),
    )


def empty(seed: int) -> Posterior:
    """The shutter was closed; every flux is free."""
    noise = np.random.default_rng(seed + 20_000).poisson(LEVEL, SHAPE).astype(float)
    return Posterior(camera(field(seed)), noise, nuisances=Nuisances(flux="free"))


def wrong_sources(seed: int) -> Posterior:
    """Four catalogue positions are wrong by 8 pixels."""
    s, rng = field(seed), np.random.default_rng(seed + 20_000)
    angle, few = rng.uniform(0.0, 2.0 * np.pi, 4), rng.choice(48, 4, replace=False)
    x, y = s.x.copy(), s.y.copy()
    x[few] += 8.0 * np.cos(angle)
    y[few] += 8.0 * np.sin(angle)
    return Posterior(camera(moved(s, x, y)), counts(camera(s), seed))


def wrong_fluxes_of_few(seed: int) -> Posterior:
    """Three sources vary: they are three times as bright as in the catalogue."""
    s = field(seed)
    flux = s.flux.copy()
    flux[:3] *= 3.0
    return Posterior(camera(s), counts(camera(replace(s, flux=flux)), seed))


def uncatalogued(seed: int) -> Posterior:
    """Ten sources are in no catalogue."""
    s = field(seed, 58)
    few = SourceCatalog(s.x[:48], s.y[:48], s.flux[:48])
    return Posterior(camera(few), counts(camera(s), seed))


def companions(seed: int, **nuisances: Any) -> Posterior:
    """Half of the sources have a companion of a tenth of their flux that no catalogue has."""
    s, rng = field(seed), np.random.default_rng(seed + 20_000)
    half, angle = np.arange(0, len(s), 2), rng.uniform(0.0, 2.0 * np.pi, len(s) // 2)
    x = np.append(s.x, s.x[half] + 2.4 * SIGMA * np.cos(angle))
    y = np.append(s.y, s.y[half] + 2.4 * SIGMA * np.sin(angle))
    whole = SourceCatalog(x, y, 10.0 * np.append(s.flux, 0.1 * s.flux[half]))
    few = replace(s, flux=10.0 * s.flux)
    return Posterior(camera(few), counts(camera(whole), seed), nuisances=Nuisances(**nuisances))


def free_companions(seed: int) -> Posterior:
    return companions(seed, flux="free", offset=True, psf_sigma=True)


def coma(seed: int) -> Posterior:
    """The PSF trails to one side, and its Gaussian's width is fitted."""
    s = field(seed)
    a = np.arange(-60, 61) / 6.0
    psf = SampledPSF(
        sum(
            share * np.exp(-0.5 * ((a - by) ** 2 + a[:, None] ** 2) / SIGMA**2)
            for share, by in ((0.7, -0.6), (0.2, 0.6), (0.1, 2.8))
        ),
        6.0,
    )
    bright = replace(s, flux=10.0 * s.flux)
    return Posterior(
        camera(bright), counts(camera(bright, psf=psf), seed),
        nuisances=Nuisances(flux="free", offset=True, psf_sigma=True),
    )  # fmt: skip


def scatter(seed: int) -> Posterior:
    """Positions of the catalogue are wrong by 0.3 pixels."""
    s, rng = field(seed), np.random.default_rng(seed + 20_000)
    s = replace(s, flux=10.0 * s.flux)
    x, y = np.stack([s.x, s.y]) + rng.normal(0.0, 0.3, (2, len(s)))
    return Posterior(camera(moved(s, x, y)), counts(camera(s), seed))


def fluxes(seed: int) -> Posterior:
    """Fluxes are taken to be exact, and are known to 40 %."""
    s, rng = field(seed), np.random.default_rng(seed + 20_000)
    true_flux = s.flux * rng.lognormal(0.0, 0.4, len(s))
    return Posterior(camera(s), counts(camera(replace(s, flux=true_flux)), seed))


def flux_scale(seed: int) -> Posterior:
    """Fluxes are right but for a factor of 1.6."""
    s = field(seed)
    return Posterior(camera(s), counts(camera(replace(s, flux=1.6 * s.flux)), seed))


def wide_psf(seed: int, **nuisances: Any) -> Posterior:
    """The PSF is wider by a quarter."""
    s = field(seed)
    frame = counts(camera(s, psf=GaussianPSF(1.25 * SIGMA)), seed)
    return Posterior(camera(s), frame, nuisances=Nuisances(**nuisances))


def moffat_psf(seed: int) -> Posterior:
    """The PSF has wings, and its Gaussian's width is fitted."""
    s = field(seed)
    frame = counts(camera(s, psf=MoffatPSF(2.355 * SIGMA, 2.2), tolerance=1e-5), seed)
    return Posterior(camera(s), frame, nuisances=Nuisances(flux="free", psf_sigma=True))


def undersampled(seed: int) -> Posterior:
    """A narrow PSF whose pixels are taken for points where they integrate."""
    s = field(seed)
    frame = counts(camera(s, psf=GaussianPSF(0.6), detector=Detector(SHAPE, pixel="box")), seed)
    return Posterior(
        camera(s, psf=GaussianPSF(0.62)), frame, nuisances=Nuisances(flux="free", offset=True)
    )


# every fault, the names that are right for it, and what a run that fits well needs
FAULTS: dict[str, tuple[Callable[[int], Posterior], tuple[str, ...]]] = {
    "saturation": (saturation, ("saturation",)),
    "gain": (gain, ("gain",)),
    "gain, counts too large": (gain_too_large, ("gain",)),
    "read noise": (read_noise, ("read noise",)),
    "pedestal": (pedestal, ("pedestal",)),
    "over-dispersion": (over_dispersion, ("over-dispersion",)),
    "colour filter": (colour_filter, ("alternating pixels",)),
    "two amplifiers": (two_amplifiers, ("alternating pixels",)),
    "dead columns": (dead_columns, ("rows or columns",)),
    "banding": (banding, ("rows or columns",)),
    "resampled": (resampled, ("correlated pixels",)),
    "background": (background, ("background",)),
    "origin": (origin, ("origin",)),
    "parity": (parity, ("parity",)),
    "shift": (shift, ("shift",)),
    "shift by 11 pixels": (far_shift, ("shift",)),
    "rotation": (rotation, ("rotation or scale",)),
    "rotation by 25 degrees": (far_rotation, ("rotation or scale",)),
    "scale": (scale, ("rotation or scale",)),
    "missing terms": (missing_terms, ("missing terms",)),
    "missing terms of 12 pixels": (far_missing_terms, ("missing terms",)),
    "missing terms, at the rim": (fisheye, ("missing terms",)),
    "another field": (unmatched, ("unmatched",)),
    "no light": (empty, ("unmatched",)),
    "wrong positions of few": (wrong_sources, ("wrong sources",)),
    "wrong fluxes of few": (wrong_fluxes_of_few, ("wrong sources",)),
    "uncatalogued sources": (uncatalogued, ("uncatalogued sources",)),
    "companions": (companions, ("companions",)),
    "companions, all free": (free_companions, ("companions",)),
    "coma": (coma, ("PSF",)),
    "scatter": (scatter, ("positions",)),
    "fluxes": (fluxes, ("fluxes",)),
    "a factor of all fluxes": (flux_scale, ("fluxes",)),
    "PSF too wide": (wide_psf, ("PSF",)),
    "PSF with wings": (moffat_psf, ("PSF",)),
    "PSF that varies": (varying_psf, ("PSF",)),
    "pixels taken for points": (undersampled, ("PSF",)),
    "PSF too narrow, on a grid": (narrow_psf_on_grid, ("PSF",)),
}
