"""A large frame, on two cores: `python -m benchmarks.large`.

It has 4096 x 4096 pixels, 10,000 sources of sigma 1.5, and 30 parameters.

The parameters are the 28 coefficients of every term to degree 3 with f in x, y, u and g in x, y, v,
the background and a common flux factor. Printed are the seconds to the maximum and to 1,000
effective draws, what they go into, and the peak memory.
"""

import re
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from rich.console import Console
from rich.table import Table

import bayesfred as bf
from bayesfred.optimize import find_map as search
from bayesfred.sampling import sampler

MEMORY = 4.0  # GiB


class Split:
    """Where the time goes: each part's own, without that of the parts it calls."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self.inner = [0.0]

    def run(self, part: str, work: Callable[..., Any], *args: Any, **options: Any) -> Any:
        """What `work` returns; its time goes to the part."""
        self.inner.append(0.0)
        start = time.perf_counter()
        try:
            return work(*args, **options)
        finally:
            whole = time.perf_counter() - start
            self.spent[part] = self.spent.get(part, 0.0) + whole - self.inner.pop()
            self.inner[-1] += whole

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count every call of a function from now on."""
        work = getattr(owner, name)
        setattr(owner, name, lambda *args, **options: self.run(part, work, *args, **options))


def peak() -> float:
    """Of this program, GiB."""
    found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    assert found
    return int(found[1]) / 2**20


def problem() -> bf.Posterior:
    terms = bf.PolynomialDistortion.full_polynomial(3)
    distortion = bf.PolynomialDistortion(
        [t for t in terms.f_terms if t[3] == 0], [t for t in terms.g_terms if t[2] == 0]
    )
    sources = bf.SourceCatalog.grid(100, 40.0, 2e3)
    model = bf.ForwardModel(bf.Detector((4096, 4096)), sources, bf.GaussianPSF(1.5), distortion)
    half = 2048.0
    levers = np.array(
        [half ** (1 - sum(term)) for term in (*distortion.f_terms, *distortion.g_terms)]
    )
    theta = (
        0.002 * levers * np.random.default_rng(1).standard_normal(levers.size)
    )  # every term moves a corner by some 4 pixels
    return bf.Posterior(
        model, bf.simulate(model, theta, 5.0, seed=1), nuisances=bf.Nuisances(flux="scale")
    )


def kernel_share(posterior: bf.Posterior, params: np.ndarray) -> float:
    """Share of one walker's likelihood that rendering the sources takes."""
    times = np.empty((5, 2))
    for row in times:
        start = time.thread_time()
        with posterior.likelihood.expected(params):
            pass
        middle = time.thread_time()
        posterior.log_prob(params)
        row[:] = middle - start, time.thread_time() - middle
    drawing, whole = np.median(times, axis=0)
    return min(float(drawing / whole), 1.0)


def main() -> int:
    numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
    posterior = problem()
    (
        posterior.gradient(posterior.start()),
        posterior.fisher(posterior.start()),
    )  # compiled code is loaded
    split = Split()
    split.watch(bf.Posterior, "log_prob", "likelihoods")
    split.watch(bf.Posterior, "gradient", "gradients")
    split.watch(bf.Posterior, "fisher", "Fisher information")
    split.watch(search, "find_start", "peaks, matching")
    split.watch(search, "fit_statistics", "deviance at the maximum")
    split.watch(sampler, "write_chain", "checkpoints")
    top = split.run("rest of the search", bf.find_map, posterior)
    to_map = sum(split.spent.values())
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.h5"
        chain = split.run(
            "emcee, proposals, rest", bf.sample, posterior, top, path=path, seed=1, progress=False
        )
        size = path.stat().st_size / 2**20
        verdict, memory = bf.diagnose(chain), peak()
    share = kernel_share(posterior, top.params)
    whole = sum(split.spent.values())
    table = Table(title=f"{posterior.n_parameters} parameters, 10,000 sources")
    for head in ("", "seconds", "share"):
        table.add_column(head, justify="right" if head else "left")
    table.add_row("to the maximum", f"{to_map:.1f}")
    table.add_row("to 1,000 effective draws more", f"{whole - to_map:.1f}", end_section=True)
    for part, spent in sorted(split.spent.items(), key=lambda item: -item[1]):
        table.add_row(part, f"{spent:.1f}", f"{spent / whole:.0%}")
        if part == "likelihoods":
            table.add_row(
                "  of these the kernel", f"{share * spent:.1f}", f"{share * spent / whole:.0%}"
            )
    console = Console(width=None if sys.stdout.isatty() else 110)
    console.print(table)
    console.print(verdict.message)
    console.print(
        f"peak memory {memory:.1f} GiB of {MEMORY:.0f}, frame "
        f"{posterior.counts.nbytes / 2**30:.2f}; chain file {size:.0f} MiB"
    )
    return 0 if top.fits_data and verdict.sampled_well and memory <= MEMORY else 1


if __name__ == "__main__":
    sys.exit(main())
