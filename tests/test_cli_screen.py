"""What a terminal, a pipe, a notebook and another program get to see."""

import io
import json
import os
import pty
import re
import shutil
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from test_cli import (
    NAMES,
    command,
    environment,
    finished,
    folder,
    invoke,
    run_text,
    simulated,
    without_waits,
)

from bayesfred.io.summary_table import make_table
from bayesfred.reporting.screen import comparison_table, parameter_table
from bayesfred.sampling.progress import progress_bar, working

__all__ = ["finished", "folder", "simulated"]  # fixtures

ESCAPE = "\x1b"


def in_terminal(folder: Path, columns: int, *args: str, **extra: str) -> tuple[int, str, str]:
    """A command whose output and errors are a terminal each: exit code, and what each shows."""
    shown, ours, theirs = [], [], []
    for _ in range(2):
        master, slave = pty.openpty()
        ours.append(master)
        theirs.append(slave)
    env = environment(**{"TERM": "xterm", "COLUMNS": str(columns), **extra})
    for name in {"FORCE_COLOR", "NO_COLOR", "CI"} - set(extra):
        env.pop(name, None)
    process = subprocess.Popen(
        command(*args), cwd=folder, env=env, stdin=subprocess.DEVNULL, stdout=theirs[0],
        stderr=theirs[1],
    )  # fmt: skip
    for slave in theirs:
        os.close(slave)
    for master in ours:
        text = b""
        while True:
            try:
                part = os.read(master, 65536)
            except OSError:  # all who could write are gone
                break
            if not part:
                break
            text += part
        os.close(master)
        shown.append(text.decode().replace("\r\n", "\n"))
    return process.wait(60), shown[0], shown[1]


def table_lines(text: str) -> list[str]:
    plain = re.sub(rf"{ESCAPE}\[[0-9;?]*[A-Za-z]", "", text)
    return [line for line in plain.splitlines() if line[:1] in "┏┃┡│└+|"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("columns", "present", "absent"),
    [
        (60, ["posterior mean +- sd", "px at corner"], ["MAP", "prior"]),
        (200, ["posterior mean +- sd", "px at corner", "MAP", "R-hat", "ESS", "prior"], []),
    ],
)
def test_a_table_fits_the_terminal(
    columns: int, present: list[str], absent: list[str], finished: tuple[Path, Any], tmp_path: Path
) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path)
    code, shown, _ = in_terminal(tmp_path, columns, "report", "run.h5")
    assert code == 0
    lines = table_lines(shown)
    assert max(map(len, lines)) <= columns and len(lines) == len(NAMES) + 4
    assert [head for head in present if head not in lines[1]] == []
    assert [head for head in absent if head in lines[1]] == []
    assert "…" not in shown and all(any(f" {name} " in line for line in lines) for name in NAMES)


@pytest.mark.slow
def test_plain_terminals_get_plain_text(folder: Path) -> None:
    """The negative control is a terminal that can do more: it gets escape codes."""
    (folder / "run.toml").write_text(run_text(sampling="steps = 12"), encoding="utf-8")
    for extra, plain in (
        ({}, False),
        ({"TERM": "dumb"}, True),
    ):
        code, shown, errors = in_terminal(folder, 80, "fit", "run.toml", "--overwrite", **extra)
        assert code == 3 and "not trustworthy: " in shown
        assert (ESCAPE not in shown) == (ESCAPE not in errors) == plain, extra
        if plain:
            assert without_waits(errors) == ""
        else:
            assert "12 steps" in errors


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extra", "width", "ascii"),
    [
        ({"COLUMNS": "60"}, 60, False),
        ({"PYTHONIOENCODING": "ascii", "TERM": "dumb", "NO_COLOR": "1"}, 80, True),
    ],
)
def test_a_pipe_gets_80_columns_without_escape_codes(
    extra: dict[str, str], width: int, ascii: bool, finished: tuple[Path, Any], tmp_path: Path
) -> None:
    shutil.copy(finished[0] / "run.h5", tmp_path / "kamera-ü.h5")
    env = environment(**{"PYTHONIOENCODING": "utf-8", **extra})
    for name in {"FORCE_COLOR", "NO_COLOR", "COLUMNS"} - set(extra):
        env.pop(name, None)
    done = subprocess.run(
        command("report", "kamera-ü.h5"), cwd=tmp_path, env=env, capture_output=True, check=False
    )
    assert (done.returncode, without_waits(done.stderr.decode())) == (0, "")
    shown = done.stdout.decode("ascii" if ascii else "utf-8")
    assert ESCAPE not in shown
    assert max(map(len, table_lines(shown))) <= width
    assert ("kamera-\\xfc.h5" if ascii else "kamera-ü.h5") in shown
    assert ("| background " if ascii else "│ background ") in shown


def parameters(**changed: Any) -> Any:
    columns: dict[str, Any] = {
        "name": ["f_ux", "a_parameter_whose_name_has_40_characters"],
        "unit": ["px^-1", ""],
        "truth": np.array([2e-6, 5.0]),
        "MAP": np.array([2.1e-6, 5.1]),
        "mean": np.array([-2.1e-6, 5.1]),
        "sd": np.array([1e-7, 0.1]),
        "z": np.array([1.0, np.nan]),
        "corner": np.array([-0.031, np.nan]),
        "corner_sd": np.array([0.002, np.nan]),
        "rhat": np.array([1.001, 1.002]),
        "ess_bulk": np.array([1200.0, 1300.0]),
        "ess_tail": np.array([1100.0, 1400.0]),
        "prior_sensitivity": np.array([0.01, np.nan]),
    }
    return make_table(columns | changed)


def rendered(table: Any, width: int) -> list[str]:
    stream = io.StringIO()
    Console(file=stream, width=width).print(table)
    return stream.getvalue().splitlines()


@pytest.mark.parametrize("width", [30, 60, 80, 100, 120, 200])
def test_what_says_least_gives_way_first(width: int) -> None:
    """Whatever fits is there; names of 40 characters are whole, or folded where they must be."""
    summary = parameters()
    table = parameter_table(summary, width)
    heads = [str(column.header) for column in table.columns]
    order = ["prior", "MAP", "R-hat", "truth", "ESS", "z", "px at corner"]
    left_out = [head for head in order if head not in heads]
    assert left_out == order[: len(left_out)]
    assert heads[0] == "parameter" and "posterior mean +- sd" in heads
    lines = rendered(table, width)
    assert max(map(len, lines)) <= width
    if width >= 80:
        assert any("a_parameter_whose_name_has_40_characters" in line for line in lines)
        assert any("-2.10 +- 0.10 e-06" in line for line in lines)
    assert (left_out == []) == (width == 200)
    assert not any("nan" in line for line in lines)


def test_columns_without_numbers_are_left_out() -> None:
    nothing = np.full(2, np.nan)
    summary = parameters(rhat=nothing, ess_bulk=nothing, ess_tail=nothing)
    heads = [str(column.header) for column in parameter_table(summary, 200).columns]
    expected = ["truth", "MAP", "posterior mean +- sd", "z", "px at corner", "prior"]
    assert heads == ["parameter", *expected]


def test_an_error_that_is_not_known_is_blank() -> None:
    summary = parameters(robust_sd=np.array([1.3e-7, np.nan]), truth=np.array([np.nan, 5.0]))
    lines = rendered(parameter_table(summary, 200), 200)
    assert any("0.13 e-06" in line for line in lines)
    assert not any("nan" in line for line in lines)


def test_a_ranking_of_long_paths_fits() -> None:
    score = SimpleNamespace(
        name="chains/" + "x" * 90 + ".h5", n_parameters=12, elpd=-123456.7, elpd_se=123.4,
        difference=1234.5, difference_se=67.8, weight=0.25, log_evidence=-123456.7,
        evidence_error=0.01, pareto_k=0.5,
    )  # fmt: skip
    other = SimpleNamespace(**{**vars(score), "pareto_k": -np.inf})
    for width in (80, 200):
        lines = rendered(comparison_table(SimpleNamespace(scores=(score, other)), width), width)
        assert max(map(len, lines)) <= width
        assert any("1234.5 +- 67.8" in line for line in lines)
        text = "".join(re.sub(r"[│ ]", "", line.split("│")[1]) for line in lines if "│" in line)
        assert text.count("x") == 180


@pytest.mark.slow
def test_json_is_one_object_and_all_else_is_on_standard_error(
    finished: tuple[Path, Any], folder: Path
) -> None:
    shutil.copy(finished[0] / "run.h5", folder / "other.h5")
    said = invoke(folder, "report", "other.h5", "--json")
    found = json.loads(said.stdout, parse_constant=pytest.fail)
    assert said.code == 0 and said.stdout.count("\n") == 1 and without_waits(said.stderr) == ""
    assert found["sampled_well"] is found["fits_data"] is found["trustworthy"] is True
    assert found["message"].startswith("trustworthy: ")
    assert [parameter["name"] for parameter in found["parameters"]] == list(NAMES)
    assert {"unit", "MAP", "mean", "sd", "rhat", "ess_bulk", "ess_tail"} <= set(
        found["parameters"][0]
    )
    kinds = {"chain": "h5", "report": "html", "picture": "png", "sources": "sources.ecsv"}
    assert found["files"] == {name: f"other.{kind}" for name, kind in kinds.items()}
    assert found["causes"] == [] and found["displacement"].startswith("Displacement: rms ")

    said = invoke(folder, "fit", "run.toml", "--map-only", "--json")
    found = json.loads(said.stdout, parse_constant=pytest.fail)
    assert said.code == 0 and found["sampled_well"] is None and found["trustworthy"] is True
    assert found["parameters"][0]["rhat"] is None
    assert [line.split(":")[0] for line in said.stderr.splitlines()] == [
        "frame.fits", "stars.csv", "maximum",
    ]  # fmt: skip

    refused = invoke(folder, "fit", "run.toml", "--json")
    assert (refused.code, refused.stdout) == (2, "")
    assert refused.stderr.splitlines()[-1].startswith("bayesfred: run.h5: exists, ")
    (folder / "run.toml").write_text(run_text(sampling="steps = 3"), encoding="utf-8")
    poor = invoke(folder, "fit", "run.toml", "--overwrite", "--json")
    assert poor.code == 3 and json.loads(poor.stdout)["sampled_well"] is False


class Clock:
    """Ten seconds pass between any two looks at it."""

    now = 0.0

    def __call__(self) -> float:
        self.now += 10.0
        return self.now


@pytest.mark.parametrize("terminal", [False, True])
def test_where_nothing_can_be_redrawn_a_line_comes_every_half_minute(terminal: bool) -> None:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, force_jupyter=False, _environ={})
    with progress_bar("sampling", console=console, clock=Clock()) as update:
        for n in range(1, 10):
            update(n, 10, f"{n} steps")
    text = stream.getvalue()
    if terminal:  # the negative control: a live display redraws its line
        assert ESCAPE in text and "9 steps" in text
    else:
        assert re.fullmatch(r"(sampling: \d steps, \d0%\n){3,4}", text)


@pytest.mark.parametrize("terminal", [False, True])
def test_no_share_is_told_while_none_is_known(terminal: bool) -> None:
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, force_jupyter=False, _environ={})
    with progress_bar("sampling", console=console, clock=Clock()) as update:
        for n in range(1, 6):
            update(n, None, f"{n} steps")
    text = stream.getvalue()
    assert "5 steps" in text if terminal else re.fullmatch(r"(sampling: \d steps\n)+", text)


@pytest.mark.parametrize("terminal", [False, True])
@pytest.mark.parametrize("show", [False, True])
def test_long_work_is_never_silent(terminal: bool, show: bool) -> None:
    """Negative control: where nothing is to be shown there is nothing."""
    stream = io.StringIO()
    console = Console(file=stream, force_terminal=terminal, force_jupyter=False, _environ={})
    with working("thinking", show=show, console=console, interval=0.05):
        time.sleep(0.5)
    text = stream.getvalue()
    if not show:
        assert text == ""
    elif terminal:
        assert ESCAPE in text and "thinking" in text and "0:00:00" in text
    else:
        assert re.fullmatch(r"(thinking: \d s\n){2,10}", text)
        assert without_waits(text) == ""
    assert "bayesfred-wait" not in [thread.name for thread in threading.enumerate()]


@pytest.mark.slow
def test_a_notebook_gets_no_widgets_and_no_warnings(folder: Path) -> None:
    """As in a Jupyter kernel, where rich finds this shell and would show widgets."""
    code = """
        import builtins, warnings
        ZMQInteractiveShell = type("ZMQInteractiveShell", (), {"custom_exceptions": ()})
        builtins.get_ipython = ZMQInteractiveShell
        warnings.simplefilter("error")
        # what one library deprecates in another is not the package's
        warnings.filterwarnings("ignore", "", DeprecationWarning, "(?!bayesfred)")
        import bayesfred as bf, rich.console
        assert rich.console.Console().is_jupyter
        result = bf.commands.fit("run.toml", say=print)
        bf.show.show_run(result)
        bf.sample(result.chain.posterior(), seed=1, steps=5)
    """
    (folder / "run.toml").write_text(run_text(sampling="steps = 5"), encoding="utf-8")
    script = "\n".join(line.strip() for line in code.splitlines())
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=folder, env=environment(), capture_output=True,
        check=False, text=True,
    )  # fmt: skip
    assert (done.returncode, without_waits(done.stderr)) == (0, "")
    assert "not trustworthy: " in done.stdout.splitlines()[-1]
    # the negative control: rich's own display in such a shell warns
    control = """
        import builtins, warnings
        warnings.simplefilter("error")
        ZMQInteractiveShell = type("ZMQInteractiveShell", (), {})
        builtins.get_ipython = ZMQInteractiveShell
        from rich.progress import Progress
        with Progress() as bar: bar.refresh()
    """
    script = "\n".join(line.strip() for line in control.splitlines())
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, check=False, text=True
    )
    assert "ipywidgets" in done.stderr
