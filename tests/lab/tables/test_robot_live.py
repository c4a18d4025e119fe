from itertools import islice, pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from placegraph.core.geometry import Camera, between, pose_matrix, split_pose
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor.perturb import Recording
from placegraph_lab.tables.named.robot_live import (
    PERIOD,
    Clock,
    FrameResult,
    Row,
    longest,
    loop_recordings,
    play,
    recoveries,
    walks,
)

LEVEL = split_pose(np.eye(4))[1]


def recording(name, start):
    """Ten frames straight on, 10 cm each."""
    poses = np.array([[start + 0.1 * i, start, 1.5, 0.2] for i in range(10)])
    truth = pose_matrix(poses, LEVEL)
    rgb, camera = np.zeros((2, 2, 3), np.uint8), Camera(2, 2, 2, 2, 1, 1)
    frames = tuple(
        Frame.from_arrays(rgb, camera, odometry=pose, stamp=i) for i, pose in enumerate(truth)
    )
    return Recording(name, frames, truth, PERIOD)


@pytest.fixture
def recordings():
    return [recording(str(i), 3.0 * i) for i in range(8)]


def steps(frames):
    poses, _ = split_pose(np.stack([f.odometry for f in frames]))
    return np.linalg.norm(between(poses[:-1], poses[1:])[:, :3], axis=1)


def test_walks_of_four_recordings(recordings):
    every = walks(recordings, 0.0, 1)
    assert [len(w.frames) for w in every] == [40, 40]
    for walk in every:
        assert walk.kidnapped == (10, 20, 30)
        gone = steps(walk.frames)
        # odometry sees nothing of a kidnapping, the truth does
        np.testing.assert_allclose(np.delete(gone, [9, 19, 29]), 0.1, atol=1e-9)
        np.testing.assert_allclose(gone[[9, 19, 29]], 0.0, atol=1e-9)
        assert np.linalg.norm(walk.truth[10, :3, 3] - walk.truth[9, :3, 3]) > 1
        stamps, poses = zip(*(samples[-1] for samples in walk.pieces()), strict=True)
        assert list(stamps) == [f.stamp for f in walk.frames]
        np.testing.assert_allclose(poses, [f.odometry for f in walk.frames], atol=1e-9)
    (quarters,) = walks(recordings[:1], 0.0, 1)
    assert (len(quarters.frames), len(quarters.kidnapped)) == (10, 3)
    drifting = walks(recordings, 1.0, 1)[0]
    assert np.abs(steps(drifting.frames) - steps(every[0].frames)).max() > 1e-4


def test_a_walk_without_end(recordings):
    drawn = list(islice(loop_recordings(recordings, np.random.default_rng(0)), 200))
    gone = steps([frame for frame, _, _ in drawn])
    assert gone.max() < 0.11
    kidnapped = [i for i, (_, _, k) in enumerate(drawn) if k]
    assert len(kidnapped) > 3
    apart = [np.linalg.norm(b[1][:3, 3] - a[1][:3, 3]) for a, b in pairwise(drawn)]
    assert [i + 1 for i, far in enumerate(apart) if far > 0.5] == kidnapped[1:]
    assert np.all(np.diff([frame.stamp for frame, _, _ in drawn]) > 0)


def parse_frames(text):
    """A frame a letter: o OK and right, m OK, F OK and false, . lost; after a bar it was kidnapped."""
    out, kidnapped = [], False
    for letter in text:
        if letter == "|":
            kidnapped = True
            continue
        sure = letter in "omF"
        status, right, false = "OK" if sure else "LOST", letter == "o", letter == "F"
        out.append(FrameResult(status, right, True, false, 5.0, kidnapped))
        kidnapped = False
    return out


def test_what_is_counted():
    walk = parse_frames("ooom|FF.mo|.....|oF")
    assert recoveries(walk) == [4, None, 0]
    assert longest(walk, lambda s: s.false) == 2
    row = Row.of("room", 0.5, [walk, parse_frames("oo")])
    assert row.frames == 18
    assert (row.right, row.sure) == (pytest.approx(7 / 18), pytest.approx(12 / 18))
    assert row.tracked == pytest.approx(7 / 12)
    assert row.false == pytest.approx(3 / 18)
    assert row.most == "4, 1 never"


def test_images_and_odometry_by_the_clock(recordings):
    """Odometry at 100 Hz, and each image when its time has come; a clock that does not wait."""
    events = []

    class Live:
        def move(self, stamp, pose):
            events.append(("odometry", stamp))
            assert pose.shape == (4, 4)
            return SimpleNamespace(map_from_camera=None, estimate=None)

        def see(self, frame):
            events.append(("image", frame.stamp))

    class Instant(Clock):
        def until(self, when):
            pass

    told = play(Live(), list(recordings[0].frames[:3]), 100.0, Instant(0.0))
    assert told["moves"] == 201
    assert told["images"] == 3
    assert [stamp for kind, stamp in events if kind == "image"] == [100.0, 101.0, 102.0]
    assert events.index(("image", 101.0)) == events.index(("odometry", 101.0)) + 1
    assert told["with_pose"] == 0
