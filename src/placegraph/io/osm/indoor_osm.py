"""Rooms in OpenStreetMap files: Simple Indoor Tagging, and osmAG's areas and passages.

Simple Indoor Tagging has ``indoor=room|area|corridor|wall|door|level`` with ``level=*`` and
``repeat_on=*``, and doors as nodes with ``door=*`` or ``entrance=*``. osmAG, OSM-XML for robots, has
ways with ``osmAG:type=area|passage`` and ``osmAG:areaType=*``. Elements may stand in any order, and
ids may be negative, as editors give them to what is new.

`encode_rooms` writes both, for JOSM and for robots: ids are then negative, and places at the same 1e-7
degrees, a centimetre, are one node, so that rooms share their walls.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import count
from math import ceil, floor
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.errors import InputError
from placegraph.io.osm.osm import SUFFIXES, check_osm, one_line, osm_file

_PART = re.compile(
    r"\s*([+-]?\d{1,4}(?:\.\d{1,3})?)\s*(?:-\s*([+-]?\d{1,4}(?:\.\d{1,3})?)\s*)?", re.ASCII
)
_MOST = 300
"""Levels of one range: no building has more."""


def parse_levels(text: str) -> tuple[float, ...]:
    """Return the levels that a tag lists, ascending; ``a-b`` is a, b and all whole levels between.

    Parts that are no levels are passed over; () where none is one.
    """
    found: set[float] = set()
    for part in re.split(r"[;,]", text):
        match = _PART.fullmatch(part)
        if match is None:
            continue
        first = float(match[1])
        last = first if match[2] is None else float(match[2])
        low, high = min(first, last), max(first, last)
        if high - low <= _MOST:
            found |= {low, high, *map(float, range(ceil(low), floor(high) + 1))}
    return tuple(sorted(found))


def format_level(level: float) -> str:
    """Return a level as it is written in a tag: ``1``, ``0.5``."""
    return f"{level:g}"


ROOMS = ("room", "corridor", "area")
"""Kinds of shapes that somebody may be in."""
KINDS = frozenset({*ROOMS, "wall", "door", "level", "building"})
MAX_POINTS = 1000
"""Maximum number of points of an outline; longer outlines are left out."""
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
    """Ways, relations and nodes of an indoor file."""

    path: Path
    shapes: list[IndoorShape]
    left_out: Counter[str] = field(default_factory=Counter)

    @property
    def levels(self) -> tuple[float, ...]:
        """Levels that have rooms, ascending."""
        return tuple(sorted({at for s in self.shapes if s.kind in ROOMS for at in s.levels}))


def is_indoor_osm(path: Path) -> bool:
    """Return whether a path looks like an OpenStreetMap file."""
    return path.name.lower().endswith(SUFFIXES) and path.is_file()


def read_indoor_osm(path: str | PathLike[str]) -> IndoorOsm:
    """Read the rooms, walls, doors and buildings of an OpenStreetMap file.

    Raises `InputError` where it is missing, empty, broken, or shows no room.
    """
    import osmium

    path = check_osm(Path(path))
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
            f"{path} has no rooms{why}: no outline is tagged indoor=room, area or corridor, "
            "or osmAG:type=area."
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
        """Yield all that can be drawn; the rest is counted."""
        for osm, tags, refs in self.tagged:
            yield from self._shape(osm, tags, [refs])
        for osm, tags, members in self.relations:
            if any(ref not in self.ways for ref, _ in members):
                self.left_out["multipolygons with missing members"] += 1
            pieces = [self.ways[ref] for ref, _ in members if ref in self.ways]
            yield from self._shape(osm, tags, _join_ways(pieces))

    def _shape(
        self, osm: str, tags: dict[str, str], lines: list[list[int]]
    ) -> Iterator[IndoorShape]:
        kind = find_kind(tags)
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
            levels = {
                *parse_levels(tags.get("level", "")),
                *parse_levels(tags.get("repeat_on", "")),
            }
            yield IndoorShape(osm, kind, tuple(sorted(levels)), tags, parts)
        else:
            self.left_out[f"{kind}s without an outline"] += 1

    def _ring(self, part: Floats, kind: str) -> Floats:
        """Return the closed ring of an outline; empty where it is none."""
        if len(part) > MAX_POINTS:
            self.left_out[f"{kind}s of more than {MAX_POINTS} points"] += 1
            return part[:0]
        moves = np.ones(len(part), np.bool_)
        moves[1:] = (np.diff(part, axis=0) != 0).any(axis=1)
        part = part[moves]
        if len(part) and (part[0] != part[-1]).any():
            if kind in ROOMS:
                self.left_out["outlines that were open, and are closed"] += 1
            part = np.concatenate([part, part[:1]])
        return part if len(part) > 3 else part[:0]


def find_kind(tags: Mapping[str, str]) -> str:
    """Return the kind of an element by its tags; empty where it is none of `KINDS`."""
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
    """Return the name of each room: its own, its number, or what it is; those that are alike are numbered."""
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


def _join_ways(pieces: Sequence[Sequence[int]]) -> list[list[int]]:
    """Return the member ways of a multipolygon, end to end: as few lines as they make."""
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


OSMAG_ENDINGS = (".osmag", ".osmag.osm", ".osmag.xml")
"""Endings of files that are written as osmAG."""
BESIDE = 0.6
"""Farthest that a door may be from the outline of its room [m]."""
_METRES = 111_200.0  # per degree of latitude, to a few per mille: what is compared is near
_AREA_TYPES = {"corridor": "corridor", "elevator": "elevator", "stairs": "stairs"}


def encode_rooms(shapes: Sequence[IndoorShape], *, osmag: bool, generator: str) -> bytes:
    """Return the OSM-XML of rooms, and of doors as nodes of their outlines or, of osmAG, as passages.

    Parameters
    ----------
    shapes
        Rooms, corridors, areas, and doors as lines of two ends; the rest is passed over.
    osmag
        Whether it is osmAG: rooms then need names that differ.

    """
    file = _File()
    rooms = [s for s in shapes if s.kind in ROOMS]
    doors = [(s, *_walls_at(s, rooms)) for s in shapes if s.kind == "door"]
    if osmag:
        middle = np.concatenate([part for s in rooms for part in s.parts]).mean(axis=0)
        file.node(middle, {"name": "root"})
        names = room_names(rooms)
        for room, name in zip(rooms, names, strict=True):
            _write(file, room, _osmag_area(room) | {"name": name})
        for door, held, line in doors:
            refs = [file.node(at) for at in line]
            ends = [*(names[k] for k in held), "outside", "outside"]
            tags = {"osmAG:type": "passage", "osmAG:from": ends[0], "osmAG:to": ends[1]}
            file.way(refs, tags | _kept_tags(door.tags, ("level", "height", "width", "name")))
    else:
        rooms = [_with_doors(room, k, doors) for k, room in enumerate(rooms)]
        for door, _, line in doors:
            file.node(line.mean(axis=0), {"door": "yes"} | door.tags)
        for room in rooms:
            _write(file, room, {"indoor": room.kind} | room.tags)
    return file.encode(generator)


class _File:
    """Elements with their ids."""

    def __init__(self) -> None:
        self.ids = count(-1, -1)
        self.nodes: dict[tuple[int, int], int] = {}
        self.places: list[tuple[int, Floats]] = []
        self.tags: dict[int, dict[str, str]] = {}
        self.ways: list[str] = []

    def node(self, at: Floats, tags: Mapping[str, str] | None = None) -> int:
        key = round(float(at[0]) * 1e7), round(float(at[1]) * 1e7)
        if key not in self.nodes:
            self.nodes[key] = next(self.ids)
            self.places.append((self.nodes[key], at))
        self.tags.setdefault(self.nodes[key], {}).update(tags or {})
        return self.nodes[key]

    def way(self, refs: Sequence[int], tags: Mapping[str, str]) -> int:
        id_ = next(self.ids)
        nodes = "".join(f'<nd ref="{ref}"/>' for ref in refs)
        self.ways.append(
            f'  <way id="{id_}" version="0" visible="true">{nodes}{_tags(tags)}</way>\n'
        )
        return id_

    def relation(self, members: Sequence[tuple[int, str]], tags: Mapping[str, str]) -> None:
        held = "".join(f'<member type="way" ref="{ref}" role="{role}"/>' for ref, role in members)
        self.ways.append(
            f'  <relation id="{next(self.ids)}" visible="true">{held}{_tags(tags)}</relation>\n'
        )

    def encode(self, generator: str) -> bytes:
        head = '<?xml version="1.0" encoding="UTF-8"?>\n'
        head += f'<osm version="0.6" generator={quoteattr(generator)} upload="false">\n'
        nodes = [
            f'  <node id="{id_}" visible="true" lat="{at[1]:.9f}" lon="{at[0]:.9f}">'
            f"{_tags(self.tags[id_])}</node>\n"
            for id_, at in self.places
        ]
        ways = [text for text in self.ways if text.startswith("  <way")]
        relations = [text for text in self.ways if not text.startswith("  <way")]
        return "".join([head, *nodes, *ways, *relations, "</osm>\n"]).encode()


def _write(file: _File, room: IndoorShape, tags: dict[str, str]) -> None:
    """Return the element of a room: a way, or a multipolygon if it has holes."""
    refs = [[file.node(at) for at in part[:-1]] for part in room.parts]
    closed = [[*ring, ring[0]] for ring in refs]
    if len(closed) == 1:
        file.way(closed[0], tags)
        return
    ways = [file.way(ring, {}) for ring in closed]
    roles = [(way, "inner" if k else "outer") for k, way in enumerate(ways)]
    file.relation(roles, {"type": "multipolygon"} | tags)


def _osmag_area(room: IndoorShape) -> dict[str, str]:
    kind = room.tags.get("room") or room.kind
    said = {"osmAG:type": "area", "osmAG:areaType": _AREA_TYPES.get(kind, "room")}
    return said | _kept_tags(room.tags, ("level", "height", "ref", "osmAG:parent"))


def _kept_tags(tags: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    return {name: tags[name] for name in names if tags.get(name)}


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items() if v)


def _walls_at(door: IndoorShape, rooms: Sequence[IndoorShape]) -> tuple[list[int], Floats]:
    """Return rows of the rooms whose outlines a door is on, the nearest first, and its ends (2, 2)."""
    line = door.parts[0][[0, -1]]
    middle = line.mean(axis=0)
    reach = 1.1 * BESIDE / _METRES / np.array([max(0.01, np.cos(np.radians(middle[1]))), 1.0])
    near = [
        (k, room)
        for k, room in enumerate(rooms)
        if any(
            (p.min(axis=0) - reach <= middle).all() and (middle <= p.max(axis=0) + reach).all()
            for p in room.parts
        )
    ]
    found = sorted((_nearest(middle, room.parts), k) for k, room in near)
    held = [k for (far, *_), k in found if far < BESIDE]
    if not held:
        return [], line
    _, ring, edge, share = found[0][0]
    a, b = rooms[held[0]].parts[ring][edge : edge + 2]
    return held, line + (a + share * (b - a) - middle)


def _nearest(at: Floats, parts: Sequence[Floats]) -> tuple[float, int, int, float]:
    """Return the distance of a place (2,) [deg] from outlines [m]; ring, edge, and position on it, 0 to 1."""
    scale = _METRES * np.array([np.cos(np.radians(at[1])), 1.0])
    best = (np.inf, 0, 0, 0.0)
    for k, part in enumerate(parts):
        points = (part - at) * scale
        along = np.diff(points, axis=0)
        squared = np.maximum((along**2).sum(axis=1), 1e-12)
        share = np.clip(-(points[:-1] * along).sum(axis=1) / squared, 0.0, 1.0)
        far = np.linalg.norm(points[:-1] + share[:, None] * along, axis=1)
        edge = int(far.argmin())
        best = min(best, (float(far[edge]), k, edge, float(share[edge])))
    return best


def _with_doors(
    room: IndoorShape, row: int, doors: Sequence[tuple[IndoorShape, list[int], Floats]]
) -> IndoorShape:
    """Return a room whose outline goes through the doors that are on it."""
    parts = list(room.parts)
    for _, held, line in doors:
        if row not in held:
            continue
        at = line.mean(axis=0)
        far, ring, edge, share = _nearest(at, parts)
        if far < 0.05 and 0.0 < share < 1.0:
            parts[ring] = np.insert(parts[ring], edge + 1, at, axis=0)
    return room._replace(parts=parts)
