"""Saving a run in progress, so that neither a kill nor an interrupt loses much of it."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from bayesfred.errors import ENDINGS
from bayesfred.sampling.chain import Chain

__all__ = ["Checkpoints", "in_memory", "uninterrupted"]

INTERVAL = 30.0  # seconds
SHARE = 0.01


class Checkpoints:
    """Saves the state of a run every half minute, or less often where that takes long.

    Parameters
    ----------
    write : callable
        Saves a chain.
    clock : callable
        Returns the time in seconds.
    interval : float
        Seconds from one checkpoint to the next, at least.
    share : float
        The share of the time that may be spent on saving.
    """

    def __init__(
        self,
        write: Callable[[Chain], None],
        *,
        clock: Callable[[], float] = time.monotonic,
        interval: float = INTERVAL,
        share: float = SHARE,
    ) -> None:
        self.write, self.clock, self.interval, self.share = write, clock, interval, share
        self._next = clock() + interval

    def due(self) -> bool:
        """Whether it is time to save."""
        return self.clock() >= self._next

    def save(self, chain: Chain) -> None:
        """Save a chain; interrupts wait until that is done."""
        began = self.clock()
        with uninterrupted():
            self.write(chain)
        now = self.clock()
        self._next = now + max(self.interval, (now - began) / self.share)


def in_memory() -> Checkpoints:
    """Checkpoints of a run that is not saved."""
    return Checkpoints(lambda chain: None, interval=float("inf"))


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Keep Ctrl-C and termination waiting until the `with` block is done.

    Other threads than the main one never get them.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    arrived: list[int] = []
    before = {
        number: signal.signal(number, lambda n, _: arrived.append(n))
        for number in (signal.SIGINT, *ENDINGS)
        if signal.getsignal(number) is not signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if arrived:
            signal.raise_signal(arrived[0])
