"""How the search for the maximum grows: `python -m benchmarks.scale [SIDE ...]`.

Frames of SIDE x SIDE pixels (2048, 4096 and 8192 by default; 16384 takes 1 GiB of disk and some
minutes) with one star in 1,342 pixels, moved by a lens of every term to degree 3. Counts are whole
numbers of 16 bits in a file that is mapped into memory. Each search is a process of its own.
Printed are its processor time per source and its peak memory, without that of the interpreter and
the compiled code, in units of the frame's numbers in double precision.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import bayesfred as bf

SIDES = (2048, 4096, 8192)
PIXELS = 1342.0  # a source
BOUND, GROWTH = 8.0, 1.2  # GiB at most; of the time per source from the smallest frame on


def problem(side: int) -> tuple[bf.ForwardModel, np.ndarray]:
    """The model, and the true parameters."""
    rng, number = np.random.default_rng(1), round(side**2 / PIXELS)
    x, y = rng.uniform(-0.49 * side, 0.49 * side, (2, number))
    flux = np.exp(rng.uniform(np.log(2e3), np.log(1e5), number))
    lens = bf.PolynomialDistortion.polynomial(3)
    reach = lens.largest_displacement(0.5 * side, 0.5 * side).max(axis=0)
    theta = 3.0 * rng.standard_normal(lens.n_terms) / reach  # pixels, each term in a corner
    sources, psf = bf.SourceCatalog(x, y, flux), bf.GaussianPSF(1.5)
    return bf.ForwardModel(bf.Detector((side, side)), sources, psf, lens), theta


def simulate(side: int, path: Path) -> None:
    model, theta = problem(side)
    mean, rng = model.expected_counts(theta, 5.0), np.random.default_rng(2)
    out = np.lib.format.open_memmap(path, "w+", np.uint16, mean.shape)
    for first in range(0, side, 256):
        rows = slice(first, first + 256)
        out[rows] = np.minimum(rng.poisson(mean[rows]), 65535)


def peak() -> float:
    """Of this process, GiB."""
    found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) / 2**20


def search(side: int, path: Path) -> None:
    """Print seconds, GiB, GiB of the process before, and 1 where the maximum was found."""
    few, theta = problem(512)
    small = bf.Posterior(few, bf.simulate(few, theta, 5.0, seed=1))
    bf.find_map(small)  # compiled code is loaded
    before = peak()
    start = time.process_time()
    posterior = bf.Posterior(problem(side)[0], np.load(path, mmap_mode="r"))
    estimate = bf.find_map(posterior)
    print(time.process_time() - start, peak(), before, int(estimate.fits_data))


def main() -> int:
    if len(sys.argv) == 4 and sys.argv[1] in ("simulate", "search"):
        {"simulate": simulate, "search": search}[sys.argv[1]](int(sys.argv[2]), Path(sys.argv[3]))
        return 0
    table, met, first = Table(), True, None
    for head in ("pixels", "sources", "seconds", "per source / the first", "GiB", "frames", "fits"):
        table.add_column(head, justify="right")
    for side in [int(each) for each in sys.argv[1:]] or SIDES:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "frame.npy"
            for step in ("simulate", "search"):
                command = [sys.executable, "-m", "benchmarks.scale", step, str(side), str(path)]
                said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        seconds, memory, before, fits = (float(each) for each in said.split())
        number = round(side**2 / PIXELS)
        first = first or seconds / number
        growth, frames = seconds / number / first, (memory - before) * 2**27 / side**2
        table.add_row(
            f"{side}^2", str(number), f"{seconds:.1f}", f"{growth:.2f}", f"{memory:.2f}",
            f"{frames:.1f}", "yes" if fits else "no",
        )  # fmt: skip
        met &= bool(fits) and memory <= BOUND and growth <= GROWTH
    Console(width=None if sys.stdout.isatty() else 110).print(table)
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
