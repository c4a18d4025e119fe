"""Cache of what is made once and found again by the next process: compiled code, grammars, tables."""

from __future__ import annotations

import os
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TypeVar

# mypy: disable-error-code="attr-defined"


T = TypeVar("T")


def use_folder(folder: str | PathLike[str] | None) -> None:
    """Keep compiled code in `folder`; None: where it would be kept unasked."""
    FOLDERS.choose(Path(folder) if folder is not None else None)


def folders() -> list[Path]:
    """Folders that are looked through for compiled code, first to last."""
    return FOLDERS.read


@contextmanager
def listening(listener: Callable[[str, bool], None]) -> Iterator[None]:
    """Call ``listener(name, done)`` when code is not found, and when it was compiled; in any thread.

    A listener that has it compiled elsewhere, before it returns, spares this process the work.
    """
    _LISTENERS.append(listener)
    try:
        yield
    finally:
        _LISTENERS.remove(listener)


def tell(name: str, *, done: bool) -> None:
    """Tell who listens that a kernel is to be compiled, or was."""
    for listener in _LISTENERS:
        listener(name, done)


def kept(name: str, make: Callable[[], bytes], read: Callable[[bytes], T]) -> T:
    """What `read` makes of the bytes that `make` returned once.

    They are found by `name`, which tells all that goes into them. Where `read` raises `ValueError`
    the file is damaged, and made anew.
    """
    for folder in folders():
        with suppress(OSError, ValueError):
            return read((folder / name).read_bytes())
    made = make()
    FOLDERS.keep(name, made)
    return read(made)


class _Folders:
    """Where compiled code is kept; looked up when first needed, since options come before."""

    def __init__(self) -> None:
        self.chosen: Path | None = None
        self._private: Path | None = None

    def choose(self, folder: Path | None) -> None:
        self.chosen = folder
        self._private = None
        self.__dict__.pop("write", None)

    @property
    def read(self) -> list[Path]:
        private = [self._private] if self._private else []
        return self._wanted + private

    @cached_property
    def write(self) -> Path | None:
        """Where what is new goes; None: nowhere."""
        return next(filter(_writable, self._wanted), None) or self._fallback()

    def fell_back(self) -> bool:
        """Whether the private folder is used, which is known once something must be written."""
        return self.write is not None and self.write == self._private

    def keep(self, name: str, code: bytes) -> None:
        """Write whole or not at all, so that no reader sees half of it."""
        while self.write is not None:
            try:
                return _write(self.write / name, code)
            except OSError:  # full by now, or gone
                self.write = self._fallback()
        return None

    @property
    def _wanted(self) -> list[Path]:
        if self.chosen is not None:
            return [self.chosen]
        from numba import config
        from numba.misc.appdirs import AppDirs

        if config.CACHE_DIR:
            return [Path(config.CACHE_DIR)]
        user = AppDirs(appname="placegraph", appauthor=False).user_cache_dir
        return [Path(__file__).parents[1] / "__pycache__" / "kernels", Path(user) / "kernels"]

    def _fallback(self) -> Path | None:
        """The private folder; None where it cannot be written, or was tried."""
        tried = self._private is not None
        self._private = self._private or _private_folder()
        private = None if tried else self._private
        wanted = " nor ".join(str(folder) for folder in self._wanted)
        instead = (
            f"; it is kept in {private} for now"
            if private
            else " nor in a temporary one, so that each process compiles anew"
        )
        warnings.warn(
            f"Compiled code cannot be kept in {wanted}{instead}. Choose a folder that can be "
            "written (`placegraph --compiled FOLDER`), and the next start will be quick.",
            stacklevel=2,
        )
        return private


FOLDERS = _Folders()
_LISTENERS: list[Callable[[str, bool], None]] = []
_PROBE = 1 << 16
"""Bytes that a folder must take to be written to: a full disk still makes empty files."""


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(bytes(_PROBE))
    except OSError:
        return False
    return True


def _private_folder() -> Path | None:
    """One folder for each user, and nobody else's: code is run from it; None: none can be written."""
    with suppress(OSError):
        folder = Path(tempfile.gettempdir()) / f"placegraph-{os.getuid()}"
        with suppress(OSError):
            folder.mkdir(mode=0o700)
        if not _is_ours(folder):
            folder = Path(tempfile.mkdtemp(prefix="placegraph-"))
        if _writable(folder):
            return folder
    return None


def _is_ours(folder: Path) -> bool:
    found = folder.lstat()
    ours = stat.S_ISDIR(found.st_mode) and found.st_uid == os.getuid()
    return ours and not found.st_mode & 0o077


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
