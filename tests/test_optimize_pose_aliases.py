"""Symmetric catalogues: what tells poses apart is used; where nothing does, the pose says so."""

import numpy as np
import pytest
from numpy.typing import NDArray
from test_optimize_pose import SCALE, SHAPE, field, guessed, off, turned

from bayesfred._typing import Floats
from bayesfred.io.tangent_plane import TangentPlane
from bayesfred.optimize.pose import Pose, find_pose

RA, DEC, PITCH = 150.0, 30.0, 70.0
COUNT = {"square": (9, 9), "rectangle": (9, 7), "wider than the frame": (19, 19)}


def grid(rows: int, columns: int) -> tuple[Floats, Floats]:
    """RA and Dec of a grid about (150, 30), regular on the tangent plane."""
    upright = TangentPlane(RA, DEC, turned(0.0, mirrored=False))  # type: ignore[arg-type]
    y, x = np.mgrid[:rows, :columns].reshape(2, -1) * PITCH
    return upright.to_sky(x - 0.5 * PITCH * (columns - 1), y - 0.5 * PITCH * (rows - 1))


def seen(
    rng: np.random.Generator, plane: TangentPlane, stars: tuple[Floats, Floats, Floats]
) -> tuple[Floats, Floats]:
    """Peaks and their heights: a lens moves corners by 4 px, centroids and heights have errors."""
    x, y = plane.to_plane(*stars[:2])
    inside = (np.abs(x) < 512.0) & (np.abs(y) < 384.0)
    at = np.stack([x, y], axis=1)[inside]
    at *= 1.0 + 4.0 * (at**2).sum(axis=1, keepdims=True) / 640.0**3
    heights = stars[2][inside] * rng.lognormal(0.0, 0.02, len(at))
    order = np.argsort(-heights)
    return (at + rng.normal(0.0, 0.05, at.shape))[order], heights[order]


def posed(
    seed: int,
    at: tuple[Floats, Floats],
    light: Floats,
    known: Floats | None = None,
    *,
    given: bool = False,
    mirrored: bool = False,
) -> tuple[Pose, TangentPlane]:
    """The pose of a grid of this light, as a catalogue knows it, and the true plane."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-180.0, 180.0)
    truth = TangentPlane(RA + 0.01, DEC, turned(angle, mirrored=mirrored))  # type: ignore[arg-type]
    peaks, heights = seen(rng, truth, (*at, light))
    guess = TangentPlane(RA, DEC + 0.02, ((1.02 * SCALE, 0.0), (0.0, 1.02 * SCALE)))
    stars = (*at, light if known is None else known)
    if not given:
        return find_pose(peaks, stars, guess, SHAPE, heights=heights), truth
    angle, parity = truth.position_angle + 3.0, truth.parity
    return find_pose(peaks, stars, guess, SHAPE, heights=heights, angle=angle, parity=parity), truth


def equal(at: tuple[Floats, Floats]) -> Floats:
    return np.full(at[0].size, 1e4)


def varied(at: tuple[Floats, Floats], seed: int) -> NDArray[np.float64]:
    return 1e4 * np.random.default_rng(seed).lognormal(0.0, 0.5, at[0].size)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(("layout", "others"), [("square", 7), ("rectangle", 3)])
def test_equal_stars_of_a_grid_do_not_tell_how_it_is_turned(
    layout: str, others: int, mirrored: bool
) -> None:
    at = grid(*COUNT[layout])
    for seed in range(5):
        pose, truth = posed(seed, at, equal(at), mirrored=mirrored)
        assert "the catalogue is symmetric" in pose.ambiguous
        assert "give sky.position_angle, sky.parity" in pose.ambiguous
        angles = pose.ambiguous.split("position angle ")[1:]
        assert sum(part.split(" degrees")[0].count(" or ") + 1 for part in angles) == others
        right = off(pose.plane, truth) < 6.0
        named = f"{truth.position_angle:.0f}." in pose.ambiguous or any(
            abs(float(word) - truth.position_angle) < 0.2
            for part in angles
            for word in part.split(" degrees")[0].split(" or ")
        )
        assert right or named
        # negative control: who says how the frame is turned gets that pose, and no doubt
        pose, truth = posed(seed, at, equal(at), given=True, mirrored=mirrored)
        assert not pose.ambiguous
        assert off(pose.plane, truth) < 6.0


@pytest.mark.parametrize("layout", COUNT)
@pytest.mark.parametrize("mirrored", [False, True])
def test_fluxes_tell(layout: str, mirrored: bool) -> None:
    at = grid(*COUNT[layout])
    for seed in range(5):
        light = varied(at, seed)
        pose, truth = posed(seed, at, light, mirrored=mirrored)
        assert not pose.ambiguous
        assert off(pose.plane, truth) < 6.0
        # negative control: fluxes that are not the frame's tell nothing
        assert posed(seed, at, light, varied(at, seed + 100), mirrored=mirrored)[0].ambiguous


def test_one_bright_star_tells_but_for_what_keeps_it_in_place() -> None:
    at = grid(*COUNT["square"])
    for seed in range(5):
        light = equal(at)
        light[5] *= 4.0
        pose, truth = posed(seed, at, light)
        assert not pose.ambiguous
        assert off(pose.plane, truth) < 6.0
        light = equal(at)
        light[20] *= 4.0  # on a diagonal, which mirrors it onto itself
        pose, _ = posed(seed, at, light)
        assert "give sky.parity, a catalogue" in pose.ambiguous


def test_places_tell() -> None:
    """Sources half a pixel off the grid, which no smooth distortion explains."""
    for seed in range(5):
        rng = np.random.default_rng(seed)
        at = grid(*COUNT["square"])
        ra, dec = (each + rng.normal(0.0, 0.5 * SCALE, each.size) for each in at)
        pose, truth = posed(seed, (ra, dec), equal(at))
        assert not pose.ambiguous
        assert off(pose.plane, truth) < 6.0


def test_several_holes_tell() -> None:
    """An alias has peaks without stars there, and stars without peaks elsewhere."""
    for seed in range(5):
        at = grid(*COUNT["square"])
        order = np.random.default_rng(seed).permutation(at[0].size)
        ra, dec = (each[order[5:]] for each in at)
        pose, truth = posed(seed, (ra, dec), equal((ra, dec)))
        assert not pose.ambiguous
        assert off(pose.plane, truth) < 6.0
        # negative control: a single one may be a star that was missed
        ra, dec = (each[order[1:]] for each in at)
        assert posed(seed, (ra, dec), equal((ra, dec)))[0].ambiguous


def test_a_grid_wider_than_the_frame_may_be_shifted() -> None:
    at = grid(*COUNT["wider than the frame"])
    for seed in range(3):
        pose, truth = posed(seed, at, equal(at), given=True)
        assert "as well at RA 1" in pose.ambiguous
        assert "sky." not in pose.ambiguous  # which was given
        assert off(pose.plane, truth) < 6.0  # of those alike the nearest to the guess
        # negative control: all of the smaller grid is seen, and has one place
        small = grid(*COUNT["rectangle"])
        assert not posed(seed, small, equal(small), given=True)[0].ambiguous


@pytest.mark.parametrize("number", [15, 60, 300])
def test_random_fields_are_not_ambiguous(number: int) -> None:
    rng = np.random.default_rng(number)
    for k in range(20):
        peaks = np.empty((0, 2))
        while len(peaks) < 8 * 4 / 3:
            stars, truth, peaks = field(rng, number, mirrored=bool(k % 2))
        heights = np.linspace(2.0, 1.0, len(peaks))
        pose = find_pose(peaks, stars, guessed(rng, truth), SHAPE, heights=heights)
        assert not pose.ambiguous
