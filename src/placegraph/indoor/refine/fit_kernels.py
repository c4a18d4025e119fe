# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops of the refinement: normal equations, and scores of held-back samples.

A pose is given as `rotation` (3, 3) and `position` (3,) of map_from_camera, both float64 and
contiguous; derivatives are by a shift [m] and a turn [rad] in map axes.
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.indoor.rays.layout import DIRECTION, FAR, LANES, ORIGIN, TRIANGLE
from placegraph.indoor.rays.packets_kernels import new_packet, trace16


@kernel(error_model="numpy")
def depth_system(surfaces, shares, rotation, position, directions, depth, seen, kernel):
    """Normal equations of the depth readings of one frame at one pose.

    Parameters: `shares` (N,) weight of each object; `rotation` (3, 3) and `position` (3,) of
    map_from_camera; readings `directions` (R, 3), `depth` (R,), and `seen`, their normals (R, 3).

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
            facing = abs(toward[0] * seen[r, 0] + toward[1] * seen[r, 1] + toward[2] * seen[r, 2])
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
    """Readings of a depth image (h, w) at pixels `v`, `u` (R,), of which -1 is none.

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
        ax, ay, az = between(depth, rays, up, column, down, column)
        bx, by, bz = between(depth, rays, row, left, row, right)
        x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        length = np.sqrt(x * x + y * y + z * z)
        if length > 1e-12:  # not so where one of the points is no number
            normals[k, 0], normals[k, 1], normals[k, 2] = x / length, y / length, z / length
    return directions, read, normals


@kernel(inline="always")
def between(depth, rays, row, column, other, beside):
    """Way (3 floats) from the point that a pixel shows to that of another."""
    near, far = depth[row, column], depth[other, beside]
    return (
        far * rays[other, beside, 0] - near * rays[row, column, 0],
        far * rays[other, beside, 1] - near * rays[row, column, 1],
        far - near,
    )


@kernel(inline="always")
def at_edge(depth, row, column):
    """Whether depth jumps from a pixel to a neighbour by more than a slanted wall's would."""
    z = depth[row, column]
    for side in range(4):
        i = row + (side == 1) - (side == 3)
        j = column + (side == 0) - (side == 2)
        if 0 <= i < depth.shape[0] and 0 <= j < depth.shape[1]:
            beside = depth[i, j]
            if abs(beside - z) > 0.02 + 0.03 * min(beside, z):
                return True
    return False


@kernel(inline="always")
def add_row(h, g, j, e, w):
    """Add one residual with its derivatives (6,) to the upper half of normal equations."""
    for a in range(6):
        g[a] += w * e * j[a]
        for b in range(a, 6):
            h[a, b] += w * j[a] * j[b]


@kernel(inline="always")
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
    """Normal equations of matched points of one frame at one pose.

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
    """Distances (R,) [m] of readings from the plane of what their rays hit, along its normal.

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
def correlations(query, drawn, seen, at, half):
    """Zero-mean normalised correlations (N,) of windows, not below 0; NaN where the query is flat."""
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
                if seen[y, x]:
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
                if seen[y, x]:
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
