"""Tracking of one camera in one map, frame by frame, or over a capture too long to be fitted together."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import (
    Camera,
    Floats,
    between,
    compose,
    level_from_camera,
    pose_matrix,
    split_pose,
    vector_from_rotation,
    wrap_angle,
)
from placegraph.errors import OptionError
from placegraph.indoor.likelihood.observe import FINE, Cut, Sighting, sight
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.pose.covariance import FITTED, explore_unobservable
from placegraph.indoor.pose.estimate import add_earth_poses, estimate_pose
from placegraph.indoor.pose.local_fit import NARROWEST, Fit, fit_level, fit_pose, fit_window
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import (
    Chain,
    PoseQuery,
    Window,
    deviations,
    leveled,
    own_encoder,
    shows_something,
)
from placegraph.indoor.status import await_confirmation, decide_followed, diagnostics_of, give_up
from placegraph.io.capture.frame import Frame

SAME_WAY, SAME_TURN = 0.3, 0.17
"""Two poses are of one place where they are no further apart [m, rad]."""


class Confirmation:
    """Judges what is found in a whole map: one image may fit an alias, such as wallpaper that repeats.

    A place counts when the next answer that is sure finds it where odometry has come to since.
    """

    def __init__(self) -> None:
        self._before: tuple[str, Floats] | None = None

    def judged(self, scene: str, frame: Frame, estimate: PoseEstimate) -> PoseEstimate:
        """The estimate of a frame's pose in a scene; where it was found first, `AMBIGUOUS`."""
        best = estimate.best
        if estimate.status is not Status.OK or best is None:
            return estimate
        found = best.map_from_camera
        before, self._before = self._before, (scene, found @ np.linalg.inv(frame.odometry))
        if (
            before is not None
            and before[0] == scene
            and _is_same_place(before[1] @ frame.odometry, found)
        ):
            return estimate
        return await_confirmation(estimate)


def _is_same_place(pose: Floats, other: Floats) -> bool:
    """Whether two poses (4, 4) are of one place."""
    apart = np.linalg.norm(pose[:3, 3] - other[:3, 3])
    turned = np.linalg.norm(vector_from_rotation(pose[:3, :3].T @ other[:3, :3]))
    return bool(apart <= SAME_WAY and turned <= SAME_TURN)


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


def look_up(window: Window, rng: Generator) -> tuple[PoseEstimate, Fit]:
    """Estimate of a window's last frame in the whole map, or around the query's prior, and its best fit."""
    seeds = search(window, rng)
    fits = explore_unobservable(window, fit_window(window, seeds, rng), rng)
    return estimate_pose(window, fits), fits[0]


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
        self._again = Confirmation()
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
        self._last, self._answer = frame, add_earth_poses(self.query.scene, estimate)
        return self._answer

    def reset(self) -> None:
        """Forget the pose and all frames."""
        self.keyframes.clear()
        self._fit, self._last, self._answer = None, None, None
        self._cut, self._since = {}, np.zeros(4)
        self._doubts = self._waited = 0
        self._again = Confirmation()

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
        level = fit_level(window, FINE, rounds=ROUNDS, samples=SAMPLES)
        fit = fit_pose(self.scorer, compose(self._fit.pose, step), spread, level, self.rng)
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
    return bool(np.linalg.norm(step[:3]) >= APART or abs(wrap_angle(step[3])) >= TURNED)


def _steps(frames: Sequence[Frame]) -> Floats:
    """(T, 4), step t from frame t - 1 to frame t; the first is none."""
    poses = leveled(frames)
    steps = np.zeros_like(poses)
    steps[1:] = between(poses[:-1], poses[1:])
    return steps


def track_capture(tracker: Tracker, frames: Sequence[Frame]) -> PoseEstimate:
    """The last pose of a long capture, and a trajectory of poses as they were known.

    Frames before the pose was first known are led back from there by odometry.
    """
    if tracker.query.prior is not None:
        raise OptionError(
            f"prior: a capture of {len(frames)} frames is tracked, which starts without one; "
            "choose fewer frames."
        )
    known: list[Floats | None] = []
    for i, frame in enumerate(frames):
        estimate = tracker.update(frame)
        sure = estimate.status is Status.OK and estimate.best is not None
        known.append(estimate.best.map_from_camera if sure and estimate.best else None)
        if tracker.query.progress:
            tracker.query.progress("tracking", i + 1, len(frames))
    rows = [i for i, matrix in enumerate(known) if matrix is not None]
    stats = {"known": len(rows), "frames": len(frames)} | tracker.scorer.stats()
    if not rows:
        return replace(estimate, stats=stats, diagnostics=None)
    trajectory = _fill_by_odometry(known, rows, frames)
    if estimate.best is not None:
        trajectory[-1] = estimate.best.map_from_camera
    stamped = np.array([f.index for f in frames])
    return replace(estimate, trajectory=trajectory, frames=stamped, stats=stats, diagnostics=None)


def _fill_by_odometry(
    known: list[Floats | None], rows: list[int], frames: Sequence[Frame]
) -> Floats:
    """Matrices (T, 4, 4): unknown ones by odometry from the nearest known, the earlier of two."""
    poses = leveled(frames)
    out = np.empty((len(frames), 4, 4))
    for i, matrix in enumerate(known):
        if matrix is not None:
            out[i] = matrix
            continue
        near = min(rows, key=lambda r: (abs(r - i), r))
        anchor = known[near]
        assert anchor is not None  # noqa: S101  rows are known
        pose = compose(split_pose(anchor)[0], between(poses[near], poses[i]))
        out[i] = pose_matrix(pose, level_from_camera(frames[i].gravity))
    return out
