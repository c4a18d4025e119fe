import numpy as np
import pytest

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph_lab.tables.indoor import maps as indoor_maps
from placegraph_lab.tables.indoor.maps import house, office


def box(low, high):
    """Corners and triangles of a box, facing outwards."""
    x, y, z = np.array([low, high], float).T
    corners = np.array([[x[i], y[j], z[k]] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


@pytest.fixture
def scene():
    """A floor and a table on it."""
    floor, table = box((-3, -3, -0.1), (3, 3, 0)), box((0, 0, 0), (1, 0.6, 0.7))
    points, triangles = np.vstack([floor[0], table[0]]), np.vstack([floor[1], table[1] + 8])
    colours = np.repeat([[90, 90, 90], [200, 120, 40]], 8, axis=0)
    mesh = Mesh.plain(points, triangles, np.repeat([0, 1], 12), colours)
    return SceneMap.create(
        mesh, ["f", "t"], ["floor", "table"], floor=0.0, names=["", "oak table"],
        attributes=[{}, {"material": "oak"}], relations=[(1, "on", 0)],
    )  # fmt: skip


def test_maps_are_made_once_and_old_ones_go(scene, tmp_path, monkeypatch):
    made = []

    def build(source, path, *, detail):
        made.append((source, detail))
        scene.save(path)

    monkeypatch.setattr(indoor_maps, "build_scene", build)
    first, again = (house(tmp_path, tmp_path / "cache") for _ in range(2))
    assert made == [(tmp_path / "house/map/house.glb", "full")]
    assert first.graph.labels == again.graph.labels == ("floor", "table")
    monkeypatch.setattr(indoor_maps, "code_key", lambda _: "0" * 16)
    house(tmp_path, tmp_path / "cache")
    assert len(made) == 2
    assert [p.name for p in (tmp_path / "cache").iterdir()] == [f"house_{'0' * 16}.scene"]


def test_half_of_the_office_is_a_map(shared, tmp_path, monkeypatch):
    monkeypatch.setattr(indoor_maps, "HALVES", {"few": ((250, 254), (0, 1))})
    found = office(shared / "data", tmp_path, "few", 3000)
    assert len(found) == 1
    assert 2500 <= len(found.mesh) <= 3000
    assert found.floors[0] == pytest.approx(-1.53, abs=0.03)
    assert [p.suffix for p in tmp_path.iterdir()] == [".scene"]
