"""Threads of BLAS: one while samplers work, and all of them again afterwards."""

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from bayesfred.model.threads import one_blas_thread


def threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def two_threads():
    with threadpool_limits(2, user_api="blas"):
        if threads() != {2}:
            pytest.skip("this BLAS has one thread")
        yield


def test_the_last_of_overlapping_blocks_brings_the_threads_back() -> None:
    outer, inner = one_blas_thread(), one_blas_thread()
    outer.__enter__()
    inner.__enter__()
    outer.__exit__(None, None, None)
    assert threads() == {1}
    inner.__exit__(None, None, None)
    assert threads() == {2}


def test_limits_of_each_block_leave_one_thread() -> None:
    """The negative control: a block that begins within another remembers its limit."""
    outer = threadpool_limits(1, user_api="blas")
    inner = threadpool_limits(1, user_api="blas")
    outer.restore_original_limits()
    inner.restore_original_limits()
    assert threads() == {1}
