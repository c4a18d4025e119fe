"""Fewer points for the same shape: Douglas-Peucker on lines and rings, compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.outdoor.map.simplify_kernels import _centers, _keep

if TYPE_CHECKING:
    from numpy.typing import NDArray


def simplify(
    points: NDArray[np.float64], starts: NDArray[np.int64], tolerance: float
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Drop points that lie within `tolerance` [m] of the simplified line of their part.

    `points` is (V, 2), `starts` (P + 1,) bounds the parts; both come back shorter. Ends stay;
    rings (first point = last) keep at least the corner farthest from their first point.
    """
    keep = _keep(points, starts, tolerance)
    kept = np.concatenate(([0], np.cumsum(keep)))
    return points[keep], kept[starts]


def centers(
    kind: NDArray[np.uint8],
    part_starts: NDArray[np.int32],
    point_starts: NDArray[np.int32],
    points: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Centers (N, 2) [m] of objects: the point, the middle of the line, the area's centroid."""
    return _centers(kind, part_starts, point_starts, points)
