"""Poses of a scene map that stands on Earth, there."""

from __future__ import annotations

from dataclasses import replace

from placegraph.core.estimate import PoseEstimate, PoseMode
from placegraph.core.geo import EarthPose
from placegraph.indoor.map.floor import storey_at
from placegraph.indoor.map.rooms import room_at
from placegraph.indoor.map.scene import Scene


def placed(scene: Scene, estimate: PoseEstimate) -> PoseEstimate:
    """The estimate with `PoseMode.earth` of each mode, where the map has anchors."""
    if not scene.anchors:
        return estimate
    return replace(estimate, modes=tuple(_placed(scene, mode) for mode in estimate.modes))


def _placed(scene: Scene, mode: PoseMode) -> PoseMode:
    at = mode.map_from_camera[:3, 3]
    room, (storey, _) = room_at(scene, at), storey_at(scene, at)
    poses = [
        a.pose(
            mode.map_from_camera, mode.covariance, probability=mode.probability, room=room,
            storey=storey,
        )
        for a in scene.anchors_of(mode.scene)
    ]  # fmt: skip
    return replace(mode, earth=tuple(poses))


def whereabouts(scene: Scene) -> tuple[EarthPose, ...]:
    """Where somebody may be who is anywhere in a map: each candidate of its anchor, likeliest first."""
    share = 1.0 / len(scene.scenes)
    found = [
        anchor.somewhere(box, probability=share)
        for name, box in zip(scene.scenes, scene.scene_bounds, strict=True)
        for anchor in scene.anchors_of(name)
    ]
    return tuple(sorted(found, key=lambda pose: -pose.probability))
