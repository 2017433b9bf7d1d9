"""Raw frames of colour cameras are told before any fit, and others are not taken for such."""

from pathlib import Path

import numpy as np
import planted
import pytest

from bayesfred.commands.pipeline import read_frame
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.imaging.detector import Detector
from bayesfred.imaging.psf import GaussianPSF
from bayesfred.model.noise import simulate
from bayesfred.optimize.alternating import alternating_message
from bayesfred.settings.joint import read_run


def test_pixels_behind_a_colour_filter_are_told() -> None:
    posterior = planted.colour_filter(1)
    some = posterior.mask.copy()
    some[::7] = False
    for valid in (posterior.mask, some):
        assert "take the pixels of one colour" in alternating_message(posterior.counts, valid)
    means = [posterior.counts[i::2, j::2] for i in (0, 1) for j in (0, 1)]
    levels = [f"{np.median(each):.4g}" for each in means]
    expected = "{} and {} counts in even rows, {} and {} in odd ones".format(*levels)
    assert expected in alternating_message(posterior.counts[:160, :160], posterior.mask[:160, :160])


@pytest.mark.parametrize("level", [0.01, 0.1, 0.5, 2.0, 50.0])
def test_noise_is_not_taken_for_a_colour_filter(level: float) -> None:
    """Least frames with an answer; the share's error of 0.016 is a fifteenth of the limit."""
    rng = np.random.default_rng(2)
    for _ in range(50):
        counts = rng.poisson(level, (64, 66)).astype(float)
        assert alternating_message(counts, counts >= 0.0) == ""
        assert alternating_message(np.round(counts / 3.7), counts >= 0.0) == ""
    assert alternating_message(counts[:40], counts[:40] >= 0.0) == ""  # too few to tell


@pytest.mark.parametrize("pitch", [6.0, 8.0, 10.0])
@pytest.mark.parametrize("sigma", [0.6, 1.5])
def test_images_on_a_grid_are_not_taken_for_a_colour_filter(pitch: float, sigma: float) -> None:
    """Their middles are all in even pixels."""
    model = planted.camera(
        SourceCatalog.grid(int(150 / pitch), pitch, 2e4),
        detector=Detector(planted.SHAPE, pixel="box"),
        psf=GaussianPSF(sigma),
    )
    counts = simulate(model, np.zeros(4), 5.0, seed=1)
    assert alternating_message(counts, counts >= 0.0) == ""


def test_a_run_says_it_unless_it_has_the_flat_field(tmp_path: Path) -> None:
    posterior = planted.colour_filter(1)
    np.save(tmp_path / "frame.npy", posterior.counts)
    response = np.ones(planted.SHAPE)
    response[::2, ::2], response[1::2, 1::2] = 0.6, 0.5
    np.save(tmp_path / "flat.npy", response)
    s = posterior.model.sources
    rows = "\n".join(f"{x},{y},{f}" for x, y, f in zip(s.x, s.y, s.flux, strict=True))
    (tmp_path / "stars.csv").write_text(f"x,y,flux\n{rows}\n")
    for flat, said in (("", True), ('flat = "flat.npy"\n', False)):
        path = tmp_path / "run.toml"
        path.write_text(
            f'[frame]\npath = "frame.npy"\n{flat}[catalogue]\npath = "stars.csv"\n'
            '[psf]\nsigma = 1.8\n[distortion]\nterms = "polynomial"\ndegree = 1\n'
            "[sampling]\nseed = 1\n"
        )
        _, _, notes = read_frame(read_run(path), path, None)
        assert any("take the pixels of one colour" in note for note in notes) == said
