"""The name of the room at a place of a scene, as its objects' attributes have it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from placegraph.indoor.map.floor import storey_at
from placegraph.indoor.map.rooms import Rooms, rooms_of
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.map.structure import structure

_STOREY = 3.0  # what is higher above a floor is in none of its rooms [m]


def room_at(scene: Scene, point: ArrayLike) -> str:
    """Name of the room in which a point (3,) x, y, z [m] lies; empty: in none, or rooms have no names.

    A room has the name that most things in it say.
    """
    x, y, z = np.asarray(point, np.float64).tolist()
    _, floor = storey_at(scene, point)
    if not -0.5 <= z - floor <= _STOREY or not any("room" in a for a in scene.attributes):
        return ""
    rooms, names = scene.derived(("rooms", floor), lambda s: _named(s, floor))
    room = int(rooms.at([(x, y)])[0])
    return names[room] if room >= 0 else ""


def most(names: Sequence[str]) -> str:
    """The name that most things have, the first of several; things without one have no say."""
    given = sorted({name for name in names if name})
    return max(given, key=names.count, default="")


def _named(scene: Scene, floor: float) -> tuple[Rooms, list[str]]:
    """Rooms at a floor, and their names."""
    graph = scene.graph
    rooms = rooms_of(scene.mesh, graph.labels, floor)
    told_by = ~structure(graph.labels)
    names = []
    for room in range(len(rooms)):
        among = np.flatnonzero(told_by & (rooms.room_of == room)).tolist()
        names.append(most([scene.attributes[i].get("room", "") for i in among]))
    return rooms, names
