"""Frozen dataclasses in HDF5 groups: the one way in which the package's objects are stored.

A class that is decorated with :func:`serializable` is stored by :func:`write` and made again by
:func:`read`, with nothing to add to the class. A field becomes

=========================================  =====================================================
number, boolean, text, tuple of texts      an attribute
None                                       an attribute without a value
array, tuple of numbers or of tuples       a dataset with a checksum; a tuple is marked as one
registered object                          a group with the attribute `kind`
mapping of str to any of these             a group of kind `mapping`, with its `keys` in order
frozen distribution of `scipy.stats`       a group of kind `distribution`: `family`, `parameters`
=========================================  =====================================================

A field declared with `field(metadata={"stored": False})` is not stored: its constructor supplies
it. One with `metadata={"since": 5}` takes its default from files of a schema before 5. Nothing is
pickled, and reading makes objects of registered classes only, through their constructors, which
check what they are given.
"""

import inspect
import math
import re
import reprlib
import types
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, partial
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import h5py
import numpy as np
from scipy import stats

from bayesfred.errors import InputError
from bayesfred.io.hdf5_checks import REMEDY

__all__ = ["kinds", "read", "serializable", "write", "write_array"]

T = TypeVar("T")

KEY = re.compile(r"\w[\w-]*")  # of a mapping, or several joined by dots

LARGEST_CHUNK = 2**24  # bytes
DEEPEST = 50  # groups in one another
TAGS = ("kind", "keys")  # names that no field has
TUPLE, MAPPING, DISTRIBUTION = "tuple", "mapping", "distribution"

_DTYPES = {"f": np.float64, "i": np.int64, "u": np.int64, "b": np.bool_}
_classes: dict[str, type] = {}


def serializable(kind: str) -> Callable[[type[T]], type[T]]:
    """Register a frozen dataclass, so that files can hold its instances.

    Parameters
    ----------
    kind : str
        What files call it. A class that a section of the run file can name is called by the section
        and the name, `psf.moffat` for `kind = "moffat"` in `[psf]`.

    Returns
    -------
    callable
        The decorator; it goes above `@dataclass` and returns the class itself.

    Raises
    ------
    TypeError
        The class is no dataclass, a field is called `kind` or `keys`, or another class is
        registered under this kind.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> @serializable("example.star")
    ... @dataclass(frozen=True)
    ... class Star:
    ...     name: str
    ...     magnitude: float | None = None
    >>> with h5py.File("star", "w", driver="core", backing_store=False) as file:
    ...     write(file, Star("Vega"))
    ...     read(file, Star)
    Star(name='Vega', magnitude=None)
    """

    def register(cls: type[T]) -> type[T]:
        if not is_dataclass(cls) or any(field.name in TAGS for field in fields(cls)):
            raise TypeError(f"{cls.__name__}: expected a dataclass without fields {TAGS}")
        known = _classes.get(kind, cls)
        if kind in (TUPLE, MAPPING, DISTRIBUTION) or known.__qualname__ != cls.__qualname__:
            raise TypeError(f"{cls.__name__}: the kind {kind!r} is taken, expected another")
        _classes[kind] = cls
        return cls

    return register


def kinds(section: str) -> dict[str, type]:
    """The registered classes that a section of the run file can name, by that name.

    Parameters
    ----------
    section : str
        Such as `psf`.

    Returns
    -------
    dict of str to type, in alphabetical order
    """
    start = f"{section}."
    return {k.removeprefix(start): _classes[k] for k in sorted(_classes) if k.startswith(start)}


def write(group: Any, value: Any) -> None:
    """Store an object in an HDF5 group.

    Parameters
    ----------
    group : h5py.Group
        An empty group.
    value : object
        An instance of a registered class.

    Raises
    ------
    InputError
        The object, or a field of it, is of a class that is not registered.
    """
    kind = next((kind for kind, cls in _classes.items() if cls is type(value)), None)
    if kind is None:
        raise InputError(
            f"{type(value).__name__}: got an object that files cannot hold, expected a class "
            "decorated with @serializable"
        )
    group.attrs["kind"] = _text(kind)
    for name in _stored(type(value)):
        _put(group, name, getattr(value, name))


def write_array(group: Any, name: str, values: np.ndarray[Any, Any]) -> Any:
    """Store an array in an HDF5 group, with a checksum, in chunks of equal size.

    Returns
    -------
    h5py.Dataset
    """
    if values.ndim == 0 or values.size == 0:
        return group.create_dataset(name, data=values)
    # equal parts, so that none is filled up
    rows = math.ceil(len(values) / math.ceil(values.nbytes / LARGEST_CHUNK))
    chunks = (rows, *values.shape[1:])
    return group.create_dataset(name, data=values, chunks=chunks, fletcher32=True)


def read(group: Any, expected: type[T]) -> T:
    """Make the object that a group holds.

    Parameters
    ----------
    group : h5py.Group
        Where `write` stored it.
    expected : type
        What it must be an instance of.

    Returns
    -------
    object

    Raises
    ------
    InputError
        The group holds something else, a field is missing or of another type, the kind is not
        registered, or the constructor refuses the values.
    """
    value = _get_group(group)
    if not isinstance(value, expected):
        raise _wrong(group, f"got {type(value).__name__}, expected {expected.__name__}")
    return value


def _stored(cls: type) -> list[str]:
    """The names of the fields that files hold."""
    return [f.name for f in fields(cls) if f.init and f.metadata.get("stored", True)]


def _text(value: str) -> np.bytes_:
    """A text of a fixed length."""
    return np.bytes_(value.encode())


def _put(group: Any, name: str, value: Any) -> None:
    """Store one field."""
    if value is None:
        group.attrs[name] = h5py.Empty("f8")
    elif isinstance(value, str):
        group.attrs[name] = _text(value)
    elif isinstance(value, bool | np.bool_):
        group.attrs[name] = bool(value)
    elif isinstance(value, int | np.integer):
        group.attrs[name] = np.int64(value)
    elif isinstance(value, float | np.floating):
        group.attrs[name] = np.float64(value)
    elif isinstance(value, tuple) and value and all(isinstance(item, str) for item in value):
        group.attrs[name] = np.array([_text(item) for item in value])
    elif isinstance(value, tuple):
        _put_array(group, name, value).attrs["kind"] = _text(TUPLE)
    elif isinstance(value, np.ndarray):
        _put_array(group, name, value)
    elif isinstance(value, Mapping):
        _put_mapping(group.create_group(name), value)
    elif isinstance(getattr(value, "dist", None), stats.rv_continuous):
        _put_distribution(group.create_group(name), value)
    else:
        write(group.create_group(name), value)


def _put_array(group: Any, name: str, value: Any) -> Any:
    try:
        array = np.asarray(value)
        if isinstance(value, tuple) and not value:  # which numpy takes for floats
            array = np.zeros(0, np.int64)
        return write_array(group, name, array.astype(_DTYPES[array.dtype.kind]))
    except (KeyError, ValueError):  # ragged, or neither numbers nor booleans
        raise InputError(f"{name}: got values that files cannot hold, expected numbers") from None


def _put_mapping(group: Any, value: Mapping[str, Any]) -> None:
    for key in value:
        if key in TAGS or not all(KEY.fullmatch(part) for part in str(key).split(".")):
            raise InputError(
                f"{key}: got a key that files cannot hold, expected letters, digits, "
                "underscores and hyphens"
            )
    group.attrs["kind"] = _text(MAPPING)
    group.attrs["keys"] = np.array([_text(key) for key in value], dtype="S")
    for key, item in value.items():
        _put(group, key, item)


def _put_distribution(group: Any, value: Any) -> None:
    family = value.dist.name
    if len({type(getattr(stats, family, None)), type(value.dist)}) > 1:
        raise InputError(f"{family}: got a distribution of your own, expected one of scipy.stats")
    shapes, loc, scale = value.dist._parse_args(*value.args, **value.kwds)
    group.attrs["kind"] = _text(DISTRIBUTION)
    group.attrs["family"] = _text(family)
    group.attrs["parameters"] = np.array([*shapes, loc, scale], dtype=np.float64)


def _wrong(group: Any, what: str) -> InputError:
    return InputError(
        f"damaged ({group.name[-200:]}: {what}), expected it as it was written: {REMEDY}"
    )


def _get_group(group: Any) -> Any:
    """The object, mapping or distribution that a group holds."""
    if group.name.count("/") > DEEPEST:
        raise _wrong(group, "got groups nested too deeply, expected an object")
    kind = _get(group, "kind") if "kind" in group.attrs else None
    if not isinstance(kind, str):
        raise _wrong(group, "got a group without a kind, expected one that says what it holds")
    if kind == MAPPING:
        keys = _get(group, "keys")
        if not isinstance(keys, tuple) or not all(isinstance(key, str) for key in keys):
            raise _wrong(group, "got a mapping without keys, expected texts")
        return {key: _get(group, key) for key in keys}
    if kind == DISTRIBUTION:
        return _get_distribution(group)
    cls = _classes.get(kind)
    if cls is None:
        known = ", ".join(sorted(_classes))
        raise InputError(
            f"{group.name}: got the unknown kind {kind!r}, expected one of {known}: import the "
            "module that defines it, or restore a copy"
        )
    held = {*group.attrs, *group}
    later = {f.name for f in fields(cls) if "since" in f.metadata} - held  # they have a default
    values = {name: _get(group, name) for name in _stored(cls) if name not in later}
    for name, hint in _hints(cls).items():
        if name in values and not _fits(values[name], hint):
            wanted = getattr(hint, "__name__", str(hint))
            raise _wrong(group, f"{name}: got {reprlib.repr(values[name])}, expected {wanted}")
    return _made(group, cls, values)


def _made(group: Any, make: Callable[..., Any], values: Mapping[str, Any]) -> Any:
    """What a constructor makes of stored values; whatever it raises becomes one line."""
    try:
        return make(**values)
    except (InputError, RecursionError):
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise _wrong(group, f"got values of which nothing can be made ({reason})") from None


def _get(group: Any, name: str) -> Any:
    """The value of one field."""
    try:
        if name in group.attrs:
            return _get_attribute(group.attrs[name])
        node = group[name]
    except (InputError, RecursionError):
        raise
    except Exception as error:  # h5py raises errors of many types
        reason = " ".join(str(error).split())[:200]
        raise _wrong(group, f"{name}: no value ({reason}), expected one") from None
    if isinstance(node, h5py.Group):
        return _get_group(node)
    array = np.asarray(node[()])
    if array.dtype.kind not in _DTYPES:
        raise _wrong(group, f"{name}: got values of type {array.dtype}, expected numbers")
    array = array.astype(_DTYPES[array.dtype.kind])
    return _nested(array.tolist()) if "kind" in node.attrs else array


def _get_attribute(value: Any) -> Any:
    if isinstance(value, h5py.Empty):
        return None
    array = np.asarray(value)
    texts = array.dtype.kind == "S"
    if texts:
        array = np.char.decode(array, "utf-8")
    return array.item() if array.ndim == 0 else tuple(array.tolist()) if texts else array


def _nested(value: Any) -> Any:
    """Lists in lists as tuples in tuples."""
    return tuple(map(_nested, value)) if isinstance(value, list) else value


def _get_distribution(group: Any) -> Any:
    family, parameters = _get(group, "family"), _get(group, "parameters")
    distribution = getattr(stats, family, None) if isinstance(family, str) else None
    if not isinstance(distribution, stats.rv_continuous):
        raise _wrong(group, f"got unknown family {family!r}, expected a continuous distribution")
    numbers = isinstance(parameters, np.ndarray) and parameters.dtype.kind == "f"
    if not (numbers and parameters.ndim == 1 < parameters.size and np.isfinite(parameters).all()):
        raise _wrong(
            group, f"got parameters {reprlib.repr(parameters)}, expected shapes, loc and scale"
        )
    *shapes, loc, scale = map(float, parameters)
    frozen = _made(group, partial(distribution, *shapes), {"loc": loc, "scale": scale})
    if np.isnan(frozen.support()).any():
        raise _wrong(group, f"got parameters {parameters}, expected valid ones of {family}")
    return frozen


@cache
def _hints(cls: type) -> dict[str, Any]:
    """The annotations of a class; none where names in them cannot be found, as of local classes."""
    try:
        return get_type_hints(cls)
    except NameError:
        return {}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a stored value is of an annotated type, as far as an annotation can be checked."""
    origin, arms = get_origin(hint), get_args(hint)
    if origin in (Union, types.UnionType):
        return any(_fits(value, arm) for arm in arms)
    if origin is Literal:
        return any(type(value) is type(arm) and value == arm for arm in arms)
    if isinstance(value, Mapping) and len(arms) == 2:
        return issubclass(origin, Mapping) and all(_fits(v, arms[1]) for v in value.values())
    if hint is float or hint is int:
        return type(value) is int or type(value) is hint
    known = origin or hint
    if getattr(known, "_is_protocol", False):
        names = [name for name in {**vars(known), **known.__annotations__} if name[0] != "_"]
        return all(inspect.getattr_static(value, name, None) is not None for name in names)
    return known is Any or not isinstance(known, type) or isinstance(value, known)
