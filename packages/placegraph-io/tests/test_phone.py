import json
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged, read_damaged, refusing

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.video import Video


def write_arkit_app(path, world, save):
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
    capture = open_capture(write_arkit_app(tmp_path, world, save))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    assert capture[1].camera != capture[0].camera, "every frame has its own intrinsics"


def test_most_frames_have_no_image(recorded, save, tmp_path):
    world = recorded(turns=1)
    write_arkit_app(tmp_path, world, save)
    (tmp_path / "frame_00001.jpg").unlink()
    (tmp_path / "depth_00003.png").unlink()
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no depth": 1}
    assert [frame.has_colour for frame in capture] == [True, False, True]
    assert not capture[1].rgb().any()
    world.check(replace(capture, frames=capture.frames[::2]), [0, 2])
    assert np.nanmedian(capture[1].depth()) == pytest.approx(
        np.median(world.units(1)) / 1000, rel=0.2
    )


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"cameraPoseARFrame": [1.0] * 16}, "cameraPoseARFrame is not a rotation and translation"),
        ({"cameraPoseARFrame": [float("nan")] * 16}, "not finite"),
        ({"cameraPoseARFrame": [0.0] * 12}, "list of 16"), ({"intrinsics": None}, "is missing"),
        ({"intrinsics": [80, 0, 990, 0, 80, 720, 0, 0, 1]}, "resized or rotated"),
        ({"intrinsics": [80, 0, float("nan"), 0, 80, 36, 0, 0, 1]}, "resized or rotated"),
        ({"intrinsics": [-80, 0, 48, 0, 80, 36, 0, 0, 1]}, "greater than 0"),
        ({"time": 101.0}, "has the stamp of"), ({"time": "now"}, "time is not"),
    ],
)  # fmt: skip
def test_wrong_frames(change, says, recorded, save, tmp_path):
    write_arkit_app(tmp_path, recorded(turns=1), save)
    file = tmp_path / "frame_00001.json"
    if change.get("time") == 101.0:
        change = {"time": json.loads((tmp_path / "frame_00000.json").read_text())["time"]}
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(InputError, match=says) as caught:
        open_capture(tmp_path)
    assert "frame_00001.json" in str(caught.value)


def test_poses_by_columns_and_captures_without_depth_are_noticed(recorded, save, tmp_path):
    world = recorded(turns=1)
    write_arkit_app(tmp_path, world, save)
    file = tmp_path / "frame_00000.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"cameraPoseARFrame": world.arkit(0).T.ravel().tolist()}))
    with pytest.raises(InputError, match="is stored by rows"):
        open_capture(tmp_path)
    file.write_text(json.dumps(content))
    for depth in tmp_path.glob("depth_*"):
        depth.unlink()
    with pytest.raises(InputError, match=r"no frame with .*depth_\*.png"):
        open_capture(tmp_path)


write_video = pytest.importorskip("tests.io.video", reason="needs OpenCV").write_video
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)


def write_ios_logger(path, world):
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
    capture = open_capture(write_ios_logger(tmp_path, world))
    world.check_views(capture)
    assert capture.depth_camera is None


def test_frames_without_a_pose(recorded, tmp_path):
    write_ios_logger(tmp_path, recorded(camera=LARGE, shrink=4))
    file = tmp_path / "ARposes.txt"
    file.write_text("".join(file.read_text().splitlines(keepends=True)[2:]))
    with (tmp_path / "Frames.txt").open("a") as frames:
        frames.write("1600000200.5,77,160,161,97,71\n")
    assert open_capture(tmp_path).left_out == {"no pose": 2}


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("Frames.txt", "1.0,0", "2 columns are given, expected 6"),
        ("Frames.txt", "", "is empty"),
        ("Frames.txt", "1600000100,0.5,1,1,1,1", "number is 0.5"),
        ("ARposes.txt", "a,b", r"`time, x, y, z, qw, qx, qy, qz`\."),
        ("ARposes.txt", "1600000100,nan,0,0,1,0,0,0", "finite"),
        ("ARposes.txt", "1600000100,0,0,0,2,0,0,0", "length 2"), ("Frames.m4v", "no", "as a video"),
    ],
)  # fmt: skip
def test_wrong_files(name, text, says, recorded, tmp_path):
    write_ios_logger(tmp_path, recorded(camera=LARGE, shrink=4))
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)


@DAMAGE
@given(data=st.data())
def test_damaged_files_of_ios_logger(data, recorded, tmp_path):
    world = recorded(camera=LARGE, shrink=4)
    read_damaged(tmp_path, data, lambda path: write_ios_logger(path, world))


def write_polycam(path, world, save, *, kind="", without=()):
    for i in range(len(world)):
        stem = f"{int(world.stamps[i] * 1e6)}"
        folder = path / "keyframes"
        c, pose = world.cameras[i], world.arkit(i)
        content = {"fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy, "width": 96, "height": 72}
        content |= {f"t_{r}{k}": pose[r, k] for r in range(3) for k in range(4)}
        content |= {"blur_score": 100.0, "timestamp": int(stem)}
        save(folder / f"{kind}images" / f"{stem}.jpg", world.rgb[i], quality=97)
        if "cameras" not in without:
            file = folder / f"{kind}cameras" / f"{stem}.json"
            file.parent.mkdir(exist_ok=True)
            file.write_text(json.dumps(content))
        if "depth" not in without:
            save(folder / "depth" / f"{stem}.png", world.units(i))
        if "confidence" not in without:
            save(folder / "confidence" / f"{stem}.png", (world.sure[i] * 127).astype(np.uint8))
    return path


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_however_the_telephone_is_held(turns, recorded, save, tmp_path):
    world = recorded(turns=turns, refocus=0.01)
    capture = open_capture(write_polycam(tmp_path, world, save))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    assert capture.depth_camera.width == (36 if turns % 2 else 48)
    focal = [f.camera.fy if turns % 2 else f.camera.fx for f in capture]
    np.testing.assert_allclose(focal, [c.fx for c in world.cameras])
    said = " ".join(capture.notes)
    assert "uncorrected" in said
    assert (f"turned by {turns * 90} degrees" in said) == bool(turns)


def test_corrected_poses_and_images_are_preferred(recorded, save, tmp_path):
    world = recorded(turns=1)
    write_polycam(tmp_path, recorded(turns=1, seed=9), save)
    write_polycam(tmp_path, world, save, kind="corrected_")
    capture = open_capture(tmp_path / "keyframes")
    world.check(capture)
    assert "uncorrected" not in " ".join(capture.notes)


def test_parts_that_are_missing(recorded, save, tmp_path):
    world = recorded(turns=1)
    write_polycam(tmp_path, world, save, without=("confidence",))
    world.check(open_capture(tmp_path), sure=False)
    for row, kind in enumerate(("depth", "cameras")):
        sorted((tmp_path / "keyframes" / kind).iterdir())[row].unlink()
    assert open_capture(tmp_path).left_out == {"no depth": 1, "no camera": 1}
    for kind, says in (
        ("depth", r"depth contains no image; only captures in LiDAR"), ("images", "images contains no image"),
    ):  # fmt: skip
        for file in (tmp_path / "keyframes" / kind).iterdir():
            file.unlink()
        with pytest.raises(InputError, match=says):
            open_capture(tmp_path)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"t_03": float("nan")}, "not finite"), ({"t_00": 5.0}, "is not a rotation and translation"),
        ({"t_12": None}, "t_12 is not a list of 1 numbers"), ({"fx": 0}, "greater than 0"),
        ({"fx": "wide"}, "fx is not"), ({"width": 0}, "greater than 0"),
        ({"height": 10**400}, "out of range"), ({"width": float("nan")}, "whole numbers"),
        ("", r"\.json"), ("[]", r"\.json"), ("{", r"\.json"), ("{}", r"\.json"),
    ],
)  # fmt: skip
def test_wrong_cameras(change, says, recorded, save, tmp_path):
    write_polycam(tmp_path, recorded(turns=1), save)
    file = next((tmp_path / "keyframes/cameras").iterdir())
    text = change
    if isinstance(change, dict):
        text = json.dumps(json.loads(file.read_text()) | change)
    file.write_text(text)
    with pytest.raises(InputError, match=says) as caught:
        open_capture(tmp_path)
    assert file.name in str(caught.value)


def test_depth_of_another_size(recorded, save, tmp_path):
    world = recorded(turns=1)
    write_polycam(tmp_path, world, save)
    files = sorted((tmp_path / "keyframes/depth").iterdir())
    save(files[1], np.zeros((18, 24), np.uint16))
    capture = open_capture(tmp_path)
    capture[0].depth()
    with pytest.raises(InputError, match=r"24 x 18 pixels, but its camera has 48 x 36"):
        capture[1].depth()
    save(files[0], np.zeros((36, 36), np.uint16))
    with pytest.raises(InputError, match="not a scaled version of the colour"):
        open_capture(tmp_path)


liblzfse = pytest.importorskip("liblzfse", reason="needs pyliblzfse")


def metadata(world, **changes):
    poses = []
    for i in range(len(world)):
        pose = world.arkit(i)
        poses.append([*quaternion_from_rotation(pose[:3, :3]), *pose[:3, 3]])
    c = world.cameras[0]
    d = world.depth_cameras[0]
    content = {
        "w": c.width, "h": c.height, "dw": d.width, "dh": d.height, "fps": 60,
        "K": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1], "poses": np.array(poses).tolist(),
        "perFrameIntrinsicCoeffs": [[c.fx, c.fy, c.cx, c.cy] for c in world.cameras],
        "frameTimestamps": world.stamps.tolist(), "initPose": [0, 0, 0, 1, 0, 0, 0],
    } | changes  # fmt: skip
    return json.dumps({name: value for name, value in content.items() if value is not None})


def metres(world, i):
    return np.where(world.metres[i] == 0, np.nan, world.metres[i]).astype("<f4")


def unpacked(path, world, save, *, name="metadata", sure=True, **changes):
    for i in range(len(world)):
        save(path / "rgbd" / f"{i}.jpg", world.rgb[i], quality=97)
        (path / "rgbd" / f"{i}.depth").write_bytes(liblzfse.compress(metres(world, i).tobytes()))
        if sure:
            data = liblzfse.compress(world.sure[i].tobytes())
            (path / "rgbd" / f"{i}.conf").write_bytes(data)
    (path / name).write_text(metadata(world, **changes))
    return path


def packed(path, folder):
    with zipfile.ZipFile(path, "w") as archive:
        for file in folder.rglob("*"):
            archive.write(file, file.relative_to(folder))
    return path


@pytest.mark.parametrize("name", ["metadata", "metadata.json"])
def test_unpacked(name, recorded, save, tmp_path):
    world = recorded(frames=11, refocus=0.002)  # 10 comes after 9
    capture = open_capture(unpacked(tmp_path, world, save, name=name))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)


def test_packed_and_without_confidence(recorded, save, tmp_path):
    world = recorded(turns=1)
    folder = unpacked(tmp_path / "walk", world, save)
    world.check(open_capture(packed(tmp_path / "walk.r3d", folder)))
    world = recorded()
    world.check(open_capture(unpacked(tmp_path / "unsure", world, save, sure=False)), sure=False)


def test_old_recordings_say_less(recorded, save, tmp_path):
    world = recorded(frames=1, camera=Camera(90, 120, 100.0, 100.0, 44.0, 61.0), shrink=1)
    folder = unpacked(tmp_path, world, save, perFrameIntrinsicCoeffs=None, frameTimestamps=None)
    capture = open_capture(folder)
    world.check(capture)
    assert capture.stamps.tolist() == [0.0]


def test_the_export(recorded, save, tmp_path):
    exr = pytest.importorskip("OpenEXR", reason="needs OpenEXR")
    world = recorded()
    folder = tmp_path / "EXR_RGBD"
    for i in range(len(world)):
        save(folder / "rgb" / f"{i}.png", world.rgb[i])
        (folder / "depth").mkdir(exist_ok=True)
        header = {"compression": exr.PIZ_COMPRESSION, "type": exr.scanlineimage}
        with exr.File(header, {"R": metres(world, i)}) as file:
            file.write(str(folder / "depth" / f"{i}.exr"))
    (folder / "metadata.json").write_text(metadata(world))
    for path in (tmp_path, folder):
        world.check(open_capture(path), sure=False)
    file = folder / "depth" / "0.exr"
    whole = file.read_bytes()
    for part in (b"", whole[:30], whole[: len(whole) // 2], bytes(500)):
        file.write_bytes(part)
        with pytest.raises(InputError, match=r"0.exr cannot be read as OpenEXR"):
            open_capture(tmp_path)[0].depth()
    (folder / "depth" / "1.exr").write_bytes(whole)
    file.unlink()
    assert open_capture(tmp_path).left_out == {"no depth": 1}


def test_without_what_unpacks(recorded, save, tmp_path, monkeypatch):
    capture = open_capture(unpacked(tmp_path, recorded(), save))
    monkeypatch.setitem(sys.modules, "liblzfse", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[record3d\]"):
        capture[0].depth()
    plain = metres(recorded(), 0).tobytes()
    (tmp_path / "rgbd/0.depth").write_bytes(plain)
    (tmp_path / "rgbd/0.conf").write_bytes(recorded().sure[0].tobytes())
    assert np.isfinite(capture[0].depth()).any(), "what is not packed needs nothing"


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"poses": None}, "poses has shape"), ({"poses": [[0, 0, 0, 1, 0, 0]]}, "rows of 7"),
        ({"poses": [[0, 0, 0, 1, 0, 0, 0], []]}, "not a list of rows"), ({"poses": []}, "poses"),
        ({"poses": [[0, 0, 0, 1, 0, float("nan"), 0]]}, "not finite"),
        ({"poses": [[0, 0, 0, 2, 0, 0, 0]]}, "length 2"),
        ({"frameTimestamps": [1.0]}, "1 numbers for 4"), ({"frameTimestamps": "x"}, "Timestamps"),
        ({"frameTimestamps": None, "fps": 0}, "fps is '0'"), ({"w": "wide"}, "sizes in pixels"),
        ({"dw": 0}, "sizes in pixels"), ({"dw": 40}, "not a scaled version"),
        ({"perFrameIntrinsicCoeffs": None, "K": None}, "K"),
        ({"perFrameIntrinsicCoeffs": [[0, 0, 0, 0]] * 4}, "greater than 0"),
        ("", "metadata"), ("[]", "metadata"), ("{", "metadata"),
    ],
)  # fmt: skip
def test_wrong_metadata(change, says, recorded, save, tmp_path):
    spoilt = change if isinstance(change, dict) else {}
    folder = unpacked(tmp_path / "walk", recorded(), save, **spoilt)
    if isinstance(change, str):
        (folder / "metadata").write_text(change)
    for path in (folder, packed(tmp_path / "a.r3d", folder)):
        with pytest.raises(InputError, match=says) as caught:
            open_capture(path)
        assert "metadata" in str(caught.value)


@DAMAGE
@given(data=st.data())
def test_damaged_depth(data, recorded, save, tmp_path):
    path = tmp_path / "rgbd/0.depth"
    if not path.exists():
        unpacked(tmp_path, recorded(), save)
    whole = liblzfse.compress(metres(recorded(), 0).tobytes())
    path.write_bytes(data.draw(damaged(whole)))
    with refusing("0.depth"):
        assert open_capture(tmp_path)[0].depth().shape == (36, 48)
    path.write_bytes(liblzfse.compress(np.zeros(100, "<f4").tobytes()))
    with pytest.raises(InputError, match=r"0.depth has 100 pixels, but metadata declares 48 x 36"):
        open_capture(tmp_path)[0].depth()


def test_truncated_zips(recorded, save, tmp_path):
    folder = unpacked(tmp_path / "walk", recorded(), save)
    path = packed(tmp_path / "walk.r3d", folder)
    whole = path.read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:size])
        with pytest.raises(
            InputError, match=r"walk.r3d(, metadata)? (cannot be read as a ZIP|is damaged)"
        ):
            open_capture(path)
    damaged = bytearray(whole)
    at = whole.index((folder / "rgbd/0.depth").read_bytes())
    damaged[at + 20] ^= 255
    path.write_bytes(bytes(damaged))
    with pytest.raises(InputError, match=r"0.depth is damaged"):
        open_capture(path)[0].depth()


HEADER = "timestamp, frame, x, y, z, qx, qy, qz, qw"


def write_stray(path, world, save, *, intrinsics=False):
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


def test_points_and_colours_stray(recorded, save, tmp_path):
    world = recorded(turns=1, camera=LARGE, shrink=4, refocus=0.01)
    world.check(open_capture(write_stray(tmp_path, world, save, intrinsics=True)))
    world = recorded(turns=1, camera=LARGE, shrink=4)
    capture = open_capture(write_stray(tmp_path, world, save))
    world.check(capture)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    straight = [f.rgb() for f in capture]
    for i in (3, 0, 2, 2, 1, 3):  # in any order
        np.testing.assert_array_equal(capture[i].rgb(), straight[i])


def test_frames_without_depth_or_picture(recorded, save, tmp_path):
    world = recorded(turns=1, camera=LARGE, shrink=4)
    write_stray(tmp_path, world, save)
    (tmp_path / "depth/000001.png").unlink()
    with (tmp_path / "odometry.csv").open("a") as file:
        file.write("200.0, 000017, 0, 0, 0, 0, 0, 0, 1\n\n")
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no depth": 1, "no colour image": 1}
    world.check(capture, [0, 2, 3])


BAD_ROWS = (
    ("1.0, 0, 0, 0, 0, 0, 0, 0, 0.5", "length 0.5"), ("1.0, 0, nan, 0, 0, 0, 0, 0, 1", "x is no"),
    ("1.0, 0, 1", "y is not a finite"), ("1.0, a, 0, 0, 0, 0, 0, 0, 1", "could not"),
    ("1.0, -1, 0, 0, 0, 0, 0, 0, 1", "frame is no"),
    ("1.0, 0, inf, 0, 0, 0, 0, 0, 1", "x is not a finite"),
)  # fmt: skip
NO_ODOMETRY = ("", "x, y\n1, 2\n", "\0", HEADER.replace("qw", "qq"))
NO_MATRIX = ("", "1,2,3", "a", "1,0,0,0,-1,0,0,0,1")


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        *(("odometry.csv", f"{HEADER}\n{row}\n", f"csv, line 2.*{says}") for row, says in BAD_ROWS),
        *(("odometry.csv", text, r"odometry.csv") for text in NO_ODOMETRY),
        *(("camera_matrix.csv", text, r"camera_matrix.csv") for text in NO_MATRIX),
    ],
)
def test_wrong_files_stray(name, text, says, recorded, save, tmp_path):
    write_stray(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)


def test_missing_parts_and_damaged_videos(recorded, save, tmp_path, capfd):
    write_stray(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    data = (tmp_path / "rgb.mp4").read_bytes()
    for part in (b"", data[: len(data) // 2], bytes(1000)):
        (tmp_path / "rgb.mp4").write_bytes(part)
        with pytest.raises(InputError, match=r"rgb.mp4 cannot be read as a video"):
            open_capture(tmp_path)
    capfd.readouterr()
    (tmp_path / "rgb.mp4").write_bytes(data)
    (tmp_path / "depth").rename(tmp_path / "elsewhere")
    with pytest.raises(InputError, match="depth contains no image"):
        open_capture(tmp_path)
    (tmp_path / "rgb.mp4").unlink()
    with pytest.raises(InputError, match=r"rgb.mp4 does not exist"):
        open_capture(tmp_path)


def test_a_frame_beyond_the_end(tmp_path):
    rng = np.random.default_rng(0)
    write_video(tmp_path / "a.mp4", rng.integers(0, 255, (3, 64, 64, 3)).astype(np.uint8))
    video = Video(tmp_path / "a.mp4")
    assert (len(video), video.size) == (3, (64, 64))
    with pytest.raises(InputError, match="frame 7 cannot be read"):
        video.read(7)
    assert video.read(2).shape == (64, 64, 3)


def test_without_a_decoder(recorded, save, tmp_path, monkeypatch):
    write_stray(tmp_path, recorded(turns=1, camera=LARGE, shrink=4), save)
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MissingExtraError, match=r"placegraph\[video\]"):
        open_capture(tmp_path)
