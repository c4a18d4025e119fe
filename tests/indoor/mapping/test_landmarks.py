import numpy as np
import pytest
from PIL import Image

from placegraph.core.geometry import Camera
from placegraph.indoor.mapping.landmarks import map_landmarks, read_depth
from placegraph.indoor.options import RefineOptions
from placegraph.indoor.refine import correspondences as landmarks
from placegraph.indoor.refine.correspondences import (
    FEATURES,
    agree_on_pose,
    detect_features,
    make_detector,
    match_features,
)
from placegraph.io.capture.frame import Frame

pytest.importorskip("cv2")

CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)
AWAY = 2.0
STEP = 0.004
"""Edge of a texel of the wall [m]."""


def shown(wall, x, z, *, lying=False):
    pose = np.eye(4)
    pose[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    if lying:
        pose[:3, :3] = pose[:3, :3] @ [[0, 1, 0], [-1, 0, 0], [0, 0, 1]]
    pose[:3, 3] = x, 0.0, z
    v, u = np.mgrid[:240, :320] + 0.5
    rays = CAMERA.directions(np.stack([u, v], axis=-1).reshape(-1, 2)) @ pose[:3, :3].T
    at = pose[:3, 3] + AWAY * rays / rays[:, 1:2]
    row, column = (np.clip(at[:, i] / STEP + 500, 0, 999).astype(int) for i in (2, 0))
    frame = Frame.from_arrays(
        np.repeat(wall[row, column].reshape(240, 320, 1), 3, axis=2),
        camera=CAMERA,
        depth=np.full((240, 320), AWAY, np.float32) + 0.01,  # a sensor that reads too far
        odometry=pose,
        gravity=pose[:3, :3].T @ [0, 0, -1],
    )
    return frame, pose


@pytest.fixture(scope="module")
def wall():
    noise = np.random.default_rng(3).integers(0, 256, (80, 80), np.uint8)
    return np.asarray(Image.fromarray(noise).resize((1000, 1000), Image.Resampling.BICUBIC))


@pytest.fixture(scope="module")
def mapped(wall):
    frames, poses = zip(*[shown(wall, x, z) for x in (-0.4, 0, 0.4) for z in (0, 0.3)], strict=True)
    return map_landmarks(frames, np.stack(poses))


def test_rays_of_several_frames_are_truer_than_their_depth(mapped):
    assert len(mapped) > 100
    assert np.median(np.abs(mapped.points[:, 1] - AWAY)) < 0.004


def place(mapped, wall, *, lying=False):
    frame, pose = shown(wall, 0.17, 0.12, lying=lying)
    found = detect_features(make_detector(FEATURES), frame, frame.rgb())
    seen = match_features(mapped, found, frame)
    return agree_on_pose([seen], np.eye(4)[None], RefineOptions()), pose


@pytest.mark.parametrize("lying", [False, True])
def test_an_image_beside_them_is_placed_to_millimetres(wall, mapped, lying):
    found, pose = place(mapped, wall, lying=lying)
    assert found.count > 50
    assert np.linalg.norm(found.pose[:3, 3] - pose[:3, 3]) < 0.008


def test_an_image_of_another_place_is_not(mapped):
    noise = np.random.default_rng(4).integers(0, 256, (80, 80), np.uint8)
    other = np.asarray(Image.fromarray(noise).resize((1000, 1000), Image.Resampling.BICUBIC))
    assert place(mapped, other)[0] is None


def test_features_beyond_a_fisheyes_rim_have_no_depth(wall):
    frame, _ = shown(wall, 0.0, 0.0)
    rays = np.array([[0.0, 0.0, 1.0], [np.nan] * 3, [0.1, 0.1, 1.0]])
    np.testing.assert_allclose(
        read_depth(frame, rays), [AWAY + 0.01, np.nan, AWAY + 0.01], atol=1e-5
    )


def test_landmarks_gone_through_in_blocks_are_the_same(wall, mapped, monkeypatch):
    frame, _ = shown(wall, 0.17, 0.12)
    found = detect_features(make_detector(FEATURES), frame, frame.rgb())
    whole = match_features(mapped, found, frame)
    cosine = found.vectors @ mapped.unit_vectors.T
    best, rows = landmarks._rank_landmarks(found.vectors, mapped.unit_vectors)
    np.testing.assert_allclose(best, -np.sort(-cosine, axis=1)[:, : best.shape[1]], atol=1e-6)
    np.testing.assert_array_equal(rows[:, 0], cosine.argmax(axis=1))
    monkeypatch.setattr(landmarks, "_BLOCK", 37)
    parts = match_features(mapped, found, frame)
    np.testing.assert_array_equal(parts.points, whole.points)
    assert len(whole) > 50
    assert mapped.unit_vectors is mapped.unit_vectors
