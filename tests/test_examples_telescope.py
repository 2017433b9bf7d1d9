"""The example of a telescope does what its page says: errors that hold, and a header that is right.

One frame is fitted. Over the field the squares of the 18 coefficients and the offset decide the
mean square of the errors, so that it is known to about 30 %: the bounds below are three times that.
A calibration whose offset is changed by ten of its errors must be refused.
"""

import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import bayesfred as bf

ROOT = Path(__file__).parents[1]
RUN = (sys.executable, "-m", "bayesfred")


def call(folder: Path, *command: str) -> tuple[int, str]:
    done = subprocess.run(
        command,
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    return done.returncode, done.stdout + done.stderr


@pytest.mark.long
def test_the_errors_of_the_example_hold(tmp_path: Path) -> None:
    for name in ("telescope.py", "telescope.toml", "telescope_design.toml"):
        shutil.copy(ROOT / "examples" / name, tmp_path)
    script = (sys.executable, "telescope.py")
    chain, file = "chains/telescope.h5", "chains/telescope.calibration.h5"
    code, said = call(tmp_path, *script, "simulate")
    assert code == 0 and "116 of them catalogued" in said
    code, said = call(tmp_path, *RUN, "fit", "telescope.toml", "--map-only")
    assert code == 0, said
    assert "RA 83.2000, Dec 22.0500 degrees" in said
    assert int(re.findall(r"(\d+) stars matched to peaks", said)[0]) > 100
    assert call(tmp_path, *RUN, "calibration", chain)[0] == 0
    code, said = call(tmp_path, *RUN, "calibration", chain, "--sip", "5", "--out", "header.fits")
    assert code == 0, said
    assert max(map(float, re.findall(r"([\d.e-]+) px at worst", said))) < 1e-3
    code, said = call(tmp_path, *RUN, "correct", "telescope_field.fits", file, "--out", "flat.fits")
    assert code == 0, said
    assert call(tmp_path, *RUN, "design", "telescope_design.toml")[0] == 0

    code, said = call(tmp_path, *script, "compare")
    assert code == 0, said
    stated, z = (float(re.findall(p, said)[0]) for p in (r"stated ([\d.]+)", r"errors: ([\d.]+)"))
    assert 0.003 < stated < 0.01
    assert 0.4 < z < 1.9

    known = bf.Calibration.read(tmp_path / file)
    draws = known.draws.copy()
    draws[:, -2] += 10.0 * draws[:, -2].std()
    wrong = replace(known, draws=draws)
    wrong.write(tmp_path / file, overwrite=True)
    assert call(tmp_path, *script, "compare")[0] == 3
