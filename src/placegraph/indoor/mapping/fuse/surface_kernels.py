# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops that find the surface in a sparse volume; see `surface`."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.core.threads import share
from placegraph.indoor.mapping.fuse.volume_kernels import SIDE, SIZE, row_of

_WIDE = SIDE + 1


def neighbours(keys, rows, places, count):
    """Rows (B, 27) of the blocks around each, -1 where there is none; column 13 is the block."""
    out = np.empty((count, 27), np.int32)
    share(_neighbours, count, keys, rows, places, out)
    return out


@kernel
def _neighbours(keys, rows, places, out, first, last):
    for row in range(first, last):
        x, y, z = np.int64(places[row, 0]), np.int64(places[row, 1]), np.int64(places[row, 2])
        for side in range(27):
            out[row, side] = row_of(
                keys, rows, x + side // 9 - 1, y + side // 3 % 3 - 1, z + side % 3 - 1
            )


@kernel
def corner_of(around, row, i, j, k):
    """Block and voxel of the voxel at i, j, k (-1 to SIDE) of a block; block -1: not there."""
    side = (i + SIDE) // SIDE * 9 + (j + SIDE) // SIDE * 3 + (k + SIDE) // SIDE
    return around[row, side], (i % SIDE * SIDE + j % SIDE) * SIDE + k % SIDE


def cells_of(around, distance, weight, least, steepest, loops):
    """Where the surface is: case (B, SIZE) uint8 and crossed edges (B, SIZE) uint16 of every cell.

    Also the number of vertices by block (B,). Cell i, j, k reaches from voxel i, j, k to the next along
    every axis. Bit e of `crossed` is set where edge e (4 axis + 0 to 3, see `low_corner`) leads
    from free space to behind the surface, between voxels that weigh more than `least`; not where the
    distance jumps by more than `steepest` [m]: there a carved voxel lies beside one behind
    something. Bit c of a case is set where corner c (x + 2 y + 4 z) lies behind the surface; a cell
    of which not all is known has case 0. `loops`: see `surface.loop_tables`.
    """
    count = len(around)
    cases = np.zeros((count, SIZE), np.uint8)
    crossed = np.zeros((count, SIZE), np.uint16)
    sizes = np.zeros(count, np.int64)
    given = around, distance, weight, least, steepest, loops
    share(_cells_of, count, *given, cases, crossed, sizes)
    return cases, crossed, sizes


@kernel
def _cells_of(
    around, distance, weight, least, steepest, loops, cases, crossed, sizes, first, last
):  # fmt: skip
    for row in range(first, last):
        gap = np.full((_WIDE, _WIDE, _WIDE), np.nan, np.float32)
        for i in range(_WIDE):
            for j in range(_WIDE):
                for k in range(_WIDE):
                    block, at = corner_of(around, row, i, j, k)
                    if block >= 0 and weight[block, at] > least:
                        gap[i, j, k] = distance[block, at]
        for cell in range(SIZE):
            i, j, k = cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE
            case, some, whole = 0, False, True
            for c in range(8):
                value = gap[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)]
                case |= (value < 0) << c
                some |= value >= 0
                whole &= not np.isnan(value)
            if case == 0 or not some:
                continue
            mask = 0
            for edge in range(12):
                c = low_corner(edge)
                d = c | 1 << (edge >> 2)
                one = gap[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)]
                two = gap[i + (d & 1), j + (d >> 1 & 1), k + (d >> 2)]
                if (one < 0) != (two < 0):
                    if abs(one - two) <= steepest:  # false where one is unknown
                        mask |= 1 << edge
                    else:
                        whole = False
            if mask:
                crossed[row, cell] = mask
                cases[row, cell] = case if whole else 0
                sizes[row] += loops[cases[row, cell]]


def vertices_of(
    around, places, distance, colour, paint, cases, crossed, starts, loop_of, loops, voxel
):
    """Vertices (V, 3) [m], colours (V, 3), and the first vertex of every cell (B, SIZE) int64.

    `starts`: (B + 1,) first vertex of each block; `loop_of`: (256, 12), see `surface.loop_tables`.
    A vertex is the mean of the points where its loop crosses the edges of the cell.
    """
    points = np.zeros((starts[-1], 3), np.float64)
    paints = np.zeros((starts[-1], 3), np.uint8)
    vertex = np.zeros((len(around), SIZE), np.int32)
    volume = around, places, distance, colour, paint
    cells = cases, crossed, starts, loop_of, loops, voxel
    share(_vertices_of, len(around), *volume, *cells, points, paints, vertex)
    return points, paints, vertex


@kernel
def _vertices_of(
    around, places, distance, colour, paint, cases, crossed, starts, loop_of, loops, voxel,
    points, paints, vertex, first, last,
):  # fmt: skip
    for row in range(first, last):
        at = starts[row]
        for cell in range(SIZE):
            if crossed[row, cell] == 0:
                continue
            case = cases[row, cell]
            vertex[row, cell] = at
            i, j, k = cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE
            gap = np.zeros(8)
            shade = np.zeros((8, 4))
            for c in range(8):
                block, voxel_at = corner_of(
                    around, row, i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)
                )
                gap[c] = distance[block, voxel_at]
                if paint[block, voxel_at] > 0:
                    shade[c, 3] = 1
                    for channel in range(3):
                        shade[c, channel] = colour[block, voxel_at, channel]
            for loop in range(loops[case]):
                x, y, z, n = 0.0, 0.0, 0.0, 0
                for edge in range(12):
                    if loop_of[case, edge] != loop or not crossed[row, cell] >> edge & 1:
                        continue
                    axis, c = edge >> 2, low_corner(edge)
                    share = gap[c] / (gap[c] - gap[c | 1 << axis])
                    x += (c & 1) + (share if axis == 0 else 0.0)
                    y += (c >> 1 & 1) + (share if axis == 1 else 0.0)
                    z += (c >> 2) + (share if axis == 2 else 0.0)
                    n += 1
                x, y, z = x / n, y / n, z / n
                points[at, 0] = (places[row, 0] * SIDE + i + x + 0.5) * voxel
                points[at, 1] = (places[row, 1] * SIDE + j + y + 0.5) * voxel
                points[at, 2] = (places[row, 2] * SIDE + k + z + 0.5) * voxel
                total = 0.0
                mix = np.zeros(3)
                for c in range(8):
                    if shade[c, 3] == 0:
                        continue
                    near = (
                        (1 - abs(x - (c & 1)))
                        * (1 - abs(y - (c >> 1 & 1)))
                        * (1 - abs(z - (c >> 2)))
                    )
                    near = max(near, 1e-6)
                    total += near
                    for channel in range(3):
                        mix[channel] += near * shade[c, channel]
                for channel in range(3):
                    value = 128.0 if total == 0 else mix[channel] / total + 0.5
                    paints[at, channel] = int(min(value, 255.0))
                at += 1


@kernel
def low_corner(edge):
    """Corner at which an edge (4 axis + 0 to 3) of a cell begins."""
    axis, rest = edge >> 2, edge & 3
    one, two = (axis + 1) % 3, (axis + 2) % 3
    return (rest & 1) << one | (rest >> 1) << two


def quads_of(around, distance, cases, crossed, vertex, loop_of, starts, quads):
    """Vertices around every edge that the surface crosses: count by block (B,), or fill `quads`.

    `quads`: (Q, 4) int32, empty for counting; `starts`: (B + 1,) first quad of each block. Seen from free
    space they run counter-clockwise.
    """
    sizes = np.zeros(len(around), np.int64)
    grid = around, distance, cases, crossed, vertex, loop_of
    share(_quads_of, len(around), *grid, starts, quads, sizes)
    return sizes


@kernel
def _quads_of(
    around, distance, cases, crossed, vertex, loop_of, starts, quads, sizes, first, last
):  # fmt: skip
    for row in range(first, last):
        at = starts[row]
        corners = np.zeros(4, np.int32)
        for cell in range(SIZE):
            i, j, k = cell // (SIDE * SIDE), cell // SIDE % SIDE, cell % SIDE
            behind = distance[row, cell] < 0
            for axis in range(3):
                if not crossed[row, cell] >> 4 * axis & 1:
                    continue
                one, two = (axis + 1) % 3, (axis + 2) % 3
                whole = True
                for turn in range(4):
                    a, b = 1 <= turn <= 2, turn >= 2  # steps back along one and two
                    p = i - (a and one == 0) - (b and two == 0)
                    q = j - (a and one == 1) - (b and two == 1)
                    r = k - (a and one == 2) - (b and two == 2)
                    block, other = corner_of(around, row, p, q, r)
                    if block < 0:
                        whole = False
                        break
                    loop = loop_of[cases[block, other], 4 * axis + a + 2 * b]
                    # free space at the edge's low end turns the quad round
                    corners[turn if behind else 3 - turn] = vertex[block, other] + loop
                if whole:
                    if len(quads):
                        quads[at] = corners
                    at += 1
        sizes[row] = at - starts[row]


@kernel
def split(points, quads):
    """Two triangles (2 Q, 3) int64 for each quad (Q, 4), along its shorter diagonal."""
    out = np.empty((2 * len(quads), 3), np.int64)
    for row in range(len(quads)):
        a, b, c, d = quads[row]
        one, two = 0.0, 0.0
        for axis in range(3):
            one += (points[a, axis] - points[c, axis]) ** 2
            two += (points[b, axis] - points[d, axis]) ** 2
        if one <= two:
            out[2 * row] = a, b, c
            out[2 * row + 1] = a, c, d
        else:
            out[2 * row] = b, c, d
            out[2 * row + 1] = b, d, a
    return out


@kernel
def areas_of(points, triangles):
    """Areas (T,) of triangles [m^2]."""
    out = np.empty(len(triangles))
    for row in range(len(triangles)):
        a, b, c = triangles[row]
        total = 0.0
        for axis in range(3):
            i, j = (axis + 1) % 3, (axis + 2) % 3
            normal = (points[b, i] - points[a, i]) * (points[c, j] - points[a, j])
            normal -= (points[b, j] - points[a, j]) * (points[c, i] - points[a, i])
            total += normal * normal
        out[row] = 0.5 * np.sqrt(total)
    return out


@kernel
def roots_of(count, triangles):
    """Lowest vertex (V,) of the connected part that every vertex belongs to."""
    root = np.arange(count)
    for row in range(len(triangles)):
        for side in range(2):
            a, b = find(root, triangles[row, side]), find(root, triangles[row, side + 1])
            root[max(a, b)] = min(a, b)
    for vertex in range(count):
        root[vertex] = find(root, vertex)
    return root


@kernel
def find(root, vertex):
    """Root of a vertex; the way there is cut short."""
    while root[vertex] != vertex:
        root[vertex] = root[root[vertex]]
        vertex = root[vertex]
    return vertex
