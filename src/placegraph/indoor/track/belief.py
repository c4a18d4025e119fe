"""What is believed of the pose: odometry, and where its frame stands in which map. No threads here."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from placegraph.core.estimate import Status
from placegraph.core.geometry import Floats
from placegraph.indoor.options import MotionNoise
from placegraph.indoor.status import LiveState, decide_live
from placegraph.indoor.track.follower import Placed, Said
from placegraph.indoor.track.live_pose import Anchor, LivePose, predicted
from placegraph.indoor.track.odometry import AHEAD, KEPT, TWITCH, Odometry, Sample
from placegraph.io.capture.frame import Frame

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
        self.near: Placed | None = None
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
        self.near = Placed(self.anchor.map_from_odom, covariance, scene)
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

    def hear(self, said: Said) -> None:
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
            return predicted(self.anchor, now, self.noise, last, silent)
        when = now.stamp if now is not None else np.nan if stamp is None else stamp
        forgotten = ""
        if self.anchor is not None:
            forgotten = f"Odometry is remembered for {KEPT:g} s, and tells nothing of {stamp}."
        status, reason = decide_live(last, silent, None, forgotten)
        return LivePose(when, status, reason, None, None, None, last.estimate, "", np.inf)
