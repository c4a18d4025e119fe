# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `looks`."""

from __future__ import annotations

from placegraph.compiled import kernel
from placegraph.indoor.map.surface_kernels import colour_at


@kernel
def _paint(surface, triangle, u, v, footprint, out):  # type: ignore[no-untyped-def]
    """Write colours of hits (N, 3)."""
    for i in range(len(triangle)):
        if triangle[i] >= 0:
            out[i, 0], out[i, 1], out[i, 2] = colour_at(
                surface, triangle[i], u[i], v[i], footprint[i]
            )
