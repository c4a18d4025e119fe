import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.bake import bake
from placegraph.indoor.mapping.atlas.colours import mesh_colours, surface_colours

UP, DOWN = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
NONE = np.zeros(1, np.int64)


def waves(points):
    return (128 + 90 * np.sin(points * (8.0, 7.0, 6.0))).astype(np.uint8)


def test_few_triangles_carry_the_colours_of_many(sphere, spots, rng):
    dense, rows = sphere(6)
    colour_of = surface_colours(dense, rows, waves(dense))
    few = Mesh.plain(*sphere(3))
    after = bake(few, colour_of, texel=0.01, tolerance=2)
    row, u, v, at = spots(after, 4000, rng)
    on = at / np.linalg.norm(at, axis=1, keepdims=True)  # up to 1 cm away
    off = np.abs(after.colour_at(row, u, v).astype(int) - waves(on)).max(axis=1)
    assert np.median(off) <= 5
    assert off.max() < 25
    corners = Mesh.plain(few.vertices, few.triangles, None, waves(few.vertices))
    worse = np.abs(corners.colour_at(row, u, v).astype(int) - waves(on)).max(axis=1)
    assert np.median(worse) > 2 * np.median(off)


def test_a_sheet_has_two_sides(grid):
    points, rows = grid(4, 4)
    below = points - (0, 0, 0.01)
    colours = np.repeat([[200, 0, 0], [0, 0, 200]], len(points), axis=0)
    colour_of = surface_colours(
        np.concatenate([points, below]),
        np.concatenate([rows, rows[:, ::-1] + len(points)]),
        colours,
    )
    for height in (0.02, 0.0, -0.002, -0.008, -0.01, -0.03):
        at = np.array([[0.21, 0.13, height]])
        assert colour_of(at, UP, NONE)[0].tolist() == [[200, 0, 0]]
        assert colour_of(at, DOWN, NONE)[0].tolist() == [[0, 0, 200]]


def test_beside_the_surface_the_nearest_corner_speaks_and_far_away_nobody(grid):
    points, rows = grid(4, 4)
    colours = np.full(points.shape, 50, np.uint8)
    colours[0] = 90  # at the origin
    colour_of = surface_colours(points, rows, colours, reach=0.1)
    at = np.array([[-0.05, -0.05, 0.0], [-0.05, 0.31, 0.05], [-0.3, 0.0, 0.0], [0.2, 0.2, 0.5]])
    got, known = colour_of(at, UP.repeat(4, axis=0), NONE.repeat(4))
    assert known.tolist() == [True, True, False, False]
    assert got[:2].tolist() == [[90] * 3, [50] * 3]


def test_textures_are_carried_over(room, spots, rng):
    colour_of = mesh_colours(room.mesh, texel=0.01)
    after = bake(room.mesh, colour_of, texel=0.01)
    row, u, v, _ = spots(room.mesh, 5000, rng)
    off = np.abs(after.colour_at(row, u, v).astype(int) - room.mesh.colour_at(row, u, v))
    assert np.median(off.max(axis=1)) <= 8
    assert np.mean(off.max(axis=1) > 60) < 0.05


def test_options(room):
    with pytest.raises(OptionError, match="reach is 0"):
        mesh_colours(room.mesh, reach=0)
    with pytest.raises(OptionError, match="triangle"):
        surface_colours(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8))
