"""Files that are written whole or not at all."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from weakref import finalize

from placegraph.errors import InputError, MapError, MapLockedError

if TYPE_CHECKING:
    Chunks = Iterable[bytes | memoryview]

_STREAMS = ("/dev/std", "/dev/fd/", "/proc/")
"""Where names stand for what is open: a new file in the place of one would be read by nobody."""


def write_file(path: str | os.PathLike[str], chunks: Chunks) -> Path:
    """Write a file that takes the place of the old one in one step; a link stays a link.

    Raises
    ------
    MapLockedError
        Another process is writing this file.
    MapError
        It cannot be written; what was there before is untouched.

    """
    target = resolve_path(path)
    check_target(target)
    try:
        with lock_file(target):
            replace_file(target, chunks)
    except OSError as error:
        raise write_error(target, error) from error
    return Path(path)


def write_output(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a picture or a text as `write_file` does; what is no file, as /dev/stdout, straight.

    Raises `MapLockedError` as `write_file` does, and `InputError` where it cannot be written.
    """
    given = Path(path)
    try:
        if str(given.absolute()).startswith(_STREAMS) or (given.exists() and not given.is_file()):
            given.write_bytes(content)
        else:
            target = Path(os.path.realpath(given))
            with lock_file(target):
                replace_file(target, [content])
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{given} cannot be written: {why}. Choose another place.") from error
    return given


def replace_file(target: Path, chunks: Chunks) -> None:
    """Bring chunks to disk and put them in the place of `target`, whose lock the caller holds.

    Raises `OSError` where that fails; the old file is untouched then.
    """
    temporary = target.with_name(f".{target.name}.tmp")  # ours alone: the lock is held
    try:
        with suppress(FileNotFoundError):  # left by a crash, or a link that somebody put there
            temporary.unlink()
        made = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
        with os.fdopen(os.open(temporary, made, 0o666), "wb") as file:
            for chunk in chunks:
                file.write(chunk)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
        _sync_folder(target.parent)
    finally:
        with suppress(OSError):  # in a folder that is no longer ours: the first error counts
            temporary.unlink()


def check_regular(path: Path) -> Path:
    """Path of a file to read; `InputError` where it is a pipe or a device, which may never end."""
    with suppress(OSError, ValueError):  # for the reader to say
        if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
            raise InputError(f"{path} is not a plain file; copy what it holds into one.")
    return path


def resolve_path(path: str | os.PathLike[str]) -> Path:
    """Where a file really lies: links are followed. `MapError` where it is no file name."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:
        raise MapError(f"{path!r} is not a file name: {error}.") from error


def check_target(target: Path) -> None:
    """Raise `MapError` where something is there that is no file, or nothing can be."""
    try:
        if target.exists() and not target.is_file():
            raise MapError(f"{target} is not a plain file; name a file to write to.")
    except OSError as error:  # as of a name that is too long
        raise write_error(target, error) from error


def write_error(target: Path, error: OSError) -> MapError:
    """Error that says why a file cannot be written."""
    return MapError(f"{target} cannot be written: {error.strerror or error}. Choose another place.")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class FileWatch:
    """A file that columns are windows on: whether it is as it was when it was opened."""

    def __init__(self, file: BinaryIO, path: str | os.PathLike[str]) -> None:
        self._path, self._file = path, os.dup(file.fileno())
        finalize(self, os.close, self._file)
        self._was = self._now()

    def _now(self) -> tuple[int, int]:
        told = os.fstat(self._file)
        return told.st_size, told.st_mtime_ns

    def check(self) -> None:
        """Raise `MapError` where it was written to or cut short: what is read of it then may be anything."""
        if self._now() != self._was:
            raise MapError(
                f"{self._path} was changed while it was open; open it again, and let a new file take its "
                "place, as `save` does."
            )

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        return type(None), ()  # other processes get the columns themselves


@contextmanager
def lock_file(target: Path) -> Iterator[None]:
    """Hold ``.NAME.lock`` next to `target`, and remove it afterwards.

    Raises `MapLockedError` at once where another holds it, and `OSError` where it cannot be had.
    """
    path = target.with_name(f".{target.name}.lock")
    descriptor = _acquire(path, target)
    while not _same_file(path, descriptor):  # its last owner removed it before we had it
        os.close(descriptor)
        descriptor = _acquire(path, target)
    try:
        yield
    finally:
        with suppress(OSError):  # what stays is free for the next
            path.unlink()
        os.close(descriptor)


def _acquire(path: Path, target: Path) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise MapLockedError(
            f"{target} is being written by someone else; wait for it, or write elsewhere."
        ) from None
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _same_file(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
