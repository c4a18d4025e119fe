"""Captures from bags of ROS 1 and ROS 2, without an installation of ROS.

`walk.mcap`, `walk.db3`, `walk.bag`, or a folder of rosbag2. `walk.mcap.json` beside it may add what
the bag lacks (`read_topic_choice`). Poses are those of the camera's optical frame, whose axes are OpenCV's
(REP 103), in `odom`, whose z points up (REP 105).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.frame import Capture, DepthUnit, LazyImages, check_shape
from placegraph.io.capture.posed import (
    SAME_MOMENT,
    StoredFrame,
    interpolate_poses,
    make_capture,
    match_stamps,
)
from placegraph.io.capture.tum import read_tum
from placegraph_io.ros.containers import Message, Topic, is_bag, open_bag, read_messages
from placegraph_io.ros.decode import (
    Registration,
    decode_colour,
    decode_depth,
    decode_message,
    read_stamps,
)
from placegraph_io.ros.poses import PoseReader
from placegraph_io.ros.topics import CameraReader, CapturePlan, plan_capture, read_topic_choice

__all__ = [
    "MessageSource",
    "capture_of_plan",
    "depth_unit",
    "is_bag",
    "read_bag",
    "read_colour",
    "read_depth",
]


def read_bag(
    path: Path, *, poses: Path | None = None, topics: Mapping[str, Any] | None = None
) -> Capture:
    """Read a bag: its index, stamps and transforms; images when they are asked for.

    `poses` is a trajectory of the same clock, which replaces transforms and odometry; `topics` has the
    keys of `BAG.json`. Raises `InputError` where the bag is damaged or incomplete, `OptionError` for
    invalid `topics`, `MissingExtraError` where `rosbags` is not installed.
    """
    return capture_of_plan(plan_capture(open_bag(path), read_topic_choice(path, topics)), poses)


def capture_of_plan(plan: CapturePlan, poses: Path | None = None) -> Capture:
    """Return the capture of a plan; `poses` is a trajectory, which replaces transforms and odometry."""
    for role in ("colour", "camera", "depth") if poses else ("colour", "camera", "poses", "depth"):
        if role in plan.missing:
            raise InputError(plan.missing[role])
    pose_reader = plan.pose_reader
    assert pose_reader is not None  # noqa: S101  # else there would be no colour
    if poses is None:
        missing = f"no transform from {pose_reader.colour.frame} to {pose_reader.frame}"
        frames = _stored_frames(plan, pose_reader, pose_reader.poses(), missing)
    else:
        frames = _stored_frames(
            plan, pose_reader, _given_poses(poses, pose_reader), f"no pose in {poses.name}"
        )
    return make_capture(plan.bag.path, frames, left_out=pose_reader.left_out, notes=plan.notes)


def _given_poses(poses: Path, pose_reader: PoseReader) -> NDArray[np.float64]:
    """Return the poses (T, 4, 4) of the images by a trajectory's rows or stamps; NaN where it has none."""
    trajectory, stamps = read_tum(poses), pose_reader.stamps[pose_reader.rows]
    if len(trajectory) == len(stamps):
        return trajectory.poses
    known = match_stamps(trajectory.stamps, stamps, SAME_MOMENT) >= 0
    found = interpolate_poses(trajectory.stamps, trajectory.poses, stamps)
    return np.where(known[:, None, None], found, np.nan)


def _stored_frames(
    plan: CapturePlan, pose_reader: PoseReader, poses: NDArray[np.float64], missing: str
) -> list[StoredFrame]:
    """Return the colour images with a pose, and with depth where the bag has any."""
    colour, depth, stamps = (
        pose_reader.colour,
        pose_reader.depth,
        pose_reader.stamps[pose_reader.rows],
    )
    views = _read_cameras(plan.camera, plan.camera_reader, pose_reader)
    reader = plan.depth_camera_reader if plan.registration is None else None
    depth_views = _read_cameras(plan.depth_camera, reader, pose_reader)
    lost = np.full(len(stamps), "", object)
    depth_of, moved = np.full(len(stamps), -1), None
    if depth is not None:
        depth_of = match_stamps(pose_reader.depth_stamps, stamps, SAME_MOMENT)
        lost[depth_of < 0] = f"no depth within {SAME_MOMENT * 1000:.0f} ms"
        if plan.registration is not None:
            moved = pose_reader.tree.lookup(colour.frame, depth.frame, stamps)
            assert moved is not None  # noqa: S101  # else depth would lack
            lost[np.isnan(moved[:, 0, 0])] = f"no transform from {depth.frame} to {colour.frame}"
    lost[np.isnan(poses[:, 0, 0])] = missing
    lost[np.setdiff1d(np.arange(len(stamps)), np.unique(stamps, return_index=True)[1])] = (
        "a repeated stamp"
    )
    pose_reader.left_out.update(why for why in lost if why)
    unit, source = depth_unit(plan), MessageSource.from_topic(colour.topic)
    frames = []
    for i in np.flatnonzero(lost == "").tolist():
        row, metres = int(pose_reader.rows[i]), None
        if depth is not None:
            metres = partial(
                read_depth, depth.topic[int(depth_of[i])], MessageSource.from_topic(depth.topic), depth.size,
                plan.choice.depth_scale, plan.registration, None if moved is None else moved[i],
            )  # fmt: skip
        camera = views[i]
        assert camera is not None  # noqa: S101  # else it would lack
        images = LazyImages(
            partial(read_colour, colour.topic[row], source, camera), metres, unit=unit
        )
        name = f"{plan.bag.path}, {colour.topic.name}, message {row}"
        frames.append(StoredFrame(name, float(stamps[i]), poses[i], camera, images, depth_views[i]))
    return frames


_SAMPLES = 16  # messages of a CameraInfo topic that tell whether it changes


def _read_cameras(
    camera: Camera | None, reader: CameraReader | None, pose_reader: PoseReader
) -> list[Camera | None]:
    """Return the camera of each image: the given one, or that of the nearest CameraInfo if they change."""
    stamps = pose_reader.stamps[pose_reader.rows]
    if reader is None:
        return [camera] * len(stamps)
    topic = reader.topic
    some = np.unique(np.linspace(0, len(topic) - 1, _SAMPLES).astype(np.intp))
    if len({reader.read(data) for data in read_messages([(topic, some, None)])[0]}) == 1:
        return [camera] * len(stamps)
    (messages,) = read_messages([(topic, None, None)])
    of = 1e-9 * topic.times if pose_reader.recorded else read_stamps(messages, topic)
    return [reader.read(messages[i]) for i in match_stamps(of, stamps, np.inf)]


def depth_unit(plan: CapturePlan) -> DepthUnit | None:
    """Return the unit of depth and its source; None without depth."""
    if plan.depth is None:
        return None
    if plan.choice.depth_scale:
        return DepthUnit(f'"depth_scale" in {plan.bag.path}.json', plan.choice.depth_scale)
    metres = plan.depth.encoding.startswith("32F")
    source = f"the encoding {plan.depth.encoding} in {plan.depth.topic.name}"
    return DepthUnit(source, 1.0 if metres else 1000.0)


class MessageSource(NamedTuple):
    """Topic, type and encoding of a message."""

    topic: str
    type: str
    encoding: str

    @classmethod
    def from_topic(cls, topic: Topic) -> MessageSource:
        """Return those of a topic's messages."""
        return cls(topic.name, topic.type, topic.encoding)


def read_colour(message: Message, source: MessageSource, camera: Camera) -> NDArray[np.uint8]:
    """Return the colours (H, W, 3) of a message; `InputError` where they do not fit the camera."""
    name = f"{message.place.path}, {source.topic}"
    image = decode_colour(decode_message(message, *source), name)
    check_shape(image, camera, name)
    return image


def read_depth(
    message: Message,
    source: MessageSource,
    size: tuple[int, int],
    per_metre: float | None,
    registration: Registration | None,
    colour_from_depth: NDArray[np.float64] | None,
) -> NDArray[np.float32]:
    """Return the depth (h, w) [m] of a message, registered to the colour camera if asked."""
    name = f"{message.place.path}, {source.topic}"
    image = decode_depth(decode_message(message, *source), per_metre, name)
    if image.shape != size[::-1]:
        raise InputError(
            f"{name} has {image.shape[1]} x {image.shape[0]} pixels, but its first image has "
            f"{size[0]} x {size[1]}; record depth at one size."
        )
    if registration is not None and colour_from_depth is not None:
        return registration(image, colour_from_depth)
    return image
