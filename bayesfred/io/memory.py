"""How much memory this process may take, asked before much of it is taken.

That is the least of the machine's memory, the limits of the control groups that the process is in,
such as a container's or a batch job's, and its own resource limits.
"""

import math
import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from bayesfred.errors import InputError

try:
    import resource
except ImportError:  # Windows has no such limits
    resource = None  # type: ignore[assignment]

__all__ = ["allowed_memory", "require_room"]


def require_room(what: str, need: float, remedy: str) -> None:
    """Refuse what would take more memory than this process may have.

    Parameters
    ----------
    what : str
        What takes the memory: the beginning of the line.
    need : float, bytes
    remedy : str

    Raises
    ------
    InputError

    Examples
    --------
    >>> require_room("study: got 9e99 frames, whose table", 1e100, "ask for fewer")
    Traceback (most recent call last):
    ...
    bayesfred.errors.InputError: study: got 9e99 frames, whose table would need about 1e+91 ...
    """
    memory = allowed_memory()
    if need > memory:
        raise InputError(
            f"{what} would need about {need / 1e9:.3g} GB of memory, expected at most the "
            f"{memory / 1e9:.3g} GB that this process may take: {remedy}"
        )


def allowed_memory(root: Path = Path("/")) -> float:
    """Bytes that this process may take; infinity where nothing limits them.

    Parameters
    ----------
    root : Path
        Where the folders `proc` and `sys` of Linux are.

    Examples
    --------
    >>> allowed_memory() > 1e6
    True
    """
    return min([*_machine(), *_control_groups(root), *_own_limits()], default=math.inf)


def _machine() -> Iterator[float]:
    with suppress(AttributeError, ValueError, OSError):  # Windows has no `sysconf`
        yield float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))


def _control_groups(root: Path) -> Iterator[float]:
    """The limits of the process's control groups, of either version, and of those around them."""
    try:
        lines = (root / "proc/self/cgroup").read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return
    for line in lines:
        _, kinds, group = line.split(":", maxsplit=2)
        if kinds == "":
            top, name = root / "sys/fs/cgroup", "memory.max"
        elif "memory" in kinds.split(","):
            top, name = root / "sys/fs/cgroup/memory", "memory.limit_in_bytes"
        else:
            continue
        here = top / group.lstrip("/")
        for folder in (here, *here.parents):
            with suppress(OSError, ValueError):  # a container does not see all; "max" is no limit
                yield float((folder / name).read_text(encoding="ascii"))
            if folder == top:
                break


def _own_limits() -> Iterator[float]:
    for name in ("RLIMIT_AS", "RLIMIT_DATA"):
        if hasattr(resource, name):
            limit = resource.getrlimit(getattr(resource, name))[0]
            if limit != resource.RLIM_INFINITY:
                yield float(limit)
