"""The outer walls of a scene map seen from above, with the windows and doors in them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geojson import nested
from placegraph.core.geometry import Floats
from placegraph.errors import OptionError
from placegraph.indoor.map.floor import label_words
from placegraph.indoor.map.map_kernels import nearest
from placegraph.indoor.map.rooms import rooms_of
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.mapping.osm import find_ends, segment_distances
from placegraph.indoor.mapping.outlines import area, trace_cells

WALL, WINDOW, DOOR = 0, 1, 2
"""What a point of the outer walls lies in."""
_WORDS = {"window": WINDOW, "windows": WINDOW, "door": DOOR, "doors": DOOR, "entrance": DOOR}
_THICK = 0.7  # thicker walls between two rooms are not closed [m]
_BESIDE = 0.5  # an opening lies no farther from the inner face of its wall [m]
_WIDEST = 8.0  # what is wider is all the windows of a house in one object [m]
_STEP, _MOST = 0.1, 600  # between points [m], or so many
_WORTH = 2.0  # of a wall, so much of it is one independent look [m]


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
        return np.where(self.opening >= 0, 1.0 / count[self.opening], self.step / _WORTH)


def outer_walls(scene: Scene) -> OuterWalls:
    """Outer walls of the floor of a map of one scene: the outline of its rooms, inner walls closed.

    Raises
    ------
    OptionError
        The map is of several scenes, or has no room.

    """
    if len(scene.scenes) != 1:
        raise OptionError(
            f"The map is merged of {len(scene.scenes)} scenes; anchor each before they are merged."
        )
    rooms = rooms_of(scene.mesh, scene.graph.labels, float(scene.floors[0]))
    reach = int(np.ceil(_THICK / 2.0 / rooms.cell))
    inside = np.pad(rooms.cells >= 0, reach + 1)
    grown = nearest(inside, reach)[1] >= 0
    inside |= nearest(~grown, reach)[1] < 0
    rings = trace_cells(inside, rooms.origin - (reach + 1) * rooms.cell, rooms.cell)
    outer = [rings[first] for first, *_ in nested(rings)] if rings else []
    if not outer:
        raise OptionError("The map has no room, so it has no outer walls; give --pair or --pose.")
    length = sum(float(np.linalg.norm(np.diff(r, axis=0), axis=1).sum()) for r in outer)
    step = max(_STEP, length / _MOST)
    points, normals = [], []
    for ring in outer:
        for a, b in pairwise(ring if area(ring) > 0 else ring[::-1]):
            far = float(np.linalg.norm(b - a))
            share = (np.arange(max(1, round(far / step))) + 0.5) / max(1, round(far / step))
            points.append(a + share[:, None] * (b - a))
            normals.append(np.tile([(b - a)[1] / far, -(b - a)[0] / far], (len(share), 1)))
    at = np.concatenate(points)
    kind, opening = _openings(scene, at)
    return OuterWalls(at, np.concatenate(normals), kind, opening, step, outer)


def _openings(scene: Scene, at: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Kind (N,) and number (N,) of the opening that each point lies in."""
    kind, opening, number = np.zeros(len(at), np.int64), np.full(len(at), -1), 0
    for row, label in enumerate(scene.graph.labels):
        what = _WORDS.get((label_words(label) or [""])[-1], WALL)
        if what == WALL:
            continue
        a, b = find_ends(scene, row)
        if np.linalg.norm(b - a) > _WIDEST:
            continue
        beside = (segment_distances(at, a[None], b[None])[:, 0] < _BESIDE) & (opening < 0)
        if beside.any():
            kind[beside], opening[beside], number = what, number, number + 1
    return kind, opening
