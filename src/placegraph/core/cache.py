"""Cache of files that later processes find again: compiled code, grammars, tables."""

# mypy: disable-error-code="attr-defined"

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
_PROBE = 1 << 16
"""Bytes written to test a folder: a full disk still makes empty files."""


class CacheFolders:
    """Folders of the cache, looked up when they are first needed."""

    def __init__(self) -> None:
        self.chosen: Path | None = None

    def choose(self, folder: str | PathLike[str] | None) -> None:
        """Use one folder; None: the default folders."""
        self.chosen = Path(folder) if folder is not None else None
        self.__dict__.pop("write", None)

    @property
    def read(self) -> list[Path]:
        """Folders to read, in order: the chosen one, else numba's, else the package's and the user's."""
        if self.chosen is not None:
            return [self.chosen]
        from numba import config

        if config.CACHE_DIR:
            return [Path(config.CACHE_DIR)]
        from platformdirs import user_cache_path

        package = Path(__file__).parents[1] / "__pycache__" / "kernels"
        return [package, user_cache_path("placegraph", appauthor=False) / "kernels"]

    @cached_property
    def write(self) -> Path | None:
        """First folder that can be written; None, after a warning, where there is none."""
        found = next(filter(_is_writable, self.read), None)
        if found is None:
            self._warn()
        return found

    def store(self, name: str, content: bytes) -> None:
        """Write a file atomically, if there is a folder to write to."""
        if self.write is None:
            return
        try:
            _write(self.write / name, content)
        except OSError:  # full by now, or gone
            self.write = None
            self._warn()

    def _warn(self) -> None:
        places = " nor in ".join(map(str, self.read))
        warnings.warn(
            f"Compiled code cannot be cached in {places}, so every process compiles again. "
            "Choose a writable folder (`placegraph --compiled FOLDER`).",
            stacklevel=3,
        )


FOLDERS = CacheFolders()
_LISTENERS: list[Callable[[str, bool], None]] = []


def load_or_make(name: str, make: Callable[[], bytes], read: Callable[[bytes], T]) -> T:
    """Read a cached file; where it is missing, or `read` raises `ValueError`, make and store it first.

    `name` is the cache key: it determines the bytes that `make` returns.
    """
    for folder in FOLDERS.read:
        with suppress(OSError, ValueError):
            return read((folder / name).read_bytes())
    content = make()
    FOLDERS.store(name, content)
    return read(content)


@contextmanager
def listen_to_compilation(listener: Callable[[str, bool], None]) -> Iterator[None]:
    """Call ``listener(name, done)`` before and after a kernel is compiled, in any thread.

    A listener may compile the kernel in another process first; this process then loads it.
    """
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)


def notify_listeners(name: str, *, done: bool) -> None:
    """Tell all listeners that a kernel is about to be compiled, or is compiled."""
    for listener in _LISTENERS:
        listener(name, done)


def _is_writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_PROBE))
    except OSError:
        return False
    return True


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent)
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
        temporary.chmod(0o644)
        temporary.replace(path)
    except BaseException:
        temporary.unlink()
        raise
