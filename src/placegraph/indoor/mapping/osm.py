"""OpenStreetMap's rooms as rough scene maps, and scene maps as OpenStreetMap's rooms."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.core.geojson import contains_points
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.map.floor import LEVEL, is_floor, split_label
from placegraph.indoor.map.rooms import find_rooms
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.from_capture import Source
from placegraph.indoor.mapping.outlines import (
    LEAST_AREA,
    area,
    find_outlines,
    make_polygons,
    trace_cells,
    triangulate,
)
from placegraph.io.mesh.model import Model, ModelObject, Texture
from placegraph.io.osm.indoor_osm import (
    ROOMS,
    IndoorOsm,
    IndoorShape,
    format_level,
    parse_levels,
    read_indoor_osm,
    room_names,
)

HEIGHT = 2.8  # Of rooms, where nobody said [m]
DOOR = (0.9, 2.05)  # Width and height of doors, where nobody said [m]
SLAB = 0.3  # Of a storey's height that is no room [m]
SPREAD = 2000.0  # Over which the rooms of one building may be spread [m]
SIGMA = (1.0, 1.0, 50.0, np.radians(1.0))
"""Standard deviation of a plan in OpenStreetMap: east, north, up (unknown) [m]; rotation [rad]."""
_LOW, _HIGH = 1.8, 40.0  # of what may be the height of a room [m]
_LENGTH = re.compile(r"\s*(\d{1,3}(?:[.,]\d{1,3})?)\s*(m|cm)?\s*", re.ASCII)


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A room, corridor or area."""

    shape: IndoorShape
    name: str  # Unique among the rooms of the level
    polygons: list[list[Floats]]  # Closed rings (n, 2) [m, map]: the outer one, then holes
    height: float  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class Door:
    """An opening."""

    shape: IndoorShape
    at: Floats  # (2,) its middle [m, map]
    width: float  # [m]
    height: float  # [m]


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One level of a building."""

    anchor: Anchor
    rooms: list[Room]
    walls: list[Floats]  # Lines (n, 2) [m, map] of walls that are no room's
    doors: list[Door]
    storey: float  # Height of rooms and walls where nobody says [m]
    notes: tuple[str, ...]


def select_level(plan: IndoorOsm, level: float | None) -> Level:
    """Select one level of a file's rooms; what has no level is on all where it is a door, else on level 0.

    Raises `OptionError`: there are several levels and none is chosen, or there is none such;
    `InputError`: the rooms are spread over more than a building.
    """
    levels, notes = plan.levels, []
    nowhere = sum(s.kind in ROOMS and not s.levels for s in plan.shapes)
    if nowhere:
        levels = tuple(sorted({*levels, 0.0}))
        notes.append(f"{nowhere:,} rooms have no level and are assumed to be on level 0.")
    known = ", ".join(map(format_level, levels))
    if level is None and len(levels) > 1:
        raise OptionError(
            f"{plan.path} has the levels {known}; choose one (--level {levels[0]:g})."
        )
    chosen = levels[0] if level is None else float(level)
    if chosen not in levels:
        raise OptionError(f"{plan.path} has no rooms on level {chosen:g}; it has {known}.")
    everywhere = {"door", "building"}
    shapes = [
        s for s in plan.shapes
        if chosen in (s.levels or ((chosen,) if s.kind in everywhere else (0.0,)))
    ]  # fmt: skip
    held = [s for s in shapes if s.kind in ROOMS]
    points = np.concatenate([part for shape in held for part in shape.parts])
    anchor = _make_anchor(plan, chosen, points)
    east, north = np.ptp(_project(anchor, points), axis=0)
    if max(east, north) > SPREAD:
        raise InputError(
            f"{plan.path}: the rooms on level {chosen:g} are spread over "
            f"{max(east, north) / 1000:,.0f} km; extract one building, for instance with "
            "`osmium extract`."
        )
    storey, note = _find_storey(plan, anchor)
    if not all(_parse_height(shape.tags) for shape in held):
        notes.append(note)
    names = room_names(held)
    rooms = []
    for shape, name in zip(held, names, strict=True):
        found = make_polygons([_project(anchor, part) for part in shape.parts])
        if found:
            rooms.append(Room(shape, name, found, _parse_height(shape.tags) or storey))
        else:
            plan.left_out["rooms without an area"] += 1
    if not rooms:
        raise InputError(f"{plan.path}: no room on level {chosen:g} has an area.")
    return Level(
        anchor=anchor,
        rooms=rooms,
        walls=[_project(anchor, part) for s in shapes if s.kind == "wall" for part in s.parts],
        doors=[_make_door(anchor, s) for s in shapes if s.kind == "door"],
        storey=storey,
        notes=tuple(notes),
    )


def _make_anchor(plan: IndoorOsm, level: float, points: Floats) -> Anchor:
    """Make anchor of the map: its origin is the middle of its rooms, x points east, y north."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    around = [
        s
        for s in plan.shapes
        if s.kind in {"building", "level"}
        and any(contains_points(middle[None], [part])[0] for part in s.parts)
    ]
    around.sort(key=lambda s: (s.kind != "building", "name" not in s.tags))
    house = around[0] if around else None
    return Anchor(
        longitude=float(middle[0]), latitude=float(middle[1]), height=0.0, heading=0.0,
        covariance=np.diag(np.square(SIGMA)),
        building=house.tags.get("name", "") if house else "", osm=house.osm if house else "",
        level=format_level(level), method="OpenStreetMap's rooms",
    )  # fmt: skip


def _project(anchor: Anchor, lonlat: Floats) -> Floats:
    """Project longitudes and latitudes (n, 2) [deg] to (n, 2) [m, map]."""
    heights = np.full((len(lonlat), 1), anchor.height)
    return anchor.to_map(np.concatenate([lonlat, heights], axis=1))[:, :2]


def _find_storey(plan: IndoorOsm, anchor: Anchor) -> tuple[float, str]:
    """Find the height of rooms by their building's, or a usual one; also says which."""
    house = next((s for s in plan.shapes if s.osm == anchor.osm), None)
    if house is not None:
        tall = parse_length(house.tags.get("height", ""))
        levels = parse_levels(house.tags.get("building:levels", ""))
        if tall and levels and levels[-1] > 0:
            height = tall / levels[-1] - SLAB
            if _LOW <= height <= _HIGH:
                return (
                    height,
                    f"Rooms are {height:.1f} m high, from their building's height and levels.",
                )
    return HEIGHT, f"Rooms without a height are assumed to be {HEIGHT} m high."


def _parse_height(tags: Mapping[str, str]) -> float | None:
    """Parse the height of a room [m] from its tags; None: nothing that could be."""
    top = parse_length(tags.get("height", ""))
    height = None if top is None else top - (parse_length(tags.get("min_height", "")) or 0.0)
    return height if height is not None and _LOW <= height <= _HIGH else None


def _make_door(anchor: Anchor, shape: IndoorShape) -> Door:
    line = _project(anchor, shape.parts[0])
    wide = float(np.linalg.norm(line[-1] - line[0]))
    width = parse_length(shape.tags.get("width", "")) or (wide if 0.3 < wide < 20.0 else DOOR[0])
    return Door(
        shape,
        line[[0, -1]].mean(axis=0),
        width,
        parse_length(shape.tags.get("height", "")) or DOOR[1],
    )


def parse_length(text: str) -> float | None:
    """Parse a length [m]: ``2.8``, ``2.8 m``, ``90 cm``; None where it is none."""
    match = _LENGTH.fullmatch(text)
    if match is None:
        return None
    metres = float(match[1].replace(",", ".")) * (0.01 if match[2] == "cm" else 1.0)
    return metres if metres > 0 else None


THICK = 0.1  # Of a wall [m]
REACH = 0.35
"""Farthest that a door may stand from its wall, and walls of one door from each other [m]."""
_ON = 0.015  # off an edge that a node may lie to be on it [m]
_LINTEL = 0.1  # least that is left of a wall above a door [m]


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """A straight wall."""

    start: Floats  # (2,) [m, map]
    end: Floats
    height: float  # [m]
    shift: Floats
    """(2,) from its line to its middle [m]: a room ends at its outline, and the wall lies beyond;
    zero between two rooms, which share it."""

    @property
    def along(self) -> Floats:
        """(2,) unit vector from start to end."""
        along: Floats = (self.end - self.start) / self.length
        return along

    @property
    def length(self) -> float:
        """Length from start to end [m]."""
        return float(np.linalg.norm(self.end - self.start))

    def in_line_with(self, other: Wall) -> bool:
        """Return whether the two lie in one line, or nearly: the two faces of one thick wall do."""
        off = max(abs(_cross(self.along, p - self.start)) for p in (other.start, other.end))
        return bool(off < REACH) and abs(float(self.along @ other.along)) > 0.97

    def opening(self, door: Door) -> tuple[float, float, float]:
        """Return start and end of an opening along the wall, beyond its ends too, and height [m]."""
        at, half = float((door.at - self.start) @ self.along), door.width / 2.0
        return at - half, at + half, min(door.height, self.height - _LINTEL)

    def solid(self, doors: list[Door]) -> list[tuple[Floats, Floats, float, float]]:
        """Return the pieces beside openings: from (2,) to (2,), from one height to another [m]."""
        pieces, at = [], 0.0
        for low, high, top in sorted(self.opening(door) for door in doors):
            first, last = max(low, at), min(high, self.length)
            if last <= first:
                continue
            if first > at:
                pieces.append((at, first, 0.0))
            pieces.append((first, last, top))
            at = last
        if at < self.length:
            pieces.append((at, self.length, 0.0))
        base = self.start + self.shift
        return [
            (base + a * self.along, base + b * self.along, z, self.height) for a, b, z in pieces
        ]


def segment_distances(points: Floats, starts: Floats, ends: Floats) -> Floats:
    """Measure distances (N, M) [m] of points (N, 2) to segments (M, 2) and (M, 2)."""
    along = ends - starts
    away = points[:, None] - starts[None]
    share = (away * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12)
    off = away - np.clip(share, 0.0, 1.0)[:, :, None] * along
    distances: Floats = np.sqrt((off**2).sum(axis=2))
    return distances


def find_walls(level: Level) -> list[Wall]:
    """Find the walls of a level: rooms stand in walls, corridors only where they border on nothing else.

    Where an outline has nodes on another's edge, it is cut there, so that shared walls are one.
    """
    rings = [(room, ring) for room in level.rooms for rings in room.polygons for ring in rings]
    nodes = np.unique(np.round(np.concatenate([ring for _, ring in rings]), 2), axis=0)
    found: dict[tuple[float, ...], list[tuple[str, Wall]]] = {}
    for room, ring in rings:
        for start, end in pairwise(np.round(ring, 2)):
            for a, b in pairwise(_split_edge(start, end, nodes)):
                length = float(np.linalg.norm(b - a))
                if length > _ON:
                    key = (*min(a.tolist(), b.tolist()), *max(a.tolist(), b.tolist()))
                    right = np.array([b[1] - a[1], a[0] - b[0]]) / length  # outside of the room
                    wall = Wall(a, b, room.height, right * THICK / 2.0)
                    found.setdefault(key, []).append((room.shape.kind, wall))
    walls = []
    for around in found.values():
        kinds = [kind for kind, _ in around]
        if kinds == ["corridor"] or "room" in kinds:
            first = around[0][1]
            shift = first.shift if len(around) == 1 else np.zeros(2)
            tallest = max(wall.height for _, wall in around)
            walls.append(Wall(first.start, first.end, tallest, shift))
    for line in level.walls:
        walls += [
            Wall(a, b, level.storey, np.zeros(2))
            for a, b in pairwise(line)
            if np.linalg.norm(b - a) > _ON
        ]
    return walls


def _split_edge(start: Floats, end: Floats, nodes: Floats) -> list[Floats]:
    """Split an edge at the nodes of other outlines that lie on it."""
    along, away = end - start, nodes - start
    length = max(float(np.linalg.norm(along)), 1e-9)
    off = np.abs(_cross(along, away)) / length
    share = away @ along / length
    on = np.flatnonzero((off < _ON) & (share > _ON) & (share < length - _ON))
    return [start, *nodes[on[np.argsort(share[on])]], end]


def _cross(a: Floats, b: Floats) -> Floats:
    crossed: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return crossed


def read_rooms(path: Path, options: Mapping[str, Any], left_out: Counter[str]) -> Source:
    """Read one level of an OpenStreetMap file, `options["level"]`, as the source of a scene map.

    Raises `InputError` and `OptionError` as `read_indoor_osm` and `select_level` do.
    """
    if strange := set(options) - {"level"}:
        raise OptionError(
            f"{', '.join(sorted(strange))} is not an option for OpenStreetMap rooms; the "
            "only option is level."
        )
    given = options.get("level")
    wanted = (
        None
        if given is None
        else parse_levels(f"{given:g}" if isinstance(given, float) else str(given))
    )
    if wanted is not None and len(wanted) != 1:
        raise OptionError(f"level is {given!r}; give a number such as 1, -1 or 0.5.")
    plan = read_indoor_osm(path)
    level = select_level(plan, wanted[0] if wanted else None)
    model = build_model(level, path, plan.left_out)
    left_out.update(plan.left_out)
    return Source(model, notes=level.notes, anchors=(level.anchor,))


FRAME = 0.06  # Width of a door's frame [m]
_KEPT = ("ref", "amenity", "shop", "office", "highway", "stairs", "access")  # fmt: skip
_BOX = np.array([(0, 1, 3), (0, 3, 2), (4, 7, 5), (4, 6, 7), (0, 4, 5), (0, 5, 1),
                 (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)])  # fmt: skip


class _ModelBuilder:
    """Things with their triangles, as they come."""

    def __init__(self) -> None:
        self.objects: list[ModelObject] = []
        self.vertices: list[Floats] = []
        self.triangles: list[NDArray[np.int64]] = []
        self.object_of: list[int] = []
        self.count = 0

    def add_object(
        self, label: str, name: str = "", attributes: dict[str, str] | None = None
    ) -> None:
        self.objects.append(ModelObject(str(len(self.objects)), label, name, attributes or {}))

    def add(self, vertices: Floats, triangles: NDArray[np.int64]) -> None:
        """Add triangles to the last object."""
        self.vertices.append(vertices)
        self.triangles.append(triangles + self.count)
        self.object_of.extend([len(self.objects) - 1] * len(triangles))
        self.count += len(vertices)

    def box(self, a: Floats, b: Floats, heights: tuple[float, float], thick: float) -> None:
        """Add a box on the line from a to b (2,) [m], between two heights."""
        along = (b - a) / np.linalg.norm(b - a)
        side = np.array([-along[1], along[0]]) * thick / 2.0
        base = np.stack([a - side, a + side, b - side, b + side])
        corners = [np.column_stack([base, np.full(4, z)]) for z in heights]
        self.add(np.concatenate(corners), _BOX)


def build_model(level: Level, path: Path, left_out: Counter[str]) -> Model:
    """Build the model of a level, its floor at 0 m."""
    parts = _ModelBuilder()
    for room in level.rooms:
        _add_floor_and_ceiling(parts, room)
    walls = find_walls(level)
    opened: list[list[Door]] = [[] for _ in walls]
    starts, ends = (
        np.reshape([getattr(w, end) for w in walls], (-1, 2)) for end in ("start", "end")
    )
    for door in level.doors:
        far = segment_distances(door.at[None], starts, ends)[0]
        if far.min(initial=np.inf) > REACH:
            left_out["doors that lie on no wall"] += 1
            continue
        nearest = walls[int(far.argmin())]
        for row in np.flatnonzero(far < REACH + door.width / 2.0).tolist():
            if walls[row].in_line_with(nearest):
                opened[row].append(door)
        _add_frame(parts, nearest, door)
    for wall, doors in zip(walls, opened, strict=True):
        pieces = wall.solid(doors)
        if pieces:
            parts.add_object("wall")
        for start, end, low, high in pieces:
            parts.box(start, end, (low, high), THICK)
    vertices = np.concatenate(parts.vertices)
    triangles = np.concatenate(parts.triangles)
    return Model(
        path=path, objects=tuple(parts.objects), vertices=vertices, triangles=triangles,
        object_of=np.array(parts.object_of, np.int64),
        colours=np.full((len(vertices), 3), 255, np.uint8), uv=np.zeros((len(vertices), 2)),
        picture_of=np.zeros(len(triangles), np.int64), pictures=(Texture(None),), floor=0.0,
    )  # fmt: skip


def _add_floor_and_ceiling(parts: _ModelBuilder, room: Room) -> None:
    tags = room.shape.tags
    attributes = {key: tags[key] for key in _KEPT if key in tags}
    kind = tags.get("room") or tags.get("osmAG:areaType", "room")
    if kind not in {"room", room.shape.kind}:
        attributes["kind"] = kind
    attributes |= {"room": room.name, "indoor": room.shape.kind, "osm": room.shape.osm}
    for label, z in (("floor", 0.0), ("ceiling", room.height)):
        parts.add_object(
            label,
            tags.get("name", "") if not z else "",
            attributes if not z else {"room": room.name},
        )
        for rings in room.polygons:
            points, triangles = triangulate(rings)
            turned = triangles if not z else triangles[:, ::-1]
            parts.add(np.column_stack([points, np.full(len(points), z)]), turned)


def _add_frame(parts: _ModelBuilder, wall: Wall, door: Door) -> None:
    """Add the frame of a door, as it stands open."""
    low, high, top = wall.opening(door)
    if high - low < 3.0 * FRAME:
        return
    tags = door.shape.tags
    attributes = {k: tags[k] for k in ("entrance", "door", "ref") if k in tags}
    parts.add_object("door", tags.get("name", ""), attributes | {"osm": door.shape.osm})
    base = wall.start + wall.shift
    for start, end, bottom in (
        (low, low + FRAME, 0.0), (high - FRAME, high, 0.0), (low, high, top - FRAME),
    ):  # fmt: skip
        ends = base + start * wall.along, base + end * wall.along
        parts.box(*ends, (bottom, top), 1.4 * THICK)


_DOORS = frozenset({"door", "doorway", "doors"})
_SAID = ("indoor", "ref", "amenity", "shop", "office", "highway", "stairs", "access")


def export_shapes(scene: Scene) -> list[IndoorShape]:
    """Export rooms and doors of a map in longitude and latitude, by the best anchor of each scene.

    A room is outlined by its own floor; where floors go through several rooms, by the free floor,
    to a decimetre.

    Raises `OptionError`: a scene has no anchor, or no room.
    """
    shapes = []
    for s, name in enumerate(scene.scenes):
        anchors = scene.anchors_of(name)
        if not anchors:
            raise OptionError(
                f"{name!r} is not georeferenced, which OpenStreetMap needs; anchor it with "
                "`placegraph scene anchor`."
            )
        rows = np.flatnonzero(scene.scene_of == s)
        shapes += _export_rooms(scene, s, rows, anchors[0])
        shapes += _export_doors(scene, s, rows, anchors[0])
    if not any(shape.kind in ROOMS for shape in shapes):
        raise OptionError(
            "The map has no rooms, neither labelled floors nor free floor between walls; label "
            "the floors."
        )
    return shapes


def _export_rooms(
    scene: Scene, s: int, rows: NDArray[np.int64], anchor: Anchor
) -> list[IndoorShape]:
    floor, found = float(scene.floors[s]), []
    outlined = {
        row: _outline_floor(scene, row)
        for row in rows.tolist()
        if is_floor(scene.graph.labels[row])
    }
    names = [scene.attributes[row].get("room", "") for row in outlined]
    own = len(set(names)) == len(names) > 0 and all(names)
    if own and all(outlined.values()):
        for row, rings in outlined.items():
            attributes = scene.attributes[row]
            tags = {k: attributes[k] for k in _SAID if k in attributes and k != "indoor"}
            kind = attributes.get("indoor", "room")
            numbered = {"ref": attributes["room"]} if attributes["room"].isdecimal() else {}
            named = _own_name(scene, row) or (
                "" if numbered or _is_generic(attributes) else attributes["room"]
            )
            tags = numbered | tags | {"name": named, "room": attributes.get("kind", "")}
            height = _find_ceiling(scene, rows, attributes["room"], floor)
            found.append(_make_room(anchor, f"way/{row}", kind, rings, tags, (floor, height)))
        return found
    rooms = find_rooms(scene.mesh, scene.graph.labels, floor)
    for k in range(len(rooms)):
        inside = [scene.attributes[row].get("room", "") for row in rows[rooms.room_of[rows] == k]]
        name = max(set(inside), key=inside.count) if inside else ""
        tags = {"name": "" if name.isdecimal() else name, "ref": name if name.isdecimal() else ""}
        rings = trace_cells(rooms.cells == k, rooms.origin, rooms.cell)
        if rings:
            found.append(_make_room(anchor, f"way/{k}", "room", rings, tags, (floor, None)))
    return found


def _is_generic(attributes: dict[str, str]) -> bool:
    """Return whether a room's name says what it is, and no more: it was given when the map was made."""
    kind = (attributes.get("kind") or attributes.get("indoor", "")).replace("_", " ")
    return bool(kind) and attributes["room"].rstrip(" 0123456789") == kind


def _make_room(
    anchor: Anchor,
    osm: str,
    kind: str,
    rings: list[Floats],
    tags: dict[str, str],
    heights: tuple[float, float | None],
) -> IndoorShape:
    level, (floor, top) = anchor.level or "0", heights
    attributes = {"level": level} | {k: v for k, v in tags.items() if v}
    if top is not None:
        attributes["height"] = f"{top - floor:.2f}"
    parts = [_to_lonlat(anchor, ring, floor) for ring in rings]
    return IndoorShape(osm, kind if kind in ROOMS else "room", (), attributes, parts)


def _to_lonlat(anchor: Anchor, points: Floats, height: float) -> Floats:
    there: Floats = anchor.to_earth(np.column_stack([points, np.full(len(points), height)]))[:, :2]
    return there


def _outline_floor(scene: Scene, row: int) -> list[Floats]:
    """Outline a floor by closed rings (n, 2) [m, map]; empty where its triangles make none."""
    mesh = scene.mesh
    triangles = mesh.triangles[mesh.object_of == row].astype(np.int64)
    corners = mesh.vertices[triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.abs(normals[:, 2]) > LEVEL * np.linalg.norm(normals, axis=1)
    rings = find_outlines(mesh.vertices[:, :2].astype(np.float64), triangles[level])
    rings = [ring for ring in rings if abs(area(ring)) > LEAST_AREA]
    return sorted(rings, key=lambda ring: -abs(area(ring)))


def _find_ceiling(scene: Scene, rows: NDArray[np.int64], room: str, floor: float) -> float | None:
    """Find height of a room's ceiling [m, map], or of the others'; None where there is none."""
    above: dict[bool, list[float]] = {True: [], False: []}
    for row in rows.tolist():
        words = split_label(scene.graph.labels[row])
        height = float(scene.graph.positions[row, 2])
        if words and words[-1] == "ceiling" and height > floor + 1.0:
            above[scene.attributes[row].get("room") == room].append(height)
    heights = above[True] or above[False]
    return float(np.median(heights)) if heights else None


def _export_doors(
    scene: Scene, s: int, rows: NDArray[np.int64], anchor: Anchor
) -> list[IndoorShape]:
    graph, floor, found = scene.graph, float(scene.floors[s]), []
    for row in rows.tolist():
        words = split_label(graph.labels[row])
        if not words or words[-1] not in _DOORS or graph.extents is None:
            continue
        ends = find_ends(scene, row)
        width, height = float(np.linalg.norm(ends[1] - ends[0])), float(graph.extents[row, 2])
        attributes = {
            k: scene.attributes[row][k]
            for k in ("entrance", "door", "ref")
            if k in scene.attributes[row]
        }
        attributes |= {
            "level": anchor.level or "0",
            "width": f"{width:.2f}",
            "name": _own_name(scene, row),
        }
        attributes["height"] = f"{height:.2f}"
        found.append(
            IndoorShape(f"node/{row}", "door", (), attributes, [_to_lonlat(anchor, ends, floor)])
        )
    return found


def find_ends(scene: Scene, row: int) -> Floats:
    """Find the ends (2, 2) of a door or window seen from above [m, map], along its width."""
    mesh = scene.mesh
    corners = mesh.vertices[mesh.triangles[mesh.object_of == row], :2].reshape(-1, 2)
    points = np.unique(corners.astype(np.float64), axis=0)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    _, axes = np.linalg.eigh(np.cov((points - middle).T))
    along = (points - middle) @ axes[:, 1]
    ends: Floats = middle + np.array([[along.min()], [along.max()]]) * axes[:, 1]
    return ends


def _own_name(scene: Scene, row: int) -> str:
    """Name of an object, unless it only says again what it is, as "floor 1"."""
    name, label = scene.graph.names[row], scene.graph.labels[row]
    return "" if name.casefold().rstrip(" 0123456789_.-") == label.casefold() else name
