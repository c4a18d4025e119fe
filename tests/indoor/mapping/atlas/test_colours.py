"""Tests."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.mapping.atlas.bake import bake
from placegraph.indoor.mapping.atlas.colours import (
    frame_colours,
    group_keyframes,
    measure_sharpness,
    mesh_colours,
)
from placegraph.indoor.rays import RayCaster
from placegraph.io.capture.frame import Frame

CAMERA = Camera(120, 90, 100.0, 100.0, 60.0, 45.0)
DOWN = np.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
"""Rotation map_from_camera of a camera that looks straight down."""


def above(x, y, height=1.5):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = DOWN, (x, y, height)
    return pose


def photograph(mesh, field, pose, camera=CAMERA, *, gain=1.0, depth=True, blurred=False):
    """Frame of a mesh painted by `field`, taken from a pose, by ray casting."""
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
    """Colours from 40 to 140, so that a longer exposure does not saturate."""
    return 90 + 50 * np.sin(points * (7.0, 8.0, 9.0) + (0, 1, 2))


@pytest.fixture
def floor(grid):
    points, rows = grid(20, 20)  # 2 x 2 m
    return Mesh.plain(points, rows)


def asked(colour_of, points, normal=(0.0, 0.0, 1.0)):
    points = np.asarray(points, float)
    normals = np.repeat([normal], len(points), axis=0)
    return colour_of(points, normals, np.zeros(len(points), np.int64))


def inner(rng, count=300, low=0.4, high=1.6):
    return np.column_stack([rng.uniform(low, high, (count, 2)), np.zeros(count)])


POSES = np.array([above(x, y) for x in (0.6, 1.0, 1.4) for y in (0.6, 1.0, 1.4)])


@pytest.mark.parametrize("depth", [True, False])
def test_a_floor_photographed_from_above(floor, rng, depth):
    frames = [photograph(floor, soft, p, depth=depth) for p in POSES]
    colour_of = frame_colours(frames, POSES, floor.vertices, floor.triangles, texel=0.01)
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
    colour_of = frame_colours(frames, POSES, floor.vertices, floor.triangles)
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
        colour_of = frame_colours(frames, POSES, mesh.vertices, mesh.triangles)
        colours, known = asked(colour_of, inner(rng, 2000))
        assert 0.8 < known.mean() <= 1.0
        assert np.mean(colours[known][:, 1] < 20) < 0.01


def test_one_wrong_view_is_outvoted(floor, rng):
    frames = [photograph(floor, soft, p) for p in POSES]
    hand = np.array(frames[4].rgb())
    hand[30:60, 40:80] = (255, 0, 255)
    frames[4] = Frame.from_arrays(hand, CAMERA, depth=frames[4].depth(), odometry=POSES[4])
    colour_of = frame_colours(frames, POSES, floor.vertices, floor.triangles)
    points = inner(rng, low=0.8, high=1.2)
    off = np.abs(asked(colour_of, points)[0] - soft(points)).max(axis=1)
    assert np.mean(off > 20) < 0.02


def test_of_one_place_the_sharpest_frame_is_kept(floor, field, rng):
    near = np.array([above(1.0 + s, 1.0) for s in (0.0, 0.01, 0.02)])
    frames = [photograph(floor, field, p, blurred=i != 1) for i, p in enumerate(near)]
    assert np.argmax([measure_sharpness(f.rgb()) for f in frames]) == 1
    assert group_keyframes(near, 10) == [[0, 1, 2]]
    colour_of = frame_colours(frames, near, floor.vertices, floor.triangles)
    alone = frame_colours(frames[1:2], near[1:2], floor.vertices, floor.triangles)
    points = inner(rng, low=0.8, high=1.2)
    assert (asked(colour_of, points)[0] == asked(alone, points)[0]).all()


def test_keyframes_are_few_enough_and_in_order():
    walk = np.array([above(0.2 * i, 0.0) for i in range(100)])
    assert [g[0] for g in group_keyframes(walk, 100)] == list(range(100))
    for most in (1, 7, 30):
        groups = group_keyframes(walk, most)
        assert 0 < len(groups) <= most
        rows = list(itertools.chain(*groups))
        assert rows == sorted(rows)
    turning = np.repeat(np.eye(4)[None], 12, axis=0)
    for i, pose in enumerate(turning):
        angle = np.radians(30 * i)
        pose[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    assert len(group_keyframes(turning, 100)) == 12
    assert len(group_keyframes(walk * np.array([1e7, 1, 1, 1])[:, None] ** [0, 0, 0, 1], 3)) == 3


def test_lenses_and_sizes(floor, rng):
    bent = replace(CAMERA, distortion=(-0.2, 0.05, 0.001, -0.001))
    large = Camera(1200, 900, 1000.0, 1000.0, 600.0, 450.0)
    frames = [photograph(floor, soft, p, (bent, large)[i % 2]) for i, p in enumerate(POSES[2:6])]
    colour_of = frame_colours(frames, POSES[2:6], floor.vertices, floor.triangles, texel=0.02)
    points = inner(rng, low=0.8, high=1.2)
    colours, known = asked(colour_of, points)
    assert known.all()
    assert np.abs(colours - soft(points)).max() < 8


def test_a_rendered_walk_gives_the_room_back(room, walk, truth, spots, rng):
    told = []
    mesh = room.mesh
    colour_of = frame_colours(
        list(walk), truth(walk), mesh.vertices, mesh.triangles, progress=lambda *n: told.append(n)
    )
    assert told[-1] == (len(walk), len(walk))
    row, u, v, at = spots(mesh, 5000, rng)
    colours, known = colour_of(at, room.normals[row].astype(float), row.astype(np.int64))
    assert known.mean() > 0.05  # of all faces, those inside furniture included
    want = mesh.colour_at(row, u, v)[known].astype(float)
    for channel in range(3):  # the walk has light of its own
        assert np.corrcoef(colours[known, channel], want[:, channel])[0, 1] > 0.65


@pytest.mark.parametrize(
    ("options", "word"), [({"texel": 0}, "texel"), ({"views": 0}, "views"), ({}, "poses")]
)
def test_what_is_refused(floor, options, word):
    poses = POSES[:1] if options else POSES[:2]
    frames = [photograph(floor, soft, POSES[0])]
    with pytest.raises(OptionError, match=word):
        frame_colours(frames, poses, floor.vertices, floor.triangles, **options)
    with pytest.raises(OptionError, match="poses"):
        frame_colours([], np.zeros((0, 4, 4)), floor.vertices, floor.triangles)


UPWARD, DOWNWARD = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
NONE = np.zeros(1, np.int64)


def surface_colours(vertices, triangles, colours, **options):
    return mesh_colours(Mesh.plain(vertices, triangles, colours=colours), **options)


def waves(points):
    return (128 + 90 * np.sin(points * (8.0, 7.0, 6.0))).astype(np.uint8)


def test_few_triangles_carry_the_colours_of_many(sphere, spots, rng):
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
        assert colour_of(at, UPWARD, NONE)[0].tolist() == [[200, 0, 0]]
        assert colour_of(at, DOWNWARD, NONE)[0].tolist() == [[0, 0, 200]]


def test_beside_the_surface_the_nearest_corner_speaks_and_far_away_nobody(grid):
    points, rows = grid(4, 4)
    colours = np.full(points.shape, 50, np.uint8)
    colours[0] = 90  # at the origin
    colour_of = surface_colours(points, rows, colours, reach=0.1)
    at = np.array([[-0.05, -0.05, 0.0], [-0.05, 0.31, 0.05], [-0.3, 0.0, 0.0], [0.2, 0.2, 0.5]])
    got, known = colour_of(at, UPWARD.repeat(4, axis=0), NONE.repeat(4))
    assert known.tolist() == [True, True, False, False]
    assert got[:2].tolist() == [[90] * 3, [50] * 3]


def test_textures_are_carried_over(room, spots, rng):
    colour_of = mesh_colours(room.mesh, texel=0.02)
    after = bake(room.mesh, colour_of, texel=0.02)
    row, u, v, _ = spots(room.mesh, 5000, rng)
    off = np.abs(after.colour_at(row, u, v).astype(int) - room.mesh.colour_at(row, u, v))
    assert np.median(off.max(axis=1)) <= 8
    assert np.mean(off.max(axis=1) > 60) < 0.05


def test_options(room):
    with pytest.raises(OptionError, match="reach is 0"):
        mesh_colours(room.mesh, reach=0)
    with pytest.raises(OptionError, match="triangle"):
        surface_colours(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3), np.uint8))
