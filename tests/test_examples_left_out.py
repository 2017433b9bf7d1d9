"""Stars of a real frame that were left out: by the likelihood and by centroids."""

import importlib.util
import os
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
DATA = Path(os.environ["BAYESFRED_DATA"])


@pytest.mark.long
@pytest.mark.skipif(
    not (DATA / "startracker_alt60_azi45_centroids.csv").exists(),
    reason="no real frames: BAYESFRED_DATA does not name their folder",
)
def test_the_likelihood_predicts_stars_better_than_centroids_do() -> None:
    """Also with a PSF that does not vary. Beside their own scatter, 0.08 px, that is little."""
    path = ROOT / "examples" / "left_out.py"
    spec = importlib.util.spec_from_file_location("left_out", path)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    found = example.main(ROOT / "examples" / "startracker.toml")
    assert np.all(found["all, likelihood"] <= found["all, centroids"])
    assert found["bright half, likelihood"][1] < 0.8 * found["bright half, centroids"][1]
