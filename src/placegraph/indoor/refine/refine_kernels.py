"""Compiled loops of the refinement: depth readings, matches, and patches found again."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    ORIGIN,
    TRIANGLE,
    new_packet,
    trace16,
)

# mypy: allow-untyped-defs, allow-incomplete-defs


@kernel(error_model="numpy")
def depth_system(surfaces, shares, rotation, position, directions, depth, seen_normals, kernel):
    """Return normal equations of the depth readings of one frame at one pose.

    Parameters: `shares` (N,) weight of each object; `rotation` (3, 3) and `position` (3,) of
    map_from_camera; readings `directions` (R, 3), `depth` (R,), and `seen_normals`, their normals (R, 3).

    Returns the matrix (6, 6) and the gradient (6,) for a shift [m] and a turn [rad] in map axes, for
    each object the sum of weights and the number of readings (N, 2), and three sums over readings:
    their number, their robust costs, and how many met the map. Residuals are distances to the plane
    of the hit; weights are Geman and McClure's, w = 1 / (1 + (e / c s)^2)^2, times how well the
    normals agree.
    """
    h, g, j = np.zeros((6, 6)), np.zeros(6), np.zeros(6)
    told = np.zeros((len(shares), 2))
    sums = np.zeros(3)
    toward = np.zeros(3)
    packet, ints, valid = new_packet()
    for tile in range(len(depth) // LANES):
        aim_rotated(packet, rotation, position, directions, tile * LANES)
        trace16(surfaces.tracer, packet, ints, valid)
        for lane in range(LANES):
            r = tile * LANES + lane
            z = depth[r]
            if z <= 0:
                continue
            sums[0] += 1.0
            triangle = ints[TRIANGLE, lane]
            if triangle < 0:
                sums[1] += 1.0
                continue
            sums[2] += 1.0
            nx, ny, nz = surfaces.normals[triangle]
            dx = packet[DIRECTION, lane]
            dy = packet[DIRECTION + 1, lane]
            dz = packet[DIRECTION + 2, lane]
            for k in range(3):  # the map's normal in camera axes
                toward[k] = rotation[0, k] * nx + rotation[1, k] * ny + rotation[2, k] * nz
            facing = abs(
                toward[0] * seen_normals[r, 0]
                + toward[1] * seen_normals[r, 1]
                + toward[2] * seen_normals[r, 2]
            )
            low, high = kernel.facing
            share = min(1.0, max(0.0, (facing - low) / (high - low)))
            slant = nx * dx + ny * dy + nz * dz
            e = slant * (z - packet[FAR, lane])
            deviation = (kernel.floor + kernel.slope * z * z) * slant
            variance = deviation * deviation + kernel.surface * kernel.surface
            ratio = e * e / (variance * kernel.width * kernel.width)
            w = share / ((1.0 + ratio) * (1.0 + ratio))
            sums[1] += 1.0 - share + share * ratio / (1.0 + ratio)
            n = surfaces.object_of[triangle]
            told[n, 0] += w
            told[n, 1] += 1.0
            x, y, q = dx * z, dy * z, dz * z
            j[0], j[1], j[2] = nx, ny, nz
            j[3] = y * nz - q * ny
            j[4] = q * nx - x * nz
            j[5] = x * ny - y * nx
            add_row(h, g, j, e, w * shares[n] / variance)
    for a in range(6):
        for b in range(a):
            h[a, b] = h[b, a]
    return h, g, told, sums


@kernel(error_model="numpy")
def read(depth, rays, v, u, reach):
    """Return readings of a depth image (h, w) at pixels `v`, `u` (R,), of which -1 is none.

    `rays`: (h, w, 2) of the pixels, where z is 1; `reach`: pixels from a reading to the points that its
    normal is made of. Returns, as of `depth.Readings`, directions (R, 3), depths (R,) and normals (R, 3).
    """
    h, w = depth.shape
    directions = np.ones((len(v), 3), np.float32)
    read = np.zeros(len(v), np.float32)
    normals = np.zeros((len(v), 3), np.float32)
    for k in range(len(v)):
        row, column = max(v[k], 0), max(u[k], 0)
        directions[k, 0], directions[k, 1] = rays[row, column]
        if v[k] < 0 or u[k] < 0:
            continue
        z = depth[row, column]
        if not np.isfinite(z) or at_edge(depth, row, column):
            continue
        read[k] = z
        up, down = max(row - reach, 0), min(row + reach, h - 1)
        left, right = max(column - reach, 0), min(column + reach, w - 1)
        ax, ay, az = subtract_points(depth, rays, up, column, down, column)
        bx, by, bz = subtract_points(depth, rays, row, left, row, right)
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        if length > 1e-12:  # not so where one of the points is no number
            normals[k, 0], normals[k, 1], normals[k, 2] = x / length, y / length, z / length
    return directions, read, normals


@kernel(inline=True)
def subtract_points(depth, rays, row, column, other, beside):
    """Return way (3 floats) from the point that a pixel shows to that of another."""
    near, far = depth[row, column], depth[other, beside]
    return (
        far * rays[other, beside, 0] - near * rays[row, column, 0],
        far * rays[other, beside, 1] - near * rays[row, column, 1],
        far - near,
    )


@kernel(inline=True)
def at_edge(depth, row, column):
    """Return whether depth jumps from a pixel to a neighbour by more than a slanted wall's would."""
    z = depth[row, column]
    for side in range(4):
        i = row + (side == 1) - (side == 3)
        j = column + (side == 0) - (side == 2)
        if 0 <= i < depth.shape[0] and 0 <= j < depth.shape[1]:
            beside = depth[i, j]
            if abs(beside - z) > 0.02 + 0.03 * min(beside, z):
                return True
    return False


@kernel(inline=True)
def add_row(h, g, j, e, w):
    """Add one residual with its derivatives (6,) to the upper half of normal equations."""
    for a in range(6):
        g[a] += w * e * j[a]
        for b in range(a, 6):
            h[a, b] += w * j[a] * j[b]


@kernel(inline=True)
def aim_rotated(packet, rotation, position, directions, first):
    """Fill a packet with the rays of one tile from one pose of six degrees of freedom."""
    for lane in range(LANES):
        x, y, z = directions[first + lane]
        for k in range(3):
            packet[ORIGIN + k, lane] = position[k]
            packet[DIRECTION + k, lane] = (
                rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z
            )
        packet[FAR, lane] = np.inf


@kernel(error_model="numpy")
def pixel_system(rotation, position, points, rays, sigma, focal, width):
    """Return normal equations of matched points of one frame at one pose.

    Parameters: `rotation` (3, 3) and `position` (3,) of map_from_camera; `points` (M, 3), `rays`
    (M, 2), `sigma` (M,) [px], `focal` [px]; `width` of the kernel in standard deviations.

    Returns the matrix (6, 6) and the gradient (6,) for a shift [m] and a turn [rad] in map axes, and
    the sum of weights, which are Geman and McClure's.
    """
    h, g = np.zeros((6, 6)), np.zeros(6)
    j = np.zeros((2, 6))
    d, c = np.zeros(3), np.zeros(3)
    total = 0.0
    for m in range(len(points)):
        for k in range(3):
            d[k] = points[m, k] - position[k]
        for k in range(3):
            c[k] = rotation[0, k] * d[0] + rotation[1, k] * d[1] + rotation[2, k] * d[2]
        if c[2] < 0.05:
            continue
        x, y = c[0] / c[2], c[1] / c[2]
        ex, ey = focal * (x - rays[m, 0]), focal * (y - rays[m, 1])
        s = sigma[m] * width
        ratio = (ex * ex + ey * ey) / (s * s)
        w = 1.0 / ((1.0 + ratio) * (1.0 + ratio))
        total += w
        for row in range(2):
            share = x if row == 0 else y
            scale = focal / c[2]
            # d(pixel)/d(shift) = -scale * (r_row - share r_3), with r the rows of R^T
            for k in range(3):
                j[row, k] = -scale * (rotation[k, row] - share * rotation[k, 2])
            # a turn of the camera moves the point as a shift by turn x d would move the camera
            j[row, 3] = d[1] * j[row, 2] - d[2] * j[row, 1]
            j[row, 4] = d[2] * j[row, 0] - d[0] * j[row, 2]
            j[row, 5] = d[0] * j[row, 1] - d[1] * j[row, 0]
        w /= sigma[m] * sigma[m]
        add_row(h, g, j[0], ex, w)
        add_row(h, g, j[1], ey, w)
    for a in range(6):
        for b in range(a):
            h[a, b] = h[b, a]
    return h, g, total


@kernel(error_model="numpy")
def plane_distances(surfaces, rotation, position, directions, depth):
    """Return distances (R,) [m] of readings from the plane of what their rays hit, along its normal.

    NaN where there is no reading, infinite where the map shows nothing.
    """
    out = np.full(len(depth), np.nan)
    packet, ints, valid = new_packet()
    for tile in range(len(depth) // LANES):
        aim_rotated(packet, rotation, position, directions, tile * LANES)
        trace16(surfaces.tracer, packet, ints, valid)
        for lane in range(LANES):
            r = tile * LANES + lane
            if depth[r] <= 0:
                continue
            out[r] = np.inf
            triangle = ints[TRIANGLE, lane]
            if triangle >= 0:
                nx, ny, nz = surfaces.normals[triangle]
                slant = (
                    nx * packet[DIRECTION, lane]
                    + ny * packet[DIRECTION + 1, lane]
                    + nz * packet[DIRECTION + 2, lane]
                )
                out[r] = abs(slant * (depth[r] - packet[FAR, lane]))
    return out


@kernel(error_model="numpy")
def correlations(query, drawn, mask, at, half):
    """Return zero-mean normalised correlations (N,) of windows, not below 0; NaN where the query is flat."""
    side = 2 * half + 1
    out = np.empty(len(at))
    for k in range(len(at)):
        row, column = at[k, 0], at[k, 1]
        n = qs = ds = qq = dd = qd = 0.0
        for y in range(row - half, row + half + 1):
            for x in range(column - half, column + half + 1):
                q = query[y, x]
                qs += q
                qq += q * q
                if mask[y, x]:
                    n += 1.0
        spread = qq - qs * qs / (side * side)
        if spread < side * side * 4e-4:
            out[k] = np.nan
            continue
        out[k] = 0.0
        if n < 0.5 * side * side:
            continue
        qs = qq = 0.0
        for y in range(row - half, row + half + 1):
            for x in range(column - half, column + half + 1):
                if mask[y, x]:
                    q, d = query[y, x], drawn[y, x]
                    qs += q
                    ds += d
                    qq += q * q
                    dd += d * d
                    qd += q * d
        vq, vd = qq - qs * qs / n, dd - ds * ds / n
        if vq > 1e-9 and vd > n * 1e-5:
            out[k] = max(0.0, (qd - qs * ds / n) / np.sqrt(vq * vd))
    return out


# mypy: allow-untyped-defs, allow-incomplete-defs


_TENSOR = 2  # half the side of the window of the structure tensor [px]
_FLAT = np.float32(1e-5)  # variance per pixel below which a window shows nothing
_LEAST = 1e-4  # least eigenvalue of the structure tensor of a corner


@kernel(fastmath=True, error_model="numpy")
def corners(image, mask, margin, cell):
    """Return best corner (K, 2) row, column of each cell of an image (H, W) float32 in [0, 1].

    A corner is where the lesser eigenvalue of the structure tensor is largest (Shi and Tomasi
    1994). Only pixels in `mask` (H, W), at least `margin` from the border.
    """
    h, w = image.shape
    xx, xy, yy = np.zeros((h, w)), np.zeros((h, w)), np.zeros((h, w))
    for y in range(1, h - 1):
        for x in range(1, w - 1):
            gx = image[y, x + 1] - image[y, x - 1]
            gy = image[y + 1, x] - image[y - 1, x]
            if not (mask[y, x + 1] and mask[y, x - 1] and mask[y + 1, x] and mask[y - 1, x]):
                gx = gy = np.float32(0.0)  # where the map ends is no corner of anything
            xx[y, x], xy[y, x], yy[y, x] = gx * gx, gx * gy, gy * gy
    margin = max(margin, _TENSOR + 1)
    out = np.empty((((h // cell) + 1) * ((w // cell) + 1), 2), np.float64)
    count = 0
    for top in range(margin, h - margin, cell):
        for left in range(margin, w - margin, cell):
            best, row, column = _LEAST, -1, -1
            for y in range(top, min(top + cell, h - margin)):
                for x in range(left, min(left + cell, w - margin)):
                    if not mask[y, x]:
                        continue
                    a = b = c = 0.0
                    for j in range(-_TENSOR, _TENSOR + 1):
                        for i in range(-_TENSOR, _TENSOR + 1):
                            a += xx[y + j, x + i]
                            b += xy[y + j, x + i]
                            c += yy[y + j, x + i]
                    least = 0.5 * (a + c) - np.sqrt(0.25 * (a - c) * (a - c) + b * b)
                    if least > best:
                        best, row, column = least, y, x
            if row >= 0:
                out[count, 0], out[count, 1] = row, column
                count += 1
    return out[:count]


@kernel(fastmath=True, error_model="numpy")
def search(view, mask, query, at, half, radius, peak):
    """Return places in a query (H, W) of patches of a view (H, W) around `at` (K, 2) row, column.

    Only pixels of a patch in `mask` (H, W) count; a patch of which less than half is seen is none.

    Returns (K, 4): row, column (to a fraction of a pixel), zero-mean normalised correlation there,
    and the best one farther than `peak` from it; correlation -1 where nothing was found. A best place
    on the rim of the window is none: the true one may lie beyond.
    """
    h, w = query.shape
    side, reach = 2 * half + 1, 2 * radius + 1
    patch = np.empty((side, side), np.float32)
    patch_mask = np.empty((side, side), np.float32)
    scores = np.empty((reach, reach), np.float32)
    rows = np.empty((3, reach), np.float32)
    out = np.empty((len(at), 4))
    for k in range(len(at)):
        row, column = int(at[k, 0]), int(at[k, 1])
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = row, column, -1.0, -1.0
        area, energy = _template(view, mask, row, column, half, patch, patch_mask)
        if 2.0 * area < side * side or energy < area * _FLAT:
            continue
        scores[:] = -1.0
        left = max(-radius, half - column)
        width = min(radius, w - 1 - half - column) + 1 - left
        for j in range(max(-radius, half - row), min(radius, h - 1 - half - row) + 1):
            _correlate_row(
                query, row + j - half, column + left - half, patch, patch_mask, area, rows, width
            )
            for i in range(width):
                spread = rows[1, i] - rows[0, i] * rows[0, i] / area
                if spread > area * _FLAT:
                    scores[j + radius, left + i + radius] = rows[2, i] / np.sqrt(spread * energy)
        best, rival, j, i = _peaks(scores, peak)
        if best <= -1.0 or not (0 < j < 2 * radius and 0 < i < 2 * radius):
            continue
        out[k, 0] = row + j - radius + _vertex(scores[j - 1, i], best, scores[j + 1, i])
        out[k, 1] = column + i - radius + _vertex(scores[j, i - 1], best, scores[j, i + 1])
        out[k, 2], out[k, 3] = best, rival
    return out


@kernel(inline=True, fastmath=True)
def _correlate_row(query, top, left, patch, patch_mask, area, rows, width):
    """Return sums, sums of squares and products with a patch (3, width) at `width` places in a row.

    The innermost loop runs along the row of places, which is what processors are quick at.
    """
    side = len(patch)
    rows[:, :width] = 0.0
    whole = area == side * side
    for y in range(side):
        for x in range(side):
            p, m = patch[y, x], patch_mask[y, x]
            if whole or m > 0.0:
                for i in range(width):
                    q = query[top + y, left + x + i]
                    rows[0, i] += q
                    rows[1, i] += q * q
                    rows[2, i] += q * p


@kernel(inline=True, fastmath=True)
def _peaks(scores, peak):
    """Return best score, the best farther than `peak` from it, and the row and column of the first."""
    best, rival, row, column = np.float32(-1.0), np.float32(-1.0), 0, 0
    for y in range(scores.shape[0]):
        for x in range(scores.shape[1]):
            if scores[y, x] > best:
                best, row, column = scores[y, x], y, x
    for y in range(scores.shape[0]):
        for x in range(scores.shape[1]):
            if (abs(y - row) > peak or abs(x - column) > peak) and scores[y, x] > rival:
                rival = scores[y, x]
    return best, rival, row, column


@kernel(inline=True, fastmath=True)
def _template(view, mask, row, column, half, patch, patch_mask):
    """Copy a patch less its mean, and which of it is seen; its number of pixels, and its energy."""
    side = 2 * half + 1
    total = area = energy = np.float32(0.0)
    for y in range(side):
        for x in range(side):
            j, i = row - half + y, column - half + x
            patch_mask[y, x] = np.float32(1.0) if mask[j, i] else np.float32(0.0)
            patch[y, x] = view[j, i] * patch_mask[y, x]
            total += patch[y, x]
            area += patch_mask[y, x]
    mean = total / max(area, np.float32(1.0))
    for y in range(side):
        for x in range(side):
            patch[y, x] -= mean * patch_mask[y, x]
            energy += patch[y, x] * patch[y, x]
    return area, energy


@kernel(inline=True)
def _vertex(before, at, after):
    """Return place of a parabola's top through three scores, from the middle one [-0.5 to 0.5]."""
    bend = before - np.float32(2.0) * at + after
    if before <= -1.0 or after <= -1.0 or bend >= 0.0:
        return np.float32(0.0)
    return np.float32(0.5) * (before - after) / bend
