"""Matchers of one's own: what they may return, and that chance persuades nobody."""

import json

import numpy as np
import pytest
from tests.indoor.conftest import rebuild

from placegraph.core.estimate import Status
from placegraph.errors import OptionError
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.refine import RefineOptions, refinement
from placegraph.indoor.refine.correspondences import MOST, match_views
from placegraph.indoor.refine.matching import Matches
from placegraph.indoor.refine.refinement import FitCheck
from placegraph.indoor.refine.refiner import FittedTrajectory
from placegraph.indoor.render import Renderer
from placegraph.indoor.status import RefinementDiagnostics

pytestmark = pytest.mark.usefixtures("one_thread")
FIVE = slice(0, 5)
BLIND = RefineOptions(depth=False)
BOTH = RefineOptions(images=True)


class Mine:
    """Matcher that returns what a function of the image's size and the number of views makes."""

    name = "mine"

    def __init__(self, made):
        self.made = made

    def match(self, query, views, *, masks=None):
        assert len(masks) == len(views)
        return self.made(query.shape[1::-1], len(views))


def check_json(estimate):
    """The estimate, which can be written as strict JSON."""
    json.dumps(estimate.to_dict(), allow_nan=False)
    return estimate


@pytest.fixture
def start(exact, kit):
    """A hand's breadth off."""
    return kit.moved(exact.poses[4], (0.1, -0.08, 0.0))


def pairs(value, which, count=200):
    """Right places, one of them no number."""
    rng = np.random.default_rng(0)

    def made(size, views):
        query = rng.uniform(0, 1, (count, 2)) * size
        rendered = query.copy()
        (query if which == "query" else rendered)[5] = value
        return [Matches.of(query, rendered, np.ones(count)) for _ in range(views)]

    return Mine(made)


@pytest.mark.parametrize("value", [np.nan, -np.inf, 1e300])
@pytest.mark.parametrize("which", ["query", "rendered"])
def test_points_that_are_no_numbers_or_outside_are_dropped(hall, way, walked, value, which):
    frame = walked[0]
    matches = match_views(
        Renderer(hall), frame, frame.rgb(), way[:1], pairs(value, which), size=160, sigma=1.0
    )
    assert 150 < len(matches) <= 199
    assert np.isfinite(matches.points).all()
    assert np.isfinite(matches.rays).all()
    errors = matches.errors(way[0])
    assert np.quantile(errors, 0.95) < 0.01
    assert errors.max() < 1.0  # edges between pixel centres


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda _, views: [(1, 2)] * views, "returned tuple"),
        (lambda *_: None, "one Matches object for each"),
        (lambda _, views: [Matches.empty()] * (views + 1), "one Matches object for each"),
        (lambda _, views: (Matches.empty() for _ in range(views)), "one Matches object for each"),
    ],
    ids=["other things", "None", "too many", "a generator"],
)
def test_what_is_no_answer_is_named(room, walk, start, made, says):
    with pytest.raises(OptionError, match=f"'mine'.*{says}"):
        room.refine(walk, start, frames=[4], matcher=Mine(made), options=BLIND)


def test_options_that_are_none_are_named(room, walk, start):
    for wrong in (3, None, object, ["sift"]):
        with pytest.raises(OptionError, match="matcher is"):
            room.refine(walk, start, frames=[4], matcher=wrong)
    with pytest.raises(OptionError, match="seed is -1"):
        room.refine(walk, start, frames=[4], seed=-1)
    with pytest.raises(OptionError, match="seed is -1"):
        room.localize(walk, frames=[4], seed=-1)
    for wrong in ("yes", 1, {}, PoseSearchOptions()):
        with pytest.raises(OptionError, match="refine is"):
            room.localize(walk, frames=[4], refine=wrong)


def test_the_surest_of_too_many_are_used(hall, way, walked, rng):
    count = MOST + 700
    at = rng.uniform([1, 1], [159, 119], (count, 2))
    sure = rng.random(count)
    crowd = Mine(lambda _, views: [Matches.of(at, at, sure)] * views)
    frame = walked[0]
    matches = match_views(Renderer(hall), frame, frame.rgb(), way[:1], crowd, size=160, sigma=1.0)
    assert 0.8 * MOST < len(matches) <= MOST
    surest = {tuple(p) for p in at[np.argsort(-sure)[:MOST]].tolist()}
    assert all(tuple(p) in surest for p in matches.pixels.tolist())


@pytest.mark.parametrize(("count", "low", "high"), [(1000, 0, 1), (300, -3, 4)])
def test_chance_is_not_believed(room, walk, start, count, low, high):
    rng = np.random.default_rng(0)

    def scattered(size, views):
        both = rng.uniform(low, high, (2, views, count, 2)) * size
        return [Matches.of(q, r, np.ones(count)) for q, r in zip(*both, strict=True)]

    estimate = check_json(
        room.refine(walk, start, frames=FIVE, matcher=Mine(scattered), options=BLIND)
    )
    assert not estimate.refinement.accepted, estimate.refinement.reason
    np.testing.assert_allclose(estimate.best.map_from_camera, start, atol=1e-9)


def test_the_same_pixels_everywhere_are_the_pose_that_was_given(room, walk, start):
    def same(size, views):
        at = np.random.default_rng(0).uniform(0, 1, (2000, 2)) * size
        return [Matches.of(at, at, np.ones(2000)) for _ in range(views)]

    estimate = check_json(room.refine(walk, start, frames=FIVE, matcher=Mine(same), options=BLIND))
    assert not estimate.refinement.accepted


def few(frame):
    """Depth of 16 x 20 pixels."""
    depth = np.full_like(frame.depth(), np.nan)
    depth[40:56, 70:90] = frame.depth()[40:56, 70:90]
    return depth


def handful(frame):
    """Depth of three pixels in a corner."""
    corner = np.add.outer(*map(np.arange, frame.depth().shape)) < 2
    return np.where(corner, frame.depth(), np.nan).astype(np.float32)


@pytest.fixture(scope="module")
def by_images(room, walk, exact, kit):
    """Refinement of frames without depth."""
    start = kit.moved(exact.poses[4], (0.1, -0.08, 0.0))
    return room.refine(rebuild(walk[:5], depth=lambda _: None), start)


@pytest.mark.parametrize("depth", [few, handful])
def test_a_few_pixels_of_depth_do_not_switch_images_off(
    room, walk, start, exact, kit, by_images, depth
):
    some, none = room.refine(rebuild(walk[:5], depth=depth), start), by_images
    stats = check_json(some).refinement.stats
    assert stats["matches"] > 100
    assert "depth_cost" not in stats
    assert some.refinement.accepted == none.refinement.accepted
    away, as_far = (kit.off(e.best.map_from_camera, exact.poses[4])[0] for e in (some, none))
    assert away < as_far + 0.05


def test_doubts_of_the_judge_are_the_coarse_poses_too(room, walk, monkeypatch):
    before = room.localize(walk, frames=FIVE, refine=False)
    assert before.status is Status.OK
    nothing = FittedTrajectory(np.eye(4)[None], None, [], np.eye(6))
    for objection in ("", "the camera is a liar"):
        found = RefinementDiagnostics(objection=objection)
        verdict = FitCheck(found, "Not refined: so it is.", nothing, {})
        monkeypatch.setattr(refinement, "confirm_fit", lambda *_, v=verdict: v)
        after = check_json(room.localize(walk, frames=FIVE))
        assert not after.refinement.accepted
        np.testing.assert_array_equal(after.best.map_from_camera, before.best.map_from_camera)
        if not objection:
            assert (after.status, after.reason) == (before.status, before.reason)
    assert after.status is Status.AMBIGUOUS
    assert objection in after.reason
    assert after.reason.endswith(".")
