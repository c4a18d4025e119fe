"""Triples (label, relation, label) between the objects around viewpoints (Eq. 5-6)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from placegraph.geometry import Floats
    from placegraph_lab.tables.outdoor.nearby import Around
    from placegraph_lab.tables.outdoor.raw import Ints

DIRECTIONS = ("north", "south", "east", "west")
NORTH, SOUTH, EAST, WEST = range(4)

SHORTEST, LONGEST = 1.0, 25.0
"""Two objects are related where they stand this far apart [m]."""


@njit(cache=True)
def _relation(dx: float, dy: float) -> int:
    if abs(dx) <= abs(dy):
        return NORTH if dy > 0.0 else SOUTH
    return EAST if dx > 0.0 else WEST


def relations(delta: ArrayLike) -> NDArray[np.int8]:
    """Direction (...) of A seen from B, for A - B (..., 2) east, north [m] (Eq. 6).

    An index into `DIRECTIONS`. The equation leaves |dx| = |dy| open: north and south win here.
    """
    dx, dy = np.moveaxis(np.asarray(delta, np.float64), -1, 0)
    upright = np.where(dy > 0.0, NORTH, SOUTH)
    return np.where(np.abs(dx) <= np.abs(dy), upright, np.where(dx > 0.0, EAST, WEST)).astype(
        np.int8
    )


@dataclass(frozen=True)
class Triples:
    """Ordered pairs of objects around V viewpoints; viewpoint v has `starts[v]:starts[v + 1]`."""

    starts: Ints
    """(V + 1,)"""
    source: NDArray[np.int32]
    """(T,) entry of the `Around`: what is described."""
    target: NDArray[np.int32]
    """(T,) entry of the `Around`: what it is described by."""
    relation: NDArray[np.int8]
    """(T,) index into `DIRECTIONS`: the source seen from the target."""

    @classmethod
    def of(cls, around: Around, longest: float = LONGEST) -> Triples:
        """All ordered pairs of objects `SHORTEST` to `longest` apart [m]."""
        return cls(*_pairs(around.starts, around.points, longest))

    def codes(self, around: Around, label: NDArray[np.int32], labels: int) -> Ints:
        """(T,) one integer a triple of labels, where `label` (N,) counts up to `labels`."""
        return encode(
            label[around.objects[self.source]],
            self.relation,
            label[around.objects[self.target]],
            labels,
        )


def encode(source: ArrayLike, relation: ArrayLike, target: ArrayLike, labels: int) -> Ints:
    """Code of triples: ``(source * 4 + relation) * labels + target``."""
    head = np.asarray(source, np.int64) * len(DIRECTIONS) + np.asarray(relation, np.int64)
    return np.asarray(head * labels + np.asarray(target, np.int64))


@njit(cache=True)
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
