# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `index`: tiles of viewpoints, what they have in sight, and what is said there.

A tile is a square of `SIDE` times `SIDE` points of the grid. Which of them are viewpoints is told by
the 64 bits of a whole number, whose bit ``8 * row + column`` is the tile's *slot*.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

AREA = 2
SIDE = 8
"""Grid points along the edge of a tile."""
SLOTS = SIDE * SIDE
FADED, WIDTH, REACHED = 25.0, 3.5, 38.0
"""`SIGHT`, `FADE` and `REACH` of `index` [m]."""
CROWDED = 30.0
"""Added to the pairs in sight of a viewpoint before masses are compared with them: `CROWD` of statements."""
GRADES = 256
"""A mass is kept as one of so many grades, always rounded up ..."""
LEAST, STEP = 0.02, 0.037
"""... the first of which is this much, and each this share more than the one below."""
FINE = 64.0
"""Totals, and roots of pairs, are kept in steps of one part in so many, rounded down."""
EDGE, WIDE = 40.0, 1.25
"""The ends of a box are kept as steps so wide from so far west, or south; rounded outwards [m]."""


@kernel(inline="always")
def slot_of(bits):
    """Slot of the lowest bit that is set."""
    x = (bits & -bits) - 1
    return ones(x)


@kernel(inline="always")
def ones(x):
    """How many bits of a whole number from 0 on are set."""
    x = x - ((x >> 1) & 0x5555555555555555)
    x = (x & 0x3333333333333333) + ((x >> 2) & 0x3333333333333333)
    x = (x + (x >> 4)) & 0x0F0F0F0F0F0F0F0F
    # written so that compilers make one instruction of it
    return ((x * 0x0101010101010101) >> 56) & 0x7F


@kernel(inline="always")
def below(bits, slot):
    """How many bits are set below a slot."""
    return ones(bits & ((np.int64(1) << slot) - 1))


@kernel(inline="always")
def grade_of(mass):
    """Least grade whose mass is no smaller."""
    return min(GRADES - 1, max(0, int(np.ceil(np.log(mass / LEAST) / STEP))))


@kernel(inline="always")
def pack(mass, west, south, east, north):
    """Posting: grade of a mass, and the ends of a box within `REACHED` [m], in 32 bits."""
    low = (int(np.floor((west + EDGE) / WIDE)) << 18) | (int(np.floor((south + EDGE) / WIDE)) << 12)
    high = (int(np.ceil((east + EDGE) / WIDE)) << 6) | int(np.ceil((north + EDGE) / WIDE))
    return (grade_of(mass) << 24) | low | high


@kernel(inline="always")
def unpack(posting):
    """Grade, and west, south, east and north end of a posting [m]."""
    return (
        posting >> 24,
        np.float32(((posting >> 18) & 63) * WIDE - EDGE),
        np.float32(((posting >> 12) & 63) * WIDE - EDGE),
        np.float32(((posting >> 6) & 63) * WIDE - EDGE),
        np.float32((posting & 63) * WIDE - EDGE),
    )


@kernel(_nrt=False)
def nearest_in_reach(scene, row, east, north):
    """As the entries of `sightings`: vector to the nearest point of an object, and its square [m^2].

    What lies beyond `REACHED` may come out as infinitely far.
    """
    best = np.inf
    best_e = best_n = 0.0
    inside = False
    area = scene.kind[row] == AREA
    for part in range(scene.part_starts[row], scene.part_starts[row + 1]):
        a, b = scene.point_starts[part], scene.point_starts[part + 1]
        for i in range(a, max(a + 1, b - 1)):
            j = min(i + 1, b - 1)
            x0, y0 = scene.points[i, 0], scene.points[i, 1]
            x1, y1 = scene.points[j, 0], scene.points[j, 1]
            if area and (y0 > north) != (y1 > north):
                inside ^= x0 + (north - y0) / (y1 - y0) * (x1 - x0) <= east
            if (
                min(x0, x1) - east > REACHED
                or east - max(x0, x1) > REACHED
                or min(y0, y1) - north > REACHED
                or north - max(y0, y1) > REACHED
            ):
                continue
            dx, dy = x1 - x0, y1 - y0
            length2 = dx * dx + dy * dy
            t = 0.0 if length2 == 0.0 else ((east - x0) * dx + (north - y0) * dy) / length2
            t = min(1.0, max(0.0, t))
            px, py = x0 + t * dx - east, y0 + t * dy - north
            d = px * px + py * py
            if d < best:
                best, best_e, best_n = d, px, py
    if inside:
        return 0.0, 0.0, 0.0
    return best_e, best_n, best


@kernel(_nrt=False)
def look(scene, views, tile, slot, objects, offsets, sight):
    """What is in sight of a viewpoint, into the first entries of `objects`, `offsets` and `sight`.

    Returns how many things there are, the sum of their `sight`, and of its products over ordered
    pairs of what one does not stand in.
    """
    east, north = place_of(views, tile, slot)
    n = 0
    total = apart = squared = np.float32(0.0)
    for k in range(views.thing_starts[tile], views.thing_starts[tile + 1]):
        o = views.things[k]
        if o < 0 or o >= len(scene.kind):  # a forged map
            continue
        if (
            scene.box[o, 0] - east > REACHED
            or scene.box[o, 1] - north > REACHED
            or east - scene.box[o, 2] > REACHED
            or north - scene.box[o, 3] > REACHED
        ):
            continue
        x, y, d2 = nearest_in_reach(scene, o, east, north)
        if d2 <= REACHED * REACHED:
            objects[n] = o
            offsets[n, 0], offsets[n, 1] = x, y
            distance = np.sqrt(offsets[n, 0] * offsets[n, 0] + offsets[n, 1] * offsets[n, 1])
            seen = np.float32(1.0) / (
                np.float32(1.0) + np.exp((distance - np.float32(FADED)) / np.float32(WIDTH))
            )
            sight[n] = seen
            total += seen
            if scene.kind[o] != AREA or offsets[n, 0] != 0.0 or offsets[n, 1] != 0.0:
                apart += seen
                squared += seen * seen
            n += 1
    return n, total, max(apart * apart - squared, np.float32(0.0))


@kernel(inline="always")
def place_of(views, tile, slot):
    """East and north of a slot of a tile [m]."""
    east0, north0, stride, columns = views.grid
    row, column = views.tiles[tile] // columns, views.tiles[tile] % columns
    east = east0 + (column * SIDE + (slot & (SIDE - 1))) * stride
    return east, north0 + (row * SIDE + (slot >> 3)) * stride


@kernel(inline="always")
def tile_of(views, view):
    """Tile and slot of a viewpoint."""
    low, high = 0, len(views.tiles)
    while high - low > 1:
        middle = (low + high) >> 1
        if views.first[middle] <= view:
            low = middle
        else:
            high = middle
    bits = views.present[low]
    for _ in range(view - views.first[low]):
        bits &= bits - 1
    return low, slot_of(bits)


@kernel(_nrt=False)
def most_things(views):
    """How many things are in sight of a tile, at most."""
    most = 0
    for tile in range(len(views.tiles)):
        most = max(most, views.thing_starts[tile + 1] - views.thing_starts[tile])
    return most


@kernel
def looks(scene, views, rows):
    """What is in sight of viewpoints (K,), as CSR: starts, objects, offsets, and `sight`."""
    starts, most = np.zeros(len(rows) + 1, np.int64), most_things(views)
    size = max(1024, 32 * len(rows)) + most
    objects, sight = np.empty(size, np.int32), np.empty(size, np.float32)
    offsets = np.empty((size, 2), np.float32)
    for k in range(len(rows)):
        n = starts[k]
        if n + most > len(objects):
            objects, sight = np.concatenate((objects, objects)), np.concatenate((sight, sight))
            offsets = np.concatenate((offsets, offsets))
        tile, slot = tile_of(views, rows[k])
        many, _, _ = look(scene, views, tile, slot, objects[n:], offsets[n:], sight[n:])
        starts[k + 1] = n + many
    n = starts[-1]
    return starts, objects[:n].copy(), offsets[:n].copy(), sight[:n].copy()
