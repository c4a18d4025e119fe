"""Where refinements start in the benchmark."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placegraph.core.geometry import Camera, level_from_camera, pose_matrix
from placegraph.io.capture.capture import Capture
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.metrics import pose_error, position_error, rotation_error
from placegraph_lab.tables.indoor.windows import LEAN, RISE, disturbed, without_depth

TRUTH = pose_matrix([1.0, 2.0, 1.6, 0.7], level_from_camera([0.05, 0.99, 0.1]))


@given(st.integers(0, 2**31), st.floats(0.01, 1.0), st.floats(0.5, 45.0))
def test_a_disturbed_start_is_exactly_so_far_off(seed, metres, degrees):
    start = disturbed(TRUTH, np.random.default_rng(seed), metres, degrees)
    assert position_error(start, TRUTH) == pytest.approx(metres)
    assert rotation_error(start, TRUTH) == pytest.approx(degrees)
    off = pose_error(start, TRUTH)
    assert abs(off[2]) <= metres * RISE + 1e-9
    assert abs(off[5]) >= np.linalg.norm(off[3:]) * np.cos(np.radians(LEAN)) - 1e-9


def test_depth_is_taken_away_and_nothing_else(capture):
    bare = without_depth(capture)
    assert capture[0].depth() is not None
    assert bare.depth_camera is bare[0].depth_camera is bare[0].depth() is None
    assert (bare[1].rgb() == capture[1].rgb()).all()
    assert (bare[1].labels() == capture[1].labels()).all()
    assert bare[1].stamp == capture[1].stamp
    assert (bare[1].gravity == capture[1].gravity).all()


@pytest.fixture
def capture():
    """Two frames in memory, with depth and labels."""
    camera = Camera(8, 6, 10.0, 10.0, 4.0, 3.0)
    frames = [
        Frame.from_arrays(
            np.full((6, 8, 3), 40 * i, np.uint8), camera, stamp=i, index=i,
            depth=np.full((6, 8), 2.0), labels=np.full((6, 8), i), label_kind="instances",
        )
        for i in range(2)
    ]  # fmt: skip
    return Capture.from_frames(frames)
