"""Files that are replaced atomically, locked while they are written, or watched while they are read."""

from __future__ import annotations

import fcntl
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO
from weakref import finalize

from placegraph.errors import InputError, MapError, MapLockedError

_STREAMS = ("/dev/std", "/dev/fd/", "/proc/")
"""Names of open files, which cannot be replaced."""


def write_file(path: str | os.PathLike[str], chunks: Iterable[bytes | memoryview]) -> Path:
    """Replace a file atomically; a link stays a link.

    Raises `MapLockedError`: another process is writing this file; `MapError`: it cannot be written;
    the old file is untouched.
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
    """Write a picture or a text atomically; write to streams such as /dev/stdout directly.

    Raises `MapLockedError` where another process writes it, `InputError` where it cannot be written.
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


def replace_file(target: Path, chunks: Iterable[bytes | memoryview]) -> None:
    """Write chunks to disk and replace `target`, whose lock the caller holds.

    Raises `OSError` where that fails; the old file is then untouched.
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
    """Return the path of a file to read; `InputError` where it is a pipe or a device."""
    with suppress(OSError, ValueError):  # the reader reports these
        if not stat.S_ISREG(mode := path.stat().st_mode) and not stat.S_ISDIR(mode):
            raise InputError(f"{path} is not a regular file; copy its contents into one.")
    return path


def resolve_path(path: str | os.PathLike[str]) -> Path:
    """Return a path with links resolved; `MapError` where it is no file name."""
    try:
        return Path(os.path.realpath(path))
    except ValueError as error:
        raise MapError(f"{path!r} is not a valid file name: {error}.") from error


def check_target(target: Path) -> None:
    """Raise `MapError` where a path names a folder or device, or can name nothing."""
    try:
        if target.exists() and not target.is_file():
            raise MapError(f"{target} is not a regular file; choose another file to write.")
    except OSError as error:  # the name is too long, for instance
        raise write_error(target, error) from error


def write_error(target: Path, error: OSError) -> MapError:
    """Return the error that says why a file cannot be written."""
    return MapError(f"{target} cannot be written: {error.strerror or error}. Choose another place.")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class FileWatch:
    """Watch over a memory-mapped file, which must not change while it is open."""

    def __init__(self, file: BinaryIO, path: str | os.PathLike[str]) -> None:
        self._path, self._file = path, os.dup(file.fileno())
        finalize(self, os.close, self._file)
        self._state = self._read_state()

    def _read_state(self) -> tuple[int, int]:
        stats = os.fstat(self._file)
        return stats.st_size, stats.st_mtime_ns

    def check(self) -> None:
        """Raise `MapError` where the file was written to or cut short since it was opened."""
        if self._read_state() != self._state:
            raise MapError(
                f"{self._path} changed while it was open; open it again. To update a map, "
                "replace its file (as `save` does) rather than write into it."
            )

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        return type(None), ()  # other processes get the columns themselves


@contextmanager
def lock_file(target: Path) -> Iterator[None]:
    """Hold ``.NAME.lock`` next to `target`, and remove it afterwards.

    Raises `MapLockedError` at once where another process holds it, `OSError` where it cannot be made.
    """
    path = target.with_name(f".{target.name}.lock")
    descriptor = _acquire(path, target)
    while not _is_same_file(path, descriptor):  # its last owner removed it before we had it
        os.close(descriptor)
        descriptor = _acquire(path, target)
    try:
        yield
    finally:
        with suppress(OSError):  # a lock file that stays is free for the next process
            path.unlink()
        os.close(descriptor)


def _acquire(path: Path, target: Path) -> int:
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        raise MapLockedError(
            f"{target} is being written by another process; wait until it ends, or choose "
            "another file."
        ) from None
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _is_same_file(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(descriptor))
    except FileNotFoundError:
        return False
