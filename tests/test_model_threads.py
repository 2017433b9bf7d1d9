"""Threads of BLAS: one while samplers work, and all of them again afterwards."""

from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from bayesfred.model.threads import one_blas_thread


def threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


def overlap(limit) -> set[int]:
    """BLAS's threads after two blocks of which the first ends while the second goes on."""
    began, both, ended = Barrier(2), Barrier(2), Barrier(2)

    def early() -> None:
        with limit():
            began.wait(10)
            both.wait(10)
        ended.wait(10)

    def late() -> None:
        began.wait(10)
        with limit():
            both.wait(10)
            ended.wait(10)
            assert threads() == {1}

    with ThreadPoolExecutor(2) as pool:
        for done in [pool.submit(early), pool.submit(late)]:
            done.result()
    return threads()


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("this BLAS has one thread")
        yield


def test_blocks_that_overlap_leave_the_threads_as_they_were() -> None:
    def both() -> None:
        with one_blas_thread(), one_blas_thread():
            assert threads() == {1}
        assert threads() == {2}

    both()
    for _ in range(5):
        assert overlap(one_blas_thread) == {2}


def test_limits_of_each_block_leave_one_thread() -> None:
    """The negative control: a block that begins within another remembers its limit."""
    outer = threadpool_limits(1, user_api="blas")
    inner = threadpool_limits(1, user_api="blas")
    outer.restore_original_limits()
    inner.restore_original_limits()
    assert threads() == {1}
