from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from tests.indoor.mapping.parts import lattice

from placegraph.core.mapfile import compress_array
from placegraph.errors import OptionError
from placegraph.indoor.map.map_kernels import sample_colour
from placegraph.indoor.map.mesh import (
    GRAIN,
    UV_GRAIN,
    WHITE,
    Mesh,
    Surface,
    decode_high_water,
    encode_high_water,
    sort_triangles,
)

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
        ({"triangles": [[0, 1, 4]] * 2}, r"a row index is outside 0 to 3\."),
        ({"triangles": [[0, 1, -1]] * 2}, "triangles: a row"),
        ({"triangles": [[0, 1, 2**32]] * 2}, "triangles: a number does not fit into int32"),
        ({"triangles": [[0.0, 1.0, 2.0]] * 2}, "triangles: float64"),
        ({"triangles": [[0, 1]] * 2}, "triangles: shape"),
        ({"object_of": [0]}, "object_of: shape"),
        ({"object_of": [0, -1]}, "object_of: a row"),
        ({"texture_of": [0, 1]}, r"a row index is outside 0 to 0\."),
        ({"vertices": [[0, 0, np.nan]] * 4}, "vertices: a number is not finite"),
        ({"vertices": [[0, 0, 1e39]] * 4}, "vertices: a number is not finite"),
        ({"uv": [[0, np.inf]] * 4}, "uv: a number is not finite"),
        ({"uv": np.zeros((3, 2))}, "uv: shape"),
        ({"colours": [[0, 0, 256]] * 4}, "colours: a number does not fit into uint8"),
        ({"textures": ()}, "textures: the list is empty"),
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
    assert square().normals().tolist() == [[0, 0, 2], [0, 0, 2]]  # twice the area
    moved = square().translate([1, 2, 3])
    assert moved.vertices[0].tolist() == [1, 2, 3]
    assert moved.vertices.dtype == np.float32


def test_bounds(rng):
    empty = Mesh.plain(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert np.isnan(empty.bounds()).all()
    triangles = rng.integers(0, 50, (200, 3))
    points, owner = rng.normal(size=(50, 3)).astype(np.float32), rng.integers(0, 9, 200)
    mesh = Mesh.plain(points, triangles, owner)
    np.testing.assert_array_equal(mesh.bounds(), [points.min(axis=0), points.max(axis=0)])
    boxes = mesh.object_bounds(10)
    for row in range(9):
        own = points[triangles[owner == row].ravel()]
        np.testing.assert_array_equal(boxes[row], [own.min(axis=0), own.max(axis=0)])
    assert np.isnan(boxes[9]).all()


CHESS = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)


def colour(mesh, triangle, u, v):
    columns = np.array([triangle], np.int32), np.array([u], np.float32), np.array([v], np.float32)
    return mesh.colour_at(*columns)[0].tolist()


def test_a_hit_has_the_colour_of_its_texel():
    mesh = square(uv=np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32), textures=(CHESS,))
    assert colour(mesh, 1, 0.1, 0.8) == [255, 0, 0]  # near (0, 1): the first row, the first column
    assert colour(mesh, 0, 0.1, 0.85) == [0, 255, 0]  # near (2, 1)
    assert colour(mesh, 0, 0.1, 0.05) == [0, 0, 255]  # near the origin
    assert colour(mesh, 0, 0.9, 0.05) == [255, 255, 255]  # near (2, 0)
    assert colour(mesh, -1, 0.3, 0.3) == [0, 0, 0]
    for at in ([0.25, 0.75], [-3.75, 8.75]):  # textures repeat
        far = square(uv=np.full((4, 2), at, np.float32), textures=(CHESS,))
        assert colour(far, 0, 0.3, 0.3) == [0, 0, 255]
    edge = square(uv=np.ones((4, 2), np.float32), textures=(CHESS,))
    assert colour(edge, 0, 0.3, 0.3) == [255, 0, 0]
    other = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)
    texels, starts, sizes = square(textures=(CHESS, other)).texels()
    assert sizes.tolist() == [[2, 2], [3, 2]]
    assert starts.tolist() == [0, 4]
    assert texels[4 + 1 * 3 + 2].tolist() == other[1, 2].tolist()


def test_vertex_colours_are_mixed_and_multiplied():
    mesh = square(
        colours=np.array([[0, 0, 0], [200, 0, 0], [0, 100, 255], [9, 9, 9]], np.uint8),
        textures=(WHITE, np.full((1, 1, 3), 51, np.uint8)), texture_of=[1, 0],
    )  # fmt: skip
    assert colour(mesh, 0, 0.5, 0.5) == [20, 10, 26]
    assert colour(mesh, 0, 1.0, 0.0) == [40, 0, 0]
    assert colour(mesh, 1, 1.0, 0.0) == [0, 100, 255]


coordinates = arrays.arrays(
    np.float32, (4, 3), elements=st.floats(-1e4, 1e4, width=32) | st.floats(-3, 3, width=32)
)


@given(coordinates)
def test_snapping_moves_little_and_once(points):
    mesh = square(vertices=points, uv=points[:, :2])
    snapped = mesh.quantize()
    step, uv_step = mesh.steps()
    assert step >= GRAIN
    assert uv_step >= UV_GRAIN
    assert np.abs(snapped.vertices - points).max() <= step / 2
    assert np.abs(snapped.uv - points[:, :2]).max() <= uv_step / 2
    again = snapped.quantize()
    np.testing.assert_array_equal(again.vertices, snapped.vertices)
    np.testing.assert_array_equal(again.uv, snapped.uv)
    multiples = snapped.vertices.astype(np.float64) / snapped.steps()[0]
    np.testing.assert_array_equal(multiples, np.rint(multiples))
    # fine in a house and coarse on a continent
    assert square().translate([GRAIN, 0, 0]).steps() == (GRAIN, UV_GRAIN)
    assert square().steps()[0] == 1.0, "the longest that all coordinates are multiples of"
    large = square(vertices=np.array(SQUARE, np.float32) * 1e6 + 0.5)
    assert 0.1 < large.steps()[0] < 1.0


soups = st.integers(0, 60).flatmap(
    lambda n: st.lists(st.integers(0, max(n - 1, 0)), min_size=0, max_size=3 * n if n else 0)
)


@given(soups, st.integers(0, 2**32 - 1))
def test_the_surface_is_the_same_and_numbers_are_dense(rows, seed):
    triangles = np.array(rows[: len(rows) // 3 * 3], np.int32).reshape(-1, 3)
    back = decode_high_water(encode_high_water(triangles))
    np.testing.assert_array_equal(back, triangles)
    assert back.dtype == np.int32
    rng = np.random.default_rng(seed)
    count = int(triangles.max(initial=-1)) + 3
    mesh = Mesh.plain(
        rng.normal(size=(count, 3)), triangles, rng.integers(0, 4, len(triangles)),
        rng.integers(0, 255, (count, 3)),
    )  # fmt: skip
    after = sort_triangles(mesh)
    assert len(after) == len(mesh)
    assert len(after.vertices) == len(np.unique(triangles))

    def list_corners(m):
        corners = np.concatenate([m.vertices[m.triangles], m.colours[m.triangles]], axis=2)
        return sorted(
            (o, *c) for o, c in zip(m.object_of, corners.reshape(len(m), 18), strict=True)
        )

    assert list_corners(after) == list_corners(mesh)
    seen = after.triangles.ravel()
    firsts = np.sort(np.unique(seen, return_index=True)[1])
    np.testing.assert_array_equal(seen[firsts], np.arange(len(after.vertices)))


def test_order_makes_files_smaller(rng):
    points, triangles = lattice(60, 60)
    shuffled = rng.permutation(len(points))
    points = np.insert(60 * points, 2, 0.0, axis=1)[np.argsort(shuffled)]
    triangles = shuffled[triangles][rng.permutation(len(triangles))].astype(np.int32)
    codes = encode_high_water(sort_triangles(Mesh.plain(points, triangles)).triangles)
    assert len(compress_array(codes)[2]) < len(compress_array(triangles)[2]) / 3
    rim = np.arange(1, 40_001, dtype=np.int32)  # a fan of many triangles takes no time
    triangles = np.stack([0 * rim, rim, np.roll(rim, -1)], axis=1)
    points = rng.normal(size=(40_001, 3))
    assert len(sort_triangles(Mesh.plain(points, triangles))) == 40_000


def quad(texture, width=2.0, height=1.0, uv=1.0):
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    vertices = np.column_stack([corners * (width, height), np.zeros(4)]).astype(np.float32)
    texture = np.asarray(texture, np.uint8)
    return square(vertices=vertices, uv=(corners * uv).astype(np.float32), textures=(texture,))


def looked_at(surface, triangle, u, v, footprint=0.0):
    hits = zip(triangle, u.astype(np.float32), v.astype(np.float32), strict=True)
    return np.array([sample_colour(surface, *hit, np.float32(footprint)) for hit in hits])


def hits_on(mesh, rng, count=300):
    u, v = rng.random((2, count))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    return rng.integers(0, len(mesh), count), u * 0.98 + 0.005, v * 0.98 + 0.005


def test_near_by_it_shows_what_the_mesh_shows(flat, rng):
    mesh, surface = flat.mesh, flat.surface
    assert len(mesh.textures) > 10
    triangle, u, v = hits_on(mesh, rng, 2000)
    got = looked_at(surface, triangle, u, v) * 255
    expected = mesh.colour_at(triangle.astype(np.int32), u.astype("f4"), v.astype("f4"))
    # where a point lies on the edge of two texels, four bytes decide otherwise than eight
    off = np.abs(got - expected).max(axis=1) > 0.51
    assert off.mean() < 0.005
    assert np.ptp(expected) > 200
    np.testing.assert_array_equal(surface.object_of, mesh.object_of)


def test_what_stands_for_more_sees_more():
    board = np.zeros((64, 64, 3))
    board[np.add.outer(np.arange(64), np.arange(64)) % 2 == 0] = 255
    surface = Surface.of(quad(board, 1.0, 1.0))  # 64 texels a metre
    at = np.arange(20) % 2, np.linspace(0.1, 0.4, 20), np.linspace(0.5, 0.1, 20)
    near = looked_at(surface, *at, footprint=1 / 64)
    assert set(near.round(6).ravel().tolist()) == {0.0, 1.0}
    for footprint in (2 / 64, 1 / 8, 0.5, 3.0):
        np.testing.assert_allclose(looked_at(surface, *at, footprint), 0.5, atol=0.01)
    board[:, :32], board[:, 32:] = 0, 255  # of halves, a ray for a quarter of the wall sees one
    surface = Surface.of(quad(board, 1.0, 1.0))
    left = (np.array([1]), np.array([0.1]), np.array([0.7]))  # x = 0.1
    assert looked_at(surface, *left, 0.25).tolist() == [[0, 0, 0]]
    np.testing.assert_allclose(looked_at(surface, *left, 1.6), [[0.5, 0.5, 0.5]], atol=0.01)


def test_charts_of_an_atlas_are_not_mixed_from_afar(monkeypatch):
    monkeypatch.setattr("placegraph.indoor.map.mesh.MIN_ATLAS_CHARTS", 4)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:, :32], texture[:, 32:] = (250, 0, 0), (0, 0, 250)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    quads = [
        np.column_stack([corners, np.full(4, z)]) * [4, 4, 1] for z in range(8)
    ]  # eight charts, four of each colour
    uv = [
        corners * 0.2 + (0.02 + 0.5 * (z % 2) + 0.25 * (z // 2 % 2), 0.25 * (z // 4))
        for z in range(8)
    ]
    triangles = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * z for z in range(8)])
    mesh = Mesh.plain(np.concatenate(quads), triangles)
    mesh = replace(mesh, uv=np.concatenate(uv).astype(np.float32), textures=(texture,))
    surface = Surface.of(mesh)
    third = np.array([1 / 3])
    for triangle, wanted in ((0, (250, 0, 0)), (2, (0, 0, 250))):
        seen = looked_at(surface, np.array([triangle]), third, third, footprint=100.0)
        np.testing.assert_allclose(255 * seen, [wanted], atol=2)
    whole = Surface.of(replace(mesh, uv=np.tile(corners, (8, 1))))
    assert (whole.levels[0, -1, 1:] == 1).all(), "one picture ends in one texel"
