"""Belief of a live pose: odometry, and where its frame stands in which map. No threads here."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Floats, cross_matrix
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.status import LiveState, decide_live
from placegraph.indoor.track.follower import FrameResult, GivenPose
from placegraph.indoor.track.odometry import AHEAD, KEPT, TWITCH, Odometry, Sample
from placegraph.io.capture.frame import Frame


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
        return grown + both @ _drop_negative_variances(now.covariance - self.at.covariance) @ both.T


def predict_pose(
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


def _drop_negative_variances(matrix: Floats) -> Floats:
    """The same without negative variances: odometry that closed a loop knows its pose better again."""
    values, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)


BROKEN = np.diag([0.25, 0.25, 0.01, 0.0, 0.0, 0.25])
"""Covariance that is added where odometry begins anew: half a metre, half a radian."""
NOTHING = "Nothing is known yet: no image has told where the camera is."


class Belief:
    """Where odometry's frame stands, since when, and what the last image said.

    `noise`: of odometry. `epoch` counts how often everything was begun anew: what was asked before
    is not listened to after.
    """

    def __init__(self, noise: MotionNoise) -> None:
        self.noise = noise
        self.odometry = Odometry()
        self.moved = False
        """Whether odometry comes by itself, and not with images."""
        self.late = 0
        self.epoch = 0
        self.anchor: Anchor | None = None
        self.near: GivenPose | None = None
        """Where images are to look first."""
        self._last = LiveState.lost(NOTHING)
        self._placed: tuple[Floats, Floats, str] | None = None

    @property
    def status(self) -> Status:
        """What the last image said."""
        return self._last.status

    def tell(self, stamp: float, pose: Floats, covariance: Floats | None, *, own: bool) -> bool:
        """A sample of odometry, of its `own` or an image's; whether it had to begin anew."""
        odometry, newest = self.odometry, self.odometry.newest
        jump = odometry.jumps(stamp, pose)
        if own and not self.moved and newest is not None:
            jump = "Odometry of its own came beside that of the images"
        self.moved = own
        if jump:
            self._break(jump, stamp, pose, covariance)
            return True
        if newest is not None and stamp <= newest.stamp:
            self.late += 1
            return False
        odometry.tell(stamp, pose, covariance)
        if self._placed is not None:
            self.believe(*self._placed, self._last.reason)
        return False

    def _break(self, why: str, stamp: float, pose: Floats, covariance: Floats | None) -> None:
        """Odometry goes on at another time or place: the camera is taken to be about where it was."""
        last, anchor = self.odometry.newest, self.anchor
        self.odometry.clear()
        self.odometry.tell(stamp, pose, covariance)
        if anchor is None or last is None:
            self.forget(f"{why}.")
            return
        spread = anchor.spread(last, self.noise)
        if np.linalg.norm(pose[:3, 3] - last.pose[:3, 3]) < TWITCH and stamp < last.stamp:
            here = anchor.map_from_odom @ pose  # the clock alone
        else:
            here, spread = anchor.pose(last), spread + BROKEN
        self.believe(here, spread, anchor.scene, f"{why}; it is looked for near where it was.")

    def believe(self, pose: Floats, covariance: Floats, scene: str, why: str) -> None:
        """A pose of now (4, 4) with its covariance (6, 6) that images are to confirm."""
        self.forget(why)
        now = self.odometry.newest
        if now is None:
            self._placed = pose, covariance, scene
            return
        self.anchor = Anchor.of(now, pose, covariance, scene)
        self.near = GivenPose(self.anchor.map_from_odom, covariance, scene)
        self._last = LiveState.unconfirmed(why)

    def forget(self, why: str) -> None:
        """Begin anew."""
        self.epoch += 1
        self.anchor = self.near = self._placed = None
        self._last = LiveState.lost(why)

    def carried(self, why: str) -> None:
        """An image told nothing: what was known goes on."""
        self._last = replace(self._last, reason=why)

    def placing(self, frame: Frame) -> tuple[Sample | None, str]:
        """Odometry at an image's time; or None, and why there is none."""
        sample, newest = self.odometry.at(frame.stamp), self.odometry.newest
        if sample is None or newest is None:
            return (
                None,
                f"An image of {frame.stamp:.3f} s is older than all odometry; is its clock the same?",
            )
        if frame.stamp > newest.stamp + AHEAD:
            ahead = frame.stamp - newest.stamp
            return None, f"An image is {ahead:.3g} s ahead of odometry; are their clocks the same?"
        return sample, ""

    def hear(self, said: FrameResult) -> None:
        """What an image told counts from its own time on."""
        status, estimate = self._last.status, self._last.estimate
        if said.estimate is not None:
            status, estimate = said.estimate.status, said.estimate
        newest = self.odometry.newest
        if said.told and newest is not None and estimate is not None and estimate.best is not None:
            at = self.odometry.at(said.frame.stamp) or newest
            # odometry as it was when the image was looked at
            at = at._replace(stamp=said.frame.stamp, pose=said.frame.odometry)
            best = estimate.best
            self.anchor = Anchor.of(at, best.map_from_camera, best.covariance, said.scene)
        elif said.over:
            self.anchor = None
        self._last = LiveState(status, said.reason, estimate)

    def pose(self, stamp: float | None) -> LivePose:
        """The pose at a time, or at that of the newest odometry."""
        newest = self.odometry.newest
        now = newest if stamp is None else self.odometry.at(stamp)
        last, silent = self._last, 0.0
        if stamp is not None and newest is not None:
            silent = stamp - newest.stamp
        if self.anchor is not None and now is not None:
            return predict_pose(self.anchor, now, self.noise, last, silent)
        when = now.stamp if now is not None else np.nan if stamp is None else stamp
        forgotten = ""
        if self.anchor is not None:
            forgotten = f"Odometry is remembered for {KEPT:g} s, and tells nothing of {stamp}."
        status, reason = decide_live(last, silent, None, forgotten)
        return LivePose(when, status, reason, None, None, None, last.estimate, "", np.inf)
