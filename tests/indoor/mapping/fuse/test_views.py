"""Frames made ready: undistorted, their poses checked."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera
from placegraph.indoor.mapping.fuse import fuse, good_poses, undistorted, view_of
from placegraph.io.capture.frame import Frame

WIDE = (-0.28, 0.09, 0.0, 0.0, -0.015)


@given(k1=st.floats(-0.3, 0.3), p1=st.floats(-0.01, 0.01))
def test_undistorted_pixels_stand_on_their_rays(k1, p1):
    camera = Camera(64, 48, 50.0, 50.0, 31.0, 25.0, (k1, 0.02, p1, 0.0))
    plain, table = undistorted(camera)
    v, u = np.nonzero(table >= 0)
    rays = plain.directions(np.stack([u, v], axis=-1) + 0.5)
    line, column = np.divmod(table[v, u], 64)
    there = np.stack([column, line], axis=-1) + 0.5
    assert np.abs(camera.project(rays) - there).max() <= 0.5 + 1e-6
    assert len(v) > 0.6 * 64 * 48  # a pincushion's image becomes smaller
    assert not any(plain.distortion)


def test_a_wall_behind_a_wide_lens_is_flat(scene):
    camera = Camera(120, 90, 90.0, 90.0, 60.0, 45.0, WIDE)
    frame, pose = scene.plane_view(1.5, camera=camera, slope=0.4)
    mesh = fuse([frame], pose[None], voxel=0.04)
    off = (mesh.vertices[:, 2] - 0.4 * mesh.vertices[:, 0] - 1.5) / np.hypot(1, 0.4)
    assert np.sqrt((off**2).mean()) < 0.04 / 5
    assert (mesh.colours == 100).all()


def test_frames_without_a_reading_give_no_view():
    camera = Camera(8, 6, 5.0, 5.0, 4.0, 3.0)
    rgb = np.zeros((6, 8, 3), np.uint8)
    assert view_of(Frame.from_arrays(rgb, camera), 0, np.eye(4)) is None
    nothing = Frame.from_arrays(rgb, camera, depth=np.full((6, 8), np.nan))
    assert view_of(nothing, 0, np.eye(4)) is None


def test_slips_are_told_from_walks_and_turns():
    walk = np.tile(np.eye(4), (9, 1, 1))
    walk[:, 0, 3] = 0.3 * np.arange(9)
    assert good_poses(walk).all()
    apart = walk.copy()
    apart[4:, 1, 3] += 5.0  # another recording begins
    assert good_poses(apart).all()
    slipped = walk.copy()
    slipped[4, 1, 3] += 5.0
    assert np.flatnonzero(~good_poses(slipped)).tolist() == [4]
    assert good_poses(walk[:2]).all()
    assert good_poses(walk[:0]).shape == (0,)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda p: p * np.nan, lambda p: np.full_like(p, np.inf), lambda p: p @ np.diag([1, 1, -1.0, 1]),
        lambda p: p @ np.diag([2, 2, 2.0, 1]), lambda p: p + 1e6, lambda p: 0 * p,
    ],
)  # fmt: skip
def test_what_is_no_pose_is_not_believed(spoil):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[1] = spoil(poses[1])
    assert good_poses(poses).tolist() == [True, False, True]
