"""What every reader of files needs.

That the file is there, its lines, and one line where it is damaged.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bayesfred.errors import InputError

__all__ = ["read_lines", "readable", "require_file"]


def require_file(path: Path) -> None:
    """Refuse what is no file, in one line."""
    if not os.path.exists(path):  # `Path.exists` raises for some paths that no file can have
        raise InputError(f"{path}: no such file, expected one to read; check the path")
    if not path.is_file():
        raise InputError(f"{path}: not a file, expected one to read; check the path")


def read_lines(path: Path) -> list[str]:
    r"""The lines of a text file, without their ends.

    Line ends alone separate them. `str.splitlines` also splits at a vertical tab or at U+2028,
    which may be in a name.

    Parameters
    ----------
    path : Path
        In UTF-8, with or without a byte order mark; lines end with \n, \r\n or, in a file without
        \n, \r.

    Returns
    -------
    list of str
    """
    text = path.read_bytes().decode("utf-8-sig")
    text = text.replace("\r\n", "\n") if "\n" in text else text.replace("\r", "\n")
    return text.removesuffix("\n").split("\n")


@contextlib.contextmanager
def readable(path: Path, kind: str) -> Iterator[None]:
    """Turn whatever a damaged file makes a reader raise into one line.

    Parameters
    ----------
    path : Path
        The file that is read, to begin the line with.
    kind : str
        What it should be.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:  # astropy, h5py and numpy raise errors of many types
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"{path}: damaged or no {kind} ({reason}), expected a whole {kind} file"
        ) from error
