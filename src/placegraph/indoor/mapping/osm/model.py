"""A rough model of rooms: floors, ceilings, and thin walls with openings where doors are."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from placegraph.formats.mesh.model import Model, Picture, Thing
from placegraph.indoor.mapping.osm.outlines import triangulated

if TYPE_CHECKING:
    from collections import Counter
    from pathlib import Path

    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.indoor.mapping.osm.rooms import Door, Level, Room

THICK = 0.1
"""Of a wall [m]."""
FRAME = 0.06
"""Width of a door's frame [m]."""
REACH = 0.35
"""Farthest that a door may stand from its wall [m]."""
_LINTEL = 0.1  # least that is left of a wall above a door [m]
_KEPT = ("indoor", "room", "ref", "level", "repeat_on", "amenity", "shop", "office", "highway", "stairs",
         "access", "osmAG:areaType")  # fmt: skip
_BOX = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 4, 5), (0, 5, 1),
                 (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip


class _Parts:
    """Things with their triangles, as they come."""

    def __init__(self) -> None:
        self.things: list[Thing] = []
        self.vertices: list[Floats] = []
        self.triangles: list[NDArray[np.int64]] = []
        self.thing_of: list[int] = []
        self.count = 0

    def thing(self, label: str, name: str = "", attributes: dict[str, str] | None = None) -> None:
        self.things.append(Thing(str(len(self.things)), label, name, attributes or {}))

    def add(self, vertices: Floats, triangles: NDArray[np.int64]) -> None:
        """Triangles of the last thing."""
        self.vertices.append(vertices)
        self.triangles.append(triangles + self.count)
        self.thing_of.extend([len(self.things) - 1] * len(triangles))
        self.count += len(vertices)

    def box(self, a: Floats, b: Floats, low: float, high: float, thick: float) -> None:
        """A box that stands on the line from a to b (2,) [m], from one height to another."""
        along = (b - a) / np.linalg.norm(b - a)
        side = np.array([-along[1], along[0]]) * thick / 2.0
        base = np.stack([a - side, a + side, b - side, b + side])
        corners = [np.column_stack([base, np.full(4, z)]) for z in (low, high)]
        self.add(np.concatenate(corners), _BOX)


def model_of(level: Level, path: Path, left_out: Counter[str]) -> Model:
    """Model of a level, its floor at 0 m."""
    parts = _Parts()
    for room in level.rooms:
        _floor_and_ceiling(parts, room)
    edges = _edges(level)
    opened: dict[tuple[float, ...], list[Door]] = {edge: [] for edge in edges}
    for door in level.doors:
        near = [edge for edge in edges if _distance(edge, door.at) < REACH]
        if not near:
            left_out["doors that are on no wall"] += 1
            continue
        nearest = min(near, key=lambda edge: _distance(edge, door.at))
        for edge in near:
            if edge == nearest or _parallel(edge, nearest):
                opened[edge].append(door)
        _frame(parts, nearest, door, edges[nearest])
    for edge, doors in opened.items():
        parts.thing("wall")
        _wall(parts, edge, edges[edge], doors)
    vertices = np.concatenate(parts.vertices)
    triangles = np.concatenate(parts.triangles)
    return Model(
        path=path, things=tuple(parts.things), vertices=vertices, triangles=triangles,
        thing_of=np.array(parts.thing_of, np.int64),
        colours=np.full((len(vertices), 3), 255, np.uint8), uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(len(triangles), np.int64), pictures=(Picture(None),), floor=0.0,
    )  # fmt: skip


def _floor_and_ceiling(parts: _Parts, room: Room) -> None:
    tags = room.shape.tags
    said = {key: tags[key] for key in _KEPT if key in tags and key != "room"}
    if "room" in tags:
        said["kind"] = tags["room"]
    said |= {"room": room.name, "indoor": room.shape.kind, "osm": room.shape.osm}
    for label, z in (("floor", 0.0), ("ceiling", room.height)):
        parts.thing(label, tags.get("name", "") if not z else "", said if not z else {"room": room.name})
        for rings in room.polygons:
            points, triangles = triangulated(rings)
            turned = triangles if not z else triangles[:, ::-1]
            parts.add(np.column_stack([points, np.full(len(points), z)]), turned)


def _edges(level: Level) -> dict[tuple[float, ...], float]:
    """Walls by their ends (x, y, x, y) [m], each once, with their heights [m].

    Rooms stand in walls; corridors where they border on nothing else; areas in none.
    """
    bounds: dict[tuple[float, ...], list[tuple[str, float]]] = {}
    for room in level.rooms:
        for ring in (ring for rings in room.polygons for ring in rings):
            for a, b in pairwise(np.round(ring, 2).tolist()):
                if a != b:
                    key = (*min(a, b), *max(a, b))
                    bounds.setdefault(key, []).append((room.shape.kind, room.height))
    walls = {
        edge: max(height for _, height in around)
        for edge, around in bounds.items()
        if any(kind == "room" for kind, _ in around) or [kind for kind, _ in around] == ["corridor"]
    }
    for line in level.walls:
        for a, b in pairwise(np.round(line, 2).tolist()):
            if a != b:
                walls.setdefault((*min(a, b), *max(a, b)), level.storey)
    return walls


def _ends(edge: tuple[float, ...]) -> tuple[Floats, Floats, float]:
    """Start and end (2,), and length [m]."""
    a, b = np.array(edge[:2]), np.array(edge[2:])
    return a, b, float(np.linalg.norm(b - a))


def _distance(edge: tuple[float, ...], at: Floats) -> float:
    a, b, length = _ends(edge)
    share = np.clip((at - a) @ (b - a) / length**2, 0.0, 1.0)
    return float(np.linalg.norm(at - a - share * (b - a)))


def _parallel(edge: tuple[float, ...], other: tuple[float, ...]) -> bool:
    (a, b, length), (c, d, reach) = _ends(edge), _ends(other)
    return bool(abs((b - a) @ (d - c)) > 0.97 * length * reach)


def _opening(edge: tuple[float, ...], door: Door, height: float) -> tuple[float, float, float]:
    """Where on a wall an opening begins and ends [m], and how high it is [m]."""
    a, b, length = _ends(edge)
    at = float((door.at - a) @ (b - a) / length)
    low, high = max(0.0, at - door.width / 2.0), min(length, at + door.width / 2.0)
    return low, high, min(door.height, height - _LINTEL)


def _wall(parts: _Parts, edge: tuple[float, ...], height: float, doors: list[Door]) -> None:
    a, b, length = _ends(edge)
    along, at = (b - a) / length, 0.0
    for low, high, top in sorted(_opening(edge, door, height) for door in doors):
        if high - max(low, at) <= 0.0:
            continue
        if low > at:
            parts.box(a + along * at, a + along * low, 0.0, height, THICK)
        parts.box(a + along * max(low, at), a + along * high, top, height, THICK)
        at = high
    if at < length:
        parts.box(a + along * at, b, 0.0, height, THICK)


def _frame(parts: _Parts, edge: tuple[float, ...], door: Door, height: float) -> None:
    """The frame of a door: what there is of it while it stands open."""
    a, b, length = _ends(edge)
    along = (b - a) / length
    low, high, top = _opening(edge, door, height)
    if high - low < 3.0 * FRAME:
        return
    tags = door.shape.tags
    said = {k: tags[k] for k in ("entrance", "door", "ref") if k in tags}
    parts.thing("door", tags.get("name", ""), said | {"osm": door.shape.osm})
    for start, end, bottom in (
        (low, low + FRAME, 0.0), (high - FRAME, high, 0.0), (low, high, top - FRAME),
    ):  # fmt: skip
        parts.box(a + along * start, a + along * end, bottom, top, 1.4 * THICK)
