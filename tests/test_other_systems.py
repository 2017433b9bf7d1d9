"""What only POSIX has is not needed: a run where Python lacks it, as it does on Windows."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_any_chain import RESUMED
from test_any_input import STARS, sound_counts
from test_cli import environment

# Without what Python's own modules need where they run: fcntl, for instance.
WITHOUT = """
import multiprocessing, os, signal, sys, threading
for module, names in {
    os: ["register_at_fork", "sysconf", "O_DIRECTORY", "fork", "getuid", "geteuid", "getpgid"],
    signal: ["pthread_sigmask", "SIGHUP", "SIGKILL", "setitimer", "alarm"],
}.items():
    for name in names:
        delattr(module, name)
sys.modules["resource"] = None
opened = os.open
def refuse(path, *args, **options):
    if isinstance(path, (str, os.PathLike)) and os.path.isdir(path):
        raise PermissionError(13, "Permission denied", str(path))
    return opened(path, *args, **options)
os.open = refuse
from bayesfred.__main__ import main
sys.argv = ["bayesfred", *sys.argv[1:]]
main()
"""
STUDY = """
[simulation]
shape = [24, 24]
background = 3.0
theta = { f_ux = 1e-3 }

[study]
replicates = 2
path = "study.ecsv"
"""


@pytest.mark.long
def test_a_fit_a_report_and_a_study(tmp_path: Path) -> None:
    np.save(tmp_path / "frame.npy", sound_counts())
    (tmp_path / "stars.csv").write_text("".join(",".join(row) + "\n" for row in STARS))
    (tmp_path / "run.toml").write_text(RESUMED + STUDY)
    for words, codes in (
        ("fit run.toml", (0, 3)),
        ("report run.h5 --overwrite", (0, 3)),
        ("verify run.h5", (0,)),
        ("study run.toml --workers 2", (0, 3)),
    ):
        found = subprocess.run(
            [sys.executable, "-c", WITHOUT, *words.split()], cwd=tmp_path, env=environment(),
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert found.returncode in codes, found.stderr
        assert "Traceback" not in found.stderr
    assert (tmp_path / "run.html").exists() and (tmp_path / "study.ecsv").exists()
