from collections import Counter

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.indoor.mapping.parts import lattice

from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.simplify import build_wedges, cut_tiles, simplify


def sheet(n, size=2.0, height=lambda x, y: 0.0 * x * y):
    points, triangles = lattice(n, n)
    return np.column_stack([size * points, height(*(size * points).T)]), triangles


def ball(n):
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


def plain(points, triangles, **more):
    return Mesh.plain(np.asarray(points, np.float32), triangles, **more)


def outline(mesh):
    place = {tuple(p): i for i, p in enumerate(np.round(mesh.vertices, 4).tolist())}
    rows = [place[tuple(p)] for p in np.round(mesh.vertices, 4).tolist()]
    triangles = np.array(rows)[mesh.triangles]
    edges = Counter(map(tuple, np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)).tolist()))
    return [e for e, n in edges.items() if n == 1]


def test_a_flat_sheet_becomes_two_triangles_with_the_same_outline():
    mesh = simplify(plain(*sheet(12)), error=0.0)
    assert len(mesh) == 2
    corners = sorted(map(tuple, mesh.vertices.round(4).tolist()))
    assert corners == [(0, 0, 0), (0, 2, 0), (2, 0, 0), (2, 2, 0)]
    assert area(mesh.vertices, mesh.triangles) == pytest.approx(4.0, abs=1e-5)


def test_a_ball_stays_round_closed_and_outside_out():
    mesh = simplify(plain(*ball(16)), error=np.inf, target=300)
    assert 298 <= len(mesh) <= 300
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(1.0, abs=0.03)
    assert not outline(mesh)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) > 0).all()
    assert area(mesh.vertices, mesh.triangles) == pytest.approx(4 * np.pi, rel=0.03)


@pytest.mark.parametrize("error", [0.003, 0.01, 0.05])
def test_the_bound_holds_and_is_used(error):
    fine = plain(*ball(24))
    mesh = simplify(fine, error=error)
    reach = np.linalg.norm(mesh.vertices, axis=1)
    # planes that touch the ball are at most as far as the bound, and its own facets a bit inside
    assert 1.0 - error - 0.01 <= reach.min() <= reach.max() <= 1.0 + error + 0.01
    middles = mesh.vertices[mesh.triangles].mean(axis=1)
    assert np.linalg.norm(middles, axis=1).min() > 1.0 - 4.0 * error - 0.01
    assert len(mesh) < len(fine) * (0.6 if error < 0.005 else 0.3)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.1))
def test_it_never_leaves_the_surface_nor_turns_over(seed, error):
    rng = np.random.default_rng(seed)
    bumps = rng.normal(size=3)

    def height(x, y):
        return 0.1 * np.sin(bumps[0] * x + bumps[1] * y)

    points, triangles = sheet(14, height=height)
    mesh = simplify(plain(points, triangles), error=error)
    x, y, z = mesh.vertices.astype(float).T
    steep = np.sqrt(1 + (0.1 * np.hypot(*bumps[:2])) ** 2)
    chord = 0.1 * (2.0 / 14) ** 2 * (bumps[:2] ** 2).sum() / 4  # what facets cut off
    assert np.abs(z - height(x, y)).max() <= steep * (error + chord + 1e-3)
    assert (mesh.vertices[:, :2] >= -error - 1e-3).all()
    assert (mesh.vertices[:, :2] <= 2 + error + 1e-3).all()
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


def test_objects_that_touch_stay_apart():
    points, triangles = sheet(10)
    owner = (points[triangles].mean(axis=1)[:, 0] > 1.0).astype(int)
    mesh = simplify(plain(points, triangles, object_of=owner), error=0.0)
    assert sorted(mesh.object_of.tolist()) == [0, 0, 1, 1]
    for row in (0, 1):
        assert area(mesh.vertices, mesh.triangles[mesh.object_of == row]) == pytest.approx(2.0)


def test_an_object_never_vanishes():
    points, triangles = ball(3)
    mesh = simplify(plain(points * 0.001, triangles), error=10.0)
    assert 4 <= len(mesh) <= 8


def test_seams_are_closed_and_twins_dropped():
    points, triangles = sheet(3)
    loose = points[triangles.ravel()]  # every triangle with corners of its own
    corners = np.arange(len(loose)).reshape(-1, 3)
    told = {}
    mesh = simplify(plain(loose, np.vstack([corners, corners[:2]])), error=0.0, left_out=told)
    assert len(mesh) == 2
    assert told == {"triangles twice in one place": 2}


def textured(points, triangles, uv, texture_of=None, count=1):
    rows = np.zeros(len(triangles), np.int32)
    return Mesh(
        np.asarray(points, np.float32), np.asarray(triangles, np.int32), rows,
        np.full((len(points), 3), 255, np.uint8), np.asarray(uv, np.float32),
        rows if texture_of is None else np.asarray(texture_of, np.int32),
        (np.zeros((4, 4, 3), np.uint8),) * count,
    )  # fmt: skip


@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_an_even_texture_stays_where_it_was(turn):
    points, triangles = sheet(12)
    spin = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    mesh = simplify(textured(points, triangles, points[:, :2] @ spin * 0.5 + 3), error=0.0)
    assert len(mesh) == 2
    np.testing.assert_allclose(mesh.uv, mesh.vertices[:, :2] @ spin * 0.5 + 3, atol=1e-5)


def test_a_seam_stays_and_both_sides_keep_their_texture():
    points, triangles = sheet(12)
    right = points[triangles].mean(axis=1)[:, 0] > 1.0
    # the right half has vertices of its own, with coordinates that jump
    twice = np.concatenate([points, points])
    corners = np.where(right[:, None], triangles + len(points), triangles)
    uv = np.concatenate([points[:, :2], 7.0 - 2.0 * points[:, :2]])
    mesh = simplify(textured(twice, corners, uv), error=0.01)
    assert len(mesh) == 4
    assert not [e for e in outline(mesh) if np.allclose(mesh.vertices[list(e), 0], 1.0)], "no crack"
    for triangle in mesh.triangles:
        at, uv = mesh.vertices[triangle][:, :2], mesh.uv[triangle]
        wanted = at if at.mean(axis=0)[0] < 1.0 else 7.0 - 2.0 * at
        np.testing.assert_allclose(uv, wanted, atol=1e-4)


def test_materials_keep_their_border():
    points, triangles = sheet(12)
    inner = (np.abs(points[triangles].mean(axis=1)[:, :2] - 1.0) < 0.5).all(axis=1)
    mesh = simplify(
        textured(points, triangles, 0 * points[:, :2], inner.astype(int), 2), error=0.01
    )
    own = mesh.triangles[mesh.texture_of == 1]
    assert area(mesh.vertices, own) == pytest.approx(1.0, abs=1e-4)
    assert area(mesh.vertices, mesh.triangles) == pytest.approx(4.0, abs=1e-4)
    assert len(mesh) <= 12


def test_a_texture_that_bends_is_not_dragged_along():
    points, triangles = sheet(16)
    uv = np.column_stack([points[:, 0] ** 2, points[:, 1]])
    error = 0.01
    mesh = simplify(textured(points, triangles, uv), error=error)
    # where a vertex is now, its own texture coordinate belongs within the slide
    slide = np.abs(np.sqrt(np.maximum(mesh.uv[:, 0], 0)) - mesh.vertices[:, 0])
    assert slide.max() < 0.06
    assert 2 < len(mesh) < len(triangles)


def test_colours_of_vertices_change_no_more_than_allowed():
    points, triangles = sheet(16)
    colours = np.full((len(points), 3), 100, np.uint8)
    colours[points[:, 0] > 1.0] = 200
    mesh = simplify(plain(points, triangles, colours=colours), error=0.01, colour=0.1)
    assert 2 < len(mesh) < 120
    far = np.abs(mesh.vertices[:, 0] - 1.0) > 0.2
    wanted = np.where(mesh.vertices[far, 0] > 1.0, 200, 100)
    assert np.abs(mesh.colours[far, 0] - wanted).max() <= 27


def test_order_of_triangles_does_not_matter_much(rng):
    points, triangles = ball(10)
    one = simplify(plain(points, triangles), error=0.02)
    other = simplify(plain(points, triangles[rng.permutation(len(triangles))]), error=0.02)
    assert len(one) == pytest.approx(len(other), rel=0.1)
    again = simplify(plain(points, triangles), error=0.02)
    np.testing.assert_array_equal(one.vertices, again.vertices)
    np.testing.assert_array_equal(one.triangles, again.triangles)


def test_a_soup_of_any_triangles_is_survived(rng):
    points = rng.integers(0, 4, (40, 3)) * 0.25
    triangles = rng.integers(0, 40, (300, 3))
    mesh = simplify(plain(points, triangles, object_of=rng.integers(0, 3, 300)), error=0.1)
    assert 0 < len(mesh) <= 300
    assert np.isfinite(mesh.vertices).all()
    reach = mesh.vertices.min(), mesh.vertices.max()
    assert -0.2 < reach[0] <= reach[1] < 0.95


def test_large_objects_are_simplified_in_tiles_without_cracks(monkeypatch):
    monkeypatch.setattr("placegraph.indoor.mapping.simplify.TILE", 300)
    points, triangles = ball(16)
    whole = build_wedges(plain(points, triangles))[0]
    parts = cut_tiles(whole, np.arange(len(triangles)))
    assert sorted(np.concatenate(parts).tolist()) == list(range(len(triangles)))
    assert 11 <= len(parts) <= 16
    assert max(map(len, parts)) <= 300
    mesh = simplify(plain(points, triangles), error=0.02)
    assert len(mesh) < 0.4 * len(triangles)
    assert not outline(mesh), "no crack"
    reach = np.linalg.norm(mesh.vertices, axis=1)
    assert 0.975 <= reach.min() <= reach.max() <= 1.025
    flat = simplify(plain(*sheet(13)), error=0.0)
    assert len(flat) <= 8, "tiles leave no trace"


def test_nothing_and_lines_stay_as_they_are():
    assert len(simplify(plain(np.zeros((0, 3)), np.zeros((0, 3), int)), error=0.1)) == 0
    points = np.array([[0, 0, 0], [1, 0, 0]])
    assert len(simplify(plain(points, [[0, 1, 1], [0, 0, 1]]), error=0.01)) == 2
