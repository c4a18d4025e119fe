"""Compiled kernels, whose machine code is kept for the next process.

`kernel` stands where `numba.njit` would, and differs in what it keeps:

- A kernel's code is found by what went into it: its bytecode, its options, the constants and the
  kernels that it uses, however deep and in whichever file, and the versions of Python, numba and
  the processor. Numba looks at one file's time alone, and misses a callee that has changed in
  another. Clones of one state share what they compile, and a new comment or docstring
  compiles nothing.
- No kernel is compiled by two processes at once: the second waits, and takes what the first made.
- Code that is found needs numba's runtime and none of its declarations, which take long to import.
- No signal cuts LLVM short. It asks Python for code that was kept, and Python ignores an exception
  there, such as a `KeyboardInterrupt`: the kernel would then be one that does nothing, and its call
  end in memory that is nobody's.
"""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import Any

import llvmlite
import numba
from numba.core import caching, config, sigutils
from numba.core.compiler import Compiler, CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.runtime import rtsys
from numba.core.serialize import dumps
from numba.core.types import unliteral

from placegraph.core import cache as kept
from placegraph.core.cache import folders, tell
from placegraph.core.fingerprint import fingerprint

# mypy: disable-error-code="attr-defined, no-untyped-call, no-any-return"


_HELD = ("SIGINT", "SIGALRM", "SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2")
"""Signals whose handlers in Python may raise."""


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
def uninterrupted() -> Iterator[None]:
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

    for number in (getattr(signal, name) for name in _HELD if hasattr(signal, name)):
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


class _Whole(Compiler):
    """Numba's compiler, with nothing of LLVM's left half owned by an exception out of the blue."""

    def compile_extra(self, func: Callable[..., Any]) -> Any:  # noqa: ANN401  # numba's
        with uninterrupted():
            return super().compile_extra(func)


class _Part(CPUDispatcher):
    """Numba's dispatcher, with our cache; of the function as other kernels have it within."""

    def __init__(self, py_func: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(py_func, pipeline_class=_Whole, **options)

    def enable_caching(self) -> None:
        """Look for code in our folders, and keep it there."""
        self._cache = _Cache(self)

    def compile(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Load or compile the code for a signature; see `numba.core.dispatcher`."""
        with global_compiler_lock, _collecting_no_garbage():
            try:
                return super().compile(sig)
            finally:
                self._cache.give_up_lock()


class Kernel(_Part):
    """A function that Python calls.

    Its arguments are unpacked from Python objects by a wrapper that can be larger than the function;
    what other kernels call is therefore another object, without one.
    """

    def __init__(self, py_func: Callable[..., Any], **options: Any) -> None:  # noqa: ANN401
        super().__init__(py_func, **options)
        self._part: _Part | None = None

    @property
    def part(self) -> _Part:
        """Of which other kernels have the code."""
        if self._part is None:
            bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
            self._part = _Part(self.py_func, locals={}, targetoptions=self.targetoptions | bare)
            self._part.enable_caching()
        return self._part

    def is_kept(self, types: tuple[Any, ...]) -> bool:
        """Whether code for arguments of these types is kept, and need not be compiled."""
        return any(f.exists() for f in self._cache.files(types))

    def get_call_template(self, args: Any, kws: Any) -> Any:  # noqa: ANN401  # numba's
        """How a call from another kernel is typed; each constant is not a type of its own."""
        args = [unliteral(arg) for arg in args]
        return self.part.get_call_template(args, {k: unliteral(arg) for k, arg in kws.items()})

    def get_overload(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Code for a call from another kernel."""
        return self.part.get_overload(sig)

    @property
    def is_compiling(self) -> Any:  # noqa: ANN401  # numba's
        """Whether a call is a call of itself."""
        return self._compiling_counter or (self._part is not None and self._part.is_compiling)


class _Cache(caching._Cache):  # noqa: SLF001  # numba's interface of caches
    """The code of one kernel: a file for each signature, in a folder named by what it is made of.

    Numba calls it under its own lock, so that one thread at a time is here.
    """

    def __init__(self, of: _Part) -> None:
        self._of = of
        self._lock: int | None = None
        self._enabled = True
        function = of.py_func
        self.name = f"{function.__module__}.{function.__qualname__}".replace("<locals>.", "")

    @cached_property
    def _folder(self) -> str:
        processor = self._of.targetctx.codegen().magic_tuple()
        versions = (sys.version, numba.__version__, llvmlite.__version__)
        return f"{self.name}-{fingerprint(versions, processor, self._of)}"

    @property
    def cache_path(self) -> str:
        return str(folders()[0] / self._folder)

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def flush(self) -> None:
        for place in folders():
            for file in (place / self._folder).glob("*.nbc"):
                with suppress(OSError):
                    file.unlink()

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        """Code that was kept; None where there is none, and then others wait until it is made."""
        if not self._enabled:
            return None
        with uninterrupted():
            rtsys.initialize(target_context)
        found = self._load(sig, target_context)
        if found is None and kept.FOLDERS.fell_back():
            found = self._load(sig, target_context)
        if found is None:
            tell(self.name, done=False)
            self._take_lock()
            found = self._load(sig, target_context)  # by whom was told, or whom we waited for
        return found

    def files(self, sig: Any) -> list[Path]:  # noqa: ANN401  # numba's
        return [place / self._folder / _file(sig) for place in folders()]

    def save_overload(self, sig: Any, data: CompileResult) -> None:  # noqa: ANN401
        if self._enabled and not data.library.has_dynamic_globals:
            code = dumps(_bare(data._reduce(), linked=not isinstance(self._of, Kernel)))  # noqa: SLF001
            kept.FOLDERS.keep(f"{self._folder}/{_file(sig)}", code)
        tell(self.name, done=True)

    def give_up_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _load(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        for file in self.files(sig):
            # cut short by a crash; or of arguments whose class has moved since
            with suppress(OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError):
                # numba's own form of compiled code, which is run: no more is trusted than that
                code = pickle.loads(file.read_bytes())  # noqa: S301
                with uninterrupted():
                    return CompileResult._rebuild(target_context, *code)  # noqa: SLF001
        return None

    def _take_lock(self) -> None:
        """Wait for another process that compiles this kernel; a kernel that calls itself has it."""
        if self._lock is not None or kept.FOLDERS.write is None:
            return
        with suppress(OSError):  # a file system without locks: twice the work, the same code
            folder = kept.FOLDERS.write / self._folder
            folder.mkdir(exist_ok=True)
            self._lock = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
            fcntl.flock(self._lock, fcntl.LOCK_EX)


@contextmanager
def _collecting_no_garbage() -> Iterator[None]:
    """Keep Python from looking through what the compiler holds, an eighth of the time."""
    before = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if before:
            gc.enable()


def _bare(reduced: tuple[Any, ...], *, linked: bool) -> tuple[Any, ...]:
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
    return f"{fingerprint(*args)}.nbc"
