"""small_gicp brings a disturbed pose back, and says what it cannot do."""

import numpy as np
import pytest

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.metrics import position_error, rotation_error
from placegraph_lab.tables.indoor.refine import align
from placegraph_lab.tables.indoor.windows import disturbed

CAMERA = Camera(160, 120, 100.0, 100.0, 80.0, 60.0)
FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
BOXES = (
    ((-2, -2, 0), (2, 2.5, 2.6)),
    ((1, 0.3, 0), (1.8, 1.1, 0.9)),
    ((0, 1.6, 0), (0.6, 2.4, 1.8)),
)


@pytest.fixture(scope="module")
def scene():
    """A room with two boxes in it."""
    corners, triangles = [], []
    for i, (low, high) in enumerate(BOXES):
        x, y, z = np.array([low, high], float).T
        corners += [[x[a], y[b], z[c]] for a in (0, 1) for b in (0, 1) for c in (0, 1)]
        for a, b, c, d in FACES:
            triangles += [(8 * i + a, 8 * i + b, 8 * i + c), (8 * i + a, 8 * i + c, 8 * i + d)]
    mesh = Mesh.plain(corners, triangles, np.repeat(range(3), 12))
    return SceneMap.create(mesh, ["r", "a", "b"], ["room", "box", "box"], floor=0.0)


def frames_at(scene, poses):
    """Frames with the depth that the map itself shows, odometry in a frame of its own."""
    odometry_from_map = pose_matrix([5.0, -3.0, 0.0, 1.0], np.eye(3))
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.directions(np.stack([u.ravel(), v.ravel()], axis=-1) + 0.5)
    for i, pose in enumerate(poses):
        hits = scene.caster.cast(np.broadcast_to(pose[:3, 3], rays.shape), rays @ pose[:3, :3].T)
        depth = np.where(hits.triangle >= 0, hits.distance, np.nan).reshape(v.shape)
        yield Frame.from_arrays(
            np.zeros((*v.shape, 3), np.uint8), CAMERA, depth=depth, stamp=i, index=i,
            odometry=odometry_from_map @ pose,
        )  # fmt: skip


@pytest.fixture(scope="module")
def poses():
    """Three poses in a curve."""
    level = level_from_camera([0.0, 0.98, 0.2])
    return [pose_matrix([-1.2 + 0.3 * i, -1.0, 1.5, 0.6 + 0.2 * i], level) for i in range(3)]


@pytest.fixture(scope="module")
def frames(scene, poses):
    return list(frames_at(scene, poses))


@pytest.mark.parametrize("kind", ["PLANE_ICP", "GICP"])
def test_it_comes_back(scene, frames, poses, kind, rng):
    start = disturbed(poses[-1], rng)
    found, _, near = align(scene, frames, start, kind=kind)
    assert position_error(found, poses[-1]) < 0.02
    assert rotation_error(found, poses[-1]) < 0.5
    assert 0.8 < near <= 1.0


def test_nothing_to_see_moves_nothing(scene, frames):
    far = pose_matrix([60.0, 0.0, 1.5, 0.0], level_from_camera([0.0, 1.0, 0.0]))
    found, converged, near = align(scene, frames, far)
    assert not converged
    assert (found == far).all()
    assert near == 0
