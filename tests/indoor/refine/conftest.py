"""Maps of a few triangles, and captures of them that are exact."""

from types import SimpleNamespace

import numpy as np
import pytest
from tests.indoor.conftest import _model, measure_error

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix, rotation_from_vector
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.refine.correspondences import PointMatches, Surfaces, sample_readings
from placegraph.indoor.refine.fit import Problem
from placegraph.indoor.refine.refiner import Refiner
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)


def _boxes(boxes):
    """Map of boxes {label: (low, high)}, each an object of six sides; the first is the hall."""
    model = _model(boxes)
    mesh = Mesh.plain(model.vertices, model.triangles, model.object_of)
    return SceneMap.create(mesh, list(map(str, range(len(boxes)))), list(boxes), floor=0.0)


def _standing(x, y, yaw_deg, down_deg=8.0, z=1.5):
    """map_from_camera (4, 4) of a camera that stands somewhere and looks down a little."""
    down = np.radians(down_deg)
    level = level_from_camera([0.0, np.cos(down), np.sin(down)])
    return pose_matrix([x, y, z, np.radians(yaw_deg)], level)


def _frames(scene, poses, camera=CAMERA, odometry=None):
    """Capture of exact renderings at poses (T, 4, 4), with exact odometry if none is given."""
    odometry = np.linalg.inv(poses[0]) @ poses if odometry is None else odometry
    frames = []
    for i, pose in enumerate(poses):
        drawn = scene.render(pose, camera, samples=1)
        frames.append(
            Frame.from_arrays(
                drawn.colour, camera, depth=drawn.depth, odometry=odometry[i],
                gravity=-pose[2, :3], stamp=float(i), index=i,
            )
        )  # fmt: skip
    return Capture.from_frames(frames)


def _problem(scene, capture, options=None, *, matches=None, blind=(), gravity=None, phase=0):
    """What the frames of a capture say; those in `blind` have no depth."""
    options = options or RefineOptions()
    seen = [
        None if t in blind else sample_readings(f, f.depth(), options.readings, phase)
        for t, f in enumerate(capture)
    ]
    return Problem(
        Surfaces.of(scene),
        seen,
        matches or [PointMatches.empty()] * len(capture),
        np.stack([f.odometry for f in capture]),
        np.stack([f.gravity for f in capture]) if gravity is None else gravity,
        np.array([f.stamp for f in capture]),
        len(scene),
        options,
    )


def _moved(poses, shift=(0.0, 0.0, 0.0), turn_deg=(0.0, 0.0, 0.0)):
    """Poses (..., 4, 4) as one rigid piece: turned about the last position, and shifted."""
    poses = np.asarray(poses, float)
    pivot = poses.reshape(-1, 4, 4)[-1, :3, 3]
    turn = rotation_from_vector(np.radians(turn_deg))
    out = poses.copy()
    out[..., :3, :3] = turn @ poses[..., :3, :3]
    out[..., :3, 3] = (poses[..., :3, 3] - pivot) @ turn.T + pivot + shift
    return out


def _check_near(poses, truth, metres, degrees=180.0):
    """Check that poses (T, 4, 4) or (4, 4) are within a distance [m] and a turn [deg] of the truth."""
    pairs = zip(np.reshape(poses, (-1, 4, 4)), np.reshape(truth, (-1, 4, 4)), strict=True)
    errors = np.array([measure_error(pose, true) for pose, true in pairs])
    assert (errors < (metres, degrees)).all(), errors


def _white(scene):
    """The map without colours."""
    mesh = Mesh.plain(scene.mesh.vertices, scene.mesh.triangles, scene.mesh.object_of)
    return SceneMap.create(mesh, scene.graph.ids, scene.graph.labels, floor=0.0)


@pytest.fixture(scope="session")
def kit():
    """Functions that make maps, poses, exact captures and problems: see those above."""
    return SimpleNamespace(
        boxes=_boxes, standing=_standing, frames=_frames, problem=_problem, moved=_moved, off=measure_error,
        white=_white, check_near=_check_near, camera=CAMERA,
    )  # fmt: skip


@pytest.fixture(scope="session")
def hall():
    """Bare hall of 6 x 4 x 3 m with a chest in it."""
    return _boxes({"hall": ((0, 0, 0), (6, 4, 3)), "chest": ((3, 1.2, 0), (4.2, 1.9, 1))})


@pytest.fixture(scope="session")
def way():
    """Poses (5, 4, 4) in the hall, that see a corner and the chest."""
    return np.stack([_standing(1.2 + 0.1 * i, 2.2, -30 + 6 * i) for i in range(5)])


@pytest.fixture(scope="session")
def walked(hall, way):
    """Exact capture of the hall."""
    return _frames(hall, way)


@pytest.fixture(scope="session")
def exact(room, walk, truth):
    """Exact capture of the drawn room along the walk's true way, and that way (T, 4, 4)."""
    poses = truth(walk)
    return SimpleNamespace(capture=_frames(room, poses), poses=poses)


@pytest.fixture(scope="session")
def located(room, walk):
    """The drawn room's first five frames, localized."""
    return room.localize(walk, frames=slice(0, 5))


@pytest.fixture
def refiner(room, walk):
    """Refiner of frames of the walk through the drawn room, by its options."""

    def made(scene=room, matcher=None, frames=slice(None), *, depth=True, colour=True, **options):
        chosen = list(walk)[frames]
        depths = [f.depth() if depth else None for f in chosen]
        queries = [f.rgb() if colour else None for f in chosen]
        return Refiner(scene, chosen, depths, queries, RefineOptions(**options), matcher)

    return made
