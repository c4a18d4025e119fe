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
def compute_centers(kind, part_starts, point_starts, points):
    """Return points, middles of lines and centroids of areas: (N, 2) east, north [m]."""
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
        box[row, 0], box[row, 1], box[row, 2], box[row, 3] = west, south, east, north
    return box


@kernel
def along_curve(steps):
    """Return positions (N,) along a Hilbert curve, 2^18 steps a side: neighbours stay neighbours."""
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


AREA = 2


@kernel(_nrt=False)
def nearest_on_parts(part_starts, point_starts, points, kind, row, east, north):
    """Return the vector from (east, north) to the nearest point of object `row`, and its square [m^2]."""
    best = np.inf
    best_e = best_n = 0.0
    inside = False
    for part in range(part_starts[row], part_starts[row + 1]):
        a, b = point_starts[part], point_starts[part + 1]
        x0, y0 = points[a, 0] - east, points[a, 1] - north
        if b - a == 1:
            d = x0 * x0 + y0 * y0
            if d < best:
                best, best_e, best_n = d, x0, y0
        for i in range(a + 1, b):
            x1, y1 = points[i, 0] - east, points[i, 1] - north
            dx, dy = x1 - x0, y1 - y0
            length2 = dx * dx + dy * dy
            t = 0.0 if length2 == 0.0 else -(x0 * dx + y0 * dy) / length2
            t = min(1.0, max(0.0, t))
            px, py = x0 + t * dx, y0 + t * dy
            d = px * px + py * py
            if d < best:
                best, best_e, best_n = d, px, py
            if kind == AREA and (y0 > 0.0) != (y1 > 0.0) and x0 + (0.0 - y0) / (y1 - y0) * dx > 0.0:
                inside = not inside
            x0, y0 = x1, y1
    if inside:
        return 0.0, 0.0, 0.0
    return best_e, best_n, best


@kernel(finite=True)
def nearest_to_each(part_starts, point_starts, points, kind, row, at, near, squares):
    """Find vectors (2, K) from positions `at` (2, K) to the nearest points of object `row`, and squares (K,).

    As `nearest_on_parts`, of many positions at once: a segment is read once, and compared with all.
    """
    inside = np.zeros(len(squares), np.bool_)
    squares[:] = 1e30
    for part in range(part_starts[row], part_starts[row + 1]):
        a, b = point_starts[part], point_starts[part + 1]
        for i in range(a, max(a + 1, b - 1)):
            ax, ay = np.float64(points[i, 0]), np.float64(points[i, 1])
            j = min(i + 1, b - 1)
            dx, dy = points[j, 0] - ax, points[j, 1] - ay
            length2 = dx * dx + dy * dy
            inverse = 0.0 if length2 == 0.0 else 1.0 / length2
            for k in range(len(squares)):
                x0, y0 = ax - at[0, k], ay - at[1, k]
                t = min(1.0, max(0.0, -(x0 * dx + y0 * dy) * inverse))
                px, py = x0 + t * dx, y0 + t * dy
                d = px * px + py * py
                closer = d < squares[k]
                squares[k] = d if closer else squares[k]
                near[0, k] = px if closer else near[0, k]
                near[1, k] = py if closer else near[1, k]
            if kind == AREA and dy != 0.0:
                slope = dx / dy
                for k in range(len(squares)):
                    x0, y0 = ax - at[0, k], ay - at[1, k]
                    inside[k] ^= ((y0 > 0.0) != (y0 + dy > 0.0)) & (x0 - y0 * slope > 0.0)
    if kind == AREA:
        for k in range(len(squares)):
            if inside[k]:
                near[0, k] = near[1, k] = squares[k] = 0.0


@kernel
def _sort(values, count):
    """Sort the first `count` values, by Shell's method: numba's own takes long to compile."""
    gap = count // 2
    while gap > 0:
        for i in range(gap, count):
            value, j = values[i], i
            while j >= gap and values[j - gap] > value:
                values[j] = values[j - gap]
                j -= gap
            values[j] = value
        gap //= 2


@kernel
def box_of(points, a, b):
    """Return the west, east, south and north end of points."""
    w = e = np.float64(points[a, 0])
    s = n = np.float64(points[a, 1])
    for i in range(a + 1, b):
        w, e = min(w, points[i, 0]), max(e, points[i, 0])
        s, n = min(s, points[i, 1]), max(n, points[i, 1])
    return w, e, s, n


@kernel
def crossings(part_starts, point_starts, points, row, north, easts):
    """Find where the lines of object `row` cross a parallel, from west to east; return their number.

    `easts` is overwritten, and returned larger where it was too small.
    """
    count = 0
    for part in range(part_starts[row], part_starts[row + 1]):
        for i in range(point_starts[part], point_starts[part + 1] - 1):
            y0, y1 = points[i, 1], points[i + 1, 1]
            if (y0 > north) != (y1 > north):
                if count == len(easts):
                    easts = np.concatenate((easts, easts))
                easts[count] = points[i, 0] + (north - y0) / (y1 - y0) * (
                    points[i + 1, 0] - points[i, 0]
                )
                count += 1
    _sort(easts, count)
    return easts, count


@kernel
def _collect(kind, part_starts, point_starts, points, rows, grid, radius, capacity, most):
    """Collect objects near grid points, unsorted; tell whether at most `most` comparisons were enough."""
    east0, north0, stride, columns, n_rows = grid
    at = np.empty(capacity, np.int64)
    who = np.empty(capacity, np.int32)
    where = np.empty((capacity, 2), np.float32)
    used = 0
    spent = 0.0
    best = np.empty(64, np.float64)
    near = np.empty((64, 2), np.float32)
    crossed = np.empty(64, np.float64)
    r2 = radius * radius
    for row in rows:
        a, b = point_starts[part_starts[row]], point_starts[part_starts[row + 1]]
        if b == a:
            continue
        w, e, s, n = box_of(points, a, b)
        c0 = max(0, int(np.ceil((w - radius - east0) / stride)))
        c1 = min(columns - 1, int(np.floor((e + radius - east0) / stride)))
        r0 = max(0, int(np.ceil((s - radius - north0) / stride)))
        r1 = min(n_rows - 1, int(np.floor((n + radius - north0) / stride)))
        if c1 < c0 or r1 < r0:
            continue
        width, height = c1 - c0 + 1, r1 - r0 + 1
        spent += float(width) * height + (height * (b - a) if kind[row] == AREA else 0)
        if spent > most:  # before anything is allocated by it
            return at[:0], who[:0], where[:0], False
        if width * height > len(best):
            best = np.empty(width * height, np.float64)
            near = np.empty((width * height, 2), np.float32)
        best[: width * height] = np.inf
        # segments reach the grid points around them
        for part in range(part_starts[row], part_starts[row + 1]):
            i0, i1 = point_starts[part], point_starts[part + 1]
            for i in range(i0, max(i0 + 1, i1 - 1)):
                j = min(i + 1, i1 - 1)
                x0, y0, x1, y1 = points[i, 0], points[i, 1], points[j, 0], points[j, 1]
                dx, dy = x1 - x0, y1 - y0
                length2 = dx * dx + dy * dy
                ca = max(c0, int(np.ceil((min(x0, x1) - radius - east0) / stride)))
                cb = min(c1, int(np.floor((max(x0, x1) + radius - east0) / stride)))
                ra = max(r0, int(np.ceil((min(y0, y1) - radius - north0) / stride)))
                rb = min(r1, int(np.floor((max(y0, y1) + radius - north0) / stride)))
                spent += float(max(0, rb - ra + 1)) * max(0, cb - ca + 1)
                if spent > most:
                    return at[:0], who[:0], where[:0], False
                for r in range(ra, rb + 1):
                    gy = north0 + r * stride
                    for c in range(ca, cb + 1):
                        gx = east0 + c * stride
                        t = 0.0 if length2 == 0.0 else ((gx - x0) * dx + (gy - y0) * dy) / length2
                        t = min(1.0, max(0.0, t))
                        px, py = x0 + t * dx - gx, y0 + t * dy - gy
                        d = px * px + py * py
                        k = (r - r0) * width + c - c0
                        if d < best[k]:
                            best[k] = d
                            near[k, 0], near[k, 1] = px, py
        # scan lines fill areas
        if kind[row] == AREA:
            for r in range(
                max(r0, int(np.ceil((s - north0) / stride))),
                min(r1, int(np.floor((n - north0) / stride))) + 1,
            ):
                crossed, count = crossings(
                    part_starts, point_starts, points, row, north0 + r * stride, crossed
                )
                for k in range(0, count - 1, 2):
                    ca = max(c0, int(np.ceil((crossed[k] - east0) / stride)))
                    cb = min(c1, int(np.floor((crossed[k + 1] - east0) / stride)))
                    for c in range(ca, cb + 1):
                        best[(r - r0) * width + c - c0] = 0.0
                        near[(r - r0) * width + c - c0] = 0.0
        for r in range(height):
            for c in range(width):
                if best[r * width + c] <= r2:
                    if used == len(at):
                        at, who = np.concatenate((at, at)), np.concatenate((who, who))
                        where = np.concatenate((where, where))
                    at[used] = (r + r0) * columns + c + c0
                    who[used] = row
                    where[used, 0] = near[r * width + c, 0]
                    where[used, 1] = near[r * width + c, 1]
                    used += 1
    return at[:used], who[:used], where[:used], True
