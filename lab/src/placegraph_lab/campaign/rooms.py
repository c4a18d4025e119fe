"""Rooms turned, mirrored, carried elsewhere or relisted, and captures of them that go along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])  # of what is seen in a mirror: right is left


@dataclass(frozen=True, eq=False)
class Motion:
    """Where a room goes: mirrored west to east before, turned about its up, shifted."""

    yaw: float  # [rad]
    shift: NDArray[np.float64]  # (3,) [m]
    mirrored: bool = False

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) of points."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        out = np.eye(4)
        out[:2, :2] = [[c, -s], [s, c]]
        out[:3, 3] = self.shift
        return out @ _FLIP if self.mirrored else out

    def pose(self, map_from_camera: NDArray[np.float64]) -> NDArray[np.float64]:
        """A pose (4, 4) in the room, as it is where the room has gone."""
        out = self.matrix @ map_from_camera
        return out @ _FLIP if self.mirrored else out

    def scene(self, scene: SceneMap) -> SceneMap:
        """The room where it has gone."""
        mesh, matrix = scene.mesh, self.matrix
        vertices = (mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)
        triangles = mesh.triangles[:, [0, 2, 1]] if self.mirrored else mesh.triangles
        return _made(scene, replace(mesh, vertices=vertices, triangles=triangles), self.shift[2])

    def capture(self, frames: Sequence[Frame]) -> Capture:
        """What a camera records that went along."""
        return Capture.from_frames([_in_mirror(f) if self.mirrored else f for f in frames])


def relisted(scene: SceneMap, rng: np.random.Generator) -> SceneMap:
    """The same room, its objects in another order."""
    order = rng.permutation(len(scene))
    place = np.argsort(order).astype(np.int32)
    mesh = replace(scene.mesh, object_of=place[scene.mesh.object_of])
    return _made(scene, mesh, 0.0, order)


def stood(frames: Sequence[Frame]) -> list[Frame]:
    """Frames of a camera that stood still, as its odometry tells."""
    return [_again(f, odometry=frames[0].odometry, gravity=frames[0].gravity) for f in frames]


def _again(frame: Frame, **change: Any) -> Frame:  # noqa: ANN401  # of `Frame.from_arrays`
    given: dict[str, Any] = {
        "depth": frame.depth(), "depth_camera": frame.depth_camera, "labels": frame.labels(),
        "label_camera": frame.label_camera, "label_kind": frame.label_kind or "labels",
        "label_names": frame.label_names, "odometry": frame.odometry, "gravity": frame.gravity,
        "stamp": frame.stamp, "index": frame.index,
    } | change  # fmt: skip
    rgb, camera = given.pop("rgb", None), given.pop("camera", frame.camera)
    return Frame.from_arrays(frame.rgb() if rgb is None else rgb, camera, **given)


def _in_mirror(frame: Frame) -> Frame:
    depth, labels = frame.depth(), frame.labels()
    return _again(
        frame,
        rgb=_flipped(frame.rgb()), camera=_seen(frame.camera),
        depth=None if depth is None else _flipped(depth),
        depth_camera=None if frame.depth_camera is None else _seen(frame.depth_camera),
        labels=None if labels is None else _flipped(labels),
        label_camera=None if frame.label_camera is None else _seen(frame.label_camera),
        odometry=_FLIP @ frame.odometry @ _FLIP, gravity=_FLIP[:3, :3] @ frame.gravity,
    )  # fmt: skip


def _flipped(image: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(image[:, ::-1])


def _seen(camera: Camera) -> Camera:
    return replace(camera, cx=camera.width - camera.cx)


def _made(
    scene: SceneMap, mesh: Mesh, rise: float, order: NDArray[np.int64] | None = None
) -> SceneMap:
    graph, rows = scene.graph, np.arange(len(scene)) if order is None else order
    return SceneMap.create(
        mesh, [graph.ids[i] for i in rows], [graph.labels[i] for i in rows],
        floor=float(scene.floors[0] + rise), names=[graph.names[i] for i in rows],
        encoded=scene.encoded,
    )  # fmt: skip
