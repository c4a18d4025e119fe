# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled ray casting: packets of 16 rays, traced by Embree or by a bounding volume hierarchy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from placegraph.core.jit import kernel

LANES = 16
ROWS = 21
ORIGIN, NEAR, DIRECTION, TIME, FAR, MASK, ID, FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
U, V, TRIANGLE, GEOMETRY = 15, 16, 17, 18
"""Rows; `ORIGIN` and `DIRECTION` are the first of three, `TRIANGLE` and from `GEOMETRY` on integers."""
NONE = -1  # Triangle of a ray that hits nothing


@intrinsic
def call(_typing, _address, _a, _b, _c, _d):
    """Call ``void f(void *, void *, void *, void *)``; address and arguments are int64.

    An address passed as a value, not as a global, lets numba cache what calls it.
    """

    def codegen(context, builder, _signature, args):
        i64 = ir.IntType(64)
        kind = ir.FunctionType(ir.VoidType(), [i64] * 4)
        builder.call(builder.inttoptr(args[0], kind.as_pointer()), list(args[1:]))
        return context.get_dummy_value()

    return types.void(*[types.int64] * 5), codegen


BINS = 16  # Bins an axis, at most, when a split is sought

CAPACITY = 8
"""A leaf holds at most so many triangles: their number less one takes three bits of a reference."""

TRAVERSE = 1.0  # Cost of walking through a node, in triangles met

DEEP = 40
"""From this depth on, nodes are halved by number: with 2^28 triangles a path has under 72 nodes."""

STACK = 72


@kernel(error_model="numpy")
def compute_boxes(vertices, triangles):
    """Compute the boxes (T, 6) of triangles: low x y z, high x y z."""
    boxes = np.empty((len(triangles), 6), np.float32)
    for i in range(len(triangles)):
        a, b, c = triangles[i, 0], triangles[i, 1], triangles[i, 2]
        for k in range(3):
            x, y, z = vertices[a, k], vertices[b, k], vertices[c, k]
            boxes[i, k] = min(x, y, z)
            boxes[i, k + 3] = max(x, y, z)
    return boxes


@kernel(error_model="numpy")
def fill_corners(vertices, triangles, order, corners, rows):
    """Write corners (12 T,) and rows (12 T,) of triangles in the order of the leaves."""
    for slot in range(len(order)):
        row = order[slot]
        for c in range(3):
            for k in range(3):
                corners[12 * slot + 3 * c + k] = vertices[triangles[row, c], k]
        rows[12 * slot + 9] = row


@kernel(error_model="numpy")
def _half_area(box):
    x = np.float64(box[3] - box[0])
    y = np.float64(box[4] - box[1])
    z = np.float64(box[5] - box[2])
    return x * y + y * z + z * x


@kernel(error_model="numpy")
def _clear_box(box):
    for k in range(3):
        box[k] = np.inf
        box[k + 3] = -np.inf


@kernel(error_model="numpy")
def _grow_box(box, other):
    for k in range(3):
        box[k] = min(box[k], other[k])
        box[k + 3] = max(box[k + 3], other[k + 3])


@kernel(error_model="numpy")
def _find_bin(box, axis, low, scale, n_bins):
    """Find bin of a box by (twice) its centre."""
    return min(n_bins - 1, int((box[axis] + box[axis + 3] - low[axis]) * scale[axis]))


@kernel(error_model="numpy")
def _find_best_split(boxes, start, stop, low, scale, n_bins, bins, counts, right):
    """Find the best split: cost (areas times numbers), axis (-1: none), first right bin."""
    for axis in range(3):
        for b in range(n_bins):
            counts[axis, b] = 0
            _clear_box(bins[axis, b])
    for i in range(start, stop):
        for axis in range(3):
            b = _find_bin(boxes[i], axis, low, scale, n_bins)
            counts[axis, b] += 1
            _grow_box(bins[axis, b], boxes[i])
    best, best_axis, best_bin = np.inf, -1, 0
    box = np.empty(6, np.float32)
    for axis in range(3):
        if scale[axis] == 0.0:
            continue
        _clear_box(box)
        number = 0
        for b in range(n_bins - 1, 0, -1):
            if counts[axis, b]:
                number += counts[axis, b]
                _grow_box(box, bins[axis, b])
            right[b] = number * _half_area(box) if number else 0.0
        _clear_box(box)
        number = 0
        for b in range(1, n_bins):
            if counts[axis, b - 1]:
                number += counts[axis, b - 1]
                _grow_box(box, bins[axis, b - 1])
            if 0 < number < stop - start:
                cost = number * _half_area(box) + right[b]
                if cost < best:
                    best, best_axis, best_bin = cost, axis, b
    return best, best_axis, best_bin


@kernel(error_model="numpy")
def _partition(boxes, order, start, stop, axis, at, low, scale, n_bins):
    """Partition triangles by bin, those before `at` first; returns where the others start."""
    i, j = start, stop - 1
    while i <= j:
        if _find_bin(boxes[i], axis, low, scale, n_bins) < at:
            i += 1
        else:
            for k in range(6):
                boxes[i, k], boxes[j, k] = boxes[j, k], boxes[i, k]
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@kernel(error_model="numpy")
def split_nodes(boxes, order, nodes, links):
    """Split [0, T) into leaves, sorting `boxes` and `order`; returns the number of nodes."""
    bins = np.empty((3, BINS, 6), np.float32)
    counts = np.empty((3, BINS), np.int64)
    right = np.empty(BINS, np.float64)
    low, scale = np.empty(3, np.float32), np.empty(3, np.float32)
    box, centres = np.empty(6, np.float32), np.empty(6, np.float32)
    tasks = np.empty((2 * STACK, 5), np.int64)  # start, stop, depth, parent, side
    tasks[0] = 0, len(order), 0, -1, 0
    waiting, used = 1, 0
    while waiting:
        waiting -= 1
        start, stop, depth, parent, side = tasks[waiting]
        number = stop - start
        _clear_box(box)
        _clear_box(centres)
        for i in range(start, stop):
            _grow_box(box, boxes[i])
            for k in range(3):
                c = boxes[i, k] + boxes[i, k + 3]
                centres[k] = min(centres[k], c)
                centres[k + 3] = max(centres[k + 3], c)
        if parent >= 0:
            for k in range(6):
                nodes[16 * parent + 6 * side + k] = box[k]
        cost, axis, at = np.inf, -1, 0
        n_bins = min(BINS, 4 + number // 4)
        if number > 1 and depth < DEEP:
            for k in range(3):
                low[k] = centres[k]
                span = centres[k + 3] - centres[k]
                # an extent too small or too large to divide into bins does not help
                scale[k] = n_bins / span if 1e-30 < span < 1e30 else 0.0
            cost, axis, at = _find_best_split(
                boxes, start, stop, low, scale, n_bins, bins, counts, right
            )
        whole = number * _half_area(box)
        stays = number <= CAPACITY and whole <= cost + TRAVERSE * _half_area(box)
        if number == 1 or (stays and parent >= 0):
            leaf = ~np.int32(start * 8 + number - 1)
            if parent >= 0:
                links[16 * parent + 12 + side] = leaf
            else:  # one triangle only: the root has it on both sides
                used = 1
                for k in range(12):
                    nodes[k] = box[k % 6]
                links[12] = links[13] = leaf
            continue
        middle = (start + stop) // 2
        if axis >= 0:
            middle = _partition(boxes, order, start, stop, axis, at, low, scale, n_bins)
        if parent >= 0:
            links[16 * parent + 12 + side] = used
        tasks[waiting] = middle, stop, depth + 1, used, 1
        tasks[waiting + 1] = start, middle, depth + 1, used, 0
        waiting += 2
        used += 1
    return used


TINY = np.float32(1e-18)  # Smallest part of a direction whose reciprocal is taken
EARLY = np.float32(1.0 - 4.0 * 2.0**-24)
LATE = np.float32(1.0 + 4.0 * 2.0**-24)
"""Boxes are entered early and left late by more than rounding may cost."""
NEVER = np.float32(np.inf)

# scratch memory of a packet: rows of 16 lanes, in one array so that the compiler sees them apart
OX, OY, OZ, RX, RY, RZ, AX, AY, AZ = range(0, 9 * LANES, LANES)  # origin, reciprocal, across
BX, BY, BZ, DX, DY, DZ, START, BEST = range(9 * LANES, 17 * LANES, LANES)  # across, along
T, OUT_U, OUT_V, LEFT, RIGHT, STACKED = range(17 * LANES, 23 * LANES, LANES)


@kernel(error_model="numpy")
def walk16(nodes, links, corners, rows, packet, ints, valid):
    """Return closest hits of a packet (see `layout`) with the triangles of a `Bvh`."""
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
            n_left = _intersect_box(s, nodes, at, LEFT)
            n_right = _intersect_box(s, nodes, at + 6, RIGHT)
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
                if _intersect_triangle(s, corners, np.uint64(slot) * 12):
                    for i in range(LANES):
                        if s[T + i] < s[BEST + i]:
                            s[BEST + i] = s[T + i]
                            packet[U, i] = s[OUT_U + i]
                            packet[V, i] = s[OUT_V + i]
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
    """Compute rows A, B (a point's place across the ray, sheared) and D (its depth along it).

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
def _intersect_box(s, nodes, at, row):
    """Write into `row` where each lane enters the box at `at`, or NEVER; returns how many do."""
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


@kernel(inline=True)
def _left_first(s):
    votes = 0
    for i in range(LANES):
        votes += 1 if s[LEFT + i] < s[RIGHT + i] else 0
        votes -= 1 if s[RIGHT + i] < s[LEFT + i] else 0
    return votes >= 0


@kernel(error_model="numpy")
def _edge_function(px, py, qx, qy):
    """Return the side of the edge p q on which the ray passes, exact in eight bytes."""
    return np.float64(px) * np.float64(qy) - np.float64(py) * np.float64(qx)


@kernel(inline=True)
def _intersect_triangle(s, corners, at):
    """Write into T, OUT_U, OUT_V where each lane meets a triangle; return how many do nearer than BEST."""
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
        w, u, v = (
            _edge_function(qa, qb, ra, rb),
            _edge_function(ra, rb, pa, pb),
            _edge_function(pa, pb, qa, qb),
        )
        inside = ((w >= 0) & (u >= 0) & (v >= 0)) | ((w <= 0) & (u <= 0) & (v <= 0))
        total = w + u + v
        share = np.float32(1.0 / total)
        fw, fu, fv = np.float32(w) * share, np.float32(u) * share, np.float32(v) * share
        t = fw * pd + fu * qd + fv * rd
        meets = inside & (total != 0) & (t >= s[START + i]) & (t < s[BEST + i])
        s[T + i] = t if meets else NEVER
        s[OUT_U + i] = fu
        s[OUT_V + i] = fv
        number += 1 if meets else 0
    return number


class Tracer(NamedTuple):
    """Tracer of ray packets, by Embree or a tree; it keeps alive what it needs."""

    intersect: int  # Address of ``rtcIntersect16``; 0: the tree is walked
    scene: int  # Embree's scene
    arguments: int  # Embree's intersect arguments
    nodes: NDArray[np.float32]
    links: NDArray[np.int32]
    corners: NDArray[np.float32]
    rows: NDArray[np.int32]  # The tree (`bvh.Bvh`); of one element each where Embree traces


@kernel
def new_packet() -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
    """Return aligned packet (21, 16) float32, the same memory as int32, and the valid mask (16,) int32."""
    floats = np.zeros((ROWS + 1) * LANES + LANES, np.float32)
    skip = ((-floats.ctypes.data) % 64) // 4
    block = floats[skip : skip + (ROWS + 1) * LANES]
    packet = block[: ROWS * LANES].reshape(ROWS, LANES)
    ints = packet.view(np.int32)
    valid = block[ROWS * LANES :].view(np.int32)
    valid[:] = -1
    ints[MASK, :] = -1
    return packet, ints, valid


@kernel
def trace16(
    tracer: Tracer, packet: NDArray[np.float32], ints: NDArray[np.int32], valid: NDArray[np.int32]
) -> None:
    """Return closest hits of a packet; lanes whose `valid` is 0 are left alone.

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
