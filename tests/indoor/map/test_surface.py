"""Surfaces as compiled code reads them: the mesh's own colours, near and from afar."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.map.surface import Surface
from placegraph.indoor.map.surface_kernels import colour_at, opponent


def quad(texture, width=2.0, height=1.0, uv=1.0, colours=255):
    """Wall width x height [m] with `uv` repeats of a texture along each side."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    return Mesh(
        vertices=np.column_stack([corners * (width, height), np.zeros(4)]).astype(np.float32),
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        object_of=np.array([0, 1], np.int32),
        colours=np.broadcast_to(np.uint8(colours), (4, 3)).astype(np.uint8),
        uv=(corners * uv).astype(np.float32),
        texture_of=np.zeros(2, np.int32),
        textures=(np.asarray(texture, np.uint8),),
    )


def looked_at(surface, triangle, u, v, footprint=0.0):
    """Colours (N, 3) of hits."""
    hits = zip(triangle, u.astype(np.float32), v.astype(np.float32), strict=True)
    return np.array([colour_at(surface, *hit, np.float32(footprint)) for hit in hits])


def hits_on(mesh, rng, count=300):
    """Random triangles and barycentrics well within them."""
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


def test_corner_colours_tint_the_texture(rng):
    mesh = quad(rng.integers(0, 256, (5, 7, 3)), uv=3.7)
    mesh = Mesh(
        mesh.vertices, mesh.triangles, mesh.object_of,
        rng.integers(0, 256, (4, 3)).astype(np.uint8),
        mesh.uv - 5.3, mesh.texture_of, mesh.textures,
    )  # fmt: skip
    triangle, u, v = hits_on(mesh, rng)
    got = looked_at(Surface.of(mesh), triangle, u, v) * 255
    expected = mesh.colour_at(triangle.astype(np.int32), u.astype("f4"), v.astype("f4"))
    assert (np.abs(got - expected).max(axis=1) > 0.51).mean() < 0.02


def test_a_texture_repeats_even_at_its_seams():
    """Coordinates a hair below a whole number lie on the last texel, not beyond it."""
    texture = np.arange(4 * 3).reshape(1, 4, 3) * 20
    mesh = quad(texture, uv=1.0)
    for shift in (0.0, -1e-9, 1.0 - 2**-24, -3.0, 1e4):
        moved = Mesh(
            mesh.vertices, mesh.triangles, mesh.object_of, mesh.colours,
            np.full((4, 2), shift, np.float32), mesh.texture_of, mesh.textures,
        )  # fmt: skip
        column = 3 if -1e-3 < shift < 0 or 0.5 < shift < 1 else 0
        colour = np.array(colour_at(Surface.of(moved), 0, np.float32(0.3), np.float32(0.3), 0.0))
        np.testing.assert_allclose(colour * 255, texture[0, column], atol=0.01)


@pytest.mark.parametrize("shape", [(8, 8), (1, 1), (1, 16), (5, 7), (3, 100), (64, 32)])
def test_levels_halve_down_to_one_texel(shape, rng):
    texture = rng.integers(0, 256, (*shape, 3)).astype(np.uint8)
    surface = Surface.of(quad(texture))
    (levels,) = surface.levels
    assert levels[0].tolist() == [0, shape[1], shape[0]]
    assert levels[-1, 1:].tolist() == [1, 1]
    for (first, w, h), (following, w2, h2) in pairwise(levels.tolist()):
        assert following == first + w * h
        assert (w2, h2) == (max(1, w // 2), max(1, h // 2))
    assert len(surface.texels) == levels[-1, 0] + 1
    np.testing.assert_array_equal(surface.texels[: texture.size // 3], texture.reshape(-1, 3))
    # halves of odd sides weigh some texels twice
    off = 0.5 * len(levels) if all(n & (n - 1) == 0 for n in shape) else 8
    np.testing.assert_allclose(surface.texels[-1], texture.mean(axis=(0, 1)), atol=off)


def test_smaller_textures_repeat_their_last_level(rng):
    small, large = (rng.integers(0, 256, (n, n, 3)).astype(np.uint8) for n in (2, 16))
    mesh = quad(small)
    mesh = Mesh(
        mesh.vertices, mesh.triangles, mesh.object_of, mesh.colours, mesh.uv,
        np.array([0, 1], np.int32), (small, large),
    )  # fmt: skip
    surface = Surface.of(mesh)
    assert surface.levels.shape == (2, 5, 3)
    assert surface.levels[0].tolist() == [[0, 2, 2], [4, 1, 1], [4, 1, 1], [4, 1, 1], [4, 1, 1]]
    assert surface.levels[1, 0].tolist() == [5, 16, 16]
    # from however far, the small one is its own mean
    far = np.array(colour_at(surface, 0, np.float32(0.2), np.float32(0.2), np.float32(1e6)))
    np.testing.assert_allclose(far * 255, surface.texels[4], atol=0.01)


def test_texels_per_metre_of_the_denser_side(rng):
    texture = rng.integers(0, 256, (64, 64, 3))
    # 64 texels over 2 m and over 1 m: 64 a metre along the shorter side
    np.testing.assert_allclose(Surface.of(quad(texture)).texels_per_metre, 64, rtol=1e-5)
    np.testing.assert_allclose(Surface.of(quad(texture, uv=3)).texels_per_metre, 192, rtol=1e-5)
    flat = Surface.of(quad(np.full((1, 1, 3), 7), uv=0))
    assert flat.texels_per_metre.tolist() == [0, 0]


def test_triangles_without_area_have_a_density_that_is_a_number():
    mesh = quad(np.zeros((4, 4, 3)))
    vertices = mesh.vertices.copy()
    vertices[1] = vertices[0]
    vertices[2] = vertices[0]
    surface = Surface.of(
        Mesh(
            vertices, mesh.triangles, mesh.object_of, mesh.colours, mesh.uv, mesh.texture_of,
            mesh.textures,
        )
    )  # fmt: skip
    assert np.isfinite(surface.texels_per_metre).all()


def test_what_stands_for_more_sees_more():
    """A checkerboard is black and white near by, and grey where a ray stands for many squares."""
    board = np.zeros((64, 64, 3))
    board[np.add.outer(np.arange(64), np.arange(64)) % 2 == 0] = 255
    surface = Surface.of(quad(board, 1.0, 1.0))  # 64 texels a metre
    at = np.arange(20) % 2, np.linspace(0.1, 0.4, 20), np.linspace(0.5, 0.1, 20)
    near = looked_at(surface, *at, footprint=1 / 64)
    assert set(near.round(6).ravel().tolist()) == {0.0, 1.0}
    for footprint in (2 / 64, 1 / 8, 0.5, 3.0):
        np.testing.assert_allclose(looked_at(surface, *at, footprint), 0.5, atol=0.01)


def test_the_level_fits_the_footprint():
    """Half black, half white: a ray for a quarter of the wall sees one half, for all of it both."""
    board = np.zeros((64, 64, 3))
    board[:, 32:] = 255
    surface = Surface.of(quad(board, 1.0, 1.0))
    left = (np.array([1]), np.array([0.1]), np.array([0.7]))  # x = 0.1
    assert looked_at(surface, *left, 0.25).tolist() == [[0, 0, 0]]
    np.testing.assert_allclose(looked_at(surface, *left, 1.6), [[0.5, 0.5, 0.5]], atol=0.01)


def test_charts_of_an_atlas_are_not_mixed_from_afar(monkeypatch):
    """Two quads share a texture, one its red corner, one its blue: a far ray sees no violet."""
    monkeypatch.setattr("placegraph.indoor.map.surface.MANY", 4)
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
    mesh = Mesh(
        np.concatenate(quads).astype(np.float32), triangles.astype(np.int32), np.zeros(16, np.int32),
        np.full((32, 3), 255, np.uint8), np.concatenate(uv).astype(np.float32),
        np.zeros(16, np.int32), (texture,),
    )  # fmt: skip
    surface = Surface.of(mesh)
    third = np.array([1 / 3])
    for triangle, wanted in ((0, (250, 0, 0)), (2, (0, 0, 250))):
        seen = looked_at(surface, np.array([triangle]), third, third, footprint=100.0)
        np.testing.assert_allclose(255 * seen, [wanted], atol=2)
    whole = Surface.of(replace(mesh, uv=np.tile(corners, (8, 1))))
    assert (whole.levels[0, -1, 1:] == 1).all(), "one picture ends in one texel"


# --------------------------------------------------------------------------- opponents


def test_opponents_by_hand():
    got = opponent(np.float32(0.6), np.float32(0.3), np.float32(0.04))
    assert got == pytest.approx((0.94, 0.56, -0.04), abs=1e-6)
    grey = opponent(np.float32(0.5), np.float32(0.5), np.float32(0.5))
    assert grey == pytest.approx((1.5, 0, 0), abs=1e-6)


def test_a_dimmer_lamp_leaves_the_colour():
    bright = np.array(opponent(*np.array([0.8, 0.5, 0.2], np.float32)))
    dim = np.array(opponent(*np.array([0.4, 0.25, 0.1], np.float32)))
    assert dim[0] == pytest.approx(bright[0] / 2, abs=1e-6)
    np.testing.assert_allclose(dim[1:], bright[1:], rtol=0.05)
    assert abs(bright[1]) > 0.3
