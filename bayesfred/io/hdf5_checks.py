"""What a chain file, or a calibration, must be before anything is read from it.

Such a file ends with its seal, a line with the SHA-256 of everything before it; HDF5 ignores what
follows its own end. So a bit that flipped, a cut or an edit shows before HDF5 sees the file. A file
made to do harm can be sealed too. So every link, attribute and array is checked next, before any of
them is read: they must be plain numbers and texts that lie in the file itself, each once and in
full.
"""

import hashlib
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import h5py
from h5py import h5a, h5d, h5l, h5o, h5t, h5z

from bayesfred.errors import InputError

KIND = b"bayesfred chain"
CALIBRATION = b"bayesfred calibration"
SCHEMA = 10
READABLE = {  # schemas by kind; not all that a chain may hold, see `sampling/chainfile`
    KIND: (3, 4, 5, 6, 7, 8, 9, 10),
    CALIBRATION: (7, 8, 9, 10),
}
COMMANDS = {KIND: "fit", CALIBRATION: "calibration"}  # which write them
SEAL = "\nbayesfred sha256 {}\n"
SEAL_SIZE = len(SEAL.format("0" * 64))

# More than any chain file has, and few enough to check in an instant.
MOST_OBJECTS = 10_000  # attributes among them
MOST_ATTRIBUTES = 100  # of one object
LARGEST_ATTRIBUTE = 2**16  # bytes

REMEDY = "restore a copy, or run again"


def seal(content: memoryview | bytes) -> bytes:
    """The line that ends a file of this content."""
    return SEAL.format(hashlib.sha256(content).hexdigest()).encode()


@contextmanager
def open_checked(path: Path, kind: bytes = KIND) -> Iterator[h5py.File]:
    """A file to read from, as of `open_with_digest`."""
    with open_with_digest(path, kind) as (file, _):
        yield file


@contextmanager
def open_with_digest(path: Path, kind: bytes = KIND) -> Iterator[tuple[h5py.File, str]]:
    """A file to read from, once it has passed; whatever is wrong with it becomes one line.

    Parameters
    ----------
    path : Path
    kind : bytes
        What it must be.

    Yields
    ------
    file : h5py.File
    digest : str
        The SHA-256 of its content, which is the one in its seal.

    Raises
    ------
    InputError
        If the file is missing, of another kind or schema, was changed or damaged since it was
        written, or holds anything but plain arrays and attributes; and if what is read from
        it within the `with` block makes no sense.
    """
    if not path.is_file():
        raise InputError(
            f"{path}: no such file, expected a {_name(kind)} written by `bayesfred "
            f"{COMMANDS[kind]}`: check the path"
        )
    try:
        with open(path, "rb") as stream:
            size, content = _check_seal(stream, kind)
            # the very file whose seal was checked, even if another is renamed over it meanwhile
            with h5py.File(stream, "r") as file:
                _check_attributes("", file.id)
                _check_schema(kind, file.attrs.get("kind"), file.attrs.get("schema"))
                _check_tree(file.id, size)
                yield file, content
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        OSError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        reason = " ".join(str(error).split())[:400]
        raise InputError(
            f"{path}: damaged ({reason}), expected a whole {_name(kind)} file: {REMEDY}"
        ) from None


def _name(kind: bytes) -> str:
    return kind.decode().removeprefix("bayesfred ")


def _check_seal(stream: BinaryIO, kind: bytes) -> tuple[int, str]:
    """Size and SHA-256 of a file that is what its seal says; the stream is back at its start."""
    size = os.fstat(stream.fileno()).st_size
    digest, left = hashlib.sha256(), size - SEAL_SIZE
    while left > 0:
        block = stream.read(min(left, 2**20))
        digest.update(block)
        left -= len(block) or left
    found = stream.read()
    if not found.startswith(SEAL.split("{", maxsplit=1)[0].encode()):
        raise InputError(
            f"got no seal at the end, expected a whole {_name(kind)} written by `bayesfred "
            f"{COMMANDS[kind]}`: {REMEDY}"
        )
    if found != SEAL.format(digest.hexdigest()).encode():
        raise InputError(
            "got another content than its seal says, expected it as it was written: damaged or "
            f"changed: {REMEDY}"
        )
    stream.seek(0)
    return size, digest.hexdigest()


def _check_schema(expected: bytes, kind: Any, schema: Any) -> None:
    if kind == expected and schema in READABLE[expected]:
        return
    later = bool(kind == expected and schema > SCHEMA)
    remedy = "read it with the version that wrote it" if later else "remake it with this version"
    got = (
        f"{kind.decode(errors='replace') if isinstance(kind, bytes) else kind!r} of "
        f"{'newer ' * later}schema {schema}"
    )
    raise InputError(f"got {got}, expected {expected.decode()} of schema {SCHEMA}: {remedy}")


def _check_tree(root: Any, size: int) -> None:
    """Look at everything that can be reached from the root of a file of `size` bytes."""
    seen, number, held, todo = set(), 0, 0, [("", root)]
    while todo:
        name, node = todo.pop()
        address = h5o.get_info(node).addr
        if address in seen:
            raise InputError(
                f"{name}: got a second link to one object, expected each once: {REMEDY}"
            )
        seen.add(address)
        number += 1 + _check_attributes(name, node)
        if isinstance(node, h5d.DatasetID):
            held += _check_dataset(name, node)
            if held > size:
                raise InputError(
                    f"{name}: got arrays larger than the file, expected them to lie in it: {REMEDY}"
                )
            continue
        if number + len(todo) + node.get_num_objs() > MOST_OBJECTS:
            raise InputError(
                f"got more than {MOST_OBJECTS} objects, expected those of a chain: {REMEDY}"
            )
        for key in node:
            child = f"{name}/{key.decode(errors='replace')}"
            if node.links.get_info(key).type != h5l.TYPE_HARD:
                raise InputError(
                    f"{child}: got a soft or external link, expected what it leads to: {REMEDY}"
                )
            item = h5o.open(node, key)
            if not isinstance(item, h5d.DatasetID | h5py.h5g.GroupID):
                raise InputError(
                    f"{child}: got neither a group nor an array, expected one of them: {REMEDY}"
                )
            todo.append((child, item))


def _check_attributes(name: str, node: Any) -> int:
    """How many attributes there are, all of them small."""
    number = int(h5a.get_num_attrs(node))
    if number > MOST_ATTRIBUTES:
        raise InputError(
            f"{name or '/'}: got {number} attributes, expected at most {MOST_ATTRIBUTES}: {REMEDY}"
        )
    for k in range(number):
        item = h5a.open(node, index=k)
        label, kind = f"{name}@{item.name.decode(errors='replace')}", item.get_type()
        # emcee wants this one as a text without a fixed length. Nothing here reads it.
        if (
            label.endswith("@random_state_0")
            and item.shape == ()
            and kind.get_class() == h5t.STRING
        ):
            continue
        _check_type(label, kind, texts=True)
        if math.prod(item.shape or ()) * kind.get_size() > LARGEST_ATTRIBUTE:
            raise InputError(
                f"{label}: got an attribute of shape {item.shape}, expected a small one: {REMEDY}"
            )
    return number


def _check_dataset(name: str, node: Any) -> int:
    """Bytes of an array that lies in the file in full."""
    plist, kind = node.get_create_plist(), node.get_type()
    _check_type(name, kind, texts=False)
    if plist.get_external_count():
        raise InputError(f"{name}: got an array in another file, expected it in this one: {REMEDY}")
    if plist.get_layout() == h5d.VIRTUAL:
        raise InputError(f"{name}: got a virtual array, expected its numbers: {REMEDY}")
    if {plist.get_filter(k)[0] for k in range(plist.get_nfilters())} - {h5z.FILTER_FLETCHER32}:
        raise InputError(f"{name}: got a compressed array, expected plain numbers: {REMEDY}")
    stored = int(node.get_storage_size())
    chunk = math.prod(plist.get_chunk()) if plist.get_layout() == h5d.CHUNKED else 0
    if max(math.prod(node.shape), chunk) * kind.get_size() > stored:
        raise InputError(
            f"{name}: got shape {node.shape} and {stored} bytes, expected an array that the file "
            f"holds: {REMEDY}"
        )
    return stored


def _check_type(name: str, kind: Any, *, texts: bool) -> None:
    """Refuse all types but numbers of at most 8 bytes, booleans (enumerations) and short texts."""
    of, size = kind.get_class(), kind.get_size()
    plain = of in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM) and size <= 8
    text = texts and of == h5t.STRING and not kind.is_variable_str()
    if not (plain or text):
        raise InputError(
            f"{name}: got an unknown type of {size} bytes, expected "
            f"numbers{' or a text' * texts}: {REMEDY}"
        )
