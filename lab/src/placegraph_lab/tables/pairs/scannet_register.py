"""How two axis-aligned scans of a room lie to each other, which ScanNet does not say.

Both stand along x and y with the floor at 0, so what is unknown is a quarter turn and a shift. Every
quarter turn is tried from shifts on a grid around the middles of both, the best are refined point to
plane, and the winner counts where it fits much of the room and clearly more than any other quarter
turn does.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

from placegraph.core.geometry import Floats
from placegraph.indoor.mapping.change.align import Registration, about, register, sample
from placegraph.indoor.scene_map import SceneMap

WITHIN = 0.05
"""Surfaces fit where they are this near [m]: two reconstructions differ by as much."""
LEAST = 0.5
"""Least share of the query's surface that fits the map's."""
LEAD = 0.08
"""Least lead of the best quarter turn over the next, in that share."""
SHIFTS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Shifts along x and y that are tried, from middle to middle [m]."""
_REACH = 0.6
_FINE, _TARGET = 5_000, 20_000
_COARSE, _COARSE_TARGET, _COARSE_WITHIN = 300, 3_000, 0.15


def register_scans(map_: SceneMap, query: SceneMap, rng: Generator) -> Floats | None:
    """map_from_query (4, 4) [m] of two maps of a room whose walls lie along x and y.

    None where too little of the query fits, or another quarter turn fits nearly as well: an empty
    rectangular room does not say how it is turned.
    """
    everything = np.arange(len(map_.mesh)), np.arange(len(query.mesh))
    target, rough = (sample(map_.mesh, everything[0], n, rng) for n in (_TARGET, _COARSE_TARGET))
    source, few = (sample(query.mesh, everything[1], n, rng).points for n in (_FINE, _COARSE))
    middle, goal = _middle(source), _middle(target.points)
    found: list[Registration] = []
    for turn in range(4):
        starts = (
            about(middle, turn * np.pi / 2, goal + np.array([x, y, 0.0]))
            for x in SHIFTS
            for y in SHIFTS
        )
        best = max(
            (register(few, rough, start, reach=_REACH, within=_COARSE_WITHIN) for start in starts),
            key=lambda fit: fit.share,
        )
        found.append(register(source, target, best.motion, reach=2 * _COARSE_WITHIN, within=WITHIN))
    first, second = sorted(found, key=lambda fit: -fit.share)[:2]
    if first.share < LEAST or first.share - second.share < LEAD:
        return None
    return first.motion


def _middle(points: Floats) -> Floats:
    """Middle (3,) of the points' box, on the floor."""
    low, high = points.min(axis=0), points.max(axis=0)
    return np.array([*(low + high)[:2] / 2.0, 0.0])
