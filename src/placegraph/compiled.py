# mypy: disable-error-code="attr-defined, no-untyped-call, no-any-return"
"""Compiled kernels, and the folders in which their machine code is kept for the next process.

`kernel` stands where `numba.njit` would, and differs in what it keeps:

- A kernel's code is found by what went into it: its bytecode, its options, the constants and the
  kernels that it uses, however deep and in whichever file, and the versions of Python, numba and
  the processor. Numba looks at one file's time alone, and misses a callee that has changed in
  another. Clones of one state share what they compile, and a new comment or docstring
  compiles nothing.
- No kernel is compiled by two processes at once: the second waits, and takes what the first made.
- Where no folder can be written, code is kept in a private temporary one, with one warning.

Folders are looked through in this order, and new code goes to the first that can be written:
the one that was chosen (`use_folder`, or numba's own setting, ``NUMBA_CACHE_DIR``), and only where
none was chosen the package's own (``__pycache__/kernels``), then the user's cache.
"""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import stat
import sys
import tempfile
import warnings
from contextlib import contextmanager, suppress
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import llvmlite
import numba
from numba.core import caching, config, sigutils
from numba.core.compiler import CompileResult
from numba.core.compiler_lock import global_compiler_lock
from numba.core.registry import CPUDispatcher
from numba.core.serialize import dumps
from numba.misc.appdirs import AppDirs

from placegraph.fingerprint import fingerprint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from os import PathLike


def kernel(function: Callable[..., Any] | None = None, /, **options: Any) -> Any:  # noqa: ANN401
    """Compile `function` when it is first called, or loaded where it was compiled before.

    `options` are those of `numba.njit`; the interpreter's lock is given up unless ``nogil=False``.
    """
    if function is None:
        return lambda given: kernel(given, **options)
    if config.DISABLE_JIT:
        return function
    always = {"nopython": True, "boundscheck": None, "no_cfunc_wrapper": True}
    options = always | {"nogil": True} | options
    made = Kernel(function, locals={}, targetoptions=options)
    made.enable_caching()
    return made


def use_folder(folder: str | PathLike[str] | None) -> None:
    """Keep compiled code in `folder`; None: where it would be kept unasked."""
    _FOLDERS.choose(Path(folder) if folder is not None else None)


def folders() -> list[Path]:
    """Folders that are looked through for compiled code, first to last."""
    return _FOLDERS.read


@contextmanager
def listening(listener: Callable[[str, bool], None]) -> Iterator[None]:
    """Call ``listener(name, done)`` before and after each compiling, in whichever thread."""
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)


class _Part(CPUDispatcher):
    """Numba's dispatcher, with our cache; of the function as other kernels have it within."""

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
        bare = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
        self.part = _Part(py_func, locals={}, targetoptions=self.targetoptions | bare)
        self.part.enable_caching()

    def get_call_template(self, args: Any, kws: Any) -> Any:  # noqa: ANN401  # numba's
        """How a call from another kernel is typed."""
        return self.part.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:  # noqa: ANN401  # numba's
        """Code for a call from another kernel."""
        return self.part.get_overload(sig)

    @property
    def is_compiling(self) -> Any:  # noqa: ANN401  # numba's
        """Whether a call is a call of itself."""
        return self._compiling_counter or self.part.is_compiling


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
        return str(_FOLDERS.read[0] / self._folder)

    def enable(self) -> None:
        self._enabled = True

    def disable(self) -> None:
        self._enabled = False

    def flush(self) -> None:
        for place in _FOLDERS.read:
            for file in (place / self._folder).glob("*.nbc"):
                with suppress(OSError):
                    file.unlink()

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        """Code that was kept; None where there is none, and then others wait until it is made."""
        if not self._enabled:
            return None
        target_context.refresh()
        file = _file(sig)
        found = self._load(file, target_context)
        if found is None and self._take_lock():
            found = self._load(file, target_context)  # by whom we waited for
        if found is None:
            _tell(self.name, done=False)
        return found

    def save_overload(self, sig: Any, data: CompileResult) -> None:  # noqa: ANN401
        if self._enabled and not data.library.has_dynamic_globals:
            code = dumps(data._reduce())  # noqa: SLF001  # as numba's own cache does
            _FOLDERS.keep(f"{self._folder}/{_file(sig)}", code)
        _tell(self.name, done=True)

    def give_up_lock(self) -> None:
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def _load(self, file: str, target_context: Any) -> CompileResult | None:  # noqa: ANN401
        for place in _FOLDERS.read:
            with suppress(OSError, EOFError, pickle.UnpicklingError):  # cut short by a crash
                kept = pickle.loads((place / self._folder / file).read_bytes())  # noqa: S301
                return CompileResult._rebuild(target_context, *kept)  # noqa: SLF001
        return None

    def _take_lock(self) -> bool:
        """Wait for another process that compiles this kernel; False where we have the lock already."""
        if self._lock is not None:
            return False
        with suppress(OSError):  # a file system without locks: twice the work, the same code
            folder = _FOLDERS.write / self._folder
            folder.mkdir(exist_ok=True)
            self._lock = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
            fcntl.flock(self._lock, fcntl.LOCK_EX)
        return True


class _Folders:
    """Where compiled code is kept; looked up when first needed, since options come before."""

    def __init__(self) -> None:
        self._chosen: Path | None = None
        self._private: Path | None = None

    def choose(self, folder: Path | None) -> None:
        self._chosen = folder
        self.__dict__.pop("write", None)

    @property
    def read(self) -> list[Path]:
        private = [self._private] if self._private else []
        return self._wanted + private

    @cached_property
    def write(self) -> Path:
        for folder in self._wanted:
            if _writable(folder):
                return folder
        return self._fallback()

    def keep(self, name: str, code: bytes) -> None:
        """Write whole or not at all, so that no reader sees half of it."""
        try:
            _write(self.write / name, code)
        except OSError:  # full by now, or gone
            self.write = self._fallback()
            _write(self.write / name, code)

    @property
    def _wanted(self) -> list[Path]:
        if self._chosen is not None:
            return [self._chosen]
        if config.CACHE_DIR:
            return [Path(config.CACHE_DIR)]
        user = AppDirs(appname="placegraph", appauthor=False).user_cache_dir
        return [Path(__file__).parent / "__pycache__" / "kernels", Path(user) / "kernels"]

    def _fallback(self) -> Path:
        if self._private is None:
            self._private = _private_folder()
            wanted = " nor ".join(str(folder) for folder in self._wanted)
            warnings.warn(
                f"Compiled code cannot be kept in {wanted}; it is kept in {self._private} for now. "
                "Choose a folder that can be written, and the next start will be quick.",
                stacklevel=2,
            )
        return self._private


_FOLDERS = _Folders()
_LISTENERS: list[Callable[[str, bool], None]] = []


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


def _tell(name: str, *, done: bool) -> None:
    for listener in _LISTENERS:
        listener(name, done)


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError:
        return False
    return True


def _private_folder() -> Path:
    """One folder for each user, and nobody else's: code is run from it."""
    folder = Path(tempfile.gettempdir()) / f"placegraph-{os.getuid()}"
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
        if ours and not found.st_mode & 0o077:
            return folder
    return Path(tempfile.mkdtemp(prefix="placegraph-"))


def _write(path: Path, code: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(code)
        temporary.chmod(0o644)
        temporary.replace(path)
    except BaseException:
        temporary.unlink()
        raise


def _file(sig: Any) -> str:  # noqa: ANN401  # numba's
    args, _ = sigutils.normalize_signature(sig)
    return f"{fingerprint(*args)}.nbc"
