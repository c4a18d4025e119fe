"""What a live tracker knows as messages: the pose as often as odometry tells it, the rest by image."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import Evidence, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Floats, pose_matrix, rotation_from_vector, split_pose
from placegraph.indoor.map.scene import Scene
from placegraph_ros.map import map_messages
from placegraph_ros.message import FrameIds, Message, header, poses, sayable, transform
from placegraph_ros.objects import objects_message
from placegraph_ros.options import LiveOptions
from placegraph_ros.pose import UPRIGHT_BASE, based, pose_messages, rig_message, transforms_message

if TYPE_CHECKING:
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.indoor.track.live_pose import LivePose
    from placegraph_io.ros.stream import Assembly

STATUS = "localization/status"


def frame_ids(options: LiveOptions, parts: Assembly | None) -> FrameIds:
    """Names of the frames by what the user says, and by what frames are made of."""
    if parts is None:
        return FrameIds(map=options.map_frame, base=options.base_frame or "base_link")
    name = options.map_frame
    if name == parts.odometry:  # poses of somebody else's map stand for odometry
        name = f"placegraph_{name}"
    return FrameIds(name, parts.odometry, options.base_frame or parts.base, parts.camera)


class Telling:
    """Makes messages of poses, and knows what was told already.

    Parameters
    ----------
    maps
        The map, or the library of which each scene is shown when the camera is in it.
    tolerance
        The transform map -> odom holds so long after its stamp [s], which is set ahead by that.
    whole
        Tell also what the robot knows already: where its camera sits, and where odometry has it.

    """

    def __init__(
        self, maps: SceneMap | SceneLibrary, frames: FrameIds, tolerance: float, *, whole: bool
    ) -> None:
        self.maps, self.frames = maps, frames
        self.base_from_camera: Floats = UPRIGHT_BASE
        self._tolerance, self._whole = tolerance, whole
        self._shown: str | None = None
        self._rig = False
        self._estimate: PoseEstimate | None = None
        self._status: tuple[Status, str] | None = None

    def begin(self, frames: FrameIds) -> None:
        """Tell the status anew: frames, of these names, begin to come."""
        self.frames, self._status = frames, None

    def moved(self, live: LivePose, stamp: float, odom_from_camera: Floats) -> list[Message]:
        """Where the camera is by odometry: odometry in the map, and the transform map -> odom."""
        messages = self._scenery(stamp, live.scene)
        if self._whole:
            base = odom_from_camera @ np.linalg.inv(self.base_from_camera)
            carried = transform(self.frames.odom, self.frames.base, base, stamp)
            messages.append(transforms_message([carried], stamp))
        if live.map_from_camera is None or live.covariance is None or live.map_from_odom is None:
            return messages
        told = pose_messages(
            live.map_from_camera, live.covariance, stamp, self.frames,
            base_from_camera=self.base_from_camera,
        )  # fmt: skip
        ahead = stamp + self._tolerance
        moved = transform(self.frames.map, self.frames.odom, live.map_from_odom, ahead)
        ridden = [m for m in told if m.topic.endswith("odometry")]
        return [*messages, *ridden, transforms_message([moved], stamp)]

    def news(self, live: LivePose, stamp: float) -> list[Message]:
        """What an image, taken at `stamp` [s], has changed; nothing where nothing is new."""
        if live.estimate is None or live.estimate is self._estimate:
            changed = self._status != (live.status, live.reason)
            return self.status(live.status, live.reason, live.stamp, live=live) if changed else []
        self._estimate, stamp = live.estimate, sayable(stamp)
        told = estimate_messages(
            live.estimate, stamp, self.frames, base_from_camera=self.base_from_camera
        )
        kept = [
            replace(m, latched=m.topic.endswith("/pose"))
            for m in told
            if m.type != "diagnostic_msgs/msg/DiagnosticArray" and not m.topic.endswith("odometry")
        ]
        said = self.status(live.status, live.reason, stamp, live=live)
        return [*self._scenery(stamp, live.scene), *kept, *said]

    def status(
        self, status: Status, reason: str, stamp: float, *, live: LivePose | None = None
    ) -> list[Message]:
        """How far the pose may be trusted, and why, as diagnostics and on a topic of its own."""
        stamp = sayable(stamp)
        self._status = status, reason
        best = live.estimate.best if live is not None and live.estimate is not None else None
        modes = len(live.estimate.modes) if live is not None and live.estimate is not None else 0
        told = status_message(status, reason, stamp, best=best, modes=modes)
        one = told.fields["status"][0]
        kind = "diagnostic_msgs/msg/DiagnosticStatus"
        return [told, Message(STATUS, kind, stamp, one, latched=True)]

    def lacking(self, reason: str, stamp: float) -> list[Message]:
        """That nothing is known, and why, if that was not said before."""
        said = Status.LOST, reason
        return [] if self._status == said else self.status(*said, stamp)

    def unusable(self, left_out: Counter[str], stamp: float) -> list[Message]:
        """That no image could be used yet, and why most could not."""
        if not left_out or not np.isfinite(stamp):
            return []
        reason = left_out.most_common(1)[0][0].rstrip(".")
        return self.lacking(f"No image could be used yet: {reason}.", stamp)

    def _scenery(self, stamp: float, scene: str) -> list[Message]:
        """The map that the camera is in, and where the camera sits, once."""
        messages = []
        if isinstance(self.maps, Scene):
            shown: SceneMap | None = self.maps
            scene = "map"
        else:
            shown = self.maps.scene(scene) if scene else None
        if shown is not None and self._shown != scene:
            self._shown = scene
            messages += map_messages(shown, stamp, self.frames)
        if self._whole and not self._rig:
            self._rig = True
            messages.append(rig_message(self.base_from_camera, stamp, self.frames))
        return messages


NAME = "placegraph: localization"
"""Of the diagnostic."""
_AROUND = 12
"""Particles that stand for a mode: two for each of its six directions."""
_LEVELS = {Status.OK: 0, Status.AMBIGUOUS: 1, Status.LOST: 2}  # OK, WARN, ERROR


def estimate_messages(
    estimate: PoseEstimate,
    stamp: float,
    frames: FrameIds | None = None,
    *,
    map_from_odom: Floats | None = None,
    base_from_camera: Floats | None = None,
) -> list[Message]:
    """What an estimate says of its last frame, taken at `stamp` [s].

    Where the status is OK, `pose.pose_messages`, whose other parameters these are. Always a
    `nav2_msgs/ParticleCloud`, a `PoseArray` of the modes, best first, a `DiagnosticArray` with
    status, reason and evidence, and, where the estimate knows its map, a `MarkerArray` of the
    objects that agreed and disagreed.

    Raises
    ------
    OptionError
        The stamp is none that ROS can say.

    """
    frames = frames or FrameIds()
    mount = UPRIGHT_BASE if base_from_camera is None else base_from_camera
    best = estimate.best
    messages = []
    if best is not None and estimate.status is Status.OK:
        messages += pose_messages(
            best.map_from_camera, best.covariance, stamp, frames,
            map_from_odom=map_from_odom, base_from_camera=mount,
        )  # fmt: skip
    head = header(stamp, frames.map)
    matrices = np.array([mode.map_from_camera for mode in estimate.modes]).reshape(-1, 4, 4)
    around, weights = particles(estimate, mount)
    cloud = [
        {"pose": pose, "weight": weight}
        for pose, weight in zip(poses(around), weights.tolist(), strict=True)
    ]
    return [
        *messages,
        Message(
            "localization/particle_cloud", "nav2_msgs/msg/ParticleCloud", stamp,
            {"header": head, "particles": cloud},
        ),
        Message(
            "localization/modes", "geometry_msgs/msg/PoseArray", stamp,
            {"header": head, "poses": poses(matrices @ np.linalg.inv(mount))},
        ),
        status_message(estimate.status, estimate.reason, stamp, best=best, modes=len(estimate.modes)),
        *objects_message(estimate, stamp, frames),
    ]  # fmt: skip


def particles(estimate: PoseEstimate, base_from_camera: Floats) -> tuple[Floats, Floats]:
    """Poses (N, 4, 4) map_from_base and weights (N,) that stand for what is known.

    Those of the filter's last step where it was recorded (`FilterOptions.record`); else twelve a
    mode, which have its pose as their mean, its covariance, and its probability together.
    """
    steps = [step for record in estimate.history for step in record.steps]
    if steps and estimate.best is not None:
        _, places, weights = steps[-1]
        level = split_pose(estimate.best.map_from_camera)[1]
        shares = weights / max(float(weights.sum()), 1e-300)
        return pose_matrix(places, level) @ np.linalg.inv(base_from_camera), shares
    around = [_around(mode, base_from_camera) for mode in estimate.modes]
    heavy = np.array([mode.probability for mode in estimate.modes])
    return np.concatenate([np.zeros((0, 4, 4)), *around]), np.repeat(heavy / _AROUND, _AROUND)


def _around(mode: PoseMode, base_from_camera: Floats) -> Floats:
    """Poses (_AROUND, 4, 4) of the base whose mean and covariance are a mode's."""
    center, covariance = based(mode.map_from_camera, mode.covariance, base_from_camera)
    values, vectors = np.linalg.eigh(covariance)
    ahead = (vectors * np.sqrt(6.0 * np.maximum(values, 0.0))).T
    arms = np.concatenate([ahead, -ahead])
    cloud = np.repeat(center[None], len(arms), axis=0)
    cloud[:, :3, 3] += arms[:, :3]
    cloud[:, :3, :3] = rotation_from_vector(arms[:, 3:]) @ center[:3, :3]
    return cloud


def status_message(
    status: Status, reason: str, stamp: float, *, best: PoseMode | None = None, modes: int = 0
) -> Message:
    """`DiagnosticArray`: OK, warning (AMBIGUOUS) or error (LOST), the reason, and the evidence."""
    values = {"status": status.name, "reason": reason, "modes": str(modes)}
    if best is not None:
        values["probability"] = f"{best.probability:.4f}"
        values["scene"] = best.scene
    told = [{"key": key, "value": value} for key, value in values.items()]
    told += [_told(evidence) for evidence in (best.evidence if best else ())]
    one = {
        "level": _LEVELS[status], "name": NAME, "message": f"{status.name}: {reason}",
        "values": told,
    }  # fmt: skip
    fields = {"header": header(stamp, ""), "status": [one]}
    return Message("diagnostics", "diagnostic_msgs/msg/DiagnosticArray", stamp, fields)


def _told(evidence: Evidence) -> dict[str, str]:
    note = f" ({evidence.note})" if evidence.note else ""
    return {
        "key": evidence.statement,
        "value": f"{evidence.verdict} {evidence.weight:+.2f}{note}",
    }
