"""Dark marks on a bright ground are told; stars, dead columns, dark corners are not called so."""

import numpy as np
import planted
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from bayesfred.optimize import dark_marks
from bayesfred.optimize.dark_marks import dark_marks_message

Floats = NDArray[np.float64]


def dots(seed: int, depth: float, shape: tuple[int, int] = (240, 300)) -> Floats:
    """Round marks of so much light, a pitch of 17 pixels apart, on a ground of 2000 counts."""
    marks = np.zeros(shape)
    marks[11::17, 9::17] = depth
    mean = 2000.0 + ndimage.gaussian_filter(marks, 2.0)
    return np.random.default_rng(seed).poisson(mean).astype(float)


def told(counts: Floats) -> bool:
    return bool(dark_marks_message(counts, np.isfinite(counts)))


def test_dark_marks_are_told_and_bright_ones_are_not() -> None:
    for seed in range(3):
        assert told(dots(seed, -3e4))
        assert not told(dots(seed, 3e4))
        frame = dots(seed, -3e4)
        frame[50:60, 200:230] = np.nan
        assert told(frame)
        frame[100, 100] = 1e4  # a hot pixel
        assert told(frame)
    assert not told(np.full((50, 60), np.nan))


def test_of_a_large_frame_the_middle_tells() -> None:
    frame = dots(1, -3e4, (2200, 2100))
    assert told(frame)
    frame[64:-64] = 2000.0
    assert not told(frame)


@pytest.mark.parametrize("faint", [300.0, 3e4])
def test_dead_columns_and_dark_corners_are_no_marks(
    faint: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    frame = dots(4, 0.0)
    rng = np.random.default_rng(5)
    light = np.zeros(frame.shape)
    light[rng.integers(0, 240, 8), rng.integers(0, 300, 8)] = faint
    frame += rng.poisson(ndimage.gaussian_filter(light, 1.5))
    frame[:, [33, 120, 200]] = 0.0
    frame[77] = 0.0
    assert not told(frame)
    v, u = np.indices(frame.shape) - np.array([119.5, 149.5])[:, None, None]
    assert not told(np.where(np.hypot(u, v) < 150.0, frame, 40.0))
    corners = np.where(np.hypot(u, v) < 165.0, dots(4, 0.0), 40.0)
    assert not told(corners)
    monkeypatch.setattr(dark_marks, "FEWEST", 4)  # the control: as many as a frame has corners
    assert told(corners)


@pytest.mark.parametrize("name", planted.FAULTS)
def test_no_other_fault_is_called_so(name: str) -> None:
    posterior = planted.FAULTS[name][0](7)
    assert not dark_marks_message(posterior.counts, posterior.mask)
