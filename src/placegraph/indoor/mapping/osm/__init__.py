"""OpenStreetMap's rooms as rough scene maps, and scene maps as OpenStreetMap's rooms."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.mapping.from_capture import Source
from placegraph.indoor.mapping.osm.outlines import triangulated
from placegraph.indoor.mapping.osm.rooms import Door, Level, Room, level_of
from placegraph.indoor.mapping.osm.walls import REACH, THICK, Wall, distances, walls_of
from placegraph.io.mesh.model import Model, Picture, Thing
from placegraph.io.osm.indoor_osm import read_indoor_osm
from placegraph.io.osm.levels import levels_of


def rooms_source(path: Path, options: Mapping[str, Any], left_out: Counter[str]) -> Source:
    """Source of a scene map of one level of an OpenStreetMap file, `options["level"]`.

    Raises `InputError` and `OptionError` as `read_indoor_osm` and `level_of` do.
    """
    if strange := set(options) - {"level"}:
        raise OptionError(
            f"{', '.join(sorted(strange))}: no option of OpenStreetMap's rooms; it has level."
        )
    given = options.get("level")
    wanted = (
        None
        if given is None
        else levels_of(f"{given:g}" if isinstance(given, float) else str(given))
    )
    if wanted is not None and len(wanted) != 1:
        raise OptionError(f"level is {given!r}; give one, as 1 or -1 or 0.5.")
    plan = read_indoor_osm(path)
    level = level_of(plan, wanted[0] if wanted else None)
    model = model_of(level, path, plan.left_out)
    left_out.update(plan.left_out)
    return Source(model, notes=level.notes, anchors=(level.anchor,))


FRAME = 0.06
"""Width of a door's frame [m]."""
_KEPT = ("ref", "amenity", "shop", "office", "highway", "stairs", "access")  # fmt: skip
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

    def box(self, a: Floats, b: Floats, heights: tuple[float, float], thick: float) -> None:
        """A box that stands on the line from a to b (2,) [m], between two heights."""
        along = (b - a) / np.linalg.norm(b - a)
        side = np.array([-along[1], along[0]]) * thick / 2.0
        base = np.stack([a - side, a + side, b - side, b + side])
        corners = [np.column_stack([base, np.full(4, z)]) for z in heights]
        self.add(np.concatenate(corners), _BOX)


def model_of(level: Level, path: Path, left_out: Counter[str]) -> Model:
    """Model of a level, its floor at 0 m."""
    parts = _Parts()
    for room in level.rooms:
        _floor_and_ceiling(parts, room)
    walls = walls_of(level)
    opened: list[list[Door]] = [[] for _ in walls]
    for door in level.doors:
        far = distances(walls, door.at) if walls else np.full(1, np.inf)
        if far.min() > REACH:
            left_out["doors that are on no wall"] += 1
            continue
        nearest = walls[int(far.argmin())]
        for row in np.flatnonzero(far < REACH + door.width / 2.0).tolist():
            if walls[row].in_line_with(nearest):
                opened[row].append(door)
        _frame(parts, nearest, door)
    for wall, doors in zip(walls, opened, strict=True):
        pieces = wall.solid(doors)
        if pieces:
            parts.thing("wall")
        for start, end, low, high in pieces:
            parts.box(start, end, (low, high), THICK)
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
    said = {key: tags[key] for key in _KEPT if key in tags}
    kind = tags.get("room") or tags.get("osmAG:areaType", "room")
    if kind not in {"room", room.shape.kind}:
        said["kind"] = kind
    said |= {"room": room.name, "indoor": room.shape.kind, "osm": room.shape.osm}
    for label, z in (("floor", 0.0), ("ceiling", room.height)):
        parts.thing(
            label, tags.get("name", "") if not z else "", said if not z else {"room": room.name}
        )
        for rings in room.polygons:
            points, triangles = triangulated(rings)
            turned = triangles if not z else triangles[:, ::-1]
            parts.add(np.column_stack([points, np.full(len(points), z)]), turned)


def _frame(parts: _Parts, wall: Wall, door: Door) -> None:
    """The frame of a door: what there is of it while it stands open."""
    low, high, top = wall.opening(door)
    if high - low < 3.0 * FRAME:
        return
    tags = door.shape.tags
    said = {k: tags[k] for k in ("entrance", "door", "ref") if k in tags}
    parts.thing("door", tags.get("name", ""), said | {"osm": door.shape.osm})
    base = wall.start + wall.shift
    for start, end, bottom in (
        (low, low + FRAME, 0.0), (high - FRAME, high, 0.0), (low, high, top - FRAME),
    ):  # fmt: skip
        ends = base + start * wall.along, base + end * wall.along
        parts.box(*ends, (bottom, top), 1.4 * THICK)
