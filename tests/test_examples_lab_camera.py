"""The lab camera of examples/: what its page claims holds."""

import importlib.util
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.stats import chi2

import bayesfred as bf
from bayesfred.errors import InputError

EXAMPLES = Path(__file__).parents[1] / "examples"
CHANCE = 1e-3  # that a true calibration is refused by its chi-square


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """The example's script and run file in a folder of their own, with its photograph."""
    folder = tmp_path_factory.mktemp("lab_camera")
    for suffix in (".py", ".toml"):
        shutil.copy(EXAMPLES / f"lab_camera{suffix}", folder)
    spec = importlib.util.spec_from_file_location("lab_camera", folder / "lab_camera.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.simulate(module.HERE / "dots.png")
    return module


def test_photograph_has_16_bits_and_darkness_where_the_truth_has_dots(example):
    with Image.open(example.HERE / "dots.png") as picture:
        stored = np.asarray(picture)
    assert stored.shape == example.SHAPE and 255 < stored.max() < 2**16 - 1
    ny, nx = example.SHAPE
    v, u = np.mgrid[:ny, :nx] - np.array([(ny - 1) / 2, (nx - 1) / 2])[:, None, None]
    column, row = example.to_target(u, v)
    off = np.hypot(column - np.rint(column), row - np.rint(row)) * example.PITCH
    on_grid = (abs(column) < example.COLUMNS / 2) & (abs(row) < example.ROWS / 2)
    dark, white = stored[on_grid & (off < 0.7)], stored[on_grid & (off > 5.0)]
    assert np.median(dark) < 0.45 * np.median(white)
    # moments of what a dot keeps away, 0.04 pixel by noise, are where the truth says
    for i in (-6, 0, 6):
        for j in (-4, 0, 4):
            near = np.hypot(column - i, row - j) * example.PITCH < 4.0
            kept = np.median(stored[near]) - stored[near].astype(float)
            at = [np.sum(kept * p[near]) / np.sum(kept) for p in (column - i, row - j)]
            assert np.hypot(*at) * example.PITCH < 0.2


@pytest.mark.long
def test_calibration_agrees_with_the_truth_and_not_with_another(example, monkeypatch, capsys):
    monkeypatch.chdir(example.HERE)
    result = bf.commands.fit("lab_camera.toml", map_only=True)
    assert result.diagnostics.trustworthy
    worst, square = example.compare(example.CHAIN)
    assert worst < 4.0
    assert chi2.sf(square, 2 * example.FEW) > CHANCE
    assert chi2.cdf(square, 2 * example.FEW) > CHANCE
    shown = capsys.readouterr().out
    assert "difference / sd" in shown and "OpenCV: k1 -0.3" in shown

    # a lens with a focal length 1 % longer is another one: at most 0.1 pixel on the grid
    monkeypatch.setattr(example, "FOCAL_LENGTH", 1.01 * example.FOCAL_LENGTH)
    worst, square = example.compare(example.CHAIN)
    assert worst > 4.0
    assert chi2.sf(square, 2 * example.FEW) < CHANCE


def test_no_chain_is_said_in_one_line(example, tmp_path):
    with pytest.raises(InputError, match=r"absent\.h5"):
        example.compare(tmp_path / "absent.h5")
