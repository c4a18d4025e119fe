"""The pose at any time: what the last image told, carried on by odometry, as unsure as the way makes it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Floats, cross_matrix
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.status import LiveState, decide_live
from placegraph.indoor.track.odometry import Sample


@dataclass(frozen=True, slots=True, eq=False)
class LivePose:
    """Where the camera is at a time, and how far that may be trusted."""

    stamp: float
    """[s]"""
    status: Status
    """Of the last image; `AMBIGUOUS` where odometry alone has led on for too long."""
    reason: str
    """One sentence: why."""
    map_from_camera: Floats | None
    """(4, 4) [m]; None where nobody knows, or several places fit: `estimate.modes`."""
    map_from_odom: Floats | None
    """(4, 4) where odometry's frame stands in the map: what an image corrects."""
    covariance: Floats | None
    """(6, 6) of `map_from_camera`, as `PoseMode.covariance`."""
    estimate: PoseEstimate | None = field(repr=False)
    """Of the last image that was looked at."""
    scene: str
    """Name of the map; of a plain map that of its (first) scene. Empty where nobody knows."""
    age: float
    """Seconds since an image, or a person, told it; infinite where nobody has."""

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and strings, without the estimate."""
        matrices = {
            name: None if (m := getattr(self, name)) is None else m.tolist()
            for name in ("map_from_camera", "map_from_odom", "covariance")
        }
        return {
            "stamp": self.stamp, "status": self.status.name, "reason": self.reason,
            "scene": self.scene, "age": self.age if np.isfinite(self.age) else None,
        } | matrices  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Anchor:
    """Where odometry's frame stands in a map, as it was told at a time."""

    at: Sample
    """Odometry then."""
    map_from_odom: Floats
    covariance: Floats
    """(6, 6) of the camera's pose then."""
    scene: str

    @classmethod
    def of(cls, at: Sample, map_from_camera: Floats, covariance: Floats, scene: str) -> Anchor:
        """Told by a pose of the camera (4, 4) with its covariance (6, 6)."""
        return cls(at, map_from_camera @ np.linalg.inv(at.pose), covariance, scene)

    def pose(self, now: Sample) -> Floats:
        """map_from_camera (4, 4) where odometry is now."""
        return self.map_from_odom @ now.pose

    def spread(self, now: Sample, noise: MotionNoise) -> Floats:
        """Covariance (6, 6) of that: it grows by way, turn and time, and by what odometry says of itself.

        A turn that is not quite known swings what was gone since.
        """
        gone = self.map_from_odom[:3, :3] @ (now.pose[:3, 3] - self.at.pose[:3, 3])
        swing = np.eye(6)
        swing[:3, 3:] = -cross_matrix(gone)
        return swing @ self.covariance @ swing.T + self._grown(now, noise)

    def _grown(self, now: Sample, noise: MotionNoise) -> Floats:
        if now.stamp == self.at.stamp:
            return np.zeros((6, 6))
        # noise is of a step; to stand still for a second counts as one more
        steps = 1.0 + abs(now.stamp - self.at.stamp)
        way = noise.translation**2 * steps
        way += (noise.translation_per_metre * (now.way - self.at.way)) ** 2
        turn = noise.rotation**2 * steps
        turn += (noise.rotation_per_radian * (now.turned - self.at.turned)) ** 2
        grown = np.diag([way, way, way, 0.0, 0.0, turn])
        if now.covariance is None or self.at.covariance is None:
            return grown
        both = np.kron(np.eye(2), self.map_from_odom[:3, :3])
        return grown + both @ _positive(now.covariance - self.at.covariance) @ both.T


def predicted(
    anchor: Anchor, now: Sample, noise: MotionNoise, last: LiveState, silent: float
) -> LivePose:
    """Return the pose where odometry is now, by the last image; `silent`: seconds without odometry."""
    covariance = anchor.spread(now, noise)
    status, reason = decide_live(last, silent, covariance)
    return LivePose(
        stamp=now.stamp,
        status=status,
        reason=reason,
        map_from_camera=anchor.pose(now),
        map_from_odom=anchor.map_from_odom,
        covariance=covariance,
        estimate=last.estimate,
        scene=anchor.scene,
        age=max(0.0, now.stamp - anchor.at.stamp),
    )


def _positive(matrix: Floats) -> Floats:
    """The same without negative variances: odometry that closed a loop knows its pose better again."""
    values, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
