import io
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph.errors import InputError
from placegraph_io.dataset.scan3r_sequence import is_scan3r_sequence, read_pgm, read_scan3r_sequence

INFO = """\
m_versionNumber = 4
m_sensorName = tangoDevice (calibrated)
m_colorWidth = 192
m_colorHeight = 108
m_depthWidth = 56
m_depthHeight = 43
m_depthShift = 1000
m_calibrationColorIntrinsic = 150 0 95.5 0 0 151 52.5 0 0 0 1 0 0 0 0 1
m_calibrationColorExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_calibrationDepthIntrinsic = 43.75 0 27.5 0 0 60.12037 20.60185 0 0 0 1 0 0 0 0 1
m_calibrationDepthExtrinsic = 1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
m_frames.size = {}
"""
INVALID = "-inf -inf -inf -inf\n" * 4
# looking along x of a level world; up is the stored image's left, as of a telephone held upright
LYING = np.array([[0, 0, 1, 0.0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
LYING[:3, 1] = np.cross(LYING[:3, 2], LYING[:3, 0])


def pose_at(x, y, z, yaw=0.0):
    turned = np.eye(4)
    turned[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    turned[:3, 3] = x, y, z
    return turned @ LYING


def pgm(units):
    height, width = units.shape
    return f"P5\n{width} {height}\n65535\n".encode() + units.astype(">u2").tobytes()


class Recording:
    POINT = np.array([3.0, 0.4, 1.7])
    POSES = (pose_at(0, 0, 1.5), pose_at(0.3, -0.1, 1.4, 0.1), pose_at(0.5, 0.2, 1.6, -0.05))

    def __init__(self):
        self.files = {"_info.txt": INFO.format(len(self.POSES)).encode()}
        for i, pose in enumerate(self.POSES):
            name = f"frame-{i:06d}"
            x, y, z, _ = np.linalg.inv(pose) @ (*self.POINT, 1.0)
            colours = np.full((108, 192, 3), 128, np.uint8)
            u, v = round(150 * x / z + 95.5), round(151 * y / z + 52.5)
            colours[v - 4 : v + 5, u - 4 : u + 5] = (230, 20, 20)
            file = io.BytesIO()
            Image.fromarray(colours).save(file, "JPEG", quality=95, subsampling=0)
            units = np.zeros((43, 56), np.uint16)
            u, v = round(43.75 * x / z + 27.5), round(60.12037 * y / z + 20.60185)
            units[v - 1 : v + 2, u - 1 : u + 2] = round(1000 * z)
            self.files[f"{name}.color.jpg"] = file.getvalue()
            self.files[f"{name}.depth.pgm"] = pgm(units)
            self.files[f"{name}.pose.txt"] = "\n".join(
                " ".join(f"{value:.6f}" for value in row) for row in pose
            ).encode()

    def folder(self, path):
        sequence = path / "sequence"
        sequence.mkdir(parents=True, exist_ok=True)
        for name, data in self.files.items():
            (sequence / name).write_bytes(data)
        return path

    def zipped(self, path, prefix="", compression=zipfile.ZIP_DEFLATED):
        path.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(path / "sequence.zip", "w", compression) as archive:
            for name, data in self.files.items():
                archive.writestr(prefix + name, data)
        return path


@pytest.fixture
def recording():
    return Recording()


def sees_the_block(frame):
    point = np.linalg.inv(frame.odometry) @ (*Recording.POINT, 1.0)
    u, v = np.floor(frame.camera.project(point[:3])).astype(int)
    r, g, b = frame.rgb()[v, u].astype(int)
    red = r > 180 and g < 80 and b < 80
    u, v = np.floor(frame.depth_camera.project(point[:3])).astype(int)
    return red and frame.depth()[v, u] == pytest.approx(point[2], abs=2e-3)


@pytest.mark.parametrize("rotate", [True, False])
def test_by_reprojection(recording, tmp_path, rotate):
    capture = read_scan3r_sequence(recording.folder(tmp_path), rotate=rotate)
    assert len(capture) == 3
    for frame in capture:
        assert sees_the_block(frame)
        assert np.allclose(frame.odometry[:3, :3] @ frame.gravity, (0, 0, -1), atol=1e-6)
        size = (frame.camera.width, frame.camera.height)
        assert size == ((108, 192) if rotate else (192, 108))
        assert frame.rgb().shape == (*size[::-1], 3)
        assert frame.depth().shape == ((56, 43) if rotate else (43, 56))
        down = frame.gravity @ ((0, 1, 0) if rotate else (1, 0, 0))
        assert down == pytest.approx(1, abs=1e-6)
    assert np.allclose(capture.odometry[:, :3, 3], [p[:3, 3] for p in Recording.POSES], atol=1e-6)


@given(yaw=st.floats(-3.1, 3.1), quarter=st.integers(0, 3))
@DAMAGE
def test_any_quarter_is_stood_upright(recording, tmp_path, yaw, quarter):
    roll = np.eye(4)
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    roll[:2, :2] = [[c, -s], [s, c]]
    pose = pose_at(0, 0, 1, yaw) @ roll
    text = "\n".join(" ".join(map(repr, row)) for row in pose.tolist()).encode()
    for i in range(3):
        recording.files[f"frame-{i:06d}.pose.txt"] = text
    capture = read_scan3r_sequence(recording.folder(tmp_path))
    assert np.allclose(capture.gravity, (0, 1, 0), atol=1e-6)
    looking = capture.odometry[:, :3, 2]
    assert np.allclose(looking, (np.cos(yaw), np.sin(yaw), 0), atol=1e-6)


def test_pixel_centres_are_at_a_half(recording, tmp_path):
    capture = read_scan3r_sequence(recording.folder(tmp_path), rotate=False)
    assert (capture.camera.cx, capture.camera.cy) == (96.0, 53.0)
    wide = capture.camera.resize(56, 43)  # depth is the same view
    assert (wide.fx, wide.cx) == pytest.approx((capture.depth_camera.fx, capture.depth_camera.cx))
    assert wide.cy == pytest.approx(capture.depth_camera.cy, abs=1e-4)


@pytest.mark.parametrize("prefix", ["", "sequence/"])
@pytest.mark.parametrize("compression", [zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED])
def test_a_zip_is_read_in_place(recording, tmp_path, prefix, compression):
    path = recording.zipped(tmp_path / "zipped", prefix, compression)
    assert is_scan3r_sequence(path)
    assert is_scan3r_sequence(path / "sequence.zip")
    zipped = read_scan3r_sequence(path / "sequence.zip")
    plain = read_scan3r_sequence(recording.folder(tmp_path / "plain") / "sequence")
    assert len(zipped) == len(plain) == 3
    for a, b in zip(zipped, plain, strict=True):
        assert np.array_equal(a.rgb(), b.rgb())
        assert np.array_equal(a.depth(), b.depth(), equal_nan=True)
        assert np.array_equal(a.odometry, b.odometry)
    assert sorted(p.name for p in path.iterdir()) == ["sequence.zip"]


def test_what_cannot_be_used_is_counted(recording, tmp_path):
    recording.files["frame-000000.pose.txt"] = b"one two"
    recording.files["frame-000007.color.jpg"] = recording.files["frame-000001.color.jpg"]
    recording.files["frame-000008.pose.txt"] = recording.files["frame-000001.pose.txt"]
    recording.files["frame-000009.color.jpg"] = b""
    recording.files["frame-000009.pose.txt"] = b"2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1"
    recording.files["_info.txt"] = INFO.format(10).encode()
    del recording.files["frame-000002.depth.pgm"]
    capture = read_scan3r_sequence(recording.folder(tmp_path))
    assert [f.index for f in capture] == [1, 2]
    assert capture.stamps.tolist() == [1, 2]
    assert capture.left_out == {
        "frames with an invalid pose": 2,
        "frames without a pose": 1,
        "frames without a colour image": 1,
        "frames that are listed, but missing": 4,
    }
    assert capture[0].depth() is not None
    assert capture[1].depth() is None
    for i in range(3):
        recording.files.pop(f"frame-{i:06d}.depth.pgm", None)
    capture = read_scan3r_sequence(recording.folder(tmp_path / "colours"))
    assert capture.depth_camera is None
    assert capture[0].depth() is None


def test_nothing_to_use(recording, tmp_path):
    for i in range(3):
        recording.files[f"frame-{i:06d}.pose.txt"] = INVALID.encode()
    with pytest.raises(InputError, match=r"no frame to use \(frames with an invalid pose: 3\)"):
        read_scan3r_sequence(recording.folder(tmp_path))
    assert not is_scan3r_sequence(tmp_path / "none")
    with pytest.raises(InputError, match="not a recording of 3RScan"):
        read_scan3r_sequence(tmp_path / "none")


@pytest.mark.parametrize(
    ("line", "instead", "message"),
    [
        ("m_colorWidth = 192", "m_colorWidth = 0", "camera"),
        ("m_colorWidth = 192", "m_colorWidth = wide", "m_colorWidth is 'wide'"),
        ("m_depthShift = 1000", "m_depthShift = 0", "units per metre"),
        ("Intrinsic = 150 0", "Intrinsic = 150", "it must be 16 finite"),
        ("Intrinsic = 150 0", "Intrinsic = nan 0", "it must be 16 finite"),
        ("m_depthHeight = 43\n", "", "m_depthHeight is 'missing'"),
    ],
)
def test_intrinsics_that_cannot_be(recording, tmp_path, line, instead, message):
    recording.files["_info.txt"] = INFO.format(3).replace(line, instead).encode()
    with pytest.raises(InputError, match=message):
        read_scan3r_sequence(recording.folder(tmp_path))


def test_images_of_another_size(recording, tmp_path):
    recording.files["frame-000001.depth.pgm"] = pgm(np.zeros((172, 224), np.uint16))
    file = io.BytesIO()
    Image.new("RGB", (96, 54)).save(file, "JPEG")
    recording.files["frame-000001.color.jpg"] = file.getvalue()
    frame = read_scan3r_sequence(recording.folder(tmp_path))[1]
    with pytest.raises(InputError, match=r"frame-000001.depth.pgm has 224 x 172 pixels"):
        frame.depth()
    with pytest.raises(InputError, match=r"frame-000001.color.jpg has 96 x 54 pixels"):
        frame.rgb()


def test_pgm_values_stand_as_they_are():
    data = b"P5 # depth\n# twice\n3 1\n4000\n" + np.array([1, 3999, 4000], ">u2").tobytes()
    assert read_pgm(data, "a.pgm").tolist() == [[1, 3999, 4000]]
    assert read_pgm(b"P5 2 1 255 \x01\x02", "a.pgm").tolist() == [[1, 2]]
    for broken in (b"", b"P2 1 1 255 1", data[:-1], b"P5 0 1 255 ", b"P5 1 1 99999 ab"):
        with pytest.raises(InputError, match=r"a\.pgm"):
            read_pgm(broken, "a.pgm")


@given(data=st.data(), zipped=st.booleans())
@DAMAGE
def test_only_input_errors_of_spoilt_files(recording, tmp_path, data, zipped):
    recording = Recording()
    if zipped:
        path = recording.zipped(tmp_path / "zipped") / "sequence.zip"
    else:
        name = data.draw(st.sampled_from(sorted(recording.files)))
        path = recording.folder(tmp_path / "plain") / "sequence" / name
    path.write_bytes(data.draw(damaged(path.read_bytes())))
    with refusing():
        for frame in read_scan3r_sequence(tmp_path / ("zipped" if zipped else "plain")):
            for read in (frame.rgb, frame.depth):
                with refusing("frame-0"):
                    read()
