"""Compiled code is never older than its source: an edited kernel changes what all its callers
compute."""

import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import bayesfred

# A kernel that calls functions of other modules: one with the polynomials, and a PSF's. That PSF
# is given inside a tuple, as the package's own kernels get it.
KERNEL = """
from bayesfred.imaging.kernels.compilation import entry, shared
from bayesfred.imaging.kernels.polynomials import evaluate
from bayesfred.imaging.kernels.psf_dispatch import psf_slopes

@entry()
def linear(c, u, v):
    return evaluate(c, u, v, (0,))[0]

@entry()
def value(parts):
    return parts[1] * psf_slopes(parts[0], 0.0, 0.0)[0]

@shared()
def twice(x):
    return 2.0 * x

@entry()
def four_times(x):
    return 2.0 * twice(x)
"""

BEGIN = """
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from bayesfred.imaging.kernels import compilation
if "numba alone" in sys.argv:
    compilation._Cache = lambda function: compilation.FunctionCache(function)
if "not asked" in sys.argv:
    compilation._Call.is_there = lambda call: True
from bayesfred.imaging.kernels.caller import linear, value
"""
POLYNOMIAL = (
    BEGIN + "import numpy as np; print(linear(np.array([[3.0, 2.0], [1.0, 0.0]]), 4.0, 5.0))"
)
OUTSIDE = BEGIN + "from family import Profile; print(value((Profile(0.5), 4.0)))"
INSIDE = BEGIN + "import bayesfred as bf; print(value((bf.GaussianPSF(1.0).profile, 4.0)))"

FAMILY = """
from typing import NamedTuple

class Profile(NamedTuple):
    norm: float

    @staticmethod
    def slopes(psf, a, b):
        return psf.norm, a, b
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy of the package with another kernel."""
    package = tmp_path / "bayesfred"
    shutil.copytree(
        Path(bayesfred.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__")
    )
    (package / "imaging" / "kernels" / "caller.py").write_text(KERNEL, encoding="utf-8")
    return package


def printed(package: Path, program: str, *arguments: str) -> float:
    """What a program prints that uses the copy of the package."""
    env = {
        name: value
        for name, value in os.environ.items()
        if name not in ("NUMBA_CACHE_DIR", "PYTHONPATH")
    }
    command, folder = [sys.executable, "-c", program, *arguments], package.parent
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=True)
    return float(done.stdout)


@pytest.mark.parametrize("arguments", [(), ("numba alone",)])
def test_an_edited_kernel_is_compiled_again(package: Path, arguments: tuple[str, ...]) -> None:
    """Negative control: with numba's own cache the edit goes unnoticed in the module that calls the
    kernel."""
    # 3 + 2 v + u at (4, 5)
    assert printed(package, POLYNOMIAL, *arguments) == 17.0
    kernel = package / "imaging" / "kernels" / "polynomials.py"
    text = kernel.read_text(encoding="utf-8")
    assert text.count("return value, c_u, c_v") == 1
    kernel.write_text(
        text.replace("return value, c_u, c_v", "return value + 1.0, c_u, c_v"), encoding="utf-8"
    )
    assert printed(package, POLYNOMIAL, *arguments) == (17.0 if arguments else 18.0)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [(), ("numba alone",)])
def test_an_edited_psf_from_outside_is_compiled_again(
    package: Path, arguments: tuple[str, ...]
) -> None:
    """Negative control: numba's own cache knows the loops' source files alone."""
    family = package.parent / "family.py"
    family.write_text(FAMILY, encoding="utf-8")
    assert printed(package, OUTSIDE, *arguments) == 2.0
    family.write_text(FAMILY.replace("psf.norm,", "2.0 * psf.norm,"), encoding="utf-8")
    assert printed(package, OUTSIDE, *arguments) == (2.0 if arguments else 4.0)
    # without the family the same loops still run: no index of theirs names it
    family.unlink()
    if arguments:
        with pytest.raises(subprocess.CalledProcessError):
            printed(package, INSIDE, *arguments)
    else:
        assert printed(package, INSIDE) == pytest.approx(4.0, rel=1e-13)


TOGETHER = (
    BEGIN
    + """
import time
from pathlib import Path
import numpy as np
from numba.core import event
class Slow(event.Listener):  # so that a busy machine starts both before one ends
    def on_start(self, event):
        time.sleep(3.0)
    def on_end(self, event):
        pass

Path("ready" + sys.argv[1]).touch()
while not Path("go").exists():
    time.sleep(0.001)
with (
    event.install_recorder("numba:compile") as compiled,
    event.install_listener("numba:compile", Slow()),
):
    assert linear(np.array([[3.0, 2.0], [1.0, 0.0]]), 4.0, 5.0) == 17.0
names = [each.data["dispatcher"].py_func.__name__ for _, each in compiled.buffer if each.is_end]
print(names.count("linear"))
"""
)


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [(), ("numba alone",)])
def test_of_processes_that_need_a_function_one_compiles_it(
    package: Path, arguments: tuple[str, ...]
) -> None:
    """Negative control: with numba's own cache each compiles it."""
    with ThreadPoolExecutor(2) as pool:
        counts = [pool.submit(printed, package, TOGETHER, name, *arguments) for name in "ab"]
        while not all((package.parent / f"ready{name}").exists() for name in "ab"):
            assert not any(count.done() for count in counts)
            time.sleep(0.01)
        (package.parent / "go").touch()
        assert sum(count.result() for count in counts) == (2.0 if arguments else 1.0)
    assert not list(package.rglob("*.lock"))


SHARED = BEGIN + "from bayesfred.imaging.kernels.caller import four_times; print(four_times(3.0))"


@pytest.mark.parametrize("arguments", [(), ("not asked",)])
def test_a_function_whose_callee_was_compiled_again_is_too(
    package: Path, arguments: tuple[str, ...]
) -> None:
    """A caller holds the name of a shared function's machine code, which another process may give
    another name.

    Negative control: if the names are not compared, the name that is missing ends the process.
    """
    assert printed(package, SHARED) == 12.0
    for file in package.rglob("caller.twice*"):
        file.unlink()
    # the number of functions that were compiled before is part of a name
    program = "import numba; numba.njit(lambda x: x)(1.0)\n" + SHARED
    if arguments:
        with pytest.raises(subprocess.CalledProcessError):
            printed(package, program, *arguments)
    else:
        assert printed(package, program) == 12.0


@pytest.mark.parametrize("arguments", [(), ("numba alone",)])
def test_a_shared_function_is_no_part_of_its_callers(
    package: Path, arguments: tuple[str, ...]
) -> None:
    """Negative control: with numba's own cache the caller's code contains it."""
    ask = BEGIN + (
        "from bayesfred.imaging.kernels.caller import four_times; four_times(3.0); "
        "code = four_times.overloads[four_times.signatures[0]].library.get_llvm_str(); "
        "print(sum('declare' in line and 'twice' in line for line in code.splitlines()))"
    )
    assert printed(package, ask, *arguments) == (0.0 if arguments else 1.0)


RAISING = """
from bayesfred.imaging.kernels.compilation import entry, inner

@inner()
def root(x):
    if x < 0.0:
        raise ValueError("negative", x)
    return x**0.5

@entry()
def value(x):
    return root(x)

try:
    value(-3.0)
except ValueError as error:
    print(error.args)
"""


def test_errors_of_functions_that_are_linked_in_keep_their_values(tmp_path):
    program = tmp_path / "raising.py"
    program.write_text(RAISING)
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    for _ in ("compiled", "read"):
        command = [sys.executable, str(program)]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout == "('negative', -3.0)\n"


COMPILED = """
import sys
from numba.core import event
import bayesfred as bf

class Names(event.Listener):
    def on_start(self, event):
        print(event.data["dispatcher"].py_func.__qualname__)

    def on_end(self, event):
        pass

event.register("numba:compile", Names())
flux, *scatters = sys.argv[1:]
stars = bf.SourceCatalog.grid(2, 12.0, 1e4)
terms = bf.PolynomialDistortion([(1, 0, 0, 0)], [(0, 1, 0, 0)])
model = bf.ForwardModel(bf.Detector((32, 32)), stars, bf.GaussianPSF(1.5), terms)
nuisances = bf.Nuisances(flux=flux, position_scatter=bool(scatters))
posterior = bf.Posterior(model, bf.simulate(model, [0.0, 0.0], 5.0, seed=1), nuisances=nuisances)
posterior.log_prob(posterior.start())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("nuisances", "some", "none"),
    [
        (("fixed",), "log_likelihoods", {"profile"}),
        (("free",), "maximize_fluxes", {"maximize", "change_source"}),
        # negative control
        pytest.param(("free", "scatters"), "maximize", set(), marks=pytest.mark.long),
    ],
)
def test_a_likelihood_compiles_what_it_needs(
    nuisances: tuple[str, ...], some: str, none: set[str], tmp_path: Path
) -> None:
    """And no messages of numba about arrays whose shapes do not match."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", COMPILED, *nuisances]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    compiled = set(done.stdout.split())
    assert some in compiled
    assert not compiled & none
    assert not [name for name in compiled if "shape" in name]
