"""Replace a file in one step: a reader meets the old file or the new one, never half of one.

Everything that the package writes as a whole goes through :func:`replace`: frames, catalogues,
tables, pages, pictures and chain files. `paths.may_write` says beforehand whether it may.
"""

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from bayesfred.errors import InputError

__all__ = ["replace", "writing"]


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what a disk or a file system refuses into one line.

    Parameters
    ----------
    path : Path
        The file that is written, to begin the line with.

    Raises
    ------
    InputError
        In place of an `OSError`, and of the `ValueError` of a path that no file can have.
    """
    try:
        yield
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            f"{path}: cannot be written ({reason}), expected a disk with room and a folder that "
            "can be written"
        ) from error


def replace(path: Path, *content: bytes | memoryview, sole_writer: bool = False) -> None:
    """Write a file under a temporary name, flush it to the disk, and rename it over `path`.

    A link at `path` is replaced, not followed. The folder is flushed too, so that the new name
    survives a power failure. Where anything fails before the renaming, the old file stays, and the
    temporary one is removed.

    Parameters
    ----------
    path : Path
    *content : bytes or memoryview
        What the file holds, in pieces.
    sole_writer : bool
        Whether a lock keeps other writers away. There is then one temporary name, so that what a
        killed writer left under it is removed by the next.

    Raises
    ------
    InputError
        The file cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     replace(Path(folder, "page"), b"old")
    ...     replace(Path(folder, "page"), b"new", b"er")
    ...     Path(folder, "page").read_text(), os.listdir(folder)
    ('newer', ['page'])
    """
    token = "" if sole_writer else f".{secrets.token_hex(4)}"
    temporary = path.with_name(f".{path.name}{token}.tmp")
    with writing(path):
        try:
            if sole_writer:
                temporary.unlink(missing_ok=True)
            with open(temporary, "xb") as stream:
                for piece in content:
                    stream.write(piece)
                stream.flush()
                os.fsync(stream.fileno())
            os.replace(temporary, path)
            _sync(path.parent)
        except BaseException:
            with contextlib.suppress(OSError, ValueError):
                temporary.unlink(missing_ok=True)
            raise


def _sync(folder: Path) -> None:
    """Have the system write down that a file has another name, where it lets a folder be opened."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except PermissionError:  # Windows opens none; others none that may not be listed
        return
    try:
        os.fsync(number)
    finally:
        os.close(number)
