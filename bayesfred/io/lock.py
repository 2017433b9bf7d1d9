"""One writer for each chain file: a lock that names its holder.

The lock is the operating system's, which frees it when its holder dies. A second file names the
holder, because some versions of filelock empty the lock file.
"""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path

import filelock

from bayesfred.errors import InputError
from bayesfred.io.paths import hidden, require_plain
from bayesfred.io.reading import require_file

PATIENCE = 0.1  # seconds; the lock of a writer that was killed is free at once


@contextmanager
def only_writer(path: Path) -> Iterator[None]:
    """Be the only writer of a chain file.

    Parameters
    ----------
    path : Path
        The chain file, which need not exist yet.

    Raises
    ------
    InputError
        If another process, which is named, is writing it, or its folder cannot be written.
    """
    place, holder, _ = hidden(path)
    require_plain(place)
    lock = filelock.FileLock(place, PATIENCE)
    try:
        lock.acquire()
        since = datetime.now().astimezone().isoformat(" ", "seconds")
        holder.unlink(missing_ok=True)
        with open(holder, "x", encoding="utf-8") as stream:  # never through a link
            stream.write(f"process {os.getpid()} on {socket.gethostname()} since {since}")
    except filelock.Timeout:
        raise InputError(
            f"{path}: another process is writing this chain{_told(holder)}, expected to be the "
            "only one: wait for it, or stop it"
        ) from None
    except OSError as error:
        lock.release()
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}), expected a folder that can be"
        ) from None
    try:
        yield
    finally:
        with suppress(OSError):
            holder.unlink(missing_ok=True)
        lock.release()


def _told(holder: Path) -> str:
    """What the holder says of itself, in a form that can be shown."""
    try:
        require_file(holder)
        with open(holder, encoding="utf-8", errors="replace") as stream:
            text = stream.read(200)
    except (InputError, OSError):
        return ""
    return f" ({''.join(c for c in text if c.isprintable())})"
