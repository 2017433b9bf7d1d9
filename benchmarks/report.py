"""What is said of a fit beside its sampling: `python -m benchmarks.report` prints ratios.

A chain of 28 parameters is sampled to the default effective size. Then it is judged, and its page,
picture and table are written, as every fit does. Two such chains, of different terms, are compared.
Times are those of the processor; compilation is over before they are taken.
"""

import gc
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import bayesfred as bf
from bayesfred.commands.judging import compare
from bayesfred.commands.results import write_results

REPORT, COMPARISON = 0.2, 1.0  # of the sampling, of the sampling of both


def ideal(terms: bf.PolynomialDistortion) -> bf.Posterior:
    """The paper's frame."""
    detector, sources = bf.Detector((505, 505)), bf.SourceCatalog.grid(9, 50.0, 1e5)
    model = bf.ForwardModel(detector, sources, bf.GaussianPSF(10.0), terms)
    free = bf.Nuisances(flux="scale", offset=True, psf_sigma=True, background_order=2)
    counts = bf.simulate(model, np.zeros(terms.n_terms), 5.0, seed=1)
    return bf.Posterior(model, counts, nuisances=free)


def real(terms: bf.PolynomialDistortion) -> bf.Posterior:
    """400 stars of free fluxes on box pixels with read noise."""
    detector = bf.Detector((512, 512), pixel="box")
    sources, noise = bf.SourceCatalog.grid(20, 25.0, 1e4), bf.PoissonNoise(read_noise=2.0)
    model = bf.ForwardModel(detector, sources, bf.GaussianPSF(1.4), terms)
    free = bf.Nuisances(flux="free", offset=True, psf_sigma=True, background_order=2)
    counts = bf.simulate(model, np.zeros(terms.n_terms), 5.0, seed=1, noise=noise)
    return bf.Posterior(model, counts, noise=noise, nuisances=free)


def spent(work: Callable[[], object], repetitions: int = 3) -> float:
    """Processor time of some work: the median, once it has been done before."""
    work()
    times = []
    for _ in range(repetitions):
        start = time.process_time()
        work()
        times.append(time.process_time() - start)
    return float(np.median(times))


def ratios(make: Callable[[bf.PolynomialDistortion], bf.Posterior], folder: Path) -> list[float]:
    """Report over sampling, and comparison over the sampling of both."""
    paths, times = [folder / "more.h5", folder / "fewer.h5"], []
    # of 18 terms and of 10; what else is free has 10 parameters, or 9
    for path, degree in zip(paths, (3, 2), strict=True):
        posterior = make(bf.PolynomialDistortion.polynomial(degree))
        estimate = bf.find_map(posterior)

        def sample(
            posterior: bf.Posterior = posterior, estimate: bf.MapEstimate = estimate,
            path: Path = path,
        ) -> object:  # fmt: skip
            return bf.sample(posterior, estimate, path=path, seed=1, overwrite=True, progress=False)

        times.append(spent(sample, 1))
    gc.freeze()  # as the command line does with what is imported
    chain = bf.open_chain(paths[0])

    def report() -> object:
        return write_results(chain, paths[0], paths[0], target_ess=1000.0, overwrite=True)

    def judge() -> object:
        return compare([str(path) for path in paths])

    return [spent(report) / times[0], spent(judge, 1) / sum(times)]


def main() -> int:
    table, every_met = Table("measure", "ratio", "bound", "met"), True
    for name, make in (("the paper's frame", ideal), ("box pixels, read noise, free", real)):
        with tempfile.TemporaryDirectory() as folder:
            values = ratios(make, Path(folder))
        for what, value, bound in (
            ("judgement and report of 28 parameters / sampling", values[0], REPORT),
            ("comparison of two models / sampling of both", values[1], COMPARISON),
        ):
            every_met &= value <= bound
            row = f"{name}: {what}", f"{value:.2f}", f"{bound:g}", "yes" if value <= bound else "no"
            table.add_row(*row)
    Console(width=None if sys.stdout.isatty() else 110).print(table)
    return 0 if every_met else 1


if __name__ == "__main__":
    sys.exit(main())
