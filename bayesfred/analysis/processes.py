"""Processes of this machine that calls can be sent to one by one.

Each is a pool of its own. So a frame is sent to one process only, and a process that is lost takes
nothing along but its own calls: it is replaced at the next one.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any

from bayesfred.errors import InputError


class Processes:
    """Processes as an executor that has places.

    Parameters
    ----------
    n : int
        How many.
    """

    def __init__(self, n: int) -> None:
        self._pools = {str(k): new_pool(1) for k in range(n)}

    def places(self) -> list[str]:
        """Names of the processes."""
        return list(self._pools)

    def submit_to(self, place: str, function: Callable[..., Any], /, *args: Any) -> "Future[Any]":
        """Begin a call in a process, or in another one if that is lost."""
        with uninterrupted():
            try:
                return self._pools[place].submit(function, *args)
            except BrokenExecutor:
                self._pools[place].shutdown(wait=False)
                self._pools[place] = new_pool(1)
                return self._pools[place].submit(function, *args)

    def shutdown(self) -> None:
        """End the processes after their present calls."""
        end = partial(ProcessPoolExecutor.shutdown, cancel_futures=True)
        with ThreadPoolExecutor(len(self._pools)) as threads:
            list(threads.map(end, self._pools.values()))


@contextmanager
def processes(n: int) -> Iterator[Processes]:
    """Processes of this machine, which end with the block.

    Parameters
    ----------
    n : int
        How many.

    Raises
    ------
    InputError
        If that is less than one.
    """
    if n < 1:
        raise InputError(f"workers: got {n}, expected at least 1 process")
    workers = Processes(n)
    try:
        yield workers
    finally:
        workers.shutdown()


def new_pool(n: int | None) -> ProcessPoolExecutor:
    """A pool of fresh processes, one a core by default, which end with this one.

    A Ctrl-C reaches all of them, but the process that keeps the answers decides.
    """
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(n, context, initializer=_follow)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold a Ctrl-C back while a process begins: it must first learn to leave it to this one."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _follow() -> None:
    """Begin a process of the pool."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
