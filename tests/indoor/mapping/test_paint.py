"""Textures brought to vertices."""

import numpy as np
import pytest

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.export import painted
from placegraph.indoor.scene_map import SceneMap


def quad(texture, colours=255):
    """A square of two triangles under a texture."""
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    mesh = Mesh(
        vertices=np.column_stack([corners, np.zeros(4)]).astype(np.float32),
        triangles=np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        object_of=np.zeros(2, np.int32),
        colours=np.full((4, 3), colours, np.uint8),
        uv=(corners * 0.999).astype(np.float32),
        texture_of=np.zeros(2, np.int32),
        textures=(np.asarray(texture, np.uint8),),
    )
    return SceneMap.create(mesh, ["0"], ["floor"], floor=0.0)


def test_a_flat_texture_gives_its_colour_times_the_vertices_own():
    model = painted(quad(np.full((8, 8, 3), (10, 100, 200)), colours=51))
    assert (model.colours == [2, 20, 40]).all()


def test_a_vertex_has_the_colours_around_it():
    halves = np.zeros((64, 64, 3))
    halves[:, 32:] = 200  # bright where x is large
    model = painted(quad(halves))
    bright = model.colours[:, 0].astype(int)
    left = model.vertices[:, 0] < 0.5
    assert bright[left].max() < 80
    assert bright[~left].min() > 120


def test_objects_and_textures_do_not_share_vertices():
    scene = quad(np.full((1, 1, 3), 255))
    mesh = Mesh(
        vertices=scene.mesh.vertices, triangles=scene.mesh.triangles,
        object_of=np.array([0, 1]), colours=scene.mesh.colours, uv=scene.mesh.uv,
        texture_of=np.array([0, 1]),
        textures=(np.full((1, 1, 3), 40, np.uint8), np.full((1, 1, 3), 80, np.uint8)),
    )  # fmt: skip
    two = SceneMap.create(mesh, ["a", "b"], ["floor", "wall"], floor=0.0, names=["", "W"])
    model = painted(two)
    assert len(model.vertices) == 6
    for row, value in ((0, 40), (1, 80)):
        assert (model.colours[model.triangles[model.thing_of == row]] == value).all()
    assert [(t.id, t.label, t.name) for t in model.things] == [
        ("a", "floor", ""),
        ("b", "wall", "W"),
    ]


def test_the_surface_stays_where_it_was(room):
    model = painted(room)
    assert (model.vertices[model.triangles] == room.mesh.vertices[room.mesh.triangles]).all()
    assert model.relations == tuple(
        zip(room.graph.sources, room.graph.relations, room.graph.targets, strict=True)
    )
    assert model.floor == pytest.approx(room.floors[0])
