"""`placegraph scene refine`: poses given roughly become exact, and what is refused."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from tests.cli.failing import fails

from placegraph.cli.scene_options import map_from_camera_of
from placegraph.core.geometry import level_from_camera, split_pose
from placegraph.io.capture.tum import read_tum

FRAMES = 6


@pytest.fixture(scope="module")
def world(room, tmp_path_factory):
    """A rough estimate of the walk, its right poses off by some centimetres, beside the room."""
    frames = [1, 2, 4]
    rough, wrong = room.truth.copy(), room.truth[4].copy()
    rough[:, 0, 3] += 0.06
    wrong[:2, 3] += (-1.2, 0.9)
    told = {
        "status": "OK", "reason": "Drawn.", "frames": frames,
        "trajectory": rough[frames].tolist(),
        "modes": [{"map_from_camera": pose.tolist()} for pose in (rough[4], wrong)],
    }  # fmt: skip
    estimate = tmp_path_factory.mktemp("refine") / "est.json"
    estimate.write_text(json.dumps(told), encoding="utf-8")
    return SimpleNamespace(
        map=room.map, walk=room.wide, narrow=room.walk, truth=room.truth, estimate=estimate, told=told,
    )  # fmt: skip


def near(truth, *, way=(0.0, 0.0, 0.0), turn_deg=0.0):
    """--pose beside a true one, without its tilt."""
    (x, y, z, yaw), _ = split_pose(truth)
    numbers = (x + way[0], y + way[1], z + way[2], np.degrees(yaw) + turn_deg)
    return ",".join(f"{v:.4f}" for v in numbers)


def off(told, truth):
    """How far the answered pose lies from a true one [m]."""
    return np.linalg.norm(np.array(told["modes"][0]["map_from_camera"])[:3, 3] - truth[:3, 3])


def test_a_rough_pose_becomes_exact(run, world, tmp_path):
    tum, png, look = (tmp_path / name for name in ("a.tum", "a.png", "look.png"))
    start = near(world.truth[4], way=(0.15, -0.12, 0.03), turn_deg=8)
    result = run(
        "scene", "refine", world.map, world.walk, "--frames", ":5", "--pose", start, "--json",
        "--tum", tum, "--png", png, "--overlay", look,
    )  # fmt: skip
    assert (result.code, result.err) == (0, "")
    told = result.json
    assert told["status"] == "OK", told["reason"]
    assert told["refinement"]["accepted"]
    assert told["frames"] == list(range(5))
    assert off(told, world.truth[4]) < 0.03
    assert off({"modes": [told["refinement"]["coarse"]]}, world.truth[4]) > 0.19
    written = read_tum(tum)
    assert written.poses == pytest.approx(np.array(told["trajectory"]), abs=1e-6)
    assert np.linalg.norm(written.poses[:, :3, 3] - world.truth[:5, :3, 3], axis=1).max() < 0.05
    with Image.open(png) as plan, Image.open(look) as sheet:
        assert plan.width == 1200
        assert sheet.height > 3 * 90, "before and after"


def test_gravity_gives_the_tilt_that_is_not_given(world):
    from placegraph import open_capture

    frame = open_capture(world.walk)[4]
    given = map_from_camera_of("1,2,1.5,40", frame.gravity)
    np.testing.assert_allclose(split_pose(given)[1], level_from_camera(frame.gravity), atol=1e-12)
    np.testing.assert_allclose(split_pose(given)[0], [1, 2, 1.5, np.radians(40)])
    told = map_from_camera_of("1,2,1.5,40,-5", frame.gravity)
    assert told[2, 2] == pytest.approx(np.sin(np.radians(-5))), "what is given stands"


def test_from_an_estimate(run, world):
    def refine_json(*options):
        result = run(
            "scene", "refine", world.map, world.walk, "--estimate", world.estimate, "--json",
            *options,
        )  # fmt: skip
        assert (result.code, result.err) == (0, "")
        return result.json

    answer = refine_json()
    assert answer["frames"] == [1, 2, 4]
    assert off(answer, world.truth[4]) < 0.03
    answer = refine_json("--frames", "0:3")
    assert answer["frames"] == [0, 1, 2]
    assert off(answer, world.truth[2]) < 0.03
    coarse = answer["refinement"]["coarse"]["map_from_camera"]
    np.testing.assert_allclose(coarse, world.told["trajectory"][1], atol=1e-9)
    answer = refine_json("--mode", "2")
    coarse = answer["refinement"]["coarse"]["map_from_camera"]
    np.testing.assert_allclose(coarse, world.told["modes"][1]["map_from_camera"], atol=1e-9)


def test_senses_and_matchers(run, world):
    ask = ("scene", "refine", world.map, world.walk, "--estimate", world.estimate, "--json")
    images = run(*ask, "--no-depth", "--matcher", "guided").json["refinement"]["stats"]
    assert images["matches"] > 0
    assert images["matcher"] == "guided"
    assert "depth_cost" not in images
    depth = run(*ask, "--no-colour").json["refinement"]["stats"]
    assert "matches" not in depth
    assert "depth_cost" in depth


def test_options_that_contradict(run, world):
    pose, estimate = ("--pose", "1,2,1.5,0"), ("--estimate", world.estimate)
    for options, *words in (
        ((), "--pose", "--estimate"),
        ((*pose, *estimate), "must be given once"),
        ((*pose, "--mode", 2), "--mode"),
        (("--pose", "1,2,1.5"), "--pose is"),
        (("--pose", "1e12,0,0,0"), "map_from_camera"),
        ((*estimate, "--mode", 3), "modes 1 to 2"),
        ((*estimate, "--frames", "3"), "frames 1, 2, 4"),
        ((*pose, "--frames", "9:"), "--frames"),
        ((*pose, "--matcher", "orb"), "choose one of auto, guided"),
        ((*pose, "--weights", "a.pt"), "--weights"),
        ((*pose, "--no-depth", "--no-colour"), "leave one on"),
        ((*pose, "--device", "abacus"), "device"),
        ((*pose, "--seed", "-1"), "seed is -1"),
    ):
        fails(run("scene", "refine", world.map, world.walk, "--quiet", *options), 7, *words)


def test_an_estimate_of_another_capture(run, world, tmp_path):
    longer = tmp_path / "longer.json"
    longer.write_text(json.dumps(world.told | {"frames": [1, 2, 40]}), encoding="utf-8")
    ask = ("scene", "refine", world.map, world.walk, "--estimate")
    fails(run(*ask, longer), 7, "frame 40", f"{FRAMES} frames")
    longer.write_text("{}", encoding="utf-8")
    fails(run(*ask, longer), 3, "longer.json")
    fails(run(*ask, tmp_path / "none.json"), 3, "none.json")
