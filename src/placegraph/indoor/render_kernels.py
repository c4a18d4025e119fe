"""Compiled loops of `render`: rays, hits, texels, and more rays where edges are.

A ray's `u` and `v` are the weights of a triangle's corners 1 and 2. How far they move from one pixel
to the next follows from the ray's own equation, so that the texels a pixel covers are known on every
slope: o + t d = a + u e1 + v e2, differentiated along the image (Igehy 1999, ray differentials).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from placegraph.indoor.raycast.packets import (
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
from placegraph.indoor.surface import Surface  # noqa: TC001  # mypy reads the fields

if TYPE_CHECKING:
    from numpy.typing import NDArray

TILE = 4
"""A packet is a tile of 4 x 4 pixels."""
MOST_TAPS = np.float32(8.0)
"""Looks at the texture along the longer side of what a pixel covers."""
SHARP = np.float32(1.05)
"""Texels a pixel: up to here a surface is seen at its finest level."""
CONTRAST = 6
"""Neighbours that differ by less than this [of 255] in every channel show no stairs."""
CREASE = np.float32(0.9)
"""Cosine between normals below which two faces meet in an edge."""
JUMP = np.float32(0.01)
"""Share of the depth by which a neighbour leaves a face's plane where one thing stands before another."""

# without the flags that take away NaN and infinity: grazing rays meet both
_FAST = {"nsz", "arcp", "contract", "afn", "reassoc"}


class World(NamedTuple):
    """The map as the loops read it."""

    tracer: Tracer
    surface: Surface
    vertices: NDArray[np.float32]
    """(V, 3) [m]"""
    coloured: bool
    """Whether corners have colours of their own."""


class Eye(NamedTuple):
    """Where the camera is and where its pixels look."""

    rays: NDArray[np.float32]
    """(H, W, 2) x and y of rays in the camera with z = 1 through the pixels' centres."""
    turn: NDArray[np.float32]
    """(3, 3) map_from_camera's rotation."""
    origin: NDArray[np.float32]
    """(3,) [m, map]"""


class Picture(NamedTuple):
    """What is drawn; made empty (`render.Rendering`), and filled where something is hit."""

    colour: NDArray[np.uint8]
    depth: NDArray[np.float32]
    objects: NDArray[np.int32]
    triangles: NDArray[np.int32]
    points: NDArray[np.float32]


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def draw(world, eye, picture, first, last):
    """Fill rows 4 `first` to before 4 `last` of a picture, one ray a pixel."""
    rows, columns = picture.depth.shape
    packet, ints, valid = new_packet()
    for top in range(TILE * first, min(TILE * last, rows), TILE):
        for left in range(0, columns, TILE):
            for lane in range(LANES):
                row, column = top + lane // TILE, left + lane % TILE
                inside = row < rows and column < columns
                valid[lane] = -1 if inside else 0
                row, column = min(row, rows - 1), min(column, columns - 1)
                ray = eye.rays[row, column]
                _aim(packet, lane, eye, ray[0], ray[1])
            trace16(world.tracer, packet, ints, valid)
            for lane in range(LANES):
                triangle = ints[TRIANGLE, lane]
                if valid[lane] == 0 or triangle < 0:
                    continue
                row, column = top + lane // TILE, left + lane % TILE
                far = packet[FAR, lane]
                picture.depth[row, column] = far
                picture.triangles[row, column] = triangle
                picture.objects[row, column] = world.surface.object_of[triangle]
                for k in range(3):
                    point = packet[ORIGIN + k, lane] + far * packet[DIRECTION + k, lane]
                    picture.points[row, column, k] = point
                colour = _colour(world, eye, packet, ints, lane, row, column, np.float32(1.0))
                for k in range(3):
                    picture.colour[row, column, k] = np.uint8(colour[k] + np.float32(0.5))


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def smooth(world, eye, picture, colour, offsets, first, last):
    """Draw the edges of rows `first` to before `last` anew into `colour`, as means of several rays.

    `colour`: (H, W, 3) uint8, a copy of the picture's, which stays to say where edges are.
    `offsets`: (S, 2) float32, x and y of the rays in a pixel from its centre [px]; S divides 16.
    """
    columns = picture.depth.shape[1]
    samples = len(offsets)
    room = LANES // samples
    places = np.empty((room, 2), np.int64)
    packet, ints, valid = new_packet()
    waiting = 0
    for row in range(first, last):
        for column in range(columns):
            if _on_edge(world, picture, row, column):
                places[waiting] = row, column
                waiting += 1
                if waiting == room:
                    _mean(world, eye, colour, offsets, places, waiting, packet, ints, valid)
                    waiting = 0
    if waiting:
        _mean(world, eye, colour, offsets, places, waiting, packet, ints, valid)


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _mean(world, eye, colour, offsets, places, number, packet, ints, valid):
    """Mean colours of `number` pixels; rays that hit nothing do not count."""
    samples = len(offsets)
    for lane in range(LANES):
        which = lane // samples
        valid[lane] = -1 if which < number else 0
        row, column = places[min(which, number - 1)]
        shift = offsets[lane % samples]
        ray = eye.rays[row, column]
        (xx, xy), (yx, yy) = _steps(eye, row, column)
        x = ray[0] + shift[0] * xx + shift[1] * yx
        y = ray[1] + shift[0] * xy + shift[1] * yy
        _aim(packet, lane, eye, x, y)
    trace16(world.tracer, packet, ints, valid)
    width = np.float32(1.0) / np.sqrt(np.float32(samples))
    for which in range(number):
        row, column = places[which]
        red = green = blue = hits = np.float32(0.0)
        for lane in range(which * samples, (which + 1) * samples):
            if ints[TRIANGLE, lane] >= 0:
                r, g, b = _colour(world, eye, packet, ints, lane, row, column, width)
                red, green, blue = red + r, green + g, blue + b
                hits += np.float32(1.0)
        if hits > 0:
            half = np.float32(0.5)
            colour[row, column, 0] = np.uint8(red / hits + half)
            colour[row, column, 1] = np.uint8(green / hits + half)
            colour[row, column, 2] = np.uint8(blue / hits + half)


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _aim(packet, lane, eye, x, y):
    """Fill a lane with the ray (x, y, 1) of the camera: distances along it are depths."""
    for k in range(3):
        packet[ORIGIN + k, lane] = eye.origin[k]
        packet[DIRECTION + k, lane] = eye.turn[k, 0] * x + eye.turn[k, 1] * y + eye.turn[k, 2]
    packet[FAR, lane] = np.inf


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _steps(eye, row, column):
    """How a ray's x and y change from one pixel to the next, along the row and down the column."""
    rows, columns = eye.rays.shape[:2]
    right, down = min(column + 1, columns - 1), min(row + 1, rows - 1)
    left, up = max(right - 1, 0), max(down - 1, 0)
    a, b = eye.rays[row, right], eye.rays[row, left]
    c, d = eye.rays[down, column], eye.rays[up, column]
    return (a[0] - b[0], a[1] - b[1]), (c[0] - d[0], c[1] - d[1])


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _colour(world, eye, packet, ints, lane, row, column, width):
    """Colour (3 floats, 0 to 255) that a lane has hit; it stands for `width` of a pixel."""
    surface, triangle = world.surface, ints[TRIANGLE, lane]
    a, b, c = surface.triangles[triangle]
    u, v = packet[U, lane], packet[V, lane]
    w = np.float32(1.0) - u - v
    red = green = blue = np.float32(1.0)
    if world.coloured:
        share = np.float32(1.0 / 255.0)
        p, q, r = surface.colours[a], surface.colours[b], surface.colours[c]
        red = (w * p[0] + u * q[0] + v * r[0]) * share
        green = (w * p[1] + u * q[1] + v * r[1]) * share
        blue = (w * p[2] + u * q[2] + v * r[2]) * share
    levels = surface.levels[surface.texture_of[triangle]]
    if levels[0, 1] * levels[0, 2] == 1:
        texel = surface.texels[levels[0, 0]]
        return red * texel[0], green * texel[1], blue * texel[2]
    p, q, r = surface.uv[a], surface.uv[b], surface.uv[c]
    s, t = w * p[0] + u * q[0] + v * r[0], w * p[1] + u * q[1] + v * r[1]
    (ux, vx), (uy, vy) = _weights(world, eye, packet, lane, a, b, c, row, column, width)
    sx, tx = ux * (q[0] - p[0]) + vx * (r[0] - p[0]), ux * (q[1] - p[1]) + vx * (r[1] - p[1])
    sy, ty = uy * (q[0] - p[0]) + vy * (r[0] - p[0]), uy * (q[1] - p[1]) + vy * (r[1] - p[1])
    x, y, z = _filtered(surface.texels, levels, s, t, sx, tx, sy, ty)
    return red * x, green * y, blue * z


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _weights(world, eye, packet, lane, a, b, c, row, column, width):
    """How u and v change over `width` of a pixel, along the row and down the column."""
    va, vb, vc = world.vertices[a], world.vertices[b], world.vertices[c]
    ex, ey, ez = vb[0] - va[0], vb[1] - va[1], vb[2] - va[2]
    fx, fy, fz = vc[0] - va[0], vc[1] - va[1], vc[2] - va[2]
    dx, dy, dz = packet[DIRECTION, lane], packet[DIRECTION + 1, lane], packet[DIRECTION + 2, lane]
    # p = e2 x d, q = d x e1: du = t ddx . p / (e1 . p), dv = t ddx . q / (e1 . p)
    px, py, pz = fy * dz - fz * dy, fz * dx - fx * dz, fx * dy - fy * dx
    qx, qy, qz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
    scale = width * packet[FAR, lane] / (ex * px + ey * py + ez * pz)
    (xx, xy), (yx, yy) = _steps(eye, row, column)
    turn = eye.turn
    # of the camera's x and y axes
    p0 = turn[0, 0] * px + turn[1, 0] * py + turn[2, 0] * pz
    p1 = turn[0, 1] * px + turn[1, 1] * py + turn[2, 1] * pz
    q0 = turn[0, 0] * qx + turn[1, 0] * qy + turn[2, 0] * qz
    q1 = turn[0, 1] * qx + turn[1, 1] * qy + turn[2, 1] * qz
    along = scale * (xx * p0 + xy * p1), scale * (xx * q0 + xy * q1)
    down = scale * (yx * p0 + yy * p1), scale * (yx * q0 + yy * q1)
    return along, down


@njit(cache=True, nogil=True, fastmath=_FAST, error_model="numpy")
def _filtered(texels, levels, s, t, sx, tx, sy, ty):
    """Mean colour (3 floats) of what a pixel covers of a texture.

    It covers about the ellipse of (sx, tx) and (sy, ty) at (s, t), in texture coordinates: several
    looks along its longer axis, each at the level, between two levels, whose texels are as wide as a
    look's share.
    """
    columns, rows = np.float32(levels[0, 1]), np.float32(levels[0, 2])
    along = np.sqrt((sx * columns) ** 2 + (tx * rows) ** 2)
    down = np.sqrt((sy * columns) ** 2 + (ty * rows) ** 2)
    longer, shorter = max(along, down), min(along, down)
    if not longer > SHARP:
        return _between(texels, levels, 0, s, t)
    if not longer < np.float32(1e6):  # along the surface: everything at once
        return _between(texels, levels, len(levels) - 1, s, t)
    if down > along:
        sx, tx = sy, ty
    taps = min(np.ceil(longer / max(shorter, np.float32(1.0)) - np.float32(0.25)), MOST_TAPS)
    fine = max(np.log2(longer / taps), np.float32(0.0))
    level = min(int(fine), len(levels) - 1)
    part = fine - np.float32(level)
    red = green = blue = np.float32(0.0)
    for tap in range(int(taps)):
        at = (np.float32(tap) + np.float32(0.5)) / taps - np.float32(0.5)
        x, y = s + at * sx, t + at * tx
        r, g, b = _between(texels, levels, level, x, y)
        if part > np.float32(0.05) and level + 1 < len(levels):
            r1, g1, b1 = _between(texels, levels, level + 1, x, y)
            r, g, b = r + part * (r1 - r), g + part * (g1 - g), b + part * (b1 - b)
        red, green, blue = red + r, green + g, blue + b
    return red / taps, green / taps, blue / taps


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _between(texels, levels, level, s, t):
    """Colour (3 floats) between the four texels of a level around (s, t), repeated beyond [0, 1)."""
    start, columns, rows = levels[level]
    half = np.float32(0.5)
    x = (s - np.floor(s)) * np.float32(columns) - half
    y = (t - np.floor(t)) * np.float32(rows) - half
    left, top = int(np.floor(x)), int(np.floor(y))
    x, y = x - np.float32(left), y - np.float32(top)
    right = left + 1 if left + 1 < columns else 0
    bottom = top + 1 if top + 1 < rows else 0
    left = left if left >= 0 else columns - 1
    top = top if top >= 0 else rows - 1
    a, b = texels[start + top * columns + left], texels[start + top * columns + right]
    c, d = texels[start + bottom * columns + left], texels[start + bottom * columns + right]
    one = np.float32(1.0)
    wa, wb, wc, wd = (one - x) * (one - y), x * (one - y), (one - x) * y, x * y
    return (
        wa * a[0] + wb * b[0] + wc * c[0] + wd * d[0],
        wa * a[1] + wb * b[1] + wc * c[1] + wd * d[1],
        wa * a[2] + wb * b[2] + wc * c[2] + wd * d[2],
    )


# ------------------------------------------------------------------------------------- edges


@njit(cache=True, nogil=True, error_model="numpy")
def _on_edge(world, picture, row, column):
    """Whether a pixel lies at an edge whose stairs can be seen."""
    if picture.triangles[row, column] < 0:
        return False
    rows, columns = picture.depth.shape
    return (
        (column + 1 < columns and _edge(world, picture, row, column, row, column + 1))
        or (row + 1 < rows and _edge(world, picture, row, column, row + 1, column))
        or (column > 0 and _edge(world, picture, row, column, row, column - 1))
        or (row > 0 and _edge(world, picture, row, column, row - 1, column))
    )


@njit(cache=True, nogil=True, inline="always", error_model="numpy")
def _edge(world, picture, row, column, i, j):
    """Whether an edge that can be seen runs between two pixels."""
    one, other = picture.triangles[row, column], picture.triangles[i, j]
    if one == other or other < 0:
        return False
    contrast = False
    for k in range(3):
        contrast |= (
            abs(int(picture.colour[row, column, k]) - int(picture.colour[i, j, k])) >= CONTRAST
        )
    if not contrast:
        return False
    surface = world.surface
    if picture.objects[row, column] != picture.objects[i, j]:
        return True
    if surface.texture_of[one] != surface.texture_of[other]:
        return True
    x, y, z = _normal(world, one)
    p, q, r = _normal(world, other)
    a, b = picture.points[row, column], picture.points[i, j]
    gap = x * (b[0] - a[0]) + y * (b[1] - a[1]) + z * (b[2] - a[2])
    jumps = abs(gap) > JUMP * picture.depth[row, column]
    return jumps or abs(x * p + y * q + z * r) < CREASE


@njit(cache=True, nogil=True, error_model="numpy")
def _normal(world, triangle):
    """Unit normal (3 floats) of a triangle; zero where it has no area."""
    a, b, c = world.surface.triangles[triangle]
    va, vb, vc = world.vertices[a], world.vertices[b], world.vertices[c]
    ex, ey, ez = vb[0] - va[0], vb[1] - va[1], vb[2] - va[2]
    fx, fy, fz = vc[0] - va[0], vc[1] - va[1], vc[2] - va[2]
    x, y, z = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    length = np.sqrt(x * x + y * y + z * z)
    scale = np.float32(1.0) / length if length > 0 else np.float32(0.0)
    return x * scale, y * scale, z * scale
