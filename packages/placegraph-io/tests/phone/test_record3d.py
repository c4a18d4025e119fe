"""Record3D: .r3d files, the same unpacked, and its export as OpenEXR."""

import json
import sys
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import InputError, MissingExtraError
from placegraph.io.capture.capture import open_capture

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
    """Depth as LiDAR has it: NaN where there is none."""
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


def test_packed(recorded, save, tmp_path):
    world = recorded(turns=1)
    folder = unpacked(tmp_path / "walk", world, save)
    world.check(open_capture(packed(tmp_path / "walk.r3d", folder)))


def test_old_recordings_say_less(recorded, save, tmp_path):
    world = recorded(frames=1, camera=Camera(90, 120, 100.0, 100.0, 44.0, 61.0), shrink=1)
    folder = unpacked(tmp_path, world, save, perFrameIntrinsicCoeffs=None, frameTimestamps=None)
    capture = open_capture(folder)
    world.check(capture)
    assert capture.stamps.tolist() == [0.0]


def test_without_confidence(recorded, save, tmp_path):
    world = recorded()
    world.check(open_capture(unpacked(tmp_path, world, save, sure=False)), sure=False)


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
        ({"dw": 0}, "sizes in pixels"), ({"dw": 40}, "not the view"),
        ({"perFrameIntrinsicCoeffs": None, "K": None}, "K"),
        ({"perFrameIntrinsicCoeffs": [[0, 0, 0, 0]] * 4}, "greater than 0"),
    ],
)  # fmt: skip
def test_wrong_metadata(change, says, recorded, save, tmp_path):
    unpacked(tmp_path, recorded(), save, **change)
    with pytest.raises(InputError, match=says) as caught:
        open_capture(tmp_path)
    assert "metadata" in str(caught.value)


@pytest.mark.parametrize("text", ["", "[]", "{"])
def test_what_is_no_metadata(text, recorded, save, tmp_path):
    folder = unpacked(tmp_path / "walk", recorded(), save)
    (folder / "metadata").write_text(text)
    for path in (folder, packed(tmp_path / "a.r3d", folder)):
        with pytest.raises(InputError, match="metadata"):
            open_capture(path)


def test_depth_of_another_size(recorded, save, tmp_path):
    unpacked(tmp_path, recorded(), save)
    few = liblzfse.compress(np.zeros(100, "<f4").tobytes())
    (tmp_path / "rgbd/0.depth").write_bytes(few)
    with pytest.raises(InputError, match=r"0.depth has 100 pixels, but metadata says 48 x 36"):
        open_capture(tmp_path)[0].depth()


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60)
@given(cut=st.integers(0, 10**6), at=st.integers(0, 10**6), byte=st.integers(0, 255))
def test_damaged_depth(cut, at, byte, recorded, save, tmp_path):
    path = tmp_path / "rgbd/0.depth"
    if not path.exists():
        unpacked(tmp_path, recorded(), save)
    whole = bytearray(liblzfse.compress(metres(recorded(), 0).tobytes()))
    whole[at % len(whole)] = byte
    path.write_bytes(bytes(whole[: cut % (2 * len(whole))]))
    try:
        assert open_capture(tmp_path)[0].depth().shape == (36, 48)
    except InputError as error:
        assert "0.depth" in str(error)  # noqa: PT017  # either is right


def test_truncated_zips(recorded, save, tmp_path):
    folder = unpacked(tmp_path / "walk", recorded(), save)
    path = packed(tmp_path / "walk.r3d", folder)
    whole = path.read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 10):
        path.write_bytes(whole[:size])
        with pytest.raises(InputError, match=r"walk.r3d(, metadata)? is (no readable ZIP|damaged)"):
            open_capture(path)
    damaged = bytearray(whole)
    at = whole.index((folder / "rgbd/0.depth").read_bytes())
    damaged[at + 20] ^= 255
    path.write_bytes(bytes(damaged))
    with pytest.raises(InputError, match=r"0.depth is damaged"):
        open_capture(path)[0].depth()
