"""Compiled code is never older than its source: an edited kernel changes what all its callers
compute."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import bayesfred

# Where a source is imaged: Newton's method calls a module of its own, with the polynomials.
RUN = """
import sys
from bayesfred.imaging.kernels import compilation
if "numba alone" in sys.argv:
    compilation._Cache = compilation.FunctionCache
import bayesfred as bf
from bayesfred.imaging.kernels.geometry import image_positions
model = bf.ForwardModel(
    bf.Detector((65, 65)), bf.SourceCatalog([20.0], [10.0], [1e4]), bf.GaussianPSF(3.0),
    bf.PolynomialDistortion([(2, 0, 0, 0)], []))
print(image_positions(model.optics(), model.sources.x * 5e-5, 0.0, 0.0, 3.0)[0, 0])
"""


def position(package: Path, *arguments: str, program: str = RUN) -> float:
    """What a program prints that uses the copy of the package: by default a source's position."""
    env = {
        name: value
        for name, value in os.environ.items()
        if name not in ("NUMBA_CACHE_DIR", "PYTHONPATH")
    }
    command, folder = [sys.executable, "-c", program, *arguments], package.parent
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=True)
    return float(done.stdout)


@pytest.mark.parametrize("arguments", [(), ("numba alone",)])
def test_an_edited_kernel_is_compiled_again(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    """Negative control: with numba's own cache the edit goes unnoticed in the module that calls the
    kernel."""
    package = tmp_path / "bayesfred"
    shutil.copytree(
        Path(bayesfred.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    assert position(package, *arguments) == pytest.approx(19.6, abs=1e-9)
    kernel = package / "imaging" / "kernels" / "polynomials.py"
    text = kernel.read_text(encoding="utf-8")
    assert text.count("return value, c_u, c_v") == 1
    kernel.write_text(
        text.replace("return value, c_u, c_v", "return value + 1.0, c_u, c_v"), encoding="utf-8"
    )
    assert position(package, *arguments) == pytest.approx(19.6 if arguments else 18.6, abs=1e-9)


FAMILY = """
import math
from typing import NamedTuple

class Profile(NamedTuple):
    norm: float

    @staticmethod
    def value(psf, a, b):
        return math.exp(-0.5 * (a * a + b * b))
"""

OUTSIDE = """
import sys
from bayesfred.imaging.kernels import compilation
if "numba alone" in sys.argv:
    compilation._Cache = compilation.FunctionCache
import bayesfred as bf
from family import Profile

class PSF(bf.GaussianPSF):
    profile = property(lambda self: Profile(0.5))

model = bf.ForwardModel(
    bf.Detector((9, 9)), bf.SourceCatalog([0.0], [0.0], [1.0]), PSF(1.0),
    bf.PolynomialDistortion([(1, 0, 0, 0)], []))
print(model.expected_counts([0.0])[4, 4])
"""


@pytest.mark.parametrize("arguments", [(), ("numba alone",)])
def test_an_edited_psf_from_outside_is_compiled_again(
    tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    """Negative control: numba's own cache knows the loops' source files alone."""
    package, family = tmp_path / "bayesfred", tmp_path / "family.py"
    shutil.copytree(
        Path(bayesfred.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    family.write_text(FAMILY, encoding="utf-8")
    assert position(package, *arguments, program=OUTSIDE) == pytest.approx(0.5)
    family.write_text(FAMILY.replace("return math", "return 2.0 * math"), encoding="utf-8")
    value = position(package, *arguments, program=OUTSIDE)
    assert value == pytest.approx(0.5 if arguments else 1.0)
    # without the family the same loops still run: no index of theirs names it
    family.unlink()
    if arguments:
        with pytest.raises(subprocess.CalledProcessError):
            position(package, *arguments)
    else:
        assert position(package) == pytest.approx(19.6, abs=1e-9)
