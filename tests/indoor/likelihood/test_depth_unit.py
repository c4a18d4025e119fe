"""Depth in another unit: refused where it is absurd, told where it is likely, else silence."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.indoor.conftest import rebuild_frame, view_frames

from placegraph.core.estimate import Status
from placegraph.errors import InputError, OptionError
from placegraph.indoor.likelihood.observe import (
    FACTORS,
    FINE,
    check_unit,
    describe_unit_error,
    observe_frame,
    suspect_unit_factor,
)
from placegraph.indoor.options import PoseSearchOptions
from placegraph.io.capture.capture import open_capture

pytestmark = pytest.mark.usefixtures("one_thread")
OPTIONS = PoseSearchOptions().only(depth=True)
KNOWN = sorted({*FACTORS, *(1 / f for f in FACTORS)})


def scaled(capture, factor):
    """Frames in memory without labels, whose depth is `factor` times too long."""
    bare = {"labels": None, "label_camera": None, "label_kind": "labels"}
    return [rebuild_frame(f, depth=f.depth() * np.float32(factor), **bare) for f in capture]


def suspected(scene, frames):
    seen = view_frames(scene, frames, OPTIONS, stride=FINE)
    return suspect_unit_factor(seen, scene.visibility(OPTIONS).background)


def test_metres_are_metres(room, flat, walk, flat_walk):
    for scene, capture in ((room, walk), (flat, flat_walk), (flat, walk), (room, flat_walk)):
        assert suspected(scene, capture) is None
    for scene, capture in ((room, walk), (flat, flat_walk)):
        assert [suspected(scene, [f]) for f in capture] == [None] * len(capture)


@pytest.mark.parametrize("factor", KNOWN)
def test_known_factors_are_named(flat, flat_walk, factor):
    found = suspected(flat, scaled(flat_walk[:5], factor))
    if found is None:  # feet taken for meters are usual from some height of a camera
        assert factor == pytest.approx(1.0 / 3.281)
        return
    # feet and fifths are neighbours
    assert abs(np.log(found / factor)) < np.log(1.7)
    assert (found > 1) == (factor > 1)


@settings(max_examples=10)
@given(st.floats(0.75, 1.35))
def test_a_scale_a_little_off_is_no_other_unit(flat, flat_walk, factor):
    assert suspected(flat, scaled(flat_walk[:2], factor)) is None


def test_no_depth_no_suspicion(room, walk):
    background = room.visibility(OPTIONS).background
    seen = view_frames(room, walk[:2], OPTIONS, stride=FINE)
    blind = [v._replace(depth=np.zeros_like(v.depth)) for v in seen]
    assert suspect_unit_factor(blind, background) is None
    few = [v._replace(depth=np.where(np.arange(len(v.depth)) < 9, v.depth, 0)) for v in blind]
    assert suspect_unit_factor(few, background) is None


@pytest.mark.parametrize(
    ("factor", "says"),
    [(1000.0, "1000 times too long"), (0.01, "100 times too short")],
)  # fmt: skip
def test_absurd_depth_is_refused(room, walk, factor, says):
    frames = scaled(walk[:3], factor)
    with pytest.raises(OptionError, match="metres") as raised:
        room.localize(frames)
    assert says in str(raised.value)
    with pytest.raises(OptionError, match="metres"):
        room.refine(frames, np.eye(4))
    # who does not look at depth does not mind
    room.localize(frames, options=PoseSearchOptions().only(colour=True))


@pytest.mark.parametrize(("scale", "fits"), [(1, "1000 would fit"), (60000, "would fit")])
def test_the_file_and_the_mend_are_named(room, walk, tmp_path, scale, fits):
    capture = rescaled(walk, tmp_path, scale)
    with pytest.raises(InputError, match=r"camera\.json") as raised:
        room.localize(capture, frames=slice(0, 3))
    assert fits in str(raised.value)
    assert f"{scale:g} units per metre" in str(raised.value)
    assert str(raised.value).endswith(".")


def rescaled(walk, tmp_path, scale):
    folder = shutil.copytree(walk.path, tmp_path / "capture")
    content = json.loads((folder / "camera.json").read_text())
    content["depth"]["scale"] = scale
    (folder / "camera.json").write_text(json.dumps(content))
    return open_capture(folder)


def test_a_hand_before_the_lens_is_no_unit(walk):
    for metres, diagonal in ((0.08, 5.0), (25.0, 5.0), (80.0, 40.0)):
        seen = [observe_frame(f, None, OPTIONS) for f in walk[:2]]
        check_unit(diagonal, [replace(s, depth=np.full_like(s.depth, metres)) for s in seen])


def test_one_frame_of_many_may_be_absurd(walk):
    frames = [*scaled(walk[:4], 1.0), *scaled(walk[4:5], 1000.0)]
    check_unit(5.0, [observe_frame(f, None, OPTIONS) for f in frames])


def test_too_few_readings_say_nothing(walk):
    (frame,) = scaled(walk[:1], 1000.0)
    observation = observe_frame(frame, None, OPTIONS)
    with pytest.raises(OptionError, match="metres"):
        check_unit(5.0, [observation])
    few = np.full_like(observation.depth, np.nan)
    few.flat[::400] = observation.depth.flat[::400]
    check_unit(5.0, [replace(observation, depth=few)])


@pytest.mark.parametrize(("scale", "says"), [(5000, "too short"), (200, "too long")])
def test_a_likely_unit_is_told_where_the_pose_is_not_found(room, walk, tmp_path, scale, says):
    """TUM's scale for millimetres, and the other way round: lost, and why."""
    capture = rescaled(walk, tmp_path, scale)
    estimate = room.localize(capture, frames=slice(0, 5))
    assert estimate.status is not Status.OK
    assert f"about 5.0 times {says}" in estimate.reason
    assert f"is {scale} units per metre; 1000 would fit" in estimate.reason
    assert estimate.reason.endswith(".")


def test_of_frames_in_memory_it_asks_for_metres(room, walk):
    frames = scaled(walk[:5], 5.0)
    text = describe_unit_error(frames[0], suspected(room, frames))
    assert "about 5.0 times too long; give depth in metres" in text


def test_who_is_found_or_truly_elsewhere_is_not_bothered(room, flat, walk):
    assert "times too" not in room.localize(walk, frames=slice(0, 5)).reason
    lost = flat.localize(walk, frames=slice(0, 5))
    assert lost.status is Status.LOST
    assert "times too" not in lost.reason
