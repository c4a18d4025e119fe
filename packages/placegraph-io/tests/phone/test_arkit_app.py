"""3D Scanner App: a JSON file a frame, images of some of them."""

import json

import numpy as np
import pytest

from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture


def write(path, world, save):
    for i in range(len(world)):
        c = world.cameras[i]
        content = {
            "cameraPoseARFrame": world.arkit(i).ravel().tolist(),
            "intrinsics": [c.fx, 0, c.cx, 0, c.fy, c.cy, 0, 0, 1],
            "time": float(world.stamps[i]), "frame_index": i, "motionQuality": 1,
        }  # fmt: skip
        (path / f"frame_{i:05d}.json").write_text(json.dumps(content))
        save(path / f"frame_{i:05d}.jpg", world.rgb[i], quality=97)
        save(path / f"depth_{i:05d}.png", world.units(i))
        save(path / f"conf_{i:05d}.png", world.sure[i])
    (path / "info.json").write_text('{"frameCount": 4}')
    return path


def test_points_and_colours(recorded, save, tmp_path):
    world = recorded(turns=3, refocus=0.01)
    capture = open_capture(write(tmp_path, world, save))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    assert capture[1].camera != capture[0].camera, "every frame has its own intrinsics"


def test_most_frames_have_no_image(recorded, save, tmp_path):
    world = recorded(turns=1)
    write(tmp_path, world, save)
    (tmp_path / "frame_00001.jpg").unlink()
    (tmp_path / "depth_00003.png").unlink()
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no colour image": 1, "no depth": 1}
    world.check(capture, [0, 2])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"cameraPoseARFrame": [1.0] * 16}, "no rotation"),
        ({"cameraPoseARFrame": [float("nan")] * 16}, "not finite"),
        ({"cameraPoseARFrame": [0.0] * 12}, "list of 16"), ({"intrinsics": None}, "is missing"),
        ({"intrinsics": [80, 0, 990, 0, 80, 720, 0, 0, 1]}, "made smaller or turned"),
        ({"intrinsics": [80, 0, float("nan"), 0, 80, 36, 0, 0, 1]}, "made smaller"),
        ({"intrinsics": [-80, 0, 48, 0, 80, 36, 0, 0, 1]}, "greater than 0"),
        ({"time": 101.0}, "has the stamp of"), ({"time": "now"}, "time is not"),
    ],
)  # fmt: skip
def test_wrong_frames(change, says, recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    file = tmp_path / "frame_00001.json"
    if change.get("time") == 101.0:
        change = {"time": json.loads((tmp_path / "frame_00000.json").read_text())["time"]}
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=says) as caught:
        open_capture(tmp_path)
    assert "frame_00001.json" in str(caught.value)


def test_poses_by_columns_are_noticed(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    file = tmp_path / "frame_00000.json"
    content = json.loads(file.read_text())
    content["cameraPoseARFrame"] = recorded(turns=1).arkit(0).T.ravel().tolist()
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match="written by columns"):
        open_capture(tmp_path)


def test_nothing_but_poses(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1), save)
    for file in tmp_path.glob("depth_*"):
        file.unlink()
    with pytest.raises(InputError, match=r"no frame with .*depth_\*.png"):
        open_capture(tmp_path)
