"""Grid targets indexed from simulated images: a known map from object to image, spots in loops."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from scipy.spatial import cKDTree

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.distortion import PolynomialDistortion
from bayesfred.imaging.forward import ForwardModel
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.io.frames import read_frame
from bayesfred.model.noise import GaussianNoise
from bayesfred.model.parameters import Nuisances
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.find_map import find_map
from bayesfred.optimize.grid_lattice import index_points
from bayesfred.optimize.grid_marks import invert_dots
from bayesfred.optimize.grid_target import GridImage, GridTarget, index_grid

Array = np.ndarray[Any, Any]
SHAPE = (360, 400)
WIDTH = 2.0
FLUX = 6000.0


def plane(row: Array, column: Array, layout: str) -> Array:
    """Positions on the target in pitches."""
    if layout == "square":
        return np.stack([column, row], axis=1).astype(float)
    return np.stack([column + 0.5 * (row % 2), row * 0.75**0.5], axis=1)


def camera(place: Array, pitch: float, **lens: Any) -> Array:
    """Where marks are imaged: tilted about v, rotated, then distorted by `radial` at the corner."""
    x, y = (pitch * (place - 0.5 * (place.min(axis=0) + place.max(axis=0)))).T
    if lens.get("mirror"):
        x = -x
    shift = lens.get("shift", (0.0, 0.0))
    tilt, angle = np.deg2rad(lens.get("tilt", 0.0)), np.deg2rad(lens.get("angle", 0.0))
    depth = 1.0 + x * np.sin(tilt) / 1000.0
    x, y = x * np.cos(tilt) / depth, y / depth
    x, y = np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y
    x, y = x + shift[0], y + shift[1]
    corner = 0.25 * (SHAPE[0] ** 2 + SHAPE[1] ** 2)
    factor = 1.0 + lens.get("radial", 0.0) * (x**2 + y**2) / corner
    return np.stack([factor * x, factor * y], axis=1)


def spots(position: Array, flux: Array, width: float = WIDTH, disc: float = 0.0) -> Array:
    """Gaussian images, or discs with a blurred rim, one after the other."""
    image = np.zeros(SHAPE)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    u, v = u - 0.5 * (SHAPE[1] - 1), v - 0.5 * (SHAPE[0] - 1)
    for (x, y), light in zip(position, flux, strict=True):
        if abs(x) > 0.6 * SHAPE[1] or abs(y) > 0.6 * SHAPE[0]:
            continue
        j, i = round(y + 0.5 * SHAPE[0]), round(x + 0.5 * SHAPE[1])
        part = (slice(max(j - 20, 0), max(j + 20, 0)), slice(max(i - 20, 0), max(i + 20, 0)))
        r = np.hypot(u[part] - x, v[part] - y)
        if disc:
            image[part] += light / (np.pi * disc**2) * 0.5 * (1.0 - np.tanh((r - disc) / 0.7))
        else:
            image[part] += light / (2.0 * np.pi * width**2) * np.exp(-0.5 * (r / width) ** 2)
    return image


class Scene:
    """A target, where its marks are imaged, and a frame of counts."""

    def __init__(
        self, rows: int, columns: int, pitch: float, seed: int, layout: Any = "square", **lens: Any
    ) -> None:
        rng = np.random.default_rng(seed)
        self.marks = lens.get("marks", "pinholes")
        self.target = GridTarget(rows, columns, lens.get("given"), layout, self.marks)
        self.row, self.column = np.mgrid[:rows, :columns].reshape(2, -1)
        self.position = camera(plane(self.row, self.column, layout), pitch, **lens)
        self.there = rng.random(rows * columns) >= lens.get("missing", 0.0)
        flux = lens.get("flux", FLUX) * rng.lognormal(0.0, lens.get("spread", 0.1), len(self.row))
        image = spots(self.position[self.there], flux[self.there], disc=lens.get("disc", 0.0))
        v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
        light = np.exp(-((u - 200) ** 2 + (v - 180) ** 2) / 2.0 / 260.0**2) * (1.0 + u / 800.0)
        if self.marks == "dots":
            bright = 1.2 * image.max()
            image = (bright - image) * light
        else:
            dust = rng.uniform(-180.0, 180.0, (lens.get("dust", 0), 2))
            image += spots(dust, FLUX * rng.lognormal(0.0, 0.7, len(dust)))
            image = (image + 20.0) * light
        self.counts = rng.poisson(image).astype(float)
        hot = rng.integers(0, 360, (2, lens.get("hot", 0)))
        self.counts[hot[0], hot[1]] += rng.exponential(3000.0, hot.shape[1])
        half = 0.5 * np.array(SHAPE[::-1]) - 2.0 * WIDTH
        self.seen = self.there & np.all(np.abs(self.position) < half, axis=1)

    def index(self, factor: float = 1.0) -> GridImage:
        return index_grid(self.counts, np.ones(SHAPE, bool), self.target, factor * WIDTH)

    def check(self, grid: GridImage, share: float = 0.97) -> tuple[int, Array]:
        """Every mark has its index, up to a symmetry of the lattice.

        Return how many are marks, and which marks they are.
        """
        found = np.stack([grid.u, grid.v], axis=1)
        distance = np.hypot(*(found[:, None] - self.position[self.there]).T).T
        right = distance.min(axis=1) < 1.5
        assert right.sum() >= share * self.seen.sum()
        assert (~right).sum() <= max(1, 0.02 * len(right))  # dust where a mark is missing
        which = np.flatnonzero(self.there)[distance.argmin(axis=1)][right]
        layout = self.target.layout
        true = plane(self.row, self.column, layout)[which]
        mine = plane(grid.row, grid.column, layout)[right]
        matrix = np.column_stack([true, np.ones(len(true))])
        turn, *_ = np.linalg.lstsq(matrix, mine, rcond=None)
        np.testing.assert_allclose(matrix @ turn, mine, atol=1e-6)
        np.testing.assert_allclose(turn[:2] @ turn[:2].T, np.eye(2), atol=1e-6)
        assert len(set(zip(grid.row, grid.column, strict=True))) == len(grid.row)
        return int(right.sum()), which


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("marks", ["pinholes", "dots"])
@pytest.mark.parametrize("angle", [0.0, 17.0, -29.0, 45.0, 90.0, 180.0, -101.0])
def test_every_index_at_any_angle(layout: str, marks: str, angle: float) -> None:
    scene = Scene(9, 11, 22.0, int(angle) + 200, layout, marks=marks, angle=angle, radial=-0.12,
                  tilt=10.0, missing=0.03, dust=8, hot=30)  # fmt: skip
    grid = scene.index()
    scene.check(grid)
    assert grid.row.min() == grid.column.min() == 0
    assert (grid.row.max(), grid.column.max()) == (8, 10)
    assert " of 9 x 11 marks found, pitch 2" in grid.message
    assert "whole" not in grid.message
    assert marks == "dots" or "other peaks left out: " in grid.message
    order = np.lexsort((grid.column, grid.row))
    np.testing.assert_array_equal(order, np.arange(len(order)))


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("angle", [-25.0, 0.0, 25.0])
def test_columns_run_along_u_where_that_is_possible(layout: str, angle: float) -> None:
    scene = Scene(8, 8, 24.0, 3, layout, angle=angle, radial=0.1)
    grid = scene.index()
    _, which = scene.check(grid)
    np.testing.assert_array_equal(grid.row, scene.row[which])
    np.testing.assert_array_equal(grid.column, scene.column[which])


def test_a_mirrored_hexagonal_grid_is_recognised() -> None:
    """With an even number of rows no rotation brings a hexagonal grid to its mirror image."""
    plain, mirrored = (Scene(8, 7, 26.0, 4, "hexagonal", angle=12.0, mirror=m) for m in (0, 1))
    assert "mirrored" not in plain.index().message
    grid = mirrored.index()
    assert "and mirrored" in grid.message
    _, which = mirrored.check(grid)
    # the grid has one more symmetry, half a turn
    same = np.array_equal(grid.row, mirrored.row[which])
    assert same or np.array_equal(7 - grid.row, mirrored.row[which])


@pytest.mark.parametrize("radial", [-0.15, 0.15])
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_strong_distortion_up_to_the_corners(layout: str, radial: float) -> None:
    scene = Scene(30, 30, 18.0, 5, layout, radial=radial, tilt=10.0, angle=8.0, missing=0.02)
    grid = scene.index()
    scene.check(grid)
    assert "count from the mark nearest to the middle" in grid.message
    nearest = np.argmin(np.hypot(grid.u, grid.v))
    assert grid.row[nearest] == grid.column[nearest] == 0


@pytest.mark.parametrize("factor", [0.5, 0.7, 1.4, 2.0])
def test_width_within_a_factor_of_two(factor: float) -> None:
    scene = Scene(10, 12, 24.0, 6, radial=-0.1, angle=20.0, dust=10, hot=40)
    scene.check(scene.index(factor))


@pytest.mark.parametrize("marks", ["pinholes", "dots"])
def test_discs(marks: str) -> None:
    scene = Scene(9, 9, 28.0, 7, disc=4.5, marks=marks, flux=20_000.0, angle=5.0, radial=-0.1)
    assert scene.check(scene.index())[0] == 81


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_a_fifth_of_the_marks_missing(layout: str) -> None:
    scene = Scene(12, 12, 20.0, 8, layout, missing=0.2, dust=20, radial=-0.12, angle=33.0)
    scene.check(scene.index(), share=0.93)


@pytest.mark.parametrize("shift", [(90.0, 0.0), (-70.0, 60.0), (0.0, -130.0)])
def test_a_grid_beside_the_middle(shift: tuple[float, float]) -> None:
    scene = Scene(7, 7, 18.0, 9, shift=shift, radial=-0.1)
    scene.check(scene.index())


@pytest.mark.parametrize("given", [11.0, 44.0, 22.0])
def test_a_wrong_pitch_is_said(given: float) -> None:
    scene = Scene(9, 9, 22.0, 10, given=given)
    grid = scene.index()
    assert scene.check(grid)[0] == 81
    assert abs(grid.pitch - 22.0) < 0.1
    assert (f"(not {given:g} as given)" in grid.message) == (given != 22.0)


def test_masked_pixels_hide_what_they_hold() -> None:
    scene = Scene(9, 9, 22.0, 11)
    valid = np.ones(SHAPE, bool)
    valid[100:130, 150:250] = False
    frame = scene.counts.copy()
    frame[~valid] = 1e7
    grid = index_grid(frame, valid, scene.target, WIDTH)
    scene.check(grid, share=0.9)


def test_centroids_are_within_their_errors() -> None:
    """Their scatter is at most 1.9 times the Cramer-Rao bound of the photons, and no bias is seen.

    Without a background the filter's gradient has 32 / 9 times the bound's variance: with q = r^2 /
    2 s^2, the integral of (2 - q)^2 q exp(-3 q) over the square of that of (2 - 4 q + q^2) exp(-2
    q). A background makes the two more alike. The pixel of the strongest count is the control.

    81 marks in 6 frames: the Monte Carlo error of a root mean square is 2.3 %, of a mean 0.032.
    """
    pulls, coarse = [], []
    for seed in range(6):
        scene = Scene(9, 9, 26.0, 100 + seed, angle=7.0 * seed, radial=-0.1, spread=0.0)
        grid = scene.index()
        _, which = scene.check(grid, share=1.0)
        error = np.stack([grid.u, grid.v], axis=1) - scene.position[which]
        v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
        light = np.exp(-((u - 200) ** 2 + (v - 180) ** 2) / 2.0 / 260.0**2) * (1.0 + u / 800.0)
        for k, mark in enumerate(which):
            x, y = scene.position[mark] + [0.5 * (SHAPE[1] - 1), 0.5 * (SHAPE[0] - 1)]
            near = np.exp(-((u - x) ** 2 + (v - y) ** 2) / 2.0 / WIDTH**2)
            spot = light * FLUX / (2.0 * np.pi * WIDTH**2) * near
            information = np.sum((spot * (u - x) / WIDTH**2) ** 2 / (spot + 20.0 * light))
            pulls.append(error[k] * information**0.5)
            pixel = np.rint([x, y]) - [x, y]
            coarse.append(pixel * information**0.5)
    scatter = np.sqrt(np.mean(np.square(pulls)))
    assert 0.93 < scatter < (32.0 / 9.0) ** 0.5, scatter
    assert np.sqrt(np.mean(np.square(coarse))) > 5.0
    assert np.abs(np.mean(pulls, axis=0)).max() < 4.0 * 0.045 * scatter


def test_flux_is_rough() -> None:
    scene = Scene(9, 9, 26.0, 12, spread=0.0)
    assert 0.5 < np.median(scene.index().flux) / FLUX < 1.5


@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (9.3, -6.1)])
def test_undistorted_positions(layout: str, shift: tuple[float, float]) -> None:
    """They are a regular lattice, and the distortion that is left grows as the cube of the radius.

    Were the lattice fitted to all marks, there would be displacements in the middle: the control.
    """
    scene = Scene(13, 13, 24.0, 13, layout, angle=11.0, radial=-0.12, shift=shift, flux=40_000.0)
    grid = scene.index()
    place = plane(grid.row, grid.column, layout)
    matrix = np.column_stack([place, np.ones(len(place))])
    turn, *_ = np.linalg.lstsq(matrix, np.stack([grid.x, grid.y], axis=1), rcond=None)
    np.testing.assert_allclose(matrix @ turn, np.stack([grid.x, grid.y], axis=1), atol=1e-8)
    np.testing.assert_allclose(turn[:2] @ turn[:2].T, grid.pitch**2 * np.eye(2), atol=1e-6)
    assert abs(grid.pitch - 24.0) < 0.15
    left = np.hypot(grid.u - grid.x, grid.v - grid.y)
    radius = np.hypot(grid.x, grid.y)
    cubic = 0.12 * radius**3 / (0.25 * (SHAPE[0] ** 2 + SHAPE[1] ** 2))
    assert np.all(np.abs(left - cubic) < 0.1 + 0.15 * cubic)
    plain, *_ = np.linalg.lstsq(matrix, np.stack([grid.u, grid.v], axis=1), rcond=None)
    middle = radius < 50.0
    everywhere = np.hypot(*(matrix @ plain - np.stack([grid.u, grid.v], axis=1)).T)
    assert left[middle].max() < 0.35 < everywhere[middle].max()


# What is refused


def message(counts: Array, target: GridTarget, width: float = WIDTH) -> str:
    with pytest.raises(InputError) as caught:
        index_grid(counts, np.ones(counts.shape, bool), target, width)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
@pytest.mark.parametrize("marks", ["pinholes", "dots"])
def test_frames_without_a_grid(layout: Any, marks: Any) -> None:
    target = GridTarget(9, 9, None, layout, marks)
    rng = np.random.default_rng(14)
    noise = rng.poisson(np.full(SHAPE, 30.0)).astype(float)
    assert "expected 9 x 9" in message(noise, target)
    sign = -1.0 if marks == "dots" else 1.0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        stars = rng.uniform(-170.0, 170.0, (150, 2))
        field = sign * spots(stars, np.full(150, FLUX))
        field = rng.poisson(field - field.min() + 30.0).astype(float)
        assert "lie on a grid" in message(field, target)


def test_empty_frames() -> None:
    target = GridTarget(9, 9)
    assert "got 0 marks" in message(np.zeros((50, 50)), target)
    assert "got 0 marks" in message(np.full((3, 3), 7.0), target)
    with pytest.raises(InputError, match="no valid pixel"):
        index_grid(np.zeros((50, 50)), np.zeros((50, 50), bool), target, WIDTH)


def test_more_rows_than_said() -> None:
    scene = Scene(12, 9, 22.0, 15)
    text = message(scene.counts, GridTarget(9, 9))
    assert "expected at most 9 and 9" in text
    scene.check(index_grid(scene.counts, np.ones(SHAPE, bool), GridTarget(12, 9), WIDTH))


def test_the_wrong_layout() -> None:
    scene = Scene(9, 9, 22.0, 16)
    message(scene.counts, GridTarget(9, 9, layout="hexagonal"))


@pytest.mark.parametrize(
    "given",
    [{"rows": 2}, {"columns": 2.5}, {"rows": True}, {"pitch": 0.0}, {"pitch": np.nan},
     {"layout": "round"}, {"marks": "stars"}],
)  # fmt: skip
def test_targets_that_are_none(given: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(given))}: got"):
        GridTarget(**({"rows": 9, "columns": 9} | given))


@pytest.mark.parametrize("width", [0.0, -1.0, np.nan, np.inf])
def test_widths_that_are_none(width: float) -> None:
    assert "width: got" in message(np.zeros((50, 50)), GridTarget(9, 9), width)


def test_dust_is_not_indexed() -> None:
    """A lattice of exact points takes none of 60 others, but for one where a mark is missing."""
    rng = np.random.default_rng(17)
    v, u = np.mgrid[-90:91:20, -90:91:20].reshape(2, -1)
    points = np.concatenate([np.stack([u, v], axis=1), rng.uniform(-120.0, 120.0, (60, 2))])
    lattice = index_points(points + rng.normal(0.0, 0.05, points.shape), np.ones(160), "square")
    assert np.sum(lattice.points < 100) == 100
    assert np.sum(lattice.points >= 100) <= 3


# Dots made bright


def dots(level: float, seed: int) -> tuple[Array, Array]:
    """Expected counts of dark dots on an uneven field, and counts."""
    v, u = np.mgrid[:120, :120]
    field = level * (1.0 + u / 600.0)
    for y in range(15, 120, 18):
        for x in range(15, 120, 18):
            r = (u - x - 0.3) ** 2 + (v - y + 0.2) ** 2
            field -= 0.7 * level * np.exp(-0.5 * r / WIDTH**2)
    return field, np.random.default_rng(seed).poisson(field).astype(float)


def chi_square(level: float, own: bool) -> tuple[float, float]:
    """The mean of the true model's residual^2 / variance in 40 frames, and its Monte Carlo error.

    `own` is the wrong variance: the pixels' own counts.
    """
    means = []
    for seed in range(40):
        field, counts = dots(level, seed)
        inverted, variance = invert_dots(counts, np.ones(counts.shape, bool))
        if own:
            variance = np.maximum(counts, 1.0)
        residual = inverted - (inverted + counts)[0, 0] + field
        means.append(np.mean(residual**2 / variance))
    return float(np.mean(means)), float(np.std(means, ddof=1) / 40**0.5)


@pytest.mark.parametrize("level", [60.0, 1000.0])
def test_variance_of_dots(level: float) -> None:
    """Chi-square is right to 4 Monte Carlo errors and 0.6 % for what 24 pixels do not resolve."""
    mean, error = chi_square(level, own=False)
    assert abs(mean - 1.0) < 4.0 * error + 0.006, (mean, error)


def test_own_counts_are_the_wrong_variance() -> None:
    mean, error = chi_square(60.0, own=True)
    assert mean - 1.0 > 4.0 * error + 0.006, (mean, error)


@pytest.mark.long
def test_dots_are_fitted_with_that_variance() -> None:
    """A Gaussian fit of sources to the inverted frame has a chi-square of 1 per pixel.

    The error of chi-square in 14,400 pixels is 1.2 %.
    """
    v, u = np.mgrid[:120, :120].astype(float)
    y, x = np.mgrid[-44:45:18, -44:45:18].reshape(2, -1) + 0.3
    field = np.full((120, 120), 800.0)
    for a, b in zip(x, y, strict=True):
        r = (u - 59.5 - a) ** 2 + (v - 59.5 - b) ** 2
        field -= 500.0 * np.exp(-0.5 * r / WIDTH**2)
    counts = np.random.default_rng(18).poisson(field).astype(float)
    inverted, variance = invert_dots(counts, np.ones(counts.shape, bool))
    model = ForwardModel(
        sources=SourceCatalog(x, y, np.full(25, 500.0 * 2.0 * np.pi * WIDTH**2)),
        detector=Detector((120, 120)),
        psf=GaussianPSF(WIDTH),
        distortion=PolynomialDistortion.pinhole(),
    )
    posterior = Posterior(
        model, inverted, noise=GaussianNoise(variance), nuisances=Nuisances(flux="free")
    )
    top = find_map(posterior)
    residual = inverted - posterior.expected_counts(top.params)
    assert abs(np.mean(residual**2 / variance) - 1.0) < 4.0 * 0.012 + 0.006
    assert np.all(np.abs(top.params[:8]) < 6.0 * np.sqrt(np.diag(top.covariance))[:8])


def test_dots_with_masked_pixels() -> None:
    field, counts = dots(300.0, 1)
    valid = np.ones(counts.shape, bool)
    valid[40:44, 30:60] = False
    counts[~valid] = 1e9
    inverted, variance = invert_dots(counts, valid)
    assert np.mean(inverted[valid] < 0.0) < 0.002
    assert variance[valid].max() < 2.0 * field.max()
    assert variance.min() >= 1.0


def test_a_real_mask_is_indexed() -> None:
    """Pinholes of a defocused spectrograph: every index against the README's list of them."""
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not (folder / "vimos_pinholes_q2.fits").exists():
        pytest.skip("needs the frame of the pinhole mask")
    frame = read_frame(folder / "vimos_pinholes_q2.fits", gain=15.0)
    found = index_grid(frame.counts, frame.valid, GridTarget(48, 43), 1.8)
    listed = Table.read(folder / "vimos_pinholes_q2_centroids.csv")
    tree = cKDTree(np.stack([found.u, found.v], axis=1))
    distance, nearest = tree.query(np.stack([listed["u"], listed["v"]], axis=1))
    same = distance < 1.5
    assert same.sum() > 1900
    assert np.median(distance[same]) < 0.15
    assert np.array_equal(found.column[nearest[same]], np.asarray(listed["i"])[same])
    assert np.array_equal(found.row[nearest[same]], np.asarray(listed["j"])[same])
