"""Writers of rooms as OSM-XML, for JOSM and for robots: Simple Indoor Tagging, and osmAG.

Ids are negative, as of what no server knows yet. Places at the same 1e-7 degrees, a centimetre, are
one node, so that rooms share their walls.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import count
from xml.sax.saxutils import quoteattr

import numpy as np

from placegraph.core.geometry import Floats
from placegraph.io.osm.indoor_osm import ROOMS, IndoorShape, room_names

OSMAG_ENDINGS = (".osmag", ".osmag.osm", ".osmag.xml")
"""Of files that become osmAG."""
BESIDE = 0.6
"""Farthest that a door may be from the outline of its room [m]."""
_METRES = 111_200.0  # per degree of latitude, to a few per mille: what is compared is near
_AREA_TYPES = {"corridor": "corridor", "elevator": "elevator", "stairs": "stairs"}


def encode_rooms(shapes: Sequence[IndoorShape], *, osmag: bool, generator: str) -> bytes:
    """OSM-XML of rooms, and of doors as nodes of their outlines or, of osmAG, as passages.

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
            file.way(refs, tags | _kept(door.tags, ("level", "height", "width", "name")))
    else:
        rooms = [_with_doors(room, k, doors) for k, room in enumerate(rooms)]
        for door, _, line in doors:
            file.node(line.mean(axis=0), {"door": "yes"} | door.tags)
        for room in rooms:
            _write(file, room, {"indoor": room.kind} | room.tags)
    return file.encoded(generator)


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

    def encoded(self, generator: str) -> bytes:
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
    """A room: one way, or a multipolygon where it has holes."""
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
    return said | _kept(room.tags, ("level", "height", "ref", "osmAG:parent"))


def _kept(tags: Mapping[str, str], names: Sequence[str]) -> dict[str, str]:
    return {name: tags[name] for name in names if tags.get(name)}


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f"<tag k={quoteattr(k)} v={quoteattr(v)}/>" for k, v in tags.items() if v)


def _walls_at(door: IndoorShape, rooms: Sequence[IndoorShape]) -> tuple[list[int], Floats]:
    """Rows of the rooms whose outlines a door is on, the nearest first, and its ends (2, 2) on it."""
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
    """How far a place (2,) [deg] is from outlines [m]; ring and edge, and where on it, 0 to 1."""
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
    """A room whose outline goes through the doors that are on it."""
    parts = list(room.parts)
    for _, held, line in doors:
        if row not in held:
            continue
        at = line.mean(axis=0)
        far, ring, edge, share = _nearest(at, parts)
        if far < 0.05 and 0.0 < share < 1.0:
            parts[ring] = np.insert(parts[ring], edge + 1, at, axis=0)
    return room._replace(parts=parts)
