"""What is written for minutes, and has its name only when it is whole."""

from __future__ import annotations

import shutil
import sqlite3
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from placegraph.core.files import cannot_write, exclusive
from placegraph.errors import OptionError


def check_free(path: Path) -> None:
    """Raise `OptionError` where something is at a path already."""
    if path.exists():
        raise OptionError(f"{path} is there already; remove it, or name another file.")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Whatever the disk says while something is written for `path` becomes a `MapError`."""
    try:
        yield
    except OSError as error:
        raise cannot_write(path, error) from error
    except sqlite3.Error as error:  # of databases
        raise cannot_write(path, OSError(str(error))) from error


class Unfinished:
    """A hidden folder beside a path, in which the file or folder of that path is written, by one at a time.

    Raises `OptionError` where something is at the path already, `MapLockedError` where somebody else
    is writing it, `MapError` where nothing can be written there.
    """

    def __init__(self, path: Path) -> None:
        check_free(path)
        self.path = path
        with writing(path), ExitStack() as stack:
            path.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(exclusive(path))
            self.folder = path.parent / tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent)
            self._locked = stack.pop_all()

    def finish(self, made: Path) -> None:
        """Give what was made in the folder its name; raises as the constructor."""
        check_free(self.path)
        with writing(self.path):
            made.rename(self.path)

    def drop(self) -> None:
        """Remove the folder, and what is left in it."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._locked.close()
