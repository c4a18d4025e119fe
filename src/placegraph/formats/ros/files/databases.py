"""The index of a rosbag2 database (.db3): its table of messages, without their data."""

from __future__ import annotations

import sqlite3
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError
from placegraph.formats.ros.files.storage import Messages, Part

if TYPE_CHECKING:
    from pathlib import Path


def read_database(path: Path, notes: list[str], *, packed: bool = False) -> list[Part]:
    """Messages of a database by topic; `packed`: each is compressed by zstd.

    Where it is damaged it is read as far as it goes, of which `notes` is told. Raises `InputError`
    where it is no such database, or holds no message.
    """
    base = Messages(path, packed=packed)
    try:
        topics = base.select("id, name, type, serialization_format", "topics").fetchall()
    except (sqlite3.Error, ValueError) as error:
        raise InputError(f"{path} is no rosbag2 database ({error}); copy the bag again.") from error
    rows: list[tuple[int, int, int]] = []
    whole = "WHERE typeof(topic_id) || typeof(timestamp) || typeof(id) = 'integerintegerinteger'"
    try:
        rows.extend(base.select("topic_id, timestamp, id", "messages", whole))
    except (sqlite3.Error, ValueError) as error:
        notes.append(
            f"{path.name}: the database is damaged ({error}); it is read as far as it goes."
        )
    if not rows:
        raise InputError(f"{path} holds no message; record again.")
    table = np.array(rows, np.int64)
    parts = []
    for number, name, kind, encoding in topics:
        mine = table[table[:, 0] == number]
        zeros = np.zeros(len(mine), np.int64)
        parts.append(
            Part(str(name), str(kind), str(encoding), mine[:, 1], (base,), zeros, mine[:, 2])
        )
    return parts
