"""One object in one sealed HDF5 file: what is handed over beside chains."""

import io
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np

from bayesfred.io import atomic
from bayesfred.io.hdf5_checks import SCHEMA, open_checked, seal
from bayesfred.io.serialize import read, write

__all__ = ["FORMAT", "read_sealed", "write_sealed"]

# The oldest format that keeps small files small; every HDF5 since 1.10 (2016) reads it.
FORMAT = ("v110", "v110")
NAME = "object"

T = TypeVar("T")


def write_sealed(path: Path, kind: bytes, value: Any) -> None:
    """Write an object of a registered class as a file of a kind.

    Parameters
    ----------
    path : Path
        Replaced if it exists.
    kind : bytes
        One of `hdf5_checks.READABLE`.
    value : object

    Raises
    ------
    InputError
        If the file cannot be written, or cannot hold such an object.
    """
    content = io.BytesIO()
    with h5py.File(content, "w", libver=FORMAT) as file:
        file.attrs.update(kind=np.bytes_(kind), schema=SCHEMA)
        write(file.create_group(NAME), value)
    with content.getbuffer() as written:
        atomic.replace(path, written, seal(written))


def read_sealed(path: Path, kind: bytes, expected: type[T]) -> T:
    """Read the object of a file that `write_sealed` wrote.

    Parameters
    ----------
    path : Path
    kind : bytes
    expected : type

    Returns
    -------
    object

    Raises
    ------
    InputError
        If the file is missing, of another kind, or was changed or damaged since.
    """
    with open_checked(path, kind) as file:
        return read(file[NAME], expected)
