"""SQLite files, read where they lie by any thread; nothing in them is run."""

from __future__ import annotations

import sqlite3
import weakref
from functools import partial
from pathlib import Path
from threading import Lock
from typing import Any

from placegraph.core.files import regular
from placegraph.errors import InputError

MOST = 1 << 28
"""Bytes of one value; images have some millions."""


class Database:
    """A database that is only read; opened again where it is sent to.

    Raises `InputError` where the file cannot be opened, or is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = regular(path)
        self._lock = Lock()
        wal = path.with_name(path.name + "-wal")
        alone = not (wal.exists() and wal.stat().st_size)
        where = f"{path.resolve().as_uri()}?{'immutable=1' if alone else 'mode=ro'}"
        try:
            self._base = sqlite3.connect(where, uri=True, check_same_thread=False)
            self._base.text_factory = partial(str, encoding="utf-8", errors="replace")
            self._base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MOST)
            self._base.execute("PRAGMA trusted_schema = OFF")
        except sqlite3.Error as error:
            raise InputError(f"{path} cannot be opened as a database ({error}).") from error
        weakref.finalize(self, self._base.close)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path,)

    def select(self, columns: str, table: str, then: str = "") -> Any:  # noqa: ANN401  # rows
        """Rows of a table, which must be one: no view runs. Raises `sqlite3.Error` or `ValueError`."""
        asked = "SELECT type || substr(sql, 1, 13) FROM sqlite_master WHERE name = ? COLLATE NOCASE"
        made = self._base.execute(asked, (table,)).fetchone()
        if made is None or str(made[0]).upper() != "TABLECREATE TABLE ":
            raise ValueError(f"it has no table {table}")
        return self._base.execute(f"SELECT {columns} FROM {table} {then}")  # noqa: S608  # our words

    def columns(self, table: str) -> set[str]:
        """Names of a table's columns, in lower case. Raises `sqlite3.Error`."""
        return {str(row[1]).lower() for row in self._base.execute(f"PRAGMA table_info({table})")}

    def blob(self, place: tuple[str, str, int], name: str, most: int | None = None) -> bytes:
        """Bytes of a table's column in a row, all or the first; `InputError`, which begins with `name`."""
        try:
            with self._lock, self._base.blobopen(*place, readonly=True) as held:
                if len(held) >= MOST:
                    raise InputError(f"{name} has {len(held):,} bytes; it is refused.")
                return held.read(len(held) if most is None else most)
        except (sqlite3.Error, OverflowError) as error:
            raise InputError(
                f"{name} cannot be read ({error}); `sqlite3 {self.path.name} .recover` saves what is left."
            ) from error
