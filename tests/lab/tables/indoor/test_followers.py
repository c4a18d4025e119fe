from itertools import pairwise

import numpy as np
import pytest

from placegraph.core.geometry import Camera, pose_matrix, rotation_z
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.followers import (
    CloudFollower,
    LaserFollower,
    depth_points,
    map_points,
)
from placegraph_lab.tables.indoor.metrics import position_error, rotation_error

LOW, HIGH = np.array([0.0, 0.0, 0.0]), np.array([5.0, 3.6, 2.5])
CAMERA = Camera(192, 144, 150.0, 150.0, 96.0, 72.0)
LEVEL = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # looks along x, with the image upright


def look(pose):
    """Depth of an empty room from a pose (4, 4), by the slabs of its walls."""
    v, u = np.mgrid[:144, :192] + 0.5
    rays = CAMERA.directions(np.stack([u, v], axis=-1)) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        ends = np.maximum((LOW - pose[:3, 3]) / rays, (HIGH - pose[:3, 3]) / rays)
    return ends.min(axis=-1).astype(np.float32)


def walk(count):
    """Frames along an arc through the room, and their poses (T, 4, 4)."""
    share = np.linspace(0, 1, count)
    at = np.stack([1.5 + 2 * share, 1.5 + 0.8 * share, 1.2 + 0 * share, 0.7 * share], axis=1)
    poses = pose_matrix(at, np.broadcast_to(LEVEL, (count, 3, 3)))
    rgb = np.zeros((144, 192, 3), np.uint8)
    frames = [
        Frame.from_arrays(rgb, CAMERA, depth=look(p), odometry=p, gravity=-p[2, :3]) for p in poses
    ]
    return frames, poses


def test_points_lie_on_the_walls():
    frames, poses = walk(3)
    points = map_points(frames, poses)
    off = np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1)
    assert len(points) == 3 * len(depth_points(frames[0])) == 3 * 768
    assert off.max() < 1e-3


@pytest.mark.parametrize(("laser", "metres", "degrees"), [(False, 0.03, 0.5), (True, 0.3, 4.0)])
def test_drift_is_taken_back(tmp_path, laser, metres, degrees):
    frames, poses = walk(24)
    kind, path = (
        (LaserFollower, tmp_path / "a.npz") if laser else (CloudFollower, tmp_path / "a.npy")
    )
    kind.build(frames, poses, path)
    # the same walk, turned and stretched as odometry would have it
    bent = [np.eye(4)]
    for before, after in pairwise(poses):
        step = np.linalg.inv(before) @ after
        step[:3, 3] *= 1.25
        bent.append(bent[-1] @ step)
    turned = np.eye(4)
    turned[:3, :3] = rotation_z(0.7)
    told = [turned @ poses[0] @ pose for pose in bent]
    assert position_error(poses[0] @ bent[-1], poses[-1]) > 0.4
    follower = (
        LaserFollower.open(path, poses[0], np.random.default_rng(0))
        if laser
        else CloudFollower(path, poses[0])
    )
    for frame, pose in zip(frames, told, strict=True):
        found = follower.step(Frame.from_arrays(
            frame.rgb(), CAMERA, depth=frame.depth(), odometry=pose, gravity=-pose[2, :3],
        ))  # fmt: skip
    assert position_error(found, poses[-1]) < metres
    assert rotation_error(found, poses[-1]) < degrees
