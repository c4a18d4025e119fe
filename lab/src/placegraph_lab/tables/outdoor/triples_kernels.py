# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `triples`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.jit import kernel
from placegraph_lab.tables.outdoor.raw import Ints

NORTH, SOUTH, EAST, WEST = range(4)


SHORTEST, LONGEST = 1.0, 25.0
"""Two objects are related where they stand this far apart [m]."""


@kernel
def _relation(dx: float, dy: float) -> int:
    if abs(dx) <= abs(dy):
        return NORTH if dy > 0.0 else SOUTH
    return EAST if dx > 0.0 else WEST


@kernel
def _pairs(
    starts: Ints, points: Floats, longest: float
) -> tuple[Ints, NDArray[np.int32], NDArray[np.int32], NDArray[np.int8]]:
    counted = np.zeros(len(starts), np.int64)
    for fill in (False, True):
        if fill:
            total = counted.sum()
            source, target = np.empty(total, np.int32), np.empty(total, np.int32)
            related = np.empty(total, np.int8)
        n = 0
        for v in range(len(starts) - 1):
            first = n
            for a in range(starts[v], starts[v + 1]):
                for b in range(starts[v], starts[v + 1]):
                    dx, dy = points[a, 0] - points[b, 0], points[a, 1] - points[b, 1]
                    d2 = dx * dx + dy * dy
                    if a != b and SHORTEST * SHORTEST <= d2 <= longest * longest:
                        if fill:
                            source[n], target[n], related[n] = a, b, _relation(dx, dy)
                        n += 1
            counted[v + 1] = n - first
    return np.cumsum(counted), source, target, related
