"""Maps of local features that ours are compared with."""

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.refine.matching.matches import Features
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.named.indoor_colmap import Answer, Row, View, peer, report, vlad

CAMERA = Camera(320, 240, 300.0, 300.0, 160.0, 120.0)


def test_the_same_features_give_the_nearest_image(rng):
    words = rng.normal(size=(8, 16)).astype(np.float32)
    images = [rng.normal(size=(50, 16)).astype(np.float32) for _ in range(5)]
    signatures = np.stack([vlad(image, words) for image in images])
    assert np.allclose(np.linalg.norm(signatures, axis=1), 1.0, atol=1e-5)
    noisy = images[3] + 0.1 * rng.normal(size=(50, 16)).astype(np.float32)
    assert (signatures @ vlad(noisy, words)).argmax() == 3


def test_a_peer_finds_the_pose_and_nothing_of_strangers(rng):
    pytest.importorskip("pycolmap")

    def unit(count):
        vectors = rng.normal(size=(count, 32)).astype(np.float32)
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    low, high = [-1, -1, 3], [1, 1, 5]
    views = [View(rng.uniform(low, high, (80, 3)), unit(80)) for _ in range(3)]
    pose = np.eye(4)
    pose[:3, 3] = 0.1, -0.2, 0.3
    shown = Features(CAMERA.project(views[1].points - pose[:3, 3]), views[1].vectors)
    frame = Frame.from_arrays(np.zeros((240, 320, 3), np.uint8), CAMERA, gravity=[0, 1, 0])
    asked = peer(views, lambda _: shown, 44, 0.8, rng)
    assert np.allclose(asked.ask(frame), pose, atol=1e-3)
    assert 80 * 3 * 44e-6 < asked.megabytes < 0.1
    strange = peer(views, lambda _: Features(shown.points, unit(80)), 44, 0.8, rng)
    assert strange.ask(frame) is None


def test_what_found_no_pose_counts_in_the_median():
    found = Answer(1, 0.02, 0.5, sure=True, wrong=False, milliseconds=10.0)
    none = Answer(2, np.inf, np.inf, sure=False, wrong=False, milliseconds=30.0)
    lines = report([Row("office", "images", 0.5, (found, none, none))]).splitlines()
    assert [cell.strip() for cell in lines[-1].split("|")[1:-1]] == [
        "images", "∞ cm, ∞°", ".33", "1 of 3", "0", "0.50", "30",
    ]  # fmt: skip
