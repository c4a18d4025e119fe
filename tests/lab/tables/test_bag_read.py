import numpy as np
import pytest

from placegraph.core.geometry import Camera
from placegraph.io.capture.frame import Capture, Frame
from placegraph_lab.tables.named.bag_read import (
    COLUMNS,
    KINDS,
    read_by_mcap,
    read_by_rosbags,
    read_messages,
    repeat,
    time_container,
)
from placegraph_lab.tables.runner import render
from placegraph_lab.worlds.bags import BagWriter, write_capture

PIXELS = 12 * 16 * 5


@pytest.fixture
def clip():
    rgb, camera = np.zeros((12, 16, 3), np.uint8), Camera(16, 12, 16, 16, 8, 6)
    frame = Frame.from_arrays(rgb, camera, depth=np.ones((12, 16)))
    return repeat(Capture.from_frames([frame]), 4 * PIXELS / 1e6)


def test_readers_read_the_same(clip, tmp_path):
    assert len(clip) == 4
    with BagWriter(tmp_path / "a") as writer:
        write_capture(writer, clip)
    assert read_messages(tmp_path / "a") == read_by_rosbags(tmp_path / "a") == 4 * PIXELS
    assert read_by_mcap(tmp_path / "a/a.mcap") == 4 * PIXELS


def test_rows(clip, tmp_path):
    rows = [time_container(clip, kind, tmp_path, 1) for kind in KINDS]
    assert [row["frames"] for row in rows] == [4] * 4
    assert [row["mcap"] is None for row in rows] == [False, False, True, True]
    row = {"container": "MCAP", "megabytes": 300.0, "open": 0.03, "messages": 0.1, "arrays": 0.2,
           "rosbags": 0.15, "mcap": None}  # fmt: skip
    cells = [c.strip() for c in render(COLUMNS, [row]).splitlines()[-1].strip("|").split("|")]
    assert cells == ["MCAP", "300", "30 ms", "3,000", "1,500", "2,000", "–", "0.67", "1.33"]
