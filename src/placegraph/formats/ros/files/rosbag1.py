"""The index of a bag of ROS 1, as `rosbags` reads it."""

from __future__ import annotations

import bz2
import struct
from typing import TYPE_CHECKING

import numpy as np

from placegraph.errors import InputError
from placegraph.formats.ros.files.storage import Chunk, File, Part

if TYPE_CHECKING:
    from pathlib import Path


def read_rosbag1(path: Path) -> list[Part]:
    """Messages of a bag by topic; `InputError` where it is damaged, or was not closed."""
    from lz4.frame import decompress as lz4
    from rosbags.rosbag1 import Reader, ReaderError

    reader = Reader(path)
    try:
        reader.open()
    except (ReaderError, struct.error, ValueError, KeyError, OSError) as error:
        raise InputError(
            f"{path} cannot be read as a bag of ROS 1 ({error}); `rosbag reindex` mends one that was "
            "not closed, else copy it again."
        ) from error
    try:
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
            parts.append(
                Part(connection.topic, connection.msgtype, "ros1", times, chunks, which, offsets)
            )
    finally:
        reader.close()
    if not any(len(part.times) for part in parts):
        raise InputError(f"{path} holds no message; record again.")
    return parts
