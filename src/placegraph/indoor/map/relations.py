"""Relations between objects of a mesh, and the words by which maps and people name them."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.floor import is_floor, singular_forms, split_label
from placegraph.indoor.map.mesh import Mesh

NEXT_DISTANCE = 0.5  # Side by side [m]
_WALLS = frozenset({"wall", "walls"})
_CEILINGS = frozenset({"ceiling", "ceilings", "roof"})
_DOORS = frozenset({"door", "doors", "doorway", "doorframe"})
_BUILT_IN = _DOORS | {"window", "windows", "curtain", "curtains", "blind", "blinds"}
_LEVEL = 0.7

Floats = NDArray[np.float64]


class Boxes(NamedTuple):
    """Boxes of N objects, and what their labels and sizes say."""

    low: Floats  # (N, 3)
    high: Floats  # (N, 3)
    structure: NDArray[np.bool_]  # (N,) walls, floors, ceilings, and what is half of the map
    floor: NDArray[np.bool_]  # (N,) by label, as the next four
    wall: NDArray[np.bool_]
    ceiling: NDArray[np.bool_]
    door: NDArray[np.bool_]
    built_in: NDArray[np.bool_]
    footprint: Floats  # (N,) [m2]


class Triangles(NamedTuple):
    """Triangles sorted by object, and their boxes."""

    corners: NDArray[np.float32]  # (T, 3 corners, 3)
    low: NDArray[np.float32]
    high: NDArray[np.float32]
    level: NDArray[np.bool_]
    starts: NDArray[np.int64]  # (N + 1,)

    def in_box(self, row: int, low: Floats, high: Floats, *, level: bool = False) -> bool:
        """Return whether a triangle of an object (a level one) reaches into a box."""
        own = slice(self.starts[row], self.starts[row + 1])
        near = np.flatnonzero((self.low[own, 2] <= high[2]) & (self.high[own, 2] >= low[2]))
        near += own.start
        if level:
            near = near[self.level[near]]
        for axis in (0, 1):
            near = near[(self.low[near, axis] <= high[axis]) & (self.high[near, axis] >= low[axis])]
        return bool(near.size) and bool(overlaps_box(self.corners[near], low, high).any())


def overlaps_box(corners: NDArray[np.float32], low: Floats, high: Floats) -> NDArray[np.bool_]:
    """Return which triangles (T, 3 corners, 3) reach into a box, by the separating axis theorem."""
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


def measure_boxes(mesh: Mesh, labels: Sequence[str]) -> Boxes:
    """Return boxes of the objects of a mesh."""
    bounds = mesh.object_bounds(len(labels))
    low, high = bounds[:, 0], bounds[:, 1]
    sides = high - low
    footprint = sides[:, 0] * sides[:, 1]
    whole = np.prod((high.max(axis=0) - low.min(axis=0))[:2])
    words = [(split_label(label) or [""])[-1] for label in labels]
    floor = np.array([is_floor(label) for label in labels])
    wall, ceiling, door, built_in = (
        np.array([word in known for word in words])
        for known in (_WALLS, _CEILINGS, _DOORS, _BUILT_IN)
    )
    structure = floor | wall | ceiling | (footprint >= 0.5 * whole)
    return Boxes(low, high, structure, floor, wall, ceiling, door, built_in, footprint)


def triangles_of(mesh: Mesh, count: int) -> Triangles:
    """Return triangles of a mesh of `count` objects, by object."""
    order = np.argsort(mesh.object_of, kind="stable")
    corners = mesh.vertices[mesh.triangles[order]]
    normals = mesh.normals()[order]
    level = np.abs(normals[:, 2]) > _LEVEL * np.linalg.norm(normals, axis=1)
    starts = np.searchsorted(mesh.object_of[order], np.arange(count + 1))
    return Triangles(corners, corners.min(axis=1), corners.max(axis=1), level, starts)


def near_pairs(boxes: Boxes) -> NDArray[np.int64]:
    """Return pairs (P, 2), both ways, whose footprints are at most `NEXT_DISTANCE` apart: a sweep along x."""
    order = np.argsort(boxes.low[:, 0], kind="stable")
    begin = boxes.low[order, 0]
    until = np.searchsorted(begin, boxes.high[order, 0] + NEXT_DISTANCE, side="right")
    found = []
    for chunk in _chunks(until - np.arange(len(order))):
        reach = until[chunk] - chunk - 1
        first = np.repeat(chunk, reach)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(reach) - reach, reach)
        a, b = order[first], order[second]
        near = (boxes.low[a, 1] <= boxes.high[b, 1] + NEXT_DISTANCE) & (
            boxes.low[b, 1] <= boxes.high[a, 1] + NEXT_DISTANCE
        )
        found.append(np.stack([a[near], b[near]], axis=1))
    one_way = np.concatenate(found)
    return np.concatenate([one_way, one_way[:, ::-1]])


def _chunks(lengths: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    part = np.cumsum(lengths) // 1_000_000
    for value in np.unique(part):
        yield np.flatnonzero(part == value)


def overlap_2d(boxes: Boxes, a: NDArray[np.int64], b: NDArray[np.int64]) -> Floats:
    """Return area [m2] that the footprints of pairs share."""
    sides = np.minimum(boxes.high[a], boxes.high[b]) - np.maximum(boxes.low[a], boxes.low[b])
    area: Floats = np.prod(np.maximum(sides[:, :2], 0.0), axis=1)
    return area


STANDING_ON, INSIDE, ATTACHED_TO, ABOVE, NEXT_TO, SAME_ROOM = (
    "standing on", "inside", "attached to", "above", "next to", "same room",
)  # fmt: skip

CONTACT = 0.05  # What is nearer than this touches [m]
SUPPORT = 0.1
"""A thing may float this much over what it stands on [m]: feet are lost in coarse meshes."""
OVER = 2.0  # One above the other [m]
MAX_RELATED_OBJECTS = 20_000
"""Beyond this many objects, as of a mesh cut to pieces, no relations are made."""

_HOLLOW = 0.2  # what something else is inside of is at least this thick [m]
_SIDE_BY_SIDE = 0.25  # of the lower one's height that the higher one shares
_THIN = 0.01  # boxes of flat things are given this thickness [m]


def find_relations(
    mesh: Mesh, labels: Sequence[str], room_of: NDArray[np.integer] | None = None
) -> list[tuple[int, str, int]]:
    """Return relations (row, relation, row) between the objects of a mesh, sorted.

    `room_of` (N,) is the room of each object, -1 none, as `placegraph.indoor.map.rooms` finds it; where
    it is not given, nothing is in the same room, and things are next to each other through walls.
    """
    count = len(labels)
    if not 1 < count <= MAX_RELATED_OBJECTS:
        return []
    boxes = measure_boxes(mesh, labels)
    rooms = np.full(count, -1) if room_of is None else np.asarray(room_of, np.int64)
    pairs = near_pairs(boxes)
    triangles = triangles_of(mesh, count)
    relation_of: dict[tuple[int, int], str] = {}
    fixed = boxes.built_in[pairs[:, 0]] & boxes.wall[pairs[:, 1]]
    grounded = _find_attached(boxes, triangles, pairs[fixed], relation_of, reach=SUPPORT)
    grounded |= _find_standing(boxes, triangles, pairs[~grounded[pairs[:, 0]]], relation_of)
    grounded |= _find_inside(boxes, pairs, relation_of, grounded)
    free = ~grounded[pairs[:, 0]] & ~boxes.structure[pairs[:, 0]]
    _find_attached(boxes, triangles, pairs[free], relation_of, reach=CONTACT)
    _find_above(boxes, triangles, pairs, relation_of)
    _find_next_to(boxes, pairs[boxes.door[pairs].any(axis=1) | ~_apart(rooms, pairs)], relation_of)
    edges = [(a, relation, b) for (a, b), relation in relation_of.items()]
    return sorted(edges + _span_rooms(boxes, rooms))


def _find_standing(
    boxes: Boxes,
    triangles: Triangles,
    pairs: NDArray[np.int64],
    relation_of: dict[tuple[int, int], str],
) -> NDArray[np.bool_]:
    """Find what stands on what; returns which objects do."""
    a, b = pairs.T
    bottom = boxes.low[a, 2]
    under = (boxes.high[b, 2] >= bottom - SUPPORT) & (boxes.low[b, 2] <= bottom + CONTACT)
    lower = (boxes.high[b, 2] <= bottom + CONTACT) | (boxes.low[b, 2] < bottom - CONTACT)
    lower |= boxes.floor[b] & ~boxes.floor[a]  # of a scan it is as uneven
    lower &= ~boxes.wall[b] & ~boxes.ceiling[a]
    apart = np.any(
        (boxes.low[a, :2] > boxes.high[b, :2]) | (boxes.low[b, :2] > boxes.high[a, :2]), axis=1
    )
    rows = np.flatnonzero(under & lower & ~apart)
    tops = np.minimum(boxes.high[b[rows], 2], bottom[rows] + CONTACT)
    carries = overlap_2d(boxes, a[rows], b[rows]) >= 0.5 * boxes.footprint[a[rows]]
    rows = rows[np.lexsort([-boxes.footprint[b[rows]], -np.round(tops, 3), ~carries])]
    stands = np.zeros(len(boxes.low), np.bool_)
    for i in rows.tolist():
        subject, under_it = int(a[i]), int(b[i])
        if stands[subject] or (under_it, subject) in relation_of:
            continue
        low, high = boxes.low[subject].copy(), boxes.high[subject].copy()
        low[2], high[2] = low[2] - SUPPORT, low[2] + CONTACT
        if triangles.in_box(under_it, low, high, level=True):
            relation_of[subject, under_it] = STANDING_ON
            stands[subject] = True
    return stands


def _find_inside(
    boxes: Boxes,
    pairs: NDArray[np.int64],
    relation_of: dict[tuple[int, int], str],
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
    within &= (volume[b] > 1.5 * volume[a]) & (thin[b].min(axis=1) >= _HOLLOW)
    inside = np.zeros(len(boxes.low), np.bool_)
    rows = np.flatnonzero(within)
    for i in rows[np.argsort(volume[b[rows]], kind="stable")].tolist():
        if not inside[a[i]] and not {(a[i], b[i]), (b[i], a[i])} & relation_of.keys():
            relation_of[int(a[i]), int(b[i])] = INSIDE
            inside[a[i]] = True
    return inside


def _find_attached(
    boxes: Boxes,
    triangles: Triangles,
    pairs: NDArray[np.int64],
    relation_of: dict[tuple[int, int], str],
    *,
    reach: float,
) -> NDArray[np.bool_]:
    """Find what touches what, within `reach` [m]; returns which objects do."""
    a, b = pairs.T
    touching = np.all(
        (boxes.low[a] <= boxes.high[b] + reach) & (boxes.low[b] <= boxes.high[a] + reach), axis=1
    )
    a, b = a[touching], b[touching]
    order = np.lexsort([-boxes.footprint[b], ~boxes.structure[b]])
    held = np.zeros(len(boxes.low), np.bool_)
    for subject, other in zip(a[order].tolist(), b[order].tolist(), strict=True):
        if held[subject] or (other, subject) in relation_of:
            continue
        low, high = boxes.low[subject] - reach, boxes.high[subject] + reach
        if triangles.in_box(other, low, high):
            relation_of[subject, other] = ATTACHED_TO
            held[subject] = True
    return held


def _find_above(
    boxes: Boxes,
    triangles: Triangles,
    pairs: NDArray[np.int64],
    relation_of: dict[tuple[int, int], str],
) -> None:
    carrier = {one: other for (one, other), kind in relation_of.items() if kind == STANDING_ON}
    stands = np.zeros(len(boxes.low), np.bool_)
    stands[list(carrier)] = True
    a, b = pairs[~boxes.structure[pairs].any(axis=1) & ~stands[pairs[:, 0]]].T
    gap = boxes.low[a, 2] - boxes.high[b, 2]
    shared = overlap_2d(boxes, a, b)
    smaller = np.minimum(boxes.footprint[a], boxes.footprint[b])
    rows = np.flatnonzero(
        (gap >= -CONTACT) & (gap <= OVER) & (shared >= 0.5 * smaller) & (smaller > 0)
    )
    half = shared >= 0.5 * boxes.footprint[a]
    under: dict[int, dict[bool, list[int]]] = {}
    for i in rows[np.argsort(gap[rows], kind="stable")].tolist():
        one, other = int(a[i]), int(b[i])
        quarter = (boxes.high[one] - boxes.low[one]) / 4.0
        low, high = boxes.low[one] + quarter, boxes.high[one] - quarter
        low[2], high[2] = boxes.low[other, 2], boxes.low[one, 2] + CONTACT
        if triangles.in_box(other, low, high):
            under.setdefault(one, {}).setdefault(bool(half[i]), []).append(other)
    for one, seen in under.items():
        others = seen.get(True) or seen[False]
        carrying = {below for subject in others for below in _carriers(carrier, subject)}
        best = next((other for other in others if other not in carrying), None)
        if best is not None and (one, best) not in relation_of and (best, one) not in relation_of:
            relation_of[one, best] = ABOVE


def _carriers(carrier: dict[int, int], subject: int) -> Iterator[int]:
    """Yield the supports of an object, from the nearest down."""
    passed = {subject}
    while subject in carrier and carrier[subject] not in passed:
        subject = carrier[subject]
        passed.add(subject)
        yield subject


def _apart(rooms: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.bool_]:
    one, other = rooms[pairs].T
    apart: NDArray[np.bool_] = (one >= 0) & (other >= 0) & (one != other)
    return apart


def _find_next_to(
    boxes: Boxes, pairs: NDArray[np.int64], relation_of: dict[tuple[int, int], str]
) -> None:
    a, b = pairs[~boxes.structure[pairs].any(axis=1)].T
    apart = np.maximum(boxes.low[a], boxes.low[b]) - np.minimum(boxes.high[a], boxes.high[b])
    tall = boxes.high[:, 2] - boxes.low[:, 2]
    beside = -apart[:, 2] >= _SIDE_BY_SIDE * np.minimum(tall[a], tall[b])
    beside &= apart[:, 2] < 0
    # one sits at a window that begins above the seat
    beside |= (boxes.built_in[a] | boxes.built_in[b]) & (apart[:, 2] <= NEXT_DISTANCE)
    near = beside & (np.hypot(*np.maximum(apart[:, :2], 0.0).T) <= NEXT_DISTANCE)
    for one, other in zip(a[near].tolist(), b[near].tolist(), strict=True):
        other_way = relation_of.get((other, one), NEXT_TO)
        if other_way == NEXT_TO:
            relation_of.setdefault((one, other), NEXT_TO)


def _span_rooms(boxes: Boxes, rooms: NDArray[np.int64]) -> list[tuple[int, str, int]]:
    """Return shortest tree through the middles of each room's things, both ways: Prim's algorithm."""
    middle = (boxes.low + boxes.high) / 2.0
    edges: list[tuple[int, str, int]] = []
    for room in range(int(rooms.max(initial=-1)) + 1):
        left = np.flatnonzero((rooms == room) & ~boxes.structure)
        if not left.size:
            continue
        at, left = int(left[0]), left[1:]
        distance = np.full(len(left), np.inf)
        nearest = np.full(len(left), at)
        while left.size:
            fresh = ((middle[left] - middle[at]) ** 2).sum(axis=1)
            nearest[fresh < distance] = at
            distance = np.minimum(distance, fresh)
            i = int(distance.argmin())
            at, other = int(left[i]), int(nearest[i])
            edges += [(at, SAME_ROOM, other), (other, SAME_ROOM, at)]
            # the last one takes the place of the one that is done
            for column in (left, distance, nearest):
                column[i] = column[-1]
            left, distance, nearest = left[:-1], distance[:-1], nearest[:-1]
    return edges


Meaning = tuple[str, bool]  # A relation, and whether subject and object change places

LEFT, FRONT, HIGHER, BIGGER = "left", "front", "higher than", "bigger than"
LEANING, PART, COVER = "leaning against", "part of", "cover"

CANONICAL: dict[str, Meaning] = {
    # 3DSSG's, those of its subset; left, right, front, behind are as seen by who labelled the scan
    "supported by": (STANDING_ON, False), "left": (LEFT, False), "right": (LEFT, True),
    "front": (FRONT, False), "behind": (FRONT, True), "close by": (NEXT_TO, False),
    "inside": (INSIDE, False), "bigger than": (BIGGER, False), "smaller than": (BIGGER, True),
    "higher than": (HIGHER, False), "lower than": (HIGHER, True),
    "same symmetry as": ("same symmetry as", False), "same as": ("same as", False),
    "attached to": (ATTACHED_TO, False), "standing on": (STANDING_ON, False),
    "lying on": (STANDING_ON, False), "hanging on": (ATTACHED_TO, False),
    "connected to": (ATTACHED_TO, False), "leaning against": (LEANING, False),
    "part of": (PART, False), "belonging to": (PART, False), "build in": (ATTACHED_TO, False),
    "standing in": (INSIDE, False), "cover": (COVER, False), "lying in": (INSIDE, False),
    "hanging in": (INSIDE, False),
    # ours
    "above": (ABOVE, False), "next to": (NEXT_TO, False), "same room": (SAME_ROOM, False),
}  # fmt: skip
"""Relation that each name of an edge stands for; a name that is not here stands for itself."""

_ASKED: dict[str, tuple[Meaning, ...]] = {
    "on, on top of, atop, upon, onto": (  # a picture is on a wall
        (STANDING_ON, False), (ATTACHED_TO, False), (COVER, False),
    ),
    "standing on, sitting on, lying on, resting on, placed on, stands on, sits on, lies on": (
        (STANDING_ON, False),
    ),
    "supporting, carrying, supports, carries": ((STANDING_ON, True),),
    "attached to, hanging on, hanging from, mounted on, fixed to, fastened to, connected to": (
        (ATTACHED_TO, False), (PART, False),
    ),
    "part of, belonging to": ((PART, False), (ATTACHED_TO, False)),
    "build in, built in, built into": ((ATTACHED_TO, False), (INSIDE, False)),
    "in, inside, inside of, within, contained in, stored in": ((INSIDE, False),),
    "containing, contains, holding, holds": ((INSIDE, True),),
    "above, over, hanging over, hanging above": ((ABOVE, False),),
    "under, underneath, below, beneath": ((ABOVE, True), (STANDING_ON, True)),
    "next to, right next to, beside, near, near to, nearby, close by, close to, by, at, alongside": (
        (NEXT_TO, False), (LEANING, False), (LEANING, True),
    ),
    "leaning against, leaning on, against": (
        (LEANING, False), (ATTACHED_TO, False), (NEXT_TO, False),
    ),
    "left of, to left of, on left of, on left side of": ((LEFT, False),),
    "right of, to right of, on right of, on right side of": ((LEFT, True),),
    "in front of": ((FRONT, False),),
    "in back of": ((FRONT, True),),
    "larger than": ((BIGGER, False),),
    "taller than": ((HIGHER, False),),
    "covering, covers": ((COVER, False),),
    "in same room as, same room as, in room with, in room of": ((SAME_ROOM, False),),
}  # fmt: skip
_READINGS = {name: meanings for names, meanings in _ASKED.items() for name in names.split(", ")}
_IDLE = frozenset({"is", "are", "that", "which", "the", "a", "an", "directly", "just"})


def normalize_relation(relation: str) -> Meaning:
    """Return the relation that the name of an edge means; unknown names mean themselves."""
    name = _strip_fillers(relation)
    return _drop_symmetric_turn(*(CANONICAL.get(name) or _READINGS.get(name, ((name, False),))[0]))


def interpret_relation(query: str) -> frozenset[Meaning]:
    """Return the meanings of a queried relation: "under" is "above" reversed, or "standing on"."""
    name = _strip_fillers(query)
    return frozenset(_drop_symmetric_turn(*r) for r in _READINGS.get(name, ())) or frozenset(
        {normalize_relation(name)}
    )


def matches_label(query: str, label: str) -> bool:
    """Return whether a label may be what is asked for: "chairs" and "desk chair", "DeskChair" and "chair".

    The last words are the same but for the plural, and what comes before does not differ: a "desk
    chair" is a "chair", but no "kitchen chair". Nothing asked for is anything.
    """
    wanted, own = split_label(query), split_label(label)
    if not wanted or not own:
        return not wanted
    if not set(singular_forms(wanted[-1])) & set(singular_forms(own[-1])):
        return False
    return set(wanted[:-1]) <= set(own[:-1]) or set(own[:-1]) <= set(wanted[:-1])


def _strip_fillers(name: str) -> str:
    """Return words of a relation in lower case, but for those that change nothing."""
    words = [word for word in re.split(r"[\s_-]+", name.lower()) if word]
    return " ".join([word for word in words if word not in _IDLE] or words)


def _drop_symmetric_turn(relation: str, turned: bool) -> Meaning:
    """Normalize a meaning: relations that hold both ways are never turned."""
    return relation, turned and relation != NEXT_TO and not relation.startswith("same ")
