"""Captures of walks through homes, in memory; their images are rendered when they are asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix, split_pose, wrap_angle
from placegraph.errors import OptionError
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame, LabelKind
from placegraph_lab.worlds.flat.flat import DOOR, HEADROOM, WINDOW, Flat
from placegraph_lab.worlds.flat.interior import Interior
from placegraph_lab.worlds.flat.render import Stage, develop, simulate_depth
from placegraph_lab.worlds.flat.walks import TURN, Walk, add_drift, exposures, gravity, stroll
from placegraph_lab.worlds.home.change import SHELL, STANDS

CAMERA = Camera(160, 120, 115.0, 115.0, 80.0, 60.0)  # 70 degrees wide


def record(
    interior: Interior,
    walk: Walk,
    rng: np.random.Generator,
    *,
    camera: Camera = CAMERA,
    daylight: float = 0.5,
    depth: bool = False,
    labels: LabelKind | None = "labels",
    words: Mapping[str, str] | None = None,
) -> Capture:
    """Capture of a walk, with the light, exposure, noise and drift of `write_walk`, in memory.

    Images are rendered when a frame is first asked for them; the answer does not depend on which
    were asked for before. Depth and labels have half the camera's size.

    `interior`: the home as it is now; `walk`: poses of the camera, of which the capture holds
    drifting odometry alone; `rng`: draws light, noise and drift; `camera`: of the colour images;
    `daylight`: from 0, evening with lamps on, to 1, day with lamps off; `depth`: whether frames
    have depth; `labels`: label images hold labels, ids of things, or are none; `words`: what the
    labels are called in the capture, where it is not as in the interior: people who label maps have
    other words than networks that label images.

    Raises `OptionError`: `labels` is none of its values.
    """
    if labels not in {"labels", "instances", None}:
        raise OptionError(f"labels is {labels!r}; it is 'labels', 'instances' or None.")
    light, sensor, motion = rng.spawn(3)
    said = {t.label: (words or {}).get(t.label, t.label) for t in interior.objects}
    names = sorted(set(said.values()))
    value = np.full(max(t.id for t in interior.objects) + 2, -1, np.int32)  # the last is nothing
    for thing in interior.objects:
        value[thing.id] = names.index(said[thing.label]) if labels == "labels" else thing.id
    half = camera.resize(camera.width // 2, camera.height // 2)
    shared = _SharedScene(interior, light, daylight, camera, half, value if labels else None)
    odometry = add_drift(walk.map_from_camera, motion)
    down = gravity(walk.map_from_camera, motion)
    factors = exposures(len(walk), sensor)
    frames = [
        Frame(
            index=i,
            stamp=float(walk.stamps[i]),
            odometry=odometry[i],
            gravity=down[i],
            camera=camera,
            depth_camera=half if depth else None,
            label_camera=half if labels else None,
            label_kind=labels,
            label_names=dict(enumerate(names)) if labels == "labels" else {},
            images=_Rendered(
                shared, walk.map_from_camera[i], float(factors[i]), noise, depth=depth
            ),
        )
        for i, noise in enumerate(sensor.spawn(len(walk)))
    ]
    return Capture.from_frames(frames)


class _SharedScene:
    """Scene of all frames of a capture, lit when the first image is rendered."""

    def __init__(
        self,
        interior: Interior,
        light: np.random.Generator,
        daylight: float,
        camera: Camera,
        half: Camera,
        value: NDArray[np.int32] | None,
    ) -> None:
        self.camera, self.half, self.value = camera, half, value
        self._interior, self._light, self._daylight = interior, light, daylight

    @cached_property
    def stage(self) -> Stage:
        return Stage(self._interior, self._light, daylight=self._daylight)


class _Rendered:
    """Images of one frame."""

    def __init__(
        self,
        shared: _SharedScene,
        map_from_camera: NDArray[np.float64],
        exposure: float,
        rng: np.random.Generator,
        *,
        depth: bool,
    ) -> None:
        self._shared, self._pose, self._exposure = shared, map_from_camera, exposure
        self._colour_noise, self._depth_noise = rng.spawn(2)
        self._has_depth = depth

    def rgb(self) -> NDArray[np.uint8]:
        """Return the colours (H, W, 3)."""
        return self._rgb

    def depth(self) -> NDArray[np.float32] | None:
        """Return the depth (h, w) [m], or None."""
        return self._depth if self._has_depth else None

    def labels(self) -> NDArray[np.int32] | None:
        """Return the labels (h, w), or None."""
        return self._labels

    @cached_property
    def _rgb(self) -> NDArray[np.uint8]:
        shared = self._shared
        radiance = shared.stage.radiance(shared.camera, self._pose)
        return develop(radiance, self._exposure, self._colour_noise)

    @cached_property
    def _depth(self) -> NDArray[np.float32]:
        geometry = self._shared.stage.geometry(self._shared.half, self._pose)
        millimetres = simulate_depth(geometry, self._depth_noise)
        return np.where(millimetres > 0, millimetres / np.float32(1000.0), np.nan).astype("f4")

    @cached_property
    def _labels(self) -> NDArray[np.int32] | None:
        if self._shared.value is None:
            return None
        geometry = self._shared.stage.geometry(self._shared.half, self._pose)
        values: NDArray[np.int32] = self._shared.value[geometry.ids]
        return values


FLAT = 0.1  # what hangs on a wall stands out less than this [m]
DWELL = (0.8, 2.5)  # how long one thing is looked at [s]
LOWEST = 0.35  # greatest angle at which a camera is held downwards [rad]
_EASE = 0.6  # of what is left to turn, turned in a fifth of a second


def visit(
    flat: Flat,
    interior: Interior,
    rng: np.random.Generator,
    *,
    frames: int = 25,
    rate: float = 5.0,
    tilt: float = 0.05,
) -> Walk:
    """Walk through a flat around the furniture as it stands now, looking at one thing and another.

    `flat`: the flat as it was drawn; `interior`: as it is now; `rng`: draws way and looks;
    `frames`, `rate`: number of images, and images a second; `tilt`: deviation of pitch and roll
    [rad].

    Raises `OptionError`: A number is out of its range, or nobody can stand anywhere.
    """
    boxes = [t.bounds for t in interior.objects if t.label not in SHELL and _in_the_way(t.bounds)]
    now = _Refurnished(**{f.name: getattr(flat, f.name) for f in fields(flat)}, boxes=tuple(boxes))
    walk = stroll(now, rng, frames=frames, rate=rate, tilt=0.0)
    poses, _ = split_pose(walk.map_from_camera)
    poses[:, 3], down = _aim(poses, interior, rate, rng)
    down += tilt * rng.uniform(0.5, 1.0) * np.sin(2 * np.pi * (walk.stamps / 4.1 + rng.random()))
    roll = 0.4 * tilt * np.sin(2 * np.pi * (walk.stamps / 3.7 + rng.random()))
    felt = np.stack([np.sin(roll), np.cos(roll) * np.cos(down), np.cos(roll) * np.sin(down)], -1)
    return Walk(walk.stamps, pose_matrix(poses, level_from_camera(felt)))


def _aim(
    poses: NDArray[np.float64], interior: Interior, rate: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Yaw and angle downwards (T,) [rad] on a way of poses (T, 4) that head along it."""
    targets_in = {
        room: np.array([t.bounds.mean(axis=0) for t in interior.objects
                        if t.room == room and t.label not in SHELL])
        for room in {t.room for t in interior.objects}
    }  # fmt: skip
    floors = {t.room: t.bounds[:, :2] for t in interior.objects if t.label == "floor"}
    yaw, down = np.empty(len(poses)), np.empty(len(poses))
    at, low, left = float(poses[0, 3]), 0.15, 0
    goal: NDArray[np.float64] | None = None
    for i, pose in enumerate(poses):
        if left == 0:
            room = next((r for r, f in floors.items() if _within(pose[:2], f)), "")
            goal = _target(pose, at, targets_in.get(room, np.zeros((0, 3))), rng)
            left = max(1, round(float(rng.uniform(*DWELL)) * rate))
        left -= 1
        wish, dip = float(pose[3]), 0.15
        if goal is not None:
            away = goal - pose[:3]
            wish = float(np.arctan2(away[1], away[0]))
            dip = float(np.arctan2(-away[2], np.hypot(*away[:2])))
        ease, most = min(1.0, 5.0 * _EASE / rate), TURN / rate
        at += float(np.clip(ease * float(wrap_angle(wish - at)), -most, most)) if i else 0.0
        low += ease * (float(np.clip(dip, -0.05, LOWEST)) - low)
        yaw[i], down[i] = at, low
    return yaw, down


def _target(
    pose: NDArray[np.float64], yaw: float, targets: NDArray[np.float64], rng: np.random.Generator
) -> NDArray[np.float64] | None:
    """Something in the room (3,) to look at, rather ahead than behind; None: where one goes."""
    away = targets - pose[:3]
    far = np.hypot(away[:, 0], away[:, 1])
    targets, away = targets[far > 0.6], away[far > 0.6]
    if not len(targets):
        return None
    turn = np.abs(wrap_angle(np.arctan2(away[:, 1], away[:, 0]) - yaw))
    weights = np.exp(-turn)
    found: NDArray[np.float64] = targets[rng.choice(len(targets), p=weights / weights.sum())]
    return found


def _within(point: NDArray[np.float64], bounds: NDArray[np.float64]) -> bool:
    return bool((point >= bounds[0]).all() and (point <= bounds[1]).all())


def _in_the_way(bounds: NDArray[np.float64]) -> bool:
    """Whether who walks has to walk around: it is no rug, and hangs neither high nor on a wall."""
    low, high = bounds
    hung = low[2] > STANDS and (high - low)[:2].min() < FLAT
    return bool(low[2] < HEADROOM and high[2] > STANDS and not hung)


@dataclass(frozen=True)
class _Refurnished(Flat):
    """A drawn flat whose furniture stands elsewhere by now."""

    boxes: tuple[NDArray[np.float64], ...] = ()  # (2, 3) of what is in the way

    @cached_property
    def blocked(self) -> NDArray[np.bool_]:
        """Cells (R, C) that nobody walks through."""
        mask = self.room_of < 0
        for opening in self.openings:
            for cell in opening.cells:
                mask[cell] = opening.symbol.kind in {WINDOW, DOOR}
        for low, high in self.boxes:
            bottom, left = self.cell(low[0], low[1])
            top, right = self.cell(high[0], high[1])
            mask[max(top, 0) : bottom + 1, max(left, 0) : right + 1] = True
        return mask
