"""PSFs measured on the same frames: `python -m benchmarks.measured_psf`.

Thirty stars of 100,000 photons, at any pixel phase, with a Moffat PSF that box pixels integrate.
This package's PSF beside that of photutils' EPSFBuilder and, where it is installed, of Piff's
PixelGrid, each with four samples a pixel and as its documentation says. Printed are, over some
frames and in units of the peak, the largest and the root mean square error of the effective PSF
within one FWHM of its middle, as drawn at every twentieth of a pixel; and the root mean square
error of the stars' positions along one axis, in thousandths of a pixel: of each star by itself, and
of the affine map fitted to them. This package's positions are those of its map.
"""

import sys
import warnings
from dataclasses import replace
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

import bayesfred as bf

STARS, FLUX, LEVEL = 30, 1e5, 5.0
FWHM, FRAMES = (1.2, 2.0, 4.0), 5
BETA = 4.765
STEP = 0.05  # of the grid of points, pixel


class Problem(NamedTuple):
    """A frame, and what is to be found on it."""

    counts: np.ndarray
    posterior: bf.Posterior
    places: np.ndarray  # (stars, 2) of the images, from the frame's middle
    fwhm: float

    @property
    def half(self) -> int:
        """Of a star's window, pixel."""
        return int(np.ceil(3.0 * self.fwhm)) + 2


class Measured(NamedTuple):
    """What a package found."""

    density: np.ndarray  # on the grid of points
    alone: np.ndarray | None  # (stars, 2)
    mapped: np.ndarray  # (stars, 2)


def grid(fwhm: float) -> np.ndarray:
    return np.arange(-np.ceil(fwhm / STEP), np.ceil(fwhm / STEP) + 1) * STEP


def problem(fwhm: float, seed: int) -> Problem:
    rng = np.random.default_rng(seed)
    spacing = max(7.0 * fwhm, 14.0)
    columns, rows = np.divmod(np.arange(STARS), 6)
    x, y = spacing * np.stack([columns - 2.0, rows - 2.5]) + rng.uniform(-0.5, 0.5, (2, STARS))
    size = int(7.0 * spacing) | 1
    distortion = bf.PolynomialDistortion.polynomial(1)
    model = bf.ForwardModel(
        bf.Detector((size, size), pixel="box"),
        bf.SourceCatalog(x, y, np.full(STARS, FLUX)),
        bf.MoffatPSF(fwhm, BETA),
        distortion,
    )
    theta = 1e-3 * rng.standard_normal(distortion.n_terms)
    counts = bf.simulate(model, theta, LEVEL, seed=seed)
    start = replace(model, psf=bf.GaussianPSF(fwhm / 2.3548))
    nuisances = bf.Nuisances(flux="free", offset=True, psf_sigma=True)
    posterior = bf.Posterior(start, counts, nuisances=nuisances)
    places = np.stack(model.distortion.image_position(theta, x, y), axis=1)
    return Problem(counts, posterior, places, fwhm)


def truth(fwhm: float) -> np.ndarray:
    """The PSF integrated over pixels, by the midpoint rule."""
    psf, points = bf.MoffatPSF(fwhm, BETA), grid(fwhm)
    within = (np.arange(25) - 12.0) / 25.0
    fine = points[:, None] + within
    across = psf.density(fine[None, :, None, :], fine[:, None, :, None])
    return np.asarray(across.mean(axis=(-1, -2)))


def mapped(given: Problem, alone: np.ndarray) -> np.ndarray:
    """The affine map from the catalogue to positions."""
    s = given.posterior.model.sources
    design = np.stack([np.ones(len(s)), s.x, s.y], axis=1)
    return np.asarray(design @ np.linalg.lstsq(design, alone, rcond=None)[0])


def of_bayesfred(given: Problem) -> Measured:
    posterior, estimate = bf.measure_psf(given.posterior, bf.find_map(given.posterior))
    psf, points = posterior.model.psf, grid(given.fwhm)
    images = posterior.likelihood.image_positions(estimate.params)
    return Measured(psf.density(points, points[:, None]), None, images)


def of_photutils(given: Problem) -> Measured:
    from astropy.nddata import NDData
    from astropy.table import Table as Places
    from photutils.psf import EPSFBuilder, PSFPhotometry, extract_stars

    middle, points = 0.5 * (len(given.counts) - 1), grid(given.fwhm)
    image, size = given.counts - LEVEL, 2 * given.half + 1
    places = Places(np.rint(given.places + middle), names=["x", "y"])
    build = EPSFBuilder(oversampling=4, maxiters=20, progress_bar=False)
    epsf = build(extract_stars(NDData(image), places, size=size))[0]
    points_u, points_v = np.meshgrid(points, points)
    density = epsf.evaluate(points_u, points_v, flux=1.0, x_0=0.0, y_0=0.0)
    near = int(np.ceil(2.0 * given.fwhm)) | 1
    start = Places(np.rint(given.places + middle), names=["x_init", "y_init"])
    start["flux_init"] = FLUX
    error = np.sqrt(np.maximum(given.counts, 1.0))
    found = PSFPhotometry(epsf, near)(image, error=error, init_params=start)
    found.sort("id")
    alone = np.stack([found["x_fit"], found["y_fit"]], axis=1) - middle
    return Measured(density, alone, mapped(given, alone))


def of_piff(given: Problem) -> Measured:
    import galsim
    import piff

    middle, points, half = 0.5 * (len(given.counts) - 1), grid(given.fwhm), given.half
    image = galsim.Image(given.counts - LEVEL, scale=1.0)  # its first pixel is (1, 1)
    weight = galsim.Image(1.0 / np.maximum(given.counts, 1.0), scale=1.0)
    stars = []
    for x, y in np.rint(given.places + middle) + 1:
        box = galsim.BoundsI(int(x) - half, int(x) + half, int(y) - half, int(y) + half)
        data = piff.StarData(image[box], galsim.PositionD(x, y), weight=weight[box])
        stars.append(piff.Star(data, None))
    size = 4 * (2 * half - 2) + 1
    model = piff.PixelGrid(scale=0.25, size=size, centered=True)
    psf = piff.SimplePSF(model, piff.BasisPolynomial(0))
    psf.fit(stars, {0: image.wcs}, None)
    density = np.empty((points.size, points.size))
    for i, v in enumerate(points):
        for k, u in enumerate(points):  # the middle pixel of a stamp on which it is moved
            drawn = psf.draw(x=middle, y=middle, stamp_size=1, center=(middle - u, middle - v))
            density[i, k] = drawn.array[0, 0]
    alone = np.array([[s.image_pos.x + s.center[0], s.image_pos.y + s.center[1]]
                      for s in psf.stars]) - 1 - middle  # fmt: skip
    return Measured(density, alone, mapped(given, alone))


def main() -> int:
    console = Console()
    peers = {"bayesfred": of_bayesfred, "photutils": of_photutils, "Piff": of_piff}
    if not find_spec("photutils"):
        del peers["photutils"]
    if not find_spec("piff"):
        del peers["Piff"]
    table = Table("FWHM, pixel", "", "PSF, worst", "PSF, rms", "star, mpx", "map, mpx")
    for fwhm in FWHM:
        true, problems = truth(fwhm), [problem(fwhm, seed) for seed in range(FRAMES)]
        for name, measure in peers.items():
            worst, square, alone, tied = [], [], [], []
            for given in problems:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    found = measure(given)
                off = (found.density - true) / true.max()
                worst.append(np.abs(off).max())
                square.append(np.mean(off**2))
                tied.append(np.mean((found.mapped - given.places) ** 2))
                if found.alone is not None:
                    alone.append(np.mean((found.alone - given.places) ** 2))
            single = f"{1e3 * np.sqrt(np.mean(alone)):.1f}" if alone else ""
            table.add_row(
                f"{fwhm}", name, f"{np.max(worst):.1%}", f"{np.sqrt(np.mean(square)):.2%}",
                single, f"{1e3 * np.sqrt(np.mean(tied)):.1f}",
            )  # fmt: skip
    console.print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())
