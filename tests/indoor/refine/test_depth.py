"""Depth readings: where they are taken, where not, and what their normals are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera
from placegraph.indoor.refine.depth import Surfaces, distances, readings
from placegraph.io.capture.frame import Frame


def frame_of(depth, **camera):
    """Frame with a depth image, taken by a camera of its size."""
    h, w = depth.shape
    values = {"fx": 100.0, "fy": 100.0, "cx": w / 2, "cy": h / 2} | camera
    image = np.zeros((h, w, 3), np.uint8)
    return Frame.from_arrays(image, Camera(w, h, **values), depth=depth)


def cut(depth, count=200, phase=0):
    frame = frame_of(np.asarray(depth, np.float32))
    return frame, readings(frame, frame.depth(), count, phase)


def pixels(frame, seen):
    """Rows and columns (N, 2) of the readings."""
    uv = frame.camera.project(seen.directions[seen.depth > 0].astype(float))
    return np.round(uv - 0.5).astype(int)[:, ::-1]


@given(
    st.integers(8, 90), st.integers(8, 90), st.integers(1, 4000), st.integers(0, 99),
)  # fmt: skip
def test_readings_are_the_pixels_values_and_phases_share_none(h, w, count, seed):
    depth = 3.0 + 1e-4 * np.random.default_rng(seed).random((h, w))
    taken = []
    for phase in (0, 1):
        frame, seen = cut(depth, count, phase)
        assert len(seen.depth) == len(seen.directions) == len(seen.normals)
        assert len(seen.depth) % 16 == 0
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
    """z = 3 + slope x: towards the camera, and no edge anywhere."""
    normal = np.array([slope, 0.0, -1.0]) / np.hypot(slope, 1.0)
    u = (np.arange(80) + 0.5 - 40) / 100.0
    depth = np.tile(3.0 / (1.0 - slope * u), (60, 1))
    _, seen = cut(depth, 400)
    told = seen.depth > 0
    assert np.count_nonzero(told) > 0.7 * min(400, len(told))
    np.testing.assert_allclose(seen.normals[told], np.tile(normal, (told.sum(), 1)), atol=1e-3)


def test_normals_near_holes_are_unknown_not_wrong():
    depth = np.full((40, 40), 2.0)
    depth[:, 20] = np.nan
    _, seen = cut(depth, 400)
    lengths = np.linalg.norm(seen.normals, axis=1)
    assert set(np.round(lengths, 3)) <= {0.0, 1.0}
    np.testing.assert_allclose(np.abs(seen.normals[lengths > 0]) @ [0, 0, 1], 1.0, atol=1e-6)


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (3, 5), (7, 4), (481, 641)])
@pytest.mark.parametrize("phase", [0, 1])
def test_odd_sizes(shape, phase):
    _, seen = cut(np.full(shape, 2.0), 100, phase)
    assert np.isfinite(seen.directions).all()
    assert np.isfinite(seen.normals).all()
    assert set(seen.depth.tolist()) <= {0.0, 2.0}


def test_no_reading_at_all():
    _, seen = cut(np.full((30, 40), np.nan))
    assert not seen.depth.any()
    assert not seen.normals.any()


def test_frames_without_depth_have_no_distances(hall, way, walked):
    seen = readings(walked[0], walked[0].depth(), 100)
    off = distances(Surfaces.of(hall), [None, seen], way[:1].repeat(2, axis=0))
    assert off[0].shape == (0,)
    assert np.nanmax(off[1]) < 1e-4


def test_surfaces_have_unit_normals(room):
    normals = Surfaces.of(room).normals
    lengths = np.linalg.norm(normals, axis=1)
    np.testing.assert_allclose(lengths[lengths > 0.5], 1.0, atol=1e-5)
    assert np.isfinite(normals).all()
