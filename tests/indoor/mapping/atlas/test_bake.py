"""Tests."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import Camera
from placegraph.core.threads import limited
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.bake import bake, fill_unknown, pack
from placegraph.indoor.scene_map import SceneMap

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)


@pytest.fixture
def colour_of(field):
    return lambda points, *_: field(points)


def middles(mesh):
    """Colours (T, 3) in the middle of each triangle."""
    third = np.full(len(mesh), 1 / 3, np.float32)
    return mesh.colour_at(np.arange(len(mesh), dtype=np.int32), third, third)


def white(points, *_):
    return np.full(points.shape, 250, np.uint8)


def test_geometry_stays_and_charts_do_not_overlap(ball, room, sound, colour_of):
    for mesh in (ball, room.mesh):
        assert (sound(mesh, bake(mesh, colour_of, texel=0.06)) < 0).any()


def test_every_triangle_of_some_size_gets_texels(ball, sound, colour_of):
    area = sound(ball, bake(ball, colour_of, texel=0.02, tolerance=0))
    metres = np.linalg.norm(ball.normals(), axis=1)
    # twice the area on both sides; a chart's plane is at most 75 degrees off
    assert (-area >= 0.25 * metres / 0.02**2).all()
    assert (-area <= 1.01 * metres / 0.02**2).all()


def test_a_field_is_reproduced(ball, room, field, spots, colour_of, rng):
    for mesh, texel in ((ball, 0.01), (room.mesh, 0.04)):
        after = bake(mesh, colour_of, texel=texel, tolerance=0)
        row, u, v, at = spots(after, 5000, rng)
        off = np.abs(after.colour_at(row, u, v).astype(int) - field(at)).max(axis=1)
        # half a texel of the steepest wave is 7 of 255; at squares' edges it is 40
        assert np.median(off) <= 8 * texel / 0.01
        assert np.mean(off > 12 * texel / 0.01) < 0.1


def test_tolerance_bounds_the_error_and_saves_texels(ball, spots, rng):
    def waves(points, *_):
        return (128 + 70 * np.sin(points * (12.0, 9.0, 7.0))).astype(np.uint8)

    sizes = []
    for tolerance in (0.0, 2.0, 8.0):
        after = bake(ball, waves, texel=0.01, tolerance=tolerance)
        row, u, v, at = spots(after, 5000, rng)
        off = after.colour_at(row, u, v).astype(float) - waves(at)
        # the nearest texel speaks: its error beside that of looks between texels
        assert np.sqrt((off**2).mean()) < 3 + 3 * tolerance
        sizes.append(sum(t.size for t in after.textures))
    assert sizes[0] > sizes[1] > sizes[2]


def test_a_map_of_it_renders_the_field(room, field, colour_of):
    mesh = bake(room.mesh, colour_of, texel=0.02)
    graph = room.graph
    scene = SceneMap.create(mesh, graph.ids, graph.labels, floor=float(room.floors[0]))
    pose = np.eye(4)
    pose[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    pose[:3, 3] = *room.bounds.mean(axis=0)[:2], 1.5
    drawn = scene.render(pose, CAMERA)
    seen = drawn.mask
    off = np.abs(drawn.colour[seen].astype(int) - field(drawn.points[seen].astype(float)))
    assert seen.mean() > 0.9
    assert np.median(off) <= 6  # JPEG, and at most 5 by coarser charts
    assert np.mean(off.max(axis=1) > 45) < 0.05


def test_one_colour_costs_a_few_texels_and_no_vertex(ball):
    after = bake(ball, white)
    assert [t.shape for t in after.textures] == [(16, 16, 3)]
    assert len(after.vertices) == len(ball.vertices)
    assert (middles(after) == 250).all()


def test_one_spot_of_colour_keeps_its_surrounding_small(grid):
    mesh = Mesh.plain(*grid(40, 40))

    def poster(points, *_):
        on = (points[:, :2] > 0.2).all(axis=1) & (points[:, :2] < 0.6).all(axis=1)
        noise = np.random.default_rng(0).integers(0, 255, points.shape)
        return np.where(on[:, None], noise, 200).astype(np.uint8)

    after = bake(mesh, poster, texel=0.01)  # 400 x 400 texels if all were kept
    assert sum(t.shape[0] * t.shape[1] for t in after.textures) < 0.4 * 400 * 400


def test_the_unseen_looks_like_its_neighbours(grid):
    mesh = Mesh.plain(*grid(4, 1))
    colours = {0: (200, 10, 10), 1: (10, 10, 200)}

    def half(points, *_):
        right = points[:, 0] > 0.2
        return np.array([colours[int(r)] for r in right], np.uint8), np.abs(
            points[:, 0] - 0.2
        ) > 0.1

    after = bake(mesh, half, texel=0.01)
    got = middles(after)
    left = mesh.vertices[mesh.triangles].mean(axis=1)[:, 0] < 0.1
    right = mesh.vertices[mesh.triangles].mean(axis=1)[:, 0] > 0.3
    assert (np.abs(got[left].astype(int) - colours[0]) <= 6).all()
    assert (np.abs(got[right].astype(int) - colours[1]) <= 6).all()
    between = got[~left & ~right].astype(int)
    assert (np.abs(between[:, 0] + between[:, 2] - 210) <= 6).all()


def test_faces_never_seen_take_over_colours(boxes):
    model = boxes({"box": ((0, 0, 0), (1, 1, 1)), "far": ((3, 0, 0), (4, 1, 1))})
    mesh = Mesh.plain(model.vertices, model.triangles, model.thing_of)

    def top(points, normals, _):
        return np.full(points.shape, (90, 60, 30), np.uint8), (normals[:, 2] > 0.5) & (
            points[:, 0] < 2
        )

    after = bake(mesh, top)
    got = middles(after)
    assert (got == (90, 60, 30)).all()  # also an object that nobody saw


def test_nothing_known_at_all_is_grey(ball):
    after = bake(ball, lambda p, *_: (np.zeros(p.shape, np.uint8), np.zeros(len(p), bool)))
    assert {tuple(c) for t in after.textures for c in t.reshape(-1, 3)} == {(128, 128, 128)}


def test_strange_triangles(sound, colour_of):
    points = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1e-7, 0, 0], [300, 0, 0], [300, 1e-4, 0], [0, 300, 0]]
    )
    for rows in ([[0, 1, 2]], [[0, 0, 0]], [[0, 1, 1]], [[0, 3, 2]], [[0, 4, 5]], [[0, 4, 6]]):
        mesh = Mesh.plain(points, rows)
        after = bake(mesh, colour_of, largest=256, texel=0.05)
        sound(mesh, after)
        assert max(max(t.shape) for t in after.textures) <= 256
    empty = Mesh.plain(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert bake(empty, colour_of) is empty


@settings(max_examples=6)
@given(st.integers(0, 2**32), st.integers(1, 60), st.floats(0.02, 0.3))
def test_any_soup_is_laid_flat(sound, soup, field, seed, count, texel):
    rng = np.random.default_rng(seed)
    points, rows = soup(count, rng)
    mesh = Mesh.plain(points, rows, rng.integers(0, 3, count))
    after = bake(mesh, lambda p, *_: field(p), texel=texel, largest=128, tolerance=0)
    sound(mesh, after)
    assert all(max(t.shape) <= 128 for t in after.textures)


def test_a_surface_that_winds_over_itself(sound, colour_of):
    turn = np.linspace(0, 6 * np.pi, 160)  # a spiral stair: all normals nearly up
    inner, outer = (
        np.stack([r * np.cos(turn), r * np.sin(turn), 0.03 * turn], axis=1) for r in (0.3, 1.0)
    )
    a = np.arange(159)
    rows = np.concatenate(
        [np.stack([a, a + 160, a + 161], axis=1), np.stack([a, a + 161, a + 1], axis=1)]
    )
    mesh = Mesh.plain(np.concatenate([inner, outer]), rows)
    area = sound(mesh, bake(mesh, colour_of, texel=0.02, tolerance=0))
    assert (area < 0).all()


def test_fifty_thousand_triangles(grid, field, rng):
    points, rows = grid(160, 160, 0.02)
    points[:, 2] = rng.normal(0, 0.004, len(points))
    mesh = Mesh.plain(points, rows)
    after = bake(mesh, lambda p, *_: field(p), texel=0.04)
    assert (after.vertices[after.triangles] == mesh.vertices[mesh.triangles]).all()
    assert len(after.vertices) < 1.5 * len(mesh.vertices)


def test_the_same_again_on_any_number_of_threads(ball, colour_of):
    made = []
    for threads in (1, 2):
        with limited(threads):
            made.append(bake(ball, colour_of))
    assert (made[0].uv == made[1].uv).all()
    assert all((a == b).all() for a, b in zip(made[0].textures, made[1].textures, strict=True))


@pytest.mark.parametrize(
    "options", [{"texel": 0}, {"texel": np.nan}, {"margin": 0}, {"largest": 10}, {"tolerance": -1}]
)
def test_options_out_of_range(ball, colour_of, options):
    with pytest.raises(OptionError, match=next(iter(options))):
        bake(ball, colour_of, **options)


def test_colours_of_another_kind_are_refused(ball):
    with pytest.raises(OptionError, match="colour_of returned float64"):
        bake(ball, lambda p, *_: np.zeros(p.shape))


@given(st.lists(st.tuples(st.integers(1, 128), st.integers(1, 128)), min_size=1, max_size=60))
def test_rectangles_lie_on_pages_and_nowhere_twice(sizes):
    page, places, pages = pack(np.array(sizes), 128, np.arange(len(sizes)))
    taken = [np.zeros((h, w), int) for w, h in pages]
    for (w, h), k, (x, y) in zip(sizes, page, places, strict=True):
        assert x + w <= pages[k][0]
        assert y + h <= pages[k][1]
        taken[k][y : y + h, x : x + w] += 1
    assert max(t.max() for t in taken) == 1
    assert pages.max() <= 128
    assert all(t.any() for t in taken)


def test_many_rectangles_fill_their_page(rng):
    sizes = rng.integers(3, 40, (2000, 2))
    page, _, pages = pack(sizes, 2048, rng.random(2000))
    assert len(pages) == page.max() + 1 == 1
    assert sizes.prod(axis=1).sum() > 0.8 * pages[0].prod()


def test_what_lies_between_is_smooth():
    texels = np.zeros((37, 50, 3), np.uint8)
    known = np.zeros((37, 50), bool)
    texels[3:10, 4:9], known[3:10, 4:9] = (200, 100, 0), True
    texels[20:30, 40:45], known[20:30, 40:45] = (100, 200, 50), True
    out = fill_unknown(texels, known)
    assert (out[known] == texels[known]).all()
    assert (out.min(axis=(0, 1)) >= (100, 100, 0)).all()
    assert (out.max(axis=(0, 1)) <= (200, 200, 50)).all()
    assert np.abs(out[10, 4:9].astype(int) - (200, 100, 0)).max() < 20  # right beside it


def test_a_page_of_which_nothing_is_known_is_one_colour():
    out = fill_unknown(np.full((5, 8, 3), 9, np.uint8), np.zeros((5, 8), bool))
    assert len(np.unique(out.reshape(-1, 3), axis=0)) == 1
