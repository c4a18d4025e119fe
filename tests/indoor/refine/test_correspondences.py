"""Matches lifted to 3D, views turned, and poses that many matches agree on."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, rotation_from_vector, vector_from_rotation
from placegraph.errors import MissingExtraError
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.refine.correspondences import (
    PointMatches,
    lift_pixels,
    match_views,
    sample_readings,
    solve_frame,
    solve_rig,
    turn_views,
)
from placegraph.indoor.refine.matching import Matches
from placegraph.indoor.render import Renderer
from placegraph.io.capture.frame import Frame

OPTIONS = RefineOptions()
LENS = Camera(320, 240, 260.0, 260.0, 160.0, 120.0)


@pytest.fixture(scope="module")
def picture(hall, way, kit):
    return hall.render(way[0], kit.camera, samples=1)


def test_points_are_depth_unprojected(picture, way, kit, rng):
    h, w = picture.depth.shape
    pixels = rng.uniform(1, [w - 1, h - 1], (500, 2))
    points, sound = lift_pixels(picture, pixels)
    assert sound.mean() > 0.9
    at = np.floor(pixels).astype(int)
    same = np.ptp(
        [picture.objects[np.clip(at[:, 1] + j, 0, h - 1), np.clip(at[:, 0] + i, 0, w - 1)]
         for j in (-1, 0, 1) for i in (-1, 0, 1)], axis=0) == 0  # fmt: skip
    inside = (points - way[0][:3, 3]) @ way[0][:3, :3]
    rays = kit.camera.directions(pixels)
    off = np.linalg.norm(inside / inside[:, 2:] - rays, axis=1)
    assert off[sound & same].max() < 2e-4
    nearest = picture.depth[at[:, 1], at[:, 0]]
    assert np.abs(inside[:, 2] - nearest)[sound & same].max() < 0.1


def test_holes_and_edges_are_unsound(picture):
    depth, points = picture.depth.copy(), picture.points.copy()
    depth[:] = 2.0
    depth[:, 80:] = 3.0  # another surface
    depth[40:50, 20:30], points[40:50, 20:30] = np.nan, np.nan
    torn = replace(picture, depth=depth, points=points)
    pixels = np.array([[80.0, 20.5], [79.9, 20.5], [25.0, 45.0], [20.0, 45.0], [60.5, 60.5]])
    _, sound = lift_pixels(torn, pixels)
    assert sound.tolist() == [False, False, False, False, True]


@given(st.integers(1, 12), st.floats(0.05, 3.0))
def test_views_are_turned_about_the_vertical(views, spread):
    options = RefineOptions(views=views, spread=spread)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector([0.3, -1.0, 0.4]), (1, 2, 3)
    poses = turn_views(pose, options, np.random.default_rng(views))
    assert len(poses) == views
    np.testing.assert_array_equal(poses[0], pose)
    turns = [vector_from_rotation(p[:3, :3] @ pose[:3, :3].T) for p in poses]
    np.testing.assert_allclose(np.array(turns)[:, :2], 0.0, atol=1e-9)
    yaws = np.array(turns)[1:, 2]
    np.testing.assert_allclose(np.array(poses)[:, :3, 3], np.tile([1, 2, 3], (views, 1)))
    assert (np.abs(yaws) <= spread + 1e-9).all()


def test_the_papers_six_views_are_six(rng):
    """Sec. 3.6: the estimate and five sampled within 45 degrees; none counts twice."""
    options, drawn = RefineOptions.paper(), []
    for _ in range(400):
        poses = turn_views(np.eye(4), options, rng)
        yaws = np.array([vector_from_rotation(p[:3, :3])[2] for p in poses])
        assert len(yaws) == 6
        assert np.abs(np.diff(np.sort(yaws))).min() > 0
        drawn.extend(yaws[1:])
    assert np.histogram(drawn, bins=6, range=(-np.pi / 4, np.pi / 4))[0].min() > 280


class FixedMatcher:
    """Matcher that returns what it was given."""

    name = "fixed"

    def __init__(self, *matches):
        self.matches = matches

    def match(self, query, views, *, masks=None):
        assert len(views) == len(masks) == len(self.matches)
        assert all(v.shape[:2] == m.shape for v, m in zip(views, masks, strict=True))
        assert query.dtype == np.uint8
        return list(self.matches)


def test_matches_become_points_of_the_map(hall, way, walked, picture):
    some = np.array([[30.5, 40.5], [100.5, 80.5], [120.5, 30.5]])
    matcher = FixedMatcher(
        Matches.of(some, some, [0.9, 0.8, 0.7]), Matches.of(some[:1], some[:1], [0.5])
    )
    frame = walked[0]
    matches = match_views(
        Renderer(hall), frame, frame.rgb(), [way[0], way[0]], matcher, size=160, sigma=1.5
    )
    assert len(matches) == 4
    v, u = some.astype(int).T[::-1]
    np.testing.assert_allclose(matches.points[:3], picture.points[v, u], atol=1e-6)
    np.testing.assert_allclose(matches.errors(way[0]), 0.0, atol=1e-2)
    assert (matches.sigma == 1.5 * 160 / 640).all()


def test_smaller_renderings_keep_the_frames_pixels(hall, way, walked):
    frame, some = walked[0], np.array([[30.5, 40.5], [40.5, 20.5], [60.5, 30.5]])

    def matched(points):
        matcher = FixedMatcher(Matches.of(points, points, np.ones(len(points))))
        return match_views(Renderer(hall), frame, frame.rgb(), way[:1], matcher, size=80, sigma=1.0)

    matches = matched(some)
    np.testing.assert_allclose(matches.pixels, 2 * some)
    np.testing.assert_allclose(matches.errors(way[0]), 0.0, atol=0.05)
    assert len(matched(np.array([[0, 0], [80, 60], [80, 10.5], [10.5, 60]], float))) <= 4
    assert len(matched(np.zeros((0, 2)))) == 0


def fabricated(seed, frames=3, count=60, wrong=0.7, noise=0.0):
    """Poses of a rig in one place, and what its frames were matched with: most of it wrong."""
    rng = np.random.default_rng(seed)
    poses, matches = [], []
    for t in range(frames):
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_vector([0.1 * t, 0.3 * t, 0.0])
        pose[:3, 3] = 0.2 * t, 0.05 * t, 0.0
        inside = rng.uniform([-1, -1, 2], [1, 1, 6], (count, 3)) * [0.5, 0.4, 1.0]
        pixels = LENS.project(inside) + noise * rng.normal(size=(count, 2))
        bad = rng.random(count) < wrong
        # what is wrong is wrong by 20 px at least
        far = rng.uniform(20, 200, bad.sum())[:, None]
        angle = rng.uniform(0, 2 * np.pi, bad.sum())
        pixels[bad] += far * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        points = inside @ pose[:3, :3].T + pose[:3, 3]
        poses.append(pose)
        matches.append(PointMatches.of(points, pixels, LENS, 1.0))
    return np.stack(poses), matches


@settings(max_examples=16)
@given(st.integers(0, 999), st.integers(1, 4), st.sets(st.integers(0, 3), max_size=3))
def test_a_rig_is_found_among_seventy_percent_outliers(kit, seed, frames, blind):
    poses, matches = fabricated(seed, frames)
    blind = blind if len(blind & set(range(frames))) < frames else set()
    matches = [PointMatches.empty() if t in blind else s for t, s in enumerate(matches)]
    mounts = list(np.linalg.inv(poses[-1]) @ poses)
    found = solve_rig(matches, mounts, OPTIONS)
    right = [s.errors(p) < 1e-3 for s, p in zip(matches, poses, strict=True)]
    if sum(r.sum() for r in right) < OPTIONS.least:
        assert found is None
        return
    metres, degrees = kit.off(found.pose, poses[-1])
    assert metres < 0.01
    assert degrees < 0.5
    assert found.count >= sum(r.sum() for r in right)
    for inlier, true in zip(found.inliers, right, strict=True):
        assert inlier[true].all()
    again = solve_rig(matches, mounts, OPTIONS)
    np.testing.assert_allclose(again.pose, found.pose, atol=1e-12)  # PoseLib's last digits vary


@pytest.mark.parametrize("seed", range(4))
def test_what_agrees_on_nothing_is_no_pose(seed):
    _, matches = fabricated(seed, wrong=1.0)
    assert solve_frame(matches[0], replace(OPTIONS, inlier=2.0)) is None


def test_too_few_are_no_pose():
    poses, matches = fabricated(1, frames=2, count=5, wrong=0.0)
    assert solve_rig(matches, list(np.linalg.inv(poses[-1]) @ poses), OPTIONS) is None
    assert solve_rig([PointMatches.empty()], [np.eye(4)], OPTIONS) is None


def test_without_poselib_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "poselib", None)
    _, matches = fabricated(1)
    with pytest.raises(MissingExtraError, match="pip install poselib") as raised:
        solve_frame(matches[0], OPTIONS)
    assert str(raised.value).endswith(".")


BENT = Camera(320, 240, 250.0, 240.0, 158.0, 121.0, (-0.1, 0.02, 0.001, -0.001))


@given(st.integers(0, 999))
def test_true_pixels_have_no_error_whatever_the_lens(seed):
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_vector(rng.normal(size=3)), rng.normal(size=3)
    inside = rng.uniform([-0.4, -0.3, 1], [0.4, 0.3, 5], (20, 3))
    points = inside @ pose[:3, :3].T + pose[:3, 3]
    matches = PointMatches.of(points, BENT.project(inside), BENT, 1.5)
    np.testing.assert_allclose(matches.errors(pose), 0.0, atol=1e-4)
    assert matches.focal == 245.0
    # tolerances are meant for images 640 wide; this one has half as many pixels
    assert (matches.sigma == 0.75).all()
    some = matches[np.arange(20) % 2 == 0]
    np.testing.assert_array_equal(some.points, points[::2])
    np.testing.assert_array_equal(some.pixels, matches.pixels[::2])


def test_errors_by_hand():
    assert len(PointMatches.of(np.zeros((0, 3)), np.zeros((0, 2)), BENT, 1.0)) == 0
    assert PointMatches.empty().errors(np.eye(4)).shape == (0,)
    matches = PointMatches.of(np.array([[0, 0, 2.0]]), np.array([[163.0, 121.0]]), BENT, 1.0)
    assert matches.errors(np.eye(4))[0] == pytest.approx(5.0, rel=0.03)  # pixels
    behind = np.array([[0, 0, -2.0], [0, 0, 0.0]])
    matches = PointMatches.of(behind, np.full((2, 2), 100.0), BENT, 1.0)
    assert np.isinf(matches.errors(np.eye(4))).all()


def frame_of(depth, **camera):
    """Frame with a depth image, taken by a camera of its size."""
    h, w = depth.shape
    values = {"fx": 100.0, "fy": 100.0, "cx": w / 2, "cy": h / 2} | camera
    image = np.zeros((h, w, 3), np.uint8)
    return Frame.from_arrays(image, Camera(w, h, **values), depth=depth)


def cut(depth, count=200, phase=0):
    frame = frame_of(np.asarray(depth, np.float32))
    return frame, sample_readings(frame, frame.depth(), count, phase)


def pixels(frame, seen):
    """Rows and columns (N, 2) of the readings."""
    uv = frame.camera.project(seen.directions[seen.depth > 0].astype(float))
    return np.round(uv - 0.5).astype(int)[:, ::-1]


@given(
    st.integers(1, 90), st.integers(1, 90), st.integers(1, 4000), st.integers(0, 99),
)  # fmt: skip
def test_readings_are_the_pixels_values_and_phases_share_none(h, w, count, seed):
    depth = 3.0 + 1e-4 * np.random.default_rng(seed).random((h, w))
    taken = []
    for phase in (0, 1):
        frame, seen = cut(depth, count, phase)
        assert len(seen.depth) == len(seen.directions) == len(seen.normals)
        assert len(seen.depth) % 16 == 0
        assert np.isfinite(seen.directions).all()
        assert np.isfinite(seen.normals).all()
        at = pixels(frame, seen)
        assert len({tuple(p) for p in at}) == len(at)
        np.testing.assert_array_equal(
            seen.depth[seen.depth > 0], depth.astype(np.float32)[at[:, 0], at[:, 1]]
        )
        taken.append({tuple(p) for p in at})
        if count > h * w // 16 and min(h, w) >= 8:
            assert len(at) > 0
    assert not taken[0] & taken[1]


def test_as_many_as_asked_for_evenly_spread():
    frame, seen = cut(np.full((240, 320), 2.0), 1500)
    at = pixels(frame, seen)
    assert 1000 < len(at) < 2000
    quarters = np.bincount((at[:, 0] >= 120) * 2 + (at[:, 1] >= 160), minlength=4)
    assert quarters.min() > 0.8 * quarters.max()


def test_edges_of_depth_are_left_out():
    depth = np.full((60, 80), 3.0)
    depth[20:40, 30:60] = 1.5
    frame, seen = cut(depth, 60 * 80 // 4)
    at = pixels(frame, seen)
    edge = np.zeros(depth.shape, bool)
    edge[20:40, 29:61] = edge[19:41, 30:60] = True  # a corner touches at a point only
    edge[21:39, 31:59] = False
    assert not edge[at[:, 0], at[:, 1]].any()
    assert (seen.depth == 1.5).any()
    assert (seen.depth == 3.0).any()


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.5])
def test_normals_of_a_slanted_plane(slope):
    normal = np.array([slope, 0.0, -1.0]) / np.hypot(slope, 1.0)
    u = (np.arange(80) + 0.5 - 40) / 100.0
    depth = np.tile(3.0 / (1.0 - slope * u), (60, 1))
    _, seen = cut(depth, 400)
    read = seen.depth > 0
    assert np.count_nonzero(read) > 0.7 * min(400, len(read))
    np.testing.assert_allclose(seen.normals[read], np.tile(normal, (read.sum(), 1)), atol=1e-3)


def test_normals_near_holes_are_unknown_not_wrong():
    depth = np.full((40, 40), 2.0)
    depth[:, 20] = np.nan
    _, seen = cut(depth, 400)
    lengths = np.linalg.norm(seen.normals, axis=1)
    assert set(np.round(lengths, 3)) <= {0.0, 1.0}
    np.testing.assert_allclose(np.abs(seen.normals[lengths > 0]) @ [0, 0, 1], 1.0, atol=1e-6)
    _, seen = cut(np.full((30, 40), np.nan))
    assert not seen.depth.any()
    assert not seen.normals.any()
