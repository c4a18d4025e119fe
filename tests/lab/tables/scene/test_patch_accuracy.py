import numpy as np
import pytest

from placegraph.indoor.encode import Patches
from placegraph.indoor.options import PoseSearchOptions
from placegraph_lab.tables.named.patch_accuracy import (
    COLUMNS,
    accuracy,
    drawn_home,
    mean,
    true_objects,
)
from placegraph_lab.tables.runner import render


@pytest.fixture(scope="module")
def place():
    return drawn_home(0)


class Knowing:
    """Says what share of the patches truly shows, of the rest what is wrong, or nothing."""

    def __init__(self, place, right, silent=0.0):
        self.place, self.right, self.silent = place, right, silent
        self.rng = np.random.default_rng(1)

    def encode(self, frame):
        scene = self.place.scene
        camera = frame.camera
        true = true_objects(scene, camera, self.place.map_from_camera[frame.index], (9, 16))
        said = np.where(self.rng.random(144) < self.right, true, (true + 1) % len(scene))
        rows = np.where(self.rng.random(144) < self.silent, -1, np.maximum(said, 0))
        table = 2.0 * np.eye(len(scene), dtype=np.float32) - 1.0
        return Patches(camera, (9, 16), rows.astype(np.int32), table, 0.1)


def test_rays_say_what_patches_show(place):
    """As the frames' own label images do."""
    labels = place.scene.graph.labels
    for frame, pose in zip(place.frames[:4], place.map_from_camera, strict=False):
        true = true_objects(place.scene, frame.camera, pose, (9, 16)).reshape(9, 16)
        shown = frame.labels()
        agree = []
        for (y, x), row in np.ndenumerate(true):
            if row >= 0:
                h, w = shown.shape
                middle = shown[int((y + 0.5) * h / 9), int((x + 0.5) * w / 16)]
                agree.append(frame.label_names.get(int(middle)) == labels[row])
        assert np.mean(agree) > 0.85
        assert len(agree) > 100


def test_who_knows_everything(place):
    told = accuracy(Knowing(place, 1.0), place.scene, place.frames[:3], place.map_from_camera[:3])
    assert (told.best, told.auc, told.encoded) == (1.0, 1.0, 1.0)
    background = place.scene.visibility(PoseSearchOptions()).background.objects
    views = zip(place.frames[:3], place.map_from_camera, strict=False)
    true = np.concatenate([true_objects(place.scene, f.camera, p, (9, 16)) for f, p in views])
    surprise = -np.log(background[true[true >= 0]]).mean()  # all there is to know
    assert told.bare == pytest.approx(surprise, abs=1e-3)
    assert 0.5 * surprise < told.nats < surprise
    assert told.patches == (true >= 0).sum()


def test_tables(place):
    told = accuracy(Knowing(place, 0.8), place.scene, place.frames[:2], place.map_from_camera[:2])
    both = mean([told, None, told])
    assert both.patches == 2 * told.patches
    assert both.nats == pytest.approx(told.nats)
    assert mean([None]) is None
    text = render(COLUMNS, [("homes, knowing", told), ("homes, silent", None)])
    assert "| homes, knowing" in text
    assert f"{told.nats:.2f}" in text
    assert "–" in text.splitlines()[3]
