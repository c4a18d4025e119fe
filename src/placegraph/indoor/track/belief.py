"""Belief of a live pose: odometry of the last seconds, and the pose of its frame in a map."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import (
    Floats,
    cross_matrix,
    rotation_from_vector,
    vector_from_rotation,
)
from placegraph.errors import OptionError
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.status import LiveState, decide_live
from placegraph.indoor.track.tracker import FrameResult, GivenPose
from placegraph.io.capture.frame import Frame

KEPT = 10.0
"""Seconds of odometry that are kept: later images are of no use."""
MOST = 8192
"""Largest number of samples."""
AHEAD = 0.25
"""Seconds of extrapolation beyond the newest sample."""
JUMP = 1.0
"""Stamps that go back by less [s] are late; by more, the clock was set back.

So long may odometry be silent, too."""
FASTEST, TWITCH = 10.0, 0.5
"""Largest speed [m/s] and jitter [m] of a camera; beyond, odometry was restarted."""
FARTHEST = 1e7
"""No pose is further than this [m] from the origin of its frame."""
_UNIT = np.eye(4)
_BASE = 0.1  # seconds over which speed is measured, since samples jitter


class Sample(NamedTuple):
    """Odometry at a time, with the way travelled."""

    stamp: float
    pose: Floats
    """(4, 4) odom_from_camera [m]"""
    way: float
    """Metres gone since the first sample ..."""
    turned: float
    """... and radians turned."""
    covariance: Floats | None
    """(6, 6) of the pose in odometry's frame, as odometry itself says; it is of the whole way."""


class Odometry:
    """Odometry buffer: samples in order of time, interpolated; older ones than `KEPT` are dropped."""

    def __init__(self) -> None:
        self._samples: list[Sample] = []
        self._stamps: list[float] = []

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def newest(self) -> Sample | None:
        """Return the last sample; None: there is none."""
        return self._samples[-1] if self._samples else None

    @property
    def oldest(self) -> float:
        """Return the stamp of the oldest sample; infinite: there is none."""
        return self._stamps[0] if self._stamps else np.inf

    def clear(self) -> None:
        """Forget all."""
        self._samples.clear()
        self._stamps.clear()

    def tell(self, stamp: float, pose: Floats, covariance: Floats | None = None) -> None:
        """Add a sample that is newer than all others; a pose is (4, 4), a covariance (6, 6)."""
        way, turned = 0.0, 0.0
        if self._samples:
            last = self._samples[-1]
            way = last.way + float(np.linalg.norm(pose[:3, 3] - last.pose[:3, 3]))
            turned = last.turned + _angle(last.pose[:3, :3].T @ pose[:3, :3])
        self._samples.append(Sample(stamp, pose, way, turned, covariance))
        self._stamps.append(stamp)
        if stamp - self._stamps[0] > 2.0 * KEPT or len(self._samples) > MOST:
            gone = max(bisect_right(self._stamps, stamp - KEPT) - 1, len(self._samples) - MOST // 2)
            del self._samples[:gone], self._stamps[:gone]

    def jumps(self, stamp: float, pose: Floats) -> str:
        """Return why a sample cannot follow the newest; empty: it can."""
        last = self.newest
        if last is None:
            return ""
        if stamp < last.stamp - JUMP:
            return f"The clock of odometry went back by {last.stamp - stamp:.3g} s"
        gone = float(np.linalg.norm(pose[:3, 3] - last.pose[:3, 3]))
        if gone > TWITCH + FASTEST * max(stamp - last.stamp, 0.0):
            return f"Odometry jumped by {gone:.3g} m"
        return ""

    def at(self, stamp: float) -> Sample | None:
        """Interpolate odometry at a time; None: before the oldest sample.

        Beyond the newest sample motion is extrapolated for `AHEAD` seconds, and stops then.
        """
        after = bisect_right(self._stamps, stamp)
        if after == 0:
            return None
        before = self._samples[after - 1]
        if before.stamp == stamp or len(self._samples) == 1:
            return before
        if after < len(self._samples):
            return _between(before, self._samples[after], stamp)
        base = min(bisect_right(self._stamps, before.stamp - _BASE), after - 2)
        return _between(self._samples[base], before, min(stamp, before.stamp + AHEAD))


def checked_odometry(
    stamp: float, odom_from_camera: ArrayLike, covariance: ArrayLike | None
) -> tuple[float, Floats, Floats | None]:
    """Check a sample; raises `OptionError` for a bad time, pose or covariance.

    A covariance of zeros becomes None.
    """
    if not np.isfinite(stamp):
        raise OptionError(f"stamp is {stamp}; give seconds.")
    pose = checked_pose("odom_from_camera", odom_from_camera)
    if covariance is None:
        return float(stamp), pose, None
    spread = checked_covariance("covariance", covariance)
    return float(stamp), pose, spread if spread.any() else None


def checked_pose(what: str, matrix: ArrayLike) -> Floats:
    """Copy a rigid transform (4, 4); raises `OptionError` if it is none."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{what}: not numbers ({error}); give a 4x4 matrix.") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise OptionError(f"{what}: shape is {pose.shape}, expected 4x4 finite numbers.")
    if np.abs(pose).max() > FARTHEST:
        raise OptionError(f"{what}: it is more than {FARTHEST:g} m from the origin; give metres.")
    turn = pose[:3, :3]
    off = max(np.abs(turn @ turn.T - _UNIT[:3, :3]).max(), np.abs(pose[3] - _UNIT[3]).max())
    if off > 1e-3 or np.linalg.det(turn) <= 0:
        raise OptionError(
            f"{what}: the matrix is not rigid; give a rotation and a translation, with last row "
            "0 0 0 1."
        )
    return pose


def checked_covariance(what: str, matrix: ArrayLike) -> Floats:
    """Copy a covariance (6, 6); raises `OptionError` if it is none."""
    try:
        spread = np.array(matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{what}: not numbers ({error}); give a 6x6 matrix.") from error
    if spread.shape != (6, 6) or not np.isfinite(spread).all():
        raise OptionError(f"{what}: shape is {spread.shape}, expected 6x6 finite numbers.")
    spread = 0.5 * (spread + spread.T)
    least = float(np.linalg.eigvalsh(spread)[0])
    if least < -1e-6 * max(1.0, float(np.abs(spread).max())):
        raise OptionError(f"{what}: an eigenvalue is {least:.3g}; variances must not be negative.")
    return spread


def _between(a: Sample, b: Sample, stamp: float) -> Sample:
    """Interpolate between two samples, or extrapolate beyond."""
    share = (stamp - a.stamp) / (b.stamp - a.stamp)
    pose = np.eye(4)
    step = vector_from_rotation(a.pose[:3, :3].T @ b.pose[:3, :3])
    pose[:3, :3] = a.pose[:3, :3] @ rotation_from_vector(share * step)
    pose[:3, 3] = a.pose[:3, 3] + share * (b.pose[:3, 3] - a.pose[:3, 3])
    covariance = None
    if a.covariance is not None and b.covariance is not None:
        covariance = a.covariance + min(share, 1.0) * (b.covariance - a.covariance)
    return Sample(
        stamp,
        pose,
        a.way + share * (b.way - a.way),
        a.turned + share * (b.turned - a.turned),
        covariance,
    )


def _angle(rotation: Floats) -> float:
    return float(np.arccos(np.clip(0.5 * (np.trace(rotation) - 1.0), -1.0, 1.0)))


@dataclass(frozen=True, slots=True, eq=False)
class LivePose:
    """Pose of the camera at a time, with status and covariance."""

    stamp: float
    """[s]"""
    status: Status
    """Status of the last image; `AMBIGUOUS` after too long by odometry alone."""
    reason: str
    """One sentence: why."""
    map_from_camera: Floats | None
    """(4, 4) [m]; None: unknown, or several places fit (`estimate.modes`)."""
    map_from_odom: Floats | None
    """(4, 4) pose of odometry's frame in the map, which images correct."""
    covariance: Floats | None
    """(6, 6) of `map_from_camera`, as `PoseMode.covariance`."""
    estimate: PoseEstimate | None = field(repr=False)
    """Estimate of the last image."""
    scene: str
    """Name of the map; of a plain map that of its (first) scene. Empty: unknown."""
    age: float
    """Seconds since an image or a person gave the pose; infinite: never."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and strings, without the estimate."""
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
    """Pose of odometry's frame in a map, as of a time."""

    at: Sample
    """Odometry at that time."""
    map_from_odom: Floats
    covariance: Floats
    """(6, 6) of the camera's pose at that time."""
    scene: str

    @classmethod
    def of(cls, at: Sample, map_from_camera: Floats, covariance: Floats, scene: str) -> Anchor:
        """Make an anchor of a pose of the camera (4, 4) with its covariance (6, 6)."""
        return cls(at, map_from_camera @ np.linalg.inv(at.pose), covariance, scene)

    def pose(self, now: Sample) -> Floats:
        """Return map_from_camera (4, 4) at a sample."""
        return self.map_from_odom @ now.pose

    def spread(self, now: Sample, noise: MotionNoise) -> Floats:
        """Return the covariance (6, 6) of that: it grows by way, turn, time and odometry's own covariance.

        An uncertain turn swings the way since.
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
    """Drop negative variances: after closing a loop odometry is more certain again."""
    values, axes = np.linalg.eigh(matrix)
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)


BROKEN = np.diag([0.25, 0.25, 0.01, 0.0, 0.0, 0.25])
"""Covariance that is added when odometry restarts: half a metre, half a radian."""
NOTHING = "The pose is unknown: no image has been localized yet."


class Belief:
    """Belief: pose of odometry's frame in a map, and the state of the last image.

    `noise`: of odometry. `epoch` counts restarts: answers to earlier requests do not count.
    """

    def __init__(self, noise: MotionNoise) -> None:
        self.noise = noise
        self.odometry = Odometry()
        self.moved = False
        """Whether odometry comes apart from images."""
        self.late = 0
        self.epoch = 0
        self.anchor: Anchor | None = None
        self.near: GivenPose | None = None
        """Pose around which images are searched first."""
        self._last = LiveState.make_lost(NOTHING)
        self._placed: tuple[Floats, Floats, str] | None = None

    @property
    def status(self) -> Status:
        """Return the status of the last image."""
        return self._last.status

    def tell(self, stamp: float, pose: Floats, covariance: Floats | None, *, own: bool) -> bool:
        """Add a sample of odometry, `own` or of an image; return whether odometry restarted."""
        odometry, newest = self.odometry, self.odometry.newest
        jump = odometry.jumps(stamp, pose)
        if own and not self.moved and newest is not None:
            jump = "Separate odometry arrived in addition to that of the images"
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
        """Restart odometry at another time or place: the camera stays about where it was."""
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
        self.believe(
            here, spread, anchor.scene, f"{why}; the camera is searched near its last pose."
        )

    def believe(self, pose: Floats, covariance: Floats, scene: str, why: str) -> None:
        """Set the current pose (4, 4) with its covariance (6, 6), which images must confirm."""
        self.forget(why)
        now = self.odometry.newest
        if now is None:
            self._placed = pose, covariance, scene
            return
        self.anchor = Anchor.of(now, pose, covariance, scene)
        self.near = GivenPose(self.anchor.map_from_odom, covariance, scene)
        self._last = LiveState.make_unconfirmed(why)

    def forget(self, why: str) -> None:
        """Forget the pose."""
        self.epoch += 1
        self.anchor = self.near = self._placed = None
        self._last = LiveState.make_lost(why)

    def keep_pose(self, why: str) -> None:
        """Keep the pose after an image without a result."""
        self._last = replace(self._last, reason=why)

    def find_odometry(self, frame: Frame) -> tuple[Sample | None, str]:
        """Return odometry at an image's time; or None, and the reason."""
        sample, newest = self.odometry.at(frame.stamp), self.odometry.newest
        if sample is None or newest is None:
            return (
                None,
                f"An image at {frame.stamp:.3f} s is older than all odometry; check their clocks.",
            )
        if frame.stamp > newest.stamp + AHEAD:
            ahead = frame.stamp - newest.stamp
            return None, (
                f"An image is {ahead:.3g} s ahead of odometry; check that both use the same clock."
            )
        return sample, ""

    def update(self, result: FrameResult) -> None:
        """Update the belief by the result of an image, from its own time on."""
        status, estimate = self._last.status, self._last.estimate
        if result.estimate is not None:
            status, estimate = result.estimate.status, result.estimate
        newest = self.odometry.newest
        if (
            result.has_pose
            and newest is not None
            and estimate is not None
            and estimate.best is not None
        ):
            at = self.odometry.at(result.frame.stamp) or newest
            # odometry as it was when the image was looked at
            at = at._replace(stamp=result.frame.stamp, pose=result.frame.odometry)
            best = estimate.best
            self.anchor = Anchor.of(at, best.map_from_camera, best.covariance, result.scene)
        elif result.is_lost:
            self.anchor = None
        self._last = LiveState(status, result.reason, estimate)

    def pose(self, stamp: float | None) -> LivePose:
        """Return the pose at a time, or at that of the newest odometry."""
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
            forgotten = f"Odometry is buffered for {KEPT:g} s, but {stamp} is older."
        status, reason = decide_live(last, silent, None, forgotten)
        return LivePose(when, status, reason, None, None, None, last.estimate, "", np.inf)
