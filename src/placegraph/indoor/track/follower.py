"""What becomes of a frame: it is followed, doubted, looked up, and what was found is taken over.

No threads and no clock here: `live` says when frames come, and where the slow question is asked.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Camera, Floats
from placegraph.errors import PlacegraphError
from placegraph.indoor.status import diagnostics_of
from placegraph.indoor.track.again import Again
from placegraph.indoor.track.finder import Finder, prior_of
from placegraph.indoor.track.tracker import KEPT, PATIENCE, WAIT, Tracker, apart
from placegraph.io.capture.frame import Frame

STRAYED = 2
"""Frames in a row that are not sure of a followed pose, before another place is believed instead."""


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A pose that somebody told: it is looked for there first."""

    map_from_odom: Floats
    covariance: Floats
    """(6, 6) of the camera's pose."""
    scene: str


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """Frames whose place nobody knows, the last of which is asked about."""

    frames: tuple[Frame, ...]
    near: Placed | None
    rng: Generator

    def asked(self, finder: Finder) -> Found:
        """Look them up; what is wrong with frames or maps is part of the answer."""
        try:
            if self.near is None:
                name, estimate = finder.anywhere(self.frames, self.rng)
            else:
                first = self.near.map_from_odom @ self.frames[0].odometry
                prior = prior_of(first, self.near.covariance)
                name, estimate = finder.near(self.frames, self.near.scene, prior, self.rng)
        except PlacegraphError as error:
            return Found(self.frames, "", None, str(error))
        return Found(self.frames, name, estimate, estimate.reason)


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """The answer to a question."""

    frames: tuple[Frame, ...]
    scene: str
    estimate: PoseEstimate | None
    """None where they could not be compared."""
    reason: str

    @property
    def sure(self) -> bool:
        """Whether one place fits."""
        return self.estimate is not None and self.estimate.status is Status.OK


@dataclass(frozen=True, slots=True, eq=False)
class Said:
    """What a frame has told."""

    frame: Frame
    reason: str
    scene: str = ""
    estimate: PoseEstimate | None = None
    """None: it showed nothing, and what was known is carried on."""
    told: bool = False
    """Whether the estimate's best mode is the pose from here on."""
    over: bool = False
    """Whether what was known before is not believed any more."""


class Follower:
    """Follows frames in one map, and knows when to ask in which map, and where, the camera is."""

    def __init__(self, finder: Finder, camera: Camera | None, seed: int) -> None:
        self.finder, self.camera, self.seed = finder, camera, seed
        self._rng = np.random.default_rng(seed)
        self.begin(None)

    def begin(self, placed: Placed | None) -> None:
        """Forget all, but for what somebody told."""
        self._placed = placed
        self._scene, self._tracker = "", None
        self._recent: deque[Frame] = deque(maxlen=KEPT)
        self._clear()
        self._again = Again()
        self._strayed = self._waited = self._denied = 0

    _tracker: Tracker | None
    _newest: Frame | None
    _fresh: bool

    @property
    def following(self) -> bool:
        """Whether a pose is followed, be it in doubt."""
        return self._tracker is not None and self._tracker.following

    def look(self, frame: Frame) -> Said | None:
        """Follow a frame; None where there is nothing to follow yet."""
        if self._tracker is None or not self._tracker.following:
            self._remember(frame)
            return None
        try:
            estimate = self._tracker.update(frame)
        except PlacegraphError as error:
            return Said(frame, f"Carried on by odometry: {error}")
        if estimate.status is Status.OK:
            return self._sure(frame, estimate)
        if not self._strayed:
            self._clear()  # what was before fits where the pose was known
        self._strayed += 1
        self._remember(frame)
        over = not self._tracker.following
        fits = not over and diagnostics_of(estimate).consistent
        return Said(frame, estimate.reason, self._scene, estimate, told=fits, over=over)

    def question(self) -> Question | None:
        """What is to be looked up now, where a pose is not known for sure and a frame is new enough."""
        known = self.following and not self._strayed
        due = self._fresh or self._waited >= WAIT
        if known or not due or self._newest is None:
            return None
        self._waited, self._fresh = 0, False
        before = [frame for frame in self._recent if frame is not self._newest][1 - KEPT :]
        return Question((*before, self._newest), self._placed, self._rng.spawn(1)[0])

    def hear(self, found: Found) -> Said | None:
        """Take an answer over; where a pose is still followed, only one that is sure to be elsewhere."""
        last, estimate = found.frames[-1], found.estimate
        if estimate is not None and self._placed is None:  # else a person and an image say the same
            estimate = self._again.judged(found.scene, last, estimate)
        sure = estimate is not None and estimate.status is Status.OK
        if self.following and not (sure and self._strayed >= STRAYED):
            return None
        if estimate is None:
            self._clear()
            return Said(last, found.reason)
        if sure:
            self._tracker, self._scene = self._taken(found), found.scene
            return self._sure(last, estimate)
        lost = estimate.status is Status.LOST
        if self._placed is not None:
            self._denied = self._denied + 1 if lost else 0
            if self._denied < PATIENCE:
                return Said(last, found.reason, found.scene, found.estimate)
            self._placed, self._fresh = None, True
        # of several places none is the pose
        told = found.sure or (not lost and len(estimate.modes) == 1)
        return Said(last, estimate.reason, found.scene, estimate, told=told, over=True)

    def _clear(self) -> None:
        """Forget the frames that were to be looked up."""
        self._recent.clear()
        self._newest, self._fresh = None, False

    def _sure(self, frame: Frame, estimate: PoseEstimate) -> Said:
        self._clear()
        self._placed = None
        self._strayed = self._denied = 0
        return Said(frame, estimate.reason, self._scene, estimate, told=True)

    def _taken(self, found: Found) -> Tracker:
        """A tracker that follows from what was found."""
        assert found.estimate is not None and found.estimate.best is not None  # noqa: S101, PT018  sure
        tracker = Tracker(self.finder.query(found.scene, self.seed), self.camera)
        tracker.start(found.frames, found.estimate.best.map_from_camera)
        return tracker

    def _remember(self, frame: Frame) -> None:
        """Keep a frame that is far enough from the last, to be looked up with it."""
        self._waited += 1
        self._newest = frame
        if not self._recent or apart(self._recent[-1], frame):
            self._recent.append(frame)
            self._fresh = True
