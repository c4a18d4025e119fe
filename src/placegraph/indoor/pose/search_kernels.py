# mypy: allow-untyped-defs, allow-incomplete-defs
"""Kernels of the search: poses moved onto the map's surfaces by depth, and distinct poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.jit import kernel
from placegraph.core.threads import run_parallel
from placegraph.indoor.rays.trace_kernels import (
    DIRECTION,
    FAR,
    LANES,
    ORIGIN,
    TRIANGLE,
    new_packet,
    trace16,
)

_HELD = np.array([0.3, 0.3, 0.2, 0.1])
"""Deviations of a step that readings do not fix: x, y, z [m], yaw [rad]."""
_COUNTED = 40.0
"""Independent readings of a step: neighbours err together."""


class Rig(NamedTuple):
    """Readings of depth of one or more frames, in the level axes of a reference frame."""

    origins: NDArray[np.float32]
    """(R, 3) [m]"""
    directions: NDArray[np.float32]
    """(R, 3) rays of length 1 along the optical axis."""
    depths: NDArray[np.float32]
    """(R,) along the optical axis [m]; 0: no reading."""


def align_poses(tracer, normals, poses, rig, deviations):
    """Move poses (N, 4) of a reference frame so that readings of a `Rig` lie on the map's surfaces.

    Point-to-plane steps of Gauss-Newton, one for each of `deviations` (I,): distances up to which
    readings count in full [m]. `normals`: (T, 3) of the map's triangles. Returns the poses (N, 4), and
    their covariances (N, 4, 4) by the last step.
    """
    moved, covariances = poses.copy(), np.empty((len(poses), 4, 4))
    run_parallel(_align, len(poses), tracer, normals, rig, deviations, moved, covariances)
    return moved, covariances


@kernel(error_model="numpy")
def _invert(h, out):
    """Invert a positive definite matrix h (4, 4), which is used up, by Gauss-Jordan; no SciPy needed."""
    out[:] = 0.0
    for i in range(4):
        out[i, i] = 1.0
    for i in range(4):
        scale = 1.0 / h[i, i]
        for b in range(4):
            h[i, b] *= scale
            out[i, b] *= scale
        for a in range(4):
            if a != i:
                share = h[a, i]
                for b in range(4):
                    h[a, b] -= share * h[i, b]
                    out[a, b] -= share * out[i, b]


@kernel(error_model="numpy")
def _align(tracer, normals, rig, deviations, poses, covariances, first, last):
    origins, directions, depths = rig.origins, rig.directions, rig.depths
    packet, ints, valid = new_packet()
    h, g, j = np.zeros((4, 4)), np.zeros(4), np.zeros(4)
    for k in range(first, last):
        pose = poses[k]
        for sd in deviations:
            h[:] = 0.0
            g[:] = 0.0
            readings = 0.0
            c, s = np.cos(pose[3]), np.sin(pose[3])
            for tile in range(len(depths) // LANES):
                for lane in range(LANES):
                    r = tile * LANES + lane
                    x, y, z = origins[r]
                    packet[ORIGIN, lane] = pose[0] + c * x - s * y
                    packet[ORIGIN + 1, lane] = pose[1] + s * x + c * y
                    packet[ORIGIN + 2, lane] = pose[2] + z
                    x, y, z = directions[r]
                    packet[DIRECTION, lane] = c * x - s * y
                    packet[DIRECTION + 1, lane] = s * x + c * y
                    packet[DIRECTION + 2, lane] = z
                    packet[FAR, lane] = np.inf
                trace16(tracer, packet, ints, valid)
                for lane in range(LANES):
                    depth, triangle = depths[tile * LANES + lane], ints[TRIANGLE, lane]
                    if depth <= 0.0 or triangle < 0:
                        continue
                    dx, dy, dz = (
                        packet[DIRECTION, lane],
                        packet[DIRECTION + 1, lane],
                        packet[DIRECTION + 2, lane],
                    )
                    n = normals[triangle]
                    error = (depth - packet[FAR, lane]) * (dx * n[0] + dy * n[1] + dz * n[2])
                    weight = 1.0 / (1.0 + (error / sd) ** 2) ** 2
                    j[0], j[1], j[2] = n[0], n[1], n[2]
                    j[3] = (packet[ORIGIN, lane] + depth * dx - pose[0]) * n[1] - (
                        packet[ORIGIN + 1, lane] + depth * dy - pose[1]
                    ) * n[0]
                    readings += 1.0
                    for a in range(4):
                        g[a] -= weight * error * j[a]
                        for b in range(4):
                            h[a, b] += weight * j[a] * j[b]
            scale = _COUNTED / max(readings, 1.0) / (sd * sd)
            for a in range(4):
                g[a] *= scale
                for b in range(4):
                    h[a, b] *= scale
                h[a, a] += 1.0 / (_HELD[a] * _HELD[a])
            _invert(h, covariances[k])
            for a in range(4):
                for b in range(4):
                    pose[a] += covariances[k, a, b] * g[b]


@kernel
def select_rows(poses, most, apart, turned):
    """Return rows (K,) of the first `most` of poses (N, 4) that are not near one selected before.

    Near: within `apart` [m] and `turned` [rad].
    """
    kept = np.empty(min(most, len(poses)), np.int64)
    count = 0
    for i in range(len(poses)):
        near = False
        for m in range(count):
            k = kept[m]
            x, y, z = (
                poses[i, 0] - poses[k, 0],
                poses[i, 1] - poses[k, 1],
                poses[i, 2] - poses[k, 2],
            )
            turn = abs(poses[i, 3] - poses[k, 3]) % (2.0 * np.pi)
            if x * x + y * y + z * z <= apart * apart and min(turn, 2.0 * np.pi - turn) <= turned:
                near = True
                break
        if not near:
            kept[count] = i
            count += 1
            if count == len(kept):
                break
    return kept[:count]
