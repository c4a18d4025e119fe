# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops that find where frames see a point, and what colour they give it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.indoor.map.map_kernels import sample_colour

BEST = 5  # Views of a texel that are compared; those that agree are mixed
OBSERVED = 12  # Views of a point that take part in solving for the frames' exposures
GRAZING = 0.17  # Cosine between ray and normal below which a view shows nothing
SPREAD = 20.0  # Difference from the median [of 255] at which a view counts for little
RUN = 8  # Points in a row, mostly neighbours, for which views are looked up together
BORDER = 24.0  # A view counts fully from this far inside the image on [px]


class Keyframes(NamedTuple):
    """K images with their poses, ready to be looked up."""

    camera_from_map: NDArray[np.float64]  # (K, 3, 4)
    centres: NDArray[np.float64]  # (K, 3) of the cameras [m, map]
    pinholes: NDArray[np.float64]  # (K, 4) fx, fy, cx, cy [px]
    levels: tuple[NDArray[np.uint8], ...]  # (K, H, W, 3) sRGB, and its half, quarter and eighth
    bounds: NDArray[np.float32]
    """(K, 2, h, w) least and greatest depth around each pixel [m]; inf: nothing there."""
    weights: NDArray[np.float32]
    """(K, h, w) 1, or less where the frame has no depth but should: what is there is not known."""
    gains: NDArray[np.float32]  # (K, 3) what the colours are multiplied by


@kernel(error_model="numpy", _nrt=False)
def _observe_point(views, k, point, normal, least):
    """Observe a point in view k: x, y [px], depth [m], weight; 0: not seen, or `least` at most."""
    dx = views.centres[k, 0] - point[0]
    dy = views.centres[k, 1] - point[1]
    dz = views.centres[k, 2] - point[2]
    distance = np.sqrt(dx * dx + dy * dy + dz * dz)
    cosine = normal[0] * dx + normal[1] * dy + normal[2] * dz
    if cosine < GRAZING * distance or distance < 0.1:
        return 0.0, 0.0, 0.0, 0.0
    pose = views.camera_from_map[k]
    z = pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3]
    if z < 0.1:
        return 0.0, 0.0, 0.0, 0.0
    facing = cosine / distance
    most = facing * np.sqrt(facing) / (z * z + 0.25)
    if most <= least:
        return 0.0, 0.0, 0.0, 0.0
    x = pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3]
    y = pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3]
    x = views.pinholes[k, 0] * x / z + views.pinholes[k, 2]
    y = views.pinholes[k, 1] * y / z + views.pinholes[k, 3]
    rows, columns = views.levels[0].shape[1], views.levels[0].shape[2]
    border = min(x, columns - x, y, rows - y)
    if not border > 2.0:
        return 0.0, 0.0, 0.0, 0.0
    row = int(y * views.bounds.shape[2] / rows)
    column = int(x * views.bounds.shape[3] / columns)
    near, far = views.bounds[k, 0, row, column], views.bounds[k, 1, row, column]
    slack = 0.03 + 0.02 * z
    # something stands before the point, or the view looks right through it
    if z > near + slack or (z < near - 2.0 * slack and np.isfinite(near)):
        return 0.0, 0.0, 0.0, 0.0
    worth = most * min(border / BORDER, 1.0) * views.weights[k, row, column]
    if far > z + 2.0 * slack:  # at the edge of something: a small error of the pose shows
        worth *= 0.2
    return x, y, z, worth


@kernel(error_model="numpy", _nrt=False)
def _sample_view(views, k, level, x, y):
    """Sample colour (3 floats, 0 to 255) of view k at (x, y) [px of level 0], between its pixels."""
    image = views.levels[level]
    rows, columns = image.shape[1], image.shape[2]
    x = x * columns / views.levels[0].shape[2] - 0.5
    y = y * rows / views.levels[0].shape[1] - 0.5
    x, y = min(max(x, 0.0), columns - 1.001), min(max(y, 0.0), rows - 1.001)
    j, i = int(x), int(y)
    s, t = x - j, y - i
    a, b, c, d = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    q, r = min(j + 1, columns - 1), min(i + 1, rows - 1)
    red = a * image[k, i, j, 0] + b * image[k, i, q, 0] + c * image[k, r, j, 0]
    green = a * image[k, i, j, 1] + b * image[k, i, q, 1] + c * image[k, r, j, 1]
    blue = a * image[k, i, j, 2] + b * image[k, i, q, 2] + c * image[k, r, j, 2]
    return (
        red + d * image[k, r, q, 0],
        green + d * image[k, r, q, 1],
        blue + d * image[k, r, q, 2],
    )


@kernel(error_model="numpy", _nrt=False)
def _choose_level(views, k, z, texel):
    """Level of the images whose pixels are about as wide as a texel at depth z."""
    pixels = texel * views.pinholes[k, 0] / z
    level = 0
    while pixels > 1.5 and level < len(views.levels) - 1:
        pixels *= 0.5
        level += 1
    return level


@kernel(error_model="numpy", _nrt=False)
def _find_candidates(views, points, first, last, candidates):
    """Fill `candidates` with the views that may see any of the points `first` to `last`; how many."""
    middle_x, middle_y, middle_z, spread = 0.0, 0.0, 0.0, 0.0
    for i in range(first, last):
        middle_x += points[i, 0] / (last - first)
        middle_y += points[i, 1] / (last - first)
        middle_z += points[i, 2] / (last - first)
    for i in range(first, last):
        square = (points[i, 0] - middle_x) ** 2 + (points[i, 1] - middle_y) ** 2
        spread = max(spread, np.sqrt(square + (points[i, 2] - middle_z) ** 2))
    count = 0
    rows, columns = views.levels[0].shape[1], views.levels[0].shape[2]
    for k in range(len(views.centres)):
        pose, pinhole = views.camera_from_map[k], views.pinholes[k]
        x = pose[0, 0] * middle_x + pose[0, 1] * middle_y + pose[0, 2] * middle_z + pose[0, 3]
        y = pose[1, 0] * middle_x + pose[1, 1] * middle_y + pose[1, 2] * middle_z + pose[1, 3]
        z = pose[2, 0] * middle_x + pose[2, 1] * middle_y + pose[2, 2] * middle_z + pose[2, 3]
        # the sphere against the four planes through the image's sides
        left, right = pinhole[2], columns - pinhole[2]
        top, bottom = pinhole[3], rows - pinhole[3]
        if (
            z > -spread
            and -pinhole[0] * x - left * z < spread * np.sqrt(pinhole[0] ** 2 + left**2)
            and pinhole[0] * x - right * z < spread * np.sqrt(pinhole[0] ** 2 + right**2)
            and -pinhole[1] * y - top * z < spread * np.sqrt(pinhole[1] ** 2 + top**2)
            and pinhole[1] * y - bottom * z < spread * np.sqrt(pinhole[1] ** 2 + bottom**2)
        ):
            candidates[count] = k
            count += 1
    return count


@kernel(error_model="numpy", _nrt=False)
def _best(views, candidates, point, normal, rows, places):
    """Fill rows (M,) and places (M, 4: x, y, z, worth) with the best views; returns how many."""
    most, count = len(rows), 0
    for k in candidates:
        least = places[most - 1, 3] if count == most else 0.0
        x, y, z, worth = _observe_point(views, k, point, normal, least)
        if worth <= least:
            continue
        if count < most:
            count += 1
        at = count - 1
        while at > 0 and places[at - 1, 3] < worth:
            rows[at] = rows[at - 1]
            for column in range(4):
                places[at, column] = places[at - 1, column]
            at -= 1
        rows[at] = k
        places[at, 0], places[at, 1], places[at, 2], places[at, 3] = x, y, z, worth
    return count


@kernel(error_model="numpy")
def observe_points(views, points, normals, texel, rows, colours, first, last):
    """Fill what the best views of points (N,) show: rows (N, M), -1: none; colours (N, M, 3)."""
    every = np.arange(len(views.centres))
    for i in range(first, last):
        places = np.zeros((rows.shape[1], 4))
        count = _best(views, every, points[i], normals[i], rows[i], places)
        for m in range(count):
            k = rows[i, m]
            level = _choose_level(views, k, places[m, 2], texel)
            red, green, blue = _sample_view(views, k, level, places[m, 0], places[m, 1])
            colours[i, m, 0], colours[i, m, 1], colours[i, m, 2] = red, green, blue


@kernel(error_model="numpy", _nrt=False)
def _median(values, count, column, ascending):
    """Return median of the first `count` of a column of values (M, C); `ascending` (M,) is overwritten."""
    for m in range(count):
        at = m
        while at > 0 and ascending[at - 1] > values[m, column]:
            ascending[at] = ascending[at - 1]
            at -= 1
        ascending[at] = values[m, column]
    return 0.5 * (ascending[(count - 1) // 2] + ascending[count // 2])


@kernel(error_model="numpy")
def mix_views(views, points, normals, texel, out, valid, first, last):
    """Fill colours (N, 3) of points (N, 3) with normals (N, 3), and whether any view shows them."""
    candidates, number = np.empty(len(views.centres), np.int64), 0
    rows, places = np.empty(BEST, np.int64), np.zeros((BEST, 4))
    colours, weights = np.empty((BEST, 3)), np.empty(BEST)
    middle, mean, ascending = np.empty(3), np.empty(3), np.empty(BEST)
    for i in range(first, last):
        if (i - first) % RUN == 0:
            number = _find_candidates(views, points, i, min(i + RUN, last), candidates)
        count = _best(views, candidates[:number], points[i], normals[i], rows, places)
        if count == 0:
            continue
        valid[i] = True
        for m in range(count):
            k = rows[m]
            level = _choose_level(views, k, places[m, 2], texel)
            sample = _sample_view(views, k, level, places[m, 0], places[m, 1])
            # too bright or too dark for this exposure
            fair = (
                max(sample[0], sample[1], sample[2]) < 250
                and max(sample[0], sample[1], sample[2]) > 8
            )
            weights[m] = (places[m, 3] / places[0, 3]) ** 2 * (1.0 if fair else 0.05)
            for c in range(3):
                colours[m, c] = min(sample[c] * views.gains[k, c], 255.0)
        for c in range(3):
            middle[c] = _median(colours, count, c, ascending)
        total, mean[:] = 0.0, 0.0
        for m in range(count):
            off = 0.0
            for c in range(3):
                off += (colours[m, c] - middle[c]) ** 2
            weight = weights[m] * np.exp(-0.5 * off / SPREAD**2) + 1e-6
            total += weight
            for c in range(3):
                mean[c] += weight * colours[m, c]
        for c in range(3):
            out[i, c] = np.uint8(mean[c] / total + 0.5)


@kernel(error_model="numpy")
def add_gain_equations(rows, logs, weights, matrix, right):
    """Add the normal equations of the views' exposures to matrix (K, K) and right (K,).

    Point i has an unknown shade s and view k an unknown exposure e, both logarithms: logs[i, m] =
    s_i + e_k for k = rows[i, m]. The shades are eliminated. `weights` (N, M): 0 leaves one out.
    """
    for i in range(len(rows)):
        total, mean = 0.0, 0.0
        for m in range(rows.shape[1]):
            total += weights[i, m]
            mean += weights[i, m] * logs[i, m]
        if total <= 0:
            continue
        mean /= total
        for m in range(rows.shape[1]):
            if weights[i, m] == 0:
                continue
            k = rows[i, m]
            right[k] += weights[i, m] * (logs[i, m] - mean)
            matrix[k, k] += weights[i, m]
            for n in range(rows.shape[1]):
                if weights[i, n] != 0:
                    matrix[k, rows[i, n]] -= weights[i, m] * weights[i, n] / total


@kernel(error_model="numpy")
def bound_depth(depth):
    """Return the least and greatest depth (2, h, w) of 3 x 3 pixels; `depth` (h, w), inf: none."""
    rows, columns = depth.shape
    out = np.empty((2, rows, columns), np.float32)
    for i in range(rows):
        for j in range(columns):
            near, far = np.inf, -np.inf
            for p in range(max(i - 1, 0), min(i + 2, rows)):
                for q in range(max(j - 1, 0), min(j + 2, columns)):
                    near, far = min(near, depth[p, q]), max(far, depth[p, q])
            out[0, i, j], out[1, i, j] = near, far
    return out


@kernel(error_model="numpy")
def sample_colours(surface, triangle, u, v, footprint, out, first, last):
    """Fill colours (N, 3) uint8 at barycentrics of triangles (N,), where that is not -1.

    `footprint`: width over which textures are averaged [m].
    """
    for i in range(first, last):
        if triangle[i] >= 0:
            red, green, blue = sample_colour(surface, triangle[i], u[i], v[i], footprint)
            out[i, 0] = np.uint8(min(max(255.0 * red + 0.5, 0.0), 255.0))
            out[i, 1] = np.uint8(min(max(255.0 * green + 0.5, 0.0), 255.0))
            out[i, 2] = np.uint8(min(max(255.0 * blue + 0.5, 0.0), 255.0))
