"""Rooms in OpenStreetMap files: Simple Indoor Tagging, and osmAG's areas and passages.

Simple Indoor Tagging has ``indoor=room|area|corridor|wall|door|level`` with ``level=*`` and
``repeat_on=*``, and doors as nodes with ``door=*`` or ``entrance=*``. osmAG, OSM-XML for robots, has
ways with ``osmAG:type=area|passage`` and ``osmAG:areaType=*``. Elements may stand in any order, and
ids may be negative, as editors give them to what is new.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import InputError
from placegraph.io.osm.levels import levels_of
from placegraph.io.osm.osm import SUFFIXES, checked_osm, one_line, osm_file

ROOMS = ("room", "corridor", "area")
"""Kinds of shapes that somebody may be in."""
KINDS = frozenset({*ROOMS, "wall", "door", "level", "building"})
MOST_POINTS = 1000
"""Of an outline; longer ones are left out."""
_KEYS = ("indoor", "osmAG:type", "building", "building:part", "door", "entrance")
_OSMAG = {"structure": "level", "corridor": "corridor"}


class IndoorShape(NamedTuple):
    """A room, a wall, a door, or the building around them."""

    osm: str
    """``way/12``."""
    kind: str
    """One of `KINDS`."""
    levels: tuple[float, ...]
    """() where the file says none."""
    tags: dict[str, str]
    parts: list[Floats]
    """Closed rings of rooms and buildings, lines of walls, a point or a line of a door, each (n, 2)
    longitude, latitude [deg]."""


@dataclass(frozen=True, slots=True)
class IndoorOsm:
    """What a file says of rooms."""

    path: Path
    shapes: list[IndoorShape]
    left_out: Counter[str] = field(default_factory=Counter)

    @property
    def levels(self) -> tuple[float, ...]:
        """Levels that have rooms, ascending."""
        return tuple(sorted({at for s in self.shapes if s.kind in ROOMS for at in s.levels}))


def is_indoor_osm(path: Path) -> bool:
    """Whether a path looks like an OpenStreetMap file."""
    return path.name.lower().endswith(SUFFIXES) and path.is_file()


def read_indoor_osm(path: str | PathLike[str]) -> IndoorOsm:
    """Read the rooms, walls, doors and buildings of an OpenStreetMap file.

    Raises `InputError` where it is missing, empty, broken, or shows no room.
    """
    import osmium

    path = checked_osm(Path(path))
    try:
        found = _Elements(path)
    except (RuntimeError, OSError, ValueError, osmium.InvalidLocationError) as error:
        raise InputError(
            f"{path} cannot be read as OpenStreetMap data: {one_line(error)}. "
            "It may be truncated or of another format; download or export it again."
        ) from error
    plan = IndoorOsm(path, list(found.shapes()), found.left_out)
    if not any(shape.kind in ROOMS for shape in plan.shapes):
        why = f" (left out: {dict(found.left_out)})" if found.left_out else ""
        raise InputError(
            f"{path} shows no room{why}: nothing in it is tagged indoor=room, area or corridor, or "
            "osmAG:type=area, with an outline."
        )
    return plan


class _Elements:
    """Elements of a file with the nodes they need; read twice, so that their order does not matter."""

    def __init__(self, path: Path) -> None:
        import osmium

        wanted = osmium.filter.KeyFilter(*_KEYS)
        self.left_out: Counter[str] = Counter()
        self.tagged: list[tuple[str, dict[str, str], list[int]]] = []
        self.relations: list[tuple[str, dict[str, str], list[tuple[int, str]]]] = []
        self.ways: dict[int, list[int]] = {}
        for item in osmium.FileProcessor(osm_file(path)).with_filter(wanted):
            self._take(item)
        members = {ref for _, _, held in self.relations for ref, _ in held}
        needed = {ref for _, _, refs in self.tagged for ref in refs}
        every: Any  # osmium's own types do not know what a filter leaves
        if members:
            every = osmium.FileProcessor(osm_file(path), osmium.osm.WAY)
            for way in every:
                if way.id in members:
                    self.ways[way.id] = [node.ref for node in way.nodes]
                    needed.update(self.ways[way.id])
        self.places: dict[int, tuple[float, float]] = {}
        every = osmium.FileProcessor(osm_file(path), osmium.osm.NODE)
        for node in every:
            if node.id in needed and node.location.valid():
                self.places[node.id] = (node.lon, node.lat)

    def _take(self, item: Any) -> None:  # noqa: ANN401  # osmium has no types
        tags = dict(item.tags)
        if item.is_node():
            self.tagged.append((f"node/{item.id}", tags, [item.id]))
        elif item.is_way():
            self.tagged.append((f"way/{item.id}", tags, [node.ref for node in item.nodes]))
        elif item.is_relation() and tags.get("type") == "multipolygon":
            held = [(m.ref, m.role) for m in item.members if m.type == "w"]
            self.relations.append((f"relation/{item.id}", tags, held))

    def shapes(self) -> Iterator[IndoorShape]:
        """All that can be drawn; the rest is counted."""
        for osm, tags, refs in self.tagged:
            yield from self._shape(osm, tags, [refs])
        for osm, tags, members in self.relations:
            if any(ref not in self.ways for ref, _ in members):
                self.left_out["multipolygons with missing members"] += 1
            pieces = [self.ways[ref] for ref, _ in members if ref in self.ways]
            yield from self._shape(osm, tags, _joined(pieces))

    def _shape(
        self, osm: str, tags: dict[str, str], lines: list[list[int]]
    ) -> Iterator[IndoorShape]:
        kind = kind_of(tags)
        if not kind or (osm.startswith("node/") and kind != "door"):
            return
        parts = []
        for refs in lines:
            known = [self.places[ref] for ref in refs if ref in self.places]
            if len(known) < len(refs):
                self.left_out["outlines with missing nodes"] += 1
            part = np.array(known, np.float64).reshape(-1, 2)
            if kind in {*ROOMS, "level", "building"}:
                part = self._ring(part, kind)
            if len(part) > (kind == "wall"):
                parts.append(part)
        if parts:
            levels = {*levels_of(tags.get("level", "")), *levels_of(tags.get("repeat_on", ""))}
            yield IndoorShape(osm, kind, tuple(sorted(levels)), tags, parts)
        else:
            self.left_out[f"{kind}s without an outline"] += 1

    def _ring(self, part: Floats, kind: str) -> Floats:
        """Closed ring of an outline; empty where it is none."""
        if len(part) > MOST_POINTS:
            self.left_out[f"{kind}s of more than {MOST_POINTS} points"] += 1
            return part[:0]
        moves = np.ones(len(part), np.bool_)
        moves[1:] = (np.diff(part, axis=0) != 0).any(axis=1)
        part = part[moves]
        if len(part) and (part[0] != part[-1]).any():
            if kind in ROOMS:
                self.left_out["outlines that were open, and are closed"] += 1
            part = np.concatenate([part, part[:1]])
        return part if len(part) > 3 else part[:0]


def kind_of(tags: Mapping[str, str]) -> str:
    """Kind of an element by its tags; empty where it is none of `KINDS`."""
    osmag, indoor = tags.get("osmAG:type", ""), tags.get("indoor", "")
    if osmag == "area":
        return _OSMAG.get(tags.get("osmAG:areaType", ""), "room")
    if osmag == "passage":
        return "door"
    if indoor in KINDS and indoor != "building":
        return indoor
    if "building" in tags or "building:part" in tags:
        return "building"
    return "door" if "door" in tags or "entrance" in tags else ""


def room_names(shapes: Sequence[IndoorShape]) -> list[str]:
    """Name of each room: its own, its number, or what it is; those that are alike are numbered."""
    said = []
    for shape in shapes:
        tags = shape.tags
        kind = tags.get("room") or tags.get("osmAG:areaType") or shape.kind
        said.append((tags.get("name") or tags.get("ref") or kind.replace("_", " ")).strip())
    count: dict[str, int] = {}
    names = []
    for name in said:
        count[name] = count.get(name, 0) + 1
        names.append(name if said.count(name) == 1 else f"{name} {count[name]}")
    return names


def _joined(pieces: Sequence[Sequence[int]]) -> list[list[int]]:
    """Member ways of a multipolygon, end to end: as few lines as they make."""
    left, lines = [list(p) for p in pieces if len(p) > 1], []
    while left:
        line = left.pop()
        while line[0] != line[-1]:
            at = next((i for i, p in enumerate(left) if line[-1] in (p[0], p[-1])), None)
            if at is None:
                break
            other = left.pop(at)
            line += other[1:] if other[0] == line[-1] else other[-2::-1]
        lines.append(line)
    return lines
