"""Ego-motion: odometry as steps of four degrees of freedom, and particles moved by them (Eq. 1)."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import hypot
from time import perf_counter
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.geometry import Floats, between, compose, level_from_camera, wrap_angle
from placegraph.errors import OptionError
from placegraph.indoor.encode import Encoder, MapEncoder, bind_encoder, make_map_encoder
from placegraph.indoor.encode.labels import InstancesEncoder, LabelsEncoder
from placegraph.indoor.likelihood.observe import (
    Observation,
    View,
    ViewCache,
    check_unit,
    observe_frame,
    views,
)
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.likelihood.visibility import VisibilityTable, visibility
from placegraph.indoor.map.scene import Scene
from placegraph.indoor.options import MotionNoise, PoseSearchOptions, check_device
from placegraph.indoor.pose.prior import LogPrior
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

if TYPE_CHECKING:
    from placegraph.indoor.language import Sentence
    from placegraph.indoor.pose.prior import Prior


def level_poses(odometry: NDArray[np.float64], gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return poses (T, 4) x, y, z, yaw in a level frame, of odometry (T, 4, 4) and gravity (T, 3).

    The odometry's own frame may be tilted: the mean direction of gravity in all frames sets it upright.
    Tilts are gravity's, frame by frame.
    """
    rotation = odometry[:, :3, :3]
    down = np.einsum("tij,tj->ti", rotation, gravity).mean(axis=0)
    # level_from_camera sets any frame upright whose "down" is given; undo its change of axes
    upright = level_from_camera(np.array([0.0, 1.0, 0.0])).T @ level_from_camera(down)
    to_level = _Z_FROM_Y_DOWN @ upright
    level_frames = to_level @ rotation @ np.swapaxes(level_from_camera(gravity), 1, 2)
    yaw = np.arctan2(
        level_frames[:, 1, 0] - level_frames[:, 0, 1], level_frames[:, 0, 0] + level_frames[:, 1, 1]
    )
    return np.column_stack([odometry[:, :3, 3] @ to_level.T, yaw])


_Z_FROM_Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def deviations(steps: NDArray[np.float64], noise: MotionNoise) -> NDArray[np.float64]:
    """Return standard deviations (..., 4) [m, rad] of steps (..., 4)."""
    length, turned = np.linalg.norm(steps[..., :3], axis=-1), np.abs(wrap_angle(steps[..., 3]))
    way = noise.translation + noise.translation_per_metre * length
    turn = noise.rotation + noise.rotation_per_radian * turned
    return np.stack([way, way, way, turn], axis=-1)


def keyframes(
    stamps: NDArray[np.float64], poses: NDArray[np.float64], seconds: float, metres: float
) -> list[int]:
    """Select keyframes so far apart in time, or in way (or 0.2 rad of turn); first and last always.

    Table 6 of the paper: a robot takes the frames that it has time for.
    """
    if seconds <= 0 and metres <= 0:
        return list(range(len(stamps)))
    kept = [0]
    for i in range(1, len(stamps)):
        moved = np.linalg.norm(poses[i, :3] - poses[kept[-1], :3]) >= metres > 0
        turned = metres > 0 and abs(float(wrap_angle(poses[i, 3] - poses[kept[-1], 3]))) >= 0.2
        waited = stamps[i] - stamps[kept[-1]] >= seconds > 0
        if moved or turned or waited or i == len(stamps) - 1:
            kept.append(i)
    return kept


@dataclass(frozen=True, eq=False)
class Chain:
    """Odometry of the T frames of a window."""

    poses: Floats
    """(T, 4) level poses in odometry's own frame."""
    deviations: Floats
    """(T - 1, 4) standard deviations of the steps between, in units of which errors are measured."""

    @classmethod
    def of(cls, poses: Floats, noise: MotionNoise) -> Chain:
        """Make a chain of level odometry (T, 4)."""
        return cls(poses, deviations(between(poses[:-1], poses[1:]), noise))

    @cached_property
    def steps(self) -> Floats:
        """(T - 1, 4) from each frame to the next."""
        return between(self.poses[:-1], self.poses[1:])

    def rigid(self, pose: Floats) -> Floats:
        """Return poses (T, 4) of all frames by odometry, from that of the last frame (4,)."""
        return compose(pose, between(self.poses[-1], self.poses))


Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseQuery:
    """Localization query: frames, map, options and priors."""

    scene: Scene
    """The map; it is only read."""
    frames: Sequence[Frame] = ()
    """In order of time."""
    options: PoseSearchOptions = field(default_factory=PoseSearchOptions)
    encoder: MapEncoder | None = None
    """Encoder of patches; None: the frames' own labels, if they have any."""
    prior: Prior | None = None
    """Roughly where the first frame was taken."""
    description: str | Sentence | None = None
    """Description of where the last frame was taken."""
    shares: ArrayLike | None = None
    """(S,) share of the first particles of each merged scene."""
    seed: int = 0
    progress: Progress | None = None
    """Called with what is done, how far, and of how much."""

    @classmethod
    def of(
        cls,
        scene: Scene,
        capture: Capture | Sequence[Frame] | None = None,
        *,
        frames: slice | Sequence[int] | None = None,
        options: PoseSearchOptions | None = None,
        encoder: str | Encoder | MapEncoder | None = None,
        device: str = "auto",
        **known: Any,  # noqa: ANN401  # the other fields
    ) -> PoseQuery:
        """Make a query of a capture, or of a stream of frames if there is none.

        Chosen frames are thinned to keyframes by the options. Colour is switched off for maps without
        colours. Parameters and errors: `SceneMap.localize`.
        """
        check_device(device)
        options = options or PoseSearchOptions()
        if known.get("seed", 0) < 0:
            raise OptionError(f"seed is {known['seed']}; it must not be negative.")
        chosen: list[Frame] = []
        if capture is not None:
            chosen = chosen_frames(capture, frames)
            stamps = np.array([frame.stamp for frame in chosen])
            kept = keyframes(stamps, level_frames(chosen), options.every, options.every_metre)
            chosen = [chosen[i] for i in kept]
        return cls(
            scene=scene,
            frames=chosen,
            options=replace(options, colour=options.colour and scene.has_colours),
            encoder=None if encoder is None else make_map_encoder(encoder, scene),
            **known,
        )


def chosen_frames(
    capture: Capture | Sequence[Frame], frames: slice | Sequence[int] | None
) -> list[Frame]:
    """Choose frames of a capture by rows, by a slice, or all; raises `OptionError` if there are none."""
    rows: Any = range(len(capture))
    if isinstance(frames, slice):
        rows = rows[frames]
    elif frames is not None:
        if isinstance(frames, (str, int)) or not all(
            isinstance(i, (int, np.integer)) for i in frames
        ):
            raise OptionError(f"frames is {frames!r}; give a slice, or rows as whole numbers.")
        rows = list(frames)
        if any(not -len(capture) <= i < len(capture) for i in rows):
            raise OptionError(f"frames: an index is outside the capture's {len(capture)} frames.")
    if not rows:
        raise OptionError(f"frames: none of the capture's {len(capture)} is selected.")
    chosen = [capture[i] for i in rows]
    if any(b.stamp <= a.stamp for a, b in itertools.pairwise(chosen)):
        raise OptionError(
            "frames: their stamps must increase; choose each frame once, in order of time."
        )
    return chosen


def level_frames(frames: Sequence[Frame]) -> Floats:
    """Return level poses (T, 4) of the odometry of frames."""
    return level_poses(
        np.stack([f.odometry for f in frames]), np.stack([f.gravity for f in frames])
    )


T = TypeVar("T")

NEWEST = 12
"""Number of newest frames that the fine fit uses."""


@contextmanager
def time_stage(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the time spent inside to a stage's seconds."""
    start = perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + perf_counter() - start


@dataclass(eq=False)
class Window:
    """Window: frames of one capture in one map, with cached views."""

    query: PoseQuery
    """Query; its frames may be more than those of the window."""
    scorer: Scorer
    observations: list[Observation]
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds of each stage."""
    cut: ViewCache = field(default_factory=dict)
    """Views of its frames, which other windows of the same frames and map may share."""
    _views: dict[tuple[float, bool], list[View]] = field(default_factory=dict)
    _derived: dict[Hashable, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.observations)

    @property
    def scene(self) -> Scene:
        """The map."""
        return self.query.scene

    @property
    def options(self) -> PoseSearchOptions:
        """Options of the search."""
        return self.query.options

    @cached_property
    def poses(self) -> Floats:
        """(T, 4) odometry, level."""
        return level_frames([s.frame for s in self.observations])

    @cached_property
    def chain(self) -> Chain:
        """Odometry as steps that may be wrong."""
        return Chain.of(self.poses, self.options.motion)

    @cached_property
    def levels(self) -> Floats:
        """(T, 3, 3) level_from_camera."""
        return np.stack([s.level for s in self.observations])

    @property
    def table(self) -> VisibilityTable:
        """The map's table."""
        return visibility(self.scene, self.options)

    @cached_property
    def log_prior(self) -> LogPrior | None:
        """Log prior of the last frame's pose; None: there is none."""
        description, shares, near = self.query.description, self.query.shares, self.query.prior
        if near is not None and near.is_wide:
            x, y, rise, turn = (self.poses[-1] - self.poses[0]).tolist()
            z, yaw = (
                None if at is None else at + moved
                for at, moved in ((near.z, rise), (near.yaw, turn))
            )
            near = replace(near, z=z, yaw=yaw, spread=hypot(near.spread, x, y))
        else:
            near = None  # poses are drawn around it
        if description is None and shares is None and near is None:
            return None
        return LogPrior.of(self.scene, self.table, description, shares, near)

    @cached_property
    def judging(self) -> Window:
        """The window with the calibrated likelihood: scores of Eq. 2 are no likelihood ratios."""
        likelihood = self.options.likelihood
        if likelihood.kind == "calibrated":
            return self
        scorer = Scorer(self.scene, replace(likelihood, kind="calibrated"))
        return Window(self.query, scorer, self.observations, self.seconds)

    def last(self, count: int) -> Window:
        """Return a window of at most `count` newest frames."""
        newest = Window(self.query, self.scorer, self.observations[-count:], cut=self.cut)
        newest._derived = self._derived
        return newest

    def derive(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return a value that a stage derives from frames, made once for each key."""
        if key not in self._derived:
            self._derived[key] = make()
        return self._derived[key]

    @cached_property
    def newest(self) -> NDArray[np.int64]:
        """Rows of the newest frames, which the last level is fitted to."""
        return np.arange(max(0, len(self) - NEWEST), len(self))

    def views(self, stride: float, *, scaled: bool = True) -> list[View]:
        """Views of all frames at a stride, which grows in large images if `scaled`."""
        if (stride, scaled) not in self._views:
            background, model = self.table.background, self.scorer.model
            self._views[stride, scaled] = views(
                self.observations, stride, model, background, self.cut, scaled=scaled
            )
        return self._views[stride, scaled]


def observe(query: PoseQuery) -> Window:
    """Read and encode the frames of a query.

    Raises
    ------
    OptionError
        Nothing can be compared with the map.
    InputError
        An image is broken, or depth is not in metres (`depth_unit.check_unit`).

    """
    scene = query.scene
    window = Window(query, Scorer(scene, query.options.likelihood), [])
    with time_stage(window.seconds, "reading"):
        encoder = query.encoder or make_label_encoder(scene, query.frames[0])
        window.observations = [
            observe_frame(frame, encoder, query.options) for frame in query.frames
        ]
    if not any(is_comparable(s) for s in window.observations):
        raise OptionError(
            "The frames cannot be compared with the map: they have no depth and no known "
            "labels, and the map has no colours (or these terms are switched off). Give "
            "depth or labels."
        )
    check_unit(float(np.linalg.norm(np.ptp(scene.bounds, axis=0))), window.observations)
    return window


def is_comparable(observation: Observation) -> bool:
    """Return whether a frame has anything that can be compared with the map."""
    return bool(observation.patches) or observation.depth is not None or observation.rgb is not None


def make_label_encoder(scene: Scene, frame: Frame) -> MapEncoder | None:
    """Make the encoder of the labels that a capture brings; None: it brings none."""
    if frame.label_kind == "instances":
        return InstancesEncoder(scene)
    return bind_encoder(LabelsEncoder(), scene) if frame.label_kind else None
