"""A lock on a file that is about to be written; it dies with its process."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from placegraph.errors import MapLockedError


@contextmanager
def exclusive(target: Path) -> Iterator[None]:
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
