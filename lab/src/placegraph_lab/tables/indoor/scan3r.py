"""Splits of 3RScan, and cross-temporal queries: one scan is the map, another of its room is asked about.

SG2Loc (Sec. 5) follows SceneGraphLoc: 3RScan's hidden test scans have no scene graphs, so its 47
validation rooms are parted anew, 17 (34 scans) for validation and 30 (123 scans) for testing. Which
these are, SceneGraphLoc's own lists say (`val_resplit_scans.txt`, `test_resplit_scans.txt`), which
are read where the user has them. Without them the 17 rooms with the fewest scans are the validation
(17 rooms have 34 scans only if hardly one has more than the two that a pair needs), those of equally
many by the ids of their references: a rule that anybody can repeat, but not that of the papers.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph.errors import InputError
from placegraph.io.capture.capture import Capture
from placegraph_io.dataset.scan3r import Room, Rooms, Scan
from placegraph_io.dataset.scan3r_sequence import read_scan3r_sequence
from placegraph_io.dataset.scannet import read_text
from placegraph_lab.tables.indoor.windows import sample_frames

Split = Literal["train", "validation", "test"]
LISTS: dict[Split, str] = {
    "train": "train_resplit_scans.txt",
    "validation": "val_resplit_scans.txt",
    "test": "test_resplit_scans.txt",
}
"""SceneGraphLoc's names of its lists."""
VALIDATION_ROOMS = 17  # of 3RScan's 47 rooms for validation, those that remain it (Sec. 5).


@dataclass(frozen=True, eq=False)
class ScanPair:
    """Two scans of one room."""

    map: str  # scan the map is made of, in its own axes
    query: str  # scan whose images are asked about
    room: str  # reference of the room
    map_from_query: Floats  # (4, 4) [m]
    changed: bool
    """Whether `3RScan.json` tells of a change of an object between the room's reference and either."""

    @property
    def name(self) -> str:
        return f"{self.query.partition('-')[0]} in {self.map.partition('-')[0]}"


# ----------------------------------------------------------------------------------------- splits


def split_rooms(
    rooms: Rooms, lists: str | PathLike[str] | None = None
) -> dict[Split, tuple[Room, ...]]:
    """Rooms for training, validation and testing, in the order of their references' ids.

    `rooms`: what `read_rooms` read of `3RScan.json`; `lists`: folder with lists called as in
    `LISTS`. A list holds ids, of references or of any of their scans. Rooms that no list names are
    in no split; splits without a list are made by the module's rule of the rooms that remain.

    Raises `InputError`: the folder has no list, or a list is empty, or names a scan that `rooms` does
    not know, or a room of another.
    """
    found: dict[Split, tuple[Room, ...]] = {}
    taken: dict[str, Path] = {}
    files = {split: Path(lists or "", name) for split, name in LISTS.items()}
    for split, file in files.items():
        if lists is None or not file.is_file():
            continue
        found[split] = tuple({room.reference: room for room in _read_list(rooms, file)}.values())
        for room in found[split]:
            if (other := taken.setdefault(room.reference, file)) != file:
                raise InputError(f"{file} and {other} both name the room {room.reference}.")
    if lists is not None and not found:
        raise InputError(
            f"{lists} has none of {', '.join(LISTS.values())}; pass a folder that has."
        )
    free = [room for room in rooms.rooms if room.reference not in taken]
    both = [room for room in free if room.kind == "validation"]
    both.sort(key=lambda room: (len(room.scans), room.reference))
    rest: dict[Split, list[Room]] = {
        "train": [room for room in free if room.kind == "train"],
        "validation": both[:VALIDATION_ROOMS],
        "test": both[VALIDATION_ROOMS:],
    }
    return {
        split: tuple(sorted(found.get(split, rest[split]), key=lambda room: room.reference))
        for split in LISTS
    }


def _read_list(rooms: Rooms, file: Path) -> list[Room]:
    ids = [line.partition("#")[0].strip() for line in read_text(file).splitlines()]
    ids = [id_ for id_ in ids if id_]
    if not ids:
        raise InputError(f"{file} names no scan; it holds one id a line.")
    try:
        return [rooms.room_of(id_) for id_ in ids]
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


# ------------------------------------------------------------------------------------------ pairs


def cross_temporal_pairs(rooms: Iterable[Room], rng: Generator | None = None) -> list[ScanPair]:
    """Pairs of different scans of the same room whose alignment 3RScan does not keep back.

    Each scan is asked about in the map of each other one; with `rng` in one other, drawn, as
    SceneGraphLoc does.
    """
    pairs = []
    for room in rooms:
        scans = [scan for scan in room.scans if scan.reference_from_scan is not None]
        for query in scans if len(scans) > 1 else ():
            others = [scan for scan in scans if scan is not query]
            if rng is not None:
                others = [others[int(rng.integers(len(others)))]]
            pairs += [_pair(room, one, query) for one in others]
    return pairs


def read_pairs(path: str | PathLike[str], rooms: Rooms) -> list[ScanPair]:
    """Pairs of a text file, `map query` a line: ids of two scans of one room; `#` begins a comment.

    Raises `InputError`, which names the line, where a line is not that, or 3RScan keeps back how the
    scans are aligned.
    """
    path, pairs = Path(path), []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        where = f"{path}, line {number}"
        if len(words) != 2 or words[0] == words[1]:
            raise InputError(f"{where}: a line is `map query`, the ids of two scans of one room.")
        try:
            room = rooms.room_of(words[0])
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        scans = {scan.id: scan for scan in room.scans if scan.reference_from_scan is not None}
        if not set(words) <= set(scans):
            raise InputError(f"{where}: {' and '.join(words)} are not two aligned scans of a room.")
        pairs.append(_pair(room, scans[words[0]], scans[words[1]]))
    if not pairs:
        raise InputError(f"{path} holds no pair; a line is `map query`, the ids of two scans.")
    return pairs


def _pair(room: Room, one: Scan, query: Scan) -> ScanPair:
    reference_from_map = cast("Floats", one.reference_from_scan)
    reference_from_query = cast("Floats", query.reference_from_scan)
    return ScanPair(
        map=one.id,
        query=query.id,
        room=room.reference,
        map_from_query=np.linalg.inv(reference_from_map) @ reference_from_query,
        changed=any(bool(s.moves or s.nonrigid or s.removed) for s in (one, query)),
    )


# ---------------------------------------------------------------------------------------- queries


def scan_folder(root: Path, scan: str) -> Path:
    found = next((p for p in (root / scan, root / "scenes" / scan) if p.is_dir()), None)
    if found is None:
        raise InputError(f"{root} contains no scan {scan}; download it there.")
    return found


def read_query(root: Path, pair: ScanPair, *, every: int = 1) -> tuple[Capture, Floats]:
    """A pair's query, one image in `every`, and its true map_from_camera (T, 4, 4) [m].

    Raises as `pair_windows` does.
    """
    capture = sample_frames(read_scan3r_sequence(scan_folder(root, pair.query)), every)
    return capture, pair.map_from_query @ capture.odometry
