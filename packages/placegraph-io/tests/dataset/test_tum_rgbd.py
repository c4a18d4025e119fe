import json

import numpy as np
import pytest

from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.tum import write_tum
from placegraph_io.dataset.tum_rgbd import CAMERAS


def write(path, world, save, *, camera=True, late=0.012):
    path.mkdir(parents=True, exist_ok=True)
    lists = {"rgb": ["# color images", "# timestamp filename"], "depth": ["# depth maps"]}
    for i in range(len(world)):
        stamp = world.stamps[i]
        for kind, at in (("rgb", stamp), ("depth", stamp + late)):
            name = f"{kind}/{at:.6f}.png"
            save(path / name, world.rgb[i] if kind == "rgb" else world.units(i, 5000))
            lists[kind].append(f"{at:.6f} {name}")
    for kind, rows in lists.items():
        (path / f"{kind}.txt").write_text("\n".join(rows) + "\n")
    # poses at 100 Hz, none at the moment of a frame
    stamps, way = np.concatenate([world.stamps - 0.004, world.stamps + 0.006]), np.zeros((4, 4))
    way[:3, 3] = (5.0, -2.0, 3.0)
    poses = np.concatenate([world.poses - 0.004 * way, world.poses + 0.006 * way])
    order = np.argsort(stamps)
    write_tum(path / "groundtruth.txt", stamps[order], poses[order])
    if camera:
        content = world.cameras[0].to_dict() | {"depth": world.depth_cameras[0].to_dict()}
        (path / "camera.json").write_text(json.dumps(content))
    return path


def test_points_and_colours(recorded, save, tmp_path):
    world = recorded()
    folder = write(tmp_path, world, save)
    capture = open_capture(folder)
    world.check(capture, sure=False)
    np.testing.assert_allclose(capture.stamps, world.stamps, atol=1e-5)
    assert "groundtruth.txt, the ground truth" in capture.notes[0]
    content = json.loads((folder / "camera.json").read_text())
    content["depth"]["scale"] = 1000
    (folder / "camera.json").write_text(json.dumps(content))
    np.testing.assert_allclose(open_capture(folder)[0].depth(), 5 * capture[0].depth(), rtol=1e-6)


@pytest.mark.parametrize("number", [1, *(pytest.param(n, marks=pytest.mark.all) for n in (2, 3))])
def test_cameras_of_the_benchmark(number, recorded, save, tmp_path):
    world = recorded(frames=1, camera=CAMERAS[number], shrink=1)
    folder = write(tmp_path / f"rgbd_dataset_freiburg{number}_desk", world, save, camera=False)
    capture = open_capture(folder)
    assert capture.camera == CAMERAS[number] == capture.depth_camera
    published = {1: 318.643040, 2: 325.141442, 3: 320.106653}[number]
    assert capture.camera.cx == published + 0.5, "the first pixel's centre is (0, 0) there"
    world.check(capture, sure=False)


def test_an_unknown_camera(recorded, save, tmp_path):
    folder = write(tmp_path / "walk4", recorded(), save, camera=False)
    with pytest.raises(InputError, match=r"freiburg3.*write camera.json with width"):
        open_capture(folder)


def test_what_is_more_than_20_ms_apart(recorded, save, tmp_path):
    world = recorded()
    write(tmp_path, world, save)
    lines = (tmp_path / "depth.txt").read_text().splitlines()
    (tmp_path / "depth.txt").write_text("\n".join(lines[:-1]))
    truth = (tmp_path / "groundtruth.txt").read_text().splitlines()
    (tmp_path / "groundtruth.txt").write_text("\n".join(truth[2:]))
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no depth within 20 ms": 1, "no pose within 20 ms": 1}
    world.check(capture, [1, 2], sure=False)


def test_a_trajectory_of_ones_own(recorded, save, tmp_path):
    world = recorded()
    folder = write(tmp_path / "walk", world, save)
    (folder / "groundtruth.txt").unlink()
    with pytest.raises(InputError, match=r"groundtruth.txt does not exist; give a trajectory"):
        open_capture(folder)
    write_tum(tmp_path / "slam.tum", world.stamps + 0.01, world.poses)
    capture = open_capture(folder, poses=tmp_path / "slam.tum")
    world.check(capture, sure=False)
    assert not capture.notes
    write_tum(tmp_path / "rows.tum", np.arange(len(world)), world.poses)
    world.check(open_capture(folder, poses=tmp_path / "rows.tum"), sure=False)


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("rgb.txt", "", "lists no image"), ("rgb.txt", "a rgb/a.png", "line 1"),
        ("rgb.txt", "1.0", "a row must be"), ("depth.txt", "nan depth/a.png", "line 1"),
        ("depth.txt", "9e9 depth/a.png", r"no usable frame \(4: no depth"),
        ("groundtruth.txt", "1 2 3", "groundtruth.txt, line 1"),
        ("groundtruth.txt", "9e9 0 0 0 0 0 0 1", "no usable frame"),
        ("groundtruth.txt", "1 nan 0 0 0 0 0 1", "tx is nan"),
    ],
)  # fmt: skip
def test_wrong_lists(name, text, says, recorded, save, tmp_path):
    write(tmp_path, recorded(), save)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)


def test_images_that_are_missing_or_of_another_size(recorded, save, tmp_path):
    write(tmp_path, recorded(), save)
    capture = open_capture(tmp_path)
    files = sorted((tmp_path / "depth").iterdir())
    save(files[0], np.zeros((72, 96), np.uint16))
    files[1].unlink()
    with pytest.raises(InputError, match="96 x 72 pixels, but its camera has 48 x 36"):
        capture[0].depth()
    with pytest.raises(InputError, match="does not exist"):
        capture[1].depth()
