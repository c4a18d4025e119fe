"""Odometry of the last seconds: where the camera was in its frame at any time, and how far it went."""

from __future__ import annotations

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.geometry import Floats, rotation_from_vector, vector_from_rotation
from placegraph.errors import OptionError

KEPT = 10.0
"""Seconds remembered: an image that is later than that is of no use."""
MOST = 8192
"""Samples remembered, however fast they come."""
AHEAD = 0.25
"""A pose is foretold for so many seconds beyond the newest sample."""
JUMP = 1.0
"""Stamps that go back by less [s] are late; by more, the clock was set back.

So long may odometry be silent, too."""
FASTEST, TWITCH = 10.0, 0.5
"""No camera moves faster [m/s], beyond this [m]: odometry has begun anew."""
FARTHEST = 1e7
"""No pose is further than this [m] from the origin of its frame."""
_UNIT = np.eye(4)
_BASE = 0.1  # seconds over which speed is measured, since samples jitter


class Sample(NamedTuple):
    """Odometry at a time, and the way to there."""

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
    """Samples in order of time, interpolated; those older than `KEPT` are forgotten."""

    def __init__(self) -> None:
        self._samples: list[Sample] = []
        self._stamps: list[float] = []

    def __len__(self) -> int:
        return len(self._samples)

    @property
    def newest(self) -> Sample | None:
        """The last sample; None where there is none."""
        return self._samples[-1] if self._samples else None

    @property
    def oldest(self) -> float:
        """Stamp from which on it is remembered; infinite where nothing is."""
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
        """Why a sample cannot follow the newest; empty where it can."""
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
        """Odometry at a time, interpolated; None before the oldest sample, or where there is none.

        Beyond the newest sample the camera is taken to go on as it did for `AHEAD` seconds, and to
        stand then.
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
    """A sample as arrays; `OptionError` where it is no time, no rigid pose or no covariance.

    A covariance of zeros says nothing, and is left out.
    """
    if not np.isfinite(stamp):
        raise OptionError(f"stamp is {stamp}; give seconds.")
    pose = checked_pose("odom_from_camera", odom_from_camera)
    if covariance is None:
        return float(stamp), pose, None
    spread = checked_covariance("covariance", covariance)
    return float(stamp), pose, spread if spread.any() else None


def checked_pose(what: str, matrix: ArrayLike) -> Floats:
    """A rigid transform (4, 4), its own copy; `OptionError` where it is none."""
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{what}: not numbers ({error}); give a 4x4 matrix.") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise OptionError(f"{what}: shape {pose.shape}; a pose is 4x4 finite numbers.")
    if np.abs(pose).max() > FARTHEST:
        raise OptionError(f"{what}: more than {FARTHEST:g} m from its origin; it is in metres.")
    turn = pose[:3, :3]
    off = max(np.abs(turn @ turn.T - _UNIT[:3, :3]).max(), np.abs(pose[3] - _UNIT[3]).max())
    if off > 1e-3 or np.linalg.det(turn) <= 0:
        raise OptionError(f"{what}: not rigid; give a rotation and a translation, 0 0 0 1 below.")
    return pose


def checked_covariance(what: str, matrix: ArrayLike) -> Floats:
    """A covariance (6, 6), its own copy; `OptionError` where it is none."""
    try:
        spread = np.array(matrix, np.float64)
    except (TypeError, ValueError) as error:
        raise OptionError(f"{what}: not numbers ({error}); give a 6x6 matrix.") from error
    if spread.shape != (6, 6) or not np.isfinite(spread).all():
        raise OptionError(f"{what}: shape {spread.shape}; 6x6 finite numbers belong.")
    spread = 0.5 * (spread + spread.T)
    least = float(np.linalg.eigvalsh(spread)[0])
    if least < -1e-6 * max(1.0, float(np.abs(spread).max())):
        raise OptionError(f"{what}: an eigenvalue is {least:.3g}; variances are not negative.")
    return spread


def _between(a: Sample, b: Sample, stamp: float) -> Sample:
    """On the straight way from a sample to a later one, or as far beyond."""
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
