"""Tracking of one camera in one map frame by frame, and relocalization in one map or in a library."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

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
from placegraph.errors import OptionError, PlacegraphError
from placegraph.indoor.likelihood.observe import (
    FINE,
    Observation,
    ViewCache,
    check_unit,
    observe_frame,
)
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.pose.estimate import add_earth_poses, estimate_pose
from placegraph.indoor.pose.local_fit import (
    FITTED,
    NARROWEST,
    Fit,
    explore_unobservable,
    fit_level,
    fit_pose,
    fit_window,
)
from placegraph.indoor.pose.prior import Prior
from placegraph.indoor.pose.search import search
from placegraph.indoor.pose.window import (
    Chain,
    PoseQuery,
    Window,
    deviations,
    is_comparable,
    level_frames,
    make_label_encoder,
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

    def confirm(self, scene: str, frame: Frame, estimate: PoseEstimate) -> PoseEstimate:
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
        self.keyframes: deque[Observation] = deque(maxlen=KEPT)
        self._cut: ViewCache = {}
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
        observations = [self._sighted(frame) for frame in frames[-NEWEST:]]
        self.reset()
        self.keyframes.extend(observations)
        chain = Chain.of(level_frames(frames[-1:]), self.query.options.motion)
        self._accept_fit(Fit.at(chain, split_pose(map_from_camera)[0]))
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
        observation = self._sighted(frame)
        keyframe = self._is_keyframe(frame)
        estimate = self._follow(observation) if self.following else None
        if keyframe:
            self.keyframes.append(observation)
        if estimate is None:
            self._waited += 1
            due = keyframe or self._waited >= WAIT or self._answer is None
            estimate = self._search(observation) if due else self._carried(frame)
        self._last, self._answer = frame, add_earth_poses(self.query.scene, estimate)
        return self._answer

    def reset(self) -> None:
        """Forget the pose and all frames."""
        self.keyframes.clear()
        self._fit, self._last, self._answer = None, None, None
        self._cut, self._since = {}, np.zeros(4)
        self._doubts = self._waited = 0
        self._again = Confirmation()

    def _sighted(self, frame: Frame) -> Observation:
        if self.camera is not None and frame.camera != self.camera:
            raise OptionError("frame: taken by another camera than the tracker was made for.")
        if self.query.encoder is None:
            self.query = replace(self.query, encoder=make_label_encoder(self.query.scene, frame))
        observation = observe_frame(frame, self.query.encoder, self.query.options)
        if not is_comparable(observation):
            raise OptionError("frame: no depth, no known labels, no colours: nothing to compare.")
        return observation

    # ------------------------------------------------------------------------------ following

    def _follow(self, observation: Observation) -> PoseEstimate:
        """Carry the pose on and fit it; it is given up where frames have contradicted it for a while."""
        assert self._fit is not None and self._last is not None  # noqa: S101, PT018  following
        frame = observation.frame
        recent = [*list(self.keyframes)[-NEWEST + 1 :], observation]
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
        self._accept_fit(fit)
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

    def _accept_fit(self, fit: Fit) -> None:
        """Follow a fit; what was said was of where the stream began."""
        self.query = replace(self.query, description=None, shares=None)
        self._fit = fit

    def _window(self, observations: list[Observation]) -> Window:
        """A window of the stream; of frames that were in the last one, views are not cut anew."""
        self._cut = {key: view for key, view in self._cut.items() if key[0] in observations}
        return Window(self.query, self.scorer, observations, cut=self._cut)

    # ------------------------------------------------------------------------------ searching

    def _search(self, newest: Observation) -> PoseEstimate:
        """Look the keyframes, and the newest frame, up in the whole map."""
        self._waited = 0
        known = [s for s in self.keyframes if s is not newest]
        window = self._window([*known[-KEPT + 1 :], newest])
        estimate, fit = look_up(window, self.rng)
        estimate = self._again.confirm("", newest.frame, estimate)
        if estimate.status is Status.OK:
            self._doubts, self._since = 0, np.zeros(4)
            self._accept_fit(fit)
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
    poses = level_frames(frames)
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
    poses = level_frames(frames)
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
        encoder = query.encoder or make_label_encoder(query.scene, frames[-1])
        seen = [observe_frame(frame, encoder, query.options) for frame in frames]
        if not is_comparable(seen[-1]):
            raise OptionError("frame: no depth, no known labels, no colours: nothing to compare.")
        shown = [s for s in seen if is_comparable(s)]
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

    def search(self, relocalizer: Relocalizer) -> Relocalized:
        """Look them up; what is wrong with frames or maps is part of the answer."""
        try:
            if self.near is None:
                name, estimate = relocalizer.anywhere(self.frames, self.rng)
            else:
                first = self.near.map_from_odom @ self.frames[0].odometry
                prior = prior_of(first, self.near.covariance)
                name, estimate = relocalizer.near(self.frames, self.near.scene, prior, self.rng)
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
    has_pose: bool = False
    """Whether the estimate's best mode is the pose from here on."""
    is_lost: bool = False
    """Whether what was known before is not believed any more."""


class Follower:
    """Follows frames in one map, and knows when to ask in which map, and where, the camera is."""

    def __init__(self, relocalizer: Relocalizer, camera: Camera | None, seed: int) -> None:
        self.relocalizer, self.camera, self.seed = relocalizer, camera, seed
        self._rng = np.random.default_rng(seed)
        self.reset(None)

    def reset(self, given: GivenPose | None) -> None:
        """Forget all, but for what somebody told."""
        self._placed = given
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

    def follow(self, frame: Frame) -> FrameResult | None:
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
        is_lost = not self._tracker.following
        fits = not is_lost and diagnostics_of(estimate).consistent
        return FrameResult(
            frame, estimate.reason, self._scene, estimate, has_pose=fits, is_lost=is_lost
        )

    def question(self) -> Relocalization | None:
        """What is to be looked up now, where a pose is not known for sure and a frame is new enough."""
        known = self.following and not self._strayed
        due = self._fresh or self._waited >= WAIT
        if known or not due or self._newest is None:
            return None
        self._waited, self._fresh = 0, False
        before = [frame for frame in self._recent if frame is not self._newest][1 - KEPT :]
        return Relocalization((*before, self._newest), self._placed, self._rng.spawn(1)[0])

    def take_answer(self, found: Relocalized) -> FrameResult | None:
        """Take an answer over; where a pose is still followed, only one that is sure to be elsewhere."""
        last, estimate = found.frames[-1], found.estimate
        if estimate is not None and self._placed is None:  # else a person and an image say the same
            estimate = self._again.confirm(found.scene, last, estimate)
        sure = estimate is not None and estimate.status is Status.OK
        if self.following and not (sure and self._strayed >= STRAYED):
            return None
        if estimate is None:
            self._clear()
            return FrameResult(last, found.reason)
        if sure:
            self._tracker, self._scene = self._start_tracker(found), found.scene
            return self._sure(last, estimate)
        lost = estimate.status is Status.LOST
        if self._placed is not None:
            self._denied = self._denied + 1 if lost else 0
            if self._denied < PATIENCE:
                return FrameResult(last, found.reason, found.scene, found.estimate)
            self._placed, self._fresh = None, True
        # of several places none is the pose
        has_pose = found.sure or (not lost and len(estimate.modes) == 1)
        return FrameResult(
            last, estimate.reason, found.scene, estimate, has_pose=has_pose, is_lost=True
        )

    def _clear(self) -> None:
        """Forget the frames that were to be looked up."""
        self._recent.clear()
        self._newest, self._fresh = None, False

    def _sure(self, frame: Frame, estimate: PoseEstimate) -> FrameResult:
        self._clear()
        self._placed = None
        self._strayed = self._denied = 0
        return FrameResult(frame, estimate.reason, self._scene, estimate, has_pose=True)

    def _start_tracker(self, found: Relocalized) -> Tracker:
        """A tracker that follows from what was found."""
        assert found.estimate is not None and found.estimate.best is not None  # noqa: S101, PT018  sure
        tracker = Tracker(self.relocalizer.query(found.scene, self.seed), self.camera)
        tracker.start(found.frames, found.estimate.best.map_from_camera)
        return tracker

    def _remember(self, frame: Frame) -> None:
        """Keep a frame that is far enough from the last, to be looked up with it."""
        self._waited += 1
        self._newest = frame
        if not self._recent or apart(self._recent[-1], frame):
            self._recent.append(frame)
            self._fresh = True
