# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `sample`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.map.raster_kernels import nearest_on_parts


@kernel
def _nearest(kind, part_starts, point_starts, points, nearby, east, north):
    """Nearest points (n, 2) of objects, seen from a position [m]."""
    out = np.empty((len(nearby), 2))
    for i in range(len(nearby)):
        o = nearby[i]
        x, y, _ = nearest_on_parts(part_starts, point_starts, points, kind[o], o, east, north)
        out[i] = x, y
    return out
