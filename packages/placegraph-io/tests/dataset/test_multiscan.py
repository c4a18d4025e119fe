import json
import os
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, read_damaged

from placegraph.core.geometry import Camera
from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture
from placegraph_io.dataset.multiscan import DeflateStream

write_video = pytest.importorskip("tests.io.video", reason="needs OpenCV").write_video
LARGE = Camera(192, 144, 160.0, 161.0, 97.5, 71.0)  # a codec's blocks blur small ones


def deflated(parts):
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return b"".join(packer.compress(part) for part in parts) + packer.flush()


def write(path, world, *, unit="m", sure=True):
    name = "20260101T120000_ABC"
    write_video(path / f"{name}.mp4", world.rgb)
    lines = []
    for i in range(len(world)):
        c = world.cameras[i]
        entry = {
            "timestamp": int(world.stamps[i] * 1e9), "transform": world.arkit(i).T.ravel().tolist(),
            "intrinsics": [c.fx, 0, 0, 0, c.fy, 0, c.cx, c.cy, 1], "exposure_duration": 16666666,
            "euler_angles": [0.0, 0.0, 0.0], "quaternion": [1.0, 0.0, 0.0, 0.0],
        }  # fmt: skip
        lines.append(json.dumps(entry))
    (path / f"{name}.jsonl").write_text("\n".join(lines) + "\n")
    kind = (lambda m: (m * 1000).astype("<u2")) if unit == "mm" else (lambda m: m.astype("<f2"))
    depth = deflated(kind(metres).tobytes() for metres in world.metres)
    (path / f"{name}.depth.zlib").write_bytes(depth)
    d = world.depth_cameras[0]
    streams = [
        {"file_extension": "mp4", "type": "color_camera", "resolution": [144, 192]},
        {"file_extension": "depth.zlib", "type": "lidar_sensor", "resolution": [d.height, d.width]},
    ]
    if sure:
        (path / f"{name}.confidence.zlib").write_bytes(deflated(s.tobytes() for s in world.sure))
        streams.append({"file_extension": "confidence.zlib", "type": "confidence_map"})
    about = {"scene": {"type": "Kitchen"}, "depth_unit": unit, "streams": streams}
    (path / f"{name}.json").write_text(json.dumps(about))
    return path


@pytest.mark.parametrize(("unit", "sure", "turns"), [("m", True, 1), ("mm", False, 0)])
def test_points_and_colours(unit, sure, turns, recorded, tmp_path):
    world = recorded(turns=turns, camera=LARGE, shrink=4, refocus=0.01)
    capture = open_capture(write(tmp_path, world, unit=unit, sure=sure))
    world.check(capture, sure=sure)
    np.testing.assert_allclose(capture.stamps, world.stamps)
    straight = [f.depth() for f in capture]
    for i in (3, 0, 2, 2, 1, 3):
        np.testing.assert_array_equal(capture[i].depth(), straight[i])
    next(tmp_path.glob("*.depth.zlib")).unlink()
    assert open_capture(tmp_path)[0].depth() is None


def test_a_pipe_is_no_stream_of_depth(tmp_path):
    os.mkfifo(tmp_path / "a.depth.zlib")
    with pytest.raises(InputError, match="not a regular file"):
        DeflateStream(tmp_path / "a.depth.zlib", 4).read(0)


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        (".json", "{}", "streams is not a list"), (".json", '{"streams": [], "depth_unit": "ft"}', "'ft'"),
        (".json", '{"streams": [], "depth_unit": {"m": 1}}', "depth_unit is"),
        (".json", '{"streams": [{"file_extension": "depth.zlib", "resolution": [0, 1e9]}]}', "0 x 1e"),
        (".json", '{"streams": []}', "the stream depth.zlib has no resolution"),
        (".jsonl", "[]", r"jsonl, line 1 must be"), (".jsonl", '{"intrinsics": [1]}', "list of 9 numbers"),
        (".jsonl", "", "contains no usable frame"),
    ],
)  # fmt: skip
def test_wrong_files(file, text, says, recorded, tmp_path):
    write(tmp_path, recorded(camera=LARGE, shrink=4))
    next(p for p in tmp_path.iterdir() if p.suffix == file).write_text(text)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)


def test_frames_of_a_stream_in_any_order(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 5, (250, 640)).astype(np.uint8)
    (tmp_path / "x").write_bytes(deflated(f.tobytes() for f in frames))
    stream = DeflateStream(tmp_path / "x", 640)
    for i in (3, 249, 120, 100, 99, 0, 248, 201):
        assert stream.read(i) == frames[i].tobytes()
    with pytest.raises(InputError, match="ends before frame 250"):
        stream.read(250)


@DAMAGE
@given(data=st.data())
def test_damaged_files(data, recorded, tmp_path):
    world = recorded(camera=LARGE, shrink=4)
    read_damaged(tmp_path, data, lambda path: write(path, world))
