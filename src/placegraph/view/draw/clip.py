"""Cutting lines and rings: to a rectangle (a ferry to Corsica must not fill the page), to dashes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.geometry import Floats

if TYPE_CHECKING:
    from placegraph.view.draw.canvas import Bounds, Points


def overlap(a: Bounds, b: Bounds) -> bool:
    """Whether two rectangles have an area in common."""
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def clip_line(points: Points, bounds: Bounds) -> list[Floats]:
    """Pieces (n, 2) of a line (N, 2) that lie within bounds, by Liang and Barsky's parameters."""
    line = np.asarray(points, np.float64)
    low, high = np.array(bounds[:2]), np.array(bounds[2:])
    if ((line >= low) & (line <= high)).all():
        return [line]
    start, delta = line[:-1], np.diff(line, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        at_low, at_high = (low - start) / delta, (high - start) / delta
    still = delta == 0.0
    inside = (start >= low) & (start <= high)
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(at_low, at_high))
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(at_low, at_high))
    first, last = np.maximum(enter.max(axis=1), 0.0), np.minimum(leave.min(axis=1), 1.0)
    pieces: list[list[Floats]] = []
    through = False
    for i in np.flatnonzero(first < last):
        a, b = start[i] + first[i] * delta[i], start[i] + last[i] * delta[i]
        if through and first[i] == 0.0:
            pieces[-1].append(b)
        else:
            pieces.append([a, b])
        through = last[i] == 1.0
    return [np.array(piece) for piece in pieces]


def clip_ring(ring: Points, bounds: Bounds) -> Floats:
    """Part (n, 2) of a closed ring (N, 2) in bounds, by Sutherland and Hodgman; may be empty."""
    corners: Floats = np.asarray(ring, np.float64)
    sides = ((0, 1, bounds[0]), (1, 1, bounds[1]), (0, -1, bounds[2]), (1, -1, bounds[3]))
    for axis, sign, limit in sides:
        inside = sign * corners[:, axis] >= sign * limit
        if inside.all():
            continue
        ahead, ahead_inside = np.roll(corners, -1, axis=0), np.roll(inside, -1)
        kept: list[Floats] = []
        for a, b, a_in, b_in in zip(corners, ahead, inside, ahead_inside, strict=True):
            if a_in:
                kept.append(a)
            if a_in != b_in:
                kept.append(a + (limit - a[axis]) / (b[axis] - a[axis]) * (b - a))
        if not kept:
            return np.zeros((0, 2))
        corners = np.array(kept)
    return corners if (corners[0] == corners[-1]).all() else np.concatenate([corners, corners[:1]])


def dashes(points: Points, drawn: float, blank: float) -> list[Floats]:
    """Cut a polyline into dashes; the dashed length starts and ends with half a dash."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    along = np.concatenate(([0.0], np.cumsum(steps)))
    starts = np.arange(-drawn / 2, along[-1], drawn + blank)
    pieces = []
    for start in starts:
        a, b = max(start, 0.0), min(start + drawn, along[-1])
        inner = along[(along > a) & (along < b)]
        at = np.concatenate(([a], inner, [b]))
        pieces.append(np.stack([np.interp(at, along, points[:, k]) for k in range(2)], axis=1))
    return pieces
