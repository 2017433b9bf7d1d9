"""Frames where they are evaluated: what a worker does for `remote_frames`, and what it keeps.

A worker keeps the frames that it was given, so that afterwards parameter vectors alone have to
travel. When an order is for a frame that it lacks, it says so and is given the frame. What it keeps
is bounded. Frames are evaluated in turn, so that at the limit the one used longest ago is the next
that is needed: the one used last makes room, after those of other posteriors.
"""

import os
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from bayesfred._typing import Flags, Floats
from bayesfred.errors import InputError
from bayesfred.model.likelihood import FrameLikelihood
from bayesfred.model.posterior import Posterior
from bayesfred.model.threads import one_thread

PIXEL = 48  # bytes that a worker needs for a pixel of a frame: counts, twice, masks, and `near`

Source = Posterior | Callable[[], Posterior]
Lack = Literal["frame", "around"]
Key = tuple[str, int]  # owner and number of a frame
Result = Floats | tuple[Floats, Floats] | Lack


class Around(NamedTuple):
    """Parameters around which a frame is evaluated often, and how far, see `Posterior.near`."""

    key: str
    params: Floats  # (d,)
    covariance: Floats  # (d, d)


class Order(NamedTuple):
    """A frame to be evaluated, with what the worker may need for it.

    Attributes
    ----------
    name : str
        The frame's name, for messages.
    frame : int
        Its number.
    around : str
        Key of `Around`; empty where the likelihood is the plain one.
    source : Posterior, or callable without arguments that returns one; optional
        The frame, for a worker that lacks it.
    prepare : Around, optional
        Likewise.
    """

    name: str
    frame: int
    around: str
    source: Source | None
    prepare: Around | None


class Packed(NamedTuple):
    """Vectors of several frames: the parameters that all share, once, and the others."""

    shared: Flags  # (d,)
    common: Floats  # (n, p), or (p,) for derivatives
    own: Floats  # (k, n, d - p), or (k, d - p)


class Orders(NamedTuple):
    """What a call asks for.

    Attributes
    ----------
    owner : str
        Whose frames they are: others have the same numbers.
    each : list of Order
    vectors : list of ndarray, shape (n, d) for log-likelihoods, (d,) for derivatives; or packed
    room : int, byte
        Of frames that the worker keeps.
    """

    owner: str
    each: list[Order]
    vectors: list[Floats] | Packed
    room: int


class Answer(NamedTuple):
    """What comes back: of every order its result, or what the worker lacks for it."""

    worker: str
    results: list[Result]


@dataclass
class _Kept:
    """A frame that a worker keeps, and its likelihood around some parameters."""

    likelihood: FrameLikelihood
    around: str = ""
    near: FrameLikelihood | None = None

    @property
    def size(self) -> int:
        """Estimate of its bytes."""
        return PIXEL * self.likelihood.counts.size


_frames: dict[Key, _Kept] = {}  # what this process keeps, the one used last at the end
_lock = threading.Lock()  # a worker may have several threads


def evaluate(orders: Orders) -> Answer:
    """Carry out orders, in the worker: one thread, also of linear algebra.

    Parameters
    ----------
    orders : Orders

    Returns
    -------
    Answer

    Raises
    ------
    InputError
        If a frame cannot be read or evaluated; the frame's name leads.
    """
    with one_thread(), _libraries().limit(limits=1, user_api="blas"):
        pairs = zip(orders.each, unpack(orders.vectors), strict=True)
        results = [_result(orders, order, vectors) for order, vectors in pairs]
    return Answer(worker_name(), results)


def pack(vectors: list[Floats]) -> list[Floats] | Packed:
    """Vectors of several frames without repeating the parameters that are the same to the last bit.

    Parameters
    ----------
    vectors : list of ndarray, shape (n, d) or (d,)

    Returns
    -------
    list of ndarray, or Packed
        The vectors as they are where they differ in shape.

    Examples
    --------
    >>> packed = pack([np.array([[1.0, 2.0]]), np.array([[1.0, 3.0]])])
    >>> packed.common, packed.own.shape
    (array([[1.]]), (2, 1, 1))
    >>> unpack(packed)[1]
    array([[1., 3.]])
    """
    if len(vectors) < 2 or len({each.shape for each in vectors}) > 1:
        return vectors
    every = np.stack(vectors)
    bits = every.view(np.int64)
    shared = (bits == bits[0]).all(axis=tuple(range(bits.ndim - 1)))
    return Packed(shared, every[0][..., shared], every[..., ~shared])


def unpack(vectors: list[Floats] | Packed) -> list[Floats]:
    """The vectors of every frame."""
    if not isinstance(vectors, Packed):
        return vectors
    out = np.empty((*vectors.own.shape[:-1], vectors.shared.size))
    out[..., vectors.shared] = vectors.common
    out[..., ~vectors.shared] = vectors.own
    return list(out)


def worker_name() -> str:
    """The machine's name and the process."""
    return f"{socket.gethostname()}:{os.getpid()}"


def kept_frames() -> dict[Key, int]:
    """The frames that this process keeps, by owner and number, with an estimate of their bytes."""
    with _lock:
        return {key: kept.size for key, kept in _frames.items()}


@cache
def _libraries() -> ThreadpoolController:
    """The libraries of linear algebra; looking for them takes longer than many an order."""
    return ThreadpoolController()


def _result(orders: Orders, order: Order, vectors: Floats) -> Result:
    try:
        likelihood = _likelihood(orders, order)
        if isinstance(likelihood, str):
            return likelihood
        if vectors.ndim == 1:
            return likelihood.gradient(vectors), likelihood.fisher(vectors)
        return likelihood.log_likelihood(vectors, np.ones(len(vectors), dtype=bool))
    except Exception as error:  # every exception can be sent back as this one
        known = isinstance(error, InputError)
        reason = str(error) if known else f"{type(error).__name__}: {error}"
        raise InputError(f"frame {order.name}: {reason}") from error


def _likelihood(orders: Orders, order: Order) -> FrameLikelihood | Lack:
    """The likelihood that an order is for."""
    key = orders.owner, order.frame
    kept = _used(key)
    if kept is None:
        if order.source is None:
            return "frame"
        frame = order.source if isinstance(order.source, Posterior) else order.source()
        kept = _Kept(frame.likelihood)
        with _lock:
            if _frames:  # buffers are larger than a frame
                kept.likelihood.share_workspaces(next(reversed(_frames.values())).likelihood)
        _keep(key, kept, orders.room)
    if not order.around:
        return kept.likelihood
    if kept.around != order.around:
        if order.prepare is None:
            return "around"
        near = kept.likelihood.near(order.prepare.params, order.prepare.covariance)
        kept.around, kept.near = order.around, near
    assert kept.near is not None
    return kept.near


def _used(key: Key) -> _Kept | None:
    """A frame if it is kept; it is now the one used last."""
    with _lock:
        if key in _frames:
            _frames[key] = _frames.pop(key)
        return _frames.get(key)


def _keep(key: Key, new: _Kept, room: int) -> None:
    """Keep a frame, if there is room when others go."""
    with _lock:
        _frames.pop(key, None)
        others = [other for other in _frames if other[0] != key[0]]
        while _frames and new.size + sum(kept.size for kept in _frames.values()) > room:
            _frames.pop(others.pop(0) if others else next(reversed(_frames)))
        if new.size <= room:
            _frames[key] = new
