# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `packets`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.indoor.rays.layout import (
    DIRECTION,
    FAR,
    FLAGS,
    GEOMETRY,
    LANES,
    MASK,
    NEAR,
    NONE,
    ORIGIN,
    ROWS,
    TIME,
    TRIANGLE,
    U,
    V,
)
from placegraph.indoor.rays.native_kernels import call
from placegraph.indoor.rays.walk_kernels import walk16


class Tracer(NamedTuple):
    """What traces packets: Embree, or a tree. It keeps alive what it needs."""

    intersect: int
    """Address of ``rtcIntersect16``; 0: the tree is walked."""
    scene: int
    """Embree's scene."""
    arguments: int
    """Embree's intersect arguments."""
    nodes: NDArray[np.float32]
    links: NDArray[np.int32]
    corners: NDArray[np.float32]
    rows: NDArray[np.int32]
    """The tree (`bvh.Bvh`); of one element each where Embree traces."""


@kernel
def new_packet() -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Aligned packet (21, 16) float32, the same memory as int32, and the valid mask (16,) int32."""
    floats = np.zeros((ROWS + 1) * LANES + LANES, np.float32)
    skip = ((-floats.ctypes.data) % 64) // 4
    block = floats[skip : skip + (ROWS + 1) * LANES]
    packet = block[: ROWS * LANES].reshape(ROWS, LANES)
    ints = packet.view(np.int32)
    valid = block[ROWS * LANES :].view(np.int32)
    valid[:] = -1
    ints[MASK, :] = -1
    return packet, ints, valid


@kernel(inline="always")
def trace16(
    tracer: Tracer, packet: NDArray[np.float32], ints: NDArray[np.int32], valid: NDArray[np.int32]
) -> None:
    """Closest hits of a packet; lanes whose `valid` is 0 are left alone.

    Origin, direction and `FAR` must be set, to finite numbers where `valid` is not 0: to Embree a
    lane that is not finite spoils its neighbours. After the call `FAR` holds the distance in units of
    the direction's length and `TRIANGLE` the triangle, or `NONE`.
    """
    for lane in range(LANES):
        packet[NEAR, lane] = 0.0
        packet[TIME, lane] = 0.0
        ints[MASK, lane] = -1
        ints[FLAGS, lane] = 0
        ints[TRIANGLE, lane] = NONE
        ints[GEOMETRY, lane] = NONE
        ints[GEOMETRY + 1, lane] = NONE
        ints[GEOMETRY + 2, lane] = NONE
    if tracer.intersect != 0:
        call(  # type: ignore[call-arg]
            tracer.intersect, valid.ctypes.data, tracer.scene, packet.ctypes.data, tracer.arguments
        )
    else:
        walk16(tracer.nodes, tracer.links, tracer.corners, tracer.rows, packet, ints, valid)


@kernel(error_model="numpy")
def cast_rays(
    tracer: Tracer,
    origins: NDArray[np.float32],
    directions: NDArray[np.float32],
    part: tuple[int, int],
    hits: tuple[NDArray[np.int32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    """Cast rays (N, 3) from the first to before the last of `part`; columns of `Hits` take it."""
    triangle, distance, us, vs = hits
    start, stop = part
    packet, ints, valid = new_packet()
    lengths = np.empty(LANES, np.float64)
    for first in range(start, stop, LANES):
        for lane in range(LANES):
            ray = min(first + lane, stop - 1)
            square = 0.0
            sane = first + lane < stop
            for k in range(3):
                square += np.float64(directions[ray, k]) ** 2
                sane &= np.isfinite(origins[ray, k])
            lengths[lane] = np.sqrt(square)
            sane &= np.isfinite(square) and square > 0.0
            valid[lane] = -1 if sane else 0
            for k in range(3):
                packet[ORIGIN + k, lane] = origins[ray, k] if sane else 0.0
                packet[DIRECTION + k, lane] = directions[ray, k] / lengths[lane] if sane else 1.0
            packet[FAR, lane] = np.inf
        trace16(tracer, packet, ints, valid)
        for lane in range(LANES):
            if valid[lane] != 0 and ints[TRIANGLE, lane] >= 0:
                triangle[first + lane] = ints[TRIANGLE, lane]
                distance[first + lane] = packet[FAR, lane] / lengths[lane]
                us[first + lane] = packet[U, lane]
                vs[first + lane] = packet[V, lane]
