# mypy: allow-untyped-defs, allow-incomplete-defs
"""Statements against objects with positions, for `kitti360pose_relational`: compiled."""

from __future__ import annotations

import numpy as np

from placegraph.core.jit import kernel
from placegraph.outdoor.likelihood.match_kernels import BLUR, DIRECTION, pair_fit, speaker_fit


@kernel
def nearest_owner(points, centers, half):
    """Row of the nearest centre (K, 2) to each point (V, 2); -1 where its square does not reach."""
    owner = np.full(len(points), -1, np.int64)
    for v in range(len(points)):
        best = np.inf
        for k in range(len(centers)):
            dx, dy = points[v, 0] - centers[k, 0], points[v, 1] - centers[k, 1]
            d2 = dx * dx + dy * dy
            if d2 < best:
                best = d2
                owner[v] = k if max(abs(dx), abs(dy)) <= half else -1
    return owner


@kernel
def find_visible(points, owner, object_starts, footprint_starts, footprints, reach):
    """Return the objects in sight of points (V, 2) of cells `owner` (V,): starts (V + 1,), objects, offsets.

    An object stands where its footprint is nearest to the point, at most `reach` away [m].
    """
    most = 0
    for v in range(len(points)):
        most += object_starts[owner[v] + 1] - object_starts[owner[v]]
    starts = np.zeros(len(points) + 1, np.int64)
    objects = np.empty(most, np.int64)
    offsets = np.empty((most, 2), np.float32)
    n = 0
    for v in range(len(points)):
        for o in range(object_starts[owner[v]], object_starts[owner[v] + 1]):
            best, x, y = np.inf, 0.0, 0.0
            for f in range(footprint_starts[o], footprint_starts[o + 1]):
                dx, dy = footprints[f, 0] - points[v, 0], footprints[f, 1] - points[v, 1]
                if dx * dx + dy * dy < best:
                    best, x, y = dx * dx + dy * dy, dx, dy
            if best <= reach * reach:
                objects[n] = o
                offsets[n, 0], offsets[n, 1] = x, y
                n += 1
        starts[v + 1] = n
    return starts, objects[:n].copy(), offsets[:n].copy()


@kernel
def from_speaker(starts, objects, offsets, match, op, table, bearing, noise, background, clutter):
    """Log-likelihood (V,) float64 of S statements about the speaker at each viewpoint.

    `match` (S, N) says how well each object is called what a statement calls it.
    """
    out = np.zeros(len(starts) - 1)
    for v in range(len(starts) - 1):
        seen = starts[v + 1] - starts[v]
        for s in range(len(op)):
            served = 0.0
            for e in range(starts[v], starts[v + 1]):
                called = match[s, objects[e]]
                if called > 0.0:
                    served += called * speaker_fit(
                        op[s], table, bearing[s, 0], bearing[s, 1], 0.0,
                        offsets[e, 0], offsets[e, 1], 2, False, BLUR,
                    )  # fmt: skip
            out[v] += np.log((1.0 - noise) * served / (seen + clutter) + noise * background[s])
    return out


@kernel
def score_pairs(object_starts, centers, source, target, table, bearing, noise, background, clutter):
    """Log-likelihood (K,) float64 of S statements about two things in each cell.

    `source` and `target` (S, N) say how well each object is called what a statement calls it.
    """
    out = np.zeros(len(object_starts) - 1)
    for k in range(len(object_starts) - 1):
        first, last = object_starts[k], object_starts[k + 1]
        pairs = (last - first) * (last - first - 1)
        for s in range(len(bearing)):
            served = 0.0
            for a in range(first, last):
                if source[s, a] <= 0.0:
                    continue
                for b in range(first, last):
                    if a != b and target[s, b] > 0.0:
                        served += source[s, a] * target[s, b] * pair_fit(
                            DIRECTION, table, bearing[s, 0], bearing[s, 1], 0.0,
                            centers[a, 0], centers[a, 1], centers[b, 0], centers[b, 1], 0,
                        )  # fmt: skip
            out[k] += np.log((1.0 - noise) * served / (pairs + clutter) + noise * background[s])
    return out
