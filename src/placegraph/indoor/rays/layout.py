"""Layout of a packet of 16 rays: Embree's ``RTCRayHit16``, 21 rows of 16 lanes of four bytes.

Kernels fill origin, direction, near and far ends of their rays and read distance, triangle and
barycentrics (`packets_kernels.trace16`). A packet is 64-byte aligned.
"""

LANES = 16
ROWS = 21
ORIGIN, NEAR, DIRECTION, TIME, FAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
U, V, TRIANGLE, GEOMETRY = 15, 16, 17, 18
"""Rows; `ORIGIN` and `DIRECTION` are the first of three, `TRIANGLE` and from `GEOMETRY` on integers."""
NONE = -1
"""Triangle of a ray that hits nothing."""
