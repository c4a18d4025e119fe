"""Fewer and more triangles of the same surface."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.errors import OptionError
from placegraph.evaluate.decimate import coarse, decimate, edges_of, fine, weld
from placegraph.indoor.mesh import Mesh


def sheet(n, size=2.0, height=lambda x, y: 0.0 * x * y):
    """Square of n x n quads over [0, size]^2."""
    x, y = (a.ravel() for a in np.meshgrid(*[np.linspace(0, size, n + 1)] * 2, indexing="ij"))
    points = np.stack([x, y, height(x, y)], axis=1)
    a = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).ravel()
    b, c, d = a + n + 1, a + n + 2, a + 1
    return points, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def ball(n):
    """Closed unit sphere: a cube's sides of n x n quads, pressed round."""
    points, triangles = [], []
    flat, faces = sheet(n)
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.roll(np.insert(flat - 1.0, 2, 0, axis=1)[:, :3], axis, axis=1)
            side[:, (axis + 2) % 3] = sign
            triangles.append((faces if sign > 0 else faces[:, ::-1]) + len(flat) * len(points))
            points.append(side)
    points = np.concatenate(points)
    return points / np.linalg.norm(points, axis=1, keepdims=True), np.concatenate(triangles)


def area(points, triangles):
    a, b, c = np.moveaxis(points[triangles].astype(float), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_a_flat_sheet_becomes_two_triangles_with_the_same_outline():
    points, triangles = sheet(12)
    vertices, left, _ = decimate(points, triangles, 2)
    assert len(left) == 2
    assert sorted(map(tuple, vertices.round(4).tolist())) == [
        (0, 0, 0), (0, 2, 0), (2, 0, 0), (2, 2, 0),
    ]  # fmt: skip
    assert area(vertices, left) == pytest.approx(4.0, abs=1e-5)


def test_a_ball_stays_round_closed_and_outside_out():
    points, triangles = ball(16)
    vertices, left, _ = decimate(points, triangles, 300)
    assert 298 <= len(left) <= 300
    assert np.linalg.norm(vertices, axis=1) == pytest.approx(1.0, abs=0.03)
    _, border = edges_of(left.astype(np.int64))
    assert (border < 0).all()
    a, b, c = np.moveaxis(vertices[left], 1, 0)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()
    assert area(vertices, left) == pytest.approx(4 * np.pi, rel=0.03)


@given(st.integers(0, 2**32 - 1), st.integers(20, 400))
def test_it_never_leaves_the_surface_nor_turns_over(seed, target):
    rng = np.random.default_rng(seed)
    bumps = rng.normal(size=3)
    points, triangles = sheet(14, height=lambda x, y: 0.1 * np.sin(bumps[0] * x + bumps[1] * y))
    vertices, left, _ = decimate(points, triangles, target)
    assert len(left) <= max(target, 4)
    assert (vertices >= points.min(axis=0) - 0.05).all()
    assert (vertices <= points.max(axis=0) + 0.05).all()
    a, b, c = np.moveaxis(vertices[left], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_objects_that_touch_stay_apart():
    points, triangles = sheet(10)
    owner = (points[triangles].mean(axis=1)[:, 0] > 1.0).astype(int)
    vertices, left, group = decimate(points, triangles, 4, owner)
    assert sorted(group.tolist()) == [0, 0, 1, 1]
    for row in (0, 1):
        assert area(vertices, left[group == row]) == pytest.approx(2.0, abs=1e-5)


def test_seams_are_closed_and_twins_dropped():
    points, triangles = sheet(3)
    loose = points[triangles.ravel()]  # every triangle with corners of its own
    corners = np.arange(len(loose)).reshape(-1, 3)
    welded, rows, owner = weld(loose, np.vstack([corners, corners[:2]]), np.zeros(20, int))
    assert (len(welded), len(rows), len(owner)) == (16, 18, 18)


def test_a_target_must_be_one_or_more():
    with pytest.raises(OptionError, match="at least 1"):
        decimate(*sheet(2), 0)


def test_coarse_meshes_are_painted_as_the_surface_is(rng):
    points, triangles = sheet(16)
    texture = np.zeros((1, 2, 3), np.uint8)
    texture[0, 0], texture[0, 1] = (200, 40, 0), (0, 40, 200)
    row = np.zeros(len(triangles), np.int32)
    uv = (points[:, :2] / 2.0 * 0.999).astype(np.float32)
    colours = np.full((len(points), 3), 255, np.uint8)
    textured = Mesh(
        points.astype(np.float32), triangles.astype(np.int32), row, colours, uv, row, (texture,)
    )
    mesh = coarse(textured, 60, rng)
    assert len(mesh) <= 60
    left = mesh.vertices[:, 0] < 0.5
    right = mesh.vertices[:, 0] > 1.5
    assert np.abs(mesh.colours[left].astype(int) - (200, 40, 0)).max() <= 1
    assert np.abs(mesh.colours[right].astype(int) - (0, 40, 200)).max() <= 1


def test_finer_meshes_are_the_same_surface():
    points, triangles = sheet(2)
    mesh = Mesh.plain(points, triangles, np.arange(8), np.full((9, 3), 90, np.uint8))
    cut = fine(mesh, 50)
    assert 50 <= len(cut) <= 52
    assert area(cut.vertices, cut.triangles) == pytest.approx(4.0, abs=1e-5)
    assert (cut.normals()[:, 2] > 0).all()
    assert (cut.colours == 90).all()
    shares = np.bincount(cut.object_of, np.linalg.norm(cut.normals(), axis=1) / 2)
    assert shares == pytest.approx(0.5, abs=1e-5)
