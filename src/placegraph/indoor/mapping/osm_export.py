"""Rooms of an anchored scene map, as OpenStreetMap has them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.map.floor import LEVEL, is_floor, label_words
from placegraph.indoor.map.rooms import rooms_of
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.outlines import LEAST_AREA, area, outlines_of, rings_of_cells
from placegraph.io.osm.indoor_osm import ROOMS, IndoorShape

_DOORS = frozenset({"door", "doorway", "doors"})
_SAID = ("indoor", "ref", "amenity", "shop", "office", "highway", "stairs", "access")


def shapes_of(scene: Scene) -> list[IndoorShape]:
    """Rooms and doors of a map, by the best anchor of each of its scenes, longitude and latitude.

    A room is outlined by its own floor; where floors go through several rooms, by the free floor,
    to a decimetre.

    Raises
    ------
    OptionError
        A scene has no anchor, or no room.

    """
    shapes = []
    for s, name in enumerate(scene.scenes):
        anchors = scene.anchors_of(name)
        if not anchors:
            raise OptionError(
                f"{name!r} has no place on Earth, which OpenStreetMap needs; give it one with "
                "`placegraph scene anchor`."
            )
        rows = np.flatnonzero(scene.scene_of == s)
        shapes += _rooms(scene, s, rows, anchors[0])
        shapes += _doors(scene, s, rows, anchors[0])
    if not any(shape.kind in ROOMS for shape in shapes):
        raise OptionError("The map has no room: neither floors nor free floor between walls.")
    return shapes


def _rooms(scene: Scene, s: int, rows: NDArray[np.int64], anchor: Anchor) -> list[IndoorShape]:
    floor, found = float(scene.floors[s]), []
    outlined = {
        row: _outline(scene, row) for row in rows.tolist() if is_floor(scene.graph.labels[row])
    }
    names = [scene.attributes[row].get("room", "") for row in outlined]
    own = len(set(names)) == len(names) > 0 and all(names)
    if own and all(outlined.values()):
        for row, rings in outlined.items():
            said = scene.attributes[row]
            tags = {k: said[k] for k in _SAID if k in said and k != "indoor"}
            kind = said.get("indoor", "room")
            numbered = {"ref": said["room"]} if said["room"].isdecimal() else {}
            named = _named(scene, row) or ("" if numbered or _of_itself(said) else said["room"])
            tags = numbered | tags | {"name": named, "room": said.get("kind", "")}
            height = _ceiling(scene, rows, said["room"], floor)
            found.append(_room(anchor, f"way/{row}", kind, rings, tags, (floor, height)))
        return found
    rooms = rooms_of(scene.mesh, scene.graph.labels, floor)
    for k in range(len(rooms)):
        inside = [scene.attributes[row].get("room", "") for row in rows[rooms.room_of[rows] == k]]
        name = max(set(inside), key=inside.count) if inside else ""
        tags = {"name": "" if name.isdecimal() else name, "ref": name if name.isdecimal() else ""}
        rings = rings_of_cells(rooms.cells == k, rooms.origin, rooms.cell)
        if rings:
            found.append(_room(anchor, f"way/{k}", "room", rings, tags, (floor, None)))
    return found


def _of_itself(said: dict[str, str]) -> bool:
    """Whether a room's name says what it is, and no more: it was given when the map was made."""
    kind = (said.get("kind") or said.get("indoor", "")).replace("_", " ")
    return bool(kind) and said["room"].rstrip(" 0123456789") == kind


def _room(
    anchor: Anchor,
    osm: str,
    kind: str,
    rings: list[Floats],
    tags: dict[str, str],
    heights: tuple[float, float | None],
) -> IndoorShape:
    level, (floor, top) = anchor.level or "0", heights
    said = {"level": level} | {k: v for k, v in tags.items() if v}
    if top is not None:
        said["height"] = f"{top - floor:.2f}"
    parts = [_lonlat(anchor, ring, floor) for ring in rings]
    return IndoorShape(osm, kind if kind in ROOMS else "room", (), said, parts)


def _lonlat(anchor: Anchor, points: Floats, height: float) -> Floats:
    there: Floats = anchor.to_earth(np.column_stack([points, np.full(len(points), height)]))[:, :2]
    return there


def _outline(scene: Scene, row: int) -> list[Floats]:
    """Closed rings of a floor (n, 2) [m, map]; empty where its triangles make none."""
    mesh = scene.mesh
    triangles = mesh.triangles[mesh.object_of == row].astype(np.int64)
    corners = mesh.vertices[triangles].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    level = np.abs(normals[:, 2]) > LEVEL * np.linalg.norm(normals, axis=1)
    rings = outlines_of(mesh.vertices[:, :2].astype(np.float64), triangles[level])
    rings = [ring for ring in rings if abs(area(ring)) > LEAST_AREA]
    return sorted(rings, key=lambda ring: -abs(area(ring)))


def _ceiling(scene: Scene, rows: NDArray[np.int64], room: str, floor: float) -> float | None:
    """Height of a room's ceiling [m, map], or of the others'; None where there is none."""
    above: dict[bool, list[float]] = {True: [], False: []}
    for row in rows.tolist():
        words = label_words(scene.graph.labels[row])
        height = float(scene.graph.positions[row, 2])
        if words and words[-1] == "ceiling" and height > floor + 1.0:
            above[scene.attributes[row].get("room") == room].append(height)
    heights = above[True] or above[False]
    return float(np.median(heights)) if heights else None


def _doors(scene: Scene, s: int, rows: NDArray[np.int64], anchor: Anchor) -> list[IndoorShape]:
    graph, floor, found = scene.graph, float(scene.floors[s]), []
    for row in rows.tolist():
        words = label_words(graph.labels[row])
        if not words or words[-1] not in _DOORS or graph.extents is None:
            continue
        ends = ends_of(scene, row)
        width, height = float(np.linalg.norm(ends[1] - ends[0])), float(graph.extents[row, 2])
        said = {
            k: scene.attributes[row][k]
            for k in ("entrance", "door", "ref")
            if k in scene.attributes[row]
        }
        said |= {"level": anchor.level or "0", "width": f"{width:.2f}", "name": _named(scene, row)}
        said["height"] = f"{height:.2f}"
        found.append(IndoorShape(f"node/{row}", "door", (), said, [_lonlat(anchor, ends, floor)]))
    return found


def ends_of(scene: Scene, row: int) -> Floats:
    """Ends (2, 2) of a door or window seen from above [m, map]: along what it is widest."""
    mesh = scene.mesh
    corners = mesh.vertices[mesh.triangles[mesh.object_of == row], :2].reshape(-1, 2)
    points = np.unique(corners.astype(np.float64), axis=0)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    _, axes = np.linalg.eigh(np.cov((points - middle).T))
    along = (points - middle) @ axes[:, 1]
    ends: Floats = middle + np.array([[along.min()], [along.max()]]) * axes[:, 1]
    return ends


def _named(scene: Scene, row: int) -> str:
    """Name of an object, unless it only says again what it is, as "floor 1"."""
    name, label = scene.graph.names[row], scene.graph.labels[row]
    return "" if name.casefold().rstrip(" 0123456789_.-") == label.casefold() else name
