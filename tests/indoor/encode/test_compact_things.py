"""What the compact encoder is told of objects: shape, colours, label, however the map was made."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.indoor.build import scene_of_model
from placegraph.indoor.encode.compact import things
from placegraph.indoor.encode.compact.things import (
    COLOUR,
    FEATURES,
    POINTS,
    SHAPE,
    describe,
    features,
)
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.scene_map import SceneMap

ROOM = {
    "floor": ((0, 0, -0.1), (4, 3, 0)),
    "wall": ((0, 3, 0), (4, 3.1, 2.5)),
    "table": ((1, 1, 0), (2.6, 1.8, 0.75)),
    "lamp": ((2, 2, 2.2), (2.2, 2.2, 2.5)),
}
AREA, SHORT, LONG, TALL, LOWEST, HIGHEST = 0, 1, 2, 3, 9, 13
"""Columns of the shape."""


def told(scene, words=None):
    n = len(scene)
    return features(describe(scene), np.zeros((n, 64), np.float32) if words is None else words)


def shapes(scene):
    return told(scene)[:, :SHAPE]


def painted(scene, factor):
    """The map, its vertices' colours multiplied."""
    mesh = scene.mesh
    colours = np.clip(mesh.colours * np.asarray(factor), 0, 255).astype(np.uint8)
    return with_mesh(scene, replace(mesh, colours=colours))


def with_mesh(scene, mesh):
    return SceneMap.create(mesh, scene.graph.ids, scene.graph.labels, floor=float(scene.floors[0]))


@pytest.fixture(scope="module")
def scene(boxes):
    """Four boxes, of four colours."""
    made = scene_of_model(boxes(ROOM))
    paints = np.array(
        [[180, 150, 120], [200, 200, 190], [150, 110, 105], [240, 240, 180]], np.uint8
    )
    mesh = made.mesh
    colours = np.zeros((len(mesh.vertices), 3), np.uint8)
    colours[mesh.triangles] = paints[mesh.object_of][:, None]
    return with_mesh(made, Mesh.plain(mesh.vertices, mesh.triangles, mesh.object_of, colours))


def test_sizes_and_heights(scene):
    shape = shapes(scene)
    table = shape[scene.graph.labels.index("table")]
    assert np.exp(table[AREA]) == pytest.approx(2 * (1.6 * 0.8 + 0.75 * 2.4), rel=0.02)
    sides = np.exp(table[[SHORT, LONG, TALL]]) - 0.05
    np.testing.assert_allclose(sides, [0.8, 1.6, 0.75], atol=0.08)
    assert table[LOWEST] == pytest.approx(0.0, abs=0.02)
    assert table[HIGHEST] == pytest.approx(0.75, abs=0.02)
    lamp = shape[scene.graph.labels.index("lamp")]
    assert lamp[LOWEST] == pytest.approx(2.2, abs=0.03)


@settings(max_examples=8, deadline=None)
@given(yaw=st.floats(-3.0, 3.0), x=st.floats(-50, 50), y=st.floats(-50, 50))
def test_shape_is_the_same_wherever_north_is(scene, yaw, x, y):
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    moved = replace(scene.mesh, vertices=scene.mesh.vertices @ turn.T + (x, y, 0.0))
    np.testing.assert_allclose(shapes(with_mesh(scene, moved)), shapes(scene), atol=0.12)


def test_shape_hardly_depends_on_the_triangles(scene):
    """Every triangle cut into four."""
    mesh = scene.mesh
    corners = mesh.vertices[mesh.triangles]
    a, b, c = np.moveaxis(corners, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    parts = np.concatenate(
        [np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))]
    )
    one = parts.reshape(-1, 3)
    colour = np.repeat(mesh.colours[mesh.triangles[:, 0]], 3, axis=0)
    fine = Mesh.plain(
        one, np.arange(len(one)).reshape(-1, 3), np.tile(mesh.object_of, 4), np.tile(colour, (4, 1))
    )
    before, after = shapes(scene), shapes(with_mesh(scene, fine))
    np.testing.assert_allclose(
        before[:, [AREA, LOWEST, HIGHEST]], after[:, [AREA, LOWEST, HIGHEST]], atol=0.1
    )
    np.testing.assert_allclose(before, after, atol=0.35)


def test_the_exposure_of_a_map_is_taken_out(scene):
    dark = told(painted(scene, 0.85))
    bright = told(scene)
    relative = slice(SHAPE, SHAPE + 3)
    np.testing.assert_allclose(dark[:, relative], bright[:, relative], atol=0.05)
    assert (dark[:, SHAPE + 3] < bright[:, SHAPE + 3] - 0.2).all()  # as it is: darker


def test_a_map_without_colours_says_so(boxes):
    plain = scene_of_model(boxes(ROOM))
    columns = told(plain)[:, SHAPE:]
    assert not plain.coloured
    assert not columns[:, : COLOUR + 1].any()
    assert np.isfinite(told(plain)).all()


def test_labels_say_something_or_not(scene):
    words = np.zeros((4, 64), np.float32)
    words[1, 3] = 1.0
    got = told(scene, words)
    assert got.shape == (4, FEATURES)
    np.testing.assert_array_equal(got[:, -1], [0, 1, 0, 0])
    np.testing.assert_array_equal(got[:, SHAPE + COLOUR + 1 : -1], words)


def test_merged_scenes_are_told_each_on_its_own(scene):
    merged = merge_scenes({"a": scene, "b": painted(scene, (0.5, 0.8, 0.5))})
    both = told(merged)
    np.testing.assert_allclose(both[:4], told(scene), atol=0.12)
    np.testing.assert_allclose(both[4:], told(painted(scene, (0.5, 0.8, 0.5))), atol=0.12)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 999), scale=st.floats(0.1, 10.0))
def test_histograms_are_shares_with_the_right_mean(seed, scale):
    values = np.random.default_rng(seed).uniform(-0.9, 0.9, (3, POINTS)).astype(np.float32)
    shares = things._histogram(values * np.float32(scale), -scale, scale)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-5)
    bins = np.linspace(-scale, scale, things.BINS)
    np.testing.assert_allclose(shares @ bins, values.mean(axis=1) * scale, atol=1e-3 * scale)


def test_an_object_of_no_area_is_still_a_number(boxes):
    scene = scene_of_model(boxes(ROOM))
    flat = scene.mesh.vertices.copy()
    rows = scene.mesh.triangles[scene.mesh.object_of == 3]
    flat[rows] = flat[rows[0, 0]]
    assert np.isfinite(told(with_mesh(scene, replace(scene.mesh, vertices=flat)))).all()
