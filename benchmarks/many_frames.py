"""Many frames on many workers: `python -m benchmarks.many_frames` prints what a plan needs.

Bytes sent, bytes kept, the time of an evaluation without work, that of a likelihood, and how much
faster two workers are than one, by processes and by Dask (`pip install -e '.[dask]'`). A frame has
1024 x 1024 pixels, 400 sources and 23 parameters, 18 of them shared. An evaluation is of 16
parameter vectors of every frame. `examples/many_workers.md` uses the figures. It takes about five
minutes on two cores, which nothing else should use.
"""

import os
import re
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from typing import Any

import numpy as np

import bayesfred as bf
from bayesfred.analysis.dask_cluster import DaskWorkers
from bayesfred.analysis.executor import PlacedExecutor
from bayesfred.analysis.frame_worker import kept_frames
from bayesfred.analysis.processes import processes
from bayesfred.analysis.remote_frames import RemoteFrames
from bayesfred.model.threads import one_thread

VECTORS = 16
FRAMES = 20  # of the efficiency
NUISANCES = bf.Nuisances(flux="scale", offset=True, psf_sigma=True)
LENS = bf.PolynomialDistortion.polynomial(3)


def frame(n: int = 1024, side: int = 20) -> bf.Posterior:
    sources = bf.SourceCatalog.grid(side, 0.9 * n / side, 1e4)
    model = bf.ForwardModel(bf.Detector((n, n)), sources, bf.GaussianPSF(1.5), LENS)
    counts = bf.simulate(model, np.zeros(LENS.n_terms), 5.0, seed=1)
    return bf.Posterior(model, counts, nuisances=NUISANCES)


def around(posterior: bf.Posterior) -> np.ndarray:
    """Parameter vectors within some hundredths of a pixel of no distortion."""
    half = 0.5 * posterior.counts.shape[0]
    reach = np.ones(posterior.n_parameters) * 1e-2
    reach[: LENS.n_terms] /= LENS.largest_displacement(half, half).max(axis=0)
    normal = np.random.default_rng(1).standard_normal((VECTORS, reach.size))
    return np.asarray(posterior.start() + reach * normal)


def evaluations(remote: RemoteFrames, vectors: np.ndarray, times: int) -> list[float]:
    """Seconds of each of some evaluations."""
    spent, k = [], len(remote.frames)
    own = [vectors.copy() for _ in range(k)]
    for i, each in enumerate(own):
        each[:, LENS.n_terms :] += 1e-9 * i  # not shared
    for _ in range(times):
        start = time.perf_counter()
        remote.log_likelihood(own, np.ones((k, VECTORS), bool))
        spent.append(time.perf_counter() - start)
    return spent


class Counting:
    """An executor that counts the bytes of calls and answers."""

    def __init__(self, executor: PlacedExecutor) -> None:
        self.executor, self.sent, self.back = executor, 0, 0

    def places(self) -> list[str]:
        """Those of the executor."""
        return self.executor.places()

    def submit_to(self, place: str, function: Any, /, *args: Any) -> "Future[Any]":
        """Count a call and its answer."""
        self.sent += len(ForkingPickler.dumps((function, args)))
        future = self.executor.submit_to(place, function, *args)
        future.add_done_callback(self._count)
        return future

    def _count(self, done: "Future[Any]") -> None:
        self.back += len(ForkingPickler.dumps(done.result()))


class Some:
    """The first few places of an executor."""

    def __init__(self, executor: PlacedExecutor, n: int) -> None:
        self.executor, self.n = executor, n
        self.submit_to = executor.submit_to

    def places(self) -> list[str]:
        """Some of those of the executor."""
        return self.executor.places()[: self.n]


def resident() -> int:
    """Bytes of memory of this process."""
    found = re.search(r"VmRSS:\s*(\d+)", Path("/proc/self/status").read_text())
    assert found
    return 1024 * int(found[1])


@contextmanager
def dask(workers: int, threads: int = 1) -> Iterator[DaskWorkers]:
    """A Dask cluster on this machine."""
    from distributed import Client, LocalCluster

    how: dict[str, Any] = {"dashboard_address": None, "host": "127.0.0.1", "memory_limit": 0}
    with (
        LocalCluster(n_workers=workers, threads_per_worker=threads, **how) as cluster,
        Client(cluster) as client,
    ):
        yield DaskWorkers(client)


def traffic(posterior: bf.Posterior, vectors: np.ndarray) -> list[tuple[str, float]]:
    """What travels, and what a worker keeps."""
    many = 10
    with processes(1) as workers:
        place = workers.places()[0]

        def ask(function: Callable[[], Any]) -> Any:
            return workers.submit_to(place, function).result()

        evaluations(RemoteFrames(dict.fromkeys("ab", posterior), workers), vectors, 1)
        before, known = ask(resident), sum(ask(kept_frames).values())
        counting = Counting(workers)
        remote = RemoteFrames({k: replace(posterior) for k in range(many)}, counting)
        evaluations(remote, vectors, 1)
        first = counting.sent
        counting.sent = counting.back = 0
        evaluations(remote, vectors, 1)
        kept = (ask(resident) - before) / many
        estimate = (sum(ask(kept_frames).values()) - known) / many
    return [
        ("a frame, sent once, MB", first / many / 1e6),
        ("... kept by its worker, MB", kept / 1e6),
        ("... by the worker's estimate, MB", estimate / 1e6),
        ("an evaluation of a frame, sent, kB", counting.sent / many / 1e3),
        ("... back, kB", counting.back / many / 1e3),
    ]


def latency(workers: DaskWorkers, frames: int, posterior: bf.Posterior) -> float:
    """Seconds of an evaluation of tiny frames, without those of their likelihoods."""
    vectors = around(posterior)
    remote = RemoteFrames(dict.fromkeys(range(frames), posterior), workers)
    _, *others = evaluations(remote, vectors, 6)
    work = likelihood_seconds(posterior) * frames * VECTORS / min(os.cpu_count() or 1, 2)
    return float(np.median(others)) - work


def likelihood_seconds(posterior: bf.Posterior) -> float:
    """Seconds of a thread for the likelihood of a vector."""
    vectors, spent = around(posterior), []
    with one_thread():
        for _ in range(5):
            start = time.perf_counter()
            posterior.likelihood.log_likelihood(vectors, np.ones(VECTORS, bool))
            spent.append(time.perf_counter() - start)
    return float(np.median(spent)) / VECTORS


def efficiency(workers: PlacedExecutor, posterior: bf.Posterior) -> list[float]:
    """Time with one worker over twice that with two."""
    vectors, every = around(posterior), dict.fromkeys(range(FRAMES), posterior)
    one, two = (RemoteFrames(every, Some(workers, n)) for n in (1, 2))
    return gain(lambda: evaluations(one, vectors, 1), lambda: evaluations(two, vectors, 1))


def gain(one: Callable[[], object], two: Callable[[], object]) -> list[float]:
    """Time of the first over twice that of the second, run in turn; three medians of five."""
    one(), two()
    out = []
    for _ in range(3):
        spent = np.empty((5, 2))
        for row in spent:
            for k, function in enumerate((one, two)):
                start = time.perf_counter()
                function()
                row[k] = time.perf_counter() - start
        first, second = np.median(spent, axis=0)
        out.append(first / (2.0 * second))
    return out


def ceiling() -> list[float]:
    """The same for the likelihoods alone: what two cores of this machine do without messages."""
    with processes(2) as workers:
        places = workers.places()

        def work(n: int) -> None:
            calls = [workers.submit_to(place, likelihoods, FRAMES // n) for place in places[:n]]
            for call in calls:
                call.result()

        return gain(lambda: work(1), lambda: work(2))


@cache
def prepared() -> bf.Posterior:
    """A frame, in a process."""
    return frame()


def likelihoods(n: int) -> None:
    """The likelihoods of n frames, by one thread of a process."""
    posterior = prepared()
    vectors = around(posterior)
    with one_thread():
        for _ in range(n):
            posterior.likelihood.log_likelihood(vectors, np.ones(VECTORS, bool))


def main() -> int:
    def tell(figure: str, *values: float) -> None:
        print(f"{figure:58}", *(f"{value:8.2f}" for value in values), flush=True)

    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", flush=True)
    posterior, tiny = frame(), frame(33, 1)
    seconds = likelihood_seconds(posterior)
    tell("a likelihood of a frame, ms", 1e3 * seconds)
    for figure, value in traffic(posterior, around(posterior)):
        tell(figure, value)
    tell(f"evaluation of {FRAMES} frames by a worker, s", FRAMES * VECTORS * seconds)
    tell("... efficiency of 2 cores without messages", *ceiling())
    with processes(2) as workers:
        tell("... efficiency of 2 processes (wanted: 0.85)", *efficiency(workers, posterior))
    with dask(2) as cluster:
        tell("... efficiency of 2 Dask workers (wanted: 0.85)", *efficiency(cluster, posterior))
        tell("evaluation without work, 2 Dask workers, ms", 1e3 * latency(cluster, 2, tiny))
    with dask(2, 50) as cluster:
        for frames in (100, 10_000):
            tell(f"... {frames} frames on 100 threads, ms", 1e3 * latency(cluster, frames, tiny))
    return 0


if __name__ == "__main__":
    sys.exit(main())
