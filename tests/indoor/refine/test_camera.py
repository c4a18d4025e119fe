"""A wrong camera is found where an answer is asked for, said, and mended for it."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.core.geometry import Camera, rotation_from_vector
from placegraph.indoor.refine.calibrate import COUNT, FOCAL, IMAGE, SCALE
from placegraph.indoor.refine.mend import Mend, longer, moved_depth, share_view
from placegraph.io.capture.capture import Capture

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)


def values(**known):
    out = np.zeros(COUNT)
    for name, value in known.items():
        out[{"scale": SCALE, "focal": FOCAL, "image": IMAGE}[name]] = value
    return Mend(out, 0.001 * (out != 0))


@pytest.mark.all
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_a_wrong_focal_length_is_found_said_and_mended(room, exact, kit, factor):
    wrong = Capture.from_frames(
        [
            replace(
                f, camera=longer(f.camera, np.log(factor)),
                depth_camera=longer(f.depth_camera, np.log(factor)),
            )
            for f in exact.capture
        ]
    )  # fmt: skip
    estimate = room.localize(wrong)
    assert estimate.status is Status.OK
    assert estimate.calibration.focal_factor[0] == pytest.approx(1 / factor, abs=0.01)
    assert f"fx {exact.capture.camera.fx:.0f}"[:5] in estimate.reason
    assert kit.off(estimate.best.map_from_camera, exact.poses[-1])[0] < 0.02
    assert (
        estimate.to_dict()["calibration"]["focal_factor"][0] == estimate.calibration.focal_factor[0]
    )


def test_gravity_that_is_off_is_found_said_and_mended(room, exact, kit):
    off = np.radians([0.0, 0.0, 4.0])
    aslant = [replace(f, gravity=rotation_from_vector(off) @ f.gravity) for f in exact.capture]
    estimate = room.localize(Capture.from_frames(aslant))
    assert estimate.status is Status.OK
    way, turn = kit.off(estimate.best.map_from_camera, exact.poses[-1])
    assert way < 0.1
    assert turn < 1.0
    assert "Gravity is 4" in estimate.reason
    mended = rotation_from_vector(estimate.calibration.gravity_turn) @ aslant[-1].gravity
    np.testing.assert_allclose(mended, exact.capture[-1].gravity, atol=0.01)
    assert len(estimate.to_dict()["calibration"]["gravity_turn"]) == 3


def test_a_right_camera_is_left_alone(room, walk):
    estimate = room.localize(walk)
    assert estimate.calibration is None
    assert "camera" not in estimate.refinement.stats


def test_mended_frames(exact):
    """Cameras of one view go together; scale is depth's alone."""
    frames = list(exact.capture)[:3]
    mended = values(scale=0.1, focal=-0.1, image=-0.1).frames(frames)
    for before, after in zip(frames, mended, strict=True):
        assert after.camera.fx == pytest.approx(before.camera.fx * np.exp(-0.1))
        assert after.depth_camera.fx == pytest.approx(before.depth_camera.fx * np.exp(-0.1))
        np.testing.assert_allclose(after.depth(), before.depth() * np.exp(0.1), rtol=1e-5)
        np.testing.assert_array_equal(after.rgb(), before.rgb())
    assert Mend.nothing().frames(frames)[0].images is frames[0].images


def test_sentences(exact):
    frame = exact.capture[0]
    said = values(scale=np.log(1.1)).sentence(frame)
    assert said == "Depth readings are 9.1% too short: 1.100 times them would fit."
    said = values(focal=np.log(0.9), image=np.log(0.9)).sentence(frame)
    fx = frame.camera.fx * 0.9
    assert said.startswith(
        "The focal length is 10.0% shorter than the camera says (depth likewise)"
    )
    assert f"fx {fx:.1f}" in said


def test_depth_is_brought_to_where_the_camera_was(hall, way):
    """A reading of the hall from elsewhere, brought back, is what is read there."""
    mount = np.linalg.inv(way[2]) @ way[3]
    seen, elsewhere = (hall.render(way[i], CAMERA, samples=1).depth for i in (2, 3))
    brought = moved_depth(elsewhere, CAMERA, mount)
    both = np.isfinite(brought)
    assert both.mean() > 0.6
    assert np.median(np.abs(brought - seen)[both]) < 0.01
    np.testing.assert_array_equal(np.isfinite(moved_depth(seen, CAMERA, np.eye(4))), seen > 0)


def test_cameras_of_one_view():
    assert share_view(CAMERA, CAMERA.resized(80, 60))
    assert not share_view(CAMERA, replace(CAMERA, fx=125.0))
    assert not share_view(CAMERA, None)
