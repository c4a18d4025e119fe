"""A pose is saved, and found again by whoever loads it; what is no such file is named."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.core.mapfile import read_map, write_map
from placegraph.errors import InputError, MapError, OptionError
from placegraph.indoor.track.live import KIND, VERSION, LiveTracker, SavedPose

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def saved(room, film, tmp_path_factory):
    """File of a tracker that knew where it was at the sixth frame, and its pose."""
    live = room.live(film.camera, background=False)
    for frame in film[:6]:
        live.move(frame.stamp, frame.odometry)
        pose = live.step(frame)
    path = tmp_path_factory.mktemp("saved") / "robot.track"
    live.save(path)
    return path, pose


def test_odometry_goes_on(saved, room, film, truth):
    path, pose = saved
    live = LiveTracker.load(path, room, background=False)
    loaded = live.pose()
    assert loaded.status is Status.AMBIGUOUS
    np.testing.assert_allclose(loaded.map_from_camera, pose.map_from_camera)
    np.testing.assert_allclose(loaded.map_from_odom, pose.map_from_odom)
    np.testing.assert_allclose(loaded.covariance, pose.covariance)
    moved = live.move(film[8].stamp, film[8].odometry)
    np.testing.assert_allclose(moved.map_from_odom, pose.map_from_odom)
    after = live.step(film[8])
    assert after.status is Status.OK
    assert np.linalg.norm(after.map_from_camera[:3, 3] - truth(film)[8][:3, 3]) < 0.2


def test_odometry_begins_anew(saved, room, film, truth):
    """A robot that was switched off, and where: its clock and its odometry are others."""
    live = LiveTracker.load(saved[0], room, background=False)
    first = live.move(0.0, np.eye(4))
    assert first.status is Status.AMBIGUOUS
    assert np.linalg.norm(first.map_from_camera[:3, 3] - truth(film)[5][:3, 3]) < 0.2
    after = live.step(replace(film[5], stamp=0.0))
    assert after.status is Status.OK
    assert np.linalg.norm(after.map_from_camera[:3, 3] - truth(film)[5][:3, 3]) < 0.2


def test_what_cannot_be_saved_or_loaded(saved, room, flat, tmp_path):
    path, _ = saved
    with pytest.raises(OptionError, match="no pose to save"):
        room.live(background=False).save(tmp_path / "a.track")
    with pytest.raises(InputError, match="does not exist"):
        LiveTracker.load(tmp_path / "a.track", room)
    with pytest.raises(MapError, match="another map"):
        LiveTracker.load(path, flat)
    room.save(tmp_path / "room.scene")
    with pytest.raises(MapError, match="scene map"):
        LiveTracker.load(tmp_path / "room.scene", room)
    for cut in (0, 7, 100, 400):
        (tmp_path / "cut.track").write_bytes(path.read_bytes()[:cut])
        with pytest.raises((MapError, InputError)):
            LiveTracker.load(tmp_path / "cut.track", room)
    assert path.stat().st_size < 5000


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("map_from_camera", np.zeros((4, 4))),
        ("map_from_camera", np.eye(3)),
        ("odom_from_camera", np.full((4, 4), np.nan)),
        ("covariance", -np.eye(6)),
        ("stamp", np.array([np.inf])),
        ("stamp", np.zeros(0)),
        ("covariance", None),
        ("scene", 3),
        ("digest", None),
    ],
)
def test_columns_that_are_none(saved, tmp_path, name, value):
    file = read_map(saved[0], KIND, VERSION)
    meta, arrays = dict(file.meta), dict(file.arrays)
    if name in meta:
        meta[name] = value
    elif value is None:
        del arrays[name]
    else:
        arrays[name] = value
    write_map(tmp_path / "a.track", KIND, VERSION, meta, arrays)
    with pytest.raises(MapError, match=r"a\.track"):
        SavedPose.read(tmp_path / "a.track")
