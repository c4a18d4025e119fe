"""Walls of a level: where rooms end, each once, with openings where doors are."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geometry import Floats

if TYPE_CHECKING:
    from placegraph.indoor.mapping.osm.rooms import Door, Level

THICK = 0.1
"""Of a wall [m]."""
REACH = 0.35
"""Farthest that a door may stand from its wall, and walls of one door from each other [m]."""
_ON = 0.015  # off an edge that a node may lie to be on it [m]
_LINTEL = 0.1  # least that is left of a wall above a door [m]


@dataclass(frozen=True, slots=True, eq=False)
class Wall:
    """A straight wall."""

    start: Floats
    """(2,) [m, map]."""
    end: Floats
    height: float
    """[m]"""
    shift: Floats
    """(2,) from its line to its middle [m]: a room ends at its outline, and the wall lies beyond;
    zero between two rooms, which share it."""

    @property
    def along(self) -> Floats:
        """(2,) unit vector from start to end."""
        along: Floats = (self.end - self.start) / self.length
        return along

    @property
    def length(self) -> float:
        """From start to end [m]."""
        return float(np.linalg.norm(self.end - self.start))

    def in_line_with(self, other: Wall) -> bool:
        """Whether the two lie in one line, or nearly: the two faces of one thick wall do."""
        off = max(abs(_cross(self.along, p - self.start)) for p in (other.start, other.end))
        return bool(off < REACH) and abs(float(self.along @ other.along)) > 0.97

    def opening(self, door: Door) -> tuple[float, float, float]:
        """Where along it an opening begins and ends, beyond its ends too, and how high it is [m]."""
        at, half = float((door.at - self.start) @ self.along), door.width / 2.0
        return at - half, at + half, min(door.height, self.height - _LINTEL)

    def solid(self, doors: list[Door]) -> list[tuple[Floats, Floats, float, float]]:
        """What is left of it: pieces from (2,) to (2,), from one height to another [m]."""
        pieces, at = [], 0.0
        for low, high, top in sorted(self.opening(door) for door in doors):
            first, last = max(low, at), min(high, self.length)
            if last <= first:
                continue
            if first > at:
                pieces.append((at, first, 0.0))
            pieces.append((first, last, top))
            at = last
        if at < self.length:
            pieces.append((at, self.length, 0.0))
        base = self.start + self.shift
        return [
            (base + a * self.along, base + b * self.along, z, self.height) for a, b, z in pieces
        ]


def distances(walls: list[Wall], at: Floats) -> Floats:
    """How far (W,) a point (2,) is from the lines of walls [m]."""
    start, end = (np.array([getattr(w, name) for w in walls]) for name in ("start", "end"))
    return off_segments(at[None], start, end)[0]


def off_segments(points: Floats, starts: Floats, ends: Floats) -> Floats:
    """Distance (N, M) [m] of points (N, 2) to segments (M, 2) and (M, 2)."""
    along = ends - starts
    away = points[:, None] - starts[None]
    share = (away * along).sum(axis=2) / np.maximum((along**2).sum(axis=1), 1e-12)
    off = away - np.clip(share, 0.0, 1.0)[:, :, None] * along
    distances: Floats = np.sqrt((off**2).sum(axis=2))
    return distances


def walls_of(level: Level) -> list[Wall]:
    """Walls of a level: rooms stand in walls; corridors where they border on nothing else; areas in none.

    Where an outline has nodes on another's edge, it is cut there, so that shared walls are one.
    """
    rings = [(room, ring) for room in level.rooms for rings in room.polygons for ring in rings]
    nodes = np.unique(np.round(np.concatenate([ring for _, ring in rings]), 2), axis=0)
    found: dict[tuple[float, ...], list[tuple[str, Wall]]] = {}
    for room, ring in rings:
        for start, end in pairwise(np.round(ring, 2)):
            for a, b in pairwise(_split(start, end, nodes)):
                length = float(np.linalg.norm(b - a))
                if length > _ON:
                    key = (*min(a.tolist(), b.tolist()), *max(a.tolist(), b.tolist()))
                    right = np.array([b[1] - a[1], a[0] - b[0]]) / length  # outside of the room
                    wall = Wall(a, b, room.height, right * THICK / 2.0)
                    found.setdefault(key, []).append((room.shape.kind, wall))
    walls = []
    for around in found.values():
        kinds = [kind for kind, _ in around]
        if kinds == ["corridor"] or "room" in kinds:
            first = around[0][1]
            shift = first.shift if len(around) == 1 else np.zeros(2)
            tallest = max(wall.height for _, wall in around)
            walls.append(Wall(first.start, first.end, tallest, shift))
    for line in level.walls:
        walls += [
            Wall(a, b, level.storey, np.zeros(2))
            for a, b in pairwise(line)
            if np.linalg.norm(b - a) > _ON
        ]
    return walls


def _split(start: Floats, end: Floats, nodes: Floats) -> list[Floats]:
    """Ends of an edge with the nodes of other outlines that lie on it, in order."""
    along, away = end - start, nodes - start
    length = max(float(np.linalg.norm(along)), 1e-9)
    off = np.abs(_cross(along, away)) / length
    share = away @ along / length
    on = np.flatnonzero((off < _ON) & (share > _ON) & (share < length - _ON))
    return [start, *nodes[on[np.argsort(share[on])]], end]


def _cross(a: Floats, b: Floats) -> Floats:
    crossed: Floats = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return crossed
