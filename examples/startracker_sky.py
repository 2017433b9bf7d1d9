"""Calibrate one lens on four frames of the night sky, from RA and Dec alone, and compare.

    BAYESFRED_DATA=<folder with the frames> python examples/startracker_sky.py [--sample]

Every frame is fitted as `bayesfred fit --map-only` does (with --sample as `bayesfred fit` does,
an hour each), into chains/, and its calibration is written there as a FITS header (TAN-SIP).
Then the header's positions of the catalogue's stars are held against centroids: least-squares
Gaussians, which know nothing of the fit. A lens makes the four cubic terms x^3 and x y^2 of u,
x^2 y and y^3 of v equal: their mean is printed in pixels at 512 pixels from the middle, frame by
frame. Without --sample the verdict is "not trustworthy": the posterior is not normal, as the
scatter of the positions is next to zero.
"""

import sys
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import Table
from scipy import ndimage, optimize, special, stats

import bayesfred as bf
from bayesfred import settings
from bayesfred.calibration.wcs import sip
from bayesfred.io.frames import read_frame
from bayesfred.io.paths import resolve

HERE = Path(__file__).parent
FRAMES = ("alt60_azi45", "alt40_azi135", "alt40_azim135", "alt60_azim45")
CUBIC = ("f_x3", "f_xy2", "g_x2y", "g_y3")
RADIUS = 512.0
BRIGHT = 6.0  # magnitude
FAINTEST = 7.5  # of which centroids are taken
HALF = 3  # pixels on either side of a star's own that its centroid is fitted to


@dataclass(frozen=True)
class Found:
    """What a frame says.

    Attributes
    ----------
    radial, radial_sd : float, pixel at 512 pixels
    stars, bright : int
        With centroids.
    rms, bright_rms : float, pixel
        Of the header's positions less the centroids, along one axis.
    truncation : float, pixel
        Largest error of the header against the calibration.
    message : str
    """

    radial: float
    radial_sd: float
    stars: int
    bright: int
    rms: float
    bright_rms: float
    truncation: float
    message: str


def main() -> int:
    found = []
    for name in FRAMES:
        print(f"\n{name}")
        found.append(calibrate(name, map_only="--sample" not in sys.argv))
    print("\nframe           radial cubic / px   stars: rms / px   bright: rms / px")
    for name, f in zip(FRAMES, found, strict=True):
        print(
            f"{name:15} {f.radial:.3f} +- {f.radial_sd:.3f}      {f.stars:3d}  {f.rms:.4f}       "
            f"{f.bright:3d}  {f.bright_rms:.4f}"
        )
    mean, sd, p = agreement(found)
    print(f"all             {mean:.3f} +- {sd:.3f}      they agree: p = {p:.2f}")
    return 0


def calibrate(name: str, *, map_only: bool = True, folder: Path = Path("chains")) -> Found:
    """Fit a frame, write its header, and hold the header against centroids."""
    folder.mkdir(exist_ok=True)
    run_file = HERE / f"startracker_sky_{name}.toml"
    result = bf.commands.fit(run_file, map_only=map_only, overwrite=True, say=print)
    print(result.diagnostics.message)
    header = sip(bf.Calibration.from_chain(result.chain), 5)
    header.write(folder / f"startracker_sky_{name}.header.fits", overwrite=True)
    run = settings.read_settings(run_file)
    stars = Table.read(resolve(run.catalogue.path or "", run_file, must_exist=True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        at = np.array(header.wcs.world_to_pixel(SkyCoord(stars["ra"], stars["dec"], unit="deg")))
    frame = read_frame(
        resolve(run.frame.path, run_file, must_exist=True), gain=run.frame.gain,
        pedestal=run.frame.pedestal,
    )  # fmt: skip
    off, bright = [], []
    for k in np.flatnonzero(np.asarray(stars["mag"]) < FAINTEST):
        centroid = gaussian_centroid(frame.counts, frame.valid, at[:, k])
        if centroid is not None:
            off.append(centroid - at[:, k])
            bright.append(float(stars["mag"][k]) < BRIGHT)
    each, light = np.array(off), np.array(bright)
    radial, sd = radial_cubic(result.chain)
    return Found(
        radial, sd, len(each), int(light.sum()), float(np.sqrt(np.mean(each**2))),
        float(np.sqrt(np.mean(each[light] ** 2))), header.forward.largest,
        result.diagnostics.message,
    )  # fmt: skip


def gaussian_centroid(counts: np.ndarray, valid: np.ndarray, at: np.ndarray) -> np.ndarray | None:
    """The centroid near a pixel (column, row) by least squares; None where it is not to be had.

    The image is a Gaussian integrated over pixels, on a constant. Stars with a saturated or masked
    pixel, with a brighter one beside them, or known to less than 0.1 pixel have none.
    """
    if not np.isfinite(at).all():
        return None
    column, row = np.rint(at).astype(int)
    ny, nx = counts.shape
    if not (HALF < column < nx - HALF - 1 and HALF < row < ny - HALF - 1):
        return None
    window = np.s_[row - HALF : row + HALF + 1, column - HALF : column + HALF + 1]
    cut = counts[window]
    if not valid[window].all():
        return None
    peak = np.unravel_index(np.argmax(ndimage.gaussian_filter(cut, 0.7)), cut.shape)
    if max(abs(peak[0] - HALF), abs(peak[1] - HALF)) > 1:
        return None
    v, u = np.mgrid[-HALF : HALF + 1, -HALF : HALF + 1].astype(float)
    noise = np.sqrt(np.maximum(cut, np.median(counts)))

    def model(p: np.ndarray) -> np.ndarray:
        flux, x, y, s, level = p
        width = s * 2**0.5
        along = [
            0.5 * (special.erf((q - c + 0.5) / width) - special.erf((q - c - 0.5) / width))
            for q, c in ((u, x), (v, y))
        ]
        return np.asarray(level + flux * along[0] * along[1])

    level = float(np.median(cut))
    start = np.array([np.sum(cut - level), 0.0, 0.0, 0.8, level])
    fit = optimize.least_squares(lambda p: ((model(p) - cut) / noise).ravel(), start)
    covariance = np.linalg.pinv(fit.jac.T @ fit.jac)
    error = np.sqrt(0.5 * (covariance[1, 1] + covariance[2, 2]))
    near = max(abs(fit.x[1]), abs(fit.x[2])) < 1.0
    if not (fit.success and fit.x[0] > 0.0 and near and 0.3 < fit.x[3] < 1.2 and error < 0.1):
        return None
    return np.array([column + fit.x[1], row + fit.x[2]])


def radial_cubic(chain: bf.Chain) -> tuple[float, float]:
    """Weighted mean of the four terms that a lens makes equal, pixel at 512 pixels."""
    draws = chain.draws()[:, [chain.parameter_names.index(name) for name in CUBIC]]
    moved = -draws * RADIUS**3
    weight = np.linalg.inv(np.cov(moved, rowvar=False))
    variance = 1.0 / weight.sum()
    return float(variance * weight.sum(axis=0) @ moved.mean(axis=0)), float(np.sqrt(variance))


def agreement(found: list[Found]) -> tuple[float, float, float]:
    """Mean of the radial terms, its error, and the probability of a larger scatter by chance."""
    values, errors = np.array([(f.radial, f.radial_sd) for f in found]).T
    weight = errors**-2.0
    mean = float(weight @ values / weight.sum())
    chi2 = float(weight @ (values - mean) ** 2)
    return mean, float(weight.sum() ** -0.5), float(stats.chi2.sf(chi2, len(found) - 1))


if __name__ == "__main__":
    sys.exit(main())
