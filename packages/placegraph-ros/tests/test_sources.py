import itertools

import pytest

from placegraph.errors import OptionError
from placegraph_ros.cli import handle_key
from placegraph_ros.sources import PlaybackClock, WaitPolicy


def clock(step):
    return itertools.count(0.0, step).__next__


def waits(pace, times):
    out, count = [], 0
    for event in pace.play(times, lambda time: time):
        if event is None:
            count += 1
        else:
            out.append(count)
            count = 0
    return out


def test_events_come_when_they_are_due():
    slow, fast = (waits(PlaybackClock(speed, clock(0.05)), [5.0, 5.0, 6.0]) for speed in (1.0, 4.0))
    assert slow[0] == fast[0] == 0
    assert slow[2] > 2 * fast[2] > 0
    assert waits(PlaybackClock(float("inf")), [5.0, 6.0, 7.0]) == [0, 0, 0]
    assert waits(PlaybackClock(1.0, clock(0.0)), [5.0, 500.0, 5.0]) == [0, 0, 0], "gaps and jumps"
    with pytest.raises(OptionError, match="speed is 0"):
        PlaybackClock(0.0)


def test_pause_speed_and_end():
    pace, policy = PlaybackClock(1.0, clock(0.01)), WaitPolicy(0.0)
    came = []
    for event in pace.play([1.0, 1.01, 1.02, 1.03], lambda time: time):
        if event is None and pace.paused:
            assert came == [1.0, 1.01]
            handle_key(" ", pace, policy)
        elif event is not None:
            came.append(event)
            if event == 1.01:
                handle_key(" ", pace, policy)
                assert pace.paused
            if event == 1.02:
                handle_key("+", pace, policy)
                assert pace.speed == 2.0
                handle_key("-", pace, policy)
                handle_key("q", pace, policy)
    assert came == [1.0, 1.01, 1.02]
    assert (pace.speed, pace.stopped, policy.over.is_set()) == (1.0, True, True)
