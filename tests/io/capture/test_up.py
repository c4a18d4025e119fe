import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, level_from_camera, rotation_from_vector, rotation_z
from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.up import estimated_up, surface_normals, upright

NONE = np.zeros((0, 3))


def shaken(normals, rng, by=0.01):
    normals = normals + by * rng.standard_normal(normals.shape)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


VECTORS = st.tuples(*[st.floats(-2, 2)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


def cameras(yaws, down=0.3, roll=0.0):
    gravity = [np.sin(roll), np.cos(down), np.sin(down)]
    return rotation_z(np.asarray(yaws)) @ level_from_camera(gravity)


def degrees(up, tilt):
    return np.degrees(np.arccos(np.clip(up @ tilt[:, 2], -1, 1)))


@given(VECTORS)
def test_cameras_that_look_several_ways(vector):
    tilt = rotation_from_vector(vector)
    up, how = estimated_up(tilt @ cameras([0.0, 0.4, 1.2, 1.9]), NONE)
    assert degrees(up, tilt) < 1e-4
    assert "x axes" in how


@given(VECTORS, st.integers(0, 99))
def test_level_surfaces_say_it_exactly(vector, seed):
    rng = np.random.default_rng(seed)
    tilt = rotation_from_vector(vector)
    floor = np.tile([0.0, 0.0, 1.0], (300, 1)) * rng.choice([-1, 1], (300, 1))
    walls = np.tile([1.0, 0.0, 0.0], (900, 1))
    noisy = shaken(np.concatenate([floor, walls]), rng, 0.02)
    up, how = estimated_up(tilt @ cameras([0.0, 0.05], roll=0.05), noisy @ tilt.T)
    assert degrees(up, tilt) < 0.5
    assert "surfaces" in how


def test_no_common_up():
    with pytest.raises(InputError, match="no common up"):
        estimated_up(np.stack([np.eye(3), np.diag([1.0, -1, -1])]), NONE)


def test_normals_of_a_plane():
    camera = Camera(80, 60, 80.0, 80.0, 40.0, 30.0)
    normal = np.array([0.2, -0.9, -0.4]) / np.linalg.norm([0.2, -0.9, -0.4])
    v, u = np.mgrid[:60, :80]
    rays = camera.directions(np.stack([u + 0.5, v + 0.5], axis=-1))
    with np.errstate(divide="ignore"):
        depth = -1.5 / (rays @ normal)
    depth[(depth < 0) | (depth > 20)] = np.nan
    found = surface_normals(depth.astype("f4"), camera)
    assert len(found) > 200
    np.testing.assert_allclose(np.abs(found @ normal), 1.0, atol=1e-4)


CAMERA = Camera(320, 180, 230.0, 230.0, 160.0, 90.0)
ROOM = np.array([[-3.0, -2.5, -1.4], [3.5, 4.0, 1.2]])
"""Low and high corner [m] of a room, as seen from the origin."""


def room_depth(rotation, rng, box=ROOM):
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = CAMERA.directions(np.stack([u + 0.5, v + 0.5], axis=-1)) @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(rays > 0, box[1] / rays, box[0] / rays).min(axis=-1)
    z += (0.0012 + 0.0019 * (z - 0.4) ** 2) * rng.standard_normal(z.shape)
    z[rng.random(z.shape) < 0.02] = np.nan
    return (np.round(z * 1000) / 1000).astype("f4")


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.3), st.floats(-0.08, 0.08))
def test_the_noise_of_a_sensor(seed, down, roll):
    rng = np.random.default_rng(seed)
    tilt = rotation_from_vector(rng.standard_normal(3))
    turns = cameras(rng.uniform(0, 6, 6), down, roll)
    seen = [surface_normals(room_depth(turn, rng), CAMERA) @ turn.T for turn in turns]
    up, how = estimated_up(tilt @ turns, np.concatenate(seen) @ tilt.T)
    assert degrees(up, tilt) < 0.5
    assert "surfaces" in how


def test_the_level_of_many_beats_a_ramp_of_more():
    rng = np.random.default_rng(2)
    ramp = rotation_from_vector([np.radians(8), 0, 0]) @ [0, 0, 1.0]
    parts = [(200, [0, 0, 1.0]), (300, ramp), (400, [1.0, 0, 0]), (400, [0, 1.0, 0])]
    normals = shaken(np.concatenate([np.tile(n, (count, 1)) for count, n in parts]), rng)
    up, how = estimated_up(cameras([0.0, 0.05], 0.1), normals)
    assert degrees(up, np.eye(3)) < 0.3
    assert "surfaces" in how


def test_walls_alone_tell_it_but_not_one():
    rng = np.random.default_rng(4)
    walls = shaken(np.repeat([[1.0, 0, 0], [0.6, 0.8, 0]], 100, axis=0), rng)
    up, how = estimated_up(cameras([0.0, 0.05]), walls)
    assert degrees(up, np.eye(3)) < 0.3
    assert "surfaces" in how


def test_where_surfaces_tell_nothing_the_cameras_word_stands():
    rng = np.random.default_rng(3)
    normals = shaken(np.zeros((5000, 3)), rng, 1.0)
    up, how = estimated_up(cameras([0.0, 0.4, 1.2, 1.9]), normals)
    assert degrees(up, np.eye(3)) < 1e-4
    assert "x axes" in how
    for wall in (NONE, np.tile([1.0, 0, 0], (100, 1))):
        up, how = estimated_up(cameras([0.0, 0.05]), wall)
        assert degrees(up, np.eye(3)) == pytest.approx(np.degrees(0.3), abs=0.5)
        assert "mean up direction" in how


def test_edges_and_holes_are_no_surfaces():
    depth = np.full((180, 320), 2.0, "f4")
    depth[:, 8::16] = 2.6
    assert not len(surface_normals(depth, CAMERA))
    assert not len(surface_normals(np.full((180, 320), np.nan, "f4"), CAMERA))
    assert not len(surface_normals(np.zeros((180, 320), "f4"), CAMERA))


@pytest.mark.parametrize("row", [0, 3, 6])
def test_the_house(shared, row):
    capture = open_capture(shared / f"data/house/seq0{row}", poses="trajectory")
    check(capture.frames, 0.2)


def test_the_office(shared):
    check(open_capture(shared / "data/office", poses="trajectory").frames[::9], 0.5)


def check(frames, most):
    turns = np.stack([frame.odometry[:3, :3] for frame in frames])
    seen = [
        surface_normals(frame.depth(), frame.depth_camera) @ turn.T
        for frame, turn in zip(frames, turns, strict=True)
    ]
    up, how = estimated_up(turns, np.concatenate(seen))
    assert degrees(up, np.eye(3)) < most
    assert "surfaces" in how


@given(VECTORS, VECTORS)
def test_upright(up, ahead):
    up = np.array(up) / np.linalg.norm(up)
    turn = upright(up, np.array(ahead))
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(turn @ up, [0, 0, 1], atol=1e-9)
    assert np.linalg.det(turn) > 0
