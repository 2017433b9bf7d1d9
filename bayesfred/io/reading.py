"""What every reader of files needs: that the file is there, and one line where it is damaged."""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from bayesfred.errors import InputError

__all__ = ["readable", "require_file"]


def require_file(path: Path) -> None:
    """Refuse what is no file, in one line."""
    if not os.path.exists(path):  # `Path.exists` raises for some paths that no file can have
        raise InputError(f"{path}: no such file, expected one to read; check the path")
    if not path.is_file():
        raise InputError(f"{path}: not a file, expected one to read; check the path")


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
