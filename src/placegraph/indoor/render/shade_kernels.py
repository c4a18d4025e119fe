# mypy: allow-untyped-defs, allow-incomplete-defs
"""What colour a ray sees: texels over what a pixel covers.

A ray's `u` and `v` are the weights of a triangle's corners 1 and 2. How far they move from one pixel
to the next follows from the ray's own equation, so that the texels a pixel covers are known on every
slope: o + t d = a + u e1 + v e2, differentiated along the image (Igehy 1999, ray differentials).
"""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.indoor.rays.layout import DIRECTION, FAR, LANES, TRIANGLE, U, V

MOST_LOOKS = np.float32(8.0)
"""Looks at the texture along the longer side of what a pixel covers."""
WIDEST = np.float32(1e12)
"""Texels, squared, that a pixel may cover along; grazing rays cover all there are."""
SHARP = np.float32(1.05)
"""Texels a pixel: up to here a surface is seen at its finest level."""
ONE, HALF, SHARE = np.float32(1.0), np.float32(0.5), np.float32(1.0 / 255.0)
# without the flags that take away NaN and infinity: grazing rays meet both
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}


@kernel(error_model="numpy")
def steps(rays, row, column):
    """How a ray's x and y change from one pixel to the next: along the row, and down the column."""
    right, down = min(column + 1, rays.shape[1] - 1), min(row + 1, rays.shape[0] - 1)
    left, up = max(right - 1, 0), max(down - 1, 0)
    return (
        rays[row, right, 0] - rays[row, left, 0],
        rays[row, right, 1] - rays[row, left, 1],
        rays[down, column, 0] - rays[up, column, 0],
        rays[down, column, 1] - rays[up, column, 1],
    )


# ----------------------------------------------------------------------------------- colours


@kernel(fastmath=FAST, error_model="numpy")
def shade(world, eye, packet, ints, places, width, colours):
    """Colours (16, 3) float32, 0 to 255, of what the lanes of a packet hit.

    `places`: (16, 2) row and column of each lane's pixel, of which it stands for the share `width`
    in height and breadth. Lanes that hit nothing are left alone.
    """
    surface, at = world.surface, world.vertices
    triangles, own, uv = surface.triangles, surface.colours, surface.uv
    texture_of, levels, texels = surface.texture_of, surface.levels, surface.texels
    for lane in range(LANES):
        triangle = ints[TRIANGLE, lane]
        if triangle < 0:
            continue
        a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
        u, v = packet[U, lane], packet[V, lane]
        if world.coloured:
            w = ONE - u - v
            for k in range(3):
                colours[lane, k] = (w * own[a, k] + u * own[b, k] + v * own[c, k]) * SHARE
        else:
            colours[lane, :] = ONE
        texture = texture_of[triangle]
        if levels[texture, 0, 1] * levels[texture, 0, 2] == 1:
            only = levels[texture, 0, 0]
            for k in range(3):
                colours[lane, k] *= texels[only, k]
            continue
        us, ut = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
        vs, vt = uv[c, 0] - uv[a, 0], uv[c, 1] - uv[a, 1]
        # p = e2 x d, q = d x e1: du = t ddx . p / (e1 . p), dv = t ddx . q / (e1 . p)
        ex, ey, ez = at[b, 0] - at[a, 0], at[b, 1] - at[a, 1], at[b, 2] - at[a, 2]
        fx, fy, fz = at[c, 0] - at[a, 0], at[c, 1] - at[a, 1], at[c, 2] - at[a, 2]
        dx, dy, dz = (
            packet[DIRECTION, lane],
            packet[DIRECTION + 1, lane],
            packet[DIRECTION + 2, lane],
        )
        px, py, pz = cross(fx, fy, fz, dx, dy, dz)
        qx, qy, qz = cross(dx, dy, dz, ex, ey, ez)
        scale = width * packet[FAR, lane] / (ex * px + ey * py + ez * pz)
        p0, p1 = across(eye.turn, px, py, pz)
        q0, q1 = across(eye.turn, qx, qy, qz)
        xx, xy, yx, yy = steps(eye.rays, places[lane, 0], places[lane, 1])
        ux, vx = scale * (xx * p0 + xy * p1), scale * (xx * q0 + xy * q1)
        uy, vy = scale * (yx * p0 + yy * p1), scale * (yx * q0 + yy * q1)
        columns, rows = np.float32(levels[texture, 0, 1]), np.float32(levels[texture, 0, 2])
        sx, tx = ux * us + vx * vs, ux * ut + vx * vt
        sy, ty = uy * us + vy * vs, uy * ut + vy * vt
        along = (sx * columns) ** 2 + (tx * rows) ** 2
        down = (sy * columns) ** 2 + (ty * rows) ** 2
        if down > along:
            sx, tx = sy, ty
        taps, level, part = looks(max(along, down), min(along, down), levels.shape[1] - 1)
        s, t = uv[a, 0] + u * us + v * vs, uv[a, 1] + u * ut + v * vt
        red, green, blue = filtered(levels, texels, texture, s, t, sx, tx, taps, level, part)
        colours[lane, 0] *= red
        colours[lane, 1] *= green
        colours[lane, 2] *= blue


@kernel(inline="always", error_model="numpy")
def cross(ax, ay, az, bx, by, bz):
    """Product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@kernel(error_model="numpy")
def across(turn, x, y, z):
    """Parts of a vector along the camera's x and y axes."""
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
    )


@kernel(fastmath=FAST, error_model="numpy")
def looks(longer, shorter, deepest):
    """How to look at a texture of which a pixel covers about an ellipse of these axes [texels^2].

    Returns how many looks along the longer axis, the level whose texels are at most as wide as a
    look's share, and the part that the next coarser level has in it.
    """
    # an axis is infinite, or not a number, where the ray runs along the face
    longer = np.sqrt(min(WIDEST, longer))
    if longer <= SHARP:
        return 1, 0, np.float32(0.0)
    shorter = np.sqrt(max(shorter, ONE) if shorter < WIDEST else WIDEST)
    taps = max(int(min(np.ceil(longer / shorter - np.float32(0.25)), MOST_LOOKS)), 1)
    fine = max(np.log2(longer / np.float32(taps)), np.float32(0.0))
    level = min(int(fine), deepest)
    part = fine - np.float32(level)
    if part < np.float32(0.05) or level == deepest:
        part = np.float32(0.0)
    return taps, level, part


@kernel(fastmath=FAST, error_model="numpy")
def filtered(levels, texels, texture, s, t, sx, tx, taps, level, part):
    """Mean colour (3 floats) of a texture around (s, t), seen by `looks` along (sx, tx).

    Textures repeat beyond [0, 1); a look lies between the four texels around it.
    """
    red = green = blue = np.float32(0.0)
    share = ONE / np.float32(taps)
    for coarser in range(2 if part > 0 else 1):
        start = levels[texture, level + coarser, 0]
        columns, rows = levels[texture, level + coarser, 1], levels[texture, level + coarser, 2]
        weight = share * (part if coarser else ONE - part)
        for tap in range(taps):
            at = (np.float32(tap) + HALF) * share - HALF
            x, y = s + at * sx, t + at * tx
            x = (x - np.floor(x)) * np.float32(columns) - HALF
            y = (y - np.floor(y)) * np.float32(rows) - HALF
            left, top = int(np.floor(x)), int(np.floor(y))
            x, y = x - np.float32(left), (y - np.float32(top))
            right = left + 1 if left + 1 < columns else 0
            bottom = top + 1 if top + 1 < rows else 0
            left = left if left >= 0 else columns - 1
            top = top if top >= 0 else rows - 1
            a, b = start + top * columns + left, start + top * columns + right
            c, d = start + bottom * columns + left, start + bottom * columns + right
            wa, wb = weight * (ONE - x) * (ONE - y), weight * x * (ONE - y)
            wc, wd = weight * (ONE - x) * y, weight * x * y
            red += wa * texels[a, 0] + wb * texels[b, 0] + wc * texels[c, 0] + wd * texels[d, 0]
            green += wa * texels[a, 1] + wb * texels[b, 1] + wc * texels[c, 1] + wd * texels[d, 1]
            blue += wa * texels[a, 2] + wb * texels[b, 2] + wc * texels[c, 2] + wd * texels[d, 2]
    return red, green, blue
