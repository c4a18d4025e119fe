"""Poses of a scene map that stands on Earth, there."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from placegraph.indoor.map.rooms.naming import room_at

if TYPE_CHECKING:
    from placegraph.estimate import PoseEstimate, PoseMode
    from placegraph.indoor.map.scene import Scene


def placed(scene: Scene, estimate: PoseEstimate) -> PoseEstimate:
    """The estimate with `PoseMode.earth` of each mode, where the map has anchors."""
    if not scene.anchors:
        return estimate
    return replace(estimate, modes=tuple(_placed(scene, mode) for mode in estimate.modes))


def _placed(scene: Scene, mode: PoseMode) -> PoseMode:
    anchors = scene.anchors_of(mode.scene)
    room = room_at(scene, mode.map_from_camera[:3, 3]) if anchors else ""
    poses = [
        a.pose(mode.map_from_camera, mode.covariance, probability=mode.probability, room=room)
        for a in anchors
    ]
    return replace(mode, earth=tuple(poses))
