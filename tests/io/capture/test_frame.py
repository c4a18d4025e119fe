"""Quarter turns of image, intrinsics and pose; files that are read when they are asked for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, rotation_from_vector
from placegraph.errors import InputError
from placegraph.io.capture.frame import (
    LazyImages,
    check_shape,
    depth_file,
    posed_frame,
    quarter_turn,
    rotate_camera,
    upright_turns,
)
from placegraph.io.capture.posed import match_stamps, orthonormalize_pose, pose_from_quaternion

CAMERA = Camera(8, 6, 10.0, 11.0, 4.5, 2.8, (0.1, -0.02, 0.003, -0.004, 0.01))


@given(st.integers(-4, 7), st.tuples(*[st.floats(-0.4, 0.4)] * 2))
def test_a_turned_camera_sees_what_the_turned_image_shows(turns, xy):
    point = np.array([*xy, 1.0])
    u, v = CAMERA.project(point)
    turned = rotate_camera(CAMERA, turns)
    for _ in range(turns % 4):  # as np.rot90 moves pixels, once a turn
        wide = CAMERA.width if _ % 2 == 0 else CAMERA.height
        u, v = v, wide - u
    np.testing.assert_allclose(turned.project(quarter_turn(turns) @ point), [u, v], atol=1e-9)


@pytest.mark.parametrize("turns", range(4))
def test_pixels_follow(turns):
    image = np.arange(48).reshape(6, 8)
    turned = LazyImages(lambda: image, turns=turns).rgb()
    assert turned.shape == (rotate_camera(CAMERA, turns).height, rotate_camera(CAMERA, turns).width)
    pinhole = Camera(8, 6, 10.0, 11.0, 4.5, 2.8)
    ray = quarter_turn(turns) @ pinhole.directions([2.5, 4.5])
    u, v = rotate_camera(pinhole, turns).project(ray)
    assert turned[int(v), int(u)] == image[4, 2]


@given(st.integers(0, 3), st.tuples(*[st.floats(-3, 3)] * 3), st.floats(-0.6, 0.6))
def test_frames_stand_upright(turns, vector, roll):
    upright = np.eye(4)
    upright[:3, :3] = rotation_from_vector([0, 0, vector[0]]) @ [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    upright[:3, :3] = upright[:3, :3] @ rotation_from_vector([0, 0, roll])
    upright[:3, 3] = vector
    stored = upright.copy()
    stored[:3, :3] = upright[:3, :3] @ quarter_turn(turns)
    assert upright_turns(-stored[2, :3]) == turns
    frame = posed_frame(0, 1.0, stored, CAMERA, LazyImages(lambda: None), turns=turns)
    np.testing.assert_allclose(frame.odometry, upright, atol=1e-9)
    np.testing.assert_allclose(frame.gravity, -upright[2, :3], atol=1e-9)
    assert frame.camera == rotate_camera(CAMERA, turns)


def test_confidence_and_images_of_another_size(save, tmp_path):
    check_shape(np.zeros((6, 8)), CAMERA, "it")
    with pytest.raises(InputError, match="it has 6 x 8 pixels, but its camera has 8 x 6"):
        check_shape(np.zeros((8, 6)), CAMERA, "it")
    save(tmp_path / "d.png", np.full((6, 8), 1500, np.uint16))
    save(tmp_path / "c.png", np.zeros((3, 4), np.uint8))
    with pytest.raises(InputError, match=r"c.png has 4 x 3"):
        depth_file(tmp_path / "d.png", CAMERA, 1000.0, confidence=tmp_path / "c.png")()
    save(tmp_path / "c.png", np.eye(6, 8, dtype=np.uint8))
    depth = depth_file(tmp_path / "d.png", CAMERA, 1000.0, confidence=tmp_path / "c.png")()
    np.testing.assert_array_equal(depth, np.where(np.eye(6, 8), np.float32(1.5), np.nan))


@given(
    st.lists(st.floats(0, 10), max_size=20),
    st.lists(st.floats(0, 10), max_size=20),
    st.floats(0, 3),
)
def test_nearest_stamps(known, asked, tolerance):
    rows = match_stamps(known, asked, tolerance)
    for stamp, row in zip(asked, rows, strict=True):
        gaps = np.abs(np.array(known) - stamp)
        if row < 0:
            assert not (gaps <= tolerance).any()
        else:
            assert gaps[row] == gaps.min() <= tolerance


@given(st.tuples(*[st.floats(-3, 3)] * 3))
def test_rigid_transforms(vector):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_vector(vector)
    pose[:3, 3] = vector
    np.testing.assert_allclose(
        orthonormalize_pose(pose[:3].ravel().round(4), "it"), pose, atol=1e-3
    )
    for wrong in (pose * 1.1, pose @ np.diag([1, 1, -1, 1]), pose * np.nan):
        with pytest.raises(InputError, match="it "):
            orthonormalize_pose(wrong, "it")


def test_quaternions():
    np.testing.assert_array_equal(
        pose_from_quaternion([1, 2, 3], [0, 0, 0, 1], "it")[:3, 3], [1, 2, 3]
    )
    for wrong in ([0, 0, 0, 0], [0, 0, 0, np.nan], [0, 0, 0, 2]):
        with pytest.raises(InputError, match="it: the quaternion has length"):
            pose_from_quaternion([1, 2, 3], wrong, "it")
