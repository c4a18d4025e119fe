import json

import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.errors import InputError
from placegraph.indoor.map.mesh import Mesh
from placegraph.indoor.scene_map import SceneMap
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph.io.capture.tum import write_tum
from placegraph_lab.tables.indoor.windows import Window, house_windows, measure_coverage

CAMERA = Camera(60, 40, 40.0, 40.0, 30.0, 20.0)
LEVEL = level_from_camera([0.0, 1.0, 0.0])


def write_capture(folder, count, changed=None):
    """A folder of `count` grey frames that walk along x."""
    (folder / "rgb").mkdir(parents=True)
    for i in range(count):
        Image.new("RGB", (60, 40), (90, 90, 90)).save(folder / f"rgb/{i:06d}.png")
    poses = pose_matrix([[0.1 * i, 2.0, 1.6, 0.0] for i in range(count)], LEVEL)
    write_tum(folder / "trajectory.tum", np.arange(count), poses)
    write_tum(folder / "odometry.tum", np.arange(count), np.linalg.inv(poses[0]) @ poses)
    camera = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps(camera))
    gravity = "\n".join(f"{i} 0 1 0" for i in range(count))
    (folder / "gravity.txt").write_text(gravity)
    if changed is not None:
        (folder / "changes.json").write_text(json.dumps({"changed": changed}))


def test_windows_of_a_house(tmp_path):
    write_capture(tmp_path / "seq00", 25, changed=False)
    write_capture(tmp_path / "seq01", 20, changed=True)
    write_capture(tmp_path / "map", 3)
    found = house_windows(tmp_path, 10)
    assert [w.name for w in found] == [
        "seq00 0:10", "seq00 5:15", "seq00 10:20", "seq00 13:23", "seq00 15:25",
        "seq01 0:10", "seq01 5:15", "seq01 10:20",
    ]  # fmt: skip
    assert [w.changed for w in found] == [False] * 5 + [True] * 3
    assert [w.truth[0, 3] for w in found[:3]] == pytest.approx([0.9, 1.4, 1.9])
    assert all(len(w.capture) == 10 for w in found)
    assert {w.place for w in house_windows(tmp_path, 5, sequences=["seq01"])} == {"seq01"}


def test_nothing_of_the_truth_is_in_a_window(tmp_path):
    write_capture(tmp_path / "seq00", 6)
    (window,) = house_windows(tmp_path, 5)
    (tmp_path / "seq00/trajectory.tum").unlink()
    assert [f.rgb().shape for f in window.capture] == [(40, 60, 3)] * 5
    with pytest.raises(InputError, match="trajectory"):
        house_windows(tmp_path, 5)


def test_coverage_is_what_the_map_holds():
    """A wall 3 m ahead that reaches the middle of the image; behind it nothing."""
    corners = np.array([[3.0, 0, 0], [3, 9, 0], [3, 9, 5], [3, 0, 5]])
    mesh = Mesh.plain(corners, [[0, 1, 2], [0, 2, 3]])
    scene = SceneMap.create(mesh, ["0"], ["wall"], floor=0.0)
    depth = np.full((40, 60), 3.05, np.float32)
    depth[:20, :30] = 2.5  # something before the wall, above on the left
    depth[20:, 30:] = np.nan
    frame = Frame.from_arrays(np.zeros((40, 60, 3), np.uint8), CAMERA, depth=depth)
    truth = pose_matrix([0.0, 0.0, 1.6, 0.0], LEVEL)  # left of the image is y > 0
    window = Window("w", Capture.from_frames([frame]), truth)
    assert measure_coverage(scene, window, step=1).coverage == pytest.approx(1 / 3, abs=0.01)
    blank = Frame.from_arrays(frame.rgb(), CAMERA, depth=np.zeros((40, 60)))
    assert measure_coverage(scene, Window("w", Capture.from_frames([blank]), truth)).coverage == 0.0
    none = Window("w", Capture.from_frames([Frame.from_arrays(frame.rgb(), CAMERA)]), truth)
    assert measure_coverage(scene, none).coverage is None
