"""Packets of 16 rays, and how compiled code traces them.

A packet is Embree's ``RTCRayHit16``: 21 rows of 16 lanes of four bytes, 64-byte aligned. Kernels
fill origin, direction, near and far ends of their rays and read distance, triangle and
barycentrics; what traces them is a `Tracer`, a plain value that numba passes by.
"""

from __future__ import annotations

from placegraph.indoor.rays.layout import (
    DIRECTION,
    FAR,
    LANES,
    NONE,
    ORIGIN,
    TRIANGLE,
    U,
    V,
)
from placegraph.indoor.rays.packets_kernels import Tracer, cast_rays, new_packet, trace16

__all__ = [
    "DIRECTION",
    "FAR",
    "LANES",
    "NONE",
    "ORIGIN",
    "TRIANGLE",
    "Tracer",
    "U",
    "V",
    "cast_rays",
    "new_packet",
    "trace16",
]
