"""Lines and areas cut at the edges of a box: of a long road, what lies in a tile."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geo import Box
from placegraph.outdoor.map.objects import AREA

Points = NDArray[np.float64]


def clip(kind: int, parts: Sequence[Points], box: Box, spare: float = 0.0) -> list[Points]:
    """Parts, lines or rings (n, 2), of a thing within a box; none where it lies outside.

    What sticks out by at most `spare` (in the box's unit) stays whole. A ring that leaves the box
    goes on along its edge.
    """
    low, high = np.array(box[:2]), np.array(box[2:])
    points = np.concatenate(parts)
    lowest, highest = points.min(axis=0), points.max(axis=0)
    if (lowest > high).any() or (highest < low).any():
        return []
    if (lowest >= low - spare).all() and (highest <= high + spare).all():
        return list(parts)
    if kind == AREA:
        rings = (_ring(part, low, high) for part in parts)
        return [ring for ring in rings if len(ring) > 3]
    return [piece for part in parts for piece in _pieces(part, low, high)]


def _ring(ring: Points, low: Points, high: Points) -> Points:
    """A ring within a box, by Sutherland and Hodgman: edge after edge of the box."""
    for axis in (0, 1):
        for side, sign in ((low[axis], 1.0), (high[axis], -1.0)):
            if not len(ring):
                return ring
            depth = sign * (ring[:, axis] - side)
            inside, start, end = depth >= 0.0, ring[:-1], ring[1:]
            crosses = inside[:-1] != inside[1:]
            share = np.divide(
                depth[:-1], depth[:-1] - depth[1:], out=np.zeros(len(start)), where=crosses
            )
            met = start + share[:, None] * (end - start)
            ring = np.stack([met, end], 1)[np.stack([crosses, inside[1:]], 1)]
            ring = np.concatenate([ring, ring[:1]])
    return ring


def _pieces(line: Points, low: Points, high: Points) -> list[Points]:
    """Pieces of a line within a box: cut where it meets the edges, and looked at in between."""
    if len(line) == 1:
        return [line] if ((line >= low) & (line <= high)).all() else []
    start, step = line[:-1], np.diff(line, axis=0)
    segments, shares = [], []
    for axis in (0, 1):
        for side in (low[axis], high[axis]):
            share = np.divide(
                side - start[:, axis], step[:, axis],
                out=np.zeros(len(start)), where=step[:, axis] != 0.0,
            )  # fmt: skip
            rows = np.flatnonzero((share > 0.0) & (share < 1.0))
            segments.append(rows)
            shares.append(share[rows])
    segment, share = np.concatenate(segments), np.concatenate(shares)
    order = np.lexsort((share, segment))
    segment, share = segment[order], share[order]
    points = np.insert(line, segment + 1, start[segment] + share[:, None] * step[segment], axis=0)
    middle = (points[:-1] + points[1:]) / 2.0
    inside = ((middle >= low) & (middle <= high)).all(axis=1)
    turns = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False])).astype(np.int8)))
    return [points[first : last + 1] for first, last in turns.reshape(-1, 2)]
