"""Poses, cameras and frames of other recorders' captures: checked, and converted to z up and OpenCV's axes.

They describe every frame as a `StoredFrame`, with images, intrinsics and pose as they are stored, in a
world with z up and camera axes as OpenCV has them; `capture_of` makes a `Capture` of them and
turns a telephone's images upright.
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
from placegraph.core.geometry import Camera, rotation_from_quaternion
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.frame import Capture, LazyImages, posed_frame, upright_turns

MAP_FROM_Y_UP = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""From ARKit's and OpenGL's worlds, y up, to z up."""
ARKIT_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])
"""Of a camera: ARKit's and OpenGL's look along -z, with y up."""

SAME_MOMENT = 0.02
"""Stamps that differ by less belong together [s]: half a frame of 30 a second, and some jitter."""
_RIGID = 1e-2  # rotations are written with few digits


@dataclass(frozen=True, slots=True, eq=False)
class StoredFrame:
    """A frame as it is stored."""

    name: str
    """File and field of its pose, for messages."""
    stamp: float
    """Seconds, or frame number."""
    pose: NDArray[np.float64]
    """(4, 4) world_from_camera [m], world z up, camera axes as OpenCV's."""
    camera: Camera
    images: LazyImages
    depth_camera: Camera | None = None
    """None where the capture has no depth."""


def capture_of(
    path: Path,
    shots: Iterable[StoredFrame],
    *,
    left_out: Counter[str] | None = None,
    notes: Sequence[str] = (),
) -> Capture:
    """Return the capture of shots, sorted by time, turned upright by one number of quarter turns.

    `left_out` counts frames that are not among them, by reason; `notes` are sentences for the user.
    Raises `InputError` where there is no shot, a pose is not a rigid transform of finite numbers,
    or two shots have one stamp.
    """
    held = sorted(shots, key=lambda shot: shot.stamp)
    missing = left_out or Counter()
    if not held:
        why = "; ".join(f"{count}: {reason}" for reason, count in missing.items())
        raise InputError(f"{path} holds no usable frame{f' ({why})' if why else ''}.")
    for before, after in itertools.pairwise(held):
        if before.stamp == after.stamp:
            raise InputError(f"{after.name} has the stamp of {before.name}; keep one of them.")
    poses = exact_poses(np.stack([shot.pose for shot in held]), [shot.name for shot in held])
    turns = upright_turns(-poses[:, 2, :3])
    frames = tuple(
        posed_frame(
            i,
            shot.stamp,
            pose,
            shot.camera,
            shot.images,
            depth_camera=shot.depth_camera,
            turns=turns,
        )
        for i, (shot, pose) in enumerate(zip(held, poses, strict=True))
    )
    said = list(notes)
    if turns:
        said.append(
            f"Images are turned by {turns * 90} degrees counter-clockwise to stand upright."
        )
    return Capture(
        path=path,
        frames=frames,
        camera=frames[0].camera,
        depth_camera=frames[0].depth_camera,
        label_camera=None,
        label_kind=None,
        label_names={},
        notes=tuple(said),
        left_out=missing,
    )


def exact_pose(matrix: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return the rigid transform (4, 4) of 12 or 16 numbers by rows, its rotation made exact.

    `InputError`, which begins with `name`, where a number is not finite or it is no rotation.
    """
    rows = np.asarray(matrix, np.float64).reshape(1, -1, 4)
    last = np.array([[[0.0, 0.0, 0.0, 1.0]]])
    return exact_poses(
        rows if rows.shape[1] == 4 else np.concatenate([rows, last], axis=1), [name]
    )[0]


def exact_poses(matrices: NDArray[np.float64], names: Sequence[str]) -> NDArray[np.float64]:
    """Return the rigid transforms (T, 4, 4), their rotations made exact; `InputError` as `exact_pose`."""
    poses = matrices.copy()
    bad = ~np.isfinite(poses).all(axis=(1, 2))
    if bad.any():
        name = names[int(bad.argmax())]
        raise InputError(f"{name} holds a number that is not finite; leave that frame out.")
    turns, last = poses[:, :3, :3], poses[:, 3]
    error = np.abs(turns @ turns.swapaxes(1, 2) - np.eye(3)).max(axis=(1, 2))
    bad = (error > _RIGID) | (np.linalg.det(turns) < 0)
    bad |= np.abs(last - (0.0, 0.0, 0.0, 1.0)).max(axis=1) > _RIGID
    if bad.any():
        name = names[int(bad.argmax())]
        raise InputError(f"{name} is no rotation and translation; it may be written by columns.")
    u, _, vt = np.linalg.svd(turns)
    poses[:, :3, :3] = u @ vt
    poses[:, 3] = (0.0, 0.0, 0.0, 1.0)
    return poses


def pose_of(position: ArrayLike, xyzw: ArrayLike, name: str) -> NDArray[np.float64]:
    """Pose (4, 4) of a position (3,) [m] and a unit quaternion (4,); `InputError` as `exact_pose`."""
    quaternion = np.asarray(xyzw, np.float64)
    length = float(np.linalg.norm(quaternion))
    if not abs(length - 1.0) <= _RIGID:
        raise InputError(f"{name}: the quaternion has length {length:.6g}, not 1.")
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(quaternion)
    pose[:3, 3] = position
    return exact_pose(pose, name)


def nearest_stamps(stamps: ArrayLike, wanted: ArrayLike, tolerance: float) -> NDArray[np.intp]:
    """Row (n,) of `stamps` (m,), in any order, nearest to each of `wanted` (n,); -1: none so near."""
    known, asked = np.asarray(stamps, np.float64), np.asarray(wanted, np.float64)
    if not known.size:
        return np.full(asked.shape, -1, np.intp)
    order = np.argsort(known, kind="stable")
    ordered = known[order]
    after = np.clip(np.searchsorted(ordered, asked), 0, len(known) - 1)
    before = np.maximum(after - 1, 0)
    first = np.abs(ordered[before] - asked) <= np.abs(ordered[after] - asked)
    best = np.where(first, before, after)
    rows: NDArray[np.intp] = np.where(
        np.abs(ordered[best] - asked) <= tolerance, order[best], -1
    ).astype(np.intp)
    return rows


def camera_of(
    name: str,
    size: tuple[int, int],
    intrinsics: Sequence[float],
    distortion: Sequence[float] = (),
    model: str = "opencv",
) -> Camera:
    """Camera of width and height [px] and fx, fy, cx, cy; `InputError`, which begins with `name`."""
    fx, fy, cx, cy = (float(v) for v in intrinsics)
    try:
        return Camera(*size, fx, fy, cx, cy, tuple(float(v) for v in distortion), model)
    except OptionError as error:
        raise InputError(f"{name}: {error}") from error


def smaller_view(camera: Camera, size: tuple[int, int], name: object) -> Camera:
    """Return the camera of images of another size that show the same; `InputError` where they cannot."""
    width, height = size
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        raise InputError(
            f"{name} has {width} x {height} pixels, which is not the view of the colour images, "
            f"{camera.width} x {camera.height}, in another size; export depth of the same view."
        )
    return camera if size == (camera.width, camera.height) else camera.resized(*size)


def read_text(path: Path) -> str:
    """Return the text of a file; `InputError` where it is missing, unreadable or not text."""
    try:
        return check_regular(path).read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise InputError(f"{path} does not exist.") from error
    except (OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as text ({error}).") from error


def read_rows(path: Path, widths: tuple[int, ...], columns: str) -> list[tuple[str, list[float]]]:
    """Return the rows of numbers of a text without header, with commas or blanks, and where each stands.

    A row has as many numbers as one of `widths`. `InputError`, which names the `columns`, where one
    has not, where a number is not finite, or where there is no row.
    """
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        where = f"{path}, line {number}"
        try:
            row = [float(word) for word in words]
        except ValueError as error:
            raise InputError(f"{where}: {error}; the columns are `{columns}`.") from error
        if len(row) not in widths or not np.isfinite(row).all():
            raise InputError(f"{where} is not a row of finite numbers `{columns}`.")
        rows.append((where, row))
    if not rows:
        raise InputError(f"{path} holds no row; a row is `{columns}`.")
    return rows


def numbers(path: Path, content: dict[str, Any], field: str, count: int) -> list[float]:
    """Return the list of `count` numbers in a JSON object; `InputError` names the file and the field."""
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
        raise InputError(f"{path}: {field} holds a number beyond all bounds.") from error


def number(path: Path, content: dict[str, Any], field: str) -> float:
    """Return a number in a JSON object; `InputError` names the file and the field."""
    return numbers(path, {field: [content[field]] if field in content else None}, field, 1)[0]
