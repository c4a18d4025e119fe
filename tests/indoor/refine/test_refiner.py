"""Which senses and which frames take part in a refinement."""

from dataclasses import replace

import numpy as np
import pytest

from placegraph.indoor.options import RefineOptions
from placegraph.indoor.refine.correspondences import PointMatches
from placegraph.indoor.refine.matching import Matches
from placegraph.indoor.refine.refinement import held_back
from placegraph.indoor.refine.refiner import (
    FEW,
    MANY,
    UNEXPLAINED,
    FittedTrajectory,
    matching_stages,
)

pytestmark = pytest.mark.usefixtures("one_thread")


class Nowhere:
    """Matcher that finds nothing, and counts what it was asked."""

    name = "nowhere"

    def __init__(self):
        self.views = []

    def match(self, query, views, *, masks=None):
        assert query.dtype == np.uint8
        assert len(masks) == len(views)
        self.views.append(len(views))
        return [Matches.empty() for _ in views]


def test_matches_in_held_back_blocks_take_no_part(refiner, exact):
    one = refiner(depth=False, frames=slice(0, 4))
    (stage, *_) = matching_stages(None, near=False)
    matches = one.match(stage, exact.poses[:4])
    camera = one.frames[0].camera
    assert sum(map(len, matches)) > 5
    assert not any(held_back(s.pixels, camera).any() for s in matches)
    all_ = refiner(depth=False, frames=slice(0, 4), check=False).match(stage, exact.poses[:4])
    assert sum(map(len, all_)) > sum(map(len, matches))
    assert any(held_back(s.pixels, camera).any() for s in all_)


def test_landmarks_kept_for_the_check_join_an_accepted_fit(refiner, exact, rng):
    one, pose = refiner(depth=False, frames=slice(0, 1)), exact.poses[0]
    camera = one.frames[0].camera
    pixels = rng.uniform(0, (camera.width, camera.height), (120, 2))
    points = camera.directions(pixels) * rng.uniform(1, 4, (120, 1)) @ pose[:3, :3].T + pose[:3, 3]
    matches = PointMatches.of(points, pixels, camera, 0.7)
    one.landmarks = [matches]
    few, shifted = matches[:20], pose.copy()
    shifted[:3, 3] += 0.01
    fitted = FittedTrajectory(shifted[None], None, [few], np.eye(6))
    assert one.add_held_back(fitted) is fitted  # no landmarks had led there
    one.by_landmarks = True
    whole = one.add_held_back(fitted)
    assert len(whole.matches[0]) > 110
    assert np.linalg.norm(whole.poses[0, :3, 3] - pose[:3, 3]) < 1e-3


def test_readings_of_fit_and_check_are_other_pixels(refiner):
    one = refiner(frames=slice(0, 2))
    for fit, check in zip(one.readings(0), one.readings(1), strict=True):
        a, b = (
            {tuple(d) for d in np.round(r.directions[r.depth > 0], 5).tolist()}
            for r in (fit, check)
        )
        assert a
        assert b
        assert not a & b
    assert one.readings(0) is one.readings(0)  # cut once


@pytest.mark.parametrize(
    ("options", "views"),
    [
        ({}, []),
        ({"images": False}, []),
        ({"images": True, "views": 3}, [3] * FEW + [1] * FEW),
        ({"depth": False, "views": 1, "frames": slice(0, 2)}, [1] * 4),
    ],
)
def test_images_are_matched_where_depth_leaves_doubts(refiner, exact, options, views):
    nowhere = Nowhere()
    one = refiner(matcher=nowhere, **options)
    one.fit_trajectory(exact.poses[: len(one.frames)])
    assert nowhere.views == views


def test_a_scan_that_leaves_depth_unexplained_is_less_true(refiner, exact):
    one = refiner(images=False)
    fitted, variances = one.fit_trajectory(exact.poses), []
    for cost in (0.3, 0.9):  # the halves of an office, as meshes, were off by 3 cm
        found = one._conclude(fitted.poses, replace(fitted.solution, cost=cost), fitted.matches)
        variances.append(found.covariance[0, 0])
    assert variances[1] - variances[0] == pytest.approx(UNEXPLAINED**2 * (0.9**2 - 0.3**2))


def test_where_nothing_matches_depth_decides(refiner, exact, kit):
    start, progress = kit.moved(exact.poses, (0.05, 0.05, 0), (0, 0, 2.0)), []
    fitted = refiner(matcher=Nowhere(), images=True, views=1).fit_trajectory(start)
    assert kit.off(fitted.poses[-1], exact.poses[-1])[0] < 0.01
    blind = refiner(matcher=Nowhere(), depth=False, views=1)
    fitted = blind.fit_trajectory(start, lambda *a: progress.append(a))
    assert sum(map(len, fitted.matches)) == 0
    assert kit.off(fitted.poses[-1], start[-1])[0] < 0.01
    assert {"matching images", "checking"} <= {what for what, _, _ in progress}
    assert all(0 <= done <= total for _, done, total in progress)


def test_a_white_map_is_not_matched(refiner, exact, room, kit):
    white = kit.white(room)
    nowhere = Nowhere()
    fitted = refiner(white, nowhere, depth=False).fit_trajectory(exact.poses)
    assert nowhere.views == []
    assert fitted.solution is None
    np.testing.assert_array_equal(fitted.poses, exact.poses)
    assert refiner(white, nowhere, images=True).fit_trajectory(exact.poses).solution is not None


@pytest.mark.parametrize(("count", "asked"), [(3, None), (10, 4), (10, 1), (10, 100)])
def test_frames_that_are_looked_at(refiner, count, asked):
    for matcher, most in ((None, MANY), (Nowhere(), FEW)):
        rows = refiner(matcher=matcher, frames=slice(0, count))
        rows.options = RefineOptions(frames=asked)
        looked = rows.image_rows()
        assert looked[-1] == count - 1
        assert len(looked) == min(count, asked or most)
        assert (np.diff(looked) > 0).all()
