"""Compiled loops of the signed distance volume; see `tsdf`."""

from __future__ import annotations

import numpy as np
from numba import njit, prange


@njit(cache=True, parallel=True)
def integrate(
    distance, weight, colour, paint, origin, voxel, truncation, depth, image, eyes, pose, reach
):
    """Take one view into the volume, in place.

    `distance`, `weight`: (X, Y, Z) float32 signed distance [m] and its weight; `colour`:
    (X, Y, Z, 3) float32 and `paint`: (X, Y, Z) float32 its weight; `origin`: (3,) centre of voxel
    0 [m]; `depth`: (h, w) float32 [m], NaN where there is none; `image`: (H, W, 3) uint8; `eyes`:
    (2, 4) fx, fy, cx, cy of the depth and of the colour camera; `pose`: (4, 4) camera_from_map;
    `reach`: greatest depth that is used [m].
    """
    nx, ny, nz = distance.shape
    h, w = depth.shape
    tall, wide = image.shape[:2]
    for ix in prange(nx):
        px = origin[0] + ix * voxel
        for iy in range(ny):
            py = origin[1] + iy * voxel
            x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * origin[2] + pose[0, 3]
            y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * origin[2] + pose[1, 3]
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * origin[2] + pose[2, 3]
            for iz in range(nz):
                up = iz * voxel
                cz = z + up * pose[2, 2]
                if cz < 0.2 or cz > reach + truncation:
                    continue
                a, b = (x + up * pose[0, 2]) / cz, (y + up * pose[1, 2]) / cz
                u, v = eyes[0, 0] * a + eyes[0, 2], eyes[0, 1] * b + eyes[0, 3]
                if u < 0 or v < 0 or u >= w or v >= h:
                    continue
                seen = depth[int(v), int(u)]
                if not seen <= reach:  # also NaN
                    continue
                gap = (seen - cz) * np.sqrt(1.0 + a * a + b * b)  # along the ray, in front > 0
                if gap < -truncation:
                    continue
                new = 1.0 / (seen * seen)  # the noise of depth grows with its square
                weight[ix, iy, iz] += new
                share = new / weight[ix, iy, iz]
                distance[ix, iy, iz] += share * (min(gap, truncation) - distance[ix, iy, iz])
                u, v = eyes[1, 0] * a + eyes[1, 2], eyes[1, 1] * b + eyes[1, 3]
                if gap > truncation or u < 0 or v < 0 or u >= wide or v >= tall:
                    continue
                paint[ix, iy, iz] += new
                share = new / paint[ix, iy, iz]
                for k in range(3):
                    value = np.float32(image[int(v), int(u), k])
                    colour[ix, iy, iz, k] += share * (value - colour[ix, iy, iz, k])


@njit(cache=True)
def blend(colour, paint, points):
    """Colours (N, 3) uint8 at points (N, 3) [voxels], of the painted ones of eight voxels."""
    out = np.zeros((len(points), 3), np.uint8)
    for i in range(len(points)):
        total = 0.0
        mix = np.zeros(3)
        x, y, z = int(points[i, 0]), int(points[i, 1]), int(points[i, 2])
        for corner in range(8):
            a, b, c = x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)
            if a >= paint.shape[0] or b >= paint.shape[1] or c >= paint.shape[2]:
                continue
            if paint[a, b, c] > 0:
                near = (
                    (1 - abs(points[i, 0] - a))
                    * (1 - abs(points[i, 1] - b))
                    * (1 - abs(points[i, 2] - c))
                )
                near = max(near, 1e-6)
                total += near
                for k in range(3):
                    mix[k] += near * colour[a, b, c, k]
        for k in range(3):
            out[i, k] = 128 if total == 0 else int(min(mix[k] / total + 0.5, 255))
    return out
