# mypy: allow-untyped-defs, allow-incomplete-defs
"""Compiled loops over depth images: what surface each reading shows, and which to believe."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.core.threads import share
from placegraph.indoor.mapping.fuse.volume_kernels import NEAR

FLAT = 0.1
"""Least cosine of the angle at which a reading's surface is looked at."""


def facets_of(depth, eye, reach, edges):
    """Plane, reading and weight of every pixel (h, w, 6) float32.

    Columns 0 to 2: unit normal n in the camera, away from it; 3: n @ x of the plane's points x, so
    that column 3 - n @ p is how far a point p lies in front; 4: the reading [m], 0: none, or not to be
    believed; 5: weight, cosine / reading^4. `depth`: (h, w) float32 [m], NaN: none; `eye`: fx, fy,
    cx, cy; `reach`: greatest reading used [m]; `edges`: whether readings at depth edges are dropped.

    Planes are linear in the image if written for 1 / depth: slopes are a least-squares fit over
    readings that are near in depth, every second of 5 x 5.
    """
    out = np.zeros((*depth.shape, 6), np.float32)
    share(_facets_of, len(out), depth, eye, reach, edges, out)
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
                z = between(depth, v, u)
            if not (NEAR <= z <= reach):
                continue
            here = 1.0 / z
            allowed = (0.01 + 0.011 * z * z) * here * here  # of noise, at this depth
            if edges and read and torn(depth, v, u, here, allowed):
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


@kernel(error_model="numpy")
def between(depth, v, u):
    """Reading between two that agree, left and right or above and below, up to 4 pixels apart; or 0.

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


@kernel(error_model="numpy")
def torn(depth, v, u, here, allowed):
    """Whether a reading stands at a depth edge, where it may be a mean of both sides."""
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
def farthest(facets, tile):
    """Greatest reading of every tile (h / tile, w / tile) of `tile`^2 pixels, 0: none."""
    h, w = facets.shape[:2]
    out = np.zeros(((h + tile - 1) // tile, (w + tile - 1) // tile), np.float32)
    for v in range(h):
        for u in range(w):
            out[v // tile, u // tile] = max(out[v // tile, u // tile], facets[v, u, 4])
    return out


@kernel(error_model="numpy")
def visible(places, count, edge, far, tile, eye, shape, pose, band):
    """Rows of the blocks that a view may see, ascending.

    `far`: of `farthest`; `shape`: height and width [px]; `pose`: (4, 4) camera_from_map.
    """
    found = np.empty(count, np.int32)
    n = 0
    radius = 0.5 * np.sqrt(3.0) * edge
    for row in range(count):
        px, py, pz = (
            (places[row, 0] + 0.5) * edge,
            (places[row, 1] + 0.5) * edge,
            (places[row, 2] + 0.5) * edge,
        )
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        if z < -radius:
            continue
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        left, right, top, low = 0.0, shape[1] - 1.0, 0.0, shape[0] - 1.0
        front = z - radius
        if front > NEAR:  # bounds of the sphere's picture, on the safe side
            left = eye[0] * min((x - radius) / front, (x - radius) / (z + radius)) + eye[2]
            right = eye[0] * max((x + radius) / front, (x + radius) / (z + radius)) + eye[2]
            top = eye[1] * min((y - radius) / front, (y - radius) / (z + radius)) + eye[3]
            low = eye[1] * max((y + radius) / front, (y + radius) / (z + radius)) + eye[3]
            if right < 0 or low < 0 or left >= shape[1] or top >= shape[0]:
                continue
        a, b = int(max(left, 0.0)) // tile, int(min(right, shape[1] - 1.0)) // tile
        c, d = int(max(top, 0.0)) // tile, int(min(low, shape[0] - 1.0)) // tile
        deepest = np.float32(0)
        for i in range(c, d + 1):
            for j in range(a, b + 1):
                deepest = max(deepest, far[i, j])
        if deepest > 0 and front < deepest + band:
            found[n] = row
            n += 1
    return found[:n]
