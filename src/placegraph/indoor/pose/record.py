"""A recorded run: an estimate with the particles of every pass and frame, as a small file.

The layout is that of map files (`placegraph.core.mapfile`), of kind ``run``: `docs/formats.md`.
"""

from __future__ import annotations

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placegraph.core.estimate import PassRecord, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import Floats
from placegraph.core.mapfile import MapFile, check_contents, read_map, write_map

KIND = "run"
VERSION = 1
STEPS = np.array([1e-3, 1e-3, 1e-3, 1e-4])
"""Steps of particles' x, y, z [m] and yaw [rad]."""
_FULL = 65535
_FARTHEST = 1e7
"""Beyond it nothing lies on a map, in metres or their squares."""
_ROUNDING = 1e-6
"""Rounding error of probabilities that sum to one."""


def write_run(path: str | PathLike[str], estimate: PoseEstimate, *, source: str = "") -> None:
    """Write an estimate, made with `FilterOptions(record=True)`; evidence and stats are left out.

    Parameters
    ----------
    path
        File, such as walk.run.
    estimate
        Its modes, its trajectory, and the particles of its history, to 1 mm and 0.1 mrad.
    source
        What the map it was made on was built from (`SceneMap.source`).

    Raises
    ------
    MapError, MapLockedError
        The file cannot be written.

    """
    steps = [step for record in estimate.history for step in record.steps]
    clouds = [poses for _, poses, _ in steps]
    meta = {
        "source": source,
        "status": estimate.status.name,
        "reason": estimate.reason,
        "scenes": [mode.scene for mode in estimate.modes],
        "strides": [float(record.stride) for record in estimate.history],
    }
    cloud = np.concatenate([np.zeros((0, 4)), *clouds])
    arrays: dict[str, NDArray[Any]] = {
        "particles": np.rint(cloud / STEPS).astype(np.int32),
        "weights": np.concatenate([np.zeros(0, np.uint16), *(_shares(w) for _, _, w in steps)]),
        "particle_counts": np.array([len(poses) for poses in clouds], np.int64),
        "step_frames": np.array([frame for frame, _, _ in steps], np.int64),
        "pass_steps": np.array([len(record.steps) for record in estimate.history], np.int64),
        "trajectory": np.asarray(estimate.trajectory, np.float64).reshape(-1, 16),
        "frames": np.asarray(estimate.frames, np.int64),
        "mode_poses": _stacked([m.pose for m in estimate.modes], 4),
        "mode_matrices": _stacked([m.map_from_camera for m in estimate.modes], 16),
        "mode_scene_matrices": _stacked([m.scene_from_camera for m in estimate.modes], 16),
        "mode_covariances": _stacked([m.covariance for m in estimate.modes], 36),
        "mode_probabilities": np.array([m.probability for m in estimate.modes], np.float64),
    }
    write_map(path, KIND, VERSION, meta, arrays)


def read_run(path: str | PathLike[str]) -> PoseEstimate:
    """Read a recorded run; weights of particles are shares of the heaviest.

    Raises
    ------
    InputError, MapError
        The file is missing, or no sound recorded run.

    """
    file = read_map(path, KIND, VERSION)
    with check_contents(path, "Record it again."):
        frames = file.array("frames", "<i8")
        return PoseEstimate(
            status=Status[file.meta["status"]],
            modes=_modes(file),
            reason=str(file.meta["reason"]),
            trajectory=_matrices(file, "trajectory", len(frames)),
            frames=frames,
            history=_history(file),
        )


def _shares(weights: Floats) -> NDArray[np.uint16]:
    """Weights (N,) as shares of the heaviest."""
    most = float(weights.max(initial=0.0))
    shares = weights / most if most > 0 else np.zeros(len(weights))
    return np.rint(_FULL * shares).astype(np.uint16)


def _stacked(rows: list[Floats], width: int) -> Floats:
    return np.array([np.ravel(row) for row in rows], np.float64).reshape(-1, width)


def _matrices(file: MapFile, name: str, count: int) -> Floats:
    return _numbers(file, name, (count, 4, 4))


def _numbers(file: MapFile, name: str, shape: tuple[int, ...]) -> Floats:
    """A column in this shape; `ValueError` where it holds what no pose has, which none could draw."""
    numbers = file.array(name, "<f8", 2).reshape(shape)
    if not (np.abs(numbers) <= _FARTHEST).all():
        raise ValueError(f"{name} contains an invalid position")
    return numbers


def _modes(file: MapFile) -> tuple[PoseMode, ...]:
    scenes = [str(name) for name in file.meta["scenes"]]
    probabilities = file.array("mode_probabilities", "<f8")
    if not ((probabilities >= 0.0).all() and probabilities.sum() <= 1.0 + _ROUNDING):
        raise ValueError("the probabilities of its modes are invalid")
    rows = zip(
        _matrices(file, "mode_matrices", len(scenes)),
        _numbers(file, "mode_poses", (len(scenes), 4)),
        _numbers(file, "mode_covariances", (len(scenes), 6, 6)),
        probabilities.tolist(),
        scenes,
        _matrices(file, "mode_scene_matrices", len(scenes)),
        strict=True,
    )
    return tuple(PoseMode(*row) for row in rows)


def _history(file: MapFile) -> tuple[PassRecord, ...]:
    counts, frames = file.array("particle_counts", "<i8"), file.array("step_frames", "<i8")
    lengths, strides = file.array("pass_steps", "<i8"), file.meta["strides"]
    poses = file.array("particles", "<i4", 2) * STEPS
    weights = file.array("weights", "<u2") / _FULL
    negative = any(column.min(initial=0) < 0 for column in (counts, lengths))
    said = (int(counts.sum()), int(lengths.sum()))
    if negative or said != (len(poses), len(counts)) or len(weights) != len(poses):
        raise ValueError("the particle counts do not add up")
    ends = np.cumsum(counts)[:-1]
    clouds = zip(frames.tolist(), np.split(poses, ends), np.split(weights, ends), strict=True)
    steps = list(clouds) if len(counts) else []
    passes = []
    for stride, length, end in zip(strides, lengths, np.cumsum(lengths), strict=True):
        passes.append(PassRecord(float(stride), tuple(steps[end - length : end])))
    return tuple(passes)
