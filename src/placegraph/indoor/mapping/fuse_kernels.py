# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of the sparse volume `fuse.Volume`: a hash of blocks, and views taken into them.

A block is a cube of SIDE^3 voxels; its key packs its whole coordinates. The hash is open addressing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.core.threads import run_parallel

SIDE = 8  # Voxels along the edge of a block
SIZE = SIDE**3
RANGE = 1 << 20  # Coordinates of blocks are below this, either way
NEAR = 0.15  # Readings and voxels nearer than this are none [m]
TILE = 8  # Edge of the squares of pixels of which the farthest reading is kept [px]
BAND = 2.0  # Colour is taken this near to the surface [voxels]


class Blocks(NamedTuple):
    """Blocks of a volume, and their hash; room for B, the first of which are used."""

    keys: NDArray[np.int64]  # (K,) of the hash, -1 where free; K is a power of two
    rows: NDArray[np.int32]  # (K,) of the blocks with these keys
    places: NDArray[np.int32]  # (B, 3) whole coordinates
    distance: NDArray[np.float32]
    """(B, SIZE) [m], positive in front of surfaces, cut at the truncation."""
    weight: NDArray[np.float32]
    """(B, SIZE) sum of cos(incidence) / depth^4 of the views [1 / m^4]."""
    colour: NDArray[np.float32]  # (B, SIZE, 3) mean sRGB near surfaces, 0 to 255
    paint: NDArray[np.float32]  # (B, SIZE) weight of the colour
    voxel: float  # Edge of a voxel [m]
    truncation: float  # Distances beyond this are cut [m]


@kernel(inline=True)
def key_of(x, y, z):
    """Return key of the block at whole coordinates."""
    return ((x + RANGE) << 42) | ((y + RANGE) << 21) | (z + RANGE)


@kernel(inline=True)
def transform(pose, x, y, z):
    """Return point as three numbers after a rigid motion (4, 4)."""
    return (
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@kernel(_nrt=False)
def slot_of(keys, key):
    """Return the slot of a key, or the free one where it would stand."""
    mask = np.int64(len(keys) - 1)
    mixed = (key ^ (key >> np.int64(31))) * np.int64(0x1E3779B97F4A7C15)
    at = (mixed ^ (mixed >> np.int64(29))) & mask
    while keys[at] != -1 and keys[at] != key:
        at = (at + 1) & mask
    return at


@kernel(_nrt=False)
def row_of(blocks, x, y, z):
    """Return row of the block at whole coordinates, -1: there is none."""
    if abs(x) >= RANGE or abs(y) >= RANGE or abs(z) >= RANGE:
        return -1
    at = slot_of(blocks.keys, key_of(x, y, z))
    return blocks.rows[at] if blocks.keys[at] != -1 else -1


@kernel
def rehash(blocks, count):
    """Fill the empty hash with the first `count` blocks."""
    keys, rows, places = blocks.keys, blocks.rows, blocks.places
    for row in range(count):
        key = key_of(np.int64(places[row, 0]), np.int64(places[row, 1]), np.int64(places[row, 2]))
        at = slot_of(keys, key)
        keys[at], rows[at] = key, row


@kernel(error_model="numpy")
def allocate_blocks(blocks, count, facets, eye, pose, step):
    """Give a block to every place within the truncation of a reading; count of blocks afterwards.

    Stops early, and says so by -1 - count, where the room ends: then give it more room and call again.
    `facets`: see `compute_facets`; `eye`: fx, fy, cx, cy; `pose`: (4, 4) map_from_camera; `step`: every
    such line and column is looked at.
    """
    keys, rows, places = blocks.keys, blocks.rows, blocks.places
    edge, band = SIDE * blocks.voxel, blocks.truncation
    h, w = facets.shape[:2]
    last = np.int64(-1)
    for v in range(step // 2, h, step):
        y = (v + 0.5 - eye[3]) / eye[1]
        for u in range(step // 2, w, step):
            z = facets[v, u, 4]
            if z == 0:
                continue
            x = (u + 0.5 - eye[2]) / eye[0]
            ray = np.sqrt(1 + x * x + y * y)
            parts = int(np.ceil(4 * band / edge)) + 1  # half a block apart
            for part in range(parts):
                at = max(z + (2 * part / (parts - 1) - 1) * band / ray, 0.0)
                px, py = x * at, y * at
                mx, my, mz = transform(pose, px, py, at)
                bx, by = np.int64(np.floor(mx / edge)), np.int64(np.floor(my / edge))
                bz = np.int64(np.floor(mz / edge))
                if abs(bx) >= RANGE or abs(by) >= RANGE or abs(bz) >= RANGE:
                    continue
                key = key_of(bx, by, bz)
                if key == last:
                    continue
                last = key
                slot = slot_of(keys, key)
                if keys[slot] == key:
                    continue
                if count == len(places):
                    return -1 - count
                places[count, 0], places[count, 1], places[count, 2] = bx, by, bz
                keys[slot], rows[slot] = key, count
                count += 1
    return count


@kernel(error_model="numpy")
def integrate(blocks, chosen, facets, image, gain, eyes, pose, first, last):
    """Take one view into the blocks `chosen`, from `first` to `last` of them, in place.

    `facets`: (h, w, 6), see `compute_facets`; `image`: (H, W, 3) uint8; `gain`: what the image is
    multiplied by; `eyes`: (2, 4) fx, fy, cx, cy of the depth and of the colour camera; `pose`: (4, 4)
    camera_from_map.
    """
    places, voxel, truncation = blocks.places, blocks.voxel, blocks.truncation
    distance, weight, colour, paint = blocks.distance, blocks.weight, blocks.colour, blocks.paint
    band = BAND * voxel
    h, w = facets.shape[:2]
    tall, wide = image.shape[:2]
    sx, sy, sz = voxel * pose[0, 2], voxel * pose[1, 2], voxel * pose[2, 2]
    for n in range(first, last):
        row = chosen[n]
        for line in range(SIDE * SIDE):
            px = (places[row, 0] * SIDE + line // SIDE + 0.5) * voxel
            py = (places[row, 1] * SIDE + line % SIDE + 0.5) * voxel
            pz = (places[row, 2] * SIDE + 0.5) * voxel
            x0, y0, z0 = transform(pose, px, py, pz)
            for k in range(SIDE):
                x, y, z = x0 + k * sx, y0 + k * sy, z0 + k * sz
                if z < NEAR:
                    continue
                a, b = x / z, y / z
                u, v = eyes[0, 0] * a + eyes[0, 2], eyes[0, 1] * b + eyes[0, 3]
                if u < 0 or v < 0 or u >= w or v >= h:
                    continue
                facet = facets[int(v), int(u)]
                seen = facet[4]
                if seen == 0:
                    continue
                behind = (z - seen) * np.sqrt(1 + a * a + b * b)  # along the ray
                if behind > truncation:
                    continue
                gap = facet[3] - (facet[0] * x + facet[1] * y + facet[2] * z)  # in front > 0
                if gap < -truncation:
                    continue
                at = line * SIDE + k
                new = facet[5]
                weight[row, at] += new
                distance[row, at] += (
                    new / weight[row, at] * (min(gap, truncation) - distance[row, at])
                )
                near = 1 - abs(gap) / band
                if near <= 0:
                    continue
                u, v = eyes[1, 0] * a + eyes[1, 2], eyes[1, 1] * b + eyes[1, 3]
                if u < 0 or v < 0 or u >= wide or v >= tall:
                    continue
                # near and frontal views count most, yet noise is averaged
                new = near * np.sqrt(new)
                paint[row, at] += new
                share = new / paint[row, at]
                pixel = image[int(v), int(u)]
                for c in range(3):
                    colour[row, at, c] += share * (gain * pixel[c] - colour[row, at, c])


@kernel(error_model="numpy")
def resample_image(image, uv, out):
    """Fill `out` (h, w, 3) uint8 with an image (H, W, 3) between its pixels at places (h, w, 2) [px]."""
    rows, columns = image.shape[:2]
    for i in range(len(out)):
        for j in range(out.shape[1]):
            x, y = uv[i, j, 0] - 0.5, uv[i, j, 1] - 0.5
            if not (-1.0 < x < columns and -1.0 < y < rows):
                out[i, j] = 0
                continue
            x, y = min(max(x, 0.0), columns - 1.0), min(max(y, 0.0), rows - 1.0)
            left, top = int(x), int(y)
            s, t = x - left, y - top
            p, q = min(left + 1, columns - 1), min(top + 1, rows - 1)
            for c in range(3):
                out[i, j, c] = np.uint8(
                    (1 - s) * (1 - t) * image[top, left, c] + s * (1 - t) * image[top, p, c]
                    + (1 - s) * t * image[q, left, c] + s * t * image[q, p, c] + 0.5
                )  # fmt: skip


@kernel(error_model="numpy")
def measure_gaps(blocks, points):
    """Measure distances (N,) [m] of points (N, 3) [m] from the surface; the truncation where none is near."""
    voxel, truncation = blocks.voxel, blocks.truncation
    out = np.empty(len(points), np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0] / voxel - 0.5, points[i, 1] / voxel - 0.5, points[i, 2] / voxel - 0.5
        x0, y0, z0 = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
        total, sum_ = 0.0, 0.0
        for corner in range(8):
            a, b, c = x0 + (corner & 1), y0 + (corner >> 1 & 1), z0 + (corner >> 2)
            row = row_of(blocks, a // SIDE, b // SIDE, c // SIDE)
            if row < 0:
                continue
            at = (a % SIDE * SIDE + b % SIDE) * SIDE + c % SIDE
            if blocks.weight[row, at] == 0:
                continue
            share = (1 - abs(x - a)) * (1 - abs(y - b)) * (1 - abs(z - c))
            total += share
            sum_ += share * blocks.distance[row, at]
        out[i] = min(abs(sum_ / total), truncation) if total > 0.5 else truncation
    return out


@kernel(error_model="numpy")
def brightness_ratios(blocks, facets, image, eyes, pose, step):
    """Compare the model's brightness with the image's (N,) float32, where both are known.

    Parameters as of `integrate` and `allocate_blocks`.
    """
    voxel = blocks.voxel
    h, w = facets.shape[:2]
    tall, wide = image.shape[:2]
    out = np.empty(((h + step - 1) // step) * ((w + step - 1) // step), np.float32)
    n = 0
    for v in range(step // 2, h, step):
        y = (v + 0.5 - eyes[0, 3]) / eyes[0, 1]
        for u in range(step // 2, w, step):
            z = facets[v, u, 4]
            if z == 0:
                continue
            x = (u + 0.5 - eyes[0, 2]) / eyes[0, 0]
            i, j = eyes[1, 0] * x + eyes[1, 2], eyes[1, 1] * y + eyes[1, 3]
            if i < 0 or j < 0 or i >= wide or j >= tall:
                continue
            pixel = image[int(j), int(i)]
            seen = 0.25 * pixel[0] + 0.5 * pixel[1] + 0.25 * pixel[2]
            if max(pixel[0], pixel[1], pixel[2]) > 245 or seen < 12:
                continue  # clipped, or noise
            px, py = x * z, y * z
            mx, my, mz = transform(pose, px, py, z)
            a, b = np.int64(np.floor(mx / voxel)), np.int64(np.floor(my / voxel))
            c = np.int64(np.floor(mz / voxel))
            row = row_of(blocks, a // SIDE, b // SIDE, c // SIDE)
            if row < 0:
                continue
            at = (a % SIDE * SIDE + b % SIDE) * SIDE + c % SIDE
            if blocks.paint[row, at] <= 0:
                continue
            model = blocks.colour[row, at]
            known = 0.25 * model[0] + 0.5 * model[1] + 0.25 * model[2]
            if 12 <= known <= 245:
                out[n] = known / seen
                n += 1
    return out[:n]


FLAT = 0.1  # Least cosine of the angle at which a reading's surface is looked at


def compute_facets(depth, eye, reach, edges):
    """Compute plane, reading and weight of every pixel (h, w, 6) float32.

    Columns 0 to 2: unit normal n in the camera, away from it; 3: n @ x of the plane's points x, so
    that column 3 - n @ p is how far a point p lies in front; 4: the reading [m], 0: none, or not to be
    believed; 5: weight, cosine / reading^4. `depth`: (h, w) float32 [m], NaN: none; `eye`: fx, fy,
    cx, cy; `reach`: greatest reading used [m]; `edges`: whether readings at depth edges are dropped.

    Planes are linear in the image if written for 1 / depth: slopes are a least-squares fit over
    readings that are near in depth, every second of 5 x 5.
    """
    out = np.zeros((*depth.shape, 6), np.float32)
    run_parallel(_facets_of, len(out), depth, eye, reach, edges, out)
    return out


@kernel(error_model="numpy")
def _facets_of(depth, eye, reach, edges, out, first, last):
    """Fill lines `first` to `last` of out (h, w, 6)."""
    h, w = depth.shape
    for v in range(first, last):
        y = (v + 0.5 - eye[3]) / eye[1]
        for u in range(w):
            z = depth[v, u]
            read = z >= NEAR
            if not read:
                z = interpolate_depth(depth, v, u)
            if not (NEAR <= z <= reach):
                continue
            here = 1.0 / z
            allowed = (0.01 + 0.011 * z * z) * here * here  # of noise, at this depth
            if edges and read and is_depth_edge(depth, v, u, here, allowed):
                continue
            n, su, sv, si = 0, 0.0, 0.0, 0.0
            suu, suv, svv, sui, svi = 0.0, 0.0, 0.0, 0.0, 0.0
            for dv in range(-2, 3, 2):
                for du in range(-2, 3, 2):
                    i, j = v + dv, u + du
                    if i < 0 or j < 0 or i >= h or j >= w:
                        continue
                    other = depth[i, j]
                    if not other >= NEAR:
                        continue
                    step = 1.0 / other - here
                    if abs(step) > 2 * allowed:
                        continue
                    n += 1
                    su, sv, si = su + du, sv + dv, si + step
                    suu, suv, svv = suu + du * du, suv + du * dv, svv + dv * dv
                    sui, svi = sui + du * step, svi + dv * step
            if n < 4:
                continue  # nothing around agrees: a speck
            suu, suv, svv = suu - su * su / n, suv - su * sv / n, svv - sv * sv / n
            sui, svi = sui - su * si / n, svi - sv * si / n
            determinant = suu * svv - suv * suv
            if determinant < 1:
                continue
            slope_u = (svv * sui - suv * svi) / determinant
            slope_v = (suu * svi - suv * sui) / determinant
            change = (si - slope_u * su - slope_v * sv) / n
            if abs(change) < 0.5 * allowed:
                here += change  # the fit is less noisy than the reading, but for creases
            x = (u + 0.5 - eye[2]) / eye[0]
            # a x + b y + c = 1 / z of rays (x, y, 1): the plane is (a, b, c) @ point = 1
            a, b = slope_u * eye[0], slope_v * eye[1]
            c = here - a * x - b * y
            length = np.sqrt(a * a + b * b + c * c)
            cosine = here / (length * np.sqrt(1 + x * x + y * y))
            if cosine < FLAT:
                continue
            out[v, u, 0], out[v, u, 1], out[v, u, 2] = a / length, b / length, c / length
            out[v, u, 3] = 1 / length
            out[v, u, 4] = 1 / here
            out[v, u, 5] = cosine * here**4


@kernel(error_model="numpy", _nrt=False)
def interpolate_depth(depth, v, u):
    """Interpolate a reading between two that agree, up to 4 pixels apart; else 0.

    Near surfaces are larger in the image than their voxels: one hole would leave voxels unseen.
    """
    h, w = depth.shape
    best, least = 0.0, np.inf
    for axis in range(2):
        before, after = 0.0, 0.0
        for step in range(2, 0, -1):
            i, j = (v, u - step) if axis == 0 else (v - step, u)
            k, m = (v, u + step) if axis == 0 else (v + step, u)
            if i >= 0 and j >= 0 and depth[i, j] >= NEAR:
                before = depth[i, j]
            if k < h and m < w and depth[k, m] >= NEAR:
                after = depth[k, m]
        if before == 0 or after == 0:
            continue
        apart = abs(before - after)
        if apart < least and apart < 2 * (0.01 + 0.011 * before * before):
            best, least = 0.5 * (before + after), apart
    return best


@kernel(error_model="numpy", _nrt=False)
def is_depth_edge(depth, v, u, here, allowed):
    """Return whether a reading stands at a depth edge, where it may be a mean of both sides."""
    h, w = depth.shape
    for axis in range(2):
        i, j = (v, u - 1) if axis == 0 else (v - 1, u)
        before = 1.0 / depth[i, j] if i >= 0 and j >= 0 else np.nan
        i, j = (v, u + 1) if axis == 0 else (v + 1, u)
        after = 1.0 / depth[i, j] if i < h and j < w else np.nan
        # a plane's 1 / depth is linear: no second difference, however steep
        if abs(before + after - 2 * here) > allowed:
            return True
        # at a hole only one side can be asked (a comparison with NaN is false)
        if np.isnan(before + after) and (
            abs(before - here) > 2 * allowed or abs(after - here) > 2 * allowed
        ):
            return True
    return False


@kernel(error_model="numpy")
def find_farthest(facets):
    """Find greatest reading of every tile (h / TILE, w / TILE) of TILE^2 pixels, 0: none."""
    h, w = facets.shape[:2]
    out = np.zeros(((h + TILE - 1) // TILE, (w + TILE - 1) // TILE), np.float32)
    for v in range(h):
        for u in range(w):
            out[v // TILE, u // TILE] = max(out[v // TILE, u // TILE], facets[v, u, 4])
    return out


@kernel(error_model="numpy")
def find_visible(blocks, count, far, eye, shape, pose):
    """Find rows of the first `count` blocks that a view may see, ascending.

    `far`: of `find_farthest`; `shape`: height and width [px]; `pose`: (4, 4) camera_from_map.
    """
    places, edge = blocks.places, SIDE * blocks.voxel
    found = np.empty(count, np.int32)
    n = 0
    radius = 0.5 * np.sqrt(3.0) * edge
    for row in range(count):
        px, py = (places[row, 0] + 0.5) * edge, (places[row, 1] + 0.5) * edge
        x, y, z = transform(pose, px, py, (places[row, 2] + 0.5) * edge)
        if z < -radius:
            continue
        left, right, top, low = 0.0, shape[1] - 1.0, 0.0, shape[0] - 1.0
        front = z - radius
        if front > NEAR:  # bounds of the sphere's picture, on the safe side
            left = eye[0] * min((x - radius) / front, (x - radius) / (z + radius)) + eye[2]
            right = eye[0] * max((x + radius) / front, (x + radius) / (z + radius)) + eye[2]
            top = eye[1] * min((y - radius) / front, (y - radius) / (z + radius)) + eye[3]
            low = eye[1] * max((y + radius) / front, (y + radius) / (z + radius)) + eye[3]
            if right < 0 or low < 0 or left >= shape[1] or top >= shape[0]:
                continue
        a, b = int(max(left, 0.0)) // TILE, int(min(right, shape[1] - 1.0)) // TILE
        c, d = int(max(top, 0.0)) // TILE, int(min(low, shape[0] - 1.0)) // TILE
        deepest = np.float32(0)
        for i in range(c, d + 1):
            for j in range(a, b + 1):
                deepest = max(deepest, far[i, j])
        if deepest > 0 and front < deepest + blocks.truncation:
            found[n] = row
            n += 1
    return found[:n]


_WIDE = SIDE + 1


def find_neighbours(blocks, count):
    """Find rows (B, 27) of the blocks around each, -1 where there is none; column 13 is the block."""
    out = np.empty((count, 27), np.int32)
    run_parallel(_neighbours, count, blocks, out)
    return out


@kernel
def _neighbours(blocks, out, first, last):
    places = blocks.places
    for row in range(first, last):
        x, y, z = np.int64(places[row, 0]), np.int64(places[row, 1]), np.int64(places[row, 2])
        for side in range(27):
            out[row, side] = row_of(
                blocks, x + side // 9 - 1, y + side // 3 % 3 - 1, z + side % 3 - 1
            )


@kernel(_nrt=False)
def corner_of(around, row, i, j, k):
    """Return block and voxel of the voxel at i, j, k (-1 to SIDE) of a block; block -1: not there."""
    side = (i + SIDE) // SIDE * 9 + (j + SIDE) // SIDE * 3 + (k + SIDE) // SIDE
    return around[row, side], (i % SIDE * SIDE + j % SIDE) * SIDE + k % SIDE


def find_cells(around, blocks, least, loops):
    """Find the surface: case (B, SIZE) uint8 and crossed edges (B, SIZE) uint16 of every cell.

    Also the number of vertices by block (B,). Cell i, j, k reaches from voxel i, j, k to the next along
    every axis. Bit e of `crossed` is set where edge e (4 axis + 0 to 3, see `low_corner`) leads
    from free space to behind the surface, between voxels that weigh more than `least`; not where the
    distance jumps by more than the truncation: there a carved voxel lies beside one behind
    something. Bit c of a case is set where corner c (x + 2 y + 4 z) lies behind the surface; a cell
    of which not all is known has case 0. `loops`: see `fuse.make_loop_tables`.
    """
    count = len(around)
    cases = np.zeros((count, SIZE), np.uint8)
    crossed = np.zeros((count, SIZE), np.uint16)
    sizes = np.zeros(count, np.int64)
    given = around, blocks.distance, blocks.weight, least, blocks.truncation, loops
    run_parallel(_cells_of, count, *given, cases, crossed, sizes)
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


def make_vertices(around, blocks, cases, crossed, starts, loop_of, loops):
    """Make vertices (V, 3) [m], colours (V, 3), and the first vertex of every cell (B, SIZE) int64.

    `starts`: (B + 1,) first vertex of each block; `loop_of`: (256, 12), see `fuse.make_loop_tables`.
    A vertex is the mean of the points where its loop crosses the edges of the cell.
    """
    points = np.zeros((starts[-1], 3), np.float64)
    paints = np.zeros((starts[-1], 3), np.uint8)
    vertex = np.zeros((len(around), SIZE), np.int32)
    cells = cases, crossed, starts, loop_of, loops
    run_parallel(_vertices_of, len(around), around, blocks, *cells, points, paints, vertex)
    return points, paints, vertex


@kernel
def _vertices_of(
    around, blocks, cases, crossed, starts, loop_of, loops, points, paints, vertex, first, last
):  # fmt: skip
    places, voxel = blocks.places, blocks.voxel
    distance, colour, paint = blocks.distance, blocks.colour, blocks.paint
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
    """Return corner at which an edge (4 axis + 0 to 3) of a cell begins."""
    axis, rest = edge >> 2, edge & 3
    one, two = (axis + 1) % 3, (axis + 2) % 3
    return (rest & 1) << one | (rest >> 1) << two


def make_quads(around, distance, cases, crossed, vertex, loop_of, starts, quads):
    """Make vertices around every edge that the surface crosses: count by block (B,), or fill `quads`.

    `quads`: (Q, 4) int32, empty for counting; `starts`: (B + 1,) first quad of each block. Seen from free
    space they run counter-clockwise.
    """
    sizes = np.zeros(len(around), np.int64)
    grid = around, distance, cases, crossed, vertex, loop_of
    run_parallel(_quads_of, len(around), *grid, starts, quads, sizes)
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
def split_quads(points, quads):
    """Split two triangles (2 Q, 3) int64 for each quad (Q, 4), along its shorter diagonal."""
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
def measure_areas(points, triangles):
    """Measure areas (T,) of triangles [m^2]."""
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
def find_roots(count, triangles):
    """Find lowest vertex (V,) of the connected part that every vertex belongs to."""
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
    """Return root of a vertex; the way there is cut short."""
    while root[vertex] != vertex:
        root[vertex] = root[root[vertex]]
        vertex = root[vertex]
    return vertex
