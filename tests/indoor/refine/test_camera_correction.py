"""Cameras that are not as they say, told from readings and matches that are exact but for that."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.indoor.conftest import rebuild

from placegraph.core.estimate import PoseEstimate, Status
from placegraph.core.geometry import Camera, rotation_from_vector
from placegraph.indoor.options import PoseSearchOptions, RefineOptions
from placegraph.indoor.pose.window import PoseQuery, observe
from placegraph.indoor.refine import RefineSetup
from placegraph.indoor.refine.camera_correction import (
    COUNT,
    FOCAL,
    IMAGE,
    PLACE,
    SCALE,
    TILT,
    TIME,
    CameraCorrection,
    _CameraSearch,
    calibrate_camera,
    depth_from_camera,
    reproject_depth,
    scale_focal,
    share_view,
    turn_gravity,
)
from placegraph.indoor.refine.correspondences import PointMatches
from placegraph.indoor.refine.refiner import Refiner
from placegraph.io.capture.capture import Capture

pytestmark = pytest.mark.usefixtures("one_thread")
LENS = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture
def matched(way, rng):
    """Matches (T,) of the way in the hall, noisy by 0.3 px: `matched(factor)`.

    Images were taken at `factor` times the focal length that their camera says.
    """

    def made(factor=1.0):
        matches = []
        for pose in way:
            inside = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 5.0], (150, 3))
            inside[:, :2] *= inside[:, 2:]
            centre = np.array([LENS.cx, LENS.cy])
            pixels = (LENS.project(inside) - centre) * factor + centre
            pixels += 0.3 * rng.normal(size=pixels.shape)
            matches.append(
                PointMatches.of(inside @ pose[:3, :3].T + pose[:3, 3], pixels, LENS, 1.0)
            )
        return matches

    return made


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.1])
def test_a_focal_length_is_told_by_matches(hall, way, walked, kit, matched, factor):
    problem = kit.problem(hall, walked, matches=matched(factor), blind=range(len(way)))
    found = calibrate_camera(
        hall, problem, kit.moved(way, (0.1, -0.05, 0.02), (0, 0, 2.0)), [IMAGE]
    )
    assert np.exp(found.values[IMAGE]) == pytest.approx(factor, abs=2e-3)
    assert abs(np.log(factor) - found.values[IMAGE]) < 4 * found.errors[IMAGE]
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01


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
    assert np.linalg.norm(found.values[list(TILT)]) > 8 * found.errors[list(TILT)].max()
    assert kit.off(found.poses[-1], way[-1])[0] < 0.01
    # what is not asked for stays
    found = calibrate_camera(hall, problem, way, [SCALE])
    rest = [k for k in range(COUNT) if k not in (SCALE, TIME)]
    assert not found.values[rest].any()
    assert not found.errors[rest].any()
    assert found.errors[SCALE] > 0


def test_depth_that_is_late_or_elsewhere_is_told_by_both(hall, way, walked, kit, matched):
    images = matched()
    mount = np.zeros(COUNT)
    mount[list(PLACE)] = 0.03, 0.0, -0.05, 0.01, -0.02, 0.0
    # what a camera reads that stands elsewhere: the hall from poses moved by the mount
    drawn = kit.frames(hall, way @ depth_from_camera(mount))
    elsewhere = rebuild(walked, depth=lambda f: drawn[f.index].depth())
    found = calibrate_camera(hall, kit.problem(hall, elsewhere, matches=images), way, PLACE)
    np.testing.assert_allclose(found.values[list(PLACE)], mount[list(PLACE)], atol=5e-3)
    late = rebuild(walked, depth=lambda f: walked[max(f.index - 1, 0)].depth())
    problem = kit.problem(hall, late, RefineOptions(), matches=images, blind=[0])
    found = calibrate_camera(hall, problem, way, [])
    assert found.values[TIME] == pytest.approx(-1.0, abs=0.1)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_of_numbers_that_are_not_finite_nothing_is_found(hall, way, walked, kit, matched, value):
    matches = matched(1.1)
    matches[1].rays[0] = value
    problem = kit.problem(hall, walked, matches=matches, blind=range(len(way)))
    with np.errstate(invalid="ignore"):
        found = calibrate_camera(hall, problem, way, [IMAGE])
    np.testing.assert_array_equal(found.poses, way)
    assert not found.values.any()
    assert not found.errors.any()
    assert found.cost == np.inf


@pytest.mark.parametrize(
    ("way", "status", "words"),
    [(0.06, Status.OK, "after"), (0.57, Status.AMBIGUOUS, "probably delayed")],
)
def test_cameras_of_one_device_stand_side_by_side(walk, way, status, words):
    values = np.zeros(COUNT)
    values[PLACE[0]] = way
    asked = SimpleNamespace(frames=list(walk)[-1:])
    before, after = (
        PoseEstimate(Status.OK, (), reason, refinement=SimpleNamespace(accepted=True))
        for reason in ("before", "after")
    )
    answer = CameraCorrection(values, np.zeros(COUNT)).choose_answer(asked, before, after)
    assert answer.status is status
    assert words in answer.reason
    assert f"{100 * way:.0f} cm" in answer.reason


def values(**known):
    out = np.zeros(COUNT)
    for name, value in known.items():
        out[{"scale": SCALE, "focal": FOCAL, "image": IMAGE}[name]] = value
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
    assert "camera" not in estimate.refinement.stats


def test_sentences_and_mended_frames(exact):
    frame, frames = exact.capture[0], list(exact.capture)[:3]
    said = values(scale=np.log(1.1)).sentence(frame)
    assert said == "Depth readings are 9.1% too short: 1.100 times them would fit."
    said = values(focal=np.log(0.9), image=np.log(0.9)).sentence(frame)
    assert said.startswith(
        "The focal length is 10.0% shorter than in the intrinsics (depth likewise)"
    )
    assert f"fx {frame.camera.fx * 0.9:.1f}" in said
    mended = values(scale=0.1, focal=-0.1, image=-0.1).frames(frames)
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


def test_depth_is_brought_to_where_the_camera_was(hall, way, kit):
    mount = np.linalg.inv(way[2]) @ way[3]
    seen, elsewhere = (hall.render(way[i], kit.camera, samples=1).depth for i in (2, 3))
    brought = reproject_depth(elsewhere, kit.camera, mount)
    both = np.isfinite(brought)
    assert both.mean() > 0.6
    assert np.median(np.abs(brought - seen)[both]) < 0.01
    np.testing.assert_array_equal(
        np.isfinite(reproject_depth(seen, kit.camera, np.eye(4))), seen > 0
    )


def test_images_take_part_if_the_first_frame_has_none(room, exact, monkeypatch):
    first = exact.capture[0].index
    part = rebuild(exact.capture, rgb=lambda f: None if f.index == first else f.rgb())
    options = PoseSearchOptions().only(depth=True, colour=True)
    window, asked = observe(PoseQuery.of(room, part, options=options)), []
    monkeypatch.setattr(Refiner, "match", lambda _self, *_: asked.append(1) or [()] * len(part))
    _CameraSearch(window, RefineSetup.of(None, "guided")).search(exact.poses.copy())
    assert asked
