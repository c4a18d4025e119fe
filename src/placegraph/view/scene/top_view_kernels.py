# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `top_view`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel

STEEP = 0.02
"""Triangles whose footprint is narrower than this share of their length are drawn as lines."""


@kernel
def _draw(
    corners: NDArray[np.float32],
    triangles: NDArray[np.int32],
    lift: NDArray[np.float32],
    triangle: NDArray[np.int32],
    level: NDArray[np.float32],
) -> None:
    """Fill a z-buffer; `corners` (V, 3) are x right, y down [px], z up [m]."""
    rows, columns = triangle.shape
    for t in range(len(triangles)):
        up = lift[t]
        if up == -np.inf:
            continue
        a, b, c = corners[triangles[t, 0]], corners[triangles[t, 1]], corners[triangles[t, 2]]
        west, east = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
        north, south = min(a[1], b[1], c[1]), max(a[1], b[1], c[1])
        if east < 0.0 or south < 0.0 or west >= columns or north >= rows:
            continue
        doubled = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        reach = (east - west) ** 2 + (south - north) ** 2
        if abs(doubled) <= STEEP * reach:
            _line(a, b, t, up, triangle, level)
            _line(b, c, t, up, triangle, level)
            _line(c, a, t, up, triangle, level)
        if doubled == 0.0:
            continue
        for y in range(max(0, int(north)), min(rows, int(south) + 1)):
            for x in range(max(0, int(west)), min(columns, int(east) + 1)):
                px, py = x + 0.5, y + 0.5
                v = ((px - a[0]) * (c[1] - a[1]) - (py - a[1]) * (c[0] - a[0])) / doubled
                w = ((b[0] - a[0]) * (py - a[1]) - (b[1] - a[1]) * (px - a[0])) / doubled
                if v < 0.0 or w < 0.0 or v + w > 1.0:
                    continue
                z = a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2]) + up
                if z > level[y, x]:
                    level[y, x], triangle[y, x] = z, t


@kernel
def _line(
    a: NDArray[np.float32],
    b: NDArray[np.float32],
    t: int,
    up: float,
    triangle: NDArray[np.int32],
    level: NDArray[np.float32],
) -> None:
    """Draw an edge, one pixel wide."""
    rows, columns = triangle.shape
    steps = int(max(abs(b[0] - a[0]), abs(b[1] - a[1]))) + 1
    for k in range(steps + 1):
        s = k / steps
        x, y = int(np.floor(a[0] + s * (b[0] - a[0]))), int(np.floor(a[1] + s * (b[1] - a[1])))
        if 0 <= x < columns and 0 <= y < rows:
            z = a[2] + s * (b[2] - a[2]) + up
            if z > level[y, x]:
                level[y, x], triangle[y, x] = z, t
