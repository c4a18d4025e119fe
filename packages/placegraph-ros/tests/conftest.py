import numpy as np
import pytest

from placegraph.core.estimate import Evidence, ObjectRef, PoseEstimate, PoseMode, Status
from placegraph.core.geometry import level_from_camera, pose_matrix
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from ros_world import made

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 2, 1), (3, 2, 1), (2, 3, 2)], float)
EVIDENCE = (
    Evidence("table 1", "for", 3.5, (ObjectRef("1", "table", ""),)),
    Evidence(
        "lamp 2", "against", -2.0, (ObjectRef("2", "lamp", ""),), "not at its place in the map"
    ),
    Evidence("depth", "for", 0.9, note="90% of the readings lie on the map's surfaces"),
)


@pytest.fixture(scope="session")
def scene():
    mesh = Mesh.plain(CORNERS, np.array([(0, 1, 2), (3, 4, 5)]), object_of=np.array([0, 1]))
    return SceneMap.create(mesh, ["1", "2"], ["table", "lamp"], floor=0.0, names=["", "Old lamp"])


def mode(pose, probability, covariance, evidence=()):
    matrix = pose_matrix(pose, level_from_camera((0.1, 1.0, 0.2)))
    return PoseMode(
        map_from_camera=matrix, pose=np.array(pose, float), covariance=covariance,
        probability=probability, scene="flat", scene_from_camera=matrix,
        explain=lambda: evidence,
    )  # fmt: skip


@pytest.fixture
def estimate(scene, rng):
    def made(status=Status.OK):
        spread = [r @ r.T * 1e-3 for r in rng.normal(size=(2, 6, 6))]
        modes = (
            mode((1, 2, 1.6, 1.0), 0.75, spread[0], EVIDENCE),
            mode((4, 2, 1.6, -0.5), 0.25, spread[1]),
        )
        return PoseEstimate(status, modes, "One place fits.", map=scene)

    return made


@pytest.fixture(scope="session")
def room(tmp_path_factory, study):
    return made(tmp_path_factory.mktemp("room"), study)
