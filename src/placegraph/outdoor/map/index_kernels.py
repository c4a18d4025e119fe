# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled parts of `index`: tiles of viewpoints, what they have in sight, and what is said there.

A tile is a square of `SIDE` times `SIDE` points of the grid. Which of them are viewpoints is told by
the 64 bits of a whole number, whose bit ``8 * row + column`` is the tile's *slot*.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.map.geometry_kernels import box_of, crossings

AREA = 2
SIDE = 8
"""Grid points along the edge of a tile."""
SLOTS = SIDE * SIDE
FADED, WIDTH, REACHED = 25.0, 3.5, 38.0
"""`SIGHT`, `FADE` and `REACH` of `index` [m]."""
CROWDED = 30.0
"""Added to the pairs in sight of a viewpoint before masses are compared with them: `CROWD` of statements."""
GRADES, LEAST, STEP = 256, 2e-4, 0.037
"""The largest share of a run is stored as one of so many grades, rounded up: the least, and the step of
the logarithm."""
FALL = 0.15
FALLS = np.exp(-FALL * np.arange(16)).astype(np.float32)
"""Shares of the largest share of a run that are told apart, in 4 bits; rounded up."""
LEAST_PULL, PULL_STEP, TOTAL_STEP = 0.1, 0.09, 0.66
PULLS = (LEAST_PULL * np.exp(PULL_STEP * (np.arange(256) & 31))).astype(np.float32)
"""(256,) all in sight over the root of pairs and `CROWDED`, by `density`; rounded up."""
TOTALS = np.exp(TOTAL_STEP * (np.arange(256) >> 5)).astype(np.float32)
"""(256,) all in sight, by `density`; rounded down."""
JUMP = 1 << 16
"""Tiles of runs are stored modulo this number; a run without postings stands at each larger step."""


@kernel(inline=True)
def slot_of(bits):
    """Return the slot of the lowest bit that is set."""
    x = (bits & -bits) - 1
    return count_bits(x)


@kernel(inline=True)
def count_bits(x):
    """Count the bits that are set in a whole number from 0 on."""
    x = x - ((x >> 1) & 0x5555555555555555)
    x = (x & 0x3333333333333333) + ((x >> 2) & 0x3333333333333333)
    x = (x + (x >> 4)) & 0x0F0F0F0F0F0F0F0F
    # written so that compilers make one instruction of it
    return ((x * 0x0101010101010101) >> 56) & 0x7F


@kernel(inline=True)
def grade_of(share):
    """Return the least grade that stands for no smaller share."""
    return min(GRADES - 1, max(0, int(np.ceil(np.log(share / LEAST) / STEP))))


@kernel(inline=True)
def pack_density(total, pairs):
    """Pack all in sight of a viewpoint, and its share of the root of pairs, in 8 bits."""
    high = min(7, max(0, int(np.log(max(total, np.float32(1.0))) / TOTAL_STEP)))
    pull = np.log(max(total, np.float32(1e-3)) / np.sqrt(pairs + CROWDED) / LEAST_PULL)
    return (high << 5) | min(31, max(0, int(np.ceil(pull / PULL_STEP))))


@kernel(inline=True)
def write_step(things, n, step):
    """Write a step from 1 on as 7 bits a byte, the lowest first; return where the next begins."""
    step -= 1
    while step > 127:
        things[n] = (step & 127) | 128
        step >>= 7
        n += 1
    things[n] = step
    return n + 1


@kernel(inline=True)
def read_step(things, k):
    """Read a step of `write_step`; return it, and where the next begins."""
    step, shift = np.int64(things[k]) & 127, 7
    while things[k] > 127 and k + 1 < len(things) and shift < 35:
        k += 1
        step |= (np.int64(things[k]) & 127) << shift
        shift += 7
    return step + 1, k + 1


@kernel(_nrt=False)
def nearest_in_reach(scene, row, east, north):
    """Return the vector to the nearest point of an object [m], and its square [m^2].

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
def list_visible(scene, views, tile, slot, objects, offsets, visibility):
    """List what is in sight of a viewpoint, into the first entries of `objects`, `offsets` and `visibility`.

    Returns how many things there are, the sum of their `visibility`, and of its products over ordered
    pairs of what one does not stand in.
    """
    east, north = place_of(views, tile, slot)
    n, o, k = 0, np.int64(-1), views.thing_starts[tile]
    total = apart = squared = np.float32(0.0)
    while k < views.thing_starts[tile + 1]:
        step, k = read_step(views.things, k)
        o += step
        if o >= len(scene.kind):  # a forged map
            break
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
            weight = np.float32(1.0) / (
                np.float32(1.0) + np.exp((distance - np.float32(FADED)) / np.float32(WIDTH))
            )
            visibility[n] = weight
            total += weight
            if scene.kind[o] != AREA or offsets[n, 0] != 0.0 or offsets[n, 1] != 0.0:
                apart += weight
                squared += weight * weight
            n += 1
    return n, total, max(apart * apart - squared, np.float32(0.0))


@kernel(inline=True)
def place_of(views, tile, slot):
    """Return east and north of a slot of a tile [m]."""
    east0, north0, stride, columns = views.grid
    row, column = views.tiles[tile] // columns, views.tiles[tile] % columns
    east = east0 + (column * SIDE + (slot & (SIDE - 1))) * stride
    return east, north0 + (row * SIDE + (slot >> 3)) * stride


@kernel(inline=True)
def tile_of(views, view):
    """Return tile and slot of a viewpoint."""
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


@kernel
def place_views(views, rows):
    """Return east and north (K, 2) of viewpoints (K,) [m]."""
    out = np.empty((len(rows), 2), np.float32)
    for k in range(len(rows)):
        tile, slot = tile_of(views, rows[k])
        out[k, 0], out[k, 1] = place_of(views, tile, slot)
    return out


@kernel(_nrt=False)
def most_objects(views):
    """Return a number of things no smaller than that in sight of any tile: the most bytes of one."""
    most = 0
    for tile in range(len(views.tiles)):
        most = max(most, views.thing_starts[tile + 1] - views.thing_starts[tile])
    return most


@kernel
def list_visible_each(scene, views, rows):
    """List what is in sight of viewpoints (K,), as CSR: starts, objects, offsets, and `visibility`."""
    starts, most = np.zeros(len(rows) + 1, np.int64), most_objects(views)
    size = max(1024, 32 * len(rows)) + most
    objects, visibility = np.empty(size, np.int32), np.empty(size, np.float32)
    offsets = np.empty((size, 2), np.float32)
    for k in range(len(rows)):
        n = starts[k]
        if n + most > len(objects):
            objects, visibility = (
                np.concatenate((objects, objects)),
                np.concatenate((visibility, visibility)),
            )
            offsets = np.concatenate((offsets, offsets))
        tile, slot = tile_of(views, rows[k])
        many, _, _ = list_visible(
            scene, views, tile, slot, objects[n:], offsets[n:], visibility[n:]
        )
        starts[k + 1] = n + many
    n = starts[-1]
    return starts, objects[:n].copy(), offsets[:n].copy(), visibility[:n].copy()


POINT = 0


@kernel
def mark_viewpoints(tile_starts, visible, kind, enough, stride, covered):
    """Mark the slots (T,) of points that see `enough`, or a point object closer than `stride` [m].

    `visible` is what tiles have in sight (`InSight`); notes in `covered` (N,) what those points see.
    """
    keep, total = np.zeros(len(tile_starts) - 1, np.int64), np.zeros(SLOTS, np.float32)
    for tile in range(len(tile_starts) - 1):
        total[:] = 0.0
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            bits, e, lone = visible.slots[r], visible.first[r], kind[visible.objects[r]] == POINT
            while bits:
                lowest = bits & -bits
                bits ^= lowest
                total[count_bits(lowest - 1)] += visible.visibility[e]
                x, y = visible.offsets[e]
                if lone and x * x + y * y < stride * stride:
                    keep[tile] |= lowest
                e += 1
        for slot in range(SLOTS):
            keep[tile] |= np.int64(total[slot] >= enough) << slot
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            if visible.slots[r] & keep[tile]:
                covered[visible.objects[r]] = True
    return keep


@kernel
def mark_isolated(tile_starts, visible, keep, stride, covered):
    """Add to `keep` points closer than `stride` [m] to what was not `covered`: in the hills, little else."""
    for tile in range(len(tile_starts) - 1):
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            bits, e = visible.slots[r], visible.first[r]
            while bits and not covered[visible.objects[r]]:
                x, y = visible.offsets[e]
                if x * x + y * y < stride * stride:
                    keep[tile] |= bits & -bits
                bits &= bits - 1
                e += 1


@kernel
def runs_of(tile_starts, visible, keep, core, kind, tokens, levels, n_labels, mass):
    """Build the runs of a band: for each tile and token in sight, its viewpoints and their postings.

    `keep` (T,) are the slots of viewpoints, `core` (T,) those of them that are counted, `visible` what tiles
    have in sight. Adds to `mass` (tokens + 1,) what of each is in sight of all viewpoints, and of all
    things (the last). Returns columns of the runs (token, tile, bytes, grades of the largest shares of the
    root of pairs, and of all), and their postings; `density` of viewpoints; things of tiles, and their bytes;
    and what is counted: what `Seen` has of tokens and of all.

    Postings of a run: which lines of the tile have viewpoints with the token in sight, as bits of a byte;
    a byte for each such line; and 4 bits for each viewpoint (`FALLS`). Where all viewpoints of the tile
    have it in sight, the first byte is 0, and no others follow for lines.
    """
    token_starts, token_values, token_weights = tokens
    number, named = np.full(len(mass) - 1, -1, np.int64), np.empty(256, np.int32)
    held = np.zeros((256, SLOTS), np.float32)
    run_token, run_tile = np.empty(1024, np.int32), np.empty(1024, np.uint32)
    run_size, run_grades = np.empty(1024, np.uint8), np.empty((1024, 2), np.uint8)
    posted, density, views = np.empty(8192, np.uint8), np.empty(1024, np.uint8), 0
    things, n_things = np.empty(5 * len(visible.objects), np.uint8), 0
    thing_counts = np.zeros(len(keep), np.uint32)
    counted, shares = np.zeros(len(mass) - 1), np.zeros(len(mass) - 1)
    peak = np.zeros(len(mass) - 1, np.float32)
    in_sight = spread = pull = 0.0
    # of each slot: all, apart from what one stands in, squares of that; shares of labels
    sums, pulls = np.zeros((4, SLOTS), np.float32), np.empty(SLOTS, np.float32)
    total, alone, squared, labelled = sums[0], sums[1], sums[2], sums[3]
    where, visibility = np.empty(SLOTS, np.int64), np.empty(SLOTS, np.float32)
    runs = postings = 0
    for tile in range(len(keep)):
        n, last, begun = 0, -1, n_things
        sums[:] = 0.0
        for r in range(tile_starts[tile], tile_starts[tile + 1]):
            bits, e, o, many = visible.slots[r], visible.first[r], visible.objects[r], 0
            if not bits & keep[tile]:
                continue
            n_things = write_step(things, n_things, o - last)
            last = o
            while bits:
                slot = count_bits((bits & -bits) - 1)
                bits &= bits - 1
                if keep[tile] >> slot & 1:
                    s, (x, y) = visible.visibility[e], visible.offsets[e]
                    where[many], visibility[many] = slot, s
                    many += 1
                    total[slot] += s
                    if (
                        kind[o] != AREA or x != 0.0 or y != 0.0
                    ):  # what one stands in lies in no direction
                        alone[slot] += s
                        squared[slot] += s * s
                e += 1
            for t in range(token_starts[o], token_starts[o + 1]):
                m = number[token_values[t]]
                if m < 0:
                    if n == len(named):
                        named = np.concatenate((named, named))
                        held = np.concatenate((held, held))
                    m = number[token_values[t]] = n
                    named[n] = token_values[t]
                    held[n] = 0.0
                    n += 1
                for i in range(many):
                    held[m, where[i]] += visibility[i] * token_weights[t]
        thing_counts[tile] = n_things - begun
        if views + SLOTS > len(density):
            density = np.concatenate((density, np.empty_like(density)))
        for slot in range(SLOTS):
            if keep[tile] >> slot & 1:
                pairs = max(alone[slot] * alone[slot] - squared[slot], np.float32(0.0))
                density[views] = pack_density(total[slot], pairs)
                pulls[slot] = PULLS[density[views]]
                views += 1
                mass[-1] += total[slot]
                if core[tile] >> slot & 1:
                    in_sight += total[slot]
                    pull = max(pull, np.float64(total[slot]) ** 2 / (pairs + CROWDED))
        if runs + n > len(run_token):
            more = max(n, len(run_token))
            run_token = np.concatenate((run_token, np.empty(more, np.int32)))
            run_tile = np.concatenate((run_tile, np.empty(more, np.uint32)))
            run_size = np.concatenate((run_size, np.empty(more, np.uint8)))
            run_grades = np.concatenate((run_grades, np.empty((more, 2), np.uint8)))
        if postings + n * SLOTS > len(posted):
            posted = np.concatenate((posted, np.empty(max(n * SLOTS, len(posted)), np.uint8)))
        for m in range(n):
            token = named[m]
            number[token] = -1
            largest = np.float32(0.0)
            for slot in range(SLOTS):
                if held[m, slot] > 0.0:
                    largest = max(largest, held[m, slot] / total[slot])
            grade = grade_of(largest * 1.0001)
            size = write_postings(posted, postings, held[m], total, keep[tile], levels[grade])
            of_pairs = np.float32(1e-9)
            for slot in range(SLOTS):
                much = held[m, slot]
                if much == 0.0:
                    continue
                share = much / total[slot]
                kept = levels[grade] * FALLS[fall_of(share, levels[grade])]
                of_pairs = max(of_pairs, kept * pulls[slot])
                mass[token] += much
                if core[tile] >> slot & 1:
                    counted[token] += much
                    shares[token] += share
                    peak[token] = max(peak[token], share)
                    labelled[slot] += share if token < n_labels else np.float32(0.0)
            run_token[runs], run_tile[runs], run_size[runs] = token, tile, size
            run_grades[runs, 0], run_grades[runs, 1] = grade_of(of_pairs), grade
            postings += size
            runs += 1
        spread = max(spread, labelled.max())
    columns = run_token[:runs], run_tile[:runs], run_size[:runs], run_grades[:runs]
    of_views = density[:views], things[:n_things], thing_counts
    return columns, posted[:postings], of_views, (counted, shares, peak, in_sight, spread, pull)


@kernel(inline=True)
def fall_of(share, largest):
    """Return the place in `FALLS` of a share of all in sight, against the largest of its run."""
    return min(15, max(0, int(-np.log(share / largest) / FALL)))


@kernel(_nrt=False)
def write_postings(posted, n, masses, total, present, largest):
    """Write the postings of a run from `posted[n]` on; return their number of bytes."""
    begun, bits = n, np.int64(0)
    for slot in range(SLOTS):
        bits |= np.int64(masses[slot] > 0.0) << slot
    posted[n] = 0
    n += 1
    if bits != present:
        for line in range(SIDE):
            byte = (bits >> (SIDE * line)) & 255
            if byte:
                posted[begun] |= 1 << line
                posted[n] = byte
                n += 1
    half = 0
    for slot in range(SLOTS):
        if bits >> slot & 1:
            fall = fall_of(masses[slot] / total[slot], largest)
            posted[n] = fall if half == 0 else posted[n] | fall << 4
            n += half
            half ^= 1
    return n + half - begun


FAR = np.float32(1e30)
LINES = 2
"""Lines of points that are compared with a segment at once."""


@kernel
def collect_visible(kind, part_starts, point_starts, points, rows, grid, window, capacity, most):
    """Collect objects in sight of the points of a `grid` (east, north, stride) within `window`.

    `window` bounds columns and rows of its tiles, the last excluded. Returns, a thing and tile each: thing,
    line and column of the tile, slots, and where its vectors begin (one more); then vectors (E, 2) from
    points to the things; and whether that took at most `most` comparisons of points with boxes and segments.
    """
    east0, north0, stride = grid
    things, lines, columns = (
        np.empty(1024, np.int32),
        np.empty(1024, np.int32),
        np.empty(1024, np.int32),
    )
    slots, first = np.empty(1024, np.int64), np.empty(1025, np.int64)
    where = np.empty((capacity, 2), np.float32)
    crossed = np.empty(64, np.float64)
    near = np.empty((4, 3, SLOTS), np.float32)  # squares of distances, and vectors
    found, used, spent = 0, 0, 0.0
    first[0] = 0
    reach2, step, wide = np.float32(REACHED * REACHED), np.float32(stride), SIDE * stride
    for row in rows:
        a, b = point_starts[part_starts[row]], point_starts[part_starts[row + 1]]
        if b == a:
            continue
        w, e, s, n = box_of(points, a, b)
        c0 = max(window[0], int(np.floor((w - REACHED - east0) / wide)))
        c1 = min(window[1] - 1, int(np.floor((e + REACHED - east0) / wide)))
        r0 = max(window[2], int(np.floor((s - REACHED - north0) / wide)))
        r1 = min(window[3] - 1, int(np.floor((n + REACHED - north0) / wide)))
        if c1 < c0 or r1 < r0:
            continue
        width, height = c1 - c0 + 1, r1 - r0 + 1
        spent += SLOTS * float(width) * height
        spent += SIDE * float(height) * (b - a) if kind[row] == AREA else 0.0
        if spent > most:  # before anything is allocated by it
            return things[:0], lines[:0], columns[:0], slots[:0], first[:1], where[:0], False
        if width * height > len(near):
            near = np.empty((width * height, 3, SLOTS), np.float32)
        for t in range(width * height):
            for k in range(SLOTS):
                near[t, 0, k] = FAR
        west, south = east0 + c0 * wide, north0 + r0 * wide
        # segments reach the grid points around them
        for part in range(part_starts[row], part_starts[row + 1]):
            i0, i1 = point_starts[part], point_starts[part + 1]
            for i in range(i0, max(i0 + 1, i1 - 1)):
                j = min(i + 1, i1 - 1)
                x0, y0 = np.float32(points[i, 0] - west), np.float32(points[i, 1] - south)
                dx, dy = (
                    np.float32(points[j, 0] - points[i, 0]),
                    np.float32(points[j, 1] - points[i, 1]),
                )
                length2 = dx * dx + dy * dy
                inverse = np.float32(0.0) if length2 == 0.0 else np.float32(1.0) / length2
                ca = max(0, int(np.floor((min(x0, x0 + dx) - REACHED) / wide)))
                cb = min(width - 1, int(np.floor((max(x0, x0 + dx) + REACHED) / wide)))
                ra = max(0, int(np.ceil((min(y0, y0 + dy) - REACHED) / stride)))
                rb = min(SIDE * height - 1, int(np.floor((max(y0, y0 + dy) + REACHED) / stride)))
                spent += float(SIDE * max(0, cb - ca + 1)) * max(0, rb - ra + 1)
                if spent > most:
                    return (
                        things[:0],
                        lines[:0],
                        columns[:0],
                        slots[:0],
                        first[:1],
                        where[:0],
                        False,
                    )
                for r in range(ra // LINES, rb // LINES + 1):
                    line, at = r * LINES // SIDE, r * LINES % SIDE * SIDE
                    fy = y0 - np.float32(r * LINES) * step
                    for c in range(ca, cb + 1):
                        fx, t = x0 - np.float32(c * SIDE) * step, line * width + c
                        for k in range(LINES * SIDE):  # so many that they are compiled as vectors
                            ex = fx - np.float32(k & (SIDE - 1)) * step
                            ey = fy - np.float32(k >> 3) * step
                            along = -(ex * dx + ey * dy) * inverse
                            along = along if along > np.float32(0.0) else np.float32(0.0)
                            along = along if along < np.float32(1.0) else np.float32(1.0)
                            px, py = ex + along * dx, ey + along * dy
                            d = px * px + py * py
                            closer = d < near[t, 0, at + k]
                            near[t, 0, at + k] = d if closer else near[t, 0, at + k]
                            near[t, 1, at + k] = px if closer else near[t, 1, at + k]
                            near[t, 2, at + k] = py if closer else near[t, 2, at + k]
        # scan lines fill areas
        if kind[row] == AREA:
            for r in range(
                max(0, int(np.ceil((s - south) / stride))),
                min(SIDE * height - 1, int(np.floor((n - south) / stride))) + 1,
            ):
                crossed, count = crossings(
                    part_starts, point_starts, points, row, south + r * stride, crossed
                )
                for i in range(0, count - 1, 2):
                    ca = max(0, int(np.ceil((crossed[i] - west) / stride)))
                    cb = min(SIDE * width - 1, int(np.floor((crossed[i + 1] - west) / stride)))
                    for c in range(ca, cb + 1):
                        t, k = (
                            (r >> 3) * width + (c >> 3),
                            (r & (SIDE - 1)) * SIDE + (c & (SIDE - 1)),
                        )
                        near[t, 0, k] = near[t, 1, k] = near[t, 2, k] = 0.0
        if used + width * height * SLOTS > len(where):
            where = np.concatenate(
                (where, np.empty_like(where), np.empty((width * height * SLOTS, 2), np.float32))
            )
        if found + width * height > len(things):
            more = max(len(things), width * height)
            things = np.concatenate((things, np.empty(more, np.int32)))
            lines = np.concatenate((lines, np.empty(more, np.int32)))
            columns = np.concatenate((columns, np.empty(more, np.int32)))
            slots = np.concatenate((slots, np.empty(more, np.int64)))
            first = np.concatenate((first, np.empty(more, np.int64)))
        for t in range(width * height):
            bits = np.int64(0)
            for k in range(SLOTS):
                bits |= np.int64(near[t, 0, k] <= reach2) << k
            if bits == 0:
                continue
            things[found], slots[found] = row, bits
            lines[found], columns[found] = r0 + t // width, c0 + t % width
            while bits:
                k = count_bits((bits & -bits) - 1)
                bits &= bits - 1
                where[used, 0], where[used, 1] = near[t, 1, k], near[t, 2, k]
                used += 1
            found += 1
            first[found] = used
    return (
        things[:found], lines[:found], columns[:found], slots[:found], first[: found + 1], where[:used],
        True,
    )  # fmt: skip
