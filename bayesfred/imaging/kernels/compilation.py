"""How functions are compiled: numba, with a cache that no edit of any kernel can leave behind.

numba keys what it compiled on the source file of the function alone, but machine code contains the
functions of other modules that it calls. Here the key is a hash of every module of the package with
compiled code, and of the modules from outside that define the named tuples among a function's
arguments: the compiled halves of other PSFs and noise models.
"""

import hashlib
import secrets
import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any

import numba as nb
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.types import BaseNamedTuple, BaseTuple  # type: ignore[attr-defined]

# Folders of the package with compiled code.
FOLDERS = ("imaging/kernels", "imaging/psf", "model/kernels", "model/noise")


@cache
def source_hash() -> str:
    """SHA-256 over the package's modules with compiled code."""
    digest = hashlib.sha256()
    for folder in FOLDERS:
        files = resources.files("bayesfred").joinpath(folder).iterdir()
        for file in sorted(files, key=lambda file: file.name):
            if file.name.endswith(".py"):
                digest.update(f"{folder}/{file.name}\n".encode() + file.read_bytes())
    return digest.hexdigest()


@cache
def _module_hash(module: str) -> str:
    """SHA-256 of a module's source.

    Without a file, as in a notebook, it is a number that no other process draws.
    """
    path = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(path).read_bytes()).hexdigest() if path else secrets.token_hex()


def _modules(kind: Any) -> Iterator[str]:
    """Modules outside the package that define the named tuples in an argument's type."""
    if isinstance(kind, BaseNamedTuple):
        module = kind.instance_class.__module__
        if module.split(".")[0] != __name__.split(".")[0]:
            yield module
    if isinstance(kind, BaseTuple):
        for part in kind:
            yield from _modules(part)


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, keyed on all sources that its machine code may come from."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = IndexDataCacheFile(
            self._cache_path, self._impl.filename_base, source_hash()
        )

    def _index_key(self, sig: Any, codegen: Any) -> tuple[Any, ...]:
        outside = sorted({module for kind in sig for module in _modules(kind)})
        return (
            *super()._index_key(sig, codegen),
            *((module, _module_hash(module)) for module in outside),
        )


def entry(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and keep its machine code on disk.

    The options are those of `numba.njit`.
    """
    return partial(_compiled, nogil=True, **options)


def inner(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that only compiled code calls; Python must not, it would crash.

    Wrappers for other callers would add a seventh to the time of compilation.
    """
    return partial(_compiled, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)


def _compiled(function: Callable[..., Any], **options: Any) -> Any:
    dispatcher = nb.njit(**options)(function)
    dispatcher._cache = _Cache(function)
    return dispatcher
