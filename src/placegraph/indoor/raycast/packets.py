"""Packets of 16 rays, and how compiled code traces them.

A packet is Embree's ``RTCRayHit16``: 21 rows of 16 lanes of four bytes, 64-byte aligned. Kernels
fill origin, direction, near and far ends of their rays and read distance, triangle and
barycentrics; what traces them is a `Tracer`, a plain value that numba passes by.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

LANES = 16
ROWS = 21
ORIGIN, NEAR, DIRECTION, TIME, FAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
U, V, TRIANGLE, GEOMETRY = 15, 16, 17, 18
NONE = -1
"""Triangle of a ray that hits nothing."""


class Tracer(NamedTuple):
    """What traces packets. Valid for as long as the `RayCaster` it belongs to."""

    intersect: int
    """Address of ``rtcIntersect16``."""
    scene: int
    """Embree's scene."""
    arguments: int
    """Embree's intersect arguments."""


@intrinsic  # type: ignore[untyped-decorator]
def _call(
    typingctx: Any, address: Any, valid: Any, scene: Any, packet: Any, arguments: Any
) -> Any:
    """Call ``void f(int *, scene, ray_hit *, arguments *)`` at an address known at run time.

    An address passed as a value, not as a global, lets numba cache what calls it.
    """
    signature = types.void(types.int64, types.int64, types.int64, types.int64, types.int64)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        i64 = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [i64, i64, i64, i64])
        function = builder.inttoptr(args[0], kind.as_pointer())
        builder.call(function, list(args[1:]))
        return context.get_dummy_value()

    return signature, codegen


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True, inline="always")
def trace16(
    tracer: Tracer,
    packet: NDArray[np.float32],
    ints: NDArray[np.int32],
    valid: NDArray[np.int32],
) -> None:
    """Closest hits of a packet; lanes whose `valid` is 0 are left alone.

    Origin, direction and `FAR` must be set. After the call `FAR` holds the distance in units of
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
    _call(
        tracer.intersect,
        valid.ctypes.data,
        tracer.scene,
        packet.ctypes.data,
        tracer.arguments,
    )
