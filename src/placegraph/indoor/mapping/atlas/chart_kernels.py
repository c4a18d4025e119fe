# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops that cut a surface into charts."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np

from placegraph.core.jit import kernel

STRICT = 1e-3
"""Share of each corner that a texel's centre needs to lie inside a triangle beyond doubt."""


@kernel(error_model="numpy")
def grow(normals, areas, neighbours, order, chart_of, first, least):
    """Give every triangle without a chart (-1) one, from number `first` on; returns the next number.

    A chart grows from the first triangle in `order` over its best neighbours, as long as the cosine
    between their normals (T, 3) and its mean normal is at least `least`. Triangles without area,
    whose normal is zero, always come along.
    """
    chart = first
    for seed in order:
        if chart_of[seed] >= 0:
            continue
        x, y, z = 0.0, 0.0, 0.0
        heap = [(0.0, np.int64(seed))]
        while len(heap) > 0:
            _, row = heappop(heap)
            if chart_of[row] >= 0:
                continue
            a, b, c = normals[row]
            length = np.sqrt(x * x + y * y + z * z)
            if a * x + b * y + c * z < least * length and areas[row] > 0:
                continue
            chart_of[row] = chart
            x, y, z = x + areas[row] * a, y + areas[row] * b, z + areas[row] * c
            length = max(np.sqrt(x * x + y * y + z * z), 1e-30)
            for side in range(3):
                other = neighbours[row, side]
                if other >= 0 and chart_of[other] < 0:
                    p, q, r = normals[other]
                    heappush(heap, (1.0 - (p * x + q * y + r * z) / length, np.int64(other)))
        chart += 1
    return chart


@kernel(error_model="numpy")
def absorb(normals, neighbours, chart_of, planes, small, least):
    """Let the triangles of small charts (C,) join a larger neighbour whose plane suits them best."""
    changed = True
    while changed:
        changed = False
        for row in range(len(chart_of)):
            if not small[chart_of[row]]:
                continue
            best, found = least, -1
            for side in range(3):
                other = neighbours[row, side]
                if other < 0 or small[chart_of[other]]:
                    continue
                plane = planes[chart_of[other]]
                cosine = (
                    normals[row, 0] * plane[0]
                    + normals[row, 1] * plane[1]
                    + normals[row, 2] * plane[2]
                )
                if cosine > best:
                    best, found = cosine, chart_of[other]
            if found >= 0:
                chart_of[row] = found
                changed = True


@kernel(error_model="numpy")
def turns(corners, rows, starts, angles, gain):
    """Angle (C,) that makes each chart's rectangle small; 0 unless another saves the share `gain`.

    `corners`: (T, 3, 2) on the charts' planes; chart c has `rows[starts[c] : starts[c + 1]]`.
    """
    out = np.zeros(len(starts) - 1)
    for chart in range(len(out)):
        least = np.inf
        for angle in angles:
            cosine, sine = np.cos(angle), np.sin(angle)
            left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
            for row in rows[starts[chart] : starts[chart + 1]]:
                for k in range(3):
                    x, y = corners[row, k, 0], corners[row, k, 1]
                    across, down = cosine * x + sine * y, cosine * y - sine * x
                    left, right = min(left, across), max(right, across)
                    top, bottom = min(top, down), max(bottom, down)
            area = (right - left) * (bottom - top)
            if area < least:
                # the first angle, 0, sets a bar that others must clear
                least, out[chart] = area * (1.0 - gain) if angle == 0.0 else area, angle
    return out


@kernel(error_model="numpy")
def overlapping(corners, rows, starts, sizes, twice, first, last):
    """Mark in `twice` (T,) what lies over another triangle of its chart, at the texels' centres.

    `corners`: (T, 3, 2) [texels] on each chart's grid, whose size is `sizes` (C, 2).
    Of two triangles at one place the first in `rows` stays.
    """
    for chart in range(first, last):
        if starts[chart + 1] - starts[chart] < 2:
            continue
        wide, high = int(sizes[chart, 0]), int(sizes[chart, 1])
        taken = np.zeros((high, wide), np.bool_)
        for row in rows[starts[chart] : starts[chart + 1]]:
            twice[row] = _covers(corners[row], taken, False)
            if not twice[row]:
                _covers(corners[row], taken, True)


@kernel(error_model="numpy")
def _covers(corner, taken, take):
    """Whether a triangle (3, 2) covers a texel's centre that is taken; or take those it covers."""
    ax, ay = corner[0]
    bx, by = corner[1, 0] - ax, corner[1, 1] - ay
    cx, cy = corner[2, 0] - ax, corner[2, 1] - ay
    area = bx * cy - by * cx
    if area == 0:
        return False
    left = max(int(np.floor(corner[:, 0].min() - 0.5)), 0)
    top = max(int(np.floor(corner[:, 1].min() - 0.5)), 0)
    right = min(int(corner[:, 0].max() + 0.5) + 1, taken.shape[1])
    bottom = min(int(corner[:, 1].max() + 0.5) + 1, taken.shape[0])
    for i in range(top, bottom):
        for j in range(left, right):
            x, y = j + 0.5 - ax, i + 0.5 - ay
            u, v = (x * cy - y * cx) / area, (bx * y - by * x) / area
            if u > STRICT and v > STRICT and u + v < 1 - STRICT:
                if take:
                    taken[i, j] = True
                elif taken[i, j]:
                    return True
    return False


@kernel(error_model="numpy")
def spread(neighbours, colours, known):
    """Colour triangles (T, 3) that are not known like the neighbours that are, ring by ring."""
    queue = np.empty(len(known), np.int64)
    last = 0
    for row in range(len(known)):
        if known[row]:
            queue[last] = row
            last += 1
    first = 0
    while first < last:
        row = queue[first]
        first += 1
        for side in range(3):
            other = neighbours[row, side]
            if other >= 0 and not known[other]:
                _mean_of(neighbours, colours, known, other)
                known[other] = True
                queue[last] = other
                last += 1


@kernel(error_model="numpy")
def _mean_of(neighbours, colours, known, row):
    count = 0
    colours[row] = 0.0
    for side in range(3):
        other = neighbours[row, side]
        if other >= 0 and known[other]:
            colours[row] += colours[other]
            count += 1
    colours[row] /= count
