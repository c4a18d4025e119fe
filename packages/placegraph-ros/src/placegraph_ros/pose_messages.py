"""Poses of a robot's base, their covariance, modes and status as messages."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from placegraph.core.estimate import Evidence, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import (
    Floats,
    cross_matrix,
    pose_matrix,
    rotation_from_vector,
    split_pose,
)
from placegraph.indoor.map.scene import Scene
from placegraph_ros.message import (
    Fields,
    FrameIds,
    Message,
    header,
    pose,
    poses,
    stamp_or_zero,
    transform,
)
from placegraph_ros.options import LiveOptions
from placegraph_ros.scene_messages import map_messages, objects_message

if TYPE_CHECKING:
    from placegraph.indoor.library.library import SceneLibrary
    from placegraph.indoor.scene_map import SceneMap
    from placegraph.indoor.track.belief import LivePose
    from placegraph_io.ros.stream import FrameAssembly

UPRIGHT_BASE = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""base_from_camera of a base that is the camera itself with a body's axes (REP-103): x where it
looks, y to the left, z up."""
_UNKNOWN = 1e6  # Variance of an unknown velocity [m^2/s^2, rad^2/s^2]


def base_pose(
    map_from_camera: Floats, covariance: Floats, base_from_camera: Floats
) -> tuple[Floats, Floats]:
    """Return the pose (4, 4) and covariance (6, 6) of the base, of those of a camera on it.

    Both covariances are of x, y, z [m] and of a turn about the map's axes [rad]. A turn w moves
    the base by w x lever, which leads from the camera to the base in the map's axes.
    """
    map_from_base = map_from_camera @ np.linalg.inv(base_from_camera)
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -cross_matrix(map_from_base[:3, 3] - map_from_camera[:3, 3])
    return map_from_base, jacobian @ covariance @ jacobian.T


def pose_messages(
    map_from_camera: Floats,
    covariance: Floats,
    stamp: float,
    frames: FrameIds | None = None,
    *,
    map_from_odom: Floats | None = None,
    base_from_camera: Floats | None = None,
) -> list[Message]:
    """`PoseWithCovarianceStamped`, `Odometry`, and where it is known the transform map -> odom.

    `map_from_camera`, `covariance`: (4, 4), and (6, 6) of x, y, z [m] and a turn about the map's axes
    [rad], which is ROS's order; `stamp`: when the camera was there [s]; `map_from_odom`: (4, 4),
    map_from_camera @ inv(odom_from_camera) of one moment; `base_from_camera`: (4, 4) where the camera
    sits on the robot; `UPRIGHT_BASE` if not given.

    Raises `OptionError`: the stamp is out of ROS's range.
    """
    frames = frames or FrameIds()
    mount = UPRIGHT_BASE if base_from_camera is None else base_from_camera
    map_from_base, spread = base_pose(map_from_camera, covariance, mount)
    pose_fields = {"pose": pose(map_from_base), "covariance": spread.ravel()}
    head = header(stamp, frames.map)
    moving = {"covariance": np.eye(6).ravel() * _UNKNOWN}
    ridden = {"header": head, "child_frame_id": frames.base, "pose": pose_fields, "twist": moving}
    kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
    messages = [
        Message("localization/pose", kind, stamp, {"header": head, "pose": pose_fields}),
        Message("localization/odometry", "nav_msgs/msg/Odometry", stamp, ridden),
    ]
    if map_from_odom is not None:
        moved = transform(frames.map, frames.odom, map_from_odom, stamp)
        messages.append(transforms_message([moved], stamp))
    return messages


def rig_message(
    base_from_camera: Floats | None, stamp: float, frames: FrameIds | None = None
) -> Message:
    """Return the camera's mount, base -> camera, on `tf_static`."""
    frames = frames or FrameIds()
    mount = UPRIGHT_BASE if base_from_camera is None else base_from_camera
    fixed = transform(frames.base, frames.camera, mount, stamp)
    return transforms_message([fixed], stamp, latched=True)


def transforms_message(
    transforms: Sequence[Fields], stamp: float, *, latched: bool = False
) -> Message:
    """`tf2_msgs/TFMessage` of `message.transform`s, on `tf`, or latched on `tf_static`."""
    topic = "tf_static" if latched else "tf"
    fields = {"transforms": list(transforms)}
    return Message(topic, "tf2_msgs/msg/TFMessage", stamp, fields, latched)


STATUS = "localization/status"
TICK = 1e-6  # from one transform to its correction [s]: tf2 ignores a second one of a stamp


def frame_ids(options: LiveOptions, parts: FrameAssembly | None) -> FrameIds:
    """Return the names of the frames by the options and the assembled topics."""
    if parts is None:
        return FrameIds(map=options.map_frame, base=options.base_frame or "base_link")
    name = options.map_frame
    if name == parts.odometry:  # poses of somebody else's map stand for odometry
        name = f"placegraph_{name}"
    return FrameIds(name, parts.odometry, options.base_frame or parts.base, parts.camera)


class PoseReporter:
    """Makes messages of poses, each status and map once.

    `maps`: the map, or the library of which each scene is shown when the camera is in it; `tolerance`:
    time by which the stamp of map -> odom is ahead [s]; `with_inputs`: also send what the robot knows
    already: the camera's mount and odometry.
    """

    def __init__(
        self,
        maps: SceneMap | SceneLibrary,
        frames: FrameIds,
        tolerance: float,
        *,
        with_inputs: bool,
    ) -> None:
        self.maps, self.frames = maps, frames
        self.base_from_camera: Floats = UPRIGHT_BASE
        self.tolerance, self._with_inputs = tolerance, with_inputs
        self._corrected: Floats | None = None  # map_from_odom that was reported last, at ...
        self._odom_stamp = 0.0  # ... this stamp
        self._shown: str | None = None
        self._rig = False
        self._estimate: PoseEstimate | None = None
        self._status: tuple[Status, str] | None = None

    def restart(self, frames: FrameIds) -> None:
        """Set the names of the frames, and report the status again."""
        self.frames, self._status = frames, None

    def report_motion(
        self, live: LivePose, stamp: float, odom_from_camera: Floats
    ) -> list[Message]:
        """Return odometry in the map, and the transform map -> odom."""
        messages, self._odom_stamp = self._scenery(stamp, live.scene), stamp
        if self._with_inputs:
            base = odom_from_camera @ np.linalg.inv(self.base_from_camera)
            carried = transform(self.frames.odom, self.frames.base, base, stamp)
            messages.append(transforms_message([carried], stamp))
        if live.map_from_camera is None or live.covariance is None or live.map_from_odom is None:
            return messages
        told = pose_messages(
            live.map_from_odom @ odom_from_camera, live.covariance, stamp, self.frames,
            base_from_camera=self.base_from_camera,
        )  # fmt: skip
        ridden = [m for m in told if m.topic.endswith("odometry")]
        return [*messages, *ridden, *self._report_correction(live.map_from_odom, stamp)]

    def _report_correction(self, map_from_odom: Floats, stamp: float) -> list[Message]:
        """Return map -> odom, stamped ahead of `stamp` [s] by the tolerance."""
        self._corrected, self._odom_stamp = map_from_odom, stamp
        ahead = stamp + self.tolerance
        moved = transform(self.frames.map, self.frames.odom, map_from_odom, ahead)
        return [transforms_message([moved], stamp)]

    def report_changes(self, live: LivePose, stamp: float) -> list[Message]:
        """Return the messages after an image taken at `stamp` [s]; empty where nothing changed.

        A correction that came later than odometry is sent at once, just after its last stamp.
        """
        messages: list[Message] = []
        anchor = live.map_from_odom
        if anchor is not None and anchor is not self._corrected and self._odom_stamp:
            messages = self._report_correction(anchor, self._odom_stamp + TICK)
        if live.estimate is None or live.estimate is self._estimate:
            if self._status == (live.status, live.reason):
                return messages
            return [
                *messages, *self.report_status(live.status, live.reason, live.stamp, live=live)
            ]  # fmt: skip
        self._estimate, stamp = live.estimate, stamp_or_zero(stamp)
        told = estimate_messages(
            live.estimate, stamp, self.frames, base_from_camera=self.base_from_camera
        )
        kept = [
            replace(m, latched=m.topic.endswith("/pose"))
            for m in told
            if m.type != "diagnostic_msgs/msg/DiagnosticArray" and not m.topic.endswith("odometry")
        ]
        status = self.report_status(live.status, live.reason, stamp, live=live)
        return [*messages, *self._scenery(stamp, live.scene), *kept, *status]

    def report_status(
        self, status: Status, reason: str, stamp: float, *, live: LivePose | None = None
    ) -> list[Message]:
        """Return the status with its reason, as diagnostics and on a topic of its own."""
        stamp = stamp_or_zero(stamp)
        self._status = status, reason
        best = live.estimate.best if live is not None and live.estimate is not None else None
        modes = len(live.estimate.modes) if live is not None and live.estimate is not None else 0
        message = status_message(status, reason, stamp, best=best, modes=modes)
        one = message.fields["status"][0]
        kind = "diagnostic_msgs/msg/DiagnosticStatus"
        return [message, Message(STATUS, kind, stamp, one, latched=True)]

    def report_lack(self, reason: str, stamp: float) -> list[Message]:
        """Return the status LOST with a reason, unless it was reported before."""
        if self._status == (Status.LOST, reason):
            return []
        return self.report_status(Status.LOST, reason, stamp)

    def report_unusable(self, left_out: Counter[str], stamp: float) -> list[Message]:
        """Return the status LOST with the most frequent reason for unusable images."""
        if not left_out or not np.isfinite(stamp):
            return []
        reason = left_out.most_common(1)[0][0].rstrip(".")
        return self.report_lack(f"No image could be used yet: {reason}.", stamp)

    def _scenery(self, stamp: float, scene: str) -> list[Message]:
        """Return the map of the camera and the camera's mount, each once."""
        messages = []
        if isinstance(self.maps, Scene):
            shown: SceneMap | None = self.maps
            scene = "map"
        else:
            shown = self.maps.scene(scene) if scene else None
        if shown is not None and self._shown != scene:
            self._shown = scene
            messages += map_messages(shown, stamp, self.frames)
        if self._with_inputs and not self._rig:
            self._rig = True
            messages.append(rig_message(self.base_from_camera, stamp, self.frames))
        return messages


DIAGNOSTIC = "placegraph: localization"  # Name of the diagnostic
_AROUND = 12  # Particles for a mode: two for each of its six directions
_LEVELS = {Status.OK: 0, Status.AMBIGUOUS: 1, Status.LOST: 2}  # OK, WARN, ERROR


def estimate_messages(
    estimate: PoseEstimate,
    stamp: float,
    frames: FrameIds | None = None,
    *,
    map_from_odom: Floats | None = None,
    base_from_camera: Floats | None = None,
) -> list[Message]:
    """Return the messages of an estimate for its last frame, taken at `stamp` [s].

    Where the status is OK, `pose.pose_messages`, whose other parameters these are. Always a
    `nav2_msgs/ParticleCloud`, a `PoseArray` of the modes, best first, a `DiagnosticArray` with
    status, reason and evidence, and, where the estimate knows its map, a `MarkerArray` of the
    objects that agreed and disagreed.

    Raises `OptionError`: the stamp is out of ROS's range.
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
    """Return the poses (N, 4, 4) map_from_base and weights (N,) that represent an estimate.

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
    """Return the poses (_AROUND, 4, 4) of the base whose mean and covariance are a mode's."""
    center, covariance = base_pose(mode.map_from_camera, mode.covariance, base_from_camera)
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
    details = [{"key": key, "value": value} for key, value in values.items()]
    details += [_evidence_value(evidence) for evidence in (best.evidence if best else ())]
    one = {
        "level": _LEVELS[status], "name": DIAGNOSTIC, "message": f"{status.name}: {reason}",
        "values": details,
    }  # fmt: skip
    fields = {"header": header(stamp, ""), "status": [one]}
    return Message("diagnostics", "diagnostic_msgs/msg/DiagnosticArray", stamp, fields)


def _evidence_value(evidence: Evidence) -> dict[str, str]:
    note = f" ({evidence.note})" if evidence.note else ""
    return {
        "key": evidence.statement,
        "value": f"{evidence.verdict} {evidence.weight:+.2f}{note}",
    }
