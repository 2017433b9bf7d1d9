"""A Ctrl-C at any time of the command line: one line and exit code 130, never a traceback."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_cli import environment

EXAMPLE = Path(__file__).parents[1] / "bayesfred" / "settings" / "example.toml"

# Interrupt where a module is looked for, or where Python lets no exception through
IMPORTING = """
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Finder())
"""
SWALLOWED = """
class Dying:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0)
def verify(*args, **options):
    Dying()
    for _ in range(200):
        time.sleep(0.01)
    raise bf.InputError("went on")
import bayesfred.commands as commands
commands.verify = verify
"""
RUN = """
import signal, sys, time
import bayesfred as bf
from bayesfred import __main__
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["bayesfred", "verify", __main__.__file__]
"""


def said(code: str) -> tuple[int, str]:
    """Exit code and standard error of the command line with some code before."""
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=environment(), check=False
    )
    return found.returncode, found.stderr


def test_while_modules_are_imported() -> None:
    assert said(RUN + IMPORTING + "__main__.main()") == (130, "bayesfred: interrupted\n")


def test_where_a_callback_lets_no_exception_through() -> None:
    kept = "bayesfred: interrupted; nothing had to be saved\n"
    assert said(RUN + SWALLOWED + "__main__.main()") == (130, kept)
    # negative control: Python's own hook
    own = "__main__._again = sys.unraisablehook\n__main__.main()"
    code, text = said(RUN + SWALLOWED + own)
    assert code == 2 and "Exception ignored in" in text and text.endswith("went on\n")


def test_what_is_ignored_stays_ignored() -> None:
    ignored = RUN.replace("signal.default_int_handler", "signal.SIG_IGN")
    code, text = said(ignored + SWALLOWED + "__main__.main()")
    assert (code, text) == (2, "bayesfred: went on\n")


@pytest.mark.long
def test_at_random_times(tmp_path: Path) -> None:
    """A hundred of them, from Python's own start on, which none of its programs can tell."""
    command = [sys.executable, "-m", "bayesfred", "fit", "run.toml"]
    (tmp_path / "run.toml").write_bytes(EXAMPLE.read_bytes())
    subprocess.run([*command[:3], "simulate", "run.toml"], cwd=tmp_path, check=True)
    seed = int.from_bytes(os.urandom(4))
    times = random.Random(seed)
    for _ in range(100):
        process = subprocess.Popen(
            command, cwd=tmp_path, env=environment(), text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        time.sleep(times.uniform(0.2, 5.0))
        process.send_signal(signal.SIGINT)
        assert process.stderr is not None
        *_, last = process.stderr.read().splitlines() or [""]
        assert process.wait(60) == 130, seed
        assert re.fullmatch(r"bayesfred: interrupted(; .+)?", last), seed
        for left in tmp_path.glob("chains/*"):
            left.unlink()
