# mypy: disable-error-code="attr-defined, no-untyped-call, no-any-return, method-assign"
"""Compiled kernels, whose machine code is cached for later processes.

`kernel` replaces `numba.njit`. Only its cache differs; it starts a command in two thirds of the time:

- The cache key covers the kernel's bytecode, its options, the constants and kernels that it uses in
  any file, and the versions of Python, numba and the processor. Numba compares the time of one file,
  and misses a callee that changed in another.
- No kernel is compiled by two processes at once: the second waits, and loads the code of the first.
- Cached code needs numba's runtime, but not its declarations, which take long to import.
- LLVM optimizes and translates only the kernels that Python calls, each with all that it calls; numba
  does so for every function on the way.
- Signals wait while LLVM asks Python for cached code: it ignores exceptions there, such as a
  `KeyboardInterrupt`, and the kernel would do nothing.
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
from llvmlite.binding import Linkage
from numba.core import config, sigutils
from numba.core.codegen import CodeLibrary, JITCodeLibrary
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.cpu import CPUContext
from numba.core.environment import lookup_environment
from numba.core.extending import _Intrinsic
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.types import BaseNamedTuple, Type, unliteral

from placegraph.core import cache

_FORMAT = 2
"""Version of the files of the cache."""
_SIGNALS = ("SIGINT", "SIGALRM", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
"""Signals whose handlers in Python may raise."""
_PLAIN = (bool, int, float, complex, str, bytes, NoneType, EllipsisType, np.generic, Enum, Type)


def kernel(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:  # noqa: ANN401
    """Compile `function` at its first call, or load its cached code.

    `options` are those of `numba.njit`, with ``nogil=True`` as the default. ``finite=True`` promises
    finite numbers, which makes comparisons quick; unlike ``fastmath=True`` it keeps the order of sums,
    so that answers do not depend on the compiler. ``_nrt=False`` makes a small function that allocates
    nothing faster: references to its array arguments are not counted. ``inline=True`` does so, too, and
    LLVM puts the function into its callers; numba's own inlining takes longer to compile.
    """
    if function is None:
        return lambda given: kernel(given, **options)
    if config.DISABLE_JIT:
        return function
    if options.pop("finite", False):
        options["fastmath"] = {"nnan", "ninf", "nsz"}
    if options.pop("inline", False):
        options |= {"forceinline": True, "_nrt": False, "error_model": "numpy"}
    defaults = {"nopython": True, "boundscheck": None, "no_cfunc_wrapper": True, "nogil": True}
    compiled = Kernel(function, locals={}, targetoptions=defaults | options)
    compiled.enable_caching()
    return compiled


@contextmanager
def defer_signals() -> Iterator[None]:
    """Run signal handlers at the end of the body; only the main thread runs any."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    pending: list[int] | None = []
    handlers: dict[int, Callable[..., Any]] = {}

    def record(number: int, frame: Any) -> None:  # noqa: ANN401
        if pending is None:
            handlers[number](number, frame)
        else:
            pending.append(number)

    for number in (getattr(signal, name) for name in _SIGNALS if hasattr(signal, name)):
        if callable(handler := signal.getsignal(number)):
            handlers[number] = handler
            signal.signal(number, record)
    try:
        yield
    finally:
        late, pending = (
            pending,
            None,
        )  # a handler may raise from here; `record` then passes signals on
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in late or ():
            handlers[number](number, None)


class _CalleeCode(JITCodeLibrary):
    """Code of a function that kernels call; they optimize and translate it with their own."""

    def finalize(self) -> None:
        """Keep the code as it is; numba optimizes and translates it here."""
        self._finalize_dynamic_globals()
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == Linkage.external:
                function.linkage = Linkage.linkonce_odr
        self._finalized = True

    @property
    def codegen(self) -> Any:  # noqa: ANN401  # numba's
        """Generator of code whose functions have no address yet, and hence no environment."""
        return self

    def set_env(self, name: str, env: Any) -> None:  # noqa: ANN401
        """Leave the environment to the kernels."""

    def own_module(self) -> Any:  # noqa: ANN401  # LLVM's
        """Return the code without that of the functions that it calls."""
        self._ensure_finalized()
        return self._final_module

    def _get_module_for_linking(self) -> Any:  # noqa: ANN401
        """Return the code with all that it calls, for numba's own dispatchers and the cache."""
        if self._shared_module is None:
            self._shared_module = self.own_module().clone()
            _link_callees(self, self._shared_module)
        return self._shared_module

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        return self.name, "bitcode", self._get_module_for_linking().as_bitcode()

    @classmethod
    def _unserialize(cls, codegen: Any, state: tuple[str, str, bytes]) -> _CalleeCode:  # noqa: ANN401
        name, _, code = state
        self = cls(codegen, name)
        self._final_module = llvmlite.binding.parse_bitcode(code)
        self._finalized = True
        return self


class _LinkedCode(JITCodeLibrary):
    """Code of a kernel that Python calls, and of all functions that it calls."""

    def finalize(self) -> None:
        """Link, optimize and translate the code."""
        _link_callees(self, self._final_module)
        self._linking_libraries = []
        super().finalize()
        for variable in self._final_module.global_variables:
            env = lookup_environment(variable.name)
            if env is not None:
                self._codegen.set_env(variable.name, env)


def _link_callees(library: CodeLibrary, module: Any) -> None:  # noqa: ANN401  # LLVM's
    """Link all functions that the code of a library calls into a module."""
    pending, visited = [library], {library}
    while pending:
        for callee in pending.pop()._linking_libraries:  # noqa: SLF001  # numba's
            if callee in visited:
                continue
            visited.add(callee)
            if hasattr(library, "_reload_init"):  # numba 0.61 and later
                library._reload_init.update(callee._reload_init)  # noqa: SLF001
            if isinstance(callee, _CalleeCode):
                pending.append(callee)
                module.link_in(callee.own_module(), preserve=True)
            else:
                module.link_in(callee._get_module_for_linking(), preserve=True)  # noqa: SLF001


@contextmanager
def _libraries_of(kind: type[JITCodeLibrary], context: CPUContext) -> Iterator[None]:
    """Make numba create libraries of a kind, without wrappers for C; needs its compiler lock."""
    codegen = context.codegen()
    before = codegen._library_class, CPUContext.create_cfunc_wrapper  # noqa: SLF001
    codegen._library_class, CPUContext.create_cfunc_wrapper = kind, lambda *_: None  # noqa: SLF001
    try:
        yield
    finally:
        codegen._library_class, CPUContext.create_cfunc_wrapper = before  # noqa: SLF001


class _KernelCompiler(Compiler):
    """Numba's compiler, which leaves callees to the kernels that Python calls.

    No exception of a signal handler interrupts it.
    """

    def compile_extra(self, func: Callable[..., Any]) -> Any:  # noqa: ANN401  # numba's
        context = self.state.targetctx
        if not self.state.flags.no_cpython_wrapper:
            self.state.library = _LinkedCode(context.codegen(), func.__qualname__)
            self.state.library.enable_object_caching()
        with defer_signals(), _libraries_of(_CalleeCode, context):
            return super().compile_extra(func)


class _InnerKernel(CPUDispatcher):
    """Numba's dispatcher with our cache, for calls from other kernels."""

    def __init__(self, py_func: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(py_func, pipeline_class=_KernelCompiler, **options)

    def enable_caching(self) -> None:
        """Use our cache instead of numba's."""
        self._cache = _Cache(self)

    def compile(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Load or compile the code for a signature; see `numba.core.dispatcher`."""
        with global_compiler_lock, _without_garbage_collection():
            try:
                return super().compile(sig)
            finally:
                self._cache.release_lock()


class Kernel(_InnerKernel):
    """Compiled function for calls from Python.

    Its wrapper, which unpacks Python objects, can be larger than the function; other kernels therefore
    call another object without a wrapper.
    """

    def __init__(self, py_func: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(py_func, **options)
        self._inner: _InnerKernel | None = None

    @property
    def inner(self) -> _InnerKernel:
        """Dispatcher for calls from other kernels."""
        if self._inner is None:
            bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
            self._inner = _InnerKernel(
                self.py_func, locals={}, targetoptions=self.targetoptions | bare
            )
            self._inner.enable_caching()
        return self._inner

    def is_cached(self, types: tuple[Any, ...]) -> bool:
        """Return whether the cache has code for arguments of these types."""
        return any(f.exists() for f in self._cache.files(types))

    def get_call_template(self, args: Any, kws: Any) -> Any:  # noqa: ANN401  # numba's
        """Return the types of a call from another kernel; literals get their plain type."""
        args = [unliteral(arg) for arg in args]
        return self.inner.get_call_template(args, {k: unliteral(arg) for k, arg in kws.items()})

    def get_overload(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Return the code for a call from another kernel."""
        return self.inner.get_overload(sig)

    @property
    def is_compiling(self) -> Any:  # noqa: ANN401  # numba's
        """Whether a call is recursive."""
        return self._compiling_counter or (self._inner is not None and self._inner.is_compiling)


class _Cache:
    """Cached code of one kernel: a file for each signature, in a folder named by the cache key.

    Numba calls these methods under its compiler lock, one thread at a time.
    """

    def __init__(self, dispatcher: _InnerKernel) -> None:
        self._dispatcher = dispatcher
        self._lock: int | None = None
        function = dispatcher.py_func
        self.name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")

    @cached_property
    def _folder(self) -> str:
        processor = self._dispatcher.targetctx.codegen().magic_tuple()
        versions = (_FORMAT, sys.version, numba.__version__, llvmlite.__version__)
        return f"{self.name}-{cache_key(versions, processor, self._dispatcher)}"

    @property
    def cache_path(self) -> str:
        return str(cache.FOLDERS.read[0] / self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        """Return cached code; where there is none, lock out other processes and return None."""
        with defer_signals():
            rtsys.initialize(target_context)
        code = self._load(sig, target_context)
        if code is None:
            cache.notify_listeners(self.name, done=False)
            self._acquire_lock()
            code = self._load(sig, target_context)  # a listener or another process compiled it
        return code

    def files(self, sig: Any) -> list[Path]:  # noqa: ANN401  # numba's
        return [place / self._folder / _file(sig) for place in cache.FOLDERS.read]

    def save_overload(self, sig: Any, data: CompileResult) -> None:  # noqa: ANN401
        if not data.library.has_dynamic_globals:
            code = dumps(_strip_code(data._reduce()))  # noqa: SLF001
            cache.FOLDERS.store(f"{self._folder}/{_file(sig)}", code)
        cache.notify_listeners(self.name, done=True)

    def release_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _load(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        for file in self.files(sig):
            # cut short by a crash, or a class of its arguments has moved
            with suppress(OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
                # numba's own format; compiled code has to be trusted anyway
                code = pickle.loads(file.read_bytes())  # noqa: S301
                kind = _LinkedCode if isinstance(self._dispatcher, Kernel) else _CalleeCode
                with defer_signals(), _libraries_of(kind, target_context):
                    return CompileResult._rebuild(target_context, *code)  # noqa: SLF001
        return None

    def _acquire_lock(self) -> None:
        """Wait for another process that compiles this kernel; a recursive kernel has the lock already."""
        if self._lock is not None or cache.FOLDERS.write is None:
            return
        with suppress(OSError):  # a file system without locks: twice the work, the same code
            folder = cache.FOLDERS.write / self._folder
            folder.mkdir(exist_ok=True)
            self._lock = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
            fcntl.flock(self._lock, fcntl.LOCK_EX)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    """Disable garbage collection, which takes an eighth of the time of compiling."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def _strip_code(reduced: tuple[Any, ...]) -> tuple[Any, ...]:
    """Drop the parts of numba's cache entry that take longest to load.

    These are the code for linking, of which kernels that Python calls need only the names, and
    environments without constants, each of which costs an import.
    """
    (name, kind, code), description, *others, environments = reduced
    if kind == "object":
        names = (description.llvm_func_name, description.llvm_cpython_wrapper_name)
        definitions = "".join(f'define void @"{name}"() {{ ret void }}\n' for name in names)
        code = code[0], llvmlite.binding.parse_assembly(definitions).as_bitcode()
    environments = tuple(each for each in environments if each.consts)
    return ((name, kind, code), description, *others, environments)


def _file(sig: Any) -> str:  # noqa: ANN401  # numba's
    args, _ = sigutils.normalize_signature(sig)
    return f"{cache_key(*args)}.nbc"


def cache_key(*values: object) -> str:
    """Return a short digest of kernels, functions and constants, equal between processes.

    Numba compiles constants in: every global that a kernel names is part of its code. Comments,
    docstrings and line numbers are not. Raises `TypeError` for values without a stable digest.
    """
    sha = hashlib.sha256()
    for part in _parts(values, set()):
        sha.update(part.encode() + b"\n")
    return sha.hexdigest()[:16]


def _parts(value: Any, visited: set[str]) -> Iterator[str]:  # noqa: ANN401, C901, PLR0912  # any constant
    match value:
        case BaseNamedTuple():  # cached code names the class and its fields, a type's repr does not
            home = value.instance_class
            yield f"{home.__module__}.{home.__qualname__} {value.fields} {value!r}"
        case tuple() | list():
            yield f"{type(value).__name__} of {len(value)}"
            for item in value:
                yield from _parts(item, visited)
        case set() | frozenset():
            yield from sorted("\n".join(_parts(item, visited)) for item in value)
        case dict():
            yield from sorted("\n".join(_parts(pair, visited)) for pair in value.items())
        case np.ndarray():
            yield f"{value.dtype} {value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        case type() | BuiltinFunctionType() | np.ufunc() | ModuleType():
            yield f"{getattr(value, '__module__', '')} {value.__name__} {getattr(value, '_fields', '')}"
        case CPUDispatcher():
            yield from _parts(value.targetoptions, visited)
            yield from _parts(value.py_func, visited)
        case _Intrinsic():
            yield from _parts(value._defn, visited)  # noqa: SLF001  # the function that it was made of
        case FunctionType():
            yield from _function_parts(value, visited)
        case CodeType():
            yield from _code_parts(value, None, visited)
        case _ if isinstance(value, _PLAIN):
            yield f"{type(value).__name__} {value!r}"
        case _:
            raise TypeError(
                f"A kernel uses {value!r}, whose changes the compiled-code cache cannot detect."
            )


def _function_parts(function: FunctionType, visited: set[str]) -> Iterator[str]:
    name = f"{function.__module__}.{function.__qualname__}"
    yield name
    if name in visited:
        return
    visited.add(name)
    code = function.__code__
    yield from _code_parts(code, function.__doc__, visited)
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    yield from _parts((function.__defaults__, function.__kwdefaults__, cells), visited)
    names = list(dict.fromkeys(_names(code)))
    for key in filter(function.__globals__.__contains__, names):
        value = function.__globals__[key]
        yield key
        yield from _parts(value, visited)
        if isinstance(value, ModuleType) and value.__name__.startswith("placegraph"):
            for member in names:
                if hasattr(value, member):
                    yield from _parts(getattr(value, member), visited)


def _code_parts(code: CodeType, doc: str | None, visited: set[str]) -> Iterator[str]:
    yield repr((code.co_code, code.co_names, code.co_varnames, code.co_flags))
    for const in code.co_consts:
        if const is None or const != doc:
            yield from _parts(const, visited)


def _names(code: CodeType) -> Iterator[str]:
    inner = (const for const in code.co_consts if isinstance(const, CodeType))
    yield from chain(code.co_names, *map(_names, inner))
