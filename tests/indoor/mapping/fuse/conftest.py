"""Scenes whose depth is known to the last digit."""

import numpy as np
import pytest

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.io.capture.frame import Frame

CAMERA = Camera(120, 90, 90.0, 90.0, 60.0, 45.0)
ROOM = np.array([[-2.0, -1.5, 0.0], [2.0, 1.5, 2.4]])
PAINT = np.array(
    [[200, 0, 0], [0, 200, 0], [0, 0, 200], [200, 200, 0], [0, 200, 200], [200, 0, 200]]
)
"""Of the walls at low x, y, z and at high x, y, z."""


def rays_of(camera, pose):
    """Directions (h, w, 3) in the map, of length 1 along the optical axis."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    return camera.directions(np.stack([u, v], axis=-1)) @ pose[:3, :3].T


def pose_at(at, yaw, down=0.0):
    return pose_matrix([*at, yaw], level_from_camera([0.0, np.cos(down), np.sin(down)]))


def room_view(yaw, down=0.0, at=(0.1, 0.0, 1.2), *, camera=CAMERA, gain=1.0):
    """Frame of a camera in an empty room of six colours, and its pose."""
    pose = pose_at(at, yaw, down)
    rays = rays_of(camera, pose)
    with np.errstate(divide="ignore"):
        walls = np.concatenate([(ROOM[0] - at) / rays, (ROOM[1] - at) / rays], axis=-1)
    walls[walls <= 0] = np.inf
    rgb = (gain * PAINT[walls.argmin(axis=-1)]).astype(np.uint8)
    return Frame.from_arrays(rgb, camera, depth=walls.min(axis=-1), odometry=pose), pose


def plane_view(distance, *, camera=CAMERA, slope=0.0, noise=None, pose=None):
    """Frame before the plane z = distance + slope * x of its own axes, and its pose."""
    pose = np.eye(4) if pose is None else pose
    rays = rays_of(camera, np.eye(4))
    depth = distance / (1.0 - slope * rays[..., 0])
    if noise is not None:
        depth = depth + noise.normal(0, 0.005, depth.shape)
    rgb = np.full((camera.height, camera.width, 3), 100, np.uint8)
    return Frame.from_arrays(rgb, camera, depth=depth, odometry=pose), pose


@pytest.fixture(scope="session")
def views():
    """Views of the whole room: `(frames, poses)`."""
    made = [room_view(yaw, down) for yaw in np.arange(0, 6.2, 0.7) for down in (-0.6, 0.2, 0.9)]
    frames, poses = zip(*made, strict=True)
    return frames, np.array(poses)


@pytest.fixture(scope="session")
def scene():
    """The functions and constants above."""
    from types import SimpleNamespace

    return SimpleNamespace(
        camera=CAMERA, room=ROOM, paint=PAINT, room_view=room_view, plane_view=plane_view,
        pose_at=pose_at, rays_of=rays_of,
    )  # fmt: skip
