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
from placegraph.indoor.pose.covariance import FITTED, explore_unobservable
from placegraph.indoor.pose.estimate import add_earth_poses, estimate_pose
from placegraph.indoor.pose.local_fit import NARROWEST, Fit, fit_level, fit_pose, fit_window
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
"""Largest distance [m] and turn [rad] between poses of one place."""


class Confirmation:
    """Confirmation of relocalizations: one image may fit an alias, such as repeated wallpaper.

    A place counts if the next answer that is `OK` finds it again, moved on by odometry.
    """

    def __init__(self) -> None:
        self._before: tuple[str, Floats] | None = None

    def confirm(self, scene: str, frame: Frame, estimate: PoseEstimate) -> PoseEstimate:
        """Return the estimate of a frame's pose in a scene, `AMBIGUOUS` until it is found again."""
        best = estimate.best
        if estimate.status is not Status.OK or best is None:
            return estimate
        found = best.map_from_camera
        before, self._before = self._before, (scene, found @ np.linalg.inv(frame.odometry))
        if before is not None and before[0] == scene:
            moved = before[1] @ frame.odometry
            way = np.linalg.norm(moved[:3, 3] - found[:3, 3])
            turn = np.linalg.norm(vector_from_rotation(moved[:3, :3].T @ found[:3, :3]))
            if way <= SAME_WAY and turn <= SAME_TURN:
                return estimate
        return await_confirmation(estimate)


KEPT = 10
"""Number of keyframes that a search uses."""
NEWEST = 4
"""Number of newest keyframes that a known pose is fitted to."""
ROUNDS, SAMPLES = 2, 16
"""Rounds and samples of the fit to a new frame."""
DOUBT = 2.0
"""Error of an odometry step, in units of the motion noise, that the fit allows for."""
NEAREST, FARTHEST = 2.0 * NARROWEST, 12.0 * NARROWEST
"""Bounds of the spread of samples."""
APART, TURNED = 0.15, 0.12
"""Way [m] or turn [rad] from one keyframe to the next."""
WAIT = 5
"""Frames after which a lost camera that stands still is searched again."""
PATIENCE = 3
"""Number of contradicting frames after which a pose is given up."""


def look_up(window: Window, rng: Generator) -> tuple[PoseEstimate, Fit]:
    """Search a window's last frame in the map, or around the query's prior: estimate and best fit."""
    seeds = search(window, rng)
    fits = explore_unobservable(window, fit_window(window, seeds, rng), rng)
    return estimate_pose(window, fits), fits[0]


class Tracker:
    """Localizes a stream of frames in one map; time and memory a frame are bounded.

    Until the pose is known, the newest keyframes are searched by the visibility table and fitted together,
    until two answers agree. Then odometry predicts the pose, which is fitted to the last keyframes. If these
    fit but do not tell a place alone, the pose holds by odometry, with a growing covariance. A pose that
    frames contradict for a while is given up and searched again.

    Raises `OptionError`: the options are of a recipe that cannot be followed frame by frame
    (`FilterOptions.tracked`).

    `query`: query without frames; its description and shares are of where the stream begins, and
        dropped once the pose is known.
    `camera`: camera of the frames, which may refocus; frames of another size or view are refused.
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
        self._confirmation = Confirmation()
        self._since = np.zeros(4)
        self._fit: Fit | None = None
        self._last: Frame | None = None
        self._answer: PoseEstimate | None = None
        self._doubts = 0
        self._waited = 0

    @property
    def following(self) -> bool:
        """Return whether the pose is known."""
        return self._fit is not None

    def start(self, frames: Sequence[Frame], map_from_camera: Floats) -> None:
        """Start from a given pose (4, 4) of the last of some frames; forget all else.

        Raises `OptionError` and `InputError` as `update` does.
        """
        observations = [self._sighted(frame) for frame in frames[-NEWEST:]]
        self.reset()
        self.keyframes.extend(observations)
        chain = Chain.of(level_frames(frames[-1:]), self.query.options.motion)
        self._accept_fit(Fit.at(chain, split_pose(map_from_camera)[0]))
        self._last = frames[-1]

    def update(self, frame: Frame) -> PoseEstimate:
        """Estimate the pose of a frame.

        Raises `OptionError`: the frame is of another camera; it has nothing that can be compared
        with the map; `InputError`: its images are broken; the tracker is as it was before.
        """
        observation = self._sighted(frame)
        keyframe = not self.keyframes or is_apart(self.keyframes[-1].frame, frame)
        estimate = self._follow(observation) if self.following else None
        if keyframe:
            self.keyframes.append(observation)
        if estimate is None:
            self._waited += 1
            due = keyframe or self._waited >= WAIT or self._answer is None
            estimate = self._search(observation) if due else self._carry_on(frame)
        self._last, self._answer = frame, add_earth_poses(self.query.scene, estimate)
        return self._answer

    def reset(self) -> None:
        """Forget the pose and all frames."""
        self.keyframes.clear()
        self._fit, self._last, self._answer = None, None, None
        self._cut, self._since = {}, np.zeros(4)
        self._doubts = self._waited = 0
        self._confirmation = Confirmation()

    def _sighted(self, frame: Frame) -> Observation:
        if self.camera is not None and not frame.camera.is_refocused(self.camera):
            raise OptionError(
                "frame: its camera differs from the tracker's; create a tracker for this camera."
            )
        if self.query.encoder is None:
            self.query = replace(self.query, encoder=make_label_encoder(self.query.scene, frame))
        observation = observe_frame(frame, self.query.encoder, self.query.options)
        if not is_comparable(observation):
            raise OptionError(
                "frame: it has no depth, known labels or colours, so it cannot be compared with "
                "the map."
            )
        return observation

    # ------------------------------------------------------------------------------ following

    def _follow(self, observation: Observation) -> PoseEstimate:
        """Predict the pose by odometry and fit it; give it up if frames contradict it for a while."""
        assert self._fit is not None and self._last is not None  # noqa: S101, PT018  following
        frame = observation.frame
        recent = [*list(self.keyframes)[-NEWEST + 1 :], observation]
        window = self._window(recent)
        step = _steps([self._last, frame])[1]
        erred = DOUBT * deviations(step, self.query.options.motion)
        spread = np.clip(np.hypot(self._fit.spread, erred), NEAREST, FARTHEST)
        level = fit_level(window, FINE, rounds=ROUNDS, samples=SAMPLES)
        fit = fit_pose(self.scorer, compose(self._fit.pose, step), spread, level, self.rng)
        estimate = self._hold_by_odometry(estimate_pose(window, [fit]), erred)
        consistent = diagnostics_of(estimate).consistent
        against = estimate.status is not Status.OK and not consistent
        self._doubts = self._doubts + 1 if against else 0
        if self._doubts >= PATIENCE:
            self._fit, self._doubts = None, 0
            self.keyframes.clear()  # they led to a wrong belief
            return give_up(estimate)
        self._accept_fit(fit)
        return estimate

    def _hold_by_odometry(self, estimate: PoseEstimate, erred: Floats) -> PoseEstimate:
        """Hold a pose by odometry if its frames fit but do not tell a place alone.

        `erred`: (4,) standard deviations of the last step, which add up until frames tell the place.
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
        """Follow a fit, and drop the priors of where the stream began."""
        self.query = replace(self.query, description=None, shares=None)
        self._fit = fit

    def _window(self, observations: list[Observation]) -> Window:
        """Make a window of the stream with the cached views of frames in the last one."""
        self._cut = {key: view for key, view in self._cut.items() if key[0] in observations}
        return Window(self.query, self.scorer, observations, cut=self._cut)

    # ------------------------------------------------------------------------------ searching

    def _search(self, newest: Observation) -> PoseEstimate:
        """Search the keyframes and the newest frame in the whole map."""
        self._waited = 0
        known = [s for s in self.keyframes if s is not newest]
        window = self._window([*known[-KEPT + 1 :], newest])
        estimate, fit = look_up(window, self.rng)
        estimate = self._confirmation.confirm("", newest.frame, estimate)
        if estimate.status is Status.OK:
            self._doubts, self._since = 0, np.zeros(4)
            self._accept_fit(fit)
        return estimate

    def _carry_on(self, frame: Frame) -> PoseEstimate:
        """Move the last answer on by odometry, for a frame too near the last to tell more."""
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


def is_apart(frame: Frame, later: Frame) -> bool:
    """Return whether a frame is far enough from another to be a keyframe beside it."""
    step = _steps([frame, later])[1]
    return bool(np.linalg.norm(step[:3]) >= APART or abs(wrap_angle(step[3])) >= TURNED)


def _steps(frames: Sequence[Frame]) -> Floats:
    """Return steps (T, 4), step t from frame t - 1 to frame t; the first is zero."""
    poses = level_frames(frames)
    steps = np.zeros_like(poses)
    steps[1:] = between(poses[:-1], poses[1:])
    return steps


def track_capture(tracker: Tracker, frames: Sequence[Frame]) -> PoseEstimate:
    """Track a long capture: estimate of the last pose, with the trajectory.

    Poses before the first known one follow from it by odometry.
    """
    if tracker.query.prior is not None:
        raise OptionError(
            f"prior: it applies only to short captures, but {len(frames)} frames are "
            "tracked; choose fewer frames."
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
    matrices: list[Floats | None], rows: list[int], frames: Sequence[Frame]
) -> Floats:
    """Fill unknown poses (T, 4, 4) by odometry from the nearest known one, the earlier of two."""
    poses = level_frames(frames)
    out = np.empty((len(frames), 4, 4))
    for i, matrix in enumerate(matrices):
        if matrix is not None:
            out[i] = matrix
            continue
        near = min(rows, key=lambda r: (abs(r - i), r))
        anchor = matrices[near]
        assert anchor is not None  # noqa: S101  of known rows
        pose = compose(split_pose(anchor)[0], between(poses[near], poses[i]))
        out[i] = pose_matrix(pose, level_from_camera(frames[i].gravity))
    return out


HEIGHT = 0.15
"""Largest standard deviation [m] of a given height that counts: on a map of RViz there is no height."""


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
    """Maps in which lost frames are searched.

    `options`: options, encoder and device, as of `SceneMap.localize`.
    """

    maps: Scene | SceneSource
    options: dict[str, Any]

    @property
    def scenes(self) -> tuple[str, ...]:
        """Return the names of the maps; a plain map has that of its first scene."""
        return self.maps.scenes[:1] if isinstance(self.maps, Scene) else self.maps.names

    def resolve_scene(self, name: str) -> str:
        """Return the name, or that of the only map if empty; `OptionError`: there is no such map."""
        if not name and len(self.scenes) == 1:
            return self.scenes[0]
        if name not in self.scenes:
            known = ", ".join(self.scenes[:5])
            raise OptionError(f"scene is {name!r}; choose one of {known or 'an empty library'}.")
        return name

    def scene(self, name: str) -> Scene:
        """Return the map of a name; raises `OptionError` without it, `InputError` without its file."""
        return self.maps if isinstance(self.maps, Scene) else self.maps.scene(name)

    def query(self, name: str, seed: int) -> PoseQuery:
        """Make the query in one map."""
        return PoseQuery.of(self.scene(name), seed=seed, **self.options)

    def anywhere(self, frames: Sequence[Frame], rng: Generator) -> tuple[str, PoseEstimate]:
        """Search frames in all maps: name of the map of the last frame, empty if none, and estimate.

        Raises `OptionError`: nothing that the frames show can be compared; `InputError` or
        `MapError`: an image is broken, or depth is not in metres; a map of the library is gone.
        """
        if isinstance(self.maps, Scene):
            return self.near(frames, self.scenes[0], None, rng)
        seed = int(rng.integers(1 << 31))
        estimate = self.maps.localize(frames, refine=False, seed=seed, **self.options)
        return (estimate.best.scene.partition("/")[0] if estimate.best else ""), estimate

    def near(
        self, frames: Sequence[Frame], name: str, prior: Prior | None, rng: Generator
    ) -> tuple[str, PoseEstimate]:
        """Search frames in one map, around a prior of the first frame if given; errors as `anywhere`."""
        query = replace(self.query(name, 0), prior=prior)
        encoder = query.encoder or make_label_encoder(query.scene, frames[-1])
        seen = [observe_frame(frame, encoder, query.options) for frame in frames]
        if not is_comparable(seen[-1]):
            raise OptionError(
                "frame: it has no depth, known labels or colours, so it cannot be compared with "
                "the map."
            )
        shown = [s for s in seen if is_comparable(s)]
        check_unit(float(np.linalg.norm(np.ptp(query.scene.bounds, axis=0))), shown)
        window = Window(query, Scorer(query.scene, query.options.likelihood), shown)
        estimate, _ = look_up(window, rng)
        return name, add_earth_poses(query.scene, estimate)


def prior_of(map_from_camera: Floats, covariance: Floats) -> Prior:
    """Make a prior of a pose (4, 4) and its covariance (6, 6), without a height that is too uncertain."""
    (x, y, z, yaw), _ = split_pose(map_from_camera)
    spread = float(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    turn = min(float(np.sqrt(covariance[5, 5])), np.pi)
    height = float(z) if covariance[2, 2] < HEIGHT**2 else None
    return Prior(float(x), float(y), height, float(yaw), max(spread, 0.02), max(turn, 0.01))


MAX_UNSURE = 2
"""Frames in a row that are not `OK` at a followed pose, before another place is accepted."""


@dataclass(frozen=True, slots=True, eq=False)
class GivenPose:
    """Given pose, around which frames are searched first."""

    map_from_odom: Floats
    covariance: Floats
    """(6, 6) of the camera's pose."""
    scene: str


@dataclass(frozen=True, slots=True, eq=False)
class Relocalization:
    """Request to search lost frames, for the pose of the last."""

    frames: tuple[Frame, ...]
    near: GivenPose | None
    rng: Generator

    def search(self, relocalizer: Relocalizer) -> RelocalizationResult:
        """Search the frames; faults of frames or maps are part of the answer."""
        try:
            if self.near is None:
                name, estimate = relocalizer.anywhere(self.frames, self.rng)
            else:
                first = self.near.map_from_odom @ self.frames[0].odometry
                prior = prior_of(first, self.near.covariance)
                name, estimate = relocalizer.near(self.frames, self.near.scene, prior, self.rng)
        except PlacegraphError as error:
            return RelocalizationResult(self.frames, "", None, str(error))
        return RelocalizationResult(self.frames, name, estimate, estimate.reason)


@dataclass(frozen=True, slots=True, eq=False)
class RelocalizationResult:
    """Answer to a `Relocalization`."""

    frames: tuple[Frame, ...]
    scene: str
    estimate: PoseEstimate | None
    """None: the frames could not be compared with a map."""
    reason: str

    @property
    def sure(self) -> bool:
        """Return whether one place fits."""
        return self.estimate is not None and self.estimate.status is Status.OK


@dataclass(frozen=True, slots=True, eq=False)
class FrameResult:
    """Result of one frame."""

    frame: Frame
    reason: str
    scene: str = ""
    estimate: PoseEstimate | None = None
    """None: the frame showed nothing, and the pose goes on by odometry."""
    has_pose: bool = False
    """Whether the estimate's best mode is the pose from here on."""
    is_lost: bool = False
    """Whether the pose before is given up."""


class RelocalizingTracker:
    """Tracking in one map, with relocalization in all maps when the pose is uncertain."""

    def __init__(self, relocalizer: Relocalizer, camera: Camera | None, seed: int) -> None:
        self.relocalizer, self.camera, self.seed = relocalizer, camera, seed
        self._rng = np.random.default_rng(seed)
        self.reset(None)

    def reset(self, given: GivenPose | None) -> None:
        """Forget all but a given pose."""
        self._given = given
        self._scene, self._tracker = "", None
        self._recent: deque[Frame] = deque(maxlen=KEPT)
        self._clear()
        self._confirmation = Confirmation()
        self._unsure_count = self._waited = self._denied_count = 0

    _tracker: Tracker | None
    _newest: Frame | None
    _is_new: bool

    @property
    def following(self) -> bool:
        """Return whether a pose is followed, even an uncertain one."""
        return self._tracker is not None and self._tracker.following

    def follow(self, frame: Frame) -> FrameResult | None:
        """Follow a frame; None: there is no pose to follow yet."""
        if self._tracker is None or not self._tracker.following:
            self._remember(frame)
            return None
        try:
            estimate = self._tracker.update(frame)
        except PlacegraphError as error:
            return FrameResult(frame, f"Carried on by odometry: {error}")
        if estimate.status is Status.OK:
            return self._sure(frame, estimate)
        if not self._unsure_count:
            self._clear()  # earlier frames fit the pose that was known
        self._unsure_count += 1
        self._remember(frame)
        is_lost = not self._tracker.following
        fits = not is_lost and diagnostics_of(estimate).consistent
        return FrameResult(
            frame, estimate.reason, self._scene, estimate, has_pose=fits, is_lost=is_lost
        )

    def question(self) -> Relocalization | None:
        """Return the relocalization that is due now; None: the pose is sure, or no frame is new enough."""
        known = self.following and not self._unsure_count
        due = self._is_new or self._waited >= WAIT
        if known or not due or self._newest is None:
            return None
        self._waited, self._is_new = 0, False
        before = [frame for frame in self._recent if frame is not self._newest][1 - KEPT :]
        return Relocalization((*before, self._newest), self._given, self._rng.spawn(1)[0])

    def take_answer(self, answer: RelocalizationResult) -> FrameResult | None:
        """Accept an answer; while a pose is followed, only one that is sure."""
        last, estimate = answer.frames[-1], answer.estimate
        if estimate is not None and self._given is None:  # else a person and an image say the same
            estimate = self._confirmation.confirm(answer.scene, last, estimate)
        sure = estimate is not None and estimate.status is Status.OK
        if self.following and not (sure and self._unsure_count >= MAX_UNSURE):
            return None
        if estimate is None:
            self._clear()
            return FrameResult(last, answer.reason)
        if sure:
            self._tracker, self._scene = self._start_tracker(answer), answer.scene
            return self._sure(last, estimate)
        lost = estimate.status is Status.LOST
        if self._given is not None:
            self._denied_count = self._denied_count + 1 if lost else 0
            if self._denied_count < PATIENCE:
                return FrameResult(last, answer.reason, answer.scene, answer.estimate)
            self._given, self._is_new = None, True
        # of several places none is the pose
        has_pose = answer.sure or (not lost and len(estimate.modes) == 1)
        return FrameResult(
            last, estimate.reason, answer.scene, estimate, has_pose=has_pose, is_lost=True
        )

    def _clear(self) -> None:
        """Forget the frames to search."""
        self._recent.clear()
        self._newest, self._is_new = None, False

    def _sure(self, frame: Frame, estimate: PoseEstimate) -> FrameResult:
        self._clear()
        self._given = None
        self._unsure_count = self._denied_count = 0
        return FrameResult(frame, estimate.reason, self._scene, estimate, has_pose=True)

    def _start_tracker(self, answer: RelocalizationResult) -> Tracker:
        """Start a tracker from an answer."""
        assert answer.estimate is not None and answer.estimate.best is not None  # noqa: S101, PT018  sure
        tracker = Tracker(self.relocalizer.query(answer.scene, self.seed), self.camera)
        tracker.start(answer.frames, answer.estimate.best.map_from_camera)
        return tracker

    def _remember(self, frame: Frame) -> None:
        """Keep a frame to search, if it is far enough from the last."""
        self._waited += 1
        self._newest = frame
        if not self._recent or is_apart(self._recent[-1], frame):
            self._recent.append(frame)
            self._is_new = True
