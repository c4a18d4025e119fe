from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.indoor.encode import Encoder, Patches
from placegraph.indoor.encode.labels import LabelsEncoder
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.bench import NoisyLabels, mislabel

CAMERA = Camera(32, 18, 20.0, 20.0, 16.0, 9.0)


def patches(rows, count=5):
    table = np.eye(count, 7, dtype=np.float32)
    return Patches(CAMERA, (1, len(rows)), np.array(rows, np.int32), table)


def frame(index):
    return SimpleNamespace(index=index)


def test_as_many_are_wrong_as_said_and_all_others_equally_often(rng):
    clean = patches([3] * 40_000)
    noisy = mislabel(clean, 0.3, rng)
    assert noisy.table is clean.table
    assert noisy.rows.dtype == np.int32
    share = np.bincount(noisy.rows, minlength=5) / 40_000
    assert share[3] == pytest.approx(0.7, abs=0.01)
    assert share[[0, 1, 2, 4]] == pytest.approx(0.075, abs=0.006)


NAMES = {0: "chair", 1: "desk", 2: "floor", 3: "elephant", 4: "unknown"}
VOCABULARY = ("chair", "desk", "floor", "sofa", "couch", "unknown")


def labelled(value, index=0):
    """A frame that shows one label in all its 4096 pixels, each a patch."""
    return Frame.from_arrays(
        np.zeros((64, 64, 3), np.uint8), Camera(64, 64, 50.0, 50.0, 32.0, 32.0),
        labels=np.full((64, 64), value), label_names=NAMES, index=index,
    )  # fmt: skip


def count_words(noisy, value, index=0):
    """How often each word of the vocabulary and the label itself is said, as shares."""
    got = noisy.patches(labelled(value, index)).reshape(-1, noisy.dimension)
    words = [*VOCABULARY[:4], NAMES[value]]
    return {w: float((got @ noisy.encoder.vector(w) > 0.999).mean()) for w in words}


@pytest.mark.parametrize("value", [0, 1, 2])
def test_labels_err_to_all_others_of_the_vocabulary_equally_often(value):
    noisy = NoisyLabels(LabelsEncoder((64, 64)), VOCABULARY, 0.3, seed=3)
    assert isinstance(noisy, Encoder)
    got = count_words(noisy, value)
    assert got.pop(NAMES[value]) == pytest.approx(0.7, abs=0.03)
    # four labels: a sofa is a couch, and what is unknown is no label
    assert list(got.values()) == pytest.approx([0.1] * 3, abs=0.02)


def test_labels_err_alike_whenever_they_are_encoded():
    clean = LabelsEncoder((64, 64))
    noisy = NoisyLabels(clean, VOCABULARY, seed=1, name="seq00")
    first = noisy.patches(labelled(0, 7))
    assert (noisy.patches(labelled(0, 7)) == first).all()
    for other, index in ((noisy, 8), (NoisyLabels(clean, VOCABULARY, seed=1, name="x"), 7)):
        assert (other.patches(labelled(0, index)) != first).any()
