"""A simulated telescope: a frame of stars, and its calibration held against the truth.

    python examples/telescope.py simulate [--seed 1]
    python examples/telescope.py compare

`simulate` writes telescope_field.fits and telescope_stars.ecsv beside this file. Nothing of
bayesfred renders the frame: stars move from the epoch of the catalogue to the night by their proper
motion and are projected by the formulas below; a detector that is not quite perpendicular to the
axis tilts the image, and a lens distorts it,

    (x', y') = (x, y) / (1 + a x + b y),    (u, v) = (x', y') (1 + k r'^2),

and every pixel integrates a Moffat profile. `compare` asks where the calibration and its FITS
header image points of the sky, in units of the errors that the calibration states.
"""

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
import numpy.typing as npt
from astropy import units
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS, FITSFixedWarning

import bayesfred as bf
from bayesfred._typing import Floats

HERE = Path(__file__).parent
SHAPE = (600, 800)  # rows, columns
RA, DEC = 83.20, 22.05  # degrees, where the middle of the frame points
SCALE, ANGLE = 2.4, 27.0  # arcsec per pixel; from north through east to where rows are counted
TILT = (8e-7, -5e-7)  # a and b, 1 / pixel
LENS = 6.0 / 500.0**3  # k: 6 pixels in the corners
FWHM, BETA = 3.2, 3.0  # pixel
GAIN, READ_NOISE, BACKGROUND = 1.6, 5.0, 180.0  # e-/adu, e-, e-
YEARS = 24.0 + 44.86 / 366.0  # from the catalogue's epoch, 2000.0, to the night
NIGHT = "2024-02-14T21:40:00"
DEEPEST, CATALOGUED = 17.5, 16.2  # magnitudes of the faintest stars
ZERO_POINT = 25.0  # magnitude of a star of one electron


def project(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Floats, Floats]:
    """Ideal image points, pixel from the middle, of directions in degrees: gnomonic, turned."""
    a, d, d0 = np.radians(np.asarray(ra) - RA), np.radians(np.asarray(dec)), np.radians(DEC)
    along = np.sin(d0) * np.sin(d) + np.cos(d0) * np.cos(d) * np.cos(a)
    east = np.cos(d) * np.sin(a) / along
    north = (np.cos(d0) * np.sin(d) - np.sin(d0) * np.cos(d) * np.cos(a)) / along
    sin, cos = np.sin(np.radians(ANGLE)), np.cos(np.radians(ANGLE))
    pixels = np.degrees(1.0) * 3600.0 / SCALE
    return pixels * (north * sin - east * cos), pixels * (north * cos + east * sin)


def distort(x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Where the tilted detector and the lens put ideal image points."""
    depth = 1.0 + TILT[0] * x + TILT[1] * y
    x, y = x / depth, y / depth
    stretch = 1.0 + LENS * (x**2 + y**2)
    return x * stretch, y * stretch


def simulate(seed: int) -> int:
    """Write the frame and the catalogue: all stars are on the one, the brighter in the other."""
    rng = np.random.default_rng(seed)
    number = 1500  # in a field of 1 x 1 degree, four times the frame
    ra = RA + rng.uniform(-0.5, 0.5, number) / np.cos(np.radians(DEC))
    dec = DEC + rng.uniform(-0.5, 0.5, number)
    magnitude = DEEPEST + np.log10(rng.uniform(1e-2, 1.0, number)) / 0.35
    pm_ra, pm_dec = rng.normal(0.0, 15.0, (2, number))  # mas / year
    moved = 1e-3 / 3600.0 * YEARS
    now = ra + pm_ra * moved / np.cos(np.radians(dec)), dec + pm_dec * moved
    u, v = distort(*project(*now))
    counts = rng.poisson(expected(u, v, 10.0 ** (-0.4 * (magnitude - ZERO_POINT))))
    adu = np.rint((counts + rng.normal(0.0, READ_NOISE, SHAPE)) / GAIN)
    write_frame(adu)
    known = magnitude < CATALOGUED
    stars = Table(
        [
            (ra[known] / 15.0) * units.hourangle,
            dec[known] * units.deg,
            pm_ra[known] * units.mas / units.yr,
            pm_dec[known] * units.mas / units.yr,
            magnitude[known] + rng.normal(0.0, 0.1, known.sum()),
        ],
        names=["ra", "dec", "pm_ra", "pm_dec", "mag"],
    )
    stars.write(HERE / "telescope_stars.ecsv", overwrite=True)
    seen = (np.abs(u) < SHAPE[1] / 2) & (np.abs(v) < SHAPE[0] / 2)
    print(f"telescope_field.fits: {seen.sum()} stars, {(seen & known).sum()} of them catalogued")
    print(f"telescope_stars.ecsv: {known.sum()} stars")
    return 0


def expected(u: Floats, v: Floats, flux: Floats) -> Floats:
    """Expected electrons: each pixel is the mean of 5 x 5 points of it, out to 25 pixels."""
    image = np.full(SHAPE, BACKGROUND)
    gamma = FWHM / (2.0 * np.sqrt(2.0 ** (1.0 / BETA) - 1.0))
    peak = (BETA - 1.0) / (np.pi * gamma**2)
    column, row = u + (SHAPE[1] - 1) / 2, v + (SHAPE[0] - 1) / 2
    fine = (np.arange(5) - 2.0) / 5.0
    for c, r, f in zip(column, row, flux, strict=True):
        rows = np.arange(max(int(r) - 25, 0), min(int(r) + 26, SHAPE[0]))
        columns = np.arange(max(int(c) - 25, 0), min(int(c) + 26, SHAPE[1]))
        if rows.size and columns.size:
            dy = (rows[:, None] + fine - r).ravel() ** 2
            dx = (columns[:, None] + fine - c).ravel() ** 2
            profile = peak * (1.0 + (dy[:, None] + dx) / gamma**2) ** -BETA
            mean = profile.reshape(rows.size, 5, columns.size, 5).mean(axis=(1, 3))
            image[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] += f * mean
    return image


def write_frame(adu: Floats) -> None:
    """The frame, with the coordinate system of a mount that is some arcminutes and 1 % off."""
    sin, cos = np.sin(np.radians(ANGLE + 0.4)), np.cos(np.radians(ANGLE + 0.4))
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crpix = ("RA---TAN", "DEC--TAN"), (400.5, 300.5)
    wcs.wcs.crval = RA + 0.07, DEC - 0.05
    wcs.wcs.cd = 1.01 * SCALE / 3600.0 * np.array([[-cos, sin], [sin, cos]])
    header = wcs.to_header()
    header["DATE-OBS"] = NIGHT
    header["BUNIT"] = "adu"
    header["GAIN"] = GAIN, "e-/adu"
    header["RDNOISE"] = READ_NOISE, "e-"
    frame = fits.PrimaryHDU(adu.astype(np.float32), header)
    frame.writeto(HERE / "telescope_field.fits", overwrite=True)


def compare() -> int:
    """Print how far calibration and header are from the truth; whether the errors hold."""
    calibration = bf.Calibration.read("chains/telescope.calibration.h5")
    points = np.meshgrid(np.linspace(-385.0, 385.0, 40), np.linspace(-285.0, 285.0, 30))
    coordinates = unproject(*(p.ravel() for p in points))
    truth = np.array(distort(*project(coordinates.ra.deg, coordinates.dec.deg)))
    kept = calibration.inside(*truth)
    coordinates, truth = coordinates[kept], truth[:, kept]
    u, v, covariance = calibration.to_pixel(coordinates)
    off = np.array([u, v]) - truth
    error = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)).T
    z = off / error
    print(f"calibration, at {kept.sum()} points of the sky within the stars, pixel:")
    print(f"  off by {rms(off):.4f} rms, stated {rms(error):.4f}")
    print(f"  in units of the stated errors: {rms(z):.2f} rms, {np.abs(z).max():.1f} at most")
    at, sky_covariance = calibration.to_sky(*truth)
    east, north = coordinates.spherical_offsets_to(at)
    sky_z = np.array([east.arcsec, north.arcsec]) / np.sqrt(
        np.diagonal(sky_covariance, axis1=1, axis2=2).T
    )
    apart = coordinates.separation(at).mas
    print(f"on the sky: {rms(apart):.1f} mas rms; {rms(sky_z):.2f} errors along east and north")
    holds = rms(z) < 2.0 and np.abs(z).max() < 5.0
    if Path("header.fits").exists():
        with warnings.catch_warnings():  # astropy expects an image with the header
            warnings.simplefilter("ignore", FITSFixedWarning)
            wcs = WCS(fits.getheader("header.fits"))
        column, row = wcs.all_world2pix(coordinates.ra.deg, coordinates.dec.deg, 0)
        header_off = np.array(calibration.from_index(column, row)) - truth
        worst = np.abs(header_off / error).max()
        print(
            f"header.fits, by astropy: off by {rms(header_off):.4f} pixel rms, {worst:.1f} errors "
            "at most"
        )
        holds = holds and worst < 5.0
    return 0 if holds else 3


def unproject(x: Floats, y: Floats) -> SkyCoord:
    """The sky at ideal image points: `project` the other way, by astropy."""
    wcs = WCS(naxis=2)
    sin, cos = np.sin(np.radians(ANGLE)), np.cos(np.radians(ANGLE))
    wcs.wcs.ctype, wcs.wcs.crpix, wcs.wcs.crval = ("RA---TAN", "DEC--TAN"), (1.0, 1.0), (RA, DEC)
    wcs.wcs.cd = SCALE / 3600.0 * np.array([[-cos, sin], [sin, cos]])
    return SkyCoord(*wcs.wcs_pix2world(x, y, 0), unit="deg")


def rms(values: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("what", choices=("simulate", "compare"))
    parser.add_argument("--seed", type=int, default=1, help="of stars and noise")
    given = parser.parse_args()
    try:
        sys.exit(simulate(given.seed) if given.what == "simulate" else compare())
    except bf.InputError as error:
        sys.exit(f"telescope: {error}")
