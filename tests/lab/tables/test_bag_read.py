"""Reading bags beside other readers: that all of them read the same, and what is told of it."""

import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import Capture, Frame
from placegraph_lab.tables.named.bag_read import (
    KINDS,
    Row,
    by_mcap,
    by_rosbags,
    measured,
    opened,
    ours,
    repeated,
    report,
)
from placegraph_lab.worlds.bags import BagWriter, write_capture

PIXELS = 12 * 16 * 5


@pytest.fixture
def clip():
    rgb, camera = np.zeros((12, 16, 3), np.uint8), Camera(16, 12, 16, 16, 8, 6)
    frame = Frame.from_arrays(rgb, camera, depth=np.ones((12, 16)))
    return repeated(Capture.from_frames([frame]), 4 * PIXELS / 1e6)


def test_readers_read_the_same(clip, tmp_path):
    assert len(clip) == 4
    with BagWriter(tmp_path / "a") as writer:
        write_capture(writer, clip)
    assert ours(tmp_path / "a") == by_rosbags(tmp_path / "a") == 4 * PIXELS
    assert by_mcap(tmp_path / "a/a.mcap") == 4 * PIXELS


def test_rows(clip, tmp_path):
    rows = [measured(clip, kind, tmp_path, 1) for kind in KINDS]
    assert [row.frames for row in rows] == [4] * 4
    assert [row.mcap is None for row in rows] == [False, False, True, True]
    assert opened(3, tmp_path, 1) > 0
    row = Row("MCAP", 300.0, 372, 0.03, 0.1, 0.2, 0.15, None)
    assert row.ratio == pytest.approx(2 / 3)
    assert report([row]).splitlines()[-1].split() == (
        [
            "|",
            "MCAP",
            "|",
            "300",
            "|",
            "30",
            "ms",
            "|",
            "3,000",
            "|",
            "1,500",
            "|",
            "2,000",
            "|",
            "–",
            "|",
            "0.67",
            "|",
            "1.33",
            "|",
        ]
    )
