"""From a coarse pose to centimetres, or to the reason why not."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.estimate import Status
from placegraph.core.geometry import split_pose
from placegraph.errors import MissingExtraError, OptionError
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.local_fit import fit_window
from placegraph.indoor.pose.window import PoseQuery, observe
from placegraph.indoor.refine import RefineOptions, RefineSetup, refine_estimate
from placegraph.indoor.refine.matching.guided import GuidedMatcher
from placegraph.indoor.refine.refinement import FitCheck, _apply_check
from placegraph.indoor.status import Diagnostics, RefinementDiagnostics

pytestmark = pytest.mark.usefixtures("one_thread")
FIVE = slice(0, 5)
WITHOUT_DEPTH = PoseSearchOptions().only(semantic=True, colour=True)


@pytest.fixture(scope="module")
def refined(room, walk):
    return room.localize(walk)


@pytest.fixture(scope="module")
def coarse(room, walk):
    return room.localize(walk, refine=False)


def test_refined_is_nearer_the_truth(refined, coarse, exact, kit):
    truth = exact.poses[-1]
    assert refined.status is Status.OK
    assert refined.refinement.accepted, refined.refinement.reason
    after, before = (kit.off(e.best.map_from_camera, truth)[0] for e in (refined, coarse))
    assert after < before
    kit.check_near(refined.best.map_from_camera, truth, 0.01, 0.3)
    kit.check_near(refined.trajectory, exact.poses, 0.02)
    # the same seed, refined or not: the filter's own answer stands in `coarse`
    refinement = refined.refinement
    np.testing.assert_array_equal(refinement.coarse.map_from_camera, coarse.best.map_from_camera)
    np.testing.assert_array_equal(refinement.coarse_trajectory, coarse.trajectory)
    np.testing.assert_array_equal(refinement.coarse.covariance, coarse.best.covariance)
    assert coarse.refinement is None
    assert refined.status is coarse.status  # the reason is that of the refined pose


def test_refinement_in_numbers(refined, exact):
    covariance = refined.best.covariance
    assert np.linalg.eigvalsh(covariance).min() > 0
    error = refined.best.map_from_camera[:3, 3] - exact.poses[-1][:3, 3]
    assert error @ np.linalg.solve(covariance[:3, :3], error) < 25.0
    stats, answer = refined.refinement.stats, refined.to_dict()["refinement"]
    assert {"inliers", "shift_m", "turn_deg", "motion", "held_back", "seconds"} <= set(stats)
    assert stats["matcher"] == "guided"
    assert "candidate" not in stats
    assert answer["accepted"] is True
    assert answer["coarse"]["map_from_camera"]


def test_images_alone(room, walk, exact, kit):
    estimate = room.localize(walk, options=WITHOUT_DEPTH)
    refinement, truth = estimate.refinement, exact.poses[-1]
    before = kit.off(refinement.coarse.map_from_camera, truth)[0]
    kit.check_near(estimate.best.map_from_camera, truth, min(before + 0.02, 0.15))
    assert "depth" not in refinement.stats["held_back"]
    assert refinement.stats["matches"] > 100


@pytest.mark.parametrize("depth", [True, False])
def test_a_start_that_is_exact_may_be_refined(room, walk, exact, kit, depth):
    options = RefineOptions(depth=depth, images=not depth, reach=(0.0, 0.0))
    estimate = room.refine(walk, exact.poses[4], frames=FIVE, options=options)
    kit.check_near(estimate.best.map_from_camera, exact.poses[4], 0.02, 0.3)


@pytest.mark.parametrize(
    ("undecided", "accepted", "landmarks", "searched", "spread", "after"),
    [
        (True, True, 40, 2.0, 0.1, Status.OK),
        (True, True, None, 2.0, 0.1, Status.AMBIGUOUS),
        (True, False, 40, 2.0, 0.1, Status.AMBIGUOUS),
        (False, True, 40, 2.0, 0.1, Status.AMBIGUOUS),  # something else speaks against it
        (
            True,
            True,
            22,
            0.5,
            0.1,
            Status.AMBIGUOUS,
        ),  # so do colours: signs of a corridor are alike
        (True, True, 40, 2.0, 0.3, Status.AMBIGUOUS),  # landmarks leave the position open
    ],
)
def test_landmarks_make_sure_of_a_pose(
    coarse, undecided, accepted, landmarks, searched, spread, after
):
    refiner = SimpleNamespace(matcher=None, seconds={}, stats={})
    poses = coarse.trajectory.copy()
    fitted = SimpleNamespace(poses=poses, solution=None, covariance=spread**2 * np.eye(6))
    objection = "" if accepted else "it is elsewhere"
    told = RefinementDiagnostics(accepted=accepted, objection=objection, landmarks=landmarks)
    judgement = FitCheck(told, "", fitted, {})
    found = Diagnostics(undecided=undecided, searched=searched)
    before = replace(coarse, status=Status.AMBIGUOUS, diagnostics=found)
    assert _apply_check(before, refiner, judgement).status is after


def test_a_pose_that_landmarks_tell_outlasts_the_coarse_levels(room, walk, exact, rng):
    window = observe(PoseQuery.of(room, walk, frames=slice(0, 1)))
    truth = split_pose(exact.poses[0])[0]
    astray = truth + np.array([[0.9, 0.0, 0.0, 1.2]])
    ways = [
        np.linalg.norm(fit_window(window, astray, rng, poses)[0].pose[:3] - truth[:3])
        for poses in (None, truth[None] + 0.05)
    ]
    assert ways[0] > 0.3
    assert ways[1] < 0.15


def test_what_is_lost_is_not_refined(flat, walk):
    lost = flat.localize(walk, frames=FIVE)
    assert lost.status is Status.LOST
    assert lost.refinement is None
    window = observe(PoseQuery.of(flat, walk, frames=FIVE))
    assert refine_estimate(window, lost, RefineSetup.of(None, "auto")) is lost


def test_sightings_of_the_newest_frames_are_enough(room, walk, coarse, exact, kit):
    newest = observe(PoseQuery.of(room, walk, frames=slice(6, None)))
    estimate = refine_estimate(newest, coarse, RefineSetup.of(None, "auto"))
    assert estimate.refinement.accepted
    np.testing.assert_array_equal(estimate.trajectory[:6], coarse.trajectory[:6])
    assert kit.off(estimate.trajectory[-1], exact.poses[-1])[0] < 0.01


def test_several_views_are_for_a_matcher_that_knows_no_neighbourhood(monkeypatch):
    monkeypatch.setitem(sys.modules, "romatch.models.model_zoo", None)
    monkeypatch.setitem(sys.modules, "cv2", None)
    mine, paper = GuidedMatcher(radius=8), RefineOptions.paper()
    assert RefineSetup.of(None, "auto").matcher is RefineSetup.of(None, "guided").matcher is None
    assert RefineSetup.of(None, mine).matcher is mine
    assert RefineSetup.of(paper, "guided").matcher is None
    with pytest.raises(MissingExtraError, match=r"placegraph\[sift\]"):
        RefineSetup.of(paper, "auto")
    roma = "placegraph_learn.roma.RomaMatcher"
    monkeypatch.setattr(roma, lambda device: GuidedMatcher(radius={"cuda": 9}[device]))
    assert RefineSetup.of(paper, "auto", "cuda:0").matcher.radius == 9


@pytest.mark.parametrize(("shift", "degrees"), [((0.16, 0.12, 0), 10.0), ((0, 0, 0), 0.0)])
def test_from_two_decimetres_and_ten_degrees(room, walk, exact, kit, shift, degrees):
    start = kit.moved(exact.poses[-1], shift, (0, 0, degrees))
    before = start.copy()
    estimate = room.refine(walk, start)
    assert estimate.refinement.accepted, estimate.refinement.reason
    assert estimate.status is Status.OK
    kit.check_near(estimate.best.map_from_camera, exact.poses[-1], 0.03, 0.5)
    np.testing.assert_allclose(estimate.refinement.coarse.map_from_camera, start, atol=1e-12)
    np.testing.assert_array_equal(start, before)
    np.testing.assert_array_equal(estimate.frames, np.arange(10))


def test_what_nothing_holds_stays_where_it_was_given(room, walk, exact, kit):
    start = kit.moved(exact.poses[4], (0.1, 0.1, 0.0), (0, 0, 4.0))
    refinement = room.refine(walk, start, frames=FIVE)
    assert "matches" not in refinement.refinement.stats  # depth is enough
    assert 0 <= refinement.refinement.stats["depth_cost"] <= 1
    assert kit.off(refinement.best.map_from_camera, exact.poses[4])[0] < 0.01
    along, _, up = np.sqrt(np.diag(refinement.best.covariance)[:3])
    assert along < 0.02
    assert 0.03 < up < 0.06  # no more is known of it than before
    alone = room.refine(walk, start, frames=[4])
    assert alone.refinement.accepted, alone.refinement.reason
    assert kit.off(alone.best.map_from_camera, exact.poses[4])[0] < 0.03


def test_with_a_named_matcher(room, walk, exact, kit):
    pytest.importorskip("cv2", reason="needs OpenCV: pip install 'placegraph[sift]'")
    start = kit.moved(exact.poses[4], (0.05, -0.05, 0), (0, 0, 2.0))
    options = RefineOptions(images=True, views=2)
    estimate = room.refine(walk, start, frames=FIVE, matcher="sift", options=options)
    assert estimate.refinement.stats["matcher"] == "sift"
    assert kit.off(estimate.best.map_from_camera, exact.poses[4])[0] < 0.05


def test_what_cannot_be_asked_is_refused_before_any_work(room, walk, exact):
    for pose in (np.eye(3), np.full((4, 4), np.nan), "here"):
        with pytest.raises(OptionError, match="map_from_camera"):
            room.refine(walk, pose)
    with pytest.raises(OptionError, match="none of the capture's"):
        room.refine(walk, exact.poses[-1], frames=[])
    with pytest.raises(OptionError, match="refine=False"):
        room.localize(walk, refine=RefineOptions(depth=False, images=False))
    for name in ("surf", "", "GUIDED"):
        with pytest.raises(OptionError, match="sift"):
            room.localize(walk, matcher=name)
        # nobody matches anything where nothing is refined
        room.localize(walk, frames=slice(0, 1), matcher=name, refine=False)


def test_without_poselib_depth_refines_and_colours_alone_say_so(
    room, walk, exact, kit, monkeypatch
):
    pytest.importorskip("cv2", reason="needs OpenCV: pip install 'placegraph[sift]'")
    monkeypatch.setitem(sys.modules, "poselib", None)
    start = kit.moved(exact.poses[4], (0.05, -0.05, 0), (0, 0, 2.0))
    estimate = room.refine(walk, start, frames=FIVE, options=RefineOptions(images=True))
    assert estimate.refinement.accepted
    assert estimate.refinement.reason == "Refined by depth."
    assert kit.off(estimate.best.map_from_camera, exact.poses[4])[0] < 0.02
    estimate = room.localize(walk, frames=FIVE, options=WITHOUT_DEPTH)
    assert not estimate.refinement.accepted
    assert "PoseLib" in estimate.refinement.reason
    assert "pip install poselib" in estimate.refinement.reason
    # a matcher that was asked for is not passed over
    options = RefineOptions(images=True, views=1)
    with pytest.raises(MissingExtraError, match="PoseLib"):
        room.refine(walk, exact.poses[1], frames=slice(0, 2), matcher="sift", options=options)
