# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `nearby`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Floats
from placegraph.core.jit import kernel
from placegraph_lab.tables.outdoor.raw import Ints

BIN = 50.0
"""Edge of the bins that segments are looked up by [m]."""


@kernel
def _rasterize(segments: Floats, low: Floats, nx: int, ny: int) -> tuple[Ints, Ints]:
    """Bins that every segment passes: walk it in steps shorter than a bin, take their boxes."""
    bins, passing = [], []
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        steps = int(np.hypot(bx - ax, by - ay) / BIN) + 1
        for k in range(steps):
            x0, x1 = ax + (bx - ax) * k / steps, ax + (bx - ax) * (k + 1) / steps
            y0, y1 = ay + (by - ay) * k / steps, ay + (by - ay) * (k + 1) / steps
            i0, i1 = int((min(x0, x1) - low[0]) / BIN), int((max(x0, x1) - low[0]) / BIN)
            j0, j1 = int((min(y0, y1) - low[1]) / BIN), int((max(y0, y1) - low[1]) / BIN)
            for i in range(i0, min(i1, nx - 1) + 1):
                for j in range(j0, min(j1, ny - 1) + 1):
                    bins.append(i * ny + j)
                    passing.append(s)
    return np.array(bins, np.int64), np.array(passing, np.int64)


@kernel
def holds(x: float, y: float, segments: Floats) -> bool:
    """Whether (x, y) lies within rings given by their segments (even-odd rule)."""
    odd = False
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        if (ay > y) != (by > y) and x < ax + (bx - ax) * (y - ay) / (by - ay):
            odd = not odd
    return odd


@kernel
def _nearest_on(x: float, y: float, segments: Floats) -> tuple[float, float, float]:
    """Nearest point to (x, y) on any of the segments, and its squared distance."""
    best, px, py = np.inf, 0.0, 0.0
    for s in range(len(segments)):
        ax, ay, bx, by = segments[s]
        dx, dy = bx - ax, by - ay
        length2 = dx * dx + dy * dy
        t = 0.0
        if length2 > 0.0:
            t = min(1.0, max(0.0, ((x - ax) * dx + (y - ay) * dy) / length2))
        qx, qy = ax + t * dx, ay + t * dy
        d2 = (qx - x) ** 2 + (qy - y) ** 2
        if d2 < best:
            best, px, py = d2, qx, qy
    return px, py, best


@kernel
def _candidates(
    x: float,
    y: float,
    radius: float,
    grid: tuple[Floats, int, int],
    starts: Ints,
    members: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Members, rising and each once, of the bins that a disk touches."""
    low, nx, ny = grid
    i0, i1 = int((x - radius - low[0]) // BIN), int((x + radius - low[0]) // BIN)
    j0, j1 = int((y - radius - low[1]) // BIN), int((y + radius - low[1]) // BIN)
    found = [np.int32(0) for _ in range(0)]
    for i in range(max(i0, 0), min(i1, nx - 1) + 1):
        for j in range(max(j0, 0), min(j1, ny - 1) + 1):
            found.extend(members[starts[i * ny + j] : starts[i * ny + j + 1]])
    return np.unique(np.array(found, np.int32))


@kernel
def _nearest_around(
    viewpoints: Floats,
    radius: float,
    grid: tuple[Floats, int, int],
    bins: tuple[Ints, NDArray[np.int32]],
    lines: tuple[Ints, Floats],
    areas: tuple[NDArray[np.bool_], Floats],
) -> tuple[Ints, NDArray[np.int32], Floats]:
    starts, owners = bins
    segment_starts, segments = lines
    is_area, center = areas
    counted = np.zeros(len(viewpoints), np.int64)
    objects, xs, ys = [], [], []
    for v in range(len(viewpoints)):
        x, y = viewpoints[v]
        for o in _candidates(x, y, radius, grid, starts, owners):
            own = segments[segment_starts[o] : segment_starts[o + 1]]
            if is_area[o] and holds(x, y, own):
                px, py = center[o]
                d2 = (px - x) ** 2 + (py - y) ** 2
            else:
                px, py, d2 = _nearest_on(x, y, own)
            if d2 <= radius * radius:
                objects.append(o)
                xs.append(px)
                ys.append(py)
                counted[v] += 1
    points = np.empty((len(objects), 2))
    points[:, 0] = np.array(xs)
    points[:, 1] = np.array(ys)
    return counted, np.array(objects, np.int32), points


@kernel
def _centers_around(
    viewpoints: Floats,
    radius: float,
    grid: tuple[Floats, int, int],
    starts: Ints,
    order: NDArray[np.int32],
    center: Floats,
) -> tuple[Ints, NDArray[np.int32]]:
    counted = np.zeros(len(viewpoints), np.int64)
    objects = []
    for v in range(len(viewpoints)):
        x, y = viewpoints[v]
        for o in _candidates(x, y, radius, grid, starts, order):
            if (center[o, 0] - x) ** 2 + (center[o, 1] - y) ** 2 <= radius * radius:
                objects.append(o)
                counted[v] += 1
    return counted, np.array(objects, np.int32)
