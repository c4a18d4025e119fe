"""Opening bags: which files one is of, and the topics that lie in them."""

from __future__ import annotations

import bz2
import os
import re
import sqlite3
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.core.files import regular
from placegraph.errors import InputError, MissingExtraError
from placegraph_io.ros.files.mcap import read_mcap
from placegraph_io.ros.files.storage import Chunk, File, Messages, Part, Topic, joined

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader

ENDINGS = (".mcap", ".db3", ".bag")
_OF_FOLDERS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")


@dataclass(frozen=True, slots=True, eq=False)
class Bag:
    """What lies in a bag."""

    path: Path
    topics: dict[str, Topic]
    """By name, in order of their names."""
    notes: tuple[str, ...]
    """What was found out while its index was read, in sentences."""

    def of_type(self, *types: str) -> list[Topic]:
        """Topics of some types that hold messages which can be read, such as `sensor_msgs/Imu`."""
        return [
            t
            for t in self.topics.values()
            if t.short in types and len(t) and t.encoding in {"cdr", "ros1"}
        ]


def looks_like_bag(path: Path) -> bool:
    """Whether a path bears the name of a bag: .mcap, .db3, .bag, or a folder with such files."""
    if path.is_dir():
        return any(p.name.lower().endswith(_OF_FOLDERS) for p in path.iterdir())
    return path.suffix.lower() in ENDINGS


def open_bag(path: Path) -> Bag:
    """Read the index of a bag; its messages stay where they are.

    Raises
    ------
    InputError
        It is no bag, is damaged beyond reading, or holds no message.
    MissingExtraError
        `rosbags` is not installed.

    """
    try:
        import rosbags  # noqa: F401  # decodes what the index leads to
    except ImportError as error:
        raise MissingExtraError(
            f'{path} is a bag, which needs the extra `ros`: pip install "placegraph[ros]".'
        ) from error
    notes: list[str] = []
    files, packed = _files(path, notes)
    parts = []
    for file in files:
        ending = file.suffix.lower()
        if ending == ".mcap":
            parts += read_mcap(file, notes)
        elif ending == ".db3":
            parts += read_database(file, notes, packed=packed)
        else:
            parts += read_rosbag1(file)
    renamed = [part._replace(type=ros2_type(part.type)) for part in parts]
    for name in {part.name for part in renamed}:
        kinds = sorted({part.type for part in renamed if part.name == name and len(part.times)})
        if len(kinds) > 1:
            notes.append(
                f"{name} holds messages of {' and '.join(kinds)}; the most frequent count."
            )
    topics = {topic.name: topic for topic in sorted(joined(renamed), key=lambda t: t.name)}
    return Bag(path, topics, tuple(notes))


def ros2_type(name: str) -> str:
    """Type as ROS 2 names it; ROS 1 leaves out `msg`."""
    package, _, rest = name.partition("/")
    return name if rest.startswith("msg/") or not rest else f"{package}/msg/{rest}"


def _files(path: Path, notes: list[str]) -> tuple[list[Path], bool]:
    """Files of a bag in order, and whether every message is compressed by itself."""
    if not path.is_dir():
        return [path], False
    metadata = path / "metadata.yaml"
    if metadata.is_file():
        said = _metadata(metadata)
        names = said.get("relative_file_paths")
        if not (isinstance(names, list) and names and all(isinstance(n, str) for n in names)):
            raise InputError(
                f"{metadata}: relative_file_paths is no list of files; run `ros2 bag reindex`."
            )
        files = [path / name.replace("\\", "/").rpartition("/")[2] for name in names]
        return [_unpacked(f) for f in files], str(said.get("compression_mode")).lower() == "message"
    found = sorted(
        (p for p in path.iterdir() if p.name.lower().endswith(_OF_FOLDERS)), key=_by_number
    )
    stems = {re.sub(r"_\d+$", "", p.name.partition(".")[0]) for p in found}
    if len(stems) > 1 or not found:
        raise InputError(
            f"{path} has no metadata.yaml, and holds {' and '.join(sorted(stems)) or 'no file'}; name "
            "the file of one bag."
        )
    notes.append(
        f"{path.name} has no metadata.yaml; its files are taken in the order of their names."
    )
    return [_unpacked(f) for f in found], False


def _by_number(path: Path) -> tuple[int, str]:
    number = re.search(r"_(\d{1,9})\.", path.name)
    return int(number[1]) if number else 0, path.name


def _unpacked(file: Path) -> Path:
    """File itself, or what was unpacked of it beside it."""
    if file.suffix == ".zstd":
        if not file.with_suffix("").is_file():
            raise InputError(f"{file} is compressed as a whole; unpack it once: `zstd -d {file}`.")
        return file.with_suffix("")
    if not os.path.isfile(file):  # noqa: PTH113 - False of names that are too long, too
        raise InputError(
            f"{file} does not exist, but metadata.yaml lists it; copy the whole folder."
        )
    return file


def _metadata(path: Path) -> dict[str, Any]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe").load(path.read_text("utf-8"))
        said = content["rosbag2_bagfile_information"]
    except (YAMLError, OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({error}); run `ros2 bag reindex`.") from error
    if not isinstance(said, dict):
        raise InputError(f"{path} is damaged; run `ros2 bag reindex`.")
    return said


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
