# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of the sparse volume: a hash of blocks, and views taken into them; see `volume`.

A block is a cube of SIDE^3 voxels; its key packs its whole coordinates. The hash is open addressing
over `keys` (K,) int64, -1 where free, and `rows` (K,) int32; K is a power of two.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel

SIDE = 8
"""Voxels along the edge of a block."""
SIZE = SIDE**3
RANGE = 1 << 20
"""Coordinates of blocks are below this, either way."""
NEAR = 0.15
"""Readings and voxels nearer than this are none [m]."""


@kernel(inline="always")
def key_of(x, y, z):
    """Key of the block at whole coordinates."""
    return ((x + RANGE) << 42) | ((y + RANGE) << 21) | (z + RANGE)


@kernel
def slot_of(keys, key):
    """Where a key stands, or would."""
    mask = np.int64(len(keys) - 1)
    mixed = (key ^ (key >> np.int64(31))) * np.int64(0x1E3779B97F4A7C15)
    at = (mixed ^ (mixed >> np.int64(29))) & mask
    while keys[at] != -1 and keys[at] != key:
        at = (at + 1) & mask
    return at


@kernel
def row_of(keys, rows, x, y, z):
    """Row of the block at whole coordinates, -1: there is none."""
    if abs(x) >= RANGE or abs(y) >= RANGE or abs(z) >= RANGE:
        return -1
    at = slot_of(keys, key_of(x, y, z))
    return rows[at] if keys[at] != -1 else -1


@kernel
def rehash(keys, rows, places, count):
    """Fill an empty hash with the first `count` of the blocks at `places` (B, 3)."""
    for row in range(count):
        key = key_of(np.int64(places[row, 0]), np.int64(places[row, 1]), np.int64(places[row, 2]))
        at = slot_of(keys, key)
        keys[at], rows[at] = key, row


@kernel(error_model="numpy")
def touch(keys, rows, places, count, room, facets, eye, pose, edge, band, step):
    """Give a block to every place within `band` [m] of a reading; count of blocks afterwards.

    Stops early, and says so by -1 - count, where `room` blocks are there: then give it more room and
    call again. `facets`: see `depth_kernels.facets_of`; `eye`: fx, fy, cx, cy; `pose`: (4, 4)
    map_from_camera; `edge`: of a block [m]; `step`: every such line and column is looked at.
    """
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
                bx = np.int64(
                    np.floor(
                        (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * at + pose[0, 3]) / edge
                    )
                )
                by = np.int64(
                    np.floor(
                        (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * at + pose[1, 3]) / edge
                    )
                )
                bz = np.int64(
                    np.floor(
                        (pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * at + pose[2, 3]) / edge
                    )
                )
                if abs(bx) >= RANGE or abs(by) >= RANGE or abs(bz) >= RANGE:
                    continue
                key = key_of(bx, by, bz)
                if key == last:
                    continue
                last = key
                slot = slot_of(keys, key)
                if keys[slot] == key:
                    continue
                if count == room:
                    return -1 - count
                places[count, 0], places[count, 1], places[count, 2] = bx, by, bz
                keys[slot], rows[slot] = key, count
                count += 1
    return count


@kernel(error_model="numpy")
def integrate(
    distance,
    weight,
    colour,
    paint,
    places,
    chosen,
    voxel,
    truncation,
    facets,
    image,
    gain,
    eyes,
    pose,
    band,
    first,
    last,
):
    """Take one view into the blocks `chosen`, from `first` to `last` of them, in place.

    `distance`, `weight`, `paint`: (B, SIZE) float32 signed distance [m], its weight, and that of the
    colour; `colour`: (B, SIZE, 3) float32; `facets`: (h, w, 6), see `depth_kernels.facets_of`;
    `image`: (H, W, 3) uint8; `gain`: what the image is multiplied by; `eyes`: (2, 4) fx, fy, cx, cy
    of the depth and of the colour camera; `pose`: (4, 4) camera_from_map; `band`: colour is
    taken within this distance of the surface [m].
    """
    h, w = facets.shape[:2]
    tall, wide = image.shape[:2]
    sx, sy, sz = voxel * pose[0, 2], voxel * pose[1, 2], voxel * pose[2, 2]
    for n in range(first, last):
        row = chosen[n]
        for line in range(SIDE * SIDE):
            px = (places[row, 0] * SIDE + line // SIDE + 0.5) * voxel
            py = (places[row, 1] * SIDE + line % SIDE + 0.5) * voxel
            pz = (places[row, 2] * SIDE + 0.5) * voxel
            x0 = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
            y0 = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
            z0 = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
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
                new = near * np.sqrt(
                    new
                )  # near and frontal views count most, yet noise is averaged
                paint[row, at] += new
                share = new / paint[row, at]
                pixel = image[int(v), int(u)]
                for c in range(3):
                    colour[row, at, c] += share * (gain * pixel[c] - colour[row, at, c])


@kernel(error_model="numpy")
def gaps_at(keys, rows, distance, weight, voxel, truncation, points):
    """Distances (N,) [m] of points (N, 3) [m] from the surface; the truncation where none is near."""
    out = np.empty(len(points), np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0] / voxel - 0.5, points[i, 1] / voxel - 0.5, points[i, 2] / voxel - 0.5
        x0, y0, z0 = np.int64(np.floor(x)), np.int64(np.floor(y)), np.int64(np.floor(z))
        total, sum_ = 0.0, 0.0
        for corner in range(8):
            a, b, c = x0 + (corner & 1), y0 + (corner >> 1 & 1), z0 + (corner >> 2)
            row = row_of(keys, rows, a // SIDE, b // SIDE, c // SIDE)
            if row < 0:
                continue
            at = (a % SIDE * SIDE + b % SIDE) * SIDE + c % SIDE
            if weight[row, at] == 0:
                continue
            share = (1 - abs(x - a)) * (1 - abs(y - b)) * (1 - abs(z - c))
            total += share
            sum_ += share * distance[row, at]
        out[i] = min(abs(sum_ / total), truncation) if total > 0.5 else truncation
    return out


@kernel(error_model="numpy")
def brightness_ratios(keys, rows, colour, paint, voxel, facets, image, eyes, pose, step, least):
    """Model's brightness over the image's, where both say something (N,) float32.

    Parameters as of `integrate` and `touch`; `least`: paint that a voxel needs.
    """
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
            a = np.int64(
                np.floor((pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * z + pose[0, 3]) / voxel)
            )
            b = np.int64(
                np.floor((pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * z + pose[1, 3]) / voxel)
            )
            c = np.int64(
                np.floor((pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * z + pose[2, 3]) / voxel)
            )
            row = row_of(keys, rows, a // SIDE, b // SIDE, c // SIDE)
            if row < 0:
                continue
            at = (a % SIDE * SIDE + b % SIDE) * SIDE + c % SIDE
            if paint[row, at] <= least:
                continue
            held = colour[row, at]
            known = 0.25 * held[0] + 0.5 * held[1] + 0.25 * held[2]
            if 12 <= known <= 245:
                out[n] = known / seen
                n += 1
    return out[:n]
