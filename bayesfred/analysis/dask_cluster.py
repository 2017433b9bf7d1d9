"""A Dask cluster: how it is reached, and how calls go to a chosen worker.

A call travels as bytes that only its worker unpacks. Dask's scheduler reads the arguments of every
task: so it reads bytes, imports this module alone, and answers while workers import the others.

References
----------
https://distributed.dask.org/en/stable/tls.html
"""

import asyncio
import ipaddress
import logging
import time
import warnings
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from bayesfred._typing import PathLike
from bayesfred.errors import InputError

CONNECTING = 8  # seconds to wait for a scheduler at first
ANSWERING = 6  # ... and for one that has answered before: it may be reading large messages
JOINING = 60  # seconds to wait for a first worker
CLOSING = 1  # seconds to say goodbye: a scheduler that is gone does not answer

ENCRYPTED = ("tls", "wss", "inproc")


def run_packed(call: bytes) -> Any:
    """Unpack a call and make it, on the worker."""
    from distributed.protocol.pickle import loads  # noqa: PLC0415 - an optional dependency

    function, args = loads(call)
    return function(*args)


class DaskWorkers:
    """The workers of a Dask cluster as an executor that has places.

    Parameters
    ----------
    client : distributed.Client
    """

    def __init__(self, client: Any) -> None:
        self.client = client

    def submit(self, function: Callable[..., Any], /, *args: Any, **where: Any) -> "Future[Any]":
        """Begin a call on any worker, or where Dask's options say, and return its future."""
        from distributed.protocol.pickle import dumps  # noqa: PLC0415 - an optional dependency

        with warnings.catch_warnings():
            # frames are large; a worker is sent each once
            warnings.filterwarnings("ignore", "Sending large graph")
            there = self.client.submit(run_packed, dumps((function, args)), pure=False, **where)
        # to cancel this future does not wait for the scheduler, as Dask's own futures do
        return asyncio.run_coroutine_threadsafe(self._result(there), self.client.loop.asyncio_loop)

    async def _result(self, there: Any) -> Any:
        from distributed.comm import CommClosedError  # noqa: PLC0415 - an optional dependency

        try:
            return await self.client.gather(there, asynchronous=True)
        except CommClosedError as error:  # the scheduler is lost: asking for its workers says so
            raise BrokenExecutor(str(error)) from error

    def submit_to(self, place: str, function: Callable[..., Any], /, *args: Any) -> "Future[Any]":
        """Begin a call on a worker, or on another one if that is lost."""
        return self.submit(function, *args, workers=[place], allow_other_workers=True)

    def places(self) -> list[str]:
        """Addresses of the workers that are there now, each as often as it has threads.

        Raises
        ------
        InputError
            If the scheduler does not answer, or no worker joins.
        """
        deadline = time.monotonic() + JOINING
        while not (threads := self._threads()):
            if time.monotonic() > deadline:
                raise InputError(
                    f"--scheduler: got no worker in {JOINING} s, expected some: what is done so "
                    "far is kept: start workers, and resume"
                )
            time.sleep(0.5)
        return [address for address, n in sorted(threads.items()) for _ in range(n)]

    def _threads(self) -> dict[str, int]:
        """The number of threads of every worker."""
        deadline, reason = time.monotonic() + ANSWERING, ""
        while (left := deadline - time.monotonic()) > 0.0:
            try:
                return dict(self.client.nthreads(callback_timeout=left))
            except Exception as error:  # which one depends on what the connection was doing
                reason = reason or _reason(error)
            time.sleep(0.25)  # the client may be connecting again
        raise InputError(
            f"--scheduler: no answer in {ANSWERING} s ({reason}), expected the scheduler to live: "
            "what is done so far is kept: start it again, and resume"
        )


def of_dask(executor: Any) -> DaskWorkers | None:
    """The workers behind a Dask client or its executor; None for anything else.

    Parameters
    ----------
    executor : object

    Returns
    -------
    DaskWorkers or None
    """
    if type(executor).__module__.split(".")[0] != "distributed":
        return None
    client = getattr(executor, "_client", executor)
    return DaskWorkers(client) if hasattr(client, "get_executor") else None


@contextmanager
def cluster(
    address: str,
    *,
    ca: PathLike | None = None,
    certificate: PathLike | None = None,
    key: PathLike | None = None,
    say: Callable[[str], None] | None = None,
) -> Iterator[DaskWorkers]:
    """The Dask cluster whose scheduler listens at an address.

    Parameters
    ----------
    address : str
        Such as tls://node:8786.
    ca, certificate, key : path-like, optional
        PEM files, for tls://: the authority that signed the scheduler's and the workers'
        certificates, one's own certificate, and its key. By default those of Dask's
        configuration, `distributed.comm.tls`.
    say : callable, optional
        Told what it means where the scheduler is on another machine and has no TLS.

    Raises
    ------
    InputError
        If Dask's `distributed` is not installed, a file is missing, or no scheduler answers there
        within 8 s.
    """
    try:
        from distributed import Client, Security  # noqa: PLC0415 - an optional dependency
        from distributed.comm import connect  # noqa: PLC0415
    except ImportError:
        raise InputError(
            "--scheduler: distributed is not installed, expected it: pip install 'bayesfred[dask]'"
        ) from None
    if say and (line := unencrypted(address)):
        say(line)
    names = {"tls_ca_file": ca, "tls_client_cert": certificate, "tls_client_key": key}
    given = {name: str(path) for name, path in names.items() if path is not None}
    if missing := [path for path in given.values() if not Path(path).is_file()]:
        raise InputError(f"--scheduler: {missing[0]}: no such file, expected one in PEM format")
    with _quiet():
        try:
            security = Security(require_encryption=True, **given) if given else Security()
            # a client waits for ever for a scheduler that accepts the connection and says nothing
            how = {"timeout": CONNECTING, **security.get_connection_args("client")}
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, _greet(connect(address, **how))).result()
            client = Client(address, timeout=CONNECTING, security=security, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError, MemoryError) as error:
            raise InputError(
                f"--scheduler: got {address!r} ({_reason(error)}), expected a Dask scheduler's "
                "address: tls://host:port with certificates, or tcp://host:port"
            ) from None
        try:
            yield DaskWorkers(client)
        finally:
            with suppress(Exception):
                client.close(timeout=CLOSING)


def unencrypted(address: str) -> str | None:
    """What it means to use a scheduler without TLS off this machine; None where there is TLS.

    Parameters
    ----------
    address : str

    Returns
    -------
    str or None
        One line.

    Examples
    --------
    >>> print(unencrypted("tcp://node:8786"))
    --scheduler: tcp://node:8786 is neither encrypted nor authenticated: anyone who ...
    >>> unencrypted("tls://node:8786"), unencrypted("tcp://127.0.0.1:8786")
    (None, None)
    """
    parts = urlsplit(address if "://" in address else f"tcp://{address}")
    if parts.scheme in ENCRYPTED or _is_loopback(parts.hostname or ""):
        return None
    return (
        f"--scheduler: {address} is neither encrypted nor authenticated: anyone who reaches its "
        "port, or a worker's, reads the frames and runs code as you: use tls://, see "
        "examples/many_workers.md"
    )


async def _greet(connecting: Awaitable[Any]) -> None:
    """Shake hands with a scheduler."""
    comm = await asyncio.wait_for(connecting, CONNECTING)
    comm.abort()


def _is_loopback(host: str) -> bool:
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _reason(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's own messages about lost connections off the terminal: they are raised instead."""
    loggers = [
        logging.getLogger(f"distributed{name}") for name in ("", ".client", ".comm", ".core")
    ]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
