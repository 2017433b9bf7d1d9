"""`bayesfred init`: the run file that a frame's own noise proposes."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from test_analysis_photon_transfer import GAIN, NOISE, PEDESTAL, ZERO, scene, stored
from typer.testing import CliRunner

from bayesfred.cli import app
from bayesfred.settings.run import read_settings


def invoke(*arguments: Any) -> tuple[int, str, str]:
    done = CliRunner().invoke(app, ["init", *map(str, arguments)])
    return done.exit_code, done.stdout, done.stderr


def frames(folder: Path, number: int = 2, **cards: Any) -> list[Path]:
    rng, light = np.random.default_rng(5), scene("stars")
    paths = [folder / f"night{k}.fits" for k in range(number)]
    for path in paths:
        fits.PrimaryHDU(stored(light, rng), fits.Header(cards)).writeto(path)
    return paths


def sd(text: str, key: str) -> float:
    found = re.search(rf"^{key} = .*\+- ([\d.e+-]+)", text, re.MULTILINE)
    assert found is not None
    return float(found[1].rstrip(":"))


def test_a_frame_proposes_its_run_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    first, _ = frames(tmp_path, GAIN=2.4)
    code, printed, _ = invoke(first)
    assert code == 0 and "gain 2." in printed and "night0.toml" in printed
    text = (tmp_path / "night0.toml").read_text()
    run = read_settings(tmp_path / "night0.toml")
    assert abs(run.frame.gain - GAIN) < 4.0 * sd(text, "gain")
    assert abs(run.frame.pedestal - ZERO) < 4.0 * sd(text, "pedestal")
    assert "in the header GAIN = 2.4" in text and run.noise.read_noise == 0.0
    assert 0.8 < run.psf.sigma < 1.4  # of stars of 1 pixel
    code, _, error = invoke(first)
    assert code == 2 and "night0.toml: exists" in error
    assert invoke(first, "--overwrite")[0] == 0


def test_two_frames_and_headers_tell_the_read_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    first, second = frames(tmp_path, RDNOISE=NOISE)
    assert invoke(first, "--out", "one.toml")[0] == 0
    one = read_settings(tmp_path / "one.toml")
    assert one.noise.read_noise == NOISE
    assert abs(one.frame.pedestal - PEDESTAL) < 4.0 * sd(Path("one.toml").read_text(), "pedestal")
    assert invoke(first, second, "--out", "two.toml")[0] == 0
    two = read_settings(tmp_path / "two.toml")
    assert abs(two.noise.read_noise - NOISE) < 0.5 * NOISE


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("absent.fits",), "absent.fits: no such file"),
        (("night0.fits", "absent.fits"), "absent.fits: no such file"),
        (("night0.fits", "--out", "run.h5"), "run.h5: got a run file of this name"),
    ],
)
def test_refusals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    frames(tmp_path, 1)
    code, printed, error = invoke(*arguments)
    assert code == 2 and said in error and not printed and error.count("\n") == 1


def test_a_frame_that_says_nothing_of_its_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("dark.npy", np.random.default_rng(1).normal(100.0, 3.0, (99, 99)))
    code, printed, _ = invoke("dark.npy")
    assert code == 0 and "does not measurably grow" in printed
    run = read_settings(tmp_path / "dark.toml")
    assert run.frame.gain is None
    # a name that TOML would misread is quoted
    Path("a\"b\\'.npy").write_bytes(Path("dark.npy").read_bytes())
    assert invoke("a\"b\\'.npy")[0] == 0
    assert read_settings(tmp_path / "a\"b\\'.toml").frame.path == "a\"b\\'.npy"
