"""Cameras that are not as they say, told from readings that are exact but for that."""

from dataclasses import replace

import numpy as np
import pytest
from tests.indoor.conftest import rebuild

from placegraph.core.estimate import Status
from placegraph.core.geometry import rotation_from_vector
from placegraph.indoor.refine.camera_correction import (
    COUNT,
    FOCAL,
    SCALE,
    SUSPECT,
    TILT,
    CameraCorrection,
    calibrate_camera,
    scale_focal,
    share_view,
    turn_gravity,
)
from placegraph.io.capture.capture import Capture

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(("scale", "focal"), [(0.9, 1.0), (1.0, 1.1), (1.1, 0.9)])
def test_depth_tells_its_scale_from_its_focal_length(hall, way, walked, kit, scale, focal):
    camera = scale_focal(kit.camera, np.log(focal))
    wrong = rebuild(
        walked, camera=lambda _: camera, depth_camera=lambda _: camera,
        depth=lambda f: f.depth() * np.float32(scale),
    )  # fmt: skip
    problem = kit.problem(hall, wrong)
    found = calibrate_camera(
        hall, problem, kit.moved(way, (0.1, 0.1, 0.0), (0, 0, 2.0)), [SCALE, FOCAL]
    )
    factors = np.exp(found.values[[SCALE, FOCAL]])
    np.testing.assert_allclose(factors, [1 / scale, 1 / focal], atol=4e-3)
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01


def test_gravity_that_is_off_is_told_by_depth(hall, way, walked, kit):
    off = np.radians([3.0, 0.0, -2.5])
    problem = kit.problem(hall, walked)
    wrong = replace(problem, gravity=problem.gravity @ rotation_from_vector(off))
    start = way.copy()
    start[:, :3, :3] = way[:, :3, :3] @ rotation_from_vector(off)
    found = calibrate_camera(hall, wrong, start, [SCALE, FOCAL, *TILT])
    np.testing.assert_allclose(
        turn_gravity(wrong.gravity, found.values), problem.gravity, atol=4e-3
    )
    assert np.linalg.norm(found.values[TILT]) > 8 * found.errors[TILT].max()
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01
    # what is not asked for stays
    found = calibrate_camera(hall, problem, way, [SCALE])
    rest = [k for k in range(COUNT) if k != SCALE]
    assert not found.values[rest].any()
    assert not found.errors[rest].any()
    assert found.errors[SCALE] > 0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_of_numbers_that_are_not_finite_nothing_is_found(hall, way, walked, kit, value):
    problem = kit.problem(hall, walked)
    problem.odometry[1, 0, 3] = value
    with np.errstate(invalid="ignore"):
        found = calibrate_camera(hall, problem, way, [FOCAL])
    np.testing.assert_array_equal(found.poses, way)
    assert not found.values.any()
    assert not found.errors.any()
    assert found.cost == np.inf


def values(**known):
    out = np.zeros(COUNT)
    for name, value in known.items():
        out[{"scale": SCALE, "focal": FOCAL}[name]] = value
    return CameraCorrection(out, 0.001 * (out != 0))


@pytest.mark.all
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_wrong_focal_length_is_found_said_and_mended(room, exact, kit, factor):
    wrong = rebuild(
        exact.capture,
        camera=lambda f: scale_focal(f.camera, np.log(factor)),
        depth_camera=lambda f: scale_focal(f.depth_camera, np.log(factor)),
    )
    estimate = room.localize(wrong)
    assert estimate.status is Status.OK
    assert estimate.calibration.focal_factor[0] == pytest.approx(1 / factor, abs=0.01)
    assert f"fx {exact.capture.camera.fx:.0f}"[:5] in estimate.reason
    assert kit.off(estimate.best.map_from_camera, exact.poses[-1])[0] < 0.02
    calibration = estimate.to_dict()["calibration"]
    assert calibration["focal_factor"][0] == estimate.calibration.focal_factor[0]


def test_gravity_that_is_off_is_found_said_and_mended(room, exact, kit):
    off = np.radians([0.0, 0.0, 4.0])
    aslant = [replace(f, gravity=rotation_from_vector(off) @ f.gravity) for f in exact.capture]
    estimate = room.localize(Capture.from_frames(aslant))
    assert estimate.status is Status.OK
    kit.check_near(estimate.best.map_from_camera, exact.poses[-1], 0.1, 1.0)
    assert "Gravity is 4" in estimate.reason
    mended = rotation_from_vector(estimate.calibration.gravity_turn) @ aslant[-1].gravity
    np.testing.assert_allclose(mended, exact.capture[-1].gravity, atol=0.01)
    assert len(estimate.to_dict()["calibration"]["gravity_turn"]) == 3


def test_a_right_camera_is_left_alone(room, walk):
    estimate = room.localize(walk)
    assert estimate.calibration is None
    assert abs(estimate.diagnostics.refinement.scale_error) < SUSPECT


def test_sentences_and_mended_frames(exact):
    frame, frames = exact.capture[0], list(exact.capture)[:3]
    said = values(scale=np.log(1.1)).sentence(frame)
    assert said == "Depth readings are 9.1% too short: 1.100 times them would fit."
    said = values(focal=np.log(0.9)).sentence(frame)
    assert said.startswith("The focal length is 10.0% shorter than in its intrinsics")
    assert f"fx {frame.camera.fx * 0.9:.1f}" in said
    apart = replace(frame, camera=replace(frame.camera, fx=125.0))
    assert "of the depth camera is 10.0% shorter" in values(focal=np.log(0.9)).sentence(apart)
    assert values(focal=-0.1).frames([apart])[0].camera is apart.camera
    mended = values(scale=0.1, focal=-0.1).frames(frames)
    for before, after in zip(frames, mended, strict=True):
        assert after.camera.fx == pytest.approx(before.camera.fx * np.exp(-0.1))
        assert after.depth_camera.fx == pytest.approx(before.depth_camera.fx * np.exp(-0.1))
        np.testing.assert_allclose(after.depth(), before.depth() * np.exp(0.1), rtol=1e-5)
        np.testing.assert_array_equal(after.rgb(), before.rgb())
        assert after.images.labels() is None
    assert CameraCorrection().frames(frames)[0].images is frames[0].images
    assert share_view(frame.camera, frame.camera.resize(80, 60))
    assert not share_view(frame.camera, replace(frame.camera, fx=125.0))
    assert not share_view(frame.camera, None)
