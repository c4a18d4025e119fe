"""Walking the tree of `bvh`: sixteen rays together.

The rays of one tile of pixels meet the same boxes; and even where they do not, sixteen lanes at once
cost little more than one. Triangles are met by the signs of Pluecker products, which two triangles
that share an edge compute alike, so that no ray slips between them.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from placegraph.indoor.raycast.bvh import STACK
from placegraph.indoor.raycast.layout import DIRECTION, FAR, GEOMETRY, LANES, NEAR, ORIGIN, TRIANGLE
from placegraph.indoor.raycast.layout import U as HIT_U
from placegraph.indoor.raycast.layout import V as HIT_V

TINY = np.float32(1e-18)
"""Smallest part of a direction whose reciprocal is taken."""
EARLY = np.float32(1.0 - 4.0 * 2.0**-24)
LATE = np.float32(1.0 + 4.0 * 2.0**-24)
"""Boxes are entered early and left late by more than rounding may cost."""
SLACK = np.float32(2.0**-23)
"""Share of the sum of edge products by which a ray may lie outside a triangle."""
NEVER = np.float32(np.inf)

# scratch memory of a packet: rows of 16 lanes, in one array so that the compiler sees them apart
OX, OY, OZ, DX, DY, DZ, RX, RY, RZ = range(0, 9 * LANES, LANES)
START, BEST, T, U, V, LEFT, RIGHT, STACKED = range(9 * LANES, 17 * LANES, LANES)


@njit(cache=True, nogil=True, error_model="numpy")
def walk16(nodes, links, corners, rows, packet, ints, valid):
    """Closest hits of a packet (see `packets`) with the triangles of a `Bvh`."""
    s = np.empty(STACKED + STACK * LANES, np.float32)
    stack = np.empty(STACK, np.int32)
    slots = np.empty(LANES, np.int32)
    for i in range(LANES):
        for k in range(3):
            s[OX + k * LANES + i] = packet[ORIGIN + k, i]
            s[DX + k * LANES + i] = packet[DIRECTION + k, i]
            s[RX + k * LANES + i] = _reciprocal(packet[DIRECTION + k, i])
        s[START + i] = packet[NEAR, i]
        s[BEST + i] = packet[FAR, i] if valid[i] else -NEVER
        slots[i] = -1
    top, reference = 0, 0
    while True:
        if reference >= 0:
            at = np.uint64(reference) * 16
            n_left = _enter(s, nodes, at, LEFT)
            n_right = _enter(s, nodes, at + 6, RIGHT)
            if n_left and n_right:
                # the child that is nearer for most rays comes first, the other is kept
                row = STACKED + LANES * top
                if _left_first(s):
                    reference, stack[top] = links[at + 12], links[at + 13]
                    for i in range(LANES):
                        s[row + i] = s[RIGHT + i]
                else:
                    reference, stack[top] = links[at + 13], links[at + 12]
                    for i in range(LANES):
                        s[row + i] = s[LEFT + i]
                top += 1
                continue
            if n_left or n_right:
                reference = links[at + (12 if n_left else 13)]
                continue
        else:
            leaf = ~reference
            for slot in range(leaf >> 3, (leaf >> 3) + (leaf & 7) + 1):
                if _meet(s, corners, np.uint64(slot) * 12):
                    for i in range(LANES):
                        if s[T + i] < s[BEST + i]:
                            s[BEST + i] = s[T + i]
                            packet[HIT_U, i] = s[U + i]
                            packet[HIT_V, i] = s[V + i]
                            slots[i] = slot
        # next of those kept that some ray still wants
        wanted = 0
        while top and not wanted:
            top -= 1
            row = STACKED + LANES * top
            for i in range(LANES):
                wanted += 1 if s[row + i] < s[BEST + i] else 0
        if not wanted:
            break
        reference = stack[top]
    for i in range(LANES):
        if slots[i] >= 0:
            packet[FAR, i] = s[BEST + i]
            ints[TRIANGLE, i] = rows[12 * slots[i] + 9]
            ints[GEOMETRY, i] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def _reciprocal(part):
    if abs(part) < TINY:
        part = TINY if part >= 0 else -TINY
    return np.float32(1.0) / part


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(s, nodes, at, row):
    """Into `row`, where each lane enters the box at `at`, or NEVER; returns how many do."""
    lx, ly, lz = nodes[at], nodes[at + 1], nodes[at + 2]
    hx, hy, hz = nodes[at + 3], nodes[at + 4], nodes[at + 5]
    number = 0
    for i in range(LANES):
        a = (lx - s[OX + i]) * s[RX + i]
        b = (hx - s[OX + i]) * s[RX + i]
        near = a if a < b else b
        far = a if a > b else b
        a = (ly - s[OY + i]) * s[RY + i]
        b = (hy - s[OY + i]) * s[RY + i]
        c = a if a < b else b
        near = near if near > c else c
        c = a if a > b else b
        far = far if far < c else c
        a = (lz - s[OZ + i]) * s[RZ + i]
        b = (hz - s[OZ + i]) * s[RZ + i]
        c = a if a < b else b
        near = near if near > c else c
        c = a if a > b else b
        far = far if far < c else c
        near *= EARLY
        far *= LATE
        near = near if near > s[START + i] else s[START + i]
        far = far if far < s[BEST + i] else s[BEST + i]
        enters = near <= far
        s[row + i] = near if enters else NEVER
        number += 1 if enters else 0
    return number


@njit(cache=True, nogil=True, error_model="numpy")
def _left_first(s):
    votes = 0
    for i in range(LANES):
        votes += 1 if s[LEFT + i] < s[RIGHT + i] else 0
        votes -= 1 if s[RIGHT + i] < s[LEFT + i] else 0
    return votes >= 0


@njit(cache=True, nogil=True, error_model="numpy")
def _edge(px, py, pz, qx, qy, qz, dx, dy, dz):
    """Pluecker product of a ray from 0 with the edge p q; of q p it is exactly the negative."""
    sx, sy, sz = px + qx, py + qy, pz + qz
    fx, fy, fz = px - qx, py - qy, pz - qz
    return (sy * fz - sz * fy) * dx + (sz * fx - sx * fz) * dy + (sx * fy - sy * fx) * dz


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(s, corners, at):
    """Into T, U, V, where each lane meets the triangle at `at`; returns how many do nearer than BEST."""
    ax, ay, az = corners[at], corners[at + 1], corners[at + 2]
    bx, by, bz = corners[at + 3], corners[at + 4], corners[at + 5]
    cx, cy, cz = corners[at + 6], corners[at + 7], corners[at + 8]
    ex, ey, ez = cx - ax, cy - ay, cz - az
    fx, fy, fz = ax - bx, ay - by, az - bz
    nx, ny, nz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    number = 0
    for i in range(LANES):
        ox, oy, oz = s[OX + i], s[OY + i], s[OZ + i]
        dx, dy, dz = s[DX + i], s[DY + i], s[DZ + i]
        px, py, pz = ax - ox, ay - oy, az - oz
        qx, qy, qz = bx - ox, by - oy, bz - oz
        rx, ry, rz = cx - ox, cy - oy, cz - oz
        u = _edge(rx, ry, rz, px, py, pz, dx, dy, dz)
        v = _edge(px, py, pz, qx, qy, qz, dx, dy, dz)
        w = _edge(qx, qy, qz, rx, ry, rz, dx, dy, dz)
        total = u + v + w
        slack = SLACK * abs(total)
        low = u if u < v else v
        low = low if low < w else w
        high = u if u > v else v
        high = high if high > w else w
        inside = (low >= -slack) | (high <= slack)
        t = (nx * px + ny * py + nz * pz) / (nx * dx + ny * dy + nz * dz)
        meets = inside & (total != 0) & (t >= s[START + i]) & (t < s[BEST + i])
        s[T + i] = t if meets else NEVER
        s[U + i] = u / total
        s[V + i] = v / total
        number += 1 if meets else 0
    return number
