"""How well the frames that a map was made of agree with it, and answers that fall short of them."""

import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.indoor.conftest import view_frames

from placegraph.core.estimate import Status
from placegraph.core.geometry import split_pose
from placegraph.core.mapfile import write_map
from placegraph.errors import MapError, OptionError
from placegraph.indoor.likelihood.score import Scorer
from placegraph.indoor.map.scene_file import KIND, VERSION, pack_scene, save_scene
from placegraph.indoor.mapping.merge import merge_scenes
from placegraph.indoor.mapping.own_agreement import measure_own_agreement
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.agreement import (
    Agreement,
    agreement,
    both_odds,
    searched_odds,
)
from placegraph.indoor.scene_map import SceneMap
from placegraph.indoor.status import FEW

pytestmark = pytest.mark.usefixtures("one_thread")
OWN = np.array([4.0, 0.6, 1.0, 0.77, 0.6, 0.05, 0.13, 0.06, 0.5])
NOTHING = np.zeros(2)


def seen(depth=0.98, texture=0.6, tone=1.0):
    return Agreement(0.9, math.nan, depth, 0.2, NOTHING, NOTHING, tone=tone, texture=texture)


def test_colours_that_fall_short_are_of_an_unsearched_place():
    as_own, beside, elsewhere = seen(), seen(texture=0.5, tone=0.8), seen(texture=0.3, tone=0.35)
    odds = [searched_odds(a, OWN) for a in (as_own, beside, elsewhere)]
    assert odds[0] > odds[1] > odds[2]
    assert odds[1] < 1.1 < searched_odds(beside, OWN, 0.77), (
        "images must confirm where a map repeats itself"
    )
    assert odds[2] < -1.0
    assert searched_odds(seen(texture=0.3), OWN) < 0.0, "a place of the same shapes"
    faint = OWN * np.array([1.0, 0.1, *np.ones(7)])
    assert searched_odds(seen(texture=0.06), faint) < odds[0], "bare walls tell little"
    assert searched_odds(beside, OWN, 0.77) > searched_odds(beside, OWN, 0.3)
    unlike = np.r_[OWN[:-1], 0.1]
    for agreed in (as_own, beside, seen(depth=0.8)):
        assert searched_odds(agreed, OWN) < searched_odds(agreed, unlike)
    # a map made on one pass is asked from another: its own frames agree better
    other_pass = seen(depth=0.9, texture=0.43, tone=0.65)
    assert searched_odds(other_pass, OWN, 0.5) < 0.0
    assert searched_odds(other_pass, unlike, 0.5) > 1.1
    assert searched_odds(seen(texture=0.9, tone=2.0), OWN) == odds[0], "more is no fault"
    assert searched_odds(elsewhere, None) == math.inf
    # without colours depth counts, without a sense that is known nothing does
    blind = seen(depth=0.7, texture=math.nan, tone=math.nan)
    assert searched_odds(blind, OWN) < searched_odds(replace(blind, depth=0.97), OWN)
    assert searched_odds(as_own, np.full(9, np.nan)) == math.inf


@given(st.floats(-30, 30), st.floats(-30, 30))
def test_both_are_no_likelier_than_either(one, other):
    probability = 1.0 / (1.0 + math.exp(-one)) / (1.0 + math.exp(-other))
    both = both_odds(one, other)
    assert 1.0 / (1.0 + math.exp(-both)) == pytest.approx(probability, rel=1e-6)
    assert both <= min(one, other)
    assert both_odds(one, math.inf) == one


@pytest.fixture(scope="module")
def measured(room, exact):
    return replace(
        room, own_agreement=measure_own_agreement(room, exact.capture.frames, exact.poses)[None]
    )


def test_own_frames_are_measured_kept_and_merged(room, measured, tmp_path):
    own = measured.own_agreement[0]
    assert own[0] > 3.0
    assert (own[1:4] > 0.05).all()
    assert (own[4:] >= 0).all()
    assert 0.25 < own[-1] < 0.6, "plain walls are alike"
    save_scene(measured, tmp_path / "it.scene")
    np.testing.assert_array_equal(
        SceneMap.open(tmp_path / "it.scene").own_agreement, measured.own_agreement
    )
    both = merge_scenes({"mesh": room, "walked": measured})
    assert np.isnan(both.own_agreement[0]).all()
    np.testing.assert_array_equal(both.own_agreement[1], measured.own_agreement[0])
    assert merge_scenes({"a": room, "b": room}).own_agreement is None
    with pytest.raises(OptionError, match="own_agreement"):
        replace(room, own_agreement=np.zeros((2, 9)))


def test_maps_with_agreement_in_older_units_must_be_built_again(measured, tmp_path):
    meta, arrays = pack_scene(measured)
    arrays["own_agreement"] = arrays.pop("own_reach")
    write_map(tmp_path / "old.scene", KIND, VERSION, meta, arrays)
    with pytest.raises(MapError, match=r"own_agreement .* older placegraph.* Build it again"):
        SceneMap.open(tmp_path / "old.scene")


@pytest.mark.parametrize(("count", "status"), [(3, Status.AMBIGUOUS), (10, Status.LOST)])
def test_answers_that_fall_short_are_not_ok(measured, exact, count, status):
    options = PoseSearchOptions().only(depth=True, colour=True)
    asked = {"frames": slice(0, count), "options": options}
    right = measured.localize(exact.capture, **asked)
    assert right.status is Status.OK
    assert 0.75 < sum(mode.probability for mode in right.modes) < 1.0
    own = measured.own_agreement + np.array([0.0, 0.4, 2.0, *np.zeros(6)])
    estimate = replace(measured, own_agreement=own).localize(exact.capture, **asked)
    assert estimate.status is status
    assert "than the frames that the map was made of" in estimate.reason
    assert sum(mode.probability for mode in estimate.modes) < 0.1
    assert count > FEW or len(estimate.modes)
    json.dumps(estimate.to_dict(), allow_nan=False)


@pytest.mark.parametrize(("textures", "repeats"), [((np.nan, 0.2), 0.2), ((np.nan,), 0.0)])
def test_places_without_texture_leave_what_repeats_known(
    room, exact, monkeypatch, textures, repeats
):
    modes = [
        SimpleNamespace(map_from_camera=np.eye(4) + 9.0, pose=np.zeros(4), probability=0.5)
        for _ in textures
    ]
    found = iter((0.8, *textures))
    measuring = "placegraph.indoor.mapping.own_agreement"
    monkeypatch.setattr(f"{measuring}.estimate_pose", lambda *_: SimpleNamespace(modes=modes))
    monkeypatch.setattr(f"{measuring}.agreement", lambda *_: seen(texture=next(found)))
    own = measure_own_agreement(room, exact.capture.frames[:1], exact.poses[:1])
    assert own[-1] * own[1] == pytest.approx(repeats)


def test_frames_without_depth_are_no_obstacle(room, exact):
    frames = list(exact.capture.frames[:2])
    images = SimpleNamespace(rgb=frames[0].rgb, labels=frames[0].labels, depth=lambda: None)
    frames[0] = replace(frames[0], images=images)
    assert np.isfinite(measure_own_agreement(room, frames, exact.poses[:2])).all()


def test_textures_tell_places_of_the_same_shapes_apart(room, exact):
    """A place that looks like another has its shapes and their edges, not the marks on its walls."""
    options = PoseSearchOptions().only(depth=True, colour=True)
    (view,) = view_frames(room, exact.capture.frames[:1], options, stride=4.0)
    at, scorer = split_pose(exact.poses[0])[0], Scorer(room, options.likelihood)
    _, triangles, _, shown = scorer.show(at, view)
    objects = np.where(triangles >= 0, room.mesh.object_of[triangles], 0)
    shown = shown.T
    plain = np.stack([np.bincount(objects, c)[objects] for c in shown.T], axis=1)
    plain /= np.bincount(objects)[objects, None]
    marked = plain + np.random.default_rng(0).normal(0.0, 0.02, plain.shape)
    found = [
        agreement(scorer, at, [view._replace(colour=np.float32(c))], np.zeros((1, 4)))
        for c in (shown, marked)
    ]
    assert found[0].texture > 0.8
    assert found[1].texture < 0.4
    blind = agreement(
        scorer, at, [view._replace(terms=np.array([False, True, False]))], np.zeros((1, 4))
    )
    assert math.isnan(blind.texture)


def test_what_one_frame_alone_shows_makes_own_agreement_uncertain(room, exact):
    frames, poses = exact.capture.frames, exact.poses
    near, single = (measure_own_agreement(room, frames[:n], poses[:n]) for n in (4, 1))
    np.testing.assert_allclose(single[4:6], single[:2] / np.sqrt(12.0))
    assert near[4] < 0.1 * near[0] < single[4]
