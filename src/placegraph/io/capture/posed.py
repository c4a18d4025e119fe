"""Checks and conversions of poses, cameras and frames for readers of other recorders' captures.

Readers describe every frame as a `StoredFrame`: images, intrinsics and pose as stored, in a world with
z up and OpenCV's camera axes. `make_capture` turns the images upright.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.files import check_regular
from placegraph.core.geometry import (
    Camera,
    rotation_from_quaternion,
    rotation_from_vector,
    vector_from_rotation,
)
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import Capture, LazyImages, posed_frame, upright_turns

MAP_FROM_Y_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Transform from the y-up worlds of ARKit and OpenGL to z up."""
ARKIT_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Transform of camera axes; cameras of ARKit and OpenGL look along -z, with y up."""

SAME_MOMENT = 0.02
"""Tolerance of stamps of one moment [s]: half a frame at 30 Hz, and some jitter."""
_RIGID = 1e-2  # rotations are written with few digits


@dataclass(frozen=True, slots=True, eq=False)
class StoredFrame:
    """Frame as stored, before its images are turned upright."""

    name: str
    """File and field of its pose, for messages."""
    stamp: float
    """Seconds, or frame number."""
    pose: NDArray[np.float64]
    """(4, 4) world_from_camera [m], world z up, OpenCV's camera axes."""
    camera: Camera
    images: LazyImages
    depth_camera: Camera | None = None
    """None where the capture has no depth."""


def make_capture(
    path: Path,
    frames: Iterable[StoredFrame],
    *,
    left_out: Counter[str] | None = None,
    notes: Sequence[str] = (),
) -> Capture:
    """Return the capture of stored frames, sorted by time, all turned upright by the same angle.

    `left_out` counts missing frames by reason; `notes` are sentences for the user. Raises `InputError`
    where there is no frame, a pose is not a rigid transform of finite numbers, or stamps repeat.
    """
    stored = sorted(frames, key=lambda frame: frame.stamp)
    missing = left_out or Counter()
    if not stored:
        why = "; ".join(f"{count}: {reason}" for reason, count in missing.items())
        raise InputError(f"{path} contains no usable frame{f' ({why})' if why else ''}.")
    for before, after in itertools.pairwise(stored):
        if before.stamp == after.stamp:
            raise InputError(f"{after.name} has the stamp of {before.name}; keep one of them.")
    poses = orthonormalize_poses(np.stack([f.pose for f in stored]), [f.name for f in stored])
    turns = upright_turns(-poses[:, 2, :3])
    upright = tuple(
        posed_frame(i, f.stamp, pose, f.camera, f.images, depth_camera=f.depth_camera, turns=turns)
        for i, (f, pose) in enumerate(zip(stored, poses, strict=True))
    )
    if turns:
        turned = f"Images are turned by {turns * 90} degrees counter-clockwise to stand upright."
        notes = [*notes, turned]
    return Capture(
        path=path,
        frames=upright,
        camera=upright[0].camera,
        depth_camera=upright[0].depth_camera,
        label_camera=None,
        label_kind=None,
        label_names={},
        notes=tuple(notes),
        left_out=missing,
    )


def orthonormalize_pose(matrix: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return the rigid transform (4, 4) of 12 or 16 numbers by rows, with an exact rotation.

    Raises `InputError`, which begins with `name`, where a number is not finite or it is no rotation.
    """
    rows = np.asarray(matrix, np.float64).reshape(1, -1, 4)
    if rows.shape[1] != 4:
        rows = np.concatenate([rows, np.array([[[0.0, 0.0, 0.0, 1.0]]])], axis=1)
    return orthonormalize_poses(rows, [name])[0]


def orthonormalize_poses(
    matrices: NDArray[np.float64], names: Sequence[str]
) -> NDArray[np.float64]:
    """Return rigid transforms (T, 4, 4) with exact rotations; raises as `orthonormalize_pose`."""
    poses = matrices.copy()
    bad = ~np.isfinite(poses).all(axis=(1, 2))
    if bad.any():
        name = names[int(bad.argmax())]
        raise InputError(f"{name} contains a number that is not finite; remove that frame.")
    turns, last = poses[:, :3, :3], poses[:, 3]
    error = np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = (error > _RIGID) | (np.linalg.det(turns) < 0)
    bad |= np.abs(last - (0.0, 0.0, 0.0, 1.0)).max(axis=1) > _RIGID
    if bad.any():
        name = names[int(bad.argmax())]
        raise InputError(
            f"{name} is not a rotation and translation; check that it is stored by rows."
        )
    u, _, vt = np.linalg.svd(turns)
    poses[:, :3, :3] = u @ vt
    poses[:, 3] = (0.0, 0.0, 0.0, 1.0)
    return poses


def pose_from_quaternion(position: ArrayLike, xyzw: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a position (3,) [m] and a unit quaternion (4,) x, y, z, w.

    Raises `InputError`, which begins with `name`.
    """
    quaternion = np.asarray(xyzw, np.float64)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _RIGID:
        raise InputError(f"{name}: the quaternion has length {length:.6g}, not 1.")
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(quaternion)
    pose[:3, 3] = position
    return orthonormalize_pose(pose, name)


def match_stamps(stamps: ArrayLike, wanted: ArrayLike, tolerance: float) -> NDArray[np.intp]:
    """Return the rows (n,) of `stamps` (m,) nearest to `wanted` (n,); -1 beyond the tolerance [s]."""
    stamps, wanted = np.asarray(stamps, np.float64), np.asarray(wanted, np.float64)
    if not stamps.size:
        return np.full(wanted.shape, -1, np.intp)
    order = np.argsort(stamps, kind="stable")
    ascending = stamps[order]
    after = np.clip(np.searchsorted(ascending, wanted), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    is_before = np.abs(ascending[before] - wanted) <= np.abs(ascending[after] - wanted)
    best = np.where(is_before, before, after)
    is_near = np.abs(ascending[best] - wanted) <= tolerance
    rows: NDArray[np.intp] = np.where(is_near, order[best], -1).astype(np.intp)
    return rows


def interpolate_poses(
    stamps: ArrayLike, poses: ArrayLike, wanted: ArrayLike
) -> NDArray[np.float64]:
    """Return poses (n, 4, 4) at moments (n,) between poses (m, 4, 4) at ascending stamps (m,).

    Positions are interpolated, and rotations at an even rate; before the first and after the last
    stamp these hold.
    """
    times, known = np.asarray(stamps, np.float64), np.asarray(poses, np.float64)
    at = np.clip(np.asarray(wanted, np.float64), times[0], times[-1])
    after = np.searchsorted(times, at)
    before = np.maximum(after - 1, 0)
    share = ((at - times[before]) / np.where(after, times[after] - times[before], 1.0))[:, None]
    found: NDArray[np.float64] = known[before].copy()
    found[:, :3, 3] += share * (known[after] - known[before])[:, :3, 3]
    turn = known[before, :3, :3].swapaxes(1, 2) @ known[after, :3, :3]
    found[:, :3, :3] = found[:, :3, :3] @ rotation_from_vector(share * vector_from_rotation(turn))
    return found


def make_camera(
    name: str,
    size: tuple[int, int],
    intrinsics: Sequence[float],
    distortion: Sequence[float] = (),
    model: str = "opencv",
) -> Camera:
    """Return a camera of width and height [px], fx, fy, cx, cy; `InputError` begins with `name`."""
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    try:
        return Camera(*size, fx, fy, cx, cy, tuple(float(v) for v in distortion), model)
    except OptionError as error:
        raise InputError(f"{name}: {error}") from error


def resize_camera(camera: Camera, size: tuple[int, int], name: object) -> Camera:
    """Return the camera of the same view in another size; `InputError` where proportions differ."""
    width, height = size
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise InputError(
            f"{name} has {width} x {height} pixels, which is not a scaled version of the "
            f"colour images, {camera.width} x {camera.height}; export depth of the same "
            "view."
        )
    return camera if size == (camera.width, camera.height) else camera.resize(*size)


def read_text(path: Path) -> str:
    """Return the text of a file; `InputError` where it is missing, unreadable or not text."""
    try:
        return check_regular(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not text: {error.reason}.") from error
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read: {why}.") from error


def read_rows(
    path: Path, widths: tuple[int, ...], columns: str, *, finite: bool = True
) -> list[tuple[str, list[float]]]:
    """Read rows of numbers without header, separated by commas or blanks, each with its location.

    A row has as many numbers as one of `widths`. Raises `InputError`, which names the `columns`, for
    another row, for a number that is not `finite`, and for a file without rows.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        location = f"{path}, line {number}"
        if len(words) not in widths:
            count = " or ".join(map(str, widths))
            raise InputError(
                f"{location}: {len(words)} columns are given, expected {count}: `{columns}`."
            )
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise InputError(f"{location}: {error}; columns are `{columns}`.") from error
        if finite and not np.isfinite(row).all():
            raise InputError(f"{location} is not a row of finite numbers `{columns}`.")
        rows.append((location, row))
    if not rows:
        raise InputError(f"{path} is empty; write rows `{columns}`.")
    return rows


def read_numbers(path: Path, content: dict[str, Any], field: str, count: int) -> list[float]:
    """Return a list of `count` numbers of a JSON object; `InputError` names file and field."""
    values = content.get(field)
    if not (
        isinstance(values, list)
        and len(values) == count
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values)
    ):
        what = "is missing" if values is None else f"is not a list of {count} numbers"
        raise InputError(f"{path}: {field} {what}; export the capture again.")
    try:
        return [float(v) for v in values]
    except OverflowError as error:
        raise InputError(f"{path}: {field} contains a number out of range.") from error


def read_number(path: Path, content: dict[str, Any], field: str) -> float:
    """Return a number of a JSON object; `InputError` names file and field."""
    return read_numbers(path, {field: [content[field]] if field in content else None}, field, 1)[0]
