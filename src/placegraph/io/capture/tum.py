"""Trajectories in TUM's text format, and other tables whose rows begin with a stamp.

A row is `stamp tx ty tz qx qy qz qw`, metres and a unit quaternion xyzw; `#` begins a comment.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from placegraph.core.files import write_output
from placegraph.core.geometry import quaternion_from_rotation, rotation_from_quaternion
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.json_files import read_json
from placegraph.io.capture.posed import read_rows

POSE_COLUMNS = ("stamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
UNIT_TOLERANCE = 1e-3
"""Largest error of a quaternion's length that counts as rounding, and is normalized."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses of a camera over time; arrays are read-only."""

    stamps: NDArray[np.float64]
    """(T,) strictly ascending: seconds, or frame numbers."""
    poses: NDArray[np.float64]
    """(T, 4, 4) rigid transforms [m]."""

    def __len__(self) -> int:
        return len(self.stamps)


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of a text file of numbers, with their locations."""

    values: NDArray[np.float64]
    """(T, C), finite; column 0 is the stamp."""
    locations: tuple[str, ...]
    """(T,) file and line of each row, for messages."""

    def error(self, row: int, fault: str) -> InputError:
        """Return the error that names the file and the line of a row."""
        return InputError(f"{self.locations[row]}: {fault}")


def read_tum(path: str | PathLike[str]) -> Trajectory:
    """Read a trajectory.

    Raises
    ------
    InputError
        The file is missing, unreadable or empty; a row has not eight finite numbers, stamps do not
        ascend, a quaternion's length is not 1 (within 1e-3). The message names file and line.

    """
    table = read_table(path, POSE_COLUMNS)
    quaternions = table.values[:, 4:]
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(~(np.abs(lengths - 1.0) <= UNIT_TOLERANCE))
    if wrong.size:
        row = int(wrong[0])
        raise table.error(
            row,
            f"the quaternion has length {lengths[row]:.6g}, not 1; the columns are "
            f"`{' '.join(POSE_COLUMNS)}`.",
        )
    poses = np.zeros((len(quaternions), 4, 4))
    poses[:, :3, :3] = rotation_from_quaternion(quaternions)
    poses[:, :3, 3] = table.values[:, 1:4]
    poses[:, 3, 3] = 1.0
    stamps = np.ascontiguousarray(table.values[:, 0])
    stamps.flags.writeable = poses.flags.writeable = False
    return Trajectory(stamps, poses)


def read_camera_path(path: str | PathLike[str]) -> NDArray[np.float64]:
    """Return the poses (T, 4, 4) map_from_camera of a TUM file, or of output of `scene localize --json`.

    Raises `InputError` where the file is missing, holds no pose, or is of another format.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        return read_tum(path).poses
    content = read_json(path)
    try:
        poses = np.array(content["trajectory"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path} contains no trajectory; save what `placegraph scene localize --json` prints."
        ) from error
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise InputError(f"{path}: its trajectory has shape {poses.shape}, expected (T, 4, 4).")
    if not np.isfinite(poses).all():
        raise InputError(f"{path}: a pose of its trajectory is not finite; localize again.")
    return poses


def write_tum(
    path: str | PathLike[str], stamps: ArrayLike, poses: ArrayLike, *, comment: str = ""
) -> None:
    """Write poses (T, 4, 4) with stamps (T,) as TUM text, to a nanometre, after a `comment`.

    Raises `OptionError` where the arrays do not fit or `read_tum` would refuse them, `InputError`
    where the file cannot be written.
    """
    times = np.asarray(stamps, np.float64)
    matrices = np.asarray(poses, np.float64)
    if times.ndim != 1 or matrices.shape != (times.size, 4, 4):
        raise OptionError(
            f"poses: shape is {matrices.shape} and that of stamps {times.shape}, expected "
            "(T, 4, 4) and (T,)."
        )
    if not (np.isfinite(times).all() and np.isfinite(matrices).all()):
        raise OptionError("poses: a stamp or a pose is not finite; remove such rows.")
    if np.any(np.diff(times) <= 0):
        raise OptionError("stamps: they do not increase; sort the rows, and drop duplicates.")
    columns = np.hstack([matrices[:, :3, 3], quaternion_from_rotation(matrices[:, :3, :3])])
    rows = [f"# {line}" for line in comment.splitlines()]
    for stamp, row in zip(times.tolist(), columns.tolist(), strict=True):
        rows.append(" ".join([repr(stamp).removesuffix(".0"), *(f"{v:.9f}" for v in row)]))
    write_output(path, ("\n".join(rows) + "\n").encode())


def read_table(
    path: str | PathLike[str], columns: tuple[str, ...], *, unknown: tuple[str, ...] = ()
) -> Table:
    """Read rows of the numbers that `columns` names, the first of which ascends strictly.

    Numbers of `unknown` columns may be NaN. Raises `InputError` as `read_tum` does.
    """
    rows = read_rows(Path(path), (len(columns),), " ".join(columns), finite=False)
    table = Table(np.array([row for _, row in rows]), tuple(location for location, _ in rows))
    finite = np.isfinite(table.values)
    finite |= np.isnan(table.values) & np.isin(columns, unknown)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite)[0])
        raise table.error(
            row, f"{columns[column]} is {table.values[row, column]}; drop the row and its image."
        )
    stamps = table.values[:, 0]
    late = np.flatnonzero(np.diff(stamps) <= 0)
    if late.size:
        row = int(late[0]) + 1
        fault = (
            "is repeated" if stamps[row] == stamps[row - 1] else "is earlier than the previous one"
        )
        raise table.error(
            row, f"the stamp {stamps[row]:.10g} {fault}; stamps must ascend from row to row."
        )
    return table
