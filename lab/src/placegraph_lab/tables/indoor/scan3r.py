"""Splits of 3RScan, and cross-temporal queries: one scan is the map, another of its room is asked about.

SG2Loc (Sec. 5) follows SceneGraphLoc: 3RScan's hidden test scans have no scene graphs, so its 47
validation rooms are parted anew, 17 (34 scans) for validation and 30 (123 scans) for testing. Which
these are, SceneGraphLoc's own lists say (`val_resplit_scans.txt`, `test_resplit_scans.txt`), which
are read where the user has them. Without them the 17 rooms with the fewest scans are the validation
(17 rooms have 34 scans only if hardly one has more than the two that a pair needs), those of equally
many by the ids of their references: a rule that anybody can repeat, but not that of the papers.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import Capture
from placegraph_io.dataset.scan3r import Room, Rooms, Scan
from placegraph_io.dataset.scan3r_sequence import read_scan3r_sequence
from placegraph_io.dataset.scannet import read_text
from placegraph_lab.tables.indoor.windows import sampled

Split = Literal["train", "validation", "test"]
SPLITS: tuple[Split, ...] = ("train", "validation", "test")
LISTS: dict[Split, str] = {
    "train": "train_resplit_scans.txt",
    "validation": "val_resplit_scans.txt",
    "test": "test_resplit_scans.txt",
}
"""SceneGraphLoc's names of its lists."""
VALIDATION_ROOMS = 17  # of 3RScan's 47 rooms for validation, those that remain it (Sec. 5).
LENGTHS = (5, 10, 25, 50)  # images of a sequence (Tables 1 and 2)
CANDIDATES = (10, 50)  # scenes from which the right one is retrieved (Table 5)


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
    rooms: Rooms,
    lists: str | PathLike[str] | Mapping[Split, str | PathLike[str]] | None = None,
    *,
    validation_rooms: int = VALIDATION_ROOMS,
) -> dict[Split, tuple[Room, ...]]:
    """Rooms for training, validation and testing, in the order of their references' ids.

    `rooms`: what `read_rooms` read of `3RScan.json`; `lists`: folder with lists called as in
    `LISTS`, or a list for each split. A list holds ids, of references or of any of their scans.
    What no list names is in no split; splits without a list are made by the module's rule of the
    rooms that remain; `validation_rooms`: by that rule, rooms for validation; the others of
    3RScan's validation are for testing.

    Raises `InputError`: A list is missing, empty, or names a scan that `rooms` does not know, or a
    room of another; `OptionError`: `validation_rooms` is negative, or a split has another name.
    """
    if validation_rooms < 0:
        raise OptionError(f"validation_rooms is {validation_rooms}; it is 0 or more.")
    files = _lists(lists)
    found: dict[Split, tuple[Room, ...]] = {}
    taken: dict[str, Path] = {}
    for split, file in files.items():
        listed = {room.reference: room for room in _listed(rooms, file)}
        for reference in listed:
            if reference in taken:
                raise InputError(f"{file} and {taken[reference]} both name the room {reference}.")
            taken[reference] = file
        found[split] = tuple(listed.values())
    free = [room for room in rooms.rooms if room.reference not in taken]
    derived = _derived(free, validation_rooms)
    return {
        split: (tuple(sorted(found.get(split, derived[split]), key=lambda room: room.reference)))
        for split in SPLITS
    }


def _derived(rooms: Sequence[Room], validation_rooms: int) -> dict[Split, tuple[Room, ...]]:
    both = [room for room in rooms if room.kind == "validation"]
    both.sort(key=lambda room: (len(room.scans), room.reference))
    return {
        "train": tuple(room for room in rooms if room.kind == "train"),
        "validation": tuple(both[:validation_rooms]),
        "test": tuple(both[validation_rooms:]),
    }


def _lists(
    given: str | PathLike[str] | Mapping[Split, str | PathLike[str]] | None,
) -> dict[Split, Path]:
    if given is None:
        return {}
    if isinstance(given, Mapping):
        unknown = set(given) - set(SPLITS)
        if unknown:
            raise OptionError(f"lists: {sorted(unknown)} are no splits; those are {SPLITS}.")
        return {split: Path(file) for split, file in given.items()}
    folder = Path(given)
    found = {split: folder / name for split, name in LISTS.items() if (folder / name).is_file()}
    if not found:
        raise InputError(
            f"{folder} has none of {', '.join(LISTS.values())}; pass a folder that has."
        )
    return found


def _listed(rooms: Rooms, file: Path) -> list[Room]:
    ids = [line.partition("#")[0].strip() for line in read_text(file).splitlines()]
    ids = [id_ for id_ in ids if id_]
    if not ids:
        raise InputError(f"{file} names no scan; it holds one id a line.")
    try:
        return [rooms.room_of(id_) for id_ in ids]
    except InputError as error:
        raise InputError(f"{file}: {error}") from error


# ------------------------------------------------------------------------------------------ pairs


def cross_temporal_pairs(
    rooms: Iterable[Room],
    which: Literal["all", "one", "reference"] = "all",
    *,
    rng: Generator | None = None,
    left_out: Counter[str] | None = None,
) -> list[ScanPair]:
    """Pairs of different scans of the same room.

    `rooms`: rooms of a split; `which`: "all": each scan is asked about in the map of each other
    one. "one": in one other, drawn, as SceneGraphLoc does. "reference": each rescan in the map of
    its room's reference; `rng`: draws for "one"; `left_out`: is told of rooms with a single scan,
    and scans whose alignment 3RScan keeps back.

    Raises `OptionError`: `which` is none of its values, or "one" without `rng`.
    """
    if which not in {"all", "one", "reference"} or (which == "one" and rng is None):
        raise OptionError(f"which is {which!r}; it is 'all', 'reference', or 'one' with an rng.")
    counts: Counter[str] = Counter() if left_out is None else left_out
    pairs = []
    for room in rooms:
        scans = [scan for scan in room.scans if scan.reference_from_scan is not None]
        hidden = len(room.scans) - len(scans)
        if hidden:
            counts["scans whose alignment is kept back"] += hidden
        if len(scans) < 2:
            counts["rooms with a single scan"] += 1
            continue
        for query in scans:
            others = [scan for scan in scans if scan is not query]
            if which == "reference":
                others = [scan for scan in others if scan.id == room.reference]
            elif which == "one" and rng is not None:
                others = [others[int(rng.integers(len(others)))]]
            pairs += [_pair(room, one, query) for one in others]
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


def candidates(pair: ScanPair, rooms: Sequence[Room], count: int, rng: Generator) -> list[str]:
    """Scans for retrieval (Table 5): the pair's map and, drawn, others that do not show its room.

    `count` in all (10 or 50 in the paper), in the order of their ids; fewer where the rooms hold
    fewer scans. `OptionError` where `count` is less than 1.
    """
    if count < 1:
        raise OptionError(f"count is {count}; it is 1 or more.")
    others = [scan.id for room in rooms if room.reference != pair.room for scan in room.scans]
    drawn = rng.permutation(len(others))[: count - 1]
    return sorted([pair.map, *(others[i] for i in drawn.tolist())])


# ---------------------------------------------------------------------------------------- queries


def scan_folder(root: Path, scan: str) -> Path:
    found = next((p for p in (root / scan, root / "scenes" / scan) if p.is_dir()), None)
    if found is None:
        raise InputError(f"{root} holds no scan {scan}; download it there.")
    return found


def recorded(root: Path, pair: ScanPair, *, every: int = 1) -> tuple[Capture, Floats]:
    """A pair's query, one image in `every`, and its true map_from_camera (T, 4, 4) [m].

    Raises as `pair_windows` does.
    """
    capture = sampled(read_scan3r_sequence(scan_folder(root, pair.query)), every)
    return capture, pair.map_from_query @ capture.odometry
