"""Stray Scanner: a video, and cameras with OpenCV's axes in a world with y up."""

import sys

import numpy as np
import pytest

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.video import Video

write_video = pytest.importorskip("tests.io.video", reason="needs OpenCV").write_video

LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)  # a codec's blocks blur small ones
HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"


def write(path, world, save, *, intrinsics=False):
    write_video(path / "rgb.mp4", world.rgb)
    c = world.cameras[0]
    (path / "camera_matrix.csv").write_text(f"{c.fx},0.0,{c.cx}\n0.0,{c.fy},{c.cy}\n0.0,0.0,1.0")
    more = ", fx, fy, cx, cy, distortion_center_x" if intrinsics else ""
    rows = [HEADER + more]
    for i in range(len(world)):
        save(path / "depth" / f"{i:06d}.png", world.units(i))
        save(path / "confidence" / f"{i:06d}.png", world.sure[i])
        pose = world.arkit(i) @ np.diag([1.0, -1, -1, 1])
        values = [*pose[:3, 3], *quaternion_from_rotation(pose[:3, :3])]
        if intrinsics:
            c = world.cameras[i]
            values += [c.fx, c.fy, c.cx, c.cy]
        cells = ", ".join(f"{v:.9f}" for v in values)
        rows.append(f"{world.stamps[i]:.6f}, {i:06d}, {cells}{', ' if intrinsics else ''}")
    (path / "odometry.csv").write_text("\n".join(rows) + "\n")
    return path


def test_points_and_colours(recorded, save, tmp_path):
    world = recorded(turns=1, camera=LARGE, shrink=4)
    capture = open_capture(write(tmp_path, world, save))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)


def test_intrinsics_of_every_frame(recorded, save, tmp_path):
    world = recorded(turns=1, camera=LARGE, shrink=4, refocus=0.01)
    world.check(open_capture(write(tmp_path, world, save, intrinsics=True)))


def test_frames_in_any_order(recorded, save, tmp_path):
    world = recorded(turns=1, camera=LARGE, shrink=4)
    capture = open_capture(write(tmp_path, world, save))
    straight = [f.rgb() for f in capture]
    for i in (3, 0, 2, 2, 1, 3):
        np.testing.assert_array_equal(capture[i].rgb(), straight[i])


def test_frames_without_depth_or_picture(recorded, save, tmp_path):
    world = recorded(turns=1, camera=LARGE, shrink=4)
    write(tmp_path, world, save)
    (tmp_path / "depth/000001.png").unlink()
    with (tmp_path / "odometry.csv").open("a") as file:
        file.write("200.0, 000017, 0, 0, 0, 0, 0, 0, 1\n\n")
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no depth": 1, "no colour image": 1}
    world.check(capture, [0, 2, 3])


@pytest.mark.parametrize(
    ("row", "says"),
    [
        ("1.0, 0, 0, 0, 0, 0, 0, 0, 0.5", "length 0.5"), ("1.0, 0, nan, 0, 0, 0, 0, 0, 1", "x is no"),
        ("1.0, 0, 1", "y is no finite"), ("1.0, a, 0, 0, 0, 0, 0, 0, 1", "line 2: could not"),
        ("1.0, -1, 0, 0, 0, 0, 0, 0, 1", "frame is no"),
        ("1.0, 0, inf, 0, 0, 0, 0, 0, 1", "x is no finite"),
    ],
)  # fmt: skip
def test_wrong_rows(row, says, recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    (tmp_path / "odometry.csv").write_text(f"{HEADER}\n{row}\n")
    with pytest.raises(InputError, match=says) as caught:
        open_capture(tmp_path)
    assert "odometry.csv, line 2" in str(caught.value)


@pytest.mark.parametrize("text", ["", "x, y\n1, 2\n", "\0", HEADER.replace("qw", "qq")])
def test_what_is_no_odometry(text, recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    (tmp_path / "odometry.csv").write_text(text)
    with pytest.raises(InputError, match=r"odometry.csv"):
        open_capture(tmp_path)


@pytest.mark.parametrize("text", ["", "1,2,3", "a", "1,0,0,0,-1,0,0,0,1"])
def test_wrong_matrices(text, recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    (tmp_path / "camera_matrix.csv").write_text(text)
    with pytest.raises(InputError, match=r"camera_matrix.csv"):
        open_capture(tmp_path)


def test_missing_parts(recorded, save, tmp_path):
    write(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    (tmp_path / "depth").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="depth holds no image"):
        open_capture(tmp_path)
    (tmp_path / "rgb.mp4").unlink()
    with pytest.raises(InputError, match=r"rgb.mp4 does not exist"):
        open_capture(tmp_path)


def test_damaged_videos(recorded, save, tmp_path, capfd):
    write(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    data = (tmp_path / "rgb.mp4").read_bytes()
    for part in (b"", data[: len(data) // 2], bytes(1000)):
        (tmp_path / "rgb.mp4").write_bytes(part)
        with pytest.raises(InputError, match=r"rgb.mp4 cannot be read as a video"):
            open_capture(tmp_path)
    capfd.readouterr()


def test_a_frame_beyond_the_end(tmp_path):
    rng = np.random.default_rng(0)
    write_video(tmp_path / "a.mp4", rng.integers(0, 255, (3, 64, 64, 3)).astype(np.uint8))
    video = Video(tmp_path / "a.mp4")
    assert (len(video), video.size) == (3, (64, 64))
    with pytest.raises(InputError, match="frame 7 cannot be read"):
        video.read(7)
    assert video.read(2).shape == (64, 64, 3)


def test_without_a_decoder(recorded, save, tmp_path, monkeypatch):
    write(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[video\]"):
        open_capture(tmp_path)
