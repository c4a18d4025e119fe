"""Labels that are wrong as often as said, and wrong in the same way every time."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.errors import OptionError
from placegraph.evaluate.label_noise import NoisyEncoder, mislabel
from placegraph.geometry import Camera
from placegraph.indoor.encode import MapEncoder, Patches

CAMERA = Camera(32, 18, 20.0, 20.0, 16.0, 9.0)


def patches(rows, count=5):
    table = np.eye(count, 7, dtype=np.float32)
    return Patches(CAMERA, (1, len(rows)), np.array(rows, np.int32), table)


class Fixed:
    """An encoder that says the same of every frame."""

    def __init__(self, said):
        self.said = said

    def encode(self, frame):  # noqa: ARG002
        return self.said


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


def test_what_says_nothing_goes_on_saying_nothing(rng):
    assert (mislabel(patches([-1] * 500), 1.0, rng).rows == -1).all()
    assert (mislabel(patches([2] * 500), 1.0, rng).rows != 2).all()
    assert (mislabel(patches([2] * 500), 0.0, rng).rows == 2).all()
    assert (mislabel(patches([0] * 500, count=1), 1.0, rng).rows == 0).all()  # no other to say


def test_a_frame_errs_alike_whenever_it_is_encoded():
    clean = patches(np.arange(500) % 5)
    noisy = NoisyEncoder(Fixed(clean), seed=1, name="seq00")
    assert isinstance(noisy, MapEncoder)
    first = noisy.encode(frame(7)).rows
    other = noisy.encode(frame(8)).rows
    assert (noisy.encode(frame(7)).rows == first).all()
    assert (NoisyEncoder(Fixed(clean), seed=1, name="seq00").encode(frame(7)).rows == first).all()
    elsewhere = NoisyEncoder(Fixed(clean), seed=1, name="seq01").encode(frame(7)).rows
    again = NoisyEncoder(Fixed(clean), seed=2, name="seq00").encode(frame(7)).rows
    for rows in (other, elsewhere, again):
        both = (rows != clean.rows) & (first != clean.rows)
        assert both.mean() == pytest.approx(0.09, abs=0.05)  # independent


def test_no_labels_are_no_labels():
    assert NoisyEncoder(Fixed(None)).encode(frame(0)) is None
    with pytest.raises(OptionError, match="share"):
        NoisyEncoder(Fixed(None), 1.2)
