"""The threads that share an ensemble's walkers with the calling one, up to numba's limit."""

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numba
from threadpoolctl import threadpool_limits

_pool: ThreadPoolExecutor | None = None
# since threadpoolctl 3.8 a limit of OpenBLAS belongs to the thread that set it
_setter = ThreadPoolExecutor(1, "bayesfred-blas")
_blas = threading.Lock()
_blas_blocks = 0  # in which BLAS has one thread
_blas_limits: threadpool_limits | None = None


def share(work: Callable[[], None], most: int) -> None:
    """Do the same work in this thread and in others, and wait for them.

    Parameters
    ----------
    work : callable
        Takes what is to be done next until nothing is left.
    most : int
        Threads that can be of use.
    """
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(numba.config.NUMBA_NUM_THREADS, "bayesfred")
    helpers = [_pool.submit(work) for _ in range(min(numba.get_num_threads(), most) - 1)]
    work()
    for helper in helpers:
        helper.result()


def _forget() -> None:
    global _pool, _setter
    _pool, _setter = None, ThreadPoolExecutor(1, "bayesfred-blas")


if hasattr(os, "register_at_fork"):  # Windows cannot fork
    os.register_at_fork(after_in_child=_forget)


@contextmanager
def one_thread() -> Iterator[None]:
    """Evaluate ensembles in the calling thread alone: for work of which every core does its own."""
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let BLAS use one thread: idle ones spin, and take half the cores from what is at work.

    The limit is the process's, so it ends with the last of `with` blocks that overlap in several
    threads.
    """
    global _blas_blocks, _blas_limits
    with _blas:
        if _blas_blocks == 0:
            _blas_limits = _setter.submit(threadpool_limits, 1, "blas").result()
        _blas_blocks += 1
    try:
        yield
    finally:
        with _blas:
            _blas_blocks -= 1
            if _blas_blocks == 0 and _blas_limits is not None:
                _setter.submit(_blas_limits.restore_original_limits).result()
