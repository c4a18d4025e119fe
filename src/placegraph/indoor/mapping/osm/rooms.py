"""Rooms of one level of an OpenStreetMap file, in metres, with their names and heights."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from placegraph.core.features import inside
from placegraph.core.geo import Anchor
from placegraph.core.geometry import Floats
from placegraph.errors import InputError, OptionError
from placegraph.indoor.mapping.osm.outlines import polygons
from placegraph.io.osm.indoor_osm import ROOMS, IndoorOsm, IndoorShape, room_names
from placegraph.io.osm.levels import level_text, levels_of

HEIGHT = 2.8
"""Of rooms, where nobody said [m]."""
DOOR = (0.9, 2.05)
"""Width and height of doors, where nobody said [m]."""
SLAB = 0.3
"""Of a storey's height that is no room [m]."""
SPREAD = 2000.0
"""Over which the rooms of one building may be spread [m]."""
SIGMA = (1.0, 1.0, 50.0, np.radians(1.0))
"""How far off a plan in OpenStreetMap may be: east, north [m]; nobody says how high it is; turn [rad]."""
_LOW, _HIGH = 1.8, 40.0  # of what may be the height of a room [m]
_LENGTH = re.compile(r"\s*(\d{1,3}(?:[.,]\d{1,3})?)\s*(m|cm)?\s*", re.ASCII)


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A room, corridor or area."""

    shape: IndoorShape
    name: str
    """Unique among the rooms of the level."""
    polygons: list[list[Floats]]
    """Closed rings (n, 2) [m, map]: the outer one, then holes."""
    height: float
    """[m]"""


@dataclass(frozen=True, slots=True, eq=False)
class Door:
    """An opening."""

    shape: IndoorShape
    at: Floats
    """(2,) its middle [m, map]."""
    width: float
    """[m]"""
    height: float
    """[m]"""


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One level of a building."""

    anchor: Anchor
    rooms: list[Room]
    walls: list[Floats]
    """Lines (n, 2) [m, map] of walls that are no room's."""
    doors: list[Door]
    storey: float
    """Height of rooms and walls where nobody says [m]."""
    notes: tuple[str, ...]


def level_of(plan: IndoorOsm, level: float | None) -> Level:
    """One level of a file's rooms; what has no level is on all where it is a door, else on level 0.

    Raises
    ------
    OptionError
        There are several levels and none is chosen, or there is none such.
    InputError
        The rooms are spread over more than a building.

    """
    chosen, notes = _chosen(plan, level)
    shapes = [s for s in plan.shapes if chosen in (s.levels or _anywhere(s, chosen))]
    held = [s for s in shapes if s.kind in ROOMS]
    points = np.concatenate([part for shape in held for part in shape.parts])
    anchor = _anchor(plan, chosen, points)
    east, north = np.ptp(_plane(anchor, points), axis=0)
    if max(east, north) > SPREAD:
        raise InputError(
            f"{plan.path}: the rooms of level {chosen:g} are spread over {max(east, north) / 1000:,.0f} "
            "km; cut out one building, as with `osmium extract`."
        )
    storey, said = _storey(plan, anchor)
    if not all(_height(shape.tags) for shape in held):
        notes.append(said)
    names = room_names(held)
    rooms = []
    for shape, name in zip(held, names, strict=True):
        found = polygons([_plane(anchor, part) for part in shape.parts])
        if found:
            rooms.append(Room(shape, name, found, _height(shape.tags) or storey))
        else:
            plan.left_out["rooms without an area"] += 1
    if not rooms:
        raise InputError(f"{plan.path}: no room of level {chosen:g} has an area.")
    return Level(
        anchor=anchor,
        rooms=rooms,
        walls=[_plane(anchor, part) for s in shapes if s.kind == "wall" for part in s.parts],
        doors=[_door(anchor, s) for s in shapes if s.kind == "door"],
        storey=storey,
        notes=tuple(notes),
    )


def _chosen(plan: IndoorOsm, level: float | None) -> tuple[float, list[str]]:
    levels, notes = plan.levels, []
    nowhere = sum(s.kind in ROOMS and not s.levels for s in plan.shapes)
    if nowhere:
        levels = tuple(sorted({*levels, 0.0}))
        notes.append(f"{nowhere:,} rooms have no level, and are taken for level 0.")
    known = ", ".join(map(level_text, levels))
    if level is None and len(levels) > 1:
        raise OptionError(
            f"{plan.path} has the levels {known}; choose one (--level {levels[0]:g})."
        )
    chosen = levels[0] if level is None else float(level)
    if chosen not in levels:
        raise OptionError(f"{plan.path} has no rooms on level {chosen:g}; it has {known}.")
    return chosen, notes


def _anywhere(shape: IndoorShape, chosen: float) -> tuple[float, ...]:
    """Level of what has none."""
    return (chosen,) if shape.kind in {"door", "building"} else (0.0,)


def _anchor(plan: IndoorOsm, level: float, points: Floats) -> Anchor:
    """Where the map stands: its origin is the middle of its rooms, x points east, y north."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    around = [
        s
        for s in plan.shapes
        if s.kind in {"building", "level"} and any(inside(middle, part) for part in s.parts)
    ]
    around.sort(key=lambda s: (s.kind != "building", "name" not in s.tags))
    house = around[0] if around else None
    return Anchor(
        longitude=float(middle[0]), latitude=float(middle[1]), height=0.0, heading=0.0,
        covariance=np.diag(np.square(SIGMA)),
        building=house.tags.get("name", "") if house else "", osm=house.osm if house else "",
        level=level_text(level), method="OpenStreetMap's rooms",
    )  # fmt: skip


def _plane(anchor: Anchor, lonlat: Floats) -> Floats:
    """(n, 2) [m, map] of (n, 2) [deg]."""
    heights = np.full((len(lonlat), 1), anchor.height)
    return anchor.to_map(np.concatenate([lonlat, heights], axis=1))[:, :2]


def _storey(plan: IndoorOsm, anchor: Anchor) -> tuple[float, str]:
    """Height of rooms by their building's, in as many levels, or a usual one; and which it was."""
    house = next((s for s in plan.shapes if s.osm == anchor.osm), None)
    if house is not None:
        tall = length_of(house.tags.get("height", ""))
        levels = levels_of(house.tags.get("building:levels", ""))
        if tall and levels and levels[-1] > 0:
            height = tall / levels[-1] - SLAB
            if _LOW <= height <= _HIGH:
                return (
                    height,
                    f"Rooms are {height:.1f} m high, by their building's height and levels.",
                )
    return HEIGHT, f"Rooms without a height are taken to be {HEIGHT} m high."


def _height(tags: Mapping[str, str]) -> float | None:
    """Height of a room [m] that its tags say; None: nothing that could be."""
    top = length_of(tags.get("height", ""))
    height = None if top is None else top - (length_of(tags.get("min_height", "")) or 0.0)
    return height if height is not None and _LOW <= height <= _HIGH else None


def _door(anchor: Anchor, shape: IndoorShape) -> Door:
    line = _plane(anchor, shape.parts[0])
    wide = float(np.linalg.norm(line[-1] - line[0]))
    width = length_of(shape.tags.get("width", "")) or (wide if 0.3 < wide < 20.0 else DOOR[0])
    return Door(
        shape, line[[0, -1]].mean(axis=0), width, length_of(shape.tags.get("height", "")) or DOOR[1]
    )


def length_of(text: str) -> float | None:
    """Metres of a tag: ``2.8``, ``2.8 m``, ``90 cm``; None where it is none."""
    match = _LENGTH.fullmatch(text)
    if match is None:
        return None
    metres = float(match[1].replace(",", ".")) * (0.01 if match[2] == "cm" else 1.0)
    return metres if metres > 0 else None
