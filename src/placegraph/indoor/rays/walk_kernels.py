# mypy: allow-untyped-defs, allow-incomplete-defs
"""Walking the tree of `bvh`: sixteen rays together.

The rays of one tile of pixels meet the same boxes; and even where they do not, sixteen lanes at once
cost little more than one. Triangles are met as in Woop, Benthin and Wald 2013: seen along the ray,
corners are points of a plane, rounded the same for all triangles that share them, and the side of an
edge on which the ray passes is decided exactly. So no ray slips between two triangles.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.indoor.rays.bvh_kernels import STACK
from placegraph.indoor.rays.layout import DIRECTION, FAR, GEOMETRY, LANES, NEAR, ORIGIN, TRIANGLE
from placegraph.indoor.rays.layout import U as HIT_U
from placegraph.indoor.rays.layout import V as HIT_V

TINY = np.float32(1e-18)
"""Smallest part of a direction whose reciprocal is taken."""
EARLY = np.float32(1.0 - 4.0 * 2.0**-24)
LATE = np.float32(1.0 + 4.0 * 2.0**-24)
"""Boxes are entered early and left late by more than rounding may cost."""
NEVER = np.float32(np.inf)

# scratch memory of a packet: rows of 16 lanes, in one array so that the compiler sees them apart
OX, OY, OZ, RX, RY, RZ, AX, AY, AZ = range(0, 9 * LANES, LANES)  # origin, reciprocal, across
BX, BY, BZ, DX, DY, DZ, START, BEST = range(9 * LANES, 17 * LANES, LANES)  # across, along
T, U, V, LEFT, RIGHT, STACKED = range(17 * LANES, 23 * LANES, LANES)


@kernel(error_model="numpy")
def walk16(nodes, links, corners, rows, packet, ints, valid):
    """Closest hits of a packet (see `layout`) with the triangles of a `Bvh`."""
    s = np.empty(STACKED + STACK * LANES, np.float32)
    stack = np.empty(STACK, np.int32)
    slots = np.empty(LANES, np.int32)
    for i in range(LANES):
        nothing = np.float32(0.0)
        for k in range(3):
            nothing += np.float32(0.0) * (packet[ORIGIN + k, i] + packet[DIRECTION + k, i])
            s[OX + k * LANES + i] = packet[ORIGIN + k, i]
            s[RX + k * LANES + i] = _reciprocal(packet[DIRECTION + k, i])
        _shear(s, i, packet[DIRECTION, i], packet[DIRECTION + 1, i], packet[DIRECTION + 2, i])
        s[START + i] = packet[NEAR, i]
        # a lane that is off, not finite or without direction wants no box
        wants = (valid[i] != 0) & (nothing == 0) & (s[DX + i] + s[DY + i] + s[DZ + i] != 0)
        s[BEST + i] = packet[FAR, i] if wants else -NEVER
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


@kernel(error_model="numpy")
def _reciprocal(part):
    if abs(part) < TINY:
        part = TINY if part >= 0 else -TINY
    return np.float32(1.0) / part


@kernel(error_model="numpy")
def _shear(s, i, x, y, z):
    """Rows A and B: a point's place across the ray, sheared along its longest part; D: its depth.

    Errors of A . p are relative to parts of p, as those of boxes are: rotating would mix them.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    along_z = (abs(z) >= abs(x)) & (abs(z) >= abs(y))
    along_y = (not along_z) & (abs(y) >= abs(x))
    along_x = (not along_z) & (not along_y)
    longest = z if along_z else (y if along_y else x)
    depth, x, y, z = one / longest, -x / longest, -y / longest, -z / longest
    s[AX + i] = y if along_x else one
    s[AY + i] = zero if along_z else (x if along_y else one)
    s[AZ + i] = x if along_z else zero
    s[BX + i] = z if along_x else zero
    s[BY + i] = one if along_z else (z if along_y else zero)
    s[BZ + i] = y if along_z else one
    s[DX + i] = depth if along_x else zero
    s[DY + i] = depth if along_y else zero
    s[DZ + i] = depth if along_z else zero


@kernel(error_model="numpy")
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


@kernel(error_model="numpy", inline="always")
def _left_first(s):
    votes = 0
    for i in range(LANES):
        votes += 1 if s[LEFT + i] < s[RIGHT + i] else 0
        votes -= 1 if s[RIGHT + i] < s[LEFT + i] else 0
    return votes >= 0


@kernel(error_model="numpy")
def _side(px, py, qx, qy):
    """On which side of the edge p q the ray passes: products of four bytes are exact in eight."""
    return np.float64(px) * np.float64(qy) - np.float64(py) * np.float64(qx)


@kernel(error_model="numpy", inline="always")
def _meet(s, corners, at):
    """Into T, U, V, where each lane meets the triangle at `at`; returns how many do nearer than BEST."""
    px, py, pz = corners[at], corners[at + 1], corners[at + 2]
    qx, qy, qz = corners[at + 3], corners[at + 4], corners[at + 5]
    rx, ry, rz = corners[at + 6], corners[at + 7], corners[at + 8]
    number = 0
    for i in range(LANES):
        x, y, z = px - s[OX + i], py - s[OY + i], pz - s[OZ + i]
        pa = s[AX + i] * x + s[AY + i] * y + s[AZ + i] * z
        pb = s[BX + i] * x + s[BY + i] * y + s[BZ + i] * z
        pd = s[DX + i] * x + s[DY + i] * y + s[DZ + i] * z
        x, y, z = qx - s[OX + i], qy - s[OY + i], qz - s[OZ + i]
        qa = s[AX + i] * x + s[AY + i] * y + s[AZ + i] * z
        qb = s[BX + i] * x + s[BY + i] * y + s[BZ + i] * z
        qd = s[DX + i] * x + s[DY + i] * y + s[DZ + i] * z
        x, y, z = rx - s[OX + i], ry - s[OY + i], rz - s[OZ + i]
        ra = s[AX + i] * x + s[AY + i] * y + s[AZ + i] * z
        rb = s[BX + i] * x + s[BY + i] * y + s[BZ + i] * z
        rd = s[DX + i] * x + s[DY + i] * y + s[DZ + i] * z
        w, u, v = _side(qa, qb, ra, rb), _side(ra, rb, pa, pb), _side(pa, pb, qa, qb)
        inside = ((w >= 0) & (u >= 0) & (v >= 0)) | ((w <= 0) & (u <= 0) & (v <= 0))
        total = w + u + v
        share = np.float32(1.0 / total)
        fw, fu, fv = np.float32(w) * share, np.float32(u) * share, np.float32(v) * share
        t = fw * pd + fu * qd + fv * rd
        meets = inside & (total != 0) & (t >= s[START + i]) & (t < s[BEST + i])
        s[T + i] = t if meets else NEVER
        s[U + i] = fu
        s[V + i] = fv
        number += 1 if meets else 0
    return number
