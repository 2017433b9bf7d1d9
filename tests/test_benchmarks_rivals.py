"""Other ways to the field that `benchmarks.rivals` compares: they run, and the bound is right."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks import rival_frames, rival_methods, rivals

pytestmark = pytest.mark.slow

BRIGHT = rival_frames.Case("stars", 2.0, 2e4)
DOTS = rival_frames.Case("dots", 5.0, 2e4, dots=True)


def test_bound_is_that_of_least_squares_on_another_image() -> None:
    """Stars do not touch, so that known fluxes say nothing about positions."""
    frame = rival_frames.simulate(BRIGHT, [1])
    found = rival_methods.least_squares(frame)
    assert found.sd**2 == pytest.approx(frame.variance, rel=0.1)


@pytest.mark.parametrize(
    ("case", "method"),
    [
        (case, method)
        for case, methods in ((BRIGHT, rivals.ON_STARS), (DOTS, rivals.ON_DOTS))
        for method in methods
    ],
    ids=lambda value: value.name,
)
def test_every_method_finds_the_field(case, method) -> None:
    if method.missing:
        pytest.skip(f"not installed: {', '.join(method.missing)}")
    frames = [rival_frames.simulate(case, [2])]
    score = rivals.score(method, frames)
    assert score is not None and score.failed == 0 and score.seconds > 0.0
    assert 0.3 < score.error < 5.0  # 20 or 11 coefficients of one frame, and the worst method
    assert np.isnan(score.coverage) or score.coverage > 0.2


def test_wrong_fields_and_failures_are_seen() -> None:
    frames = [rival_frames.simulate(BRIGHT, [3, k]) for k in range(2)]

    def shifted(frame: rival_frames.Frame) -> rival_methods.Found:
        if frame is frames[1]:
            raise ValueError("nothing found")
        return rival_methods.Found(frame.field + 0.1, np.sqrt(frame.variance), False)

    score = rivals.score(rivals.Method("shifted", shifted), frames)
    assert score is not None and score.failed == 1 and score.refused
    assert score.error > 30.0 and score.coverage == 0.0
