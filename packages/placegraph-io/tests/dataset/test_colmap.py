import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE, damaged, refusing

from placegraph.core.geometry import Camera, quaternion_from_rotation, rotation_from_vector
from placegraph.errors import InputError, OptionError
from placegraph.io.capture.capture import open_capture
from placegraph_io.dataset.colmap import read_depth_map, read_model

TILT = rotation_from_vector([1.9, -0.6, 0.8])
UP = TILT[:, 2]
UNIT = 0.37  # metres in a unit of the model
NUMBERS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "RADIAL": 3, "OPENCV": 4,
           "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "FOV": 7,
           "SIMPLE_RADIAL_FISHEYE": 8, "THIN_PRISM_FISHEYE": 10}  # fmt: skip


class Model:
    def __init__(self, world, *, camera="PINHOLE", parameters=None, names="img{}.jpg"):
        rng = np.random.default_rng(5)
        c = world.cameras[0]
        self.size = c.width, c.height
        self.camera, self.parameters = camera, parameters or (c.fx, c.fy, c.cx, c.cy)
        self.names = [names.format(i) for i in range(len(world))]
        self.poses, self.seen, self.points = [], [], {}
        for i, pose in enumerate(world.poses):
            camera_from_map = np.linalg.inv(pose)
            rotation = camera_from_map[:3, :3] @ TILT.T
            offset = camera_from_map[:3, 3] / UNIT - rotation @ [5.0, -3.0, 8.0]
            self.poses.append((quaternion_from_rotation(rotation)[[3, 0, 1, 2]], offset))
            good = np.argwhere((world.metres[i] > 0) & (world.sure[i] > 0))
            rows, columns = rng.choice(good, 60).T
            uv = np.stack([columns, rows], axis=-1) + 0.5
            depth = world.metres[i][rows, columns, None]
            points = world.depth_cameras[i].directions(uv) * depth
            points = (points @ pose[:3, :3].T + pose[:3, 3]) / UNIT @ TILT.T + [5.0, -3.0, 8.0]
            points[:5] *= 3.0  # outliers
            ids = 1000 * i + np.arange(len(points))
            self.points.update(zip(ids.tolist(), points, strict=True))
            shown = c.width / world.depth_cameras[i].width
            self.seen.append((np.append(uv * shown, [[3.0, 4.0]], axis=0), [*ids.tolist(), -1]))

    def binary(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        n, values = len(self.parameters), self.parameters
        data = struct.pack(f"<QIiQQ{n}d", 1, 7, NUMBERS[self.camera], *self.size, *values)
        (folder / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(self.names))
        for i, (name, (q, t), (uv, ids)) in enumerate(
            zip(self.names, self.poses, self.seen, strict=True)
        ):
            data += struct.pack("<I7dI", i + 1, *q, *t, 7) + name.encode() + b"\0"
            data += struct.pack("<Q", len(ids))
            for (u, v), k in zip(uv, ids, strict=True):
                data += struct.pack("<ddQ", u, v, k % (1 << 64))
        (folder / "images.bin").write_bytes(data)
        data = struct.pack("<Q", len(self.points))
        for k, xyz in self.points.items():
            data += struct.pack("<Q3d3BdQ", k, *xyz, 1, 2, 3, 0.5, 2) + struct.pack(
                "<4I", 1, 2, 3, 4
            )
        (folder / "points3D.bin").write_bytes(data)

    def text(self, folder):
        folder.mkdir(parents=True, exist_ok=True)
        row = " ".join(map(str, ["7", self.camera, *self.size, *self.parameters]))
        (folder / "cameras.txt").write_text(f"# Camera list\n{row}\n")
        rows = ["# Image list with two lines of data per image:"]
        for i, (name, (q, t), (uv, ids)) in enumerate(
            zip(self.names, self.poses, self.seen, strict=True)
        ):
            rows.append(" ".join(map(str, [i + 1, *q, *t, 7, name])))
            rows.append(" ".join(f"{u} {v} {k}" for (u, v), k in zip(uv, ids, strict=True)))
        (folder / "images.txt").write_text("\n".join(rows) + "\n")
        rows = [f"{k} {x} {y} {z} 1 2 3 0.5 1 2" for k, (x, y, z) in self.points.items()]
        (folder / "points3D.txt").write_text("# 3D point list\n" + "\n".join(rows) + "\n")


def images(path, world, model, save, *, depth="depth/{}.png"):
    for i, name in enumerate(model.names):
        save(path / "images" / name, world.rgb[i], quality=97)
        if depth:
            save(path / depth.format(name.rpartition(".")[0]), world.units(i))
    return path


def own_depth(path, world, model):
    folder = path / "stereo" / "depth_maps"
    for i, name in enumerate(model.names):
        depth = np.where(world.metres[i] > 0, world.metres[i] / UNIT, 0.0).astype("<f4")
        file = folder / f"{name}.geometric.bin"
        file.parent.mkdir(parents=True, exist_ok=True)
        h, w = depth.shape
        file.write_bytes(b"%d&%d&1&" % (w, h) + depth.tobytes())


def check(world, capture, **options):
    map_from_world = world.poses[0] @ np.linalg.inv(capture[0].odometry)
    tilt = np.degrees(np.arccos(min(1.0, map_from_world[2, 2])))
    assert tilt < 0.6, capture.notes
    world.check(capture, map_from_world=map_from_world, sure=False, near=0.02, **options)


@pytest.mark.parametrize(
    ("form", "where"), [("binary", "."), ("text", "sparse"), ("binary", "sparse/0")]
)
def test_points_and_colours(form, where, recorded, save, tmp_path):
    world = recorded(frames=12)
    model = Model(world)
    getattr(model, form)(tmp_path / where)
    capture = open_capture(images(tmp_path, world, model, save))
    check(world, capture)
    said = " ".join(capture.notes)
    assert "The unit of the COLMAP model is 0.37" in said
    assert re.search(r"at 6[0-9][0-9] sparse points", said)
    assert "horizontal and vertical surfaces show" in said


@pytest.mark.parametrize(
    ("camera", "parameters"),
    [
        ("SIMPLE_PINHOLE", (80.0, 49.5, 35.0)), ("SIMPLE_RADIAL", (80.0, 49.5, 35.0, 0.04)),
        ("RADIAL", (80.0, 49.5, 35.0, 0.04, -0.01)),
        ("OPENCV", (80.0, 80.0, 49.5, 35.0, 0.04, -0.01, 0.002, -0.003)),
        ("FULL_OPENCV", (80.0, 80.0, 49.5, 35.0, 0.04, -0.01, 0.002, -0.003, 0.01, 0.0, 0.0, 0.0)),
        ("SIMPLE_RADIAL_FISHEYE", (80.0, 49.5, 35.0, 0.04)),
        ("OPENCV_FISHEYE", (80.0, 80.0, 49.5, 35.0, 0.04, -0.01, 0.002, -0.003)),
    ],
)  # fmt: skip
def test_camera_models(camera, parameters, recorded, save, tmp_path):
    given = {4: 1, 5: 2}.get(len(parameters), len(parameters) - 4) if len(parameters) > 3 else 0
    distortion = [*parameters[len(parameters) - given :], 0, 0, 0, 0] if given else []
    distortion = tuple(float(v) for v in distortion[: max(4, given)]) if given else ()
    lens = "fisheye" if "FISHEYE" in camera else "opencv"
    drawn = Camera(96, 72, 80.0, 80.0, 49.5, 35.0, distortion, lens)
    world = recorded(camera=drawn, frames=3)
    model = Model(world, camera=camera, parameters=parameters)
    for form in ("binary", "text"):
        folder = tmp_path / form
        getattr(model, form)(folder / "sparse/0")
        capture = open_capture(images(folder, world, model, save), up=UP)
        assert capture.camera == drawn
        check(world, capture)


@pytest.mark.parametrize("camera", ["THIN_PRISM_FISHEYE", "FOV"])
def test_other_camera_models(camera, recorded, save, tmp_path):
    world = recorded()
    parameters = (80.0, 80.0, 49.5, 35.0, *(0.1,) * (8 if "FISH" in camera else 1))
    model = Model(world, camera=camera, parameters=parameters)
    for form in ("binary", "text"):
        getattr(model, form)(tmp_path / form)
        images(tmp_path / form, world, model, save)
        with pytest.raises(InputError, match=rf"{camera} is not supported.*image_undistorter"):
            open_capture(tmp_path / form)


def test_depth_of_colmaps_own(recorded, save, tmp_path):
    world = recorded(frames=12)
    model = Model(world, names="a b/img{}.jpg")
    model.binary(tmp_path / "sparse")
    images(tmp_path, world, model, save, depth=None)
    own_depth(tmp_path, world, model)
    check(world, open_capture(tmp_path, scale=UNIT))
    capture = open_capture(tmp_path)
    assert "is assumed to be the metre, because" in capture.notes[0]
    units = open_capture(tmp_path, scale=1.0)[0].depth()
    np.testing.assert_array_equal(capture[0].depth(), units)


def test_given_scale_and_direction(recorded, save, tmp_path):
    world = recorded(frames=2)
    model = Model(world)
    model.binary(tmp_path / "sparse/0")
    images(tmp_path, world, model, save)
    capture = open_capture(tmp_path, up=2.0 * UP, scale=UNIT)
    check(world, capture)
    assert all("given" in note for note in capture.notes)
    twice = open_capture(tmp_path, up=2.0 * UP, scale=2 * UNIT).odometry[:, :3, 3]
    np.testing.assert_allclose(twice, 2 * capture.odometry[:, :3, 3], atol=1e-9)
    for options in ({"scale": 0.0}, {"scale": np.nan}, {"up": [0, 0, 0]}, {"up": [1, 2]}):
        with pytest.raises(OptionError, match=r"scale is|up is"):
            open_capture(tmp_path, **options)


def test_missing_images_are_counted(recorded, save, tmp_path):
    world = recorded(frames=12)
    model = Model(world)
    model.binary(tmp_path / "sparse/0")
    images(tmp_path, world, model, save, depth="depth/{}.jpg.png")
    (tmp_path / "images/img3.jpg").unlink()
    (tmp_path / "depth/img10.jpg.png").unlink()
    capture = open_capture(tmp_path)
    assert capture.left_out == {"no colour image": 1, "no depth": 1}
    check(world, capture, rows=[i for i in range(12) if i not in {3, 10}])


def test_depth_that_is_missing_or_tells_no_scale(recorded, save, tmp_path):
    world = recorded()
    model = Model(world)
    model.binary(tmp_path / "sparse/0")
    images(tmp_path, world, model, save, depth=None)
    with pytest.raises(InputError, match="has no depth, which a map needs: add depth/"):
        open_capture(tmp_path)
    (tmp_path / "depth").mkdir()
    with pytest.raises(InputError, match="no image with both colour and depth"):
        open_capture(tmp_path)
    images(tmp_path, world, model, save)
    (tmp_path / "sparse/0/points3D.bin").unlink()
    with pytest.raises(InputError, match="has depth at only 0 sparse points of the"):
        open_capture(tmp_path)
    check(world, open_capture(tmp_path, scale=UNIT, up=UP))


def test_depth_of_another_size_or_kind(recorded, save, tmp_path):
    world = recorded()
    model = Model(world)
    model.binary(tmp_path / "sparse/0")
    images(tmp_path, world, model, save)
    save(tmp_path / "depth/img1.png", np.ones((10, 10), np.uint16))
    with pytest.raises(InputError, match="10 x 10 pixels, but its camera has 48 x 36"):
        open_capture(tmp_path)
    own_depth(tmp_path, world, model)
    (tmp_path / "depth/img1.png").unlink()
    with pytest.raises(InputError, match="two kinds of depth"):
        open_capture(tmp_path)


def test_names_that_lead_elsewhere(recorded, tmp_path):
    world = recorded()
    model = Model(world, names="../img{}.jpg")
    model.binary(tmp_path / "sparse/0")
    (tmp_path / "depth").mkdir()
    with pytest.raises(InputError, match="lies outside the folder; rename the image"):
        open_capture(tmp_path)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("form", ["binary", "text"])
def test_truncated_models(name, form, recorded, tmp_path):
    getattr(Model(recorded()), form)(tmp_path)
    path = tmp_path / f"{name}.{'bin' if form == 'binary' else 'txt'}"
    whole = path.read_bytes()
    cuts = [*range(0, min(len(whole), 120), 3), *range(120, len(whole), 1201), len(whole) - 1]
    for size in cuts:
        path.write_bytes(whole[:size])
        if form == "binary":
            with pytest.raises(InputError, match=rf"{name}.bin.*(truncated)"):
                read_model(tmp_path)
            continue
        with refusing(tmp_path):  # a text may be whole before its end
            read_model(tmp_path)


@DAMAGE
@given(data=st.data())
def test_damaged_models(data, recorded, tmp_path):
    form = data.draw(st.sampled_from(["binary", "text"]))
    folder = tmp_path / form
    getattr(Model(recorded()), form)(folder)
    file = data.draw(st.sampled_from(sorted(folder.iterdir())))
    file.write_bytes(data.draw(damaged(file.read_bytes(), within=300)))
    with refusing(folder):
        read_model(folder)


@given(st.binary(max_size=80) | st.builds(lambda b: b"2&2&1&" + b, st.binary(max_size=20)))
@DAMAGE
def test_damaged_depth_maps(tmp_path, content):
    path = tmp_path / "a.geometric.bin"
    path.write_bytes(content)
    with refusing(path.name):
        assert read_depth_map(path).ndim == 2


def test_a_pose_that_is_no_number(recorded, tmp_path):
    world = recorded()
    model = Model(world)
    model.poses[2] = (model.poses[2][0], np.array([0.0, np.nan, 0.0]))
    for form in ("binary", "text"):
        getattr(model, form)(tmp_path / form)
        with pytest.raises(InputError, match=r"finite"):
            read_model(tmp_path / form)
