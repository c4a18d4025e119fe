"""Compiled loops of the refinement against plain NumPy and numeric derivatives."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placegraph.core.geometry import rotation_from_vector
from placegraph.indoor.refine.correspondences import Kernel, Surfaces, sample_readings
from placegraph.indoor.refine.refine_kernels import (
    correlations,
    depth_system,
    pixel_system,
    plane_distances,
)

STEP = 1e-6
SMALL = st.floats(-0.05, 0.05)


def perturb_pose(pose, d):
    """A pose (4, 4) after a shift and a turn `d` (6,) in map axes."""
    out = pose.copy()
    out[:3, :3] = rotation_from_vector(d[3:]) @ pose[:3, :3]
    out[:3, 3] += d[:3]
    return out


def derivatives(errors):
    """(R, 6) of a function of a small motion (6,), by central differences."""
    columns = [(errors(STEP * unit) - errors(-STEP * unit)) / (2 * STEP) for unit in np.eye(6)]
    return np.stack(columns, axis=1)


def parts(pose):
    return np.ascontiguousarray(pose[:3, :3]), np.ascontiguousarray(pose[:3, 3])


@pytest.fixture(scope="module")
def frame(walked):
    return walked[0]


@pytest.fixture(scope="module")
def sample_frame(frame):
    return sample_readings(frame, frame.depth(), 200)


@settings(max_examples=25)
@given(st.tuples(SMALL, SMALL, SMALL, SMALL, SMALL, SMALL), st.floats(2.0, 30.0))
def test_depth_equations_are_those_of_planes_that_are_held(hall, way, sample_frame, d, width):
    pose = perturb_pose(way[0], np.array(d))
    noise = 0.01, 0.003, 0.008
    kernel = Kernel(*noise, (0.5, 0.85), width)
    shares = np.array([1.0, 0.3])
    h, g, told, sums = depth_system(
        Surfaces.of(hall),
        shares,
        *parts(pose),
        sample_frame.directions,
        sample_frame.depth,
        sample_frame.normals,
        kernel,
    )
    aims = sample_frame.directions @ pose[:3, :3].T
    hits = hall.caster.cast(np.broadcast_to(pose[:3, 3], aims.shape), aims)
    rows = (hits.triangle >= 0) & (sample_frame.depth > 0)
    normal = Surfaces.of(hall).normals[hits.triangle[rows]].astype(float)
    aims, depth = aims[rows], sample_frame.depth[rows].astype(float)
    points = pose[:3, 3] + aims * hits.distance[rows, None]
    inside = sample_frame.directions[rows] * depth[:, None]

    def errors(d):
        moved = perturb_pose(pose, d)
        at = inside @ moved[:3, :3].T + moved[:3, 3]
        return np.sum(normal * (at - points), axis=1)

    j, e = derivatives(errors), errors(np.zeros(6))
    slant = np.sum(normal * aims, axis=1)
    variance = ((noise[0] + noise[1] * depth**2) * slant) ** 2 + noise[2] ** 2
    facing = np.abs(np.sum((normal @ pose[:3, :3]) * sample_frame.normals[rows], axis=1))
    share = np.clip((facing - 0.5) / 0.35, 0, 1)
    ratio = e**2 / (variance * width**2)
    objects = hall.mesh.object_of[hits.triangle[rows]]
    robust = share / (1 + ratio) ** 2
    w = robust * shares[objects] / variance
    scale = np.abs(j.T @ (w[:, None] * j)).max()
    np.testing.assert_allclose(h, j.T @ (w[:, None] * j), atol=3e-4 * scale)
    # rays and distances are float32: a few micrometres
    off = 3e-4 * np.sqrt(scale * np.sum(w * e**2)) + 5e-6 * scale
    np.testing.assert_allclose(g, j.T @ (w * e), atol=off)
    np.testing.assert_allclose(told[:, 0], np.bincount(objects, robust, 2), rtol=1e-3)
    np.testing.assert_array_equal(told[:, 1], np.bincount(objects, minlength=2))
    assert sums[0] == np.count_nonzero(sample_frame.depth > 0)
    assert sums[2] == np.count_nonzero(rows)
    assert 0.0 <= sums[1] <= sums[0]


def test_what_faces_away_has_no_say(hall, way, sample_frame):
    kernel = Kernel(0.01, 0.0, 0.01, (0.5, 0.85), 5.0)
    rest = (
        Surfaces.of(hall),
        np.ones(2),
        *parts(way[0]),
        sample_frame.directions,
        sample_frame.depth,
    )
    across = np.roll(sample_frame.normals, 1, axis=1) * [[0.0, 1.0, 0.0]]
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    full = depth_system(*rest, sample_frame.normals, kernel)[2][:, 0].sum()
    assert depth_system(*rest, np.zeros_like(sample_frame.normals), kernel)[2][:, 0].sum() == 0.0
    assert depth_system(*rest, across.astype(np.float32), kernel)[2][:, 0].sum() < 0.7 * full


def test_distances_from_a_wall_are_along_its_normal(kit):
    hall = kit.boxes({"hall": ((0, 0, 0), (6, 4, 3))})
    pose = kit.standing(4.0, 2.0, 20.0, down_deg=0.0)
    frame = kit.frames(hall, pose[None])[0]
    seen = sample_readings(frame, frame.depth(), 400)
    surfaces = Surfaces.of(hall)
    aims = seen.directions @ pose[:3, :3].T
    hit = pose[:3, 3] + aims * seen.depth[:, None]
    wall = (seen.depth > 0) & (np.abs(hit[:, 0] - 6.0) < 1e-3) & (hit[:, 2] > 0.3)
    wall &= (hit[:, 1] > 0.3) & (hit[:, 1] < 3.7) & (hit[:, 2] < 2.7)
    assert np.count_nonzero(wall) > 50
    exact = plane_distances(surfaces, *parts(pose), seen.directions, seen.depth)
    assert np.nanmax(exact) < 1e-4
    assert np.array_equal(np.isnan(exact), seen.depth <= 0)
    nearer = kit.moved(pose, (0.2, 0.0, 0.0))
    off = plane_distances(surfaces, *parts(nearer), seen.directions, seen.depth)
    np.testing.assert_allclose(off[wall], 0.2, atol=1e-4)
    outside = kit.standing(7.0, 2.0, 0.0)  # where the map shows nothing
    off = plane_distances(surfaces, *parts(outside), seen.directions, seen.depth)
    assert np.isinf(off[seen.depth > 0]).all()


@settings(max_examples=40)
@given(
    st.tuples(SMALL, SMALL, SMALL, SMALL, SMALL, SMALL), st.integers(0, 999), st.floats(0.5, 20.0)
)
def test_pixel_equations_are_those_of_reprojection(d, seed, width):
    rng = np.random.default_rng(seed)
    pose = perturb_pose(np.eye(4), rng.normal(size=6))
    inside = rng.uniform([-1, -1, 0.5], [1, 1, 4], (12, 3))
    points = inside @ pose[:3, :3].T + pose[:3, 3]
    rays = inside[:, :2] / inside[:, 2:] + rng.normal(size=(12, 2)) * 0.01
    sigma, focal = rng.uniform(0.5, 3.0, 12), 150.0
    start = perturb_pose(pose, np.array(d))

    def errors(d):
        moved = perturb_pose(start, d)
        at = (points - moved[:3, 3]) @ moved[:3, :3]
        return (focal * (at[:, :2] / at[:, 2:] - rays)).ravel()

    h, g, total = pixel_system(*parts(start), points, rays, sigma, focal, width)
    ahead = ((points - start[:3, 3]) @ start[:3, :3])[:, 2] >= 0.05
    assert ahead.all()
    j, e = derivatives(errors), errors(np.zeros(6))
    robust = 1 / (1 + np.sum(e.reshape(-1, 2) ** 2, axis=1) / (sigma * width) ** 2) ** 2
    w = np.repeat(robust / sigma**2, 2)
    scale = np.abs(j.T @ (w[:, None] * j)).max()
    np.testing.assert_allclose(h, j.T @ (w[:, None] * j), atol=1e-5 * scale)
    off = 1e-5 * np.sqrt(scale * np.sum(w * e**2)) + 1e-9 * scale
    np.testing.assert_allclose(g, j.T @ (w * e), atol=off)
    assert total == pytest.approx(robust.sum())
    # points behind the camera say nothing
    behind = np.array([[0.1, 0.2, -2.0], [0.0, 0.0, 0.01]])
    rest = np.zeros((2, 2)), np.ones(2), 100.0, 3.0
    h, g, total = pixel_system(np.eye(3), np.zeros(3), behind, *rest)
    assert not any((h.any(), g.any(), total))


@given(st.integers(0, 999))
def test_correlations_are_numpys(seed):
    rng = np.random.default_rng(seed)
    query = rng.random((20, 24), np.float32)
    drawn = (0.5 * query + 0.5 * rng.random((20, 24))).astype(np.float32)
    seen = rng.random((20, 24)) < 0.9
    at = rng.integers(3, 17, (15, 2))
    found = correlations(query, drawn, seen, at, 3)
    for value, (row, column) in zip(found, at, strict=True):
        window = slice(row - 3, row + 4), slice(column - 3, column + 4)
        shown = seen[window]
        expected = np.corrcoef(query[window][shown], drawn[window][shown])[0, 1]
        assert value == pytest.approx(max(0.0, expected), abs=1e-4)


def test_flat_windows_of_the_query_are_no_samples():
    flat, rough = np.full((9, 9), 0.4, np.float32), np.eye(9, dtype=np.float32)
    seen, at = np.ones((9, 9), bool), np.array([[4, 4]])
    assert np.isnan(correlations(flat, rough, seen, at, 3)).all()
    assert correlations(rough, flat, seen, at, 3).tolist() == [0.0]
    assert correlations(rough, rough, seen, at, 3)[0] == pytest.approx(1.0, abs=1e-5)
    assert correlations(rough, rough, ~seen, at, 3).tolist() == [0.0]
    assert correlations(rough, 0.1 + 0.5 * rough, seen, at, 3)[0] == pytest.approx(1.0, abs=1e-5)
    assert correlations(rough, 1.0 - rough, seen, at, 3).tolist() == [0.0]
