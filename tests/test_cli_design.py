"""`bayesfred design`: a run file in, a table, a figure and sentences out."""

from pathlib import Path

import numpy as np
import pytest

import bayesfred as bf
from bayesfred.cli import app
from bayesfred.errors import InputError
from bayesfred.io.tables import read_table

RUN = """
[frame]
path = "none.fits"
[catalogue]
path = "none.csv"
[psf]
kind = "gaussian"
sigma = 2.0
[distortion]
terms = "polynomial"
degree = 2
[nuisances]
flux = "free"
position_scatter = true
[simulation]
shape = [65, 65]
background = 5.0
[simulation.theta]
f_x2 = 1e-5
[simulation.grid]
side = 3
spacing = 20.0
flux = 1e4
[design]
error = 0.05
sources = 6
dithers = [[0, 0], [5, 0]]
frames = 3
"""


@pytest.fixture
def run_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "run.toml"
    path.write_text(RUN)
    return path


def test_a_design_is_written_once(run_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    app(["design", str(run_file)], standalone_mode=False)
    out = capsys.readouterr().out.splitlines()
    assert out[0].endswith("run.design.ecsv") and out[1].endswith("run.design.png")
    assert [line.split(" ")[0] for line in out[2:]] == [
        "Displacement",
        "Sources:",
        "For",
        "Pointings:",
    ]
    table = read_table("chains/run.design.ecsv")
    assert sorted(table.columns["source"].tolist()) == list(range(9))
    assert table.columns["chosen"].sum() == 6
    assert np.all(np.diff(table.columns["rms"]) < 0.0)
    assert len(table.meta["pointings of the chosen frames, fine pixel"]) == 3
    assert Path("chains/run.design.png").read_bytes()[1:4] == b"PNG"
    with pytest.raises(InputError, match="exists"):
        bf.commands.design(run_file)
    planned = bf.commands.design(run_file, overwrite=True)
    assert planned.plan.sources.order.tolist() == table.columns["source"].tolist()


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("sources = 10", "run.toml: sources: got 10, expected an integer from 1 to 9"),
        ("frames = 2000", "run.toml: frames: got 2000"),
        ('criterion = "A"', "design.criterion"),
        ("dithers = [[0, 0, 0]]", "design.dithers"),
        ("dithers = [[900, 0]]", "where the frame shows no source"),
        ('path = "../a.ecsv"', "design.path"),
    ],
)
def test_mistakes_are_told_with_the_run_file(run_file: Path, line: str, told: str) -> None:
    key = line.split(" ")[0]
    before, section = RUN.split("[design]\n")
    others = [each for each in section.splitlines() if not each.startswith(f"{key} ")]
    run_file.write_text("\n".join([before, "[design]", *others, line]))
    with pytest.raises(InputError, match=told):
        bf.commands.design(run_file)
