"""`placegraph scene render`: pictures of a drawn room, and what is refused."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from tests.cli.failing import fails

from placegraph import open_capture, open_map
from placegraph.cli.scene_options import map_from_camera_of
from placegraph.core.geometry import split_pose
from placegraph.errors import OptionError
from placegraph.indoor.render import render
from placegraph.io.capture.tum import write_tum

FILES = ["colour.png", "depth.png", "objects.png", "objects.json", "objects_preview.png"]


@pytest.fixture(scope="module")
def world(room, tmp_path_factory):
    folder, frames = tmp_path_factory.mktemp("render"), [1, 5]
    told = {
        "status": "OK", "reason": "Drawn.", "frames": frames,
        "trajectory": room.truth[frames].tolist(),
        "modes": [{"map_from_camera": room.truth[k].tolist()} for k in (5, 0)],
    }  # fmt: skip
    (folder / "est.json").write_text(json.dumps(told), encoding="utf-8")
    return SimpleNamespace(
        map=room.map, walk=room.walk, truth=room.truth, camera=room.walk / "camera.json",
        estimate=folder / "est.json", told=told,
    )  # fmt: skip


@pytest.fixture
def draw(run, world, tmp_path):
    """Render the map into the folder `out`."""
    return lambda *options: run("scene", "render", world.map, "-o", tmp_path / "out", *options)


def read(path):
    with Image.open(path) as image:
        return np.asarray(image)


def at(pose):
    (x, y, z, yaw), _ = split_pose(pose)
    forward, right = pose[:3, 2], pose[:3, 0]
    pitch = np.arcsin(forward[2])
    roll = np.arcsin(-right[2] / np.cos(pitch))
    return ",".join(f"{v:.9f}" for v in (x, y, z, *np.degrees([yaw, pitch, roll])))


def test_pictures_from_a_pose(run, world, tmp_path):
    out = tmp_path / "new" / "out"
    pose = world.truth[2]
    result = run(
        "scene", "render", world.map, "-o", out, "--pose", at(pose), "--camera", world.camera
    )
    assert (result.code, result.err) == (0, "")
    assert sorted(f.name for f in out.iterdir()) == sorted(FILES)
    assert all(name in result.out for name in FILES)
    assert "The map fills 100% of the picture" in result.out

    scene, camera = open_map(world.map), open_capture(world.walk).camera
    drawn = render(scene, pose, camera)
    assert np.abs(read(out / "colour.png").astype(int) - drawn.colour).mean() < 0.1
    depth = read(out / "depth.png")
    assert depth.dtype == np.uint16
    assert np.abs(depth / 1000.0 - drawn.depth).max() < 0.02
    values = read(out / "objects.png")
    assert (values.astype(int) - 1 == drawn.objects).mean() > 0.999
    named = json.loads((out / "objects.json").read_text(encoding="utf-8"))
    assert set(named) == {str(v) for v in np.unique(values)}
    for value, told in named.items():
        row = int(value) - 1
        assert (told["id"], told["label"]) == (scene.graph.ids[row], scene.graph.labels[row])
        assert told["share"] == pytest.approx((values == int(value)).mean(), abs=1e-6)
    preview = read(out / "objects_preview.png")
    assert preview.shape == drawn.colour.shape
    assert not (out / "overlay.png").exists()


def test_a_pose_is_laid_over_its_frame(draw, world, tmp_path):
    def render_json(*options):
        result = draw("--capture", world.walk, "--json", *options)
        assert (result.code, result.err) == (0, "")
        return result.json

    answer = render_json("--estimate", world.estimate)
    assert answer["frame"] == 5
    np.testing.assert_allclose(answer["map_from_camera"], world.truth[5])
    assert [*FILES, "overlay.png"] == [f.rsplit("/", 1)[-1] for f in answer["files"]]
    sheet = read(tmp_path / "out/overlay.png")
    query = read(sorted((world.walk / "rgb").iterdir())[5])
    band = (sheet.shape[0] - 8) // 2 - 90
    np.testing.assert_array_equal(sheet[band : band + 90, :160], query)
    np.testing.assert_array_equal(sheet[band : band + 90, 168:], read(tmp_path / "out/colour.png"))

    for options, frame, row in (
        (("--estimate", world.estimate, "--frame", 1), 1, 1),
        (("--estimate", world.estimate, "--frame", -1), 5, 5),
        (("--estimate", world.estimate, "--mode", 2), 5, 0),
        (("--pose", at(world.truth[1])), 5, 1),
        (("--pose", at(world.truth[1]), "--frame", "0"), 0, 1),
    ):
        answer = render_json(*options)
        assert answer["frame"] == frame
        np.testing.assert_allclose(answer["map_from_camera"], world.truth[row], atol=1e-6)
    assert answer["covered"] == 1.0
    assert len(answer["depth_m"]) == 2
    assert answer["objects"][0]["share"] >= answer["objects"][-1]["share"]


def test_poses_of_a_tum_file(draw, world, tmp_path):
    tum = tmp_path / "walk.tum"
    stamps = [frame.stamp for frame in open_capture(world.walk)]
    write_tum(tum, stamps[1:], world.truth[1:])

    for options, row in (
        (("--capture", world.walk, "--frame", 2), 2),
        (("--capture", world.walk), 5),
        (("--camera", world.camera), 5),
        (("--camera", world.camera, "--row", 0), 1),
        (("--camera", world.camera, "--row", -2), 4),
        (("--capture", world.walk, "--frame", 0, "--row", 1), 2),
    ):
        answer = draw("--tum", tum, "--json", *options).json
        np.testing.assert_allclose(answer["map_from_camera"], world.truth[row], atol=1e-6)
    assert answer["frame"] == 0
    refused = draw("--tum", tum, "--capture", world.walk, "--frame", 0)
    fails(refused, 3, "walk.tum", "stamp", "--row")
    fails(draw("--tum", tum, "--camera", world.camera, "--row", 5), 7, "--row is 5", "0 to 4")


def test_an_empty_picture_says_so_and_what_is_too_far_has_no_depth(draw, world, tmp_path):
    out = tmp_path / "out"
    result = draw("--pose", "500,0,1,0", "--camera", world.camera)
    assert result.code == 0
    assert "empty" in result.out
    assert not read(out / "depth.png").any()
    assert not read(out / "objects.png").any()
    assert json.loads((out / "objects.json").read_text(encoding="utf-8")) == {}
    far = world.truth[0][:2, 3]
    pose = f"{far[0] + 80},{far[1]},1.3,180"
    result = draw("--pose", pose, "--camera", world.camera, "--json")
    assert result.json["depth_m"][0] > 65.5
    assert read(out / "objects.png").any()
    assert not read(out / "depth.png").any()


@pytest.mark.parametrize(
    ("text", "forward", "down"),
    [
        ("1,2,3,0", (1, 0, 0), (0, 0, -1)),
        ("1,2,3,90", (0, 1, 0), (0, 0, -1)),
        ("1,2,3,90,30", (0, 0.75**0.5, 0.5), (0, 0.5, -(0.75**0.5))),
        ("1, 2, 3, 0, -90", (0, 0, -1), (-1, 0, 0)),
        ("1,2,3,0,0,90", (1, 0, 0), (0, 1, 0)),
        ("1,2,3,-180,0,180", (-1, 0, 0), (0, 0, 1)),
    ],
)
def test_poses(text, forward, down):
    pose = map_from_camera_of(text)
    np.testing.assert_allclose(pose[:3, 3], (1, 2, 3))
    np.testing.assert_allclose(pose[:3, 2], forward, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 1], down, atol=1e-12)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "text", ["", "1,2,3", "1,2,3,4,5,6,7", "a,b,c,d", "1,2,3,nan", "1,2,3,0,91"]
)
def test_no_poses(text):
    with pytest.raises(OptionError, match="--pose is"):
        map_from_camera_of(text)


def test_options_that_contradict(draw, world, tmp_path):
    pose, camera = ("--pose", "1,2,1,0"), ("--camera", world.camera)
    for options, *words in (
        ((*camera,), "--pose", "--tum", "--estimate"),
        ((*pose, *camera, "--estimate", world.estimate), "pose must be given once"),
        (pose, "--camera", "--capture"),
        ((*pose, *camera, "--capture", world.walk), "camera must be given once"),
        ((*pose, *camera, "--frame", 1), "--frame"),
        ((*pose, *camera, "--row", 1), "--row"),
        ((*pose, *camera, "--mode", 2), "--mode"),
        ((*pose, "--capture", world.walk, "--frame", 9), "--frame is 9", "0 to 5"),
        ((*pose, *camera, "--samples", 3), "samples is 3"),
        ((*pose, *camera, "--device", "abacus"), "device"),
        (("--estimate", world.estimate, *camera, "--mode", 3), "modes 1 to 2"),
        (("--estimate", world.estimate, *camera, "--mode", 0), "--mode is 0"),
        (("--estimate", world.estimate, "--capture", world.walk, "--frame", 2), "frames 1, 5"),
        (
            ("--estimate", world.estimate, "--capture", world.walk, "--frame", 1, "--mode", 2),
            "last",
        ),
    ):
        fails(draw(*options), 7, *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "change",
    [
        {"modes": 5}, {"modes": [{}]}, {"modes": [{"map_from_camera": [[1, 2], [3, 4]]}]},
        {"frames": ["x"]}, {"trajectory": [[1]]}, {"frames": None}, {"trajectory": {}},
        {"frames": [1, 1e999]},
    ],
)  # fmt: skip
def test_what_is_no_estimate(change, draw, world, tmp_path):
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(world.told | change), encoding="utf-8")
    fails(draw("--estimate", path, "--camera", world.camera), 3, "bad.json", "")


def test_files_that_are_none(draw, world, tmp_path):
    lost = tmp_path / "lost.json"
    lost.write_text(
        json.dumps(world.told | {"status": "LOST", "modes": [], "frames": [], "trajectory": []}),
        encoding="utf-8",
    )
    camera = "--camera", world.camera
    fails(draw("--estimate", lost, *camera), 3, "lost.json", "LOST", "Drawn.")
    fails(draw("--estimate", tmp_path / "none.json", *camera), 3, "none.json")
    fails(draw("--estimate", world.map, *camera), 3, "room.scene")
    fails(draw("--tum", tmp_path / "none.tum", *camera), 3, "none.tum")
    fails(draw("--pose", "1,2,1,0", "--camera", tmp_path / "none.json"), 3, "none.json")
    broken = json.loads(world.estimate.read_text(encoding="utf-8"))
    broken["modes"][0]["map_from_camera"][0][0] = 7.0
    (tmp_path / "bent.json").write_text(json.dumps(broken), encoding="utf-8")
    fails(draw("--estimate", tmp_path / "bent.json", *camera), 7, "not rigid")
    (tmp_path / "out").write_text("", encoding="utf-8")
    fails(draw("--pose", "1,2,1,0", *camera), 3, "--out")
