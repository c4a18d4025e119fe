# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled part of `index_build`: what is in sight of all points of a grid, thing after thing.

Points stand in tiles of `SIDE` times `SIDE`, and what is found of a thing is told tile by tile: 64 bits
say which of its points have the thing in sight, and as many vectors, by rising slot, where it stands.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.map.index_kernels import AREA, REACHED, SIDE, SLOTS, ones
from placegraph.outdoor.map.raster_kernels import box_of, crossings

FAR = np.float32(1e30)
LINES = 2
"""Lines of points that are compared with a segment at once."""


@kernel
def seen(kind, part_starts, point_starts, points, rows, grid, window, capacity, most):
    """Things in sight of the points of a `grid` (east, north, stride) within `window`.

    `window` bounds columns and rows of its tiles, the last excluded. Returns, a thing and tile each: thing,
    line and column of the tile, slots, and where its vectors begin (one more); then vectors (E, 2) from
    points to the things; and whether that took at most `most` comparisons of points with boxes and segments.
    """
    east0, north0, stride = grid
    things, lines, columns = (
        np.empty(1024, np.int32),
        np.empty(1024, np.int32),
        np.empty(1024, np.int32),
    )
    slots, first = np.empty(1024, np.int64), np.empty(1025, np.int64)
    where = np.empty((capacity, 2), np.float32)
    crossed = np.empty(64, np.float64)
    near = np.empty((4, 3, SLOTS), np.float32)  # squares of distances, and vectors
    found, used, spent = 0, 0, 0.0
    first[0] = 0
    reach2, step, wide = np.float32(REACHED * REACHED), np.float32(stride), SIDE * stride
    for row in rows:
        a, b = point_starts[part_starts[row]], point_starts[part_starts[row + 1]]
        if b == a:
            continue
        w, e, s, n = box_of(points, a, b)
        c0 = max(window[0], int(np.floor((w - REACHED - east0) / wide)))
        c1 = min(window[1] - 1, int(np.floor((e + REACHED - east0) / wide)))
        r0 = max(window[2], int(np.floor((s - REACHED - north0) / wide)))
        r1 = min(window[3] - 1, int(np.floor((n + REACHED - north0) / wide)))
        if c1 < c0 or r1 < r0:
            continue
        width, height = c1 - c0 + 1, r1 - r0 + 1
        spent += SLOTS * float(width) * height
        spent += SIDE * float(height) * (b - a) if kind[row] == AREA else 0.0
        if spent > most:  # before anything is allocated by it
            return things[:0], lines[:0], columns[:0], slots[:0], first[:1], where[:0], False
        if width * height > len(near):
            near = np.empty((width * height, 3, SLOTS), np.float32)
        for t in range(width * height):
            for k in range(SLOTS):
                near[t, 0, k] = FAR
        west, south = east0 + c0 * wide, north0 + r0 * wide
        # segments reach the grid points around them
        for part in range(part_starts[row], part_starts[row + 1]):
            i0, i1 = point_starts[part], point_starts[part + 1]
            for i in range(i0, max(i0 + 1, i1 - 1)):
                j = min(i + 1, i1 - 1)
                x0, y0 = np.float32(points[i, 0] - west), np.float32(points[i, 1] - south)
                dx, dy = (
                    np.float32(points[j, 0] - points[i, 0]),
                    np.float32(points[j, 1] - points[i, 1]),
                )
                length2 = dx * dx + dy * dy
                inverse = np.float32(0.0) if length2 == 0.0 else np.float32(1.0) / length2
                ca = max(0, int(np.floor((min(x0, x0 + dx) - REACHED) / wide)))
                cb = min(width - 1, int(np.floor((max(x0, x0 + dx) + REACHED) / wide)))
                ra = max(0, int(np.ceil((min(y0, y0 + dy) - REACHED) / stride)))
                rb = min(SIDE * height - 1, int(np.floor((max(y0, y0 + dy) + REACHED) / stride)))
                spent += float(SIDE * max(0, cb - ca + 1)) * max(0, rb - ra + 1)
                if spent > most:
                    return (
                        things[:0],
                        lines[:0],
                        columns[:0],
                        slots[:0],
                        first[:1],
                        where[:0],
                        False,
                    )
                for r in range(ra // LINES, rb // LINES + 1):
                    line, at = r * LINES // SIDE, r * LINES % SIDE * SIDE
                    fy = y0 - np.float32(r * LINES) * step
                    for c in range(ca, cb + 1):
                        fx, t = x0 - np.float32(c * SIDE) * step, line * width + c
                        for k in range(LINES * SIDE):  # so many that they are compiled as vectors
                            ex = fx - np.float32(k & (SIDE - 1)) * step
                            ey = fy - np.float32(k >> 3) * step
                            along = -(ex * dx + ey * dy) * inverse
                            along = along if along > np.float32(0.0) else np.float32(0.0)
                            along = along if along < np.float32(1.0) else np.float32(1.0)
                            px, py = ex + along * dx, ey + along * dy
                            d = px * px + py * py
                            closer = d < near[t, 0, at + k]
                            near[t, 0, at + k] = d if closer else near[t, 0, at + k]
                            near[t, 1, at + k] = px if closer else near[t, 1, at + k]
                            near[t, 2, at + k] = py if closer else near[t, 2, at + k]
        # scan lines fill areas
        if kind[row] == AREA:
            for r in range(
                max(0, int(np.ceil((s - south) / stride))),
                min(SIDE * height - 1, int(np.floor((n - south) / stride))) + 1,
            ):
                crossed, count = crossings(
                    part_starts, point_starts, points, row, south + r * stride, crossed
                )
                for i in range(0, count - 1, 2):
                    ca = max(0, int(np.ceil((crossed[i] - west) / stride)))
                    cb = min(SIDE * width - 1, int(np.floor((crossed[i + 1] - west) / stride)))
                    for c in range(ca, cb + 1):
                        t, k = (
                            (r >> 3) * width + (c >> 3),
                            (r & (SIDE - 1)) * SIDE + (c & (SIDE - 1)),
                        )
                        near[t, 0, k] = near[t, 1, k] = near[t, 2, k] = 0.0
        if used + width * height * SLOTS > len(where):
            where = np.concatenate(
                (where, np.empty_like(where), np.empty((width * height * SLOTS, 2), np.float32))
            )
        if found + width * height > len(things):
            more = max(len(things), width * height)
            things = np.concatenate((things, np.empty(more, np.int32)))
            lines = np.concatenate((lines, np.empty(more, np.int32)))
            columns = np.concatenate((columns, np.empty(more, np.int32)))
            slots = np.concatenate((slots, np.empty(more, np.int64)))
            first = np.concatenate((first, np.empty(more, np.int64)))
        for t in range(width * height):
            bits = np.int64(0)
            for k in range(SLOTS):
                bits |= np.int64(near[t, 0, k] <= reach2) << k
            if bits == 0:
                continue
            things[found], slots[found] = row, bits
            lines[found], columns[found] = r0 + t // width, c0 + t % width
            while bits:
                k = ones((bits & -bits) - 1)
                bits &= bits - 1
                where[used, 0], where[used, 1] = near[t, 1, k], near[t, 2, k]
                used += 1
            found += 1
            first[found] = used
    return (
        things[:found], lines[:found], columns[:found], slots[:found], first[: found + 1], where[:used],
        True,
    )  # fmt: skip
