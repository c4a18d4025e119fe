"""Which recorder, and whose poses."""

import json

import numpy as np
import pytest

import placegraph as pg
from placegraph.core.plugins import plugins
from placegraph.errors import InputError, MissingExtraError, OptionError
from placegraph.io.capture.capture import capture_formats, find_format, is_capture, open_capture
from placegraph.io.capture.tum import read_tum, write_tum


@pytest.fixture
def walk(folder, recorded, save):
    """Capture folder of a recorded walk: its odometry is false, `trajectory.tum` is true."""
    world = recorded()
    path = folder.path / "walk"
    for i in range(len(world)):
        save(path / "rgb" / f"{i}.png", world.rgb[i])
        save(path / "depth" / f"{i}.png", world.units(i))
    content = world.cameras[0].to_dict() | {"depth": world.depth_cameras[0].to_dict()}
    (path / "camera.json").write_text(json.dumps(content))
    false = world.poses.copy()
    false[:, :3, 3] += np.arange(len(world))[:, None]
    write_tum(path / "odometry.tum", world.stamps, false)
    write_tum(path / "trajectory.tum", world.stamps, world.poses)
    return path


def test_odometry_unless_the_truth_is_asked_for(walk, recorded):
    for poses in (None, "odometry"):
        own = open_capture(walk, poses=poses).odometry
        np.testing.assert_allclose(own[3, :3, 3] - recorded().poses[3, :3, 3], 3.0, atol=1e-6)
    recorded().check(open_capture(walk, poses="trajectory"), sure=False)
    (walk / "trajectory.tum").unlink()
    open_capture(walk)
    with pytest.raises(InputError, match=r"trajectory.tum does not exist"):
        open_capture(walk, poses="trajectory")


def test_a_file_of_poses(walk, recorded, tmp_path):
    world = recorded()
    rows = tmp_path / "rows.tum"
    write_tum(rows, np.arange(4), world.poses)  # as many rows as images: stamps do not matter
    world.check(open_capture(walk, poses=rows), sure=False)
    write_tum(rows, world.stamps[1:] + 0.001, world.poses[1:])
    capture = pg.open_capture(str(walk), poses=str(rows))
    world.check(capture, [1, 2, 3], sure=False)
    assert capture.left_out == {"no pose in rows.tum": 1}
    write_tum(rows, world.stamps[1:] + 0.1, world.poses[1:])
    with pytest.raises(InputError, match=r"rows.tum has 3 rows for 4 images, and none has.*20 ms"):
        open_capture(walk, poses=rows)
    with pytest.raises(InputError, match="does not exist"):
        open_capture(walk, poses=tmp_path / "no.tum")


def test_gravity_comes_with_the_poses(walk):
    stamps = read_tum(walk / "odometry.tum").stamps
    (walk / "gravity.txt").write_text("".join(f"{s} 0 0.6 0.8\n" for s in stamps))
    np.testing.assert_allclose(open_capture(walk).gravity, [[0, 0.6, 0.8]] * 4)
    capture = open_capture(walk, poses="trajectory")
    np.testing.assert_allclose(capture.gravity, -capture.odometry[:, 2, :3], atol=1e-9)
    for options in ({"scale": 2.0}, {"up": [0, 0, 1]}):
        with pytest.raises(OptionError, match="not an option of capture folder"):
            open_capture(walk, **options)


def test_poses_of_images_as_they_are_stored(recorded, save, tmp_path):
    world = recorded(turns=1)
    for i in range(len(world)):
        c = world.cameras[i]
        content = {"cameraPoseARFrame": np.eye(4).ravel().tolist(), "time": float(world.stamps[i]),
                   "intrinsics": [c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1]}  # fmt: skip
        pose = world.arkit(i).copy()
        pose[:3, 3] += 1.0
        content["cameraPoseARFrame"] = pose.ravel().tolist()
        (tmp_path / f"frame_{i:05d}.json").write_text(json.dumps(content))
        save(tmp_path / f"frame_{i:05d}.jpg", world.rgb[i], quality=97)
        save(tmp_path / f"depth_{i:05d}.png", world.units(i))
        save(tmp_path / f"conf_{i:05d}.png", world.sure[i])
    write_tum(tmp_path / "better.tum", world.stamps, world.poses)
    world.check(open_capture(tmp_path, poses=tmp_path / "better.tum"))


def test_the_nearest_format_is_named(tmp_path):
    (tmp_path / "walk").mkdir()
    (tmp_path / "walk/rgb.mp4").touch()
    (tmp_path / "walk/odometry.csv").touch()
    with pytest.raises(InputError) as caught:
        open_capture(tmp_path / "walk")
    assert "Stray Scanner" in str(caught.value).splitlines()[1]
    assert "; camera_matrix.csv missing." in str(caught.value)
    with pytest.raises(InputError, match=r"it contains walk/odometry.csv, walk/rgb.mp4\."):
        open_capture(tmp_path)
    assert not is_capture(tmp_path)
    assert not is_capture(tmp_path / "no")


def test_formats_are_told_by_what_lies_there(walk, tmp_path):
    (walk / "preview.mp4").touch()
    assert find_format(walk).name == "capture folder"
    assert is_capture(walk)
    for name, files in {
        "TUM RGB-D": ("rgb.txt", "depth.txt"), "Stray Scanner": ("odometry.csv", "camera_matrix.csv"),
        "Polycam": ("keyframes/cameras/1.json",), "Record3D": ("metadata", "rgbd/0.jpg"),
        "3D Scanner App": ("frame_00000.json",), "ARKitScenes": ("lowres_wide.traj",),
        "MultiScan": ("x.jsonl", "x.mp4"), "ios_logger": ("Frames.txt", "ARposes.txt"),
        "a video with a trajectory": ("x.mov", "camera.json"),
        "NeRFCapture, Spectacular AI and nerfstudio": ("transforms.json",),
        "COLMAP": ("sparse/0/cameras.bin", "sparse/0/images.bin"),
    }.items():  # fmt: skip
        for file in files:
            (tmp_path / name / file).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name / file).touch()
        assert find_format(tmp_path / name).name == name
        with pytest.raises(InputError, match=str(tmp_path / name)):  # empty files, all of them
            open_capture(tmp_path / name)


@pytest.fixture
def alone(monkeypatch):
    """The core without placegraph-io."""
    monkeypatch.setattr("placegraph.core.plugins.entry_points", lambda **_: ())
    plugins.cache_clear()
    capture_formats.cache_clear()
    yield
    monkeypatch.undo()
    plugins.cache_clear()
    capture_formats.cache_clear()


@pytest.mark.usefixtures("alone")
def test_an_extra_that_is_missing_is_named(walk, tmp_path):
    assert len(open_capture(walk)) == 4
    for name in ("walk.mcap", "walk.r3d", "a/rgb.txt", "b/rec.db3", "c/keyframes/1", "d/walk.sens"):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
        at = file if file.parent == tmp_path else tmp_path / name.partition("/")[0]
        assert is_capture(at)
        with pytest.raises(MissingExtraError, match=r"pip install 'placegraph\[io\]'"):
            open_capture(at)
    with pytest.raises(InputError, match="install the extra `io`"):
        open_capture(walk / "rgb")
