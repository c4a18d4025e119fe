"""Poses on the command line: as numbers, or from what `placegraph scene localize` printed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from placegraph.cli.common import numbers_of
from placegraph.errors import InputError, OptionError

if TYPE_CHECKING:
    from pathlib import Path

    from placegraph.core.geometry import Floats
    from placegraph.io.capture.frame import Frame


def map_from_camera_of(text: str, down: Floats | None = None) -> Floats:
    """Pose (4, 4) of a text X,Y,Z,YAW_DEG[,PITCH_DEG[,ROLL_DEG]].

    The yaw is that of `geometry.split_pose`, as `scene localize` prints it. `down`: gravity (3,) in
    the camera's axes, for a text without pitch and roll; upright if not given. Raises `OptionError`.
    """
    from placegraph.core.geometry import level_from_camera, pose_matrix

    mend = (
        "give x, y, z in metres and yaw in degrees, and pitch and roll if need be, as 1.5,2,1.6,90 or "
        "1.5,2,1.6,90,-10,0."
    )
    numbers = numbers_of(text, "--pose", {4, 5, 6}, mend)
    x, y, z = numbers[:3]
    if down is not None and len(numbers) == 4:
        return pose_matrix([x, y, z, np.deg2rad(numbers[3])], level_from_camera(down))
    yaw, pitch, roll = np.deg2rad([*numbers[3:], 0.0, 0.0][:3])
    if abs(pitch) > np.pi / 2:
        raise OptionError(f"--pose is {text!r}; pitch_deg is from -90 to 90.")
    gravity = [np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch), -np.sin(pitch)]
    return pose_matrix([x, y, z, yaw], level_from_camera(gravity))


def pose_of_estimate(path: Path, mode: int = 1, frame: Frame | None = None) -> Floats:
    """Pose (4, 4) of one frame of an estimate's JSON, the last if not given, under a mode from 1.

    Raises
    ------
    OptionError
        There is no such mode, or the estimate does not tell of the frame.
    InputError
        The file is no such JSON, or holds no pose.

    """
    modes, frames, trajectory = read_estimate(path)
    if not 1 <= mode <= len(modes):
        raise OptionError(f"--mode is {mode}, but {path} has modes 1 to {len(modes)}.")
    if frame is None or (frame.index == frames[-1]):
        return modes[mode - 1]
    if mode != 1:
        raise OptionError(
            f"--mode {mode} is known for the last frame alone, {frames[-1]}; leave --frame out."
        )
    if frame.index not in frames:
        raise OptionError(
            f"--frame is {frame.index}, but {path} tells of frames {', '.join(map(str, frames))}."
        )
    pose: Floats = trajectory[frames.index(frame.index)]
    return pose


def read_estimate(path: Path) -> tuple[list[Floats], list[int], Floats]:
    """Poses of the modes, rows of the frames and their poses (T, 4, 4) of an estimate's JSON.

    Raises `InputError` where the file is no such JSON, or holds no pose.
    """
    from placegraph.io.capture.camera import read_json

    told = read_json(path)
    try:
        modes = [_matrix(mode["map_from_camera"]) for mode in told["modes"]]
        frames = [int(row) for row in told["frames"]]
        trajectory = np.array([_matrix(pose) for pose in told["trajectory"]]).reshape(-1, 4, 4)
        reason, status = str(told["reason"]), str(told["status"])
    except (TypeError, KeyError, ValueError, OverflowError) as error:
        raise InputError(
            f"{path} is not what `placegraph scene localize --json` prints "
            f"({type(error).__name__}: {error}); write its output to a file and give that."
        ) from error
    if not modes or not frames or len(frames) != len(trajectory):
        raise InputError(f"{path} holds no pose: it says {status}. {reason}")
    return modes, frames, trajectory


def _matrix(values: Any) -> Floats:  # noqa: ANN401  # whatever the file holds
    matrix = np.array(values, np.float64)
    if matrix.shape != (4, 4):
        raise ValueError(f"map_from_camera has shape {matrix.shape}")
    return matrix
