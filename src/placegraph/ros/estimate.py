"""An estimate as messages: the pose where it is known, and always what else it might be, and why."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from placegraph.estimate import Status
from placegraph.geometry import pose_matrix, rotation_from_vector, split_pose
from placegraph.ros.message import FrameIds, Message, header, poses
from placegraph.ros.objects import objects_message
from placegraph.ros.pose import UPRIGHT_BASE, based, pose_messages

if TYPE_CHECKING:
    from placegraph.estimate import PoseEstimate, PoseMode
    from placegraph.evidence import Evidence
    from placegraph.geometry import Floats

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
