import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.indoor.mapping.parts import lattice, sphere

from placegraph.core.geometry import Camera
from placegraph.core.threads import limit_threads
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.bake import bake
from placegraph.indoor.mapping.atlas.colours import (
    SharpestViews,
    frame_colours,
    group_keyframes,
    measure_sharpness,
    mesh_colours,
)
from placegraph.indoor.mapping.fuse import make_pinhole, read_view
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame


def grid(columns, rows, step=0.1):
    points, triangles = lattice(columns, rows)
    return np.insert(points * (columns * step, rows * step), 2, 0.0, axis=1), triangles


def soup(count, rng, size=0.2):
    corners = rng.uniform(-2, 2, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))
    corners[:-1:10] = corners[1::10]
    corners[7::20, 2] = corners[7::20, 1]
    corners[8::20, 2] = 0.5 * (corners[8::20, 1] + corners[8::20, 0])
    corners[9::20, 2] = corners[9::20, 1] + 1e-5
    return corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)


def inside(uv, size):
    corners = uv * size
    low = np.floor(corners.min(axis=0)).astype(int)
    high = np.ceil(corners.max(axis=0)).astype(int)
    x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
    texels = np.stack([x.ravel(), y.ravel()], axis=1)
    (ax, ay), b, c = corners[0], corners[1] - corners[0], corners[2] - corners[0]
    area = b[0] * c[1] - b[1] * c[0]
    if abs(area) < 1e-9:
        return texels[:0]
    px, py = texels[:, 0] + 0.5 - ax, texels[:, 1] + 0.5 - ay
    u, v = (px * c[1] - py * c[0]) / area, (b[0] * py - b[1] * px) / area
    return texels[(u > 1e-2) & (v > 1e-2) & (u + v < 1 - 1e-2)]


def sound(before, after):
    assert len(after) == len(before)
    assert (after.object_of == before.object_of).all()
    assert (after.vertices[after.triangles] == before.vertices[before.triangles]).all()
    assert (after.colours == 255).all()
    sizes = np.array([t.shape[1::-1] for t in after.textures])
    uv = after.uv[after.triangles] * sizes[after.texture_of][:, None]  # texels
    room = sizes[after.texture_of][:, None] - uv
    assert uv.min() >= 0.99
    assert room.min() >= 0.99  # a bilinear look never leaves the page
    b, c = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    area[np.abs(area) < 1e-4 * np.abs(uv).max()] = 0  # what float32 leaves of slivers
    assert not (area > 0).any()  # v is down: seen from outside, triangles turn the other way
    taken = [np.zeros(t.shape[:2], bool) for t in after.textures]
    for row in np.flatnonzero(area):
        page = after.texture_of[row]
        x, y = inside(after.uv[after.triangles[row]], sizes[page]).T
        assert not taken[page][y, x].any()
        taken[page][y, x] = True
    return area


def field(points):
    waves = 128 + 70 * np.sin(points * (12.0, 9.0, 7.0) + (0, 1, 2))
    squares = np.floor(points * 4 + 0.013).astype(int).sum(axis=1) % 2 * 40
    return np.clip(waves + squares[:, None], 0, 255).astype(np.uint8)


def everywhere(field):
    return lambda points, *_: (field(points), np.ones(len(points), bool))


def spots(mesh, count, rng):
    area = np.linalg.norm(mesh.normals(), axis=1)
    rows = rng.choice(len(mesh), count, p=area / area.sum()).astype(np.int32)
    uv = rng.random((count, 2))
    uv = np.where(uv.sum(axis=1, keepdims=True) > 1, 1 - uv, uv).astype(np.float32)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles[rows]].astype(float), 1, 0)
    return rows, uv[:, 0], uv[:, 1], a + uv[:, :1] * (b - a) + uv[:, 1:] * (c - a)


@pytest.fixture(scope="session")
def ball():
    points, rows = sphere(3)
    return Mesh.plain(points, rows, (np.arange(len(rows)) % 8 > 3).astype(int))


@pytest.fixture
def colour_of():
    return everywhere(field)


def middles(mesh):
    third = np.full(len(mesh), 1 / 3, np.float32)
    return mesh.colour_at(np.arange(len(mesh), dtype=np.int32), third, third)


def white(points):
    return np.full(points.shape, 250, np.uint8)


def test_every_triangle_of_some_size_gets_texels(ball, colour_of):
    area = sound(ball, bake(ball, colour_of, texel=0.02, tolerance=0))
    metres = np.linalg.norm(ball.normals(), axis=1)
    # twice the area on both sides; a chart's plane is at most 75 degrees off
    assert (-area >= 0.25 * metres / 0.02**2).all()
    assert (-area <= 1.01 * metres / 0.02**2).all()


def test_a_field_is_reproduced(ball, room, colour_of, rng):
    for mesh, texel in ((ball, 0.01), (room.mesh, 0.04)):
        after = bake(mesh, colour_of, texel=texel, tolerance=0)
        assert (sound(mesh, after) < 0).any()
        row, u, v, at = spots(after, 5000, rng)
        off = np.abs(after.colour_at(row, u, v).astype(int) - field(at)).max(axis=1)
        # half a texel of the steepest wave is 7 of 255; at squares' edges it is 40
        assert np.median(off) <= 8 * texel / 0.01
        assert np.mean(off > 12 * texel / 0.01) < 0.1


def test_tolerance_bounds_the_error_and_saves_texels(ball, rng):
    def waves(points):
        return (128 + 70 * np.sin(points * (12.0, 9.0, 7.0))).astype(np.uint8)

    sizes = []
    for tolerance in (0.0, 2.0, 8.0):
        after = bake(ball, everywhere(waves), texel=0.01, tolerance=tolerance)
        row, u, v, at = spots(after, 5000, rng)
        off = after.colour_at(row, u, v).astype(float) - waves(at)
        # the nearest texel speaks: its error beside that of looks between texels
        assert np.sqrt((off**2).mean()) < 3 + 3 * tolerance
        sizes.append(sum(t.size for t in after.textures))
    assert sizes[0] > sizes[1] > sizes[2]


def test_one_spot_of_colour_keeps_its_surrounding_small():
    mesh = Mesh.plain(*grid(40, 40))

    def poster(points):
        on = (points[:, :2] > 0.2).all(axis=1) & (points[:, :2] < 0.6).all(axis=1)
        noise = np.random.default_rng(0).integers(0, 255, points.shape)
        return np.where(on[:, None], noise, 200).astype(np.uint8)

    after = bake(mesh, everywhere(poster), texel=0.01)  # 400 x 400 texels if all were kept
    assert sum(t.shape[0] * t.shape[1] for t in after.textures) < 0.4 * 400 * 400


def test_the_unseen_looks_like_its_neighbours():
    mesh = Mesh.plain(*grid(4, 1))
    colours = {0: (200, 10, 10), 1: (10, 10, 200)}

    def half(points, *_):
        right = points[:, 0] > 0.2
        inside = np.abs(points[:, 0] - 0.2) > 0.1
        return np.array([colours[int(r)] for r in right], np.uint8), inside

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
    mesh = Mesh.plain(model.vertices, model.triangles, model.object_of)

    def top(points, normals, _):
        known = (normals[:, 2] > 0.5) & (points[:, 0] < 2)
        return np.full(points.shape, (90, 60, 30), np.uint8), known

    after = bake(mesh, top)
    got = middles(after)
    assert (got == (90, 60, 30)).all()  # also an object that nobody saw


def test_of_one_colour_or_none_known_a_few_texels_are_made(ball):
    after = bake(ball, everywhere(white))
    assert [t.shape for t in after.textures] == [(16, 16, 3)]
    assert len(after.vertices) == len(ball.vertices)
    assert (middles(after) == 250).all()
    after = bake(ball, lambda p, *_: (np.zeros(p.shape, np.uint8), np.zeros(len(p), bool)))
    assert {tuple(c) for t in after.textures for c in t.reshape(-1, 3)} == {(128, 128, 128)}


def test_strange_triangles(colour_of):
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
def test_any_soup_is_laid_flat(seed, count, texel):
    rng = np.random.default_rng(seed)
    points, rows = soup(count, rng)
    mesh = Mesh.plain(points, rows, rng.integers(0, 3, count))
    after = bake(mesh, everywhere(field), texel=texel, largest=128, tolerance=0)
    sound(mesh, after)
    assert all(max(t.shape) <= 128 for t in after.textures)


def test_the_same_again_on_any_number_of_threads(ball, colour_of):
    made = []
    for threads in (1, 2):
        with limit_threads(threads):
            made.append(bake(ball, colour_of))
    assert (made[0].uv == made[1].uv).all()
    assert all((a == b).all() for a, b in zip(made[0].textures, made[1].textures, strict=True))


PHONE = Camera(120, 90, 100.0, 100.0, 60.0, 45.0)
DOWN = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
"""Rotation map_from_camera of a camera that looks straight down."""


def above(x, y, height=1.5):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = DOWN, (x, y, height)
    return pose


def photograph(mesh, field, pose, camera=PHONE, *, gain=1.0, depth=True, blurred=False):
    v, u = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = camera.directions(np.stack([u, v], axis=-1)).reshape(-1, 3)
    along = rays @ pose[:3, :3].T
    far = RayCaster(mesh.vertices, mesh.triangles).cast(pose[:3, 3], along).distance.astype(float)
    hit = np.isfinite(far)
    colours = np.zeros((len(rays), 3))
    colours[hit] = field(pose[:3, 3] + far[hit, None] * along[hit])
    image = np.clip(np.rint(colours * gain), 0, 255).reshape(camera.height, camera.width, 3)
    if blurred:
        image = np.mean([np.roll(image, s, axis=1) for s in range(-4, 5)], axis=0)
    metres = far.reshape(camera.height, camera.width) if depth else None
    return Frame.from_arrays(image.astype(np.uint8), camera, depth=metres, odometry=pose)


def soft(points):
    return 90 + 50 * np.sin(points * (7.0, 8.0, 9.0) + (0, 1, 2))


@pytest.fixture
def floor():
    points, rows = grid(20, 20)  # 2 x 2 m
    return Mesh.plain(points, rows)


def asked(colour_of, points, normal=(0.0, 0.0, 1.0)):
    points = np.asarray(points, float)
    normals = np.repeat([normal], len(points), axis=0)
    return colour_of(points, normals, np.zeros(len(points), np.int64))


def inner(rng, count=300, low=0.4, high=1.6):
    return np.column_stack([rng.uniform(low, high, (count, 2)), np.zeros(count)])


def see(frames, poses):
    sharpest = SharpestViews(frames, poses)
    for row, (frame, pose) in enumerate(zip(frames, poses, strict=True)):
        sharpest.add(read_view(frame, row, pose, make_pinhole(frames[0].camera), 250.0))
    return sharpest.views


POSES = np.array([above(x, y) for x in (0.6, 1.0, 1.4) for y in (0.6, 1.0, 1.4)])


@pytest.mark.parametrize("depth", [True, False])
def test_a_floor_photographed_from_above(floor, rng, depth):
    frames = [photograph(floor, soft, p, depth=depth) for p in POSES]
    colour_of = frame_colours(see(frames, POSES), floor.vertices, floor.triangles)
    points, rise = inner(rng), np.array([0, 0, 1.0])
    colours, known = asked(colour_of, points)
    assert known.all()
    assert np.abs(colours - soft(points)).max() < 6
    assert not asked(colour_of, points, (0.0, 0.0, -1.0))[1].any()  # nobody saw it from below
    assert not asked(colour_of, points + rise)[1].any()  # all look right through it
    assert not asked(colour_of, points - rise)[1].any()  # the floor stands before it


def test_exposures_are_evened_out(floor, rng):
    gains = np.array([0.6, 1.0, 1.5, 0.8, 1.2, 1.0, 0.7, 1.4, 1.0])
    frames = [photograph(floor, soft, p, gain=g) for p, g in zip(POSES, gains, strict=True)]
    colour_of = frame_colours(see(frames, POSES), floor.vertices, floor.triangles)
    points = inner(rng)
    ratio = asked(colour_of, points)[0] / soft(points)
    # one exposure for all; which one, nobody can say
    assert np.abs(ratio / np.median(ratio, axis=0) - 1).max() < 0.08
    assert 0.85 < np.median(ratio) < 1.15


def test_what_stands_in_front_is_not_painted_on_what_lies_behind(floor, boxes, rng):
    model = boxes({"box": ((0.8, 0.8, 0.3), (1.2, 1.2, 0.5))})
    count = len(floor.vertices)
    both = Mesh.plain(
        np.concatenate([floor.vertices, model.vertices]),
        np.concatenate([floor.triangles, model.triangles + count]),
    )

    def field(points):
        return np.where(points[:, 2:] > 0.1, (250, 0, 0), soft(points))

    for mesh, depth in ((both, False), (floor, True)):  # by the mesh alone, and by depth alone
        frames = [photograph(both, field, p, depth=depth) for p in POSES]
        colour_of = frame_colours(see(frames, POSES), mesh.vertices, mesh.triangles)
        colours, known = asked(colour_of, inner(rng, 2000))
        assert 0.8 < known.mean() <= 1.0
        assert np.mean(colours[known][:, 1] < 20) < 0.01


def test_one_wrong_view_is_outvoted(floor, rng):
    frames = [photograph(floor, soft, p) for p in POSES]
    hand = np.array(frames[4].rgb())
    hand[30:60, 40:80] = (255, 0, 255)
    frames[4] = Frame.from_arrays(hand, PHONE, depth=frames[4].depth(), odometry=POSES[4])
    colour_of = frame_colours(see(frames, POSES), floor.vertices, floor.triangles)
    points = inner(rng, low=0.8, high=1.2)
    off = np.abs(asked(colour_of, points)[0] - soft(points)).max(axis=1)
    assert np.mean(off > 20) < 0.02


def test_of_one_place_the_sharpest_frame_is_kept(floor, rng):
    near = np.array([above(1.0 + s, 1.0) for s in (0.0, 0.01, 0.02)])
    frames = [photograph(floor, field, p, blurred=i != 1) for i, p in enumerate(near)]
    assert np.argmax([measure_sharpness(f.rgb()) for f in frames]) == 1
    assert group_keyframes(near, 10) == [[0, 1, 2]]
    strip = np.array([above(0.2 * i, 0.0) for i in range(100)])
    for most in (1, 7, 30, 100):
        groups = group_keyframes(strip, most)
        assert 0 < len(groups) <= most
        rows = list(itertools.chain(*groups))
        assert rows == sorted(rows)
    colour_of = frame_colours(see(frames, near), floor.vertices, floor.triangles)
    alone = frame_colours(see(frames[1:2], near[1:2]), floor.vertices, floor.triangles)
    points = inner(rng, low=0.8, high=1.2)
    assert (asked(colour_of, points)[0] == asked(alone, points)[0]).all()


def test_lenses_and_sizes(floor, rng):
    bent = replace(PHONE, distortion=(-0.2, 0.05, 0.001, -0.001))
    large = Camera(480, 360, 400.0, 400.0, 240.0, 180.0)
    frames = [photograph(floor, soft, p, (bent, large)[i % 2]) for i, p in enumerate(POSES[2:6])]
    colour_of = frame_colours(see(frames, POSES[2:6]), floor.vertices, floor.triangles)
    points = inner(rng, low=0.8, high=1.2)
    colours, known = asked(colour_of, points)
    assert known.all()
    assert np.abs(colours - soft(points)).max() < 8


def test_a_rendered_walk_gives_the_room_back(room, walk, truth, rng):
    mesh = room.mesh
    colour_of = frame_colours(see(list(walk), truth(walk)), mesh.vertices, mesh.triangles)
    row, u, v, at = spots(mesh, 5000, rng)
    colours, known = colour_of(at, room.normals[row].astype(float), row.astype(np.int64))
    assert known.mean() > 0.05  # of all faces, those inside furniture included
    want = mesh.colour_at(row, u, v)[known].astype(float)
    for channel in range(3):  # the walk has light of its own
        assert np.corrcoef(colours[known, channel], want[:, channel])[0, 1] > 0.65


UPWARD, DOWNWARD = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
NONE = np.zeros(1, np.int64)


def surface_colours(vertices, triangles, colours):
    return mesh_colours(Mesh.plain(vertices, triangles, colours=colours))


def waves(points):
    return (128 + 90 * np.sin(points * (8.0, 7.0, 6.0))).astype(np.uint8)


def test_few_triangles_carry_the_colours_of_many(rng):
    dense, rows = sphere(5)
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


def test_a_sheet_has_two_sides():
    points, rows = grid(4, 4)
    below = points - (0, 0, 0.01)
    colours = np.repeat([[200, 0, 0], [0, 0, 200]], len(points), axis=0)
    both, sides = np.concatenate([points, below]), [rows, rows[:, ::-1] + len(points)]
    colour_of = surface_colours(both, np.concatenate(sides), colours)
    for height in (0.02, 0.0, -0.002, -0.008, -0.01, -0.03):
        at = np.array([[0.21, 0.13, height]])
        assert colour_of(at, UPWARD, NONE)[0].tolist() == [[200, 0, 0]]
        assert colour_of(at, DOWNWARD, NONE)[0].tolist() == [[0, 0, 200]]


def test_beside_the_surface_the_nearest_corner_speaks_and_far_away_nobody():
    points, rows = grid(4, 4)
    colours = np.full(points.shape, 50, np.uint8)
    colours[0] = 90  # at the origin
    colour_of = surface_colours(points, rows, colours)
    at = np.array([[-0.05, -0.05, 0.0], [-0.05, 0.31, 0.05], [-0.3, 0.0, 0.0], [0.2, 0.2, 0.5]])
    got, known = colour_of(at, UPWARD.repeat(4, axis=0), NONE.repeat(4))
    assert known.tolist() == [True, True, False, False]
    assert got[:2].tolist() == [[90] * 3, [50] * 3]


def test_textures_are_carried_over(room, rng):
    colour_of = mesh_colours(room.mesh)
    after = bake(room.mesh, colour_of, texel=0.02)
    row, u, v, _ = spots(room.mesh, 5000, rng)
    off = np.abs(after.colour_at(row, u, v).astype(int) - room.mesh.colour_at(row, u, v))
    assert np.median(off.max(axis=1)) <= 8
    assert np.mean(off.max(axis=1) > 60) < 0.05
    with pytest.raises(OptionError, match="triangle"):
        surface_colours(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8))
