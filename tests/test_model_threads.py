"""Threads of BLAS: one while a sampler works, and all of them again afterwards."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event

import pytest
from test_sampling_protocol import CutGaussian, top
from threadpoolctl import threadpool_info

import bayesfred as bf


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


def test_runs_that_overlap_leave_the_threads_as_they_were() -> None:
    """The first to begin ends while the other goes on, which knows one thread alone."""
    before = threads()
    if max(before) == 1:
        pytest.skip("this BLAS has one thread")
    began, both, ended = Event(), Event(), Event()
    estimate = top(CutGaussian())

    def run(density: Held) -> None:
        bf.sample(density, estimate, seed=1, walkers=8, steps=3, progress=False)

    with ThreadPoolExecutor(2) as pool:
        early = pool.submit(run, Held(began, both))
        assert began.wait(30)
        assert threads() == {1}
        late = pool.submit(run, Held(both, ended))
        early.result()
        ended.set()
        late.result()
    assert threads() == before
