"""One frame at a time: the same algorithm for a robot that wants a pose now, and again soon."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import (
    Camera,
    Floats,
    between,
    compose,
    level_from_camera,
    pose_matrix,
    split_pose,
    wrap,
)
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.observe import FINE, Cut, Sighting, sight
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.pose.chain import Chain
from placegraph.indoor.pose.covariance import FITTED
from placegraph.indoor.pose.estimate import estimate_pose
from placegraph.indoor.pose.motion import deviations
from placegraph.indoor.pose.placed import placed
from placegraph.indoor.pose.polish import NARROWEST, Fit, refine, round_of
from placegraph.indoor.pose.query import PoseQuery, leveled
from placegraph.indoor.pose.window import Window, own_encoder, shows_something
from placegraph.indoor.status import decide_followed, diagnostics_of, give_up
from placegraph.indoor.track.again import Again
from placegraph.indoor.track.finder import look_up
from placegraph.io.capture.frame import Frame

KEPT = 10
"""Keyframes remembered: what a search after the camera was lost has to go by."""
NEWEST = 4
"""Newest of them that the pose is fitted to while it is known."""
ROUNDS, SAMPLES = 2, 40
"""Of the fit to a new frame."""
DOUBT = 2.0
"""Errors of a step, in units of the noise that is allowed for, that are reckoned with."""
NEAREST, FARTHEST = 2.0 * NARROWEST, 12.0 * NARROWEST
"""Bounds of how widely its samples are spread."""
APART, TURNED = 0.15, 0.12
"""A new keyframe is this far on [m], or turned by this much [rad]."""
WAIT = 5
"""Frames after which a camera that stands still, and is lost, is looked up again."""
PATIENCE = 3
"""Frames that may contradict the pose before it is given up."""


class Tracker:
    """Localizes a stream of frames in one map; time and memory a frame are bounded.

    Until the pose is known, the newest keyframes are looked up in the visibility table and polished
    together, until two answers agree; then the pose is carried on by odometry and fitted to the last
    keyframes. Where these fit, but are too bare to tell a place alone, it stays known by where it was,
    ever more loosely; a pose that they contradict for a while is given up, and searched for anew.

    Parameters
    ----------
    query
        What is asked, without frames; its description and shares are of where the stream begins, and
        forgotten once the pose is known.
    camera
        Camera of the frames; frames of another are refused.

    Raises
    ------
    OptionError
        The options are of a recipe that cannot be followed frame by frame (`FilterOptions.tracked`).

    """

    def __init__(self, query: PoseQuery, camera: Camera | None = None) -> None:
        if not query.options.tracked:
            raise OptionError(
                "options: a tracker starts from the table and fits; give start='table' and "
                "answer='fit', or localize the whole capture."
            )
        self.query = query
        self.camera = camera
        self.rng = np.random.default_rng(query.seed)
        self.scorer = Scorer(query.scene, query.options.likelihood)
        self.keyframes: deque[Sighting] = deque(maxlen=KEPT)
        self._cut: Cut = {}
        self._again = Again()
        self._since = np.zeros(4)
        self._fit: Fit | None = None
        self._last: Frame | None = None
        self._answer: PoseEstimate | None = None
        self._doubts = 0
        self._waited = 0

    @property
    def following(self) -> bool:
        """Whether the pose is known."""
        return self._fit is not None

    def start(self, frames: Sequence[Frame], map_from_camera: Floats) -> None:
        """Follow from the pose (4, 4) of the last of some frames, found elsewhere; the rest is forgotten.

        Raises `OptionError` and `InputError` as `update` does.
        """
        sightings = [self._sighted(frame) for frame in frames[-NEWEST:]]
        self.reset()
        self.keyframes.extend(sightings)
        chain = Chain.of(leveled(frames[-1:]), self.query.options.motion)
        self._settle(Fit.at(chain, split_pose(map_from_camera)[0]))
        self._last = frames[-1]

    def update(self, frame: Frame) -> PoseEstimate:
        """Estimate of this frame's pose.

        Raises
        ------
        OptionError
            The frame is of another camera; it has nothing that can be compared with the map.
        InputError
            Its images are broken; the tracker is as it was before.

        """
        sighting = self._sighted(frame)
        keyframe = self._is_keyframe(frame)
        estimate = self._follow(sighting) if self.following else None
        if keyframe:
            self.keyframes.append(sighting)
        if estimate is None:
            self._waited += 1
            due = keyframe or self._waited >= WAIT or self._answer is None
            estimate = self._search(sighting) if due else self._carried(frame)
        self._last, self._answer = frame, placed(self.query.scene, estimate)
        return self._answer

    def reset(self) -> None:
        """Forget the pose and all frames."""
        self.keyframes.clear()
        self._fit, self._last, self._answer = None, None, None
        self._cut, self._since = {}, np.zeros(4)
        self._doubts = self._waited = 0
        self._again = Again()

    def _sighted(self, frame: Frame) -> Sighting:
        if self.camera is not None and frame.camera != self.camera:
            raise OptionError("frame: taken by another camera than the tracker was made for.")
        if self.query.encoder is None:
            self.query = replace(self.query, encoder=own_encoder(self.query.scene, frame))
        sighting = sight(frame, self.query.encoder, self.query.options)
        if not shows_something(sighting):
            raise OptionError("frame: no depth, no known labels, no colours: nothing to compare.")
        return sighting

    # ------------------------------------------------------------------------------ following

    def _follow(self, sighting: Sighting) -> PoseEstimate:
        """Carry the pose on and fit it; it is given up where frames have contradicted it for a while."""
        assert self._fit is not None and self._last is not None  # noqa: S101, PT018  following
        frame = sighting.frame
        recent = [*list(self.keyframes)[-NEWEST + 1 :], sighting]
        window = self._window(recent)
        step = _steps([self._last, frame])[1]
        erred = DOUBT * deviations(step, self.query.options.motion)
        spread = np.clip(np.hypot(self._fit.spread, erred), NEAREST, FARTHEST)
        level = round_of(window, FINE, rounds=ROUNDS, samples=SAMPLES)
        fit = refine(self.scorer, compose(self._fit.pose, step), spread, level, self.rng)
        estimate = self._believed(estimate_pose(window, [fit]), erred)
        consistent = diagnostics_of(estimate).consistent
        against = estimate.status is not Status.OK and not consistent
        self._doubts = self._doubts + 1 if against else 0
        if self._doubts >= PATIENCE:
            self._fit, self._doubts = None, 0
            self.keyframes.clear()  # they led to a wrong belief
            return give_up(estimate)
        self._settle(fit)
        return estimate

    def _believed(self, estimate: PoseEstimate, erred: Floats) -> PoseEstimate:
        """What is known by where the camera was: frames too bare to tell a place do not deny one.

        `erred`: (4,) standard deviations of the last step. They add up until frames tell the place
        by themselves, or the pose is known too loosely.
        """
        if estimate.status is Status.OK:
            self._since = np.zeros(4)
            return estimate
        if not diagnostics_of(estimate).consistent:
            return estimate
        self._since = self._since + erred**2
        best = estimate.modes[0]
        covariance = best.covariance.copy()
        covariance[FITTED, FITTED] += self._since
        return decide_followed(estimate, replace(best, covariance=covariance))

    def _settle(self, fit: Fit) -> None:
        """Follow a fit; what was said was of where the stream began."""
        self.query = replace(self.query, description=None, shares=None)
        self._fit = fit

    def _window(self, sightings: list[Sighting]) -> Window:
        """A window of the stream; of frames that were in the last one, views are not cut anew."""
        self._cut = {key: view for key, view in self._cut.items() if key[0] in sightings}
        return Window(self.query, self.scorer, sightings, cut=self._cut)

    # ------------------------------------------------------------------------------ searching

    def _search(self, newest: Sighting) -> PoseEstimate:
        """Look the keyframes, and the newest frame, up in the whole map."""
        self._waited = 0
        known = [s for s in self.keyframes if s is not newest]
        window = self._window([*known[-KEPT + 1 :], newest])
        estimate, fit = look_up(window, self.rng)
        estimate = self._again.judged("", newest.frame, estimate)
        if estimate.status is Status.OK:
            self._doubts, self._since = 0, np.zeros(4)
            self._settle(fit)
        return estimate

    def _carried(self, frame: Frame) -> PoseEstimate:
        """The last answer, carried on by odometry: a frame too near the last to tell more."""
        assert self._answer is not None and self._last is not None  # noqa: S101, PT018
        if not self._answer.modes:
            return self._answer
        step = _steps([self._last, frame])[1]
        level = level_from_camera(frame.gravity)
        modes = []
        for mode in self._answer.modes:
            pose = compose(mode.pose, step)
            matrix = pose_matrix(pose, level)
            into = mode.scene_from_camera @ np.linalg.inv(mode.map_from_camera)
            modes.append(
                replace(mode, pose=pose, map_from_camera=matrix, scene_from_camera=into @ matrix)
            )
        return replace(
            self._answer,
            modes=tuple(modes),
            trajectory=modes[0].map_from_camera[None],
            frames=np.array([frame.index]),
        )

    def _is_keyframe(self, frame: Frame) -> bool:
        return not self.keyframes or apart(self.keyframes[-1].frame, frame)


def apart(frame: Frame, later: Frame) -> bool:
    """Whether a frame is far enough from another to be a keyframe beside it."""
    step = _steps([frame, later])[1]
    return bool(np.linalg.norm(step[:3]) >= APART or abs(wrap(step[3])) >= TURNED)


def _steps(frames: Sequence[Frame]) -> Floats:
    """(T, 4), step t from frame t - 1 to frame t; the first is none."""
    poses = leveled(frames)
    steps = np.zeros_like(poses)
    steps[1:] = between(poses[:-1], poses[1:])
    return steps
