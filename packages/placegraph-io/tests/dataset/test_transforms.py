import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.io.damage import DAMAGE

from placegraph.errors import InputError, OptionError, PlacegraphError
from placegraph.io.capture.capture import open_capture

OPENGL = np.diag([1.0, -1, -1, 1])
Z_UP = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])
"""nerfstudio_from_arkit, of Polycam."""


def of_camera(c, *, size=True):
    said = {"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy}
    return said | ({"w": c.width, "h": c.height} if size else {})


def nerfcapture(path, world, save):
    step, frames = 10.0 / 65535, []
    for i in range(len(world)):
        save(path / "images" / f"{i}.png", world.rgb[i])
        save(path / "images" / f"{i}.depth.png", np.rint(world.metres[i] / step).astype(np.uint16))
        said = {"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png"}
        said |= {"transform_matrix": world.arkit(i).tolist()}
        frames.append(said | of_camera(world.cameras[i]))
    return of_camera(world.cameras[0]) | {"integer_depth_scale": step, "frames": frames}


def frames_of(path, world, save, *, rgb, depth, poses):
    frames = []
    for i in range(len(world)):
        save(path / rgb.format(i), world.rgb[i], **({"quality": 97} if rgb.endswith("jpg") else {}))
        frame = {"file_path": f"./{rgb.format(i)}", "transform_matrix": poses[i].tolist()}
        if depth:
            save(path / depth.format(i), world.units(i))
            frame["depth_file_path"] = f"./{depth.format(i)}"
        frames.append(frame)
    return frames


def polycam(path, world, save):
    poses = [Z_UP @ world.arkit(i) for i in range(len(world))]
    names = {"rgb": "images/frame_{:05d}.jpg", "depth": "depth/frame_{:05d}.png"}
    frames = frames_of(path, world, save, **names, poses=poses)
    for frame, camera in zip(frames, world.cameras, strict=True):
        frame.update(of_camera(camera))
    return {"camera_model": "OPENCV", "orientation_override": "none", "frames": frames}


def spectacular(path, world, save):
    said = {"k1": 0, "k2": 0, "p1": 0, "p2": 0, "aabb_scale": 16} | of_camera(world.cameras[0])
    names = {"rgb": "images/frame_{:05}.png", "depth": "images/depth_{:05}.png"}
    return said | {"frames": frames_of(path, world, save, **names, poses=world.poses @ OPENGL)}


def record3d(path, world, save):
    poses = [world.arkit(i) for i in range(len(world))]
    frames = frames_of(path, world, save, rgb="images/frame_{:05d}.png", depth=None, poses=poses)
    return of_camera(world.cameras[0]) | {"camera_model": "OPENCV", "frames": frames}


WRITERS = {
    "nerfcapture": nerfcapture, "polycam": polycam, "spectacular": spectacular, "record3d": record3d,
}  # fmt: skip


def write(path, world, save, writer="nerfcapture", **changes):
    content = WRITERS[writer](path, world, save) | changes
    (path / "transforms.json").write_text(json.dumps(content))
    return path


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("turns", [0, 1])
def test_points_and_colours(writer, turns, recorded, save, tmp_path):
    world = recorded(turns=turns, frames=8)
    capture = open_capture(write(tmp_path, world, save, writer))
    # the world's heading is the writer's own
    shift = world.poses[0] @ np.linalg.inv(stored(capture[0], turns))
    check = world.check_views if writer == "record3d" else world.check
    check(capture, map_from_world=shift, **({} if writer == "record3d" else {"sure": False}))
    assert "Up is" in capture.notes[0]


def stored(frame, turns):
    turn = np.linalg.matrix_power(np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]]), turns)
    pose = frame.odometry.copy()
    pose[:3, :3] = pose[:3, :3] @ turn
    return pose


def test_up_where_nothing_tells(recorded, save, tmp_path):
    write(tmp_path, recorded(), save, "record3d")
    content = json.loads((tmp_path / "transforms.json").read_text())
    along_x = np.eye(4)[[2, 0, 1, 3]]  # y and z lie in the image
    content["frames"] = [content["frames"][0] | {"transform_matrix": along_x.tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"give up=\(0, 1, 0\)"):
        open_capture(tmp_path)
    assert open_capture(tmp_path, up=(0, 0, 1)).notes == ("Up is 0 0 1, as given.",)
    with pytest.raises(OptionError, match="up is"):
        open_capture(tmp_path, up=(0, 0))


def one(**said):
    return {"frames": [{"transform_matrix": np.eye(4).tolist()} | said]}


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"frames": []}, "not a list of objects"), ({"frames": [3]}, "not a list of objects"),
        (one(transform_matrix=[[1] * 4] * 4), "is not a rotation and translation"),
        (one(transform_matrix="a"), "4 x 4 numbers"),
        (one(transform_matrix=[[1, 2], [3]]), "4 x 4 numbers"),
        (one(), "not the name of an image"),
        (one(file_path="../../etc/passwd"), "is missing; copy"),
        (one(file_path="images/0", sharpness=1.0), "COLMAP"),
        (one(file_path="nothing"), "1: no colour image"),
        (one(file_path="images/0", depth_file_path="a" * 300), "is missing; copy"),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR"),
        ({"integer_depth_scale": 77}, "metres per depth unit"),
        (one(file_path="images/0", h=float("inf")), "w and h are"),
        (one(file_path="images/0", w=10**400), "out of range"),
    ],
)  # fmt: skip
def test_wrong_files(changes, says, recorded, save, tmp_path):
    write(tmp_path, recorded(), save, **changes)
    with pytest.raises(InputError, match=says):
        open_capture(tmp_path)


@DAMAGE
@given(
    field=st.sampled_from(
        ["fl_x", "cx", "w", "h", "k1", "camera_model", "timestamp", "file_path", "depth_path"]
    ),
    value=st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=4)
    | st.lists(st.integers(), max_size=3),
)  # fmt: skip
def test_whatever_stands_in_a_field(recorded, save, tmp_path, field, value):
    if not (tmp_path / "transforms.json").exists():
        write(tmp_path, recorded(), save)
        (tmp_path / "good").write_text((tmp_path / "transforms.json").read_text())
    content = json.loads((tmp_path / "good").read_text())
    content["frames"][1][field] = value
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    with contextlib.suppress(PlacegraphError):
        frame = open_capture(tmp_path)[1]
        frame.rgb(), frame.depth()
