"""Boxes and triangles of the objects of a mesh, as relations between them are found by."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import is_floor, label_words
from placegraph.indoor.map.mesh import Mesh

NEXT = 0.5
"""Side by side [m]."""
_WALLS = frozenset({"wall", "walls"})
_CEILINGS = frozenset({"ceiling", "ceilings", "roof"})
_DOORS = frozenset({"door", "doors", "doorway", "doorframe"})
_BUILT_IN = _DOORS | {"window", "windows", "curtain", "curtains", "blind", "blinds"}
_LEVEL = 0.7

Floats = NDArray[np.float64]


class Boxes(NamedTuple):
    """Boxes of N objects, and what their labels and sizes say."""

    low: Floats
    """(N, 3)"""
    high: Floats
    """(N, 3)"""
    structure: NDArray[np.bool_]
    """(N,) walls, floors, ceilings, and what is half of the map."""
    floor: NDArray[np.bool_]
    """(N,) by label, as the next four."""
    wall: NDArray[np.bool_]
    ceiling: NDArray[np.bool_]
    door: NDArray[np.bool_]
    built_in: NDArray[np.bool_]
    footprint: Floats
    """(N,) [m2]"""


class Triangles(NamedTuple):
    """Triangles sorted by object, and their boxes."""

    corners: NDArray[np.float32]
    """(T, 3 corners, 3)"""
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    level: NDArray[np.bool_]
    starts: NDArray[np.int64]
    """(N + 1,)"""

    def in_box(self, row: int, low: Floats, high: Floats, *, level: bool = False) -> bool:
        """Whether a triangle of an object (a level one) reaches into a box."""
        own = slice(self.starts[row], self.starts[row + 1])
        near = np.flatnonzero((self.low[own, 2] <= high[2]) & (self.high[own, 2] >= low[2]))
        near += own.start
        if level:
            near = near[self.level[near]]
        for axis in (0, 1):
            near = near[(self.low[near, axis] <= high[axis]) & (self.high[near, axis] >= low[axis])]
        return bool(near.size) and bool(overlap(self.corners[near], low, high).any())


def overlap(corners: NDArray[np.float32], low: Floats, high: Floats) -> NDArray[np.bool_]:
    """Which triangles (T, 3 corners, 3) reach into a box, by the separating axis theorem."""
    half = (high - low) / 2.0
    points = corners.astype(np.float64) - (low + high) / 2.0
    edges = np.roll(points, -1, axis=1) - points
    touching = np.all((points.min(axis=1) <= half) & (points.max(axis=1) >= -half), axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    touching &= np.abs((normal * points[:, 0]).sum(axis=1)) <= np.abs(normal) @ half
    for i in range(3):  # box axis x edge
        axes = np.cross(np.eye(3)[None, i], edges)  # (T, 3 edges, 3)
        spans = np.einsum("tei,tci->tec", axes, points)
        reach = np.abs(axes) @ half
        touching &= np.all((spans.min(axis=2) <= reach) & (spans.max(axis=2) >= -reach), axis=1)
    return np.asarray(touching)


def boxes_of(mesh: Mesh, labels: Sequence[str]) -> Boxes:
    """Boxes of the objects of a mesh."""
    bounds = mesh.object_bounds(len(labels))
    low, high = bounds[:, 0], bounds[:, 1]
    sides = high - low
    footprint = sides[:, 0] * sides[:, 1]
    whole = np.prod((high.max(axis=0) - low.min(axis=0))[:2])
    words = [(label_words(label) or [""])[-1] for label in labels]
    floor = np.array([is_floor(label) for label in labels])
    wall, ceiling, door, built_in = (
        np.array([word in known for word in words])
        for known in (_WALLS, _CEILINGS, _DOORS, _BUILT_IN)
    )
    structure = floor | wall | ceiling | (footprint >= 0.5 * whole)
    return Boxes(low, high, structure, floor, wall, ceiling, door, built_in, footprint)


def triangles_of(mesh: Mesh, count: int) -> Triangles:
    """Triangles of a mesh of `count` objects, by object."""
    order = np.argsort(mesh.object_of, kind="stable")
    corners = mesh.vertices[mesh.triangles[order]]
    normals = mesh.normals()[order]
    level = np.abs(normals[:, 2]) > _LEVEL * np.linalg.norm(normals, axis=1)
    starts = np.searchsorted(mesh.object_of[order], np.arange(count + 1))
    return Triangles(corners, corners.min(axis=1), corners.max(axis=1), level, starts)


def near_pairs(boxes: Boxes) -> NDArray[np.int64]:
    """Pairs (P, 2), both ways, whose footprints are at most `NEXT` apart: a sweep along x."""
    order = np.argsort(boxes.low[:, 0], kind="stable")
    begin = boxes.low[order, 0]
    until = np.searchsorted(begin, boxes.high[order, 0] + NEXT, side="right")
    found = []
    for chunk in _chunks(until - np.arange(len(order))):
        reach = until[chunk] - chunk - 1
        first = np.repeat(chunk, reach)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(reach) - reach, reach)
        a, b = order[first], order[second]
        near = (boxes.low[a, 1] <= boxes.high[b, 1] + NEXT) & (
            boxes.low[b, 1] <= boxes.high[a, 1] + NEXT
        )
        found.append(np.stack([a[near], b[near]], axis=1))
    one_way = np.concatenate(found)
    return np.concatenate([one_way, one_way[:, ::-1]])


def _chunks(lengths: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Rows, a million pairs at a time."""
    part = np.cumsum(lengths) // 1_000_000
    for value in np.unique(part):
        yield np.flatnonzero(part == value)


def overlap_2d(boxes: Boxes, a: NDArray[np.int64], b: NDArray[np.int64]) -> Floats:
    """Area [m2] that the footprints of pairs share."""
    sides = np.minimum(boxes.high[a], boxes.high[b]) - np.maximum(boxes.low[a], boxes.low[b])
    area: Floats = np.prod(np.maximum(sides[:, :2], 0.0), axis=1)
    return area
