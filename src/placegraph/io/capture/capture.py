"""Opening captures: the formats that `open_capture` knows, and how each is recognized.

A reader's module has `is_X(path)`, which looks at names alone and never raises, and
`read_X(path, ...)`, which returns a `Capture`. Modules are imported where they are needed; what they
read looks like `docs/formats.md` says.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib import import_module
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
from placegraph.io.capture.posed import SAME_MOMENT, nearest_stamps
from placegraph.io.capture.tum import read_tum

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
    """Open a capture, whoever recorded it; images are read when they are asked for.

    Parameters
    ----------
    path
        A capture folder: `rgb/`, `camera.json`, `odometry.tum`, and optionally `depth/`,
        `instances/` or `labels/` with `labels.json`, and `gravity.txt` (without which gravity is
        -z of the odometry's frame, which must then be gravity-aligned). Or what another recorder
        wrote: `capture_formats` lists them.
    labels
        Of capture folders: which labels to use; "auto" takes `instances/`, else `labels/`, else
        none.
    poses
        Where the poses come from: None or "odometry": the recorder's own. "trajectory":
        `trajectory.tum` in the folder, the truth, which nothing that localizes may see; for making
        maps. Else a file in TUM's format, z up, OpenCV's camera axes, whose rows belong to the
        images in order, if there are as many, or else to those of the same stamps (to 20 ms).
    scale
        Of COLMAP models and `transforms.json`: metres in a unit of the model; estimated from depth
        if not given.
    up
        Of COLMAP models and `transforms.json`: (3,) direction of up; estimated if not given.
    topics
        Of bags of ROS: topics, frames and intrinsics by their role, over what `BAG.json` beside the
        bag says; `docs/howto-bags.md`. Found by type if not given.

    Raises
    ------
    InputError
        Nothing known lies there; a file is missing, unreadable, or not what it should be; rows and
        images differ in number.
    OptionError
        `labels` is none of its values; an option is not one of that recorder's.
    MissingExtraError
        What would decode its images is not installed.

    """
    if labels not in {"auto", "labels", "instances", None}:
        raise OptionError(f"labels is {labels!r}; it is 'auto', 'labels', 'instances' or None.")
    given: dict[str, Any] = {
        name: value
        for name, value in {"poses": poses, "scale": scale, "up": up, "topics": topics}.items()
        if value is not None
    }
    return format_of(Path(path)).open(Path(path), given | {"labels": labels})


class Format(NamedTuple):
    """How one recorder's captures are told and read."""

    name: str
    """Of the recorder."""
    holds: str
    """What it is told by, for the user."""
    module: str
    """Of `placegraph.io`."""
    verb: str
    """X of its `is_X` and `read_X`."""
    takes: tuple[str, ...] = ()
    """Options of `open_capture` that its reader takes; `poses` else is left to `with_poses`."""
    rank: int = 0
    """Formats of a lower rank are asked first: those whose files no other format has."""

    def fits(self, path: Path) -> bool:
        """Return whether a path looks like one of this recorder's captures."""
        try:
            return bool(getattr(self._module(), f"is_{self.verb}")(path))
        except OSError:  # no leave to look there
            return False

    def open(self, path: Path, options: dict[str, Any]) -> Capture:
        """Read a capture; `OptionError` where the recorder has no such option."""
        poses = options.get("poses")
        given = {name: value for name, value in options.items() if name in self.takes}
        idle = set(options) - set(given) - {"poses"}
        if options.get("labels") in {"auto", None}:
            idle.discard("labels")
        if idle:
            raise OptionError(f"{', '.join(sorted(idle))}: not an option of {self.name}.")
        if poses is None or poses == "odometry":
            given.pop("poses", None)
            return self._read(path, given)
        file = path / "trajectory.tum" if poses == "trajectory" else Path(poses)
        if "poses" in self.takes:
            return self._read(path, given | {"poses": file})
        return with_poses(self._read(path, given), file)

    def _read(self, path: Path, given: dict[str, Any]) -> Capture:
        capture: Capture = getattr(self._module(), f"read_{self.verb}")(path, **given)
        return capture

    def _module(self) -> Any:  # noqa: ANN401  # a module
        return import_module(self.module)


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
"""Files, or what a folder has, by which formats of the extra `io` are recognized, by their rank."""


class AbsentFormat(NamedTuple):
    """Formats that a distribution which is not installed would read."""

    rank: int
    name: str = "captures of other recorders, data sets and bags"
    holds: str = "install the extra `io` for them"

    def fits(self, path: Path) -> bool:
        """Return whether a path looks like one of them."""
        patterns = _ELSEWHERE[self.rank]
        try:
            if path.is_dir():
                return any(next(path.glob(pattern), None) is not None for pattern in patterns)
            return any(path.match(pattern) for pattern in patterns)
        except OSError:  # no leave to look there
            return False

    def open(self, path: Path, options: dict[str, Any]) -> Capture:  # noqa: ARG002  # as `Format.open`
        """Raise `MissingExtraError`, which names the extra."""
        raise missing_extra(f"A reader of {path}", "io")


@cache
def capture_formats() -> tuple[Format | AbsentFormat, ...]:
    """Return all formats, plugins' included, in the order in which they are asked."""
    points = plugins(CAPTURES)
    found: list[Format | AbsentFormat] = [f for point in points.values() for f in point.load()]
    if "io" not in points:
        found += [AbsentFormat(rank) for rank in _ELSEWHERE]
    return tuple(sorted([*found, *_OWN], key=lambda format_: format_.rank))


def format_of(path: Path) -> Format | AbsentFormat:
    """Return the format of a capture; raise `InputError`, which lists what is known, where none fits."""
    if not path.exists():
        raise InputError(f"{path} does not exist; a capture is a folder that a recorder wrote.")
    for known in capture_formats():
        if known.fits(path):
            return known
    listed = "; ".join(f"{known.name} ({known.holds})" for known in capture_formats())
    raise InputError(f"{path} holds no capture of a known recorder. Known are: {listed}.")


def is_capture(path: Path) -> bool:
    """Return whether `open_capture` knows the recorder of what lies there."""
    return path.exists() and any(known.fits(path) for known in capture_formats())


def with_poses(capture: Capture, path: Path) -> Capture:
    """Return the capture with the poses of a TUM file instead of its own.

    Rows belong to frames in order, where there are as many, else to those whose stamps differ by
    20 ms at most; frames without a row are left out, and counted. Gravity is -z of the new poses.
    Raises `InputError` where no row belongs to a frame.
    """
    trajectory = read_tum(path)
    rows = np.arange(len(capture))
    if len(trajectory) != len(capture):
        rows = nearest_stamps(trajectory.stamps, capture.stamps, SAME_MOMENT)
    if (rows < 0).all():
        raise InputError(
            f"{path} has {len(trajectory)} rows for {len(capture)} images, and no stamp of theirs "
            f"(from {capture.stamps[0]:.6g}) within {SAME_MOMENT * 1000:.0f} ms; give one row an "
            "image, or stamps of the same clock."
        )
    frames = tuple(
        _with_pose(frame, trajectory.poses[row])
        for frame, row in zip(capture, rows, strict=True)
        if row >= 0
    )
    missing = int((rows < 0).sum())
    left_out = capture.left_out + Counter({f"no pose in {path.name}": missing})
    return replace(capture, frames=frames, left_out=left_out)


def _with_pose(frame: Frame, stored: np.ndarray[Any, np.dtype[np.float64]]) -> Frame:
    """Return the frame whose stored image has this pose (4, 4)."""
    turns = frame.images.turns if isinstance(frame.images, LazyImages) else 0
    pose = stored.copy()
    pose[:3, :3] = stored[:3, :3] @ quarter_turn(turns).T
    gravity = -pose[2, :3] / np.linalg.norm(pose[2, :3])
    pose.flags.writeable = gravity.flags.writeable = False
    return replace(frame, odometry=pose, gravity=gravity)
