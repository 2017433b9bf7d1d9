"""Threads of BLAS: one while a sampler works, and all of them again afterwards."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from functools import partial
from threading import Event

import pytest
from test_sampling_protocol import CutGaussian, top
from threadpoolctl import threadpool_info, threadpool_limits

import bayesfred as bf
from bayesfred.sampling import sampler


def threads() -> set[int]:
    return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}


class Held(CutGaussian):
    """A density that tells when it is first asked, and answers when it may."""

    def __init__(self, asked: Event, may_answer: Event) -> None:
        self.asked, self.may_answer = asked, may_answer

    def log_prob(self, params):
        self.asked.set()
        assert self.may_answer.wait(30)
        return super().log_prob(params)


def overlap(each_for_itself: bool) -> tuple[set[int], ...]:
    """BLAS's threads before, within and after two runs; the first ends while the other goes on."""
    if each_for_itself:
        sampler.one_blas_thread = partial(threadpool_limits, 1, user_api="blas")
    before, estimate = threads(), top(CutGaussian())
    began, both, ended = Event(), Event(), Event()

    def run(density: Held) -> None:
        bf.sample(density, estimate, seed=1, walkers=8, steps=3, progress=False)

    with ThreadPoolExecutor(2) as pool:
        early = pool.submit(run, Held(began, both))
        assert began.wait(30)
        within = threads()
        late = pool.submit(run, Held(both, ended))
        early.result()
        ended.set()
        late.result()
    return before, within, threads()


@pytest.mark.parametrize("each_for_itself", [False, True])
def test_runs_that_overlap_leave_the_threads_as_they_were(each_for_itself: bool) -> None:
    """Negative control: limits of each run's own, of which the last knows one thread alone."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        before, within, after = pool.submit(overlap, each_for_itself).result()
    if before == {1}:
        pytest.skip("this BLAS has one thread")
    assert within == {1}
    assert after == ({1} if each_for_itself else before)
