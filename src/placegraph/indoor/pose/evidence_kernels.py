# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `evidence`."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.compiled import kernel
from placegraph.indoor.likelihood.score_kernels import aim
from placegraph.indoor.rays.layout import FAR, LANES, TRIANGLE
from placegraph.indoor.rays.packets_kernels import new_packet, trace16

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.indoor.rays.packets_kernels import Tracer


@kernel
def look(
    tracer: Tracer, pose: NDArray[np.float64], directions: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Triangles (R,) int32, -1: none, and depths (R,) float32 [m] from one pose (4,)."""
    n = len(directions)
    triangles = np.empty(n, np.int32)
    distances = np.empty(n, np.float32)
    packet, ints, valid = new_packet()
    for tile in range(n // LANES):
        aim(packet, pose, directions, tile * LANES)
        trace16(tracer, packet, ints, valid)
        for lane in range(LANES):
            triangles[tile * LANES + lane] = ints[TRIANGLE, lane]
            distances[tile * LANES + lane] = packet[FAR, lane]
    return triangles, distances
