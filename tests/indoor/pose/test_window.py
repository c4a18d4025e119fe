"""What a window of frames keeps."""

import time

import pytest

from placegraph.indoor.pose.window import timed


def test_seconds_add_up_by_stage():
    seconds = {}
    for _ in range(2):
        with timed(seconds, "a"):
            time.sleep(0.002)
    with timed(seconds, "b"):
        pass
    assert seconds["a"] >= 0.004
    assert 0.0 <= seconds["b"] < seconds["a"]


def test_what_fails_took_time_too():
    seconds = {}
    with pytest.raises(ZeroDivisionError), timed(seconds, "a"):
        _ = 1 / 0
    assert seconds["a"] > 0.0
