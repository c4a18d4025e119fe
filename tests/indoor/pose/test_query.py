"""What is asked: which frames, by which options, of which map."""

from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.errors import OptionError
from placegraph.indoor.options import PoseSearchOptions
from placegraph.indoor.pose.window import PoseQuery, chosen_frames
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame

CAMERA = Camera(8, 6, 8.0, 8.0, 4.0, 3.0)


@pytest.fixture(scope="module")
def capture():
    image = np.zeros((6, 8, 3), np.uint8)
    frames = [Frame.from_arrays(image, CAMERA, stamp=i / 5, index=i) for i in range(6)]
    return Capture.from_frames(frames)


@pytest.mark.parametrize(
    ("asked", "rows"),
    [
        (None, [0, 1, 2, 3, 4, 5]),
        (slice(2, 4), [2, 3]),
        (slice(None, None, 2), [0, 2, 4]),
        (slice(-2, None), [4, 5]),
        ([1, 3], [1, 3]),
        ((0,), [0]),
        (np.array([2, 5]), [2, 5]),
        ([-6, -1], [0, 5]),
        (range(1, 3), [1, 2]),
    ],
)
def test_by_slice_by_rows_or_all(capture, asked, rows):
    assert [f.index for f in chosen_frames(capture, asked)] == rows
    assert [f.index for f in chosen_frames(list(capture), asked)] == rows


@pytest.mark.parametrize(
    ("asked", "says"),
    [
        ([], "none chosen"),
        (slice(3, 3), "none chosen"),
        (slice(9, 12), "none chosen"),
        ([6], "outside"),
        ([-7], "outside"),
        ([3, 1], "order of time"),
        ([1, 1], "each frame once"),
        (slice(None, None, -1), "order of time"),
        ([1.5], "whole numbers"),
        (["1"], "whole numbers"),
        ("123", "whole numbers"),
        (3, "whole numbers"),
    ],
)
def test_what_is_refused(capture, asked, says):
    with pytest.raises(OptionError, match=says) as raised:
        chosen_frames(capture, asked)
    assert str(raised.value).startswith("frames")


def test_nothing_to_choose_from():
    with pytest.raises(OptionError, match="none chosen of the capture's 0"):
        chosen_frames([], None)


def test_of_the_frames_chosen_keyframes_are_asked_about(room, capture):
    query = PoseQuery.of(room, capture, frames=slice(1, 6), options=PoseSearchOptions(every=0.35))
    assert [f.index for f in query.frames] == [1, 3, 5]
    assert PoseQuery.of(room).frames == []


def test_what_the_map_cannot_serve_is_not_asked(room, capture):
    assert PoseQuery.of(room, capture).options.colour is room.coloured is True
    grey = SimpleNamespace(coloured=False)
    assert not PoseQuery.of(grey, capture).options.colour
    with pytest.raises(OptionError, match="all off"):
        PoseQuery.of(grey, capture, options=PoseSearchOptions().only(colour=True))


def test_seeds_are_not_negative(room, capture):
    with pytest.raises(OptionError, match="seed is -1"):
        PoseQuery.of(room, capture, seed=-1)
