# mypy: disable-error-code="attr-defined, no-untyped-call, no-any-return"
"""Compiled kernels, whose machine code is cached for the next process.

`kernel` stands where `numba.njit` would, and differs in its cache, which starts a command in two
thirds of the time:

- Code is found by a fingerprint of the kernel: its bytecode, its options, the constants and kernels
  that it uses, however deep and in whichever file, and the versions of Python, numba and the
  processor. Numba compares the time of one file, and misses a callee that changed in another.
- No kernel is compiled by two processes at once: the second waits, and loads what the first made.
- Cached code needs numba's runtime and none of its declarations, which take long to import.
- No signal interrupts LLVM, which asks Python for cached code and ignores an exception there, such
  as a `KeyboardInterrupt`: the kernel would then be one that does nothing.
"""

from __future__ import annotations

import fcntl
import gc
import hashlib
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from enum import Enum
from functools import cached_property
from itertools import chain
from pathlib import Path
from types import BuiltinFunctionType, CodeType, EllipsisType, FunctionType, ModuleType, NoneType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config, sigutils
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.extending import _Intrinsic
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.types import BaseNamedTuple, Type, unliteral

from placegraph.core import cache

_SIGNALS = ("SIGINT", "SIGALRM", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
"""Signals whose handlers in Python may raise."""
_PLAIN = (bool, int, float, complex, str, bytes, NoneType, EllipsisType, np.generic, Enum, Type)


def kernel(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:  # noqa: ANN401
    """Compile `function` when it is first called, or loaded where it was compiled before.

    `options` are those of `numba.njit`; the interpreter's lock is given up unless ``nogil=False``.
    ``finite=True`` says that numbers are finite, which makes comparisons quick. Unlike ``fastmath=True``
    it leaves sums and products as they are written, so that answers do not hang on the compiler's mood.
    A small function that allocates nothing is faster with ``_nrt=False``: without counting references
    to the arrays of its arguments, which can take longer than its work.
    """
    if function is None:
        return lambda given: kernel(given, **options)
    if config.DISABLE_JIT:
        return function
    if options.pop("finite", False):
        options["fastmath"] = {"nnan", "ninf", "nsz"}
    always = {"nopython": True, "boundscheck": None, "no_cfunc_wrapper": True}
    options = always | {"nogil": True} | options
    made = Kernel(function, locals={}, targetoptions=options)
    made.enable_caching()
    return made


@contextmanager
def defer_signals() -> Iterator[None]:
    """Let handlers of signals wait until the end of it; on the main thread, where alone they run."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] | None = []
    before: dict[int, Callable[..., Any]] = {}

    def note(number: int, frame: Any) -> None:  # noqa: ANN401
        if came is None:
            before[number](number, frame)
        else:
            came.append(number)

    for number in (getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)):
        if callable(handler := signal.getsignal(number)):
            before[number] = handler
            signal.signal(number, note)
    try:
        yield
    finally:
        late, came = came, None  # from here on a handler may raise; `note` then stays, and hands on
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in late or ():
            before[number](number, None)


class _UninterruptedCompiler(Compiler):
    """Numba's compiler, with nothing of LLVM's left half owned by an exception out of the blue."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:  # noqa: ANN401  # numba's
        with defer_signals():
            return super().compile_extra(func)


class _InnerKernel(CPUDispatcher):
    """Numba's dispatcher, with our cache; of the function as other kernels have it within."""

    def __init__(self, py_func: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(py_func, pipeline_class=_UninterruptedCompiler, **options)

    def enable_caching(self) -> None:
        """Look for code in our folders, and keep it there."""
        self._cache = _Cache(self)

    def compile(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Load or compile the code for a signature; see `numba.core.dispatcher`."""
        with global_compiler_lock, _without_garbage_collection():
            try:
                return super().compile(sig)
            finally:
                self._cache.release_lock()


class Kernel(_InnerKernel):
    """A function that Python calls.

    Its arguments are unpacked from Python objects by a wrapper that can be larger than the function;
    what other kernels call is therefore another object, without one.
    """

    def __init__(self, py_func: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(py_func, **options)
        self._inner: _InnerKernel | None = None

    @property
    def inner(self) -> _InnerKernel:
        """Of which other kernels have the code."""
        if self._inner is None:
            bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
            self._inner = _InnerKernel(
                self.py_func, locals={}, targetoptions=self.targetoptions | bare
            )
            self._inner.enable_caching()
        return self._inner

    def is_cached(self, types: tuple[Any, ...]) -> bool:
        """Whether code for arguments of these types is kept, and need not be compiled."""
        return any(f.exists() for f in self._cache.files(types))

    def get_call_template(self, args: Any, kws: Any) -> Any:  # noqa: ANN401  # numba's
        """How a call from another kernel is typed; each constant is not a type of its own."""
        args = [unliteral(arg) for arg in args]
        return self.inner.get_call_template(args, {k: unliteral(arg) for k, arg in kws.items()})

    def get_overload(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Code for a call from another kernel."""
        return self.inner.get_overload(sig)

    @property
    def is_compiling(self) -> Any:  # noqa: ANN401  # numba's
        """Whether a call is a call of itself."""
        return self._compiling_counter or (self._inner is not None and self._inner.is_compiling)


class _Cache:
    """The code of one kernel: a file for each signature, in a folder named by what it is made of.

    Numba calls it under its own lock, so that one thread at a time is here.
    """

    def __init__(self, of: _InnerKernel) -> None:
        self._of = of
        self._lock: int | None = None
        function = of.py_func
        self.name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")

    @cached_property
    def _folder(self) -> str:
        processor = self._of.targetctx.codegen().magic_tuple()
        versions = (sys.version, numba.__version__, llvmlite.__version__)
        return f"{self.name}-{cache_key(versions, processor, self._of)}"

    @property
    def cache_path(self) -> str:
        return str(cache.FOLDERS.read[0] / self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        """Code that was kept; None where there is none, and then others wait until it is made."""
        with defer_signals():
            rtsys.initialize(target_context)
        found = self._load(sig, target_context)
        if found is None:
            cache.notify_listeners(self.name, done=False)
            self._acquire_lock()
            found = self._load(sig, target_context)  # by whom was told, or whom we waited for
        return found

    def files(self, sig: Any) -> list[Path]:  # noqa: ANN401  # numba's
        return [place / self._folder / _file(sig) for place in cache.FOLDERS.read]

    def save_overload(self, sig: Any, data: CompileResult) -> None:  # noqa: ANN401
        if not data.library.has_dynamic_globals:
            code = dumps(_stripped(data._reduce(), linked=not isinstance(self._of, Kernel)))  # noqa: SLF001
            cache.FOLDERS.store(f"{self._folder}/{_file(sig)}", code)
        cache.notify_listeners(self.name, done=True)

    def release_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _load(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        for file in self.files(sig):
            # cut short by a crash; or of arguments whose class has moved since
            with suppress(OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
                # numba's own form of compiled code, which is run: no more is trusted than that
                code = pickle.loads(file.read_bytes())  # noqa: S301
                with defer_signals():
                    return CompileResult._rebuild(target_context, *code)  # noqa: SLF001
        return None

    def _acquire_lock(self) -> None:
        """Wait for another process that compiles this kernel; a kernel that calls itself has it."""
        if self._lock is not None or cache.FOLDERS.write is None:
            return
        with suppress(OSError):  # a file system without locks: twice the work, the same code
            folder = cache.FOLDERS.write / self._folder
            folder.mkdir(exist_ok=True)
            self._lock = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
            fcntl.flock(self._lock, fcntl.LOCK_EX)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Keep Python from looking through what the compiler holds, an eighth of the time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _stripped(reduced: tuple[Any, ...], *, linked: bool) -> tuple[Any, ...]:
    """What numba's own cache would keep, less what takes most of the time to load.

    That is the code for linking, which only what is `linked` needs (else its names do), and
    environments without constants, for which nothing asks and each of which is an import.
    """
    (name, kind, (code, linkable)), described, *others, environments = reduced
    if not linked:
        names = (described.llvm_func_name, described.llvm_cpython_wrapper_name)
        defined = "".join(f'define void @"{name}"() {{ ret void }}\n' for name in names)
        linkable = llvmlite.binding.parse_assembly(defined).as_bitcode()
    environments = tuple(each for each in environments if each.consts)
    return ((name, kind, (code, linkable)), described, *others, environments)


def _file(sig: Any) -> str:  # noqa: ANN401  # numba's
    args, _ = sigutils.normalize_signature(sig)
    return f"{cache_key(*args)}.nbc"


def cache_key(*values: object) -> str:
    """Return a short digest of kernels, functions and constants, equal between processes.

    Numba compiles constants in: whatever a kernel names is part of its code. Comments, docstrings
    and line numbers are not.

    Raises
    ------
    TypeError
        A kernel names something of which a change could not be told.

    """
    sha = hashlib.sha256()
    for part in _parts(values, set()):
        sha.update(part.encode() + b"\n")
    return sha.hexdigest()[:16]


def _parts(value: Any, seen: set[str]) -> Iterator[str]:  # noqa: ANN401, C901, PLR0912  # any constant
    match value:
        case BaseNamedTuple():  # cached code names the class and its fields, a type's repr does not
            home = value.instance_class
            yield f"{home.__module__}.{home.__qualname__} {value.fields} {value!r}"
        case tuple() | list():
            yield f"{type(value).__name__} of {len(value)}"
            for item in value:
                yield from _parts(item, seen)
        case set() | frozenset():
            yield from sorted("\n".join(_parts(item, seen)) for item in value)
        case dict():
            yield from sorted("\n".join(_parts(pair, seen)) for pair in value.items())
        case np.ndarray():
            yield f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        case type() | BuiltinFunctionType() | np.ufunc() | ModuleType():
            yield f"{getattr(value, '__module__', '')} {value.__name__} {getattr(value, '_fields', '')}"
        case CPUDispatcher():
            yield from _parts(value.targetoptions, seen)
            yield from _parts(value.py_func, seen)
        case _Intrinsic():
            yield from _parts(value._defn, seen)  # noqa: SLF001  # the function that it was made of
        case FunctionType():
            yield from _function_parts(value, seen)
        case CodeType():
            yield from _code_parts(value, None, seen)
        case _ if isinstance(value, _PLAIN):
            yield f"{type(value).__name__} {value!r}"
        case _:
            raise TypeError(
                f"A kernel uses {value!r}, of which compiled code cannot tell a change."
            )


def _function_parts(function: FunctionType, seen: set[str]) -> Iterator[str]:
    name = f"{function.__module__}.{function.__qualname__}"
    yield name
    if name in seen:
        return
    seen.add(name)
    code = function.__code__
    yield from _code_parts(code, function.__doc__, seen)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    yield from _parts((function.__defaults__, function.__kwdefaults__, cells), seen)
    names = list(dict.fromkeys(_names(code)))
    for key in filter(function.__globals__.__contains__, names):
        value = function.__globals__[key]
        yield key
        yield from _parts(value, seen)
        if isinstance(value, ModuleType) and value.__name__.startswith("placegraph"):
            for member in names:
                if hasattr(value, member):
                    yield from _parts(getattr(value, member), seen)


def _code_parts(code: CodeType, doc: str | None, seen: set[str]) -> Iterator[str]:
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_flags))
    for const in code.co_consts:
        if const is None or const != doc:
            yield from _parts(const, seen)


def _names(code: CodeType) -> Iterator[str]:
    inner = (const for const in code.co_consts if isinstance(const, CodeType))
    yield from chain(code.co_names, *map(_names, inner))
