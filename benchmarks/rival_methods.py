"""What `benchmarks.rivals` compares: this package, and what people would pick instead.

Each method is used as its documentation recommends. A method turns a frame into the images of the
field's points with their standard deviations, if it quotes any. All but this package are told where
every star is imaged, to the nearest pixel. Those that fit a polynomial to centroids reject outliers
at 4 robust standard deviations and take the errors from the scatter of the residuals, as `polyfit`
and `curve_fit` do; so they know when centroids scatter more than their own errors say.

- `fit_given`, `fit_free`, `fit_remedied`: this package, from the counts alone: with fluxes and PSF
  given; with free fluxes and width; with the PSF measured on the frame or, where the catalogue is
  not complete, outliers rejected. `fit_from_places`: the first, told what the others are told.
- `psf_photometry`: photutils' PSFPhotometry with a Gaussian PRF of the given width, groups of
  neighbours together; `epsf_photometry`: the same with the PSF of its EPSFBuilder.
- `gaussian_centroids`: photutils' `centroid_2dg`; `windowed_centroids`: sep's `winpos`, on stars
  without catalogued neighbours.
- `sip`: astropy's `fit_wcs_from_points`, in place of the polynomial.
- `least_squares`: scipy's, of all pixels, fluxes and PSF given, derivatives by finite differences,
  residuals of 2 sqrt(n + 3/8), whose variance is one.
- `camera`: OpenCV's `calibrateCamera` of a grid of dots, focal length and principal point given, on
  the centroids named, or on those of its own `findCirclesGrid` (`circles`).
"""

from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, special

import bayesfred as bf
from benchmarks.rival_frames import (
    FOCAL_LENGTH,
    HALF,
    MIDDLE,
    POINTS,
    SHAPE,
    SIDE,
    Case,
    Frame,
    field_deviations,
    forward_model,
    images,
    jacobian,
)

OUTLIER = 4.0  # robust standard deviations
WINDOW = 3.5  # half-width of a star's pixels for least squares, FWHM


class Found(NamedTuple):
    """What a method found.

    Attributes
    ----------
    field : ndarray, shape (m, 2), pixel
    sd : ndarray, shape (m, 2), pixel, or None
    fits : bool or None
        Whether the method says that its model fits the counts.
    """

    field: np.ndarray
    sd: np.ndarray | None = None
    fits: bool | None = None


class Centroids(NamedTuple):
    """Positions with errors, shape (n, 2), pixel from the frame's middle; nan where there is none.

    Without errors of their own all have 1.
    """

    at: np.ndarray
    error: np.ndarray


# ------------------------------------------------------------------------------------ this package


def _posterior(frame: Frame, nuisances: bf.Nuisances) -> bf.Posterior:
    case = frame.case
    model = forward_model(case, frame.catalog, bf.GaussianPSF(case.sigma))
    return bf.Posterior(model, frame.counts, nuisances=nuisances)


def _found(case: Case, posterior: bf.Posterior, estimate: bf.MapEstimate) -> Found:
    names = posterior.parameter_names
    field = images(case, dict(zip(names, estimate.params, strict=True)), *POINTS.T)
    sd = field_deviations(case, names, estimate.covariance)
    return Found(field, sd, estimate.fits_data)


def fit_given(frame: Frame) -> Found:
    posterior = _posterior(frame, bf.Nuisances(offset=True))
    return _found(frame.case, posterior, bf.find_map(posterior))


def fit_from_places(frame: Frame) -> Found:
    posterior = _posterior(frame, bf.Nuisances(offset=True))
    names = posterior.parameter_names
    plain = np.stack([frame.catalog.x, frame.catalog.y], axis=1)
    along = jacobian(frame.case, names, plain).reshape(-1, len(names))
    start = np.linalg.lstsq(along, (frame.places - plain).ravel(), rcond=None)[0]
    start[names.index("background")] = np.median(frame.counts)
    return _found(frame.case, posterior, bf.find_map(posterior, start))


def fit_free(frame: Frame) -> Found:
    posterior = _posterior(frame, bf.Nuisances(flux="free", offset=True, psf_sigma=True))
    return _found(frame.case, posterior, bf.find_map(posterior))


def fit_remedied(frame: Frame) -> Found:
    posterior = _posterior(frame, bf.Nuisances(flux="free", offset=True, psf_sigma=True))
    if frame.case.uncatalogued:
        return _found(frame.case, *bf.reject_outliers(posterior))
    return _found(frame.case, *bf.measure_psf(posterior, bf.find_map(posterior)))


# --------------------------------------------------------------------------------------- centroids


def _subtracted(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    """The frame without its background, and its errors, by astropy and photutils."""
    from astropy.stats import sigma_clipped_stats
    from photutils.utils import calc_total_error

    mean, _, scatter = sigma_clipped_stats(frame.counts, sigma=3.0)
    image = frame.counts - mean
    return image, calc_total_error(image, np.full_like(image, scatter), 1.0)


def psf_photometry(frame: Frame) -> Centroids:
    from photutils.psf import CircularGaussianPRF

    return _fitted(frame, CircularGaussianPRF(fwhm=frame.case.fwhm))


def epsf_photometry(frame: Frame) -> Centroids:
    from astropy.nddata import NDData
    from astropy.table import Table
    from photutils.psf import EPSFBuilder, extract_stars

    places = Table((frame.places + MIDDLE)[frame.alone], names=["x", "y"])
    size = 2 * int(np.ceil(3.0 * frame.case.fwhm)) + 5
    stars = extract_stars(NDData(_subtracted(frame)[0]), places, size=size)
    build = EPSFBuilder(oversampling=4, maxiters=20, progress_bar=False)
    return _fitted(frame, build(stars)[0])


def _fitted(frame: Frame, psf: Any) -> Centroids:
    """Each star, or group of neighbours, by itself."""
    from astropy.table import Table
    from photutils.psf import PSFPhotometry, SourceGrouper

    image, error = _subtracted(frame)
    fwhm = frame.case.fwhm
    start = Table(frame.places + MIDDLE, names=["x_init", "y_init"])
    measure = PSFPhotometry(
        psf, max(5, int(3.0 * fwhm) | 1), grouper=SourceGrouper(2.0 * fwhm),
        aperture_radius=max(fwhm, 1.5), xy_bounds=3.0 * fwhm,
    )  # fmt: skip
    found = measure(image, error=error, init_params=start)
    found.sort("id")
    at, sd = (
        np.stack([np.ma.filled(found[name], np.nan) for name in names], axis=1)
        for names in (("x_fit", "y_fit"), ("x_err", "y_err"))
    )
    return Centroids(at - MIDDLE, sd)


def gaussian_centroids(frame: Frame) -> Centroids:
    from photutils.centroids import centroid_2dg, centroid_sources

    image, error = _subtracted(frame)
    start = (frame.places + MIDDLE).T
    box = max(5, int(np.ceil(3.0 * frame.case.fwhm)) | 1)
    at = np.stack(
        centroid_sources(image, *start, box_size=box, centroid_func=centroid_2dg, error=error),
        axis=1,
    )
    return _of_stars_alone(frame, at)


def windowed_centroids(frame: Frame) -> Centroids:
    import sep

    image = frame.counts - sep.Background(frame.counts).back()
    width = np.hypot(frame.case.sigma, 1.0 / np.sqrt(12.0))  # as the half-light radius has it
    x, y, _ = sep.winpos(image, *(frame.places + MIDDLE).T, width)
    return _of_stars_alone(frame, np.stack([x, y], axis=1))


def _of_stars_alone(frame: Frame, at: np.ndarray) -> Centroids:
    at = np.where(frame.alone[:, None], at - MIDDLE, np.nan)
    return Centroids(at, np.ones_like(at))


# ------------------------------------------------------------------------------- what is fitted to


def monomials(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """x^i y^j with i + j <= 3, the field's half-width as unit: shape (n, 10)."""
    x, y = x / HALF, y / HALF
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _kept(frame: Frame, centroids: Centroids) -> tuple[np.ndarray, np.ndarray]:
    """Which centroids are no outliers, and the polynomial's coefficients, shape (10, 2)."""
    design = monomials(frame.catalog.x, frame.catalog.y)
    usable = np.isfinite(centroids.at).all(axis=1) & (centroids.error > 0.0).all(axis=1)
    usable &= np.isfinite(centroids.error).all(axis=1)
    good, found = usable, np.zeros((design.shape[1], 2))
    for _ in range(10):
        for axis in range(2):
            w = 1.0 / centroids.error[good, axis]
            found[:, axis] = np.linalg.lstsq(
                design[good] * w[:, None], centroids.at[good, axis] * w, rcond=None
            )[0]
        off = np.abs(centroids.at - design @ found) / centroids.error
        before, good = good, usable & (off < OUTLIER * 1.4826 * np.median(off[good])).all(axis=1)
        if (good == before).all():
            break
    return good, found


def polynomial(frame: Frame, centroids: Centroids) -> Found:
    good, found = _kept(frame, centroids)
    design, along = monomials(frame.catalog.x, frame.catalog.y)[good], monomials(*POINTS.T)
    sd = np.empty_like(POINTS)
    for axis in range(2):
        w = 1.0 / centroids.error[good, axis]
        off = (centroids.at[good, axis] - design @ found[:, axis]) * w
        scatter = off @ off / (off.size - design.shape[1])
        covariance = scatter * np.linalg.inv((design * w[:, None] ** 2).T @ design)
        sd[:, axis] = np.sqrt(np.einsum("ij,jk,ik->i", along, covariance, along))
    return Found(along @ found, sd)


def sip(frame: Frame, centroids: Centroids) -> Found:
    """The world is the catalogue on a tangent plane, a minute of arc a pixel.

    Up to astropy 8.0 the fit takes SIP's polynomial one pixel off its place (pull request 20383);
    that is put right here, and of both readings the one that agrees with the centroids is taken.
    """
    from astropy.coordinates import SkyCoord
    from astropy.wcs import WCS, Sip
    from astropy.wcs.utils import fit_wcs_from_points

    good, _ = _kept(frame, centroids)
    sky = WCS(naxis=2)
    sky.wcs.ctype, sky.wcs.crval, sky.wcs.crpix = ["RA---TAN", "DEC--TAN"], [40.0, 10.0], [1.0, 1.0]
    sky.wcs.cdelt = [-1.0 / 60.0, 1.0 / 60.0]
    stars = sky.pixel_to_world(frame.catalog.x[good], frame.catalog.y[good])
    points, at = sky.pixel_to_world(*POINTS.T), centroids.at[good] + MIDDLE
    centre = SkyCoord(*sky.wcs.crval, unit="deg")
    lens = fit_wcs_from_points(at.T, stars, proj_point=centre, sip_degree=3)
    readings = []
    for shift in (0, 1):
        lens.sip = Sip(lens.sip.a, lens.sip.b, lens.sip.ap, lens.sip.bp, lens.wcs.crpix + shift)
        back, field = (
            np.stack(lens.all_world2pix(sky.ra.deg, sky.dec.deg, 1 - shift), axis=1)
            for sky in (stars, points)
        )
        readings.append((float(np.mean((back - at) ** 2)), field - MIDDLE))
    return Found(min(readings, key=lambda reading: reading[0])[1])


# ---------------------------------------------------------------------------------- the full image


def least_squares(frame: Frame) -> Found:
    case, counts = frame.case, frame.counts.ravel()
    half = int(np.ceil(WINDOW * case.fwhm))
    ny, nx = frame.counts.shape
    corner = (frame.places + MIDDLE).astype(int) - half
    pixel = corner[:, :, None] + np.arange(2 * half + 1)  # column and row of every star's window
    edges = pixel - 0.5 - MIDDLE[None, :, None]
    edges = np.concatenate([edges, edges[:, :, -1:] + 1.0], axis=2)
    inside = ((pixel[:, 0] >= 0) & (pixel[:, 0] < nx))[:, None, :]
    inside = inside & ((pixel[:, 1] >= 0) & (pixel[:, 1] < ny))[:, :, None]
    place = np.where(inside, pixel[:, 1, :, None] * nx + pixel[:, 0, None, :], 0).ravel()
    flux = frame.catalog.flux[:, None, None] * inside
    design, along = monomials(frame.catalog.x, frame.catalog.y), monomials(*POINTS.T)
    plain = np.stack([frame.catalog.x, frame.catalog.y], axis=1)
    data = 2.0 * np.sqrt(counts + 0.375)

    def residuals(z: np.ndarray) -> np.ndarray:
        at = plain + design @ z[:-1].reshape(2, -1).T
        parts = np.diff(special.ndtr((edges - at[:, :, None]) / case.sigma), axis=2)
        light = flux * parts[:, 1, :, None] * parts[:, 0, None, :]
        mean = np.bincount(place, light.ravel(), counts.size) + z[-1]
        return 2.0 * np.sqrt(np.maximum(mean, 0.0) + 0.375) - data

    moved = np.linalg.lstsq(design, frame.places - plain, rcond=None)[0]
    best = optimize.least_squares(residuals, np.append(moved.T, np.median(counts)), method="lm")
    covariance = np.linalg.inv(best.jac.T @ best.jac)[:-1, :-1].reshape(2, 10, 2, 10)
    sd = [np.sqrt(np.einsum("ij,jk,ik->i", along, covariance[a, :, a], along)) for a in range(2)]
    return Found(POINTS + along @ best.x[:-1].reshape(2, -1).T, np.stack(sd, axis=1))


# ------------------------------------------------------------------------------------ dots, OpenCV


def circles(frame: Frame) -> Centroids:
    import cv2

    grey = np.rint(frame.counts * (255.0 / frame.counts.max())).astype(np.uint8)
    settings = cv2.SimpleBlobDetector_Params()
    settings.blobColor, settings.minDistBetweenBlobs = 255, 5.0
    settings.minThreshold, settings.maxThreshold = 30.0, 230.0
    settings.minArea, settings.minConvexity = 5.0, 0.7  # dots of few pixels
    detector = cv2.SimpleBlobDetector_create(settings)
    flags = cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING
    found, at = cv2.findCirclesGrid(grey, (SIDE, SIDE), flags=flags, blobDetector=detector)
    if not found:
        return Centroids(*np.full((2, SIDE**2, 2), np.nan))
    at = at.reshape(-1, 2) - MIDDLE  # in any of the grid's orders
    nearest = np.hypot(*(at[:, None] - frame.places).T).argmin(axis=1)
    return Centroids(at[nearest], np.ones_like(at))


def camera(frame: Frame, centroids: Centroids) -> Found:
    import cv2

    ny, nx = SHAPE
    s, good = frame.catalog, np.isfinite(centroids.at).all(axis=1)
    if not good.any():
        return Found(np.full_like(POINTS, np.nan))
    target = np.stack([s.x, s.y, np.zeros_like(s.x)], axis=1)[good].astype(np.float32)
    at = (centroids.at + MIDDLE)[good].astype(np.float32)
    known = np.array([[FOCAL_LENGTH, 0, MIDDLE[0]], [0, FOCAL_LENGTH, MIDDLE[1]], [0, 0, 1]])
    flags = (
        cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_FOCAL_LENGTH | cv2.CALIB_FIX_PRINCIPAL_POINT
    )
    _, matrix, lens, turn, shift = cv2.calibrateCamera(
        [target], [at], (nx, ny), known, np.zeros(5), flags=flags
    )
    points = np.append(POINTS, np.zeros((len(POINTS), 1)), axis=1)
    field, _ = cv2.projectPoints(points, turn[0], shift[0], matrix, lens)
    return Found(field.reshape(-1, 2) - MIDDLE)
