"""Compiled rendering: rays of pixels, and the colours of what they hit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.indoor.map.mesh import Surface
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    ORIGIN,
    TRIANGLE,
    Tracer,
    U,
    V,
    new_packet,
    trace16,
)

# mypy: allow-untyped-defs, allow-incomplete-defs


MOST_LOOKS = np.float32(8.0)  # Looks at the texture along the longer side of what a pixel covers
WIDEST = np.float32(1e12)
"""Texels, squared, that a pixel may cover along; grazing rays cover all there are."""
SHARP = np.float32(1.05)  # Texels a pixel: up to here a surface is seen at its finest level
ONE, HALF, SHARE = np.float32(1.0), np.float32(0.5), np.float32(1.0 / 255.0)
# without the flags that take away NaN and infinity: grazing rays meet both
FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}


@kernel(error_model="numpy")
def differentiate_rays(rays, row, column):
    """Differentiate a ray's x and y along the row and down the column, by pixel."""
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
    """Shade what the lanes of a packet hit: colours (16, 3) float32, 0 to 255.

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
        p0, p1 = project_on_axes(eye.turn, px, py, pz)
        q0, q1 = project_on_axes(eye.turn, qx, qy, qz)
        xx, xy, yx, yy = differentiate_rays(eye.rays, places[lane, 0], places[lane, 1])
        ux, vx = scale * (xx * p0 + xy * p1), scale * (xx * q0 + xy * q1)
        uy, vy = scale * (yx * p0 + yy * p1), scale * (yx * q0 + yy * q1)
        columns, rows = np.float32(levels[texture, 0, 1]), np.float32(levels[texture, 0, 2])
        sx, tx = ux * us + vx * vs, ux * ut + vx * vt
        sy, ty = uy * us + vy * vs, uy * ut + vy * vt
        along = (sx * columns) ** 2 + (tx * rows) ** 2
        down = (sy * columns) ** 2 + (ty * rows) ** 2
        if down > along:
            sx, tx = sy, ty
        taps, level, part = plan_taps(max(along, down), min(along, down), levels.shape[1] - 1)
        s, t = uv[a, 0] + u * us + v * vs, uv[a, 1] + u * ut + v * vt
        red, green, blue = filter_texture(levels, texels, texture, s, t, sx, tx, taps, level, part)
        colours[lane, 0] *= red
        colours[lane, 1] *= green
        colours[lane, 2] *= blue


@kernel(inline=True)
def cross(ax, ay, az, bx, by, bz):
    """Return product of two vectors."""
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@kernel(error_model="numpy")
def project_on_axes(turn, x, y, z):
    """Project a vector onto the camera's x and y axes."""
    return (
        turn[0, 0] * x + turn[1, 0] * y + turn[2, 0] * z,
        turn[0, 1] * x + turn[1, 1] * y + turn[2, 1] * z,
    )


@kernel(fastmath=FAST, error_model="numpy")
def plan_taps(longer, shorter, deepest):
    """Plan the filter of a pixel that covers an ellipse of these axes [texels^2].

    Returns the number of taps along the longer axis, the level whose texels are at most as wide as
    a tap, and the share of the next coarser level.
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
def filter_texture(levels, texels, texture, s, t, sx, tx, taps, level, part):
    """Filter a texture around (s, t) by the taps of `plan_taps` along (sx, tx): mean colour.

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


TILE = 4  # A packet is a tile of 4 x 4 pixels
CONTRAST = 6  # Neighbours that differ by less than this [of 255] in every channel show no stairs
CREASE = np.float32(0.9)  # Cosine between normals below which two faces meet in an edge
JUMP = np.float32(0.01)
"""Share of the depth by which a neighbour leaves a face's plane where one thing stands before another."""


class World(NamedTuple):
    """The map as the loops read it."""

    tracer: Tracer
    surface: Surface
    vertices: NDArray[np.float32]  # (V, 3) [m]
    coloured: bool  # Whether corners have colours of their own


class Eye(NamedTuple):
    """Pose and pixel rays of a camera."""

    rays: NDArray[np.float32]
    """(H, W, 2) x and y of rays in the camera with z = 1 through the pixels' centres."""
    turn: NDArray[np.float32]  # (3, 3) map_from_camera's rotation
    origin: NDArray[np.float32]  # (3,) [m, map]
    wanted: NDArray[np.bool_]  # (H / 4, W / 4), rounded up: tiles that are drawn, or (0, 0): all


class Picture(NamedTuple):
    """Images to draw into; made empty (`render.Rendering`), and filled where something is hit."""

    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    objects: NDArray[np.int32]
    triangles: NDArray[np.int32]
    points: NDArray[np.float32]


@kernel(fastmath=FAST, error_model="numpy")
def draw(world, eye, picture, first, last):
    """Fill rows 4 `first` to before 4 `last` of a picture, one ray a pixel, where it is wanted."""
    colour, depth, points = picture.colour, picture.depth, picture.points
    objects, triangles, object_of = picture.objects, picture.triangles, world.surface.object_of
    rays, wanted = eye.rays, eye.wanted
    rows, columns = depth.shape
    packet, ints, valid = new_packet()
    places = np.zeros((LANES, 2), np.int64)
    colours = np.zeros((LANES, 3), np.float32)
    for top in range(TILE * first, min(TILE * last, rows), TILE):
        for left in range(0, columns, TILE):
            if wanted.size > 0 and not wanted[top // TILE, left // TILE]:
                continue
            for lane in range(LANES):
                row, column = top + lane // TILE, left + lane % TILE
                valid[lane] = -1 if row < rows and column < columns else 0
                row, column = min(row, rows - 1), min(column, columns - 1)
                places[lane, 0], places[lane, 1] = row, column
                aim(eye.turn, eye.origin, packet, lane, rays[row, column, 0], rays[row, column, 1])
            trace16(world.tracer, packet, ints, valid)
            shade(world, eye, packet, ints, places, np.float32(1.0), colours)
            for lane in range(LANES):
                triangle = ints[TRIANGLE, lane]
                if triangle < 0:
                    continue
                row, column = places[lane, 0], places[lane, 1]
                far = packet[FAR, lane]
                depth[row, column] = far
                triangles[row, column] = triangle
                objects[row, column] = object_of[triangle]
                for k in range(3):
                    points[row, column, k] = (
                        packet[ORIGIN + k, lane] + far * packet[DIRECTION + k, lane]
                    )
                    colour[row, column, k] = np.uint8(colours[lane, k] + HALF)


@kernel(fastmath=FAST, error_model="numpy")
def smooth(world, eye, picture, colour, offsets, first, last):
    """Draw the edges of rows `first` to before `last` anew into `colour`, as means of several rays.

    `colour`: (H, W, 3) uint8, a copy of the picture's, which stays to say where edges are.
    `offsets`: (S, 2) float32, x and y of the rays in a pixel from its centre [px]; S divides 16.
    """
    columns = picture.depth.shape[1]
    edge = np.empty(columns, np.bool_)
    samples = len(offsets)
    width = ONE / np.sqrt(np.float32(samples))
    packet, ints, valid = new_packet()
    places = np.zeros((LANES, 2), np.int64)
    colours = np.zeros((LANES, 3), np.float32)
    lane = 0
    for row in range(first, last):
        edges(world, picture, row, edge)
        for column in range(columns):
            if not edge[column]:
                continue
            xx, xy, yx, yy = differentiate_rays(eye.rays, row, column)
            for k in range(samples):
                across, down = offsets[k, 0], offsets[k, 1]
                x = eye.rays[row, column, 0] + across * xx + down * yx
                y = eye.rays[row, column, 1] + across * xy + down * yy
                aim(eye.turn, eye.origin, packet, lane, x, y)
                places[lane, 0], places[lane, 1], valid[lane] = row, column, -1
                lane += 1
            if lane == LANES:
                trace16(world.tracer, packet, ints, valid)
                shade(world, eye, packet, ints, places, width, colours)
                mix(ints, places, colours, samples, lane, colour)
                lane = 0
    if lane:
        valid[lane:] = 0
        trace16(world.tracer, packet, ints, valid)
        shade(world, eye, packet, ints, places, width, colours)
        mix(ints, places, colours, samples, lane, colour)


@kernel(fastmath=FAST, error_model="numpy")
def mix(ints, places, colours, samples, lanes, colour):
    """Write the mean colour of every `samples` lanes; rays that hit nothing do not count."""
    for start in range(0, lanes, samples):
        red = green = blue = hits = np.float32(0.0)
        for lane in range(start, start + samples):
            if ints[TRIANGLE, lane] >= 0:
                red += colours[lane, 0]
                green += colours[lane, 1]
                blue += colours[lane, 2]
                hits += ONE
        if hits > 0:
            row, column = places[start, 0], places[start, 1]
            colour[row, column, 0] = np.uint8(red / hits + HALF)
            colour[row, column, 1] = np.uint8(green / hits + HALF)
            colour[row, column, 2] = np.uint8(blue / hits + HALF)


@kernel(error_model="numpy")
def aim(turn, origin, packet, slot, x, y):
    """Fill a lane with the ray (x, y, 1) of the camera: distances along it are depths."""
    for k in range(3):
        packet[ORIGIN + k, slot] = origin[k]
        packet[DIRECTION + k, slot] = turn[k, 0] * x + turn[k, 1] * y + turn[k, 2]
    packet[FAR, slot] = np.inf


# ------------------------------------------------------------------------------------- edges


@kernel(error_model="numpy")
def edges(world, picture, row, edge):
    """Mark the pixels (W,) of a row at edges whose stairs can be seen."""
    triangles, objects, colour = picture.triangles, picture.objects, picture.colour
    points, depth, texture_of = picture.points, picture.depth, world.surface.texture_of
    corners, at = world.surface.triangles, world.vertices
    rows, columns = triangles.shape
    for column in range(columns):
        edge[column] = False
        one = triangles[row, column]
        if one < 0:
            continue
        for side in range(4):
            i = row + (side == 1) - (side == 3)
            j = column + (side == 0) - (side == 2)
            if i < 0 or j < 0 or i >= rows or j >= columns:
                continue
            other = triangles[i, j]
            if other == one or other < 0 or not contrast(colour, row, column, i, j):
                continue
            if objects[row, column] == objects[i, j] and texture_of[one] == texture_of[other]:
                x, y, z = normal(corners, at, one)
                p, q, r = normal(corners, at, other)
                gap = x * (points[i, j, 0] - points[row, column, 0])
                gap += y * (points[i, j, 1] - points[row, column, 1])
                gap += z * (points[i, j, 2] - points[row, column, 2])
                jumps = abs(gap) > JUMP * depth[row, column]
                if not jumps and abs(x * p + y * q + z * r) >= CREASE:
                    continue
            edge[column] = True
            break


@kernel(error_model="numpy")
def contrast(colour, row, column, i, j):
    """Return whether two pixels differ enough for stairs to be seen."""
    red = abs(int(colour[row, column, 0]) - int(colour[i, j, 0]))
    green = abs(int(colour[row, column, 1]) - int(colour[i, j, 1]))
    blue = abs(int(colour[row, column, 2]) - int(colour[i, j, 2]))
    return max(red, green, blue) >= CONTRAST


@kernel(error_model="numpy")
def normal(triangles, at, triangle):
    """Return unit normal (3 floats) of a triangle; zero where it has no area."""
    a, b, c = triangles[triangle, 0], triangles[triangle, 1], triangles[triangle, 2]
    x, y, z = cross(
        at[b, 0] - at[a, 0], at[b, 1] - at[a, 1], at[b, 2] - at[a, 2],
        at[c, 0] - at[a, 0], at[c, 1] - at[a, 1], at[c, 2] - at[a, 2],
    )  # fmt: skip
    length = np.sqrt(x * x + y * y + z * z)
    scale = ONE / length if length > 0 else np.float32(0.0)
    return x * scale, y * scale, z * scale
