"""Outlines: footprints of buildings in OpenStreetMap, and outer walls of scene maps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Anchor
from placegraph.core.geojson import contains_points, nest_rings
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.map.floor import split_label
from placegraph.indoor.map.map_kernels import distance_transform
from placegraph.indoor.map.rooms import find_rooms
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.osm import find_ends, segment_distances
from placegraph.indoor.mapping.outlines import area, trace_cells
from placegraph.io.osm.indoor_osm import parse_levels
from placegraph.io.osm.osm import POINT, read_osm

_KEYS = ("building", "entrance", "door", "name", "addr:housenumber")
_NAMES = ("name", "official_name", "alt_name", "short_name", "old_name", "loc_name")
_NEAR_DISTANCE = 5.0  # what lies this close to a building may be its neighbour, or its entrance [m]
_NEIGHBOUR_DISTANCE = 0.6  # what is beyond a wall is looked for this far outside of it [m]
_PIECE_LENGTH, _MAX_PIECES = 1.0, 400  # of walls, length [m] and number

WALL, WINDOW, DOOR = 0, 1, 2
"""Kinds of a point of the outer walls."""
_OPENING_KINDS = {
    "window": WINDOW,
    "windows": WINDOW,
    "door": DOOR,
    "doors": DOOR,
    "entrance": DOOR,
}
_MAX_INNER_WALL = 0.7  # thicker walls between two rooms are not closed [m]
_MAX_OPENING_DISTANCE = 0.5  # an opening lies no farther from the inner face of its wall [m]
_MAX_OPENING = 8.0  # what is wider is all the windows of a house in one object [m]
_POINT_STEP, _MAX_POINTS = 0.1, 600  # between points [m], or so many
_INDEPENDENT_LENGTH = 2.0  # of a wall, so much of it is one independent look [m]


@dataclass(frozen=True, eq=False)
class Footprint:
    """Walls of a building seen from above, M pieces, in metres east and north of `base`."""

    name: str
    osm: str
    tags: Mapping[str, str] = field(repr=False)
    base: Anchor = field(repr=False)
    """Its first point: an anchor that looks north."""
    rings: Sequence[Floats] = field(repr=False)
    """Closed (n, 2) [m]."""
    starts: Floats = field(repr=False)
    ends: Floats = field(repr=False)
    """(M, 2) [m]"""
    normals: Floats = field(repr=False)
    """(M, 2) unit vectors, outwards."""
    shared: NDArray[np.bool_] = field(repr=False)
    """(M,) bool, where another building stands wall to wall."""
    entrances: Floats = field(repr=False)
    """(E, 2) [m], of the floor in question."""
    grain: float = 0.0
    """Coordinates are steps of this [m]."""

    @property
    def levels(self) -> tuple[float, ...]:
        """Levels that the building has, as far as its tags say."""
        if told := parse_levels(self.tags.get("level", "")):
            return told
        count = parse_levels(self.tags.get("building:levels", ""))
        lowest = parse_levels(self.tags.get("building:min_level", "0"))
        return tuple(np.arange(lowest[0] if lowest else 0.0, count[-1])) if count else ()


class _MapObject(NamedTuple):
    """Object of the map, in longitude and latitude."""

    osm: str
    point: bool
    tags: Mapping[str, str]
    rings: Sequence[Floats]


def find_footprints(path: Path, name: str, level: str = "") -> list[Footprint]:
    """Find the footprints of the buildings of a name, at most a few.

    Raises `InputError` or `MapError`: the file cannot be read; `OptionError`: nothing there has
    that name, or what has it stands in no building.

    `path`: extract of OpenStreetMap, or a city map.
    `name`: of the building or of something in it, such as a shop; an address, or an id: ``way/12``.
    `level`: OpenStreetMap's level; entrances of others are left out.
    """
    if path.suffix.lower() == ".city":
        things, grain = _read_city(path)
    else:
        kinds, grain = ("node", "way", "relation"), 0.0
        things = [
            _MapObject(f"{kinds[e.osm_type]}/{e.osm_id}", e.kind == POINT, e.tags, e.parts)
            for e in read_osm(path, _KEYS)
        ]
    wanted = " ".join(name.split()).casefold()
    named = [t for t in things if wanted in {n.casefold() for n in _list_names(t)}]
    if not named:
        others = sorted({n for t in things for n in _list_names(t) if "/" not in n})
        close = get_close_matches(name, others, 3, 0.5)
        hint = f" Is it {' or '.join(map(repr, close))}?" if close else ""
        raise OptionError(f"--building {name!r}: nothing in {path} has that name.{hint}")
    buildings = [t for t in things if _is_building(t)]
    found: dict[str, tuple[_MapObject, Mapping[str, str]]] = {}
    for thing in named:
        around = [thing] if _is_building(thing) else _find_buildings(thing, buildings)
        for building in around:
            found.setdefault(building.osm, (building, {**building.tags, **thing.tags}))
    if not found:
        raise OptionError(
            f"--building {name!r}: this object lies in no building of {path}; name the "
            "building itself."
        )
    if len(found) > 8:
        ids = ", ".join(sorted(found)[:3])
        raise OptionError(
            f"--building {name!r}: {len(found)} buildings have that name; give an id ({ids})."
        )
    doors = [t for t in things if t.point and {"entrance", "door"} & t.tags.keys()]
    if level:
        there = set(parse_levels(level))
        doors = [t for t in doors if there & set(parse_levels(t.tags.get("level", "0")))]
    return [
        _make_footprint(building, tags, buildings, doors, grain)
        for building, tags in found.values()
    ]


def _list_names(element: _MapObject) -> Iterator[str]:
    tags = element.tags
    yield element.osm
    for key, value in tags.items():
        if key in _NAMES or key.startswith("name:"):
            yield from (" ".join(v.split()) for v in value.split(";"))
    number, street = tags.get("addr:housenumber", ""), tags.get("addr:street", "")
    if number and street:
        yield from (f"{street} {number}", f"{number} {street}")


def _is_building(element: _MapObject) -> bool:
    return (
        not element.point
        and element.tags.get("building", "no") != "no"
        and len(element.rings[0]) > 3
    )


def _find_buildings(element: _MapObject, buildings: Iterable[_MapObject]) -> list[_MapObject]:
    """Find the buildings that contain an object."""
    middle = (
        element.rings[0][:-1].mean(axis=0) if len(element.rings[0]) > 3 else element.rings[0][0]
    )
    found = []
    for building in buildings:
        ring = building.rings[0]
        in_box = (ring.min(axis=0) <= middle).all() and (middle <= ring.max(axis=0)).all()
        if in_box and contains_points(middle[None], building.rings)[0]:
            found.append(building)
    return found


def _read_city(path: Path) -> tuple[list[_MapObject], float]:
    from placegraph.outdoor.city import CityMap
    from placegraph.outdoor.map.objects import GRAIN

    city = CityMap.open(path)
    o, things = city.objects, []
    for i in range(len(o)):
        labels = o.label_values[o.label_starts[i] : o.label_starts[i + 1]]
        tags = dict(o.labels[k].split("=", 1) for k in labels.tolist())
        names = o.name_values[o.name_starts[i] : o.name_starts[i + 1]]
        tags["name"] = ";".join(o.names[k] for k in names.tolist())
        rings = [city.plane.to_lonlat(part.astype(np.float64)) for part in o.parts(i)]
        things.append(_MapObject(o.osm(i), o.kind[i] == POINT, tags, rings))
    return things, GRAIN


def _make_footprint(
    building: _MapObject,
    tags: Mapping[str, str],
    buildings: Sequence[_MapObject],
    doors: Sequence[_MapObject],
    grain: float,
) -> Footprint:
    lon, lat = building.rings[0][0].tolist()
    base = Anchor(lon, lat, 0.0, 0.0)

    def plane(points: Floats) -> Floats:
        return base.to_map(np.column_stack([points, np.zeros(len(points))]))[:, :2]

    near = _NEAR_DISTANCE / 111e3 / np.array([np.cos(np.radians(lat)), 1.0])
    low, high = building.rings[0].min(axis=0) - near, building.rings[0].max(axis=0) + near
    others = [
        [plane(ring) for ring in b.rings]
        for b in buildings
        if b.osm != building.osm
        and (b.rings[0].max(axis=0) >= low).all()
        and (b.rings[0].min(axis=0) <= high).all()
    ]
    rings = [plane(ring) for ring in building.rings]
    length = sum(float(np.linalg.norm(np.diff(r, axis=0), axis=1).sum()) for r in rings)
    piece, starts, ends = max(_PIECE_LENGTH, length / _MAX_PIECES), [], []
    for ring in rings:
        for a, b in pairwise(ring):
            count = max(1, round(float(np.linalg.norm(b - a)) / piece))
            cuts = a + np.linspace(0, 1, count + 1)[:, None] * (b - a)
            starts.append(cuts[:-1])
            ends.append(cuts[1:])
    start, end = np.concatenate(starts), np.concatenate(ends)
    along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1), 1e-9)[:, None]
    normals, middles = np.stack([along[:, 1], -along[:, 0]], axis=1), (start + end) / 2.0
    normals[contains_points(middles + 0.05 * normals, rings)] *= -1.0
    beyond, shared = middles + _NEIGHBOUR_DISTANCE * normals, np.zeros(len(start), np.bool_)
    for other in others:
        shared |= contains_points(beyond, other)
    at = [t.rings[0][0] for t in doors]
    places = [p for p in at if (p >= low).all() and (p <= high).all()]
    entrances = plane(np.array(places)) if places else np.zeros((0, 2))
    return Footprint(
        tags.get("name", ""), building.osm, tags, base, rings, start, end, normals, shared,
        entrances, grain,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class OuterWalls:
    """N points along the inner faces of the outer walls."""

    points: Floats
    """(N, 2) [m, map]."""
    normals: Floats
    """(N, 2) unit vectors, outwards."""
    kind: NDArray[np.int64]
    """(N,) WALL, WINDOW or DOOR."""
    opening: NDArray[np.int64]
    """(N,) number of the window or door; -1: wall."""
    step: float
    """Between points [m]."""
    rings: list[Floats]
    """Closed outlines (n, 2) [m, map]."""

    @property
    def weights(self) -> Floats:
        """(N,) of how many independent looks each point is worth: an opening is one."""
        count = np.bincount(self.opening[self.opening >= 0], minlength=1)
        return np.where(
            self.opening >= 0, 1.0 / count[self.opening], self.step / _INDEPENDENT_LENGTH
        )


def find_outer_walls(scene: Scene) -> OuterWalls:
    """Find the outer walls of a map of one scene: the outline of its rooms, inner walls closed.

    Raises `OptionError`: the map is of several scenes, or has no room.
    """
    if len(scene.scenes) != 1:
        raise OptionError(
            f"The map is merged from {len(scene.scenes)} scenes; anchor each scene before merging."
        )
    rooms = find_rooms(scene.mesh, scene.graph.labels, float(scene.floors[0]))
    reach = int(np.ceil(_MAX_INNER_WALL / 2.0 / rooms.cell))
    inside = np.pad(rooms.cells >= 0, reach + 1)
    grown = distance_transform(inside, reach)[1] >= 0
    inside |= distance_transform(~grown, reach)[1] < 0
    rings = trace_cells(inside, rooms.origin - (reach + 1) * rooms.cell, rooms.cell)
    outer = [rings[first] for first, *_ in nest_rings(rings)] if rings else []
    if not outer:
        raise OptionError("The map has no room, so it has no outer walls; give --pair or --pose.")
    length = sum(float(np.linalg.norm(np.diff(r, axis=0), axis=1).sum()) for r in outer)
    step = max(_POINT_STEP, length / _MAX_POINTS)
    points, normals = [], []
    for ring in outer:
        for a, b in pairwise(ring if area(ring) > 0 else ring[::-1]):
            far = float(np.linalg.norm(b - a))
            share = (np.arange(max(1, round(far / step))) + 0.5) / max(1, round(far / step))
            points.append(a + share[:, None] * (b - a))
            normals.append(np.tile([(b - a)[1] / far, -(b - a)[0] / far], (len(share), 1)))
    at = np.concatenate(points)
    kind, opening = _find_openings(scene, at)
    return OuterWalls(at, np.concatenate(normals), kind, opening, step, outer)


def _find_openings(scene: Scene, at: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find kind (N,) and number (N,) of the opening that each point lies in."""
    kind, opening, number = np.zeros(len(at), np.int64), np.full(len(at), -1), 0
    for row, label in enumerate(scene.graph.labels):
        what = _OPENING_KINDS.get((split_label(label) or [""])[-1], WALL)
        if what == WALL:
            continue
        a, b = find_ends(scene, row)
        if np.linalg.norm(b - a) > _MAX_OPENING:
            continue
        beside = (segment_distances(at, a[None], b[None])[:, 0] < _MAX_OPENING_DISTANCE) & (
            opening < 0
        )
        if beside.any():
            kind[beside], opening[beside], number = what, number, number + 1
    return kind, opening
