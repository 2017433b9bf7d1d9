"""Many independent tasks over anything with `submit`: a process pool, a Dask cluster, MPI.

A task is given a number. What it works on, the study, is sent to a worker when that worker says it
lacks it: once for each worker, regardless of the executor and of when the worker joins.
Task k's random numbers are those of `SeedSequence(seed).spawn`'s child k, so that answers do not
depend on the workers or their order. Every finished task is a row of a table on disk before the
next is waited for. A study that was stopped is resumed after its last complete row.

A task that fails by what it works on has a row, which says why. One that fails by where it works,
from lack of memory or by a fault of the system, has none: it is done when the study is resumed.
"""

import hashlib
import json
import os
import queue
import socket
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from bayesfred._typing import PathLike
from bayesfred.analysis.processes import new_pool, uninterrupted
from bayesfred.analysis.study_table import check_same, resumed
from bayesfred.errors import InputError, printable
from bayesfred.io import tables
from bayesfred.io.lock import only_writer
from bayesfred.io.memory import require_room
from bayesfred.io.paths import may_write
from bayesfred.model.threads import one_blas_thread, one_thread
from bayesfred.sampling.progress import progress_bar
from bayesfred.sampling.sampler import versions

SILENCE = 1.0  # seconds without an answer after which the workers are asked for
WAITING = 4  # tasks sent ahead for each worker that is known
BYTES_A_CELL = 150.0  # of a table that is read


class Executor(Protocol):
    """What runs tasks.

    A `concurrent.futures` executor is one, and so is what a Dask client's `get_executor()` returns.
    """

    def submit(self, function: Callable[..., Any], /, *args: Any) -> Any:
        """Begin a call and return its future."""


@runtime_checkable
class PlacedExecutor(Protocol):
    """An executor that sends a call where it is asked to."""

    def places(self) -> list[str]:
        """Names of the workers that are there now, each as often as it has threads."""
        ...

    def submit_to(self, place: str, function: Any, /, *args: Any) -> "Future[Any]":
        """Begin a call on a worker, or on another one if that is lost."""
        ...


class Study(Protocol):
    """What the tasks of a study share; it is sent to the workers, so it can be pickled."""

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the numbers that a task returns."""

    def contents(self) -> dict[str, str]:
        """What the answers depend on, as texts by name."""

    def task(self, k: int) -> Sequence[float]:
        """The numbers of task k."""


ENVIRONMENT = (MemoryError, OSError)  # where a task works, not what it works on


class Answer(NamedTuple):
    """What comes back from a worker; neither numbers nor message where it lacks the study."""

    worker: str
    numbers: tuple[float, ...] | None
    message: str | None
    environment: bool = False  # whether that is why there are no numbers


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
        with one_thread(), one_blas_thread():
            return Answer(worker, tuple(map(float, known.task(k))), "")
    except Exception as error:  # whatever stops one task must not stop the others
        return Answer(
            worker,
            None,
            printable(
                str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
            ),
            isinstance(error, ENVIRONMENT),
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
    """Do the tasks 0 to n - 1 of a study that the table does not hold yet.

    Parameters
    ----------
    study : Study
    n : int
    path : path-like
        The table, .ecsv: a column `task`, the study's columns, NaN where a task failed, a column
        `message`, and a check of every row.
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
        The rows of tasks 0 to n - 1, in their order, without the checks.

    Raises
    ------
    InputError
        If the file exists, holds another study or rows that are not as they were written, or
        cannot be written; if the table would not fit in memory; if a worker process dies, or a task
        fails from lack of memory. What is finished is kept.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(
            f"{path}: no folder {path.parent}, expected one to write the study to: create it"
        )
    size = n * len(study.columns)
    require_room(
        f"study: got {n} frames, whose table", BYTES_A_CELL * size, "ask for fewer replicates"
    )
    contents = study.contents()
    key = hashlib.sha256(json.dumps(contents).encode()).hexdigest()
    everything = {**meta, "versions": versions(), "contents": contents}
    with only_writer(path):
        if not may_write(path, resume=resume, overwrite=overwrite):
            empty = {
                "task": np.empty(0, np.int64),
                **dict.fromkeys(study.columns, np.empty(0)),
                **dict.fromkeys(("message", tables.CHECK), np.empty(0, "U1")),
            }
            tables.write_table(path, tables.TableRecord(empty, everything), overwrite=overwrite)
        text = tables.read_text(path)
        record = tables.parse(path, text)
        check_same(path, record, study.columns, everything)
        tables.require_checks(path, text, key)
        done = set(record.columns["task"].tolist())
        todo = deque(k for k in range(n) if k not in done)
        if todo:
            updated = resumed(record, everything)
            if updated != record.meta:
                tables.with_meta(path, text, tables.TableRecord(record.columns, updated))
            try:
                lost = _work(study, key, todo, n, path, (executor, workers, progress))
            except KeyboardInterrupt as stop:
                stop.add_note(f"{path} holds what is finished: resume it with --resume")
                raise
            if lost:
                raise InputError(
                    f"{path}: {len(lost)} of {n} tasks failed by no fault of theirs ({lost[0]}), "
                    "expected memory and a system that works; what is finished is kept: resume, "
                    "with fewer workers if it was because of insufficient memory"
                )
            text = tables.read_text(path)
            tables.require_checks(path, text, key)
            record = tables.parse(path, text)
    order = np.argsort(record.columns["task"], kind="stable")
    order = order[record.columns["task"][order] < n]
    columns = {name: values for name, values in record.columns.items() if name != tables.CHECK}
    return tables.TableRecord(
        {name: values[order] for name, values in columns.items()}, record.meta
    )


def _work(
    study: Study,
    key: str,
    todo: deque[int],
    n: int,
    path: Path,
    how: tuple[Executor | None, int | None, bool],
) -> list[str]:
    """Do tasks and append their rows. Return the messages of tasks that the environment failed."""
    executor, workers, progress = how
    blank, lost = [float("nan")] * len(study.columns), []
    with ExitStack() as stack:
        append = stack.enter_context(tables.appending(path, key))
        update = stack.enter_context(_progress(n, n - len(todo), progress))
        pool = stack.enter_context(_executor(executor, workers))
        for k, given in _answers(study, key, todo, pool):
            message = given.message or ""
            if given.environment:
                lost.append(message)
            else:
                append([k, *(blank if given.numbers is None else given.numbers), message])
            update(given.numbers is None)
    return lost


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
        with uninterrupted():
            future = executor.submit(answer, key, study if with_study else None, k)
        waiting.add(future)
        future.add_done_callback(lambda done: finished.put((k, done)))

    try:
        while todo or waiting:
            while todo and finished.empty() and len(waiting) < 2 + WAITING * len(workers):
                send(todo.popleft(), not workers)
            try:
                k, future = finished.get(timeout=SILENCE)
            except queue.Empty:
                _require_workers(executor)
                continue
            waiting.discard(future)
            try:
                given = future.result()
            except Exception as error:  # a task's own errors are answers
                _require_workers(executor)
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


def _require_workers(executor: Executor) -> None:
    """Raise where nobody will answer, if the executor can tell."""
    if isinstance(executor, PlacedExecutor):
        executor.places()


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
        pool = new_pool(workers)
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


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
