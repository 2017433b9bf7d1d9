"""Corrected frames: counts, noise and positions are conserved, and errors are what they should be.

`overlap` is the area common to a quadrilateral and a pixel by clipping polygons, one by one.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from drizzle.resample import Drizzle

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.calibration.correct import correct
from bayesfred.calibration.corrected import CorrectedFrame, read_cards, read_grid
from bayesfred.calibration.overlaps import corners
from bayesfred.errors import InputError
from bayesfred.io.frames import read_frame
from bayesfred.io.tangent_plane import TangentPlane

CUBIC = bf.PolynomialDistortion.polynomial(3)
RADIAL = ("f_x3", "f_xy2", "g_x2y", "g_y3")
SKY = TangentPlane(10.0, 20.0, ((-1e-4, 2e-5), (2e-5, 1e-4)), (3.0, -2.0))


def calibration_of(
    shape: tuple[int, int] = (120, 100),
    *,
    radial: float = 0.0,
    scale: float = 0.0,
    offset: tuple[float, float] = (0.0, 0.0),
    error: float = 1e-3,
    binning: int = 1,
    sky: TangentPlane | None = None,
) -> bf.Calibration:
    """A radial distortion of this share of the half-height; positions of stars are in error."""
    half = 0.5 * binning * shape[0]
    theta = np.where(np.isin(CUBIC.names, RADIAL), radial / half**2, 0.0)
    theta += np.where(np.isin(CUBIC.names, ("f_x", "g_y")), scale, 0.0)
    rng = np.random.default_rng(5)
    u, v = half * rng.uniform(-1.0, 1.0, (2, 60))
    one, none = np.ones((60, 1)), np.zeros((60, 1))
    design = CUBIC.design_matrix(u, v, u, v)
    rows = np.vstack([np.hstack([design[0], one, none]), np.hstack([design[1], none, one])])
    size = np.linalg.norm(rows, axis=0)
    noise = rng.normal(0.0, error, (80, len(rows)))
    fitted = np.linalg.lstsq(rows / size, noise.T, rcond=None)[0].T / size
    fitted -= fitted.mean(axis=0)
    draws = np.hstack([theta, offset]) + fitted
    detector = bf.Detector(shape, binning=binning)
    return bf.Calibration(
        CUBIC, draws, detector, bf.GaussianPSF(2.0), 2.0, np.column_stack([u, v]), sky
    )


def star_field(
    calibration: bf.Calibration, flux: float = 1e5, background: float = 0.0, sigma: float = 2.5
) -> tuple[Floats, Floats, Floats]:
    """Expected counts of stars, and their object points."""
    ny, nx = calibration.detector.shape
    binning = calibration.detector.binning
    half_y, half_x = (0.5 * ny - 25.0) * binning, (0.5 * nx - 25.0) * binning
    x, y = (p.ravel() for p in np.meshgrid(np.linspace(-half_x, half_x, 3) + 0.3,
                                           np.linspace(-half_y, half_y, 3) - 0.2))  # fmt: skip
    catalog = bf.SourceCatalog(x, y, np.full(x.size, flux))
    model = bf.ForwardModel(calibration.detector, catalog, bf.GaussianPSF(sigma), CUBIC)
    mean = calibration.positions.mean
    assert np.abs(mean[-2:]).max() < 1e-12
    return model.expected_counts(mean[:-2], background), x, y


def smooth_field(calibration: bf.Calibration, brightness: Any) -> Floats:
    """The integral of an object's brightness over recorded pixels, by Gauss's rule."""
    ny, nx = calibration.detector.shape
    nodes, weights = np.polynomial.legendre.leggauss(3)
    rows, columns = np.indices((ny, nx), dtype=float)
    mean, total = calibration.positions.mean, np.zeros((ny, nx))
    for p, by_p in zip(0.5 * nodes, 0.5 * weights, strict=True):
        for q, by_q in zip(0.5 * nodes, 0.5 * weights, strict=True):
            u, v = calibration.from_index(columns + p, rows + q)
            x, y = CUBIC.object_position(mean[:-2], u, v, offset=mean[-2:])
            d = CUBIC.determinant(mean[:-2], u, v, x, y)
            a = calibration.positions.slope((u, v, x, y), images=False)
            area = np.abs(d / np.linalg.det(a)) * calibration.detector.binning**2
            total += by_p * by_q * area * brightness(x, y)
    return total


def waves(x: Floats, y: Floats) -> Floats:
    return np.asarray(1000.0 * (1.0 + 0.3 * np.sin(x / 15.0) + 0.2 * np.cos(y / 12.0)))


def grid_like(scale: float, degrees: float, shape: tuple[int, int], *, parity: float = 1.0) -> WCS:
    """A turned celestial grid around the middle of `SKY`'s frame."""
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ("RA---TAN", "DEC--TAN")
    wcs.wcs.crval = tuple(float(p) for p in SKY.to_sky(0.0, 0.0))
    wcs.wcs.crpix = (0.5 * (shape[1] + 1), 0.5 * (shape[0] + 1))
    angle = np.radians(degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    wcs.wcs.cd = scale * np.diag([-parity, 1.0]) @ turn
    wcs.wcs.set()
    return wcs


def overlap(x: Floats, y: Floats, column: int, row: int) -> float:
    """The area of a quadrilateral within a pixel, by clipping it at the pixel's four sides."""
    polygon = list(zip(x, y, strict=True))
    for axis, sign, limit in ((0, 1, column - 0.5), (0, -1, column + 0.5),
                              (1, 1, row - 0.5), (1, -1, row + 0.5)):  # fmt: skip
        kept = []
        for p, q in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            s, t = sign * (p[axis] - limit), sign * (q[axis] - limit)
            if s >= 0.0:
                kept.append(p)
            if s * t < 0.0:
                kept.append(tuple(np.array(p) + s / (s - t) * (np.array(q) - p)))
        polygon = kept
    if len(polygon) < 3:
        return 0.0
    a, b = np.array(polygon).T
    return float(abs(0.5 * np.sum(a * np.roll(b, -1) - b * np.roll(a, -1))))


# --- counts ---------------------------------------------------------------------------------------


def test_without_distortion_the_frame_comes_back() -> None:
    calibration = calibration_of()
    frame = np.random.default_rng(1).poisson(3.0, (120, 100)).astype(float)
    corrected = correct(frame, calibration)
    assert np.allclose(corrected.counts, frame, rtol=2e-7, atol=1e-6)
    noise = corrected.variance - corrected.calibration_variance
    assert np.allclose(noise, np.maximum(frame, 1.0), rtol=1e-6)
    assert corrected.valid.all()
    assert np.allclose(corrected.coverage, 1.0, atol=1e-6)
    assert np.allclose(corrected.wcs.pixel_to_world_values(49.5, 59.5), 0.0)


def test_overlaps_are_those_of_polygons_clipped_one_by_one() -> None:
    calibration = calibration_of((11, 13), radial=-0.15, offset=(0.3, -0.2), sky=SKY)
    rng = np.random.default_rng(2)
    frame, variance = rng.uniform(50.0, 100.0, (2, 11, 13))
    mask = rng.uniform(size=(11, 13)) > 0.1
    wcs = grid_like(0.9e-4, 25.0, (15, 14))
    corrected = correct(frame, calibration, wcs=wcs, shape=(15, 14), variance=variance, mask=mask)
    around = np.indices((13, 15))[::-1] - 1.0
    x, y = calibration.positions.object(*calibration.from_index(*around))[:2]
    at = [corners(p) for p in wcs.world_to_pixel_values(*SKY.to_sky(x, y))]
    expected = np.zeros((3, 15, 14))
    for i, j in np.argwhere(mask):
        quad = [np.array([p[i, j], p[i, j + 1], p[i + 1, j + 1], p[i + 1, j]]) for p in at]
        area = 0.5 * abs(np.sum(quad[0] * np.roll(quad[1], -1) - quad[1] * np.roll(quad[0], -1)))
        for row, column in np.ndindex(15, 14):
            share = overlap(*quad, column, row)
            expected[:, row, column] += (
                frame[i, j] * share / area, variance[i, j] * (share / area) ** 2, share
            )  # fmt: skip
    noise = corrected.variance - corrected.calibration_variance
    for found, right in zip((corrected.counts, noise, corrected.coverage), expected, strict=True):
        assert np.abs(found - right).max() < 1e-5 * right.max()
    assert np.array_equal(corrected.valid, expected[2] > 1.0 - 1e-4)


@pytest.mark.parametrize("field", ["stars", "smooth", "noise"])
@pytest.mark.parametrize(("radial", "binning"), [(0.05, 1), (-0.05, 1), (0.05, 2), (0.0, 2)])
def test_counts_are_conserved(field: str, radial: float, binning: int) -> None:
    calibration = calibration_of(radial=radial, binning=binning, sky=SKY)
    if field == "stars":
        frame = star_field(calibration, 1e6)[0]
    elif field == "smooth":
        frame = smooth_field(calibration, waves)
    else:
        frame = np.random.default_rng(3).normal(10.0, 30.0, calibration.detector.shape)
    mirrored = grid_like(1.1e-4 * binning, 30.0, (200, 190), parity=-1.0)
    for grid in ({}, {"wcs": mirrored, "shape": (200, 190)}):
        corrected = correct(frame, calibration, **grid)
        assert corrected.counts.sum() == pytest.approx(frame.sum(), rel=1e-6)
        assert corrected.counts.shape != frame.shape or not radial


def test_a_grid_that_cuts_the_frame_has_what_the_whole_one_has() -> None:
    """And `drizzle` alone has not: it omits pixels where the edges of a frame are curved."""
    calibration = calibration_of((150, 150), radial=-0.06, sky=SKY)
    frame = smooth_field(calibration, waves)
    whole = correct(frame, calibration)
    for row, column, n in ((40, 12, 100), (5, 30, 60)):
        wcs = whole.wcs[row : row + n, column : column + n]
        cut = correct(frame, calibration, wcs=wcs, shape=(n, n))
        part = np.s_[row : row + n, column : column + n]
        for name in ("counts", "variance", "calibration_variance", "coverage"):
            found, right = getattr(cut, name), getattr(whole, name)[part]
            assert np.allclose(found, right, rtol=1e-4, atol=1e-5 * right.max()), name
    rows, columns = np.indices((150, 150))
    x, y = calibration.positions.object(*calibration.from_index(columns, rows))[:2]
    low = calibration.index(*calibration.from_index(np.array(12), np.array(40)))
    at = np.dstack(calibration.index(x, y)) - low
    drizzled = Drizzle("square", 0.0, 0.0, out_shape=(100, 100), disable_ctx=True)
    drizzled.add_image(frame.astype(np.float32), exptime=1.0, pixmap=at)
    alone = float(np.sum(drizzled.out_img * drizzled.out_wht))
    rightly = Drizzle("square", 0.0, 0.0, out_shape=(300, 300), disable_ctx=True)
    rightly.add_image(frame.astype(np.float32), exptime=1.0, pixmap=at + 100.0)
    there = (rightly.out_img * rightly.out_wht)[100:200, 100:200].sum()
    assert alone < 0.999 * there


def test_brightness_is_right_everywhere() -> None:
    """Of single pixels within a share of the change from one to the next; of fields exactly.

    The counts of a pixel are spread evenly. Where it covers more than an output pixel, that does
    not see the change of brightness within it.
    """
    for radial, binning in ((0.05, 1), (-0.05, 1), (0.05, 2)):
        calibration = calibration_of(radial=radial, binning=binning)
        corrected = correct(smooth_field(calibration, waves), calibration)
        rows, columns = np.indices(corrected.counts.shape)
        x, y = corrected.wcs.pixel_to_world_values(columns, rows)
        # integrals of sines over a pixel
        s, c = (np.sinc(binning / (2.0 * np.pi * w)) for w in (15.0, 12.0))
        right = 1000.0 * (1.0 + 0.3 * s * np.sin(x / 15.0) + 0.2 * c * np.cos(y / 12.0))
        inner = corrected.valid
        off = np.where(inner, corrected.counts / binning**2 - right, np.nan)
        step = 1000.0 * binning * np.hypot(0.3 / 15.0, 0.2 / 12.0)
        assert np.nanmax(np.abs(off)) < 0.2 * step
        fields = off[: len(off) // 8 * 8, : off.shape[1] // 8 * 8]
        fields = fields.reshape(len(off) // 8, 8, -1, 8).mean(axis=(1, 3))
        assert np.nanmax(np.abs(fields)) < 0.001 * binning * 1000.0
        even = correct(smooth_field(calibration, lambda x, y: 1000.0 + 0.0 * x), calibration)
        assert np.abs(even.counts[inner] / binning**2 / 1000.0 - 1.0).max() < 3e-4


CROSS = ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0))


@pytest.mark.parametrize("binning", [1, 2])
def test_stars_keep_their_flux_and_stand_at_their_object_points(binning: int) -> None:
    calibration = calibration_of((400, 360), radial=0.05, binning=binning)
    frame, x, y = star_field(calibration, sigma=2.5 * binning)
    corrected = correct(frame, calibration)
    # the mean of the map over a PSF that is symmetric on the frame
    u, v, _ = calibration.positions.image(x, y)
    around = [calibration.positions.object(u + p, v + q)[:2] for p, q in CROSS]
    bend = 0.5 * 2.5**2 * (np.sum(around, axis=0) - 4.0 * np.array([x, y])) * binning**2
    columns, rows = corrected.wcs.world_to_pixel_values(x + bend[0], y + bend[1])
    assert np.abs(bend).max() < 0.02 * binning
    moved = np.hypot(*(np.array(calibration.to_image(x, y)[:2]) - [x, y]))
    assert moved.max() > 2.0  # pixel: the distortion is felt
    for column, row in zip(columns, rows, strict=True):
        flux, at = centroid(corrected.counts, column, row)
        assert flux == pytest.approx(1e5, rel=2e-5)
        assert np.hypot(*(at - (column, row))) < 0.01


def centroid(counts: Floats, column: float, row: float, radius: int = 15) -> tuple[float, Floats]:
    first = round(row) - radius, round(column) - radius
    box = counts[first[0] : first[0] + 2 * radius + 1, first[1] : first[1] + 2 * radius + 1]
    q, p = np.indices(box.shape)
    at = np.array([np.sum(p * box), np.sum(q * box)]) / box.sum()
    return float(box.sum()), at + first[::-1]


def test_counts_of_bad_pixels_are_not_used() -> None:
    calibration = calibration_of(radial=0.05)
    frame = smooth_field(calibration, waves)
    mask = np.random.default_rng(4).uniform(size=frame.shape) > 0.05
    corrected = correct(np.where(mask, frame, 1e12), calibration, mask=mask)
    same = correct(np.where(mask, frame, np.nan), calibration, mask=mask)
    masked = correct(np.ma.masked_array(frame, ~mask), calibration)
    for other in (same, masked):
        for name in ("counts", "variance", "coverage", "valid"):
            assert np.array_equal(getattr(corrected, name), getattr(other, name))
    assert corrected.counts.sum() == pytest.approx(frame[mask].sum(), rel=1e-6)
    whole = correct(frame, calibration)
    holes = whole.valid & ~corrected.valid
    assert holes.any()
    assert (corrected.coverage[holes] < 1.0).all()
    # where a field is smooth, counts by covered area are what they are without holes
    some = whole.valid & (corrected.coverage > 0.3)
    by_area = corrected.counts[some] / corrected.coverage[some] / whole.counts[some]
    assert np.abs(by_area - 1.0).max() < 0.03


# --- the sky --------------------------------------------------------------------------------------


def test_the_grid_points_where_the_calibration_does() -> None:
    calibration = calibration_of((400, 360), radial=0.01, sky=SKY)
    frame, x, y = star_field(calibration)
    u, v, _ = calibration.positions.image(x, y)
    with pytest.warns(bf.ExtrapolationWarning):
        stars, _ = calibration.to_sky(u, v)
    turned = grid_like(0.9e-4, 65.0, (600, 600))
    grids: list[dict[str, Any]] = [{}, {"wcs": turned, "shape": (600, 600)}]
    turned.array_shape = (600, 600)
    grids.append({"wcs": turned})
    galactic = WCS(naxis=2)
    galactic.wcs.ctype = ("GLON-SIN", "GLAT-SIN")
    middle = SkyCoord(*SKY.to_sky(0.0, 0.0), unit="deg").galactic
    galactic.wcs.crval = (middle.l.deg, middle.b.deg)
    galactic.wcs.crpix, galactic.wcs.cdelt = (300.0, 300.0), (-0.9e-4, 0.9e-4)
    grids.append({"wcs": galactic, "shape": (600, 600)})
    for grid in grids:
        corrected = correct(frame, calibration, **grid)
        for at in stars:
            column, row = corrected.wcs.world_to_pixel(at)
            flux, found = centroid(corrected.counts, float(column), float(row))
            assert flux == pytest.approx(1e5, rel=1e-5)
            assert np.abs(found - (column, row)).max() < 0.01


# --- errors ---------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_calibrations_variance_is_that_of_frames_corrected_with_its_draws() -> None:
    """The draws are those of the calibration, so that there is no Monte Carlo error."""
    calibration = calibration_of((80, 80), radial=0.05, error=0.005, sky=SKY)
    frame = star_field(calibration, 1e5, 200.0)[0]
    shape, wcs = (110, 110), grid_like(0.9e-4, 20.0, (110, 110))
    corrected = correct(frame, calibration, wcs=wcs, shape=shape)
    found = variance_of_draws(calibration, frame, wcs, shape)
    predicted = corrected.calibration_variance
    stars = corrected.valid & (found > np.quantile(found[corrected.valid], 0.9))
    dark = corrected.valid & (corrected.counts < 1.05 * np.median(corrected.counts))
    assert stars.sum() > 300
    assert dark.sum() > 1000
    for some in (stars, dark):
        assert agree(predicted[some], found[some])
        # deliberately wrong: as if the counts of the output were smooth
        assert not agree(gradient_alone(calibration, corrected)[some], found[some])


def agree(predicted: Floats, found: Floats) -> bool:
    """In the mean to 3 %, and pixel by pixel: the draws' second order is not in the prediction."""
    ratio = np.mean(predicted) / np.mean(found)
    return bool(abs(ratio - 1.0) < 0.03 and np.corrcoef(predicted, found)[0, 1] > 0.99)


def test_of_an_even_field_the_calibrations_variance_is_that_of_the_areas() -> None:
    """The gradient vanishes; the counts change with the area over which they are spread."""
    calibration = calibration_of((80, 80), error=0.01)
    corrected = correct(np.full((80, 80), 1e4), calibration)
    x, y = np.meshgrid(np.arange(2, 78, 5) - 39.5, np.arange(2, 78, 5) - 39.5)
    step, area = 1e-2, np.zeros((len(calibration.draws), *x.shape))
    for out, draw in zip(area, calibration.draws, strict=True):
        for axis, (p, q) in enumerate(((step, 0.0), (0.0, step))):
            ends = [
                CUBIC.object_position(draw[:-2], x + s * p, y + s * q, offset=draw[-2:])[axis]
                for s in (-1.0, 1.0)
            ]
            out += (ends[1] - ends[0]) / (2.0 * step) - 1.0
    right = 1e8 * area.var(axis=0, ddof=1)
    assert np.allclose(corrected.calibration_variance[2:78:5, 2:78:5], right, rtol=0.02)


def variance_of_draws(
    calibration: bf.Calibration, frame: Floats, wcs: WCS, shape: tuple[int, int]
) -> Floats:
    """The variance of the counts of a frame that is corrected with each draw."""
    sums = np.zeros((2, *shape))
    middle = correct(frame, calibration, wcs=wcs, shape=shape).counts
    for draw in calibration.draws:
        one = dataclasses.replace(calibration, draws=[draw, draw])
        off = correct(frame, one, wcs=wcs, shape=shape).counts - middle
        sums += off, off**2
    n = len(calibration.draws)
    return np.asarray((sums[1] - sums[0] ** 2 / n) / (n - 1))


def gradient_alone(calibration: bf.Calibration, corrected: CorrectedFrame) -> Floats:
    """grad F^T cov(x, y) grad F."""
    rows, columns = np.indices(corrected.counts.shape, dtype=float)
    x, y = SKY.to_plane(*corrected.wcs.pixel_to_world_values(columns, rows))
    u, v, _ = calibration.positions.image(x, y)
    covariance = calibration.positions.object(u, v)[2]
    slope = np.stack([np.stack(np.gradient(p)[::-1], -1) for p in (x, y)], -2)
    gradient = np.stack(np.gradient(corrected.counts)[::-1], -1)
    along = np.linalg.solve(np.swapaxes(slope, -1, -2), gradient[..., None])[..., 0]
    return np.asarray(np.einsum("...i,...ij,...j->...", along, covariance, along))


def test_the_errors_of_corrected_frames_are_those_they_state() -> None:
    """Noise and an error of the calibration together; without its part the errors are too small."""
    calibration = calibration_of((80, 80), radial=0.05, error=0.03)
    expected = star_field(calibration, 4e6, 50.0)[0]
    rng = np.random.default_rng(6)
    truth = correct(expected, calibration)
    bright = truth.valid & (truth.counts > 1000.0)
    whole, part = [], []
    for draw in calibration.draws[:40]:
        # the light is where one draw has it, and is put where the mean has it: to first order the
        # same as the opposite
        frame = rng.poisson(expected).astype(float)
        corrected = correct(frame, calibration)
        one = dataclasses.replace(calibration, draws=[draw, draw])
        right = on_grid(correct(expected, one), truth)
        off = (corrected.counts - right)[bright] ** 2
        noise = corrected.variance - corrected.calibration_variance
        whole.append(np.mean(off / corrected.variance[bright]))
        part.append(np.mean(off / noise[bright]))
    assert holds(whole)
    assert not holds(part)


def on_grid(found: CorrectedFrame, like: CorrectedFrame) -> Floats:
    """Counts of one corrected frame on the grid of another, which is shifted by whole pixels."""
    by = np.rint(found.wcs.wcs.crpix - like.wcs.wcs.crpix).astype(int)
    out = np.zeros((like.counts.shape[0] + 8, like.counts.shape[1] + 8))
    top, left = 4 - by[1], 4 - by[0]
    out[top : top + found.counts.shape[0], left : left + found.counts.shape[1]] = found.counts
    return out[4:-4, 4:-4]


def holds(chi_square: list[float]) -> bool:
    """Whether the mean over frames is 1 within 4 standard errors and the 5 % of the first order."""
    values = np.array(chi_square)
    error = values.std(ddof=1) / np.sqrt(values.size)
    return bool(abs(values.mean() - 1.0) < 4.0 * error + 0.05)


def test_the_noise_of_neighbours_is_correlated_as_the_documentation_says() -> None:
    """Over pixels at all phases the correlation is 0.25, and the variance 4/9 of the input's."""
    calibration = calibration_of((400, 400), scale=0.005)  # 0 to 1 pixel
    rng = np.random.default_rng(7)
    corrected = correct(rng.normal(0.0, 1.0, (400, 400)), calibration, variance=1.0)
    noise, inner = corrected.counts, corrected.valid
    inner[[0, -1]] = inner[:, [0, -1]] = False
    two = inner[:, 1:] & inner[:, :-1]
    pairs = (noise[:, 1:] * noise[:, :-1])[two].mean() / (noise[inner] ** 2).mean()
    # 130,000 pixels with some 60,000 degrees of freedom: errors of 0.006
    assert pairs == pytest.approx(0.25, abs=0.025)
    assert (noise[inner] ** 2).mean() == pytest.approx(4.0 / 9.0, rel=0.05)
    assert corrected.variance[inner].mean() == pytest.approx(4.0 / 9.0, rel=0.04)


# --- files ----------------------------------------------------------------------------------------


def test_a_file_holds_all_planes_and_what_remains_true_of_the_header(tmp_path: Path) -> None:
    calibration = calibration_of((40, 50), radial=0.05, sky=SKY)
    mask = np.ones((40, 50), dtype=bool)
    mask[20, 30] = False
    corrected = correct(np.full((40, 50), 100.0), calibration, mask=mask)
    stored = fits.Header({"OBJECT": "Vega", "GAIN": 2.0, "CRVAL1": 1.0, "DATE-OBS": "2020-01-01"})
    stored.add_comment("pixels as they are")
    fits.PrimaryHDU(np.ones((3, 3)), stored).writeto(tmp_path / "frame.fits")
    path = tmp_path / "corrected.fits"
    corrected.write(path, header=read_cards(tmp_path / "frame.fits"))
    with fits.open(path, checksum=True) as hdus:
        names = ["SCI", "VAR", "CALVAR", "DQ", "COVERAGE"]
        assert [hdu.name for hdu in hdus] == names
        planes = [corrected.counts, corrected.variance, corrected.calibration_variance,
                  ~corrected.valid, corrected.coverage]  # fmt: skip
        for hdu, plane in zip(hdus, planes, strict=True):
            assert np.array_equal(hdu.data, plane.astype(hdu.data.dtype.newbyteorder("=")))
            there = WCS(hdu.header).pixel_to_world(7.0, 9.0)
            assert there.separation(corrected.wcs.pixel_to_world(7.0, 9.0)).arcsec < 1e-6
        header = hdus[0].header
        assert (header["OBJECT"], header["DATE-OBS"]) == ("Vega", "2020-01-01")
        assert "GAIN" not in header
        assert "pixels as they are" not in str(header)
    back = read_frame(path, saturation=np.inf)
    assert np.array_equal(back.valid, corrected.valid)
    with pytest.raises(InputError, match="exists"):
        corrected.write(path)
    corrected.write(path, overwrite=True)
    wcs, shape = read_grid(path)
    again = correct(np.full((40, 50), 100.0), calibration, wcs=wcs, shape=shape, mask=mask)
    assert np.allclose(again.counts, corrected.counts, atol=1e-3)
    assert not read_cards("frame.npy")


def test_a_file_without_sky_has_the_object_plane(tmp_path: Path) -> None:
    calibration = calibration_of((40, 50), radial=0.05, binning=2)
    corrected = correct(np.ones((40, 50)), calibration)
    corrected.write(tmp_path / "corrected.fits")
    wcs, _ = read_grid(tmp_path / "corrected.fits")
    middle = wcs.world_to_pixel_values(0.0, 0.0)
    assert np.allclose(wcs.pixel_to_world_values(middle[0] + 3.0, middle[1]), (6.0, 0.0))


# --- what cannot be corrected ---------------------------------------------------------------------

NAN = np.where(np.arange(100 * 120).reshape(120, 100) == 57, np.nan, 1.0)
SPECTRAL = WCS(naxis=2)
SPECTRAL.wcs.ctype = ("WAVE", "SLIT")
AWAY = WCS(naxis=2)
AWAY.wcs.ctype, AWAY.wcs.crval, AWAY.wcs.cdelt = ("RA---TAN", "DEC--TAN"), (11.0, 20.0), (1e-4,) * 2
BEHIND = WCS(naxis=2)
BEHIND.wcs.ctype, BEHIND.wcs.crval, BEHIND.wcs.cdelt = AWAY.wcs.ctype, (190.0, -20.0), (1e-4,) * 2


@pytest.mark.parametrize(
    ("frame", "options", "line"),
    [
        (np.ones((3, 4)), {}, "frame: got shape"),
        (np.ones(7), {}, "frame: got shape"),
        (NAN, {}, "frame: got nan at row 0, column 57"),
        (np.full((120, 100), 1e300), {}, "expected finite counts of at most"),
        ("frame", {}, "frame: got str, expected an array"),
        (None, {"mask": np.zeros((120, 100), dtype=bool)}, "mask: got no good pixel"),
        (None, {"mask": np.ones((3, 3), dtype=bool)}, "mask: got shape"),
        (None, {"variance": np.ones(7)}, "variance: got shape"),
        (None, {"variance": -1.0}, "variance: got NaN, infinite or negative"),
        (None, {"variance": np.nan}, "variance: got NaN"),
        (None, {"variance": "much"}, "variance: got shape"),
        (None, {"shape": (10, 10)}, "without wcs"),
        (None, {"wcs": SPECTRAL, "shape": (10, 10)}, "two celestial axes"),
        (None, {"wcs": WCS(naxis=3), "shape": (10, 10)}, "two celestial axes"),
        (None, {"wcs": "sky", "shape": (10, 10)}, "got str, expected an astropy.wcs.WCS"),
        (None, {"wcs": AWAY}, "shape: got None"),
        (None, {"wcs": AWAY, "shape": (0, 10)}, "shape: got"),
        (None, {"wcs": AWAY, "shape": (10, 10, 3)}, "shape: got"),
        (None, {"wcs": AWAY, "shape": ("a", 3)}, "shape: got"),
        (None, {"wcs": AWAY, "shape": (10**6, 10**6)}, "at most 134217728: take larger pixels"),
        (None, {"wcs": AWAY, "shape": (10, 10)}, "no pixel of the frame falls"),
        (None, {"wcs": BEHIND, "shape": (10, 10)}, "parts of the frame have no place"),
    ],
)
def test_what_cannot_be_corrected_is_said_in_one_line(
    frame: Any, options: dict[str, Any], line: str
) -> None:
    calibration = calibration_of(sky=SKY)
    with pytest.raises(InputError, match=line) as caught:
        correct(np.ones((120, 100)) if frame is None else frame, calibration, **options)
    assert "\n" not in str(caught.value)


def test_no_place_on_the_sky() -> None:
    with pytest.raises(InputError, match="no place on the sky"):
        correct(np.ones((120, 100)), calibration_of(), wcs=AWAY, shape=(10, 10))


@pytest.mark.parametrize("radial", [0.3, 0.9])
def test_a_distortion_that_folds_is_refused(radial: float) -> None:
    with pytest.raises(InputError, match=r"folds|output grid"):
        correct(np.ones((120, 100)), calibration_of(radial=radial))


def test_a_pixel_that_is_far_too_small_is_refused() -> None:
    with pytest.raises(InputError, match="larger pixels"):
        correct(
            np.ones((120, 100)), calibration_of(sky=SKY),
            wcs=grid_like(1e-9, 0.0, (5, 5)), shape=(5, 5),
        )  # fmt: skip
