import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import (
    Camera,
    between,
    level_from_camera,
    pose_matrix,
    split_pose,
    wrap_angle,
)
from placegraph.io.capture.capture import open_capture
from placegraph_lab.worlds.flat.flat import Flat
from placegraph_lab.worlds.flat.render import Stage
from placegraph_lab.worlds.flat.walks import BODY, Walk, add_drift, stroll, write_walk

ROOM = """
[flat]
metres = 0.5
height = 2.5
[drawing]
######=#####
#    #   c #
#    #  TT #
#1   : 2TT #
#    #     #
####+#######
#  3 #
######
[legend]
1 room: walls=plaster tan
2 room: label=dining room
3 spot:
T table:
c chair: faces=T
"""
SMALL = Camera(96, 54, 69.0, 69.0, 48.0, 27.0)


@pytest.fixture(scope="module")
def flat():
    return Flat.parse(ROOM)


@pytest.fixture(scope="module")
def interior(flat):
    return flat.furnish(np.random.default_rng(1))


@pytest.fixture(scope="module")
def walk(flat):
    return stroll(flat, np.random.default_rng(2), frames=8, through="12")


@pytest.fixture(scope="module")
def folder(interior, walk, tmp_path_factory):
    folder = tmp_path_factory.mktemp("walk")
    return write_walk(interior, walk, folder, np.random.default_rng(3), camera=SMALL)


@pytest.fixture(scope="module")
def stage(interior):
    return Stage(interior, np.random.default_rng(4))


def level(x, y, z, yaw):
    return pose_matrix([x, y, z, yaw], level_from_camera([0.0, 1.0, 0.0]))


def test_a_walk_passes_its_places(flat):
    walk = stroll(flat, np.random.default_rng(0), frames=40, through="121", speed=1.0)
    at = walk.map_from_camera[:, :2, 3]
    first, second = (np.array(flat.position(g)) for g in "12")
    assert np.hypot(*(at[0] - first)) < 0.3
    assert np.hypot(*(at[-1] - first)) < 0.3
    assert np.hypot(*(at - second).T).min() < 0.4


@pytest.mark.parametrize("seed", range(2))
def test_a_walk_keeps_away_from_walls_and_furniture(seed):
    flat = Flat.load("altbau")
    walk = stroll(flat, np.random.default_rng(seed), frames=60)
    blocked = np.argwhere(flat.blocked)
    middles = np.array([flat.corner(r + 0.5, c + 0.5) for r, c in blocked])
    for x, y in walk.map_from_camera[:, :2, 3]:
        assert not flat.blocked[flat.cell(x, y)]
        assert np.hypot(*(middles - (x, y)).T).min() > BODY - 0.08


def test_depth_is_what_the_drawing_says(stage, interior):
    pose = level(1.5, 1.75, 1.25, np.pi)  # looks left, along -x
    geometry = stage.geometry(SMALL, pose)
    names = np.array([thing.label for thing in interior.objects])
    middle = geometry.depth[27, 48]
    assert middle == pytest.approx(1.0, abs=1e-4)
    wall = (names[geometry.ids] == "wall") & (np.abs(geometry.depth - 1.0) < 1e-3)
    assert wall.mean() > 0.3
    u, v = np.meshgrid(np.arange(96) + 0.5, np.arange(54) + 0.5)
    across, down = (u - 48) / 69, (v - 27) / 69
    # x right of the camera is north here: the room ends at y = 1.5 and 3.5; floor 1.25 m below
    sides = np.minimum(1.0, np.where(across > 0, 1.75, 0.25) / np.maximum(np.abs(across), 1e-9))
    expected = np.minimum(sides, 1.25 / np.maximum(np.abs(down), 1e-9))
    assert geometry.depth == pytest.approx(expected, abs=1e-3)
    assert (names[geometry.ids[geometry.depth < 0.99]] == "wall").any()


def test_a_capture_opens_with_all_it_has(folder, walk):
    capture = open_capture(folder)
    assert len(capture) == 8
    assert capture.stamps == pytest.approx(walk.stamps)
    assert (capture.camera.width, capture.depth_camera.width) == (96, 48)
    assert capture.label_kind == "instances"
    for frame in capture:
        assert frame.rgb().shape == (54, 96, 3)
        assert frame.depth().shape == frame.labels().shape == (27, 48)


def test_depth_and_instances_are_those_of_the_truth(folder, stage, walk):
    capture = open_capture(folder)
    for frame, pose in zip(capture, walk.map_from_camera, strict=True):
        geometry = stage.geometry(capture.depth_camera, pose)
        assert np.array_equal(frame.labels(), geometry.ids)
        depth = frame.depth()
        holes = np.isnan(depth)
        assert 0.01 < holes.mean() < 0.5
        error = np.abs(depth - geometry.depth)[~holes]
        assert 0.0003 < np.median(error) < 0.01
        assert np.quantile(error, 0.99) < 0.05


def test_odometry_begins_at_home_and_drifts_a_little(flat):
    walk = stroll(flat, np.random.default_rng(0), frames=400, through="12121212")
    odometry, tilt = split_pose(add_drift(walk.map_from_camera, np.random.default_rng(1)))
    truth, level_ = split_pose(walk.map_from_camera)
    assert odometry[0] == pytest.approx(np.zeros(4), abs=1e-12)
    assert tilt == pytest.approx(level_, abs=1e-9)
    steps, ours = (between(p[:-1], p[1:]) for p in (truth, odometry))
    lengths = np.linalg.norm(steps[:, :3], axis=1)
    error = (ours - steps)[:, :3] / lengths[:, None]
    assert np.std(error) == pytest.approx(0.01, rel=0.1)
    assert np.std(np.degrees(wrap_angle(ours - steps)[:, 3])) == pytest.approx(0.1, rel=0.15)


def test_a_changed_flat_is_seen_as_it_is_now(interior, tmp_path):
    chair = interior.find_object("chair")
    at = chair.bounds.mean(axis=0)
    walk = Walk(np.array([0.0]), level(at[0] - 1.2, at[1] - 0.3, 1.3, 0.0)[None])
    found = {}
    for name, now in {
        "before": interior,
        "moved": interior.move_object("chair", (0.2, -0.3)),
        "gone": interior.without("chair"),
    }.items():
        write_walk(now, walk, tmp_path / name, np.random.default_rng(0), camera=SMALL)
        picture = np.asarray(Image.open(tmp_path / name / "instances/000000.png"))
        found[name] = picture == chair.id + 1
    assert found["before"].any()
    assert found["moved"].any()
    assert not np.array_equal(found["moved"], found["before"])
    assert not found["gone"].any()
