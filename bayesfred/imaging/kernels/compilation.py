"""How functions are compiled: numba, with a cache that no edit of any kernel can leave behind.

numba keys what it compiled on the source file of the function alone, but machine code contains the
functions of other modules that it calls. Here the key is a hash of every module of the package with
compiled code, and of the modules from outside that define the named tuples among a function's
arguments: the compiled halves of other PSFs and noise models.
"""

import gc
import hashlib
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import filelock
import numba as nb
from llvmlite import binding
from numba.core import event
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, Flags
from numba.core.types import BaseNamedTuple, BaseTuple  # type: ignore[attr-defined]

PATIENCE = 60.0  # seconds for which another process may compile a function
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
def _module_hash(module: str) -> str | None:
    """SHA-256 of a module's source; None without a file, as in a notebook."""
    path = getattr(sys.modules.get(module), "__file__", None)
    return hashlib.sha256(Path(path).read_bytes()).hexdigest() if path else None


def _modules(kind: Any) -> Iterator[str]:
    """Modules outside the package that define the named tuples in an argument's type."""
    if isinstance(kind, BaseNamedTuple):
        module = kind.instance_class.__module__
        if module.split(".")[0] != __name__.split(".")[0]:
            yield module
    if isinstance(kind, BaseTuple):
        for part in kind:
            yield from _modules(part)


class _Call(NamedTuple):
    """A shared function that machine code calls."""

    module: str
    function: str
    types: Any  # of its arguments
    symbol: str  # of its machine code

    def is_there(self) -> bool:
        """Read or compile the function; whether it is the machine code that is called."""
        dispatcher = getattr(sys.modules[self.module], self.function)
        dispatcher.compile(self.types)
        found: str = dispatcher.overloads[self.types].fndesc.llvm_func_name
        return found == self.symbol


def _calls(library: Any) -> set[_Call]:
    """The shared functions that a library of machine code calls."""
    if not hasattr(library, "calls"):
        library.calls = set().union(*map(_calls, library._linking_libraries))
    calls: set[_Call] = library.calls
    return calls


class _CompileResults(CompileResultCacheImpl):  # type: ignore[misc]
    """Compiled functions as they are kept on disk: with the shared functions that they call."""

    def reduce(self, cres: Any) -> Any:
        return _calls(cres.library), super().reduce(cres)

    def rebuild(self, target_context: Any, payload: Any) -> Any:
        """Read a function; None where what it calls has been compiled again since."""
        calls, function = payload
        if not all(call.is_there() for call in calls):
            return None
        cres = super().rebuild(target_context, function)
        cres.library.calls = calls
        return cres


class _Index(IndexDataCacheFile):  # type: ignore[misc]
    """The list of one function's machine codes."""

    def _load_index(self) -> dict[Any, Any]:
        try:
            return dict(super()._load_index())
        except Exception:  # it names classes of another version, which are gone
            return {}


class _Cache(FunctionCache):  # type: ignore[misc]
    """numba's cache of one function, keyed on all sources that its machine code may come from.

    Code for families from outside the package has an index of its own: without their modules it
    cannot be read. Where such a module has no file there is nothing to key on, so nothing is kept.
    Of processes that need the same code at the same time one compiles, and the others wait.
    """

    _impl_class = _CompileResults

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._function = function
        self._compiling: dict[Any, filelock.BaseFileLock] = {}

    def _select(self, sig: Any) -> bool:
        """Choose the index for these argument types; False where nothing is kept."""
        outside = sorted({module for kind in sig for module in _modules(kind)})
        hashes = [_module_hash(module) for module in outside]
        name = self._impl.filename_base
        if outside:
            text = "".join(
                f"{module} {each}\n" for module, each in zip(outside, hashes, strict=True)
            )
            name += f"-{hashlib.sha256(text.encode()).hexdigest()[:16]}"
        self._cache_file = _Index(self._cache_path, name, source_hash())
        return None not in hashes

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        """Find machine code, or be the one process that compiles it, if others do not take long."""
        if not self._select(sig):
            return None
        found = super()._load_overload(sig, target_context)
        if found is None and sig not in self._compiling:
            lock = filelock.FileLock(self._lock_path(sig), PATIENCE)
            # a timeout is an OSError; nobody waits where nothing can be written or locked
            with suppress(OSError, NotImplementedError):
                lock.acquire(poll_interval=0.02)
            self._compiling[sig] = lock
            found = super()._load_overload(sig, target_context)
            if found is not None:
                self._release(sig)
        if found is not None:
            self._share(sig, found)
        return found

    def _save_overload(self, sig: Any, data: Any) -> None:
        # what was linked in raises errors by these, and no machine code of its own has set them
        for env in data._find_referenced_environments():
            data.library.codegen.set_env(env.env_name, env)
        try:
            if self._select(sig):
                super()._save_overload(sig, data)
        finally:
            self._release(sig)
            self._share(sig, data)

    def _share(self, sig: Any, cres: Any) -> None:
        """Give the callers of a shared function its name in place of its code."""
        library, name = cres.library, cres.fndesc.llvm_func_name
        library.calls = {_Call(self._function.__module__, self._function.__name__, sig, name)}
        library._shared_module = binding.parse_assembly("")

    def _lock_path(self, sig: Any) -> Path:
        name = f"{self._impl.filename_base} {sig}".encode()
        return Path(self._cache_path) / f"{hashlib.sha256(name).hexdigest()[:32]}.lock"

    def _release(self, sig: Any) -> None:
        if lock := self._compiling.pop(sig, None):
            lock.release()
            with suppress(OSError):
                Path(lock.lock_file).unlink(missing_ok=True)


class _Part(JITCodeLibrary):  # type: ignore[misc]
    """A library that is only linked into others, and so is never turned into machine code."""

    @property
    def codegen(self) -> "_Part":
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Set nothing: the callers' machine code has it, see `_Cache`."""

    def get_pointer_to_function(self, name: str) -> int:
        """Optimise the library; the pointer is null, as that of a wrapper that is missing."""
        self._ensure_finalized()
        return 0

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True


class _Flags(Flags):  # type: ignore[misc]
    """Compiler flags, equal where the functions of numba that are called inherit the same options.

    They are part of the key under which numba keeps its code of every operator. With its own flags
    the code is compiled again for callers that differ in other options. Their hash is a constant,
    and comparing them takes a tenth of all time.
    """

    def _inherited(self) -> tuple[object, ...]:
        return self.nrt, frozenset(self.fastmath.flags), self.error_model, self.forceinline

    def __hash__(self) -> int:
        return hash(self._inherited())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Flags) and self._inherited() == other._inherited()


class _Compiler(Compiler):  # type: ignore[misc]
    """numba's compiler with flags of our own."""

    def __init__(self, typing: Any, target: Any, library: Any, *others: Any) -> None:
        args, return_type, flags, types = others
        super().__init__(typing, target, library, args, return_type, _Flags(flags), types)


class _PartCompiler(_Compiler):
    """Compiles what only compiled code calls, and links it into that of its callers."""

    def define_pipelines(self) -> Any:
        state = self.state
        state.library = _Part(state.targetctx.codegen(), state.func_id.func_qualname)
        return super().define_pipelines()


# Options of what is compiled into its callers. Wrappers for other callers would take as long to
# compile as a small function itself.
INLINED: dict[str, Any] = {
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
    "pipeline_class": _PartCompiler,
}


def entry(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that Python calls, and keep its machine code on disk.

    Compiled code may call it too, as it does what is `shared`. The options are those of
    `numba.njit`.
    """
    return partial(_compiled, is_shared=True, nogil=True, no_cfunc_wrapper=True, **options)


def inner(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function that only compiled code calls; Python must not, it would crash.

    Its code is kept on disk only within that of its callers.
    """
    return partial(_compiled, **INLINED, **options)


def leaf(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function as `inner` does, but without counting references to arrays.

    For loops over pixels, which neither make arrays nor return any, and call no function that does:
    the counts would cost more than a short row.
    """
    return inner(_nrt=False, **options)


def shared(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function as `inner` does, but once for all its callers.

    For what is called once a source, or less often: a call costs up to 0.1 microseconds.
    """
    return partial(
        _compiled, is_shared=True, no_cpython_wrapper=True, no_cfunc_wrapper=True, **options
    )


def _compiled(function: Callable[..., Any], is_shared: bool = False, **options: Any) -> Any:
    # a function without the options would take them from the first that calls it
    ours = {"_nrt": True, "error_model": "numpy", "pipeline_class": _Compiler}
    dispatcher = nb.njit(**ours | options)(function)
    if is_shared:
        dispatcher._cache = _Cache(function)
    return dispatcher


class _WithoutCollector(event.Listener):  # type: ignore[misc]
    """Switches Python's garbage collector off while a function is compiled.

    The compiler makes millions of objects that live until its end: looking through them again and
    again takes a sixth of its time.
    """

    def __init__(self) -> None:
        self._depth, self._was_on = 0, False

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._was_on = gc.isenabled()
            gc.disable()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0 and self._was_on:
            gc.enable()


event.register("numba:compile", _WithoutCollector())  # which one thread at a time compiles under
