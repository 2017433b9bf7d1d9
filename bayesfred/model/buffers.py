"""What evaluations of a likelihood leave for the next: memory, and what was profiled at last."""

import queue
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from bayesfred._typing import Floats
from bayesfred.model.kernels.contexts import Known, Nearby, Rendered, Turns, Workspace

UNKNOWN = np.empty((0, 3))
NOTHING = Known(UNKNOWN, Nearby(UNKNOWN, np.empty(0), UNKNOWN))


def new_turns(
    values: Floats,
    found: Floats = UNKNOWN[None],
    start: Floats | None = None,
    nearby: Nearby = NOTHING.nearby,
) -> Turns:
    """Rows for threads to share, see `Turns`."""
    start = np.empty((len(values), *UNKNOWN.shape)) if start is None else start
    return Turns(np.zeros(1, np.int64), values, found, start, nearby)


class Workspaces:
    """Buffers that threads use in turn, made by a function when they are needed."""

    def __init__(self, make: Callable[[], Workspace]) -> None:
        self._make = make
        self._idle: queue.SimpleQueue[Workspace] = queue.SimpleQueue()

    @contextmanager
    def one(self) -> Iterator[Workspace]:
        """A workspace that no other thread uses meanwhile."""
        try:
            workspace = self._idle.get_nowait()
        except queue.Empty:
            workspace = self._make()
        yield workspace
        self._idle.put(workspace)


class LastProfiled:
    """Fluxes and shifts of every source where a likelihood was last evaluated.

    Its derivatives are wanted at the same parameters, as a rule, and then need no search of their
    own.

    Parameters
    ----------
    sources : int
        Whose fluxes are free.
    """

    def __init__(self, sources: int) -> None:
        self._sources = sources
        self._known = np.empty(0), UNKNOWN

    def room(self, vectors: Floats) -> Floats:
        """Where the loops leave what `keep` takes, shape (n, s, 3); nothing of several vectors."""
        return np.empty((len(vectors), self._sources if len(vectors) == 1 else 0, 3))

    def keep(self, vectors: Floats, values: Floats, found: Floats) -> None:
        """Keep what was found of one vector, unless its log-likelihood is -inf."""
        if found.size and values[0] > -np.inf:
            self._known = vectors[0].copy(), found[0]

    def keep_rendered(self, params: Floats, rendered: Rendered) -> None:
        """Keep what has been rendered."""
        if rendered.profiled and rendered.extra > -np.inf:
            found = np.column_stack([rendered.fluxes, rendered.profiled.shifts])
            self._known = params.copy(), found

    def missing(self, params: Floats) -> bool:
        """Whether fluxes are free and not known there."""
        return self._sources > 0 and not self.at(params).size

    def at(self, params: Floats) -> Floats:
        """Shape (s, 3); without rows where they are not known."""
        there, numbers = self._known
        return numbers if np.array_equal(there, params) else UNKNOWN
