"""Where frames were taken, in one map or in any of a library, when nobody knows: the slow question."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Camera, Floats, split_pose
from placegraph.errors import OptionError, PlacegraphError
from placegraph.indoor.likelihood.observe import check_unit, sight
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.estimate import add_earth_poses
from placegraph.indoor.pose.prior import Prior
from placegraph.indoor.pose.window import PoseQuery, Window, own_encoder, shows_something
from placegraph.indoor.status import diagnostics_of
from placegraph.indoor.track.tracker import (
    KEPT,
    PATIENCE,
    WAIT,
    Confirmation,
    Tracker,
    apart,
    look_up,
)
from placegraph.io.capture.frame import Frame

HEIGHT = 0.15
"""A told height with a larger standard deviation [m] is none: on a map of RViz there is no height."""


class SceneSource(Protocol):
    """Several scene maps by name, such as a `SceneLibrary`."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the maps."""

    def scene(self, name: str) -> Scene:
        """Return the map of a name."""

    def localize(self, capture: Sequence[Frame], **options: Any) -> PoseEstimate:  # noqa: ANN401
        """Find the map and the pose of some frames."""


@dataclass(frozen=True, eq=False)
class Relocalizer:
    """Maps in which frames are looked up.

    `known`: options, encoder and device, as of `SceneMap.localize`.
    """

    maps: Scene | SceneSource
    known: dict[str, Any]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Names of the maps; a plain map has that of its first scene."""
        return self.maps.scenes[:1] if isinstance(self.maps, Scene) else self.maps.names

    def named(self, name: str) -> str:
        """The name, or that of the only map where none is given; `OptionError` where it is none."""
        if not name and len(self.scenes) == 1:
            return self.scenes[0]
        if name not in self.scenes:
            known = ", ".join(self.scenes[:5])
            raise OptionError(f"scene is {name!r}; name one of {known or 'an empty library'}.")
        return name

    def scene(self, name: str) -> Scene:
        """Map of a name; `OptionError` where there is none, `InputError` where its file is gone."""
        return self.maps if isinstance(self.maps, Scene) else self.maps.scene(name)

    def query(self, name: str, seed: int) -> PoseQuery:
        """The question in one map."""
        return PoseQuery.of(self.scene(name), seed=seed, **self.known)

    def anywhere(self, frames: Sequence[Frame], rng: Generator) -> tuple[str, PoseEstimate]:
        """In which map the last of some frames was taken, and where; the name is empty if in none.

        Raises
        ------
        OptionError
            Nothing that the frames show can be compared.
        InputError, MapError
            An image is broken, or depth is not in metres; a map of the library is gone.

        """
        if isinstance(self.maps, Scene):
            return self.near(frames, self.scenes[0], None, rng)
        seed = int(rng.integers(1 << 31))
        estimate = self.maps.localize(frames, refine=False, seed=seed, **self.known)
        return (estimate.best.scene.partition("/")[0] if estimate.best else ""), estimate

    def near(
        self, frames: Sequence[Frame], name: str, prior: Prior | None, rng: Generator
    ) -> tuple[str, PoseEstimate]:
        """Where in one map, around a prior of the first frame if there is one; errors as `anywhere`."""
        query = replace(self.query(name, 0), prior=prior)
        encoder = query.encoder or own_encoder(query.scene, frames[-1])
        seen = [sight(frame, encoder, query.options) for frame in frames]
        if not shows_something(seen[-1]):
            raise OptionError("frame: no depth, no known labels, no colours: nothing to compare.")
        shown = [s for s in seen if shows_something(s)]
        check_unit(float(np.linalg.norm(np.ptp(query.scene.bounds, axis=0))), shown)
        window = Window(query, Scorer(query.scene, query.options.likelihood), shown)
        estimate, _ = look_up(window, rng)
        return name, add_earth_poses(query.scene, estimate)


def prior_of(map_from_camera: Floats, covariance: Floats) -> Prior:
    """A pose (4, 4) with its covariance (6, 6) as a prior; who tells a height loosely knows none."""
    (x, y, z, yaw), _ = split_pose(map_from_camera)
    spread = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    turn = min(float(np.sqrt(covariance[5, 5])), np.pi)
    height = float(z) if covariance[2, 2] < HEIGHT**2 else None
    return Prior(float(x), float(y), height, float(yaw), max(spread, 0.02), max(turn, 0.01))


STRAYED = 2
"""Frames in a row that are not sure of a followed pose, before another place is believed instead."""


@dataclass(frozen=True, slots=True, eq=False)
class GivenPose:
    """A pose that somebody told: it is looked for there first."""

    map_from_odom: Floats
    covariance: Floats
    """(6, 6) of the camera's pose."""
    scene: str


@dataclass(frozen=True, slots=True, eq=False)
class Relocalization:
    """Frames whose place nobody knows, the last of which is asked about."""

    frames: tuple[Frame, ...]
    near: GivenPose | None
    rng: Generator

    def asked(self, finder: Relocalizer) -> Relocalized:
        """Look them up; what is wrong with frames or maps is part of the answer."""
        try:
            if self.near is None:
                name, estimate = finder.anywhere(self.frames, self.rng)
            else:
                first = self.near.map_from_odom @ self.frames[0].odometry
                prior = prior_of(first, self.near.covariance)
                name, estimate = finder.near(self.frames, self.near.scene, prior, self.rng)
        except PlacegraphError as error:
            return Relocalized(self.frames, "", None, str(error))
        return Relocalized(self.frames, name, estimate, estimate.reason)


@dataclass(frozen=True, slots=True, eq=False)
class Relocalized:
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
class FrameResult:
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

    def __init__(self, finder: Relocalizer, camera: Camera | None, seed: int) -> None:
        self.finder, self.camera, self.seed = finder, camera, seed
        self._rng = np.random.default_rng(seed)
        self.begin(None)

    def begin(self, placed: GivenPose | None) -> None:
        """Forget all, but for what somebody told."""
        self._placed = placed
        self._scene, self._tracker = "", None
        self._recent: deque[Frame] = deque(maxlen=KEPT)
        self._clear()
        self._again = Confirmation()
        self._strayed = self._waited = self._denied = 0

    _tracker: Tracker | None
    _newest: Frame | None
    _fresh: bool

    @property
    def following(self) -> bool:
        """Whether a pose is followed, be it in doubt."""
        return self._tracker is not None and self._tracker.following

    def look(self, frame: Frame) -> FrameResult | None:
        """Follow a frame; None where there is nothing to follow yet."""
        if self._tracker is None or not self._tracker.following:
            self._remember(frame)
            return None
        try:
            estimate = self._tracker.update(frame)
        except PlacegraphError as error:
            return FrameResult(frame, f"Carried on by odometry: {error}")
        if estimate.status is Status.OK:
            return self._sure(frame, estimate)
        if not self._strayed:
            self._clear()  # what was before fits where the pose was known
        self._strayed += 1
        self._remember(frame)
        over = not self._tracker.following
        fits = not over and diagnostics_of(estimate).consistent
        return FrameResult(frame, estimate.reason, self._scene, estimate, told=fits, over=over)

    def question(self) -> Relocalization | None:
        """What is to be looked up now, where a pose is not known for sure and a frame is new enough."""
        known = self.following and not self._strayed
        due = self._fresh or self._waited >= WAIT
        if known or not due or self._newest is None:
            return None
        self._waited, self._fresh = 0, False
        before = [frame for frame in self._recent if frame is not self._newest][1 - KEPT :]
        return Relocalization((*before, self._newest), self._placed, self._rng.spawn(1)[0])

    def hear(self, found: Relocalized) -> FrameResult | None:
        """Take an answer over; where a pose is still followed, only one that is sure to be elsewhere."""
        last, estimate = found.frames[-1], found.estimate
        if estimate is not None and self._placed is None:  # else a person and an image say the same
            estimate = self._again.judged(found.scene, last, estimate)
        sure = estimate is not None and estimate.status is Status.OK
        if self.following and not (sure and self._strayed >= STRAYED):
            return None
        if estimate is None:
            self._clear()
            return FrameResult(last, found.reason)
        if sure:
            self._tracker, self._scene = self._taken(found), found.scene
            return self._sure(last, estimate)
        lost = estimate.status is Status.LOST
        if self._placed is not None:
            self._denied = self._denied + 1 if lost else 0
            if self._denied < PATIENCE:
                return FrameResult(last, found.reason, found.scene, found.estimate)
            self._placed, self._fresh = None, True
        # of several places none is the pose
        told = found.sure or (not lost and len(estimate.modes) == 1)
        return FrameResult(last, estimate.reason, found.scene, estimate, told=told, over=True)

    def _clear(self) -> None:
        """Forget the frames that were to be looked up."""
        self._recent.clear()
        self._newest, self._fresh = None, False

    def _sure(self, frame: Frame, estimate: PoseEstimate) -> FrameResult:
        self._clear()
        self._placed = None
        self._strayed = self._denied = 0
        return FrameResult(frame, estimate.reason, self._scene, estimate, told=True)

    def _taken(self, found: Relocalized) -> Tracker:
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
