# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `objects` and `extract`: outlines made simpler, their middles, and their order."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel


@kernel
def _keep(points, starts, tolerance):
    keep = np.zeros(len(points), np.bool_)
    stack = np.empty((len(points) + 2, 2), np.int64)
    for part in range(len(starts) - 1):
        first, last = starts[part], starts[part + 1] - 1
        if last < first:
            continue
        keep[first] = keep[last] = True
        stack[0, 0], stack[0, 1] = first, last
        depth = 1
        while depth:
            depth -= 1
            i, j = stack[depth]
            x0, y0 = points[i]
            dx, dy = points[j, 0] - x0, points[j, 1] - y0
            length2 = dx * dx + dy * dy
            worst, at = 0.0, -1
            for k in range(i + 1, j):
                x, y = points[k, 0] - x0, points[k, 1] - y0
                t = 0.0 if length2 == 0.0 else min(1.0, max(0.0, (x * dx + y * dy) / length2))
                d = (x - t * dx) ** 2 + (y - t * dy) ** 2
                if d > worst:
                    worst, at = d, k
            if worst > tolerance * tolerance:
                keep[at] = True
                stack[depth, 0], stack[depth, 1] = i, at
                stack[depth + 1, 0], stack[depth + 1, 1] = at, j
                depth += 2
    return keep


@kernel
def _centers(kind, part_starts, point_starts, points):
    n = len(kind)
    out = np.zeros((n, 2), np.float32)
    for row in range(n):
        a, b = point_starts[part_starts[row]], point_starts[part_starts[row + 1]]
        if b == a:
            continue
        ox, oy = points[a]
        twice, cx, cy = 0.0, 0.0, 0.0
        length = 0.0
        for part in range(part_starts[row], part_starts[row + 1]):
            for i in range(point_starts[part], point_starts[part + 1] - 1):
                x0, y0 = points[i, 0] - ox, points[i, 1] - oy
                x1, y1 = points[i + 1, 0] - ox, points[i + 1, 1] - oy
                cross = x0 * y1 - x1 * y0
                twice += cross
                cx += (x0 + x1) * cross
                cy += (y0 + y1) * cross
                length += np.hypot(x1 - x0, y1 - y0)
        if kind[row] == 2 and abs(twice) > 1e-3:
            out[row, 0], out[row, 1] = ox + cx / (3.0 * twice), oy + cy / (3.0 * twice)
            continue
        # half way along the line
        left = 0.5 * length
        out[row, 0], out[row, 1] = ox, oy
        for part in range(part_starts[row], part_starts[row + 1]):
            for i in range(point_starts[part], point_starts[part + 1] - 1):
                step = np.hypot(points[i + 1, 0] - points[i, 0], points[i + 1, 1] - points[i, 1])
                if left >= 0.0 and step > 0.0 and left <= step:
                    t = left / step
                    out[row, 0] = points[i, 0] + t * (points[i + 1, 0] - points[i, 0])
                    out[row, 1] = points[i, 1] + t * (points[i + 1, 1] - points[i, 1])
                    left = -1.0
                elif left >= 0.0:
                    left -= step
    return out


@kernel
def _boxes(part_starts, point_starts, points):
    box = np.empty((len(part_starts) - 1, 4), np.float32)
    for row in range(len(box)):
        a, b = point_starts[part_starts[row]], point_starts[part_starts[row + 1]]
        west, south = points[a]
        east, north = west, south
        for i in range(a + 1, b):
            west, east = min(west, points[i, 0]), max(east, points[i, 0])
            south, north = min(south, points[i, 1]), max(north, points[i, 1])
        box[row] = west, south, east, north
    return box


@kernel
def along_curve(steps):
    """Position (N,) along a Hilbert curve, 2^18 steps a side: neighbours stay neighbours."""
    found = np.zeros(len(steps), np.int64)
    for i in range(len(steps)):
        x, y = steps[i]
        for bit in range(17, -1, -1):
            side = np.int64(1) << bit
            right, up = (x >> bit) & 1, (y >> bit) & 1
            found[i] += side * side * ((3 * right) ^ up)
            x, y = x & (side - 1), y & (side - 1)
            if not up:
                if right:
                    x, y = side - 1 - x, side - 1 - y
                x, y = y, x
    return found
