"""Any value of any setting gives a result or one line, of every command that reads a run file.

Hypothesis puts numbers, texts and lists of all kinds into a small run file that has every section.
The default run tries the same few every time, the long one thousands of new ones.
"""

import contextlib
import copy
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import event, given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from test_any_chain import FEW, SECONDS
from test_any_input import DOT, NUMBERS, STARS, VALUES, sound_counts, toml
from typer.testing import CliRunner

from bayesfred.cli import app

RUN: dict[str, dict[str, Any]] = {
    "frame": {"path": "frame.npy", "gain": 1.0, "pedestal": 0.0, "saturation": 6e4,
              "background_scale": 6.0},
    "catalogue": {"path": "stars.csv", "x": "x", "y": "y", "flux": "flux"},
    "detector": {"pixel": "impulse", "binning": 1},
    "psf": {"kind": "gaussian", "sigma": 1.5},
    "distortion": {"f_terms": [[1, 0, 1, 0]], "g_terms": [[0, 1, 0, 1]]},
    "model": {"conserve_flux": True, "tolerance": 1e-8},
    "noise": {"kind": "poisson", "read_noise": 0.0},
    "nuisances": {"flux": "fixed", "offset": False, "background_order": 0, "footprint": 5.0},
    "prior": {"f_ux": {"distribution": "norm", "loc": 0.0, "scale": 1e-2}},
    "sampling": {"seed": 1, "ensembles": 2, "walkers": 8, "steps": 2, "target_ess": 10},
    "output": {"path": "run.h5"},
    "simulation": {"shape": [24, 24], "background": 3.0, "seed": 1, "theta": {"f_ux": 1e-3},
                   "grid": {"side": 2, "spacing": 9.0, "flux": 5e3}},
    "study": {"kind": "noise", "replicates": 2, "method": "laplace", "seed": 1, "error": 0.01,
              "background": [0.5], "flux": [1e4], "sources": [4], "psf_sigma": [1.5],
              "exposure": [1.0], "path": "study.ecsv"},
    "design": {"error": 0.01, "criterion": "D", "sources": 3, "dithers": [[0, 0], [5, 0]],
               "frames": 2, "path": "design.ecsv"},
}  # fmt: skip
LONG = (("simulation", "shape"), ("sampling", "steps"), ("study", "replicates"))  # by themselves
COMMANDS = ("fit", "simulate", "study", "design")
EXTREME = st.sampled_from([1e-300, 1e300, 1e15, -1e15, 10**9, 10**18, -1, 0, 1e-15, 5e-324])


@pytest.fixture(scope="module", autouse=True)
def unrendered() -> Iterator[None]:
    """Pictures take most of the time of a small run."""
    with patch.object(Figure, "savefig", lambda figure, target, **_: target.write(DOT)):
        yield


def edit(data: st.DataObject, run: dict[str, dict[str, Any]]) -> None:
    """Change a value, or one inside it."""
    section = data.draw(st.sampled_from([*run]))
    table, key = run[section], data.draw(st.sampled_from([*run[section]]))
    while isinstance(table[key], dict) and table[key] and data.draw(st.booleans()):
        table = table[key]
        key = data.draw(st.sampled_from([*table]))
    if isinstance(table[key], list) and data.draw(st.booleans()):
        table[key] = [*table[key], data.draw(EXTREME)] if data.draw(st.booleans()) else []
    else:
        table[key] = data.draw(st.one_of(EXTREME, EXTREME, NUMBERS, VALUES))
    for place, name in LONG:
        value = run[place][name]
        sizes = value if isinstance(value, list) else [value]
        if any(isinstance(v, int | float) and 30 < v < 10**9 for v in sizes):
            run[place][name] = RUN[place][name]  # sound, but long


def text_of(run: dict[str, dict[str, Any]]) -> str:
    """The run file of some sections."""
    return "".join(
        f"[{name}]\n" + "".join(f"{toml(k)} = {toml(v)}\n" for k, v in table.items())
        for name, table in run.items()
    )


def check(data: st.DataObject) -> None:
    """Give an edited run file to a command."""
    command, run = data.draw(st.sampled_from(COMMANDS)), copy.deepcopy(RUN)
    if command != "simulate":
        del run["simulation"]["grid"]
    if command in ("simulate", "study"):
        del run["frame"]["gain"], run["frame"]["pedestal"]
    for _ in range(data.draw(st.integers(1, 2))):
        edit(data, run)
    text = text_of(run)
    with tempfile.TemporaryDirectory() as name:
        here = Path(name)
        np.save(here / "frame.npy", sound_counts())
        (here / "stars.csv").write_text("".join(",".join(row) + "\n" for row in STARS))
        (here / "run.toml").write_text(text, encoding="utf-8")
        if command == "simulate":
            (here / "stars.csv").unlink()
            (here / "frame.npy").unlink()
        before = {path.name: path.read_bytes() for path in here.iterdir()}
        start = time.monotonic()
        with contextlib.chdir(here), warnings.catch_warnings(record=True) as warned:
            warnings.simplefilter("always")
            words = ["--workers", "1"] if command == "study" else []
            result = CliRunner().invoke(app, [command, "run.toml", *words])
        assert time.monotonic() - start < SECONDS, text
        event(f"{command} {result.exit_code}")
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        assert not warned, [str(w.message) for w in warned]
        assert result.exit_code in (0, 2, 3), result.output
        after = {path.name: path.read_bytes() for path in here.iterdir() if path.is_file()}
        assert {name: after.get(name) for name in before} == before
        if result.exit_code == 2:
            assert result.stderr.startswith("bayesfred: ") and result.stderr[:-1].isprintable()


@FEW(max_examples=40, derandomize=True)
@given(data=st.data())
def test_a_result_or_one_line(data: st.DataObject) -> None:
    check(data)


def test_a_study_without_a_fit_has_a_picture_too(tmp_path: Path) -> None:
    run = copy.deepcopy(RUN)
    run["prior"]["f_ux"]["loc"] = 1e15
    del run["frame"]["gain"], run["frame"]["pedestal"], run["simulation"]["grid"]
    (tmp_path / "stars.csv").write_text("".join(",".join(row) + "\n" for row in STARS))
    (tmp_path / "run.toml").write_text(text_of(run), encoding="utf-8")
    with contextlib.chdir(tmp_path):
        result = CliRunner().invoke(app, ["study", "run.toml", "--workers", "1"])
    assert "2 frames, 2 failed" in result.output
    assert (tmp_path / "study.png").stat().st_size > 10_000


@pytest.mark.long
@FEW(max_examples=10_000, print_blob=True)
@given(data=st.data())
def test_a_result_or_one_line_thousands_of_times(data: st.DataObject) -> None:
    check(data)
