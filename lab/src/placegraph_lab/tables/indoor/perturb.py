"""Perturbations of captures: clips of recordings, changed in one way, by a strength.

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
class Clip:
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

    def map_frames(self, change: Callable[[Frame], Frame]) -> Self:
        """The clip with each frame changed."""
        return replace(self, frames=tuple(change(frame) for frame in self.frames))


def with_images(
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


def height(clip: Clip, metres: float, rng: Generator) -> Clip:
    """From the same places at another height above the floor, rendered, with sensors' noise."""
    assert clip.recording.world is not None  # noqa: S101  sets say what can be rendered
    world = clip.recording.world()
    truth = clip.truth.copy()
    truth[:, 2, 3] += float(world.floors[0]) + metres - float(np.median(truth[:, 2, 3]))
    pairs = zip(clip.frames, truth, strict=True)
    return replace(
        clip, truth=truth, frames=tuple(_rendered(world, f, pose, rng) for f, pose in pairs)
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
    return with_images(frame, rgb=rgb, depth=depth)


# ------------------------------------------------------------------------------------ the motion


def drift(clip: Clip, degrees: float, rng: Generator) -> Clip:
    """Odometry that wanders: degrees of yaw a frame, and twice as many % of the way, at random."""
    noise = rng.standard_normal((len(clip.frames) - 1, 4))
    return _bent(clip, degrees, noise)


def steady_drift(clip: Clip, degrees: float, rng: Generator) -> Clip:  # noqa: ARG001
    """The same, all one way, and every step too long: a wheel that slips."""
    return _bent(clip, degrees, np.ones((len(clip.frames) - 1, 4)), along=True)


def _bent(clip: Clip, degrees: float, noise: Floats, *, along: bool = False) -> Clip:
    poses, level = split_pose(np.stack([f.odometry for f in clip.frames]))
    steps = between(poses[:-1], poses[1:])
    lengths = np.linalg.norm(steps[:, :3], axis=1, keepdims=True)
    errors = steps[:, :3] if along else lengths * noise[:, :3]
    steps[:, :3] += 0.02 * degrees * errors
    steps[:, 3] += np.radians(degrees) * noise[:, 3]
    found = [poses[0]]
    for step in steps:
        found.append(compose(found[-1], step))
    bent = pose_matrix(np.array(found), level)
    pairs = zip(clip.frames, bent, strict=True)
    return replace(clip, frames=tuple(replace(f, odometry=pose) for f, pose in pairs))


def tilt(clip: Clip, degrees: float, rng: Generator) -> Clip:
    """Gravity that errs by one angle in all frames: the sensor is mounted aslant."""
    down = clip.frames[0].gravity
    axis = rng.standard_normal(3)
    axis -= axis @ down * down
    turn = rotation_from_vector(np.radians(degrees) * axis / np.linalg.norm(axis))
    return clip.map_frames(lambda f: replace(f, gravity=turn @ f.gravity))


def shake_gravity(clip: Clip, degrees: float, rng: Generator) -> Clip:
    """Gravity that errs anew in each frame, by an angle of this deviation about each axis."""

    def change(frame: Frame) -> Frame:
        turn = rotation_from_vector(np.radians(degrees) * rng.standard_normal(3))
        return replace(frame, gravity=turn @ frame.gravity)

    return clip.map_frames(change)


def drop_frames(clip: Clip, percent: float, rng: Generator) -> Clip:
    """So many of the frames are missing; the last is there."""
    last = len(clip.frames) - 1
    count = last - round(percent / 100.0 * len(clip.frames))
    kept = [*np.sort(rng.choice(last, count, replace=False)).tolist(), last]
    return replace(
        clip,
        frames=tuple(clip.frames[i] for i in kept),
        truth=clip.truth[kept],
        rows=tuple(clip.rows[i] for i in kept),
    )


def shift_odometry(clip: Clip, milliseconds: float, rng: Generator) -> Clip:
    """Odometry and gravity of up to so much earlier or later than the image, frame by frame."""
    all_frames, frames = clip.recording.frames, []
    for frame, row in zip(clip.frames, clip.rows, strict=True):
        part = rng.uniform(-1.0, 1.0) * milliseconds / 1000.0 / clip.recording.period
        other = min(max(row + (1 if part > 0 else -1), 0), len(all_frames) - 1)
        here, there = frame.odometry, all_frames[other].odometry
        moved = here.copy()
        moved[:3, 3] += abs(part) * (there[:3, 3] - here[:3, 3])
        turn = vector_from_rotation(there[:3, :3] @ here[:3, :3].T)
        moved[:3, :3] = rotation_from_vector(abs(part) * turn) @ here[:3, :3]
        gravity = moved[:3, :3].T @ (here[:3, :3] @ frame.gravity)
        frames.append(replace(frame, odometry=moved, gravity=gravity))
    return replace(clip, frames=tuple(frames))


# ------------------------------------------------------------------------------------ the camera


def focal(clip: Clip, percent: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Focal lengths told so many % too long."""

    def lengthened(camera: Camera) -> Camera:
        return replace(
            camera, fx=camera.fx * (1 + percent / 100), fy=camera.fy * (1 + percent / 100)
        )

    return clip.map_frames(
        lambda f: replace(
            f,
            camera=lengthened(f.camera),
            depth_camera=f.depth_camera and lengthened(f.depth_camera),
        )
    )


def depth_scale(clip: Clip, percent: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Readings so many % too long."""
    return clip.map_frames(lambda f: with_images(f, depth=_depth(f) * (1 + percent / 100)))


def depth_late(clip: Clip, count: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Depth of so many frames of the recording before."""
    rows = [max(0, row - int(count)) for row in clip.rows]
    pairs = zip(clip.frames, rows, strict=True)
    frames = clip.recording.frames
    return replace(
        clip, frames=tuple(with_images(f, depth=_depth(frames[row])) for f, row in pairs)
    )


def depth_aside(clip: Clip, pixels: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Depth shifted to the right, and half as far down, by so many pixels of an image 640 wide."""

    def change(frame: Frame) -> Frame:
        depth = _depth(frame)
        k = round(pixels * depth.shape[1] / WIDE)
        moved = np.full_like(depth, np.nan)
        moved[k // 2 :, k:] = depth[: depth.shape[0] - k // 2, : depth.shape[1] - k]
        return with_images(frame, depth=moved)

    return clip.map_frames(change)


def crop(clip: Clip, shape: float, rng: Generator) -> Clip:  # noqa: ARG001
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
        return with_images(frame, rgb=rgb, depth=depth, camera=camera, depth_camera=depth_camera)

    return clip.map_frames(change)


def turn_images(clip: Clip, degrees: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Images turned by quarters, counter-clockwise, camera and gravity with them."""
    turns = round(degrees / 90.0)
    turn = quarter_turn(turns)

    def change(frame: Frame) -> Frame:
        assert frame.depth_camera is not None  # noqa: S101
        odometry = frame.odometry.copy()
        odometry[:3, :3] = odometry[:3, :3] @ turn.T
        return with_images(
            frame,
            rgb=np.ascontiguousarray(np.rot90(frame.rgb(), turns)),
            depth=np.ascontiguousarray(np.rot90(_depth(frame), turns)),
            camera=rotate_camera(frame.camera, turns),
            depth_camera=rotate_camera(frame.depth_camera, turns),
            odometry=odometry,
            gravity=turn @ frame.gravity,
        )

    truth = clip.truth.copy()
    truth[:, :3, :3] = truth[:, :3, :3] @ turn.T
    return replace(clip.map_frames(change), truth=truth)


def _depth(frame: Frame) -> NDArray[np.float32]:
    depth = frame.depth()
    assert depth is not None  # noqa: S101  all sets have depth
    return depth


def dark(clip: Clip, percent: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Images of so much of the light."""
    return clip.map_frames(
        lambda f: with_images(f, rgb=(f.rgb() * (percent / 100.0)).astype(np.uint8))
    )


def noise(clip: Clip, deviation: float, rng: Generator) -> Clip:
    """Noise of so many of 255 steps in each pixel and channel."""

    def change(frame: Frame) -> Frame:
        rgb = frame.rgb()
        noisy = rgb + deviation * rng.normal(size=rgb.shape)
        return with_images(frame, rgb=np.clip(noisy, 0, 255).astype(np.uint8))

    return clip.map_frames(change)


def blur(clip: Clip, pixels: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Images blurred by a Gaussian of so many pixels."""
    from PIL import Image, ImageFilter

    def change(frame: Frame) -> Frame:
        image = Image.fromarray(frame.rgb()).filter(ImageFilter.GaussianBlur(pixels))
        return with_images(frame, rgb=np.asarray(image))

    return clip.map_frames(change)


# ----------------------------------------------------------------------------------- bad input


def lens_cap(clip: Clip, _: float, rng: Generator) -> Clip:
    """Black images with a sensor's noise, and no reading of depth."""

    def change(frame: Frame) -> Frame:
        black = np.clip(3.0 + 2.0 * rng.normal(size=frame.rgb().shape), 0, 255)
        depth = frame.depth()
        blind = None if depth is None else np.full_like(depth, np.nan)
        return with_images(frame, rgb=black.astype(np.uint8), depth=blind)

    return clip.map_frames(change)


def freeze_images(clip: Clip, _: float, rng: Generator) -> Clip:  # noqa: ARG001
    """All images are the first, while odometry goes on."""
    first = with_images(clip.frames[0])
    return clip.map_frames(lambda f: with_images(f, rgb=first.rgb(), depth=first.depth()))


def mirror_images(clip: Clip, _: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Left and right changed in images and depth."""

    def change(frame: Frame) -> Frame:
        depth = frame.depth()
        flipped = None if depth is None else np.ascontiguousarray(depth[:, ::-1])
        return with_images(frame, rgb=np.ascontiguousarray(frame.rgb()[:, ::-1]), depth=flipped)

    return clip.map_frames(change)


def gravity_up(clip: Clip, _: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Gravity with the wrong sign, as of an accelerometer at rest."""
    return clip.map_frames(lambda f: replace(f, gravity=-f.gravity))


def without_odometry(clip: Clip, _: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Return the clip with the odometry of its first frame in all frames."""
    return clip.map_frames(lambda f: replace(f, odometry=clip.frames[0].odometry))


def backwards(clip: Clip, _: float, rng: Generator) -> Clip:  # noqa: ARG001
    """Stamps fall from frame to frame."""
    stamps = [f.stamp for f in clip.frames][::-1]
    pairs = zip(clip.frames, stamps, strict=True)
    return replace(clip, frames=tuple(replace(f, stamp=stamp) for f, stamp in pairs))


def half_elsewhere(clip: Clip, other: Recording) -> Clip:
    """The first half of the images is of another recording."""
    frames = list(clip.frames)
    for i in range(len(frames) // 2):
        theirs = other.frames[i]
        frames[i] = with_images(
            frames[i],
            rgb=theirs.rgb(),
            depth=theirs.depth(),
            camera=theirs.camera,
            depth_camera=theirs.depth_camera,
        )
    return replace(clip, frames=tuple(frames))


def only(clip: Clip, senses: tuple[str, ...]) -> Clip:
    """The clip with these of `labels`, `depth` and `colour`; who has none of them is refused."""
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

    return clip.map_frames(change)
