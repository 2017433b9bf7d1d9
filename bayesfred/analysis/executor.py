"""Many independent tasks over anything with `submit`: a process pool, a Dask cluster, MPI.

A task is given a number. What it works on, the study, is sent to a worker when that worker says it
lacks it: once for each worker, regardless of the executor and of when the worker joins.
Task k's random numbers are those of `SeedSequence(seed).spawn`'s child k, so that answers do not
depend on the workers or their order. Every finished task is a row of a table on disk before the
next is waited for. A study that was stopped is resumed after its last complete row.
"""

import hashlib
import json
import multiprocessing
import os
import queue
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from bayesfred._typing import PathLike
from bayesfred.errors import InputError, printable
from bayesfred.io import tables
from bayesfred.io.lock import only_writer
from bayesfred.io.paths import may_write
from bayesfred.model.threads import one_thread
from bayesfred.sampling.progress import progress_bar
from bayesfred.sampling.sampler import versions

WAITING = 4  # tasks sent ahead for each worker that is known


class Executor(Protocol):
    """What runs tasks.

    A `concurrent.futures` executor is one, and so is what a Dask client's `get_executor()` returns.
    """

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Any:
        """Begin a call and return its future."""


class Study(Protocol):
    """What the tasks of a study share; it is sent to the workers, so it can be pickled."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the numbers that a task returns."""

    def contents(self) -> dict[str, str]:
        """What the answers depend on, as texts by name."""

    def task(self, k: int) -> Sequence[float]:
        """The numbers of task k."""


class Answer(NamedTuple):
    """What comes back from a worker; neither numbers nor message where it lacks the study."""

    worker: str
    numbers: tuple[float, ...] | None
    message: str | None


_studies: dict[str, Study] = {}  # the study that this process works on, by its hash


def answer(key: str, study: Study | None, k: int) -> Answer:
    """Do task k of a study, in the worker; a task that fails answers with the reason."""
    global _studies
    worker = f"{socket.gethostname()}:{os.getpid()}"
    if study is not None:
        _studies = {key: study}
    known = _studies.get(key)
    if known is None:
        return Answer(worker, None, None)
    try:
        with one_thread(), threadpool_limits(1, user_api="blas"):
            return Answer(worker, tuple(map(float, known.task(k))), "")
    except Exception as error:  # whatever stops one task must not stop the others
        return Answer(
            worker,
            None,
            printable(
                str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            ),
        )


def run(
    study: Study,
    n: int,
    *,
    path: PathLike,
    meta: Mapping[str, Any],
    executor: Executor | None,
    workers: int | None,
    resume: bool,
    overwrite: bool,
    progress: bool,
) -> tables.TableRecord:
    """Do tasks 0 to n - 1 of a study, but those that the table holds already.

    Parameters
    ----------
    study : Study
    n : int
    path : path-like
        The table, .ecsv: a column `task`, the study's columns, NaN where a task failed, and a
        column `message`.
    meta : dict
        Stored in the table.
    executor : Executor, optional
        By default a pool of processes.
    workers : int, optional
        Processes of that pool, by default one a core; 1 is this process alone.
    resume, overwrite : bool
        Resume the study in the file; replace it.
    progress : bool
        Show a progress bar with the time that is left on standard error.

    Returns
    -------
    TableRecord
        The rows of tasks 0 to n - 1, in their order.

    Raises
    ------
    InputError
        If the file exists, holds another study, or cannot be written; if a worker process dies.
        What is finished is kept.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(
            f"{path}: no folder {path.parent}, expected one to write the study to: create it"
        )
    contents = study.contents()
    key = hashlib.sha256(json.dumps(contents).encode()).hexdigest()
    with only_writer(path):
        if not may_write(path, resume=resume, overwrite=overwrite):
            empty = {
                "task": np.empty(0, np.int64),
                **dict.fromkeys(study.columns, np.empty(0)),
                "message": np.empty(0, "U1"),
            }
            everything = {**meta, "versions": versions(), "contents": contents}
            tables.write_table(path, tables.TableRecord(empty, everything), overwrite=overwrite)
        record = tables.read_table(path)
        _check_same(path, record, study, contents)
        done = set(record.columns["task"].tolist())
        todo = deque(k for k in range(n) if k not in done)
        blank = [float("nan")] * len(study.columns)
        if todo:
            with ExitStack() as stack:
                append = stack.enter_context(tables.appending(path))
                update = stack.enter_context(_progress(n, n - len(todo), progress))
                for k, given in _answers(
                    study, key, todo, stack.enter_context(_executor(executor, workers))
                ):
                    append(
                        [
                            k,
                            *(blank if given.numbers is None else given.numbers),
                            given.message or "",
                        ]
                    )
                    update(given.numbers is None)
            record = tables.read_table(path)
    order = np.argsort(record.columns["task"], kind="stable")
    order = order[record.columns["task"][order] < n]
    return tables.TableRecord(
        {name: values[order] for name, values in record.columns.items()}, record.meta
    )


def _answers(
    study: Study, key: str, todo: deque[int], executor: Executor
) -> Iterator[tuple[int, Answer]]:
    """The answers as they come.

    Enough tasks are sent ahead to keep busy all workers that have answered so far.
    """
    finished: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
    waiting: set[Any] = set()
    workers: set[str] = set()

    def send(k: int, with_study: bool) -> None:
        # a process that begins here must not meet a Ctrl-C before it has learnt to leave it to this
        # one
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            future = executor.submit(answer, key, study if with_study else None, k)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        waiting.add(future)
        future.add_done_callback(lambda done: finished.put((k, done)))

    try:
        while todo or waiting:
            while todo and finished.empty() and len(waiting) < 2 + WAITING * len(workers):
                send(todo.popleft(), not workers)
            k, future = finished.get()
            waiting.discard(future)
            try:
                given = future.result()
            except Exception as error:  # a task's own errors are answers
                raise InputError(
                    f"study: the workers failed ({type(error).__name__}: {error}), expected them "
                    "to live; what is finished is "
                    "kept: resume, with fewer workers if it was because of insufficient memory"
                ) from error
            if given.message is None:
                send(k, True)
            else:
                workers.add(given.worker)
                yield k, given
    finally:
        for future in waiting:
            future.cancel()


class _Here:
    """An executor that does every task at once, in this process."""

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*args))
        return future


@contextmanager
def _executor(executor: Executor | None, workers: int | None) -> Iterator[Executor]:
    """The executor given, this process, or a pool of fresh processes."""
    if workers is not None and workers < 1:
        raise InputError(f"workers: got {workers}, expected at least 1 process")
    if executor is not None:
        yield executor
    elif workers == 1:
        yield _Here()
    else:
        pool = ProcessPoolExecutor(
            workers, multiprocessing.get_context("spawn"), initializer=_follow
        )
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _follow() -> None:
    """Begin a process of the pool.

    It ends with the process that keeps the answers, and not by a Ctrl-C, which reaches all of them.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The Dask cluster whose scheduler listens at an address.

    Parameters
    ----------
    address : str
        Such as tcp://node:8786.

    Raises
    ------
    InputError
        If Dask's `distributed` is not installed, or nothing answers there.
    """
    try:
        from distributed import Client  # noqa: PLC0415 - an optional dependency
    except ImportError:
        raise InputError(
            "--scheduler: distributed is not installed, expected it: pip install 'bayesfred[dask]'"
        ) from None
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"--scheduler: got {address!r} ({reason}), expected a Dask scheduler's address: "
            "tcp://host:port"
        ) from None
    with client:
        yield client.get_executor()


@contextmanager
def _progress(total: int, completed: int, show: bool) -> Iterator[Callable[[bool], None]]:
    """A bar that is told of every answer whether the task failed."""
    failures = 0
    with progress_bar("study", show=show) as tell:

        def update(failed: bool) -> None:
            nonlocal failures, completed
            failures += failed
            completed += 1
            tell(completed, total, f"{completed}/{total}" + f" {failures} failed" * (failures > 0))

        yield update


def _check_same(
    path: Path, record: tables.TableRecord, study: Study, contents: Mapping[str, str]
) -> None:
    """Refuse to resume another study."""
    stored = record.meta.get("contents")
    if not isinstance(stored, dict) or list(record.columns) != ["task", *study.columns, "message"]:
        raise InputError(
            f"{path}: got a table of something else, expected one of this study: write elsewhere"
        )
    changed = [name for name in contents if stored.get(name) != contents[name]]
    if changed:
        raise InputError(
            f"{path}: holds a study with another {', '.join(changed)}, expected the same: write "
            "elsewhere, or overwrite"
        )
