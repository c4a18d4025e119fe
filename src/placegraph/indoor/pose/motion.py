"""Ego-motion: odometry as steps of four degrees of freedom, and particles moved by them (Eq. 1)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from placegraph.core.geometry import Floats, between, compose, level_from_camera, wrap
from placegraph.indoor.options import MotionNoise


def level_poses(odometry: NDArray[np.float64], gravity: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (T, 4) x, y, z, yaw in a level frame of odometry (T, 4, 4) and gravity (T, 3).

    The odometry's own frame may stand at any slant: it is set upright by the mean of what gravity
    says in all frames. Tilts are gravity's, frame by frame.
    """
    rotation = odometry[:, :3, :3]
    down = np.einsum("tij,tj->ti", rotation, gravity).mean(axis=0)
    # level_from_camera sets any frame upright whose "down" is given; undo its change of axes
    upright = level_from_camera(np.array([0.0, 1.0, 0.0])).T @ level_from_camera(down)
    to_level = _Z_FROM_Y_DOWN @ upright
    leveled = to_level @ rotation @ np.swapaxes(level_from_camera(gravity), 1, 2)
    yaw = np.arctan2(leveled[:, 1, 0] - leveled[:, 0, 1], leveled[:, 0, 0] + leveled[:, 1, 1])
    return np.column_stack([odometry[:, :3, 3] @ to_level.T, yaw])


_Z_FROM_Y_DOWN = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def propagate(
    poses: NDArray[np.float64],
    step: NDArray[np.float64],
    noise: MotionNoise,
    rng: Generator,
) -> NDArray[np.float64]:
    """Poses (N, 4) after a step (4,) with noise: s_{t+1} = s_t (+) (t_t + w_t), Eq. 1."""
    errors = rng.normal(size=poses.shape) * deviations(step, noise)
    return compose(poses, step + errors)


def deviations(steps: NDArray[np.float64], noise: MotionNoise) -> NDArray[np.float64]:
    """Standard deviations (..., 4) [m, rad] of steps (..., 4)."""
    length, turned = np.linalg.norm(steps[..., :3], axis=-1), np.abs(wrap(steps[..., 3]))
    way = noise.translation + noise.translation_per_metre * length
    turn = noise.rotation + noise.rotation_per_radian * turned
    return np.stack([way, way, way, turn], axis=-1)


def keyframes(
    stamps: NDArray[np.float64], poses: NDArray[np.float64], seconds: float, metres: float
) -> list[int]:
    """Frames at least so far apart in time, or in way (or 0.2 rad of turn); first and last always.

    Table 6 of the paper: a robot takes the frames that it has time for.
    """
    if seconds <= 0 and metres <= 0:
        return list(range(len(stamps)))
    kept = [0]
    for i in range(1, len(stamps)):
        moved = np.linalg.norm(poses[i, :3] - poses[kept[-1], :3]) >= metres > 0
        turned = metres > 0 and abs(float(wrap(poses[i, 3] - poses[kept[-1], 3]))) >= 0.2
        waited = stamps[i] - stamps[kept[-1]] >= seconds > 0
        if moved or turned or waited or i == len(stamps) - 1:
            kept.append(i)
    return kept


@dataclass(frozen=True, eq=False)
class Chain:
    """Odometry of the T frames of a window."""

    poses: Floats
    """(T, 4) level poses in odometry's own frame."""
    deviations: Floats
    """(T - 1, 4) standard deviations of the steps between, in units of which errors are measured."""

    @classmethod
    def of(cls, poses: Floats, noise: MotionNoise) -> Chain:
        """Chain of level odometry (T, 4)."""
        return cls(poses, deviations(between(poses[:-1], poses[1:]), noise))

    @cached_property
    def steps(self) -> Floats:
        """(T - 1, 4) from each frame to the next."""
        return between(self.poses[:-1], self.poses[1:])

    def rigid(self, pose: Floats) -> Floats:
        """Poses (T, 4) of all frames if odometry were right, from that of the last (4,)."""
        return compose(pose, between(self.poses[-1], self.poses))
