"""Accidents: kills, interrupts, full disks, other processes at the same file.

The chain file is the old one or the new one. The operating system's calls are patched, as a disk
that fails cannot be injected otherwise; everything else is an argument.
"""

import contextlib
import errno
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import emcee
import h5py
import numpy as np
import pytest
from numpy.typing import ArrayLike
from test_model import make_model, make_posterior, make_truth
from test_sampling_chain import (
    TOTAL,
    Floats,
    assert_same_file,
    draws_of,
    interrupted,
    run,
    watched,
)
from threadpoolctl import threadpool_limits

from bayesfred.errors import InputError
from bayesfred.imaging.catalog import SourceCatalog
from bayesfred.io.lock import only_writer
from bayesfred.model.posterior import Posterior
from bayesfred.optimize.estimate import MapEstimate
from bayesfred.optimize.find_map import find_map
from bayesfred.sampling.chain import Chain
from bayesfred.sampling.chainfile import open_chain, write_chain
from bayesfred.sampling.checkpoints import Checkpoints
from bayesfred.sampling.ensembles import _Sampler
from bayesfred.sampling.sampler import Run

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    rng = np.random.default_rng(60)
    model = make_model(tolerance=1e-8)
    return make_posterior(model, make_truth(model, rng), rng)[0]


@pytest.fixture(scope="module")
def estimate(posterior: Posterior) -> MapEstimate:
    return find_map(posterior)


@pytest.fixture(scope="module")
def old(
    posterior: Posterior, estimate: MapEstimate, tmp_path_factory: pytest.TempPathFactory
) -> Chain:
    return run(posterior, estimate, tmp_path_factory.mktemp("old") / "chain.h5")


@pytest.fixture(scope="module")
def new(
    posterior: Posterior, estimate: MapEstimate, tmp_path_factory: pytest.TempPathFactory
) -> Chain:
    return run(posterior, estimate, tmp_path_factory.mktemp("new") / "chain.h5", TOTAL + 1)


@pytest.fixture
def path(old: Chain, tmp_path: Path) -> Path:
    """A finished run's file, to be endangered."""
    return Path(shutil.copy(old.path, tmp_path))


# --- every prefix of a checkpoint -----------------------------------------------------------------


class KilledError(BaseException):
    """The process is dead: nothing after this happens."""


class Disk:
    """The operations of a checkpoint, of which the one numbered `last` fails.

    After a kill all that follow fail, too.
    """

    def __init__(self, error: BaseException | None = None, last: int = 10**9) -> None:
        self.error, self.last, self.done = error, last, list[str]()
        self.patch = pytest.MonkeyPatch()

    def __enter__(self) -> None:
        create = self.watched("create", open)
        for name in ("fsync", "replace", "open", "unlink"):
            self.patch.setattr(os, name, self.watched(name, getattr(os, name)))
        self.patch.setattr("builtins.open", lambda *args: Stream(self, create(*args)))

    def __exit__(self, *_: object) -> None:
        self.patch.undo()

    def happen(self, name: str) -> None:
        if len(self.done) >= self.last and (
            isinstance(self.error, KilledError) or len(self.done) == self.last
        ):
            self.done.append("failed")
            assert self.error is not None
            raise self.error
        self.done.append(name)

    def watched(self, name: str, real: Callable[..., Any]) -> Callable[..., Any]:
        def operate(*args: Any, **kwargs: Any) -> Any:
            self.happen(name)
            return real(*args, **kwargs)

        return operate


class Stream:
    """A file whose writes can fail halfway."""

    def __init__(self, disk: Disk, real: Any) -> None:
        self.disk, self.real = disk, real

    def __enter__(self) -> "Stream":
        return self

    def __exit__(self, *_: object) -> None:
        self.real.close()

    def write(self, content: memoryview | bytes) -> None:
        whole = bytes(content)
        self.real.write(whole[: len(whole) // 2])
        self.disk.happen("write")
        self.real.write(whole[len(whole) // 2 :])

    def flush(self) -> None:
        self.disk.happen("flush")
        self.real.flush()

    def fileno(self) -> int:
        return int(self.real.fileno())


OPERATIONS = ["unlink", "create", "write", "write", "flush", "fsync", "replace", "open", "fsync"]


def test_a_checkpoint_reaches_the_disk_before_it_replaces_the_file(new: Chain, path: Path) -> None:
    disk = Disk()
    with disk:
        write_chain(replace(new, path=path))
    assert disk.done == OPERATIONS
    assert_same_file(path, new.path)


def endangered(
    write: Callable[[Chain], None], old: Chain, new: Chain, path: Path, disk: Disk
) -> None:
    """Write a chain to a disk that fails: the file is the old or the new one."""
    error, moved = disk.error, replace(new, path=path)
    expected = InputError if isinstance(error, OSError) else type(error)
    with disk, pytest.raises(expected) as caught:
        write(moved)
    replaced = "replace" in disk.done
    assert draws_of(open_chain(path)) == draws_of(new if replaced else old)
    if isinstance(error, OSError):
        assert "cannot be written (No space left on device)" in str(caught.value)
    if not isinstance(error, KilledError):
        assert [p.name for p in path.parent.iterdir()] == ["chain.h5"]
    write(moved)  # what a killed run left does not disturb
    assert_same_file(path, new.path)
    assert [p.name for p in path.parent.iterdir()] == ["chain.h5"]


@pytest.mark.parametrize("last", range(len(OPERATIONS)))
@pytest.mark.parametrize(
    "error", [KilledError(), OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), KeyboardInterrupt()]
)
def test_every_prefix_of_a_checkpoint_is_the_old_or_the_new_state(
    old: Chain, new: Chain, path: Path, last: int, error: BaseException
) -> None:
    disk = Disk(error, last)
    endangered(write_chain, old, new, path, disk)
    assert disk.done[:last] == OPERATIONS[:last]


def test_a_checkpoint_that_is_not_atomic_fails_that_test(
    old: Chain, new: Chain, path: Path
) -> None:
    content = new.path.read_bytes()

    def in_place(chain: Chain) -> None:
        assert chain.path is not None
        chain.path.unlink()
        with open(chain.path, "xb") as stream:
            stream.write(content)

    disk = Disk(KilledError(), 2)  # halfway through its one write
    with pytest.raises(InputError, match="no seal"):
        endangered(in_place, old, new, path, disk)
    assert disk.done == ["unlink", "create", "failed"]


# --- kills ----------------------------------------------------------------------------------------


def sample_without_end(path: Path, pipe: int) -> None:
    """Sample with a checkpoint after every step, and tell a pipe how many steps were saved."""

    def acknowledged(chain: Chain) -> None:
        write_chain(replace(chain, path=path))
        os.write(pipe, f"{chain.chain.shape[1]}\n".encode())

    chain = open_chain(path)
    with only_writer(path), threadpool_limits(1, user_api="blas"):
        Run.resumed(chain.posterior(), chain).until(1000.0, 10**6, often(acknowledged), show=False)


def often(write: Callable[[Chain], None]) -> Checkpoints:
    """A checkpoint after every step."""
    return Checkpoints(write, interval=0.0, share=np.inf)


def kill_often(path: Path, kills: int, seed: int) -> None:
    """Kill a sampling process again and again, and print what was found.

    It is called in a process that has no threads yet.
    """
    chance, found = random.Random(seed), {"unreadable": 0, "lost": 0, "reset": 0, "halfway": 0}
    temporary = path.with_name(f".{path.name}.tmp")
    for k in range(kills):
        before = open_chain(path)
        ours, theirs = os.pipe()
        child = os.fork()
        if child == 0:
            os.close(ours)
            try:
                sample_without_end(path, theirs)
            finally:
                os._exit(1)
        os.close(theirs)
        acknowledged = os.read(ours, 100)
        time.sleep(chance.uniform(0.0, 0.1))
        while k % 2 and not temporary.exists():  # every other time in the middle of a checkpoint
            time.sleep(1e-4)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with open(ours, "rb") as rest:
            acknowledged += rest.read()
        try:
            chain = open_chain(path)
        except InputError:
            found["unreadable"] += 1
            break
        steps, least = chain.chain.shape[1], before.chain.shape[1]
        found["lost"] += steps < int(acknowledged.split()[-1])
        found["reset"] += not np.array_equal(chain.chain[:, :least], before.chain)
        found["halfway"] += temporary.exists()
    print(json.dumps(found))


@pytest.mark.parametrize("kills", [5, pytest.param(100, marks=pytest.mark.long)])
def test_kills_lose_nothing(
    posterior: Posterior, estimate: MapEstimate, path: Path, kills: int
) -> None:
    code = (
        f"import sys; sys.path.insert(0, {str(HERE)!r}); import test_sampling_accidents as t; "
        "from pathlib import Path; "
    )
    code += f"t.kill_often(Path({str(path)!r}), {kills}, 1)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=600
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["unreadable"], found["lost"], found["reset"]) == (0, 0, 0)
    assert found["halfway"] >= kills // 5, "the kills did not meet a checkpoint"
    survived = open_chain(path)
    steps = survived.chain.shape[1]
    assert steps >= TOTAL + kills
    undisturbed = run(posterior, estimate, path.with_name("undisturbed.h5"), steps)
    assert draws_of(survived) == draws_of(undisturbed)
    run(posterior, estimate, path, steps, resume=True)
    assert_same_file(path, undisturbed.path)


# --- interrupts -----------------------------------------------------------------------------------


class Unprotected(Checkpoints):
    """Checkpoints that an interrupt stops halfway."""

    def save(self, chain: Chain) -> None:
        self.write(chain)


@pytest.mark.parametrize("kind", [Checkpoints, Unprotected])
def test_an_interrupt_while_saving_waits(
    posterior: Posterior,
    estimate: MapEstimate,
    old: Chain,
    tmp_path: Path,
    kind: type[Checkpoints],
) -> None:
    """A Ctrl-C, and another while the steps are saved; without the protection they are lost."""
    path = tmp_path / "chain.h5"

    def impatient(chain: Chain) -> None:
        signal.raise_signal(signal.SIGINT)
        write_chain(replace(chain, path=path, density=posterior))

    with pytest.raises(KeyboardInterrupt):
        watched(posterior, estimate, path, interrupted(15), checkpoints=kind(impatient))
    assert path.exists() == (kind is Checkpoints)
    if kind is Checkpoints:
        assert np.array_equal(open_chain(path).chain, old.chain[:, :6])
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


class Interrupted:
    """Random numbers during whose setting a Ctrl-C comes."""

    def set_state(self, state: object) -> None:
        raise KeyboardInterrupt


def test_no_interrupt_is_lost_while_random_numbers_are_set() -> None:
    """The negative control is emcee's own sampler."""
    for sampler_of, expected in (
        (_Sampler, pytest.raises(KeyboardInterrupt)),
        (emcee.EnsembleSampler, contextlib.nullcontext()),
    ):
        sampler = sampler_of(4, 1, lambda params: 0.0)
        sampler._random = Interrupted()
        with expected:
            sampler.random_state = np.random.RandomState(1).get_state()


def test_sampling_in_a_thread_takes_no_signals(
    posterior: Posterior, estimate: MapEstimate, old: Chain, tmp_path: Path
) -> None:
    chains: list[Chain] = []
    thread = threading.Thread(
        target=lambda: chains.append(run(posterior, estimate, tmp_path / "chain.h5"))
    )
    thread.start()
    thread.join()
    assert draws_of(chains[0]) == draws_of(old)


def test_checkpoints_keep_to_their_share(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    """On a clock on which a step takes 10 and a checkpoint 7: one every 700, the first after 30."""
    now, saved = 0.0, []

    def save(chain: Chain) -> None:
        nonlocal now
        saved.append(now)
        now += 7.0

    def step(log_prob: Callable[[ArrayLike], Floats], params: ArrayLike) -> Floats:
        nonlocal now
        now += 5.0  # 2 ensembles, which seldom make more than a call each
        return log_prob(params)

    checkpoints = Checkpoints(save, clock=lambda: now)
    watched(posterior, estimate, tmp_path / "chain.h5", step, 160, checkpoints)
    assert len(saved) == 4 and 30.0 <= saved[0] < 70.0
    assert np.all(np.diff(saved[:-1]) >= 700.0)


# --- disks ----------------------------------------------------------------------------------------


def big(
    posterior: Posterior, estimate: MapEstimate, path: Path, steps: int, **options: Any
) -> Chain:
    """A run whose every step adds 29 kB."""
    return run(posterior, estimate, path, steps, ensembles=4, walkers=64, **options)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip("a disk can be mounted by root only")
    yield disk
    subprocess.run(["umount", disk], check=True)


def test_a_full_disk_says_so_and_loses_nothing(
    posterior: Posterior, estimate: MapEstimate, small_disk: Path, tmp_path: Path
) -> None:
    path = small_disk / "chain.h5"
    checkpoints = often(lambda chain: write_chain(replace(chain, path=path)))
    running = Run(posterior, estimate, 1, ensembles=4, walkers=64)
    with (
        threadpool_limits(1, user_api="blas"),
        pytest.raises(
            InputError,
            match=r"cannot be written \(No space left on device\), expected a disk with room",
        ),
    ):
        running.until(1000.0, 200, checkpoints, show=False)
    steps = open_chain(path).chain.shape[1]
    assert 20 < steps < 120
    assert not list(small_disk.glob("*.tmp"))
    roomy = Path(shutil.copy(path, tmp_path))
    big(posterior, estimate, roomy, steps + 3, resume=True)
    assert_same_file(roomy, big(posterior, estimate, tmp_path / "whole.h5", steps + 3).path)


def test_a_file_that_may_not_grow_says_so_and_loses_nothing(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    """The same without a disk to fill: the system's limit on the size of a file."""
    path = tmp_path / "chain.h5"
    first = big(posterior, estimate, path, 4)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, hard))
    try:
        with pytest.raises(InputError, match=r"cannot be written \(File too large\)"):
            big(posterior, estimate, path, 8, resume=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert draws_of(open_chain(path)) == draws_of(first)
    assert big(posterior, estimate, path, 8, resume=True).chain.shape[1] == 8


@contextlib.contextmanager
def without_rights() -> Iterator[None]:
    """Root may write everywhere, so be somebody else for a moment."""
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@pytest.fixture(scope="module")
def hopeless() -> Posterior:
    """A posterior whose maximum cannot be found: a search for it would end with that message."""
    model = make_model(SourceCatalog.grid(3, 17.0, 1.0))
    posterior = Posterior(model, np.full((60, 75), 100.0))
    with pytest.raises(InputError, match="holds no information"):
        find_map(posterior)
    return posterior


def test_a_read_only_folder_is_refused_before_the_work(hopeless: Posterior, old: Chain) -> None:
    refused = r"cannot be written \(Permission denied\), expected a folder that can"
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(old.path, folder)
        folder.chmod(0o555)
        try:
            with without_rights():
                for target, options in (
                    ("chain.h5", {"resume": True}),
                    ("chain.h5", {"overwrite": True}),
                    ("other.h5", {}),
                ):
                    with pytest.raises(InputError, match=refused):
                        run(hopeless, None, folder / target, TOTAL + 1, **options)
                assert draws_of(open_chain(folder / "chain.h5")) == draws_of(old)
        finally:
            folder.chmod(0o755)
        assert [p.name for p in folder.iterdir()] == ["chain.h5"]


# --- others at the same file ----------------------------------------------------------------------


SINCE = r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d\S+"


def test_a_second_writer_hears_who_the_first_is_before_any_work(
    hopeless: Posterior, path: Path
) -> None:
    before = path.read_bytes()
    with only_writer(path):
        for options in ({"resume": True}, {"overwrite": True}, {}):
            with pytest.raises(
                InputError, match=rf"\(process {os.getpid()} on \S+ since {SINCE}\)"
            ):
                run(hopeless, None, path, TOTAL + 1, **options)
        (path.parent / ".chain.h5.writer").write_bytes(b"\x1b[31mme\n\xff" + b"x" * 10**6)
        with pytest.raises(InputError) as caught:
            run(hopeless, None, path, TOTAL + 1, resume=True)
        assert str(caught.value).isprintable() and len(str(caught.value)) < 1000
    assert path.read_bytes() == before


def test_links_at_the_hidden_files_lead_nowhere(
    posterior: Posterior, estimate: MapEstimate, tmp_path: Path
) -> None:
    precious = tmp_path / "precious"
    precious.write_text("mine")
    for suffix in ("tmp", "writer"):
        (tmp_path / f".chain.h5.{suffix}").symlink_to(precious)
    assert run(posterior, estimate, tmp_path / "chain.h5").chain.shape[1] == TOTAL
    assert precious.read_text() == "mine"


def test_a_killed_writer_leaves_no_lock(
    posterior: Posterior, estimate: MapEstimate, path: Path
) -> None:
    code = "from pathlib import Path; from bayesfred.io.lock import only_writer; import os, sys\n"
    code += "with only_writer(Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    assert (
        subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode
        == -signal.SIGKILL
    )
    assert (path.parent / ".chain.h5.writer").exists()
    assert run(posterior, estimate, path, TOTAL + 1, resume=True).chain.shape[1] == TOTAL + 1
    assert not (path.parent / ".chain.h5.writer").exists()


def test_a_file_that_appeared_meanwhile_is_not_replaced(
    hopeless: Posterior, old: Chain, tmp_path: Path
) -> None:
    """The other run ends while this one waits for the lock."""
    path, said = tmp_path / "chain.h5", list[str]()

    def refused() -> None:
        with pytest.raises(InputError) as caught:
            run(hopeless, None, path, 2)
        said.append(str(caught.value))

    while not said or "another process is writing" in said[-1]:  # it did not wait long enough
        path.unlink(missing_ok=True)
        thread = threading.Thread(target=refused)
        with only_writer(path):
            thread.start()
            time.sleep(0.05)
            shutil.copy(old.path, path)
        thread.join()
    assert "exists, expected a new file" in said[-1]
    assert path.read_bytes() == old.path.read_bytes()


def attach(posterior: Posterior, path: Path, k: int) -> int:
    """Attach to a file in one of the ways there are; how many steps were seen."""
    if k % 4 == 0:
        with pytest.raises(InputError, match="another process is writing"):
            run(posterior, None, path, 3, **({"resume": True} if k % 8 else {"overwrite": True}))
    if k % 4 == 1:
        backend = emcee.backends.HDFBackend(str(path), name="ensemble_0")
        emcee.EnsembleSampler(
            *backend.shape,
            posterior.log_prob,
            backend=backend,
            moves=emcee.moves.DEMove(live_dangerously=True),
        )
        return int(backend.iteration)
    if k % 4 == 2:
        with h5py.File(path, "r") as file:
            return len(file["ensemble_0/chain"])
    return open_chain(path).chain.shape[1]


@pytest.mark.parametrize("attaches", [60, pytest.param(1000, marks=pytest.mark.long)])
def test_readers_and_attaches_disturb_nobody(
    posterior: Posterior, estimate: MapEstimate, path: Path, attaches: int
) -> None:
    """A checkpoint after every step, a reader every 10 ms, and others that attach, in 4 threads."""
    seen: list[int] = []
    errors: list[BaseException] = []
    waiting, attached = list(range(attaches)), list[int]()
    stop = threading.Event()

    def guarded(work: Callable[[], object]) -> Callable[[], None]:
        def guard() -> None:
            try:
                work()
            except BaseException as error:
                errors.append(error)

        return guard

    def poll() -> None:
        while not stop.wait(0.01):
            seen.append(open_chain(path).chain.shape[1])

    def attach_often() -> None:
        while waiting and not stop.is_set():
            attached.append(attach(posterior, path, waiting.pop()))

    def until_attached(log_prob: Callable[[ArrayLike], Floats], params: ArrayLike) -> Floats:
        if errors or (len(attached) == attaches and len(seen) > 5):
            raise KeyboardInterrupt
        return log_prob(params)

    threads = [threading.Thread(target=guarded(work)) for work in (poll, *4 * [attach_often])]
    started = threading.Event()

    def write(chain: Chain) -> None:
        write_chain(replace(chain, path=path, density=posterior))
        if not started.is_set():
            started.set()
            for thread in threads:
                thread.start()

    try:
        with only_writer(path), pytest.raises(KeyboardInterrupt):
            watched(posterior, estimate, path, until_attached, 10**5, often(write), resume=True)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert errors == [] and len(attached) == attaches and min(attached) >= TOTAL
    assert seen == sorted(seen) and len(set(seen)) > 3
    steps = open_chain(path).chain.shape[1]
    assert steps >= seen[-1] > TOTAL
    assert draws_of(open_chain(path)) == draws_of(
        run(posterior, estimate, path.with_name("undisturbed.h5"), steps)
    )
