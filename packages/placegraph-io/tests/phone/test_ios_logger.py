"""ios_logger: a video with ARKit's poses."""

import pytest

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture

write_video = pytest.importorskip("tests.io.video", reason="needs OpenCV").write_video
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)


def write(path, world):
    write_video(path / "Frames.m4v", world.rgb)
    frames, poses = [], []
    for i in range(len(world)):
        stamp, c, pose = 1.6e9 + world.stamps[i], world.cameras[i], world.arkit(i)
        frames.append(f"{stamp:f},{i},{c.fx:f},{c.fy:f},{c.cx:f},{c.cy:f}\r\n")
        x, y, z, w = quaternion_from_rotation(pose[:3, :3])
        numbers = [stamp, *pose[:3, 3], w, x, y, z]
        poses.append(",".join(f"{v:f}" for v in numbers) + "\r\n")
        poses.append(f"{stamp + 0.016:f},9,9,9,1,0,0,0\r\n")  # frames that were not kept
    (path / "Frames.txt").write_text("".join(frames))
    (path / "ARposes.txt").write_text("".join(poses))
    return path


@pytest.mark.parametrize("turns", [0, 3])
def test_colours_and_poses(turns, recorded, tmp_path):
    world = recorded(turns=turns, camera=LARGE, shrink=4, refocus=0.01)
    capture = open_capture(write(tmp_path, world))
    world.check_views(capture)
    assert capture.depth_camera is None


def test_frames_without_a_pose(recorded, tmp_path):
    write(tmp_path, recorded(camera=LARGE, shrink=4))
    file = tmp_path / "ARposes.txt"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[2:]))
    with (tmp_path / "Frames.txt").open("a") as frames:
        frames.write("1600000200.5,77,160,161,97,71\n")
    assert open_capture(tmp_path).left_out == {"no pose": 2}


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("Frames.txt", "1.0,0", "line 1 is not a row .* `time, number"), ("Frames.txt", "", "holds no row"),
        ("Frames.txt", "1600000100,0.5,1,1,1,1", "number is 0.5"),
        ("ARposes.txt", "a,b", "could not convert"),
        ("ARposes.txt", "1600000100,nan,0,0,1,0,0,0", "finite"),
        ("ARposes.txt", "1600000100,0,0,0,2,0,0,0", "length 2"), ("Frames.m4v", "no", "as a video"),
    ],
)  # fmt: skip
def test_wrong_files(name, text, says, recorded, tmp_path):
    write(tmp_path, recorded(camera=LARGE, shrink=4))
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)
