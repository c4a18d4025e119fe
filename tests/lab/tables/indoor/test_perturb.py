import numpy as np
import pytest

from placegraph.core.geometry import Camera, pose_matrix
from placegraph.io.capture.frame import Frame
from placegraph_lab.tables.indoor import perturb as perturb_images
from placegraph_lab.tables.indoor.perturb import Clip, Recording
from placegraph_lab.tables.indoor.robustness import RENDERED, SPOILED

CAMERA = Camera(256, 144, 200.0, 200.0, 124.0, 68.0)
UPRIGHT = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""level_from_camera of a camera that looks ahead."""


@pytest.fixture
def clip():
    """Six of eight frames of a camera that walks ahead and turns."""
    rng = np.random.default_rng(3)
    poses = np.column_stack([0.1 * np.arange(8), np.zeros(8), np.full(8, 1.5), 0.1 * np.arange(8)])
    truth = pose_matrix(poses, np.broadcast_to(UPRIGHT, (8, 3, 3)))
    frames = tuple(
        Frame.from_arrays(
            rng.integers(0, 255, (144, 256, 3), np.uint8), CAMERA, depth=rng.uniform(1, 4, (144, 256)),
            odometry=truth[i], stamp=0.2 * i, index=i,
        )
        for i in range(8)
    )  # fmt: skip
    return Clip.of(Recording("walk", frames, truth, 0.2), range(2, 8))


@pytest.mark.parametrize("family", [f for f in SPOILED if f.sets != RENDERED], ids=lambda f: f.name)
def test_every_family_changes_what_is_told_and_is_drawn_anew_alike(clip, family):
    weak, strong = family.strengths[0], family.strengths[-1]
    first, again, other = (
        family.make(clip, strength, np.random.default_rng(1)) for strength in (weak, weak, strong)
    )
    assert first.frames[-1].index == clip.frames[-1].index
    assert first.truth.shape == (len(first.frames), 4, 4)
    assert _frame_contents(first) == _frame_contents(again)
    assert len({_frame_contents(clip), _frame_contents(first), _frame_contents(other)}) == 3
    assert _frame_contents(clip) == _frame_contents(Clip.of(clip.recording, range(2, 8))), (
        "the recording is untouched"
    )


def _frame_contents(clip):
    """All that a localizer is told of a clip."""
    return tuple(
        (
            f.rgb().tobytes(), f.depth().tobytes(), f.odometry.tobytes(), f.gravity.tobytes(),
            f.camera, f.depth_camera, f.stamp,
        )
        for f in clip.frames
    )  # fmt: skip


def test_bad_input(clip):
    rng = np.random.default_rng(0)
    cap = perturb_images.lens_cap(clip, 0, rng).frames[0]
    assert np.isnan(cap.depth()).all()
    assert cap.rgb().max() < 20
    still = perturb_images.freeze_images(clip, 0, rng).frames
    assert (still[-1].rgb() == clip.frames[0].rgb()).all()
    stamps = [f.stamp for f in perturb_images.backwards(clip, 0, rng).frames]
    assert stamps == sorted(stamps, reverse=True)
    flipped = perturb_images.mirror_images(clip, 0, rng).frames[2]
    assert (flipped.rgb()[:, 0] == clip.frames[2].rgb()[:, -1]).all()
    half = perturb_images.half_elsewhere(clip, clip.recording).frames
    assert (half[0].rgb() == clip.recording.frames[0].rgb()).all()
    assert (half[3].rgb() == clip.frames[3].rgb()).all()
