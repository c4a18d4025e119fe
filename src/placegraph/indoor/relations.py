"""Relations between the objects of a scene, from their boxes and triangles.

In this order, of which the first that holds for a pair is kept:

- A *standing on* B: level triangles of B lie under A's box, from 10 cm below its bottom to 5 cm
  above, and B as a whole lies lower or begins lower; of several B those under at least half of A
  first, then the highest, then the largest.
- A *inside* B: A stands on nothing, and at least 90 % of its box lies in B's, which is larger.
- A *attached to* B: A stands on nothing and is in nothing, and B's triangles come within 5 cm of
  its box: of several B walls, ceilings and floors first, then the largest.
- A *above* B: A's bottom is over B's top, by at most 2 m, and half of the smaller footprint
  overlaps; of several B the highest.
- A *next to* B, and B next to A: their boxes overlap in height and are at most 0.5 m apart.

Walls, floors and ceilings (by the label's last word, or because their footprint is half of the
map's) are never inside, above or next to anything.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.floor import label_words

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from placegraph.indoor.mesh import Mesh

STANDING_ON, INSIDE, ATTACHED_TO, ABOVE, NEXT_TO = (
    "standing on", "inside", "attached to", "above", "next to",
)  # fmt: skip
RELATIONS = (STANDING_ON, INSIDE, ATTACHED_TO, ABOVE, NEXT_TO)

CONTACT = 0.05
"""What is nearer than this touches [m]."""
SUPPORT = 0.1
"""A thing may float this much over what it stands on [m]: feet are lost in coarse meshes."""
NEXT = 0.5
"""Side by side [m]."""
OVER = 2.0
"""One above the other [m]."""
MOST_OBJECTS = 20_000
"""Beyond this many objects, as of a mesh cut to pieces, no relations are made."""

_STRUCTURE = {"wall", "walls", "floor", "floors", "ground", "ceiling", "roof"}
_LEVEL = 0.7
_THIN = 0.01  # boxes of flat things are given this thickness [m]

Floats = NDArray[np.float64]


class _Boxes(NamedTuple):
    low: Floats
    """(N, 3)"""
    high: Floats
    """(N, 3)"""
    structure: NDArray[np.bool_]
    """(N,)"""
    footprint: Floats
    """(N,) [m2]"""


class _Triangles(NamedTuple):
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


def relate(mesh: Mesh, labels: Sequence[str]) -> list[tuple[int, str, int]]:
    """Relations (row, relation, row) between the objects of a mesh, sorted."""
    count = len(labels)
    if not 1 < count <= MOST_OBJECTS:
        return []
    boxes = _boxes(mesh, labels)
    pairs = _near_pairs(boxes)
    triangles = _triangles(mesh, count)
    found: dict[tuple[int, int], str] = {}
    grounded = _standing(boxes, triangles, pairs, found)
    grounded |= _inside(boxes, pairs, found, grounded)
    _attached(boxes, triangles, pairs, found, grounded)
    _above(boxes, pairs, found)
    _next_to(boxes, pairs, found)
    return sorted((a, relation, b) for (a, b), relation in found.items())


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


def _boxes(mesh: Mesh, labels: Sequence[str]) -> _Boxes:
    bounds = mesh.object_bounds(len(labels))
    low, high = bounds[:, 0], bounds[:, 1]
    sides = high - low
    footprint = sides[:, 0] * sides[:, 1]
    whole = np.prod((high.max(axis=0) - low.min(axis=0))[:2])
    named = np.array([bool(w) and w[-1] in _STRUCTURE for w in map(label_words, labels)])
    return _Boxes(low, high, named | (footprint >= 0.5 * whole), footprint)


def _triangles(mesh: Mesh, count: int) -> _Triangles:
    order = np.argsort(mesh.object_of, kind="stable")
    corners = mesh.vertices[mesh.triangles[order]]
    normals = mesh.normals()[order]
    level = np.abs(normals[:, 2]) > _LEVEL * np.linalg.norm(normals, axis=1)
    starts = np.searchsorted(mesh.object_of[order], np.arange(count + 1))
    return _Triangles(corners, corners.min(axis=1), corners.max(axis=1), level, starts)


def _near_pairs(boxes: _Boxes) -> NDArray[np.int64]:
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


def _overlap_2d(boxes: _Boxes, a: NDArray[np.int64], b: NDArray[np.int64]) -> Floats:
    """Area [m2] that the footprints of pairs share."""
    sides = np.minimum(boxes.high[a], boxes.high[b]) - np.maximum(boxes.low[a], boxes.low[b])
    area: Floats = np.prod(np.maximum(sides[:, :2], 0.0), axis=1)
    return area


def _standing(
    boxes: _Boxes,
    triangles: _Triangles,
    pairs: NDArray[np.int64],
    found: dict[tuple[int, int], str],
) -> NDArray[np.bool_]:
    """Find what stands on what; returns which objects do."""
    a, b = pairs.T
    bottom = boxes.low[a, 2]
    under = (boxes.high[b, 2] >= bottom - SUPPORT) & (boxes.low[b, 2] <= bottom + CONTACT)
    lower = (boxes.high[b, 2] <= bottom + CONTACT) | (boxes.low[b, 2] < bottom - CONTACT)
    apart = np.any(
        (boxes.low[a, :2] > boxes.high[b, :2]) | (boxes.low[b, :2] > boxes.high[a, :2]), axis=1
    )
    rows = np.flatnonzero(under & lower & ~apart)
    tops = np.minimum(boxes.high[b[rows], 2], bottom[rows] + CONTACT)
    carries = _overlap_2d(boxes, a[rows], b[rows]) >= 0.5 * boxes.footprint[a[rows]]
    rows = rows[np.lexsort([-boxes.footprint[b[rows]], -np.round(tops, 3), ~carries])]
    stands = np.zeros(len(boxes.low), np.bool_)
    for i in rows.tolist():
        thing, under_it = int(a[i]), int(b[i])
        if stands[thing] or (under_it, thing) in found:
            continue
        low, high = boxes.low[thing].copy(), boxes.high[thing].copy()
        low[2], high[2] = low[2] - SUPPORT, low[2] + CONTACT
        if triangles.in_box(under_it, low, high, level=True):
            found[thing, under_it] = STANDING_ON
            stands[thing] = True
    return stands


def _inside(
    boxes: _Boxes,
    pairs: NDArray[np.int64],
    found: dict[tuple[int, int], str],
    grounded: NDArray[np.bool_],
) -> NDArray[np.bool_]:
    """Find what is inside what; returns which objects are."""
    a, b = pairs[~boxes.structure[pairs].any(axis=1) & ~grounded[pairs[:, 0]]].T
    thin = np.maximum(boxes.high - boxes.low, _THIN)
    volume = thin.prod(axis=1)
    shared = np.minimum(boxes.high[a], boxes.high[b]) - np.maximum(boxes.low[a], boxes.low[b])
    shared = np.where(
        boxes.high[a] - boxes.low[a] < _THIN, np.where(shared >= 0, thin[a], 0), shared
    )
    within = np.prod(np.maximum(shared, 0.0), axis=1) >= 0.9 * volume[a]
    within &= volume[b] > 1.5 * volume[a]
    inside = np.zeros(len(boxes.low), np.bool_)
    rows = np.flatnonzero(within)
    for i in rows[np.argsort(volume[b[rows]], kind="stable")].tolist():
        if not inside[a[i]] and not {(a[i], b[i]), (b[i], a[i])} & found.keys():
            found[int(a[i]), int(b[i])] = INSIDE
            inside[a[i]] = True
    return inside


def _attached(
    boxes: _Boxes,
    triangles: _Triangles,
    pairs: NDArray[np.int64],
    found: dict[tuple[int, int], str],
    grounded: NDArray[np.bool_],
) -> None:
    a, b = pairs[~grounded[pairs[:, 0]] & ~boxes.structure[pairs[:, 0]]].T
    touching = np.all(
        (boxes.low[a] <= boxes.high[b] + CONTACT) & (boxes.low[b] <= boxes.high[a] + CONTACT),
        axis=1,
    )
    a, b = a[touching], b[touching]
    order = np.lexsort([-boxes.footprint[b], ~boxes.structure[b]])
    held = grounded.copy()
    for thing, other in zip(a[order].tolist(), b[order].tolist(), strict=True):
        if held[thing] or (other, thing) in found:
            continue
        low, high = boxes.low[thing] - CONTACT, boxes.high[thing] + CONTACT
        if triangles.in_box(other, low, high):
            found[thing, other] = ATTACHED_TO
            held[thing] = True


def _above(boxes: _Boxes, pairs: NDArray[np.int64], found: dict[tuple[int, int], str]) -> None:
    a, b = pairs[~boxes.structure[pairs].any(axis=1)].T
    gap = boxes.low[a, 2] - boxes.high[b, 2]
    smaller = np.minimum(boxes.footprint[a], boxes.footprint[b])
    rows = np.flatnonzero(
        (gap >= -CONTACT) & (gap <= OVER) & (_overlap_2d(boxes, a, b) >= 0.5 * smaller)
        & (smaller > 0)
    )  # fmt: skip
    done: set[int] = set()
    for i in rows[np.argsort(gap[rows], kind="stable")].tolist():
        one, other = int(a[i]), int(b[i])
        if one not in done and (one, other) not in found and (other, one) not in found:
            found[one, other] = ABOVE
        done.add(one)


def _next_to(boxes: _Boxes, pairs: NDArray[np.int64], found: dict[tuple[int, int], str]) -> None:
    a, b = pairs[~boxes.structure[pairs].any(axis=1)].T
    apart = np.maximum(boxes.low[a], boxes.low[b]) - np.minimum(boxes.high[a], boxes.high[b])
    near = (apart[:, 2] < 0) & (np.hypot(*np.maximum(apart[:, :2], 0.0).T) <= NEXT)
    for one, other in zip(a[near].tolist(), b[near].tolist(), strict=True):
        other_way = found.get((other, one), NEXT_TO)
        if other_way == NEXT_TO:
            found.setdefault((one, other), NEXT_TO)
