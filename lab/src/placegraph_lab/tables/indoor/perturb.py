"""What goes wrong with captures: windows of recordings, spoiled in one way, by a strength.

A perturbation changes what a localizer is told, never what is true: of the truth only turned images
and moved cameras have another. Rates of odometry are those of a frame of the window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import (
    Camera,
    Floats,
    between,
    compose,
    pose_matrix,
    rotation_from_vector,
    split_pose,
    vector_from_rotation,
)
from placegraph.errors import OptionError
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import ArrayImages, Frame, quarter_turn, rotate_camera

WIDE = 640  # width of the image that shifts in pixels are meant for


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames in order of time, and where they were truly taken."""

    name: str
    frames: tuple[Frame, ...]
    truth: Floats  # (T, 4, 4) map_from_camera
    period: float  # seconds from a frame to the next
    world: Callable[[], SceneMap] | None = None
    """Opens the finest map there is, in the frame of the truth, to render from."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Frames of one window, and where they were truly taken."""

    frames: tuple[Frame, ...]
    truth: Floats  # (T, 4, 4) map_from_camera
    recording: Recording
    rows: tuple[int, ...]  # of the recording that the frames are

    @classmethod
    def of(cls, recording: Recording, rows: range) -> Self:
        """Frames of a recording as they are."""
        frames = tuple(recording.frames[i] for i in rows)
        return cls(frames, recording.truth[list(rows)], recording, tuple(rows))

    @property
    def name(self) -> str:
        step = f":{self.rows[1] - self.rows[0]}" if len(self.rows) > 1 else ""
        whole = "" if step == ":1" else step
        return f"{self.recording.name} {self.rows[0]}:{self.rows[-1] + 1}{whole}"

    def each(self, change: Callable[[Frame], Frame]) -> Self:
        """The shot with each frame changed."""
        return replace(self, frames=tuple(change(frame) for frame in self.frames))


def seen(
    frame: Frame,
    *,
    rgb: NDArray[Any] | None = None,
    depth: NDArray[Any] | None = None,
    **more: Any,
) -> Frame:
    """Frame with other images in memory, without labels; those not given stay."""
    metres = frame.depth() if depth is None else depth.astype(np.float32)
    images = ArrayImages(frame.rgb() if rgb is None else rgb, metres, None)
    return replace(frame, images=images, label_camera=None, label_kind=None, **more)


# ------------------------------------------------------------------------------------- the place


def height(shot: Shot, metres: float, rng: Generator) -> Shot:
    """From the same places at another height above the floor, rendered, with sensors' noise."""
    assert shot.recording.world is not None  # noqa: S101  sets say what can be rendered
    world = shot.recording.world()
    truth = shot.truth.copy()
    truth[:, 2, 3] += float(world.floors[0]) + metres - float(np.median(truth[:, 2, 3]))
    pairs = zip(shot.frames, truth, strict=True)
    return replace(
        shot, truth=truth, frames=tuple(_rendered(world, f, pose, rng) for f, pose in pairs)
    )


def _rendered(world: SceneMap, frame: Frame, pose: Floats, rng: Generator) -> Frame:
    from PIL import Image, ImageFilter

    colour = world.render(pose, frame.camera, samples=2).colour / 255.0
    gain, gamma = rng.uniform(0.75, 1.15), rng.uniform(0.85, 1.2)
    noisy = 255.0 * gain * colour**gamma + 4.0 * rng.normal(size=colour.shape)
    image = Image.fromarray(np.clip(noisy, 0, 255).astype(np.uint8))
    rgb = np.asarray(image.filter(ImageFilter.GaussianBlur(0.6)))
    assert frame.depth_camera is not None  # noqa: S101  all sets have depth
    depth = np.asarray(world.render(pose, frame.depth_camera, samples=1).depth, np.float64)
    sd = 0.0012 + 0.0019 * np.maximum(depth - 0.4, 0.0) ** 2
    depth = depth + sd * rng.normal(size=depth.shape)
    depth[(rng.random(depth.shape) < 0.1) | (depth > 9.0)] = np.nan
    return seen(frame, rgb=rgb, depth=depth)


# ------------------------------------------------------------------------------------ the motion


def drift(shot: Shot, degrees: float, rng: Generator) -> Shot:
    """Odometry that wanders: degrees of yaw a frame, and twice as many % of the way, at random."""
    noise = rng.standard_normal((len(shot.frames) - 1, 4))
    return _bent(shot, degrees, noise)


def steady_drift(shot: Shot, degrees: float, rng: Generator) -> Shot:  # noqa: ARG001
    """The same, all one way, and every step too long: a wheel that slips."""
    return _bent(shot, degrees, np.ones((len(shot.frames) - 1, 4)), along=True)


def _bent(shot: Shot, degrees: float, noise: Floats, *, along: bool = False) -> Shot:
    poses, level = split_pose(np.stack([f.odometry for f in shot.frames]))
    steps = between(poses[:-1], poses[1:])
    lengths = np.linalg.norm(steps[:, :3], axis=1, keepdims=True)
    errors = steps[:, :3] if along else lengths * noise[:, :3]
    steps[:, :3] += 0.02 * degrees * errors
    steps[:, 3] += np.radians(degrees) * noise[:, 3]
    found = [poses[0]]
    for step in steps:
        found.append(compose(found[-1], step))
    bent = pose_matrix(np.array(found), level)
    pairs = zip(shot.frames, bent, strict=True)
    return replace(shot, frames=tuple(replace(f, odometry=pose) for f, pose in pairs))


def tilt(shot: Shot, degrees: float, rng: Generator) -> Shot:
    """Gravity that errs by one angle in all frames: the sensor is mounted aslant."""
    down = shot.frames[0].gravity
    axis = rng.standard_normal(3)
    axis -= axis @ down * down
    turn = rotation_from_vector(np.radians(degrees) * axis / np.linalg.norm(axis))
    return shot.each(lambda f: replace(f, gravity=turn @ f.gravity))


def shaken(shot: Shot, degrees: float, rng: Generator) -> Shot:
    """Gravity that errs anew in each frame, by an angle of this deviation about each axis."""

    def change(frame: Frame) -> Frame:
        turn = rotation_from_vector(np.radians(degrees) * rng.standard_normal(3))
        return replace(frame, gravity=turn @ frame.gravity)

    return shot.each(change)


def dropped(shot: Shot, percent: float, rng: Generator) -> Shot:
    """So many of the frames are missing; the last is there."""
    last = len(shot.frames) - 1
    count = last - round(percent / 100.0 * len(shot.frames))
    kept = [*np.sort(rng.choice(last, count, replace=False)).tolist(), last]
    return replace(
        shot,
        frames=tuple(shot.frames[i] for i in kept),
        truth=shot.truth[kept],
        rows=tuple(shot.rows[i] for i in kept),
    )


def rolling(shot: Shot, milliseconds: float, rng: Generator) -> Shot:
    """Odometry and gravity of up to so much earlier or later than the image, frame by frame."""
    all_frames, frames = shot.recording.frames, []
    for frame, row in zip(shot.frames, shot.rows, strict=True):
        part = rng.uniform(-1.0, 1.0) * milliseconds / 1000.0 / shot.recording.period
        other = min(max(row + (1 if part > 0 else -1), 0), len(all_frames) - 1)
        here, there = frame.odometry, all_frames[other].odometry
        moved = here.copy()
        moved[:3, 3] += abs(part) * (there[:3, 3] - here[:3, 3])
        turn = vector_from_rotation(there[:3, :3] @ here[:3, :3].T)
        moved[:3, :3] = rotation_from_vector(abs(part) * turn) @ here[:3, :3]
        gravity = moved[:3, :3].T @ (here[:3, :3] @ frame.gravity)
        frames.append(replace(frame, odometry=moved, gravity=gravity))
    return replace(shot, frames=tuple(frames))


# ------------------------------------------------------------------------------------ the camera


def focal(shot: Shot, percent: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Focal lengths told so many % too long."""

    def told(camera: Camera) -> Camera:
        return replace(
            camera, fx=camera.fx * (1 + percent / 100), fy=camera.fy * (1 + percent / 100)
        )

    return shot.each(
        lambda f: replace(
            f, camera=told(f.camera), depth_camera=f.depth_camera and told(f.depth_camera)
        )
    )


def depth_scale(shot: Shot, percent: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Readings so many % too long."""
    return shot.each(lambda f: seen(f, depth=_depth(f) * (1 + percent / 100)))


def depth_late(shot: Shot, count: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Depth of so many frames of the recording before."""
    rows = [max(0, row - int(count)) for row in shot.rows]
    pairs = zip(shot.frames, rows, strict=True)
    frames = shot.recording.frames
    return replace(shot, frames=tuple(seen(f, depth=_depth(frames[row])) for f, row in pairs))


def depth_aside(shot: Shot, pixels: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Depth shifted to the right, and half as far down, by so many pixels of an image 640 wide."""

    def change(frame: Frame) -> Frame:
        depth = _depth(frame)
        k = round(pixels * depth.shape[1] / WIDE)
        moved = np.full_like(depth, np.nan)
        moved[k // 2 :, k:] = depth[: depth.shape[0] - k // 2, : depth.shape[1] - k]
        return seen(frame, depth=moved)

    return shot.each(change)


def crop(shot: Shot, shape: float, rng: Generator) -> Shot:  # noqa: ARG001
    """The middle of images, of their full height, `shape` times as wide as high."""

    def cut(camera: Camera, image: NDArray[Any]) -> tuple[Camera, NDArray[Any]]:
        width = min(camera.width, round(shape * camera.height))
        x = (camera.width - width) // 2
        inner = np.ascontiguousarray(image[:, x : x + width])
        return replace(camera, width=width, cx=camera.cx - x), inner

    def change(frame: Frame) -> Frame:
        assert frame.depth_camera is not None  # noqa: S101
        camera, rgb = cut(frame.camera, frame.rgb())
        depth_camera, depth = cut(frame.depth_camera, _depth(frame))
        return seen(frame, rgb=rgb, depth=depth, camera=camera, depth_camera=depth_camera)

    return shot.each(change)


def turned(shot: Shot, degrees: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Images turned by quarters, counter-clockwise, camera and gravity with them."""
    turns = round(degrees / 90.0)
    turn = quarter_turn(turns)

    def change(frame: Frame) -> Frame:
        assert frame.depth_camera is not None  # noqa: S101
        odometry = frame.odometry.copy()
        odometry[:3, :3] = odometry[:3, :3] @ turn.T
        return seen(
            frame,
            rgb=np.ascontiguousarray(np.rot90(frame.rgb(), turns)),
            depth=np.ascontiguousarray(np.rot90(_depth(frame), turns)),
            camera=rotate_camera(frame.camera, turns),
            depth_camera=rotate_camera(frame.depth_camera, turns),
            odometry=odometry,
            gravity=turn @ frame.gravity,
        )

    truth = shot.truth.copy()
    truth[:, :3, :3] = truth[:, :3, :3] @ turn.T
    return replace(shot.each(change), truth=truth)


def _depth(frame: Frame) -> NDArray[np.float32]:
    depth = frame.depth()
    assert depth is not None  # noqa: S101  all sets have depth
    return depth


def dark(shot: Shot, percent: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Images of so much of the light."""
    return shot.each(lambda f: seen(f, rgb=(f.rgb() * (percent / 100.0)).astype(np.uint8)))


def noise(shot: Shot, deviation: float, rng: Generator) -> Shot:
    """Noise of so many of 255 steps in each pixel and channel."""

    def change(frame: Frame) -> Frame:
        rgb = frame.rgb()
        noisy = rgb + deviation * rng.normal(size=rgb.shape)
        return seen(frame, rgb=np.clip(noisy, 0, 255).astype(np.uint8))

    return shot.each(change)


def blur(shot: Shot, pixels: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Images blurred by a Gaussian of so many pixels."""
    from PIL import Image, ImageFilter

    def change(frame: Frame) -> Frame:
        image = Image.fromarray(frame.rgb()).filter(ImageFilter.GaussianBlur(pixels))
        return seen(frame, rgb=np.asarray(image))

    return shot.each(change)


# ----------------------------------------------------------------------------------- bad input


def lens_cap(shot: Shot, _: float, rng: Generator) -> Shot:
    """Black images with a sensor's noise, and no reading of depth."""

    def change(frame: Frame) -> Frame:
        black = np.clip(3.0 + 2.0 * rng.normal(size=frame.rgb().shape), 0, 255)
        depth = frame.depth()
        blind = None if depth is None else np.full_like(depth, np.nan)
        return seen(frame, rgb=black.astype(np.uint8), depth=blind)

    return shot.each(change)


def frozen(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """All images are the first, while odometry goes on."""
    first = seen(shot.frames[0])
    return shot.each(lambda f: seen(f, rgb=first.rgb(), depth=first.depth()))


def mirrored(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Left and right changed in images and depth."""

    def change(frame: Frame) -> Frame:
        depth = frame.depth()
        flipped = None if depth is None else np.ascontiguousarray(depth[:, ::-1])
        return seen(frame, rgb=np.ascontiguousarray(frame.rgb()[:, ::-1]), depth=flipped)

    return shot.each(change)


def gravity_up(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Gravity with the wrong sign, as of an accelerometer at rest."""
    return shot.each(lambda f: replace(f, gravity=-f.gravity))


def without_odometry(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Return the shot with the odometry of its first frame in all frames."""
    return shot.each(lambda f: replace(f, odometry=shot.frames[0].odometry))


def backwards(shot: Shot, _: float, rng: Generator) -> Shot:  # noqa: ARG001
    """Stamps fall from frame to frame."""
    stamps = [f.stamp for f in shot.frames][::-1]
    pairs = zip(shot.frames, stamps, strict=True)
    return replace(shot, frames=tuple(replace(f, stamp=stamp) for f, stamp in pairs))


def half_elsewhere(shot: Shot, other: Recording) -> Shot:
    """The first half of the images is of another recording."""
    frames = list(shot.frames)
    for i in range(len(frames) // 2):
        theirs = other.frames[i]
        frames[i] = seen(
            frames[i],
            rgb=theirs.rgb(),
            depth=theirs.depth(),
            camera=theirs.camera,
            depth_camera=theirs.depth_camera,
        )
    return replace(shot, frames=tuple(frames))


def only(shot: Shot, senses: tuple[str, ...]) -> Shot:
    """The shot with these of `labels`, `depth` and `colour`; who has none of them is refused."""
    if not senses:
        raise OptionError("senses: there is none; give labels, depth or colour.")
    labels, depth = "labels" in senses, "depth" in senses

    def change(frame: Frame) -> Frame:
        images = ArrayImages(
            frame.rgb(), frame.depth() if depth else None, frame.labels() if labels else None
        )
        return replace(
            frame,
            images=images,
            depth_camera=frame.depth_camera if depth else None,
            label_camera=frame.label_camera if labels else None,
            label_kind=frame.label_kind if labels else None,
        )

    return shot.each(change)
