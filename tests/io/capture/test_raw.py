"""Recordings in layouts without a reader become capture folders."""

import json

import numpy as np
import pytest

from placegraph.core.geometry import Camera, quaternion_from_rotation
from placegraph.errors import InputError
from placegraph.io.capture.capture import open_capture
from placegraph.io.capture.raw import RawOptions, read_poses, read_raw, write_capture

VGA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
ICL = Camera(640, 480, 481.2, 480.0, 320.0, 240.0)
OPENGL = np.diag([1.0, -1, -1, 1])
MIRROR = np.diag([1.0, -1, 1, 1])
FIRST = np.array([[1.0, 0, 0, 0.3], [0, 0, -1, 0.5], [0, 1, 0, -0.2], [0, 0, 0, 1]])
"""World of a recorder that calls y down, as one does whose first camera is the world: from z up."""


def rows(poses, tall=4):
    return "\n".join(" ".join(f"{v:.9f}" for v in line) for pose in poses for line in pose[:tall])


def quaternions(poses, *, first=False):
    xyzw = quaternion_from_rotation(poses[:, :3, :3])
    turned = xyzw[:, [3, 0, 1, 2]] if first else xyzw
    return np.hstack([poses[:, :3, 3], turned])


def write_images(path, world, save, *, rgb, depth, per_metre=1000, encode=lambda units: units):
    for i in range(len(world)):
        save(path / rgb.format(i), world.rgb[i])
        save(path / depth.format(i), encode(world.units(i, per_metre)))


def check(world, path, tmp_path, given=None):
    """Check the capture that is read, written and opened again."""
    capture = read_raw(path, given or RawOptions())
    out = tmp_path / "out"
    write_capture(capture, out)
    back = open_capture(out)
    to_map = world.poses[0] @ np.linalg.inv(back[0].odometry)
    assert abs(to_map[2, 2]) > 0.999, "up is found"
    world.check(back, map_from_world=to_map, sure=False)
    return capture


@pytest.fixture
def vga(recorded):
    return recorded(camera=VGA, shrink=4)


def test_seven_scenes(vga, save, tmp_path):
    seq = tmp_path / "seq-01"
    write_images(
        seq, vga, save, rgb="frame-{:06d}.color.png", depth="frame-{:06d}.depth.png",
        encode=lambda units: np.where(units == 0, 65535, units).astype(np.uint16),
    )  # fmt: skip
    for i, pose in enumerate(FIRST @ vga.poses):
        (seq / f"frame-{i:06d}.pose.txt").write_text(rows([pose]))
    capture = check(vga, seq, tmp_path)
    assert capture.camera == VGA
    assert (
        "--axes opencv --pose camera-to-world --depth-unit 1000 --depth-kind z" in capture.notes[0]
    )


def test_sun3d(recorded, save, tmp_path):
    world, scan = recorded(shrink=1), tmp_path / "study"
    for i in range(len(world)):
        units = world.units(i).astype(np.int64)
        save(scan / f"image/{i + 1:07d}-{33367 * i:012d}.jpg", world.rgb[i], quality=97)
        rotated = (units << 3 & 0xFFFF | units >> 13).astype(np.uint16)
        save(scan / f"depth/{i + 1:07d}-{33367 * i + 9000:012d}.png", rotated)
    c = world.cameras[0]
    (scan / "intrinsics.txt").write_text(f"{c.fx} 0 {c.cx}\n0 {c.fy} {c.cy}\n0 0 1\n")
    (scan / "extrinsics").mkdir()
    (scan / "extrinsics/20140101.txt").write_text("0 0 0 0\n")
    (scan / "extrinsics/20140202.txt").write_text(rows(FIRST @ world.poses, 3))
    check(world, scan, tmp_path)


def test_icl_nuim(recorded, save, tmp_path):
    world, path = recorded(camera=ICL, shrink=4), tmp_path / "living"
    write_images(path, world, save, rgb="rgb/{}.png", depth="depth/{}.png", per_metre=5000)
    poses = MIRROR @ FIRST @ world.poses @ MIRROR
    table = [f"{i} " + " ".join(map(str, row)) for i, row in enumerate(quaternions(poses))]
    (path / "livingRoom0.gt.freiburg").write_text("\n".join(table))
    with pytest.raises(InputError, match=r"lacks camera.json and odometry.tum.*capture init"):
        open_capture(path)
    assert "mirrored" in check(world, path, tmp_path).notes[0]


def test_icl_nuim_of_povray(recorded, save, tmp_path):
    world, path = recorded(camera=ICL, shrink=4), tmp_path / "office"
    v, u = np.mgrid[:120, :160] + 0.5
    rays = ICL.resize(160, 120).directions(np.stack([u, v], -1))
    long = np.linalg.norm(rays, axis=-1)
    for i, pose in enumerate(MIRROR @ FIRST @ world.poses @ MIRROR):
        stem = path / f"scene_00_{i:04d}"
        save(stem.with_suffix(".png"), world.rgb[i])
        stem.with_suffix(".depth").write_text(
            " ".join(f"{d:.4f}" for d in (world.metres[i] * long).flat)
        )
        fields = {
            "pos": pose[:3, 3],
            "dir": pose[:3, 2],
            "up": pose[:3, 1],
            "right": pose[:3, 0] * 1.33,
        }
        stem.with_suffix(".txt").write_text("".join(
            f"cam_{name} = [{', '.join(map(str, value))}]';\n" for name, value in fields.items()
        ))  # fmt: skip
    assert "--depth-unit 1 --depth-kind range" in check(world, path, tmp_path).notes[0]


@pytest.fixture
def hololens(recorded, save, tmp_path):
    """Writes a recording like DeepVideoMVS' samples of HoloLens, with any poses."""

    def write(make=lambda poses: poses, per_metre=1000):
        world, path = recorded(refocus=0.0), tmp_path / "hololens"
        write_images(path, world, save, rgb="images/{:05d}.png", depth="depth/{:05d}.png",
                     per_metre=per_metre)  # fmt: skip
        c = world.cameras[0]
        (path / "K.txt").write_text(f"{c.fx} 0 {c.cx}\n0 {c.fy} {c.cy}\n0 0 1\n")
        poses = make(world.poses)
        (path / "poses.txt").write_text("\n".join(" ".join(map(str, p.ravel())) for p in poses))
        return world, path

    return write


@pytest.mark.parametrize(
    ("make", "per_metre", "says"),
    [
        (lambda poses: poses, 1000, "--axes opencv --pose camera-to-world --depth-unit 1000"),
        (lambda poses: poses @ OPENGL, 1000, "--axes opengl --pose camera-to-world"),
        (np.linalg.inv, 1000, "--axes opencv --pose world-to-camera"),
        (lambda poses: np.linalg.inv(poses @ OPENGL), 5000,
         r"--axes opengl --pose world-to-camera --depth-unit 5000"),
        (lambda poses: poses.swapaxes(1, 2), 1000, "--axes opencv --pose camera-to-world"),
        (quaternions, 1000, "--quaternion xyzw"),
        (lambda poses: quaternions(poses, first=True), 1000, "--quaternion wxyz"),
    ],
)  # fmt: skip
def test_hololens_in_every_convention(make, per_metre, says, hololens, tmp_path):
    world, path = hololens(make, per_metre)
    assert says in check(world, path, tmp_path).notes[0]


def test_swapped_conventions_are_named(hololens):
    _, path = hololens(lambda poses: poses @ OPENGL)
    with pytest.raises(
        InputError, match=r"\d+% .* by --axes opencv, but .*--axes opengl.*give these"
    ):
        read_raw(path, RawOptions(axes="opencv"))
    (path / "poses.txt").write_text((path / "poses.txt").read_text()[::-1].replace("e", "1"))
    with pytest.raises(InputError, match=r"poses of these images"):
        read_raw(path, RawOptions())
    rng = np.random.default_rng(0)
    _, path = hololens(lambda poses: poses[rng.permutation([2, 3, 0, 1])])
    with pytest.raises(InputError, match="check that the poses are of these images"):
        read_raw(path, RawOptions())
    _, path = hololens()
    with pytest.raises(InputError, match="is not empty"):
        write_capture(read_raw(path, RawOptions()), path)


def test_everything_that_lacks_is_named_at_once(tmp_path):
    with pytest.raises(InputError, match=r"colour images: --images.*poses of.*intrinsics: --in"):
        read_raw(tmp_path, RawOptions())
    for name in ("color/0.jpg", "color/1.jpg", "depth/0.png", "poses.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InputError) as caught:
        open_capture(tmp_path)
    found, nearest, command = str(caught.value).splitlines()
    assert "contains 2 x *.jpg in color/, depth/0.png, poses.txt." in found
    assert nearest.endswith("missing.")
    assert f"`placegraph capture init {tmp_path}`" in command


def test_a_log_of_redwood(tmp_path):
    file = tmp_path / "a.log"
    poses = np.tile(np.eye(4), (3, 1, 1)) + np.arange(3)[:, None, None] * np.eye(4)[:, [3, 0, 1, 2]]
    poses[:, 3] = 0, 0, 0, 1
    text = "".join(f"{i} {i} {i + 1}\n{rows([p])}\n" for i, p in enumerate(poses))
    file.write_text(text)
    np.testing.assert_allclose(read_poses(file)[1], poses)


def test_one_frame_alone(hololens):
    _, path = hololens()
    for file in path.glob("*/0000[1-3].png"):
        file.unlink()
    table = path / "poses.txt"
    table.write_text(table.read_text().splitlines()[0])
    capture = read_raw(path, RawOptions(up="0,0,1"))
    assert "nothing confirms --axes opencv" in capture.notes[0]
    assert capture[0].depth().shape == (36, 48)


def test_intrinsics_for_each_image(hololens, tmp_path):
    _, path = hololens()
    write_capture(read_raw(path, RawOptions()), tmp_path / "out")
    (tmp_path / "out/intrinsics.txt").write_text(
        "".join(f"{i} {80 + i} 81 49 35\n" for i in range(4))
    )
    capture = open_capture(tmp_path / "out")
    assert [f.camera.fx for f in capture] == [80, 81, 82, 83]
    assert [f.depth_camera.fx for f in capture] == [40, 40.5, 41, 41.5]


def test_a_negative_focal_length(hololens, tmp_path):
    _, path = hololens()
    write_capture(read_raw(path, RawOptions()), tmp_path / "out")
    file = tmp_path / "out/camera.json"
    camera = json.loads(file.read_text()) | {"fy": -80, "cx": None}
    file.write_text(json.dumps(camera))
    with pytest.raises(InputError, match=r"cx is missing; fy is -80, so .*capture init"):
        open_capture(tmp_path / "out")
