"""The pose is found from the pattern of the stars, and none is found where there is none."""

from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import bayesfred as bf
from bayesfred._typing import Floats
from bayesfred.io.frames import read_frame
from bayesfred.io.tangent_plane import TangentPlane
from bayesfred.optimize.peaks import bright_peaks
from bayesfred.optimize.pose import find_pose

SHAPE = (768, 1024)
SCALE = 40.3 / 3600.0
DATA = Path(__file__).parents[2] / "shared" / "data"
# from the frames' README: RA, Dec, degrees
POINTINGS = {
    "alt60_azi45": (314.7, 64.2),
    "alt40_azi135": (296.75, 11.3),
    "alt40_azim135": (230.65, 11.05),
    "alt60_azim45": (212.2, 64.2),
}

Stars = tuple[Floats, Floats, Floats]


def turned(
    angle: float, *, mirrored: bool, scale: float = SCALE
) -> tuple[tuple[float, float], ...]:
    sin, cos = scale * np.sin(np.radians(angle)), scale * np.cos(np.radians(angle))
    right = 1.0 if mirrored else -1.0
    return ((right * cos, sin), (-right * sin, cos))


def field(
    rng: np.random.Generator, number: int, *, mirrored: bool = False
) -> tuple[Stars, TangentPlane, Floats]:
    """Stars about a pointing, the true plane, and peaks: stars that moved a little, and others.

    Every fifth star is not seen, every fourth peak is no star, and a lens moves corners by 4 px.
    """
    area = 1.0 / (SHAPE[0] * SHAPE[1] * SCALE**2)
    many = int(number * (18.0**2) * area)
    dec = np.degrees(
        np.arcsin(rng.uniform(np.sin(np.radians(41.0)), np.sin(np.radians(59.0)), many))
    )
    ra = 150.0 + rng.uniform(-9.0, 9.0, many) / np.cos(np.radians(50.0))
    flux = rng.pareto(1.0, many) + 1.0
    plane = TangentPlane(150.3, 50.2, turned(rng.uniform(0.0, 360.0), mirrored=mirrored))  # type: ignore[arg-type]
    x, y = plane.to_plane(ra, dec)
    seen = (np.abs(x) < 512.0) & (np.abs(y) < 384.0) & (rng.uniform(size=many) > 0.2)
    u, v = x[seen], y[seen]
    lens = 1.0 + 4.0 * (u**2 + v**2) / 640.0**3
    others = rng.uniform(-0.5, 0.5, (seen.sum() // 3, 2)) * SHAPE[::-1]
    peaks = np.vstack(
        [np.stack([u * lens, v * lens], axis=1) + rng.normal(0.0, 0.1, (u.size, 2)), others]
    )
    light = np.concatenate(
        [flux[seen] * rng.lognormal(0.0, 0.5, u.size), rng.pareto(1.0, len(others)) + 1.0]
    )
    return (ra, dec, flux), plane, peaks[np.argsort(-light)]


def guessed(rng: np.random.Generator, plane: TangentPlane) -> TangentPlane:
    """A guess up to 0.95 degrees and 4.5 % off."""
    angle, away = rng.uniform(0.0, 2.0 * np.pi), 0.95 * np.sqrt(rng.uniform())
    scale = SCALE * rng.uniform(0.955, 1.045)
    return TangentPlane(
        plane.ra + away * np.sin(angle) / np.cos(np.radians(plane.dec)),
        plane.dec + away * np.cos(angle),
        ((scale, 0.0), (0.0, scale)),
    )


def off(found: TangentPlane, truth: TangentPlane) -> float:
    """The largest distance of both planes over the frame, pixel."""
    u, v = np.meshgrid([-512.0, 0.0, 512.0], [-384.0, 0.0, 384.0])
    x, y = found.to_plane(*truth.to_sky(u, v))
    return float(np.hypot(x - u, y - v).max())


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("number", [15, 60, 300])
def test_the_pose_is_found(number: int, mirrored: bool) -> None:
    """Of 20 fields each; a failure of 1 in 20 would be seen with a probability of 64 %.

    Fewer than 8 stars among the peaks may be too few to tell them from chance.
    """
    rng = np.random.default_rng([number, mirrored])
    for _ in range(20):
        peaks = np.empty((0, 2))
        while len(peaks) < 8 * 4 / 3:
            stars, truth, peaks = field(rng, number, mirrored=mirrored)
        pose = find_pose(peaks, stars, guessed(rng, truth), SHAPE)
        assert pose.plane.parity == ("mirrored" if mirrored else "sky")
        assert off(pose.plane, truth) < 6.0  # the lens is left for the fit
        assert pose.matched >= 5


def test_no_pose_where_there_is_none() -> None:
    """Peaks that are no stars: 20 fields, none of which may be found."""
    rng = np.random.default_rng(5)
    for k in range(20):
        stars, truth, peaks = field(rng, (15, 100)[k % 2])
        others = rng.uniform(-0.5, 0.5, peaks.shape) * SHAPE[::-1]
        with pytest.raises(bf.InputError, match="got no pose within 1 degree of RA"):
            find_pose(others, stars, guessed(rng, truth), SHAPE)


def test_what_is_known_is_kept_to() -> None:
    rng = np.random.default_rng(7)
    stars, truth, peaks = field(rng, 60)
    guess = guessed(rng, truth)
    found = find_pose(peaks, stars, guess, SHAPE, angle=truth.position_angle + 3.0, parity="sky")
    assert off(found.plane, truth) < 6.0
    with pytest.raises(bf.InputError, match="5 degrees of the position angle"):
        find_pose(peaks, stars, guess, SHAPE, angle=truth.position_angle + 20.0)
    with pytest.raises(bf.InputError, match="no pose"):
        find_pose(peaks, stars, guess, SHAPE, parity="mirrored")
    with pytest.raises(bf.InputError, match="got 2 peaks"):
        find_pose(peaks[:2], stars, guess, SHAPE)


@pytest.mark.parametrize("name", POINTINGS)
def test_real_frames(name: str) -> None:
    path = DATA / f"startracker_{name}.fits"
    if not path.exists():
        pytest.skip("needs the star tracker's frames")
    frame = read_frame(path, pedestal=-10.0)
    table = Table.read(DATA / f"startracker_{name}_sky.csv")
    stars = (np.array(table["ra"]), np.array(table["dec"]), 10.0 ** (-0.4 * np.array(table["mag"])))
    peaks = bright_peaks(frame.counts, frame.valid, 0.73)[0]
    rng = np.random.default_rng(3)
    planes = []
    for _ in range(5):
        near = TangentPlane(*POINTINGS[name], ((SCALE, 0.0), (0.0, SCALE)))
        pose = find_pose(peaks, stars, guessed(rng, near), SHAPE)
        planes.append(pose.plane)
        assert pose.matched >= 60
        assert pose.rms < 0.25
        assert pose.plane.pixel_scale == pytest.approx(40.3, abs=0.02)
    assert max(off(plane, planes[0]) for plane in planes) < 0.2
