"""Compiled loops of maps: order of triangles, panoramas, cells of rooms."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.core.threads import run_parallel
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    ORIGIN,
    TRIANGLE,
    U,
    V,
    new_packet,
    trace16,
)

# mypy: allow-untyped-defs, allow-incomplete-defs


@kernel
def label_charts(triangles, vertices):
    """Return lowest vertex (V,) of the connected part, joined by triangles (T, 3), of each vertex."""
    root = np.empty(vertices, np.int64)
    for v in range(vertices):
        root[v] = v
    for t in range(len(triangles)):
        for k in range(2):
            a, b = triangles[t, k], triangles[t, k + 1]
            while root[a] != a:
                root[a] = root[root[a]]
                a = root[a]
            while root[b] != b:
                root[b] = root[root[b]]
                b = root[b]
            root[max(a, b)] = min(a, b)
    for v in range(vertices):
        root[v] = root[root[v]]  # lower vertices are done
    return root


@kernel(inline=True)
def sample_colour(surface, triangle, u, v, footprint):
    """Return colour in sRGB (3 floats, 0 to 1) at barycentrics u, v of a triangle.

    `footprint`: width of what the ray stands for at the hit [m].
    """
    a = surface.triangles[triangle, 0]
    b = surface.triangles[triangle, 1]
    c = surface.triangles[triangle, 2]
    w = np.float32(1.0) - u - v
    red = w * surface.colours[a, 0] + u * surface.colours[b, 0] + v * surface.colours[c, 0]
    green = w * surface.colours[a, 1] + u * surface.colours[b, 1] + v * surface.colours[c, 1]
    blue = w * surface.colours[a, 2] + u * surface.colours[b, 2] + v * surface.colours[c, 2]
    texture = surface.texture_of[triangle]
    level = 0
    texels = surface.texels_per_metre[triangle] * footprint
    while texels > np.float32(1.5) and level < surface.levels.shape[1] - 1:
        texels *= np.float32(0.5)
        level += 1
    width = surface.levels[texture, level, 1]
    height = surface.levels[texture, level, 2]
    x = w * surface.uv[a, 0] + u * surface.uv[b, 0] + v * surface.uv[c, 0]
    y = w * surface.uv[a, 1] + u * surface.uv[b, 1] + v * surface.uv[c, 1]
    column = min(int((x - np.floor(x)) * width), width - 1)
    row = min(int((y - np.floor(y)) * height), height - 1)
    texel = surface.levels[texture, level, 0] + row * width + column
    scale = np.float32(1.0 / (255.0 * 255.0))
    return (
        red * surface.texels[texel, 0] * scale,
        green * surface.texels[texel, 1] * scale,
        blue * surface.texels[texel, 2] * scale,
    )


@kernel(inline=True)
def opponent_colour(red, green, blue):
    """Return lightness and two chromaticities (3 floats) that a lamp's brightness leaves alone."""
    total = red + green + blue
    shade = np.float32(1.0) / (total + np.float32(0.06))
    return total, (red - blue) * shade, (np.float32(2.0) * green - red - blue) * shade


_LOOK = 64  # vertices of more triangles than this are walked around as the triangles lie


@kernel
def encode_rows(rows, codes):
    """Write how far each row (N,) is below the number of those met in order so far."""
    high = 0
    for i in range(len(rows)):
        codes[i] = high - rows[i]
        high += rows[i] == high


@kernel
def order_fans(corners, vertices):
    """Return order (T,) of triangles (T, 3), new number (V,) of each vertex or -1, and how many are used.

    Vertices wait in the order in which they were met; around each its triangles follow, each beside
    the one before where there is such a one.
    """
    first = np.zeros(vertices + 1, np.int64)
    for t in range(len(corners)):
        for k in range(3):
            first[corners[t, k] + 1] += 1
    for v in range(vertices):
        first[v + 1] += first[v]
    around = np.empty(3 * len(corners), np.int64)
    place = first[:-1].copy()
    for t in range(len(corners)):
        for k in range(3):
            v = corners[t, k]
            around[place[v]] = t
            place[v] += 1
    done = np.zeros(len(corners), np.bool_)
    order = np.empty(len(corners), np.int64)
    number = np.full(vertices, -1)
    queue = np.empty(vertices, np.int64)
    n, count, head, seed = 0, 0, 0, 0
    while n < len(corners):
        if head == count:  # a part is done
            while done[seed]:
                seed += 1
            for k in range(3):
                v = corners[seed, k]
                if number[v] < 0:
                    number[v] = count
                    queue[count] = v
                    count += 1
            done[seed] = True
            order[n] = seed
            n += 1
            continue
        v = queue[head]
        head += 1
        last = -1
        row = first[v]
        near = first[v + 1] - first[v] <= _LOOK
        while True:
            t = -1
            if near:
                best = -1
                for j in range(first[v], first[v + 1]):
                    if done[around[j]]:
                        continue
                    score = 0
                    for k in range(3):
                        w = corners[around[j], k]
                        if w != v:
                            score += 4 if w == last else number[w] >= 0
                    if score > best:
                        best, t = score, around[j]
            else:
                while row < first[v + 1] and done[around[row]]:
                    row += 1
                t = around[row] if row < first[v + 1] else -1
            if t < 0:
                break
            done[t] = True
            order[n] = t
            n += 1
            for k in range(3):
                w = corners[t, k]
                if number[w] < 0:
                    number[w] = count
                    queue[count] = w
                    count += 1
            newest = -1
            for k in range(3):
                w = corners[t, k]
                if w != v and number[w] > newest:
                    newest, last = number[w], w
    return order, number, count


AZIMUTHS = 72

ELEVATIONS = 20

STEP = 2.0 * np.pi / AZIMUTHS  # Bin of azimuth, and step of headings [rad]: 5 degrees

HEADINGS = 36  # Headings of a camera that are looked up at each position: every other bin

FOLD = AZIMUTHS // HEADINGS

NEAREST, FARTHEST = 0.1, 30.0  # ranges are stored in 255 steps of their logarithm, 2.3 % each

NOTHING = 255


class Panoramas(NamedTuple):
    """K panoramas of E elevations and A azimuths."""

    objects: NDArray[np.uint16]  # (K, E, A) row of the object; their number where the map ends
    ranges: NDArray[np.uint8]  # (K, E, A) logarithmic; 255: the map ends
    colours: NDArray[np.uint8]  # (K, E, 3, A) `opponent_colour`, scaled to bytes


COLOUR_SCALE = np.array([85.0, 127.0, 63.0], np.float32)

COLOUR_SHIFT = np.array([0.0, 127.0, 127.0], np.float32)


def render_panoramas(tracer, surface, points, directions, objects):
    """Return panoramas from points (K, 3)."""
    shape = (len(points), ELEVATIONS, AZIMUTHS)
    hit_objects = np.full(shape, objects, np.uint16)
    ranges = np.full(shape, NOTHING, np.uint8)
    colours = np.zeros((len(points), ELEVATIONS, 3, AZIMUTHS), np.uint8)
    run_parallel(
        _render_panoramas,
        len(points),
        tracer,
        surface,
        np.array(points),  # a writeable copy: kernels are compiled anew for read-only arrays
        directions,
        hit_objects,
        ranges,
        colours,
    )
    return Panoramas(hit_objects, ranges, colours)


@kernel(error_model="numpy")
def _render_panoramas(
    tracer, surface, points, directions, hit_objects, ranges, colours, first, last
):
    scale = np.float32(254.0 / np.log(FARTHEST / NEAREST))
    packet, ints, valid = new_packet()
    for k in range(first, last):
        for tile in range(len(directions) // LANES):
            for lane in range(LANES):
                for axis in range(3):
                    packet[ORIGIN + axis, lane] = points[k, axis]
                    packet[DIRECTION + axis, lane] = directions[tile * LANES + lane, axis]
                packet[FAR, lane] = np.inf
            trace16(tracer, packet, ints, valid)
            for lane in range(LANES):
                triangle = ints[TRIANGLE, lane]
                if triangle < 0:
                    continue
                e = tile // (AZIMUTHS // 4) * 4 + lane // 4
                a = tile % (AZIMUTHS // 4) * 4 + lane % 4
                hit_objects[k, e, a] = surface.object_of[triangle]
                steps = np.log(packet[FAR, lane] / np.float32(NEAREST)) * scale
                ranges[k, e, a] = np.uint8(min(max(steps, np.float32(0)), np.float32(254)))
                red, green, blue = sample_colour(
                    surface,
                    triangle,
                    packet[U, lane],
                    packet[V, lane],
                    packet[FAR, lane] * np.float32(STEP),
                )
                rendered = opponent_colour(red, green, blue)
                for c in range(3):
                    byte = rendered[c] * COLOUR_SCALE[c] + COLOUR_SHIFT[c]
                    colours[k, e, c, a] = np.uint8(min(max(byte, np.float32(0)), np.float32(255)))


class Bins(NamedTuple):
    """Bins of panoramas that T views meet, an even number of each, and what each view shows there."""

    ends: NDArray[np.int64]  # (T,) row behind the last bin of each view
    band: NDArray[np.int64]  # (B,) band of elevation
    azimuth: NDArray[np.int64]  # (B,) where the reference frame looks along bin 0
    semantic: NDArray[np.float32]
    """(B, N + 1) log-likelihood of each object, and of none; no column: labels are not asked."""
    depth: NDArray[np.float32]
    """(B, 256) log-likelihood of each stored range; no column: depth is not asked."""
    colour: NDArray[np.float32]
    """(B, 7) number of samples, sums and sums of squares of their three colours on the scale of bytes;
    no column: colours are not asked."""


_BLOCK = 256  # positions that are scanned beside each other


def scan_headings(panoramas, bins, colour_weight):
    """Return log-likelihood (T, K, HEADINGS): for each bin, its column turned through all headings."""
    count = len(panoramas.objects)
    out = np.empty((len(bins.ends), count, HEADINGS), np.float32)
    beside = Panoramas(*(np.moveaxis(a, 0, -1) for a in panoramas))
    sums = np.stack([part.sum(axis=0) for part in np.split(bins.colour, bins.ends[:-1])])
    run_parallel(_scan_headings, -(-count // _BLOCK), beside, bins, sums, colour_weight, out)
    return out


@kernel(fastmath=True, error_model="numpy")
def _scan_headings(panoramas, bins, view_sums, colour_weight, out, first, last):
    """Fill blocks `first` to `last` of positions of out (T, K, HEADINGS).

    `panoramas`: positions are their last axis. Loops run along it, as what a bin meets lies there in a row.
    """
    total, moments = np.empty(_BLOCK, np.float32), np.empty((16, _BLOCK), np.float32)
    for block in range(first, last):
        start = np.uint64(block * _BLOCK)
        count = np.uint64(min(_BLOCK, out.shape[1] - block * _BLOCK))
        places, begin = (start, count), 0
        for t in range(len(bins.ends)):
            rows = begin, bins.ends[t]
            for a in range(HEADINGS):
                total[:] = 0.0
                if bins.semantic.size:
                    _look_up(total, bins.semantic, panoramas.objects, bins, a, rows, places)
                if bins.depth.size:
                    _look_up(total, bins.depth, panoramas.ranges, bins, a, rows, places)
                if bins.colour.size:
                    _sum_colours(moments, panoramas, bins, a, rows, places)
                    _add_correlation(total, moments, view_sums[t], colour_weight)
                for k in range(count):
                    out[t, start + k, a] = total[k]
            begin = bins.ends[t]


@kernel(fastmath=True, error_model="numpy")
def _look_up(total, table, keys, bins, a, rows, places):
    """Add the values of rows of a table (B, N) that bins meet by their keys (E, A, K) under heading `a`."""
    band, azimuth, (start, count) = bins.band, bins.azimuth, places
    for b in range(rows[0], rows[1], 2):  # in pairs, which halves the accesses to total
        e, at = np.uint64(band[b]), np.uint64((azimuth[b] + a * FOLD) % AZIMUTHS)
        f, there = np.uint64(band[b + 1]), np.uint64((azimuth[b + 1] + a * FOLD) % AZIMUTHS)
        for k in range(count):
            total[k] += table[b, keys[e, at, start + k]] + table[b + 1, keys[f, there, start + k]]


@kernel(fastmath=True, error_model="numpy")
def _sum_colours(m, panoramas, bins, a, rows, places):
    """Sum the colours that rows of bins meet under heading `a` from places beside each other, to m (16, K).

    Of the image, sums of the columns of `Bins.colour` where nothing is hit; of each colour of the map, its
    sum, that of its squares, and that of its products with the image.
    """
    band, azimuth, image = bins.band, bins.azimuth, bins.colour
    ranges, colours, (start, count) = panoramas.ranges, panoramas.colours, places
    m[:] = 0.0
    for b in range(rows[0], rows[1], 2):
        e, at = np.uint64(band[b]), np.uint64((azimuth[b] + a * FOLD) % AZIMUTHS)
        f, there = np.uint64(band[b + 1]), np.uint64((azimuth[b + 1] + a * FOLD) % AZIMUTHS)
        i, j = image[b, 0], image[b + 1, 0]
        for c in range(3):
            p, q = image[b, 1 + c], image[b + 1, 1 + c]
            for k in range(count):
                r = np.float32(colours[e, c, at, start + k])  # 0 where nothing is hit
                s = np.float32(colours[f, c, there, start + k])
                m[7 + c, k] += i * r + j * s
                m[10 + c, k] += i * r * r + j * s * s
                m[13 + c, k] += p * r + q * s
    for b in range(rows[0], rows[1]):
        e, at = np.uint64(band[b]), np.uint64((azimuth[b] + a * FOLD) % AZIMUTHS)
        missed = False
        for k in range(count):
            missed |= ranges[e, at, start + k] == NOTHING
        if missed:
            for j in range(7):
                for k in range(count):
                    m[j, k] += image[b, j] * np.float32(ranges[e, at, start + k] == NOTHING)


@kernel(fastmath=True, error_model="numpy")
def _add_correlation(total, m, view_sums, colour_weight):
    """Add what colours tell (`score._tone`) by sums of `_sum_colours`, and by those of the view (7,)."""
    zero, one = np.float32(0.0), np.float32(1.0)
    weight = colour_weight / max(one, view_sums[0]) / np.float32(6.0)
    for k in range(np.uint64(len(total))):
        n = view_sums[0] - m[0, k]
        left = one  # share of the variances that the map leaves unexplained
        for c in range(3):
            q, r = view_sums[1 + c] - m[1 + c, k], m[7 + c, k]
            vq, vr = n * (view_sums[4 + c] - m[4 + c, k]) - q * q, n * m[10 + c, k] - r * r
            both = max(n * m[13 + c, k] - q * r, zero)
            told = min(both * both / max(vq * vr, one), np.float32(0.99 * 0.99))
            left *= one - (told if min(vq, vr) > n * n else zero)
        m[0, k], m[1, k] = left, weight * n if n >= LANES else zero
    for k in range(np.uint64(len(total))):
        total[k] -= m[1, k] * np.log(m[0, k])


def add_shifted(total, scan, unknown, positions, layer_of, index, origin, spacing, step):
    """Add the scores of `scan`, shifted by `step` (3,) [m], to the poses of the reference frame."""
    grid = positions, layer_of, index, origin, spacing, step
    run_parallel(_add_shifted, len(positions), total, scan, unknown, *grid)


@kernel
def _add_shifted(
    total, scan, unknown, positions, layer_of, index, origin, spacing, step, first, last
):  # fmt: skip
    _, nx, ny = index.shape
    turn = 2.0 * np.pi / HEADINGS
    for a in range(HEADINGS):
        c, s = np.cos(a * turn), np.sin(a * turn)
        along, across = c * step[0] - s * step[1], s * step[0] + c * step[1]
        for k in range(first, last):
            i = int(np.floor((positions[k, 0] + along - origin[0]) / spacing))
            j = int(np.floor((positions[k, 1] + across - origin[1]) / spacing))
            row = -1
            if 0 <= i < nx and 0 <= j < ny:
                row = index[layer_of[k], i, j]
            total[k, a] += scan[row, a] if row >= 0 else unknown


_MOST_SAMPLES = 512  # along an edge of a triangle


@kernel
def draw_cuts(corners, kinds, heights, origin, cell, bits):
    """Draw where triangles (T, 3 corners, 3) meet level planes (K,).

    Sets bit k of `found[kinds[t]]` (kinds, nx, ny) where triangle t meets plane k in a cell; a
    kind below 0 is left out.
    """
    ends = np.empty((3, 2))
    for t in range(len(corners)):
        if kinds[t] < 0:
            continue
        plane = bits[kinds[t]]
        low = min(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2])
        high = max(corners[t, 0, 2], corners[t, 1, 2], corners[t, 2, 2])
        for k in range(len(heights)):
            z = heights[k]
            if not low < z <= high:
                continue
            count = 0
            for i in range(3):
                a, b = corners[t, i], corners[t, (i + 1) % 3]
                if (a[2] < z) != (b[2] < z):
                    share = (z - a[2]) / (b[2] - a[2])
                    ends[count, 0] = (a[0] + share * (b[0] - a[0]) - origin[0]) / cell
                    ends[count, 1] = (a[1] + share * (b[1] - a[1]) - origin[1]) / cell
                    count += 1
            if count == 2:
                _draw_line(ends, np.uint32(1 << k), plane)


@kernel
def _draw_line(ends, bit, plane):
    """Set a bit in every cell on the way from one end to the other, in steps of half a cell."""
    dx, dy = ends[1, 0] - ends[0, 0], ends[1, 1] - ends[0, 1]
    steps = int(2.0 * max(abs(dx), abs(dy))) + 1
    for s in range(steps + 1):
        x, y = int(ends[0, 0] + dx * s / steps), int(ends[0, 1] + dy * s / steps)
        if 0 <= x < plane.shape[0] and 0 <= y < plane.shape[1]:
            plane[x, y] |= bit


@kernel
def rasterize_triangles(corners, chosen, origin, cell, covered):
    """Mark the cells whose centre lies under or over one of the chosen triangles (T, 3, 3)."""
    nx, ny = covered.shape
    for t in range(len(corners)):
        if not chosen[t]:
            continue
        ax, ay = (corners[t, 0, 0] - origin[0]) / cell, (corners[t, 0, 1] - origin[1]) / cell
        bx, by = (corners[t, 1, 0] - origin[0]) / cell, (corners[t, 1, 1] - origin[1]) / cell
        cx, cy = (corners[t, 2, 0] - origin[0]) / cell, (corners[t, 2, 1] - origin[1]) / cell
        doubled = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        if doubled == 0.0:
            continue
        west, east = int(min(ax, bx, cx)), int(max(ax, bx, cx))
        south, north = int(min(ay, by, cy)), int(max(ay, by, cy))
        for x in range(max(0, west), min(nx - 1, east) + 1):
            for y in range(max(0, south), min(ny - 1, north) + 1):
                px, py = x + 0.5 - ax, y + 0.5 - ay
                v = (px * (cy - ay) - py * (cx - ax)) / doubled
                w = ((bx - ax) * py - (by - ay) * px) / doubled
                if v >= -1e-6 and w >= -1e-6 and v + w <= 1.000001:
                    covered[x, y] = True


@kernel
def distance_transform(mask, reach):
    """Return squared distance [cells2] of every cell to the nearest one of a mask, and its number x ny + y.

    Where there is none within `reach` cells, it is (reach + 1) squared, and -1. Exact: first along
    columns, then along rows, as far out as a nearer one can lie.
    """
    nx, ny = mask.shape
    far = reach + 1
    column = np.full((nx, ny), far, np.int32)  # signed offset in y
    for x in range(nx):
        last = -1
        for y in range(ny):
            if mask[x, y]:
                last = y
            if last >= 0 and y - last < far:
                column[x, y] = last - y
        last = -1
        for y in range(ny - 1, -1, -1):
            if mask[x, y]:
                last = y
            if last >= 0 and last - y < abs(column[x, y]):
                column[x, y] = last - y
    squared = np.full((nx, ny), far * far, np.int32)
    number = np.full((nx, ny), -1, np.int32)
    for x in range(nx):
        for y in range(ny):
            best, row = far * far, -1
            if abs(column[x, y]) < far:
                best, row = column[x, y] ** 2, x
            k = 1
            while k <= reach and k * k < best:
                for side in (x - k, x + k):
                    if 0 <= side < nx and abs(column[side, y]) < far:
                        d = column[side, y] ** 2 + k * k
                        if d < best:
                            best, row = d, side
                k += 1
            if best <= reach * reach:
                squared[x, y] = best
                number[x, y] = row * ny + y + column[row, y]
    return squared, number


@kernel
def _find_root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
def flood_basins(width, order, least, narrow, door, narrow_door):
    """Flood basins of half-widths (nx, ny) [m]: from the widest place down, cut where it is narrow.

    `order` (M,): cells x ny + y to be flooded, widest first; they are neighbours by their sides, since
    walls askew touch at corners. Two basins stay apart where the widest place of each is at least
    `least`, and the pass between them at most the share `narrow` of the narrower one's (`narrow_door`
    where the pass is at most `door`). Returns the basin of each cell, -1: not flooded, and basins that
    meet (C, 2), the widest pass first.
    """
    nx, ny = width.shape
    flat = width.reshape(-1)
    parent = np.arange(nx * ny)
    seen = np.zeros(nx * ny, np.bool_)
    meetings = np.empty((3 * len(order), 2), np.int64)
    count = 0
    for i in order:
        seen[i] = True
        x, y = i // ny, i % ny
        best = -1
        for k in range(4):  # the widest neighbour's basin, if there is one, takes the cell
            u, v = x + _X[k], y + _Y[k]
            j = u * ny + v
            if 0 <= u < nx and 0 <= v < ny and seen[j] and (best < 0 or flat[j] > flat[best]):
                best = j
        if best < 0:
            continue
        parent[i] = _find_root(parent, best)
        for k in range(4):
            u, v = x + _X[k], y + _Y[k]
            j = u * ny + v
            if not (0 <= u < nx and 0 <= v < ny and seen[j]):
                continue
            one, other = _find_root(parent, i), _find_root(parent, j)
            if one == other:
                continue
            if flat[one] < flat[other]:
                one, other = other, one
            share = narrow_door if flat[i] <= door else narrow
            if flat[other] < least or flat[i] > share * flat[other]:
                parent[other] = one  # a root is its basin's widest place
            elif count < len(meetings):
                meetings[count, 0], meetings[count, 1] = one, other
                count += 1
    basin = np.full(nx * ny, -1)
    for i in order:
        basin[i] = _find_root(parent, i)
    for c in range(count):
        meetings[c, 0] = _find_root(parent, meetings[c, 0])
        meetings[c, 1] = _find_root(parent, meetings[c, 1])
    return basin.reshape(nx, ny), meetings[:count].copy()


_X = np.array([1, -1, 0, 0, 1, 1, -1, -1])
_Y = np.array([0, 0, 1, -1, 1, -1, 1, -1])


@kernel
def label_components(mask):
    """Number the 8-connected parts of a mask (nx, ny) from 0 on; -1 outside of it."""
    nx, ny = mask.shape
    part = np.full((nx, ny), -1, np.int32)
    stack = np.empty(nx * ny, np.int64)
    count = 0
    for x in range(nx):
        for y in range(ny):
            if not mask[x, y] or part[x, y] >= 0:
                continue
            part[x, y] = count
            stack[0] = x * ny + y
            top = 1
            while top:
                top -= 1
                i = stack[top]
                for k in range(8):
                    u, v = i // ny + _X[k], i % ny + _Y[k]
                    if 0 <= u < nx and 0 <= v < ny and mask[u, v] and part[u, v] < 0:
                        part[u, v] = count
                        stack[top] = u * ny + v
                        top += 1
            count += 1
    return part, count


@kernel
def sum_areas(corners, areas, object_of, origin, cell, rooms, votes):
    """Add the area [m2] of triangles (T, 3, 3) that lies in each room to `votes` (N, R + 1).

    `rooms` (nx, ny) is the room of a cell; -1, and what is beyond the grid, counts in the last
    column. Triangles are divided until their parts are no longer than two cells.
    """
    nx, ny = rooms.shape
    none = votes.shape[1] - 1
    for t in range(len(corners)):
        a, b, c = corners[t, 0], corners[t, 1], corners[t, 2]
        reach = max(
            abs(b[0] - a[0]), abs(c[0] - a[0]), abs(c[0] - b[0]),
            abs(b[1] - a[1]), abs(c[1] - a[1]), abs(c[1] - b[1]),
        )  # fmt: skip
        n = min(_MOST_SAMPLES, int(reach / (2.0 * cell)) + 1)
        part = areas[t] / (n * n)
        for i in range(n):
            for j in range(2 * (n - i) - 1):  # triangles upright and upside down by turns
                turned = j % 2
                v = (i + (1.0 + turned) / 3.0) / n
                w = (j // 2 + (1.0 + turned) / 3.0) / n
                x = int(np.floor((a[0] + v * (b[0] - a[0]) + w * (c[0] - a[0]) - origin[0]) / cell))
                y = int(np.floor((a[1] + v * (b[1] - a[1]) + w * (c[1] - a[1]) - origin[1]) / cell))
                room = rooms[x, y] if 0 <= x < nx and 0 <= y < ny else -1
                votes[object_of[t], room if room >= 0 else none] += part
