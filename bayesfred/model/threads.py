"""The threads that share an ensemble's walkers with the calling one, as many as numba may use."""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import numba

_pool: ThreadPoolExecutor | None = None


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
    global _pool
    _pool = None


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
