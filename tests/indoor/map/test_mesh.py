"""The mesh: arrays that fit each other, colours of hits, coordinates in steps."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import GRAIN, UV_GRAIN, WHITE, Mesh

SQUARE = [[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]]
HALVES = [[0, 1, 2], [0, 2, 3]]


def square(**columns):
    plain = {
        "vertices": np.array(SQUARE, np.float32), "triangles": np.array(HALVES, np.int32),
        "object_of": np.array([0, 1], np.int32), "colours": np.full((4, 3), 255, np.uint8),
        "uv": np.zeros((4, 2), np.float32), "texture_of": np.zeros(2, np.int32), "textures": (WHITE,),
    }  # fmt: skip
    return Mesh(**(plain | columns))


def test_columns_have_their_types_and_cannot_be_written():
    mine = np.array(SQUARE, np.float32)
    mesh = square(vertices=mine, triangles=np.array(HALVES), object_of=[0, 1])
    assert (mesh.triangles.dtype, mesh.object_of.dtype) == (np.int32, np.int32)
    for name in ("vertices", "triangles", "object_of", "colours", "uv", "texture_of"):
        assert not getattr(mesh, name).flags.writeable
    assert not mesh.textures[0].flags.writeable
    mine[0, 0] = 0.0  # the caller's own stays his
    assert repr(mesh) == "Mesh(2 triangles, 4 vertices, 1 textures)"
    assert len(mesh) == 2


@pytest.mark.parametrize(
    ("columns", "says"),
    [
        ({"triangles": [[0, 1, 4]] * 2}, "triangles: a row lies outside 0 to 3"),
        ({"triangles": [[0, 1, -1]] * 2}, "triangles: a row"),
        ({"triangles": [[0, 1, 2**32]] * 2}, "triangles: a number does not fit into int32"),
        ({"triangles": [[0.0, 1.0, 2.0]] * 2}, "triangles: float64"),
        ({"triangles": [[0, 1]] * 2}, "triangles: shape"),
        ({"object_of": [0]}, "object_of: shape"),
        ({"object_of": [0, -1]}, "object_of: a row"),
        ({"texture_of": [0, 1]}, "texture_of: a row lies outside 0 to 0"),
        ({"vertices": [[0, 0, np.nan]] * 4}, "vertices: a number is not finite"),
        ({"vertices": [[0, 0, 1e39]] * 4}, "vertices: a number is not finite"),
        ({"uv": [[0, np.inf]] * 4}, "uv: a number is not finite"),
        ({"uv": np.zeros((3, 2))}, "uv: shape"),
        ({"colours": [[0, 0, 256]] * 4}, "colours: a number does not fit into uint8"),
        ({"textures": ()}, "textures: there is none"),
        ({"textures": (np.zeros((2, 2), np.uint8),)}, "textures: 0 is uint8"),
        ({"textures": (WHITE, np.zeros((2, 2, 3)))}, "textures: 1 is float64"),
        ({"textures": (np.zeros((0, 2, 3), np.uint8),)}, "textures: 0 is"),
    ],
)
def test_what_does_not_fit_is_refused(columns, says):
    with pytest.raises(OptionError, match=says):
        square(**columns)


def test_plain_meshes():
    mesh = Mesh.plain(SQUARE, HALVES)
    assert mesh.object_of.tolist() == [0, 0]
    assert (mesh.colours == 255).all()
    coloured = Mesh.plain(SQUARE, HALVES, [1, 0], np.full((4, 3), 9))
    assert coloured.object_of.tolist() == [1, 0]
    assert (coloured.colours == 9).all()
    assert len(Mesh.plain(np.zeros((0, 3)), np.zeros((0, 3), int))) == 0


def test_bounds():
    mesh = square(vertices=np.array([[0, 0, 5], [2, 0, 0], [2, 1, 0], [-7, 1, 0]], np.float32))
    assert mesh.bounds().tolist() == [[-7, 0, 0], [2, 1, 5]]
    boxes = mesh.object_bounds(3)
    assert boxes[0].tolist() == [[0, 0, 0], [2, 1, 5]]
    assert boxes[1].tolist() == [[-7, 0, 0], [2, 1, 5]]
    assert np.isnan(boxes[2]).all()
    assert np.isnan(Mesh.plain(np.zeros((0, 3)), np.zeros((0, 3), int)).bounds()).all()


def test_bounds_of_objects_in_any_order(rng):
    triangles = rng.integers(0, 50, (200, 3))
    points, owner = rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 9, 200)
    boxes = Mesh.plain(points, triangles, owner).object_bounds(9)
    for row in range(9):
        own = points[triangles[owner == row].ravel()]
        np.testing.assert_array_equal(boxes[row], [own.min(axis=0), own.max(axis=0)])


def test_normals_are_twice_the_area():
    assert square().normals().tolist() == [[0, 0, 2], [0, 0, 2]]


# --- colours ---

CHESS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)


def colour(mesh, triangle, u, v):
    columns = np.array([triangle], np.int32), np.array([u], np.float32), np.array([v], np.float32)
    return mesh.colour_at(*columns)[0].tolist()


def test_a_hit_has_the_colour_of_its_texel():
    """Texture coordinates run with x and against y: v is down, as rows of the image are."""
    mesh = square(uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32), textures=(CHESS,))
    assert colour(mesh, 1, 0.1, 0.8) == [255, 0, 0]  # near (0, 1): the first row, the first column
    assert colour(mesh, 0, 0.1, 0.85) == [0, 255, 0]  # near (2, 1)
    assert colour(mesh, 0, 0.1, 0.05) == [0, 0, 255]  # near the origin
    assert colour(mesh, 0, 0.9, 0.05) == [255, 255, 255]  # near (2, 0)
    assert colour(mesh, -1, 0.3, 0.3) == [0, 0, 0]


def test_textures_repeat():
    near = square(uv=np.full((4, 2), [0.25, 0.75], np.float32), textures=(CHESS,))
    far = square(uv=np.full((4, 2), [-3.75, 8.75], np.float32), textures=(CHESS,))
    assert colour(near, 0, 0.3, 0.3) == colour(far, 0, 0.3, 0.3) == [0, 0, 255]
    edge = square(uv=np.ones((4, 2), np.float32), textures=(CHESS,))
    assert colour(edge, 0, 0.3, 0.3) == [255, 0, 0]


def test_vertex_colours_are_mixed_and_multiplied():
    mesh = square(
        colours=np.array([[0, 0, 0], [200, 0, 0], [0, 100, 255], [9, 9, 9]], np.uint8),
        textures=(WHITE, np.full((1, 1, 3), 51, np.uint8)), texture_of=[1, 0],
    )  # fmt: skip
    assert colour(mesh, 0, 0.5, 0.5) == [20, 10, 26]
    assert colour(mesh, 0, 1.0, 0.0) == [40, 0, 0]
    assert colour(mesh, 1, 1.0, 0.0) == [0, 100, 255]


def test_texels_lie_behind_each_other():
    other = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    texels, starts, sizes = square(textures=(CHESS, other)).texels()
    assert sizes.tolist() == [[2, 2], [3, 2]]
    assert starts.tolist() == [0, 4]
    assert texels[4 + 1 * 3 + 2].tolist() == other[1, 2].tolist()


# --- steps ---

coordinates = arrays.arrays(
    np.float32, (4, 3), elements=st.floats(-1e4, 1e4, width=32) | st.floats(-3, 3, width=32)
)


@given(coordinates)
def test_snapping_moves_little_and_once(points):
    mesh = square(vertices=points, uv=points[:, :2])
    snapped = mesh.snapped()
    step, uv_step = mesh.steps()
    assert step >= GRAIN
    assert uv_step >= UV_GRAIN
    assert np.abs(snapped.vertices - points).max() <= step / 2
    assert np.abs(snapped.uv - points[:, :2]).max() <= uv_step / 2
    again = snapped.snapped()
    np.testing.assert_array_equal(again.vertices, snapped.vertices)
    np.testing.assert_array_equal(again.uv, snapped.uv)
    multiples = snapped.vertices.astype(np.float64) / snapped.steps()[0]
    np.testing.assert_array_equal(multiples, np.rint(multiples))


def test_steps_are_fine_in_a_house_and_coarse_on_a_continent():
    shifted = square().moved([GRAIN, 0, 0])
    assert shifted.steps() == (GRAIN, UV_GRAIN)
    assert square().steps()[0] == 1.0, "the longest that all coordinates are multiples of"
    large = square(vertices=np.array(SQUARE, np.float32) * 1e6 + 0.5)
    assert 0.1 < large.steps()[0] < 1.0


def test_moved():
    moved = square().moved([1, 2, 3])
    assert moved.vertices[0].tolist() == [1, 2, 3]
    assert moved.vertices.dtype == np.float32
