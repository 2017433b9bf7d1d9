"""Frames evaluated elsewhere: the same bits everywhere, and what is lost is told or redone.

The clusters are real ones on this machine, whose processes are killed.
"""

import asyncio
import json
import multiprocessing
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import bayesfred as bf
from bayesfred._typing import Flags, Floats
from bayesfred.analysis.dask_cluster import DaskWorkers, cluster, unencrypted
from bayesfred.analysis.executor import PlacedExecutor
from bayesfred.analysis.frame_worker import Orders, Packed, kept_frames, pack, unpack
from bayesfred.analysis.processes import Processes, processes
from bayesfred.analysis.remote_frames import RemoteFrames, share_out
from bayesfred.errors import InputError
from bayesfred.model.frame_evaluator import FrameEvaluator, LocalFrames
from bayesfred.model.joint import JointPosterior
from bayesfred.sampling.chainfile import open_chain

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[1] / "examples" / "many_workers.md"
NAMES = ["a", "b", "c", "d", "e"]


def frame(seed: int) -> bf.Posterior:
    model = bf.ForwardModel(
        bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
        bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]),
    )  # fmt: skip
    flux = "free" if seed % 2 else "fixed"
    counts = bf.simulate(model, [1e-4], 2.0, seed=seed)
    return bf.Posterior(model, counts, nuisances=bf.Nuisances(flux=flux))


FRAMES = {name: frame(seed) for seed, name in enumerate(NAMES)}
LOCAL = LocalFrames(FRAMES)
FIXED = {name: FRAMES[name] for name in "ace"}  # their fluxes are fixed, which is sooner loaded
CENTRES = [np.array([1e-4, 2.0]) for _ in NAMES]
COVARIANCES = [np.diag([1e-10, 2.5e-3]) for _ in NAMES]


def vectors(seed: int, n: int = 16) -> tuple[list[Floats], Flags]:
    """Parameter vectors, and which of them are wanted."""
    rng = np.random.default_rng(seed)
    near = [c + rng.normal(size=(n, 2)) * [1e-5, 0.05] for c in CENTRES]
    for each in near:
        each[:, 0] = near[0][:, 0]  # shared
    return near, rng.random((len(near), n)) < 0.8


def everything(frames: FrameEvaluator, seed: int) -> list[bytes]:
    """The bits of all that an evaluator answers."""
    own, wanted = vectors(seed)
    near = frames.near(CENTRES, COVARIANCES)
    derivatives = [
        *frames.derivatives([each[0] for each in own]),
        *near.derivatives([each[1] for each in own]),
    ]
    values = [frames.log_likelihood(own, wanted), near.log_likelihood(own, wanted)]
    return [each.tobytes() for each in (*values, *(x for pair in derivatives for x in pair))]


@pytest.fixture(scope="module")
def three() -> Iterator[Processes]:
    with processes(3) as workers:
        yield workers


class Watched:
    """Some places of an executor, and what is sent to them."""

    def __init__(self, executor: PlacedExecutor, n: int) -> None:
        self.executor, self.n = executor, n
        self.sent: list[tuple[str, Orders]] = []

    def places(self) -> list[str]:
        return self.executor.places()[: self.n]

    def submit_to(self, place: str, function: Any, /, *args: Any) -> "Future[Any]":
        self.sent.append((place, args[0]))
        return self.executor.submit_to(place, function, *args)

    def frames(self) -> list[tuple[str, str]]:
        """The frames that were sent, with their places."""
        sent = [(place, each) for place, orders in self.sent for each in orders.each]
        return [(place, each.name) for place, each in sent if each.source is not None]


# --- the same bits --------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3])
def test_any_number_of_processes_gives_the_same_bits(three: Processes, n: int) -> None:
    remote = RemoteFrames(FRAMES, Watched(three, n))
    for seed in (1, 2):
        assert everything(remote, seed) == everything(LOCAL, seed)


def test_a_pool_without_places_gives_the_same_bits() -> None:
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        remote = RemoteFrames(FIXED, pool)
        own, wanted = vectors(1)[0][:3], np.ones((3, 16), bool)
        for _ in range(3):
            values = remote.log_likelihood(own, wanted)
            assert values.tobytes() == LocalFrames(FIXED).log_likelihood(own, wanted).tobytes()


def test_other_vectors_give_other_bits() -> None:
    """That the tests above can fail."""
    first, second = everything(LOCAL, 1), everything(LOCAL, 2)
    assert all(a != b for a, b in zip(first, second, strict=True))
    other = LocalFrames({**FRAMES, "e": frame(9)})
    assert everything(other, 1) != first


def test_a_worker_of_several_threads_gives_the_same_bits() -> None:
    class Threads:
        """One process that takes four calls at a time."""

        def __init__(self, pool: ThreadPoolExecutor) -> None:
            self.pool = pool

        def places(self) -> list[str]:
            return ["here"] * 4

        def submit_to(self, place: str, function: Any, /, *args: Any) -> "Future[Any]":
            return self.pool.submit(function, *args)

    with ThreadPoolExecutor(4) as pool:
        remote = RemoteFrames(FRAMES, Threads(pool))
        for seed in range(5):
            assert everything(remote, seed) == everything(LOCAL, seed)


# --- what travels ---------------------------------------------------------------------------------


def test_a_frame_travels_once_to_its_place(three: Processes) -> None:
    watched = Watched(three, 3)
    remote = RemoteFrames(FRAMES, watched)
    everything(remote, 1)
    frames = watched.frames()
    assert len(set(frames)) == len(frames) <= 5 + 3 - 1  # ... or two, with its vectors in parts
    assert {name for _, name in frames} == set(NAMES)
    watched.sent.clear()
    everything(remote, 2)
    assert watched.frames() == []
    assert all(each.prepare is None for _, orders in watched.sent for each in orders.each)
    assert len(watched.sent) == 4 * 3  # a call a place and an evaluation


def test_a_new_place_gets_a_fair_share_and_the_others_keep_theirs(three: Processes) -> None:
    watched = Watched(three, 2)
    many = {f"{k}": FRAMES["a"] for k in range(24)}
    remote = RemoteFrames(many, watched)
    own, wanted = [CENTRES[0][None]] * 24, np.ones((24, 1), bool)
    remote.log_likelihood(own, wanted)
    watched.n = 3
    watched.sent.clear()
    remote.log_likelihood(own, wanted)
    place = watched.places()[2]
    assert [where for where, _ in watched.frames()] == [place] * 8


def test_shares_are_fair_and_stay() -> None:
    rng = np.random.default_rng(1)
    before: dict[tuple[int, int], str] = {}
    for _ in range(200):
        places = sorted(rng.choice(list("abcdefgh"), rng.integers(1, 9)).tolist())
        pieces = [(int(k), 0) for k in range(rng.integers(1, 40))]
        out = share_out(pieces, places, before)
        most = -(-len(pieces) // len(places))
        counts = {p: list(out.values()).count(p) for p in places}
        assert list(out) and set(out) == set(pieces)
        assert all(counts[p] <= most * places.count(p) for p in places)
        moved = [p for p in pieces if before.get(p) in places and out[p] != before[p]]
        full = [p for p in set(places) if counts[p] == most * places.count(p)]
        assert all(before[piece] in full for piece in moved)
        before = out


def test_parameters_that_frames_share_travel_once() -> None:
    own, _ = vectors(1)
    packed = pack(own)
    assert isinstance(packed, Packed)
    assert packed.shared.tolist() == [True, False]
    assert packed.own.nbytes == 5 * 16 * 8
    own[1][0, 1], own[2][0, 0], own[3][0, 0] = np.nan, -0.0, 0.0
    for given in (own, own[:1], [own[0], own[1][:3]], [each[0] for each in own]):
        back = unpack(pack(given))
        assert [each.tobytes() for each in back] == [each.tobytes() for each in given]


# --- frames that the workers make -----------------------------------------------------------------


def reading(path: Path) -> bf.Posterior:
    """A frame whose counts are in a file."""
    plain = frame(0)
    return bf.Posterior(plain.model, np.load(path), nuisances=plain.nuisances)


def test_frames_are_read_where_they_are(three: Processes, tmp_path: Path) -> None:
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", frame(ord(name)).counts)
    sources = {name: partial(reading, tmp_path / f"{name}.npy") for name in "ab"}
    remote = RemoteFrames(sources, Watched(three, 1))
    own, wanted = CENTRES[:2], np.ones((2, 1), bool)
    values = remote.log_likelihood([each[None] for each in own], wanted)
    local = LocalFrames({name: source() for name, source in sources.items()})
    assert values.tobytes() == local.log_likelihood([v[None] for v in own], wanted).tobytes()
    (tmp_path / "b.npy").unlink()
    again = RemoteFrames(sources, Watched(three, 1))
    with pytest.raises(InputError, match=r"^frame b: FileNotFoundError: .*b\.npy") as told:
        again.log_likelihood([each[None] for each in own], wanted)
    assert "\n" not in str(told.value)


class Lazy(Mapping[str, bf.Posterior]):
    """Frames that are loaded when asked for."""

    def __init__(self) -> None:
        self.loaded: list[str] = []

    def __getitem__(self, name: str) -> bf.Posterior:
        self.loaded.append(name)
        return FRAMES[name]

    def __iter__(self) -> Iterator[str]:
        return iter(NAMES)

    def __len__(self) -> int:
        return len(NAMES)


def test_frames_are_loaded_when_they_are_sent(three: Processes) -> None:
    lazy = Lazy()
    remote = RemoteFrames(lazy, Watched(three, 1))
    assert lazy.loaded == []
    assert everything(remote, 1) == everything(LOCAL, 1)
    assert sorted(lazy.loaded) == NAMES


def test_a_worker_keeps_what_it_has_room_for(three: Processes) -> None:
    place = three.places()[0]

    def kept() -> dict[tuple[str, int], int]:
        found: dict[tuple[str, int], int] = three.submit_to(place, kept_frames).result()
        return found

    fixed = {f"{k}": frame(2 * k) for k in range(4)}
    own, wanted = vectors(1)[0][:4], np.ones((4, 16), bool)
    expected = LocalFrames(fixed).log_likelihood(own, wanted)
    everything_fits = RemoteFrames(fixed, Watched(three, 1))
    everything_fits.log_likelihood(own, wanted)
    size = kept()[everything_fits.session.owner, 0]
    watched = Watched(three, 1)
    small = RemoteFrames(fixed, watched, room=int(2.5 * size))
    for _ in range(3):
        assert small.log_likelihood(own, wanted).tobytes() == expected.tobytes()
        assert 0 < sum(kept().values()) <= 2.5 * size
    assert {owner for owner, _ in kept()} == {small.session.owner}
    # two of the four find room, and are found again each time
    assert len(watched.frames()) == 4 + 2 + 2
    none = RemoteFrames(fixed, Watched(three, 1), room=0)
    assert none.log_likelihood(own, wanted).tobytes() == expected.tobytes()
    assert kept() == {}


# --- workers that are lost ------------------------------------------------------------------------


def test_a_process_that_is_lost_costs_its_work_alone() -> None:
    with processes(2) as workers:
        remote = RemoteFrames(FIXED, workers)
        own, wanted = vectors(1)[0][:3], np.ones((3, 16), bool)
        expected = LocalFrames(FIXED).log_likelihood(own, wanted).tobytes()
        remote.log_likelihood(own, wanted)
        pids = [workers.submit_to(place, os.getpid).result() for place in workers.places()]
        workers.submit_to("0", time.sleep, 0.5)  # ... and the evaluation waits behind this
        threading.Timer(0.2, os.kill, (pids[0], signal.SIGKILL)).start()
        assert remote.log_likelihood(own, wanted).tobytes() == expected
        after = [workers.submit_to(place, os.getpid).result() for place in workers.places()]
        assert after[0] != pids[0] and after[1] == pids[1]


def test_a_pool_that_is_broken_is_told_in_one_line() -> None:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        remote = RemoteFrames(FRAMES, pool)
        own, wanted = vectors(1)
        os.kill(pool.submit(os.getpid).result(), signal.SIGKILL)
        with pytest.raises(InputError, match=r"^frames: the workers failed .*resume") as told:
            remote.log_likelihood(own, wanted)
        assert "\n" not in str(told.value)


class Murderous:
    """An executor whose workers die of a frame."""

    def places(self) -> list[str]:
        return ["here"]

    def submit_to(self, place: str, function: Any, /, *args: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        future.cancel()
        future.set_running_or_notify_cancel()
        return future


def test_a_frame_that_kills_every_worker_is_not_sent_for_ever() -> None:
    remote = RemoteFrames(FRAMES, Murderous())
    own, wanted = vectors(1)
    with pytest.raises(InputError, match="insufficient memory"):
        remote.log_likelihood(own, wanted)


INTERRUPTED = """
import numpy as np
from bayesfred.analysis.processes import processes
from bayesfred.analysis.remote_frames import RemoteFrames
from test_remote_frames import FIXED, vectors

if __name__ == "__main__":
    own, wanted = vectors(1)[0][:3], np.ones((3, 16), bool)
    with processes(2) as workers:
        remote = RemoteFrames(FIXED, workers)
        remote.log_likelihood(own, wanted)
        print("ready", flush=True)
        while True:
            remote.log_likelihood(own, wanted)
"""


def in_tests() -> dict[str, str]:
    """The environment in which a script finds the tests."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}


def test_an_interrupt_ends_the_processes_too(tmp_path: Path) -> None:
    """A terminal's Ctrl-C, which goes to all of them."""
    script = tmp_path / "interrupted.py"
    script.write_text(INTERRUPTED, encoding="utf-8")
    process = subprocess.Popen(
        [sys.executable, script], env=in_tests(), start_new_session=True, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(0.2)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)  # ... when nobody has the pipes open any more
    assert process.returncode == -signal.SIGINT
    assert said.count("Traceback") == 1 and said.endswith("KeyboardInterrupt\n")


# --- Dask -----------------------------------------------------------------------------------------


class Loopback:
    """A Dask scheduler with workers, on this machine: processes of which some are killed."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "scheduler.json"
        self.log = (folder / "log").open("w")
        self.scheduler = self.run(
            f"dask scheduler --host 127.0.0.1 --port 0 --no-dashboard --scheduler-file {self.file}"
        )
        self.workers = [self.run(f"{WORKER} --scheduler-file {self.file}") for _ in range(3)]

    def run(self, command: str) -> "subprocess.Popen[bytes]":
        return dask(command, self.log)

    @property
    def address(self) -> str:
        wait(lambda: self.file.exists() and self.file.read_text())
        return str(json.loads(self.file.read_text())["address"])

    def end(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.wait()
        self.log.close()


WORKER = "dask worker --no-nanny --nthreads 1 --no-dashboard --host 127.0.0.1"


def dask(command: str, log: Any, cwd: Path | None = None) -> "subprocess.Popen[bytes]":
    words = [sys.executable, "-m", *shlex.split(command)]
    return subprocess.Popen(words, cwd=cwd, stdout=log, stderr=log)


def wait(until: Callable[[], object]) -> None:
    deadline = time.monotonic() + 120.0
    while not until():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@contextmanager
def told_within(seconds: float, words: str) -> Iterator[None]:
    """An InputError of one line, soon after the block begins."""
    start = time.monotonic()
    with pytest.raises(InputError, match=words) as told:
        yield
    assert time.monotonic() - start < seconds
    assert "\n" not in str(told.value)


def test_a_dask_cluster_that_loses_a_worker_and_then_its_scheduler(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    joint = JointPosterior({name: FRAMES[name] for name in "ac"}, ["f_ux"])
    estimate = bf.find_map(joint, [1e-4, 2.0, 2.0])
    how: dict[str, Any] = {"seed": 1, "progress": False, "ensembles": 2, "walkers": 8}
    path = tmp_path / "chain.h5"
    with ExitStack() as stack:
        loopback = Loopback(tmp_path)
        stack.callback(loopback.end)
        workers = stack.enter_context(cluster(loopback.address))
        wait(lambda: len(workers.places()) == 3)
        # the same bits, a worker killed at work
        remote = RemoteFrames(FRAMES, workers)
        expected = [everything(LOCAL, seed) for seed in range(8)]
        assert everything(remote, 0) == expected[0]
        threading.Timer(0.1, loopback.workers[1].kill).start()
        for _ in range(3):
            assert [everything(remote, seed) for seed in range(8)] == expected
        assert len(workers.places()) == 2
        # a user's client, and its executor
        for executor in (workers.client, workers.client.get_executor()):
            assert everything(RemoteFrames(FRAMES, executor), 1) == expected[1]
        # a scheduler that does not answer for a while
        os.kill(loopback.scheduler.pid, signal.SIGSTOP)
        with told_within(10.0, r"--scheduler: no answer in 6 s .*is kept: .*resume"):
            everything(remote, 1)
        os.kill(loopback.scheduler.pid, signal.SIGCONT)
        assert everything(remote, 1) == expected[1]
        # one that is killed while a chain is sampled
        sampled = joint.with_evaluator(RemoteFrames(joint.frames, workers))
        threading.Timer(3.0, loopback.scheduler.kill).start()
        with told_within(13.0, r"--scheduler: no answer in 6 s .*is kept: .*resume"):
            bf.sample(sampled, estimate, path=path, steps=100_000, **how)
    kept = open_chain(path)
    steps = kept.chain.shape[1]
    assert steps > 3
    chain = bf.sample(joint, estimate, steps=steps + 2, **how)
    assert chain.chain[:, :steps].tobytes() == kept.chain.tobytes()
    resumed = bf.sample(joint, estimate, path=path, steps=steps + 2, resume=True, **how)
    assert resumed.chain.tobytes() == chain.chain.tobytes()


def test_a_connection_that_breaks_while_an_answer_comes_is_a_lost_scheduler() -> None:
    comm = pytest.importorskip("distributed.comm", reason="Dask's distributed is not installed")

    class Client:
        """A client whose scheduler resets its connection."""

        def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
            self.loop = SimpleNamespace(asyncio_loop=loop)

        def submit(self, *args: object, **options: object) -> None: ...

        async def gather(self, future: object, asynchronous: bool) -> None:
            raise comm.CommClosedError("reset")

        def nthreads(self, callback_timeout: float) -> None:
            time.sleep(callback_timeout)
            raise OSError("nobody there")

    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        workers = DaskWorkers(Client(loop))
        with pytest.raises(BrokenExecutor, match="reset"):
            workers.submit(len, ()).result()
        with told_within(10.0, r"--scheduler: no answer in 6 s \(nobody there\)"):
            everything(RemoteFrames(FIXED, workers), 1)
    finally:
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def test_a_cluster_with_tls_as_the_page_says(tmp_path: Path) -> None:
    """The page's own commands, at a free port, one worker."""
    pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    openssl, scheduler, worker = commands("openssl", "dask scheduler", "dask worker")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    subprocess.run(shlex.split(openssl), cwd=tmp_path, check=True, capture_output=True)
    with (tmp_path / "log").open("w") as log, ExitStack() as stack:
        for command in (scheduler, worker):
            there = command.replace("8786", port).replace("node", "127.0.0.1")
            there = re.sub(r"--nworkers \d+", "--no-nanny --host 127.0.0.1", there)
            process = dask(there, log, tmp_path)
            stack.callback(process.wait)
            stack.callback(process.kill)
        files = {"ca": "dask.pem", "certificate": "dask.pem", "key": "dask.key"}
        given = {name: tmp_path / file for name, file in files.items()}
        wait(lambda: answers(port))
        with cluster(f"tls://127.0.0.1:{port}", **given) as workers:
            wait(lambda: workers.client.nthreads())
            assert workers.submit(os.getpid).result() == process.pid
            own, wanted = vectors(1)
            values = RemoteFrames(FIXED, workers).log_likelihood(own[:3], wanted[:3])
            assert (
                values.tobytes() == LocalFrames(FIXED).log_likelihood(own[:3], wanted[:3]).tobytes()
            )
        # the files by environment variables, as for `--scheduler`
        variables = dict(re.findall(r"export (\w+)=(\S+)", PAGE.read_text(encoding="utf-8")))
        assert len(variables) == 3
        asked = (
            "import sys; from bayesfred.analysis.dask_cluster import cluster\n"
            "with cluster(sys.argv[1]) as workers: print(len(workers.places()))"
        )
        found = subprocess.run(
            [sys.executable, "-c", asked, f"tls://127.0.0.1:{port}"], cwd=tmp_path, check=True,
            env=os.environ | variables, capture_output=True, text=True,
        )  # fmt: skip
        assert found.stdout == "1\n"
        # nobody else gets in
        subprocess.run(
            shlex.split(openssl.replace("dask.", "other.")), cwd=tmp_path, check=True,
            capture_output=True,
        )  # fmt: skip
        other = {"certificate": tmp_path / "other.pem", "key": tmp_path / "other.key"}
        with (
            told_within(10.0, "--scheduler: got 'tls://"),
            cluster(f"tls://127.0.0.1:{port}", **{**given, **other}),
        ):
            pass
        with told_within(10.0, "--scheduler: got 'tcp://"), cluster(f"tcp://127.0.0.1:{port}"):
            pass


def answers(port: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", int(port))) == 0


def commands(*starts: str) -> list[str]:
    """Lines of the page's console blocks that begin with some words, continued ones joined."""
    text = PAGE.read_text(encoding="utf-8").replace("\\\n", " ")
    return [next(line for line in text.splitlines() if line.startswith(start)) for start in starts]


def test_a_certificate_that_is_missing_is_named(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    missing = tmp_path / "dask.pem"
    with (
        told_within(5.0, "--scheduler: .*dask.pem: no such file"),
        cluster("tls://a:1", ca=missing),
    ):
        pass


def test_a_scheduler_that_never_answers_is_told_in_time() -> None:
    pytest.importorskip("distributed", reason="Dask's distributed is not installed")
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with told_within(10.0, f"--scheduler: got '{address}'"), cluster(address):
            pass


@pytest.mark.parametrize(
    ("address", "open_to_all"),
    [
        ("tcp://node:8786", True),
        ("node:8786", True),
        ("10.0.0.3:8786", True),
        ("tcp://[2001:db8::1]:8786", True),
        ("ws://node:8786", True),
        ("tls://node:8786", False),
        ("tcp://127.0.0.1:8786", False),
        ("localhost:8786", False),
        ("tcp://[::1]:8786", False),
    ],
)
def test_a_scheduler_without_tls_says_what_it_means(address: str, open_to_all: bool) -> None:
    line = unencrypted(address)
    assert (line is not None) == open_to_all
    if line:
        assert address in line and "runs code as you" in line and "\n" not in line
        assert PAGE.name in line
