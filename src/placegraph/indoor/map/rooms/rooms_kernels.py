# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of `placegraph.indoor.map.rooms`, on grids of cells (nx, ny)."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

_MOST_SAMPLES = 512  # along an edge of a triangle


@kernel
def cut(corners, kinds, heights, origin, cell, found):
    """Draw where triangles (T, 3 corners, 3) meet level planes (K,).

    Sets bit k of `found[kinds[t]]` (kinds, nx, ny) where triangle t meets plane k in a cell; a
    kind below 0 is left out.
    """
    ends = np.empty((3, 2))
    for t in range(len(corners)):
        if kinds[t] < 0:
            continue
        plane = found[kinds[t]]
        low = min(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2])
        high = max(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2])
        for k in range(len(heights)):
            z = heights[k]
            if not low < z <= high:
                continue
            count = 0
            for i in range(3):
                a, b = corners[t, i], corners[t, (i + 1) % 3]
                if (a[2] < z) != (b[2] < z):
                    share = (z - a[2]) / (b[2] - a[2])
                    ends[count, 0] = (a[0] + share * (b[0] - a[0]) - origin[0]) / cell
                    ends[count, 1] = (a[1] + share * (b[1] - a[1]) - origin[1]) / cell
                    count += 1
            if count == 2:
                _line(ends, np.uint32(1 << k), plane)


@kernel
def _line(ends, bit, plane):
    """Set a bit in every cell on the way from one end to the other, in steps of half a cell."""
    dx, dy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    steps = int(2.0 * max(abs(dx), abs(dy))) + 1
    for s in range(steps + 1):
        x, y = int(ends[0, 0] + dx * s / steps), int(ends[0, 1] + dy * s / steps)
        if 0 <= x < plane.shape[0] and 0 <= y < plane.shape[1]:
            plane[x, y] |= bit


@kernel
def cover(corners, chosen, origin, cell, covered):
    """Mark the cells whose centre lies under or over one of the chosen triangles (T, 3, 3)."""
    nx, ny = covered.shape
    for t in range(len(corners)):
        if not chosen[t]:
            continue
        ax, ay = (corners[t, 0, 0] - origin[0]) / cell, (corners[t, 0, 1] - origin[1]) / cell
        bx, by = (corners[t, 1, 0] - origin[0]) / cell, (corners[t, 1, 1] - origin[1]) / cell
        cx, cy = (corners[t, 2, 0] - origin[0]) / cell, (corners[t, 2, 1] - origin[1]) / cell
        doubled = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if doubled == 0.0:
            continue
        west, east = int(min(ax, bx, cx)), int(max(ax, bx, cx))
        south, north = int(min(ay, by, cy)), int(max(ay, by, cy))
        for x in range(max(0, west), min(nx - 1, east) + 1):
            for y in range(max(0, south), min(ny - 1, north) + 1):
                px, py = x + 0.5 - ax, y + 0.5 - ay
                v = (px * (cy - ay) - py * (cx - ax)) / doubled
                w = ((bx - ax) * py - (by - ay) * px) / doubled
                if v >= -1e-6 and w >= -1e-6 and v + w <= 1.000001:
                    covered[x, y] = True


@kernel
def nearest(mask, reach):
    """Squared distance [cells2] of every cell to the nearest one of a mask, and its number x ny + y.

    Where there is none within `reach` cells, it is (reach + 1) squared, and -1. Exact: first along
    columns, then along rows, as far out as a nearer one can lie.
    """
    nx, ny = mask.shape
    far = reach + 1
    column = np.full((nx, ny), far, np.int32)  # signed offset in y
    for x in range(nx):
        last = -1
        for y in range(ny):
            if mask[x, y]:
                last = y
            if last >= 0 and y - last < far:
                column[x, y] = last - y
        last = -1
        for y in range(ny - 1, -1, -1):
            if mask[x, y]:
                last = y
            if last >= 0 and last - y < abs(column[x, y]):
                column[x, y] = last - y
    squared = np.full((nx, ny), far * far, np.int32)
    number = np.full((nx, ny), -1, np.int32)
    for x in range(nx):
        for y in range(ny):
            best, row = far * far, -1
            if abs(column[x, y]) < far:
                best, row = column[x, y] ** 2, x
            k = 1
            while k <= reach and k * k < best:
                for side in (x - k, x + k):
                    if 0 <= side < nx and abs(column[side, y]) < far:
                        d = column[side, y] ** 2 + k * k
                        if d < best:
                            best, row = d, side
                k += 1
            if best <= reach * reach:
                squared[x, y] = best
                number[x, y] = row * ny + y + column[row, y]
    return squared, number


@kernel
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def flood(width, order, least, narrow, door, narrow_door):
    """Basins of half-widths (nx, ny) [m]: from the widest place down, cut where it is narrow.

    Cells are neighbours by their sides: walls askew touch at corners.

    Parameters
    ----------
    width
        Distance to the nearest wall.
    order
        (M,) cells x ny + y to be flooded, widest first.
    least
        A basin whose widest place is narrower is none of its own.
    narrow
        Two basins stay apart if the pass between them is at most this share of the widest place of
        the narrower one; `narrow_door` where the pass is as narrow as `door`.

    Returns
    -------
    Basin of each cell, -1 where it was not flooded; basins that meet (C, 2), the widest pass first.

    """
    nx, ny = width.shape
    flat = width.reshape(-1)
    parent = np.arange(nx * ny)
    seen = np.zeros(nx * ny, np.bool_)
    meetings = np.empty((3 * len(order), 2), np.int64)
    count = 0
    for i in order:
        seen[i] = True
        x, y = i // ny, i % ny
        best = -1
        for k in range(4):  # the widest neighbour's basin, if there is one, takes the cell
            u, v = x + _X[k], y + _Y[k]
            j = u * ny + v
            if 0 <= u < nx and 0 <= v < ny and seen[j] and (best < 0 or flat[j] > flat[best]):
                best = j
        if best < 0:
            continue
        parent[i] = _root(parent, best)
        for k in range(4):
            u, v = x + _X[k], y + _Y[k]
            j = u * ny + v
            if not (0 <= u < nx and 0 <= v < ny and seen[j]):
                continue
            one, other = _root(parent, i), _root(parent, j)
            if one == other:
                continue
            if flat[one] < flat[other]:
                one, other = other, one
            share = narrow_door if flat[i] <= door else narrow
            if flat[other] < least or flat[i] > share * flat[other]:
                parent[other] = one  # a root is its basin's widest place
            elif count < len(meetings):
                meetings[count, 0], meetings[count, 1] = one, other
                count += 1
    basin = np.full(nx * ny, -1)
    for i in order:
        basin[i] = _root(parent, i)
    for c in range(count):
        meetings[c, 0] = _root(parent, meetings[c, 0])
        meetings[c, 1] = _root(parent, meetings[c, 1])
    return basin.reshape(nx, ny), meetings[:count].copy()


_X = np.array([1, -1, 0, 0, 1, 1, -1, -1])
_Y = np.array([0, 0, 1, -1, 1, -1, 1, -1])


@kernel
def pieces(mask):
    """Number the 8-connected parts of a mask (nx, ny) from 0 on; -1 outside of it."""
    nx, ny = mask.shape
    part = np.full((nx, ny), -1, np.int32)
    stack = np.empty(nx * ny, np.int64)
    count = 0
    for x in range(nx):
        for y in range(ny):
            if not mask[x, y] or part[x, y] >= 0:
                continue
            part[x, y] = count
            stack[0] = x * ny + y
            top = 1
            while top:
                top -= 1
                i = stack[top]
                for k in range(8):
                    u, v = i // ny + _X[k], i % ny + _Y[k]
                    if 0 <= u < nx and 0 <= v < ny and mask[u, v] and part[u, v] < 0:
                        part[u, v] = count
                        stack[top] = u * ny + v
                        top += 1
            count += 1
    return part, count


@kernel
def areas_within(corners, areas, object_of, origin, cell, rooms, votes):
    """Add the area [m2] of triangles (T, 3, 3) that lies in each room to `votes` (N, R + 1).

    `rooms` (nx, ny) is the room of a cell; -1, and what is beyond the grid, counts in the last
    column. Triangles are divided until their parts are no longer than two cells.
    """
    nx, ny = rooms.shape
    none = votes.shape[1] - 1
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        reach = max(
            abs(b[0] - a[0]), abs(c[0] - a[0]), abs(c[0] - b[0]),
            abs(b[1] - a[1]), abs(c[1] - a[1]), abs(c[1] - b[1]),
        )  # fmt: skip
        n = min(_MOST_SAMPLES, int(reach / (2.0 * cell)) + 1)
        part = areas[t] / (n * n)
        for i in range(n):
            for j in range(2 * (n - i) - 1):  # triangles upright and upside down by turns
                turned = j % 2
                v = (i + (1.0 + turned) / 3.0) / n
                w = (j // 2 + (1.0 + turned) / 3.0) / n
                x = int(np.floor((a[0] + v * (b[0] - a[0]) + w * (c[0] - a[0]) - origin[0]) / cell))
                y = int(np.floor((a[1] + v * (b[1] - a[1]) + w * (c[1] - a[1]) - origin[1]) / cell))
                room = rooms[x, y] if 0 <= x < nx and 0 <= y < ny else -1
                votes[object_of[t], room if room >= 0 else none] += part
