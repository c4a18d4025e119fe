"""Relations between the objects of a scene, from their boxes and triangles.

In this order, of which the first that holds for a pair is kept:

- A *attached to* B first for what is built in, by its label: windows, doors, curtains, where a wall
  is within 10 cm.
- A *standing on* B: level triangles of B lie under A's box, from 10 cm below its bottom to 5 cm
  above, and B as a whole lies lower or begins lower; of several B those under at least half of A
  first, then the highest, then the largest. Nothing stands on a wall, and no ceiling on anything.
- A *inside* B: A stands on nothing, and at least 90 % of its box lies in B's, which is larger, and
  nowhere thinner than 20 cm: doors and boards hold nothing.
- A *attached to* B: A stands on nothing and is in nothing, and B's triangles come within 5 cm of
  its box: of several B walls, ceilings and floors first, then the largest.
- A *above* B: A stands on nothing, its bottom is over B's top, by at most 2 m, half of the smaller
  footprint overlaps, and B itself, not its box alone, lies under the middle of A; of several B
  those under at least half of A first, of these none that carries another, then the highest.
- A *next to* B, and B next to A: their boxes overlap in height, by a quarter of the lower one (a
  window may be 0.5 m higher), and are at most 0.5 m apart; they are not known to be in two rooms,
  or one is a door.

Walls, floors and ceilings (by the label's last word, or because their footprint is half of the
map's) are never inside, above or next to anything.

Where rooms are known, A *same room* B besides, and B same room A: as few as tell it of all, namely
the shortest tree through the things of a room. It goes on from one to the next: what is connected
by such relations is in one room (`placegraph.indoor.map.relations.words.find` follows them).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.relations.boxes import (
    NEXT,
    Boxes,
    Triangles,
    boxes_of,
    near_pairs,
    overlap_2d,
    triangles_of,
)

STANDING_ON, INSIDE, ATTACHED_TO, ABOVE, NEXT_TO, SAME_ROOM = (
    "standing on", "inside", "attached to", "above", "next to", "same room",
)  # fmt: skip
RELATIONS = (STANDING_ON, INSIDE, ATTACHED_TO, ABOVE, NEXT_TO, SAME_ROOM)

CONTACT = 0.05
"""What is nearer than this touches [m]."""
SUPPORT = 0.1
"""A thing may float this much over what it stands on [m]: feet are lost in coarse meshes."""
OVER = 2.0
"""One above the other [m]."""
MOST_OBJECTS = 20_000
"""Beyond this many objects, as of a mesh cut to pieces, no relations are made."""

_HOLLOW = 0.2  # what something else is inside of is at least this thick [m]
_SIDE_BY_SIDE = 0.25  # of the lower one's height that the higher one shares
_THIN = 0.01  # boxes of flat things are given this thickness [m]


def relate(
    mesh: Mesh, labels: Sequence[str], room_of: NDArray[np.integer] | None = None
) -> list[tuple[int, str, int]]:
    """Relations (row, relation, row) between the objects of a mesh, sorted.

    `room_of` (N,) is the room of each object, -1 none, as `placegraph.indoor.map.rooms` finds it; where
    it is not given, nothing is in the same room, and things are next to each other through walls.
    """
    count = len(labels)
    if not 1 < count <= MOST_OBJECTS:
        return []
    boxes = boxes_of(mesh, labels)
    rooms = np.full(count, -1) if room_of is None else np.asarray(room_of, np.int64)
    pairs = near_pairs(boxes)
    triangles = triangles_of(mesh, count)
    found: dict[tuple[int, int], str] = {}
    fixed = boxes.built_in[pairs[:, 0]] & boxes.wall[pairs[:, 1]]
    grounded = _attached(boxes, triangles, pairs[fixed], found, reach=SUPPORT)
    grounded |= _standing(boxes, triangles, pairs[~grounded[pairs[:, 0]]], found)
    grounded |= _inside(boxes, pairs, found, grounded)
    free = ~grounded[pairs[:, 0]] & ~boxes.structure[pairs[:, 0]]
    _attached(boxes, triangles, pairs[free], found, reach=CONTACT)
    _above(boxes, triangles, pairs, found)
    _next_to(boxes, pairs[boxes.door[pairs].any(axis=1) | ~_apart(rooms, pairs)], found)
    edges = [(a, relation, b) for (a, b), relation in found.items()]
    return sorted(edges + _same_room(boxes, rooms))


def _standing(
    boxes: Boxes, triangles: Triangles, pairs: NDArray[np.int64], found: dict[tuple[int, int], str]
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
    boxes: Boxes,
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
    within &= (volume[b] > 1.5 * volume[a]) & (thin[b].min(axis=1) >= _HOLLOW)
    inside = np.zeros(len(boxes.low), np.bool_)
    rows = np.flatnonzero(within)
    for i in rows[np.argsort(volume[b[rows]], kind="stable")].tolist():
        if not inside[a[i]] and not {(a[i], b[i]), (b[i], a[i])} & found.keys():
            found[int(a[i]), int(b[i])] = INSIDE
            inside[a[i]] = True
    return inside


def _attached(
    boxes: Boxes,
    triangles: Triangles,
    pairs: NDArray[np.int64],
    found: dict[tuple[int, int], str],
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
    for thing, other in zip(a[order].tolist(), b[order].tolist(), strict=True):
        if held[thing] or (other, thing) in found:
            continue
        low, high = boxes.low[thing] - reach, boxes.high[thing] + reach
        if triangles.in_box(other, low, high):
            found[thing, other] = ATTACHED_TO
            held[thing] = True
    return held


def _above(
    boxes: Boxes, triangles: Triangles, pairs: NDArray[np.int64], found: dict[tuple[int, int], str]
) -> None:
    carrier = {one: other for (one, other), kind in found.items() if kind == STANDING_ON}
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
        carrying = {below for thing in others for below in _carriers(carrier, thing)}
        best = next((other for other in others if other not in carrying), None)
        if best is not None and (one, best) not in found and (best, one) not in found:
            found[one, best] = ABOVE


def _carriers(carrier: dict[int, int], thing: int) -> Iterator[int]:
    """What a thing stands on, what that stands on, and so on."""
    passed = {thing}
    while thing in carrier and carrier[thing] not in passed:
        thing = carrier[thing]
        passed.add(thing)
        yield thing


def _apart(rooms: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which pairs are known to be in two rooms."""
    one, other = rooms[pairs].T
    apart: NDArray[np.bool_] = (one >= 0) & (other >= 0) & (one != other)
    return apart


def _next_to(boxes: Boxes, pairs: NDArray[np.int64], found: dict[tuple[int, int], str]) -> None:
    a, b = pairs[~boxes.structure[pairs].any(axis=1)].T
    apart = np.maximum(boxes.low[a], boxes.low[b]) - np.minimum(boxes.high[a], boxes.high[b])
    tall = boxes.high[:, 2] - boxes.low[:, 2]
    beside = -apart[:, 2] >= _SIDE_BY_SIDE * np.minimum(tall[a], tall[b])
    beside &= apart[:, 2] < 0
    # one sits at a window that begins above the seat
    beside |= (boxes.built_in[a] | boxes.built_in[b]) & (apart[:, 2] <= NEXT)
    near = beside & (np.hypot(*np.maximum(apart[:, :2], 0.0).T) <= NEXT)
    for one, other in zip(a[near].tolist(), b[near].tolist(), strict=True):
        other_way = found.get((other, one), NEXT_TO)
        if other_way == NEXT_TO:
            found.setdefault((one, other), NEXT_TO)


def _same_room(boxes: Boxes, rooms: NDArray[np.int64]) -> list[tuple[int, str, int]]:
    """Shortest tree through the middles of each room's things, both ways: Prim's algorithm."""
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
