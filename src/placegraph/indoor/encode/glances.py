"""Glances into a map: poses from which a visitor would see its objects, for encoders that render."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.indoor.map.panoramas import HIGHEST
from placegraph.indoor.map.panoramas_kernels import AZIMUTHS, ELEVATIONS, NOTHING, STEP

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from placegraph.geometry import Floats
    from placegraph.indoor.likelihood.visibility import VisibilityTable

POSITIONS_A_GLANCE = 24
"""Free positions of the visibility table, 0.25 m apart, that share a glance."""
LEAST = 32
"""Glances at least."""
_PITCHES = np.deg2rad([-20.0, 0.0, 20.0, -35.0])
_GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
_HALF = 7  # bins of azimuth to either side of a heading that a glance takes in: 70 degrees in all
_MAPPED = 0.9  # headings with this share of the most mapped one's surface will do
_WANTED = 24.0  # bins of a panorama that an object looked at should cover, of the 120 of a glance


def around(table: VisibilityTable) -> Floats:
    """Poses (G, 4, 4) map_from_camera, evenly spread over the free positions of a map.

    Headings are spread too, as far as there is anything to be seen; pitches take turns.
    """
    if not len(table):
        return np.zeros((0, 4, 4))
    count = min(max(LEAST, len(table) // POSITIONS_A_GLANCE), max(len(table), LEAST))
    rows = _apart(table.positions, count)
    mapped = (table.panoramas.ranges[rows] != NOTHING).mean(axis=1)
    ahead = sum(np.roll(mapped, shift, axis=1) for shift in range(-_HALF, _HALF + 1))
    poses = []
    for i, row in enumerate(rows.tolist()):
        good = np.flatnonzero(ahead[i] >= _MAPPED * ahead[i].max())
        heading = good[int(i * _GOLDEN % 1.0 * len(good))] * STEP
        poses.append(_looking(table.positions[row], heading, _PITCHES[i % len(_PITCHES)]))
    return np.stack(poses)


def towards(table: VisibilityTable, objects: NDArray[np.intp]) -> Floats:
    """Poses (G, 4, 4), one for each of these objects (rows) that is visible from anywhere."""
    poses = []
    elevations = ((np.arange(ELEVATIONS) + 0.5) / ELEVATIONS * 2.0 - 1.0) * HIGHEST
    azimuths = np.arange(AZIMUTHS) * STEP
    for row in objects.tolist():
        seen = table.panoramas.objects == row
        bins = seen.sum(axis=(1, 2))
        if not bins.any():
            continue
        with np.errstate(divide="ignore"):
            best = int(np.abs(np.log(bins / _WANTED)).argmin())
        e, a = np.nonzero(seen[best])
        heading = np.arctan2(np.sin(azimuths[a]).mean(), np.cos(azimuths[a]).mean())
        poses.append(_looking(table.positions[best], heading, elevations[e].mean()))
    return np.stack(poses) if poses else np.zeros((0, 4, 4))


def _apart(points: Floats, count: int) -> NDArray[np.intp]:
    """Rows of points, each the farthest from those before it; again from the start if too few."""
    rows = np.zeros(count, np.intp)
    distance = np.full(len(points), np.inf)
    for i in range(1, count):
        distance = np.minimum(distance, np.linalg.norm(points - points[rows[i - 1]], axis=1))
        rows[i] = distance.argmax()
        if distance[rows[i]] == 0.0:
            distance[:] = np.inf
    return rows


def _looking(position: Floats, heading: float, pitch: float) -> Floats:
    """Pose (4, 4) of an upright camera; pitch is up."""
    ahead = [np.cos(heading) * np.cos(pitch), np.sin(heading) * np.cos(pitch), np.sin(pitch)]
    right = [np.sin(heading), -np.cos(heading), 0.0]
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    pose[:3, 3] = position
    return pose
