"""Opening captures of all recorders (`docs/formats.md`)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from placegraph.core.plugins import CAPTURES, missing_extra, plugins
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import (
    ArrayImages,
    Capture,
    Frame,
    LabelKind,
    LazyImages,
    quarter_turn,
)
from placegraph.io.capture.posed import SAME_MOMENT, interpolate_poses, match_stamps
from placegraph.io.capture.tum import read_tum
from placegraph.io.formats import Format

__all__ = ["ArrayImages", "Capture", "Frame", "LabelKind", "open_capture"]


def open_capture(
    path: str | PathLike[str],
    *,
    labels: Literal["auto", "labels", "instances"] | None = "auto",
    poses: str | PathLike[str] | None = None,
    scale: float | None = None,
    up: ArrayLike | None = None,
    topics: Mapping[str, Any] | None = None,
) -> Capture:
    """Open a capture of any known recorder; images are read when they are needed.

    Parameters
    ----------
    path
        Capture folder: `rgb/`, `camera.json`, `odometry.tum`, and optionally `depth/`, `instances/`
        or `labels/` with `labels.json`, and `gravity.txt`. Without `gravity.txt`, gravity is -z of the
        odometry's frame. Or a capture of another recorder; `capture_formats` lists them.
    labels
        Labels of a capture folder: "auto" takes `instances/`, else `labels/`, else none.
    poses
        Source of the poses. None or "odometry": the recorder's own. "trajectory": the ground truth
        `trajectory.tum`, for building maps, never for localizing. Or a file in TUM's format, z up,
        OpenCV's camera axes; its rows belong to the images in order if there are as many, else to
        images of the same stamps (within 20 ms).
    scale
        For COLMAP models and `transforms.json`: metres in a unit of the model; estimated from depth
        if not given.
    up
        For COLMAP models and `transforms.json`: (3,) direction of up; estimated if not given.
    topics
        For ROS bags: topics, frames and intrinsics by role, overriding `BAG.json` beside the bag
        (`docs/howto-bags.md`); found by type if not given.

    Raises
    ------
    InputError
        The format is unknown; a file is missing, unreadable or malformed; rows and images differ in
        number.
    OptionError
        `labels` is none of its values; the recorder has no such option.
    MissingExtraError
        A decoder of its images is not installed.

    """
    if labels not in {"auto", "labels", "instances", None}:
        raise OptionError(
            f"labels is {labels!r}; it must be 'auto', 'labels', 'instances' or None."
        )
    options = {"poses": poses, "scale": scale, "up": up, "topics": topics}
    given = {name: value for name, value in options.items() if value is not None}
    return load_capture(Path(path), given | {"labels": labels})


def load_capture(path: Path, options: Mapping[str, Any]) -> Capture:
    """Read a capture with options of its recorder's reader; raises as `open_capture`."""
    format_ = find_format(path)
    if isinstance(format_, AbsentFormat):
        raise missing_extra(f"A reader of {path}", "io")
    options = dict(options)
    poses = options.pop("poses", None)
    ignored = ("labels",) if options.get("labels") in {"auto", None} else ()
    if poses in {None, "odometry"}:
        own: Capture = format_.read(path, options, ignored)
        return own
    file = path / "trajectory.tum" if poses == "trajectory" else Path(poses)
    if "poses" in format_.takes:
        capture: Capture = format_.read(path, options | {"poses": file}, ignored)
        return capture
    return replace_poses(format_.read(path, options, ignored), file)


_OWN = (
    Format(
        "a video with a trajectory",
        "a video, camera.json and odometry.tum or .csv",
        "placegraph.io.capture.video",
        "video_folder",
        rank=1,
    ),
    Format(
        "capture folder",
        "rgb/, camera.json and odometry.tum",
        "placegraph.io.capture.capture_folder",
        "capture_folder",
        ("labels",),
        rank=2,
    ),
)
_ELSEWHERE = {
    0: (
        "*.r3d", "*.sens", "*.db", "rgb.txt", "camera_matrix.csv", "keyframes", "rgbd", "depth/*.exr",
        "EXR_RGBD", "*.jsonl", "ARposes.txt", "frame_0*.json", "lowres_wide.traj", "_info.txt",
        "sequence/_info.txt", "sequence.zip", "intrinsic_color.txt", "intrinsic/intrinsic_color.txt",
        "cameras.bin", "cameras.txt", "sparse/0", "transforms.json",
    ),
    3: ("*.mcap", "*.db3", "*.bag", "*.mcap.zstd", "*.db3.zstd"),
}  # fmt: skip
"""Files, or files in a folder, of the formats that the extra `io` reads, by rank."""


class AbsentFormat(NamedTuple):
    """Formats of a plugin that is not installed."""

    rank: int
    name: str = "captures of other recorders, data sets and bags"

    def __str__(self) -> str:
        return f"{self.name} (install the extra `io` for them)"

    def matches(self, path: Path) -> bool:
        """Return whether a path looks like one of these formats."""
        patterns = _ELSEWHERE[self.rank]
        try:
            if path.is_dir():
                return any(next(path.glob(pattern), None) is not None for pattern in patterns)
            return any(path.match(pattern) for pattern in patterns)
        except OSError:  # the path may not be read
            return False


@cache
def capture_formats() -> tuple[Format | AbsentFormat, ...]:
    """Return all formats of captures, plugins' included, in the order in which they are tried."""
    points = plugins(CAPTURES)
    formats: list[Format | AbsentFormat] = [f for point in points.values() for f in point.load()]
    if "io" not in points:
        formats += [AbsentFormat(rank) for rank in _ELSEWHERE]
    return tuple(sorted([*formats, *_OWN], key=lambda format_: format_.rank))


def find_format(path: Path) -> Format | AbsentFormat:
    """Return the format of a capture; `InputError`, which describes the folder, where none matches."""
    if not path.exists():
        raise InputError(f"{path} does not exist; a capture is a folder that a recorder wrote.")
    for format_ in capture_formats():
        if format_.matches(path):
            return format_
    if path.suffix in {".scene", ".city", ".library"}:
        raise InputError(f"{path} is a map, not a capture; check the order of map and capture.")
    raise InputError(describe_unknown(path))


_LISTED = 8  # kinds of files that a message lists


def describe_unknown(path: Path) -> str:
    """Describe a folder that no reader knows: its files, the nearest reader, and what to do."""
    kinds: dict[tuple[str, str], list[str]] = {}
    for p in sorted([*path.glob("*"), *path.glob("*/*")]):
        if p.is_file():
            file = p.relative_to(path)
            kinds.setdefault((str(file.parent), p.suffix), []).append(str(file))
    listed = ", ".join(
        files[0] if len(files) == 1 else f"{len(files)} x *{suffix} in {folder}/"
        for (folder, suffix), files in [*kinds.items()][:_LISTED]
    )
    held = "is one file" if path.is_file() else f"contains {listed or 'no files'}"
    best, lacks, name = 0.0, ["rgb/", "camera.json", "odometry.tum"], str(_OWN[1])
    for format_ in capture_formats():
        wanted = re.findall(r"[\w*]+/|[\w*]*\.\w+", getattr(format_, "contents", ""))
        lacking = [w for w in wanted if not next(path.glob(w if w[0] != "." else f"*{w}"), None)]
        if wanted and 1.0 - len(lacking) / len(wanted) > best:
            best, lacks, name = 1.0 - len(lacking) / len(wanted), lacking, str(format_)
    more = "" if "io" in plugins(CAPTURES) else " Other recorders: install the extra `io`."
    return (
        f"{path} is not a capture of a known format; it {held}.\n"
        f"The nearest format is {name}; {', '.join(lacks)} missing.{more}\n"
        f"`placegraph capture init {path}` writes a capture folder from images, poses and "
        "intrinsics."
    )


def is_capture(path: Path) -> bool:
    """Return whether a path is a capture of a known recorder."""
    return path.exists() and any(format_.matches(path) for format_ in capture_formats())


def replace_poses(capture: Capture, path: Path) -> Capture:
    """Return the capture with the poses of a TUM file; gravity is -z of these poses.

    Rows belong to frames in order if there are as many; else poses are interpolated. Frames without a row
    within 20 ms are left out and counted. Raises `InputError` where no row belongs to a
    frame.
    """
    trajectory = read_tum(path)
    poses, known = trajectory.poses, np.ones(len(capture), bool)
    if len(trajectory) != len(capture):
        known = match_stamps(trajectory.stamps, capture.stamps, SAME_MOMENT) >= 0
        poses = interpolate_poses(trajectory.stamps, poses, capture.stamps)
    if not known.any():
        raise InputError(
            f"{path} has {len(trajectory)} rows for {len(capture)} images, and none has an "
            f"image's stamp (from {capture.stamps[0]:.6g}) within {SAME_MOMENT * 1000:.0f} "
            "ms; give one row per image, or stamps of the same clock."
        )
    frames = tuple(
        _with_pose(frame, pose)
        for frame, pose, kept in zip(capture, poses, known, strict=True)
        if kept
    )
    missing = int((~known).sum())
    left_out = capture.left_out + Counter({f"no pose in {path.name}": missing})
    return replace(capture, frames=frames, left_out=left_out)


def _with_pose(frame: Frame, stored: np.ndarray[Any, np.dtype[np.float64]]) -> Frame:
    """Return a frame whose stored image has this pose (4, 4)."""
    turns = frame.images.turns if isinstance(frame.images, LazyImages) else 0
    pose = stored.copy()
    pose[:3, :3] = stored[:3, :3] @ quarter_turn(turns).T
    gravity = -pose[2, :3] / np.linalg.norm(pose[2, :3])
    pose.flags.writeable = gravity.flags.writeable = False
    return replace(frame, odometry=pose, gravity=gravity)
