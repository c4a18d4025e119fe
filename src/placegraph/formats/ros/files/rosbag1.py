"""The index of a bag of ROS 1, as `rosbags` reads it."""

from __future__ import annotations

import bz2
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError
from placegraph.files import regular
from placegraph.formats.ros.files.storage import Chunk, File, Part

if TYPE_CHECKING:
    from pathlib import Path

    from rosbags.rosbag1 import Reader


def read_rosbag1(path: Path) -> list[Part]:
    """Messages of a bag by topic; `InputError` where it is damaged, or was not closed."""
    from rosbags.rosbag1 import Reader

    regular(path)
    try:
        with Reader(path) as reader:
            parts = _parts(path, reader)
    except Exception as error:  # at damaged bytes it raises whatever they lead to, assertions too
        why = str(error) or "its index is damaged"
        raise InputError(
            f"{path} cannot be read as a bag of ROS 1 ({why}); `rosbag reindex` mends one that was not "
            "closed, else copy it again."
        ) from error
    if not any(len(part.times) for part in parts):
        raise InputError(f"{path} holds no message; record again.")
    return parts


def _parts(path: Path, reader: Reader) -> list[Part]:
    from lz4.frame import decompress as lz4

    file, packings = File(path), {bz2.decompress: "bz2", lz4: "lz4"}
    chunks = tuple(
        Chunk(file, c.datapos, c.datasize, packings.get(c.decompressor, ""), rosbag1=True)
        for c in reader.chunks.values()
    )
    row_of = {pos: row for row, pos in enumerate(reader.chunks)}
    parts = []
    for connection in reader.connections:
        index = reader.indexes[connection.id]
        rows = np.array([(e.time, row_of[e.chunk_pos], e.offset) for e in index], np.int64)
        times, which, offsets = rows.reshape(-1, 3).T
        name, kind = connection.topic, connection.msgtype
        parts.append(Part(name, kind, "ros1", times, chunks, which, offsets))
    return parts
