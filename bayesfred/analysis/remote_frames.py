"""The frames of a joint posterior, evaluated elsewhere: by processes, a Dask cluster or MPI.

An evaluation of k frames at n parameter vectors is cut into pieces: a frame each, or some of its
vectors where there are fewer frames than workers. Every piece belongs to a place, a worker or a
process, and stays with it from one evaluation to the next. A place gets its pieces in one call for
each of its threads, and with a piece the frame, if it was not sent there before. What comes back is
a number for each frame and vector. As each of them depends on its frame and its vector alone,
answers have the same bits for any number of workers.

An executor that has no places sends a call to any worker, so that every worker gets every frame
sooner or later. `frame_worker` is the other side.
"""

import hashlib
import itertools
import math
import queue
import uuid
from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Future
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from bayesfred._typing import Flags, Floats
from bayesfred.analysis.dask_cluster import of_dask
from bayesfred.analysis.executor import SILENCE, Executor, PlacedExecutor
from bayesfred.analysis.frame_worker import (
    Answer,
    Around,
    Order,
    Orders,
    Source,
    evaluate,
    pack,
)
from bayesfred.errors import InputError
from bayesfred.model.posterior import Posterior

PIECES = 4  # for each thread of a worker, at least: some have one more than others
WAITING = 2  # calls on the way to each thread of a worker
CALL = 2**23  # bytes of frames in a call, and one more frame
LOAD = 2**28  # bytes of frames on the way
LOSSES = 3  # workers that a piece may lose
ROOM = 2**32  # bytes of frames that a worker keeps

Piece = tuple[int, int]  # frame, part of its vectors


class _Anywhere:
    """An executor without places: one place, with room for twice the workers that answered."""

    def __init__(self, executor: Executor, workers: set[str]) -> None:
        self._executor, self._workers = executor, workers

    def places(self) -> list[str]:
        return ["anywhere"] * (2 * max(len(self._workers), 1))

    def submit_to(self, place: str, function: Any, /, *args: Any) -> "Future[Any]":
        future: Future[Any] = self._executor.submit(function, *args)
        return future


@dataclass
class Session:
    """What was sent so far.

    Attributes
    ----------
    owner : str
        Distinguishes these frames from those of other posteriors on the same workers.
    place : dict of Piece to str
        Where each piece was evaluated last.
    sent : dict of (str, int) to str
        Which places were sent which frames, and the key of what they prepared them for last.
    workers : set of str
        The frames that answered.
    """

    owner: str = field(default_factory=lambda: uuid.uuid4().hex)
    place: dict[Piece, str] = field(default_factory=dict)
    sent: dict[tuple[str, int], str] = field(default_factory=dict)
    workers: set[str] = field(default_factory=set)


@dataclass(frozen=True, eq=False)
class RemoteFrames:
    """Frames that the workers of an executor evaluate.

    A frame travels to a worker once. Afterwards parameter vectors do, and log-likelihoods or
    derivatives come back. A worker that is lost costs its work: others do it again.

    Parameters
    ----------
    frames : mapping of str to Posterior, or to a callable without arguments that returns one
        A callable is called by the worker, such as to read a file there: the pixels never travel.
        The mapping may load a frame when asked; it is asked when the frame is sent.
    executor : PlacedExecutor, Dask client, or anything with `submit`
        `processes`, `cluster`, a Dask client or its `get_executor()` have places. A pool of
        `concurrent.futures` or an MPI pool has none: any of its workers is given any frame.
    room : int, byte
        Of frames that a worker keeps. A frame that finds no room is sent, or read, every time.
    around : tuple of Around, length k
        Where the frames are evaluated often, see `near`; empty for the plain likelihoods.
    session : Session
        What was sent so far.

    Examples
    --------
    >>> import bayesfred as bf
    >>> from concurrent.futures import ThreadPoolExecutor
    >>> model = bf.ForwardModel(
    ...     bf.Detector((65, 65)), bf.SourceCatalog.grid(3, 20.0, 1e4), bf.GaussianPSF(3.0),
    ...     bf.PolynomialDistortion(f_terms=[(1, 0, 1, 0)], g_terms=[]))
    >>> frames = {
    ...     name: bf.Posterior(model, bf.simulate(model, [1e-4], 2.0, seed=k))
    ...     for k, name in enumerate("ab")}
    >>> vectors = np.array([[1e-4, 2.0], [0.0, 2.0]])
    >>> with ThreadPoolExecutor(1) as executor:
    ...     remote = RemoteFrames(frames, executor)
    ...     values = remote.log_likelihood([vectors, vectors], np.ones((2, 2), bool))
    >>> bool(values[1, 0] == frames["b"].likelihood.log_likelihood(vectors[:1], [True])[0])
    True
    """

    frames: Mapping[str, Source]
    executor: Any
    room: int = ROOM
    around: tuple[Around, ...] = ()
    session: Session = field(default_factory=Session, repr=False)

    def log_likelihood(self, vectors: Sequence[Floats], wanted: Flags) -> Floats:
        """Log-likelihood of every frame, see `FrameEvaluator`.

        Raises
        ------
        InputError
            If a frame cannot be evaluated, the scheduler does not answer, or workers are lost
            again and again.
        """
        out = np.full(wanted.shape, -np.inf)
        places = self._workers.places()
        most = math.ceil(PIECES * len(places) / len(out))
        rows: dict[Piece, Any] = {}
        for i, some in enumerate(wanted):
            there = np.flatnonzero(some)
            for j, part in enumerate(np.array_split(there, max(1, min(most, there.size)))):
                if part.size:
                    rows[i, j] = part
        tasks = {piece: vectors[piece[0]][part] for piece, part in rows.items()}
        for piece, values in self._evaluate(tasks, places):
            out[piece[0], rows[piece]] = values
        return out

    def derivatives(self, vectors: Sequence[Floats]) -> list[tuple[Floats, Floats]]:
        """Gradient and Fisher information of every frame, see `FrameEvaluator`.

        Raises
        ------
        InputError
            As for `log_likelihood`.
        """
        tasks = {(i, 0): vector for i, vector in enumerate(vectors)}
        found = dict(self._evaluate(tasks, self._workers.places()))
        return [found[piece] for piece in tasks]

    def near(self, params: Sequence[Floats], covariances: Sequence[Floats]) -> "RemoteFrames":
        """The same frames with faster likelihoods around some parameters, see `FrameEvaluator`.

        The workers prepare them when they are evaluated first.
        """
        around = tuple(
            Around(_digest(own.tobytes() + c.tobytes()), own, c)
            for own, c in zip(params, covariances, strict=True)
        )
        return replace(self, around=around)

    @property
    def _workers(self) -> PlacedExecutor:
        if isinstance(self.executor, PlacedExecutor):
            return self.executor
        return of_dask(self.executor) or _Anywhere(self.executor, self.session.workers)

    def _evaluate(
        self, tasks: Mapping[Piece, Floats], places: list[str]
    ) -> Iterator[tuple[Piece, Any]]:
        return _Evaluation(self, self._workers, tasks).results(places)


class _Call(NamedTuple):
    """Pieces on their way."""

    place: str
    pieces: list[Piece]
    load: int  # bytes of frames
    future: Any


class _Evaluation:
    """One evaluation of all frames."""

    def __init__(
        self, frames: RemoteFrames, workers: PlacedExecutor, tasks: Mapping[Piece, Floats]
    ) -> None:
        self.frames, self.workers, self.tasks = frames, workers, tasks
        self.names, self.session = list(frames.frames), frames.session
        self.slots: Counter[str] = Counter()
        self.calls: dict[str, deque[list[Piece]]] = defaultdict(deque)
        self.flying: Counter[str] = Counter()
        self.load = 0
        self.losses: Counter[Piece] = Counter()
        self.finished: queue.SimpleQueue[_Call] = queue.SimpleQueue()

    def results(self, places: list[str]) -> Iterator[tuple[Piece, Any]]:
        """The results of all pieces as they come."""
        pieces = list(self.tasks)
        self.session.place.update(share_out(pieces, places, self.session.place))
        self._plan(pieces, places)
        left = len(pieces)
        while left:
            self._send()
            for found in self._next():
                left -= 1
                yield found

    def _plan(self, pieces: list[Piece], places: list[str]) -> None:
        """Make calls, one for each thread of a place.

        Those with frames that are new to the place are apart, and all pieces of such a frame
        together.
        """
        self.slots = Counter(places)
        there: dict[str, list[Piece]] = defaultdict(list)
        for piece in pieces:
            there[self.session.place[piece]].append(piece)
        for place, own in there.items():
            known: list[Piece] = []
            new: dict[int, list[Piece]] = defaultdict(list)
            for piece in own:
                has = (place, piece[0]) in self.session.sent
                (known if has else new[piece[0]]).append(piece)
            self.calls[place].extend(_split(known, self.slots[place]))
            for frames in _split(list(new.values()), self.slots[place]):
                self.calls[place].append(list(itertools.chain(*frames)))

    def _send(self) -> None:
        """Send as many calls as keep the workers busy."""
        for place, calls in self.calls.items():
            most = WAITING * max(self.slots[place], 1)
            while calls and self.flying[place] < most and self.load < LOAD:
                self._submit(place, calls.popleft())

    def _submit(self, place: str, pieces: list[Piece]) -> None:
        """Send a call, or its beginning where it has many large frames."""
        orders: list[Order] = []
        load = 0
        for n, piece in enumerate(pieces):
            if load > CALL and piece[0] != pieces[n - 1][0]:
                self.calls[place].appendleft(pieces[n:])
                pieces = pieces[:n]
                break
            orders.append(self._order(place, piece))
            source = orders[-1].source
            load += source.counts.nbytes if isinstance(source, Posterior) else 0
        vectors = pack([self.tasks[piece] for piece in pieces])
        call = Orders(self.session.owner, orders, vectors, self.frames.room)
        try:
            future = self.workers.submit_to(place, evaluate, call)
        except BrokenExecutor as error:
            raise _failed(error) from error
        self.flying[place] += 1
        self.load += load
        future.add_done_callback(lambda done: self.finished.put(_Call(place, pieces, load, done)))

    def _order(self, place: str, piece: Piece) -> Order:
        """What a place is to do, with what it has not been sent before."""
        i, sent = piece[0], self.session.sent
        around = self.frames.around[i] if self.frames.around else None
        given, wanted = sent.get((place, i)), around.key if around else ""
        source = self.frames.frames[self.names[i]] if given is None else None
        prepare = around if wanted != given else None
        sent[place, i] = wanted or given or ""
        return Order(self.names[i], i, wanted, source, prepare)

    def _next(self) -> list[tuple[Piece, Any]]:
        """The results of the next call that is finished; none where its work has to be redone."""
        try:
            call = self.finished.get(timeout=SILENCE)
        except queue.Empty:
            self.workers.places()  # raises where nobody will answer
            return []
        self.flying[call.place] -= 1
        self.load -= call.load
        try:
            answer: Answer = call.future.result()
        except (BrokenExecutor, CancelledError) as error:
            self.losses.update(call.pieces)
            if max(self.losses[piece] for piece in call.pieces) > LOSSES:
                raise _failed(error) from error
            for each in [each for each in self.session.sent if each[0] == call.place]:
                del self.session.sent[each]
            self._repeat(call.pieces)
            return []
        except InputError:
            raise
        except Exception as error:  # the worker's own errors are of the kind above
            raise _failed(error) from error
        self.session.workers.add(answer.worker)
        found, lacking = [], []
        for piece, result in zip(call.pieces, answer.results, strict=True):
            if not isinstance(result, str):
                found.append((piece, result))
                continue
            lacking.append(piece)
            if result == "frame":
                self.session.sent.pop((call.place, piece[0]), None)
            else:
                self.session.sent[call.place, piece[0]] = ""
        if lacking:
            self._repeat(lacking)
        return found

    def _repeat(self, pieces: list[Piece]) -> None:
        """Plan pieces again, those of a place that is gone elsewhere."""
        places = self.workers.places()
        gone = [piece for piece in pieces if self.session.place[piece] not in places]
        self.session.place.update(share_out(gone, places, {}))
        self._plan(pieces, places)


def share_out(
    pieces: Sequence[Piece], places: Sequence[str], before: Mapping[Piece, str]
) -> dict[Piece, str]:
    """Which place each piece goes to: as before where that is a fair share, the others in turn.

    Parameters
    ----------
    pieces : sequence of Piece
    places : sequence of str
        Each as often as it has threads.
    before : mapping of Piece to str

    Returns
    -------
    dict of Piece to str

    Examples
    --------
    >>> share_out([(0, 0), (1, 0), (2, 0)], ["a", "b"], {(0, 0): "b", (2, 0): "c"})
    {(0, 0): 'b', (1, 0): 'a', (2, 0): 'a'}
    """
    most = -(-len(pieces) // len(places))
    room = {place: most * n for place, n in Counter(places).items()}
    out, left = {}, []
    for piece in pieces:
        place = before.get(piece, "")
        if room.get(place, 0):
            room[place] -= 1
            out[piece] = place
        else:
            left.append(piece)
    free = (place for place, n in room.items() for _ in range(n))
    return out | dict(zip(left, free, strict=False))


def _digest(content: bytes) -> str:
    return hashlib.blake2b(content, digest_size=16).hexdigest()


def _split(items: list[Any], n: int) -> Iterator[list[Any]]:
    """At most n parts of about one length, in order; none is empty."""
    n = min(max(n, 1), len(items))
    for j in range(n):
        yield items[len(items) * j // n : len(items) * (j + 1) // n]


def _failed(error: Exception) -> InputError:
    return InputError(
        f"frames: the workers failed ({type(error).__name__}: {error}), expected them to live: "
        "what is done so far is kept: resume, with fewer workers if it was because of "
        "insufficient memory"
    )
